/* A motion that is played: piecewise polynomials of the clock, which is the only state. Stands where
   a plant's generated code stands, and answers to the same calls.

   motion_data.h gives MOTION_PIECES, MOTION_TERMS (degree + 1), MOTION_BREAKS (one more than pieces),
   MOTION_TABLE (pieces, terms, outputs) and MODEL_JUMPS, 1 when a value jumps at breaks. */
#include "motion_data.h"

/* A clock that an importer has summed up or integrated is not exact. */
#define MOTION_SLACK 1e-9

static double motion_reached(double clock) { return clock + MOTION_SLACK * (1.0 + fabs(clock)); }

/* Number of breaks that are reached; outside of the breaks the first and last values are held. */
static int motion_breaks_reached(double clock) {
    const double reached = motion_reached(clock);
    int low = 0, high = MOTION_PIECES + 1;
    while (low < high) {
        const int middle = (low + high) / 2;
        if (MOTION_BREAKS[middle] <= reached)
            low = middle + 1;
        else
            high = middle;
    }
    return low;
}

/* Outputs and their slopes; either may be NULL. */
static void motion_evaluate(double clock, double *y, double *slope) {
    const int reached = motion_breaks_reached(clock);
    const int outside = reached == 0 || reached > MOTION_PIECES;
    const int piece = reached == 0 ? 0 : (reached > MOTION_PIECES ? MOTION_PIECES : reached) - 1;
    const double end = MOTION_BREAKS[reached == 0 ? 0 : MOTION_PIECES];
    const double s = (outside ? end : clock) - MOTION_BREAKS[piece];
    for (int i = 0; i < NY; i++) {
        double value = 0.0, rate = 0.0;
        for (int j = MOTION_TERMS - 1; j >= 0; j--) {
            rate = rate * s + value;
            value = value * s + MOTION_TABLE[(piece * MOTION_TERMS + j) * NY + i];
        }
        if (y != NULL) y[i] = value;
        if (slope != NULL) slope[i] = outside ? 0.0 : rate;
    }
}

/* How long the values go on without a jump. */
static double model_time_to_jump(const double *x) {
    const int reached = motion_breaks_reached(x[0]);
    return MODEL_JUMPS && reached <= MOTION_PIECES ? MOTION_BREAKS[reached] - x[0] : INFINITY;
}

static int plant_rhs(const double **arg, double **res, int *iw, double *w, int mem) {
    res[0][0] = 1.0;
    return 0;
}

static int plant_outputs(const double **arg, double **res, int *iw, double *w, int mem) {
    motion_evaluate(arg[0][0], res[0], NULL);
    return 0;
}

static int plant_linearize(const double **arg, double **res, int *iw, double *w, int mem) {
    res[0][0] = 1.0;
    res[1][0] = 0.0;
    return 0;
}

static int plant_forward(const double **arg, double **res, int *iw, double *w, int mem) {
    double slope[NY];
    motion_evaluate(arg[0][0], NULL, slope);
    res[0][0] = 0.0;
    for (int i = 0; i < NY; i++) res[1][i] = slope[i] * arg[3][0];
    return 0;
}

static int plant_reverse(const double **arg, double **res, int *iw, double *w, int mem) {
    double slope[NY];
    motion_evaluate(arg[0][0], NULL, slope);
    res[0][0] = 0.0;
    for (int i = 0; i < NY; i++) res[0][0] += slope[i] * arg[4][i];
    return 0;
}

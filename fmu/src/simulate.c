/* A plant's motion over a grid of times for Python: the solver of the FMUs, with inputs that are
   polynomials from break to break. Compiled once per plant structure; values are arguments.

   simulate_data.h gives SOLVER_N (states), NU, NP and NY, and the work sizes of plant.c. */
#include "simulate_data.h"
#include "generated.c"
#include "solver.c"

#if defined(_WIN32)
#define SHOWN __declspec(dllexport)
#else
#define SHOWN __attribute__((visibility("default")))
#endif

#define LENGTH(n) ((n) > 0 ? (n) : 1)
/* Breaks and times that differ by less, relatively, are the same. */
static const double SAME = 1e-12;

/* Whole in Python's memory, where it has the same members in the same order. */
typedef struct {
    const double *parameters, *nominal;
    const double *times;        /* intervals + 1 */
    const double *breaks;       /* pieces + 1 */
    const double *coefficients; /* u_i = sum_j coefficients[k][j][i] (t - breaks[k])^j */
    double *states;             /* row k: at times[k]; the first is given */
    double tolerance;           /* of a step, in units of nominal */
    long long intervals, pieces, degree;
    long long max_steps; /* between two times */
    /* where it stands */
    long long interval, piece, steps;
    double offset, step;
    double x[SOLVER_N];
} Simulation;

enum { SIMULATED, GOES_ON, FAILED };

typedef struct {
    const Simulation *of;
    double begin; /* of the solver's time, behind the break of the piece */
} Span;

static void inputs_at(const Span *span, double s, double *u, double *slope) {
    const Simulation *of = span->of;
    const double t = span->begin + s;
    const double *c = of->coefficients + of->piece * (of->degree + 1) * NU;
    for (int i = 0; i < NU; i++) {
        double value = 0.0, rise = 0.0;
        for (long long j = of->degree; j >= 0; j--) {
            rise = rise * t + value;
            value = value * t + c[j * NU + i];
        }
        u[i] = value;
        if (slope != NULL) slope[i] = rise;
    }
}

static void span_rhs(const void *context, double s, const double *x, double *xdot) {
    const Span *span = context;
    double u[LENGTH(NU)], w[PLANT_W];
    inputs_at(span, s, u, NULL);
    const double *arg[PLANT_ARG] = {x, u, span->of->parameters};
    double *res[PLANT_RES] = {xdot};
    int iw[PLANT_IW];
    plant_rhs(arg, res, iw, w, 0);
}

static void span_linearize(const void *context, double s, const double *x, double *xdot,
                           double *jacobian, double *slope) {
    const Span *span = context;
    double u[LENGTH(NU)], rise[LENGTH(NU)], w[PLANT_W];
    int iw[PLANT_IW], moving = 0;
    inputs_at(span, s, u, rise);
    const double *arg[PLANT_ARG] = {x, u, span->of->parameters, rise};
    double *res[PLANT_RES] = {xdot, jacobian};
    plant_linearize(arg, res, iw, w, 0);
    for (int i = 0; i < NU; i++) moving |= rise[i] != 0.0;
    if (!moving) {
        memset(slope, 0, SOLVER_N * sizeof *slope);
        return;
    }
    double *slopes[PLANT_RES] = {slope};
    plant_slope(arg, slopes, iw, w, 0);
}

/* From where the simulation stands on, for so many steps at most: SIMULATED at the last time, GOES_ON
   before it, FAILED where the solver cannot go on. */
SHOWN int simulate(Simulation *run, long long budget);
int simulate(Simulation *run, long long budget) {
    SolverWork work;
    Span span = {run, 0.0};
    const SolverProblem problem = {&span, span_rhs, span_linearize, run->nominal};
    while (run->interval < run->intervals) {
        if (budget <= 0) return GOES_ON;
        const double begin = run->times[run->interval];
        const double same = begin + SAME * (1.0 + fabs(begin));
        while (run->piece + 1 < run->pieces && run->breaks[run->piece + 1] <= same) run->piece++;
        span.begin = begin - run->breaks[run->piece] + run->offset;
        const long long left = run->max_steps - run->steps;
        const SolverOptions options = {run->tolerance, 0.0, (long)(left < budget ? left : budget)};
        const double length = run->times[run->interval + 1] - begin - run->offset;
        SolverReport report;
        SolverStatus status = solver_advance(&problem, &options, &work, length, run->step, run->x,
                                             NULL, NULL, &report);
        const long long made = report.steps + report.rejected;
        run->step = report.step;
        budget -= made;
        if (status == SOLVER_TOO_MANY_STEPS && made < left) {
            run->steps += made;
            run->offset += report.reached;
            continue;
        }
        if (status != SOLVER_OK) return FAILED;
        run->steps = 0;
        run->offset = 0.0;
        run->interval++;
        memcpy(run->states + run->interval * SOLVER_N, run->x, sizeof run->x);
    }
    return SIMULATED;
}

/* Derivatives and outputs at many points: rows of x, u, xdot and y. */
SHOWN void outputs(const double *x, const double *u, const double *p, double *xdot, double *y,
                   long long rows);
void outputs(const double *x, const double *u, const double *p, double *xdot, double *y,
             long long rows) {
    double w[PLANT_W];
    int iw[PLANT_IW];
    for (long long k = 0; k < rows; k++) {
        const double *arg[PLANT_ARG] = {x + k * SOLVER_N, u + k * NU, p};
        double *res[PLANT_RES] = {y + k * NY};
        plant_outputs(arg, res, iw, w, 0);
        if (xdot != NULL) {
            res[0] = xdot + k * SOLVER_N;
            plant_rhs(arg, res, iw, w, 0);
        }
    }
}

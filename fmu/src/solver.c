/* Rodas4, a stiffly accurate Rosenbrock method of order 4 with an embedded solution of order 3,
   6 stages, L-stable.

   E. Hairer and G. Wanner, Solving Ordinary Differential Equations II: Stiff and
   Differential-Algebraic Problems, 2nd ed., Springer 1996, section VI.4 (RODAS), in the form of
   section IV.7 that needs no product with the Jacobian:

     (I/(h gamma) - J) k_i = f(s + alpha_i h, x + sum_j a_ij k_j) + sum_j (c_ij/h) k_j + h d_i df/ds
     x_new = x + sum_j a_5j k_j + k_5 + k_6,   error = k_6

   One-step: nothing but the suggestion for the next step length outlives a step, so a rollback is
   exact. */
#include "solver.h"

#include <math.h>
#include <string.h>

#define STAGES 6

#if defined(__GNUC__)
#define INLINE inline __attribute__((always_inline))
#else
#define INLINE inline
#endif

static const double RODAS_GAMMA = 0.25;
static const double RODAS_ALPHA[STAGES] = {0.0, 0.386, 0.21, 0.63, 1.0, 1.0};
static const double RODAS_D[STAGES] = {0.25, -0.1043, 0.1035, -0.03620000000000023, 0.0, 0.0};
static const double RODAS_A[STAGES][STAGES - 1] = {
    {0},
    {1.544},
    {0.9466785280815826, 0.2557011698983284},
    {3.314825187068521, 2.896124015972201, 0.9986419139977817},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950},
    {1.221224509226641, 6.019134481288629, 12.53708332932087, -0.6878860361058950, 1.0},
};
static const double RODAS_C[STAGES][STAGES - 1] = {
    {0},
    {-5.6688},
    {-2.430093356833875, -0.2063599157091915},
    {-0.1073529058151375, -9.594562251023355, -20.47028614809616},
    {7.496443313967647, -10.24680431464352, -33.99990352819905, 11.70890893206160},
    {8.083246795921522, -7.981132988064893, -31.52159432874371, 16.31930543123136,
     -6.058818238834054},
};

/* Step-size control: h_new = h SAFETY error^(-1/4), within these factors. */
static const double SAFETY = 0.9, SHRINK = 0.1, GROW = 5.0;
static const double FIRST_CHANGE = 0.5;
/* Steps may be longer than suggested by this factor, which SAFETY leaves room for. */
static const double STRETCH = 1.08;
/* So many steps before the end of the span and less are made evenly. */
static const double EVEN = 4.0;
/* Shortest step, as a part of the span. */
static const double SHORTEST = 1e-13;
/* The error of a state need not be smaller than this part of its value: rounding. */
static const double ROUNDING = 1e-14;

static INLINE void swap(double *vector, int i, int j) {
    double value = vector[i];
    vector[i] = vector[j];
    vector[j] = value;
}

/* The row below the diagonal whose element in this column is the largest; rows are weighed by the
   nominals, so the choice does not depend on units. Returns -1 when none is finite and not zero. */
static INLINE int pivot_row(const double *column, const double *weight, int k) {
    int pivot = k;
    double largest = fabs(column[k]) * weight[k];
    for (int i = k + 1; i < SOLVER_N; i++) {
        double size = fabs(column[i]) * weight[i];
        if (size > largest) largest = size, pivot = i;
    }
    return largest > 0.0 && isfinite(largest) ? pivot : -1;
}

/* The inverse of I/(h gamma) - J by Gauss-Jordan elimination with row pivoting, in its place.
   Returns 0 when the matrix is singular or not finite.

   Six products with an inverse take less time than six solutions with LU factors, each of which is a
   chain of operations that wait for one another; they are as accurate (A. Druinsky and S. Toledo,
   How accurate is inv(A)*b?, arXiv:1201.6035). */
static int invert(SolverWork *w, const double *nominal, double shift) {
    double *a = w->inverse, weight[SOLVER_N], column[SOLVER_N];
    int pivots[SOLVER_N], permuted = 0;
    for (int i = 0; i < SOLVER_N; i++) weight[i] = 1.0 / nominal[i];
    for (int i = 0; i < SOLVER_N * SOLVER_N; i++) a[i] = -w->jacobian[i];
    for (int i = 0; i < SOLVER_N; i++) a[i + SOLVER_N * i] += shift;
    for (int k = 0; k < SOLVER_N; k++) {
        double *own = a + SOLVER_N * k;
        const int pivot = pivots[k] = pivot_row(own, weight, k);
        if (pivot < 0) return 0;
        if (pivot != k) {
            permuted = 1;
            for (int j = 0; j < SOLVER_N; j++) swap(a + SOLVER_N * j, k, pivot);
            swap(weight, k, pivot);
        }
        const double reciprocal = 1.0 / own[k];
        memcpy(column, own, sizeof column);
        for (int j = 0; j < SOLVER_N; j++) {
            double *other = a + SOLVER_N * j;
            const double factor = other[k] * reciprocal;
            if (j == k || factor == 0.0) continue;
            for (int i = 0; i < SOLVER_N; i++) other[i] -= column[i] * factor;
            other[k] = factor;
        }
        for (int i = 0; i < SOLVER_N; i++) own[i] = -column[i] * reciprocal;
        own[k] = reciprocal;
    }
    for (int k = SOLVER_N - 1; permuted && k >= 0; k--)
        for (int i = 0; i < SOLVER_N && pivots[k] != k; i++)
            swap(a + i, SOLVER_N * k, SOLVER_N * pivots[k]);
    return 1;
}

/* Stage i from k of the stages before it; i is a number in the code, so that the compiler writes out
   the sums with the coefficients in them. */
static INLINE void rodas_stage(const SolverProblem *problem, SolverWork *w, double s, double h,
                               double inverse, const double *x, int i) {
    double total[SOLVER_N], *k = w->k[i];
    for (int n = 0; n < SOLVER_N; n++) {
        double shift = 0.0, value = x[n];
        for (int j = 0; j < i; j++) {
            value += RODAS_A[i][j] * w->k[j][n];
            shift += RODAS_C[i][j] * w->k[j][n];
        }
        w->stage[n] = value;
        total[n] = inverse * shift + h * RODAS_D[i] * w->slope[n];
    }
    const double *f = w->f;
    if (i > 0) {
        problem->rhs(problem->context, s + RODAS_ALPHA[i] * h, w->stage, k);
        f = k;
    }
    for (int n = 0; n < SOLVER_N; n++) total[n] += f[n];
    double solution[SOLVER_N] = {0};
    for (int j = 0; j < SOLVER_N; j++)
        for (int n = 0; n < SOLVER_N; n++) solution[n] += w->inverse[n + SOLVER_N * j] * total[j];
    memcpy(k, solution, sizeof solution);
}

/* One step of length h from x at s; f, jacobian and slope of the start stand in the work memory.
   The new state is left in w->stage, its error estimate in w->k[5]. Returns 0 on failure. */
static int rodas_step(const SolverProblem *problem, SolverWork *w, double s, double h,
                      const double *x) {
    const double inverse = 1.0 / h;
    if (!invert(w, problem->nominal, inverse / RODAS_GAMMA)) return 0;
    rodas_stage(problem, w, s, h, inverse, x, 0);
    rodas_stage(problem, w, s, h, inverse, x, 1);
    rodas_stage(problem, w, s, h, inverse, x, 2);
    rodas_stage(problem, w, s, h, inverse, x, 3);
    rodas_stage(problem, w, s, h, inverse, x, 4);
    rodas_stage(problem, w, s, h, inverse, x, 5);
    for (int n = 0; n < SOLVER_N; n++) w->stage[n] += w->k[STAGES - 1][n];
    return 1;
}

/* Largest error of the step just made, in units of what is allowed; not finite when it failed. */
static double step_error(const SolverProblem *problem, const SolverWork *w, double tolerance,
                         const double *x) {
    double largest = 0.0;
    for (int n = 0; n < SOLVER_N; n++) {
        double allowed = tolerance * problem->nominal[n] + ROUNDING * fabs(x[n]);
        double error = fabs(w->k[STAGES - 1][n]) / allowed;
        if (!isfinite(w->stage[n]) || !isfinite(error)) return NAN;
        if (error > largest) largest = error;
    }
    return largest;
}

/* A first step that no jump of an input can fool: over it no state changes by much more than
   FIRST_CHANGE of its nominal. Returns 0 when f is not finite. */
static double first_step(const SolverProblem *problem, const SolverWork *w, double span) {
    double rate = 0.0;
    for (int n = 0; n < SOLVER_N; n++) {
        double size = fabs(w->f[n]) / problem->nominal[n];
        if (!isfinite(size)) return 0.0;
        if (size > rate) rate = size;
    }
    return rate * span > FIRST_CHANGE ? FIRST_CHANGE / rate : span;
}

static void linearize(const SolverProblem *problem, SolverWork *w, double s, const double *x) {
    problem->linearize(problem->context, s, x, w->f, w->jacobian, w->slope);
}

/* Steps of equal length and no error control: the work per call is known beforehand. */
static SolverStatus advance_fixed(const SolverProblem *problem, const SolverOptions *options,
                                  SolverWork *w, double span, double *x, SolverReport *report) {
    double count = ceil(span / options->fixed_step * (1.0 - 1e-9));
    if (!(count <= (double)options->max_steps)) return SOLVER_TOO_MANY_STEPS;
    long steps = count < 1.0 ? 1 : (long)count;
    double h = span / (double)steps;
    for (long i = 0; i < steps; i++) {
        linearize(problem, w, (double)i * h, x);
        if (!rodas_step(problem, w, (double)i * h, h, x) ||
            isnan(step_error(problem, w, 1.0, x)))
            return SOLVER_NOT_FINITE;
        memcpy(x, w->stage, sizeof w->stage);
        report->reached = (double)(i + 1) * h;
        report->steps++;
    }
    report->reached = span;
    return SOLVER_OK;
}

static SolverStatus advance_controlled(const SolverProblem *problem, const SolverOptions *options,
                                       SolverWork *w, double span, double *x,
                                       SolverObserver observer, void *observer_context,
                                       SolverReport *report) {
    double s = 0.0, step = report->step;
    linearize(problem, w, s, x);
    double first = first_step(problem, w, span);
    if (first == 0.0) return SOLVER_NOT_FINITE;
    if (!(step > 0.0) || step > first) step = first;
    for (;;) {
        if (report->steps + report->rejected >= options->max_steps) return SOLVER_TOO_MANY_STEPS;
        /* even steps to the end rather than long ones and a stub, a little longer than suggested
           where that saves one */
        double count = ceil((span - s) / (step * STRETCH));
        int last = count <= 1.0;
        double h = last ? span - s : (count <= EVEN ? (span - s) / count : step);
        double error = rodas_step(problem, w, s, h, x)
                           ? step_error(problem, w, options->tolerance, x)
                           : NAN;
        double factor = SHRINK;
        if (!isnan(error)) factor = error > 0.0 ? SAFETY / sqrt(sqrt(error)) : GROW;
        factor = factor < SHRINK ? SHRINK : (factor > GROW ? GROW : factor);
        if (!(error <= 1.0)) {
            step = h * (factor < SAFETY ? factor : SAFETY);
            report->rejected++;
            if (step < SHORTEST * span) return SOLVER_STEP_TOO_SMALL;
            continue;
        }
        memcpy(x, w->stage, sizeof w->stage);
        s = last ? span : s + h;
        report->steps++;
        report->reached = s;
        /* a step cut short by the end of the span says nothing against the longer one */
        if (!(h < step && factor >= 1.0) || factor * h > step) step = factor * h;
        report->step = step;
        if (last || (observer != NULL && observer(observer_context, s, x))) return SOLVER_OK;
        linearize(problem, w, s, x);
    }
}

static SolverStatus solver_advance(const SolverProblem *problem, const SolverOptions *options,
                                   SolverWork *work, double span, double step, double *x,
                                   SolverObserver observer, void *observer_context,
                                   SolverReport *report) {
    *report = (SolverReport){.reached = 0.0, .step = step, .steps = 0, .rejected = 0};
    if (options->fixed_step > 0.0)
        return advance_fixed(problem, options, work, span, x, report);
    return advance_controlled(problem, options, work, span, x, observer, observer_context, report);
}

static const char *solver_message(SolverStatus status) {
    switch (status) {
    case SOLVER_OK: return "done";
    case SOLVER_NOT_FINITE: return "the derivatives of the states are not finite";
    case SOLVER_STEP_TOO_SMALL: return "no step, however small, meets the tolerance";
    default: return "too many internal steps";
    }
}

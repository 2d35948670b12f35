/* Rodas5P, a stiffly accurate Rosenbrock method of order 5 with an embedded solution of order 4,
   8 stages, L-stable.

   G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the
   Julia Differential Equations package, BIT Numerical Mathematics 63 (2023) 27, in the form of
   E. Hairer and G. Wanner, Solving Ordinary Differential Equations II, 2nd ed., Springer 1996,
   section IV.7, that needs no product with the Jacobian:

     (I/(h gamma) - J) k_i = f(s + alpha_i h, x + sum_j a_ij k_j) + sum_j (c_ij/h) k_j + h d_i df/ds
     x_new = x + sum_j a_7j k_j + k_7 + k_8,   error = k_8

   Where inputs jump from one communication step to the next it takes one step where Rodas4 (6
   stages, order 4) takes two.

   One-step: nothing but the suggestion for the next step length outlives a step, so a rollback is
   exact. */
#include "solver.h"

#include <math.h>
#include <string.h>

#define STAGES 8

#if defined(__GNUC__)
#define INLINE inline __attribute__((always_inline))
#else
#define INLINE inline
#endif

static const double RODAS_GAMMA = 0.21193756319429014;
static const double RODAS_ALPHA[STAGES] = {
    0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0,
};
static const double RODAS_D[STAGES] = {
    0.21193756319429014, -0.42387512638858027, -0.3384627126235924, 1.8046452872882734,
    2.325825639765069,
};
static const double RODAS_A[STAGES][STAGES - 1] = {
    {0},
    {3.0},
    {2.849394379747939, 0.45842242204463923},
    {-6.954028509809101, 2.489845061869568, -10.358996098473584},
    {2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
     0.030198172008377946},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
     0.030198172008377946, 1.0},
    {-7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256,
     0.030198172008377946, 1.0, 1.0},
};
static const double RODAS_C[STAGES][STAGES - 1] = {
    {0},
    {-14.155112264123755},
    {-17.97296035885952, -2.859693295451294},
    {147.12150275711716, -1.41221402718213, 71.68940251302358},
    {165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306},
    {24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125,
     -0.6610691825249471},
    {30.91273214028599, -3.1208243349937974, 77.79954646070892, 34.28646028294783,
     -19.097331116725623, -28.087943162872662},
    {37.80277123390563, -3.2571969029072276, 112.26918849496327, 66.9347231244047,
     -40.06618937091002, -54.66780262877968, -9.48861652309627},
};

/* Step-size control: h_new = h SAFETY error^(-1/5), within these factors. Steps that grew faster
   would leap over kinks of f (a muscle that goes slack, a valve that chokes) unseen. */
static const double SAFETY = 0.9, SHRINK = 0.1, GROW = 2.5;
/* Errors below are so small that the step grows as far as it may. */
static const double LEAST_ERROR = 1e-5;
static const double FIRST_CHANGE = 0.5;
/* Steps may be longer than suggested by this factor, which SAFETY leaves room for. */
static const double STRETCH = 1.08;
/* So many steps before the end of the span and less are made evenly. */
static const double EVEN = 4.0;
/* A rejected step tells of a kink of f, near which an estimate is too small as often as not: the next
   one is shorter by this factor, and may err by this part of the usual. */
static const double CAUTION = 0.6, BEHIND_REJECTED = 0.1;
/* Shortest step, as a part of the span. */
static const double SHORTEST = 1e-13;
/* The error of a state need not be smaller than this part of its value: rounding. */
static const double ROUNDING = 1e-14;

/* Of what error asks for: about error^(-1/5), by roots that are the same on every platform, which
   powers of C libraries are not: 1/5 is nearly 1/4 - 1/16 + 1/64. */
static INLINE double change_of_step(double error) {
    if (!(error > LEAST_ERROR)) return GROW;
    const double quarter = sqrt(sqrt(error)), sixteenth = sqrt(sqrt(quarter));
    const double factor = SAFETY * sixteenth / (quarter * sqrt(sqrt(sixteenth)));
    return factor < SHRINK ? SHRINK : (factor > GROW ? GROW : factor);
}

#ifndef SOLVER_TABLES_ONLY /* which lanes.c takes, to step many cases side by side */
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
    rodas_stage(problem, w, s, h, inverse, x, 6);
    rodas_stage(problem, w, s, h, inverse, x, 7);
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
    double s = 0.0, step = report->step, allowed = 1.0;
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
        double factor = isnan(error) ? SHRINK : change_of_step(error);
        if (!(error <= allowed)) {
            step = h * (factor < SAFETY ? factor : SAFETY) * (allowed < 1.0 ? 1.0 : CAUTION);
            allowed = BEHIND_REJECTED;
            report->rejected++;
            if (step < SHORTEST * span) return SOLVER_STEP_TOO_SMALL;
            continue;
        }
        memcpy(x, w->stage, sizeof w->stage);
        s = last ? span : s + h;
        allowed = 1.0;
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
#endif /* SOLVER_TABLES_ONLY */

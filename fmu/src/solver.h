/* Rodas5P: one-step, L-stable integrator for small stiff systems x' = f(s, x).

   Define SOLVER_N, the number of states, before including this file. */
#ifndef SOLVER_H
#define SOLVER_H

#ifndef SOLVER_N
#error "define SOLVER_N, the number of states"
#endif

/* The system. s is the time since the start of the communication step. */
typedef struct {
    const void *context;
    void (*rhs)(const void *context, double s, const double *x, double *xdot);
    /* xdot, the Jacobian df/dx (dense, by columns) and df/ds at one point. */
    void (*linearize)(const void *context, double s, const double *x, double *xdot, double *jacobian,
                      double *slope);
    const double *nominal; /* typical size of each state, > 0 */
} SolverProblem;

typedef struct {
    double tolerance;  /* allowed error of a step, in units of nominal */
    double fixed_step; /* > 0: steps of about this length, without error control */
    long max_steps;    /* attempts before giving up */
} SolverOptions;

/* Scratch memory; holds nothing between two calls. */
typedef struct {
    double k[8][SOLVER_N];
    double jacobian[SOLVER_N * SOLVER_N];
    double inverse[SOLVER_N * SOLVER_N]; /* of I/(h gamma) - J, by columns */
    double stage[SOLVER_N], f[SOLVER_N], slope[SOLVER_N];
} SolverWork;

typedef enum {
    SOLVER_OK,
    SOLVER_NOT_FINITE,     /* f is not finite at the start */
    SOLVER_STEP_TOO_SMALL, /* no step, however small, meets the tolerance */
    SOLVER_TOO_MANY_STEPS
} SolverStatus;

typedef struct {
    double reached; /* time up to which x is valid */
    double step;    /* suggestion for the next call */
    long steps, rejected;
} SolverReport;

/* Called behind each accepted step; not 0 ends the integration there. */
typedef int (*SolverObserver)(void *context, double s, const double *x);

/* Advance x from s = 0 to s = span. On failure x is the state at report->reached. */
static SolverStatus solver_advance(const SolverProblem *problem, const SolverOptions *options,
                                   SolverWork *work, double span, double step, double *x,
                                   SolverObserver observer, void *observer_context,
                                   SolverReport *report);

static const char *solver_message(SolverStatus status);

#endif

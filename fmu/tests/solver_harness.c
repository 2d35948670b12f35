/* The solver alone, on problems whose solution is known otherwise. The test puts
   "#define PROBLEM ..." in front of this file. */
#if PROBLEM == 3
#define SOLVER_N 3
#else
#define SOLVER_N 2
#endif
#include "solver.c"

#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

static const double NOMINAL[3] = {1.0, 1.0, 1.0};

static void rhs(const void *context, double s, const double *x, double *f) {
    (void)context, (void)s;
#if PROBLEM == 1 /* non-autonomous, nonlinear */
    f[0] = -x[0] * x[1] + sin(3.0 * s);
    f[1] = x[0] - x[1] + s * s;
#elif PROBLEM == 2 /* Van der Pol, mu = 1000 */
    f[0] = x[1];
    f[1] = 1e3 * (1.0 - x[0] * x[0]) * x[1] - x[0];
#elif PROBLEM == 3 /* Robertson */
    f[0] = -0.04 * x[0] + 1e4 * x[1] * x[2];
    f[2] = 3e7 * x[1] * x[1];
    f[1] = -f[0] - f[2];
#else /* runs into infinity at s = 1 */
    f[0] = x[0] * x[0];
    f[1] = 0.0;
#endif
}

static void slopes(const void *context, double s, const double *x, double *f, double *jacobian,
                   double *slope) {
    rhs(context, s, x, f);
    memset(slope, 0, SOLVER_N * sizeof *slope);
#if PROBLEM == 1
    const double j[] = {-x[1], 1.0, -x[0], -1.0};
    slope[0] = 3.0 * cos(3.0 * s);
    slope[1] = 2.0 * s;
#elif PROBLEM == 2
    const double j[] = {0.0, -2e3 * x[0] * x[1] - 1.0, 1.0, 1e3 * (1.0 - x[0] * x[0])};
#elif PROBLEM == 3
    const double a = 1e4 * x[2], b = 1e4 * x[1], c = 6e7 * x[1];
    const double j[] = {-0.04, 0.04, 0.0, a, -a - c, c, b, -b, 0.0};
#else
    const double j[] = {2.0 * x[0], 0.0, 0.0, 0.0};
#endif
    memcpy(jacobian, j, sizeof j);
}

/* x advances by span; numbers[] = reached, suggestion, steps, rejected. Returns the status. */
EXPORT int advance(double span, double tolerance, double fixed_step, long max_steps, double *x,
                   double *numbers) {
    const SolverProblem problem = {0, rhs, slopes, NOMINAL};
    const SolverOptions options = {tolerance, fixed_step, max_steps};
    SolverWork work;
    SolverReport report;
    SolverStatus status =
        solver_advance(&problem, &options, &work, span, 0.0, x, 0, 0, &report);
    numbers[0] = report.reached;
    numbers[1] = report.step;
    numbers[2] = (double)report.steps;
    numbers[3] = (double)report.rejected;
    return (int)status;
}

EXPORT const char *message(int status) { return solver_message((SolverStatus)status); }

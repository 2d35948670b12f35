/* The solver alone, on problems with a solution in closed form:

   CURVED   x' = x^2 cos s, y' = -y + x: x = x0/(1 - x0 sin s); nonlinear and non-autonomous
   STIFF    x' = -lambda (x - cos s) - sin s: x = cos s from x0 = 1 (Prothero and Robinson 1974)
   SWAPPED  x' = y, y' = -w^2 x with w = 1e4: the pivots of I/(h gamma) - J lie off the diagonal
   BLOW_UP  x' = x^2: infinite at s = 1 from x0 = 1 */
#define SOLVER_N 2
#include "solver.c"

#include "check.h"

enum { CURVED, STIFF, SWAPPED, BLOW_UP };
static const double LAMBDA = 1e6, W = 1e4;
static int problem;

static void rhs(const void *context, double s, const double *x, double *f) {
    (void)context;
    switch (problem) {
    case CURVED: f[0] = x[0] * x[0] * cos(s), f[1] = x[0] - x[1]; break;
    case STIFF: f[0] = -LAMBDA * (x[0] - cos(s)) - sin(s), f[1] = 0.0; break;
    case SWAPPED: f[0] = x[1], f[1] = -W * W * x[0]; break;
    default: f[0] = x[0] * x[0], f[1] = 0.0; break;
    }
}

static void slopes(const void *context, double s, const double *x, double *f, double *jacobian,
                   double *slope) {
    rhs(context, s, x, f);
    memset(jacobian, 0, 4 * sizeof *jacobian);
    memset(slope, 0, 2 * sizeof *slope);
    switch (problem) {
    case CURVED:
        jacobian[0] = 2.0 * x[0] * cos(s), jacobian[1] = 1.0, jacobian[3] = -1.0;
        slope[0] = -x[0] * x[0] * sin(s);
        break;
    case STIFF: jacobian[0] = -LAMBDA, slope[0] = -LAMBDA * sin(s) - cos(s); break;
    case SWAPPED: jacobian[1] = -W * W, jacobian[2] = 1.0; break;
    default: jacobian[0] = 2.0 * x[0]; break;
    }
}

static SolverReport told;

static SolverStatus solve(int which, double *x, double span, double tolerance, double fixed_step,
                          long max_steps, SolverObserver observer, void *context) {
    static const double NOMINAL[2] = {1.0, 1.0}, FAST[2] = {1.0, 1e4};
    problem = which;
    const SolverProblem p = {NULL, rhs, slopes, which == SWAPPED ? FAST : NOMINAL};
    const SolverOptions options = {tolerance, fixed_step, max_steps};
    SolverWork work;
    return solver_advance(&p, &options, &work, span, 0.0, x, observer, context, &told);
}

static double curved_error(double tolerance, double fixed_step) {
    double x[2] = {0.5, 0.0};
    CHECK(solve(CURVED, x, 1.5, tolerance, fixed_step, 100000, NULL, NULL) == SOLVER_OK);
    return fabs(x[0] - 0.5 / (1.0 - 0.5 * sin(1.5)));
}

static void fixed_steps_are_of_order_five(void) {
    for (double h = 0.05; h > 0.01; h /= 2.0) {
        const double order = log2(curved_error(1.0, h) / curved_error(1.0, h / 2.0));
        CHECK(order > 4.8);
        CHECK(order < 5.3);
    }
}

static void fixed_steps_are_just_those_asked_for(void) {
    curved_error(1.0, 0.15);
    CHECK(told.steps == 10 && told.rejected == 0);
    curved_error(1.0, 0.4); /* none longer than asked for */
    CHECK(told.steps == 4 && told.reached == 1.5);
    curved_error(1.0, 9.0);
    CHECK(told.steps == 1);
}

static void the_error_follows_the_tolerance(void) {
    double last = 1.0;
    for (double tolerance = 1e-4; tolerance > 1e-11; tolerance *= 1e-2) {
        const double error = curved_error(tolerance, 0.0);
        CHECK(error < last);
        CHECK(error < 20.0 * tolerance);
        last = error;
    }
}

static void a_stiff_system_takes_few_steps(void) {
    double x[2] = {1.0, 7.0};
    CHECK(solve(STIFF, x, 10.0, 1e-8, 0.0, 100000, NULL, NULL) == SOLVER_OK);
    NEAR(x[0], cos(10.0), 1e-7);
    NEAR(x[1], 7.0, 0.0);
    CHECK(told.steps < 1000);
    x[0] = 3.0; /* far from the slow motion, which it joins at once: L-stable */
    CHECK(solve(STIFF, x, 1.0, 1e-6, 0.1, 100000, NULL, NULL) == SOLVER_OK);
    NEAR(x[0], cos(1.0), 1e-3);
}

static void rows_are_exchanged_where_the_pivot_asks_for_it(void) {
    double x[2] = {1.0, 0.0};
    CHECK(solve(SWAPPED, x, 1e-3, 1e-10, 0.0, 100000, NULL, NULL) == SOLVER_OK);
    NEAR(x[0], cos(W * 1e-3), 1e-7);
    NEAR(x[1], -W * sin(W * 1e-3), 1e-3);
}

static void the_pivot_is_the_largest_in_nominals(void) {
    const double column[2] = {1.0, 4.0}, first[2] = {10.0, 0.5}, second[2] = {0.1, 0.5};
    CHECK(pivot_row(column, first, 0) == 0);
    CHECK(pivot_row(column, second, 0) == 1);
    const double zeros[2] = {0.0, 0.0}, broken[2] = {INFINITY, 1.0};
    CHECK(pivot_row(zeros, first, 0) == -1 && pivot_row(broken, first, 0) == -1);
}

static void a_failure_says_how_far_it_came(void) {
    double x[2] = {1.0, 0.0};
    CHECK(solve(BLOW_UP, x, 2.0, 1e-6, 0.0, 100000, NULL, NULL) != SOLVER_OK);
    CHECK(told.reached > 0.9 && told.reached < 1.01);
    CHECK(isfinite(x[0]));
    double nan[2] = {NAN, 0.0};
    CHECK(solve(CURVED, nan, 1.0, 1e-6, 0.0, 100000, NULL, NULL) == SOLVER_NOT_FINITE);
    CHECK(told.reached == 0.0);
    double many[2] = {1.0, 0.0};
    CHECK(solve(SWAPPED, many, 1.0, 1e-10, 0.0, 50, NULL, NULL) == SOLVER_TOO_MANY_STEPS);
    CHECK(told.steps + told.rejected == 50);
    CHECK(solve(SWAPPED, many, 1.0, 1e-10, 1e-3, 50, NULL, NULL) == SOLVER_TOO_MANY_STEPS);
    for (int status = SOLVER_OK; status <= SOLVER_TOO_MANY_STEPS; status++)
        CHECK(strlen(solver_message((SolverStatus)status)) > 3);
}

/* Ends behind the first step past 0.5. */
static int past_half(void *context, double s, const double *x) {
    (*(long *)context)++;
    CHECK(fabs(x[0] - 0.5 / (1.0 - 0.5 * sin(s))) < 1e-6);
    return s > 0.5;
}

static void an_observer_sees_each_step_and_can_end_it(void) {
    long seen = 0;
    double x[2] = {0.5, 0.0};
    CHECK(solve(CURVED, x, 1.5, 1e-8, 0.0, 100000, past_half, &seen) == SOLVER_OK);
    CHECK(seen == told.steps && told.reached > 0.5 && told.reached < 1.4);
}

int main(void) {
    fixed_steps_are_of_order_five();
    fixed_steps_are_just_those_asked_for();
    the_error_follows_the_tolerance();
    a_stiff_system_takes_few_steps();
    rows_are_exchanged_where_the_pivot_asks_for_it();
    the_pivot_is_the_largest_in_nominals();
    a_failure_says_how_far_it_came();
    an_observer_sees_each_step_and_can_end_it();
    return verdict();
}

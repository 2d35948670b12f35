/* Co-Simulation of the example spring against its closed form. FIXED: the library makes one internal
   step of fixed length in each communication step. */
#include "check.h"
#include "face.h"
#include "spring.h"
#include "spring_motion.h"

/* Largest error of the position over a second, in communication steps of length h. */
static double error_of(double h, double tolerance, double force) {
    Spring spring = EXAMPLE;
    spring.F = force;
    void *c = started(1, SPRING_TOKEN, tolerance);
    double largest = 0.0, x, v;
    CHECK(put(c, FORCE, force) == DONE);
    for (int i = 0; i < (int)lround(1.0 / h); i++) {
        CHECK(step(c, i * h, h) == DONE);
        spring_motion(spring, (i + 1) * h, &x, &v);
        largest = fmax(largest, fabs(value(c, X) - x));
        NEAR(value(c, TENSION), 100.0 * value(c, X), 1e-12);
        NEAR(value(c, POWER), force * value(c, V), 1e-12);
    }
    FREE(c);
    return largest;
}

#ifdef FIXED
/* The method is of order five; for a linear plant its stability function is met to order six. */
static void fixed_steps_are_of_order_five(void) {
    for (double h = 0.1; h > 0.02; h /= 2.0) {
        const double order = log2(error_of(h, 0.0, 3.0) / error_of(h / 2.0, 0.0, 3.0));
        CHECK(order > 4.8);
        CHECK(order < 6.2);
    }
}
#else
static void the_error_is_below_the_tolerance_whatever_the_step(void) {
    static const double STEPS[] = {1.0, 0.25, 0.1, 0.01, 0.001};
    for (int i = 0; i < 5; i++) CHECK(error_of(STEPS[i], 0.0, 3.0) < 1e-6 * 0.1);
}

static void a_tighter_tolerance_is_taken_over_and_a_looser_one_is_not(void) {
    const double own = error_of(0.25, 0.0, 3.0);
    CHECK(error_of(0.25, 1e-9, 3.0) < 0.01 * own);
    NEAR(error_of(0.25, 1e-2, 3.0), own, 0.0);
}

static void a_tunable_parameter_acts_from_the_next_step_on(void) {
    void *c = started(1, SPRING_TOKEN, 1e-9);
    CHECK(step(c, 0.0, 0.5) == DONE && put(c, STIFFNESS, 250.0) == DONE);
    NEAR(value(c, TENSION), 250.0 * value(c, X), 1e-12);
    CHECK(put(c, DAMPING, 30.0) == DONE);
    for (int i = 0; i < 40; i++) CHECK(step(c, 0.5 + 0.25 * i, 0.25) == DONE);
    NEAR(value(c, X), 10.0 / 250.0, 1e-9); /* at rest: weight over stiffness */
    NEAR(value(c, V), 0.0, 1e-9);
    FREE(c);
}

#ifdef fmi2Functions_h
static void an_input_runs_along_its_slope_for_one_step(void) {
    Spring spring = EXAMPLE;
    spring.F = 2.0, spring.r = -8.0;
    const unsigned force = FORCE;
    const int order = 1;
    double x, v;
    void *c = started(1, SPRING_TOKEN, 1e-9);
    for (int i = 0; i < 10; i++) { /* the importer goes on from where the line ended */
        CHECK(put(c, FORCE, 2.0 - 8.0 * 0.1 * i) == DONE);
        CHECK(fmi2SetRealInputDerivatives(c, &force, 1, &order, &spring.r) == fmi2OK);
        CHECK(step(c, 0.1 * i, 0.1) == DONE);
        NEAR(value(c, FORCE), 2.0 - 8.0 * 0.1 * (i + 1), 1e-12);
    }
    spring_motion(spring, 1.0, &x, &v);
    NEAR(value(c, X), x, 1e-9);
    NEAR(value(c, V), v, 1e-8);
    const double last = value(c, FORCE);
    CHECK(step(c, 1.0, 0.1) == DONE);
    NEAR(value(c, FORCE), last, 0.0); /* a slope counts for one step */
    const int second = 2;
    CHECK(fmi2SetRealInputDerivatives(c, &force, 1, &second, &spring.r) == fmi2Error);
    FREE(c);
}
#else
static double wanted_end;
static int looks;

static void between(fmi3InstanceEnvironment instance, double time, bool set, bool get_allowed,
                    bool done, bool early, bool *requested, double *wish) {
    (void)set;
    double x, v;
    CHECK(get_allowed && done && early);
    spring_motion(EXAMPLE, time, &x, &v);
    NEAR(value(*(void **)instance, X), x, 1e-7); /* what the importer sees belongs to that time */
    NEAR(value(*(void **)instance, TIME), time, 0.0);
    *requested = true, *wish = wanted_end;
    looks++;
}

static void an_intermediate_update_can_end_a_step_early(void) {
    void *c;
    bool event, terminate, early;
    double reached, x, v;
    c = fmi3InstantiateCoSimulation("test", SPRING_TOKEN, NULL, 0, 0, 0, 1, NULL, 0, &c, listen,
                                    between);
    wanted_end = 0.7;
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE && START(c) == fmi3OK);
    CHECK(fmi3DoStep(c, 0.0, 1.0, 1, &event, &terminate, &early, &reached) == fmi3OK);
    CHECK(looks > 2 && early && !event && !terminate);
    NEAR(reached, 0.7, 1e-12);
    spring_motion(EXAMPLE, 0.7, &x, &v);
    NEAR(value(c, X), x, 1e-7);
    wanted_end = 9.0; /* beyond the step: no wish */
    CHECK(fmi3DoStep(c, 0.7, 0.3, 1, &event, &terminate, &early, &reached) == fmi3OK);
    CHECK(!early);
    NEAR(reached, 1.0, 1e-12);
    FREE(c);
}
#endif
#endif

int main(void) {
#ifdef FIXED
    fixed_steps_are_of_order_five();
#else
    the_error_is_below_the_tolerance_whatever_the_step();
    a_tighter_tolerance_is_taken_over_and_a_looser_one_is_not();
    a_tunable_parameter_acts_from_the_next_step_on();
#ifdef fmi2Functions_h
    an_input_runs_along_its_slope_for_one_step();
#else
    an_intermediate_update_can_end_a_step_early();
#endif
#endif
    return verdict();
}

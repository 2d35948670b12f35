/* Model Exchange: an importer's own integrator (RK4) on the example spring, and its derivatives, both
   against closed forms. */
#include "check.h"
#include "face.h"
#include "spring.h"
#include "spring_motion.h"

static void slope_at(void *c, double t, const double *x, double *f) {
    CHECK(SET_TIME(c, t) == 0 && SET_STATES(c, x, 2) == 0 && GET_DERIVATIVES(c, f, 2) == 0);
}

static void rk4(void *c, double t, double h, double *x) {
    double k[4][2], y[2];
    static const double SHARE[] = {0.0, 0.5, 0.5, 1.0};
    for (int i = 0; i < 4; i++) {
        for (int n = 0; n < 2; n++) y[n] = x[n] + (i ? SHARE[i] * h * k[i - 1][n] : 0.0);
        slope_at(c, t + SHARE[i] * h, y, k[i]);
    }
    for (int n = 0; n < 2; n++) x[n] += h / 6.0 * (k[0][n] + 2.0 * (k[1][n] + k[2][n]) + k[3][n]);
    CHECK(SET_TIME(c, t + h) == 0 && SET_STATES(c, x, 2) == 0);
}

static int completed(void *c, bool *event, bool *stop) {
#ifdef fmi2Functions_h
    int e, s;
    const int status = (int)fmi2CompletedIntegratorStep(c, 1, &e, &s);
    *event = e != 0, *stop = s != 0;
    return status;
#else
    return (int)fmi3CompletedIntegratorStep(c, 1, event, stop);
#endif
}

static void an_importers_integrator_finds_the_motion(void) {
    void *c = started(0, SPRING_TOKEN, 0.0);
    double x[2], next, nominal[2], h = 1e-3, exact, v;
    bool event, stop;
    CHECK(update(c, &next) == DONE && next < 0.0); /* a smooth plant knows of no event */
    CHECK(GET_STATES(c, x, 2) == 0 && GET_NOMINALS(c, nominal, 2) == 0);
    NEAR(x[0], 0.0, 0.0);
    NEAR(nominal[0], 0.1, 0.0);
    NEAR(nominal[1], 1.0, 0.0);
    CHECK(CONTINUOUS_MODE(c) == 0);
    for (int i = 0; i < 500; i++) {
        rk4(c, i * h, h, x);
        CHECK(completed(c, &event, &stop) == DONE && !event && !stop);
    }
    spring_motion(EXAMPLE, 0.5, &exact, &v);
    NEAR(value(c, X), exact, 1e-10);
    NEAR(value(c, V), v, 1e-9);
    NEAR(value(c, TENSION), 100.0 * exact, 1e-8);
    FREE(c);
}

static void a_parameter_changes_in_event_mode_only(void) {
    void *c = started(0, SPRING_TOKEN, 0.0);
    CHECK(CONTINUOUS_MODE(c) == 0 && put(c, STIFFNESS, 50.0) == REFUSED);
    CHECK(EVENT_MODE(c) == 0 && put(c, STIFFNESS, 50.0) == DONE);
    CHECK(put(c, X, 0.1) == DONE);
    NEAR(value(c, DER_V), 10.0 - 50.0 * 0.1, 1e-14); /* computed anew */
    CHECK(put(c, FORCE, 7.0) == DONE);
    NEAR(value(c, DER_V), 12.0, 1e-14);
    FREE(c);
}

static void wrong_states_are_discarded_or_refused(void) {
    void *c = started(0, SPRING_TOKEN, 0.0);
    double x[2] = {NAN, 0.0};
    CHECK(CONTINUOUS_MODE(c) == 0);
    CHECK(SET_STATES(c, x, 2) == DISCARDED); /* an integrator may try a shorter step */
    CHECK(SET_STATES(c, x, 1) == REFUSED && GET_STATES(c, x, 3) == REFUSED);
    CHECK(SET_TIME(c, INFINITY) == REFUSED);
    CHECK(GET_DERIVATIVES(c, NULL, 2) == REFUSED);
    FREE(c);
}

/* The partial derivatives by hand at x, v, force: rows der(x), der(v), tension, power; columns x, v,
   force, mass, stiffness, damping, gravity (m = 1, k = 100, d = 2). */
static const unsigned UNKNOWNS[] = {DER_X, DER_V, TENSION, POWER};
static const unsigned KNOWNS[] = {X, V, FORCE, MASS, STIFFNESS, DAMPING, GRAVITY};

static void partials(double x, double v, double force, double rows[4][7]) {
    const double total = force - 100.0 * x - 2.0 * v;
    const double by_hand[4][7] = {{0, 1, 0, 0, 0, 0, 0},
                                  {-100, -2, 1, -total, -x, -v, 1},
                                  {100, 0, 0, 0, x, 0, 0},
                                  {0, force, v, 0, 0, 0, 0}};
    memcpy(rows, by_hand, sizeof by_hand);
}

static void derivatives_are_those_by_hand(void) {
    void *c = started(0, SPRING_TOKEN, 0.0);
    double rows[4][7], found[7];
    CHECK(CONTINUOUS_MODE(c) == 0 && SET_STATES(c, (double[]){0.3, -0.7}, 2) == 0);
    CHECK(put(c, FORCE, 4.0) == DONE);
    partials(0.3, -0.7, 4.0, rows);
    for (int j = 0; j < 7; j++) {
        const double seed = 2.5;
        CHECK(directional(c, UNKNOWNS, 4, KNOWNS + j, 1, &seed, found) == DONE);
        for (int i = 0; i < 4; i++) NEAR(found[i], 2.5 * rows[i][j], 1e-12);
    }
#ifndef fmi2Functions_h
    for (int i = 0; i < 4; i++) {
        const double seed = -0.5;
        CHECK(fmi3GetAdjointDerivative(c, UNKNOWNS + i, 1, KNOWNS, 7, &seed, 1, found, 7) == 0);
        for (int j = 0; j < 7; j++) NEAR(found[j], -0.5 * rows[i][j], 1e-12);
    }
#endif
    const double seeds[2] = {1.0, 1.0};
    const unsigned wrong[] = {TENSION, X};
    CHECK(directional(c, UNKNOWNS, 4, wrong, 1, seeds, found) == REFUSED); /* an output by one */
    CHECK(directional(c, KNOWNS + 3, 1, KNOWNS, 1, seeds, found) == REFUSED); /* a parameter by x */
    CHECK(directional(c, wrong, 2, KNOWNS, 2, seeds, found) == DONE); /* a state is an output */
    NEAR(found[1], 1.0, 0.0);
    FREE(c);
}

static void outputs_have_their_rate_of_change(void) {
    void *c = started(1, SPRING_TOKEN, 0.0);
    const unsigned outputs[] = {X, V, TENSION, POWER};
    const int first[] = {1, 1, 1, 1}, second[] = {2};
    double rates[4];
    CHECK(put(c, FORCE, 4.0) == DONE && step(c, 0.0, 0.2) == DONE);
    CHECK(output_slopes(c, outputs, 4, first, rates) == DONE);
    NEAR(rates[0], value(c, V), 1e-14);
    NEAR(rates[1], value(c, DER_V), 1e-12);
    NEAR(rates[2], 100.0 * value(c, V), 1e-12);
    NEAR(rates[3], 4.0 * value(c, DER_V), 1e-12);
    CHECK(output_slopes(c, outputs, 1, second, rates) == REFUSED);
    CHECK(output_slopes(c, KNOWNS + 2, 1, first, rates) == REFUSED); /* of an input */
    FREE(c);
}

int main(void) {
    an_importers_integrator_finds_the_motion();
    a_parameter_changes_in_event_mode_only();
    wrong_states_are_discarded_or_refused();
    derivatives_are_those_by_hand();
    outputs_have_their_rate_of_change();
    return verdict();
}

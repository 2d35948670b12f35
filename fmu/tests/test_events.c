/* A motion that is played: events known beforehand, values before and behind a jump. */
#include "check.h"
#include "face.h"
#include "motion_example.h"

/* The two outputs by hand (see motion_data.h). */
static double level(double t) { return t < 0.25 ? 1.0 : t < 0.75 ? 3.0 : -2.0; }
static double curve(double t) {
    return t < 0.25 ? t * t : t < 0.75 ? 0.0625 + (t - 0.25) / 2.0 : 0.3125;
}

static void each_jump_is_announced_as_an_event(void) {
    static const double EVENTS[] = {0.25, 0.75};
    void *c = started(0, MOTION_TOKEN, 0.0);
    double time = 0.0, next, clock;
    int seen = 0;
    while (update(c, &next) == DONE && next > 0.0 && seen < 2) {
        NEAR(next, EVENTS[seen], 1e-12);
        CHECK(CONTINUOUS_MODE(c) == 0);
        clock = next - 1e-6; /* just before: the old value */
        CHECK(SET_TIME(c, clock) == 0 && SET_STATES(c, &clock, 1) == 0);
        NEAR(value(c, LEVEL), level(clock), 0.0);
        time = clock = next;
        CHECK(SET_TIME(c, time) == 0 && SET_STATES(c, &clock, 1) == 0 && EVENT_MODE(c) == 0);
        NEAR(value(c, LEVEL), level(time), 0.0);
        NEAR(value(c, CURVE), curve(time), 1e-15);
        seen++;
    }
    CHECK(seen == 2);
    NEAR(next, 1.0, 1e-12); /* the end of the motion */
    FREE(c);
}

static void steps_pass_over_jumps(void) {
    void *c = started(1, MOTION_TOKEN, 0.0);
    for (int i = 0; i < 120; i++) {
        CHECK(step(c, 0.01 * i, 0.01) == DONE);
        const double t = 0.01 * (i + 1);
        NEAR(value(c, CLOCK), t, 1e-12);
        NEAR(value(c, LEVEL), level(t + 1e-12), 0.0); /* on a break the value behind it */
        NEAR(value(c, CURVE), curve(t), 1e-12);
    }
    FREE(c);
}

static void the_slope_of_an_output_is_that_of_its_piece(void) {
    void *c = started(0, MOTION_TOKEN, 0.0);
    const unsigned outputs[] = {LEVEL, CURVE}, clock = CLOCK;
    const double one = 1.0, times[] = {0.1, 0.5, 0.9, 2.0}, slopes[] = {0.2, 0.5, 0.0, 0.0};
    double found[2];
    CHECK(CONTINUOUS_MODE(c) == 0);
    for (int i = 0; i < 4; i++) {
        CHECK(SET_STATES(c, times + i, 1) == 0);
        CHECK(directional(c, outputs, 2, &clock, 1, &one, found) == DONE);
        NEAR(found[0], 0.0, 0.0);
        NEAR(found[1], slopes[i], 1e-15);
    }
    FREE(c);
}

int main(void) {
    each_jump_is_announced_as_an_event();
    steps_pass_over_jumps();
    the_slope_of_an_output_is_that_of_its_piece();
    return verdict();
}

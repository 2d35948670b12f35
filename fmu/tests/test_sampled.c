/* A sampled block: its samples at their times whatever the steps, saved states, clocks. */
#include "check.h"
#include "counter.h"
#include "face.h"

#include <stdlib.h>

static double samples(void *c) { return value(c, COUNT); }

static void steps_that_are_shorter_longer_or_crooked_make_every_sample_once(void) {
    static const double STEPS[] = {COUNTER_PERIOD, COUNTER_PERIOD / 7, 0.05, 0.0137, 0.3};
    for (int i = 0; i < 5; i++) {
        void *c = started(1, COUNTER_TOKEN, 0.0);
        const double h = STEPS[i];
        for (int k = 1; k <= 2000; k++) {
            CHECK(step(c, (k - 1) * h, h) == DONE);
            /* those at 0, T, 2 T, ... before k h */
            const double due = ceil(k * h / COUNTER_PERIOD - 1e-6);
            NEAR(samples(c), due, 0.0);
        }
        FREE(c);
    }
}

static void a_clock_summed_up_by_the_importer_makes_every_sample_once(void) {
    void *c = started(1, COUNTER_TOKEN, 0.0);
    double at = 0.0;
    for (long k = 1; k <= 3000000; k++) {
        CHECK(step(c, at, COUNTER_PERIOD) == DONE);
        at += COUNTER_PERIOD; /* drifts by some 1e-6 s */
        if (samples(c) != (double)k) break;
    }
    NEAR(samples(c), 3e6, 0.0);
    FREE(c);
}

static void a_sample_sees_the_inputs_of_its_step_and_holds_its_outputs(void) {
    void *c = started(1, COUNTER_TOKEN, 0.0);
    CHECK(put(c, REFERENCE, 1.0) == DONE);
    NEAR(value(c, COMMAND), 0.0, 0.0); /* nothing changes between two steps */
    CHECK(step(c, 0.0, 0.004) == DONE);
    NEAR(value(c, COMMAND), COUNTER_GAIN, 0.0);
    CHECK(put(c, REFERENCE, 5.0) == DONE && step(c, 0.004, 0.006) == DONE);
    NEAR(value(c, COMMAND), COUNTER_GAIN, 0.0); /* no sample in between */
    CHECK(step(c, 0.01, 0.001) == DONE);
    NEAR(value(c, COMMAND), 6.0 * COUNTER_GAIN, 0.0);
    CHECK(put(c, GAIN, 3.0) == DONE && put(c, OFFSET, 1.0) == REFUSED);
    CHECK(step(c, 0.011, 0.01) == DONE);
    NEAR(value(c, COMMAND), 11.0 * 3.0, 0.0);
    FREE(c);
}

static void the_first_outputs_are_those_of_the_first_sample(void) {
    void *c = create(1, COUNTER_TOKEN);
    CHECK(enter(c, 0.0, 3.0, 0.0) == DONE);
    CHECK(put(c, REFERENCE, 0.5) == DONE && put(c, OFFSET, 1.0) == DONE);
    NEAR(value(c, COMMAND), 0.5 * COUNTER_GAIN + 1.0, 0.0);
    CHECK(START(c) == 0);
    NEAR(value(c, COMMAND), 0.5 * COUNTER_GAIN + 1.0, 0.0);
    CHECK(step(c, 3.0, COUNTER_PERIOD) == DONE); /* which comes now, and not twice */
    NEAR(value(c, COMMAND), 0.5 * COUNTER_GAIN + 1.0, 0.0);
    FREE(c);
}

static void a_missing_measurement_is_the_blocks_affair_and_a_missing_reference_is_refused(void) {
    void *c = started(1, COUNTER_TOKEN, 0.0);
    CHECK(put(c, REFERENCE, NAN) == REFUSED && put(c, MEASURED, INFINITY) == REFUSED);
    CHECK(put(c, REFERENCE, 1.0) == DONE && put(c, MEASURED, NAN) == DONE);
    CHECK(step(c, 0.0, 0.05) == DONE);
    NEAR(value(c, DROPPED), 5.0, 0.0);
    NEAR(value(c, COMMAND), 0.0, 0.0);
    CHECK(put(c, MEASURED, 0.0) == DONE && step(c, 0.05, 0.01) == DONE);
    NEAR(value(c, COMMAND), COUNTER_GAIN, 0.0);
    FREE(c);
}

static void a_saved_state_holds_memory_clock_and_outputs(void) {
    void *c = started(1, COUNTER_TOKEN, 0.0), *state = NULL, *copy = NULL;
    uint8_t bytes[4096];
    size_t size = 0;
    CHECK(put(c, REFERENCE, 0.3) == DONE && step(c, 0.0, 0.137) == DONE);
    CHECK(GET_STATE(c, &state) == 0 && STATE_SIZE(c, state, &size) == 0 && size <= sizeof bytes);
    CHECK(SERIALIZE(c, state, (void *)bytes, size) == 0);
    CHECK(step(c, 0.137, 0.1) == DONE);
    const double command = value(c, COMMAND), count = samples(c);
    void *d = started(1, COUNTER_TOKEN, 0.0);
    CHECK(DESERIALIZE(d, (void *)bytes, size, &copy) == 0 && SET_STATE(d, copy) == 0);
    NEAR(samples(d), 14.0, 0.0);
    CHECK(step(d, 0.137, 0.1) == DONE);
    NEAR(value(d, COMMAND), command, 0.0);
    NEAR(samples(d), count, 0.0);
    FREE_STATE(c, &state), FREE_STATE(d, &copy);
    FREE(c), FREE(d);
}

static void there_is_no_model_exchange_and_there_are_no_derivatives(void) {
    CHECK(create(0, COUNTER_TOKEN) == NULL);
    void *c = started(1, COUNTER_TOKEN, 0.0);
    const unsigned output = COMMAND, input = REFERENCE;
    const double one = 1.0;
    double found;
    CHECK(directional(c, &output, 1, &input, 1, &one, &found) == REFUSED);
    FREE(c);
}

#ifdef fmi3Functions_h

static void a_tick_samples_at_once_and_the_step_does_not_repeat_it(void) {
    void *c = fmi3InstantiateCoSimulation("test", COUNTER_TOKEN, NULL, 0, 0, 1, 0, NULL, 0, NULL,
                                          listen, NULL);
    const unsigned clock = CLOCK;
    const bool on = true;
    bool ticks = false;
    double next, interval = 0.0;
    fmi3IntervalQualifier qualifier;
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE && START(c) == 0);
    CHECK(fmi3GetIntervalDecimal(c, &clock, 1, &interval, &qualifier) == 0);
    NEAR(interval, COUNTER_PERIOD, 0.0);
    for (int k = 0; k < 100; k++) {
        CHECK(fmi3SetClock(c, &clock, 1, &on) == 0 && fmi3GetClock(c, &clock, 1, &ticks) == 0);
        CHECK(ticks);
        for (int i = 0; i < 2; i++) { /* an algebraic loop asks twice */
            CHECK(put(c, REFERENCE, 1.0 - i) == DONE);
            NEAR(value(c, COMMAND), (1.0 - i) * COUNTER_GAIN, 0.0);
        }
        CHECK(update(c, &next) == DONE && fmi3GetClock(c, &clock, 1, &ticks) == 0 && !ticks);
        NEAR(samples(c), k + 1.0, 0.0);
        CHECK(fmi3SetClock(c, &clock, 1, &on) == REFUSED); /* the next one is not due */
        CHECK(fmi3EnterStepMode(c) == 0 && step(c, k * 0.01, 0.01) == DONE && EVENT_MODE(c) == 0);
        NEAR(samples(c), k + 1.0, 0.0);
    }
    CHECK(fmi3EnterStepMode(c) == 0); /* without a tick the step samples by itself */
    CHECK(step(c, 1.0, 0.03) == DONE);
    NEAR(samples(c), 103.0, 0.0);
    CHECK(fmi3SetClock(c, &clock, 1, &on) == REFUSED); /* not in event mode */
    FREE(c);
}

#endif

int main(void) {
    steps_that_are_shorter_longer_or_crooked_make_every_sample_once();
    a_clock_summed_up_by_the_importer_makes_every_sample_once();
    a_sample_sees_the_inputs_of_its_step_and_holds_its_outputs();
    the_first_outputs_are_those_of_the_first_sample();
    a_missing_measurement_is_the_blocks_affair_and_a_missing_reference_is_refused();
    a_saved_state_holds_memory_clock_and_outputs();
    there_is_no_model_exchange_and_there_are_no_derivatives();
#ifdef fmi3Functions_h
    a_tick_samples_at_once_and_the_step_does_not_repeat_it();
#endif
    return verdict();
}

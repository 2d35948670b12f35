/* Saved states: a rollback is exact to the last bit; foreign and damaged ones are refused. */
#include "check.h"
#include "face.h"
#include "spring.h"

enum { FIRST = X, SHOWN = POWER };

static void read_all(void *c, double *values) {
    unsigned references[SHOWN];
    for (unsigned i = 0; i < SHOWN; i++) references[i] = FIRST + i;
    CHECK(get(c, references, SHOWN, values) == DONE);
}

static void walk(void *c, double from, int steps) {
    for (int i = 0; i < steps; i++) {
        CHECK(put(c, FORCE, (double)((i * 7) % 5) - 2.0) == DONE);
        CHECK(step(c, from + 0.01 * i, 0.01) == DONE);
    }
}

static void a_rollback_is_exact(void) {
    void *c = started(1, SPRING_TOKEN, 0.0), *state = NULL;
    double first[SHOWN], second[SHOWN];
    walk(c, 0.0, 10);
    CHECK(GET_STATE(c, &state) == 0 && state != NULL);
    CHECK(put(c, DAMPING, 5.0) == DONE);
    walk(c, 0.1, 50);
    read_all(c, first);
    CHECK(SET_STATE(c, state) == 0);
    NEAR(value(c, TIME), 0.1, 1e-12);
    NEAR(value(c, DAMPING), 2.0, 0.0);
    CHECK(put(c, DAMPING, 5.0) == DONE);
    walk(c, 0.1, 50);
    read_all(c, second);
    CHECK(memcmp(first, second, sizeof first) == 0);
    CHECK(GET_STATE(c, &state) == 0); /* into the same place */
    CHECK(FREE_STATE(c, &state) == 0 && state == NULL);
    CHECK(FREE_STATE(c, &state) == 0); /* of none: nothing to do */
    FREE(c);
}

static void bytes_carry_a_state_to_another_instance(void) {
    void *c = started(1, SPRING_TOKEN, 0.0), *other = started(1, SPRING_TOKEN, 0.0);
    void *state = NULL, *copy = NULL;
    uint8_t bytes[1024];
    double first[SHOWN], second[SHOWN];
    size_t size = 0;
    walk(c, 0.0, 10);
    CHECK(GET_STATE(c, &state) == 0 && STATE_SIZE(c, state, &size) == 0);
    CHECK(size > 0 && size <= sizeof bytes);
    CHECK(SERIALIZE(c, state, (void *)bytes, size) == 0);
    CHECK(DESERIALIZE(other, (void *)bytes, size, &copy) == 0 && SET_STATE(other, copy) == 0);
    walk(c, 0.1, 30), walk(other, 0.1, 30);
    read_all(c, first), read_all(other, second);
    CHECK(memcmp(first, second, sizeof first) == 0);
    CHECK(SERIALIZE(c, state, (void *)bytes, size - 1) == REFUSED);
    CHECK(FREE_STATE(c, &state) == 0 && FREE_STATE(other, &copy) == 0);
    FREE(c), FREE(other);
}

static void damaged_bytes_are_refused_wherever_they_are_wrong(void) {
    void *c = started(1, SPRING_TOKEN, 0.0), *state = NULL, *copy = NULL;
    uint8_t bytes[1024], broken[1024];
    size_t size = 0;
    CHECK(GET_STATE(c, &state) == 0 && STATE_SIZE(c, state, &size) == 0);
    CHECK(SERIALIZE(c, state, (void *)bytes, size) == 0);
    for (size_t i = 0; i < size; i++) {
        memcpy(broken, bytes, size);
        broken[i] ^= 4;
        const long before = lines;
        if (DESERIALIZE(c, (void *)broken, size, &copy) != REFUSED || lines != before + 1)
            failures++, printf("byte %zu is not looked at\n", i);
    }
    CHECK(DESERIALIZE(c, (void *)bytes, size - 1, &copy) == REFUSED);
    CHECK(DESERIALIZE(c, NULL, size, &copy) == REFUSED && copy == NULL);
    CHECK(FREE_STATE(c, &state) == 0);
    FREE(c);
}

static void states_of_the_other_kind_are_refused(void) {
    void *c = started(1, SPRING_TOKEN, 0.0), *other = started(0, SPRING_TOKEN, 0.0), *state = NULL;
    CHECK(GET_STATE(c, &state) == 0);
    CHECK(SET_STATE(other, state) == REFUSED && strstr(last_line, "Co-Simulation") != NULL);
    CHECK(SET_STATE(c, NULL) == REFUSED && GET_STATE(c, NULL) == REFUSED);
    CHECK(FREE_STATE(c, &state) == 0);
    FREE(c), FREE(other);
}

static void a_state_saved_before_initialization_brings_that_mode_back(void) {
    void *c = create(1, SPRING_TOKEN), *state = NULL;
    CHECK(GET_STATE(c, &state) == 0);
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE && START(c) == 0 && step(c, 0.0, 0.1) == DONE);
    CHECK(SET_STATE(c, state) == 0 && step(c, 0.0, 0.1) == REFUSED);
    CHECK(put(c, MASS, 2.0) == DONE); /* fixed parameters can be set again */
    CHECK(FREE_STATE(c, &state) == 0);
    FREE(c);
}

int main(void) {
    a_rollback_is_exact();
    bytes_carry_a_state_to_another_instance();
    damaged_bytes_are_refused_wherever_they_are_wrong();
    states_of_the_other_kind_are_refused();
    a_state_saved_before_initialization_brings_that_mode_back();
    return verdict();
}

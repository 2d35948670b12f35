/* The order of calls, and calls that are refused: each with its status and a line in the log, and
   without effect. */
#include "check.h"
#include "face.h"
#include "spring.h"

/* A refused call: its status, and one line that holds the word. */
#define REFUSES(call, status, word)                                                                \
    do {                                                                                           \
        const long before_ = lines;                                                                \
        const int answer_ = (int)(call);                                                           \
        if (answer_ != (status) || lines != before_ + 1 || strstr(last_line, (word)) == NULL)      \
            failures++, printf("%s:%d: %s gives %d, \"%s\"\n", __FILE__, __LINE__, #call, answer_, \
                               last_line);                                                         \
    } while (0)

static void only_the_own_token_is_accepted(void) {
    CHECK(create(1, "{00000000-0000-0000-0000-000000000000}") == NULL);
    CHECK(lines == 1 && strstr(last_line, "token") != NULL);
    CHECK(create(0, NULL) == NULL);
    FREE(NULL);
}

static void co_simulation_goes_through_its_modes(void) {
    void *c = create(1, SPRING_TOKEN);
    const long before = lines;
    CHECK(put(c, MASS, 2.0) == DONE);
    CHECK(enter(c, 1e-8, 0.5, 1.0) == DONE);
    CHECK(put(c, X, 0.02) == DONE);
    NEAR(value(c, DER_V), 10.0 - 100.0 * 0.02 / 2.0, 1e-14);
    CHECK(START(c) == 0);
    NEAR(value(c, TIME), 0.5, 0.0);
    CHECK(step(c, 0.5, 0.25) == DONE && step(c, 0.75, 0.25) == DONE);
    NEAR(value(c, TIME), 1.0, 1e-12);
    CHECK(lines == before);
    REFUSES(step(c, 1.0, 0.25), REFUSED, "stop time");
    CHECK(TERMINATE(c) == 0);
    CHECK(value(c, X) > 0.02); /* can still be read */
    REFUSES(step(c, 1.0, 0.25), REFUSED, "terminated");
    REFUSES(TERMINATE(c), REFUSED, "terminated");
    CHECK(RESET(c) == 0);
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE);
    NEAR(value(c, X), 0.0, 0.0);
    NEAR(value(c, MASS), 1.0, 0.0);
    FREE(c);
}

static void functions_of_another_mode_are_refused(void) {
    void *c = create(1, SPRING_TOKEN);
    double x[2] = {0.0, 0.0};
    REFUSES(START(c), REFUSED, "before initialization");
    REFUSES(step(c, 0.0, 0.1), REFUSED, "before initialization");
    REFUSES(get(c, (unsigned[]){X}, 1, x), REFUSED, "before initialization");
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE);
    REFUSES(step(c, 0.0, 0.1), REFUSED, "initialization mode");
    CHECK(START(c) == 0);
    REFUSES(EVENT_MODE(c), REFUSED, "Co-Simulation");
    REFUSES(SET_TIME(c, 1.0), REFUSED, "Co-Simulation");
    REFUSES(SET_STATES(c, x, 2), REFUSED, "Co-Simulation");
    FREE(c);
    c = started(0, SPRING_TOKEN, 0.0);
    REFUSES(step(c, 0.0, 0.1), REFUSED, "Model Exchange");
    REFUSES(SET_STATES(c, x, 2), REFUSED, "event mode");
    CHECK(CONTINUOUS_MODE(c) == 0);
    REFUSES(CONTINUOUS_MODE(c), REFUSED, "continuous-time mode");
    REFUSES(GET_INDICATORS(c, x, 1), REFUSED, "no event indicators");
    CHECK(GET_INDICATORS(c, NULL, 0) == 0);
    FREE(c);
    CHECK(step(NULL, 0.0, 0.1) == REFUSED);
    CHECK(get(NULL, NULL, 0, NULL) == REFUSED);
}

static void wrong_values_are_refused_and_change_nothing(void) {
    void *c = create(1, SPRING_TOKEN);
    REFUSES(put(c, MASS, -1.0), REFUSED, "mass");
    REFUSES(put(c, STIFFNESS, NAN), REFUSED, "not finite");
    REFUSES(put(c, TENSION, 1.0), REFUSED, "tension is computed");
    REFUSES(put(c, POWER + 1, 1.0), REFUSED, "not known");
    REFUSES(put(c, TIME, 1.0), REFUSED, "time is computed");
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE && START(c) == 0);
    REFUSES(put(c, MASS, 3.0), REFUSED, "fixed after initialization");
    REFUSES(put(c, X, 0.1), REFUSED, "before the simulation");
    /* one wrong value refuses the whole call */
    const unsigned both[] = {FORCE, DAMPING};
    REFUSES(set(c, both, 2, (double[]){5.0, -1.0}), REFUSED, "damping");
    NEAR(value(c, FORCE), 0.0, 0.0);
    CHECK(set(c, both, 2, (double[]){5.0, 1.0}) == DONE);
    NEAR(value(c, FORCE), 5.0, 0.0);
    NEAR(value(c, MASS), 1.0, 0.0);
    double x[1];
    REFUSES(get(c, (unsigned[]){99}, 1, x), REFUSED, "99");
    REFUSES(get(c, NULL, 1, x), REFUSED, "missing");
    REFUSES(get(c, both, 1, NULL), REFUSED, "missing");
    FREE(c);
}

static void an_input_out_of_its_range_is_used_and_told_once(void) {
    void *c = started(1, SPRING_TOKEN, 0.0);
    const long before = lines;
    CHECK(put(c, FORCE, 150.0) == DONE && put(c, FORCE, 160.0) == DONE);
    CHECK(lines == before + 1 && strstr(last_line, "force = 150") != NULL);
    NEAR(value(c, DER_V), 170.0, 1e-12);
    FREE(c);
}

static void steps_must_follow_each_other(void) {
    void *c = started(1, SPRING_TOKEN, 0.0);
    CHECK(step(c, 0.0, 0.1) == DONE);
    REFUSES(step(c, 0.2, 0.1), REFUSED, "stands at 0.1");
    REFUSES(step(c, 0.1, 0.0), REFUSED, "must be > 0");
    REFUSES(step(c, 0.1, -0.1), REFUSED, "must be > 0");
    REFUSES(step(c, 0.1, NAN), REFUSED, "must be > 0");
    NEAR(value(c, TIME), 0.1, 0.0);
    CHECK(step(c, 0.1 + 1e-12, 0.1) == DONE); /* the sums of importers drift */
    FREE(c);
}

static void a_step_that_fails_is_discarded_and_changes_nothing(void) {
    void *c = create(1, SPRING_TOKEN);
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE && put(c, X, 1e308) == DONE && START(c) == 0);
    REFUSES(step(c, 0.0, 0.1), DISCARDED, "not finite");
    NEAR(value(c, TIME), 0.0, 0.0);
    NEAR(value(c, X), 1e308, 0.0);
    FREE(c);
}

static void the_log_can_be_switched(void) {
    void *c = started(1, SPRING_TOKEN, 0.0);
    CHECK(SET_LOGGING(c, 1, 1, (const char *[]){"logSteps"}) == 0);
    long before = lines;
    CHECK(step(c, 0.0, 0.1) == DONE && lines == before + 1);
    CHECK(strstr(last_line, "internal steps") != NULL);
    CHECK(SET_LOGGING(c, 1, 0, NULL) == 0);
    REFUSES(SET_LOGGING(c, 1, 1, (const char *[]){"logMoods"}), REFUSED, "log category 1");
    CHECK(SET_LOGGING(c, 0, 1, (const char *[]){"logAll"}) == 0);
    before = lines;
    CHECK(put(c, MASS, 1.0) == REFUSED && lines == before);
    FREE(c);
}

static void what_the_fmu_does_not_offer_is_refused(void) {
    void *c = started(1, SPRING_TOKEN, 0.0);
    const unsigned reference = FORCE;
#ifdef fmi2Functions_h
    CHECK(strcmp(fmi2GetVersion(), "2.0") == 0 && strcmp(fmi2GetTypesPlatform(), "default") == 0);
    REFUSES(fmi2GetInteger(c, &reference, 1, NULL), REFUSED, "Integer");
    REFUSES(fmi2SetString(c, &reference, 1, NULL), REFUSED, "String");
    CHECK(fmi2GetBoolean(c, NULL, 0, NULL) == fmi2OK);
    REFUSES(fmi2CancelStep(c), REFUSED, "pending");
    double reached = -1.0;
    CHECK(step(c, 0.0, 0.1) == DONE);
    CHECK(fmi2GetRealStatus(c, fmi2LastSuccessfulTime, &reached) == fmi2OK);
    NEAR(reached, 0.1, 0.0);
    REFUSES(fmi2GetStatus(c, fmi2DoStepStatus, NULL), DISCARDED, "pending");
#else
    CHECK(strcmp(fmi3GetVersion(), "3.0") == 0);
    REFUSES(fmi3GetInt32(c, &reference, 1, NULL, 1), REFUSED, "Int32");
    REFUSES(fmi3SetClock(c, &reference, 1, NULL), REFUSED, "Clock");
    CHECK(fmi3GetBoolean(c, NULL, 0, NULL, 0) == fmi3OK);
    REFUSES(fmi3EnterStepMode(c), REFUSED, "event mode");
    REFUSES(fmi3EnterConfigurationMode(c), REFUSED, "structural");
    size_t n = 7;
    CHECK(fmi3GetNumberOfContinuousStates(c, &n) == fmi3OK && n == 2);
    CHECK(fmi3GetNumberOfEventIndicators(c, &n) == fmi3OK && n == 0);
    const long before = lines;
    CHECK(fmi3InstantiateScheduledExecution("s", SPRING_TOKEN, NULL, 0, 0, NULL, listen, NULL, NULL,
                                            NULL) == NULL);
    CHECK(lines == before + 1);
#endif
    FREE(c);
}

static void a_jump_of_an_input_asks_for_a_restart_once(void) {
    void *c = started(0, SPRING_TOKEN, 0.0);
    for (int again = 0; again < 2; again++) {
        CHECK(put(c, FORCE, 5.0) == DONE); /* the second time nothing changes */
        int changed;
#ifdef fmi2Functions_h
        fmi2EventInfo info;
        CHECK(fmi2NewDiscreteStates(c, &info) == fmi2OK);
        changed = info.valuesOfContinuousStatesChanged;
#else
        bool flags[5];
        double next;
        CHECK(fmi3UpdateDiscreteStates(c, flags, flags + 1, flags + 2, flags + 3, flags + 4, &next) ==
              fmi3OK);
        changed = flags[3];
#endif
        CHECK(changed == !again);
    }
    FREE(c);
}

#ifdef fmi3Functions_h

static void in_event_mode_an_output_follows_an_input_at_once(void) {
    void *c = fmi3InstantiateCoSimulation("test", SPRING_TOKEN, NULL, 0, 0, 1, 0, NULL, 0, NULL,
                                          listen, NULL);
    double next;
    CHECK(enter(c, 0.0, 0.0, 0.0) == DONE && put(c, V, 2.0) == DONE && START(c) == 0);
    REFUSES(step(c, 0.0, 0.1), REFUSED, "event mode"); /* which a simulation begins in */
    REFUSES(put(c, X, 1.0), REFUSED, "before the simulation");
    CHECK(put(c, FORCE, 3.0) == DONE);
    NEAR(value(c, POWER), 6.0, 0.0);
    CHECK(update(c, &next) == DONE && fmi3EnterStepMode(c) == fmi3OK);
    CHECK(step(c, 0.0, 0.1) == DONE && EVENT_MODE(c) == 0 && fmi3EnterStepMode(c) == fmi3OK);
    FREE(c);
}

#endif

int main(void) {
    only_the_own_token_is_accepted();
    co_simulation_goes_through_its_modes();
    functions_of_another_mode_are_refused();
    wrong_values_are_refused_and_change_nothing();
    an_input_out_of_its_range_is_used_and_told_once();
    steps_must_follow_each_other();
    a_step_that_fails_is_discarded_and_changes_nothing();
    the_log_can_be_switched();
    what_the_fmu_does_not_offer_is_refused();
    a_jump_of_an_input_asks_for_a_restart_once();
#ifdef fmi3Functions_h
    in_event_mode_an_output_follows_an_input_at_once();
#endif
    return verdict();
}

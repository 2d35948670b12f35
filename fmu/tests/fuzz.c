/* Random calls, legal and illegal, of an FMU's functions: wrong order, wrong references, NaN, zero and
   negative steps, null pointers, foreign states; several instances interleaved. Compiled with the
   sources of an exported FMU under the address and undefined-behaviour sanitizers; ends with 0 when
   every refused call came with a log line and every accepted one without.

   fuzz CALLS SEED

   With GUIDED defined the choices are the bytes of libFuzzer, which looks for those that reach new
   code: clang -fsanitize=fuzzer,address,undefined -DGUIDED. */
#define MAX_STEPS 300 /* nonsense values may make the plant as stiff as they like */
#include "fmu.c"

#include <stdio.h>

#include "face.h"

static long calls = 0, refused = 0, silent = 0;

#ifdef GUIDED
static const uint8_t *choices;
static size_t left;

static unsigned choose(unsigned n) {
    unsigned found = 0;
    for (unsigned most = n; most > 0 && left > 0; most >>= 8, left--) found = found << 8 | *choices++;
    return found % n;
}

static bool more(void) { return left > 0; }
#else
static unsigned long long random_state;
static long wanted;

static unsigned choose(unsigned n) {
    random_state ^= random_state << 13;
    random_state ^= random_state >> 7;
    random_state ^= random_state << 17;
    return (unsigned)(random_state >> 33) % n;
}

static bool more(void) { return calls < wanted; }
#endif

static double random_number(void) {
    static const double ODD[] = {0.0, -1.0, 1e300, -1e300, 1e-300, NAN, INFINITY, -INFINITY};
    if (choose(6) == 0) return ODD[choose(8)];
    return ((double)choose(2000001) / 1e6 - 1.0) * (choose(2) ? 1.0 : 1e5);
}

/* Count a refused call, and whether it was refused without a word. */
static void judge(int answer, long lines_before, unsigned what) {
    if (answer == 0) return;
    refused++;
    if (lines == lines_before) silent++, printf("silent refusal, kind %u\n", what);
}

#ifdef fmi2Functions_h
typedef fmi2Status Answer;
#define create_any create
#else
typedef fmi3Status Answer;
static void between(fmi3InstanceEnvironment e, double t, bool set_now, bool get_now, bool done,
                    bool may, bool *wanted, double *wish) {
    (void)e, (void)set_now, (void)get_now, (void)done, (void)may;
    *wanted = choose(8) == 0;
    *wish = choose(2) ? t : random_number();
}
static void *create_any(int kind, const char *token) {
    if (kind == 0) return create(0, token);
    return fmi3InstantiateCoSimulation("fuzz", token, NULL, 0, 0, choose(2), choose(2), NULL, 0, NULL,
                                       listen, choose(2) ? between : NULL);
}
#endif

enum { SLOTS = 4, MOST = VR_END + 4 };
static void *instance[SLOTS], *state[SLOTS];
static double time_of[SLOTS];

static unsigned references[MOST];
static double values[MOST + NX];
static int orders[MOST];

static size_t some(void) {
    size_t n = choose(4) ? choose(5) : choose(MOST);
    for (size_t i = 0; i < n; i++) {
        references[i] = choose(90) == 0 ? choose(1u << 30) : choose(VR_END);
        values[i] = random_number();
        orders[i] = choose(20) == 0 ? (int)choose(5) - 1 : 1;
    }
    return n;
}

/* A legal way to where most functions are allowed. */
static void start(int k) {
    void *c = instance[k];
#ifdef fmi2Functions_h
    fmi2EnterInitializationMode(c);
    fmi2ExitInitializationMode(c);
    fmi2EnterContinuousTimeMode(c);
#else
    fmi3EnterInitializationMode(c, 0, 0.0, 0.0, 0, 0.0);
    fmi3ExitInitializationMode(c);
    fmi3EnterContinuousTimeMode(c);
#endif
    time_of[k] = 0.0;
}

static uint8_t bytes[sizeof(SavedState) + 16];

static Answer state_call(void *c, int k) {
    size_t size = 0;
    void **place = choose(20) == 0 ? NULL : &state[k];
    switch (choose(6)) {
    case 0: return F(fmi2GetFMUstate, fmi3GetFMUState)(c, place);
    case 1: return F(fmi2SetFMUstate, fmi3SetFMUState)(c, state[choose(SLOTS)]);
    case 2: return F(fmi2FreeFMUstate, fmi3FreeFMUState)(c, place);
    case 3: return F(fmi2SerializedFMUstateSize, fmi3SerializedFMUStateSize)(
                c, state[k], choose(20) == 0 ? NULL : &size);
    case 4: return F(fmi2SerializeFMUstate, fmi3SerializeFMUState)(
                c, state[k], (void *)bytes, choose(9) == 0 ? choose(64) : sizeof(SavedState));
    default:
        if (choose(4) == 0) bytes[choose(sizeof bytes)] ^= (uint8_t)(1u << choose(8));
        return F(fmi2DeSerializeFMUstate, fmi3DeserializeFMUState)(
            c, (void *)bytes, choose(9) == 0 ? choose(600) : sizeof(SavedState), place);
    }
}

static Answer mode_call(void *c, int k) {
    bool flags[5];
    double next;
#ifdef fmi3Functions_h
    const unsigned clock = choose(20) ? VR_END : choose(VR_END);
    const bool tick = choose(3) != 0;
    switch (choose(18)) {
    case 0: return fmi3EnterStepMode(c);
    case 1: return fmi3SetClock(c, &clock, 1, choose(20) ? &tick : NULL);
    case 2: return fmi3GetClock(c, &clock, choose(2), flags);
    case 3: return fmi3GetIntervalDecimal(c, &clock, 1, &next, NULL);
    default: break;
    }
#endif
    switch (choose(9)) {
#ifdef fmi2Functions_h
    case 0: return fmi2SetupExperiment(c, choose(2), random_number(), 0.0, choose(2), 1e3);
    case 1: return fmi2EnterInitializationMode(c);
    case 2: return choose(3) ? fmi2OK : fmi2NewDiscreteStates(c, NULL);
#else
    case 0: return fmi3EnterConfigurationMode(c);
    case 1: return fmi3EnterInitializationMode(c, choose(2), random_number(), 0.0, choose(2), 1e3);
    case 2: return fmi3UpdateDiscreteStates(c, flags, flags + 1, NULL, flags + 3, flags + 4, &next);
#endif
    case 3: return F(fmi2ExitInitializationMode, fmi3ExitInitializationMode)(c);
    case 4: return F(fmi2EnterEventMode, fmi3EnterEventMode)(c);
    case 5: return F(fmi2EnterContinuousTimeMode, fmi3EnterContinuousTimeMode)(c);
    case 6: return choose(4) ? 0 : F(fmi2Terminate, fmi3Terminate)(c);
    case 7: return choose(4) ? 0 : (time_of[k] = 0.0, F(fmi2Reset, fmi3Reset)(c));
    default: (void)flags, (void)next; start(k); return 0;
    }
}

static Answer value_call(void *c) {
    size_t n = some();
    const unsigned *r = choose(40) == 0 ? NULL : references;
    double *v = choose(40) == 0 ? NULL : values;
    const size_t states = choose(10) == 0 ? choose(2 * NX + 1) : NX;
    switch (choose(10)) {
#ifdef fmi2Functions_h
    case 0: return fmi2GetReal(c, r, n, v);
    case 1: return fmi2SetReal(c, r, choose(2) ? n : n % 3, v);
    case 2: return fmi2SetRealInputDerivatives(c, r, n % 2, orders, v);
    case 3: return fmi2GetRealOutputDerivatives(c, r, n % 4, orders, v);
    case 4: return fmi2GetDirectionalDerivative(c, r, n / 2, r ? r + n / 2 : r, n - n / 2, v, v);
    case 5: return fmi2GetInteger(c, r, n % 2, NULL);
#else
    case 0: return fmi3GetFloat64(c, r, n, v, choose(9) ? n : choose(MOST));
    case 1: n = choose(2) ? n : n % 3; return fmi3SetFloat64(c, r, n, v, choose(9) ? n : n + 1);
    case 2: return fmi3GetAdjointDerivative(c, r, n / 2, r ? r + n / 2 : r, n - n / 2, v, n / 2,
                                            v, n - n / 2);
    case 3: return fmi3GetOutputDerivatives(c, r, n % 4, orders, v, n % 4);
    case 4: return fmi3GetDirectionalDerivative(c, r, n / 2, r ? r + n / 2 : r, n - n / 2, v,
                                                n - n / 2, v, n / 2);
    case 5: return fmi3GetInt32(c, r, n % 2, NULL, n % 2);
#endif
    case 6: return F(fmi2SetTime, fmi3SetTime)(c, random_number());
    case 7: return F(fmi2SetContinuousStates, fmi3SetContinuousStates)(c, v, states);
    case 8: return F(fmi2GetContinuousStates, fmi3GetContinuousStates)(c, v, states);
    default: return F(fmi2GetDerivatives, fmi3GetContinuousStateDerivatives)(c, v, states);
    }
}

static void step_call(void *c, int k) {
    const long before = lines;
    double h = choose(8) == 0 ? random_number() : 1e-3 * (1.0 + choose(5));
    double at = choose(12) == 0 ? random_number() : time_of[k];
    if (h > 0.1) h = 0.1; /* a long step may take long */
#ifdef fmi2Functions_h
    judge((int)fmi2DoStep(c, at, h, 1), before, 750);
    fmi2GetRealStatus(c, fmi2LastSuccessfulTime, &time_of[k]); /* may itself be refused */
#else
    bool flags[3];
    judge((int)fmi3DoStep(c, at, h, 1, flags, flags + 1, flags + 2, &time_of[k]), before, 750);
#endif
}

static void run(void) {
    for (calls = 0; more(); calls++) {
        int k = (int)choose(SLOTS);
        if (instance[k] == NULL) {
            instance[k] = create_any((int)choose(2), choose(10) == 0 ? "wrong" : MODEL_TOKEN);
            if (instance[k] != NULL && choose(4)) start(k);
            continue;
        }
        void *c = instance[k];
        long before = lines;
        Answer answer = 0;
        unsigned what = choose(1000);
        if (what == 0) {
            F(fmi2FreeInstance, fmi3FreeInstance)(c);
            instance[k] = NULL;
            continue;
        }
        if (what < 150) answer = state_call(c, k);
        else if (what < 250) answer = mode_call(c, k);
        else if (what < 750) answer = value_call(c);
        else step_call(c, k);
        judge((int)answer, before, what);
    }
    for (int k = 0; k < SLOTS; k++) {
        void *last = create(1, MODEL_TOKEN);
        F(fmi2FreeFMUstate, fmi3FreeFMUState)(last, &state[k]);
        F(fmi2FreeInstance, fmi3FreeInstance)(last);
        F(fmi2FreeInstance, fmi3FreeInstance)(instance[k]);
        instance[k] = state[k] = NULL;
        time_of[k] = 0.0;
    }
}

#ifdef GUIDED
int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
    choices = data, left = size;
    memset(bytes, 0, sizeof bytes);
    memset(references, 0, sizeof references);
    memset(values, 0, sizeof values);
    run();
    if (silent != 0) abort();
    return 0;
}
#else
int main(int argc, char **argv) {
    wanted = argc > 1 ? atol(argv[1]) : 100000;
    random_state = argc > 2 ? strtoull(argv[2], NULL, 10) : 1;
    random_state = random_state * 2862933555777941757ull + 3037000493ull;
    run();
    printf("%ld calls, %ld refused, %ld lines, %ld silent\n", calls, refused, lines, silent);
    return silent != 0;
}
#endif

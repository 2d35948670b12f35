/* Eight threads, each with an instance of its own, do the same work as one thread alone: the results
   must be equal to the last bit, and a sanitizer must find nothing. Compiled with an FMU's sources. */
#include "fmu.c"

#include <pthread.h>
#include <stdio.h>

enum { THREADS = 8, STEPS = 400 };

#ifdef fmi2Functions_h
static void listen(fmi2ComponentEnvironment e, fmi2String n, fmi2Status s, fmi2String c,
                   fmi2String m, ...) {
    (void)e, (void)n, (void)s, (void)c, (void)m;
}
static const fmi2CallbackFunctions CALLBACKS = {listen, NULL, NULL, NULL, NULL};
#define F(name2, name3) name2
static void *create(void) {
    return fmi2Instantiate("thread", fmi2CoSimulation, MODEL_TOKEN, NULL, &CALLBACKS, 0, 0);
}
static void begin(void *c) {
    fmi2SetupExperiment(c, 0, 0.0, 0.0, 0, 0.0);
    fmi2EnterInitializationMode(c);
}
static int step(void *c, double at) { return (int)fmi2DoStep(c, at, 1e-3, 1); }
static int get(void *c, const unsigned *r, size_t n, double *v) {
    return (int)fmi2GetReal(c, r, n, v);
}
static int set(void *c, const unsigned *r, size_t n, const double *v) {
    return (int)fmi2SetReal(c, r, n, v);
}
#else
static void listen(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String m) {
    (void)e, (void)s, (void)c, (void)m;
}
#define F(name2, name3) name3
static void *create(void) {
    return fmi3InstantiateCoSimulation("thread", MODEL_TOKEN, NULL, 0, 0, 0, 0, NULL, 0, NULL,
                                       listen, NULL);
}
static void begin(void *c) { fmi3EnterInitializationMode(c, 0, 0.0, 0.0, 0, 0.0); }
static int step(void *c, double at) {
    bool flags[3];
    double reached;
    return (int)fmi3DoStep(c, at, 1e-3, 1, flags, flags + 1, flags + 2, &reached);
}
static int get(void *c, const unsigned *r, size_t n, double *v) {
    return (int)fmi3GetFloat64(c, r, n, v, n);
}
static int set(void *c, const unsigned *r, size_t n, const double *v) {
    return (int)fmi3SetFloat64(c, r, n, v, n);
}
#endif

typedef struct {
    double shown[NX + LENGTH(NY)];
    int failed;
} Work;

static void *work(void *argument) {
    Work *w = argument;
    unsigned inputs[LENGTH(NU)], shown[NX + LENGTH(NY)];
    double values[LENGTH(NU)];
    size_t n = 0;
    for (unsigned i = 0; i < NU; i++) inputs[i] = VR_U + i;
    for (unsigned i = 0; i < NX; i++) shown[n++] = VR_X + i;
    for (unsigned i = 0; i < NY; i++) shown[n++] = VR_Y + i;
    void *c = create(), *state = NULL;
    begin(c);
    w->failed |= (int)F(fmi2ExitInitializationMode, fmi3ExitInitializationMode)(c);
    for (int k = 0; k < STEPS; k++) {
        for (unsigned i = 0; i < NU; i++) values[i] = 1e5 * (2 + (k / 7 + (int)i) % 3);
        if (k == STEPS / 2) w->failed |= (int)F(fmi2GetFMUstate, fmi3GetFMUState)(c, &state);
        w->failed |= set(c, inputs, NU, values) | step(c, k * 1e-3) | get(c, shown, n, w->shown);
        if (k == STEPS / 2) { /* back, and the same step again */
            w->failed |= (int)F(fmi2SetFMUstate, fmi3SetFMUState)(c, state);
            w->failed |= set(c, inputs, NU, values) | step(c, k * 1e-3);
        }
    }
    F(fmi2FreeFMUstate, fmi3FreeFMUState)(c, &state);
    F(fmi2FreeInstance, fmi3FreeInstance)(c);
    return NULL;
}

int main(void) {
    static Work alone, together[THREADS];
    pthread_t threads[THREADS];
    int different = 0;
    work(&alone);
    for (int i = 0; i < THREADS; i++) pthread_create(&threads[i], NULL, work, &together[i]);
    for (int i = 0; i < THREADS; i++) {
        pthread_join(threads[i], NULL);
        different += memcmp(&alone, &together[i], sizeof alone) != 0;
    }
    printf("%d of %d threads differ, failed: %d\n", different, THREADS, alone.failed);
    return different != 0 || alone.failed != 0;
}

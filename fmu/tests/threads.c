/* Eight threads, each with an instance of its own, do the same work as one thread alone: the results
   must be equal to the last bit, and a sanitizer must find nothing. Compiled with an FMU's sources. */
#include "fmu.c"

#include <pthread.h>
#include <stdio.h>

#include "face.h"

enum { THREADS = 8, STEPS = 400 };

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
    void *c = started(1, MODEL_TOKEN, 0.0), *state = NULL;
    w->failed |= c == NULL;
    for (int k = 0; k < STEPS; k++) {
        /* within their range, so that no thread writes to the one log */
        for (int i = 0; i < NU; i++)
            values[i] = U_MIN[i] + (U_MAX[i] - U_MIN[i]) * (2 + (k / 7 + i) % 3) / 8.0;
        if (k == STEPS / 2) w->failed |= (int)GET_STATE(c, &state);
        w->failed |= set(c, inputs, NU, values) | step(c, k * 1e-3, 1e-3);
        w->failed |= get(c, shown, n, w->shown);
        if (k == STEPS / 2) { /* back, and the same step again */
            w->failed |= (int)SET_STATE(c, state);
            w->failed |= set(c, inputs, NU, values) | step(c, k * 1e-3, 1e-3);
        }
    }
    FREE_STATE(c, &state);
    FREE(c);
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

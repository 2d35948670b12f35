/* Loads an FMU's library, makes 2000 steps of changing inputs, prints states and outputs bit by bit.

   loader LIBRARY TOKEN FIRST_INPUT INPUTS FIRST_STATE STATES FIRST_OUTPUT OUTPUTS
   (value references). FMI is defined as 2 or 3. */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#include <windows.h>
typedef HMODULE Library;
static Library open_library(const char *path) { return LoadLibraryA(path); }
static void *symbol(Library l, const char *name) { return (void *)GetProcAddress(l, name); }
#else
#include <dlfcn.h>
typedef void *Library;
static Library open_library(const char *path) { return dlopen(path, RTLD_NOW | RTLD_LOCAL); }
static void *symbol(Library l, const char *name) { return dlsym(l, name); }
#endif

#define STEPS 2000
#define SHOW_EVERY 100
#define STEP 1e-3
#define MOST 256

static void *needed(Library library, const char *name) {
    void *address = symbol(library, name);
    if (address == NULL) {
        printf("%s is missing\n", name);
        exit(1);
    }
    return address;
}

/* ---- the calls of one version of FMI, as far as they are wanted here ---- */

#if FMI == 2
#include "fmi2FunctionTypes.h"
typedef fmi2SetRealTYPE Set;
typedef fmi2GetRealTYPE Get;

static void quiet(fmi2ComponentEnvironment e, fmi2String n, fmi2Status s, fmi2String c, fmi2String m,
                  ...) {
    (void)e, (void)n, (void)s, (void)c;
    printf("%s\n", m);
}

static void *start(Library library, const char *token) {
    static const fmi2CallbackFunctions functions = {quiet, NULL, NULL, NULL, NULL};
    fmi2InstantiateTYPE *instantiate = (fmi2InstantiateTYPE *)needed(library, "fmi2Instantiate");
    void *c = instantiate("plant", fmi2CoSimulation, token, "", &functions, 0, 0);
    if (c == NULL) return NULL;
    ((fmi2SetupExperimentTYPE *)needed(library, "fmi2SetupExperiment"))(c, 0, 0.0, 0.0, 0, 0.0);
    ((fmi2EnterInitializationModeTYPE *)needed(library, "fmi2EnterInitializationMode"))(c);
    ((fmi2ExitInitializationModeTYPE *)needed(library, "fmi2ExitInitializationMode"))(c);
    return c;
}

static int step(Library library, void *c, double time) {
    return ((fmi2DoStepTYPE *)needed(library, "fmi2DoStep"))(c, time, STEP, 1) != fmi2OK;
}

static void release(Library library, void *c) {
    ((fmi2FreeInstanceTYPE *)needed(library, "fmi2FreeInstance"))(c);
}
#else
#include "fmi3FunctionTypes.h"
typedef fmi3SetFloat64TYPE Set;
typedef fmi3GetFloat64TYPE Get;

static void *start(Library library, const char *token) {
    fmi3InstantiateCoSimulationTYPE *instantiate =
        (fmi3InstantiateCoSimulationTYPE *)needed(library, "fmi3InstantiateCoSimulation");
    void *c = instantiate("plant", token, NULL, 0, 0, 0, 0, NULL, 0, NULL, NULL, NULL);
    if (c == NULL) return NULL;
    ((fmi3EnterInitializationModeTYPE *)needed(library, "fmi3EnterInitializationMode"))(c, 0, 0.0,
                                                                                       0.0, 0, 0.0);
    ((fmi3ExitInitializationModeTYPE *)needed(library, "fmi3ExitInitializationMode"))(c);
    return c;
}

static int step(Library library, void *c, double time) {
    fmi3Boolean event, terminate, early;
    double reached;
    return ((fmi3DoStepTYPE *)needed(library, "fmi3DoStep"))(c, time, STEP, 1, &event, &terminate,
                                                           &early, &reached) != fmi3OK;
}

static void release(Library library, void *c) {
    ((fmi3FreeInstanceTYPE *)needed(library, "fmi3FreeInstance"))(c);
}
#endif

static int set(Library library, void *c, const unsigned *references, size_t n, const double *values) {
#if FMI == 2
    return ((Set *)needed(library, "fmi2SetReal"))(c, references, n, values) != fmi2OK;
#else
    return ((Set *)needed(library, "fmi3SetFloat64"))(c, references, n, values, n) != fmi3OK;
#endif
}

static int get(Library library, void *c, const unsigned *references, size_t n, double *values) {
#if FMI == 2
    return ((Get *)needed(library, "fmi2GetReal"))(c, references, n, values) != fmi2OK;
#else
    return ((Get *)needed(library, "fmi3GetFloat64"))(c, references, n, values, n) != fmi3OK;
#endif
}

/* ---- the run ---- */

/* Pressures between 1 and 5 bar out of whole numbers: the same on every machine. */
static double next_pressure(void) {
    static uint64_t random = 88172645463325252u;
    random ^= random << 13, random ^= random >> 7, random ^= random << 17;
    return 1e5 + (double)(random % 400001u);
}

static int show(Library library, void *c, const unsigned *references, size_t n, int done) {
    double values[MOST];
    if (get(library, c, references, n, values)) return 1;
    printf("%d", done);
    for (size_t i = 0; i < n; i++) {
        uint64_t bits;
        memcpy(&bits, values + i, sizeof bits);
        printf(" %08x%08x", (unsigned)(bits >> 32), (unsigned)bits);
    }
    printf("\n");
    return 0;
}

int main(int count, char **words) {
    if (count != 9) return 2;
    Library library = open_library(words[1]);
    if (library == NULL) {
        printf("%s cannot be loaded\n", words[1]);
        return 1;
    }
    unsigned inputs[MOST], shown[MOST];
    size_t n_inputs = 0, n_shown = 0;
    for (int i = 0; i < atoi(words[4]); i++) inputs[n_inputs++] = (unsigned)(atoi(words[3]) + i);
    for (int k = 5; k < 9; k += 2)
        for (int i = 0; i < atoi(words[k + 1]); i++)
            shown[n_shown++] = (unsigned)(atoi(words[k]) + i);
    void *c = start(library, words[2]);
    if (c == NULL) return 1;
    double pressures[MOST];
    for (int i = 0; i < STEPS; i++) {
        /* jumps every 20 steps for the first half, then at every step */
        if (i % 20 == 0 || i > STEPS / 2)
            for (size_t k = 0; k < n_inputs; k++) pressures[k] = next_pressure();
        if (set(library, c, inputs, n_inputs, pressures) || step(library, c, i * STEP)) return 1;
        if ((i + 1) % SHOW_EVERY == 0 && show(library, c, shown, n_shown, i + 1)) return 1;
    }
    release(library, c);
    return 0;
}

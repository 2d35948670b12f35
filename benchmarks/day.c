/* A predictive controller and its plant for as many steps of 1 ms as are asked for: the plant as an FMU
   (FMI 2.0, co-simulation), the controller as one, too, or as exported C (-DCONTROLLER_IN_C).

   Arguments: steps, period of the square wave; then the plant's library, token and references of
   states and inputs; then the controller's library, token and references (states, wanted values,
   commands; without CONTROLLER_IN_C). Printed at the end: memory [MB] and open files at a fifth of
   the way and at the end, the largest relative difference of x between the period before
   that fifth and the last, and a hash of the bits of all commands: the same for both controllers. */
#define _POSIX_C_SOURCE 200809L
#include <dirent.h>
#include <dlfcn.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#ifdef CONTROLLER_IN_C
#include "mpc.h"
#endif

#define STEP 1e-3
#define NX 3
#define NU 1
#define WANTED 2
#define LOW 0.02 /* [m] */
#define HIGH 0.03
#define LONGEST 100000

typedef void *Unit;
typedef struct {
    void *log, *allocate, *release, *finished, *environment;
} Callbacks;

static void quiet(void *e, const char *name, int status, const char *category, const char *text, ...) {
    (void)e, (void)category;
    fprintf(stderr, "%s: %d %s\n", name, status, text);
}

typedef struct {
    Unit unit;
    int (*set)(Unit, const unsigned *, size_t, const double *);
    int (*get)(Unit, const unsigned *, size_t, double *);
    int (*step)(Unit, double, double, int);
    unsigned seen[NX + WANTED], sent[NU];
} Loaded;

static void require(int good, const char *what) {
    if (good) return;
    fprintf(stderr, "%s failed\n", what);
    exit(2);
}

/* In its initialisation mode. */
static Loaded loaded(const char *library, const char *token) {
    static const Callbacks callbacks = {(void *)quiet, (void *)calloc, (void *)free, NULL, NULL};
    void *file = dlopen(library, RTLD_NOW | RTLD_LOCAL);
    require(file != NULL, library);
    Unit (*begin)(const char *, int, const char *, const char *, const Callbacks *, int, int);
    int (*setup)(Unit, int, double, double, int, double), (*enter)(Unit);
    Loaded made;
    *(void **)&begin = dlsym(file, "fmi2Instantiate");
    *(void **)&setup = dlsym(file, "fmi2SetupExperiment");
    *(void **)&enter = dlsym(file, "fmi2EnterInitializationMode");
    *(void **)&made.set = dlsym(file, "fmi2SetReal");
    *(void **)&made.get = dlsym(file, "fmi2GetReal");
    *(void **)&made.step = dlsym(file, "fmi2DoStep");
    made.unit = begin(library, 1, token, "", &callbacks, 0, 0);
    require(made.unit != NULL, "fmi2Instantiate");
    require(setup(made.unit, 0, 0.0, 0.0, 0, 0.0) == 0, "fmi2SetupExperiment");
    require(enter(made.unit) == 0, "fmi2EnterInitializationMode");
    return made;
}

static void left_initialisation(Loaded *what, const char *library) {
    int (*leave)(Unit);
    *(void **)&leave = dlsym(dlopen(library, RTLD_NOW), "fmi2ExitInitializationMode");
    require(leave(what->unit) == 0, "fmi2ExitInitializationMode");
}

static void in_use(double *memory, int *files) {
    long all, pages = 0;
    FILE *told = fopen("/proc/self/statm", "r");
    require(told && fscanf(told, "%ld %ld", &all, &pages) == 2, "/proc/self/statm");
    fclose(told);
    *memory = (double)pages * (double)sysconf(_SC_PAGESIZE) / 1e6;
    DIR *open_files = opendir("/proc/self/fd");
    for (*files = -3; readdir(open_files);) ++*files; /* not ".", "..", its own */
    closedir(open_files);
}

int main(int count, char **given) {
    (void)count;
    int next = 1;
    const long steps = atol(given[next++]), period = atol(given[next++]);
    require(period <= LONGEST && steps >= 5 * period, "steps");
    const char *library = given[next++];
    Loaded load = loaded(library, given[next++]);
    for (int i = 0; i < NX; i++) load.seen[i] = (unsigned)atol(given[next++]);
    for (int i = 0; i < NU; i++) load.sent[i] = (unsigned)atol(given[next++]);
    double rest[NX + NU];
    for (int i = 0; i < NX + NU; i++) rest[i] = atof(given[next++]);
    require(load.set(load.unit, load.seen, NX, rest) == 0, "fmi2SetReal");
    require(load.set(load.unit, load.sent, NU, rest + NX) == 0, "fmi2SetReal");
    left_initialisation(&load, library);
#ifdef CONTROLLER_IN_C
    static mpc_state state;
    mpc_parameters parameters;
    mpc_inputs inputs;
    mpc_outputs outputs;
    mpc_init(&state, &parameters, &inputs);
#else
    library = given[next++];
    Loaded control = loaded(library, given[next++]);
    for (int i = 0; i < NX + WANTED; i++) control.seen[i] = (unsigned)atol(given[next++]);
    for (int i = 0; i < NU; i++) control.sent[i] = (unsigned)atol(given[next++]);
    require(control.set(control.unit, control.seen, NX, rest) == 0, "fmi2SetReal");
    left_initialisation(&control, library);
#endif
    static double before[LONGEST], last[LONGEST];
    double memory[2] = {0, 0}, largest = 0, apart = 0;
    int files[2] = {0, 0};
    uint64_t hash = 14695981039346656037u;
    for (long k = 0; k < steps; k++) {
        double seen[NX + WANTED], sent[NU];
        require(load.get(load.unit, load.seen, NX, seen) == 0, "fmi2GetReal");
        seen[NX] = k % period < period / 2 ? LOW : HIGH;
        seen[NX + 1] = 0.0; /* v: a horizon of few samples brings no load to rest without */
        last[k % period] = seen[0];
#ifdef CONTROLLER_IN_C
        memcpy(&inputs, seen, sizeof seen); /* its first members, in this order */
        mpc_step(&state, &parameters, &inputs, &outputs);
        memcpy(sent, &outputs, sizeof sent);
#else
        require(control.set(control.unit, control.seen, NX + WANTED, seen) == 0, "fmi2SetReal");
        require(control.step(control.unit, (double)k * STEP, STEP, 1) == 0, "fmi2DoStep");
        require(control.get(control.unit, control.sent, NU, sent) == 0, "fmi2GetReal");
#endif
        require(load.set(load.unit, load.sent, NU, sent) == 0, "fmi2SetReal");
        require(load.step(load.unit, (double)k * STEP, STEP, 1) == 0, "fmi2DoStep");
        for (size_t i = 0; i < sizeof sent; i++)
            hash = (hash ^ ((unsigned char *)sent)[i]) * 1099511628211u;
        if (k == steps / 5 / period * period - 1) memcpy(before, last, sizeof last);
        if (k == steps / 5) in_use(&memory[0], &files[0]);
    }
    in_use(&memory[1], &files[1]);
    for (long i = 0; i < period; i++) {
        largest = fmax(largest, fabs(before[i]));
        apart = fmax(apart, fabs(last[i] - before[i]));
    }
    printf("%.6f %d %.6f %d %.17g %016llx\n", memory[0], files[0], memory[1], files[1],
           apart / largest, (unsigned long long)hash);
    return 0;
}

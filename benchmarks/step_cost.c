/* What a communication step costs, in units of six right-hand sides and one Jacobian (what a step of
   Rodas4, of order 4, would ask for; Rodas5P's asks for eight and one). Compiled together with the
   sources of an exported FMU (FMI 2.0). */
#include "fmu.c"

#include <stdio.h>
#include <time.h>

/* Of the processor, so that other programs enter little. */
static double seconds(void) { return (double)clock() / CLOCKS_PER_SEC; }

static long total_steps = 0, total_rejected = 0;

static void quiet(fmi2ComponentEnvironment e, fmi2String n, fmi2Status s, fmi2String c, fmi2String m,
                  ...) {
    (void)e, (void)n, (void)c;
    long steps = 0, rejected = 0;
    const char *place = strstr(m, "internal steps:");
    if (s == fmi2OK && place && sscanf(place, "internal steps: %ld, rejected: %ld", &steps, &rejected) == 2)
        total_steps += steps, total_rejected += rejected;
    else
        printf("%s\n", m);
}

/* Between these commands jump [Pa, or openings]. */
#ifndef LOWEST
#define LOWEST 1e5
#define HIGHEST 5e5
#endif

/* Commands that jump now and then, as in a planned tour. */
static void command(fmi2Component c, int i, int every) {
    static unsigned long long random = 88172645463325252ull;
    if (i % every != 0) return;
    for (unsigned k = 0; k < NU; k++) {
        random ^= random << 13, random ^= random >> 7, random ^= random << 17;
        const unsigned vr = VR_U + k;
        const double value = LOWEST + (HIGHEST - (LOWEST)) * (double)(random >> 11) / 9007199254740992.0;
        fmi2SetReal(c, &vr, 1, &value);
    }
}

static fmi2Component started(int logging) {
    const fmi2CallbackFunctions functions = {quiet, NULL, NULL, NULL, NULL};
    fmi2Component c =
        fmi2Instantiate("cost", fmi2CoSimulation, MODEL_TOKEN, NULL, &functions, 0, logging);
    if (logging) fmi2SetDebugLogging(c, fmi2True, 0, NULL);
    fmi2EnterInitializationMode(c);
    fmi2ExitInitializationMode(c);
    return c;
}

/* The quickest of many batches: other programs on the machine only ever slow one down. */
enum { BATCHES = 60, BATCH = 10000 };

static double cost_of_step(double h, int every) {
    double best = INFINITY;
    fmi2Component c = started(0);
    for (int batch = 0, i = 0; batch < BATCHES; batch++) {
        double begin = seconds();
        for (int last = i + BATCH; i < last; i++) {
            command(c, i, every);
            if (fmi2DoStep(c, i * h, h, fmi2True) != fmi2OK) return NAN;
        }
        double cost = (seconds() - begin) / BATCH;
        if (cost < best) best = cost;
    }
    fmi2FreeInstance(c);
    c = started(1);
    total_steps = total_rejected = 0;
    for (int i = 0; i < BATCH; i++) {
        command(c, i, every);
        fmi2DoStep(c, i * h, h, fmi2True);
    }
    fmi2FreeInstance(c);
    return best;
}

/* Where the compiler cannot see the values. */
static struct {
    double x[NX], u[LENGTH(NU)], p[LENGTH(NP)], xdot[NX], jacobian[NX * NX];
} at;

static double cost_of_model(int with_jacobian) {
    double *volatile place = at.x;
    double best = INFINITY;
    for (int batch = 0; batch < BATCHES; batch++) {
        double begin = seconds();
        for (int i = 0; i < BATCH; i++) {
            /* each call waits for the one before it, as the stages of a step do */
            place[0] = 1e-7 * i + 1e-30 * at.xdot[1];
            if (with_jacobian)
                model_linearize(place, at.u, at.p, at.xdot, at.jacobian);
            else
                model_rhs(place, at.u, at.p, at.xdot);
        }
        double cost = (seconds() - begin) / BATCH;
        if (cost < best) best = cost;
    }
    return best;
}

int main(void) {
    memcpy(at.x, X_START, sizeof at.x);
    memcpy(at.u, U_START, NU * sizeof at.u[0]);
    memcpy(at.p, P_START, NP * sizeof at.p[0]);
    const double rhs = cost_of_model(0), both = cost_of_model(1);
    const double unit = 5.0 * rhs + both; /* six right-hand sides and one Jacobian */
    printf("right-hand side %.1f ns, with Jacobian %.1f ns, unit %.0f ns\n", rhs * 1e9, both * 1e9,
           unit * 1e9);
    const int every[] = {1 << 30, 100, 10, 1};
    for (size_t i = 0; i < sizeof every / sizeof every[0]; i++) {
        double cost = cost_of_step(1e-3, every[i]);
        printf("inputs jump every %10d steps: a step of 1 ms costs %5.0f ns = %5.2f units; internal "
               "steps %.2f, rejected %.3f\n",
               every[i], cost * 1e9, cost / unit, (double)total_steps / BATCH,
               (double)total_rejected / BATCH);
    }
    return 0;
}

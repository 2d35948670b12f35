/* One face for both versions of FMI, so that a test is written once. FMI is defined as 2 or 3, or the
   sources of an FMU are included before this file. */
#ifndef FACE_H
#define FACE_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if !defined(fmi2Functions_h) && !defined(fmi3Functions_h)
#if FMI == 2
#include "fmi2Functions.h"
#else
#include "fmi3Functions.h"
#endif
#endif

#if defined(__GNUC__)
#define HELPER static __attribute__((unused))
#else
#define HELPER static
#endif

/* The numbers are those of fmi2Status and fmi3Status. */
#define DONE 0
#define DISCARDED 2
#define REFUSED 3

/* Lines in the log so far, and the last of them. */
static long lines = 0;
static char last_line[600];

HELPER void keep_line(const char *line) {
    lines += line[0] != '\0';
    strncpy(last_line, line, sizeof last_line - 1);
}

#ifdef fmi2Functions_h

#define F(name2, name3) name2

HELPER void listen(fmi2ComponentEnvironment e, fmi2String n, fmi2Status s, fmi2String c,
                   fmi2String m, ...) {
    (void)e, (void)n, (void)s, (void)c;
    keep_line(m);
}

HELPER void *create(int simulated, const char *token) {
    static const fmi2CallbackFunctions CALLBACKS = {listen, NULL, NULL, NULL, NULL};
    return fmi2Instantiate("test", simulated ? fmi2CoSimulation : fmi2ModelExchange, token, NULL,
                           &CALLBACKS, 0, 0);
}

/* To the initialization mode; stop <= start: no stop time. */
HELPER int enter(void *c, double tolerance, double start, double stop) {
    const fmi2Status status =
        fmi2SetupExperiment(c, tolerance > 0.0, tolerance, start, stop > start, stop);
    return status != fmi2OK ? (int)status : (int)fmi2EnterInitializationMode(c);
}

HELPER int get(void *c, const unsigned *references, size_t n, double *values) {
    return (int)fmi2GetReal(c, references, n, values);
}

HELPER int set(void *c, const unsigned *references, size_t n, const double *values) {
    return (int)fmi2SetReal(c, references, n, values);
}

HELPER int step(void *c, double at, double size) { return (int)fmi2DoStep(c, at, size, 1); }

HELPER int update(void *c, double *next) {
    fmi2EventInfo info;
    const fmi2Status status = fmi2NewDiscreteStates(c, &info);
    *next = status == fmi2OK && info.nextEventTimeDefined ? info.nextEventTime : -1.0;
    return (int)status;
}

HELPER int directional(void *c, const unsigned *unknowns, size_t n_unknowns, const unsigned *knowns,
                       size_t n_knowns, const double *seed, double *sensitivity) {
    return (int)fmi2GetDirectionalDerivative(c, unknowns, n_unknowns, knowns, n_knowns, seed,
                                             sensitivity);
}

HELPER int output_slopes(void *c, const unsigned *references, size_t n, const int *orders,
                         double *values) {
    return (int)fmi2GetRealOutputDerivatives(c, references, n, orders, values);
}

#else

#define F(name2, name3) name3

HELPER void listen(fmi3InstanceEnvironment e, fmi3Status s, fmi3String c, fmi3String m) {
    (void)e, (void)s, (void)c;
    keep_line(m);
}

HELPER void *create(int simulated, const char *token) {
    if (!simulated)
        return fmi3InstantiateModelExchange("test", token, NULL, 0, 0, NULL, listen);
    return fmi3InstantiateCoSimulation("test", token, NULL, 0, 0, 0, 0, NULL, 0, NULL, listen,
                                       NULL);
}

HELPER int enter(void *c, double tolerance, double start, double stop) {
    return (int)fmi3EnterInitializationMode(c, tolerance > 0.0, tolerance, start, stop > start,
                                            stop);
}

HELPER int get(void *c, const unsigned *references, size_t n, double *values) {
    return (int)fmi3GetFloat64(c, references, n, values, n);
}

HELPER int set(void *c, const unsigned *references, size_t n, const double *values) {
    return (int)fmi3SetFloat64(c, references, n, values, n);
}

HELPER int step(void *c, double at, double size) {
    bool flags[3];
    double reached;
    return (int)fmi3DoStep(c, at, size, 1, flags, flags + 1, flags + 2, &reached);
}

HELPER int update(void *c, double *next) {
    bool flags[5] = {0};
    const fmi3Status status =
        fmi3UpdateDiscreteStates(c, flags, flags + 1, flags + 2, flags + 3, flags + 4, next);
    if (status != fmi3OK || !flags[4]) *next = -1.0;
    return (int)status;
}

HELPER int directional(void *c, const unsigned *unknowns, size_t n_unknowns, const unsigned *knowns,
                       size_t n_knowns, const double *seed, double *sensitivity) {
    return (int)fmi3GetDirectionalDerivative(c, unknowns, n_unknowns, knowns, n_knowns, seed,
                                             n_knowns, sensitivity, n_unknowns);
}

HELPER int output_slopes(void *c, const unsigned *references, size_t n, const int *orders,
                         double *values) {
    return (int)fmi3GetOutputDerivatives(c, references, n, orders, values, n);
}

#endif

#define FREE F(fmi2FreeInstance, fmi3FreeInstance)
#define START F(fmi2ExitInitializationMode, fmi3ExitInitializationMode)
#define TERMINATE F(fmi2Terminate, fmi3Terminate)
#define RESET F(fmi2Reset, fmi3Reset)
#define EVENT_MODE F(fmi2EnterEventMode, fmi3EnterEventMode)
#define CONTINUOUS_MODE F(fmi2EnterContinuousTimeMode, fmi3EnterContinuousTimeMode)
#define SET_TIME F(fmi2SetTime, fmi3SetTime)
#define SET_STATES F(fmi2SetContinuousStates, fmi3SetContinuousStates)
#define GET_STATES F(fmi2GetContinuousStates, fmi3GetContinuousStates)
#define GET_DERIVATIVES F(fmi2GetDerivatives, fmi3GetContinuousStateDerivatives)
#define GET_NOMINALS F(fmi2GetNominalsOfContinuousStates, fmi3GetNominalsOfContinuousStates)
#define GET_INDICATORS F(fmi2GetEventIndicators, fmi3GetEventIndicators)
#define GET_STATE F(fmi2GetFMUstate, fmi3GetFMUState)
#define SET_STATE F(fmi2SetFMUstate, fmi3SetFMUState)
#define FREE_STATE F(fmi2FreeFMUstate, fmi3FreeFMUState)
#define STATE_SIZE F(fmi2SerializedFMUstateSize, fmi3SerializedFMUStateSize)
#define SERIALIZE F(fmi2SerializeFMUstate, fmi3SerializeFMUState)
#define DESERIALIZE F(fmi2DeSerializeFMUstate, fmi3DeserializeFMUState)
#define SET_LOGGING F(fmi2SetDebugLogging, fmi3SetDebugLogging)

/* One value by its reference; not a number when the call is refused. */
HELPER double value(void *c, unsigned reference) {
    double found = 0.0;
    return get(c, &reference, 1, &found) == DONE ? found : (double)NAN;
}

HELPER int put(void *c, unsigned reference, double wanted) { return set(c, &reference, 1, &wanted); }

/* An instance that is ready for its first step or event. */
HELPER void *started(int simulated, const char *token, double tolerance) {
    void *c = create(simulated, token);
    if (c == NULL || enter(c, tolerance, 0.0, 0.0) != DONE || START(c) != 0) return NULL;
    return c;
}

#endif

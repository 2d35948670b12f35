/* FMI 3.0: types and callbacks; what the functions do stands in instance.c and its neighbours. */
#include "fmi3Functions.h"
#include "instance.h"

#define CALL(function, ...) ((fmi3Status)function((Instance *)instance, __func__, __VA_ARGS__))
#define CALL0(function) ((fmi3Status)function((Instance *)instance, __func__))

const char *fmi3GetVersion(void) { return fmi3Version; }

/* ---- life ---- */

static void log_fmi3(const Instance *s, Status status, const char *category, const char *message) {
    fmi3LogMessageCallback log = (fmi3LogMessageCallback)s->log_callback;
    log(s->environment, (fmi3Status)status, category, message);
}

static int update_fmi3(Instance *s, double elapsed, double *end) {
    fmi3IntermediateUpdateCallback update = (fmi3IntermediateUpdateCallback)s->step_callback;
    const double time = s->memory.time;
    fmi3Boolean requested = fmi3False;
    fmi3Float64 wish = time;
    update(s->environment, time, fmi3False, fmi3True, fmi3True, s->early_return_allowed, &requested,
           &wish);
    if (!requested || !s->early_return_allowed || !isfinite(wish)) return 0;
    wish = wish > time ? elapsed + (wish - time) : elapsed;
    if (wish >= *end) return 0;
    *end = wish;
    return 1;
}

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    return CALL(set_debug_logging, loggingOn, nCategories, categories);
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible,
                                          fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
    (void)resourcePath, (void)visible, (void)loggingOn; /* see instance_new */
    return instance_new(MODEL_EXCHANGE, instanceName, instantiationToken, log_fmi3,
                        (void (*)(void))logMessage, instanceEnvironment);
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate) {
    (void)resourcePath, (void)visible, (void)loggingOn; /* see instance_new */
    (void)requiredIntermediateVariables, (void)nRequiredIntermediateVariables; /* all can be read */
    Instance *s = instance_new(CO_SIMULATION, instanceName, instantiationToken, log_fmi3,
                               (void (*)(void))logMessage, instanceEnvironment);
    if (s == NULL) return NULL;
    s->early_return_allowed = earlyReturnAllowed;
    s->event_mode_used = eventModeUsed;
    s->step_callback = (void (*)(void))intermediateUpdate;
    s->after_step = intermediateUpdate != NULL ? update_fmi3 : NULL;
    return s;
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
    fmi3LockPreemptionCallback lockPreemption, fmi3UnlockPreemptionCallback unlockPreemption) {
    (void)instanceName, (void)instantiationToken, (void)resourcePath, (void)visible;
    (void)loggingOn, (void)clockUpdate, (void)lockPreemption, (void)unlockPreemption;
    if (logMessage != NULL)
        logMessage(instanceEnvironment, fmi3Error, "logStatusError",
                   "fmi3InstantiateScheduledExecution: this FMU offers Model Exchange and "
                   "Co-Simulation");
    return NULL;
}

void fmi3FreeInstance(fmi3Instance instance) { instance_free(instance); }

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                       fmi3Float64 tolerance, fmi3Float64 startTime,
                                       fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    fmi3Status status =
        CALL(setup_experiment, toleranceDefined, tolerance, startTime, stopTimeDefined, stopTime);
    return status == fmi3OK ? CALL0(enter_initialization) : status;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) { return CALL0(exit_initialization); }

fmi3Status fmi3EnterEventMode(fmi3Instance instance) { return CALL0(enter_event_mode); }

fmi3Status fmi3Terminate(fmi3Instance instance) { return CALL0(terminate); }

fmi3Status fmi3Reset(fmi3Instance instance) { return CALL0(reset); }

/* ---- values ---- */

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, fmi3Float64 values[], size_t nValues) {
    return CALL(get_values, valueReferences, nValueReferences, values, nValues);
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, const fmi3Float64 values[], size_t nValues) {
    return CALL(set_values, valueReferences, nValueReferences, values, nValues);
}

#define NOTHING_OF(type) "this FMU has no variables of type " type
#define CLOCK_AS_IT_IS "a clock of this FMU has a constant interval, given as a decimal number"

#define NO_VARIABLES(Type)                                                                         \
    fmi3Status fmi3Get##Type(fmi3Instance instance, const fmi3ValueReference valueReferences[],    \
                             size_t nValueReferences, fmi3##Type values[], size_t nValues) {       \
        (void)valueReferences, (void)values, (void)nValues;                                        \
        return CALL(refuse, nValueReferences, NOTHING_OF(#Type));                                  \
    }                                                                                              \
    fmi3Status fmi3Set##Type(fmi3Instance instance, const fmi3ValueReference valueReferences[],    \
                             size_t nValueReferences, const fmi3##Type values[],                   \
                             size_t nValues) {                                                     \
        (void)valueReferences, (void)values, (void)nValues;                                        \
        return CALL(refuse, nValueReferences, NOTHING_OF(#Type));                                  \
    }

NO_VARIABLES(Int8)
NO_VARIABLES(UInt8)
NO_VARIABLES(Int16)
NO_VARIABLES(UInt16)
NO_VARIABLES(Int32)
NO_VARIABLES(UInt32)
NO_VARIABLES(UInt64)
#ifdef MODEL_TYPES
#define TYPED_VARIABLES(Type, TYPE)                                                                \
    fmi3Status fmi3Get##Type(fmi3Instance instance, const fmi3ValueReference valueReferences[],    \
                             size_t nValueReferences, fmi3##Type values[], size_t nValues) {       \
        if (valueReferences == NULL || values == NULL || nValues != nValueReferences)              \
            return CALL(refuse, nValueReferences + nValues, WRONG_ARRAY);                          \
        fmi3Status status = fmi3OK;                                                                \
        for (size_t i = 0; i < nValues && status == fmi3OK; i++) {                                 \
            double one = 0.0;                                                                      \
            status = CALL(get_one, valueReferences[i], TYPE, &one);                                \
            values[i] = (fmi3##Type)one;                                                           \
        }                                                                                          \
        return status;                                                                             \
    }                                                                                              \
    fmi3Status fmi3Set##Type(fmi3Instance instance, const fmi3ValueReference valueReferences[],    \
                             size_t nValueReferences, const fmi3##Type values[],                   \
                             size_t nValues) {                                                     \
        if (valueReferences == NULL || values == NULL || nValues != nValueReferences)              \
            return CALL(refuse, nValueReferences + nValues, WRONG_ARRAY);                          \
        fmi3Status status = fmi3OK;                                                                \
        for (size_t i = 0; i < nValues && status == fmi3OK; i++)                                   \
            status = CALL(set_one, valueReferences[i], TYPE, (double)values[i]);                   \
        return status;                                                                             \
    }
#define WRONG_ARRAY "an array is missing or too long"

TYPED_VARIABLES(Float32, SINGLE)
TYPED_VARIABLES(Int64, ENUMERATION)
TYPED_VARIABLES(Boolean, BOOLEAN)
#else
NO_VARIABLES(Float32)
NO_VARIABLES(Int64)
NO_VARIABLES(Boolean)
#endif
NO_VARIABLES(String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, size_t valueSizes[], fmi3Binary values[],
                         size_t nValues) {
    (void)valueReferences, (void)valueSizes, (void)values, (void)nValues;
    return CALL(refuse, nValueReferences, NOTHING_OF("Binary"));
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const size_t valueSizes[],
                         const fmi3Binary values[], size_t nValues) {
    (void)valueReferences, (void)valueSizes, (void)values, (void)nValues;
    return CALL(refuse, nValueReferences, NOTHING_OF("Binary"));
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Clock values[]) {
    return CALL(get_clock, valueReferences, nValueReferences, values);
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, const fmi3Clock values[]) {
    return CALL(set_clock, valueReferences, nValueReferences, values);
}

#define NO_DEPENDENCIES "dependencies of single elements are not offered; see ModelStructure"

fmi3Status fmi3GetNumberOfVariableDependencies(fmi3Instance instance,
                                               fmi3ValueReference valueReference,
                                               size_t *nDependencies) {
    (void)valueReference, (void)nDependencies;
    return CALL(refuse, 1, NO_DEPENDENCIES);
}

fmi3Status fmi3GetVariableDependencies(fmi3Instance instance, fmi3ValueReference dependent,
                                       size_t elementIndicesOfDependent[],
                                       fmi3ValueReference independents[],
                                       size_t elementIndicesOfIndependents[],
                                       fmi3DependencyKind dependencyKinds[], size_t nDependencies) {
    (void)dependent, (void)elementIndicesOfDependent, (void)independents;
    (void)elementIndicesOfIndependents, (void)dependencyKinds, (void)nDependencies;
    return CALL(refuse, 1, NO_DEPENDENCIES);
}

fmi3Status fmi3GetDirectionalDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                        size_t nUnknowns, const fmi3ValueReference knowns[],
                                        size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                        fmi3Float64 sensitivity[], size_t nSensitivity) {
    return CALL(directional_derivative, unknowns, nUnknowns, knowns, nKnowns, seed, nSeed,
                sensitivity, nSensitivity);
}

fmi3Status fmi3GetAdjointDerivative(fmi3Instance instance, const fmi3ValueReference unknowns[],
                                    size_t nUnknowns, const fmi3ValueReference knowns[],
                                    size_t nKnowns, const fmi3Float64 seed[], size_t nSeed,
                                    fmi3Float64 sensitivity[], size_t nSensitivity) {
    return CALL(adjoint_derivative, unknowns, nUnknowns, knowns, nKnowns, seed, nSeed, sensitivity,
                nSensitivity);
}

/* ---- saved states ---- */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    return CALL(get_state, (SavedState **)FMUState);
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    return CALL(set_state, FMUState);
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    return CALL(free_state, (SavedState **)FMUState);
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    return CALL(serialized_size, FMUState, size);
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState,
                                 fmi3Byte serializedState[], size_t size) {
    return CALL(serialize, FMUState, serializedState, size);
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[],
                                   size_t size, fmi3FMUState *FMUState) {
    return CALL(deserialize, serializedState, size, (SavedState **)FMUState);
}

/* ---- configuration: there is none; clocks: that of a sampled block, with a constant interval ---- */

fmi3Status fmi3EnterConfigurationMode(fmi3Instance instance) {
    return CALL(refuse, 1, "this FMU has no structural parameters");
}

fmi3Status fmi3ExitConfigurationMode(fmi3Instance instance) {
    return CALL(refuse, 1, "this FMU has no structural parameters");
}

fmi3Status fmi3GetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                  size_t nValueReferences, fmi3Float64 intervals[],
                                  fmi3IntervalQualifier qualifiers[]) {
    fmi3Status status = CALL(get_clock_times, valueReferences, nValueReferences, 0, intervals);
    for (size_t i = 0; status == fmi3OK && qualifiers != NULL && i < nValueReferences; i++)
        qualifiers[i] = fmi3IntervalUnchanged;
    return status;
}

fmi3Status fmi3GetIntervalFraction(fmi3Instance instance,
                                   const fmi3ValueReference valueReferences[],
                                   size_t nValueReferences, fmi3UInt64 counters[],
                                   fmi3UInt64 resolutions[], fmi3IntervalQualifier qualifiers[]) {
    (void)valueReferences, (void)counters, (void)resolutions, (void)qualifiers;
    return CALL(refuse, nValueReferences, CLOCK_AS_IT_IS);
}

fmi3Status fmi3GetShiftDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, fmi3Float64 shifts[]) {
    return CALL(get_clock_times, valueReferences, nValueReferences, 1, shifts);
}

fmi3Status fmi3GetShiftFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, fmi3UInt64 counters[],
                                fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)counters, (void)resolutions;
    return CALL(refuse, nValueReferences, CLOCK_AS_IT_IS);
}

fmi3Status fmi3SetIntervalDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                  size_t nValueReferences, const fmi3Float64 intervals[]) {
    (void)valueReferences, (void)intervals;
    return CALL(refuse, nValueReferences, CLOCK_AS_IT_IS);
}

fmi3Status fmi3SetIntervalFraction(fmi3Instance instance,
                                   const fmi3ValueReference valueReferences[],
                                   size_t nValueReferences, const fmi3UInt64 counters[],
                                   const fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)counters, (void)resolutions;
    return CALL(refuse, nValueReferences, CLOCK_AS_IT_IS);
}

fmi3Status fmi3SetShiftDecimal(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                               size_t nValueReferences, const fmi3Float64 shifts[]) {
    (void)valueReferences, (void)shifts;
    return CALL(refuse, nValueReferences, CLOCK_AS_IT_IS);
}

fmi3Status fmi3SetShiftFraction(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                                size_t nValueReferences, const fmi3UInt64 counters[],
                                const fmi3UInt64 resolutions[]) {
    (void)valueReferences, (void)counters, (void)resolutions;
    return CALL(refuse, nValueReferences, CLOCK_AS_IT_IS);
}

/* Outputs are those of the present inputs anyhow. */
fmi3Status fmi3EvaluateDiscreteStates(fmi3Instance instance) {
    return CALL(check_events, EVENT);
}

fmi3Status fmi3UpdateDiscreteStates(fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
                                    fmi3Boolean *terminateSimulation,
                                    fmi3Boolean *nominalsOfContinuousStatesChanged,
                                    fmi3Boolean *valuesOfContinuousStatesChanged,
                                    fmi3Boolean *nextEventTimeDefined, fmi3Float64 *nextEventTime) {
    fmi3Boolean *answers[] = {discreteStatesNeedUpdate, terminateSimulation,
                              nominalsOfContinuousStatesChanged, valuesOfContinuousStatesChanged,
                              nextEventTimeDefined};
    for (size_t i = 0; i < sizeof answers / sizeof answers[0]; i++)
        if (answers[i] != NULL) *answers[i] = fmi3False;
    int changed;
    fmi3Status status = CALL(update_discrete_states, &changed);
    if (valuesOfContinuousStatesChanged != NULL) *valuesOfContinuousStatesChanged = changed != 0;
    if (status != fmi3OK || nextEventTime == NULL) return status;
    double next = next_event(instance);
    if (nextEventTimeDefined != NULL) *nextEventTimeDefined = isfinite(next) != 0;
    *nextEventTime = isfinite(next) ? next : 0.0;
    return status;
}

/* ---- Model Exchange ---- */

fmi3Status fmi3EnterContinuousTimeMode(fmi3Instance instance) {
    return CALL0(enter_continuous_time);
}

fmi3Status fmi3CompletedIntegratorStep(fmi3Instance instance,
                                       fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi3Boolean *enterEventMode,
                                       fmi3Boolean *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    if (enterEventMode != NULL) *enterEventMode = fmi3False;
    if (terminateSimulation != NULL) *terminateSimulation = fmi3False;
    return CALL0(completed_integrator_step);
}

fmi3Status fmi3SetTime(fmi3Instance instance, fmi3Float64 time) { return CALL(set_time, time); }

fmi3Status fmi3SetContinuousStates(fmi3Instance instance, const fmi3Float64 continuousStates[],
                                   size_t nContinuousStates) {
    return CALL(set_states, continuousStates, nContinuousStates);
}

fmi3Status fmi3GetContinuousStateDerivatives(fmi3Instance instance, fmi3Float64 derivatives[],
                                             size_t nContinuousStates) {
    return CALL(get_state_derivatives, derivatives, nContinuousStates);
}

fmi3Status fmi3GetEventIndicators(fmi3Instance instance, fmi3Float64 eventIndicators[],
                                  size_t nEventIndicators) {
    (void)eventIndicators;
    return CALL(refuse, nEventIndicators, "this FMU has no event indicators");
}

fmi3Status fmi3GetContinuousStates(fmi3Instance instance, fmi3Float64 continuousStates[],
                                   size_t nContinuousStates) {
    return CALL(get_states, continuousStates, nContinuousStates);
}

fmi3Status fmi3GetNominalsOfContinuousStates(fmi3Instance instance, fmi3Float64 nominals[],
                                             size_t nContinuousStates) {
    return CALL(get_nominals, nominals, nContinuousStates);
}

fmi3Status fmi3GetNumberOfEventIndicators(fmi3Instance instance, size_t *nEventIndicators) {
    return CALL(get_count, 0, nEventIndicators);
}

fmi3Status fmi3GetNumberOfContinuousStates(fmi3Instance instance, size_t *nContinuousStates) {
    return CALL(get_count, NX, nContinuousStates);
}

/* ---- Co-Simulation ---- */

fmi3Status fmi3EnterStepMode(fmi3Instance instance) {
    return CALL0(enter_step_mode);
}

fmi3Status fmi3GetOutputDerivatives(fmi3Instance instance,
                                    const fmi3ValueReference valueReferences[],
                                    size_t nValueReferences, const fmi3Int32 orders[],
                                    fmi3Float64 values[], size_t nValues) {
    return CALL(get_output_slopes, valueReferences, nValueReferences, orders, values, nValues);
}

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                      fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                      fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                      fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    (void)noSetFMUStatePriorToCurrentPoint;
    double reached = 0.0;
    int early = 0;
    fmi3Status status =
        CALL(do_step, currentCommunicationPoint, communicationStepSize, &reached, &early);
    if (eventHandlingNeeded != NULL) *eventHandlingNeeded = fmi3False;
    if (terminateSimulation != NULL) *terminateSimulation = fmi3False;
    if (earlyReturn != NULL) *earlyReturn = early != 0;
    if (lastSuccessfulTime != NULL) *lastSuccessfulTime = reached;
    return status;
}

/* ---- Scheduled Execution: not offered ---- */

fmi3Status fmi3ActivateModelPartition(fmi3Instance instance, fmi3ValueReference clockReference,
                                      fmi3Float64 activationTime) {
    (void)clockReference, (void)activationTime;
    return CALL(refuse, 1, "this FMU offers no Scheduled Execution");
}

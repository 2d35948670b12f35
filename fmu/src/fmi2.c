/* FMI 2.0: types and callbacks; what the functions do stands in instance.c and its neighbours. */
#include "fmi2Functions.h"
#include "instance.h"

#define CALL(function, ...) ((fmi2Status)function((Instance *)c, __func__, __VA_ARGS__))
#define CALL0(function) ((fmi2Status)function((Instance *)c, __func__))
#define NOTHING_OF(type) "this FMU has no variables of type " type

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }

const char *fmi2GetVersion(void) { return fmi2Version; }

/* ---- life ---- */

static void log_fmi2(const Instance *s, Status status, const char *category, const char *message) {
    fmi2CallbackLogger logger = (fmi2CallbackLogger)s->log_callback;
    logger(s->environment, s->name, (fmi2Status)status, category, message);
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean loggingOn) {
    (void)fmuResourceLocation, (void)visible, (void)loggingOn; /* see instance_new */
    if (functions == NULL || (fmuType != fmi2ModelExchange && fmuType != fmi2CoSimulation))
        return NULL;
    return instance_new(fmuType == fmi2CoSimulation ? CO_SIMULATION : MODEL_EXCHANGE, instanceName,
                        fmuGUID, log_fmi2, (void (*)(void))functions->logger,
                        functions->componentEnvironment);
}

void fmi2FreeInstance(fmi2Component c) { instance_free(c); }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
    return CALL(set_debug_logging, loggingOn, nCategories, categories);
}

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined,
                               fmi2Real stopTime) {
    return CALL(setup_experiment, toleranceDefined, tolerance, startTime, stopTimeDefined, stopTime);
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return CALL0(enter_initialization); }

fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return CALL0(exit_initialization); }

fmi2Status fmi2Terminate(fmi2Component c) { return CALL0(terminate); }

fmi2Status fmi2Reset(fmi2Component c) { return CALL0(reset); }

/* ---- values ---- */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       fmi2Real value[]) {
    return CALL(get_values, vr, nvr, value, nvr);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       const fmi2Real value[]) {
    return CALL(set_values, vr, nvr, value, nvr);
}

#define NO_VARIABLES(Type)                                                                         \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             fmi2##Type value[]) {                                                 \
        (void)vr, (void)value;                                                                     \
        return CALL(refuse, nvr, NOTHING_OF(#Type));                                               \
    }                                                                                              \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             const fmi2##Type value[]) {                                           \
        (void)vr, (void)value;                                                                     \
        return CALL(refuse, nvr, NOTHING_OF(#Type));                                               \
    }

#ifdef MODEL_TYPES
#define TYPED_VARIABLES(Type, TYPE)                                                                \
    fmi2Status fmi2Get##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             fmi2##Type value[]) {                                                 \
        if (vr == NULL || value == NULL) return CALL(refuse, nvr, "an array is missing");          \
        fmi2Status status = fmi2OK;                                                                \
        for (size_t i = 0; i < nvr && status == fmi2OK; i++) {                                     \
            double one = 0.0;                                                                      \
            status = CALL(get_one, vr[i], TYPE, &one);                                             \
            value[i] = (fmi2##Type)one;                                                            \
        }                                                                                          \
        return status;                                                                             \
    }                                                                                              \
    fmi2Status fmi2Set##Type(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,           \
                             const fmi2##Type value[]) {                                           \
        if (vr == NULL || value == NULL) return CALL(refuse, nvr, "an array is missing");          \
        fmi2Status status = fmi2OK;                                                                \
        for (size_t i = 0; i < nvr && status == fmi2OK; i++)                                       \
            status = CALL(set_one, vr[i], TYPE, TYPE == BOOLEAN ? value[i] != 0 : value[i]);       \
        return status;                                                                             \
    }

TYPED_VARIABLES(Integer, ENUMERATION)
TYPED_VARIABLES(Boolean, BOOLEAN)
#else
NO_VARIABLES(Integer)
NO_VARIABLES(Boolean)
#endif
NO_VARIABLES(String)

fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference vUnknown_ref[],
                                        size_t nUnknown, const fmi2ValueReference vKnown_ref[],
                                        size_t nKnown, const fmi2Real dvKnown[],
                                        fmi2Real dvUnknown[]) {
    return CALL(directional_derivative, vUnknown_ref, nUnknown, vKnown_ref, nKnown, dvKnown, nKnown,
                dvUnknown, nUnknown);
}

/* ---- saved states ---- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    return CALL(get_state, (SavedState **)FMUstate);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    return CALL(set_state, FMUstate);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    return CALL(free_state, (SavedState **)FMUstate);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    return CALL(serialized_size, FMUstate, size);
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate, fmi2Byte serializedState[],
                                 size_t size) {
    return CALL(serialize, FMUstate, (uint8_t *)serializedState, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate) {
    return CALL(deserialize, (const uint8_t *)serializedState, size, (SavedState **)FMUstate);
}

/* ---- Model Exchange ---- */

fmi2Status fmi2EnterEventMode(fmi2Component c) { return CALL0(enter_event_mode); }

fmi2Status fmi2NewDiscreteStates(fmi2Component c, fmi2EventInfo *eventInfo) {
    int changed;
    fmi2Status status = CALL(update_discrete_states, &changed);
    if (status != fmi2OK || eventInfo == NULL) return status;
    *eventInfo = (fmi2EventInfo){0};
    eventInfo->valuesOfContinuousStatesChanged = changed;
    double next = next_event(c);
    if (isfinite(next)) eventInfo->nextEventTimeDefined = fmi2True, eventInfo->nextEventTime = next;
    return status;
}

fmi2Status fmi2EnterContinuousTimeMode(fmi2Component c) { return CALL0(enter_continuous_time); }

fmi2Status fmi2CompletedIntegratorStep(fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
                                       fmi2Boolean *enterEventMode,
                                       fmi2Boolean *terminateSimulation) {
    (void)noSetFMUStatePriorToCurrentPoint;
    if (enterEventMode != NULL) *enterEventMode = fmi2False;
    if (terminateSimulation != NULL) *terminateSimulation = fmi2False;
    return CALL0(completed_integrator_step);
}

fmi2Status fmi2SetTime(fmi2Component c, fmi2Real time) { return CALL(set_time, time); }

fmi2Status fmi2SetContinuousStates(fmi2Component c, const fmi2Real x[], size_t nx) {
    return CALL(set_states, x, nx);
}

fmi2Status fmi2GetDerivatives(fmi2Component c, fmi2Real derivatives[], size_t nx) {
    return CALL(get_state_derivatives, derivatives, nx);
}

fmi2Status fmi2GetEventIndicators(fmi2Component c, fmi2Real eventIndicators[], size_t ni) {
    (void)eventIndicators;
    return CALL(refuse, ni, "this FMU has no event indicators");
}

fmi2Status fmi2GetContinuousStates(fmi2Component c, fmi2Real x[], size_t nx) {
    return CALL(get_states, x, nx);
}

fmi2Status fmi2GetNominalsOfContinuousStates(fmi2Component c, fmi2Real x_nominal[], size_t nx) {
    return CALL(get_nominals, x_nominal, nx);
}

/* ---- Co-Simulation ---- */

fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                       const fmi2Integer order[], const fmi2Real value[]) {
    return CALL(set_input_slopes, vr, nvr, order, value);
}

fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                                        const fmi2Integer order[], fmi2Real value[]) {
    return CALL(get_output_slopes, vr, nvr, order, value, nvr);
}

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
                      fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    (void)noSetFMUStatePriorToCurrentPoint;
    double reached;
    int early;
    return CALL(do_step, currentCommunicationPoint, communicationStepSize, &reached, &early);
}

fmi2Status fmi2CancelStep(fmi2Component c) {
    return CALL(refuse, 1, "a step is never pending, so there is none to cancel");
}

#define NO_STATUS "this status exists for pending steps only"

fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind s, fmi2Status *value) {
    (void)s, (void)value;
    return CALL(discard, NO_STATUS);
}

fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind s, fmi2Real *value) {
    const fmi2ValueReference time = VR_TIME;
    if (s != fmi2LastSuccessfulTime) return CALL(discard, NO_STATUS);
    return CALL(get_values, &time, 1, value, 1);
}

fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind s, fmi2Integer *value) {
    (void)s, (void)value;
    return CALL(discard, NO_STATUS);
}

fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value) {
    if (c == NULL || value == NULL || s != fmi2Terminated) return CALL(discard, NO_STATUS);
    *value = fmi2False; /* the plant never ends a simulation by itself */
    return fmi2OK;
}

fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind s, fmi2String *value) {
    (void)s, (void)value;
    return CALL(discard, NO_STATUS);
}

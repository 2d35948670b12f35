/* The life of an instance: creation, modes, log. */
#include "instance.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const struct {
    const char *name;
    unsigned mask;
} LOG_CATEGORIES[] = {
    {"logStatusError", LOG_ERROR},
    {"logStatusDiscard", LOG_DISCARD},
    {"logStatusWarning", LOG_WARNING},
    {"logSteps", LOG_STEPS},
    {"logAll", LOG_EVERYTHING},
};
#define N_LOG_CATEGORIES (sizeof LOG_CATEGORIES / sizeof LOG_CATEGORIES[0])

/* ---- log ---- */

#if defined(__GNUC__)
__attribute__((format(printf, 4, 5)))
#endif
/* Log a message for the importer and answer with the status, so that a refusal is one line. */
static Status report(const Instance *s, Status status, const char *function, const char *format,
                     ...) {
    static const unsigned MASKS[] = {LOG_STEPS, LOG_WARNING, LOG_DISCARD, LOG_ERROR};
    const unsigned mask = MASKS[status];
    if ((s->log_mask & mask) == 0 || s->log_callback == NULL) return status;
    char message[512];
    int length = snprintf(message, sizeof message, "%s: ", function);
    va_list arguments;
    va_start(arguments, format);
    vsnprintf(message + length, sizeof message - (size_t)length, format, arguments);
    va_end(arguments);
    /* importers may take the message for a format of printf */
    for (char *c = message; *c != '\0'; c++)
        if (*c == '%') *c = '/';
    for (size_t i = 0; i < N_LOG_CATEGORIES; i++)
        if (LOG_CATEGORIES[i].mask == mask) s->log(s, status, LOG_CATEGORIES[i].name, message);
    return status;
}

static Status set_debug_logging(Instance *s, const char *function, int on, size_t n,
                                const char *const categories[]) {
    if (s == NULL) return ERROR;
    /* a refused call is always in the log, unless its category is named here */
    unsigned mask = n == 0 ? (on ? LOG_EVERYTHING : LOG_STEPS | LOG_WARNING) : 0;
    for (size_t i = 0; i < n; i++) {
        size_t c = 0;
        const char *name = categories == NULL || categories[i] == NULL ? "" : categories[i];
        while (c < N_LOG_CATEGORIES && strcmp(LOG_CATEGORIES[c].name, name) != 0) c++;
        if (c == N_LOG_CATEGORIES)
            return report(s, ERROR, function, "log category %zu is not known", i + 1);
        mask |= LOG_CATEGORIES[c].mask;
    }
    if (!on)
        s->log_mask &= ~mask;
    else
        s->log_mask = mask;
    return OK;
}

/* ---- checks ---- */

static const char *mode_name(int mode) {
    switch (mode) {
    case INSTANTIATED: return "before initialization";
    case INITIALIZATION: return "initialization mode";
    case EVENT: return "event mode";
    case CONTINUOUS: return "continuous-time mode";
    case STEP: return "step mode";
    case INTERMEDIATE: return "an intermediate update";
    default: return "a terminated instance";
    }
}

static Status check_mode(const Instance *s, const char *function, int modes) {
    if (s == NULL) return ERROR;
    if ((s->memory.mode & modes) != 0) return OK;
    return report(s, ERROR, function, "not allowed in %s", mode_name(s->memory.mode));
}

/* Most functions are allowed in one kind of instance only. */
static Status check_kind(const Instance *s, const char *function, Kind kind, int modes) {
    if (s == NULL) return ERROR;
    if (s->memory.kind != (int32_t)kind)
        return report(s, ERROR, function, "not allowed in %s",
                      kind == CO_SIMULATION ? "Model Exchange" : "Co-Simulation");
    return check_mode(s, function, modes);
}

static Status check_array(const Instance *s, const char *function, const void *array, size_t n,
                          size_t expected) {
    if (n != expected)
        return report(s, ERROR, function, "%zu values are given, %zu are expected", n, expected);
    if (array == NULL && n > 0) return report(s, ERROR, function, "an array is missing");
    return OK;
}

static Status refuse(Instance *s, const char *function, size_t n, const char *reason) {
    if (s == NULL) return ERROR;
    return n == 0 ? OK : report(s, ERROR, function, "%s", reason);
}

static Status discard(Instance *s, const char *function, const char *reason) {
    if (s == NULL) return ERROR;
    return report(s, DISCARD, function, "%s", reason);
}

static void invalidate(Instance *s) { s->xdot_valid = s->y_valid = 0; }

/* ---- life ---- */

static void set_start_values(Instance *s) {
    Memory *m = &s->memory;
    int32_t kind = m->kind;
    memset(m, 0, sizeof *m);
    m->kind = kind;
    m->mode = INSTANTIATED;
    m->stop_time = INFINITY;
    m->tolerance = MODEL_TOLERANCE;
    for (int i = 0; i < NX; i++) m->x[i] = X_START[i];
    for (int i = 0; i < NU; i++) m->u[i] = U_START[i];
    for (int i = 0; i < NP; i++) m->p[i] = P_START[i];
#ifdef MODEL_SAMPLED
    for (int i = 0; i < NM; i++) m->samples.memory[i] = M_START[i];
    for (int i = 0; i < NY; i++) m->samples.held[i] = Y_START[i];
#endif
    memset(s->warned, 0, sizeof s->warned);
    s->jumped = 0;
    invalidate(s);
}

static Instance *instance_new(Kind kind, const char *name, const char *token, LogFunction *log,
                              void (*log_callback)(void), void *environment) {
    /* never the importer's own allocator: some of them cut the pointer to 32 bits */
    Instance *s = calloc(1, sizeof *s);
    if (s == NULL) return NULL;
    snprintf(s->name, sizeof s->name, "%s", name == NULL || *name == '\0' ? MODEL_NAME : name);
    /* a line for each step that went well only when logSteps or logAll is asked for */
    s->log_mask = LOG_ERROR | LOG_DISCARD | LOG_WARNING;
    s->log = log;
    s->log_callback = log_callback;
    s->environment = environment;
    s->memory.kind = (int32_t)kind;
    set_start_values(s);
    if (token == NULL || strcmp(token, MODEL_TOKEN) != 0) {
        report(s, ERROR, "instantiate", "the token (GUID) is not that of this binary, " MODEL_TOKEN
               ": modelDescription.xml and binary do not belong together");
        free(s);
        return NULL;
    }
#ifdef MODEL_SAMPLED
    if (kind == MODEL_EXCHANGE) {
        report(s, ERROR, "instantiate", "a sampled block runs in Co-Simulation only");
        free(s);
        return NULL;
    }
#endif
    return s;
}

static void instance_free(Instance *s) { free(s); }

static Status setup_experiment(Instance *s, const char *function, int has_tolerance,
                               double tolerance, double start, int has_stop, double stop) {
    if (check_mode(s, function, INSTANTIATED) != OK) return ERROR;
    if (!isfinite(start)) return report(s, ERROR, function, "the start time is not finite");
    if (has_stop && !(isfinite(stop) && stop >= start))
        return report(s, ERROR, function, "stop time %g must be finite and not before %g", stop,
                      start);
    if (has_tolerance && !(isfinite(tolerance) && tolerance > 0.0))
        return report(s, ERROR, function, "tolerance %g must be finite and > 0", tolerance);
    s->memory.time = start;
    s->memory.stop_time = has_stop ? stop : INFINITY;
    /* a looser tolerance is not taken over, a tighter one as far as rounding allows; who hands back
       the one of the description, which is meant for Model Exchange, asks for nothing special */
    s->memory.tolerance = MODEL_TOLERANCE;
    const int proposed =
        fabs(tolerance - MODEL_PROPOSED_TOLERANCE) <= 1e-9 * MODEL_PROPOSED_TOLERANCE;
    if (has_tolerance && !proposed && tolerance < MODEL_TOLERANCE)
        s->memory.tolerance = tolerance > 1e-11 ? tolerance : 1e-11;
    invalidate(s);
    return OK;
}

static Status enter_initialization(Instance *s, const char *function) {
    if (check_mode(s, function, INSTANTIATED) != OK) return ERROR;
    s->memory.mode = INITIALIZATION;
    return OK;
}

static Status exit_initialization(Instance *s, const char *function) {
    if (check_mode(s, function, INITIALIZATION) != OK) return ERROR;
    start_model(s);
    s->memory.mode = s->memory.kind == CO_SIMULATION && !s->event_mode_used ? STEP : EVENT;
    return OK;
}

/* Events: of Model Exchange, and of Co-Simulation when the importer said so at instantiation. */
static Status check_events(const Instance *s, const char *function, int modes) {
    if (s == NULL) return ERROR;
    if (s->memory.kind == CO_SIMULATION && !s->event_mode_used)
        return report(s, ERROR, function, "not allowed in Co-Simulation without event mode");
    return check_mode(s, function, modes);
}

static Status enter_event_mode(Instance *s, const char *function) {
    if (check_events(s, function, EVENT | CONTINUOUS | STEP) != OK) return ERROR;
    s->memory.mode = EVENT;
    return OK;
}

/* *changed: whether the importer's solver should start anew. No state jumps, but derivatives do where
   an input does, and some solvers restart for nothing less. */
static Status update_discrete_states(Instance *s, const char *function, int *changed) {
    *changed = 0;
    if (check_events(s, function, EVENT) != OK) return ERROR;
    *changed = s->jumped && s->memory.kind == MODEL_EXCHANGE;
    s->jumped = 0;
    return update_model(s, function);
}

static Status enter_step_mode(Instance *s, const char *function) {
    if (check_kind(s, function, CO_SIMULATION, ANY_MODE) != OK) return ERROR;
    if (check_events(s, function, EVENT) != OK) return ERROR;
    s->memory.mode = STEP;
    return OK;
}

static Status enter_continuous_time(Instance *s, const char *function) {
    if (check_kind(s, function, MODEL_EXCHANGE, EVENT) != OK) return ERROR;
    s->memory.mode = CONTINUOUS;
    return OK;
}

static Status completed_integrator_step(Instance *s, const char *function) {
    return check_kind(s, function, MODEL_EXCHANGE, CONTINUOUS);
}

static Status terminate(Instance *s, const char *function) {
    if (check_mode(s, function, EVENT | CONTINUOUS | STEP) != OK) return ERROR;
    s->memory.mode = TERMINATED;
    return OK;
}

static Status reset(Instance *s, const char *function) {
    if (check_mode(s, function, ANY_MODE) != OK) return ERROR;
    set_start_values(s);
    return OK;
}

/* ---- communication points ---- */

static Status check_step(const Instance *s, const char *function, double point, double size) {
    const Memory *m = &s->memory;
    if (!isfinite(point) || !isfinite(size) || !(size > 0.0))
        return report(s, ERROR, function, "communication point %g, step %g: the step must be > 0",
                      point, size);
    if (!(point + size > point) || !isfinite(point + size))
        return report(s, ERROR, function, "a step of %g is lost in rounding at time %.12g", size,
                      point);
    /* the importer's sum of steps drifts from ours; only a real gap is an error */
    double slack = fmin(1e-3 * size + 1e-9 * (1.0 + fabs(m->time)), 0.5 * size);
    if (fabs(point - m->time) > slack)
        return report(s, ERROR, function, "communication point %.12g, but the instance stands at %.12g",
                      point, m->time);
    if (point + size > m->stop_time + slack)
        return report(s, ERROR, function, "the step to %.12g passes the stop time %.12g",
                      point + size, m->stop_time);
    return OK;
}

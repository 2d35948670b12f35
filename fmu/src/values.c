/* Reading and setting variables, states and time. */
#include "instance.h"

static int all_finite(const double *values, size_t n) {
    for (size_t i = 0; i < n; i++)
        if (!isfinite(values[i])) return 0;
    return 1;
}

/* ---- variables ---- */

#define READABLE (INITIALIZATION | INITIALIZED | INTERMEDIATE)

static size_t count_values(const unsigned *vr, size_t n) {
    size_t total = 0;
    for (size_t i = 0; vr != NULL && i < n; i++) total += SIZE_OF(vr[i]);
    return vr == NULL ? n : total;
}

static Status get_value(Instance *s, const char *function, unsigned r, double *value) {
    const Memory *m = &s->memory;
    Status status = OK;
    if (r >= VR_Y) {
        status = evaluate_y(s, function);
        *value = s->y[r - VR_Y];
    } else if (r >= VR_P) {
        *value = m->p[r - VR_P];
    } else if (r >= VR_U) {
        *value = m->u[r - VR_U];
    } else if (r >= VR_XDOT) {
        status = evaluate_xdot(s, function);
        *value = s->xdot[r - VR_XDOT];
    } else {
        *value = r == VR_TIME ? m->time : m->x[r - VR_X];
    }
    return status;
}

static Status get_values(Instance *s, const char *function, const unsigned *vr, size_t n,
                         double *values, size_t n_values) {
    if (check_mode(s, function, READABLE) != OK) return ERROR;
    if (check_array(s, function, values, n_values, count_values(vr, n)) != OK) return ERROR;
    if (vr == NULL && n > 0) return report(s, ERROR, function, "the value references are missing");
    size_t k = 0;
    for (size_t i = 0; i < n; i++) {
        if (vr[i] >= VR_END)
            return report(s, ERROR, function, "value reference %u is not known", vr[i]);
        if (TYPE_OF(vr[i]) != NUMBER)
            return report(s, ERROR, function, "%s is of another type", NAMES[vr[i]]);
        for (unsigned e = 0; e < SIZE_OF(vr[i]); e++, k++) {
            Status status = get_value(s, function, vr[i] + e, &values[k]);
            if (status != OK) return status;
        }
    }
    return OK;
}

static Status check_parameter(const Instance *s, const char *function, unsigned r, double value) {
    const int i = (int)(r - VR_P), mode = s->memory.mode;
    if (mode != INSTANTIATED && mode != INITIALIZATION) {
        if (!P_TUNABLE[i])
            return report(s, ERROR, function, "parameter %s is fixed after initialization",
                          NAMES[r]);
        if (mode == CONTINUOUS)
            return report(s, ERROR, function, "parameter %s can change in event mode only",
                          NAMES[r]);
    }
    if (value < BOUND(P_MIN[i]) || value > BOUND(P_MAX[i]))
        return report(s, ERROR, function, "%s = %g is outside %g .. %g", NAMES[r], value, P_MIN[i],
                      P_MAX[i]);
    return OK;
}

static Status check_settable(const Instance *s, const char *function, unsigned r, double value) {
    if (r >= VR_END) return report(s, ERROR, function, "value reference %u is not known", r);
    const int missing = isnan(value) && r >= VR_U && r < VR_P && MAY_BE_MISSING(r - VR_U);
    if (!isfinite(value) && !missing)
        return report(s, ERROR, function, "%s = %g is not finite", NAMES[r], value);
    if (r >= VR_P && r < VR_Y) return check_parameter(s, function, r, value);
    if (r >= VR_U && r < VR_P) return OK;
    const int begins = r >= VR_Y && BEGINS(r - VR_Y);
    if (r < VR_X || (r >= VR_XDOT && !begins))
        return report(s, ERROR, function, "%s is computed and cannot be set", NAMES[r]);
    /* in Model Exchange some importers set states this way instead of all at once */
    const int exchanged = s->memory.kind == MODEL_EXCHANGE ? EVENT | CONTINUOUS : 0;
    if ((s->memory.mode & (INSTANTIATED | INITIALIZATION | exchanged)) == 0)
        return report(s, ERROR, function, "the start value of %s can be set before the simulation only",
                      NAMES[r]);
    return OK;
}

static double *settable(Memory *m, unsigned r) {
#ifdef MODEL_SAMPLED
    if (r >= VR_Y) return m->samples.held + (r - VR_Y);
#endif
    return r >= VR_P ? m->p + (r - VR_P) : r >= VR_U ? m->u + (r - VR_U) : m->x + (r - VR_X);
}

static Status set_values(Instance *s, const char *function, const unsigned *vr, size_t n,
                         const double *values, size_t n_values) {
    if (check_mode(s, function, INSTANTIATED | INITIALIZATION | EVENT | CONTINUOUS | STEP) != OK)
        return ERROR;
    if (check_array(s, function, values, n_values, count_values(vr, n)) != OK) return ERROR;
    if (vr == NULL && n > 0) return report(s, ERROR, function, "the value references are missing");
    size_t k = 0;
    for (size_t i = 0; i < n; i++)
        if (TYPE_OF(vr[i]) != NUMBER)
            return report(s, ERROR, function, "%s is of another type", NAMES[vr[i]]);
    for (size_t i = 0; i < n; i++)
        for (unsigned e = 0; e < SIZE_OF(vr[i]); e++, k++)
            if (check_settable(s, function, vr[i] + e, values[k]) != OK) return ERROR;
    Memory *m = &s->memory;
    k = 0;
    for (size_t i = 0; i < n; i++)
        for (unsigned e = 0; e < SIZE_OF(vr[i]); e++, k++) {
            double *target = settable(m, vr[i] + e);
            s->jumped |= s->memory.mode == EVENT && *target != values[k];
            *target = values[k];
        }
    invalidate(s);
    warn_of_inputs(s, function);
    return OK;
}

#ifdef MODEL_TYPES
#define SETTABLE (INSTANTIATED | INITIALIZATION | EVENT | STEP)

static Status check_type(Instance *s, const char *function, int modes, unsigned r, int type) {
    if (check_mode(s, function, modes) != OK) return ERROR;
    if (TYPE_OF(r) == type) return OK;
    return report(s, ERROR, function, "value reference %u is not of this type", r);
}

static Status get_one(Instance *s, const char *function, unsigned r, int type, double *value) {
    if (check_type(s, function, READABLE, r, type) != OK) return ERROR;
    Status status = get_value(s, function, r, value);
    if (type == BOOLEAN) *value = *value != 0.0;
    return status;
}

static Status set_one(Instance *s, const char *function, unsigned r, int type, double value) {
    if (check_type(s, function, SETTABLE, r, type) != OK) return ERROR;
    if (check_settable(s, function, r, value) != OK) return ERROR;
    *settable(&s->memory, r) = value;
    invalidate(s);
    warn_of_inputs(s, function);
    return OK;
}
#endif

/* A plan or a change of units may pass a bound by rounding, which is not worth a word. */
static int is_outside(double value, double low, double high) {
    const double a = isfinite(low) ? fabs(low) : 0.0, b = isfinite(high) ? fabs(high) : 0.0;
    const double slack = 1e-6 * (a > b ? a : b);
    return value < low - slack || value > high + slack;
}

static void warn_of_inputs(Instance *s, const char *function) {
    if ((s->log_mask & LOG_WARNING) == 0) return;
    for (int i = 0; i < NU; i++) {
        const double value = s->memory.u[i];
        if (s->warned[i] || !is_outside(value, U_MIN[i], U_MAX[i])) continue;
        s->warned[i] = 1;
        report(s, WARNING, function, "%s = %g is outside %g .. %g; it is used as it is",
               NAMES[VR_U + i], value, U_MIN[i], U_MAX[i]);
    }
}

/* ---- Model Exchange ---- */

static Status set_time(Instance *s, const char *function, double time) {
    if (check_kind(s, function, MODEL_EXCHANGE, EVENT | CONTINUOUS) != OK) return ERROR;
    if (!isfinite(time)) return report(s, ERROR, function, "the time is not finite");
    s->memory.time = time;
    invalidate(s);
    return OK;
}

static Status set_states(Instance *s, const char *function, const double *x, size_t n) {
    if (check_kind(s, function, MODEL_EXCHANGE, CONTINUOUS) != OK) return ERROR;
    if (check_array(s, function, x, n, NX) != OK) return ERROR;
    /* an integrator that went astray may try again with a shorter step */
    for (int i = 0; i < NX; i++)
        if (!isfinite(x[i]))
            return report(s, DISCARD, function, "%s = %g is not finite", NAMES[VR_X + i], x[i]);
    memcpy(s->memory.x, x, NX * sizeof *x);
    invalidate(s);
    return OK;
}

#define READABLE_ME (INITIALIZATION | EVENT | CONTINUOUS | TERMINATED)

static Status get_states(Instance *s, const char *function, double *x, size_t n) {
    if (check_kind(s, function, MODEL_EXCHANGE, READABLE_ME) != OK) return ERROR;
    if (check_array(s, function, x, n, NX) != OK) return ERROR;
    memcpy(x, s->memory.x, NX * sizeof *x);
    return OK;
}

static Status get_state_derivatives(Instance *s, const char *function, double *xdot, size_t n) {
    if (check_kind(s, function, MODEL_EXCHANGE, READABLE_ME) != OK) return ERROR;
    if (check_array(s, function, xdot, n, NX) != OK) return ERROR;
    Status status = evaluate_xdot(s, function);
    if (status == OK) memcpy(xdot, s->xdot, NX * sizeof *xdot);
    return status;
}

static Status get_nominals(Instance *s, const char *function, double *nominals, size_t n) {
    if (check_kind(s, function, MODEL_EXCHANGE, READABLE_ME) != OK) return ERROR;
    if (check_array(s, function, nominals, n, NX) != OK) return ERROR;
    memcpy(nominals, X_NOMINAL, NX * sizeof *nominals);
    return OK;
}

static Status get_count(Instance *s, const char *function, size_t value, size_t *count) {
    if (s == NULL) return ERROR;
    if (count == NULL) return report(s, ERROR, function, "the place for the answer is missing");
    *count = value;
    return OK;
}

/* ---- slopes of inputs, Co-Simulation ---- */

static Status set_input_slopes(Instance *s, const char *function, const unsigned *vr, size_t n,
                               const int *order, const double *values) {
    if (check_kind(s, function, CO_SIMULATION, INSTANTIATED | INITIALIZATION | STEP) != OK)
        return ERROR;
    if (n > 0 && (vr == NULL || order == NULL || values == NULL))
        return report(s, ERROR, function, "an array is missing");
    for (size_t i = 0; i < n; i++) {
        if (vr[i] < VR_U || vr[i] >= VR_P)
            return report(s, ERROR, function, "value reference %u is no input", vr[i]);
        if (order[i] != 1)
            return report(s, ERROR, function, "derivatives of order %d: only order 1 is used",
                          order[i]);
        if (!isfinite(values[i]))
            return report(s, ERROR, function, "the derivative of %s is not finite", NAMES[vr[i]]);
    }
    for (size_t i = 0; i < n; i++) s->memory.slope[vr[i] - VR_U] = values[i];
    return OK;
}

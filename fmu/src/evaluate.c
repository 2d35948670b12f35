/* What a plant computes when it is asked for, and its events. */
#include "instance.h"

static Status evaluate_xdot(Instance *s, const char *function) {
    const Memory *m = &s->memory;
    if (s->xdot_valid) return OK;
    model_rhs(m->x, m->u, m->p, s->xdot);
    for (int i = 0; i < NX; i++)
        if (!isfinite(s->xdot[i]))
            return report(s, DISCARD, function, "%s is not finite here", NAMES[VR_XDOT + i]);
    s->xdot_valid = 1;
    return OK;
}

static Status evaluate_y(Instance *s, const char *function) {
    const Memory *m = &s->memory;
    if (s->y_valid) return OK;
    model_outputs(m->x, m->u, m->p, s->y);
    for (int i = 0; i < NY; i++)
        if (!isfinite(s->y[i]))
            return report(s, DISCARD, function, "%s is not finite here", NAMES[VR_Y + i]);
    s->y_valid = 1;
    return OK;
}

static void start_model(Instance *s) { (void)s; }

static double next_event(const Instance *s) {
#ifdef MODEL_JUMPS
    return s->memory.time + model_time_to_jump(s->memory.x);
#else
    (void)s;
    return INFINITY;
#endif
}

/* A smooth plant has no discrete states: nothing changes at an event but inputs and parameters. */
static Status update_model(Instance *s, const char *function) {
    (void)s, (void)function;
    return OK;
}

#define NO_CLOCKS "this FMU has no variables of type Clock"

static Status get_clock(Instance *s, const char *function, const unsigned *vr, size_t n,
                        _Bool *values) {
    (void)vr, (void)values;
    return refuse(s, function, n, NO_CLOCKS);
}

static Status set_clock(Instance *s, const char *function, const unsigned *vr, size_t n,
                        const _Bool *values) {
    (void)vr, (void)values;
    return refuse(s, function, n, NO_CLOCKS);
}

static Status get_clock_times(Instance *s, const char *function, const unsigned *vr, size_t n,
                              int which, double *values) {
    (void)vr, (void)which, (void)values;
    return refuse(s, function, n, NO_CLOCKS);
}

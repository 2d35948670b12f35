/* Partial derivatives, and derivatives of inputs and outputs with respect to time. */
#include "instance.h"

/* What the derivative functions of the model take and give, in one place. */
typedef struct {
    double x[NX], u[LENGTH(NU)], p[LENGTH(NP)];
    double xdot[NX], y[LENGTH(NY)];
} Tangent;

/* Where a known stands in a tangent; NULL for time, of which a plant does not depend. */
static Status known_of(const Instance *s, const char *function, unsigned r, Tangent *t,
                       double **place) {
    *place = NULL;
    if (r == VR_TIME) return OK;
    if (r >= VR_X && r < VR_XDOT) *place = t->x + (r - VR_X);
    if (r >= VR_U && r < VR_P) *place = t->u + (r - VR_U);
    if (r >= VR_P && r < VR_Y) *place = t->p + (r - VR_P);
    if (*place != NULL) return OK;
    if (r >= VR_END) return report(s, ERROR, function, "value reference %u is not known", r);
    return report(s, ERROR, function, "%s is no state, input or parameter", NAMES[r]);
}

static Status unknown_of(const Instance *s, const char *function, unsigned r, Tangent *t,
                         double **place) {
    *place = NULL;
    if (r >= VR_X && r < VR_XDOT) *place = t->x + (r - VR_X);
    if (r >= VR_XDOT && r < VR_U) *place = t->xdot + (r - VR_XDOT);
    if (r >= VR_Y && r < VR_END) *place = t->y + (r - VR_Y);
    if (*place != NULL) return OK;
    if (r >= VR_END) return report(s, ERROR, function, "value reference %u is not known", r);
    return report(s, ERROR, function, "%s is no output and no derivative", NAMES[r]);
}

static Status check_derivative(const Instance *s, const char *function, const unsigned *unknowns,
                               size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
                               const double *seed, const double *sensitivity) {
    if (check_mode(s, function, INITIALIZATION | INITIALIZED | INTERMEDIATE) != OK) return ERROR;
    if ((n_unknowns > 0 && unknowns == NULL) || (n_knowns > 0 && knowns == NULL) || seed == NULL ||
        sensitivity == NULL)
        return report(s, ERROR, function, "an array is missing");
    return OK;
}

static Status directional_derivative(Instance *s, const char *function, const unsigned *unknowns,
                                     size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
                                     const double *seed, size_t n_seed, double *sensitivity,
                                     size_t n_sensitivity) {
    if (check_derivative(s, function, unknowns, n_unknowns, knowns, n_knowns, seed,
                         sensitivity) != OK ||
        check_array(s, function, seed, n_seed, n_knowns) != OK ||
        check_array(s, function, sensitivity, n_sensitivity, n_unknowns) != OK)
        return ERROR;
    const Memory *m = &s->memory;
    Tangent t = {0};
    double *place;
    for (size_t i = 0; i < n_knowns; i++) {
        if (known_of(s, function, knowns[i], &t, &place) != OK) return ERROR;
        if (place != NULL) *place += seed[i];
    }
    model_forward(m->x, m->u, m->p, t.x, t.u, t.p, t.xdot, t.y);
    for (size_t i = 0; i < n_unknowns; i++) {
        if (unknown_of(s, function, unknowns[i], &t, &place) != OK) return ERROR;
        sensitivity[i] = *place;
    }
    if (!all_finite(sensitivity, n_unknowns))
        return report(s, DISCARD, function, "a derivative is not finite here");
    return OK;
}

static Status adjoint_derivative(Instance *s, const char *function, const unsigned *unknowns,
                                 size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
                                 const double *seed, size_t n_seed, double *sensitivity,
                                 size_t n_sensitivity) {
    if (check_derivative(s, function, unknowns, n_unknowns, knowns, n_knowns, seed,
                         sensitivity) != OK ||
        check_array(s, function, seed, n_seed, n_unknowns) != OK ||
        check_array(s, function, sensitivity, n_sensitivity, n_knowns) != OK)
        return ERROR;
    const Memory *m = &s->memory;
    Tangent seeds = {0}, t = {0};
    double *place;
    for (size_t i = 0; i < n_unknowns; i++) {
        if (unknown_of(s, function, unknowns[i], &seeds, &place) != OK) return ERROR;
        *place += seed[i];
    }
    model_reverse(m->x, m->u, m->p, seeds.xdot, seeds.y, t.x, t.u, t.p);
    for (int i = 0; i < NX; i++) t.x[i] += seeds.x[i]; /* states are outputs of themselves */
    for (size_t i = 0; i < n_knowns; i++) {
        if (known_of(s, function, knowns[i], &t, &place) != OK) return ERROR;
        sensitivity[i] = place == NULL ? 0.0 : *place;
    }
    if (!all_finite(sensitivity, n_knowns))
        return report(s, DISCARD, function, "a derivative is not finite here");
    return OK;
}

/* ---- derivatives of outputs with respect to time, Co-Simulation ---- */

static Status get_output_slopes(Instance *s, const char *function, const unsigned *vr, size_t n,
                                const int *order, double *values, size_t n_values) {
    if (check_kind(s, function, CO_SIMULATION, STEP | INTERMEDIATE | TERMINATED) != OK)
        return ERROR;
    if (check_array(s, function, values, n_values, n) != OK) return ERROR;
    if (n > 0 && (vr == NULL || order == NULL))
        return report(s, ERROR, function, "an array is missing");
    const Memory *m = &s->memory;
    Tangent t = {0};
    Status status = evaluate_xdot(s, function);
    if (status != OK) return status;
    model_forward(m->x, m->u, m->p, s->xdot, m->last_slope, t.p, t.xdot, t.y);
    for (size_t i = 0; i < n; i++) {
        const unsigned r = vr[i];
        const int is_state = r >= VR_X && r < VR_XDOT;
        if (!is_state && (r < VR_Y || r >= VR_END))
            return report(s, ERROR, function, "value reference %u is no output", r);
        if (order[i] != 1)
            return report(s, ERROR, function, "derivatives of order %d: only order 1 is known",
                          order[i]);
        values[i] = is_state ? s->xdot[r - VR_X] : t.y[r - VR_Y];
    }
    if (!all_finite(values, n)) return report(s, DISCARD, function, "a derivative is not finite here");
    return OK;
}

/* A sampled block: its samples in a communication step or on the ticks of a clock.

   Sample k is due k MODEL_SAMPLE_TIME behind the start. A communication step from t to t + h makes
   the samples that are due from t on and before t + h, each with the inputs at its time; the outputs
   of the last one are held. In event mode the importer may make a due sample itself, by its clock:
   then outputs follow from inputs without a delay. A sample that no clock made is made in the next
   step. */
#include "instance.h"

/* A step that ends so near to a sample, as a part of the sample time, ends at it. */
static const double NEAR = 1e-6;
#ifndef MAX_SAMPLES
#define MAX_SAMPLES 1000000
#endif

static double next_sample(const Samples *k) { return (double)k->count * MODEL_SAMPLE_TIME; }

/* Sample with these inputs: next memory to work.memory, outputs to y. */
static Status try_sample(Instance *s, const char *function, const double *u) {
    const Memory *m = &s->memory;
    block_call(&s->work, m->samples.memory, u, m->p, s->work.memory, s->y);
    for (int i = 0; i < NY; i++)
        if (!isfinite(s->y[i]))
            return report(s, DISCARD, function, "%s is not finite at time %.12g", NAMES[VR_Y + i],
                          m->time);
    return OK;
}

static void take_sample(Instance *s) {
    Samples *k = &s->memory.samples;
    memcpy(k->memory, s->work.memory, sizeof k->memory);
    memcpy(k->held, s->y, sizeof k->held);
    k->count++;
}

/* What stands at the outputs until the first sample is what it would give, or their start value. */
static void start_model(Instance *s) {
    const unsigned mask = s->log_mask;
    s->log_mask = 0;
    if (try_sample(s, "", s->memory.u) == OK)
        for (int i = 0; i < NY; i++)
            if (!Y_BEGINS[i]) s->memory.samples.held[i] = s->y[i];
    s->log_mask = mask;
    invalidate(s);
}

static Status evaluate_xdot(Instance *s, const char *function) {
    (void)s, (void)function;
    return OK;
}

/* During initialization, and while the clock ticks, outputs follow the inputs. */
static Status evaluate_y(Instance *s, const char *function) {
    const Samples *k = &s->memory.samples;
    if (s->y_valid) return OK;
    if (s->memory.mode == INITIALIZATION || k->ticking) {
        if (try_sample(s, function, s->memory.u) != OK) return DISCARD;
        for (int i = 0; i < NY; i++)
            if (!k->ticking && Y_BEGINS[i]) s->y[i] = k->held[i];
    } else {
        memcpy(s->y, k->held, sizeof k->held);
    }
    s->y_valid = 1;
    return OK;
}

/* ---- clock ---- */

static double next_event(const Instance *s) {
    (void)s; /* the clock is the importer's */
    return INFINITY;
}

static Status update_model(Instance *s, const char *function) {
    Samples *k = &s->memory.samples;
    if (!k->ticking) return OK;
    Status status = try_sample(s, function, s->memory.u);
    if (status == OK) take_sample(s), k->ticking = 0;
    invalidate(s);
    return status;
}

static Status check_clocks(const Instance *s, const char *function, const unsigned *vr, size_t n,
                           const void *values) {
    if (n > 0 && (vr == NULL || values == NULL))
        return report(s, ERROR, function, "an array is missing");
    for (size_t i = 0; i < n; i++)
        if (vr[i] != VR_CLOCK)
            return report(s, ERROR, function, "value reference %u is no clock", vr[i]);
    return OK;
}

static Status get_clock(Instance *s, const char *function, const unsigned *vr, size_t n,
                        _Bool *values) {
    if (check_mode(s, function, INITIALIZATION | EVENT) != OK) return ERROR;
    if (check_clocks(s, function, vr, n, values) != OK) return ERROR;
    for (size_t i = 0; i < n; i++) values[i] = s->memory.samples.ticking != 0;
    return OK;
}

static Status set_clock(Instance *s, const char *function, const unsigned *vr, size_t n,
                        const _Bool *values) {
    Samples *k = s == NULL ? NULL : &s->memory.samples;
    if (check_mode(s, function, EVENT) != OK) return ERROR;
    if (check_clocks(s, function, vr, n, values) != OK) return ERROR;
    for (size_t i = 0; i < n; i++)
        if (values[i] && next_sample(k) > k->elapsed + NEAR * MODEL_SAMPLE_TIME)
            return report(s, ERROR, function, "the next tick is due %.12g s behind the start, not %.12g",
                          next_sample(k), k->elapsed);
    for (size_t i = 0; i < n; i++) k->ticking = values[i] != 0;
    invalidate(s);
    return OK;
}

static Status get_clock_times(Instance *s, const char *function, const unsigned *vr, size_t n,
                              int which, double *values) {
    if (check_mode(s, function, ANY_MODE) != OK) return ERROR;
    if (check_clocks(s, function, vr, n, values) != OK) return ERROR;
    for (size_t i = 0; i < n; i++) values[i] = which == 0 ? MODEL_SAMPLE_TIME : 0.0;
    return OK;
}

/* ---- communication step ---- */

/* Inputs run linearly from the start of the step on. */
static void inputs_at(const Memory *start, double elapsed, double *u) {
    for (int i = 0; i < NU; i++) u[i] = start->u[i] + elapsed * start->slope[i];
}

static void add_time(Samples *k, double size) {
    const double step = size - k->carry, sum = k->elapsed + step;
    k->carry = (sum - k->elapsed) - step;
    k->elapsed = sum;
}

static Status do_step(Instance *s, const char *function, double point, double size,
                      double *reached, int *early) {
    if (check_kind(s, function, CO_SIMULATION, STEP) != OK) return ERROR;
    Memory *m = &s->memory;
    *reached = m->time;
    *early = 0;
    if (check_step(s, function, point, size) != OK) return ERROR;
    const Memory start = *m;
    Samples *k = &m->samples;
    k->ticking = 0;
    add_time(k, size);
    long made = 0;
    for (; next_sample(k) < k->elapsed - NEAR * MODEL_SAMPLE_TIME; made++) {
        double u[LENGTH(NU)];
        const double behind = next_sample(k) - start.samples.elapsed;
        inputs_at(&start, behind > 0.0 ? (behind < size ? behind : size) : 0.0, u);
        Status status = made < MAX_SAMPLES
                            ? try_sample(s, function, u)
                            : report(s, DISCARD, function, "more than %ld samples in one step", made);
        if (status != OK) {
            memcpy(m, &start, sizeof start); /* a discarded step changes nothing */
            invalidate(s);
            return status;
        }
        take_sample(s);
    }
    m->time = point + size;
    inputs_at(&start, size, m->u);
    memcpy(m->last_slope, start.slope, sizeof m->last_slope);
    memset(m->slope, 0, sizeof m->slope);
    invalidate(s);
    *reached = m->time;
    warn_of_inputs(s, function);
    if (s->log_mask & LOG_STEPS)
        report(s, OK, function, "to time %.12g, samples: %ld", *reached, made);
    return OK;
}

/* What no instance can have in its memory; NULL when all is as it may be. */
static const char *impossible_samples(const Memory *m) {
    const Samples *k = &m->samples;
    if (k->count < 0 || (k->ticking != 0 && (k->ticking != 1 || m->mode != EVENT)))
        return "its count of samples";
    if (!(k->elapsed >= 0.0 && isfinite(k->elapsed) && fabs(k->carry) <= 1.0)) return "its time";
    return all_finite(k->held, NY) ? NULL : "an output";
}

/* ---- derivatives: there are none ---- */

static Status directional_derivative(Instance *s, const char *function, const unsigned *unknowns,
                                     size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
                                     const double *seed, size_t n_seed, double *sensitivity,
                                     size_t n_sensitivity) {
    (void)unknowns, (void)n_unknowns, (void)knowns, (void)n_knowns, (void)seed, (void)n_seed;
    (void)sensitivity, (void)n_sensitivity;
    return refuse(s, function, 1, "a sampled block offers no derivatives");
}

static Status adjoint_derivative(Instance *s, const char *function, const unsigned *unknowns,
                                 size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
                                 const double *seed, size_t n_seed, double *sensitivity,
                                 size_t n_sensitivity) {
    return directional_derivative(s, function, unknowns, n_unknowns, knowns, n_knowns, seed, n_seed,
                                  sensitivity, n_sensitivity);
}

static Status get_output_slopes(Instance *s, const char *function, const unsigned *vr, size_t n,
                                const int *order, double *values, size_t n_values) {
    (void)vr, (void)order, (void)values, (void)n_values;
    return refuse(s, function, n, "outputs of a sampled block are held, without derivatives");
}

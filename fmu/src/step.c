/* The communication step of Co-Simulation. */
#include "instance.h"

/* The error allowed in one internal step, as a part of the tolerance: errors add up over steps, and
   outputs such as a stiffness are steeper than the states they come from. */
static const double STEP_FRACTION = MODEL_STEP_FRACTION;
#ifndef MAX_STEPS
#define MAX_STEPS 1000000
#endif

/* The instance at the start of the step, and how far the step has come when the solver starts. */
typedef struct {
    const Memory *start;
    double offset;
} StepContext;

/* Inputs run linearly from the start of the step on. */
static void inputs_at(const Memory *start, double elapsed, double *u) {
    for (int i = 0; i < NU; i++) u[i] = start->u[i] + elapsed * start->slope[i];
}

static void step_rhs(const void *context, double s, const double *x, double *xdot) {
    const StepContext *c = context;
    double u[LENGTH(NU)];
    inputs_at(c->start, c->offset + s, u);
    model_rhs(x, u, c->start->p, xdot);
}

static void step_linearize(const void *context, double s, const double *x, double *xdot,
                           double *jacobian, double *slope) {
    const StepContext *c = context;
    const Memory *start = c->start;
    double u[LENGTH(NU)];
    int sloping = 0;
    inputs_at(start, c->offset + s, u);
    model_linearize(x, u, start->p, xdot, jacobian);
    for (int i = 0; i < NU; i++) sloping |= start->slope[i] != 0.0;
    if (sloping) {
        static const double still[NX + LENGTH(NP)] = {0};
        double dy[LENGTH(NY)];
        model_forward(x, u, start->p, still, start->slope, still, slope, dy);
    } else {
        memset(slope, 0, NX * sizeof *slope);
    }
}

/* The instance as it stands `elapsed` behind the start of the step. */
static void arrive(Instance *s, const Memory *start, double elapsed, const double *x) {
    Memory *m = &s->memory;
    m->time = start->time + elapsed;
    memcpy(m->x, x, sizeof m->x);
    inputs_at(start, elapsed, m->u);
    memcpy(m->last_slope, start->slope, sizeof m->last_slope);
    memset(m->slope, 0, sizeof m->slope);
    invalidate(s);
}

/* Between internal steps the importer may look, and ask for an earlier end. */
typedef struct {
    Instance *instance;
    const StepContext *context;
    double end; /* of the step, as wished; counted from its start */
} Watch;

static int watch(void *context, double s, const double *x) {
    Watch *w = context;
    double elapsed = w->context->offset + s;
    arrive(w->instance, w->context->start, elapsed, x);
    w->instance->memory.mode = INTERMEDIATE;
    int changed = w->instance->after_step(w->instance, elapsed, &w->end);
    w->instance->memory.mode = STEP;
    return changed;
}

static Status do_step(Instance *s, const char *function, double point, double size,
                      double *reached, int *early) {
    if (check_kind(s, function, CO_SIMULATION, STEP) != OK) return ERROR;
    *reached = s->memory.time;
    *early = 0;
    if (check_step(s, function, point, size) != OK) return ERROR;
    const Memory start = s->memory;
    StepContext context = {&start, 0.0};
    Watch w = {s, &context, size};
    const SolverProblem problem = {&context, step_rhs, step_linearize, X_NOMINAL};
    const SolverOptions options = {start.tolerance * STEP_FRACTION, MODEL_FIXED_STEP, MAX_STEPS};
    SolverReport solver = {.step = start.step};
    long steps = 0, rejected = 0;
    double x[NX];
    memcpy(x, start.x, sizeof x);
    /* once, unless an intermediate update asks for an end before the next internal step */
    for (int arrived = 0; !arrived;) {
        double span = w.end - context.offset;
        SolverStatus status =
            solver_advance(&problem, &options, &s->work, span, solver.step, x,
                           s->after_step != NULL ? watch : NULL, &w, &solver);
        context.offset += solver.reached;
        steps += solver.steps;
        rejected += solver.rejected;
        if (status != SOLVER_OK) {
            memcpy(&s->memory, &start, sizeof start); /* a discarded step changes nothing */
            invalidate(s);
            return report(s, DISCARD, function,
                          "%s behind time %.12g (internal steps: %ld, rejected: %ld)",
                          solver_message(status), start.time + context.offset, steps, rejected);
        }
        arrived = solver.reached >= span || w.end <= context.offset;
    }
    *early = w.end < size;
    arrive(s, &start, context.offset, x);
    s->memory.time = point + (*early ? context.offset : size);
    s->memory.step = solver.step;
    *reached = s->memory.time;
    warn_of_inputs(s, function); /* where a slope has led them */
    if (s->log_mask & LOG_STEPS)
        report(s, OK, function, "to time %.12g, internal steps: %ld, rejected: %ld", *reached,
               steps, rejected);
    return OK;
}

/* One instance of a plant or a block: everything FMI 2 and FMI 3 have in common.

   Every function checks first, then acts, and answers with a status; a refused call is logged and
   changes nothing. `function` is the name of the FMI function that was called, for the log. */
#ifndef INSTANCE_H
#define INSTANCE_H

#include <stddef.h>
#include <stdint.h>

#include "model.h"
#ifndef MODEL_SAMPLED
#define SOLVER_N NX
#include "solver.h"
#endif

#if defined(__GNUC__)
#define NOT_ALWAYS_USED __attribute__((unused)) /* by one of the version layers only */
#else
#define NOT_ALWAYS_USED
#endif

/* The numbers are those of fmi2Status and fmi3Status. */
typedef enum { OK = 0, WARNING = 1, DISCARD = 2, ERROR = 3 } Status;

typedef enum { MODEL_EXCHANGE = 0, CO_SIMULATION = 1 } Kind;

typedef enum {
    INSTANTIATED = 1,
    INITIALIZATION = 2,
    EVENT = 4,
    CONTINUOUS = 8,
    STEP = 16,
    INTERMEDIATE = 32, /* inside the callback of FMI 3's intermediate update */
    TERMINATED = 64
} Mode;

#define INITIALIZED (EVENT | CONTINUOUS | STEP | TERMINATED)
#define ANY_MODE (INSTANTIATED | INITIALIZATION | INITIALIZED)

typedef enum {
    LOG_ERROR = 1,
    LOG_DISCARD = 2,
    LOG_STEPS = 4,
    LOG_WARNING = 8,
    LOG_EVERYTHING = 15
} LogMask;

#ifdef MODEL_SAMPLED
/* What a sampled block carries from sample to sample. Sample k is due k MODEL_SAMPLE_TIME behind the
   start: samples are counted, and the steps of the importer are summed up without rounding errors. */
typedef struct {
    int64_t count;         /* of samples made */
    int64_t ticking;       /* 1 while the importer's clock ticks, in event mode */
    double elapsed, carry; /* time since the start: the sum of all steps, and what its rounding left */
    double memory[LENGTH(NM)];
    double held[LENGTH(NY)]; /* outputs of the last sample */
} Samples;
#endif

/* All that a saved state holds; plain data of the same layout on every 64-bit platform. */
typedef struct {
    int32_t kind, mode;
    double time, stop_time; /* stop_time is infinite when none was given */
    double tolerance;
    double step; /* the solver's suggestion; 0: none */
    double x[LENGTH(NX)];
    double u[LENGTH(NU)];
    double p[LENGTH(NP)];
    double slope[LENGTH(NU)];      /* du/dt over the next communication step */
    double last_slope[LENGTH(NU)]; /* du/dt over the last one */
#ifdef MODEL_SAMPLED
    Samples samples;
#endif
} Memory;

typedef struct SavedState SavedState;

typedef struct Instance Instance;
/* Hands a message to the importer; belongs to the version layer. */
typedef void LogFunction(const Instance *instance, Status status, const char *category,
                         const char *message);
/* Called behind each internal step, `elapsed` behind the start of the communication step. Returns 1
   when the importer moved *end, the time from its start at which the communication step ends. */
typedef int StepFunction(Instance *instance, double elapsed, double *end);

struct Instance {
    Memory memory;
    /* computed when asked for: valid is cleared by whatever changes x, u, p or time */
    int xdot_valid, y_valid;
    double xdot[LENGTH(NX)];
    double y[LENGTH(NY)];
#ifdef MODEL_SAMPLED
    BlockWork work;
#else
    SolverWork work;
#endif
    /* ways to the importer, opaque here */
    char name[128];
    unsigned log_mask;
    char warned[LENGTH(NU)]; /* inputs whose value outside their range is in the log */
    LogFunction *log;
    StepFunction *after_step; /* NULL: not wanted */
    void *environment;
    void (*log_callback)(void);
    void (*step_callback)(void);
    int early_return_allowed;
    int jumped;          /* an input or a parameter, in event mode, since the last update */
    int event_mode_used; /* by an importer of FMI 3 Co-Simulation */
};

/* ---- life ---- */
static Instance *instance_new(Kind kind, const char *name, const char *token, LogFunction *log,
                              void (*log_callback)(void), void *environment);
static void instance_free(Instance *s);
static Status set_debug_logging(Instance *s, const char *function, int on, size_t n,
                                const char *const categories[]);
static Status setup_experiment(Instance *s, const char *function, int has_tolerance,
                               double tolerance, double start, int has_stop, double stop);
static Status enter_initialization(Instance *s, const char *function);
static Status exit_initialization(Instance *s, const char *function);
static Status enter_event_mode(Instance *s, const char *function);
static Status update_discrete_states(Instance *s, const char *function, int *changed);
static Status enter_continuous_time(Instance *s, const char *function);
NOT_ALWAYS_USED static Status enter_step_mode(Instance *s, const char *function);
static Status completed_integrator_step(Instance *s, const char *function);
static Status terminate(Instance *s, const char *function);
static Status reset(Instance *s, const char *function);
/* A function that this FMU does not offer: OK when it is called for nothing at all. */
static Status refuse(Instance *s, const char *function, size_t n, const char *reason);
NOT_ALWAYS_USED static Status discard(Instance *s, const char *function, const char *reason);

/* ---- what depends on the model: evaluate.c of a plant, sampled.c of a block ---- */
/* Make xdot and y those of the present memory. */
static Status evaluate_xdot(Instance *s, const char *function);
static Status evaluate_y(Instance *s, const char *function);
/* What a simulation begins with, when all start values are there. */
static void start_model(Instance *s);
/* When the next event comes that is known beforehand; infinite when there is none. */
static double next_event(const Instance *s);
/* What an event changes, of itself or by a clock. */
static Status update_model(Instance *s, const char *function);

/* ---- clocks: of a block in FMI 3 ---- */
NOT_ALWAYS_USED static Status get_clock(Instance *s, const char *function, const unsigned *vr,
                                        size_t n, _Bool *values);
NOT_ALWAYS_USED static Status set_clock(Instance *s, const char *function, const unsigned *vr,
                                        size_t n, const _Bool *values);
/* Interval (which = 0) or shift (1) of clocks [s]. */
NOT_ALWAYS_USED static Status get_clock_times(Instance *s, const char *function, const unsigned *vr,
                                              size_t n, int which, double *values);

/* ---- values ---- */
static Status get_values(Instance *s, const char *function, const unsigned *vr, size_t n,
                         double *values, size_t n_values);
static Status set_values(Instance *s, const char *function, const unsigned *vr, size_t n,
                         const double *values, size_t n_values);
static Status set_time(Instance *s, const char *function, double time);
static Status set_states(Instance *s, const char *function, const double *x, size_t n);
static Status get_states(Instance *s, const char *function, double *x, size_t n);
static Status get_state_derivatives(Instance *s, const char *function, double *xdot, size_t n);
static Status get_nominals(Instance *s, const char *function, double *nominals, size_t n);
static Status get_count(Instance *s, const char *function, size_t value, size_t *count);
/* Log inputs outside their min and max, each once until the next reset; they are used as given. */
static void warn_of_inputs(Instance *s, const char *function);

/* ---- derivatives ---- */
static Status directional_derivative(Instance *s, const char *function, const unsigned *unknowns,
                                     size_t n_unknowns, const unsigned *knowns, size_t n_knowns,
                                     const double *seed, size_t n_seed, double *sensitivity,
                                     size_t n_sensitivity);
NOT_ALWAYS_USED static Status adjoint_derivative(
    Instance *s, const char *function, const unsigned *unknowns, size_t n_unknowns,
    const unsigned *knowns, size_t n_knowns, const double *seed, size_t n_seed, double *sensitivity,
    size_t n_sensitivity);
NOT_ALWAYS_USED static Status set_input_slopes(Instance *s, const char *function,
                                               const unsigned *vr, size_t n, const int *order,
                                               const double *values);
static Status get_output_slopes(Instance *s, const char *function, const unsigned *vr, size_t n,
                                const int *order, double *values, size_t n_values);

/* ---- co-simulation ---- */
/* Whether a step from `point` by `size` follows on where the instance stands. */
static Status check_step(const Instance *s, const char *function, double point, double size);
/* *reached is the time up to which the step was made, *early whether the importer cut it short. */
static Status do_step(Instance *s, const char *function, double point, double size,
                      double *reached, int *early);

/* ---- saved states ---- */
static Status get_state(Instance *s, const char *function, SavedState **state);
static Status set_state(Instance *s, const char *function, const SavedState *state);
static Status free_state(Instance *s, const char *function, SavedState **state);
static Status serialized_size(Instance *s, const char *function, const SavedState *state,
                              size_t *size);
static Status serialize(Instance *s, const char *function, const SavedState *state, uint8_t *bytes,
                        size_t size);
static Status deserialize(Instance *s, const char *function, const uint8_t *bytes, size_t size,
                          SavedState **state);

#endif

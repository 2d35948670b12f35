/* Many cases of a plant side by side for Python: the method of solver.c, a case in each lane of a
   vector, with steps, error control and inputs of its own. A lane whose case has ended takes the next.
   What a lane computes depends on nothing in the others, so results do not depend on their number.

   lanes_data.h gives SOLVER_N (states), NU, NP, LANES and the target; plant_lanes.c the equations. */
#include "lanes_data.h"

#include <math.h>
#include <stdint.h>
#include <string.h>

#if defined(LANES_TARGET) && defined(__clang__)
#pragma clang attribute push(__attribute__((target(LANES_TARGET))), apply_to = function)
#elif defined(LANES_TARGET) && defined(__GNUC__)
#pragma GCC target(LANES_TARGET)
#endif

#include "elementary.h"

#define INSIDE static inline __attribute__((always_inline))
typedef double V __attribute__((vector_size(8 * LANES)));
typedef int64_t M __attribute__((vector_size(8 * LANES)));

INSIDE V all(double value) {
    V every;
    for (int l = 0; l < LANES; l++) every[l] = value;
    return every;
}
INSIDE V chosen(M mask, V yes, V no) { return (V)((mask & (M)yes) | (~mask & (M)no)); }
INSIDE V truth(M mask) { return (V)(mask & (M)all(1.0)); }
INSIDE V v_fabs(V a) { return (V)((M)a & INT64_MAX); }
INSIDE V v_fmax(V a, V b) { return chosen(a > b, a, b); }
INSIDE V v_fmin(V a, V b) { return chosen(a < b, a, b); }
INSIDE V v_sign(V a) { return chosen(a > 0.0, all(1.0), chosen(a < 0.0, all(-1.0), a)); }
#define BY_LANE(name, f)                                                                           \
    static V name(V a) {                                                                           \
        for (int l = 0; l < LANES; l++) a[l] = f(a[l]);                                            \
        return a;                                                                                  \
    }
#define BY_LANE2(name, f)                                                                          \
    static V name(V a, V b) {                                                                      \
        for (int l = 0; l < LANES; l++) a[l] = f(a[l], b[l]);                                      \
        return a;                                                                                  \
    }

/* As portable_exp, whose bits it gives; where a lane is beyond the range, lane by lane. */
static V v_exp(V x) {
    const M inside = (v_fabs(x) < 700.0);
    int every = 1;
    for (int l = 0; l < LANES; l++) every &= inside[l] != 0;
    if (!every) {
        for (int l = 0; l < LANES; l++) x[l] = portable_exp(x[l]);
        return x;
    }
    const V multiple = x * PARTS_PER_LN2;
    const M n = __builtin_convertvector(multiple + chosen(multiple < 0.0, all(-0.5), all(0.5)), M);
    const V whole = __builtin_convertvector(n, V);
    const V r = (x - whole * LN2_PART_HIGH) - whole * LN2_PART_LOW;
    const M j = n & (EXP_PARTS - 1), k = (n - j) / EXP_PARTS;
    const V high = 1.0 / 24 + r * (1.0 / 120 + r * (1.0 / 720));
    const V p = r + r * r * (1.0 / 2 + r * (1.0 / 6 + r * high));
    V head, tail;
    for (int l = 0; l < LANES; l++) head[l] = POWERS[j[l]][0], tail[l] = POWERS[j[l]][1];
    return (head + (tail + head * p)) * (V)((k + 1023) << 52);
}

BY_LANE(v_sqrt, sqrt)
BY_LANE(v_log, log)
BY_LANE(v_log1p, log1p)
BY_LANE(v_expm1, portable_expm1)
BY_LANE(v_tanh, portable_tanh)
BY_LANE(v_sin, sin)
BY_LANE(v_cos, cos)
BY_LANE(v_tan, tan)
BY_LANE(v_asin, asin)
BY_LANE(v_acos, acos)
BY_LANE(v_atan, atan)
BY_LANE(v_sinh, sinh)
BY_LANE(v_cosh, cosh)
BY_LANE(v_asinh, asinh)
BY_LANE(v_acosh, acosh)
BY_LANE(v_atanh, atanh)
BY_LANE(v_floor, floor)
BY_LANE(v_ceil, ceil)
BY_LANE(v_erf, erf)
BY_LANE2(v_pow, pow)
BY_LANE2(v_fmod, fmod)
BY_LANE2(v_atan2, atan2)
BY_LANE2(v_hypot, hypot)
BY_LANE2(v_copysign, copysign)

#include "plant_lanes.c"

#define SOLVER_TABLES_ONLY
#include "solver.c"

#if defined(_WIN32)
#define SHOWN __declspec(dllexport)
#else
#define SHOWN __attribute__((visibility("default")))
#endif
#define LENGTH(n) ((n) > 0 ? (n) : 1)
static const double SAME = 1e-12;

/* Whole in Python's memory, where it has the same members in the same order. */
typedef struct {
    const double *parameters;   /* cases x NP */
    const double *starts;       /* cases x SOLVER_N */
    const double *coefficients; /* of the inputs: pieces x (degree + 1) x NU, for one or each case */
    const double *nominal, *times, *breaks;
    double *states;      /* cases x (intervals + 1) x SOLVER_N */
    signed char *status; /* 1: wanted, 2: at its end, 0: not wanted, or given up */
    double tolerance;
    long long cases, intervals, pieces, degree, max_steps;
    long long apart; /* numbers from the coefficients of one case to those of the next */
    void *memory;    /* of lanes_memory() bytes, aligned */
    long long next;  /* case */
} Cases;

/* Where the lanes stand. */
typedef struct {
    V x[SOLVER_N], p[LENGTH(NP)];
    V k[STAGES][SOLVER_N], f[SOLVER_N], slope[SOLVER_N], stage[SOLVER_N];
    V jacobian[SOLVER_N * SOLVER_N], lu[SOLVER_N][SOLVER_N];
    M swapped[SOLVER_N][SOLVER_N];
    int swaps;
    V behind; /* the break of the piece: begin of the interval */
    V s, h;
    double span[LANES], step[LANES], allowed[LANES];
    long long of[LANES]; /* case, -1: none */
    long long interval[LANES], piece[LANES], steps[LANES];
    int begins[LANES], busy;
    V inputs[]; /* (degree + 1) x NU coefficients of the pieces that the lanes are in */
} Lanes;

SHOWN long long lanes_memory(long long degree);
long long lanes_memory(long long degree) {
    return (long long)(sizeof(Lanes) + sizeof(V) * (size_t)((degree + 1) * NU + 1));
}

static void enter_piece(const Cases *run, Lanes *w, int l) {
    const long long size = (run->degree + 1) * NU;
    const double *c = run->coefficients + w->of[l] * run->apart + w->piece[l] * size;
    for (long long j = 0; j < size; j++) w->inputs[j][l] = c[j];
}

static void enter_interval(const Cases *run, Lanes *w, int l) {
    const double begin = run->times[w->interval[l]], same = begin + SAME * (1.0 + fabs(begin));
    const long long before = w->piece[l];
    while (w->piece[l] + 1 < run->pieces && run->breaks[w->piece[l] + 1] <= same) w->piece[l]++;
    if (w->piece[l] != before) enter_piece(run, w, l);
    w->behind[l] = begin - run->breaks[w->piece[l]];
    w->span[l] = run->times[w->interval[l] + 1] - begin;
    w->s[l] = 0.0, w->allowed[l] = 1.0, w->steps[l] = 0, w->begins[l] = 1;
}

/* The next case that is wanted into a lane; without one it idles on what it has. */
static void load(Cases *run, Lanes *w, int l) {
    if (w->of[l] >= 0) w->busy--;
    w->of[l] = -1, w->h[l] = 1.0;
    while (run->next < run->cases && !run->status[run->next]) run->next++;
    if (run->next >= run->cases) return;
    const long long c = run->next++;
    w->of[l] = c, w->busy++;
    for (int i = 0; i < NP; i++) w->p[i][l] = run->parameters[c * NP + i];
    double *row = run->states + c * (run->intervals + 1) * SOLVER_N;
    for (int n = 0; n < SOLVER_N; n++) row[n] = w->x[n][l] = run->starts[c * SOLVER_N + n];
    w->interval[l] = w->piece[l] = 0, w->step[l] = 0.0;
    enter_piece(run, w, l);
    enter_interval(run, w, l);
}

static void give_up(Cases *run, Lanes *w, int l) {
    run->status[w->of[l]] = 0;
    load(run, w, l);
}

static void inputs_at(const Cases *run, const Lanes *w, V s, V *u, V *slope) {
    const V t = w->behind + s;
    for (int i = 0; i < NU; i++) {
        V value = {0}, rise = {0};
        for (long long j = run->degree; j >= 0; j--) {
            rise = rise * t + value;
            value = value * t + w->inputs[j * NU + i];
        }
        u[i] = value;
        if (slope != NULL) slope[i] = rise;
    }
}

static int any(M mask) {
    int64_t found = 0;
    for (int l = 0; l < LANES; l++) found |= mask[l];
    return found != 0;
}

/* LU factors of I/(h gamma) - J; rows are swapped in each lane by itself. */
static void factorise(const Cases *run, Lanes *w) {
    V(*a)[SOLVER_N] = w->lu;
    const V shift = 1.0 / w->h / RODAS_GAMMA;
    V weight[SOLVER_N];
    w->swaps = 0;
    for (int i = 0; i < SOLVER_N; i++) {
        weight[i] = all(1.0 / run->nominal[i]);
        for (int j = 0; j < SOLVER_N; j++) a[i][j] = -w->jacobian[i + SOLVER_N * j];
        a[i][i] += shift;
    }
    for (int k = 0; k < SOLVER_N; k++) {
        for (int i = k + 1; i < SOLVER_N; i++) {
            const M m = w->swapped[k][i] =
                (M)(v_fabs(a[i][k]) * weight[i] > v_fabs(a[k][k]) * weight[k]);
            if (!any(m)) continue;
            w->swaps = 1;
            for (int j = 0; j < SOLVER_N; j++) {
                const V upper = a[k][j];
                a[k][j] = chosen(m, a[i][j], upper);
                a[i][j] = chosen(m, upper, a[i][j]);
            }
            const V upper = weight[k];
            weight[k] = chosen(m, weight[i], upper);
            weight[i] = chosen(m, upper, weight[i]);
        }
        a[k][k] = 1.0 / a[k][k];
        for (int i = k + 1; i < SOLVER_N; i++) {
            a[i][k] *= a[k][k];
            for (int j = k + 1; j < SOLVER_N; j++) a[i][j] -= a[i][k] * a[k][j];
        }
    }
}

INSIDE void solve(const Lanes *w, V *b) {
    const V(*a)[SOLVER_N] = w->lu;
    for (int k = 0; w->swaps && k < SOLVER_N; k++)
        for (int i = k + 1; i < SOLVER_N; i++) {
            const M m = w->swapped[k][i];
            const V upper = b[k];
            b[k] = chosen(m, b[i], upper);
            b[i] = chosen(m, upper, b[i]);
        }
    for (int k = 0; k < SOLVER_N; k++)
        for (int i = k + 1; i < SOLVER_N; i++) b[i] -= a[i][k] * b[k];
    for (int k = SOLVER_N - 1; k >= 0; k--) {
        b[k] *= a[k][k];
        for (int i = 0; i < k; i++) b[i] -= a[i][k] * b[k];
    }
}

INSIDE void one_stage(const Cases *run, Lanes *w, V inverse, int i) {
    V total[SOLVER_N], u[LENGTH(NU)], *k = w->k[i];
    for (int n = 0; n < SOLVER_N; n++) {
        V shift = {0}, value = w->x[n];
        for (int j = 0; j < i; j++) {
            value += RODAS_A[i][j] * w->k[j][n];
            shift += RODAS_C[i][j] * w->k[j][n];
        }
        w->stage[n] = value;
        total[n] = inverse * shift + w->h * RODAS_D[i] * w->slope[n];
    }
    const V *f = w->f;
    if (i > 0) {
        inputs_at(run, w, w->s + RODAS_ALPHA[i] * w->h, u, NULL);
        plant_rhs(w->stage, u, w->p, k);
        f = k;
    }
    for (int n = 0; n < SOLVER_N; n++) total[n] += f[n];
    solve(w, total);
    for (int n = 0; n < SOLVER_N; n++) k[n] = total[n];
}

/* Largest error of the step just made, in units of what is allowed; NaN where it failed. */
static V errors(const Cases *run, const Lanes *w) {
    V largest = {0};
    M sound = ~(M){0};
    for (int n = 0; n < SOLVER_N; n++) {
        const V allowed = run->tolerance * run->nominal[n] + ROUNDING * v_fabs(w->x[n]);
        const V error = v_fabs(w->k[STAGES - 1][n]) / allowed;
        sound &= (M)(v_fabs(w->stage[n]) < INFINITY) & (M)(error < INFINITY);
        largest = v_fmax(error, largest);
    }
    return chosen(sound, largest, all(NAN));
}

/* The length of a lane's next step; 0 where it cannot be made. */
static double length_of(const Cases *run, Lanes *w, int l) {
    if (w->begins[l]) {
        double rate = 0.0;
        for (int n = 0; n < SOLVER_N; n++) {
            const double size = fabs(w->f[n][l]) / run->nominal[n];
            if (!isfinite(size)) return 0.0;
            if (size > rate) rate = size;
        }
        const double span = w->span[l];
        const double first = rate * span > FIRST_CHANGE ? FIRST_CHANGE / rate : span;
        if (!(w->step[l] > 0.0) || w->step[l] > first) w->step[l] = first;
        w->begins[l] = 0;
    }
    if (w->steps[l]++ >= run->max_steps) return 0.0;
    const double left = w->span[l] - w->s[l], count = ceil(left / (w->step[l] * STRETCH));
    return count <= 1.0 ? left : (count <= EVEN ? left / count : w->step[l]);
}

/* What follows from a step for a lane. */
static void judged(Cases *run, Lanes *w, int l, double error) {
    const double h = w->h[l], step = w->step[l], allowed = w->allowed[l];
    const double factor = isnan(error) ? SHRINK : change_of_step(error);
    if (!(error <= allowed)) {
        w->step[l] = h * (factor < SAFETY ? factor : SAFETY) * (allowed < 1.0 ? 1.0 : CAUTION);
        w->allowed[l] = BEHIND_REJECTED;
        if (w->step[l] < SHORTEST * w->span[l]) give_up(run, w, l);
        return;
    }
    const int last = h == w->span[l] - w->s[l];
    for (int n = 0; n < SOLVER_N; n++) w->x[n][l] = w->stage[n][l];
    w->s[l] += h;
    w->allowed[l] = 1.0;
    if (!(h < step && factor >= 1.0) || factor * h > step) w->step[l] = factor * h;
    if (!last) return;
    const long long c = w->of[l], row = c * (run->intervals + 1) + ++w->interval[l];
    for (int n = 0; n < SOLVER_N; n++) run->states[row * SOLVER_N + n] = w->x[n][l];
    if (w->interval[l] < run->intervals) {
        enter_interval(run, w, l);
        return;
    }
    run->status[c] = 2;
    load(run, w, l);
}

static void linearise(const Cases *run, Lanes *w) {
    V u[LENGTH(NU)], rise[LENGTH(NU)];
    inputs_at(run, w, w->s, u, rise);
    plant_linearize(w->x, u, w->p, w->f, w->jacobian);
    if (run->degree > 0)
        plant_slope(w->x, u, w->p, rise, w->slope);
    else
        memset(w->slope, 0, sizeof w->slope);
}

static void step_all(Cases *run, Lanes *w) {
    linearise(run, w);
    for (int l = 0; l < LANES; l++) {
        if (w->of[l] < 0) continue;
        w->h[l] = length_of(run, w, l);
        if (w->h[l] > 0.0) continue;
        give_up(run, w, l);
        w->h[l] = -1.0; /* what it has now begins with the next step */
    }
    M waits = w->h < 0.0;
    w->h = chosen(waits, all(1.0), w->h);
    factorise(run, w);
    const V inverse = 1.0 / w->h;
    one_stage(run, w, inverse, 0);
    one_stage(run, w, inverse, 1);
    one_stage(run, w, inverse, 2);
    one_stage(run, w, inverse, 3);
    one_stage(run, w, inverse, 4);
    one_stage(run, w, inverse, 5);
    one_stage(run, w, inverse, 6);
    one_stage(run, w, inverse, 7);
    for (int n = 0; n < SOLVER_N; n++) w->stage[n] += w->k[STAGES - 1][n];
    const V error = errors(run, w);
    for (int l = 0; l < LANES; l++)
        if (w->of[l] >= 0 && !waits[l]) judged(run, w, l, error[l]);
}

/* For so many steps at most: 0 when all cases have ended, 1 before. */
SHOWN int simulate_cases(Cases *run, long long begins, long long budget);
int simulate_cases(Cases *run, long long begins, long long budget) {
    Lanes *w = run->memory;
    if (begins) {
        memset(w, 0, (size_t)lanes_memory(run->degree));
        run->next = 0;
        for (int l = 0; l < LANES; l++) w->of[l] = -1;
        /* lanes without a case compute on what the first one has */
        for (int i = 0; i < NP; i++) w->p[i] = all(run->parameters[i]);
        for (int n = 0; n < SOLVER_N; n++) w->x[n] = all(run->starts[n]);
        for (int l = 0; l < LANES; l++) load(run, w, l);
    }
    for (; w->busy > 0; budget--) {
        if (budget <= 0) return 1;
        step_all(run, w);
    }
    return 0;
}

#if defined(LANES_TARGET) && defined(__clang__)
#pragma clang attribute pop
#endif

/* The plant, or the sampled block, as C functions over the code that CasADi generated. Knows nothing
   of FMI.

   model_data.h, written at export, gives the sizes, names and values:
   NX, NU, NP, NY, MODEL_NAME, MODEL_TOKEN, MODEL_TOLERANCE, MODEL_FIXED_STEP, the work sizes of the
   generated functions, and the tables declared there. A block (MODEL_SAMPLED) has no states: NX is 0,
   NM the size of its memory. */
#ifndef MODEL_H
#define MODEL_H

/* What V_TYPE says of variables */
enum { NUMBER, BOOLEAN, ENUMERATION, SINGLE };

#include "model_data.h"

/* What the model description proposes to importers' own solvers. */
#ifndef MODEL_PROPOSED_TOLERANCE
#define MODEL_PROPOSED_TOLERANCE MODEL_TOLERANCE
#endif

/* Values behind a reference: more than one for the first entry of an array of parameters (FMI 3). */
#ifdef MODEL_ARRAYS
#define SIZE_OF(r) ((r) >= VR_P && (r) < VR_Y ? (size_t)P_SIZE[(r) - VR_P] : (size_t)1)
#else
#define SIZE_OF(r) ((size_t)1)
#endif

/* Variables that FMI reads and sets by functions of their own type */
#ifdef MODEL_TYPES
#define TYPE_OF(r) ((r) < VR_END ? V_TYPE[r] : NUMBER)
#else
#define TYPE_OF(r) NUMBER
#endif

/* The end of a range, as numbers of single precision meet it */
#ifdef MODEL_SINGLE
#define BOUND(value) ((double)(float)(value))
#else
#define BOUND(value) (value)
#endif

/* C has no arrays of length 0. */
#define LENGTH(n) ((n) > 0 ? (n) : 1)

/* Value references: time, states, their derivatives, inputs, parameters, outputs. */
enum {
    VR_TIME = 0,
    VR_X = 1,
    VR_XDOT = VR_X + NX,
    VR_U = VR_XDOT + NX,
    VR_P = VR_U + NU,
    VR_Y = VR_P + NP,
    VR_END = VR_Y + NY
};

#ifdef MODEL_SAMPLED

/* Inputs that may be NaN: measurements that are missing. */
#define MAY_BE_MISSING(i) U_MISSING[i]
/* Outputs that hold their start value until the first sample */
#define BEGINS(i) Y_BEGINS[i]

/* The clock of the samples in FMI 3 */
enum { VR_CLOCK = VR_END };

/* Scratch memory; holds nothing between two calls. MODEL_SINGLE: the step computes with floats. */
typedef struct {
    int iw[BLOCK_IW];
    double memory[LENGTH(NM)];
#ifdef MODEL_SINGLE
    float w[BLOCK_W], m[LENGTH(NM)], u[LENGTH(NU)], p[LENGTH(NP)], next[LENGTH(NM)], y[LENGTH(NY)];
#else
    double w[BLOCK_W];
#endif
} BlockWork;

/* (next, y) = step(memory, u, p) */
static void block_call(BlockWork *work, const double *memory, const double *u, const double *p,
                       double *next, double *y);

#else

#define MAY_BE_MISSING(i) 0
#define BEGINS(i) 0

/* xdot = f(x, u, p) */
static void model_rhs(const double *x, const double *u, const double *p, double *xdot);
/* y = g(x, u, p) */
static void model_outputs(const double *x, const double *u, const double *p, double *y);
/* xdot and df/dx, dense by columns */
static void model_linearize(const double *x, const double *u, const double *p, double *xdot,
                            double *jacobian);
/* (dxdot, dy) = d(f, g)/d(x, u, p) (dx, du, dp) */
static void model_forward(const double *x, const double *u, const double *p, const double *dx,
                          const double *du, const double *dp, double *dxdot, double *dy);
/* (bx, bu, bp) = (bxdot, by) d(f, g)/d(x, u, p) */
static void model_reverse(const double *x, const double *u, const double *p, const double *bxdot,
                          const double *by, double *bx, double *bu, double *bp);

#endif

#endif

/* The plant as C functions over the code that CasADi generated. Knows nothing of FMI.

   model_data.h, written at export, gives the sizes, names and values:
   NX, NU, NP, NY, MODEL_NAME, MODEL_TOKEN, MODEL_TOLERANCE, MODEL_FIXED_STEP, the work sizes of the
   generated functions, and the tables declared there. */
#ifndef MODEL_H
#define MODEL_H

#include "model_data.h"

/* What the model description proposes to importers' own solvers. */
#ifndef MODEL_PROPOSED_TOLERANCE
#define MODEL_PROPOSED_TOLERANCE MODEL_TOLERANCE
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

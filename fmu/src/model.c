/* Calls of the functions that CasADi generated for a plant. */
#include "model.h"

#include "generated.c"

static void model_rhs(const double *x, const double *u, const double *p, double *xdot) {
    const double *arg[PLANT_ARG] = {x, u, p};
    double *res[PLANT_RES] = {xdot}, w[PLANT_W];
    int iw[PLANT_IW];
    plant_rhs(arg, res, iw, w, 0);
}

static void model_outputs(const double *x, const double *u, const double *p, double *y) {
    const double *arg[PLANT_ARG] = {x, u, p};
    double *res[PLANT_RES] = {y}, w[PLANT_W];
    int iw[PLANT_IW];
    plant_outputs(arg, res, iw, w, 0);
}

static void model_linearize(const double *x, const double *u, const double *p, double *xdot,
                            double *jacobian) {
    const double *arg[PLANT_ARG] = {x, u, p};
    double *res[PLANT_RES] = {xdot, jacobian}, w[PLANT_W];
    int iw[PLANT_IW];
    plant_linearize(arg, res, iw, w, 0);
}

static void model_forward(const double *x, const double *u, const double *p, const double *dx,
                          const double *du, const double *dp, double *dxdot, double *dy) {
    const double *arg[PLANT_ARG] = {x, u, p, dx, du, dp};
    double *res[PLANT_RES] = {dxdot, dy}, w[PLANT_W];
    int iw[PLANT_IW];
    plant_forward(arg, res, iw, w, 0);
}

static void model_reverse(const double *x, const double *u, const double *p, const double *bxdot,
                          const double *by, double *bx, double *bu, double *bp) {
    const double *arg[PLANT_ARG] = {x, u, p, bxdot, by};
    double *res[PLANT_RES] = {bx, bu, bp}, w[PLANT_W];
    int iw[PLANT_IW];
    plant_reverse(arg, res, iw, w, 0);
}

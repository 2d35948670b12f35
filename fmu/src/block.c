/* The call of the step that CasADi generated for a sampled block. */
#include "model.h"

#include "generated.c"

#ifdef MODEL_SINGLE
static void narrow(const double *from, float *to, int n) {
    for (int i = 0; i < n; i++) to[i] = (float)from[i];
}

static void widen(const float *from, double *to, int n) {
    for (int i = 0; i < n; i++) to[i] = from[i];
}

static void block_call(BlockWork *work, const double *memory, const double *u, const double *p,
                       double *next, double *y) {
    const float *arg[BLOCK_ARG] = {work->m, work->u, work->p};
    float *res[BLOCK_RES] = {work->next, work->y};
    narrow(memory, work->m, NM), narrow(u, work->u, NU), narrow(p, work->p, NP);
    casadi_f0(arg, res, work->iw, work->w, 0);
    widen(work->next, next, NM), widen(work->y, y, NY);
}
#else
static void block_call(BlockWork *work, const double *memory, const double *u, const double *p,
                       double *next, double *y) {
    const double *arg[BLOCK_ARG] = {memory, u, p};
    double *res[BLOCK_RES] = {next, y};
    block_step(arg, res, work->iw, work->w, 0);
}
#endif

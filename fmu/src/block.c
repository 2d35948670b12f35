/* The call of the step that CasADi generated for a sampled block. */
#include "model.h"

#include "generated.c"

static void block_call(BlockWork *work, const double *memory, const double *u, const double *p,
                       double *next, double *y) {
    const double *arg[BLOCK_ARG] = {memory, u, p};
    double *res[BLOCK_RES] = {next, y};
    block_step(arg, res, work->iw, work->w, 0);
}

/* The code that CasADi generated, plant.c. Its exponentials are not those of the C library, so that
   every platform gives the same bits. */
#define CASADI_SYMBOL_EXPORT static
#if defined(__GNUC__)
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
#include "elementary.h"
#define exp portable_exp
#define expm1 portable_expm1
#define tanh portable_tanh
#include "plant.c"
#undef exp
#undef expm1
#undef tanh
#if defined(__GNUC__)
#pragma GCC diagnostic pop
#endif

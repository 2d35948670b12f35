/* The whole FMU of a sampled block as one translation unit: compile this file. */
#include "instance.h"
#include "block.c"
#include "instance.c"
#include "values.c"
#include "sampled.c"
#include "state.c"
#include "fmi2.c"

/* Sizes, names and values of the counter, written by hand. */
#ifndef MODEL_DATA_H
#define MODEL_DATA_H
#include <math.h>

#include "counter.h"
#define MODEL_SAMPLED
#define MODEL_SAMPLE_TIME COUNTER_PERIOD
#define NX 0
#define NM 3
#define NU 2
#define NP 2
#define NY 3
#define MODEL_NAME "counter"
#define MODEL_TOKEN COUNTER_TOKEN
#define MODEL_TOLERANCE 1e-06
#define BLOCK_ARG 3
#define BLOCK_RES 2
#define BLOCK_IW 1
#define BLOCK_W 1
static const char *const NAMES[] = {"time", "measured", "reference", "gain",  "offset",
                                    "command", "count", "dropped",   "clock"};
/* no states: C has no arrays of length 0 */
static const double X_START[] = {0.0};
static const double X_NOMINAL[] = {1.0};
static const double M_START[] = {0.0, 0.0, 0.0};
static const double U_START[] = {0.0, 0.0};
static const double U_MIN[] = {-1.0, -INFINITY};
static const double U_MAX[] = {1.0, INFINITY};
static const int U_MISSING[] = {1, 0};
static const double P_START[] = {COUNTER_GAIN, 0.0};
static const double P_MIN[] = {0.0, -INFINITY};
static const double P_MAX[] = {100.0, INFINITY};
static const int P_TUNABLE[] = {1, 0};
static const double Y_START[] = {0.0, 0.0, 0.0};
static const int Y_BEGINS[] = {0, 0, 0};
#endif

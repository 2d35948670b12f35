/* Sizes, names and values of a motion that is played, written by hand. */
#ifndef MODEL_DATA_H
#define MODEL_DATA_H
#include <math.h>

#include "motion_example.h"
#define NX 1
#define NU 0
#define NP 0
#define NY 2
#define MODEL_NAME "motion"
#define MODEL_TOKEN MOTION_TOKEN
#define MODEL_TOLERANCE 1e-06
#define MODEL_STEP_FRACTION 0.01
#define MODEL_FIXED_STEP 0.0
#define PLANT_ARG 6
#define PLANT_RES 3
#define PLANT_IW 1
#define PLANT_W 1
static const char *const NAMES[] = {"time", "clock", "der(clock)", "level", "curve"};
static const double X_START[] = {0.0};
static const double X_NOMINAL[] = {1.0};
/* no inputs, no parameters: C has no arrays of length 0 */
static const double U_START[] = {0.0};
static const double U_MIN[] = {0.0};
static const double U_MAX[] = {0.0};
static const double P_START[] = {0.0};
static const double P_MIN[] = {0.0};
static const double P_MAX[] = {0.0};
static const int P_TUNABLE[] = {0};
#endif

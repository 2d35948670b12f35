/* Sizes, names and values of a mass that hangs on a spring, written by hand. */
#ifndef MODEL_DATA_H
#define MODEL_DATA_H
#include <math.h>

#include "spring.h"
#define NX 2
#define NU 1
#define NP 4
#define NY 2
#define MODEL_NAME "spring"
#define MODEL_TOKEN SPRING_TOKEN
#define MODEL_TOLERANCE 1e-06
#define MODEL_STEP_FRACTION 0.01
#ifndef MODEL_FIXED_STEP /* a test asks for fixed steps */
#define MODEL_FIXED_STEP 0.0
#endif
#define PLANT_ARG 6
#define PLANT_RES 3
#define PLANT_IW 1
#define PLANT_W 1
static const char *const NAMES[] = {"time", "x",    "v",         "der(x)",  "der(v)",  "force",
                                    "mass", "stiffness", "damping", "gravity", "tension", "power"};
static const double X_START[] = {0.0, 0.0}; /* at the end of the unloaded spring, at rest */
static const double X_NOMINAL[] = {0.1, 1.0};
static const double U_START[] = {0.0};
static const double U_MIN[] = {-100.0};
static const double U_MAX[] = {100.0};
static const double P_START[] = {1.0, 100.0, 2.0, 10.0};
static const double P_MIN[] = {1e-6, 0.0, 0.0, 0.0};
static const double P_MAX[] = {INFINITY, INFINITY, INFINITY, INFINITY};
static const int P_TUNABLE[] = {0, 1, 1, 0};
#endif

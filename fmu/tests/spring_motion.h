/* The motion of the example spring in closed form: mass m, stiffness k, damping d, gravity g, from
   rest at x = 0, under the outer force F + r t. */
#ifndef SPRING_MOTION_H
#define SPRING_MOTION_H

#include <math.h>

typedef struct {
    double m, k, d, g, F, r;
} Spring;

static const Spring EXAMPLE = {1.0, 100.0, 2.0, 10.0, 0.0, 0.0};

/* Underdamped: the ramp's own motion, and a decaying oscillation that meets x = v = 0 at t = 0. */
static void spring_motion(Spring s, double t, double *x, double *v) {
    const double decay = s.d / (2.0 * s.m), omega = sqrt(s.k / s.m - decay * decay);
    const double slope = s.r / s.k, level = (s.m * s.g + s.F - s.d * slope) / s.k;
    const double a = -level, b = (-slope + decay * a) / omega;
    const double e = exp(-decay * t), co = cos(omega * t), si = sin(omega * t);
    *x = level + slope * t + e * (a * co + b * si);
    *v = slope + e * ((b * omega - decay * a) * co - (a * omega + decay * b) * si);
}

#endif

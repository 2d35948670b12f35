/* What a user of the played motion must know: its token and its value references. */
#ifndef MOTION_EXAMPLE_H
#define MOTION_EXAMPLE_H

#define MOTION_TOKEN "{c94d1a35-8e07-4b6f-b2d3-60a7f18e4c92}"

enum { TIME, CLOCK, DER_CLOCK, LEVEL, CURVE };

#endif

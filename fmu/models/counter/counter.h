/* A sampled block written by hand: it sums up an error, and counts. Shared by the model and its tests. */
#ifndef COUNTER_H
#define COUNTER_H

#define COUNTER_TOKEN "{3f0a7c52-8b44-4d0e-9a51-6c2f1e7d9b03}"
#define COUNTER_PERIOD 0.01
#define COUNTER_GAIN 2.0

/* value references; the clock is one of FMI 3 only */
enum { MEASURED = 1, REFERENCE, GAIN, OFFSET, COMMAND, COUNT, DROPPED, CLOCK };

#endif

/* What every test program shares: a check that says where it failed and goes on. */
#ifndef CHECK_H
#define CHECK_H

#include <math.h>
#include <stdio.h>

static int failures = 0;

#define CHECK(condition)                                                                           \
    do {                                                                                           \
        if (!(condition)) failures++, printf("%s:%d: %s\n", __FILE__, __LINE__, #condition);       \
    } while (0)

/* Nearer than a distance; what is not a number is near to nothing. */
#define NEAR(value, expected, distance)                                                            \
    do {                                                                                           \
        const double is_ = (value), should_ = (expected);                                          \
        if (!(fabs(is_ - should_) <= (distance)))                                                  \
            failures++, printf("%s:%d: %s is %.17g, not %.17g\n", __FILE__, __LINE__, #value, is_, \
                               should_);                                                           \
    } while (0)

static int verdict(void) {
    printf("%d failures\n", failures);
    return failures != 0;
}

#endif

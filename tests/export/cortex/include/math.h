#ifndef MATH_H
#define MATH_H
#define NAN (__builtin_nanf(""))
#define INFINITY (__builtin_inff())
#define fabs __builtin_fabs
double sqrt(double x);
#endif

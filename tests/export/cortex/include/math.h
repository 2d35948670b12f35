#ifndef MATH_H
#define MATH_H
#define NAN (__builtin_nanf(""))
#define INFINITY (__builtin_inff())
#define fabs __builtin_fabs
double sqrt(double x);
double floor(double x);
/* declared only: what calls it compiles, and needs a C library to run */
double pow(double x, double y);
float sqrtf(float x);
float floorf(float x);
float powf(float x, float y);
#define fabsf __builtin_fabsf
#endif

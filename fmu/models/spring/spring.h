/* What a user of the spring must know: its token and its value references. */
#ifndef SPRING_H
#define SPRING_H

#define SPRING_TOKEN "{7b2a6f0e-53c1-4d8e-9a64-5f0d1c3e8b21}"

enum { TIME, X, V, DER_X, DER_V, FORCE, MASS, STIFFNESS, DAMPING, GRAVITY, TENSION, POWER };

#endif

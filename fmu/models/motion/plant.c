/* The runtime plays; motion_data.h beside this file says what. */
#include "motion.c"

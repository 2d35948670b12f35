/* Three pieces: level jumps from 1 to 3 at 0.25 s and to -2 at 0.75 s; curve is t^2 up to 0.25 s, its
   tangent after that up to 0.75 s, then constant, without a jump. */
#define MOTION_PIECES 3
#define MOTION_TERMS 3
#define MODEL_JUMPS 1
static const double MOTION_BREAKS[] = {0.0, 0.25, 0.75, 1.0};
/* piece by piece, power by power of the time since its break: level, curve */
static const double MOTION_TABLE[] = {
    1.0,  0.0,    0.0, 0.0, 0.0, 1.0, /* 1, s^2 */
    3.0,  0.0625, 0.0, 0.5, 0.0, 0.0, /* 3, 1/16 + s/2 */
    -2.0, 0.3125, 0.0, 0.0, 0.0, 0.0, /* -2, 5/16 */
};

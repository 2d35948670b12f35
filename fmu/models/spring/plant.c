/* A mass that hangs on a spring, by hand, in the form in which CasADi writes a plant: arg and res
   point to the vectors of arguments and results; iw, w and mem are scratch memory, unused here.

     der(x) = v,   der(v) = gravity + (force - stiffness x - damping v)/mass
     tension = stiffness x,   power = force v */

static int plant_rhs(const double **arg, double **res, int *iw, double *w, int mem) {
    const double *x = arg[0], *u = arg[1], *p = arg[2];
    res[0][0] = x[1];
    res[0][1] = p[3] + (u[0] - p[1] * x[0] - p[2] * x[1]) / p[0];
    return 0;
}

static int plant_outputs(const double **arg, double **res, int *iw, double *w, int mem) {
    const double *x = arg[0], *u = arg[1], *p = arg[2];
    res[0][0] = p[1] * x[0];
    res[0][1] = u[0] * x[1];
    return 0;
}

/* The derivatives, and df/dx by columns. */
static int plant_linearize(const double **arg, double **res, int *iw, double *w, int mem) {
    const double *p = arg[2];
    plant_rhs(arg, res, iw, w, mem);
    res[1][0] = 0.0;
    res[1][1] = -p[1] / p[0];
    res[1][2] = 1.0;
    res[1][3] = -p[2] / p[0];
    return 0;
}

/* d(f, g) along dx, du, dp. */
static int plant_forward(const double **arg, double **res, int *iw, double *w, int mem) {
    const double *x = arg[0], *u = arg[1], *p = arg[2], *dx = arg[3], *du = arg[4], *dp = arg[5];
    const double total = u[0] - p[1] * x[0] - p[2] * x[1];
    const double dtotal = du[0] - dp[1] * x[0] - p[1] * dx[0] - dp[2] * x[1] - p[2] * dx[1];
    res[0][0] = dx[1];
    res[0][1] = dp[3] + dtotal / p[0] - total / (p[0] * p[0]) * dp[0];
    res[1][0] = dp[1] * x[0] + p[1] * dx[0];
    res[1][1] = du[0] * x[1] + u[0] * dx[1];
    return 0;
}

/* The transpose: bf and bg, weights of f and g, give those of x, u, p. */
static int plant_reverse(const double **arg, double **res, int *iw, double *w, int mem) {
    const double *x = arg[0], *u = arg[1], *p = arg[2], *bf = arg[3], *bg = arg[4];
    const double total = u[0] - p[1] * x[0] - p[2] * x[1], share = bf[1] / p[0];
    res[0][0] = -p[1] * share + bg[0] * p[1];
    res[0][1] = bf[0] - p[2] * share + bg[1] * u[0];
    res[1][0] = share + bg[1] * x[1];
    res[2][0] = -total / p[0] * share;
    res[2][1] = -x[0] * share + bg[0] * x[0];
    res[2][2] = -x[1] * share;
    res[2][3] = bf[1];
    return 0;
}

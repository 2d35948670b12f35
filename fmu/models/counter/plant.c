/* next = (sum + error, count + 1, dropped + missing), y = (gain sum + offset, count, dropped): as
   CasADi would generate it. A measurement that is not a number leaves the sum as it is. */
static int block_step(const double **arg, double **res, int *iw, double *w, int mem) {
    const double *memory = arg[0], *u = arg[1], *p = arg[2];
    const double error = u[1] - u[0];
    const int missing = error != error;
    const double sum = missing ? memory[0] : memory[0] + error;
    res[0][0] = sum;
    res[0][1] = memory[1] + 1.0;
    res[0][2] = memory[2] + missing;
    res[1][0] = p[0] * sum + p[1];
    res[1][1] = memory[1] + 1.0;
    res[1][2] = memory[2] + missing;
    return 0;
}

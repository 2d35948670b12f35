"""Methods without physics: Newton, continuation, collocation, Runge-Kutta, Rosenbrock."""

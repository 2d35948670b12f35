"""python-control: a NonlinearIOSystem in NumPy, input_output_response by LSODA or RK45."""

import sys

import control
import equations as e
import numpy as np


def main():
    method = sys.argv[1] if len(sys.argv) > 1 else "LSODA"
    begin, seconds = e.clock(), []
    system = control.NonlinearIOSystem(
        lambda t, z, u, _: np.array(e.slopes(*z, *u)), None, inputs=2, states=4, outputs=4
    )
    commands = np.array([e.command(t) for t in e.TIMES]).T
    settings = {"rtol": 1e-8, "atol": 1e-10}
    for again in range(3):
        ready = e.clock()
        run = control.input_output_response(
            system,
            e.TIMES,
            commands,
            e.REST,
            solve_ivp_method=method,
            solve_ivp_kwargs=settings,
        )
        done = e.clock()
        seconds.append(done - ready)
        if not again:
            first = done, done - begin
    e.say(f"python-control: {method}", first, min(seconds), states=run.states.tolist())


main()

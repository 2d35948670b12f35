"""python-control: a NonlinearIOSystem in NumPy, input_output_response by LSODA or RK45."""

import sys

import control
import equations as e
import numpy as np


def main():
    method = sys.argv[1] if len(sys.argv) > 1 else "LSODA"
    begin = e.clock()
    system = control.NonlinearIOSystem(
        lambda t, z, u, _: np.array(e.slopes(*z, *u)), None, inputs=2, states=4, outputs=4
    )
    commands = np.array([e.command(t) for t in e.TIMES]).T
    settings = {"solve_ivp_method": method, "solve_ivp_kwargs": {"rtol": 1e-8, "atol": 1e-10}}
    first, best, run = e.repeated(
        lambda: control.input_output_response(system, e.TIMES, commands, e.REST, **settings), begin
    )
    e.say(f"python-control: {method}", first, best, states=run.states.tolist())


main()

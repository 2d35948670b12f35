"""simulate of pam_ocp, interpreted or compiled."""

import sys

import equations as e
import numpy as np
from pam_ocp_slide import slide

import pam_ocp as pam


def main():
    compiled = sys.argv[1:] == ["compiled"]
    begin, seconds = e.clock(), []
    plant = slide()
    commands = 1e5 * np.array([e.command(t) for t in e.TIMES]).T
    size = np.array([1, 1, 1e5, 1e5])
    names = [s.name for s in plant.states]
    for again in range(6):
        ready = e.clock()
        run = pam.simulate(
            plant,
            dict(zip((u.name for u in plant.inputs), commands, strict=True)),
            t=e.TIMES,
            start=dict(zip(names, e.REST * size, strict=True)),
            interpolation="linear",
            rtol=1e-8,
            compiled=compiled,
        )
        done = e.clock()
        seconds.append(done - ready)
        if not again:
            first = done, done - begin
    states = (run.array(run.named("state")) / size).T
    e.say(
        f"pam_ocp: simulate{', compiled' if compiled else ''}",
        first,
        min(seconds),
        states=states.tolist(),
    )


main()

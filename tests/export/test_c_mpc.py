"""C code of model predictive control: the bits of Python, nothing allocated."""

from __future__ import annotations

import numpy as np
import pytest
from c_program import Program, needs_compiler

import pam_ocp as pam
from pam_ocp.control import BlockController, Mpc, block

COMMANDS = ("muscle1.command", "muscle2.command")


def regulated() -> Mpc:
    slide = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10, feed=pam.feeds.Regulator(0.05)
    )
    rate = dict.fromkeys(COMMANDS, 0.1)
    return Mpc(slide, horizon=12, sample_time=5e-3, track={"x": 1.0}, rate=rate, iterations=2)


def valved() -> Mpc:
    """Spool valves with a dead zone, and a muscle with memory."""
    load = pam.HangingLoad(
        pam.muscle("DMSP-20-400N"),
        mass=20.0,
        feed=pam.feeds.SpoolValve(overlap=0.1),
        losses=pam.losses.BoucWen(),
    )
    return Mpc(
        load,
        horizon=10,
        sample_time=5e-3,
        track={"x": 1.0},
        rate={"muscle.command": 0.02},
        iterations=1,
        method="rosenbrock",
        substeps=2,
    )


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("make", "at"), [(regulated, 0.0), (valved, 0.04)])
def test_a_loop_is_the_same_bit_for_bit(make, at, tmp_path):
    mpc = make()
    made = block(mpc, plant=mpc.plant)

    def told(t):
        return {"wanted.x": at + 0.005 * np.sin(6.0 * t)}

    pam.export_c(made, tmp_path / "c", name="under_test", steps=5, tolerance=1e-9)
    sides = BlockController(made, told), Program(tmp_path / "c", "under_test", made, told)
    start = mpc.plant.equilibrium(x=at, stiffness=2e4) if at == 0.0 else mpc.plant.equilibrium(x=at)
    one, other = (
        pam.closed_loop(side, mpc.plant, duration=0.3, start=start, noise={"x": 1e-6})
        for side in sides
    )
    assert np.ptp(one["x"]) > 2e-3
    for name in ("x", *(v.name for v in mpc.plant.inputs)):
        assert np.array_equal(one[name], other[name])

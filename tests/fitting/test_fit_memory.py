"""Losses and the muscle's body are found back from a synthetic record, within their intervals."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import noisy_record

import pam_ocp as pam
from pam_ocp.core.errors import InputError
from pam_ocp.simulation.integrate import Integration

MUSCLE = pam.muscle("DMSP-20-200N")
LAW = pam.laws.with_ends(pam.laws.with_bladder(MUSCLE.law, 3e4), 0.05, 1.05, 60.0)
BODY = replace(MUSCLE, law=LAW)
CASES = {
    "force-velocity": (
        MUSCLE,
        pam.losses.ForceVelocity(),
        {"muscle.velocity_contracting_per_pressure": 1.4, "muscle.velocity_relaxing": 0.7},
    ),
    "bladder and ends": (BODY, (), {"muscle.threshold": 1.3, "muscle.tube": 0.6}),
}


def record(plant, seed):
    """4 s under six sines of pressure, with noise on position (20 um) and pressure (2 mbar)."""
    rng = np.random.default_rng(seed)
    t = np.arange(0, 4, 0.01)
    sines = [np.sin(w * t + rng.uniform(0, 6)) for w in (2, 3.7, 5.1, 9, 14, 23)]
    command = 2.4e5 + 4e4 * np.sum(sines, axis=0)
    started = plant.with_values(plant.equilibrium({"muscle.command": command[0]}))
    given = pam.Trajectory(t, {"muscle.command": command}, [plant.variable("muscle.command")])
    motion = pam.simulate(started, inputs=given)
    told = {"muscle.command": np.interp(motion.t, t, command)}
    noise = {"x": 2e-5, "muscle.pressure": 200.0}
    return started, noisy_record(plant, motion, told, noise, rng, None)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_truth_lies_within_the_intervals(case):
    muscle, losses, free = CASES[case]
    plant = pam.HangingLoad(muscle, 10.0, losses=losses)
    started, measured = record(plant, seed=3)
    elsewhere = started.with_values({n: plant.variable(n).start * f for n, f in free.items()})
    fit = pam.fit_plant(elsewhere, measured, list(free))
    for name, (low, high) in fit.intervals(0.99).items():
        true = plant.variable(name).start
        assert low < true < high
        assert high - low < 0.05 * true


# ---- memories whose kinks no polynomial follows -----------------------------------------------


@pytest.mark.parametrize(
    ("loss", "free"),
    [
        pytest.param(
            pam.losses.MaxwellSlip((8.0, 12.0), (0.004, 0.02)),
            ["slip1_force", "slip2_force"],
            marks=pytest.mark.slow,
        ),
        (pam.losses.BoucWen(), ["hysteresis_force"]),
        (
            pam.losses.PrandtlIshlinskii((10.0,), (6.0,), (0.01,)),
            ["play1_contracting", "play1_relaxing"],
        ),
        (pam.losses.Preconditioning(), ["softening_stiffness"]),
    ],
)
def test_memories_are_found_back_by_simulation(loss, free):
    feed = pam.feeds.Regulator(0.03)
    plant = pam.HangingLoad("DMSP-20-200N", 10.0, damping=60.0, feed=feed, losses=loss)
    names = [f"muscle.{n}" for n in free]
    draw = np.random.default_rng(20261122)
    t = np.arange(0, 0.8, 0.01)
    command = np.repeat(draw.uniform(1.2e5, 4.5e5, 8), 10)
    start = {"x": 0.03, "muscle.pressure": 3e5}
    run = pam.simulate(plant, {"muscle.command": (t, command)}, t=t, start=start, rtol=1e-11)
    noise = {"x": 2e-5, "muscle.pressure": 500.0}
    record = noisy_record(plant, run, {"muscle.command": command}, noise, draw)
    truth = {n: plant.variable(n).start for n in names}
    beside = plant.with_values({n: 0.7 * v for n, v in truth.items()})
    fit = pam.fit_plant(beside, record, names)
    assert fit.method == "simulation"
    assert fit.adequacy.adequate
    for name, (low, high) in fit.intervals(level=0.999).items():
        if name in truth:
            assert low < truth[name] < high
            assert high - low < 0.2 * truth[name]


def test_runs_are_the_same_where_there_is_no_compiler(monkeypatch):
    plant = pam.HangingLoad("DMSP-20-200N", 10.0, damping=60.0, losses=pam.losses.BoucWen())
    t = np.arange(0, 0.2, 0.01)
    command = np.where(t < 0.1, 2e5, 4e5)
    run = pam.simulate(plant, {"muscle.command": (t, command)}, t=t, rtol=1e-11)
    given = {"muscle.command": command, "x": run["x"]}
    record = pam.Trajectory(t, given, [plant.variable(n) for n in given], "previous")
    beside = plant.with_values(damping=0.8 * plant.variable("damping").start)
    ask = {"noise": {"x": 1e-5}, "method": "simulation"}
    fits = [pam.fit_plant(beside, record, ["damping"], **ask)]

    def refused(plant):
        raise InputError("no compiler here")

    monkeypatch.setattr(Integration, "built", refused)
    fits.append(pam.fit_plant(beside, record, ["damping"], **ask))
    one, other = (fit.coefficients["damping"] for fit in fits)
    assert one.value == pytest.approx(plant.variable("damping").start, rel=1e-4)
    assert other.value == pytest.approx(one.value, rel=1e-8)

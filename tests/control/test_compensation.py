"""Hysteresis compensated by feed-forward through the inverse of the memory."""

import casadi as ca
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.control import HysteresisCompensation
from pam_ocp.control.blocks.draft import Draft
from pam_ocp.control.blocks.running import Running
from pam_ocp.control.compensation import MemoryModel, Rounded, _PressureInputs
from pam_ocp.core.errors import InputError

L = pam.losses
MUSCLE = pam.muscle("DMSP-20-400N")
STEP = 4e-3


def triangle(middle, amplitude, frequency=0.5):
    """From its lower end up, and back."""
    return lambda t: middle + amplitude * (1 - 2 * abs(1 - 2 * (frequency * t % 1.0)))


def missed(plant, path, compensate, stiffness=None, **more):
    """Root mean square of the tracking error, once the first stroke is over."""
    start = plant.equilibrium({"x": path(0.0)} | ({"stiffness": stiffness} if stiffness else {}))
    how = {"sample_time": STEP, "compensate": compensate, **more}
    controller = HysteresisCompensation(plant.with_values(start), **how)
    run = pam.closed_loop(controller, plant, {"x": path}, duration=3.0, start=start, rtol=1e-7)
    return float(np.sqrt(np.mean((run["x"] - run.reference["x"])[run.t > 1.0] ** 2)))


LOSSES = [
    L.PrandtlIshlinskii(per_pressure=3e-6),
    pytest.param(L.MaxwellSlip(), marks=pytest.mark.slow),
    pytest.param((L.BoucWen(), L.Creep((300.0,), (1.0,))), marks=pytest.mark.slow),
]


@pytest.mark.parametrize("loss", LOSSES, ids=["play", "maxwell-slip", "bouc-wen and creep"])
def test_a_triangle_is_tracked_at_least_four_times_better(loss):
    plant = pam.HangingLoad(MUSCLE, 15.0, losses=loss)
    path = triangle(0.05, 0.015)
    without, compensated = (missed(plant, path, c) for c in (False, True))
    assert compensated < without / 4
    assert compensated < 2e-4


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_random_plants_and_feeds_are_tracked_at_least_four_times_better(seed):
    rng = np.random.default_rng(700 + seed)
    n = rng.integers(1, 4)
    forces, yields = rng.uniform(4, 15, (2, n)), rng.uniform(0.002, 0.02, n)
    loss = L.PrandtlIshlinskii(*forces, yields, *rng.uniform(-1, 3, 2))
    slow = pam.feeds.Regulator(rng.uniform(0.02, 0.1))
    valves = pam.feeds.SpoolValve(), pam.feeds.OnOffValves()
    feed = (valves[0], slow, valves[1], pam.feeds.IdealPressure())[seed]
    more = {"frequency": rng.choice([0.0, 1.0])}
    if seed % 2:
        plant = pam.HangingLoad(MUSCLE, rng.uniform(5, 30), losses=loss, feed=feed)
        path = triangle(0.048, 0.016)
    else:
        plant = pam.AntagonisticSlide(MUSCLE, rng.uniform(1, 5), losses=loss, feed=feed)
        path = triangle(0.0, 0.012)
        middle = plant.equilibrium({"x": 0.0, "muscle1.pressure": 3.2e5})
        more["stiffness"] = middle["stiffness"]
    without, compensated = (missed(plant, path, c, **more) for c in (False, True))
    assert compensated < without / 4


def test_the_memory_along_a_motion_is_that_of_the_sharp_operator():
    loss = L.PrandtlIshlinskii(edge=0.01)
    plant = pam.HangingLoad(MUSCLE, 15.0, losses=loss, feed=pam.feeds.IdealPressure())
    model, operator = MemoryModel(plant, "x", "v"), loss.elements()
    way, memory = ca.MX.sym("way", 2), ca.MX.sym("memory", len(model.values))
    pressure = {"muscle.pressure": plant.variable("muscle.pressure").start}
    after = model.moved(memory, (way[0], way[1]), pressure, 0.01)
    move = ca.Function("move", [memory, way], [after])
    here, kept = plant.variable("x").start, np.array([*model.values.values()])
    assert set(model.values.values()) == {0.0}
    for x in (0.002, 0.008, 0.03, 0.06, 0.055, 0.03, 0.034, 0.02):
        for part in np.linspace(here, x, 30)[1:]:
            kept, here = np.asarray(move(kept, [here, part])).ravel(), float(part)
        largest = [c * (1 + 2 * 0.279) for c in loss.contracting]
        force = sum(f * z for f, z in zip(largest, kept, strict=True))
        assert force == pytest.approx(operator.force(x / 0.4), abs=0.05)


def test_a_corner_is_rounded_within_the_kernel_and_a_line_stays():
    path = Rounded(lambda t: abs(t - 1.0), 0.1, preview=True)
    x, v, a = path(0.5)
    assert (x, v, a) == pytest.approx((0.5, -1.0, 0.0), abs=1e-12)
    x, v, a = path(1.0)
    assert x == pytest.approx(0.1 / 3, rel=1e-9)  # integral of (1 - |s|) |s| h
    assert v == pytest.approx(0.0, abs=1e-12)
    assert a == pytest.approx(2 / 0.1, rel=1e-9)
    assert Rounded(lambda t: t, 0.1, preview=False)(1.0)[0] == pytest.approx(0.9)


def test_inputs_give_a_pressure_the_rate_that_was_asked_whatever_feeds_it():
    for feed in (pam.feeds.Regulator(0.08), pam.feeds.SpoolValve(), pam.feeds.OnOffValves()):
        plant = pam.HangingLoad(MUSCLE, 15.0, feed=feed)
        draft = Draft("inputs", 0.02, "", ca.MX)
        target = draft.input("wanted.pressure"), draft.input("wanted.rate")
        _PressureInputs(plant, ["muscle"]).enter(draft, {"muscle": target}, 0.02)
        inputs = Running(draft.block())
        state = {v.name: v.start for v in plant.states} | {"muscle.pressure": 2e5, "v": 0.05}
        for rate in (-3e5, 2e5, 6e5):
            inputs.measure(state)
            inputs.tell({"wanted.pressure": 2e5, "wanted.rate": rate})
            sent = inputs.commands()
            u = plant.vector("input", sent)
            xdot = plant.function(plant.vector("state", state), u, plant.vector("parameter"))[0]
            at = [v.name for v in plant.states].index("muscle.pressure")
            assert float(xdot[at]) == pytest.approx(rate, rel=1e-6)


def test_what_it_cannot_track_is_refused():
    plant = pam.HangingLoad(MUSCLE, 15.0, losses=L.MaxwellSlip())
    controller = HysteresisCompensation(plant)
    with pytest.raises(InputError, match="v is not tracked; give x"):
        pam.closed_loop(controller, plant, {"v": 0.0}, duration=0.1)
    refused("no choice of it", HysteresisCompensation, plant, stiffness=1e4)
    refused("relative degree", HysteresisCompensation, pam.SeriesLoad(MUSCLE))

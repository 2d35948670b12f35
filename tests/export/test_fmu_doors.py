"""An FMU at its doors: steps and states that cannot be are refused, and change nothing."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmu_tools import DISCARD, ERROR, VERSIONS, now, opened, started

import pam_ocp as pam
from pam_ocp.core.units import unit
from pam_ocp.export.runner import Runner, UnpackedFmu

HEADER = 80  # bytes before the memory of an instance: 8 zeros, magic, version and size, sum, token


def oscillator(**values: float) -> pam.Plant:
    """x'' = f - x, an output that holds the input itself, an unused parameter of a range."""
    plant = pam.Plant("oscillator")
    x, v = plant.state("x", unit="m", start=1.0), plant.state("v", unit="m/s")
    f = plant.input("f", unit="N")
    k = plant.parameter("k", 1.0, unit="N/m", min=0.5, max=2.0, tunable=True)
    plant.der(x, v)
    plant.der(v, f - k * x)
    plant.output("sum", 3.0 * f + f * f + 2.0 * x, unit="N")
    return plant.with_values(values)


@pytest.fixture(scope="module", params=VERSIONS)
def fixed(request: Any, tmp_path_factory: pytest.TempPathFactory) -> UnpackedFmu:
    folder = tmp_path_factory.mktemp("fixed")
    return opened(oscillator(), folder, request.param, fixed_step=1e-2)


@pytest.fixture(scope="module", params=VERSIONS)
def free(request: Any, tmp_path_factory: pytest.TempPathFactory) -> UnpackedFmu:
    return opened(oscillator(), tmp_path_factory.mktemp("free"), request.param)


def refused(runner: Runner, status: int, call: Any, *arguments: Any) -> str:
    """The sentence with which a call is refused; time and states stay."""
    before, said = [now(runner), *runner.get(["x", "v"])], len(runner.log)
    with pytest.raises(FMICallException) as caught:
        call(*arguments)
    assert caught.value.status == status
    assert [now(runner), *runner.get(["x", "v"])] == before
    assert len(runner.log) == said + 1
    return runner.log[-1][1]


# ---- steps ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e6, 1e15, 1e300])
def test_a_step_of_too_many_fixed_steps_is_discarded_with_its_sentence(fixed, size):
    with started(fixed, "CoSimulation") as runner:
        runner.step(0.0, 0.05)
        assert "too many internal steps" in refused(runner, DISCARD, runner.step, 0.05, size)
        runner.step(0.05, 0.05)
        assert runner.get(["x"])[0] == pytest.approx(math.cos(0.1), abs=1e-6)


@pytest.mark.parametrize(
    ("point", "size"),
    [
        *((0.0, size) for size in (0.0, -0.01, math.nan, math.inf)),
        *((point, 0.01) for point in (math.nan, math.inf, -1.0, 1e15, -1e300)),
        *((0.5, size) for size in (1e-300, 1e-17)),
    ],
)
def test_points_and_lengths_that_cannot_be_are_refused(fixed, free, point, size):
    for fmu in (fixed, free):
        with started(fmu, "CoSimulation") as runner:
            runner.step(0.0, 0.5)
            at = 0.5 if point == 0.0 else point
            refused(runner, ERROR, runner.step, at, size)
            runner.step(0.5, 0.01)


@pytest.mark.parametrize("time", [math.nan, math.inf, -math.inf])
def test_a_time_that_is_not_finite_is_refused(free, time):
    with started(free, "ModelExchange") as runner:
        refused(runner, ERROR, runner.inner.setTime, time)
    with Runner(free, "CoSimulation") as runner, pytest.raises(FMICallException):
        runner.initialize({}, time, None)


# ---- slopes and units ----------------------------------------------------------------------------


def test_the_slope_of_an_output_holds_what_its_inputs_do(tmp_path):
    """d(3 f + f^2 + 2 x)/dt = (3 + 2 f) f' + 2 v, with f = 1 + 0.4 t."""
    fmu = opened(oscillator(), tmp_path)
    with started(fmu, "CoSimulation") as runner:
        runner.set({"f": 1.0})
        runner.inner.setRealInputDerivatives(runner.references(["f"]), [1], [0.4])
        runner.step(0.0, 0.5)
        f, v = 1.2, runner.get(["v"])[0]
        assert runner.get(["f"])[0] == pytest.approx(f)
        (slope,) = runner.inner.getRealOutputDerivatives(runner.references(["sum"]), [1])
        assert slope == pytest.approx((3 + 2 * f) * 0.4 + 2 * v, rel=1e-12)
        runner.step(0.5, 0.5)  # no slope given: the input is held, and so is its share
        (slope,) = runner.inner.getRealOutputDerivatives(runner.references(["sum"]), [1])
        assert slope == pytest.approx(2 * runner.get(["v"])[0], rel=1e-12)


def test_equal_steps_follow_an_input_that_rises(tmp_path):
    """x' = f - x with f = f0 + s t: x = f - s + (x0 - f0 + s) exp(-t), to the fifth order in steps
    of 0.1 s.
    """
    plant = pam.Plant("lag")
    x, f = plant.state("x", nominal=1.0), plant.input("f", min=-10.0, max=10.0)
    plant.der(x, f - x)
    fmu = opened(plant, tmp_path, fixed_step=0.1)
    with started(fmu, "CoSimulation") as runner:
        runner.set({"f": 1.0})
        runner.inner.setRealInputDerivatives(runner.references(["f"]), [1], [4.0])
        runner.step(0.0, 0.1)
        assert runner.get(["x"])[0] == pytest.approx(1.4 - 4 + 3 * math.exp(-0.1), abs=1e-7)


def test_a_derivative_has_the_unit_of_its_state_per_second(fmi, tmp_path):
    states = {"m": "m/s", "m/s": "m/s2", "1": "1/s", "Pa": "Pa/s", "rad": "rad/s"}
    states |= {"N/m": "N/(m.s)", "kg/(m.s)": "kg/(m.s.s)"}
    plant = pam.Plant("united")
    for i, name in enumerate(states):
        plant.der(plant.state(f"s{i}", unit=name), 0.0)
    fmu = opened(plant, tmp_path, fmi)
    bases = {u.name: u.baseUnit for u in fmu.description.unitDefinitions}
    for i, expected in enumerate(states.values()):
        found = fmu.variables[f"der(s{i})"].unit
        assert unit(found).exponents == unit(expected).exponents
        base = {b: getattr(bases[found], b) for b in ("kg", "m", "s", "K", "rad")}
        assert {b: e for b, e in base.items() if e} == unit(expected).base_exponents


# ---- saved states --------------------------------------------------------------------------------


def sealed(state: bytearray) -> bytes:
    """The state with its checksum made good (FNV-1a): only what it says can give it away."""
    total = 14695981039346656037
    for byte in state[HEADER:]:
        total = ((total ^ byte) * 1099511628211) % 2**64
    state[24:32] = struct.pack("<Q", total)
    return bytes(state)


def saved(fmu: UnpackedFmu, kind: Any = "CoSimulation") -> bytes:
    with started(fmu, kind) as runner:
        if kind == "CoSimulation":
            runner.step(0.0, 0.1)
        content = runner.save()
    assert sealed(bytearray(content)) == content  # the layout is as this file takes it to be
    return content


def test_a_state_of_another_unit_is_refused_in_the_process_too(free, tmp_path):
    for name, plant in (("twin", oscillator(k=1.5)), ("big", pam.HangingLoad("DMSP-20-300"))):
        other = opened(plant, tmp_path / name, free.fmi)
        with started(free, "CoSimulation") as runner, started(other, "CoSimulation") as stranger:
            state = stranger.inner.getFMUState()
            assert "another FMU" in refused(runner, ERROR, runner.inner.setFMUState, state)
            assert "another FMU" in refused(runner, ERROR, runner.inner.serializeFMUState, state)
            assert "another FMU" in refused(runner, ERROR, runner.restore, stranger.save())
            stranger.inner.freeFMUState(state)


# offsets in the memory: kind, mode, time, stop, tolerance, step, x, v, f, k, slope, last slope
IMPOSSIBLE = [
    *(("kind", 0, value) for value in (2, -1)),
    *(("mode", 4, value) for value in (0, 48, 32, 8, -(2**31))),
    *(("time", place, math.nan) for place in (8, 16)),
    *(("tolerance", 24, value) for value in (0.0, math.inf)),
    ("step length", 32, -1.0),
    *(("a state", place, value) for place, value in ((40, math.nan), (48, -math.inf))),
    ("an input", 56, math.nan),
    *(("a parameter", 64, value) for value in (2.5, math.nan)),
    *(("a slope", place, value) for place, value in ((72, math.inf), (80, math.nan))),
]


@pytest.mark.parametrize(("what", "place", "value"), IMPOSSIBLE)
def test_a_state_that_no_instance_could_have_is_refused(free, what, place, value):
    content = bytearray(saved(free))
    struct.pack_into("<i" if place < 8 else "<d", content, HEADER + place, value)
    with started(free, "CoSimulation") as runner:
        assert what in refused(runner, ERROR, runner.restore, sealed(content))


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_of_two_thousand_damaged_states_none_harms_and_none_is_not_finite(free, kind):
    rng, good, accepted = np.random.default_rng(11), saved(free, kind), 0
    with started(free, kind) as runner:
        for i in range(2000):
            content, first = bytearray(good), 0 if i % 4 == 0 else HEADER
            for place in rng.integers(first, len(content), rng.integers(1, 9)):
                content[place] = rng.choice([0, 0x7F, 0xFF, 0xF0, rng.integers(256)])
            damaged = bytes(content) if i % 8 == 0 else sealed(content)
            runner.restore(good)
            try:
                runner.restore(damaged)
            except FMICallException:
                continue
            memory = np.frombuffer(damaged[HEADER + 40 :])
            accepted += 1
            assert np.all(np.isfinite(memory))
            assert 0.5 <= memory[3] <= 2.0
            assert runner.save() == damaged
    assert 0 < accepted < 1900  # a changed digit of a state is a state all the same

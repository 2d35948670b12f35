"""An FMU in motion: accuracy, steps, slopes of inputs and outputs, saved states, derivatives."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from conftest import BAR, benchmark_slide, flat, scipy_states
from fmpy.fmi1 import FMICallException
from fmu_tools import COMMANDS, KINDS, VERSIONS, bars_every, now, opened, started
from hostile import contents

import pam_ocp as pam
from pam_ocp.export import check_fmu, export_fmu
from pam_ocp.export.runner import Runner

# ---- accuracy ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "step", [0.001, *(pytest.param(step, marks=pytest.mark.slow) for step in (0.005, 0.02))]
)
def test_both_modes_agree_with_scipy_to_a_millionth_of_nominal(fmus, step):
    plant = benchmark_slide()
    t, commands = bars_every(step, 30 * step)
    held = lambda time: commands[min(int(time / step + 1e-9), len(t) - 1)]  # noqa: E731
    states = scipy_states(plant, held, t, rtol=1e-10)  # of 1e-6 below
    outputs = np.asarray(plant.function(states.T, commands.T, plant.vector("parameter"))[1]).T
    variables = (*plant.states, *plant.inputs, *plant.outputs)
    columns = np.hstack([states, commands, outputs]).T
    named = dict(zip((v.name for v in variables), columns, strict=True))
    truth = pam.Trajectory(t, named, variables, "previous")
    for unit in (fmus[fmi].folder.with_name(f"{fmi[0]}.fmu") for fmi in VERSIONS):
        found = check_fmu(unit, truth)
        assert found.ok, str(found)
        assert set(found.deviations) == set(KINDS)
        assert len(found.deviations["CoSimulation"]) == len(plant.states) + len(plant.outputs)
        assert found.largest < 1e-6
        # a power errs by its force and its velocity, and runs up to six nominals
        others = [d for of in found.deviations.values() for n, d in of.items() if "power" not in n]
        assert max(others) < 5e-7


@pytest.mark.slow
def test_linear_inputs_are_followed_in_every_mode(tmp_path):
    plant = pam.HangingLoad(pam.muscle("DMSP-20-400N"))
    t = np.linspace(0.0, 0.5, 26)
    command = np.random.default_rng(3).uniform(2 * BAR, 5 * BAR, t.shape)
    ramp = lambda time: [np.interp(time, t, command)]  # noqa: E731
    states = scipy_states(plant, ramp, t)
    columns = dict(zip([v.name for v in plant.states], states.T, strict=True))
    columns["muscle.command"] = command
    truth = pam.Trajectory(t, columns, (*plant.states, *plant.inputs), "linear")
    for fmi in VERSIONS:
        path = export_fmu(plant, tmp_path / "load.fmu", fmi=fmi, platforms="native")  # type: ignore[arg-type]
        assert check_fmu(path, truth).ok


def test_the_communication_step_does_not_matter(fmu):
    ends = []
    for count in (1, 7, 300):
        with started(fmu, "CoSimulation", {"x": 0.005}) as runner:
            runner.set({"muscle1.command": 5 * BAR})
            for i in range(count):
                runner.step(0.3 * i / count, 0.3 / count)
            ends.append(runner.get(fmu.names("output")) / fmu.nominals(fmu.names("output")))
    assert np.max(np.ptp(ends, axis=0)) < 1e-6


def test_a_tighter_tolerance_is_taken_over_and_a_looser_one_and_the_proposed_are_not(fmu):
    proposed, ends = float(fmu.description.defaultExperiment.tolerance), {}
    assert proposed == pytest.approx(1e-8)  # of one step
    for tolerance in (None, 1e-2, proposed, 1e-9):
        with Runner(fmu, "CoSimulation") as runner:
            runner.initialize({"x": 0.01}, 0.0, tolerance)
            runner.step(0.0, 0.05)
            ends[tolerance] = tuple(runner.get(["x", "v"]))
    assert ends[1e-2] == ends[proposed] == ends[None]
    assert ends[1e-9] != ends[None]


def test_fixed_steps_agree_with_controlled_ones(tmp_path):
    plant, t = benchmark_slide(), np.linspace(0, 0.1, 101)
    truth = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=t)
    path = export_fmu(plant, tmp_path / "slide.fmu", fmi="3.0", fixed_step=5e-4, platforms="native")
    assert check_fmu(path, truth).ok
    assert b'fixedInternalStepSize="0.0005"' in contents(path)["modelDescription.xml"]


# ---- FMI 2: slopes of inputs and outputs; FMI 3: intermediate updates ----------------------------


def test_output_derivatives_are_those_of_the_motion(fmu):
    outputs, h = fmu.names("output"), 1e-5
    references = [fmu.references[n] for n in outputs]
    with started(fmu, "CoSimulation", {"x": 0.005}) as runner:
        runner.set({"muscle1.command": 5 * BAR})
        runner.step(0.0, 0.02)
        orders = [1] * len(outputs)
        if fmu.fmi == "2.0":
            slopes = np.array(runner.inner.getRealOutputDerivatives(references, orders))
        else:
            slopes = np.array(runner.inner.getOutputDerivatives(references, orders))
        before = runner.get(outputs)
        runner.step(0.02, h)
        middle = runner.get(outputs)
        runner.step(0.02 + h, h)
        after = runner.get(outputs)
    differences = (-3 * before + 4 * middle - after) / (2 * h)  # second order, one-sided
    assert slopes == pytest.approx(differences, rel=1e-4, abs=1e-6 * np.max(np.abs(slopes)))


def test_an_importer_may_look_between_internal_steps_and_end_a_step_early(fmus):
    fmu, seen = fmus["3.0"], []
    x = fmu.references["x"]

    def update(_: Any, time: float, may_set: bool, *told: Any) -> None:
        *allowed, requested, wish = told
        assert all(allowed)  # to get, of a step that is done, and to return early
        seen.append((time, runner.inner.getFloat64([x])[0]))
        requested[0] = len(seen) >= 2
        wish[0] = 0.0321

    with Runner(fmu, "CoSimulation") as runner:
        runner.inner.fmi3FreeInstance(runner.inner.component)
        runner.inner.instantiate(intermediateUpdate=update, earlyReturnAllowed=True)
        runner.initialize({"x": 0.01}, 0.0, None)
        _, _, early, reached = runner.inner.doStep(0.0, 0.3)
        assert early
        assert reached == pytest.approx(0.0321, abs=1e-15)
        assert [t for t, _ in seen] == sorted({t for t, _ in seen})
        end = runner.get(["time", "x"])
    assert end[0] == reached
    with started(fmu, "CoSimulation", {"x": 0.01}) as plain:
        plain.step(0.0, 0.0321)
        assert end[1] == pytest.approx(plain.get(["x"])[0], abs=1e-8)


# ---- events --------------------------------------------------------------------------------------

HELD, PARTS = 0.02, 25


def test_an_importer_that_restarts_when_asked_is_right_where_inputs_jump(tmp_path):
    """Model Exchange: its solver begins anew where values of states are said to have changed."""
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"))
    values = np.random.default_rng(31).uniform(0.5e5, 5.5e5, (PARTS, 2))
    held = dict(zip(COMMANDS, np.vstack([values, values[-1]]).T, strict=True))
    t = np.arange(PARTS + 1) * HELD
    truth = pam.simulate(plant, held, t=t, interpolation="previous", rtol=1e-11)
    names, unit = [v.name for v in plant.states], opened(plant, tmp_path, "2.0")
    scale = plant.vector("state", None, "nominal")

    def states(listens: bool) -> Any:
        begin = dict(zip(COMMANDS, values[0], strict=True))
        with started(unit, "ModelExchange", begin) as runner:
            solver, rows = runner.integrator(0.0, 1e-8, None), [runner.get(names)]
            for k in range(PARTS):
                if k:
                    runner.inner.enterEventMode()
                    runner.set(dict(zip(COMMANDS, values[k], strict=True)))
                    changed = runner.inner.newDiscreteStates()[3]
                    runner.inner.enterContinuousTimeMode()
                    if listens and changed:
                        solver.reset(k * HELD)
                solver.step(k * HELD, (k + 1) * HELD)
                rows.append(runner.get(names))
            return np.array(rows)

    def error(listens: bool) -> float:
        try:
            return float(np.max(np.abs(states(listens) - truth.array(names)) / scale))
        except RuntimeError:  # CVODE gives up
            return np.inf

    assert error(True) < 1e-5
    assert error(False) > 1e-2


# ---- saved states --------------------------------------------------------------------------------


def test_a_restored_state_continues_to_the_last_bit_in_another_instance(fmu):
    t, commands = bars_every(0.002, 0.1)
    outputs = fmu.names("output")

    def play(runner: Runner, low: int, high: int) -> Any:
        for k in range(low, high):
            runner.set(dict(zip(COMMANDS, commands[k], strict=True)))
            runner.step(t[k], t[k + 1] - t[k])
        return runner.get(outputs)

    with started(fmu, "CoSimulation", {"mass": 1.7}) as one:
        play(one, 0, 20)
        saved = one.save()
        end = play(one, 20, 50)
    with started(fmu, "CoSimulation") as other:
        other.restore(saved)
        assert np.array_equal(play(other, 20, 50), end)
        other.restore(saved)  # once more: a rollback
        assert np.array_equal(play(other, 20, 50), end)
    assert saved[:8] == bytes(8)


@pytest.mark.parametrize("place", [0, 9, 17, 21, 40, 100, -1])
def test_damaged_states_are_refused(fmu, place):
    with started(fmu, "CoSimulation") as runner:
        saved = bytearray(runner.save())
        saved[place] ^= 0xFF
        with pytest.raises(FMICallException):
            runner.restore(bytes(saved))
        with pytest.raises(FMICallException):
            runner.restore(bytes(saved[:-8]))
        assert len(runner.log) == 2
        runner.step(0.0, 0.01)  # and nothing has happened


def test_a_state_of_the_other_kind_is_refused(fmu):
    with started(fmu, "ModelExchange") as exchange, started(fmu, "CoSimulation") as simulation:
        with pytest.raises(FMICallException):
            simulation.restore(exchange.save())
        assert "Model Exchange" in simulation.log[-1][1]


def test_reset_brings_back_the_start(fmu):
    with started(fmu, "CoSimulation", {"x": 0.01, "mass": 1.0}) as runner:
        runner.step(0.0, 0.01)
        runner.inner.reset()
        runner.initialize({}, 0.0, None)
        assert list(runner.get(["x", "mass"])) == [0.0, 2.0]
        assert now(runner) == 0.0


# ---- many instances ------------------------------------------------------------------------------


def test_instances_do_not_disturb_each_other(fmu):
    t, commands = bars_every(0.005, 0.1)

    def alone(mass: float) -> Any:
        with started(fmu, "CoSimulation", {"mass": mass}) as runner:
            for k, (low, high) in enumerate(pairwise(t)):
                runner.set(dict(zip(COMMANDS, commands[k], strict=True)))
                runner.step(low, high - low)
            return runner.get(["x", "v"])

    runners = [started(fmu, "CoSimulation", {"mass": m}) for m in (1.0, 2.0, 4.0)]
    for k, (low, high) in enumerate(pairwise(t)):
        for runner in runners:
            runner.set(dict(zip(COMMANDS, commands[k], strict=True)))
            runner.step(low, high - low)
    together = [runner.get(["x", "v"]) for runner in runners]
    for runner in runners:
        runner.__exit__(None, None, None)
    assert np.array_equal(together, [alone(m) for m in (1.0, 2.0, 4.0)])


# ---- partial derivatives -------------------------------------------------------------------------


def _jacobian_by_differences(plant: pam.Plant, x: Any, u: Any) -> Any:
    """d(xdot, y)/d(x, u) by central differences of the plant's own function in Python."""
    p = plant.vector("parameter")
    nominal = [*plant.vector("state", None, "nominal"), *plant.vector("input", None, "nominal")]
    point = np.concatenate([x, u])

    def value(z: Any) -> Any:
        xdot, y, _ = plant.function(z[: len(x)], z[len(x) :], p)
        return np.concatenate([flat(xdot), flat(y)])

    steps = 1e-5 * np.array(nominal)
    apart = [value(point + step) - value(point - step) for step in np.diag(steps)]
    return np.array(apart).T / (2 * steps)


@pytest.mark.parametrize("kind", KINDS)
def test_directional_derivatives_agree_with_differences(fmu, kind):
    plant = benchmark_slide()
    x, u = np.array([0.004, 0.1, 2.5 * BAR, 3.5 * BAR]), np.array([3 * BAR, 2 * BAR])
    knowns = [*fmu.states, *COMMANDS]
    unknowns = [f"der({n})" for n in fmu.states] + [v.name for v in plant.outputs]
    expected = _jacobian_by_differences(plant, x, u)
    with started(fmu, kind, dict(zip(knowns, [*x, *u], strict=True))) as runner:
        for column, known in enumerate(knowns):
            found = runner.directional(unknowns, [known], [1.0])
            scale = np.max(np.abs(expected), axis=1)
            assert np.max(np.abs(found - expected[:, column]) / scale) < 1e-6
        with pytest.raises(FMICallException):
            runner.directional(unknowns, ["muscle1.force"], [1.0])


def test_states_are_outputs_of_themselves_and_parameters_are_known(fmu):
    with started(fmu, "ModelExchange") as runner:
        assert list(runner.directional(["x", "v"], ["v", "x"], [2.0, 5.0])) == [5.0, 2.0]
    with started(fmu, "ModelExchange", {"muscle1.command": 5 * BAR}) as runner:
        at = runner.get(["muscle1.pressure"])[0]
        slope = runner.directional(["der(muscle1.pressure)"], ["muscle1.lag"], [1.0])
        assert slope[0] == pytest.approx(-(5 * BAR - at) / 0.05**2)


def test_adjoint_and_directional_derivatives_agree_in_the_dot_product(fmus):
    fmu, rng = fmus["3.0"], np.random.default_rng(11)
    knowns = [*fmu.states, *fmu.names("input"), *fmu.names("parameter")]
    unknowns = [*fmu.names("output"), *fmu.states, *(f"der({n})" for n in fmu.states)]
    seed = rng.normal(size=len(knowns)) * fmu.nominals(knowns)
    weight = rng.normal(size=len(unknowns)) / fmu.nominals(unknowns)
    with started(fmu, "ModelExchange", {"x": 0.003}) as runner:
        forward = runner.directional(unknowns, knowns, list(seed))
        references = (runner.references(unknowns), runner.references(knowns))
        adjoint = runner.inner.getAdjointDerivative(*references, list(weight), len(knowns))
    reverse = np.array(adjoint)
    terms = np.concatenate([weight * forward, -reverse * seed])
    assert abs(np.sum(terms)) < 1e-12 * np.sum(np.abs(terms))

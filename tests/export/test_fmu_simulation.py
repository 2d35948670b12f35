"""An FMU in motion: accuracy, steps, slopes of inputs and outputs."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import BAR, benchmark_slide, scipy_states
from fmu_tools import KINDS, VERSIONS, bars_every, started

import pam_ocp as pam
from pam_ocp.export import check_fmu, export_fmu
from pam_ocp.export.runner import Runner, UnpackedFmu

# ---- accuracy ------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.001, pytest.param(0.005, marks=pytest.mark.slow), 0.02])
def test_both_modes_agree_with_scipy_to_a_millionth_of_nominal(
    fmus: dict[str, UnpackedFmu], step: float, tmp_path: Path
) -> None:
    plant = benchmark_slide()
    t, commands = bars_every(step, 30 * step)
    held = lambda time: commands[min(int(time / step + 1e-9), len(t) - 1)]  # noqa: E731
    states = scipy_states(plant, held, t, rtol=1e-10)  # of 1e-6 below
    outputs = np.asarray(plant.function(states.T, commands.T, plant.vector("parameter"))[1]).T
    variables = (*plant.states, *plant.inputs, *plant.outputs)
    columns = np.hstack([states, commands, outputs]).T
    truth = pam.Trajectory(
        t, dict(zip((v.name for v in variables), columns, strict=True)), variables, "previous"
    )
    for fmi in VERSIONS:
        path = export_fmu(plant, tmp_path / "slide.fmu", fmi=fmi, platforms="native")  # type: ignore[arg-type]
        found = check_fmu(path, truth)
        assert found.ok, str(found)
        assert set(found.deviations) == set(KINDS)
        assert len(found.deviations["CoSimulation"]) == len(plant.states) + len(plant.outputs)
        assert found.largest < 1e-6
        # a power errs by its force and its velocity, and runs up to six nominals
        others = [d for of in found.deviations.values() for n, d in of.items() if "power" not in n]
        assert max(others) < 5e-7


@pytest.mark.slow
def test_linear_inputs_are_followed_in_every_mode(tmp_path: Path) -> None:
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


def test_the_communication_step_does_not_matter(fmu: UnpackedFmu) -> None:
    ends = []
    for count in (1, 7, 300):
        with started(fmu, "CoSimulation", {"x": 0.005}) as runner:
            runner.set({"muscle1.command": 5 * BAR})
            for i in range(count):
                runner.step(0.3 * i / count, 0.3 / count)
            ends.append(runner.get(fmu.names("output")) / fmu.nominals(fmu.names("output")))
    assert np.max(np.ptp(ends, axis=0)) < 1e-6


def test_a_tighter_tolerance_is_taken_over_and_a_looser_one_is_not(fmu: UnpackedFmu) -> None:
    ends = {}
    for tolerance in (None, 1e-2, 1e-9):
        with Runner(fmu, "CoSimulation") as runner:
            runner.initialize({"x": 0.01}, 0.0, tolerance)
            runner.step(0.0, 0.05)
            ends[tolerance] = tuple(runner.get(["x", "v"]))
    assert ends[1e-2] == ends[None]
    assert ends[1e-9] != ends[None]


def test_an_importer_is_proposed_a_tolerance_of_one_step_which_co_simulation_does_not_take_over(
    fmu: UnpackedFmu,
) -> None:
    proposed = float(fmu.description.defaultExperiment.tolerance)
    assert proposed == pytest.approx(1e-8)
    ends = []
    for tolerance in (None, proposed):
        with Runner(fmu, "CoSimulation") as runner:
            runner.initialize({"x": 0.01}, 0.0, tolerance)
            runner.step(0.0, 0.05)
            ends.append(tuple(runner.get(["x", "v"])))
    assert ends[0] == ends[1]


def test_fixed_steps_agree_with_controlled_ones(tmp_path: Path) -> None:
    plant, t = benchmark_slide(), np.linspace(0, 0.1, 101)
    truth = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=t)
    path = export_fmu(plant, tmp_path / "slide.fmu", fmi="3.0", fixed_step=5e-4, platforms="native")
    assert check_fmu(path, truth).ok
    assert 'fixedInternalStepSize="0.0005"' in _description(path)


def _description(path: Path) -> str:
    with zipfile.ZipFile(path) as archive:
        return archive.read("modelDescription.xml").decode()


# ---- FMI 2: slopes of inputs and outputs; FMI 3: intermediate updates
# -----------------------------


def test_output_derivatives_are_those_of_the_motion(fmu: UnpackedFmu) -> None:
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


def test_an_importer_may_look_between_internal_steps_and_end_a_step_early(
    fmus: dict[str, UnpackedFmu],
) -> None:
    fmu, seen = fmus["3.0"], []
    x = fmu.references["x"]

    def update(
        environment: Any,
        time: float,
        set_: bool,
        get: bool,
        done: bool,
        may_return: bool,
        requested: Any,
        wish: Any,
    ) -> None:
        assert get
        assert done
        assert may_return
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

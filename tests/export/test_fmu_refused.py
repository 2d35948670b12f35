"""Calls that an FMU refuses: an error, a line in the log, and nothing has changed."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
import pytest
from conftest import BAR
from fmpy.fmi1 import FMICallException
from fmu_tools import DISCARD, ERROR, KINDS, VERSIONS, now, opened, started

import pam_ocp as pam
from pam_ocp.export.runner import Runner, UnpackedFmu, pointer


def refused(runner: Runner, words: str, call: Any, *arguments: Any, status: int = ERROR) -> None:
    lines = len(runner.log)
    with pytest.raises(FMICallException) as failure:
        call(*arguments)
    assert failure.value.status == status
    assert len(runner.log) == lines + 1
    assert runner.log[-1][0] == status
    assert words in runner.log[-1][1]


def test_a_wrong_token_is_refused(fmu):
    with pytest.raises(pam.SimulationError, match="do not belong together"):
        Runner(fmu, "CoSimulation", token="{00000000-0000-0000-0000-000000000000}")
    with started(fmu, "CoSimulation") as runner:  # the next one is not disturbed
        runner.step(0.0, 0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_bad_values_are_refused_with_the_name_of_the_variable(fmu, kind):
    with started(fmu, kind) as runner:
        write = runner.inner.setReal if fmu.fmi == "2.0" else runner.inner.setFloat64
        read = runner.inner.getReal if fmu.fmi == "2.0" else runner.inner.getFloat64
        reference = fmu.references
        before = runner.get(list(reference))
        refused(runner, "9999 is not known", write, [9999], [1.0])
        refused(runner, "9999 is not known", read, [9999])
        for bad in (np.nan, np.inf):
            refused(runner, "muscle1.command", write, [reference["muscle1.command"]], [bad])
        refused(runner, "muscle1.a1 is fixed", write, [reference["muscle1.a1"]], [1.0])
        refused(runner, "muscle1.force is computed", write, [reference["muscle1.force"]], [0.0])
        if kind == "ModelExchange":
            refused(runner, "event mode", write, [reference["mass"]], [3.0])
            runner.change_inputs({"mass": 3.0})
        else:
            refused(runner, "start value of x", write, [reference["x"]], [0.0])
            refused(runner, "mass = -1", write, [reference["mass"]], [-1.0])
            runner.set({"mass": 3.0})
        assert runner.get(["mass"])[0] == 3.0
        names = [n for n in reference if n not in ("mass", "der(v)")]
        kept = dict(zip(reference, before, strict=True))
        assert list(runner.get(names)) == [kept[n] for n in names]


def test_bad_steps_are_refused(fmu):
    with started(fmu, "CoSimulation") as runner:
        runner.step(0.0, 0.01)
        for size in (0.0, -0.01, np.nan, np.inf):
            refused(runner, "step", runner.step, 0.01, size)
        refused(runner, "the instance stands at 0.01", runner.step, 0.5, 0.01)
        runner.step(0.01 + 1e-14, 0.01)  # the sum of an importer's steps drifts
        assert now(runner) == pytest.approx(0.02, abs=1e-12)
    with Runner(fmu, "CoSimulation") as runner:  # seconds since 1970
        runner.initialize({}, 1.7e9, None)
        runner.step(1.7e9, 1e-3)
        refused(runner, "the instance stands at", runner.step, 1.7e9, 1e-3)
        runner.step(1.7e9 + 1e-3, 1e-3)


def test_a_step_beyond_the_stop_time_is_refused(fmu):
    with Runner(fmu, "CoSimulation") as runner:
        if fmu.fmi == "2.0":
            runner.inner.setupExperiment(startTime=0.0, stopTime=0.1)
            runner.inner.enterInitializationMode()
        else:
            runner.inner.enterInitializationMode(startTime=0.0, stopTime=0.1)
        runner.inner.exitInitializationMode()
        runner.step(0.0, 0.1)
        refused(runner, "stop time", runner.step, 0.1, 0.01)


def test_calls_in_the_wrong_mode_are_refused(fmu):
    with Runner(fmu, "CoSimulation") as runner:
        refused(runner, "before initialization", runner.step, 0.0, 0.01)
        refused(runner, "before initialization", runner.get, ["x"])
        refused(runner, "before initialization", runner.inner.exitInitializationMode)
        runner.initialize({}, 0.0, None)
        refused(runner, "step mode", runner.inner.enterInitializationMode)
        runner.inner.terminate()
        refused(runner, "terminated", runner.step, 0.0, 0.01)
        refused(runner, "terminated", runner.set, {"muscle1.command": 1e5})
        assert runner.get(["x"])[0] == 0.0
    with started(fmu, "ModelExchange") as runner:
        three = np.zeros(3)
        refused(runner, "3 values", runner.inner.setContinuousStates, pointer(three), 3)
        runner.inner.enterEventMode()
        refused(runner, "event mode", runner.inner.setContinuousStates, pointer(three), 3)


def test_states_that_are_not_finite_are_discarded(fmu):
    with started(fmu, "ModelExchange") as runner:
        x = np.array([np.nan, 0.0, BAR, BAR])
        refused(runner, "x = nan", runner.inner.setContinuousStates, pointer(x), 4, status=DISCARD)
        x = np.array([0.0, 1e308, BAR, BAR])  # the damping's force overflows
        runner.inner.setContinuousStates(pointer(x), 4)
        refused(runner, "not finite", runner.get, ["der(v)"], status=DISCARD)


@pytest.fixture(scope="module")
def blow_up(tmp_path_factory: pytest.TempPathFactory) -> dict[str, UnpackedFmu]:
    """x = 1/(1 - t) in both versions."""
    plant, folder = pam.Plant("blow_up"), tmp_path_factory.mktemp("blow_up")
    x = plant.state("x", start=1.0)
    plant.der(x, x**2)
    return {fmi: opened(plant, folder, fmi) for fmi in VERSIONS}


def test_a_step_that_fails_is_discarded_and_changes_nothing(blow_up):
    for fmu in blow_up.values():
        with started(fmu, "CoSimulation") as runner:
            runner.step(0.0, 0.5)
            refused(runner, "behind time", runner.step, 0.5, 1.0, status=DISCARD)
            assert now(runner) == 0.5
            assert runner.get(["x"])[0] == pytest.approx(2.0, rel=1e-6)
            runner.step(0.5, 0.25)  # a shorter one works
            assert runner.get(["x"])[0] == pytest.approx(4.0, rel=1e-6)


def test_a_step_that_fails_changes_nothing_though_the_importer_has_looked_on(blow_up):
    seen = []
    with Runner(blow_up["3.0"], "CoSimulation") as runner:

        def update(environment: Any, time: float, *others: Any) -> None:
            seen.append(time)

        runner.inner.fmi3FreeInstance(runner.inner.component)
        runner.inner.instantiate(intermediateUpdate=update, earlyReturnAllowed=False)
        runner.initialize({}, 0.0, None)
        with pytest.raises(FMICallException) as failure:
            runner.inner.doStep(0.0, 2.0)
        assert failure.value.status == DISCARD
        assert max(seen) > 0.5  # it had come far
        assert list(runner.get(["time", "x"])) == [0.0, 1.0]
        runner.inner.doStep(0.0, 0.5)
        assert runner.get(["x"])[0] == pytest.approx(2.0, rel=1e-6)


def test_types_that_the_fmu_does_not_have_are_refused(fmu):
    with started(fmu, "CoSimulation") as runner:
        read = runner.inner.getInteger if fmu.fmi == "2.0" else runner.inner.getInt32
        refused(runner, "no variables of type Int", read, [1])


def test_an_instance_that_is_no_instance_gives_an_error(fmu):
    with started(fmu, "CoSimulation") as runner:
        function = runner.inner.dll[f"fmi{fmu.fmi[0]}Terminate"]
        assert function(ctypes.c_void_p(None)) == ERROR


def test_the_log_can_be_chosen_by_category(fmu):
    with started(fmu, "CoSimulation") as runner:
        runner.inner.setDebugLogging(True, ["logSteps"])
        runner.step(0.0, 0.01)
        assert "internal steps" in runner.log[-1][1]
        lines = len(runner.log)
        with pytest.raises(FMICallException):
            runner.step(0.01, -1.0)
        assert len(runner.log) == lines  # errors were not chosen
        runner.inner.setDebugLogging(True, [])
        refused(runner, "log category", runner.inner.setDebugLogging, True, ["logNothing"])


def test_a_step_says_in_fmi_3_where_it_ended_also_when_it_was_refused(fmus):
    """Also where the importer hands over no place for an answer."""
    with started(fmus["3.0"], "CoSimulation") as runner:
        runner.step(0.0, 0.25)
        for size, status in ((-1.0, ERROR), (0.25, 0)):
            flags = [ctypes.c_bool(True) for _ in range(3)]
            reached = ctypes.c_double(-1.0)
            places = [*map(ctypes.byref, flags), ctypes.byref(reached)]
            step = runner.inner.dll.fmi3DoStep
            component = runner.inner.component
            arguments = (component, ctypes.c_double(0.25), ctypes.c_double(size), True)
            assert step(*arguments, *places) == status
            assert [flag.value for flag in flags] == [False, False, False]
            assert reached.value == pytest.approx(0.25 if status else 0.5)
        later = (component, ctypes.c_double(0.5), ctypes.c_double(0.25), True)
        assert step(*later, None, None, None, None) == 0
        assert now(runner) == pytest.approx(0.75)

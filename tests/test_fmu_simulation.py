"""An FMU in motion: accuracy, saved states, derivatives, refused calls."""

from __future__ import annotations

import ctypes
import gc
import zipfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import BAR, benchmark_slide, flat, scipy_states
from fmpy.fmi1 import FMICallException

import pam_ocp as pam
from pam_ocp.fmu import check_fmu, export_fmu, source
from pam_ocp.fmu.runner import Runner, UnpackedFmu, pointer

VERSIONS = ("2.0", "3.0")
KINDS = ("CoSimulation", "ModelExchange")
COMMANDS = ("muscle1.command", "muscle2.command")
DISCARD, ERROR = 2, 3


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> dict[str, UnpackedFmu]:
    """The benchmark's slide in both versions, unpacked."""
    folder = tmp_path_factory.mktemp("fmus")
    found = {}
    for fmi in VERSIONS:
        path = export_fmu(benchmark_slide(), folder / f"{fmi[0]}.fmu", fmi=fmi, platforms="native")  # type: ignore[arg-type]
        found[fmi] = UnpackedFmu(path, folder / fmi)
    return found


@pytest.fixture(params=VERSIONS)
def fmu(request: pytest.FixtureRequest, fmus: dict[str, UnpackedFmu]) -> UnpackedFmu:
    return fmus[request.param]


def started(fmu: UnpackedFmu, kind: Any, start: dict[str, float] | None = None) -> Runner:
    runner = Runner(fmu, kind)
    runner.initialize(start or {}, 0.0, None)
    return runner


def now(runner: Runner) -> float:
    """The time at which an instance stands; value reference 0 in both versions."""
    read = runner.inner.getReal if runner.fmu.fmi == "2.0" else runner.inner.getFloat64
    return float(read([0])[0])


def bars_every(step: float, duration: float, seed: int = 7) -> tuple[Any, Any]:
    """Commands like those of a planned tour: held, jumping by bars at each step."""
    t = np.arange(0, round(duration / step) + 1) * step
    return t, np.random.default_rng(seed).uniform(0.5 * BAR, 5.5 * BAR, (len(t), 2))


# ---- accuracy -------------------------------------------------------------------------------------


@pytest.mark.parametrize("step", [0.001, 0.005, 0.02])
def test_both_modes_agree_with_scipy_to_a_millionth_of_nominal(
    fmus: dict[str, UnpackedFmu], step: float, tmp_path: Path
) -> None:
    plant = benchmark_slide()
    t, commands = bars_every(step, 60 * step)
    held = lambda time: commands[min(int(time / step + 1e-9), len(t) - 1)]  # noqa: E731
    states = scipy_states(plant, held, t)
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
        assert found.largest < 5e-7


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


def test_a_wrong_trajectory_is_found_out(fmus: dict[str, UnpackedFmu], tmp_path: Path) -> None:
    plant = benchmark_slide()
    path = export_fmu(plant, tmp_path / "slide.fmu", platforms="native")
    t = np.linspace(0, 0.1, 11)
    right = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=t)
    assert check_fmu(path, right).ok
    other = pam.simulate(plant.with_values(mass=2.01), {"muscle1.command": 4 * BAR}, t=t)
    found = check_fmu(path, other)
    assert not found.ok
    assert "NOT well" in str(found)
    assert check_fmu(path, other, parameters={"mass": 2.01}).ok


def test_damaged_fmus_are_found_out(tmp_path: Path) -> None:
    path = export_fmu(benchmark_slide(), tmp_path / "slide.fmu", platforms="native")

    def changed(change: Any) -> Any:
        other = tmp_path / "other.fmu"
        with zipfile.ZipFile(path) as old, zipfile.ZipFile(other, "w") as new:
            for name in old.namelist():
                content = change(name, old.read(name))
                if content is not None:
                    new.writestr(name, content)
        return check_fmu(other)

    binary = lambda name: name.startswith("binaries/")  # noqa: E731
    assert "no binary" in str(changed(lambda n, c: None if binary(n) else c))
    assert "no shared library" in str(changed(lambda n, c: b"nonsense" if binary(n) else c))
    old_token = changed(
        lambda n, c: c.replace(b'guid="{', b'guid="{1') if n.endswith(".xml") else c
    )
    assert any("belong together" in finding for finding in old_token.findings)
    foreign = changed(
        lambda n, c: c.replace(b"fmi2Terminate", b"foreign__name") if binary(n) else c
    )
    assert any("foreign__name" in finding for finding in foreign.findings)


@pytest.mark.parametrize("fmi", VERSIONS)
def test_wrong_directional_derivatives_are_found_out(
    fmi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    right = source.plant_functions

    def wrong(plant: pam.Plant) -> Any:
        functions = {f.name(): f for f in right(plant)}
        forward = functions["plant_forward"]
        given = forward.sx_in()
        dxdot, dy = forward(*given)
        functions["plant_forward"] = ca.Function("plant_forward", given, [1.001 * dxdot, dy])
        return list(functions.values())

    monkeypatch.setattr(source, "plant_functions", wrong)
    found = check_fmu(
        export_fmu(benchmark_slide(), tmp_path / "slide.fmu", fmi=fmi, platforms="native")
    )
    assert any("directional derivatives along x" in finding for finding in found.findings)


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


def test_fixed_steps_agree_with_controlled_ones(tmp_path: Path) -> None:
    plant, t = benchmark_slide(), np.linspace(0, 0.1, 101)
    truth = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=t)
    path = export_fmu(plant, tmp_path / "slide.fmu", fmi="3.0", fixed_step=5e-4, platforms="native")
    assert check_fmu(path, truth).ok
    assert 'fixedInternalStepSize="0.0005"' in _description(path)


def _description(path: Path) -> str:
    with zipfile.ZipFile(path) as archive:
        return archive.read("modelDescription.xml").decode()


# ---- FMI 2: slopes of inputs and outputs; FMI 3: intermediate updates -----------------------------


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
        environment: Any, time: float, set_: bool, get: bool, done: bool, may_return: bool,
        requested: Any, wish: Any,
    ) -> None:  # fmt: skip
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


# ---- saved states ---------------------------------------------------------------------------------


def test_a_restored_state_continues_to_the_last_bit_in_another_instance(fmu: UnpackedFmu) -> None:
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
def test_damaged_states_are_refused(fmu: UnpackedFmu, place: int) -> None:
    with started(fmu, "CoSimulation") as runner:
        saved = bytearray(runner.save())
        saved[place] ^= 0xFF
        with pytest.raises(FMICallException):
            runner.restore(bytes(saved))
        with pytest.raises(FMICallException):
            runner.restore(bytes(saved[:-8]))
        assert len(runner.log) == 2
        runner.step(0.0, 0.01)  # and nothing has happened


def test_a_state_of_the_other_kind_is_refused(fmu: UnpackedFmu) -> None:
    with started(fmu, "ModelExchange") as exchange, started(fmu, "CoSimulation") as simulation:
        with pytest.raises(FMICallException):
            simulation.restore(exchange.save())
        assert "Model Exchange" in simulation.log[-1][1]


def test_reset_brings_back_the_start(fmu: UnpackedFmu) -> None:
    with started(fmu, "CoSimulation", {"x": 0.01, "mass": 1.0}) as runner:
        runner.step(0.0, 0.01)
        runner.inner.reset()
        runner.initialize({}, 0.0, None)
        assert list(runner.get(["x", "mass"])) == [0.0, 2.0]
        assert now(runner) == 0.0


# ---- partial derivatives --------------------------------------------------------------------------


def _jacobian_by_differences(plant: pam.Plant, x: Any, u: Any) -> Any:
    """d(xdot, y)/d(x, u) by central differences of the plant's own function in Python."""
    p = plant.vector("parameter")
    nominal = [*plant.vector("state", None, "nominal"), *plant.vector("input", None, "nominal")]
    point = np.concatenate([x, u])

    def value(z: Any) -> Any:
        xdot, y, _ = plant.function(z[: len(x)], z[len(x) :], p)
        return np.concatenate([flat(xdot), flat(y)])

    columns = []
    for i, size in enumerate(nominal):
        step = np.zeros(len(point))
        step[i] = 1e-5 * size
        columns.append((value(point + step) - value(point - step)) / (2 * step[i]))
    return np.array(columns).T


@pytest.mark.parametrize("kind", KINDS)
def test_directional_derivatives_agree_with_differences(fmu: UnpackedFmu, kind: str) -> None:
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


def test_states_are_outputs_of_themselves_and_parameters_are_known(fmu: UnpackedFmu) -> None:
    with started(fmu, "ModelExchange") as runner:
        assert list(runner.directional(["x", "v"], ["v", "x"], [2.0, 5.0])) == [5.0, 2.0]
    with started(fmu, "ModelExchange", {"muscle1.command": 5 * BAR}) as runner:
        at = runner.get(["muscle1.pressure"])[0]
        slope = runner.directional(["der(muscle1.pressure)"], ["muscle1.lag"], [1.0])
        assert slope[0] == pytest.approx(-(5 * BAR - at) / 0.05**2)


def test_adjoint_and_directional_derivatives_agree_in_the_dot_product(
    fmus: dict[str, UnpackedFmu],
) -> None:
    fmu, rng = fmus["3.0"], np.random.default_rng(11)
    knowns = [*fmu.states, *fmu.names("input"), *fmu.names("parameter")]
    unknowns = [*fmu.names("output"), *(f"der({n})" for n in fmu.states)]
    seed = rng.normal(size=len(knowns)) * fmu.nominals(knowns)
    weight = rng.normal(size=len(unknowns)) / fmu.nominals(unknowns)
    with started(fmu, "ModelExchange", {"x": 0.003}) as runner:
        forward = runner.directional(unknowns, knowns, list(seed))
        references = (runner.references(unknowns), runner.references(knowns))
        reverse = np.array(
            runner.inner.getAdjointDerivative(*references, list(weight), len(knowns))
        )
    terms = np.concatenate([weight * forward, -reverse * seed])
    assert abs(np.sum(terms)) < 1e-12 * np.sum(np.abs(terms))


# ---- refused calls: an error, a line in the log, and nothing has changed --------------------------


def refused(runner: Runner, words: str, call: Any, *arguments: Any, status: int = ERROR) -> None:
    lines = len(runner.log)
    with pytest.raises(FMICallException) as failure:
        call(*arguments)
    assert failure.value.status == status
    assert len(runner.log) == lines + 1
    assert runner.log[-1][0] == status
    assert words in runner.log[-1][1]


def test_a_wrong_token_is_refused(fmu: UnpackedFmu) -> None:
    with pytest.raises(pam.SimulationError, match="do not belong together"):
        Runner(fmu, "CoSimulation", token="{00000000-0000-0000-0000-000000000000}")
    with started(fmu, "CoSimulation") as runner:  # the next one is not disturbed
        runner.step(0.0, 0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_bad_values_are_refused_with_the_name_of_the_variable(fmu: UnpackedFmu, kind: str) -> None:
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


def test_bad_steps_are_refused(fmu: UnpackedFmu) -> None:
    with started(fmu, "CoSimulation") as runner:
        runner.step(0.0, 0.01)
        for size in (0.0, -0.01, np.nan, np.inf):
            refused(runner, "step", runner.step, 0.01, size)
        refused(runner, "the instance stands at 0.01", runner.step, 0.5, 0.01)
        runner.step(0.01 + 1e-14, 0.01)  # the sum of an importer's steps drifts
        assert now(runner) == pytest.approx(0.02, abs=1e-12)


def test_a_step_beyond_the_stop_time_is_refused(fmu: UnpackedFmu) -> None:
    with Runner(fmu, "CoSimulation") as runner:
        if fmu.fmi == "2.0":
            runner.inner.setupExperiment(startTime=0.0, stopTime=0.1)
            runner.inner.enterInitializationMode()
        else:
            runner.inner.enterInitializationMode(startTime=0.0, stopTime=0.1)
        runner.inner.exitInitializationMode()
        runner.step(0.0, 0.1)
        refused(runner, "stop time", runner.step, 0.1, 0.01)


def test_calls_in_the_wrong_mode_are_refused(fmu: UnpackedFmu) -> None:
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


def test_states_that_are_not_finite_are_discarded(fmu: UnpackedFmu) -> None:
    with started(fmu, "ModelExchange") as runner:
        x = np.array([np.nan, 0.0, BAR, BAR])
        refused(runner, "x = nan", runner.inner.setContinuousStates, pointer(x), 4, status=DISCARD)
        x = np.array([-1e9, 0.0, BAR, BAR])  # the force law overflows
        runner.inner.setContinuousStates(pointer(x), 4)
        refused(runner, "not finite", runner.get, ["der(v)"], status=DISCARD)


def test_a_step_that_fails_is_discarded_and_changes_nothing(tmp_path: Path) -> None:
    plant = pam.Plant("blow_up")
    x = plant.state("x", start=1.0)
    plant.der(x, x**2)  # x = 1/(1 - t)
    for fmi in VERSIONS:
        path = export_fmu(plant, tmp_path / f"{fmi[0]}.fmu", fmi=fmi, platforms="native")  # type: ignore[arg-type]
        fmu = UnpackedFmu(path, tmp_path / fmi)
        with started(fmu, "CoSimulation") as runner:
            runner.step(0.0, 0.5)
            refused(runner, "behind time", runner.step, 0.5, 1.0, status=DISCARD)
            assert now(runner) == 0.5
            assert runner.get(["x"])[0] == pytest.approx(2.0, rel=1e-6)
            runner.step(0.5, 0.25)  # a shorter one works
            assert runner.get(["x"])[0] == pytest.approx(4.0, rel=1e-6)


def test_types_that_the_fmu_does_not_have_are_refused(fmu: UnpackedFmu) -> None:
    with started(fmu, "CoSimulation") as runner:
        read = runner.inner.getInteger if fmu.fmi == "2.0" else runner.inner.getInt32
        refused(runner, "no variables of type Int", read, [1])


def test_an_instance_that_is_no_instance_gives_an_error(fmu: UnpackedFmu) -> None:
    with started(fmu, "CoSimulation") as runner:
        function = runner.inner.dll[f"fmi{fmu.fmi[0]}Terminate"]
        assert function(ctypes.c_void_p(None)) == ERROR


def test_the_log_can_be_chosen_by_category(fmu: UnpackedFmu) -> None:
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


# ---- many instances -------------------------------------------------------------------------------


def test_instances_do_not_disturb_each_other(fmu: UnpackedFmu) -> None:
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


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
def test_hundreds_of_instances_leave_no_memory_behind(fmu: UnpackedFmu) -> None:
    def resident() -> int:
        gc.collect()  # the callbacks of FMPy's instances form cycles
        return int(Path("/proc/self/statm").read_text().split()[1])

    def use() -> None:
        with started(fmu, "CoSimulation") as runner:
            runner.step(0.0, 1e-3)
            runner.restore(runner.save())

    with started(fmu, "CoSimulation"):  # keeps the library loaded
        for _ in range(400):  # until the heap has found its size
            use()
        before = resident()
        for _ in range(300):
            use()
        assert resident() - before < 256  # pages; an instance and its state are about one page

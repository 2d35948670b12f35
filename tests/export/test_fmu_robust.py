"""Under sanitizers, in threads, in strange folders, from other importers: an FMU stays sound."""

from __future__ import annotations

import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import casadi as ca
import fmpy
import numpy as np
import pytest
from c_program import SANITIZED, needs_compiler, require_works
from conftest import BAR, benchmark_slide, flat
from fmu_tools import VERSIONS, exported, opened
from scipy.linalg import expm

import pam_ocp as pam
from pam_ocp import ExportError
from pam_ocp.export import check_fmu, export_fmu
from pam_ocp.export import compile as compiler
from pam_ocp.export.runner import Runner

PROGRAMS = Path(__file__).parents[2] / "fmu" / "tests"


def lonely() -> pam.Plant:
    """No input, no parameter, no output of its own."""
    plant = pam.Plant("lonely")
    x, v = plant.state("x", start=1.0), plant.state("v")
    plant.der(x, v)
    plant.der(v, -x)
    return plant


def built(folder: Path, fmi: str, plant: pam.Plant, program: str, *flags: str) -> Path:
    """A C program of fmu/tests, compiled by gcc together with the sources of an FMU."""
    fmpy.extract(str(exported(plant, folder, fmi)), str(folder / "fmu"))
    target = folder / program
    command = ["gcc", "-std=c11", "-g", "-O1", *flags, "-I", str(folder / "fmu" / "sources")]
    command += [str(PROGRAMS / f"{program}.c"), "-o", str(target), "-lm"]
    subprocess.run(command, check=True)
    return target


@pytest.mark.slow
@pytest.mark.parametrize("make", [benchmark_slide, lonely])
def test_half_a_million_random_calls_do_no_harm(fmi, make, tmp_path):
    require_works("gcc", *SANITIZED)
    fuzz = built(tmp_path, fmi, make(), "fuzz", *SANITIZED)
    for seed in range(2):
        done = subprocess.run(
            [str(fuzz), "250000", str(seed)], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout[-500:] + done.stderr[-2000:]
        assert "0 silent" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("sanitizer", ["address,undefined", "thread"])
def test_eight_threads_do_as_one_under_sanitizers(fmi, sanitizer, tmp_path):
    flags = (f"-fsanitize={sanitizer}", "-fno-sanitize-recover=all", "-pthread")
    require_works("gcc", *flags)
    program = built(tmp_path, fmi, benchmark_slide(), "threads", *flags)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-2000:]
    assert "0 of 8 threads differ, failed: 0" in done.stdout


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("valgrind") is None, reason="needs valgrind")
def test_valgrind_finds_no_error_and_no_leak(fmi, tmp_path):
    require_works("gcc")
    fuzz = built(tmp_path, fmi, benchmark_slide(), "fuzz")
    command = ["valgrind", "-q", "--error-exitcode=9", "--leak-check=full", str(fuzz), "10000", "3"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_a_stiff_linear_plant_of_badly_scaled_states_follows_the_matrix_exponential(tmp_path):
    rng, n = np.random.default_rng(5), 9
    scale = 10.0 ** rng.integers(-4, 6, n)
    basis = rng.normal(size=(n, n))
    rates = -np.logspace(0, 5, n)
    a = np.diag(scale) @ basis @ np.diag(rates) @ np.linalg.inv(basis) @ np.diag(1 / scale)
    start = scale * rng.normal(size=n)
    plant = pam.Plant("chain")
    states = [plant.state(f"x{i}", start=start[i], nominal=scale[i]) for i in range(n)]
    for row, state in zip(a, states, strict=True):
        plant.der(state, sum(float(c) * x for c, x in zip(row, states, strict=True)))
    expected = expm(a * 0.5) @ start
    for fmi in VERSIONS:
        fmu = opened(plant, tmp_path, fmi)
        with Runner(fmu, "CoSimulation") as runner:
            runner.initialize({}, 0.0, None)
            runner.step(0.0, 0.5)
            found = runner.get(fmu.states)
        assert np.max(np.abs(found - expected) / scale) < 1e-6


@needs_compiler
def test_without_zig_the_compiler_of_the_system_builds_for_this_machine(tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "_zig", lambda: None)
    found = check_fmu(exported(benchmark_slide(), tmp_path))
    assert found.ok, str(found)
    with pytest.raises(ExportError, match=r"aarch64-linux, .*pip install 'pam_ocp\[cross\]'"):
        export_fmu(benchmark_slide(), tmp_path / "all.fmu")


def test_eight_threads_give_the_same_bits_as_one(fmu):
    def play(runner: Runner) -> Any:
        for k in range(200):
            runner.set({"muscle1.command": (2 + k % 3) * BAR})
            runner.step(k * 1e-3, 1e-3)
        return runner.get(fmu.names("output"))

    runners = [Runner(fmu, "CoSimulation") for _ in range(9)]
    for runner in runners:
        runner.initialize({"x": 0.004}, 0.0, None)
    alone = play(runners.pop())
    with ThreadPoolExecutor(8) as pool:
        for together in pool.map(play, runners):
            assert np.array_equal(together, alone)


def test_a_read_only_folder_with_spaces_and_umlauts_is_no_hindrance(slide_unit, tmp_path):
    folder = tmp_path / "Prüfstand mit Müskeln"
    folder.mkdir()
    moved = Path(shutil.copy(slide_unit, folder / "schlitten größe 1.fmu"))
    subprocess.run(["unzip", "-q", str(moved), "-d", str(folder / "ausgepackt")], check=True)
    for file in sorted(folder.rglob("*"), reverse=True):
        file.chmod(0o555)
    try:
        result = fmpy.simulate_fmu(str(folder / "ausgepackt"), stop_time=0.01)
        assert result["x"][-1] == pytest.approx(0.0, abs=1e-12)
    finally:
        for file in sorted(folder.rglob("*")):
            file.chmod(0o755)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
def test_fmpy_simulates_it_in_one_call(slide_unit, kind):
    plant, t = benchmark_slide(), np.linspace(0, 0.2, 21)
    truth = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=t, parameters={"mass": 1.5})
    asked = {"stop_time": 0.2, "output_interval": 0.01, "relative_tolerance": 1e-10}
    asked["start_values"] = {"muscle1.command": 4 * BAR, "mass": 1.5}
    result = fmpy.simulate_fmu(str(slide_unit), fmi_type=kind, **asked)
    assert result["time"] == pytest.approx(t, abs=1e-12)
    for variable in (*plant.states, *plant.outputs):
        name = variable.name
        assert np.max(np.abs(result[name] - truth[name])) < 1e-6 * variable.nominal, name


def test_casadi_imports_it_for_model_exchange(fmus):
    plant = benchmark_slide()
    builder = ca.DaeBuilder("slide", str(fmus["2.0"].folder))
    f = builder.create("f", ["x", "u"], ["ode"])
    names = builder.x()
    order = [names.index(v.name) for v in plant.states]
    x = plant.vector("state", {"x": 0.004, "v": 0.1})
    u = plant.vector("input")
    given = np.empty(len(names))
    given[order] = x
    ode = flat(f(given, u))[order]
    expected = flat(plant.function(x, u, plant.vector("parameter"))[0])
    assert ode == pytest.approx(expected, rel=1e-12, abs=1e-9)
    jacobian = np.asarray(f.factory("j", ["x", "u"], ["jac:ode:x"])(given, u))
    symbols = [plant.x, plant.u, plant.p]
    slopes = ca.Function("J", symbols, [ca.jacobian(plant.function(*symbols)[0], plant.x)])
    exact = np.asarray(ca.densify(slopes(x, u, plant.vector("parameter"))))
    assert jacobian[np.ix_(order, order)] == pytest.approx(exact, rel=1e-9, abs=1e-9)


_ELSEWHERE = """
import sys
from pathlib import Path
from pam_ocp.export.runner import Runner, UnpackedFmu
fmu = UnpackedFmu(Path(sys.argv[1]), Path(sys.argv[2]))
with Runner(fmu, "CoSimulation") as runner:
    runner.initialize({}, 0.0, None)
    runner.restore(Path(sys.argv[3]).read_bytes())
    for k in range(50, 100):
        runner.step(k * 1e-3, 1e-3)
    print(*(float(v).hex() for v in runner.get(fmu.names("output"))))
"""


def test_a_state_saved_in_the_middle_continues_to_the_last_bit_in_another_process(
    fmu, slide_unit, tmp_path
):
    with Runner(fmu, "CoSimulation") as runner:
        runner.initialize({"mass": 1.7, "x": 0.003}, 0.0, None)
        runner.set({"muscle1.command": 4.2e5})
        for k in range(50):
            runner.step(k * 1e-3, 1e-3)
        (tmp_path / "state").write_bytes(runner.save())
        for k in range(50, 100):
            runner.step(k * 1e-3, 1e-3)
        end = [float(v).hex() for v in runner.get(fmu.names("output"))]
    places = (str(p) for p in (slide_unit, tmp_path / "there", tmp_path / "state"))
    command = [sys.executable, "-c", _ELSEWHERE, *places]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == end


_MANY = """
import gc, sys
from pathlib import Path
from pam_ocp.export.runner import Runner, UnpackedFmu

def resident():
    gc.collect()  # the callbacks of FMPy's instances form cycles
    return int(Path("/proc/self/statm").read_text().split()[1])

def use(times):
    for _ in range(times):
        with Runner(fmu, "CoSimulation") as runner:
            runner.initialize({}, 0.0, None)
            runner.step(0.0, 1e-3)
            runner.restore(runner.save())

fmu = UnpackedFmu(*map(Path, sys.argv[1:]))
with Runner(fmu, "CoSimulation") as keeps_the_library_loaded:
    keeps_the_library_loaded.initialize({}, 0.0, None)
    use(1000)  # until the heap has found its size
    before = resident()
    use(3000)
    print(resident() - before)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
def test_thousands_of_instances_leave_no_memory_behind(slide_unit, tmp_path):
    # in a process of its own: what other tests left in the heap moves while this one runs
    command = [sys.executable, "-c", _MANY, str(slide_unit), str(tmp_path / "here")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert int(done.stdout) < 153  # pages: a twentieth of one for each instance

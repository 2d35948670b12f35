"""C code of controllers: as in Python, without heap or warnings, the same bits everywhere."""

import ctypes
import itertools
import json
import re
import shutil
import subprocess
from functools import cache

import casadi as ca
import numpy as np
import pytest
from c_program import (
    COMPILER,
    SANITIZED,
    ZIG,
    Program,
    bits_of,
    needs_compiler,
    on_aarch64,
    on_cortex_m7,
    printed_by,
    require_works,
    run,
    selftest,
    with_gaps,
)
from conftest import refused

import pam_ocp as pam
from pam_ocp.control import (
    PID,
    BlockController,
    HysteresisCompensation,
    KalmanFilter,
    PositionController,
    PressureLoop,
    block,
    chain,
    kalman,
    lqr,
)
from pam_ocp.control.references import sine
from pam_ocp.core.block import Block
from pam_ocp.core.exceptions import WriteError
from pam_ocp.export.c_code import package, single

MUSCLE = pam.muscle("DMSP-20-300")
REST = {"x": 0.002, "stiffness": 2.2e4}
STEP = 2e-3
CLANG = shutil.which("clang") or "clang"


def pid_block(**more):
    return block(PID(3.0, 10.0, 0.1), sample_time=1e-3, limits={"command": (-1.0, 1.0)}, **more)


@pytest.fixture(scope="module")
def valved():
    return pam.AntagonisticSlide(MUSCLE, mass=2.0, feed=pam.feeds.SpoolValve())


@pytest.fixture(scope="module")
def estimating(valved):
    """LQI on the openings behind a Kalman filter that measures position and pressures."""
    feedback = lqr(valved, REST, integral={"x": 80.0}, sample_time=STEP)
    measured = {"x": 1e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    estimator = kalman(valved, REST, measured=measured, sample_time=STEP)
    return block(chain([estimator, feedback]), plant=valved)


@pytest.fixture(scope="module")
def extended():
    """LQR behind an extended Kalman filter that finds the mass: exponentials, a matrix inverse."""
    slide = pam.AntagonisticSlide(MUSCLE, mass=2.0)
    measured = {"x": 1e-5, "muscle1.pressure": 500.0}
    known = {"measured": measured, "unknown": {"mass": (0.2, 0.01)}}
    estimator = KalmanFilter(slide, sample_time=STEP, substeps=1, **known)
    return block(chain([estimator, lqr(slide, REST, sample_time=STEP)]), plant=slide)


@pytest.fixture(scope="module")
def exported(tmp_path_factory, estimating, extended):
    """(name of a block, precision) -> a folder with its C, made once."""
    blocks = {"estimating": estimating, "extended": extended, "pid": pid_block()}

    @cache
    def export(name, precision="double"):
        place = tmp_path_factory.mktemp(f"{name}_{precision}") / "c"
        return pam.export_c(blocks[name], place, precision=precision)

    return export


# ---- the same closed loops ----------------------------------------------------------------------
def same_loop(made, plant, folder, told, duration=0.2, least=0.02, **loop):
    """The plant moves, and with the C program as with the block in Python, to 1e-9 of nominal."""
    pam.export_c(made, folder, name="under_test")
    here, there = BlockController(made, told), Program(folder, "under_test", made, told)
    runs = [pam.closed_loop(c, plant, duration=duration, **loop) for c in (here, there)]
    for v in (*plant.states, *plant.inputs):
        first, second = (run[v.name] for run in runs)
        assert np.abs(first - second).max() <= 1e-9 * v.nominal
    for v in plant.inputs:
        assert np.ptp(runs[0][v.name]) > least * v.nominal
    return runs[0]


@needs_compiler
def test_a_slide_with_spool_valves_and_an_estimator_moves_the_same(valved, estimating, tmp_path):
    def told(t):
        return {"wanted.x": 0.002 + 0.005 * (t > 0.05)}

    same_loop(estimating, valved, tmp_path / "c", told, noise={"x": 1e-5}, seed=4)


@needs_compiler
def test_a_joint_with_dead_zones_in_its_valves_moves_the_same(tmp_path):
    link = {"inertia": 0.05, "link_mass": 1.0, "link_length": 0.2}
    joint = pam.AntagonisticJoint(MUSCLE, **link, feed=pam.feeds.SpoolValve())
    path, how = sine(0.0, 0.2, 1.0), {"stiffness": 30.0, "inner": PressureLoop(joint)}
    controller = PositionController(joint, path, PID.placed(2.0), sample_time=STEP, **how)
    names = [f"wanted.{n}" for n in next(iter(joint.positions.items()))] + ["wanted.acceleration"]
    told = lambda t: dict(zip(names, path(t), strict=True))  # noqa: E731
    same_loop(block(controller, plant=joint), joint, tmp_path / "c", told)


@needs_compiler
def test_a_muscle_with_memory_moves_the_same(tmp_path):
    parts = {"losses": pam.losses.PrandtlIshlinskii(), "feed": pam.feeds.SpoolValve()}
    plant = pam.HangingLoad(MUSCLE, 15.0, **parts)
    start = plant.equilibrium(x=0.03)
    controller = HysteresisCompensation(plant.with_values(start), sample_time=STEP, frequency=2.0)

    def told(t):
        found = {}
        for first, s in (("wanted", t), ("ahead", t + STEP)):
            found[f"{first}.x"] = 0.03 + 0.008 * np.sin(8 * s)
            found[f"{first}.v"] = 0.064 * np.cos(8 * s)
            found[f"{first}.acceleration"] = -0.512 * np.sin(8 * s)
        return found

    same_loop(block(controller), plant, tmp_path / "c", told, start=start)


@needs_compiler
def test_gains_are_tunable_in_c(exported):
    made = pid_block()
    program = Program(exported("pid"), "pid", made)
    names = [v.name for v in made.parameters]
    for name, gain in {"ki": 0.0, "kp": 0.5, "kd": 0.0}.items():
        program.parameters[names.index(name)] = gain
    assert program.step({"wanted.measured": 1.0, "measured": 0.4})["command"] == 0.5 * 0.6


# ---- what a target wants ------------------------------------------------------------------------
@needs_compiler
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("made", ["estimating", "extended"])
def test_the_self_test_passes_without_a_warning(made, precision, exported):
    assert "passed" in selftest(exported(made, precision), "chain")


@pytest.mark.parametrize("precision", ["double", "single"])
def test_sanitizers_find_nothing(precision, exported):
    require_works(CLANG, *SANITIZED)
    folder = exported("estimating", precision)
    assert "passed" in selftest(folder, "chain", *SANITIZED, compiler=[CLANG])


@needs_compiler
def test_nothing_is_allocated_and_nothing_is_kept(exported):
    """Undefined symbols are those of mathematics alone; no variable outlives a call."""
    if shutil.which("nm") is None:
        pytest.skip("needs nm")
    folder = exported("estimating")
    run(COMPILER, "-std=c99", "-O2", "-c", "chain.c", "-o", "chain.o", cwd=folder)
    symbols = [line.split()[-2:] for line in run("nm", "chain.o", cwd=folder).splitlines()]
    kinds = {kind for kind, _ in symbols}
    assert {n for kind, n in symbols if kind == "U"} <= {"sqrt", "memcpy", "memset"}
    assert {n for kind, n in symbols if kind == "T"} == {"chain_init", "chain_step"}
    assert not kinds & set("bBdDC")


@needs_compiler
def test_cmake_builds_and_tests_it(tmp_path):
    if shutil.which("cmake") is None:
        pytest.skip("needs cmake")
    folder = pam.export_c(pid_block(), tmp_path / "c")
    for command in (("cmake", "-B", "b"), ("cmake", "--build", "b"), ("ctest", "--test-dir", "b")):
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("made", ["estimating", "extended"])
@pytest.mark.parametrize("there", [on_aarch64, on_cortex_m7])
def test_other_processors_give_the_same_bits(there, made, exported):
    folder = exported(made)
    assert bits_of(there(folder, "chain")) == bits_of(selftest(folder, "chain"))


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "single"])
def test_it_compiles_for_a_cortex_m7_without_a_system(precision, exported):
    folder = exported("pid", precision)
    target = ("-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m7", "-ffreestanding")
    warn = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Wdouble-promotion")
    run(*ZIG, *target, *warn, "-Werror", "-c", "pid.c", "-o", "pid.o", cwd=folder)
    assert (folder / "pid.o").stat().st_size > 0


DAY = """
#include "pid.h"
#include <stdio.h>
static pid_state state;
int main(void) {
    pid_parameters parameters;
    pid_inputs inputs;
    pid_outputs outputs;
    long k;
    pid_init(&state, &parameters, &inputs);
    parameters.kp = 0; parameters.kd = 0; parameters.ki = 1;
    for (k = 0; k < STEPS; ++k) {
        inputs.wanted_measured = (pid_real)1e-6;
        inputs.measured = 0;
        pid_step(&state, &parameters, &inputs, &outputs);
    }
    printf("%.17g %g\\n", (double)outputs.command, (double)outputs.status);
    return 0;
}
"""


@needs_compiler
@pytest.mark.parametrize("precision", ["double", "single"])
@pytest.mark.parametrize("steps", [1_000_000, pytest.param(86_400_000, marks=pytest.mark.slow)])
def test_an_integral_is_exact_after_a_day(steps, precision, exported):
    """86.4 million steps at 1 ms: the sum of as many small numbers, to the last digits."""
    folder = exported("pid", precision)
    command, status = map(float, printed_by(DAY, folder, "pid.c", f"-DSTEPS={steps}L"))
    assert status == 0
    assert command == pytest.approx(steps * 1e-9, rel=1e-14 if precision == "double" else 3e-7)


@needs_compiler
def test_missing_measurements_give_in_c_what_they_give_in_python(estimating, exported):
    program = Program(exported("estimating"), "chain", estimating)
    nominal = np.array([v.nominal for v in estimating.outputs])
    for found, outputs in with_gaps(estimating, program, samples=300, seed=12):
        assert np.all(np.abs(found - outputs) <= 1e-9 * (nominal + np.abs(outputs)))


# ---- the folder ---------------------------------------------------------------------------------
def test_the_header_is_short_and_the_readme_says_what_it_takes(tmp_path):
    folder = pam.export_c(pid_block(), tmp_path / "c")
    files = {"CMakeLists.txt", "README.md", "pam_ocp_export.json"}
    files |= {"pid.c", "pid.h", "pid_selftest.c"}
    assert {p.name for p in folder.iterdir()} == files
    lines = [s for s in (folder / "pid.h").read_text().splitlines() if s[:1] not in ("#", " ", "")]
    assert len(lines) <= 20
    readme = (folder / "README.md").read_text()
    size = int(re.search(r"`pid_state` \| (\d+)", readme).group(1))
    memory = len(pid_block().memory)
    assert f"memory[{memory}]" in (folder / "pid.h").read_text()
    assert size > 8 * memory
    assert re.search(r"\| multiplications \| \d+ \|", readme)


@needs_compiler
def test_the_readme_tells_the_bytes_that_the_compiler_takes(exported):
    folder = exported("estimating")
    said = dict(re.findall(r"\| `chain_(\w+)` \| (\d+) \|", (folder / "README.md").read_text()))
    names = ["state", "inputs", "parameters", "outputs"]
    prints = "".join(f'printf("%u ", (unsigned)sizeof(chain_{n}));' for n in names)
    text = f'#include "chain.h"\n#include <stdio.h>\nint main(void) {{ {prints} return 0; }}\n'
    assert printed_by(text, folder) == [said[n] for n in names]


def test_an_export_is_replaced_and_anything_else_is_left_alone(tmp_path):
    place = tmp_path / "c"
    pam.export_c(pid_block(), place)
    pam.export_c(pid_block(), place, name="other")
    assert json.loads((place / "pam_ocp_export.json").read_text())["name"] == "other"
    assert not (place / "pid.h").exists()
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    (theirs / "thesis.tex").write_text("years of work")
    refused("no export of C code", pam.export_c, pid_block(), theirs, error=WriteError)
    refused("is a file", pam.export_c, pid_block(), theirs / "thesis.tex", error=WriteError)
    refused("s3://bucket/c is a URL", pam.export_c, pid_block(), "s3://bucket/c", error=WriteError)
    assert [p.name for p in theirs.iterdir()] == ["thesis.tex"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["c", "theirs"]


def test_what_cannot_be_written_is_refused_in_one_sentence(tmp_path):
    made, place = pid_block(), tmp_path / "c"
    refused("precision", pam.export_c, made, place, precision="half")
    refused("begins all names in C", pam.export_c, made, place, name="1 pid")
    refused("inputs has the shape", pam.export_c, made, place, inputs=np.zeros((3, 1)))
    refused("steps", pam.export_c, made, place, steps=0)
    refused("seed = -1", pam.export_c, made, place, seed=-1)
    refused("not known as a block", pam.export_c, object(), place)
    refused("inputs = 'x': give rows of numbers", pam.export_c, made, place, inputs="x")
    refused("limits is of no effect", pam.export_c, made, place, limits={"command": (0.0, 0.5)})
    for name in ("math", "STDIO", "elementary"):  # its header would stand in for C's own
        refused(f"{name.lower()}.h is a header", pam.export_c, made, place, name=name)
    assert not place.exists()


def test_units_are_those_that_variables_have(tmp_path):
    y, none = ca.SX.sym("y"), ca.SX.zeros(0, 1)
    step = ca.Function("step", [none, y, none], [none, y])
    told = pam.Variable("p", "input", unit="bar"), pam.Variable("q", "output", unit="bar")
    folder = pam.export_c(Block("gauge", 1.0, told[:1], told[1:], (), (), step), tmp_path / "c")
    text = (folder / "gauge.h").read_text() + (folder / "README.md").read_text()
    assert "gauge_real p; /* [bar]" in text
    assert "SI units" not in text


@needs_compiler
def test_words_of_c_and_of_cpp_are_names_of_variables(tmp_path):
    names = ("this", "new", "double", "NULL", "linux")
    one, none = ca.SX.sym("x"), ca.SX.zeros(0, 1)
    step = ca.Function("step", [none, one, none], [none, ca.repmat(one, len(names), 1)])
    outputs = tuple(pam.Variable(n, "output") for n in names)
    words = Block("words", 1.0, (pam.Variable("class", "input"),), outputs, (), (), step)
    folder = pam.export_c(words, tmp_path / "c", steps=2)
    assert "passed" in selftest(folder, "words")
    fields = re.findall(r"words_real (\w+);", (folder / "words.h").read_text())
    assert not {"class", *names} & set(fields), "the header is for C++, too"


def test_vectors_end_where_rounding_spoils_them(tmp_path):
    """x -> 4 x (1 - x) doubles an error in each step: from 1e-16 to 1e-6 in some 33 of them."""
    x, none = ca.SX.sym("x"), ca.SX.zeros(0, 1)
    step = ca.Function("step", [x, none, none], [4 * x * (1 - x), x])
    memory = (pam.Variable("x", "state", start=0.3),)
    chaotic = Block("chaos", 1.0, (), (pam.Variable("y", "output"),), (), memory, step)
    for precision, least, most in (("double", 20, 40), ("single", 5, 25)):
        folder = pam.export_c(chaotic, tmp_path / "c", precision=precision)
        steps = re.search(r"#define STEPS (\d+)", (folder / "chaos_selftest.c").read_text())
        assert least < int(steps.group(1)) < most
        if COMPILER:
            assert "passed" in selftest(folder, "chaos")


def test_what_rounding_may_turn_over_is_not_compared_in_single_precision():
    """Passes of x = cos(x) until it moves by less than a few units in the last place."""
    x, moved, count = ca.SX.sym("x"), ca.SX.sym("moved"), ca.SX.sym("count")
    body = ca.Function("b", [x, moved, count], [ca.cos(x), ca.cos(x) - x, count + 1])
    y, last, passes = x, ca.SX(1), ca.SX(0)
    for _ in range(60):
        z = body(y, last, passes)
        going = ca.fabs(last) > 1.5e-7
        before = (y, last, passes)
        y, last, passes = (ca.if_else(going, *pair) for pair in zip(z, before, strict=True))
    memory, none = ca.SX.sym("m"), ca.SX.sym("none", 0)
    outputs = ca.vertcat(passes, ca.if_else(x > 0, 2, 3))
    step = ca.Function("step", [memory, x, none], [memory, outputs])
    inputs = (pam.Variable("x", "input", start=0.5, nominal=1.0),)
    shown = tuple(pam.Variable(n, "output") for n in ("passes", "sure"))
    kept = (pam.Variable("m", "state", start=0.0),)
    made = Block("passes", 1e-3, inputs, shown, (), kept, step)
    given = np.linspace(0.2, 1.2, 20)[:, None]
    expected = package.outputs_of(made, given, single=True)
    told = package.sensitivity(made, given, expected, 2.0**-23, single=True)[1]
    alone = single.single_outputs(made, given)[0]  # which shows some of them, not all
    assert np.isnan(told[alone[:, 0] == expected[:, 0], 0]).any()
    assert np.array_equal(told[:, 1], expected[:, 1])


def test_a_step_beyond_the_budget_is_not_read_instruction_by_instruction(monkeypatch):
    made = pid_block()
    inputs = package.inputs_of(made, 3, 0)
    assert single.single_outputs(made, inputs).shape == (single.DRAWS, 3, len(made.outputs))
    monkeypatch.setattr(single, "BUDGET", 10)
    monkeypatch.setattr(single, "steps_of", lambda step: pytest.fail("it was read"))
    assert single.single_outputs(made, inputs) is None


def test_operations_in_layers_round_as_one_after_another():
    """The first draw against a walk by hand in NumPy's singles, with a function that is called."""
    x, inner = ca.SX.sym("x", 3), ca.SX.sym("y")
    called = ca.Function("elementary", [inner], [inner * inner + 0.1, inner / 3])
    value, third = called.call([x[0] * x[1]], False, True)
    value = value + ca.sqrt(ca.fabs(x[2])) * ca.if_else(x[0] > x[1], third, -x[2])
    step = ca.Function("step", [x], [ca.vertcat(value, third, 7, value * value), ca.SX(0, 1)])
    layers = single.Layers.of(step)
    a, b, c = (np.float32(v) for v in (0.3, 0.1, -1.7))
    product = a * b
    v = (product * product + np.float32(0.1)) + np.sqrt(abs(c)) * (product / np.float32(3))
    for _ in range(2):
        found, nothing = layers(np.repeat(np.float32([[a], [b], [c]]), single.DRAWS, axis=1))
        assert np.array_equal(found[:, 0], [v, product / np.float32(3), 7, v * v])
        assert np.all(np.abs(found / found[:, :1] - 1) < 1e-6)
        assert np.ptp(found[0]) > 0
        assert np.all(found[2] == 7)  # whole numbers are exact
        assert nothing.shape == (0, single.DRAWS)
    table = ca.interpolant("table", "linear", [[0, 1]], [0, 1])
    m = ca.MX.sym("m")
    assert single.Layers.of(ca.Function("step", [m], [table(m)])) is None


@needs_compiler
def test_two_instances_do_not_disturb_each_other(exported):
    made, folder = pid_block(), exported("pid", "single")
    one, two = (Program(folder, "pid", made, real=ctypes.c_float) for _ in range(2))
    alone = [one.step({"wanted.measured": 0.01})["command"] for _ in range(5)]
    one.reset()
    mixed = []
    for _, other in itertools.product(range(5), [-0.5]):
        mixed.append(one.step({"wanted.measured": 0.01})["command"])
        two.step({"wanted.measured": other})
    assert mixed == alone

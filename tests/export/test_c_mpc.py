"""C code of model predictive control: the bits of Python on every machine, nothing allocated."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from c_program import (
    BARE,
    SANITIZED,
    WARN,
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
from fmu_tools import COMMANDS
from test_c_code import CLANG

import pam_ocp as pam
from pam_ocp.control import BlockController, Mpc, block
from pam_ocp.control.step import Givens, Step
from pam_ocp.core.block import Block

MOST = {"double": 1e-9, "single": 5e-3}
"""Largest relative deviation from Python's double that self-tests here allow."""


def regulated(horizon: int = 4, sample_time: float = 5e-3, iterations: int = 2) -> Mpc:
    parts = {"pre_contraction": 0.10, "feed": pam.feeds.Regulator(0.05)}
    slide = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, **parts)
    how = {"horizon": horizon, "sample_time": sample_time, "iterations": iterations}
    return Mpc(slide, track={"x": 1.0}, rate=dict.fromkeys(COMMANDS, 0.1), **how)


def valved() -> Mpc:
    """Spool valves with a dead zone, and a muscle with memory."""
    parts = {"feed": pam.feeds.SpoolValve(overlap=0.1), "losses": pam.losses.BoucWen()}
    load = pam.HangingLoad("DMSP-20-400N", mass=20.0, **parts)
    weights = {"track": {"x": 1.0}, "rate": {"muscle.command": 0.02}}
    how = {"iterations": 1, "method": "rosenbrock", "substeps": 1}
    return Mpc(load, horizon=5, sample_time=5e-3, **weights, **how)


KINDS = {"regulated": regulated, "valved": valved}


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """(kind, precision) -> (its block, a folder with its C), made once."""
    made: dict[Any, Any] = {}

    def export(kind: str, precision: Any = "double") -> tuple[Block, Path]:
        if kind not in made:
            mpc = KINDS[kind]()
            made[kind] = block(mpc, plant=mpc.plant)
        if (kind, precision) not in made:
            folder = tmp_path_factory.mktemp(f"{kind}_{precision}") / "c"
            how = {"precision": precision, "steps": 20, "tolerance": MOST[precision]}
            made[kind, precision] = pam.export_c(made[kind], folder, name="mpc", **how)
        return made[kind], made[kind, precision]

    return export


both = pytest.mark.parametrize("kind", KINDS)
precisions = pytest.mark.parametrize("precision", ["double", "single"])


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("kind", "at"), [("regulated", 0.0), ("valved", 0.04)])
def test_a_loop_is_the_same_bit_for_bit(kind, at, exports):
    (made, folder), plant = exports(kind), KINDS[kind]().plant

    def told(t):
        return {"wanted.x": at + 0.005 * np.sin(6.0 * t)}

    sides = BlockController(made, told), Program(folder, "mpc", made, told)
    start = plant.equilibrium(x=at, stiffness=2e4) if at == 0.0 else plant.equilibrium(x=at)
    real = {"duration": 0.3, "start": start, "noise": {"x": 1e-6}}
    one, other = (pam.closed_loop(side, plant, **real) for side in sides)
    assert np.ptp(one["x"]) > 2e-3
    for name in ("x", *(v.name for v in plant.inputs)):
        assert np.array_equal(one[name], other[name])


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("there", [on_aarch64, on_cortex_m7])
def test_other_processors_give_the_same_bits(there, exports):
    _, folder = exports("regulated")
    assert bits_of(there(folder, "mpc")) == bits_of(selftest(folder, "mpc"))


@pytest.mark.slow
@needs_compiler
def test_another_c_library_gives_the_same_but_for_the_last_digits_of_pow(exports):
    """With valves it calls pow, whose last bit no standard fixes; 20 steps may add up a hundred."""
    _, folder = exports("valved")
    printed = on_aarch64(folder, "mpc")
    assert "passed" in printed
    deviation = re.search(r"largest deviation ([0-9.e+-]+)", printed)
    assert deviation is not None
    assert float(deviation[1]) < 100 * 2.0**-52


@pytest.mark.slow
@needs_compiler
@both
def test_single_precision_is_near_to_double(kind, exports):
    _, folder = exports(kind, "single")
    assert "passed" in selftest(folder, "mpc")


@pytest.mark.slow
@both
@precisions
def test_sanitizers_find_nothing(kind, precision, exports):
    require_works(CLANG, *SANITIZED)
    _, folder = exports(kind, precision)
    assert "passed" in selftest(folder, "mpc", "-O1", *SANITIZED, compiler=[CLANG])


TARGETS = {
    "x86-64": ("-target", "x86_64-linux-gnu.2.17"),
    "aarch64": ("-target", "aarch64-linux-gnu.2.17"),
    "cortex-m7": (
        *("-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m7", "-ffreestanding"),
        *("-I", str(BARE / "include")),  # math.h, which a toolchain for it has
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("target", TARGETS)
@precisions
def test_it_compiles_without_a_warning(target, precision, exports):
    # the warnings are those of clang's front end: optimising finds no more
    more = ("-Wpedantic", "-Wdouble-promotion", "-Wshadow", "-O0")
    one = {"double": "valved", "single": "regulated"}[precision]
    kinds = KINDS if target == "x86-64" else [one]
    for kind in kinds:
        _, folder = exports(kind, precision)
        run(*ZIG, *TARGETS[target], *WARN, *more, "-c", "mpc.c", "-o", "mpc.o", cwd=folder)
        assert (folder / "mpc.o").stat().st_size > 0


# ---- what comes in and what goes on -------------------------------------------------------------
@pytest.mark.slow
@needs_compiler
@both
def test_missing_measurements_give_in_c_what_they_give_in_python(kind, exports):
    """A fifth of all measurements is no number, and for 30 samples all of them."""
    made, folder = exports(kind)
    program, place = Program(folder, "mpc", made), [v.name for v in made.outputs].index("status")
    states = []
    for found, outputs in with_gaps(made, program, samples=100, seed=8, blind=range(40, 70)):
        assert np.array_equal(found, outputs)
        assert np.all(np.isfinite(outputs))
        states.append(int(found[place]))
    assert any(s & 2 for s in states)  # a measurement is missing
    assert any(s & 4 for s in states[50:70])  # for too long: the safe commands


ALLOCATIONS = """
#include "mpc.h"
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
static long count;
void *__real_malloc(size_t), *__real_calloc(size_t, size_t), *__real_realloc(void *, size_t);
void *__wrap_malloc(size_t n) { count++; return __real_malloc(n); }
void *__wrap_calloc(size_t n, size_t m) { count++; return __real_calloc(n, m); }
void *__wrap_realloc(void *p, size_t n) { count++; return __real_realloc(p, n); }
static mpc_state state;
static uint32_t sum, seed;
static double noise(void) {
    seed = seed * 1664525u + 1013904223u;
    return (double)(seed >> 8) / 8388608.0 - 1.0;
}
static void steps(void) {
    mpc_parameters p;
    mpc_inputs u, given;
    mpc_outputs y;
    size_t i;
    mpc_init(&state, &p, &u);
    sum = 2166136261u, seed = 1;
    for (int k = 0; k < 10000; ++k) {
        given = u;
        given.x = u.x + 1e-5 * noise();
        given.wanted_x = u.x + (k / 50 % 2 ? 0.004 : 0.001);
        mpc_step(&state, &p, &given, &y);
        for (i = 0; i < sizeof y; ++i) sum = (sum ^ ((unsigned char *)&y)[i]) * 16777619u;
    }
}
int main(void) {
    volatile size_t size = 8;
    void *volatile one = malloc(size);
    const long counted = count;
    uint32_t first;
    free(one);
    count = 0;
    steps(), first = sum, steps();
    fprintf(stderr, "%s", "");
    printf("%ld %ld %d\\n", counted, count, first == sum);
    return 0;
}
"""


@pytest.mark.slow
@needs_compiler
@both
def test_ten_thousand_steps_allocate_nothing_and_are_the_same_twice(kind, exports):
    """Every allocation of the program is counted by the linker's --wrap; one that is made on
    purpose shows that it is.
    """
    _, folder = exports(kind)
    hook = "-Wl," + ",".join(f"--wrap={n}" for n in ("malloc", "calloc", "realloc"))
    assert printed_by(ALLOCATIONS, folder, "mpc.c", hook) == ["1", "0", "1"]


# ---- a long time --------------------------------------------------------------------------------
LONG = """
#include "mpc.h"
#include "slide.h"
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#define PERIOD 100
static mpc_state law;
static slide_state plant;
int main(int count, char **arguments) {
    mpc_parameters p; mpc_inputs u; mpc_outputs y;
    slide_parameters sp; slide_inputs su; slide_outputs sy;
    const long periods = atol(arguments[count - 1]);
    double first[PERIOD], worst = 0, most = 0, work = 0;
    mpc_init(&law, &p, &u);
    slide_init(&plant, &sp, &su);
    for (long n = 0; n < periods; ++n)
        for (int k = 0; k < PERIOD; ++k) {
            slide_step(&plant, &sp, &su, &sy);
            u.x = sy.x, u.v = sy.v;
            u.muscle1_pressure = sy.muscle1_pressure, u.muscle2_pressure = sy.muscle2_pressure;
            u.wanted_x = k < PERIOD / 2 ? -0.006 : 0.006;
            mpc_step(&law, &p, &u, &y);
            su.muscle1_command = y.muscle1_command, su.muscle2_command = y.muscle2_command;
            if (n == 9) first[k] = sy.x;
            if (n > 9) worst = fmax(worst, fabs(sy.x - first[k]));
            most = fmax(most, fabs(sy.x)), work = fmax(work, y.solver_work);
            if (y.status != 0 && n > 9 && y.status != 8) return 1;
        }
    printf("%.17g %.17g %g\\n", worst, most, work);
    return 0;
}
"""


def plant_block(mpc: Mpc) -> Block:
    """The plant of a controller as a sampled Block: outputs are the states before the step."""
    plant, given = mpc.plant, Givens(mpc.plant)
    x, u, none = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs)), ca.SX(0, 1)
    xn, un = (np.array([v.nominal for v in part]) for part in (plant.states, plant.inputs))
    q = ca.SX(given.vector())
    after = Step(mpc.sample_time, "rk4", 20).expression(given, x / xn, u / un, q) * xn
    outputs = tuple(pam.Variable(v.name, "output", unit=v.unit) for v in plant.states)
    memory = tuple(pam.Variable(f"kept.{v.name}", "state", start=v.start) for v in plant.states)
    step = ca.Function("step", [x, u, none], [after, x])
    return Block("slide", mpc.sample_time, plant.inputs, outputs, (), memory, step)


def long_loop(folder: Path, periods: int) -> tuple[float, float, float]:
    """(largest distance of a period from the tenth, largest position, most work) of a loop in C."""
    mpc = regulated(horizon=10, sample_time=0.02, iterations=1)
    pam.export_c(block(mpc, plant=mpc.plant), folder / "mpc", name="mpc", steps=5, tolerance=1e-9)
    pam.export_c(plant_block(mpc), folder / "slide", name="slide", steps=5, tolerance=1e-9)
    files = ["mpc/mpc.c", "slide/slide.c", "-Impc", "-Islide"]
    worst, most, work = map(float, printed_by(LONG, folder, *files, given=(periods,)))
    return worst, most, work


@pytest.mark.slow
@needs_compiler
def test_a_loop_does_not_drift(tmp_path):
    """A reference of 2 s in a loop of controller and plant: ten minutes later the motion is still
    that of the tenth period. (``long_loop(folder, 43200)`` is a day.)
    """
    worst, most, work = long_loop(tmp_path, 300)
    assert most > 5e-3
    assert worst < 1e-9
    assert work <= 20


def test_the_readme_of_an_export_states_the_worst_case(exports):
    made, folder = exports("regulated")
    readme = (folder / "README.md").read_text()
    for what, most in made.loops.items():
        assert f"- {what}: {most}" in readme

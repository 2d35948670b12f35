"""The FMU's integrator (fmu/src/solver.c) on its own: order, stiffness, failure."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pam_ocp.export.compile import compile_library, native
from pam_ocp.export.source import c_text

PROGRAMS = Path(__file__).parents[2] / "fmu" / "tests"

OK, NOT_FINITE, STEP_TOO_SMALL, TOO_MANY_STEPS = range(4)


@dataclass
class Outcome:
    status: int
    x: Any
    reached: float
    steps: int


@pytest.fixture(scope="module")
def solver(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Outcome]:
    """solver(problem, x, span, tolerance=..., fixed_step=..., max_steps=...)"""
    folder = tmp_path_factory.mktemp("solver")
    harness = (PROGRAMS / "solver_harness.c").read_text("utf-8")
    loaded: dict[int, Any] = {}

    def library(problem: int) -> Any:
        if problem not in loaded:
            sources = {n: c_text(n) for n in ("solver.c", "solver.h")}
            sources["harness.c"] = f"#define PROBLEM {problem}\n{harness}"
            path = folder / f"solver{problem}{native().suffix}"
            path.write_bytes(compile_library(sources, "harness.c", native(), "solver"))
            loaded[problem] = ctypes.CDLL(str(path))
        return loaded[problem]

    def advance(problem: int, x: Any, span: float, **options: Any) -> Outcome:
        given = {"tolerance": 1e-6, "fixed_step": 0.0, "max_steps": 1_000_000, **options}
        state, numbers = (ctypes.c_double * len(x))(*x), (ctypes.c_double * 4)()
        sizes = (ctypes.c_double(v) for v in (span, given["tolerance"], given["fixed_step"]))
        most = ctypes.c_long(given["max_steps"])
        status = library(problem).advance(*sizes, most, state, numbers)
        return Outcome(status, np.array(state), numbers[0], int(numbers[2]))

    return advance


def non_autonomous(t: float, x: Any) -> list[float]:
    return [-x[0] * x[1] + np.sin(3 * t), x[0] - x[1] + t * t]


def van_der_pol(t: float, x: Any) -> list[float]:
    return [x[1], 1e3 * (1 - x[0] ** 2) * x[1] - x[0]]


def robertson(t: float, x: Any) -> list[float]:
    down, up, burnt = 0.04 * x[0], 1e4 * x[1] * x[2], 3e7 * x[1] ** 2
    return [-down + up, down - up - burnt, burnt]


def test_order_is_five_also_with_explicit_time_and_the_error_follows_the_tolerance(solver):
    x0, span = [1.0, 0.5], 2.0
    truth = solve_ivp(non_autonomous, (0, span), x0, method="DOP853", rtol=1e-13, atol=1e-14)

    def error(**options):
        return np.max(np.abs(solver(1, x0, span, **options).x - truth.y[:, -1]))

    errors = np.array([error(fixed_step=span / n) for n in (20, 40, 80, 160)])
    orders = np.log2(errors[:-1] / errors[1:])
    assert np.all(orders > 4.85), orders
    assert orders[-1] > 4.95, orders
    assert np.all(orders < 5.2), orders
    errors = [error(tolerance=10.0**-k) for k in (4, 6, 8, 10)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 1e-9


@pytest.mark.parametrize("span", [1.0, 600.0, 1500.0])
def test_stiff_van_der_pol_agrees_with_radau(solver, span):
    x0 = [2.0, 0.0]
    truth = solve_ivp(van_der_pol, (0, span), x0, method="Radau", rtol=1e-11, atol=1e-13)
    found = solver(2, x0, span, tolerance=1e-10)
    assert found.status == OK
    assert found.x == pytest.approx(truth.y[:, -1], rel=2e-6, abs=1e-9)


def test_stiff_robertson_needs_few_steps_and_keeps_mass(solver):
    x0, span = [1.0, 0.0, 0.0], 1e4
    truth = solve_ivp(robertson, (0, span), x0, method="Radau", rtol=1e-11, atol=1e-15)
    found = solver(3, x0, span, tolerance=1e-9)
    assert found.status == OK
    assert found.steps < 500
    assert found.x == pytest.approx(truth.y[:, -1], rel=1e-5)
    assert np.sum(found.x) == pytest.approx(1.0, abs=1e-12)


def test_fixed_step_makes_just_the_steps_asked_for(solver):
    assert solver(1, [1.0, 0.5], 1.0, fixed_step=0.1).steps == 10
    assert solver(1, [1.0, 0.5], 1.0, fixed_step=0.3).steps == 4  # none longer than asked for
    assert solver(1, [1.0, 0.5], 1.0, fixed_step=7.0).steps == 1


def test_blow_up_is_reported_with_the_time_reached(solver):
    found = solver(4, [1.0, 0.0], 2.0)  # x = 1/(1 - s)
    assert found.status in (STEP_TOO_SMALL, NOT_FINITE, TOO_MANY_STEPS)
    assert 0.9 < found.reached < 1.01
    assert np.all(np.isfinite(found.x))


def test_nan_at_the_start_and_too_many_steps_are_reported(solver):
    assert solver(1, [np.nan, 0.0], 1.0).status == NOT_FINITE
    found = solver(2, [2.0, 0.0], 1500.0, tolerance=1e-10, max_steps=50)
    assert found.status == TOO_MANY_STEPS
    assert 0 < found.reached < 1500


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_the_solvers_own_program_finds_no_failure(tmp_path):
    """fmu/tests/test_solver.c, which CMake builds too: what only C can call."""
    program = tmp_path / "test_solver"
    sources = ["-I", str(PROGRAMS.parent / "src"), str(PROGRAMS / "test_solver.c")]
    subprocess.run(["gcc", "-std=c11", "-O1", *sources, "-o", str(program), "-lm"], check=True)
    done = subprocess.run([str(program)], capture_output=True, text=True, check=False)
    assert done.stdout == "0 failures\n"

"""Rodas5P written out: its order, its dense output, its coefficients, stiff and broken systems."""

from __future__ import annotations

import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pam_ocp.numerics import rodas
from pam_ocp.numerics.rodas import Rodas, written_out

T, X, C, P = (ca.SX.sym(n, k) for n, k in (("t", 1), ("x", 2), ("c", 1), ("p", 1)))


def made(*rates: ca.SX) -> Rodas:
    found = written_out(ca.Function("ode", [T, X, C, P], [ca.vertcat(*rates)]))
    assert found is not None
    return found


def driven() -> Rodas:
    """Nonlinear, and time stands in it: x1' = x2 sin t, x2' = -p x1 - x2^3 + c."""
    return made(X[1] * ca.sin(3 * T), -P * X[0] - X[1] ** 3 + C)


def reference(t: np.ndarray, p: float, c: float) -> np.ndarray:
    def slope(s: float, x: np.ndarray) -> list[float]:
        return [x[1] * np.sin(3 * s), -p * x[0] - x[1] ** 3 + c]

    found = solve_ivp(slope, (0, t[-1]), [1.0, 0.5], "DOP853", t, rtol=1e-13, atol=1e-13)
    return np.asarray(found.y.T)


def over(method: Rodas, grid: np.ndarray, tolerance: float, steps: int = 10_000) -> np.ndarray:
    at = (grid, grid[[0, -1]], np.array([[2.0]]), np.array([1.0, 0.5]), np.array([5.0]))
    found = method(*at, tolerance, steps)
    assert found is not None
    return found


@pytest.mark.parametrize("tolerance", [1e-5, 1e-8, 1e-11])
def test_errors_at_ends_of_steps_and_between_them_keep_the_tolerance(tolerance: float) -> None:
    grid = np.linspace(0.0, 4.0, 401)
    wrong = over(driven(), grid, tolerance) - reference(grid, 5.0, 2.0)
    assert 1e-3 * tolerance < np.abs(wrong).max() < 5 * tolerance


def test_a_step_is_of_order_five_and_its_dense_output_of_order_four() -> None:
    """Local errors fall by 2^6 and 2^5 with half the step."""
    method, place = driven(), np.array([0.3, 0.7])
    ends, inside = [], []
    for h in (0.04, 0.02, 0.01):
        rows = np.array(method.step(0.0, h, [1.0, 0.5], 2.0, 5.0)[0].T)
        grid = np.array([0.0, *(h * place), h])
        states = rodas._between(grid, np.array([0.0, h]), np.array([1.0, 0.5]), rows[None])
        wrong = np.abs(states - reference(grid, 5.0, 2.0)).max(axis=1)
        assert wrong[0] == 0.0
        ends.append(wrong[-1])
        inside.append(wrong[1:3].max())
    assert np.log2(ends[1] / ends[2]) > 5.5
    assert np.log2(inside[1] / inside[2]) > 4.8


def test_its_coefficients_are_those_of_the_c_runtime() -> None:
    source = (Path(__file__).parents[2] / "fmu/src/solver.c").read_text()

    def rows(name: str) -> list[float]:
        body = re.search(rf"RODAS_{name}\b[^=]*= (.*?);", source, re.DOTALL)
        assert body is not None
        return [float(v) for v in re.findall(r"-?\d+\.\d+", body[1])]

    flat = [v for row in rodas.A for v in row]
    sixth = [*rodas.A[5]]
    assert rows("GAMMA") == [rodas.GAMMA]
    assert rows("ALPHA") == [*rodas.ALPHA, 1.0, 1.0, 1.0]
    assert rows("D") == [*rodas.SLOPE]
    assert rows("A") == [*flat, *sixth, 1.0, *sixth, 1.0, 1.0]
    assert rows("C") == [v for row in rodas.C for v in row]


def test_a_stiff_system_takes_few_steps() -> None:
    """Explicit ones would be limited to 2e-6: Prothero and Robinson, whose solution is cos t.

    Its ends of steps are nearly exact however long they are; what lies between them is not.
    """
    stiff = made(-1e6 * (X[0] - ca.cos(T)) - ca.sin(T), -X[1])
    steps = 0
    call = stiff.step.call

    def counted() -> None:
        nonlocal steps
        steps += 1
        call()

    stiff.step.call = counted  # type: ignore[method-assign]
    grid = np.linspace(0.0, 10.0, 21)
    at = (grid, grid[[0, -1]], np.zeros((1, 1)), np.ones(2), np.zeros(1))
    found = stiff(*at, 1e-8, 10_000)
    assert found is not None
    np.testing.assert_allclose(found, np.column_stack([np.cos(grid), np.exp(-grid)]), atol=1e-8)
    assert steps < 400


def test_pieces_have_their_own_constants_and_jumps_are_met() -> None:
    """x1' = c: the integral of steps, exact at each break."""
    grid = np.array([0.0, 0.1, 0.35, 0.5, 1.0])
    ramp = made(C, X[0])
    controls = np.array([[1e3], [-1e3], [0.0]])
    found = ramp(grid, grid[[0, 1, 3, 4]], controls, np.zeros(2), np.zeros(1), 1e-10, 1000)
    assert found is not None
    np.testing.assert_allclose(found[:, 0], [0.0, 100.0, -150.0, -300.0, -300.0], atol=1e-7)


@pytest.mark.parametrize(
    ("rates", "start"),
    [
        ((X[0] ** 2, -X[1]), 2.0),  # infinite at t = 0.5
        ((-ca.sqrt(0.3 - T), -X[1]), 0.0),  # no number behind t = 0.3
        ((ca.log(X[0]), -X[1]), -1.0),  # none at all
    ],
)
def test_where_nothing_leads_on_it_says_so(rates: tuple[ca.SX, ca.SX], start: float) -> None:
    grid = np.array([0.0, 1.0])
    method = made(*rates)
    at = (grid, grid, np.zeros((1, 1)), np.array([start, 1.0]), np.zeros(1))
    assert method(*at, 1e-6, 10_000) is None


def test_steps_are_counted() -> None:
    grid = np.linspace(0.0, 4.0, 3)
    at = (grid, grid[[0, -1]], np.array([[2.0]]), np.array([1.0, 0.5]), np.array([5.0]))
    assert driven()(*at, 1e-11, 5) is None
    assert driven()(*at, 1e-11, 5000) is not None


def test_a_long_step_is_not_written_out() -> None:
    long = sum((ca.sin(k * X[0]) for k in range(2000)), ca.SX(0))
    assert written_out(ca.Function("ode", [T, X, C, P], [ca.vertcat(long, X[0])])) is None

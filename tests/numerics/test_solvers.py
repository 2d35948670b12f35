"""Solvers of CasADi as this library calls them: they print nothing, and say what went wrong."""

from __future__ import annotations

import math

import casadi as ca
import pytest
from conftest import refused

from pam_ocp.numerics.solvers import nlpsol, quiet_ipopt


def solver(*equations: ca.SX, of: ca.SX) -> object:
    problem = {"x": of, "f": ca.sumsqr(of), "g": ca.vertcat(*equations)}
    return nlpsol("least", "ipopt", problem, quiet_ipopt())


def test_more_equations_than_unknowns_print_nothing_and_are_a_status(capfd) -> None:
    x = ca.SX.sym("x")
    found = solver(x - 1, x - 2, of=x)
    found(lbg=0, ubg=0)
    assert found.stats()["return_status"] == "Not_Enough_Degrees_Of_Freedom"
    assert found.stats()["iter_count"] == 0
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("low", "high"), [([0.0, 1.0], [1.0, 0.0]), ([0.0, math.nan], 1.0)])
def test_crossed_bounds_are_refused_with_their_place(low, high) -> None:
    x = ca.SX.sym("x", 2)
    refused("bound 1 of x", solver(x[0], of=x), lbx=low, ubx=high)


def test_bounds_that_meet_are_an_equality() -> None:
    x = ca.SX.sym("x", 2)
    found = solver(x[0] + x[1], of=x)(lbx=[1.0, -5], ubx=[1.0, 5], lbg=0, ubg=0)
    assert found["x"].full().ravel() == pytest.approx([1.0, -1.0])


def test_a_report_that_says_true_ends_the_solve_where_it_is() -> None:
    x = ca.SX.sym("x", 2)
    rosenbrock = (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
    seen: list[float] = []

    def report(at: ca.DM, value: ca.DM, rows: ca.DM) -> bool:
        seen.append(float(value))
        return len(seen) == 4

    found = nlpsol("valley", "ipopt", {"x": x, "f": rosenbrock}, quiet_ipopt(), report=report)
    result = found(x0=[-1.2, 1.0])
    assert found.stats()["return_status"] == "User_Requested_Stop"
    assert len(seen) == 4
    assert float(result["f"]) == seen[-1]

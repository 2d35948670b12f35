"""plan against optima that are known: by hand, by the literature,
by SciPy's boundary value solver.
"""

import casadi as ca
import numpy as np
import pytest
from conftest import pushed
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp import Collocation

REST = [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]


@pytest.mark.parametrize("points", ["radau", "gauss"])
def test_least_time_of_the_double_integrator(points):
    """T = 2 sqrt(d/a) (Bryson, Ho, Applied Optimal Control, 1975); the switch is on the mesh."""
    plan = pam.plan(pushed(1.0), REST, rest=False, method=Collocation(10, 3, points=points))
    assert plan.duration == pytest.approx(2.0, rel=1e-6)
    assert plan.trajectory["u"][[0, -1]] == pytest.approx([1.0, -1.0], abs=1e-6)


@pytest.mark.parametrize("points", ["radau", "gauss"])
def test_bryson_denham(points):
    """x <= L = 1/9: half the squared input comes to 4/(9 L) = 4 (Bryson, Ho 1975, sect. 3.11)."""
    method = Collocation(30, 3, "linear", points)  # the contact's ends 1/3, 2/3 are on the mesh
    asked = {"duration": 1.0, "minimise": {"effort": 0.5}, "bounds": {"x": (None, 1 / 9)}}
    ends = [{"x": 0.0, "v": 1.0}, {"x": 0.0, "v": -1.0}]
    plan = pam.plan(pushed(20.0), ends, rest=False, method=method, **asked)
    assert plan.objective == pytest.approx(4.0, rel=1e-6)


def van_der_pol():
    plant = pam.Plant("van_der_pol")
    x1, x2 = plant.state("x1", start=0.0), plant.state("x2", start=1.0)
    u = plant.input("u", min=-0.3, max=1.0)
    plant.der(x1, (1 - x2**2) * x1 - x2 + u)
    plant.der(x2, x1)
    return plant


def van_der_pol_by_pontryagin():
    """Integral of x1^2 + x2^2 + u^2 over 5 s from the canonical equations, u = clip(-l1/2)."""

    def input_of(costate):
        return np.clip(-costate / 2, -0.3, 1.0)

    def rates(t, z):
        x1, x2, l1, l2, _ = z
        u = input_of(l1)
        return np.array(
            [
                (1 - x2**2) * x1 - x2 + u,
                x1,
                -2 * x1 - l1 * (1 - x2**2) - l2,
                -2 * x2 + l1 * (2 * x1 * x2 + 1),
                x1**2 + x2**2 + u**2,
            ]
        )

    def ends(a, b):
        return np.array([a[0], a[1] - 1, b[2], b[3], a[4]])

    t = np.linspace(0, 5, 400)
    start = np.vstack([np.zeros_like(t), np.exp(-t), np.zeros((3, len(t)))])
    found = solve_bvp(rates, ends, t, start, tol=1e-7, max_nodes=200_000)
    assert found.success
    return found.y[4, -1]


def test_van_der_pol():
    plant = van_der_pol()
    x1, x2 = plant.expression("x1"), plant.expression("x2")
    plan = pam.plan(
        plant,
        [{"x1": 0.0, "x2": 1.0}, {"x1": (-2.0, 2.0)}],
        rest=False,
        duration=5.0,
        minimise="effort",
        integrand=x1**2 + x2**2,
        method=Collocation(120, 4, "polynomial"),
    )
    assert plan.objective == pytest.approx(van_der_pol_by_pontryagin(), rel=1e-6)
    # TOMLAB/PROPT's example collection gives 2.8673
    assert plan.objective == pytest.approx(2.8673, abs=5e-4)


def test_brachistochrone():
    """A bead slides to (1, -1) fastest on a cycloid: T = phi sqrt(r/g) (Johann Bernoulli 1697)."""
    g = 9.81
    plant = pam.Plant("bead")
    x, y, v = plant.state("x", max=5.0), plant.state("y", max=5.0), plant.state("v", min=0.0)
    angle = plant.input("angle", min=0.0, max=np.pi, start=0.8)
    plant.der(x, v * ca.sin(angle))
    plant.der(y, v * ca.cos(angle))
    plant.der(v, g * ca.cos(angle))
    plan = pam.plan(
        plant,
        [{"x": 0.0, "y": 0.0, "v": 0.0}, {"x": 1.0, "y": 1.0}],
        rest=False,
        method=Collocation(6, 7, "polynomial"),
    )
    phi = brentq(lambda a: (a - np.sin(a)) / (1 - np.cos(a)) - 1.0, 0.1, 6.0)
    exact = phi * np.sqrt(1 / (1 - np.cos(phi)) / g)
    assert plan.duration == pytest.approx(exact, rel=1e-6)
    assert plan.replay_error < 1e-6

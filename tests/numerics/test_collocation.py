"""Points, polynomials and matrices of collocation, against theory and NumPy's polynomials."""

import casadi as ca
import numpy as np
import pytest
from numpy.polynomial import Polynomial
from numpy.polynomial.legendre import Legendre, leggauss

from pam_ocp.numerics.collocation import collocation_matrices, collocation_points, lagrange


@pytest.mark.parametrize("degree", [1, 2, 5, 9])
def test_gauss_points_are_numpys(degree):
    assert collocation_points("gauss", degree) == pytest.approx((leggauss(degree)[0] + 1) / 2)


@pytest.mark.parametrize("degree", [1, 2, 5, 9])
def test_radau_points_are_the_roots_of_legendre_polynomials_and_end_at_1(degree):
    """P_d - P_(d-1) on -1 .. 1 (Hairer and Wanner, IV.5: the right Radau points)."""
    roots = (Legendre.basis(degree) - Legendre.basis(degree - 1)).roots()
    found = collocation_points("radau", degree)
    assert found == pytest.approx(np.sort((roots.real + 1) / 2), abs=1e-12)
    assert found[-1] == 1.0


@pytest.mark.parametrize("degree", range(1, 10))
@pytest.mark.parametrize("kind", ["radau", "gauss"])
def test_matrices_are_exact_for_polynomials_of_their_degree(kind, degree):
    random = np.random.default_rng(14)
    p = Polynomial(random.normal(size=degree + 1))
    taus = collocation_points(kind, degree)
    slopes, end, weights = collocation_matrices(taus)
    values = p(np.append(0.0, taus))
    assert values @ slopes == pytest.approx(p.deriv()(taus), abs=1e-9)
    assert values @ end == pytest.approx(p(1.0), abs=1e-10)
    # the quadrature is exact to twice the degree less 1 (Gauss) or 2 (Radau)
    high = Polynomial(random.normal(size=2 * degree - (kind == "radau")))
    assert weights @ high(taus) == pytest.approx(high.integ()(1.0), abs=1e-11)


@pytest.mark.parametrize("order", [0, 1])
def test_lagrange_gives_the_polynomial_and_its_slope_on_numbers_arrays_and_graphs(order):
    random = np.random.default_rng(14)
    nodes = np.sort(random.uniform(0, 1, 5))
    p = Polynomial(random.normal(size=5))
    wanted = p.deriv() if order else p
    at = random.uniform(-0.2, 1.2, 7)
    there = np.stack(lagrange(nodes.tolist(), at, order), axis=-1)
    assert there @ p(nodes) == pytest.approx(wanted(at), abs=1e-6)
    assert np.dot(lagrange(nodes.tolist(), 0.3, order), p(nodes)) == pytest.approx(
        wanted(0.3), abs=1e-6
    )
    s = ca.SX.sym("s")
    graph = ca.Function(
        "p", [s], [ca.dot(ca.vertcat(*lagrange(nodes.tolist(), s, order)), p(nodes))]
    )
    assert float(graph(0.3)) == pytest.approx(wanted(0.3), abs=1e-6)


def test_at_a_node_all_weights_but_one_are_exactly_zero():
    nodes = (0.0, *collocation_points("radau", 9).tolist())
    assert lagrange(nodes, nodes[4]) == [0, 0, 0, 0, 1, 0, 0, 0, 0, 0]
    assert lagrange((0.5,), np.zeros(2))[0].tolist() == [1.0, 1.0]

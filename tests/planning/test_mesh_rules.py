"""The rules of a mesh: points, weights, and where refinement puts more of them."""

from dataclasses import replace

import numpy as np
import pytest
import searches
from conftest import pushed
from numpy.polynomial import Polynomial, legendre
from searches import solved

import pam_ocp as pam
from pam_ocp import Collocation, InputError
from pam_ocp.planning import Shooting
from pam_ocp.planning.candidate import checked
from pam_ocp.planning.transcription.mesh import (
    Form,
    Interval,
    Mesh,
    doubled_at_most,
    halved,
    held,
    refined,
    watched,
)


def mesh(form, *intervals):
    return Mesh(tuple(intervals), form)


def shape(found):
    return [(i.leg, i.fraction, i.degree) for i in found.intervals]


RADAU, GAUSS = Form("radau", "polynomial", True), Form("gauss", "linear")
SHOOTING = Form("shooting", "constant")


def test_points_are_those_of_gauss_and_radau():
    gauss = (legendre.leggauss(4)[0] + 1) / 2
    assert GAUSS.collocated(4) == pytest.approx(gauss, abs=1e-14)
    assert GAUSS.state_taus(4) == pytest.approx([*gauss, 1.0], abs=1e-14)
    # Radau of degree 2 and 3: roots by hand
    assert RADAU.collocated(2) == pytest.approx([1 / 3, 1.0], abs=1e-14)
    r = np.sqrt(6)
    assert RADAU.state_taus(3) == pytest.approx([(4 - r) / 10, (4 + r) / 10, 1.0], abs=1e-14)
    assert list(SHOOTING.collocated(3)) == []
    assert list(SHOOTING.state_taus(3)) == [1.0]
    assert SHOOTING.profile_taus(2) == pytest.approx([0, 0.25, 0.5, 0.75, 1.0])
    assert RADAU.profile_taus(2) == pytest.approx([0, 1 / 3, 1])


def test_inputs_have_a_value_at_the_start_at_both_ends_or_at_each_point():
    assert list(SHOOTING.input_taus(3)) == [0.0]
    assert list(GAUSS.input_taus(3)) == [0.0, 1.0]
    assert RADAU.input_taus(2) == pytest.approx([1 / 3, 1.0])


@pytest.mark.parametrize("form", [RADAU, GAUSS, Form("gauss", "polynomial"), SHOOTING])
def test_weights_and_powers_are_those_of_the_polynomial_through_the_values(form):
    degree = 3
    taus = form.input_taus(degree)
    values = np.random.default_rng(1).uniform(-1, 1, len(taus))
    through = Polynomial.fit(taus, values, len(taus) - 1, domain=[0, 1], window=[0, 1])
    assert form.input_powers(degree) @ values == pytest.approx(through.coef, abs=1e-12)
    for tau in (0.0, 0.27, 1.0):
        found = float(np.asarray(form.weights(degree, tau)).ravel() @ values)
        assert found == pytest.approx(through(tau), abs=1e-12)


@pytest.mark.parametrize("scheme", ["radau", "gauss"])
def test_states_run_through_their_start_and_their_points(scheme):
    form = Form(scheme, "constant")
    states = [0.0, *form.state_taus(3)]
    cubic = Polynomial([0.3, -1.0, 2.0, 0.7])
    for tau in (0.0, 0.41, 0.9):
        weights = np.asarray(form.state_weights(3, tau)).ravel()
        assert len(weights) == len(states)
        assert weights @ cubic(np.array(states)) == pytest.approx(cubic(tau), abs=1e-12)


def test_checks_lie_evenly_between_the_points():
    """Three of a polynomial's bounds, 15 of what was seen beyond; 5 where inputs are simple."""
    third = np.array([1, 2, 3]) / 4
    expected = [0.0, *(third / 3), *(1 / 3 + third * 2 / 3)]
    assert RADAU.guard_taus(2) == pytest.approx(expected)
    assert len(RADAU.watch_taus(2)) == 1 + 2 * 15
    assert len(Form("radau", "linear").watch_taus(2)) == 1 + 2 * 5
    assert len(GAUSS.watch_taus(2)) == 1 + 3 * 5  # the end is no point of Gauss
    assert list(Form("radau", "polynomial").guard_taus(2)) == []
    assert list(Form("radau", "linear", True).guard_taus(2)) == []
    assert list(SHOOTING.watch_taus(4)) == pytest.approx(np.arange(6) / 6)


def test_the_clock_counts_each_leg_in_its_own_duration():
    two = mesh(SHOOTING, Interval(0, 0.25, 4), Interval(0, 0.75, 4), Interval(1, 1.0, 4))
    lengths, starts = two.clock(np.array([2.0, 3.0]))
    assert np.array_equal(lengths, [[0.5, 0], [1.5, 0], [0, 3.0]])
    assert np.array_equal(starts, [[0, 0], [0.5, 0], [2.0, 0], [2.0, 3.0]])
    assert [two.first(node) for node in range(3)] == [0, 2, 3]
    assert shape(Collocation(2, 5).mesh(2)) == [(0, 0.5, 5)] * 2 + [(1, 0.5, 5)] * 2
    assert shape(Shooting(1, 7).mesh(2)) == [(0, 1.0, 7), (1, 1.0, 7)]


def test_an_interval_that_exceeds_a_limit_is_watched_then_with_a_margin_then_split():
    one, other = Interval(0, 0.6, 8), Interval(0, 0.4, 8)
    beyond = [{"x": 0.02, "v": 0.0005}]
    both = watched(mesh(RADAU, other, one, other), [{}, *beyond, {}], 1e-3).intervals
    assert both == (other, replace(one, watched=(("x", 0.0),)), other)
    first = watched(mesh(RADAU, one), beyond, 1e-3)
    assert first.intervals[0].watched == (("x", 0.0),)
    second = watched(first, [{"x": 0.02}], 1e-3)
    assert second.intervals[0].watched == (("x", pytest.approx(0.024)),)
    third = watched(second, [{"x": 0.01, "v": 0.5}], 1e-3)
    assert dict(third.intervals[0].watched) == {"x": pytest.approx(0.036), "v": 0.0}
    fourth = watched(third, [{"x": 0.02}], 1e-3)  # the margin would be 0.06
    assert shape(fourth) == [(0, 0.3, 5)] * 2
    assert fourth.intervals[0].watched == ()
    assert shape(watched(mesh(RADAU, Interval(0, 0.6, 4)), beyond, 1.0)) == [(0, 0.6, 4)]
    low = Interval(0, 0.6, 3, watched=(("x", 0.049),))
    assert shape(watched(mesh(RADAU, low), beyond, 1e-3)) == [(0, 0.3, 3)] * 2
    assert shape(watched(mesh(SHOOTING, one), beyond, 1e-3)) == [(0, 0.3, 8)] * 2


def test_halved_and_held_meshes_keep_the_time():
    one = Interval(1, 0.6, 4, watched=(("x", 0.1),))
    assert shape(halved(mesh(RADAU, one))) == [(1, 0.3, 4)] * 2
    assert shape(halved(mesh(GAUSS, one))) == [(1, 0.3, 7)] * 2
    assert shape(halved(mesh(GAUSS, Interval(1, 0.6, 9)))) == [(1, 0.3, 9)] * 2
    assert shape(halved(mesh(SHOOTING, one))) == [(1, 0.3, 4)] * 2
    assert halved(mesh(RADAU, one)).intervals[0].watched == ()
    found = held(mesh(RADAU, one))
    assert shape(found) == [(1, pytest.approx(0.15), 3)] * 4
    assert (found.form.control, found.form.scheme) == ("constant", "radau")
    assert found.intervals[0].watched == ()


@pytest.mark.parametrize(
    ("form", "interval", "error", "expected"),
    [
        (RADAU, Interval(0, 1.0, 4), 1e-3, [(0, 1.0, 4)]),
        (RADAU, Interval(0, 1.0, 4), 1.1e-3, [(0, 1.0, 5)]),  # one decade: at least 1
        (RADAU, Interval(0, 1.0, 4), 0.9, [(0, 1.0, 6)]),  # three decades
        (RADAU, Interval(0, 1.0, 4), np.inf, [(0, 1.0, 6)]),  # counts as four
        (RADAU, Interval(0, 1.0, 9), 0.01001, [(0, 0.5, 5)] * 2),
        (RADAU, Interval(0, 1.0, 9), 0.9, [(0, 1 / 3, 5)] * 3),
        (RADAU, Interval(0, 1.0, 9), 1e9, [(0, 0.25, 5)] * 4),
        (RADAU, Interval(0, 1.0, 4, raised=True), 0.009, [(0, 0.5, 5)] * 2),
        (GAUSS, Interval(0, 1.0, 4, raised=True), 0.009, [(0, 1.0, 5)]),
        (GAUSS, Interval(0, 1.0, 9, raised=True), 0.009, [(0, 0.5, 7)] * 2),
        (SHOOTING, Interval(0, 1.0, 10), 10.0, [(0, 0.25, 10)] * 4),
        (SHOOTING, Interval(0, 1.0, 4), 0.1, [(0, 1.0, 14)]),  # 4 x 1.1 x 10^(2/4) = 13.9
    ],
)
def test_refinement_raises_degrees_then_splits(form, interval, error, expected):
    found = refined(mesh(form, interval), [error], 1e-3)
    assert shape(found) == [(leg, pytest.approx(part), degree) for leg, part, degree in expected]


def test_a_kink_is_split_after_one_rise_whatever_the_inputs():
    one = Interval(0, 1.0, 4, raised=True)
    assert shape(refined(mesh(GAUSS, one), [0.009], 1e-3, kinks=True)) == [(0, 0.5, 7)] * 2
    raised = refined(mesh(GAUSS, Interval(0, 1.0, 4)), [0.009], 1e-3, kinks=True).intervals
    assert [(i.degree, i.raised) for i in raised] == [(5, True)]
    assert all(i.raised for i in refined(mesh(RADAU, one), [0.009], 1e-3).intervals)
    assert not any(
        i.raised for i in refined(mesh(RADAU, Interval(0, 1.0, 9)), [0.9], 1e-3).intervals
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda: Collocation(0),
        lambda: Collocation(4, 0),
        lambda: Collocation(4, 10),
        lambda: Collocation(4, 3, "cubic"),
        lambda: Collocation(4, 3, points="lobatto"),
        lambda: Shooting(0),
        lambda: Shooting(4, 0),
        lambda: Shooting(4, 65),
        lambda: Shooting(4, 4, "polynomial"),
    ],
)
def test_meshes_that_cannot_be_are_refused(make):
    with pytest.raises(InputError):
        make()


def test_the_smallest_and_the_largest_meshes_are_meshes():
    assert shape(Collocation(1, 1).mesh(1)) == [(0, 1.0, 1)]
    assert shape(Collocation(1, 9, points="gauss").mesh(1)) == [(0, 1.0, 9)]
    assert shape(Shooting(1, 1).mesh(1)) == [(0, 1.0, 1)]
    assert shape(Shooting(1, 64).mesh(1)) == [(0, 1.0, 64)]


# ---- finer for states only -----------------------------------------------------------------------
def test_an_interval_of_a_held_input_that_is_split_keeps_one_value_for_it():
    form = Form("radau", "constant")
    rough, fine = Interval(0, 0.5, 3), Interval(0, 0.5, 3)
    parted = refined(mesh(form, rough, fine), [1.0, 0.0], 1e-3)
    parts = len(parted.intervals) - 1
    assert parts > 1
    assert [i.joined for i in parted.intervals] == [False, *[True] * (parts - 1), False]
    assert parted.held() == [0, parts]


def test_inputs_that_are_polynomials_have_their_own_in_each_part():
    parted = refined(mesh(RADAU, Interval(0, 1.0, 9, raised=True)), [1.0], 1e-3)
    assert len(parted.intervals) > 1
    assert not any(i.joined for i in parted.intervals)


@pytest.mark.parametrize("minimise", ["effort", {"effort": 1.0, "rate": 0.1}], ids=str)
def test_a_mesh_that_is_finer_for_states_only_has_the_same_optimum_where_states_were_exact(
    minimise,
):
    # v' = u, x' = v: cubic polynomials hold the states of any held input
    plant = pushed(9.0)
    stops = [{"x": 0.0}, {"x": 1.0}]
    method = Collocation(6, 3)
    planner = pam.Planner(plant, stops, duration=1.0, minimise=minimise, method=method)
    coarse = solved(planner)
    finer = halved(coarse.program.mesh, joined=True)
    fine = searches.refined(planner, coarse, finer)
    assert fine.outcome.objective == pytest.approx(coarse.outcome.objective, rel=1e-7)
    t = np.linspace(0.0, 1.0, 50)
    assert fine.solution.inputs(t) == pytest.approx(coarse.solution.inputs(t), abs=1e-5)
    assert checked(fine).replay.objective == pytest.approx(fine.outcome.objective, rel=1e-6)


def test_a_mesh_that_grows_at_most_twofold_is_finer_where_errors_are_largest():
    mesh = Collocation(12, 3, control="constant").mesh(1)
    errors = 10.0 ** np.random.default_rng(3).uniform(-6, 2, 12)
    points = [sum(i.degree for i in m.intervals) for m in (mesh, refined(mesh, errors, 1e-7))]
    assert points[1] > 2 * points[0]
    grown = doubled_at_most(mesh, errors, 1e-7)
    assert points[0] < sum(i.degree for i in grown.intervals) <= 2 * points[0]
    ends = np.cumsum([i.fraction for i in mesh.intervals])
    places = np.cumsum([i.fraction for i in grown.intervals])
    share = np.bincount(
        np.searchsorted(ends + 1e-9, places), [i.degree for i in grown.intervals], 12
    )
    rank = np.argsort(errors)
    assert share[rank[-1]] > 3
    assert share[rank[0]] == 3
    assert doubled_at_most(mesh, errors, 1e2 * errors.max()) == mesh
    lost = doubled_at_most(mesh, np.full(12, np.inf), 1e-7)  # nothing is known of the motion
    assert sum(i.degree for i in lost.intervals) <= 2 * points[0]

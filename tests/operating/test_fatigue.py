"""Cycles, damage and derating, against ASTM E1049-85, sums by hand and convexity."""

import math
from itertools import pairwise

import casadi as ca
import numpy as np
import pytest
from conftest import BAR, refused

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.operating import SNCurve, cycles, damage, with_damage

ASTM = [-2.0, 1.0, -3.0, 5.0, -1.0, 3.0, -4.0, 4.0, -2.0]
PLAIN = SNCurve(strength=100.0, slope=3.0, unit="1")


def counted(rows):
    """{range: summed counts}."""
    return {float(r): float(rows[rows[:, 0] == r, 2].sum()) for r in np.unique(rows[:, 0])}


def test_the_example_of_the_standard_is_counted_as_there():
    rows = cycles(ASTM)
    assert counted(rows) == {3: 0.5, 4: 1.5, 6: 0.5, 8: 1.0, 9: 0.5}
    assert set(rows[:, 2]) == {0.5, 1.0}
    assert [list(row) for row in rows if row[2] == 1] == [[4, 1, 1]]  # -1 to 3


def test_samples_between_turning_points_and_plateaus_change_nothing():
    t = np.arange(len(ASTM))
    dense = np.interp(np.linspace(0, t[-1], 20 * t[-1] + 1), t, ASTM)
    assert np.array_equal(cycles(np.repeat(dense, 2)), cycles(ASTM))


def test_a_motion_that_repeats_has_whole_cycles_wherever_it_begins():
    # from 5: 5 -1 3 -4 4 -2 1 -3 5, in which 3..-1, 1..-2 and 4..-3 lie within others
    expected = {9: 1.0, 7: 1.0, 4: 1.0, 3: 1.0}
    for shift in range(8):
        rows = cycles(np.roll(ASTM[:-1], shift), periodic=True)
        assert counted(rows) == expected
        assert np.all(rows[:, 2] == 1)


def test_equal_peaks_are_counted_each():
    assert counted(cycles([0, 1, 0, 1, 0], periodic=True)) == {1: 2.0}
    assert counted(cycles([0, 1, 0, 1, 0])) == {1: 2.0}
    assert counted(cycles([0, 1, 2])) == {2: 0.5}


@pytest.mark.parametrize("row", [[3.0], [3.0, 3.0, 3.0]])
@pytest.mark.parametrize("periodic", [True, False])
def test_where_nothing_changes_there_are_no_cycles_and_no_end(row, periodic):
    assert cycles(row, periodic=periodic).shape == (0, 3)
    worn = damage(row, None, PLAIN, periodic)
    assert (worn.per_run, worn.life, worn.derating(10)) == (0, math.inf, math.inf)


def test_points_are_joined_and_continued_in_log_log():
    curve = SNCurve({"4 bar": 1e4, "1 bar": 1e8, "2 bar": 1e6})
    assert curve.cycles_to_failure([1e5, 2e5, 4e5]) == pytest.approx([1e8, 1e6, 1e4])
    assert curve.cycles_to_failure(math.sqrt(2) * 1e5) == pytest.approx(1e7)
    last = math.log(100) / math.log(2)
    assert curve.cycles_to_failure(8e5) == pytest.approx(1e4 * 2**-last)
    two = SNCurve({"4 bar": 1e4, "1 bar": 1e8})
    law = SNCurve(strength=1e5 * 1e8 ** (1 / 6.643856), slope=6.643856189774724)
    assert two.cycles_to_failure(3e5) == pytest.approx(law.cycles_to_failure(3e5), rel=1e-6)


def test_the_endurance_limit_and_goodman_s_correction():
    curve = SNCurve(strength=100.0, slope=3.0, endurance=2.0, ultimate=50.0, unit="1")
    assert curve.cycles_to_failure([0.0, 2.0]).tolist() == [math.inf, math.inf]
    assert curve.cycles_to_failure(10.0) == pytest.approx(1e3)
    assert curve.cycles_to_failure(10.0, 25.0) == pytest.approx(125.0)  # counts as 20
    assert curve.cycles_to_failure(10.0, -25.0) == pytest.approx(1e3)
    assert curve.cycles_to_failure(2.0, 25.0) == pytest.approx(25.0**3)  # as 4, above the limit
    refused(r"means reach 50 1; .* below ultimate = 50", curve.cycles_to_failure, 1.0, 50.0)


def test_miner_s_sum_of_the_standard_s_example():
    worn = damage(ASTM, None, PLAIN, periodic=False)
    by_hand = (0.5 * 27 + 1.5 * 64 + 0.5 * 216 + 512 + 0.5 * 729) / 1e6
    assert worn.per_run == pytest.approx(by_hand, rel=1e-12)
    assert worn.life == pytest.approx(1 / by_hand)
    assert worn.seconds is None


def test_a_pressure_staircase():
    steps = np.repeat([1, 3, 2, 6, 1], [3, 3, 3, 3, 1]) * BAR  # 3..2 within 1..6
    pressure = pam.core.variables.Variable("p", "output", unit="Pa")
    run = pam.Trajectory(0.5 * np.arange(13), {"p": steps}, [pressure])
    worn = damage(run, "p", SNCurve({"1 bar": 1e7, "5 bar": 1e5}))
    assert counted(worn.cycles) == {1 * BAR: 1, 5 * BAR: 1}
    assert worn.per_run == pytest.approx(1e-7 + 1e-5)
    assert worn.seconds == pytest.approx(6.0 / 1.01e-5)
    text = str(worn)
    assert text.startswith("p: 1.01e-05 of the life in one run: 9.901e+04 runs to failure, after")
    assert "99 %" in text
    assert repr(worn).startswith("<FatigueDamage p: 1.01e-05")
    refused("p is in 'Pa', the curve in '1'", damage, run, "p", PLAIN)
    refused("name is None: name a column, such as 'p'", cycles, run)


def test_derating_brings_miner_s_sum_to_one():
    worn = damage(ASTM, None, PLAIN)
    factor = worn.derating(1e5)
    assert factor == pytest.approx((worn.life / 1e5) ** (1 / 3))
    assert damage(factor * np.array(ASTM), None, PLAIN).life == pytest.approx(1e5)
    bent = SNCurve({1.0: 1e6, 3.0: 1e5, 9.0: 1e2}, unit="1")
    worn = damage(ASTM, None, bent)
    for runs in (1.0, worn.life, 1e7):
        factor = worn.derating(runs)
        assert damage(factor * np.array(ASTM), None, bent).life == pytest.approx(runs)
    assert worn.derating(worn.life) == pytest.approx(1)


def test_derating_stops_at_the_endurance_limit():
    limited = SNCurve(strength=100.0, slope=3.0, endurance=3.0, unit="1")
    worn = damage([0.0, 6.0], None, limited)
    assert worn.derating(1e9) == pytest.approx(0.5, rel=1e-12)  # a range of 3: for ever
    assert worn.derating(1e3) == pytest.approx(10 / 6)


def test_derating_leaves_goodman_s_means():
    curve = SNCurve(strength=100.0, slope=3.0, ultimate=40.0, unit="1")
    worn = damage([10.0, 30.0], None, curve)  # 20 about 20 counts as 40
    assert worn.life == pytest.approx(2.5**3)
    assert worn.derating(1e3) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (lambda: SNCurve(), "give points, or strength and slope"),
        (lambda: SNCurve(strength=1.0), "give points, or strength and slope"),
        (lambda: SNCurve({1: 2, 3: 1}, slope=3), "not both"),
        (lambda: SNCurve({1.0: 10}), "give two or more ranges"),
        (lambda: SNCurve({1.0: 10, 2.0: 10}), "fall as the range grows"),
        (lambda: SNCurve([(1.0, 10), (1.0, 5)]), "each once"),
        (lambda: SNCurve({-1.0: 10, 2.0: 5}), "range of points = -1 Pa must be > 0"),
        (lambda: SNCurve({1.0: 10, 2.0: 0}), r"points\[2.0\] = 0 must be > 0"),
        (lambda: SNCurve(7), "points = 7: give {range: cycles to failure}"),
        (lambda: SNCurve(strength="10 mm", slope=3), "measures something else than 'Pa'"),
        (lambda: SNCurve(strength=0, slope=3), "strength = 0 Pa must be > 0"),
        (lambda: SNCurve(strength=1, slope=-3), "slope = -3 must be > 0"),
        (lambda: SNCurve(strength=1, slope=3, unit="bar"), "unit = 'bar': give the SI unit"),
        (lambda: SNCurve(strength=1, slope=3, endurance=-1), "endurance = -1 Pa must be >= 0"),
        (lambda: PLAIN.cycles_to_failure(-1.0), "ranges = -1 must be >= 0"),
        (lambda: cycles([[1, 2]]), r"shape \(1, 2\)"),
        (lambda: cycles([]), r"shape \(0,\)"),
        (lambda: cycles([1, math.nan]), "sample 1 is nan"),
        (lambda: cycles(ASTM, periodic="yes"), "periodic = 'yes': give True or False"),
        (lambda: damage(ASTM, None, 3.0), "curve is a float: give an SNCurve"),
        (lambda: damage(ASTM, None, PLAIN).derating(0), "runs = 0 must be > 0"),
    ],
)
def test_bad_input_is_named(asked, said):
    refused(said, asked)


# ---- the rate ------------------------------------------------------------------------------------
def follower(nominal=1.0):
    """q' = w, of which the rate and the damage are known."""
    plant = pam.Plant("follower")
    q, w = plant.state("q", unit="Pa", nominal=nominal), plant.input("w", unit="Pa/s")
    plant.der(q, w)
    plant.output("both", q + w, unit="Pa")
    return plant


def bound_of(q, curve, centre):
    """Integral of the rate along straight lines through q, each of 1 s."""
    plant = with_damage(follower(1e-6), "q", curve, centre)
    rate = plant.expression("damage_rate")
    function = ca.Function("rate", [plant.x, plant.u], [rate])
    nodes, weights = np.polynomial.legendre.leggauss(12)
    total = 0.0
    for a, b in pairwise(q):
        # split at the centre: on either side the integrand is a power
        ends = sorted(
            {0.0, 1.0, *([(centre - a) / (b - a)] if (centre - a) * (centre - b) < 0 else [])}
        )
        for s, e in pairwise(ends):
            for node, weight in zip(nodes, weights, strict=True):
                at = a + (s + (e - s) * (node + 1) / 2) * (b - a)
                total += (e - s) / 2 * weight * float(function(at, b - a))
    return total


LAW = SNCurve(strength=50.0, slope=4.0)


def test_the_rate_of_cycles_about_the_centre_integrates_to_their_damage():
    q = [3.0, 7.0, 3.0]
    assert bound_of(q, LAW, 5.0) == pytest.approx((4 / 50) ** 4, rel=1e-6)
    assert damage(q, None, LAW).per_run == pytest.approx((4 / 50) ** 4)


@pytest.mark.parametrize("centre", [-4.0, 0.0, 0.7, 9.0])
def test_the_rate_never_integrates_to_less_than_rainflow_counts(centre):
    random = np.random.default_rng(3)
    for _ in range(4):
        q = random.uniform(-5, 5, 12)
        assert bound_of(q, LAW, centre) >= damage(q, None, LAW, periodic=False).per_run
        closed = [*q, q[0]]
        assert bound_of(closed, LAW, centre) >= damage(closed, None, LAW).per_run


@pytest.mark.filterwarnings("ignore::pam_ocp.PlanWarning")  # coarse meshes, to be quick
def test_a_plan_of_least_damage_lasts_longer_than_a_quick_one_of_the_same_duration():
    plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=10.0, damping=100.0)
    low, high = (plant.equilibrium(x=x)["muscle.pressure"] for x in (0.02, 0.03))
    curve = SNCurve(strength="100 bar", slope=5)
    plant = with_damage(plant, "muscle.pressure", curve, (low + high) / 2)
    least = 0.5 * ((high - low) / 100e5) ** 5  # it rests at both ends, whatever it does between

    def worn(minimise, **more):
        plan = pam.plan(
            plant,
            [{"x": 0.02}, {"x": 0.03}],
            minimise=minimise,
            duration=0.25,
            method=pam.Collocation(6, 3),
            tolerance=None,
            starts=1,
            **more,
        )
        return damage(plan.trajectory, "muscle.pressure", curve, periodic=False).per_run

    quick, lasting = worn("time"), worn({"integral(damage_rate)": 1.0})
    bounded = worn("time", budgets={"integral(damage_rate)": 2 * least})
    assert least <= lasting * (1 + 1e-6)
    assert lasting < 1.2 * least  # the bound is nearly tight
    assert lasting < quick / 2
    assert bounded < 2 * least


def test_variables_and_curves_without_a_rate_are_refused():
    plant = follower()
    for name in ("w", "both"):
        refused(f"{name} (depends on inputs|is in)", with_damage, plant, name, LAW, 0.0)
    with pytest.raises(InputError, match="a damage rate needs Basquin's law"):
        with_damage(plant, "q", SNCurve({1.0: 1e4, 2.0: 1e3}), 0.0)
    with pytest.raises(InputError, match="without ultimate"):
        with_damage(plant, "q", SNCurve(strength=1.0, slope=3.0, ultimate=9.0), 0.0)
    refused("q is in 'Pa', the curve in '1'", with_damage, plant, "q", PLAIN, 0.0)
    refused("centre = '2 mm'", with_damage, plant, "q", LAW, "2 mm")

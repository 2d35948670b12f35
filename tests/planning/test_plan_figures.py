"""The figures that a plan is judged by, against sums written out by hand."""

import math

import hand_equations as hand
import numpy as np
import pytest
from conftest import pushed
from fibres import LONG, THIN, bought
from hand_equations import GRAVITY
from scipy.integrate import trapezoid

import pam_ocp as pam

ROUGH = pam.Collocation(12, 3)


def squares(plan, nominal):
    """Integral of the squared held inputs in nominals."""
    signals = plan.trajectory.signals
    assert signals.degree == 0
    held = signals.coefficients[:, 0] / nominal
    return float(np.sum(held**2 * np.diff(signals.breaks)[:, None]))


BLIND = {"rest": False, "duration": 1.0, "minimise": "effort", "tolerance": None}
BLIND["method"] = pam.Collocation(1, 2, "constant")
"""A mesh that looks at three points."""


def densely(plan, points=4001):
    """The plan's motion on many points, inputs held as planned."""
    return pam.simulate(plan.plant, plan.trajectory, t=np.linspace(0, plan.duration, points))


def test_the_work_of_lifting_a_load_is_its_weight_times_the_way():
    """No damping, x rising throughout: every motion from rest to rest takes m g h."""
    plant = pam.HangingLoad(
        bought(LONG), 20.0, damping=pam.losses.ConstantDamping(0.0), feed=pam.feeds.Regulator(0.05)
    )
    stops = [{"x": 0.05}, {"x": 0.065}]
    plan = pam.plan(
        plant,
        stops,
        duration=0.3,
        minimise={"work": 1.0, "effort": 1e-4},
        method=ROUGH,
        bounds={"v": (0.0, None)},
    )
    work = plan.objective - 1e-4 * squares(plan, 1e5)
    assert work == pytest.approx(20.0 * GRAVITY * 0.015, rel=1e-3)


@pytest.mark.slow
def test_work_is_counted_of_each_muscle_where_it_is_given():
    """Muscles of unequal length and strength: forces and speeds by hand."""
    plant = pam.AntagonisticSlide(bought(LONG), 2.0, 0.10, muscle2=bought(THIN))
    weights = {"work": 1e-3, "effort": 1e-2}
    plan = pam.plan(
        plant, [{"x": -0.008}, {"x": 0.008}], duration=0.25, minimise=weights, method=ROUGH
    )
    run, total = densely(plan), 0.0
    for i, fibre, sign in ((1, LONG, 1), (2, THIN, -1)):
        kappa = 0.10 + sign * run["x"] / fibre.length
        pairs = zip(run[f"muscle{i}.pressure"], kappa, strict=True)
        force = np.array([max(fibre.tension(p, k), 0.0) for p, k in pairs])
        total += trapezoid(np.maximum(sign * force * run["v"], 0.0), run.t)
    assert total > 0.1  # there is work to be counted
    assert plan.objective - 1e-2 * squares(plan, 1e5) == pytest.approx(1e-3 * total, rel=0.01)


@pytest.mark.parametrize("term", ["air", "exergy"])
def test_air_and_exergy_are_what_the_supply_gives(term):
    """Up and down again: what was let out is paid for all the same. Air in g, exergy in 10 J."""
    feed = pam.feeds.OnOffValves(conductance=3e-8, exhaust_conductance=2e-8, supply=6.5e5)
    plant = pam.HangingLoad(bought(LONG), 20.0, feed=feed)
    stops = [{"x": 0.05}, {"x": 0.06}, {"x": 0.05}]
    plan = pam.plan(
        plant,
        stops,
        duration=0.25,
        minimise={term: 1.0, "effort": 0.1},
        method=ROUGH,
        bounds={"muscle.pressure": (0.5e5, 5.5e5)},
    )
    run = densely(plan)
    source = 6.5e5 + hand.AMBIENT
    flow = np.array(
        [
            duty * hand.orifice(source, p + hand.AMBIENT, 3e-8, 0.3, hand.WARM)
            for duty, p in zip(run["muscle.fill"], run["muscle.pressure"], strict=True)
        ]
    )
    drawn = trapezoid(flow, run.t)
    assert abs(trapezoid(run["muscle.mass_flow"], run.t)) < 0.8 * drawn  # some was let out
    worth = {"air": 1e3, "exergy": hand.AIR * hand.WARM * math.log(source / hand.AMBIENT) / 10}
    found = plan.objective - 0.1 * squares(plan, 1.0)
    assert found == pytest.approx(worth[term] * drawn, rel=5e-3)


def mass_on_rails(high):
    """x'' = u with a path constraint of its own on v."""

    def room(plant, x, v, u):
        plant.constraint("room", x * (1 - x), unit="m2", nominal=0.25, max=high)

    return pushed(20.0, also=room, x={"nominal": 0.5})


def test_what_a_path_constraint_is_exceeded_by_between_points_is_said():
    """x (1 - x) peaks at 1/4 half way, where a mesh of one interval of degree 2 does not look."""
    ends, speeds = [{"x": 0.0}, {"x": 1.0}], {"v": (0.5, 1.5)}
    plan = pam.plan(mass_on_rails(0.2), ends, bounds=speeds, **BLIND)
    fine = densely(plan)
    beyond = np.max(fine["x"] * (1 - fine["x"])) - 0.2
    assert beyond == pytest.approx(0.05, abs=1e-6)
    assert plan.replay.constraint == "room"
    assert plan.replay.violation == pytest.approx(beyond / 0.25, rel=0.02)


def test_a_constraint_of_ones_own_is_watched_between_points_too():
    plant = mass_on_rails(1.0)
    x = plant.expression("x")
    bulge = pam.Constraint(4 * x * (1 - x), high=0.8, name="bulge")
    asked = {"bounds": {"v": (0.5, 1.5)}, "constraints": [bulge]}
    plan = pam.plan(plant, [{"x": 0.0}, {"x": 1.0}], **asked, **BLIND)
    assert plan.replay.constraint == "bulge"
    assert plan.replay.violation == pytest.approx(0.2, rel=0.02)


def rails(limit=20.0):
    """x'' = u, nothing else."""
    return pushed(limit, x={"nominal": 0.5}, v={"nominal": 2.0}, u={"nominal": 4.0})


def costs(plan):
    """The objective as the judge, the solver, and the search's own integration count it."""
    return [plan.objective, plan.statistics["objective_on_mesh"], plan.replay.objective]


def test_every_leg_is_watched():
    """Of two legs, out and back, the second alone is held to x (1 - x) <= 0.2."""
    asked = {"phases": [None, pam.Phase(bounds={"room": (None, 0.2)})]}
    asked["method"] = pam.Collocation(1, 2, "linear")
    plan = pam.plan(mass_on_rails(10.0), [{"x": 0.0}, {"x": 1.0}, {"x": 0.0}], **(BLIND | asked))
    peak = float(np.max(densely(plan)["x"][2000:] * (1 - densely(plan)["x"][2000:])))
    assert peak > 0.21
    assert plan.replay.violation == pytest.approx((peak - 0.2) / 0.25, rel=0.05)


def test_a_state_below_its_lower_bound_between_points_is_said():
    """Down to -1/4 and up again: one interval of degree 2 looks at both ends and one point."""
    stops = [{"x": 0.0, "v": -1.0}, {"x": 0.0, "v": 1.0}]
    plan = pam.plan(rails(), stops, bounds={"x": (-0.23, 1.0)}, **BLIND)
    assert densely(plan)["x"].min() == pytest.approx(-0.25, abs=1e-6)
    assert plan.replay.constraint == "x"
    assert plan.replay.violation == pytest.approx(0.02 / 0.5, rel=0.02)


@pytest.mark.parametrize(
    ("wish", "value"),
    [
        # u = 6 - 12 t and v = 6 t (1 - t) of least effort by hand; nominals 4 N and 2 m/s
        ({"minimise": "effort"}, 12.0 / 16.0),
        ({"minimise": "square(u)"}, 12.0 / 16.0),
        ({"minimise": {"square(u)": 1.0, "square(v)": 0.0}, "track": {"u": 0.0}}, 24.0 / 16.0),
        ({"minimise": {"time": 0.0}, "track": {"u": (3.0, 2.0)}}, 2 * (12.0 + 9.0) / 16.0),
    ],
)
def test_objectives_are_in_units_of_nominal(wish, value):
    asked = {"rest": False, "duration": 1.0, "method": pam.Collocation(6, 3, "linear"), **wish}
    plan = pam.plan(rails(), [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}], **asked)
    assert costs(plan) == pytest.approx([value] * 3, rel=1e-7)


def test_the_rate_of_held_inputs_is_that_of_the_line_through_their_middles():
    asked = {"rest": False, "duration": 1.0, "minimise": "rate", "method": pam.Collocation(7, 3)}
    plan = pam.plan(rails(), [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}], **asked)
    signals = plan.trajectory.signals
    middles = (signals.breaks[:-1] + signals.breaks[1:]) / 2
    u = signals.coefficients[:, 0, 0] / 4.0
    rate = np.sum(np.diff(u) ** 2 / np.diff(middles))
    assert costs(plan) == pytest.approx([rate] * 3, rel=1e-9)
    assert plan.objective > 5


def test_a_mirrored_cycle_ends_as_the_mirror_image_of_its_start():
    """Through -8 and 8 mm in motion: v turns its sign, the muscles change places."""
    plant = pam.AntagonisticSlide(bought(LONG), 2.0, 0.10)
    stops = [
        pam.Stop({"x": -0.008, "v": (0.05, 0.2)}, rest=False),
        pam.Stop({"x": 0.008}, rest=False),
    ]
    plan = pam.plan(
        plant, stops, cyclic="mirrored", duration=0.4, minimise={"effort": 1.0}, method=ROUGH
    )
    first, last = plan.trajectory.row(0), plan.trajectory.row(-1)
    assert first["v"] > 0.049
    assert (last["x"], last["v"]) == pytest.approx((-first["x"], -first["v"]), abs=1e-9)
    for one, two in (("muscle1", "muscle2"), ("muscle2", "muscle1")):
        assert last[f"{two}.pressure"] == pytest.approx(first[f"{one}.pressure"], abs=1e-3)


@pytest.mark.parametrize("swapped", [False, True])
def test_where_two_legs_meet_the_bounds_of_both_hold(swapped):
    """At most 2 m/s on one leg and 1 m/s on the other: 1.2 m/s where they meet cannot be."""
    phases = [pam.Phase(bounds={"v": (-3.0, 2.0)}), pam.Phase(bounds={"v": (-3.0, 1.0)})]
    arguments = {
        "phases": phases[::-1] if swapped else phases,
        "duration": 1.3,
        "minimise": "effort",
        "method": pam.Collocation(10, 3),
        "tolerance": None,
    }
    slow, quick = (
        [{"x": 0.0}, pam.Stop({"x": 1.0, "v": v}, rest=False), {"x": 2.0}] for v in (0.9, 1.2)
    )
    assert pam.plan(rails(), slow, **arguments).replay.violation < 0.02
    with pytest.raises(pam.PlanError):
        pam.plan(rails(), quick, **arguments)

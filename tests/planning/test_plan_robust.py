"""robust_plan: each plant's motion against SciPy, the bound of the spread, and its limits."""

import pickle

import numpy as np
import pytest
from conftest import benchmark_slide, pushed, refused, scipy_states

import pam_ocp as pam
from pam_ocp import Avoid, Collocation, Constraint, PlanError, Stop
from pam_ocp.planning.studies.robust import robust_plan
from pam_ocp.plants.ensemble import Ensemble

WIDTH = 2e-4
METHOD = Collocation(20, 3)
STOPS = [{"x": -0.010}, {"x": 0.010}]


def draws(plant, count, seed, scatter=0.02):
    """Each muscle stronger or weaker by a normally distributed factor (all but the exponent a3)."""
    law = [v for v in plant.parameters if ".a" in v.name and not v.name.endswith("a3")]
    factors = 1 + scatter * np.random.default_rng(seed).standard_normal((count, 2))
    return [{v.name: v.start * row[int(v.name[6]) - 1] for v in law} for row in factors]


@pytest.fixture(scope="module")
def plant():
    return benchmark_slide()


@pytest.fixture(scope="module")
def robust(plant):
    asked = {"duration": (0.02, 0.5), "method": METHOD, "share": 0.5, "spread": {"x": WIDTH}}
    return robust_plan(plant, STOPS, draws=draws(plant, 4, 1), unseen=draws(plant, 12, 2), **asked)


def by_scipy(plant, draw, motion, x0):
    return scipy_states(plant.with_values(draw), lambda t: motion.signals(t)[0], motion.t, x0)


def test_every_plant_stays_within_by_scipy(plant, robust):
    motion = robust.trajectory
    assert robust.nominal_members.worst("x") > 1.5 * WIDTH  # the bound is worth something
    worst = 0.0
    for i, draw in enumerate(robust.members.draws):
        found = robust.members.motions[i]
        start = found.array(found.named("state"))[0]
        states = by_scipy(plant, draw, motion, start)
        assert states[:, 0] == pytest.approx(found["x"], abs=1e-9)
        # what the ensemble planned for this plant is what the plant does
        assert robust.plan.trajectory[f"x.draw{i + 1}"] == pytest.approx(states[:, 0], abs=1e-6)
        worst = max(worst, *np.abs(states[[0, -1], 0] - motion["x"][[0, -1]]))
    assert worst == pytest.approx(WIDTH, rel=1e-3)
    assert robust.members.worst("x") == pytest.approx(worst, rel=1e-4)


def test_the_nominal_plant_meets_its_stops_and_pays_little(robust):
    assert robust.trajectory["x"][[0, -1]] == pytest.approx([-0.010, 0.010], abs=1e-10)
    assert 0.0 < robust.price < 0.05
    assert robust.plan.replay_error < 1e-4


def test_each_plant_starts_at_rest_under_the_same_pressures(plant, robust):
    """Forces of the force law by itself, at the start's pressures and each plant's position."""
    for draw, motion in zip(robust.members.draws, robust.members.motions, strict=True):
        own, first = plant.with_values(draw), motion.row(0)
        at = [[first[v.name] for v in variables] for variables in (own.states, own.inputs)]
        forces = own.function(*at, own.vector("parameter"))[1]
        names = [v.name for v in own.outputs]
        one, two = (float(forces[names.index(f"muscle{i}.force")]) for i in (1, 2))
        assert one == pytest.approx(two, abs=1e-4)
        assert first["v"] == pytest.approx(0.0, abs=1e-9)
        begun = robust.trajectory["muscle1.pressure"][0]
        assert first["muscle1.pressure"] == pytest.approx(begun)


def test_no_muscle_of_any_plant_goes_slack(robust):
    for motion in robust.members.motions:
        assert min(motion["muscle1.force"].min(), motion["muscle2.force"].min()) > -1e-3
    assert robust.members.violation[0] < 1e-3


def test_unseen_plants_are_only_simulated(robust):
    assert len(robust.unseen.draws) == 12
    share = robust.unseen.share_within({"x": WIDTH})
    deviations = np.abs(robust.unseen.at_stops("x")).max(axis=1)
    assert share == pytest.approx(np.mean(deviations <= WIDTH * (1 + 1e-6)))
    again = robust.verify([{"parameters": d} for d in robust.unseen.draws[:3]])
    assert again.at_stops("x") == pytest.approx(robust.unseen.at_stops("x")[:3], abs=1e-12)
    assert "unseen" in str(robust)


def test_a_robust_plan_survives_a_file_and_another_process(robust, tmp_path):
    """Rest at the stops is asked of the nominal plant alone there, too."""
    stored = pam.load_plan(robust.plan.save(tmp_path / "robust.npz"))
    assert stored.verified
    assert stored.duration == robust.plan.duration
    there, draws = pickle.loads(pickle.dumps(robust)), robust.unseen.draws[:2]
    one, other = (each.judge(each.verify(draws)).excess for each in (robust, there))
    assert other == pytest.approx(one, abs=1e-9)


def test_pressures_that_all_plants_share_are_not_copied(plant, robust):
    names = [v.name for v in robust.plan.plant.states]
    assert sorted(n for n in names if ".draw1" in n) == ["v.draw1", "x.draw1"]
    lags = Ensemble(plant, [{"muscle1.lag": 0.06}])
    assert [v.name for v in lags.states if "draw" in v.name] == [
        "x.draw1",
        "v.draw1",
        "muscle1.pressure.draw1",
    ]
    copy = pickle.loads(pickle.dumps(lags))
    assert copy.positions == plant.positions


@pytest.mark.slow
def test_a_cycle_closes_for_each_plant(plant):
    asked = {"duration": (0.02, 0.5), "cyclic": True, "method": METHOD, "share": None}
    found = robust_plan(plant, STOPS, draws=draws(plant, 2, 1), spread={"x": 1.5e-4}, **asked)
    for draw, run in zip(found.members.draws, found.members.motions, strict=True):
        states = by_scipy(plant, draw, found.trajectory, run.array(run.named("state"))[0])
        scale = plant.vector("state", attribute="nominal")
        assert np.max(np.abs(states[-1] - states[0]) / scale) < 1e-7
    assert found.members.worst("x") < 1.5e-4 * (1 + 1e-3) < found.nominal_members.worst("x")
    assert found.members.at_stops("x").shape == (2, 3)


def test_a_stop_may_be_left_out_and_a_via_point_be_passed(plant):
    stops = [STOPS[0], Stop({"x": 0.0}, rest=False), STOPS[1]]
    asked = {"duration": (0.01, 0.5), "start": "same", "method": Collocation(12), "share": None}
    spread = [None, None, {"x": 2e-4, "v": 0.01}]
    found = robust_plan(plant, stops, draws=draws(plant, 2, 1), spread=spread, **asked)
    assert found.members.at_stops("x").shape == (2, 1)
    assert found.members.worst("x") < 2e-4 * 1.01
    assert found.members.worst("v") < 0.0101
    for run in found.members.motions:
        assert run["x"][0] == pytest.approx(-0.010, abs=1e-9)


def test_what_the_user_bounds_is_bounded_for_all(plant):
    own = plant.expression("muscle1.force") + plant.expression("muscle2.force")
    arguments = {
        "draws": draws(plant, 2, 1),
        "spread": {"x": 1e-3},
        "duration": 0.1,
        "minimise": "effort",
        "bounds": {"muscle1.force": (30.0, None)},
        "method": Collocation(12),
        "share": None,
        "constraints": [Constraint(own, low=100.0, nominal=100.0), Avoid({"x": (0.013, 0.002)})],
    }
    found = robust_plan(plant, STOPS, **arguments)
    for run in (found.trajectory, *found.members.motions):
        assert run["muscle1.force"].min() > 30.0 - 0.1
        assert np.min(run["muscle1.force"] + run["muscle2.force"]) > 100.0 - 0.1
    loose = robust_plan(plant, STOPS, **arguments, all_within=False)
    assert min(r["muscle1.force"].min() for r in loose.members.motions) < 29.9
    assert loose.plan.objective < found.plan.objective


def test_a_spread_that_cannot_be_is_named():
    """x'' = u/m from rest: every input moves a mass 10 % heavier 1/1.1 as far, 0.0909 m short."""
    plant = pushed(10.0, 1.0, x={"nominal": 0.1})
    arguments = {"draws": [{"mass": 1.1}], "start": "same", "duration": 1.0, "share": None}
    arguments |= {"minimise": "effort", "method": Collocation(5, 4, "linear")}
    stops = [{"x": 0.0}, {"x": 1.0}]
    found = robust_plan(plant, stops, spread={"x": 0.1}, **arguments)
    assert found.members.worst("x") == pytest.approx(1 - 1 / 1.1, rel=1e-6)
    assert found.plan.objective == pytest.approx(found.nominal_plan.objective, rel=1e-6)
    with pytest.raises(PlanError, match="deviation1"):
        robust_plan(plant, stops, spread={"x": 0.05}, **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"draws": []}, "draws is empty"),
        ({"draws": [{"x": 1.0}]}, "x is a state, not a parameter"),
        ({"draws": [{"mass": 1.0}, {"damping": 3.0}]}, "same parameters"),
        ({"draws": [{"mass": -1.0}]}, "outside"),
        ({"draws": [{"mass": "1 m"}]}, "mass: draws = '1 m'"),
        ({"draws": [{"parameters": {"mass": 2.0}, "start": {"v": 0.1}}]}, "a case holds start"),
        ({"spread": {}}, "spread is empty"),
        ({"spread": {"mass": 1.0}}, "mass is a parameter"),
        ({"spread": {"x": -1.0}}, "must be > 0"),
        ({"spread": [{"x": 1e-3}]}, "1 entries for 2 stops"),
        ({"start": "latched"}, "'rest' or 'same'"),
        ({"cyclic": "mirrored"}, "takes True or False"),
        ({"design": {"mass": (1.0, 2.0)}}, "mass is drawn"),
        ({"stops": [Stop({"x": -0.01}, dwell=0.1), {"x": 0.01}]}, "stop 1 has a dwell"),
    ],
)
def test_what_cannot_be_meant_is_refused(plant, arguments, message):
    given = {"draws": [{"mass": 2.1}], "spread": {"x": 1e-3}, "duration": 0.1, "minimise": "effort"}
    given |= {"method": Collocation(5), "stops": STOPS} | arguments
    refused(message, robust_plan, plant, given.pop("stops"), **given)

"""Economical motions: work is counted exactly where it is positive, and its least is found."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import searches
from scipy.integrate import trapezoid

import pam_ocp as pam
from pam_ocp.core.signals import signals
from pam_ocp.planning.candidate import FLOOR, Candidate, gains
from pam_ocp.planning.continuation import ValveOpenings
from pam_ocp.planning.mesh_sequence import MeshSequence
from pam_ocp.planning.problem.problem import is_nonnegative
from pam_ocp.planning.settings import SETTINGS
from pam_ocp.planning.transcription.mesh import doubled

MUSCLE = pam.muscle("DMSP-20-200N")


def positive_work(plant, plan, samples=100001):
    """Integral of the positive powers out of the muscles, by hand, along the plan's replay [J]."""
    motion = pam.simulate(
        plant, plan.trajectory, t=np.linspace(0.0, plan.duration, samples), rtol=1e-10
    )
    names = [v.name.removesuffix(".force") for v in plant.outputs if v.name.endswith(".force")]
    total = np.zeros(samples)
    for name in names:
        kappa, length = motion[f"{name}.contraction"], MUSCLE.rest_length
        total += np.maximum(motion[f"{name}.force"] * np.gradient(kappa * length, motion.t), 0.0)
    return trapezoid(total, motion.t)


def slider(force=50.0):
    """A block of 2 kg with a muscle's outputs: force is the input, contraction the position."""
    plant = pam.Plant("block")
    x, v = plant.state("x", unit="m", nominal=0.1), plant.state("v", unit="m/s", nominal=0.1)
    pull = plant.input("pull", unit="N", min=-force, max=force, nominal=force)
    plant.der(x, v)
    plant.der(v, pull / 2.0)
    plant.output("block.force", pull, unit="N")
    plant.output("block.contraction", x)
    plant.output("block.rest_length", ca.SX(1.0), unit="m")
    plant.output("block.power", pull * v, unit="W")
    return plant


def least_work_of_the_block(distance, duration, force=50.0, mass=2.0):
    """m v^2 / 2 of the slowest trapezoid: accelerated and braked with all force, by hand [J]."""
    a = force / mass
    v = (a * duration - np.sqrt((a * duration) ** 2 - 4 * a * distance)) / 2
    return mass * v**2 / 2


def test_the_least_work_of_a_block_is_that_of_the_slowest_trapezoid():
    wanted = {"duration": 0.4, "minimise": "work", "starts": 1}
    plan = pam.plan(slider(), [{"x": 0.0}, {"x": 0.1}], rest=True, **wanted)
    assert plan.verified
    assert plan.objective == pytest.approx(least_work_of_the_block(0.1, 0.4), rel=1e-3)


@pytest.mark.slow
def test_the_work_of_an_antagonistic_pair_is_that_along_its_motion_and_settles():
    plant = pam.AntagonisticSlide(MUSCLE, 2.0)
    wanted = {"duration": 0.3, "minimise": "work"}
    plan = pam.plan(plant, [{"x": -0.01}, {"x": 0.01}], **wanted)
    assert plan.verified
    assert plan.objective == pytest.approx(positive_work(plant, plan), rel=1e-3)
    assert plan.statistics["objective_change"] < 1e-3
    finer = pam.plan(
        plant,
        [{"x": -0.01}, {"x": 0.01}],
        **wanted,
        guess=plan,
        method=pam.Collocation(300, 3),
        tolerance=None,
    )
    assert plan.objective < finer.objective * (1 + 1e-3)


@pytest.mark.parametrize(
    ("plant", "stops", "intervals"),
    [
        (pam.AntagonisticSlide(MUSCLE, 2.0), [{"x": -0.01}, {"x": 0.01}], 50),
        (pam.HangingLoad(MUSCLE, 10.0), [{"x": 0.01}, {"x": 0.03}], 20),
    ],
)
def test_the_gradients_inside_the_intervals_tell_what_finer_meshes_gain(plant, stops, intervals):
    wanted = {"duration": 0.3, "minimise": "work", "tolerance": None}
    coarse = pam.plan(plant, stops, **wanted, method=pam.Collocation(intervals, 3))
    fine = pam.plan(plant, stops, **wanted, method=pam.Collocation(160, 3), guess=coarse)
    gained = coarse.objective - fine.objective
    assert gained > 0
    assert 0.5 * gained < gains(coarse._solved).sum() < 2 * gained
    outcome = coarse._solved.outcome
    unknown = replace(outcome, lam_g=0.0 * outcome.lam_g)  # brought back to the constraints alone
    assert gains(replace(coarse._solved, outcome=unknown)) is None


@pytest.mark.slow
@pytest.mark.parametrize("cyclic", [False, True])
def test_work_with_pressures_as_inputs_settles_on_linear_ones(cyclic):
    """Each jump of a held pressure costs work."""
    plant, ends = pam.AntagonisticSlide(MUSCLE, 2.0, feed=pam.feeds.IdealPressure()), (-0.01, 0.01)
    if cyclic:
        plant, ends = pam.HangingLoad(MUSCLE, 8.0, feed=pam.feeds.IdealPressure()), (0.01, 0.03)
    stops, wanted = [{"x": x} for x in ends], {"duration": 0.25, "minimise": "work"}
    plan = pam.plan(plant, stops, **wanted, cyclic=cyclic)
    assert plan.verified
    assert plan.statistics["objective_gap"] < 1e-3
    assert plan.objective == pytest.approx(positive_work(plant, plan), rel=1e-3)
    mesh, near = doubled(plan._solved.program.mesh), plan._solved
    finer = searches.refined(pam.Planner(plant, stops, **wanted, cyclic=cyclic), near, mesh).outcome
    assert finer.success
    assert finer.objective <= plan.objective < finer.objective * (1 + 1e-3)
    if not cyclic:
        held = pam.plan(plant, stops, **wanted, method=pam.Collocation(50, 3, "constant"))
        assert held.objective > 1.05 * plan.objective


@pytest.mark.slow
def test_the_least_work_with_a_spool_is_that_with_two_valves_of_its_conductance():
    """Filling and venting at once, as only two valves can, takes no less work."""
    stops, wanted = [{"x": -0.01}, {"x": 0.01}], {"duration": 0.25, "minimise": "work"}
    spool, two = (
        pam.plan(pam.AntagonisticSlide(MUSCLE, 4.0, feed=feed), stops, **wanted)
        for feed in (pam.feeds.SpoolValve(), pam.feeds.OnOffValves())
    )
    assert spool.verified
    assert two.verified
    assert spool.objective == pytest.approx(two.objective, rel=5e-3)


@pytest.mark.slow
def test_a_spool_needs_as_much_for_a_cycle_as_two_valves_of_its_conductance():
    """To fill and to vent at once, as only two valves can, is a waste of air."""
    stops, wanted = [{"x": -0.009}, {"x": 0.009}], {"duration": 0.3, "minimise": "exergy"}
    spool, two = (
        pam.plan(pam.AntagonisticSlide(MUSCLE, 2.0, feed=feed), stops, **wanted, cyclic=True)
        for feed in (pam.feeds.SpoolValve(), pam.feeds.OnOffValves())
    )
    assert spool.verified
    assert two.verified
    assert spool.statistics["objective_gap"] < 1e-3
    assert spool.objective == pytest.approx(two.objective, rel=1e-3)


@pytest.mark.slow
def test_what_refinement_made_dearer_is_settled_on_the_mesh_that_resolves_it():
    plant = pam.HangingLoad(MUSCLE, 1.0, feed=pam.feeds.OnOffValves())
    stops, wanted = [{"x": 0.01}, {"x": 0.035}], {"duration": 1.0, "minimise": "air"}
    rough, fine = (pam.plan(plant, stops, **wanted, method=pam.Collocation(k)) for k in (10, 100))
    assert rough.verified
    assert rough.statistics["objective_gap"] < 1e-3
    assert rough.objective == pytest.approx(fine.objective, rel=5e-5)  # 1.1e-4 unsettled


@pytest.mark.slow
def test_a_mesh_too_coarse_to_lead_anywhere_is_not_all_that_is_searched():
    """Ten oscillations on 50 intervals: unresolved, they cost less than any, and end elsewhere."""
    stops, wanted = [{"x": 0.005}, {"x": 0.035}], {"duration": 2.0, "minimise": "exergy"}
    rough, fine = (
        pam.plan(pam.SpringOverMuscle(MUSCLE, 1.7, feed=feed), stops, **wanted, method=method)
        for feed, method in (
            (pam.feeds.SpoolValve(), None),
            (pam.feeds.OnOffValves(), pam.Collocation(100)),
        )
    )
    assert rough.verified
    assert rough.statistics["objective_gap"] < 1e-3
    assert rough.objective == pytest.approx(fine.objective, rel=1e-3)  # 5e-3 without


def test_a_lapped_valve_lives_on_no_air_that_it_gives_back():
    """With rounded openings the optimum lets air out through the supply."""
    feeds = pam.feeds.SpoolValve(overlap=0.0), pam.feeds.OnOffValves()
    stops, wanted = [{"x": 0.01}, {"x": 0.03}], {"duration": 0.4, "minimise": "air", "starts": 1}
    lapped, two = (
        pam.plan(pam.HangingLoad(MUSCLE, 8.0, feed=feed), stops, **wanted) for feed in feeds
    )
    assert lapped.verified
    assert min(lapped.trajectory["muscle.supply_flow"]) > -1e-9
    assert lapped.objective == pytest.approx(two.objective, rel=1e-3)


def test_openings_are_sought_for_the_stops_that_were_asked_for(monkeypatch):
    stated = []
    of = ValveOpenings.of.__func__

    def told(cls, plant, statement, ways=False):
        stated.append(statement.stops)
        return of(cls, plant, statement, ways)

    monkeypatch.setattr(ValveOpenings, "of", classmethod(told))
    plant = pam.HangingLoad(MUSCLE, 8.0, feed=pam.feeds.SpoolValve())
    wanted = {"duration": 0.4, "minimise": "work", "method": pam.Collocation(20)}
    planner = pam.Planner(plant, [{"x": 0.01}, {"x": 0.03}], **wanted)
    other = [{"x": 0.01}, {"x": 0.025}]
    plan = planner(stops=other, starts=1)
    assert stated
    assert all(stops == other for stops in stated)
    assert plan.objective == pytest.approx(
        pam.plan(plant, other, **wanted, starts=1).objective, rel=1e-4
    )


@pytest.mark.parametrize("minimise", ["work", "air"])
def test_a_motion_in_openings_meets_all_limits_in_commands(minimise):
    """Of air, filling and venting are inputs of their own: two stand for one command. At the first
    stop the command that holds the plant settles the pressure, too.
    """
    plant = pam.HangingLoad(MUSCLE, 8.0, feed=pam.feeds.SpoolValve())
    wanted = {"duration": 0.4, "minimise": minimise, "method": pam.Collocation(20)}
    search = searches.search_of(pam.Planner(plant, [{"x": 0.01}, {"x": 0.03}], **wanted))
    opened, inner = search._opened
    c = inner.best().best
    program = search.engine.smoothed(search.engine.program(c.mesh), c.place)
    sent = opened.in_commands(program, c.solved)
    g = ca.Function("g", [program.nlp["x"], program.nlp["p"]], [program.nlp["g"]])
    values = np.ravel(g(sent.outcome.w, program.parameters()))
    limited = [(values[at], row.limits()) for row, at in program.placed() if row.conditions]
    labels = {each.label for row in program.rows for each in row.conditions}
    assert "stop 1: der(muscle.pressure) settled" in labels
    for value, (low, high) in [*limited, (sent.outcome.w, program.bounds())]:
        assert np.all(value > low - 1e-4)
        assert np.all(value < high + 1e-4)


@pytest.mark.parametrize(("minimise", "most"), [("work", 0.15), ("air", 0.05)])
def test_bounds_of_commands_hold_where_openings_are_sought(minimise, most):
    plant = pam.HangingLoad(MUSCLE, 8.0, feed=pam.feeds.SpoolValve())
    wanted = {"duration": 0.4, "minimise": minimise, "method": pam.Collocation(20)}
    stops = [{"x": 0.01}, {"x": 0.03}]
    plan, free = (
        pam.plan(plant, stops, **wanted, bounds=bounds, starts=1)
        for bounds in ({"muscle.command": (-0.05, most)}, None)
    )
    assert plan.verified
    command = plan.trajectory["muscle.command"]
    assert np.max(command) == pytest.approx(most, abs=2e-3)
    assert np.min(command) > -0.05 - 1e-6
    assert np.max(free.trajectory["muscle.command"]) > 1.2 * most
    assert free.objective < plan.objective * (1 + 1e-3)


@pytest.mark.slow
def test_the_gradients_tell_what_is_gained_on_finer_meshes_of_linear_inputs():
    plant = pam.AntagonisticSlide(MUSCLE, 2.0, feed=pam.feeds.IdealPressure())
    stops = [{"x": -0.01}, {"x": 0.01}]
    planner = pam.Planner(plant, stops, duration=0.4, minimise="work")
    coarse = planner(tolerance=None)._solved
    assert coarse.program.mesh.form.control == "linear"
    meshes, c = searches.search_of(planner).meshes, None
    estimates, values, gaps = [], [], []
    for _ in range(6):
        c = Candidate(coarse, coarser=c)
        gaps.append(meshes.gap(c) * c.scale)
        estimates.append(gains(coarse).sum())
        values.append(coarse.outcome.objective)
        mesh = MeshSequence.split(coarse.program.mesh, gains(coarse), SETTINGS)
        coarse = searches.refined(planner, coarse, mesh)
    left = np.array(values) - coarse.outcome.objective  # on a mesh that leaves 1e-3 of it
    assert np.all(left[:4] > 0)
    assert np.all((np.array(estimates[:4]) > left[:4]) & (np.array(estimates[:4]) < 6 * left[:4]))
    # what came of them before is counted: nearer, and still no less than there is
    assert np.all(np.array(gaps[:4]) > left[:4])
    assert np.all(np.array(gaps[1:4]) < 1.5 * np.array(estimates[1:4]))


@pytest.mark.parametrize(
    ("feed", "minimise", "control"),
    [
        (pam.feeds.IdealPressure(), "work", "linear"),
        (pam.feeds.IdealPressure(), {"time": 1.0, "work": 0.1}, "linear"),
        (pam.feeds.IdealPressure(), "effort", "constant"),
        (pam.feeds.Regulator(), "work", "constant"),
        (pam.feeds.SpoolValve(), "work", "constant"),
    ],
)
def test_inputs_are_linear_where_their_jumps_cost_work(feed, minimise, control):
    plant = pam.HangingLoad(MUSCLE, 10.0, feed=feed)
    stops = [{"x": 0.01}, {"x": 0.03}]
    wanted = {"minimise": minimise, "duration": 0.4}
    planner = pam.Planner(plant, stops, **wanted, method=pam.Collocation(10))
    assert planner._program.mesh.form.control == control
    assert planner._statement.jumps == (control != "linear")
    asked = pam.Collocation(10, 3, "polynomial")
    said = pam.Planner(plant, stops, **wanted, method=asked)
    assert said._program.mesh.form.control == "polynomial"


@pytest.mark.parametrize("sign", [1, -1])
def test_an_input_that_stays_on_its_bound_keeps_nothing_back(sign):
    """Of x' = sign u with a free end, the integral of x is least where u is 0 all the way, on any
    mesh: the costate T - t is uneven, and has one sign.
    """
    plant = pam.Plant("tank")
    x = plant.state("x", start=0.5)
    u = plant.input("u", min=min(0.0, sign), max=max(0.0, sign))
    plant.der(x, sign * u)
    plan = pam.plan(
        plant,
        [{"x": 0.5}, {"x": (0.0, 2.0)}],
        duration=1.0,
        rest=False,
        minimise="integral(x)",
        method=pam.Collocation(10),
        tolerance=None,
    )
    assert plan.objective == pytest.approx(0.5, rel=1e-6)
    assert gains(plan._solved).sum() < 1e-6


@pytest.mark.slow
def test_a_mesh_split_where_inputs_cost_gains_more_than_as_many_equal_intervals():
    plant, stops = pam.AntagonisticSlide(MUSCLE, 2.0), [{"x": -0.01}, {"x": 0.01}]
    wanted = {"duration": 0.3, "minimise": "work"}
    planner = pam.Planner(plant, stops, **wanted)
    coarse = planner(tolerance=None)._solved
    for _ in range(2):
        mesh = MeshSequence.split(coarse.program.mesh, gains(coarse), SETTINGS)
        coarse = searches.refined(planner, coarse, mesh)
    as_many = pam.Collocation(len(mesh.intervals), 3)
    equal = pam.plan(plant, stops, **wanted, method=as_many, tolerance=None)
    assert coarse.outcome.success
    assert coarse.outcome.objective < equal.objective * (1 - 1e-3)


def test_an_objective_that_has_not_converged_says_so(monkeypatch):
    monkeypatch.setattr("pam_ocp.planning.planner.SETTINGS", replace(SETTINGS, work=0.0))
    plant, stops = pam.AntagonisticSlide(MUSCLE, 2.0), [{"x": -0.01}, {"x": 0.01}]
    plan = pam.plan(plant, stops, duration=0.3, minimise="work")
    assert plan.statistics["objective_gap"] > 1e-3
    assert "has not converged" in plan.statistics["warning"]
    assert "has not converged" in str(plan)


@pytest.mark.parametrize(
    "method", [pam.planning.Shooting(30, 4), pam.Collocation(20, 3, points="gauss")]
)
def test_work_is_stated_in_all_forms_of_the_program(method):
    plant = pam.HangingLoad(MUSCLE, 10.0)
    plan = pam.plan(
        plant,
        [{"x": 0.01}, {"x": 0.03}],
        duration=0.4,
        minimise="work",
        method=method,
        tolerance=None,
        cyclic=True,
    )
    assert plan.objective == pytest.approx(positive_work(plant, plan), rel=1e-3)
    assert plan.replay.objective == pytest.approx(positive_work(plant, plan), rel=1e-5)


def test_budgets_bound_the_work_from_both_sides():
    plant = pam.AntagonisticJoint(MUSCLE)
    stops, spent = [{"theta": -0.2}, {"theta": 0.2}], {}
    for name, budget in {"least": (2.0, None), "most": (None, 0.5), "both": (0.7, 0.71)}.items():
        plan = pam.plan(
            plant,
            stops,
            duration=0.5,
            minimise="effort",
            budgets={"work": budget},
            method=pam.Collocation(20, 3),
            tolerance=None,
        )
        spent[name] = positive_work(plant, plan)
    assert spent["least"] > 2.0 - 5e-3
    assert spent["most"] < 0.5 + 5e-3
    assert 0.7 - 5e-3 < spent["both"] < 0.71 + 5e-3


def test_a_saved_plan_of_least_work_is_loaded_with_its_objective(tmp_path):
    plant = pam.HangingLoad(MUSCLE, 10.0)
    for method in (pam.Collocation(10, 3), pam.planning.Shooting(20, 4)):
        plan = pam.plan(
            plant, [{"x": 0.01}, {"x": 0.03}], duration=0.5, minimise="work", method=method
        )
        again = pam.load_plan(plan.save(tmp_path / "plan.npz"), plant)
        assert again.objective == pytest.approx(plan.objective, rel=1e-6)
        assert again.verified


@pytest.mark.slow
def test_the_least_air_is_what_the_supply_gives_along_the_motion():
    plant = pam.HangingLoad(MUSCLE, 10.0, feed=pam.feeds.SpoolValve())
    plan = pam.plan(
        plant, [{"x": 0.01}, {"x": 0.03}], duration=0.5, minimise="air", cyclic=True, starts=1
    )
    assert plan.verified
    t = np.linspace(0.0, plan.duration, 20001)
    motion = pam.simulate(plant, plan.trajectory, t=t, rtol=1e-10)
    u = signals(plant, plan.trajectory, t)(t)
    x = motion.array([v.name for v in plant.states])
    y = np.asarray(plant.function(x.T, u.T, plant.vector("parameter"))[1], float)
    flow = y[[v.name for v in plant.outputs].index("muscle.supply_flow")]
    assert 1e3 * trapezoid(flow, t) == pytest.approx(plan.objective, rel=1e-3)


def test_a_motion_that_costs_nothing_has_converged_whatever_its_gradients_say(monkeypatch):
    # the weight pulls the muscle out: no work is taken from it, and no less can be
    large = lambda found: np.ones(len(found.program.mesh.intervals))  # noqa: E731
    monkeypatch.setattr("pam_ocp.planning.candidate.gains", large)
    plant = pam.HangingLoad(MUSCLE, 10.0)
    plan = pam.plan(plant, [{"x": 0.03}, {"x": 0.01}], duration=1.0, minimise="work")
    assert plan.verified
    assert abs(plan.statistics["objective_on_mesh"]) < 1e-6
    # the motion itself: nothing, beside the energy at hand
    assert abs(plan.objective) < 1e-4 * 10.0 * 9.81 * 0.02
    assert abs(plan.statistics["objective_gap"]) < 1e-3
    assert plan.statistics["intervals"] <= 100


@pytest.mark.slow
def test_where_many_motions_cost_nothing_one_of_them_is_found_and_settles():
    # a load on a tendon is let down: no work is taken from the muscle on any slow way
    plant = pam.SeriesLoad(MUSCLE, 15.0, 1.4e5)
    wish = {"duration": 1.0, "minimise": "work"}
    plan = pam.plan(plant, [{"x": 0.03}, {"x": 0.012}], **wish)
    assert plan.verified
    # nothing: a ten-thousandth of what the load gives up, whatever the last digits of a machine
    assert positive_work(plant, plan) < 1e-4 * 15.0 * 9.81 * 0.018
    assert abs(plan.objective) < 1e-5
    assert plan.statistics["objective_gap"] < 1e-3


@pytest.mark.slow
def test_work_between_the_points_of_a_mesh_is_seen_and_saved():
    # on so few intervals the tendon rings, and its muscle works between the points
    plant = pam.SeriesLoad(MUSCLE, 15.0, 1.4e5)
    wish = {"duration": 0.7, "minimise": "work", "method": pam.Collocation(12, 3)}
    stops = [{"x": 0.03}, {"x": 0.012}]
    rough, plan = (pam.plan(plant, stops, **wish, tolerance=t) for t in (None, 1e-3))
    work = positive_work(plant, rough)
    assert work - rough.statistics["objective_on_mesh"] > 1e-3
    assert rough.objective == pytest.approx(work, rel=2e-3)
    assert plan.verified
    assert positive_work(plant, plan) < 1e-5
    assert plan.statistics["objective_replayed"] < 1e-5


def test_the_term_that_chooses_among_flat_optima_is_small_whatever_the_units_of_inputs():
    plant = slider()
    planner = pam.Planner(plant, [{"x": 0.0}, {"x": 0.1}], duration=0.4, minimise="work")
    problem = planner._program.problem
    curvature = ca.DM(ca.hessian(problem.objective.integrand, plant.u)[0])
    added = float(curvature) / 2 * 50.0**2  # where the input is largest
    assert 0 < added * 0.4 < 1e-3 * FLOOR
    assert is_nonnegative(problem)


def test_what_is_wanted_large_may_fall_below_nothing():
    minimise = {"work": 1.0, "integral(x)": -1.0}
    planner = pam.Planner(slider(), [{"x": 0.0}, {"x": 0.1}], duration=0.4, minimise=minimise)
    assert not is_nonnegative(planner._program.problem)


def test_one_small_change_between_large_ones_is_no_sign_that_an_objective_has_converged():
    # changes and gradients as a joint with regulators gave them on 100, 106, 114 and 128 intervals
    planner = pam.Planner(slider(), [{"x": 0.0}, {"x": 0.1}], duration=0.4, minimise="work")
    search, first = searches.search_of(planner), searches.solved(planner)
    objective, c = 1.0, None
    for left, change in ((2.9e-2, 0.0), (1.8e-2, 5.1e-3), (9.6e-3, 8.5e-4), (5.2e-3, 1.39e-3)):
        objective -= change
        outcome = replace(first.outcome, objective=objective)
        before, c = c, Candidate(replace(first, outcome=outcome), coarser=c)
        vars(c)["gains"] = np.array([left])
    assert search.meshes.gap(before) > 1.39e-3  # the change that followed

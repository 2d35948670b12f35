"""plan: via points, dwells, phases, profiles, forbidden regions, budgets, objectives, design."""

import inspect
import pickle
import warnings

import casadi as ca
import numpy as np
import pytest
from conftest import pushed, refused
from scipy.integrate import quad
from scipy.optimize import minimize_scalar

import pam_ocp as pam
from pam_ocp import Avoid, Collocation, Constraint, InputError, Phase, Profile, Stop
from pam_ocp.judge import Statement
from pam_ocp.planning import Shooting
from pam_ocp.planning.planner import SolveKeywords
from pam_ocp.planning.problem.formulation import formulate

POLYNOMIAL = Collocation(6, 6, "polynomial")


def double_integrator(limit=1.0, mass=1.0):
    def power(plant, x, v, u):
        plant.output("power", u * v, unit="W")

    return pushed(limit, mass, also=power, x={"max": 10.0})


AT_REST = [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]


def in_a_second(limit, stops, **asked):
    """A motion of the double integrator, of least effort unless something else is asked for."""
    asked = {"duration": 1.0, "minimise": "effort", **asked}
    return pam.plan(double_integrator(limit), stops, **asked)


@pytest.mark.parametrize(
    "method",
    [
        Collocation(10, 3, "linear"),
        Collocation(10, 3, "linear", points="gauss"),
        Collocation(3, 4, "polynomial", points="gauss"),
        Collocation(4, 3, "polynomial"),
        Shooting(10, 2, "linear"),
    ],
)
def test_every_scheme_is_exact_for_the_least_effort(method):
    """u = 6 - 12 t, integral of u^2 = 12; costates by hand: lambda_x = -24,
    lambda_v = -12 + 24 t.
    """
    plan = in_a_second(10.0, AT_REST, rest=False, method=method)
    assert plan.objective == pytest.approx(12.0, rel=1e-8)
    assert plan.replay_error < 1e-8
    assert plan.trajectory["u"] == pytest.approx(6 - 12 * plan.trajectory.t, abs=1e-6)
    t = plan.costates.t
    assert plan.costates["x"] == pytest.approx(np.full(len(t), -24.0), abs=1e-5)
    assert plan.costates["v"] == pytest.approx(-12 + 24 * t, abs=1e-5)


@pytest.mark.parametrize("points", ["radau", "gauss"])
def test_order_of_the_collocation(points):
    """x' = -x over one second: the error falls as h^(2d-1) by Radau and h^(2d) by Gauss points."""
    plant = pam.Plant("decay")
    y = plant.state("y", start=1.0)
    plant.der(y, -y)
    errors = []
    for intervals in (4, 8):
        plan = pam.plan(
            plant,
            [{"y": 1.0}, {"y": (0.0, 1.0)}],
            rest=False,
            duration=1.0,
            method=Collocation(intervals, 2, points=points),
        )
        errors.append(abs(plan.trajectory["y"][-1] - np.exp(-1.0)))
    order = np.log2(errors[0] / errors[1])
    assert order == pytest.approx({"radau": 3, "gauss": 4}[points], abs=0.15)


def test_a_via_point_is_passed_and_a_dwell_is_kept():
    plan = pam.plan(
        double_integrator(10.0),
        [Stop({"x": 0.0}), Stop({"x": 0.4}, rest=False), Stop({"x": 1.0}, dwell=0.2), {"x": 0.0}],
        method=Collocation(12, 6, "polynomial"),
    )
    motion = plan.replay.trajectory
    begin, end = np.cumsum(plan.durations)[[1, 2]]
    assert plan.durations[2] == pytest.approx(0.2)
    inside = (motion.t >= begin) & (motion.t <= end)
    assert np.abs(motion["x"][inside] - 1.0).max() < 1.01e-3
    at_via = np.interp(plan.durations[0], motion.t, motion["v"])
    assert at_via > 0.5
    # bang-bang from rest to rest over one metre with 10 N on 1 kg takes 2 sqrt(1/10)
    assert sum(plan.durations[:2]) == pytest.approx(2 * np.sqrt(0.1), rel=5e-3)


def test_phases_have_limits_of_their_own():
    plan = pam.plan(
        double_integrator(10.0),
        [*AT_REST, AT_REST[0]],
        rest=False,
        method=Collocation(33),
        phases=[None, Phase(duration=(0.1, 5.0), bounds={"v": (-1.0, 1.0)})],
    )
    motion = plan.trajectory
    back = motion.t > plan.durations[0]
    assert motion["v"].max() > 2.0
    assert motion["v"][back].min() == pytest.approx(-1.0, abs=1e-6)
    # a trapezium of speed, 1/v + v/a, its corners on the mesh
    assert plan.durations[1] == pytest.approx(1.0 + 1.0 / 10.0, rel=1e-6)


def test_bounds_of_a_polynomial_input_are_those_of_its_phase():
    plan = pam.plan(
        double_integrator(10.0),
        [*AT_REST, AT_REST[0]],
        rest=False,
        phases=[None, Phase(bounds={"u": (-2.0, 2.0)})],
        method=Collocation(8, 5, "polynomial"),
    )
    motion = plan.replay.trajectory
    there = motion.t < plan.durations[0]
    assert np.abs(motion["u"][there]).max() > 9.0
    assert np.abs(motion["u"][~there]).max() < 2.05
    # bang-bang there and back: 2 sqrt(d/a)
    assert plan.durations == pytest.approx([2 / np.sqrt(10), 2 / np.sqrt(2)], rel=1e-3)
    planner = pam.Planner(
        double_integrator(10.0),
        AT_REST,
        rest=False,
        bounds={"u": (-4.0, 4.0)},
        method=Collocation(8, 5, "polynomial"),
    )
    wider = planner(bounds={"u": (-9.0, 9.0)}, guess=planner())
    assert wider.duration == pytest.approx(2 / 3, rel=1e-3)


def test_a_bound_that_changes_with_time_is_kept():
    corridor = Profile([0.0, 0.5, 1.0], [0.2, 0.2, 1.2])
    stops, method = [{"x": 0.0}, {"x": 1.0}], Collocation(40, 3, "linear")
    free = in_a_second(50.0, stops, method=method)
    plan = in_a_second(50.0, stops, bounds={"x": (None, corridor)}, method=method)
    excess = [np.max(p.trajectory["x"] - corridor(p.trajectory.t)) for p in (plan, free)]
    assert excess[0] < 1e-8
    assert excess[1] > 0.1
    assert plan.objective > 1.05 * free.objective


def planar_point(limit=20.0):
    plant = pam.Plant("point")
    for axis in "xy":
        position, velocity = plant.state(axis, unit="m", nominal=1.0), plant.state(f"v{axis}")
        force = plant.input(f"f{axis}", min=-limit, max=limit)
        plant.der(position, velocity)
        plant.der(velocity, force)
    return plant


def test_a_forbidden_region_is_gone_around():
    stops = [{"x": 0.0, "y": 0.0}, {"x": 1.0, "y": 0.0}]
    region = Avoid({"x": (0.5, 0.2), "y": (-0.02, 0.1)})
    asked = {"duration": 1.0, "minimise": "effort", "method": Collocation(30, 3, "linear")}
    plan = pam.plan(planar_point(), stops, constraints=[region], **asked)
    x, y = plan.trajectory["x"], plan.trajectory["y"]
    assert ((x - 0.5) ** 2 / 0.2**2 + (y + 0.02) ** 2 / 0.1**2).min() > 1 - 1e-6
    assert y.max() == pytest.approx(0.08, abs=2e-3)


def test_a_place_that_is_taken_for_a_while_is_passed_later():
    """Time is one of the region's names: before 0.9 s nothing passes x = 0.5."""
    taken, method = Avoid({"x": (0.6, 0.2), "time": (0.0, 0.9)}), Collocation(30, 3, "linear")
    asked = {"duration": 1.5, "constraints": [taken], "method": method}
    plan = in_a_second(20.0, [{"x": 0.0}, {"x": 1.0}], **asked)
    x, t = plan.trajectory["x"], plan.trajectory.t
    assert (((x - 0.6) / 0.2) ** 2 + (t / 0.9) ** 2).min() > 1 - 1e-6


def test_a_constraint_of_ones_own_is_kept():
    plant = double_integrator(10.0)
    power = plant.expression("u") * plant.expression("v")
    kept = [Constraint(power, high=4.0, name="power")]
    plan = pam.plan(plant, [{"x": 0.0}, {"x": 1.0}], constraints=kept, method=Collocation(40))
    assert plan.trajectory["power"].max() < 4.0 + 0.3  # constant inputs: kept at the points
    assert plan.replay.violation < 0.1
    assert plan.duration > 2 * np.sqrt(0.1) * 1.05


def test_limits_of_one_name_are_two():
    """A constraint that is called like an output, in a phase that bounds the output, and twice."""
    plant = double_integrator(10.0)
    own = Constraint(plant.expression("v"), high=2.0, name="power")
    asked = {"constraints": [own, own], "phases": [Phase(bounds={"power": (None, 8.0)})]}
    path = formulate(plant, Statement([{"x": 0.0}, {"x": 1.0}], **asked)).legs[0].path
    assert {c.label: c.high for c in path} == {"power": 2.0, "power (2)": 2.0, "power (3)": 8.0}


def test_the_range_of_an_output_is_kept():
    """d/v + v/a: 10 m/s^2 up to 2 m/s."""
    plant = double_integrator(10.0)
    plant = plant.with_output("speed", plant.expression("v"), max=2.0)
    plan = pam.plan(plant, [{"x": 0.0}, {"x": 1.0}], method=Collocation(14, 3))
    assert plan.verified
    assert plan.duration == pytest.approx(1 / 2 + 2 / 10, rel=1e-3)


def test_a_budget_of_effort_costs_time():
    """Least time with integral u^2 <= E from rest to rest over one metre: T^3 = 12/E (u = 6/T^2
    ...).
    """
    plan = pam.plan(
        double_integrator(100.0), AT_REST, rest=False, budgets={"effort": 20.0}, method=POLYNOMIAL
    )
    assert plan.duration == pytest.approx((12 / 20) ** (1 / 3), rel=1e-6)


def test_tracking_follows_a_profile_and_a_number():
    t = np.linspace(0.0, 2.0, 41)
    wanted = Profile(t, 0.3 * np.sin(np.pi * t), smooth=True)
    asked = {"rest": False, "duration": 2.0, "minimise": {"effort": 1e-8}}
    asked |= {"track": {"x": (wanted, 10.0)}, "method": Collocation(20, 5, "polynomial")}
    plan = in_a_second(50.0, [{"x": 0.0}, {"x": (-1.0, 1.0)}], **asked)
    assert np.abs(plan.trajectory["x"] - 0.3 * np.sin(np.pi * plan.trajectory.t)).max() < 5e-3
    asked = {"rest": False, "minimise": {"effort": 1e-9}, "track": {"x": 0.2}}
    stops = [{"x": 0.2, "v": 0.0}, {"x": (-1.0, 1.0)}]
    still = in_a_second(50.0, stops, **asked, method=POLYNOMIAL)
    assert still.objective < 1e-9  # the tolerance of the solver


def test_the_least_peak_of_the_input_is_the_bang_bang_one():
    """Smallest push that moves one metre in one second when braking with 4 N at most: 4 N."""
    asked = {"minimise": "peak(u)", "bounds": {"u": (-4.0, None)}, "method": Collocation(40)}
    plan = in_a_second(100.0, AT_REST, rest=False, **asked)
    assert plan.objective == pytest.approx(4.0, rel=1e-6)
    assert plan.trajectory["u"].max() == pytest.approx(4.0, rel=1e-6)


def test_final_with_a_negative_weight_asks_for_the_most():
    """The farthest in one second with 1 N on 1 kg: half a metre."""
    asked = {"rest": False, "minimise": {"final(x)": -1.0}, "method": POLYNOMIAL}
    plan = in_a_second(1.0, [{"x": 0.0, "v": 0.0}, {"x": (0.0, None)}], **asked)
    assert plan.trajectory["x"][-1] == pytest.approx(0.5, rel=1e-6)


def test_rate_of_the_input_is_penalised():
    """min integral u'^2 from rest to rest with u = 0 at both ends: the minimum jerk, 720."""
    for method, error in (
        (Collocation(8, 5, "polynomial"), 1e-6),
        (Collocation(60, 3, "linear"), 5e-3),
    ):
        plan = in_a_second(100.0, [{"x": 0.0}, {"x": 1.0}], minimise="rate", method=method)
        assert plan.objective == pytest.approx(720.0, rel=error)


def test_the_lever_is_designed_with_the_motion():
    """x'' = r u - r^2 x, the effort of reaching 1 in one second over r: SciPy finds the same r."""
    plant = pam.Plant("lever")
    x, v = plant.state("x"), plant.state("v")
    r = plant.parameter("radius", 1.0, min=0.1, max=10.0)
    u = plant.input("u", min=-100.0, max=100.0)
    plant.der(x, v)
    plant.der(v, r * u - r**3)
    stops = [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]
    asked = {"rest": False, "duration": 1.0, "minimise": "effort", "method": POLYNOMIAL}
    plan = pam.plan(plant, stops, design={"radius": (0.2, 5.0)}, **asked)

    def effort(radius):  # u = (6 - 12 t + r^3)/r
        return quad(lambda t: ((6 - 12 * t + radius**3) / radius) ** 2, 0, 1)[0]

    best = minimize_scalar(effort, bounds=(0.2, 5.0), method="bounded", options={"xatol": 1e-10})
    assert plan.design["radius"] == pytest.approx(best.x, rel=1e-5)
    assert plan.objective == pytest.approx(best.fun, rel=1e-8)
    assert plan.plant.vector("parameter")[0] == plan.design["radius"]
    assert plan.replay_error < 1e-7


def test_a_planner_solves_again_for_other_numbers(slide):
    stops = [{"x": -0.015}, {"x": 0.015}]
    method = Collocation(20)
    planner = pam.Planner(slide, stops, duration=(0.02, 1.0), method=method)
    first = planner()
    for values, there in (
        ({"mass": 2.4}, stops),
        ({"muscle1.lag": 0.06}, [{"x": -0.012}, {"x": 0.01}]),
    ):
        again = planner(values=values, stops=there, guess=first)
        alone = pam.plan(slide.with_values(values), there, duration=(0.02, 1.0), method=method)
        assert again.duration == pytest.approx(alone.duration, rel=1e-7)
        assert again.plant.vector("parameter") == pytest.approx(alone.plant.vector("parameter"))
    refused("only numbers may change", planner, stops=[{"x": 0.0}, {"muscle1.force": 300.0}])
    refused("cyclic cannot change", planner, cyclic=True)


def test_weights_and_margins_of_a_built_planner_stay():
    stops = [{"x": 0.0}, Stop({"x": 1.0}, dwell=0.1)]
    planner = pam.Planner(double_integrator(), stops, track={"x": (1.0, 2.0)})
    refused("only numbers may change", planner, track={"x": (1.0, 3.0)})
    with pytest.raises(InputError, match="only numbers may change"):
        planner(stops=[stops[0], Stop({"x": 1.0}, dwell=0.1, within=0.1)])


@pytest.mark.parametrize("name", ["mass", "muscle1.lag", "muscle1.a1"])
def test_sensitivities_agree_with_solving_again(slide, name):
    asked = {"duration": 0.2, "minimise": {"effort": 1.0, "rate": 1e-3}}
    asked["method"] = Collocation(10, 5, "linear")
    planner = pam.Planner(slide, [{"x": -0.01}, {"x": 0.012}], **asked)
    plan = planner()
    value = slide.vector("parameter")[[v.name for v in slide.parameters].index(name)]
    step = 1e-4 * abs(value)
    low, high = (planner(values={name: value + s * step}, guess=plan).objective for s in (-1, 1))
    assert plan.sensitivity(name) == pytest.approx((high - low) / (2 * step), rel=1e-4, abs=1e-9)


def test_costates_are_the_slopes_of_the_optimal_value(slide):
    """Finite differences of the optimal value over each state at the start."""
    start = {"x": -0.01, "v": 0.0, "muscle1.pressure": 2.5e5, "muscle2.pressure": 3.5e5}
    asked = {"rest": False, "duration": 0.2, "minimise": {"effort": 1.0}}
    asked["method"] = Collocation(10, 5, "linear")
    planner = pam.Planner(slide, [start, {"x": 0.012}], **asked)
    plan = planner()
    for name, value in start.items():
        nominal = slide.variable(name).nominal
        low, high = (
            planner(stops=[{**start, name: value + h}, {"x": 0.012}], guess=plan).objective
            for h in (-1e-4 * nominal, 1e-4 * nominal)
        )
        change = (high - low) / 2e-4
        assert plan.costates[name][0] * nominal == pytest.approx(change, rel=1e-4, abs=1e-7)
        slope = plan.stop_sensitivities[f"stop 1: {name}"]
        assert slope == pytest.approx(change / nominal, rel=1e-4, abs=1e-12)


def test_the_slope_of_a_stop_with_a_dwell_is_that_of_both_legs():
    """Least effort 12 d^2/T^3 of each leg, 1 m in 1 s, then 0.6 m in 0.8 s: its slope by where the
    dwell is, 24 d/T^3 of both.
    """
    stops = [{"x": 0.0}, Stop({"x": 1.0}, dwell=0.1), {"x": 0.4}]
    asked = {"minimise": "effort", "duration": [1.0, 0.8], "method": POLYNOMIAL}
    plan = pam.plan(double_integrator(20.0), stops, **asked)
    assert plan.objective == pytest.approx(12.0 + 12 * 0.36 / 0.512, rel=1e-6)
    slopes = [plan.stop_sensitivities[f"stop {i}: x"] for i in (1, 2, 3)]
    assert slopes == pytest.approx([-24.0, 24.0 + 14.4 / 0.512, -14.4 / 0.512], rel=1e-5)


def test_a_plan_survives_a_file_and_another_process(slide, tmp_path):
    asked = {"cyclic": True, "method": Collocation(15, 4, "polynomial")}
    stops = [{"x": -0.015}, {"x": 0.015}]
    plan = pam.plan(slide, stops, design={"mass": (1.5, 3.0)}, **asked)
    stored = pam.load_plan(plan.save(tmp_path / "plan.npz"), slide)
    assert stored.design == plan.design
    assert stored.replay_error == pytest.approx(plan.replay_error, rel=1e-6)
    assert stored.trajectory.compare(plan.trajectory).largest < 1e-12
    assert stored.meshes == plan.meshes
    with pytest.raises(pam.PlanError, match="no multipliers"):
        _ = stored.costates
    copy = pickle.loads(pickle.dumps(plan))
    assert copy.duration == plan.duration
    with pytest.raises(InputError, match="a plan of 'antagonistic_slide' with states"):
        pam.load_plan(tmp_path / "plan.npz", double_integrator())
    (tmp_path / "no.npz").write_bytes(b"nothing")
    refused("cannot be read as a plan file", pam.load_plan, tmp_path / "no.npz", slide)


def test_progress_is_reported(slide, capsys):
    seen = []
    plan = pam.plan(slide, STOPS, method=Collocation(10), progress=lambda *e: seen.append(e))
    assert [entry[0] for entry in seen] == list(range(len(seen)))
    assert len(seen) >= plan.statistics["iterations"]
    assert seen[-1][1] == pytest.approx(plan.objective, rel=1e-6)
    pam.plan(slide, STOPS, method=Collocation(10), progress=True)
    assert "largest violation" in capsys.readouterr().out


STOPS = [{"x": -0.01}, {"x": 0.01}]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stops": [Stop({"x": 0.0}, dwell=0.1, rest=False), {"x": 0.01}]}, "dwell is at rest"),
        ({"phases": [None, None]}, "2 entries for 1 phases"),
        ({"bounds": {"x": (0.0, Profile([0, 1], [0, 1])), "v": (2.0, 1.0)}}, "crossed"),
        ({"constraints": [3]}, "neither a Constraint nor an Avoid"),
        ({"track": {"x": (0.0, 1.0, 2.0)}}, "give the aim"),
        ({"budgets": {"peak(x)": 1.0}}, r"square\(NAME\)$"),
        ({"constraints": [Avoid({})]}, "region is empty"),
        ({"constraints": [Constraint(ca.SX.sym("z"), high=1.0)]}, "not the plant's: z"),
        ({"track": {"x": "far"}}, "not a number"),
        ({"budgets": {"air": 1e-3}}, "feed its muscles by valves"),
        ({"budgets": {"effort": (2.0, 1.0)}}, "crossed"),
        ({"budgets": {"effort": None}}, "give the most"),
        ({"design": {"x": (0.0, 1.0)}}, "x is a state"),
        ({"design": {"mass": (1.0, None)}}, "must be finite"),
        ({"minimise": {"peek(x)": 1.0}}, "peak"),
        ({"minimise": {"time": -1.0}}, "must be >= 0"),
        ({"method": "radau"}, "Collocation"),
        ({"final": 3.0}, "scalar CasADi SX expression"),
        ({"rest": None}, "rest = None: give True or False"),
        ({"bounds": {"x": None}}, r"bounds\['x'\] = None: give a number, or \(low, high\)"),
        ({"design": {"mass": None}}, r"design\['mass'\] = None: give a number, or \(low, high\)"),
        ({"stops": [{"x": "10 mm"}, {"x": 0.010}]}, "stops 1 and 2 are the same"),
    ],
)
def test_what_cannot_be_meant_is_refused(slide, arguments, message):
    refused(message, pam.plan, slide, **{"stops": STOPS, **arguments})


def test_a_disturbance_that_changes_is_no_bound_of_a_plan():
    plant = pam.Plant("blown")
    x, v, u = plant.state("x"), plant.state("v"), plant.input("u", min=-2.0, max=2.0)
    plant.der(x, v)
    plant.der(v, u + plant.input("wind", disturbance=True))
    for bound in (gust := Profile([0, 1], [0.0, 0.5]), (None, gust)):
        with pytest.raises(InputError, match="wind is a disturbance, which a plan holds constant"):
            pam.plan(plant, AT_REST, bounds={"wind": bound})


def test_times_of_a_profile_rise():
    with pytest.raises(InputError):
        Profile([0.0, 0.0], [1.0, 2.0])


def test_a_planner_knows_the_keywords_of_plan_and_names_the_nearest_to_a_wrong_one():
    asked = set(inspect.signature(pam.plan).parameters) - {"plant", "stops"}
    assert asked - {"time_limit", "executor"} == set(SolveKeywords.__annotations__)
    stops = [{"x": 0.0}, {"x": 0.01}]
    with pytest.raises(TypeError, match="no argument 'minimize'; did you mean 'minimise'"):
        pam.Planner(pam.HangingLoad("DMSP-20-400N", mass=20.0), stops, minimize="time")


def test_values_may_have_units_wherever_a_plan_takes_one():
    """15 mm is 0.015: in stops, dwells, bounds, phases, aims and forbidden regions."""
    slide = pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10)

    def planned(mm, seconds, pressure):
        return pam.plan(
            slide,
            [pam.Stop({"x": mm(-10)}, dwell=seconds(0.02)), {"x": (mm(9), mm(10))}],
            duration=(seconds(0.05), seconds(1.0)),
            bounds={"muscle1.pressure": (None, pressure(5e5))},
            phases=[pam.Phase(bounds={"x": (mm(-12), mm(12))})],
            constraints=[pam.Avoid({"x": (mm(0), mm(1)), "time": (seconds(2), seconds(0.1))})],
            minimise={"time": 1.0, "rate": 1e-3},
            track={"x": mm(3)},
            method=pam.Collocation(10),
            tolerance=None,
        )

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pam.PlanWarning)
        numbers = planned(lambda v: v / 1e3, lambda v: v, lambda v: v)
        texts = planned(lambda v: f"{v} mm", lambda v: f"{1e3 * v} ms", lambda v: f"{v / 1e5} bar")
    assert texts.duration == pytest.approx(numbers.duration, rel=1e-9)


def test_an_argument_that_no_verb_has_is_answered_with_the_nearest(slide):
    with pytest.raises(TypeError, match=r"plan\(\) has no argument 'minimize'.*minimise"):
        pam.plan(slide, [{"x": 0.0}, {"x": 0.01}], minimize="time")
    with pytest.raises(TypeError, match=r"AntagonisticSlide\(\) has no argument 'masss'.*mass"):
        pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), masss=2.0)


def test_the_objective_is_printed_with_its_unit(slide):
    plan = pam.plan(slide, STOPS, minimise={"time": 2.0, "rate": 1e-3})
    assert "= 2 time [s] + 0.001 rate" in str(plan)


# ---- what cannot be met is named ----------------------------------------------------------------
@pytest.fixture(scope="module")
def slide():
    return pam.AntagonisticSlide("DMSP-20-300", 2.0)


@pytest.mark.slow
def test_a_bound_of_one_number_is_named_where_it_leaves_no_motion(slide, capfd):
    with pytest.raises(InputError, match=r"bounds hold it at 10 mm all along; give \(low, high\)"):
        pam.plan(slide, STOPS, bounds={"x": 0.01})
    stops = [{"x": 0.0}, {"x": 1.0}]
    with pytest.raises(pam.PlanError, match=r"Bounds hold v at 0\.3 m/s all along: give \(low"):
        pam.plan(double_integrator(), stops, bounds={"v": 0.3}, method=Collocation(4, 3))
    held, polynomial = {"muscle1.force": 300.0}, Collocation(10, 5, control="polynomial")
    with pytest.raises(pam.PlanError, match=r"muscle1\.force at 300 N all along.*polynomial"):
        pam.plan(slide, STOPS, bounds=held, method=Collocation(4, 4))
    plan = pam.plan(slide, STOPS, bounds=held, method=polynomial)
    assert plan.verified
    assert np.abs(plan.trajectory["muscle1.force"] - 300.0).max() < 0.1
    printed = capfd.readouterr()
    assert printed.out + printed.err == ""  # CasADi's lines on more equations than unknowns


@pytest.mark.slow
def test_a_leg_of_one_interval_of_constant_inputs_is_named(slide):
    words = r"Leg 1 has 1 interval, .*method=Collocation\(intervals=50"
    refused(words, pam.plan, slide, STOPS, method=Collocation(1, 3), starts=1, error=pam.PlanError)


def test_a_guess_of_a_plant_with_other_variables_is_refused(slide):
    method = Collocation(10, 3)
    hanging = pam.HangingLoad("DMSP-20-300", 10.0)
    guess = pam.plan(hanging, [{"x": 0.01}, {"x": 0.03}], method=method, tolerance=None)
    with pytest.raises(InputError, match="guess: a plan of 'hanging_load', with x, v, muscle"):
        pam.plan(slide, STOPS, guess=guess, method=method)
    heavier = slide.with_values(mass=3.0)
    near = pam.plan(slide, STOPS, method=method, tolerance=None)
    assert pam.plan(heavier, STOPS, guess=near, method=method, tolerance=None).solved


def test_none_leaves_an_end_of_a_duration_open():
    """From rest to rest over 1 m with |u| <= 1 N takes 2 s."""
    method = Collocation(10, 3)
    stops = [{"x": 0.0}, {"x": 1.0}]
    plan = pam.plan(double_integrator(), stops, duration=(None, 3.0), method=method)
    assert plan.duration == pytest.approx(2.0, rel=1e-6)
    plan = pam.plan(double_integrator(), stops, duration=(2.5, None), method=method)
    assert plan.duration == pytest.approx(2.5, rel=1e-6)

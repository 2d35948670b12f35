"""Equilibria and linearisation."""

import re

import control
import numpy as np
import pytest
from conftest import BAR, flat, refused
from scipy.linalg import expm

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.operating import EquilibriumError
from pam_ocp.operating.along import stability_path
from pam_ocp.operating.linear import (
    linear_model,
    linearize_along,
    linearize_grid,
    no_influence,
)
from pam_ocp.operating.several import equilibria, equilibrium_path
from pam_ocp.plants.regulated import PositionFeedback
from pam_ocp.plants.valves import OnOffValves, SpoolValve, Tube


@pytest.mark.parametrize(
    ("mass", "bar", "position", "frequency"),
    [
        (20, 2, 34.6, 2.74),
        (20, 4, 80.8, 3.43),
        (20, 6, 97.3, 4.20),
        (50, 2, 5.4, 3.10),
        (50, 4, 49.5, 2.21),
        (50, 6, 76.2, 2.66),
        (10, 4, 91.4, 4.85),
        (100, 6, 41.5, 1.92),
    ],
)
def test_the_hanging_load_rests_and_swings_where_the_reference_says(
    hanging, mass, bar, position, frequency
):
    point = hanging.equilibrium({"mass": mass, "muscle.command": bar * BAR})
    assert point["x"] * 1e3 == pytest.approx(position, abs=0.05)
    ((found, damping),) = pam.operating.modes(hanging.linearize(point))
    assert found == pytest.approx(frequency, abs=0.005)
    assert damping == pytest.approx(0.1, rel=1e-6)


FEEDS = {
    "ideal": pam.feeds.IdealPressure(),
    "regulator": pam.feeds.Regulator(0.08),
    "spool": SpoolValve(),
    "spool and tube": SpoolValve(tube=Tube(), leak=1e-10),
    "spool with totals": SpoolValve(totals=True),
    "on-off": OnOffValves(),
    "position feedback": PositionFeedback(derivative_gain=1e4),
}

PLANTS = {
    "hanging": lambda m, feed: pam.HangingLoad(m, feed=feed),
    "spring over muscle": lambda m, feed: pam.SpringOverMuscle(m, feed=feed),
    "slide": lambda m, feed: pam.AntagonisticSlide(m, feed=feed),
    "joint": lambda m, feed: pam.AntagonisticJoint(m, link_mass=1.0, link_length=0.2, feed=feed),
    "series": lambda m, feed: pam.SeriesLoad(m, feed=feed),
}


def away_from_the_borders_of_pieces(plant, rng):
    """A point in the middle of the range: taut muscles, a flow that is not laminar."""
    x, u = plant.vector("state"), plant.vector("input")
    for vector, variables in ((x, plant.states), (u, plant.inputs)):
        for i, v in enumerate(variables):
            if v.unit == "Pa":
                vector[i] = rng.uniform(2.5e5, 3.5e5)
            elif v.causality == "input":
                vector[i] = rng.uniform(0.3, 0.7) * v.nominal
            elif np.isfinite(v.min) and np.isfinite(v.max):
                vector[i] = v.min + rng.uniform(0.45, 0.55) * (v.max - v.min)
            else:
                vector[i] = rng.uniform(0.2, 0.8) * v.nominal
    return x, u


def central_differences(function, z, step):
    """Derivatives to order h^8."""
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}
    columns = []
    for i, h in enumerate(step):
        e = np.zeros_like(z)
        e[i] = h
        values = [w * (function(z + k * e) - function(z - k * e)) for k, w in weights.items()]
        columns.append(sum(values) / h)
    return np.column_stack(columns)


@pytest.mark.parametrize("feed", FEEDS)
@pytest.mark.parametrize("kind", PLANTS)
def test_jacobians_agree_with_differences_to_1e_8(kind, feed, long_muscle):
    plant = PLANTS[kind](long_muscle, FEEDS[feed])
    p = plant.vector("parameter")
    x, u = away_from_the_borders_of_pieces(plant, np.random.default_rng(1))
    point = pam.operating.OperatingPoint(plant, x, u)
    n = len(x)

    def values(z):
        xdot, y, _ = plant.function(z[:n], z[n:], p)
        return np.concatenate([flat(xdot), z[:n], flat(y)])

    nominal = np.concatenate([plant.vector(c, attribute="nominal") for c in ("state", "input")])
    expected = central_differences(values, np.concatenate([x, u]), 0.02 * nominal)
    system = plant.linearize(point)
    found = np.block([[system.A, system.B], [system.C, system.D]])
    # in units of nominal the largest entry of each row says what counts
    row = np.abs(expected * nominal).max(axis=1, keepdims=True)
    error = np.abs(found - expected) * nominal
    assert np.all(error <= 1e-8 * row)


def test_signals_keep_their_names_in_python_control(slide):
    system = slide.linearize(inputs=["muscle1.command"], outputs=["x", "muscle1.force"])
    assert system.input_labels == ["muscle1_command"]
    assert system.output_labels == ["x", "muscle1_force"]
    assert system.state_labels == ["x", "v", "muscle1_pressure", "muscle2_pressure"]
    assert system.name == "antagonistic_slide"


def test_a_slide_rests_at_the_stiffness_asked_for(slide):
    point = slide.equilibrium(x=0.0, stiffness=2e4)
    assert point["stiffness"] == pytest.approx(2e4, rel=1e-12)
    assert point["muscle1.force"] == pytest.approx(point["muscle2.force"], rel=1e-12)
    assert point.residual < 1e-9


def test_too_few_conditions_are_counted(slide):
    refused(r"needs 2 condition.*1 given: x", slide.equilibrium, x=0.0)


def test_a_load_too_heavy_says_the_pressure_that_would_carry_it(hanging, long_muscle):
    needed = float(long_muscle.law.pressure(100.0 * 9.80665, 0.0)) / BAR
    with pytest.raises(
        EquilibriumError, match=r"no equilibrium.*muscle\.command = 2 bar"
    ) as caught:
        hanging.equilibrium({"mass": 100.0, "muscle.command": 2 * BAR})
    suggested = re.search(r"muscle\.command = ([\d.]+) bar would do", str(caught.value))
    assert float(suggested[1]) == pytest.approx(needed, rel=1e-4)
    with pytest.raises(EquilibriumError, match=r"beyond the plant's range"):
        hanging.equilibrium({"mass": 250.0, "muscle.command": 2 * BAR})


def test_a_condition_outside_its_range_is_refused(hanging):
    refused("x: the condition = 500 mm is outside", hanging.equilibrium, x=0.5)


# ---- discrete, along a motion, over a grid
# ---------------------------------------------------------
def test_sampled_with_a_held_input_the_system_steps_as_the_continuous_one_moves(hanging):
    point = hanging.equilibrium(x=0.06)
    system, sampled = hanging.linearize(point), hanging.linearize(point, dt=0.01)
    assert sampled.dt == 0.01
    assert sampled.input_labels == system.input_labels
    assert sampled.state_labels == system.state_labels
    assert np.sort_complex(np.linalg.eigvals(sampled.A)) == pytest.approx(
        np.sort_complex(np.exp(0.01 * system.poles())), rel=1e-10
    )
    nominal = hanging.vector("state", attribute="nominal")
    a, b = system.A * nominal / nominal[:, None], system.B / nominal[:, None]
    exact = expm(0.01 * np.block([[a, b], [np.zeros((1, 4))]]))
    assert sampled.A * nominal / nominal[:, None] == pytest.approx(exact[:3, :3], abs=1e-12)
    assert sampled.B / nominal[:, None] == pytest.approx(exact[:3, 3:], rel=1e-9)


def test_modes_are_the_oscillating_pairs_slowest_first():
    system = control.ss(
        np.diag([0.0, -5.0, -2.0]) + np.diag([20.0], 2), np.ones((3, 1)), np.eye(3), 0
    )
    assert pam.operating.modes(system) == []
    pairs = (
        np.kron(np.diag([-3.0, 1.0]), np.eye(2))
        + np.diag([12.0, 0, 4], 1)
        - np.diag([12.0, 0, 4], -1)
    )
    system = control.ss(pairs, np.ones((4, 1)), np.eye(4), 0)
    growing, falling = (np.sqrt(17.0), -1 / np.sqrt(17)), (np.sqrt(153.0), 3 / np.sqrt(153))
    for found, (size, ratio) in zip(pam.operating.modes(system), (growing, falling), strict=True):
        assert found == pytest.approx((size / (2 * np.pi), ratio))
    refused("system is a float", pam.operating.modes, 3.0)


def test_what_no_input_moves_is_told():
    """The force reaches the position by way of two integrations, unless the chain is cut."""
    plant = pitchfork()
    a, b = np.array([[0.0, 1.0], [1.0, -1.0]]), np.array([[0.0], [1.0]])
    no_influence("lqr", plant, a, b, ["f"])
    for cut, still in ((a * [[1, 0], [1, 1]], b), (a, 0 * b), (a, 1e-14 * b)):
        refused("lqr: f has no influence on x here", no_influence, "lqr", plant, cut, still, ["f"])
    along = np.stack([0 * b, b])  # somewhere on the way is enough
    no_influence("tvlqr", plant, np.stack([a, a]), along, ["f"])


def test_deviations_from_a_motion_follow_the_time_varying_system(slide):
    """d' = A(t) d by an integrator of its own is the difference of two nearby motions."""
    from scipy.integrate import solve_ivp

    t = np.linspace(0, 0.1, 401)
    inputs = {
        "muscle1.command": lambda s: 3e5 + 1e5 * np.sin(40 * s),
        "muscle2.command": lambda s: 3e5 - 1e5 * np.sin(40 * s),
    }
    start = {"x": 0.0, "v": 0.0, "muscle1.pressure": 3e5, "muscle2.pressure": 3e5}
    motion = pam.simulate(slide, inputs, t=t, start=start)
    small = 1e-7
    other = pam.simulate(slide, inputs, t=t, start={**start, "x": small}, rtol=1e-12)
    reference = pam.simulate(slide, inputs, t=t, start=start, rtol=1e-12)
    along = linearize_along(slide, motion, outputs=["x"])
    assert along.A.shape == (401, 4, 4)
    assert along.B.shape == (401, 4, 2)
    deviation = solve_ivp(
        lambda s, d: along.at(s)[0] @ d, (0, 0.1), [small, 0, 0, 0], t_eval=t, rtol=1e-9, atol=1e-14
    )
    expected = other["x"] - reference["x"]
    assert deviation.y[0] == pytest.approx(expected, abs=1e-4 * float(np.abs(expected).max()))
    for at, expected in ((-1.0, 0), (1.0, -1), (t[7], 7)):
        assert [m.tolist() for m in along.at(at)] == [
            m[expected].tolist() for m in (along.A, along.B, along.C, along.D)
        ]
    half = [(m[7] + m[8]) / 2 for m in (along.A, along.B, along.C, along.D)]
    for found, mean in zip(along.at((t[7] + t[8]) / 2), half, strict=True):
        assert found == pytest.approx(mean, rel=1e-9, abs=1e-9)
    few = linearize_along(slide, motion, t=t[[7, 200]], inputs=["muscle2.command"])
    assert few.A.tolist() == along.A[[7, 200]].tolist()
    assert few.u[:, 0] == pytest.approx(motion["muscle2.command"][[7, 200]], rel=1e-12)
    assert along.system(0.05, dt=1e-3).dt == 1e-3
    frozen = along.system(0.05)
    there = {v.name: motion[v.name][200] for v in (*slide.states, *slide.inputs)}
    assert np.allclose(frozen.A, slide.linearize(there).A, rtol=1e-10, atol=0)


def test_a_grid_interpolates_between_its_points_of_rest(slide):
    family = linearize_grid(
        slide,
        {"x": np.linspace(-0.008, 0.008, 9), "stiffness": np.linspace(2e4, 2.6e4, 7)},
        outputs=["x"],
    )
    node = family(x=0.002, stiffness=2.3e4)
    exact = slide.linearize(slide.equilibrium(x=0.002, stiffness=2.3e4), outputs=["x"])
    assert np.allclose(node.A, exact.A, rtol=1e-9, atol=1e-9)
    between = family(x=0.003, stiffness=2.25e4)
    exact = slide.linearize(slide.equilibrium(x=0.003, stiffness=2.25e4), outputs=["x"])
    assert between.poles() == pytest.approx(exact.poles(), rel=5e-3)
    assert between.input_labels == ["muscle1_command", "muscle2_command"]
    assert family(x=0.003, stiffness=2.25e4, dt=0.01).dt == 0.01
    assert family.x.shape == (9, 7, 4)
    assert family.u[..., 0] == pytest.approx(family.x[..., 2], rel=1e-9)  # at rest
    assert family.x[:, 3, 0] == pytest.approx(np.linspace(-0.008, 0.008, 9), abs=1e-12)
    points, systems = zip(*family.systems(), strict=True)
    assert [p["stiffness"] for p in points[:2]] == pytest.approx([2e4, 2.1e4])
    assert systems[8].A.tolist() == family.A[1, 1].tolist()
    refused("give a value for each axis", family, x=0.003)
    refused(r"x = 9 mm is outside the grid -8 mm \.\. 8 mm", family, x=0.009, stiffness=2.2e4)
    with pytest.raises(EquilibriumError, match="grid point x = 0 mm, stiffness = 100 N/mm"):
        linearize_grid(slide, {"x": [0.0, 0.001], "stiffness": [1e5, 2e5]})


# ---- more equilibria
# -------------------------------------------------------------------------------
def test_the_load_that_rests_at_a_place_and_pressure_is_found(hanging, long_muscle):
    point = hanging.equilibrium({"x": 0.06, "muscle.command": 3 * BAR}, free=["mass"])
    force = long_muscle.force(3 * BAR, 0.06 / 0.4)
    assert point["mass"] == pytest.approx(force / 9.80665, rel=1e-9)
    assert point.plant.variable("mass").start == point["mass"]
    assert hanging.variable("mass").start == 20.0


def test_torque_and_co_contraction_fix_the_angle_of_a_joint(long_muscle):
    joint = pam.AntagonisticJoint(long_muscle, link_mass=2.0, link_length=0.3)
    p = [joint.expression(f"muscle{i}.pressure") for i in (1, 2)]
    mean = {"co-contraction": ((p[0] + p[1]) / 2, 3 * BAR)}
    point = joint.equilibrium(torque=2.0, expressions=mean)
    assert np.sin(point["theta"]) == pytest.approx(2.0 / (2.0 * 9.80665 * 0.3), rel=1e-9)
    both = point["muscle1.pressure"], point["muscle2.pressure"]
    assert pam.operating.common_and_difference(*both)[0] == pytest.approx(3 * BAR, rel=1e-9)
    with pytest.raises(EquilibriumError, match=r"torque = 2 N\.m, co-contraction = 900000 within"):
        joint.equilibrium(
            torque=2.0, expressions={"co-contraction": (mean["co-contraction"][0], 9e5)}
        )


def test_a_disturbance_can_be_the_unknown(long_muscle):
    joint = pam.AntagonisticJoint(long_muscle, loads=[pam.loads.ExternalForce()])
    (external,) = [v.name for v in joint.inputs if v.disturbance]
    given = {"theta": 0.2, "muscle1.command": 3 * BAR, "muscle2.command": 3 * BAR}
    point = joint.equilibrium(given, free=[external])
    assert abs(point[external]) == pytest.approx(abs(point["torque"]), rel=1e-9)


def test_free_variables_are_counted_and_checked(hanging):
    with pytest.raises(InputError, match=r"needs 2 condition\(s\).*free variables.*1 given: x"):
        hanging.equilibrium({"x": 0.06}, free=["mass"])
    refused("free: v is a state", hanging.equilibrium, {"x": 0.06}, free=["v"])
    with pytest.raises(InputError, match="mass cannot be free and given"):
        hanging.equilibrium({"x": 0.06, "mass": 3.0}, free=["mass"])


def pitchfork():
    """x'' = a x - x^3 - x': one point of rest for a < 0, three for a > 0."""
    plant = pam.Plant("pitchfork")
    x = plant.state("x", start=0.1, min=-3, max=3)
    v = plant.state("v")
    a = plant.parameter("a", 1.0, min=-2, max=4)
    f = plant.input("f", min=-10, max=10)
    plant.der(x, v)
    plant.der(v, a * x - x**3 - v + f)
    return plant


def test_eigenvalues_along_a_path_of_rest_are_those_of_its_equation():
    """About x = 1/2, which f holds: s^2 + s = a - 3/4."""
    values = np.linspace(-2.0, 3.0, 11)
    path = stability_path(pitchfork(), "a", values, x=0.5)
    roots = [np.roots([1.0, 1.0, 0.75 - a]) for a in values]
    for found, expected in zip(path.eigenvalues, roots, strict=True):
        assert np.sort_complex(found) == pytest.approx(np.sort_complex(expected), abs=1e-7)
    assert path.column("f") == pytest.approx(0.125 - values / 2, abs=1e-9)
    assert path.growth == pytest.approx([r.real.max() for r in roots], abs=1e-7)
    assert path.stable.tolist() == [a < 0.75 for a in values]
    assert [p.plant.variable("a").start for p in path.points] == values.tolist()
    real = path.eigenvalues[values > 0.5].real  # one falls, the other rises
    assert sorted(np.sign(np.diff(real, axis=0)).mean(axis=0)) == [-1, 1]
    with pytest.raises(EquilibriumError, match=r"the path ends at a = 1: no equilibrium"):
        stability_path(pitchfork(), "a", [3.0, 1.0], x=2.5)  # f = 15.6 - 2.5 a, at most 10
    refused("at least one number", stability_path, pitchfork(), "a", [], x=0.5)


def test_all_points_of_rest_are_found_and_classified():
    points = equilibria(pitchfork(), f=0.0)
    assert [p["x"] for p in points] == pytest.approx([-1, 0, 1], abs=1e-9)
    assert [p.stability for p in points] == ["stable", "unstable", "stable"]
    # the fastest growth first
    assert points[1].poles.real == pytest.approx(np.sort(np.roots([1, 1, -1]))[::-1], rel=1e-9)
    (only,) = equilibria(pitchfork(), a=-1.0, f=0.0)
    assert only["x"] == pytest.approx(0, abs=1e-9)
    (border,) = equilibria(pitchfork().with_values(a=0.0), x=0.0)
    assert border.stability == "marginal"


def test_a_path_stays_on_its_branch_and_ends_at_the_fold():
    """x^3 - x = f: the upper branch folds back at x = 1/sqrt(3), f = -2/(3 sqrt(3)) = -0.3849."""
    values = np.linspace(2.0, -1.0, 121)
    upper = equilibrium_path(pitchfork(), "f", values)
    assert "no neighbour within the bounds" in upper.end or upper["x"][-1] < 0
    before = upper.values > -0.38
    assert upper["x"][before] ** 3 - upper["x"][before] == pytest.approx(upper.values[before])
    assert np.all(upper["x"][before] > 1 / np.sqrt(3))


def test_a_path_of_the_hanging_load_ends_where_the_muscle_can_lift_no_more(hanging, long_muscle):
    path = equilibrium_path(hanging, "mass", np.linspace(5, 120, 47), {"muscle.command": 3 * BAR})
    most = long_muscle.force(3 * BAR, 0.0) / 9.80665
    assert path.end
    assert path.values[-1] <= most < path.values[-1] + 2.5
    assert np.all(np.diff(path["x"]) < 0)
    assert path["muscle.force"] == pytest.approx(path.values * 9.80665, rel=1e-9)
    assert {p.stability for p in path.points} == {"stable"}


def test_a_linear_model_is_what_python_control_makes_of_it(hanging):
    point = hanging.equilibrium(x=0.06)
    for options in ({}, {"dt": 0.01}, {"stuck": True, "units": "display", "outputs": ["x"]}):
        model = linear_model(hanging, point, **options)
        system = hanging.linearize(point, **options)
        assert (system.A.tolist(), system.dt) == (model.A.tolist(), model.dt)
        assert system.units == model.units
        assert system.output_labels == model.output_labels
        assert np.sort(model.poles()) == pytest.approx(np.sort(system.poles()), rel=1e-9)
        places = np.exp(0.3j) if model.dt else 2j * np.pi * np.array([0.1, 3.0, 50.0])
        expected = system(places, squeeze=False)
        assert model(places).reshape(expected.shape) == pytest.approx(expected, rel=1e-9)
        swings = np.array(pam.operating.modes(system))
        assert np.array(pam.operating.modes(model)) == pytest.approx(swings, rel=1e-6)

"""The arrangements of muscles and loads: equations, energy, agreement with SciPy, bad input."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from conftest import BAR, rates_and_outputs, refused, scipy_states

import pam_ocp as pam

MUSCLE = pam.muscle("DMSP-20-400N")


def plants(**options):
    """One of each plant."""
    return {
        "hanging": pam.HangingLoad(MUSCLE, 20.0, **options),
        "spring": pam.SpringOverMuscle(MUSCLE, 2.0, 5e3, 100.0, **options),
        "slide": pam.AntagonisticSlide(MUSCLE, 2.0, 0.125, **options),
        "joint": pam.AntagonisticJoint(MUSCLE, link_mass=1.0, link_length=0.2, **options),
        "bent_joint": pam.AntagonisticJoint(
            MUSCLE, moment_arm=lambda a: 0.03 + 0.01 * ca.cos(a), **options
        ),
        "series": pam.SeriesLoad(MUSCLE, 20.0, 1e5, **options),
    }


@pytest.mark.parametrize(
    ("name", "method"), [*((name, "DOP853") for name in plants()), ("slide", "Radau")]
)
def test_every_plant_agrees_with_scipy(name, method):
    plant = plants()[name]
    t = np.linspace(0.0, 0.3 if method == "DOP853" else 0.06, 4)
    rng = np.random.default_rng(7)
    u = rng.uniform(2.5 * BAR, 4.5 * BAR, size=(len(plant.inputs), len(t)))
    inputs = {v.name: row for v, row in zip(plant.inputs, u, strict=True)}
    motion = pam.simulate(plant, inputs, t=t, rtol=1e-11)
    held = lambda s: u[:, min(int(np.searchsorted(t, s, side="right")) - 1, len(t) - 2)]  # noqa: E731
    rtol = 1e-11 if method == "DOP853" else 1e-10
    expected = scipy_states(plant, held, t, method=method, rtol=rtol)
    nominal = plant.vector("state", attribute="nominal")
    assert np.max(np.abs(motion.array(motion.named("state")) - expected) / nominal) < 1e-7


def work(p, kappa):
    """Integral of the six-parameter tension over the shortening of 0.4 m, in closed form [J]."""
    a1, a2, a3, a4, a5, a6 = MUSCLE.law.values.values()
    return 0.4 * (
        (a1 * p + a2) / a3 * np.exp(a3 * kappa) + a4 * p * kappa**2 / 2 + (a5 * p + a6) * kappa
    )


def pair_work(p, kappa):
    return work(p[0], 0.125 + kappa) + work(p[1], 0.125 - kappa)


UNDAMPED = {"damping": pam.losses.ConstantDamping(0.0), "feed": pam.feeds.IdealPressure()}


@pytest.mark.parametrize(
    ("plant", "start", "pressures", "energy"),
    [
        (
            pam.HangingLoad(MUSCLE, 20.0, **UNDAMPED),
            {"x": 0.0708},
            (4,),
            lambda m, p: 10 * m["v"] ** 2 + 20 * 9.80665 * m["x"] - work(p[0], m["x"] / 0.4),
        ),
        (
            pam.SpringOverMuscle(MUSCLE, 2.0, 5e3, 100.0, inclination=0.5, **UNDAMPED),
            {"x": 0.05},
            (4,),
            lambda m, p: (
                m["v"] ** 2
                + 2.5e3 * m["x"] ** 2
                - work(p[0], m["x"] / 0.4)
                + (2.0 * 9.80665 * np.sin(0.5) + 100.0) * m["x"]
            ),
        ),
        (
            pam.AntagonisticSlide(MUSCLE, 2.0, 0.125, **UNDAMPED),
            {"x": 0.005},
            (4, 4),
            lambda m, p: m["v"] ** 2 - pair_work(p, m["x"] / 0.4),
        ),
        (
            pam.AntagonisticJoint(
                MUSCLE,
                moment_arm=lambda a: 0.03 + 0.01 * ca.cos(a),
                link_mass=1.0,
                link_length=0.2,
                **UNDAMPED,
            ),
            {"theta": 0.2},
            (4, 4),
            lambda m, p: (
                0.025 * m["omega"] ** 2
                + 0.2 * 9.80665 * (1 - np.cos(m["theta"]))
                - pair_work(p, (0.03 * m["theta"] + 0.01 * np.sin(m["theta"])) / 0.4)
            ),
        ),
    ],
    ids=["hanging", "spring", "slide", "joint"],
)
def test_energy_is_conserved_over_a_hundred_periods(plant, start, pressures, energy):
    """Ideal pressure, no damping, always taut: the energy in closed form stays to 1e-6."""
    p = [bar * BAR for bar in pressures]
    inputs = dict(zip([v.name for v in plant.inputs], p, strict=True))
    first = pam.simulate(plant, inputs, t=np.linspace(0, 2, 2001), start=start)
    position = first[next(iter(plant.positions))]
    middle = (position.max() + position.min()) / 2
    crossings = np.sum(np.diff(np.sign(position - middle)) != 0)
    period = 2 * 2.0 / crossings
    t = np.linspace(0, 100 * period, 3001)
    motion = pam.simulate(plant, inputs, t=t, start=start, rtol=1e-12)
    for name in plant.constraints:
        kappa = motion[name.name.replace("tension", "contraction")]
        tension = MUSCLE.law.tension(inputs[name.name.replace("tension", "pressure")], kappa)
        assert np.min(tension) > 1.0, "the closed form holds for a taut muscle only"
    velocity = motion[plant.positions[next(iter(plant.positions))]]
    inertia = {"hanging_load": 20.0, "antagonistic_joint": 0.05}.get(plant.name, 2.0)
    exchanged = inertia * np.max(velocity**2) / 2
    assert exchanged > 0.01  # joules: it moves
    assert np.ptp(energy(motion, p)) < 1e-6 * exchanged


def test_a_moment_arm_of_any_shape_shortens_the_muscle_by_its_integral():
    plant = plants()["bent_joint"]
    at = {"theta": 0.6, "muscle1.pressure": 3 * BAR, "muscle2.pressure": 3 * BAR}
    outputs = rates_and_outputs(plant, at)[1]
    shortening = 0.03 * 0.6 + 0.01 * np.sin(0.6)
    assert outputs["muscle1.contraction"] == pytest.approx(0.125 + shortening / 0.4, rel=1e-13)
    assert outputs["muscle1.radius"] == pytest.approx(0.03 + 0.01 * np.cos(0.6), rel=1e-13)
    f1, f2 = outputs["muscle1.force"], outputs["muscle2.force"]
    assert outputs["torque"] == pytest.approx(outputs["muscle1.radius"] * (f1 - f2), rel=1e-12)


@pytest.mark.parametrize(
    ("stretch", "pull"), [(-2.0, 0.0), (-1.0, 0.0), (0.0, 0.15625), (1.0, 1.0), (80.0, 80.0)]
)
def test_a_tendon_only_pulls_rounded_off_within_one_newton(stretch, pull):
    """At no stretch the integral of the quintic smoothstep from -1 to 0: 5/32 of the width."""
    plant = pam.SeriesLoad("DMSP-20-300", tendon_stiffness=1e5, tendon_damping=0.0)
    at = {"x": 0.02, "muscle.shortening": 0.02 + stretch / 1e5}
    assert rates_and_outputs(plant, at)[1]["tendon_force"] == pytest.approx(pull, abs=1e-9)


def test_a_stiff_tendon_hangs_the_load_where_the_muscle_alone_would():
    alone = pam.HangingLoad(MUSCLE, 20.0).equilibrium({"muscle.command": 4 * BAR})
    series = plants()["series"].equilibrium({"muscle.command": 4 * BAR})
    assert series["muscle.shortening"] == pytest.approx(alone["x"], rel=1e-9)
    assert series["x"] == pytest.approx(alone["x"] - 20.0 * 9.80665 / 1e5, rel=1e-9)


def accelerated(plant, at):
    return rates_and_outputs(plant, at)[0][plant.positions[next(iter(plant.positions))]]


def test_loads_add_their_forces():
    loads = (
        pam.loads.Spring(200.0, 0.01),
        pam.loads.Damper(3.0),
        pam.loads.Inertia(1.5),
        pam.loads.ExternalForce(start=7.0),
    )
    at = {"x": 0.05, "v": 0.4, "muscle.pressure": 3 * BAR}
    one = accelerated(pam.SpringOverMuscle(MUSCLE, 2.0), at) * 2.0
    two = accelerated(pam.SpringOverMuscle(MUSCLE, 2.0, loads=loads), at) * 3.5
    assert two - one == pytest.approx(-200.0 * 0.04 - 3.0 * 0.4 + 7.0, rel=1e-9)


def test_a_wall_stops_the_load_and_takes_energy_never_pulling():
    wall = pam.loads.Wall(0.07, stiffness=1e5, damping=100.0)
    plant = pam.SpringOverMuscle(MUSCLE, 2.0, loads=(wall,), feed=pam.feeds.IdealPressure())
    motion = pam.simulate(
        plant, {"muscle.pressure": 6 * BAR}, t=np.linspace(0, 0.5, 501), events=["wall.gap"]
    )
    hit, left = motion.events[:2]
    assert (hit.name, hit.rising, left.rising) == ("wall.gap", False, True)
    into, out = np.interp([hit.time, left.time], motion.t, motion["v"])
    # a mass on a spring: the force of the muscle while in contact adds F/k at most
    assert motion["x"].max() - 0.07 < into * np.sqrt(2.0 / 1e5) + motion["muscle.force"].max() / 1e5
    assert 0 < -out < into
    free = motion["wall.gap"] > 1e-4
    other = pam.SpringOverMuscle(MUSCLE, 2.0, feed=pam.feeds.IdealPressure())
    for i in np.flatnonzero(free)[::25]:
        at = {"x": motion["x"][i], "v": motion["v"][i], "muscle.pressure": 6 * BAR}
        # away from the wall there is no wall
        assert accelerated(plant, at) == pytest.approx(accelerated(other, at), rel=1e-12)


def test_the_weight_on_an_incline_is_its_component():
    plants = (pam.SpringOverMuscle(MUSCLE, 2.0, inclination=a) for a in (0.0, 0.5))
    level, steep = (accelerated(p, {"x": 0.05, "muscle.pressure": 3e5}) for p in plants)
    assert level - steep == pytest.approx(9.80665 * np.sin(0.5), rel=1e-9)


@pytest.mark.parametrize(
    ("build", "wrong", "message"),
    [
        (pam.AntagonisticJoint, {"inertia": 0.0}, "inertia = 0 kg.m2 must be > 0"),
        (pam.AntagonisticJoint, {"moment_arm": lambda a: a * 0 - 1}, "moment_arm: the function"),
        (pam.AntagonisticJoint, {"pre_contraction": 0.4}, "slack or overstretched"),
        (pam.AntagonisticJoint, {"limits": (0.5, -0.5)}, "the lower must be the smaller"),
        (pam.AntagonisticJoint, {"limits": (-2.0, 2.0)}, "allow at most"),
        (pam.SpringOverMuscle, {"loads": (3.0,)}, "give components, such as Spring"),
    ],
)
def test_what_cannot_be_built_is_refused(build, wrong, message):
    refused(message, build, MUSCLE, **wrong)


def test_a_muscle_measured_away_from_rest_length_starts_where_it_was_measured():
    measured = replace(MUSCLE, contraction_range=(0.02, 0.2))
    for build, name in (
        (pam.HangingLoad, "x"),
        (pam.SpringOverMuscle, "x"),
        (pam.SeriesLoad, "muscle.shortening"),
    ):
        assert build(measured).variable(name).start == pytest.approx(0.008)


def test_a_joint_has_no_link_unless_one_is_given():
    """Equal pressures balance at the middle; aside, both muscles pull back and nothing else."""
    joint = pam.AntagonisticJoint(MUSCLE, 0.05, 0.04, 0.125, **UNDAMPED)
    at = {"theta": 0.2, "muscle1.pressure": 4e5, "muscle2.pressure": 4e5}
    one, two = (MUSCLE.law.tension(4e5, 0.125 + s * 0.04 * 0.2 / 0.4) for s in (1, -1))
    assert accelerated(joint, at) == pytest.approx(0.04 * (one - two) / 0.05, rel=1e-9)


@pytest.mark.parametrize(
    ("build", "own"),
    [
        (pam.HangingLoad, {"mass", "damping_ratio"}),
        (pam.SpringOverMuscle, {"mass", "damping_ratio"}),
        (pam.SeriesLoad, {"mass", "damping"}),
        (pam.AntagonisticSlide, {"mass", "damping"}),
        (
            lambda m, loads: pam.AntagonisticJoint(m, link_mass=1.0, link_length=0.2, loads=loads),
            {"inertia", "link_mass", "damping"},
        ),
    ],
)
def test_what_is_moved_may_change_during_a_simulation_and_the_muscle_may_not(build, own):
    kinds = (pam.loads.Spring, pam.loads.Damper, pam.loads.DryFriction, pam.loads.Inertia)
    plant = build(MUSCLE, loads=[*(kind(1.0) for kind in kinds), pam.loads.Wall(0.05)])
    of_loads = {"spring.stiffness", "spring.rest", "damper.coefficient", "friction.coulomb"}
    of_loads |= {"load_inertia", "wall.position"}
    assert {v.name for v in plant.parameters if v.tunable} == own | of_loads


@pytest.mark.parametrize(
    ("build", "stiffness", "coulomb", "gap"),
    [
        (pam.HangingLoad, "N/m", "N", "m"),
        (pam.AntagonisticSlide, "N/m", "N", "m"),
        (pam.AntagonisticJoint, "N.m/rad", "N.m", "rad"),
    ],
)
def test_loads_are_measured_along_the_way_or_round_the_joint(build, stiffness, coulomb, gap):
    loads = [pam.loads.Spring(1.0), pam.loads.DryFriction(1.0), pam.loads.Wall(0.05)]
    plant = build(MUSCLE, loads=loads)
    units = [plant.variable(n).unit for n in ("spring.stiffness", "friction.coulomb", "wall.gap")]
    assert units == [stiffness, coulomb, gap]

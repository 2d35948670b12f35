"""Vibration: free, its energy, the Hopf border, limit cycles and their continuation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import BAR, flat, refused, scipy_states
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp import InputError, UnknownNameError, vibration
from pam_ocp.operating import EquilibriumError
from pam_ocp.plants.regulated import RegulatedLoad
from pam_ocp.vibration import VibrationError

FOUR_BAR = {"muscle.pressure": 4 * BAR}
LOW = {"x": 0.04, "muscle.reference": 0.04}
HIGH = {"x": 0.0808, "muscle.reference": 0.0808}


def load(damping: pam.losses.ConstantDamping | pam.losses.StiffnessDamping) -> pam.Plant:
    """20 kg on the DMSP-20-400N at constant pressure."""
    return pam.HangingLoad(
        pam.muscle("DMSP-20-400N"), mass=20.0, damping=damping, feed=pam.feeds.IdealPressure()
    )


def unclamped() -> pam.Plant:
    """The undamped load with the law's tension instead of the force F >= 0."""
    muscle = pam.muscle("DMSP-20-400N")
    plant = pam.Plant("unclamped")
    x = plant.state("x", unit="m", min=0.0, max=0.12, nominal=0.01)
    v = plant.state("v", unit="m/s", nominal=0.1)
    p = plant.input("muscle.pressure", unit="Pa", min=0.0, max=6e5, start=3e5, nominal=1e5)
    plant.der(x, v)
    plant.der(v, muscle.law.tension(p, x / 0.4) / 20.0 - 9.80665)
    return plant


@cache
def regulated() -> pam.Plant:
    return RegulatedLoad(pam.muscle("DMSP-20-400N"), mass=20.0, lag=0.1)


@cache
def low_hopf() -> vibration.HopfPoint:
    return vibration.hopf(regulated(), "muscle.gain", (1e5, 1e7), LOW)


def beyond(factor: float) -> pam.Plant:
    """The regulated load near its Hopf point, the gain ``factor`` times that of the border."""
    return low_hopf().plant.with_values({"muscle.gain": factor * low_hopf().value})


@cache
def low_cycle() -> tuple[vibration.LimitCycle, pam.Trajectory]:
    """The limit cycle 10 % beyond the border, and the last second of a long simulation."""
    plant = beyond(1.10)
    times = np.append(np.linspace(0, 99, 200), np.linspace(99.005, 101, 400))
    motion = pam.simulate(plant, t=times, start={"x": 0.06}, rtol=1e-11)
    tail = motion.at(motion.t[motion.t >= 99])
    return vibration.limit_cycle(plant, tail), tail


# ---- free vibration --------------------------------------------------------------------------


def period_integral(force, offset: float) -> float:
    """Frequency [Hz] from T = 2 int dx/v with v from the conservation of energy; by SciPy."""

    def a(x):
        return np.asarray(force(4 * BAR, x / 0.4)) / 20.0 - 9.80665

    rest = brentq(a, 0.02, 0.11)
    start, grid = rest + offset, np.linspace(rest - 0.1, rest + 0.1, 20_001)
    well = CubicSpline(grid, -a(grid)).antiderivative()
    total = well(start)
    ends = rest - np.sign(offset) * 1e-6, rest - 3 * offset
    other = brentq(lambda x: well(x) - total, *ends, xtol=1e-14)
    middle, radius = (start + other) / 2, abs(start - other) / 2

    def slowness(angle):  # x = middle - radius cos(angle) takes the singular ends away
        speed2 = 2 * (total - well(middle - radius * np.cos(angle)))
        return radius * np.sin(angle) / np.sqrt(max(speed2, 1e-300))

    return 1 / (2 * quad(slowness, 0, np.pi, epsrel=1e-8, limit=200)[0])


@pytest.mark.parametrize(
    ("clamp", "offset", "reference"),
    [(True, 0.002, 3.432), (False, 0.030, 3.437), (True, 0.030, 3.26), (True, -0.030, None)],
)
@pytest.mark.filterwarnings("ignore::pam_ocp.muscles.validity.ValidityWarning")
def test_free_vibration_has_the_frequency_of_the_period_integral(clamp, offset, reference):
    muscle = pam.muscle("DMSP-20-400N")
    plant = load(pam.losses.ConstantDamping(0.0)) if clamp else unclamped()
    motion = vibration.free_vibration(plant, FOUR_BAR, offset, cycles=6)
    if reference is not None:  # REFERENCE: let go above the rest position
        digits = 2 if reference == 3.26 else 3
        assert motion.frequency == pytest.approx(reference, abs=0.51 * 10.0**-digits)
    expected = period_integral(muscle.force if clamp else muscle.law.tension, offset)
    assert motion.frequencies == pytest.approx(expected, rel=1e-7)
    assert motion.log_decrement == pytest.approx(0.0, abs=1e-8)


def test_small_damped_vibration_decays_as_the_linear_oscillator():
    motion = vibration.free_vibration(
        load(pam.losses.StiffnessDamping(0.1)), FOUR_BAR, 1e-4, cycles=8
    )
    ((natural, ratio),) = pam.operating.modes(motion.point.plant.linearize(motion.point))
    assert motion.damping_ratio == pytest.approx(ratio, rel=1e-4)
    assert motion.frequency == pytest.approx(natural * np.sqrt(1 - ratio**2), rel=1e-6)
    assert motion.rest * 1e3 == pytest.approx(80.8, abs=0.05)


def test_frequency_falls_with_amplitude_once_the_muscle_goes_slack():
    plant = load(pam.losses.ConstantDamping(0.0))
    curve = vibration.backbone(plant, FOUR_BAR, [0.002, 0.015, 0.025, 0.030])
    assert curve.frequencies[1] > curve.frequencies[0]  # taut: slightly stiffening
    assert np.all(np.diff(curve.frequencies[1:]) < -0.05)
    assert curve.highs == pytest.approx(curve.offsets, rel=1e-8)


def test_without_oscillation_there_is_nothing_to_measure():
    with pytest.raises(VibrationError, match="does not oscillate about this point"):
        vibration.free_vibration(load(pam.losses.ConstantDamping(5e3)), FOUR_BAR, 0.01)
    with pytest.raises(InputError, match="offset = 0"):
        vibration.free_vibration(load(pam.losses.ConstantDamping(0.0)), FOUR_BAR, 0.0)


# ---- energy: no self-excited vibration at constant pressure ----------------------------------


def test_energy_falls_along_every_motion_at_constant_pressure():
    plant = load(pam.losses.StiffnessDamping(0.1))
    for start in (0.03, -0.06):  # slack at the top; overstretched at no time
        motion = vibration.free_vibration(plant, FOUR_BAR, start, cycles=5).trajectory
        found = vibration.energy(plant, motion)
        assert np.all(np.diff(found.total) <= 1e-8)
        assert found.total[-1] < found.total[0] - 1.0
        k, v = np.maximum(motion["stiffness"], 0), motion["v"]
        c = 2 * 0.1 * np.sqrt(20 * (k + np.sqrt(k**2 + 1)) / 2)  # the rounded StiffnessDamping
        assert found.rate == pytest.approx(-c * v**2, rel=1e-9, abs=1e-12)


def test_energy_is_the_one_of_the_reference():
    """E = m v^2/2 + m g x - int F dx, the integral by SciPy; its slope is the rate."""
    plant = load(pam.losses.ConstantDamping(30.0))
    motion = vibration.free_vibration(plant, FOUR_BAR, 0.03, cycles=2, samples=200).trajectory
    found = vibration.energy(plant, motion)
    muscle, x, v = pam.muscle("DMSP-20-400N"), motion["x"], motion["v"]
    for i in (40, 111, 170):
        work = quad(lambda s: muscle.force(4 * BAR, s / 0.4), x[0], x[i], epsabs=1e-11, limit=400)[
            0
        ]
        expected = 20 * v[i] ** 2 / 2 + 20 * 9.80665 * (x[i] - x[0]) - work
        assert found.total[i] == pytest.approx(expected, abs=1e-8)
    slope = np.gradient(found.total, motion.t, edge_order=2)
    assert slope == pytest.approx(-30 * v**2, abs=2e-2 * np.max(30 * v**2))


def test_undamped_energy_is_conserved():
    plant = load(pam.losses.ConstantDamping(0.0))
    motion = vibration.free_vibration(plant, FOUR_BAR, 0.03, cycles=20)
    found = vibration.energy(plant, motion.trajectory)
    assert np.ptp(found.total) < 1e-8 * found.kinetic.max()


def test_the_energy_is_that_of_all_that_moves():
    muscle = replace(pam.muscle("DMSP-20-400N"), end_mass=1.0)
    more = {"loads": pam.loads.Inertia(5.0), "damping": 0.0, "feed": pam.feeds.IdealPressure()}
    for plant, moved, speed in (
        (pam.SpringOverMuscle(muscle, 2.0, **more), 7.5, "v"),
        (pam.AntagonisticJoint(muscle, 0.05, 0.04, **more), 5.05 + 0.04**2, "omega"),
    ):
        at, state = {v.name: 4 * BAR for v in plant.inputs}, plant.states[0].name
        run = vibration.free_vibration(plant, at, 0.005, state=state, cycles=2).trajectory
        found = vibration.energy(plant, run, position=state)
        assert found.kinetic == pytest.approx(moved * run[speed] ** 2 / 2, rel=1e-9)
        assert np.ptp(found.total) < 1e-8 * found.kinetic.max()
    lever = pam.AntagonisticJoint(muscle, 0.05, lambda a: 0.04 + 0.01 * a, **more)
    run = pam.simulate(lever, duration=0.1, start={"theta": 0.3})
    with pytest.raises(InputError, match="mass: what moves in 'antagonistic_joint' changes"):
        vibration.energy(lever, run, position="theta")


def test_energy_refuses_a_moving_pressure():
    cycle, _ = low_cycle()
    refused(r"muscle\.pressure moves between", vibration.energy, cycle.plant, cycle.trajectory)


# ---- the border ------------------------------------------------------------------------------


def routh_hurwitz(conditions, lag: float) -> tuple[float, float]:
    """Gain and frequency [Hz] at which m T s^3 + (m + c T) s^2 + (c + k T) s + k + G s0 turns."""
    point = regulated().equilibrium({**conditions, "muscle.lag": lag})
    muscle, m = pam.muscle("DMSP-20-400N"), 20.0
    p, kappa, step = point["muscle.pressure"], point["x"] / 0.4, 1e-5
    k = -(muscle.tension(p, kappa + step) - muscle.tension(p, kappa - step)) / (2 * step * 0.4)
    area = (muscle.tension(p + 10, kappa) - muscle.tension(p - 10, kappa)) / 20
    c = 0.2 * np.sqrt(m * k)
    gain = ((m + c * lag) * (c + k * lag) / (m * lag) - k) / area
    roots = np.roots([m * lag, m + c * lag, c + k * lag, k + area * gain])
    return gain, float(np.max(roots.imag)) / (2 * np.pi)


def test_the_hopf_point_is_that_of_routh_and_hurwitz():
    found = low_hopf()
    gain, frequency = routh_hurwitz(LOW, 0.1)
    assert found.value == pytest.approx(gain, rel=1e-6)
    assert found.frequency == pytest.approx(frequency, rel=1e-6)
    assert found.residual < 1e-10
    point, plant = found.point, found.plant
    poles = np.linalg.eigvals(
        np.asarray(plant.jacobians(point.x, point.u, plant.vector("parameter"))[0])
    )
    assert np.sort(np.abs(poles.real))[:2] == pytest.approx([0, 0], abs=1e-11)


def test_the_crossing_rate_is_the_slope_of_the_growth_rate():
    found, step = low_hopf(), 1e3
    path = vibration.stability_path(
        regulated(), "muscle.gain", found.value + step * np.array([-1, 0, 1]), LOW
    )
    assert found.crossing == pytest.approx((path.growth[2] - path.growth[0]) / (2 * step), rel=1e-5)
    assert path.stable.tolist()[::2] == [True, False]


def test_the_border_over_gain_and_lag_is_that_of_routh_and_hurwitz():
    lags = np.geomspace(0.01, 0.5, 8)
    border = vibration.hopf_border(regulated(), "muscle.gain", (1e5, 3e7), "muscle.lag", lags, LOW)
    expected = np.array([routh_hurwitz(LOW, lag) for lag in lags])
    assert border.border == pytest.approx(expected[:, 0], rel=1e-6)
    assert border.frequencies == pytest.approx(expected[:, 1], rel=1e-6)
    assert not border.reasons


def test_beside_the_border_simulations_decay_and_grow():
    t = np.linspace(0, 8, 2001)
    swings = []
    for factor in (0.95, 1.05):
        x = pam.simulate(beyond(factor), t=t, start={"x": 0.041})["x"]
        swings.append(np.ptp(x[t > 7]) / np.ptp(x[t < 1]))
    assert swings[0] < 0.8
    assert swings[1] > 1.3


def test_a_path_of_rest_finds_the_equilibria_of_each_pressure():
    """The input itself varies; every point agrees with pam_ocp.equilibrium."""
    path = vibration.stability_path(
        load(pam.losses.StiffnessDamping(0.1)), "muscle.pressure", np.array([2, 4, 6]) * BAR
    )
    assert path.column("x") * 1e3 == pytest.approx([34.6, 80.8, 97.3], abs=0.05)  # REFERENCE
    frequency = np.abs(path.eigenvalues).max(axis=1) / (2 * np.pi)
    assert frequency == pytest.approx([2.74, 3.43, 4.20], abs=0.005)


# ---- limit cycles ----------------------------------------------------------------------------


def test_the_limit_cycle_is_what_a_long_simulation_ends_in():
    cycle, tail = low_cycle()
    x = tail["x"]
    fine = np.linspace(tail.t[0], tail.t[-1], 200_001)
    from scipy.interpolate import CubicHermiteSpline

    curve = CubicHermiteSpline(tail.t, x, tail["v"])
    y = curve(fine) - 0.04
    rises = fine[1:][(y[:-1] < 0) & (y[1:] >= 0)]
    assert cycle.period == pytest.approx(np.diff(rises).mean(), rel=1e-4)
    assert cycle.amplitude("x") == pytest.approx(np.ptp(y) / 2, rel=1e-4)
    assert cycle.closing_error < 1e-9


def test_floquet_multipliers_of_the_cycle():
    """One is 1; the others agree with the variational equation, integrated by SciPy."""
    cycle, _ = low_cycle()
    assert cycle.multipliers[0] == pytest.approx(1.0, abs=1e-6)
    assert cycle.stable
    assert np.all(np.abs(cycle.multipliers[1:]) < 1)
    plant = cycle.plant
    start = np.array([cycle.trajectory[v.name][0] for v in plant.states])
    nominal, u = plant.vector("state", attribute="nominal"), plant.vector("input")
    columns = []
    for i in range(3):
        shift = np.eye(3)[i] * 1e-4 * nominal
        ends = [
            scipy_states(plant, lambda _: u, [0.0, cycle.period], start + sign * shift)[-1]
            for sign in (1, -1)
        ]
        columns.append((ends[0] - ends[1]) / (2e-4 * nominal))
    others = np.sort(np.abs(np.linalg.eigvals(np.array(columns).T)))
    assert np.sort(np.abs(cycle.multipliers)) == pytest.approx(others, abs=2e-6)


def test_near_the_hopf_point_the_cycle_is_the_linear_mode():
    point = low_hopf()
    cycle = vibration.limit_cycle(point.plant, point, amplitude={"x": 1e-3})
    assert cycle.amplitude("x") == pytest.approx(1e-3, rel=1e-3)
    assert cycle.frequency == pytest.approx(point.frequency, rel=1e-3)
    # supercritical and unstable above: the cycle is stable and lies above
    assert point.supercritical
    assert cycle.stable
    assert cycle.plant.variable("muscle.gain").start > point.value


def test_the_lyapunov_coefficient_tells_how_the_parameter_moves_with_amplitude():
    """Normal form r' = growth r + omega l1 r^3: growth r = -omega l1 r^2 on the cycle."""
    point = low_hopf()
    nominal = point.plant.vector("state", attribute="nominal")
    mode = point.mode / nominal
    size = 5e-4
    cycle = vibration.limit_cycle(point.plant, point, amplitude={"x": size})
    offset = cycle.plant.variable("muscle.gain").start - point.value
    # z = 2 r Re(q e^(i phi)) with |q| = 1, so a state swings by 2 r |q_i|
    r = size / (2 * abs(mode[0]) / np.linalg.norm(mode)) / nominal[0]
    omega = 2 * np.pi * point.frequency
    assert point.crossing * offset == pytest.approx(-omega * point.lyapunov * r**2, rel=1e-2)


def test_a_branch_reaches_the_cycle_found_by_simulation():
    point = low_hopf()
    small = vibration.limit_cycle(point.plant, point)
    branch = vibration.continue_cycle(
        small, "muscle.gain", (0.5 * point.value, 1.13 * point.value), step=1.0
    )
    assert branch.ended == f"muscle.gain reaches {_gain(1.13 * point.value)}"
    assert branch.values[-1] == pytest.approx(1.13 * point.value, rel=1e-12)
    assert np.all(np.diff(branch.amplitudes("x")) > 0)
    assert branch.stable.all()
    (there,) = branch.at(1.10 * point.value)
    cycle, _ = low_cycle()
    assert there.period == pytest.approx(cycle.period, rel=1e-8)
    assert there.amplitude("x") == pytest.approx(cycle.amplitude("x"), rel=1e-8)


@pytest.mark.slow
def test_slack_makes_the_onset_a_jump():
    """At 80.8 mm the muscle goes slack at 20 mm amplitude: there the branch folds back.

    The rest is stable still, a stable cycle of about 165 mm stands beside it: the unstable one
    between them parts simulations that die out from those that grow.
    """
    point = vibration.hopf(regulated(), "muscle.gain", (1e5, 1e7), HIGH)
    small = vibration.limit_cycle(point.plant, point, amplitude={"x": 0.012})
    branch = vibration.continue_cycle(
        small, "muscle.gain", (0.9 * point.value, 1.1 * point.value), step=1.0
    )
    assert len(branch.folds) == 1
    assert branch.values[-1] == pytest.approx(0.9 * point.value)
    assert branch.stable[0]
    assert not branch.stable[-1]
    assert branch.cycles[0].slack["muscle.tension"] == 0
    assert branch.cycles[-1].slack["muscle.tension"] > 0.1
    last = branch.cycles[-1]
    assert last.multipliers[0] == pytest.approx(1, abs=1e-4)
    assert last.multipliers[1].real > 1
    first = {v.name: last.trajectory[v.name][0] for v in last.plant.states}
    rest = dict(zip(first, point.point.x, strict=True))
    swings = []
    for factor in (0.97, 1.03):
        start = {n: rest[n] + factor * (first[n] - rest[n]) for n in first}
        t = np.linspace(0, 2, 801)
        x = pam.simulate(last.plant, t=t, start=start)["x"]
        swings.append(np.ptp(x[t > 1.5]) / np.ptp(x[t < 0.35]))
    assert swings[0] < 0.95
    assert swings[1] > 1.05


def _gain(value: float) -> str:
    return regulated().variable("muscle.gain").shown(value)


# ---- bad input -------------------------------------------------------------------------------


def test_unknown_names_are_answered_with_near_ones():
    with pytest.raises(UnknownNameError, match=r"muscle\.gian.*muscle\.gain"):
        vibration.hopf(regulated(), "muscle.gian", (1e5, 1e7), LOW)
    with pytest.raises(InputError, match=r"needs 2 condition\(s\).*1 given: x"):
        vibration.stability_path(regulated(), "muscle.gain", [1e6], x=0.04)


def test_a_bracket_without_a_crossing_is_said_to_have_none():
    with pytest.raises(InputError, match=r"no complex pair.*1 bar/m \.\. 5 bar/m"):
        vibration.hopf(regulated(), "muscle.gain", (1e5, 5e5), LOW)


def test_a_path_says_where_it_ends():
    with pytest.raises(EquilibriumError, match=r"the path ends at mass = 200 kg"):
        vibration.stability_path(load(pam.losses.ConstantDamping(9.0)), "mass", [20, 200], FOUR_BAR)


@pytest.mark.parametrize(
    ("duration", "error", "words"),
    [
        (40, InputError, "the guess does not oscillate"),
        (3, VibrationError, "from this guess: it collapses to an equilibrium"),
    ],
)
def test_a_guess_that_has_come_to_rest_or_dies_out_gives_no_cycle(duration, error, words):
    t = np.linspace(0, duration, 2001)
    with pytest.raises(error, match=words):
        vibration.limit_cycle(beyond(0.5), pam.simulate(beyond(0.5), t=t, start={"x": 0.045}))


def test_a_regulator_needs_a_positive_lag():
    refused(r"lag = 0 s must be > 0", RegulatedLoad, pam.muscle("DMSP-20-400N"), lag=0.0)


def test_the_command_of_a_regulated_load_is_linear_within_its_range():
    plant = RegulatedLoad(pam.muscle("DMSP-20-400N"), gain=1e6, derivative_gain=2e5)
    u = {"muscle.set_pressure": 3 * BAR, "muscle.reference": 0.05}
    inputs = plant.vector("input", u)
    y = plant.function([0.06, 0.1, 2 * BAR], inputs, plant.vector("parameter"))[1]
    outputs = dict(zip([v.name for v in plant.outputs], flat(y), strict=True))
    assert outputs["muscle.command"] == pytest.approx(3 * BAR - 1e6 * 0.01 - 2e5 * 0.1, rel=1e-12)


def test_pictures_are_drawn_with_named_axes():
    cycle, _ = low_cycle()
    labels = [ax.get_ylabel() for ax in cycle.plot_phase().axes]
    assert labels == ["v [m/s]"]
    motion = vibration.free_vibration(
        load(pam.losses.StiffnessDamping(0.1)), FOUR_BAR, 0.01, cycles=4
    )
    for figure in (
        motion.plot_envelope(),
        motion.plot_phase(),
        cycle.plot_multipliers(),
        vibration.energy(motion.point.plant, motion.trajectory).plot(),
        vibration.backbone(motion.point.plant, motion.point, [0.01]).plot(),
        vibration.stability_path(regulated(), "muscle.gain", [1e6, 2e6], LOW).plot(),
        vibration.hopf_border(
            regulated(), "muscle.gain", (1e5, 1e7), "muscle.lag", [0.1], LOW
        ).plot(),
        vibration.CycleBranch("muscle.gain", (cycle,), "").plot(),
        vibration.CycleBranch("muscle.gain", (cycle,), "").plot_phase(),
    ):
        figure.draw_without_rendering()
        assert all(ax.get_xlabel() or ax.get_ylabel() for ax in figure.axes)


def test_a_joint_vibrates_in_its_angle() -> None:
    """What a plant's one position is, nobody has to say; of several without an x, somebody has."""
    muscle = pam.muscle("DMSP-20-400N")
    inertia, arm, centre = 0.05, 0.04, 0.125
    joint = pam.AntagonisticJoint(
        muscle, inertia, arm, pre_contraction=centre, damping=0.0, feed=pam.feeds.IdealPressure()
    )
    pressures = {"muscle1.pressure": 4 * BAR, "muscle2.pressure": 4 * BAR}
    swing = vibration.free_vibration(joint, pressures, 1e-3, cycles=4)
    stiffness = 2 * arm**2 * float(muscle.stiffness(4 * BAR, centre))
    assert swing.state == "theta"
    assert swing.frequency == pytest.approx(np.sqrt(stiffness / inertia) / (2 * np.pi), rel=1e-4)
    energy = vibration.energy(joint, swing.trajectory)
    assert np.ptp(energy.total) < 1e-7 * energy.kinetic.max()  # without damping it stays
    assert vibration.backbone(joint, pressures, [1e-3]).state == "theta"
    two = pam.Plant("two")
    for name in ("left", "right"):
        position, velocity = two.state(name, unit="m"), two.state(f"{name}_rate", unit="m/s")
        two.der(position, velocity)
        two.der(velocity, -100.0 * position)
    refused("left, right; name a state", vibration.free_vibration, two, {}, 0.01)

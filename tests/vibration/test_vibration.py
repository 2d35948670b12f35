"""Vibration: free, its energy, the Hopf border, limit cycles and their continuation."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from conftest import BAR, flat
from scipy.integrate import quad
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp import InputError, UnknownNameError, vibration
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
def low_cycle() -> vibration.LimitCycle:
    return vibration.limit_cycle(low_hopf().plant, low_hopf())


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


def test_frequency_falls_with_amplitude_once_the_muscle_goes_slack():
    plant = load(pam.losses.ConstantDamping(0.0))
    curve = vibration.backbone(plant, FOUR_BAR, [0.002, 0.015, 0.025, 0.030])
    assert curve.frequencies[1] > curve.frequencies[0]  # taut: slightly stiffening
    assert np.all(np.diff(curve.frequencies[1:]) < -0.05)
    assert curve.highs == pytest.approx(curve.offsets, rel=1e-8)


def test_without_oscillation_there_is_nothing_to_measure():
    with pytest.raises(VibrationError, match="does not oscillate about this point"):
        vibration.free_vibration(load(pam.losses.ConstantDamping(5e3)), FOUR_BAR, 0.01)


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


def test_energy_refuses_a_moving_pressure():
    cycle = low_cycle()
    with pytest.raises(InputError, match=r"muscle\.pressure moves between"):
        vibration.energy(cycle.plant, cycle.trajectory)


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


# ---- limit cycles ----------------------------------------------------------------------------


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


# ---- bad input -------------------------------------------------------------------------------


def test_unknown_names_are_answered_with_near_ones():
    with pytest.raises(UnknownNameError, match=r"muscle\.gian.*muscle\.gain"):
        vibration.hopf(regulated(), "muscle.gian", (1e5, 1e7), LOW)
    with pytest.raises(InputError, match=r"needs 2 condition\(s\).*1 given: x"):
        vibration.stability_path(regulated(), "muscle.gain", [1e6], x=0.04)


def test_a_bracket_without_a_crossing_is_said_to_have_none():
    with pytest.raises(InputError, match=r"no complex pair.*1 bar/m \.\. 5 bar/m"):
        vibration.hopf(regulated(), "muscle.gain", (1e5, 5e5), LOW)


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
    with pytest.raises(InputError, match=r"lag = 0 s must be > 0"):
        RegulatedLoad(pam.muscle("DMSP-20-400N"), lag=0.0)


def test_the_command_of_a_regulated_load_is_linear_within_its_range():
    plant = RegulatedLoad(pam.muscle("DMSP-20-400N"), gain=1e6, derivative_gain=2e5)
    u = {"muscle.set_pressure": 3 * BAR, "muscle.reference": 0.05}
    inputs = plant.vector("input", u)
    y = plant.function([0.06, 0.1, 2 * BAR], inputs, plant.vector("parameter"))[1]
    outputs = dict(zip([v.name for v in plant.outputs], flat(y), strict=True))
    assert outputs["muscle.command"] == pytest.approx(3 * BAR - 1e6 * 0.01 - 2e5 * 0.1, rel=1e-12)


def test_pictures_are_drawn_with_named_axes():
    cycle = low_cycle()
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

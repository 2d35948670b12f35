"""Vibration known in closed form: of the normal form of a Hopf point, and of an oscillator."""

from __future__ import annotations

import re

import casadi as ca
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp import InputError, vibration
from pam_ocp.numerics.periodic_collocation import Periodic
from pam_ocp.vibration.cycle import Settings, converged, pin
from pam_ocp.vibration.free import Smooth
from pam_ocp.vibration.hopf_bifurcation import _between
from pam_ocp.vibration.maps import _passages

W, K, NX, NY = 7.0, 0.2, 0.5, 0.8
"""Angular frequency [1/s], border, nominals."""


def normal_form(b: float = -1.0, c: float = 0.0, widest: float = 3.0) -> pam.Plant:
    """r' = (mu - k + b r^2 - c r^4) r, phi' = w."""
    plant = pam.Plant("normal_form")
    x = plant.state("x", nominal=NX, min=-3.0, max=widest)
    y = plant.state("y", nominal=NY, min=-3.0, max=3.0)
    mu, k, w = (
        plant.parameter(n, v, nominal=s, min=-2.0, max=9.0)
        for n, v, s in (("mu", 0.1, 0.3), ("k", K, 1.0), ("w", W, 5.0))
    )
    square = x**2 + y**2
    growth = mu - k + b * square - c * square**2
    plant.der(x, growth * x - w * y)
    plant.der(y, growth * y + w * x)
    z = plant.state("z")  # beside them
    plant.der(z, -5 * z)
    return plant


def at_border(**form: float) -> vibration.HopfPoint:
    return vibration.hopf(normal_form(**form), "mu", (-0.5, 0.8))


def size(b: float) -> float:
    """l1 by growth r = -w l1 r^2 on the cycle, whose scaled mode (1/NX, -i/NY) has length one."""
    return 4 * b / (W * (1 / NX**2 + 1 / NY**2))


@pytest.mark.parametrize("b", [-1.0, 1.0, -0.3])
def test_the_border_its_frequency_and_what_is_born_there(b):
    point = at_border(b=b)
    assert (point.value, point.frequency) == pytest.approx((K, W / (2 * np.pi)), rel=1e-10)
    assert (point.crossing, point.lyapunov) == pytest.approx((1.0, size(b)), rel=1e-9)
    assert point.supercritical == (b < 0)
    assert np.abs(point.mode) == pytest.approx(
        [NX, NX, 0]
    )  # a circle; the largest scaled entry is 1
    assert ("unstable above, supercritical" in str(point)) == (b < 0)


@pytest.mark.parametrize(
    ("low", "high", "middle"),
    [
        (1.0, 29.0, 15.0),
        (1.0, 100.0, 10.0),
        (100.0, 1.0, 10.0),
        (-1.0, 100.0, 49.5),
        (9.0, 1.0, 5.0),
    ],
)
def test_a_bracket_over_decades_is_searched_in_equal_ratios(low, high, middle):
    assert _between(low, high, 3) == pytest.approx([low, middle, high])


@pytest.mark.parametrize("named", ["x", "y"])
def test_a_cycle_is_a_circle_and_its_multiplier_that_of_its_radius(named):
    point = at_border()
    cycle = vibration.limit_cycle(point.plant, point, amplitude={named: 0.3})
    assert cycle.plant.variable("mu").start == pytest.approx(K + 0.09, rel=1e-6)
    assert [cycle.amplitude(n) for n in "xy"] == pytest.approx([0.3, 0.3], rel=1e-6)
    assert (cycle.period, cycle.frequency) == pytest.approx((2 * np.pi / W, W / (2 * np.pi)))
    assert cycle.multipliers == pytest.approx(
        [1, np.exp(-2 * 0.09 * cycle.period), np.exp(-5 * cycle.period)], rel=1e-6
    )
    assert cycle.stable
    assert cycle.outside == ()
    assert cycle.closing_error < 1e-8
    assert cycle.plot().axes[-1].lines[0].get_xdata()[-1] == pytest.approx(cycle.period)
    from_run = pam.simulate(cycle.plant, t=np.linspace(0, 60, 3000), start={"x": 0.1})
    assert vibration.limit_cycle(cycle.plant, from_run).amplitude("x") == pytest.approx(0.3)


def test_a_cycle_on_the_finest_mesh_is_taken_where_its_states_are_known_well_enough():
    """Its multiplier is never exactly 1; beyond the largest mesh the states alone decide."""
    cycle = vibration.limit_cycle(at_border().plant, at_border(), amplitude={"x": 0.3})
    periodic = Periodic(cycle.plant, "mu", 6)
    finest = {"most_intervals": 5, "multiplier_tolerance": 0.0}
    row = pin(cycle.orbit, periodic.lam)
    taken = converged(periodic, cycle.orbit, row, Settings(tolerance=1e-8, **finest))
    assert taken.period == pytest.approx(2 * np.pi / W)
    with pytest.raises(vibration.VibrationError, match="stays above the tolerance"):
        converged(periodic, cycle.orbit, row, Settings(tolerance=1e-30, **finest))


def test_what_is_no_closed_motion_has_the_frequency_of_its_passages():
    t = np.linspace(0.0, 4.0, 4001)
    for hertz, expected in ((3.0, 3.0), (0.4, np.nan)):
        found = _passages(t, 5 + np.sin(2 * np.pi * hertz * t) + 0.1 * np.cos(17 * hertz * t))
        assert found == pytest.approx(expected, rel=0.02, nan_ok=True)


def test_by_default_a_cycle_swings_by_a_third_of_a_nominal():
    point = at_border(widest=0.1)
    cycle = vibration.limit_cycle(point.plant, point)
    assert cycle.amplitude("x") == pytest.approx(0.3 * NX, rel=1e-6)
    assert cycle.outside == ("x",)
    for words, amplitude in (("name one state", {"x": 1, "y": 1}), ("name a state", {"mu": 1.0})):
        refused(words, vibration.limit_cycle, point.plant, point, amplitude=amplitude)


def test_a_branch_of_stable_cycles_grows_as_the_root():
    point = at_border()
    small = vibration.limit_cycle(point.plant, point, amplitude={"x": 0.2})
    branch = vibration.continue_cycle(small, "mu", (K + 0.01, K + 0.49))
    assert branch.values[-1] == K + 0.49
    assert branch.amplitudes("x") == pytest.approx(np.sqrt(branch.values - K), rel=1e-5)
    assert branch.periods == pytest.approx(np.full(len(branch.cycles), 2 * np.pi / W))
    assert branch.stable.all()
    assert branch.folds == ()
    (there,) = branch.at(K + 0.25)
    assert there.amplitude("y") == pytest.approx(0.5, rel=1e-6)
    refused("the branch covers", branch.at, K + 0.6)
    for direction, end in (("smaller", K + 0.01), ("down", K + 0.01), ("up", K + 0.49)):
        other = vibration.continue_cycle(
            small, "mu", (K + 0.01, K + 0.49), direction=direction, step=0.1
        )
        assert other.values[-1] == end
        assert np.all(np.diff(other.amplitudes("x")) * (end - K - 0.04) > 0)
    gone = vibration.continue_cycle(small, "mu", (K - 0.5, K + 0.49), direction="smaller", step=0.1)
    assert "shrinks to an equilibrium (Hopf point) near mu" in gone.ended
    assert len(vibration.continue_cycle(small, "mu", (0.0, 2.0), step=0.05, most=3).cycles) == 3


def test_a_branch_says_that_the_cycle_at_its_end_is_not_found(monkeypatch):
    def lost(*given):
        raise vibration.VibrationError("lost")

    monkeypatch.setattr("pam_ocp.vibration.cycle_branch._reached", lost)
    branch = continued("mu", (0.0, K + 0.1))
    assert re.fullmatch(r"mu reaches 0\.3\S*, where the cycle is not found: lost", branch.ended)
    assert branch.values.max() < K + 0.1


def test_a_branch_goes_round_its_fold():
    """mu - k = r^4 - r^2: a fold at r^2 = 1/2, mu - k = -1/4; unstable within, stable without."""
    point = at_border(b=1.0, c=1.0)
    small = vibration.limit_cycle(point.plant, point, amplitude={"x": 0.3})
    assert not small.stable
    branch = vibration.continue_cycle(small, "mu", (K - 0.3, K + 0.2))
    square = branch.amplitudes("x") ** 2
    assert branch.values - K == pytest.approx(square**2 - square, abs=1e-5)
    assert branch.values[-1] == K + 0.2
    (fold,) = branch.folds
    assert branch.values[fold] == pytest.approx(K - 0.25, abs=0.02)
    assert fold == np.argmin(branch.values)
    assert branch.stable.tolist() == (square > 0.5).tolist()
    two = branch.at(K - 0.2)
    expected = np.sqrt((1 + np.array([-1, 1]) * np.sqrt(0.2)) / 2)
    assert [c.amplitude("x") for c in two] == pytest.approx(expected, rel=1e-5)
    assert [c.stable for c in two] == [False, True]


def test_borders_over_other_parameters_follow_them():
    values = [0.1, 0.3, 1.5]
    border = vibration.hopf_border(normal_form(), "mu", (-0.5, 0.8), "k", values)
    assert border.border[:2] == pytest.approx(values[:2], rel=1e-9)
    assert np.isnan(border.border[2])
    assert np.isnan(border.frequencies[2])
    assert list(border.reasons) == [1.5]
    assert border.supercritical.tolist() == [True, True, False]
    found = vibration.hopf_map(
        normal_form(), "mu", (-0.5, 0.8), {"k": [0.1, 1.5], "w": [4.0, 7.0, 9.0]}
    )
    assert found.border[0] == pytest.approx([0.1] * 3, rel=1e-9)
    assert found.frequencies[0] == pytest.approx(np.array([4.0, 7.0, 9.0]) / (2 * np.pi))
    assert found.lyapunov[0] == pytest.approx(size(-1.0) * W / np.array([4.0, 7.0, 9.0]))
    assert np.isnan(found.border[1]).all()
    assert set(found.reasons) == {(1.5, 4.0), (1.5, 7.0), (1.5, 9.0)}
    assert str(found).endswith("3 without a border")
    with pytest.raises(InputError, match="name another"):
        vibration.hopf_map(normal_form(), "mu", (-0.5, 0.8), {"mu": [0.1], "w": [4.0]})


@pytest.mark.parametrize("push", [None, {"y": 0.05}])
def test_how_large_a_vibration_becomes_over_two_values(push):
    found = vibration.amplitude_map(
        normal_form(widest=0.6), {"mu": [0.0, K + 0.25, K + 0.49], "w": [4.0, 9.0]}, push=push
    )
    assert found.amplitude == pytest.approx(np.outer([0.0, 0.5, 0.7], [1, 1]), rel=1e-5)
    assert found.frequency[1:] == pytest.approx(np.outer([1, 1], [4, 9]) / (2 * np.pi), rel=1e-6)
    assert np.isnan(found.frequency[0]).all()
    assert found.growth == pytest.approx(np.outer([-K, 0.25, 0.49], [1, 1]))
    assert found.closed.all()
    assert found.outside.tolist() == [[False] * 2, [False] * 2, [True] * 2]
    assert "4 of 6 points vibrate, x by up to +-0.7" in str(found)


def test_a_push_decides_where_a_vibration_stands_beside_a_stable_rest():
    """r^2 = (1 + sqrt(1/5))/2 at mu - k = -1/5, beyond an unstable cycle of r = 0.53."""
    plant, axes = normal_form(b=1.0, c=1.0, widest=0.4), {"mu": [K - 0.2], "w": [W]}
    for x in (0.7, -0.4, -0.7):  # upwards it ends at 0.4
        found = vibration.amplitude_map(plant, axes, push={"x": x})
        size = np.sqrt((1 + np.sqrt(0.2)) / 2) if x == -0.7 else 0.0
        assert found.amplitude[0, 0] == pytest.approx(size, rel=1e-5)
    assert "at 1 of them rest is stable, too" in str(found)


# ---- an oscillator -------------------------------------------------------------------------------
OMEGA, RATIO, REST = 12.0, 0.06, 0.3


def oscillator(ratio: float = RATIO, dry: float = 0.0) -> pam.Plant:
    plant = pam.Plant("oscillator")
    q = plant.state("q", start=REST, min=-9.0, max=9.0, nominal=0.4)
    v, u = plant.state("v", nominal=2.0), plant.input("u", min=-9.0, max=9.0)
    plant.parameter("inertia", 2.5)
    plant.der(q, v)
    plant.der(v, OMEGA**2 * (u - q) - 2 * ratio * OMEGA * v - dry * ca.tanh(v / 1e-4))
    return plant


def test_dry_friction_takes_as_much_from_each_swing():
    """4 F/k a cycle, at the frequency without it; about rest itself no pole oscillates."""
    dry = 0.02 * OMEGA**2
    motion = vibration.free_vibration(oscillator(0.0, dry), {"u": REST}, 0.5, state="q", cycles=5)
    assert -np.diff(motion.amplitudes) == pytest.approx(np.full(3, 0.08), rel=1e-3)
    assert motion.frequency == pytest.approx(OMEGA / (2 * np.pi), rel=5e-3)


@pytest.mark.parametrize("offset", [0.5, -0.5])
def test_a_free_vibration_is_that_of_the_linear_oscillator(offset):
    motion = vibration.free_vibration(oscillator(), {"u": REST}, offset, state="q", cycles=6)
    damped = OMEGA * np.sqrt(1 - RATIO**2)
    decrement = 2 * np.pi * RATIO / np.sqrt(1 - RATIO**2)
    late = np.arctan(np.sqrt(1 - RATIO**2) / RATIO)  # from a passage to the top
    first = 2 * np.pi - late if offset > 0 else np.pi - late
    expected = (first + 2 * np.pi * np.arange(len(motion.crossings))) / damped
    assert motion.crossings == pytest.approx(expected, rel=1e-9)
    assert len(motion.frequencies) == 5
    drawn = motion.plot().axes[0].lines[0]  # over time, about rest
    assert drawn.get_ydata()[0] == pytest.approx(offset)
    assert drawn.get_xdata() == pytest.approx(motion.trajectory.t)
    assert motion.frequency == pytest.approx(damped / (2 * np.pi))
    turns = np.arange(1, 3) + (offset > 0)
    tops = abs(offset) * np.exp(-decrement / 2 * turns)
    assert (motion.highs[0], motion.lows[0]) == pytest.approx((tops[0], -tops[1]), rel=1e-8)
    assert motion.amplitudes[0] == pytest.approx((tops[0] + tops[1]) / 2, rel=1e-8)
    assert motion.log_decrement == pytest.approx(decrement, rel=1e-8)
    assert motion.damping_ratio == pytest.approx(RATIO, rel=1e-8)
    for cycles, expected in ((2, np.nan), (3, decrement)):  # the first passage is a cycle's begin
        short = vibration.free_vibration(
            oscillator(), {"u": REST}, offset, state="q", cycles=cycles
        )
        assert short.log_decrement == pytest.approx(expected, nan_ok=True)
    assert motion.rest == pytest.approx(REST)
    times, deviations = motion.peaks
    assert np.diff(times) * damped == pytest.approx(np.full(len(times) - 1, np.pi), rel=1e-8)
    assert deviations[1:] / deviations[:-1] == pytest.approx(-np.exp(-decrement / 2), rel=1e-8)


def test_a_passage_at_a_sample_counts_once():
    line = Smooth(np.arange(3.0), np.array([[-1.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]))
    assert [e.tolist() for e in line.zeros()] == [[1.0], [0.0], [1.0]]


def test_the_energy_of_the_linear_oscillator():
    plant = oscillator()
    motion = vibration.free_vibration(plant, {"u": REST}, 0.5, state="q", cycles=3).trajectory
    for mass, m in (("inertia", 2.5), (4.0, 4.0)):
        found = vibration.energy(plant, motion, position="q", mass=mass)
        q, v = motion["q"] - REST, motion["v"]
        assert found.kinetic == pytest.approx(m * v**2 / 2)
        assert found.potential == pytest.approx(m * OMEGA**2 * (q**2 - 0.25) / 2, abs=1e-9)
        assert found.rate == pytest.approx(-2 * m * RATIO * OMEGA * v**2, abs=1e-9)
        assert found.total == pytest.approx(found.kinetic + found.potential)
    for words, given in (
        ("has no velocity", {"position": "v"}),
        ("a parameter", {"mass": "u"}),
        ("no muscle is taut", {}),
    ):
        refused(words, vibration.energy, plant, motion, **{"position": "q"} | given)


def test_the_backbone_of_the_linear_oscillator_is_upright():
    found = vibration.backbone(oscillator(0.0), {"u": REST}, [0.1, 0.5], state="q")
    assert found.frequencies == pytest.approx([OMEGA / (2 * np.pi)] * 2, rel=1e-9)
    assert found.amplitudes == pytest.approx([0.1, 0.5], rel=1e-9)
    assert -found.lows == pytest.approx([0.1, 0.5], rel=1e-9)


# ---- what cannot be meant ------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("words", "asked"),
    [
        ("plant is an int", lambda: vibration.limit_cycle(3, at_border())),
        ("guess is an int", lambda: vibration.limit_cycle(normal_form(), 3)),
        ("degree = 1:", lambda: vibration.limit_cycle(normal_form(), at_border(), degree=1)),
        ("degree = 10:", lambda: vibration.limit_cycle(normal_form(), at_border(), degree=10)),
        ("tolerance = 0 ", lambda: vibration.limit_cycle(normal_form(), at_border(), tolerance=0)),
        ("belongs to 'normal", lambda: vibration.limit_cycle(oscillator(), at_border())),
        ("goes with a HopfPoint", lambda: vibration.limit_cycle(normal_form(), RUN, amplitude={})),
        ("moves; a limit cycle has constant", lambda: vibration.limit_cycle(oscillator(), RUN)),
        ("choose 'larger', 'smaller'", lambda: continued("mu", (0.0, 2.0), direction="left")),
        ("must hold the cycle's own", lambda: continued("mu", (1.0, 2.0))),
        ("must hold the cycle's own", lambda: continued("mu", (-1.0, 0.0))),
        ("x is a state", lambda: continued("x", (-1.0, 2.0))),
        ("step = 0 ", lambda: continued("mu", (0.0, 2.0), step=0.0)),
        ("tolerance = 0 ", lambda: continued("mu", (0.0, 2.0), tolerance=0.0)),
        ("is the first parameter", lambda: vibration.hopf_border(*OVER, "mu", [0.1])),
        ("no border for any value of k", lambda: vibration.hopf_border(*OVER, "k", [1.5])),
        ("no border anywhere", lambda: vibration.hopf_map(*OVER, {"k": [1.5], "w": [4.0]})),
        ("plant is an int", lambda: vibration.amplitude_map(3, {"k": [1.5], "w": [4.0]})),
        ("name a state", lambda: mapped(state="mu")),
        ("give two", lambda: mapped({"k": [1.5]})),
        ("give two", lambda: mapped({"k": [1.5], "w": [4.0], "mu": [0.0]})),
        ("give two", lambda: mapped({"k": [1.5], "w": []})),
        ("among the conditions", lambda: mapped(k=1.0)),
        ("periods = 5:", lambda: mapped(periods=5)),
        ("give a state", lambda: freed(0.1, state="u")),
        ("offset = 0", lambda: freed(0.0, state="q")),
        ("cycles = 0 ", lambda: freed(0.1, state="q", cycles=0)),
        ("at least one", lambda: vibration.backbone(oscillator(), {"u": 0.0}, [], state="q")),
    ],
)
def test_what_cannot_be_meant_is_refused(words, asked):
    refused(words, asked)


OVER = normal_form(), "mu", (-0.5, 0.8)
RUN = pam.simulate(oscillator(), {"u": ([0.0, 8.0, 9.0], [0.0, 1.0, 1.0])}, t=np.linspace(0, 9, 99))


def continued(name, within, **words):
    cycle = vibration.limit_cycle(normal_form(), at_border(), amplitude={"x": 0.3})
    return vibration.continue_cycle(cycle, name, within, **words)


def mapped(axes=None, **words):
    return vibration.amplitude_map(normal_form(), axes or {"k": [1.5], "w": [4.0]}, **words)


def freed(offset, **words):
    return vibration.free_vibration(oscillator(), {"u": 0.0}, offset, **words)

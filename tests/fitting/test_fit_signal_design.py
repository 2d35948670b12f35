"""Designs of a record's inputs: against theory, finite differences, and fits of what was played."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import BAR, benchmark_slide, noisy_record, refused
from test_fit_process_noise import oscillator

import pam_ocp as pam
from pam_ocp.core.errors import FitError, InputError, UnknownNameError
from pam_ocp.fitting import fit_plant
from pam_ocp.fitting.experiments.signals import SignalDesign, design_experiment, design_signal

FREE = ("damping", "muscle*.lag", "muscle*.a2", "muscle*.a5")
NOISE = {"x": 2e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
RANGE = {f"muscle{i}.command": (2.2 * BAR, 4.5 * BAR) for i in (1, 2)}
START = {"muscle1.pressure": 3 * BAR, "muscle2.pressure": 3 * BAR}


def integrator() -> pam.Plant:
    """x' = rate u, measured directly."""
    plant = pam.Plant("integrator")
    x = plant.state("x", max=10.0)
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, plant.parameter("rate", 2.0) * u)
    return plant


def told(plant: pam.Plant, free: Any, size: float, **asked: Any) -> SignalDesign:
    """A design of two seconds at 20 Hz for the position, whose noise is known."""
    given: dict[str, Any] = {"duration": 2.0, "sample": 0.05, "noise": {"x": size}, **asked}
    return design_signal(plant, free, **given)


@pytest.fixture(scope="module")
def rig() -> pam.Plant:
    return benchmark_slide(pam.feeds.Regulator(0.05, max_pressure=6 * BAR))


@pytest.fixture(scope="module")
def design(rig: pam.Plant) -> SignalDesign:
    asked = {"duration": 1.5, "noise": NOISE, "inputs": RANGE, "segments": 6, "start": START}
    return design_signal(rig, FREE, **asked, tries=2)


def played(plant: pam.Plant, run: pam.Trajectory, noise: dict[str, float], seed: int) -> Any:
    """A record of a signal, with noise."""
    told = {n: run[n] for n in run.named("input")}
    return noisy_record(plant, run, told, noise, np.random.default_rng(seed), run.interpolation)


def test_the_rate_of_an_integrator_is_best_seen_at_full_input() -> None:
    """Information on the rate is sum (integral u)^2/sigma^2: most for u = 1 (or -1) throughout."""
    plant, t = integrator(), np.arange(0, 2.001, 0.05)
    for family in ("steps", "ramps"):
        found = told(plant, ["rate"], 0.1, segments=5, family=family, known_start=True)
        assert np.abs(found.trajectory["u"]) == pytest.approx(np.ones(t.size), abs=1e-5)
        assert found.stderr["rate"] == pytest.approx(0.1 / np.linalg.norm(t), rel=1e-6)


def test_an_unknown_start_costs_what_least_squares_say() -> None:
    """With x(0) unknown the line through t must be told from a constant: no start at t = 0."""
    found = told(integrator(), ["rate"], 0.1, segments=5)
    u = found.trajectory["u"][:-1]
    way = np.concatenate([[0.0], 0.05 * np.cumsum(u)])
    rest = way - way.mean()
    assert found.stderr["rate"] == pytest.approx(0.1 / np.linalg.norm(rest), rel=1e-4)
    assert np.abs(u) == pytest.approx(np.ones(u.size), abs=1e-4)  # a convex function: at corners


def test_limits_are_kept(rig: pam.Plant) -> None:
    limits = {"x": (-0.004, 0.006), "muscle1.pressure": (2.5 * BAR, 4 * BAR)}
    asked = {"duration": 1.0, "noise": NOISE, "inputs": RANGE, "segments": 5, "start": START}
    found = design_signal(rig, FREE, **asked, limits=limits, tries=1, family="ramps")
    assert found.violation < 1e-5
    run = found.trajectory
    for name, (low, high) in limits.items():
        edge = 5e-3 * (high - low)  # between the design's RK4 and this accurate simulation
        assert low - edge <= run[name].min() <= run[name].max() <= high + edge
    assert run["x"].max() == pytest.approx(0.006, abs=3e-4)  # a limit that matters is used
    assert found.gain > 1.0


def test_information_is_that_of_finite_differences_of_simulations(
    rig: pam.Plant, design: SignalDesign
) -> None:
    run, columns = design.trajectory, []
    members = {n: [n.replace("*", i) for i in "12"] if "*" in n else [n] for n in FREE}
    states = [v.name for v in rig.states]
    start = {n: float(run[n][0]) for n in states}

    def measured(plant: pam.Plant, begin: dict[str, float]) -> np.ndarray:
        again = pam.simulate(plant, run, start=begin, rtol=1e-10)
        return np.concatenate([again[n] / s for n, s in NOISE.items()])

    for names in members.values():
        value = float(rig.variable(names[0]).start or 0.0)
        size = 1e-4 * value
        pair = [rig.with_values(dict.fromkeys(names, value + s)) for s in (size, -size)]
        columns.append((measured(pair[0], start) - measured(pair[1], start)) / (2 * size))
    for name in states:
        size = 1e-4 * rig.variable(name).nominal
        ends = [measured(rig, start | {name: start[name] + s}) for s in (size, -size)]
        columns.append((ends[0] - ends[1]) / (2 * size))
    jacobian = np.stack(columns, axis=1)
    scale = np.linalg.norm(jacobian, axis=0)
    covariance = np.linalg.inv((jacobian / scale).T @ (jacobian / scale)) / np.outer(scale, scale)
    expected = np.sqrt(np.diag(covariance))[: len(FREE)]
    # the design integrates to 0.2 % of each variable's spread
    assert list(design.stderr.values()) == pytest.approx(expected, rel=0.03)


@pytest.mark.slow
def test_a_designed_record_beats_random_ones_when_it_is_fitted(
    rig: pam.Plant, design: SignalDesign
) -> None:
    best = fit_plant(rig, played(rig, design.trajectory, NOISE, 1), FREE, noise=NOISE)
    for name, promised in design.stderr.items():
        # the fit's scale is that of its residuals: known to 3 % here
        assert best.coefficients[name].stderr == pytest.approx(promised, rel=0.12)
    random = np.random.default_rng(8)
    t = design.trajectory.t
    for seed in range(3):
        levels = random.uniform(2.2 * BAR, 4.5 * BAR, (2, 7))
        place = np.minimum((t / 0.25 + 1e-9).astype(int), 6)
        inputs = {f"muscle{i + 1}.command": (t, levels[i][place]) for i in (0, 1)}
        run = pam.simulate(rig, inputs, t=t, start=START, interpolation="previous")
        other = fit_plant(rig, played(rig, run, NOISE, seed), FREE, noise=NOISE)
        assert np.linalg.det(correlation_free(best)) < np.linalg.det(correlation_free(other)) / 4


def correlation_free(fit: pam.fitting.PlantFit) -> np.ndarray:
    """Covariance relative to the values."""
    values = np.array([c.value for c in fit.coefficients.values()])
    return np.asarray(fit.covariance / np.outer(values, values))


@pytest.mark.slow
def test_promised_standard_errors_are_the_scatter_of_fits() -> None:
    plant, noise = oscillator(), {"x": 5e-4}
    found = told(plant, ["spring", "damper"], noise["x"], segments=10, criterion="A")
    values = []
    for seed in range(60):
        record = played(plant, found.trajectory, noise, seed)
        values.append(list(fit_plant(plant, record, ["spring", "damper"]).values.values()))
    scatter = np.std(values, axis=0, ddof=1)
    assert scatter == pytest.approx(list(found.stderr.values()), rel=0.25)  # 60 know it to 9 %


def test_a_fit_counts_as_what_is_known() -> None:
    plant, noise = oscillator(), {"x": 5e-4}
    first = told(plant, ["spring", "damper"], noise["x"], segments=4)
    fit = fit_plant(plant, played(plant, first.trajectory, noise, 0), ["spring", "damper"])
    more = design_experiment(fit, duration=2.0, sample=0.05, segments=4)
    for name in fit.values:
        assert more.stderr_before[name] == pytest.approx(fit.coefficients[name].stderr)
        # as good a record again: at least as sharp as sqrt(2)
        assert more.stderr[name] < 1.02 * fit.coefficients[name].stderr / np.sqrt(2)
    runs = (first.trajectory, more.trajectory)
    both = [played(plant, run, noise, i) for i, run in enumerate(runs)]
    again = fit_plant(plant, both, ["spring", "damper"])
    for name, promised in more.stderr.items():
        assert again.coefficients[name].stderr == pytest.approx(promised, rel=0.15)


def test_a_multisine_stays_within_its_range() -> None:
    asked = {"duration": 4.0, "family": "multisine", "segments": 9, "known_start": True}
    found = told(oscillator(), ["spring"], 1e-3, **asked)
    force = found.trajectory["force"]
    assert 0.99 < np.max(np.abs(force)) <= 1 + 1e-6
    tones = np.abs(np.fft.rfft(force[:-1]))
    assert np.max(tones[5:]) < 1e-6 * np.max(tones)  # four harmonics and a constant
    assert found.gain > 1.0


def test_the_report_holds_every_parameter(design: SignalDesign) -> None:
    text = design.report()
    assert "steps of muscle1.command, muscle2.command over 1.5 s, 151 samples" in text
    for name in FREE:
        assert f"\n{name} [" in text
    low, high = design.interval("damping", 0.9545)
    assert high - low == pytest.approx(4 * design.stderr["damping"], rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"noise": None}, "noise is missing"),
        ({"noise": {}}, "noise is empty"),
        ({"noise": {"u": 1.0}}, "neither a state nor an output"),
        ({"free": None}, "free is missing"),
        ({"free": "rate"}, "give a list of parameters"),
        ({"free": ["u"]}, "u is an input"),
        ({"parameters": ["x"]}, "unknown free parameter in parameters 'x'"),
        ({"criterion": "E"}, "choose 'D' or 'A'"),
        ({"family": "noise"}, "choose one of steps, ramps, multisine"),
        ({"segments": 0}, "segments = 0"),
        ({"duration": -1.0}, "duration = -1 s must be > 0"),
        ({"inputs": {"u": (2.0, 3.0)}}, "give a finite range within its bounds"),
        ({"inputs": {"x": (0.0, 1.0)}}, "x is a state, not an input"),
        ({"inputs": []}, "inputs is empty"),
        ({"limits": {"x": (1.0, 0.0)}}, "the first the smaller"),
    ],
)
def test_bad_arguments_are_refused_in_words(arguments: dict[str, Any], words: str) -> None:
    usual: dict[str, Any] = {"free": ["rate"], "duration": 1.0, "noise": {"x": 0.1}}
    with pytest.raises((InputError, UnknownNameError), match=words):
        design_signal(integrator(), **(usual | arguments))


def test_parameters_that_no_signal_tells_and_plants_too_stiff_for_the_samples_are_refused() -> None:
    plant = pam.Plant("twins")
    x, u = plant.state("x"), plant.input("u", min=-1.0, max=1.0)
    plant.der(x, (plant.parameter("a", 1.0) + plant.parameter("b", 1.0)) * u)
    asked = {"error": FitError, "duration": 1.0, "noise": {"x": 0.1}, "segments": 4}
    words = "no signal of this family tells a, b together"
    refused(words, design_signal, plant, ["a", "b"], **asked)
    stiff = pam.Plant("stiff")
    x, u = stiff.state("x"), stiff.input("u", min=-1.0, max=1.0)
    stiff.der(x, stiff.parameter("rate", 1e5) * (u - x))
    words = "too stiff for these samples; give a shorter sample"
    refused(words, design_signal, stiff, ["rate"], **asked, sample=0.05)

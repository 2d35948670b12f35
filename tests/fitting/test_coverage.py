"""A fit says where its records have not been, and a signal is designed that goes there."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.core.errors import SimulationError
from pam_ocp.fitting import coverage, fit_free_run, fit_plant
from pam_ocp.fitting.experiments import design_signal

T = 0.02 * np.arange(301)


def spring() -> pam.Plant:
    """q'' = 50 u - k q - cubic q^3 - c q': at small angles nothing tells the cubic part."""
    plant = pam.Plant("spring")
    q, w = plant.state("q"), plant.state("w")
    u = plant.input("u", min=-3, max=3)
    k, c = plant.parameter("k", 60.0, nominal=60.0), plant.parameter("c", 6.0, nominal=6.0)
    cubic = plant.parameter("cubic", 40.0, nominal=40.0)
    plant.der(q, w)
    plant.der(w, 50 * u - k * q - cubic * q**3 - c * w)
    return plant


def played(size: float, frequency: float, noise: float = 1e-3) -> pam.Trajectory:
    u = size * np.sin(2 * np.pi * frequency * T)
    run = pam.simulate(spring(), {"u": (T, u)}, t=T, interpolation="linear")
    q = run["q"] + noise * np.random.default_rng(0).standard_normal(T.size)
    return pam.Trajectory(T, {"q": q, "u": u}, interpolation="linear")


@pytest.fixture(scope="module")
def fit() -> pam.fitting.PlantFit:
    return fit_plant(spring(), played(0.4, 0.5), ["k", "c", "cubic"])


def test_what_was_measured_is_covered(fit: pam.fitting.PlantFit) -> None:
    found = coverage(fit, played(0.4, 0.5), uncertainty=False)
    assert found.covered
    assert found.doubts == ()
    assert "covered" in found.report()


def test_a_larger_swing_leaves_the_ranges_and_its_doubts_say_so(fit: pam.fitting.PlantFit) -> None:
    found = fit.coverage({"u": lambda t: 1.6 * np.sin(np.pi * t)}, duration=6.0)
    assert {r.name for r in found.left} == {"q", "w", "u"}
    assert found.far > 0.5
    reach = next(r for r in found.reaches if r.name == "u")
    np.testing.assert_allclose(reach.asked, (-1.6, 1.6), rtol=1e-3)
    np.testing.assert_allclose(reach.seen, (-0.4, 0.4), rtol=1e-3)
    here, there = found.uncertainty["q"]
    assert here > 2 * there  # the cubic part, which the small swings hardly tell
    assert any("parameters' uncertainty" in d for d in found.doubts)


def test_amplitudes_are_counted_by_octaves(fit: pam.fitting.PlantFit) -> None:
    """As loud as measured, but quicker: only the octave of 3 Hz is new."""
    found = coverage(fit, played(0.4, 3.0), uncertainty=False)
    (band,) = found.new_bands
    assert band.low < 3.0 < band.high
    assert band.asked == pytest.approx(0.4, rel=0.05)
    assert band.seen < 0.01


def test_frequencies_beyond_all_that_was_measured_are_absurd(fit: pam.fitting.PlantFit) -> None:
    """The records end in the octave of 0.5 Hz, below 0.89 Hz; their windows leak into all."""
    verdicts = [coverage(fit, played(0.4, f), uncertainty=False).verdict for f in (0.5, 1.5, 8.0)]
    assert verdicts == ["covered", "extrapolation", "absurd"]


def test_a_motion_that_the_plant_does_not_come_through_is_absurd(
    fit: pam.fitting.PlantFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = pam.Trajectory(T, {"u": played(0.4, 0.5)["u"]}, interpolation="linear")
    assert coverage(fit, alone, uncertainty=False).verdict == "covered"

    def explodes(*_: object, **options: object) -> pam.Trajectory:
        raise SimulationError("too far")

    monkeypatch.setattr("pam_ocp.fitting.dynamic.experiment.simulate", explodes)
    assert coverage(fit, alone, uncertainty=False).verdict == "absurd"


def test_what_does_not_hold_a_motion_is_refused(fit: pam.fitting.PlantFit) -> None:
    record = played(0.4, 0.5)
    gap = np.where(T[7] == T, np.nan, record["q"])
    refused("other: no column for the input u", coverage, fit, pam.Trajectory(T, {"q": gap}))
    hole = pam.Trajectory(T, {"q": gap, "u": record["u"]})
    refused("other: q is not finite", coverage, fit, hole)


def test_a_value_at_its_bound_leaves_the_uncertainty_of_the_others() -> None:
    records = [played(0.4, f) for f in (0.5, 0.9)]
    plant, bounds = spring().with_values(c=8.0), {"c": (7.0, 9.0)}
    found = fit_free_run(plant, records, ["k", "c"], horizon=None, bounds=bounds, judge=False)
    assert found.at_bound == ("c",)
    assert set(coverage(found, records[0]).uncertainty) == {"q"}


def test_the_designed_signal_closes_the_gap(fit: pam.fitting.PlantFit) -> None:
    gap = coverage(fit, [played(1.5, 0.5), played(0.8, 2.0)], uncertainty=False)
    signal = design_signal(gap, duration=12.0, sample=0.02, tries=2, seed=1)
    assert signal.before.far > 0.3
    assert signal.after.far < 0.5 * signal.before.far
    assert len(signal.after.new_bands) < len(signal.before.new_bands)
    assert np.abs(signal.trajectory["u"]).max() <= 1.5 * 1.001
    narrow = {"inputs": {"u": (-0.5, 0.7)}, "limits": {"q": (-0.3, 0.3)}}
    held = design_signal(gap, duration=6.0, sample=0.02, tries=1, **narrow)
    assert held.trajectory["u"].min() >= -0.5
    assert held.trajectory["u"].max() <= 0.7
    assert 0.25 < np.abs(held.trajectory["q"]).max() <= 0.3 * 1.002  # the whole signal left them
    assert "far from all records" in str(held)


def test_fits_of_free_runs_cover_as_well() -> None:
    fit = fit_free_run(spring(), played(0.4, 0.5), ["k", "c"], horizon=0.2, every=0.2)
    assert not fit.coverage(played(1.6, 0.5)).covered
    refused("duration", fit.coverage, {"u": 1.0})


# ---- limits of a fit -------------------------------------------------------------------------
def rubbing(width: float) -> pam.Plant:
    plant = pam.Plant("rubbing")
    q, w = plant.state("q"), plant.state("w")
    u = plant.input("u")
    f = plant.parameter("friction", 2.0, nominal=1.0, min=0.0)
    k = plant.parameter("k", 40.0, nominal=40.0)
    v = plant.parameter("width", width, nominal=0.01, min=1e-4)
    plant.der(q, w)
    plant.der(w, 30 * u - k * q - 3 * w - f * ca.tanh(w / v))
    return plant


def test_friction_is_found_through_wide_roundings_and_limits_keep_the_best() -> None:
    t = 0.01 * np.arange(81)
    u = np.interp(t, np.linspace(0, 0.8, 5), [0, 0.4, -0.3, 0.5, 0])
    run = pam.simulate(rubbing(0.01), {"u": (t, u)}, t=t, interpolation="linear", rtol=1e-8)
    noise = 1e-4 * np.random.default_rng(1).standard_normal(t.size)
    record = pam.Trajectory(t, {"q": run["q"] + noise, "u": u}, interpolation="linear")
    told: list[str] = []
    given = rubbing(0.01).with_values(friction=0.3, k=30.0), record, ["friction", "k"]
    heard = {"progress": lambda stage, *_: told.append(stage)}
    fit = fit_plant(*given, widest={"width": 0.3}, degree=5, **heard)
    assert fit.values["friction"] == pytest.approx(2.0, rel=0.05)
    assert fit.values["k"] == pytest.approx(40.0, rel=0.02)
    assert told
    short = fit_plant(*given, iterations=2, degree=3)
    assert any("did not come to its end" in w for w in short.warnings)

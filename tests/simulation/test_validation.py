"""Comparison of simulations with measured records."""

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp import InputError, Trajectory, Variable

X = Variable("x", "state", unit="m", nominal=0.01)


def wave(t, delay=0.0):
    return 0.01 * np.sin(7 * (t - delay)) + 0.004 * np.sin(17 * (t - delay))


def simulated():
    t = np.linspace(0, 3, 3001)
    return Trajectory(t, {"x": wave(t)}, [X])


def test_a_late_and_noisy_record_is_aligned_and_measured():
    t = np.arange(0.5, 2.5, 0.01)
    noise = np.random.default_rng(0).normal(0, 2e-4, t.size)
    record = Trajectory(t, {"x": wave(t, 0.0273) + noise}, [X])
    found = pam.simulation.compare_with_record(simulated(), record, max_shift=0.1)
    assert found.shift == pytest.approx(0.0273, abs=3e-4)
    assert found["x"].rmse == pytest.approx(2e-4, rel=0.1)
    spread = np.linalg.norm(record["x"] - record["x"].mean())
    assert found["x"].fit_percent == pytest.approx(
        100 * (1 - np.linalg.norm(noise) / spread), abs=0.3
    )
    as_it_is = pam.simulation.compare_with_record(simulated(), record)
    assert as_it_is.shift == 0.0
    assert as_it_is["x"].rmse > 5 * found["x"].rmse


def test_a_perfect_record_fits_to_a_hundred_percent():
    found = pam.simulation.compare_with_record(simulated(), simulated())
    assert found["x"].fit_percent == 100.0
    assert "fit 100.00 %" in str(found)


def test_the_plot_shows_both_and_the_residual(tmp_path):
    found = pam.simulation.compare_with_record(simulated(), simulated())
    found.plot().savefig(tmp_path / "record.png")
    assert (tmp_path / "record.png").stat().st_size > 5000


def test_nothing_in_common_is_refused():
    t = np.linspace(10, 11, 5)
    with pytest.raises(InputError, match="overlap in 0 samples"):
        pam.simulation.compare_with_record(simulated(), Trajectory(t, {"x": t}, [X]))
    with pytest.raises(InputError, match="no column in common"):
        pam.simulation.compare_with_record(simulated(), Trajectory(t, {"y": t}))

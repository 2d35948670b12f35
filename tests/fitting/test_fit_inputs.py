"""How inputs ran between samples, and errors of measured inputs."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import BAR, benchmark_slide, noisy_record, refused

import pam_ocp as pam
from pam_ocp.core.errors import FitError, InputError
from pam_ocp.fitting import fit_plant, read_record
from pam_ocp.fitting.dynamic.experiment import deviance
from pam_ocp.fitting.dynamic.free_run_fit import _require_sense
from pam_ocp.fitting.dynamic.rig import RunUnknowns, Unknown
from pam_ocp.fitting.dynamic.runs import FreeRun

FREE = ["damping", "muscle*.lag"]
T = np.arange(0, 1.2, 0.01)


@pytest.fixture(scope="module")
def rig() -> pam.Plant:
    return benchmark_slide(pam.feeds.Regulator(0.05, max_pressure=6 * BAR))


def run(rig: pam.Plant, seed: int, way: str = "previous") -> pam.Trajectory:
    levels = np.random.default_rng(seed).uniform(2.2 * BAR, 4.5 * BAR, (2, 7))
    place = (T / 0.2 + 1e-9).astype(int)
    inputs = {f"muscle{i + 1}.command": levels[i][place] for i in (0, 1)}
    start = {"muscle1.pressure": 3 * BAR, "muscle2.pressure": 3 * BAR}
    return pam.simulate(rig, inputs, t=T, interpolation=way, start=start)


def measured(
    rig: pam.Plant, motion: pam.Trajectory, seed: int, command: float = 0.0, way: str | None = None
) -> pam.Trajectory:
    noise = dict.fromkeys(motion.named("input"), command) | {"x": 2e-5}
    return noisy_record(rig, motion, {}, noise, np.random.default_rng([seed, 1]), way)


@pytest.mark.parametrize("way", ["previous", "linear"])
@pytest.mark.parametrize("ending", ["csv", "npz", "parquet"])
def test_a_saved_record_says_how_its_inputs_ran(
    rig: pam.Plant, tmp_path: Path, ending: str, way: str
) -> None:
    motion = run(rig, 1, way)
    path = motion.save(tmp_path / f"record.{ending}")
    for back in (pam.Trajectory.load(path), read_record(path, rig), read_record(path)):
        assert back.interpolation_known
        assert back.interpolation == way
        assert "inputs_held" not in back.names
        np.testing.assert_array_equal(back["x"], motion["x"])


def test_a_record_that_does_not_say_it_stays_open(rig: pam.Plant, tmp_path: Path) -> None:
    unknown = measured(rig, run(rig, 1), 1)
    for ending in ("csv", "npz"):
        assert not read_record(unknown.save(tmp_path / f"r.{ending}"), rig).interpolation_known
    path = tmp_path / "r.csv"
    assert read_record(path, rig, inputs="held").interpolation == "previous"
    assert unknown.running("previous").interpolation_known
    refused("contradicts", read_record, path, rig, inputs="held", interpolation="linear")
    refused("'held' or 'linear'", read_record, path, rig, inputs="zoh")


@pytest.mark.slow
@pytest.mark.parametrize("way", ["previous", "linear"])
def test_the_likelihood_decides_how_inputs_ran(rig: pam.Plant, way: str) -> None:
    record = measured(rig, run(rig, 3, way), 3)
    fit = fit_plant(rig, record, FREE)
    assert fit.interpolation == way
    assert {"previous": "count as held", "linear": "joined by lines between"}[way] in fit.report()
    for name, (low, high) in fit.intervals(0.999).items():
        assert low <= float(rig.variable(name.replace("*", "1")).start or 0) <= high
    told = fit_plant(rig, record.running(way), FREE)
    assert told.inputs_ran == ""
    assert told.values == pytest.approx(fit.values, rel=1e-6)


def test_the_deviance_is_that_of_normal_errors() -> None:
    from scipy.stats import norm

    e = np.random.default_rng(0).standard_normal((50, 2)) * [1.0, 3.0]
    sigma = np.sqrt(np.mean(e**2, axis=0))
    exact = -2 * np.sum(norm.logpdf(e, scale=sigma)) - 100 * (1 + np.log(2 * np.pi))
    assert deviance(e) == pytest.approx(exact)
    assert deviance(e, np.array([1.0, 3.0])) == pytest.approx(np.sum((e / [1.0, 3.0]) ** 2))


@pytest.mark.slow
def test_errors_of_measured_inputs_no_longer_bias_the_damping(rig: pam.Plant) -> None:
    """Of 20 fits; where nothing is biased 16 or more lie above the truth once in 170."""
    noise = {"muscle1.command": 5e3, "muscle2.command": 5e3}
    hits, above, named = [], {True: 0, False: 0}, 0
    for seed in range(20):
        record = measured(rig, run(rig, 50 + seed), seed, 5e3, "previous")
        for known in (True, False):
            extra = {"input_noise": noise} if known else {}
            fit = fit_plant(rig, record, FREE, noise={"x": 2e-5}, degree=3, **extra)
            truth = {n: float(rig.variable(n.replace("*", "1")).start or 0) for n in fit.values}
            above[known] += fit.values["damping"] > truth["damping"]
            if known:
                hits += [low <= truth[n] <= high for n, (low, high) in fit.intervals().items()]
            elif seed < 6:
                named += not fit.adequacy.adequate
    assert np.mean(hits) >= 0.85
    assert 5 <= above[True] <= 15
    assert above[False] >= 16
    assert named == 6  # a fit that leaves such errors out says that something is


def test_input_noise_is_refused_where_it_cannot_be(rig: pam.Plant) -> None:
    record = measured(rig, run(rig, 1), 1, way="previous")
    with pytest.raises(InputError, match="input_noise needs noise"):
        fit_plant(rig, record, FREE, input_noise={"muscle1.command": 5e3})
    with pytest.raises(InputError, match="x is a state, not an input"):
        fit_plant(rig, record, FREE, noise={"x": 1e-5}, input_noise={"x": 1e-5})


# ---- free runs ----------------------------------------------------------------------------------
def test_a_free_run_that_diverges_says_so() -> None:
    t = np.array([0.1, 0.2])
    wild = np.array([[[1.0], [np.inf]], [[1.0], [1.1]], [[1.0], [5e3]]])
    starts, shown = np.array([0.0, 1.0, 2.0]), np.ones((3, 2, 1))
    runs = FreeRun(("x",), np.zeros(3), starts, t, shown, wild, np.ones(1))
    assert runs.diverged.tolist() == [True, False, True]
    assert "2 of 3 free runs diverge" in str(runs)
    assert np.isinf(runs.rmse["x"])


def test_discarded_sensitivities_are_not_called_no_influence() -> None:
    row = Unknown("groups", None, "stiffness", "N/m", 0.0, 1.0, -1.0, 1.0)
    unknowns = RunUnknowns((row,))
    for damped, words in ((4, "cannot be told"), (0, "no influence")):
        rollout = SimpleNamespace(
            weights=np.ones((4, 6)),
            largest=lambda z: 0.0,
            normal=lambda z, d=damped: (0.0, np.zeros(1), np.zeros((1, 1)), d),
        )
        refused(words, _require_sense, rollout, np.ones(1), unknowns, error=FitError)

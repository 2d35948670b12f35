"""The verdict on a closed loop where users look: the loop itself, a warning, files, the command."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.control import kalman

SEEN = {"x": 1e-4}


@pytest.fixture(scope="module")
def plant() -> pam.Plant:
    return pam.HangingLoad("DMSP-20-400N", 10.0)


@pytest.fixture(scope="module")
def start(plant):
    return plant.equilibrium(x=0.05)


def told(run):
    """(what a run gives, the sentences of its warnings)."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = run()
    return found, [str(w.message) for w in said]


def mpc(plant, **more):
    given = {"horizon": 20, "sample_time": 0.01, "rate": {"muscle.command": 0.05}} | more
    return pam.Mpc(plant, track={"x": 1.0}, **given)


def test_a_loop_that_arrives_is_as_asked_and_says_nothing(plant, start):
    loop, said = told(lambda: mpc(plant).closed_loop(plant, {"x": 0.06}, 1.0, start=start))
    assert loop.verdict
    assert said == []
    assert "as asked: x within 1 % of the stroke" in str(loop)
    assert loop.verdict.prediction < 0.01


def test_a_load_that_the_model_does_not_know_is_named_in_one_warning(plant, start):
    loop, said = told(
        lambda: mpc(plant).closed_loop(
            plant, {"x": 0.08}, 1.0, start=start, parameters={"mass": 14.0}
        )
    )
    assert said == [f"closed loop: {loop.verdict}"]
    share = abs(loop["x"][loop.t >= 0.9] - 0.08).max() / 0.03
    assert loop.verdict.missed == {"x": pytest.approx(share, rel=1e-9)}
    assert "predictions of v over one sample miss" in said[0]


def test_an_integration_that_is_unstable_is_said(plant):
    with pytest.warns(UserWarning, match=r"sample_time = 5 s in 64 substeps of rk4 is too long"):
        mpc(plant, sample_time=5.0)
    with pytest.warns(UserWarning, match="KalmanFilter: sample_time = 5 s"):
        pam.KalmanFilter(plant, measured={"x": 1e-4}, sample_time=5.0)


@pytest.mark.parametrize(("lags", "said"), [(2.7, 0), (2.9, 1)])
def test_rk4_grows_from_steps_of_2785_thousandths_of_a_lag_on(lags, said):
    """The end of its interval of stability (E. Hairer, G. Wanner, Solving ODEs II, IV.2)."""
    plant = pam.Plant("lag")
    x, u = plant.state("x"), plant.input("u")
    plant.der(x, (u - x) / 0.05)
    given = {"horizon": 3, "sample_time": 2 * 0.05 * lags, "track": {"x": 1.0}}
    assert len(told(lambda: pam.Mpc(plant, **given, substeps=2))[1]) == said
    own, silent = told(lambda: pam.Mpc(plant, **given))
    assert silent == []
    assert own.control({"x": 0.0}, {"x": 1.0})["u"] > 0


def test_state_feedback_is_judged_by_the_positions_of_its_point(plant, start):
    law = pam.lqr(plant, plant.equilibrium(x=0.06))
    loop, said = told(lambda: pam.closed_loop(law, plant, duration=0.02, start=start))
    share = abs(loop["x"][loop.t >= 0.018 - 1e-9] - 0.06).max() / 0.01
    assert loop.verdict.missed == {"x": pytest.approx(share, rel=1e-9)}
    assert len(said) == 1
    done, said = told(lambda: pam.closed_loop(law, plant, duration=1.5, start=start))
    assert done.verdict, said


def test_a_noisy_measurement_is_no_fault(plant, start):
    loop, said = told(
        lambda: mpc(plant).closed_loop(
            plant, {"x": 0.06}, 1.0, start=start, noise={"x": 2e-5, "v": 1e-3}
        )
    )
    assert loop.verdict, said


def test_bounds_given_to_the_controller_are_limits(plant, start):
    narrow = mpc(plant, bounds={"v": (-0.05, 0.05)}, penalty=1e-3)
    loop, _ = told(lambda: narrow.closed_loop(plant, {"x": 0.08}, 0.6, start=start))
    beyond = np.abs(loop["v"]).max() - 0.05
    assert beyond > 0.01
    assert loop.verdict.broken["v"] == pytest.approx(beyond, rel=1e-9)


def test_a_verdict_is_kept_in_files_and_shown_on_pages(plant, start, tmp_path):
    law = pam.lqr(plant, plant.equilibrium(x=0.06))
    loop, _ = told(lambda: pam.closed_loop(law, plant, duration=0.05, start=start))
    path = loop.save(tmp_path / "loop.npz")
    assert type(loop).load(path).verdict == loop.verdict
    page = tmp_path / "r.html"
    assert main(["report", str(path), "--out", str(page)]) == 0
    assert "not as asked: x ends" in page.read_text("utf-8")
    assert "not as asked: x ends" in loop._repr_html_()


def test_the_command_says_the_verdict(capsys):
    assert main(["mpc", "hanging_load", "--duration", "50 ms", "--estimator", "none"]) == 0
    assert "verdict: " in capsys.readouterr().out
    main(["mpc", "hanging_load", "--duration", "50 ms", "--estimator", "none", "--json"])
    said = json.loads(capsys.readouterr().out)["verdict"]
    assert said["words"].startswith("as asked" if said["as_asked"] else "not as asked")


# ---- what is given to controllers ----------------------------------------------------------------
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"sample_time": 5.0}, r"= 5 s is too long .* unstable .* give at most 0\.0098 s"),
        ({"sample_time": 0.0}, "sample_time = 0 s must be > 0"),
        ({"sample_time": -1.0}, "sample_time = -1 s must be > 0"),
        ({"sample_time": float("nan")}, "sample_time = nan"),
        ({"weights": {"x": -1.0}}, r"weights\['x'\] = -1 must be >= 0"),
        ({"weights": [1.0, 2.0]}, "weights"),
        ({"weights": {"y": 1.0}}, "unknown variable"),
        ({"effort": {"y": 1.0}}, "unknown variable"),
        ({"integral": ["x"]}, "integral"),
        ({"integral": {"x": -1.0}}, r"integral\['x'\] = -1 must be > 0"),
        ({"integral": {"x": 1.0}, "setpoint": {"x": 5.0}}, "5000 mm is outside.*did you mean 5 mm"),
        ({"integral": {"x": 1.0}, "setpoint": {"x": float("nan")}}, "setpoint = nan"),
        ({"integral": {"x": 1.0}, "setpoint": {"y": 0.05}}, "unknown variable"),
        ({"setpoint": {"x": 0.05}}, "setpoint: x is not integrated"),
    ],
)
def test_lqr_names_what_cannot_be_meant(plant, start, given, words):
    refused(words, pam.lqr, plant, start, error=pam.PamError, **given)


def test_the_longest_sample_time_that_is_named_stabilises(plant, start):
    assert pam.lqr(plant, start, sample_time=0.0098)
    with pytest.warns(UserWarning, match="over within a sample"):
        pam.lqr(plant, start, sample_time=5.0, sampled=True)


def along(plant, start, **given):
    motion = pam.simulate(plant, duration=0.1, start=start)
    return pam.control.tvlqr(plant, motion, **given)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p, at: kalman(p, at, measured=["x"]), "measured"),
        (lambda p, at: kalman(p, at, measured=SEEN, sample_time=-1.0), "sample_time"),
        (lambda p, at: kalman(p, at, measured=SEEN, process={"v": -1.0}), "process"),
        (lambda p, at: pam.Mpc(p, horizon=5, sample_time=0.01, track=["x"]), "track"),
        (lambda p, at: mpc(p).closed_loop(p, {"x": 80.0}, 0.1, start=at), "did you mean 80 mm"),
        (lambda p, at: mpc(p).closed_loop(p, {"x": float("nan")}, 0.1, start=at), "nan"),
        (lambda p, at: along(p, at, sample_time=5), "5 s is no shorter than the motion"),
        (lambda p, at: along(p, at, final=np.full((3, 3), np.nan)), "entries that are not finite"),
    ],
)
def test_other_controllers_name_what_cannot_be_meant(plant, start, call, words):
    refused(words, call, plant, start, error=pam.PamError)

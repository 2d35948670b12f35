"""Which model: a ladder of them, and the free runs through whole records by which it judges."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import noisy_record, refused
from scipy.linalg import expm

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.core.errors import FitError, InputError, OutOfTime, UnknownNameError
from pam_ocp.core.stop import TimeIsUp
from pam_ocp.fitting import Ladder, Rung, fit_ladder
from pam_ocp.fitting.dynamic import ladder as module
from pam_ocp.fitting.dynamic.free_run_result import widened
from pam_ocp.fitting.dynamic.ladder import rungs_of
from pam_ocp.fitting.dynamic.rungs import HISTORY, RungModel, Task, model_of, promised
from pam_ocp.fitting.dynamic.runs import half_widths

F = pam.feeds
NOISE = {"x": 2e-5, "muscle1.pressure": 300.0}
OUTPUTS = tuple(NOISE)
TRUE = {"dead_time": 0.0234, "lag": 0.06, "gain": 0.9e5, "base_pressure": 2.4e5, "damping": 50.0}


def regulator(**more: Any) -> Any:
    return F.PairRegulator(**{"gain": 1e5, "base": 2.5e5, "max_pressure": 6e5, **more})


slide = partial(pam.AntagonisticSlide, "DMSP-20-200N", 2.0, damping=60.0)


def staircase(plant: pam.Plant, seed: int, duration: float = 4.0) -> pam.Trajectory:
    """Holds of 0.25 s at random, with noise, through an exact dead time."""
    rng, t = np.random.default_rng(seed), np.arange(0, duration, 0.01)
    u = np.repeat([0.0, *rng.uniform(-1.5, 1.5, len(t) // 25)], 25)[: len(t)]
    start = plant.equilibrium(difference=0.0)
    run = pam.simulate(plant, {"difference": u}, t=t, start=start, dead_times="exact", rtol=1e-8)
    return noisy_record(plant, run, {"difference": u}, NOISE, rng)


@pytest.fixture(scope="module")
def record() -> pam.Trajectory:
    feed = regulator(lag=0.06, gain=0.9e5, base=2.4e5, dead_time=TRUE["dead_time"])
    return staircase(slide(feed=feed, damping=TRUE["damping"]), 3)


def climbed(record: pam.Trajectory, **options: Any) -> Ladder:
    given = {"rungs": ("static", "lag", "dead time"), "folds": 3, "steps": 3, **options}
    return fit_ladder(slide, record, ["base_pressure", "muscle*.gain"], feed=regulator(), **given)


@pytest.fixture(scope="module")
def ladder(record: pam.Trajectory) -> Ladder:
    return climbed(record)


# ---- free runs -----------------------------------------------------------------------------------
def whole_rig(venting: float = 0.09) -> pam.Plant:
    feed = regulator(lag=0.06, venting_lag=venting, slew=1.5e6, dead_time=F.DeadTime(0.0234, 3))
    return slide(feed=feed, losses=pam.losses.CoulombFriction(6.0, speed=5e-3))


def model(plant: pam.Plant, *records: pam.Trajectory, **more: Any) -> RungModel:
    """A rung's model; free, outputs, static."""
    rung = Rung("one", plant, more.get("free", ()), static=more.get("static", False))
    outputs = more.get("outputs", OUTPUTS)
    return model_of(Task(records, outputs, (), np.empty(0, dtype=np.intp), 8, {}), plant, rung)


def error(found: RungModel, steps: int = 8) -> Any:
    """(records, K, ny) in spreads."""
    rollout = replace(found, steps=steps).rollout()
    return (rollout.predicted(found.z) - rollout.runs.measured) / rollout.spread


def test_runs_are_those_of_an_accurate_integrator_with_exact_dead_time() -> None:
    record = staircase(whole_rig(), 4)
    plant, t = whole_rig(), record.t
    start, told = plant.equilibrium(difference=0.0), {"difference": record["difference"]}
    exact = pam.simulate(plant, told, t=t, start=start, dead_times="exact")
    columns = {n: exact[n] for n in ("difference", *OUTPUTS)}
    clean = pam.Trajectory(t, columns, [plant.variable(n) for n in columns], "previous")
    runs = model(plant, clean)
    coarse, fine = (np.sqrt(np.mean(error(runs, n) ** 2)) for n in (4, 8))
    assert np.abs(error(runs)).max() < 0.03
    assert coarse < 2e-3
    assert fine < 0.5 * coarse


@pytest.mark.parametrize("static", [False, True])
def test_sensitivities_are_those_of_differences(static: bool, record: pam.Trajectory) -> None:
    plant = slide(feed=regulator()) if static else whole_rig()
    free = ["base_pressure", "muscle*.gain"]
    free += [] if static else ["muscle*.lag", "difference.dead_time", "muscle*.slew", "damping"]
    found = model(plant, record, free=tuple(free), static=static)
    rollout, z = found.rollout(), found.z
    assert set(found.unknowns.names[: len(free)]) == set(free)
    exact = rollout.jacobian(z, damped=False)
    for j, name in enumerate(found.unknowns.names):
        step = 1e-5 * np.eye(len(z))[j]
        difference = (rollout.residuals(z + step) - rollout.residuals(z - step)) / 2e-5
        gap = np.sqrt(np.mean((difference - exact[:, j]) ** 2))
        assert gap < 1e-3 * np.sqrt(np.mean(difference**2)), name


def test_free_starts_are_where_a_record_begins() -> None:
    """A record cut out of a motion: from where it begins the runs meet what an accurate integrator
    gives from there.
    """
    plant = slide(feed=regulator(lag=0.06))
    t = 0.01 * np.arange(60)
    start = {"x": 2e-3, "v": 0.05, "muscle1.pressure": 2.9e5, "muscle2.pressure": 2.2e5}
    volts = {"difference": np.repeat([0.6, -0.4], 30)}
    run = pam.simulate(plant, volts, t=t, start=start, interpolation="previous", rtol=1e-10)
    seen = [plant.variable(n) for n in ("difference", "x")]
    cut = pam.Trajectory(t, {"difference": run["difference"], "x": run["x"]}, seen, "previous")
    found = model(plant, cut, cut, outputs=("x",))
    names, own = [v.name for v in plant.states], list(start)
    assert [names[i] for i in found.unknowns.own_starts] == own
    assert len(found.z) == 8
    nominal = plant.vector("state", attribute="nominal")[list(found.unknowns.own_starts)]
    z = found.z.copy()
    z[:4] = [run[n][HISTORY - 1] for n in own] / nominal
    rollout = replace(found, steps=32).rollout()
    errors = (rollout.predicted(z) - rollout.runs.measured) / rollout.spread
    assert np.abs(errors[0]).max() < 2e-4
    assert np.abs(errors[1]).max() > 0.1


def test_a_static_run_is_at_rest_at_every_sample(record: pam.Trajectory) -> None:
    plant = slide(feed=regulator())
    predicted = model(plant, record, static=True).rollout().predicted(np.empty(0))[0]
    for k in (HISTORY, 60, 200, 399):
        rest = plant.equilibrium(difference=record["difference"][k])
        found = predicted[k - HISTORY]
        np.testing.assert_allclose(found, [rest[n] for n in OUTPUTS], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("sampling", "extra"), [((0.01, 0.008), 0.0), ((0.01,), 0.004)])
def test_dead_times_that_differ_are_exact_or_lines_of_states(
    sampling: tuple[float, ...], extra: float
) -> None:
    """Exact in records of equal steps, of each its own; inputs that are held over unequal steps go
    through the delay lines themselves.
    """
    plant = slide(feed=F.Regulator(0.05, dead_time=F.DeadTime(0.02, 3)))
    apart = plant.with_values({"muscle2.dead_time": 0.043})
    for one in (plant, apart):
        runs = []
        for h in sampling:
            t = h * np.arange(round(4 / h))
            t = t if not extra else np.sort(np.concatenate([t, t[50:150:7] + extra]))
            wave = np.sin(4 * np.maximum(t - 0.1, 0.0)) * np.cos(1.3 * t)
            u = {f"muscle{i}.command": 2.5e5 + s * 1e5 * wave for i, s in ((1, 1), (2, -1))}
            start = plant.equilibrium({n: v[0] for n, v in u.items()})
            kind: Any = "line" if extra else "exact"
            runs.append(pam.simulate(one, u, t=t, start=start, dead_times=kind))
        assert np.sqrt(np.nanmean(error(model(one, *runs)) ** 2)) < 2e-3


# ---- the ladder ----------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_rung_that_made_the_record_is_chosen(ladder: Ladder) -> None:
    assert ladder.chosen.name == "+ dead time"
    assert [r.worse for r in ladder.rungs] == [True, True, False]
    assert ladder["dead time"].rmse["x"] == pytest.approx(2e-5, rel=0.1)  # the noise
    assert ladder["dead time"].against[0] < -0.8


def test_the_truth_lies_within_the_intervals(ladder: Ladder) -> None:
    for name, found in ladder.chosen.coefficients.items():
        true = TRUE[name.rpartition(".")[2]]
        assert abs(found.value - true) < 3 * found.stderr, name
        assert found.stderr < 0.02 * true, name


def test_errors_that_follow_each_other_widen_the_intervals() -> None:
    """Beside white noise of the same size: by sqrt((1 + a)/(1 - a)) for a mean."""
    random, n, a, blocks = np.random.default_rng(8), 4000, 0.8, 40
    ratios = {0.0: [], a: []}
    for follows, found in ratios.items():
        for _ in range(40):
            e = random.standard_normal(n)
            for k in range(1, n):
                e[k] = follows * e[k - 1] + np.sqrt(1 - follows**2) * e[k]
            sums = e.reshape(blocks, -1).sum(axis=1)[:, None]
            covariance = widened(np.array([[1 / n]]), sums, float(e @ e) / n)
            found.append(float(covariance[0, 0]) * n)
    assert np.mean(ratios[0.0]) == pytest.approx(1.0, rel=0.1)
    assert np.mean(ratios[a]) == pytest.approx((1 + a) / (1 - a), rel=0.15)


def test_the_report_marks_it_and_says_what_it_costs(ladder: Ladder) -> None:
    text = ladder.report()
    marked = [line for line in text.splitlines() if line.startswith("    * +")]
    assert len(marked) == 1
    assert "+ dead time" in marked[0]
    assert "x [mm]" in text
    assert "difference.dead_time: 0.023" in text


def test_an_executor_finds_the_same(record: pam.Trajectory, ladder: Ladder) -> None:
    with ThreadPoolExecutor(2) as pool:
        again = climbed(record, rungs=("static",), executor=pool)
    np.testing.assert_allclose(again["static"].losses, ladder["static"].losses, rtol=1e-6)


@pytest.mark.slow
def test_more_than_the_record_asks_for_is_not_chosen(record: pam.Trajectory) -> None:
    found = climbed(record, rungs=("dead time", "friction"))
    assert found.chosen.name == "dead time"
    assert found["friction"].score > 0.98 * found["dead time"].score


def joint(**more: Any) -> pam.Plant:
    return pam.AntagonisticJoint("DMSP-20-200N", 0.05, 0.025, damping=0.3, **more)


def test_two_muscles_have_lags_of_their_own_on_a_rung() -> None:
    """Truth by SciPy: two first-order lags; the plant's joint is held, so pressures are alone."""
    t = np.arange(400) * 0.01
    rng = np.random.default_rng(5)
    levels = rng.uniform(1e5, 4e5, (9, 2))
    u = levels[np.minimum((t / 0.45).astype(int), 8)]
    lags, p = (0.06, 0.21), np.empty((len(t), 2))
    p[0] = u[0]
    for k in range(len(t) - 1):
        p[k + 1] = u[k] + (p[k] - u[k]) * np.exp(-0.01 / np.array(lags))
    p += 100.0 * rng.standard_normal(p.shape)
    plant = joint()
    names = [f"muscle{i}.{what}" for what in ("command", "pressure") for i in (1, 2)]
    variables = [plant.variable(n) for n in names]
    columns = dict(zip(names, np.hstack([u, p]).T, strict=True))
    record = pam.Trajectory(t, columns, variables, "previous")
    found = fit_ladder(joint, record, rungs=["lag", "unequal lags"], dynamic=(), folds=3)
    assert [r.name for r in found.rungs] == ["lag", "+ unequal lags"]
    rung = found["+ unequal lags"]
    for i, lag in enumerate(lags, 1):
        assert rung.coefficients[f"muscle{i}.lag"].value == pytest.approx(lag, rel=0.01)
    assert found.chosen is rung
    single = rungs_of(partial(pam.HangingLoad, "DMSP-20-200N", 5.0), names=["lag", "unequal lags"])
    assert [r.name for r in single] == ["lag"]
    refused('"unequal lags" without "lag"', rungs_of, joint, names=["static", "unequal lags"])


def test_hysteresis_grows_with_pressure_and_the_force_law_is_freed_on_rungs() -> None:
    names = ["lag", "memory", "memory per pressure", "force law", "creep"]
    found = dict(zip(names, rungs_of(joint, ["inertia", "muscle1.a5"], names=names), strict=True))
    loss = found["memory per pressure"].plant
    assert loss.variable("muscle1.slip_per_pressure").start > 0
    assert found["memory per pressure"].starts[0]["muscle2.slip_per_pressure"] == 0
    freed = found["force law"].free
    law = [n for entry in freed for n in ([entry] if isinstance(entry, str) else entry)]
    own = {f"muscle{i}.a{k}" for i in (1, 2) for k in range(1, 7)} - {"muscle2.a5"}
    assert own <= set(law)
    assert "muscle2.a5" not in law  # a user who frees it of one muscle alone holds it
    assert len(set(law)) == len(law)
    exponents = {"muscle1.a3", "muscle2.a3"}  # of exp(a3 kappa): the force is no line in them
    assert found["force law"].later[-1] == exponents
    assert {frozenset({"muscle1.a2", "muscle2.a2"})} < {*found["force law"].later[:-1]}
    for name, free in ((n, r.free) for n, r in found.items()):
        assert ("inertia" in free) == (name not in ("force law", "creep"))  # it sets the scale
    every = [f"muscle{i}.a{k}" for i in (1, 2) for k in range(1, 7)]
    known = rungs_of(joint, ["inertia", *every], names=["lag", "force law", "creep"])
    assert [r.name for r in known] == ["lag", "+ creep"]  # nothing is left to free
    assert "inertia" in known[-1].free
    with pytest.raises(InputError, match='"memory per pressure" without "memory"'):
        rungs_of(joint, names=["lag", "memory per pressure"])


def test_a_free_mass_is_tried_lighter_and_heavier() -> None:
    lag, memory = rungs_of(joint, ["inertia"], names=["lag", "memory"])
    scaled = [s for s in lag.starts if "inertia" in s]
    assert sorted({round(s["inertia"], 12) for s in scaled}) == [0.015, 0.05, 0.15, 0.5]
    assert [s["damping"] for s in scaled] == pytest.approx([6 * s["inertia"] for s in scaled])
    assert any("inertia" not in s for s in memory.starts)  # from what the rung before found
    assert any(s.get("inertia", 0.0) > 0.4 and s["muscle1.slip1_force"] > 0 for s in memory.starts)
    tied = rungs_of(joint, [["inertia"], ["muscle1.a5", "muscle2.a5"]], names=["lag"])
    assert tied[0].starts == lag.starts
    (known,) = rungs_of(joint, names=["lag"])
    assert not any("inertia" in s for s in known.starts)


@pytest.mark.slow
def test_rungs_of_ones_own_need_no_arrangement(record: pam.Trajectory) -> None:
    plants = [slide(feed=regulator(lag=0.06, dead_time=d)) for d in (None, TRUE["dead_time"])]
    frees = [("damping", "muscle*.lag", "base_pressure", "muscle*.gain")] * 2
    rungs = [Rung(n, p, f) for n, p, f in zip(("plain", "late"), plants, frees, strict=True)]
    found = fit_ladder(rungs, [record], folds=3, steps=3)
    assert found.chosen.name == "late"


def test_disturbances_that_no_record_holds_are_what_they_are_by_themselves() -> None:
    plant = pam.Plant("pushed")
    x, push, u = plant.state("x"), plant.input("push", disturbance=True), plant.input("u")
    rate = plant.parameter("rate", 3.0)
    plant.der(x, rate * (u - x) + push)
    t = 0.01 * np.arange(300)
    wave = {"u": (t, np.sin(2 * t)), "push": 0.0}
    run = pam.simulate(plant, wave, t=t, interpolation="linear")
    noisy = run["x"] + 1e-4 * np.random.default_rng(1).standard_normal(len(t))
    seen = pam.Trajectory(t, {"x": noisy, "u": run["u"]}, interpolation="linear")
    found = fit_ladder([Rung("one", plant.with_values(rate=2.0), ("rate",))], seen, folds=3)
    value = found.chosen.coefficients["rate"]
    assert value.value == pytest.approx(3.0, abs=4 * value.stderr)
    assert value.stderr < 0.01


@pytest.mark.slow
def test_rungs_are_structures_to_choose_among() -> None:
    """Whole records are left out; of the winner the nested error is the noise of the records."""
    feed = regulator(lag=0.06, dead_time=TRUE["dead_time"])
    records = [staircase(slide(feed=feed), seed, 1.5) for seed in (11, 12, 13)]
    free, late = ("base_pressure", "muscle*.lag"), regulator(lag=0.06, dead_time=0.02)
    rungs = {
        "static": Rung("static", slide(feed=regulator()), free[:1], static=True),
        "plain": Rung("plain", slide(feed=regulator(lag=0.06)), free),
        "late": Rung("late", slide(feed=late), (*free, "difference.dead_time")),
    }
    asked = {"folds": 3, "seed": 2, "rule": "best", "criteria": OUTPUTS, "executor": 0}
    found = pam.fitting.choose(rungs, records, **asked)
    assert found.name == "late"
    assert [t.complexity for t in found.tried] == [1.0, 2.0, 3.0]
    assert found.rmse["x"] == pytest.approx(2e-5, rel=0.1)
    assert found.rmse["muscle1.pressure"] == pytest.approx(300.0, rel=0.1)


def test_when_time_is_over_the_rungs_climbed_remain(record: Any, monkeypatch: Any) -> None:
    seen, whole = [], module.climbed

    def twice(*arguments: Any) -> Any:
        seen.append(1)
        if len(seen) == 2:
            raise TimeIsUp
        return whole(*arguments)

    monkeypatch.setattr(module, "climbed", twice)
    found = climbed(record)
    assert found.unclimbed == ("+ lag", "+ dead time")
    assert "no time left" in found.report()
    seen[:] = [1]
    refused("before the first rung", climbed, record, error=OutOfTime)


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"rungs": ["lagg"]}, UnknownNameError, "did you mean 'lag'"),
        ({"rungs": []}, InputError, "rungs is empty"),
        ({"folds": 2}, InputError, "folds = 2"),
        ({"folds": 60}, InputError, "too few for 360 parts"),
        ({"outputs": ["mass"]}, InputError, "mass is neither a state nor an output"),
        ({"dynamic": ["x"]}, InputError, "x is a state; only parameters"),
        (
            {"bounds": {"gian": (0.5, 2.0)}},
            UnknownNameError,
            "in bounds that no rung frees: 'gian'",
        ),
        ({"bounds": 3}, InputError, "bounds is an int: give"),
        ({"bounds": {"muscle*.gain": 2.0}}, InputError, r"= 2.0: give \(low, high\)"),
    ],
)
def test_what_cannot_be_is_refused(
    record: pam.Trajectory, options: dict[str, Any], error: type[Exception], words: str
) -> None:
    refused(words, climbed, record, error=error, **options)


def test_a_ladder_of_nothing_that_can_be_fitted_says_why(record: pam.Trajectory) -> None:
    plant = slide(feed=regulator()).with_values({"muscle1.a6": 1e9, "muscle2.a6": 0.0})
    with pytest.raises(FitError, match="no rung could be fitted: the free runs diverge"):
        fit_ladder([Rung("wild", plant, ("damping",))], record, folds=3)


# ---- the command ---------------------------------------------------------------------------------
OWN = """\
import pam_ocp as pam

def rig(muscle, feed, losses):
    return pam.AntagonisticSlide(muscle, 2.0, damping=60.0, feed=feed, losses=losses)
"""
STUDY = """\
records = ["run.csv"]
free = ["base_pressure", "muscle*.gain"]
rungs = ["dead time"]
folds = 3
interpolation = "previous"

[plant]
arrangement = {arrangement}
muscle = "DMSP-20-200N"
feed = {{ kind = "PairRegulator", base = "2.5 bar", gain = "1 bar/V", max_pressure = "6 bar" }}
{more}
"""


@pytest.mark.parametrize("own", [pytest.param(False, marks=pytest.mark.slow), True])
def test_the_command_climbs_with_plants_of_the_library_and_of_ones_own(
    own: bool, record: pam.Trajectory, tmp_path: Path, capsys: Any
) -> None:
    record.at(record.t[:200]).save(tmp_path / "run.csv")
    (tmp_path / "rig.py").write_text(OWN)
    arrangement, more = ('"rig.py:rig"', "") if own else ('"AntagonisticSlide"', "damping = 60.0")
    study = tmp_path / "study.toml"
    study.write_text(STUDY.format(arrangement=arrangement, more=more))
    if own:
        assert main(["ladder", str(study)]) == 2
        assert "--allow-code" in capsys.readouterr().err
    assert main(["ladder", str(study), *(["--allow-code"] if own else [])]) == 0
    shown = capsys.readouterr()
    assert "* dead time" in shown.out
    assert "dead time: error" in shown.err


def test_bands_hold_what_they_say_of_another_record(ladder: Ladder) -> None:
    """What the chosen plant leaves is white noise, of which 90 % lie within 1.645 deviations."""
    feed = regulator(lag=0.06, gain=0.9e5, base=2.4e5, dead_time=TRUE["dead_time"])
    again = staircase(slide(feed=feed, damping=TRUE["damping"]), 17)
    band = ladder.predict(again, level=0.9)
    assert band.run.names == OUTPUTS
    for name, noise in NOISE.items():
        assert band.coverage[name] == pytest.approx(0.9, abs=0.04)
        half = band.half[..., OUTPUTS.index(name)]
        assert np.median(half) == pytest.approx(1.645 * noise, rel=0.15)
    refused("level = 90", ladder.predict, again, level=90)
    failed = replace(ladder.rungs[0], failure="it ran away", model=None)
    broken = replace(ladder, rungs=(failed, *ladder.rungs[1:]))
    refused(r"has no fit \(it ran away\)", broken.predict, again, failed.name)


def swings(count: int, random: np.random.Generator, samples: int = 60) -> list[pam.Trajectory]:
    """q'' = 40 u - 40 q - 3 q', u held, from rest, sampled exactly, with noise of 1 mrad."""
    t, rates = 0.02 * np.arange(samples), np.array([[0, 1, 0], [-40, -3, 40], [0, 0, 0]])
    step, found = expm(0.02 * rates), []
    for _ in range(count):
        u = np.repeat(random.uniform(-1, 1, samples // 10), 10)
        x = [np.array([u[0], 0.0, u[0]])]
        for own in u[:-1]:
            x.append(step @ np.array([*x[-1][:2], own]))
        q = np.array(x)[:, 0] + 1e-3 * random.standard_normal(samples)
        found.append(pam.Trajectory(t, {"q": q, "u": u}, interpolation="previous"))
    return found


def test_bands_hold_records_that_begin_where_noise_says() -> None:
    """The noise of the start swings through the run; of records that were fitted it does not."""
    plant = pam.Plant("spring")
    q, w, u = plant.state("q"), plant.state("w"), plant.input("u", min=-3, max=3)
    k, c = (plant.parameter(n, v, nominal=v) for n, v in (("k", 38.0), ("c", 3.5)))
    plant.der(q, w)
    plant.der(w, 40 * u - k * q - c * w)
    random = np.random.default_rng(2)
    rungs, records = [Rung("spring", plant, ("k", "c"))], swings(8, random)
    short = pam.Trajectory(
        [0, 0.02, 0.04], {n: np.zeros(3) for n in "qu"}, interpolation="previous"
    )
    refused("record 9 has 3 samples", fit_ladder, rungs, [*records, short], folds=4)
    ladder = fit_ladder(rungs, records, folds=4)
    assert ladder.predict(swings(20, random), level=0.9).coverage["q"] == pytest.approx(
        0.9, abs=0.05
    )


def test_bands_are_wider_where_the_plants_of_folds_differ() -> None:
    """Against the definition of CV+ over the nearest fifth, sample by sample."""
    rng = np.random.default_rng(3)
    left = [np.abs(rng.standard_normal((2, n, 2))) for n in (40, 60)]
    apart, at = rng.standard_normal((2, 3, 5, 2)), rng.standard_normal((3, 5, 2))
    half = half_widths(apart, at, left, 0.9)
    size = np.std(np.concatenate([e[0] for e in left]), axis=0)
    every = [(f, e[0, i], e[1, i]) for f, e in enumerate(left) for i in range(e.shape[1])]
    for n, k, y in np.ndindex(half.shape):
        near = sorted(every, key=lambda s: np.linalg.norm((s[1] - at[n, k]) / size))[:20]
        ends = []
        for sign in (1.0, -1.0):
            reached = sorted(e[y] + sign * apart[f, n, k, y] for f, _, e in near)
            ends.append(reached[19 - 1])  # the 0.9 (20 + 1)th, rounded up
        assert half[n, k, y] == pytest.approx(max(ends), rel=1e-12)


def test_plants_with_other_values_run_through_the_same_functions(record: pam.Trajectory) -> None:
    """So what is compiled is compiled once for all starts and folds of a rung."""
    plant = slide(feed=regulator(lag=0.06, gain=0.9e5))
    other = plant.with_values({"muscle1.lag": 0.1, "muscle2.lag": 0.1, "mass": 3.0})
    one, two = (model(p, record, free=("muscle*.lag",)).rollout() for p in (plant, other))
    assert one._one(True, False) is two._one(True, False)


def test_what_freeing_unknowns_promises_is_what_least_squares_gain() -> None:
    rng = np.random.default_rng(5)
    slopes, errors = rng.standard_normal((30, 4)), rng.standard_normal(30)
    for free in ([0, 2], [1, 3], [0, 1, 2, 3]):
        rest = np.linalg.lstsq(slopes[:, free], errors, rcond=None)[1][0]
        gain = promised(slopes.T @ errors, slopes.T @ slopes, free)
        assert gain == pytest.approx(errors @ errors - rest, rel=1e-9)


def test_intervals_of_a_rung_widen_with_their_level(ladder: Ladder) -> None:
    """Student's t of the blocks: of 24 blocks 95 % are 2.069 standard errors to each side; those of
    the chosen rung count how far the least squares of whole motions lie.
    """
    for rung, told in (("lag", {}), (ladder.chosen.name, ladder.adequacy.stderr)):
        found = ladder.intervals(rung, 0.95)
        assert found.keys() == ladder[rung].coefficients.keys()
        for name, (low, high) in found.items():
            own = ladder[rung].coefficients[name].stderr
            assert told.get(name, own) >= own
            assert (high - low) / 2 == pytest.approx(2.0687 * told.get(name, own), rel=1e-4)
    lag = ladder.intervals("lag", 0.5)
    assert lag.keys() == ladder["lag"].coefficients.keys()
    refused("rung", ladder.intervals, "kinks", error=UnknownNameError)

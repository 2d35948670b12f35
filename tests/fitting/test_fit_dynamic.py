"""Dynamic fits: the truth comes back within its intervals, doubts come before intervals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import BAR, benchmark_slide, noisy_record, refused

import pam_ocp as pam
from pam_ocp.core.errors import FitError, UnknownNameError
from pam_ocp.fitting import PlantFit, fit_plant
from pam_ocp.fitting.dynamic.experiment import prepare
from pam_ocp.plants.memory import BoucWen

POSITION_NOISE, PRESSURE_NOISE = 2e-5, 500.0
EVEN = {"muscle1.pressure": 3 * BAR, "muscle2.pressure": 3 * BAR}
NOISE = {"x": POSITION_NOISE, **dict.fromkeys(EVEN, PRESSURE_NOISE)}
FREE = ("damping", "muscle*.lag", "muscle*.a2", "muscle*.a4", "muscle*.a5")


def record(
    plant: pam.Plant,
    seed: int,
    *,
    duration: float = 1.5,
    delay: float = 0.0,
    start: dict[str, float] | None = None,
) -> pam.Trajectory:
    """Random steps of both commands every 0.25 s; position and pressures at 100 Hz with noise."""
    random = np.random.default_rng(seed)
    t = np.arange(0, duration + 0.005, 0.01)
    levels = random.uniform(2.2 * BAR, 4.5 * BAR, (2, 1 + int(duration / 0.25)))
    commands = {f"muscle{i + 1}.command": levels[i][(t / 0.25 + 1e-9).astype(int)] for i in (0, 1)}
    late = np.concatenate([t[:1], t[1:] + delay])
    inputs, begin = {n: (late, c) for n, c in commands.items()}, start or EVEN
    run = pam.simulate(plant, inputs, t=t, interpolation="previous", start=begin)
    return noisy_record(plant, run, commands, NOISE, random)


def truth(plant: pam.Plant, name: str) -> float:
    return float(plant.variable(name.replace("*", "1")).start or 0.0)


def elsewhere(plant: pam.Plant, free: tuple[str, ...] = FREE, factor: float = 0.8) -> pam.Plant:
    """The plant with its free parameters off by 20 %."""
    members = {name.replace("*", i) for name in free for i in "12"}
    return plant.with_values({n: factor * truth(plant, n) for n in members})


def assert_within(fit: PlantFit, plant: pam.Plant, level: float = 0.99) -> None:
    """All truths at once in their intervals of 99 %."""
    for name, (low, high) in fit.intervals(level).items():
        if name in ("delay",) or name.endswith((".offset", ".gain")):
            continue
        assert low <= truth(plant, name) <= high, name


@pytest.fixture(scope="module")
def rig() -> pam.Plant:
    return benchmark_slide(pam.feeds.Regulator(0.05, max_pressure=6 * BAR))


@pytest.fixture(scope="module")
def records(rig: pam.Plant) -> list[pam.Trajectory]:
    return [record(rig, seed) for seed in range(2)]


@pytest.fixture(scope="module")
def fit(rig: pam.Plant, records: list[pam.Trajectory]) -> PlantFit:
    return fit_plant(elsewhere(rig), records, FREE)


# ---- the truth -----------------------------------------------------------------------------------
@pytest.mark.slow
def test_free_parameters_of_an_antagonistic_slide_come_back_within_their_intervals(
    fit: PlantFit, rig: pam.Plant
) -> None:
    assert_within(fit, rig)
    for name, c in fit.coefficients.items():
        assert c.stderr < 0.02 * abs(truth(rig, name))  # and they are narrow
    assert fit.rank == len(fit.linearisation.names)
    assert not fit.warnings
    assert fit.rmse["x"] == pytest.approx(POSITION_NOISE, rel=0.15)
    assert fit.noise["muscle1.pressure"] == pytest.approx(PRESSURE_NOISE, rel=0.15)
    assert fit.plant.variable("muscle2.a4").start == fit.values["muscle*.a4"]


@pytest.mark.slow
@pytest.mark.parametrize("method", ["multiple-shooting", "single-shooting"])
def test_shooting_finds_the_same(fit: PlantFit, rig: pam.Plant, records: Any, method: Any) -> None:
    other = fit_plant(elsewhere(rig), records, FREE, method=method)
    for name, c in fit.coefficients.items():
        assert other.values[name] == pytest.approx(c.value, abs=0.25 * c.stderr)
        assert other.coefficients[name].stderr == pytest.approx(c.stderr, rel=0.05)


@pytest.mark.slow
def test_the_reduced_covariance_is_that_of_finite_differences_of_simulations(
    fit: PlantFit, records: Any
) -> None:
    """Residuals of independent simulations, differentiated in every unknown."""
    head = fit.linearisation
    count, nx = len(fit.parameters), len(fit.plant.states)
    sigma = np.array([fit.noise[n] for n in fit.measured])

    def residuals(values: np.ndarray) -> np.ndarray:
        changed = {
            n.replace("*", i): v
            for n, v in zip(fit.parameters, values, strict=False)
            for i in ("1", "2")
        }
        plant, rows = fit.plant.with_values(changed), []
        for r, one in enumerate(records):
            x0 = values[count + r * nx : count + (r + 1) * nx]
            start = dict(zip((v.name for v in plant.states), x0, strict=True))
            run = pam.simulate(plant, one, start=start, rtol=1e-11)
            rows.append(((one.array(fit.measured) - run.array(fit.measured)) / sigma).ravel())
        return np.concatenate(rows)

    scale = head.stderr()
    steps = np.diag(0.05 * scale)
    apart = [residuals(head.values + s) - residuals(head.values - s) for s in steps]
    jacobian = np.stack(apart, 1) / (2 * steps.sum(axis=0))
    covariance = np.linalg.inv((jacobian * scale).T @ (jacobian * scale))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(np.ones(len(scale)), rel=0.02)


@pytest.mark.slow
def test_an_input_delay_is_estimated_to_a_part_of_a_sample(rig: pam.Plant) -> None:
    late = [record(rig, 5, delay=0.023)]
    found = fit_plant(elsewhere(rig, ("damping",)), late, ["damping"], delay=(0.0, 0.04))
    low, high = found.interval("delay", 0.99)
    assert low <= 0.023 <= high
    assert found.coefficients["delay"].stderr < 2e-4
    known = fit_plant(elsewhere(rig, ("damping",)), late, ["damping"], delay=0.023)
    found = known.coefficients["damping"]
    assert found.value == pytest.approx(20.0, abs=4 * found.stderr)


def test_gain_and_offset_of_a_sensor_are_estimated(rig: pam.Plant) -> None:
    clean = record(rig, 6)
    columns = {n: clean[n] for n in clean.names}
    columns["x"] = 1.05 * columns["x"] + 1e-3
    columns["muscle1.pressure"] = columns["muscle1.pressure"] + 5e3
    wrong = pam.Trajectory(clean.t, columns, clean.variables, "previous")
    sensors = {"gains": ["x"], "offsets": ["x", "muscle1.pressure"]}
    found = fit_plant(elsewhere(rig, ("damping",)), wrong, ["damping"], **sensors)
    expected = {"x.gain": 1.05, "x.offset": 1e-3, "muscle1.pressure.offset": 5e3, "damping": 20.0}
    for name, value in expected.items():
        low, high = found.interval(name, 0.99)
        assert low <= value <= high, name
    assert found.fit_percent["x"] > 98


@pytest.mark.slow
def test_hysteresis_comes_back_from_a_record_with_noise_and_delay() -> None:
    """Bouc-Wen in both muscles, delay of 13 ms: all within their intervals."""
    parts = {"damping": 20.0, "feed": pam.feeds.Regulator(0.05, max_pressure=6 * BAR)}
    loss = BoucWen(friction=15.0, yield_contraction=0.004)
    rig = pam.AntagonisticSlide("DMSP-20-200N", 2.0, 0.10, stroke=0.016, losses=loss, **parts)
    free = ("damping", "muscle*.lag", "muscle*.a4", "muscle*.hysteresis_force")
    late = record(rig, 8, delay=0.013, duration=1.0)
    found = fit_plant(elsewhere(rig, free), late, free, delay=(0.0, 0.03))
    assert_within(found, rig)
    low, high = found.interval("delay", 0.99)
    assert low <= 0.013 <= high


def test_validation_estimates_only_the_initial_state(fit: PlantFit, rig: pam.Plant) -> None:
    (found,) = fit.validate(record(rig, 77))
    assert found["x"].fit_percent > 98
    assert found["x"].rmse == pytest.approx(POSITION_NOISE, rel=0.2)
    heavy = rig.with_values(damping=200.0)
    assert fit.validate([record(heavy, 77)])[0]["x"].fit_percent < 98


def test_known_noise_weighs_the_measured_variables(rig: pam.Plant, records: Any) -> None:
    noise = {n.replace("2.", "2_"): size for n, size in NOISE.items()}
    found = fit_plant(elsewhere(rig, ("damping",)), records, ["damping"], noise=noise)
    assert found.linearisation.scale == pytest.approx(1.0, abs=0.1)


# ---- doubts --------------------------------------------------------------------------------------
def test_a_constant_that_cancels_in_a_symmetric_pair_is_refused_by_name(
    rig: pam.Plant, records: Any
) -> None:
    with pytest.raises(FitError, match=r"^muscle\*\.a6: no influence on x"):
        fit_plant(rig, records, ["damping", "muscle*.a6"])


@pytest.mark.slow
def test_constants_of_both_muscles_are_seen_only_in_their_difference(
    rig: pam.Plant, records: Any
) -> None:
    found = fit_plant(rig, records, ["damping", "muscle1.a6", "muscle2.a6"])
    assert found.rank == len(found.linearisation.names) - 1
    assert np.isinf(found.coefficients["muscle1.a6"].stderr)
    wanted = ("do not see this combination", "muscle1.a6", "muscle2.a6")
    assert any(all(words in w for words in wanted) for w in found.warnings)
    report = found.report()
    assert report.index("do not see") < report.index("[[Parameters]]")


def test_constant_inputs_are_refused_with_the_parameters_they_cannot_tell(rig: pam.Plant) -> None:
    t = np.arange(0, 0.5, 0.01)
    inputs = {"muscle1.command": 3 * BAR, "muscle2.command": 3 * BAR}
    run = pam.simulate(rig, inputs, t=t, start=EVEN)
    with pytest.raises(FitError, match=r"all inputs are constant .* cannot tell .*muscle\*\.lag"):
        fit_plant(rig, run, ["damping", "muscle*.lag"], outputs=["x", "muscle1.pressure"])


@pytest.mark.slow
def test_a_wrong_model_is_given_away_by_its_residuals(rig: pam.Plant, records: Any) -> None:
    heavy = rig.with_values({"muscle1.a5": 1.1 * truth(rig, "muscle1.a5")})
    found = fit_plant(heavy, records, ["damping"])
    assert any("the model is inadequate" in text for text in found.warnings)
    assert found.adequacy.excess > 3


# ---- what is refused -----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"free": ["dumping"]}, "did you mean 'damping'"),
        ({"free": ["muscle*.a9"]}, "unknown pattern in free"),
        ({"free": ["x"]}, "x is a state; only parameters are fitted"),
        ({"free": ["damping", ("damping", "mass")]}, "are to be equal but start from"),
        ({"free": ["damping", "damping"]}, "twice"),
        ({"free": []}, "free is empty"),
        ({"method": "euler"}, "choose one of collocation"),
        ({"degree": 12}, "whole number from 1 to 9"),
        ({"delay": (0.1, 0.05)}, "the lower must be the smaller"),
        ({"delay": (0.0, 5.0)}, "too short for delays of up to 5 s"),
        ({"offsets": ["v"]}, "v is not measured; measured are x"),
        ({"noise": {"x": 1e-5}}, "muscle1.pressure is measured too"),
        ({"bounds": {"mass": (1.0, 2.0)}}, "in bounds that is not free"),
        ({"bounds": {"damping": (30.0, 40.0)}}, "starts at 20, outside its bounds"),
        ({"bounds": {"damping": 30.0}}, r"bounds\['damping'\] = 30.0: give \(low, high\)"),
        ({"bounds": {"damping": ("1 bar", 40.0)}}, "measures something else than 'N.s/m'"),
        ({"bounds": {"damping": (0.0, 10**400)}}, "larger than any float"),
        ({"bounds": 3.0}, r"bounds is a float: give \{free parameter"),
        ({"free": 3}, "free = 3: give a name in quotes"),
        ({"free": [None]}, "free = None: give a name in quotes"),
        ({"outputs": ["muscle1.command"]}, "neither a state nor an output"),
        ({"inputs": {"x": 1.0}}, "x is a state, not an input"),
    ],
)
def test_bad_arguments_are_refused_in_words(
    arguments: dict[str, Any], words: str, rig: pam.Plant, records: Any
) -> None:
    refused(words, fit_plant, rig, records, **{"free": ["damping"], **arguments})


def test_what_is_no_plant_and_no_record_is_named(rig: pam.Plant, records: Any) -> None:
    for *chosen, words in (
        (None, records, "plant is None: give a Plant"),
        (rig, None, "records is None: give a Trajectory"),
        (rig, [None], "record 1 is None"),
    ):
        refused(words, fit_plant, *chosen, ["damping"])
        refused(words, pam.fit_free_run, *chosen, ["damping"], horizon=0.2)


def test_bounds_may_be_texts_with_units(rig: pam.Plant) -> None:
    short = record(rig, 1, duration=0.3)
    texts, numbers = (
        fit_plant(rig, short, ["damping"], outputs=["x"], bounds={"damping": given})
        for given in (("0.01 N.s/mm", "1 N.s/mm"), (10.0, 1000.0))
    )
    assert texts.values == pytest.approx(numbers.values, rel=1e-9)


def test_records_that_cannot_serve_are_refused(rig: pam.Plant, records: Any, fit: PlantFit) -> None:
    one = records[0]
    columns = {n: one[n].copy() for n in one.names}
    columns["x"][3] = np.nan
    broken = pam.Trajectory(one.t, columns, one.variables)
    bare = pam.Trajectory(one.t, {"x": one["x"]}, [rig.variable("x")])
    alien = pam.Trajectory(one.t, {"foo": one["x"]})
    for given, words in (
        ([one, broken], r"record 2: x = nan at t = 0.03 s"),
        (bare, r"no column for the input muscle1\.command"),
        (alien, "no state or output of the plant"),
        ([], "records is empty"),
    ):
        refused(words, fit_plant, rig, given, ["damping"])
    refused("fitted parameter", fit.interval, "mass", error=UnknownNameError)


def test_a_report_names_the_pairs_of_parameters_that_go_together(fit: PlantFit) -> None:
    covariance, names = fit.linearisation.covariance, fit.linearisation.names
    size = np.sqrt(np.diag(covariance))
    expected = set()
    for i, a in enumerate(names):
        for j, b in enumerate(names[:i]):
            r = covariance[i, j] / (size[i] * size[j])
            if abs(r) > 0.8 and {a, b} <= set(fit.coefficients):
                expected.add((frozenset((a, b)), f"{r:+.4f}"))
    told = [line[6:].split(") = ") for line in fit.report().splitlines() if line[:6] == "    C("]
    assert expected
    assert {(frozenset(pair.split(", ")), r) for pair, r in told} == expected


def test_a_step_parts_the_samples_evenly_and_no_more_than_it_asks(
    rig: pam.Plant, records: list[pam.Trajectory]
) -> None:
    one = records[0]
    between = float(np.diff(one.t).max())
    for step, parts in ((between / 2, 2), (between / 2.5, 3), (2 * between, 1)):
        mesh = prepare(rig, one, ["x"], 0.0, step, {}, {}).mesh
        plain = prepare(rig, one, ["x"], 0.0, None, {}, {}).mesh
        assert len(mesh) - 1 == parts * (len(plain) - 1)
        assert mesh[::parts] == pytest.approx(plain, abs=1e-12)
        assert np.diff(mesh).max() <= step * (1 + 1e-6)


def test_a_record_without_noise_is_fitted_to_its_last_digits() -> None:
    """Weights by what is left of it would grow beyond rounding."""
    plant = pam.HangingLoad(pam.muscle("DMSP-20-200N"), mass=4.0)
    t = np.linspace(0.0, 0.3, 61)
    rest = plant.equilibrium({"muscle.command": 2e5})
    command = 2e5 + 3e4 * np.sign(np.sin(30 * t))
    exact = pam.simulate(plant, {"muscle.command": command}, t=t, start=rest)
    found = fit_plant(plant.with_values(mass=4.5), exact, ["mass"], outputs=["x"])
    assert found.values["mass"] == pytest.approx(4.0, rel=1e-4)

"""Models without physics: what they predict, how they are judged, and against what."""

from __future__ import annotations

import multiprocessing
import pickle
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.stats import t as student

import pam_ocp as pam
from pam_ocp.core.errors import FitError, InputError, UnknownNameError
from pam_ocp.fitting import ArxStructure, GruStructure, NarxStructure, SubspaceStructure, choose
from pam_ocp.fitting.dynamic.choice import rmse_ratios
from pam_ocp.fitting.dynamic.networks import NUMPY, NetworkModel, _Arrays
from pam_ocp.fitting.dynamic.structures import Scales, levels_of

STEP = 0.02
WAYS = {"horizon": (0.1, 0.5), "every": 0.1}


def pendulum(seed: int, count: int, samples: int = 100) -> list[pam.Trajectory]:
    """q'' = -30 sin q - q' + u, u held: swings beyond the horizontal are far from linear."""
    random = np.random.default_rng(seed)
    u = np.repeat(random.uniform(-30, 30, (-(-samples // 8), count)), 8, axis=0)[:samples]
    x = np.concatenate([random.uniform(-2, 2, count), np.zeros(count)])

    def rates(_: float, x: np.ndarray, push: np.ndarray) -> np.ndarray:
        q, w = np.split(x, 2)
        return np.concatenate([w, -30 * np.sin(q) - w + push])

    found = [x[:count]]
    for push in u[1:]:
        x = solve_ivp(rates, (0, STEP), x, args=(push,), rtol=1e-6, atol=1e-8).y[:, -1]
        found.append(x[:count])
    q = np.array(found) + 1e-3 * random.standard_normal((samples, count))
    t = STEP * np.arange(samples)
    return [pam.Trajectory(t, {"q": y, "u": v}) for y, v in zip(q.T, u.T, strict=True)]


def arx_process(
    seed: int, count: int, samples: int = 100, noise: float = 0.1, step: float = STEP
) -> list[pam.Trajectory]:
    """A system that is ARX(2): nothing predicts it better than an ARX(2) of much data."""
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        u, y = random.standard_normal(samples), np.zeros(samples)
        e = noise * random.standard_normal(samples)
        for k in range(2, samples):
            y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.4 * u[k] + 0.2 * u[k - 1] + e[k]
        found.append(pam.Trajectory(step * np.arange(samples), {"q": y, "u": u}))
    return found


def two_masses(seed: int, count: int) -> tuple[list[pam.Trajectory], np.ndarray]:
    """Two masses between springs, sampled exactly with forces held; and its poles."""
    a = np.array([[0, 1, 0, 0], [-120, -1, 40, 0], [0, 0, 0, 1], [30, 0, -60, -0.8]], dtype=float)
    b = np.array([[0, 0], [1, 0], [0, 0], [0, 2]], dtype=float)
    whole = expm(STEP * np.block([[a, b], [np.zeros((2, 6))]]))
    random = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        u, x = random.standard_normal((150, 2)), 0.1 * random.standard_normal(4)
        y = np.zeros((150, 2))
        for k in range(150):
            y[k] = x[[0, 2]]
            x = whole[:4, :4] @ x + whole[:4, 4:] @ u[k]
        y += 1e-4 * random.standard_normal(y.shape)
        columns = {"a": 3 + y[:, 0], "b": y[:, 1] - 1, "f": u[:, 0], "g": u[:, 1]}
        found.append(pam.Trajectory(STEP * np.arange(150), columns))
    return found, np.linalg.eigvals(whole[:4, :4])


def small(kind: str, **more: Any) -> NarxStructure | GruStructure:
    given: dict[str, Any] = {"units": 3, "steps": 50, "batch": 8, **WAYS, **more}
    if kind == "narx":
        return NarxStructure(["q"], ["u"], order=3, tries=2, **given)
    return GruStructure(["q"], ["u"], warm_up=0.1, members=2, **given)


# ---- linear ---------------------------------------------------------------------------------
def test_subspace_identification_finds_the_poles_of_two_masses():
    records, poles = two_masses(1, 12)
    ways = {"past": 12, "first": 0.26, **WAYS}  # no run starts before the past is there
    structure = SubspaceStructure(["a", "b"], ["f", "g"], order=4, **ways)
    model = structure.fit(records)
    np.testing.assert_allclose(np.sort_complex(model.poles), np.sort_complex(poles), atol=2e-3)
    others, _ = two_masses(2, 4)
    moved = np.std([r["a"] for r in others])
    assert np.sqrt(structure.losses(model, others).max()) < 0.03 * moved


def test_constants_of_outputs_and_inputs_do_not_matter_to_subspaces():
    records = arx_process(0, 8)
    moved = [pam.Trajectory(r.t, {"q": 7 + 2 * r["q"], "u": 3 - r["u"]}) for r in records]
    structure = SubspaceStructure(["q"], ["u"], order=2, past=6, **WAYS)
    here, there = structure.fit(records), structure.fit(moved)
    np.testing.assert_allclose(np.sort_complex(there.poles), np.sort_complex(here.poles), atol=1e-9)
    four = structure.losses(there, moved) / structure.losses(here, records)
    np.testing.assert_allclose(four, 4.0, rtol=1e-9)


def test_a_delayed_input_is_found_by_its_lag():
    records = [
        pam.Trajectory(r.t, {"q": r["q"], "u": np.concatenate([r["u"][3:], r["u"][:3]])})
        for r in arx_process(0, 8)
    ]
    ways = {"order": 2, "past": 6, **WAYS}
    right, wrong = (SubspaceStructure(["q"], ["u"], lag=n, **ways) for n in (3, 4))
    now, late = (s.losses(s.fit(records), records).mean() for s in (right, wrong))
    assert now < 0.5 * late


@pytest.mark.parametrize(
    ("lag", "metre", "pascal"), [(0, 1.0, 1.0), (2, 1e-3, 1e5), (-2, 1e6, 1e-3)]
)
def test_arx_finds_the_coefficients_of_records_that_begin_in_motion_in_any_unit(lag, metre, pascal):
    """Five samples of the past, and no noise: not one row may hold a sample that is none."""
    a, b = np.array([0.9, -0.3, 0.2, -0.1, 0.05]), np.array([0.1, 0.2, 0.3, 0.1, 0.05])
    random, records = np.random.default_rng(0), []
    for samples in (40, 25, 3):
        y, u = random.uniform(-1, 1, samples), random.uniform(1, 2, samples + 20)
        for k in range(5, samples):
            y[k] = a @ y[k - 5 : k][::-1] + b @ u[k - lag + 6 : k - lag + 11][::-1]
        columns = {"q": metre * y, "u": pascal * u[10 : samples + 10]}
        records.append(pam.Trajectory(STEP * np.arange(samples), columns))
    found = ArxStructure(["q"], ["u"], 5, lag=lag, **WAYS).fit(records).coefficients[:, 0]
    np.testing.assert_allclose(
        found / [*[1.0] * 5, *[metre / pascal] * 5, metre], [*a, *b, 0], atol=1e-9
    )


# ---- networks -------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize(("kind", "factor"), [("narx", 0.5), ("gru", 0.3)])
def test_networks_beat_arx_on_a_pendulum_that_swings_over(kind, factor):
    pytest.importorskip("optax")
    training, held = pendulum(1, 24), pendulum(2, 8)
    network = small(kind, units=16, steps=1500, batch=32)
    arx = ArxStructure(["q"], ["u"], 6, **WAYS)
    own = network.losses(network.fit(training), held)
    other = arx.losses(arx.fit(training), held)
    # over 0.5 s alone: over 0.1 s these short trainings were not clearly better than ARX
    assert rmse_ratios(own, other)[1, 2] < factor


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["narx", "gru"])
def test_networks_do_not_beat_arx_where_it_is_the_truth(kind):
    pytest.importorskip("optax")
    structures = {
        "network": small(kind, steps=300),
        "ARX(2)": ArxStructure(["q"], ["u"], 2, **WAYS),
    }
    choice = choose(structures, arx_process(3, 30), folds=3, seed=1, refit=False)
    ratio = choice.against("ARX(2)")["network"]
    assert np.all(ratio[:, 2] > 0.995)
    assert choice.name == "ARX(2)"


def guessed(structure: NarxStructure | GruStructure, before: int) -> NetworkModel:
    """A model of random weights, which predicts without JAX."""
    random, network = np.random.default_rng(0), structure._network
    weights = [
        {n: 0.1 * random.standard_normal(shape) for n, shape in network.shapes().items()}
        for _ in range(2)
    ]
    scales = tuple(Scales.of([random.standard_normal((9, 1))]) for _ in range(2))
    return NetworkModel(network, tuple(weights), (scales[0], scales[1]), before, (0.0, 0.0), STEP)


@pytest.mark.parametrize("kind", ["narx", "gru"])
def test_losses_are_those_of_free_runs_written_by_hand(kind):
    """Every start, by loops over samples and the formulas as they stand in books."""
    structure = small(kind, horizon=(0.2,), every=0.14, first=0.06)
    model = guessed(structure, 3 if kind == "narx" else 6)
    (record,) = pendulum(6, 1, samples=40)
    (ys, us), h = model.scales, 10
    y = (record["q"] - ys.mean[0]) / ys.size[0]
    u = (record["u"] - us.mean[0]) / us.size[0]
    order = 3 if kind == "narx" else 2
    errors = []
    for start in range(7, 40 - h, 7):  # 0.14 s apart, the first behind 0.06 s
        end = start + h
        runs = []
        for w in model.weights:
            run, memory = {k: y[max(k, 0)] for k in range(-9, start + 1)}, np.zeros(3)
            for k in range(start - model.before + 2, end + 1):
                own = [run[k - 1 - i] for i in range(order)]
                drive = [u[max(k - i, 0)] for i in range(order)]
                # repeated samples beyond the window's begin, as beyond that of the record
                if kind == "gru" and k == start - model.before + 2:
                    own[1] = own[0]
                x = np.concatenate(
                    [own[:1], -np.diff(own) / ys.gain, drive[:1], -np.diff(drive) / us.gain]
                )
                if kind == "narx":
                    hidden = np.tanh(w["in"].T @ x + w["in0"])
                else:
                    gates = 1 / (1 + np.exp(-(w["gates"].T @ np.append(x, memory) + w["gates0"])))
                    keep, reset = gates[:3], gates[3:]
                    new = np.tanh(w["in"].T @ x + w["recalled"].T @ (reset * memory) + w["in0"])
                    hidden = memory = keep * memory + (1 - keep) * new
                if k > start:
                    step = w["linear"].T @ x + w["offset"] + w["out"].T @ hidden
                    run[k] = run[k - 1] + ys.gain[0] * step[0]
            runs.append([run[k] for k in range(start + 1, end + 1)])
        errors.append(ys.size[0] * (np.mean(runs, axis=0) - y[start + 1 : end + 1]))
    by_hand = np.mean(np.square(errors))
    np.testing.assert_allclose(structure.losses(model, [record]), [[by_hand]], rtol=1e-9)


@pytest.mark.parametrize("kind", ["narx", "gru"])
def test_a_model_that_was_kept_is_the_same(kind):
    structure, records = small(kind), pendulum(6, 2, samples=40)
    model = guessed(structure, 6)
    kept = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(structure.losses(kept, records), structure.losses(model, records))
    assert structure.complexity * (2 if kind == "narx" else 1) == sum(
        w.size for member in model.weights for w in member.values()
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["narx", "gru"])
def test_training_gives_the_same_again_and_runs_in_jax_as_in_numpy(kind):
    jax = pytest.importorskip("jax")
    pytest.importorskip("optax")
    structure, records = small(kind), pendulum(5, 3, samples=60)
    model, other = structure.fit(records), small(kind, seed=1).fit(records)
    losses = structure.losses(model, records)
    np.testing.assert_array_equal(structure.losses(structure.fit(records), records), losses)
    assert np.all(structure.losses(other, records) != losses)
    assert len(model.weights) == len(model.held_out) == (1 if kind == "narx" else 2)
    whole = np.concatenate([r["q"] for r in records])
    assert model.scales[0].mean[0] == pytest.approx(whole.mean())
    assert model.scales[0].size[0] == pytest.approx(whole.std())

    way = _Arrays(jax.numpy, jax.lax.scan)
    random = np.random.default_rng(0)
    past = random.standard_normal((model.before, 4, 1)).astype(np.float32)
    inputs = random.standard_normal((model.before + 5, 4, 1)).astype(np.float32)
    gains = tuple(s.gain.astype(np.float32) for s in model.scales)
    weights = {n: w.astype(np.float32) for n, w in model.weights[0].items()}
    here, there = (model.network.run(w, weights, past, inputs, gains) for w in (NUMPY, way))
    np.testing.assert_allclose(here, there, rtol=1e-3, atol=1e-4)


def test_levels_repeat_the_last_sample_beyond_the_ends():
    series = np.arange(4.0).reshape(4, 1, 1)
    np.testing.assert_array_equal(levels_of(np, series, [0, 3], 0, 2).ravel(), [0, 0, 3, 2])
    np.testing.assert_array_equal(levels_of(np, series, [0, 3], -1, 2).ravel(), [1, 0, 3, 3])


# ---- the same runs for all ------------------------------------------------------------------
def test_all_are_judged_by_the_same_runs():
    """Of a model without error the losses are zero; records that are too short count for none."""
    records = [*arx_process(1, 2), *arx_process(2, 1, samples=20)]
    ways: dict[str, Any] = {**WAYS, "first": 0.16}
    arx = ArxStructure(["q"], ["u"], 2, **ways)
    subspace = SubspaceStructure(["q"], ["u"], 2, past=6, **ways)
    empty = [np.isnan(s.losses(s.fit(records), records)) for s in (arx, subspace)]
    np.testing.assert_array_equal(empty[0], empty[1])
    np.testing.assert_array_equal(empty[0], [[False, False], [False, False], [False, True]])


# ---- what cannot be -------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"outputs": "q"}, "outputs = 'q': give names"),
        ({"inputs": []}, r"inputs = \[\]: give names"),
        ({"order": 0}, "order = 0: give a whole number >= 1"),
        ({"horizon": ()}, "horizon is empty"),
        ({"horizon": (0.1, -1.0)}, "horizon = -1"),
        ({"every": 0.0}, "every = 0"),
        ({"first": -0.1}, "first = -0.1 s must be >= 0"),
        ({"units": 0}, "units = 0"),
        ({"tries": 1.5}, "tries = 1.5"),
        ({"rate": 0.0}, "rate = 0"),
        ({"lag": 0.5}, r"lag = 0\.5: give a whole number"),
        ({"seed": -1}, "seed = -1"),
    ],
)
def test_arguments_that_cannot_be_are_named(more, message):
    given = {"outputs": ["q"], "inputs": ["u"], "order": 2, **WAYS, **more}
    refused(message, NarxStructure, **given)
    if not more.keys() & {"units", "tries", "rate", "seed"}:
        refused(message, ArxStructure, **given)


def test_other_arguments_that_cannot_be_are_named():
    with pytest.raises(InputError, match="order = 4: give a whole number from 1 to 3"):
        SubspaceStructure(["q"], ["u"], 4, past=3, **WAYS)
    refused("warm_up = 0", GruStructure, ["q"], ["u"], warm_up=0.0, **WAYS)
    structure = SubspaceStructure(["q"], ["u"], 2, past=6, **WAYS)
    for one in (structure, ArxStructure(["q"], ["u"], 6, **WAYS)):
        model = one.fit(arx_process(0, 3))
        refused("reads 6 of the past", model.predict, np.zeros((1, 5, 1)), np.zeros((1, 9, 1)))
        refused(r"past \(6, 1\)", model.predict, np.zeros((6, 1)), np.zeros((9, 1)))
    refused("no column u", structure.fit, [pam.Trajectory([0, 1, 2], {"q": [0, 1, 2]})])


def test_records_that_cannot_be_are_refused():
    structure = SubspaceStructure(["q"], ["u"], 2, past=6, **WAYS)
    arx = ArxStructure(["q"], ["u"], 4, **WAYS)
    (usual,) = arx_process(0, 1)
    columns = {"q": usual["q"], "u": usual["u"]}
    uneven = usual.t + 0.2 * STEP * np.sin(usual.t / STEP)
    for linear, short in ((structure, 7), (arx, 4)):
        refused("no records", linear.fit, [], error=FitError)
        refused("is longer than", linear.fit, arx_process(0, 2, samples=short), error=FitError)
        model = linear.fit([usual])
        for t in (2 * usual.t, uneven):
            other = pam.Trajectory(t, columns)
            refused("one sampling interval", linear.fit, [usual, other], error=FitError)
            refused("one sampling interval", linear.losses, model, [other], error=FitError)
    pytest.importorskip("optax")
    with pytest.raises(FitError, match=r"longer than first = 0\.1 s"):
        small("narx").fit(arx_process(0, 2, samples=8))


@pytest.mark.parametrize("missing", ["jax", "optax"])
def test_a_missing_library_is_named_with_its_extra(missing, monkeypatch):
    for name in ("jax", "optax"):  # as if the other one were there, wherever the test runs
        monkeypatch.setitem(sys.modules, name, None if name == missing else ModuleType(name))
    structure = NarxStructure(["q"], ["u"], order=2, **WAYS)
    refused(rf"needs {missing}.*pam_ocp\[learn\]", structure.fit, arx_process(0, 2))


@pytest.mark.skipif(sys.platform != "linux", reason="forks")
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning", "ignore::DeprecationWarning")
def test_a_forked_process_says_why_it_does_not_train():
    jax = pytest.importorskip("jax")
    pytest.importorskip("optax")
    structure = small("narx")
    jax.numpy.zeros(2).block_until_ready()
    with (
        ProcessPoolExecutor(1, multiprocessing.get_context("fork")) as pool,
        pytest.raises(FitError, match="executor=0"),
    ):
        pool.submit(structure.fit, arx_process(0, 2)).result()


# ---- ratios ---------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Known:
    """A structure with losses as given by the records."""

    column: str
    complexity: float = 1.0
    alone: bool = False

    def fit(self, records: Sequence[pam.Trajectory], /) -> int:
        return multiprocessing.current_process().pid or 0

    def losses(self, model: int, records: Sequence[pam.Trajectory], /) -> np.ndarray:
        return np.array([[r[self.column][0], 4.0] for r in records])


def known(losses: np.ndarray) -> list[pam.Trajectory]:
    return [pam.Trajectory([0, 1], {"a": [x, x], "b": [y, y]}) for x, y in losses]


def test_ratios_are_those_of_mean_losses_with_bands_of_their_differences():
    losses = np.random.default_rng(0).uniform(1, 2, (12, 2)) * [1, 0.5]
    choice = choose({"A": _Known("a"), "B": _Known("b")}, known(losses), folds=3, seed=0)
    ratios = choice.against("A")
    np.testing.assert_array_equal(ratios["A"], np.ones((2, 3)))
    np.testing.assert_array_equal(ratios["B"][1], [1, 1, 1])
    a, b = losses.T
    ratio = b.mean() / a.mean()
    # the delta method of log(mean b / mean a), by the covariance of both means
    slope = np.array([-1 / a.mean(), 1 / b.mean()])
    error = np.sqrt(slope @ np.cov(losses.T) @ slope / 12)
    half = student.ppf(0.975, 11) * error
    expected = np.sqrt(ratio * np.exp([0, -half, half]))
    np.testing.assert_allclose(ratios["B"][0], expected, rtol=1e-12)
    np.testing.assert_allclose(choice.against("B")["A"][0][[0, 2, 1]], 1 / expected)
    assert f"{expected[0]:.2f} ({expected[1]:.2f}, {expected[2]:.2f})" in str(ratios)
    np.testing.assert_allclose(ratios["the choice"], ratios[choice.name])
    refused("did you mean 'A'", choice.against, "a", error=UnknownNameError)


def test_bands_hold_the_true_ratio_as_often_as_they_say():
    random, held = np.random.default_rng(3), 0
    for _ in range(600):
        hard = random.lognormal(0, 0.6, 60)  # records that are hard for both
        own, other = (hard * size * random.gamma(4, 0.25, 60) for size in (0.64, 1.0))
        _, low, high = rmse_ratios(own[:, None], other[:, None])[0]
        held += low < 0.8 < high
    assert 0.92 < held / 600 < 0.975  # 95 %: sd of the share 0.9 %


def test_records_that_one_cannot_judge_do_not_count():
    own, other = np.array([[1.0, np.nan], [3.0, np.nan]]), np.array([[2.0, 1.0], [np.nan, 1.0]])
    assert np.all(np.isnan(rmse_ratios(own, other)))
    three = rmse_ratios(np.array([[1.0], [3.0], [9.0]]), np.array([[4.0], [12.0], [np.nan]]))
    np.testing.assert_allclose(three, [[0.5, 0.5, 0.5]])


def test_what_starts_threads_is_fitted_here_whatever_the_number_of_workers():
    here = multiprocessing.current_process().pid
    both = {"A": _Pid("a"), "B": _Pid("b", alone=True)}
    losses = np.arange(12.0).reshape(6, 2)
    found = choose(both, known(losses), folds=3, seed=0, executor=2, refit=False)
    assert set(found["B"].losses[:, 0]) == {float(here or 0)}
    assert float(here or 0) not in found["A"].losses[:, 0]


class _Pid(_Known):
    def losses(self, model: int, records: Sequence[pam.Trajectory], /) -> np.ndarray:
        return np.array([[float(model)] for _ in records])

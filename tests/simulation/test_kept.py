"""Numbers kept of many simulations: words, rows, statistics, folders, early stops."""

import os
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.simulation.batches import BATCH, Batch, batches
from pam_ocp.simulation.reducers import parsed
from pam_ocp.simulation.stored import part_of

T = np.linspace(0.0, 1.0, 41)


def spring() -> pam.Plant:
    """m x'' = u - d x' - k x, and its own outputs."""
    plant = pam.Plant("spring", "a mass on a spring")
    x, v = plant.state("x", unit="m", start=0.0), plant.state("v", unit="m/s")
    u = plant.input("push", unit="N", start=1.0, max=100.0)
    m, d = plant.parameter("mass", 1.0, min=0.1), plant.parameter("damping", 1.0)
    k = plant.parameter("spring.rate", 20.0)
    plant.der(x, v)
    plant.der(v, (u - d * v - k * x) / m)
    plant.output("spring.force", k * x, unit="N")
    return plant


def masses(count: int) -> list[dict]:
    return [{"parameters": {"mass": 0.5 + i / count}} for i in range(count)]


def words(text: str, columns: dict[str, list], t=None, **units: str) -> float:
    variables = [pam.core.variables.Variable(n, "output", units.get(n, "1")) for n in columns]
    found = parsed("keep['y']", text, variables)
    times = np.arange(len(next(iter(columns.values()))), dtype=float) if t is None else t
    return float(found(times, lambda n: np.array([columns[n]], float), 1)[0])


STEP = {"y": [0.0, 2.0, 12.0, 9.0, 10.5, 10.0]}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("y.final", 10.0),
        ("final(y)", 10.0),
        ("y.initial", 0.0),
        ("max(y)", 12.0),
        ("y.min", 0.0),
        ("integral(y)", 38.5),
        ("y.mean", 7.7),
        ("crossing(y, 7)", 1.5),
        ("crossing(y, 11, falling)", 2 + 1 / 3),
        ("crossing(y, level=9.5, direction='rising')", 1.75),
        ("overshoot(y)", 0.2),
        ("overshoot(y, 8)", 0.5),
        ("settling(y, band=0.07)", 3 + 0.3 / 1.5),
        ("settling(y, 10, 0.5)", 1.3),
        ("max(y) - 2 * min(y) + 1", 13.0),
        ("max(abs(y - 10)) ** 2", 100.0),
        ("-y.final / 4", -2.5),
    ],
)
def test_words_give_the_number_by_hand(text, expected):
    assert words(text, STEP) == pytest.approx(expected, rel=1e-12)


def test_what_never_happens_is_nan_and_quantities_have_units():
    assert np.isnan(words("crossing(y, 100)", STEP))
    assert np.isnan(words("settling(y, 0, 0.01)", STEP))
    assert np.isnan(words("overshoot(y)", {"y": [1.0, 2.0, 1.0]}))
    assert words("crossing(y, '7000 mm')", STEP, y="m") == pytest.approx(1.5)
    assert words("settling(y, 10, '500 mm')", STEP, y="m") == pytest.approx(3 + 0.5 / 1.5)
    square = {"y": [3.0, 3.0, 3.0]}
    assert words("rms(-y)", square) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("y", "is a signal, not a number"),
        ("z.final", "unknown signal in keep.*'z'.*y"),
        ("y.finale", "unknown reducer.*final"),
        ("peak(y)", "unknown reducer"),
        ("crossing(y)", "crossing needs level"),
        ("crossing(y, 1, upwards)", "direction 'upwards' is none of rising"),
        ("crossing(y, '1 bar')", "measures something else"),
        ("max(3)", "max wants a signal"),
        ("max(y, 3)", "0 further arguments at most"),
        ("y.max if y.min else 0", "not among what may be said"),
        ("__import__('os').system('true')", "unknown reducer"),
        ("y[0]", "not among what may be said"),
        ("max(y", "cannot be read"),
        ("(" * 500 + "1" + ")" * 500, "cannot be read|too deeply"),
        ("'3 mm'", "names no signal"),
    ],
)
def test_other_words_are_refused_in_one_sentence(text, match):
    refused(match, words, text, STEP, y="m")


KEEP = {
    "x_end": "x.final",
    "peak": "max(spring.force)",
    "own": lambda motion: motion["x"][-1] * motion["spring.force"][-1],
    "per_mass": "integral(push) / mass",
}


@pytest.mark.parametrize("compiled", [True, False])
def test_numbers_are_those_of_the_single_motions(compiled):
    cases = masses(7)
    cases[2] = {"parameters": {"mass": 2.0}, "inputs": {"push": 3.0}, "start": {"x": 0.01}}
    cases[3] = {"inputs": {"push": lambda t: 1 + t}}
    kept = pam.simulate_many(
        spring(), cases, keep=KEEP, t=T, compiled=compiled, executor=0, interpolation="linear"
    )
    for i, case in enumerate(cases):
        alone = pam.simulate(spring(), t=T, **case)
        mass = case.get("parameters", {}).get("mass", 1.0)
        assert kept["x_end"][i] == pytest.approx(alone["x"][-1], rel=1e-8)
        assert kept["peak"][i] == pytest.approx(alone["spring.force"].max(), rel=1e-8)
        assert kept["own"][i] == pytest.approx(20 * alone["x"][-1] ** 2, rel=1e-8)
        push = np.trapezoid(alone["push"], T)
        assert kept["per_mass"][i] == pytest.approx(push / mass, rel=1e-12)
    assert np.isnan(kept["mass"][3])
    assert len(kept) == 7


def test_cases_that_differ_in_numbers_only_are_stepped_side_by_side_to_the_tolerance():
    cases = [
        {"parameters": {"mass": m}, "inputs": {"push": p}, "start": {"v": v}}
        for m, p, v in np.random.default_rng(1).uniform(0.5, 3.0, (60, 3))
    ]
    kept = pam.simulate_many(spring(), cases, keep={"x": "x.final"}, t=T, compiled=True, executor=0)
    for i, case in enumerate(cases):  # in closed form
        m, p, v = case["parameters"]["mass"], case["inputs"]["push"], case["start"]["v"]
        a, w = 0.5 / m, np.sqrt(20.0 / m - 0.25 / m**2)
        x = p / 20 + np.exp(-a) * (-p / 20 * np.cos(w) + (v - a * p / 20) / w * np.sin(w))
        assert kept["x"][i] == pytest.approx(x, abs=1e-10)
    alone = pam.simulate_many(
        spring(), cases[17:18], keep={"x": "x.final"}, t=T, compiled=True, executor=0
    )
    assert alone["x"][0] == kept["x"][17]  # the same bits, whatever stands beside it


def test_a_failing_case_is_told_of_and_costs_no_other(tmp_path):
    cases = masses(5)
    cases[1] = {"parameters": {"mass": -1.0}}
    cases[3] = {"parameters": {"weight": 1.0}}

    def picky(motion):
        if motion["x"][-1] > 0.05:
            raise ArithmeticError("too far")
        return 1.0

    said = {"keep": {"x_end": "x.final", "own": picky}, "t": T, "compiled": True, "executor": 0}
    for place in ({}, {"into": tmp_path / "runs"}):
        kept = pam.simulate_many(spring(), cases, **said, **place)
        failures = kept.failures
        assert {1, 3} <= set(failures)
        assert "mass: start = -1" in str(failures[1])
        assert "weight" in str(failures[3])
        assert any("too far" in str(e) for e in failures.values())
        assert np.isnan(kept["x_end"][sorted(failures)]).all()
        assert np.isfinite(kept["x_end"][[i for i in range(5) if i not in failures]]).all()


def content(folder) -> list[bytes]:
    return [p.read_bytes() for p in sorted((folder / "cases").rglob("*.parquet"))]


SAID = {"keep": {"x_end": "x.final", "peak": "max(spring.force)"}, "t": T, "compiled": True}


@pytest.fixture
def needs_arrow():
    pytest.importorskip("pyarrow")


def test_a_folder_has_the_same_bits_by_any_way(tmp_path, needs_arrow):
    cases = masses(700)
    whole = pam.simulate_many(spring(), cases, into=tmp_path / "a", chunk=300, executor=0, **SAID)
    two = pam.simulate_many(
        spring(), iter(cases), into=tmp_path / "b", chunk=300, executor=2, **SAID
    )
    assert content(tmp_path / "a") == content(tmp_path / "b")
    part = part_of(tmp_path / "b", 1)
    part.write_bytes(part.read_bytes()[:-30])  # cut short
    part_of(tmp_path / "b", 2).unlink()
    again = pam.simulate_many(spring(), cases, into=tmp_path / "b", executor=0, **SAID)
    assert content(tmp_path / "a") == content(tmp_path / "b")
    read = pam.simulation.KeptNumbers.read(tmp_path / "b")
    assert str(whole).split("\n")[1:] == str(again).split("\n")[1:] == str(two).split("\n")[1:]
    assert str(read) == str(again)
    memory = pam.simulate_many(spring(), cases, executor=0, **SAID)
    assert np.array_equal(memory["x_end"], read["x_end"])
    assert np.array_equal(read["mass"], [c["parameters"]["mass"] for c in cases])
    frame = read.frame()
    assert list(frame.columns) == ["case", "mass", "x_end", "peak", "error"]
    assert len(frame) == 700
    with pytest.raises(InputError, match="other arguments"):
        pam.simulate_many(
            spring(), cases, into=tmp_path / "b", **{**SAID, "keep": {"x_end": "x.max"}}
        )


KILLED = """
import os, signal, sys
sys.path[:0] = [sys.argv[3], os.path.dirname(sys.argv[3])]
from test_kept import SAID, masses, spring
import pam_ocp as pam

def progress(done, count):
    if done >= int(sys.argv[2]):
        os.kill(os.getpid(), signal.SIGKILL)

place = {"into": sys.argv[1], "chunk": 500, "executor": 2, "progress": progress}
pam.simulate_many(spring(), masses(2000), **place, **SAID)
"""


@pytest.mark.slow
def test_killed_twice_and_gone_on_with_it_is_the_same_bits(tmp_path, needs_arrow):
    script, here = tmp_path / "run.py", os.path.dirname(__file__)
    script.write_text(KILLED)
    run = [sys.executable, str(script), str(tmp_path / "runs")]
    kept = {}
    for limit, parts in (("700", 1), ("1300", 2)):
        assert subprocess.run([*run, limit, here]).returncode == -signal.SIGKILL
        kept |= {p: p.stat().st_ino for p in (tmp_path / "runs").rglob("*.parquet")}
        assert len(kept) == parts
    subprocess.run([*run, "9999", here], check=True)
    assert {p: p.stat().st_ino for p in kept} == kept  # what was whole is not written again
    pam.simulate_many(spring(), masses(2000), into=tmp_path / "one", chunk=500, executor=0, **SAID)
    assert content(tmp_path / "runs") == content(tmp_path / "one")


def test_statistics_are_those_of_numpy_without_rows():
    cases = masses(900)
    kept = pam.simulate_many(spring(), cases, executor=0, **SAID)
    without = pam.simulate_many(spring(), cases, executor=0, rows=False, **SAID)
    values, found = kept["peak"], without.statistics["peak"]
    assert without.rows is None
    assert found.count == 900
    assert found.mean == pytest.approx(values.mean(), rel=1e-12)
    assert found.std == pytest.approx(values.std(ddof=1), rel=1e-10)
    assert (found.min, found.max) == (values.min(), values.max())
    assert found.quantile(0.3) == pytest.approx(np.quantile(values, 0.3), rel=1e-3)
    with pytest.raises(InputError, match="rows=False"):
        without["peak"]


@pytest.mark.parametrize("draw", ["normal", "lognormal"])
def test_quantiles_of_many_numbers_are_good_to_a_thousandth_of_the_cases(draw):
    values = getattr(np.random.default_rng(3), draw)(size=200_000)
    found = pam.simulation.Statistic()
    for part in np.array_split(values, 777):
        found.add(part)
    rank = np.sort(values)
    for share in (0.001, 0.025, 0.5, 0.9, 0.999):
        there = np.searchsorted(rank, found.quantile(share)) / len(rank)
        assert there == pytest.approx(share, abs=2e-3 * np.sqrt(share * (1 - share)))
    assert found.quantile(0) == rank[0]
    assert found.quantile(1) == rank[-1]


def test_it_stops_once_the_interval_of_the_mean_is_narrow_enough(tmp_path, needs_arrow):
    rng = np.random.default_rng(0)
    cases = [{"parameters": {"mass": m}} for m in rng.uniform(0.5, 3.0, 3000)]
    everything = pam.simulate_many(spring(), cases, executor=0, **SAID)
    width = 2.2 * everything.statistics["x_end"].half_width
    stopped = pam.simulate_many(spring(), cases, executor=0, until={"x_end": width}, **SAID)
    assert stopped.stopped
    assert not everything.stopped
    assert len(stopped) < 3000
    assert len(stopped) % BATCH == 0
    values = everything["x_end"]
    n = next(
        n for n in range(BATCH, 3000, BATCH) if 1.96 * values[:n].std(ddof=1) / np.sqrt(n) <= width
    )
    assert len(stopped) == n
    for executor in (2, 0):  # the second run finds the parts of the first
        kept = pam.simulate_many(
            spring(),
            cases,
            executor=executor,
            until={"x_end": width},
            chunk=400,
            into=tmp_path / "runs",
            **SAID,
        )
        assert len(kept) == n
        assert np.array_equal(kept["x_end"], values[:n])


def test_sobol_indices_of_a_known_function(tmp_path, needs_arrow):
    pytest.importorskip("SALib")
    ranges = {"mass": (1.0, 1.000001), "damping": (1.0, 1.000001), "spring.rate": (10.0, 20.0)}
    cases = pam.simulation.SobolCases(ranges, 128, seed=1)
    many = pam.simulate_many(
        spring(), cases, keep={"k": "0 * x.final + spring.rate"}, t=T, executor=0, rows=False
    )
    found = many.sobol("k")
    assert found.first["spring.rate"][0] == pytest.approx(1.0, abs=0.1)
    assert abs(found.total["mass"][0]) < 1e-6
    said = {"keep": {"k": "0 * x.final + spring.rate"}, "t": T, "executor": 0}
    for _ in range(2):  # the second run finds what the first one wrote, less a part
        stored = pam.simulate_many(spring(), cases, into=tmp_path / "runs", chunk=300, **said)
        assert stored.sobol("k") == found
        part_of(stored.folder, 1).unlink()
    # Ishigami's function has indices in closed form
    cases = pam.simulation.SobolCases(dict.fromkeys("abc", (-np.pi, np.pi)), 4096, seed=2)
    a, b, c = np.array([list(x["parameters"].values()) for x in cases]).T
    found = cases.indices(np.sin(a) + 7 * np.sin(b) ** 2 + 0.1 * c**4 * np.sin(a))
    for name, first, total in (("a", 0.3139, 0.5576), ("b", 0.4424, 0.4424), ("c", 0.0, 0.2437)):
        assert found.first[name][0] == pytest.approx(first, abs=0.03)
        assert found.total[name][0] == pytest.approx(total, abs=0.03)
    with pytest.raises(InputError, match="1 of 20480 cases have no number"):
        cases.indices(np.where(np.arange(20480) == 7, np.nan, a))


def killer(t: float) -> float:
    os.kill(os.getpid(), signal.SIGKILL)
    return t


def test_a_case_that_kills_its_worker_is_the_only_one_lost():
    cases = masses(40)
    cases[17] = {"inputs": {"push": killer}}
    kept = pam.simulate_many(spring(), cases, keep={"x": "x.final"}, t=T, executor=2)
    assert list(kept.failures) == [17]
    assert np.isfinite(np.delete(kept["x"], 17)).all()


def test_columns_of_parameters_are_numbers_by_their_own_names():
    """Whatever units and names the cases have; a case that is none fails alone."""
    plant = spring()
    plant.parameter("mass.of_load", 1.0, unit="kg")
    given = [{"mass.of_load": "500 g"}, {"mass_of_load": 2.0}, {"mass.of_load": "1 m"}]
    cases = [{"parameters": each} for each in given]
    kept = pam.simulate_many(plant, cases, keep={"x": "0 * x.final"}, t=T, executor=0)
    assert kept["mass.of_load"] == pytest.approx([0.5, 2.0, np.nan], nan_ok=True)
    assert "mass_of_load" not in kept.frame()
    assert list(kept.failures) == [2]


@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"keep": {}}, "keep = {}"),
        ({"keep": {"mass": "x.final"}}, "'mass' is a parameter of case 0"),
        ({"keep": {"x": 3}}, "give words such as"),
        ({"keep": {"case": "x.final"}}, "no name for a column"),
        ({"keep": {"x": "y.final"}}, "unknown signal in keep.*known: .*spring.force"),
        ({"keep": {"x": "x.final"}, "until": {"y": 1.0}}, "unknown name in until"),
        ({"keep": {"x": "x.final"}, "until": {"x": 0.0}}, "until"),
        ({"until": {"x": 1.0}}, "go with keep"),
    ],
)
def test_what_cannot_be_kept_is_said(given, match):
    refused(match, pam.simulate_many, spring(), masses(2), t=T, **given)


@pytest.mark.parametrize("pool", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_words_travel_to_any_executor(pool):
    cases = masses(12)
    with pool(2) as executor:
        kept = pam.simulate_many(spring(), cases, executor=executor, **SAID)
    assert not kept.failures
    assert np.array_equal(kept["peak"], pam.simulate_many(spring(), cases, **SAID)["peak"])


def test_batches_hold_numbers_as_arrays_and_give_the_cases_back():
    cases = [*masses(BATCH), {"parameters": {"mass": 1.0}}, {"inputs": {"push": (T, T)}}]
    first, second = batches(iter(cases))
    assert first.values.shape == (BATCH, 1)
    assert [first.case(i) for i in range(BATCH)] == cases[:BATCH]
    assert isinstance(second, Batch)
    assert second.cases == tuple(cases[BATCH:])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["joblib", "executorlib"])
def test_local_executors_of_joblib_and_executorlib_give_the_same_bits(kind):
    if kind == "joblib":
        from joblib.externals.loky import get_reusable_executor

        executor = get_reusable_executor(2)
    else:
        executorlib = pytest.importorskip("executorlib", reason="executorlib is not installed")
        executor = executorlib.SingleNodeExecutor(max_workers=2, block_allocation=True)
    with executor:
        there = pam.simulate_many(spring(), masses(300), executor=executor, **SAID)
    here = pam.simulate_many(spring(), masses(300), executor=0, **SAID)
    for name in ("x_end", "peak", "mass"):
        assert np.array_equal(there[name], here[name])

"""benchmarks/run.py: what became slower is seen, whatever its figure is called."""

import importlib.util
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def run():
    sys.path.insert(0, str(FOLDER))
    try:
        spec = importlib.util.spec_from_file_location("benchmark_run", FOLDER / "run.py")
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        yield module
    finally:
        sys.path.remove(str(FOLDER))


def stored(figures):
    return {"figures": {n: {"median": v, "values": [v, 1.1 * v]} for n, v in figures.items()}}


def test_a_fifth_more_is_told_of_every_figure_that_has_a_goal(run):
    """But of those by the clock and of worst steps, which scatter."""
    before = dict.fromkeys(run.WANTED, 1.0)
    worse = {n: 1.25 if sign == "<=" else 0.8 for n, (sign, _) in run.WANTED.items()}
    told = run.slower(stored(before) | {"missing": {}}, stored(worse) | {"missing": {}})
    silent = {n for n in before if not any(t.startswith(f"{n}: ") for t in told)}
    assert silent == {n for n in before if "wall" in n or "worst" in n}


def test_less_than_a_fifth_others_and_what_is_better_are_not_told(run):
    before = {"fit [s]@60": 1.0, "SciPy LM [s]@60": 1.0, "plan, plain CasADi [s]@50": 1.0}
    after = {"fit [s]@60": 1.15, "SciPy LM [s]@60": 2.0, "plan, plain CasADi [s]@50": 2.0}
    assert run.slower(stored(before), stored(after) | {"missing": {}}) == []
    assert run.slower(stored(before), stored({"fit [s]@60": 0.5}) | {"missing": {}}) == []


def test_a_group_that_fails_where_it_did_not_is_told(run):
    before = stored({}) | {"missing": {"cases": "no end in 900 s"}}
    after = stored({}) | {"missing": {"cases": "no end in 900 s", "start": "ImportError"}}
    assert run.slower(before, after) == ["start: not measured any more: ImportError"]

"""Verbs that loop over cases: the same bits wherever the cases are worked on."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from conftest import dask_client, refused

import pam_ocp as pam
from pam_ocp.core.errors import OutOfTime
from pam_ocp.core.stop import TimeIsUp
from pam_ocp.fitting import fit_forces
from pam_ocp.fitting.tables.force_table import ForceTable

# on meshes as coarse as these
pytestmark = pytest.mark.filterwarnings("ignore:the plan of .* is not verified")


@contextmanager
def place(where: Any) -> Iterator[Any]:
    """An executor by its kind."""
    if where == "dask":
        with dask_client() as client:
            yield client
    elif isinstance(where, str):
        kinds: dict[str, Callable[[int], Executor]] = {
            "threads": ThreadPoolExecutor,
            "pool": ProcessPoolExecutor,
        }
        with kinds[where](2) as executor:
            yield executor
    else:
        yield where


def cells(name: str, seed: int) -> ForceTable:
    """Measured with normal errors of 5 N."""
    p, kappa = (g.ravel() for g in np.meshgrid(np.linspace(1e5, 6e5, 6), np.linspace(0, 0.2, 8)))
    force = np.asarray(pam.muscle(name).force(p, kappa)).ravel()
    force = force + np.random.default_rng(seed).normal(0, 5.0, force.size)
    return ForceTable(p, kappa, force, rest_length=0.3)


def starts(executor: Any) -> list[Any]:
    """Where each start of a plan ended, and the plan."""
    plant = pam.HangingLoad("DMSP-20-400N", 20.0, feed=pam.feeds.SpoolValve())
    ways = {"method": pam.Collocation(8, 3), "tolerance": None, "starts": 4}
    plan = pam.plan(plant, [{"x": 0.02}, {"x": 0.04}], executor=executor, **ways)
    ends = [(s["objective"], s["iterations"], s["status"]) for s in plan.statistics["starts"]]
    assert len(ends) == 4
    return [ends, plan.duration, plan.trajectory.array(["x", "v"])]


def planners(executor: Any) -> list[Any]:
    """The same by a planner."""
    plant = pam.HangingLoad("DMSP-20-400N", 20.0, feed=pam.feeds.SpoolValve())
    planner = pam.Planner(plant, [{"x": 0.02}, {"x": 0.04}], method=pam.Collocation(8, 3))
    plan = planner({"mass": 22.0}, tolerance=None, starts=3, executor=executor)
    return [len(plan.statistics["starts"]), plan.duration, plan.trajectory["x"]]


def profiles(executor: Any) -> list[Any]:
    """Of a censored fit (each end is walked to) and of a joint one."""
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.3)
    hold = {"a3": -33.0}
    alone = pam.fit_force(table, fixed=hold, censored=True)
    found: list[Any] = [alone.profile_interval(n, executor=executor) for n in alone.free[:2]]
    tables = {"20": cells("DMSP-20-200N", 1), "10": cells("DMSP-10-250", 2)}
    joint = fit_forces(tables, shared=["a3"], errors="independent")
    found.append(joint.profile_interval("a3", executor=executor))
    assert found[0][0] < found[0][1]
    return found


def profiles_at_once(executor: Any) -> list[Any]:
    """Of a law with four nonlinear coefficients on a dozen cells: two have ends far away."""
    table = cells("DMSP-20-200N", 1).subset(np.arange(48) % 4 == 0)
    fit = pam.fit_force(table, "three-element-two-slopes")
    found = fit.intervals(executor=executor)
    assert found["k1"][0] < found["k1"][1]
    return [found, fit.open_ends()]


def campaigns(executor: Any) -> list[Any]:
    """Muscles, and laws with each length left out."""
    tables = {f"DMSP-20-{n}": cells("DMSP-20-200N", n) for n in (200, 300)}
    lengths = {"200": 0.2, "300": 0.3}
    found = fit_forces(
        tables,
        rest_length=lengths,
        diameter=0.02,
        candidates=("six-parameter", "five-parameter"),
        executor=executor,
    )
    (group,) = found.lengths
    return [found.table(), [dict(law.left_out) for law in group.laws]]


def loads(executor: Any) -> list[Any]:
    """Two loads, one of which cannot be carried."""
    study = pam.load_study("DMSP-20-400N", [5.0, 500.0], [2e5], duration=0.5, executor=executor)
    assert [np.isnan(c.position) for c in study.cases] == [False, True]
    return [str(study), [c.overshoot for c in study.cases]]


def modes(executor: Any) -> list[Any]:
    """Over load and place."""
    plant = pam.HangingLoad("DMSP-20-400N")
    axes = {"mass": [5.0, 10.0], "x": [0.03, 0.04]}
    found = pam.control.mode_map(plant, axes, executor=executor)
    assert (found.frequency > 0).all()
    return [found.frequency, found.damping, found.stable]


def designs(executor: Any) -> list[Any]:
    """Of six further cells."""
    fit = pam.fit_force(cells("DMSP-20-200N", 1))
    found = pam.experiments.design_cells(fit, 6, executor=executor)
    return [found.cells.pressure, found.cells.contraction, found.efficiency]


LONG = [starts, profiles, loads]
SHORT = [planners, profiles_at_once, campaigns, modes, designs]
VERBS = [*LONG, *SHORT]
PLACES = [("threads", LONG), (2, VERBS), ("pool", VERBS), ("dask", VERBS)]


def same(one: Any, two: Any) -> None:
    np.testing.assert_equal(one, two)


@pytest.fixture(scope="module")
def here() -> dict[str, Any]:
    """What a plain loop gives."""
    return {}


@pytest.mark.parametrize(
    ("where", "verbs"),
    [("threads", SHORT), *(pytest.param(*p, marks=pytest.mark.slow) for p in PLACES)],
    ids=["threads", "threads-long", "processes", "pool", "dask"],
)
def test_verbs_give_the_same_bits_wherever_their_cases_are(
    where: Any, verbs: list[Callable[[Any], Any]], here: Any
) -> None:
    with place(where) as executor:
        for verb in verbs:
            if verb.__name__ not in here:
                here[verb.__name__] = verb(0)
            same(verb(executor), here[verb.__name__])


@pytest.mark.parametrize("verb", VERBS, ids=lambda verb: verb.__name__)
def test_what_is_no_executor_is_refused_by_name(verb: Callable[[Any], Any]) -> None:
    refused("executor is a str: give a number of processes", verb, "everywhere")


def test_starts_of_a_plan_are_the_same_unasked() -> None:
    same(starts(None), starts(0))


@pytest.mark.parametrize("where", [2, "threads", "pool"])
def test_a_signal_ends_starts_wherever_they_are(where: Any) -> None:
    """The first start is tried here; the press comes when the others are under way."""
    plant = pam.HangingLoad("DMSP-20-400N", 20.0, feed=pam.feeds.SpoolValve())
    planner = pam.Planner(plant, [{"x": 0.02}, {"x": 0.04}], method=pam.Collocation(60, 4))
    press = threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT))
    with place(where) as executor:
        press.start()
        with pytest.raises(KeyboardInterrupt):
            planner(starts=12, executor=executor)


def test_a_time_limit_keeps_what_starts_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time is up behind the second of the starts that are handed out."""
    from pam_ocp.core import cases

    whole = cases.ending

    def broken_off(*arguments: Any, **options: Any) -> Iterator[tuple[int, Any]]:
        ended = whole(*arguments, **options)
        yield next(ended)
        yield next(ended)
        raise TimeIsUp

    monkeypatch.setattr(cases, "ending", broken_off)
    plant = pam.HangingLoad("DMSP-20-400N", 20.0, feed=pam.feeds.SpoolValve())
    planner = pam.Planner(plant, [{"x": 0.02}, {"x": 0.04}], method=pam.Collocation(8, 3))
    plan = planner(tolerance=None, starts=6, executor=0)
    assert 3 <= len(plan.statistics["starts"]) < 6  # the best may have been followed once more


@pytest.mark.parametrize("where", [0, 2])
def test_a_time_limit_ends_loads(where: int) -> None:
    with pytest.raises(OutOfTime):
        pam.load_study("DMSP-20-400N", executor=where, time_limit=0.05)

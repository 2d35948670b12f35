"""Loops over cases: the same everywhere, and what becomes of them when workers are lost."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp import InputError, PamError
from pam_ocp.core.cases import ending
from pam_ocp.core.stop import LOCK, verb


def drawn(seed: int) -> np.ndarray:
    """Bits that depend on the case alone."""
    return np.sin(np.random.default_rng(seed).standard_normal(3))


def picky(case: Any) -> Any:
    if case == 5:
        raise ValueError("five")
    if case == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid() if case == "who" else case


def slowly(folder: str, case: int) -> tuple[int, int]:
    """Takes its time, and tells who did it."""
    Path(folder, f"{case}.{os.getpid()}").touch()
    time.sleep(0.05)
    return case, os.getpid()


def within(case: int) -> list[int]:
    return pam.each(abs, [-case, case])


SERIAL = [drawn(seed) for seed in range(60)]


@pytest.mark.parametrize("where", [None, 0, 1, 2, "threads", "processes"])
def test_a_loop_gives_the_same_bits_wherever_it_runs(where: Any) -> None:
    pools = {"threads": ThreadPoolExecutor, "processes": ProcessPoolExecutor}
    if where in pools:
        with pools[where](2) as pool:
            found = pam.each(drawn, range(60), executor=pool)
    else:
        found = pam.each(drawn, range(60), executor=where, chunk=7)
    assert np.array_equal(found, SERIAL)


@pytest.mark.parametrize("where", [0, 2])
def test_the_error_of_a_case_is_its_result(where: int) -> None:
    found = pam.each(picky, range(9), executor=where)
    assert found[:5] == [0, 1, 2, 3, 4]
    assert isinstance(found[5], ValueError)
    assert found[6:] == [6, 7, 8]


@pytest.mark.parametrize("pool", [False, True])
def test_a_case_that_kills_its_workers_is_told_from_all_others(pool: bool) -> None:
    cases = [*range(6, 30), "kill", *range(30, 50)]
    if pool:
        with ProcessPoolExecutor(2) as executor:
            found = pam.each(picky, cases, executor=executor, chunk=4)
    else:
        found = pam.each(picky, cases, executor=2, chunk=4)
    assert isinstance(found[24], PamError)
    assert "case 24 ended its worker process 2 times (SIGKILL)" in str(found[24])
    assert found[:24] + found[25:] == [*range(6, 30), *range(30, 50)]


def test_short_work_stays_here() -> None:
    assert set(pam.each(picky, ["who"] * 50)) == {os.getpid()}


def test_work_for_seconds_is_shared_unasked(tmp_path: Path) -> None:
    found = pam.each(partial(slowly, str(tmp_path)), range(40))
    assert [case for case, _ in found] == list(range(40))
    if len(os.sched_getaffinity(0)) > 1:
        assert len({pid for _, pid in found} - {os.getpid()}) > 1
    assert len(list(tmp_path.iterdir())) == 40  # nothing twice


def test_what_cannot_travel_is_done_here() -> None:
    cases = [lambda: os.getpid(), 1, lambda: os.getpid()]
    found = pam.each(lambda case: case() if callable(case) else os.getpid(), cases, executor=1)
    assert found[0] == found[2] == os.getpid()
    found = pam.each(len, [[1], (2, 3)], executor=2)
    assert found == [1, 2]
    with ProcessPoolExecutor(1) as pool, pytest.raises(InputError, match="does not travel"):
        pam.each(lambda case: case, [1], executor=pool)


def test_a_result_that_cannot_travel_is_an_error() -> None:
    made = pam.each(partial(getattr, threading), ["Lock", "main_thread"], executor=1)
    assert made[0] is threading.Lock
    opened = pam.each(open, [os.devnull], executor=1)
    assert isinstance(opened[0], PamError)
    assert "does not come back" in str(opened[0])


def test_a_verb_that_waits_lets_threads_take_their_turns() -> None:
    @verb
    def outer() -> list[Any]:
        with ThreadPoolExecutor(2) as pool:
            return pam.each(drawn, range(8), executor=pool)

    assert np.array_equal(outer(), SERIAL[:8])
    assert LOCK.acquire(blocking=False)  # as it was
    LOCK.release()


def test_a_worker_starts_no_workers_of_its_own() -> None:
    assert pam.each(within, [1, 2], executor=2) == [[1, 1], [2, 2]]


def test_cases_are_taken_as_there_are_workers_for_them() -> None:
    taken = 0

    def cases() -> Iterator[int]:
        nonlocal taken
        for case in range(10_000):
            taken += 1
            yield case

    ended = ending(abs, cases(), executor=2, chunk=5)
    for _ in range(20):
        next(ended)
    ended.close()
    assert taken < 100


def test_progress_is_told() -> None:
    told: list[tuple[int, int | None]] = []
    pam.each(abs, range(10), executor=0, chunk=4, progress=lambda *a: told.append(a))
    assert told == [(4, 10), (8, 10), (10, 10)]
    pam.each(abs, iter(range(3)), executor=0, progress=lambda *a: told.append(a))
    assert told[-1] == (3, None)


@pytest.mark.parametrize("wrong", ["two", 1.5, True, -1])
def test_what_is_no_executor_is_refused(wrong: Any) -> None:
    refused("executor", pam.each, abs, [1], executor=wrong)


@pytest.mark.slow
def test_a_cluster_of_which_workers_are_killed_gives_all_the_same(tmp_path: Path) -> None:
    """One worker is ended from outside, and one case ends every worker that takes it."""
    distributed = pytest.importorskip("distributed")
    dask = pytest.importorskip("dask")
    cases: list[Any] = [*range(100, 150)]

    def kill(done: int, _: Any) -> None:
        nonlocal killed
        if not killed and done >= 10:
            killed = next(iter(pids.values()))
            os.kill(killed, signal.SIGKILL)

    killed = 0
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 1}),
        distributed.LocalCluster(
            n_workers=3, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        pids = client.run(os.getpid)
        work = partial(slowly, str(tmp_path))
        found = pam.each(work, cases, executor=client, chunk=2, progress=kill)
        assert [case for case, _ in found] == cases
        assert killed
        found = pam.each(picky, [*range(10, 20), "kill", *range(20, 25)], executor=client, chunk=3)
    assert isinstance(found[10], PamError)
    assert "case 10 was lost with its worker" in str(found[10])
    assert found[:10] + found[11:] == [*range(10, 20), *range(20, 25)]

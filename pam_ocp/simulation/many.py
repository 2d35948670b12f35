"""simulate_many: the same simulation under many parameters, starts or inputs, on any executor."""

from __future__ import annotations

import itertools
import pickle
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np

from ..core.errors import InputError, PamError
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from .simulator import simulate

__all__ = ["ManySimulations", "draws", "simulate_many", "sweep"]

Case = Mapping[str, Any]
_CASADI = threading.Lock()
"""CasADi's expressions are not safe among threads: a process works on one task at a time."""
CASE_KEYS = ("parameters", "start", "inputs")


@dataclass(frozen=True)
class ManySimulations:
    """Results of many simulations in the order of their cases; a failed one holds its error."""

    cases: tuple[Case, ...]
    results: tuple[Trajectory | Exception, ...] = field(repr=False)

    @property
    def trajectories(self) -> dict[int, Trajectory]:
        """The simulations that came to their end, by the number of their case."""
        return {i: r for i, r in enumerate(self.results) if isinstance(r, Trajectory)}

    @property
    def failures(self) -> dict[int, Exception]:
        """The errors of all others, by the number of their case."""
        return {i: r for i, r in enumerate(self.results) if isinstance(r, Exception)}

    def __len__(self) -> int:
        return len(self.results)

    def __str__(self) -> str:
        lines = [f"{len(self.trajectories)} of {len(self)} simulations done"]
        lines += [f"case {i}: {error}" for i, error in self.failures.items()]
        return "\n".join(lines)


def sweep(**values: Sequence[float]) -> list[dict[str, Any]]:
    """Cases for every combination of parameter values: ``sweep(mass=[1, 2], damping=[10, 20])``.

    ``_`` may stand for the dot in a name.
    """
    return [
        {"parameters": dict(zip(values, combination, strict=True))}
        for combination in itertools.product(*values.values())
    ]


def draws(
    values: Mapping[str, float], covariance: Any, count: int, *, prefix: str = "", seed: int = 0
) -> list[dict[str, Any]]:
    """Cases drawn from a normal distribution of parameters: Monte Carlo over a fit's uncertainty.

    values : {parameter: mean}; covariance : (n, n) in their order; prefix : put before each name
    (``"muscle1."``, or several muscles of one fit: repeat with the same seed and merge).
    """
    matrix = np.asarray(covariance, float)
    if matrix.shape != (len(values), len(values)):
        raise InputError(f"covariance has shape {matrix.shape} for {len(values)} values")
    if count < 1:
        raise InputError(f"count = {count} must be >= 1")
    scale = np.sqrt(np.diag(matrix))
    scale[scale == 0] = 1.0  # a constant stays one
    # in units of standard errors: the coefficients' sizes differ by many decades
    factor = np.linalg.cholesky(matrix / np.outer(scale, scale) + 1e-14 * np.eye(len(scale)))
    normal = np.random.default_rng(seed).standard_normal((count, len(scale)))
    samples = np.array(list(values.values())) + (normal @ factor.T) * scale
    return [
        {"parameters": {prefix + n: float(v) for n, v in zip(values, row, strict=True)}}
        for row in samples
    ]


def simulate_many(
    plant: Plant,
    cases: Sequence[Case],
    *,
    executor: Executor | None = None,
    chunk: int | None = None,
    progress: Callable[[int, int], None] | None = None,
    **common: Any,
) -> ManySimulations:
    """Simulate a plant once for each case; one failing case does not stop the others.

    Parameters
    ----------
    cases : mappings with any of "parameters", "start", "inputs", as :func:`simulate` takes them.
    executor : any ``concurrent.futures.Executor`` (processes, threads, Dask's
        ``client.get_executor()``, MPI's); None runs in this process. Take processes for speed:
        threads take turns. Functions of time among the inputs travel only if they can be pickled.
    chunk : cases per task; by default so that there are about 40 tasks.
    progress : called as progress(done, all) after each finished task.
    common : further arguments of :func:`simulate` for all cases (``t``, ``duration``, ``inputs``,
        ``rtol``, ...); what a case names wins (parameters and start are merged by name).

    Raises InputError when a case or a common argument is not one of those.
    """
    cases = tuple(cases)
    for number, case in enumerate(cases):
        unknown = set(case) - set(CASE_KEYS)
        if unknown:
            raise InputError(
                f"case {number} holds {sorted(unknown)}; a case may hold {', '.join(CASE_KEYS)}"
            )
    if chunk is None:
        chunk = max(1, -(-len(cases) // 40))
    elif chunk < 1:
        raise InputError(f"chunk = {chunk} must be >= 1")
    tasks = [list(range(i, min(i + chunk, len(cases)))) for i in range(0, len(cases), chunk)]
    results: list[Any] = [None] * len(cases)
    done = 0
    for numbers, values in _completed(plant, cases, tasks, executor, common):
        for number, value in zip(numbers, values, strict=True):
            results[number] = value
        done += len(numbers)
        if progress is not None:
            progress(done, len(cases))
    return ManySimulations(cases, tuple(results))


def _completed(
    plant: Plant,
    cases: tuple[Case, ...],
    tasks: list[list[int]],
    executor: Executor | None,
    common: dict[str, Any],
) -> Iterator[tuple[list[int], list[Any]]]:
    """(numbers, results) of each task as it ends."""
    if executor is None:
        for numbers in tasks:
            yield numbers, [_one(plant, cases[n], common) for n in numbers]
        return
    packed = pickle.dumps(plant)
    futures: dict[Future[list[Any]], list[int]] = {
        executor.submit(_task, packed, [cases[n] for n in numbers], common): numbers
        for numbers in tasks
    }
    for future in _as_completed(futures):
        numbers = futures[future]
        try:
            yield numbers, future.result()
        except Exception as error:  # a worker that died takes its task's cases only
            yield numbers, [error] * len(numbers)


def _as_completed(futures: Mapping[Any, Any]) -> Iterator[Any]:
    """Futures as they end; executors with futures of their own class are asked in order."""
    if all(isinstance(f, Future) for f in futures):
        yield from as_completed(futures)
    else:
        yield from futures


@lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Plant:
    """The plant in a worker: unpickled once, so that its integrators are built once too."""
    plant: Plant = pickle.loads(packed)  # our own bytes, from simulate_many in the parent
    return plant


def _task(packed: bytes, cases: list[Case], common: dict[str, Any]) -> list[Any]:
    with _CASADI:
        plant = _unpacked(packed)
        return [_one(plant, case, common) for case in cases]


def _one(plant: Plant, case: Case, common: dict[str, Any]) -> Trajectory | Exception:
    arguments = dict(common)
    for key in CASE_KEYS:
        if key in case:
            both = isinstance(case[key], Mapping) and isinstance(arguments.get(key), Mapping)
            arguments[key] = {**arguments[key], **case[key]} if both else case[key]
    try:
        return simulate(plant, **arguments)
    except PamError as error:
        return error

"""simulate_many: the same simulation under many parameters, starts or inputs, on any executor."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, overload

import numpy as np

from ..core.cases import Loop, ending
from ..core.errors import (
    InputError,
    SimulationError,
    kind_of,
    require_count,
    require_finite,
    require_known_keywords,
    with_kinds,
)
from ..core.executors import Place, placed
from ..core.files import MOST_ROWS
from ..core.interrupts import interruptible
from ..core.shown import shown
from ..core.stores import Store, folder_of
from ..core.trajectory import Trajectory
from ..plants.plant import Plant, require_plant
from .batches import CASE_KEYS, Case, Keep, Numbers, Simulation, keep_of, plain
from .integrate import Integration
from .kept import KeptNumbers, keep_numbers
from .simulator import simulate
from .statistics import SobolCases
from .stored import StoredSimulations, store

COMPILED = 500
"""From so many cases on the plant is compiled beforehand: it takes seconds, and saves them."""


@shown
@dataclass(frozen=True)
class ManySimulations:
    """Results of many simulations in the order of their cases; a failed one holds its error.

    Examples
    --------
    >>> cases = pam.simulation.sweep(mass=[5.0, 10.0])
    >>> many = pam.simulate_many(plant, cases, duration=0.1)
    >>> len(many.results), many.failures
    (2, {})
    """

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

    Examples
    --------
    >>> cases = pam.simulation.sweep(mass=[1.0, 2.0], muscle_lag=[0.05, 0.1])
    >>> len(cases), cases[0]
    (4, {'parameters': {'mass': 1.0, 'muscle_lag': 0.05}})
    """
    given: Mapping[str, Any] = values
    for name, several in given.items():
        if isinstance(several, str) or not isinstance(several, Iterable):
            raise InputError(f"{name} = {several!r}: give a list of values")
    return [
        {"parameters": dict(zip(values, combination, strict=True))}
        for combination in itertools.product(*values.values())
    ]


@with_kinds
def draws(
    values: Mapping[str, float], covariance: Any, count: int, *, prefix: str = "", seed: int = 0
) -> list[dict[str, Any]]:
    """Cases drawn from a normal distribution of parameters: Monte Carlo over a fit's uncertainty.

    values : {parameter: mean}; covariance : (n, n) in their order; prefix : put before each name
    (``"muscle1."``, or several muscles of one fit: repeat with the same seed and merge).

    Examples
    --------
    >>> cases = pam.simulation.draws(fit.law.values, fit.covariance, 3, prefix="muscle.", seed=1)
    >>> len(cases), sorted(cases[0]["parameters"])[:2]
    (3, ['muscle.a1', 'muscle.a2'])
    """
    matrix = np.asarray(covariance, float)
    if matrix.shape != (len(values), len(values)):
        raise InputError(f"covariance has shape {matrix.shape} for {len(values)} values")
    require_count("count", count)
    require_count("seed", seed, 0)
    scale = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    scale[scale == 0] = 1.0  # a constant stays one
    # in units of standard errors: the coefficients' sizes differ by many decades
    relative = matrix / np.outer(scale, scale)
    wrong = InputError(
        "covariance is none: it has to be symmetric, without negative eigenvalues; give that of a "
        "fit, as fit.covariance"
    )
    if not np.allclose(relative, relative.T):  # NaN is not close to itself
        raise wrong
    try:
        factor = np.linalg.cholesky(relative + 1e-14 * np.eye(len(scale)))
    except np.linalg.LinAlgError:
        raise wrong from None
    normal = np.random.default_rng(seed).standard_normal((count, len(scale)))
    means = [require_finite(f"values[{name!r}]", value) for name, value in values.items()]
    samples = np.array(means) + (normal @ factor.T) * scale
    return [
        {"parameters": {prefix + n: float(v) for n, v in zip(values, row, strict=True)}}
        for row in samples
    ]


@overload
def simulate_many(
    plant: Plant,
    cases: Iterable[Case],
    *,
    executor: Place = ...,
    workers: int | None = ...,
    chunk: int | None = ...,
    progress: Callable[[int, int | None], None] | None = ...,
    into: None = ...,
    **common: Any,
) -> ManySimulations: ...
@overload
def simulate_many(
    plant: Plant,
    cases: Iterable[Case],
    *,
    executor: Place = ...,
    workers: int | None = ...,
    chunk: int | None = ...,
    progress: Callable[[int, int | None], None] | None = ...,
    into: Store,
    **common: Any,
) -> StoredSimulations: ...
@overload
def simulate_many(
    plant: Plant,
    cases: Iterable[Case],
    *,
    executor: Place = ...,
    workers: int | None = ...,
    chunk: int | None = ...,
    progress: Callable[[int, int | None], None] | None = ...,
    into: Store | None = ...,
    keep: Keep,
    rows: bool = ...,
    until: Mapping[str, float] | None = ...,
    **common: Any,
) -> KeptNumbers: ...
@with_kinds
def simulate_many(
    plant: Plant,
    cases: Iterable[Case],
    *,
    executor: Place = None,
    workers: int | None = None,
    chunk: int | None = None,
    progress: Callable[[int, int | None], None] | None = None,
    into: Store | None = None,
    keep: Keep | None = None,
    rows: bool = True,
    until: Mapping[str, float] | None = None,
    **common: Any,
) -> ManySimulations | StoredSimulations | KeptNumbers:
    """Simulate a plant once for each case; one failing case does not stop the others.

    Parameters
    ----------
    cases : mappings with any of "parameters", "start", "inputs", as :func:`simulate` takes them; a
        generator is read as far as there are workers for it.
    executor : where, as for :func:`pam_ocp.each`: all processors where it pays (None), a number of
        processes (0: this one alone), any ``concurrent.futures.Executor``, a client of Dask. Take
        processes for speed: threads take turns. Functions of time among the inputs travel only if
        they can be pickled; cases that do not are simulated here. A case that takes two workers
        with it has failed; the others are not touched.
    workers : the same as a number given as ``executor``.
    chunk : cases per task; by default so that there are some fifty tasks for each worker; with
        ``into`` 100 cases, fewer where there are fewer than 1600. With ``keep`` rows of a file
        (100 000).
    progress : called as progress(done, all) after each finished task; all is None for a generator.
    into : a folder for the results, in place of memory: one Parquet file per task, which the
        workers make. A path, a URL such as "s3://bucket/runs", or a file system of fsspec or
        pyarrow (see docs/many.md). Needs pyarrow. Run again with the same arguments, only what is
        not there is computed. Functions count by their code and all that it leads to; what cannot
        be told from something else (compiled functions, open files) is computed anew, with a
        warning. A folder of other arguments, or of other versions of the packages that compute, is
        refused.
    keep : {name: what to keep of each motion}, in place of the motions: words such as "x.final",
        "max(muscle1.force)", "crossing(x, '10 mm')" (docs/many.md has all of them), or a function
        of a Trajectory that gives a number. One row a case, with the parameters that it names.
    rows : with ``keep``, in memory: False keeps no rows, only their statistics (and, of SobolCases,
        what their indices need).
    until : {name of a number: half width of the 95 % interval of its mean} at which to stop early;
        looked at after every 250 cases, so it is the same place in every run.
    common : further arguments of :func:`simulate` for all cases (``t``, ``duration``, ``inputs``,
        ``rtol``, ...); what a case names wins (parameters and start are merged by name).
        ``time_limit`` is that of each case, which fails when it is over. From 500 cases on the
        plant is compiled first where a compiler is there, unless ``compiled`` says otherwise.

    Raises InputError when a case is not one of those, and for a folder that holds something else;
    TypeError for a common argument that simulate does not know.

    Examples
    --------
    >>> cases = pam.simulation.sweep(mass=[5.0, 10.0, 20.0])
    >>> many = pam.simulate_many(plant, cases, inputs={"muscle.command": 4e5}, duration=2.0)
    >>> [f"{run['x'][-1]:.3f}" for run in many.results]
    ['0.061', '0.057', '0.049']
    """
    if chunk is not None:
        require_count("chunk", chunk, 1, MOST_ROWS)
    if workers is not None:
        require_count("workers", workers)
        if executor is not None:
            raise InputError("give executor or workers, not both")
        executor = workers
    require_known_keywords("simulate", inspect.signature(simulate), common)
    count = len(cases) if isinstance(cases, Sized) else None
    require_plant(plant)
    # no turns: threads of an executor want theirs
    with interruptible():
        many = (count is None and keep is not None) or (count or 0) >= COMPILED
        if many and not {"compiled", "method", "step"} & set(common):
            with suppress(InputError):
                machine = Integration.built(plant)
                if machine is not None and keep is not None:
                    machine.lanes()  # before workers begin with what is here
                common["compiled"] = None
        work = Simulation(plant, common)
        place = None if into is None else folder_of("into", into)
        if keep is not None:
            numbers = Loop(Numbers(work, keep_of(plant, keep)), placed(executor), count)
            drawn = cases if isinstance(cases, SobolCases) else None
            given = _in_numbers(plant, _checked(cases), keep)
            return keep_numbers(numbers, given, place, chunk, progress, rows, until or {}, drawn)
        if not rows or until is not None:
            raise InputError("rows and until go with keep={...}")
        if place is not None:
            run = Loop(work, placed(executor), count, lost=SimulationError)
            return store(run, _in_numbers(plant, _checked(cases)), place, chunk, progress)
        kept: list[Case] = []
        found = dict(
            ending(
                work,
                _noted(_checked(cases), kept),
                executor=executor,
                chunk=chunk,
                progress=progress,
                what="simulations",
                count=count,
                lost=SimulationError,
            )
        )
        return ManySimulations(tuple(kept), tuple(found[i] for i in range(len(kept))))


def _noted(cases: Iterable[Case], kept: list[Case]) -> Iterator[Case]:
    for case in cases:
        kept.append(case)
        yield case


def _checked(cases: Iterable[Case]) -> Iterator[Case]:
    for number, case in enumerate(cases):
        if not isinstance(case, Mapping):
            raise InputError(
                f"case {number} is {kind_of(case)}; a case is a mapping that may hold "
                f"{', '.join(CASE_KEYS)}"
            )
        unknown = set(case) - set(CASE_KEYS)
        if unknown:
            raise InputError(
                f"case {number} holds {sorted(unknown)}; a case may hold {', '.join(CASE_KEYS)}"
            )
        yield case


def _in_numbers(plant: Plant, cases: Iterable[Case], keep: Keep | None = None) -> Iterator[Case]:
    """Cases with their parameters as numbers by their own names, as columns have them. What is none
    fails in its simulation.
    """
    own = {v.name for v in plant.parameters}
    for number, case in enumerate(cases):
        given = case.get("parameters")
        if isinstance(given, Mapping) and not all(n in own and plain(v) for n, v in given.items()):
            with suppress(InputError):
                variables = {n: plant.variable(n) for n in given}
                found = {v.name: v.number(given[n]) for n, v in variables.items()}
                if len(found) == len(given):
                    case, given = {**case, "parameters": found}, found
        both = set(keep or {}).intersection(given if isinstance(given, Mapping) else ())
        if both:
            raise InputError(
                f"keep: {min(both)!r} is a parameter of case {number}, a column of its own; give "
                "the number another name"
            )
        yield case

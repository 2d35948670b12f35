"""Which model? A ladder of them on the same records, each with one thing more, judged by what it
predicts of the parts that it was not fitted to.

Every rung is fitted to all records, and once without each fold of them; the parts left out are
predicted by free runs through the whole record (see :mod:`.climbing`). Rungs are compared part by
part, so that what makes a part hard for all of them drops out: the simplest rung that is not
significantly worse than the best is marked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ...core.cases import Place
from ...core.errors import FitError, InputError, OutOfTime, UnknownNameError, require_count
from ...core.interrupts import interruptible
from ...core.progress import counted
from ...core.stop import TimeIsUp, check, limited, spared
from ...core.trajectory import Trajectory
from ...plants.feeds import Regulator
from ..statistics import student_t
from .adequacy import Adequacy, adequacy_of
from .climbing import Task, climbed, usual_steps
from .evidence import evidence_of
from .experiment import bounds_of, groups, measured_names, recorded
from .ladder_result import Ladder, Part, RungFit, compared
from .rig import Rig, unknowns_of
from .rungs import LADDER, Builder, Rung, rungs_of

__all__ = ["Ladder", "RungFit", "fit_ladder"]

FIRST_RATE = 1e6
"""Of pressures [Pa/s], where no rung before tells it."""
REPORTING = 5.0
"""Seconds to say what was found when a time limit is over."""


@interruptible()
def fit_ladder(
    build: Builder | Sequence[Rung],
    records: Trajectory | Sequence[Trajectory],
    free: Sequence[str | Sequence[str]] = (),
    *,
    feed: Regulator | None = None,
    dynamic: Sequence[str | Sequence[str]] | None = None,
    rungs: Sequence[str] = LADDER,
    outputs: Sequence[str] | None = None,
    folds: int = 5,
    steps: int | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    level: float = 0.95,
    executor: Place = None,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
) -> Ladder:
    """Climb from a static model to one with lag, dead time, slew limit, friction, memory, creep.

    Parameters
    ----------
    build : makes the plant of a rung from ``feed=`` and ``losses=``, as
        ``functools.partial(pam.AntagonisticSlide, muscle, 2.0)``; or rungs of your own
        (:class:`Rung`), from the simplest up, with which ``free``, ``feed``, ``dynamic`` and
        ``rungs`` are left out.
    records : with all inputs and some states or outputs. Each should begin at rest: what is not
        measured begins there.
    free : parameters to fit on every rung, as for :func:`fit_plant` (a gain, a base pressure, the
        muscle's coefficients); they begin where ``build`` sets them.
    feed : the regulator on which rungs are built: its gain, base, lags; by default ``Regulator()``.
    dynamic : parameters freed from the second rung on; by default the plant's damping.
    rungs : which to climb, of "static", "lag", "dead time", "slew", "friction", "memory" (slip)
        and "creep". Parameters of these, such as the lags of two muscles, count as equal.
    outputs : what is compared; by default all states and outputs that the records hold.
    folds : of parts of the records (at least 3), each predicted once by a fit to the others. Whole
        records are the parts where there are as many, else each is cut.
    steps : of the integration in each sampling interval; by default of 1.25 ms. Values are found
        with as many more as the residuals ask for.
    bounds : {free parameter: (low, high)}.
    level : of intervals and of the significance of differences.
    executor : where the fits without folds are made, as for :func:`pam_ocp.each`.
    progress : called with a line for each rung.
    time_limit : [s]; rungs for which there is no time are named, OutOfTime where none was climbed.

    Raises
    ------
    InputError, UnknownNameError : arguments that cannot be.
    FitError : no rung could be fitted.

    Examples
    --------
    >>> from functools import partial
    >>> rig = partial(pam.HangingLoad, muscle, 10.0, damping=100.0)
    >>> commanded = pam.Trajectory(
    ...     record.t,
    ...     {n: record[n] for n in ("muscle.command", "x")},
    ...     [plant.variable(n) for n in ("muscle.command", "x")],
    ...     "previous",
    ... )
    >>> ladder = pam.fitting.fit_ladder(rig, commanded, folds=3, rungs=["static", "lag"])
    >>> [rung.name for rung in ladder.rungs]
    ['static', '+ lag']
    """
    began = time.perf_counter()
    chosen = recorded(records)
    ladder = (
        rungs_of(build, free, feed=feed, dynamic=dynamic, names=rungs)
        if callable(build)
        else _own(build)
    )
    names = measured_names(ladder[-1].plant, chosen, outputs)
    student_t(level, 1)  # refuses what is no level
    parts = _parts(chosen, require_count("folds", folds, 3))
    fold = _folds(chosen, parts, folds)
    number = usual_steps(chosen) if steps is None else require_count("steps", steps)
    task = Task(chosen, names, parts, fold, number, _bounds(ladder, bounds))
    with limited(time_limit):
        found = _climbed_all(ladder, task, executor, progress)
        with spared(REPORTING):
            result = Ladder(
                tuple(compared(found, level)),
                tuple(parts),
                fold,
                tuple(names),
                len(chosen),
                level,
                time.perf_counter() - began,
                tuple(r.name for r in ladder[len(found) :]),
            )
            rung = next(r for r in ladder if r.name == result.chosen.name)
            adequacy = Adequacy() if rung.static else _adequacy(result)
            return replace(result, adequacy=adequacy, seconds=time.perf_counter() - began)


def _bounds(
    ladder: Sequence[Rung], bounds: Mapping[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Each belongs to a parameter that some rung frees and holds its value."""
    given = bounds_of(bounds)
    free = [{g.name for g in groups(rung.plant, rung.free)} for rung in ladder]
    for name in given:
        if not any(name in each for each in free):
            every = sorted(set().union(*free))
            raise UnknownNameError("parameter in bounds that no rung frees:", name, every)
    for rung, names in zip(ladder, free, strict=True):
        groups(rung.plant, rung.free, {n: ends for n, ends in given.items() if n in names})
    return given


def _adequacy(ladder: Ladder) -> Adequacy:
    """Of the chosen rung, its dead times as they were found."""
    fit, names = ladder.chosen, list(ladder.outputs)
    m = fit.model
    plant = m.plant.with_values(m.unknowns.parameters(m.plant, m.z))
    found = zip(m.unknowns.groups, m.z, strict=False)
    free = [replace(g, value=float(v * g.scale)) for g, v in found]
    unknowns, _ = unknowns_of(plant, free, names, len(m.records), 1.0)
    rig = m.unknowns.rig(plant, names, m.rig, m.z)
    evidence = evidence_of(plant, m.records, names, unknowns, Rig(rig.delays), unknowns.guess)
    weights = 1 / np.array([max(fit.rmse[n], 1e-300) for n in names])
    return adequacy_of(evidence, weights, {n: c.stderr for n, c in fit.coefficients.items()})


def _climbed_all(
    ladder: Sequence[Rung],
    task: Task,
    executor: Place,
    progress: Callable[[str], None] | None,
) -> list[RungFit]:
    """The rungs for which there is time."""
    found: list[RungFit] = []
    values: dict[str, float] = {}
    rate = FIRST_RATE
    try:
        for rung in counted(ladder, "rungs"):
            check()
            fit, values, rate = climbed(task, rung, values, rate, executor)
            found.append(fit)
            if progress is not None:
                progress(f"{fit.name}: {fit.failure or f'error {fit.score:.4f}'}")
    except TimeIsUp:
        if not any(not r.failure for r in found):
            raise OutOfTime(
                "the time limit was over before the first rung was climbed; allow more time, or "
                "give fewer folds"
            ) from None
    if all(r.failure for r in found):
        raise FitError(f"no rung could be fitted: {found[0].failure}")
    return found


# ---- arguments ----------------------------------------------------------------------------------
def _own(given: Sequence[Rung]) -> list[Rung]:
    ladder = list(given) if isinstance(given, Sequence) else []
    wrong = [r for r in ladder if not isinstance(r, Rung)]
    if wrong or not ladder:
        raise InputError(
            "build: give a function of feed= and losses= that makes a plant, or a list of Rungs"
        )
    return ladder


def _parts(records: Sequence[Trajectory], folds: int) -> list[Part]:
    """Whole records, or each cut into as many pieces as make a part for each fold and more."""
    if len(records) >= folds:
        return [(r, 0, len(record)) for r, record in enumerate(records)]
    pieces = 3 * folds if len(records) == 1 else folds
    found = []
    for r, record in enumerate(records):
        if len(record) < 4 * pieces:
            raise InputError(
                f"record {r + 1} has {len(record)} samples, too few for {pieces} parts; take fewer "
                "folds"
            )
        edges = np.linspace(0, len(record), pieces + 1).round().astype(int).tolist()
        found += [(r, a, b) for a, b in pairwise(edges)]
    return found


def _folds(records: Sequence[Trajectory], parts: Sequence[Part], folds: int) -> NDArray[np.intp]:
    """The fold of each part: in turn, so that a fold has parts of early and of late."""
    return np.arange(len(parts), dtype=np.intp) % min(folds, len(parts))

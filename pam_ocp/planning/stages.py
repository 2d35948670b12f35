"""What a search does, stage by stage: each solve with its reason, and what it took; the work that
it may take in all.

Work is iterations times the cost of one, counted from the program (``iteration_cost``): processor
seconds of a common machine, the same on all.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Sequence, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from math import inf
from typing import TYPE_CHECKING, Any, Protocol

from ..core.stop import TimeIsUp

if TYPE_CHECKING:
    from .solvers.ipopt import Start
    from .transcription.transcription import Program

LOG = logging.getLogger(__name__)


class WorkIsSpent(TimeIsUp):
    """A search has taken the work that it may take: it ends with what it has."""


@dataclass(frozen=True)
class Stage:
    """One solve of a search."""

    name: str
    """Of the stage; those that it is part of stand before it: "valve openings / mesh"."""
    reason: str
    start: str
    """Where the solve began: "cold" from a guess, "near" from another mesh, "warm", ..."""
    status: str
    solved: bool
    iterations: int
    seconds: float
    """Of the processor."""
    intervals: int
    unknowns: int
    objective: float
    work: float = 0.0
    """Iterations times the cost of one."""


class _Outcome(Protocol):
    """What a solver made of a program."""

    @property
    def w(self) -> Sized: ...
    @property
    def status(self) -> str: ...
    @property
    def success(self) -> bool: ...
    @property
    def iterations(self) -> int: ...
    @property
    def objective(self) -> float: ...


@dataclass
class _Record:
    """The solves of one search; names and reasons of the stages that it is in."""

    found: list[Stage]
    limit: float = inf
    """Of the work of all."""
    names: tuple[str, ...] = ()
    reason: str = ""


RECORD: ContextVar[_Record | None] = ContextVar("stages of the search", default=None)


@contextmanager
def recorded(limit: float = inf) -> Iterator[list[Stage]]:
    """In the ``with`` solves are entered in the list; a search within another has its own. limit :
    of their work.
    """
    found: list[Stage] = []
    before = RECORD.set(_Record(found, limit))
    try:
        yield found
    finally:
        RECORD.reset(before)


@contextmanager
def stage(name: str, reason: str) -> Iterator[None]:
    """What the solves in the ``with`` are for."""
    record = RECORD.get()
    if record is None:
        yield
        return
    names = record.names if name in record.names else (*record.names, name)
    before = RECORD.set(_Record(record.found, record.limit, names, reason))
    try:
        yield
    finally:
        RECORD.reset(before)


@contextmanager
def limited(limit: float = inf) -> Iterator[None]:
    """Another limit of the work of all: a lower one for a part that others follow, none for solves
    side by side, of which none may end for what another takes.
    """
    record = RECORD.get() or _Record([])
    before = RECORD.set(_Record(record.found, limit, record.names, record.reason))
    try:
        yield
    finally:
        RECORD.reset(before)


def entered(more: Sequence[Stage] = ()) -> list[Stage]:
    """Solves of the search that is under way, with ``more`` from another process."""
    record = RECORD.get() or _Record([])
    record.found += more
    return record.found


def require_work(more: float) -> None:
    """Raise WorkIsSpent where the solves so far and ``more`` take what is allowed."""
    record = RECORD.get()
    if record is not None and sum(s.work for s in record.found) + more > record.limit:
        raise WorkIsSpent


def written(program: Program, start: Start, outcome: _Outcome, seconds: float, cost: float) -> None:
    """Enter a solve; cost : of an iteration."""
    record = RECORD.get() or _Record([])
    entry = Stage(
        " / ".join(record.names) or "solve",
        record.reason,
        start,
        outcome.status,
        outcome.success,
        outcome.iterations,
        seconds,
        len(program.mesh.intervals),
        len(outcome.w),
        outcome.objective,
        outcome.iterations * cost,
    )
    record.found.append(entry)
    LOG.info("%s (%s): %s", entry.name, entry.reason, _told(entry))


def _told(s: Stage) -> str:
    return (
        f"{s.intervals} intervals, {s.unknowns} unknowns, {s.start} start: {s.status}, "
        f"{s.iterations} iterations, {s.seconds:.2f} s, objective {s.objective:.6g}"
    )


def as_data(stages: Sequence[Stage]) -> list[dict[str, Any]]:
    """Of a plan: plain data, as its file has them."""
    return [asdict(s) for s in stages]


def table(stages: Sequence[dict[str, Any]], seconds: float) -> str:
    """The stages in lines, and what each kind of them took of all ``seconds``."""
    rows = [("stage", "intervals", "start", "iterations", "seconds", "objective", "status, reason")]
    spent: dict[str, float] = defaultdict(float)
    for s in stages:
        spent[s["name"]] += s["seconds"]
        numbers = (str(s["intervals"]), s["start"], str(s["iterations"]), f"{s['seconds']:.2f}")
        why = ", ".join(filter(None, (s["status"].replace("_", " "), s["reason"])))
        rows.append((s["name"], *numbers, f"{s['objective']:.6g}", why))
    widths = [max(len(row[i]) for row in rows) for i in range(6)]
    lines = [
        "  ".join([*(cell.ljust(w) for cell, w in zip(row, widths, strict=False)), row[6]])
        for row in rows
    ]
    most = sorted(spent, key=lambda name: -spent[name])
    shares = ", ".join(f"{name} {spent[name]:.2f} s" for name in most)
    return "\n".join([*lines, f"in all {seconds:.2f} s, of which solvers: {shares or 'none'}"])

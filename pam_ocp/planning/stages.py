"""What a search does, stage by stage: each solve with its reason, and what it took."""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator, Sequence, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from .solvers.ipopt_options import Start
    from .transcription.transcription import Program

__all__ = ["Stage", "as_data", "recorded", "stage", "table", "written"]

LOG = logging.getLogger(__name__)


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
    names: tuple[str, ...] = ()
    reason: str = ""


RECORD: ContextVar[_Record | None] = ContextVar("stages of the search", default=None)


@contextmanager
def recorded() -> Iterator[list[Stage]]:
    """In the ``with`` solves are entered in the list; a search within another has its own."""
    found: list[Stage] = []
    before = RECORD.set(_Record(found))
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
    before = RECORD.set(_Record(record.found, names, reason))
    try:
        yield
    finally:
        RECORD.reset(before)


def written(program: Program, start: Start, outcome: _Outcome, seconds: float) -> None:
    """Enter a solve."""
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

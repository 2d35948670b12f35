"""What each stage of the planner earns: random tasks with one stage switched off at a time.

    python benchmarks/stages_off.py [tasks] [seed] [--off NAME NAME] [--seconds 1200] [--table FILE]

Each task (``random_tasks.py``) is planned as usual, then anew without each stage that was entered;
where one was not entered, the plan is the same without it. Each answer is judged by
``motion_check.py``, which shares nothing with the planner but the equations. The table has, for
each stage: the tasks that entered it; of these, plans that are verified only with it or only
without it; tasks in which the objective is more than 0.2 % higher or lower without it, and the
largest of these changes; the processor's seconds with and without it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from typing import Any
from unittest import mock

import harness
import verdict_study

from pam_ocp.planning import mesh_sequence, search
from pam_ocp.planning.candidate import Engine
from pam_ocp.planning.continuation import Continuation
from pam_ocp.planning.mesh_sequence import MeshSequence
from pam_ocp.planning.search import Search
from pam_ocp.planning.transcription.mesh import doubled

SAME = 2e-3
"""Relative difference of objectives that counts."""
LEAST = 1e-2
"""An objective below it is taken for as much: next to nothing has no parts."""


def none(was: Any, *given: Any, **named: Any) -> None:
    """In place of a stage that gives one or none."""


def empty(was: Any, *given: Any, **named: Any) -> Iterator[Any]:
    """In place of a stage that gives several."""
    return iter(())


def first(was: Any, given: Any, *other: Any) -> Any:
    """In place of one that changes what it is given."""
    return given


def near(was: Any, engine: Any, c: Any, mesh: Any, why: str, start: str = "near") -> Any:
    return was(engine, c, mesh, why, "near" if start == "restored" else start)


STAGES: dict[str, tuple[Any, str, Callable[..., Any]]] = {
    "further starts": (Search, "_usual_number", lambda was, search: 1),
    "valve openings": (search.ValveOpenings, "of", none),
    "shooting at the end of the path": (Engine, "shot", none),
    "defect correction": (Engine, "corrected", none),
    "where a finer mesh's solver stopped": (
        Continuation,
        "_beside",
        lambda was, walk, failed, c: failed,
    ),
    "first meshes of few intervals": (MeshSequence, "_ladder", lambda was, m, merges: [m.asked]),
    "restoration first on the path": (Engine, "refined", near),
    "splitting by the gradients": (
        MeshSequence,
        "split",
        lambda was, mesh, gained, settings: doubled(mesh),
    ),
    "limits watched between points": (mesh_sequence, "watched", first),
    "relaxed parameters": (search, "has_relaxed", lambda was, problem: False),
    "other guesses": (Search, "_fallbacks", empty),
    "a simulated motion as guess": (search, "by_leading", none),
    "equilibria as guess": (search, "by_rests", none),
    "a point that meets all constraints": (Search, "_feasible", empty),
}
"""What is switched off: where it stands, and what takes its place (called with the stage and its
arguments).
"""
ENTERED: dict[str, Callable[[Any, tuple[Any, ...]], bool]] = {
    "further starts": lambda answer, given: answer > 1,
    "valve openings": lambda answer, given: answer is not None,
    "first meshes of few intervals": lambda answer, given: len(answer) > 1,
    "restoration first on the path": lambda answer, given: "restored" in given,
    "relaxed parameters": lambda answer, given: bool(answer),
}
"""Whether a call of a stage made a difference; of others each call does."""


def replaced(name: str, other: Callable[..., Any]) -> AbstractContextManager[Any]:
    """A stage replaced by ``other``, which is called with it and its arguments."""
    place, attribute, _ = STAGES[name]
    kind, was = place.__dict__[attribute], getattr(place, attribute)

    def called(*given: Any, **named: Any) -> Any:
        return other(was, *given, **named)

    unbound = isinstance(kind, staticmethod | classmethod)
    return mock.patch.object(place, attribute, staticmethod(called) if unbound else called)


def noting(name: str, entered: set[str]) -> Callable[..., Any]:
    """A stage as it is, which enters its name where it made a difference."""

    def noted(was: Any, *given: Any, **named: Any) -> Any:
        answer = was(*given, **named)
        if ENTERED.get(name, lambda answer, given: True)(answer, given):
            entered.add(name)
        return answer

    return noted


def one(index: int, seed: int, chosen: list[str]) -> harness.Row:
    task = verdict_study.drawn(index, seed)
    harness.about(str(task))
    entered: set[str] = set()
    with ExitStack() as stack:
        for name in chosen:
            stack.enter_context(replaced(name, noting(name, entered)))
        usual = verdict_study.judged(task)
    without = {}
    for name in [name for name in chosen if name in entered]:
        with replaced(name, STAGES[name][2]):
            without[name] = harness.judged(partial(verdict_study.judged, task))
    why = [f"{name}: {_told(usual, row)}" for name, row in without.items()]
    return {**usual, "index": index, "without": without, "text": str(task), "why": why}


def _told(usual: harness.Row, row: harness.Row) -> str:
    words = "" if row["verdict"] == usual["verdict"] else f"{row['verdict']}, "
    return f"{words}J {100 * change(usual, row):+.2f} %, {row['processor']} s"


def change(usual: harness.Row, row: harness.Row) -> float:
    """Of the objective, as a part of it; 0 where one is not verified."""
    if {usual["verdict"], row["verdict"]} != {verdict_study.RIGHT}:
        return 0.0
    return float((row["objective"] - usual["objective"]) / max(abs(usual["objective"]), LEAST))


def cases(given: harness.Given) -> harness.Keyed:
    chosen = given.off or list(STAGES)
    for index in harness.numbers(given):
        yield index, partial(one, index, given.seed, chosen)


def line(name: str, rows: list[harness.Row]) -> list[object]:
    """Of the table; none where no task entered the stage."""
    right = verdict_study.RIGHT
    pairs = [(row, row["without"][name]) for row in rows if name in row.get("without", {})]
    if not pairs:
        return []
    lost = sum(a["verdict"] == right != b["verdict"] for a, b in pairs)
    won = sum(a["verdict"] != right == b["verdict"] for a, b in pairs)
    by = [100 * change(a, b) for a, b in pairs]
    counts = f"{sum(c > 100 * SAME for c in by)}, {sum(c < -100 * SAME for c in by)}"
    took = [sum(row["processor"] for row in side) for side in zip(*pairs, strict=True)]
    most = f"{max(*by, 0.0):+.1f}, {min(*by, 0.0):+.1f}"
    return [name, len(pairs), f"{lost}, {won}", counts, most, f"{took[0]:.0f}, {took[1]:.0f}"]


def summary(rows: list[harness.Row]) -> str:
    heads = ("without", "tasks", "verified lost, won", "J higher, lower", "by at most [%]")
    lines = [each for each in (line(name, rows) for name in STAGES) if each]
    return harness.table((*heads, "seconds with it, without"), lines)


OPTIONS = {"--off": {"choices": STAGES, "nargs": "+", "help": "only these stages"}}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=40, seed=1, options=OPTIONS, seconds=1200.0)

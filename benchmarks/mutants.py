"""Chosen faults, one at a time: do the tests see each of them?

    nice -n 10 python benchmarks/mutants.py [--only WORD ...]

Each fault of ``mutants.txt`` is put into a scratch copy of the tree, where the tests that it names
are asked; one whose text no longer stands in exactly one file is STALE. Exit code 1 unless all are
killed. Random faults: ``mutate.py``.
"""

from __future__ import annotations

import shlex
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import harness
from mutation import Fault, Scratch, placed

TABLE = Path(__file__).with_suffix(".txt")
EXPECTED = 150.0
"""Seconds of the tests of a fault, as they take without it."""


@dataclass(frozen=True)
class Mutant:
    """One fault. tests : files, and options of pytest, joined by blanks."""

    name: str
    file: str
    old: str
    new: str
    tests: str


def read(text: str) -> Iterator[Mutant]:
    """The mutants of a table."""
    for block in text.split("\n\n"):
        lines = [line for line in block.strip("\n").split("\n") if not line.startswith("#")]
        if not any(lines):
            continue
        name, place, *changes = lines
        file, _, tests = place.partition(", ")
        old, new = ("\n".join(c[2:] for c in changes if c[0] == sign) for sign in "-+")
        yield Mutant(name, file, old, new, tests)


MUTANTS = list(read(TABLE.read_text("utf-8")))


def found(tree: Path, mutant: Mutant) -> Fault | None:
    """The mutant's place in the tree: in its file, or in the one file that has its text now."""
    others = [*sorted(tree.glob("pam_ocp/**/*.py")), *sorted(tree.glob("fmu/*.c"))]
    for candidates in ([tree / mutant.file], others):
        places = []
        for path in candidates:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            if (at := placed(text, mutant.old)) is not None:
                name = path.relative_to(tree).as_posix()
                places.append(Fault.at(name, text, at, mutant.new, mutant.name))
        if len(places) == 1:
            return places[0]
    return None


def one(scratch: Scratch, mutant: Mutant) -> harness.Row:
    fault = found(scratch.folder, mutant)
    if fault is None:
        return {"verdict": "STALE"}
    with scratch.with_fault(fault):
        answer = scratch.ask(shlex.split(mutant.tests), EXPECTED)
    return {**answer, "text": answer["by"]}


def cases(given: harness.Given) -> harness.Keyed:
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Scratch(Path(temporary))
        for mutant in MUTANTS:
            yield mutant.name, partial(one, scratch, mutant)


if __name__ == "__main__":
    rows = harness.main(__doc__, cases)
    sys.exit(not all(row["verdict"].startswith("killed") for row in rows))

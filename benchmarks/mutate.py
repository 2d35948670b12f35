"""Random faults: how many of them do the tests of their own room see?

Faults of the operators of ``mutation/`` are drawn by a seed: first a line of the room's files, then
a fault of that line. Each is put into a scratch copy, where the tests that run its line are asked,
the likeliest first, until one fails. A fault that no test run in the room touches has survived.

    nice -n 10 python benchmarks/mutate.py --seed 1 muscles=60 plants=60 ... [--table FILE]
    nice -n 10 python benchmarks/mutate.py --again FILE     (the survivors of an earlier table)

Needs pytest-cov (extra ``test``). The coverage of a room is collected first and kept in --keep.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import random
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import harness
from mutation.c_faults import c_faults
from mutation.coverage_map import CoverageMap, collect
from mutation.faults import Fault, placed
from mutation.python_faults import alters, python_faults
from mutation.scratch import Answer, Scratch

C_TESTS = {
    "fmu/src/step.c": "simulation refused robust solver state doors motion derivatives interface",
    "fmu/src/solver.c": "solver simulation robust log state",
    "fmu/src/values.c": "interface doors refused robust simulation log derivatives check",
    "fmu/src/state.c": "state robust doors simulation interface",
    "fmu/src/motion.c": "motion simulation doors robust interface refused",
    "fmu/src/derivatives.c": "derivatives robust interface refused",
    "fmu/src/windows.c": "physics simulation doors motion robust interface",
    "fmu/src/instance.c": "refused interface log robust state doors simulation",
    "fmu/src/model.c": "simulation interface refused robust",
    "fmu/src/fmi2.c": "interface refused doors state log derivatives robust motion check",
    "fmu/src/fmi3.c": "interface refused doors state log derivatives robust motion check",
}
"""Tests of each file of the C runtime, the likeliest first: no coverage is known of them."""
ROOMS: dict[str, tuple[str, tuple[str, ...]]] = {
    "muscles": ("muscles", ("pam_ocp/muscles/**/*.py",)),
    "plants": ("plants", ("pam_ocp/plants/**/*.py",)),
    "transcription": ("planning", ("pam_ocp/planning/transcription/**/*.py",)),
    "replay": ("planning", ("pam_ocp/planning/replay.py",)),
    "fits": (
        "fitting",
        (
            "pam_ocp/fitting/statistics.py",
            "pam_ocp/fitting/static/*.py",
            "pam_ocp/fitting/dynamic/*.py",
        ),
    ),
    "c": ("export", tuple(C_TESTS)),
}
"""Name: (room of the tests, files)."""
BUDGET = 45.0
"""Seconds of tests (as they take without a fault) spent on one fault, unless told otherwise."""


LENT = ("pam_ocp/plants/ensemble.py", "pam_ocp/plants/plant_file.py")
"""Files that speak of plans or of files: their tests are in the rooms of plans and of commands."""


def faults_of(tree: Path, patterns: tuple[str, ...]) -> list[Fault]:
    found: list[Fault] = []
    for pattern in patterns:
        for path in sorted(tree.glob(pattern)):
            name, text = path.relative_to(tree).as_posix(), path.read_text(encoding="utf-8")
            if name in LENT:
                continue
            found += (python_faults if path.suffix == ".py" else c_faults)(name, text)
    return found


def drawn(tree: Path, faults: list[Fault], count: int, rng: random.Random) -> list[Fault]:
    """Lines first, so that a long formula does not stand for its file; no line twice."""
    by_line: dict[tuple[str, int], list[Fault]] = defaultdict(list)
    for fault in faults:
        by_line[fault.file, fault.line].append(fault)
    lines = sorted(by_line)
    rng.shuffle(lines)
    found: list[Fault] = []
    for line in lines:
        text = (tree / line[0]).read_text(encoding="utf-8")
        rng.shuffle(by_line[line])
        good = (f for f in by_line[line] if line[0].endswith(".c") or alters(f, text))
        found += [f for f in (next(good, None),) if f is not None]
        if len(found) == count:
            break
    return found


def asked(
    scratch: Scratch, fault: Fault, known: CoverageMap | None, budget: float = BUDGET
) -> Answer:
    """What the tests say of a fault."""
    with scratch.with_fault(fault):
        if known is None:
            tests = [f"tests/export/test_fmu_{name}.py" for name in C_TESTS[fault.file].split()]
            return scratch.ask(tests, expected=150.0)
        order, seconds = [], 0.0
        for test in known.tests(fault.file, fault.line):
            if seconds and seconds + known.seconds[test] > budget:
                continue
            order.append(test)
            seconds += known.seconds[test]
        if not order:
            return Answer("SURVIVED (no test runs it)", "", 0.0)
        files = list(dict.fromkeys(t.split("::")[0] for t in order))
        answer = scratch.ask(files, order, seconds)
        if answer.killed and answer.by:
            known.won(answer.by)
        return answer


def still_there(scratch: Scratch, fault: Fault) -> Fault | None:
    """The fault where its line is now: of the same text, the place nearest to the old one."""
    text = (scratch.folder / fault.file).read_text(encoding="utf-8")
    if text[fault.start : fault.end] == fault.old:
        return fault
    at = placed(text, fault.old)
    if at is None:
        return None
    return dataclasses.replace(fault, start=at[0], end=at[1], line=text.count("\n", 0, at[0]) + 1)


def wanted(tree: Path, given: argparse.Namespace) -> list[tuple[str, Fault]]:
    """(room, fault) of those that are drawn, or of the survivors of a table."""
    if given.again:
        rows = (json.loads(line) for line in given.again.read_text("utf-8").splitlines())
        last = {row["case"]: row for row in rows}  # the last word counts
        survived = [row for row in last.values() if not row["verdict"].startswith("killed")]
        return [(row["room"], Fault(**row["fault"])) for row in survived]
    rng, found = random.Random(given.seed), []
    for word in given.counts:
        room, _, count = word.partition("=")
        faults = faults_of(tree, ROOMS[room][1])
        found += [(room, fault) for fault in drawn(tree, faults, int(count), rng)]
    return found


def one(
    scratch: Scratch, room: str, first: Fault, known: CoverageMap | None, budget: float
) -> harness.Row:
    row: harness.Row = {"room": room, "fault": dataclasses.asdict(first), "text": str(first)}
    fault = still_there(scratch, first)
    if fault is None:
        return {**row, "verdict": "STALE"}
    answer = asked(scratch, fault, known, budget)
    return {**row, "verdict": answer.word, "text": str(fault), "by": answer.by}


def cases(given: argparse.Namespace) -> Iterator[tuple[str, harness.Work]]:
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Scratch(Path(temporary) / "tree")
        keep = given.keep or Path(temporary) / "coverage"
        keep.mkdir(parents=True, exist_ok=True)
        known: dict[str, CoverageMap | None] = {"c": None}
        for room, fault in wanted(scratch.folder, given):
            tests = ROOMS[room][0]
            if room not in known:
                if not (keep / f"{tests}.json").exists():
                    collect(scratch.folder, tests, keep)
                known[room] = CoverageMap(scratch.folder, tests, keep)
            yield str(fault), partial(one, scratch, room, fault, known[room], given.budget)


def summary(rows: list[harness.Row]) -> str:
    lines = []
    for room in ROOMS:
        fates = Counter(r["verdict"].split()[0] for r in rows if r.get("room") == room)
        if fates:
            lines.append([room, fates.total(), fates["killed"], fates["SURVIVED"], fates["STALE"]])
    return harness.table(("room", "faults", "killed", "survived", "stale"), lines)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("counts", nargs="*", help=f"room=count, of {', '.join(ROOMS)}")
    parser.add_argument("--again", type=Path, help="ask again about the survivors in this table")
    parser.add_argument("--keep", type=Path, help="folder of the coverage, used again if there")
    parser.add_argument("--budget", type=float, default=BUDGET, help="seconds of tests a fault")


if __name__ == "__main__":
    rows = harness.main(__doc__, cases, summary, seed=0, options=options)
    sys.exit(not all(row["verdict"].startswith("killed") for row in rows))

"""Random faults: how many of them do the tests of their own room see?

Faults of the operators of ``mutation.py`` are drawn by a seed: first a line of the room's files,
then a fault of that line. Each is put into a scratch copy, where the tests that run its line are
asked, the likeliest first, until one fails. A fault that no test run in the room touches has
survived.

    nice -n 10 python benchmarks/mutate.py --seed 1 muscles=60 plants=60 ... [--table FILE]
    nice -n 10 python benchmarks/mutate.py --again FILE     (the survivors of an earlier table)

Needs pytest-cov (extra ``test``). The coverage of a room is collected first and kept in --keep.
"""

from __future__ import annotations

import ast
import dataclasses
import json
import os
import random
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from functools import partial
from pathlib import Path

import harness
from mutation import Fault, Scratch, c_faults, placed, python_faults

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
    "search": ("planning", ("pam_ocp/planning/*.py", "pam_ocp/planning/solvers/*.py")),
    "judge": ("judge", ("pam_ocp/judge/*.py",)),
    "control": ("control", ("pam_ocp/control/**/*.py",)),
    "simulation": ("simulation", ("pam_ocp/simulation/*.py",)),
    "core": ("core", ("pam_ocp/core/*.py",)),
    "rig": ("rig", ("pam_ocp/rig/**/*.py",)),
    "operating": ("operating", ("pam_ocp/operating/*.py",)),
    "vibration": ("vibration", ("pam_ocp/vibration/*.py",)),
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


# ---- which tests run which lines -----------------------------------------------------------------
PLUGIN = """
import json, os, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
found, failed = {}, set()
def pytest_runtest_logreport(report):
    if report.failed:
        failed.add(report.nodeid)
    if report.passed:
        found[report.nodeid] = found.get(report.nodeid, 0.0) + report.duration
def pytest_sessionfinish(session):
    with open(os.environ["DURATIONS"], "w") as file:
        json.dump({n: t for n, t in found.items() if n not in failed}, file)
"""


class CoverageMap:
    """Tests of a room by the lines that they run, and how long each takes: pytest-cov, asked once;
    ``room.cov`` and ``room.json`` stay in the folder.
    """

    def __init__(self, tree: Path, room: str, folder: Path) -> None:
        from coverage import CoverageData

        durations = folder / f"{room}.json"
        if not durations.exists():
            self._collect(tree, room, folder)
        self.tree = tree
        self.seconds: dict[str, float] = json.loads(durations.read_text("utf-8"))
        data = CoverageData(str(folder / f"{room}.cov"))
        data.read()
        prefix = os.path.commonpath(list(data.measured_files())).split("/pam_ocp")[0]
        self._lines: dict[str, dict[int, set[str]]] = {}
        self._wins, self._size = Counter[str](), Counter[str]()
        for file in data.measured_files():
            lines = data.contexts_by_lineno(file).items()
            own = {n: {test.split("|")[0] for test in tests} for n, tests in lines}
            self._lines[os.path.relpath(file, prefix)] = own
            self._size.update(test for tests in own.values() for test in tests)

    @staticmethod
    def _collect(tree: Path, room: str, folder: Path) -> None:
        (folder / "durations_of_tests.py").write_text(PLUGIN, encoding="utf-8")
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join((str(tree), str(folder))),
            "COVERAGE_FILE": str(folder / f"{room}.cov"),
            "DURATIONS": str(folder / f"{room}.json"),
        }
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
        command += ["-p", "durations_of_tests", "--cov=pam_ocp", "--cov-context=test"]
        command += ["--cov-report=", f"tests/{room}"]
        subprocess.run(command, cwd=tree, env=environment, check=False)

    def won(self, test: str) -> None:
        """This test has killed: it is asked earlier from now on."""
        self._wins[test] += 1

    def tests(self, file: str, line: int) -> list[str]:
        """Tests that run the statement at this line, the likeliest to fail under a fault first.

        Lines that run on import are everybody's. A fixture's lines belong to the first test that
        asked for it, so the other tests of that file follow.
        """
        lines = self._lines.get(file, {})
        names = {name for n in _statement(self.tree / file, line) for name in lines.get(n, ())}
        if "" in names:
            return sorted(self.seconds, key=self._likely)
        files = {n.split("::")[0] for n in names}
        beside = {n for n in self.seconds if n.split("::")[0] in files} - names
        groups = (names & set(self.seconds), beside)
        return [name for group in groups for name in sorted(group, key=self._likely)]

    def _likely(self, test: str) -> float:
        cost = self.seconds[test] + 0.02
        return cost * (50 + self._size[test]) / (1 + 3 * self._wins[test])


def _statement(path: Path, line: int) -> range:
    """The lines of the innermost simple statement, or head of a compound one, round ``line``."""
    best = range(line, line + 1)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.stmt) and node.end_lineno is not None:
            body = getattr(node, "body", None)
            last = body[0].lineno - 1 if body else node.end_lineno
            found = range(node.lineno, max(last, node.lineno) + 1)
            if line in found and (len(best) == 1 or len(found) <= len(best)):
                best = found
    return best


# ---- faults, and what the tests say of them ------------------------------------------------------
def drawn(tree: Path, patterns: tuple[str, ...], count: int, rng: random.Random) -> list[Fault]:
    """Lines first, so that a long formula does not stand for its file; no line twice."""
    by_line: dict[tuple[str, int], list[Fault]] = defaultdict(list)
    for path in (p for pattern in patterns for p in sorted(tree.glob(pattern))):
        name, text = path.relative_to(tree).as_posix(), path.read_text(encoding="utf-8")
        for fault in (python_faults if path.suffix == ".py" else c_faults)(name, text):
            if name not in LENT:
                by_line[name, fault.line].append(fault)
    lines = rng.sample(sorted(by_line), min(count, len(by_line)))
    return [rng.choice(by_line[line]) for line in lines]


def asked(
    scratch: Scratch, fault: Fault, known: CoverageMap | None, budget: float = BUDGET
) -> harness.Row:
    """What the tests say of a fault."""
    with scratch.with_fault(fault):
        if known is None:
            tests = [f"tests/export/test_fmu_{name}.py" for name in C_TESTS[fault.file].split()]
            return scratch.ask(tests, 150.0)
        order, seconds = [], 0.0
        for test in known.tests(fault.file, fault.line):
            if seconds and seconds + known.seconds[test] > budget:
                continue
            order.append(test)
            seconds += known.seconds[test]
        if not order:
            return {"verdict": "SURVIVED (no test runs it)", "by": ""}
        files = list(dict.fromkeys(t.split("::")[0] for t in order))
        answer = scratch.ask(files, seconds, order)
        if answer["by"] and answer["verdict"].startswith("killed"):
            known.won(answer["by"])
        return answer


def still_there(scratch: Scratch, fault: Fault) -> Fault | None:
    """The fault where its line is now: of the same text, the place nearest to the old one."""
    text = (scratch.folder / fault.file).read_text(encoding="utf-8")
    if text[fault.start : fault.end] == fault.old:
        return fault
    at = placed(text, fault.old)
    if at is None:
        return None
    return Fault.at(fault.file, text, at, fault.new, fault.kind)


def wanted(tree: Path, given: harness.Given) -> list[tuple[str, Fault]]:
    """(room, fault) of those that are drawn, or of the survivors of a table."""
    if given.again:
        rows = (json.loads(line) for line in given.again.read_text("utf-8").splitlines())
        last = {row["case"]: row for row in rows}  # the last word counts
        survived = [row for row in last.values() if not row["verdict"].startswith("killed")]
        return [(row["room"], Fault(**row["fault"])) for row in survived]
    rng, found = random.Random(given.seed), []
    for word in given.counts:
        room, _, count = word.partition("=")
        found += [(room, fault) for fault in drawn(tree, ROOMS[room][1], int(count), rng)]
    return found


def one(
    scratch: Scratch, room: str, first: Fault, known: CoverageMap | None, budget: float
) -> harness.Row:
    row: harness.Row = {"room": room, "fault": dataclasses.asdict(first), "text": str(first)}
    fault = still_there(scratch, first)
    if fault is None:
        return {**row, "verdict": "STALE"}
    answer = asked(scratch, fault, known, budget)
    return {**row, **answer, "text": str(fault)}


def cases(given: harness.Given) -> harness.Keyed:
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Scratch(Path(temporary) / "tree")
        keep = given.keep or Path(temporary) / "coverage"
        keep.mkdir(parents=True, exist_ok=True)
        known: dict[str, CoverageMap | None] = {"c": None}
        for room, fault in wanted(scratch.folder, given):
            tests = ROOMS[room][0]
            if room not in known:
                known[room] = CoverageMap(scratch.folder, tests, keep)
            yield str(fault), partial(one, scratch, room, fault, known[room], given.budget)


def summary(rows: list[harness.Row]) -> str:
    lines = []
    for room in ROOMS:
        fates = Counter(r["verdict"].split()[0] for r in rows if r.get("room") == room)
        if fates:
            lines.append([room, fates.total(), fates["killed"], fates["SURVIVED"], fates["STALE"]])
    return harness.table(("room", "faults", "killed", "survived", "stale"), lines)


OPTIONS = {
    "counts": {"nargs": "*", "help": f"room=count, of {', '.join(ROOMS)}"},
    "--again": {"type": Path, "help": "ask again about the survivors in this table"},
    "--keep": {"type": Path, "help": "folder of the coverage, used again if there"},
    "--budget": {"type": float, "default": BUDGET, "help": "seconds of tests a fault"},
}

if __name__ == "__main__":
    rows = harness.main(__doc__, cases, summary, seed=0, options=OPTIONS)
    sys.exit(not all(row["verdict"].startswith("killed") for row in rows))

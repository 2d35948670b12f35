"""Which tests of a room run which lines, and how long each takes: pytest-cov, asked once."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

__all__ = ["CoverageMap", "collect"]

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


def collect(tree: Path, room: str, folder: Path) -> None:
    """Run the tests of a room in ``tree``; leaves ``room.cov`` and ``room.json`` in ``folder``."""
    (folder / "durations_of_tests.py").write_text(PLUGIN, encoding="utf-8")
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join((str(tree), str(folder))),
        "COVERAGE_FILE": str(folder / f"{room}.cov"),
        "DURATIONS": str(folder / f"{room}.json"),
        "OMP_NUM_THREADS": "1",
        "MPLBACKEND": "Agg",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    command += ["-p", "durations_of_tests", "--cov=pam_ocp", "--cov-context=test"]
    subprocess.run(
        [*command, "--cov-report=", f"tests/{room}"], cwd=tree, env=environment, check=False
    )


class CoverageMap:
    """Of one room."""

    def __init__(self, tree: Path, room: str, folder: Path) -> None:
        from coverage import CoverageData

        self.tree, self.room = tree, room
        self.seconds: dict[str, float] = json.loads((folder / f"{room}.json").read_text("utf-8"))
        self._data = CoverageData(str(folder / f"{room}.cov"))
        self._data.read()
        self._prefix = os.path.commonpath(list(self._data.measured_files())).split("/pam_ocp")[0]
        self._wins: dict[str, int] = defaultdict(int)
        self._lines: dict[str, dict[int, list[str]]] = {}
        self._size: dict[str, int] = defaultdict(int)
        for file in self._data.measured_files():
            for tests in self._data.contexts_by_lineno(file).values():
                for test in {t.split("|")[0] for t in tests}:
                    self._size[test] += 1

    def won(self, test: str) -> None:
        """This test has killed: it is asked earlier from now on."""
        self._wins[test] += 1

    def tests(self, file: str, line: int) -> list[str]:
        """Tests that run the statement at this line, the likeliest to fail under a fault first.

        Lines that run on import are everybody's. A fixture's lines belong to the first test that
        asked for it, so the other tests of that file follow.
        """
        if file not in self._lines:
            found = self._data.contexts_by_lineno(f"{self._prefix}/{file}")
            self._lines[file] = {
                n: sorted({t.split("|")[0] for t in tests}) for n, tests in found.items()
            }
        lines = self._lines[file]
        names = {name for n in _statement(self.tree / file, line) for name in lines.get(n, ())}
        if "" in names:
            names = set(self.seconds)
        else:
            files = {n.split("::")[0] for n in names}
            beside = {n for n in self.seconds if n.split("::")[0] in files}
            return sorted(names & set(self.seconds), key=self._likely) + sorted(
                beside - names, key=self._likely
            )
        return sorted(names, key=self._likely)

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

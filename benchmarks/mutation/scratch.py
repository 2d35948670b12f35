"""A scratch copy of the tree, in which tests are asked about one fault after the other.

Dependencies are imported once; each question is a fork of this process, in which pytest imports
the package of the scratch copy.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .faults import Fault

__all__ = ["ROOT", "Answer", "Scratch"]

ROOT = Path(__file__).resolve().parents[2]
NEEDED = (
    "casadi", "numpy", "scipy.integrate", "scipy.interpolate", "scipy.linalg", "scipy.optimize",
    "scipy.special", "scipy.stats", "scipy.sparse.linalg", "matplotlib.figure", "control", "fmpy",
    "hypothesis", "pytest", "tomli_w",
)  # fmt: skip
PATIENCE = 60.0
"""Processor seconds beyond those that the tests take without a fault, before they count as hung."""


@dataclass(frozen=True)
class Answer:
    """killed, survived, or broken (pytest could not be asked); by which test; how long it took."""

    word: str
    by: str
    seconds: float

    @property
    def killed(self) -> bool:
        return self.word.startswith("killed")


class _Chosen:
    """A plugin of pytest: these tests alone, in this order, and the first that failed."""

    def __init__(self, order: Sequence[str] | None) -> None:
        self.order, self.first = order, ""

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        if self.order is not None:
            rank = {name: i for i, name in enumerate(self.order)}
            items[:] = sorted(
                (i for i in items if i.nodeid in rank), key=lambda item: rank[item.nodeid]
            )

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed and not self.first:
            self.first = report.nodeid

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed and not self.first:
            self.first = f"{report.nodeid} (collecting)"


class Scratch:
    """The copy, in ``folder``: the files that git knows, and those not yet committed."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            check=True,
            capture_output=True,
            text=True,
        ).stdout.splitlines()
        for name in listed:
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
        os.environ |= {
            "PYTHONPATH": str(folder),
            "OMP_NUM_THREADS": "1",
            "MPLBACKEND": "Agg",
            "XDG_CACHE_HOME": str(folder / "cache"),
        }
        for name in NEEDED:
            importlib.import_module(name)

    @contextlib.contextmanager
    def with_fault(self, fault: Fault) -> Iterator[None]:
        path = self.folder / fault.file
        text, kept = path.read_text(encoding="utf-8"), path.stat()
        path.write_text(fault.applied(text), encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(text, encoding="utf-8")
            os.utime(path, ns=(kept.st_atime_ns, kept.st_mtime_ns))  # its bytecode stays good

    def ask(
        self,
        words: Sequence[str],
        order: Sequence[str] | None = None,
        expected: float = 60.0,
        compiled: bool = False,
    ) -> Answer:
        """Run ``pytest -x words``; of what it collects only ``order``, where it is given.

        expected : processor seconds that these tests take without a fault.
        compiled : write bytecode (without a fault only).
        """
        began = time.perf_counter()
        told = self.folder / "told.json"
        told.unlink(missing_ok=True)
        child = os.fork()
        if child == 0:
            self._child(list(words), order, told, expected, compiled)
        late = began + 4 * (expected + PATIENCE) + 120
        status = None
        while status is None and time.perf_counter() < late:
            done, code = os.waitpid(child, os.WNOHANG)
            if done:
                status = code
            else:
                time.sleep(0.02)
        with contextlib.suppress(ProcessLookupError):
            os.killpg(child, signal.SIGKILL)  # what its tests have left running
        if status is None:
            os.waitpid(child, 0)
        spent = time.perf_counter() - began
        try:
            code, by = json.loads(told.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return Answer("killed (by time or crash)", "", spent)
        words_of = {0: "SURVIVED", 1: "killed", 2: "killed (while collecting)"}
        return Answer(words_of.get(code, f"BROKEN (pytest ended with {code})"), by, spent)

    def _child(
        self,
        words: list[str],
        order: Sequence[str] | None,
        told: Path,
        expected: float,
        compiled: bool,
    ) -> None:
        code: int = 99
        try:
            os.setsid()
            signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
            limit = int(2 * expected + PATIENCE)
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))
            out = os.open(self.folder / "said.txt", os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
            os.dup2(out, 1)
            os.dup2(out, 2)
            os.chdir(self.folder)
            sys.path[:] = [str(self.folder), *(p for p in sys.path if "benchmarks" not in p)]
            sys.dont_write_bytecode = not compiled
            os.environ["PYTHONDONTWRITEBYTECODE"] = "" if compiled else "1"
            import pytest

            chosen = _Chosen(order)
            code = int(
                pytest.main(["-q", "-x", "-p", "no:cacheprovider", *words], plugins=[chosen])
            )
            told.write_text(json.dumps([code, chosen.first]), encoding="utf-8")
        finally:
            os._exit(code)

"""Faults put into the source: do the tests see each of them?

    nice -n 10 python benchmarks/mutants.py [--only WORD ...]
    nice -n 10 python benchmarks/mutants.py --seed 1 muscles=60 plants=60 ... [--table FILE]
    nice -n 10 python benchmarks/mutants.py --again FILE    (the survivors of an earlier table)

Chosen faults: each of ``mutants.txt`` is put into a scratch copy of the tree, where the tests that
it names are asked; one whose text no longer stands in exactly one file is STALE.

Random faults, so many of a room: drawn by a seed, first a line of the room's files, then a fault of
that line. The tests that run its line are asked, the likeliest first, until one fails. A fault that
no test run in the room touches has survived. Needs pytest-cov (extra ``test``). The coverage of a
room is collected first and kept in --keep.

A fault is one place of one file, and what stands there instead. In Python it replaces a node of the
syntax tree, in C a word of a line. Left out is what no result depends on: docstrings and other
text, types, ``raise`` statements and warnings (their words), how things are printed, and choices:
the nominals, limits and units with which variables are declared, and the numbers that arguments
have by default. Exit code 1 unless all are killed.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import importlib
import json
import os
import random
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any

import harness

ROOT = Path(__file__).resolve().parents[1]


@dataclass(frozen=True)
class Fault:
    """``file[start:end]`` becomes ``new``. Lines count from 1."""

    file: str
    start: int
    end: int
    new: str
    kind: str
    line: int
    old: str

    @classmethod
    def at(cls, file: str, text: str, place: tuple[int, int], new: str, kind: str) -> Fault:
        """At a place of the text of a file."""
        start, end = place
        return cls(file, start, end, new, kind, text.count("\n", 0, start) + 1, text[start:end])

    def applied(self, text: str) -> str:
        return text[: self.start] + self.new + text[self.end :]

    def __str__(self) -> str:
        old, new = (" ".join(s.split()) for s in (self.old, self.new))
        return f"{self.file}:{self.line}: {self.kind}: {old or '(nothing)'} -> {new or '(nothing)'}"


def squeezed(text: str) -> tuple[str, list[int]]:
    """The text without what a formatter may change, and where each of its letters stood.

    Blanks and line breaks go, commas before a closing bracket too; all quotes are double.
    """
    kept: list[tuple[str, int]] = []
    for place, letter in enumerate(text):
        if letter.isspace():
            continue
        if letter in ")]}" and kept and kept[-1][0] == ",":
            kept.pop()
        kept.append(('"' if letter == "'" else letter, place))
    return "".join(letter for letter, _ in kept), [place for _, place in kept]


def placed(text: str, old: str) -> tuple[int, int] | None:
    """Start and end of ``old`` in ``text``, however either is broken into lines; None unless it
    stands there exactly once.
    """
    letters, places = squeezed(text)
    wanted, _ = squeezed(old)
    if letters.count(wanted) != 1:
        return None
    first = letters.index(wanted)
    return places[first], places[first + len(wanted) - 1] + 1


# ---- faults in Python ----------------------------------------------------------------------------
SWAPS: dict[type, tuple[type[ast.operator], str]] = {
    ast.Add: (ast.Sub, "term"),
    ast.Sub: (ast.Add, "term"),
    ast.Mult: (ast.Div, "factor"),
    ast.Div: (ast.Mult, "factor"),
    ast.Pow: (ast.Mult, "power"),
}
COMPARISONS: dict[type, tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
NAMES = {
    "min": "max", "minimum": "maximum", "fmin": "fmax", "argmin": "argmax", "nanmin": "nanmax",
    "mmin": "mmax", "any": "all", "sin": "cos", "sum1": "sum2", "vertcat": "horzcat",
    "zeros": "ones", "floor": "ceil", "cumsum": "diff", "column_stack": "vstack",
}  # fmt: skip
NAMES |= {b: a for a, b in NAMES.items() if a not in ("zeros", "cumsum", "column_stack")}
QUIET = {
    "description", "display", "repr", "unit", "nominal", "min", "max", "minimum", "maximum", "name",
    "stacklevel", "indent",
}  # fmt: skip
UNSWAPPED = {
    "isinstance", "getattr", "field", "coefficient", "__setattr__", "min", "max", "fmin", "fmax",
    "minimum", "maximum", "isclose", "is_equal", "add", "multiply",
}  # fmt: skip
PRINTED = {"__str__", "__repr__", "_repr_html_", "summary", "describe", "plot", "__dir__"}
TYPING = ("TYPE_CHECKING", "typing.TYPE_CHECKING")
SILENT = (ast.Raise, ast.JoinedStr, ast.Import, ast.ImportFrom, ast.Global, ast.Nonlocal)
TEXT = (ast.JoinedStr, ast.List, ast.Tuple, ast.Dict)


def called(node: ast.Call) -> str:
    """The last name of the function of a call."""
    return node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)


def is_text(node: ast.AST) -> bool:
    return isinstance(node, TEXT) or (isinstance(node, ast.Constant) and type(node.value) is str)


def looked_at(node: ast.AST) -> list[ast.AST]:
    """The children of a node in which faults are looked for."""

    def chosen(values: Sequence[ast.expr | None]) -> list[ast.AST]:
        """Defaults: a number that stands where none is given is a choice; yes or no is more."""
        found: list[ast.AST] = []
        for value in values:
            number = value.operand if isinstance(value, ast.UnaryOp) else value
            if not isinstance(number, ast.Constant) or isinstance(number.value, bool):
                found += [value] if value is not None else []
        return found

    match node:
        case ast.FunctionDef():
            defaults = chosen([*node.args.defaults, *node.args.kw_defaults])
            return [] if node.name in PRINTED else [*defaults, *node.body]
        case ast.ClassDef():
            protocol = any("Protocol" in ast.unparse(base) for base in node.bases)
            return [] if protocol else [*node.body]
        case ast.Lambda():
            return [node.body]
        case ast.AnnAssign():
            return chosen([node.value])
        case ast.AugAssign():
            return [node.value]
        case ast.Assign(targets=[ast.Name(id="__all__")]) | ast.Expr(value=ast.Constant()):
            return []
        case ast.If() if ast.unparse(node.test) in TYPING:
            return []
        case ast.Call() if called(node) in ("cast", "TypeVar", "warn", "print"):
            return []
        case ast.Call() if called(node) in ("require_finite", "require_positive"):
            return [*node.args]
        case ast.Call():
            values = [k.value for k in node.keywords if k.arg not in QUIET]
            first = 2 if called(node) == "coefficient" else 0  # behind unit and nominal
            return [node.func, *node.args[first:], *values]
    return [] if isinstance(node, SILENT) else list(ast.iter_child_nodes(node))


def negated(test: ast.expr) -> Iterator[tuple[ast.AST, ast.AST, str]]:
    """A condition; of a comparison the own operator is turned round."""
    if not (isinstance(test, ast.Compare) and len(test.ops) == 1):
        yield test, ast.UnaryOp(ast.Not(), test), "condition negated"


def replaced(node: ast.AST) -> Iterator[tuple[ast.AST, ast.AST, str]]:
    """(node, what stands there instead, kind) of the faults of one node."""
    match node:
        case ast.If() | ast.IfExp():
            if ast.unparse(node.test) not in TYPING:
                yield from negated(node.test)
        case ast.comprehension():
            for test in node.ifs:
                yield from negated(test)
        case ast.AugAssign():
            yield node, ast.Pass(), "statement dropped"
        case ast.Expr(value=ast.Call() as call) if called(call) not in ("warn", "print"):
            yield node, ast.Pass(), "statement dropped"
        case ast.BinOp(left, op, right) if type(op) in SWAPS:
            if is_text(left) or is_text(right):
                return
            other, word = SWAPS[type(op)]
            yield node, ast.BinOp(left, other(), right), "operator"
            yield node, left, f"{word} dropped"
            if isinstance(op, ast.Mult | ast.Add):
                yield node, right, f"{word} dropped"
            elif isinstance(op, ast.Sub):
                yield node, ast.UnaryOp(ast.USub(), right), f"{word} dropped"
        case ast.UnaryOp(op=ast.USub() | ast.Not()):
            yield node, node.operand, "sign dropped"
        case ast.BoolOp(op, values):
            turned = ast.Or() if isinstance(op, ast.And) else ast.And()
            yield node, ast.BoolOp(turned, values), "operator"
        case ast.Compare(left, ops, comparators):
            for i, op in enumerate(ops):
                for wrong in COMPARISONS.get(type(op), ()):
                    others = [*ops[:i], wrong(), *ops[i + 1 :]]
                    yield node, ast.Compare(left, others, comparators), "comparison"
        case ast.Call():
            yield from of_call(node)
        case ast.Constant(value) if not isinstance(value, str):
            for number in other_numbers(value, node):
                yield node, ast.Constant(number), "constant"


def of_call(node: ast.Call) -> Iterator[tuple[ast.AST, ast.AST, str]]:
    """Another function, or two arguments exchanged."""
    name, args = called(node), node.args
    if name in ("cast", "TypeVar", "warn", "print", "require_finite", "require_positive"):
        return
    if name in NAMES:
        of = node.func.value if isinstance(node.func, ast.Attribute) else None
        function = ast.Attribute(of, NAMES[name]) if of else ast.Name(NAMES[name])
        yield node, ast.Call(function, args, node.keywords), "function"
    if name in UNSWAPPED or any(isinstance(a, ast.Starred) for a in args):
        return
    for i in range(len(args) - 1):
        if not (isinstance(args[i], ast.Constant) and is_text(args[i])):
            order = [*args[:i], args[i + 1], args[i], *args[i + 2 :]]
            yield node, ast.Call(node.func, order, node.keywords), "arguments swapped"


def other_numbers(value: Any, node: ast.Constant) -> Iterator[Any]:
    """What may stand instead of a constant."""
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, int):
        yield value + 1
    elif isinstance(value, float) and value == 0.0:
        yield 1.0
    elif isinstance(value, float) and abs(value) <= 1e-6 and ast.unparse(node).startswith("1e"):
        yield 1e6 * value  # a tolerance: twice is as good
    elif isinstance(value, float) and abs(value) < 1e300:
        yield from (2 * value, 1.01 * value)


def python_faults(file: str, text: str) -> Iterator[Fault]:
    """Faults of ``text``, each of which says something else."""
    lines = text.splitlines(keepends=True)
    starts = [0, *accumulate(map(len, lines))]

    def place(line: int, column: int) -> int:
        return starts[line - 1] + len(lines[line - 1].encode()[:column].decode())

    waiting: list[ast.AST] = [ast.parse(text)]
    while waiting:
        node = waiting.pop()
        waiting += looked_at(node)
        for old, new, kind in replaced(node):
            words = ast.unparse(new)
            if words == ast.unparse(old):
                continue
            assert isinstance(old, ast.expr | ast.stmt)
            assert old.end_lineno is not None
            assert old.end_col_offset is not None
            at = place(old.lineno, old.col_offset), place(old.end_lineno, old.end_col_offset)
            plain = isinstance(new, ast.stmt | ast.Constant | ast.Call)
            yield Fault.at(file, text, at, words if plain else f"({words})", kind)


# ---- faults in C ---------------------------------------------------------------------------------
RULES: tuple[tuple[str, str, str], ...] = (
    (r" \+ ", " - ", "operator"),
    (r" - ", " + ", "operator"),
    (r" \* ", " / ", "operator"),
    (r" / ", " * ", "operator"),
    (r" \+= ", " -= ", "operator"),
    (r" < ", " <= ", "comparison"),
    (r" < ", " >= ", "comparison"),
    (r" <= ", " < ", "comparison"),
    (r" > ", " >= ", "comparison"),
    (r" > ", " <= ", "comparison"),
    (r" >= ", " > ", "comparison"),
    (r" == ", " != ", "comparison"),
    (r" != ", " == ", "comparison"),
    (r" && ", " || ", "operator"),
    (r" \|\| ", " && ", "operator"),
    (r"\bfmax\(", "fmin(", "function"),
    (r"\bfmin\(", "fmax(", "function"),
    (r"(?<=[(=?:,] )-(?=\w)", "", "sign dropped"),
    (r"(?<=\()!(?=\w)", "", "condition negated"),
    (r"(?<=if \()(?=[a-z])(?!int)", "!", "condition negated"),
    (r" \* [\w.>-]+(?:\[\w+\])?(?=[;,)])", "", "factor dropped"),
    (r" \+ [\w.>-]+(?:\[\w+\])?(?=[;,)])", "", "term dropped"),
    (r"(?<=\[)0(?=\])", "1", "index"),
    (r"(?<=int [a-z] = )0(?=;)", "1", "index"),
)
NUMBER = re.compile(r"(?<![\w.\"%])(\d+\.\d*(?:e-?\d+)?|\d+e-?\d+)(?![\w.])")
STATEMENT = re.compile(r"^ +((?:\w+\([^;{}]*\)|[\w.>\[\]*-]+ [+|]?= [^;{}]*);)", re.M)
HIDDEN = re.compile(r"/\*.*?\*/|\"(?:[^\"\\\n]|\\.)*\"|^#[^\n]*$", re.S | re.M)
SPOKEN = re.compile(r"\b(?:report|warn_\w+|snprintf|static_assert)\s*\(")
"""Calls whose arguments are words for the importer's log."""


def c_faults(file: str, text: str) -> Iterator[Fault]:
    """Faults of the code, comments, words and declarations of macros left alone."""
    bare = HIDDEN.sub(lambda m: re.sub(r"[^\n]", "\x01", m.group()), text)
    for spoken in SPOKEN.finditer(bare):
        depth, end = 1, spoken.end()
        while depth and end < len(bare):
            depth += {"(": 1, ")": -1}.get(bare[end], 0)
            end += 1
        bare = bare[: spoken.end()] + "\x01" * (end - spoken.end()) + bare[end:]
    for pattern, new, kind in RULES:
        for found in re.finditer(pattern, bare):
            yield Fault.at(file, text, found.span(), new, kind)
    for number in NUMBER.finditer(bare):
        value = float(number.group())
        yield Fault.at(file, text, number.span(), repr(2 * value) if value else "1.0", "constant")
    for statement in STATEMENT.finditer(bare):
        words = statement.group(1)
        if not re.match(r"(?:const |static |int |double |return|typedef)", words):
            yield Fault.at(file, text, statement.span(1), ";", "statement dropped")


# ---- a scratch copy ------------------------------------------------------------------------------
NEEDED = (
    "casadi", "numpy", "scipy.integrate", "scipy.interpolate", "scipy.linalg", "scipy.optimize",
    "scipy.special", "scipy.stats", "scipy.sparse.linalg", "matplotlib.figure", "control", "fmpy",
    "hypothesis", "pytest", "tomli_w",
)  # fmt: skip
"""Imported once; each question is a fork, in which pytest imports the package of the copy."""
PATIENCE = 60.0
"""Processor seconds beyond those that the tests take without a fault, before they count as hung."""


class Chosen:
    """A plugin of pytest: these tests alone, in this order, and the first that failed."""

    def __init__(self, order: Sequence[str] | None) -> None:
        self.order, self.first = order, ""

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        if self.order is not None:
            rank = {name: i for i, name in enumerate(self.order)}
            wanted = (item for item in items if item.nodeid in rank)
            items[:] = sorted(wanted, key=lambda item: rank[item.nodeid])

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
        command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
        for name in listed.stdout.splitlines():
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)
        os.environ |= {
            "PYTHONPATH": str(folder),
            "PYTHONDONTWRITEBYTECODE": "1",
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
        self, words: Sequence[str], expected: float, order: Sequence[str] | None = None
    ) -> harness.Row:
        """Run ``pytest -x words``; of what it collects only ``order``, where it is given.

        expected : processor seconds that these tests take without a fault. The verdict is killed,
        SURVIVED, or BROKEN (pytest could not be asked); ``by`` the test that failed.
        """
        found = harness.limited(
            partial(self._pytest, words, order, expected), 2 * expected + PATIENCE
        )
        if found["verdict"] in ("over time", "DIED", "RAISED"):
            found |= {"verdict": "killed (by time or crash)"}
        return {"by": "", **found}

    def _pytest(
        self, words: Sequence[str], order: Sequence[str] | None, expected: float
    ) -> harness.Row:
        signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in the background
        signal.alarm(int(4 * (expected + PATIENCE) + 120))  # what only waits ends, too
        out = os.open(self.folder / "said.txt", os.O_CREAT | os.O_TRUNC | os.O_WRONLY)
        os.dup2(out, 1)
        os.dup2(out, 2)
        os.chdir(self.folder)
        sys.path[:] = [str(self.folder), *(p for p in sys.path if "benchmarks" not in p)]
        sys.dont_write_bytecode = True
        import pytest

        chosen = Chosen(order)
        code = int(pytest.main(["-q", "-x", "-p", "no:cacheprovider", *words], plugins=[chosen]))
        verdicts = {0: "SURVIVED", 1: "killed", 2: "killed (while collecting)"}
        return {
            "verdict": verdicts.get(code, f"BROKEN (pytest ended with {code})"),
            "by": chosen.first,
        }


# ---- chosen faults -------------------------------------------------------------------------------
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


def one_chosen(scratch: Scratch, mutant: Mutant) -> harness.Row:
    fault = found(scratch.folder, mutant)
    if fault is None:
        return {"verdict": "STALE"}
    with scratch.with_fault(fault):
        answer = scratch.ask(shlex.split(mutant.tests), EXPECTED)
    return {**answer, "text": answer["by"]}


# ---- random faults -------------------------------------------------------------------------------
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


def one_random(
    scratch: Scratch, room: str, first: Fault, known: CoverageMap | None, budget: float
) -> harness.Row:
    row: harness.Row = {"room": room, "fault": dataclasses.asdict(first), "text": str(first)}
    fault = still_there(scratch, first)
    if fault is None:
        return {**row, "verdict": "STALE"}
    answer = asked(scratch, fault, known, budget)
    return {**row, **answer, "text": str(fault)}


# ---- the study -----------------------------------------------------------------------------------
def cases(given: harness.Given) -> harness.Keyed:
    with tempfile.TemporaryDirectory() as temporary:
        scratch = Scratch(Path(temporary) / "tree")
        if not given.counts and not given.again:
            for mutant in MUTANTS:
                yield mutant.name, partial(one_chosen, scratch, mutant)
            return
        keep = given.keep or Path(temporary) / "coverage"
        keep.mkdir(parents=True, exist_ok=True)
        known: dict[str, CoverageMap | None] = {"c": None}
        for room, fault in wanted(scratch.folder, given):
            if room not in known:
                known[room] = CoverageMap(scratch.folder, ROOMS[room][0], keep)
            work = partial(one_random, scratch, room, fault, known[room], given.budget)
            yield str(fault), work


def summary(rows: list[harness.Row]) -> str:
    lines = []
    for room in ROOMS:
        fates = Counter(r["verdict"].split()[0] for r in rows if r.get("room") == room)
        if fates:
            lines.append([room, fates.total(), fates["killed"], fates["SURVIVED"], fates["STALE"]])
    heads = ("room", "faults", "killed", "survived", "stale")
    return harness.table(heads, lines) if lines else ""  # chosen ones are of no room


OPTIONS = {
    "counts": {"nargs": "*", "help": f"room=count, of {', '.join(ROOMS)}"},
    "--again": {"type": Path, "help": "ask again about the survivors in this table"},
    "--keep": {"type": Path, "help": "folder of the coverage, used again if there"},
    "--budget": {"type": float, "default": BUDGET, "help": "seconds of tests a fault"},
}

if __name__ == "__main__":
    rows = harness.main(__doc__, cases, summary, seed=0, options=OPTIONS)
    sys.exit(not all(row["verdict"].startswith("killed") for row in rows))

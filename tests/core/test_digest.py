"""The digest of what runs: another after every change that matters, the same after all others."""

import datetime
import functools
import importlib
import os
import subprocess
import sys
import textwrap
import threading
import time

import casadi as ca
import numpy as np
import pytest

from pam_ocp.core.digest import digest_of
from pam_ocp.core.own_code import as_written, behind, content_digest

HELPER = """
GAIN = {gain}

class Table:
    slope = {gain}

def body(t):
    return {gain} * t
"""
KINDS = {
    "the body": "def push(t): return {gain} * t",
    "a function called": "def inner(t): return {gain} * t\ndef push(t): return inner(t)",
    "two calls deep": (
        "def a(t): return {gain} * t\ndef b(t): return a(t)\ndef push(t): return b(t)"
    ),
    "functions that call each other": (
        "def even(n): return n <= 0 or odd(n - {gain})\n"
        "def odd(n): return n > 0 and even(n - 1)\ndef push(t): return even(t)"
    ),
    "an inner lambda": "def push(t): return (lambda s: {gain} * s)(t)",
    "a nested function": "def push(t):\n    def inner(s): return {gain} * s\n    return inner(t)",
    "a closure": "def make(g):\n    return lambda t: g * t\npush = make({gain})",
    "a function in a closure": (
        "def make(f):\n    return lambda t: f(t)\npush = make(lambda t: {gain} * t)"
    ),
    "a default": "def push(t, g={gain}): return g * t",
    "a keyword default": "def push(t, *, g={gain}): return g * t",
    "a global number": "G = {gain}\ndef push(t): return G * t",
    "a global array": "import numpy as np\nG = np.array([{gain}])\ndef push(t): return G[0] * t",
    "a global in a lambda": "G = {gain}\npush = lambda t: max([t], key=lambda s: G * s)",
    "a class attribute": "class C:\n    g = {gain}\ndef push(t): return C.g * t",
    "a class attribute between underscores": (
        "class C:\n    __gain__ = {gain}\ndef push(t): return C.__gain__ * t"
    ),
    "a method": ("class C:\n    def f(self, t): return {gain} * t\ndef push(t): return C().f(t)"),
    "a base class": ("class B:\n    g = {gain}\nclass C(B): pass\ndef push(t): return C.g * t"),
    "a property": (
        "class C:\n    @property\n    def g(self): return {gain}\ndef push(t): return C().g * t"
    ),
    "a class made in a function": (
        "def push(t):\n    class C:\n        g = {gain}\n    return C.g * t"
    ),
    "__call__": "class C:\n    def __call__(self, t): return {gain} * t\npush = C()",
    "the state of an object": (
        "class C:\n    def __init__(self, g): self.g = g\n"
        "    def __call__(self, t): return self.g * t\npush = C({gain})"
    ),
    "slots": (
        "class C:\n    __slots__ = ('g',)\n    def __init__(self, g): self.g = g\n"
        "    def __call__(self, t): return self.g * t\npush = C({gain})"
    ),
    "a dataclass": (
        "from dataclasses import dataclass\n@dataclass(frozen=True)\nclass C:\n"
        "    g: float = {gain}\n    def __call__(self, t): return self.g * t\npush = C()"
    ),
    "a default factory": (
        "from dataclasses import dataclass, field\n@dataclass\nclass C:\n"
        "    g: list = field(default_factory=lambda: [{gain}])\ndef push(t): return C().g[0] * t"
    ),
    "a bound method": (
        "class C:\n    def __init__(self, g): self.g = g\n    def f(self, t): return self.g * t\n"
        "push = C({gain}).f"
    ),
    "a partial": (
        "from functools import partial\ndef f(g, t): return g * t\npush = partial(f, {gain})"
    ),
    "what a partial calls": (
        "from functools import partial\ndef f(g, t): return {gain} * t\npush = partial(f, 1)"
    ),
    "what is decorated": (
        "from functools import wraps\ndef twice(f):\n    @wraps(f)\n"
        "    def g(t): return 2 * f(t)\n    return g\n@twice\ndef push(t): return {gain} * t"
    ),
    "a decorator": (
        "from functools import wraps\ndef often(f):\n    @wraps(f)\n"
        "    def g(t): return {gain} * f(t)\n    return g\n@often\ndef push(t): return t"
    ),
    "what is cached": "from functools import cache\n@cache\ndef push(t): return {gain} * t",
    "one of several by type": (
        "from functools import singledispatch\n@singledispatch\ndef push(t): return t\n"
        "@push.register\ndef _(t: float): return {gain} * t"
    ),
    "a generator": (
        "def values():\n    yield 1.0\n    yield {gain}\ndef push(t): return sum(values()) * t"
    ),
    "a comprehension": "def push(t): return sum([{gain} * s for s in (t, t)])",
    "a default dictionary": (
        "from collections import defaultdict\nG = defaultdict(lambda: {gain})\n"
        "def push(t): return G['a'] * t"
    ),
    "a named tuple": (
        "from collections import namedtuple\nG = namedtuple('G', 'a b')(1.0, {gain})\n"
        "def push(t): return G.b * t"
    ),
    "an enumeration": (
        "from enum import Enum\nclass G(Enum):\n    a = {gain}\ndef push(t): return G.a.value * t"
    ),
    "an attribute of a function": "def push(t): return push.g * t\npush.g = {gain}",
    "one between underscores": "def push(t): return push.__g__ * t\npush.__g__ = {gain}",
    "what was put into an installed module": (
        "import json\njson.gain_of_mine = lambda t: {gain} * t\n"
        "def push(t): return json.gain_of_mine(t)"
    ),
    "a number put into an installed module": (
        "import json\njson.number_of_mine = {gain}\ndef push(t): return json.number_of_mine * t"
    ),
    "a file that is opened for a reader": (
        "import json\ndef push(t): return {gain} * json.load(open('curve.json'))"
    ),
    "a spline": (
        "from scipy.interpolate import CubicSpline\nimport numpy as np\n"
        "push = CubicSpline([0.0, 1.0, 2.0], [0.0, 1.0, {gain}])"
    ),
    "what stays behind in copies": (
        "class C:\n    def __init__(self, g): self.g = g\n"
        "    def __getstate__(self): return {{}}\n"
        "    def __call__(self, t): return self.g * t\npush = C({gain})"
    ),
    "what __reduce__ leaves out": (
        "class C:\n    def __init__(self, g=0.0): self.g = g\n"
        "    def __reduce__(self): return C, ()\n"
        "    def __call__(self, t): return self.g * t\npush = C({gain})"
    ),
    "numbers of objects that are weakly held": (
        "from weakref import WeakKeyDictionary\nclass C: pass\nkept = C()\n"
        "GAINS = WeakKeyDictionary({{kept: {gain}}})\ndef push(t): return GAINS[kept] * t"
    ),
    "weakly held values": (
        "from weakref import WeakValueDictionary\nclass C:\n    g = 1.0\nkept = C()\n"
        "kept.g = {gain}\nALL = WeakValueDictionary(a=kept)\ndef push(t): return ALL['a'].g * t"
    ),
    "vectorised": "import numpy as np\npush = np.vectorize(lambda t: {gain} * t)",
    "an attribute of a module": "import helper\ndef push(t): return helper.GAIN * t",
    "a function of a module": "import helper\ndef push(t): return helper.body(t)",
    "a class of a module": "import helper\ndef push(t): return helper.Table.slope * t",
    "taken from a module": "from helper import body\ndef push(t): return body(t)",
    "imported within": "def push(t):\n    import helper\n    return helper.body(t)",
    "taken from a module within": ("def push(t):\n    from helper import body\n    return body(t)"),
    "a module as a value": "import helper as h\ndef push(t): return getattr(h, 'GAIN') * t",
    "text that is run": "push = eval('lambda t: {gain} * t')",
    "CasADi": (
        "import casadi as ca\nx = ca.SX.sym('x')\npush = ca.Function('push', [x], [{gain} * x])"
    ),
    "CasADi in a closure": (
        "import casadi as ca\nx = ca.SX.sym('x')\nF = ca.Function('F', [x], [{gain} * x])\n"
        "def push(t): return float(F(t))"
    ),
}


HIDING = {
    "import sys\ndef push(t): return sys.modules['helper'].GAIN": "looks up names as it runs",
    "import sys\ndef push(t): return float(sys.argv[1])": "reads the command line",
    "import subprocess as s\ndef push(t): return s.run('rig')": "runs another program",
    "def push(t):\n    import subprocess\n    return subprocess.run('rig')": "runs another program",
    "from os import system\ndef push(t): return system('rig')": "runs another program",
    "import os\ndef push(t): return os.popen('rig')": "runs another program",
    "from urllib.request import urlopen\ndef push(t): return urlopen('rig')": "other machines",
    "import sqlite3\ndef push(t): return sqlite3.connect('rig')": "asks a database",
    "from pathlib import Path\ndef push(t): return Path(f'{t}').open().read()": "reads a file",
    "from pathlib import Path\nHERE = Path()\ndef push(t): return (HERE / f'{t}').open()": (
        "reads a file"
    ),
    "import numpy as np\n"
    "def push(t): return np.loadtxt('curve.csv') + np.loadtxt(f'{t}.csv')": "reads a file",
}
"""Lines whose push asks what stands elsewhere, and how that is said."""


def made(folder, text: str, gain: float, before: str = "", behind: str = "", helper: str = HELPER):
    """``push`` of a module with these lines, run from a file."""
    (folder / "helper.py").write_text(before + helper.format(gain=gain) + behind)
    (folder / "mine.py").write_text(before + text.format(gain=gain) + "\n" + behind)
    return importlib.import_module("mine").push


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with as_written():
        yield tmp_path


def anew(place, *arguments, **more):
    for name in ("mine", "helper"):
        sys.modules.pop(name, None)
    importlib.invalidate_caches()
    return digest_of(made(place, *arguments, **more))


@pytest.mark.parametrize("kind", KINDS)
def test_a_change_is_seen_wherever_it_stands_and_nothing_else(place, kind):
    (place / "curve.json").write_text("1.0")
    first = anew(place, KINDS[kind], 2.0)
    assert first.doubts == ()
    assert anew(place, KINDS[kind], 2.0) == first
    assert anew(place, KINDS[kind], 3.0).text != first.text
    before = "# a comment\n\nUNUSED_HERE = 1\n\n"
    behind = "\n\ndef other(t):\n    return 17.0 * t  # nobody calls it\n"
    if kind in (
        "a module as a value",
        "imported within",
    ):  # whatever stands there could be asked for
        before, behind = "# a comment\n\n", ""
    assert anew(place, KINDS[kind], 2.0, before, behind) == first


def test_an_attribute_that_is_set_on_a_module_as_it_runs_is_seen(place):
    push = made(place, KINDS["an attribute of a module"], 2.0)
    first = digest_of(push)
    sys.modules["helper"].GAIN = 5.0
    assert push(1.0) == 5.0
    assert digest_of(push).text != first.text


def test_the_digest_is_the_same_in_another_process(tmp_path):
    """Sets and dictionaries are in another order there; objects at other places."""
    script = tmp_path / "all.py"
    script.write_text(
        "import sys, importlib\nfrom pathlib import Path\n"
        "from pam_ocp.core.digest import digest_of\n"
        "G = {'beta': {1.0, 'b', (2, 'c')}, 'alpha': frozenset('xyz')}\n"
        "def sets(t): return G if t in {'a', 'b', 'c'} else 0\n"
        "print(digest_of(sets).text)\n"
        "for name in sys.argv[1:]:\n"
        "    print(digest_of(importlib.import_module(name).push).text)\n"
    )
    names = []
    (tmp_path / "helper.py").write_text(HELPER.format(gain=2.0))
    for number, text in enumerate(KINDS.values()):
        (tmp_path / f"kind{number}.py").write_text(text.format(gain=2.0))
        names.append(f"kind{number}")
    found = []
    for seed in ("1", "2"):
        command = [sys.executable, "-B", str(script), *names]
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        done = subprocess.run(
            command, env=environment, capture_output=True, text=True, check=True, cwd=tmp_path
        )
        found.append(done.stdout.split())
    assert found[0] == found[1]
    assert len(found[0]) == len(names) + 1


def outside(t):
    return open(f"{t}.csv").read()


def surroundings(t):
    return float(__import__("os").environ["GAIN"])


def named_late(t):
    return importlib.import_module(f"helper{t}").body(t)


class Locked:
    def __init__(self):
        self.lock = threading.Lock()

    def __call__(self, t):
        return t


def counting():
    yield 1.0


def called_back():
    class Double(ca.Callback):
        def __init__(self):
            ca.Callback.__init__(self)
            self.construct("double")

        def eval(self, arguments):
            return [2 * arguments[0]]

    double, x = Double(), ca.MX.sym("x")
    called_back.kept = double
    return ca.Function("f", [x], [double(x)])


def at_the_clock(t):
    return t + time.time()


def by_the_date(t):
    return datetime.datetime.now()


@pytest.mark.parametrize(
    ("thing", "words"),
    [
        (at_the_clock, "at_the_clock asks the clock"),
        (by_the_date, "by_the_date asks the clock"),
        (outside, "outside reads a file that is named as it runs"),
        (surroundings, "surroundings imports what is named as it runs"),
        (named_late, "named_late imports what is named as it runs"),
        (Locked(), "a lock has a state that cannot be read"),
        (counting(), "counting has a state that cannot be read"),
        (np.frompyfunc(lambda t: 2 * t, 1, 1), "a ufunc has a state that cannot be read"),
        (functools.partial(lambda f, t: t, open(__file__)), "TextIOWrapper has a state"),  # noqa
        (called_back(), "a Function calls compiled code"),
    ],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)
def test_what_cannot_be_told_is_named(thing, words):
    assert any(words in doubt for doubt in digest_of(thing).doubts)
    assert digest_of([1.0, {"u": thing}]).doubts == digest_of(thing).doubts


@pytest.mark.parametrize("lines", HIDING)
def test_what_a_function_asks_outside_of_its_code_is_named(place, monkeypatch, lines):
    (place / "curve.csv").write_text("1.0\n")
    (place / "mine.py").write_text(lines)
    assert any(
        HIDING[lines] in doubt for doubt in digest_of(importlib.import_module("mine").push).doubts
    )
    if "loadtxt" not in lines:  # files of one's own are looked through as a whole
        assert any(HIDING[lines] in doubt for doubt in behind("mine.py", place).doubts)


def test_what_is_called_as_a_reader_but_is_none_is_no_doubt(place):
    text = "class V:\n    def open(self, t): return t\nv = V()\ndef push(t): return v.open(t)"
    assert anew(place, text, 1.0).doubts == ()


def test_a_file_that_a_function_names_counts_by_its_content(place):
    (place / "curve.csv").write_text("1.0\n")
    text = (
        "import numpy as np\nfrom pathlib import Path\n"
        "def push(t): return {gain} * np.loadtxt(Path(__file__).with_name('curve.csv'))"
    )
    first = anew(place, text, 1.0)
    assert first.doubts == ()
    (place / "curve.csv").write_text("2.0\n")
    assert anew(place, text, 1.0).text != first.text


def test_what_was_computed_meanwhile_is_no_change():
    class Area:
        def __init__(self, radius):
            self.radius = radius

        @functools.cached_property
        def area(self):
            return np.pi * self.radius**2

    area = Area(2.0)
    first = digest_of(area)
    assert area.area > 12.0
    assert digest_of(area) == first


def test_what_a_dispatcher_remembers_and_a_lock_are_no_change():
    @functools.singledispatch
    def push(t):
        return t

    class Guarded:
        def __init__(self):
            self.lock = threading.Lock()

        def __getstate__(self):
            return {}

    first = digest_of(push), digest_of(Guarded())
    assert push(2.0) == 2.0
    assert (digest_of(push), digest_of(Guarded())) == first
    assert first[1].doubts == ()


def test_equal_content_is_told_by_what_it_says_and_not_by_where_it_lies():
    shared = [1.0, 2.0]
    assert digest_of([shared, shared]) == digest_of([[1.0, 2.0], [1.0, 2.0]])
    assert digest_of({"a": 1, "b": 2}) == digest_of({"b": 2, "a": 1})
    others = [1, 1.0, "1", True, [1], (1,), {1}, {1: None}, np.float64(1), np.array([1]), None]
    assert len({digest_of(v).text for v in others}) == len(others)


# ---- files ---------------------------------------------------------------------------------------
def test_behind_a_python_file_stand_the_files_that_it_imports_and_names(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    package = tmp_path / "rig"
    package.mkdir()
    files = {
        "mine.py": "import numpy\nfrom rig import masses\ndef build(muscle): ...\n",
        "rig/__init__.py": "",
        "rig/masses.py": "from .units import GRAM\nimport json\nDATA = 'curve.csv'\n",
        "rig/units.py": "GRAM = 1e-3\n",
        "rig/curve.csv": "1\n",
        "rig/other.py": "",
        "plant.toml": "arrangement = 'mine.py:build'\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    found = behind({"plant": ["plant.toml"]}, tmp_path)
    names = {p.relative_to(tmp_path).as_posix() for p in found.files}
    assert names == set(files) - {"rig/other.py"}
    assert found.doubts == []
    (tmp_path / "mine.py").write_text("import importlib\nimportlib.import_module('rig.' + 'x')\n")
    (doubt,) = behind("mine.py:build", tmp_path).doubts
    assert doubt == "mine.py imports what is named as it runs (import_module)"


def test_comments_and_lines_of_a_python_file_do_not_count(tmp_path):
    path = tmp_path / "mine.py"
    path.write_text("def f(t):\n    return 2 * t\n")
    first = content_digest(path)
    path.write_text("# new\n\n\ndef f(t):  # twice\n    return 2 * t\n")
    assert content_digest(path) == first
    path.write_text("def f(t):\n    return 3 * t\n")
    assert content_digest(path) != first


def test_a_module_is_read_as_it_is_now_and_the_one_from_before_comes_back(tmp_path, monkeypatch):
    """Also within the same second, at the same length, where Python's own cache sees no change."""
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "gains_of_mine.py"
    path.write_text(textwrap.dedent("GAIN = 2.0\n"))
    import gains_of_mine as before

    stamp = path.stat()
    path.write_text("GAIN = 3.0\n")
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    with as_written():
        import gains_of_mine as now

        assert now.GAIN == 3.0
    import gains_of_mine as after

    assert after is before
    del sys.modules["gains_of_mine"]

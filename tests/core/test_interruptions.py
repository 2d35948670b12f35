"""Ctrl-C at every moment of a verb, one after the other: what comes out is KeyboardInterrupt.

Python calls a signal's handler where a function begins, behind a call of C and within CasADi, which
asks for signals (PyErr_CheckSignals). The first two are met by a profiler that sends the signal at
its n-th event, the third by a library that is loaded before Python and sends it at the n-th time.
"""

import gc
import os
import shutil
import signal
import subprocess
import sys
import textwrap
from functools import cache
from pathlib import Path

import pytest
from conftest import pushed

import pam_ocp as pam
from pam_ocp.core.interrupts import INTERRUPTS
from pam_ocp.core.stop import LOCK, turns

# an error that a handler raises in a generator that is thrown away is told, and raised again
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
posix = pytest.mark.skipif(os.name != "posix", reason="sends a signal to this thread")
HERE = Path(__file__).parent
DENSE = int(os.environ.get("PAM_MOMENTS", "11"))
"""The slow tests try one moment of so many; with PAM_MOMENTS=1 all of them (minutes)."""


class Injector:
    """Sends SIGINT at the n-th moment of some work."""

    def __init__(self, work):
        self.work, self.at, self.n, self.moments = work, 0, 0, []

    def _event(self, frame, event, arg):
        if event not in ("call", "c_return", "c_exception") or arg is sys.setprofile:
            return
        if frame.f_code.co_filename == __file__:
            return
        self.n += 1
        if not self.at:
            self.moments.append((frame.f_code, frame.f_lasti))
        elif self.n == self.at:
            sys.setprofile(None)
            signal.raise_signal(signal.SIGINT)

    def run(self, at=0):
        self.at, self.n = at, 0
        sys.setprofile(self._event)
        try:
            return self.work()
        finally:
            sys.setprofile(None)

    def ends(self, every=1):
        """{n: how it ended} of what did not end by KeyboardInterrupt, or left something behind: at
        the first and the last time that each place in the code is reached.
        """
        self.run()
        first, last = {}, {}
        for n, place in enumerate(self.moments, 1):
            first.setdefault(place, n)
            last[place] = n
        found = {}
        for n in sorted({*first.values(), *last.values()})[::every]:
            try:
                self.run(n)
                end = "returned" if self.n >= n else "KeyboardInterrupt"  # it was not reached
            except BaseException as error:
                end = type(error).__name__
            if end != "KeyboardInterrupt" or left():
                code, at = self.moments[n - 1]
                found[n] = f"{end} {left()} at {code.co_filename}: {code.co_qualname} {at}"
        return found


def left():
    """What a verb that ended must not leave."""
    state = INTERRUPTS.depth, INTERRUPTS.native, INTERRUPTS.held, INTERRUPTS.error
    found = [] if state == (0, 0, 0, None) else [state]
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        found.append("a handler")
    if INTERRUPTS._before:
        found.append("handlers to put back")
    if LOCK._is_owned():
        found.append("the lock")
    return found


@pytest.fixture(autouse=True)
def python_handler(monkeypatch):
    # pytest's own hook is Python: a signal within it would be lost with what it was told
    monkeypatch.setattr(sys, "unraisablehook", lambda told: None)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    gc.disable()  # so that the work goes the same way each time
    yield
    gc.enable()
    signal.signal(signal.SIGINT, before)


def planner():
    stops = [{"x": 0.0}, {"x": 0.3}]
    method = pam.Collocation(4, 2)
    return pam.Planner(pushed(2.0, mass=1.0), stops, method=method, minimise="effort", duration=1.0)


@posix
@pytest.mark.parametrize("every", [17, pytest.param(DENSE, marks=pytest.mark.slow)])
def test_ctrl_c_comes_out_of_a_planner_wherever_it_falls_and_the_planner_can_be_used_again(every):
    made = planner()
    first = made()
    wanted = made(values={"mass": 1.2}, guess=first)
    again = Injector(lambda: made(values={"mass": 1.2}, guess=first))
    assert again.ends(every) == {}
    assert len(again.moments) > 3000
    after = made(values={"mass": 1.2}, guess=first)
    assert after.objective == wanted.objective
    assert after.verified


@turns
def short():
    return 1


def hanging():
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0)
    return plant, pam.equilibrium(plant, {"muscle.pressure": 2e5})


@cache
def works():
    """{name: what is done again and again}, each from what stands ready."""
    plant, point = hanging()
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)
    cart = pushed(2.0, mass=1.0)
    # 2500 fits, each begun anew: the least that goes through all of it
    pushes = pam.simulate(cart, {"u": 1.0}, t=[0.05 * i for i in range(8)])
    weights = {"track": {"x": 1.0}, "rate": {"muscle.command": 0.1}}
    mpc = pam.Mpc(plant, horizon=5, sample_time=0.01, compiled=False, **weights)
    said = {"sample_time": 0.01, "measured": {"x": 1e-4}, "start": point}
    kalman = pam.KalmanFilter(plant, **said)
    window = pam.control.MovingHorizonEstimator(plant, horizon=4, **said)
    now = {"x": point["x"], "v": 0.0, "muscle.pressure": 2e5}
    return {
        "a short call": short,
        "build": planner,
        "simulate": lambda: pam.simulate(plant, {"muscle.command": 3e5}, duration=0.01),
        "fit_force": lambda: pam.fit_force(table),
        "fit_plant": lambda: pam.fit_plant(cart, pushes, ["mass"], outputs=["x"]),
        "mpc": lambda: mpc.control(now, {"x": 0.045}),
        "kalman": lambda: (kalman.correct({"x": 0.041}), kalman.predict({"muscle.command": 2e5})),
        "window": lambda: (window.correct({"x": 0.041}), window.predict({"muscle.command": 2e5})),
        "point": lambda: (point["x"], point.poles, point.stability, str(point)),
    }


@posix
@pytest.mark.parametrize(
    ("name", "every"),
    [
        ("a short call", 1),
        ("build", 101),
        ("simulate", 7),
        ("fit_force", 31),
        ("fit_plant", 1501),
        ("mpc", 3),
        ("kalman", 3),
        ("window", 5),
        ("point", 1),
        *(
            pytest.param(n, DENSE, marks=pytest.mark.slow)
            for n in ("build", "simulate", "fit_force", "fit_plant", "mpc", "kalman", "window")
        ),
    ],
)
def test_ctrl_c_comes_out_of_what_stands_in_a_loop_wherever_it_falls(name, every):
    work = works()[name]
    for _ in range(3):
        work()  # what is loaded and kept
    injector = Injector(work)
    assert injector.ends(every) == {}
    assert injector.moments
    work()


SHIM = """
#define _GNU_SOURCE
#include <dlfcn.h>
extern void PyErr_SetInterrupt(void);
long shim_count = 0, shim_at = -1;
int PyErr_CheckSignals(void) {
    static int (*real)(void);
    if (!real) real = (int (*)(void))dlsym(RTLD_NEXT, "PyErr_CheckSignals");
    if (++shim_count == shim_at) PyErr_SetInterrupt();
    return real();
}
"""
WITHIN = """
import ctypes, os, signal, sys, warnings
sys.path.insert(0, {here!r})
import test_interruptions as tests
signal.signal(signal.SIGINT, signal.default_int_handler)
shim = ctypes.CDLL(os.environ["LD_PRELOAD"])
count, at = (ctypes.c_long.in_dll(shim, "shim_" + name) for name in ("count", "at"))
made = tests.planner()
first = made()
everything = tests.works()
everything["planner"] = lambda: made(values={{"mass": 1.2}}, guess=first)
for name in {names!r}:
    work = everything[name]
    for _ in range(3):
        work()
    at.value, count.value = -1, 0
    work()
    total, wrong = count.value, []
    for n in range(1, total + 1, max(1, total // 40)):
        count.value, at.value = 0, n
        try:
            work()
            end = "returned" if count.value >= n else "KeyboardInterrupt"
        except BaseException as error:
            end = type(error).__name__
        at.value = -1
        if end != "KeyboardInterrupt" or tests.left():
            wrong.append((n, end, tests.left()))
    print(name, total > 0, wrong)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="a library is loaded before Python")
@pytest.mark.parametrize(
    "names",
    [
        ["planner", "point", "simulate", "mpc", "kalman"],
        pytest.param(["build", "fit_force", "fit_plant", "window"], marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_within_casadi_comes_out_wherever_casadi_asks_for_it(tmp_path, names):
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler here")
    (tmp_path / "shim.c").write_text(SHIM)
    library = tmp_path / "shim.so"
    command = [compiler, "-shared", "-fPIC", "-o", library, tmp_path / "shim.c", "-ldl"]
    subprocess.run(command, check=True)
    script = textwrap.dedent(WITHIN).format(here=str(HERE), names=names)
    paths = os.pathsep.join([str(HERE.parents[1]), *filter(None, sys.path)])
    plain = {n: v for n, v in os.environ.items() if not n.startswith("COV")}
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", script],
        env={**plain, "LD_PRELOAD": str(library), "PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=False,
    )
    if f"{names[0]} False" in done.stdout:
        pytest.skip("Python does not take the function from a library")
    assert done.stdout.splitlines() == [f"{name} True []" for name in names], done.stderr[-3000:]

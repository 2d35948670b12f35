"""Stopping: Ctrl-C, SIGTERM and time limits end verbs, each in a process of its own."""

import _thread
import importlib
import importlib.util
import inspect
import math
import os
import random
import re
import signal
import subprocess
import sys
import textwrap
import threading
import time
import weakref
from pathlib import Path

import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.core.errors import OutOfTime
from pam_ocp.core.interrupts import interruptible
from pam_ocp.core.lazy import lazily
from pam_ocp.core.stop import TimeIsUp, check, deadline, limited, native, spared, verb
from pam_ocp.fitting.static import force_fit
from pam_ocp.numerics.continuation import Walk
from pam_ocp.operating.rest import Rest
from pam_ocp.planning import Collocation
from pam_ocp.plants import RegulatedLoad
from pam_ocp.vibration.hopf_bifurcation import BorderWalk

ROOT = Path(__file__).parents[2]
posix = pytest.mark.skipif(os.name != "posix", reason="signals are sent to processes")


def interrupts():
    path = ROOT / "benchmarks" / "interrupts.py"
    found = importlib.util.spec_from_file_location("interrupts", path)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def slide():
    return pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10)


STOPS = [{"x": -0.015}, {"x": 0.015}]


# ---- Ctrl-C --------------------------------------------------------------------------------------
@posix
@pytest.mark.parametrize("name", ["simulate", "plan", "bootstrap"])
def test_ctrl_c_ends_a_verb_at_any_moment(name):
    after = random.uniform(0.05, 1.5)
    assert interrupts().interrupted(name, after)[0] == "KeyboardInterrupt", after


@posix
@pytest.mark.slow
@pytest.mark.parametrize("within", ["0.3", "2"])
def test_ctrl_c_ends_every_verb_at_any_moment(within):
    """Soon after its start, where modules are loaded, and later."""
    path = ROOT / "benchmarks" / "interrupts.py"
    seed = str(random.SystemRandom().randrange(10**6))
    command = [sys.executable, path, "--tries", "1", "--within", within, "--seed", seed]
    # a tracer's own locks are none of ours: what a handler raises in it would keep them for ever
    plain = {name: value for name, value in os.environ.items() if not name.startswith("COV")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=plain)
    assert done.returncode == 0, f"seed {seed}\n{done.stdout}{done.stderr[-6000:]}"
    assert all(f"| {name} | 1 | 0 | 0 |" in done.stdout for name in interrupts().VERBS)


def test_what_a_call_swallows_comes_out_behind_it():
    """As CasADi does: the handler's KeyboardInterrupt ends in a RuntimeError, or in nothing."""

    def swallows(then):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if then is not None:
                raise then from None

    before = signal.getsignal(signal.SIGINT)
    for then in (None, RuntimeError("KeyboardInterrupt"), SystemError()):
        with pytest.raises(KeyboardInterrupt):
            native(swallows, then)
        with pytest.raises(KeyboardInterrupt):
            verb(swallows)(then)
    assert signal.getsignal(signal.SIGINT) is before
    check()  # and it is over


def test_ctrl_c_while_a_name_is_loaded_comes_out_as_itself(tmp_path, monkeypatch):
    """Python below 3.12 makes a RuntimeError of what is raised while a class is made."""
    body = """
        import signal
        class Interrupted:
            def __set_name__(self, owner, name):
                signal.raise_signal(signal.SIGINT)
        class Noun:
            member = Interrupted()
    """
    (tmp_path / "face_of_a_test").mkdir()
    (tmp_path / "face_of_a_test" / "noun.py").write_text(textwrap.dedent(body))
    monkeypatch.syspath_prepend(tmp_path)
    ask, _ = lazily("face", "face_of_a_test", {"Noun": "noun"})
    with pytest.raises(KeyboardInterrupt):
        ask("Noun")


def test_what_gets_lost_in_python_too_is_raised_again_within_the_verb():
    """__del__ prints what it raises; nothing in the loop asks."""

    class Dropped:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    @verb
    def works():
        Dropped()
        for i in range(100):
            time.sleep(0.1)
            reached.append(i)

    reached = []
    with pytest.raises(KeyboardInterrupt):
        works()
    assert len(reached) < 100


def test_what_gets_lost_in_a_callback_of_a_weak_reference_comes_out_of_a_picture(monkeypatch):
    """As matplotlib has them: Python prints what is raised in one, and goes on."""
    from matplotlib.axes import Axes

    class Dropped:
        pass

    def interrupted(*arguments, **named):
        dropped = Dropped()
        _ = weakref.ref(dropped, lambda _: signal.raise_signal(signal.SIGINT))
        del dropped
        return drawn(*arguments, **named)

    motion, drawn = pam.Trajectory([0.0, 1.0], {"x": [0.0, 1.0]}), Axes.plot
    monkeypatch.setattr(Axes, "plot", interrupted)
    with pytest.raises(KeyboardInterrupt):
        motion.plot()


def test_a_set_of_weak_references_drops_what_is_gone_before_a_handler_raises():
    class Dropped:
        pass

    @verb
    def works():
        for kept in (weakref.WeakSet(), weakref.WeakKeyDictionary()):
            dropped = Dropped()
            if isinstance(kept, weakref.WeakSet):
                kept.add(dropped)
            else:
                kept[dropped] = 1
            sys.settrace(traced)
            del dropped
            sys.settrace(None)
            left.append(len(kept.data))

    def traced(frame, event, argument):
        if frame.f_code.co_name in ("_remove", "remove"):
            signal.raise_signal(signal.SIGINT)

    left, before = [], sys.gettrace()
    try:
        with pytest.raises(KeyboardInterrupt):
            works()
    finally:
        sys.settrace(before)
    assert left == [0, 0]


def test_every_picture_is_drawn_as_a_verb_is():
    found = 0
    for name in ("control", "film", "plan", "sheets", "tables", "trajectory", "vibration"):
        module = importlib.import_module(f"pam_ocp.figures.{name}")
        for word, thing in vars(module).items():
            if word.startswith("plot_") and thing.__module__ == module.__name__:
                within = inspect.unwrap(thing).__code__.co_names  # or what it calls is
                assert hasattr(thing, "__wrapped__") or "_drawn" in within, word
                found += 1
    assert found > 30


def test_who_cleans_up_behind_ctrl_c_is_not_disturbed():
    @verb
    def works():
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            for i in range(3):
                time.sleep(0.1)
                cleaned.append(i)

    cleaned = []
    with pytest.raises(KeyboardInterrupt):
        works()
    assert cleaned == [0, 1, 2]


def test_an_import_is_not_broken_off_in_the_middle(tmp_path, monkeypatch):
    body = "import signal\nsignal.raise_signal(signal.SIGINT)\nwhole = True\n"
    (tmp_path / "module_of_a_test.py").write_text(body)
    monkeypatch.syspath_prepend(tmp_path)

    @verb
    def works():
        import module_of_a_test  # noqa: F401

        time.sleep(10.0)
        reached.append(1)

    reached = []
    with pytest.raises(KeyboardInterrupt):
        works()
    assert sys.modules.pop("module_of_a_test").whole
    assert not reached


@posix
def test_a_process_forked_within_a_verb_has_signals_of_its_own():
    """Its parent's interrupt is none of its business, nor are its parent's handlers."""

    @verb
    def forks():
        child = os.fork()
        if child == 0:
            found = signal.getsignal(signal.SIGINT) is before
            os._exit(0 if found else 1)
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])

    before = signal.getsignal(signal.SIGINT)
    assert forks() == 0


def test_a_handler_that_raises_nothing_interrupts_nothing():
    seen = []
    before = signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        native(signal.raise_signal, signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)
    assert seen == [signal.SIGINT]


# ---- time limits ---------------------------------------------------------------------------------
def test_the_shorter_of_two_limits_counts():
    with limited(1000.0):
        assert 900 < deadline().remaining() <= 1000
        with limited(2000.0):
            assert deadline().remaining() <= 1000
        with limited(10.0):
            assert deadline().remaining() <= 10
    assert deadline().remaining() == math.inf


def test_an_outer_limit_is_not_taken_for_an_inner_one():
    def inner():
        with limited(500.0):
            check()

    def outer():
        with limited(0.01):
            time.sleep(0.02)
            with spared(100.0):
                check()
            with pytest.raises(TimeIsUp):
                inner()
            check()

    refused(r"time_limit = 0\.01 s", outer, error=OutOfTime)


def test_a_time_limit_breaks_off_one_long_call_of_the_integrator():
    with pytest.raises(OutOfTime, match=r"time_limit = 0\.2 s"):
        pam.simulate(slide(), t=[0.0, 2e5], step=1e-4, max_steps=10**9, time_limit=0.2)


def test_a_plan_that_is_not_found_in_time_is_an_error_that_says_so():
    with pytest.raises(pam.PlanError, match=r"time_limit = 0\.001 s was over before a plan"):
        pam.plan(slide(), STOPS, time_limit=0.001)


def test_the_best_plan_so_far_is_returned_unverified(monkeypatch):
    """The time is up in the first round of refinement."""
    from pam_ocp.planning.continuation import Continuation

    def over(self, *_):
        raise TimeIsUp

    monkeypatch.setattr(Continuation, "_finer", over)
    with pytest.warns(pam.PlanWarning, match="before the search was done"):
        plan = pam.plan(slide(), STOPS, method=Collocation(6), tolerance=1e-9, time_limit=1000.0)
    assert plan.solved
    assert not plan.verified
    assert "time_limit = 1000 s was over" in str(plan.verdict)


def test_a_limit_that_is_not_reached_changes_nothing():
    method = Collocation(10)
    one, other = (pam.plan(slide(), STOPS, method=method, time_limit=t) for t in (None, 1e4))
    assert other.verified
    assert other.duration == one.duration


def test_a_bootstrap_keeps_the_samples_that_it_has(monkeypatch):
    table = pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)
    own, drawn = force_fit._resampled, []

    def resampled(*args):
        drawn.append(1)
        if len(drawn) == 60:
            deadline().end = time.monotonic()
        return own(*args)

    monkeypatch.setattr(force_fit, "_resampled", resampled)
    whole = pam.fit_force(table)
    found = whole.bootstrap(10**7, executor=0, time_limit=1000.0)
    assert 2 <= len(found.samples) < 60
    assert "time_limit = 1000 s was over" in found.ended
    monkeypatch.undo()
    same = whole.bootstrap(len(found.samples), executor=0)
    assert found.samples.tolist() == same.samples.tolist()


def over_at_call(monkeypatch, cls, name, number):
    """The time is up when a method is called for the n-th time."""
    own, calls = getattr(cls, name), []

    def called(*args, **kwargs):
        calls.append(1)
        if len(calls) == number:
            raise TimeIsUp
        return own(*args, **kwargs)

    monkeypatch.setattr(cls, name, called)


def test_a_branch_of_rest_keeps_the_points_that_it_has(monkeypatch):
    plant = pam.HangingLoad("DMSP-20-300")
    asked = (plant, "mass", 5.0, 60.0, {"muscle.command": 3e5})
    whole = pam.operating.equilibrium_branch(*asked)
    over_at_call(monkeypatch, Walk, "advance", 4)
    found = pam.operating.equilibrium_branch(*asked, time_limit=1000.0)
    assert found.end == "time_limit = 1000 s was over"
    assert found.values.tolist() == whole.values[:4].tolist()


def test_a_path_of_rest_keeps_the_points_that_it_has():
    def values():
        yield from (10.0, 11.0)
        deadline().end = time.monotonic()
        yield 12.0

    plant = pam.HangingLoad("DMSP-20-300")
    at = {"muscle.command": 3e5}
    found = pam.operating.equilibrium_path(plant, "mass", values(), at, time_limit=1000.0)
    assert found.end == "time_limit = 1000 s was over"
    assert found.values.tolist() == [10.0, 11.0]


def test_a_search_for_points_of_rest_keeps_what_it_has(monkeypatch):
    plant = pam.HangingLoad("DMSP-20-300")
    at = {"muscle.command": 3e5}
    (whole,) = pam.operating.equilibria(plant, at)
    over_at_call(monkeypatch, Rest, "newton", 3)
    found = pam.operating.equilibria(plant, at, time_limit=1000.0)
    assert found.ended == "time_limit = 1000 s was over"
    assert [p["x"] for p in found] == pytest.approx([whole["x"]], rel=1e-9)


def test_a_border_of_vibration_keeps_the_points_that_it_has(monkeypatch):
    plant = RegulatedLoad(pam.muscle("DMSP-20-400N"), mass=20.0, lag=0.1)
    rest = {"x": 0.04, "muscle.reference": 0.04}
    asked = (plant, "muscle.gain", (1e5, 5e7), "muscle.lag", [0.1, 0.11, 0.12], rest)
    over_at_call(monkeypatch, BorderWalk, "_near", 2)
    found = pam.vibration.hopf_border(*asked, time_limit=1000.0)
    assert found.points[0] is not None
    assert found.points[1] is None
    assert found.reasons[0.11] == "time_limit = 1000 s was over"


def test_a_branch_of_cycles_keeps_what_it_has(monkeypatch):
    plant = RegulatedLoad(pam.muscle("DMSP-20-400N"), mass=20.0, lag=0.1)
    rest = {"x": 0.04, "muscle.reference": 0.04}
    point = pam.vibration.hopf(plant, "muscle.gain", (1e5, 1e7), rest)
    small = pam.vibration.limit_cycle(point.plant, point, amplitude={"x": 2e-3})
    over_at_call(monkeypatch, Walk, "advance", 2)
    within = (0.2 * point.value, 1.5 * point.value)
    found = pam.vibration.continue_cycle(small, "muscle.gain", within, time_limit=1000.0)
    assert found.ended == "time_limit = 1000 s was over"
    assert len(found.cycles) == 2


@pytest.mark.parametrize("wrong", [0.0, -1.0, math.nan, "soon"])
def test_a_time_limit_is_a_positive_number(wrong):
    refused("time_limit", pam.simulate, slide(), duration=0.01, time_limit=wrong)


# ---- processes -----------------------------------------------------------------------------------
@posix
def test_sigterm_ends_the_command_with_143(tmp_path):
    run = "import sys; from pam_ocp.cli.main import main; from pam_ocp.studies import tour as m\n"
    run += "import time\n"
    run += "def wait(*o, **k):\n    print('go', flush=True)\n    time.sleep(60)\n"
    run += "m.tour = wait\nsys.exit(main(['tour']))"
    command = [sys.executable, "-c", run]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        assert process.stdout.readline() == "go\n"
        process.terminate()
        assert process.wait(60) == 143


@posix
def test_a_signal_leaves_no_thread_behind_its_verb(request):
    """A thread that wakes behind the interpreter's end crashes the process (3 of 150 times)."""

    def asked(number, frame):
        raise SystemExit(128 + number)

    def ended():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            time.sleep(0.02)  # in which its thread begins

    before = signal.signal(signal.SIGTERM, asked)
    request.addfinalizer(lambda: signal.signal(signal.SIGTERM, before))
    threads = _thread._count()
    with pytest.raises(SystemExit), interruptible():
        ended()
    assert _thread._count() == threads


# ---- threads -------------------------------------------------------------------------------------
MIXED = """
import random, sys, threading, warnings
import numpy as np
import pam_ocp as pam
warnings.simplefilter("ignore")
muscle = pam.muscle("DMSP-20-300")
slide = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.10)
hanging = pam.HangingLoad(muscle, mass=10.0)
names = [v.name for v in hanging.states]

def call(kind, i):
    at = {"muscle.pressure": 2e5 + 1e3 * i}
    if kind == "simulate":
        return pam.simulate(hanging, duration=0.02 + 1e-3 * i).array(names)[-1].tolist()
    if kind == "equilibrium":
        return np.asarray(pam.equilibrium(hanging, at).x).tolist()
    if kind == "linearize":
        return np.asarray(pam.linearize(hanging, pam.equilibrium(hanging, at)).A).tolist()
    if kind == "force":
        return float(muscle.force(at["muscle.pressure"], 0.1))
    if kind == "build":
        return pam.HangingLoad(muscle, mass=5.0 + i).vector("parameter").tolist()
    stops = [{"x": -0.01}, {"x": 0.01 + 1e-4 * i}]
    return pam.plan(slide, stops, method=pam.Collocation(8), tolerance=None).duration

kinds = ["simulate", "equilibrium", "linearize", "force", "force", "build"]

def calls(seed):
    chosen = random.Random(seed)
    for i in range(100):
        one = (chosen.choice(kinds), chosen.randrange(20))
        yield one if i % 100 else ("plan", chosen.randrange(3))

start = random.SystemRandom().randrange(10**6)
print("seed", start)
wanted = {one: call(*one) for seed in range(start, start + 8) for one in calls(seed)}
done = []

def work(seed):
    for one in calls(seed):
        done.append(call(*one) == wanted[one])

threads = [threading.Thread(target=work, args=(seed,)) for seed in range(start, start + 8)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert len(done) == 800 and all(done), (len(done), sum(done))
print("same")
"""


@pytest.mark.slow
def test_eight_threads_get_what_one_gets():
    done = subprocess.run([sys.executable, "-c", MIXED], capture_output=True, text=True)
    assert done.returncode == 0, (done.stdout, done.stderr[-2000:])
    assert done.stdout.endswith("same\n")


def test_a_verb_in_another_thread_keeps_to_its_time_limit():
    found = []

    def work():
        try:
            pam.plan(slide(), STOPS, tolerance=1e-12, time_limit=0.001)
        except pam.PlanError as error:
            found.append(str(error))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(60)
    assert "time_limit" in found[0]


# ---- no other way --------------------------------------------------------------------------------
def test_no_solver_or_integrator_is_made_but_by_the_wrappers():
    own = {"numerics/solvers.py"}
    made = re.compile(r"\bca\.(?:nlpsol|integrator|rootfinder|conic|qpsol)\(")
    package = ROOT / "pam_ocp"
    found = {
        path.relative_to(package).as_posix()
        for path in package.rglob("*.py")
        if made.search(path.read_text(encoding="utf-8"))
    }
    assert found <= own

"""The loop in C: its guard against the one in Python, its runs on twins, and what ends them."""

import ctypes
import math
import os
import signal
import subprocess
import sys
import zlib

import numpy as np
import pytest
from conftest import refused
from rig_fixtures import instruments, plant  # noqa: F401 - fixtures

import pam_ocp as pam
from pam_ocp.control.blocks.running import Running
from pam_ocp.figures.control import plot_durations
from pam_ocp.rig import real_time
from pam_ocp.rig.guard import Watch

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the loop in C is for Linux")
STEP = 5e-3
PATIENT = pam.rig.Guard(max_age="5 s", late="5 s", heartbeat="5 s")
"""Other processes may take both processors of a machine that tests."""
LIMITS = [
    pam.rig.Reading("x", low="-100 mm", high="200 mm"),
    pam.rig.Reading("muscle.pressure", low="-1 bar", high="20 bar"),
]


@pytest.fixture(scope="module")
def law(plant):
    goal = plant.equilibrium(x=0.04)
    known = pam.control.kalman(
        plant, goal, measured={"x": 1e-5, "muscle.pressure": 200.0}, sample_time=STEP
    )
    regulator = pam.lqr(plant, goal, integral={"x": 20.0}, sample_time=STEP)
    return pam.control.block(pam.control.chain([known, regulator], name="lqg"), plant=plant)


@pytest.fixture
def bench(plant, tmp_path):
    """bench(kind, readings, guard) -> (rig, twin), served in real time."""
    open_ends = []

    def make(kind="udp", readings=LIMITS, guard=PATIENT, commands=None):
        twin = pam.rig.Twin(plant, readings, commands, sensors=instruments())
        served = pam.rig.serve(twin, kind)
        driver = pam.rig.driver(**served.address, timeout=0.2)
        rig = pam.Rig(
            driver,
            readings,
            commands,
            plant=plant,
            guard=guard,
            record=tmp_path,
            sample_time=0.05,  # of soft starts, in Python
        )
        open_ends.extend((served, rig))
        rig.arm()
        return rig, twin

    yield make
    for end in reversed(open_ends):
        end.close()


@pytest.fixture(scope="module")
def library(law, tmp_path_factory):
    place = tmp_path_factory.mktemp("library") / "real_time.so"
    place.write_bytes(real_time._library(law))
    return ctypes.CDLL(str(place))


def test_python_and_c_share_the_same_memory(library):
    library.pam_size.restype = ctypes.c_size_t
    assert library.pam_size() == ctypes.sizeof(real_time.Shared)


def test_the_check_sum_in_c_is_that_of_zlib(library):
    library.pam_crc.restype = ctypes.c_uint32
    for text in (b"123456789", b">7 W 0.5 2.0", b""):
        assert library.pam_crc(text, ctypes.c_size_t(len(text))) == zlib.crc32(text)


CAUSES = {
    real_time.OLD: "nothing valid comes in",
    real_time.NO_NUMBER: "is no number",
    real_time.OUTSIDE: "has left",
    real_time.FAST: "changes by",
    real_time.FROZEN: "stayed the same",
    real_time.ASTRAY: "look at supply",
}


def test_the_guard_in_c_decides_as_the_one_in_python(plant, law, library):
    """Random courses until something is wrong, of every kind."""
    readings = [
        pam.rig.Reading("x", low=-0.05, high=0.05, rate=1.0, frozen=0.04),
        pam.rig.Reading("muscle.pressure", follows="muscle.command", deviation=1e5, within=0.03),
    ]
    guard = pam.rig.Guard(max_age=0.03)
    rig = pam.Rig(
        pam.rig.driver("udp", host="127.0.0.1", port=9), readings, plant=plant, guard=guard
    )
    look, found = library.pam_look, set()
    look.argtypes = [ctypes.c_void_p, ctypes.c_double]
    rng = np.random.default_rng(1)
    for course in range(300):
        shared = real_time.Shared()
        real_time.fill(shared, rig, law, {})
        watch = Watch(guard, rig.readings, rig.commands)
        x, p, stamp, sent = 0.0, 2e5, 0.0, 2e5
        kind = course % 6
        for k in range(1, 200):
            now = 1e-3 * k
            if kind != 0 or rng.random() < 0.02:
                stamp = now - 1e-4 * rng.random()
                x += 1e-5 * rng.normal() * (kind != 4 or rng.random() < 0.1)
            x += {2: 5e-4, 3: 3e-3 * (rng.random() < 0.3)}.get(kind, 0.0)
            p = math.nan if kind == 1 and rng.random() < 0.02 else sent + 100.0 * rng.normal()
            p += 2e5 * (kind == 5 and k > 100) * (rng.random() < 0.995)
            shared.values[:2], shared.stamp = [x, p], stamp
            shared.command[0].sent = sent
            seen = {"x": x, "muscle.pressure": p}
            words = watch.look(now, seen, stamp, {"muscle.command": sent})
            cause = look(ctypes.addressof(shared), now)
            assert bool(words) == bool(cause), (course, k, words, cause)
            if words:
                assert CAUSES[cause] in words
                shared.over = 1
                said = real_time._reason(rig, shared)
                assert said.partition(" for ")[0] == words.partition(" for ")[0]
                found.add(cause)
                break
    assert found == set(CAUSES)


def test_commands_in_c_keep_ranges_and_rates_as_in_python(plant, law, library):
    commands = [pam.rig.Command("muscle.command", low=0.0, high=5e5, rate=2e7)]
    driver = pam.rig.driver("udp", host="127.0.0.1", port=9)
    rig = pam.Rig(driver, commands=commands, plant=plant, readings=LIMITS)
    watch, shared = Watch(rig.guard, rig.readings, rig.commands), real_time.Shared()
    real_time.fill(shared, rig, law, {})
    sent = {"muscle.command": 0.0}
    for asked in np.random.default_rng(2).normal(2e5, 3e5, 200):
        assert library.pam_limit(ctypes.byref(shared), ctypes.byref(ctypes.c_double(asked))) == 0
        sent = watch.limited({"muscle.command": asked}, sent, STEP)
        assert shared.command[0].sent == sent["muscle.command"]
    broken = ctypes.byref(ctypes.c_double(math.nan))
    assert library.pam_limit(ctypes.byref(shared), broken) == real_time.NO_COMMAND


@pytest.mark.parametrize("kind", ["udp", "serial"])
@pytest.mark.slow
def test_a_controller_in_c_moves_a_twin_and_leaves_it_vented(bench, plant, law, kind, tmp_path):
    if kind == "serial":
        pytest.importorskip("serial")
    rig, twin = bench(kind)
    came = []
    run = rig.run_in_c(
        law,
        5.0,
        wanted={"x": lambda t: 0.036 if t < 1.0 else 0.04},
        start=plant.equilibrium(x=0.036),
        seen=lambda rows: came.append(len(rows)),
    )
    assert run.samples == 1000 == len(run.trajectory.t) == sum(came)
    assert run.lost == 0
    assert abs(run.trajectory["x"][0] - 0.036) < 2e-3
    assert abs(run.trajectory["x"][-1] - 0.04) < 3e-4
    assert np.all(np.diff(run.trajectory.t) > 0)
    assert int(run.lateness.counts.sum()) == 1000
    assert not twin.armed
    assert rig.armed  # nothing went wrong
    assert "Linux" in run.report()
    recorded = pam.rig.read_run(tmp_path / "run_0001.csv")  # the last row is vented
    assert np.allclose(recorded["x"][-1001:-1], run.trajectory["x"], rtol=1e-8, atol=1e-12)
    assert rig.run(lambda t: {"muscle.command": 2e5}, 0.5)["x"].size > 5  # the driver goes on


def test_what_was_sent_is_what_the_block_says(bench, plant, law):
    """The readings of a run through the block in Python: the same commands."""
    rig, _ = bench()
    rows = []
    start = plant.equilibrium(x=0.03)
    rig.run_in_c(law, 0.6, wanted={"x": 0.03}, start=start, bumpless=False, seen=rows.extend)
    again, wrong = Running(law, ()), []
    for row in rows:
        again.tell({"x": row[4], "muscle.pressure": row[5], "wanted.x": 0.03})
        asked = again.commands()["muscle.command"]
        wrong.append(abs(min(max(asked, 0.0), rig.commands["muscle.command"].high) - row[6]))
    assert len(wrong) == 120
    assert max(wrong) < 1e-3  # Pa


HOG = """
import os, sys, time
os.sched_setaffinity(0, {int(sys.argv[1])})
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(95))
print("on", flush=True)
while True:
    until = time.monotonic() + 0.06
    while time.monotonic() < until:
        pass
    time.sleep(0.1)
"""


@pytest.mark.slow
def test_a_second_processor_bridges_the_pauses_of_the_first(bench, law):
    """A process of higher priority takes the first one for 60 ms of each 160."""
    allowed = sorted(os.sched_getaffinity(0))
    if len(allowed) < 2 or os.geteuid() != 0:
        pytest.skip("needs two processors, and root for the priority")
    missed = {}
    with subprocess.Popen(
        [sys.executable, "-c", HOG, str(allowed[0])], stdout=subprocess.PIPE
    ) as hog:
        try:
            if not hog.stdout.readline():
                pytest.skip("SCHED_FIFO is not allowed here")
            for cpu in (allowed[0], allowed[:2]):
                rig, _ = bench()
                run = rig.run_in_c(law, 2.0, wanted={"x": 0.04}, cpu=cpu)
                assert run.samples == 400 == int(run.lateness.counts.sum())
                missed[np.size(cpu)] = run.missed
        finally:
            hog.kill()
    assert missed[1] > 80  # of 400, some 150 fall into its turns
    assert missed[2] < missed[1] / 2
    assert "standing by" in run.report()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (pam.rig.Fault("nan", "x"), "x is no number"),
        (pam.rig.Fault("bias", "x", 0.5), "x = .* has left"),
        (pam.rig.Fault("stale"), "nothing valid comes in"),
        (pam.rig.Fault("cable"), "nothing valid comes in"),
    ],
    ids=lambda f: getattr(f, "kind", ""),
)
def test_the_loop_in_c_vents_where_something_is_wrong(bench, law, fault, words, tmp_path):
    guard = pam.rig.Guard(max_age="1 s", late="5 s", heartbeat="5 s")
    rig, twin = bench(guard=guard)
    came = []

    def begins(rows):
        """The fault, in the middle of the run."""
        came.extend(rows)
        if len(came) > 100:
            twin.faults = (fault,)

    with pytest.raises(pam.rig.RealTimeError, match=words) as error:
        rig.run_in_c(law, 30.0, seen=begins)
    run = error.value.run
    assert run.reason == rig.reason
    assert not rig.armed
    assert 100 < run.samples < 15000
    assert run.reaction < 0.05
    if fault.kind != "cable":  # there no vent arrives, and the device has to
        assert not twin.armed
    assert pam.rig.read_run(tmp_path / "run_0001.csv").t.size >= run.samples - 1
    refused("arm", rig.run_in_c, law, 1.0, error=pam.rig.RigError)


def test_a_killed_loop_is_vented_by_the_watchdog(bench, law, monkeypatch):
    guard = pam.rig.Guard(max_age="5 s", late="5 s", heartbeat="0.5 s")
    rig, twin = bench(guard=guard)
    loops, start = [], real_time._Loop.start
    monkeypatch.setattr(real_time._Loop, "start", lambda o, fds: loops.append(o) or start(o, fds))
    acting = []

    def kill(rows):
        if loops[0]._taken > 100 and not acting:
            acting.append(twin.armed)
            os.kill(loops[0]._process.pid, signal.SIGKILL)

    refused(r"died|watchdog has vented", rig.run_in_c, law, 20.0, seen=kill, error=pam.rig.RigError)
    assert acting == [True]
    assert not twin.armed
    assert not rig.armed


def test_what_the_loop_in_c_cannot_do_is_said(bench, plant, law):
    rig, _ = bench()
    state = pam.lqr(plant, plant.equilibrium(x=0.04), sample_time=STEP)
    for controller, options, words in (
        (state, {}, "measures v, which rig does not read"),
        (law, {"wanted": {"y": 1.0}}, "y"),
        (law, {"priority": 100}, "priority"),
        (law, {"cpu": 1023}, "this process may run on"),
        (law, {"cpu": []}, "one processor, or two that differ"),
        (law, {"cpu": [min(os.sched_getaffinity(0))] * 2}, "one processor, or two that differ"),
    ):
        refused(words, rig.run_in_c, controller, 1.0, **options)
    clock = pam.rig.SimulatedClock()
    other = pam.Rig(
        pam.rig.driver("twin", twin=pam.rig.Twin(plant, clock=clock)), plant=plant, clock=clock
    )
    refused("udp and serial", other.run_in_c, law, 1.0)
    bent = pam.rig.Reading("x", "m", scale="V^2 * 1 mm/V^2")
    refused(r"straight line|scale", bent.line, real_time.BENT)


def test_a_histogram_counts_and_draws():
    edges, counts = 1e-6 * np.array([1.0, 2.0, 4.0, math.inf]), np.array([98, 1, 1])
    shown = pam.rig.Histogram(edges, counts, 9e-6)
    assert shown.above(2e-6) == 2
    assert shown.text("late").splitlines()[-1] == "worst 9 us"
    figure = plot_durations({"late": (edges, counts)})
    assert len(figure.axes) == 1

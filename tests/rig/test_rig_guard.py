"""The guard: what goes wrong on a twin, and that the air is out soon after."""

import itertools
import math
import os
import signal
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from conftest import refused
from rig_fixtures import made, plant  # noqa: F401 - fixtures
from rig_tools import child

import pam_ocp as pam
from pam_ocp.rig.guard import Watch, Watchdog

Fault = pam.rig.Fault
AT = 1.0
"""On the twin's clock, in the middle of a run [s]."""
FAULTS = [
    Fault("nan", "x", at=AT),
    Fault("nan", "muscle.pressure", at=AT),
    Fault("stuck", "x", at=AT),
    Fault("stuck", "muscle.pressure", at=AT),
    Fault("spike", "x", 0.02, at=AT),
    Fault("spike", "muscle.pressure", 3e5, at=AT),
    Fault("bias", "x", 0.05, at=AT),
    Fault("bias", "muscle.pressure", -3.5e5, at=AT),
    Fault("gain", "x", -1.0, at=AT),
    Fault("gain", "muscle.pressure", 3.0, at=AT),
    Fault("drift", "x", 5.0, at=AT),
    Fault("stale", at=AT),
    Fault("cable", at=AT, until=AT + 0.036),
    Fault("cable", at=AT),
    Fault("supply", at=AT),
]


def holding(t, seen):
    return {"muscle.command": 3e5 + 2e4 * math.sin(10 * t)}


@pytest.mark.parametrize("fault", FAULTS, ids=lambda f: f"{f.kind}-{f.channel or 'rig'}")
@pytest.mark.parametrize("phase", [0.0, 0.0017])
def test_a_fault_is_answered_by_venting_within_50_ms(made, tmp_path, fault, phase):
    from dataclasses import replace

    at = fault.at + phase
    wanted = [replace(fault, at=at, until=fault.until + phase)]
    alone = "45 ms" if fault == Fault("cable", at=AT) else None  # then only the device can vent
    rig, twin = made(wanted, record=tmp_path, timeout=alone)
    rig.arm()
    with pytest.raises(pam.rig.RigError) as error:
        pam.closed_loop(holding, rig, duration=5.0)
    assert not twin.armed
    assert twin.acting["muscle.command"] == 0.0
    assert at < twin.vented_at <= at + 0.050
    assert not rig.armed
    assert rig.reason in str(error.value)
    run = pam.rig.read_run(tmp_path / "run_0001.csv")
    assert abs(run.t[-2] - twin.vented_at) < 0.1  # whole up to the fault
    refused("arm", rig.run, lambda t: {"muscle.command": 3e5}, 0.1, error=pam.rig.RigError)


def test_a_valve_that_follows_no_more_is_found(made):
    rig, twin = made([Fault("valve", "muscle.command", at=1.0)])
    rig.arm()
    with pytest.raises(pam.rig.RigError, match=r"away from muscle.command.*supply, valve"):
        pam.closed_loop(lambda t, s: {"muscle.command": 2e5 + 1.9e5 * (t > 1.0)}, rig, duration=3.0)
    assert not twin.armed


@pytest.mark.parametrize(
    "answer",
    [
        lambda t: {"muscle.command": math.nan},
        lambda t: {"muscle.command": math.inf},
        lambda t: {"muscle.comand": 1.0},
        lambda t: 1 / 0,
        lambda t: None,
    ],
)
def test_a_controller_that_fails_leaves_the_rig_vented(made, answer):
    rig, twin = made()
    rig.arm()
    with pytest.raises((pam.PamError, ZeroDivisionError)):
        pam.closed_loop(
            lambda t, s: {"muscle.command": 3e5} if t < 0.5 else answer(t), rig, duration=2.0
        )
    assert not twin.armed
    assert twin.vented_at <= 0.5 + 0.050
    assert not rig.armed


def test_commands_keep_ranges_and_rates_whatever_is_asked(plant):
    command = pam.rig.Command("u", "Pa", low=0.0, high=6e5, rate=1e6)
    watch = Watch(pam.rig.Guard(), {}, {"u": command})
    rng, sent = np.random.default_rng(0), {"u": 0.0}
    for asked in rng.normal(0, 1e7, 200):
        now = watch.limited({"u": asked}, sent, 0.005)
        assert 0.0 <= now["u"] <= 6e5
        assert abs(now["u"] - sent["u"]) <= 5e3 + 1e-9
        sent = now


def test_a_run_begins_softly_without_a_bump_and_ends_vented(made, plant):
    point = plant.equilibrium(x=0.04)
    rig, twin = made()
    rig.arm()
    loop = pam.closed_loop(
        lambda t, s: {"muscle.command": point.u[0] + 5e4}, rig, duration=1.0, start=point
    )
    sent = twin.motion()["muscle.command"]
    high = plant.variable("muscle.command").max
    assert np.max(np.abs(np.diff(sent[: np.argmax(sent)]))) < 1.1 * max(0.005 * high, 5e4 * 0.05)
    assert abs(loop["x"][0] - 0.04) < 1e-3
    assert abs(loop["muscle.command"][-2] - point.u[0] - 5e4) < 10.0
    assert not twin.armed
    assert rig.armed


def test_nothing_is_sent_before_it_is_armed(made):
    rig, twin = made()
    for action in (
        lambda: rig.run(lambda t: {"muscle.command": 3e5}, 0.1),
        lambda: rig.home(),
        lambda: rig.identify(["mass"], duration=0.5),
        lambda: pam.closed_loop(holding, rig, duration=0.1),
    ):
        refused("not armed", action, error=pam.rig.RigError)
    rig.check(0.1)
    assert not twin.armed
    assert not np.any(twin.motion()["muscle.command"])


def test_a_rig_with_a_fault_is_not_armed(made):
    rig, _ = made([Fault("nan", "x")])
    refused("x is no number", rig.arm, error=pam.rig.RigError)
    rig, _ = made([Fault("cable")])
    refused("nothing valid", rig.arm, error=pam.rig.RigError)
    assert not rig.armed


def test_a_twin_vents_by_itself_where_no_command_comes(plant):
    clock = pam.rig.SimulatedClock()
    twin = pam.rig.Twin(plant, clock=clock, timeout="40 ms")
    twin.arm()
    twin.write({"muscle.command": 3e5})
    clock.wait(0.039)
    assert twin.acting["muscle.command"] == 3e5
    clock.wait(0.1)
    assert twin.acting["muscle.command"] == 0.0
    assert twin.vented_at == pytest.approx(0.04, abs=1e-9)


# ---- drivers that do not keep their word ---------------------------------------------------------
class Own:
    """A driver that reads 0.03 m on a simulated clock; ``wrong(self, raw)`` changes what it reads
    from ``AT`` on, ``deaf`` refuses commands from then on.
    """

    def __init__(self, wrong=None, deaf=False):
        self.clock, self.wrong, self.deaf = pam.rig.SimulatedClock(), wrong, deaf
        self.acting, self.vented_at, self.first = 0.0, math.nan, True

    def read(self):
        raw = {"x": 0.03, "time": self.clock.now()}
        return self.wrong(self, raw) if self.wrong and self.clock.now() >= AT else raw

    def write(self, inputs):
        if self.deaf and self.clock.now() >= AT:
            raise OSError("the valves are gone")
        self.acting = inputs["u"]

    def vent(self):
        self.acting, self.vented_at = 0.0, self.clock.now()

    def close(self):
        pass

    def run(self, record=None, duration=2.0):
        rig = pam.Rig(
            self,
            [pam.rig.Reading("x", "m", low=-0.1, high=0.1)],
            [pam.rig.Command("u", "Pa", low=0.0, high=6e5)],
            clock=self.clock,
            record=record,
        )
        rig.arm()
        try:
            return rig.run(lambda t: {"u": 3e5}, duration)
        finally:
            assert not rig._running


def once_ahead(own, raw):
    """One stamp lies a thousand seconds ahead: whatever comes next is older."""
    first, own.first = own.first, False
    return {**raw, "time": raw["time"] + 1000.0} if first else raw


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (once_ahead, "1e\\+06 ms ahead of this host's clock"),
        (lambda own, raw: {**raw, "time": math.inf}, "ahead of this host's clock"),
        (lambda own, raw: {**raw, "time": math.nan}, "nan ms old"),
        (lambda own, raw: {**raw, "x": "1,5"}, "nothing valid comes in .*'1,5'"),
        (lambda own, raw: None, "nothing valid comes in .*NoneType"),
        (lambda own, raw: {"time": raw["time"]}, r"nothing valid comes in \('x'\)"),
    ],
)
def test_what_a_driver_reads_wrong_is_found_and_said(wrong, words):
    own = Own(wrong)
    with pytest.raises(pam.rig.RigError, match=words):
        own.run()
    assert own.acting == 0.0
    assert AT <= own.vented_at <= AT + 0.050


def test_a_rig_that_reads_well_and_takes_no_command_is_vented():
    own = Own(deaf=True)
    with pytest.raises(pam.rig.RigError, match=r"no command has been taken .*the valves are gone"):
        own.run()
    assert own.acting == 0.0
    assert AT <= own.vented_at <= AT + 0.050


def test_a_single_command_that_is_not_taken_is_nothing_more_than_lost():
    class Once(Own):
        def write(self, inputs):
            refused, self.deaf = self.deaf, self.deaf and self.clock.now() < AT
            if refused and not self.deaf:
                raise OSError("once")
            self.acting = inputs["u"]

    assert Once(deaf=True).run().duration == pytest.approx(2.0)


@pytest.mark.skipif(sys.platform == "win32", reason="limits of POSIX")
def test_a_record_that_cannot_be_written_vents_and_is_closed_whole(tmp_path):
    import resource

    own, (soft, hard) = Own(), resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4000, hard))
        with pytest.raises(pam.PamError, match=r"run_0001.csv: a line .* was not written"):
            own.run(record=tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert own.acting == 0.0
    run = pam.rig.read_run(tmp_path / "run_0001.csv")
    assert 100 < len(run) < 200
    assert np.all(run["x"] == 0.03)
    assert '"ended": true' in (tmp_path / "run_0001.json").read_text("utf-8")
    if os.path.isdir("/proc/self/fd"):
        left = [os.path.realpath(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")]
        assert not any(name.startswith(str(tmp_path)) for name in left)


def test_a_soft_start_waits_for_rest_where_readings_have_no_limits(plant):
    weak = pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=10.0, damping=10.0)
    clock = pam.rig.SimulatedClock()
    driver = pam.rig.driver("twin", twin=pam.rig.Twin(weak, clock=clock))
    rig = pam.Rig(driver, plant=weak, clock=clock)
    rig.arm()
    point = weak.equilibrium(x=0.04)
    run = rig.run(lambda t: {"muscle.command": point.u[0]}, 0.5, start=point)
    assert np.ptp(run["x"]) < 4e-3 * 0.078  # 1e-3 of its range between means, 4 quarters


# ---- the watchdog, in the time of the world -----------------------------------------------------
LOOP = """
import sys, time
import pam_ocp as pam
plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=10.0, damping=100.0)
guard = pam.rig.Guard(max_age=1.0, late=1.0, heartbeat=0.15)
rig = pam.Rig(pam.rig.driver("udp", host="127.0.0.1", port=int(sys.argv[1]), timeout=0.2),
              plant=plant, guard=guard, record=sys.argv[2])
rig.arm()
def law(t, seen):
    if t > 0.1:
        print("running", flush=True)
    if t > 0.3 and sys.argv[3] == "hang":
        time.sleep(30)
    if t > 0.3 and sys.argv[3] == "exit":
        import os
        os._exit(1)
    return {"muscle.command": 3e5}
pam.closed_loop(law, rig, duration=60.0)
"""
SIGNALS = {"kill": "SIGKILL", "stop": "SIGSTOP", "term": "SIGTERM", "ctrl-c": "SIGINT"}


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
@pytest.mark.parametrize(
    "way", ["kill", *(pytest.param(w, marks=pytest.mark.slow) for w in ("stop", "ctrl-c", "hang"))]
)
def test_a_loop_that_ends_or_hangs_is_followed_by_venting(plant, tmp_path, way):
    twin = pam.rig.Twin(plant)
    with pam.rig.serve(twin, "udp") as served:
        loop = child(LOOP, served.address["port"], tmp_path, way)
        try:
            assert loop.stdout.readline() == "running\n", loop.stderr.read()
            assert twin.armed
            if way in SIGNALS:
                time.sleep(0.2)
                loop.send_signal(getattr(signal, SIGNALS[way]))
            end = time.monotonic() + 20.0
            while twin.armed and time.monotonic() < end:
                time.sleep(0.005)
            assert not twin.armed
            assert twin.acting["muscle.command"] == 0.0
        finally:
            loop.kill()
            loop.wait()
        time.sleep(0.3)
        assert not twin.armed  # and stays so
    run = pam.rig.read_run(tmp_path / "run_0001.csv")
    assert run.duration > 0.05
    assert np.max(run["muscle.command"]) > 1e5
    end = time.monotonic() + 10.0
    while _watchdogs() and time.monotonic() < end:
        time.sleep(0.1)
    assert not _watchdogs()


def _watchdogs():
    """Watchdogs that nobody waits for any more (their parent is gone)."""
    found = []
    for name in filter(str.isdigit, os.listdir("/proc") if os.path.isdir("/proc") else []):
        try:
            with open(f"/proc/{name}/cmdline", "rb") as file:
                ours = b"watchdog_server.py" in file.read()
            with open(f"/proc/{name}/stat") as file:
                orphan = file.read().rpartition(")")[2].split()[1] == "1"
        except OSError:
            continue
        if ours and orphan:
            found.append(name)
    return found


@contextmanager
def watched(plant):
    """A twin over UDP, and its armed rig, which a watchdog's process looks after."""
    twin = pam.rig.Twin(plant)
    with pam.rig.serve(twin, "udp") as served:
        guard = pam.rig.Guard(max_age=1.0, late=1.0, heartbeat=0.5)
        driver = pam.rig.driver(**served.address, timeout=0.2)
        with pam.Rig(driver, plant=plant, guard=guard) as rig:
            rig.arm()
            yield twin, rig


def test_a_watchdog_that_is_killed_ends_the_run(plant):
    with watched(plant) as (twin, rig):
        looks = itertools.count()

        def law(t, seen):
            if next(looks) == 20:
                rig._watchdog._process.kill()
            return {"muscle.command": 3e5}

        with pytest.raises(pam.rig.RigError, match="watchdog's process has ended"):
            pam.closed_loop(law, rig, duration=20.0)
        assert not twin.armed


def test_a_rig_that_was_vented_runs_again_once_it_is_armed(plant):
    with watched(plant) as (_, rig):
        first = rig._watchdog._process
        with pytest.raises(ZeroDivisionError):
            rig.run(lambda t: 1 / 0, 0.1)
        assert not rig.armed
        rig.arm()
        assert first.poll() is not None  # it would have gone on venting
        assert rig.run(lambda t: {"muscle.command": 1e5}, 0.2).duration > 0.1
        assert rig.armed


NOISY = """
print("a library that says hello")
class Driver:
    def __init__(self, path):
        self.path = path
    def vent(self):
        print("venting")
        open(self.path, "w").close()
"""


def test_a_driver_that_prints_does_not_confuse_the_watchdog(tmp_path, monkeypatch):
    from pam_ocp.rig.drivers.driver import Emergency

    (tmp_path / "noisy_driver.py").write_text(NOISY)
    monkeypatch.syspath_prepend(tmp_path)
    vented = tmp_path / "vented"
    emergency = Emergency("call", "noisy_driver:Driver", arguments={"path": str(vented)})
    dog = Watchdog(emergency, 60.0)
    try:
        assert dog.beat() == ""
        dog.vent()
        end = time.monotonic() + 20.0
        while not dog.heard_trip() and time.monotonic() < end:
            time.sleep(0.01)
        assert dog.tripped
        assert vented.exists()
    finally:
        dog.close()


def test_a_watchdog_that_reaches_nobody_keeps_the_rig_unarmed():
    from pam_ocp.rig.drivers.driver import Emergency

    refused("cannot reach", Watchdog, Emergency("tcp", "127.0.0.1", 9), 0.1, error=pam.rig.RigError)


def test_a_driver_without_emergency_needs_a_word_that_there_is_no_watchdog(plant):
    class Own:
        def __init__(self):
            self.sent, self.vents = {}, 0

        def read(self):
            return {"x": 0.01, "muscle.pressure": 0.0, "time": time.monotonic()}

        def write(self, inputs):
            self.sent = dict(inputs)

        def vent(self):
            self.vents += 1

        def close(self):
            pass

    own = Own()
    refused("watchdog=False", pam.Rig(own, plant=plant).arm, error=pam.rig.RigError)
    guard = pam.rig.Guard(max_age=2.0, late=2.0)
    with pam.Rig(own, plant=plant, guard=guard, watchdog=False) as rig:
        rig.arm()
        rig.run(lambda t: {"muscle.command": 1e5}, 0.05)
        assert own.sent["muscle.command"] > 0.0
        vents = own.vents
    assert own.vents > vents >= 3

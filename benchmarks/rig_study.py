"""What the guard, the drivers and learning of rigs do over many twins and long bad lines.

    python benchmarks/rig_study.py [faults] [COUNT]   # each kind of fault COUNT times (default 50)
    python benchmarks/rig_study.py lines [SECONDS] [--only DRIVER ...]  # bad lines (default 3600)
    python benchmarks/rig_study.py realtime [SECONDS] # the loop in C at 1 kHz (default 600)
    python benchmarks/rig_study.py learning [COUNT]   # twins at random (default 10)
    python benchmarks/rig_study.py tracking [COUNT]   # from home() to unseen motions

Faults and learning run on a simulated clock; lines and realtime in real time. Drivers take turns;
side by side they are run by one command each.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import harness
import numpy as np

import pam_ocp as pam

NOISE = {"x": 1e-5, "muscle.pressure": 200.0}
"""Standard deviations of what is measured."""


def instruments() -> dict[str, pam.simulation.Instrument]:
    return {n: pam.simulation.Instrument(noise=v) for n, v in NOISE.items()}


def kinds_of_faults() -> dict[str, pam.rig.Fault | str]:
    """Twenty: of sensors, of the transport, of the supply, and of the controller itself."""
    pressure = "muscle.pressure"
    made = [
        *(pam.rig.Fault(k, n) for k in ("nan", "stuck") for n in ("x", pressure)),
        *(pam.rig.Fault("spike", n, v) for n, v in (("x", 0.02), (pressure, 3e5))),
        *(pam.rig.Fault("bias", n, v) for n, v in (("x", 0.05), ("x", -0.08), (pressure, 4e5))),
        *(pam.rig.Fault("gain", n, v) for n, v in (("x", -1.0), ("x", 4.0), (pressure, 3.0))),
        *(pam.rig.Fault("drift", n, v) for n, v in (("x", 5.0), (pressure, 2e8))),
        *(pam.rig.Fault(k) for k in ("stale", "supply", "cable")),
    ]
    known: dict[str, pam.rig.Fault | str] = {}
    for f in made:
        size = f" {f.value:g}" if math.isfinite(f.value) else ""
        known[f"{f.kind} {f.channel}".strip() + size] = f
    loop = ("controller raises", "controller answers nan", "controller hangs for 40 ms")
    return known | {name: name for name in loop}


def failing(kind: str, at: float, clock: pam.rig.SimulatedClock):
    """A controller that goes wrong at a time of the twin."""

    def law(t, seen):
        if kind and clock.now() >= at:
            if kind == "controller raises":
                raise ValueError("a slip in a controller")
            if kind.endswith("nan"):
                return {"muscle.command": math.nan}
            clock.wait(clock.now() + 0.04)
        return {"muscle.command": 3e5 + 2e4 * math.sin(10 * t)}

    return law


def whole(rig, twin, folder: Path, at: float) -> bool:
    """Whether nothing runs, and the record holds every sample before the fault as it was."""
    about = json.loads(max(folder.glob("*.json")).read_text("utf-8"))
    record = pam.rig.read_run(max(folder.glob("*.csv")))
    true, before = twin.motion(), record.t < at - 0.006
    seen = np.interp(record.t[before], true.t, true["x"])
    same = np.max(np.abs(record["x"][before] - seen)) < 1e-4  # ten times the noise
    even = np.max(np.diff(record.t[before])) < 0.0051
    reaches = record.t[before][-1] >= at - 0.0111
    resting = all(v == 0.0 for v in twin.acting.values())
    over = resting and not (twin.armed or rig.armed or rig._running)
    return bool(over and about["ended"] and about["vented_for"] and same and even and reaches)


def one_fault(plant, kind, at: float, folder: Path, seed: int) -> tuple[float, bool]:
    """(time from the fault to the air being let out on the twin's clock [ms], record whole)."""
    pressure, clock = "muscle.pressure", pam.rig.SimulatedClock()
    readings = [
        pam.rig.Reading("x", low="-20 mm", high="70 mm", rate="2 m/s", frozen="30 ms"),
        pam.rig.Reading(pressure, low="-0.3 bar", high="5.5 bar", frozen="30 ms"),
        pam.rig.Reading("supply", "Pa", low="3 bar"),
    ]
    own = isinstance(kind, str)
    short = not own and kind.kind == "cable"
    wrong = [] if own else [replace(kind, at=at, until=at + 0.04 if short else math.inf)]
    twin = pam.rig.Twin(
        plant, readings, clock=clock, sensors=instruments(), faults=wrong, seed=seed
    )
    driver = pam.rig.driver("twin", twin=twin)
    rig = pam.Rig(driver, readings, plant=plant, clock=clock, record=folder)
    rig.arm()
    law = failing(kind if own else "", at, clock)
    try:
        pam.closed_loop(law, rig, duration=3.0)
    except (pam.rig.RigError, ValueError):
        took = 1e3 * (twin.vented_at - at) if not twin.armed else math.inf
        return took, whole(rig, twin, folder, at)
    return math.inf, False


def faults(name: str, count: int, seed: int) -> harness.Row:
    """Time from a fault to the air being let out, what is left running, and the record."""
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0, damping=100.0)
    kinds, found = kinds_of_faults(), []
    rng = np.random.default_rng([seed, list(kinds).index(name)])
    for k in range(count):
        with tempfile.TemporaryDirectory() as place:
            at = float(rng.uniform(0.5, 1.5))
            found.append(one_fault(plant, kinds[name], at, Path(place), k))
    inside, good = sum(t <= 50 for t, _ in found), sum(w for _, w in found)
    worst = max(t for t, _ in found)
    text = f"{inside}/{count} within 50 ms, worst {worst:.1f} ms; {good}/{count} stopped with a "
    verdict = "vented" if inside == good == count else "NOT VENTED"
    return {"verdict": verdict, "worst": worst, "text": text + "whole record"}


WAYS = {"udp": "BadUdp", "serial": "BadSerial", "modbus": "BadTcp", "opcua": "BadTcp"}
"""Which bad line each driver is tried on."""
SHARE = {"opcua": 0.004}
"""Of what passes that is dropped, doubled, late or damaged, where it is not 5 %: OPC UA closes the
connection at each, and connecting takes a dozen messages.
"""


def line(kind: str, seconds: float) -> harness.Row:
    """Answers, missing answers and the longest call of a driver over a line that is bad all the
    time.
    """
    harness.importable("tests/rig")
    import rig_tools
    from test_drivers import opened, talk

    device, bad = rig_tools.Counting(), rig_tools.Bad(7, SHARE.get(kind, 0.05))
    way = getattr(rig_tools, WAYS[kind])
    with (
        pam.rig.serve(device, kind) as served,
        way(rig_tools.end_of(served.address), bad) as between,
    ):
        address = {**rig_tools.through(served.address, between), "timeout": 0.03}
        with rig_tools.quiet(bad):
            driver = opened(address.pop("kind"), device, **address)
            driver.arm()
        good, failed, longest = talk(driver, device, seconds, doubled=kind == "opcua")
        driver.close()
    text = f"{good} answers, {failed} missing, longest {longest:.3f} s, {bad.done}"
    return {"longest": longest, "text": text}


def realtime(seconds: float) -> harness.Row:
    """Deadlines of the loop in C at 1 kHz behind a UDP twin in another process; then how long it
    takes from a fault to the air being let out.
    """
    before = _processors()
    run = _in_c(seconds)
    print(run.report(), flush=True)
    idle, stolen, total = (b - a for a, b in zip(before, _processors(), strict=True))
    machine = f"processors: {100 * idle / total:.0f} % idle, {100 * stolen / total:.2g} % stolen"
    text, lines = f"missed {run.missed} of {run.samples}: {run.missed / run.samples:.2g}", [machine]
    run.plot().savefig(Path(tempfile.gettempdir()) / "realtime.png", dpi=120)
    rng = np.random.default_rng(0)
    for kind in (
        pam.rig.Fault("nan", "x"),
        pam.rig.Fault("bias", "x", 0.05),
        pam.rig.Fault("stuck", "x"),
        pam.rig.Fault("stale"),
    ):
        found = [_reaction(replace(kind, at=float(rng.uniform(1.5, 2.0)))) for _ in range(10)]
        after = [t for t in found if t >= 0]  # the others were vented before, for another reason
        label, worst = f"{kind.kind} {kind.channel}".strip(), 1e3 * max(after, default=0)
        lines.append(f"{label}: {len(after)} of {len(found)}: worst {worst:.1f} ms to air")
    return {"missed": run.missed / run.samples, "text": text, "why": lines}


def _processors() -> tuple[int, int, int]:
    """(idle, stolen by the machine below this one, all) of all processors so far."""
    numbers = [int(n) for n in Path("/proc/stat").read_text().split("\n")[0].split()[1:]]
    return numbers[3] + numbers[4], numbers[7], sum(numbers[:8])


LIMITS = [
    pam.rig.Reading("x", low="-20 mm", high="70 mm", frozen="30 ms"),
    pam.rig.Reading("muscle.pressure", low="-0.3 bar", high="5.5 bar"),
]


def _law() -> tuple[pam.Plant, pam.control.Block]:
    """A regulator behind an estimator, every millisecond."""
    plant = pam.HangingLoad("DMSP-20-300")
    goal = plant.equilibrium(x=0.04)
    first = pam.control.kalman(plant, goal, measured=NOISE, sample_time=1e-3)
    law = pam.lqr(plant, goal, integral={"x": 100.0}, sample_time=1e-3)
    return plant, pam.control.block(pam.control.chain([first, law], name="lqg"), plant=plant)


def _in_c(seconds: float) -> Any:
    plant, law = _law()
    twin = [sys.executable, "-m", "pam_ocp", "twin", "HangingLoad", "--udp", "0", "--json"]
    noise = ["--noise", "x=0.01 mm", "--noise", "muscle.pressure=2 mbar"]
    process = subprocess.Popen([*twin, *noise], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        address = json.loads(process.stdout.readline())
        guard = pam.rig.Guard(max_age=1.0, late=1.0, heartbeat=1.0)  # deadlines are what counts
        driver = pam.rig.driver(**{**address, "timeout": 0.2})
        wide = {"low": -math.inf, "high": math.inf, "frozen": None}
        readings = [replace(r, **wide) for r in LIMITS]  # the twin may be starved: that is no fault
        with pam.Rig(driver, readings, plant=plant, guard=guard) as rig:
            rig.arm()
            wanted = {"x": lambda t: 0.04 + 0.005 * math.sin(3 * t)}
            return rig.run_in_c(law, seconds, wanted=wanted, start=plant.equilibrium(x=0.04))
    finally:
        process.kill()
        process.wait()


def _reaction(fault: pam.rig.Fault) -> float:
    """From a fault to the vented twin [s]."""
    plant, law = _law()
    twin = pam.rig.Twin(plant, LIMITS, sensors=instruments(), faults=[fault])
    began = twin._began  # times of faults count from there
    with pam.rig.serve(twin, "udp") as served:
        driver = pam.rig.driver(**{**served.address, "timeout": 0.2})
        with pam.Rig(driver, LIMITS, plant=plant) as rig:
            rig.arm()
            try:
                rig.run_in_c(law, fault.at + 1.0)
            except pam.rig.RealTimeError as error:
                print(f"  {error.run.reason}; {1e6 * error.run.reaction:.0f} us to the vent line")
                return float(twin.vented_at - began - fault.at)
    return math.inf


def learning(seed: int) -> harness.Row:
    """Gain of ten runs of a sine of 1 Hz, and the worst run, of a twin at random."""
    harness.importable("tests/rig")
    from rig_tools import twin_at_random, wanted_sine

    rig, _, model = twin_at_random(seed)
    wanted, position = wanted_sine(model)
    rig.arm()
    found = rig.learn(wanted, position, runs=10)
    worst = max(found.errors) / found.errors[0]
    text = f"{model.name}: {found.gain:.1f} times better in ten runs, worst run {worst:.2f} of the "
    return {"gain": found.gain, "worst": worst, "text": text + "first"}


def unseen(rng: np.random.Generator, low: float, high: float, wild: bool):
    """A sine of 1 Hz of random middle and size, or a smooth random motion up to 1.2 Hz."""
    half = (high - low) / 2
    size = half * float(rng.uniform(0.3, 1.0))
    middle = (low + high) / 2 + float(rng.uniform(-1, 1)) * (half - size)
    if not wild:
        phase = float(rng.uniform(0, 2 * math.pi))
        return lambda t: middle + size * math.sin(2 * math.pi * t + phase)
    f, phases = rng.uniform(0.2, 1.2, 4), rng.uniform(0, 2 * math.pi, 4)
    parts = rng.dirichlet(np.ones(4))
    return lambda t: middle + size * float(parts @ np.sin(2 * math.pi * f * t + phases))


def tracking(seed: int, way: str) -> harness.Row:
    """RMSE of 20 unseen motions after home() and tune(), in parts of the stroke, on a new twin:
    widely drawn, small muscles and lightly damped loads among them.
    """
    harness.importable("tests/rig")
    from rig_tools import twin_at_random

    rig, twin, model = twin_at_random(seed, way=way, wide=True)
    rig.arm()
    rig.home()
    tuned = rig.tune()
    spent, (low, high) = twin.now(), tuned.range
    position, rng = tuned.law.position, np.random.default_rng(seed + 1)
    errors, whole_runs = [], []
    for n in range(20):
        motion = unseen(rng, low, high, wild=n % 5 > 2)
        start = tuned.start(motion(0.0))
        loop = pam.closed_loop(tuned.law, rig, {position: motion}, duration=3.0, start=start)
        missed = loop[position] - np.array([motion(t) for t in loop.t])
        for found, part in ((errors, loop.t > 1.0), (whole_runs, loop.t >= 0.0)):
            found.append(100 * float(np.sqrt(np.mean(missed[part] ** 2))) / (high - low))
    limits, true = rig.readings[position], twin.motion()[position]
    over = max(true.max() - limits.high, limits.low - true.min(), 0.0) / (high - low)
    rig.close()
    if way != "twin":
        twin.served.close()
    good = max(errors) <= 0.5 and over <= 0.01
    return {
        "verdict": "within 0.5 %" if good else "BEYOND 0.5 %",
        "text": f"{model.name} by {way} (scale {twin.scale:.2f}): ready after {spent:.0f} s, "
        f"stroke {high - low:.4g}; RMSE worst {max(errors):.2f} %, median {np.median(errors):.2f} "
        f"% (with the first second {max(whole_runs):.2f} %), limits exceeded by {100 * over:.2f} %",
    }


USUAL = {"faults": 50, "lines": 3600, "realtime": 600, "learning": 10, "tracking": 10}
"""Counts, or seconds of lines and realtime."""


def cases(given: harness.Given) -> harness.Keyed:
    number = given.number or USUAL[given.what]
    if given.what == "faults":
        for name in kinds_of_faults():
            yield name, partial(faults, name, int(number), given.seed)
    elif given.what == "lines":
        for kind in WAYS:
            yield kind, partial(line, kind, number)
    elif given.what == "realtime":
        yield "realtime", partial(realtime, number)
    for k in range(int(number)):
        seed = given.seed + k
        if given.what == "learning":
            yield f"seed {seed}", partial(learning, seed)
        if given.what == "tracking":
            way = ("twin", "modbus", "serial")[k % 3]
            yield f"seed {seed}", partial(tracking, seed, way)


OPTIONS = {
    "what": {"nargs": "?", "choices": USUAL, "default": "faults"},
    "number": {"nargs": "?", "type": float, "help": "a count, or seconds"},
}

if __name__ == "__main__":
    harness.main(__doc__, cases, options=OPTIONS)

"""What the guard, the drivers and learning of rigs do over many twins and long bad lines.

    python benchmarks/rig_study.py faults [COUNT]     # each kind of fault COUNT times (default 50)
    python benchmarks/rig_study.py lines [SECONDS]    # bad lines for each driver (default 3600)
    python benchmarks/rig_study.py learning [COUNT]   # twins at random (default 10)
    python benchmarks/rig_study.py tracking [COUNT]   # from home() to unseen motions

Faults and learning run on a simulated clock; lines in real time. Figures are printed, a line each.
"""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import pam_ocp as pam

TESTS = Path(__file__).parents[1] / "tests" / "rig"
STROKE = 0.03
"""Of the slide's motions [m]: +-15 mm."""


def faults(count: int) -> None:
    """Time from a fault to the air being let out, on the twin's clock [ms]."""
    plant = pam.HangingLoad("DMSP-20-300", mass=10.0, damping=100.0)
    pressure = "muscle.pressure"
    kinds = [
        *(pam.rig.Fault(k, n) for k in ("nan", "stuck") for n in ("x", pressure)),
        *(pam.rig.Fault("spike", n, v) for n, v in (("x", 0.02), (pressure, 3e5))),
        *(pam.rig.Fault("bias", n, v) for n, v in (("x", 0.05), ("x", -0.08), (pressure, 4e5))),
        *(pam.rig.Fault("gain", n, v) for n, v in (("x", -1.0), ("x", 4.0), (pressure, 3.0))),
        *(pam.rig.Fault("drift", n, v) for n, v in (("x", 5.0), (pressure, 2e8))),
        *(pam.rig.Fault(k) for k in ("stale", "supply", "cable")),
    ]
    rng = np.random.default_rng(0)
    for kind in kinds:
        reactions = []
        for _ in range(count):
            at = float(rng.uniform(0.5, 1.5))
            until = at + 0.04 if kind.kind == "cable" else math.inf
            clock = pam.rig.SimulatedClock()
            readings = [
                pam.rig.Reading("x", low="-20 mm", high="70 mm", rate="2 m/s", frozen="30 ms"),
                pam.rig.Reading(pressure, low="-0.3 bar", high="5.5 bar", frozen="30 ms"),
                pam.rig.Reading("supply", "Pa", low="3 bar"),
            ]
            noise = {
                "x": pam.simulation.Instrument(noise=1e-5),
                pressure: pam.simulation.Instrument(noise=200.0),
            }
            fault = replace(kind, at=at, until=until)
            twin = pam.rig.Twin(plant, readings, clock=clock, sensors=noise, faults=[fault])
            rig = pam.Rig(pam.rig.driver("twin", twin=twin), readings, plant=plant, clock=clock)
            rig.arm()
            try:
                pam.closed_loop(
                    lambda t, s: {"muscle.command": 3e5 + 2e4 * math.sin(10 * t)}, rig, duration=3.0
                )
            except pam.rig.RigError:
                reactions.append(1e3 * (twin.vented_at - at) if not twin.armed else math.inf)
            else:
                reactions.append(math.inf)
        inside = sum(r <= 50 for r in reactions)
        label = f"{kind.kind} {kind.channel}".strip()
        print(
            f"{label:<24} {inside}/{count} within 50 ms, worst {max(reactions):.1f} ms", flush=True
        )


def lines(seconds: float) -> None:
    """Answers, missing answers and the longest call over lines that are bad all the time."""
    sys.path.insert(0, str(TESTS))
    from rig_tools import Bad, BadSerial, BadTcp, BadUdp, Counting
    from test_drivers import opened, talk

    for kind, way in (("udp", BadUdp), ("serial", BadSerial), ("modbus", BadTcp)):
        device, bad = Counting(), Bad(7)
        with pam.rig.serve(device, kind) as served:
            own = served.address["port"]
            with way(own, bad) as between:
                place = {"port": getattr(between, "path", None) or between.port, "timeout": 0.03}
                address = {**served.address, **place}
                driver = opened(address.pop("kind"), device, **address)
                good, failed, longest = talk(driver, device, seconds)
                driver.close()
        print(f"{kind}: {good} answers, {failed} missing, longest {longest:.3f} s, {bad.done}")


def learning(count: int) -> None:
    """Gain of ten runs of a sine of 1 Hz, and the worst run, over twins at random."""
    sys.path.insert(0, str(TESTS))
    from test_rig import slide

    from pam_ocp.control.references import sine

    for seed in range(count):
        rig, _, model = slide(seed)
        pid = pam.control.PID.placed(3.0)
        law = pam.control.PositionController(
            model, sine(0.0, 0.01, 1.0), pid, sample_time=0.005, stiffness=2.5e4
        )
        start = model.equilibrium(x=-0.01, stiffness=2.5e4)
        wanted = pam.closed_loop(law, model, duration=2.0, start=start).trajectory
        rig.arm()
        found = rig.learn(wanted, "x", runs=10)
        worst = max(found.errors) / found.errors[0]
        print(
            f"twin {seed}: {found.gain:.1f} times better, worst run {worst:.2f} of the first",
            flush=True,
        )


def tracking(count: int) -> None:
    """RMSE of unseen motions of 1 Hz after homing and one compensation, of the stroke."""
    sys.path.insert(0, str(TESTS))
    from test_rig import slide

    from pam_ocp.control.references import sine

    for seed in range(count):
        rig, twin, model = slide(seed)
        rig.arm()
        rig.home(level="3 bar")
        rng, errors = np.random.default_rng(seed), []
        for _ in range(20):
            middle, size = float(rng.uniform(-0.003, 0.003)), float(rng.uniform(0.004, 0.011))
            reference = sine(middle, size, 1.0)
            pid = pam.control.PID.placed(4.0)
            law = pam.control.PositionController(
                model, reference, pid, sample_time=0.005, stiffness=2.5e4
            )
            start = model.equilibrium(x=middle - size, stiffness=2.5e4)
            loop = pam.closed_loop(law, rig, duration=4.0, start=start)
            late = loop.t > 1.0
            wanted = np.array([reference(t)[0] for t in loop.t[late]])
            errors.append(float(np.sqrt(np.mean((loop["x"][late] - wanted) ** 2))))
        worst = 100 * max(errors) / STROKE
        print(
            f"twin {seed}: worst RMSE {worst:.2f} % of the stroke, {twin.now():.0f} s", flush=True
        )


if __name__ == "__main__":
    what = sys.argv[1] if len(sys.argv) > 1 else "faults"
    usual = {"faults": 50, "lines": 3600, "learning": 10, "tracking": 10}
    number = float(sys.argv[2]) if len(sys.argv) > 2 else usual[what]
    globals()[what](number if what == "lines" else int(number))

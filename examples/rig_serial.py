"""A rig on a serial line: a sensor gets stuck, and the guard lets the air out.

A hanging load behind a pseudo-terminal, as a microcontroller would be (rig_sketch/rig_sketch.ino
speaks the same lines). The twin is in a process of its own, in real time; its position sensor
sticks in the middle of a run. The record is whole up to there. POSIX only.

Run:  python examples/rig_serial.py [folder for the results]
"""

import json
import math
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt

import pam_ocp as pam

FAULTS = """
[[fault]]
kind = "stuck"
channel = "x"
at = "7 s"
"""


def main(folder: Path) -> None:
    (folder / "faults.toml").write_text(FAULTS)
    command = [sys.executable, "-m", "pam_ocp", "twin", "HangingLoad", "--serial", "--json"]
    more = ["--noise", "x=0.01 mm", "--faults", str(folder / "faults.toml")]
    twin = subprocess.Popen([*command, *more], stdout=subprocess.PIPE, text=True)
    address = json.loads(twin.stdout.readline())
    plant = pam.HangingLoad("DMSP-20-300")
    readings = [
        pam.rig.Reading("x", low="-30 mm", high="90 mm", frozen="60 ms"),
        pam.rig.Reading("muscle.pressure", low="-0.5 bar", high="7 bar"),
    ]
    guard = pam.rig.Guard(max_age="2 s", late="2 s", heartbeat="1 s")
    record = folder / "runs"
    try:
        driver = pam.rig.driver(**{**address, "timeout": "0.2 s"})
        with pam.Rig(
            driver, readings, plant=plant, guard=guard, sample_time=0.01, record=record
        ) as rig:
            rig.arm()
            try:
                rig.run(lambda t: {"muscle.command": 2.5e5 + 5e4 * math.sin(3 * t)}, 20.0)
            except pam.rig.RigError as error:
                print(f"vented: {error}")
    finally:
        twin.kill()
        twin.wait()

    run = pam.rig.read_run(sorted(record.glob("run_*.csv"))[-1])
    figure, axes = plt.subplots(2, 1, figsize=(8, 5), sharex=True, layout="constrained")
    axes[0].plot(run.t, 1e3 * run["x"])
    axes[0].set(ylabel="x [mm]", title="A position sensor sticks, and the air goes out")
    axes[1].plot(run.t, run["muscle.pressure"] / 1e5, label="pressure")
    axes[1].step(run.t, run["muscle.command"] / 1e5, where="post", label="command")
    axes[1].set(xlabel="t [s]", ylabel="[bar]")
    axes[1].legend()
    figure.savefig(folder / "rig_serial.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "rig_serial")
    target.mkdir(parents=True, exist_ok=True)
    main(target)

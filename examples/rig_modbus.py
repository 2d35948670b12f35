"""A rig over Modbus TCP: homing, then a motion that gets better from run to run.

The rig is a twin in a process of its own: an antagonistic slide whose muscles pull 15 % less than
the model believes, behind Modbus TCP and with noise, in real time. It is checked, armed, homed,
and learns a sine of 1 Hz in five runs. With a valve terminal on the bench only the driver's address
changes; read docs/rig.md before you arm it.

Run:  python examples/rig_modbus.py [folder for the results]
"""

import json
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt

import pam_ocp as pam
from pam_ocp.control.pid import PID, PositionController
from pam_ocp.control.references import sine

PLANT = """
[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
"""


def start_twin(folder: Path) -> tuple[subprocess.Popen[str], dict]:
    """A twin in a process of its own, and how a driver reaches it."""
    (folder / "plant.toml").write_text(PLANT)
    command = [sys.executable, "-m", "pam_ocp", "twin", str(folder / "plant.toml"), "--modbus", "0"]
    more = ["--scale", "0.85", "--noise", "x=0.01 mm", "--timeout", "0.5 s", "--json"]
    twin = subprocess.Popen([*command, *more], stdout=subprocess.PIPE, text=True)
    return twin, json.loads(twin.stdout.readline())


def main(folder: Path) -> None:
    model = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"))
    law = PositionController(
        model, sine(0.0, 0.008, 1.0), PID.placed(3.0), sample_time=0.01, stiffness=2.5e4
    )
    start = model.equilibrium(x=-0.008, stiffness=2.5e4)
    wanted = pam.closed_loop(law, model, duration=2.0, start=start).trajectory
    readings = [
        pam.rig.Reading("x", low="-25 mm", high="25 mm", address=2),
        pam.rig.Reading("muscle1.pressure", low="-0.5 bar", high="6.5 bar", address=4),
        pam.rig.Reading("muscle2.pressure", low="-0.5 bar", high="6.5 bar", address=6),
    ]
    # this computer has other things to do: a rig of one's own allows less
    guard = pam.rig.Guard(max_age="2 s", late="2 s", heartbeat="1 s")
    twin, address = start_twin(folder)
    try:
        driver = pam.rig.driver(**{**address, "timeout": "0.2 s"})
        with pam.Rig(
            driver, readings, plant=model, guard=guard, sample_time=0.01, record=folder / "runs"
        ) as rig:
            print(rig.check(0.5)["time"])
            rig.arm()
            print(rig.home(level="3 bar", sweep_time=2.0, hold_time=1.0))
            learned = rig.learn(wanted, "x", runs=5)
            print(learned)
    finally:
        twin.kill()
        twin.wait()

    figure, (above, below) = plt.subplots(2, 1, figsize=(8, 6), layout="constrained")
    above.plot(wanted.t, 1e3 * wanted["x"], "k--", label="wanted")
    best = min(range(len(learned.errors)), key=lambda k: learned.errors[k])
    for k, label in ((0, "first run"), (best, f"run {best + 1}")):
        above.plot(learned.runs[k].t, 1e3 * learned.runs[k]["x"], label=label)
    above.set(xlabel="t [s]", ylabel="x [mm]", title="A slide over Modbus TCP learns a sine")
    above.legend()
    below.semilogy(range(1, len(learned.errors) + 1), [1e3 * e for e in learned.errors], "o-")
    below.set(xlabel="run", ylabel="RMS error [mm]")
    figure.savefig(folder / "rig_modbus.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "rig_modbus")
    target.mkdir(parents=True, exist_ok=True)
    main(target)

"""A rig behind OPC UA that slowly gets weaker, and a monitor that says so.

The twin of a hanging load stands behind an OPC UA server. A motion of half a minute tells a monitor
what the rig is like; then the muscle loses three tenths of its force within some seconds. Needs
pip install 'pam_ocp[rig]'.

Run:  python examples/rig_opcua.py [folder for the results]
"""

import math
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import pam_ocp as pam
from pam_ocp.rig.drift import drifting

MEASURED = {"x": 1e-5, "muscle.pressure": 200.0}


def main(folder: Path) -> None:
    plant = pam.HangingLoad("DMSP-20-300")
    noise = {n: pam.simulation.Instrument(noise=s) for n, s in MEASURED.items()}
    twin = pam.rig.Twin(drifting(plant), sensors=noise, scale=1.05)
    with pam.rig.serve(twin, "opcua") as served:
        driver = pam.rig.driver(**{**served.address, "timeout": "0.5 s"})
        guard = pam.rig.Guard(max_age="2 s", late="2 s", heartbeat="2 s")
        with pam.Rig(driver, plant=plant, guard=guard, sample_time=0.02, watchdog=False) as rig:
            rig.monitor = pam.rig.Monitor(plant, measured=MEASURED, learn="15 s")

            def moving(t: float) -> dict[str, float]:
                twin.change(**{"drift.scale": 1.0 - 0.3 * min(max((t - 20) / 5, 0.0), 1.0)})
                return {"muscle.command": 2.5e5 + 4e4 * math.sin(3 * t) + 3e4 * math.sin(1.1 * t)}

            rig.arm()
            rig.run(moving, 40.0)
            print(rig.monitor.report())

    rows = np.array(rig.monitor.history)
    figure, axes = plt.subplots(figsize=(8, 3.5), layout="constrained")
    axes.plot(rows[:, 0], rows[:, 1])
    axes.fill_between(rows[:, 0], *(rows[:, 1] + s * rows[:, 4] for s in (-2, 2)), alpha=0.3)
    for alarm in rig.monitor.alarms:
        axes.axvline(alarm.time, color="#b3261e", label=f"alarm: {alarm.what}")
    axes.set(xlabel="t [s]", ylabel="scale of force", ylim=(0.6, 1.2))
    axes.legend()
    figure.savefig(folder / "rig_opcua.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "rig_opcua")
    target.mkdir(parents=True, exist_ok=True)
    main(target)

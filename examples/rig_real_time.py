"""A controller as C at 1 kHz on a rig behind UDP, and how late its samples are.

An estimator and a regulator become C, which runs in a loop of its own process with absolute
deadlines. The rig is a twin in another process. SCHED_FIFO and locked memory are used where they
are allowed, and what is granted is printed. Linux, with a C compiler.

Run:  python examples/rig_real_time.py [folder for the results]
"""

import json
import math
import subprocess
import sys
from pathlib import Path

import pam_ocp as pam
from pam_ocp.control import block, chain, kalman

STEP = 1e-3


def main(folder: Path) -> None:
    plant = pam.HangingLoad("DMSP-20-300")
    goal = plant.equilibrium(x=0.04)
    measured = {"x": 1e-5, "muscle.pressure": 200.0}
    estimator = kalman(plant, goal, measured=measured, sample_time=STEP)
    regulator = pam.lqr(plant, goal, integral={"x": 100.0}, sample_time=STEP)
    law = block(chain([estimator, regulator], name="lqg"), plant=plant)

    command = [sys.executable, "-m", "pam_ocp", "twin", "HangingLoad", "--udp", "0", "--json"]
    noise = ["--noise", "x=0.01 mm", "--noise", "muscle.pressure=2 mbar"]
    twin = subprocess.Popen([*command, *noise], stdout=subprocess.PIPE, text=True)
    try:
        driver = pam.rig.driver(**{**json.loads(twin.stdout.readline()), "timeout": "0.2 s"})
        guard = pam.rig.Guard(max_age="1 s", late="1 s", heartbeat="1 s")  # a rig: 20 ms
        with pam.Rig(driver, plant=plant, guard=guard) as rig:
            rig.arm()
            wanted = {"x": lambda t: 0.04 + 0.003 * math.sin(4 * t)}
            run = rig.run_in_c(law, 5.0, wanted=wanted, start=goal)
    finally:
        twin.kill()
        twin.wait()
    print(run.report())
    run.plot().savefig(folder / "rig_real_time.png", dpi=120)
    run.trajectory.plot().savefig(folder / "rig_real_time_motion.png", dpi=120)


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "rig_real_time")
    target.mkdir(parents=True, exist_ok=True)
    main(target)

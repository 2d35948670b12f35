"""A position controller with an estimator becomes C code; it is compiled and runs its self-test.

Run:  python examples/export_controller.py [folder for the results]
"""

import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp.control import BlockController, block, chain, kalman

STEP = 2e-3


def main(folder: Path) -> None:
    slide = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, feed=pam.feeds.SpoolValve())
    rest = {"x": 0.002, "stiffness": 2.2e4}
    measured = {"x": 1e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    estimator = kalman(slide, rest, measured=measured, sample_time=STEP)
    feedback = pam.lqr(slide, rest, integral={"x": 80.0}, sample_time=STEP)
    closed = {"muscle1.command": 0.0, "muscle2.command": 0.0}
    made = block(chain([estimator, feedback], name="slide_lqg"), plant=slide, safe=closed)
    print(f"{made.name}: {len(made.inputs)} inputs, {len(made.outputs)} outputs, every {STEP} s")

    def told(t: float) -> dict[str, float]:
        """A step of 5 mm; for 20 ms nobody measures the position."""
        silent = {"x": np.nan} if 0.10 < t < 0.12 else {}
        return {"wanted.x": 0.007 if t > 0.05 else 0.002, **silent}

    loop = pam.closed_loop(BlockController(made, told), slide, duration=0.4, noise={"x": 1e-5})
    print(f"in Python: x = {1e3 * loop['x'][-1]:.2f} mm after {loop.t[-1]:g} s")

    place = pam.export_c(made, folder / "slide_lqg")
    for file in sorted(place.iterdir()):
        print(f"  {file.name:22} {file.stat().st_size:7} bytes")
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        print("no C compiler (cc) is here to run the self-test")
        return
    sources = ["slide_lqg.c", "slide_lqg_selftest.c", "-o", "selftest", "-lm"]
    flags = ["-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra"]
    subprocess.run([compiler, *flags, *sources], cwd=place, check=True)
    done = subprocess.run([place / "selftest"], capture_output=True, text=True, check=True)
    print(done.stdout.strip())


if __name__ == "__main__":
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "export_controller")
    target.mkdir(parents=True, exist_ok=True)
    main(target)

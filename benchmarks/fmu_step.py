"""What a communication step of an exported FMU costs, in units of six right-hand sides and one
Jacobian (a step of Rodas5P asks for eight and one): at rest, with jumps 100 and 10 steps apart,
with jumps in each step.

    python benchmarks/fmu_step.py [runs]

The least of several runs counts: other work on the machine only ever slows one down.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np

import pam_ocp as pam
from pam_ocp.export.compile import native

PROGRAM = Path(__file__).with_name("step_cost.c")
CASES = ("at rest", "jumps 100 steps apart", "jumps 10 steps apart", "jumps in each step")


PLANTS = {
    "slide": (None, ()),
    "valves": (pam.feeds.SpoolValve(), ("-DLOWEST=-0.3", "-DHIGHEST=0.3")),
}
"""Feeds of a slide, and the range in which its commands jump where it is not that of pressures."""


def built(kind: str, folder: Path) -> Path:
    """step_cost.c together with the sources of the FMU of a slide."""
    feed, defines = PLANTS[kind]
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-400N"), feed=feed)
    fmu = pam.export_fmu(plant, folder / "slide.fmu", fmi="2.0", platforms="native")
    with zipfile.ZipFile(fmu) as archive:
        archive.extractall(folder / "fmu")
    target, sources = folder / "step_cost", folder / "fmu" / "sources"
    command = [sys.executable, "-m", "ziglang", "cc", "-target", native().target, "-std=c11", "-O2"]
    command += ["-ffp-contract=off", *defines, "-I", str(sources), str(PROGRAM)]
    subprocess.run([*command, "-o", str(target), "-lm"], check=True)
    return target


def figures(quick: bool) -> dict[str, float]:
    """For run.py: {plant, case: units}."""
    return {
        f"{kind}, {case}": cost
        for kind in PLANTS
        for case, cost in zip(CASES, least(kind, 1 if quick else 3).tolist(), strict=True)
    }


def least(kind: str, runs: int) -> np.ndarray:
    """The least cost of each case in so many runs [units]."""
    costs = np.full(len(CASES), np.inf)
    with tempfile.TemporaryDirectory() as folder:
        program = built(kind, Path(folder))
        for _ in range(runs):
            done = subprocess.run([str(program)], capture_output=True, text=True, check=True)
            found = re.findall(r"= +([\d.]+) units", done.stdout)
            costs = np.minimum(costs, [float(c) for c in found])
    return costs


def main(runs: int) -> None:
    for kind in PLANTS:
        for case, cost in zip(CASES, least(kind, runs), strict=True):
            print(f"{kind + ', ' + case:<32}{cost:6.2f} units")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)

"""The rig that has everything: muscles with memory, a receiver, spool valves, tubes and heat.

    python benchmarks/rig.py

An antagonistic slide on two DMSP-20-200N muscles with asymmetric memory (two play operators each),
each behind a proportional valve with a second-order spool and a metre of tube, both on one receiver
of two litres; the air's temperature is a state in muscles and receiver. Shows: processor time of
10 s at three tolerances and the error against 1e-11, processor time of a planned motion and its
verdict, deviations of the FMUs in both modes. Times are of this process alone; those of a loaded
machine are longer.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import pam_ocp as pam
from pam_ocp.muscles.gas import Gas
from pam_ocp.muscles.heat import ConstantHeatTransfer
from pam_ocp.plants.feeds import LumpedTube, Receiver, SecondOrderSpool, SpoolValve

COMMANDS = ("muscle1.command", "muscle2.command")


def rig(**arguments: Any) -> pam.Plant:
    """20 states; arguments of the feed replace those of the rig."""
    feed: dict[str, Any] = {
        "supply": Receiver(2e-3, wall_conductance=1.0),
        "spool": SecondOrderSpool(60.0, 0.8),
        "tube": LumpedTube(1.0, 4e-3, 1),
        "gas": Gas(heat=ConstantHeatTransfer(30.0)),
    }
    return pam.AntagonisticSlide(
        "DMSP-20-200N",
        feed=SpoolValve(**{**feed, **arguments}),
        losses=pam.losses.PrandtlIshlinskii(),
    )


def waves(duration: float, number: int) -> dict[str, Any]:
    """Held commands, against each other."""
    t = np.linspace(0, duration, number)
    wave = 0.15 * np.sin(2 * np.pi * t)
    return {COMMANDS[0]: (t, wave), COMMANDS[1]: (t, -wave)}


def simulated(plant: pam.Plant) -> None:
    """10 s with 200 steps of the commands; the second run of each tolerance is timed."""
    names = [v.name for v in plant.states]
    nominal = plant.vector("state", attribute="nominal")
    exact = pam.simulate(plant, waves(10.0, 201), duration=10.0, rtol=1e-11).array(names)
    for rtol in (1e-6, 1e-7, 3e-8):
        for _ in range(2):
            before = time.process_time()
            run = pam.simulate(plant, waves(10.0, 201), duration=10.0, rtol=rtol)
            spent = time.process_time() - before
        error = np.abs(run.array(names) - exact).max(axis=0) / nominal
        worst = f"{error.max():.1e} of nominal, in {names[int(error.argmax())]}"
        print(f"simulate 10 s at rtol {rtol:g}: {spent:.2f} s of processor time; error {worst}")


def planned(plant: pam.Plant) -> None:
    """From -10 to 10 mm in half a second."""
    before = time.process_time()
    stops = [{"x": -0.01}, {"x": 0.01}]
    plan = pam.plan(plant, stops=stops, minimise="effort", duration=0.5, starts=1)
    print(f"plan: {time.process_time() - before:.1f} s of processor time; {plan.verdict}")


def exported(plant: pam.Plant) -> None:
    """Both versions of FMI, both modes."""
    motion = pam.simulate(plant, waves(1.0, 51), duration=1.0, rtol=1e-11)
    with tempfile.TemporaryDirectory() as folder:
        for fmi in ("2.0", "3.0"):
            path = Path(folder) / f"rig{fmi[0]}.fmu"
            fmu = pam.export_fmu(plant, path, platforms="native", fmi=fmi)  # type: ignore[arg-type]
            check = pam.check_fmu(fmu, against=motion)
            print(f"FMI {fmi}, {' and '.join(check.deviations)}: {check.largest:.1e} of nominal")


def main() -> None:
    plant = rig()
    print(plant)
    simulated(plant)
    exported(plant)
    planned(plant)


if __name__ == "__main__":
    main()

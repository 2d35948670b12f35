"""The rig that has everything: muscles with memory, a receiver, spool valves, tubes and heat.

    python benchmarks/rig.py [--verbs simulate export plan plain]

An antagonistic slide on two DMSP-20-200N muscles with asymmetric memory (two play operators each,
rounded off over a tenth of their force), each behind a proportional valve with a second-order spool
and a metre of tube, both on one receiver of two litres; the air's temperature is a state in muscles
and receiver. Shows: processor time of 10 s by machine code and by CasADi, each at three tolerances,
and the error against 1e-11; deviations of the FMUs in both modes; processor time of a planned
motion and its verdict, on a chosen mesh (`plan`) and by the default call (`plain`: four starts, all
processes counted). Those of a loaded machine are longer.
"""

from __future__ import annotations

import argparse
import resource
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


def spent() -> float:
    """Processor seconds of this process and of those it started."""
    each = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in each)


def rig(losses: Any = None, **arguments: Any) -> pam.Plant:
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
        losses=losses or pam.losses.PrandtlIshlinskii(edge=0.1),
    )


def waves(duration: float, number: int) -> dict[str, Any]:
    """Held commands, against each other."""
    t = np.linspace(0, duration, number)
    wave = 0.15 * np.sin(2 * np.pi * t)
    return {COMMANDS[0]: (t, wave), COMMANDS[1]: (t, -wave)}


def simulated(plant: pam.Plant) -> None:
    """10 s with 200 steps of the commands; of three runs at each tolerance the quickest counts."""
    names = [v.name for v in plant.states]
    nominal = plant.vector("state", attribute="nominal")
    exact = pam.simulate(plant, waves(10.0, 201), duration=10.0, rtol=1e-11).array(names)
    ways = {"machine code": (True, (1e-6, 3e-7, 1e-7)), "CasADi": (False, (1e-6, 1e-7, 3e-8))}
    for way, (compiled, tolerances) in ways.items():
        for rtol in tolerances:
            spent = []
            for _ in range(3):
                before = time.process_time()
                run = pam.simulate(
                    plant, waves(10.0, 201), duration=10.0, rtol=rtol, compiled=compiled
                )
                spent.append(time.process_time() - before)
            error = np.abs(run.array(names) - exact).max(axis=0) / nominal
            worst = f"{error.max():.1e} of nominal, in {names[int(error.argmax())]}"
            print(f"10 s by {way}, rtol {rtol:g}: {min(spent):.2f} s of processor; error {worst}")


def planned(plant: pam.Plant) -> None:
    """From -10 to 10 mm in half a second, both muscles taut all the while.

    Spools and tubes ring at 60 to 85 Hz, and swing less where commands have no jumps: they are
    straight lines on each of 20 intervals.
    """
    before = spent()
    stops = [{"x": -0.01, "muscle1.pressure": 1.5e5}, {"x": 0.01}]
    method = pam.Collocation(intervals=20, degree=6, control="linear")
    plan = pam.plan(plant, stops, minimise="effort", duration=0.5, starts=1, method=method)
    print(f"plan: {spent() - before:.1f} s of processor time; {plan.verdict}")


def planned_plainly() -> None:
    """The same motion by the default call, memories with their own sharper edges."""
    plant, before = rig(losses=pam.losses.PrandtlIshlinskii()), spent()
    plan = pam.plan(plant, [{"x": -0.01}, {"x": 0.01}], minimise="effort", duration=0.5)
    print(f"plan by default: {spent() - before:.1f} s of processor time; {plan.verdict}")


def exported(plant: pam.Plant) -> None:
    """Both versions of FMI, both modes."""
    motion = pam.simulate(plant, waves(1.0, 51), duration=1.0, rtol=1e-11)
    with tempfile.TemporaryDirectory() as folder:
        for fmi in ("2.0", "3.0"):
            path = Path(folder) / f"rig{fmi[0]}.fmu"
            fmu = pam.export_fmu(plant, path, platforms="native", fmi=fmi)  # type: ignore[arg-type]
            check = pam.check_fmu(fmu, against=motion)
            print(f"FMI {fmi}, {' and '.join(check.deviations)}: {check.largest:.1e} of nominal")


VERBS = {
    "simulate": simulated,
    "export": exported,
    "plan": planned,
    "plain": lambda plant: planned_plainly(),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--verbs", nargs="*", choices=VERBS, default=list(VERBS))
    plant = rig()
    print(plant)
    for verb in parser.parse_args().verbs:
        VERBS[verb](plant)


if __name__ == "__main__":
    main()

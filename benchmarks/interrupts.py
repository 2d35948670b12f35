"""How soon Ctrl-C ends each verb: interrupts at random moments, one process each.

    python benchmarks/interrupts.py [--tries 10] [--within 3.0] [--seed 0] [VERB ...]

Prints per verb: interrupts sent, runs that were over before, swallowed (the verb returned, or ended
by anything but KeyboardInterrupt, behind the interrupt), median and worst latency. Moments crowd
towards the start, where modules are loaded; each process is a fork of one that has loaded CasADi
only. tests/core/test_stop.py runs the same verbs.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import itertools
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from typing import Any

LONGEST = 60.0
"""Behind the signal; then the process is killed [s]."""
STOPS = [{"x": -0.015}, {"x": 0.015}]
Work = Callable[[], Any]
Verb = Callable[[Any, str], Work]


# ---- what verbs are given ------------------------------------------------------------------------
def slide(pam: Any) -> Any:
    return pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10)


def hanging(pam: Any, **options: Any) -> Any:
    return pam.HangingLoad(pam.muscle("DMSP-20-300"), **{"mass": 10.0, **options})


def table(pam: Any) -> Any:
    return pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)


def recorded(pam: Any) -> Any:
    plant = hanging(pam)
    times = [0.002 * i for i in range(500)]
    return plant, pam.simulate(plant, {plant.inputs[0].name: 3e5}, t=times)


def fed_back(pam: Any) -> Any:
    """A plant that vibrates from some gain on, and where it rests."""
    plant = pam.RegulatedLoad(pam.muscle("DMSP-20-400N"), mass=20.0, lag=0.1)
    return plant, {"x": 0.04, "muscle.reference": 0.04}


def many(pam: Any, **options: Any) -> Work:
    masses = [{"parameters": {"mass": 2.0 + 1e-4 * i}} for i in range(100_000)]
    return lambda: pam.simulate_many(slide(pam), masses, duration=1.0, **options)


# ---- verbs of more than a line -------------------------------------------------------------------
def pooled(kind: Any) -> Verb:
    def work(pam: Any) -> Any:
        with kind(2) as pool:
            return many(pam, executor=pool)()

    return lambda pam, folder: partial(work, pam)


def plan_infeasible(pam: Any, folder: str) -> Work:
    """The whole search for a reason."""

    def tried() -> None:
        with contextlib.suppress(pam.PlanError):
            pam.plan(slide(pam), STOPS, duration=0.01)

    return tried


def plan_valves(pam: Any, folder: str) -> Work:
    """Several starts, side by side in processes."""
    plant = hanging(pam, feed=pam.feeds.SpoolValve(conductance=1e-9))
    return lambda: pam.plan(plant, [{"x": 0.03}, {"x": 0.05}], tolerance=None)


def robust_plan(pam: Any, folder: str) -> Work:
    draws = {"draws": [{"mass": mass} for mass in (1.9, 2.0, 2.1)], "spread": {"x": 2e-3}}
    return lambda: pam.robust_plan(slide(pam), STOPS, tolerance=None, share=None, **draws)


def fit_plant(pam: Any, folder: str) -> Work:
    plant, record = recorded(pam)
    return lambda: pam.fit_plant(plant, record, [plant.parameters[0].name], outputs=["x"])


def free_run(pam: Any, folder: str) -> Work:
    plant, record = recorded(pam)
    options = {"horizon": 0.2, "every": 0.1, "outputs": ["x"]}
    return lambda: pam.fit_free_run(plant, record, ["mass"], **options)


def design_signal(pam: Any, folder: str) -> Work:
    options = {"duration": 1.0, "noise": {"x": 1e-4}}
    return lambda: pam.experiments.design_signal(hanging(pam), ["mass"], **options)


def design_cells(pam: Any, folder: str) -> Work:
    fit = pam.fit_force(table(pam))
    return lambda: pam.experiments.design_cells(fit, 12)


def equilibrium_branch(pam: Any, folder: str) -> Work:
    way = ("mass", 5.0, 60.0, {"muscle.pressure": 3e5})
    return lambda: pam.operating.equilibrium_branch(hanging(pam), *way, longest=0.01)


def hopf_border(pam: Any, folder: str) -> Work:
    plant, rest = fed_back(pam)
    way = ("muscle.gain", (1e5, 5e7), "muscle.lag", [0.02 + 0.02 * i for i in range(40)])
    return lambda: pam.vibration.hopf_border(plant, *way, rest)


def limit_cycles(pam: Any, folder: str) -> Work:
    plant, rest = fed_back(pam)

    def followed() -> Any:
        point = pam.vibration.hopf(plant, "muscle.gain", (1e5, 1e7), rest)
        small = pam.vibration.limit_cycle(point.plant, point, amplitude={"x": 2e-3})
        within = (0.2 * point.value, 1.5 * point.value)
        return pam.vibration.continue_cycle(small, "muscle.gain", within, step=0.1)

    return followed


def closed_loop_ipopt(pam: Any, folder: str) -> Work:
    plant = slide(pam)
    mpc = pam.Mpc(plant, track={"x": 1.0}, sample_time=0.01, horizon=40, solver="ipopt")
    return lambda: mpc.closed_loop(plant, {"x": 0.01}, duration=20.0)


def export_fmu(pam: Any, folder: str) -> Work:
    """Compilers at work; each plant another one, so that none is found in the cache."""
    masses = itertools.count(5.0 + 40.0 * random.SystemRandom().random(), 1e-3)
    unit = {"path": f"{folder}/plant.fmu", "platforms": ["native"]}
    return lambda: pam.export_fmu(hanging(pam, mass=next(masses)), **unit)


def export_controller(pam: Any, folder: str) -> Work:
    plant = hanging(pam)

    def exported() -> Any:
        feedback = pam.lqr(plant, plant.equilibrium(x=0.05), sample_time=1e-3)
        controller = pam.control.state_feedback_controller(feedback)
        return pam.export_fmu(controller, f"{folder}/controller.fmu", platforms=["native"])

    return exported


def check_fmu(pam: Any, folder: str) -> Work:
    path = pam.export_fmu(hanging(pam), f"{folder}/plant.fmu", platforms=["native"])
    return lambda: pam.check_fmu(path, duration=5.0)


def files(pam: Any, folder: str) -> Work:
    """Readers and writers, with the libraries that they load."""
    _, record = recorded(pam)

    def there_and_back() -> None:
        for end in (".csv", ".npz", ".parquet"):
            record.save(f"{folder}/record{end}")
            pam.Trajectory.load(f"{folder}/record{end}")
        pam.save_muscle(pam.muscle("DMSP-20-300"), f"{folder}/record.toml")
        pam.load_muscle(f"{folder}/record.toml")
        table(pam)

    return there_and_back


LONG = {"t": [0.0, 2e5], "step": 1e-4, "max_steps": 10**9}
"""Some minutes in one call of the integrator."""
GIVEN = {"muscle.pressure": 2e5}
VERBS: dict[str, Verb] = {
    "simulate": lambda pam, _: lambda: pam.simulate(slide(pam), **LONG),
    "plan": lambda pam, _: lambda: pam.plan(slide(pam), STOPS),
    "plan_work": lambda pam, _: lambda: pam.plan(slide(pam), STOPS, minimise="work", duration=0.5),
    "plan_infeasible": plan_infeasible,
    "plan_valves": plan_valves,
    "pareto": lambda pam, _: lambda: pam.pareto(slide(pam), STOPS, points=7),
    "robust_plan": robust_plan,
    "compare_laws": lambda pam, _: lambda: pam.compare_laws(table(pam)),
    "fit_force": lambda pam, _: lambda: pam.fit_force(table(pam), loss="bisquare"),
    "bootstrap": lambda pam, _: lambda: pam.fit_force(table(pam)).bootstrap(100_000),
    "fit_plant": fit_plant,
    "equilibria": lambda pam, _: lambda: pam.operating.equilibria(hanging(pam), GIVEN, starts=1000),
    "load_study": lambda pam, _: lambda: pam.load_study("DMSP-20-300"),
    "closed_loop_ipopt": closed_loop_ipopt,
    "free_run": free_run,
    "design_signal": design_signal,
    "design_cells": design_cells,
    "equilibrium_branch": equilibrium_branch,
    "hopf_border": hopf_border,
    "limit_cycles": limit_cycles,
    "export_fmu": export_fmu,
    "export_controller": export_controller,
    "check_fmu": check_fmu,
    "files": files,
    "figures": lambda pam, _: recorded(pam)[1].plot,
    "simulate_many": lambda pam, _: many(pam),
    "simulate_many_workers": lambda pam, _: many(pam, workers=2),
    "simulate_many_pool": pooled(ProcessPoolExecutor),
    "simulate_many_threads": pooled(ThreadPoolExecutor),
}
"""(pam_ocp, a folder) -> what is done again and again, so that an interrupt always finds it."""


# ---- one try -------------------------------------------------------------------------------------
def run(name: str, told: Any) -> None:
    """In the process of its own: says "go", works, and says how it ended and when."""
    end = "nothing"
    # a shell starts what runs in the background with the signal ignored
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        import warnings

        import pam_ocp as pam

        warnings.simplefilter("ignore")
        faulthandler.dump_traceback_later(LONGEST - 10.0)  # where it hangs, if it does
        told.write("go\n")
        told.flush()
        with tempfile.TemporaryDirectory() as folder:
            work = VERBS[name](pam, folder)
            for _ in range(1000):
                work()
        end = "returned"
    except KeyboardInterrupt:
        end = "KeyboardInterrupt"
    except BaseException as error:
        end = f"{type(error).__name__}: {error}".splitlines()[0]
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # over before
    told.write(f"{time.monotonic()} {end}\n")
    told.flush()


def _forked(name: str) -> Any:
    """(process number, what it says): a fork, so that loading does not take the time of a try."""
    read, write = os.pipe()
    process = os.fork()
    if process == 0:
        os.close(read)
        run(name, os.fdopen(write, "w"))
        os._exit(0)
    os.close(write)
    return process, os.fdopen(read)


def shot(name: str, after: float, number: int = signal.SIGINT) -> tuple[str, float]:
    """How the verb ended, and how long [s] after the signal."""
    process, said = _forked(name)
    with said:
        began = said.readline() == "go\n"
        time.sleep(after)
        sent = time.monotonic()
        os.kill(process, number)
        killer = threading.Timer(LONGEST, os.kill, (process, signal.SIGKILL))
        killer.start()
        out = said.readline() if began else ""
        killer.cancel()
        code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    return _how(out, code, sent)


def interrupted(name: str, after: float, number: int = signal.SIGINT) -> tuple[str, float]:
    """The same in a fresh interpreter."""
    command = [sys.executable, __file__, "--run", name]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "go\n"
        time.sleep(after)
        sent = time.monotonic()
        process.send_signal(number)
        try:
            out, _ = process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            process.kill()
            return "went on for a minute", LONGEST
    return _how(out, process.returncode, sent)


def _how(out: str, code: int, sent: float) -> tuple[str, float]:
    if not out:
        return f"exit code {code}", time.monotonic() - sent
    at, end = out.split(maxsplit=1)
    return ("over before", 0.0) if float(at) < sent else (end.strip(), float(at) - sent)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("verbs", nargs="*", metavar="VERB", help=", ".join(VERBS))
    parser.add_argument("--tries", type=int, default=10)
    parser.add_argument("--within", type=float, default=3.0, help="latest moment [s]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--run", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        run(options.run, sys.stdout)
        return
    import casadi  # noqa: F401
    import numpy as np  # noqa: F401

    random.seed(options.seed)
    lost = 0
    print("| verb | sent | over before | swallowed | median [s] | worst [s] |")
    print("|---|---|---|---|---|---|")
    for name in options.verbs or VERBS:
        # half of the moments within a quarter of the time
        moments = [options.within * random.random() ** 2 for _ in range(options.tries)]
        ends = [shot(name, moment) for moment in moments]
        met = [end for end in ends if end[0] != "over before"]
        wrong = [end[0] for end in met if end[0] != "KeyboardInterrupt"]
        lost += len(wrong)
        times = [seconds for _, seconds in met] or [float("nan")]
        print(
            f"| {name} | {len(met)} | {len(ends) - len(met)} | {len(wrong)} | "
            f"{statistics.median(times):.3f} | {max(times):.3f} |"
            + "".join(
                f"\n    {moment:.4f} s: {end[0][:150]}"
                for moment, end in zip(moments, ends, strict=True)
                if end[0] not in ("over before", "KeyboardInterrupt")
            ),
            flush=True,
        )
    sys.exit(lost > 0)


if __name__ == "__main__":
    main()

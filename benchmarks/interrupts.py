"""How soon Ctrl-C ends each verb: interrupts at random moments, one process each.

    python benchmarks/interrupts.py [--tries 10] [--seed 0] [VERB ...]

Prints per verb: interrupts sent, runs that were over before, swallowed (the verb returned, or ended
by anything but KeyboardInterrupt, behind the interrupt), median and worst latency. tests/core/
test_stop.py runs the same verbs.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

VERBS: dict[str, Callable[[Any], Any]] = {}


def _verb(function: Callable[[Any], Any]) -> Callable[[Any], Any]:
    VERBS[function.__name__] = function
    return function


STOPS = [{"x": -0.015}, {"x": 0.015}]


def _slide(pam: Any) -> Any:
    return pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), mass=2.0, pre_contraction=0.10)


def _hanging(pam: Any) -> Any:
    return pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=10.0)


def _table(pam: Any) -> Any:
    return pam.read_table("DMSP-20-300_static.csv", rest_length=0.300)


def _again(work: Callable[[], Any], times: int = 1000) -> Any:
    """The work again and again, so that an interrupt always finds it."""
    for _ in range(times):
        found = work()
    return found


@_verb
def simulate(pam: Any) -> Any:
    """Some minutes in one call of the integrator."""
    return pam.simulate(_slide(pam), t=[0.0, 2e5], step=1e-4, max_steps=10**9)


@_verb
def plan(pam: Any) -> Any:
    return _again(lambda: pam.plan(_slide(pam), STOPS))


@_verb
def plan_work(pam: Any) -> Any:
    return _again(lambda: pam.plan(_slide(pam), STOPS, minimise="work", duration=0.5))


@_verb
def plan_infeasible(pam: Any) -> Any:
    """The whole search for a reason."""
    far = [{"x": -0.015}, {"x": 0.015}]

    def tried() -> None:
        try:
            pam.plan(_slide(pam), far, duration=0.01)
        except pam.PlanError:
            return

    return _again(tried)


@_verb
def plan_valves(pam: Any) -> Any:
    """Several starts, side by side in processes."""
    m = pam.muscle("DMSP-20-300")
    valve = pam.feeds.SpoolValve(conductance=1e-9)
    plant = pam.HangingLoad(m, mass=10.0, feed=valve)
    return _again(lambda: pam.plan(plant, [{"x": 0.03}, {"x": 0.05}], tolerance=None))


@_verb
def pareto(pam: Any) -> Any:
    return _again(lambda: pam.pareto(_slide(pam), STOPS, points=7))


@_verb
def robust_plan(pam: Any) -> Any:
    draws = [{"mass": mass} for mass in (1.9, 2.0, 2.1)]
    return _again(
        lambda: pam.robust_plan(
            _slide(pam), STOPS, draws=draws, spread={"x": 2e-3}, tolerance=None, share=None
        )
    )


@_verb
def compare_laws(pam: Any) -> Any:
    return _again(lambda: pam.compare_laws(_table(pam)))


@_verb
def fit_force(pam: Any) -> Any:
    return _again(lambda: pam.fit_force(_table(pam), loss="bisquare"))


@_verb
def bootstrap(pam: Any) -> Any:
    return pam.fit_force(_table(pam)).bootstrap(100_000)


@_verb
def fit_plant(pam: Any) -> Any:
    plant = _hanging(pam)
    record = pam.simulate(plant, {plant.inputs[0].name: 3e5}, t=[0.002 * i for i in range(500)])
    free = [plant.parameters[0].name]
    return _again(lambda: pam.fit_plant(plant, record, free, outputs=["x"]))


@_verb
def equilibria(pam: Any) -> Any:
    return _again(lambda: pam.equilibria(_hanging(pam), {"muscle.pressure": 2e5}, starts=1000))


@_verb
def load_study(pam: Any) -> Any:
    return _again(lambda: pam.load_study("DMSP-20-300"))


@_verb
def closed_loop_ipopt(pam: Any) -> Any:
    plant = _slide(pam)
    mpc = pam.Mpc(plant, track={"x": 1.0}, sample_time=0.01, horizon=40, solver="ipopt")
    return _again(lambda: mpc.closed_loop(plant, {"x": 0.01}, duration=20.0))


@_verb
def simulate_many(pam: Any) -> Any:
    cases = [{"parameters": {"mass": 2.0 + 1e-4 * i}} for i in range(100_000)]
    return pam.simulate_many(_slide(pam), cases, duration=1.0)


def run(name: str) -> None:
    """In the process of its own: says "go", works, and says how it ended and when."""
    import warnings

    import pam_ocp as pam

    warnings.simplefilter("ignore")
    print("go", flush=True)
    try:
        VERBS[name](pam)
        end = "returned"
    except KeyboardInterrupt:
        end = "KeyboardInterrupt"
    except BaseException as error:
        end = f"{type(error).__name__}: {error}".splitlines()[0]
    print(time.monotonic(), end, flush=True)


def interrupted(name: str, after: float, number: int = signal.SIGINT) -> tuple[str, float]:
    """How the verb ended, and how long [s] after the signal."""
    process = subprocess.Popen(
        [sys.executable, __file__, "--run", name], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    with process:
        assert process.stdout.readline() == "go\n"
        time.sleep(after)
        if process.poll() is not None:
            return "over before", 0.0
        sent = time.monotonic()
        os.kill(process.pid, number)
        try:
            out, _ = process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            return "went on for a minute", 60.0
    if not out:
        return f"exit code {process.returncode}", time.monotonic() - sent
    at, end = out.split(maxsplit=1)
    return ("over before", 0.0) if float(at) < sent else (end.strip(), float(at) - sent)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("verbs", nargs="*", metavar="VERB", help=", ".join(VERBS))
    parser.add_argument("--tries", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--run", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        run(options.run)
        return
    random.seed(options.seed)
    print("| verb | sent | over before | swallowed | median [s] | worst [s] |")
    print("|---|---|---|---|---|---|")
    for name in options.verbs or VERBS:
        ends = [interrupted(name, random.uniform(0.02, 3.0)) for _ in range(options.tries)]
        met = [end for end in ends if end[0] != "over before"]
        wrong = [end[0] for end in met if end[0] != "KeyboardInterrupt"]
        times = [seconds for _, seconds in met] or [float("nan")]
        print(
            f"| {name} | {len(met)} | {len(ends) - len(met)} | {len(wrong)} | "
            f"{statistics.median(times):.3f} | {max(times):.3f} |"
            + (f" {wrong[0][:80]}" if wrong else ""),
            flush=True,
        )


if __name__ == "__main__":
    main()

"""How soon Ctrl-C ends each verb: interrupts at random moments, one process each.

    python benchmarks/interrupts.py [--tries 10] [--within 3.0] [--seed 0] [VERB ...]

Prints per verb: interrupts sent, runs that were over before, swallowed (the verb returned, or ended
by anything but KeyboardInterrupt, behind the interrupt), median and worst latency. Moments crowd
towards the start, where modules are loaded; each process is a fork of one that has loaded CasADi
only. tests/core/test_stop.py runs the same verbs.
"""

from __future__ import annotations

import argparse
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
from typing import Any

LONGEST = 60.0
"""Behind the signal; then the process is killed [s]."""
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


def _recorded(pam: Any) -> Any:
    plant = _hanging(pam)
    times = [0.002 * i for i in range(500)]
    return plant, pam.simulate(plant, {plant.inputs[0].name: 3e5}, t=times)


def _fed_back(pam: Any) -> Any:
    """A plant that vibrates from some gain on, and where it rests."""
    plant = pam.RegulatedLoad(pam.muscle("DMSP-20-400N"), mass=20.0, lag=0.1)
    return plant, {"x": 0.04, "muscle.reference": 0.04}


@_verb
def fit_plant(pam: Any) -> Any:
    plant, record = _recorded(pam)
    free = [plant.parameters[0].name]
    return _again(lambda: pam.fit_plant(plant, record, free, outputs=["x"]))


@_verb
def equilibria(pam: Any) -> Any:
    return _again(
        lambda: pam.operating.equilibria(_hanging(pam), {"muscle.pressure": 2e5}, starts=1000)
    )


@_verb
def load_study(pam: Any) -> Any:
    return _again(lambda: pam.load_study("DMSP-20-300"))


@_verb
def closed_loop_ipopt(pam: Any) -> Any:
    plant = _slide(pam)
    mpc = pam.Mpc(plant, track={"x": 1.0}, sample_time=0.01, horizon=40, solver="ipopt")
    return _again(lambda: mpc.closed_loop(plant, {"x": 0.01}, duration=20.0))


@_verb
def free_run(pam: Any) -> Any:
    plant, record = _recorded(pam)
    return _again(
        lambda: pam.fit_free_run(plant, record, ["mass"], horizon=0.2, every=0.1, outputs=["x"])
    )


@_verb
def design_signal(pam: Any) -> Any:
    return _again(
        lambda: pam.experiments.design_signal(
            _hanging(pam), ["mass"], duration=1.0, noise={"x": 1e-4}
        )
    )


@_verb
def design_cells(pam: Any) -> Any:
    fit = pam.fit_force(_table(pam))
    return _again(lambda: pam.experiments.design_cells(fit, 12))


@_verb
def equilibrium_branch(pam: Any) -> Any:
    return _again(
        lambda: pam.operating.equilibrium_branch(
            _hanging(pam), "mass", 5.0, 60.0, {"muscle.pressure": 3e5}, longest=0.01
        )
    )


@_verb
def hopf_border(pam: Any) -> Any:
    plant, rest = _fed_back(pam)
    lags = [0.02 + 0.02 * i for i in range(40)]
    return _again(
        lambda: pam.vibration.hopf_border(
            plant, "muscle.gain", (1e5, 5e7), "muscle.lag", lags, rest
        )
    )


@_verb
def limit_cycles(pam: Any) -> Any:
    plant, rest = _fed_back(pam)

    def followed() -> Any:
        point = pam.vibration.hopf(plant, "muscle.gain", (1e5, 1e7), rest)
        small = pam.vibration.limit_cycle(point.plant, point, amplitude={"x": 2e-3})
        within = (0.2 * point.value, 1.5 * point.value)
        return pam.vibration.continue_cycle(small, "muscle.gain", within, step=0.1)

    return _again(followed)


@_verb
def export_fmu(pam: Any) -> Any:
    """Compilers at work; each plant another one, so that none is found in the cache."""
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "plant.fmu")
        masses = itertools.count(5.0 + 40.0 * random.SystemRandom().random(), 1e-3)
        return _again(
            lambda: pam.export_fmu(
                pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=next(masses)),
                path,
                platforms=["native"],
            )
        )


@_verb
def export_controller(pam: Any) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "controller.fmu")
        plant = _hanging(pam)

        def exported() -> Any:
            feedback = pam.lqr(plant, plant.equilibrium(x=0.05), sample_time=1e-3)
            controller = pam.control.state_feedback_controller(feedback)
            return pam.export_fmu(controller, path, platforms=["native"])

        return _again(exported)


@_verb
def check_fmu(pam: Any) -> Any:
    with tempfile.TemporaryDirectory() as folder:
        path = os.path.join(folder, "plant.fmu")
        pam.export_fmu(_hanging(pam), path, platforms=["native"])
        return _again(lambda: pam.check_fmu(path, duration=5.0))


@_verb
def files(pam: Any) -> Any:
    """Readers and writers, with the libraries that they load."""
    with tempfile.TemporaryDirectory() as folder:
        _, record = _recorded(pam)
        path = os.path.join(folder, "record")

        def there_and_back() -> None:
            for end in (".csv", ".npz", ".parquet"):
                record.save(path + end)
                pam.Trajectory.load(path + end)
            pam.save_muscle(pam.muscle("DMSP-20-300"), path + ".toml")
            pam.load_muscle(path + ".toml")
            _table(pam)

        return _again(there_and_back)


@_verb
def figures(pam: Any) -> Any:
    _, record = _recorded(pam)
    return _again(lambda: record.plot())


def _cases() -> list[dict[str, Any]]:
    return [{"parameters": {"mass": 2.0 + 1e-4 * i}} for i in range(100_000)]


@_verb
def simulate_many(pam: Any) -> Any:
    return pam.simulate_many(_slide(pam), _cases(), duration=1.0)


@_verb
def simulate_many_workers(pam: Any) -> Any:
    return pam.simulate_many(_slide(pam), _cases(), duration=1.0, workers=2)


@_verb
def simulate_many_pool(pam: Any) -> Any:
    with ProcessPoolExecutor(2) as pool:
        return pam.simulate_many(_slide(pam), _cases(), duration=1.0, executor=pool)


@_verb
def simulate_many_threads(pam: Any) -> Any:
    with ThreadPoolExecutor(2) as pool:
        return pam.simulate_many(_slide(pam), _cases(), duration=1.0, executor=pool)


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
        VERBS[name](pam)
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

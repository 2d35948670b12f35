"""Economical motions on every arrangement and feed that has them: do they converge, and are they
exact?

Work, air and exergy at the default call, a motion of fixed duration there and, for some, back.
Three figures each: the objective, the same integral by SciPy along its own replay of the plan (how
exact the reported figure is), and the objective on a mesh four times as fine (how far the optimum
may be off).

Run:  python benchmarks/economy.py [seed] [--fine]
"""

import sys
import time
import warnings

import numpy as np
import verdict_study
from scipy.integrate import trapezoid

import pam_ocp as pam
from pam_ocp.core.signals import signals

GOALS = {"work": 1.0, "air": 1e-3, "exergy": 10.0}
"""Term: its unit in SI."""


def plants(rng):
    """(words, plant, stops) of every arrangement with a regulator and with each kind of valve."""
    muscle = pam.muscle("DMSP-20-200N")
    reach = rng.uniform(0.006, 0.012)
    feeds = {
        "regulator": lambda: pam.feeds.Regulator(),
        "spool": lambda: pam.feeds.SpoolValve(),
        "on-off": lambda: pam.feeds.OnOffValves(),
        "ideal": lambda: pam.feeds.IdealPressure(),
    }
    makers = {
        "hanging": lambda f: (
            pam.HangingLoad(muscle, rng.uniform(5, 15), feed=f),
            "x",
            0.01,
            0.01 + 2 * reach,
        ),
        "spring": lambda f: (
            pam.SpringOverMuscle(muscle, 2.0, feed=f),
            "x",
            0.005,
            0.005 + 2 * reach,
        ),
        "series": lambda f: (
            pam.SeriesLoad(muscle, rng.uniform(5, 15), feed=f),
            "x",
            0.01,
            0.01 + 2 * reach,
        ),
        "slide": lambda f: (pam.AntagonisticSlide(muscle, 2.0, feed=f), "x", -reach, reach),
        "joint": lambda f: (
            pam.AntagonisticJoint(muscle, feed=f),
            "theta",
            -30 * reach,
            30 * reach,
        ),
    }
    for kind, make in makers.items():
        for feed, build in feeds.items():
            plant, name, a, b = make(build())
            yield f"{kind}, {feed}", plant, [{name: a}, {name: b}]


def integral(plant, plan, term):
    """The term's integral along SciPy's own replay of the plan [SI]."""
    t, x, _ = verdict_study.scipy_replay(plant, plan, samples=4000)
    u = signals(plant, plan.trajectory, t)(t)
    y = np.asarray(plant.function(x.T, u.T, plant.vector("parameter"))[1], float)
    names = [v.name for v in plant.outputs]
    muscles = [n.removesuffix(".contraction") for n in names if n.endswith(".contraction")]
    key = {"work": "power", "air": "supply_flow", "exergy": "exergy_flow"}[term]
    values = [y[names.index(f"{m}.{key}")] for m in muscles]
    if term == "work":
        values = [np.maximum(v, 0.0) for v in values]
    return float(trapezoid(sum(values), t))


def main(seed=1, fine=False):
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(seed)
    total = found = 0
    for words, plant, stops in plants(rng):
        valves = any(v.name.endswith(".supply_flow") for v in plant.outputs)
        for term in GOALS if valves else ("work",):
            for cyclic in (False, True):
                total += 1
                begin = time.process_time()
                wanted = {"minimise": term, "duration": 0.4, "cyclic": cyclic}
                try:
                    plan = pam.plan(plant, stops, **wanted)
                except pam.PamError as error:
                    print(f"{words}, {term}, cyclic {cyclic}: {error}", flush=True)
                    continue
                seconds = time.process_time() - begin  # without those of other processes
                found += plan.verified
                line = f"{words:20s} {term:6s} {'cyclic' if cyclic else '      '} "
                line += f"{'verified' if plan.verified else 'UNVERIFIED'} {plan.objective:10.5g} "
                line += f"by SciPy {integral(plant, plan, term) / GOALS[term]:10.5g} "
                if fine:
                    finer = pam.plan(
                        plant, stops, **wanted, guess=plan, method=pam.Collocation(200, 3)
                    )
                    line += f"fine {finer.objective:10.5g} "
                print(
                    f"{line}  {plan.statistics['iterations']} iterations, {seconds:.1f} s",
                    flush=True,
                )
    print(f"{found} of {total} verified")


if __name__ == "__main__":
    main(
        int(sys.argv[1]) if len(sys.argv) > 1 and sys.argv[1] != "--fine" else 1,
        "--fine" in sys.argv,
    )

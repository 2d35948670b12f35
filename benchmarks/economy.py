"""Economical motions on every arrangement and feed that has them: do they converge, and are they
exact?

Work, air and exergy at the default call, a motion of fixed duration there, and there and back.
Figures: the objective, the same integral by SciPy along its own replay of the plan (how exact the
reported figure is), what the plan itself says that it may lie above the least, and (--fine) what it
lies above the best of two finer searches: on 200 to 400 equal intervals a leg, until it settles to
2e-4, and on its own mesh with each interval split in two, whose inputs hold the plan's among them.
Times are those of the processor, of all processes of a task together.

Run:  python benchmarks/economy.py [--seed N] [--fine] [--only WORD ...]
"""

import argparse
import contextlib
import warnings

import motion_check
import numpy as np
import random_tasks
import verdict_study

import pam_ocp as pam
from pam_ocp.planning.solvers.backend import Backend
from pam_ocp.planning.transcription.guess import from_solution
from pam_ocp.planning.transcription.mesh import doubled
from pam_ocp.planning.transcription.transcription import transcribe

GOALS = {"work": 1.0, "air": 1e-3, "exergy": 10.0}
"""Term: its unit in SI."""
REFERENCE = 2e-4
"""To which a reference settles."""
LEAST = 1e-2
"""Objectives below it are judged as if they were this large, as by plan."""


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


def integral(plant, stops, plan, term):
    """The term's integral along SciPy's own replay of the plan [SI]."""
    task = random_tasks.Task("", plant, stops, (), {"minimise": term})
    check = motion_check.Check(task, motion_check.Answer.of(plan))
    return float(dict(zip(check.running(), check.run().integrals, strict=True))[term])


def finer(plant, stops, wanted, plan):
    """The least objective of finer searches from a plan; none where none is found."""
    found = []
    equal = {"method": pam.Collocation(200, 3), "tolerance": REFERENCE}
    with contextlib.suppress(pam.PamError):
        found.append(pam.plan(plant, stops, **wanted, guess=plan, **equal).objective)
    coarse = plan._solved
    program = transcribe(coarse.program.problem, doubled(coarse.program.mesh))
    guess = from_solution(program.problem, program.mesh, coarse.solution)
    outcome = Backend().near().build(program)(program, guess, "near")
    return min([*found, *([outcome.objective] if outcome.success else [])], default=np.nan)


def judged(plant, stops, wanted, fine):
    """(verified, objective, by SciPy, what the plan says, error to the fine mesh, seconds)."""
    begin = verdict_study.spent()
    plan = pam.plan(plant, stops, **wanted)
    seconds = verdict_study.spent() - begin
    term, gap = wanted["minimise"], plan.statistics.get("objective_gap", np.nan)
    scipy = integral(plant, stops, plan, term) / GOALS[term]
    error = np.nan
    if fine:
        least = finer(plant, stops, wanted, plan)
        error = (plan.objective - least) / max(abs(least), LEAST)
    return plan.verified, plan.objective, scipy, gap, error, seconds


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--fine", action="store_true")
    parser.add_argument("--only", nargs="*", default=[""], help="arrangements or feeds")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(arguments.seed)
    rows = []
    for words, plant, stops in plants(rng):
        if not any(word in words for word in arguments.only):
            continue
        valves = any(v.name.endswith(".supply_flow") for v in plant.outputs)
        for term in GOALS if valves else ("work",):
            for cyclic in (False, True):
                wanted = {"minimise": term, "duration": 0.4, "cyclic": cyclic}
                line = f"{words:20s} {term:6s} {'cyclic' if cyclic else '':6s}"
                try:
                    row = judged(plant, stops, wanted, arguments.fine)
                except pam.PamError as error:
                    row = (False, *[np.nan] * 5)
                    print(f"{line} {' '.join(str(error).split())[:150]}", flush=True)
                else:
                    print(
                        f"{line} {'verified' if row[0] else 'UNVERIFIED':10s} {row[1]:9.5g} "
                        f"by SciPy {row[2]:9.5g}, gap {row[3]:8.1e}, error {row[4]:8.1e}, "
                        f"{row[5]:5.1f} s",
                        flush=True,
                    )
                rows.append(row)
    verified, values, scipy, gaps, errors, seconds = map(np.array, zip(*rows, strict=True))
    print(
        f"{verified.sum()} of {len(rows)} verified; {np.sum(errors <= 1e-3)} of "
        f"{np.isfinite(errors).sum()} within 1e-3 of the fine mesh, worst {np.nanmax(errors):.1e}; "
        f"{np.sum(gaps <= 1e-3)} say so; figures by SciPy agree to "
        f"{np.nanmax(abs(values - scipy) / np.maximum(abs(scipy), LEAST)):.1e}; "
        f"seconds: median {np.nanmedian(seconds):.1f}, worst {np.nanmax(seconds):.1f}"
    )


if __name__ == "__main__":
    main()

"""Minimum-energy and minimum-air motions of every arrangement and feed: do they converge, and are
they exact?

    python benchmarks/economy.py [--seed N] [--fine] [--only WORD ...]

Work, air and exergy at the default call, a motion of fixed duration there, and there and back.
Figures: the objective, the same integral by SciPy along its own replay of the plan (how exact the
reported figure is), what the plan itself says that it may lie above the least, and (--fine) what it
lies above the best of two finer searches: on 200 to 400 equal intervals a leg, until it settles to
2e-4, and on its own mesh with each interval split in two, whose inputs hold the plan's among them.
Times are those of the processor, of all processes of a task together.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import harness
import motion_check
import numpy as np
import random_tasks

import pam_ocp as pam
from pam_ocp.planning.solvers.solver import Backend
from pam_ocp.planning.transcription.guess import from_solution
from pam_ocp.planning.transcription.mesh import doubled
from pam_ocp.planning.transcription.transcription import transcribe

GOALS = {"work": 1.0, "air": 1e-3, "exergy": 10.0}
"""Term: its unit in SI."""
REFERENCE = 2e-4
"""To which a reference settles."""
LEAST = 1e-2
"""Objectives below it are judged as if they were this large, as by plan."""
FEEDS: dict[str, Callable[[], Any]] = {
    "regulator": pam.feeds.Regulator,
    "spool": pam.feeds.SpoolValve,
    "on-off": pam.feeds.OnOffValves,
    "ideal": pam.feeds.IdealPressure,
}


def plants(rng: np.random.Generator) -> Iterator[tuple[str, pam.Plant, list[dict[str, float]]]]:
    """(words, plant, stops) of every arrangement with a regulator and with each kind of valve."""
    muscle = pam.muscle("DMSP-20-200N")
    reach = rng.uniform(0.006, 0.012)
    above = (0.01, 0.01 + 2 * reach)
    makers: dict[str, tuple[Callable[[Any], pam.Plant], str, tuple[float, float]]] = {
        "hanging": (lambda f: pam.HangingLoad(muscle, rng.uniform(5, 15), feed=f), "x", above),
        "spring": (
            lambda f: pam.SpringOverMuscle(muscle, 2.0, feed=f),
            "x",
            (0.005, 0.005 + 2 * reach),
        ),
        "series": (lambda f: pam.SeriesLoad(muscle, rng.uniform(5, 15), feed=f), "x", above),
        "slide": (lambda f: pam.AntagonisticSlide(muscle, 2.0, feed=f), "x", (-reach, reach)),
        "joint": (
            lambda f: pam.AntagonisticJoint(muscle, feed=f),
            "theta",
            (-30 * reach, 30 * reach),
        ),
    }
    for kind, (make, name, ends) in makers.items():
        for feed, build in FEEDS.items():
            yield f"{kind}, {feed}", make(build()), [{name: end} for end in ends]


def integral(plant: pam.Plant, stops: list[Any], plan: pam.planning.Plan, term: str) -> float:
    """The term's integral along SciPy's own replay of the plan [SI]."""
    task = random_tasks.Task("", plant, stops, (), {"minimise": term})
    check = motion_check.Check(task, motion_check.Answer.of(plan))
    return float(dict(zip(check.running(), check.run().integrals, strict=True))[term])


def finer(
    plant: pam.Plant, stops: list[Any], wanted: dict[str, Any], plan: pam.planning.Plan
) -> float:
    """The least objective of finer searches from a plan; NaN where none is found."""
    found = []
    equal: dict[str, Any] = {"method": pam.Collocation(200, 3), "tolerance": REFERENCE}
    with contextlib.suppress(pam.PamError):
        found.append(pam.plan(plant, stops, **wanted, guess=plan, **equal).objective)
    coarse = plan._solved
    program = transcribe(coarse.program.problem, doubled(coarse.program.mesh))
    guess = from_solution(program.problem, program.mesh, coarse.solution)
    outcome = Backend().near().build(program)(program, guess, "near")
    return min([*found, *([outcome.objective] if outcome.success else [])], default=np.nan)


def judged(plant: pam.Plant, stops: list[Any], wanted: dict[str, Any], fine: bool) -> harness.Row:
    """Verdict, objective, the same by SciPy, the gap that the plan says, error to finer meshes."""
    begin = harness.spent()
    plan = pam.plan(plant, stops, **wanted)
    seconds = harness.spent() - begin
    term, value = wanted["minimise"], plan.objective
    row = {
        "verdict": "verified" if plan.verified else "UNVERIFIED",
        "objective": value,
        "scipy": integral(plant, stops, plan, term) / GOALS[term],
        "gap": plan.statistics.get("objective_gap", np.nan),
        "error": np.nan,
        "processor": seconds,
    }
    if fine:
        least = finer(plant, stops, wanted, plan)
        row["error"] = (value - least) / max(abs(least), LEAST)
    text = "{objective:9.5g} by SciPy {scipy:9.5g}, gap {gap:8.1e}, error {error:8.1e}"
    return {**row, "text": text.format(**row)}


def cases(given: harness.Given) -> harness.Keyed:
    for words, plant, stops in plants(np.random.default_rng(given.seed)):
        valves = any(v.name.endswith(".supply_flow") for v in plant.outputs)
        for term in GOALS if valves else ("work",):
            for cyclic in (False, True):
                wanted = {"minimise": term, "duration": 0.4, "cyclic": cyclic}
                key = f"{words}, {term}{', cyclic' if cyclic else ''}"
                yield key, partial(judged, plant, stops, wanted, given.fine)


def summary(rows: list[harness.Row]) -> str:
    names = ("objective", "scipy", "gap", "error")
    solved = [r for r in rows if "objective" in r]
    values, scipy, gaps, errors = (np.array([r[n] for r in solved], float) for n in names)
    off = np.max(abs(values - scipy) / np.maximum(abs(scipy), LEAST), initial=0.0)
    text = f"{np.sum(gaps <= 1e-3)} say within 1e-3; figures by SciPy agree to {off:.1e}"
    known = errors[np.isfinite(errors)]
    if known.size:
        text += f"; {np.sum(known <= 1e-3)} of {known.size} within 1e-3 of the fine mesh, worst "
        text += f"{known.max():.1e}"
    return text


OPTIONS = {"--fine": harness.flag("compare with finer searches")}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, seed=1, options=OPTIONS)

"""Plans of motions, for the tab Motion: one in full, and one after the other while a hand drags.

A motion is a member of the session's ``motions``::

    {"id", "name", "variable": position that the stops name, "second": another variable, or None,
     "stops": [{"at", "second": value or None, "dwell", "rest": bool}, ...],
     "durations": [of each leg [s], or None: free], "cyclic": bool, "minimise": {term: weight},
     "bounds": [{"name", "low", "high"}], "method": of METHODS}
"""

from __future__ import annotations

import copy
import json
import re
import time
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core.errors import InputError, PlanError
from ...core.trajectory import Trajectory
from ...figures.film import scene_of
from ...figures.plan import panels_of
from ...judge.statement import COSTS
from ...planning.active import limits_along
from ...planning.planner import Planner, plan
from ...planning.result import Plan
from ...planning.transcription.mesh import Collocation
from ...plants.plant import Plant
from ..look import numbers
from ..made import World, kept, plant_of, records_of
from ..script import METHODS, TIME_LIMIT, arguments
from ..work import Say, job

DRAGGED = Collocation(20, 3)
"""The mesh while a hand drags."""
FRAMES = 80
"""Of an animation."""
SAMPLES = 240
"""Of a curve that is drawn, about."""


# ---- what a motion says --------------------------------------------------------------------------
def first_motion(plant: Plant, id: str, name: str, variable: str = "") -> dict[str, Any]:
    """A motion to begin with: over the middle of the stroke, and back to nothing.

    variable : that moves, by default the plant's first position.
    """
    if not plant.positions:
        raise InputError(f"{plant.name} has no position that moves; choose another arrangement")
    variable = variable or next(iter(plant.positions))
    low, high = stroke_of(plant, variable)
    return {
        "id": id,
        "name": name,
        "variable": variable,
        "second": None,
        "stops": [stop_at(low + part * (high - low)) for part in (0.35, 0.65)],
        "durations": [None],
        "cyclic": False,
        "minimise": {"time": 1.0},
        "bounds": [],
        "method": "usual",
    }


def stop_at(at: float, rest: bool = True) -> dict[str, Any]:
    """A stop that names the position alone."""
    return {"at": at, "second": None, "dwell": 0.0, "rest": rest}


def stroke_of(plant: Plant, name: str) -> tuple[float, float]:
    """The range of a variable; where it is open, one as wide as its nominal."""
    v = plant.variable(name)
    low = v.min if np.isfinite(v.min) else (v.start or 0.0) - v.nominal
    high = v.max if np.isfinite(v.max) else (v.start or 0.0) + v.nominal
    return float(low), float(high)


def terms_of(plant: Plant) -> dict[str, str]:
    """{term that a plan of this plant may minimise: what it is}."""
    air = any(v.name.endswith(".supply_flow") for v in plant.outputs)
    terms = {n: cost.title for n, cost in COSTS.items() if air or not cost.from_supply}
    return {**terms, "rate": "Integral of the squared rates of the inputs"}


# ---- plans ---------------------------------------------------------------------------------------
def plan_of(world: World, motion: Mapping[str, Any]) -> Plan:
    """The plan of a motion as a script makes it: from nothing, in full. The last few are kept."""
    return _plan(world, {k: motion[k] for k in motion if k not in ("id", "name")})


@kept("plant", "muscle")
def _plan(world: World, motion: Mapping[str, Any]) -> Plan:
    plant = plant_of(world)
    said = arguments(motion)
    method = METHODS[motion["method"]][1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the verdict stands on the page
        return plan(plant, said.pop("stops"), method=method, time_limit=TIME_LIMIT, **said)


@job("Plan {}", warm="plan", latest="plan", time_limit=TIME_LIMIT + 30.0)
def planned(say: Say, world: World, motion: Mapping[str, Any]) -> dict[str, Any]:
    """The plan in full, with its animation, as plain values; of one that is not, why not."""
    say(None, "planning")
    try:
        found = plan_of(world, motion)
    except PlanError as error:
        return _failed(error)
    _keep(_full, f"{world.folder} {motion['id']}", found)
    said = _told(found, motion)
    said["figures"] = motion_figures(found)
    said["shown"] = {n: with_unit(found.plant, n, v) for n, v in said["figures"].items()}
    said["scene"] = _film(found)
    return said


_kept: dict[str, tuple[Planner, Plan | None]] = {}
_full: dict[str, Plan] = {}
"""The last plan of a motion, from which a hand sets out."""
MOST_KEPT = 4
"""Planners, and such plans, that a process keeps."""


@job("Plan under the hand", warm="plan", latest="drag", time_limit=30.0, quiet=True)
def dragged(say: Say, world: World, motion: Mapping[str, Any]) -> dict[str, Any]:
    """The plan on a coarse mesh, warm from the last one of the same form; see :func:`planned`."""
    begin = time.perf_counter()
    said = arguments(motion)
    made_of = [world.state[n] for n in ("plant", "muscle")]
    form = json.dumps([str(world.folder), made_of, _form(motion)], sort_keys=True)
    planner, last = _kept.pop(form, (None, None))
    if planner is None:
        plant = plant_of(world)
        stops = said["stops"]
        others = {k: v for k, v in said.items() if k != "stops"}
        planner = Planner(plant, stops, method=DRAGGED, **others)
        last = _full.get(f"{world.folder} {motion['id']}")
    changed = {k: said[k] for k in ("stops", "duration", "bounds") if k in said}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            found = planner(guess=last, tolerance=None, starts=1, time_limit=20.0, **changed)
        except PlanError as error:
            _keep(_kept, form, (planner, last))
            return _failed(error)
    _keep(_kept, form, (planner, found))
    told = _told(found, motion)
    told["verb_seconds"] = time.perf_counter() - begin
    return told


def _keep(store: dict[str, Any], name: str, value: Any) -> None:
    """The last few of a store."""
    store[name] = value
    while len(store) > MOST_KEPT:
        del store[next(iter(store))]


def _form(motion: Mapping[str, Any]) -> dict[str, Any]:
    """All of a motion but the numbers that a built planner may change."""
    form = copy.deepcopy({k: v for k, v in motion.items() if k not in ("id", "name", "method")})
    for stop in form["stops"]:
        stop["at"] = 0.0
        stop["second"] = None if stop["second"] is None else 0.0
    form["durations"] = [None if d is None else 0.0 for d in form["durations"]]
    for bound in form["bounds"]:
        bound.update({side: None if bound[side] is None else 0.0 for side in ("low", "high")})
    return form


# ---- plain values --------------------------------------------------------------------------------
def motion_figures(found: Plan) -> dict[str, float]:
    """What the exported script says of a plan, too (:func:`with_unit` has its words)."""
    figures = {
        "duration": found.duration,
        "objective": found.objective,
        "replay_error": found.replay_error,
    }
    for v in (*found.plant.states, *found.plant.inputs):
        figures[f"max({v.name})"] = float(found.trajectory[v.name].max())
    return figures


def with_unit(plant: Plant, name: str, value: float) -> str:
    """A figure of a motion of this plant, as it is shown."""
    if name == "duration":
        return f"{1e3 * value:.5g} ms"
    if name.startswith("max("):
        return plant.variable(name[4:-1]).shown(value)
    return f"{value:.4g}"


def _told(found: Plan, motion: Mapping[str, Any]) -> dict[str, Any]:
    assert found.replay is not None  # of a plan that succeeded
    drawn = found.replay.trajectory
    every = max(1, len(drawn.t) // SAMPLES)
    rows = np.unique([*range(0, len(drawn.t), every), len(drawn.t) - 1])
    panels = [
        {"unit": drawn.variable(names[0]).display_unit, "names": names}
        for names in panels_of(found).values()
    ]
    names = [n for panel in panels for n in panel["names"]]
    active = _active(found)
    return {
        "ok": True,
        "t": numbers(drawn.t[rows]),
        "columns": {n: numbers(drawn[n][rows] / drawn.variable(n).display_factor) for n in names},
        "position": numbers(drawn[motion["variable"]][rows]),
        "panels": panels,
        "stop_times": _stop_times(found),
        "duration": found.duration,
        "objective": found.objective,
        "verified": found.verified,
        "verdict": str(found.verdict),
        "active": active,
        "seconds": float(found.statistics["seconds"]),
    }


def _stop_times(found: Plan) -> list[float]:
    """When the motion arrives at each stop; at the end, back at the first one of a cycle."""
    legs = found._problem.legs if found._problem else ()
    times, now = [0.0], 0.0
    for leg, duration in zip(legs, found.durations, strict=False):
        now += duration
        if not leg.dwell:
            times.append(now)
    return times


def _active(found: Plan) -> list[dict[str, Any]]:
    """Limits that the motion touches: label, and the spans of time."""
    spans: dict[str, list[list[float]]] = {}
    for limit in limits_along(found):
        at = np.flatnonzero(limit.active)
        if not at.size:
            continue
        for run in np.split(at, np.flatnonzero(np.diff(at) > 1) + 1):
            spans.setdefault(limit.label, []).append(
                [float(limit.t[run[0]]), float(limit.t[run[-1]])]
            )
    return [{"label": label, "spans": each} for label, each in spans.items()]


def _failed(error: PlanError) -> dict[str, Any]:
    """Why there is no plan, and what is in conflict where."""
    conflicts = [str(c) for c in getattr(error.plan, "conflicts", ())]
    told = [{"words": words, "stop": _place(words)} for words in conflicts]
    return {"ok": False, "problem": str(error), "conflicts": told}


def _place(words: str) -> int | None:
    """The number (from 0) of the stop that these words name."""
    found = re.search(r"\bstop (\d+)", words)
    return int(found[1]) - 1 if found else None


def _film(found: Plan) -> dict[str, Any] | None:
    """The plant along the motion, at moments in ms."""
    assert found.replay is not None
    plant, motion = found.plant, found.replay.trajectory.at(np.linspace(0, found.duration, FRAMES))
    x, u = (motion.array([v.name for v in each]).T for each in (plant.states, plant.inputs))
    return scene_of(plant, 1e3 * motion.t, x, u)


# ---- records -------------------------------------------------------------------------------------
@job("Compare {}", warm="plan")
def replayed(
    say: Say, world: World, motion: Mapping[str, Any], item: Mapping[str, Any]
) -> dict[str, Any]:
    """A plan beside a record of the same motion: how far the record is from it, by variable.

    The record's first sample is the motion's beginning. Raises InputError where they share no
    column, or overlap in less than two samples.
    """
    record = records_of(world, item)[0]
    found = plan_of(world, motion)
    assert found.replay is not None
    return _compared(found.replay.trajectory, record, str(item["name"]))


def _compared(planned_motion: Trajectory, record: Trajectory, name: str) -> dict[str, Any]:
    shared = [n for n in planned_motion.names if n in record]
    if not shared:
        raise InputError(
            f"{name} has no column of this plan; its columns are {', '.join(record.names)}, the "
            f"plan's {', '.join(planned_motion.names)}"
        )
    begun = record.t - record.t[0]
    inside: Sequence[int] = np.flatnonzero(begun <= planned_motion.t[-1] * (1 + 1e-9)).tolist()
    if len(inside) < 2:
        raise InputError(f"{name} has fewer than two samples within the plan's duration")
    at = np.minimum(begun[inside], planned_motion.t[-1])
    columns = {n: record[n][inside] for n in shared}
    seen = Trajectory(at, columns, [record.variable(n) for n in shared])
    every, rows, curves = max(1, len(at) // 1000), [], {}
    for found in planned_motion.at(at).compare(seen).deviations:
        variable = found.variable
        factor = variable.display_factor
        figures = {"largest": found.largest / factor, "rms": found.rms / factor}
        rows.append({"name": variable.name, "unit": variable.display_unit, **figures})
        shown = numbers(seen[variable.name][::every] / factor)
        curves[variable.name] = {"t": numbers(at[::every]), "y": shown}
    return {"name": name, "rows": rows, "curves": curves}

"""What was done on the page as a study file for ``pam-ocp study``: the same steps in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from ..judge.statement import Stop
from ..plants.plant import Plant
from ..studies.steps.measured import TableStep
from .jobs.control import law_arguments
from .jobs.export import STEPS, TOLERANCE
from .made import World, muscle_of, plant_of, point_of
from .script import (
    METHODS,
    arguments,
    can_be_pushed,
    exports_of,
    platforms_of,
    pushed,
    run_keywords,
)

MUSCLE_FILE = "muscle.toml"
"""Beside the study, where no step makes the muscle."""
READ = [k for k in TableStep.keys if k not in ("file", "without")]
"""What a step of kind "table" may be told of the reading."""
State = Mapping[str, Any]
Steps = dict[str, Any]


def study_of(world: World, title: str = "") -> str:
    """The study file: table, fit, plant, linear model, plans, controllers' runs and exports.

    Files are named as in the session's folder ("files/..."); a muscle with coefficients moved by
    hand is MUSCLE_FILE beside it. A plant of the user's own runs with ``--allow-code`` only.
    """
    state, steps = world.state, Steps()
    muscle = _muscle(state["muscle"], steps)
    if muscle is not None:
        steps["plant"] = {"kind": "plant", **_plant(state["plant"]), "muscle": muscle}
        if state["point"]:
            steps["linear"] = {"kind": "linearize", "plant": "plant", "rest": state["point"]}
        for motion in state["motions"]:
            steps[motion["id"]] = {"kind": "plan", "plant": "plant", **_plan(motion)}
        if state["point"] and state["controllers"]:
            steps |= _controllers(world, plant_of(world), muscle)
        for said in exports_of(state):
            steps |= _exported(said, state)
    content = {"title": title or "A session of pam-ocp bench", "steps": steps}
    return tomli_w.dumps(content)


def _plant(said: State) -> dict[str, Any]:
    name = str(said["arrangement"])
    return {**said, "arrangement": f"files/{name}" if ":" in name else name}


# ---- controllers ---------------------------------------------------------------------------------
def _controllers(world: World, plant: Plant, muscle: str) -> Steps:
    """Each controller, and its run against the plant that can be pushed."""
    state, steps = world.state, Steps()
    against = "plant"
    if can_be_pushed(state["plant"]):
        side, against = _plant(pushed(state["plant"])), "side"
        steps["side"] = {"kind": "plant", **side, "muscle": muscle}
    for said in state["controllers"]:
        law = steps[f"{said['id']}-law"] = {"kind": "controller", "plant": "plant"}
        if said["kind"] != "mpc":
            law["rest"] = state["point"]
        law["controller"] = {"kind": said["kind"], **law_arguments(plant, said)}
        steps[said["id"]] = _run(world, plant, said, against)
    return steps


def _run(world: World, plant: Plant, said: State, against: str) -> dict[str, Any]:
    position = next(iter(plant.positions))
    step: dict[str, Any] = {"kind": "loop", "plant": "plant", "controller": f"{said['id']}-law"}
    step |= {"against": against, "start": world.state["point"]}
    wanted = point_of(world, plant)[position] + said["study"]["step"]
    keywords = run_keywords(said, position, wanted).items()
    step |= {name: value for name, value in keywords if value is not None}
    return {**step, "estimator": {"kind": "none"}}


# ---- exports -------------------------------------------------------------------------------------
def _exported(said: State, state: State) -> Steps:
    """An export, with its check where there is one."""
    id, kind, motion = said["id"], said["kind"], said["motion"]
    if kind == "c":
        return {id: {"kind": "export-c", "controller": f"{said['controller']}-law"}}
    chosen, size = platforms_of(said), {"step_size": said["step_size"]}
    unit = {"plant": "plant", **({"platforms": chosen} if chosen else {})}
    if kind == "ssp":
        return {id: {"kind": "export-ssp", **unit, "motion": motion, **size}}
    steps: Steps = {id: {"kind": "export", **unit, "fmi": said["fmi"], **size}}
    check = {"kind": "check", "fmu": id, "tolerance": TOLERANCE}
    if motion:
        check["against"] = motion
    elif state["point"]:
        rest = check["against"] = f"{id}-rest"
        duration = STEPS * said["step_size"]
        steps[rest] = {"kind": "simulate", "plant": "plant", "rest": state["point"]}
        steps[rest] |= {"duration": duration, "samples": STEPS + 1}
    return {**steps, f"{id}-check": check}


# ---- the muscle ----------------------------------------------------------------------------------
def needs_muscle_file(state: Mapping[str, Any]) -> bool:
    """Whether the muscle must lie beside the study."""
    said = state["muscle"]
    return said is not None and said["kind"] == "fit" and bool(said.get("moved"))


def save_muscle_file(world: World) -> Path:
    """The muscle of the session, to lie beside its study."""
    from ..muscles.muscle_file import save_muscle

    return save_muscle(muscle_of(world), world.exported(MUSCLE_FILE))


def _muscle(said: Mapping[str, Any] | None, steps: dict[str, Any]) -> str | None:
    """What the plant's muscle is: a step, or a file."""
    if said is None:
        return None
    if said["kind"] == "file":
        return f"files/{said['file']}"
    if said["kind"] == "catalogue":
        length = said.get("rest_length")
        steps["muscle"] = {"kind": "muscle", "name": said["name"]}
        if length is not None:
            steps["muscle"]["rest_length"] = length
        return "muscle"
    if said.get("moved"):
        return MUSCLE_FILE
    table = said["table"]
    source = table["bundled"] if "bundled" in table else f"files/{table['file']}"
    read = {k: v for k, v in table["said"].items() if k in READ and v is not None}
    off = {"without": sorted(table["off"])} if table.get("off") else {}
    steps["table"] = {"kind": "table", "file": source, **read, **off}
    steps["fit"] = {"kind": "fit", "table": "table", "law": said["law"]}
    for name in ("rest_length", "diameter", "fixed", "name"):
        if said.get(name):
            steps["fit"][name] = said[name]
    return "fit"


def _plan(motion: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of a step of kind "plan"."""
    said = arguments(motion)
    stops = []
    for stop in said.pop("stops"):
        if not isinstance(stop, Stop):
            stops.append(dict(stop))
            continue
        more = {} if stop.rest is None else {"rest": stop.rest}
        stops.append({**stop.values, **more, **({"dwell": stop.dwell} if stop.dwell else {})})
    found = {**said, "stops": stops}
    if "duration" in found:
        found["duration"] = ["free" if d is None else d for d in found["duration"]]
    if "bounds" in found:
        sides = {n: dict(zip(("min", "max"), b, strict=True)) for n, b in found["bounds"].items()}
        found["bounds"] = {
            n: {k: v for k, v in b.items() if v is not None} for n, b in sides.items()
        }
    method = METHODS[motion["method"]][1]
    if method is not None:
        kind = type(method).__name__
        found["method"] = {"kind": kind, "intervals": method.intervals}
    return found

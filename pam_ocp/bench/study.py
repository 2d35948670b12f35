"""What was done on the page as a study file for ``pam-ocp study``: made of the state alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from ..planning.problem.wording import Stop
from .jobs.export import TOLERANCE
from .jobs.motion import METHODS, arguments
from .made import muscle_of

__all__ = ["study_of"]

MUSCLE_FILE = "muscle.toml"
"""Beside the study, where no step makes the muscle."""
READ = ("rest_length", "ambient_pressure", "ramp", "sheet", "units", "columns", "pivot")
"""What a step of kind "table" may be told."""


def study_of(state: Mapping[str, Any], title: str = "") -> str:
    """The study file: table, fit, plant, linear model, plans and FMUs as steps.

    Files are named as in the session's folder ("files/..."); a muscle with coefficients moved by
    hand is MUSCLE_FILE beside it. Controllers' runs are left out: the script has them.
    """
    steps: dict[str, Any] = {}
    muscle = _muscle(state["muscle"], steps)
    if muscle is not None and ":" not in state["plant"]["arrangement"]:
        steps["plant"] = {"kind": "plant", **state["plant"], "muscle": muscle}
        if state["point"]:
            steps["linear"] = {"kind": "linearize", "plant": "plant", "rest": state["point"]}
        for motion in state["motions"]:
            steps[motion["id"]] = {"kind": "plan", "plant": "plant", **_plan(motion)}
        for said in state["exports"]:
            if said["kind"] == "fmu":
                step = {"kind": "export", "plant": "plant", "fmi": said["fmi"]}
                steps[said["id"]] = {**step, "platforms": ["native"]}
                check = {"kind": "check", "fmu": said["id"], "tolerance": TOLERANCE}
                if said["motion"]:
                    check["against"] = said["motion"]
                steps[f"{said['id']}-check"] = check
    content = {"title": title or "A session of pam-ocp bench", "steps": steps}
    return tomli_w.dumps(content)


def needs_muscle_file(state: Mapping[str, Any]) -> bool:
    """Whether the muscle must lie beside the study."""
    said = state["muscle"]
    return said is not None and said["kind"] == "fit" and bool(said.get("moved"))


def save_muscle_file(folder: Path, state: Mapping[str, Any]) -> Path:
    """The muscle of the session, to lie beside its study."""
    from ..muscles.muscle_file import save_muscle

    there = folder / "exports"
    there.mkdir(exist_ok=True)
    return save_muscle(muscle_of(folder, state), there / MUSCLE_FILE)


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
    steps["table"] = {"kind": "table", "file": source, **read}
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

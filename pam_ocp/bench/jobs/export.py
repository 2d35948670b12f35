"""What leaves the page: FMU, SSP, C code, a report, and the check that the script says the same."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import sys
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError, PamError
from ...core.files import atomic_path
from ...core.processes import Processes
from ...core.stop import deadline
from ...core.trajectory import Trajectory
from ...export.c_code.package import export_c
from ...export.check import FmuCheck, check_fmu
from ...export.package import export_fmu
from ...export.ssp import export_ssp
from ...figures.report import write_report
from ...operating.linear import equilibrium
from ...simulation.simulator import simulate
from ...studies.from_table import quick
from ..made import muscle_of, plant_of, source_of, table_of
from ..script import figures_said, platforms_of
from ..session import safe_name
from ..work import Say
from .control import controller_of, loop_figures, loop_of
from .motion import motion_figures, plan_of

__all__ = [
    "AGREES",
    "c_code",
    "fmu",
    "fresh_figures",
    "one_page",
    "report",
    "same",
    "script_checked",
    "ssp",
]

AGREES = 1e-9
"""Relative difference to which the script's figures are the page's."""
TOLERANCE = 1e-3
"""Of the check of an FMU, scaled by nominals."""
STEPS = 200
"""Communication steps of a motion from the operating point that an FMU is compared with."""

LONGEST = 3600.0
"""[s] that the script may take."""

State = Mapping[str, Any]


def _place(folder: Path, name: str) -> Path:
    there = folder / "exports"
    there.mkdir(exist_ok=True)
    return there / name


def _member(state: State, part: str, id: str) -> Mapping[str, Any]:
    found = next((m for m in state[part] if m["id"] == id), None)
    if found is None:
        raise InputError(f"{id!r} is not among the {part} of this session")
    return dict(found)


# ---- FMU, SSP, C ---------------------------------------------------------------------------------
def fmu(say: Say, folder: Path, state: State, said: State, allow_code: bool) -> dict[str, Any]:
    """The plant as an FMU, compared with a motion of the session, or rest at the operating point.

    said : {"id", "fmi", "step_size" [s], "platforms": key of PLATFORMS, "motion": id or ""}.
    """
    say(0.1, "writing and compiling")
    plant = plant_of(folder, state, allow_code=allow_code)
    path = export_fmu(
        plant,
        _place(folder, f"{said['id']}.fmu"),
        fmi=said["fmi"],
        platforms=platforms_of(said),
        step_size=said["step_size"],
    )
    say(0.6, "running it")
    against = _motion(folder, state, said, allow_code)
    check = check_fmu(path, against=against, tolerance=TOLERANCE)
    return {
        "file": path.name,
        "size": path.stat().st_size,
        "ok": check.ok,
        "words": str(check),
        "figures": check_figures(check),
    }


def check_figures(check: FmuCheck) -> dict[str, float]:
    """What the exported script says of a check, too."""
    return {"ok": float(check.ok), "largest": check.largest}


def _motion(folder: Path, state: State, said: State, allow_code: bool) -> Trajectory | None:
    if said["motion"]:
        motion = _member(state, "motions", said["motion"])
        return plan_of(folder, state, motion, allow_code).trajectory
    if not state["point"]:
        return None
    plant = plant_of(folder, state, allow_code=allow_code)
    at = equilibrium(plant, state["point"])
    return simulate(plant, start=at, duration=STEPS * said["step_size"])


def ssp(say: Say, folder: Path, state: State, said: State, allow_code: bool) -> dict[str, Any]:
    """The plant and a motion that plays its inputs, connected. said : {"id", "motion": id, ...}."""
    if not said["motion"]:
        raise InputError("an SSP connects the plant with a motion: plan one in the tab Motion")
    say(0.2, "writing and compiling")
    plant = plant_of(folder, state, allow_code=allow_code)
    found = plan_of(folder, state, _member(state, "motions", said["motion"]), allow_code)
    wires = {f"plant.{v.name}": f"motion.{v.name}" for v in plant.inputs}
    path = export_ssp(
        {"plant": plant, "motion": found.trajectory},
        wires,
        _place(folder, f"{said['id']}.ssp"),
        step_size=said["step_size"],
        stop_time=found.duration,
        platforms=platforms_of(said),
    )
    return {"file": path.name, "size": path.stat().st_size, "ok": True, "words": str(path.name)}


def c_code(say: Say, folder: Path, state: State, said: State, allow_code: bool) -> dict[str, Any]:
    """A controller as C, zipped. said : {"id", "controller": id}."""
    controller = _member(state, "controllers", said["controller"])
    plant = plant_of(folder, state, allow_code=allow_code)
    made = controller_of(plant, equilibrium(plant, state["point"]), controller)
    target = _place(folder, f"{said['id']}.zip")
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as temporary:
        whole = Path(export_c(made, Path(temporary) / "c"))
        with (
            atomic_path(target) as fresh,
            zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as packed,
        ):
            for file in sorted(whole.rglob("*")):
                if file.is_file():
                    packed.write(file, file.relative_to(whole).as_posix())
    return {"file": target.name, "size": target.stat().st_size, "ok": True, "words": target.name}


# ---- the report ----------------------------------------------------------------------------------
def report(say: Say, folder: Path, state: State, title: str, allow_code: bool) -> dict[str, Any]:
    """All that the session holds as one HTML file."""
    things: dict[str, Any] = {}
    muscle = muscle_of(folder, state)
    sources = []
    if state["muscle"]["kind"] == "fit":
        item = state["muscle"]["table"]
        things["Measured table"] = table_of(folder, item)
        if "file" in item:
            sources.append(source_of(folder, item))
    things["Muscle"] = muscle
    plant = plant_of(folder, state, allow_code=allow_code)
    things["Plant"] = plant
    if state["point"]:
        things["Operating point"] = equilibrium(plant, state["point"])
    for i, motion in enumerate(state["motions"]):
        say(i / (len(state["motions"]) + 1), motion["name"])
        things[motion["name"]] = plan_of(folder, state, motion, allow_code)
    for said in state["controllers"] if state["point"] else ():
        things[f"Run of {said['name']}"] = loop_of(folder, state, said, allow_code).trajectory
    shown = {k: v for k, v in things.items() if hasattr(v, "_repr_html_")}
    path = write_report(
        _place(folder, "report.html"),
        shown,
        title=title or "Session of pam-ocp bench",
        sources=sources,
    )
    return {"file": path.name, "size": path.stat().st_size, "ok": True, "words": path.name}


def one_page(say: Say, folder: Path, item: Mapping[str, Any]) -> dict[str, Any]:
    """The whole chain from a table at its defaults (:func:`pam_ocp.studies.quick`), as one .zip."""
    say(None, "laws, motion, linearisation, FMU, report")
    with tempfile.TemporaryDirectory() as place:
        made = quick(table_of(folder, item), place)
        stem = safe_name(Path(item["name"]).stem)
        path = _place(folder, f"{stem}.zip")
        with atomic_path(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in made.files.values():
                archive.write(file, f"{stem}/{file.name}")
        words = made.report().partition("\n\nWritten:")[0]
    return {"file": path.name, "words": words}


# ---- the script ----------------------------------------------------------------------------------
def fresh_figures(state: State) -> dict[str, float]:
    """Figures that the page has shown, of what has not changed since (views, "figures")."""
    kept = state["views"].get("figures", {})
    found: dict[str, float] = {}
    for motion in state["motions"]:
        said = {k: v for k, v in motion.items() if k != "name"}
        key = [state["muscle"], state["plant"], said]
        found |= _kept(kept, motion["id"], key)
    for said in state["controllers"]:
        key = [{k: state[k] for k in ("plant", "muscle", "point")}, said]
        found |= _kept(kept, said["id"], key)
    for said in state["exports"]:
        found |= _kept(kept, said["id"], None)
    return found


def _kept(kept: State, id: str, key: Any) -> dict[str, float]:
    one = kept.get(id)
    if one is None or (key is not None and one["of"] != json.loads(json.dumps(key))):
        return {}
    return {f"{id}.{name}": value for name, value in one["values"].items()}


def _figures(folder: Path, state: State, allow_code: bool) -> dict[str, float]:
    """Figures of the session, made here by the functions that the page calls."""
    found: dict[str, float] = {}
    muscle = state["muscle"]
    if muscle is not None and muscle["kind"] == "fit":
        fitted = muscle.get("fitted", muscle["coefficients"])
        found |= {f"fit.{n}": v for n, v in fitted.items()}
    if muscle is None:
        return found
    plant = plant_of(folder, state, allow_code=allow_code)
    if state["point"]:
        at = equilibrium(plant, state["point"])
        found |= {f"point.{v.name}": at[v.name] for v in (*plant.states, *plant.inputs)}
    for motion in state["motions"]:
        figures = motion_figures(plan_of(folder, state, motion, allow_code))
        found |= {f"{motion['id']}.{n}": v for n, v in figures.items()}
    for said in state["controllers"] if state["point"] else ():
        figures = loop_figures(
            loop_of(folder, state, said, allow_code), next(iter(plant.positions))
        )
        found |= {f"{said['id']}.{n}": v for n, v in figures.items()}
    return found


def script_checked(
    say: Say, folder: Path, state: State, script: str, allow_code: bool
) -> dict[str, Any]:
    """Run the script in a fresh process and hold its figures against the page's."""
    say(0.1, "the page's figures")
    page = {**_figures(folder, state, allow_code), **fresh_figures(state)}
    say(0.5, "the script, in a process of its own")
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as temporary:
        place = Path(temporary)
        shutil.copytree(folder / "files", place / "files")
        (place / "session.py").write_text(script, encoding="utf-8")
        own = str(Path(__file__).resolve().parents[3])
        paths = os.pathsep.join(p for p in (own, os.environ.get("PYTHONPATH", "")) if p)
        ran = Processes().run(
            [sys.executable, "session.py"],
            place,
            {**os.environ, "PYTHONPATH": paths},
            min(deadline().remaining(), LONGEST),
        )
    if ran.returncode:
        last = (ran.stderr.strip().splitlines() or ["no word"])[-1]
        raise PamError(f"the script ended with: {re.sub(r'^[a-z_.]*exceptions[.]', '', last)}")
    said = figures_said(ran.stdout)
    rows = [
        {
            "name": name,
            "page": page.get(name),
            "script": said.get(name),
            "ok": name in page and name in said and same(page[name], said[name]),
        }
        for name in dict.fromkeys([*page, *said])
    ]
    return {"rows": rows, "ok": bool(rows) and all(row["ok"] for row in rows)}


def same(a: float, b: float) -> bool:
    """To :data:`AGREES`, relative."""
    return (math.isnan(a) and math.isnan(b)) or bool(np.isclose(a, b, rtol=AGREES, atol=1e-12))

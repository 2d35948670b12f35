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
from collections.abc import Container, Mapping
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError, PamError
from ...core.files import atomic_path
from ...core.processes import Processes
from ...core.stop import deadline
from ...core.trajectory import Trajectory
from ...export.c_code.package import export_c
from ...export.check import check_fmu
from ...export.package import export_fmu
from ...export.ssp import export_ssp
from ...figures.report import write_report
from ...simulation.simulator import simulate
from ...studies.from_table import quick
from ..made import (
    World,
    is_of_now,
    made_of_export,
    made_of_loop,
    made_of_plan,
    muscle_of,
    plant_of,
    point_of,
    source_of,
    table_of,
)
from ..script import figures_said, platforms_of
from ..session import safe_name
from ..work import Say, job
from .control import controller_of, loop_figures, loop_of
from .motion import motion_figures, plan_of
from .muscle import fit_of

AGREES = 1e-9
"""Relative difference to which the script's figures are the page's."""
TOLERANCE = 1e-3
"""Of the check of an FMU, scaled by nominals."""
STEPS = 200
"""Communication steps of a motion from the operating point that an FMU is compared with."""

LONGEST = 3600.0
"""[s] that the script may take."""

State = Mapping[str, Any]


# ---- FMU, SSP, C ---------------------------------------------------------------------------------
@job("Export FMU", warm="plan")
def fmu(say: Say, world: World, said: State) -> dict[str, Any]:
    """The plant as an FMU, compared with a motion of the session, or rest at the operating point.

    said : {"id", "fmi", "step_size" [s], "platforms": key of PLATFORMS, "motion": id or ""}.
    """
    say(0.1, "writing and compiling")
    plant = plant_of(world)
    path = export_fmu(
        plant,
        world.exported(f"{said['id']}.fmu"),
        fmi=said["fmi"],
        platforms=platforms_of(said),
        step_size=said["step_size"],
    )
    say(0.6, "running it")
    against = _motion(world, said)
    check = check_fmu(path, against=against, tolerance=TOLERANCE)
    figures = {"ok": float(check.ok), "largest": check.largest}  # as the exported script has them
    return _made(path, ok=check.ok, words=str(check), figures=figures)


def _made(path: Path, **more: Any) -> dict[str, Any]:
    """What the tab is told of a file."""
    return {"file": path.name, "size": path.stat().st_size, "ok": True, **more}


def _motion(world: World, said: State) -> Trajectory | None:
    if said["motion"]:
        return plan_of(world, world.member("motions", said["motion"])).trajectory
    if not world.state["point"]:
        return None
    plant = plant_of(world)
    return simulate(plant, start=point_of(world, plant), duration=STEPS * said["step_size"])


@job("Export SSP", warm="plan")
def ssp(say: Say, world: World, said: State) -> dict[str, Any]:
    """The plant and a motion that plays its inputs, connected. said : {"id", "motion": id, ...}."""
    if not said["motion"]:
        raise InputError("an SSP connects the plant with a motion: plan one in the tab Motion")
    say(0.2, "writing and compiling")
    plant = plant_of(world)
    found = plan_of(world, world.member("motions", said["motion"]))
    wires = {f"plant.{v.name}": f"motion.{v.name}" for v in plant.inputs}
    path = export_ssp(
        {"plant": plant, "motion": found.trajectory},
        wires,
        world.exported(f"{said['id']}.ssp"),
        step_size=said["step_size"],
        stop_time=found.duration,
        platforms=platforms_of(said),
    )
    return _made(path)


@job("Export C", warm="plan")
def c_code(say: Say, world: World, said: State) -> dict[str, Any]:
    """A controller as C, zipped. said : {"id", "controller": id}."""
    controller = world.member("controllers", said["controller"])
    plant = plant_of(world)
    made = controller_of(plant, point_of(world, plant), controller)
    target = world.exported(f"{said['id']}.zip")
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as temporary:
        whole = Path(export_c(made, Path(temporary) / "c"))
        files = (file for file in sorted(whole.rglob("*")) if file.is_file())
        _pack(target, {file.relative_to(whole).as_posix(): file for file in files})
    return _made(target)


def _pack(target: Path, files: Mapping[str, Path]) -> None:
    """Files by their names in an archive."""
    with atomic_path(target) as fresh, zipfile.ZipFile(fresh, "w", zipfile.ZIP_DEFLATED) as packed:
        for name, file in files.items():
            packed.write(file, name)


# ---- the report ----------------------------------------------------------------------------------
@job("Report", warm="plan")
def report(say: Say, world: World, title: str) -> dict[str, Any]:
    """All that the session holds as one HTML file."""
    things: dict[str, Any] = {}
    state, muscle = world.state, muscle_of(world)
    sources = []
    if state["muscle"]["kind"] == "fit":
        item = state["muscle"]["table"]
        things["Measured table"] = table_of(world, item)
        things["Fit"] = fit_of(world, state["muscle"])
        if "file" in item:
            sources.append(source_of(world, item))
    things["Muscle"] = muscle
    plant = plant_of(world)
    things["Plant"] = plant
    if state["point"]:
        things["Operating point"] = point_of(world, plant)
    for i, motion in enumerate(state["motions"]):
        say(i / (len(state["motions"]) + 1), motion["name"])
        things[_unlike(motion["name"], things)] = plan_of(world, motion)
    for said in state["controllers"] if state["point"] else ():
        things[_unlike(f"Run of {said['name']}", things)] = loop_of(world, said).trajectory
    shown = {k: v for k, v in things.items() if hasattr(v, "_repr_html_")}
    path = write_report(
        world.exported("report.html"),
        shown,
        title=title or "Session of pam-ocp bench",
        sources=sources,
    )
    return _made(path)


def _unlike(name: str, others: Container[str]) -> str:
    """A heading that no other has: users may give one name twice."""
    numbered = (f"{name} ({i})" for i in count(2))
    return name if name not in others else next(n for n in numbered if n not in others)


@job("One page")
def one_page(say: Say, world: World, item: Mapping[str, Any]) -> dict[str, Any]:
    """The whole chain from a table at its defaults (:func:`pam_ocp.studies.quick`), as one .zip."""
    say(None, "laws, motion, linearisation, FMU, report")
    with tempfile.TemporaryDirectory() as place:
        made = quick(table_of(world, item), place)
        stem = safe_name(Path(item["name"]).stem)
        path = world.exported(f"{stem}.zip")
        _pack(path, {f"{stem}/{file.name}": file for file in made.files.values()})
        words = made.report().partition("\n\nWritten:")[0]
    return {"file": path.name, "words": words}


# ---- the script ----------------------------------------------------------------------------------
def fresh_figures(state: State) -> dict[str, float]:
    """Figures that the page has shown, of what has not changed since (views, "figures")."""
    made = {m["id"]: made_of_plan(state, m) for m in state["motions"]}
    made |= {c["id"]: made_of_loop(state, c) for c in state["controllers"]}
    made |= {e["id"]: made_of_export(state, e) for e in state["exports"]}
    return {
        f"{id}.{name}": value
        for id, shown in state["views"].get("figures", {}).items()
        if id in made and shown["of"] == json.loads(json.dumps(made[id]))
        for name, value in shown["values"].items()
    }


def _figures(world: World) -> dict[str, float]:
    """Figures of the session, made here by the functions that the page calls."""
    state, muscle = world.state, world.state["muscle"]
    if muscle is None:
        return {}
    found: dict[str, dict[str, float]] = {}
    if muscle["kind"] == "fit":
        found["fit"] = muscle.get("fitted", muscle["coefficients"])
    plant = plant_of(world)
    if state["point"]:
        at = point_of(world, plant)
        found["point"] = {v.name: at[v.name] for v in (*plant.states, *plant.inputs)}
    for motion in state["motions"]:
        found[motion["id"]] = motion_figures(plan_of(world, motion))
    for said in state["controllers"] if state["point"] else ():
        position = next(iter(plant.positions))
        found[said["id"]] = loop_figures(loop_of(world, said), position)
    return {f"{id}.{n}": v for id, own in found.items() for n, v in own.items()}


@job("Run the script", warm="plan", time_limit=1800.0)
def script_checked(say: Say, world: World, script: str) -> dict[str, Any]:
    """Run the script in a fresh process and hold its figures against the page's."""
    say(0.1, "the page's figures")
    page = {**_figures(world), **fresh_figures(world.state)}
    say(0.5, "the script, in a process of its own")
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as temporary:
        place = Path(temporary)
        shutil.copytree(world.folder / "files", place / "files")
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
    # the page has no figures of a file that is made of earlier values
    earlier = {e["id"] for e in world.state["exports"] if not is_of_now(world.state, e)}
    rows = [
        {
            "name": name,
            "page": page.get(name),
            "script": said.get(name),
            "ok": name in page and name in said and same(page[name], said[name]),
        }
        for name in dict.fromkeys([*page, *said])
        if name.partition(".")[0] not in earlier
    ]
    return {"rows": rows, "ok": bool(rows) and all(row["ok"] for row in rows)}


def same(a: float, b: float) -> bool:
    """To :data:`AGREES`, relative."""
    return (math.isnan(a) and math.isnan(b)) or bool(np.isclose(a, b, rtol=AGREES, atol=1e-12))

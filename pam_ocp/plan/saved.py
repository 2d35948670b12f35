"""Plans in files: .npz with the samples, the inputs as they ran, and the figures."""

from __future__ import annotations

import json
import zipfile
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files import atomic_path
from ..plant.plant import Plant, require_plant
from ..signals import PiecewisePolynomial
from ..simulate import evaluated, simulate
from .mesh import Form, Interval, Mesh
from .replay import TOLERANCE, Replay
from .result import Plan

__all__ = ["load_plan", "save_plan"]

FORMAT = "pam_ocp plan 1"


def save_plan(plan: Plan, path: str | Path) -> Path:
    """Write a plan; it must have succeeded (PlanError otherwise)."""
    target = Path(path)
    if target.suffix != ".npz":
        raise InputError(f"path = {str(path)!r}: a plan is written as .npz")
    motion, replay = plan.trajectory, plan.replay
    assert motion.signals is not None  # a plan that succeeded has both
    assert replay is not None
    meta = {
        "format": FORMAT,
        "plant": plan.plant.name,
        "states": motion.named("state"),
        "inputs": motion.named("input"),
        "parameters": {v.name: v.start for v in plan.plant.parameters},
        "status": plan.status,
        "objective": plan.objective,
        "durations": plan.durations,
        "design": plan.design,
        "statistics": plan.statistics,
        "violation": [replay.violation, replay.constraint],
        "log": plan.log,
        "meshes": [
            {"form": [m.form.scheme, m.form.control, m.form.guarded],
             "intervals": [astuple(i) for i in m.intervals]}
            for m in plan.meshes
        ],
    }  # fmt: skip
    with atomic_path(target) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file, meta=np.array(json.dumps(meta)), t=motion.t,
            states=motion.array(motion.named("state")), breaks=motion.signals.breaks,
            coefficients=motion.signals.coefficients,
        )  # fmt: skip
    return target


def load_plan(path: str | Path, plant: Plant) -> Plan:
    """Read a plan of ``plant`` and replay it anew, so its error is that of today's plant.

    The plant takes over the parameter values that the plan was made with. Multipliers are not kept:
    ``costates`` and ``sensitivities`` of a loaded plan raise PlanError.

    Raises InputError for a file that is no plan, or a plan of another plant.
    """
    require_plant(plant)
    meta, arrays = _read(Path(path))
    for what, here in (
        ("states", [v.name for v in plant.states]),
        ("inputs", [v.name for v in plant.inputs]),
        ("parameters", {v.name: v.start for v in plant.parameters}),
    ):
        if list(meta[what]) != list(here):
            raise InputError(
                f"{path}: a plan of {meta['plant']!r} with {what} {', '.join(meta[what])}; the plant "
                f"{plant.name!r} has {', '.join(here)}"
            )
    plant = plant.with_values(meta["parameters"])
    signals = PiecewisePolynomial(arrays["breaks"], arrays["coefficients"])
    samples = evaluated(plant, arrays["t"], arrays["states"], signals)
    motion = simulate(plant, samples, rtol=TOLERANCE)
    names = samples.named("state")
    nominal = plant.vector("state", attribute="nominal")
    deviation = np.max(np.abs(motion.array(names) - samples.array(names)) / nominal, axis=0)
    worst = int(np.argmax(deviation))
    violation, constraint = meta["violation"]
    replay = Replay(float(deviation[worst]), names[worst], violation, constraint, motion)
    meshes = tuple(
        Mesh(tuple(Interval(*i) for i in m["intervals"]), Form(*m["form"])) for m in meta["meshes"]
    )
    return Plan(
        plant, True, meta["status"], meta["objective"], tuple(meta["durations"]), meta["design"],
        meta["statistics"], replay, meshes, tuple(meta["log"]), (), samples,
    )  # fmt: skip


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """(meta data, arrays) of a file."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in file.files}
        meta = json.loads(str(arrays.pop("meta")))
    except (ValueError, OSError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"{path} is no plan file: {error}") from None
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        raise InputError(f"{path} is no plan file of this version ({FORMAT})")
    return meta, arrays

"""Closed loops in files: .npz, which are files of their motion too."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..core.files import read_npz, reading, require_format, write_npz
from ..core.trajectory import Trajectory
from ..judge.loop import LoopVerdict
from .mpc_statistics import MpcStatistics, MpcStep

__all__ = ["read_loop", "write_loop"]

FORMAT = "pam_ocp closed loop 1"
PARTS = ("seen", "reference", "estimate")


def write_loop(
    path: str | os.PathLike[str],
    motion: Trajectory,
    parts: dict[str, Trajectory | None],
    statistics: MpcStatistics | None,
    facts: dict[str, Any],
) -> Path:
    """Write a loop: :meth:`Trajectory.load` reads its motion, :func:`read_loop` all of it."""
    content, arrays = motion._packed()
    content |= {"format": FORMAT, "prediction_error": facts["prediction_error"], "parts": {}}
    content["verdict"] = asdict(facts["verdict"])
    content["steps"] = None if statistics is None else [asdict(s) for s in statistics.steps]
    for name, part in parts.items():
        if part is not None:
            content["parts"][name], own = part._packed()
            arrays |= {f"{name}_{key}": array for key, array in own.items()}
    return write_npz(path, content, arrays)


def read_loop(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The arguments of the ClosedLoop that was written. Raises InputError for any other file."""
    kind = "a closed loop"
    content, arrays = read_npz(path, kind)
    require_format(path, content, kind, FORMAT, "ClosedLoop.save() writes one")
    with reading(path, kind, "give one that ClosedLoop.save() wrote"):
        found: dict[str, Any] = dict.fromkeys(PARTS)
        found["trajectory"] = Trajectory._from_meta(content, arrays["t"], arrays["data"])
        for name, part in content["parts"].items():
            data = arrays[f"{name}_t"], arrays[f"{name}_data"]
            found[name] = Trajectory._from_meta(part, *data)
        steps = content["steps"]
        found["statistics"] = steps and MpcStatistics(tuple(MpcStep(**s) for s in steps))
        found["prediction_error"] = content["prediction_error"]
        if "verdict" in content:  # files of 0.2 and before have none
            told = content["verdict"]
            lists = {n: tuple(v) for n, v in told.items() if isinstance(v, list)}
            found["verdict"] = LoopVerdict(**{**told, **lists})
    return found

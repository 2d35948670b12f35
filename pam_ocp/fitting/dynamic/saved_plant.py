"""Dynamic fits in files of JSON, which carry their plant."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...core.files import read_json, reading, write_json
from ...core.stop import verb
from ...core.trajectory import Trajectory
from ...core.variables import data_of_variable, variable_of
from ...plants.plant import Plant, require_plant
from ...plants.plant_data import carried
from ...plants.plant_file import load_plant
from ..statistics import Array, Linearisation
from .plant_fit import PlantFit

__all__ = ["load_plant_fit", "write_plant_fit"]

FORMAT = "pam_ocp plant fit"
_PLAIN = (
    "delay",
    "offsets",
    "gains",
    "noise",
    "descriptions",
    "method",
    "degree",
    "step",
    "inputs",
    "status",
    "iterations",
    "seconds",
    "process_noise",
    "input_noise",
    "interpolation",
    "inputs_ran",
)
_LATER = ("input_noise", "interpolation", "inputs_ran")
"""Not in older files."""
_TUPLES = ("measured", "parameters", "starts", "at_bound")


def write_plant_fit(fit: PlantFit, path: str | os.PathLike[str]) -> Path:
    """See :meth:`PlantFit.save`."""
    linear = fit.linearisation
    content: dict[str, Any] = {
        "format": FORMAT,
        "version": 1,
        "units": "SI",
        "plant": fit.plant.name,
        "values": {v.name: v.start for v in fit.plant.parameters},
        "states": [v.name for v in fit.plant.states],
        "fitted": {n: c.value for n, c in fit.coefficients.items()},
        "stderr": {n: c.stderr for n, c in fit.coefficients.items() if np.isfinite(c.stderr)},
        "rmse": fit.rmse,
        "fit_percent": {n: v if np.isfinite(v) else None for n, v in fit.fit_percent.items()},
        "warnings": list(fit.warnings),
        **{n: _plain(getattr(fit, n)) for n in _PLAIN},
        **{n: _plain(getattr(fit, n)) for n in _TUPLES},
        "linearisation": {
            "names": list(linear.names),
            "values": linear.values.tolist(),
            "units": list(linear.units),
            # what matters of the Jacobian is its triangle: J^T J = R^T R
            "jacobian": _triangle(linear.jacobian).tolist(),
            "scale": float(linear.scale),
            "dof": linear.dof,
            "active": None if linear.active is None else np.asarray(linear.active).tolist(),
        },
        "residuals": [r.tolist() for r in fit.residuals],
        "records": [_record(r, r.names) for r in fit.records],
        "simulated": [_record(r, fit.measured) for r in fit.simulated],
    }
    return write_json(path, content | carried(fit.plant))


@verb
def load_plant_fit(path: str | os.PathLike[str], plant: Plant | None = None) -> PlantFit:
    """Read what :meth:`PlantFit.save` wrote.

    plant : the same plant (any parameter values), on which the fitted values are set; None: the one
        that the file carries.

    Raises InputError for a file that holds no fit, or one of another plant.

    Examples
    --------
    >>> path = dynamic_fit.save("fit.json")
    >>> print(f"{pam.fitting.load_plant_fit(path, plant).values['mass']:.2f} kg")
    10.00 kg
    """
    name = os.fspath(path)
    content = read_json(path, "a fit of a plant", FORMAT, "PlantFit.save() writes one")
    plant = load_plant(path) if plant is None else require_plant(plant)
    with reading(path, "a fit of a plant", "give one that PlantFit.save() wrote"):
        _require_same(name, content, plant)
        linear = dict(content["linearisation"])
        for key in ("values", "jacobian"):
            linear[key] = np.array(linear[key], dtype=float)
        if linear["active"] is not None:
            linear["active"] = np.array(linear["active"], dtype=float)
        arguments: dict[str, Any] = {
            **{n: content[n] for n in _PLAIN if n in content or n not in _LATER},
            **{n: tuple(content[n]) for n in _TUPLES},
            "plant": plant.with_values(content["values"]),
            "records": tuple(_trajectory(r) for r in content["records"]),
            "simulated": tuple(_trajectory(r) for r in content["simulated"]),
            "linearisation": Linearisation(**linear),
            "residuals": tuple(np.array(r, dtype=float) for r in content["residuals"]),
        }
        return PlantFit(**arguments)


def _require_same(name: str, content: Mapping[str, Any], plant: Plant) -> None:
    for kind, saved, own in (
        ("parameters", list(content["values"]), [v.name for v in plant.parameters]),
        ("states", content["states"], [v.name for v in plant.states]),
    ):
        other = [n for n in (*saved, *own) if (n in saved) != (n in own)]
        if other:
            side = "the file" if other[0] in saved else "the plant"
            raise InputError(
                f"{name} is a fit of plant {content['plant']!r}, whose {kind} are others: only "
                f"{side} has {other[0]}; give the plant that was fitted"
            )


def _triangle(jacobian: Array) -> Array:
    """R (k, k) with R^T R = J^T J; J itself when it has fewer rows."""
    return np.asarray(
        np.linalg.qr(jacobian, mode="r") if len(jacobian) > jacobian.shape[1] else jacobian
    )


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (tuple, list)):
        return [_plain(v) for v in value]
    return value.item() if isinstance(value, np.generic) else value


def _record(record: Trajectory, names: Sequence[str]) -> dict[str, Any]:
    return {
        "t": record.t.tolist(),
        "columns": {n: record[n].tolist() for n in names},
        "variables": [data_of_variable(record.variable(n)) for n in names],
        "interpolation": record.interpolation if record.interpolation_known else None,
    }


def _trajectory(content: Mapping[str, Any]) -> Trajectory:
    variables = [variable_of(said) for said in content["variables"]]
    return Trajectory(content["t"], content["columns"], variables, content["interpolation"])

"""Plants in files: variables and equations as data, so that reading one runs no code of others.

Files of plans, motions, closed loops and fits carry their plant this way; every command takes such
a file in place of a plant.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import casadi as ca

from ..core.errors import InputError, with_kinds
from ..core.expressions import operations_of, results_of
from ..core.files import write_json
from ..core.variables import data_of_variable, variable_of
from .dead_time import DeadTime, DelayLine
from .kinds import PLANTS
from .plant import Plant, require_plant

FORMAT = "pam_ocp plant 1"
SYSTEM = "system"
"""Key under which files carry their plant."""


def data_of_plant(plant: Plant) -> dict[str, Any]:
    """A plant as numbers, texts and lists.

    Raises InputError where its equations call a function of the user's, which no file can hold.
    """
    state = plant.__getstate__()
    function: ca.Function = state.pop("function")
    dense = function.factory("equations", function.name_in(), function.name_out())
    sizes = [dense.numel_out(i) for i in range(dense.n_out())]
    return {
        **state,
        "kind": _kind(plant),
        "variables": [data_of_variable(v) for v in state["variables"]],
        "delay_lines": [asdict(line) for line in state["delay_lines"]],
        "openings": [[data_of_variable(v), list(names)] for v, names in state["openings"]],
        "sizes": sizes,
        "operations": operations_of(dense),
    }


def _kind(plant: Plant) -> str:
    """The library's class of a plant, which draws it; "" for others."""
    name = type(plant).__name__
    return name if name in PLANTS and PLANTS[name] is type(plant) else ""


def carried(plant: Plant | None) -> dict[str, Any]:
    """What a file holds in order to carry its plant; nothing for one that no file can hold."""
    if plant is None:
        return {}
    try:
        return {SYSTEM: data_of_plant(plant)}
    except InputError:
        return {}


def plant_of_data(said: Mapping[str, Any]) -> Plant:
    """The plant behind :func:`data_of_plant`.

    Raises InputError, KeyError, TypeError, ValueError or IndexError for what is no plant.
    """

    def equations(*arguments: ca.SX) -> list[ca.SX]:
        columns = results_of(said["operations"], arguments, said["sizes"])
        return [ca.vertcat(ca.SX(0, 1), *column) for column in columns]

    lines = [{**line, "states": tuple(line["states"])} for line in said["delay_lines"]]
    kind: Any = PLANTS[said["kind"]] if said["kind"] else Plant
    plant: Plant = kind.__new__(kind)
    plant.__setstate__(
        {
            **said,
            "function": equations,
            "variables": [variable_of(v) for v in said["variables"]],
            "mirror": {n: (float(sign), image) for n, (sign, image) in said["mirror"].items()},
            "delay_lines": tuple(
                DelayLine(**{**line, "dead_time": DeadTime(**line["dead_time"])}) for line in lines
            ),
            "openings": [(variable_of(v), tuple(names)) for v, names in said["openings"]],
        }
    )
    return plant


@with_kinds
def save_plant(plant: Plant, path: str | os.PathLike[str]) -> Path:
    """Write a plant with its values as .json, which :func:`pam_ocp.plants.load_plant` and all
    commands read.

    Raises InputError for another ending, and for equations that call a function of the user's.

    Examples
    --------
    >>> path = pam.plants.save_plant(slide, "slide.json")
    >>> pam.plants.load_plant(path).name == slide.name
    True
    """
    require_plant(plant)
    if Path(path).suffix.lower() != ".json":
        raise InputError(f"path = {os.fspath(path)!r}: a plant is written as .json")
    return write_json(path, {"format": FORMAT, SYSTEM: data_of_plant(plant)})

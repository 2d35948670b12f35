"""Parameter values in a small file (SSV of SSP 1.0), which sets an FMU without Python."""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..core.errors import InputError, require_flag, require_names, with_kinds
from ..core.files import atomic_path, require_ending
from ..core.variables import Variable
from ..muscles.pneumatic_muscle import Muscle
from ..plants.hanging import HangingLoad
from ..plants.plant import Plant, by_name, require_plant
from . import quantities
from .description import to_text
from .package import with_shared

SPACE = "http://ssp-standard.org/SSP1/SystemStructure"
"""Of SSP 1.0 and 2.0; 2.0 knows the types of FMI 3 (Float64)."""


def parameter_set(
    values: Iterable[tuple[Variable, float]],
    name: str,
    spaces: bool = True,
    version: str = "1.0",
    kind: str = "Real",
) -> ET.Element:
    """ssv:ParameterSet of values [SI]; with its namespaces and units where it is a file's root."""
    pairs = list(values)
    known = {"ssv": f"{SPACE}ParameterValues", "ssc": f"{SPACE}Common"} if spaces else {}
    declared = {f"xmlns:{prefix}": uri for prefix, uri in known.items()}
    group = ET.Element("ssv:ParameterSet", {**declared, "version": version, "name": name})
    parameters = ET.SubElement(group, "ssv:Parameters")
    for variable, value in pairs:
        parameter = ET.SubElement(parameters, "ssv:Parameter", name=variable.name)
        ET.SubElement(parameter, f"ssv:{kind}", value=repr(float(value)), unit=variable.unit)
    if spaces:
        units = ET.SubElement(group, "ssv:Units")
        quantities.add_units(units, [variable for variable, _ in pairs], "ssc:")
    return group


@with_kinds
def save_ssv(
    plant: Plant,
    path: str | os.PathLike[str],
    values: Mapping[str, Any] | None = None,
    *,
    name: str = "parameters",
    share: bool = False,
) -> Path:
    """Write parameter values of a plant as SSV, to be applied to its FMU; returns the path.

    values : {parameter or state: value} [SI, or a text with a unit]; by default all parameters with
        the plant's values. share : as it was exported. Raises InputError, UnknownNameError.

    Examples
    --------
    >>> pam.export.save_ssv(plant, "load.ssv", {"mass": "12 kg"}).name
    'load.ssv'
    """
    require_plant(plant)
    require_flag("share", share)
    given = by_name("values", values)
    plant = with_shared(plant)[0] if share else plant
    if values is None:
        pairs = [(v, v.start or 0.0) for v in plant.parameters]
    else:
        chosen = [(plant.variable(n), v) for n, v in given.items()]
        wrong = [v.name for v, _ in chosen if v.causality not in ("parameter", "state")]
        if wrong:
            raise InputError(f"values: {wrong[0]} is neither a parameter nor a state")
        pairs = [(v, v.check(value)) for v, value in chosen]
    return write_ssv(pairs, path, name)


def write_ssv(
    values: Sequence[tuple[Variable, float]],
    path: str | os.PathLike[str],
    name: str = "parameters",
) -> Path:
    """Write variables with their values [SI] as SSV; returns the path."""
    require_ending(path, ".ssv", "a set of parameters")
    if not values:
        raise InputError("there is no value to write")
    text = to_text(parameter_set(values, name))
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def write_muscle_ssv(
    muscle: Muscle, path: str | os.PathLike[str], names: str | Sequence[str] = "muscle"
) -> Path:
    """Write what a muscle brings into a plant (rest length, coefficients of its force law) as SSV,
    for the muscles of these names in an FMU; returns the path.

    Raises InputError for invalid names.
    """
    chosen = require_names("names", names)
    if not chosen:
        raise InputError("muscles is empty; name those of the plant, such as 'muscle1'")
    constants: list[str] = []

    def noted(constant: str, value: Any) -> Any:
        constants.append(f"muscle.{constant}")
        return value

    muscle.substituted(noted)
    declared = [v for v in HangingLoad(muscle).parameters if v.name in constants]
    pairs = [
        (Variable(f"{name}.{v.name.partition('.')[2]}", "parameter", unit=v.unit), v.start or 0.0)
        for name in chosen
        for v in declared
    ]
    return write_ssv(pairs, path, muscle.name or "muscle")

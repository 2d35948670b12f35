"""Units and types of an FMU or a system: each quantity with its unit and its range, once."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from ..core import units
from ..core.variables import Variable

_NAMES = {
    "1": "Number",
    "Pa": "Pressure",
    "Pa/s": "PressureRate",
    "m": "Length",
    "m/s": "Velocity",
    "m/s2": "Acceleration",
    "m3": "Volume",
    "rad": "Angle",
    "rad/s": "AngularVelocity",
    "rad/s2": "AngularAcceleration",
    "N": "Force",
    "N.m": "Torque",
    "N/m": "Stiffness",
    "N.m/rad": "AngularStiffness",
    "N.s/m": "Damping",
    "N.m.s/rad": "AngularDamping",
    "kg": "Mass",
    "kg.m2": "Inertia",
    "kg/s": "MassFlow",
    "K": "Temperature",
    "s": "Time",
    "W": "Power",
    "J": "Energy",
    "V": "Voltage",
}


@dataclass(frozen=True)
class Type:
    """What the variables of one quantity have in common."""

    unit: str
    display_unit: str
    min: float
    max: float
    codes: str


def _type_of(variable: Variable) -> Type:
    return Type(variable.unit, variable.display_unit, variable.min, variable.max, variable.codes)


def type_names(variables: Iterable[Variable]) -> dict[Type, str]:
    """The types of these variables, each with a name: ``Pressure``, ``Pressure2``, ..."""
    names: dict[Type, str] = {}
    count: dict[str, int] = {}
    for kind in map(_type_of, variables):
        if kind in names:
            continue
        quantity = "Code" if kind.codes else _NAMES.get(kind.unit, f"Quantity[{kind.unit}]")
        count[quantity] = count.get(quantity, 0) + 1
        names[kind] = quantity if count[quantity] == 1 else f"{quantity}{count[quantity]}"
    return names


def declared(variable: Variable, names: Mapping[Type, str]) -> str:
    """The name of the type of a variable."""
    return names[_type_of(variable)]


def range_of(known: Variable | Type) -> dict[str, str]:
    """The attributes displayUnit, min and max, where they say something."""
    found = {} if known.display_unit == known.unit else {"displayUnit": known.display_unit}
    ends = {"min": known.min, "max": known.max}
    return found | {name: repr(float(e)) for name, e in ends.items() if math.isfinite(e)}


def add_types(
    root: ET.Element, names: Mapping[Type, str], fmi: str, number: str = "Float64"
) -> None:
    """TypeDefinitions of FMI 2 or 3. number : what FMI 3 calls numbers."""
    parent = ET.SubElement(root, "TypeDefinitions")
    for kind, name in names.items():
        if kind.codes:
            _add_enumeration(parent, name, kind.codes, fmi)
            continue
        attributes = {"unit": kind.unit}
        if kind.unit in _NAMES and kind.unit != "1":
            attributes["quantity"] = _NAMES[kind.unit]
        attributes |= range_of(kind)
        if fmi == "2.0":
            ET.SubElement(ET.SubElement(parent, "SimpleType", name=name), "Real", attributes)
        else:
            ET.SubElement(parent, f"{number}Type", {"name": name, **attributes})


def _add_enumeration(parent: ET.Element, name: str, codes: str, fmi: str) -> None:
    if fmi == "2.0":
        element = ET.SubElement(ET.SubElement(parent, "SimpleType", name=name), "Enumeration")
    else:
        element = ET.SubElement(parent, "EnumerationType", name=name)
    add_items(element, codes)


def add_items(parent: ET.Element, codes: str, space: str = "") -> None:
    """An Item for each of the codes (see Variable)."""
    for value, code in enumerate(codes.split()):
        ET.SubElement(parent, f"{space}Item", name=code, value=str(value))


def add_units(parent: ET.Element, variables: Iterable[Variable], space: str = "") -> None:
    """A Unit for each unit of the variables; with display units, but not in SSP (a ``space``)."""
    shown: dict[str, set[str]] = {}
    for variable in variables:
        displays = shown.setdefault(variable.unit, set())
        if variable.display_unit != variable.unit:
            displays.add(variable.display_unit)
    for name in sorted(shown):
        unit = units.unit(name)
        element = ET.SubElement(parent, f"{space}Unit", name=name)
        base = {base: str(exponent) for base, exponent in unit.base_exponents.items()}
        if unit.factor != 1.0:
            base["factor"] = repr(unit.factor)
        ET.SubElement(element, f"{space}BaseUnit", base)
        for display in sorted(shown[name]) if not space else ():
            factor = unit.factor / units.unit(display).factor
            ET.SubElement(element, "DisplayUnit", name=display, factor=repr(factor))

"""SystemStructure.ssd and parameter sets (SSV) of SSP 1.0 and 2.0.

Both have the name spaces SSP1; 2.0 knows the types of FMI 3 (Float64).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

from ..core.variables import Variable
from . import quantities

Wire: TypeAlias = tuple[str, str, str, str]
"""Component and variable of the output, component and variable of the input."""

_SPACE = "http://ssp-standard.org/SSP1/SystemStructure"
_NAMESPACES = {
    "ssd": f"{_SPACE}Description",
    "ssc": f"{_SPACE}Common",
    "ssv": f"{_SPACE}ParameterValues",
    "oms": "https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd",
}
_PARAMETER_SET = "initialValues"
_TOLERANCE = "1e-06"
_WIDTH, _GAP, _ROW = 40.0, 30.0, 6.0
"""Of a block in the diagram [mm]; the height of one connector."""


@dataclass(frozen=True)
class Part:
    """A component: its variables, and how its FMU is written to a path."""

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    settable: tuple[Variable, ...]
    """States and parameters with their start values."""
    write: Callable[[Path], Path]
    sample_time: float | None = None
    types: Mapping[str, str] = field(default_factory=dict)
    """Of inputs and outputs that are no numbers: "Boolean", or the codes of an enumeration."""


def parameter_set(
    values: Iterable[tuple[Variable, float]],
    name: str,
    spaces: bool = True,
    version: str = "1.0",
    kind: str = "Real",
) -> ET.Element:
    """ssv:ParameterSet of values [SI]; with its namespaces and units where it is a file's root."""
    pairs = list(values)
    declared = {f"xmlns:{p}": _NAMESPACES[p] for p in ("ssv", "ssc")} if spaces else {}
    group = ET.Element("ssv:ParameterSet", {**declared, "version": version, "name": name})
    parameters = ET.SubElement(group, "ssv:Parameters")
    for variable, value in pairs:
        parameter = ET.SubElement(parameters, "ssv:Parameter", name=variable.name)
        ET.SubElement(parameter, f"ssv:{kind}", value=repr(float(value)), unit=variable.unit)
    if spaces:
        _units(ET.SubElement(group, "ssv:Units"), [variable for variable, _ in pairs])
    return group


def system_structure(
    name: str,
    parts: Mapping[str, Part],
    wires: Iterable[Wire],
    step_size: float,
    stop_time: float,
    version: str = "1.0",
    kind: str = "Real",
) -> ET.Element:
    """The root of SystemStructure.ssd: components side by side, connectors with units.

    version : of SSP. kind : type of all variables, "Float64" in 2.0 for units of FMI 3.

    OMSimulator's command line wants to be told its master; others pass over the annotation.
    """
    spaces = {f"xmlns:{prefix}": uri for prefix, uri in _NAMESPACES.items()}
    root = ET.Element(
        "ssd:SystemStructureDescription", {**spaces, "version": version, "name": name}
    )
    system = ET.SubElement(root, "ssd:System", name=name)
    elements = ET.SubElement(system, "ssd:Elements")
    codes = sorted({t for part in parts.values() for t in part.types.values()} - {"Boolean"})
    names = {text: f"Code{i + 1}" for i, text in enumerate(codes)}
    for place, (key, part) in enumerate(parts.items()):
        _component(elements, key, part, place, (version, kind), names)
    group = ET.SubElement(system, "ssd:Connections")
    for of, source, to, sink in wires:
        ends = {
            "startElement": of,
            "startConnector": source,
            "endElement": to,
            "endConnector": sink,
        }
        ET.SubElement(group, "ssd:Connection", ends)
    _master(system, step_size)
    if names:
        group = ET.SubElement(root, "ssd:Enumerations")
    for text, enumeration in names.items():
        element = ET.SubElement(group, "ssc:Enumeration", name=enumeration)
        quantities.add_items(element, text, "ssc:")
    everything = [
        v for part in parts.values() for v in (*part.inputs, *part.outputs, *part.settable)
    ]
    _units(ET.SubElement(root, "ssd:Units"), everything)
    ET.SubElement(root, "ssd:DefaultExperiment", startTime="0.0", stopTime=repr(float(stop_time)))
    return root


def _units(parent: ET.Element, variables: Iterable[Variable]) -> None:
    quantities.add_units(parent, variables, "ssc:")


def _master(system: ET.Element, step_size: float) -> None:
    annotations = ET.SubElement(system, "ssd:Annotations")
    annotation = ET.SubElement(annotations, "ssc:Annotation", type="org.openmodelica")
    own = ET.SubElement(annotation, "oms:Annotations")
    ET.SubElement(
        ET.SubElement(own, "oms:SimulationInformation"),
        "oms:FixedStepMaster",
        description="oms-ma",
        stepSize=repr(float(step_size)),
        absoluteTolerance=_TOLERANCE,
        relativeTolerance=_TOLERANCE,
    )


def _component(
    parent: ET.Element,
    name: str,
    part: Part,
    place: int,
    form: tuple[str, str],
    codes: Mapping[str, str],
) -> None:
    version, type_ = form
    component = ET.SubElement(
        parent,
        "ssd:Component",
        name=name,
        type="application/x-fmu-sharedlibrary",
        source=f"resources/{name}.fmu",
    )
    connectors = ET.SubElement(component, "ssd:Connectors")
    for kind, side, variables in (("input", 0.0, part.inputs), ("output", 1.0, part.outputs)):
        for i, variable in enumerate(variables):
            connector = ET.SubElement(connectors, "ssd:Connector", name=variable.name, kind=kind)
            own = part.types.get(variable.name)
            if own is None:
                ET.SubElement(connector, f"ssc:{type_}", unit=variable.unit)
            elif own == "Boolean":
                ET.SubElement(connector, "ssc:Boolean")
            else:
                ET.SubElement(connector, "ssc:Enumeration", name=codes[own])
            height = f"{(i + 1) / (len(variables) + 1):.4g}"
            ET.SubElement(connector, "ssd:ConnectorGeometry", x=f"{side:g}", y=height)
    left = place * (_WIDTH + _GAP)
    rows = max(len(part.inputs), len(part.outputs), 2)
    corners = {"x1": left, "y1": 0.0, "x2": left + _WIDTH, "y2": rows * _ROW}
    ET.SubElement(component, "ssd:ElementGeometry", {c: f"{v:g}" for c, v in corners.items()})
    if not part.settable:
        return
    bindings = ET.SubElement(component, "ssd:ParameterBindings")
    values = ET.SubElement(ET.SubElement(bindings, "ssd:ParameterBinding"), "ssd:ParameterValues")
    pairs = [(v, v.start or 0.0) for v in part.settable]
    values.append(parameter_set(pairs, _PARAMETER_SET, False, version, type_))

"""modelDescription.xml and its neighbours, for FMI 2.0 and FMI 3.0."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable

from ..core import units
from .layout import Dependency, Entry, Layout
from .source import MAIN_SOURCE

__all__ = ["GENERATED", "build_description", "model_description", "terminals", "to_text"]

GENERATED = "2000-01-01T00:00:00Z"
"""Every FMU carries this date, so that the same plant gives the same bytes."""

_LOG_CATEGORIES = {
    "logStatusError": "refused calls",
    "logStatusDiscard": "steps and evaluations without a finite result",
    "logStatusWarning": "inputs outside their min and max, each once until the next reset",
    "logSteps": "work of the solver in each communication step",
    "logAll": "all messages",
}


def to_text(root: ET.Element) -> str:
    """An XML document as text, indented."""
    ET.indent(root, "  ")
    body = ET.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'


def model_description(
    layout: Layout,
    fmi: str,
    *,
    identifier: str,
    token: str,
    tolerance: float,
    step_size: float,
    stop_time: float,
    fixed_step: float,
    version: str,
) -> ET.Element:
    """The root element of modelDescription.xml."""
    plant = layout.plant
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": fmi,
            "modelName": plant.name,
            "guid" if fmi == "2.0" else "instantiationToken": token,
            "description": plant.description,
            "version": version,
            "generationTool": f"pam_ocp {version}",
            "generationDateAndTime": GENERATED,
            "variableNamingConvention": "structured",
        },
    )
    if fmi == "2.0":
        root.set("numberOfEventIndicators", "0")
    _interfaces(root, fmi, identifier, fixed_step)
    _units(root, layout)
    categories = ET.SubElement(root, "LogCategories")
    for name, description in _LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", name=name, description=description)
    ET.SubElement(
        root,
        "DefaultExperiment",
        startTime="0.0",
        stopTime=repr(stop_time),
        tolerance=repr(tolerance),
        stepSize=repr(step_size),
    )
    if fmi == "2.0":
        _variables_2(root, layout)
        _structure_2(root, layout)
    else:
        _variables_3(root, layout)
        _structure_3(root, layout)
    return root


# ---- interfaces and units -----------------------------------------------------------------------


def _interfaces(root: ET.Element, fmi: str, identifier: str, fixed_step: float) -> None:
    if fmi == "2.0":
        common = dict.fromkeys(
            ("canGetAndSetFMUstate", "canSerializeFMUstate", "providesDirectionalDerivative"),
            "true",
        )
        exchange = {"completedIntegratorStepNotNeeded": "true"}
        simulation = {
            "canHandleVariableCommunicationStepSize": "true",
            "canInterpolateInputs": "true",
            "maxOutputDerivativeOrder": "1",
        }
    else:
        common = dict.fromkeys(
            (
                "canGetAndSetFMUState",
                "canSerializeFMUState",
                "providesDirectionalDerivatives",
                "providesAdjointDerivatives",
            ),
            "true",
        )
        exchange = {}
        simulation = {
            "canHandleVariableCommunicationStepSize": "true",
            "maxOutputDerivativeOrder": "1",
            "providesIntermediateUpdate": "true",
            "canReturnEarlyAfterIntermediateUpdate": "true",
        }
        if fixed_step > 0:
            simulation = {
                "canHandleVariableCommunicationStepSize": "true",
                "fixedInternalStepSize": repr(fixed_step),
                "maxOutputDerivativeOrder": "1",
            }
    for name, special in (("ModelExchange", exchange), ("CoSimulation", simulation)):
        element = ET.SubElement(root, name, {"modelIdentifier": identifier, **common, **special})
        if fmi == "2.0":
            files = ET.SubElement(element, "SourceFiles")
            ET.SubElement(files, "File", name=MAIN_SOURCE)


def _units(root: ET.Element, layout: Layout) -> None:
    shown: dict[str, set[str]] = {}
    for entry in layout.entries:
        displays = shown.setdefault(entry.variable.unit, set())
        if entry.variable.display_unit != entry.variable.unit:
            displays.add(entry.variable.display_unit)
    parent = ET.SubElement(root, "UnitDefinitions")
    for name in sorted(shown):
        unit = units.unit(name)
        element = ET.SubElement(parent, "Unit", name=name)
        base = {base: str(exponent) for base, exponent in unit.base_exponents.items()}
        if unit.factor != 1.0:
            base["factor"] = repr(unit.factor)
        ET.SubElement(element, "BaseUnit", base)
        for display in sorted(shown[name]):
            factor = unit.factor / units.unit(display).factor
            ET.SubElement(element, "DisplayUnit", name=display, factor=repr(factor))


# ---- variables ----------------------------------------------------------------------------------


def _causality(entry: Entry) -> dict[str, str]:
    """Causality, variability and initial of a variable, the same in FMI 2 and 3."""
    if entry.role == "time":
        return {"causality": "independent", "variability": "continuous"}
    if entry.role == "parameter":
        variability = "tunable" if entry.variable.tunable else "fixed"
        return {"causality": "parameter", "variability": variability, "initial": "exact"}
    if entry.role == "input":
        return {"causality": "input", "variability": "continuous"}
    return {
        "causality": "output" if entry.is_output else "local",
        "variability": "continuous",
        "initial": "exact" if entry.role == "state" else "calculated",
    }


def _quantity(entry: Entry) -> dict[str, str]:
    """Unit, range, nominal and start value of a variable."""
    variable = entry.variable
    attributes = {"unit": variable.unit}
    if variable.display_unit != variable.unit:
        attributes["displayUnit"] = variable.display_unit
    if entry.role == "time":
        return attributes
    for name in ("min", "max", "nominal"):
        if math.isfinite(getattr(variable, name)):
            attributes[name] = repr(float(getattr(variable, name)))
    if entry.role in ("state", "input", "parameter"):
        attributes["start"] = repr(float(variable.start or 0.0))
    return attributes


def _head(entry: Entry) -> dict[str, str]:
    head = {"name": entry.name, "valueReference": str(entry.reference)}
    if entry.variable.description:
        head["description"] = entry.variable.description
    return head | _causality(entry)


def _variables_2(root: ET.Element, layout: Layout) -> None:
    """Without time, which FMI 2 does not ask for and FMI Library complains about."""
    parent = ET.SubElement(root, "ModelVariables")
    for entry in layout.entries[1:]:
        real = _quantity(entry)
        if entry.role == "derivative":
            real["derivative"] = str(entry.reference - len(layout.of("state")))
        ET.SubElement(ET.SubElement(parent, "ScalarVariable", _head(entry)), "Real", real)


def _variables_3(root: ET.Element, layout: Layout) -> None:
    parent = ET.SubElement(root, "ModelVariables")
    for entry in layout.entries:
        attributes = _head(entry) | _quantity(entry)
        if entry.role == "derivative":
            attributes["derivative"] = str(entry.reference - len(layout.of("state")))
        ET.SubElement(parent, "Float64", attributes)


# ---- model structure ----------------------------------------------------------------------------


def _outputs(layout: Layout) -> list[tuple[int, tuple[Dependency, ...]]]:
    itself: tuple[Dependency, ...]
    found = []
    for entry in layout.outputs:
        itself = ((entry.reference, "constant"),)
        known = itself if entry.role == "state" else layout.dependencies[entry.reference]
        found.append((entry.reference, known))
    return found


def _derivatives(layout: Layout) -> list[tuple[int, tuple[Dependency, ...]]]:
    return [(e.reference, layout.dependencies[e.reference]) for e in layout.of("derivative")]


def _initial(layout: Layout) -> list[tuple[int, tuple[Dependency, ...]]]:
    return [
        (e.reference, layout.initial_dependencies[e.reference])
        for e in layout.entries
        if e.role == "derivative" or (e.role == "output" and e.is_output)
    ]


def _dependency_attributes(known: Iterable[Dependency]) -> dict[str, str]:
    pairs = list(known)
    return {
        "dependencies": " ".join(str(reference) for reference, _ in pairs),
        "dependenciesKind": " ".join(kind for _, kind in pairs),
    }


def _structure_2(root: ET.Element, layout: Layout) -> None:
    """FMI 2 counts variables from 1 in the order of the file: the index is our reference."""
    parent = ET.SubElement(root, "ModelStructure")
    for name, unknowns in (
        ("Outputs", _outputs(layout)),
        ("Derivatives", _derivatives(layout)),
        ("InitialUnknowns", _initial(layout)),
    ):
        group = ET.SubElement(parent, name)
        for reference, known in unknowns:
            attributes = {"index": str(reference)} | _dependency_attributes(known)
            ET.SubElement(group, "Unknown", attributes)


def _structure_3(root: ET.Element, layout: Layout) -> None:
    parent = ET.SubElement(root, "ModelStructure")
    for name, unknowns in (
        ("Output", _outputs(layout)),
        ("ContinuousStateDerivative", _derivatives(layout)),
        ("InitialUnknown", _initial(layout)),
    ):
        for reference, known in unknowns:
            attributes = {"valueReference": str(reference)} | _dependency_attributes(known)
            ET.SubElement(parent, name, attributes)


# ---- neighbours ---------------------------------------------------------------------------------


def build_description(identifier: str) -> ET.Element:
    """FMI 3's sources/buildDescription.xml: how to compile the sources."""
    root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
    configuration = ET.SubElement(
        root,
        "BuildConfiguration",
        modelIdentifier=identifier,
        description="one translation unit, C11, no library but the mathematical one",
    )
    files = ET.SubElement(configuration, "SourceFileSet", language="C11")
    ET.SubElement(files, "SourceFile", name=MAIN_SOURCE)
    return root


def terminals(layout: Layout) -> ET.Element:
    """terminalsAndIcons.xml: the icon, and one terminal for each part with inputs and outputs.

    A terminal gathers the variables ``part.*`` (a muscle's command, force, ...), and one more all
    inputs and outputs of the whole plant.
    """
    root = ET.Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    drawing = ET.SubElement(root, "GraphicalRepresentation")
    square = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
    ET.SubElement(drawing, "CoordinateSystem", {**square, "suggestedScalingFactorTo_mm": "0.1"})
    ET.SubElement(drawing, "Icon", square)
    groups: dict[str, list[Entry]] = {}
    for entry in layout.entries:
        if entry.is_output or entry.role == "input":
            groups.setdefault(entry.name.rpartition(".")[0] or layout.plant.name, []).append(entry)
    parent = ET.SubElement(root, "Terminals")
    for name, members in groups.items():
        terminal = ET.SubElement(parent, "Terminal", name=name, matchingRule="none")
        for entry in members:
            ET.SubElement(
                terminal,
                "TerminalMemberVariable",
                variableName=entry.name,
                memberName=entry.name.rpartition(".")[2],
                variableKind="signal",
            )
    return root

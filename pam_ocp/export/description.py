"""modelDescription.xml, for FMI 2.0 and FMI 3.0."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping

from . import quantities
from .layout import Dependency, Entry, Layout
from .settings import Settings
from .source import MAIN_SOURCE

GENERATED = "2000-01-01T00:00:00Z"
"""The date of an FMU that is given none, so that the same plant gives the same bytes."""

Types = Mapping[quantities.Type, str]
Unknowns = list[tuple[int, tuple[Dependency, ...]]]
"""Value references of unknowns, and what each depends on."""

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
    layout: Layout, settings: Settings, *, identifier: str, token: str, tool: str
) -> ET.Element:
    """The root element of modelDescription.xml."""
    fmi, about = settings.fmi, dict(settings.about)
    date = about.pop("date", GENERATED)
    root = ET.Element(
        "fmiModelDescription",
        {
            "fmiVersion": fmi,
            "modelName": layout.name,
            "guid" if fmi == "2.0" else "instantiationToken": token,
            "description": layout.description,
            **about,
            "generationTool": tool,
            "generationDateAndTime": date,
            "variableNamingConvention": "structured",
        },
    )
    if fmi == "2.0":
        root.set("numberOfEventIndicators", "0")
    _interfaces(root, fmi, identifier, settings.fixed_step, layout.sample_time)
    variables = [e.variable for e in layout.entries]
    quantities.add_units(ET.SubElement(root, "UnitDefinitions"), variables)
    types = quantities.type_names(variables[1:])
    quantities.add_types(root, types, fmi, "Float32" if layout.single else "Float64")
    categories = ET.SubElement(root, "LogCategories")
    for name, description in _LOG_CATEGORIES.items():
        ET.SubElement(categories, "Category", name=name, description=description)
    ET.SubElement(
        root,
        "DefaultExperiment",
        startTime="0.0",
        stopTime=repr(settings.stop_time),
        tolerance=repr(settings.proposed_tolerance),
        stepSize=repr(settings.step_size),
    )
    _variables(root, layout, fmi, types)
    _structure(root, layout, fmi)
    return root


# ---- interfaces and units -----------------------------------------------------------------------


_STATE = {
    "2.0": ("canGetAndSetFMUstate", "canSerializeFMUstate"),
    "3.0": ("canGetAndSetFMUState", "canSerializeFMUState"),
}
_DERIVATIVES = {
    "2.0": ("providesDirectionalDerivative",),
    "3.0": ("providesDirectionalDerivatives", "providesAdjointDerivatives"),
}


def _interfaces(
    root: ET.Element, fmi: str, identifier: str, fixed_step: float, sample_time: float | None
) -> None:
    common = dict.fromkeys(_STATE[fmi], "true")
    if sample_time is None:
        common |= dict.fromkeys(_DERIVATIVES[fmi], "true")
        exchange = {"completedIntegratorStepNotNeeded": "true"} if fmi == "2.0" else {}
        _interface(root, "ModelExchange", fmi, identifier, common | exchange)
    simulation = _simulation(fmi, fixed_step, sample_time)
    _interface(root, "CoSimulation", fmi, identifier, common | simulation)


def _simulation(fmi: str, fixed_step: float, sample_time: float | None) -> dict[str, str]:
    """What Co-Simulation can do beyond what Model Exchange can."""
    found = {"canHandleVariableCommunicationStepSize": "true"}
    if fmi == "2.0":
        found["canInterpolateInputs"] = "true"
    else:
        found["hasEventMode"] = "true"
    if sample_time is None:
        found["maxOutputDerivativeOrder"] = "1"
    internal = sample_time if sample_time is not None else fixed_step
    if fmi == "3.0" and internal > 0:
        found["fixedInternalStepSize"] = repr(internal)
    elif fmi == "3.0":
        found["providesIntermediateUpdate"] = "true"
        found["canReturnEarlyAfterIntermediateUpdate"] = "true"
    return found


def _interface(
    root: ET.Element, name: str, fmi: str, identifier: str, attributes: Mapping[str, str]
) -> None:
    element = ET.SubElement(root, name, {"modelIdentifier": identifier, **attributes})
    if fmi == "2.0":
        files = ET.SubElement(element, "SourceFiles")
        ET.SubElement(files, "File", name=MAIN_SOURCE)


# ---- variables ----------------------------------------------------------------------------------


def _causality(entry: Entry, sampled: bool) -> dict[str, str]:
    """Causality, variability and initial of a variable, the same in FMI 2 and 3."""
    if entry.role == "time":
        return {"causality": "independent", "variability": "continuous"}
    tuned = "tunable" if entry.variable.tunable else "fixed"
    if entry.role == "parameter":
        return {"causality": "parameter", "variability": tuned, "initial": "exact"}
    if entry.role == "input":
        variability = "continuous" if entry.type == "Real" else "discrete"
        return {"causality": "input", "variability": variability}
    if entry.is_calculated:
        causality = "calculatedParameter"
        return {"causality": causality, "variability": tuned, "initial": "calculated"}
    return {
        "causality": "output" if entry.is_output else "local",
        "variability": "discrete" if sampled else "continuous",
        "initial": "exact" if entry.role == "state" or entry.begins else "calculated",
    }


def _quantity(entry: Entry, types: Types) -> dict[str, str]:
    """Unit, range, nominal and start value of a variable. Unit and range are those of its type,
    and repeated: not all importers look at types.
    """
    variable = entry.variable
    if entry.boolean:
        known = entry.role == "input"
        return {"start": "true" if variable.start else "false"} if known else {}
    settable = entry.role in ("state", "input", "parameter") or entry.begins
    if entry.type == "Enumeration":
        start = {"start": str(round(variable.start or 0.0))} if settable else {}
        return {"declaredType": quantities.declared(variable, types), **start}
    attributes = {"unit": variable.unit}
    if entry.role != "time":
        attributes["declaredType"] = quantities.declared(variable, types)
    attributes |= quantities.range_of(variable)
    if entry.role != "time" and math.isfinite(variable.nominal):
        attributes["nominal"] = repr(float(variable.nominal))
    if settable:
        attributes["start"] = repr(float(variable.start or 0.0))
    return attributes


def _head(entry: Entry, sampled: bool) -> dict[str, str]:
    head = {"name": entry.name, "valueReference": str(entry.reference)}
    if entry.variable.description:
        head["description"] = entry.variable.description
    return head | _causality(entry, sampled)


def _variables(root: ET.Element, layout: Layout, fmi: str, types: Types) -> None:
    """In FMI 2 without time, which it does not ask for and FMI Library complains about."""
    parent = ET.SubElement(root, "ModelVariables")
    number = "Float32" if layout.single else "Float64"
    for entry in layout.entries[1:] if fmi == "2.0" else layout.entries:
        if entry.reference in layout.within:
            if entry.reference in layout.arrays:
                _array(parent, layout, entry)
            continue
        head = _head(entry, layout.sample_time is not None)
        about = _quantity(entry, types)
        if entry.role == "derivative":
            about["derivative"] = str(entry.reference - len(layout.of("state")))
        if fmi == "2.0":
            ET.SubElement(ET.SubElement(parent, "ScalarVariable", head), entry.type, about)
        else:
            kind = "Float64" if entry.role == "time" else number
            ET.SubElement(parent, kind if entry.type == "Real" else entry.type, head | about)
    if fmi == "3.0" and layout.clock and layout.sample_time is not None:
        _clock(parent, layout, layout.sample_time)


def _array(parent: ET.Element, layout: Layout, first: Entry) -> None:
    """A matrix of parameters, row by row. Its entries count in different units: it has none."""
    name, rows, columns = layout.arrays[first.reference]
    entries = layout.entries[first.reference : first.reference + rows * columns]
    attributes = {"name": name, "valueReference": str(first.reference)}
    attributes["description"] = "; ".join(e.variable.description for e in entries)
    attributes |= _causality(first, True)
    attributes["start"] = " ".join(repr(float(e.variable.start or 0.0)) for e in entries)
    element = ET.SubElement(parent, "Float64", attributes)
    for size in (rows, columns):
        ET.SubElement(element, "Dimension", start=str(size))


def _clock(parent: ET.Element, layout: Layout, sample_time: float) -> None:
    """The clock of the samples. Inputs and outputs do not belong to it, so that importers without
    clocks may set and read them in each step.
    """
    name = "clock"
    while name in {e.name for e in layout.entries}:
        name += "_"
    ET.SubElement(
        parent,
        "Clock",
        name=name,
        valueReference=str(len(layout.entries)),
        description="ticks when a sample is due; without ticks samples are made in the steps",
        causality="input",
        intervalVariability="constant",
        intervalDecimal=repr(sample_time),
    )


# ---- model structure ----------------------------------------------------------------------------


def _outputs(layout: Layout) -> Unknowns:
    known: dict[int, tuple[Dependency, ...]] = {**layout.dependencies}
    known |= {e.reference: ((e.reference, "constant"),) for e in layout.of("state")}
    return [(e.reference, known[e.reference]) for e in layout.outputs]


def _derivatives(layout: Layout) -> Unknowns:
    return [(e.reference, layout.dependencies[e.reference]) for e in layout.of("derivative")]


def _initial(layout: Layout) -> Unknowns:
    return [
        (e.reference, _once(layout, layout.initial_dependencies[e.reference]))
        for e in layout.entries
        if e.role == "derivative"
        or e.is_calculated
        or (e.role == "output" and e.is_output and not e.begins)
    ]


def _once(layout: Layout, known: Iterable[Dependency]) -> tuple[Dependency, ...]:
    """Dependencies on entries of an array as one on the array."""
    return tuple(dict.fromkeys((layout.within.get(r, r), kind) for r, kind in known))


def _structure(root: ET.Element, layout: Layout, fmi: str) -> None:
    """FMI 2 counts variables from 1 in the order of the file: the index is our reference."""
    two, parent = fmi == "2.0", ET.SubElement(root, "ModelStructure")
    for name, unknowns in (
        ("Output", _outputs(layout)),
        ("Derivative" if two else "ContinuousStateDerivative", _derivatives(layout)),
        ("InitialUnknown", _initial(layout)),
    ):
        group = parent
        if two and unknowns:  # FMI 2 allows no empty groups
            group = ET.SubElement(parent, f"{name}s")
        for reference, known in unknowns:
            attributes = {
                "index" if two else "valueReference": str(reference),
                "dependencies": " ".join(str(r) for r, _ in known),
                "dependenciesKind": " ".join(kind for _, kind in known),
            }
            ET.SubElement(group, "Unknown" if two else name, attributes)

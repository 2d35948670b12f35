"""modelDescription.xml, for FMI 2.0 and FMI 3.0; the page and the icon beside it."""

from __future__ import annotations

import html
import io
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources

import casadi as ca

from ..core.errors import InputError
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.plant import Plant
from . import quantities
from .layout import Dependency, Entry, Layout, Settings
from .source import MAIN_SOURCE

GENERATED = "2000-01-01T00:00:00Z"
"""The date of an FMU that is given none, so that the same plant gives the same bytes."""

_NOT_IN_XML = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")

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
    """An XML document as text, indented. Raises InputError for characters that XML has not."""
    ET.indent(root, "  ")
    body = ET.tostring(root, encoding="unicode")
    if wrong := _NOT_IN_XML.search(body):
        around = body[max(wrong.start() - 20, 0) : wrong.end() + 20]
        raise InputError(
            f"a name or a description has the character {wrong[0]!r}, which XML does not allow: "
            f"... {around!r} ...; leave it out"
        )
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


def equations(plant: Plant) -> list[tuple[str, str]]:
    """(left side, right side) of every equation as text; shared parts first, named w0, w1, ..."""
    names = [f"der({v.name})" for v in plant.states] + [v.name for v in plant.outputs]
    sides, symbols, parts = ca.shared([plant.expression(n) for n in names], "w", "")
    found = [(_text(s), _text(e)) for s, e in _ordered(list(zip(symbols, parts, strict=True)))]
    return found + [(n, _text(e)) for n, e in zip(names, sides, strict=True)]


def _ordered(parts: list[tuple[ca.SX, ca.SX]]) -> list[tuple[ca.SX, ca.SX]]:
    """Parts so that each one stands behind those it uses."""
    waiting = {symbol.name(): (symbol, part) for symbol, part in parts}
    needs = {n: {s.name() for s in ca.symvar(p)} & waiting.keys() for n, (_, p) in waiting.items()}
    ordered: list[tuple[ca.SX, ca.SX]] = []
    while waiting:
        ready = [n for n in waiting if not needs[n] & waiting.keys()]
        ordered += [waiting.pop(n) for n in ready]
    return ordered


def _text(expression: ca.SX) -> str:
    """An expression in one line, CasADi's abbreviations (@1=6, ...) written out."""
    text = str(expression)
    numbers = {}
    while match := re.match(r"(@\d+)=(.*?), (?=@\d+=|[^,]*$|.)", text):
        numbers[match[1]] = match[2]
        text = text[match.end() :]
    for _ in numbers:
        text = re.sub(r"@\d+", lambda m: numbers.get(m[0], m[0]), text)
    if text.startswith("(") and text.endswith(")") and _closes_last(text):
        text = text[1:-1]
    return text


def _closes_last(text: str) -> bool:
    """Whether the first bracket is closed by the last one."""
    depth = 0
    for position, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return position == len(text) - 1
    return False


_STYLE = (
    "body{font-family:sans-serif;max-width:60em;margin:2em auto;padding:0 1em}"
    "table{border-collapse:collapse}td,th{border:1px solid #bbb;padding:.2em .6em;text-align:left}"
    "pre{white-space:pre-wrap;overflow-wrap:anywhere;background:#f4f4f4;padding:.5em}"
)


def _range(variable: Variable) -> str:
    low, high = (
        variable.exactly(bound) if math.isfinite(bound) else ""
        for bound in (variable.min, variable.max)
    )
    return f"{low} .. {high}" if low or high else ""


def _table(title: str, variables: Iterable[Variable]) -> str:
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td>{html.escape(cell)}</td>"
            for cell in (
                v.name,
                "" if v.start is None else v.exactly(v.start),
                v.unit,
                _range(v),
                "tunable" if v.tunable else "",
                v.description,
            )
        )
        + "</tr>\n"
        for v in variables
    )
    if not rows:
        return ""
    head = "".join(f"<th>{h}</th>" for h in ("name", "start", "SI unit", "range", "", "meaning"))
    return f"<h2>{title}</h2>\n<table><tr>{head}</tr>\n{rows}</table>\n"


def page(
    layout: Layout,
    notes: Sequence[str],
    lines: Sequence[tuple[str, str]],
    with_reference: bool = False,
) -> str:
    """documentation/index.html: what the model is, its variables, parameters and equations.

    lines : the equations, left and right sides.
    """
    picture = (
        "<h2>Reference motion</h2>\n<p>Its numbers stand beside this page in two tables, inputs "
        '(..._in.csv) and results (..._ref.csv).</p>\n<img src="reference.png" alt="time series">\n'
    )
    results = [*layout.of("state"), *layout.of("output")]
    shown, local = (
        [e.variable for e in results if e.is_output is wanted] for wanted in (True, False)
    )
    text = "\n".join(f"{left} = {right}" for left, right in lines)
    tables = "".join(
        _table(title, variables)
        for title, variables in (
            ("Inputs", layout.variables("input")),
            ("Outputs (those with a start value are states)", shown),
            ("Local variables", local),
            ("Parameters", layout.variables("parameter")),
        )
    )
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{html.escape(layout.name)}</title><style>{_STYLE}</style></head><body>\n"
        f"<h1>{html.escape(layout.name)}</h1>\n<p>{html.escape(layout.description)}</p>\n"
        + "".join(f"<p>{html.escape(note)}</p>\n" for note in notes)
        + tables
        + "<h2>Equations</h2>\n<p>SI units; w0, w1, ... are parts used more than once; "
        "(condition ? a : 0) is a where the condition holds, else 0; sq(a) is a squared.</p>\n"
        f"<pre>{html.escape(text)}</pre>\n{picture if with_reference else ''}</body></html>\n"
    )


# ---- reference motion --------------------------------------------------------------------------


def table(names: Iterable[str], rows: Iterable[Iterable[float]]) -> str:
    """Columns behind the time [SI], in the CSV format of FMI's reference results."""
    header = ",".join(f'"{name}"' for name in ("time", *names))
    lines = (",".join(repr(float(c)) for c in row) for row in rows)
    return "\n".join([header, *lines, ""])


def picture(motion: Trajectory) -> bytes:
    """A motion over time, as PNG."""
    buffer = io.BytesIO()
    motion.plot().savefig(buffer, format="png", dpi=80, metadata={"Software": None})
    return buffer.getvalue()


# ---- icon: a muscle between two ends -----------------------------------------------------------


def icon_svg() -> str:
    """The icon as SVG, 100 x 100: a braided muscle between its fittings."""
    braid = "".join(
        f'<path d="M{x} 62 Q{x + 9} 50 {x + 18} 38 M{x} 38 Q{x + 9} 50 {x + 18} 62"/>'
        for x in range(23, 60, 12)
    )
    return (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 100 100">'
        '<rect x="1" y="1" width="98" height="98" rx="6" '
        'fill="#fff" stroke="#345" stroke-width="2"/>'
        '<path d="M2 50H98" stroke="#345" stroke-width="4"/>'
        '<path d="M18 40Q50 26 82 40V60Q50 74 18 60Z" fill="#7ab" stroke="#345" stroke-width="2"/>'
        f'<g fill="none" stroke="#345" stroke-width="1.2">{braid}</g>'
        '<path d="M12 38h8v24h-8zM80 38h8v24h-8z" fill="#345"/></svg>\n'
    )


def stored(name: str) -> bytes:
    """A picture as PNG: the same drawing (icon.png, 100 x 100 pixels), a disc for terminals
    (signal.png, 32 x 32); files, so that an export needs no matplotlib.
    """
    return (resources.files("pam_ocp.export") / "icons" / name).read_bytes()

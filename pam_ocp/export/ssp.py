"""A system of FMUs in one file (SSP): plant, estimator, controller, motion."""

from __future__ import annotations

import os
import tempfile
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias, get_args

from ..core.block import Block
from ..core.errors import InputError, UnknownNameError, require_positive
from ..core.files import atomic_path, require_ending
from ..core.quantities import outside
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.units import unit
from ..core.variables import Variable
from ..plants.plant import Plant
from . import assembly, description, quantities
from .layout import FmiVersion, checked
from .motion import export_motion, player
from .package import checked_shapes, export_fmu, write_block
from .sampled import BlockLayout, as_block, as_booleans
from .ssv import SPACE, parameter_set

LATE = 0.1
"""Sample times: commands that act so much later than designed for lose little."""

SspVersion: TypeAlias = Literal["1.0", "2.0"]
Component: TypeAlias = Plant | Block | Trajectory | Any
Wire: TypeAlias = tuple[str, str, str, str]
"""Component and variable of the output, component and variable of the input."""


@dataclass(frozen=True)
class Part:
    """A component: its variables, and how its FMU is written to a path."""

    inputs: tuple[Variable, ...]
    outputs: tuple[Variable, ...]
    settable: tuple[Variable, ...]
    """States and parameters with their start values."""
    write: Callable[[Path], Path]
    types: Mapping[str, str] = field(default_factory=dict)
    """Of inputs and outputs that are no numbers: "Boolean", or the codes of an enumeration."""


@verb
def export_ssp(
    components: Mapping[str, Component] | Sequence[Component],
    connections: Mapping[str, str],
    path: str | os.PathLike[str],
    *,
    name: str = "system",
    fmi: FmiVersion = "2.0",
    step_size: float | None = None,
    stop_time: float = 1.0,
    tolerance: float = 1e-6,
    platforms: Iterable[str] | str | None = None,
    version: SspVersion = "1.0",
    matrices: bool = False,
    booleans: bool = False,
    enumerations: bool = False,
) -> Path:
    """Write FMUs (Co-Simulation) and their connections as an SSP; returns its path.

    Parameters
    ----------
    components : by name, plants, sampled blocks (controllers, estimators), and motions to be
        played, with all their columns (see :func:`export_motion`); or a list of them, which go by
        their own names, a motion by "motion".
    connections : {input: output}, such as ``{"plant.muscle1.command": "pid.muscle1.command"}``: the
        component's name, a dot, the variable's name. States are outputs too. Every input of every
        component must have one, since some tools take 0 for an open one.
    path : the file to write. An existing file is replaced when all is done.
    name : of the system.
    fmi : of the units; not all tools for systems read 3.0. Blocks have no clock here, since no
        such tool ticks one.
    step_size : proposed communication step [s]; by default the blocks' sample time, else 1 ms.
    stop_time : proposed end [s].
    tolerance : of the plants, see :func:`export_fmu`.
    platforms : see :func:`export_fmu`.
    version : of SSP: "1.0" (default: read by every importer) or "2.0", which knows the types of
        FMI 3; its name spaces are those of 1.0.
    matrices, booleans, enumerations : of the blocks, see :func:`export_fmu`. Arrays stand in the
        FMUs alone. An input stays a number where its source is one.

    Start values and parameters stand in the FMUs and, to be changed there, in the SSP.

    The exchange: outputs are handed over once after initialization, and after each communication
    step, which all components take at once with inputs held. So a plant's inputs start with its
    own start values, and commands act one step after their measurement: at the blocks' sample
    time that is ``closed_loop(..., delay=1)``, to the last digits of the integration. Masters that
    hand nothing over after initialization (FMPy) begin with zeros. Warns where a block is not
    designed for that delay (``Mpc(delay=1)``, ``block(..., delay=1)``), or gets values through
    another block, each of which takes one step more (``chain`` makes them one).

    Raises InputError (an open input, units that do not fit, sample times that differ, a step that
    does not fit them), UnknownNameError, ExportError.

    Examples
    --------
    >>> weights = {"muscle.command": 1.0}
    >>> pid = pam.control.pid_controller(plant, "x", weights, proportional=2e6)
    >>> x, u = plant.variable("x"), plant.variable("muscle.command")
    >>> ramp = pam.Trajectory([0, 1], {"x": [0.04, 0.05], u.name: [2e5, 3e5]}, [x, u])
    >>> wires = {
    ...     "load.muscle.command": "pid.muscle.command",
    ...     "pid.position": "load.x",
    ...     "pid.reference": "ramp.x",
    ...     "pid.feedforward.muscle.command": "ramp.muscle.command",
    ... }
    >>> parts = {"load": plant, "pid": pid, "ramp": ramp}
    >>> pam.export_ssp(parts, wires, "system.ssp", platforms=["native"]).name
    'system.ssp'
    """
    require_ending(path, ".ssp", "a system")
    stop_time = require_positive("stop_time", stop_time, "s")
    if version not in get_args(SspVersion):
        raise UnknownNameError("SSP version", version, get_args(SspVersion))
    kind = "Float64" if (version, fmi) == ("2.0", "3.0") else "Real"
    shapes = checked_shapes(fmi, matrices=matrices, booleans=booleans, enumerations=enumerations)
    found = _with_flags(_named(components), connections, shapes)
    size = _step_size(found, step_size)
    first = _first_commands(found, connections)
    parts = {
        n: _part(n, c, size, tolerance, fmi, platforms, first, shapes) for n, c in found.items()
    }
    wires = _wires(parts, connections)
    _warn_of_delays(found, wires, size)
    with (
        atomic_path(path) as target,
        tempfile.TemporaryDirectory(prefix="pam_ocp_") as folder,
    ):
        content = {}
        for key, part in parts.items():
            file = part.write(Path(folder) / f"{key}.fmu")
            content[f"resources/{key}.fmu"] = file.read_bytes()
        tree = _system_structure(name, parts, wires, size, stop_time, (version, kind))
        content["SystemStructure.ssd"] = description.to_text(tree).encode()
        assembly.write_archive(target, content)
    return Path(path)


# ---- components ---------------------------------------------------------------------------------


def _named(components: Mapping[str, Component] | Sequence[Component]) -> dict[str, Component]:
    """Components by name; controllers as blocks. Raises InputError."""
    if isinstance(components, Mapping):
        pairs = list(components.items())
    elif isinstance(components, Sequence) and not isinstance(components, str):
        pairs = [(_own_name(c), c) for c in components]
    else:
        raise InputError(f"components = {components!r}: give a list, or a dict by name")
    if not pairs:
        raise InputError("components is empty: name at least one Plant, Block or Trajectory")
    found: dict[str, Component] = {}
    for name, component in pairs:
        if Variable(name, "parameter").name in found:
            raise InputError(f"components: {name!r} is there twice; give a dict with other names")
        block = as_block(component)
        found[name] = component if block is None else block
        if not isinstance(found[name], Plant | Block | Trajectory):
            raise InputError(
                f"component {name!r} = {component!r} must be a Plant, a Block or a Trajectory"
            )
        _require_own_prefix(name, found[name])
    return found


def _require_own_prefix(name: str, component: Component) -> None:
    """Importers take the component's name off parameters: those that begin with it get lost."""
    variables = () if isinstance(component, Trajectory) else component.parameters
    if isinstance(component, Plant):
        variables += component.states
    lost = next((v.name for v in variables if v.name.startswith(f"{name}.")), None)
    if lost is not None:
        raise InputError(
            f"component {name!r} is named like the beginning of its parameter {lost}, whose value "
            f"some importers then lose; name it otherwise, such as 'the_{name}'"
        )


def _with_flags(
    components: Mapping[str, Component], connections: Mapping[str, str], shapes: Mapping[str, bool]
) -> dict[str, Component]:
    """Blocks with one output for each flag; inputs whose sources are numbers are numbers."""
    found = dict(components)
    blocks = {n: c for n, c in found.items() if isinstance(c, Block)}
    if shapes["booleans"]:
        if not any(b.flags for b in blocks.values()):
            raise InputError("booleans = True: no block has flags; leave it out")
        blocks = {n: as_booleans(b) if b.flags else b for n, b in blocks.items()}
    sources = {f"{n}.{v.name}": _type(b, v) for n, b in blocks.items() for v in b.outputs}
    for name, block in blocks.items():
        of = {v.name: sources.get(connections.get(f"{name}.{v.name}", "")) for v in block.inputs}
        other = {v.name for v in block.inputs if _type(block, v) != of[v.name]}
        found[name] = replace(
            block,
            inputs=tuple(replace(v, codes="") if v.name in other else v for v in block.inputs),
            flags={n: bits for n, bits in block.flags.items() if n not in other},
        )
    return found


def _type(block: Block, variable: Variable) -> str | None:
    return "Boolean" if variable.name in block.flags else variable.codes or None


def _own_name(component: Component) -> str:
    block = as_block(component)
    if isinstance(component, Trajectory):
        return "motion"
    return str(getattr(component if block is None else block, "name", "component"))


def _step_size(components: Mapping[str, Component], step_size: float | None) -> float:
    """The communication step: the blocks' sample time, or a whole part of it. Raises InputError."""
    times = {n: c.sample_time for n, c in components.items() if isinstance(c, Block)}
    if step_size is None:
        step_size = next(iter(times.values()), 1e-3)
    step_size = require_positive("step_size", step_size, "s")
    if len(set(times.values())) > 1:
        said = ", ".join(f"{n} {t:g} s" for n, t in times.items())
        raise InputError(f"sample times differ: {said}; make the blocks with one sample time")
    for name, time in times.items():
        if abs(time / step_size - round(time / step_size)) > 1e-9 or time < step_size * (1 - 1e-9):
            raise InputError(
                f"step_size = {step_size:g} s does not go into the sample time of {name}, "
                f"{time:g} s, a whole number of times; give {time:g} or a whole part of it"
            )
    return step_size


def _part(
    name: str,
    component: Plant | Block | Trajectory,
    step_size: float,
    tolerance: float,
    fmi: FmiVersion,
    platforms: Iterable[str] | str | None,
    first: Mapping[str, float],
    shapes: Mapping[str, bool],
) -> Part:
    chosen = None if platforms is None else [platforms] if isinstance(platforms, str) else platforms
    more: dict[str, Any] = {"fmi": fmi, "platforms": chosen, "step_size": step_size}
    if isinstance(component, Block):
        block, settings = component, checked(fmi, step_size, tolerance, None, 1.0)
        begins = {v.name: first.get(f"{name}.{v.name}") for v in block.outputs}
        given = {n: value for n, value in begins.items() if value is not None}
        forms = {**shapes, "booleans": shapes["booleans"] and bool(block.flags)}
        layout = BlockLayout(block, False, given, **forms)
        plain = [e for e in layout.of("parameter") if e.type == "Real"]
        return Part(
            block.inputs,
            block.outputs,
            tuple(e.variable for e in plain if e.reference not in layout.within),
            lambda path: write_block(block, path, settings, chosen, False, given, **forms),
            {e.name: e.variable.codes or e.type for e in layout.entries if e.type != "Real"},
        )
    if isinstance(component, Trajectory):
        model = player(name, component, component.names)
        more |= {"names": component.names, "name": name}
        write = partial(export_motion, component, **more)
    else:
        model = component
        write = partial(export_fmu, component, tolerance=tolerance, **more)
    settable = model.states + model.parameters
    return Part(model.inputs, model.states + model.outputs, settable, write)


# ---- exchange -----------------------------------------------------------------------------------


def _first_commands(
    components: Mapping[str, Component], connections: Mapping[str, str]
) -> dict[str, float]:
    """{output of a block: start value of the plant's input that it drives}."""
    found: dict[str, float] = {}
    plants = {n: c for n, c in components.items() if isinstance(c, Plant)}
    blocks = {n: c for n, c in components.items() if isinstance(c, Block)}
    begins = {f"{n}.{v.name}": v.start or 0.0 for n, c in plants.items() for v in c.inputs}
    commands = {f"{n}.{v.name}" for n, c in blocks.items() for v in c.outputs}
    for target, start in connections.items():
        if target in begins and start in commands:
            found.setdefault(start, begins[target])
    return found


def _warn_of_delays(
    components: Mapping[str, Component], wires: Iterable[Wire], step_size: float
) -> None:
    """What the exchange does to loops that are designed for another delay."""
    said: dict[str, None] = {}
    for of, _, to, sink in wires:
        block, target = components[of], components[to]
        if not isinstance(block, Block) or of == to:
            continue
        if isinstance(target, Block):
            if not sink.startswith("sent."):  # those are of the sample before anyway
                said[
                    f"{to} gets what {of} gives one step ({1e3 * step_size:g} ms) later; make them "
                    "one block by chain()"
                ] = None
            continue
        designed = block.delay * block.sample_time
        off = abs(step_size - designed)
        if isinstance(target, Plant) and off > LATE * block.sample_time:
            known = f"{1e3 * designed:g} ms" if block.delay else "no delay"
            said[
                f"commands of {of} act one step ({1e3 * step_size:g} ms) after their measurement, "
                f"but it is designed for {known}: {360 * off:.2g} deg of phase for each Hz of the "
                "loop's bandwidth; closed_loop(delay=1) tells what that does to a motion. Design "
                "it for that, as Mpc(delay=1) or block(..., delay=1), or give a step_size of a "
                "tenth of its sample time"
            ] = None
    for text in said:
        warnings.warn(f"export_ssp: {text}", stacklevel=outside())


# ---- connections --------------------------------------------------------------------------------


def _remedy(source: Variable, sink: Variable) -> str:
    """For a connection of an output to an input of another unit."""
    given, taken = unit(source.unit), unit(sink.unit)
    if not given.compatible(taken):
        return f"connect an output in {sink.unit}"
    if given.offset or taken.offset:
        how = f"converted to {sink.unit}"
    else:
        how = f"its values times {given.factor / taken.factor:.10g}"
    return (
        f"a connection hands numbers over as they are, so let the output be one in {sink.unit} "
        f"({how})"
    )


def _wires(parts: Mapping[str, Part], connections: Mapping[str, str]) -> list[Wire]:
    outputs = {f"{n}.{v.name}": (n, v) for n, part in parts.items() for v in part.outputs}
    inputs = {f"{n}.{v.name}": (n, v) for n, part in parts.items() for v in part.inputs}
    wires = []
    for target, start in connections.items():
        if target not in inputs:
            raise UnknownNameError("input of the system", target, inputs)
        if start not in outputs:
            raise UnknownNameError("output of the system", start, outputs)
        (to, sink), (of, source) = inputs[target], outputs[start]
        if sink.unit != source.unit:
            raise InputError(
                f"{target} is in {sink.unit}, but {start} is in {source.unit}: they do not fit; "
                + _remedy(source, sink)
            )
        types = [parts[n].types.get(v.name) for n, v in ((to, sink), (of, source))]
        if types[0] != types[1]:
            raise InputError(
                f"{target} is a number, but {start} is none: they do not fit; leave out booleans "
                "and enumerations, or connect a number"
            )
        wires.append((of, source.name, to, sink.name))
    unconnected = [n for n in inputs if n not in connections]
    if unconnected:
        raise InputError(f"connections: nothing leads to {', '.join(unconnected)}")
    return wires


# ---- SystemStructure.ssd ------------------------------------------------------------------------
_NAMESPACES = {
    "ssd": f"{SPACE}Description",
    "ssc": f"{SPACE}Common",
    "ssv": f"{SPACE}ParameterValues",
    "oms": "https://raw.githubusercontent.com/OpenModelica/OMSimulator/master/schema/oms.xsd",
}
_WIDTH, _GAP, _ROW = 40.0, 30.0, 6.0
"""Of a block in the diagram [mm]; the height of one connector."""


def _system_structure(
    name: str,
    parts: Mapping[str, Part],
    wires: Iterable[Wire],
    step_size: float,
    stop_time: float,
    form: tuple[str, str],
) -> ET.Element:
    """The root: components side by side, connectors with units.

    form : version of SSP, and the type of its numbers ("Float64" in 2.0 for units of FMI 3).
    """
    spaces = {f"xmlns:{prefix}": uri for prefix, uri in _NAMESPACES.items()}
    root = ET.Element(
        "ssd:SystemStructureDescription", {**spaces, "version": form[0], "name": name}
    )
    system = ET.SubElement(root, "ssd:System", name=name)
    elements = ET.SubElement(system, "ssd:Elements")
    codes = sorted({t for part in parts.values() for t in part.types.values()} - {"Boolean"})
    names = {text: f"Code{i + 1}" for i, text in enumerate(codes)}
    for place, (key, part) in enumerate(parts.items()):
        _component(elements, key, part, place, form, names)
    group = ET.SubElement(system, "ssd:Connections")
    ends = ("startElement", "startConnector", "endElement", "endConnector")
    for wire in wires:
        ET.SubElement(group, "ssd:Connection", dict(zip(ends, wire, strict=True)))
    _master(system, step_size)
    if names:
        group = ET.SubElement(root, "ssd:Enumerations")
    for text, enumeration in names.items():
        element = ET.SubElement(group, "ssc:Enumeration", name=enumeration)
        quantities.add_items(element, text, "ssc:")
    everything = [
        v for part in parts.values() for v in (*part.inputs, *part.outputs, *part.settable)
    ]
    quantities.add_units(ET.SubElement(root, "ssd:Units"), everything, "ssc:")
    ET.SubElement(root, "ssd:DefaultExperiment", startTime="0.0", stopTime=repr(float(stop_time)))
    return root


def _master(system: ET.Element, step_size: float) -> None:
    """OMSimulator's command line wants to be told its master; others pass over the annotation."""
    annotations = ET.SubElement(system, "ssd:Annotations")
    annotation = ET.SubElement(annotations, "ssc:Annotation", type="org.openmodelica")
    own = ET.SubElement(annotation, "oms:Annotations")
    ET.SubElement(
        ET.SubElement(own, "oms:SimulationInformation"),
        "oms:FixedStepMaster",
        description="oms-ma",
        stepSize=repr(float(step_size)),
        absoluteTolerance="1e-06",
        relativeTolerance="1e-06",
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
    values.append(parameter_set(pairs, "initialValues", False, version, type_))

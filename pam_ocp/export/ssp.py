"""A system of FMUs in one file (SSP 1.0): plant, controller, motion."""

from __future__ import annotations

import os
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from pathlib import Path

from ..core.errors import InputError, UnknownNameError, require_positive
from ..core.files import atomic_path, require_ending
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.plant import Plant
from . import description, package
from .motion import export_motion, player
from .package import export_fmu

__all__ = ["export_ssp"]

_SPACE = "http://ssp-standard.org/SSP1/SystemStructure"
_NAMESPACES = {
    "ssd": f"{_SPACE}Description",
    "ssc": f"{_SPACE}Common",
    "ssv": f"{_SPACE}ParameterValues",
}
_PARAMETER_SET = "initialValues"


@verb
def export_ssp(
    components: Mapping[str, Plant | Trajectory],
    connections: Mapping[str, str],
    path: str | os.PathLike[str],
    *,
    name: str = "system",
    step_size: float = 1e-3,
    stop_time: float = 1.0,
    platforms: Iterable[str] | None = None,
) -> Path:
    """Write FMUs (FMI 2.0, Co-Simulation) and their connections as an SSP 1.0; returns its path.

    Parameters
    ----------
    components : by name, plants (also a controller: see :func:`pid_controller` and
        :func:`state_feedback_controller`), and motions to be
        played, with all their columns (see :func:`export_motion`).
    connections : {input: output}, such as ``{"plant.muscle1.command": "pid.muscle1.command"}``: the
        component's name, a dot, the variable's name. States are outputs too. Every input of every
        component must have one, since some tools take 0 for an open one.
    path : the file to write. An existing file is replaced when all is done.
    name : of the system.
    step_size, stop_time : proposed communication step and end [s].
    platforms : see :func:`export_fmu`.

    Start values and parameters stand in the FMUs and, to be changed there, in the SSP. Inputs are
    held over a communication step, so a loop through two components lags by one step.

    Raises InputError (an open input, units that do not fit), UnknownNameError, ExportError.

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
    step_size = require_positive("step_size", step_size, "s")
    stop_time = require_positive("stop_time", stop_time, "s")
    if not components:
        raise InputError("components is empty: name at least one Plant or Trajectory")
    plants = {Variable(n, "parameter").name: _variables(n, c) for n, c in components.items()}
    wires = _wires(plants, connections)
    with (
        atomic_path(path) as target,
        tempfile.TemporaryDirectory(prefix="pam_ocp_") as folder,
    ):
        content = {}
        for key, component in components.items():
            file = Path(folder) / f"{key}.fmu"
            if isinstance(component, Trajectory):
                export_motion(
                    component,
                    file,
                    names=component.names,
                    name=key,
                    platforms=platforms,
                    step_size=step_size,
                )
            else:
                export_fmu(component, file, platforms=platforms, step_size=step_size)
            content[f"resources/{key}.fmu"] = file.read_bytes()
        text = description.to_text(_structure(name, plants, wires, stop_time))
        content["SystemStructure.ssd"] = text.encode()
        package.write_archive(target, content)
    return Path(path)


# ---- connections --------------------------------------------------------------------------------


def _variables(name: str, component: Plant | Trajectory) -> Plant:
    """A plant with the component's variables."""
    if isinstance(component, Plant):
        return component
    if isinstance(component, Trajectory):
        return player(name, component, component.names)
    raise InputError(f"component {name!r} = {component!r} must be a Plant or a Trajectory")


Wire = tuple[str, str, str, str]
"""Component and variable of the output, component and variable of the input."""


def _wires(plants: Mapping[str, Plant], connections: Mapping[str, str]) -> list[Wire]:
    outputs = {
        f"{n}.{v.name}": (n, v) for n, plant in plants.items() for v in plant.states + plant.outputs
    }
    inputs = {f"{n}.{v.name}": (n, v) for n, plant in plants.items() for v in plant.inputs}
    wires = []
    for target, start in connections.items():
        if target not in inputs:
            raise UnknownNameError("input of the system", target, inputs)
        if start not in outputs:
            raise UnknownNameError("output of the system", start, outputs)
        (to, sink), (of, source) = inputs[target], outputs[start]
        if sink.unit != source.unit:
            raise InputError(
                f"{target} is in {sink.unit}, but {start} is in {source.unit}: they do not fit"
            )
        wires.append((of, source.name, to, sink.name))
    unconnected = [n for n in inputs if n not in connections]
    if unconnected:
        raise InputError(f"connections: nothing leads to {', '.join(unconnected)}")
    return wires


# ---- SystemStructure.ssd ------------------------------------------------------------------------


def _structure(
    name: str, plants: Mapping[str, Plant], wires: Iterable[Wire], stop_time: float
) -> ET.Element:
    spaces = {f"xmlns:{prefix}": uri for prefix, uri in _NAMESPACES.items()}
    root = ET.Element("ssd:SystemStructureDescription", {**spaces, "version": "1.0", "name": name})
    system = ET.SubElement(root, "ssd:System", name=name)
    elements = ET.SubElement(system, "ssd:Elements")
    for key, plant in plants.items():
        _component(elements, key, plant)
    group = ET.SubElement(system, "ssd:Connections")
    for of, source, to, sink in wires:
        ends = {
            "startElement": of,
            "startConnector": source,
            "endElement": to,
            "endConnector": sink,
        }
        ET.SubElement(group, "ssd:Connection", ends)
    ET.SubElement(root, "ssd:DefaultExperiment", startTime="0.0", stopTime=repr(float(stop_time)))
    return root


def _component(parent: ET.Element, name: str, plant: Plant) -> None:
    component = ET.SubElement(
        parent,
        "ssd:Component",
        name=name,
        type="application/x-fmu-sharedlibrary",
        source=f"resources/{name}.fmu",
    )
    connectors = ET.SubElement(component, "ssd:Connectors")
    for kind, variables in (("input", plant.inputs), ("output", plant.states + plant.outputs)):
        for variable in variables:
            connector = ET.SubElement(connectors, "ssd:Connector", name=variable.name, kind=kind)
            ET.SubElement(connector, "ssc:Real")
    bindings = ET.SubElement(component, "ssd:ParameterBindings")
    values = ET.SubElement(ET.SubElement(bindings, "ssd:ParameterBinding"), "ssd:ParameterValues")
    group = ET.SubElement(values, "ssv:ParameterSet", version="1.0", name=_PARAMETER_SET)
    parameters = ET.SubElement(group, "ssv:Parameters")
    for variable in plant.states + plant.parameters:
        parameter = ET.SubElement(parameters, "ssv:Parameter", name=variable.name)
        ET.SubElement(parameter, "ssv:Real", value=repr(float(variable.start or 0.0)))

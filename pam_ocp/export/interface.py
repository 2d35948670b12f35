"""Which of a plant's inputs and outputs its FMU shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from ..core.errors import InputError
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..operating.linear import chosen_signals
from ..plants.plant import Plant
from ..plants.undelayed import attributes_of


def with_inputs(plant: Plant, inputs: Sequence[str] | None) -> Plant:
    """The plant with these inputs only; the others become tunable parameters at their start values.

    Path constraints, which are not part of an FMU, are left out.
    Raises InputError, UnknownNameError for names that are no inputs.
    """
    chosen = chosen_signals("inputs", plant, inputs, ("input",))
    left_out = {v.name for v in plant.inputs} - set(chosen)
    if not left_out:
        return plant
    other = Plant(plant.name, plant.description)
    symbols = {}
    for v in (*plant.states, *plant.inputs, *plant.parameters):
        about = attributes_of(v)
        if v.causality == "state":
            symbols[v.name] = other.state(v.name, **about)
        elif v.causality == "input" and v.name not in left_out:
            symbols[v.name] = other.input(v.name, **about)
        else:
            tunable = v.tunable or v.causality == "input"
            del about["disturbance"]
            value = about.pop("start")
            symbols[v.name] = other.parameter(v.name, value, **{**about, "tunable": tunable})
    _define(other, plant, symbols)
    return other


def with_shared(plant: Plant) -> tuple[Plant, frozenset[str]]:
    """The plant with one parameter (``muscle.a1``) where parts that are numbered (``muscle1.a1``,
    ``muscle2.a1``) have equal ones; those become outputs. Returns the names of these, too.
    """
    groups: dict[str, list[Variable]] = {}
    for v in plant.parameters:
        part, _, constant = v.name.rpartition(".")
        family = part.rstrip("0123456789")
        if family and family != part:
            groups.setdefault(f"{family}.{constant}", []).append(v)
    taken = {v.name for v in plant.variables}
    shared = {
        name: members
        for name, members in groups.items()
        if len(members) > 1
        and name not in taken
        and all(_like(m) == _like(members[0]) for m in members)
    }
    one = {m.name: name for name, members in shared.items() for m in members}
    if not one:
        return plant, frozenset()
    other = Plant(plant.name, plant.description)
    symbols = {v.name: other.state(v.name, **attributes_of(v)) for v in plant.states}
    symbols |= {v.name: other.input(v.name, **attributes_of(v)) for v in plant.inputs}
    for v in plant.parameters:
        name = one.get(v.name, v.name)
        if name not in symbols:
            symbols[name] = _parameter(other, v, name)
        symbols[v.name] = symbols[name]
    _define(other, plant, symbols)
    for v in plant.parameters:
        if v.name in one:
            about = attributes_of(v) | {"start": None}
            other.output(v.name, symbols[v.name], **about)
    return other, frozenset(one)


def _like(variable: Variable) -> Variable:
    """All but the name and what is said of it."""
    return replace(variable, name="x", description="")


def _parameter(plant: Plant, variable: Variable, name: str) -> ca.SX:
    about = attributes_of(variable)
    del about["disturbance"]
    words = about["description"]
    if name != variable.name:
        part, family = variable.name.rpartition(".")[0], name.rpartition(".")[0]
        about["description"] = words.replace(part, f"each {family}")
    return plant.parameter(name, about.pop("start"), **about)


def _define(other: Plant, plant: Plant, symbols: Mapping[str, ca.SX]) -> None:
    """The equations and outputs of ``plant`` in the symbols of another."""
    columns = [
        ca.vertcat(*(symbols[v.name] for v in group))
        for group in (plant.states, plant.inputs, plant.parameters)
    ]
    xdot, y, _ = plant.function(*columns)
    for i, v in enumerate(plant.states):
        other.der(symbols[v.name], xdot[i])
    for i, v in enumerate(plant.outputs):
        other.output(v.name, y[i], **{**attributes_of(v), "start": None})


def shown_outputs(plant: Plant, outputs: Sequence[str] | None) -> frozenset[str] | None:
    """Names of the states and outputs that the FMU gives as outputs; None for all.

    Raises InputError, UnknownNameError for names that are neither, and for an empty list.
    """
    if outputs is None:
        return None
    chosen = chosen_signals("outputs", plant, outputs, ("state", "output"))
    if not chosen:
        raise InputError("outputs is empty; name at least one state or output")
    return frozenset(chosen)


def check_reference(reference: Trajectory, plant: Plant) -> None:
    """Refuse a reference motion that plays what the FMU holds. Raises InputError."""
    constants = {v.name: v.start for v in plant.parameters}
    for name in reference.named("input"):
        if name in constants and not np.all(reference[name] == constants[name]):
            raise InputError(
                f"reference: its input {name} is left out of the FMU, which holds it at "
                f"{plant.variable(name).shown(constants[name] or 0.0)}; name it in inputs"
            )

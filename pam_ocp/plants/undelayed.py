"""A plant without the delay lines of its dead times: what comes out of them are inputs."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

import casadi as ca

from ..core.errors import InputError
from ..core.variables import Variable
from .plant import Plant, require_plant

__all__ = ["attributes_of", "without_dead_times"]


def without_dead_times(plant: Plant) -> Plant:
    """The same plant with an input in place of each delay line, called as what came out of it.

    ``muscle1.command`` with a dead time of order 4 becomes ``muscle1.delay4``: the command as it
    was a dead time ago. The command itself stays an input, so that nothing else changes its place.
    Whoever drives this plant (a simulator's own transport delay around an FMU of it) delays
    exactly. Values are kept; the plant itself where it has no dead times.

    Examples
    --------
    >>> late = pam.HangingLoad(muscle, feed=pam.feeds.Regulator(dead_time=0.02))
    >>> [v.name for v in pam.plants.without_dead_times(late).inputs]
    ['muscle.command', 'muscle.delay4']
    """
    require_plant(plant)
    if not plant.delay_lines:
        return plant
    template: Plant = plant.cached("without dead times", lambda: _rebuilt(plant))
    values = {v.name: plant.variable(v.name).start for v in template.variables}
    kept = [v.name for v in template.variables if v.causality in ("state", "input", "parameter")]
    return template.with_values({n: values[n] for n in kept})


def _rebuilt(plant: Plant) -> Plant:
    outlets = {line.outlet for line in plant.delay_lines}
    inner = {s for line in plant.delay_lines for s in line.states} - outlets
    made = Plant(plant.name, plant.description)
    declare: dict[str, Any] = {"state": made.state, "input": made.input}
    symbols: dict[str, ca.SX] = {}
    for v in plant.variables:
        if v.causality in ("output", "constraint") or v.name in inner:
            continue
        attributes = attributes_of(v)
        if v.causality == "parameter":
            symbols[v.name] = made.parameter(v.name, attributes.pop("start"), **attributes)
        else:
            late = {"memory": ""} if v.name in outlets else {}
            kind = "input" if late else v.causality
            symbols[v.name] = declare[kind](v.name, **{**attributes, **late})
    defined = [v for v in plant.variables if v.causality in ("output", "constraint")]
    stated = [f"der({v.name})" for v in made.states] + [v.name for v in defined]
    found = ca.substitute(
        [ca.vertcat(*map(plant.expression, stated))],
        [ca.vertcat(*map(plant.expression, symbols))],
        [ca.vertcat(*symbols.values())],
    )[0]
    lost = sorted({s.name() for s in ca.symvar(found)} & inner)
    if lost:
        raise InputError(
            f"plant {plant.name!r}: its equations use {lost[0]}, inside of a delay line; use only "
            "what comes out of it"
        )
    for v, rate in zip(made.states, ca.vertsplit(found), strict=False):
        made.der(symbols[v.name], rate)
    for v, value in zip(defined, ca.vertsplit(found)[len(made.states) :], strict=True):
        attributes = {n: a for n, a in attributes_of(v).items() if n != "start"}
        (made.output if v.causality == "output" else made.constraint)(v.name, value, **attributes)
    return made


def attributes_of(variable: Variable) -> dict[str, Any]:
    """What declares the variable once more, but its name and causality."""
    names = [f.name for f in fields(variable) if f.name not in ("name", "causality")]
    return {n: getattr(variable, n) for n in names}

"""A plant without the delay lines of its dead times: what comes out of them are inputs."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import fields
from typing import Any

import casadi as ca

from ..core.errors import InputError, with_kinds
from ..core.variables import Variable
from .plant import Plant, require_plant


@with_kinds
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
    again = Redeclared(plant, inputs=outlets, without=inner)
    found = again.equations()
    lost = sorted({s.name() for e in found.values() for s in ca.symvar(e)} & inner)
    if lost:
        raise InputError(
            f"plant {plant.name!r}: its equations use {lost[0]}, inside of a delay line; use only "
            "what comes out of it"
        )
    return again.finished(found)


class Redeclared:
    """A plant declared once more, where more may be declared, other equations given.

    inputs : states that become inputs. without : states that are left out. symbols : what stands
    for each parameter, state and input in the equations; those of ``made`` unless others are put.
    """

    def __init__(
        self, plant: Plant, inputs: Collection[str] = (), without: Collection[str] = ()
    ) -> None:
        self.plant, self.made = plant, Plant(plant.name, plant.description)
        self.own: dict[str, ca.SX] = {}
        for v in plant.variables:
            if v.causality in ("output", "constraint") or v.name in without:
                continue
            attributes = attributes_of(v)
            if v.causality == "parameter":
                start = attributes.pop("start")
                self.own[v.name] = self.made.parameter(v.name, start, **attributes)
            elif v.name in inputs:
                self.own[v.name] = self.made.input(v.name, **{**attributes, "memory": ""})
            else:
                declare = self.made.state if v.causality == "state" else self.made.input
                self.own[v.name] = declare(v.name, **attributes)
        self.symbols = dict(self.own)

    def state(self, name: str, **attributes: Any) -> ca.SX:
        """One more state, whose rate :meth:`finished` takes."""
        self.own[name] = self.made.state(name, **attributes)
        return self.own[name]

    def equations(self) -> dict[str, ca.SX]:
        """{state: its rate} and {output or constraint: its value}, in ``symbols``."""
        states = [v.name for v in self.plant.states if v.name in self.own]
        states = [n for n in states if self.made.variable(n).causality == "state"]
        defined = [v.name for v in self.plant.variables if v.causality in ("output", "constraint")]
        wanted = [*(f"der({n})" for n in states), *defined]
        found = ca.substitute(
            [ca.vertcat(*map(self.plant.expression, wanted))],
            [ca.vertcat(*map(self.plant.expression, self.symbols))],
            [ca.vertcat(*self.symbols.values())],
        )[0]
        return dict(zip((*states, *defined), ca.vertsplit(found), strict=False))

    def finished(self, equations: Mapping[str, ca.SX], constraints: bool = True) -> Plant:
        """The plant with these equations; those of states that were added may be among them."""
        states = {v.name for v in self.made.states}
        for name, value in equations.items():
            if name in states:
                self.made.der(self.own[name], value)
                continue
            v = self.plant.variable(name)
            attributes = {n: a for n, a in attributes_of(v).items() if n != "start"}
            if v.causality == "output":
                self.made.output(name, value, **attributes)
            elif constraints:
                self.made.constraint(name, value, **attributes)
        return self.made


def attributes_of(variable: Variable) -> dict[str, Any]:
    """What declares the variable once more, but its name and causality."""
    names = [f.name for f in fields(variable) if f.name not in ("name", "causality")]
    return {n: getattr(variable, n) for n in names}

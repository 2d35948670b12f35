"""Ensemble: copies of a plant with parameters of their own under the same inputs, as one Plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import casadi as ca

from ..core.system import Scope
from .plant import Plant

Draw = Mapping[str, float]


class Ensemble(Plant):
    """A nominal plant, and a copy of it for each draw of its parameters, under the same inputs.

    plant : the nominal one; its variables keep their names here.
    draws : {parameter: value} each, all of the same parameters.
    watched : names of variables whose deviation from the nominal plant becomes an output.
    kept : the copies' path constraints and ranges of states hold too, not the nominal plant's only.

    What differs in copy k is called ``NAME.draw<k>``, and ``NAME.deviation<k>`` its difference from
    the nominal; states that the draws do not touch (a regulator's pressure under a drawn force law)
    are shared. Objectives see the nominal plant, and rest at a stop is asked of it alone.
    """

    def __init__(
        self, plant: Plant, draws: Sequence[Draw], watched: Sequence[str] = (), kept: bool = True
    ) -> None:
        super().__init__(f"{plant.name}_ensemble", f"{plant.description}, {len(draws)} draws")
        self.nominal = plant
        self.draws = tuple(dict(d) for d in draws)
        self.own = _touched(plant, list(self.draws[0]))
        """Names of states, outputs and constraints that differ between the copies."""
        x, u, p = (
            [self._declare(v) for v in of] for of in (plant.states, plant.inputs, plant.parameters)
        )
        self._u = ca.vertcat(*u) if u else ca.SX(0, 1)
        self._symbols_of = {0: (ca.vertcat(*x), ca.vertcat(*p))}
        for k in range(1, len(draws) + 1):
            self._symbols_of[k] = self._copy(k, x, p, kept)
        self._write(kept)
        for name in watched:
            for k in range(1, len(draws) + 1):
                if name in self.own:
                    self._deviation(name, k)

    def _copy(
        self, k: int, x: Sequence[ca.SX], p: Sequence[ca.SX], kept: bool
    ) -> tuple[ca.SX, ca.SX]:
        """(states, parameters) of copy k: its own where the draws touch them."""
        states, parameters = list(x), list(p)
        for i, v in enumerate(self.nominal.states):
            if v.name in self.own:
                named = replace(v, name=f"{v.name}.draw{k}")
                self._copies |= {named.name}
                inf = float("inf")
                states[i] = self._declare(named if kept else replace(named, min=-inf, max=inf))
        drawn = self.draws[k - 1]
        for i, v in enumerate(self.nominal.parameters):
            if v.name in drawn:
                named = replace(v, name=f"{v.name}.draw{k}")
                parameters[i] = self._declare(named.with_start(drawn[v.name]))
        return ca.vertcat(*states), ca.vertcat(*parameters)

    def _write(self, kept: bool) -> None:
        plant = self.nominal
        for k, (x, p) in self._symbols_of.items():
            xdot, y, c = plant.function(x, self._u, p)
            suffix = f".draw{k}" if k else ""
            for i, v in enumerate(plant.states):
                if not k or v.name in self.own:
                    self.der(self._symbols[v.name + suffix], xdot[i])
            defined = [(v, y[i]) for i, v in enumerate(plant.outputs)]
            if not k or kept:
                defined += [(v, c[i]) for i, v in enumerate(plant.constraints)]
            for v, expression in defined:
                if not k or v.name in self.own:
                    self._define(replace(v, name=v.name + suffix), expression)

    def _deviation(self, name: str, k: int) -> None:
        variable = self.nominal.variable(name)
        here, there = (
            self._symbols.get(n, self._expressions.get(n)) for n in (f"{name}.draw{k}", name)
        )
        assert here is not None  # states have symbols, outputs expressions
        assert there is not None
        scope = Scope(self, name).of(
            variable.unit, variable.nominal, display_unit=variable.display_unit
        )
        scope.output(f"deviation{k}", here - there, f"of {name} in draw {k}")

    # ---- what is said of the plant, said of the ensemble ---------------------------------------
    def images(self, name: str) -> list[str]:
        """What a variable (or der(NAME)) of the plant is called in the copies; [] when shared."""
        inner = name[4:-1] if name.startswith("der(") else name
        inner = self.nominal.variable(inner).name
        count = range(1, len(self.draws) + 1)
        if inner not in self.own:
            return []
        found = [f"{inner}.draw{k}" for k in count]
        return [f"der({n})" for n in found] if name.startswith("der(") else found

    def expression_in(self, k: int, expression: ca.SX) -> ca.SX:
        """An expression of the plant's symbols, of copy k (0: the nominal one)."""
        plant = self.nominal
        x, p = self._symbols_of[k]
        old = ca.vertcat(plant.x, plant.u, plant.p)
        return ca.SX(ca.substitute(expression, old, ca.vertcat(x, self._u, p)))


def _touched(plant: Plant, drawn: Sequence[str]) -> set[str]:
    """States, outputs and constraints that the drawn parameters have an influence on."""
    known = ca.vertcat(*(plant.expression(name) for name in drawn))
    names = [v.name for v in plant.states]
    found: set[str] = set()
    while True:
        more = {
            n
            for n in names
            if n not in found and ca.depends_on(plant.expression(f"der({n})"), known)
        }
        if not more:
            break
        found |= more
        known = ca.vertcat(known, *(plant.expression(n) for n in more))
    defined = [v.name for v in (*plant.outputs, *plant.constraints)]
    return found | {n for n in defined if ca.depends_on(plant.expression(n), known)}

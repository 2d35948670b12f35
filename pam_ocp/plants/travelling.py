"""Plants that travel to other processes: their functions go, symbols are made anew."""

from __future__ import annotations

from typing import Any

import casadi as ca

from ..core.stop import locked
from .declaration import Declaration
from .equations import CHANGEABLE, DEFINED
from .opening import Carried, FlowPath, Opening

__all__ = ["Travelling"]


@locked
class Travelling(Declaration):
    """A declaration that can be pickled, by its function and what is said of its variables."""

    def __getstate__(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "description": self.description,
            "variables": list(self._variables.values()),
            "mirror": self._mirror,
            "function": self._travelling(),
            "delay_lines": self._delay_lines,
            "openings": [(o.variable, o.commands) for o in self._openings],
            "carried": [tuple(c.name for c in o.carried) for o in self._openings],
            "paths": [(way.opening, way.way) for way in self._flow_paths],
        }

    def _travelling(self) -> ca.Function:
        """The plant's function; where it has openings with their paths and the paths' meaning."""
        if not self._openings:
            return self._finished().function
        system = self._finished()
        w = ca.vertcat(*(o.symbol for o in self._openings))
        paths = ca.vertcat(*(way.symbol for way in self._flow_paths))
        results = [self._column(self._stated, c) for c in DEFINED]
        results += [ca.vertcat(*(way.in_commands for way in self._flow_paths))]
        results += [ca.vertcat(*(way.in_openings for way in self._flow_paths))]
        results += [ca.vertcat(*(o.forward for o in self._openings))]
        results += [ca.vertcat(*(e for o in self._openings for e in o.inverse))]
        carried = [c for o in self._openings for c in o.carried]
        results += [ca.vertcat(*(ca.vertcat(c.entered, c.left) for c in carried))]
        return ca.Function("plant", [system.x, system.u, system.p, w, paths], results)

    def __setstate__(self, state: dict[str, Any]) -> None:
        Declaration.__init__(self, state["name"], state["description"])
        self._variables = {v.name: v for v in state["variables"]}
        self._mirror = state["mirror"]
        self._delay_lines = state.get("delay_lines", ())
        symbols = {v.name: ca.SX.sym(v.name) for v in state["variables"]}
        self._symbols = {v.name: symbols[v.name] for c in CHANGEABLE for v in self._of(c)}
        known = [self._column(self._symbols, c) for c in CHANGEABLE]
        if not state.get("openings"):
            values = state["function"](*known)
        else:
            values = self._with_openings(state, known)
        for kind, column in zip(DEFINED, values, strict=True):
            for i, variable in enumerate(self._of(kind)):
                self._expressions[variable.name] = column[i]

    def _with_openings(self, state: dict[str, Any], known: list[ca.SX]) -> tuple[ca.SX, ...]:
        """Openings and paths from what has travelled; gives the columns of the equations."""
        function, openings = state["function"], state["openings"]
        symbols = [ca.SX.sym(v.name) for v, _ in openings]
        paths = [ca.SX.sym(f"way{i}") for i in range(len(state["paths"]))]
        *columns, in_commands, in_openings, forward, inverse, carried = function(
            *known, ca.vertcat(*symbols), ca.vertcat(*paths)
        )
        self._flow_paths = tuple(
            FlowPath(s, in_commands[i], in_openings[i], *state["paths"][i])
            for i, s in enumerate(paths)
        )
        parts, moved = (iter(ca.vertsplit(each)) for each in (inverse, carried))
        self._openings = tuple(
            Opening(
                v,
                symbols[i],
                commands,
                forward[i],
                tuple(next(parts) for _ in commands),
                tuple(Carried(n, next(moved), next(moved)) for n in state["carried"][i]),
            )
            for i, (v, commands) in enumerate(openings)
        )
        return tuple(columns)

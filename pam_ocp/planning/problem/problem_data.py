"""What was asked of a plan, as data: limits and objectives with their formulas, but without code.

A formula stands as the name of a variable of the plant where it is one ("muscle.tension",
"der(v)"), so that today's plant says what it is; else as the operations of CasADi, one by one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import casadi as ca

from ...core.errors import InputError
from ...core.variables import variable_of
from ...judge.statement import TIME, Profile
from ...plants.plant import Plant
from .problem import Auxiliary, Budget, Condition, Leg, Objective, Problem

__all__ = ["data_of", "problem_of"]

_CODES: dict[int, str] = {
    value: name[3:]
    for name, value in vars(ca).items()
    if name.startswith("OP_") and isinstance(value, int)
}
_NUMBERS = {name: code for code, name in _CODES.items()}


# ---- writing ------------------------------------------------------------------------------------
class _Writer:
    """Collects the formulas of a problem."""

    def __init__(self, problem: Problem) -> None:
        plant = problem.plant
        states = [f"der({v.name})" for v in plant.states]
        known = [v.name for v in plant.variables if v.causality != "parameter"] + states
        self._names = {name: plant.expression(name) for name in known}
        self.problem = problem
        self.formulas: list[ca.SX] = []

    def formula(self, expression: ca.SX) -> str | int:
        """A variable's name, or the number of a formula."""
        for name, own in self._names.items():
            if ca.is_equal(expression, own):
                return name
        self.formulas.append(ca.densify(expression))
        return len(self.formulas) - 1

    def limited(self, c: Condition | Budget) -> dict[str, Any]:
        """A condition or a budget."""
        expression = c.expression if isinstance(c, Condition) else c.integrand
        return {
            "label": c.label,
            "formula": self.formula(expression),
            "low": c.low,
            "high": c.high,
            "nominal": c.nominal,
            "shown": asdict(c.shown),
            "defining": isinstance(c, Condition) and c.defining,
        }

    def operations(self) -> list[Any]:
        """The formulas' operations in order: [name, result, arguments or number]."""
        function = self.problem.running("formulas", self.formulas)
        found: list[Any] = []
        for k in range(function.n_instructions()):
            code = _CODES.get(function.instruction_id(k), "?")
            if code in ("CALL", "?"):
                raise InputError("a formula of this plan calls a function, which no file can hold")
            out, into = function.instruction_output(k), function.instruction_input(k)
            value = function.instruction_constant(k) if code == "CONST" else list(into)
            found.append([code, list(out), value])
        return found


def data_of(problem: Problem) -> dict[str, Any]:
    """A problem as numbers, texts and lists (as JSON takes them, with infinities)."""
    writer, goal = _Writer(problem), problem.objective
    said = {
        "stops": [dict(stop) for stop in problem.stops],
        "nodes": [[writer.limited(c) for c in node] for node in problem.nodes],
        "legs": [
            {
                "duration": leg.duration,
                "path": [writer.limited(c) for c in leg.path],
                "bounds": leg.bounds,
                "dwell": leg.dwell,
            }
            for leg in problem.legs
        ],
        "closing": problem.closing,
        "objective": {
            "time": goal.time,
            "rate": goal.rate,
            "peaks": goal.peaks,
            "integrand": writer.formula(goal.integrand),
            "final": writer.formula(goal.final),
            "words": goal.words,
        },
        "budgets": [writer.limited(b) for b in problem.budgets],
        "design": problem.design,
        "profiles": [
            {"t": p.t.tolist(), "values": p.values.tolist(), "smooth": p.smooth}
            for p in problem.profiles
        ],
        "aims": problem.aims,
        "peaks": problem.m.numel(),
        "auxiliaries": [
            {
                "value": writer.formula(a.value),
                "range": (a.low, a.high),
                "conditions": [writer.limited(c) for c in a.conditions],
            }
            for a in problem.auxiliaries
        ],
    }
    return {**said, "formulas": len(writer.formulas), "operations": writer.operations()}


# ---- reading -------------------------------------------------------------------------------------
class _Reader:
    """The formulas of a statement in a plant's symbols."""

    def __init__(self, plant: Plant, said: Mapping[str, Any]) -> None:
        self.plant = plant
        sizes = [
            len(said["profiles"]),
            len(said["aims"]),
            said["peaks"],
            len(said.get("auxiliaries", ())),
        ]
        self.r, self.q, self.m, self.a = (
            ca.SX.sym(name, size) if size else ca.SX(0, 1)
            for name, size in zip(("profile", "aim", "peak", "auxiliary"), sizes, strict=True)
        )
        arguments = [plant.x, plant.u, plant.p, TIME, self.r, self.q, self.m, self.a]
        self.formulas = _replayed(said["operations"], arguments, said["formulas"])

    def formula(self, given: str | int) -> ca.SX:
        """The expression behind a name or a number."""
        return self.plant.expression(given) if isinstance(given, str) else self.formulas[given]

    def condition(self, said: Mapping[str, Any]) -> Condition:
        """A condition."""
        return Condition(
            said["label"],
            self.formula(said["formula"]),
            float(said["low"]),
            float(said["high"]),
            float(said["nominal"]),
            variable_of(said["shown"]),
            bool(said.get("defining")),
        )

    def budget(self, said: Mapping[str, Any]) -> Budget:
        """A budget."""
        c = self.condition(said)
        return Budget(c.label, c.expression, c.low, c.high, c.nominal, c.shown)


def _replayed(operations: Sequence[Any], arguments: Sequence[ca.SX], count: int) -> list[ca.SX]:
    """The expressions that a list of operations makes of the arguments."""
    work: dict[int, ca.SX] = {}
    found = [ca.SX(0)] * count
    for code, out, value in operations:
        if code not in _NUMBERS:
            raise InputError(f"unknown operation {code!r}")
        if code == "CONST":
            work[out[0]] = ca.SX(float(value))
        elif code == "INPUT":
            work[out[0]] = arguments[value[0]][value[1]]
        elif code == "OUTPUT":
            found[out[1]] = work[value[0]]
        else:
            given = [work[i] for i in value]
            made = ca.SX.binary if len(given) == 2 else ca.SX.unary
            work[out[0]] = made(_NUMBERS[code], *given)
    return found


def problem_of(plant: Plant, said: Mapping[str, Any]) -> Problem:
    """The problem behind :func:`data_of`, for a plant with the same variables.

    Raises KeyError, TypeError, ValueError or IndexError for what is no statement.
    """
    reader = _Reader(plant, said)
    goal = said["objective"]
    legs = tuple(
        Leg(
            (float(leg["duration"][0]), float(leg["duration"][1])),
            tuple(reader.condition(c) for c in leg["path"]),
            {n: (float(low), float(high)) for n, (low, high) in leg["bounds"].items()},
            bool(leg["dwell"]),
        )
        for leg in said["legs"]
    )
    closing = said["closing"]
    return Problem(
        plant,
        tuple(said["stops"]),
        tuple(tuple(reader.condition(c) for c in node) for node in said["nodes"]),
        legs,
        None if closing is None else {n: (float(s), image) for n, (s, image) in closing.items()},
        Objective(
            float(goal["time"]),
            float(goal["rate"]),
            reader.formula(goal["integrand"]),
            reader.formula(goal["final"]),
            tuple(goal["peaks"]),
            words=str(goal.get("words", "")),
        ),
        tuple(reader.budget(b) for b in said["budgets"]),
        {n: (float(low), float(high)) for n, (low, high) in said["design"].items()},
        tuple(Profile(p["t"], p["values"], p["smooth"]) for p in said["profiles"]),
        tuple(map(float, said["aims"])),
        reader.r,
        reader.q,
        reader.m,
        tuple(
            Auxiliary(
                symbol,
                reader.formula(a["value"]),
                float(a["range"][0]),
                float(a["range"][1]),
                tuple(reader.condition(c) for c in a["conditions"]),
            )
            for symbol, a in zip(ca.vertsplit(reader.a), said.get("auxiliaries", ()), strict=True)
        ),
    )

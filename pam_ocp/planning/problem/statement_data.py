"""A statement as data: numbers in SI, texts and lists, with formulas but without code.

A formula stands as the operations of CasADi, one by one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from ...core.errors import require_finite
from ...core.expressions import operations_of, results_of
from ...judge.asked import unit_of_sum
from ...judge.statement import TIME, Avoid, Constraint, Phase, Profile, Statement, Stop, subject
from ...plants.plant import Plant


# ---- writing ------------------------------------------------------------------------------------
class _Writer:
    """Turns values into data; collects the formulas."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.formulas: list[ca.SX] = []

    def value(self, given: Any, unit: str) -> Any:
        """A number, None, a range or list of these, or a Profile."""
        if given is None:
            return None
        if isinstance(given, Profile):
            points = {"t": given.t.tolist(), "values": given.values.tolist()}
            return {"profile": {**points, "smooth": given.smooth}}
        if isinstance(given, tuple | list | np.ndarray):
            kind = "range" if isinstance(given, tuple) else "list"
            return {kind: [self.value(each, unit) for each in given]}
        if isinstance(given, float | int) and np.isinf(given):
            return float(given)
        return require_finite("statement", given, unit)

    def named(self, given: Mapping[str, Any] | None) -> dict[str, Any] | None:
        """Values of variables."""
        if given is None:
            return None
        return {n: self.value(v, subject(self.plant, n)[0].unit) for n, v in given.items()}

    def formula(self, expression: ca.SX | None) -> int | None:
        """The number of a formula."""
        if expression is None:
            return None
        self.formulas.append(ca.densify(expression))
        return len(self.formulas) - 1

    def stop(self, given: Mapping[str, Any] | Stop) -> dict[str, Any]:
        stop = given if isinstance(given, Stop) else Stop(given)
        return {
            "values": self.named(stop.values),
            "rest": stop.rest,
            "dwell": self.value(stop.dwell, "s"),
            "within": stop.within,
        }

    def constraint(self, given: Constraint | Avoid) -> dict[str, Any]:
        if isinstance(given, Avoid):
            units = {
                n: "s" if n == "time" else subject(self.plant, n)[0].unit for n in given.region
            }
            region = {n: self.value(tuple(v), units[n]) for n, v in given.region.items()}
            return {"region": region, "name": given.name}
        ends = {n: self.value(getattr(given, n), given.unit) for n in ("low", "high")}
        formula = self.formula(given.expression)
        own = {"name": given.name, "nominal": float(given.nominal), "unit": given.unit}
        return {"formula": formula, **ends, **own}

    def phase(self, given: Phase | None) -> dict[str, Any] | None:
        if given is None:
            return None
        return {
            "duration": self.value(given.duration, "s"),
            "bounds": self.named(given.bounds),
            "constraints": [self.constraint(c) for c in given.constraints],
        }

    def operations(self) -> list[Any]:
        """The formulas' operations in order: [name, result, arguments or number]."""
        plant = self.plant
        column = ca.vertcat(ca.SX(0, 1), *self.formulas)
        function = ca.Function("formulas", [plant.x, plant.u, plant.p, TIME], [column])
        return operations_of(function)


def data_of(plant: Plant, statement: Statement) -> dict[str, Any]:
    """A statement as numbers, texts and lists (as JSON takes them, with infinities)."""
    writer, said = _Writer(plant), statement
    track = {
        n: {"aim": writer.value(aim, plant.variable(n).unit), "weight": float(weight)}
        for n, v in (said.track or {}).items()
        for aim, weight in [v if isinstance(v, tuple) else (v, 1.0)]
    }
    budgets = {n: writer.value(v, unit_of_sum(plant, n)) for n, v in (said.budgets or {}).items()}
    memory = said.memory if isinstance(said.memory, str) else writer.named(said.memory)
    found = {
        "stops": [writer.stop(s) for s in said.stops],
        "cyclic": said.cyclic,
        "duration": writer.value(said.duration, "s"),
        "minimise": {n: float(w) for n, w in said.weights.items()},
        "bounds": writer.named(said.bounds),
        "rest": bool(said.rest),
        "memory": memory,
        "jumps": said.jumps,
        "phases": None if said.phases is None else [writer.phase(p) for p in said.phases],
        "constraints": [writer.constraint(c) for c in said.constraints],
        "track": track,
        "budgets": budgets,
        "design": writer.named(said.design),
        "integrand": writer.formula(said.integrand),
        "final": writer.formula(said.final),
    }
    return {**found, "formulas": len(writer.formulas), "operations": writer.operations()}


# ---- reading ------------------------------------------------------------------------------------
def statement_of(plant: Plant, said: Mapping[str, Any]) -> Statement:
    """The statement behind :func:`data_of`, for a plant with the same variables.

    Raises KeyError, TypeError, ValueError or IndexError for what is no statement.
    """
    arguments = [plant.x, plant.u, plant.p, TIME]
    (formulas,) = results_of(said["operations"], arguments, [int(said["formulas"])])

    def formula(number: int | None) -> ca.SX | None:
        return None if number is None else formulas[number]

    def constraint(data: Mapping[str, Any]) -> Constraint | Avoid:
        if "region" in data:
            return Avoid({n: _value(v) for n, v in data["region"].items()}, str(data["name"]))
        own = {n: data[n] for n in ("low", "high", "name", "nominal", "unit")}
        return Constraint(formulas[data["formula"]], **own)

    def phase(data: Mapping[str, Any] | None) -> Phase | None:
        if data is None:
            return None
        constraints = [constraint(c) for c in data["constraints"]]
        return Phase(_value(data["duration"]), _named(data["bounds"]) or {}, constraints)

    memory = said["memory"]
    return Statement(
        [_stop(s) for s in said["stops"]],
        cyclic=said["cyclic"],
        duration=_value(said["duration"]),
        minimise=dict(said["minimise"]),
        bounds=_named(said["bounds"]),
        rest=bool(said["rest"]),
        memory=memory if isinstance(memory, str) else _named(memory),  # type: ignore[arg-type]
        jumps=bool(said["jumps"]),
        phases=None if said["phases"] is None else [phase(p) for p in said["phases"]],
        constraints=[constraint(c) for c in said["constraints"]],
        track={n: (_value(t["aim"]), float(t["weight"])) for n, t in said["track"].items()} or None,
        budgets=_named(said["budgets"]) or None,
        design=_named(said["design"]),
        integrand=formula(said["integrand"]),
        final=formula(said["final"]),
    )


def _stop(said: Mapping[str, Any]) -> Stop:
    dwell = _value(said["dwell"])
    return Stop(_named(said["values"]) or {}, said["rest"], dwell, float(said["within"]))


def _named(said: Mapping[str, Any] | None) -> dict[str, Any] | None:
    return None if said is None else {n: _value(v) for n, v in said.items()}


def _value(said: Any) -> Any:
    if not isinstance(said, Mapping):
        return None if said is None else float(said)
    (kind, content), *_ = said.items()
    if kind == "profile":
        return Profile(content["t"], content["values"], bool(content["smooth"]))
    values = [_value(each) for each in content]
    return tuple(values) if kind == "range" else values

"""Which variables an FMU has, in which order (one value reference for FMI and C); what it was asked
for: settings and words about the model.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from functools import cached_property
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

import casadi as ca

from ..core.errors import ExportError, InputError, UnknownNameError, require_positive
from ..core.quantities import largest_usual
from ..core.units import display_unit, per_second
from ..core.variables import Variable

if TYPE_CHECKING:
    from ..plants.plant import Plant

Role = Literal["time", "state", "derivative", "input", "parameter", "output"]
Type = Literal["Real", "Boolean", "Enumeration"]
Dependency = tuple[int, str]
"""Value reference of a known, and how an unknown depends on it (FMI's dependenciesKind)."""


@dataclass(frozen=True)
class Entry:
    """One variable of the FMU. ``variable`` gives unit, range and description."""

    reference: int
    name: str
    role: Role
    variable: Variable
    is_output: bool = False
    """In the sense of FMI: a state or an output of the plant that is shown as one."""
    is_calculated: bool = False
    """In the sense of FMI: an output that is a parameter, given by others."""
    boolean: bool = False
    """Not 0, or 0: a Boolean of FMI; variables with codes are enumerations."""
    begins: bool = False
    """An output of a block that holds its start value until the first sample."""

    @property
    def type(self) -> Type:
        """Of FMI 2."""
        return "Boolean" if self.boolean else "Enumeration" if self.variable.codes else "Real"


class Layout:
    """The variables of an FMU, numbered as in fmu/src/model.h, and what depends on what.

    groups : the variables by role, in the order of their references.
    shown : states and outputs to be outputs of the FMU, by default all; the others are local
        variables, which can be read but are not offered for connections.
    calculated : outputs that are calculated parameters.
    typed : roles whose variables with codes are enumerations; the others are numbers.

    Raises ExportError when a name is one that FMI needs.
    """

    sample_time: float | None = None
    """Of a sampled block [s]; None for a plant."""
    clock = False
    """Whether FMI 3 shows the samples' clock."""
    single = False
    """Whether numbers are of single precision (FMI 3)."""
    arrays: Mapping[int, tuple[str, int, int]] = MappingProxyType({})
    """{reference of the first entry: (name, rows, columns)} of parameters shown as one array."""

    def __init__(
        self,
        name: str,
        description: str,
        groups: Sequence[tuple[Role, tuple[Variable, ...]]],
        shown: frozenset[str] | None = None,
        calculated: frozenset[str] = frozenset(),
        typed: Sequence[Role] = (),
    ) -> None:
        self.name, self.description = name, description
        time = Variable("time", "input", unit="s", description="independent variable")
        numbered: list[tuple[Role, Variable]] = [("time", time)]
        numbered += [
            (role, replace(v, codes="") if v.codes and role not in typed else v)
            for role, variables in groups
            for v in variables
        ]
        self.entries = tuple(
            Entry(
                i,
                f"der({v.name})" if role == "derivative" else v.name,
                role,
                v,
                role in ("state", "output")
                and v.name not in calculated
                and (shown is None or v.name in shown),
                role == "output" and v.name in calculated,
            )
            for i, (role, v) in enumerate(numbered)
        )
        if sum(e.name == "time" for e in self.entries) > 1:
            raise ExportError(
                f"{name!r} has a variable named 'time'; FMI keeps this name for the independent "
                "variable: rename it"
            )

    @property
    def outputs(self) -> tuple[Entry, ...]:
        """What the FMU gives as outputs: states first."""
        return tuple(e for e in self.entries if e.is_output)

    @cached_property
    def within(self) -> dict[int, int]:
        """{reference of an entry of an array: that of the array}."""
        return {
            first + i: first
            for first, (_, rows, columns) in self.arrays.items()
            for i in range(rows * columns)
        }

    def of(self, role: Role) -> tuple[Entry, ...]:
        """All entries of a role, in order."""
        return tuple(e for e in self.entries if e.role == role)

    def variables(self, role: Role) -> tuple[Variable, ...]:
        """The variables of a role, in order."""
        return tuple(e.variable for e in self.of(role))

    def vector(self, role: Role, attribute: str) -> list[float]:
        """One attribute of all variables of a role; 0 for a start that is not given."""
        return [float(getattr(v, attribute) or 0.0) for v in self.variables(role)]

    @cached_property
    def dependencies(self) -> Mapping[int, tuple[Dependency, ...]]:
        """For each derivative and output: the states and inputs it depends on, and how."""
        raise NotImplementedError

    @cached_property
    def initial_dependencies(self) -> Mapping[int, tuple[Dependency, ...]]:
        """For each derivative and output: states, inputs and parameters it starts from."""
        raise NotImplementedError


class PlantLayout(Layout):
    """The variables of a plant's FMU."""

    def __init__(
        self,
        plant: Plant,
        shown: frozenset[str] | None = None,
        calculated: frozenset[str] = frozenset(),
        enumerations: bool = False,
    ) -> None:
        # outputs of a plant may change at any time, which those of FMI that are no reals may not
        typed: tuple[Role, ...] = ("input", "parameter") if enumerations else ()
        self.plant = plant
        groups: list[tuple[Role, tuple[Variable, ...]]] = [
            ("state", plant.states),
            ("derivative", tuple(_derivative(v) for v in plant.states)),
            ("input", plant.inputs),
            ("parameter", tuple(map(_bounded, plant.parameters))),
            ("output", plant.outputs),
        ]
        super().__init__(plant.name, plant.description, groups, shown, calculated, typed)

    @cached_property
    def unknowns(self) -> ca.SX:
        """Derivatives and outputs as one column, in the order of their references."""
        plant = self.plant
        xdot, y, _ = plant.function(plant.x, plant.u, plant.p)
        return ca.SX(ca.vertcat(xdot, y))

    @cached_property
    def dependencies(self) -> dict[int, tuple[Dependency, ...]]:
        """For each derivative and output: the states and inputs it depends on, and how."""
        plant = self.plant
        knowns = [*self.of("state"), *self.of("input")]
        tunable = {e.name for e in self.of("parameter") if e.variable.tunable}
        fixed = {e.name for e in self.of("parameter")} - tunable
        jacobian = ca.jacobian(self.unknowns, ca.vertcat(plant.x, plant.u))

        def kind(element: ca.SX) -> str:
            names = {s.name() for s in ca.symvar(element)}
            if not names:
                return "constant"
            if names <= fixed:
                return "fixed"
            return "tunable" if names <= fixed | tunable else "dependent"

        return {
            unknown.reference: tuple(
                (knowns[column].reference, kind(jacobian[row, column]))
                for column in _columns(jacobian, row)
            )
            for row, unknown in enumerate([*self.of("derivative"), *self.of("output")])
        }

    @cached_property
    def initial_dependencies(self) -> dict[int, tuple[Dependency, ...]]:
        """For each derivative and output: states, inputs and parameters it starts from."""
        plant = self.plant
        parameters = self.of("parameter")
        jacobian = ca.jacobian(self.unknowns, plant.p)
        found = {}
        for row, unknown in enumerate([*self.of("derivative"), *self.of("output")]):
            known = [
                (reference, "constant" if kind == "constant" else "dependent")
                for reference, kind in self.dependencies[unknown.reference]
            ]
            known += [
                (
                    parameters[column].reference,
                    "constant" if jacobian[row, column].is_constant() else "dependent",
                )
                for column in _columns(jacobian, row)
            ]
            found[unknown.reference] = tuple(known)
        return found


def _columns(matrix: ca.SX, row: int) -> list[int]:
    """Columns of the structural non-zeros of a row, rising."""
    return sorted(int(c) for c in matrix[row, :].sparsity().get_col()) if matrix.numel() else []


_FAR = 100.0


def _bounded(parameter: Variable) -> Variable:
    """The parameter with a largest value far beyond any usual one, where it has none: a pressure in
    Pa typed as one in uPa is refused by the FMU, too.
    """
    if math.isfinite(parameter.max):
        return parameter
    usual = largest_usual(parameter.unit) or _FAR * _FAR * parameter.nominal
    most = max(usual, _FAR * parameter.nominal, _FAR * abs(parameter.start or 0.0))
    bounded = copy(parameter)  # made anew, it would doubt this bound as a value far from usual ones
    object.__setattr__(bounded, "max", 10.0 ** math.ceil(math.log10(most) - 1e-9))
    return bounded


def _derivative(state: Variable) -> Variable:
    unit = per_second(state.unit)
    return Variable(
        state.name,
        "output",
        unit=unit,
        nominal=state.nominal,
        display_unit=display_unit(unit),
        description=f"time derivative of {state.name}",
    )


FmiVersion = Literal["2.0", "3.0"]
EXCHANGE_FRACTION = 1e-2
"""The tolerance proposed to an importer's own solver, as a part of that of Co-Simulation.

A multistep solver such as CVODE holds the error of one step to its tolerance; over the steps of an
oscillation errors add up to some 50 (20 .. 400) times that.
"""
LEAST_PROPOSED = 1e-9
"""Below, importers' limits on the number of steps break a simulation off."""


@dataclass(frozen=True)
class Settings:
    """What an export was asked for, checked."""

    fmi: str
    tolerance: float
    step_size: float
    fixed_step: float
    stop_time: float
    about: Mapping[str, str]
    """Author, version, copyright, license and date of the model, where they are said."""

    @property
    def proposed_tolerance(self) -> float:
        """What DefaultExperiment says, so that Model Exchange comes near to Co-Simulation."""
        return max(self.tolerance * EXCHANGE_FRACTION, min(self.tolerance, LEAST_PROPOSED))


def checked(
    fmi: str,
    step_size: float,
    tolerance: float,
    fixed_step: float | None,
    stop_time: float,
    about: Mapping[str, str] | None = None,
) -> Settings:
    """The settings of an export. Raises InputError, UnknownNameError."""
    if fmi not in ("2.0", "3.0"):
        raise UnknownNameError("FMI version", fmi, ("2.0", "3.0"))
    step_size = require_positive("step_size", step_size, "s")
    stop_time = require_positive("stop_time", stop_time, "s")
    if not 1e-11 <= require_positive("tolerance", tolerance) <= 1e-2:
        raise InputError(f"tolerance = {tolerance:g} must lie in 1e-11 .. 1e-2")
    fixed = 0.0 if fixed_step is None else require_positive("fixed_step", fixed_step, "s")
    return Settings(fmi, float(tolerance), float(step_size), fixed, float(stop_time), about or {})


def checked_about(
    author: str | None,
    version: str | None,
    copyright: str | None,
    license: str | None,
    date: str | datetime | None,
) -> dict[str, str]:
    """What is said of the model, for its description. Raises InputError."""
    said = {"author": author, "version": version, "copyright": copyright, "license": license}
    for name, text in said.items():
        if text is not None and (not isinstance(text, str) or not text.isprintable()):
            raise InputError(f"{name} = {text!r}: give one line of text")
    found = {name: text for name, text in said.items() if text}
    if date is not None:
        try:
            moment = date if isinstance(date, datetime) else datetime.fromisoformat(date)
        except (TypeError, ValueError):
            raise InputError(
                f"date = {date!r}: give a datetime or ISO 8601, such as '2026-03-01T12:00:00Z'"
            ) from None
        moment = moment if moment.tzinfo else moment.replace(tzinfo=timezone.utc)
        found["date"] = moment.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ")
    return found

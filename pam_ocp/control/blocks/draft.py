"""A block under way: variables are entered one by one and come back as symbols."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ...core import units
from ...core.block import Block
from ...core.errors import InputError, require_positive
from ...core.variables import Variable
from ...plants.inversion import Inversion
from ...plants.plant import Plant
from ..kinds import ACTIVE, BEFORE, ESTIMATE, HELD_BACK, LARGEST, LIMITED, SENT, Array

Symbol: TypeAlias = Any
"""SX or MX."""


def kind_of_step(*laws: Block) -> Any:
    """SX where the steps of all these blocks are made of it, else MX."""
    return ca.SX if all(law.step.is_a("SXFunction") for law in laws) else ca.MX


class Draft:
    """Collects the variables of a block, and what becomes of its memory.

    kind : ca.SX, or ca.MX for laws that call functions with loops or look tables up.
    """

    def __init__(self, name: str, sample_time: float, description: str, kind: Any = ca.SX) -> None:
        self.name, self.description = name, description
        self.sample_time = require_positive("sample_time", sample_time, "s")
        self.kind = kind
        self._kept: dict[str, dict[str, tuple[Sequence[Variable], Symbol]]] = {
            causality: {} for causality in ("state", "input", "parameter")
        }
        self._next: dict[str, Symbol] = {}
        self._outputs: list[tuple[Sequence[Variable], Symbol]] = []
        self._commands: list[str] = []
        self._missing: list[str] = []
        self._matrices: dict[str, tuple[int, int]] = {}
        self.loops: dict[str, int] = {}

    def column(self, variables: Sequence[Variable]) -> Symbol:
        """States, inputs or parameters as one column of symbols, known by the name of the first."""
        if not variables:
            return self.kind.zeros(0, 1)
        name, entered = variables[0].name, self._kept[variables[0].causality]
        if name not in entered:
            entered[name] = variables, self.kind.sym(name, len(variables))
        return entered[name][1]

    def call(self, law: Block, inputs: Symbol, prefix: str = "") -> tuple[Symbol, Symbol, Symbol]:
        """(memory, the memory after it, outputs) of a step of another block, whose memory and
        parameters become this block's.
        """
        memory, gains = (
            self.column([replace(v, name=prefix + v.name) for v in part])
            for part in (law.memory, law.parameters)
        )
        after, outputs = law.step.call([memory, inputs, gains])
        if law.memory:
            self.next(prefix + law.memory[0].name, after)
        self._matrices |= {prefix + name: size for name, size in law.matrices.items()}
        return memory, after, outputs

    # ---- variables ----------------------------------------------------------------------------
    def input(self, name: str, start: float = 0.0, missing: bool = False, **about: Any) -> Symbol:
        """A measurement or a reference. missing : NaN is understood by the law itself."""
        if missing:
            self._missing.append(name)
        return self.column([Variable(name, "input", start=start, **about)])

    def like(self, variable: Variable, prefix: str = "", **more: Any) -> Symbol:
        """The input that measures (or prescribes) a variable of a plant: no range, it may err."""
        start = variable.start or 0.0
        return self.input(prefix + variable.name, start, **about(variable), **more)

    def wanted(self, variable: Variable, start: float, first: str = "wanted") -> Symbol:
        """The input ``wanted.NAME``: what a variable of a plant is to reach."""
        words = f"to be reached: {variable.description}"
        return self.input(f"{first}.{variable.name}", start, **about(variable, words))

    def measured(self, variables: Iterable[Variable], prefix: str = "", **more: Any) -> Symbol:
        """Inputs that measure these, as a column."""
        return column_of(self.kind, [self.like(v, prefix, **more) for v in variables])

    def parameter(self, name: str, value: float, **about: Any) -> Symbol:
        """A number that may be tuned."""
        if not np.isfinite(value):
            raise InputError(f"{self.name}: parameter {name} = {value} must be finite")
        start = float(value)
        return self.column([Variable(name, "parameter", start=start, tunable=True, **about)])

    def parameters(
        self, name: str, variables: Iterable[Variable], values: Iterable[float], words: str
    ) -> Symbol:
        """Values of variables of a plant, each a parameter ``name.VARIABLE``, as a column."""
        pairs = zip(variables, values, strict=True)
        entries = [
            self.parameter(f"{name}.{v.name}", float(value), **about(v, f"{v.name} {words}"))
            for v, value in pairs
        ]
        return column_of(self.kind, entries)

    def matrix(
        self,
        name: str,
        values: Array,
        rows: Iterable[Variable],
        columns: Iterable[Variable],
        times: str = "1",
    ) -> Symbol:
        """A matrix of gains, each a parameter ``name.row.column``.

        times : unit of what the columns are multiplied with ("s" for integrals).
        """
        right = list(columns)
        entries = [
            [
                self.parameter(
                    f"{name}.{r.name}.{c.name}",
                    float(v),
                    unit=per(r.unit, c.unit, times),
                    description=f"gain of {r.name} over {c.name}",
                )
                for c, v in zip(right, line, strict=True)
            ]
            for r, line in zip(rows, np.atleast_2d(values), strict=True)
        ]
        if not right or not entries:
            return self.kind.zeros(len(entries), len(right))
        self._matrices[name] = len(entries), len(right)
        return ca.vertcat(*(ca.horzcat(*line) for line in entries))

    def memory(self, name: str, start: float = 0.0, **about: Any) -> Symbol:
        """A number that is carried to the next step; it stays as it is unless ``next`` is told."""
        return self.column([Variable(name, "state", start=float(start), **about)])

    @property
    def started(self) -> Symbol:
        """The memory that is 0 in the first step and 1 after it."""
        self.next("started", self.kind(1))
        return self.memory("started", description="1 after the first step")

    def next(self, name: str, value: Symbol) -> None:
        """What the memory ``name``, or the column that begins with it, is in the next step."""
        self._next[name] = value

    def memories(self, start: Array, description: str, name: str = "w") -> Symbol:
        """A column that is carried to the next step, its entries named w1, w2, ..."""
        return self.column(
            [
                Variable(f"{name}{i + 1}", "state", start=float(value), description=description)
                for i, value in enumerate(start)
            ]
        )

    def remembered(
        self,
        name: str,
        variables: Iterable[Variable],
        words: str,
        starts: Iterable[float] = itertools.repeat(0.0),
        plain: bool = False,
    ) -> Symbol:
        """A column of memories ``name.VARIABLE``. plain : without the units of the variables."""
        return self.column(
            [
                Variable(
                    f"{name}.{v.name}",
                    "state",
                    start=start,
                    **({"description": words} if plain else about(v, words)),
                )
                for v, start in zip(variables, starts, strict=False)
            ]
        )

    def delayed(self, variable: Variable, value: Symbol, delay: int) -> Symbol:
        """A command as it was sent ``delay`` samples ago."""
        for k in range(1, delay + 1):
            name, words = f"{variable.name}{BEFORE}{k}", about(variable, "sent, acts later")
            waits = self.memory(name, variable.start or 0.0, **words)
            self.next(name, value)
            value = waits
        return value

    def output(self, variable: Variable, value: Symbol, command: bool = False) -> None:
        """An output. command : it drives a plant."""
        self.outputs([variable], value, [variable.name] if command else [])

    def outputs(
        self, variables: Sequence[Variable], values: Symbol, commands: Iterable[str] = ()
    ) -> None:
        """A column of outputs. commands : those of them that drive a plant."""
        self._outputs.append((variables, values))
        self._commands += commands

    def estimate(self, variable: Variable, value: Symbol) -> None:
        """The output ``estimate.NAME`` of a variable of a plant."""
        words = about(variable, f"estimated: {variable.description}")
        self.output(Variable(ESTIMATE + variable.name, "output", **words), value)

    def deviation(self, variable: Variable, value: Symbol) -> None:
        """The output ``deviation.NAME``, standard deviation of an estimate."""
        name, words = f"deviation.{variable.name}", about(variable, "")
        self.output(Variable(name, "output", min=0.0, start=0.0, **words), value)

    def repeats(self, what: str, count: int) -> None:
        """What is done ``count`` times in a step, besides what was told before."""
        self.loops[what] = self.loops.get(what, 0) + count

    # ---- what the guard tells -------------------------------------------------------------------
    @property
    def active(self) -> Symbol:
        """1 while the law's own commands acted."""
        return self.input(ACTIVE, 1.0, description="1 while the law's own commands acted")

    @property
    def limited(self) -> Symbol:
        """1 where the last command was not what was asked for."""
        return self.input(LIMITED, 0.0, description="1 where a limit acted on the last command")

    @property
    def held_back(self) -> Symbol:
        """1 where a limit that the law cannot know acted on the last command."""
        description = "1 where a rate or a narrower range acted on the last command"
        return self.input(HELD_BACK, 0.0, description=description)

    def sent(self, variables: Iterable[Variable]) -> Symbol:
        """The commands that acted since the last step, as a column."""
        return self.measured(variables, SENT)

    # ---- of plants with valves ---------------------------------------------------------------
    def send(
        self,
        inversion: Inversion | None,
        inner: Sequence[Variable],
        u: Symbol,
        known: tuple[Symbol, Symbol] | None = None,
    ) -> None:
        """The commands of chosen inputs: for openings those that give them.

        known : parameters and states of the plant, where the block has them.
        """
        if not inversion:
            for i, variable in enumerate(inner):
                self.output(as_output(variable), u[i], command=True)
            return
        self.drive(inversion, {v.name: u[i] for i, v in enumerate(inner)}, known)

    def drive(
        self,
        inversion: Inversion,
        chosen: Mapping[str, Symbol],
        known: tuple[Symbol, Symbol] | None = None,
    ) -> None:
        """The commands of inputs by inner name; those that are there already stay as they are."""
        there = set(self._commands)
        for variable, value in sent_by(inversion, chosen, known or beside(inversion, self)):
            if variable.name not in there:
                self.output(as_output(variable), value, command=True)

    def states(self, inversion: Inversion | None, variables: Iterable[Variable]) -> Symbol:
        """Measured states as a column, those of spools as they count in openings."""
        x = self.measured(variables)
        if inversion is None or inversion.exact:
            return x
        return inversion.entering()(x, inversion.plant.vector("parameter"))

    def block(self) -> Block:
        """The block, once all is entered."""
        kept = [list(entered.values()) for entered in self._kept.values()]
        memory, inputs, parameters, outputs = (
            tuple(v for column, _ in part for v in column) for part in (*kept, self._outputs)
        )
        after = [self._next.get(column[0].name, symbol) for column, symbol in kept[0]]
        results = [
            column_of(self.kind, column)
            for column in (after, [value for _, value in self._outputs])
        ]
        return Block(
            name=self.name,
            sample_time=self.sample_time,
            inputs=inputs,
            outputs=outputs,
            parameters=parameters,
            memory=memory,
            step=self._step([[symbol for _, symbol in part] for part in kept], results),
            description=self.description,
            commands=tuple(self._commands),
            missing=tuple(self._missing),
            loops=self.loops,
            matrices=self._matrices,
        )

    def _step(self, groups: list[list[Symbol]], results: list[Symbol]) -> ca.Function:
        names = ["memory", "inputs", "parameters"], ["memory_next", "outputs"]
        if self.kind is ca.SX:
            columns = [column_of(ca.SX, group) for group in groups]
            return ca.Function("step", columns, results, *names, {"cse": True})
        symbols = [s for group in groups for s in group]
        law = ca.Function("law", symbols, results)
        sizes = [[s.numel() for s in group] for group in groups]
        columns = [ca.MX.sym(n, sum(size)) for n, size in zip(names[0], sizes, strict=True)]
        entries = [
            e
            for c, size in zip(columns, sizes, strict=True)
            if size
            for e in ca.vertsplit(c, np.cumsum([0, *size]).tolist())
        ]
        return ca.Function("step", columns, law.call(entries, True, False), *names)


def column_of(kind: Any, entries: list[Symbol]) -> Symbol:
    """Entries below each other, dense; without any a column of no rows."""
    return ca.densify(ca.vertcat(*entries)) if entries else kind.zeros(0, 1)


def as_output(variable: Variable) -> Variable:
    """An input of a plant as the command that a block gives."""
    v = variable
    return Variable(v.name, "output", start=v.start, min=v.min, max=v.max, **about(v))


def about(variable: Variable, description: str | None = None) -> dict[str, Any]:
    """What a variable of a block takes over from one of a plant that it stands for."""
    words = variable.description if description is None else description
    return {"unit": variable.unit, "nominal": variable.nominal, "description": words}


def sent_by(
    inversion: Inversion, chosen: Mapping[str, Symbol], known: tuple[Symbol, Symbol]
) -> list[tuple[Variable, Symbol]]:
    """(input of the plant, value) of inputs by inner name, openings through their inverse.

    known : parameters and states of the plant.
    """
    plant, (p, x) = inversion.plant, known
    results: list[tuple[Variable, Symbol]] = []
    for name, value in chosen.items():
        opening = inversion.opening_of(name)
        if opening is None:
            results.append((plant.variable(name), value))
            continue
        sent = inversion.inverse(opening)(value, p, x)
        commands = inversion.commands_of(opening)
        results += [(plant.variable(c), sent[i]) for i, c in enumerate(commands)]
    return results


def beside(inversion: Inversion, draft: Draft) -> tuple[Symbol, Symbol]:
    """Parameters and states of the plant, these measured where an opening needs them beside its
    commands.
    """
    plant = inversion.plant
    p, x = plant.vector("parameter"), ca.DM([v.start or 0.0 for v in plant.states])
    return p, draft.measured(plant.states) if inversion.by_states else x


def opened_by(
    inversion: Inversion | None,
    plant: Plant,
    draft: Draft,
    known: tuple[Symbol, Symbol] | None = None,
) -> dict[str, Symbol]:
    """{inner input: value} that the commands sent since the last step gave; known : see send."""
    controls = [v for v in plant.inputs if not v.disturbance]
    sent = draft.sent(controls)
    named = {v.name: sent[i] for i, v in enumerate(controls)}
    if not inversion:
        return named
    inner: dict[str, Symbol] = {}
    p, x = known or beside(inversion, draft)
    for variable in inversion.inner.inputs:
        opening = inversion.opening_of(variable.name)
        if opening is None:
            if variable.name in named:
                inner[variable.name] = named[variable.name]
            continue
        commands = ca.vertcat(*(named[c] for c in inversion.commands_of(opening)))
        inner[variable.name] = inversion.forward(opening)(commands, p, x)
    return inner


def per(unit: str, *others: str) -> str:
    """The unit of a ratio; "1" for one that has no plain name."""
    above: list[str] = []
    below: list[str] = []
    for text, ends in ((unit, (above, below)), *((o, (below, above)) for o in others)):
        for part, end in zip(text.split("/"), ends, strict=False):
            end += [p for p in part.strip("()").split(".") if p != "1"]
    for p in [p for p in above if p in below]:
        if p in below:
            above.remove(p)
            below.remove(p)
    under = ".".join(below)
    divided = [f"({under})" if len(below) > 1 else under] if below else []
    name = "/".join([".".join(above) or "1", *divided])
    try:
        units.unit(name)
    except InputError:
        return "1"
    return name


def clipped(column: Symbol, low: Iterable[float], high: Iterable[float]) -> Symbol:
    """Each entry within its range; an open end is no operation (in C it would be an infinity)."""
    within = []
    for entry, least, most in zip(ca.vertsplit(column), low, high, strict=True):
        value = ca.fmax(entry, float(least)) if np.isfinite(least) else entry
        within.append(ca.fmin(value, float(most)) if np.isfinite(most) else value)
    return ca.vertcat(*within)


def compensated(total: Symbol, carry: Symbol, more: Symbol) -> tuple[Symbol, Symbol]:
    """(total, carry) of a sum that goes on for days, without the rounding of each addition.

    The value is total + carry. W. Kahan, Communications of the ACM 8 (1965) 40.
    """
    wanted = more + carry
    after = ca.fmin(total + wanted, LARGEST)  # without it CasADi takes (a + b) - a for b
    return after, wanted - (after - total)


def least_norm(matrix: Symbol, right: Symbol) -> Symbol:
    """The z nearest to matrix z = right; 0 for columns that are zero."""
    rows, columns = matrix.shape
    m, r = ca.SX.sym("m", rows, columns), ca.SX.sym("r", rows)
    sizes = [ca.sqrt(ca.sumsqr(m[:, j])) for j in range(columns)]
    scales = [1 / ca.if_else(size > 0, size, 1) for size in sizes]
    even = ca.horzcat(*(m[:, j] * scales[j] for j in range(columns)))
    square = ca.mtimes(even.T, even) + 1e-14 * ca.SX.eye(columns)
    z = ca.solve(square, ca.mtimes(even.T, r)) * ca.vertcat(*scales)
    return ca.Function("least_norm", [m, r], [z], {"cse": True})(matrix, right)

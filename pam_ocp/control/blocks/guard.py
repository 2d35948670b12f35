"""What every block has in common: missing measurements, limits, and switching on and off.

Put once around the law of a block, in the same equations for Python, C and FMU:

- a measurement that is NaN or infinite is replaced by the last good one for ``hold_samples``
  samples; after that, and before the first one, the commands are the safe ones;
- while ``enable`` is below 0.5 the commands are the safe ones, too, and the law goes on watching;
- back in action the commands begin where they stand: integrals follow what was sent meanwhile, and
  the difference that is left fades with the time constant ``fade_time``;
- commands keep their range and, where asked for, their largest rate;
- an answer that is no number is not sent: the last command stays, and the memory does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import InputError, UnknownNameError, require_count, require_positive
from ...core.variables import Causality, Variable
from ..kinds import ACTIVE, HELD_BACK, LARGEST, LIMITED, SENT
from .draft import Draft, Symbol, column_of, kind_of_step, per

Symbols: TypeAlias = "dict[str, ca.SX]"

STATUS = {
    1: "off (enable < 0.5)",
    2: "a measurement is missing",
    4: "missing for too long: safe commands",
    8: "a command is at an end of its range",
    16: "a command is at its largest rate",
    32: "the law gave no number: the last commands stay",
}
"""Bits of the output ``status``; 0 where all is well."""
FLAGS = {1: "off", 2: "missing", 4: "lost", 8: "at_range", 16: "at_rate", 32: "no_number"}
"""Their names, where each is a Boolean of its own."""

ROUNDING = 1e-9
"""A command so little beyond its range, scaled by nominals, was not limited."""
NEVER = 1e6
"""Age [samples] of a measurement that never was; ages grow no further."""


@dataclass(frozen=True)
class Guard:
    """What is asked of the guard.

    limits : {command: (low, high)} [SI], where they differ from the command's own range.
    rates : {command: largest rate [SI per s]}; none by default.
    safe : {command: value sent while off or blind} [SI]; those not named stay as they are.
    hold : samples for which the last good measurement stands in for a missing one.
    fade_time : [s], of what is left of the step at switching on.

    Examples
    --------
    >>> guard = pam.control.Guard(rates={"muscle.command": 2e6}, hold=5)
    >>> guard.hold, guard.rates
    (5, {'muscle.command': 2000000.0})
    """

    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rates: Mapping[str, float] = field(default_factory=dict)
    safe: Mapping[str, float] = field(default_factory=dict)
    hold: int = 10
    fade_time: float = 0.05


def guarded(law: Block, guard: Guard | None = None) -> Block:
    """The block with the guard around its law.

    Raises InputError for a command without a finite range, and for names that are no commands.
    """
    return _Guarded(law, guard or Guard()).block()


class _Guarded:
    def __init__(self, law: Block, guard: Guard) -> None:
        self.law, self.guard = law, guard
        require_count("hold", guard.hold, 0)
        require_positive("fade_time", guard.fade_time, "s", zero=True)
        self.commands = [v for v in law.outputs if v.name in law.commands]
        for argument in ("limits", "rates", "safe"):
            for name in getattr(guard, argument):
                if name not in law.commands:
                    raise UnknownNameError(f"command ({argument})", name, law.commands)
        told = {ACTIVE, LIMITED, HELD_BACK, *(SENT + v.name for v in self.commands)}
        self.inputs = [v for v in law.inputs if v.name not in told]
        self.told = [v for v in law.inputs if v.name in told]
        self.ranges = {v.name: self._range(v) for v in self.commands}
        self._kept: dict[Causality, dict[str, Variable]] = {"state": {}, "parameter": {}}
        self._declare()

    def _range(self, command: Variable) -> tuple[float, float]:
        name = command.name
        given = self.guard.limits.get(name, (command.min, command.max))
        if not isinstance(given, tuple | list) or len(given) != 2:
            raise InputError(f"limits[{name!r}] = {given!r}: give (lowest, highest)")
        low, high = (command.number(v, "limit") for v in given)
        if not (np.isfinite(low) and np.isfinite(high) and low < high):
            raise InputError(
                f"{self.law.name}: the command {name} may be anything between {low:g} and "
                f"{high:g}; give limits={{{name!r}: (lowest, highest)}}, finite and rising"
            )
        if low < command.min or high > command.max:
            raise InputError(
                f"limits[{name!r}] = {command.exactly(low)} .. {command.exactly(high)} goes "
                f"beyond the command's range {command.exactly(command.min)} .. "
                f"{command.exactly(command.max)}; give a part of it"
            )
        return low, high

    # ---- variables ----------------------------------------------------------------------------
    def _enter(self, name: str, causality: Causality, start: float, **about: Any) -> None:
        tunable = causality == "parameter"
        self._kept[causality][name] = Variable(
            name, causality, start=start, tunable=tunable, **about
        )

    def _declare(self) -> None:
        for v in self.inputs:
            about = {"unit": v.unit, "nominal": v.nominal}
            last = f"last good value of {v.name}"
            self._enter(f"held.{v.name}", "state", v.start or 0.0, description=last, **about)
            self._enter(f"age.{v.name}", "state", NEVER, description="samples since then")
        if self.inputs:
            self._enter(
                "hold_samples",
                "parameter",
                float(self.guard.hold),
                min=0.0,
                max=NEVER - 1,
                description="samples for which the last good measurement stands in",
            )
        for v in self.commands:
            self._declare_command(v)
        if self.commands:
            self._enter(
                "fade_time",
                "parameter",
                self.guard.fade_time,
                min=0.0,
                unit="s",
                description="of the step that is left at switching on",
            )
            self._enter("was_active", "state", 1.0, description="the law's commands acted")
            self._enter("was_limited", "state", 0.0, description="a limit acted on a command")
            self._enter("was_held_back", "state", 0.0, description="one that the law cannot know")

    def _declare_command(self, v: Variable) -> None:
        low, high = self.ranges[v.name]
        about = {"unit": v.unit, "nominal": v.nominal}
        begin = float(np.clip(v.start or 0.0, low, high))
        self._enter(f"sent.{v.name}", "state", begin, description="as last sent", **about)
        self._enter(f"fade.{v.name}", "state", 0.0, description="added after a switch", **about)
        self._enter(f"min.{v.name}", "parameter", low, description="lowest command", **about)
        self._enter(f"max.{v.name}", "parameter", high, description="highest command", **about)
        if v.name in self.guard.rates:
            unit = per(v.unit, "s")
            rate = require_positive(f"rates[{v.name!r}]", self.guard.rates[v.name], unit)
            self._enter(
                f"rate.{v.name}", "parameter", rate, min=0.0, unit=unit, description="largest rate"
            )
        if v.name in self.guard.safe:
            safe = v.number(self.guard.safe[v.name], "safe")
            if not low <= safe <= high:
                raise InputError(
                    f"safe[{v.name!r}] = {v.exactly(safe)} is outside {v.exactly(low)} .. "
                    f"{v.exactly(high)}; give a command within its range"
                )
            self._enter(
                f"safe.{v.name}", "parameter", safe, description="while off or blind", **about
            )

    # ---- equations ----------------------------------------------------------------------------
    def _columns(self) -> tuple[list[ca.SX], Symbols]:
        """Columns (guard's memory, inputs, enable, guard's parameters), and their entries."""
        memory, parameters = (list(self._kept[c]) for c in ("state", "parameter"))
        inputs = [v.name for v in self.inputs]
        columns = [
            ca.SX.sym(kind, len(names))
            for kind, names in (("m", memory), ("i", inputs), ("on", ["enable"]), ("p", parameters))
        ]
        named = {}
        for names, column in zip((memory, inputs, ["enable"], parameters), columns, strict=True):
            named.update({n: column[i] for i, n in enumerate(names)})
        return columns, named

    def _watch(self) -> ca.Function:
        """(memory, inputs, enable, parameters) -> (inputs of the law, held, ages, flags).

        flags : on, some measurement missing, one missing for too long.
        """
        columns, s = self._columns()
        seen, held, ages = {}, [], []
        missing, lost = ca.SX(0), ca.SX(0)
        for v in self.inputs:
            good = ca.fabs(s[v.name]) <= LARGEST
            value = ca.if_else(good, s[v.name], s[f"held.{v.name}"])
            age = ca.if_else(good, 0, ca.fmin(s[f"age.{v.name}"] + 1, NEVER))
            by_the_law = v.name in self.law.missing
            seen[v.name] = ca.if_else(good, s[v.name], ca.SX.nan()) if by_the_law else value
            held.append(value)
            ages.append(age)
            missing = ca.fmax(missing, ca.logic_not(good))
            lost = ca.fmax(lost, age > s["hold_samples"])
        for v in self.told:
            names = {ACTIVE: "was_active", LIMITED: "was_limited", HELD_BACK: "was_held_back"}
            seen[v.name] = s[names.get(v.name, v.name)]
        inner = [seen[v.name] for v in self.law.inputs]
        flags = ca.vertcat(s["enable"] >= 0.5, missing, lost)
        return ca.Function(
            "watch", columns, [_cat(inner), _cat(held), _cat(ages), flags], {"cse": True}
        )

    def _act(self) -> ca.Function:
        """(memory, inputs, enable, parameters, flags, law's memory is sound, law's outputs)
        -> (law gave numbers, sent, fade, was active, limited and held back, outputs)."""
        columns, s = self._columns()
        flags, sound = ca.SX.sym("flags", 3), ca.SX.sym("sound")
        outputs = ca.SX.sym("outputs", len(self.law.outputs))
        names = [v.name for v in self.law.outputs]
        asked = {v.name: outputs[names.index(v.name)] for v in self.commands}
        whole = sound
        for entry in asked.values():
            whole = ca.logic_and(whole, ca.fabs(entry) <= LARGEST)
        awake = ca.logic_and(flags[0], ca.logic_not(flags[2]))
        status = ca.logic_not(flags[0]) + 2 * flags[1] + 4 * flags[2] + 32 * ca.logic_not(whole)
        sent, fade, at_range, narrowed, at_rate = [], [], ca.SX(0), ca.SX(0), ca.SX(0)
        given = [outputs[i] for i in range(len(names))]
        for v in self.commands:
            value, left, ranged, rated = self._sent(v, s, asked[v.name], awake, whole)
            sent.append(value)
            fade.append(left)
            at_range, at_rate = ca.fmax(at_range, ranged), ca.fmax(at_rate, rated)
            if self.ranges[v.name] != (v.min, v.max):
                narrowed = ca.fmax(narrowed, ranged)
            given[names.index(v.name)] = value
        for i, v in enumerate(self.law.outputs):
            if v.name not in asked:  # an estimate or a status that is no number is not told either
                good = ca.fabs(outputs[i]) <= LARGEST
                given[i] = ca.if_else(good, outputs[i], v.start or 0.0)
        status += 8 * at_range + 16 * at_rate
        limited = [ca.fmax(at_range, at_rate), ca.fmax(narrowed, at_rate)]
        done = [ca.logic_and(awake, whole), *limited] if self.commands else []
        results = [whole, _cat(sent), _cat(fade), _cat(done), _cat([*given, status])]
        return ca.Function("act", [*columns, flags, sound, outputs], results, {"cse": True})

    def _sent(
        self, v: Variable, s: Symbols, asked: ca.SX, awake: ca.SX, whole: ca.SX
    ) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """(command sent, fade, at an end of its range, at its largest rate)."""
        time, last = self.law.sample_time, s[f"sent.{v.name}"]
        back = ca.logic_not(s["was_active"])  # the first sample in action again
        left = s[f"fade.{v.name}"] * (s["fade_time"] / (s["fade_time"] + time))
        fade = ca.if_else(back, last - asked, left)
        good = ca.logic_and(awake, whole)
        fade = ca.if_else(good, fade, 0)
        safe = ca.if_else(awake, last, s.get(f"safe.{v.name}", last))
        wanted = ca.if_else(good, asked + fade, safe)
        rated, value = ca.SX(0), wanted
        if f"rate.{v.name}" in s:
            step = s[f"rate.{v.name}"] * time
            value = ca.fmin(ca.fmax(wanted, last - step), last + step)
            rated = ca.fabs(wanted - value) > ROUNDING * v.nominal
        within = ca.fmin(ca.fmax(value, s[f"min.{v.name}"]), s[f"max.{v.name}"])
        return within, fade, ca.fabs(within - value) > ROUNDING * v.nominal, rated

    # ---- the block ------------------------------------------------------------------------------
    def block(self) -> Block:
        law = self.law
        clash = {v.name for v in (*self.inputs, *law.memory, *law.parameters, *law.outputs)} & {
            *(n for kept in self._kept.values() for n in kept),
            "enable",
            "status",
        }
        if clash:
            raise InputError(
                f"{law.name}: {min(clash)} is a name that the guard gives; is it guarded already? "
                "Then leave it as it is"
            )
        enable = Variable("enable", "input", start=1.0, min=0.0, max=1.0, description="1 on, 0 off")
        words = "; ".join(f"{bit} {word}" for bit, word in STATUS.items())
        status = Variable(
            "status", "output", start=0.0, min=0.0, max=63.0, description=f"sum of: {words}"
        )
        draft = Draft(law.name, law.sample_time, law.description, kind_of_step(law))
        given = self._stepped(draft, enable)
        draft.outputs([*(self._output(v) for v in law.outputs), status], given, law.commands)
        return replace(
            draft.block(),
            missing=tuple(v.name for v in self.inputs),
            loops=law.loops,
            delay=law.delay,
            flags={"enable": {}, "status": FLAGS},
        )

    def _output(self, v: Variable) -> Variable:
        if v.name not in self.ranges:
            return v
        low, high = self.ranges[v.name]
        return replace(v, min=low, max=high, start=self._kept["state"][f"sent.{v.name}"].start)

    def _stepped(self, draft: Draft, enable: Variable) -> Symbol:
        """The outputs; of the memories, whole columns, whose code stays short however much memory
        a law has.
        """
        law, kept = self.law, {c: list(of.values()) for c, of in self._kept.items()}
        draft.column(law.memory)
        draft.column(law.parameters)
        known = [
            draft.column(part) for part in (kept["state"], self.inputs, [enable], kept["parameter"])
        ]
        seen, held, ages, flags = self._watch().call(known)
        before, after, outputs = draft.call(law, seen)
        sound = ca.sum1(ca.fabs(after) <= LARGEST) == after.numel() if law.memory else draft.kind(1)
        rest: list[Any] = [*known, flags, sound, outputs]
        whole, sent, fade, done, given = self._act().call(rest)
        if law.memory:
            draft.next(law.memory[0].name, ca.if_else(whole, after, before))
        order = [f"held.{v.name}" for v in self.inputs] + [f"age.{v.name}" for v in self.inputs]
        order += [f"{part}.{v.name}" for part in ("sent", "fade") for v in self.commands]
        order += ["was_active", "was_limited", "was_held_back"] if self.commands else []
        places = [order.index(v.name) for v in kept["state"]]
        if places:
            draft.next(kept["state"][0].name, ca.vertcat(held, ages, sent, fade, done)[places])
        return given


def _cat(entries: list[ca.SX]) -> Any:
    return column_of(ca.SX, entries)

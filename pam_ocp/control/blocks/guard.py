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

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import InputError, UnknownNameError, require_count, require_positive
from ...core.variables import Variable
from ..kinds import ACTIVE, HELD_BACK, LARGEST, LIMITED, SENT
from .draft import Draft, Symbol, column_of, kind_of_step, per

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

GIVEN = {"enable", "status", "hold_samples", "fade_time"}
"""Names that the guard gives."""
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
    """The guard of a law, in whole columns: its code stays short however large the law is."""

    def __init__(self, law: Block, guard: Guard) -> None:
        self.law, self.guard = law, guard
        require_count("hold", guard.hold, 0)
        self.fade_time = require_positive("fade_time", guard.fade_time, "s", zero=True)
        self.commands = [v for v in law.outputs if v.name in law.commands]
        for argument in ("limits", "rates", "safe"):
            for name in getattr(guard, argument):
                if name not in law.commands:
                    raise UnknownNameError(f"command ({argument})", name, law.commands)
        clash = {v.name for v in (*law.inputs, *law.memory, *law.parameters, *law.outputs)} & GIVEN
        if clash:
            raise InputError(
                f"{law.name}: {min(clash)} is a name that the guard gives; is it guarded already? "
                "Then leave it as it is"
            )
        told = {ACTIVE, LIMITED, HELD_BACK} if self.commands else set()
        told |= {SENT + v.name for v in self.commands}
        self.inputs = [v for v in law.inputs if v.name not in told]
        self.ranges = {v.name: self._range(v) for v in self.commands}
        self.draft = Draft(law.name, law.sample_time, law.description, kind_of_step(law))

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

    def _safe(self, v: Variable) -> float:
        safe, (low, high) = v.number(self.guard.safe[v.name], "safe"), self.ranges[v.name]
        if not low <= safe <= high:
            raise InputError(
                f"safe[{v.name!r}] = {v.exactly(safe)} is outside {v.exactly(low)} .. "
                f"{v.exactly(high)}; give a command within its range"
            )
        return safe

    def _begin(self, v: Variable) -> float:
        """The command before the first sample."""
        return float(np.clip(v.start or 0.0, *self.ranges[v.name]))

    # ---- equations ----------------------------------------------------------------------------
    def block(self) -> Block:
        law, draft = self.law, self.draft
        draft.column(law.memory)
        draft.column(law.parameters)
        seen, missing, lost = self._watched()
        enable = Variable("enable", "input", start=1.0, min=0.0, max=1.0, description="1 on, 0 off")
        on = draft.column([enable]) >= 0.5
        known = seen | self._told()
        entries = [known[v.name] for v in law.inputs]
        before, after, outputs = draft.call(law, column_of(draft.kind, entries))
        given = [outputs[i] for i in range(len(law.outputs))]
        places = [i for i, v in enumerate(law.outputs) if v.name in law.commands]
        whole = ca.logic_and(_sound(after), _sound(outputs[places]))
        status = ca.logic_not(on) + 2 * missing + 4 * lost + 32 * ca.logic_not(whole)
        if places:
            awake = ca.logic_and(on, ca.logic_not(lost))
            sent, at_range, at_rate = self._sent(outputs[places], awake, whole)
            for i, place in enumerate(places):
                given[place] = sent[i]
            status += 8 * at_range + 16 * at_rate
        for i, v in enumerate(law.outputs):
            if i not in places:  # an estimate or a status that is no number is not told either
                good = ca.fabs(given[i]) <= LARGEST
                given[i] = ca.if_else(good, given[i], v.start or 0.0)
        if law.memory:
            draft.next(law.memory[0].name, ca.if_else(whole, after, before))
        draft.outputs(self._outputs(), column_of(draft.kind, [*given, status]), law.commands)
        return replace(
            draft.block(),
            missing=tuple(v.name for v in self.inputs),
            loops=law.loops,
            delay=law.delay,
            flags={"enable": {}, "status": FLAGS},
        )

    def _watched(self) -> tuple[dict[str, Symbol], Symbol, Symbol]:
        """(inputs of the law by name, whether a measurement is missing, one for too long)."""
        draft, inputs = self.draft, self.inputs
        if not inputs:
            return {}, draft.kind(0), draft.kind(0)
        x, first = draft.column(inputs), inputs[0].name
        starts, never = (v.start or 0.0 for v in inputs), itertools.repeat(NEVER)
        held = draft.remembered("held", inputs, "last good value", starts)
        age = draft.remembered("age", inputs, "samples since the last good value", never, True)
        words = "samples for which the last good measurement stands in"
        hold = draft.parameter(
            "hold_samples", self.guard.hold, min=0.0, max=NEVER - 1, description=words
        )
        good = ca.fabs(x) <= LARGEST
        value, now = ca.if_else(good, x, held), ca.if_else(good, 0, ca.fmin(age + 1, NEVER))
        draft.next(f"held.{first}", value)
        draft.next(f"age.{first}", now)
        by_the_law = ca.if_else(good, x, np.nan)
        seen = {
            v.name: (by_the_law if v.name in self.law.missing else value)[i]
            for i, v in enumerate(inputs)
        }
        return seen, ca.mmax(ca.logic_not(good)), ca.mmax(now > hold)

    def _last(self) -> Symbol:
        """The commands as they were last sent."""
        starts = map(self._begin, self.commands)
        return self.draft.remembered("sent", self.commands, "as last sent", starts)

    def _told(self) -> dict[str, Symbol]:
        """What became of the last commands, by the law's name for it."""
        if not self.commands:
            return {}
        last = self._last()
        told = {SENT + v.name: last[i] for i, v in enumerate(self.commands)}
        for name, start, words in (
            (ACTIVE, 1.0, "the law's commands acted"),
            (LIMITED, 0.0, "a limit acted on a command"),
            (HELD_BACK, 0.0, "one that the law cannot know"),
        ):
            told[name] = self.draft.memory(f"was_{name}", start, description=words)
        return told

    def _sent(self, asked: Symbol, awake: Symbol, whole: Symbol) -> tuple[Symbol, Symbol, Symbol]:
        """(commands sent, whether one is at an end of its range, one at its largest rate)."""
        draft, commands, last = self.draft, self.commands, self._last()
        first, nominal = commands[0].name, ca.DM([v.nominal for v in commands])
        words = "of the step that is left at switching on"
        fade_time = draft.parameter(
            "fade_time", self.fade_time, min=0.0, unit="s", description=words
        )
        fading = draft.remembered("fade", commands, "added after a switch")
        back = ca.logic_not(draft.memory(f"was_{ACTIVE}"))  # the first sample in action again
        left = fading * (fade_time / (fade_time + self.law.sample_time))
        good = ca.logic_and(awake, whole)
        fade = ca.if_else(good, ca.if_else(back, last - asked, left), 0)
        safe = ca.if_else(awake, last, self._safe_commands(last))
        wanted = ca.if_else(good, asked + fade, safe)
        value = ca.vertcat(*(self._slewed(v, wanted[i], last[i]) for i, v in enumerate(commands)))
        low, high = zip(*(self.ranges[v.name] for v in commands), strict=True)
        least = draft.parameters("min", commands, low, "at least")
        sent = ca.fmin(ca.fmax(value, least), draft.parameters("max", commands, high, "at most"))
        at_range = ca.fabs(sent - value) > ROUNDING * nominal
        at_rate = ca.mmax(ca.fabs(wanted - value) > ROUNDING * nominal)
        narrow = ca.DM([self.ranges[v.name] != (v.min, v.max) for v in commands])
        draft.next(f"sent.{first}", sent)
        draft.next(f"fade.{first}", fade)
        draft.next(f"was_{ACTIVE}", good)
        draft.next(f"was_{LIMITED}", ca.fmax(ca.mmax(at_range), at_rate))
        draft.next(f"was_{HELD_BACK}", ca.fmax(ca.mmax(at_range * narrow), at_rate))
        return sent, ca.mmax(at_range), at_rate

    def _safe_commands(self, last: Symbol) -> Symbol:
        """Those to be sent while off or blind; the last ones of what has none."""
        chosen = [v for v in self.commands if v.name in self.guard.safe]
        values = self.draft.parameters(
            "safe", chosen, map(self._safe, chosen), "while off or blind"
        )
        named = {v.name: values[i] for i, v in enumerate(chosen)}
        return ca.vertcat(*(named.get(v.name, last[i]) for i, v in enumerate(self.commands)))

    def _slewed(self, v: Variable, wanted: Symbol, last: Symbol) -> Symbol:
        """A command within its largest rate."""
        if v.name not in self.guard.rates:
            return wanted
        unit, words = per(v.unit, "s"), "largest rate"
        rate = require_positive(f"rates[{v.name!r}]", self.guard.rates[v.name], unit)
        most = self.draft.parameter(f"rate.{v.name}", rate, min=0.0, unit=unit, description=words)
        step = most * self.law.sample_time
        return ca.fmin(ca.fmax(wanted, last - step), last + step)

    def _outputs(self) -> list[Variable]:
        words = "; ".join(f"{bit} {word}" for bit, word in STATUS.items())
        status = Variable(
            "status", "output", start=0.0, min=0.0, max=63.0, description=f"sum of: {words}"
        )
        outputs = []
        for v in self.law.outputs:
            if v.name in self.ranges:
                low, high = self.ranges[v.name]
                v = replace(v, min=low, max=high, start=self._begin(v))
            outputs.append(v)
        return [*outputs, status]


def _sound(column: Symbol) -> Symbol:
    """Whether all entries are numbers."""
    return ca.sum1(ca.fabs(column) <= LARGEST) == column.numel()

"""Chains: blocks that feed each other become one block with one step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.errors import InputError, UnknownNameError, require_count, with_kinds
from ...core.stop import turns
from ...core.units import unit
from ...core.variables import Variable
from ..kinds import ESTIMATE, SENT, law_of
from .draft import Draft, Symbol, about, column_of, kind_of_step


@with_kinds
@turns
def chain(
    parts: Sequence[Any],
    connections: Mapping[str, str] | None = None,
    *,
    name: str = "chain",
    description: str = "",
    delay: int | None = None,
) -> Block:
    """Several blocks as one: in each step they are called in their order.

    parts : Blocks, or controllers, whose laws alone are taken; each has a name of its own.
    connections : {"PART.INPUT": "PART.OUTPUT"}. An output of the same or of a later part counts
        with its value of the step before. Without a connection an input takes the output of its own
        name, or ``estimate.NAME``, of the nearest part before it; where there is none it is an
        input of the chain, shared by all parts that have it.
    delay : samples after which commands act (``closed_loop(delay=)``; 1 in a system of
        ``export_ssp``): estimators take the commands sent so much before. By default what a part,
        such as an ``Mpc(delay=1)``, is designed for.

    Parameters and memory get the part's name in front, outputs only where two have one name. What
    another part takes drives no plant any more: it is no command of the chain. The chain has no
    guard yet: ``pam_ocp.control.block(chain)`` puts one around it.

    Raises InputError for sample times or units that differ, UnknownNameError for names.

    Examples
    --------
    >>> filter = pam.control.kalman(plant, point, measured={"x": 1e-5}, sample_time=2e-3)
    >>> law = pam.lqr(plant, point, sample_time=2e-3)
    >>> whole = pam.control.chain([filter, law], name="lqg")
    >>> whole.name
    'lqg'
    """
    if not isinstance(parts, Sequence) or not parts:
        raise InputError("chain: parts has none; give a list of blocks or controllers")
    blocks = [law_of(part) for part in parts]
    waits = max(b.delay for b in blocks) if delay is None else require_count("delay", delay, 0)
    blocks = [with_delay(b, waits) for b in blocks]
    return replace(_Chain(blocks, dict(connections or {}), name, description).block(), delay=waits)


def with_delay(law: Block, delay: int) -> Block:
    """The law for commands that act ``delay`` samples after they are sent: what sends none itself,
    an estimator, takes those sent so much before. Raises InputError for a law of another delay.
    """
    if law.delay == delay:
        return law
    if law.delay:
        raise InputError(
            f"delay = {delay}: {law.name} is designed for delay = {law.delay}; give that"
        )
    sent = [v for v in law.inputs if v.name.startswith(SENT)]
    if law.commands or not sent:
        return replace(law, delay=delay)
    draft = Draft(law.name, law.sample_time, law.description, kind_of_step(law))
    entries = dict(zip(law.inputs, ca.vertsplit(draft.column(law.inputs)), strict=True))
    for v in sent:
        entries[v] = draft.delayed(v, entries[v], delay)
    _, _, outputs = draft.call(law, ca.vertcat(*entries.values()))
    draft.outputs(law.outputs, outputs)
    made = draft.block()
    return replace(law, memory=made.memory, step=made.step, delay=delay)


class _Chain:
    def __init__(
        self, blocks: list[Block], connections: dict[str, str], name: str, description: str
    ) -> None:
        self.blocks, self.name = blocks, name
        self.description = description or ", then ".join(b.description or b.name for b in blocks)
        names = [b.name for b in blocks]
        twice = next((n for n in names if names.count(n) > 1), None)
        if twice is not None:
            raise InputError(f"chain: two parts are named {twice!r}; name them apart")
        for b in blocks[1:]:
            if not np.isclose(b.sample_time, blocks[0].sample_time, rtol=1e-9, atol=0.0):
                raise InputError(
                    f"chain: sample_time = {b.sample_time:g} s of {b.name}, "
                    f"{blocks[0].sample_time:g} s of {blocks[0].name}; make all equal"
                )
        self.given = {
            self._end(to, "inputs"): self._end(of, "outputs") for to, of in connections.items()
        }
        self.sources = {
            (i, k): self._source(i, k) for i, b in enumerate(blocks) for k in range(len(b.inputs))
        }

    # ---- who feeds whom -------------------------------------------------------------------------
    def _end(self, text: str, kind: str) -> tuple[int, int]:
        """(part, place) of "PART.NAME"."""
        names = [b.name for b in self.blocks]
        for i, name in enumerate(names):
            if text.startswith(f"{name}."):
                rest = text[len(name) + 1 :]
                known = [v.name for v in getattr(self.blocks[i], kind)]
                if rest not in known:
                    raise UnknownNameError(f"{kind[:-1]} of {name}", rest, known)
                return i, known.index(rest)
        raise UnknownNameError("part of the chain", text.partition(".")[0], names)

    def _source(self, i: int, k: int) -> tuple[int, int] | None:
        """The output that feeds an input; None for an input of the chain."""
        wanted = self.blocks[i].inputs[k]
        source = self.given.get((i, k))
        if source is None:
            for j in reversed(range(i)):
                outputs = [v.name for v in self.blocks[j].outputs]
                for name in (wanted.name, ESTIMATE + wanted.name):
                    if name in outputs and source is None:
                        source = j, outputs.index(name)
        if source is not None:
            output = self.blocks[source[0]].outputs[source[1]]
            self._same_unit(wanted, output, f"{self.blocks[source[0]].name}.{output.name}", i)
        return source

    def _same_unit(self, wanted: Variable, other: Variable, who: str, i: int) -> None:
        if unit(wanted.unit) != unit(other.unit):
            raise InputError(
                f"chain: {self.blocks[i].name}.{wanted.name} counts in {wanted.unit!r}, {who} in "
                f"{other.unit!r}; connect what counts in the same unit"
            )

    def _inputs(self) -> dict[str, Variable]:
        """Inputs of the chain by name."""
        found: dict[str, Variable] = {}
        for (i, k), source in self.sources.items():
            if source is None:
                v = self.blocks[i].inputs[k]
                self._same_unit(v, found.setdefault(v.name, v), "another part", i)
        return found

    def _missing(self, inputs: Mapping[str, Variable]) -> tuple[str, ...]:
        """Inputs that may be NaN for every part that takes them."""
        takers: dict[str, list[bool]] = {n: [] for n in inputs}
        for (i, k), source in self.sources.items():
            if source is None:
                b = self.blocks[i]
                takers[b.inputs[k].name].append(b.inputs[k].name in b.missing)
        return tuple(n for n, known in takers.items() if all(known))

    # ---- the block ------------------------------------------------------------------------------
    def block(self) -> Block:
        inputs, kind = self._inputs(), kind_of_step(*self.blocks)
        draft = Draft(self.name, self.blocks[0].sample_time, self.description, kind)
        outside = {name: draft.column([v]) for name, v in inputs.items()}
        given: list[Symbol] = []
        for i, b in enumerate(self.blocks):
            seen = []
            for k, v in enumerate(b.inputs):
                source = self.sources[i, k]
                if source is None:
                    seen.append(outside[v.name])
                elif source[0] < i:
                    seen.append(given[source[0]][source[1]])
                else:
                    seen.append(self._late(draft, *source))
            given.append(draft.call(b, column_of(kind, seen), f"{b.name}.")[2])
            for what, count in b.loops.items():
                draft.repeats(f"{b.name}: {what}", count)
        for i, k in {s for (i, _), s in self.sources.items() if s is not None and s[0] >= i}:
            draft.next(f"{self.blocks[i].name}.last.{self.blocks[i].outputs[k].name}", given[i][k])
        outputs, commands = self._outputs(inputs)
        draft.outputs(outputs, column_of(kind, given), commands)
        return replace(draft.block(), missing=self._missing(inputs))

    def _late(self, draft: Draft, i: int, k: int) -> Symbol:
        """An output as the step before gave it."""
        v, name = self.blocks[i].outputs[k], self.blocks[i].name
        words = about(v, f"{v.name} of the last step")
        return draft.memory(f"{name}.last.{v.name}", v.start or 0.0, **words)

    def _outputs(self, inputs: Mapping[str, Variable]) -> tuple[list[Variable], list[str]]:
        names = [*inputs, *(v.name for b in self.blocks for v in b.outputs)]
        taken = {s for s in self.sources.values() if s is not None}
        variables, commands = [], []
        for i, b in enumerate(self.blocks):
            for k, v in enumerate(b.outputs):
                name = f"{b.name}.{v.name}" if names.count(v.name) > 1 else v.name
                variables.append(replace(v, name=name))
                if v.name in b.commands and (i, k) not in taken:
                    commands.append(name)
        return variables, commands

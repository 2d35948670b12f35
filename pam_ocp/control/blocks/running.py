"""The verb ``block``, a block's step on fixed memory, and a block as a loop's controller."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from functools import cached_property
from typing import Any

from ...core.block import Block
from ...core.errors import InputError, UnknownNameError, require_count
from ...core.stop import locked, turns, verb
from ...core.units import unit
from ...core.variables import Variable
from ...numerics.solvers import Buffered
from ...plants.plant import Plant, require_plant
from ..controller import Measured
from ..kinds import BEFORE, SENT, TOLD, Array, law_of, takes
from ..references import Source
from .chain import with_delay
from .guard import Guard, guarded


class Running:
    """A block whose memory is carried from step to step. Inputs that nobody gives stay as they are.

    memory, inputs, parameters : arrays in the block's order, which may be written to; ``outputs``
    are names.
    needed : measurements that each call must bring (None: all of them).
    """

    def __init__(self, block: Block, needed: Collection[str] | None = None) -> None:
        self.block, self.needed = block, needed
        self._step = Buffered(block.step)
        self.memory, self.inputs, self.parameters = self._step.arguments
        self.places = {v.name: i for i, v in enumerate(block.inputs)}
        measured = [(i, n) for n, i in self.places.items() if n.partition(".")[0] not in TOLD]
        self._measured = [(i, n) for i, n in measured if needed is None or n in needed]
        self._besides = [pair for pair in measured if pair not in self._measured]
        self.outputs = [v.name for v in block.outputs]
        self._commands = [(n, self.outputs.index(n)) for n in block.commands]
        self.parameters[:] = block.start("parameters")
        self.reset()

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (self.block, self.needed, *(a.copy() for a in self._step.arguments))

    def reset(self) -> None:
        """Forget the past."""
        self.memory[:] = self.block.start("memory")
        self.inputs[:] = self.block.start("inputs")

    def tell(self, values: Mapping[str, float]) -> None:
        """Set inputs by name. Raises KeyError for others."""
        for name, value in values.items():
            self.inputs[self.places[name]] = value

    def measure(self, measured: Mapping[str, float]) -> None:
        """Set the measurements among the inputs. Raises KeyError where a needed one is missing."""
        inputs = self.inputs
        for i, name in self._measured:
            inputs[i] = measured[name]
        for i, name in self._besides:
            if name in measured:
                inputs[i] = measured[name]

    def step(self) -> Array:
        """The outputs of a step, in the block's order: a view that the next one overwrites."""
        self._step.call()
        after, outputs = self._step.results
        self.memory[:] = after[:, 0]
        return outputs[:, 0]

    def commands(self) -> dict[str, float]:
        """The commands of a step by name [SI]."""
        outputs = self.step().tolist()
        return {n: outputs[i] for n, i in self._commands}


def _again(block: Block, needed: Collection[str] | None, *arrays: Array) -> Running:
    running = Running(block, needed)
    for array, values in zip(
        (running.memory, running.inputs, running.parameters), arrays, strict=True
    ):
        array[:] = values
    return running


class ByBlock:
    """A controller whose law is the step of its block: exported, it is the same function."""

    @cached_property
    def _law(self) -> Running:
        return self._running()

    @turns
    def _running(self) -> Running:
        return Running(law_of(self), self._needed())

    def _needed(self) -> Collection[str] | None:
        """Measurements that each call must bring; None: all that the block takes."""
        return None

    def reset(self) -> None:
        """See :class:`Controller`."""
        self._law.reset()


class SampledLaw(ByBlock):
    """A controller whose call sets the block's inputs and gives the commands of one step."""

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        law = self._law
        law.measure(measured)
        law.tell(self._references(t))
        return law.commands()

    def wanted(self, t: float) -> dict[str, float]:
        """Values by name that are to be reached at a time [s]."""
        return {}

    def _references(self, t: float) -> dict[str, float]:
        """The block's inputs that are no measurements, at a time [s]."""
        return {f"wanted.{n}": value for n, value in self.wanted(t).items()}


# ---- the verb, and a block as a controller -------------------------------------------------------
@verb
def block(
    controller: Any,
    *,
    plant: Plant | None = None,
    name: str | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    rates: Mapping[str, float] | None = None,
    safe: Mapping[str, float] | None = None,
    hold: int = 10,
    fade_time: float = 0.05,
    guard: bool = True,
    delay: int | None = None,
    **options: Any,
) -> Block:
    """A controller, an estimator or a planned motion as a Block, the form in which it is exported.

    controller : any that ``pam_ocp.control`` has, or a Block (a chain of them, say).
    plant : what it is to drive: InputError where its commands or measurements are not among that
        plant's variables, or count in other units. Before the first sample its start values act.
    name : of the block. limits, rates, safe, hold, fade_time : see :class:`Guard`, which stands
        around the law; ``guard`` False leaves it out (for parts of a chain).
    delay : samples from measuring to acting that the controller is designed for, by default its
        own (``Mpc(delay=1)``) or 0; loops and systems with another one warn. An estimator takes
        the commands sent so much before. Of a chain see :func:`chain`.
    options : of this kind of controller.

    Examples
    --------
    >>> law = pam.lqr(plant, point, sample_time=2e-3)
    >>> made = pam.control.block(law, plant=plant, safe={"muscle.command": 0.0})
    >>> [v.name for v in made.outputs][:1]
    ['muscle.command']
    """
    if name is not None:
        options["name"] = name
    if plant is not None and takes(controller, "plant"):
        options["plant"] = require_plant(plant)
    if delay is not None and isinstance(controller, Block):
        raise InputError(f"{controller.name} is a block already; leave out delay")
    law = law_of(controller, **options)
    if delay is not None:
        law = with_delay(law, require_count("delay", delay, 0))
    if plant is not None:
        _require_plant_of(law, require_plant(plant))
        law = _begun(law, plant)
    if not guard:
        return law
    return guarded(law, Guard(limits or {}, rates or {}, safe or {}, hold, fade_time))


def _require_plant_of(law: Block, plant: Plant) -> None:
    known = {v.name: v for v in plant.variables}
    measures = {v.name: v for v in law.inputs if v.name.partition(".")[0] not in TOLD}
    drives = {v.name: v for v in law.outputs if v.name in law.commands}
    for name, variable in {**measures, **drives}.items():
        if name not in known:
            raise InputError(
                f"{law.name} is a controller for another plant: {plant.name!r} has no variable "
                f"{name}"
            )
        if unit(variable.unit) != unit(known[name].unit):
            raise InputError(
                f"{law.name}: {name} counts in {variable.unit!r}, that of {plant.name!r} in "
                f"{known[name].unit!r}"
            )
        if name in drives and known[name].causality != "input":
            raise InputError(f"{law.name}: {name} is no input of {plant.name!r}")


def _begun(law: Block, plant: Plant) -> Block:
    """The law with the plant's start values as the commands before its first sample."""
    starts = {c: plant.variable(c).start for c in law.commands}

    def begun(v: Variable) -> Variable:
        name = v.name.rpartition(SENT)[2].partition(BEFORE)[0] if BEFORE in v.name else v.name
        start = starts.get(name)
        return v if start is None else replace(v, start=start)

    return replace(
        law, outputs=tuple(map(begun, law.outputs)), memory=tuple(map(begun, law.memory))
    )


@locked
class BlockController:
    """A Block in the closed loop: a Controller that calls its step once per sample.

    block : with commands among its outputs. inputs : t [s] -> {input: value} for what is not
    measured: references, ``enable``. ``sent.COMMAND`` of a block without guard is what it sent.
    Inputs that are none of these stay at their start values. What the loop's ``reference`` names
    are the inputs ``wanted.NAME``, and ``ahead.NAME...`` in the samples to come.
    outputs : those of the last sample by name; memory : as it stands now.

    Examples
    --------
    >>> law = pam.lqr(plant, point, sample_time=2e-3)
    >>> made = pam.control.block(law, plant=plant)
    >>> loop = pam.closed_loop(pam.control.BlockController(made), plant, duration=0.5, start=point)
    >>> bool(abs(loop["x"][-1] - 0.04) < 1e-3)
    True
    """

    def __init__(
        self, block: Block, inputs: Callable[[float], Mapping[str, float]] | None = None
    ) -> None:
        if not block.commands:
            raise InputError(f"{block.name} gives no commands, so it cannot close a loop")
        self.block, self._told = block, inputs
        self.sample_time, self.delay = block.sample_time, block.delay
        self._running, self._start = Running(block, ()), block.start("inputs")
        self.parameters = block.start("parameters")
        self._ranges = {v.name: v for v in block.outputs if v.name in block.commands}
        self._reference: dict[str, Source] = {}
        self.reset()

    def tracking(
        self, reference: Mapping[str, Source], inputs: Mapping[str, float], preview: bool
    ) -> BlockController:
        """The Controller whose inputs ``wanted.NAME`` are these references; see Tracking."""
        for name in reference:
            if f"wanted.{name}" not in self._running.places:
                known = [
                    n.partition(".")[2] for n in self._running.places if n.startswith("wanted.")
                ]
                raise InputError(
                    f"reference: {self.block.name} is not told {name}; it tracks "
                    f"{', '.join(known) or 'nothing'}"
                )

        coming = self._coming(reference, preview)

        def told(t: float) -> dict[str, float]:
            before = dict(self._told(t)) if self._told else {}
            return before | {n: at(t + later) for n, (at, later) in coming.items()}

        tracker = BlockController(self.block, told)
        tracker.parameters, tracker._reference = self.parameters, dict(reference)
        return tracker

    def _coming(
        self, reference: Mapping[str, Source], preview: bool
    ) -> dict[str, tuple[Source, float]]:
        """{input: (reference, how much later it is told of)}; of a Mpc from the moment on at which
        its inputs act.
        """
        found: dict[str, tuple[Source, float]] = {}
        for name, at in reference.items():
            node = re.compile(rf"ahead\.{re.escape(name)}(?:\.k(\d+))?")
            ahead = {n: m for n in self._running.places if (m := node.fullmatch(n))}
            steps = {f"wanted.{name}": 0} | {n: int(m[1] or 1) for n, m in ahead.items()}
            begin = self.delay if ahead else 0
            for n, k in steps.items():
                found[n] = at, (begin + k) * self.sample_time if preview else 0.0
        return found

    def wanted(self, t: float) -> dict[str, float]:
        """What the loop told to reach at a time [s]."""
        return {n: at(t) for n, at in self._reference.items()}

    def reset(self) -> None:
        """See :class:`Controller`."""
        self._running.reset()
        self.outputs: dict[str, float] = {}
        self._sent: dict[str, float] = {}

    @property
    def memory(self) -> Array:
        """As it stands now."""
        return self._running.memory

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        running = self._running
        running.inputs[:] = self._start
        running.parameters[:] = self.parameters
        running.tell(self._sent)
        running.tell({n: v for n, v in measured.items() if n in running.places})
        for name, value in (self._told(t) if self._told else {}).items():
            if name not in running.places:
                raise UnknownNameError(f"input of {self.block.name}", name, running.places)
            running.tell({name: value})
        numbers = running.step().tolist()
        self.outputs = dict(zip(running.outputs, numbers, strict=True))
        commands = {n: self.outputs[n] for n in self.block.commands}
        acts = {n: min(max(commands[n], v.min), v.max) for n, v in self._ranges.items()}
        self._sent = {SENT + n: u for n, u in acts.items() if SENT + n in running.places}
        return commands

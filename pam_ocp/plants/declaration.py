"""Declaration: the variables and equations that a plant is made of, until its first use."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import casadi as ca

from ..core.errors import InputError, UnknownNameError
from ..core.expressions import scalar_expression
from ..core.stop import locked
from ..core.system import PathOf
from ..core.variables import Causality, Variable
from ..muscles.dead_zone import dead_zone, dead_zone_inverse
from ..muscles.pneumatic_muscle import Muscle
from .damping import Loss
from .dead_time import DeadTime, DelayLine, as_dead_time, delay_line
from .feeds import AttachedMuscle, Feed, attach
from .opening import Asked, FlowPath, Lead, Opening, checked_commands, flow_path, path_of
from .sensors import Sensor, as_sensor

Part = TypeVar("Part")


# in the order of the plant's function: arguments, and results (a state's is its derivative)
CHANGEABLE: tuple[Causality, ...] = ("state", "input", "parameter")
DEFINED: tuple[Causality, ...] = ("state", "output", "constraint")


@dataclass(frozen=True)
class Equations:
    """Expressions and functions of a finished plant: x' = xdot(x, u, p), y and c alike.

    All copies of a plant share one; ``c`` are its path constraints.
    """

    x: ca.SX
    u: ca.SX
    p: ca.SX
    xdot: ca.SX
    y: ca.SX
    c: ca.SX
    built: OrderedDict[Any, Any] = field(default_factory=OrderedDict)
    """What verbs have built from these expressions, the latest last."""

    @cached_property
    def function(self) -> ca.Function:
        return ca.Function(
            "plant",
            [self.x, self.u, self.p],
            [self.xdot, self.y, self.c],
            ["x", "u", "p"],
            ["xdot", "y", "c"],
        )

    @cached_property
    def jacobians(self) -> ca.Function:
        blocks = [ca.jacobian(e, z) for e in (self.xdot, self.y) for z in (self.x, self.u)]
        return ca.Function(
            "jacobians",
            [self.x, self.u, self.p],
            [ca.densify(b) for b in blocks],
            ["x", "u", "p"],
            ["A", "B", "C", "D"],
        )


@locked
class Declaration:
    """What a :class:`Plant` is made of: named variables, and CasADi expressions for them.

    Open until the finished system is first used; then further declarations are refused.
    """

    def __init__(self, name: str, description: str = "") -> None:
        self.name = Variable(name, "parameter").name  # same rule as for variables
        self.description = description
        self._variables: dict[str, Variable] = {}
        self._symbols: dict[str, ca.SX] = {}
        self._expressions: dict[str, ca.SX] = {}  # derivatives, outputs and constraints by name
        self._stated: dict[str, ca.SX] = {}  # the same as declared, with symbols for openings
        self._mirror: dict[str, tuple[float, str]] = {}
        self._copies: frozenset[str] = frozenset()  # states of further specimens
        self._openings: tuple[Opening, ...] = ()
        self._flow_paths: tuple[FlowPath, ...] = ()
        self._shared: dict[str, tuple[Any, Any]] = {}
        self._gathered: list[tuple[ca.SX, list[ca.SX]]] = []
        self._delay_lines: tuple[DelayLine, ...] = ()
        self._system: Equations | None = None

    # ---- declaring ----------------------------------------------------------------------------
    def state(self, name: str, *, start: float = 0.0, **attributes: Any) -> ca.SX:
        """Declare a continuous state; give its derivative with :meth:`der`. See Variable."""
        return self._declare(Variable(name, "state", start=start, **attributes))

    def input(self, name: str, *, start: float = 0.0, **attributes: Any) -> ca.SX:
        """Declare an input; ``start`` is its value where nothing else is given."""
        return self._declare(Variable(name, "input", start=start, **attributes))

    def parameter(self, name: str, value: float, **attributes: Any) -> ca.SX:
        """Declare a physical constant; ``tunable=True`` if it may change during a simulation."""
        return self._declare(Variable(name, "parameter", start=value, **attributes))

    def der(self, state: ca.SX, derivative: Any) -> None:
        """State the equation d(state)/dt = derivative."""
        self._open()
        name = self._name_of(state)
        if self._symbols.get(name) is not state or self._variables[name].causality != "state":
            raise InputError(f"der({state}): the first argument must be the symbol of a state")
        if name in self._expressions:
            raise InputError(f"der({name}) is given twice")
        self._expressions[name] = scalar_expression(f"der({name})", derivative)

    def output(self, name: str, expression: Any, **attributes: Any) -> ca.SX:
        """Declare an output and its expression in states, inputs and parameters."""
        return self._define(Variable(name, "output", **attributes), expression)

    def constraint(self, name: str, expression: Any, **attributes: Any) -> ca.SX:
        """Declare a path constraint min <= expression <= max, which plans keep."""
        return self._define(Variable(name, "constraint", **attributes), expression)

    def opening(
        self,
        name: str,
        commands: Sequence[ca.SX],
        forward: ca.SX,
        inverse: Callable[[ca.SX], Sequence[ca.SX]],
        paths: Sequence[tuple[ca.SX, PathOf]],
        behind: ca.SX | None = None,
        asked: Asked | None = None,
        **attributes: Any,
    ) -> list[ca.SX]:
        """Declare an input w that controllers choose in place of commands that have a dead zone.

        commands : symbols of the inputs. forward : w as an expression of them and of parameters.
        inverse : w -> the commands that give it. paths : what stands in the plant's equations, each
        as (expression of the commands, w -> the same of w); returns their symbols, to be used
        there. In place of w -> ... "filling" or "venting": the part of w above or below zero.
        behind : where the dead zone stands behind something that moves (a spool), its position, an
            expression of states whose equations are stated and follow the one command linearly;
            ``paths`` are expressions of it then, ``forward`` and ``inverse`` as of a command that
            is the position.
        asked : where what is asked of these states is no command; see :class:`Asked`.
        attributes : of the variable w; see :class:`Variable`. See :meth:`in_openings`.

        Nothing is declared where the states behind are not linear, or other inputs than the
        commands say what w is.
        """
        self._open()
        if behind is not None:
            entry = commands[0] if asked is None else asked.symbol
            lead = Lead.of(behind, entry, self._variables, self._expressions)
            if lead is None:
                return [path for path, _ in paths]
            return self._opening_behind(
                name, commands[0], forward, inverse, paths, lead, asked, attributes
            )
        names = [self._name_of(c) for c in commands]
        variable = self._as_opening(name, names, attributes)
        symbol = ca.SX.sym(name)
        opening = Opening(variable, symbol, tuple(names), forward, tuple(inverse(symbol)))
        if self._is_of_others(opening):
            return [path for path, _ in paths]
        self._openings += (opening,)
        symbols = [ca.SX.sym(f"{name}.way{i}") for i in range(len(paths))]
        self._flow_paths += tuple(
            flow_path(s, way, opening, of) for s, (way, of) in zip(symbols, paths, strict=True)
        )
        return symbols

    def _is_of_others(self, opening: Opening) -> bool:
        """Whether its commands alone do not tell an opening, nor it them."""
        inputs = [n for n, v in self._variables.items() if v.causality == "input"]
        others = [self._symbols[n] for n in inputs if n not in opening.commands]
        told = ca.vertcat(opening.forward, *opening.inverse)
        return bool(others) and bool(ca.depends_on(told, ca.vertcat(*others)))

    def _as_opening(self, name: str, commands: list[str], attributes: dict[str, Any]) -> Variable:
        checked_commands(name, commands, self._variables)
        if name in self._variables or any(o.name == name for o in self._openings):
            raise InputError(f"the name {name!r} is declared twice in plant {self.name!r}")
        return Variable(name, "input", **{"start": 0.0, **attributes})

    def _opening_behind(
        self,
        name: str,
        command: ca.SX,
        forward: ca.SX,
        inverse: Callable[[ca.SX], Sequence[ca.SX]],
        paths: Sequence[tuple[ca.SX, PathOf]],
        lead: Lead,
        asked: Asked | None,
        attributes: dict[str, Any],
    ) -> list[ca.SX]:
        """An opening before what ``lead`` describes; see :meth:`opening`.

        In openings the same states move without a dead zone behind them and without play.
        """
        of = self._name_of(command)
        variable = self._as_opening(name, [of], attributes)
        entry = command if asked is None else asked.symbol
        symbol = ca.SX.sym(name)
        seen, sent, carried = lead.opening(
            asked,
            command,
            lambda position: ca.substitute(forward, entry, position),
            lambda effect: inverse(effect)[0],
            symbol,
        )
        opening = Opening(variable, symbol, (of,), seen, (sent,), carried)
        if self._is_of_others(opening):
            return [path for path, _ in paths]
        self._openings += (opening,)
        symbols = [ca.SX.sym(f"{name}.way{i}") for i in range(len(paths))]
        made = [
            FlowPath(s, ca.SX(way), path_of(part, lead.straight), name)
            for s, (way, part) in zip(symbols, paths, strict=True)
        ]
        if lead.play is not None:
            held = lead.play[0].name()
            rate = ca.SX.sym(f"{name}.play")
            made.append(FlowPath(rate, self._expressions[held], ca.SX(0), name))
            self._expressions[held] = rate
        self._flow_paths += tuple(made)
        return symbols

    def dead_zone(self, command: ca.SX, width: Any, name: str | None = None) -> ca.SX:
        """What an input leaves beyond its dead zone of +-width/2 [its unit], declared with its
        inverse.

        Smooth within ``width`` of zero, the command less width/2 beyond; ``width`` is a number or a
        symbol, such as that of a parameter. Controllers then choose this effect itself, as the
        input ``name`` (by default ``<command>_effect``), and send the command that gives it.

        command : the symbol of an input; or a position that follows one input linearly, as an
            expression of states whose equations are stated (a spool of one's own), see ``behind``
            of :meth:`opening`.
        """
        behind, command = self._followed(command)
        name_of = self._name_of(command)
        checked_commands("dead_zone", [name_of], self._variables)
        variable, effect = self._variables[name_of], dead_zone(command, ca.SX(width))
        known = [v for v in self._variables.values() if v.causality == "parameter"]
        at = ca.Function("at", [command, *(self._symbols[v.name] for v in known)], [effect])
        low, high = (
            float(at(end, *(v.start or 0.0 for v in known))) if math.isfinite(end) else end
            for end in (variable.min, variable.max)
        )
        (symbol,) = self.opening(
            name or f"{name_of}_effect",
            [command],
            effect,
            lambda w: [dead_zone_inverse(w, ca.SX(width))],
            [(effect if behind is None else dead_zone(behind, ca.SX(width)), lambda w: w)],
            behind,
            unit=variable.unit,
            nominal=variable.nominal,
            min=low,
            max=high,
            description=f"effect of {name_of} beyond its dead zone",
        )
        return symbol

    def _followed(self, command: ca.SX) -> tuple[ca.SX | None, ca.SX]:
        """(None, the symbol of an input), or (a position, the input that it follows)."""
        own = self._name_of(command)
        if self._symbols.get(own) is command and self._variables[own].causality == "input":
            return None, command
        seen, found = set[str](), list(ca.symvar(ca.SX(command)))
        for s in found:  # which grows as it is gone through
            if s.name() not in seen:
                seen.add(s.name())
                found += ca.symvar(self._expressions.get(s.name(), ca.SX(0)))
        inputs = [
            n for n in seen if n in self._variables and self._variables[n].causality == "input"
        ]
        if len(inputs) != 1:
            raise InputError(
                f"dead_zone of {command}: give an input of the plant, or a position that follows "
                "one input by states whose equations were stated before with der()"
            )
        return ca.SX(command), self._symbols[inputs[0]]

    def shared(self, name: str, component: Any, declare: Callable[[], Part]) -> Part:
        """What several parts of the plant use in common, such as two muscles one receiver.

        ``declare()`` declares its variables and is called at the first mention of ``name`` only;
        later ones get what it gave then. Raises InputError where the name means another component.
        """
        self._open()
        if name not in self._shared:
            self._shared[name] = (component, declare())
        known, part = self._shared[name]
        if known != component:
            raise InputError(
                f"plant {self.name!r}: two different parts are called {name!r}; give one of them "
                "another name=, or both parts the same component"
            )
        found: Part = part
        return found

    def gathered(self) -> tuple[ca.SX, Callable[[Any], None]]:
        """A sum whose terms are not known yet: (its symbol, what adds a term to it).

        The symbol may stand in any equation; when the plant is finished, the sum of all terms (0
        without any) takes its place. Terms must not hold such symbols themselves.
        """
        self._open()
        symbol, terms = ca.SX.sym(f"gathered{len(self._gathered)}"), list[ca.SX]()
        self._gathered.append((symbol, terms))

        def add(term: Any) -> None:
            self._open()
            terms.append(scalar_expression("a term of a sum", term))

        return symbol, add

    def delayed(
        self, command: ca.SX, dead_time: DeadTime | float, name: str | None = None
    ) -> ca.SX:
        """What an input was a dead time ago: its effect, to be used in the equations.

        command : the symbol of an input. dead_time : a DeadTime, or its time [s]. name : of what is
        declared for it (``<name>.dead_time``, ``<name>.delay1``, ...); by default the input's.
        """
        of = self._name_of(command)
        line = as_dead_time(dead_time)
        if line is None or of not in self._variables or self._variables[of].causality != "input":
            raise InputError(
                f"delayed({of}, {dead_time}): give the symbol of an input, and a dead time"
            )
        effect, made = delay_line(self, name or of, self._variables[of], command, line)
        self._delay_lines += (made,)
        return effect

    def add_sensor(self, name: str, sensor: Sensor) -> None:
        """Read a state or output through a :class:`Sensor`: adds the output ``<name>.measured``.

        Before the plant's first use. A symmetry declared before (:meth:`mirror`) is kept where the
        sensor's filter has a mirror image: the quantity's own, or that of a like sensor.
        """
        variable = self.variable(name)
        if variable.causality not in ("state", "output"):
            raise InputError(
                f"add_sensor: {variable.name} is {variable.kind}; sensors read states and outputs"
            )
        own = variable.name
        value = self._symbols[own] if own in self._symbols else self._expressions[own]
        states = as_sensor(sensor).attach(self, variable, value)
        if self._mirror and states:
            sign, image = self._mirror.get(own, (1.0, own))
            if variable.causality == "output":
                image = ""  # outputs' images are not declared
            self._mirror |= {s: (sign, image + s.removeprefix(own)) for s in states}

    @property
    def delay_lines(self) -> tuple[DelayLine, ...]:
        """The dead times of inputs, by the names of what they are made of."""
        return self._delay_lines

    def mirror(self, mapping: Mapping[str, tuple[float, str]]) -> None:
        """Declare a symmetry: {name: (sign, name of its mirror image)}; others map to themselves.

        Plans use it for motions whose second half is the mirrored first (``cyclic="mirrored"``).
        """
        self._open()
        for name, (_, image) in mapping.items():
            self.variable(name), self.variable(image)
        self._mirror = dict(mapping)

    def add_muscle(
        self,
        name: str,
        muscle: Muscle | str,
        *,
        shortening: Any,
        rate: Any,
        pre_contraction: Any = 0.0,
        feed: Feed | None = None,
        losses: Loss | Sequence[Loss] = (),
    ) -> AttachedMuscle:
        """Attach a muscle: its constants as parameters, its feed, its losses, its outputs.

        shortening, rate : by how much the plant's motion shortens it [m], and the derivative [m/s];
            its contraction is pre_contraction + shortening / rest length.
        pre_contraction : a number (becomes the parameter ``<name>.pre_contraction``) or a symbol.
        feed : how its pressure comes about; by default a first-order ``Regulator()``.
        losses : friction, hysteresis, creep, such as ``CoulombFriction()``.

        Adds the outputs ``<name>.force``, ``.contraction``, ``.stiffness``, ``.power`` (mechanical)
        and the path constraint ``<name>.tension`` >= 0 (never slack). Returns expressions to use in
        the equation of motion.
        """
        return attach(
            self,
            name,
            muscle,
            shortening=shortening,
            rate=rate,
            pre_contraction=pre_contraction,
            feed=feed,
            losses=losses,
        )

    def _name_of(self, symbol: Any) -> str:
        """What a symbol was declared as; its text where it was not."""
        return next((n for n, s in self._symbols.items() if s is symbol), str(symbol))

    def _open(self) -> None:
        if self._system is not None:
            raise InputError(
                f"plant {self.name!r} is in use and cannot be changed any more; "
                "declare everything before its first use (also before expression()); with_output() "
                "gives a copy with one more output"
            )

    def _add(self, variable: Variable) -> None:
        self._open()
        if variable.name in self._variables:
            raise InputError(
                f"the name {variable.name!r} is declared twice in plant {self.name!r}; give one of "
                "the two another name"
            )
        self._variables[variable.name] = variable

    def _declare(self, variable: Variable) -> ca.SX:
        if variable.start is None:
            raise InputError(f"{variable.name}: start is not set; give it a number")
        self._add(variable)
        self._symbols[variable.name] = ca.SX.sym(variable.name)
        return self._symbols[variable.name]

    def _define(self, variable: Variable, expression: Any) -> ca.SX:
        value = scalar_expression(variable.name, expression)
        self._add(variable)
        self._expressions[variable.name] = value
        return value

    # ---- variables -------------------------------------------------------------------------
    def _of(self, causality: Causality) -> tuple[Variable, ...]:
        return tuple(v for v in self._variables.values() if v.causality == causality)

    @property
    def states(self) -> tuple[Variable, ...]:
        return self._of("state")

    @property
    def inputs(self) -> tuple[Variable, ...]:
        return self._of("input")

    @property
    def parameters(self) -> tuple[Variable, ...]:
        return self._of("parameter")

    @property
    def outputs(self) -> tuple[Variable, ...]:
        return self._of("output")

    @property
    def constraints(self) -> tuple[Variable, ...]:
        return self._of("constraint")

    @property
    def variables(self) -> tuple[Variable, ...]:
        """All variables in the order of their declaration."""
        return tuple(self._variables.values())

    def variable(self, name: str) -> Variable:
        """The variable of this name; ``_`` may stand for ``.`` (``muscle1_pressure``).

        Raises UnknownNameError with the nearest names.
        """
        if name in self._variables:
            return self._variables[name]
        for known in self._variables:
            if known.replace(".", "_") == name:
                return self._variables[known]
        raise UnknownNameError(f"variable of plant {self.name!r}", name, self._variables)

    # ---- finishing -------------------------------------------------------------------------------
    def _finished(self) -> Equations:
        if self._system is None:
            self._system = self._close()
        return self._system

    def _close(self) -> Equations:
        missing = [v.name for v in self.states if v.name not in self._expressions]
        if missing:
            raise InputError(f"plant {self.name!r}: no equation der({', '.join(missing)}) is given")
        if not self.states:
            raise InputError(f"plant {self.name!r} has no state")
        self._stated = dict(self._expressions)
        if self._gathered:
            sums = [sum(terms, ca.SX(0)) for _, terms in self._gathered]
            symbols = [symbol for symbol, _ in self._gathered]
            self._stated = self._replaced(symbols, sums)
            self._expressions = dict(self._stated)
            whole = [ca.vertcat(*symbols)], [ca.vertcat(*sums)]
            self._flow_paths = tuple(
                replace(w, in_commands=ca.substitute([w.in_commands], *whole)[0])
                for w in self._flow_paths
            )
        if any(image not in self._variables for _, image in self._mirror.values()):
            self._mirror = {}  # a sensor's filter on one side alone
        if self._flow_paths:
            self._expressions = self._replaced(
                [w.symbol for w in self._flow_paths], [w.in_commands for w in self._flow_paths]
            )
        declared = {s.name() for s in self._symbols.values()}
        for name, expression in self._expressions.items():
            free = {s.name() for s in ca.symvar(expression)} - declared
            if free:
                raise InputError(
                    f"plant {self.name!r}: the expression of {name!r} holds symbols that no state, "
                    f"input or parameter declares: {', '.join(sorted(free))}"
                )
        # laws come to their variables by several ways: what stands twice in their equations is once
        # here, a fifth to two fifths of all operations, before anything differentiates them
        common = ca.cse(list(self._expressions.values()))
        self._expressions = dict(zip(self._expressions, common, strict=True))
        x, u, p = (self._column(self._symbols, c) for c in CHANGEABLE)
        xdot, y, c = (self._column(self._expressions, c) for c in DEFINED)
        return Equations(x, u, p, xdot, y, c)

    def _replaced(self, old: list[ca.SX], new: list[ca.SX]) -> dict[str, ca.SX]:
        """The equations as they were declared, with other expressions for some symbols."""
        names = list(self._stated)
        given = [self._stated[n] for n in names]
        column = ca.substitute(given, [ca.vertcat(*old)], [ca.vertcat(*new)])
        return dict(zip(names, column, strict=True))

    def _column(self, table: Mapping[str, ca.SX], causality: Causality) -> ca.SX:
        return ca.SX(ca.vertcat(*(table[v.name] for v in self._of(causality))))

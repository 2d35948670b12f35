"""Plant: named, united variables and CasADi expressions for them. Nothing downstream knows physics.

Every verb (simulate, fit, plan, linearize, export) takes a Plant, also one that a user wrote.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, UnknownNameError
from ..core.expressions import scalar_expression
from ..core.shown import shown
from ..core.stop import locked
from ..core.variables import Causality, Variable
from ..muscles.dead_zone import dead_zone, dead_zone_inverse
from ..muscles.pneumatic_muscle import Muscle
from .damping import Loss
from .dead_time import DeadTime, DelayLine, as_dead_time, delay_line
from .feeds import AttachedMuscle, Feed, attach
from .opening import FlowPath, Opening, checked_commands
from .sensors import Sensor, as_sensor
from .sketch import Sketch
from .stillness import Position, resting

if TYPE_CHECKING:
    import control

    from ..courtesy import OperatingPoint

__all__ = ["Given", "Plant", "Values", "by_name", "require_plant"]

Values = Mapping[str, Any]
Part = TypeVar("Part")
Given: TypeAlias = "Values | OperatingPoint"
"""Values by name, or those of a point."""

# in the order of the plant's function: arguments, and results (a state's is its derivative)
_CHANGEABLE: tuple[Causality, ...] = ("state", "input", "parameter")
_FREE: tuple[Causality, ...] = ("state", "input")
_DEFINED: tuple[Causality, ...] = ("state", "output", "constraint")


@dataclass(frozen=True)
class _System:
    """The finished expressions and functions of a plant; shared by all its copies."""

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


def require_plant(value: Any) -> Plant:
    """``value``, or an InputError when it is no Plant:
    what every verb asks of its first argument.
    """
    if isinstance(value, Plant):
        return value
    hint = (
        "; put the muscle into one, as HangingLoad(muscle)"
        if isinstance(value, Muscle)
        else ", such as HangingLoad(muscle) or one of your own"
    )
    raise InputError(f"plant is a {type(value).__name__}, not a Plant{hint}")


def by_name(argument: str, values: Any, causality: Causality | None = None) -> dict[str, Any]:
    """Values by name: of a mapping (None: of none), or of an operating point those of a causality.

    Without a causality those of its states and inputs, from which its outputs follow.
    """
    if values is None:
        return {}
    if isinstance(values, Mapping):
        return dict(values)
    point = getattr(values, "values", None)
    if isinstance(point, Mapping) and isinstance(getattr(values, "plant", None), Plant):
        kinds = {v.name: v.causality for v in values.plant.variables}
        wanted = _FREE if causality is None else (causality,)
        return {n: v for n, v in point.items() if kinds[n] in wanted}
    raise InputError(
        f"{argument} is a {type(values).__name__}: give values by name, such as {{'x': 0.01}}, or "
        "an operating point"
    )


@shown
@locked
class Plant:
    """A system to move: states x, inputs u, parameters p; x' = f(x, u, p), y = g(x, u, p).

    Build one by declaring variables (each call gives its CasADi symbol) and equations::

        plant = Plant("mass", "a mass on a spring")
        x = plant.state("x", unit="m", start=0.1)
        v = plant.state("v", unit="m/s")
        f = plant.input("force", unit="N")
        m = plant.parameter("mass", 2.0, unit="kg", min=1e-9)
        plant.der(x, v)
        plant.der(v, (f - 100 * x) / m)
        plant.output("spring_force", 100 * x, unit="N")

    :meth:`add_muscle` brings a muscle with its pressure feed. The first use of the finished system
    closes it: further declarations are refused. A plant is autonomous: what changes with time is an
    input. Values are changed by :meth:`with_values`, which shares the expressions (no rebuilding).

    Raises InputError for duplicate names, missing equations, or symbols that nothing declares.

    Examples
    --------
    >>> own = pam.Plant("mass", "a mass on a spring")
    >>> x, v = own.state("x", unit="m", start=0.1), own.state("v", unit="m/s")
    >>> m = own.parameter("mass", 4.0, unit="kg", min=1e-9)
    >>> own.der(x, v)
    >>> own.der(v, -100 * x / m)
    >>> run = pam.simulate(own, t=[0.0, np.pi / 5])  # sqrt(100/4) = 5 rad/s: half a period
    >>> print(f"{run['x'][-1]:.4f}")
    -0.1000
    """

    def __init__(self, name: str, description: str = "") -> None:
        self.name = Variable(name, "parameter").name  # same rule as for variables
        self.description = description
        self._variables: dict[str, Variable] = {}
        self._symbols: dict[str, ca.SX] = {}
        self._expressions: dict[str, ca.SX] = {}  # derivatives, outputs and constraints by name
        self._stated: dict[str, ca.SX] = {}  # the same as declared, with symbols for openings
        self._mirror: dict[str, tuple[float, str]] = {}
        self._openings: tuple[Opening, ...] = ()
        self._flow_paths: tuple[FlowPath, ...] = ()
        self._shared: dict[str, tuple[Any, Any]] = {}
        self._gathered: list[tuple[ca.SX, list[ca.SX]]] = []
        self._delay_lines: tuple[DelayLine, ...] = ()
        self._system: _System | None = None

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        locked(cls)

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
        name = next((n for n, s in self._symbols.items() if s is state), None)
        if name is None or self._variables[name].causality != "state":
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
        paths: Sequence[tuple[ca.SX, Callable[[ca.SX], ca.SX]]],
        **attributes: Any,
    ) -> list[ca.SX]:
        """Declare an input w that controllers choose in place of commands that have a dead zone.

        commands : symbols of the inputs. forward : w as an expression of them and of parameters.
        inverse : w -> the commands that give it. paths : what stands in the plant's equations, each
        as (expression of the commands, w -> the same of w); returns their symbols, to be used
        there.
        attributes : of the variable w; see :class:`Variable`. See :meth:`in_openings`.
        """
        self._open()
        names = [next((n for n, s in self._symbols.items() if s is c), str(c)) for c in commands]
        checked_commands(name, names, self._variables)
        variable = Variable(name, "input", **{"start": 0.0, **attributes})
        if name in self._variables or any(o.name == name for o in self._openings):
            raise InputError(f"the name {name!r} is declared twice in plant {self.name!r}")
        symbol = ca.SX.sym(name)
        opening = Opening(variable, symbol, tuple(names), forward, tuple(inverse(symbol)))
        self._openings += (opening,)
        symbols = [ca.SX.sym(f"{name}.way{i}") for i in range(len(paths))]
        self._flow_paths += tuple(
            FlowPath(s, ca.SX(way), ca.SX(of(symbol)))
            for s, (way, of) in zip(symbols, paths, strict=True)
        )
        return symbols

    def dead_zone(self, command: ca.SX, width: Any, name: str | None = None) -> ca.SX:
        """What an input leaves beyond its dead zone of +-width/2 [its unit], declared with its
        inverse.

        Smooth within ``width`` of zero, the command less width/2 beyond; ``width`` is a number or a
        symbol, such as that of a parameter. Controllers then choose this effect itself, as the
        input ``name`` (by default ``<command>_effect``), and send the command that gives it.
        """
        name_of = next((n for n, s in self._symbols.items() if s is command), str(command))
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
            [(effect, lambda w: w)],
            unit=variable.unit,
            nominal=variable.nominal,
            min=low,
            max=high,
            description=f"effect of {name_of} beyond its dead zone",
        )
        return symbol

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
        of = next((n for n, s in self._symbols.items() if s is command), str(command))
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
                f"add_sensor: {variable.name} is a {variable.causality}; sensors read states and "
                "outputs"
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

    def _open(self) -> None:
        if self._system is not None:
            raise InputError(
                f"plant {self.name!r} is in use and cannot be changed any more; "
                "declare everything before the first simulate, plan, linearize or export"
            )

    def _add(self, variable: Variable) -> None:
        self._open()
        if variable.name in self._variables:
            raise InputError(f"the name {variable.name!r} is declared twice in plant {self.name!r}")
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

    def with_values(self, values: Given | None = None, /, **more: Any) -> Plant:
        """A copy with other parameter values and start values; expressions are shared.

        ``plant.with_values(mass=3.0)`` or ``plant.with_values({"muscle1.a3": -30.0})``; of an
        operating point states and inputs are taken, not the parameters of its plant.
        """
        self._finished()
        changed = dict(self._variables)
        for name, value in {**by_name("values", values), **more}.items():
            variable = self.variable(name)
            if variable.causality in ("output", "constraint"):
                raise InputError(
                    f"{variable.name} is an {variable.causality} and follows from the others; "
                    "set states, inputs or parameters"
                )
            changed[variable.name] = variable.with_start(value)
        other = self._sharing(self)
        other._variables = changed
        return other

    def vector(
        self, causality: Causality, values: Given | None = None, attribute: str = "start"
    ) -> NDArray[np.float64]:
        """``start`` (or ``min``, ``max``, ``nominal``) of all variables of a causality, as an
        array.

        ``values`` replaces single ones by name; names of another causality are an error.
        """
        variables = self._of(causality)
        array = np.array([getattr(v, attribute) for v in variables], dtype=float)
        position = {v.name: i for i, v in enumerate(variables)}
        for name, value in by_name(causality, values, causality).items():
            variable = self.variable(name)
            if variable.name not in position:
                raise InputError(f"{variable.name} is a {variable.causality}, not a {causality}")
            array[position[variable.name]] = variable.check(value)
        return array

    # ---- verbs that read like properties of the plant -------------------------------------------
    def equilibrium(self, conditions: Values | None = None, /, **more: Any) -> OperatingPoint:
        """The point of rest under conditions; see
        :func:`pam_ocp.equilibrium`.
        """
        return courtesy.equilibrium(self, conditions, **more)

    def linearize(self, at: Any = None, **options: Any) -> control.StateSpace:
        """python-control's StateSpace near a point;
        see :func:`pam_ocp.operating.linear.linearize`.
        """
        return courtesy.linearize(self, at, **options)

    # ---- expressions and functions -----------------------------------------------------------
    def sketch(self) -> Sketch | None:
        """How the plant looks in a film; None: as a load on a muscle if it is one, else not at all.

        A subclass overrides it: shapes whose points are expressions of its own variables.
        """
        return None

    def _finished(self) -> _System:
        if self._system is None:
            self._system = self._close()
        return self._system

    def _close(self) -> _System:
        missing = [v.name for v in self.states if v.name not in self._expressions]
        if missing:
            raise InputError(f"plant {self.name!r}: no equation der({', '.join(missing)}) is given")
        if not self.states:
            raise InputError(f"plant {self.name!r} has no state")
        self._stated = dict(self._expressions)
        if self._gathered:
            sums = [sum(terms, ca.SX(0)) for _, terms in self._gathered]
            self._stated = self._replaced([symbol for symbol, _ in self._gathered], sums)
            self._expressions = dict(self._stated)
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
        x, u, p = (self._column(self._symbols, c) for c in _CHANGEABLE)
        xdot, y, c = (self._column(self._expressions, c) for c in _DEFINED)
        return _System(x, u, p, xdot, y, c)

    def _replaced(self, old: list[ca.SX], new: list[ca.SX]) -> dict[str, ca.SX]:
        """The equations as they were declared, with other expressions for some symbols."""
        names = list(self._stated)
        given = [self._stated[n] for n in names]
        column = ca.substitute(given, [ca.vertcat(*old)], [ca.vertcat(*new)])
        return dict(zip(names, column, strict=True))

    def _column(self, table: Mapping[str, ca.SX], causality: Causality) -> ca.SX:
        return ca.SX(ca.vertcat(*(table[v.name] for v in self._of(causality))))

    @property
    def x(self) -> ca.SX:
        """All states as one symbolic column, in the order of :attr:`states`."""
        return self._finished().x

    @property
    def u(self) -> ca.SX:
        """All inputs as one symbolic column."""
        return self._finished().u

    @property
    def p(self) -> ca.SX:
        """All parameters as one symbolic column."""
        return self._finished().p

    @property
    def function(self) -> ca.Function:
        """CasADi function (x, u, p) -> (xdot, y, c)."""
        return self._finished().function

    def cached(self, key: Hashable, build: Callable[[], Any]) -> Any:
        """What ``build()`` gives, kept with the expressions under ``key`` (the latest 32 are kept).

        For verbs that make CasADi functions of this plant: copies with other values share them.
        """
        built = self._finished().built
        if key not in built:
            built[key] = build()
            while len(built) > 32:
                built.popitem(last=False)
        built.move_to_end(key)
        return built[key]

    @property
    def jacobians(self) -> ca.Function:
        """CasADi function (x, u, p) -> (A, B, C, D), the exact Jacobians of xdot and y."""
        return self._finished().jacobians

    def expression(self, name: str) -> ca.SX:
        """The CasADi expression of any variable; ``"der(NAME)"`` for the derivative of a state."""
        self._finished()
        if name.startswith("der(") and name.endswith(")"):
            variable = self.variable(name[4:-1])
            if variable.causality != "state":
                raise InputError(
                    f"{name}: {variable.name} is no state, so it has no derivative here"
                )
            return self._expressions[variable.name]
        variable = self.variable(name)
        if variable.name in self._symbols:
            return self._symbols[variable.name]
        return self._expressions[variable.name]

    @cached_property
    def positions(self) -> dict[str, str]:
        """{position: velocity} for the states whose derivative is itself a state (x' = v)."""
        self._finished()
        pairs = {}
        for name in (v.name for v in self.states):
            for other in (v.name for v in self.states):
                if ca.is_equal(self._expressions[name], self._symbols[other]):
                    pairs[name] = other
        return pairs

    def resting(self, named: Collection[str] = ()) -> tuple[Position, ...]:
        """The states whose rates and accelerations vanish where the plant rests, in any
        coordinates.

        ``named`` states come first where the equations leave a choice; see :mod:`.stillness`.
        """
        return resting(self, named)

    @property
    def mirror_map(self) -> dict[str, tuple[float, str]]:
        """The declared symmetry, or {} when the plant has none."""
        return dict(self._mirror)

    # ---- openings in place of commands -----------------------------------------------------------
    @property
    def openings(self) -> tuple[Opening, ...]:
        """What controllers choose in place of commands that have a dead zone."""
        return self._openings

    def in_openings(self) -> Plant:
        """The same plant with openings as inputs, in place of the commands that they stand in for.

        A valve-fed muscle has the input ``<name>.opening`` (-1 exhaust .. 1 supply), through whose
        zero the flow goes with a slope: there a linear model and a solver see what the valve can
        do. The plant itself where it declares no openings. Values, names and order are kept.
        """
        if not self._openings:
            return self
        template = self.cached("in openings", self._in_openings)
        other = self._sharing(template)
        other._variables = {n: self._variables.get(n, v) for n, v in template._variables.items()}
        p = self.vector("parameter")
        for opening in self._openings:
            commands = ca.vertcat(*(self._symbols[c] for c in opening.commands))
            start = ca.Function("start", [commands, self.p], [opening.forward])
            value = float(start([self._variables[c].start or 0.0 for c in opening.commands], p))
            variable = opening.variable
            value = min(max(value, variable.min), variable.max)
            other._variables[opening.name] = variable.with_start(value)
        return other

    def in_commands(self) -> Plant:
        """The same plant without openings: controllers then choose its commands as they are."""
        if not self._openings:
            return self
        self._finished()
        other = self._sharing(self)
        other._openings, other._flow_paths, other._stated = (), (), other._expressions
        return other

    def _sharing(self, template: Plant) -> Plant:
        other = object.__new__(type(self))  # copy.copy would make new symbols, as pickling does
        other.__dict__.update(template.__dict__)
        return other

    def _in_openings(self) -> Plant:
        other = self._sharing(self)
        other.__dict__.pop("positions", None)
        instead = {o.commands[0]: o for o in self._openings}
        gone = {c: o for o in self._openings for c in o.commands}
        other._variables, other._symbols = {}, {}
        for name, variable in self._variables.items():
            if name in instead:
                opening = instead[name]
                other._variables[opening.name] = opening.variable
                other._symbols[opening.name] = opening.symbol
            elif name not in gone:
                other._variables[name] = variable
                if name in self._symbols:
                    other._symbols[name] = self._symbols[name]
        commands = [self._symbols[c] for o in self._openings for c in o.commands]
        inverse = [e for o in self._openings for e in o.inverse]
        paths = [w.symbol for w in self._flow_paths], [w.in_openings for w in self._flow_paths]
        other._expressions = self._replaced(paths[0] + commands, paths[1] + inverse)
        other._mirror = {
            gone[n].name if n in gone else n: (sign, gone[m].name if m in gone else m)
            for n, (sign, m) in self._mirror.items()
        }
        other._openings, other._flow_paths, other._system = (), (), None
        return other

    # ---- pickling: CasADi functions travel, symbols are made anew
    # ---------------------------------
    def __getstate__(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "description": self.description,
            "variables": list(self._variables.values()),
            "mirror": self._mirror,
            "function": self._travelling(),
            "delay_lines": self._delay_lines,
            "openings": [(o.variable, o.commands) for o in self._openings],
        }

    def _travelling(self) -> ca.Function:
        """The plant's function; where it has openings with their paths and the paths' meaning."""
        if not self._openings:
            return self.function
        self._finished()
        w = ca.vertcat(*(o.symbol for o in self._openings))
        paths = ca.vertcat(*(way.symbol for way in self._flow_paths))
        results = [self._column(self._stated, c) for c in _DEFINED]
        results += [ca.vertcat(*(way.in_commands for way in self._flow_paths))]
        results += [ca.vertcat(*(way.in_openings for way in self._flow_paths))]
        results += [ca.vertcat(*(o.forward for o in self._openings))]
        results += [ca.vertcat(*(e for o in self._openings for e in o.inverse))]
        return ca.Function("plant", [self.x, self.u, self.p, w, paths], results)

    def __setstate__(self, state: dict[str, Any]) -> None:
        Plant.__init__(self, state["name"], state["description"])
        self._variables = {v.name: v for v in state["variables"]}
        self._mirror = state["mirror"]
        self._delay_lines = state.get("delay_lines", ())
        symbols = {v.name: ca.SX.sym(v.name) for v in state["variables"]}
        self._symbols = {v.name: symbols[v.name] for c in _CHANGEABLE for v in self._of(c)}
        known = [self._column(self._symbols, c) for c in _CHANGEABLE]
        if not state.get("openings"):
            values = state["function"](*known)
        else:
            values = self._with_openings(state["function"], known, state["openings"])
        for kind, column in zip(_DEFINED, values, strict=True):
            for i, variable in enumerate(self._of(kind)):
                self._expressions[variable.name] = column[i]

    def _with_openings(
        self, function: ca.Function, known: list[ca.SX], openings: list[Any]
    ) -> tuple[ca.SX, ...]:
        """Openings and paths from what has travelled; gives the columns of the equations."""
        symbols = [ca.SX.sym(v.name) for v, _ in openings]
        paths = [ca.SX.sym(f"way{i}") for i in range(function.numel_in(4))]
        *columns, in_commands, in_openings, forward, inverse = function(
            *known, ca.vertcat(*symbols), ca.vertcat(*paths)
        )
        self._flow_paths = tuple(
            FlowPath(s, in_commands[i], in_openings[i]) for i, s in enumerate(paths)
        )
        parts = iter(ca.vertsplit(inverse))
        self._openings = tuple(
            Opening(v, symbols[i], commands, forward[i], tuple(next(parts) for _ in commands))
            for i, (v, commands) in enumerate(openings)
        )
        return tuple(columns)

    def __repr__(self) -> str:
        kinds: tuple[Causality, ...] = ("state", "input", "parameter", "output")
        counts = ", ".join(f"{len(self._of(kind))} {kind}s" for kind in kinds)
        return f"<{type(self).__name__} {self.name!r}: {counts}>"

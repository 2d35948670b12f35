"""Plant: named, united variables and CasADi expressions for them. Nothing downstream knows physics.

Every verb (simulate, fit, plan, linearize, export) takes a Plant, also one that a user wrote.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, kind_of, with_article
from ..core.expressions import scalar_expression
from ..core.shown import shown
from ..core.stop import locked
from ..core.variables import Causality, require_causality
from ..muscles.pneumatic_muscle import Muscle
from .declaration import CHANGEABLE, DEFINED, Declaration
from .opening import Carried, FlowPath, Instead, Opening
from .sketch import Sketch
from .stillness import Position, resting

if TYPE_CHECKING:
    import control

    from ..courtesy import OperatingPoint

Values = Mapping[str, Any]
Given: TypeAlias = "Values | OperatingPoint"
"""Values by name, or those of a point."""

ATTRIBUTES = ("start", "min", "max", "nominal")
"""Of a variable, that :meth:`Plant.vector` makes arrays of."""
_FREE: tuple[Causality, ...] = ("state", "input")


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
    raise InputError(f"plant is {kind_of(value)}, not a Plant{hint}")


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
        f"{argument} is {kind_of(values)}: give values by name, such as {{'x': 0.01}}, or "
        "an operating point"
    )


@locked
class Travelling(Declaration):
    """A declaration that can be pickled, by its function and what is said of its variables."""

    def __getstate__(self) -> dict[str, Any]:
        return {
            "name": self.name,
            "description": self.description,
            "variables": list(self._variables.values()),
            "mirror": self._mirror,
            "function": self._travelling(),
            "delay_lines": self._delay_lines,
            "openings": [(o.variable, o.commands) for o in self._openings],
            "carried": [tuple(c.name for c in o.carried) for o in self._openings],
            "paths": [(way.opening, way.way) for way in self._flow_paths],
            **({"copies": sorted(self._copies)} if self._copies else {}),
        }

    def _travelling(self) -> ca.Function:
        """The plant's function; where it has openings with their paths and the paths' meaning."""
        if not self._openings:
            return self._finished().function
        system = self._finished()
        w = ca.vertcat(*(o.symbol for o in self._openings))
        paths = ca.vertcat(*(way.symbol for way in self._flow_paths))
        results = [self._column(self._stated, c) for c in DEFINED]
        results += [ca.vertcat(*(way.in_commands for way in self._flow_paths))]
        results += [ca.vertcat(*(way.in_openings for way in self._flow_paths))]
        results += [ca.vertcat(*(o.forward for o in self._openings))]
        results += [ca.vertcat(*(e for o in self._openings for e in o.inverse))]
        carried = [c for o in self._openings for c in o.carried]
        results += [ca.vertcat(*(ca.vertcat(c.entered, c.left) for c in carried))]
        return ca.Function("plant", [system.x, system.u, system.p, w, paths], results)

    def __setstate__(self, state: dict[str, Any]) -> None:
        Declaration.__init__(self, state["name"], state["description"])
        self._variables = {v.name: v for v in state["variables"]}
        self._mirror = state["mirror"]
        self._copies = frozenset(state.get("copies", ()))
        self._delay_lines = state.get("delay_lines", ())
        symbols = {v.name: ca.SX.sym(v.name) for v in state["variables"]}
        self._symbols = {v.name: symbols[v.name] for c in CHANGEABLE for v in self._of(c)}
        known = [self._column(self._symbols, c) for c in CHANGEABLE]
        if not state.get("openings"):
            values = state["function"](*known)
        else:
            values = self._with_openings(state, known)
        for kind, column in zip(DEFINED, values, strict=True):
            for i, variable in enumerate(self._of(kind)):
                self._expressions[variable.name] = column[i]

    def _with_openings(self, state: dict[str, Any], known: list[ca.SX]) -> tuple[ca.SX, ...]:
        """Openings and paths from what has travelled; gives the columns of the equations."""
        function, openings = state["function"], state["openings"]
        symbols = [ca.SX.sym(v.name) for v, _ in openings]
        paths = [ca.SX.sym(f"way{i}") for i in range(len(state["paths"]))]
        *columns, in_commands, in_openings, forward, inverse, carried = function(
            *known, ca.vertcat(*symbols), ca.vertcat(*paths)
        )
        self._flow_paths = tuple(
            FlowPath(s, in_commands[i], in_openings[i], *state["paths"][i])
            for i, s in enumerate(paths)
        )
        parts, moved = (iter(ca.vertsplit(each)) for each in (inverse, carried))
        self._openings = tuple(
            Opening(
                v,
                symbols[i],
                commands,
                forward[i],
                tuple(next(parts) for _ in commands),
                tuple(Carried(n, next(moved), next(moved)) for n in state["carried"][i]),
            )
            for i, (v, commands) in enumerate(openings)
        )
        return tuple(columns)


@shown
@locked
class Plant(Travelling):
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

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        locked(cls)

    # ---- values --------------------------------------------------------------------------------
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

    def with_output(self, name: str, expression: Any, **attributes: Any) -> Plant:
        """A copy with one more output, an expression of this plant's (:meth:`expression`).

        So a finished arrangement gets what a controller is to track or to keep in bounds, such as a
        cost term of your own. attributes : ``unit``, ``nominal``, ...; see :class:`Variable`.

        Examples
        --------
        >>> total = slide.expression("muscle1.pressure") + slide.expression("muscle2.pressure")
        >>> plant = slide.with_output("total", total, unit="Pa", nominal=1e5)
        >>> mpc = pam.Mpc(plant, horizon=5, sample_time=0.01, track={"x": 1.0, "total": 0.1})
        """
        self._finished()
        other = self._sharing(self)
        other._variables, other._expressions = dict(self._variables), dict(self._stated)
        other._gathered, other._system = [], None
        other.output(name, expression, **attributes)
        other._finished()
        return other

    def with_terms(self, declare: Callable[[Plant], Mapping[str, Any]]) -> Plant:
        """A copy with more in its equations, such as a force that the model lacks.

        declare : called with the copy, still open: it may declare parameters and states there, and
            returns {state or output: what is added to its rate, or to its value} in symbols of this
            plant (:meth:`expression`) and of what it declared.

        Names, values and order of what was there are kept. A declared symmetry is not: nothing says
        that the terms have it.

        Examples
        --------
        >>> def spring(open_plant):
        ...     rate = open_plant.parameter("rate", 100.0, unit="1/s2", min=0.0)
        ...     return {"v": -rate * slide.expression("x")}
        >>> stiffer = slide.with_terms(spring)
        >>> more = stiffer.expression("der(v)") - slide.expression("der(v)")
        >>> values = stiffer.vector("state", {"x": 0.01}), stiffer.vector("parameter")
        >>> float(ca.Function("f", [stiffer.x, stiffer.p], [more])(*values))
        -1.0
        """
        self._finished()
        other = self._sharing(self)
        other.__dict__.pop("positions", None)
        other._variables, other._symbols = dict(self._variables), dict(self._symbols)
        other._expressions = dict(self._stated)
        other._gathered, other._mirror, other._system = [], {}, None
        if not callable(declare):
            raise InputError(f"declare is {kind_of(declare)}: give a function of the open plant")
        terms = declare(other)
        if not isinstance(terms, Mapping):
            raise InputError(f"declare returns {kind_of(terms)}: return {{state or output: term}}")
        for name, term in terms.items():
            variable = other.variable(name)
            if variable.causality not in ("state", "output"):
                raise InputError(
                    f"a term of {variable.name}, {with_article(variable.causality)}: terms are "
                    "added to the rates of states and to outputs"
                )
            value = scalar_expression(f"the term of {variable.name}", term)
            other._expressions[variable.name] += value
        other._finished()
        return other

    def vector(
        self, causality: Causality, values: Given | None = None, attribute: str = "start"
    ) -> NDArray[np.float64]:
        """``start`` (or ``min``, ``max``, ``nominal``) of all variables of a causality, as an
        array.

        ``values`` replaces single ones by name; names of another causality are an error.
        """
        require_causality(causality)
        if attribute not in ATTRIBUTES:
            raise InputError(f"attribute = {attribute!r}: choose one of {', '.join(ATTRIBUTES)}")
        variables = self._of(causality)
        array = np.array([getattr(v, attribute) for v in variables], dtype=float)
        position = {v.name: i for i, v in enumerate(variables)}
        for name, value in by_name(causality, values, causality).items():
            variable = self.variable(name)
            if variable.name not in position:
                said, asked = with_article(variable.causality), with_article(causality)
                raise InputError(
                    f"{variable.name} is {said}, not {asked}; name {causality}s alone: "
                    f"{', '.join(position) or 'the plant has none'}"
                )
            array[position[variable.name]] = variable.check(value)
        return array

    # ---- verbs that read like properties of the plant -------------------------------------------
    def equilibrium(self, conditions: Values | None = None, /, **more: Any) -> OperatingPoint:
        """The equilibrium under conditions; see
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
        """{position: velocity} for the states whose derivative is itself a state (x' = v); those
        of :attr:`copies` aside.
        """
        self._finished()
        pairs = {}
        for name in (v.name for v in self.states if v.name not in self._copies):
            for other in (v.name for v in self.states):
                if ca.is_equal(self._expressions[name], self._symbols[other]):
                    pairs[name] = other
        return pairs

    @property
    def load_positions(self) -> dict[str, str]:
        """:attr:`positions` of what is moved: without those that valves have (their spools)."""
        return {x: v for x, v in self.positions.items() if not self.variable(x).memory}

    def resting(self, named: Collection[str] = ()) -> tuple[Position, ...]:
        """The states whose rates and accelerations vanish where the plant rests, in any
        coordinates.

        ``named`` states come first where the equations leave a choice; see :mod:`.stillness`.
        """
        return tuple(q for q in resting(self, named) if q.name not in self._copies)

    @property
    def copies(self) -> frozenset[str]:
        """States of further specimens, of which nothing is asked but what a statement says."""
        return self._copies

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
        return self._with_inputs("in openings", Instead.whole)

    def in_ways(self) -> Plant:
        """The same plant with the two ways of each opening as inputs of their own, 0 or more.

        A valve-fed muscle has ``<name>.opening.filling`` and ``<name>.opening.venting``, 0 .. 1:
        the flow through each has no rounding at zero, so that what air costs is exact. Nothing but
        that keeps them from being open at once. Openings without such ways stay whole.
        """
        return self._with_inputs("in ways", Instead.ways)

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

    def _with_inputs(self, key: str, make: Callable[..., Instead]) -> Plant:
        """With other inputs in place of the commands of openings; the template is made once."""
        if not self._openings:
            return self

        def build() -> tuple[Plant, list[Instead]]:
            made = [make(opening, self._flow_paths) for opening in self._openings]
            return self._in_place_of_commands(made), made

        template, made = self.cached(key, build)
        other = self._sharing(template)
        other._variables = {n: self._variables.get(n, v) for n, v in template._variables.items()}
        p = self.vector("parameter")
        for each in made:
            commands = ca.vertcat(*(self._symbols[c] for c in each.opening.commands))
            carried = each.opening.carried
            states = ca.vertcat(*(c.entered for c in carried))
            results = [each.opening.forward, states]
            start = ca.Function("start", [commands, self.p, self.x], results)
            sent = [self._variables[c].start or 0.0 for c in each.opening.commands]
            opening, begin = start(sent, p, self.vector("state"))
            other._variables |= each.starting(float(opening))
            for i, c in enumerate(carried):
                at = other._variables[c.name]
                other._variables[c.name] = at.with_start(min(max(float(begin[i]), at.min), at.max))
        return other

    def _in_place_of_commands(self, made: list[Instead]) -> Plant:
        other = self._sharing(self)
        other.__dict__.pop("positions", None)
        first = {each.opening.commands[0]: each for each in made}
        gone = {c: each for each in made for c in each.opening.commands}
        other._variables, other._symbols, other._mirror = {}, {}, {}
        for name, variable in self._variables.items():
            if name in first:
                other._variables |= {n: v for n, (v, _) in first[name].inputs.items()}
                other._symbols |= {n: s for n, (_, s) in first[name].inputs.items()}
            elif name not in gone:
                other._variables[name] = variable
                if name in self._symbols:
                    other._symbols[name] = self._symbols[name]
        for n, (sign, m) in self._mirror.items():
            other._mirror |= gone[n].mirrored(sign, gone[m]) if n in gone else {n: (sign, m)}
        replaced = [pair for each in made for pair in (*each.paths, *self._sent(each))]
        other._expressions = self._replaced(
            [old for old, _ in replaced], [new for _, new in replaced]
        )
        other._openings, other._flow_paths, other._system = (), (), None
        return other

    def _sent(self, instead: Instead) -> list[tuple[ca.SX, ca.SX]]:
        """(symbol of a command, what is sent), of all that an opening stands in for."""
        opening = instead.opening
        if opening.carried:  # what moves follows the opening as it follows the command
            return [(self._symbols[opening.commands[0]], instead.value)]
        symbols = (self._symbols[c] for c in opening.commands)
        sent = ca.substitute(list(opening.inverse), [opening.symbol], [instead.value])
        return list(zip(symbols, sent, strict=True))

    def report(self) -> str:
        """Its variables by name, each with its start value (or its unit) and description."""
        lines = [repr(self), *([self.description] if self.description else [])]
        for v in self._variables.values():
            value = v.display_unit if v.start is None else v.shown(v.start)
            lines.append(f"  {v.causality:<10} {v.name:<28} {value:<16} {v.description}".rstrip())
        return "\n".join(lines)

    def __repr__(self) -> str:
        kinds: tuple[Causality, ...] = ("state", "input", "parameter", "output")
        counts = ", ".join(f"{len(self._of(kind))} {kind}s" for kind in kinds)
        return f"<{type(self).__name__} {self.name!r}: {counts}>"

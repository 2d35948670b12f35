"""Linearisation: from a plant to python-control, by exact Jacobians.

At a point (continuous or sampled), along a motion (A(t), B(t)), or over a grid of equilibria
(a family to interpolate in).
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, kind_of, require_instance, require_numbers, require_positive
from ..core.quantities import outside
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.units import unit
from ..plants.inversion import Inversion, in_dead_zone
from ..plants.plant import Plant, Values, require_plant
from ..plants.stillness import totals
from .held import Memory
from .linear_model import LinearModel
from .operating_point import require_point_of
from .resting_point import EquilibriumError, OperatingPoint, equilibrium

if TYPE_CHECKING:
    import control

Array: TypeAlias = NDArray[np.float64]
NO_SLOPE = 1e-12
"""In units of nominal: smaller slopes move nothing."""
OFF_REST = 1e-4
"""Rates [of nominal per second] that are still those of an equilibrium."""
Matrices: TypeAlias = tuple[Array, Array, Array, Array]


def point_of(plant: Plant, at: OperatingPoint | Values | None) -> tuple[Plant, Array, Array]:
    """The plant with the point's parameters, and the point's states and inputs."""
    require_plant(plant)
    if isinstance(at, OperatingPoint):
        require_point_of(plant, at)
        return at.plant, at.x, at.u
    remedy = "give an OperatingPoint (of equilibrium), or values by name"
    require_instance("at", at, Mapping, remedy, none=True)
    given = {plant.variable(n).name: v for n, v in (at or {}).items()}
    moved = plant.with_values(given)
    return moved, moved.vector("state"), moved.vector("input")


def inside(plant: Plant, at: OperatingPoint | Values | None) -> tuple[Inversion, OperatingPoint]:
    """The plant's inversion, and an equilibrium of the plant in openings.

    at : a point (with commands or openings), or conditions of rest.
    """
    inversion = Inversion(require_plant(plant))
    if isinstance(at, OperatingPoint):
        point_of(plant, at)
        at = inversion.entered(at)
    else:
        at = inversion.inner.equilibrium(inversion.conditions(at))
    return Inversion(inversion.carrying(at)), at


def no_influence(verb: str, plant: Plant, a: Array, b: Array, inputs: Sequence[str]) -> None:
    """InputError when no input moves a state, or a position where there are any: A (..., states,
    states) and B (..., states, inputs) leave no way there.
    """
    scale = plant.vector("state", attribute="nominal")
    effect = np.abs(b) / scale[:, None] * np.array([plant.variable(n).nominal for n in inputs])
    slopes = np.abs(a) * scale / scale[:, None]
    moves, passes = (
        m.reshape(-1, *m.shape[-2:]).max(axis=0, initial=0.0) for m in (effect, slopes)
    )
    reached = moves.max(axis=1, initial=0.0) > NO_SLOPE
    names = [v.name for v in plant.states]
    for _ in names:
        reached |= (passes[:, reached] > NO_SLOPE).any(axis=1)
    wanted = [n for n in (p.name for p in plant.resting()) if n in names]
    moved = {n for n, there in zip(names, reached, strict=True) if there}
    if moved & set(wanted) or (moved and not wanted):
        return
    raise InputError(
        f"{verb}: {', '.join(inputs) or 'no input'} has no influence on "
        f"{', '.join(wanted) or repr(plant.name)} here: its slope is 0, as in a dead zone or at a "
        "closed valve. Declare the dead zone (plant.dead_zone(command, width), or of the position "
        "of a spool), so that its inverse is used, or take a point at which the input acts"
    )


def warn_off_rest(plant: Plant, x: Array, u: Array) -> None:
    """Say at which rate which state changes at a point that is none of rest.

    States that only sum up (air drawn, work) and held memories may change.
    """
    rates = np.asarray(plant.function(x, u, plant.vector("parameter"))[0], dtype=float).ravel()
    free = {*totals(plant), *(v.name for v in plant.states if v.memory == "held")}
    sizes = np.abs(rates) / plant.vector("state", attribute="nominal")
    sizes[[v.name in free for v in plant.states]] = 0.0
    if not np.max(sizes, initial=0.0) > OFF_REST:
        return
    worst = plant.states[int(np.argmax(sizes))]
    unit = per_second(worst.display_unit)
    warnings.warn(
        f"linearize: {plant.name!r} does not rest at this point: {worst.name} changes by "
        f"{rates[int(np.argmax(sizes))] / worst.display_factor:.4g} {unit}. The linear system "
        "holds for small deviations from the motion through it, as long as that stays near; "
        "plant.equilibrium(...) gives equilibria",
        stacklevel=outside(),
    )


def per_second(unit: str) -> str:
    """A unit, per second."""
    if unit == "1":
        return "1/s"
    return f"{unit}2" if unit.endswith("/s") else f"{unit}/s"


def _seen(
    plant: Plant, x: Array, u: Array, inputs: Sequence[str] | None
) -> tuple[Plant, Array, Array]:
    """The plant, its states (n, nx) and inputs (n, nu),
    in openings where they are named or commands have no slope.
    """
    inversion = Inversion(plant)
    names = [inputs] if isinstance(inputs, str) else inputs
    if names is None:
        inner = in_dead_zone(plant, u, x)
    else:
        inner = any(inversion.opening_of(n) is not None for n in names)
    if not inner:
        return plant, x, u
    return inversion.inner, inversion.inside(x), inversion.rows(u, x=x)


@dataclass(frozen=True)
class _Selection:
    """Which inputs and outputs of a plant are kept, and their names for python-control."""

    plant: Plant
    inputs: Sequence[str]
    outputs: Sequence[str]
    units: Mapping[str, str] = field(default_factory=dict)
    """Of variables that do not count in SI."""

    def unit(self, name: str) -> str:
        return self.units.get(name, self.plant.variable(name).unit)

    def factors(self, names: Sequence[str]) -> Array:
        """SI value per unit, of each."""
        own = (unit(self.plant.variable(n).unit).factor for n in names)
        return np.array([unit(self.unit(n)).factor / f for n, f in zip(names, own, strict=True)])

    @classmethod
    def of(
        cls, plant: Plant, inputs: Sequence[str] | None, outputs: Sequence[str] | None
    ) -> _Selection:
        return cls(
            plant,
            chosen_signals("inputs", plant, inputs, ("input",)),
            chosen_signals("outputs", plant, outputs, ("state", "output")),
        )

    def matrices(self, x: Array, u: Array) -> Matrices:
        """A, B, C, D at states (n, nx) and inputs (n, nu), stacked along the first axis."""
        n, nx = x.shape
        blocks = self.plant.jacobians(x.T, u.T, self.plant.vector("parameter"))
        a, b, c, d = (
            np.asarray(m).reshape(m.shape[0], n, m.shape[1] // n).swapaxes(0, 1) for m in blocks
        )
        c = np.concatenate([np.broadcast_to(np.eye(nx), (n, nx, nx)), c], axis=1)
        d = np.concatenate([np.zeros((n, nx, u.shape[1])), d], axis=1)
        all_in = [v.name for v in self.plant.inputs]
        all_out = [v.name for v in (*self.plant.states, *self.plant.outputs)]
        columns = [all_in.index(name) for name in self.inputs]
        rows = [all_out.index(name) for name in self.outputs]
        return a, b[:, :, columns], c[:, rows], d[:, rows][:, :, columns]

    def model(
        self, matrices: Matrices, dt: float = 0.0, kept: Sequence[int] | None = None
    ) -> LinearModel:
        """The system of these matrices; sampled with zero-order hold when ``dt`` > 0.

        kept : the states that they are of, by default all.
        """
        a, b, c, d = matrices
        variables = [self.plant.states[i] for i in (range(len(a)) if kept is None else kept)]
        if dt:
            a, b = held(a, b, np.array([v.nominal for v in variables]), dt)
        states = [v.name for v in variables]
        x, u, y = (self.factors(names) for names in (states, self.inputs, self.outputs))
        names = (*states, *self.inputs, *self.outputs)
        return LinearModel(
            a * x / x[:, None],
            b * u / x[:, None],
            c * x / y[:, None],
            d * u / y[:, None],
            _plain(states),
            _plain(self.inputs),
            _plain(self.outputs),
            dict(zip(_plain(names), map(self.unit, names), strict=True)),
            self.plant.name,
            dt,
        )

    def system(self, matrices: Matrices, dt: float = 0.0) -> control.StateSpace:
        """The same as python-control's."""
        return self.model(matrices, dt).to_control()


def held(a: Array, b: Array, nominal: Array, dt: float) -> tuple[Array, Array]:
    """A and B of x[k+1] = A x[k] + B u[k] for inputs held over dt, exact (matrix exponential)."""
    from scipy.signal import cont2discrete

    # states scaled by nominals: Pa beside m would cost the exponential its small entries
    scaled = a * nominal / nominal[:, None], b / nominal[:, None]
    n, m = b.shape
    discrete = cont2discrete((*scaled, np.zeros((1, n)), np.zeros((1, m))), dt, method="zoh")
    return discrete[0] * nominal[:, None] / nominal, discrete[1] * nominal[:, None]


def gramian(a: Array, b: Array, horizon: float) -> Array:
    """Controllability gramian over a finite time [s]: integral of exp(A t) B B' exp(A' t).

    Exists for any A. By doubling, W(2h) = W(h) + exp(A h) W(h) exp(A' h), from h so short that the
    series of its integrand ends; observability: ``gramian(A.T, C.T, horizon)``.
    """
    from scipy.linalg import expm

    size = float(np.linalg.norm(a, 2)) * require_positive("horizon", horizon, "s")
    doublings = max(0, int(np.ceil(np.log2(max(size, 1e-12) / 0.1))))
    h, n = horizon / 2**doublings, len(a)
    # van Loan: the exponential of one block matrix holds exp(A' h) and the integral
    block = expm(np.block([[-a, b @ b.T], [np.zeros((n, n)), a.T]]) * h)
    phi = block[n:, n:].T
    w = phi @ block[:n, n:]
    for _ in range(doublings):
        w = w + phi @ w @ phi.T
        phi = phi @ phi
    return np.asarray((w + w.T) / 2)


def _plain(names: Sequence[str]) -> list[str]:
    return [n.replace(".", "_") for n in names]


@verb
def linearize(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    dt: float | None = None,
    stuck: bool = False,
    units: Mapping[str, str] | Literal["display"] | None = None,
) -> control.StateSpace:
    """The plant near a point as python-control's StateSpace: x' = A x + B u, y = C x + D u.

    at : an OperatingPoint (of :func:`equilibrium`) or values by name; by default the start values.
    inputs, outputs : names to keep; by default all inputs, and all states and outputs. At a valve
        that stands in its dead zone the command has no slope: by default the opening stands in for
        it (``muscle_opening``, see :meth:`Plant.in_openings`); either may be named. Where a spool
        moves between the two it follows the opening as if there were no dead zone behind it.
    dt : sampling time [s] for a discrete system x[k+1] = A x[k] + B u[k], exact for inputs held
        over each sample; None for a continuous one.
    stuck : leave out held memories (hysteresis). In small motion about an equilibrium they stick
        and are springs; as states they bring a pole at zero each that no input reaches, and design
        by Riccati equations wants them out (``lqr`` and ``kalman`` see to it themselves). Transfer
        functions are the same; see :mod:`pam_ocp.operating.operating_point`.

    units : {variable: unit} in which signals and states count, as {"x": "mm", "muscle.pressure":
        "bar"}, or "display" for bar, mm and deg throughout; by default SI. Numbers of like size
        serve what computes from polynomials (``ss2tf``, zeros), and eyes.

    Warns where the point is none of rest, and names the state that changes most.

    Jacobians are exact (CasADi); signals keep the plant's names with ``_`` for ``.``, since
    python-control reads a dot as system.signal. ``system.units`` = {signal: unit}
    (python-control itself has none, so systems that it computes from this one lack it).

    Examples
    --------
    >>> system = pam.linearize(plant, point)
    >>> system.nstates, system.input_labels
    (3, ['muscle_command'])
    >>> scaled = pam.linearize(plant, point, units="display")  # in mm and bar
    >>> bool(np.allclose(np.sort(scaled.poles()), np.sort(system.poles())))
    True
    """
    return linear_model(
        plant, at, inputs=inputs, outputs=outputs, dt=dt, stuck=stuck, units=units
    ).to_control()


def linear_model(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    dt: float | None = None,
    stuck: bool = False,
    units: Mapping[str, str] | Literal["display"] | None = None,
) -> LinearModel:
    """What :func:`linearize` gives, before python-control is loaded for it."""
    plant, x, u = point_of(plant, at)
    warn_off_rest(plant, x, u)
    plant, x_rows, rows = _seen(plant, x[None, :], u[None, :], inputs)
    chosen = _Selection.of(plant, inputs, outputs)
    a, b, c, d = chosen.matrices(x_rows, rows)
    step = 0.0 if dt is None else require_positive("dt", dt, "s")
    chosen = replace(chosen, units=_units_of(plant, units))
    if not stuck:
        return chosen.model((a[0], b[0], c[0], d[0]), step)
    follow = OperatingPoint(plant, x_rows[0], rows[0]).stuck
    return chosen.model((*follow.reduced(a[0], b[0], c[0]), d[0]), step, follow.kept.tolist())


def _units_of(plant: Plant, units: Mapping[str, str] | str | None) -> dict[str, str]:
    """{variable: unit it is to count in}, where that is not its SI unit."""
    require_instance("units", units, (Mapping, str), "give {variable: unit}", none=True)
    if units is None:
        return {}
    if isinstance(units, str):
        if units != "display":
            raise InputError(f"units = {units!r}: give {{variable: unit}}, 'display', or None")
        return {v.name: v.display_unit for v in plant.variables}
    found = {}
    for name, wanted in units.items():
        variable = plant.variable(name)
        if not unit(wanted).compatible(unit(variable.unit)):
            raise InputError(
                f"units[{name!r}] = {wanted!r}: this measures something else than {variable.unit!r}"
            )
        found[variable.name] = wanted
    return found


# ---- along a motion -----------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class LinearAlong:
    """A(t), B(t), C(t), D(t) of small deviations from a motion: d' = A d + B w, e = C d + D w.

    t : (n,) [s]. x, u : the motion itself, (n, nx) and (n, nu), u of the kept inputs.
    A : (n, nx, nx), B : (n, nx, nu), C : (n, ny, nx), D : (n, ny, nu), SI units.
    """

    plant: Plant
    t: Array
    x: Array
    u: Array
    A: Array = field(repr=False)
    B: Array = field(repr=False)
    C: Array = field(repr=False)
    D: Array = field(repr=False)
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def at(self, t: float) -> Matrices:
        """A, B, C, D at a time [s], joined by straight lines; held outside."""
        i = int(np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2))
        share = float(np.clip((t - self.t[i]) / (self.t[i + 1] - self.t[i]), 0.0, 1.0))
        a, b, c, d = (m[i] + share * (m[i + 1] - m[i]) for m in (self.A, self.B, self.C, self.D))
        return a, b, c, d

    def system(self, t: float, dt: float | None = None) -> control.StateSpace:
        """The system frozen at a time [s], as :func:`linearize` gives it."""
        chosen = _Selection(self.plant, self.inputs, self.outputs)
        return chosen.system(self.at(t), 0.0 if dt is None else require_positive("dt", dt, "s"))


@verb
def linearize_along(
    plant: Plant,
    motion: Trajectory,
    *,
    t: ArrayLike | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> LinearAlong:
    """Exact Jacobians along a motion (a plan, a simulation) that holds all states and inputs.

    t : times [s]; by default those of the motion. Between the samples of the motion its states
    are joined by straight lines: give a finely sampled one (``plan.replay.trajectory``).
    inputs : as in :func:`linearize`: where a valve's command is in its dead zone anywhere on the
        way, the default are openings.
    Raises InputError when the motion lacks a state or an input of the plant.

    Examples
    --------
    >>> along = pam.operating.linearize_along(plant, motion, t=[0.1, 0.2])
    >>> along.A.shape
    (2, 3, 3)
    """
    missing = [v.name for v in (*plant.states, *plant.inputs) if v.name not in motion]
    if missing:
        raise InputError(f"the motion holds no column {missing[0]!r} of plant {plant.name!r}")
    if t is not None:
        motion = motion.at(t)
    x = motion.array([v.name for v in plant.states])
    plant, x, u = _seen(plant, x, motion.array([v.name for v in plant.inputs]), inputs)
    chosen = _Selection.of(plant, inputs, outputs)
    matrices = chosen.matrices(x, u)
    kept = [[v.name for v in plant.inputs].index(n) for n in chosen.inputs]
    return LinearAlong(
        plant,
        motion.t,
        x,
        u[:, kept],
        *matrices,
        tuple(chosen.inputs),
        tuple(chosen.outputs),
    )


# ---- over a grid --------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class LinearGrid:
    """A family of linear systems over a grid of equilibria: ``family(x=0.002)`` interpolates.

    axes : {name: (n_i,) rising values}. points : array of OperatingPoint of shape (n_1, n_2, ...).
    A, B, C, D : (n_1, n_2, ..., rows, columns).
    """

    plant: Plant
    axes: dict[str, Array]
    points: NDArray[Any] = field(repr=False)
    A: Array = field(repr=False)
    B: Array = field(repr=False)
    C: Array = field(repr=False)
    D: Array = field(repr=False)
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def interpolated(self, values: Array, where: Mapping[str, float]) -> Array:
        """``values`` (n_1, n_2, ..., any shape) at a place of the grid, linear along each axis.

        Raises InputError outside the grid.
        """
        weights, corners = self._corners(where)
        return np.asarray(
            sum(w * values[corner] for w, corner in zip(weights, corners, strict=True))
        )

    def _corners(self, where: Mapping[str, float]) -> tuple[list[float], list[tuple[int, ...]]]:
        given = {self.plant.variable(n).name: float(v) for n, v in where.items()}
        if set(given) != set(self.axes):
            raise InputError(f"give a value for each axis of the grid: {', '.join(self.axes)}")
        sides = []
        for name, axis in self.axes.items():
            value, variable = given[name], self.plant.variable(name)
            slack = 1e-9 * variable.nominal
            if not axis[0] - slack <= value <= axis[-1] + slack:
                raise InputError(
                    f"{name} = {variable.exactly(value)} is outside the grid "
                    f"{variable.exactly(axis[0])} .. {variable.exactly(axis[-1])}"
                )
            i = int(np.clip(np.searchsorted(axis, value, side="right") - 1, 0, len(axis) - 2))
            share = float(np.clip((value - axis[i]) / (axis[i + 1] - axis[i]), 0.0, 1.0))
            sides.append([(1 - share, i), (share, i + 1)])
        corners = list(itertools.product(*sides))
        return (
            [float(np.prod([w for w, _ in corner])) for corner in corners],
            [tuple(i for _, i in corner) for corner in corners],
        )

    @cached_property
    def x(self) -> Array:
        """States at rest (n_1, n_2, ..., nx)."""
        return self._stacked("x")

    @cached_property
    def u(self) -> Array:
        """All inputs at rest (n_1, n_2, ..., nu)."""
        return self._stacked("u")

    def _stacked(self, name: str) -> Array:
        rows = np.array([getattr(p, name) for p in self.points.ravel()])
        return rows.reshape(*self.points.shape, -1)

    def __call__(
        self, where: Mapping[str, float] | None = None, /, *, dt: float | None = None, **more: float
    ) -> control.StateSpace:
        """The system at a place of the grid: ``family(x=0.002, stiffness=2.1e4)``."""
        place = {**(where or {}), **more}
        a, b, c, d = (self.interpolated(m, place) for m in (self.A, self.B, self.C, self.D))
        chosen = _Selection(self.plant, self.inputs, self.outputs)
        return chosen.system((a, b, c, d), 0.0 if dt is None else require_positive("dt", dt, "s"))

    def systems(self) -> list[tuple[OperatingPoint, control.StateSpace]]:
        """Every point of the grid with its system."""
        chosen = _Selection(self.plant, self.inputs, self.outputs)
        return [
            (
                self.points[i],
                chosen.system((self.A[i], self.B[i], self.C[i], self.D[i])),
            )
            for i in np.ndindex(self.points.shape)
        ]


@verb
def linearize_grid(
    plant: Plant,
    axes: Mapping[str, ArrayLike],
    conditions: Values | None = None,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    memory: Memory = "virgin",
) -> LinearGrid:
    """Linear systems at the equilibria over a grid of conditions, to interpolate in.

    axes : {name: at least two rising values} of states, inputs, outputs or parameters, as
        conditions of :func:`equilibrium`: ``{"x": [-0.01, 0, 0.01], "stiffness": [1.8e4, 2.4e4]}``.
    conditions, memory : further ones of :func:`equilibrium`, the same everywhere.
    inputs : as in :func:`linearize`; of a plant fed by valves the default are openings.

    Raises InputError for bad axes, EquilibriumError naming the first place without equilibrium.

    Examples
    --------
    >>> grid = pam.operating.linearize_grid(plant, {"x": [0.02, 0.03, 0.04]})
    >>> grid.inputs, grid.outputs[:2]
    (('muscle.command',), ('x', 'v'))
    """
    inversion = Inversion(require_plant(plant))
    if inputs is None or any(inversion.opening_of(n) for n in inputs):
        # at rest valves are closed, or nearly so
        plant, conditions = inversion.inner, inversion.conditions(conditions)
    grid: dict[str, Array] = {}
    for name, values in axes.items():
        variable = plant.variable(name)
        axis = np.asarray(require_numbers(f"axes[{name!r}]", values, variable.unit), float)
        if axis.ndim != 1 or len(axis) < 2 or not np.all(np.diff(axis) > 0):
            raise InputError(f"axes[{name!r}] must hold at least two rising values")
        grid[variable.name] = axis
    if not grid:
        raise InputError("axes is empty: name at least one variable with its values")
    shape = tuple(len(a) for a in grid.values())
    points = np.empty(shape, dtype=object)
    last: OperatingPoint | None = None
    for index in np.ndindex(shape):
        place = {n: float(a[i]) for (n, a), i in zip(grid.items(), index, strict=True)}
        try:
            given = {**(conditions or {}), **place}
            last = equilibrium(plant, given, guess=last, memory=memory)
        except EquilibriumError as error:
            where = ", ".join(f"{n} = {plant.variable(n).shown(v)}" for n, v in place.items())
            raise EquilibriumError(f"grid point {where}: {error}") from None
        points[index] = last
    chosen = _Selection.of(plant, inputs, outputs)
    found = []
    for point in points.ravel():
        at = _Selection(point.plant, chosen.inputs, chosen.outputs)
        found.append(at.matrices(point.x[None, :], point.u[None, :]))
    a, b, c, d = (
        np.concatenate(m).reshape(*shape, *m[0].shape[1:]) for m in zip(*found, strict=True)
    )
    return LinearGrid(plant, grid, points, a, b, c, d, tuple(chosen.inputs), tuple(chosen.outputs))


def chosen_signals(
    argument: str, plant: Plant, names: Sequence[str] | None, allowed: tuple[str, ...]
) -> list[str]:
    """The plant's spelling of names, all of the allowed causalities when None is given."""
    known = [v for a in allowed for v in plant.variables if v.causality == a]
    if names is None:
        return [v.name for v in known]
    names = [names] if isinstance(names, str) else names
    chosen = [plant.variable(n) for n in names]
    for variable in chosen:
        if variable.causality not in allowed:
            raise InputError(
                f"{argument}: {variable.name} is {variable.kind}; choose among "
                f"{', '.join(v.name for v in known)}"
            )
    return [v.name for v in chosen]


@verb
def modes(system: control.StateSpace) -> list[tuple[float, float]]:
    """(natural frequency [Hz], damping ratio) of each oscillating pair of poles, slowest first.

    Raises InputError for what is no system of python-control.

    Examples
    --------
    >>> ((frequency, ratio),) = pam.operating.modes(plant.linearize(point))
    >>> print(f"{frequency:.2f} Hz, damping ratio {ratio:.2f}")
    4.46 Hz, damping ratio 0.18
    """
    if not callable(getattr(system, "poles", None)):
        raise InputError(
            f"modes: system is {kind_of(system)}, not a control.StateSpace, such as "
            "plant.linearize(point)"
        )
    poles = np.asarray(system.poles())
    pairs = poles[poles.imag > 1e-9 * np.abs(poles)]
    found = [(abs(s) / (2 * np.pi), -s.real / abs(s)) for s in pairs]
    return sorted((float(f), float(z)) for f, z in found)

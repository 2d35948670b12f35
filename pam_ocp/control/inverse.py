"""Inverse dynamics: the pressures that give a position an acceleration (and a pair its
stiffness).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..core.block import Block
from ..core.errors import InputError
from ..core.stop import locked
from ..plants.plant import Plant, require_plant
from .blocks.draft import Draft, Symbol, as_output, per
from .kinds import BLOCKS, Array

STEPS = 16
"""Of Newton's method where the equations are not straight lines of the pressures."""
MISS = 1e-6
"""Relative miss of acceleration and stiffness that counts as met."""
SETTLED = 1e-5, 1e-2
"""Or a step so short, in parts of the range, that ends within it, and a miss no larger than the
second: in single precision the miss stays above MISS."""
LEVELS = 41
"""Pressures that are tried for a pair's usual stiffness."""
SLACK = 0.01
"""Part of its largest force below which a muscle counts as slack there."""
RANK = 4.5e-16
"""Singular values in this ratio count as one (that of NumPy's lstsq)."""


@locked
class InverseDynamics:
    """(position, velocity, acceleration, stiffness) -> pressures of the plant's muscles.

    plant : one position moved by one muscle (then there is no choice of stiffness) or by two
        (``stiffness`` chooses the co-contraction).

    Newton's method on the plant's own equations: der(velocity) = acceleration and the output
    ``stiffness``; exact after one step where both are linear in the pressures (six-parameter law,
    constant damping, taut muscles), the same as :class:`Allocation` and ``Muscle.pressure`` then.
    Pressures are kept within the plant's range: where not both are possible the acceleration comes
    before the stiffness, and the nearest to each is taken.
    States other than position, velocity and pressures are taken at their start values, or as the
    call gives them.

    Examples
    --------
    >>> inverse = pam.control.InverseDynamics(plant)
    >>> (pressure,) = inverse(0.04, 0.0, 0.0)
    >>> round(float(pressure)) == round(point["muscle.pressure"])
    True
    """

    def __init__(self, plant: Plant) -> None:
        require_plant(plant)
        if len(plant.load_positions) > 1 and not self._driven(plant):
            raise InputError(
                f"InverseDynamics: in {plant.name!r} no pressure acts on the acceleration of its "
                "load, only through a tendon or another mass (higher relative degree): the "
                "pressures that a motion needs follow from its third and fourth derivatives. Plan "
                "the motion with plan(), and hold it by tvlqr()"
            )
        if len(plant.load_positions) != 1:
            raise InputError(
                f"InverseDynamics needs a plant with one position; {plant.name!r} has "
                f"{', '.join(plant.load_positions) or 'none'}"
            )
        ((self.position, self.velocity),) = plant.load_positions.items()
        self.plant = plant
        where = {v.name: i for i, v in enumerate((*plant.states, *plant.inputs))}
        pressures = [n for n in where if n.endswith(".pressure")]
        if len(pressures) not in (1, 2):
            raise InputError(
                f"InverseDynamics needs one or two muscles; {plant.name!r} has the pressures "
                f"{', '.join(pressures) or 'none'}"
            )
        self.muscles = [n.removesuffix(".pressure") for n in pressures]
        self._place = [where[n] for n in pressures]
        self._at = where[self.position], where[self.velocity]
        self.low, self.high = (
            np.array([getattr(plant.variable(n), a) for n in pressures]) for a in ("min", "max")
        )
        self._where = where
        self._z = np.concatenate([plant.vector("state"), plant.vector("input")])
        self._p = plant.vector("parameter")
        self.equations = self._build(pressures)
        """z -> (acceleration[, stiffness], slopes over the pressures)."""
        self.function = self._solved()
        """(z, acceleration[, stiffness]) -> pressures; those in z do not count."""

    @staticmethod
    def _driven(plant: Plant) -> bool:
        """Whether a pressure stands in the equation of motion of the first position."""
        velocity = next(iter(plant.load_positions.values()))
        symbols = {s.name() for s in ca.symvar(plant.expression(f"der({velocity})"))}
        return any(n.endswith(".pressure") for n in symbols)

    def _build(self, pressures: list[str]) -> ca.Function:
        """(states and inputs) -> (acceleration[, stiffness]), slopes over pressures."""
        plant = self.plant
        asked = [plant.expression(f"der({self.velocity})")]
        if len(pressures) == 2:
            asked.append(plant.expression("stiffness"))
        column = ca.vertcat(*asked)
        slopes = ca.jacobian(column, ca.vertcat(*(plant.expression(n) for n in pressures)))
        z = ca.vertcat(plant.x, plant.u)
        whole = ca.Function("inverse", [z, plant.p], [column, ca.densify(slopes)])
        here = ca.SX.sym("z", z.numel())
        values, steep = whole(here, ca.DM(self._p))
        return ca.Function("inverse", [here], [values, steep], {"cse": True})

    def require_stiffness(self, stiffness: float | None) -> None:
        """InputError where a pair lacks its stiffness, or a single muscle has one."""
        if (len(self.muscles) == 2) != (stiffness is not None):
            raise InputError(
                f"{self.plant.name!r} has {len(self.muscles)} muscle(s): give a stiffness for a "
                "pair and none for a single one"
            )

    def __call__(
        self,
        position: float,
        velocity: float,
        acceleration: float,
        stiffness: float | None = None,
        states: Mapping[str, float] | None = None,
    ) -> Array:
        """Pressures [Pa], one per muscle. Raises InputError when a pair lacks its stiffness.

        states : values of other states (memories), kept until the next call that names them.
        """
        self.require_stiffness(stiffness)
        target = np.array([acceleration] if stiffness is None else [acceleration, stiffness])
        for name, value in (states or {}).items():
            self._z[self._where[name]] = value
        self._z[list(self._at)] = position, velocity
        return np.asarray(self.function(self._z, target), dtype=float).ravel()

    def points(self, position: ArrayLike, velocity: ArrayLike, pressures: ArrayLike) -> Array:
        """States and inputs of the plant in columns, of rows of position, velocity, pressures."""
        x = np.asarray(position, dtype=float)
        z = np.tile(self._z[:, None], (1, len(x)))
        z[list(self._at)] = x, np.asarray(velocity, dtype=float)
        z[self._place] = np.asarray(pressures, dtype=float).T
        return np.asarray(z)

    def accelerations(
        self, position: ArrayLike, velocity: ArrayLike, pressures: ArrayLike
    ) -> Array:
        """The plant's accelerations, of rows of positions, velocities and pressures."""
        z = self.points(position, velocity, pressures)
        values: Any = self.equations.map(z.shape[1])(z)
        found: Array = np.array(values[0], dtype=float)[0]
        return found

    # ---- the search of pressures in z, states and inputs of the plant ---------------------------
    @property
    def steps(self) -> int:
        """Of Newton's method in each search; one for straight lines, and one for rounding."""
        z = ca.SX.sym("z", len(self._z))
        pressures = ca.vertcat(*(z[int(i)] for i in self._place))
        slopes = ca.vec(self.equations(z)[1])
        return STEPS if any(ca.which_depends(slopes, pressures, 1, True)) else 2

    def _solved(self) -> ca.Function:
        """(z, acceleration[, stiffness]) -> pressures; those in z do not count.

        Newton's method within the range, and where not both are possible one muscle at an end of
        its range: one function for Python and for targets, each call of which takes the same time.
        """
        n = len(self._place)
        z, target = ca.MX.sym("z", len(self._z)), ca.MX.sym("target", n)
        taut = ca.DM(self.high)  # a slack muscle has no slope to begin from
        both = self._search(list(range(n)), list(range(n)))
        pressures, miss, inside = both(taut, z, target)
        if n == 1:
            return ca.Function("inverse_dynamics", [z, target], [pressures])
        met = ca.logic_or(ca.fmax(miss[0], miss[1]) <= MISS, inside)
        alone = [self._search([0], [1 - i]) for i in (0, 1)]
        best: Any = taut
        least: Any = (ca.MX(np.inf), ca.MX(np.inf))
        for i, ends in product((0, 1), (self.low, self.high)):
            start = np.array(self.high)
            start[i] = ends[i]
            p, missed, within = alone[i](ca.DM(start), z, target)
            first = ca.if_else(ca.logic_or(missed[0] <= MISS, within), 0, missed[0])
            ahead = ca.logic_and(first == least[0], missed[1] < least[1])
            better = ca.logic_or(first < least[0], ahead)
            best = _either(better, p, best)
            least = tuple(
                ca.if_else(better, new, old)
                for new, old in zip((first, missed[1]), least, strict=True)
            )
        return ca.Function("inverse_dynamics", [z, target], [_either(met, pressures, best)])

    def _search(self, equations: list[int], unknown: list[int]) -> ca.Function:
        """(pressures to begin from, z, target) ->
        (pressures, what is missed, relative, whether the unknown ones settled within their range).
        """
        n = len(self._place)
        w, z, target = (ca.SX.sym(k, m) for k, m in (("w", n), ("z", len(self._z)), ("t", n)))
        here = ca.SX(z)
        for i, place in enumerate(self._place):
            here[int(place)] = w[i]
        values, slopes = self.equations(here)
        missed = values - target
        step = _shortest(slopes[equations, unknown], missed[equations])
        moved, inside = ca.SX(w), ca.SX(1)
        for k, i in enumerate(unknown):
            low, high = float(self.low[i]), float(self.high[i])
            moved[i] = ca.fmin(ca.fmax(w[i] - step[k], low), high)
            within = ca.logic_and(w[i] > low, w[i] < high)
            settled = ca.fabs(step[k]) <= SETTLED[0] * (high - low)
            inside = ca.logic_and(inside, ca.logic_and(within, settled))
        label = f"newton_{''.join(map(str, equations))}_{''.join(map(str, unknown))}"
        one = ca.Function(label, [w, z, target], [moved], {"cse": True})
        size = ca.fabs(missed) / ca.fmax(ca.fabs(target), 1)
        for i in equations:
            inside = ca.logic_and(inside, size[i] <= SETTLED[1])
        rest = ca.Function(f"{label}_missed", [w, z, target], [size, inside], {"cse": True})
        arguments = [ca.MX.sym(k, m) for k, m in (("w", n), ("z", len(self._z)), ("t", n))]
        p = arguments[0]
        for _ in range(self.steps):
            p = one(p, *arguments[1:])
        results = [p, *rest(p, *arguments[1:])]
        return ca.Function(f"{label}_search", arguments, results)


def _either(condition: Any, yes: Any, no: Any) -> Any:
    pairs = zip(ca.vertsplit(ca.MX(yes)), ca.vertsplit(ca.MX(no)), strict=True)
    return ca.vertcat(*(ca.if_else(condition, a, b) for a, b in pairs))


def _shortest(matrix: ca.SX, right: ca.SX) -> ca.SX:
    """The shortest step of least squares of one or two equations of as many unknowns."""
    if matrix.numel() == 1:
        there = ca.fabs(matrix) > 0
        return ca.if_else(there, right / ca.if_else(there, matrix, 1), 0)
    a, b, c, d = matrix[0, 0], matrix[0, 1], matrix[1, 0], matrix[1, 1]
    determinant, size = a * d - b * c, a * a + b * b + c * c + d * d
    whole = ca.fabs(determinant) > RANK * size
    safe = ca.if_else(whole, determinant, 1)
    exact = ca.vertcat(d * right[0] - b * right[1], a * right[1] - c * right[0]) / safe
    spread = ca.if_else(size > 0, size, 1)
    flat = ca.mtimes(matrix.T, right) / spread
    return ca.vertcat(*(ca.if_else(whole, exact[i], flat[i]) for i in (0, 1)))


# ---- in blocks ----------------------------------------------------------------------------------
def wanted_motion(
    draft: Draft, inverse: InverseDynamics, start: tuple[float, float, float], first: str = "wanted"
) -> tuple[Symbol, Symbol, Symbol]:
    """Inputs for position, velocity and acceleration."""
    plant = inverse.plant
    position, velocity = (plant.variable(n) for n in (inverse.position, inverse.velocity))
    moved = [
        draft.wanted(v, value, first) for v, value in zip((position, velocity), start, strict=False)
    ]
    acceleration = draft.input(
        f"{first}.acceleration",
        start[2],
        unit=per(velocity.unit, "s") if "/" not in velocity.unit else f"{velocity.unit}2",
        nominal=10.0 * velocity.nominal,
        description="to be reached: acceleration",
    )
    return moved[0], moved[1], acceleration


def stiffness_of(plant: Plant) -> float:
    """The stiffness of a pair at its start values; where a muscle is slack there, at pressures
    halfway between those from which on both pull and the highest ones.
    """
    everything = [v.name for v in (*plant.states, *plant.inputs)]
    pressures = [n for n in everything if n.endswith(".pressure")]
    known = {v.name for v in plant.outputs}
    forces = [f for n in pressures if (f := n.removesuffix("pressure") + "force") in known]
    asked = ca.vertcat(*(plant.expression(n) for n in ("stiffness", *forces)))
    at = ca.Function("at", [ca.vertcat(plant.x, plant.u), plant.p], [asked])
    shares = np.linspace(0.0, 1.0, LEVELS)
    z = np.concatenate([plant.vector("state"), plant.vector("input")])
    points = np.tile(z[:, None], LEVELS)
    for name in pressures:
        row, most = points[everything.index(name)], plant.variable(name).max
        row += shares * max(most - row[0], 0.0) if np.isfinite(most) else 0.0
    p = np.tile(plant.vector("parameter")[:, None], LEVELS)
    stiffness, *pull = np.asarray(at.map(LEVELS)(points, p))
    taut = np.all([f > SLACK * f.max() for f in pull], axis=0)
    if not pull or taut[0] or not taut.any():
        return float(stiffness[0])
    return float(stiffness[(int(np.argmax(taut)) + LEVELS) // 2])


def wanted_stiffness(
    draft: Draft, plant: Plant, start: float | None, first: str = "wanted"
) -> Symbol:
    """The input for the stiffness of a pair."""
    return draft.wanted(plant.variable("stiffness"), float(start or 0.0), first)


def pressures_of(
    draft: Draft,
    inverse: InverseDynamics,
    x: Symbol,
    v: Symbol,
    a: Symbol,
    stiffness: Symbol | None,
    states: dict[str, Symbol] | None = None,
) -> Symbol:
    """Pressures of the muscles by inverse dynamics; states : of memories, by name."""
    count = inverse.steps
    draft.repeats("Newton steps of the inverse dynamics", count * (1 if stiffness is None else 5))
    target = a if stiffness is None else ca.vertcat(a, stiffness)
    return inverse.function(_at(inverse, x, v, states), target)


def _at(inverse: InverseDynamics, x: Symbol, v: Symbol, states: dict[str, Symbol] | None) -> Symbol:
    """States and inputs of the plant."""
    known = {inverse._at[0]: x, inverse._at[1]: v}
    known |= {inverse._where[n]: s for n, s in (states or {}).items()}
    return ca.vertcat(*(known.get(i, float(start)) for i, start in enumerate(inverse._z)))


def unreached(
    inverse: InverseDynamics,
    x: Symbol,
    v: Symbol,
    a: Symbol,
    p: Symbol,
    states: dict[str, Symbol] | None = None,
) -> Symbol:
    """What is left of an acceleration where all pressures are at an end of their range, else 0."""
    at = ca.vertsplit(_at(inverse, x, v, states))
    for i, place in enumerate(inverse._place):
        at[place] = p[i]
    at_ends = ca.logic_or(p <= ca.DM(inverse.low), p >= ca.DM(inverse.high))
    return ca.if_else(ca.mmin(at_ends), a - inverse.equations(ca.vertcat(*at))[0][0], 0)


@BLOCKS.register("InverseDynamics")
def inverse_dynamics(
    inverse: InverseDynamics, name: str = "inverse", *, sample_time: float = 1e-3
) -> Block:
    """Feed-forward alone: outputs ``wanted.MUSCLE.pressure`` of a motion, for a PressureLoop.

    As :class:`InverseDynamics`. sample_time : [s].
    """
    plant = inverse.plant
    draft = Draft(name, sample_time, "inverse dynamics", ca.MX)
    start = plant.variable(inverse.position).start or 0.0
    x, v, a = wanted_motion(draft, inverse, (start, 0.0, 0.0))
    k = None
    if len(inverse.muscles) == 2:
        k = wanted_stiffness(draft, plant, stiffness_of(plant))
    p = pressures_of(draft, inverse, x, v, a, k)
    for i, m in enumerate(inverse.muscles):
        pressure = as_output(plant.variable(f"{m}.pressure"))
        words = f"gauge pressure of {m} that the motion needs"
        draft.output(replace(pressure, name=f"wanted.{pressure.name}", description=words), p[i])
    return draft.block()

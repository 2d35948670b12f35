"""Allocation: which two pressures give an antagonistic pair a force (torque) and a stiffness."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import (
    InputError,
    PamError,
    broadcast,
    require_ends,
    require_finite,
    require_numbers,
)
from ..core.stop import locked, verb
from ..numerics.newton import iterate
from ..plants.plant import Plant

Array: TypeAlias = NDArray[np.float64]

ITERATIONS = 50
BAR = 1e5
"""Size of a pressure [Pa]: unknowns are of order one."""
SETTLED = 1e-13
"""Change of a pressure that no longer counts, in bar."""


class AllocationError(PamError):
    """No pressures within the plant's range give what was asked for.

    Examples
    --------
    >>> pam.operating.Allocation(slide).stiffness_range(0.0, 5e3)
    Traceback (most recent call last):
    pam_ocp.operating.allocation.AllocationError: effort 5000 is out of reach at x = 0: ...
    """


@verb
def common_and_difference(p1: ArrayLike, p2: ArrayLike) -> tuple[Array, Array]:
    """Co-contraction coordinates of a pair: ((p1 + p2)/2, (p1 - p2)/2) [Pa].

    Examples
    --------
    >>> [float(v) for v in pam.operating.common_and_difference(3e5, 1e5)]
    [200000.0, 100000.0]
    """
    one, two = _alike(p1=p1, p2=p2)
    return (one + two) / 2, (one - two) / 2


def _alike(*units: str, **values: Any) -> list[Array]:
    """Values in these units (pressures, where none is given) as arrays of one shape."""
    asked = zip(values.items(), units or ["Pa"] * len(values), strict=True)
    numbers = {name: require_numbers(name, v, unit) for (name, v), unit in asked}
    return [np.array(a) for a in broadcast(**numbers)]


@verb
def pressures_of(common: ArrayLike, difference: ArrayLike) -> tuple[Array, Array]:
    """The pressures (p1, p2) of co-contraction coordinates [Pa].

    Examples
    --------
    >>> [float(v) for v in pam.operating.pressures_of(2e5, 1e5)]
    [300000.0, 100000.0]
    """
    mean, half = _alike(common=common, difference=difference)
    return mean + half, mean - half


@locked
class Allocation:
    """(position, effort, stiffness) -> (p1, p2) of an antagonistic pair, and what is attainable.

    plant : an AntagonisticSlide or AntagonisticJoint (or any plant with ``muscle1``, ``muscle2``
        and one position). Effort is the force [N] or torque [N m] of both muscles, stiffness its
        negative slope over the position at constant pressures.

    With laws affine in pressure (six-parameter among them) both are linear in (p1, p2), so the
    answer is an exact 2x2 solve; other laws take a few Newton steps more. The laws' tensions are
    used without the clamp at zero: ask for ``taut`` pressures, or look at :meth:`feasible`.

    Examples
    --------
    >>> pair = pam.operating.Allocation(slide)
    >>> p1, p2 = pair.pressures(0.0, 0.0, 2e4)
    >>> bool(np.isclose(p1, p2))
    True
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        if len(plant.load_positions) != 1:
            raise InputError(
                f"Allocation needs a plant with one position; {plant.name!r} has "
                f"{', '.join(plant.load_positions) or 'none'}"
            )
        (self.position,) = plant.load_positions
        if not {"muscle1.pressure", "muscle2.pressure"} <= {v.name for v in plant.variables}:
            raise InputError(
                f"Allocation needs a pair, muscle1 and muscle2, which {plant.name!r} has not; give "
                "an AntagonisticSlide or AntagonisticJoint"
            )
        turns = plant.variable(self.position).unit == "rad"
        self._units = ("rad", "N.m", "N.m/rad") if turns else ("m", "N", "N/m")
        self._pressures = [plant.variable(f"muscle{i}.pressure") for i in (1, 2)]
        self._function = self._build()

    def _build(self) -> ca.Function:
        """(position, p1, p2, parameters) -> effort, stiffness, Jacobian over (p1, p2), tensions."""
        plant = self.plant
        z = plant.expression(self.position)
        p = [plant.expression(v.name) for v in self._pressures]
        tensions = [plant.expression(f"muscle{i}.tension") for i in (1, 2)]
        names = {v.name for v in plant.variables}
        arms = [
            plant.expression(f"muscle{i}.radius") if f"muscle{i}.radius" in names else ca.SX(1)
            for i in (1, 2)
        ]
        effort = arms[0] * tensions[0] - arms[1] * tensions[1]
        asked = ca.vertcat(effort, -ca.jacobian(effort, z))
        result = [asked, ca.jacobian(asked, ca.vertcat(*p)), ca.vertcat(*tensions)]
        try:
            return ca.Function("allocation", [z, *p, plant.p], [ca.densify(r) for r in result])
        except RuntimeError:
            raise InputError(
                f"Allocation: the muscles' tensions in {plant.name!r} depend on more than position "
                "and pressures (losses with memory or friction); build the plant without losses"
            ) from None

    def _call(self, position: Array, p: Array) -> tuple[Array, Array, Array]:
        """Efforts and stiffnesses (2, n), Jacobians (n, 2, 2), tensions (2, n)."""
        n = len(position)
        parts = self._function(position[None, :], p[0:1], p[1:2], self.plant.vector("parameter"))
        asked, jacobian, tensions = (np.asarray(part, float) for part in parts)
        return asked.reshape(2, n), jacobian.reshape(2, n, 2).transpose(1, 0, 2), tensions

    def pressures(
        self, position: ArrayLike, effort: ArrayLike, stiffness: ArrayLike
    ) -> tuple[Array, Array]:
        """The pressures [Pa] that give this effort and stiffness at this position (may lie outside
        the range: see :meth:`feasible`). Arrays broadcast.

        Raises AllocationError when the equations have no solution.
        """
        wanted = _alike(*self._units, position=position, effort=effort, stiffness=stiffness)
        z, target = wanted[0].ravel(), np.array([wanted[1].ravel(), wanted[2].ravel()])
        start = np.array([np.full(z.shape, (v.min + v.max) / 2) for v in self._pressures])

        def missed(w: Array) -> tuple[Array, Callable[[Array], Array]]:
            asked, jacobian, _ = self._call(z, w * BAR)
            return (
                asked - target,
                lambda right: np.linalg.solve(jacobian, right.T[:, :, None])[:, :, 0].T / BAR,
            )

        # each place is a pair of equations of its own; their steps are taken together
        root = iterate(missed, start / BAR, settled=SETTLED, steps=ITERATIONS, halvings=0)
        p = root.w * BAR
        asked, _, _ = self._call(z, p)
        worst = np.abs(asked - target) / np.maximum(np.abs(target), 1.0)
        if not np.all(worst < 1e-9):
            i = int(np.argmax(worst.max(axis=0)))
            raise AllocationError(
                f"no pressures give effort {target[0, i]:g} and stiffness {target[1, i]:g} at "
                f"{self.position} = {z[i]:g}"
            )
        return p[0].reshape(wanted[0].shape), p[1].reshape(wanted[0].shape)

    def feasible(
        self, position: ArrayLike, p1: ArrayLike, p2: ArrayLike, *, taut: bool = True
    ) -> NDArray[np.bool_]:
        """Whether pressures lie within the plant's range and (``taut``) both muscles pull."""
        z, one, two = _alike(self._units[0], "Pa", "Pa", position=position, p1=p1, p2=p2)
        p = np.array([one.ravel(), two.ravel()])
        good = np.ones(p.shape[1], bool)
        for variable, row in zip(self._pressures, p, strict=True):
            margin = 1e-9 * variable.nominal
            good &= (row >= variable.min - margin) & (row <= variable.max + margin)
        if taut:
            good &= np.all(self._call(z.ravel(), p)[2] >= -1e-9, axis=0)
        return np.asarray(good.reshape(z.shape))

    def effort_range(
        self, position: float, *, pressures: tuple[float, float] | None = None
    ) -> tuple[float, float]:
        """Smallest and largest effort at a position over the range of pressures."""
        (low1, high1), (low2, high2) = self._box(pressures)
        z = np.full(2, require_finite("position", position, self._units[0]))
        asked, _, _ = self._call(z, np.array([[low1, high1], [high2, low2]]))
        return float(asked[0, 0]), float(asked[0, 1])

    def stiffness_range(
        self,
        position: float,
        effort: float = 0.0,
        *,
        taut: bool = True,
        pressures: tuple[float, float] | None = None,
    ) -> tuple[float, float]:
        """Attainable stiffness at a position and effort: the ends of the co-contraction.

        taut : both muscles must pull; pressures : (lowest, highest) [Pa] instead of the plant's
        own. Raises AllocationError when the effort is out of reach.
        """
        box = self._box(pressures)
        position = require_finite("position", position, self._units[0])
        effort = require_finite("effort", effort, self._units[1])
        ends = self._ends(position, effort, box, taut)
        if ends is None:
            least, most = self.effort_range(position, pressures=pressures)
            raise AllocationError(
                f"effort {effort:g} is out of reach at {self.position} = {position:g}: "
                f"{least:.4g} .. {most:.4g} within the pressures"
                + (", and less when both muscles must pull" if taut else "")
            )
        asked, _, _ = self._call(np.full(2, position), np.array(ends).T)
        return float(asked[1].min()), float(asked[1].max())

    def _box(self, pressures: tuple[float, float] | None) -> list[tuple[float, float]]:
        if pressures is None:
            return [(v.min, v.max) for v in self._pressures]
        return [require_ends("pressures", pressures, "Pa")] * 2

    def _ends(
        self, z: float, effort: float, box: list[tuple[float, float]], taut: bool
    ) -> list[tuple[float, float]] | None:
        """Both ends (p1, p2) of the curve effort = constant inside the box (and the taut part).

        p2 rises with p1 along it; each end is where the first limit is met.
        """

        def partner(p1: float) -> float:
            def missed(w: Array) -> tuple[Array, Callable[[Array], Array]]:
                asked, jacobian, _ = self._call(np.array([z]), np.array([[p1], w * BAR]))
                return asked[0] - effort, lambda right: right / jacobian[0, 0, 1] / BAR

            start = np.array([(box[1][0] + box[1][1]) / 2])
            root = iterate(missed, start / BAR, settled=SETTLED, steps=ITERATIONS, halvings=0)
            return float(root.w[0]) * BAR

        def excess(p1: float) -> tuple[float, float]:
            """How far (p1, partner) lies beyond the lower and the upper limits (<= 0 inside)."""
            p2 = partner(p1)
            tensions = self._call(np.array([z]), np.array([[p1], [p2]]))[2][:, 0]
            below = max(box[0][0] - p1, box[1][0] - p2)
            if taut:  # in units of pressure: G is some 1e-3 N/Pa
                below = max(below, float(-tensions.min()) * 1e3)
            return below, max(p1 - box[0][1], p2 - box[1][1])

        # limits in order along the curve: all lower ones are met before all upper ones, or never
        low = _border(lambda p1: excess(p1)[0], box[0][0], box[0][1], falling=True)
        high = _border(lambda p1: excess(p1)[1], box[0][0], box[0][1], falling=False)
        if low is None or high is None or low > high * (1 + 1e-12):
            return None
        return [(low, partner(low)), (high, partner(high))]


def _border(
    function: Callable[[float], float], low: float, high: float, *, falling: bool
) -> float | None:
    """Where a monotone function of p1 passes zero on [low, high]: the end of its part <= 0."""
    inside, outside = (high, low) if falling else (low, high)
    if function(inside) > 1e-6:
        return None
    if function(outside) <= 0:
        return outside
    for _ in range(80):
        middle = (inside + outside) / 2
        inside, outside = (middle, outside) if function(middle) <= 0 else (inside, middle)
    return inside

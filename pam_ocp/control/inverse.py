"""Inverse dynamics: the pressures that give a position an acceleration (and a pair its
stiffness).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.stop import locked
from ..numerics.newton import iterate, least_squares
from ..plants.plant import Plant, require_plant

__all__ = ["InverseDynamics"]

Array: TypeAlias = NDArray[np.float64]
ITERATIONS = 30
SETTLED = 1e-4
"""Change of a pressure that no longer counts [Pa]."""
MISS = 1e-6
"""Relative miss of acceleration and stiffness that counts as met."""


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
        if len(plant.positions) > 1 and not self._driven(plant):
            raise InputError(
                f"InverseDynamics: in {plant.name!r} no pressure acts on the acceleration of its "
                "load, only through a tendon or another mass (higher relative degree): the "
                "pressures that a motion needs follow from its third and fourth derivatives. Plan "
                "the motion with plan(), and hold it by tvlqr()"
            )
        if len(plant.positions) != 1:
            raise InputError(
                f"InverseDynamics needs a plant with one position; {plant.name!r} has "
                f"{', '.join(plant.positions) or 'none'}"
            )
        ((self.position, self.velocity),) = plant.positions.items()
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
        self._function = self._build(pressures)

    @staticmethod
    def _driven(plant: Plant) -> bool:
        """Whether a pressure stands in the equation of motion of the first position."""
        velocity = next(iter(plant.positions.values()))
        symbols = {s.name() for s in ca.symvar(plant.expression(f"der({velocity})"))}
        return any(n.endswith(".pressure") for n in symbols)

    def _build(self, pressures: list[str]) -> ca.Function:
        """(states and inputs, parameters) -> (acceleration[, stiffness]), slopes over pressures."""
        plant = self.plant
        asked = [plant.expression(f"der({self.velocity})")]
        if len(pressures) == 2:
            asked.append(plant.expression("stiffness"))
        column = ca.vertcat(*asked)
        slopes = ca.jacobian(column, ca.vertcat(*(plant.expression(n) for n in pressures)))
        z = ca.vertcat(plant.x, plant.u)
        return ca.Function("inverse", [z, plant.p], [column, ca.densify(slopes)])

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
        if (len(self.muscles) == 2) != (stiffness is not None):
            raise InputError(
                f"{self.plant.name!r} has {len(self.muscles)} muscle(s): give a stiffness for a "
                "pair and none for a single one"
            )
        target = np.array([acceleration] if stiffness is None else [acceleration, stiffness])
        for name, value in (states or {}).items():
            self._z[self._where[name]] = value
        self._z[list(self._at)] = position, velocity
        both = list(range(len(self.muscles)))
        pressures, miss = self._solved((self.low + self.high) / 2, target, both, both)
        if np.abs(miss).max() <= MISS or len(self.muscles) == 1:
            return pressures
        return self._at_a_limit(target)

    def _solved(
        self, pressures: Array, target: Array, equations: list[int], unknown: list[int]
    ) -> tuple[Array, Array]:
        """Newton within the range for some of the pressures, and what is missed (relative)."""
        pressures, miss = pressures.copy(), np.zeros(len(target))

        def missed(w: Array) -> tuple[Array, Callable[[Array], Array]]:
            pressures[unknown] = w
            self._z[self._place] = pressures
            found, slopes = (np.asarray(m, dtype=float) for m in self._function(self._z, self._p))
            miss[:] = found.ravel() - target
            return miss[equations], least_squares(slopes[np.ix_(equations, unknown)])

        iterate(
            missed,
            pressures[unknown],
            settled=SETTLED,
            steps=ITERATIONS,
            halvings=0,
            within=(self.low[unknown], self.high[unknown]),
        )
        return pressures, miss / np.maximum(np.abs(target), 1.0)

    def _at_a_limit(self, target: Array) -> Array:
        """One muscle at an end of its range, the other one giving the acceleration: the pair with
        the nearest stiffness, or the nearest acceleration where none gives it."""
        best, least = (self.low + self.high) / 2, (np.inf, np.inf)
        for i, ends in itertools.product((0, 1), (self.low, self.high)):
            start = (self.low + self.high) / 2
            start[i] = ends[i]
            pressures, miss = self._solved(start, target, [0], [1 - i])
            missed = abs(float(miss[0])), abs(float(miss[1]))
            rank = (0.0 if missed[0] <= MISS else missed[0], missed[1])
            if rank < least:
                best, least = pressures, rank
        return np.asarray(best)

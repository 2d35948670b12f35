"""Inverse dynamics: the pressures that give a position an acceleration (and a pair its
stiffness).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.stop import locked
from ..plants.plant import Plant, require_plant
from .inverse_search import Search

__all__ = ["InverseDynamics"]

Array: TypeAlias = NDArray[np.float64]


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
        self.search = Search(self._build(pressures), len(self._z), self._place, self.low, self.high)
        self._pressures = self.search.function

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
        found, steep = whole(here, ca.DM(self._p))
        return ca.Function("inverse", [here], [found, steep], {"cse": True})

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
        return np.asarray(self._pressures(self._z, target), dtype=float).ravel()

"""Equilibria along a varying value, and their eigenvalues."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import courtesy
from ..core.errors import InputError, require_numbers
from ..core.stop import turns, verb
from ..numerics.newton import Array, NewtonError, casadi_equations, newton
from ..plants.plant import Plant
from .held import Memory
from .rest import VariedRest
from .resting_point import EquilibriumError, OperatingPoint, equilibrium

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class StabilityPath:
    """Equilibria along the values of a parameter or an input, and their eigenvalues.

    Examples
    --------
    >>> path = pam.vibration.stability_path(
    ...     regulated, "muscle.gain", [1e5, 1e7], x=0.04, muscle_reference=0.04
    ... )
    >>> path.stable
    array([ True, False])
    """

    plant: Plant
    parameter: str
    values: Array
    """(n,) [unit of the parameter]."""
    points: tuple[OperatingPoint, ...]
    eigenvalues: NDArray[np.complex128]
    """(n, states but held memories) [1/s]; a column follows one eigenvalue along the path."""
    scaled: Array
    """(n, states + inputs) scaled by nominals."""

    @property
    def growth(self) -> Array:
        """Largest real part at each point [1/s]; the rest is stable where it is negative."""
        return np.asarray(self.eigenvalues.real.max(axis=1))

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Whether each equilibrium is stable."""
        return np.asarray(self.growth < 0)

    @turns
    def column(self, name: str) -> Array:
        """A state, input or output along the path [its unit]."""
        return np.array([point[name] for point in self.points])

    def plot(self) -> Figure:
        """Eigenvalues in the complex plane, and growth rates over the parameter."""
        return courtesy.plot_stability(self)


@verb
def stability_path(
    plant: Plant,
    parameter: str,
    values: ArrayLike,
    conditions: Mapping[str, float] | None = None,
    /,
    *,
    memory: Memory = "virgin",
    time_limit: float | None = None,
    **more: float,
) -> StabilityPath:
    """Eigenvalues of the plant along a path of equilibria.

    Parameters
    ----------
    parameter : name of the parameter (or the input) that varies. values : (n,) [its unit].
    conditions, memory : as for :func:`pam_ocp.equilibrium`: one condition for each input (a varied
        input is one).

    time_limit : [s]; OutOfTime when it is over before there is a result.

    Each point is continued from the last by Newton with exact Jacobians.
    Raises UnknownNameError, InputError for values out of range, EquilibriumError where no point of
    rest exists (with the value at which the path ended).

    Examples
    --------
    >>> rest = {"muscle.command": 3e5}
    >>> path = pam.vibration.stability_path(plant, "mass", [5.0, 10.0, 20.0], rest)
    >>> path.stable
    array([ True,  True,  True])
    """
    rest = VariedRest(plant, parameter, {**(conditions or {}), **more}, memory)
    numbers = np.atleast_1d(require_numbers("values", values, rest.variable.unit))
    if numbers.ndim != 1 or not numbers.size:
        raise InputError("values must be a row of at least one number")
    for value in numbers:
        rest.variable.check(value)
    path: list[Array] = []
    eigenvalues: list[NDArray[np.complex128]] = []
    for value in map(float, numbers):
        try:
            path.append(_next(rest, path[-1], value) if path else _first(rest, value))
        except EquilibriumError as error:
            shown = rest.variable.shown(value)
            raise EquilibriumError(
                f"the path ends at {rest.variable.name} = {shown}: {error}"
            ) from None
        found = rest.eigenvalues(path[-1], value)
        eigenvalues.append(_followed(eigenvalues[-1], found) if eigenvalues else np.sort(found))
    return StabilityPath(
        plant,
        rest.variable.name,
        numbers,
        tuple(rest.at(z, float(v)) for z, v in zip(path, numbers, strict=True)),
        np.array(eigenvalues),
        np.array(path),
    )


def _first(rest: VariedRest, value: float) -> Array:
    """Scaled equilibrium at a value, from nothing. Raises EquilibriumError."""
    point = equilibrium(rest.plant, rest.given(value))
    return np.asarray(np.concatenate([point.x, point.u]) / rest.nominal)


def _next(rest: VariedRest, z: Array, value: float) -> Array:
    """Equilibrium at a value, continued from a near one; from nothing where that fails."""
    try:
        lam = value / rest.variable.nominal
        found, _ = newton(casadi_equations(rest.function, lam, rest.constants), z)
    except NewtonError:
        return _first(rest, value)
    return found if rest.inside(found) else _first(rest, value)


def _followed(
    last: NDArray[np.complex128], found: NDArray[np.complex128]
) -> NDArray[np.complex128]:
    """``found`` in the order of ``last``: nearest pairs first."""
    distance = np.abs(last[:, None] - found[None, :])
    order = np.empty(len(last), dtype=int)
    for _ in last:
        i, j = np.unravel_index(np.argmin(distance), distance.shape)
        order[i] = j
        distance[i, :], distance[:, j] = np.inf, np.inf
    return found[order]

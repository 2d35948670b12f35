"""Points of rest along a varying value, their eigenvalues, and what a border needs of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import courtesy
from ..core.errors import InputError
from ..numerics.newton import Array, VibrationError, casadi_equations, newton
from ..plants.plant import Plant, Values
from .equilibrium import EquilibriumError, OperatingPoint, equilibrium
from .held import Memory, held

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Rest", "StabilityPath", "stability_path"]


class Rest:
    """The equations of rest of a plant under conditions, with one value left to vary.

    The varying value is a parameter, or an input (or anything else that may be a condition).
    Everything is scaled by nominals: z = (x, u)/nominal, lam = value/nominal.
    """

    def __init__(
        self, plant: Plant, parameter: str, conditions: Values, memory: Memory = "virgin"
    ) -> None:
        self.variable = plant.variable(parameter)
        given = {plant.variable(n).name: float(v) for n, v in conditions.items()}
        given.pop(self.variable.name, None)
        constants = {n: v for n, v in given.items() if plant.variable(n).causality == "parameter"}
        self.plant = plant.with_values(constants)
        self.pinned = held(self.plant, memory)
        self.pinned.update({n: v for n, v in given.items() if n in self.pinned})
        kept = {*constants, *self.pinned}
        self.targets = {n: v for n, v in given.items() if n not in kept}
        varies = self.variable.causality != "parameter"
        named = {*self.targets, self.variable.name}
        outside = {v.name: v.start or 0.0 for v in plant.inputs if v.disturbance}
        outside = {n: start for n, start in outside.items() if n not in named}
        needed = len(plant.inputs) - varies
        if len(self.targets) + len(outside) == needed:
            self.targets.update(outside)  # as pam_ocp.operating.equilibrium does
        if len(self.targets) != needed:
            raise InputError(
                f"{plant.name!r} has {len(plant.inputs) - len(outside)} input(s) to choose, so "
                "with "
                f"{self.variable.name} varied {needed - len(outside)} condition(s) are needed for "
                "its "
                f"points of rest; {len(self.targets)} given: {', '.join(self.targets) or 'none'}"
            )
        self.nx = len(plant.states)
        self.nominal = np.concatenate(
            [plant.vector(c, attribute="nominal") for c in ("state", "input")]
        )
        self.names = (*self.targets, *((self.variable.name,) if varies else ()))
        self.row = None if varies else self.plant.parameters.index(self.variable)

    @property
    def constants(self) -> Array:
        """What the functions take behind z and lam: parameters, then the conditions' values."""
        return np.concatenate([self.plant.vector("parameter"), list(self.targets.values())])

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, dict[str, ca.SX]]:
        """(z, lam, constants, expressions): scaled "rates", and in "rest" what vanishes at rest.

        "slopes" are the Jacobian of the rates over the states, without the fading of held memories.
        """
        plant, nx = self.plant, self.nx
        z, lam = ca.SX.sym("z", len(self.nominal)), ca.SX.sym("lam")
        constants = ca.SX.sym("constants", len(self.constants))
        p, targets = constants[: len(plant.parameters)], constants[len(plant.parameters) :]
        value = lam * self.variable.nominal
        if self.row is not None:
            p = ca.vertcat(p[: self.row], value, p[self.row + 1 :])
        else:
            targets = ca.vertcat(targets, value)
        scaled = z * self.nominal
        missed = ca.vertcat(
            ca.SX(0, 1),
            *(
                (plant.expression(n) - t) / plant.variable(n).nominal
                for n, t in zip(self.names, ca.vertsplit(targets), strict=True)
            ),
        )
        rates = plant.function(scaled[:nx], scaled[nx:], p)[0] / self.nominal[:nx]
        conditions = ca.substitute(
            missed, ca.vertcat(plant.x, plant.u, plant.p), ca.vertcat(scaled, p)
        )
        index = [i for i, v in enumerate(plant.states) if v.name in self.pinned]
        vanish, slopes = ca.SX(rates), ca.jacobian(rates, z)[:, :nx]
        for i, pin in zip(index, self.pinned.values(), strict=True):
            vanish[i] = z[i] - pin / self.nominal[i]
            for j in index:
                slopes[i, j] = 0.0
        found = {"rates": rates, "rest": ca.vertcat(vanish, conditions), "slopes": slopes}
        return z, lam, constants, found

    @cached_property
    def function(self) -> ca.Function:
        """(z, lam, constants) -> (residual, Jacobian in z)."""
        z, lam, constants, found = self.symbols()
        residual = found["rest"]
        return ca.Function("rest", [z, lam, constants], [residual, ca.jacobian(residual, z)])

    @cached_property
    def stability(self) -> ca.Function:
        """(z, lam, constants) -> the scaled Jacobian of the rates; eigenvalues are the plant's."""
        z, lam, constants, found = self.symbols()
        return ca.Function("stability", [z, lam, constants], [ca.densify(found["slopes"])])

    def given(self, value: float) -> dict[str, float]:
        """All conditions with the varying value put in, as :func:`equilibrium` takes them."""
        return {**self.targets, **self.pinned, self.variable.name: value}

    def first(self, value: float) -> Array:
        """Scaled point of rest at a value, from nothing. Raises EquilibriumError."""
        point = equilibrium(self.plant, self.given(value))
        return np.asarray(np.concatenate([point.x, point.u]) / self.nominal)

    def next(self, z: Array, value: float) -> Array:
        """Point of rest at a value, continued from a near one; from nothing where that fails."""
        try:
            lam = value / self.variable.nominal
            found, _ = newton(casadi_equations(self.function, lam, self.constants), z)
        except VibrationError:
            return self.first(value)
        low, high = (
            np.concatenate([self.plant.vector(c, attribute=a) for c in ("state", "input")])
            / self.nominal
            for a in ("min", "max")
        )
        inside = np.all(found >= low - 1e-9) and np.all(found <= high + 1e-9)
        return found if inside else self.first(value)

    def at(self, z: Array, value: float) -> OperatingPoint:
        """The OperatingPoint of a scaled solution; its plant holds all values as start values."""
        values = z * self.nominal
        names = [v.name for v in (*self.plant.states, *self.plant.inputs)]
        fixed: dict[str, float] = {
            n: float(np.clip(x, self.plant.variable(n).min, self.plant.variable(n).max))
            for n, x in zip(names, values, strict=True)
        }
        if self.row is not None:
            fixed[self.variable.name] = value
        residual = self.function(z, value / self.variable.nominal, self.constants)[0]
        return OperatingPoint(
            self.plant.with_values(fixed),
            values[: self.nx],
            values[self.nx :],
            float(np.max(np.abs(np.asarray(residual)))),
        )

    def eigenvalues(self, z: Array, value: float) -> NDArray[np.complex128]:
        """Eigenvalues of the plant at rest [1/s], unsorted; held memories stick and have none."""
        if self.pinned:
            return self.at(z, value).poles
        a = self.stability(z, value / self.variable.nominal, self.constants)
        return np.asarray(np.linalg.eigvals(np.asarray(a)), dtype=complex)


@dataclass(frozen=True)
class StabilityPath:
    """Points of rest along the values of a parameter or an input, and their eigenvalues."""

    plant: Plant
    parameter: str
    values: Array
    """(n,) [unit of the parameter]."""
    points: tuple[OperatingPoint, ...]
    eigenvalues: NDArray[np.complex128]
    """(n, states but held memories) [1/s]; a column follows one eigenvalue along the path."""
    scaled: Array
    """(n, states + inputs) in units of nominal."""

    @property
    def growth(self) -> Array:
        """Largest real part at each point [1/s]; the rest is stable where it is negative."""
        return np.asarray(self.eigenvalues.real.max(axis=1))

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Whether each point of rest is stable."""
        return np.asarray(self.growth < 0)

    def column(self, name: str) -> Array:
        """A state, input or output along the path [its unit]."""
        return np.array([point[name] for point in self.points])

    def plot(self) -> Figure:
        """Eigenvalues in the complex plane, and growth rates over the parameter."""
        return courtesy.plot_stability(self)


def stability_path(
    plant: Plant,
    parameter: str,
    values: ArrayLike,
    conditions: Mapping[str, float] | None = None,
    /,
    *,
    memory: Memory = "virgin",
    **more: float,
) -> StabilityPath:
    """Eigenvalues of the plant along a path of equilibria.

    Parameters
    ----------
    parameter : name of the parameter (or the input) that varies. values : (n,) [its unit].
    conditions, memory : as for :func:`pam_ocp.operating.equilibrium`: one condition for each input
    (a varied
        input is one).

    Each point is continued from the last by Newton with exact Jacobians.
    Raises UnknownNameError, InputError for values out of range, EquilibriumError where no point of
    rest exists (with the value at which the path ended).
    """
    rest = Rest(plant, parameter, {**(conditions or {}), **more}, memory)
    numbers = np.atleast_1d(np.asarray(values, dtype=float))
    if numbers.ndim != 1 or not numbers.size:
        raise InputError("values must be a row of at least one number")
    for value in numbers:
        rest.variable.check(value)
    path: list[Array] = []
    eigenvalues: list[NDArray[np.complex128]] = []
    for value in map(float, numbers):
        try:
            path.append(rest.next(path[-1], value) if path else rest.first(value))
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

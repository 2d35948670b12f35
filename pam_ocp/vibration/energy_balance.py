"""The energy of a load on muscles at constant pressure: why it cannot vibrate by itself.

Theorem. Let m x'' = R(x) - D(x, x'), where R = F(p, kappa) - m g - ... is the resultant force at
rest with all pressures constant, and D the resistance, D(x, v) v >= 0. Then

    E = m x'^2/2 - integral of R dx        (for the hanging load m x'^2/2 + m g x - integral F dx)

falls along every motion, dE/dt = -D x' (= -c x'^2 for viscous damping). A limit cycle would return
to the same E after a period, so none exists with c > 0, and with c = 0 every motion keeps the
energy that it was given. Conditions: pressures constant (no gas being compressed, no feedback), one
position, c >= 0, dry friction not falling below zero. It holds for any force law, with or without
the clamp F >= 0, because F then depends on x alone. Sustained vibration needs an active element:
see :class:`pam_ocp.plants.regulated.RegulatedLoad`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from .. import courtesy
from ..core.errors import InputError
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..numerics.newton import Array
from ..plants.plant import Plant
from .free import watched

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(16)


@dataclass(frozen=True, eq=False)
class Energy:
    """Energy along a motion [J] and its exact rate [W], all (n,); t [s].

    Examples
    --------
    >>> held = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.IdealPressure())
    >>> swing = pam.vibration.free_vibration(held, {"muscle.pressure": 3e5}, 5e-3, cycles=3)
    >>> energy = pam.vibration.energy(held, swing.trajectory)
    >>> bool(np.diff(energy.total).max() < 1e-9)  # it only falls
    True
    """

    t: Array
    kinetic: Array
    potential: Array
    """- integral of the resultant force at rest, 0 at the first sample."""
    rate: Array
    """dE/dt by the plant's equations: the power of what resists the motion, <= 0."""

    @property
    def total(self) -> Array:
        """Kinetic plus potential energy [J]."""
        return self.kinetic + self.potential

    def plot(self) -> Figure:
        """Energies over time, and the power lost."""
        return courtesy.plot_energy(self)


@verb
def energy(
    plant: Plant,
    trajectory: Trajectory,
    *,
    position: str | None = None,
    mass: str | float | None = None,
) -> Energy:
    """E = m v^2/2 - integral R dx along a motion at constant pressures; see the module's theorem.

    Parameters
    ----------
    plant : with one position whose velocity is a state, as ``HangingLoad(...,
    feed=IdealPressure())``.
    trajectory : a motion of it, as :func:`pam_ocp.simulation.simulator` returns.
    position : its name; by default x, or the plant's one position.
    mass : name of the parameter, or the inertia itself [kg, kg m2];
        by default all that moves (the load, what is added to it, half of each muscle's body).

    R is mass times the plant's acceleration at zero velocity. Its integral is exact to rounding:
    Gauss-Legendre with 16 points on pieces between the ends of the clamp's rounding.

    Raises InputError when another state or an input moves: then this is no energy of the plant.

    Examples
    --------
    >>> held = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.IdealPressure())
    >>> swing = pam.vibration.free_vibration(held, {"muscle.pressure": 3e5}, 5e-3, cycles=3)
    >>> found = pam.vibration.energy(held, swing.trajectory)
    >>> bool((found.rate <= 0).all())
    True
    """
    name = watched(plant, position, "position").name
    velocity = plant.positions.get(name)
    if velocity is None:
        raise InputError(f"position: {name} has no velocity among the states of {plant.name!r}")
    _require_constant(plant, trajectory, {name, velocity})
    if mass is None:
        m = _moved(plant, trajectory, velocity)
    else:
        m = mass if isinstance(mass, (int, float)) else plant.vector("parameter")[_row(plant, mass)]
    acceleration, tension = _expressions(plant, name, velocity)
    first = trajectory.row(0)
    x0 = np.array([first[v.name] for v in plant.states])
    constants = (x0, trajectory.array([v.name for v in plant.inputs])[0], plant.vector("parameter"))
    x, v = trajectory[name], trajectory[velocity]
    still = np.zeros_like(v)

    def resultant(at: Array) -> Array:
        flat = np.asarray(acceleration(at.reshape(1, -1), 0.0, *constants))
        return float(m) * flat.reshape(at.shape)

    pieces = _pieces(lambda at: np.asarray(tension(at.reshape(1, -1), 0.0, *constants)), x)
    moving, resting = (
        np.asarray(acceleration(x[None, :], w[None, :], *constants)).ravel() for w in (v, still)
    )
    potential = -_integral(resultant, pieces, x)
    return Energy(
        trajectory.t,
        float(m) * v**2 / 2,
        potential - potential[0],
        float(m) * v * (moving - resting),
    )


def _moved(plant: Plant, trajectory: Trajectory, velocity: str) -> float:
    """What moves [kg, kg m2]: the pull per velocity that more pressure gives (by virtual work, from
    the muscles' power), over the acceleration that it gives; of a muscle that is taut.
    """
    muscles = [v.name.removesuffix(".power") for v in plant.outputs if v.name.endswith(".power")]
    pressures = [plant.expression(f"{m}.pressure") for m in muscles]
    pulls = [
        ca.jacobian(plant.expression(f"{m}.power"), plant.expression(velocity)) for m in muscles
    ]
    gains = [
        ca.vertcat(*(ca.jacobian(e, p) for e, p in zip(of, pressures, strict=True)))
        for of in (pulls, [plant.expression(f"der({velocity})")] * len(muscles))
    ]
    still = trajectory.array([v.name for v in plant.states])
    still[:, [v.name for v in plant.states].index(velocity)] = 0.0
    inputs = trajectory.array([v.name for v in plant.inputs])
    by = ca.Function("moved", [plant.x, plant.u, plant.p], gains)
    pull, gained = (np.asarray(g) for g in by(still.T, inputs.T, plant.vector("parameter")))
    taut = np.abs(gained) > 1e-6 * np.abs(gained).max(initial=0.0)
    found = pull[taut] / gained[taut]
    if not found.size or np.ptp(found) > 1e-6 * found.max():
        raise InputError(
            f"mass: what moves in {plant.name!r} "
            + ("changes on the way" if found.size else "cannot be told, as no muscle is taut")
            + "; name its parameter, or give a number"
        )
    return float(found[0])


def _row(plant: Plant, mass: str) -> int:
    variable = plant.variable(mass)
    if variable.causality != "parameter":
        raise InputError(f"mass: {variable.name} is {variable.kind}; name a parameter")
    return plant.parameters.index(variable)


def _require_constant(plant: Plant, trajectory: Trajectory, moving: set[str]) -> None:
    for variable in (*plant.states, *plant.inputs):
        column = trajectory[variable.name]
        if variable.name not in moving and np.ptp(column) > 1e-9 * variable.nominal:
            remedy = (
                "leave out losses with memory"
                if variable.memory
                else "use IdealPressure() and constant inputs"
            )
            raise InputError(
                f"{variable.name} moves between {variable.shown(column.min())} and "
                f"{variable.shown(column.max())}: the energy function holds only while it is "
                f"constant; {remedy}"
            )


def _expressions(plant: Plant, position: str, velocity: str) -> tuple[ca.Function, ca.Function]:
    """(position, velocity, x, u, p) -> acceleration, and [tensions -+ width] of all muscles."""
    names = [v.name for v in plant.states]
    x, v = ca.SX.sym("x"), ca.SX.sym("v")
    others = ca.SX.sym("states", len(names))
    z = [x if n == position else v if n == velocity else others[i] for i, n in enumerate(names)]
    kinks = []
    for constraint in plant.constraints:
        owner, _, kind = constraint.name.rpartition(".")
        if kind == "tension":
            tension = plant.expression(constraint.name)
            width = plant.expression(f"{owner}.slack_width")
            kinks += [tension - width, tension + width]
    arguments = [x, v, others, plant.u, plant.p]
    found = ca.substitute(
        [plant.expression(f"der({velocity})"), ca.vertcat(*kinks) if kinks else ca.SX(1)],
        [plant.x],
        [ca.vertcat(*z)],
    )
    return ca.Function("a", arguments, [found[0]]), ca.Function("kinks", arguments, [found[1]])


def _pieces(kinks: Callable[[Array], Array], x: Array) -> Array:
    """Ends of intervals that cover x and hold no kink of the clamp inside."""
    grid = np.linspace(x.min(), x.max(), 401)
    values = kinks(grid)
    ends = [x.min(), x.max()]
    for row in range(values.shape[0]):
        for i in np.flatnonzero(np.sign(values[row, :-1]) * np.sign(values[row, 1:]) < 0):
            low, high = grid[i], grid[i + 1]
            for _ in range(60):
                middle = (low + high) / 2
                same = np.sign(kinks(np.array([middle]))[row, 0]) == np.sign(values[row, i])
                low, high = (middle, high) if same else (low, middle)
            ends.append(middle)
    coarse = np.linspace(x.min(), x.max(), 9)
    return np.unique(np.concatenate([ends, coarse]))


def _integral(function: Callable[[Array], Array], pieces: Array, x: Array) -> Array:
    """Integral of a vectorised function from pieces[0] to each x."""
    total = np.zeros_like(x)
    for low, high in pairwise(pieces):
        half = (np.clip(x, low, high) - low) / 2
        at = low + half[:, None] * (1 + _NODES)
        total += half * (function(at) @ _WEIGHTS)
    return total

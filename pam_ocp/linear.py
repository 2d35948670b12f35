"""Equilibria and linearisation: from a plant to python-control, by exact Jacobians."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .errors import InputError, PamError
from .plant.plant import Plant, Values

if TYPE_CHECKING:
    import control

__all__ = ["EquilibriumError", "OperatingPoint", "equilibrium", "linearize", "modes"]

Array: TypeAlias = NDArray[np.float64]


class EquilibriumError(PamError):
    """No equilibrium meets the conditions within the plant's bounds."""


@dataclass(frozen=True)
class OperatingPoint:
    """States, inputs and outputs of a plant at one point; ``point["x"]`` gives a value [SI]."""

    plant: Plant
    x: Array
    u: Array
    residual: float = field(default=0.0)
    """Largest |xdot| in units of nominal per second (0 at an equilibrium)."""

    @cached_property
    def values(self) -> dict[str, float]:
        """All states, inputs and outputs by name."""
        y = np.asarray(self.plant.function(self.x, self.u, self.plant.vector("parameter"))[1])
        variables = (*self.plant.states, *self.plant.inputs, *self.plant.outputs)
        numbers = np.concatenate([self.x, self.u, y.ravel()])
        return {v.name: float(n) for v, n in zip(variables, numbers, strict=True)}

    def __getitem__(self, name: str) -> float:
        return self.values[self.plant.variable(name).name]

    def __str__(self) -> str:
        return "\n".join(
            f"{n:<24} {self.plant.variable(n).shown(v)}" for n, v in self.values.items()
        )


def equilibrium(plant: Plant, conditions: Values | None = None, /, **more: Any) -> OperatingPoint:
    """The point of rest that meets conditions on states, inputs, outputs (or parameters).

    ``equilibrium(plant, x=0.0, stiffness=2e4)``; values of parameters replace the plant's. As many
    conditions are needed as the plant has inputs (each condition fixes one freedom of rest);
    disturbances (external forces) that are not named are held at their start value.

    Solved within the variables' bounds by IPOPT from several starts, then by Newton to rounding.
    Raises InputError when the conditions are too few or too many, EquilibriumError when no point
    within the bounds meets them (it names the one that fails, and by how much).
    """
    given = {plant.variable(n).name: v for n, v in {**(conditions or {}), **more}.items()}
    constants = {n: v for n, v in given.items() if plant.variable(n).causality == "parameter"}
    plant = plant.with_values(constants)
    targets = {n: float(v) for n, v in given.items() if n not in constants}
    for name, value in targets.items():
        if not np.isfinite(value):
            raise InputError(f"equilibrium: {name} = {value} must be finite")
        plant.variable(name).check(value, "the condition")
    disturbances = {
        v.name: v.start or 0.0 for v in plant.inputs if v.disturbance and v.name not in targets
    }
    if len(targets) + len(disturbances) == len(plant.inputs):
        targets.update(disturbances)
    if len(targets) != len(plant.inputs):
        controls = [v.name for v in plant.inputs if v.name not in disturbances]
        raise InputError(
            f"equilibrium of {plant.name!r} needs {len(controls)} condition(s), one for each of its "
            f"inputs ({', '.join(controls)}); {len(targets)} given: {', '.join(targets) or 'none'}"
        )
    return _solved(plant, targets)


def _solved(plant: Plant, targets: Mapping[str, float]) -> OperatingPoint:
    z = ca.vertcat(plant.x, plant.u)
    names = [f"der({v.name})" for v in plant.states] + list(targets)
    scale = np.array(
        [v.nominal for v in plant.states] + [plant.variable(n).nominal for n in targets]
    )
    values = np.array([0.0] * len(plant.states) + list(targets.values()))
    residual = (ca.vertcat(*(plant.expression(n) for n in names)) - values) / scale
    p = plant.vector("parameter")
    nominal, low, high, start = (
        np.concatenate([plant.vector(c, attribute=a) for c in ("state", "input")])
        for a in ("nominal", "min", "max", "start")
    )
    function = ca.Function("rest", [z, plant.p], [residual, ca.jacobian(residual, z)])
    solver = _nearest(function, len(z.nz), len(names))
    best: tuple[float, Array] | None = None
    for guess in _starts(low, high, start, nominal):
        result = solver(
            x0=np.concatenate([guess / nominal, np.zeros(len(names))]), p=np.concatenate([p, nominal]),
            lbx=np.concatenate([low / nominal, np.full(len(names), -np.inf)]),
            ubx=np.concatenate([high / nominal, np.full(len(names), np.inf)]), lbg=0, ubg=0,
        )  # fmt: skip
        point = _newton(function, np.asarray(result["x"]).ravel()[: len(nominal)] * nominal, p)
        error = np.abs(np.asarray(function(point, p)[0]).ravel())
        inside = np.all(point >= low - 1e-9 * nominal) and np.all(point <= high + 1e-9 * nominal)
        if error.max() < 1e-9 and inside:
            point = np.clip(point, low, high)
            return OperatingPoint(
                plant, point[: len(plant.states)], point[len(plant.states) :], float(error.max())
            )
        clipped = np.asarray(result["x"]).ravel()[: len(nominal)] * nominal
        misses = np.abs(np.asarray(function(clipped, p)[0]).ravel())
        if best is None or misses.max() < best[0]:
            best = (float(misses.max()), clipped)
    assert best is not None
    raise EquilibriumError(_why(plant, targets, best[1], function, names))


def _why(
    plant: Plant,
    targets: Mapping[str, float],
    point: Array,
    function: ca.Function,
    names: list[str],
) -> str:
    misses = np.asarray(function(point, plant.vector("parameter"))[0]).ravel()
    worst = names[int(np.argmax(np.abs(misses)))]
    wanted = ", ".join(f"{n} = {plant.variable(n).shown(v)}" for n, v in targets.items())
    n = len(plant.states)
    near = OperatingPoint(plant, point[:n], point[n:])
    at = ", ".join(
        f"{k} = {plant.variable(k).shown(near[k])}"
        for k in [v.name for v in (*plant.states, *plant.inputs)]
    )
    return (
        f"no equilibrium of {plant.name!r} with {wanted} within the plant's bounds; nearest: {at}, "
        f"where {worst} is not met. Change the conditions, the load or the muscle"
    )


def _nearest(function: ca.Function, unknowns: int, equations: int) -> ca.Function:
    """IPOPT for min |r|^2 s.t. r = residual(z): converges also where no equilibrium exists."""
    w, r = ca.MX.sym("w", unknowns), ca.MX.sym("r", equations)
    p = ca.MX.sym("p", function.size1_in(1) + unknowns)
    constants, nominal = p[: function.size1_in(1)], p[function.size1_in(1) :]
    nlp: dict[str, ca.MX] = {
        "x": ca.vertcat(w, r), "p": p, "f": ca.sumsqr(r),
        "g": function(w * nominal, constants)[0] - r,
    }  # fmt: skip
    ipopt: dict[str, Any] = {
        "print_level": 0,
        "sb": "yes",
        "tol": 1e-10,
        "max_iter": 200,
        "mu_init": 1e-3,
    }
    return ca.nlpsol("equilibrium", "ipopt", nlp, {"print_time": False, "ipopt": ipopt})


def _starts(low: Array, high: Array, start: Array, nominal: Array) -> list[Array]:
    """Start values first, then points spread over the bounds (fixed seed: the same every time)."""
    finite_low = np.where(np.isfinite(low), low, start - nominal)
    finite_high = np.where(np.isfinite(high), high, start + nominal)
    spread = np.random.default_rng(0).uniform(0.1, 0.9, size=(5, len(low)))
    return [start, *(finite_low + s * (finite_high - finite_low) for s in spread)]


def _newton(function: ca.Function, point: Array, p: Array, steps: int = 4) -> Array:
    """A few Newton steps to rounding; least squares where the Jacobian is singular."""
    for _ in range(steps):
        residual, jacobian = (np.asarray(m) for m in function(point, p))
        if not np.all(np.isfinite(jacobian)):
            break
        point = point - np.linalg.lstsq(jacobian, residual.ravel(), rcond=None)[0]
    return point


def _point(plant: Plant, at: OperatingPoint | Values | None) -> tuple[Plant, Array, Array]:
    if isinstance(at, OperatingPoint):
        if {v.name for v in at.plant.states} != {v.name for v in plant.states}:
            raise InputError(
                f"the operating point belongs to {at.plant.name!r}, not {plant.name!r}"
            )
        return at.plant, at.x, at.u
    given = {plant.variable(n).name: v for n, v in (at or {}).items()}
    moved = plant.with_values(given)
    return moved, moved.vector("state"), moved.vector("input")


def linearize(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> control.StateSpace:
    """The plant near a point as python-control's StateSpace: x' = A x + B u, y = C x + D u.

    at : an OperatingPoint (of :func:`equilibrium`) or values by name; by default the start values.
    inputs, outputs : names to keep; by default all inputs, and all states and outputs.

    Jacobians are exact (CasADi); signals keep the plant's names with ``_`` for ``.``, since
    python-control reads a dot as system.signal. Units are SI.
    """
    import control

    plant, x, u = _point(plant, at)
    chosen_in = _chosen("inputs", plant, inputs, ("input",))
    chosen_out = _chosen("outputs", plant, outputs, ("state", "output"))
    a, b, c, d = (np.asarray(m) for m in plant.jacobians(x, u, plant.vector("parameter")))
    c = np.vstack([np.eye(len(x)), c])
    d = np.vstack([np.zeros((len(x), len(u))), d])
    all_in = [v.name for v in plant.inputs]
    all_out = [v.name for v in (*plant.states, *plant.outputs)]
    columns, rows = [all_in.index(n) for n in chosen_in], [all_out.index(n) for n in chosen_out]

    def plain(names: Sequence[str]) -> list[str]:
        return [n.replace(".", "_") for n in names]

    return control.ss(
        a, b[:, columns], c[rows], d[np.ix_(rows, columns)], name=plant.name,
        states=plain([v.name for v in plant.states]), inputs=plain(chosen_in), outputs=plain(chosen_out),
    )  # fmt: skip


def _chosen(
    argument: str, plant: Plant, names: Sequence[str] | None, allowed: tuple[str, ...]
) -> list[str]:
    known = [v for a in allowed for v in plant.variables if v.causality == a]
    if names is None:
        return [v.name for v in known]
    names = [names] if isinstance(names, str) else names
    chosen = [plant.variable(n) for n in names]
    for variable in chosen:
        if variable.causality not in allowed:
            raise InputError(
                f"{argument}: {variable.name} is a {variable.causality}; choose among "
                f"{', '.join(v.name for v in known)}"
            )
    return [v.name for v in chosen]


def modes(system: control.StateSpace) -> list[tuple[float, float]]:
    """(natural frequency [Hz], damping ratio) of each oscillating pair of poles, slowest first."""
    poles = np.asarray(system.poles())
    pairs = poles[poles.imag > 1e-9 * np.abs(poles)]
    found = [(abs(s) / (2 * np.pi), -s.real / abs(s)) for s in pairs]
    return sorted((float(f), float(z)) for f, z in found)

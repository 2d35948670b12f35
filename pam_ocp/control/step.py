"""A plant's discrete step: how the state follows from one sample to the next, the inputs held."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import (
    InputError,
    UnknownNameError,
    require_count,
    require_finite,
    require_positive,
)
from ..core.quantities import outside
from ..numerics.runge_kutta import rk4
from ..plants.plant import Plant, Values
from ..simulation.sampled import StepMethod, stepped
from .kinds import Array

LEAST, MOST = 2, 64
"""Substeps where none are given."""
GROWTH = 1.01
"""From step to step: what decays in the plant is not to grow by more in a prediction."""
PLACES, RARE = 256, 0.005
"""Places in the ranges of states and inputs at which that is looked at, and the share of them at
which it need not hold: a quick exhaust that opens is ten times quicker than the tube before it.
"""


class Givens:
    """What a controller or an estimator is told from outside, as one vector q.

    q holds the plant's parameters, its disturbance inputs, and an offset for each derivative, named
    ``der(STATE)``: x' = f(x, u, p) + offset. An offset stands for whatever the model leaves out.
    """

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.disturbances = tuple(v for v in plant.inputs if v.disturbance)
        self.controls = tuple(v for v in plant.inputs if not v.disturbance)
        named = (*plant.parameters, *self.disturbances)
        self.names = (*(v.name for v in named), *(f"der({v.name})" for v in plant.states))
        rates = plant.vector("state", attribute="nominal")
        self.nominal = np.concatenate([[v.nominal for v in named], rates])
        free = np.full(len(plant.states), np.inf)
        self.low = np.concatenate([[v.min for v in named], -free])
        self.high = np.concatenate([[v.max for v in named], free])
        self._start = np.concatenate([[v.start for v in named], np.zeros(len(plant.states))])

    def name(self, name: str) -> str:
        """The full name of a parameter, disturbance or ``der(STATE)``. Raises UnknownNameError."""
        inner = name[4:-1] if name.startswith("der(") and name.endswith(")") else ""
        if inner:
            full = f"der({self.plant.variable(inner).name})"
        else:
            full = self.plant.variable(name).name
        if full not in self.names:
            raise UnknownNameError("parameter, disturbance or der(STATE)", name, self.names)
        return full

    def vector(self, values: Values | None = None) -> Array:
        """q with the plant's start values, single ones replaced by name [SI]."""
        q: Array = self._start.copy()
        for name, value in (values or {}).items():
            full = self.name(name)
            if full.startswith("der("):
                number = require_finite(full, value)
            else:
                number = self.plant.variable(full).check(value, full)
            q[self.names.index(full)] = number
        return q

    def parts(self, q: ca.SX, u: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX]:
        """(all inputs of the plant, parameters, offsets) from q and the control inputs [SI]."""
        n, nd = len(self.plant.parameters), len(self.disturbances)
        # not q[:n], which is a row where q is a scalar
        p, disturbances, offsets = ca.vertsplit(q, [0, n, n + nd, len(self.names)])
        given = {v.name: disturbances[i] for i, v in enumerate(self.disturbances)}
        given |= {v.name: u[i] for i, v in enumerate(self.controls)}
        inputs = ca.SX(ca.vertcat(*(given[v.name] for v in self.plant.inputs)))
        return inputs, p, offsets


@dataclass(frozen=True)
class Step:
    """How one node follows from the one before, the inputs held.

    length : [s]. method : "rk4" (explicit, order 4) or "rosenbrock" (RODAS3: linearly implicit,
    order 3, L-stable, for stiff plants). substeps : equal steps of the method in one step.
    """

    length: float
    method: StepMethod = "rk4"
    substeps: int = 2

    def __post_init__(self) -> None:
        length = require_positive("sample_time", self.length, "s")
        object.__setattr__(self, "length", length)
        if self.method not in get_args(StepMethod):
            raise InputError(f"method = {self.method!r}: choose 'rk4' or 'rosenbrock'")
        require_count("substeps", self.substeps)

    @classmethod
    def of(
        cls, verb: str, plant: Plant, length: float, method: StepMethod, substeps: int | None
    ) -> Step:
        """The step of a plant. substeps : None: ``LEAST``, or as many more as rk4 needs to damp
        what the plant damps, at its start values and nearly everywhere in its ranges
        (E. Hairer, G. Wanner, Solving ODEs II, IV.2).

        Warns where what is given, or ``MOST`` of them, is not enough for that.
        """
        step = cls(length, method, LEAST if substeps is None else substeps)
        while (time := step._too_quick(plant)) and substeps is None and step.substeps < MOST:
            step = replace(step, substeps=step.substeps + 1)
        while substeps is None and step.substeps < MOST and step._grows_about(plant):
            step = replace(step, substeps=step.substeps + 1)
        if time:
            warnings.warn(
                f"{verb}: sample_time = {step.length:g} s in {step.substeps} substeps of rk4 is "
                f"too long for {plant.name!r}, whose fastest motion has the time constant "
                f"{time:.2g} s: predictions grow without bound; give a shorter sample_time, more "
                "substeps, or method='rosenbrock'",
                stacklevel=outside(),
            )
        return step

    def _too_quick(self, plant: Plant) -> float:
        """1/|pole| [s] of the motion that decays in the plant and grows most here; 0 for none."""
        if self.method != "rk4":
            return 0.0
        x, u, p = (plant.vector(c) for c in ("state", "input", "parameter"))
        poles = plant.cached(("decaying poles", *x, *u, *p), lambda: _poles(plant, x, u))
        growth = self._growth(poles)  # of a pole 0 it is 1
        if np.max(growth, initial=0.0) <= GROWTH:
            return 0.0
        return float(1 / np.abs(poles[int(np.argmax(growth))]))

    def _grows_about(self, plant: Plant) -> bool:
        """Whether decaying motions grow here at more than ``RARE`` of the places in the ranges."""
        if self.method != "rk4":
            return False
        at = plant.vector("parameter")
        poles = plant.cached(("decaying poles about", *at), lambda: _poles_about(plant))
        if not poles.size:
            return False
        return bool(np.mean(np.any(self._growth(poles) > GROWTH, axis=1)) > RARE)

    def _growth(self, poles: NDArray[np.complex128]) -> Array:
        """Of each motion from substep to substep of rk4."""
        z = poles * self.length / self.substeps
        return np.abs(1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24)

    def expression(self, given: Givens, x: ca.SX, u: ca.SX, q: ca.SX, length: Any = None) -> ca.SX:
        """The state after the step from x; x and u scaled by nominals, q in SI."""
        state, control = ca.SX.sym("x", x.numel()), ca.SX.sym("u", len(given.controls))
        known = ca.SX.sym("q", len(given.names))
        slope = _slope(given, state, control, known)
        slopes = ca.Function("slopes", [state, control, known], [slope, ca.jacobian(slope, state)])

        def slopes_at(z: ca.SX) -> tuple[ca.SX, ca.SX]:
            value, jacobian = slopes.call([z, u, q])
            return value, jacobian

        span = self.length if length is None else length
        return stepped(slopes_at, x, span, self.method, self.substeps)

    def with_slopes(
        self, given: Givens, x: ca.SX, u: ca.SX, q: ca.SX, over: ca.SX, length: Any = None
    ) -> tuple[ca.SX, ca.SX]:
        """The state after the step, see :meth:`expression`, and its Jacobian over the symbols
        ``over``.

        The slopes of rk4 are those of the method on the variational equations, stage by stage:
        expressions of 3/5 of the length that differentiating the step gives.
        """
        if self.method != "rk4":
            after = self.expression(given, x, u, q, length)
            return after, ca.jacobian(after, over)
        state = ca.SX.sym("x", x.numel())
        slope = _slope(given, state, u, q)
        known = ca.vertcat(*ca.symvar(ca.vertcat(u, q, over)))
        derivatives = [ca.jacobian(slope, e) for e in (state, over)]
        slopes = ca.Function("slopes", [state, known], [slope, *derivatives])

        def varied(z: ca.SX, _: float) -> ca.SX:
            value, onward, own = slopes.call([z[:, 0], known])
            return ca.SX(ca.horzcat(value, onward @ z[:, 1:] + own))

        span = self.length if length is None else length
        begin = ca.SX(ca.horzcat(x, ca.jacobian(x, over)))
        end = rk4(varied, begin, span / self.substeps, self.substeps)
        return end[:, 0], end[:, 1:]


def _slope(given: Givens, x: ca.SX, u: ca.SX, q: ca.SX) -> ca.SX:
    """x' with the offsets; x and u scaled by nominals."""
    plant = given.plant
    scale = plant.vector("state", attribute="nominal")
    inputs, p, offset = given.parts(q, u * np.array([v.nominal for v in given.controls]))
    return ca.SX((plant.function(x * scale, inputs, p)[0] + offset) / scale)


def _poles_about(plant: Plant) -> NDArray[np.complex128]:
    """Those at places all over the finite ranges of states and inputs; a row each. What has no
    range stays within its nominal value.
    """
    rng = np.random.default_rng(0)
    columns = []
    for kind in ("state", "input"):
        low, high, start, size = (
            plant.vector(kind, attribute=a) for a in ("min", "max", "start", "nominal")
        )
        open_ = ~(np.isfinite(low) & np.isfinite(high))
        low, high = np.where(open_, start - size, low), np.where(open_, start + size, high)
        columns.append(rng.uniform(low[:, None], high[:, None], (len(low), PLACES)))
    places = zip(*(column.T for column in columns), strict=True)
    rows = [poles for x, u in places if len(poles := _poles(plant, x, u))]
    return np.array(rows, dtype=np.complex128).reshape(-1, len(plant.states))


def _poles(plant: Plant, x: Array, u: Array) -> NDArray[np.complex128]:
    """Poles [1/s] that decay, 0 for those that do not; none where slopes are not finite."""
    scale = plant.vector("state", attribute="nominal")
    slopes = plant.jacobians(x, u, plant.vector("parameter"))[0]
    a = np.asarray(slopes, dtype=float) * scale / scale[:, None]
    if not np.all(np.isfinite(a)):
        return np.zeros(0, dtype=np.complex128)
    found = np.asarray(np.linalg.eigvals(a), dtype=np.complex128)
    return np.where(found.real < 0, found, 0.0)

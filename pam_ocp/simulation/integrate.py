"""Integration of a plant over a grid, by one of CasADi's integrators. Used by simulate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.signals import PiecewisePolynomial, merged
from ..numerics.solvers import Native, integrator
from ..plants.plant import Plant

__all__ = ["METHODS", "Integration", "Method"]

Array: TypeAlias = NDArray[np.float64]
Method: TypeAlias = Literal["rosenbrock", "cvodes", "rk4"]
METHODS = ("rosenbrock", "cvodes", "rk4")


@dataclass(frozen=True)
class Integration:
    """x' = f(x, u(t), p) from ``x0`` over ``grid``, the breaks of ``u`` among its times.

    method : "rosenbrock" (CasADi's, order 5, L-stable, adaptive, or equal steps of at most
        ``step``), "cvodes" (SUNDIALS BDF, started anew at each break), "rk4" (explicit, steps of
        ``step``).
    States are scaled by nominals, so tolerances are relative to them too.
    """

    plant: Plant
    u: PiecewisePolynomial
    grid: Array
    x0: Array
    method: Method = "rosenbrock"
    rtol: float = 1e-10
    step: float | None = None
    max_steps: int = 100_000

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"method = {self.method!r}: choose one of {', '.join(METHODS)}")
        if self.method == "rk4" and self.step is None:
            raise InputError("method = 'rk4' needs a step (seconds), such as step=1e-3")
        if self.method == "cvodes" and self.step is not None:
            raise InputError("method = 'cvodes' chooses its steps; leave out step")

    @classmethod
    def over(
        cls, plant: Plant, u: PiecewisePolynomial, times: Array, x0: Array, **options: Any
    ) -> Integration:
        """Over ``times`` and all breaks of the inputs between them."""
        inside = u.breaks[(u.breaks > times[0]) & (u.breaks < times[-1])]
        groups = merged(np.concatenate([times[[0, -1]], inside]))
        grid = merged(np.concatenate([times, inside]))
        return cls(plant, u.shifted(groups), grid, x0, **options)

    def __call__(self, intervals: int | None = None) -> Array | None:
        """States (k + 1, nx) over the first k intervals (all by default); None when it gave up."""
        k = len(self.grid) - 1 if intervals is None else intervals
        if k == 0:
            return self.x0[None, :]
        try:
            states = self._by_group(k) if self.method == "cvodes" else self._at_once(k)
        except RuntimeError:
            return None
        return states if np.all(np.isfinite(states)) else None

    def at(self, times: Array, states: Array) -> Array:
        """The rows of ``states`` (over the grid) at ``times``."""
        return states[np.searchsorted(self.grid, times - 1e-12 * (1 + np.abs(times)))]

    @property
    def longest(self) -> int:
        """The number of intervals that can be integrated, by bisection (0 when none)."""
        done, beyond = 0, len(self.grid) - 1
        while beyond - done > 1:
            middle = (done + beyond) // 2
            done, beyond = (middle, beyond) if self(middle) is not None else (done, middle)
        return done

    # ---- the integrators ---------------------------------------------------------------------
    @property
    def _nominal(self) -> Array:
        return self.plant.vector("state", attribute="nominal")

    def _groups(self, k: int) -> tuple[NDArray[np.intp], Array]:
        """Sizes (in grid intervals) and controls (one column each) of the pieces of the inputs."""
        end = self.grid[k]
        breaks = np.append(self.u.breaks[:-1][self.u.breaks[:-1] < end], end)
        size = np.diff(np.searchsorted(self.grid, breaks - 1e-12 * (1 + np.abs(breaks))))
        pieces = len(self.u.breaks) - 1
        stacked = self.u.coefficients.transpose(1, 2, 0).reshape(-1, pieces)
        control = np.vstack([self.u.breaks[:-1], stacked])
        return size, control[:, : len(size)]

    def _built(
        self, key: tuple[Any, ...], t0: float, times: Array, options: dict[str, Any]
    ) -> Native:
        name = "rk" if self.method == "rk4" else self.method
        nominal = self._nominal
        full = (name, self.u.degree, t0, times.tobytes(), nominal.tobytes(), *key)
        build: Callable[[], Native] = lambda: integrator(  # noqa: E731
            "simulate", name, self._dae(nominal), t0, times.tolist(), options
        )
        return self.plant.cached(full, build)  # type: ignore[no-any-return]

    def _at_once(self, k: int) -> Array:
        size, control = self._groups(k)
        if self.method == "rk4":
            assert self.step is not None
            span = self.grid[k] - self.grid[0]
            steps = int(np.ceil(span / self.step * (1 - 1e-9)))
            options: dict[str, Any] = {"number_of_finite_elements": max(steps, k)}
            control = np.repeat(control, size, axis=1)
        else:
            options = {
                "reltol": self.rtol,
                "abstol": self.rtol,
                "max_num_steps": self.max_steps,
                "control_group_size": size.tolist(),
                "step_size": self.step or 0.0,
            }
        key = (*(str(v) for v in options.values()),)
        motion = self._built(key, float(self.grid[0]), self.grid[1 : k + 1], options)
        result = motion(x0=self.x0 / self._nominal, p=self.plant.vector("parameter"), u=control)
        return np.vstack([self.x0, np.asarray(result["xf"]).T * self._nominal])

    def _by_group(self, k: int) -> Array:
        """CVODES keeps a history that a jump of the inputs makes wrong: one call for each piece."""
        size, control = self._groups(k)
        options = {"reltol": self.rtol, "abstol": self.rtol, "max_num_steps": self.max_steps}
        p, nominal = self.plant.vector("parameter"), self._nominal
        rows, begin = [self.x0[None, :]], 0
        for n, column in zip(size, control.T, strict=True):
            times = self.grid[begin : begin + n + 1]
            motion = self._built((self.rtol, self.max_steps), float(times[0]), times[1:], options)
            u = np.repeat(column[:, None], n, axis=1)
            result = motion(x0=rows[-1][-1] / nominal, p=p, u=u)
            rows.append(np.asarray(result["xf"]).T * nominal)
            begin += n
        return np.vstack(rows)

    def advance(self, start: float, x: Array, end: float) -> Array:
        """The state at ``end`` from ``x`` at ``start``, no break of the inputs between them."""
        return np.asarray(self.between(start, x, end, (1.0,))[0])

    def between(self, start: float, x: Array, end: float, taus: tuple[float, ...]) -> Array:
        """States (n, nx) at the rising fractions ``taus`` of the way; see :meth:`advance`.

        One integrator over a stretched unit interval serves all calls. Raises RuntimeError when it
        gives up.
        """
        nominal = self._nominal

        def build() -> Native:
            dae = self._dae(nominal)
            span, begin = ca.SX.sym("span"), ca.SX.sym("begin")
            stretched = ca.substitute(dae["ode"], dae["t"], begin + dae["t"] * span)
            p = ca.vertcat(dae["p"], dae["u"], begin, span)
            unit = {"t": dae["t"], "x": dae["x"], "p": p, "ode": span * stretched}
            options = {"reltol": self.rtol, "abstol": self.rtol, "max_num_steps": self.max_steps}
            return integrator("between", "rosenbrock", unit, 0.0, list(taus), options)

        key = ("between", taus, self.u.degree, nominal.tobytes(), self.rtol, self.max_steps)
        piece = self.u.shifted(np.array([start, end])).coefficients[0]
        p = np.concatenate(
            [self.plant.vector("parameter"), [start], piece.ravel(), [start, end - start]]
        )
        found = self.plant.cached(key, build)(x0=x / nominal, p=p)["xf"]
        return np.asarray(np.asarray(found, float).T * nominal)

    def _dae(self, nominal: Array) -> dict[str, ca.SX]:
        """The plant in scaled states, inputs as polynomials of the time since their break."""
        plant, degree = self.plant, self.u.degree
        t = ca.SX.sym("t")
        scaled = ca.SX.sym("x", len(nominal))
        control = ca.SX.sym("control", 1 + (degree + 1) * len(plant.inputs))
        coefficients = ca.reshape(control[1:], len(plant.inputs), degree + 1)
        powers = ca.vertcat(*((t - control[0]) ** j for j in range(degree + 1)))
        p = ca.SX.sym("p", len(plant.parameters))
        xdot = plant.function(scaled * nominal, coefficients @ powers, p)[0]
        return {"t": t, "x": scaled, "u": control, "p": p, "ode": xdot / nominal}

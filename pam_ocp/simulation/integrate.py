"""Integration of a plant over a grid, by CasADi's integrators; outputs along a motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, require_flag
from ..core.expressions import polynomial
from ..core.signals import Interpolation, PiecewisePolynomial, merged
from ..core.stop import native
from ..core.trajectory import Event, Trajectory
from ..numerics.rodas import LEAST, Rodas, written_out
from ..numerics.solvers import Native, integrator, stoppable
from ..plants.plant import Plant

if TYPE_CHECKING:
    from ..courtesy import MachinePlant

Array: TypeAlias = NDArray[np.float64]
Method: TypeAlias = Literal["rosenbrock", "cvodes", "rk4"]
METHODS = ("rosenbrock", "cvodes", "rk4")
COMPILED_PART = 0.2
"""Of the tolerance, allowed as the error of a step of the compiled solver, which is of order 5:
errors add up over steps.
"""
LEAST_COMPILED = 1e-12
"""Below, that solver's steps become too many."""
JUMP = 1e-8
"""A smaller change of an input at once, in units of its nominal, is a kink at most."""


@dataclass(frozen=True)
class Integration:
    """x' = f(x, u(t), p) from ``x0`` over ``grid``, the breaks of ``u`` among its times.

    method : "rosenbrock" (order 5, L-stable, adaptive: Rodas5P, a step as one expression; CasADi's
        where that is long or gives up, and for equal steps of at most ``step``), "cvodes" (SUNDIALS
        BDF, started anew at each jump), "rk4" (explicit, steps of ``step``).
    compiled : by machine code in place of CasADi's integrator: where it is there (None), built if
        need be (True), never (False). Where it gives up, CasADi's is asked.
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
    compiled: bool | None = False

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise InputError(f"method = {self.method!r}: choose one of {', '.join(METHODS)}")
        if self.method == "rk4" and self.step is None:
            raise InputError("method = 'rk4' needs a step (seconds), such as step=1e-3")
        if self.method == "cvodes" and self.step is not None:
            raise InputError("method = 'cvodes' chooses its steps; leave out step")
        require_flag("compiled", self.compiled, "where it is in the cache")
        if self.compiled and (self.method != "rosenbrock" or self.step is not None):
            raise InputError(
                "compiled = True is for method = 'rosenbrock' with steps of its own; leave out "
                "compiled, or method and step"
            )

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
            if self.method == "cvodes":
                states = self._by_legs(k)
            else:
                found = self._by_machine(k)
                found = self._by_steps(k) if found is None else found
                states = self._at_once(k) if found is None else found
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

    @property
    def machine(self) -> MachinePlant | None:
        """The plant as machine code, where this integration uses it."""
        own = self.method == "rosenbrock" and self.step is None and self.compiled is not False
        if not own or self.rtol < LEAST_COMPILED:
            return None
        return courtesy.machine_plant(self.plant, build=bool(self.compiled))

    @staticmethod
    def built(plant: Plant) -> MachinePlant | None:
        """The plant's machine code, compiled if need be. Raises InputError where it cannot be."""
        return courtesy.machine_plant(plant, build=True)

    # ---- the integrators ---------------------------------------------------------------------
    @property
    def _nominal(self) -> Array:
        return self.plant.vector("state", attribute="nominal")

    def _groups(self, k: int) -> tuple[NDArray[np.intp], Array]:
        """Sizes (in grid intervals) and controls (one column each) of the pieces of the inputs."""
        end = self.grid[k]
        breaks = np.append(self.u.breaks[:-1][self.u.breaks[:-1] < end], end)
        size = np.diff(np.searchsorted(self.grid, breaks - 1e-12 * (1 + np.abs(breaks))))
        return size, self._controls[:, : len(size)]

    @property
    def _controls(self) -> Array:
        """A column for each piece of the inputs: where it begins, and its coefficients."""
        pieces = len(self.u.breaks) - 1
        stacked = self.u.coefficients.transpose(1, 2, 0).reshape(-1, pieces)
        return np.vstack([self.u.breaks[:-1], stacked])

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

    def _by_machine(self, k: int) -> Array | None:
        machine = self.machine
        if machine is None:
            return None
        states = machine.motion(
            self.u,
            self.grid[: k + 1],
            self.x0,
            self.plant.vector("parameter"),
            self._nominal,
            COMPILED_PART * self.rtol,
            self.max_steps,
        )
        return states if states is not None and np.all(np.isfinite(states)) else None

    def _by_steps(self, k: int) -> Array | None:
        """By steps that are written out; None for long ones, and where they lead no further."""
        if self.method != "rosenbrock" or self.step is not None or self.rtol < LEAST:
            return None
        nominal = self._nominal

        def build() -> Rodas | None:
            dae = self._dae(nominal)
            return written_out(ca.Function("ode", [dae[n] for n in "txup"], [dae["ode"]]))

        rodas = self.plant.cached(("rodas", self.u.degree, nominal.tobytes()), build)
        if rodas is None:
            return None
        size, control = self._groups(k)
        grid, p = self.grid[: k + 1], self.plant.vector("parameter")
        breaks = grid[np.concatenate([[0], np.cumsum(size)])]
        given = (grid, breaks, control.T, self.x0 / nominal, p, self.rtol, self.max_steps)
        found = native(rodas, *given)
        if found is None:
            return None
        return np.vstack([self.x0, found[1:] * nominal])

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

    def _by_legs(self, k: int) -> Array:
        """CVODES keeps a history, which a jump of the inputs makes wrong and a kink does not: one
        call from jump to jump.
        """
        size, control = self._groups(k)
        columns, first = np.repeat(control, size, axis=1), np.cumsum(size) - size
        rows = [self.x0[None, :]]
        for leg in np.split(np.arange(len(size)), self._jumps(len(size))):
            begin, end = first[leg[0]], first[leg[-1]] + size[leg[-1]]
            try:
                rows.append(self._leg(begin, end, rows[-1][-1], columns[:, begin:end]))
            except RuntimeError:  # a kink that was too much for it
                if len(leg) == 1:
                    raise
                for begin, n in zip(first[leg], size[leg], strict=True):
                    part = columns[:, begin : begin + n]
                    rows.append(self._leg(begin, begin + n, rows[-1][-1], part))
        return np.vstack(rows)

    def _jumps(self, count: int) -> NDArray[np.intp]:
        """The first so many pieces of the inputs: those before which an input jumps."""
        pieces, breaks = self.u.coefficients[:count], self.u.breaks[:count]
        powers = np.diff(breaks)[:, None] ** np.arange(self.u.degree + 1)
        ends = np.einsum("kj,kji->ki", powers, pieces[:-1])
        least = JUMP * self.plant.vector("input", attribute="nominal")
        return np.flatnonzero((np.abs(pieces[1:, 0] - ends) > least).any(axis=1)) + 1

    def _leg(self, begin: int, end: int, x: Array, control: Array) -> Array:
        """States behind ``x`` at the times of the grid from ``begin`` on, to ``end``."""
        start, times = self.grid[begin], self.grid[begin + 1 : end + 1]
        span = times[-1] - start
        # rounded, so that equal grids share an integrator
        taus = (*np.round((times[:-1] - start) / span, 13).tolist(), 1.0)
        return self._over_unit(taus, float(start), float(span), x, control)

    def advance(self, start: float, x: Array, end: float) -> Array:
        """The state at ``end`` from ``x`` at ``start``, no break of the inputs between them."""
        return np.asarray(self.between(start, x, end, (1.0,))[0])

    def between(self, start: float, x: Array, end: float, taus: tuple[float, ...]) -> Array:
        """States (n, nx) at the rising fractions ``taus`` of the way; see :meth:`advance`.

        Raises RuntimeError when the integrator gives up.
        """
        piece = self.u.shifted(np.array([start, end])).coefficients[0]
        control = np.append(start, piece.ravel())[:, None]
        run = self if self.method == "rosenbrock" else replace(self, method="rosenbrock", step=None)
        return run._over_unit(taus, start, end - start, x, np.repeat(control, len(taus), axis=1))

    def apart(self, pieces: NDArray[np.intp], starts: Array, taus: tuple[float, ...]) -> Array:
        """States (m, n, nx) at the rising fractions ``taus`` of m pieces of the inputs, each from a
        start (m, nx) of its own.

        Raises RuntimeError when the integrator gives up on one of them.
        """
        control = np.repeat(self._controls[:, pieces], len(taus), axis=1)
        begins, lengths = self.u.breaks[pieces], np.diff(self.u.breaks)[pieces]
        found = self._over_units(taus, begins, lengths, starts, control)
        return found.reshape(len(pieces), len(taus), -1)

    def _over_unit(
        self, taus: tuple[float, ...], start: float, span: float, x: Array, control: Array
    ) -> Array:
        """States at fractions of a time span."""
        return self._over_units(taus, np.array([start]), np.array([span]), x[None], control)

    def _over_units(
        self, taus: tuple[float, ...], begins: Array, spans: Array, starts: Array, control: Array
    ) -> Array:
        """States at fractions of several time spans, one below the other; one integrator over a
        stretched unit interval serves all spans.
        """
        nominal = self._nominal

        def build() -> Native:
            dae = self._dae(nominal)
            length, begin = ca.SX.sym("span"), ca.SX.sym("begin")
            ode = length * ca.substitute(dae["ode"], dae["t"], begin + dae["t"] * length)
            unit = {**dae, "p": ca.vertcat(dae["p"], begin, length), "ode": ode}
            options = {"reltol": self.rtol, "abstol": self.rtol, "max_num_steps": self.max_steps}
            return integrator("leg", self.method, unit, 0.0, list(taus), options)

        fixed = (taus, self.u.degree, nominal.tobytes(), self.rtol, self.max_steps)
        motion = self.plant.cached(("leg", self.method, *fixed), build)
        if len(spans) > 1:
            motion = stoppable(motion.function.map(len(spans)))
        own = np.tile(self.plant.vector("parameter"), (len(spans), 1))
        p = np.column_stack([own, begins, spans]).T
        found = np.asarray(motion(x0=(starts / nominal).T, p=p, u=control)["xf"], float)
        return np.asarray(found.T * nominal)

    def _dae(self, nominal: Array) -> dict[str, ca.SX]:
        """The plant in scaled states, inputs as polynomials of the time since their break."""
        plant, degree = self.plant, self.u.degree
        t = ca.SX.sym("t")
        scaled = ca.SX.sym("x", len(nominal))
        control = ca.SX.sym("control", 1 + (degree + 1) * len(plant.inputs))
        coefficients = ca.reshape(control[1:], len(plant.inputs), degree + 1)
        u = polynomial(ca.horzsplit(coefficients), t - control[0])
        p = ca.SX.sym("p", len(plant.parameters))
        xdot = plant.function(scaled * nominal, u, p)[0]
        return {"t": t, "x": scaled, "u": control, "p": p, "ode": xdot / nominal}


# ---- outputs along a motion ----------------------------------------------------------------------
class Computes(Protocol):
    """A plant's outputs at many points, by other means than CasADi's."""

    def outputs(self, x: Array, u: Array, p: Array) -> Array:
        """(n, ny) at states (n, nx), inputs (n, nu) and parameters (np,)."""
        ...


COLUMNS = 10_000
"""Samples whose outputs are computed at once."""


def evaluated(
    plant: Plant,
    t: Array,
    states: Array,
    inputs: PiecewisePolynomial,
    events: tuple[Event, ...] = (),
    machine: Computes | None = None,
) -> Trajectory:
    """The Trajectory of given states (n, nx) at times t under given inputs, outputs computed.

    machine : what computes them; None: CasADi.
    """
    u = inputs(t)
    p = plant.vector("parameter")
    if machine is not None:
        outputs = machine.outputs(states, u, p)
    else:
        parts_of = [  # CasADi's working memory grows with the columns of a call
            np.asarray(plant.function(states[i : i + COLUMNS].T, u[i : i + COLUMNS].T, p)[1]).T
            for i in range(0, len(t), COLUMNS)
        ]
        outputs = np.concatenate(parts_of)
    parts = {"state": states, "input": u, "output": outputs}
    variables = (*plant.states, *plant.inputs, *plant.outputs)
    data = np.concatenate([parts[c].reshape(len(t), -1) for c in parts], axis=1)
    columns = {v.name: data[:, i] for i, v in enumerate(variables)}
    between: Interpolation = "previous" if inputs.degree == 0 else "linear"
    return Trajectory(t, columns, variables, between, events, inputs)

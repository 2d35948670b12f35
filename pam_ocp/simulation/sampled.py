"""A plant over one sample, its inputs held: its motion and slopes, and steps for programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.stop import locked
from ..numerics.rosenbrock import Slopes, rodas3
from ..numerics.runge_kutta import rk4
from ..numerics.solvers import Native, integrator, stoppable
from ..plants.plant import Plant

Array: TypeAlias = NDArray[np.float64]
StepMethod: TypeAlias = Literal["rk4", "rosenbrock"]


@locked
@dataclass(frozen=True)
class SampledPlant:
    """x(t + sample_time) = F(x(t), u, p): the plant's motion under inputs held over a sample.

    By CasADi's Rosenbrock integrator (adaptive, L-stable) at the relative tolerance ``rtol``, in
    states scaled by nominals. parts : equal parts of the sample at whose ends the states are given.
    Integrators are kept with the plant and serve its copies of other values.
    """

    plant: Plant
    sample_time: float
    rtol: float = 1e-9
    parts: int = 1

    @property
    def _nominal(self) -> Array:
        return self.plant.vector("state", attribute="nominal")

    def _integrator(self, name: str, dae: dict[str, ca.SX], parts: int) -> Native:
        times = [self.sample_time * (i + 1) / parts for i in range(parts)]
        options = {"reltol": self.rtol, "abstol": self.rtol}
        return integrator(name, "rosenbrock", dae, 0.0, times, options)

    def _key(self, name: str, *more: Any) -> tuple[Any, ...]:
        return (name, self.sample_time, self.rtol, self._nominal.tobytes(), *more)

    @property
    def function(self) -> Native:
        """(x, u, p) -> states (nx, parts) at the ends of the parts [SI]."""
        plant, nominal = self.plant, self._nominal

        def build() -> Native:
            x, u, p = (
                ca.SX.sym(name, len(v))
                for name, v in zip(
                    "xup", (plant.states, plant.inputs, plant.parameters), strict=True
                )
            )
            ode = plant.function(x * nominal, u, p)[0] / nominal
            dae = {"x": x, "p": ca.vertcat(u, p), "ode": ode}
            sample = self._integrator("sample", dae, self.parts)
            given = [ca.MX.sym(n, s.numel()) for n, s in zip("xup", (x, u, p), strict=True)]
            end = sample.function(x0=given[0] / nominal, p=ca.vertcat(*given[1:]))["xf"]
            states = end * ca.repmat(ca.DM(nominal), 1, self.parts)
            return stoppable(ca.Function("sampled", given, [states]))

        return plant.cached(self._key("sampled", self.parts), build)  # type: ignore[no-any-return]

    def __call__(self, x: Array, u: Array, p: Array | None = None) -> Array:
        """States (parts, nx) from x under u [SI]; p : parameters, by default the plant's.

        Raises RuntimeError when the integrator gives up.
        """
        known = self.plant.vector("parameter") if p is None else p
        states: Array = np.asarray(self.function(x, u, known), dtype=float).T
        return states

    def slopes(
        self, x: Array, u: Array, p: Array | None = None, inputs: Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        """A (nx, nx) and B (nx, inputs) at the end of the sample [SI], by variational equations.

        inputs : places of those that B is over, by default all. (CasADi's derivatives of the
        integrator follow steps chosen for the motion alone; at rest these are too long.)
        """
        plant, nominal = self.plant, self._nominal
        n, columns = len(nominal), tuple(range(len(u)) if inputs is None else inputs)
        m, effort = len(columns), np.array([plant.inputs[i].nominal for i in columns])

        def build() -> Native:
            state, own = ca.SX.sym("x", n), ca.SX.sym("u", m)
            held = ca.SX.sym("held", len(plant.inputs))
            parameters = ca.SX.sym("p", len(plant.parameters))
            whole = ca.SX(held)
            for i, column in enumerate(columns):
                whole[column] = own[i] * effort[i]
            ode = plant.function(state * nominal, whole, parameters)[0] / nominal
            slopes = ca.SX.sym("slopes", n, n + m)
            change = ca.jacobian(ode, state) @ slopes
            change[:, n:] += ca.jacobian(ode, own)
            dae = {
                "x": ca.vertcat(state, ca.vec(slopes)),
                "p": ca.vertcat(own, held, parameters),
                "ode": ca.vertcat(ode, ca.vec(change)),
            }
            return self._integrator("variation", dae, 1)

        known = plant.vector("parameter") if p is None else p
        begin = np.hstack([np.eye(n), np.zeros((n, m))])
        end = plant.cached(self._key("variation", columns, effort.tobytes()), build)(
            x0=np.concatenate([x / nominal, begin.ravel("F")]),
            p=np.concatenate([u[list(columns)] / effort, u, known]),
        )["xf"]
        found = np.asarray(end, dtype=float)[n:].reshape(n, n + m, order="F") * nominal[:, None]
        return found[:, :n] / nominal, found[:, n:] / effort


def stepped(
    slopes: Slopes, x: ca.SX, length: float | ca.SX, method: StepMethod, substeps: int
) -> ca.SX:
    """The state after ``length`` [s] by equal steps, as an expression: for programs and filters.

    method : "rk4" (explicit, order 4) or "rosenbrock" (RODAS3: linearly implicit, order 3,
    L-stable, for stiff plants).
    """
    h = length / substeps
    if method == "rk4":
        return rk4(lambda z, _: slopes(z)[0], x, h, substeps)
    for _ in range(substeps):
        x = rodas3(slopes, x, h)
    return x

"""A plant as python-control's NonlinearIOSystem. Apart from nlsys.py: it loads python-control."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import casadi as ca
import control
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..plants.plant import Plant
from ..simulation.sampled import SampledPlant
from ..simulation.simulator import simulate

__all__ = ["PlantSystem"]

Array: TypeAlias = NDArray[np.float64]


class _Buffers(threading.local):
    """A CasADi function with memory for its arguments and result, once for each thread.

    A call by ``Function.buffer()`` converts nothing and takes 0.6 us where the usual one takes 26,
    but writes to fixed memory: threads (and copies of a system) must not share it.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        # one closure: look-ups in a thread's own attributes are slow. The holder must stay alive
        self.holder, self.run = _runner(function)

    def __deepcopy__(self, memo: Any) -> _Buffers:
        return type(self)(self.function)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[ca.Function]]:
        return type(self), (self.function,)


def _runner(function: ca.Function) -> tuple[Any, Callable[[Array, Array, Array], Array]]:
    """The holder of the memory, and (x, u, p) -> the function's first result."""
    buffer: Any = function.buffer()
    holder, call = buffer
    own_x, own_u, own_p = own = [np.zeros(function.numel_in(i)) for i in range(3)]
    result: Array = np.zeros(function.numel_out(0))
    for i, argument in enumerate(own):
        holder.set_arg(i, memoryview(argument))  # type: ignore[arg-type]
    holder.set_res(0, memoryview(result))  # type: ignore[arg-type]
    known: Array | None = None  # the parameters that own_p holds, by identity

    def run(x: Array, u: Array, p: Array) -> Array:
        nonlocal known
        own_x[:] = x
        own_u[:] = u
        if p is not known:
            own_p[:] = p
            known = p
        call()
        return np.array(result)

    return holder, run


class PlantSystem(control.NonlinearIOSystem):  # type: ignore[misc]
    """x' = f(x, u, p), y = g(x, u, p) of a plant; made by :func:`pam_ocp.operating.as_nlsys`.

    With ``dt`` in discrete time: x(t + dt) = F(x(t), u(t), p), the inputs held over dt.
    x0, u0 : states and (chosen) inputs of the point that it was made at, for ``X0`` and ``U``.
    units : {signal: SI unit} of states, inputs and outputs; ``params`` holds all parameters.
    Its ``linearize`` (and so ``control.linearize``) is exact.
    """

    def __init__(
        self,
        plant: Plant,
        x: Array,
        u: Array,
        inputs: Sequence[str],
        outputs: Sequence[str],
        dt: float | None = None,
        rtol: float = 1e-9,
    ) -> None:
        self.plant = plant
        self._sampled = None if dt is None else SampledPlant(plant, dt, rtol)
        self._held = u
        all_inputs = [v.name for v in plant.inputs]
        self._columns = [all_inputs.index(n) for n in inputs]
        self._rows = [[v.name for v in (*plant.states, *plant.outputs)].index(n) for n in outputs]
        self.x0, self.u0 = x.copy(), u[self._columns]
        state_function, output_function = self._functions(tuple(inputs), tuple(outputs))
        self._state_buffers, self._output_buffers = (
            _Buffers(f) for f in (state_function, output_function)
        )
        self._order = {signal(v.name): i for i, v in enumerate(plant.parameters)}
        self._defaults = np.concatenate([plant.vector("parameter"), u])
        self._p = self._defaults
        names = [v.name for v in plant.states]
        super().__init__(
            self._update,
            self._output,
            name=plant.name,
            params={signal(v.name): v.start for v in plant.parameters},
            states=[signal(n) for n in names],
            inputs=[signal(n) for n in inputs],
            outputs=[signal(n) for n in outputs],
            dt=0 if dt is None else dt,
        )
        self.units = {signal(n): plant.variable(n).unit for n in (*names, *inputs, *outputs)}

    def _functions(
        self, inputs: tuple[str, ...], outputs: tuple[str, ...]
    ) -> tuple[ca.Function, ca.Function]:
        """(x, chosen u, [p, all u]) -> xdot or the next x, and -> y; inputs left out stand behind
        p.
        """
        plant = self.plant

        def build() -> tuple[ca.Function, ca.Function]:
            chosen = ca.SX.sym("u", len(inputs))
            held = ca.SX.sym("held", len(plant.inputs))
            u = ca.SX(held)
            for i, column in enumerate(self._columns):
                u[column] = chosen[i]
            xdot, y, _ = plant.function(plant.x, u, plant.p)
            rows = ca.vertcat(*(ca.vertcat(plant.x, y)[i] for i in self._rows))
            arguments = [plant.x, chosen, ca.vertcat(plant.p, held)]
            update = ca.Function("update", arguments, [ca.densify(xdot)])
            output = ca.Function("output", arguments, [ca.densify(rows)])
            if self._sampled is None:
                return update, output
            given = [ca.MX.sym(n, e.numel()) for n, e in zip("xup", arguments, strict=True)]
            p, known = ca.vertsplit(given[2], [0, len(plant.parameters), given[2].numel()])
            whole = ca.MX(known)
            for i, column in enumerate(self._columns):
                whole[column] = given[1][i]
            end = self._sampled.function(given[0], whole, p)
            return ca.Function("update", given, [end]), output

        nominal = plant.vector("state", attribute="nominal").tobytes()
        sampling = self._sampled and (self._sampled.sample_time, self._sampled.rtol)
        return plant.cached(  # type: ignore[no-any-return]
            ("nlsys", inputs, outputs, sampling, nominal), build
        )

    def response(
        self,
        T: Any,
        U: Any = None,
        X0: Any = None,
        params: Mapping[str, Any] | None = None,
        rtol: float = 1e-10,
    ) -> control.TimeResponseData:
        """``control.input_output_response`` by the plant's own integrator
        (:func:`pam_ocp.simulation.simulator`).

        T : output times [s]; U : (inputs, times) or one value per input, joined by straight lines
        (held, when the system is sampled), by default ``u0``; X0 : by default ``x0``. Quicker and
        tighter than a Python-side integrator, since nothing is called between two output times.
        Raises InputError, SimulationError.
        """
        t = np.asarray(T, float)
        u = np.asarray(self.u0 if U is None else U, float)
        if u.size not in (self.ninputs, self.ninputs * t.size):
            raise InputError(
                f"U has shape {u.shape}; give {self.ninputs} value(s) or ({self.ninputs}, {t.size})"
            )
        u = np.broadcast_to(u.reshape(self.ninputs, -1), (self.ninputs, len(t)))
        vector = self._vector(params)[: len(self.plant.parameters)]
        values = {v.name: float(n) for v, n in zip(self.plant.parameters, vector, strict=True)}
        x0 = np.broadcast_to(np.asarray(self.x0 if X0 is None else X0, float), (self.nstates,))
        held = {v.name: float(n) for v, n in zip(self.plant.inputs, self._held, strict=True)}
        names = [self.plant.inputs[i].name for i in self._columns]
        motion = simulate(
            self.plant,
            {**held, **dict(zip(names, u, strict=True))},
            t=t,
            start={v.name: float(n) for v, n in zip(self.plant.states, x0, strict=True)},
            parameters=values,
            interpolation="previous" if self._sampled else "linear",
            rtol=rtol,
        )
        x = motion.array([v.name for v in self.plant.states]).T
        # with the inputs as given: simulate holds the last but one over the last sample
        y = self._output_buffers.function(x, u, self._vector(params))
        return control.TimeResponseData(
            t,
            np.asarray(y, dtype=float),
            x,
            u,
            issiso=self.issiso(),
            output_labels=self.output_labels,
            input_labels=self.input_labels,
            state_labels=self.state_labels,
            sysname=self.name,
            title=f"Input/output response for {self.name}",
        )

    # ---- parameters --------------------------------------------------------------------------
    def _vector(self, params: Mapping[str, Any] | None) -> Array:
        """Parameters and held inputs; names of other systems are passed over, as python-control
        hands every system of an interconnection all of them."""
        vector: Array = self._defaults.copy()
        for name, value in (params or {}).items():
            index = self._order.get(signal(name))
            if index is not None:
                vector[index] = self.plant.parameters[index].check(value)
        return vector

    def _update_params(self, params: Mapping[str, Any] | None) -> None:
        super()._update_params(params)
        self._p = self._vector(params)

    # ---- what python-control calls ------------------------------------------------------------
    def _rhs(self, t: float, x: Array, u: Array) -> Array:
        return self._state_buffers.run(x, u, self._p)

    def _out(self, t: float, x: Array, u: Array) -> Array:
        return self._output_buffers.run(x, u, self._p)

    def _update(self, t: float, x: Array, u: Array, params: Mapping[str, Any] | None) -> Array:
        p = self._p if params is self._current_params else self._vector(params)
        return self._state_buffers.run(x, u, p)

    def _output(self, t: float, x: Array, u: Array, params: Mapping[str, Any] | None) -> Array:
        p = self._p if params is self._current_params else self._vector(params)
        return self._output_buffers.run(x, u, p)

    def linearize(
        self,
        x0: Any,
        u0: Any = None,
        t: float = 0,
        params: Mapping[str, Any] | None = None,
        eps: float = 1e-6,
        copy_names: bool = False,
        **kwargs: Any,
    ) -> control.StateSpace:
        """python-control's ``linearize`` with exact Jacobians; ``eps`` is not needed."""
        if hasattr(x0, "states") and hasattr(x0, "inputs"):
            x0, u0 = x0.states, x0.inputs if u0 is None else u0
        x = np.broadcast_to(np.asarray(x0, float), (self.nstates,))
        u = self._held.copy()
        u[self._columns] = 0.0 if u0 is None else u0
        vector = self._vector(params)
        p = vector[: len(self.plant.parameters)]
        a, b, c, d = (np.asarray(m) for m in self.plant.jacobians(x, u, p))
        c, d = np.vstack([np.eye(len(x)), c]), np.vstack([np.zeros_like(b), d])
        b = b[:, self._columns]
        if self._sampled:
            a, b = self._sampled.slopes(x, u, p, self._columns)
        system = control.StateSpace(
            a,
            b,
            c[self._rows],
            d[np.ix_(self._rows, self._columns)],
            self.dt,
            remove_useless_states=False,
        )
        if copy_names:
            system._copy_names(self, prefix_suffix_name="linearized")
        return control.StateSpace(system, **kwargs)


def signal(name: str) -> str:
    """A name as python-control takes it: there a dot means system.signal."""
    return name.replace(".", "_")

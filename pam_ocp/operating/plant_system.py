"""as_nlsys: a plant as one of python-control's own systems (which this loads)."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import casadi as ca
import control
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_positive, require_tolerance
from ..core.stop import verb
from ..numerics.solvers import Buffered
from ..plants.inversion import Inversion
from ..plants.plant import Plant, Values
from ..simulation.sampled import SampledPlant
from ..simulation.simulator import simulate
from .linear import chosen_signals, point_of
from .resting_point import OperatingPoint

Array: TypeAlias = NDArray[np.float64]


@verb
def as_nlsys(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    dt: float | None = None,
    rtol: float = 1e-9,
) -> PlantSystem:
    """The plant as python-control's NonlinearIOSystem, on CasADi functions without conversions.

    at : an OperatingPoint, or values by name (also of parameters); by default the start values.
        Inputs left out of ``inputs`` are held at its values.
    inputs, outputs : names to keep; by default all inputs, and all states and outputs. Of a plant
        fed by valves the inputs are the openings (``muscle_opening``), which have a slope through
        zero, unless commands are named; ``pam.plants.Inversion(plant).commands(...)`` gives the
        commands.
        ``inputs=[]`` gives an autonomous system, as ``phase_plane_plot`` wants it.

    Signals and parameters keep the plant's names with ``_`` for ``.`` (python-control reads a dot
    as system.signal); SI units in ``system.units``. Parameters change by python-control's
    ``params`` (``{"mass": 3.0}``); names that are not the plant's are passed over, as
    python-control's interconnections hand all parameters to every system. ``system.x0`` and
    ``system.u0`` hold the point ``at``; ``control.linearize`` of the system uses exact Jacobians.

    dt : sampling time [s] for a discrete-time system: its update is the plant's motion over one
        sample under held inputs, integrated at the relative tolerance ``rtol``. python-control then
        calls one compiled function for each sample, also in a loop with sampled controllers.
        Default: continuous time.

    Which call for which purpose: ``system.response(t, u)`` is the quickest for the plant alone (the
    plant's own integrator, nothing called in between); ``control.input_output_response`` of a
    system with ``dt`` for held inputs and sampled loops; that of a continuous one for everything
    else. There python-control integrates by default to rtol 1e-3: give ``solve_ivp_kwargs={"rtol":
    1e-9, "atol": 1e-9 * nominal}`` where figures matter. It joins samples of inputs by straight
    lines, as ``response`` does (held when the system has a ``dt``). One system may be used by
    several threads at once as long as ``params`` stay the same; copies are independent.

    Raises InputError or UnknownNameError for names that are not the plant's.

    Examples
    --------
    >>> import control
    >>> system = pam.operating.as_nlsys(plant, point)
    >>> t = np.linspace(0, 1, 11)
    >>> held = np.full(11, system.u0[0])
    >>> run = control.input_output_response(system, t, held, system.x0)
    >>> bool(np.ptp(run.outputs[0]) < 1e-5)  # it stays at rest
    True
    """
    plant, x, u = point_of(plant, at)
    inversion = Inversion(plant)
    if inversion and (inputs is None or any(inversion.opening_of(n) for n in inputs)):
        u = inversion.rows(u[None, :], x=x[None, :])[0]
        plant, x = inversion.inner, inversion.inside(x)
    return PlantSystem(
        plant,
        x,
        u,
        chosen_signals("inputs", plant, inputs, ("input",)),
        chosen_signals("outputs", plant, outputs, ("state", "output")),
        None if dt is None else require_positive("dt", dt, "s"),
        require_tolerance("rtol", rtol),
    )


class _Buffers(threading.local):
    """A CasADi function on fixed memory, once for each thread: these (and copies of a system) must
    not share it.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        # one closure: look-ups in a thread's own attributes are slow
        self.holder, self.run = _runner(function)

    def __deepcopy__(self, memo: Any) -> _Buffers:
        return type(self)(self.function)

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[ca.Function]]:
        return type(self), (self.function,)


def _runner(function: ca.Function) -> tuple[Buffered, Callable[[Array, Array, Array], Array]]:
    """The holder of the memory, and (x, u, p) -> the function's first result."""
    holder = Buffered(function)
    (own_x, own_u, own_p), call, result = holder.arguments, holder.call, holder.results[0][:, 0]
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

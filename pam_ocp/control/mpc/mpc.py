"""Mpc: model predictive control of any plant by multiple shooting and SQP."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ... import courtesy
from ...core.errors import (
    InputError,
    UnknownNameError,
    require_count,
    require_ends,
    require_instance,
    require_positive,
)
from ...core.quantities import outside
from ...core.shown import shown
from ...core.signals import PiecewisePolynomial
from ...core.stop import locked
from ...core.trajectory import Trajectory
from ...numerics.solvers import Buffered
from ...planning.transcription.transcription import smoothed
from ...plants.inversion import Inversion
from ...plants.plant import Plant, Values
from ...simulation.integrate import evaluated
from ...simulation.sampled import StepMethod
from ..kinds import CONTROLLERS, Array
from ..mpc_statistics import Calls, MpcStatistics
from ..references import Source
from ..step import Givens, Step
from .real_time import PATIENCE, RealTimeCalls, RealTimeIteration
from .shooting import NodeLimit, Penalty, TrackingProgram
from .sqp import QpSolver, Sqp, SqpOutcome, TrackingIpopt

if TYPE_CHECKING:
    from ...courtesy import ClosedLoop

Index: TypeAlias = NDArray[np.intp]

FIRST_ITERATIONS = 30
"""Of the first solve, which has no solution to start from."""

KINKS = 0.5
"""Place between the widest roundings (0) and the plant's own (1) at which a controller sees kinks:
one step of Newton's method a sample does not settle on sharper ones.
"""
REGULATED = 0.1
"""Part of the largest weight from which on a tracked variable is one that is to arrive."""
NO_INFLUENCE = 1e-10
"""Of nominals: what an input moves by less it does not move."""
FINER = 8
"""How many times finer a prediction is looked at by :meth:`Mpc.prediction_error`."""


@shown
@locked
@CONTROLLERS.register("mpc")
class Mpc:
    """Receding-horizon control: at each step, the best inputs over a horizon; the first is applied.

    minimises  sum over nodes  w/2 ((y - reference)/nominal)^2 + r/2 ((u - u before)/nominal)^2

    Parameters
    ----------
    plant : the model. Inputs marked as disturbances are not for the controller to choose. Of
        muscles fed by valves it chooses the openings (``plant.in_openings()``), which move the flow
        through zero, where commands have a dead zone, and gives the commands that make exactly
        these; weights and bounds may name either. ``plant.in_commands()`` leaves commands as they
        are.
    horizon : number of steps looked ahead, of ``sample_time`` seconds each.
    track : {state, output or input: weight w >= 0}.
    rate : {input: weight r >= 0} on its change from step to step. Weights on changes leave no
        steady error; weights on inputs (in ``track``) pull away from the reference of the others.
    terminal : {state or output: weight at the last node}, where inputs have no value any more;
        what is not named keeps that of ``track``.
    bounds : {state, input, output or constraint: (low, high)}, None for an open end; narrows the
        plant's own bounds and path constraints, which always hold.
    soft : limits of all but inputs may give way where they cannot be kept (after a disturbance, or
        with a noisy state), at the price ``penalty`` on the largest violation per node, in units of
        nominal. With False they are hard, and a step may fail.
    iterations : at most so many SQP steps per call; 1 is the real-time iteration (Diehl et al.,
        SIAM J. Control Optim. 43, 2005). The first call takes as many as it needs.
    work : no further SQP step is begun in a call once its quadratic programs took so many
        iterations of the interior-point method (known with "hpipm"). Usual calls take 5 to 7; after
        a jump of the reference the solution is completed over the calls that follow, so that no
        call takes much longer than the others; a larger number tracks jumps a little better. None:
        no limit. The first call has none either.
    delay : 0 when the inputs are applied at once, 1 when they take effect a step later: the state
        is then predicted to that time with the inputs applied meanwhile.
    method, substeps : of the integration from node to node, see Step ("rosenbrock" for stiff
        plants). None: 2 substeps, or as many as "rk4" needs to be stable at the start values.
    solver : "hpipm" or "piqp" for the quadratic programs, or "ipopt" for the whole program;
        "riccati": each call is the one Function that runs as C code and FMU, too (see
        ``pam.control.block``), to the last bit, slower than HPIPM by ten times where it is not
        compiled. None: "hpipm"; where ``compiled`` asks for machine code, an SQP step is one
        function of it, with the interior point of "riccati" inside.
    tolerance : an iteration that changes less ends the SQP, scaled by nominals: the errors that
        are minimised, as they weigh next to the largest weight (root mean square over the horizon),
        the inputs that are applied, and what predictions and limits were off by.
    compiled : the SQP's steps as machine code (with a ``solver`` that is named: the model's steps
        and their derivatives), a third of the time. True: built if need be, some seconds for each
        structure, once; kept in the cache. None: where it is there. False: never.

    Solutions are shifted by one step to start the next call: call :meth:`control` once per step.
    When the SQP fails, IPOPT is asked (with "riccati" the plan before is followed);
    :attr:`statistics` says how often, how often that failed
    too, and how often the solution applied had not converged. No step is replayed:
    :meth:`prediction_error` does that of the last one.

    Raises InputError for an invalid horizon, step or weight, UnknownNameError for
    names. The first call warns of an input that has no influence where the plant stands (a dead
    zone that is not declared): no solver of this kind finds out of it.

    Examples
    --------
    >>> weights = {"track": {"x": 1.0}, "rate": {"muscle.command": 0.1}}
    >>> mpc = pam.Mpc(plant, horizon=20, sample_time=0.01, **weights)
    >>> loop = mpc.closed_loop(plant, {"x": 0.045}, duration=1.0, start=point)
    >>> print(f"{loop['x'][-1]:.4f}")
    0.0450
    """

    def __init__(
        self,
        plant: Plant,
        *,
        horizon: int,
        sample_time: float,
        track: Mapping[str, float],
        rate: Mapping[str, float] | None = None,
        terminal: Mapping[str, float] | None = None,
        bounds: Mapping[str, Any] | None = None,
        soft: bool = True,
        penalty: float = 100.0,
        iterations: int = 3,
        work: int | None = 12,
        delay: int = 0,
        method: StepMethod = "rk4",
        substeps: int | None = None,
        solver: QpSolver | Literal["ipopt", "riccati"] | None = None,
        tolerance: float = 1e-3,
        compiled: bool | None = False,
    ) -> None:
        require_count("horizon", horizon)
        require_count("iterations", iterations)
        require_count("work", 1 if work is None else work)
        if delay not in (0, 1):
            raise InputError(f"delay = {delay!r}: give 0 (at once) or 1 (one step later)")
        penalty = require_positive("penalty", penalty)
        tolerance = require_positive("tolerance", tolerance)
        self.plant, self.horizon, self.delay = plant, horizon, delay
        self._states = [v.name for v in plant.states]
        self.sample_time = sample_time = require_positive("sample_time", sample_time, "s")
        self.iterations, self.work = iterations, math.inf if work is None else work
        self.inversion = inversion = Inversion(plant)
        self.model = smoothed(inversion.inner, KINKS)
        """The plant as the program sees it: with openings in place of the commands of valves, and
        the kinks of friction and hysteresis smoothed over wider widths.
        """
        self.given = Givens(self.model)
        if not self.given.controls:
            raise InputError(f"plant {plant.name!r} has no input that a controller may choose")
        how = Step.of("Mpc", self.model, sample_time, method, substeps)
        for argument, named in (("track", track), ("terminal", terminal), ("rate", rate)):
            require_instance(
                argument, named, Mapping, "give {name: weight}", none=argument != "track"
            )
        track, terminal = inversion.names(track), terminal and inversion.names(terminal)
        self._penalties = penalties = _penalties(self.model, track, terminal)
        rated = _weights(self.model, inversion.names(rate or {}), "rate", ("input",))
        limits = _limits(self.model, self.given, inversion.bounds(_pairs(plant, bounds)), soft)
        self.limits = {
            b.variable.name: (b.low, b.high) for b in limits if b.variable.causality != "input"
        }
        """Of states, outputs and constraints: the plant's ranges, narrowed by ``bounds``."""
        self._telling = _telling(self.plant, track)
        self.program = TrackingProgram(
            self.given,
            how,
            horizon,
            penalties,
            {n: w for n, w in rated.items() if w > 0},
            limits,
            (penalty, penalty),
        )
        self._only_ipopt = solver == "ipopt"
        self._patience = _Patience()
        if solver in ("ipopt", "riccati"):
            self._sqp = Sqp(self.program, "hpipm", tolerance)
        else:
            self._sqp = Sqp(self.program, solver, tolerance, compiled)
        self._ipopt: TrackingIpopt | None = None
        self._cores: dict[tuple[int, int], RealTimeIteration] = {}
        self._calls = RealTimeCalls(self.real_time(), compiled) if solver == "riccati" else None
        self._how, self._advance = how, self._predictor(how)
        self._going = Buffered(self._advance)
        self._one_on = _one_on(self.program)
        self._fine: ca.Function | None = None
        self.reset()

    def reset(self, inputs: Values | None = None, state: Values | None = None) -> None:
        """Forget solutions and statistics;
        ``inputs`` are those applied now, at ``state`` (start values if None).
        """
        values = self.plant.vector("input", inputs)
        x = self.plant.vector("state") if state is None else self._state(state)
        values = self.inversion.rows(values[None, :], x=x[None, :])[0]
        names = [v.name for v in self.model.inputs]
        chosen = [names.index(v.name) for v in self.given.controls]
        self._applied: Array = values[chosen] / self.program.u_nominal
        self._warm, self._patience = False, _Patience()
        self.idle: tuple[str, ...] = ()
        """Inputs without influence on what is tracked, where the first call stood."""
        self._watched = False
        self._done = Calls()
        if self._calls is not None:
            rest = self.inversion.rows(self.plant.vector("input")[None, :])[0]
            self._calls.reset(self.plant.vector("state"), rest[chosen])

    def real_time(
        self, iterations: int | None = None, patience: int = PATIENCE
    ) -> RealTimeIteration:
        """A call as one Function, see RealTimeIteration.

        iterations : SQP steps (None: as this Mpc). patience : calls in a row that may fail.
        """
        steps = self.iterations if iterations is None else iterations
        if (steps, patience) not in self._cores:
            self._cores[steps, patience] = RealTimeIteration(
                self.program,
                iterations=steps,
                work=self.work,
                tolerance=self._sqp.tolerance,
                delay=self.delay,
                patience=patience,
            )
        return self._cores[steps, patience]

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of the plant's inputs that :meth:`control` answers."""
        return tuple(v.name for v in self.plant.inputs if not v.disturbance)

    @property
    def statistics(self) -> MpcStatistics:
        """Times and iterations of the calls since the last :meth:`reset`."""
        return self._done.statistics

    def closed_loop(
        self,
        real: Plant | str | os.PathLike[str],
        reference: Mapping[str, Any],
        duration: float,
        **options: Any,
    ) -> ClosedLoop:
        """Run against a plant or an FMU: :func:`pam_ocp.control.loop.closed_loop` with it."""
        return courtesy.closed_loop(self, real, reference, duration=duration, **options)

    def tracking(
        self,
        reference: Mapping[str, Source],
        inputs: Mapping[str, float] | None = None,
        preview: bool = True,
    ) -> TrackingMpc:
        """The Controller that tracks ``reference``; see :class:`Tracking`."""
        own = set(self.commands)
        applied = None if inputs is None else {n: u for n, u in inputs.items() if n in own}
        return TrackingMpc(self, reference, applied, preview)

    # ---- one step -------------------------------------------------------------------------------
    def control(
        self,
        state: Values | Sequence[float] | Array,
        reference: Mapping[str, Any] | None = None,
        values: Values | None = None,
    ) -> dict[str, float]:
        """The inputs to apply from now on (with ``delay=1``: from the next step on), by name [SI].

        state : all states of the plant by name, or in order [SI].
        reference : {tracked name: number, or horizon + 1 values from the moment on at which the
            inputs take effect}; the start values for what is not named.
        values : of parameters, disturbance inputs, or "der(STATE)" for a constant added to a
            state's derivative: what an estimator found [SI].
        """
        begin = perf_counter()
        q = self.given.vector(values)
        p = q[: len(self.plant.parameters)]
        seen = self._state(state)
        now = self.inversion.inside(seen, p)
        point = self._sqp.point
        self._references(reference or {})
        point.set_given(q)
        if self._calls is None:
            outcome, fallback, failed = self._by_sqp(now / self.program.x_nominal, q)
        else:
            if not self._done.count:
                self._look_for_dead_inputs(now / self.program.x_nominal, q)
            outcome = self._calls(point, now, self._applied * self.program.u_nominal)
            fallback, failed = False, not outcome.usable
        self._warm = not failed
        at, low, high = self.program.first_inputs, self.program.w_low, self.program.w_high
        first = np.clip(point.w[at], low[at], high[at])  # held to their bounds against rounding
        before, self._applied = self._applied, first
        self._sample = now / self.program.x_nominal, before if self.delay else self._applied, q
        self._done.record(
            perf_counter() - begin,
            outcome.qp_seconds,
            outcome.iterations,
            outcome.work,
            outcome.step,
            outcome.converged,
            fallback,
            failed,
        )
        si = self._applied * self.program.u_nominal
        chosen = {v.name: float(u) for v, u in zip(self.given.controls, si, strict=True)}
        return self.inversion.commands(chosen, p, dict(zip(self._states, seen, strict=True)))

    def _brief(self) -> str:
        names = ", ".join(p.variable.name for p in self._penalties)
        length = f"{self.horizon} x {1e3 * self.sample_time:g} ms"
        return f"of {self.plant.name}: horizon {length}, tracks {names}"

    def prediction(self) -> Trajectory:
        """The planned motion of the last call,
        from the moment on at which the inputs take effect.
        """
        p, point = self.program, self._sqp.point
        scaled, inputs_scaled = self._planned()
        states: Array = scaled.T * p.x_nominal
        chosen = inputs_scaled.T * p.u_nominal
        chosen = np.vstack([chosen, chosen[-1]])
        n = len(self.plant.parameters)
        columns = dict(zip((v.name for v in self.given.controls), chosen.T, strict=True))
        for i, v in enumerate(self.given.disturbances):
            columns[v.name] = np.full(len(chosen), point.given[n + i])
        inputs = np.column_stack([columns[v.name] for v in self.model.inputs])
        if self.inversion:
            states = self.inversion.inside(states, point.given[:n], inwards=False)
            inputs = self.inversion.sent(inputs, point.given[:n], states)
        t: Array = self.sample_time * np.arange(self.horizon + 1.0)
        held = PiecewisePolynomial(t, inputs[:-1, None, :])
        model = self.plant.with_values(
            {v.name: point.given[i] for i, v in enumerate(self.plant.parameters)}
        )
        return evaluated(model, t, states, held)

    def prediction_error(self) -> float:
        """How far the last call's prediction is from its own model's motion, scaled by nominals.

        The largest difference, over the steps of the horizon, between the next node and the step
        from the node before with substeps ``FINER`` times finer: the error of the integration, and
        what an SQP that was not run to its end leaves of defects. Takes some milliseconds; a
        controller does not do it by itself.
        """
        if self._fine is None:
            how = replace(self._how, substeps=FINER * self._how.substeps)
            self._fine = self._predictor(how)
        states, inputs = self._planned()
        exact = self._fine(states[:, :-1], inputs, self._sqp.point.given)
        worst = float(np.max(np.abs(np.asarray(exact, float) - states[:, 1:])))
        return worst if np.isfinite(worst) else math.inf

    # ---- inside ---------------------------------------------------------------------------------
    def _planned(self) -> tuple[Array, Array]:
        """States at all nodes and inputs at all but the last of the last solution, scaled."""
        p, unknowns = self.program, self._sqp.point.unknowns
        nodes, begin = unknowns[p.at], p.nx + len(p.rated)
        states = np.column_stack([nodes[: p.nx], unknowns[p.at_last][: p.nx]])
        return states, nodes[begin : begin + p.nu]

    def expected(self) -> dict[str, float]:
        """Velocities (of plants without positions, tracked states) at the end of the sample of the
        last call, by the model's own step, whatever the SQP has left of defects.
        """
        x, u, q = self._sample
        after = self._going(x, u, q)[0][:, 0] * self.program.x_nominal
        return {n: float(after[i]) for n, i in self._telling.items()}

    def _by_sqp(self, x: Array, q: Array) -> tuple[SqpOutcome, bool, bool]:
        """The program solved from a scaled state: (outcome, IPOPT was asked, it failed too)."""
        if self.delay:
            x = self._going(x, self._applied, q)[0][:, 0].copy()
        point = self._sqp.point
        self._guess(x)
        if not self._done.count:
            self._look_for_dead_inputs(x, q)
        limit = self.iterations if self._warm else max(self.iterations, FIRST_ITERATIONS)
        kept, call = point.w.copy(), self._done.count
        fallback = failed = False
        if self._only_ipopt:
            outcome = self._by_ipopt()
        else:
            outcome = self._sqp.solve(limit, self.work if self._warm else math.inf)
            if not outcome.usable and self._rolled_out():
                outcome = self._sqp.solve(max(self.iterations, FIRST_ITERATIONS))
            if not outcome.usable and self._patience.asks(call):
                fallback = True
                point.w[:] = kept
                outcome = self._by_ipopt()
                self._patience.told(call, outcome.usable)
        if not outcome.usable:
            failed = True
            point.w[:] = kept
        return outcome, fallback, failed

    def _rolled_out(self) -> bool:
        """The motion that the model makes under the inputs that act now, as a guess without
        defects; False where it grows without bound.
        """
        p, point = self.program, self._sqp.point
        states = p.nx + len(p.rated)
        x = point.start[: p.nx].copy()
        point.unknowns[p.at[p.nx : states]] = self._applied[p.rated][:, None]
        point.unknowns[p.at[states : states + p.nu]] = self._applied[:, None]
        point.unknowns[p.at[states + p.nu :]] = 0.0
        for k in range(1, self.horizon + 1):
            x = self._going(x, self._applied, point.given)[0][:, 0].copy()
            at = p.at[: p.nx, k] if k < self.horizon else p.at_last[: p.nx]
            point.unknowns[at] = x
        return bool(np.all(np.isfinite(point.unknowns)))

    def _predictor(self, how: Step) -> ca.Function:
        p = self.program
        return ca.Function("predict", [p.x, p.u, p.q], [how.expression(self.given, p.x, p.u, p.q)])

    def _look_for_dead_inputs(self, x: Array, q: Array) -> None:
        """Which inputs have no influence on what is tracked, over the horizon, the inputs as they
        are: with zero slopes a solver of this kind does not find out of where it stands.
        """
        p = self.program
        step = self._advance(p.x, p.u, p.q)
        tracked = [e for e in self._penalties if e.variable.causality != "input" and e.weight > 0]
        if not tracked:
            return
        x_si, u_si = self.model.vector("state", attribute="nominal"), p.u_nominal
        inputs, parameters, _ = self.given.parts(p.q, p.u * u_si)
        here = ca.vertcat(*(e.expression / e.variable.nominal for e in tracked))
        values = ca.Function("tracked", [self.model.x, self.model.u, self.model.p], [here])
        seen = values(p.x * x_si, inputs, parameters)
        slopes = [ca.jacobian(e, s) for e in (step, seen) for s in (p.x, p.u)]
        at = ca.Function("slopes", [p.x, p.u, p.q], [step, *map(ca.densify, slopes)])
        moved, effect = np.zeros((p.nx, p.nu)), np.zeros(p.nu)
        for _ in range(self.horizon):
            after, a, b, c, d = (np.asarray(e, dtype=float) for e in at(x, self._applied, q))
            effect = np.maximum(effect, np.abs(c @ moved + d).max(axis=0))
            moved, x = a @ moved + b, after.ravel()
            if not np.all(np.isfinite(moved)):
                return
        effect = np.maximum(effect, np.abs(c @ moved).max(axis=0))
        dead = effect <= NO_INFLUENCE
        self.idle = tuple(v.name for v, none in zip(self.given.controls, dead, strict=True) if none)
        if self.idle and not self._watched:
            names = ", ".join(e.variable.name for e in tracked)
            warnings.warn(
                f"Mpc: {', '.join(self.idle)} has no influence on {names} over the horizon from "
                "where the plant stands: its slope is 0, as in a dead zone, and it will hardly be "
                "moved. Declare the dead zone (plant.dead_zone(command, width), or of the position "
                "of a spool), so that its inverse is used",
                stacklevel=outside(),
            )

    def _by_ipopt(self) -> SqpOutcome:
        self._ipopt = self._ipopt or TrackingIpopt(self.program)
        return self._ipopt.solve(self._sqp.point)

    def _state(self, state: Values | Sequence[float] | Array) -> Array:
        names = self._states
        if isinstance(state, Mapping) and not all(n in state for n in names):
            given = {self.plant.variable(n).name: v for n, v in state.items()}
            missing = [n for n in names if n not in given]
            if missing:
                raise InputError(f"state: {missing[0]} is missing; give all of {', '.join(names)}")
            state = given
        if isinstance(state, Mapping):
            state = [state[n] for n in names]
        values = np.asarray(state, dtype=float)
        if values.shape != (len(names),) or not np.all(np.isfinite(values)):
            raise InputError(
                f"state = {values}: give one finite number for each of {', '.join(names)}"
            )
        return values

    def _references(self, reference: Mapping[str, Any]) -> None:
        given = self.inversion.references(reference, self.horizon + 1)
        tracked = {p.variable.name: i for i, p in enumerate(self.program.penalties)}
        for i, penalty in enumerate(self.program.penalties):
            self._sqp.point.references[:, i] = penalty.variable.start or 0.0
        for name, value in given.items():
            if name not in tracked:
                raise UnknownNameError("tracked variable", name, tracked)
            column = np.asarray(value, dtype=float)
            if column.shape not in ((), (self.horizon + 1,)) or not np.all(np.isfinite(column)):
                raise InputError(
                    f"reference[{name!r}] has shape {column.shape}: give a finite number or "
                    f"{self.horizon + 1} of them (horizon + 1)"
                )
            self._sqp.point.references[:, tracked[name]] = column

    def _guess(self, x: Array) -> None:
        """The last solution one step on; at first the state and the inputs as they are."""
        p, point = self.program, self._sqp.point
        states = p.nx + len(p.rated)
        if self._warm:
            point.unknowns[self._one_on[0]] = point.unknowns[self._one_on[1]]
            end, inputs = p.at_last[: p.nx], p.at[states : states + p.nu, -1]
            last = self._going(point.unknowns[end], point.unknowns[inputs], point.given)
            point.unknowns[end] = last[0][:, 0]
        else:
            node = np.zeros(p.y_size)
            node[: p.nx], node[p.nx : states] = x, self._applied[p.rated]
            node[states : states + p.nu] = self._applied
            point.unknowns[:] = 0.0
            point.unknowns[p.at] = node[:, None]
            point.unknowns[p.at_last[: p.nx]] = x
        point.start[: p.nx], point.start[p.nx :] = x, self._applied[p.rated]


@dataclass
class _Patience:
    """Of a controller whose programs fail: IPOPT takes seconds to fail, too, so it is asked again
    after twice as many calls each time.
    """

    wait: int = 1
    again: int = 0

    def asks(self, call: int) -> bool:
        """Whether at this call."""
        return call >= self.again

    def told(self, call: int, usable: bool) -> None:
        """What came of it."""
        self.wait = 1 if usable else 2 * self.wait
        self.again = call + self.wait


_ASKED = ("statistics", "prediction_error", "expected", "inversion", "limits", "idle")


@dataclass
class TrackingMpc:
    """An Mpc as a Controller, with what it is to track.

    Estimated unknowns among what it is given are planned with; the states are taken as they are
    given.
    """

    mpc: Mpc
    reference: Mapping[str, Source]
    inputs: Values | None = None
    """Those applied as a run begins; None: start values."""
    preview: bool = True

    def reset(self) -> None:
        """See :class:`Controller`."""
        self.mpc.reset(self.inputs)
        self.mpc._watched = True  # a loop says in its verdict what is the matter

    def wanted(self, t: float) -> dict[str, float]:
        """What is to be reached at a time [s]."""
        return {n: at(t) for n, at in self.reference.items()}

    def __getattr__(self, name: str) -> Any:
        """What a loop asks that the Mpc knows."""
        if name not in _ASKED:
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.mpc, name)

    def aims(self, t: float) -> dict[str, float]:
        """Of what is wanted states and outputs that have ``REGULATED`` of the largest weight."""
        weights = {p.variable.name: p.weight for p in self.mpc._penalties}
        least = REGULATED * max(weights.values())
        kinds = {v.name for v in (*self.mpc.plant.states, *self.mpc.plant.outputs)}
        known = {n: self.mpc.plant.variable(n).name for n in self.reference if n not in weights}
        named = {known.get(n, n): v for n, v in self.wanted(t).items()}
        return {n: v for n, v in named.items() if n in kinds and weights.get(n, 0.0) >= least}

    def __call__(self, t: float, measured: Mapping[str, float]) -> dict[str, float]:
        """See :class:`Controller`."""
        mpc = self.mpc
        states = [v.name for v in mpc.plant.states]
        ahead = t + mpc.sample_time * (mpc.delay + np.arange(mpc.horizon + 1))
        if not self.preview:
            ahead = np.full_like(ahead, t)
        reference = {n: np.array([at(float(s)) for s in ahead]) for n, at in self.reference.items()}
        names = set(mpc.given.names)
        unknowns = {n: v for n, v in measured.items() if n in names}
        return mpc.control({n: measured[n] for n in states}, reference, unknowns)


# ---- checking the arguments ---------------------------------------------------------------------
def _telling(plant: Plant, track: Mapping[str, float]) -> dict[str, int]:
    """{state whose prediction tells of the model: its place}: velocities, or tracked states."""
    names = [v.name for v in plant.states]
    found = [v for p in plant.resting() for v in p.velocities if v in names]
    found = found or [n for n in names if n in track]
    return {n: names.index(n) for n in found}


def _one_on(p: TrackingProgram) -> tuple[Index, Index]:
    """(where, whence): the unknowns of each node from those of the next one, the last's inputs
    again.
    """
    states, source = p.nx + len(p.rated), p.at.copy()
    source[:, :-1] = p.at[:, 1:]
    source[: p.nx, -1] = p.at_last[: p.nx]
    source[p.nx : states, -1] = p.at[states : states + p.nu, -1][p.rated]
    return p.at.ravel(), source.ravel()


def _weights(
    plant: Plant, given: Mapping[str, float], argument: str, allowed: tuple[str, ...]
) -> dict[str, float]:
    weights = {}
    for name, weight in given.items():
        variable = plant.variable(name)
        if variable.causality not in allowed or variable.disturbance:
            kind = "a disturbance" if variable.disturbance else variable.kind
            raise InputError(
                f"{argument}: {variable.name} is {kind}; give {' or '.join(allowed)} variables"
            )
        label = f"{argument}[{variable.name!r}]"
        weights[variable.name] = require_positive(label, weight, zero=True)
    return weights


def _penalties(
    plant: Plant, track: Mapping[str, float], terminal: Mapping[str, float] | None
) -> list[Penalty]:
    weights = _weights(plant, track, "track", ("state", "output", "input"))
    named = _weights(plant, terminal or {}, "terminal", ("state", "output"))
    controls = [plant.expression(v.name) for v in plant.inputs if not v.disturbance]
    for name, weight in named.items():
        if weight and ca.depends_on(plant.expression(name), ca.vertcat(*controls)):
            raise InputError(
                f"terminal: {name} depends on the inputs, which have no value at the last node; "
                "give a state, or an output of states alone"
            )
    last = weights | named
    names = list(last)
    if not any(w > 0 for w in weights.values()):
        raise InputError(f"track = {dict(track)}: at least one weight must be > 0")
    return [
        Penalty(plant.variable(n), plant.expression(n), weights.get(n, 0.0), last.get(n, 0.0))
        for n in names
    ]


def _limits(
    plant: Plant, given: Givens, bounds: Mapping[str, tuple[float, float]], soft: bool
) -> list[NodeLimit]:
    """The plant's bounds and path constraints, narrowed by ``bounds``."""
    narrowed = dict(bounds)
    limits = []
    for variable in (*plant.states, *given.controls, *plant.constraints, *plant.outputs):
        low, high = narrowed.pop(variable.name, (-math.inf, math.inf))
        low, high = max(low, variable.min), min(high, variable.max)
        if low > high:
            raise InputError(
                f"bounds[{variable.name!r}] leave nothing of the plant's own "
                f"{variable.exactly(variable.min)} .. {variable.exactly(variable.max)}"
            )
        if math.isfinite(low) or math.isfinite(high):
            gives = soft and variable.causality != "input"
            limits.append(NodeLimit(variable, plant.expression(variable.name), low, high, gives))
    if narrowed:
        name = next(iter(narrowed))
        raise InputError(f"bounds: {name} is a parameter or a disturbance and cannot be bounded")
    return limits


def _pairs(plant: Plant, bounds: Mapping[str, Any] | None) -> dict[str, tuple[float, float]]:
    inner = plant.in_openings()
    found = {}
    for name, value in (bounds or {}).items():
        opening = Inversion(plant).opening_of(name)
        variable = inner.variable(opening) if opening else plant.variable(name)
        label = f"bounds[{variable.name!r}]"
        found[variable.name] = require_ends(label, value, variable.unit, open_ends=True)
    return found

"""A model predictive controller as a Block: the form in which it runs as FMU and as C code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca

from ...core.block import Block
from ...core.errors import InputError, require_count, require_instance, with_kinds
from ...core.stop import turns
from ...core.variables import Variable
from ...plants.plant import Plant
from ..blocks.draft import Draft, Symbol, about, opened_by
from ..kinds import BLOCKS
from .mpc import Mpc
from .real_time import FACTS, PATIENCE, RealTimeIteration

_TOLD = {
    "status": "0 solved, 1 unfinished, 2 failed: the plan before is followed, 3 failed for too "
    "long: the fallback is sent",
    "iterations": "SQP steps",
    "work": "iterations of the interior-point method",
    "last_step": "how much the last SQP step changed errors and inputs, scaled by nominals",
    "converged": "1 where the tolerance was met",
    "active": "number of limits that hold the plan back",
    "violation": "largest violation of a soft limit in the plan, scaled by nominals",
    "missing": "samples in a row that lacked a measurement: predicted values stood in",
    "failures": "samples in a row whose quadratic program failed",
}
_CODES = "solved unfinished failed fallback"


@with_kinds
@BLOCKS.register("Mpc")
@turns
def mpc_block(
    controller: Mpc,
    name: str = "mpc",
    *,
    preview: bool = False,
    estimated: Sequence[str] = (),
    iterations: int | None = None,
    patience: int = PATIENCE,
) -> Block:
    """The Mpc's call by real-time iteration; see RealTimeIteration for what it does.

    Inputs: the plant's states (an entry that is NaN is replaced by the model's prediction),
    ``wanted.NAME`` for what is tracked (held over the horizon), disturbances. Outputs: commands,
    and ``solver.status``, ``solver.iterations``... Parameters: those of the plant, ``low.NAME`` and
    ``high.NAME`` of each limit, ``fallback.NAME`` of each input.

    preview : further inputs ``ahead.NAME.k1`` to ``.kN``: what is to be reached at the nodes.
    estimated : parameters, disturbances or ``der(STATE)`` (input ``der.STATE``) that an estimator
        tells, as inputs.
    iterations : SQP steps per call, at most; by default those of ``controller``. The first call,
        too, takes no more, so that the worst case is bounded.
    patience : quadratic programs that may fail in a row before ``fallback`` is sent.

    Raises InputError where a bounded worst case cannot be given (``solver="ipopt"``).

    Examples
    --------
    >>> weights = {"track": {"x": 1.0}, "rate": {"muscle.command": 0.1}}
    >>> mpc = pam.Mpc(plant, horizon=10, sample_time=0.01, **weights)
    >>> made = pam.control.mpc_block(mpc)
    >>> made.name, "wanted.x" in [v.name for v in made.inputs]
    ('mpc', True)
    """
    require_instance("mpc_block: controller", controller, Mpc, "give an Mpc")
    if controller._only_ipopt:
        raise InputError(
            "solver = 'ipopt': the work of a call cannot be bounded; give the Mpc solver='riccati' "
            "or 'hpipm'"
        )
    count = controller.iterations if iterations is None else iterations
    require_count("iterations", count)
    require_count("patience", patience, 0)
    core = controller.real_time(count, patience)
    mpc, plant, inversion, given = (
        controller,
        controller.plant,
        controller.inversion,
        controller.given,
    )
    words = f"model predictive control of {plant.name}, horizon {mpc.horizon}"
    draft = Draft(name, mpc.sample_time, words, ca.MX)
    x = draft.measured(plant.states, missing=True)
    draft.sent(v for v in plant.inputs if not v.disturbance)
    steps = mpc.horizon if preview else 0
    rows = [_wanted(draft, e.variable, steps, mpc.horizon) for e in mpc.program.penalties]
    told = [given.name(n) for n in estimated]
    q = ca.vertcat(*(_told(draft, plant, n, n in told) for n in given.names))
    p, _ = ca.vertsplit(q, [0, len(plant.parameters), len(given.names)])
    acted = opened_by(inversion, plant, draft, (p, x))
    memory = draft.memories(core.start(plant.vector("state")), "of the last plan")
    after, chosen, facts = core.step(
        memory,
        x if inversion.exact else inversion.entering()(x, p),
        ca.vertcat(*(acted[v.name] for v in given.controls)),
        ca.vertcat(*rows),
        q,
        _bounds(draft, core),
        _fallback(draft, mpc),
    )
    draft.next("w1", after)
    draft.send(inversion, given.controls, chosen, (p, x))
    for i, fact in enumerate(FACTS):
        codes = _CODES if fact == "status" else ""
        words = _TOLD[fact]
        variable = Variable(f"solver.{fact}", "output", start=0.0, description=words, codes=codes)
        draft.output(variable, facts[i])
    draft.repeats("SQP steps", core.iterations)
    draft.repeats("iterations of the interior-point method", core.worst_work)
    return replace(draft.block(), delay=mpc.delay)


def _wanted(draft: Draft, variable: Variable, steps: int, horizon: int) -> Symbol:
    """A row of references at the nodes: those given, or the present one at each."""
    start = variable.start or 0.0
    first, name = draft.like(variable, "wanted."), f"ahead.{variable.name}"
    ahead = [draft.input(f"{name}.k{k + 1}", start, **about(variable)) for k in range(steps)]
    return ca.horzcat(first, *(ahead or [first] * horizon))


def _told(draft: Draft, plant: Plant, name: str, estimated: bool) -> Symbol:
    """An entry of q, as an input or a parameter; 0 for an offset that nobody tells."""
    if name.startswith("der("):
        if not estimated:
            return draft.kind(0.0)
        state = plant.variable(name[4:-1])
        words = f"added to the derivative of {state.name}, per second"
        return draft.input(f"der.{state.name}", description=words)
    v = plant.variable(name)
    if v.disturbance or estimated:
        return draft.like(v)
    return draft.parameter(name, v.start or 0.0, min=v.min, max=v.max, **about(v))


def _bounds(draft: Draft, core: RealTimeIteration) -> Symbol:
    """The ends of limits, each a parameter."""
    ends = []
    for bound in core.bounds:
        v, side = bound.limit.variable, "high" if bound.high else "low"
        words = about(v, f"{side}est {v.name} planned")
        ends.append(draft.parameter(f"{side}.{v.name}", bound.value, **words))
    return ca.vertcat(*ends)


def _fallback(draft: Draft, mpc: Mpc) -> Symbol:
    """Inputs where programs fail for too long, each a parameter; by default those at the start."""
    rest = mpc.inversion.rows(mpc.plant.vector("input")[None, :])[0]
    starts = dict(zip((v.name for v in mpc.model.inputs), rest, strict=True))
    controls = mpc.given.controls
    values = [starts[v.name] for v in controls]
    return draft.parameters("fallback", controls, values, "where programs fail for too long")

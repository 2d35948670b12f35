"""A model predictive controller as a Block: the form in which it runs as FMU and as C code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca

from ...core.block import Block
from ...core.errors import InputError, require_count, require_instance
from ...core.stop import turns
from ...core.variables import Variable
from ..blocks.draft import as_output
from ..blocks.kinds import BLOCKS, SENT
from .mpc import Mpc
from .real_time import FACTS, PATIENCE, RealTimeIteration

__all__ = ["mpc_block"]

_TOLD = {
    "status": "0 solved, 1 unfinished, 2 failed: the plan before is followed, 3 failed for too "
    "long: the fallback is sent",
    "iterations": "SQP steps",
    "work": "iterations of the interior-point method",
    "last_step": "how much the last SQP step changed errors and inputs, in units of nominal",
    "converged": "1 where the tolerance was met",
    "active": "number of limits that hold the plan back",
    "violation": "largest violation of a soft limit in the plan, in units of nominal",
    "missing": "samples in a row that lacked a measurement: predicted values stood in",
    "failures": "samples in a row whose quadratic program failed",
}


class _Columns:
    """Variables entered one by one; their symbols are the entries of a column."""

    def __init__(self) -> None:
        self.kept: dict[str, Variable] = {}

    def enter(self, name: str, like: Variable | None = None, **about: Any) -> str:
        """A variable, which takes its unit, nominal and description from another."""
        if like is not None:
            known = {"unit": like.unit, "nominal": like.nominal, "description": like.description}
            about = {**known, **about}
        self.kept[name] = Variable(name, **about)
        return name

    def column(self) -> tuple[ca.MX, dict[str, ca.MX]]:
        """(column, its entries by name)."""
        column = ca.MX.sym("c", len(self.kept))
        return column, dict(zip(self.kept, ca.vertsplit(column), strict=True))


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
    return _MpcBlock(controller, core, preview, estimated).block(name)


class _MpcBlock:
    def __init__(
        self, mpc: Mpc, core: RealTimeIteration, preview: bool, estimated: Sequence[str]
    ) -> None:
        self.mpc, self.core, self.plant, self.model = mpc, core, mpc.plant, mpc.model
        self.given, self.inversion = mpc.given, mpc.inversion
        self.ahead = range(1, mpc.horizon + 1) if preview else range(0)
        self.estimated = [self.given.name(n) for n in estimated]
        self.inputs, self.parameters = _Columns(), _Columns()
        self.states = [self._measured(v) for v in self.plant.states]
        self.sent = {v.name: self._measured(v, SENT) for v in self._commands()}
        self.wanted = [self._wanted(e.variable) for e in mpc.program.penalties]
        self.told = [self._told(n) for n in self.given.names]
        self._declare_parameters()

    def _commands(self) -> list[Variable]:
        return [v for v in self.plant.inputs if not v.disturbance]

    # ---- variables ------------------------------------------------------------------------------
    def _measured(self, variable: Variable, prefix: str = "") -> str:
        start = variable.start or 0.0
        return self.inputs.enter(prefix + variable.name, variable, causality="input", start=start)

    def _wanted(self, variable: Variable) -> list[str]:
        """Inputs of the references at the nodes: those given, and then the last one."""
        name, about = variable.name, {"causality": "input", "start": variable.start or 0.0}
        first = self.inputs.enter(f"wanted.{name}", variable, **about)
        found = [self.inputs.enter(f"ahead.{name}.k{k}", variable, **about) for k in self.ahead]
        return [first, *(found or [first] * self.mpc.horizon)]

    def _told(self, name: str) -> str:
        """The input or parameter that holds an entry of q; "" for an offset that nobody tells."""
        if name.startswith("der("):
            if name not in self.estimated:
                return ""
            state = self.plant.variable(name[4:-1])
            return self.inputs.enter(
                f"der.{state.name}",
                causality="input",
                start=0.0,
                description=f"added to the derivative of {state.name}, per second",
            )
        variable = self.plant.variable(name)
        start = variable.start or 0.0
        if variable.disturbance or name in self.estimated:
            return self.inputs.enter(name, variable, causality="input", start=start)
        return self.parameters.enter(
            name,
            variable,
            causality="parameter",
            start=start,
            min=variable.min,
            max=variable.max,
            tunable=True,
        )

    def _declare_parameters(self) -> None:
        self.bounds, self.fallback = [], []
        for bound in self.core.bounds:
            variable, side = bound.limit.variable, "high" if bound.high else "low"
            self.bounds.append(
                self.parameters.enter(
                    f"{side}.{variable.name}",
                    variable,
                    causality="parameter",
                    start=bound.value,
                    tunable=True,
                    description=f"{side}est {variable.name} planned",
                )
            )
        rest = self.inversion.rows(self.plant.vector("input")[None, :])[0]
        starts = dict(zip((v.name for v in self.model.inputs), rest, strict=True))
        for variable in self.given.controls:
            self.fallback.append(
                self.parameters.enter(
                    f"fallback.{variable.name}",
                    variable,
                    causality="parameter",
                    start=float(starts[variable.name]),
                    tunable=True,
                    description=f"{variable.name} where programs fail for too long",
                )
            )

    def _outputs(
        self, inputs: ca.MX, p: ca.MX, x: ca.MX, facts: ca.MX
    ) -> list[tuple[Variable, ca.MX]]:
        """Commands of the inputs chosen (of openings those that give them), and the facts."""
        found = []
        for i, variable in enumerate(self.given.controls):
            opening = self.inversion.opening_of(variable.name)
            if opening is None:
                found.append((as_output(self.plant.variable(variable.name)), inputs[i]))
                continue
            sent = self.inversion.inverse(opening)(inputs[i], p, x)
            for k, command in enumerate(self.inversion.commands_of(opening)):
                found.append((as_output(self.plant.variable(command)), sent[k]))
        for i, name in enumerate(FACTS):
            told = Variable(f"solver.{name}", "output", start=0.0, description=_TOLD[name])
            found.append((told, facts[i]))
        return found

    def _memory(self) -> tuple[Variable, ...]:
        start = self.core.start(self.plant.vector("state"))
        return tuple(
            Variable(f"w{i + 1}", "state", start=float(value), description="of the last plan")
            for i, value in enumerate(start)
        )

    # ---- equations ------------------------------------------------------------------------------
    def block(self, name: str) -> Block:
        inputs, seen = self.inputs.column()
        parameters, set_ = self.parameters.column()
        memory_in = self._memory()
        memory = ca.MX.sym("memory", len(memory_in))
        known = {"": ca.MX(0.0), **seen, **set_}

        def column(names: Sequence[str]) -> ca.MX:
            return ca.MX(ca.vertcat(*(known[n] for n in names))) if names else ca.MX(0, 1)

        q = column(self.told)
        p, _ = ca.vertsplit(q, [0, len(self.plant.parameters), len(self.told)])
        x = column(self.states)
        references = ca.vertcat(*(ca.horzcat(*(seen[n] for n in row)) for row in self.wanted))
        after, chosen, facts = self.core.step(
            memory,
            x if self.inversion.exact else self.inversion.entering()(x, p),
            self._applied(seen, p, x),
            references,
            q,
            column(self.bounds),
            column(self.fallback),
        )
        outputs = self._outputs(chosen, p, x, facts)
        step = ca.Function(
            "step",
            [memory, inputs, parameters],
            [after, ca.vertcat(*(value for _, value in outputs))],
            ["memory", "inputs", "parameters"],
            ["memory_next", "outputs"],
        )
        mpc = self.mpc
        return Block(
            name=name,
            sample_time=mpc.sample_time,
            inputs=tuple(self.inputs.kept.values()),
            outputs=tuple(v for v, _ in outputs),
            parameters=tuple(self.parameters.kept.values()),
            memory=memory_in,
            step=step,
            description=f"model predictive control of {self.plant.name}, horizon {mpc.horizon}",
            commands=tuple(v.name for v in self._commands()),
            missing=tuple(self.states),
            loops={
                "SQP steps": self.core.iterations,
                "iterations of the interior-point method": self.core.worst_work,
            },
        )

    def _applied(self, seen: dict[str, ca.MX], p: ca.MX, x: ca.MX) -> ca.MX:
        """The inputs of the model that acted since the last call, openings from the commands."""
        found = []
        for variable in self.given.controls:
            opening = self.inversion.opening_of(variable.name)
            if opening is None:
                found.append(seen[self.sent[variable.name]])
                continue
            commands = self.inversion.commands_of(opening)
            sent = ca.vertcat(*(seen[self.sent[c]] for c in commands))
            found.append(self.inversion.forward(opening)(sent, p, x))
        return ca.MX(ca.vertcat(*found))

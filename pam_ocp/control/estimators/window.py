"""Moving-horizon estimation as a block: Gauss-Newton steps of a fixed window, without heap.

Each step is the smoother of the window linearised about itself (estimators/smoother.py). Where the
result leaves its bounds, an interior-point method repeats it: the barrier of a bound is one more
measured number, whose variance falls as the bound comes near. All is written as Functions of one
node, mapped over the window; the work of a call is bounded.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ...core.block import Block
from ...core.variables import Variable
from ...numerics.bounded_loop import repeated
from ...numerics.portable import portable
from ..blocks.kinds import BLOCKS, LARGEST, SENT
from .extended_kalman import estimated_variables
from .moving_horizon import TOLERANCE, MovingHorizonEstimator
from .smoother import Side, Smoother

__all__ = ["moving_horizon"]

PASSES = 25
"""Of the smoother in one step that bounds hold back, at most."""
GAP = 1e-13
"""Mean complementarity that ends them, in squared standard deviations."""
CLOSED = 1e-7
"""Above it the bounds are left to the last resort: what is estimated is cut off at them."""
SHORT = 0.995
"""Share of the way to the nearest bound that is gone."""
ROOM = 1e-2
"""Least distance from a bound at the start, in units of nominal."""
CENTRED, LOST = 0.02, 0.5
"""How far the barrier falls after a long step, and after a short one."""


class _Window(Smoother):
    """The Functions of a filter's window."""

    def __init__(self, filter: MovingHorizonEstimator) -> None:
        self.window = filter
        self.low, self.high = ca.DM(filter._low), ca.DM(filter._high)
        self.given = ca.DM(filter.given.vector())
        sides = [
            Side(i, sign, float(bound))
            for i in range(len(filter.names))
            for sign, bound in ((1.0, filter._low[i]), (-1.0, filter._high[i]))
            if np.isfinite(bound)
        ]
        super().__init__(
            filter,
            filter.horizon + 1,
            filter.robust,
            (portable(filter._predict), portable(filter._measure)),
            sides,
            self.given,
        )

    # ---- bounds ------------------------------------------------------------------------------
    def _bounded(self) -> ca.Function:
        """(first, p, linear..., free changes, nodes) -> changes that keep the bounds."""
        n, nodes, count = self.n, self.nodes, len(self.sides)
        sizes = (n * n, n, n * n, self.m * n, self.m, self.m)
        first, p = ca.MX.sym("first", n), ca.MX.sym("p", n * n)
        linear = [ca.MX.sym(f"linear{k}", size, nodes) for k, size in enumerate(sizes)]
        z = ca.MX.sym("z", n, nodes)
        d, s, mu = (
            ca.MX.sym(k, size, nodes) for k, size in (("d", n), ("s", count), ("mu", count))
        )
        told = ca.MX.sym("told", 2)  # mean complementarity, length of the last step
        signs = ca.repmat(ca.DM([side.sign for side in self.sides]), 1, nodes)
        entries = [side.entry for side in self.sides]
        ends = ca.repmat(ca.DM([side.bound for side in self.sides]), 1, nodes) - z[entries, :]
        centre = told[0] * ca.if_else(told[1] > 0.9, CENTRED, LOST)
        weight = mu / s
        push = centre / s + mu
        target = ends + signs * push / weight
        new, _ = self.smooth(first, p, *linear, target, weight)
        ahead = signs * (new[entries, :] - ends)
        ds, dmu = ahead - s, push - weight * ahead - mu
        share = 1 / ca.fmax(
            1, ca.fmax(ca.mmax(ca.vec(-ds / s)), ca.mmax(ca.vec(-dmu / mu))) / SHORT
        )
        after = [d + share * (new - d), s + share * ds, mu + share * dmu]
        gap = ca.sum1(ca.sum2(after[1] * after[2])) / (count * nodes)
        constants = [first, p, *linear, z]
        body = ca.Function("pass", [d, s, mu, told, *constants], [*after, ca.vertcat(gap, share)])
        # a gap that is no number ends the passes, too
        wanted = told[0] > GAP
        loop = repeated(body, 4, PASSES, wanted, [d, s, mu, told])
        free = ca.MX.sym("free", n, nodes)
        room = ca.fmax(signs * (free[entries, :] - ends), ROOM)
        begun = [free, room, 1 / room, ca.MX(ca.DM([1.0, 1.0]))]
        found, _, _, end = loop(*begun, *constants)
        sound = ca.logic_and(end[0] <= CLOSED, _finite(found))
        return ca.Function("bounded", [*constants, free], [ca.if_else(sound, found, free)])

    # ---- one call ------------------------------------------------------------------------------
    def improve(self) -> ca.Function:
        """(z, covariance, largest change, prior, its covariance, u, y, has, real) -> the first
        three after at most ``iterations`` Gauss-Newton steps.
        """
        n, nodes = self.n, self.nodes
        z, square, change = (
            ca.MX.sym("z", n, nodes),
            ca.MX.sym("square", n * n),
            ca.MX.sym("change"),
        )
        prior, p = ca.MX.sym("prior", n), ca.MX.sym("p", n * n)
        u, y = ca.MX.sym("u", self.nu, nodes), ca.MX.sym("y", self.m, nodes)
        has, real = ca.MX.sym("has", self.m, nodes), ca.MX.sym("real", 1, nodes)
        ahead = [ca.horzcat(e[:, 1:], e[:, nodes - 1]) for e in (z, u)]
        linear = self.linear(z, ahead[0], u, ahead[1], y, has, real)
        none = ca.MX.zeros(len(self.sides), nodes)
        first = prior - z[:, 0]
        free, covariance = self.smooth(first, p, *linear, none, none)
        found = free
        if self.sides:
            low, high = (ca.repmat(e, 1, nodes) - TOLERANCE for e in (self.low, -self.high))
            inside = ca.logic_and(
                ca.mmin(ca.vec(z + free - low)) >= 0, ca.mmin(ca.vec(-z - free - high)) >= 0
            )
            arguments = [first, p, *linear, z, free]
            symbols = [ca.MX.sym(f"e{k}", e.sparsity()) for k, e in enumerate(arguments)]
            stay = ca.Function("stay", symbols, [symbols[-1]])
            found = ca.Function.if_else("within", stay, self._bounded())(inside, *arguments)
        fitted = z + found
        fitted = ca.fmax(
            ca.fmin(fitted, ca.repmat(self.high, 1, nodes)), ca.repmat(self.low, 1, nodes)
        )
        sound = ca.logic_and(_finite(found), _finite(covariance))
        fitted = ca.if_else(sound, fitted, z)
        covariance = ca.if_else(sound, covariance, square)
        size = ca.if_else(sound, ca.mmax(ca.fabs(ca.vec(found))), 0)
        constants = [prior, p, u, y, has, real]
        body = ca.Function("gauss", [z, square, change, *constants], [fitted, covariance, size])
        return repeated(body, 3, self.window.iterations, change > TOLERANCE, [z, square, change])

    def arrive(self) -> ca.Function:
        """(prior, its covariance, z, u, following u, y, has) -> the prior one node on."""
        n = self.n
        prior, p = ca.SX.sym("prior", n), ca.SX.sym("p", n * n)
        z, u, then = ca.SX.sym("z", n), ca.SX.sym("u", self.nu), ca.SX.sym("then", self.nu)
        y, has = ca.SX.sym("y", self.m), ca.SX.sym("has", self.m)
        c, error, variance = self.seen(z, u, self.given, y, has)
        mean, square = prior - z, ca.reshape(p, n, n)
        for i in range(self.m):
            spread = ca.mtimes(square, c[i, :].T)
            size = ca.mtimes(c[i, :], spread) + variance[i]
            mean = mean + spread * ((error[i] - ca.mtimes(c[i, :], mean)) / size)
            square = square - ca.mtimes(spread, spread.T) / size
        after, a, noise = self.moved(z, then, self.given)
        square = ca.mtimes([a, square, a.T]) + noise
        results = [after + ca.mtimes(a, mean), ca.vec((square + square.T) / 2)]
        return ca.Function("arrive", [prior, p, z, u, then, y, has], results, {"cse": True})


@BLOCKS.register("MovingHorizonEstimator")
def moving_horizon(filter: MovingHorizonEstimator, name: str = "estimator") -> Block:
    """The estimate of states and unknowns, as :class:`MovingHorizonEstimator`, begun anew.

    Inputs are what is measured (NaN where a value is missing) and the commands sent since the last
    step; outputs ``estimate.NAME`` and ``deviation.NAME``. Memory is the window.
    """
    window = _Window(filter)
    n, m, nodes = window.n, window.m, window.nodes
    controls = filter.given.controls
    sizes = {
        "nodes": n * nodes,
        "values": m * nodes,
        "present": m * nodes,
        "controls": len(controls) * nodes,
        "prior": n,
        "covariance": n * n,
        "counts": 2,
    }
    memory = ca.MX.sym("memory", sum(sizes.values()))
    inputs, parameters = ca.MX.sym("inputs", m + len(controls)), ca.MX.sym("parameters", 0)
    ends = np.cumsum([0, *sizes.values()]).tolist()
    part = dict(zip(sizes, ca.vertsplit(memory, ends), strict=True))
    z, y, has, u = (
        ca.reshape(part[key], -1, nodes) for key in ("nodes", "values", "present", "controls")
    )
    prior, p = part["prior"], part["covariance"]
    started, count = part["counts"][0], part["counts"][1]
    measured, sent = inputs[:m], inputs[m:]
    good = ca.fabs(measured) <= LARGEST
    value = ca.if_else(good, measured, 0) / ca.DM([v.nominal for v in filter.measured])

    # one step on, where there was one before
    oldest = [z[:, 0], u[:, 0], u[:, 1], y[:, 0], has[:, 0]]
    following, onward = window.arrive()(prior, p, *oldest)
    full = ca.logic_and(started, count >= filter.horizon)
    prior, p = (ca.if_else(full, a, b) for a, b in ((following, prior), (onward, p)))
    after = window.predict(z[:, nodes - 1], sent, window.given)[0]
    after = ca.fmax(ca.fmin(after, window.high), window.low)
    z = ca.if_else(started, ca.horzcat(z[:, 1:], after), z)
    y, has, u = (
        ca.horzcat(ca.if_else(started, old[:, 1:], old[:, : nodes - 1]), new)
        for old, new in ((y, value), (has, good), (u, sent))
    )
    count = ca.fmin(ca.if_else(started, count + 1, 0), filter.horizon)
    real = count >= filter.horizon - ca.DM(range(nodes)).T
    has = has * ca.repmat(real, m, 1)

    begun = [z, ca.MX.zeros(n * n), ca.MX(ca.DM(1.0))]
    z, covariance, _ = window.improve()(*begun, prior, p, u, y, has, real)
    scale = ca.DM(filter._scale)
    told = z[:, nodes - 1] * scale
    square = ca.diag(ca.reshape(covariance, n, n))
    deviation = ca.sqrt(ca.fmax(square, 0)) * scale
    rest = [ca.vec(e) for e in (z, y, has, u)] + [prior, p, ca.MX(1), count]
    step = ca.Function(
        "step",
        [memory, inputs, parameters],
        [ca.densify(ca.vertcat(*rest)), ca.vertcat(told, deviation)],
        ["memory", "inputs", "parameters"],
        ["memory_next", "outputs"],
    )
    kept = estimated_variables(filter)
    loops = {"Gauss-Newton steps": filter.iterations}
    if window.sides:
        loops["passes of the smoother"] = filter.iterations * (PASSES + 1)
    return Block(
        name=name,
        sample_time=filter.sample_time,
        inputs=tuple(_inputs(filter)),
        outputs=tuple(_outputs(kept)),
        parameters=(),
        memory=tuple(_memory(filter, sizes)),
        step=step,
        description=f"moving-horizon estimator, {filter.horizon} steps",
        missing=tuple(v.name for v in filter.measured),
        loops=loops,
    )


def _finite(columns: ca.MX) -> ca.MX:
    return ca.sum1(ca.fabs(ca.vec(columns))) <= LARGEST


def _inputs(filter: MovingHorizonEstimator) -> list[Variable]:
    pairs = [(v.name, v) for v in filter.measured]
    pairs += [(SENT + v.name, v) for v in filter.given.controls]
    return [
        Variable(
            name,
            "input",
            unit=v.unit,
            nominal=v.nominal,
            start=v.start or 0.0,
            description=v.description,
        )
        for name, v in pairs
    ]


def _outputs(kept: list[Variable]) -> list[Variable]:
    found = [
        Variable(
            f"estimate.{v.name}",
            "output",
            unit=v.unit,
            nominal=v.nominal,
            description=f"estimated: {v.description}",
        )
        for v in kept
    ]
    return found + [
        Variable(
            f"deviation.{v.name}", "output", unit=v.unit, nominal=v.nominal, min=0.0, start=0.0
        )
        for v in kept
    ]


def _memory(filter: MovingHorizonEstimator, sizes: dict[str, int]) -> list[Variable]:
    start_z, start_p = filter._first
    values = np.zeros(sum(sizes.values()))
    nodes = filter.horizon + 1
    values[: sizes["nodes"]] = np.tile(start_z[:, None], nodes).ravel(order="F")
    at = sum(list(sizes.values())[:4])
    values[at : at + len(start_z)] = start_z
    values[at + len(start_z) : at + len(start_z) + start_p.size] = start_p.ravel()
    return [
        Variable(f"w{i + 1}", "state", start=float(value), description="of the window")
        for i, value in enumerate(values)
    ]

"""The smoother of a window of nodes linearised about itself, as CasADi Functions of one node.

A Kalman filter forwards and the adjoint recursion backwards (G. J. Bierman, Automatica 9, 1973),
which inverts no matrix, so that states without noise are no exception. Measurements enter one
number at a time. Where the result leaves its bounds, an interior-point method repeats it: the
barrier of a bound is one more measured number, whose variance falls as the bound comes near. All is
written as Functions of one node, mapped over the window; the work of a call is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ...numerics.bounded_loop import inlined, repeated
from ..kinds import LARGEST
from .extended_kalman import Estimator, mirrored, taken_in

TOLERANCE = 1e-9
"""Change of the window's trajectory, scaled by nominals, that ends the Gauss-Newton steps."""
PASSES = 25
"""Of the smoother in one step that bounds hold back, at most."""
GAP = 1e-13
"""Mean complementarity that ends them, in squared standard deviations."""
CLOSED = 1e-7
"""Above it the bounds are left to the last resort: what is estimated is cut off at them."""
SHORT = 0.995
"""Share of the way to the nearest bound that is gone."""
ROOM = 1e-2
"""Least distance from a bound at the start, scaled by nominals."""
LONGEST = 200_000
"""Operations of a window that are written out one by one: a fifth less time for each."""
CENTRED, LOST = 0.02, 0.5
"""How far the barrier falls after a long step, and after a short one."""


@dataclass(frozen=True)
class Side:
    """sign (entry - bound) >= 0, scaled by nominals."""

    entry: int
    sign: float
    bound: float


class Smoother:
    """The Functions of a filter's window; columns are nodes, the last is the present.

    steps, sights : linear, of all nodes but the last, and of all nodes. free : changes of all
    nodes, and the covariance of the last one, as if there were no bounds; held : with them among
    what is measured.
    improve : Gauss-Newton steps of the window. arrive : the prior one node on.
    """

    def __init__(
        self,
        filter: Estimator,
        nodes: int,
        robust: float,
        functions: tuple[ca.Function, ca.Function],
        iterations: int,
        q: ca.DM | None = None,
    ) -> None:
        """functions : the filter's prediction and measurement. robust : Huber's limit.
        iterations : Gauss-Newton steps, at most. q : where it never changes.
        """
        self.filter, self.nodes, self.robust = filter, nodes, robust
        self.iterations, self.q = iterations, q
        self.sides = [
            Side(i, sign, float(bound))
            for i in range(len(filter.names))
            for sign, bound in ((1.0, filter._low[i]), (-1.0, filter._high[i]))
            if np.isfinite(bound)
        ]
        self.n, self.m = len(filter.names), len(filter.measured)
        self.nu, self.nq = len(filter.given.controls), len(filter.given.names)
        self.predict, self.measure = functions
        self.pattern = self.predict.sparsity_out(1) + ca.Sparsity.diag(self.n)
        """Of the Jacobian of a step; a node that stands still has ones on its diagonal."""
        self.steps, self.sights = self._step().map(nodes - 1), self._sight().map(nodes)
        self.free = self._smooth([])
        self.held = self._smooth(self.sides) if self.sides else self.free

    def unroll(self) -> None:
        """Loops over the nodes written out, for the interpreter; not where they are long."""
        node = self._step().n_instructions() + self._forward([]).n_instructions()
        if self.nodes * node <= LONGEST:
            self.steps, self.sights, self.free = (
                f.expand() for f in (self.steps, self.sights, self.free)
            )

    # ---- one node -------------------------------------------------------------------------------
    def moved(self, z: Any, u: Any, q: Any) -> tuple[Any, Any, Any]:
        """(following node, its Jacobian, covariance that the noise adds)."""
        after, a, half = inlined(self.predict, [z, u, q])
        return after, a, self.filter.noise_of_step(a, half)

    def seen(self, z: Any, u: Any, q: Any, y: Any, has: Any) -> tuple[Any, Any, Any]:
        """(Jacobian, measured - expected, variances) of a node; what is missing has no rows."""
        value, c = inlined(self.measure, [z, u, q])
        sigma = ca.DM(self.filter._noise)
        error = y - value
        variance = sigma**2
        if np.isfinite(self.robust):
            size, limit = ca.fabs(error) / sigma, self.robust
            variance = variance * ca.if_else(size > limit, size / limit, 1)
        rows = [ca.if_else(has[i], c[i, :], 0) for i in range(self.m)]
        return (
            ca.vertcat(*rows),
            ca.if_else(has, error, 0),
            ca.if_else(has, variance, 1),
        )

    def _step(self) -> ca.Function:
        """(z, following z, u, real, q) -> (a, gap, noise); without q where it is the same always. A
        node that is not ``real`` stands still.
        """
        n = self.n
        z, following = ca.SX.sym("z", n), ca.SX.sym("following", n)
        u, real = ca.SX.sym("u", self.nu), ca.SX.sym("real")
        told, q = self._given()
        after, a, noise = self.moved(z, u, q)
        a = ca.if_else(real, ca.project(a, self.pattern), ca.project(ca.SX.eye(n), self.pattern))
        gap = ca.if_else(real, after, z) - following
        noise = ca.if_else(real, noise, 0)
        found = [a.nz[:], gap, ca.densify(ca.vec(noise))]
        return ca.Function("step", [z, following, u, real, *told], found, {"cse": True})

    def _sight(self) -> ca.Function:
        """(z, u, y, has, q) -> (c, error, variance)."""
        z, u = ca.SX.sym("z", self.n), ca.SX.sym("u", self.nu)
        y, has = ca.SX.sym("y", self.m), ca.SX.sym("has", self.m)
        told, q = self._given()
        found = [ca.densify(ca.vec(e)) for e in self.seen(z, u, q, y, has)]
        return ca.Function("sight", [z, u, y, has, *told], found, {"cse": True})

    def _given(self) -> tuple[list[ca.SX], Any]:
        """(symbols of q, q): without a symbol where it never changes."""
        if self.q is not None:
            return [], self.q
        q = ca.SX.sym("q", self.nq)
        return [q], q

    # ---- the smoother ----------------------------------------------------------------------------
    def _forward(self, sides: list[Side]) -> ca.Function:
        """A node of the filter: takes (change, covariance) expected, gives those of the next node;
        keeps what the way back needs.
        """
        n, rows = self.n, self.m + len(sides)
        d, p = ca.SX.sym("d", n), ca.SX.sym("p", n * n)
        a, gap = ca.SX.sym("a", self.pattern.nnz()), ca.SX.sym("gap", n)
        noise = ca.SX.sym("noise", n * n)
        c, error = ca.SX.sym("c", self.m * n), ca.SX.sym("error", self.m)
        variance = ca.SX.sym("variance", self.m)
        target, weight = (ca.SX.sym(k, len(sides)) for k in ("target", "weight"))
        lines, square = self._lines(c, sides), ca.reshape(p, n, n)
        change = d
        gains, surprises = [], []
        for i in range(rows):
            j = i - self.m
            told = error[i] if j < 0 else target[j]
            spread = ca.mtimes(square, lines[i].T)
            along = ca.mtimes(lines[i], spread)
            if j < 0:
                size = along + variance[i]
                gain, surprise = spread / size, (told - ca.mtimes(lines[i], change)) / size
            else:  # by its weight 1/variance, which may be 0
                size = 1 + weight[j] * along
                gain = spread * (weight[j] / size)
                surprise = weight[j] * (told - ca.mtimes(lines[i], change)) / size
            change = change + spread * surprise
            square = mirrored(square - ca.mtimes(gain, spread.T))
            gains.append(gain)
            surprises.append(surprise)
        jacobian = ca.SX(self.pattern, a)
        following = ca.mtimes(jacobian, change) + gap
        carried = ca.mtimes([jacobian, square, jacobian.T]) + ca.reshape(noise, n, n)
        kept = [change, ca.vec(square), ca.vertcat(*gains), ca.vertcat(*surprises)]
        given = [d, p, a, gap, noise, c, error, variance, target, weight]
        results = [ca.densify(e) for e in (following, ca.vec(mirrored(carried)), *kept)]
        return ca.Function("forward", given, results, {"cse": True})

    def _lines(self, c: ca.SX, sides: list[Side]) -> list[ca.SX]:
        """What is measured of a node, one row each: measurements, then bounded entries."""
        matrix, eye = ca.reshape(c, self.m, self.n), ca.SX.eye(self.n)
        return [matrix[i, :] for i in range(self.m)] + [eye[s.entry, :] for s in sides]

    def _backward(self, sides: list[Side]) -> ca.Function:
        """A node of the way back: takes the adjoint from behind, gives that before the node."""
        n, rows = self.n, self.m + len(sides)
        after = ca.SX.sym("after", n)
        change, p = ca.SX.sym("change", n), ca.SX.sym("p", n * n)
        a, c = ca.SX.sym("a", self.pattern.nnz()), ca.SX.sym("c", self.m * n)
        gains, surprises = ca.SX.sym("gains", n * rows), ca.SX.sym("surprises", rows)
        adjoint = ca.densify(ca.mtimes(ca.SX(self.pattern, a).T, after))
        smoothed = change - ca.mtimes(ca.reshape(p, n, n), adjoint)
        lines = self._lines(c, sides)
        for i in reversed(range(rows)):
            gain = gains[i * n : (i + 1) * n]
            along = ca.mtimes(gain.T, adjoint)
            adjoint = adjoint - lines[i].T * (along + surprises[i])
        given = [after, change, p, a, c, gains, surprises]
        return ca.Function("backward", given, [adjoint, smoothed], {"cse": True})

    def _smooth(self, sides: list[Side]) -> ca.Function:
        """(prior's change, its covariance, linear..., targets, weights) -> (changes, covariance of
        the last node).
        """
        n, nodes, rows = self.n, self.nodes, self.m + len(sides)
        sizes = (*self._sizes, len(sides), len(sides))
        first, p = ca.MX.sym("first", n), ca.MX.sym("p", n * n)
        given = [ca.MX.sym(f"given{k}", size, nodes) for k, size in enumerate(sizes)]
        forward = self._forward(sides).mapaccum("forwards", nodes, 2)
        _, _, change, square, gains, surprises = forward(first, p, *given)
        order = [nodes - 1 - k for k in range(nodes)]
        turned = [e[:, order] for e in (change, square, given[0], given[3], gains, surprises)]
        back = self._backward(sides).mapaccum("backwards", nodes, 1)
        _, smoothed = back(ca.MX.zeros(n, 1), *turned)
        assert gains.shape == (n * rows, nodes)
        return ca.Function("smooth", [first, p, *given], [smoothed[:, order], square[:, nodes - 1]])

    @property
    def _sizes(self) -> tuple[int, ...]:
        """Of a node's part of what :meth:`_linear` gives."""
        n, m = self.n, self.m
        return self.pattern.nnz(), n, n * n, m * n, m, m

    def _linear(
        self, z: ca.MX, u: ca.MX, then: ca.MX, y: ca.MX, has: ca.MX, real: ca.MX, *q: ca.MX
    ) -> list[ca.MX]:
        """(a, gap, noise, c, error, variance) of all nodes: ``u`` and q[0] those of the
        measurement, ``then`` and q[1] those of the step. The last node's step leads nowhere.
        """
        before = self.nodes - 1
        step = self.steps.call(
            [z[:, :before], z[:, 1:], *(e[:, :before] for e in (then, real, *q[1:]))]
        )
        none = (ca.horzcat(e, ca.MX.zeros(e.shape[0], 1)) for e in step)
        return [*none, *self.sights.call([z, u, y, has, *q[:1]])]

    # ---- bounds ------------------------------------------------------------------------------
    def _bounded(self) -> ca.Function:
        """(first, p, linear..., free changes, nodes) -> changes that keep the bounds."""
        n, nodes, count = self.n, self.nodes, len(self.sides)
        first, p = ca.MX.sym("first", n), ca.MX.sym("p", n * n)
        linear = [ca.MX.sym(f"linear{k}", size, nodes) for k, size in enumerate(self._sizes)]
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
        new, _ = self.held(first, p, *linear, target, weight)
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
        """(z, covariance, largest change, prior, its covariance, u, following u, y, has, real, q,
        following q) -> the first three after Gauss-Newton steps; without q where it never changes.
        """
        n, nodes = self.n, self.nodes
        z, square, change = (
            ca.MX.sym("z", n, nodes),
            ca.MX.sym("square", n * n),
            ca.MX.sym("change"),
        )
        prior, p = ca.MX.sym("prior", n), ca.MX.sym("p", n * n)
        sizes = {"u": self.nu, "then": self.nu, "y": self.m, "has": self.m, "real": 1}
        if self.q is None:
            sizes |= {"q": self.nq, "q_then": self.nq}
        rest = [ca.MX.sym(k, size, nodes) for k, size in sizes.items()]
        linear = self._linear(z, *rest)
        none = ca.MX(0, nodes)
        first = prior - z[:, 0]
        free, covariance = self.free(first, p, *linear, none, none)
        found = free
        low, high = (ca.repmat(ca.DM(e), 1, nodes) for e in (self.filter._low, self.filter._high))
        if self.sides:
            free_z = z + free
            inside = ca.mmin(ca.vec(ca.fmin(free_z - low, high - free_z))) >= -TOLERANCE
            arguments = [first, p, *linear, z, free]
            symbols = [ca.MX.sym(f"e{k}", e.sparsity()) for k, e in enumerate(arguments)]
            stay = ca.Function("stay", symbols, [symbols[-1]])
            found = ca.Function.if_else("within", stay, self._bounded())(inside, *arguments)
        fitted = z + found
        fitted = ca.fmax(ca.fmin(fitted, high), low)
        sound = ca.logic_and(_finite(found), _finite(covariance))
        fitted = ca.if_else(sound, fitted, z)
        covariance = ca.if_else(sound, covariance, square)
        size = ca.if_else(sound, ca.mmax(ca.fabs(ca.vec(found))), 0)
        constants = [prior, p, *rest]
        body = ca.Function("gauss", [z, square, change, *constants], [fitted, covariance, size])
        return repeated(body, 3, self.iterations, change > TOLERANCE, [z, square, change])

    def arrive(self) -> ca.Function:
        """(prior, its covariance, z, u, following u, y, has, q, following q) -> the prior one node
        on, and its covariance: a step of the extended Kalman filter about the window.
        """
        n = self.n
        prior, p = ca.SX.sym("prior", n), ca.SX.sym("p", n * n)
        z, u, then = ca.SX.sym("z", n), ca.SX.sym("u", self.nu), ca.SX.sym("then", self.nu)
        y, has = ca.SX.sym("y", self.m), ca.SX.sym("has", self.m)
        (told, q), (told_then, q_then) = self._given(), self._given()
        c, error, variance = self.seen(z, u, q, y, has)
        # taken_in reads measured - expected alone
        mean, square = taken_in(
            (prior, ca.reshape(p, n, n)),
            z,
            (ca.SX.zeros(self.m), c),
            error,
            ca.vertsplit(variance),
            ca.vertsplit(has),
        )
        after, a, noise = self.moved(z, then, q_then)
        square = mirrored(ca.mtimes([a, square, a.T]) + noise)
        results = [after + ca.mtimes(a, mean - z), ca.densify(ca.vec(square))]
        return ca.Function(
            "arrive", [prior, p, z, u, then, y, has, *told, *told_then], results, {"cse": True}
        )


def _finite(columns: ca.MX) -> ca.MX:
    return ca.sum1(ca.fabs(ca.vec(columns))) <= LARGEST

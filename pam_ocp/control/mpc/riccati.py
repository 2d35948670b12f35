"""The quadratic program of shooting by an interior-point method, as CasADi Functions without heap.

Mehrotra's predictor-corrector method (S. Mehrotra, SIAM J. Optim. 2, 1992) on the stages' own
structure: each Newton step is a Riccati recursion backwards and a roll-out forwards (C. V. Rao,
S. J. Wright, J. B. Rawlings, J. Optim. Theory Appl. 99, 1998). All is written as Functions of one
stage, mapped over the horizon, so that Python, C code and FMUs run the same lines; the work of a
call is bounded by the number of iterations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from ...numerics.bounded_loop import inlined, repeated
from ...numerics.portable import portable
from .shooting import Side, TrackingProgram

ITERATIONS = 20
"""At most so many of the interior-point method in one quadratic program."""
GAP = 1e-12
"""Mean complementarity that ends it, scaled by nominals: leaves an error of about 1e-9, so that the
commands of two machines whose functions differ in the last bit differ by no more."""
CLOSED = 1e-8
"""Share of the defects that may be left when it ends."""
SHORT = 0.995
"""Share of the way to the nearest wall of the barrier that is gone."""
FIRST = 1.0
"""Complementarity at the start, where nothing is known of the multipliers."""
SMALLEST = 1e-14
"""A pivot of a factorisation, as a share of its diagonal, below which it is rounding."""
LARGEST = 1e30
"""A sum beyond it is no number."""
ROOM = 0.1
"""Least distance from a limit at the start, scaled by nominals."""


class _Packed:
    """Expressions packed into one column: only the entries that are not constants."""

    def __init__(self, parts: Mapping[str, ca.SX]) -> None:
        self._parts: dict[str, tuple[ca.Sparsity, list[float | None]]] = {}
        self.ends: dict[str, int] = {}
        """Of each part's entries in the column."""
        entries: list[ca.SX] = []
        for name, part in parts.items():
            values: list[float | None] = []
            for entry in ca.vertsplit(part.nz[:]) if part.nnz() else []:
                values.append(float(entry) if entry.is_constant() else None)
                if values[-1] is None:
                    entries.append(entry)
            self._parts[name] = (part.sparsity(), values)
            self.ends[name] = len(entries)
        self.column = ca.SX(ca.vertcat(*entries)) if entries else ca.SX(0, 1)
        self.size = len(entries)

    def __call__(self, column: ca.SX) -> dict[str, ca.SX]:
        """The expressions by name, made of a column's symbols."""
        found, at = {}, 0
        for name, (sparsity, values) in self._parts.items():
            part = ca.SX(sparsity, ca.SX.zeros(sparsity.nnz()))
            for i, value in enumerate(values):
                part.nz[i] = column[at] if value is None else value
                at += value is None
            found[name] = ca.sparsify(part)
        return found


class _Stage:
    """Functions of one node: its program written down, and what the method does with it.

    Unknowns are the change of states and inputs, dy = (dz, du), and the slack itself, of which
    limits and cost are linear and quadratic. Multipliers and distances are those of the sides.
    """

    def __init__(
        self, program: TrackingProgram, sides: Sequence[Side], bounds: ca.SX, last: bool
    ) -> None:
        p, node = program, program.last if last else program.inner
        self.last, self.ns = last, p.ns
        self.nz = p.nx if last else p.nx + len(p.rated)
        self.nu = 0 if last else p.nu
        self.full = p.nx + len(p.rated)
        """States of the recursion: those of the plant, and inputs before."""
        self.ny = self.nz + self.nu
        self.m = len(sides) + p.ns
        self.masked = any(s.given for s in sides) and not last
        self.count = self.m
        """Sides that say something, at nodes after the first."""
        self.first_count = self.m - sum(s.given for s in sides)
        y, _ = ca.vertsplit(node.y, [0, self.ny, self.ny + p.ns])
        zero = [node.y], [ca.vertcat(y, ca.SX.zeros(p.ns))]

        def at_zero(e: ca.SX) -> ca.SX:
            return ca.SX(ca.substitute([e], *zero)[0]) if p.ns else e

        damping, keep = ca.SX.sym("damping"), ca.SX.sym("keep")
        target = ca.SX.sym("target", 0 if last else self.full)
        value = ca.SX(ca.vertcat(*(e.sign * (e.value - bounds[e.bound]) for e in sides)))
        h, g = node.parts["hessian"], at_zero(node.parts["gradient"])
        following, to_next = node.parts["next"], node.parts["to_next"]
        soft = [e.soft for e in sides] + [True] * p.ns
        self.e = np.array(soft, dtype=float)
        self._given = np.array([e.given and not last for e in sides] + [False] * p.ns)
        self._hss = float(h[self.ny, self.ny]) if p.ns else 0.0
        self._lin = float(g[self.ny]) if p.ns else 0.0
        to_value = ca.jacobian(value, y) if sides else ca.SX(0, self.ny)
        self.packed = _Packed(
            {
                "a": to_next[:, : self.nz],
                "b": to_next[:, self.nz : self.ny],
                "defect": ca.densify(following) - target,
                "h": h[: self.ny, : self.ny],
                "g": ca.densify(g[: self.ny]),
                "c": ca.vertcat(to_value, ca.SX(p.ns, self.ny)),
                "d": ca.vertcat(ca.densify(value), ca.SX.zeros(p.ns)),
                "damping": damping,
                "keep": keep if self.masked else ca.SX(1.0),
            }
        )
        arguments = [y, target, p.reference, p.q, bounds, keep, damping]
        self.write = _function("write", arguments, [self.packed.column])
        self.size = self.packed.size
        self.motion = self.packed.ends["defect"]
        """Of the data, the first ones say how the node after follows: all that a roll-out needs."""
        self._symbols()
        self._functions()

    # ---- pieces ---------------------------------------------------------------------------------
    def _symbols(self) -> None:
        sizes = {"data": self.size, "y": self.ny, "s": self.ns, "t": self.m, "l": self.m}
        known = {n: ca.SX.sym(n, k) for n, k in sizes.items()}
        self.data, self.y, self.s, self.t, self.lam = self._here = list(known.values())
        # divisions are dear, and each sweep would do them again
        scales = ca.SX.sym("scales", 2 * self.m + 1)
        self._in = [*self._here, scales]
        self._inverse, self.w, self._share = ca.vertsplit(
            scales, [0, self.m, 2 * self.m, 2 * self.m + 1]
        )
        parts = self.packed(self.data)
        self.g, self.a, self.b = parts["g"], parts["a"], parts["b"]
        self.defect, self.c, self.d = parts["defect"], parts["c"], parts["d"]
        self.h = parts["h"] + parts["damping"] * ca.SX.eye(self.ny)
        keep = parts["keep"]
        self.keep = ca.SX(ca.vertcat(*(keep if e else ca.SX(1.0) for e in self._given)))
        if not self.m:
            self.keep = ca.SX(0, 1)
        self._soft = [i for i in range(self.m) if self.e[i]]
        # weights may differ by all digits: M - w_i is summed without w_i
        self._rest = _others([self.w[i] for i in self._soft], self._hss)
        exact = [self.lam[i] / self.t[i] for i in self._soft]
        total = sum(exact, ca.SX(self._hss))
        column = ca.vertcat(1 / self.t, self.lam / self.t, 1 / total if exact else 1.0)
        self.scale = _function("scale", [self.t, self.lam], [column])

    def _gap(self, y: ca.SX, s: ca.SX) -> ca.SX:
        slack = ca.SX(self.e) * s if self.ns else ca.SX.zeros(self.m)
        return ca.densify(self.c @ y) + slack

    @property
    def _miss(self) -> ca.SX:
        """Of the distances t from what they are to be."""
        return self.keep * (self._gap(self.y, self.s) + self.d - self.t)

    def _matrix(self) -> ca.SX:
        """The Hessian of dy with the barrier, the slack eliminated."""
        weight = ca.SX(self.m, self.m)
        for i in range(self.m):
            if not self.e[i]:
                weight[i, i] = self.w[i]
        for k, i in enumerate(self._soft):
            scaled = self.w[i] * self._share
            weight[i, i] = scaled * self._rest[k]
            for j in self._soft[:k]:
                weight[i, j] = weight[j, i] = -scaled * self.w[j]
        return ca.SX(self.h + self.c.T @ weight @ self.c)

    def _turned(self, force: ca.SX) -> ca.SX:
        """The forces of the sides on dy once the slack has given way: (I - W e e'/M) force."""
        turned = ca.SX(force)
        others = _others([force[i] for i in self._soft], 0.0)
        for k, i in enumerate(self._soft):
            turned[i] = (self._rest[k] * force[i] - self.w[i] * others[k]) * self._share
        return turned

    def _slack_step(self, force: ca.SX, dy: ca.SX, own: ca.SX | float) -> ca.SX:
        """Change of the slack with that of dy; ``own``: the gradient of its cost."""
        if not self.ns:
            return ca.SX(0, 1)
        pull = sum((force[i] for i in self._soft), ca.SX(0.0))
        carried = ca.dot(ca.SX(self.e) * self.w, self.c @ dy)
        return ca.SX(-(own - pull + carried) * self._share)

    @property
    def _own(self) -> ca.SX:
        return self._hss * self.s + self._lin if self.ns else ca.SX(0.0)

    # ---- Functions ------------------------------------------------------------------------------
    def _functions(self) -> None:
        """backward, again, forward, predict, correct; see RiccatiQp."""
        force = -self.w * self._miss  # of the multipliers that the predictor asks for
        pushed = self._turned(force)
        if self.ns:
            for i in self._soft:
                pushed[i] += self.w[i] * self._share * self._own
        gradient = self.h @ self.y + self.g - self.c.T @ pushed
        products, centre = ca.SX.sym("products", self.m), ca.SX.sym("centre")
        more = self.keep * (centre - products) * self._inverse
        change = -(self.c.T @ self._turned(more))
        share = ca.SX.sym("share")
        if self.last:
            matrix, gradient, change = (self._padded(e) for e in (self._matrix(), gradient, change))
            value = ca.densify(ca.vertcat(_lower(matrix), gradient))
            self.backward = _function("end", self._in, [value])
            again = [*self._in, products, centre]
            self.again = _function("end_again", again, [ca.densify(change)])
        else:
            self._recursions(gradient, change, share, products, centre)
        self._steps(force, more, products, centre)
        d = self._gap(self.y, self.s) + self.d
        least = ca.mmax(ca.vertcat(0.0, -self.keep * d)) if self.m else ca.SX(0.0)
        active = ca.sum1(self.keep * (self.lam > self.t)) if self.m else ca.SX(0.0)
        if self.ns:  # the slack's own side is not a limit
            active -= self.lam[-1] > self.t[-1]
        change = ca.bilin(self.packed(self.data)["h"], self.y, self.y)
        defect = ca.mmax(ca.vertcat(0.0, ca.fabs(self.defect)))
        seen = ca.vertcat(least, active, change, defect)
        self.look = _function("look", self._here, [seen])
        start = self._gap(ca.SX.zeros(self.ny), ca.SX.ones(self.ns) * ROOM) + self.d
        t = self.keep * ca.fmax(start, ROOM) + (1 - self.keep)
        self.begin = _function("begin", [self.data], [t, self.keep * FIRST / t])

    def _padded(self, part: ca.SX) -> ca.SX:
        size = self.full - self.nz
        if part.shape[1] == 1:
            return ca.SX(ca.vertcat(part, ca.SX.zeros(size)))
        return ca.SX(ca.diagcat(part, ca.SX(size, size)))

    def _recursions(
        self, gradient: ca.SX, change: ca.SX, share: ca.SX, products: ca.SX, centre: ca.SX
    ) -> None:
        nz, nu = self.nz, self.nu
        value = ca.SX.sym("value", nz * (nz + 1) // 2 + nz)
        cost = ca.tril2symm(_triangle(value[: -nz or None], nz))
        slope = value[value.numel() - nz :]
        matrix = self._matrix()
        ab = ca.horzcat(self.a, self.b)
        carried = cost @ ab
        whole = matrix + ab.T @ carried
        ahead = slope + cost @ (share * self.defect)
        pull = gradient + ab.T @ ahead
        root = _cholesky(whole[nz:, nz:])
        cross = ca.densify(whole[nz:, :nz])
        gain, constant = -_solved(root, cross), -_solved(root, pull[nz:])
        before = whole[:nz, :nz] + cross.T @ gain
        slope_before = pull[:nz] + gain.T @ pull[nz:]
        policy = ca.vertcat(ca.vec(gain), _lower(root), constant)
        self.backward = _function(
            "backward",
            [value, *self._in, share],
            [ca.vertcat(_lower(before), slope_before), policy],
        )
        known = ca.SX.sym("policy", policy.numel())
        sizes = np.cumsum([0, nu * nz, nu * (nu + 1) // 2, nu])
        k, r, _ = ca.vertsplit(known, sizes.tolist())
        gain, root = ca.reshape(k, nu, nz), _triangle(r, nu)
        slope = ca.SX.sym("slope", nz)
        pull = change + ab.T @ slope
        self.again = _function(
            "again",
            [slope, *self._in, known, products, centre],
            [pull[:nz] + gain.T @ pull[nz:], -_solved(root, pull[nz:])],
        )
        dz, constant = ca.SX.sym("dz", nz), ca.SX.sym("constant", nu)
        du = gain @ dz + constant
        after = self.a @ dz + self.b @ du + share * self.defect
        self.forward = _function(
            "forward",
            [dz, self.data[: self.motion], known, constant, share],
            [ca.densify(after), du],
        )

    def _steps(self, force: ca.SX, more: ca.SX, products: ca.SX, centre: ca.SX) -> None:
        """The changes of slack, distances and multipliers with that of dy, and how long they may
        be.
        """
        dy = ca.SX.sym("dy", self.ny)
        t, lam = self.t, self.lam

        def steps(total: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
            ds = self._slack_step(total, dy, self._own)
            dt = self.keep * self._gap(dy, ds) + self._miss
            # total = l + (r - l miss)/t  with r the complementarity asked for
            dl = total - lam - self.w * (dt - self._miss)
            ratios = ca.vertcat(-dt * self._inverse, -dl / (lam + (1 - self.keep)), 1.0)
            return ds, dt, dl, _largest(ratios)

        _, dt, dl, longest = steps(force)
        sums = ca.vertcat(longest, ca.dot(t, dl) + ca.dot(lam, dt), ca.dot(dt, dl))
        self.predict = _function("predict", [*self._in, dy], [dt * dl, sums])
        ds, dt, dl, longest = steps(force + more)
        size = sum((ca.sum1(ca.fabs(e)) for e in (dy, ds, dt, dl)), ca.SX(0.0))
        told = ca.vertcat(longest, size)
        self.correct = _function("correct", [*self._in, dy, products, centre], [ds, dt, dl, told])
        length, here = ca.SX.sym("length"), [self.y, self.s, t, lam]
        changes = [ca.SX.sym("d", e.numel()) for e in here]
        moved = [
            ca.if_else(length > 0, e + length * d, e) for e, d in zip(here, changes, strict=True)
        ]
        self.move = _function("move", [*here, *changes, length], moved)


class RiccatiQp:
    """The quadratic program of ``program`` at any point, solved by Functions alone.

    write : (y (ny, N), end, references, q, bounds, damping) -> data of inner nodes and of the last.
    solve : (data, most iterations) -> (dy, dy of the last node, facts): the share of the defects
    that is left, the complementarity, iterations, the largest miss of a limit, limits that hold,
    the largest slack, and how much the step changes (see QpStep).
    bounds : those of all sides, symbols of the expressions in ``sides``.
    """

    def __init__(
        self,
        program: TrackingProgram,
        bounds: ca.SX,
        sides: Sequence[Side],
        last: Sequence[Side],
        gap: float = GAP,
    ) -> None:
        """gap : mean complementarity that ends it."""
        self.gap = gap
        self.program, self.n = program, program.horizon
        self.inner = _Stage(program, sides, bounds, last=False)
        self.last = _Stage(program, last, bounds, last=True)
        n, i, e = self.n, self.inner, self.last
        self.sides = i.first_count + (n - 1) * i.count + e.count
        self._bounds = bounds.numel()
        self.write, self.solve = self._write(), self._solve()

    def _write(self) -> ca.Function:
        p, n, inner, last = self.program, self.n, self.inner, self.last
        y, end = ca.MX.sym("y", inner.ny, n), ca.MX.sym("end", last.ny)
        references = ca.MX.sym("references", len(p.penalties), n + 1)
        q, bounds = ca.MX.sym("q", p.q.numel()), ca.MX.sym("bounds", self._bounds)
        damping = ca.MX.sym("damping")
        rated = y[inner.nz :, n - 1][p.rated] if p.rated else ca.MX(0, 1)
        targets = ca.horzcat(y[: inner.nz, 1:], ca.vertcat(end, rated))
        keep = ca.DM.ones(1, n)
        keep[0] = 0
        # the C code of repeating a column without entries has a number where a pointer belongs
        shared, limits = ([3, 4, 6], bounds) if self._bounds else ([3, 6], ca.MX(0, n))
        written = inner.write.map("write_all", "serial", n, shared, [])(
            y, targets, references[:, :n], q, limits, keep, damping
        )
        at_end = last.write(end, ca.MX(0, 1), references[:, n], q, bounds, 1, 0)
        return ca.Function("written", [y, end, references, q, bounds, damping], [written, at_end])

    # ---- the method -----------------------------------------------------------------------------
    def _iterate(self) -> tuple[list[ca.MX], list[ca.MX]]:
        """Symbols of (iterate, data): dy, s, t, l of the inner nodes, the last of them first, and
        of the last node; the share of the defects left, the complementarity, the iterations done,
        and 1 where one was lost. Data: of the inner nodes, the last of them first; of their motion,
        the first of them first; of the last node.
        """
        n, i, e = self.n, self.inner, self.last
        sizes = [
            *((k, n) for k in (i.ny, i.ns, i.m, i.m)),
            *((k, 1) for k in (e.ny, e.ns, e.m, e.m)),
            (4, 1),
        ]
        iterate = [ca.MX.sym(f"i{k}", *size) for k, size in enumerate(sizes)]
        data = [ca.MX.sym("data", i.size, n), ca.MX.sym("motion", i.motion, n)]
        return iterate, [*data, ca.MX.sym("data_end", e.size)]

    def _iteration(self) -> ca.Function:
        """One iteration: (iterate, data) -> iterate."""
        n, i, e = self.n, self.inner, self.last
        iterate, (back, motion, data_end) = self._iterate()
        here, end, facts = [back, *iterate[:4]], [data_end, *iterate[4:8]], iterate[8]
        here.append(i.scale.map(n)(*iterate[2:4]))
        end.append(e.scale(*iterate[6:8]))
        share, mu = facts[0], facts[1]
        shares = ca.repmat(share, 1, n)
        _, policy = i.backward.mapaccum("sweep", n, 1)(e.backward(*end), *here, shares)
        forward = _backwards(policy)
        roll = i.forward.mapaccum("roll", n, 1)
        start = ca.MX.zeros(i.nz)

        def rolled(first: ca.MX, shares: ca.MX) -> tuple[ca.MX, ca.MX]:
            after, du = roll(start, motion, forward, first, shares)
            dz = ca.horzcat(start, after[:, : n - 1])
            return _backwards(ca.vertcat(dz, du)), after[: e.nz, n - 1]

        dy, dy_end = rolled(forward[policy.shape[0] - i.nu :, :], shares)
        products, sums = i.predict.map(n)(*here, dy)
        products_end, sums_end = e.predict(*end, dy_end)
        length = 1 / ca.fmax(ca.mmax(sums[0, :]), sums_end[0])
        totals = ca.sum2(sums[1:, :]) + sums_end[1:]
        affine = mu + (length * totals[0] + length**2 * totals[1]) / self.sides
        centre = mu * ca.fmax(ca.fmin(affine / mu, 1.0), 0.0) ** 3

        centres = ca.repmat(centre, 1, n)
        slope = e.again(*end, products_end, centre)
        _, change = i.again.mapaccum("sweep_again", n, 1)(slope, *here, policy, products, centres)
        more, more_end = rolled(_backwards(change), ca.MX.zeros(1, n))
        dy, dy_end = dy + more, dy_end + more_end
        *changes, told = i.correct.map(n)(*here, dy, products, centres)
        *changes_end, told_end = e.correct(*end, dy_end, products_end, centre)
        longest = ca.fmax(ca.mmax(told[0, :]), told_end[0])
        # an iteration that ends in no number is not taken, and is the last
        sound = ca.sum2(told[1, :]) + told_end[1] <= LARGEST
        length = ca.if_else(sound, ca.fmin(1.0, SHORT / longest), 0.0)
        lengths = ca.repmat(length, 1, n)
        moved = i.move.map(n)(*iterate[:4], dy, *changes, lengths)
        moved_end = e.move(*iterate[4:8], dy_end, *changes_end, length)
        left = (ca.dot(moved[2], moved[3]) + ca.dot(moved_end[2], moved_end[3])) / self.sides
        facts = ca.vertcat(share * (1 - length), left, facts[2] + 1, ca.logic_not(sound))
        given = [*iterate, back, motion, data_end]
        return ca.Function("iteration", given, [*moved, *moved_end, facts])

    def _solve(self) -> ca.Function:
        n, i, e = self.n, self.inner, self.last
        _, (data, _, data_end) = self._iterate()
        back, most = _backwards(data), ca.MX.sym("most")
        t, lam = i.begin.map(n)(back)
        t_end, l_end = e.begin(data_end)
        mu = (ca.dot(t, lam) + ca.dot(t_end, l_end)) / self.sides
        iterate = [
            ca.MX.zeros(i.ny, n),
            ca.MX.ones(i.ns, n) * ROOM,
            t,
            lam,
            ca.MX.zeros(e.ny),
            ca.MX.ones(e.ns) * ROOM,
            t_end,
            l_end,
            ca.vertcat(1.0, mu, ITERATIONS - most, 0.0),
        ]
        symbols, _ = self._iterate()
        told = symbols[-1]
        open_ = ca.logic_and(
            ca.logic_or(told[1] > self.gap, told[0] > CLOSED), ca.logic_not(told[3])
        )
        open_ = ca.logic_and(open_, told[2] < ITERATIONS)
        loop = repeated(self._iteration(), len(iterate), ITERATIONS, open_, symbols)
        found = inlined(loop, [*iterate, back, data[: i.motion, :], data_end])
        seen = i.look.map(n)(back, *found[:4])
        seen_end = e.look(data_end, *found[4:8])
        miss = ca.fmax(ca.mmax(seen[0, :]), seen_end[0])
        active = ca.sum2(seen[1, :]) + seen_end[1]
        slacks = ca.vertcat(ca.vec(found[1]), found[5])
        largest = ca.mmax(slacks) if i.ns else ca.MX(0.0)
        done = found[8][2] - (ITERATIONS - most)
        dy, errors = _backwards(found[0]), ca.fmax(ca.sum2(seen[2, :]) + seen_end[2], 0.0)
        first = ca.mmax(ca.fabs(dy[i.nz :, 0]))
        change = ca.fmax(ca.sqrt(errors / self.program.error_scale), first)
        change = ca.fmax(change, ca.mmax(seen[3, :]))
        told = ca.vertcat(found[8][:2], done, miss, active, largest, change)
        return ca.Function("qp", [data, data_end, most], [dy, found[4], told])


def _function(name: str, arguments: list[ca.SX], results: list[ca.SX]) -> ca.Function:
    return portable(ca.Function(name, arguments, results, {"cse": True}))


def _backwards(columns: ca.MX) -> ca.MX:
    """The last column first."""
    return columns[:, ::-1]


# ---- sums and small matrices --------------------------------------------------------------------
def _largest(column: ca.SX) -> ca.SX:
    """The largest entry, by pairs: a chain of comparisons would wait for each."""
    values = ca.vertsplit(column)
    while len(values) > 1:
        pairs = zip(values[::2], values[1::2], strict=False)
        values = [*(ca.fmax(a, b) for a, b in pairs), *values[len(values) & ~1 :]]
    return ca.SX(values[0])


def _others(values: Sequence[ca.SX], more: float) -> list[ca.SX]:
    """For each value the sum of all the others, and ``more``."""
    before, after = [ca.SX(more)], [ca.SX(0.0)]
    for value, last in zip(values, reversed(values), strict=True):
        before.append(before[-1] + value)
        after.append(after[-1] + last)
    return [before[k] + after[len(values) - 1 - k] for k in range(len(values))]


def _lower(matrix: ca.SX) -> ca.SX:
    """The lower triangle of a matrix, column by column."""
    size = matrix.shape[0]
    return ca.SX(ca.vertcat(*(matrix[i, j] for j in range(size) for i in range(j, size))))


def _triangle(column: ca.SX, size: int) -> ca.SX:
    """The lower triangular matrix that :func:`_lower` took apart."""
    found, at = ca.SX(size, size), 0
    for j in range(size):
        for i in range(j, size):
            found[i, j] = column[at]
            at += 1
    return found


def _cholesky(matrix: ca.SX) -> ca.SX:
    """The lower factor of a positive definite matrix; its diagonal holds the inverses.

    Where rounding has left nothing of a pivot its inverse is 0: that input is not moved.
    """
    size = matrix.shape[0]
    root = ca.SX(size, size)
    for j in range(size):
        pivot = matrix[j, j] - sum((root[j, k] ** 2 for k in range(j)), ca.SX(0.0))
        sound = pivot > SMALLEST * matrix[j, j]
        root[j, j] = ca.if_else(sound, 1 / ca.sqrt(ca.if_else(sound, pivot, 1.0)), 0.0)
        for i in range(j + 1, size):
            rest = matrix[i, j] - sum((root[i, k] * root[j, k] for k in range(j)), ca.SX(0.0))
            root[i, j] = rest * root[j, j]
    return root


def _solved(root: ca.SX, right: ca.SX) -> ca.SX:
    """(L L')^-1 right, with the factor of :func:`_cholesky`."""
    size = root.shape[0]
    rows: list[ca.SX] = []
    for i in range(size):
        known = sum((root[i, k] * rows[k] for k in range(i)), ca.SX.zeros(1, right.shape[1]))
        rows.append((right[i, :] - known) * root[i, i])
    for i in reversed(range(size)):
        known = sum(
            (root[k, i] * rows[k] for k in range(i + 1, size)), ca.SX.zeros(1, right.shape[1])
        )
        rows[i] = (rows[i] - known) * root[i, i]
    return ca.SX(ca.vertcat(*rows))

"""Multiple shooting for tracking: a plant's discrete step, and the quadratic programs of its SQP.

The step from one node to the next is integrated with the inputs held; states at the nodes are
unknowns of their own, and the step's defect is a constraint (Bock and Plitt, IFAC 1984). The cost
is a sum of squares, so its Hessian is the Gauss-Newton one. All unknowns are scaled by nominals.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.variables import Variable
from ...export.machine import quick
from ..kinds import Array
from ..step import Givens, Step

Index: TypeAlias = NDArray[np.intp]

UNBOUNDED = 1e6
"""Stands for infinity in scaled bounds: interior-point solvers for QPs want finite ones."""
CONVEXITY = 1e-9
"""Added to the Hessian's diagonal of inputs, so that untracked ones are determined."""


@dataclass(frozen=True)
class NodeLimit:
    """low <= variable <= high at the nodes [SI]; ``soft`` limits may give way at a price."""

    variable: Variable
    expression: ca.SX
    low: float
    high: float
    soft: bool


@dataclass(frozen=True)
class Penalty:
    """One squared residual: weight * ((variable - reference)/nominal)^2 / 2 at each node."""

    variable: Variable
    expression: ca.SX
    weight: float
    terminal: float


@dataclass(frozen=True)
class _Node:
    """Values and derivatives at one node, as a function of (y, reference, q), and where they are.

    The function gives one column; ``place[part]`` is the slice of a part in it. Derivatives are
    with respect to y; ``pattern[part]`` holds (rows, columns) of the stored entries of a matrix.
    ``parts`` are the expressions themselves, matrices sparse.
    """

    function: ca.Function
    values: ca.Function
    place: dict[str, slice]
    pattern: dict[str, tuple[Index, Index]]
    size: int
    y: ca.SX
    parts: dict[str, ca.SX]


class TrackingProgram:
    """The program: N intervals, and after each solution the next quadratic program.

    Unknowns at node k < N: scaled states x, inputs before v (those with a weight on their rate),
    inputs u, and one slack s >= 0 shared by the soft limits; at node N: x and its slack. Node 0's
    x and v are given. ``w`` holds the unknowns node after node; the given start stands behind them.
    """

    def __init__(
        self,
        given: Givens,
        step: Step,
        horizon: int,
        penalties: Sequence[Penalty],
        rate: Mapping[str, float],
        limits: Sequence[NodeLimit],
        price: tuple[float, float],
    ) -> None:
        self.given, self.step, self.horizon = given, step, horizon
        self.penalties, self.rate, self.limits, self.price = penalties, rate, limits, price
        plant = given.plant
        self.nx, self.nu = len(plant.states), len(given.controls)
        self.rated = [i for i, v in enumerate(given.controls) if v.name in rate]
        self.ns = int(any(limit.soft for limit in limits))
        weights = [*rate.values(), *(max(e.weight, e.terminal) for e in penalties)]
        self.error_scale = horizon * max(weights)
        """Of a sum of squared weighted errors over the horizon, to be a mean scaled by nominals of
        what weighs most."""
        self.x_nominal = plant.vector("state", attribute="nominal")
        self.u_nominal = np.array([v.nominal for v in given.controls])
        self._symbols()
        self.inner, self.last = self._inner_node(), self._last_node()
        self._lay_out()
        self._assemble()

    # ---- one node -------------------------------------------------------------------------------
    def _symbols(self) -> None:
        self.x, self.v = ca.SX.sym("x", self.nx), ca.SX.sym("v", len(self.rated))
        self.u, self.s = ca.SX.sym("u", self.nu), ca.SX.sym("s", self.ns)
        self.q = ca.SX.sym("q", len(self.given.names))
        self.reference = ca.SX.sym("r", len(self.penalties))
        plant = self.given.plant
        inputs, p, _ = self.given.parts(self.q, self.u * self.u_nominal)
        before, after = [plant.x, plant.u, plant.p], [self.x * self.x_nominal, inputs, p]
        own = {v.name: self.x[i] for i, v in enumerate(plant.states)}
        own |= {v.name: self.u[i] for i, v in enumerate(self.given.controls)}

        def scaled(item: NodeLimit | Penalty) -> ca.SX:
            variable = item.variable
            if variable.name in own:  # x / nominal * nominal would not become x again
                return own[variable.name]
            return ca.substitute([item.expression], before, after)[0] / variable.nominal

        self._tracked = [scaled(penalty) for penalty in self.penalties]
        self.limited = [scaled(limit) for limit in self.limits]

    def _rows(self, of_inputs: bool) -> tuple[list[ca.SX], list[float], list[float]]:
        """Rows (expression, low, high) of the limits that do or do not depend on the inputs."""
        rows, low, high = [], [], []
        for limit, value in zip(self.limits, self.limited, strict=True):
            if bool(ca.depends_on(value, self.u)) != of_inputs:
                continue
            bounds = (limit.low / limit.variable.nominal, limit.high / limit.variable.nominal)
            sides = [(value, *bounds)]
            if limit.soft:
                sides = [(value + self.s, bounds[0], np.inf), (value - self.s, -np.inf, bounds[1])]
            elif limit.variable.causality in ("state", "input"):
                continue  # a hard bound of the QP's variable, not a row
            for side, a, b in sides:
                if np.isfinite(a) or np.isfinite(b):
                    rows.append(side)
                    low.append(a)
                    high.append(b)
        return rows, low, high

    def _inner_node(self) -> _Node:
        early, late = self._rows(True), self._rows(False)
        self.early = len(early[0])
        self.row_low, self.row_high = np.array(early[1] + late[1]), np.array(early[2] + late[2])
        y = ca.vertcat(self.x, self.v, self.u, self.s)
        following, to_next = self.step.with_slopes(self.given, self.x, self.u, self.q, y)
        if self.rated:  # u[[]] of a scalar u is not empty
            rated = self.u[self.rated]
            following = ca.vertcat(following, rated)
            to_next = ca.vertcat(to_next, ca.jacobian(rated, y))
        errors = [
            np.sqrt(e.weight) * (z - self.reference[i] / e.variable.nominal)
            for i, (e, z) in enumerate(zip(self.penalties, self._tracked, strict=True))
            if e.weight > 0
        ]
        errors += [
            np.sqrt(self.rate[self.given.controls[i].name]) * (self.u[i] - self.v[j])
            for j, i in enumerate(self.rated)
        ]
        return self._node(y, (following, to_next), early[0] + late[0], errors)

    def _last_node(self) -> _Node:
        rows, low, high = self._rows(False)
        self.last_low, self.last_high = np.array(low), np.array(high)
        y = ca.vertcat(self.x, self.s)
        errors = [
            np.sqrt(e.terminal) * (z - self.reference[i] / e.variable.nominal)
            for i, (e, z) in enumerate(zip(self.penalties, self._tracked, strict=True))
            if e.terminal > 0 and not ca.depends_on(z, self.u)
        ]
        return self._node(y, (ca.SX(0, 1), ca.SX(0, y.numel())), rows, errors)

    def _node(
        self, y: ca.SX, step: tuple[ca.SX, ca.SX], rows: list[ca.SX], errors: list[ca.SX]
    ) -> _Node:
        """step : the node after, and its Jacobian over y."""
        following, to_next = step
        row, error = ca.SX(ca.vertcat(*rows)), ca.SX(ca.vertcat(*errors))
        linear, square = self.price
        slack = linear * ca.sum1(self.s) + square / 2 * ca.sumsqr(self.s)
        cost = ca.sumsqr(error) / 2 + slack
        to_row, to_error = (ca.jacobian(e, y) for e in (row, error))
        hessian = to_error.T @ to_error + ca.hessian(slack, y)[0]
        damping = ca.SX(y.numel(), 1)
        for i in range(self.nx + len(self.rated), y.numel() if following.numel() else 0):
            damping[i] = CONVEXITY
        hessian = hessian + ca.diag(ca.sparsify(damping))
        gradient = to_error.T @ error + ca.gradient(slack, y)
        matrices = {"to_next": to_next, "to_row": to_row, "hessian": hessian}
        vectors = {"next": following, "row": row, "gradient": gradient, "cost": cost}
        parts = {n: ca.densify(e) for n, e in vectors.items()}
        # of a single row e[:] is a row
        parts |= {n: ca.vec(e if e.is_dense() else e.nz[:]) for n, e in matrices.items()}
        place, begin = {}, 0
        for name, part in parts.items():
            place[name] = slice(begin, begin + part.numel())
            begin += part.numel()
        triplets = {n: e.sparsity().get_triplet() for n, e in matrices.items()}
        pattern = {
            n: (np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp))
            for n, (rows, columns) in triplets.items()
        }
        arguments = [y, self.reference, self.q]
        column = ca.cse(ca.vertcat(*parts.values()))
        values = ca.vertcat(*(parts[n] for n in ("next", "row", "cost")))
        return _Node(
            ca.Function("node", arguments, [column]),
            ca.Function("values", arguments, [values]),
            place,
            pattern,
            begin,
            y,
            vectors | matrices,
        )

    # ---- where everything is ------------------------------------------------------------------
    def _lay_out(self) -> None:
        """Positions of each node's unknowns in w, and of each node's rows."""
        n, nv = self.horizon, len(self.rated)
        states, inputs = self.nx + nv, self.nu + self.ns
        self.y_size = states + inputs
        sizes_x = [0] + [states] * (n - 1) + [self.nx + self.ns]
        sizes_u = [inputs] * (n - 1) + [inputs + self.ns]
        sizes = [a + b for a, b in zip(sizes_x, [*sizes_u, 0], strict=True)]
        begins = np.concatenate([[0], np.cumsum(sizes)])
        self.size = int(begins[-1])
        self.at = np.empty((self.y_size, n), dtype=np.intp)
        """Position in (w, start) of each node's y; node 0's states stand behind w."""
        self.at[:, 0] = [*range(self.size, self.size + states), *range(inputs)]
        for k in range(1, n):
            self.at[:, k] = range(begins[k], begins[k] + self.y_size)
        self.at_last = np.arange(begins[n], begins[n] + self.nx + self.ns)
        self.carried = int(begins[n] - 1) if self.ns else -1
        """The slack of the last node is chosen as an extra input one node before."""
        rows = [self.early] + [len(self.row_low)] * (n - 1) + [len(self.last_low)]
        self.dimensions = {"N": n, "nx": sizes_x, "nu": [*sizes_u, 0], "ng": rows}
        self._bound_variables()

    def _bound_variables(self) -> None:
        """Hard bounds of inputs and states, and slacks >= 0."""
        low, high = np.full(self.y_size, -UNBOUNDED), np.full(self.y_size, UNBOUNDED)
        names = [v.name for v in self.given.plant.states] + [""] * len(self.rated)
        names += [v.name for v in self.given.controls]
        for limit in self.limits:
            if limit.variable.name in names and not limit.soft:
                i, nominal = names.index(limit.variable.name), limit.variable.nominal
                low[i], high[i] = limit.low / nominal, limit.high / nominal
        low[self.y_size - self.ns :] = 0.0
        start = self.nx + len(self.rated)
        bounds = []
        for side, slack in ((low, 0.0), (high, UNBOUNDED)):
            w = np.full(self.size + start, slack)  # the extra slacks of the last node remain
            w[self.at] = side[:, None]
            w[self.at_last[: self.nx]] = side[: self.nx]
            bounds.append(np.clip(w[: self.size], -UNBOUNDED, UNBOUNDED))
        self.w_low, self.w_high = bounds

    def _assemble(self) -> None:
        """Where the entries of the QP's matrices and vectors are found in the nodes' results.

        Results are those of all inner nodes, of the last node, and the constants 1, -1 and 0.
        """
        n = self.horizon
        self._one = self.inner.size * n + self.last.size
        self.gradient_at = np.full(self.size, self._one + 2, dtype=np.intp)
        hessian: list[tuple[Any, Any, Any]] = []
        blocks = []
        for k in range(n + 1):
            node, at = (self.inner, self.at[:, k]) if k < n else (self.last, self.at_last)
            source = np.arange(node.size) + self.inner.size * k
            unknown = at < self.size
            self.gradient_at[at[unknown]] = source[node.place["gradient"]][unknown]
            i, j = node.pattern["hessian"]
            keep = unknown[i] & unknown[j]
            hessian.append((at[i][keep], at[j][keep], source[node.place["hessian"]][keep]))
            if k < n:
                blocks.append(self._defect_rows(k, source, at))
            blocks.append(self._limit_rows(k, node, source, at))
        begins = np.cumsum([0] + [len(b.low) for b in blocks])
        entries = [
            (begin + i, j, source)
            for begin, b in zip(begins, blocks, strict=False)
            for i, j, source in b.entries
        ]
        rows = int(begins[-1])
        self.a_sparsity, self.a_at, self.a_rows, self.a_columns = _sorted(entries, rows, self.size)
        self.h_sparsity, self.h_at, *self.h_entries = _sorted(hessian, self.size, self.size)
        """Of the Hessian: pattern, sources, and [rows, columns] of its entries."""
        self.value_at = np.concatenate([b.value for b in blocks])
        self.other_at = np.concatenate([b.other for b in blocks])
        low, high = (np.concatenate([getattr(b, e) for b in blocks]) for e in ("low", "high"))
        self.a_low, self.a_high = (np.clip(b, -UNBOUNDED, UNBOUNDED) for b in (low, high))

    @property
    def first_inputs(self) -> Index:
        """Where in ``w`` the inputs at the first node stand."""
        begin = self.nx + len(self.rated)
        return self.at[begin : begin + self.nu, 0]

    @property
    def slacks(self) -> Index:
        """Where in ``w`` all slacks stand."""
        extra = [self.carried] * self.ns
        inner, end = self.at[self.y_size - self.ns :].ravel(), self.at_last[self.nx :]
        return np.concatenate([inner, end, np.array(extra, dtype=np.intp)])

    def _defect_rows(self, k: int, source: Index, at: Index) -> _Rows:
        """next(y_k) - y_(k+1) = 0; the last node's slack is the extra input before it."""
        end = k + 1 == self.horizon
        target = self.at_last if end else self.at[: self.nx + len(self.rated), k + 1]
        count = self.nx if end else len(target)
        i, j = self.inner.pattern["to_next"]
        keep = (at[j] < self.size) & (i < count)
        entries: list[tuple[Any, Any, Any]] = [
            (i[keep], at[j][keep], source[self.inner.place["to_next"]][keep]),
            (np.arange(len(target)), target, np.full(len(target), self._one + 1)),
        ]
        if end and self.ns:
            entries.append((np.array([self.nx]), np.array([self.carried]), np.array([self._one])))
        extra = len(target) - count
        value = np.append(source[self.inner.place["next"]][:count], np.full(extra, self._one + 2))
        # that slack equals its input from the first guess on: its row needs no defect
        other = np.append(target[:count], np.full(extra, self._nothing))
        zero = np.zeros(len(target))
        return _Rows(entries, value.astype(np.intp), other.astype(np.intp), zero, zero)

    def _limit_rows(self, k: int, node: _Node, source: Index, at: Index) -> _Rows:
        """low <= row(y_k) <= high; at node 0, whose state is given, only those of the inputs."""
        count = self.early if k == 0 else node.place["row"].stop - node.place["row"].start
        i, j = node.pattern["to_row"]
        keep = (at[j] < self.size) & (i < count)
        entries = [(i[keep], at[j][keep], source[node.place["to_row"]][keep])]
        last = k == self.horizon
        low, high = (self.last_low, self.last_high) if last else (self.row_low, self.row_high)
        other = np.full(count, self._nothing, dtype=np.intp)
        return _Rows(entries, source[node.place["row"]][:count], other, low[:count], high[:count])

    @property
    def _nothing(self) -> int:
        """Position of the zero that stands behind w and the start."""
        return self.size + self.nx + len(self.rated)


@dataclass(frozen=True)
class _Rows:
    """Some rows of the QP: entries of its matrix as (rows, columns, sources), value - other,
    bounds.
    """

    entries: list[tuple[Any, Any, Any]]
    value: Index
    other: Index
    low: Array
    high: Array


def _sorted(
    parts: list[tuple[Any, Any, Any]], rows: int, columns: int
) -> tuple[ca.Sparsity, Index, Index, Index]:
    """(sparsity, source, row, column) of entries given as (rows, columns, sources), in CasADi's
    order.
    """
    row, column, source = (np.concatenate([p[i] for p in parts]).astype(np.intp) for i in range(3))
    order = np.lexsort((row, column))
    row, column, source = row[order], column[order], source[order]
    begins = np.searchsorted(column, np.arange(columns + 1))
    return ca.Sparsity(rows, columns, begins.tolist(), row.tolist()), source, row, column


class TrackingPoint:
    """The program evaluated at one point: all that the next quadratic program needs.

    Works on fixed memory: a call takes w, the given start, references and q, and leaves the entries
    of the constraints' matrix ``a`` and of the Hessian ``h``, the ``gradient``, the bounds of the
    rows and of the variables, ready to be handed to a QP solver.
    """

    def __init__(self, program: TrackingProgram, compiled: bool | None = False) -> None:
        """compiled : the nodes' functions as machine code (None: where it is there)."""
        self.program = p = program
        n, inner, last = p.horizon, p.inner, p.last
        self.unknowns = np.zeros(p.size + p.nx + len(p.rated) + 1)
        self.w = self.unknowns[: p.size]
        self.start = self.unknowns[p.size : -1]
        self._y, self._y_last = np.zeros((n, p.y_size)), np.zeros(len(p.at_last))
        self.references = np.zeros((n + 1, len(p.penalties)))
        self._q = np.zeros((n + 1, len(p.given.names)))
        self._results = np.concatenate([np.zeros(inner.size * n + last.size), [1.0, -1.0, 0.0]])
        self._calls = []
        split = inner.size * n
        for function, y, k, out in (
            (quick(inner.function, compiled).map(n), self._y, slice(0, n), self._results[:split]),
            (last.function, self._y_last, slice(n, n + 1), self._results[split:-3]),
        ):
            buffer, call = function.buffer()
            for i, argument in enumerate((y, self.references[k], self._q[k])):
                buffer.set_arg(i, memoryview(argument))  # type: ignore
            buffer.set_res(0, memoryview(out))  # type: ignore
            self._calls.append((buffer, call))
        self._at = np.ascontiguousarray(p.at.T)
        self.a, self.h = np.zeros(len(p.a_at)), np.zeros(len(p.h_at))
        self.gradient = np.zeros(p.size)
        self.a_low, self.a_high = np.zeros(len(p.a_low)), np.zeros(len(p.a_high))
        self.w_low, self.w_high = np.zeros(p.size), np.zeros(p.size)
        self._value, self._other = np.zeros(len(p.a_low)), np.zeros(len(p.a_low))

    def set_given(self, q: Array) -> None:
        """Parameters, disturbances and offsets [SI] for all nodes."""
        self._q[:] = q

    @property
    def given(self) -> Array:
        """What :meth:`set_given` set."""
        first: Array = self._q[0]
        return first

    def __call__(self) -> None:
        """Evaluate at ``unknowns`` and ``references``."""
        p = self.program
        np.take(self.unknowns, self._at, out=self._y)
        np.take(self.unknowns, p.at_last, out=self._y_last)
        for _, call in self._calls:
            call()
        np.take(self._results, p.a_at, out=self.a)
        np.take(self._results, p.h_at, out=self.h)
        np.take(self._results, p.gradient_at, out=self.gradient)
        np.take(self._results, p.value_at, out=self._value)
        np.take(self.unknowns, p.other_at, out=self._other)
        self._value -= self._other
        np.subtract(p.a_low, self._value, out=self.a_low)
        np.subtract(p.a_high, self._value, out=self.a_high)
        np.subtract(p.w_low, self.w, out=self.w_low)
        np.subtract(p.w_high, self.w, out=self.w_high)


# ---- limits, one side at a time, as the Riccati interior point takes them ----------------------
@dataclass(frozen=True)
class Bound:
    """A finite end of a limit, as a number that may change [SI]."""

    limit: NodeLimit
    high: bool
    place: int
    """Of the limit among those of the program."""

    @property
    def value(self) -> float:
        return self.limit.high if self.high else self.limit.low


@dataclass(frozen=True)
class Side:
    """One side of a limit of a node: sign (value - bound) + slack >= 0, scaled.

    soft : the node's slack stands in it. given : it says nothing at node 0, whose state is given.
    """

    value: ca.SX
    sign: float
    bound: int
    """Place of its bound among all bounds."""
    soft: bool
    given: bool


def bounds_of(program: TrackingProgram) -> tuple[Bound, ...]:
    """All finite ends of the program's limits."""
    found = []
    for place, limit in enumerate(program.limits):
        if math.isfinite(limit.low):
            found.append(Bound(limit, False, place))
        if math.isfinite(limit.high):
            found.append(Bound(limit, True, place))
    return tuple(found)


def sides_of(program: TrackingProgram, bounds: Sequence[Bound]) -> tuple[list[Side], list[Side]]:
    """The sides of these bounds at an inner node, and at the last one, which has no inputs."""
    found = []
    for k, bound in enumerate(bounds):
        value = program.limited[bound.place]
        sign = -1.0 if bound.high else 1.0
        given = not ca.depends_on(value, program.u)
        found.append(Side(value, sign, k, bound.limit.soft, given))
    return found, [s for s in found if not ca.depends_on(s.value, program.u)]

"""Exact derivatives of a program, put together from those of its stages.

CasADi would find the sparse Jacobian and Hessian of the whole program by colouring: a dozen or more
sweeps over all intervals. Here each stage function is differentiated once, as a small expression of
its own unknowns, evaluated over the intervals, and its entries are added where they belong.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TypeAlias, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..problem.problem import Problem
from .solution import Places
from .stage import Stage
from .transcription import Program, with_design

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.intp]
Matrix = TypeVar("Matrix", ca.SX, ca.MX)


PER_UNKNOWN, UNCOUNTED = 4e-6, 1.2e-5
"""Processor seconds of an iteration for each unknown: of the linear algebra, and of all where the
derivatives' operations are not counted.
"""
PER_OPERATION = {"rows": 1.7e-8, "curvature": 7.7e-9}
"""The same for each operation. Measured on 46 solves of 14 random tasks (2 to 8 states, 100 to
40 000 unknowns): right to a factor of 1.4 in nine of ten."""


def derivatives(program: Program) -> dict[str, ca.Function]:
    """{"grad_f", "jac_g", "hess_lag"}: functions for CasADi's interface to IPOPT.

    Empty for programs with profiles, which are tables that no stage can hold: CasADi differentiates
    those.
    """
    if program.problem.profiles:
        return {}
    n, parameters = program.nlp["x"].numel(), program.nlp["p"].numel()
    w, p = ca.MX.sym("w", n), ca.MX.sym("p", parameters)
    blocks = stage_blocks(program)
    other = ca.Function("other", [program.nlp["x"], program.nlp["p"]], list(program.other.values()))
    f, g = other(w, p)
    return {
        "grad_f": _gradient(program, blocks, (w, p, f)),
        "jac_g": _jacobian(program, blocks, (w, p, g)),
        "hess_lag": _hessian(program, blocks, (w, p, f, g)),
    }


@dataclass(frozen=True)
class _Local:
    """A stage's values as functions of its own unknowns.

    y = (start, states, inputs, auxiliaries, durations, design, peaks);
    given = (y, lengths, starts, p, q), where
    lengths and starts weigh the durations in the interval's length and start; rows: of defects,
    path, budgets.
    """

    given: list[ca.SX]
    rows: ca.SX
    cost: ca.SX
    functions: dict[str, ca.Function] = field(default_factory=dict)
    """Those that were made: all meshes share them."""

    @cached_property
    def slopes(self) -> ca.SX:
        """Of the rows."""
        return ca.jacobian(self.rows, self.given[0])

    @cached_property
    def curvature(self) -> tuple[ca.SX, ca.SX, ca.SX]:
        """(factor of the cost, multipliers of the rows, upper half of the Lagrangian's Hessian)."""
        factor, multipliers = ca.SX.sym("lam_f"), ca.SX.sym("lam", self.rows.numel())
        lagrangian = factor * self.cost + ca.dot(multipliers, self.rows)
        return factor, multipliers, ca.triu(ca.hessian(lagrangian, self.given[0])[0])

    @classmethod
    def of(cls, stage: Stage) -> _Local:
        problem, form, d = stage.problem, stage.form, stage.degree
        nx, nu = len(problem.plant.states), len(problem.plant.inputs)
        sizes = {
            "start": nx,
            "states": nx * len(form.state_taus(d)),
            "inputs": nu * len(form.input_taus(d)),
            "auxiliaries": len(problem.auxiliaries) * form.cost_points(d),
            "durations": len(problem.legs),
            "design": len(problem.design),
            "peaks": problem.m.numel(),
        }
        parts = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
        lengths, starts = (ca.SX.sym(name, len(problem.legs)) for name in ("lengths", "starts"))
        p = ca.SX.sym("p", len(problem.plant.parameters))
        q = ca.SX.sym("q", problem.q.numel())
        h, t = (ca.dot(weights, parts["durations"]) for weights in (lengths, starts))
        defects, path, cost, budgets = stage.function(
            parts["start"],
            parts["states"],
            parts["inputs"],
            h,
            t,
            with_design(problem, p, parts["design"]),
            ca.SX(0, 1),
            q,
            parts["peaks"],
            parts["auxiliaries"],
        )
        y = ca.vertcat(*parts.values())
        return cls([y, lengths, starts, p, q], ca.veccat(defects, path, budgets), cost)

    def function(self, name: str, value: ca.SX, more: list[ca.SX]) -> ca.Function:
        """(given, more) -> the stored entries of ``value``, as one column."""
        if name not in self.functions:
            self.functions[name] = ca.Function(name, [*self.given, *more], [stored(value)])
        return self.functions[name]


_local = lru_cache(maxsize=32)(_Local.of)


@dataclass(frozen=True)
class Block:
    """A stage over its intervals: a column each of unknowns, rows and weights of durations."""

    local: _Local
    unknowns: Index
    rows: Index
    weights: tuple[Array, Array]

    def over(self, name: str, value: ca.SX, more: list[ca.SX], given: list[ca.MX]) -> ca.MX:
        """The stored entries of ``value`` of all intervals, as one column."""
        function = self.local.function(name, value, more)
        return ca.vec(function.map(self.unknowns.shape[1])(*given))

    def given(self, problem: Problem, w: ca.MX, p: ca.MX) -> list[ca.MX]:
        """Arguments at the program's unknowns and parameters."""
        plain = len(problem.plant.parameters)
        lengths, starts = (ca.MX(ca.DM(weights)) for weights in self.weights)
        return [_gathered(w, self.unknowns), lengths, starts, p[:plain], p[plain:]]


def stored(matrix: Matrix) -> Matrix:
    """The stored entries as one dense column, also those of a matrix that is one row."""
    return ca.densify(ca.vec(matrix.nz[:])) if matrix.nnz() else type(matrix)(0, 1)


def entries_of(sparsity: ca.Sparsity) -> tuple[Index, Index]:
    """(rows, columns) of these."""
    rows, columns = sparsity.get_triplet()
    return np.array(rows, dtype=np.intp), np.array(columns, dtype=np.intp)


def _gathered(vector: ca.MX, at: Index) -> ca.MX:
    return ca.reshape(vector[at.T.ravel().tolist()], *at.shape)


def stage_blocks(program: Program) -> list[Block]:
    """Where the unknowns and rows of each group's intervals stand in the program."""
    problem, mesh = program.problem, program.mesh
    places = Places.of(problem, mesh)
    every, common = np.arange(places.count), np.arange(places.begins[-1], places.count)
    budgets = program.nlp["g"].numel() - len(problem.budgets) + np.arange(len(problem.budgets))
    lengths, starts = mesh.clock(problem.time_nominals)
    found = []
    for group in program.groups:
        unknowns, rows, n = [], [], len(group.members)
        size = len(group.stage.conditions())
        for j, k in enumerate(group.members):
            own = every[places.begins[k] : places.begins[k + 1]]
            unknowns.append(np.concatenate([every[places.begin(k)], own, common]))
            defects = group.first_row + group.rows * j + np.arange(group.rows)
            path = group.first_row + group.rows * n + size * j + np.arange(size)
            rows.append(np.concatenate([defects, path, budgets]))
        members = list(group.members)
        weights = lengths[members].T, starts[members].T
        found.append(Block(_local(group.stage), np.array(unknowns).T, np.array(rows).T, weights))
    return found


def iteration_cost(program: Program) -> float:
    """Processor seconds of an iteration on a common machine, from the size of the program and the
    operations of its derivatives (once these are made): the same wherever it is asked.
    """
    unknowns, counted = program.nlp["x"].numel(), 0.0
    for group in program.groups:
        made = {} if program.problem.profiles else _local(group.stage).functions
        if not made:
            return UNCOUNTED * unknowns
        known = [(cost, made[n]) for n, cost in PER_OPERATION.items() if n in made]
        each = sum(cost * function.n_instructions() for cost, function in known)
        counted += len(group.members) * each
    return PER_UNKNOWN * unknowns + counted


@dataclass
class _Entries:
    """Entries of a matrix from several places; those at one place are added."""

    shape: tuple[int, int]
    values: list[ca.MX]
    rows: list[Index]
    columns: list[Index]

    def add(self, values: ca.MX, rows: Index, columns: Index) -> None:
        self.values.append(values)
        self.rows.append(rows)
        self.columns.append(columns)

    def add_matrix(self, matrix: ca.MX, first_row: int = 0) -> None:
        rows, columns = entries_of(matrix.sparsity())
        if len(rows):
            self.add(ca.vec(matrix.nz[:]), rows + first_row, columns)

    def matrix(self) -> ca.MX:
        """The sum."""
        if not self.values:
            return ca.MX(*self.shape)
        rows, columns = np.concatenate(self.rows), np.concatenate(self.columns)
        every = columns * self.shape[0] + rows
        count, order = len(every), np.argsort(every, kind="stable")
        first = np.diff(every[order], prepend=-1) > 0  # of the entries at one place
        places, at = every[order][first], np.empty(count, dtype=np.intp)
        at[order] = np.cumsum(first) - 1
        size = len(places)
        pattern = ca.Sparsity.triplet(
            *self.shape, (places % self.shape[0]).tolist(), (places // self.shape[0]).tolist()
        )
        values = ca.vertcat(*self.values)
        if size == count:
            return ca.MX(pattern, values[order.tolist()])
        adding = ca.DM.triplet(at.tolist(), list(range(count)), ca.DM.ones(count), size, count)
        return ca.MX(pattern, adding @ values)


def _gradient(program: Program, blocks: list[Block], at: tuple[ca.MX, ca.MX, ca.MX]) -> ca.Function:
    """(w, p) -> (f, gradient)."""
    w, p, other = at
    total, entries = other, _Entries((w.numel(), 1), [], [], [])
    for block in blocks:
        local = block.local
        if local.cost.is_zero():
            continue
        given = block.given(program.problem, w, p)
        gradient = ca.densify(ca.gradient(local.cost, local.given[0]))
        both = block.over("cost", ca.vertcat(local.cost, gradient), [], given)
        both = ca.reshape(both, 1 + gradient.numel(), block.unknowns.shape[1])
        total += ca.sum2(both[0, :])
        places = block.unknowns.T.ravel()
        entries.add(ca.vec(both[1:, :]), places, np.zeros_like(places))
    entries.add_matrix(ca.gradient(other, w))
    return ca.Function(
        "nlp_grad_f", [w, p], [total, ca.densify(entries.matrix())], ["x", "p"], ["f", "grad_f_x"]
    )


def _jacobian(program: Program, blocks: list[Block], at: tuple[ca.MX, ca.MX, ca.MX]) -> ca.Function:
    """(w, p) -> (g, Jacobian)."""
    w, p, other = at
    size = program.nlp["g"].numel()
    values, entries = _Entries((size, 1), [], [], []), _Entries((size, w.numel()), [], [], [])
    for block in blocks:
        local, given = block.local, block.given(program.problem, w, p)
        jacobian = local.slopes
        n, rows = block.unknowns.shape[1], local.rows.numel()
        known = ca.densify(ca.vertcat(local.rows, stored(jacobian)))
        both = block.over("rows", known, [], given)
        both = ca.reshape(both, rows + jacobian.nnz(), n)
        i, j = entries_of(jacobian.sparsity())
        values.add(ca.vec(both[:rows, :]), block.rows.T.ravel(), np.zeros(rows * n, dtype=np.intp))
        entries.add(ca.vec(both[rows:, :]), block.rows[i].T.ravel(), block.unknowns[j].T.ravel())
    first = size - len(program.problem.budgets) - other.numel()
    values.add_matrix(ca.densify(other), first)
    entries.add_matrix(ca.jacobian(other, w), first)
    g = ca.densify(values.matrix())
    return ca.Function("nlp_jac_g", [w, p], [g, entries.matrix()], ["x", "p"], ["g", "jac_g_x"])


def _hessian(
    program: Program, blocks: list[Block], at: tuple[ca.MX, ca.MX, ca.MX, ca.MX]
) -> ca.Function:
    """(w, p, lam_f, lam_g) -> upper triangle of the Hessian of the Lagrangian."""
    w, p, f, g = at
    size = program.nlp["g"].numel()
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", size)
    entries = _Entries((w.numel(), w.numel()), [], [], [])
    for block in blocks:
        local, given = block.local, block.given(program.problem, w, p)
        factor, multipliers, hessian = local.curvature
        i, j = (block.unknowns[e].T.ravel() for e in entries_of(hessian.sparsity()))
        found = block.over(
            "curvature",
            hessian,
            [factor, multipliers],
            [*given, lam_f, _gathered(lam_g, block.rows)],
        )
        if found.numel():
            entries.add(found, np.minimum(i, j), np.maximum(i, j))
    first = size - len(program.problem.budgets) - g.numel()
    rest = lam_f * f + ca.dot(lam_g[first : first + g.numel()], g)
    entries.add_matrix(ca.triu(ca.hessian(rest, w)[0]))
    names = ["x", "p", "lam_f", "lam_g"]
    return ca.Function(
        "nlp_hess_l", [w, p, lam_f, lam_g], [entries.matrix()], names, ["triu_hess_gamma_x_x"]
    )

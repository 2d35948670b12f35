"""How a program is stated in the order of its stages; see staged.py for what that means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .stage import nominals
from .transcription import Program, sampled, with_design

__all__ = ["NONE", "Staged", "stage_ordered"]

Array: TypeAlias = NDArray[np.float64]
Index: TypeAlias = NDArray[np.intp]

NONE = -1
"""In place of an index: nothing of the program corresponds."""


@dataclass(frozen=True)
class Staged:
    """The stage-ordered form of a program.

    sizes : "N", and "nx", "nu", "ng" of each stage, under the names of CasADi's options.
    unknown : (z,) which unknown of the program each entry is.
    row : (g,) which constraint of the program each row is; sign : (g,) by which factor.
    spent, before : (k, 2) pairs (entry of z, its gap's row): budgets spent, inputs before.
    """

    program: Program
    nlp: dict[str, ca.MX]
    sizes: dict[str, Any]
    unknown: Index
    row: Index
    sign: Array
    spent: Index
    before: Index

    @cached_property
    def _constraints(self) -> ca.Function:
        return ca.Function("g", [self.nlp["x"], self.nlp["p"]], [self.nlp["g"]])

    @cached_property
    def first(self) -> Index:
        """Where each unknown of the program stands first in z."""
        values, at = np.unique(self.unknown, return_index=True)
        return np.asarray(at[values != NONE], dtype=np.intp)

    @cached_property
    def _held(self) -> Index:
        """Where each constraint of the program stands among the rows here."""
        values, at = np.unique(self.row, return_index=True)
        return np.asarray(at[values != NONE], dtype=np.intp)

    def bounds(self, program: Program) -> tuple[Array, Array]:
        """(low, high) of z: each unknown is bounded once, where it stands first."""
        both = []
        for limit, open_end in zip(program.bounds(), (-np.inf, np.inf), strict=True):
            z = np.full(len(self.unknown), open_end)
            z[self.first] = limit
            both.append(z)
        return both[0], both[1]

    def limits(self, program: Program) -> tuple[Array, Array]:
        """(low, high) of the rows."""
        both = []
        for limit in program.limits():
            g = np.zeros(len(self.row))
            g[self._held] = limit[self.row[self._held]]
            both.append(g)
        return both[0], both[1]

    def lifted(self, w: Array, parameters: Array) -> Array:
        """z of the program's unknowns: with it all gaps of what is carried are closed."""
        z = np.where(self.unknown == NONE, 0.0, w[self.unknown])
        if len(self.spent) or len(self.before):
            gaps = np.asarray(self._constraints(z, parameters), float).ravel()
            z[self.before[:, 0]] = -gaps[self.before[:, 1]]
            budgets = len(self.program.problem.budgets)
            each = -gaps[self.spent[:, 1]].reshape(-1, budgets) if budgets else np.zeros((0, 0))
            z[self.spent[:, 0]] = np.cumsum(each, axis=0).ravel()
        return z

    def lowered(self, z: Array) -> Array:
        """The program's unknowns."""
        return z[self.first]

    def lowered_multipliers(self, g: Array, x: Array) -> tuple[Array, Array]:
        """The program's (lam_g, lam_x) from those of rows and bounds.

        Where the gaps of what is carried are closed, z is a function of the program's unknowns and
        drops out of the Lagrangian: the other multipliers are the program's own.
        """
        return self.sign[self._held] * g[self._held], x[self.first]


def stage_ordered(program: Program) -> Staged:
    """State a program's stage-ordered form, from the same stage functions."""
    return _Builder(program).build()


@dataclass
class _Symbols:
    """One stage: parts of its state, then of its controls, and which unknowns of the program they
    are.
    """

    x: ca.MX
    before: ca.MX
    spent: ca.MX
    durations: ca.MX
    design: ca.MX
    peaks: ca.MX
    start: ca.MX
    states: ca.MX
    inputs: ca.MX
    auxiliaries: ca.MX


@dataclass
class _Rows:
    """Constraints of one stage and where the program has them."""

    values: list[ca.MX] = field(default_factory=list)
    row: list[Index] = field(default_factory=list)

    def add(self, value: ca.MX, row: Index) -> None:
        self.values.append(ca.vec(value))
        self.row.append(row)


class _Builder:
    """States stage after stage of a program."""

    def __init__(self, program: Program) -> None:
        self.program, self.problem, self.mesh = program, program.problem, program.mesh
        problem, mesh = self.problem, self.mesh
        self.nx, self.nu = len(problem.plant.states), len(problem.plant.inputs)
        self.legs, self.count = len(problem.legs), len(mesh.intervals)
        self.shooting = mesh.form.scheme == "shooting"
        self.p = ca.MX.sym("p", len(problem.plant.parameters))
        self.q = ca.MX.sym("q", problem.q.numel())
        self.carries_input = self._carries_input()
        self.lengths, self.starts = mesh.clock(problem.time_nominals)
        self.profiles = [profile.function() for profile in problem.profiles]
        self._lay_out()
        self.rows = [_Rows() for _ in range(self.count + 1)]
        self.cost = ca.MX(0)

    def _continuous(self) -> bool:
        control = self.mesh.form.control
        return self.count > 1 and (
            control == "linear" or (control == "polynomial" and bool(self.problem.objective.rate))
        )

    def _carries_input(self) -> bool:
        """Whether something behind an interval depends on its last input."""
        problem, u = self.problem, self.problem.plant.u
        if not self.nu:
            return False
        last = [c.expression for c in problem.nodes[-1]] + [problem.objective.final]
        ends = self.shooting and any(problem.depends_on_inputs(leg) for leg in problem.legs)
        jumps = bool(problem.objective.rate) and self.mesh.form.control == "constant"
        depends = any(ca.depends_on(ca.SX(e), u) for e in last)
        return bool(self._continuous() or jumps or ends or depends)

    # ---- unknowns -------------------------------------------------------------------------------
    def _lay_out(self) -> None:
        """Symbols of all stages, and their place among the program's unknowns."""
        problem, form, nx = self.problem, self.mesh.form, self.nx
        degrees = [i.degree for i in self.mesh.intervals]
        points = [nx * len(form.state_taus(d)) for d in degrees]
        columns = [self.nu * len(form.input_taus(d)) for d in degrees]
        costs = [len(problem.auxiliaries) * form.cost_points(d) for d in degrees]
        own = np.add(np.add(points, columns), costs)
        begins = nx + np.concatenate([[0], np.cumsum(own)]).astype(np.intp)
        tail = [self.legs, len(problem.design), problem.m.numel()]
        ends = np.cumsum([int(begins[-1]), *tail])
        nothing = np.zeros(0, dtype=np.intp)
        carried = [np.arange(a, b) for a, b in pairwise(ends)]
        parts: list[list[Index]] = []
        for k in range(self.count + 1):
            end = nx if k == 0 else int(begins[k - 1]) + points[k - 1]
            inside = k < self.count
            after = range(int(begins[k]), int(begins[k]) + points[k]) if inside else range(0)
            parts.append(
                [
                    np.arange(end - nx, end),
                    np.full(self.nu if k and self.carries_input else 0, NONE, dtype=np.intp),
                    np.full(len(problem.budgets) if k else 0, NONE, dtype=np.intp),
                    *carried,
                    np.arange(nx) if k and problem.closing is not None else nothing,
                    nothing if self.shooting else np.array(after, dtype=np.intp),
                    np.arange(after.stop, after.stop + columns[k]) if inside else nothing,
                    np.arange(begins[k + 1] - costs[k], begins[k + 1]) if inside else nothing,
                ]
            )
        self.nxs = [sum(len(part) for part in each[:-3]) for each in parts]
        self.nus = [sum(len(part) for part in each[-3:]) for each in parts]
        self.parts, flat = parts, [part for each in parts for part in each]
        self.unknown = np.concatenate(flat)
        self.z = ca.MX.sym("z", len(self.unknown))
        pieces = ca.vertsplit(self.z, np.cumsum([0, *(len(part) for part in flat)]).tolist())
        width = len(parts[0])
        self.at = [_Symbols(*pieces[width * k : width * (k + 1)]) for k in range(self.count + 1)]

    def _columns(self, members: Sequence[int], of: Callable[[_Symbols], ca.MX]) -> ca.MX:
        return ca.horzcat(*(of(self.at[k]) for k in members))

    def _times(self, members: Sequence[int], weights: Array) -> ca.MX:
        """A row of lengths or starts [s], each by the durations its own stage carries."""
        durations = self._columns(members, lambda s: s.durations)
        return ca.sum1(durations * ca.DM(weights[list(members)].T))

    def _parameters(self, members: Sequence[int]) -> ca.MX:
        """The plant's parameters, a column per stage where a design carries some."""
        if not self.problem.design:
            return self.p
        columns: list[ca.MX] = [
            with_design(self.problem, self.p, self.at[k].design) for k in members
        ]
        return ca.horzcat(*columns)

    def _input(self, k: int, tau: float) -> ca.MX:
        degree = self.mesh.intervals[k].degree
        values = ca.reshape(self.at[k].inputs, self.nu, len(self.mesh.form.input_taus(degree)))
        return values @ self.mesh.form.weights(degree, tau)

    def _point(self, members: Sequence[int]) -> list[ca.MX]:
        """Arguments of a Problem's function at the starts of stages, with the input before."""
        x_nominal, u_nominal = nominals(self.problem)
        t = self._times(members, self.starts)
        if self.carries_input and 0 not in members:
            before = self._columns(members, lambda s: s.before)
        else:
            before = ca.MX(self.nu, len(members))  # nothing depends on it
        return [
            self._columns(members, lambda s: s.x) * ca.repmat(ca.DM(x_nominal), 1, len(members)),
            before * ca.repmat(ca.DM(u_nominal), 1, len(members)),
            self._parameters(members),
            t,
            sampled(self.profiles, ca.MX(1, t.shape[1]), t, np.zeros(1)),
            self.q,
            self._columns(members, lambda s: s.peaks),
        ]

    # ---- stages ---------------------------------------------------------------------------------
    def build(self) -> Staged:
        """All constraints and costs."""
        ends, spent = self._stages()
        if self.shooting:
            self._path_at_ends()
        self._nodes()
        self._continuity()
        self._other_costs()
        return self._assembled(ends, spent)

    def _stages(self) -> tuple[list[ca.MX], list[ca.MX]]:
        """(end state, part of the budgets) of each interval; defects and path go to the rows."""
        ends, spent = [ca.MX()] * self.count, [ca.MX()] * self.count
        for group in self.program.groups:
            stage, members = group.stage, group.members
            n = len(members)
            h, t = self._times(members, self.lengths), self._times(members, self.starts)
            states = self._columns(members, lambda s: s.states)
            if self.shooting:
                states = ca.MX(self.nx, n)  # the defect from zero is the end state
            taus = stage.profile_taus
            defects, path, cost, budgets = stage.function.map(n)(
                self._columns(members, lambda s: s.x),
                states,
                self._columns(members, lambda s: s.inputs),
                h,
                t,
                self._parameters(members),
                sampled(self.profiles, h, t, taus),
                self.q,
                self._columns(members, lambda s: s.peaks),
                self._columns(members, lambda s: s.auxiliaries),
            )
            self.cost += ca.sum2(cost)
            # by shooting, the path at the end is the next stage's
            held = path[len(stage.leg.path) :, :] if self.shooting else path
            first = group.first_row + group.rows * n
            for j, k in enumerate(members):
                own = group.first_row + group.rows * j + np.arange(group.rows)
                rows = first + path.shape[0] * j + np.arange(path.shape[0])
                if not self.shooting:
                    self.rows[k].add(defects[:, j], own)
                self.rows[k].add(_column(held, j), rows[path.shape[0] - held.shape[0] :])
                ends[k] = defects[:, j] if self.shooting else self.at[k].states[-self.nx :]
                spent[k] = _column(budgets, j)
        return ends, spent

    def _path_at_ends(self) -> None:
        """By shooting, the path at an interval's end stands in the next stage,
        which has its state.
        """
        for group in self.program.groups:
            path = self.problem.conditions("path", group.stage.leg.path)
            size, total = len(group.stage.leg.path), len(group.stage.conditions)
            if not size:
                continue
            after = [k + 1 for k in group.members]
            values = path.map(len(after))(*self._point(after))
            first = group.first_row + group.rows * len(after)
            for j, k in enumerate(after):
                self.rows[k].add(values[:, j], first + total * j + np.arange(size))

    def _nodes(self) -> None:
        """Stops, the closing of a cycle, and budgets, where they stand in the program."""
        at = {}
        begin = 0
        for row in self.program.rows:
            at[row.label] = begin + np.arange(row.size)
            begin += row.size
        problem = self.problem
        for i, conditions in enumerate(problem.nodes):
            if conditions:
                k = self.mesh.first(i)
                point = self._point([k])
                if k < self.count and self.nu:
                    point[1] = self._input(k, 0.0) * nominals(problem)[1]
                values = problem.conditions("stop", conditions)(*point)
                self.rows[k].add(values, at[f"stop {i + 1}"])
        last = self.at[-1]
        if problem.closing is not None:
            x_nominal, _ = nominals(problem)
            names = [v.name for v in problem.plant.states]
            images = list(problem.closing.values())
            closed = [names.index(name) for name in problem.closing]
            order = [names.index(other) for _, other in images]
            factors = np.array([sign for sign, _ in images]) * x_nominal[order] / x_nominal[closed]
            missed = last.x[closed] - last.start[order] * factors
            self.rows[-1].add(missed, at["closing of the cycle"])
        if problem.budgets:
            self.rows[-1].add(last.spent, at["budgets"])

    def _continuity(self) -> None:
        if not (self._continuous() and self.nu):
            return
        begin = sum(r.size for r in self.program.rows if r.kind not in ("budget",)) - self.nu * (
            self.count - 1
        )
        for k in range(1, self.count):
            rows = begin + self.nu * (k - 1) + np.arange(self.nu)
            self.rows[k].add(self.at[k].before - self._input(k, 0.0), rows)

    def _other_costs(self) -> None:
        """As the program's: time, the last node, peaks, jumps of the inputs."""
        goal, first = self.problem.objective, self.at[0]
        self.cost += goal.time * ca.dot(first.durations, ca.DM(self.starts[-1]))
        if not goal.final.is_zero():
            self.cost += self.problem.function("final", [goal.final])(*self._point([self.count]))
        if goal.peaks:
            self.cost += ca.dot(ca.DM(list(goal.peaks)), first.peaks)
        if goal.rate and self.mesh.form.control == "constant":
            between = (self.lengths[:-1] + self.lengths[1:]) / 2
            for k in range(1, self.count):
                h = ca.dot(self.at[k].durations, ca.DM(between[k - 1]))
                jump = ca.sumsqr(self._input(k, 0.0) - self.at[k].before)
                self.cost += goal.rate * jump / h

    # ---- the whole ------------------------------------------------------------------------------
    def _assembled(self, ends: list[ca.MX], spent: list[ca.MX]) -> Staged:
        """Gaps and rows in their order."""
        pieces: list[ca.MX] = []
        row: list[Index] = []
        sign: list[Array] = []
        pairs: dict[str, list[Index]] = {"before": [], "spent": []}
        entry, at = 0, 0
        for k in range(self.count + 1):
            held = self.rows[k]
            if k < self.count:
                entry += self.nxs[k] + self.nus[k]
                gap = self._gap(k, ends[k], spent[k])
                names = np.full(gap.numel(), NONE, dtype=np.intp)
                if self.shooting:
                    names[: self.nx] = self._defect_rows(k)
                pieces.append(gap)
                row.append(names)
                sign.append(np.full(gap.numel(), -1.0))
                begin = self.nx
                for name in ("before", "spent"):
                    size = getattr(self.at[k + 1], name).numel()
                    inside = begin + np.arange(size)
                    pairs[name].append(np.column_stack([entry + inside, at + inside]))
                    begin += size
            pieces += held.values
            row += held.row
            sign += [np.ones(len(r)) for r in held.row]
            at = sum(len(r) for r in row)
        nlp = {
            "x": self.z,
            "p": ca.vertcat(self.p, self.q),
            "f": self.cost,
            "g": ca.vertcat(*pieces),
        }
        ngs = [sum(len(r) for r in rows.row) for rows in self.rows]
        sizes = {"N": self.count, "nx": self.nxs, "nu": self.nus, "ng": ngs}
        return Staged(
            self.program,
            nlp,
            sizes,
            self.unknown,
            np.concatenate(row),
            np.concatenate(sign),
            np.concatenate(pairs["spent"]),
            np.concatenate(pairs["before"]),
        )

    def _gap(self, k: int, end: ca.MX, spent: ca.MX) -> ca.MX:
        """X_(k+1) - F_k."""
        here, after = self.at[k], self.at[k + 1]
        closing = self.problem.closing is not None
        following = [
            end,
            self._input(k, 1.0) if self.carries_input else ca.MX(0, 1),
            here.spent + spent if k else spent,
            here.durations,
            here.design,
            here.peaks,
            (here.start if k else here.x) if closing else ca.MX(0, 1),
        ]
        names = ("x", "before", "spent", "durations", "design", "peaks", "start")
        reached: list[ca.MX] = [getattr(after, n) for n in names]
        return ca.vertcat(*reached) - ca.vertcat(*following)

    def _defect_rows(self, k: int) -> Index:
        """Where the program has the defects of interval k."""
        for group in self.program.groups:
            if k in group.members:
                return np.asarray(
                    group.first_row + group.rows * group.members.index(k) + np.arange(group.rows)
                )
        raise AssertionError(f"interval {k} belongs to no group")


def _column(matrix: ca.MX, j: int) -> ca.MX:
    """One column; of a matrix without rows CasADi keeps none."""
    return matrix[:, j] if matrix.numel() else ca.MX(0, 1)

"""Why there is no plan: an elastic re-solve that names the constraints in conflict."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.shown import shown
from ...numerics.solvers import nlpsol, quiet_ipopt
from ..problem.problem import Budget, Condition
from ..transcription.mesh import Collocation, Mesh
from ..transcription.transcription import Program
from .ipopt import DEFAULTS
from .solver import Outcome, limit

Array: TypeAlias = NDArray[np.float64]

NOTABLE = 1e-6
"""Violations below this part of nominal are rounding."""
ENOUGH = 1000
"""Iterations of a re-solve that has to converge to say anything."""
RESOLVING = 25, 2
"""Intervals of a leg, at least, and their degree, on which conflicts are looked for."""
NAMED = 3
"""How many constraints a message names."""


@shown
@dataclass(frozen=True)
class Conflict:
    """A constraint that has to be violated: the condition, by how much (in nominals), and where."""

    label: str
    excess: float
    where: str
    condition: Condition | Budget | None

    def __str__(self) -> str:
        if self.condition is None:
            return f"the {self.label} (by {self.excess:.3g} of nominal)"
        shown = self.condition.shown.shown
        low, high = self.condition.low, self.condition.high
        bounds = f"= {shown(low)}" if low == high else f"{shown(low)} .. {shown(high)}"
        where = f" {self.where}" if self.where else ""
        return f"{self.label} ({bounds}), by {shown(self.excess * self.condition.nominal)}{where}"


@dataclass(frozen=True)
class Elastic:
    """Where an elastic re-solve ended. Only one that converged tells anything."""

    converged: bool
    conflicts: tuple[Conflict, ...]
    """The constraints that are violated, the worst of each name, largest first."""
    w: Array
    """The (scaled) unknowns found."""

    @property
    def feasible(self) -> bool:
        """Whether these unknowns meet all constraints."""
        return self.converged and not self.conflicts

    @property
    def conflicting(self) -> bool:
        """Whether nothing near these unknowns meets all constraints."""
        return self.converged and bool(self.conflicts)


def elastic(program: Program, guess: Array, options: Mapping[str, Any] | None) -> Elastic:
    """Least total violation of stops, path and budgets; the dynamics and a cycle's closing are
    kept.
    """
    soft = np.concatenate([r.soft() for r in program.rows])
    chosen = np.flatnonzero(soft)
    g = program.nlp["g"]
    above, below = ca.MX.sym("above", len(chosen)), ca.MX.sym("below", len(chosen))
    pick = ca.DM(
        ca.Sparsity.triplet(g.numel(), len(chosen), chosen.tolist(), list(range(len(chosen)))), 1.0
    )
    nlp = {
        "x": ca.vertcat(program.nlp["x"], above, below),
        "p": program.nlp["p"],
        "f": ca.sum1(above) + ca.sum1(below),
        "g": g + ca.mtimes(pick, below - above),
    }
    ipopt = {**DEFAULTS, "tol": 1e-7, "max_iter": ENOUGH}
    ipopt["max_cpu_time"] = limit(program)
    ipopt.update(options or {})
    zero = np.zeros(2 * len(chosen))
    (lbx, ubx), (lbg, ubg) = program.bounds(), program.limits()
    arguments = {
        "x0": np.concatenate([np.clip(program.completed(guess), lbx, ubx), zero + 0.1]),
        "p": program.parameters(),
        "lbx": np.concatenate([lbx, zero]),
        "ubx": np.concatenate([ubx, zero + np.inf]),
        "lbg": lbg,
        "ubg": ubg,
    }
    solver = nlpsol("elastic", "ipopt", nlp, quiet_ipopt(**ipopt))
    result, stats = solver(**arguments), solver.stats()
    found = np.asarray(result["x"], float).ravel()
    slack = np.zeros(g.numel())
    slack[chosen] = found[len(lbx) :].reshape(2, -1).max(axis=0)
    return Elastic(bool(stats["success"]), _conflicts(program, slack), found[: len(lbx)])


def resolving(mesh: Mesh) -> Mesh:
    """A mesh of enough short intervals of a low degree; itself where it has as many. On one that
    does not resolve a motion's oscillations an elastic solve does not converge.
    """
    legs = 1 + mesh.intervals[-1].leg
    enough = len(mesh.intervals) >= RESOLVING[0] * legs
    return mesh if enough else Collocation(*RESOLVING).mesh(legs)


def _conflicts(program: Program, slack: Array) -> tuple[Conflict, ...]:
    """The worst row of each condition whose slack is notable."""
    worst: dict[str, Conflict] = {}
    for row, own in program.placed():
        for i in np.flatnonzero(slack[own] > NOTABLE):
            condition = row.condition(int(i))
            label = condition.label if condition else row.label
            excess = float(slack[own][i])
            if label not in worst or worst[label].excess < excess:
                worst[label] = Conflict(label, excess, row.where(int(i)), condition)
    return tuple(sorted(worst.values(), key=lambda c: -c.excess))


def explanation(
    plant: str, outcome: Outcome, conflicts: tuple[Conflict, ...], feasible: bool
) -> str:
    """The message of a plan that was not found.

    feasible : whether an elastic re-solve met all constraints.
    """
    if outcome.stopped:
        return f"the solver was stopped before it found a plan for {plant} ({outcome.status})"
    advised = f" {outcome.advice}" if outcome.advice else ""
    opening = f"no plan found for {plant} ({outcome.status}). "
    if not conflicts:
        known = (
            "A motion that meets all constraints seems to exist, but the solver did not converge"
            if feasible
            else f"The solver did not converge in {outcome.iterations} iterations from the first "
            "guess, nor from others; this does not prove that there is no plan"
        )
        remedy = (
            "; try another method=Collocation(...), other bounds of duration, a guess=..., or more "
            "options={'max_iter': ...}."
        )
        return opening + known + remedy + advised
    more = "; ".join(str(c) for c in conflicts[1:NAMED])
    also = f" In conflict with it: {more}." if more else ""
    worst = str(conflicts[0])
    if " settled" in worst:
        remedy = "it cannot rest before the motion: name that state in the first stop if it shall "
        remedy += "begin as it is said there, or give rest=False"
    else:
        remedy = "relax it, or allow more time or pressure"
    return (
        opening
        + f"The most violated constraint is {worst}; {remedy}.{also} So says a local search, "
        "which is no proof that there is no plan." + advised
    )


def advice(program: Program) -> str:
    """What often leaves no motion: bounds that are one number, legs of few intervals; "" where
    there is neither.
    """
    mesh, said = program.mesh, []
    still = mesh.form.control != "polynomial"
    held = _held_all_along(program)
    if held:
        said.append(
            f"Bounds hold {' and '.join(held)} all along: give (low, high) for a range"
            + (", or inputs that can follow it: method=Collocation(control='polynomial')" * still)
            + "."
        )
    name = "Shooting" if mesh.form.scheme == "shooting" else "Collocation"
    for i, node in enumerate(program.problem.nodes[1:]):
        count = sum(each.leg == i for each in mesh.intervals)
        asked = sum(c.low == c.high for c in node)
        if still and count < asked:
            said.append(
                f"Leg {i + 1} has {count} interval{'s' * (count > 1)}, in which inputs are "
                f"{mesh.form.control}, for {asked} conditions at its end: give it more, as in "
                f"method={name}(intervals=50)."
            )
            break
    return " ".join(said)


def _held_all_along(program: Program) -> list[str]:
    """What has one value along a whole motion, with that value."""
    found: dict[str, str] = {}
    problem = program.problem
    for leg in problem.legs:
        if leg.dwell:
            continue
        for v in (*problem.plant.states, *problem.plant.inputs):
            low, high = leg.bounds[v.name]
            if low == high and not v.disturbance:
                found[v.name] = f"{v.name} at {v.shown(low)}"
        for c in leg.path:
            if c.low == c.high and not c.defining:
                level = "" if "profile" in c.label else f" at {c.shown.shown(c.low)}"
                found[c.label] = c.label + level
    return list(found.values())

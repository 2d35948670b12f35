"""Plan: a planned motion with everything that says how far to trust it."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import compress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, PlanError, PlanWarning
from ..core.shown import shown
from ..core.signals import PiecewisePolynomial
from ..core.stop import turns
from ..core.trajectory import Trajectory
from ..core.units import significant
from ..core.variables import Variable
from ..judge.motion import TOLERANCE, Judgement, Motion, Verdict
from ..judge.statement import Statement
from ..numerics.collocation import collocation_matrices
from ..plants.plant import Plant
from .problem.formulation import DWELLING, formulate
from .problem.problem import Problem
from .problem.statement_data import data_of, statement_of
from .replay import Replay
from .solvers.diagnosis import Conflict
from .solvers.solver import Ipopt, Outcome
from .stages import table
from .transcription.mesh import Arc, Form, Mesh
from .transcription.solution import Solution, unpack
from .transcription.stage import nominals
from .transcription.transcription import Group, Program

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Solved:
    """A program and what a solver made of it: for its multipliers, and to start others from."""

    program: Program
    outcome: Outcome
    solution: Solution

    @property
    def multiplied(self) -> bool:
        """Whether its multipliers are known: those of a plan by arcs are not."""
        return bool(np.isfinite(self.outcome.lam_g).all())


def motion_of(samples: Trajectory, mesh: Mesh, durations: Iterable[float]) -> Motion:
    """What a plant is driven by: held inputs have one piece for each of their values."""
    inputs = samples.signals
    assert inputs is not None  # a plan's inputs are known in between
    if mesh.form.control == "constant":
        first = mesh.held()
        breaks = np.append(inputs.breaks[first], inputs.breaks[-1])
        inputs = PiecewisePolynomial(breaks, inputs.coefficients[first])
    variables = [v for v in samples.variables if v.causality == "state"]
    # a solver may leave the range by rounding
    start = [np.clip(samples[v.name][0], v.min, v.max) for v in variables]
    return Motion(np.array(start, float), inputs, tuple(map(float, durations)))


@shown
@dataclass(frozen=True, eq=False)
class Plan:
    """A planned motion, or a failed attempt at one; :attr:`verdict` says whether to trust it.

    A failed plan is sealed: ``trajectory`` raises PlanError; what the solver left is reached only
    by :meth:`unverified`.

    Examples
    --------
    >>> plan.verified, plan.replay_error < 1e-3
    (True, True)
    >>> print(f"{1e3 * plan.duration:.1f} ms")
    36.6 ms
    >>> plan.trajectory["x"][[0, -1]].round(6)
    array([-0.01,  0.01])
    """

    plant: Plant
    """With the values that the plan chose for its ``design`` parameters."""
    solved: bool
    """Whether the solver converged: then there is a :attr:`trajectory`."""
    status: str
    """The solver's return status."""
    objective: float
    """Of the motion, in the statement's words, as the judge finds it; ``statistics`` has what the
    solver minimised on its mesh. Of a failed plan the solver's.
    """
    durations: tuple[float, ...]
    """Of each leg, dwells among them [s]."""
    design: dict[str, float]
    """Values of the parameters that were chosen with the motion."""
    statistics: dict[str, Any]
    """iterations, seconds to build and to solve, size of the program."""
    replay: Replay | None
    """What the planner's own replay says of its mesh, interval by interval."""
    judgement: Judgement | None
    """What the judge says of the motion; None of a failed plan."""
    meshes: tuple[Mesh, ...]
    """The mesh of each round of refinement; the last is the plan's."""
    log: tuple[dict[str, float], ...] = field(repr=False)
    """The solver's last run: objective (obj), violation (inf_pr), dual infeasibility (inf_du), ...
    per iteration.
    """
    conflicts: tuple[Conflict, ...] = ()
    """Of a failed plan: the constraints that cannot hold together, the worst first."""
    tolerance: float = TOLERANCE
    """What the plan is judged by, in units of nominal."""
    _samples: Trajectory = field(repr=False, default=None)  # type: ignore[assignment]
    _statement: Statement | None = field(repr=False, default=None)
    _problem: Problem | None = field(repr=False, default=None)
    _solved: Solved | None = field(repr=False, default=None)
    _coarse: Solved | None = field(repr=False, default=None)
    """The solution on the first mesh."""
    _peaks: tuple[float, ...] = ()
    """In units of nominal."""

    @property
    def verdict(self) -> Verdict:
        """Whether the plan can be trusted, with all figures;
        ``print(plan.verdict)`` is a sentence.
        """
        nan, j = float("nan"), self.judgement
        figures = (j.error, j.state, j.violation, j.constraint) if j else (nan, "", nan, "")
        ended = str(self.statistics.get("ended", ""))
        local = self.replay.local if self.replay else nan
        corrected = bool(self.statistics.get("corrected", False))
        begins = tuple(f.label for f in j.said if f.by > self.tolerance) if j else ()
        return Verdict(
            self.status,
            self.solved,
            *figures,
            self.tolerance,
            ended,
            local,
            corrected,
            begins,
            j.apart if j else 0.0,
        )

    @property
    def motion(self) -> Motion:
        """What the plant is driven by: start, inputs as they run, durations; what the judge sees.

        Raises PlanError when the plan failed.
        """
        return motion_of(self.trajectory, self.meshes[-1], self.durations)

    @property
    def verified(self) -> bool:
        """Whether the solver converged, an independent replay agrees, and all limits hold between
        the points too, to the plan's :attr:`tolerance`.
        """
        return self.verdict.verified

    @property
    def success(self) -> bool:
        """The same as :attr:`verified`."""
        return self.verified

    def _near(self, program: Program) -> Solved | None:
        """Where a solve of ``program`` may start from this plan: warm,
        if it solved the same one. InputError where it is of a plant with other variables.
        """
        own, other = (
            [v.name for v in (*plant.states, *plant.inputs)]
            for plant in (self.plant, program.problem.plant)
        )
        if own != other:
            raise InputError(
                f"guess: a plan of {self.plant.name!r}, with {', '.join(own)}, cannot start one of "
                f"{program.problem.plant.name!r}, with {', '.join(other)}; give a plan of a plant "
                "with these states and inputs, or none"
            )
        if self._coarse is not None and self._coarse.program.nlp is program.nlp:
            return self._coarse
        return self._solved

    @property
    def duration(self) -> float:
        """Of the whole motion [s]."""
        return sum(self.durations)

    @property
    def trajectory(self) -> Trajectory:
        """The planned motion. Raises PlanError when the plan failed."""
        if not self.solved:
            raise PlanError(
                f"this plan failed ({self.status}) and holds no solution; unverified() gives what "
                "the solver left",
                self,
            )
        return self._samples

    @property
    def replay_error(self) -> float:
        """Largest deviation of the replay from the plan, in units of nominal (NaN when failed)."""
        return self.judgement.error if self.judgement else float("nan")

    def unverified(self) -> Trajectory:
        """What the solver left, whether it is a solution or not."""
        return self._samples

    @cached_property
    @turns
    def arcs(self) -> tuple[Arc, ...]:
        """What leads each input when: arcs along one of its limits, or "interior"; input by input.

        Exact to the plan's tolerance where :class:`pam_ocp.Arcs` planned it, else to the mesh.
        """
        self.trajectory  # noqa: B018 - raises for a plan that failed
        return courtesy.arcs_along(self)

    # ---- duals --------------------------------------------------------------------------------
    def _duals(self) -> Solved:
        if not self.solved or self._solved is None:
            raise PlanError(
                "this plan holds no multipliers: it failed, or was loaded from a file; plan it "
                "anew",
                self,
            )
        return self._multiplied

    @cached_property
    def _multiplied(self) -> Solved:
        """The solution with multipliers: those of a plan by arcs are found when asked for, on its
        mesh.
        """
        solved = self._solved
        assert solved is not None
        if solved.multiplied:
            return solved
        program = solved.program
        outcome = Ipopt(program)(program, solved.outcome.w, "near")
        if not outcome.success:
            raise PlanError(
                f"no multipliers were found for this plan ({outcome.status}); plan it with "
                "method=Collocation()",
                self,
            )
        return replace(solved, outcome=outcome)

    @cached_property
    def costates(self) -> Trajectory:
        """Derivative of the optimal value by each state, over time [objective / SI unit].

        Columns are named as the states. From the defects' multipliers: lambda = multiplier /
        quadrature weight at collocation points (Benson et al., J. Guid. Control Dyn. 29, 2006, for
        Gauss points; Garg et al., Comput. Optim. Appl. 49, 2011, for Radau points), the multiplier
        itself at the end of an interval by Gauss points or shooting; at the start of the motion
        from the stationarity of the initial state.
        """
        solved = self._duals()
        t, values = _costates(solved.program, solved.outcome)
        keep = np.concatenate([[True], np.diff(t) > 0])  # a Gauss interval of no length has twins
        variables = [Variable(v.name, "output") for v in self.plant.states]
        columns = {v.name: values[keep, i] for i, v in enumerate(variables)}
        return Trajectory(t[keep], columns, variables, "linear")

    @cached_property
    def sensitivities(self) -> dict[str, float]:
        """{parameter: derivative of the optimal objective by it [objective / SI unit]}.

        By the envelope theorem, from the multipliers: no re-solve. Valid while the same constraints
        stay active.
        """
        solved = self._duals()
        return _sensitivities(solved.program, solved.outcome)

    @cached_property
    def stop_sensitivities(self) -> dict[str, float]:
        """{"stop 2: x": derivative of the optimal objective by this value}."""
        solved = self._duals()
        return _stop_sensitivities(solved.program, solved.outcome)

    def sensitivity(self, name: str) -> float:
        """Derivative of the optimal objective by one parameter of the plant."""
        variable = self.plant.variable(name)
        if variable.name not in self.sensitivities:
            raise InputError(
                f"{name} is {variable.kind}"
                + (" that this plan designs" if variable.name in self.design else "")
                + "; sensitivities are those of the plant's other parameters"
            )
        return self.sensitivities[variable.name]

    def __getstate__(self) -> dict[str, Any]:
        """Symbols do not travel between processes: the problem goes as data, a copy there knows no
        multipliers."""
        figures = ("costates", "sensitivities", "stop_sensitivities")
        lost = ("_problem", "_statement", "_solved", "_coarse", "_multiplied", *figures)
        kept = {k: v for k, v in self.__dict__.items() if k not in lost}
        try:
            said = data_of(self.plant, self._statement) if self._statement else None
        except InputError:
            said = None
        return {**kept, "_solved": None, "_coarse": None, "conflicts": (), "statement": said}

    def __setstate__(self, state: dict[str, Any]) -> None:
        said = state.pop("statement")
        statement = statement_of(state["plant"], said) if said else None
        with warnings.catch_warnings():  # said where the plan was made
            warnings.simplefilter("ignore", PlanWarning)
            problem = formulate(state["plant"], statement) if statement else None
        self.__dict__.update(state, _statement=statement, _problem=problem)

    # ---- files and figures ----------------------------------------------------------------------
    @turns
    def save(self, path: str | Path) -> Path:
        """Write the plan as .npz; :func:`pam_ocp.load_plan` reads it and replays it anew."""
        return courtesy.save_plan(self, path)

    def explain(self) -> str:
        """What the search did, stage by stage: why each program was solved, what it took, and what
        its motion costs; for a plan that takes long. The same as data: ``statistics["stages"]``.
        """
        return table(self.statistics.get("stages", ()), self.statistics.get("seconds", math.nan))

    def to_excel(self, path: str | Path) -> Path:
        """Write a workbook (.xlsx): verdict and figures, the motion in display units, charts.

        Raises PlanError when the plan failed.
        """
        return courtesy.write_plan_book(self, path)

    def to_pandas(self) -> pd.DataFrame:
        """The motion as a DataFrame, one column per variable, indexed by time [s]."""
        return self.trajectory.to_pandas()

    def _brief(self) -> str:
        return f"of {self.plant.name}, {significant(self.duration)} s: {self.verdict}"

    def plot(self) -> Figure:
        """Motion, velocities, pressures with commands, forces, stiffness; active bounds shaded."""
        return courtesy.plot_plan(self)

    def __str__(self) -> str:
        s = self.statistics
        verdict = str(self.verdict)
        counted = self._problem.objective.words if self._problem else ""
        lines = [
            f"{verdict if self.verified else verdict.upper()[:12] + verdict[12:]}",
            f"plan of {self.plant.name}: {self.status}",
            f"duration   {significant(self.duration)} s "
            f"({' + '.join(map(significant, self.durations))})",
            f"objective  {significant(self.objective)}" + (f" = {counted}" if counted else ""),
            f"solver     {s.get('solver', 'IPOPT')}, {s['iterations']} iterations, "
            f"{s['solve_seconds']:.3f} s (built in {s['build_seconds']:.3f} s; {s['variables']} "
            f"variables, {s['constraints']} constraints)",
            f"mesh       {s['intervals']} intervals"
            + (f", refined {len(self.meshes) - 1} times" if len(self.meshes) > 1 else ""),
        ]
        if len(s.get("starts", ())) > 1:
            led = sum(end["solved"] for end in s["starts"])
            lines.append(
                f"starts     {len(s['starts'])}, of which {led} found a plan; these lay "
                f"{100 * s['starts_apart']:.2g} % apart"
            )
        if s.get("warning"):
            lines.append(f"note       {s['warning']}")
        lines[4:4] = [
            f"design     {name} = {self.plant.variable(name).shown(value)}"
            for name, value in self.design.items()
        ]
        if self.judgement:
            judged = self.judgement
            worst = f" ({judged.constraint})" if judged.constraint else ""
            lines += [
                f"replay     error {judged.error:.2e} of nominal ({judged.state})",
                f"bounds     largest violation {judged.violation:.2e} of nominal{worst}",
            ]
        return "\n".join(lines)


# ---- what the multipliers say -------------------------------------------------------------------
def _costates(program: Program, outcome: Outcome) -> tuple[Array, Array]:
    """(times (n,), costates (n, nx)); see :attr:`Plan.costates`."""
    mesh = program.mesh
    x_nominal, _ = nominals(program.problem)
    breaks = unpack(program.problem, mesh, outcome.w).inputs.breaks
    parts: dict[int, tuple[Array, Array]] = {}
    for group in program.groups:
        degree = group.stage.degree
        taus, shares = mesh.form.state_taus(degree), _shares(mesh.form, degree)
        for k, row in zip(group.members, _block(group, outcome), strict=True):
            values = row.reshape(len(taus), -1) / shares[:, None] / x_nominal
            parts[k] = (breaks[k] + (breaks[k + 1] - breaks[k]) * taus, values)
    order = [parts[k] for k in range(len(mesh.intervals))]
    first = _initial(program, outcome) / x_nominal
    times = np.concatenate([[0.0], *(t for t, _ in order)])
    return times, np.vstack([first, *(values for _, values in order)])


def _shares(form: Form, degree: int) -> Array:
    """By what the multipliers of an interval's defects exceed the costates."""
    if form.scheme == "shooting":
        return np.ones(1)
    shares = collocation_matrices(form.collocated(degree))[2]
    return np.append(shares, 1.0) if form.scheme == "gauss" else shares


def _block(group: Group, outcome: Outcome) -> Array:
    """(intervals, rows) multipliers of a group's defects."""
    size = group.rows * len(group.members)
    return outcome.lam_g[group.first_row : group.first_row + size].reshape(len(group.members), -1)


def _initial(program: Program, outcome: Outcome) -> Array:
    """Gradient of the Lagrangian by the (scaled) initial state."""
    n = len(program.problem.plant.states)
    nlp = program.nlp
    # what the stops and the closing say of the initial state is what its change is asked against
    held = [np.full(r.size, r.kind in ("stop", "closing")) for r in program.rows]
    lam = np.where(np.concatenate(held), 0.0, outcome.lam_g)
    lagrangian = nlp["f"] + ca.dot(nlp["g"], lam)
    gradient = ca.Function("g", [nlp["x"], nlp["p"]], [ca.gradient(lagrangian, nlp["x"])])
    return np.asarray(gradient(outcome.w, program.parameters()), float).ravel()[:n]


def _sensitivities(program: Program, outcome: Outcome) -> dict[str, float]:
    """{parameter: derivative of the optimal objective by it} (envelope theorem).

    Holds where the active constraints stay the same; parameters that the plan designs are left out.
    """
    nlp = program.nlp
    lagrangian = nlp["f"] + ca.dot(nlp["g"], outcome.lam_g)
    gradient = ca.Function("g", [nlp["x"], nlp["p"]], [ca.gradient(lagrangian, nlp["p"])])
    values = np.asarray(gradient(outcome.w, program.parameters()), float).ravel()
    problem = program.problem
    names = [v.name for v in problem.plant.parameters]
    return {n: float(v) for n, v in zip(names, values, strict=False) if n not in problem.design}


def _stop_sensitivities(program: Program, outcome: Outcome) -> dict[str, float]:
    """{label of a condition at a stop: derivative of the objective by its value}, which a dwell
    holds from its beginning to its end.
    """
    found: dict[str, float] = {}
    for row, own in program.placed():
        if row.kind not in ("stop", "path"):
            continue
        stands = row.kind == "stop"
        held = [stands or c.label.startswith(DWELLING) for c in row.conditions]
        slopes = outcome.lam_g[own].reshape(-1, max(len(held), 1)).sum(axis=0)
        for condition, push in compress(zip(row.conditions, slopes, strict=False), held):
            label = condition.label.removeprefix(DWELLING)
            found[label] = found.get(label, 0.0) - float(push) / condition.nominal
    return found

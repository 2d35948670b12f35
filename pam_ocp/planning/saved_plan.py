"""Plans in files: .npz with the samples, the inputs as they ran, the problem and the figures."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, PlanError, PlanWarning
from ..core.files import read_npz, reading, require_format, write_npz
from ..core.quantities import outside
from ..core.signals import PiecewisePolynomial
from ..core.stop import verb
from ..judge.motion import judge
from ..plants.plant import Plant, require_plant
from ..plants.plant_data import carried
from ..plants.plant_file import load_plant
from ..simulation.integrate import evaluated
from .problem.formulation import formulate
from .problem.problem import Problem
from .problem.statement_data import data_of, statement_of
from .replay import chosen_plant, explained, interval_errors, interval_states, left_as, replayed
from .result import Plan, motion_of
from .settings import SETTINGS
from .transcription.mesh import Form, Interval, Mesh
from .transcription.solution import Solution, pack
from .transcription.transcription import Program, transcribe

Array: TypeAlias = NDArray[np.float64]

FORMAT = "pam_ocp plan 3"
FORMER = ("pam_ocp plan 1", "pam_ocp plan 2")
AGREE = 1e-5
"""How far what a file says twice may differ, in units of nominal; solvers leave 1e-6 and less."""


def save_plan(plan: Plan, path: str | Path) -> Path:
    """Write a plan; the solver must have converged (PlanError otherwise)."""
    target = Path(path)
    if target.suffix != ".npz":
        raise InputError(f"path = {str(path)!r}: a plan is written as .npz")
    motion = plan.trajectory
    assert motion.signals is not None  # a plan that was solved has them
    if plan._statement is None:
        raise PlanError(
            "this plan does not know its problem any more; save it where it was made", plan
        )
    meta = {
        "format": FORMAT,
        "plant": plan.plant.name,
        "states": motion.named("state"),
        "inputs": motion.named("input"),
        "parameters": {v.name: v.start for v in plan.plant.parameters},
        "statement": data_of(plan.plant, plan._statement),
        "status": plan.status,
        "objective": plan.objective,
        "durations": plan.durations,
        "design": plan.design,
        "peaks": plan._peaks,
        "tolerance": plan.tolerance,
        "statistics": plan.statistics,
        "log": plan.log,
        "meshes": [
            {
                "form": [m.form.scheme, m.form.control, m.form.guarded],
                "intervals": [
                    [i.leg, i.fraction, i.degree, i.raised, i.watched, i.joined]
                    for i in m.intervals
                ],
            }
            for m in plan.meshes
        ],
    }
    arrays = {
        "t": motion.t,
        "states": motion.array(motion.named("state")),
        "breaks": motion.signals.breaks,
        "coefficients": motion.signals.coefficients,
    }
    own, samples = motion._packed()  # Trajectory.load, and so every command, reads the motion
    return write_npz(target, own | meta | carried(plan.plant), samples | arrays)


@verb
def load_plan(path: str | Path, plant: Plant | None = None) -> Plan:
    """Read a plan of ``plant`` (None: the plant that the file carries) and judge it anew.

    Objective, durations, violations and the replay are computed here, from the motion in the file,
    the problem in the file and today's plant, which takes over the parameter values that the plan
    was made with. Multipliers are not kept: ``costates`` and ``sensitivities`` of a loaded plan
    raise PlanError.

    Raises InputError for a file that is no plan, a plan of another plant, or one that contradicts
    itself: the message names what. Warns (PlanWarning) when the plan is not verified.

    Examples
    --------
    >>> path = plan.save("plan.npz")
    >>> pam.load_plan(path, slide).verified
    True
    """
    meta, arrays = _read(Path(path))
    plant = load_plant(path) if plant is None else require_plant(plant)
    with reading(path, "a plan file", "give one that plan.save() wrote, or plan anew"):
        found = _plan(str(path), meta, arrays, plant)
    if not found.verified:
        warnings.warn(f"{path}: the plan is {found.verdict}", PlanWarning, stacklevel=outside())
    return found


def _plan(path: str, meta: Mapping[str, Any], arrays: Mapping[str, Array], plant: Plant) -> Plan:
    _require_same_names(path, meta, plant)
    plant = plant.with_values(meta["parameters"])
    statement = statement_of(plant, meta["statement"])
    with warnings.catch_warnings():  # said where the plan was made
        warnings.simplefilter("ignore", PlanWarning)
        problem = formulate(plant, statement)
    meshes = tuple(_mesh(m) for m in meta["meshes"])
    mesh = meshes[-1]
    solution = Solution(
        arrays["t"],
        arrays["states"],
        PiecewisePolynomial(arrays["breaks"], arrays["coefficients"]),
        np.array(meta["durations"], float),
        np.array([meta["design"][n] for n in problem.design], float),
        np.array(meta["peaks"], float),
    )
    _require_grid(path, problem, mesh, solution)
    for name in problem.design:
        if meta["design"][name] != meta["parameters"][name]:
            raise _contradiction(path, f"design and parameters differ in {name}")
    program = transcribe(problem, mesh)
    if meta["statistics"].get("corrected"):
        program = _corrected(path, program, solution)
    _require_solution(path, program, solution)
    samples = evaluated(plant, solution.t, solution.states, solution.inputs)
    tolerance = float(meta["tolerance"])
    replay = replayed(problem, plant, mesh, samples, solution)
    judgement = judge(plant, statement, motion_of(samples, mesh, solution.durations), samples)
    objective, claimed = judgement.objective, float(meta["objective"])
    if not abs(objective - claimed) <= AGREE * max(1.0, abs(objective)):
        raise _contradiction(path, f"its objective is {objective:.6g}, not {claimed:.6g}")
    return Plan(
        plant,
        True,
        str(meta["status"]),
        objective,
        tuple(map(float, solution.durations)),
        {n: float(v) for n, v in zip(problem.design, solution.design, strict=True)},
        dict(meta["statistics"]),
        explained(replay, plant, mesh, solution, tolerance),
        judgement,
        meshes,
        tuple(meta["log"]),
        (),
        tolerance,
        samples,
        statement,
        problem,
        None,
        None,
        tuple(map(float, solution.peaks)),
    )


def _contradiction(path: str, what: str) -> InputError:
    return InputError(
        f"{path} contradicts itself: {what}; it was changed after it was saved, or the plant's "
        "equations were. Plan anew"
    )


def _require_same_names(path: str, meta: Mapping[str, Any], plant: Plant) -> None:
    for what, here in (
        ("states", [v.name for v in plant.states]),
        ("inputs", [v.name for v in plant.inputs]),
        ("parameters", {v.name: v.start for v in plant.parameters}),
    ):
        if list(meta[what]) != list(here):
            raise InputError(
                f"{path}: a plan of {meta['plant']!r} with {what} {', '.join(meta[what])}; the "
                f"plant {plant.name!r} has {', '.join(here)}"
            )


def _mesh(said: Mapping[str, Any]) -> Mesh:
    intervals = (
        Interval(
            leg, fraction, degree, raised, tuple((n, margin) for n, margin in watched), *joined
        )
        for leg, fraction, degree, raised, watched, *joined in said["intervals"]
    )
    return Mesh(tuple(intervals), Form(*said["form"]))


def _require_grid(path: str, problem: Problem, mesh: Mesh, solution: Solution) -> None:
    """Times and sizes that the mesh and the durations say."""
    if len(solution.durations) != len(problem.legs) or len(solution.peaks) != problem.m.numel():
        raise _contradiction(path, "its durations are not those of its legs")
    t, breaks = [0.0], [0.0]
    for interval in mesh.intervals:
        h = float(solution.durations[interval.leg] * interval.fraction)
        t += list(breaks[-1] + h * mesh.form.state_taus(interval.degree))
        breaks.append(breaks[-1] + h)
    columns = max(len(mesh.form.input_taus(i.degree)) for i in mesh.intervals)
    inputs = solution.inputs
    shapes = {
        "times": (solution.t.shape, (len(t),)),
        "states": (solution.states.shape, (len(t), len(problem.plant.states))),
        "input breaks": (inputs.breaks.shape, (len(breaks),)),
        "inputs": (
            inputs.coefficients.shape,
            (len(breaks) - 1, columns, len(problem.plant.inputs)),
        ),
    }
    for name, (shape, expected) in shapes.items():
        if shape != expected:
            raise _contradiction(
                path, f"its {name} have the shape {shape}, its mesh says {expected}"
            )
    for array in (
        solution.t,
        solution.states,
        inputs.breaks,
        inputs.coefficients,
        solution.durations,
    ):
        if not np.all(np.isfinite(array)):
            raise _contradiction(path, "a value is not a finite number")
    allowed = AGREE * breaks[-1]
    missed = (solution.t - t, inputs.breaks - breaks)
    if max(float(np.max(np.abs(miss))) for miss in missed) > allowed:
        raise _contradiction(path, "its times are not those of its durations")


def _corrected(path: str, program: Program, solution: Solution) -> Program:
    """The program of a motion whose mesh's defects were corrected: its intervals run as the plant
    does, its collocation equations hold but for what they leave.
    """
    plant = chosen_plant(program.problem, solution)
    run = interval_states(plant, program.mesh, solution)
    errors = interval_errors(plant, solution, run)
    if not max(errors) <= SETTINGS.resolved:
        words = f"its states do not follow from its inputs (by {max(errors):.2g} of nominal)"
        raise _contradiction(path, words)
    return left_as(program, solution)


def _require_solution(path: str, program: Program, solution: Solution) -> None:
    """The motion meets the problem's constraints."""
    w = program.completed(pack(program.problem, program.mesh, solution))
    nlp = program.nlp
    values = ca.Function("values", [nlp["x"], nlp["p"]], [nlp["g"]])
    g = np.asarray(values(w, program.parameters()), float).ravel()
    low, high = program.limits()
    missed = np.maximum(low - g, g - high)
    words = {"defect": "its states do not follow from its inputs", "closing": "its cycle is open"}
    for row, place in program.placed():
        own = missed[place]
        i = int(np.argmax(np.where(np.isnan(own), np.inf, own))) if row.size else 0
        if row.size and not own[i] <= AGREE:
            condition = row.condition(i)
            label = condition.label if condition else row.label
            what = words.get(row.kind, f"its motion does not keep {label}")
            raise _contradiction(path, f"{what} (by {own[i]:.2g} of nominal)")
    least, most = program.bounds()
    if not np.max(np.maximum(least - w, w - most), initial=0.0) <= AGREE:
        raise _contradiction(path, "its motion does not keep the bounds of its variables")


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """(meta data, arrays) of a file."""
    meta, arrays = read_npz(path, "a plan file")
    if meta.get("format") in FORMER:
        raise InputError(
            f"{path} was written by a former version, which did not keep what was asked for in "
            "words that can be judged: Trajectory.load(path) reads its motion, to simulate or to "
            "compare; for a verdict plan anew"
        )
    remedy = f"save one of this version ({FORMAT}) by plan.save(...)"
    return require_format(path, meta, "a plan file", FORMAT, remedy), arrays

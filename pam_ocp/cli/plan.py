"""The command ``pam-ocp plan``: a planning problem as a file, solved, checked and drawn."""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, PlanError, PlanWarning
from ..core.progress import heard, working
from .options import add_allow_code, require_places
from .output import add_json, tell, wrote

if TYPE_CHECKING:
    from ..planning.result import Plan

EPILOG = """\
A problem file (TOML). Values are numbers in SI, or texts with a unit; plain keys come first:

  cyclic = true                     # or false, or "mirrored" (second half by symmetry)
  minimise = { time = 1.0, effort = 1e-4 }   # or one term, as "time"
  duration = { min = "20 ms", max = "1 s" }  # of each leg; or "0.2 s", "free", or a list
  tolerance = 1e-6                  # of the verdict (1e-3): the mesh is refined until it is met
  starts = 1                        # how many starts (4 with a tendon, 2 with valves, else 1)

  [plant]
  arrangement = "AntagonisticSlide" # HangingLoad, AntagonisticJoint, ..., or FILE.py:NAME
                                    # (which runs FILE.py: only with --allow-code)
  muscle = "DMSP-20-200N"           # see 'pam-ocp muscles'; or a muscle file (.toml, .json)
  mass = "2 kg"
  pre_contraction = "10 %"
  feed = { kind = "Regulator", lag = "50 ms", max_pressure = "6 bar", max_rate = "40 bar/s" }

  [[stops]]                         # at least two; the motion rests there
  x = "-15 mm"

  [[stops]]
  x = "15 mm"
  dwell = "0.1 s"                   # or rest = false for a via point

  [bounds]                          # "name" = [low, high] or { min = ..., max = ... }
  "muscle1.force" = { min = "20 N" }

Further keys: rest, phases, constraints, track, budgets, design, integrand, final, method, options;
docs/problem_files.md lists them.

Exit code: 0 verified plan (the solver converged, an independent integration agrees, and limits are
kept between the points, too), 1 no plan (the message names the constraints in conflict), 2 invalid
file, 3 plan not verified (its first line names the criterion; files are written), 130 interrupted,
143 terminated. --time-limit ends the search; the best plan so far is then not verified (3).
"""


def add_plan(commands: Any) -> None:
    """Add the command to the parser's commands."""
    plan = commands.add_parser(
        "plan",
        help="plan an optimal motion from a problem file",
        description="Plan the optimal motion that a problem file asks for, check it by a tight "
        "independent integration, and print how far to trust it.",
        epilog=EPILOG,
    )
    plan.add_argument("problem", type=Path, metavar="FILE.toml", help="the problem, see below")
    for option, ending, words in (
        (
            "--out",
            "npz",
            "write the plan itself, with its motion (load_plan and all commands read it)",
        ),
        ("--excel", "xlsx", "write a workbook: verdict, motion, charts"),
        (
            "--csv",
            "csv",
            "write the motion as a table: states, inputs and outputs over time, in SI",
        ),
        ("--plot", "png", "draw the motion, with limits, stops and active constraints"),
        ("--animate", "gif", "draw the plant moving"),
        ("--fmu-inputs", "csv", "write the inputs as a table that FMI tools replay"),
    ):
        plan.add_argument(option, type=Path, metavar=f"FILE.{ending}", help=words)
    add_allow_code(plan)
    plan.add_argument("--progress", action="store_true", help="show each iteration as it runs")
    plan.add_argument("--log", action="store_true", help="print the solver's iterations afterwards")
    plan.add_argument(
        "--explain",
        action="store_true",
        help="print what the search did, stage by stage: why, and how long it took",
    )
    add_json(plan)
    plan.set_defaults(run=_plan)


def _plan(options: argparse.Namespace) -> int:
    from ..planning.planner import plan
    from ..planning.problem.problem_file import load_problem

    _check_endings(options)
    plant, arguments = load_problem(options.problem, allow_code=options.allow_code)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PlanWarning)  # said below
            shown = heard() and not options.progress
            with working("plan") as bar:

                def told(number: int, objective: float, violation: float) -> None:
                    bar.step(note=f"objective {objective:.4g}, violation {violation:.1e}")

                arguments["progress"] = told if shown else options.progress
                found = plan(plant, **arguments, time_limit=options.time_limit)
    except InputError as error:
        raise InputError(f"{options.problem}: {error}") from error
    except PlanError as error:
        for asked, text in ((options.log, _log), (options.explain, _explained)):
            if asked and error.plan is not None:
                tell(options, text(error.plan))
        print(f"pam-ocp plan: {options.problem}: {error}", file=sys.stderr)
        return 1
    for asked, text in ((options.log, _log), (options.explain, _explained)):
        if asked:
            tell(options, text(found))
    tell(options, found, lambda: _data(found))
    for written in _written(found, options):
        wrote(options, written)
    if not found.verified:
        print(f"pam-ocp plan: {options.problem}: the plan is {found.verdict}", file=sys.stderr)
        return NOT_VERIFIED
    return 0


def _data(plan: Plan) -> dict[str, Any]:
    replay = plan.replay
    return {
        "verified": plan.verified,
        "verdict": str(plan.verdict),
        "duration": plan.duration,
        "durations": plan.durations,
        "objective": plan.objective,
        "design": plan.design,
        "replay_error": replay.error if replay else None,
        "violation": replay.violation if replay else None,
    }


NOT_VERIFIED = 3
"""Exit code."""

ENDINGS = {
    "out": (".npz",),
    "excel": (".xlsx",),
    "csv": (".csv",),
    "plot": (".png", ".pdf", ".svg"),
    "animate": (".gif",),
    "fmu_inputs": (".csv",),
}
"""What each option can write: asked before a long solve, not after it."""


def _check_endings(options: argparse.Namespace) -> None:
    for option, endings in ENDINGS.items():
        target: Path | None = getattr(options, option)
        if target is None:
            continue
        shown = f"--{option.replace('_', '-')} {target}"
        if target.suffix.lower() not in endings:
            raise InputError(f"{shown}: give a name that ends in {' or '.join(endings)}")
        require_places(target)


def _written(plan: Plan, options: argparse.Namespace) -> list[Path]:
    """Write all files asked for."""
    done: list[Path] = []
    if options.out:
        done.append(plan.save(options.out))
    if options.excel:
        done.append(plan.to_excel(options.excel))
    if options.csv:
        done.append(plan.trajectory.save(options.csv))
    if options.plot:
        from ..figures.saved import save_figure

        done.append(save_figure(plan.plot(), options.plot))
    if options.animate:
        from ..figures.film import animate_plan

        done.append(animate_plan(plan, options.animate))
    if options.fmu_inputs:
        from ..export import save_input_table

        done.append(save_input_table(plan.trajectory, options.fmu_inputs))
    return done


def _explained(plan: Plan) -> str:
    return plan.explain()


def _log(plan: Plan) -> str:
    """The solver's iterations as a table."""
    columns = {
        "obj": "objective",
        "inf_pr": "violation",
        "inf_du": "dual infeas.",
        "mu": "barrier",
        "alpha_pr": "step",
    }
    known = [c for c in columns if plan.log and c in plan.log[0]]
    lines = [f"{'iter':>5}" + "".join(f"{columns[c]:>15}" for c in known)]
    lines += [
        f"{i:>5}" + "".join(f"{entry[c]:>15.6g}" for c in known) for i, entry in enumerate(plan.log)
    ]
    return "\n".join(lines)

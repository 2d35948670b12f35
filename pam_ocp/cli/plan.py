"""The commands of motions: ``pam-ocp plan`` (a planning problem as a file, solved, checked, drawn)
and ``mpc`` (a closed loop of controller, estimator and a real side that differs).
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pam_ocp as pam

from ..core.errors import InputError, PlanError, PlanWarning
from ..core.files import read_toml, reading
from ..core.progress import heard, working
from .command import asked, command, count, file, flag, named, option, output, pairs, plot
from .options import ALLOW_CODE, from_here, require_motion_ending, require_no_own_muscle, written
from .output import deliver, picture, tell

if TYPE_CHECKING:
    from ..planning.result import Plan

NOT_VERIFIED = 3
"""Exit code."""
PROBLEM = """\
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


@command(
    "plan",
    "plan an optimal motion from a problem file",
    file("problem", "FILE.toml", "the problem, see below"),
    output(
        "--out",
        "FILE.npz",
        "write the plan itself, with its motion (load_plan and all commands read it)",
        ".npz",
    ),
    output("--excel", "FILE.xlsx", "write a workbook: verdict, motion, charts", ".xlsx"),
    output(
        "--csv",
        "FILE.csv",
        "write the motion as a table: states, inputs and outputs over time, in SI",
        ".csv",
    ),
    output(
        "--plot",
        "FILE.png",
        "draw the motion, with limits, stops and active constraints",
        *(".png", ".pdf", ".svg"),
    ),
    output("--animate", "FILE.gif", "draw the plant moving", ".gif"),
    output("--fmu-inputs", "FILE.csv", "write the inputs as a table that FMI tools replay", ".csv"),
    ALLOW_CODE,
    flag("--progress", "show each iteration as it runs"),
    flag("--log", "print the solver's iterations afterwards"),
    flag("--explain", "print what the search did, stage by stage: why, and how long it took"),
    about="Plan the optimal motion that a problem file asks for, check it by a tight "
    "independent integration, and print how far to trust it.",
    epilog=PROBLEM,
)
def _plan(options: argparse.Namespace) -> int:
    plant, arguments = pam.planning.load_problem(options.problem, allow_code=options.allow_code)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PlanWarning)  # said below
            shown = heard() and not options.progress
            with working("plan") as bar:

                def told(number: int, objective: float, violation: float) -> None:
                    bar.step(note=f"objective {objective:.4g}, violation {violation:.1e}")

                arguments["progress"] = told if shown else options.progress
                found = pam.plan(plant, **arguments, time_limit=options.time_limit)
    except InputError as error:
        raise InputError(f"{options.problem}: {error}") from error
    except PlanError as error:
        if error.plan is not None:
            _tell_search(error.plan, options)
        print(f"pam-ocp plan: {options.problem}: {error}", file=sys.stderr)
        return 1
    _tell_search(found, options)
    tell(options, found, lambda: _plan_data(found))
    motion = found.trajectory
    deliver(
        options,
        out=found.save,
        excel=found.to_excel,
        csv=motion.save,
        plot=picture(found.plot),
        animate=lambda path: pam.figures.animate_plan(found, path),
        fmu_inputs=lambda path: pam.export.save_input_table(motion, path),
    )
    if not found.verified:
        print(f"pam-ocp plan: {options.problem}: the plan is {found.verdict}", file=sys.stderr)
        return NOT_VERIFIED
    return 0


def _tell_search(plan: Plan, options: argparse.Namespace) -> None:
    """The solver's iterations, and the search stage by stage, where they are asked for."""
    if options.log:
        tell(options, _log(plan))
    if options.explain:
        tell(options, plan.explain())


def _plan_data(plan: Plan) -> dict[str, Any]:
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


# ---- mpc -----------------------------------------------------------------------------------------
LOOP = """\
A problem file (TOML), every key optional. Values are numbers in SI, or texts with a unit; plain
keys come first:

  against = "fmu"                         # "plant", "fmu", or the path of an FMU
  duration = "2 s"
  real = { mass = "2.6 kg" }              # what differs in the true plant
  start = { x = 0.0, stiffness = 2e4 }    # initial equilibrium
  noise = { x = "0.02 mm" }              # standard deviations; default: what the estimator expects

  sensors = { x = { delay = "4 ms", resolution = "0.01 mm", filter = "2 ms" } }

  [plant]                                 # as for 'pam-ocp plan', or a name: plant = "hanging_load"
  arrangement = "AntagonisticSlide"
  muscle = "DMSP-20-200N"
  mass = "2 kg"

  [reference]                             # a value, or stops that are each held for a time
  x = { stops = ["10 mm", "-10 mm"], dwell = "0.4 s", rest = 0.0, rest_from = "1.2 s" }
  stiffness = 2e4

  [controller]                            # and arguments of its class
  kind = "mpc"
  sample_time = 0.005
  horizon = 40
  delay = 1
  track = { x = 1.0, stiffness = 0.05 }

  [estimator]                             # and arguments of its class
  kind = "kalman"                         # "kalman", "moving-horizon" or "none"
  unknown = { mass = [0.5, 0.05] }        # initial deviation, drift per square root of a second

  [disturbances]                          # unknown to the controller; [value, start time]
  push = ["40 N", "1 s"]

The report has the number of steps without a solution ("failed") and with one that had not
converged, the error of predictions compared with a finer integration of the model, and the verdict:
set points reached, limits kept, solver converged, predictions accurate.

Exit code: 0, or 1 if a step had no solution, 2 for an invalid file or option.
"""


@command(
    "mpc",
    "model predictive control in closed loop",
    option(
        "problem",
        "PROBLEM",
        "a problem file (.toml), or a plant as in 'export' (default: antagonistic_slide)",
        nargs="?",
    ),
    option("--muscle", "MUSCLE", "name in the catalogue, or a muscle file"),
    *(
        named(f"--{name}", f"{meaning}; SI without a unit")
        for name, meaning in (
            ("set", "value of the model's parameter or start value"),
            ("real", "value on the real side that the controller is not told, as in mass='2.6 kg'"),
        )
    ),
    option("--against", "SIDE", "plant, fmu, or FILE.fmu (default: plant)"),
    option("--estimator", "KIND", "kind of estimator (default: kalman)"),
    option("--duration", "S", "such as '500 ms'; seconds without unit"),
    count("--seed", None, "of the noise (default: 0)"),
    output("--out", "FILE", "write the loop (.npz), or its motion (.csv, .parquet, .xlsx)"),
    plot("draw the run"),
    ALLOW_CODE,
    about="Run model predictive control with an estimator against a plant, or its FMU, whose "
    "load differs; print step times, steady error and what was found.",
    epilog=LOOP,
)
def _mpc(options: argparse.Namespace) -> int:
    from ..studies.problem import loop_text, loop_title, run_loop

    require_motion_ending(options.out)
    study = _study(options)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="closed loop: ")  # the report has the verdict
        loop = run_loop(study)
    tell(options, loop_text(study, loop), lambda: _loop_data(study, loop))

    def save(path: Path) -> Path:
        return loop.save(path) if path.suffix.lower() == ".npz" else written(loop.trajectory, path)

    deliver(options, out=save, plot=picture(lambda: loop.plot(loop_title(study)), dpi=120))
    return 1 if loop.statistics and loop.statistics.failures else 0


def _loop_data(study: Any, loop: Any) -> dict[str, Any]:
    from ..studies.problem import window_of

    window = window_of(study)
    names = loop.reference.names if loop.reference else ()
    return {
        "duration": loop.trajectory.duration,
        "failures": loop.statistics.failures if loop.statistics else 0,
        "prediction_error": loop.prediction_error,
        "verdict": {"as_asked": bool(loop.verdict), "words": str(loop.verdict)},
        "steady_error": {n: loop.steady_error(n, window) for n in names},
        "last": loop.trajectory.row(-1),
    }


def _study(options: argparse.Namespace) -> dict[str, Any]:
    """DEFAULTS, what the problem file says over them, and what the command line says over that."""
    from ..studies.file_kinds import require_role
    from ..studies.problem import guarded, loop_settings, require_spans

    study = loop_settings("", {})
    if options.problem:
        require_role(options.problem, "plant")
    if options.problem and options.problem.endswith(".toml"):
        with reading(options.problem, "a problem file", "'pam-ocp mpc --help' shows one"):
            said = read_toml(options.problem)
            if "stops" in said:  # a problem of 'pam-ocp plan': its plant alone
                said = {"plant": said.get("plant")}
            study = loop_settings(options.problem, said)
        study["folder"] = Path(options.problem).parent
    elif options.problem:
        require_no_own_muscle(options.problem, options.muscle)
        study["plant"] = options.problem
    study |= {"file": options.problem, "allow_code": options.allow_code}
    study |= asked(options, "muscle", "against", "duration", "seed")
    if options.muscle and isinstance(study["plant"], Mapping):
        study["plant"] = {**study["plant"], "muscle": from_here(options.muscle)}
    if str(study["against"]).endswith(".fmu") and options.against is None:
        from ..plants.plant_file import require_allowed

        what = f"against = {study['against']!r} would run the machine code of that FMU"
        require_allowed(what, options.allow_code)
    for name in ("set", "real"):
        study[name] = {**study[name], **pairs(f"--{name}", getattr(options, name))}
    if options.estimator is not None:
        study["estimator"] = {**study["estimator"], "kind": options.estimator}
    with guarded(study):
        require_spans(study)
    return study

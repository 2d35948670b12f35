"""The command ``pam-ocp mpc``: a closed loop of controller,
estimator and a real side that differs.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path
from typing import Any

from ..core.files import read_toml, reading
from .options import (
    add_allow_code,
    add_out,
    add_pairs,
    add_plot,
    pairs,
    require_motion_ending,
    require_places,
    whole,
    written,
)
from .output import add_json, tell, wrote

EPILOG = """\
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


def add_mpc(commands: Any) -> None:
    """Add the command to the parser's commands."""
    mpc = commands.add_parser(
        "mpc",
        help="model predictive control in closed loop",
        description="Run model predictive control with an estimator against a plant, or its FMU, "
        "whose "
        "load differs; print step times, steady error and what was found.",
        epilog=EPILOG,
    )
    mpc.add_argument(
        "problem",
        nargs="?",
        metavar="PROBLEM",
        help="a problem file (.toml), or a plant as in 'export' (default: antagonistic_slide)",
    )
    mpc.add_argument("--muscle", metavar="MUSCLE", help="name in the catalogue, or a muscle file")
    for name, meaning in (
        ("set", "value of the model's parameter or start value"),
        ("real", "value on the real side that the controller is not told, as in mass='2.6 kg'"),
    ):
        add_pairs(mpc, f"--{name}", f"{meaning}; SI without a unit")
    mpc.add_argument("--against", metavar="SIDE", help="plant, fmu, or FILE.fmu (default: plant)")
    mpc.add_argument("--estimator", metavar="KIND", help="kind of estimator (default: kalman)")
    mpc.add_argument("--duration", metavar="S", help="such as '500 ms'; seconds without unit")
    mpc.add_argument("--seed", type=whole, help="of the noise (default: 0)")
    add_out(mpc, "FILE", "write the loop (.npz), or its motion (.csv, .parquet, .xlsx)")
    add_plot(mpc, "draw the run")
    add_allow_code(mpc)
    add_json(mpc)
    mpc.set_defaults(run=_mpc)


def _mpc(options: argparse.Namespace) -> int:
    from ..studies.loop_problem import loop_text, loop_title, run_loop

    require_motion_ending(options.out)
    require_places(options.out, options.plot)
    study = _study(options)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="closed loop: ")  # the report has the verdict
        loop = run_loop(study)
    tell(options, loop_text(study, loop), lambda: _data(study, loop))
    if options.out:
        whole = options.out.suffix.lower() == ".npz"
        target = loop.save(options.out) if whole else written(loop.trajectory, options.out)
        wrote(options, target)
    if options.plot:
        from ..figures.saved import save_figure

        wrote(options, save_figure(loop.plot(loop_title(study)), options.plot, dpi=120))
    return 1 if loop.statistics and loop.statistics.failures else 0


def _data(study: Any, loop: Any) -> dict[str, Any]:
    from ..studies.loop_problem import window_of

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
    from ..studies.loop_problem import guarded, loop_settings, require_spans

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
        study["plant"] = options.problem
    study |= {"file": options.problem, "allow_code": options.allow_code}
    for name in ("muscle", "against", "duration", "seed"):
        if getattr(options, name) is not None:
            study[name] = getattr(options, name)
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

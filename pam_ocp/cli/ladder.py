"""The command ``pam-ocp ladder``: which model do these records ask for?"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any

from ..core.errors import FitError, InputError
from ..core.files import read_toml
from ..core.quantities import known_keys
from ..plants.plant import Plant
from ..studies.plant_fit_problem import bounds_of, listed, records_of
from .options import add_allow_code, whole
from .output import add_json, tell

__all__ = ["add_ladder"]

EPILOG = """\
The candidates are fitted to all records, and compared by their predictions of parts left out; the
simplest that is not significantly worse than the best is marked with *.

The study file (TOML) is that of 'pam-ocp fit-plant'. Its [plant] has the arrangement and the
regulator's start values, without the effects that candidates add (dead time, slew limit, losses):

  records = ["run1.csv", "run2.csv"]      # each begins at rest
  free = ["base_pressure", "muscle*.gain"]   # in every candidate
  dynamic = ["damping", "mass"]           # from the second on; default: the damping

  [plant]
  arrangement = "AntagonisticSlide"       # or "FILE.py:NAME": (muscle, feed=, losses=)
  muscle = "DMSP-20-200N"
  mass = "2 kg"
  feed = { kind = "PairRegulator", base = "2.5 bar", gain = "1 bar/V", lag = "50 ms" }

Exit code: 0, or 1 if no candidate could be fitted, 2 for an invalid file or option.
"""
_KEYS = (
    "plant",
    "records",
    "free",
    "dynamic",
    "outputs",
    "bounds",
    "rungs",
    "folds",
    "columns",
    "units",
    "time",
    "interpolation",
    "max_gap",
    "split",
)


def add_ladder(commands: Any) -> None:
    """Add the command to the parser's commands."""
    ladder = commands.add_parser(
        "ladder",
        help="select a model for records: static, or with lag, friction, hysteresis, creep",
        description="Compare nested models (static, + lag, + unequal lags, + dead time, "
        "+ slew limit, + friction, + memory, + memory per pressure, + force law, + creep) by "
        "their predictions of parts of the records that were left out.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    ladder.add_argument("study", metavar="FILE.toml", help="plant and records; see below")
    ladder.add_argument(
        "records", nargs="*", type=Path, metavar="RECORD", help="instead of those in the study file"
    )
    ladder.add_argument(
        "--free", nargs="+", metavar="NAME", help="parameters fitted in every candidate"
    )
    ladder.add_argument(
        "--dynamic",
        nargs="+",
        metavar="NAME",
        help="parameters fitted from the second candidate on",
    )
    ladder.add_argument(
        "--rungs", nargs="+", metavar="RUNG", help="only these, such as 'dead time'"
    )
    ladder.add_argument("--outputs", nargs="+", metavar="NAME", help="compare only these")
    ladder.add_argument("--folds", type=whole, metavar="N", help="of parts left out (default 5)")
    ladder.add_argument("--jobs", type=whole, default=1, metavar="N", help="processes (default 1)")
    add_allow_code(ladder)
    add_json(ladder)
    ladder.set_defaults(run=_ladder)


def _said(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _data(found: Any) -> dict[str, Any]:
    return {
        "chosen": found.chosen.name,
        "warnings": found.warnings,
        "rungs": {
            r.name: {
                "rmse": r.rmse,
                "worse": r.worse,
                "failure": r.failure,
                "parameters": {n: c.value for n, c in r.coefficients.items()},
            }
            for r in found.rungs
        },
    }


def _ladder(options: argparse.Namespace) -> int:
    from ..fitting.dynamic.ladder import fit_ladder
    from ..plants.plant_file import builder_of

    study: dict[str, Any] = read_toml(options.study)
    known_keys(options.study, study, _KEYS)
    folder = Path(options.study).parent
    described = study.get("plant")
    if not isinstance(described, Mapping):
        raise InputError(f"{options.study} has no [plant] table: say what the ladder is built on")
    build, feed = builder_of(described, "plant", folder, allow_code=options.allow_code)
    for name in ("free", "dynamic", "rungs", "outputs", "folds"):
        if getattr(options, name) is not None:
            study[name] = getattr(options, name)
    beside = [folder / n for n in listed("records", study.get("records", []))]
    try:
        plant: Plant = build(feed=feed, losses=())
    except TypeError as error:
        raise InputError(
            f"{options.study}: the arrangement is called with muscle, feed= and losses= on every "
            f"rung; {error}"
        ) from error
    records = records_of(study, plant, options.records or beside)
    if not records:
        raise InputError("no record: give files, or records = [...] in the study file")
    given: dict[str, Any] = {
        n: listed(n, study[n]) for n in ("dynamic", "rungs", "outputs") if n in study
    }
    if "bounds" in study:
        given["bounds"] = bounds_of(study, plant)
    pool = ProcessPoolExecutor(options.jobs) if options.jobs > 1 else None
    with pool or nullcontext():
        try:
            found = fit_ladder(
                build,
                records,
                listed("free", study.get("free", [])),
                feed=feed,
                folds=study.get("folds", 5),
                executor=pool,
                progress=None if options.quiet else _said,
                time_limit=options.time_limit,
                **given,
            )
        except FitError as error:
            print(f"pam-ocp ladder: {error}", file=sys.stderr)
            return 1
    tell(options, found.report(), lambda: _data(found))
    return 0

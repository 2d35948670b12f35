"""``pam-ocp quick``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .options import add_diameter, add_rest_length, length_of
from .output import add_json, tell
from .reading import add_floor, add_reading, reading_options

__all__ = ["add_quick"]


def add_quick(commands: Any) -> None:
    """Add ``quick`` to the parser's commands."""
    quick = commands.add_parser(
        "quick",
        help="one page from one file: law, plant, motion, FMU, report, workbook",
        description="From a measured table to one page: read it, rank the force laws, build a "
        "plant, plan its quickest motion, linearise it, write an FMU, a report "
        "and a workbook. Assumptions are printed, each with the option that "
        "changes it.",
    )
    quick.add_argument("table", metavar="TABLE", help="as for 'pam-ocp fit'")
    quick.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for all files (default: TABLE's name)"
    )
    add_rest_length(quick, " (needed unless the table holds contractions)")
    add_diameter(quick)
    quick.add_argument(
        "--law", action="append", metavar="LAW", help="one law, or several to rank (default: all)"
    )
    quick.add_argument(
        "--counterforce",
        choices=("pair", "load"),
        default="pair",
        help="a second muscle on a slide (default), or a hanging weight",
    )
    quick.add_argument("--mass", metavar="KG", help="moving mass (default: from the force)")
    quick.add_argument("--stops", nargs=2, metavar="M", help="of the motion, as -10mm 10mm")
    quick.add_argument(
        "--platforms", nargs="+", default=["native"], metavar="NAME", help="of the FMU"
    )
    quick.add_argument(
        "--force", dest="overwrite", action="store_true", help="overwrite existing files"
    )
    add_reading(quick)
    add_floor(quick)
    add_json(quick)
    quick.set_defaults(run=_quick)


def _quick(options: argparse.Namespace) -> int:
    from ..studies.from_table import quick

    made = quick(
        options.table,
        options.out or Path(Path(options.table).stem),
        rest_length=length_of("--rest-length", options.rest_length),
        diameter=length_of("--diameter", options.diameter),
        law=options.law,
        counterforce=options.counterforce,
        mass=options.mass,
        stops=options.stops,
        platforms=options.platforms,
        overwrite=options.overwrite,
        **reading_options(options),
    )
    tell(
        options,
        made.report(),
        lambda: {
            "law": made.fit.law.name,
            "rmse": made.fit.rmse,
            "verified": made.plan is not None and made.plan.verified,
            "assumptions": dict(made.assumptions),
            "doubts": list(made.doubts),
            "files": {what: str(path) for what, path in made.files.items()},
        },
    )
    return 0

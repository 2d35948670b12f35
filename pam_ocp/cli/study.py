"""The commands of whole studies: ``pam-ocp tour``, ``study``, ``quick`` and ``report``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .options import (
    add_allow_code,
    add_diameter,
    add_out,
    add_rest_length,
    length_of,
    require_places,
    whole,
)
from .output import add_json, tell, wrote
from .reading import add_floor, add_reading, reading_options

PATIENCE = 10.0
"""For a scheduler to answer [s]."""
EPILOG = """\
A study file (TOML) names its steps; a key whose value is the name of another step takes what that
one makes:

  title = "Two muscles move a slide"

  [steps.static]
  kind = "table"
  file = "DMSP-20-300_static.csv"
  rest_length = "300 mm"

  [steps.law]
  kind = "fit"
  table = "static"                        # the step above

  [steps.slide]
  kind = "plant"
  arrangement = "AntagonisticSlide"
  muscle = "law"
  mass = "2 kg"

  [steps.quickest]
  kind = "plan"                           # keys as for 'pam-ocp plan'
  plant = "slide"
  stops = [{ x = "-15 mm" }, { x = "15 mm" }]

'pam-ocp components study-step' lists kinds and keys; docs/studies.md explains studies.

Exit code: 0 if every step and every verdict succeeded, 1 otherwise, 2 for an invalid file (checked
before anything runs).
"""


def add_tour(commands: Any) -> None:
    """Add ``tour`` to the parser's commands."""
    tour = commands.add_parser("tour", help="the whole chain on a bundled measured muscle")
    tour.add_argument(
        "--out",
        type=Path,
        default=Path("tour"),
        metavar="DIR",
        help="folder for the results (default: tour)",
    )
    add_json(tour)
    tour.set_defaults(run=_tour)


def add_study(commands: Any) -> None:
    """Add ``study`` to the parser's commands."""
    study = commands.add_parser(
        "study",
        help="run a study file: data, fits, plants, plans, FMUs, sweeps; one folder, one report",
        description="Run the steps of a study file in their order; unchanged results of "
        "earlier runs, even interrupted ones, are reused. Writes figures, tables, "
        "parameter files, FMUs and report.html into one folder.",
        epilog=EPILOG,
    )
    study.add_argument("study", type=Path, metavar="FILE.toml", help="the study; see below")
    add_out(study, "DIR", "folder for the results (default: named as the file)")
    study.add_argument(
        "--workers", type=whole, default=1, metavar="N", help="processes (default: 1, this one)"
    )
    study.add_argument("--scheduler", metavar="ADDRESS", help="of Dask, as tcp://host:8786")
    study.add_argument(
        "--shard", metavar="K/N", help="run the K-th of N shares of the steps, for a job array"
    )
    study.add_argument(
        "--merge", action="store_true", help="merge the results of all shards, and write the report"
    )
    study.add_argument("--fresh", action="store_true", help="recompute everything")
    study.add_argument(
        "--cache",
        type=Path,
        metavar="DIR",
        help="of cached results (only your own: they are pickles)",
    )
    add_allow_code(study)
    add_json(study)
    study.set_defaults(run=_study)


def _study(options: argparse.Namespace) -> int:
    from ..studies.study import run_study

    with _executor(options.scheduler) as executor:
        found = run_study(
            options.study,
            options.out,
            workers=options.workers,
            executor=executor,
            allow_code=options.allow_code,
            fresh=options.fresh,
            cache=options.cache,
            shard=options.shard,
            merge=options.merge,
        )
    steps = {
        n: {"kind": s.kind, "state": s.state, "verdict": s.verdict, "good": s.good}
        | {"numbers": {k: v for k, (v, _) in s.numbers.items()}}
        for n, s in found.steps.items()
    }
    tell(options, found, {"title": found.title, "ok": found.ok, "steps": steps})
    if options.shard is None:
        wrote(options, found.report)
    return 0 if found.ok else 1


@contextmanager
def _executor(address: str | None) -> Iterator[Any]:
    """Dask's workers at an address; None for none."""
    if address is None:
        yield None
        return
    from ..core.errors import InputError

    try:
        import distributed
    except ImportError:
        raise InputError("--scheduler needs Dask: pip install 'pam_ocp[studies]'") from None
    try:
        client: Any = distributed.Client(address, timeout=PATIENCE)  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: no scheduler answers there ({error})") from None
    with client:
        yield client.get_executor()


def _tour(options: argparse.Namespace) -> int:
    from ..studies.tour import tour

    summary = tour(options.out, say=lambda text: tell(options, text))
    tell(options, "", lambda: summary) if options.json else None
    return 0


# ---- quick ---------------------------------------------------------------------------------------
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


# ---- report --------------------------------------------------------------------------------------
def add_report(commands: Any) -> None:
    """The command ``report``."""
    report = commands.add_parser(
        "report",
        help="one HTML page on muscles, fits, motions and closed loops in files",
        description="Show files of any command as one HTML page: muscles, fits, plans (judged "
        "again), motions, closed loops, linear models, plants, FMUs (checked), "
        "and records.",
    )
    report.add_argument("files", nargs="+", type=Path, metavar="FILE")
    report.add_argument(
        "--out", type=Path, default=Path("report.html"), metavar="FILE.html", help="report.html"
    )
    report.add_argument("--title", default="Report", metavar="TEXT")
    report.add_argument("--text", default="", metavar="TEXT", help="an introduction")
    report.add_argument(
        "--crate", type=Path, metavar="FILE.zip", help="also write an RO-Crate (needs --licence)"
    )
    report.add_argument("--licence", metavar="ID", help="of the crate, as CC-BY-4.0")
    report.add_argument("--author", metavar="NAME", help="of the crate")
    add_json(report)
    report.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> int:
    from ..figures.crate import save_crate
    from ..figures.report import write_report
    from ..studies.file_kinds import load

    require_places(options.out, options.crate)
    names = [
        str(f) if len({g.name for g in options.files}) < len(options.files) else f.name
        for f in options.files
    ]
    things = {n: load(f) for n, f in zip(names, options.files, strict=True)}
    made = {"title": options.title, "text": options.text, "sources": options.files}
    if options.crate is not None:  # first, as it may refuse its licence
        own = {"licence": options.licence, "author": options.author}
        wrote(options, save_crate(options.crate, things, **made, **own))
    wrote(options, write_report(options.out, things, **made))
    return 0

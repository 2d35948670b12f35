"""The commands of whole studies: ``pam-ocp tour``, ``study``, ``quick`` and ``report``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pam_ocp as pam

from .command import choice, command, count, file, flag, option, output, repeated, several
from .options import ALLOW_CODE, DIAMETER, FLOOR, READING, length_of, reading_options, rest_length
from .output import tell, wrote

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


@command(
    "tour",
    "the whole chain on a bundled measured muscle",
    file("--out", "DIR", "folder for the results (default: tour)", default=Path("tour")),
)
def _tour(options: argparse.Namespace) -> int:
    from ..studies.tour import tour

    summary = tour(options.out, say=lambda text: tell(options, text))
    tell(options, "", lambda: summary) if options.json else None
    return 0


@command(
    "study",
    "run a study file: data, fits, plants, plans, FMUs, sweeps; one folder, one report",
    file("study", "FILE.toml", "the study; see below"),
    file("--out", "DIR", "folder for the results (default: named as the file)"),
    count("--workers", "N", "processes (default: 1, this one)", default=1),
    option("--scheduler", "ADDRESS", "of Dask, as tcp://host:8786"),
    option("--shard", "K/N", "run the K-th of N shares of the steps, for a job array"),
    flag("--merge", "merge the results of all shards, and write the report"),
    flag("--fresh", "recompute everything"),
    file("--cache", "DIR", "of cached results (only your own: they are pickles)"),
    ALLOW_CODE,
    about="Run the steps of a study file in their order; unchanged results of "
    "earlier runs, even interrupted ones, are reused. Writes figures, tables, "
    "parameter files, FMUs and report.html into one folder.",
    epilog=EPILOG,
)
def _study(options: argparse.Namespace) -> int:
    with _executor(options.scheduler) as executor:
        found = pam.studies.run_study(
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


@command(
    "quick",
    "one page from one file: law, plant, motion, FMU, report, workbook",
    option("table", "TABLE", "as for 'pam-ocp fit'"),
    file("--out", "DIR", "folder for all files (default: TABLE's name)"),
    rest_length(" (needed unless the table holds contractions)"),
    DIAMETER,
    repeated("--law", "LAW", "one law, or several to rank (default: all)"),
    choice(
        "--counterforce",
        ("pair", "load"),
        "a second muscle on a slide (default), or a hanging weight",
        default="pair",
    ),
    option("--mass", "KG", "moving mass (default: from the force)"),
    option("--stops", "M", "of the motion, as -10mm 10mm", nargs=2),
    several("--platforms", "NAME", "of the FMU", default=["native"]),
    flag("--force", "overwrite existing files", dest="overwrite"),
    *READING,
    FLOOR,
    about="From a measured table to one page: read it, rank the force laws, build a "
    "plant, plan its quickest motion, linearise it, write an FMU, a report "
    "and a workbook. Assumptions are printed, each with the option that "
    "changes it.",
)
def _quick(options: argparse.Namespace) -> int:
    made = pam.studies.quick(
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


@command(
    "report",
    "one HTML page on muscles, fits, motions and closed loops in files",
    several("files", "FILE", type=Path),
    output("--out", "FILE.html", "report.html", default=Path("report.html")),
    option("--title", "TEXT", default="Report"),
    option("--text", "TEXT", "an introduction", default=""),
    output("--crate", "FILE.zip", "also write an RO-Crate (needs --licence)"),
    option("--licence", "ID", "of the crate, as CC-BY-4.0"),
    option("--author", "NAME", "of the crate"),
    about="Show files of any command as one HTML page: muscles, fits, plans (judged "
    "again), motions, closed loops, linear models, plants, FMUs (checked), "
    "and records.",
)
def _report(options: argparse.Namespace) -> int:
    names = [
        str(f) if len({g.name for g in options.files}) < len(options.files) else f.name
        for f in options.files
    ]
    things = {n: pam.load(f) for n, f in zip(names, options.files, strict=True)}
    made = {"title": options.title, "text": options.text, "sources": options.files}
    if options.crate is not None:  # first, as it may refuse its licence
        own = {"licence": options.licence, "author": options.author}
        wrote(options, pam.figures.save_crate(options.crate, things, **made, **own))
    wrote(options, pam.figures.write_report(options.out, things, **made))
    return 0

"""``pam-ocp report``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .options import require_places
from .output import add_json, wrote

__all__ = ["add_report"]


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

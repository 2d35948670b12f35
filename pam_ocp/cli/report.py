"""``pam-ocp report``."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from .options import require_places
from .output import add_json, wrote

__all__ = ["add_report"]


def add_report(commands: Any) -> None:
    """The command ``report``."""
    report = commands.add_parser(
        "report",
        help="one HTML page on muscles, fits, motions and closed loops in files",
        description="Show files as one HTML page: muscle files (.toml, .json), force fits (.json), "
        "trajectories (.csv, .npz, .parquet), closed loops (.npz), FMUs (checked). A plan that "
        "'pam-ocp plan --out' wrote is shown by its motion.",
    )
    report.add_argument("files", nargs="+", type=Path, metavar="FILE")
    report.add_argument(
        "--out", type=Path, default=Path("report.html"), metavar="FILE.html", help="report.html"
    )
    report.add_argument("--title", default="Report", metavar="TEXT")
    report.add_argument("--text", default="", metavar="TEXT", help="an introduction")
    add_json(report)
    report.set_defaults(run=_report)


def _report(options: argparse.Namespace) -> int:
    from ..figures.report import write_report

    require_places(options.out)
    names = [
        str(f) if len({g.name for g in options.files}) < len(options.files) else f.name
        for f in options.files
    ]
    things = {n: _shown(f) for n, f in zip(names, options.files, strict=True)}
    made = {"title": options.title, "text": options.text, "sources": options.files}
    wrote(options, write_report(options.out, things, **made))
    return 0


def _shown(path: Path) -> Any:
    """What stands in a file, whichever kind of ours it is."""
    from ..control.loop import ClosedLoop
    from ..core.files import require_file
    from ..core.trajectory import Trajectory
    from ..export import check_fmu
    from ..fitting.static.force_fit import ForceFit
    from ..muscles.muscle_file import load_muscle

    readers: dict[str, tuple[Callable[[Any], Any], ...]] = {
        ".toml": (load_muscle,),
        ".json": (load_muscle, ForceFit.from_json),
        ".npz": (ClosedLoop.load, Trajectory.load),
        ".csv": (Trajectory.load,),
        ".parquet": (Trajectory.load,),
        ".fmu": (check_fmu,),
    }
    require_file(path)
    refused = []
    for read in readers.get(path.suffix.lower(), ()):
        try:
            return read(path)
        except InputError as error:
            refused.append(str(error))
    if not refused:
        raise InputError(f"{path}: a report shows files that end in {', '.join(readers)}")
    raise InputError("; or ".join(refused))

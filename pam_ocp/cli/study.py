"""The commands of whole studies: ``pam-ocp tour`` and ``study``."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .options import add_allow_code, add_out, whole
from .output import add_json, tell, wrote

__all__ = ["add_study", "add_tour"]

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
        formatter_class=argparse.RawDescriptionHelpFormatter,
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

"""The commands of FMUs: ``pam-ocp export`` and ``check``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .options import require_places
from .output import add_json, tell, wrote
from .plants import add_plant, plant_said
from .systems import EPILOG, is_system, write_system

__all__ = ["add_check", "add_export"]


def add_export(commands: Any) -> None:
    """Add ``export`` to the parser's commands."""
    export = commands.add_parser(
        "export",
        help="export a plant as an FMU, a system as an SSP",
        description="Export a plant as an FMU for Model Exchange and Co-Simulation, or a system "
        "file as an SSP of such units.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_plant(export)
    export.add_argument(
        "--fmi",
        choices=("2.0", "3.0"),
        help="version of the standard (default: 2.0, which every tool reads)",
    )
    export.add_argument(
        "--platform",
        action="append",
        metavar="NAME",
        help="native, or a platform by name (may be repeated; default: the usual five; on request "
        "x86-linux, x86-windows, aarch64-windows)",
    )
    for kind, rest in (("input", "tunable parameters"), ("output", "local variables")):
        export.add_argument(
            f"--{kind}",
            action="append",
            metavar="NAME",
            help=f"{kind} that the FMU shows (may be repeated; default: all; the rest become "
            f"{rest})",
        )
    export.add_argument("--out", type=Path, metavar="FILE", help="default: PLANT.fmu or SYSTEM.ssp")
    add_json(export)
    export.set_defaults(run=_export)


def add_check(commands: Any) -> None:
    """Add ``check`` to the parser's commands."""
    check = commands.add_parser(
        "check",
        help="check an FMU",
        description="Validate an FMU and run it by fmpy. Exit code 0 when nothing is found, 1 "
        "otherwise.",
    )
    check.add_argument("fmu", type=Path, metavar="FMU")
    check.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help="trajectory or plan (.npz, .parquet, .csv) whose inputs are replayed and whose "
        "outputs are compared",
    )
    check.add_argument(
        "--time-limit",
        type=float,
        default=60.0,
        metavar="S",
        help="stop the FMU after so many seconds, which is a finding (default 60)",
    )
    add_json(check)
    check.set_defaults(run=_check)


def _export(options: argparse.Namespace) -> int:
    from ..export import export_fmu

    target: Path | None = options.out
    require_places(target)
    if is_system(options.plant):
        given = (options.fmi, options.platform, options.allow_code)
        wrote(options, write_system(options.plant, target, *given))
        return 0
    plant = plant_said(options)
    target = target or Path(f"{plant.name}.fmu")
    chosen = {"inputs": options.input, "outputs": options.output}
    fmu = export_fmu(plant, target, fmi=options.fmi or "2.0", platforms=options.platform, **chosen)
    wrote(options, fmu)
    return 0


def _check(options: argparse.Namespace) -> int:
    from ..core.trajectory import Trajectory
    from ..export import check_fmu

    reference = Trajectory.load(options.against) if options.against else None
    result = check_fmu(options.fmu, against=reference, time_limit=options.time_limit)
    tell(options, result, result.to_dict)
    return 0 if result.ok else 1

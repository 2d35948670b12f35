"""The commands of FMUs: ``pam-ocp export`` and ``check``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ..core.errors import InputError
from ..core.files import read_toml, reading
from ..core.quantities import known_keys, quantity, table
from .options import add_plant, number, plant_said, require_places
from .output import add_json, tell, wrote

if TYPE_CHECKING:
    from ..core.trajectory import Trajectory

EPILOG = """\
A system file (TOML) with a table [connections] is written as SSP:

  stop_time = "2 s"                       # also: step_size, fmi, version, booleans, ...

  [components.plant]                      # a plant as for 'pam-ocp plan', or a study file's
  arrangement = "AntagonisticSlide"
  muscle = "DMSP-20-200N"

  [components]
  motion = "plan.npz"                     # a Trajectory, in the folder of this file
  controller = "mine.py:controller"       # a Block, a controller or a plant (with --allow-code)

  [connections]                           # every input of every component = an output
  "plant.muscle1.command" = "controller.muscle1.command"
"""
_SHAPES = ("matrices", "booleans", "enumerations")
_KEYS = ("components", "connections", "step_size", "stop_time", "fmi", "name", "version", *_SHAPES)


def is_system(name: str) -> bool:
    """Whether a file named on the command line describes a system."""
    return name.endswith(".toml") and "connections" in read_toml(name)


def write_system(
    file: str, target: Path | None, fmi: str | None, platforms: Any, allow_code: bool
) -> Path:
    """Write the SSP that a system file describes, by default beside where we are as NAME.ssp."""
    from ..export import export_ssp

    content = read_toml(file)
    with reading(file, "a system file", "see 'pam-ocp export --help'"):
        known_keys(file, content, _KEYS)
        folder = Path(file).parent
        described = table("components", content.get("components", {}))
        components = {n: _component(n, c, folder, allow_code) for n, c in described.items()}
        connections = table("connections", content["connections"])
        more: dict[str, Any] = {
            n: quantity(n, content[n], "s") for n in ("step_size", "stop_time") if n in content
        }
        more |= {n: content[n] for n in _SHAPES if n in content}
    name = str(content.get("name", Path(file).stem))
    return export_ssp(
        components,
        {str(k): str(v) for k, v in connections.items()},
        target or Path(f"{name}.ssp"),
        name=name,
        fmi=cast(Any, fmi or content.get("fmi", "2.0")),
        platforms=platforms,
        version=cast(Any, str(content.get("version", "1.0"))),
        **more,
    )


def _component(name: str, said: Any, folder: Path, allow_code: bool) -> Any:
    from ..core.trajectory import Trajectory
    from ..plants.plant_file import member_of, plant_of, require_allowed

    if isinstance(said, Mapping):
        return plant_of(said, f"components.{name}", folder, allow_code=allow_code)
    if not isinstance(said, str):
        raise InputError(f"components.{name} = {said!r}: give a table, or the name of a file")
    file, colon, member = said.rpartition(":")
    if not colon or not file.endswith(".py"):
        return Trajectory.load(folder / said)
    require_allowed(f"{said!r} would run the Python file {file}", allow_code)
    found = member_of(folder / file, member)
    return found() if callable(found) and not hasattr(found, "sample_time") else found


def add_export(commands: Any) -> None:
    """Add ``export`` to the parser's commands."""
    export = commands.add_parser(
        "export",
        help="export a plant as an FMU, a system as an SSP",
        description="Export a plant as an FMU for Model Exchange and Co-Simulation, or a system "
        "file as an SSP of such units.",
        epilog=EPILOG,
    )
    add_plant(export)
    export.add_argument(
        "--fmi",
        type=lambda text: f"{text}.0" if text in ("2", "3") else text,
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
        description="Validate an FMU and run it by fmpy. Exit code 0 if all is well, 1 otherwise.",
    )
    check.add_argument("fmu", type=Path, metavar="FMU")
    check.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help="plan, closed loop, motion or measured record whose inputs are replayed and whose "
        "outputs are compared",
    )
    check.add_argument(
        "--time-limit",
        type=number,
        default=60.0,
        metavar="S",
        help="time limit in seconds; exceeding it fails the check (default: 60)",
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


def _reference(path: Path) -> Trajectory:
    """The motion in a file; a plan's inputs played tightly, as its samples are a solver's."""
    from ..planning.result import Plan
    from ..simulation.simulator import simulate
    from ..studies.file_kinds import kind_of, motion_in

    kind = kind_of(path)
    found = kind.read(path) if kind.read is not None and "plan" in kind.words else None
    if isinstance(found, Plan):
        return simulate(found.plant, found.trajectory, t=found.trajectory.t)
    return motion_in(path)


def _check(options: argparse.Namespace) -> int:
    from ..export import check_fmu
    from ..studies.file_kinds import require_role

    require_role(options.fmu, "FMU")
    reference = _reference(options.against) if options.against else None
    result = check_fmu(options.fmu, against=reference, time_limit=options.time_limit)
    tell(options, result, result.to_dict)
    return 0 if result.ok else 1

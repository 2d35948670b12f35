"""A system file (TOML) of ``pam-ocp export``: components and connections, to be written as SSP."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from ..core.errors import InputError
from ..core.files import read_toml, reading
from ..core.quantities import known_keys, quantity, table

__all__ = ["EPILOG", "is_system", "write_system"]

EPILOG = """\
A system file (TOML) with a table [connections] is written as SSP 1.0:

  stop_time = "2 s"                       # also: step_size, fmi = "3.0"

  [components.plant]                      # a plant as for 'pam-ocp plan', or a study file's
  arrangement = "AntagonisticSlide"
  muscle = "DMSP-20-200N"

  [components]
  motion = "plan.npz"                     # a Trajectory, beside this file
  controller = "mine.py:controller"       # a Block, a controller or a plant (with --allow-code)

  [connections]                           # every input of every component = an output
  "plant.muscle1.command" = "controller.muscle1.command"
"""
_KEYS = ("components", "connections", "step_size", "stop_time", "fmi", "name")


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
        times = {
            n: quantity(n, content[n], "s") for n in ("step_size", "stop_time") if n in content
        }
    name = str(content.get("name", Path(file).stem))
    return export_ssp(
        components,
        {str(k): str(v) for k, v in connections.items()},
        target or Path(f"{name}.ssp"),
        name=name,
        fmi=cast(Any, fmi or content.get("fmi", "2.0")),
        platforms=platforms,
        **times,
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

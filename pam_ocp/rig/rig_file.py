"""A rig in a file: driver, channels, guard, model."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.files import read_toml, reading
from ..core.quantities import known_keys, quantity, table
from ..plants.plant import Plant
from ..plants.plant_file import plant_of
from .drivers.driver import DRIVERS, Driver
from .guard import Guard
from .rig import Rig

__all__ = ["KEYS", "driver", "load_rig", "rig_of"]

KEYS = (
    "name",
    "driver",
    "sample_time",
    "record",
    "watchdog",
    "plant",
    "readings",
    "commands",
    "guard",
    "fault",
)
HELP = "see docs/rig.md: it has tables [driver], [plant], [readings], [commands], [guard]"


def driver(kind: str, **arguments: Any) -> Driver:
    """A driver by its kind ("modbus", "serial", "udp", "opcua", "ros", "twin") and its arguments.

    Raises UnknownNameError, InputError.

    Examples
    --------
    >>> pam.rig.driver("udp", host="127.0.0.1", port=9750, timeout="5 ms").timeout
    0.005
    """
    name = DRIVERS.name("driver.kind", kind)
    known = DRIVERS.arguments(name)
    known_keys(f"driver ({name})", arguments, known)
    given = {
        n: quantity(f"driver.{n}", v, *known[n].units)
        if isinstance(v, str) and known[n].units
        else v
        for n, v in arguments.items()
    }
    try:
        made: Driver = DRIVERS[name](**given)
    except TypeError as error:
        raise InputError(f"driver ({name}): {error}") from None
    return made


def load_rig(path: str | os.PathLike[str], *, allow_code: bool = False, **changes: Any) -> Rig:
    """The rig that a TOML file describes; nothing is sent.

    allow_code : the file may name a plant as FILE.py:NAME. changes : arguments of :class:`Rig` that
    take the place of what the file says.

    Raises InputError, naming file, key and what is allowed.

    Examples
    --------
    >>> _ = open("bench.toml", "w").write('''
    ... driver = { kind = "udp", host = "127.0.0.1", port = 9750 }
    ... [plant]
    ... arrangement = "HangingLoad"
    ... muscle = "DMSP-20-300"
    ... ''')
    >>> pam.rig.load_rig("bench.toml")
    <Rig 'bench', not armed: reads x, muscle.pressure>
    """
    content = read_toml(path)
    with reading(path, "a rig", HELP):
        return rig_of(content, Path(path), allow_code=allow_code, **changes)


def plant_in(content: Any, path: Path, allow_code: bool) -> Plant | None:
    """The model of a rig's file, if it has one: a table, or another file with a table [plant]."""
    said = content.get("plant")
    if isinstance(said, str):
        said = read_toml(path.parent / said).get("plant")
    return None if said is None else plant_of(said, "plant", path.parent, allow_code=allow_code)


def rig_of(content: Any, path: Path, *, allow_code: bool = False, **changes: Any) -> Rig:
    """The rig of a file's content."""
    known_keys(path.name, content, KEYS)
    arguments: dict[str, Any] = {"name": str(content.get("name", path.stem))}
    if "sample_time" in content:
        arguments["sample_time"] = quantity("sample_time", content["sample_time"], "s")
    if "record" in content:
        arguments["record"] = path.parent / str(content["record"])
    if "watchdog" in content:
        if not isinstance(content["watchdog"], bool):
            raise InputError(f"watchdog = {content['watchdog']!r}: give true or false")
        arguments["watchdog"] = content["watchdog"]
    for name in ("readings", "commands"):
        if name in content:
            arguments[name] = table(name, content[name])
    guard = dict(table("guard", content.get("guard", {})))
    known_keys("guard", guard, ("max_age", "late", "heartbeat", "fade", "tolerated"))
    arguments |= {"guard": Guard(**guard), "plant": plant_in(content, path, allow_code), **changes}
    if "driver" not in arguments:
        if "driver" not in content:
            raise InputError(
                "driver is missing; give a table such as { kind = 'modbus', host = ... }"
            )
        said = dict(table("driver", content["driver"]))
        if "kind" not in said:
            raise InputError(f"driver.kind is missing; give one of {', '.join(DRIVERS)}")
        kind = said.pop("kind")
        if kind == "twin":
            raise InputError("driver.kind = 'twin': a twin in this process is made in Python alone")
        arguments["driver"] = driver(kind, **said)
    return Rig(arguments.pop("driver"), **arguments)

"""Where the C runtime of the FMUs lies: installed inside the package, or at the top of a clone."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.abc import Traversable

_FOLDERS = ("src", "include")


def c_sources() -> Traversable:
    """The folder of the runtime: C files in src/, FMI headers in include/, licences beside them."""
    installed = resources.files("pam_ocp.export") / "c"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "fmu"


def c_text(name: str) -> str:
    """The text of one file of the runtime, such as "solver.c" or "fmi3Functions.h"."""
    top = c_sources()
    places = (*(top / folder / name for folder in _FOLDERS), top / name)
    return next((p for p in places if p.is_file()), places[-1]).read_text(encoding="utf-8")

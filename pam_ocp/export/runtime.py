"""Where the C runtime of the FMUs lies: installed inside the package, or at the top of a clone."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from importlib.abc import Traversable

__all__ = ["c_sources"]


def c_sources() -> Traversable:
    """The folder of the runtime's C files and the FMI headers."""
    installed = resources.files("pam_ocp.export") / "c"
    return installed if installed.is_dir() else Path(__file__).parents[2] / "fmu"

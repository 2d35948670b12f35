"""Options that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ..core.errors import InputError
from ..core.files import require_place
from ..core.quantities import quantity

__all__ = ["add_allow_code", "length_of", "pairs", "require_places"]


def add_allow_code(command: argparse.ArgumentParser) -> None:
    """The consent to run code that a file names."""
    command.add_argument(
        "--allow-code",
        action="store_true",
        help="let the file run code: Python of a plant named FILE.py:NAME in it, FMUs, libraries "
        "of solvers. Read that code before: it can do whatever you can (default: refused)",
    )


def require_places(*targets: Path | None) -> None:
    """Files can be written there: asked before a long run, not after it. Raises WriteError."""
    for target in targets:
        if target is not None:
            require_place(target)


def pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """{name: value} of texts NAME=VALUE. Raises InputError."""
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not value or not name.strip():
            raise InputError(f"{option} {text}: give NAME=VALUE, as mass=2kg or mass=2.0")
        found[name.strip()] = value
    return found


def length_of(option: str, text: str | None) -> float | None:
    """A length [m] of "300 mm" or "0.3"; None where nothing is said. Raises InputError."""
    return None if text is None else quantity(option, text, "m")

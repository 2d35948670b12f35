"""Muscle files: a muscle as JSON, written by ``pam-ocp fit`` and read by every other command."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from ..errors import InputError, UnknownNameError
from ..files import atomic_path
from .force import LAWS
from .muscle import Muscle

__all__ = ["load_muscle", "save_muscle"]

FORMAT = "pam_ocp muscle 1"
_PLAIN = (
    "rest_length", "diameter", "slack_width", "name", "source", "note", "mass", "construction", "obtained",
)  # fmt: skip
_RANGES = ("pressure_range", "contraction_range")


def save_muscle(muscle: Muscle, path: str | os.PathLike[str]) -> Path:
    """Write a muscle with its law and coefficients (SI) as JSON."""
    if LAWS.get(muscle.law.name) is not type(muscle.law):
        raise InputError(
            f"law {muscle.law.name!r} is not one of the library's own; only these can be saved: "
            f"{', '.join(LAWS)}"
        )
    content = {
        "format": FORMAT,
        **{key: getattr(muscle, key) for key in _PLAIN},
        **{key: list(getattr(muscle, key)) for key in _RANGES},
        "law": muscle.law.name,
        "coefficients": {n: float(v) for n, v in muscle.law.values.items()},
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, ensure_ascii=False) + "\n", "utf-8")
    return Path(path)


def load_muscle(path: str | os.PathLike[str]) -> Muscle:
    """Read what :func:`save_muscle` wrote. Raises InputError when it is something else."""
    source = Path(path)
    try:
        content: Any = json.loads(source.read_text("utf-8"))
    except FileNotFoundError:
        raise InputError(f"{source}: no such file") from None
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{source}: not a muscle file ({error})") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{source}: not a muscle file (its 'format' must be {FORMAT!r})")
    if content.get("law") not in LAWS:
        raise UnknownNameError("force law", content.get("law"), LAWS)
    law = LAWS[content["law"]]
    wanted = {v.name for v in law.coefficient_variables()}
    given = content.get("coefficients", {})
    if set(given) != wanted:
        raise InputError(f"{source}: coefficients {sorted(given)} given, {sorted(wanted)} needed")
    try:
        return Muscle(
            law(**{n: float(v) for n, v in given.items()}),
            **{
                **{key: content[key] for key in _PLAIN if key in content},
                **{key: tuple(map(float, content[key])) for key in _RANGES if key in content},
            },
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"{source}: {error}") from None

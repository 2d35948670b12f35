"""Muscle files: a muscle as TOML or JSON, written by ``pam-ocp fit`` and read by every other command."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import tomli_w

from ..errors import InputError, UnknownNameError
from ..files import atomic_path
from ..quantities import read_toml
from .free import law_named
from .muscle import Muscle

__all__ = ["ENDINGS", "load_muscle", "save_muscle"]

FORMAT = "pam_ocp muscle 1"
_PLAIN = (
    "rest_length", "diameter", "slack_width", "name", "source", "note", "mass", "construction", "obtained",
)  # fmt: skip
_RANGES = ("pressure_range", "contraction_range")


ENDINGS = (".toml", ".json")


def save_muscle(muscle: Muscle, path: str | os.PathLike[str]) -> Path:
    """Write a muscle with its law and coefficients (SI): TOML or JSON, as the file's name ends."""
    name = muscle.law.name
    try:
        known = law_named(name) is type(muscle.law)
    except UnknownNameError:
        known = False
    if not known:
        raise InputError(
            f"law {name!r} is one of your own, which no file can hold; write its Muscle(...) in Python"
        )
    content = {
        "format": FORMAT,
        **{key: getattr(muscle, key) for key in _PLAIN},
        **{key: list(getattr(muscle, key)) for key in _RANGES},
        "law": muscle.law.name,
        "coefficients": {n: float(v) for n, v in muscle.law.values.items()},
    }
    if _ending(path) == ".toml":
        text = tomli_w.dumps({key: value for key, value in content.items() if value is not None})
    else:
        text = json.dumps(content, indent=2, ensure_ascii=False) + "\n"
    with atomic_path(path) as temporary:
        temporary.write_text(text, "utf-8")
    return Path(path)


def _ending(path: str | os.PathLike[str]) -> str:
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise InputError(f"{os.fspath(path)}: a muscle file ends in {' or '.join(ENDINGS)}")
    return ending


def load_muscle(path: str | os.PathLike[str]) -> Muscle:
    """Read what :func:`save_muscle` wrote. Raises InputError when it is something else."""
    source = Path(path)
    if _ending(source) == ".toml":
        content: Any = read_toml(source)
    else:
        try:
            content = json.loads(source.read_text("utf-8"))
        except FileNotFoundError:
            raise InputError(f"{source}: no such file") from None
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise InputError(f"{source}: not a muscle file ({error})") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise InputError(f"{source}: not a muscle file (its 'format' must be {FORMAT!r})")
    try:
        law = law_named(str(content.get("law")))
    except InputError as error:
        raise InputError(f"{source}: {error}") from None
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

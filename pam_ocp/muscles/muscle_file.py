"""Muscle files: a muscle as TOML or JSON, written by ``pam-ocp fit`` and read by every other
command.
"""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path
from typing import Any

import tomli_w

from ..core.errors import InputError, UnknownNameError, require_finite, require_instance, with_kinds
from ..core.files import (
    atomic_path,
    read_json,
    read_toml,
    reading,
    require_format,
    write_json,
)
from ..core.quantities import table
from .laws.user_defined import law_named
from .pneumatic_muscle import Muscle

FORMAT = "pam_ocp muscle 1"
_PLAIN = tuple(f.name for f in fields(Muscle) if f.name != "law")


ENDINGS = (".toml", ".json")


@with_kinds
def save_muscle(muscle: Muscle, path: str | os.PathLike[str]) -> Path:
    """Write a muscle with its law and coefficients (SI): TOML or JSON, as the file's name ends.

    Examples
    --------
    >>> pam.save_muscle(muscle, "M1.toml").name
    'M1.toml'
    """
    require_instance("muscle", muscle, Muscle, "give a Muscle, such as fit.muscle(...)")
    ending, name = ending_of(path), muscle.law.name
    try:
        known = law_named(name) is type(muscle.law)
    except UnknownNameError:
        known = False
    if not known:
        raise InputError(
            f"law {name!r} is one of your own, which no file can hold; write its Muscle(...) in "
            "Python"
        )
    content = {
        "format": FORMAT,
        **{key: getattr(muscle, key) for key in _PLAIN},
        "law": muscle.law.name,
        "coefficients": {n: float(v) for n, v in muscle.law.values.items()},
    }
    if ending == ".json":
        return write_json(path, content)
    with atomic_path(path) as temporary:
        stated = {key: value for key, value in content.items() if value is not None}
        temporary.write_text(tomli_w.dumps(stated), "utf-8")
    return Path(path)


def ending_of(path: str | os.PathLike[str]) -> str:
    """That of a muscle file's name, in small letters. Raises InputError for any other."""
    require_instance("path", path, (str, os.PathLike), "give the name of a file")
    ending = Path(path).suffix.lower()
    if ending not in ENDINGS:
        raise InputError(f"{os.fspath(path)}: a muscle file ends in {' or '.join(ENDINGS)}")
    return ending


@with_kinds
def load_muscle(path: str | os.PathLike[str]) -> Muscle:
    """Read what :func:`save_muscle` wrote. Raises InputError when it is something else.

    Examples
    --------
    >>> path = pam.save_muscle(muscle, "M1.toml")
    >>> pam.load_muscle(path).law == muscle.law
    True
    """
    kind, remedy = "a muscle file", f"its 'format' must be {FORMAT!r}"
    if ending_of(path) == ".json":
        content = read_json(path, kind, FORMAT, remedy)
    else:
        content = require_format(path, read_toml(path), kind, FORMAT, remedy)
    with reading(path, kind, "save one by save_muscle(...)"):
        return _muscle(content)


def _muscle(content: dict[str, Any]) -> Muscle:
    """The muscle that a file's content describes;
    raises what Python does where it describes none.
    """
    law = law_named(str(content.get("law")))
    wanted = {v.name for v in law.coefficient_variables()}
    given = table("coefficients", content.get("coefficients", {}))
    if set(given) != wanted:
        raise InputError(f"coefficients {sorted(given)} given, {sorted(wanted)} needed")
    return Muscle(
        law(**{n: require_finite(f"coefficients.{n}", v) for n, v in given.items()}),
        **{key: content[key] for key in _PLAIN if key in content},
    )

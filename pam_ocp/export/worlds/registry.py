"""The worlds that a plant can be exported to, and the verb of all of them."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ...core.errors import InputError
from ...core.registry import Registry

WORLDS: Registry[Callable[..., Any]] = Registry("world", "pam_ocp.export.worlds")
"""name -> what exports to it: (system, path, ...) -> Path for files, (system, ...) otherwise."""

ENDINGS: dict[str, str] = {}
"""{ending of a file: the world that it means}; entered where the world is."""


def export(
    system: Any,
    path: str | os.PathLike[str] | None = None,
    *,
    world: str | None = None,
    **options: Any,
) -> Any:
    """A plant, or a controller, in another world: ``pam.export(plant, "slide.fmu")``.

    path : the file to write; its ending tells the world (.fmu, .ssp, .onnx, .mo, .xml of MuJoCo).
        None for worlds in this process (jax, torch, mujoco).
    world : by name, where no path tells it, or where its ending does not.
    options : of what does the work (``pam.export_fmu``, ``pam.export.to_jax``, ...).

    Returns the path, or what stands for the system in that world.
    Raises InputError, UnknownNameError for a world that is none, and as the world's own function.

    Examples
    --------
    >>> pam.export(plant, "Load.mo").name
    'Load.mo'
    """
    if world is None:
        if path is None:
            raise InputError(f"export: give a path, or one of world = {', '.join(WORLDS)}")
        len(WORLDS)  # all of them have entered their endings
        ending = Path(os.fspath(path)).suffix.lower()
        if ending not in ENDINGS:
            known = ", ".join(sorted(ENDINGS))
            raise InputError(f"path = {os.fspath(path)!r} ends in none of {known}; give world=")
        world = ENDINGS[ending]
    made = WORLDS.find("world", world)
    return made(system, **options) if path is None else made(system, path, **options)

"""Nouns out of what a session says: tables, records, muscles, plants. No page is needed.

Both sides use it: the page for quick looks, other processes (work.py) for the rest; there the last
few of each are kept. ``state`` is a session's state, ``folder`` its folder.
"""

from __future__ import annotations

import ast
import json
import warnings
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import InputError
from ..core.trajectory import Trajectory
from ..fitting.tables.force_table import ForceTable
from ..fitting.tables.preview import Preview, Previews, look
from ..muscles.catalogue import muscle as catalogued
from ..muscles.laws.user_defined import law_named
from ..muscles.muscle_file import load_muscle
from ..muscles.pneumatic_muscle import Muscle
from ..plants.plant import Plant
from ..plants.plant_file import plant_of as described
from .session import safe_name, stored_file

__all__ = [
    "chosen_item",
    "muscle_of",
    "own_plants",
    "plant_of",
    "preview_of",
    "records_of",
    "source_of",
    "table_of",
]

State = Mapping[str, Any]
KEPT = 8


def source_of(folder: Path, item: Mapping[str, Any]) -> str:
    """What a reader is given for an item of ``data``: a bundled table's name, or a file."""
    if "bundled" in item:
        return str(item["bundled"])
    return str(stored_file(folder, safe_name(str(item["file"]))))


def chosen_item(state: State) -> dict[str, Any]:
    """The data in use. Raises InputError where there are none."""
    for item in state["data"]:
        if item["id"] == state["chosen"]:
            return dict(item)
    raise InputError("no data are chosen; choose a table in the tab Data")


def _kept(make: Callable[[str, str], Any]) -> Callable[[Path, Any], Any]:
    """Makes by (folder, JSON) once; errors are not kept."""
    cached = lru_cache(KEPT)(make)
    return lambda folder, content: cached(str(folder), json.dumps(content, sort_keys=True))


@_kept
def _preview(folder: str, content: str) -> Preview:
    item = json.loads(content)
    seen = look(source_of(Path(folder), item), **_options(item["said"]))
    if isinstance(seen, Previews):  # a pattern cannot be meant here
        raise InputError(f"{item['name']} holds several sources; give one file at a time")
    return seen


def _options(said: Mapping[str, Any]) -> dict[str, Any]:
    return {k: tuple(v) if k == "pivot" else v for k, v in said.items()}


def preview_of(folder: Path, item: Mapping[str, Any]) -> Preview:
    """What is understood of an item of ``data``. Raises InputError for a damaged file."""
    kept = {k: item[k] for k in ("bundled", "file", "name", "said") if k in item}
    found: Preview = _preview(folder, kept)
    return found


def table_of(folder: Path, item: Mapping[str, Any], *, whole: bool = False) -> ForceTable:
    """The table of an item, without its cells that are switched off (``whole``: with them)."""
    seen = preview_of(folder, item)
    if not seen.ok:
        raise InputError(seen.problem)
    if not isinstance(seen.result, ForceTable):
        raise InputError(f"{item['name']} is a record in time, no force table")
    table = seen.result
    off = [i for i in item.get("off", ()) if isinstance(i, int) and 0 <= i < len(table)]
    if whole or not off:
        return table
    chosen = np.ones(len(table), bool)
    chosen[off] = False
    return table.subset(chosen)


def records_of(folder: Path, item: Mapping[str, Any]) -> list[Trajectory]:
    """The records of an item."""
    seen = preview_of(folder, item)
    if not isinstance(seen.result, list):
        raise InputError(seen.problem or f"{item['name']} is a force table, no record in time")
    return seen.result


# ---- muscles -------------------------------------------------------------------------------------
def muscle_of(folder: Path, state: State) -> Muscle:
    """The muscle of the session. Raises InputError where none is chosen or fitted."""
    said = state["muscle"]
    if said is None:
        raise InputError("no muscle yet; choose or fit one in the tab Muscle")
    found: Muscle = _muscle(folder, said)
    return found


@_kept
def _muscle(folder: str, content: str) -> Muscle:
    """kind "catalogue": name, rest_length; "file": file; "fit": law, coefficients, rest_length,
    diameter, pressure_range, contraction_range, name, source."""
    said = json.loads(content)
    if said["kind"] == "catalogue":
        return catalogued(said["name"], rest_length=said.get("rest_length"))
    if said["kind"] == "file":
        return load_muscle(stored_file(Path(folder), safe_name(said["file"])))
    if said["kind"] != "fit":
        raise InputError(f"muscle = {said['kind']!r} is no kind of muscle that the bench knows")
    return Muscle(
        law_named(said["law"])(**said["coefficients"]),
        rest_length=said["rest_length"],
        diameter=said.get("diameter"),
        pressure_range=tuple(said["pressure_range"]),
        contraction_range=tuple(said["contraction_range"]),
        name=said["name"],
        source=said["source"],
    )


def plant_of(folder: Path, state: State, *, allow_code: bool = False) -> Plant:
    """The plant of the session, with its muscle.

    allow_code : it may be one of the user's own, FILE.py:NAME among the session's files.
    """
    if state["muscle"] is None:
        muscle_of(folder, state)
    content = [state["plant"], state["muscle"], allow_code]
    made: Plant = _described(folder, content)
    return made


@_kept
def _described(folder: str, content: str) -> Plant:
    table, muscle, allow_code = json.loads(content)
    part: Muscle = _muscle(Path(folder), muscle)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        files = Path(folder) / "files"
        return described({**table, "muscle": part}, "plant", files, allow_code=allow_code)


def own_plants(folder: Path) -> dict[str, str]:
    """{FILE.py:NAME: words}: what Python files of the session name at their top. None is run.

    Names that are imported, or begin with _, are left out.
    """
    found: dict[str, str] = {}
    for path in sorted((folder / "files").glob("[!.]*.py")):
        try:
            body = ast.parse(stored_file(folder, path.name).read_bytes()).body
        except (InputError, SyntaxError, ValueError):
            continue
        names = [s.name for s in body if isinstance(s, ast.FunctionDef | ast.ClassDef)]
        for assigned in body:
            if isinstance(assigned, ast.Assign):
                names += [t.id for t in assigned.targets if isinstance(t, ast.Name)]
        shown = path.name.partition("-")[2] or path.name
        found |= {f"{path.name}:{n}": f"{n} ({shown})" for n in names if n[0] != "_"}
    return found

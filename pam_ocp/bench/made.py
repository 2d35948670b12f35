"""Nouns out of what a session says: tables, records, muscles, plants. No page is needed.

Both sides use it: the page for quick looks, other processes (work.py) for the rest; there the last
few of each are kept. All are made of a :class:`World`, which is plain enough to be sent to them.
"""

from __future__ import annotations

import ast
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, wraps
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ..core.errors import InputError
from ..core.trajectory import Trajectory
from ..fitting.tables.force_table import ForceTable
from ..fitting.tables.preview import Preview, Previews, look
from ..muscles.catalogue import muscle as catalogued
from ..muscles.laws.user_defined import law_named
from ..muscles.muscle_file import load_muscle
from ..muscles.pneumatic_muscle import Muscle
from ..operating.resting_point import OperatingPoint, equilibrium
from ..plants.plant import Plant
from ..plants.plant_file import plant_of as described
from .session import EMPTY, safe_name, stored_file

State = Mapping[str, Any]
Made = TypeVar("Made")


@dataclass(frozen=True)
class World:
    """What nouns are made of: folder and state of a session, and whether its files may name code
    to be run.
    """

    folder: Path
    state: State = field(default_factory=lambda: EMPTY)
    allow_code: bool = False

    def but(self, **parts: Any) -> World:
        """The same with other parts of the state."""
        return replace(self, state={**self.state, **parts})

    def member(self, part: str, id: str) -> dict[str, Any]:
        """A motion, a controller, ... by its id. Raises InputError where there is none."""
        found = next((m for m in self.state[part] if m["id"] == id), None)
        if found is None:
            raise InputError(f"{id!r} is not among the {part} of this session")
        return dict(found)

    def exported(self, name: str) -> Path:
        """Where something lies that leaves the session."""
        there = self.folder / "exports"
        there.mkdir(exist_ok=True)
        return there / name


def kept(*parts: str, most: int = 8) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
    """Makes once of a world's ``parts`` and further plain arguments; the last ``most`` are kept,
    errors are not.
    """

    def decorated(make: Callable[..., Made]) -> Callable[..., Made]:
        @lru_cache(most)
        def made(folder: Path, allow_code: bool, content: str) -> Made:
            state, args = json.loads(content)
            return make(World(folder, state, allow_code), *args)

        @wraps(make)
        def found(world: World, *args: Any) -> Made:
            content = [{n: world.state[n] for n in parts}, args]
            return made(world.folder, world.allow_code, json.dumps(content, sort_keys=True))

        return found

    return decorated


def source_of(world: World, item: Mapping[str, Any]) -> str:
    """What a reader is given for an item of ``data``: a bundled table's name, or a file."""
    if "bundled" in item:
        return str(item["bundled"])
    return str(stored_file(world.folder, safe_name(str(item["file"]))))


def chosen_item(state: State) -> dict[str, Any]:
    """The data in use. Raises InputError where there are none."""
    for item in state["data"]:
        if item["id"] == state["chosen"]:
            return dict(item)
    raise InputError("no data are chosen; choose a table in the tab Data")


@kept()
def _preview(world: World, item: Mapping[str, Any]) -> Preview:
    said: dict[str, Any] = {k: tuple(v) if k == "pivot" else v for k, v in item["said"].items()}
    seen = look(source_of(world, item), **said)
    if isinstance(seen, Previews):  # a pattern cannot be meant here
        raise InputError(f"{item['name']} holds several sources; give one file at a time")
    return seen


def preview_of(world: World, item: Mapping[str, Any]) -> Preview:
    """What is understood of an item of ``data``. Raises InputError for a damaged file."""
    return _preview(world, {k: item[k] for k in ("bundled", "file", "name", "said") if k in item})


def table_of(world: World, item: Mapping[str, Any]) -> ForceTable:
    """The table of an item, without its cells that are switched off."""
    seen = preview_of(world, item)
    if not seen.ok:
        raise InputError(seen.problem)
    if not isinstance(seen.result, ForceTable):
        raise InputError(f"{item['name']} is a record in time, no force table")
    table = replace(seen.result, source=str(item["name"]))  # not the name it is stored by
    off = [i for i in item.get("off", ()) if isinstance(i, int) and 0 <= i < len(table)]
    if not off:
        return table
    chosen = np.ones(len(table), bool)
    chosen[off] = False
    return table.subset(chosen)


def records_of(world: World, item: Mapping[str, Any]) -> list[Trajectory]:
    """The records of an item."""
    seen = preview_of(world, item)
    if not isinstance(seen.result, list):
        raise InputError(seen.problem or f"{item['name']} is a force table, no record in time")
    return seen.result


@kept("muscle")
def muscle_of(world: World) -> Muscle:
    """The muscle of the session. Raises InputError where none is chosen or fitted.

    kind "catalogue": name, rest_length; "file": file; "fit": law, coefficients, rest_length,
    diameter, pressure_range, contraction_range, name, source.
    """
    said = world.state["muscle"]
    if said is None:
        raise InputError("no muscle yet; choose or fit one in the tab Muscle")
    if said["kind"] == "catalogue":
        return catalogued(said["name"], rest_length=said.get("rest_length"))
    if said["kind"] == "file":
        return load_muscle(stored_file(world.folder, safe_name(said["file"])))
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


@kept("plant", "muscle")
def plant_of(world: World) -> Plant:
    """The plant of the session, with its muscle; one of the user's own, FILE.py:NAME among the
    session's files, where code is allowed.
    """
    table = {**world.state["plant"], "muscle": muscle_of(world)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return described(table, "plant", world.folder / "files", allow_code=world.allow_code)


def point_of(world: World, plant: Plant) -> OperatingPoint:
    """The operating point of the session's plant. Raises InputError where none is chosen."""
    if not world.state["point"]:
        raise InputError("no operating point yet; choose one in the tab Plant or Control")
    return equilibrium(plant, world.state["point"])


def made_of_plan(state: State, motion: Mapping[str, Any]) -> list[Any]:
    """All that a plan's figures depend on."""
    said = {k: v for k, v in motion.items() if k != "name"}
    return [state["muscle"], state["plant"], said]


def made_of_loop(state: State, controller: Mapping[str, Any] | None) -> list[Any]:
    """All that a loop's figures depend on."""
    return [{k: state[k] for k in ("plant", "muscle", "point")}, controller]


def made_of_export(state: State, said: Mapping[str, Any]) -> list[Any]:
    """All that an exported file depends on, and what it is held against."""
    part = "controllers" if said["kind"] == "c" else "motions"
    id = said["controller"] if said["kind"] == "c" else said["motion"]
    member = next((m for m in state[part] if m["id"] == id), None)
    point = state["point"] if said["kind"] == "c" or not said["motion"] else {}
    return [state["muscle"], state["plant"], point, member]


def is_of_now(state: State, said: Mapping[str, Any]) -> bool:
    """Whether an exported file is made of what the session says now; those of before that was
    noted are taken to be.
    """
    now = made_of_export(state, said)
    return bool(said.get("of", now) == now)


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

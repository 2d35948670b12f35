"""A plant in words: a table of a TOML file, or a name on the command line, becomes a Plant."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import partial
from inspect import signature
from pathlib import Path
from types import FunctionType
from typing import Any

from ..core.errors import InputError, UnknownNameError, kind_of
from ..core.files import read_toml, reading, said_in
from ..core.own_code import module_of
from ..core.quantities import known_keys, quantity, table
from ..core.registry import Registry, registry_of
from ..core.stop import verb
from ..muscles.catalogue import muscle as catalogue_muscle
from ..muscles.muscle_file import ENDINGS, load_muscle
from ..muscles.pneumatic_muscle import Muscle
from .kinds import PLANTS
from .plant import Plant
from .plant_data import FORMAT, SYSTEM, plant_of_data

CARRYING = (".json", ".npz")
"""Endings of files that may carry a plant."""
OWN = "FILE.py:NAME"
"""How a plant of one's own is named."""


def muscle_of(value: Any, where: str = "muscle", folder: Path | None = None) -> Muscle:
    """A Muscle from a catalogue's name, a muscle file (.toml, .json), or a table.

    value : the name; the file, relative to ``folder``; or { name = ..., rest_length = ... } where
        the catalogue holds no length. A Muscle is taken as it is.
    """
    if isinstance(value, Muscle):
        return value
    length = None
    if isinstance(value, Mapping):
        known_keys(where, value, ("name", "rest_length"))
        if "rest_length" in value:
            length = quantity(f"{where}.rest_length", value["rest_length"], "m")
        value = value.get("name")
    if not isinstance(value, str):
        given = f"{where} is missing" if value is None else f"{where} = {value!r}"
        raise InputError(f"{given}: give a name of the catalogue, or a muscle file")
    if value.endswith(ENDINGS):
        return load_muscle((folder or Path()) / value)
    return catalogue_muscle(value, rest_length=length)


def named_plant(
    name: str,
    muscle: Muscle,
    folder: Path | None = None,
    *,
    allow_code: bool = False,
    **parts: Any,
) -> Plant:
    """A plant of the library with its defaults ("AntagonisticSlide" or "antagonistic_slide"), the
    one that a file carries (see :func:`load_plant`), or a user's: FILE.py:NAME, NAME being a Plant
    or a function that takes a muscle and returns one.

    allow_code : FILE.py may be run; without it InputError says why not. parts : further arguments.
    """
    if name.lower().endswith(CARRYING):
        return load_plant((folder or Path()) / name)
    file, colon, member = name.rpartition(":")
    if not colon:
        made: Plant = PLANTS.find("plant", name, OWN)(muscle, **parts)
        return made
    require_allowed(f"{name!r} would run the Python file {file}", allow_code)
    found = member_of((folder or Path()) / file, member)
    wanted = "a Plant, or a function that takes a muscle and returns one"
    other = isinstance(found, type) and not issubclass(found, Plant)
    if other or (not isinstance(found, Plant) and not callable(found)):
        raise InputError(f"{name} is {_called(found)}; give {wanted}")
    if isinstance(found, FunctionType):
        try:
            signature(found).bind(muscle, **parts)
        except TypeError as error:
            *first, last = ["a muscle", *(f"{n}=" for n in parts)]
            given = f"{', '.join(first)} and {last}" if first else last
            raise InputError(f"{name} cannot take {given} ({error}); give {wanted}") from None
    plant = found if isinstance(found, Plant) else found(muscle, **parts)
    if not isinstance(plant, Plant):
        raise InputError(f"{name} returns {_called(plant)}; give {wanted}")
    return plant


def _called(value: Any) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else kind_of(value)


def require_allowed(what: str, allow_code: bool) -> None:
    """Raises InputError where a file asks for code to be run and nobody said that it may."""
    if not allow_code:
        raise InputError(
            f"{what}: a file that others made could do anything with your files that way. Read "
            "that code, and then allow it by --allow-code (in Python: allow_code=True)"
        )


def plant_of(
    content: Any,
    where: str = "plant",
    folder: Path | None = None,
    *,
    allow_code: bool = False,
) -> Plant:
    """The Plant that a ``[plant]`` table describes.

    content : ``arrangement`` (a plant of the library, or FILE.py:NAME), ``muscle`` (see
        :func:`muscle_of`), ``set`` ({parameter or start value: value}), ``sensors`` ({state or
        output: its sensor}), and the arguments of the arrangement by name. Components are tables
        with their ``kind``, as ``feed = { kind = "Regulator", lag = "50 ms" }``; losses and loads
        are lists of them. Values are SI numbers or texts with a unit.
    where : what is read, for messages. folder : of the file; other files are looked for there.
    allow_code : the table may name a plant as FILE.py:NAME, which runs that file.

    Raises InputError (UnknownNameError for a name), naming key, value and what is allowed.
    """
    content = dict(table(where, content))
    name = content.pop("arrangement", None)
    if not isinstance(name, str):
        raise InputError(
            f"{where}.arrangement is missing; give one of {', '.join(PLANTS)}, or FILE.py:NAME"
        )
    values = table(f"{where}.set", content.pop("set", {}))
    sensors = table(f"{where}.sensors", content.pop("sensors", {}))
    part = muscle_of(content.pop("muscle", None), f"{where}.muscle", folder)
    if ":" in name:
        known_keys(where, content, ("arrangement", "muscle", "set", "sensors"))
        plant = named_plant(name, part, folder, allow_code=allow_code)
    else:
        if "muscle2" in content:
            content["muscle2"] = muscle_of(content["muscle2"], f"{where}.muscle2", folder)
        known = PLANTS.name(f"{where}.arrangement", name, OWN)
        plant = _built(where, PLANTS, known, content, part)
    for sensed, said in sensors.items():
        plant.add_sensor(sensed, _component(f"{where}.sensors.{sensed}", "sensors", said))
    return plant.with_values(
        {n: quantity(f"{where}.set.{n}", v, plant.variable(n).unit) for n, v in values.items()}
    )


def builder_of(
    content: Any,
    where: str = "plant",
    folder: Path | None = None,
    *,
    allow_code: bool = False,
) -> tuple[Callable[..., Plant], Any]:
    """(what builds the plant of a ``[plant]`` table with another feed= and losses=, its feed).

    Arguments as of :func:`plant_of`. A plant of one's own is a function that takes both.
    """
    content = dict(table(where, content))
    fed = content.pop("feed", {"kind": "Regulator"})
    feed = _component(f"{where}.feed", "feed", fed)
    content.pop("losses", None)
    own = str(content.get("arrangement", ""))
    if ":" not in own:
        return partial(_with_parts, content, where, folder), feed
    known_keys(where, content, ("arrangement", "muscle"))
    part = muscle_of(content.get("muscle"), f"{where}.muscle", folder)
    return partial(named_plant, own, part, folder, allow_code=allow_code), feed


def _with_parts(content: Mapping[str, Any], where: str, folder: Path | None, **parts: Any) -> Plant:
    return plant_of({**content, **parts}, where, folder)


def _built(
    where: str, kinds: Registry[Any], name: str, given: Mapping[str, Any], *first: Any
) -> Any:
    """A plant or component from its arguments in words."""
    known = kinds.arguments(name)
    title = f"{where} ({name})"
    known_keys(title, given, [n for n in known if n != "muscle" or not first])
    values = {n: _argument(f"{where}.{n}", n, v, known[n].units) for n, v in given.items()}
    try:
        return kinds[name](*first, **values)
    except TypeError as error:
        raise InputError(f"{title}: {error}") from None


def _argument(where: str, name: str, value: Any, units: tuple[str, ...]) -> Any:
    if isinstance(value, Mapping):
        return _component(where, name, value)
    if isinstance(value, list) and registry_of(name) is not None:
        return tuple(_component(f"{where}[{i}]", name, v) for i, v in enumerate(value))
    if isinstance(value, list):
        return tuple(_entry(where, v, units) for v in value)
    if isinstance(value, str) and not units:
        return value
    made = registry_of(name) is not None and not isinstance(value, str | int | float | list)
    if isinstance(value, bool | Muscle | tuple) or made:
        return value
    return quantity(where, value, *units)


def _entry(where: str, value: Any, units: tuple[str, ...]) -> Any:
    if isinstance(value, list):
        return tuple(_entry(where, v, units) for v in value)
    return quantity(where, value, *units)


def component_of(argument: str, content: Mapping[str, Any]) -> Any:
    """The component that a table with its ``kind`` describes: component_of("feed", {...})."""
    return _component(argument, argument, content)


def _component(where: str, argument: str, value: Any) -> Any:
    """One of those that an argument takes, from a table with its ``kind``."""
    kinds = registry_of(argument)
    if kinds is None:
        raise InputError(f"{where} = {value!r}: give a value, not a table")
    given = dict(table(where, value))
    usual = kinds.default or (next(iter(kinds)) if len(kinds) == 1 else None)
    kind = given.pop("kind", usual)
    if kind is None:
        raise InputError(f"{where}.kind is missing; give one of {', '.join(kinds)}")
    return _built(where, kinds, kinds.name(f"{where}.kind", kind), given)


def member_of(file: Path, member: str) -> Any:
    """A name of a Python file, which is run. Raises InputError, UnknownNameError."""
    module = module_of(file)
    if not hasattr(module, member):
        raise UnknownNameError(f"name in {file}", member, [n for n in vars(module) if n[0] != "_"])
    return getattr(module, member)


@verb
def load_plant(path: str | os.PathLike[str], *, allow_code: bool = False) -> Plant:
    """The plant that a file describes or carries.

    path : .json of :func:`save_plant` or of a fit of a plant (with its fitted values), .npz of a
        plan, a motion or a closed loop, or .toml with a table [plant]. allow_code : a table may
        name FILE.py:NAME, which runs that file.

    Raises InputError for a file without a plant.

    Examples
    --------
    >>> pam.plants.load_plant(plan.save("plan.npz")).name
    'antagonistic_slide'
    """
    name, ending = os.fspath(path), Path(path).suffix.lower()
    remedy = "give a file that save_plant(), plan.save() or 'pam-ocp simulate --out' wrote"
    if ending == ".toml":
        content: Any = read_toml(path)
        with reading(path, "a plant", "give it a table [plant], as for 'pam-ocp plan'"):
            where, folder = f"{name}: plant", Path(path).parent
            return plant_of(content.get("plant"), where, folder, allow_code=allow_code)
    if ending not in CARRYING:
        raise InputError(f"{name}: a plant is read from .json, .npz or .toml; {remedy}")
    content = said_in(path)
    if SYSTEM not in content:
        kind = content.get("format", "pam_ocp motion")
        raise InputError(f"{name} ({kind}) carries no plant; {remedy}")
    form = str(content.get("format"))
    if form != FORMAT and form.rstrip("0123456789. ") == FORMAT.rstrip("0123456789. "):
        raise InputError(
            f"{name} is of another version ({form}; this one reads {FORMAT}): save the plant anew"
        )
    with reading(path, "a plant", remedy):
        return plant_of_data(content[SYSTEM])

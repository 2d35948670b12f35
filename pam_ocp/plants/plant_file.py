"""A plant in words: a table of a TOML file, or a name on the command line, becomes a Plant."""

from __future__ import annotations

import importlib.util
import inspect
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from ..core.errors import InputError, UnknownNameError
from ..core.quantities import known_keys, quantity, table
from ..muscles.catalogue import muscle as catalogue_muscle
from ..muscles.gas import BraidVolume, ConsistentVolume, Gas, PolynomialVolume
from ..muscles.muscle import Muscle
from ..muscles.muscle_file import ENDINGS, load_muscle
from .elastic import SeriesLoad, SpringOverMuscle
from .feeds import IdealPressure, Regulator
from .hanging import HangingLoad
from .joint import AntagonisticJoint
from .loads import Damper, DryFriction, ExternalForce, Inertia, Spring, Wall
from .losses import ConstantDamping, CoulombFriction, DirectionalDamping, StiffnessDamping
from .memory import BoucWen, Creep, MaxwellSlip
from .plant import Plant
from .regulated import RegulatedLoad
from .slide import AntagonisticSlide
from .valves import OnOffValves, SpoolValve, Tube

__all__ = ["ARRANGEMENTS", "muscle_of", "named_plant", "plant_of"]

ARRANGEMENTS: dict[str, Callable[..., Plant]] = {
    c.__name__: c
    for c in (
        AntagonisticJoint,
        AntagonisticSlide,
        HangingLoad,
        RegulatedLoad,
        SeriesLoad,
        SpringOverMuscle,
    )
}
"""Plants of the library by their name."""

_COMPONENTS: dict[str, dict[str, Callable[..., Any]]] = {
    role: {c.__name__: c for c in kinds}
    for role, kinds in {
        "feed": (Regulator, IdealPressure, SpoolValve, OnOffValves),
        "damping": (ConstantDamping, StiffnessDamping),
        "losses": (CoulombFriction, DirectionalDamping, BoucWen, MaxwellSlip, Creep),
        "loads": (ExternalForce, Spring, Damper, DryFriction, Inertia, Wall),
        "tube": (Tube,),
        "gas": (Gas,),
        "volume": (ConsistentVolume, BraidVolume, PolynomialVolume),
    }.items()
}
"""What a component may be, by the argument that takes it."""

_UNITS: dict[str, tuple[str, ...]] = {
    "mass": ("kg",),
    "link_mass": ("kg",),
    "fitting_mass": ("kg",),
    "inertia": ("kg.m2",),
    "pre_contraction": ("1",),
    "stroke": ("m",),
    "moment_arm": ("m",),
    "moment_arm2": ("m",),
    "link_length": ("m",),
    "rest_length": ("m",),
    "diameter": ("m",),
    "inclination": ("rad",),
    "limits": ("rad",),
    "angle": ("rad",),
    "spring_stiffness": ("N/m",),
    "preload": ("N",),
    "tendon_stiffness": ("N/m",),
    "tendon_damping": ("N.s/m",),
    "gain": ("Pa/m",),
    "derivative_gain": ("Pa.s/m",),
    "lag": ("s",),
    "max_pressure": ("Pa",),
    "max_rate": ("Pa/s",),
    "supply": ("Pa",),
    "ambient": ("Pa",),
    "temperature": ("K",),
    "dead_volume": ("m3",),
    "Tube.volume": ("m3",),
    "conductance": ("m3/(s.Pa)",),
    "exhaust_conductance": ("m3/(s.Pa)",),
    "leak": ("m3/(s.Pa)",),
    "critical_ratio": ("1",),
    "exponent": ("1",),
    "overlap": ("1",),
    "ratio": ("1",),
    "ConstantDamping.value": ("N.s/m", "N.m.s/rad"),
    "constant": ("N",),
    "per_pressure": ("N/Pa",),
    "excess": ("1",),
    "speed": ("m/s", "rad/s"),
    "stribeck_speed": ("m/s",),
    "friction": ("N",),
    "yield_contraction": ("1",),
    "rounding": ("N.s/m",),
    "start": ("N", "N.m"),
    "stiffness": ("N/m", "N.m/rad"),
    "rest": ("m", "rad"),
    "coefficient": ("N.s/m", "N.m.s/rad"),
    "coulomb": ("N", "N.m"),
    "Inertia.value": ("kg", "kg.m2"),
    "position": ("m", "rad"),
    "Wall.damping": ("N.s/m", "N.m.s/rad"),
    "width": ("N", "N.m"),
}
"""Units of the arguments; "Component.argument" before the argument's name alone."""


def muscle_of(value: Any, where: str = "muscle", folder: Path | None = None) -> Muscle:
    """A Muscle from a catalogue's name, a muscle file (.toml, .json), or a table.

    value : the name; the file, relative to ``folder``; or { name = ..., rest_length = ... } where
        the catalogue holds no length.
    """
    length = None
    if isinstance(value, Mapping):
        known_keys(where, value, ("name", "rest_length"))
        if "rest_length" in value:
            length = quantity(f"{where}.rest_length", value["rest_length"], "m")
        value = value.get("name")
    if not isinstance(value, str):
        raise InputError(f"{where} = {value!r}: give a name of the catalogue, or a muscle file")
    if value.endswith(ENDINGS):
        return load_muscle((folder or Path()) / value)
    return catalogue_muscle(value, rest_length=length)


def named_plant(name: str, muscle: Muscle, folder: Path | None = None) -> Plant:
    """A plant of the library with its defaults ("AntagonisticSlide" or "antagonistic_slide"), or a
    user's: FILE.py:NAME, NAME being a Plant or a function that takes a muscle and returns one."""
    file, colon, member = name.rpartition(":")
    if not colon:
        return _arrangement("plant", name)(muscle)
    found = _member((folder or Path()) / file, member)
    plant = found if isinstance(found, Plant) else found(muscle)
    if not isinstance(plant, Plant):
        raise InputError(f"{name} gives {type(plant).__name__}, not a Plant")
    return plant


def plant_of(content: Any, where: str = "plant", folder: Path | None = None) -> Plant:
    """The Plant that a ``[plant]`` table describes.

    content : ``arrangement`` (a plant of the library, or FILE.py:NAME), ``muscle`` (see
        :func:`muscle_of`), ``set`` ({parameter or start value: value}), and the arguments of the
        arrangement by name. Components are tables with their ``kind``, as
        ``feed = { kind = "Regulator", lag = "50 ms" }``; losses and loads are lists of them.
        Values are SI numbers or texts with a unit.
    where : what is read, for messages. folder : of the file; other files are looked for there.

    Raises InputError (UnknownNameError for a name), naming key, value and what is allowed.
    """
    content = dict(table(where, content))
    name = content.pop("arrangement", None)
    if not isinstance(name, str):
        raise InputError(
            f"{where}.arrangement is missing; give one of {', '.join(ARRANGEMENTS)}, or "
            "FILE.py:NAME"
        )
    values = table(f"{where}.set", content.pop("set", {}))
    part = muscle_of(content.pop("muscle", None), f"{where}.muscle", folder)
    if ":" in name:
        known_keys(where, content, ("arrangement", "muscle", "set"))
        plant = named_plant(name, part, folder)
    else:
        if "muscle2" in content:
            content["muscle2"] = muscle_of(content["muscle2"], f"{where}.muscle2", folder)
        plant = _built(where, _arrangement(f"{where}.arrangement", name), content, part)
    return plant.with_values(
        {n: quantity(f"{where}.set.{n}", v, plant.variable(n).unit) for n, v in values.items()}
    )


def _arrangement(where: str, name: str) -> Callable[..., Plant]:
    for known, kind in ARRANGEMENTS.items():
        if name in (known, re.sub(r"(?<!^)(?=[A-Z])", "_", known).lower()):
            return kind
    raise UnknownNameError(where, name, [*ARRANGEMENTS, "FILE.py:NAME"])


def _built(where: str, kind: Callable[..., Any], given: Mapping[str, Any], *first: Any) -> Any:
    """A plant or component from its arguments in words."""
    allowed = [n for n in inspect.signature(kind).parameters if n != "muscle" or not first]
    title = f"{where} ({kind.__name__})"
    known_keys(title, given, allowed)
    try:
        return kind(*first, **{n: _argument(where, kind, n, v) for n, v in given.items()})
    except TypeError as error:
        raise InputError(f"{title}: {error}") from None


def _argument(where: str, kind: Callable[..., Any], name: str, value: Any) -> Any:
    where = f"{where}.{name}"
    units = _UNITS.get(f"{kind.__name__}.{name}") or _UNITS.get(name, ())
    if isinstance(value, Mapping):
        return _component(where, name, value)
    if isinstance(value, list) and name in _COMPONENTS:
        return tuple(_component(f"{where}[{i}]", name, v) for i, v in enumerate(value))
    if isinstance(value, list):
        return tuple(_argument_entry(where, v, units) for v in value)
    if isinstance(value, str) and not units:
        return value
    if isinstance(value, bool | Muscle):
        return value
    return quantity(where, value, *units)


def _argument_entry(where: str, value: Any, units: tuple[str, ...]) -> Any:
    if isinstance(value, list):
        return tuple(_argument_entry(where, v, units) for v in value)
    return quantity(where, value, *units)


def _component(where: str, role: str, value: Any) -> Any:
    kinds = _COMPONENTS.get(role)
    if kinds is None:
        raise InputError(f"{where} = {value!r}: give a value, not a table")
    given = dict(table(where, value))
    kind = given.pop("kind", next(iter(kinds)) if len(kinds) == 1 else None)
    if kind is None:
        raise InputError(f"{where}.kind is missing; give one of {', '.join(kinds)}")
    if kind not in kinds:
        raise UnknownNameError(f"{where}.kind", kind, kinds)
    return _built(where, kinds[kind], given)


def _member(file: Path, member: str) -> Any:
    """A name of a Python file."""
    spec = importlib.util.spec_from_file_location("users_plant", file)
    if spec is None or spec.loader is None or not file.is_file():
        raise InputError(f"{file}: no such Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not hasattr(module, member):
        raise UnknownNameError(f"name in {file}", member, [n for n in vars(module) if n[0] != "_"])
    return getattr(module, member)

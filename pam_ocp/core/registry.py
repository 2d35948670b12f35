"""Registries: what there is of a kind (laws, loads, feeds, plants, ...), by name.

A component registers in the file that defines it. Whoever takes a name (problem files, the command
line, tables in the docs, error messages) reads the registry; none of them lists anything itself.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import pkgutil
import re
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeAlias, TypeVar

from .errors import InputError, UnknownNameError, with_kinds
from .lazy import load
from .quantities import is_quantity, quantity

Kind = TypeVar("Kind")
Made = TypeVar("Made")
Units: TypeAlias = "Mapping[str, str | tuple[str, ...]]"
"""{argument: its SI unit, or the units that it may have}."""

_REGISTRIES: dict[str, Registry[Any]] = {}


class _NotThere(UnknownNameError, KeyError):
    """Of ``registry[name]``: what a mapping raises, with the nearest names."""

    __str__ = Exception.__str__


@dataclass(frozen=True)
class Argument:
    """An argument of a registered kind, as a problem file and a table want to know it.

    units : the SI units that a value may have; none where it is no quantity.
    default : inspect.Parameter.empty where it must be given.
    """

    name: str
    units: tuple[str, ...]
    default: Any

    @property
    def required(self) -> bool:
        """Whether it has no default."""
        return self.default is inspect.Parameter.empty


class Registry(Mapping[str, Kind], Generic[Kind]):
    """What there is of one kind, by name; a read-only mapping to whom it does not concern.

    noun : what one of them is called ("load"). argument : of plants and components that takes one
    (or several), by which a problem file finds this registry.
    room : package whose modules define them; all are imported when the registry is first asked for
    more than a name that it knows already, so that a new file needs no mention anywhere.
    default : the one that a file means by a table without ``kind``, where there are several.

        LOADS: Registry[type[Load]] = Registry("load", "pam_ocp.plants", argument="loads")

        @LOADS.register(units={"stiffness": ("N/m", "N.m/rad")})
        @dataclass(frozen=True)
        class Spring: ...
    """

    def __init__(self, noun: str, room: str, *, argument: str = "", default: str = "") -> None:
        self.noun, self.argument, self.room, self.default = noun, argument, room, default
        self._kinds: dict[str, Kind] = {}
        self._homes: dict[str, str] = {}
        self._units: dict[str, dict[str, tuple[str, ...]]] = {}
        self._lock, self._complete = threading.RLock(), False
        _REGISTRIES[noun] = self

    # ---- registering --------------------------------------------------------------------------
    def register(
        self, name: str | None = None, *, units: Units | None = None, home: Any = None
    ) -> Callable[[Made], Made]:
        """Decorator that enters a class or function, by its own name if none is given.

        units : of its arguments that are quantities; others are plain numbers, texts or components.
        home : what tells where it is defined, for what is no class or function itself.

        Raises InputError for a name that is taken by another one.
        """

        def entered(made: Made) -> Made:
            key = str(name or getattr(made, "__name__", ""))
            there, own = self._homes.get(key), _home(made if home is None else home)
            if there not in (None, own):
                raise InputError(
                    f"{self.noun} {key!r} is registered already, by {there}; give {own} another "
                    "name"
                )
            self._homes[key] = own
            value: Any = made
            self._kinds[key] = value
            self._units[key] = {
                n: (u,) if isinstance(u, str) else tuple(u) for n, u in (units or {}).items()
            }
            if dataclasses.is_dataclass(made) and isinstance(made, type):
                _with_units(made, self._units[key])
                with_kinds(made)
            return made

        return entered

    def remove(self, name: str) -> None:
        """Take one out again (of a test, a notebook). Raises UnknownNameError."""
        _ = self[name]
        for part in (self._kinds, self._homes, self._units):
            del part[name]

    # ---- reading ------------------------------------------------------------------------------
    def _all(self) -> dict[str, Kind]:
        """The entries, once every module of the room is imported."""
        if not self._complete:
            with self._lock:
                if not self._complete:
                    self._import_room()
        return self._kinds

    def _import_room(self) -> None:
        room = load(self.room)
        for found in pkgutil.walk_packages(room.__path__, f"{self.room}."):
            if not found.name.endswith("_server"):  # scripts of other processes
                load(found.name)
        self._complete = True

    def __iter__(self) -> Iterator[str]:
        return iter(sorted(self._all()))

    def __len__(self) -> int:
        return len(self._all())

    def __contains__(self, name: object) -> bool:
        return name in self._kinds or name in self._all()

    def __getitem__(self, name: str) -> Kind:
        if name not in self:
            raise _NotThere(self.noun, name, sorted(self))
        return self._kinds[name]

    def find(self, where: str, name: object, *more: str) -> Kind:
        """The one that :meth:`name` means."""
        return self._all()[self.name(where, name, *more)]

    def name(self, where: str, given: object, *more: str) -> str:
        """The name that is meant: "SpoolValve", also as "spool_valve".

        where : what asks, for the message. more : what else could have been given there.

        Raises UnknownNameError with the nearest names.
        """
        for known in self:
            if given in (known, _snake(known)):
                return known
        raise UnknownNameError(where, given, [*self, *more])

    def words(self, name: str) -> str:
        """What it is, in one sentence: its ``title``, or the first of its docstring."""
        made: Any = self[name]
        return str(getattr(made, "title", "")) or _first_sentence(inspect.getdoc(made) or "")

    def arguments(self, name: str) -> dict[str, Argument]:
        """The arguments by name, with units and defaults; none of what is not called."""
        made: Any = self[name]
        return arguments(made, self._units[name]) if callable(made) else {}


def _with_units(cls: type, units: Mapping[str, tuple[str, ...]]) -> None:
    """Let a class take texts such as "0.5 N/mm" for its quantities: they become numbers in SI."""
    plain: Callable[..., None] = vars(cls)["__init__"]
    signature = inspect.signature(plain)

    @functools.wraps(plain)
    def converting(self: Any, *args: Any, **kwargs: Any) -> None:
        if any(map(_holds_quantity, (*args, *kwargs.values()))):
            bound = signature.bind_partial(self, *args, **kwargs)
            for name, argument in arguments(cls, units).items():
                if argument.units and name in bound.arguments:
                    where = f"{cls.__name__}.{name}"
                    bound.arguments[name] = _in_si(where, bound.arguments[name], argument.units)
            args, kwargs = bound.args[1:], bound.kwargs
        plain(self, *args, **kwargs)

    setattr(cls, "__init__", converting)  # noqa: B010 - a type checker sees the plain one


def _holds_quantity(value: Any) -> bool:
    return is_quantity(value) or (isinstance(value, list | tuple) and any(map(is_quantity, value)))


def _in_si(where: str, value: Any, units: tuple[str, ...]) -> Any:
    if isinstance(value, list | tuple):
        return tuple(_in_si(where, v, units) for v in value)
    return quantity(where, value, *units) if is_quantity(value) else value


def arguments(
    made: Callable[..., Any], units: Mapping[str, tuple[str, ...]]
) -> dict[str, Argument]:
    """The arguments of a class or function; a plain number's unit is "1"."""
    found, roles = {}, {r.argument for r in _REGISTRIES.values()}
    for name, parameter in inspect.signature(made).parameters.items():
        kind = str(parameter.annotation)  # "Loss | float" is a component, or a number for one
        number = kind == "float" or ("float" in kind and name not in roles)
        own = units.get(name, ("1",) if number else ())
        found[name] = Argument(name, own, parameter.default)
    return found


def registries() -> tuple[Registry[Any], ...]:
    """All registries made so far, by their nouns."""
    return tuple(_REGISTRIES[noun] for noun in sorted(_REGISTRIES))


def registry_of(argument: str) -> Registry[Any] | None:
    """The registry of what this argument takes; None for one that takes no component."""
    return next((r for r in _REGISTRIES.values() if argument and r.argument == argument), None)


def _home(made: Any) -> str:
    module, name = getattr(made, "__module__", "?"), getattr(made, "__qualname__", repr(made))
    return f"{module}.{name}"


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()


def _first_sentence(text: str) -> str:
    paragraph = " ".join(text.partition("\n\n")[0].split())
    paragraph = re.sub(r":\w+:`", "`", paragraph)  # roles mean nothing outside of the docs
    return re.split(r"(?<=[.;])\s+(?=[A-Z`])", paragraph)[0].rstrip(".;:")

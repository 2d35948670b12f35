"""Names of a package that are loaded when they are first asked for (PEP 562)."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import sys
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Any

from .interrupts import interruptible


def _hint(name: str, known: Iterable[str]) -> str:
    if name.startswith("_"):
        return ""
    from .exceptions import nearest

    near = nearest(name, known, 0.7)
    return f"; did you mean {' or '.join(near)}?" if near else ""


def load(name: str) -> ModuleType:
    """A module, loaded now. Ctrl-C that arrives meanwhile comes out behind it, as itself (within it
    Python below 3.12 makes a RuntimeError of it where a class is just being made).
    """
    with interruptible():
        return importlib.import_module(name)


def library(name: str, extra: str, asks: str, called: str = "") -> Any:
    """A library of an extra, imported now. Raises InputError where it is not installed.

    called : what it is called in the message, where that is not its module.
    """
    try:
        return load(name)
    except ImportError:
        from .exceptions import InputError

        raise InputError(
            f"{asks} needs {called or name}, which is not installed: pip install 'pam_ocp[{extra}]'"
        ) from None


def lazily(
    module: str, package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """``__getattr__`` and ``__dir__`` of a module whose names stand elsewhere.

    module : its ``__name__``. homes : {name: the module below ``package`` that defines it}.
    A name is looked up once; from then on it is the module's own.
    """
    return _face(module, homes, lambda name: getattr(load(f"{package}.{homes[name]}"), name))


def _face(
    module: str, homes: Mapping[str, Any], find: Callable[[str], Any]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {module!r} has no attribute {name!r}{_hint(name, homes)}")
        value = find(name)
        if not isinstance(value, ModuleType):  # a submodule becomes one by itself
            vars(sys.modules[module])[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted({*vars(sys.modules[module]), *homes})

    return __getattr__, __dir__


class MovedModules:
    """Finds modules that stand elsewhere now, for pickles that name them.

    homes : {name of the module below ``package``: the one that has its names now}.
    """

    def __init__(self, package: str, homes: Mapping[str, str]) -> None:
        self.homes = {f"{package}.{old}": f"{package}.{new}" for old, new in homes.items()}

    def find_spec(self, name: str, *_: Any) -> ModuleSpec | None:
        loader: Any = self  # importlib.abc takes as long to load as all the rest of the package
        return ModuleSpec(name, loader) if name in self.homes else None

    def create_module(self, spec: ModuleSpec) -> None:
        """One as any other."""

    def exec_module(self, module: ModuleType) -> None:
        home = load(self.homes[module.__name__])
        vars(module)["__getattr__"] = partial(getattr, home)


def from_stub(
    module: str, file: str
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package, read from the stub beside
    ``file``.

    The stub (``__init__.pyi``) is what type checkers and completion see; each of its
    ``from .place import name as name`` is carried out when the name is first asked for, so that the
    list of names stands once. ``from . import room as room`` stands for a submodule. Classes name
    their wrong arguments from then on (:func:`~pam_ocp.core.errors.with_kinds`).
    """
    homes: dict[str, tuple[str, bool]] = {}
    package = sys.modules[module].__package__ or module
    for node in ast.parse(Path(file).with_suffix(".pyi").read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            place = importlib.util.resolve_name("." * node.level + (node.module or ""), package)
            homes |= {alias.name: (place, node.module is None) for alias in node.names}

    def find(name: str) -> Any:
        place, submodule = homes[name]
        if submodule:
            return load(f"{place}.{name}")
        value = getattr(load(place), name)
        if isinstance(value, type) and not issubclass(value, Exception):
            from .errors import with_kinds

            with_kinds(value)
        return value

    return *_face(module, homes, find), sorted(homes)

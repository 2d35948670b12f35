"""Python files of the user's: what stands behind one, and how they are run as they are now."""

from __future__ import annotations

import ast
import importlib.util
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.machinery import ModuleSpec, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from .digest import file_digest, is_installed, named_file, sha, unseen
from .errors import InputError
from .files import read_toml


@dataclass
class Behind:
    """Files that others name or import, and what cannot be followed, each with the reason."""

    files: set[Path] = field(default_factory=set)
    doubts: list[str] = field(default_factory=list)

    def add(self, path: Path) -> None:
        """A file, and all that stands behind it."""
        if any(path.samefile(known) for known in self.files if known.name == path.name):
            return
        self.files.add(path)
        if path.suffix == ".py":
            self._python(path)
        elif path.suffix == ".toml":
            try:
                content = read_toml(path)
            except InputError:  # whoever reads it says so
                return
            self.name(content, path.parent)

    def name(self, content: Any, folder: Path) -> None:
        """The files, and those of the folders, that texts within plain data name."""
        for text in texts(content):
            file, colon, _ = text.partition(".py:")
            place = folder / (f"{file}.py" if colon else text)
            try:
                if place.is_file():
                    self.add(place)
                elif text.strip(".") and place.is_dir():
                    self.files |= {p for p in place.rglob("*") if p.is_file()}
            except (OSError, ValueError):  # a text that no file can be called
                continue

    def _python(self, path: Path, package: str = "") -> None:
        """What a Python file imports, of the user's, and the files that its constants name."""
        try:
            tree = ast.parse(path.read_bytes())
        except (OSError, SyntaxError, ValueError):  # running it says so
            return
        named: list[str] = []
        used: set[str] = set()
        known: set[Path] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                named += [a.name for a in node.names]
            elif isinstance(node, ast.ImportFrom):
                base = "." * node.level + (node.module or "")
                named += [base, *(f"{base.rstrip('.')}.{a.name}" for a in node.names)]
                used |= {n for a in node.names for n in (a.name, f"{base}.{a.name}")}
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                file = named_file(node.value, path.parent)
                if file is not None:
                    known.add(file)
                    self.add(file)
            elif isinstance(node, ast.Attribute | ast.Name):
                used |= _spelled(node)
        used |= {name.partition(".")[0] for name in named}
        self.doubts += [f"{path.name} {why}" for why in unseen(used - {"load"}, len(known))]
        for name in dict.fromkeys(named):
            self._module(name, package)

    def _module(self, name: str, package: str) -> None:
        try:
            full = importlib.util.resolve_name(name, package)
        except ImportError:
            return
        for part, spec in _specs(full):
            if spec.origin is None or is_installed(spec.origin) or part.startswith("pam_ocp"):
                continue
            file = Path(spec.origin)
            if file.suffix != ".py":
                self.doubts.append(f"{file.name} is compiled code")
            elif file not in self.files:
                self.files.add(file)
                inner = part if spec.submodule_search_locations else part.rpartition(".")[0]
                self._python(file, inner)


def behind(content: Any, folder: Path) -> Behind:
    """The files that plain data names, all that those import and name, and doubts."""
    found = Behind()
    found.name(content, folder)
    return found


def texts(content: Any) -> Iterator[str]:
    """The texts within plain data; keys of mappings are none."""
    if isinstance(content, str):
        yield content
    elif isinstance(content, Mapping):
        yield from (t for value in content.values() for t in texts(value))
    elif isinstance(content, list):
        yield from (t for value in content for t in texts(value))


def _spelled(node: ast.Attribute | ast.Name) -> set[str]:
    """The name, also with what it is asked of in front where that is a name, too."""
    if isinstance(node, ast.Name):
        return {node.id}
    owner = {f"{node.value.id}.{node.attr}"} if isinstance(node.value, ast.Name) else set()
    return {node.attr} | owner


def content_digest(path: Path) -> str:
    """Of a file; of a Python file without its comments and lines."""
    if path.suffix == ".py":
        try:
            return sha(ast.dump(ast.parse(path.read_bytes())).encode("utf-8", "replace")).hex()
        except (SyntaxError, ValueError):
            pass
    return file_digest(path)


def _specs(full: str) -> Iterator[tuple[str, ModuleSpec]]:
    """A module and the packages around it, as an import would find them; nothing is run."""
    places: Sequence[str] | None = None
    done = ""
    for part in full.split("."):
        done = f"{done}.{part}" if done else part
        spec = _spec(done, places)
        if spec is None:
            return
        yield done, spec
        if spec.submodule_search_locations is None:
            return
        places = list(spec.submodule_search_locations)


def _spec(name: str, places: Sequence[str] | None) -> ModuleSpec | None:
    for finder in sys.meta_path:
        try:
            spec = finder.find_spec(name, places, None)
        except (AttributeError, ImportError, ValueError):
            continue
        if spec is not None:
            return spec
    return None


# ---- running -------------------------------------------------------------------------------------
class _AsWritten(SourceFileLoader):
    """Compiles what the file holds now. Python's own caches go by its second and its length."""

    def get_code(self, fullname: str) -> Any:
        path = self.get_filename(fullname)
        return self.source_to_code(self.get_data(path), path)


class _Finder:
    """Finds modules of the user's as others do, and has them compiled anew."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name.partition(".")[0] in sys.stdlib_module_names:
            return None
        for finder in sys.meta_path:
            spec = None if finder is _Finder else finder.find_spec(name, path, target)
            if spec is None:
                continue
            if type(spec.loader) is SourceFileLoader and not is_installed(spec.origin):
                spec.loader = _AsWritten(name, str(spec.origin))
            return spec
        return None


@contextmanager
def as_written() -> Iterator[None]:
    """Imports within give the user's modules as their files are now; afterwards all is as before.

    A module that this process imported earlier may be another than its file by now.
    """
    before = {n: m for n, m in sys.modules.items() if _own(n, m)}
    for name in before:
        del sys.modules[name]
    finder: Any = _Finder
    importlib.invalidate_caches()
    sys.meta_path.insert(0, finder)
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        for name in [n for n, m in sys.modules.items() if _own(n, m)]:
            del sys.modules[name]
        sys.modules.update(before)


def _own(name: str, module: ModuleType) -> bool:
    file = getattr(module, "__file__", None)
    loader = getattr(module, "__loader__", None)
    return (
        name.partition(".")[0] not in ("pam_ocp", "__main__", "__mp_main__")
        and isinstance(loader, SourceFileLoader)
        and not is_installed(file)
    )


def module_of(path: Path) -> ModuleType:
    """A Python file, run. Raises InputError where there is none, and what running it raises."""
    spec = importlib.util.spec_from_loader("users_plant", _AsWritten("users_plant", str(path)))
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError(f"{path}: no such Python file")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        place = f"{error.filename or path}, line {error.lineno}"
        raise InputError(f"{place}: {error.msg}; mend it there") from error
    return module

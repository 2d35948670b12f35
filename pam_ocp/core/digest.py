"""A digest of what runs: the same in any process, another after any change that can be seen.

Functions count by their code, defaults, closures and the globals that they name, those of the user
recursively; classes by their members and bases; objects by their state (as they travel, PEP 307);
installed packages by their version; files that a constant names by their content. Comments, line
numbers and what is never reached do not count.

What cannot be told from something else (compiled functions, open files, modules that are named only
as it runs) is listed as a doubt: whoever keeps results by a digest computes those anew.
"""

from __future__ import annotations

import builtins
import copyreg
import dis
import hashlib
import importlib.util
import os
import pickle
import re
import sys
import sysconfig
import threading
import types
import weakref
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, singledispatch
from importlib import metadata
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from .. import __version__
from .errors import kind_of

DEEPEST = 200
"""Objects within objects."""
DERIVED = frozenset({"__firstlineno__", "__static_attributes__", "__doc__"})
"""Members of a class that come from where and how it is written."""
MODULE = frozenset(vars(types.ModuleType(""))) | frozenset(
    f"__{n}__" for n in ("builtins", "file", "cached", "path", "annotations", "warningregistry")
)
"""Members of a module that come from where it lies."""
READERS = ("open", "loadtxt", "genfromtxt", "fromfile", "memmap", "loadmat")
"""Names of what reads a file; so do those that begin with read_ or load_."""
_ASKS = {
    "runs code that is text": "eval exec",
    "imports what is named as it runs": "__import__ import_module",
    "runs a file that is named as it runs": "run_path",
    "looks up names as it runs": "globals sys.modules",
    "reads the environment": "environ getenv",
    "reads the command line": "sys.argv",
    "runs another program": "subprocess os.popen os.system posix.system",
    "asks other machines": "socket urllib http requests",
    "asks a database": "sqlite3",
    "asks at the keyboard": "input",
    "asks the clock": "time.time time.time_ns time.perf_counter time.monotonic now utcnow",
    "is another at each call": "uuid1 uuid4 urandom secrets",
    "calls compiled code": "CDLL LoadLibrary",
}
HIDDEN = {name: why for why, names in _ASKS.items() for name in names.split()}
"""What leads out of sight, {name, module, or name in a module: what it does}."""


@dataclass(frozen=True)
class Digest:
    """text : SHA-256 in hexadecimal. doubts : what could be something else, and why."""

    text: str
    doubts: tuple[str, ...] = ()


def digest_of(value: Any) -> Digest:
    """Of data, functions and objects."""
    walk = _Walk()
    found = walk.of(value).hex()
    return Digest(found, tuple(dict.fromkeys(walk.doubts)))


def sha(*parts: bytes) -> bytes:
    """SHA-256 of parts that are told from each other."""
    found = hashlib.sha256()
    for part in parts:
        found.update(len(part).to_bytes(8, "little") + part)
    return found.digest()


def unseen(names: Iterable[str], files: int) -> list[str]:
    """Why code that uses these names of modules and builtins may do more than can be seen.

    names : each as often as it stands there. files : how many files it names.
    """
    used = Counter(names)
    found = [f"{why} ({name})" for name, why in HIDDEN.items() if name in used]
    reading = [n for n in sorted(used) if n in READERS or n.startswith(("read_", "load_"))]
    if "load" in used and not files:  # of json takes what open gave, of NumPy opens by itself
        reading.append("load")
    if sum(used[n] for n in reading) > files:
        found += [f"reads a file that is named as it runs ({n})" for n in reading]
    return found


# ---- files and packages --------------------------------------------------------------------------
def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    found = hashlib.sha256()
    with path.open("rb") as file:
        for block in iter(lambda: file.read(2**20), b""):
            found.update(block)
    return found.hexdigest()


def named_file(text: str, *folders: Path) -> Path | None:
    """The file that a text names, from the working folder or one of these."""
    if not 2 < len(text) < 500 or not set(text) & {".", "/", os.sep} or "\n" in text:
        return None
    for folder in (Path(), *folders):
        try:
            if (folder / text).is_file():
                return folder / text
        except (OSError, ValueError):  # a text that no file can be called
            continue
    return None


@cache
def own_digest() -> str:
    """Of the files of pam_ocp, which may be installed from a working tree."""
    package = Path(__file__).parents[1]
    endings = (".py", ".toml", ".csv", ".c", ".h", ".html")
    folders = (package, package.parent / "fmu")
    files = sorted(p for f in folders for p in f.rglob("*") if p.suffix in endings)
    return sha(*(part for p in files for part in (p.name.encode(), p.read_bytes()))).hex()


@cache
def built_with(*packages: str) -> Mapping[str, str]:
    """{"Python", "pam_ocp" and each package: its version}."""
    versions = {name: _version(name) or "not installed" for name in packages}
    return {"Python": sys.version.split()[0], "pam_ocp": __version__, **versions}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


_PYTHON = tuple(Path(sysconfig.get_path(p)).resolve() for p in ("stdlib", "platstdlib"))


def is_installed(file: str | None) -> bool:
    """Whether a module of this file (None: of the interpreter) comes from an installation."""
    return file is None or _installed(file if os.path.isabs(file) else os.path.abspath(file))


@cache
def _installed(file: str) -> bool:
    # asked of all modules of a process at every step of a study: links are followed once
    path = Path(file).resolve()
    apart = {"site-packages", "dist-packages"} & set(path.parts)
    return bool(apart) or any(path.is_relative_to(p) for p in _PYTHON)


def _release(name: Any) -> str | None:
    """An installed module by its package's version; None for one of the user's."""
    if not isinstance(name, str):  # what has no module, or says so in its own way
        return None
    top, module = name.partition(".")[0], sys.modules.get(name)
    if top == "pam_ocp":
        return f"pam_ocp {own_digest()}"
    if module is None or top == "__main__":
        return None
    spec = getattr(module, "__spec__", None)
    file = getattr(module, "__file__", None)
    if (file is None and (spec is None or spec.origin is None)) or not is_installed(file):
        return None
    return _package_release(top)


@cache
def _package_release(top: str) -> str:
    if top in sys.stdlib_module_names:
        return f"python {sys.version}"
    found = _version(top)
    if found is None:
        named = metadata.packages_distributions().get(top, ())
        found = ", ".join(f"{n} {_version(n)}" for n in sorted(set(named)))
    return f"{top} {found or getattr(sys.modules[top], '__version__', '')}"


def _by_name(value: Any) -> bool:
    """Whether its module leads to it by its name."""
    found: Any = sys.modules.get(value.__module__)
    for part in str(getattr(value, "__qualname__", getattr(value, "__name__", ""))).split("."):
        found = getattr(found, part, None)
    return found is value


# ---- code ----------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Seen:
    """What of a code object counts, in the order of its instructions."""

    steps: tuple[Any, ...]
    chains: tuple[tuple[str, ...], ...]
    """Names that are looked up outside, each with the attributes that are asked of it."""
    imports: tuple[tuple[str, int, tuple[str, ...]], ...]
    """(module, dots in front, names taken from it)."""
    attributes: tuple[str, ...]
    """Of whatever else."""


@lru_cache(maxsize=4096)
def _seen(code: types.CodeType) -> _Seen:
    steps: list[Any] = []
    chains: list[tuple[str, ...]] = []
    imports: list[tuple[str, int, tuple[str, ...]]] = []
    attributes: list[str] = []
    chained = False
    for step in dis.get_instructions(code):
        if step.opname == "EXTENDED_ARG":
            continue
        if step.opname == "STORE_NAME" and step.argval in DERIVED:
            steps = steps[:-1]
            continue
        argument = step.argval
        follows = step.opname in ("LOAD_ATTR", "LOAD_METHOD")
        if step.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
            chains.append((str(argument),))
        elif follows and chained:
            chains[-1] = (*chains[-1], str(argument))
        elif follows:
            attributes.append(str(argument))
        elif step.opname == "IMPORT_NAME":
            level, names = steps[-2][1], steps[-1][1]
            imports.append((str(argument), int(level or 0), tuple(names or ())))
        chained = step.opname in ("LOAD_GLOBAL", "LOAD_NAME") or (follows and chained)
        steps.append((step.opname, argument))
    return _Seen(tuple(steps), tuple(chains), tuple(imports), tuple(attributes))


def _parts(code: types.CodeType) -> Iterator[types.CodeType]:
    """A code object and those within it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from _parts(constant)


# ---- the walk ------------------------------------------------------------------------------------
_LEAVES = (int, float, complex, bool, bytes, bytearray, range, slice, type(None), type(...))
_SLOTS = ("__dict__", "__weakref__")
_WRAPPED = ("fget", "fset", "fdel", "func", "__func__", "__wrapped__", "dispatcher", "args")
_WEAK = (weakref.WeakKeyDictionary, weakref.WeakValueDictionary)
_LOCKS = (type(threading.Lock()), type(threading.RLock()), threading.Event, threading.Condition)
_COMPILED = (
    types.BuiltinFunctionType,
    types.MethodWrapperType,
    types.WrapperDescriptorType,
    types.MethodDescriptorType,
    types.ClassMethodDescriptorType,
    types.GetSetDescriptorType,
    types.MemberDescriptorType,
)


class _Walk:
    """Digests of objects that lead to each other."""

    def __init__(self) -> None:
        self.doubts: list[str] = []
        self._open: dict[int, int] = {}
        """Objects that we are within, by how deep they lie."""
        self._done: dict[int, tuple[Any, bytes]] = {}
        """With the object, so that no other takes its number."""

    def of(self, value: Any) -> bytes:
        kind = type(value).__qualname__.encode()
        if type(value) in _LEAVES:
            return sha(kind, repr(value).encode())
        if isinstance(value, str | PurePath):
            return sha(kind, str(value).encode("utf-8", "surrogatepass"), self._content(str(value)))
        key = id(value)
        if key in self._done:
            return self._done[key][1]
        if key in self._open:
            return sha(b"around", str(len(self._open) - self._open[key]).encode())
        if len(self._open) > DEEPEST:
            return self._doubt(value, "is nested too deeply")
        self._open[key] = len(self._open)
        try:
            found = sha(kind, *self._pieces(value))
        finally:
            del self._open[key]
        self._done[key] = value, found
        return found

    def _doubt(self, value: Any, why: str) -> bytes:
        name = getattr(value, "__qualname__", None) or kind_of(value)
        self.doubts.append(f"{name} {why}")
        return b"doubt"

    def _content(self, text: str) -> bytes:
        path = named_file(text)
        try:
            return b"" if path is None else file_digest(path).encode()
        except OSError:
            return self._doubt(text, f"{text} cannot be read")

    def _all(self, *values: Any) -> Iterator[bytes]:
        return (self.of(v) for v in values)

    def _pieces(self, value: Any) -> Iterator[bytes]:
        if type(value) in (dict, types.MappingProxyType):
            keys = sorted(((self.of(k), k) for k in value), key=lambda pair: pair[0])
            yield from (part for found, k in keys for part in (found, self.of(value[k])))
        elif type(value) in (list, tuple):
            yield from self._all(*value)
        elif type(value) in (set, frozenset):
            yield from sorted(self._all(*value))
        elif isinstance(value, np.generic) or (
            type(value) is np.ndarray and value.dtype != object and not value.dtype.hasobject
        ):
            yield repr((value.dtype.descr, value.shape)).encode()
            yield np.ascontiguousarray(value).tobytes()
        elif isinstance(value, types.CodeType):
            yield from self._code(value)
        elif isinstance(value, types.ModuleType):
            yield from self._module(value)
        elif isinstance(value, types.MethodType):
            yield from self._all(value.__func__, value.__self__)
        elif isinstance(value, types.CellType):
            yield from self._cell(value)
        elif isinstance(value, _COMPILED):
            yield from self._compiled(value)
        elif isinstance(value, type | types.FunctionType) and self._released(value):
            yield f"{value.__module__}.{value.__qualname__} {_release(value.__module__)}".encode()
        elif isinstance(value, types.FunctionType):
            yield from self._function(value)
        elif isinstance(value, type):
            yield from self._class(value)
        else:
            yield from self._object(value)

    @staticmethod
    def _released(value: Any) -> bool:
        return _release(getattr(value, "__module__", None)) is not None and _by_name(value)

    def _cell(self, cell: types.CellType) -> Iterator[bytes]:
        try:
            yield self.of(cell.cell_contents)
        except ValueError:
            yield b"empty"

    def _compiled(self, value: Any) -> Iterator[bytes]:
        """A function of the interpreter or of an extension."""
        owner = getattr(value, "__self__", None)
        if owner is None or isinstance(owner, types.ModuleType):
            owner = getattr(value, "__objclass__", None)
        yield str(getattr(value, "__qualname__", value.__name__)).encode()
        if owner is not None:
            yield self.of(owner)
        elif not self._released(value):
            yield self._doubt(value, "is compiled code")

    # ---- functions ------------------------------------------------------------------------------
    def _function(self, function: types.FunctionType) -> Iterator[bytes]:
        code = function.__code__
        yield from self._all(code, function.__defaults__, function.__kwdefaults__)
        remembers = code.co_filename == singledispatch.__code__.co_filename
        for cell in function.__closure__ or ():
            if not (remembers and isinstance(cell.cell_contents, _WEAK)):  # what it looked up
                yield self.of(cell)
        yield self.of({n: v for n, v in vars(function).items() if n != "_clear_cache"})
        within = [_seen(part) for part in _parts(code)]
        chains = sorted({c for part in within for c in part.chains})
        values = [_looked_up(function, chain) for chain in chains]
        yield repr(chains).encode()
        yield from self._all(*values)
        for name, level, taken in sorted({i for part in within for i in part.imports}):
            yield repr((name, level, taken)).encode()
            yield self._imported(function, name, level, taken)
        texts = [a for part in within for _, a in part.steps if isinstance(a, str)]
        texts += [str(v) for v in (*values, *_held(function)) if isinstance(v, str | PurePath)]
        files = {named_file(t, Path(code.co_filename).parent) for t in texts} - {None}
        yield from (self._content(str(path)) for path in sorted(map(str, files)))
        self._out_of_sight(function, within, len(files))

    def _imported(
        self, function: types.FunctionType, name: str, level: int, taken: tuple[str, ...]
    ) -> bytes:
        """What an import within the function gives, which it will import anyway."""
        try:
            package = function.__globals__.get("__package__") or ""
            full = importlib.util.resolve_name("." * level + name, package)
            module = importlib.import_module(full)
        except Exception:  # whatever a module raises
            return b"absent"
        if _release(module.__name__) is not None or not taken or "*" in taken:
            return self.of(module)
        return sha(*self._all(*(getattr(module, n, "absent") for n in taken)))

    def _out_of_sight(self, function: types.FunctionType, within: list[_Seen], files: int) -> None:
        """Doubts about what it asks of installed modules."""
        used: list[str] = []
        paths = False
        for chain in (c for part in within for c in part.chains):
            root = function.__globals__.get(chain[0], getattr(builtins, chain[0], None))
            used += self._asked(root, chain)
            paths = paths or isinstance(root, PurePath) or {"Path", "pathlib"} & set(chain) != set()
        paths = paths or any(isinstance(v, PurePath) for v in _held(function))
        asked = [n for part in within for n in part.attributes]
        used += [n for n in asked if n.startswith("read_") or (paths and n == "open")]
        used += [name.partition(".")[0] for part in within for name, level, _ in part.imports]
        for why in unseen(used, files):
            self._doubt(function, why)

    def _asked(self, root: Any, chain: tuple[str, ...]) -> list[str]:
        """Of an installed module: the names, those with the module in front, and the module."""
        if isinstance(root, types.ModuleType):
            home = root.__name__ if _release(root.__name__) else ""
        else:
            home = str(getattr(root, "__module__", "")) if self._released(root) else ""
        if not home:
            return []
        last = chain[1] if isinstance(root, types.ModuleType) and len(chain) > 1 else chain[0]
        return [*chain, f"{home}.{last}", *({home.partition(".")[0]} - set(chain))]

    def _code(self, code: types.CodeType) -> Iterator[bytes]:
        arguments = code.co_argcount + code.co_kwonlyargcount
        shape = (code.co_flags, code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount)
        yield repr((shape, code.co_varnames[:arguments], code.co_freevars)).encode()
        yield getattr(code, "co_exceptiontable", b"")
        for name, argument in _seen(code).steps:
            yield name.encode()
            yield self.of(argument)

    # ---- modules, classes, objects --------------------------------------------------------------
    def _module(self, module: types.ModuleType) -> Iterator[bytes]:
        yield module.__name__.encode()
        release = _release(module.__name__)
        if release is not None:
            yield release.encode()
        else:
            yield self.of({n: v for n, v in vars(module).items() if n not in MODULE})

    def _class(self, kind: type) -> Iterator[bytes]:
        yield kind.__qualname__.encode()
        yield from self._all(type(kind), *kind.__bases__)
        for name, member in sorted(vars(kind).items()):
            routine = callable(member) or hasattr(member, "__get__")
            plain = type(member) in (*_LEAVES, str) and name not in (*DERIVED, "__module__")
            if name[:2] == "__" and not plain and (not routine or name in _SLOTS):
                continue
            if name != "_abc_impl":
                yield name.encode()
                yield self.of(member)

    def _object(self, value: Any) -> Iterator[bytes]:
        """By its class and its state, as copies are made of it."""
        wrapped = [getattr(value, n) for n in _WRAPPED if hasattr(value, n)]
        if wrapped and type(value).__module__ in ("builtins", "functools"):
            yield from self._all(*wrapped, getattr(value, "keywords", None))
        elif hasattr(value, "serialize") and type(value).__module__.startswith("casadi"):
            yield from self._casadi(value)
        elif isinstance(value, _WEAK):
            yield self.of(dict(value))
        elif isinstance(value, weakref.ref):
            yield self.of(value())
        elif value is os.environ:
            yield self._doubt(value, HIDDEN["environ"])
        else:
            yield from self._reduced(value)

    def _casadi(self, value: Any) -> Iterator[bytes]:
        """CasADi's own writing of a function; what it calls from outside stands in none."""
        inner = [value, *(value.find_functions() if hasattr(value, "find_functions") else ())]
        for part in inner:
            if re.search("External|Callback", getattr(part, "class_name", str)()):
                yield self._doubt(value, "calls compiled code")
        try:
            yield str(value.serialize()).encode()
        except Exception:  # of CasADi
            yield self._doubt(value, "calls code that CasADi cannot write down")

    def _reduced(self, value: Any) -> Iterator[bytes]:
        try:
            reduce = copyreg.dispatch_table.get(type(value))
            found = reduce(value) if reduce else value.__reduce_ex__(4)
        except Exception:  # whatever a class raises that does not travel
            yield self._doubt(value, "has a state that cannot be read")
            return
        yield self.of(type(value))
        if isinstance(found, str):
            home = str(pickle.whichmodule(value, found))  # type: ignore[attr-defined]
            yield f"{home}.{found} {_release(home)}".encode()
            if _release(home) is None or getattr(sys.modules[home], found, None) is not value:
                yield self._doubt(value, "has a state that cannot be read")
            return
        made, arguments, state, items, entries = (*found, None, None, None)[:5]
        yield from self._all(made, arguments, _stated(type(value), state))
        if _release(type(value).__module__) is None:  # what its author keeps from copies counts
            told = state if isinstance(state, dict) else {}
            left = {n: v for n, v in getattr(value, "__dict__", {}).items() if n not in told}
            left = {n: v for n, v in left.items() if not isinstance(v, _LOCKS)}
            yield self.of(_stated(type(value), left))
        yield from self._all(*(items or ()))
        yield self.of(dict(entries or ()))


def _looked_up(function: types.FunctionType, chain: tuple[str, ...]) -> Any:
    """What a name means; of a module, the attribute that is asked for, if it is of the user's.

    What an installed module has of its own goes by its version.
    """
    around = function.__globals__
    if chain[0] not in around:
        return getattr(builtins, chain[0], "absent")
    value = around[chain[0]]
    for name in chain[1:]:
        if not isinstance(value, types.ModuleType):
            break
        found = getattr(value, name, "absent")
        if _release(value.__name__) is not None and not _put_there(found):
            break
        value = found
    return value


def _put_there(found: Any) -> bool:
    """Whether a user may have put it into an installed module: his code, or a number."""
    if isinstance(found, types.FunctionType | type):
        return _release(found.__module__) is None
    return type(found) in (int, float, complex)


def _held(function: types.FunctionType) -> Iterator[Any]:
    """Its defaults, and what its closure holds."""
    yield from function.__defaults__ or ()
    yield from (function.__kwdefaults__ or {}).values()
    for cell in function.__closure__ or ():
        with suppress(ValueError):  # empty
            yield cell.cell_contents


def _stated(kind: type, state: Any) -> Any:
    """A state without what was computed from the rest of it."""
    if isinstance(state, tuple) and len(state) == 2:
        return tuple(_stated(kind, part) for part in state)
    if not isinstance(state, dict):
        return state
    return {n: v for n, v in state.items() if not isinstance(_member(kind, n), cached_property)}


def _member(kind: type, name: Any) -> Any:
    return next((vars(k)[name] for k in kind.__mro__ if name in vars(k)), None)

"""From C sources to shared libraries for every platform, on one machine, with a cache."""

from __future__ import annotations

import logging
import os
import platform as host
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from functools import cache
from importlib import metadata, util
from pathlib import Path

from ..core.errors import ExportError, InputError, UnknownNameError, require_names
from ..core.processes import Processes
from .cache import digest, home_folder, keep, kept, usable_folder
from .source import c_text

LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Platform:
    """A platform: its name in FMI 3, its folder in FMI 2, zig's name for it, the file's ending."""

    name: str
    folder2: str
    target: str
    suffix: str
    on_request: bool = False
    """Built only when asked for by name."""


PLATFORMS = {
    p.name: p
    for p in (
        Platform("x86_64-linux", "linux64", "x86_64-linux-gnu.2.17", ".so"),
        Platform("aarch64-linux", "aarch64-linux", "aarch64-linux-gnu.2.17", ".so"),
        Platform("x86_64-windows", "win64", "x86_64-windows-gnu", ".dll"),
        Platform("x86_64-darwin", "darwin64", "x86_64-macos.11.0", ".dylib"),
        Platform("aarch64-darwin", "darwin64", "aarch64-macos.11.0", ".dylib"),
        Platform("x86-linux", "linux32", "x86-linux-gnu.2.17", ".so", on_request=True),
        Platform("x86-windows", "win32", "x86-windows-gnu", ".dll", on_request=True),
        Platform("aarch64-windows", "aarch64-windows", "aarch64-windows-gnu", ".dll", True),
    )
}
"""Every platform that can be built, by its name. On 32-bit x86 zig computes with SSE2, so that the
bits are those of x86_64."""

_WINDOWS_SOURCE = "windows.c"
_WINDOWS_FLAGS = (
    "-nostdlib",
    "-D_UCRT",
    "-Wl,-e,DllMainCRTStartup",
    *(f"-lapi-ms-win-crt-{part}-l1-1-0" for part in ("math", "heap", "stdio", "string")),
)
"""For zig: Windows' own runtime (UCRT) alone, and fmu/src/windows.c in place of its static part,
which zig would have to build first: most of a minute on a new machine."""

_FLAGS = ("-std=c11", "-O2", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-s")
_MSVC_FLAGS = ("/nologo", "/std:c11", "/O2", "/LD", "/fp:precise", "/utf-8")


def platforms_named(names: Iterable[str] | None) -> tuple[Platform, ...]:
    """The platforms of these names ("native": this machine's; "source" alone: none); for None all
    but those on request.

    Raises UnknownNameError, and InputError for "source" beside others.
    """
    if names is None:
        return tuple(p for p in PLATFORMS.values() if not p.on_request)
    chosen = require_names("platforms", names)
    if list(chosen) == ["source"]:
        return ()
    if "source" in chosen:
        raise InputError(f"platforms = {chosen}: 'source' means no binaries at all; give it alone")
    for name in chosen:
        if name != "native" and name not in PLATFORMS:
            raise UnknownNameError("platform", name, ["native", "source", *PLATFORMS])
    wanted = {native().name if n == "native" else n for n in chosen}
    if not wanted:
        raise ExportError("platforms is empty; name at least one, such as 'native'")
    return tuple(p for p in PLATFORMS.values() if p.name in wanted)


_MACHINES = {"amd64": "x86_64", "arm64": "aarch64", "i386": "x86", "i586": "x86", "i686": "x86"}


def native() -> Platform:
    """The platform of this machine. Raises ExportError when FMUs are not built for it."""
    machine = _MACHINES.get(host.machine().lower(), host.machine().lower())
    if machine == "x86_64" and sys.maxsize < 2**32:  # a 32-bit Python on a 64-bit processor
        machine = "x86"
    name = f"{machine}-{host.system().lower()}"
    if name not in PLATFORMS:
        raise ExportError(f"this machine is {name}; FMUs can be built for {', '.join(PLATFORMS)}")
    return PLATFORMS[name]


# ---- compilers ----------------------------------------------------------------------------------


CROSS = "pip install 'pam_ocp[cross]'"
_PROBE = "#include <math.h>\ndouble probe(double x);\ndouble probe(double x) { return exp(x); }\n"


@dataclass(frozen=True)
class _Compiler:
    command: tuple[str, ...]
    version: str
    """Part of the cache's key."""
    cross: bool = False
    """zig, which builds for every platform."""


@cache
def _zig() -> _Compiler | None:
    """The cross compiler, where the extra [cross] is installed."""
    if util.find_spec("ziglang") is None:
        return None
    command = (sys.executable, "-m", "ziglang", "cc")
    return _Compiler(command, f"zig {metadata.version('ziglang')}", True)


@cache
def _local() -> _Compiler | None:
    """The first C compiler of this machine that makes a shared library when it is tried."""
    names = ("cl", "gcc", "clang") if os.name == "nt" else ("cc", "gcc", "clang")
    for path in filter(None, map(shutil.which, names)):
        version = () if Path(path).stem.lower() == "cl" else ("--version",)  # cl shows it of itself
        shown = subprocess.run([path, *version], capture_output=True, text=True, check=False)
        line = (shown.stdout or shown.stderr).partition("\n")[0]
        compiler = _Compiler((path,), line)
        platform = native()
        output = f"probe{platform.suffix}"
        command = _command(compiler, platform, output, "probe.c")
        try:
            with Processes() as running:
                _compile(running, {"probe.c": _PROBE}, command, output, platform)
        except (ExportError, OSError) as error:
            LOG.info("%s is not used: %s", path, error)
        else:
            return compiler
    return None


def _compiler(platform: Platform, alone: bool) -> _Compiler:
    """Who builds for this platform: for this machine ``alone`` its own compiler where there is
    one; else zig, so that a unit for several platforms has the same bytes wherever it is made.
    """
    here = platform == native()
    compiler = (_local() if here and alone else None) or _zig() or (_local() if here else None)
    if compiler is not None:
        return compiler
    if here:
        raise ExportError(
            "no C compiler works here; install one (gcc, clang, Visual C++), or the cross compiler "
            f"of the extra [cross]: {CROSS}"
        )
    raise ExportError(
        f"binaries for {platform.name}, another platform than this machine's, need the cross "
        f"compiler of the extra [cross]: {CROSS}; or give platforms='native'"
    )


def _command(compiler: _Compiler, platform: Platform, output: str, source: str) -> list[str]:
    if Path(compiler.command[0]).stem.lower() == "cl":  # of MSVC
        return [*compiler.command, *_MSVC_FLAGS, source, f"/Fe:{output}", "/link", "/Brepro"]
    command = [*compiler.command, *_FLAGS]
    if compiler.cross:
        command += ["-target", platform.target]
    elif platform.name.startswith("x86-"):  # as zig does; the machine may be one of 64 bits
        command += ["-m32", "-msse2", "-mfpmath=sse"]
    if platform.suffix != ".dll":
        command.append("-fPIC")
    if platform.suffix == ".dylib":
        command.append(f"-Wl,-install_name,@rpath/{output}")
    command += ["-o", output, source]
    if compiler.cross and platform.suffix == ".dll":
        command += [_WINDOWS_SOURCE, *_WINDOWS_FLAGS]
    if platform.suffix == ".so":
        command += [f"-Wl,-soname,{output}", "-lm"]
    return command


# ---- compiling, what is in the cache comes from there -------------------------------------------


def _key(sources: Mapping[str, str], command: Iterable[str], version: str) -> str:
    parts = (version, *command, *(t for item in sorted(sources.items()) for t in item))
    return digest(b"".join(f"{len(part)}:".encode() + part.encode() for part in parts))


def compile_library(
    sources: Mapping[str, str],
    main: str,
    platform: Platform,
    identifier: str,
    processes: Processes | None = None,
    alone: bool = True,
) -> bytes:
    """The shared library ``identifier`` for one platform, from the cache when it is there.

    processes : among them the compiler runs, where several do. alone : nothing is built for other
    platforms with it. Raises ExportError where there is no compiler for the platform, and with the
    compiler's words when the sources do not compile.
    """
    compiler = _compiler(platform, alone)
    output = f"{identifier}{platform.suffix}"
    command = _command(compiler, platform, output, main)
    if _WINDOWS_SOURCE in command:
        sources = {**sources, _WINDOWS_SOURCE: c_text(_WINDOWS_SOURCE)}
    shown = command[len(compiler.command) :]
    stored = usable_folder("fmu") / f"{_key(sources, shown, compiler.version)}{platform.suffix}"
    library = kept(stored)
    LOG.info("%s: %s", output, "compiling" if library is None else "from the cache")
    if library is None:
        with nullcontext(processes) if processes else Processes() as running:
            library = _compile(running, sources, command + _headers(command), output, platform)
        keep(stored, library)
    return library


def _headers(command: Iterable[str]) -> list[str]:
    """Where Windows' headers are, which zig leaves out with -nostdlib (a path: not in the key)."""
    spec = util.find_spec("ziglang")
    if _WINDOWS_SOURCE not in command or spec is None or spec.origin is None:
        return []
    return ["-isystem", str(Path(spec.origin).parent / "lib/libc/include/any-windows-any")]


def _compile(
    running: Processes,
    sources: Mapping[str, str],
    command: list[str],
    output: str,
    platform: Platform,
) -> bytes:
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as name:
        folder = Path(name)
        for file, text in sources.items():
            (folder / file).write_text(text, encoding="utf-8", newline="\n")
        # relative names and an empty surrounding: no path of this machine gets into the binary
        done = running.run(command, folder, _environment())
        if done.returncode != 0:
            words = (done.stderr or done.stdout).strip().splitlines()[:5]
            raise ExportError(f"the compiler failed for {platform.name}: {' / '.join(words)}")
        return (folder / output).read_bytes()


def _environment() -> dict[str, str]:
    """This process's environment; zig's cache beside ours where that is chosen, or needed."""
    environment = dict(os.environ)
    if "ZIG_GLOBAL_CACHE_DIR" not in environment and (
        environment.get("PAM_OCP_CACHE") or not _zig_finds_a_place()
    ):
        environment["ZIG_GLOBAL_CACHE_DIR"] = str(usable_folder("zig"))
        environment.setdefault("ZIG_LOCAL_CACHE_DIR", environment["ZIG_GLOBAL_CACHE_DIR"])
    return environment


def _zig_finds_a_place() -> bool:
    """Whether zig can write to the cache folder that it takes of itself."""
    home = home_folder()
    chosen = os.environ.get("XDG_CACHE_HOME")
    if not chosen and home is None:
        return False
    place = Path(chosen) if chosen else Path(home or "/") / ".cache"
    there = next((p for p in (place, *place.parents) if p.exists()), place)
    return place.is_absolute() and os.access(there, os.W_OK | os.X_OK)


def compile_all(
    sources: Mapping[str, str], main: str, platforms: Iterable[Platform], identifier: str
) -> dict[str, bytes]:
    """The library for each platform, by the platform's name; two compilers at a time."""
    chosen = list(platforms)
    alone = chosen == [p for p in chosen if p == native()]
    for platform in chosen:  # before the first one is built
        _compiler(platform, alone)
    with ThreadPoolExecutor(max_workers=2) as pool, Processes() as running:

        def compiled(platform: Platform) -> bytes:
            return compile_library(sources, main, platform, identifier, running, alone)

        try:
            return dict(zip((p.name for p in chosen), pool.map(compiled, chosen), strict=True))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


# ---- macOS: two processors in one file ----------------------------------------------------------

_CPU = {"x86_64-darwin": (0x01000007, 3), "aarch64-darwin": (0x0100000C, 0)}
_FAT_MAGIC, _ALIGNMENT = 0xCAFEBABE, 14


def universal(libraries: Mapping[str, bytes]) -> bytes:
    """One universal Mach-O file of libraries by platform name (FMI 2 has one folder for macOS)."""
    if len(libraries) == 1:
        return next(iter(libraries.values()))
    page = 1 << _ALIGNMENT
    header = struct.pack(">II", _FAT_MAGIC, len(libraries))
    body, offset = b"", page
    for name, library in libraries.items():
        header += struct.pack(">IIIII", *_CPU[name], offset, len(library), _ALIGNMENT)
        padded = library + bytes(-len(library) % page)
        body += padded
        offset += len(padded)
    return header + bytes(page - len(header)) + body

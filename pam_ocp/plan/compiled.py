"""A program's functions as machine code: C by CasADi, compiled by zig or cc, kept by content.

It pays where the functions cost more than the linear algebra: on re-solves by shooting, 0.3 to 0.4 of
the time; for collocation 0.7 to 0.9. The compiler takes a few seconds, once.
(``benchmarks/resolve.py``.)
"""

from __future__ import annotations

import hashlib
import tempfile
from pathlib import Path

import casadi as ca

from ..errors import ExportError, InputError
from ..files import atomic_path

__all__ = ["compiled"]

NAME = "pam_ocp_plan"
HEAD = """\
#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))
#pragma GCC diagnostic ignored "-Wint-conversion"
"""
"""The compiler is told to hide what is not declared otherwise; and where a mapped function has an
argument without entries, CasADi copies nothing to an address written as a number."""


def compiled(solver: ca.Function) -> str:
    """The path of a library with a solver's problem and derivatives, for ``casadi.nlpsol(name, "ipopt", path)``.

    Raises InputError where there is no C compiler.
    """
    from ..fmu.compile import cache_folder, compile_library, native

    generator = ca.CodeGenerator(f"{NAME}.c")
    generator.add(solver.oracle())
    for name in solver.get_function():
        generator.add(solver.get_function(name))
    source = f"{NAME}.c"
    try:
        platform = native()
        library = compile_library({source: HEAD + generator.dump()}, source, platform, NAME)
    except ExportError as error:
        raise InputError(f"compiled = True: {error}; or leave compiled out") from None
    name = f"{hashlib.sha256(library).hexdigest()}{platform.suffix}"
    return str(_stored(cache_folder() / "plan" / name, library))


def _stored(path: Path, library: bytes) -> Path:
    """The library as a file: in the cache, else in a folder of its own."""
    try:
        if path.read_bytes() == library:
            return path
    except OSError:
        pass  # not there yet
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as part:
            part.write_bytes(library)
    except OSError:
        path = Path(tempfile.mkdtemp(prefix="pam_ocp_")) / path.name
        path.write_bytes(library)
    return path

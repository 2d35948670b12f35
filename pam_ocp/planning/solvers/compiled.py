"""A program's functions as machine code: C by CasADi, compiled by cc or zig, kept by content.

It pays where the functions cost more than the linear algebra: on re-solves by shooting, 0.3 to 0.4
of the time; for collocation 0.7 to 0.9. The compiler takes a few seconds, once.
(``benchmarks/resolve.py``.)
"""

from __future__ import annotations

import contextlib
from pathlib import Path

import casadi as ca

from ...core.errors import ExportError, InputError

__all__ = ["compiled"]

NAME = "pam_ocp_plan"
HEAD = """\
#ifdef __GNUC__
#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))
#pragma GCC diagnostic ignored "-Wint-conversion"
#endif
"""
"""The compiler is told to hide what is not declared otherwise; and where a mapped function has an
argument without entries, CasADi copies nothing to an address written as a number."""


def compiled(solver: ca.Function) -> str:
    """The path of a library with a solver's problem and derivatives, for ``casadi.nlpsol(name,
    "ipopt", path)``.

    Raises InputError where there is no C compiler.
    """
    from ...export.cache import digest, usable_folder
    from ...export.compile import compile_library, native

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
    path = usable_folder("plan") / f"{digest(library)}{platform.suffix}"
    return str(_stored(path, library))


def _stored(path: Path, library: bytes) -> Path:
    """The library as a whole file in the cache."""
    from ...export.cache import write_whole

    with contextlib.suppress(OSError):  # not there yet
        if path.read_bytes() == library:
            return path
    try:
        write_whole(path, library)
    except OSError as error:
        raise InputError(f"compiled = True: {path} cannot be written ({error.strerror})") from None
    return path

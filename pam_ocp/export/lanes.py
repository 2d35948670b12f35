"""Many cases of one plant side by side: C code with a case in each lane of a vector register.

Written from CasADi's instructions, compiled for the widest vectors that this processor has, kept
like all machine code, and compared with the plant's own when it is loaded. fmu/src/lanes.c steps.
"""

from __future__ import annotations

import ctypes
import platform as host
from functools import cache
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.expressions import steps_of
from ..core.signals import PiecewisePolynomial
from ..core.stop import check
from ..plants.plant import Plant
from .source import c_text, number, solver_rows

Array: TypeAlias = NDArray[np.float64]

MAIN = "lanes.c"
OWN = (MAIN, "solver.c", "solver.h", "elementary.h")
BUDGET = 2e5
"""Steps of all lanes between two looks for signals, divided by the states' third power."""
ALIGNED = 64
INFIX = {
    "add": "{} + {}",
    "sub": "{} - {}",
    "mul": "{} * {}",
    "div": "{} / {}",
    "neg": "-{}",
    "sq": "{0} * {0}",
    "twice": "2.0 * {}",
    "inv": "1.0 / {}",
    "assign": "{}",
    "lt": "truth((M)({} < {}))",
    "le": "truth((M)({} <= {}))",
    "eq": "truth((M)({} == {}))",
    "ne": "truth((M)({} != {}))",
    "not": "truth((M)({} == 0.0))",
    "and": "truth((M)({} != 0.0) & (M)({} != 0.0))",
    "or": "truth((M)({} != 0.0) | (M)({} != 0.0))",
    "if_else_zero": "(V)((M)({} != 0.0) & (M){})",
    "constpow": "v_pow({}, {})",
}
SIGNATURES = {
    "plant_rhs": "const V *x, const V *u, const V *p, V *xdot",
    "plant_linearize": "const V *x, const V *u, const V *p, V *xdot, V *jacobian",
    "plant_slope": "const V *x, const V *u, const V *p, const V *rise, V *slope",
}
CALLS = {
    1: "exp log sqrt sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil fabs "
    "sign erf log1p expm1",
    2: "pow fmod fmin fmax atan2 hypot copysign",
}
"""Functions in fmu/src/lanes.c by the number of their arguments."""


@cache
def lanes_here() -> tuple[int, str]:
    """(cases side by side, what the compiler is told of this processor)."""
    if host.machine().lower() not in ("x86_64", "amd64"):
        return 4, ""
    try:
        flags = set(Path("/proc/cpuinfo").read_text().partition("flags")[2].split("\n")[0].split())
    except OSError:
        flags = set()
    if {"avx512f", "avx512dq", "avx512vl"} <= flags:
        return 8, "avx512f,avx512dq,avx512vl"
    return (4, "avx2") if "avx2" in flags else (4, "")


def lane_sources(plant: Plant) -> dict[str, str] | None:
    """C files; None where the equations hold what has no words here."""
    rows = solver_rows(plant)
    try:
        code = [_function(name, *rows[name], signature) for name, signature in SIGNATURES.items()]
    except KeyError:
        return None
    count, target = lanes_here()
    sizes = (len(plant.states), len(plant.inputs), len(plant.parameters), count)
    defines = dict(zip(("SOLVER_N", "NU", "NP", "LANES"), sizes, strict=True))
    data = "".join(f"#define {name} {value}\n" for name, value in defines.items())
    data += f'#define LANES_TARGET "{target}"\n' if target else ""
    own = {name: c_text(name) for name in OWN}
    return {**own, "lanes_data.h": data, "plant_lanes.c": "\n".join(code)}


@cache
def _words() -> dict[str, str]:
    """{operation: its C}"""
    found = dict(INFIX)
    for arguments, names in CALLS.items():
        inner = ", ".join(["{}"] * arguments)
        found |= {name: f"v_{name}({inner})" for name in names.split()}
    return found


def _function(name: str, given: list[ca.SX], made: list[ca.SX], signature: str) -> str:
    function = ca.Function(name, given, made, {"cse": True})
    arguments = [part.rpartition("*")[2] for part in signature.split(", ")]
    words, now = _words(), dict[int, str]()
    lines = []
    for k, (kind, outs, ins, constant) in enumerate(steps_of(function)):
        if kind == "output":
            lines.append(f"{arguments[len(given) + outs[0]]}[{outs[1]}] = {now[ins[0]]};")
            continue
        if kind == "input":
            text = f"{arguments[ins[0]]}[{ins[1]}]"
        elif kind == "const":
            text = f"all({number(constant)})"
        else:
            text = words[kind].format(*(now[i] for i in ins))
        lines.append(f"const V a{k} = {text};")
        now[outs[0]] = f"a{k}"
    unused = "".join(f"(void){a}; " for a in arguments)
    body = "\n    ".join([unused, *lines])
    return f"static void {name}({signature}) {{\n    {body}\n}}\n"


# ---- the library ---------------------------------------------------------------------------------
class _Cases(ctypes.Structure):
    """As fmu/src/lanes.c has it."""

    _fields_ = (
        *((n, ctypes.c_void_p) for n in ("parameters", "starts", "coefficients", "nominal")),
        *((n, ctypes.c_void_p) for n in ("times", "breaks", "states", "status")),
        ("tolerance", ctypes.c_double),
        *((n, ctypes.c_longlong) for n in ("cases", "intervals", "pieces", "degree", "max_steps")),
        ("apart", ctypes.c_longlong),
        ("memory", ctypes.c_void_p),
        ("next", ctypes.c_longlong),
    )


class LaneCases:
    """The library of one structure of plants. Raises OSError where it cannot be loaded."""

    def __init__(self, path: Path, states: int) -> None:
        library: Any = ctypes.CDLL(str(path))
        self._memory, self._simulate = library.lanes_memory, library.simulate_cases
        self._memory.argtypes, self._memory.restype = (ctypes.c_longlong,), ctypes.c_longlong
        long = ctypes.c_longlong
        self._simulate.argtypes = (ctypes.POINTER(_Cases), long, long)
        self._nx = states
        self._budget = max(20, int(BUDGET / (states + 2) ** 3))

    def motions(
        self,
        u: PiecewisePolynomial,
        coefficients: Array,
        grid: Array,
        x0: Array,
        p: Array,
        nominal: Array,
        tolerance: float,
        max_steps: int,
        wanted: NDArray[np.bool_],
    ) -> tuple[Array, NDArray[np.bool_]]:
        """See :meth:`pam_ocp.export.machine.MachinePlant.motions`."""
        states = np.zeros((len(x0), len(grid), self._nx))
        status = wanted.astype(np.int8)
        given = [p, x0, coefficients, nominal, grid, u.breaks]
        arrays = [np.ascontiguousarray(a, dtype=float) for a in given]
        memory = np.zeros(int(self._memory(u.degree)) + ALIGNED, np.uint8)
        run = _Cases(
            *(a.ctypes.data for a in (*arrays, states, status)),
            tolerance,
            len(x0),
            len(grid) - 1,
            len(u.breaks) - 1,
            u.degree,
            max_steps,
            0 if len(coefficients) == 1 else coefficients[0].size,
            memory.ctypes.data + -memory.ctypes.data % ALIGNED,
        )
        begins, goes_on = 1, 1
        while goes_on:
            check()
            goes_on = self._simulate(ctypes.byref(run), begins, self._budget)
            begins = 0
        return states, (status == 2) & np.isfinite(states).all(axis=(1, 2))

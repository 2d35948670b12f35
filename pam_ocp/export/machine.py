"""A plant as machine code for simulations: the C solver of the FMUs, loaded into this process.

Built once per structure (its parameters are arguments), kept by the digest of its equations, and
compared with CasADi when it is loaded. fmu/src/simulate.c is what is compiled.
"""

from __future__ import annotations

import ctypes
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import ExportError, InputError, require_flag
from ..core.quantities import outside
from ..core.signals import PiecewisePolynomial
from ..core.stop import check
from ..plants.plant import Plant
from .cache import cache_folder, digest, keep, kept, usable_folder
from .compile import compile_library, native
from .lanes import MAIN as LANES
from .lanes import LaneCases, lane_sources, lanes_here
from .source import c_text, functions_of, plant_code, solver_rows, work_of

Array: TypeAlias = NDArray[np.float64]

NAME = "pam_ocp_plant"
MAIN = "simulate.c"
OWN = (MAIN, "solver.c", "solver.h", "generated.c", "elementary.h")
BUDGET = 1e6
"""Interrupts and time limits are asked for after so many steps, divided by the states' third power
(some milliseconds of work)."""
AGREED, OVER = 1e-6, 0.05
"""What two ways to step may differ by over so many seconds, in nominals and of the value."""
ALIKE = 1e-9
"""What the library and CasADi may differ by, scaled by nominals and of the value: rounding."""


class _Simulation(ctypes.Structure):
    """As fmu/src/simulate.c has it; behind its last member stand the states."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("parameters", "nominal", "times", "breaks")),
        *((name, ctypes.c_void_p) for name in ("coefficients", "states")),
        ("tolerance", ctypes.c_double),
        *((name, ctypes.c_longlong) for name in ("intervals", "pieces", "degree", "max_steps")),
        *((name, ctypes.c_longlong) for name in ("interval", "piece", "steps")),
        ("offset", ctypes.c_double),
        ("step", ctypes.c_double),
    )


class MachinePlant:
    """The library of one structure of plants. Raises OSError where it cannot be loaded."""

    def __init__(self, path: Path, states: int, outputs: int) -> None:
        self._library = ctypes.CDLL(str(path))
        self._outputs = self._library.outputs
        self._outputs.argtypes = (*[ctypes.c_void_p] * 5, ctypes.c_longlong)
        self._outputs.restype = None
        self._nx, self._ny = states, outputs
        self.lanes: Callable[[], LaneCases | None] = lambda: None
        """What steps many cases side by side, where it is there."""
        members = {"_fields_": [("x", ctypes.c_double * states)]}
        self._structure: Any = type("Simulation", (_Simulation,), members)
        self._simulate = self._library.simulate
        self._simulate.argtypes = (ctypes.POINTER(self._structure), ctypes.c_longlong)
        self._budget = max(20, int(BUDGET / (states + 2) ** 3))

    def motion(
        self,
        u: PiecewisePolynomial,
        grid: Array,
        x0: Array,
        p: Array,
        nominal: Array,
        tolerance: float,
        max_steps: int,
    ) -> Array | None:
        """States (times, nx) over ``grid`` from ``x0``; None where the solver gave up.

        u : with pieces for the whole grid. tolerance : of a step, in units of ``nominal``.
        Signals and time limits end it.
        """
        states = np.empty((len(grid), self._nx))
        states[0] = x0
        arrays = [p, nominal, grid, u.breaks, u.coefficients]
        arrays = [np.ascontiguousarray(a, dtype=float) for a in arrays]
        run = self._structure(
            *(a.ctypes.data for a in (*arrays, states)),
            tolerance,
            len(grid) - 1,
            len(u.breaks) - 1,
            u.degree,
            max_steps,
        )
        run.x[:] = states[0].tolist()
        goes_on = 1
        while goes_on == 1:
            check()
            goes_on = self._simulate(ctypes.byref(run), self._budget)
        return states if goes_on == 0 else None

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
        """States (cases, times, nx) of cases that differ in numbers only, and which of them came to
        their end: those ``wanted`` that the solver did not give up.

        coefficients : of the inputs on the breaks of ``u``, of each case or one for all.
        x0 : (cases, nx). p : (cases, np). Each case has steps of its own, and depends on no other.
        """
        lanes = self.lanes()
        given = (grid, x0, p, nominal, tolerance, max_steps)
        if lanes is not None:
            return lanes.motions(u, coefficients, *given, wanted)
        states = np.zeros((len(x0), len(grid), self._nx))
        done = np.zeros(len(x0), bool)
        for i in np.flatnonzero(wanted).tolist():
            own = replace(u, coefficients=coefficients[min(i, len(coefficients) - 1)])
            found = self.motion(own, grid, x0[i], p[i], nominal, tolerance, max_steps)
            if found is not None and np.all(np.isfinite(found)):
                states[i], done[i] = found, True
        return states, done

    def outputs(self, x: Array, u: Array, p: Array, xdot: Array | None = None) -> Array:
        """Outputs (rows, ny) at rows of states and inputs; ``xdot`` takes the derivatives."""
        y = np.empty((len(x), self._ny))
        x, u, p = (np.ascontiguousarray(a, dtype=float) for a in (x, u, p))
        into = None if xdot is None else xdot.ctypes.data
        self._outputs(x.ctypes.data, u.ctypes.data, p.ctypes.data, into, y.ctypes.data, len(x))
        return y


# ---- where it is kept ---------------------------------------------------------------------------


class _Known:
    """What was found for a structure in this process."""

    machine: MachinePlant | None = None
    looked = False


@contextmanager
def _refused(build: bool) -> Iterator[None]:
    """Nothing where code is not built and cannot be used; InputError where it was to be built."""
    try:
        yield
    except ExportError as error:
        if build:
            raise InputError(f"compiled = True: {error}; or leave compiled out") from None


def machine_plant(plant: Plant, build: bool) -> MachinePlant | None:
    """The plant's library where it is there, or where ``build`` asks for it; else None.

    Raises InputError where it is to be built and cannot be.
    """
    known: _Known = plant.cached(("machine",), _Known)
    if known.machine is None and (build or not known.looked):
        known.looked = True
        with _refused(build):
            known.machine = _machine(plant, build)
    return known.machine


def _place(part: str, name: str, build: bool) -> Path | None:
    """Where a library is kept, or is to be; None where only looking shows none, which touches
    nothing.
    """
    file = f"{name}{native().suffix}"
    if not build and not (cache_folder() / part / file).is_file():
        return None
    return usable_folder(part) / file


def _machine(plant: Plant, build: bool) -> MachinePlant | None:
    stored = _place("plant", _digest(plant), build)
    if stored is None:
        return None
    if kept(stored) is None:
        if not build:
            return None
        keep(stored, compile_library(_sources(plant), MAIN, native(), NAME))
    try:
        machine = MachinePlant(stored, len(plant.states), len(plant.outputs))
    except OSError as error:
        raise ExportError(f"{stored} cannot be loaded ({error})") from None
    if _alike(plant, machine):
        machine.lanes = cache(partial(_lanes, plant, machine, build))
        return machine
    stored.unlink(missing_ok=True)
    warnings.warn(
        f"the compiled code of {plant.name} does not agree with CasADi and is not used",
        stacklevel=outside(),
    )
    return None


@cache
def _own() -> dict[str, str]:
    return {name: c_text(name) for name in OWN}


def _digest(plant: Plant) -> str:
    """Of the plant's equations, and of what makes a library of them."""
    parts = (plant.function.serialize(), ca.CasadiMeta.version(), native().name, *_own().values())
    return digest("\0".join(parts).encode())


def _sources(plant: Plant) -> dict[str, str]:
    functions = functions_of(solver_rows(plant))
    defines = {
        "SOLVER_N": len(plant.states),
        "NU": len(plant.inputs),
        "NY": len(plant.outputs),
        **work_of("PLANT", functions),
    }
    data = "".join(f"#define {name} {value}\n" for name, value in defines.items())
    return {**_own(), "simulate_data.h": data, "plant.c": plant_code(functions)}


def _alike(plant: Plant, machine: MachinePlant) -> bool:
    """Whether derivatives and outputs at the start values are CasADi's."""
    x, u, p = (plant.vector(kind) for kind in ("state", "input", "parameter"))
    rates = np.empty((1, len(x)))
    y = machine.outputs(x[None, :], u[None, :], p, rates)
    expected = [np.asarray(e, float).ravel() for e in plant.function(x, u, p)[:2]]
    sizes = [plant.vector(kind, attribute="nominal") for kind in ("state", "output")]
    for value, known, size in zip((rates[0], y[0]), expected, sizes, strict=True):
        wrong = np.abs(value - known) > ALIKE * (size + np.abs(known))
        if np.any(wrong & np.isfinite(known)):
            return False
    return True


# ---- many cases side by side --------------------------------------------------------------------
MOST_STATES = 16
"""Of plants that are stepped side by side: the code of larger ones takes long to compile."""


def _lanes(plant: Plant, machine: MachinePlant, build: bool) -> LaneCases | None:
    """The plant's library for many cases; None where it is not there, or not to be trusted."""
    if not 0 < len(plant.states) <= MOST_STATES:
        return None
    count, target = lanes_here()
    code = digest("\0".join([target, c_text(LANES)]).encode())[:16]
    stored = _place("plant", f"{_digest(plant)}-{count}-{code}", build)
    if stored is None:
        return None
    try:
        if kept(stored) is None:
            sources = lane_sources(plant) if build else None
            if sources is None:
                return None
            keep(stored, compile_library(sources, LANES, native(), f"{NAME}_lanes"))
        lanes = LaneCases(stored, len(plant.states))
    except (ExportError, OSError):
        return None
    return lanes if _agree(plant, machine, lanes) else None


def _agree(plant: Plant, machine: MachinePlant, lanes: LaneCases) -> bool:
    """Whether a few cases end where the solver for one brings them."""
    x, p = plant.vector("state"), plant.vector("parameter")
    nominal, grid = plant.vector("state", attribute="nominal"), np.array([0.0, OVER])
    u = PiecewisePolynomial(grid, plant.vector("input")[None, None])
    three, wanted = (np.stack([x] * 3), np.stack([p] * 3)), np.ones(3, bool)
    found, done = lanes.motions(
        u, u.coefficients[None], grid, *three, nominal, AGREED / 100, 1000, wanted
    )
    known = machine.motion(u, grid, x, p, nominal, AGREED / 100, 1000)
    if known is None or not done.all():
        return known is None and not done.any()
    return bool(np.all(np.abs(found - known) <= AGREED * (nominal + np.abs(known))))


# ---- single functions ---------------------------------------------------------------------------

_HEAD = """\
#ifdef __GNUC__
#define CASADI_SYMBOL_EXPORT __attribute__((visibility("default")))
#endif
"""


def quick(function: ca.Function, compiled: bool | None) -> ca.Function:
    """The function as machine code (None: where it is there; True: built if need be), or itself."""
    require_flag("compiled", compiled, "where it is in the cache")
    machine = None if compiled is False else machine_function(function, build=bool(compiled))
    return function if machine is None else machine


def machine_function(function: ca.Function, build: bool) -> ca.Function | None:
    """A function as machine code, where that is there or where ``build`` asks for it; else None.

    Raises InputError where it is to be built and cannot be.
    """
    with _refused(build):
        parts = (function.serialize(), ca.CasadiMeta.version(), native().name)
        stored = _place("function", digest(chr(0).join(parts).encode()), build)
        if stored is None:
            return None
        if kept(stored) is None:
            if not build:
                return None
            generator = ca.CodeGenerator("function.c")
            generator.add(function)
            source = {"function.c": _HEAD + generator.dump()}
            keep(stored, compile_library(source, "function.c", native(), function.name()))
        try:
            found = ca.external(function.name(), str(stored))
        except RuntimeError as error:
            raise ExportError(f"{stored} cannot be loaded ({error})") from None
        point = [ca.DM(function.sparsity_in(i), 0.1) for i in range(function.n_in())]
        same = all(
            np.allclose(np.asarray(a), np.asarray(b), rtol=ALIKE, atol=ALIKE, equal_nan=True)
            for a, b in zip(found.call(point), function.call(point), strict=True)
        )
        return found if same else None

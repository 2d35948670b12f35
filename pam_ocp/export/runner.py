"""Driving an FMU step by step with FMPy (one face for FMI 2.0 and FMI 3.0, both kinds), and playing
a record's inputs to it, as exactly as each mode of FMI allows.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, PamError, SimulationError, UnknownNameError
from ..core.trajectory import Trajectory
from .archive import UnsafeFileError, require_safe

if TYPE_CHECKING:
    from fmpy.sundials import CVodeSolver

Kind: TypeAlias = Literal["CoSimulation", "ModelExchange"]
Array: TypeAlias = NDArray[np.float64]


_KINDS: dict[str, Callable[[float], Any]] = {
    "Boolean": bool,
    "Enumeration": round,
    "Float32": float,
}
"""Types of variables that FMI has functions of their own for, beside those of most numbers."""

_note: Callable[[str], None] | None = None


def note_calls(note: Callable[[str], None] | None) -> None:
    """Let ``note`` hear the name of each call into a unit before it is made, and "" behind it."""
    global _note
    _note = note


class UnpackedFmu:
    """An FMU unpacked into a folder, with its description read.

    Raises InputError when the file is no FMU, or not safe to unpack (names, sizes, entities).
    """

    def __init__(self, path: Path, folder: Path) -> None:
        import fmpy  # loaded when an FMU is opened: `import pam_ocp` stays quick

        try:
            require_safe(path)
            self.description: Any = fmpy.read_model_description(str(path), validate=False)
            fmpy.extract(str(path), str(folder))
        except UnsafeFileError as error:
            raise UnsafeFileError(f"{path}: this file cannot be read as an FMU: {error}") from None
        except Exception as error:  # FMPy raises plain Exceptions
            raise InputError(f"{path}: this file cannot be read as an FMU ({error})") from None
        self.folder = folder
        self.fmi = "3.0" if self.description.fmiVersion.startswith("3") else "2.0"
        variables = self.description.modelVariables
        self.references = {v.name: int(v.valueReference) for v in variables}
        self.variables: dict[str, Any] = {v.name: v for v in variables}
        self.typed = {v.name: v.type for v in variables if v.type in _KINDS}
        self.derivatives = [d.variable.name for d in self.description.derivatives]
        self.states = [d.variable.derivative.name for d in self.description.derivatives]

    @property
    def has_directional_derivatives(self) -> bool:
        """Of Model Exchange. FMPy does not read FMI 3's name of this attribute:
        so it is read here.
        """
        root = ElementTree.parse(self.folder / "modelDescription.xml").getroot()
        exchange = root.find("ModelExchange")
        name = "providesDirectionalDerivative" + ("s" if self.fmi == "3.0" else "")
        return exchange is not None and exchange.get(name) in ("true", "1")

    def names(self, causality: str) -> list[str]:
        """Names of all variables of a causality of FMI."""
        return [n for n, v in self.variables.items() if v.causality == causality]

    def nominals(self, names: Sequence[str]) -> Array:
        return np.array([float(self.variables[n].nominal or 1.0) for n in names])


class Runner:
    """One instance of an FMU in this process; a context manager that frees it.

    A unit that crashes takes the process with it: for units of others see :func:`check_fmu`.

    ``log`` collects the messages of the FMU as (status, text).
    """

    def __init__(self, fmu: UnpackedFmu, kind: Kind, token: str | None = None) -> None:
        import fmpy.fmi2
        import fmpy.fmi3

        self.fmu = fmu
        self.kind: Kind = kind
        self.log: list[tuple[int, str]] = []
        two, exchange = fmu.fmi == "2.0", kind == "ModelExchange"
        module = fmpy.fmi2 if two else fmpy.fmi3
        name = f"FMU{fmu.fmi[0]}{'Model' if exchange else 'Slave'}"
        here = os.getcwd()
        self._noted("the loading of its library")
        try:
            self.inner: Any = getattr(module, name)(
                guid=fmu.description.guid if token is None else token,
                unzipDirectory=str(fmu.folder),
                modelIdentifier=getattr(
                    fmu.description, "modelExchange" if exchange else "coSimulation"
                ).modelIdentifier,
                instanceName="instance",
            )
        finally:
            os.chdir(here)  # FMPy stays in the library's folder when it cannot load the library
        self._watch_calls()
        try:
            self._instantiate(two)
        except Exception as error:  # FMPy raises plain Exceptions
            raise self.failure(error) from None

    def _noted(self, call: str) -> None:
        if _note is not None:
            _note(f"{call} ({self.kind})" if call else "")

    def _watch_calls(self) -> None:
        self._noted("")
        call = getattr(self.inner, "_call", None)
        if _note is None or call is None:
            return

        def noted(function: str, *arguments: Any) -> Any:
            self._noted(function)
            try:
                return call(function, *arguments)
            finally:
                unloads = function.endswith("FreeInstance")
                self._noted("the unloading of its library" if unloads else "")

        self.inner._call = noted

    def _instantiate(self, two: bool) -> None:
        if not two:
            self.inner.instantiate(
                logMessage=lambda _, status, __, text: self.log.append((status, _words(text)))
            )
            return
        import fmpy.fmi2

        callbacks = fmpy.fmi2.fmi2CallbackFunctions()
        callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(
            lambda _, __, status, ___, text: self.log.append((status, _words(text)))
        )
        callbacks.allocateMemory = fmpy.fmi2.defaultCallbacks.allocateMemory
        callbacks.freeMemory = fmpy.fmi2.defaultCallbacks.freeMemory
        self.inner.instantiate(callbacks=callbacks)

    def __enter__(self) -> Runner:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.inner.freeInstance()
        self._noted("")

    # ---- values -----------------------------------------------------------------------------
    def references(self, names: Sequence[str]) -> list[int]:
        """Value references of variables. Raises UnknownNameError."""
        for name in names:
            if name not in self.fmu.references:
                raise UnknownNameError("variable of the FMU", name, self.fmu.references)
        return [self.fmu.references[n] for n in names]

    def get(self, names: Sequence[str]) -> Array:
        """Values of variables [SI]; 1 and 0 of Booleans."""
        known = dict(zip(names, self.references(names), strict=True))
        plain = [n for n in known if n not in self.fmu.typed]
        read = self.inner.getReal if self.fmu.fmi == "2.0" else self.inner.getFloat64
        found = dict(zip(plain, read([known[n] for n in plain]) if plain else (), strict=True))
        for name in known.keys() & self.fmu.typed.keys():
            call = getattr(self.inner, f"get{self._call_of(name)}")
            found[name] = call([known[name]])[0]
        return np.array([found[n] for n in names], dtype=float)

    def set(self, values: Mapping[str, float]) -> None:
        """Set variables [SI]."""
        known = dict(zip(values, self.references(list(values)), strict=True))
        for name in known.keys() & self.fmu.typed.keys():
            call = getattr(self.inner, f"set{self._call_of(name)}")
            call([known[name]], [_KINDS[self.fmu.typed[name]](values[name])])
        plain = [n for n in known if n not in self.fmu.typed]
        if plain:
            write = self.inner.setReal if self.fmu.fmi == "2.0" else self.inner.setFloat64
            write([known[n] for n in plain], [float(values[n]) for n in plain])

    def _call_of(self, name: str) -> str:
        """What FMI's functions for such a variable end in."""
        if self.fmu.typed[name] != "Enumeration":
            return str(self.fmu.typed[name])
        return "Integer" if self.fmu.fmi == "2.0" else "Int64"

    def initialize(self, start: Mapping[str, float], time: float, tolerance: float | None) -> None:
        """Set start values and go through initialization; Model Exchange to continuous time."""
        self.begin(time, start, tolerance)
        self.end_initialization()

    def begin(
        self, time: float, start: Mapping[str, float] | None = None, tolerance: float | None = None
    ) -> None:
        """Set start values and enter initialization."""
        if self.fmu.fmi == "2.0":
            self.inner.setupExperiment(startTime=time, tolerance=tolerance)
            self.set(start or {})
            self.inner.enterInitializationMode()
        else:
            self.set(start or {})
            self.inner.enterInitializationMode(startTime=time, tolerance=tolerance)

    def end_initialization(self) -> None:
        """Go on to steps; in Model Exchange to continuous time."""
        self.inner.exitInitializationMode()
        if self.kind == "ModelExchange":
            self.inner.enterContinuousTimeMode()

    def directional(
        self, unknowns: Sequence[str], knowns: Sequence[str], seed: Sequence[float]
    ) -> Array:
        """Directional derivative of ``unknowns`` along ``seed`` in ``knowns``."""
        arguments = (self.references(unknowns), self.references(knowns), [float(s) for s in seed])
        return np.array(self.inner.getDirectionalDerivative(*arguments))

    # ---- time -------------------------------------------------------------------------------
    def step(self, time: float, size: float) -> None:
        """One communication step of Co-Simulation."""
        self.inner.doStep(currentCommunicationPoint=time, communicationStepSize=size)

    def change_inputs(self, values: Mapping[str, float]) -> None:
        """Let inputs jump; in Model Exchange this is an event."""
        if self.kind == "ModelExchange":
            self.inner.enterEventMode()
            self.set(values)
            self.inner.enterContinuousTimeMode()
        else:
            self.set(values)

    def integrator(
        self, time: float, tolerance: float, inputs: Callable[[float], Mapping[str, float]] | None
    ) -> CVodeSolver:
        """SUNDIALS' CVode on the derivatives of a Model Exchange instance.

        ``inputs`` gives the values of inputs that change between events.
        """
        from fmpy.sundials import CVodeSolver

        def set_time(t: float) -> None:
            self.inner.setTime(t)
            if inputs is not None:
                self.set(inputs(t))

        three = self.fmu.fmi == "3.0"
        return CVodeSolver(
            nx=len(self.fmu.states),
            nz=0,
            get_x=self.inner.getContinuousStates,
            set_x=self.inner.setContinuousStates,
            get_dx=self.inner.getContinuousStateDerivatives if three else self.inner.getDerivatives,
            get_z=lambda *_: None,
            get_nominals=self.inner.getNominalsOfContinuousStates,
            set_time=set_time,
            input=None,
            startTime=time,
            relativeTolerance=tolerance,
            maxNumSteps=100_000,
        )

    # ---- saved states -----------------------------------------------------------------------
    def save(self) -> bytes:
        """The state of the instance, serialised."""
        state = self.inner.getFMUState()
        try:
            return bytes(self.inner.serializeFMUState(state))
        finally:
            self.inner.freeFMUState(state)

    def restore(self, content: bytes) -> None:
        """Put the instance into a state that :meth:`save` gave."""
        state = self.inner.deserializeFMUState(content)
        try:
            self.inner.setFMUState(state)
        finally:
            self.inner.freeFMUState(state)

    def failure(self, error: BaseException) -> SimulationError:
        """What went wrong, in the words of the FMU where it has some."""
        refusals = [text for status, text in self.log if status > 1]  # neither OK nor a warning
        words = refusals[-1] if refusals else str(error)
        return SimulationError(f"{self.kind} of the FMU failed: {words}")


def _words(text: bytes | None) -> str:
    return (text or b"").decode("utf-8", "replace")


def pointer(values: Array) -> Any:
    """A C array of doubles that shares memory with a NumPy array."""
    return values.ctypes.data_as(ctypes.POINTER(ctypes.c_double))


_EXCHANGE_TOLERANCE = 1e-11
"""Relative tolerance of CVode in Model Exchange: far below the deviations that are looked for."""
_CURVE_RESIDUAL = 1e-3
"""In Co-Simulation a curved input is played in parts by straight lines with its own mean and first
moment over the part. What is left has neither, so it moves a state of rate r by no more than about
(r part)^3 / 100 of its size, and that is kept below this share of nominal by halving the parts:
with parts below 0.1 / r an error of 1e-8.
"""
_MOST_PARTS = 1024
_PAIRS, _LONGEST_PAIR = 100, 1e-3
"""FMI 3 gives Co-Simulation no slopes of inputs: what is not constant between two samples is played
as at least so many pairs of held values, no pair longer than this [s]. The two values of a pair
have the input's mean and first moment: the error is of fourth order in the pair's length.
"""


@dataclass(frozen=True)
class _Played:
    """Inputs over a grid that has all their breaks: on interval k the polynomials
    sum_j pieces[k, j] (t - times[k])^j; ``values`` are those at the times, to the right of a jump.
    """

    names: list[str]
    times: Array
    pieces: Array
    values: Array
    nominals: Array

    def at(self, k: int, t: Array | float) -> Array:
        """Inputs (times, inputs) by the polynomials of interval k."""
        elapsed = np.atleast_1d(t) - self.times[k]
        return np.asarray(elapsed[:, None] ** np.arange(self.pieces.shape[1]) @ self.pieces[k])

    def lines(self, k: int, parts: int) -> tuple[Array, Array, float]:
        """Means and slopes (per part) of lines with the inputs' mean and first moment, and how far
        the inputs are from the lines scaled by nominals."""
        begin, size = self.times[k], (self.times[k + 1] - self.times[k]) / parts
        nodes, weights = np.polynomial.legendre.leggauss(self.pieces.shape[1] // 2 + 2)
        place, weights = (nodes + 1) / 2, weights / 2
        shown = np.concatenate([[0.0], place, [1.0]])
        t = begin + size * (np.arange(parts)[:, None] + shown)
        u = self.at(k, t.ravel()).reshape(*t.shape, -1)
        mean = np.einsum("j,pji->pi", weights, u[:, 1:-1])
        slope = 12 * np.einsum("j,pji->pi", weights * (place - 0.5), u[:, 1:-1])
        line = mean[:, None] + slope[:, None] * (shown - 0.5)[:, None]
        return mean, slope, float(np.max(np.abs(u - line) / self.nominals, initial=0.0))


def as_polynomials(
    motion: Trajectory, names: Sequence[str], breaks: Array, held: Collection[str]
) -> tuple[Array, Array]:
    """Columns of a motion on common breaks: values there (breaks, names), to the right of a jump,
    and coefficients (pieces, powers, names). held : columns that stay between samples; inputs run
    by the motion's own signals where it has some, all else in straight lines.
    """
    exact, t = motion.signals, motion.t
    own = motion.named("input") if exact is not None else []
    smooth = None if exact is None else (exact(breaks), exact.shifted(breaks).coefficients)
    powers = 2 if smooth is None else max(2, smooth[1].shape[1])
    pieces = np.zeros((len(breaks) - 1, powers, len(names)))
    values = np.zeros((len(breaks), len(names)))
    for i, name in enumerate(names):
        if smooth is not None and name in own:
            column = own.index(name)
            values[:, i] = smooth[0][:, column]
            pieces[:, : smooth[1].shape[1], i] = smooth[1][:, :, column]
            continue
        if name in held:
            rows = np.searchsorted(t, breaks + 1e-12 * (1 + np.abs(breaks)), side="right") - 1
            values[:, i] = motion[name][np.maximum(rows, 0)]
        else:
            values[:, i] = np.interp(breaks, t, motion[name])
            pieces[:, 1, i] = np.diff(values[:, i]) / np.diff(breaks)
        pieces[:, 0, i] = values[:-1, i]
    return values, pieces


def _played(record: Trajectory, inputs: list[str]) -> tuple[_Played, NDArray[np.intp]]:
    """The inputs as they run in the record, and where the record's own times are."""
    t, exact = record.t, record.signals
    times = t
    if exact is not None:
        inside = exact.breaks[(exact.breaks > t[0]) & (exact.breaks < t[-1])]
        behind = np.clip(np.searchsorted(t, inside), 1, len(t) - 1)
        apart = np.minimum(np.abs(t[behind] - inside), np.abs(t[behind - 1] - inside))
        times = np.union1d(t, inside[apart > 1e-12 * (1 + np.abs(inside))])
    held = inputs if record.interpolation == "previous" else ()
    values, pieces = as_polynomials(record, inputs, times, held)
    nominals = np.array([record.variable(n).nominal for n in inputs])
    return _Played(inputs, times, pieces, values, nominals), np.searchsorted(times, t)


def replay(
    fmu: UnpackedFmu,
    kind: Kind,
    record: Trajectory,
    parameters: Mapping[str, float],
    outputs: list[str],
) -> Array:
    """Values of ``outputs`` (times, outputs) at the record's times, its inputs played to an
    instance.

    The record's first row gives the start of states, and the parameters where it has some.
    """
    inputs = [n for n in fmu.names("input") if n in record]
    played, rows = _played(record, inputs)
    given = [*fmu.states, *fmu.names("parameter")]
    start = {n: float(record[n][0]) for n in given if n in record}
    start |= dict(zip(inputs, played.values[0].tolist(), strict=True))
    play = _play_exchange if kind == "ModelExchange" else _play_simulation
    with Runner(fmu, kind) as runner:
        try:
            runner.initialize({**start, **parameters}, float(record.t[0]), None)
            return play(runner, played, outputs)[rows]
        except PamError:
            raise
        except Exception as error:  # FMPy raises plain Exceptions
            raise runner.failure(error) from None


# ---- Co-Simulation ------------------------------------------------------------------------------


def _play_simulation(runner: Runner, played: _Played, outputs: list[str]) -> Array:
    rows = []
    for k, begin in enumerate(played.times):
        runner.change_inputs(dict(zip(played.names, played.values[k].tolist(), strict=True)))
        rows.append(runner.get(outputs))
        if k == len(played.times) - 1:
            break
        if not np.any(played.pieces[k, 1:]):
            runner.step(begin, played.times[k + 1] - begin)
        elif runner.fmu.fmi == "2.0":
            _play_slopes(runner, played, k)
        else:
            _play_pairs(runner, played, k)
    return np.array(rows)


def _parts(played: _Played, k: int, least: int) -> tuple[Array, Array, float]:
    """Means and slopes of the lines of interval k, and the length of its parts [s]."""
    parts = least
    mean, slope, left = played.lines(k, parts)
    while left > _CURVE_RESIDUAL and parts < _MOST_PARTS:
        parts *= 2
        mean, slope, left = played.lines(k, parts)
    return mean, slope, float(played.times[k + 1] - played.times[k]) / parts


def _play_slopes(runner: Runner, played: _Played, k: int) -> None:
    """Inputs as lines, by FMI 2's derivatives of inputs."""
    mean, slope, size = _parts(played, k, 1)
    references = runner.references(played.names)
    for i, (middle, rise) in enumerate(zip(mean, slope, strict=True)):
        runner.set(dict(zip(played.names, (middle - rise / 2).tolist(), strict=True)))
        runner.inner.setRealInputDerivatives(references, [1] * len(references), rise / size)
        runner.step(played.times[k] + i * size, size)


def _play_pairs(runner: Runner, played: _Played, k: int) -> None:
    """Inputs as pairs of held values."""
    span = float(played.times[k + 1] - played.times[k])
    mean, slope, size = _parts(played, k, max(_PAIRS, int(np.ceil(span / _LONGEST_PAIR))))
    for i, (middle, rise) in enumerate(zip(mean, slope, strict=True)):
        for half, value in enumerate((middle - rise / 3, middle + rise / 3)):
            runner.set(dict(zip(played.names, value.tolist(), strict=True)))
            runner.step(played.times[k] + (i + half / 2) * size, size / 2)


# ---- Model Exchange -----------------------------------------------------------------------------


def _play_exchange(runner: Runner, played: _Played, outputs: list[str]) -> Array:
    """CVode; inputs are the record's own polynomials, however curved."""
    interval = 0
    moving = bool(np.any(played.pieces[:, 1:]))

    def inputs(time: float) -> dict[str, float]:
        return dict(zip(played.names, played.at(interval, time)[0].tolist(), strict=True))

    t = played.times
    solver = runner.integrator(float(t[0]), _EXCHANGE_TOLERANCE, inputs if moving else None)
    rows = []
    for k, (begin, end) in enumerate([*pairwise(t), (t[-1], t[-1])]):
        here = dict(zip(played.names, played.values[k].tolist(), strict=True))
        if k > 0:
            jump = played.at(k - 1, begin)[0] != played.values[k]
            if not moving and np.any(jump):
                runner.change_inputs(here)
            if moving or np.any(jump):
                solver.reset(begin)
        runner.set(here)
        rows.append(runner.get(outputs))
        if begin < end:
            interval = k
            solver.step(begin, end)
            runner.inner.setTime(end)
    return np.array(rows)

"""Driving an FMU step by step with FMPy: one face for FMI 2.0 and FMI 3.0, both kinds."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Literal, TypeAlias
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, SimulationError, UnknownNameError
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

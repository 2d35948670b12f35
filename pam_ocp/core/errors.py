"""What can go wrong, as exception classes of our own.

Each message names the argument, the value seen, the range allowed and the remedy.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from numbers import Integral
from typing import Any

__all__ = [
    "ExportError",
    "FitError",
    "InputError",
    "PamError",
    "PlanError",
    "PlanWarning",
    "SimulationError",
    "UnknownNameError",
    "VibrationError",
    "require_count",
    "require_finite",
    "require_instance",
    "require_positive",
]


class PamError(Exception):
    """Base of every error that pam_ocp raises on purpose."""


class InputError(PamError, ValueError):
    """An argument has a value that it must not have."""


class UnknownNameError(InputError):
    """A name that is not known here; the message lists the nearest ones."""

    def __init__(self, kind: str, name: object, known: Iterable[str]) -> None:
        known = list(known)
        near = difflib.get_close_matches(str(name), known, n=3, cutoff=0.4)
        if near:
            hint = f"did you mean {' or '.join(repr(n) for n in near)}?"
        elif len(known) <= 30:
            hint = f"known: {', '.join(known) or 'none'}"
        else:
            hint = f"{len(known)} names are known"
        super().__init__(f"unknown {kind} {name!r}: {hint}")
        self.name = name
        self.nearest = near


class SimulationError(PamError):
    """The integrator could not go on.

    ``time`` is how far it came, ``trajectory`` what was computed until then (or None).
    """

    def __init__(self, message: str, time: float | None = None, trajectory: Any = None) -> None:
        super().__init__(message)
        self.time = time
        self.trajectory = trajectory


class FitError(PamError):
    """The data do not allow this fit, or the solver did not find it."""


class PlanError(PamError):
    """A plan that was not found; ``plan`` holds what the solver left, sealed."""

    def __init__(self, message: str, plan: Any = None) -> None:
        super().__init__(message)
        self.plan = plan


class PlanWarning(UserWarning):
    """A plan was found, but not verified: its verdict says which figure failed."""


class VibrationError(PamError):
    """A border, a limit cycle or an oscillation that was asked for and not found; says why."""


class ExportError(PamError):
    """An FMU could not be built."""


def require_instance(
    argument: str, value: Any, kinds: type | tuple[type, ...], remedy: str, none: bool = False
) -> Any:
    """``value``, or an InputError when it is none of ``kinds`` (with ``none``: nor None)."""
    if isinstance(value, kinds) or (none and value is None):
        return value
    raise InputError(f"{argument} is a {type(value).__name__}: {remedy}")


def require_count(argument: str, value: Any, least: int = 1, most: int | None = None) -> int:
    """``value`` as an int, or an InputError when it is no whole number of this range."""
    whole = isinstance(value, Integral) and not isinstance(value, bool)
    if not whole or value < least or (most is not None and value > most):
        allowed = f">= {least}" if most is None else f"from {least} to {most}"
        raise InputError(f"{argument} = {value!r}: give a whole number {allowed}")
    return int(value)


def require_finite(argument: str, value: Any, unit: str = "") -> float:
    """``value`` as a float, or an InputError when it is not a finite number.

    A text such as "20 mm" is a number too, where ``unit`` is known.
    """
    if isinstance(value, str):
        from .quantities import quantity

        value = quantity(argument, value, *([unit] if unit else []))
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{argument} = {value!r} is not a number; give a float") from None
    if not math.isfinite(number):
        raise InputError(f"{argument} = {value} must be a finite number {unit}".rstrip())
    return number


def require_positive(argument: str, value: Any, unit: str = "", zero: bool = False) -> float:
    """``value`` as a float, or an InputError when it is not > 0 (>= 0 with ``zero``)."""
    number = require_finite(argument, value, unit)
    if number < 0 or (number == 0 and not zero):
        bound = ">= 0" if zero else "> 0"
        raise InputError(f"{argument} = {number:g} {unit} must be {bound}".replace("  ", " "))
    return number

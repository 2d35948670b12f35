"""What can go wrong, and checks of arguments that say so.

Each message names the argument, the value seen, the range allowed and the remedy.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral
from typing import Any

from .exceptions import (
    ExportError,
    FitError,
    InputError,
    OutOfTime,
    PamError,
    PlanError,
    PlanWarning,
    SimulationError,
    UnknownNameError,
    VibrationError,
    WriteError,
)
from .quantities import is_quantity, quantity

__all__ = [
    "ExportError",
    "FitError",
    "InputError",
    "OutOfTime",
    "PamError",
    "PlanError",
    "PlanWarning",
    "SimulationError",
    "UnknownNameError",
    "VibrationError",
    "WriteError",
    "require_count",
    "require_finite",
    "require_flag",
    "require_instance",
    "require_names",
    "require_positive",
    "require_tolerance",
]

LEAST_TOLERANCE = 1e-14
"""Some fifty times the spacing of numbers; below, an integrator counts rounding errors."""


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


def require_flag(argument: str, value: Any, none: str = "") -> bool | None:
    """``value``, or an InputError when it is neither True nor False (with ``none``, which says
    what that means: nor None).
    """
    if isinstance(value, bool) or (none and value is None):
        return value
    allowed = f"True, False or None ({none})" if none else "True or False"
    raise InputError(f"{argument} = {value!r}: give {allowed}")


def require_names(argument: str, value: Any) -> list[str]:
    """One name or several as a list, or an InputError for what holds no names."""
    given = [value] if isinstance(value, str) else value
    names = list(given) if isinstance(given, Iterable) else [given]
    if not all(isinstance(name, str) for name in names):
        raise InputError(f"{argument} = {value!r}: give a name in quotes, or a list of them")
    return names


def require_tolerance(argument: str, value: Any) -> float:
    """``value`` as a relative tolerance of an integrator: numbers have 16 digits."""
    if not LEAST_TOLERANCE <= (given := require_positive(argument, value)) < 1:
        raise InputError(
            f"{argument} = {given:g} must lie in {LEAST_TOLERANCE:g} .. 1 (numbers have 16 "
            "digits); 1e-10 .. 1e-4 are usual"
        )
    return given


def require_finite(argument: str, value: Any, unit: str = "") -> float:
    """``value`` as a float, or an InputError when it is not a finite number.

    A text such as "20 mm" is a number too, where ``unit`` is known.
    """
    if is_quantity(value):
        value = quantity(argument, value, *([unit] if unit else []))
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except OverflowError:
        number = math.inf if value > 0 else -math.inf
    except (TypeError, ValueError, RuntimeError):
        raise InputError(f"{argument} = {value!r} is not a number; give a float") from None
    if not math.isfinite(number):
        raise InputError(f"{argument} = {number} must be a finite number {unit}".rstrip())
    return number


def require_positive(argument: str, value: Any, unit: str = "", zero: bool = False) -> float:
    """``value`` as a float, or an InputError when it is not > 0 (>= 0 with ``zero``)."""
    number = require_finite(argument, value, unit)
    if number < 0 or (number == 0 and not zero):
        bound = ">= 0" if zero else "> 0"
        raise InputError(f"{argument} = {number:g} {unit} must be {bound}".replace("  ", " "))
    return number

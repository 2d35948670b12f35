"""Quantities in files: a number in SI, or a number with its unit such as "15 mm"."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Any

from .calibration import spelled
from .exceptions import InputError, UnknownNameError
from .units import Unit
from .units import unit as unit_of

TOO_LARGE = "is larger than any float (1.8e308)"
_QUANTITY = re.compile(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*(.*?)\s*$")


def table(where: str, value: Any) -> Mapping[str, Any]:
    """``value``, or an InputError when it is no table."""
    if not isinstance(value, Mapping):
        raise InputError(f"{where} = {value!r}: give a table, as {{ key = value }}")
    return value


def known_keys(where: str, given: Iterable[str], allowed: Iterable[str]) -> None:
    """UnknownNameError for the first key that is not allowed."""
    allowed = list(allowed)
    for key in given:
        if key not in allowed:
            raise UnknownNameError(f"key of {where}", key, allowed)


def quantity(where: str, value: Any, *units: str) -> float:
    """The SI value of a number (SI already) or of a text such as "15 mm" or "40 bar/s".

    where : what it belongs to, for messages. units : the SI units that it may measure; a text with
        a unit of another kind is refused. ``inf`` and ``-inf`` are numbers.
    """
    expected = " or ".join(repr(u) for u in units) or "a plain number"
    example = "a plain number" if units in ((), ("1",)) else "a number with its unit, as '15 mm'"
    if hasattr(value, "magnitude") and hasattr(value, "units"):
        return _of_pint(where, value, expected, units)
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise InputError(f"{where} = {value!r}: give a number in SI, or a text as '15 mm'")
    if not isinstance(value, str):
        try:
            given = float(value)
        except OverflowError:
            raise InputError(f"{where} {TOO_LARGE}") from None
        if math.isnan(given):
            raise InputError(f"{where} is not a number")
        return given
    match = _QUANTITY.match(value)
    if match is None or match[2][:1] in tuple(".,0123456789"):  # "1.000.5"
        raise InputError(f"{where} = {value!r} is not a number; give {example}")
    number, name = float(match[1]), match[2]
    if math.isinf(number):
        raise InputError(f"{where} {TOO_LARGE}")
    if not name:
        return number
    measured = _unit(where, value, name)
    if not any(measured.compatible(unit_of(u)) for u in units):
        raise InputError(f"{where} = {value!r}: this measures something else than {expected}")
    return number * measured.factor


def _unit(where: str, value: str, name: str) -> Unit:
    """The unit of a text; of a pressure also as files spell it, "bar(g)" or "psig"."""
    try:
        return unit_of(name)
    except UnknownNameError as error:
        known = spelled(name)
        if known.endswith(" abs"):
            raise InputError(
                f"{where} = {value!r}: pressures are gauge pressures here; take the ambient "
                "pressure (1.013 bar) off"
            ) from None
        if known not in ("Pa", "hPa", "kPa", "MPa", "mbar", "bar", "psi"):
            raise InputError(f"{where} = {value!r}: {error}") from None
        return unit_of(known)


def is_quantity(value: Any) -> bool:
    """Whether this is a number with its unit: a text, or a quantity of pint."""
    return isinstance(value, str) or (hasattr(value, "magnitude") and hasattr(value, "units"))


def _of_pint(where: str, value: Any, expected: str, units: tuple[str, ...]) -> float:
    """The SI value of a quantity of pint's."""
    for unit in units or ("1",):
        wanted = "" if unit == "1" else re.sub(r"(?<=[A-Za-z])(\d)", r"**\1", unit)
        try:
            return float(value.to(wanted.replace(".", "*")).magnitude)
        except Exception:  # pint's own errors, which are not known here
            continue
    raise InputError(f"{where} = {value}: this measures something else than {expected}")


def pair(where: str, value: Any, *units: str) -> tuple[float | None, float | None]:
    """(low, high) of ``[low, high]`` or ``{ min = low, max = high }``; None for an open end."""
    if isinstance(value, Mapping):
        known_keys(where, value, ("min", "max"))
        if not value:
            raise InputError(f"{where} is empty; give min, max or both")
        ends = [value.get("min", -math.inf), value.get("max", math.inf)]
    elif isinstance(value, list) and len(value) == 2:
        ends = value
    else:
        raise InputError(f"{where} = {value!r}: give [low, high], or {{ min = low, max = high }}")
    low, high = (quantity(where, end, *units) for end in ends)
    return (None if low == -math.inf else low), (None if high == math.inf else high)

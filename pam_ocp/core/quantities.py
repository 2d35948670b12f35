"""Quantities: a number in SI, or a number with its unit such as "15 mm"; and values that are far
from any usual one, with the unit that was probably meant.

One table per kind of quantity serves all doors: :meth:`Variable.check` (start values, parameters,
conditions, inputs), bounds and stops of plans, studies, and the arguments that never become a
variable.
"""

from __future__ import annotations

import math
import re
import sys
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

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
    match = _QUANTITY.match(value.replace("\u2212", "-", 1))  # the typesetter's minus
    if match is None or re.match(r"(?!1/)[.,\d]", match[2]):  # "1.000.5", but "60 1/min"
        raise InputError(f"{where} = {value!r} is not a number; give {example}")
    number, name = float(match[1]), match[2]
    if math.isinf(number):
        raise InputError(f"{where} {TOO_LARGE}")
    if not name:
        return number
    if name.replace("°", "deg") == "degC" and "K" in units:
        return number + ZERO_CELSIUS
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


# ---- values that are far from any usual one ------------------------------------------------------
FAR = 100.0
"""What a variable calls its nominal size says what is usual for it: only so many times more is
doubted.
"""
DIGITS = 5
"""A number of more digits was computed, not typed, and is not doubted: a pressure may decay to
0.137 Pa.
"""
ZERO_CELSIUS = 273.15


class UnitWarning(UserWarning):
    """A value is so far from any usual one that another unit was probably meant.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings(record=True) as given:
    ...     warnings.simplefilter("always")
    ...     _ = pam.simulate(plant, {"muscle.command": 3}, duration=0.1)  # 3 Pa: bar was meant
    ...
    >>> given[0].category.__name__
    'UnitWarning'
    """


@dataclass(frozen=True)
class Usual:
    """Sizes |value| from ``least`` to ``most`` [SI] pass, and 0; beyond, one of ``units`` was
    meant.

    typical : of several units the one is named that brings the value nearest to this size [SI].
    """

    least: float
    most: float
    units: tuple[str, ...]
    typical: float
    remedy: str = "check its unit"
    """What to say where none of the units fits."""


_USUAL: dict[str, Usual] = {
    "Pa": Usual(1e3, 1e8, ("bar", "kPa", "MPa", "psi"), 3e5),
    "Pa/s": Usual(1e4, 1e11, ("bar/s", "kPa/s", "MPa/s"), 4e6),
    "m": Usual(0.0, 4.0, ("mm", "cm", "in"), 0.05),
    "m/s": Usual(0.0, 200.0, ("mm/s", "cm/s"), 0.5),
    "kg": Usual(0.0, 1e3, ("g",), 5.0),
    "K": Usual(100.0, 2e3, ("degC",), 293.15),
    "rad": Usual(0.0, 2 * math.pi, ("deg",), 0.5),
    "m3": Usual(0.0, 0.5, ("l", "cm3", "mm3"), 1e-4),
    "m3/(s.Pa)": Usual(
        0.0, 1e-3, (), 1e-8, "conductance_from_flow(...) makes it from a nominal flow in l/min"
    ),
    "Hz": Usual(0.0, 1e5, (), 1.0),
}
_TIME_CONSTANT = Usual(0.0, 5.0, ("ms",), 0.05)
MEASURED: dict[str, Usual] = {
    "pressure": Usual(1e4, 1e6, ("bar", "kPa", "MPa", "psi", "mbar", "Pa"), 3e5),
    "force": Usual(1.0, 2e4, ("kN", "lbf", "kgf", "gf", "mN"), 1e3),
    "contraction": Usual(2e-3, 0.45, ("%",), 0.2),
    "length": Usual(5e-3, 4.0, ("mm", "cm", "in"), 0.3),
    "position": Usual(0.0, 2.0, ("mm", "cm", "in"), 0.03),
    "angle": Usual(0.0, 2 * math.pi, ("deg",), 0.5),
    "velocity": Usual(0.0, 10.0, ("mm/s", "cm/s"), 0.2),
    "angular velocity": Usual(0.0, 60.0, ("deg/s",), 2.0),
    "sample time": Usual(1e-5, 1.0, ("ms", "us", "ns", "d"), 1e-2),
    "duration": Usual(0.1, 30 * 86400.0, ("ms", "us", "ns", "d"), 10.0),
}
"""What rigs of this field measure: sizes of the largest value of a column [SI], in gauge pressure.
Muscles bear some 8 bar and pull with some kN, their stroke is a quarter of their length.
"""
FORCE_PER_PRESSURE = (1e-5, 0.03)
"""Force per gauge pressure [m2] of muscles of 1 to 60 mm in diameter: pi r0^2 times some 20."""
_BY_KIND = {unit_of(name).exponents: usual for name, usual in _USUAL.items()}


def largest_usual(unit: str) -> float:
    """The largest size that is usual for a quantity of this unit [SI]; 0 when none is known."""
    usual = _BY_KIND.get(unit_of(unit).exponents)
    return usual.most if usual else 0.0


def units_of(unit: str) -> tuple[str, ...]:
    """The other units in which people write a quantity of this unit; none where not known."""
    usual = _BY_KIND.get(unit_of(unit).exponents)
    return usual.units if usual else ()


def _in_si(value: float, unit: str) -> float:
    return value + ZERO_CELSIUS if unit == "degC" else value * unit_of(unit).factor


def _typed(value: float) -> bool:
    """Whether a person wrote this number: it has few digits."""
    return value == float(f"{value:.{DIGITS}g}")


def meant(value: float, unit: str, usual: Usual | None = None) -> str | None:
    """What was probably meant by ``value`` [unit, SI], as "3 bar = 3e+05 Pa"; None when it is
    usual.

    "" when it is unusual, and no unit known here makes it usual.
    """
    usual = usual or _BY_KIND.get(unit_of(unit).exponents)
    size = abs(value)
    if usual is None or size == 0 or usual.least <= size <= usual.most:
        return None
    if not math.isfinite(value) or not _typed(value):
        return None
    found = [(_in_si(value, name), name) for name in usual.units]
    inside = [(v, name) for v, name in found if usual.least <= abs(v) <= usual.most]
    if not inside:
        return ""
    best, name = min(inside, key=lambda pair: abs(math.log(abs(pair[0]) / usual.typical)))
    return f"{value:g} {name} = {best:g} {unit}"


def meant_within(value: float, unit: str, low: float, high: float) -> str:
    """A remedy for a value outside ``low`` .. ``high``: the unit in which it lies inside, or ""."""
    usual = _BY_KIND.get(unit_of(unit).exponents)
    names = usual.units if usual else ("%",) if unit == "1" else ()
    size = max((abs(v) for v in (low, high) if math.isfinite(v)), default=0.0)
    found = []
    for said in ("", *names):  # the unit that was said, "" for SI, and the one that was meant
        number = value if not said else _as_said(value, said)
        for name in names:
            inside = _in_si(number, name)
            if low <= inside <= high and inside != 0.0 and name != said and _typed(number):
                away = abs(math.log(abs(inside) / size)) if size > 0 else 0.0
                unlikely = (away > math.log(NEAR)) + 2 * (abs(number) < 1.0) + bool(said)
                found.append((unlikely, number, name, inside))
    if not found:
        return ""
    _, number, name, inside = min(found, key=lambda each: each[0])
    return f"; did you mean {number:g} {name} = {inside:g}{'' if unit == '1' else f' {unit}'}?"


NEAR = 30.0
"""Times that a value is less than the largest possible: still likely."""


def _as_said(value: float, unit: str) -> float:
    """The number that a person said in a unit, of its value in SI."""
    number = value - ZERO_CELSIUS if unit == "degC" else value / unit_of(unit).factor
    return float(f"{number:.12g}")


def inside_by(numbers: Mapping[str, float], now: str = "") -> list[str]:
    """The units by which all these numbers are usual, {key of MEASURED: as they stand}: the one
    nearest to typical sizes first, and those that are not ten times as far from them.

    now : the unit by which they are not.
    """

    def away(name: str) -> float:
        sizes = {k: abs(_in_si(v, name)) for k, v in numbers.items()}
        if not all(MEASURED[k].least <= s <= MEASURED[k].most and s > 0 for k, s in sizes.items()):
            return math.inf
        return sum(abs(math.log(s / MEASURED[k].typical)) for k, s in sizes.items())

    names = dict.fromkeys(name for k in numbers for name in MEASURED[k].units if name != now)
    nearest = min(map(away, names), default=math.inf)
    likely = [n for n in names if away(n) < math.inf and away(n) <= nearest + math.log(10)]
    return sorted(likely, key=away)


def doubt(
    argument: str,
    value: Any,
    unit: str,
    *,
    nominal: float = 0.0,
    time_constant: bool = False,
    within: tuple[float, float] = (-math.inf, math.inf),
) -> bool:
    """Warn (UnitWarning) when the numbers ``value`` [unit] are far from any usual ones; True then.

    Of arrays the largest number counts. nominal : a size at which large numbers are no wonder.
    time_constant : seconds of a lag, not of a duration. within : where the quantity can be.
    """
    if isinstance(value, float):
        largest = value
    else:
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
        largest = float(numbers.flat[int(np.argmax(np.abs(numbers)))]) if numbers.size else 0.0
    usual = _TIME_CONSTANT if time_constant else _BY_KIND.get(unit_of(unit).exponents)
    probable = meant(largest, unit, usual)
    large = usual is not None and abs(largest) > usual.most
    if usual is None or probable is None or (large and abs(largest) < FAR * nominal):
        return False
    hint = f"did you mean {probable}?" if probable else usual.remedy
    if not within[0] <= largest <= within[1]:
        hint = meant_within(largest, unit, *within).removeprefix("; ") or hint
    warnings.warn(
        f"{argument} = {largest:g} {unit} is far from any usual value; {hint}",
        UnitWarning,
        stacklevel=outside(),
    )
    return True


def outside() -> int:
    """For ``stacklevel=`` of a warning: how far up the stack the user's own code stands."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None:
        level, frame = level + 1, frame.f_back
        package = frame.f_globals.get("__name__", "").partition(".")[0]
        if package not in ("pam_ocp", "functools"):  # which stands between, in cached properties
            return level
    return 2

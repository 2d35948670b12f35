"""Physical units: exponents of the SI base units, and factors for display.

One small table serves the table reader, the plots and the FMU's unit definitions.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache

from .exceptions import UnknownNameError

BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")
"""Base units in the order of FMI's BaseUnit element."""


@dataclass(frozen=True)
class Unit:
    """A unit: SI value = ``factor`` * value + ``offset``, and its base exponents."""

    name: str
    exponents: tuple[int, ...]
    factor: float = 1.0
    offset: float = 0.0

    @property
    def base_exponents(self) -> dict[str, int]:
        """The non-zero exponents, as {"kg": 1, "m": -1, ...}."""
        return {b: e for b, e in zip(BASE, self.exponents, strict=True) if e}

    def compatible(self, other: Unit) -> bool:
        """Whether both measure the same quantity."""
        return self.exponents == other.exponents


def _exponents(**powers: int) -> tuple[int, ...]:
    return tuple(powers.get(b, 0) for b in BASE)


_NEWTON, _PASCAL = _exponents(kg=1, m=1, s=-2), _exponents(kg=1, m=-1, s=-2)
_VOLT = _exponents(kg=1, m=2, s=-3, A=-1)
_KINDS: tuple[tuple[tuple[int, ...], dict[str, float]], ...] = (
    (_exponents(), {"1": 1.0, "%": 0.01}),
    (_exponents(kg=1), {"kg": 1.0, "lb": 0.45359237, "g": 1e-3}),
    (_exponents(m=1), {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "um": 1e-6, "in": 0.0254}),
    (_exponents(m=3), {"l": 1e-3}),
    (_exponents(s=1), {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0, "d": 86400.0}),
    (_exponents(s=-1), {"Hz": 1.0}),
    (_exponents(K=1), {"K": 1.0}),
    (_exponents(rad=1), {"rad": 1.0, "deg": 0.017453292519943295}),
    (_NEWTON, {"N": 1.0, "kN": 1e3, "daN": 10.0, "lbf": 4.4482216152605, "mN": 1e-3}),
    (_NEWTON, {"gf": 9.80665e-3, "kgf": 9.80665, "kp": 9.80665}),
    (_exponents(kg=1, m=2, s=-2), {"J": 1.0}),
    (_exponents(kg=1, m=2, s=-3), {"W": 1.0}),
    (_VOLT, {"V": 1.0, "mV": 1e-3}),
    (_exponents(A=1), {"A": 1.0, "mA": 1e-3}),
    (_PASCAL, {"Pa": 1.0, "hPa": 1e2, "mbar": 1e2, "kPa": 1e3, "bar": 1e5, "MPa": 1e6}),
    (_PASCAL, {"psi": 6894.757293168, "atm": 101325.0, "at": 98066.5, "torr": 101325.0 / 760.0}),
    (_PASCAL, {"mmHg": 133.322387415, "inHg": 25.4 * 133.322387415}),
)
"""(exponents, {symbol: factor to SI}). Offsets (degC, absolute scales) are not needed here."""
_SYMBOLS = {name: (kind, factor) for kind, symbols in _KINDS for name, factor in symbols.items()}

_PREFIXES = {"n": 1e-9, "u": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}


def _symbol(name: str) -> tuple[tuple[int, ...], float] | None:
    """Exponents and factor of a symbol, with a prefix or without; None when it is not known."""
    if name in _SYMBOLS:
        return _SYMBOLS[name]
    prefix, plain = _PREFIXES.get(name[:1]), name[1:]
    if prefix is None or plain not in ("m", "s", "l", "Hz", "N", "J", "W", "Pa", "rad", "bar"):
        return None
    return _SYMBOLS[plain][0], prefix * _SYMBOLS[plain][1]


_TOKEN = re.compile(r"(?P<symbol>[A-Za-z%]+|1)(?P<power>-?\d+)?$")

_TYPESET = str.maketrans({"²": "2", "³": "3", "µ": "u", "μ": "u", "°": "deg", "·": ".", " ": None})


@cache
def unit(name: str) -> Unit:
    """Parse a unit such as ``"N"``, ``"N.s/m"``, ``"m3/(s.Pa)"`` or ``"bar"``.

    Grammar of Modelica: factors joined by ``.``, an integer power behind a symbol, one ``/``
    with the denominator in brackets when it has several factors.
    Raises UnknownNameError when a symbol is not known.
    """
    numerator, _, denominator = name.translate(_TYPESET).partition("/")
    exponents = [0] * len(BASE)
    factor = 1.0
    for part, sign in ((numerator, 1), (denominator.strip("()"), -1)):
        for token in filter(None, part.strip("()").split(".")):
            match = _TOKEN.match(token)
            known = match and _symbol(match["symbol"])
            if match is None or known is None:
                raise UnknownNameError("unit", name, [*_SYMBOLS, "N.m", "N.s", "rad/s"])
            power = sign * int(match["power"] or 1)
            base, scale = known
            exponents = [e + power * b for e, b in zip(exponents, base, strict=True)]
            factor *= scale**power
    return Unit(name, tuple(exponents), factor)


_DISPLAY = {"Pa": "bar", "Pa/s": "bar/s", "m": "mm", "rad": "deg", "rad/s": "deg/s", "N/m": "N/mm"}


def display_unit(name: str) -> str:
    """The unit in which people read this one: bar for Pa, mm for m, deg for rad, N/mm for N/m."""
    return _DISPLAY.get(name, name)


_QUANTITIES = {
    "m": "position",
    "rad": "angle",
    "m/s": "velocity",
    "rad/s": "angular velocity",
    "Pa": "pressure",
    "Pa/s": "pressure rate",
    "N": "force",
    "N.m": "torque",
    "N/m": "stiffness",
    "N.m/rad": "stiffness",
    "W": "power",
    "J": "energy",
    "kg": "mass",
    "kg/s": "mass flow",
    "K": "temperature",
    "V": "voltage",
    "A": "current",
}
_READ = {shown: si for si, shown in _DISPLAY.items()}


def quantity_of(unit: str) -> str:
    """What is measured in a unit of SI, or in the one that people read; "" without a usual name."""
    return _QUANTITIES.get(_READ.get(unit, unit), "")


_SI = {unit(si).exponents: si for si in reversed((*_QUANTITIES, *_DISPLAY))}


def si_unit(name: str) -> str:
    """The unit of SI for what a unit measures.

    Examples
    --------
    >>> si_unit("bar"), si_unit("l/min"), si_unit("%"), si_unit("N.s/m")
    ('Pa', 'm3/s', '1', 'N.s/m')
    """
    found = unit(name)
    if found.factor == 1.0:
        return name
    if found.exponents in _SI:
        return _SI[found.exponents]
    above, below = (
        ".".join(
            base + (str(abs(power)) if abs(power) > 1 else "")
            for base, power in found.base_exponents.items()
            if power * sign > 0
        )
        for sign in (1, -1)
    )
    over = f"/({below})" if "." in below else f"/{below}" if below else ""
    return f"{above or 1}{over}"


DIGITS = 4
"""Significant ones of a number that people read."""


def significant(value: float, digits: int = DIGITS) -> str:
    """A number as people read it, without an exponent where it is of a usual size.

    Examples
    --------
    >>> significant(123456.0), significant(0.0123456)
    ('123500', '0.01235')
    """
    return f"{float(f'{value:.{digits}g}'):.{max(digits, 7)}g}"


def per_second(unit: str) -> str:
    """The unit of a time derivative, as Modelica spells it: "m/s" for "m", "m/s2" for "m/s"."""
    numerator, _, denominator = unit.partition("/")
    if not denominator:
        return f"{numerator}/s"
    if denominator == "s":
        return f"{numerator}/s2"
    return f"{numerator}/({denominator.strip('()')}.s)"

"""From what a sensor reads to SI: a unit, an absolute pressure, or a calibration.

A calibration is a text such as ``"V * 2 bar/V - 0.3 bar"``: the bare name (V) is the reading, a
number with its unit is a constant, and units are checked as in any equation. Nothing of it is run
by Python.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .exceptions import InputError, UnknownNameError
from .units import Unit, unit

Array: TypeAlias = NDArray[np.float64]

AMBIENT = 101325.0
"""Standard atmosphere [Pa], which an absolute pressure counts from where nothing else is said."""

_NAMES = (
    "Pa hPa kPa MPa mbar bar psi torr mmHg inHg N kN daN kp lbf kgf m cm mm in s ms us min rad deg "
    "% 1"
)
"""Of pam_ocp.core.units, which are known in small letters, too."""
_WORDS = {
    "Pa": "па",
    "kPa": "кпа",
    "MPa": "мпа",
    "bar": "barg бар",
    "bar abs": "bara",
    "psi": "psig",
    "psi abs": "psia",
    "at": "atü",
    "at abs": "ata",
    "kgf/cm2": "kg/cm2 кгс/см2",
    "N": "newton н",
    "kN": "кн",
    "kgf": "кгс",
    "lb": "lbs",
    "mm": "мм",
    "cm": "см",
    "in": "inch",
    "um": "µm μm",
    "s": "sec second seconds sekunden с",
    "ms": "msec milliseconds мс",
    "us": "usec microseconds µs μs",
    "ns": "nsec nanoseconds",
    "min": "minutes",
    "h": "hours",
    "d": "day days tage",
    "deg": "°",
    "%": "percent pct",
    "1": "- fraction",
    "V": "volt",
}
SPELLINGS = {name.lower(): name for name in _NAMES.split()}
SPELLINGS |= {word: name for name, words in _WORDS.items() for word in words.split()}
"""What people write, in lower case, and the name in pam_ocp.core.units."""
COUNTS = frozenset(
    {"1", "count", "counts", "cnt", "digit", "digits", "lsb", "inc", "bit", "bits", "raw", "adc"}
)
"""Units of readings that measure nothing yet."""
_RAISED = str.maketrans({"²": "2", "³": "3"})
"""Powers as typesetters write them; ``^2`` is that of a calibration."""
_AREA = re.compile(r"[^\W\d]+/[^\W\d]+\^\d(?: abs)?$")
_ABSOLUTE = re.compile(
    r"(?P<rest>.*?)[\s_(,]*(?<![^\W_])(?:abs|absolute|absolut|absolu|a)\b\.?\)?\s*$", re.I
)
_GAUGE = re.compile(
    r"(?P<rest>.*?)[\s_(,]*\b(?:gauge|gage|rel|relativ|relative|g|ü)\b\.?\)?\s*$", re.I
)
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[^\W\d]+|%|°)(?P<power>\d(?![\d.]))?|(?P<sign>\*\*|[-+*/^().·]))"
)
MOST_TOKENS, MOST_POWER = 200, 9


@dataclass(frozen=True)
class Scale:
    """From the numbers that stand in a file to SI.

    unit : as it was said, for messages. measured : what it is a unit of. formula : of a
    calibration; None for a plain unit. reading, kind : SI value and exponents of the unit of its
    readings. shift : what is taken off for an absolute pressure [Pa].
    """

    unit: str
    measured: Unit
    formula: str | None = None
    reading: float = 1.0
    kind: tuple[int, ...] = ()
    shift: float = 0.0

    def si(self, values: Array) -> Array:
        """Readings in SI; NaN stays."""
        if self.formula is None:
            return np.asarray(values * self.measured.factor - self.shift)
        with np.errstate(all="ignore"):
            found = _Parser(self.unit, self.formula, values * self.reading, self.kind).value()[0]
        return np.asarray(found * np.ones_like(values) - self.shift)


def spelled(text: str) -> str:
    """A unit as pam_ocp.core.units knows it, " abs" behind that of an absolute pressure."""
    text = text.strip().translate(_RAISED)
    if _AREA.match(text):  # kgf/cm^2
        text = text.replace("^", "")
    known = SPELLINGS.get(text.lower())
    if known is not None:
        return known
    for pattern, tail in ((_ABSOLUTE, " abs"), (_GAUGE, "")):
        match = pattern.match(text)
        if match and match["rest"].strip():
            rest = match["rest"].strip()
            return SPELLINGS.get(rest.lower(), rest) + tail
    return text


def scale_of(
    where: str, text: str, base: Unit | None, header: str | None, ambient: float = AMBIENT
) -> Scale:
    """What a text says of a column's readings.

    where : the column, for messages. text : a unit, or a calibration. base : what it must measure;
    None for anything. header : the unit that stands in the file, of the reading of a calibration.
    ambient : pressure of the surroundings [Pa], taken off absolute pressures.

    Raises InputError, UnknownNameError.
    """
    name = spelled(text)
    absolute = name.endswith(" abs")
    plain = name.removesuffix(" abs")
    shift = ambient if absolute else 0.0
    if plain.lower() in COUNTS:
        return Scale(name, Unit(plain, unit("1").exponents))
    try:
        measured = unit(plain)
    except UnknownNameError:
        if not re.search(r"[-+*/^\s\d]", plain):
            raise
        return replace(_calibrated(where, plain, base, header), unit=name, shift=shift)
    return Scale(name, measured, shift=shift)


def _calibrated(where: str, text: str, base: Unit | None, header: str | None) -> Scale:
    parser, formula = _Parser(where, text), text
    parser.value()
    names = sorted(parser.names)
    if len(names) > 1:
        raise InputError(
            f"{where}: {text!r} names {' and '.join(names)}; a calibration has one reading, as in "
            "'V * 2 bar/V - 0.3 bar', and a unit behind every constant"
        )
    if names:
        reading = _unit_or_count(names[0])
    else:  # "2 bar/V": so much for each V
        below = text.rpartition("/")[2].strip() if "/" in text else ""
        if not below or sum(bool(token["number"]) for token in parser.tokens) > 1:
            raise InputError(
                f"{where}: {text!r} names no reading; write it as in 'V * 2 bar/V - 0.3 bar'"
            )
        reading, formula = _unit_or_count(below), f"{below} * ({text})"
    if header is not None and header.lower() not in COUNTS:
        said = unit(spelled(header).removesuffix(" abs"))
        if names and _is_symbol(names[0]) and not said.compatible(reading):
            raise InputError(
                f"{where} says {header}, but {text!r} reads {names[0]}; correct one of them"
            )
        reading = said
    _, kind = _Parser(where, formula, np.ones(1), reading.exponents).value()
    if base is not None and kind != base.exponents:
        raise InputError(
            f"{where}: {text!r} gives something else than {base.name}; give each constant its "
            f"unit, as in 'V * 2 {base.name}/V - 0.3 {base.name}'"
        )
    return Scale(text, Unit(text, kind), formula, reading.factor, reading.exponents)


def _is_symbol(name: str) -> bool:
    """Whether a word of a calibration is a unit."""
    try:
        unit(name)
    except UnknownNameError:
        return False
    return True


def _unit_or_count(name: str) -> Unit:
    name = SPELLINGS.get(name.lower(), name)
    return unit(name) if _is_symbol(name) else unit("1")


# ---- grammar: sums of products of powers of readings and constants ------------------------------
_Value: TypeAlias = tuple[Any, tuple[int, ...]]
"""(SI value, exponents of its unit)."""


class _Parser:
    """sum = product {(+|-) product}; product = power {(*|/) power}; power = atom [^ digit].

    Each gives its value for readings [SI] of a kind; kind None: units are not looked at.
    """

    def __init__(
        self, where: str, text: str, readings: Any = 1.0, kind: tuple[int, ...] | None = None
    ) -> None:
        self.where, self.text, self.readings, self.kind, at = where, text, readings, kind, 0
        self.names: set[str] = set()
        """Of the readings."""
        self.tokens: list[re.Match[str]] = []
        while at < len(text.rstrip()):
            match = _TOKEN.match(text, at)
            if match is None or len(self.tokens) > MOST_TOKENS:
                raise self.wrong(f"cannot be read at {text[at : at + 10]!r}")
            self.tokens.append(match)
            at = match.end()
        self.at = self.level = 0

    def wrong(self, words: str) -> InputError:
        return InputError(
            f"{self.where}: {self.text[:100]!r} {words}; write a unit, or a calibration as "
            "'V * 2 bar/V - 0.3 bar'"
        )

    def value(self) -> _Value:
        """Of the whole text."""
        found = self.sum()
        if self.at < len(self.tokens):
            raise self.wrong(f"cannot be read at {self.tokens[self.at][0].strip()!r}")
        return found

    def peek(self, kind: str, ahead: int = 0) -> str | None:
        place = self.at + ahead
        return self.tokens[place][kind] if place < len(self.tokens) else None

    def sum(self) -> _Value:
        sign = self.peek("sign")
        if sign in ("+", "-"):
            self.at += 1
        total, kind = self.product()
        total = -total if sign == "-" else total
        while (sign := self.peek("sign")) in ("+", "-"):
            self.at += 1
            more, other = self.product()
            if self.kind is not None and kind != other:
                raise InputError(
                    f"{self.text!r} adds things of different kinds; give each constant its unit, "
                    "as in 'V * 2 bar/V - 0.3 bar'"
                )
            total = total + more if sign == "+" else total - more
        return total, kind

    def product(self) -> _Value:
        value, kind = self.power()
        while (sign := self.peek("sign")) in ("*", "/", "·"):
            self.at += 1
            other, its = self.power()
            value = np.divide(value, other) if sign == "/" else value * other
            turn = -1 if sign == "/" else 1
            kind = tuple(a + turn * b for a, b in zip(kind, its, strict=True))
        return value, kind

    def power(self) -> _Value:
        value, kind = self.atom()
        if self.peek("sign") in ("^", "**"):
            self.at += 1
            power = self.digit()
            return value**power, tuple(e * power for e in kind)
        return value, kind

    def digit(self) -> int:
        number = self.peek("number")
        if number is None or not number.isdigit() or int(number) > MOST_POWER:
            raise self.wrong(f"has a power that is no whole number from 0 to {MOST_POWER}")
        self.at += 1
        return int(number)

    def atom(self) -> _Value:
        if self.peek("sign") == "(":
            self.at, self.level = self.at + 1, self.level + 1
            found = self.sum()
            if self.peek("sign") != ")" or self.level > 20:
                raise self.wrong("lacks a closing bracket")
            self.at += 1
            return found
        number = self.peek("number")
        if number is not None:
            self.at += 1
            return self.constant(float(number))
        name, power = self.peek("name"), int(self.peek("power") or 1)
        if name is None:
            raise self.wrong("ends too early" if self.at >= len(self.tokens) else "is no equation")
        self.at += 1
        self.names.add(name)
        return self.readings**power, tuple(e * power for e in self.kind or unit("1").exponents)

    def constant(self, number: float) -> _Value:
        """With the unit behind it: names joined by / or a point; ``*`` ends it."""
        exponents, sign = unit("1").exponents, 1
        while (name := self.peek("name")) is not None:
            power = int(self.peek("power") or 1)
            self.at += 1
            if self.peek("sign") == "^":
                self.at += 1
                power = self.digit()
            known = SPELLINGS.get(name.lower(), name)
            counted = known.lower() in COUNTS or not (_is_symbol(known) or any(self.kind or ()))
            if self.kind is not None and not counted:
                one = unit(known)
                number *= one.factor ** (sign * power)
                exponents = tuple(
                    e + sign * power * o for e, o in zip(exponents, one.exponents, strict=True)
                )
            following = self.peek("sign")
            if following not in ("/", ".") or self.peek("name", 1) is None:
                break
            sign = -1 if following == "/" else sign
            self.at += 1
        return number, exponents

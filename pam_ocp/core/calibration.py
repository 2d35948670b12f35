"""From what a sensor reads to SI: a unit, an absolute pressure, or a calibration.

A calibration is a text such as ``"V * 2 bar/V - 0.3 bar"``: the bare name (V) is the reading, a
number with its unit is a constant, and units are checked as in any equation. Nothing of it is run
by Python.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .exceptions import InputError, UnknownNameError
from .units import Unit, unit

Array: TypeAlias = NDArray[np.float64]

AMBIENT = 101325.0
"""Standard atmosphere [Pa], which an absolute pressure counts from where nothing else is said."""

# What people write, in lower case, and the name in pam_ocp.core.units
SPELLINGS = {
    "pa": "Pa",
    "hpa": "hPa",
    "kpa": "kPa",
    "mpa": "MPa",
    "mbar": "mbar",
    "bar": "bar",
    "barg": "bar",
    "bara": "bar abs",
    "psi": "psi",
    "psig": "psi",
    "psia": "psi abs",
    "torr": "torr",
    "mmhg": "mmHg",
    "inhg": "inHg",
    "ata": "at abs",
    "atü": "at",
    "n": "N",
    "kn": "kN",
    "dan": "daN",
    "kp": "kp",
    "newton": "N",
    "lbf": "lbf",
    "kgf": "kgf",
    "m": "m",
    "cm": "cm",
    "mm": "mm",
    "in": "in",
    "inch": "in",
    "s": "s",
    "sec": "s",
    "seconds": "s",
    "sekunden": "s",
    "second": "s",
    "ms": "ms",
    "msec": "ms",
    "milliseconds": "ms",
    "us": "us",
    "usec": "us",
    "microseconds": "us",
    "nsec": "ns",
    "nanoseconds": "ns",
    "min": "min",
    "minutes": "min",
    "hours": "h",
    "day": "d",
    "days": "d",
    "tage": "d",
    "rad": "rad",
    "deg": "deg",
    "°": "deg",
    "%": "%",
    "percent": "%",
    "pct": "%",
    "1": "1",
    "-": "1",
    "fraction": "1",
    "volt": "V",
    "µs": "us",
    "μs": "us",
    "µm": "um",
    "μm": "um",
}
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
    formula: _Node | None = None
    reading: float = 1.0
    kind: tuple[int, ...] = ()
    shift: float = 0.0

    def si(self, values: Array) -> Array:
        """Readings in SI; NaN stays."""
        if self.formula is None:
            return np.asarray(values * self.measured.factor - self.shift)
        with np.errstate(all="ignore"):
            found = _value(self.formula, values * self.reading, self.kind, self.unit)[0]
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
        tree = _parsed(where, plain)
        return _calibrated(where, name, tree, base, header, shift)
    return Scale(name, measured, shift=shift)


def _calibrated(
    where: str, text: str, tree: _Node, base: Unit | None, header: str | None, shift: float
) -> Scale:
    names = sorted(_readings(tree))
    if len(names) > 1:
        raise InputError(
            f"{where}: {text!r} names {' and '.join(names)}; a calibration has one reading, as in "
            "'V * 2 bar/V - 0.3 bar', and a unit behind every constant"
        )
    if names:
        reading = _unit_or_count(names[0], header)
    else:
        reading, tree = _gain(where, text, tree)
    if header is not None and header.lower() not in COUNTS:
        said = unit(spelled(header).removesuffix(" abs"))
        if names and _is_symbol(names[0]) and not said.compatible(reading):
            raise InputError(
                f"{where} says {header}, but {text!r} reads {names[0]}; correct one of them"
            )
        reading = said
    _, kind = _value(tree, np.ones(1), reading.exponents, text)
    if base is not None and kind != base.exponents:
        raise InputError(
            f"{where}: {text!r} gives something else than {base.name}; give each constant its "
            f"unit, as in 'V * 2 {base.name}/V - 0.3 {base.name}'"
        )
    return Scale(text, Unit(text, kind), tree, reading.factor, reading.exponents, shift)


def _is_symbol(name: str) -> bool:
    """Whether a word of a calibration is a unit."""
    try:
        unit(name)
    except UnknownNameError:
        return False
    return True


def _unit_or_count(name: str, header: str | None) -> Unit:
    name = SPELLINGS.get(name.lower(), name)
    return unit(name) if _is_symbol(name) else unit("1")


def _gain(where: str, text: str, tree: _Node) -> tuple[Unit, _Node]:
    """``"2 bar/V"``: so much for each V."""
    below = text.rpartition("/")[2].strip() if "/" in text else ""
    if tree[0] != "constant" or not below:
        raise InputError(
            f"{where}: {text!r} names no reading; write it as in 'V * 2 bar/V - 0.3 bar'"
        )
    return _unit_or_count(below, None), ("*", tree, ("reading", below))


# ---- grammar: sums of products of powers of readings and constants ------------------------------
_Node: TypeAlias = tuple[Any, ...]
_Value: TypeAlias = tuple[Any, tuple[int, ...]]


class _Parser:
    """sum = product {(+|-) product}; product = power {(*|/) power}; power = atom [^ digit]."""

    def __init__(self, where: str, text: str) -> None:
        self.where, self.text, at = where, text, 0
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

    def peek(self, kind: str, ahead: int = 0) -> str | None:
        place = self.at + ahead
        return self.tokens[place][kind] if place < len(self.tokens) else None

    def sum(self) -> _Node:
        sign = self.peek("sign")
        if sign in ("+", "-"):
            self.at += 1
        node = self.product()
        node = ("-", ("zero",), node) if sign == "-" else node
        while (sign := self.peek("sign")) in ("+", "-"):
            self.at += 1
            node = (sign, node, self.product())
        return node

    def product(self) -> _Node:
        node = self.power()
        while (sign := self.peek("sign")) in ("*", "/", "·"):
            self.at += 1
            node = ("/" if sign == "/" else "*", node, self.power())
        return node

    def power(self) -> _Node:
        node = self.atom()
        if self.peek("sign") in ("^", "**"):
            self.at += 1
            node = ("^", node, self.digit())
        return node

    def digit(self) -> int:
        number = self.peek("number")
        if number is None or not number.isdigit() or int(number) > MOST_POWER:
            raise self.wrong(f"has a power that is no whole number from 0 to {MOST_POWER}")
        self.at += 1
        return int(number)

    def atom(self) -> _Node:
        if self.peek("sign") == "(":
            self.at, self.level = self.at + 1, self.level + 1
            node = self.sum()
            if self.peek("sign") != ")" or self.level > 20:
                raise self.wrong("lacks a closing bracket")
            self.at += 1
            return node
        number = self.peek("number")
        if number is not None:
            self.at += 1
            return ("constant", float(number), self.units())
        name = self.peek("name")
        if name is None:
            raise self.wrong("ends too early" if self.at >= len(self.tokens) else "is no equation")
        power = self.peek("power")
        self.at += 1
        return ("^", ("reading", name), int(power)) if power else ("reading", name)

    def units(self) -> tuple[tuple[str, int], ...]:
        """The unit behind a number: names joined by / or a point; ``*`` ends it."""
        found, sign = [], 1
        while (name := self.peek("name")) is not None:
            power = int(self.peek("power") or 1)
            self.at += 1
            if self.peek("sign") == "^":
                self.at += 1
                power = self.digit()
            found.append((name, sign * power))
            following = self.peek("sign")
            if following not in ("/", ".") or self.peek("name", 1) is None:
                break
            sign = -1 if following == "/" else sign
            self.at += 1
        return tuple(found)


def _parsed(where: str, text: str) -> _Node:
    parser = _Parser(where, text)
    node = parser.sum()
    if parser.at < len(parser.tokens):
        raise parser.wrong(f"cannot be read at {parser.tokens[parser.at][0].strip()!r}")
    return node


def _readings(node: _Node) -> set[str]:
    if node[0] == "reading":
        return {node[1]}
    return set().union(
        *(_readings(n) for n in node[1:] if isinstance(n, tuple) and n and n[0] in _OF)
    )


_OF = ("reading", "constant", "zero", "+", "-", "*", "/", "^")


def _value(node: _Node, reading: Array, kind: tuple[int, ...], text: str) -> _Value:
    """(SI value, exponents of its unit)."""
    what = node[0]
    if what == "reading":
        return reading, kind
    if what == "zero":
        return 0.0, ()
    if what == "constant":
        return _constant(node[1], node[2], kind)
    if what == "^":
        value, base = _value(node[1], reading, kind, text)
        return value ** node[2], tuple(e * node[2] for e in base)
    (a, left), (b, right) = (_value(n, reading, kind, text) for n in node[1:])
    if what == "*":
        return a * b, tuple(x + y for x, y in zip(left, right, strict=True))
    if what == "/":
        return np.divide(a, b), tuple(x - y for x, y in zip(left, right, strict=True))
    if left and left != right:
        raise InputError(
            f"{text!r} adds things of different kinds; give each constant its unit, as in "
            "'V * 2 bar/V - 0.3 bar'"
        )
    return (a + b if what == "+" else a - b), right


def _constant(number: float, units: tuple[tuple[str, int], ...], kind: tuple[int, ...]) -> _Value:
    exponents, factor = unit("1").exponents, 1.0
    for name, power in units:
        known = SPELLINGS.get(name.lower(), name)
        if known.lower() in COUNTS or (not _is_symbol(known) and not any(kind)):
            continue
        one = unit(known)
        exponents = tuple(e + power * o for e, o in zip(exponents, one.exponents, strict=True))
        factor *= one.factor**power
    return number * factor, exponents

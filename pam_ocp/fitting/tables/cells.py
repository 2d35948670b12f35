"""Headers and cells as people write them: quantities and units in usual spellings and languages
(``length_m``, ``p [kPa]``, ``pressure (bar)``, ``F/N``, ``kappa [%]``, ``Druck Ist [bar]``);
numbers with points or commas, empty ones, stamps of time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import date, datetime
from datetime import time as clock_time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.calibration import COUNTS, SPELLINGS, spelled
from ...core.errors import InputError, UnknownNameError
from ...core.units import unit


def words_of(text: str) -> frozenset[str]:
    """Names between commas, on any number of lines."""
    return frozenset(" ".join(name.split()) for name in text.split(","))


NAMES: dict[str, frozenset[str]] = {
    "length": words_of(
        """length, l, len, muscle length, active length, länge, laenge, muskellänge, longueur,
        longitud, lunghezza, lengte, comprimento, längd, długość, hossz, délka, lungime, uzunluk,
        boy, pituus, длина, длина мышцы, довжина, μήκος, 长度, 長度, 長さ, 全長, 길이"""
    ),
    "contraction": words_of(
        """contraction, contraction ratio, contraction strain, relative contraction, kappa, κ, eps,
        epsilon, ε, kontraktion, kontraktionsgrad, verkürzung, verkuerzung, taux de contraction,
        contracción, contraccion, contrazione, contractie, contração, raccourcissement,
        acortamiento, accorciamento, rövidülés, összehúzódás, kontrakció, skrócenie, zkrácení,
        contracție, supistuma, сокращение, относительное сокращение, укорочение, скорочення,
        收缩率, 收縮率, 収縮率, 收缩量, 収縮量, 수축률"""
    ),
    "pressure": words_of(
        """pressure, p, gauge pressure, pressure gauge, p gauge, muscle pressure, internal pressure,
        press, druck, überdruck, ueberdruck, muskeldruck, innendruck, pression, pression relative,
        presión, presion, pressione, druk, tryck, pressão, ciśnienie, nadciśnienie, nyomás,
        túlnyomás, tlak, přetlak, presiune, basınç, paine, trykk, давление, избыточное давление,
        тиск, πίεση, 压力, 压强, 气压, 壓力, 圧力, ゲージ圧, 압력"""
    ),
    "absolute pressure": words_of(
        """absolute pressure, pressure absolute, pressure abs, p abs, pabs, abs pressure,
        absolutdruck, druck absolut, druck abs, pression absolue, presión absoluta, pressione
        assoluta, 绝对压力, 絶対圧, 絶対圧力"""
    ),
    "force": words_of(
        """force, f, pulling force, pull force, tension, tensile force, axial force, load cell,
        loadcell, kraft, zugkraft, muskelkraft, kraftsensor, force de traction, fuerza,
        fuerza axial, forza, kracht, força, siła, effort, erő, húzóerő, síla, forță, kuvvet, voima,
        сила, усилие, сила тяги, δύναμη, 力, 拉力, 张力, 張力, 発生力, 힘"""
    ),
}
"""Quantity: names by which a header calls it."""
PLACES: dict[str, frozenset[str]] = {
    "position": words_of("x, position, pos, displacement, weg, hub, stroke, posición, posizione"),
    "angle": words_of("phi, φ, angle, joint angle, winkel, gelenkwinkel, theta, q, ángulo"),
}
"""Motion of a load: names by which a header calls it."""
TIME_NAMES = words_of(
    """time, t, zeit, timestamp, time stamp, date, datetime, date time, elapsed, elapsed time,
    datum, uhrzeit, zeitstempel, datum uhrzeit, messzeit, temps, tiempo, tempo, tijd, tid, czas,
    время, 时间, 時間, x value, seconds, sec, tout, stamp, clock, header stamp"""
)
MEASURED = words_of(
    """measured, meas, actual, act, ist, istwert, sensor, mess, gemessen, mesuré, mesurée, mesure,
    real, feedback, mean, avg, average, mittel, mittelwert, moyenne, medida, misurata, muscle,
    muskel"""
)
"""Words that say no more than that the quantity was measured."""
COMMANDS = words_of(
    """command, cmd, set, setpoint, set point, pressure command, pressure set, p set, p cmd, p soll,
    p ref, p des, reference, ref, target, soll, sollwert, druck soll, solldruck, consigne, consigna,
    setpunkt, commanded, demanded, desired, requested, drucksollwert, consigne de pression"""
)
"""Names of what was asked for; with a name of the pressure beside: :func:`is_command`."""
SI = {
    **{"length": "m", "contraction": "1", "pressure": "Pa", "force": "N"},
    **{"position": "m", "angle": "rad", "velocity": "m/s", "angular velocity": "rad/s"},
}
"""What is measured: its unit."""
QUANTITIES = {q: (SI[q], NAMES[q]) for q in ("length", "contraction", "pressure", "force")}
"""Quantity of a force table: (SI unit, names by which a header calls it)."""
LABELS: dict[str, frozenset[str]] = {
    "branch": words_of(
        """branch, direction, phase, half cycle, path, richtung, ast, halbzyklus, sens, branche,
        dirección, sentido, direzione, richting"""
    ),
    "run": words_of(
        """run, repeat, repetition, rep, replicate, trial, cycle, lauf, zyklus, wiederholung,
        durchgang, versuch, essai, répétition, ciclo, ensayo, prova, herhaling"""
    ),
}
"""Label: names by which a header calls it."""
_BRANCH_WORDS = {
    "inflation": words_of(
        """inflation, inflating, inflate, inf, up, filling, fill, loading, rising, increasing,
        pressurising, pressurizing, ascending, auf, aufwärts, befüllen, befüllung, füllen,
        belüften, steigend, gonflage, montée, inflado, subida, gonfiaggio, +, +1"""
    ),
    "deflation": words_of(
        """deflation, deflating, deflate, def, down, venting, vent, unloading, falling,
        decreasing, depressurising, depressurizing, descending, ab, abwärts, entlüften,
        entlüftung, entleeren, fallend, dégonflage, descente, desinflado, bajada,
        sgonfiaggio, -, -1, -1.0"""
    ),
}
_BRANCHES = {word: branch for branch, words in _BRANCH_WORDS.items() for word in words}
# A bracket that ends the header, or what stands behind a slash or a comma
_BRACKETED = re.compile(
    r"(?P<name>.+?)\s*[\[(](?P<unit>[^\])]*(?:\([^)]*\))?)[\])]$|(?P<left>.+?)\s*/\s*(?P<right>\S+)$"
)
_ABSOLUTE = re.compile(r"(?P<rest>.*[\])]|.*_[^\W_]+)[\s_]*\(?(?:abs|absolute|absolut)\)?$", re.I)
"""Behind the unit: ``p [bar] (abs)``, ``p_bar_abs``."""
_SAYING_ABSOLUTE = words_of(
    """abs, absolute, absolut, absolue, absoluta, assoluta, abszolút, bezwzględne, absolutne,
    absolutní, абсолютное, абсолютний, 绝对, 絶対"""
)
_NARROW = {0xFF01 + i: 0x21 + i for i in range(94)}
"""Brackets and signs as wide as a Chinese character."""
_TOPIC = re.compile(r"/(?:data|value)$")
_COMMA = re.compile(r"(?P<name>.+?)\s*,\s*(?P<unit>[^,]+)$")
_SUFFIXED = re.compile(r"(?P<name>.+?)(?:[_\s]+in)?[_\s]+(?P<unit>[^_\s]+)$")


def parse_header(header: str) -> tuple[str, str | None]:
    """(name, unit or None) of a header; the unit as core.calibration spells it where known."""
    if header.startswith("/"):  # a topic: /rig/pressure/data
        return plain(_TOPIC.sub("", header.strip("/ ")).replace("/", ".")), None
    text = _ABSOLUTE.sub(r"abs \g<rest>", header.translate(_NARROW).strip())
    match = _COMMA.match(text)
    if match and (match["unit"].strip().lower() in SPELLINGS or _per(match["unit"])):
        return _absolute(plain(match["name"]), spelled(match["unit"]))
    match = _BRACKETED.match(text)
    if match:
        name, said = match["name"] or match["left"], match["unit"] or match["right"] or ""
        if said.strip().isdigit() and said.strip() != "1" and match["name"]:
            return _absolute(plain(header), None)  # an index, as in position[0]
        return _absolute(plain(name), spelled(said.strip()) or None)
    match = _SUFFIXED.match(text)
    if match and match["unit"].lower() in SPELLINGS and match["unit"] not in ("1", "-"):
        return _absolute(plain(match["name"]), spelled(match["unit"]))
    return _absolute(plain(header), None)


def _per(text: str) -> bool:
    """Whether this is a unit with a slash: kgf/cm2."""
    return "/" in text and is_unit(text)


def _absolute(name: str, said: str | None) -> tuple[str, str | None]:
    """The name says that a pressure is absolute: so does its unit then."""
    words = name.split()
    rest = " ".join(w for w in words if w.strip("().") not in _SAYING_ABSOLUTE)
    known = name in NAMES["absolute pressure"]
    if not known and (rest == name or not (rest in NAMES["pressure"] or measures(said, "Pa"))):
        return name, said
    said = said if (said or "").endswith(" abs") else f"{said or 'Pa'} abs"
    return "pressure" if known else rest, said


def measures(said: str | None, base: str) -> bool:
    """Whether a unit is one of those of ``base``; absolute pressures are pressures."""
    try:
        return said is not None and unit(said.removesuffix(" abs")).compatible(unit(base))
    except (UnknownNameError, ValueError, OverflowError):
        return False


def plain(name: str) -> str:
    return re.sub(r"[_\s]+", " ", name).strip().lower()


def is_unit(text: str) -> bool:
    """Whether a cell says a unit and nothing else: mm, [bar], (-), bar abs."""
    said = text.strip().strip("[]()").strip()
    name = spelled(said).removesuffix(" abs")
    return name.lower() in COUNTS or (bool(name) and measures(name, name))


def matching(names: frozenset[str], headers: Iterable[str]) -> list[str]:
    """The headers that bear one of the names, or else those that also say "measured"."""
    parsed = {h: parse_header(h)[0] for h in headers}
    exact = [h for h, name in parsed.items() if name in names]
    if exact:
        return exact
    return [
        h
        for h, name in parsed.items()
        if (words := [w for w in name.split() if w not in MEASURED]) != name.split()
        and " ".join(words) in names
    ]


def named_branch(text: str) -> str:
    """ "inflation" or "deflation" for the usual words; other words stay as they are."""
    return _BRANCHES.get(text.lower(), text)


def branch_of(text: str) -> str | None:
    """ "inflation" or "deflation" where a word says so; signs alone do not."""
    word = text.strip().lower()
    return _BRANCHES.get(word) if word.isalpha() else None


# ---- headers -------------------------------------------------------------------------------------
_EMPTY = """
    nan na n/a n.a. k.a. #n/a #nv #na #n/d <na> nat null none nil missing - -- --- nan(ind)
    -nan(ind) nan(snan) +nan -nan 1.#qnan -1.#qnan 1.#ind -1.#ind 1.#inf -1.#inf #div/0! #value!
    #wert! #num! #zahl! #ref! #bezug! over overload overrange overflow underrange ol +ol -ol error
    err fault invalid nodata bad ? ??? * *** #### ##### ######
    """
EMPTY = frozenset(_EMPTY.split()) | {""}
"""What stands in a cell that holds no reading, in lower case."""
_BLANKS = "’' \u00a0\u202f"
_INFINITE = ("inf", "-inf", "+inf", "infinity", "-infinity")


def _written(decimal: str, group: str) -> re.Pattern[str]:
    grouped = rf"[1-9]\d{{0,2}}(?:[{group}{_BLANKS}]\d{{3}})+"
    sign = re.escape(decimal)
    return re.compile(
        rf"[+-]?(?:{grouped}|\d+|(?={sign}\d))(?:{sign}\d*)?(?:[eEdD][+-]?\d+)?$", re.ASCII
    )


_NUMBERS = {".": _written(".", ","), ",": _written(",", ".")}
"""Decimal sign: numbers written with it, thousands in groups allowed."""
_STAMP = re.compile(
    r"\d{4}[-/.] ?\d{1,2}[-/.] ?\d{1,2}\.?([T ]+\d{1,2}:\d{2}.*)?$"
    r"|\d{1,2}[-/.](\d{1,2}|[a-z]{3})[-/.]\d{2,4}([T ,]+\d{1,2}:\d{2}.*)?$"
    r"|\d{1,3}:\d{2}(:\d{2})?([.,:]\d+)?( ?[AP]M)?$",
    re.IGNORECASE,
)


def is_empty(cell: Any) -> bool:
    """Whether a cell holds nothing, or says so."""
    if cell is None:
        return True
    if isinstance(cell, str):
        return cell.strip().lower() in EMPTY
    return isinstance(cell, float) and cell != cell


def is_stamp(cell: Any) -> bool:
    """Whether a cell is a date, a time of day, or both."""
    if isinstance(cell, datetime | date | clock_time | np.datetime64):
        return True
    return isinstance(cell, str) and _STAMP.match(cell.strip()) is not None


def is_number(cell: Any, decimal: str = ".") -> bool:
    if isinstance(cell, bool | np.bool_):
        return True
    if isinstance(cell, str):
        return (
            _NUMBERS[decimal].match(cell.strip()) is not None or cell.strip().lower() in _INFINITE
        )
    return isinstance(cell, int | float | np.integer | np.floating)


def number(cell: Any, decimal: str = ".") -> float:
    """The number in a cell; NaN where it is empty. Raises ValueError, TypeError, OverflowError."""
    if not isinstance(cell, str):
        return float("nan") if cell is None else float(cell)
    text = cell.strip()
    if text.lower() in EMPTY:
        return float("nan")
    if _NUMBERS[decimal].match(text) is None:
        if text.lower() in _INFINITE:
            return float(text)
        raise ValueError(f"{text!r} is no number")
    text = re.sub(f"[{_BLANKS}]", "", text).replace("D", "e").replace("d", "e")
    text = text.replace("," if decimal == "." else ".", "")
    return float(text.replace(",", "."))


def numbers_of(cells: Sequence[Any], decimal: str = ".") -> tuple[NDArray[np.float64], int | None]:
    """(numbers with NaN for empty cells, index of the first that is no number or None)."""
    plain = cells
    if decimal == "," and not any("." in c for c in cells if isinstance(c, str)):
        plain = [c.replace(",", ".") if isinstance(c, str) else c for c in cells]
    if decimal == "." or plain is not cells:
        try:  # all at once, where every cell is a plain number
            return np.array(plain, dtype=float).reshape(len(cells)), None
        except (TypeError, ValueError, OverflowError):
            pass
    found = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        try:
            found[i] = number(cell, decimal)
        except (TypeError, ValueError, OverflowError):
            return found, i
    return found, None


def decimal_of(cells: Iterable[Any]) -> str:
    """The decimal sign of text cells: a comma where more of them are numbers with it."""
    points = commas = signs = 0
    for cell in cells:
        if not isinstance(cell, str):
            continue
        text = cell.strip()
        point, comma = (_NUMBERS[d].match(text) is not None for d in ".,")
        points, commas = points + point, commas + comma
        signs += ("," in text) if point and comma else 0
    return "," if commas > points or (commas == points and signs) else "."


_PARTED = re.compile(
    r"(?P<number>[+-]?[\d.,'’ \u00a0\u202f]*\d(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\W\d_]\D*\d?|[%°].*)$"
)
MOSTLY = 0.6
"""Share of a column's cells that must be so written for it to be one of numbers with units."""


def parted(cell: Any) -> tuple[str, str] | None:
    """(number, unit) of a cell that holds both; None of any other."""
    if not isinstance(cell, str):
        return None
    text = cell.strip()
    match = None if any(is_number(text, d) for d in ".,") else _PARTED.match(text)
    if match is None or not is_unit(match["unit"]):
        return None
    number = match["number"].strip()
    return (number, match["unit"].strip()) if any(is_number(number, d) for d in ".,") else None


def without_units(
    label: str,
    columns: Mapping[int, Sequence[Any]],
    places: Sequence[Any],
    headers: Mapping[int, str] | None = None,
) -> tuple[dict[int, list[Any]], dict[int, str], str | None]:
    """(columns of plain numbers, their units, decimal sign) of columns whose cells name a unit. A
    bare number has the unit of the others; ``places`` : of each row, for messages.
    """
    found: dict[int, list[Any]] = {}
    units: dict[int, str] = {}
    for i, cells in columns.items():
        filled = [c for c in cells if not is_empty(c)]
        sample = filled[:: max(1, len(filled) // 50)]
        if sum(parted(c) is not None for c in sample) < MOSTLY * max(len(sample), 1):
            continue
        found[i], units[i] = _plain(label, (headers or {}).get(i, f"column {i + 1}"), cells, places)
    numbers = [c for cells in found.values() for c in cells]
    return found, units, decimal_of(numbers) if numbers else None


def _plain(
    label: str, header: str, cells: Sequence[Any], places: Sequence[Any]
) -> tuple[list[Any], str]:
    said = parse_header(header)[1]
    first: tuple[str, Any] | None = None if said is None else (said, "the header")
    made: list[Any] = []
    for cell, place in zip(cells, places, strict=True):
        two = parted(cell)
        made.append(cell if two is None else two[0])
        if two is None:
            continue
        if first is None:
            first = two[1], f"line {place}"
        elif spelled(two[1]) != spelled(first[0]):
            raise InputError(
                f"{label}: column {header!r} mixes units: {first[0]} in {first[1]}, {two[1]} in "
                f"line {place}; write all of a column in one unit"
            )
    assert first is not None
    return made, first[0]


def is_command(name: str) -> bool:
    """Whether a name says what was asked for: ``setpoint``, ``pressure setpoint``, ``target p``;
    a reference pressure may also be that of a gauge."""
    words = name.replace("-", " ").split()
    halves = [(" ".join(words[:i]), " ".join(words[i:])) for i in range(1, len(words))]
    return name in COMMANDS or any(
        (a in NAMES["pressure"] and b in COMMANDS)
        or (a in COMMANDS - {"ref", "reference"} and b in NAMES["pressure"])
        for a, b in halves
    )


def says_no_quantity(header: str) -> bool:
    """Whether a header says only that something was measured, or asked for: ``actual, set``."""
    name = parse_header(header)[0]
    return name in COMMANDS or all(w in MEASURED for w in name.split())

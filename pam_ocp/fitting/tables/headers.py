"""Headers: which quantity a column holds and in which unit, in the usual spellings and languages.

``length_m``, ``p [kPa]``, ``pressure (bar)``, ``F/N``, ``kappa [%]``, ``Druck Ist [bar]``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from ...core.calibration import COUNTS, SPELLINGS, spelled
from ...core.errors import UnknownNameError
from ...core.units import unit

__all__ = [
    "COMMANDS",
    "LABELS",
    "MEASURED",
    "NAMES",
    "PLACES",
    "QUANTITIES",
    "TIME_NAMES",
    "branch_of",
    "is_unit",
    "matching",
    "named_branch",
    "parse_header",
    "plain",
    "words_of",
]


def words_of(text: str) -> frozenset[str]:
    """Names between commas, on any number of lines."""
    return frozenset(" ".join(name.split()) for name in text.split(","))


NAMES: dict[str, frozenset[str]] = {
    "length": words_of(
        """length, l, len, muscle length, active length, länge, laenge, muskellänge, longueur,
        longitud, lunghezza, lengte, comprimento, längd, długość, длина, 长度, 長さ"""
    ),
    "contraction": words_of(
        """contraction, contraction ratio, contraction strain, relative contraction, kappa, κ, eps,
        epsilon, ε, kontraktion, kontraktionsgrad, verkürzung, verkuerzung, taux de contraction,
        contracción, contraccion, contrazione, contractie, contração, 收缩率, 収縮率"""
    ),
    "pressure": words_of(
        """pressure, p, gauge pressure, pressure gauge, p gauge, muscle pressure, internal pressure,
        press, druck, überdruck, ueberdruck, muskeldruck, innendruck, pression, pression relative,
        presión, presion, pressione, druk, tryck, pressão, ciśnienie, давление, 压力, 圧力"""
    ),
    "absolute pressure": words_of(
        """absolute pressure, pressure absolute, pressure abs, p abs, pabs, abs pressure,
        absolutdruck, druck absolut, druck abs, pression absolue, presión absoluta, pressione
        assoluta"""
    ),
    "force": words_of(
        """force, f, pulling force, pull force, tension, tensile force, axial force, load cell,
        loadcell, kraft, zugkraft, muskelkraft, kraftsensor, force de traction, fuerza,
        fuerza axial, forza, kracht, força, siła, сила, 力, 张力, 張力"""
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
    setpunkt"""
)
"""Names of what was asked for."""
QUANTITIES: dict[str, tuple[str, frozenset[str]]] = {
    "length": ("m", NAMES["length"]),
    "contraction": ("1", NAMES["contraction"]),
    "pressure": ("Pa", NAMES["pressure"]),
    "force": ("N", NAMES["force"]),
}
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
_SAYING_ABSOLUTE = words_of("abs, abs., absolute, absolut, absolue, absoluta, assoluta")
_TOPIC = re.compile(r"/(?:data|value)$")
_COMMA = re.compile(r"(?P<name>.+?)\s*,\s*(?P<unit>[^,]+)$")
_SUFFIXED = re.compile(r"(?P<name>.+?)(?:[_\s]+in)?[_\s]+(?P<unit>[^_\s]+)$")


def parse_header(header: str) -> tuple[str, str | None]:
    """(name, unit or None) of a header; the unit as core.calibration spells it where known."""
    if header.startswith("/"):  # a topic: /rig/pressure/data
        return plain(_TOPIC.sub("", header.strip("/ ")).replace("/", ".")), None
    text = _ABSOLUTE.sub(r"abs \g<rest>", header.strip())
    match = _BRACKETED.match(text)
    if match:
        name, said = match["name"] or match["left"], match["unit"] or match["right"] or ""
        if said.strip().isdigit() and said.strip() != "1" and match["name"]:
            return _absolute(plain(header), None)  # an index, as in position[0]
        return _absolute(plain(name), spelled(said.strip()) or None)
    match = _COMMA.match(text)
    if match and match["unit"].strip().lower() in SPELLINGS:
        return _absolute(plain(match["name"]), spelled(match["unit"]))
    match = _SUFFIXED.match(text)
    if match and match["unit"].lower() in SPELLINGS and match["unit"] not in ("1", "-"):
        return _absolute(plain(match["name"]), spelled(match["unit"]))
    return _absolute(plain(header), None)


def _absolute(name: str, said: str | None) -> tuple[str, str | None]:
    """The name says that a pressure is absolute: so does its unit then."""
    words = name.split()
    rest = " ".join(w for w in words if w not in _SAYING_ABSOLUTE)
    known = name in NAMES["absolute pressure"]
    if not known and (rest == name or not (rest in NAMES["pressure"] or _of_pressure(said))):
        return name, said
    said = said if (said or "").endswith(" abs") else f"{said or 'Pa'} abs"
    return "pressure" if known else rest, said


def _of_pressure(said: str | None) -> bool:
    try:
        return said is not None and unit(said.removesuffix(" abs")).compatible(unit("Pa"))
    except (UnknownNameError, ValueError, OverflowError):
        return False


def plain(name: str) -> str:
    return re.sub(r"[_\s]+", " ", name).strip().lower()


def is_unit(text: str) -> bool:
    """Whether a cell says a unit and nothing else: mm, [bar], (-), bar abs."""
    said = text.strip().strip("[]()").strip()
    name = spelled(said).removesuffix(" abs")
    if name.lower() in COUNTS:
        return True
    try:
        unit(name)
    except (UnknownNameError, ValueError, OverflowError):
        return False
    return bool(name)


def matching(names: frozenset[str], headers: Iterable[str]) -> list[str]:
    """The headers that bear one of the names; only where none does, those that say besides that
    it was measured (``p_meas``, ``Druck Ist``).
    """
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

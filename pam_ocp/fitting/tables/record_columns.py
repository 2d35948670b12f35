"""Which column of a record is which variable, and its values in SI."""

from __future__ import annotations

import re
import unicodedata
from typing import TYPE_CHECKING

import numpy as np

from ...core.calibration import AMBIENT, COUNTS, Scale, scale_of, spelled
from ...core.errors import InputError
from ...core.plausible import inside_by, units_of
from ...core.units import Unit, unit
from ...core.variables import Variable
from .cells import is_empty, is_number, is_stamp
from .headers import MEASURED, NAMES, PLACES, is_unit, parse_header, words_of
from .raw import RawTable

if TYPE_CHECKING:
    from ...plants.plant import Plant
    from ..statistics import Array

__all__ = ["COMMANDS", "check_size", "display_of", "record_scale", "record_variables"]

BEYOND = 20.0
"""A value this many times beyond a variable's bounds was read in a wrong unit."""
LEAST_PRESSURE = 1e3
"""A record whose pressures stay below this [Pa] was read in a wrong unit."""
_SI = (
    *("1", "m", "s", "kg", "K", "rad", "N", "Pa", "J", "W", "m/s", "rad/s", "m3", "N.m", "Pa/s"),
    *("V", "A"),
)
COMMANDS = words_of(
    """command, cmd, set, setpoint, set point, pressure command, pressure set, p set, p cmd, p soll,
    p ref, p des, reference, ref, target, soll, sollwert, druck soll, solldruck, consigne, consigna,
    setpunkt"""
)


def record_scale(
    raw: RawTable,
    header: str,
    name: str,
    base: Unit | None,
    wanted: str | None,
    ambient: float = AMBIENT,
) -> Scale | None:
    """How a column's numbers become SI; None where nothing says a unit. Raises InputError."""
    said = raw.unit(header)
    text = wanted or said
    if text is None:
        return None
    where = f"{raw.label}: column {header!r}"
    scale = scale_of(where, text, base, said if wanted else None, ambient)
    if scale.formula is not None:
        return scale
    if wanted and said and is_unit(said):
        other = scale_of(where, said, None, None).measured
        if not other.compatible(scale.measured):
            raise InputError(
                f"{where} says {said} but units[{name!r}] = {wanted!r}; correct the header or "
                f"leave units away, or give a calibration: '{said} * 2 {wanted}/{said}'"
            )
    if base is not None and not scale.measured.compatible(base):
        shown = {"Pa": "bar", "m": "mm", "rad": "deg"}.get(base.name, base.name)
        reads = text if text.lower() not in COUNTS else "counts"
        raise InputError(
            f"{where} is in {text}, which is no unit of {name} ({base.name}); correct the header "
            f"or give units={{{name!r}: ...}}, or a calibration as '{reads} * 2 {shown}/{reads} - "
            f"0.3 {shown}'"
        )
    return scale


def display_of(scale: Scale | None) -> str:
    """The SI unit of a column that belongs to no plant."""
    if scale is None:
        return "1"
    fitting = (name for name in _SI if unit(name).compatible(scale.measured))
    plain = spelled(scale.unit).removesuffix(" abs")
    return next(fitting, plain if scale.formula is None and scale.measured.factor == 1.0 else "1")


def check_size(
    raw: RawTable, header: str, variable: Variable, values: Array, scale: Scale | None
) -> None:
    """Values that no such variable takes come from a wrong unit."""
    said = None if scale is None else scale.unit
    bound = max((abs(v) for v in (variable.min, variable.max) if np.isfinite(v)), default=np.inf)
    worst = int(np.argmax(np.abs(values)))
    size = float(abs(values[worst]))
    read = f"read in {said}" if said else f"read in {variable.unit}, as no unit was named"
    place = (
        f"{raw.label}: column {header!r}, {raw.row(worst)}, is {values[worst]:.4g} {variable.unit}"
    )
    factor = 1.0 if scale is None else scale.measured.factor
    if np.isfinite(bound) and size > BEYOND * max(bound, 1e-3 * variable.nominal):
        fitting = next(
            (u for u in units_of(variable.unit) if size / factor * unit(u).factor <= bound), "..."
        )
        raise InputError(
            f"{place} ({read}), where {variable.name} lies within {variable.min:g} .. "
            f"{variable.max:g}: the unit cannot be right; correct the header or give "
            f"units={{{variable.name!r}: {fitting!r}}}"
        )
    if variable.unit == "Pa" and 0 < size < LEAST_PRESSURE:
        likely = inside_by({"pressure": size / factor})[:2] or ["bar", "kPa"]
        raise InputError(
            f"{place} at most ({read}): no muscle moves at that, it looks like "
            f"{' or '.join(likely)}; correct the header or give units={{{variable.name!r}: "
            f"{likely[0]!r}}}"
        )


def record_variables(
    raw: RawTable, plant: Plant | None, columns: dict[str, str], clock: str
) -> list[tuple[Variable, str]]:
    """(variable, header) of every column of use. Raises InputError where there is none."""
    labels = {h for h in raw.constant if h in ("muscle", "branch", "run")}
    taken = {*columns.values(), clock, *labels}
    rest = {h: parse_header(h)[0] for h in raw.columns if h not in taken}
    if plant is None:
        made = dict(columns)
        for header, name in rest.items():
            if not _has_numbers(raw, header):
                continue
            plain = _name(name)
            made[plain if plain not in made else _name(header)] = header
        return [(Variable(n, "output"), h) for n, h in made.items()]
    chosen = {plant.variable(n).name: h for n, h in columns.items()}
    plain_names = {v.name.replace(".", " ").replace("_", " ").lower(): v for v in plant.variables}
    for header, name in rest.items():
        for words in (name, header.lower().replace("_", " ")):
            variable = plain_names.get(words.replace(".", " "))
            if variable is not None and variable.name not in chosen:
                chosen[variable.name] = header
    for header, name in rest.items():
        if header not in chosen.values():
            meant = _meant(plant, name)
            if meant is not None and meant not in chosen and _has_numbers(raw, header):
                chosen[meant] = header
    chosen = {n: h for n, h in chosen.items() if plant.variable(n).causality != "parameter"}
    if not chosen:
        raise InputError(
            f"{raw.label}: no column among {', '.join(map(repr, rest))} bears the name of a "
            f"variable of plant {plant.name!r}; give columns={{variable: header}}"
        )
    return [(plant.variable(n), h) for n, h in chosen.items()]


def _name(text: str) -> str:
    """A variable's name: without accents, of other alphabets the English word."""
    known = next((k for k, names in NAMES.items() if text in names and not text.isascii()), text)
    plain = unicodedata.normalize("NFKD", known.replace("ß", "ss"))
    plain = "".join(c for c in plain if not unicodedata.combining(c))
    name = "".join(c if c.isascii() and c.isalnum() else "_" for c in plain)
    return name if name[:1].isalpha() else f"column_{name.strip('_')}".rstrip("_")


def _has_numbers(raw: RawTable, header: str) -> bool:
    """Whether a column holds numbers, and not remarks or stamps."""
    there = [c for c in raw.columns[header] if not is_empty(c)][:200]
    sign = raw.decimal or "."
    fitting = sum(is_number(c, sign) or is_number(c, ",") for c in there if not is_stamp(c))
    return fitting > 0.5 * len(there)


def _meant(plant: Plant, name: str) -> str | None:
    """The one variable of a plant that words such as ``druck 1`` or ``p2 ist`` mean."""
    words = [w for w in name.split() if w not in MEASURED]
    match = re.match(r"(?P<kind>\D*?)[\s.]*(?P<number>\d*)\s*(?P<rest>\D*)$", " ".join(words))
    if match is None:
        return None
    kind = " ".join(f"{match['kind']} {match['rest']}".split())
    for names in PLACES.values():
        if kind in names and not match["number"]:
            found = [v.name for v in plant.states if v.name in names]
            return found[0] if len(found) == 1 else None
    last = "command" if kind in COMMANDS else next((k for k in NAMES if kind in NAMES[k]), None)
    if last is None:
        return None
    fitting = [
        v.name
        for v in plant.variables
        if v.causality != "parameter"
        and v.name.rpartition(".")[2] == last
        and (not match["number"] or v.name.partition(".")[0].endswith(match["number"]))
    ]
    return fitting[0] if len(fitting) == 1 else None

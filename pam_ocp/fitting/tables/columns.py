"""Which column holds which quantity of a force table, or which variable of a record, in which unit,
and whether its numbers can be what its header says.
"""

from __future__ import annotations

import difflib
import re
import unicodedata
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...core.calibration import AMBIENT, COUNTS, Scale, scale_of, spelled
from ...core.errors import InputError, UnknownNameError
from ...core.quantities import MEASURED, inside_by, units_of
from ...core.units import Unit, unit
from ...core.variables import Variable
from .cells import (
    LABELS,
    NAMES,
    PLACES,
    QUANTITIES,
    is_command,
    is_empty,
    is_number,
    is_stamp,
    is_unit,
    measures,
    named_branch,
    parse_header,
    words_of,
)
from .cells import MEASURED as SAID_MEASURED
from .doubts import Column
from .raw import RawTable

if TYPE_CHECKING:
    from ...plants.plant import Plant
    from ..statistics import Array

BEYOND = 20.0
"""A value this many times beyond a variable's bounds was read in a wrong unit."""
LEAST_PRESSURE = 1e3
"""A record whose pressures stay below this [Pa] was read in a wrong unit."""
LARGEST_PRESSURE = (1e3, 5e6)
"""Where the largest gauge pressure of a table may lie [Pa]; beyond, its unit is in doubt."""
LARGEST_FORCE = 1e5
"""Beyond any fluidic muscle [N]."""
CONTRACTION_RANGE = (-0.10, 0.60)
"""10 % beyond the rest length; the braid locks at 35-40 %."""


_SI = (
    *("1", "m", "s", "kg", "K", "rad", "N", "Pa", "J", "W", "m/s", "rad/s", "m3", "N.m", "Pa/s"),
    *("V", "A"),
)


# ---- force tables --------------------------------------------------------------------------------
def assigned(
    raw: RawTable,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    ambient: float = AMBIENT,
    rest_length: float | None = None,
) -> dict[str, Column]:
    """{quantity: column} of a table, from the user's words first, then from the headers."""
    for argument, given, known in (
        ("columns", columns, (*QUANTITIES, *LABELS)),
        ("units", units, (*QUANTITIES,)),
    ):
        for quantity in given:
            if quantity not in known:
                raise UnknownNameError(f"quantity in {argument}", quantity, known)
    for header in columns.values():
        if header not in raw.columns:
            raise UnknownNameError("column", header, raw.columns)
    found = {}
    for quantity, (_, names) in QUANTITIES.items():
        chosen = raw.header(quantity, names, columns)
        if chosen is not None:
            base, said = unit(QUANTITIES[quantity][0]), units.get(quantity)
            if quantity == "contraction" and measures(said or raw.unit(chosen), "m"):
                scale = _shortening(raw, chosen, said, rest_length)
            else:
                scale = column_scale(raw, chosen, quantity, base, said, ambient, exact=True)
            found[quantity] = Column(chosen, quantity, quantity, scale, quantity in units)
    return found


def _shortening(
    raw: RawTable, header: str, wanted: str | None, rest_length: float | None
) -> Scale | None:
    """How a contraction in mm becomes a fraction of the rest length."""
    scale = column_scale(raw, header, "contraction", unit("m"), wanted, exact=True)
    if rest_length is None or scale is None:
        raise InputError(
            f"{raw.label}: column {header!r} holds by how much the muscle is shorter: give "
            "rest_length in metres, as in read_table(..., rest_length=0.300)"
        )
    ratio = Unit(scale.unit, unit("1").exponents, scale.measured.factor / rest_length)
    return replace(scale, measured=ratio)


def column_scale(
    raw: RawTable,
    header: str,
    name: str,
    base: Unit | None,
    wanted: str | None,
    ambient: float = AMBIENT,
    *,
    exact: bool = False,
) -> Scale | None:
    """How a column's numbers become SI; None where nothing says a unit. name : how ``units=`` calls
    the column. base : what it must measure. wanted : the user's unit or calibration. exact :
    numbers without a kind are refused, so is a unit beside the header's.
    """
    said = raw.unit(header)
    text = wanted or said
    if text is None:
        return None
    where = f"{raw.label}: column {header!r}"
    scale = scale_of(where, text, base, said if wanted else None, ambient)
    if scale.formula is not None:
        return scale
    counted = text.lower() in COUNTS and text != "1"
    if base is not None and ((exact and counted) or not scale.measured.compatible(base)):
        shown = {"Pa": "bar", "m": "mm", "rad": "deg", "1": "%"}.get(base.name, base.name)
        reads = "counts" if text.lower() in COUNTS else text
        what = f"a {name}" if name in QUANTITIES else name
        named = f"units[{name!r}] = {wanted!r}" if wanted else f"{where} is in {text}, which"
        remedy = "" if wanted else "correct the header or "
        example = f"{reads} * 2 {shown}/{reads} - 0.3 {shown}"
        if base.name == "N" and scale.measured.compatible(unit("kg")):
            example = _WEIGHT.format(reads)
        raise InputError(
            f"{named} is no unit of {what} ({base.name}); {remedy}give a calibration: "
            f"units={{{name!r}: {example!r}}}"
        )
    if wanted and said and is_unit(said):
        other = scale_of(where, said, None, None).measured
        same = other.compatible(scale.measured)
        absolute = said.endswith(" abs") and not scale.shift
        if not same or (exact and (other.factor != scale.measured.factor or absolute)):
            remedy = "" if same else f", or give a calibration: '{said} * 2 {wanted}/{said}'"
            raise InputError(
                f"{where} says {said} but units[{name!r}] = {wanted!r}; correct the header or "
                f"leave units away{remedy}"
            )
    return scale


def require_columns(raw: RawTable, found: Mapping[str, Column]) -> None:
    """Raises InputError for a quantity that no column holds."""
    missing = [q for q in ("pressure", "force") if q not in found]
    if "length" not in found and "contraction" not in found:
        missing.append("length")
    if not missing:
        return
    quantity = missing[0]
    words = "length or contraction" if quantity == "length" else quantity
    example = {"pressure": "pressure_Pa", "force": "force_N", "length": "length_m"}[quantity]
    used = {column.header for column in found.values()}
    free = [h for h in raw.columns if h not in used]
    near = {q: _near_headers(q, free, raw) for q in missing}
    hint = f"did you mean {' or '.join(map(repr, near[quantity]))}? " if near[quantity] else ""
    taken = {q: (near[q] or ["..."])[0] for q in missing}
    length, pull = taken.get("length", ""), taken.get("force", "")
    if measures(raw.unit(length), "1"):
        taken = {"contraction" if q == "length" else q: h for q, h in taken.items()}
    given = ", ".join(f"{q!r}: {h if h == '...' else repr(h)}" for q, h in taken.items())
    less = ""
    if parse_header(length)[0] in _DISPLACEMENTS:
        less = ", units={'length': '300 mm - x'} (the rest length less what it moved)"
    elif measures(raw.unit(pull), "kg"):
        less = f", units={{'force': {_WEIGHT.format(raw.unit(pull))!r}}} (the weight of a mass)"
    elif length == "...":
        less = " or constants={'contraction': '5 %'} where it is the same in all rows (from "
        less += "the file's name: pattern='..._{contraction [%]}pct.csv')"
    raise InputError(
        f"{raw.label} has no column for the {words} among {', '.join(map(repr, raw.columns))}: "
        f"{hint}Name it {example!r} or give columns={{{given}}}{less}"
    )


_WEIGHT = "{} * 9.80665 N/kg"
"""A calibration."""
_DISPLACEMENTS = words_of(
    """displacement, stroke, travel, shortening, hub, weg, verschiebung, course, carrera, corsa,
    elmozdulás, przemieszczenie, перемещение, ход, δl, dl, delta l, δx"""
)


def _near_headers(quantity: str, headers: Iterable[str], raw: RawTable) -> list[str]:
    """Headers that are spelled nearly so, or else those in a unit of the quantity."""
    headers = list(headers)
    plain = {parse_header(h)[0]: h for h in headers}
    wanted = [quantity, "contraction"] if quantity == "length" else [quantity]
    near = [m for w in wanted for m in difflib.get_close_matches(w, plain, n=2, cutoff=0.6)]
    if near:
        return [plain[m] for m in near]
    units = {h: u for h in headers if (u := raw.unit(h)) and u.lower() not in COUNTS}
    for base in (*(QUANTITIES[w][0] for w in wanted), *(["kg"] if quantity == "force" else [])):
        found = [h for h, said in units.items() if measures(said, base)]
        if found:
            return found[:3]
    return []


def read_labels(raw: RawTable, columns: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """Columns that hold labels, as text. Branches are "inflation" and "deflation" whichever of the
    usual words stand there ("up", "venting", -1 beside 1); other words stay as they are.
    """
    found = {}
    for label, names in LABELS.items():
        header = raw.header(label, names, columns)
        if header is not None:
            texts = [str("" if c is None else c).strip() for c in raw.columns[header]]
            texts = [t[:-2] if re.fullmatch(r"-*\d+\.0", t) else t for t in texts]
            if label == "branch":
                signs = set(texts) <= {"1", "-1"}
                texts = ["inflation" if signs and t == "1" else named_branch(t) for t in texts]
            found[label] = tuple(texts)
    return found


class Series:
    """A column as numbers: ``values`` as they stand, ``si`` converted."""

    def __init__(self, column: Column, raw: RawTable) -> None:
        self.column, self.raw = column, raw
        self.values = raw.numbers(column.header)
        self.si: Array = column.si(self.values)
        # what messages call the numbers that stand in the file
        self.unit = column.unit if column.plain else raw.unit(column.header) or "1"

    def shown(self, index: int) -> str:
        """``pressure 0.35 bar in row 3``."""
        name = "" if self.unit == "1" else f" {self.unit}"
        return f"{self.column.kind} {self.values[index]:g}{name} in {self.raw.row(index)}"

    @property
    def reading(self) -> str:
        return self.column.reading


def check_pressure(pressure: Series) -> None:
    top = int(np.argmax(pressure.si))
    low = int(np.argmin(pressure.si))
    largest, smallest = pressure.si[top], pressure.si[low]
    if smallest < -max(0.02 * largest, 2e3):
        raise InputError(
            f"{pressure.shown(low)} is negative beyond noise{_from_ambient(pressure, low)}; "
            "pressures are gauge pressures >= 0"
        )
    low_end, high_end = LARGEST_PRESSURE
    if not low_end <= largest <= high_end:
        fitting = inside_by({"pressure": float(pressure.values[top])}, pressure.unit)[:2]
        guess = f"it looks like {' or '.join(fitting)}" if fitting else "that cannot be"
        remedy = fitting[0] if fitting else "bar"
        usual = float(np.median(pressure.si))
        mark = f"{pressure.values[top]:g}"
        mixed = (
            f" (half of the rows stay below {usual / 1e5:.3g} bar: where the column mixes units, "
            f"mend it; where {mark} marks a missing value, give missing=[{mark}])"
            if largest > high_end and MEASURED["pressure"].least < usual < high_end / 10
            else ""
        )
        raise InputError(
            f"the largest {pressure.shown(top)} ({pressure.reading}) is {largest / 1e5:g} bar, "
            f"outside {low_end / 1e5:g} .. {high_end / 1e5:g} bar: {guess}; "
            f"correct the header or give units={{'pressure': {remedy!r}}}{mixed}"
        )


def _from_ambient(pressure: Series, low: int) -> str:
    if not pressure.column.shift:
        return ""
    least = pressure.si[low] + pressure.column.shift
    return (
        f" (absolute, {pressure.column.shift:g} Pa taken off: give ambient_pressure={least:.0f} if "
        "that was the weather, or the unit without 'abs')"
    )


def check_mixed_pressure(pressure: Series, p: Array, force: Array, contraction: Array) -> None:
    """A muscle at its rest length or shorter cannot pull hard with next to no pressure."""
    doubtful = (p < p.max() / 500) & (force > 0.2 * force.max()) & (contraction >= 0)
    if np.any(doubtful):
        i = int(np.argmax(doubtful))
        raise InputError(
            f"{pressure.shown(i)} goes with a force of {force[i]:g} N, while other rows reach "
            f"{pressure.values.max():g} {pressure.unit}: the column mixes units"
        )


def check_force(force: Series) -> None:
    top = int(np.argmax(np.abs(force.si)))
    if abs(force.si[top]) > LARGEST_FORCE:
        fitting = inside_by({"force": float(abs(force.values[top]))}, force.unit)[:2]
        guess = f"it looks like {' or '.join(fitting)}; " if fitting else ""
        raise InputError(
            f"{force.shown(top)} ({force.reading}) is beyond any fluidic muscle "
            f"({LARGEST_FORCE:g} N): {guess}correct the header or give "
            f"units={{'force': {fitting[0] if fitting else '...'!r}}}"
        )


def contraction_of(series: Mapping[str, Series], rest_length: float | None) -> Array:
    """kappa from whichever column there is; both must agree where both are."""
    low, high = CONTRACTION_RANGE
    direct = series.get("contraction")
    if direct is not None:
        _check_contraction(direct)
    if "length" not in series:
        assert direct is not None
        return direct.si
    if rest_length is None:
        if direct is not None:
            return direct.si
        raise InputError(
            f"column {series['length'].column.header!r} holds lengths: give rest_length in metres, "
            "as in read_table(..., rest_length=0.300)"
        )
    length = series["length"]
    shortest = int(np.argmin(length.si))
    if length.si[shortest] <= 0:
        raise InputError(f"{length.shown(shortest)} must be > 0")
    kappa: Array = 1.0 - length.si / rest_length
    for i in (int(np.argmin(kappa)), int(np.argmax(kappa))):
        if not low <= kappa[i] <= high:
            side = "more than 10 % beyond" if kappa[i] < low else "far too short for"
            raise InputError(
                f"{length.shown(i)} ({length.reading}) is {side} the rest length {rest_length:g} "
                "m; check rest_length (in metres) and the unit of the lengths (mm?)"
            )
    if direct is not None:
        gap = np.abs(kappa - direct.si)
        i = int(np.argmax(gap))
        if gap[i] > 0.01:
            raise InputError(
                f"{direct.shown(i)} contradicts {length.shown(i)}, which is a contraction of "
                f"{kappa[i]:.4g} at rest_length = {rest_length:g} m; correct one of them"
            )
    return kappa


def _check_contraction(contraction: Series) -> None:
    low, high = CONTRACTION_RANGE
    size = np.abs(contraction.si)
    worst = int(np.argmax(size))
    if size[worst] > 1:
        raise InputError(
            f"{contraction.shown(worst)} ({contraction.reading}) is beyond 1: it looks like "
            "percent; give units={'contraction': '%'}"
        )
    if 0 < size[worst] < 0.006 and contraction.unit == "%":
        raise InputError(
            f"the largest {contraction.shown(worst)} is next to nothing: it looks like a fraction; "
            "correct the header or give units={'contraction': '1'}"
        )
    for i in (int(np.argmin(contraction.si)), int(np.argmax(contraction.si))):
        if not low <= contraction.si[i] <= high:
            whole = 0 if contraction.si.min() < low else 100 if contraction.unit == "%" else 1
            raise InputError(
                f"{contraction.shown(i)} is outside {low * 100:g} .. {high * 100:g} %; "
                "contraction is (rest length - length)/rest length, positive when shorter: give "
                f"units={{'contraction': '{whole} {contraction.unit} - x'}} where it counts the "
                "other way"
            )


# ---- records ------------------------------------------------------------------------------------
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
            if not has_numbers(raw, header):
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
            if meant is not None and meant not in chosen and has_numbers(raw, header):
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


def has_numbers(raw: RawTable, header: str) -> bool:
    """Whether a column holds numbers, and not remarks or stamps."""
    there = [c for c in raw.columns[header] if not is_empty(c)][:200]
    sign = raw.decimal or "."
    fitting = sum(is_number(c, sign) or is_number(c, ",") for c in there if not is_stamp(c))
    return fitting > 0.5 * len(there)


def _meant(plant: Plant, name: str) -> str | None:
    """The one variable of a plant that words such as ``druck 1`` or ``p2 ist`` mean."""
    words = [w for w in name.split() if w not in SAID_MEASURED]
    match = re.match(r"(?P<kind>\D*?)[\s.]*(?P<number>\d*)\s*(?P<rest>\D*)$", " ".join(words))
    if match is None:
        return None
    kind = " ".join(f"{match['kind']} {match['rest']}".split())
    for names in PLACES.values():
        if kind in names and not match["number"]:
            found = [v.name for v in plant.states if v.name in names]
            return found[0] if len(found) == 1 else None
    last = "command" if is_command(kind) else next((k for k in NAMES if kind in NAMES[k]), None)
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

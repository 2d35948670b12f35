"""What no rig of this field measures: sentinels taken for missing values, points taken for
thousands, and values that doubt the unit, the sign or the zero by which they are read.

What is certain is mended and named in a note; what is only improbable is a :class:`Doubt` that
names the keyword to settle it. The ranges stand in :mod:`pam_ocp.core.quantities`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.calibration import Scale
from ...core.quantities import FORCE_PER_PRESSURE, MEASURED, inside_by
from ...core.units import unit
from ...core.variables import Variable
from .cells import MEASURED as SAID_MEASURED
from .cells import NAMES, PLACES, SI, is_empty, is_number, number, numbers_of
from .raw import Doubt, RawTable

Array: TypeAlias = NDArray[np.float64]
FEW_ROWS = 20
"""Fewer are set points that were held, and no record of what a sensor read."""
VACUUM = -1.1e5
"""No gauge pressure lies lower [Pa]."""
NEAR_AMBIENT = (9.5e4, 1.06e5)
"""A pressure that rests at such a value [Pa] is probably absolute."""
FULL_SCALES = frozenset({32767.0, -32768.0, 65535.0, 2147483647.0, -2147483648.0, 4294967295.0})
"""What a converter gives that has nothing to give."""
BEYOND_NUMBERS = 1e20
"""Nothing that is measured here is as large: 1e30, 9.91e37, the largest single."""
APART = 0.25
"""Of the range of the others: a sentinel stands so far from them at least."""
FAR_APART = 2.0
"""The same of a value that is none of the usual sentinels, but returns and cannot be."""
MIXED = 25.0
"""Times the usual force per pressure: beyond, pressures are in several units."""
HALF = 0.5
"""Of the force at less pressure and no less contraction: no muscle pulls so little."""
MOST_COMPARED = 1000
"""Cells of which each is compared with all others."""
OUTSIDE = 0.2
"""Of a variable's range: what is measured may lie so far beyond it."""
DECLARED = 10.0
"""A file that names the unit may hold values so much smaller than usual ones."""


@dataclass(frozen=True)
class Column:
    """A column of use. argument : how ``units=`` calls it. kind : key of MEASURED, "" where it is
    not known. scale : None where no unit is named. settled : the user said the unit.
    """

    header: str
    argument: str
    kind: str = ""
    scale: Scale | None = None
    settled: bool = False
    variable: Variable | None = None

    def si(self, numbers: Array) -> Array:
        return numbers if self.scale is None else self.scale.si(numbers)

    @property
    def plain(self) -> bool:
        """Whether the numbers are in a unit, and not in volts or counts."""
        return self.scale is None or self.scale.formula is None

    @property
    def shift(self) -> float:
        """What is taken off, of an absolute pressure [Pa]."""
        return 0.0 if self.scale is None else self.scale.shift

    @property
    def unit(self) -> str:
        return SI.get(self.kind, "1") if self.scale is None else self.scale.unit

    @property
    def reading(self) -> str:
        named = "" if self.scale is not None else ", as no unit was named"
        return f"read in {self.unit}{named}"


@dataclass
class Understood:
    """How far a source was understood, filled while it is read: its cells; {header: (quantity or
    variable, scale)} of the columns of use; its clock in words.
    """

    raw: RawTable
    meanings: dict[str, tuple[str, Scale | None]] = field(default_factory=dict)
    clock: str = ""


def kind_of(name: str, measured: str | None, *, told: bool) -> str:
    """The kind, a key of MEASURED, of a column; "" where not known, or where a plant ``told`` its
    unit.
    """
    words = [
        w.strip("0123456789") for w in name.replace(".", " ").replace("_", " ").lower().split()
    ]
    last = " ".join(w for w in words if w and w not in SAID_MEASURED)
    named = [k for k in ("pressure", "force", "contraction", "length") if _called(last, NAMES[k])]
    if measured is None:
        places = [k for k, names in PLACES.items() if _called(last, names)]
        return (named or places or [""])[0]
    if measured == "m":
        return "length" if named == ["length"] else "position"
    if measured == "1":
        return "contraction" if named == ["contraction"] and told else ""
    return next((k for k, si in SI.items() if si == measured), "")


def _called(text: str, names: frozenset[str]) -> bool:
    return text in names or text.rpartition(" ")[2] in names


# ---- cells that hold no reading ------------------------------------------------------------------
def checked_cells(raw: RawTable, columns: Sequence[Column], missing: Any = "found") -> RawTable:
    """The table with the decimal sign of each column, and without values that mark missing ones:
    those ``missing``, as they stand in the file; "found"; or none. What was done is noted.
    """
    if raw.own:
        return raw
    for column in columns:
        raw = _signed(raw, column)
    for column in columns if missing is not None else ():
        header = column.header
        if missing == "found":
            gone = _sentinels(raw.numbers(header), column)
        else:
            gone = _equal(raw.columns[header], missing, raw.sign(header))
        if np.any(gone):
            raw = _emptied(raw, header, gone)
    return raw


def _equal(cells: Sequence[Any], given: Sequence[Any], sign: str) -> NDArray[np.bool_]:
    texts = {v.strip().lower() for v in given if isinstance(v, str)}
    numbers = [float(v) for v in given if not isinstance(v, str)]
    return np.array(
        [
            str(c).strip().lower() in texts or (is_number(c, sign) and number(c, sign) in numbers)
            for c in cells
        ],
        dtype=bool,
    )


def _emptied(raw: RawTable, header: str, gone: NDArray[np.bool_]) -> RawTable:
    cells = raw.columns[header]
    marks = [c if isinstance(c, str) else f"{c:g}" for c, g in zip(cells, gone, strict=True) if g]
    shown = ", ".join(dict.fromkeys(marks))[:60]
    count, first = int(gone.sum()), raw.row(int(np.argmax(gone)))
    note = (
        f"{shown} in {header!r} ({count} row{'s' * (count > 1)}, first {first}) taken for missing "
        "values; missing=None keeps them"
    )
    kept = [None if g else c for c, g in zip(cells, gone, strict=True)]
    return replace(raw, columns={**raw.columns, header: kept}, notes=(*raw.notes, note))


def _sentinels(numbers: Array, column: Column) -> NDArray[np.bool_]:
    """Which numbers mark a missing value: beyond all, usual marks apart from others, or absurd."""
    known = ~np.isnan(numbers)
    gone = known & (np.abs(numbers) >= BEYOND_NUMBERS)
    values, counts = np.unique(numbers[known & ~gone], return_counts=True)
    while values.size > 3:  # from the ends inwards
        gaps = values[1] - values[0], values[-1] - values[-2]
        spans = values[-1] - values[1], values[-2] - values[0]
        end = int(gaps[1] * max(spans[0], 1e-300) > gaps[0] * max(spans[1], 1e-300))
        value, count = (values[-1], counts[-1]) if end else (values[0], counts[0])
        apart = gaps[end] / max(spans[end], 1e-300)
        outside = (value > 0) == bool(end)  # 99999 Pa below all others is a pressure
        if not (
            (_usual_mark(value) and outside and apart >= APART)
            or (_absurd(value, count, column) and apart >= FAR_APART)
        ):
            break
        gone |= numbers == value
        values, counts = (values[:-1], counts[:-1]) if end else (values[1:], counts[1:])
    return gone


def _usual_mark(value: float) -> bool:
    """9999, -999, 99999.9 and their like, or a converter's full scale."""
    digits = f"{abs(value):.10g}".replace(".", "")
    return value in FULL_SCALES or (len(digits) >= 3 and set(digits) == {"9"} and abs(value) >= 99)


def _absurd(value: float, count: int, column: Column) -> bool:
    usual = MEASURED.get(column.kind)
    if usual is None or count < 3 or not column.plain:
        return False
    size = float(column.si(np.array([value]))[0])
    below = {"pressure": VACUUM, "length": 0.0}.get(column.kind, -np.inf)
    return abs(size) > usual.most or size < below


# ---- points and commas ---------------------------------------------------------------------------
def _signed(raw: RawTable, column: Column) -> RawTable:
    """The table with the decimal sign of a column, where it is not that of the others."""
    header = column.header
    texts = [c.strip() for c in raw.columns[header] if isinstance(c, str) and not is_empty(c)]
    if raw.decimal_given or header in raw.signs or not any("." in c or "," in c for c in texts):
        return raw
    now = raw.sign(header)
    other = "," if now == "." else "."
    can, could = (all(is_number(c, sign) for c in texts) for sign in (now, other))
    if not could or (not can and raw.decimal is None):
        return raw
    word = {".": "point", ",": "comma"}
    swapped = f"{header!r} has a decimal {word[other]}, unlike other columns"
    if not can:
        return replace(raw, signs={**raw.signs, header: other}, notes=(*raw.notes, swapped))
    # each cell reads both ways: its sign stands for decimals, or between groups of three digits
    grouped = not any(now in c for c in texts)
    fits_now, fits_other = (_fits(texts, sign, column) for sign in (now, other))
    if fits_now is False and fits_other:
        note = f"{swapped}: {texts[0]!r} would else be {numbers_of(texts[:1], now)[0][0]:g}"
        return replace(raw, signs={**raw.signs, header: other}, notes=(*raw.notes, note))
    thousands = any(c.lstrip("+-").isdigit() and 100 <= abs(int(c)) < 1000 for c in texts)
    settled = _settled(raw, header, now)
    if (grouped and (not settled or fits_now is None)) or (not grouped and thousands):
        shown = next(c for c in texts if "." in c or "," in c)
        one, two = (numbers_of([shown], sign)[0][0] for sign in (now, other))
        both = Doubt(
            f"{shown!r} in {header!r} is read as {one:g}, and could be {two:g}: say "
            f"decimal={now!r} or decimal={other!r}"
        )
        return replace(raw, notes=(*raw.notes, both))
    return raw


def _fits(texts: Sequence[str], sign: str, column: Column) -> bool | None:
    """Whether the largest number is one that rigs measure; None where the kind is not known."""
    usual = MEASURED.get(column.kind)
    if usual is None or not column.plain:
        return None
    size = float(np.max(np.abs(column.si(numbers_of(texts, sign)[0]))))
    return usual.least <= size <= usual.most


def _settled(raw: RawTable, header: str, sign: str) -> bool:
    """Whether another column can be read by this decimal sign alone."""
    other = "," if sign == "." else "."
    rest = (c for h, cells in raw.columns.items() if h != header for c in cells)
    texts = (c for c in rest if isinstance(c, str))
    return any(is_number(c, sign) and not is_number(c, other) for c in texts)


# ---- doubts --------------------------------------------------------------------------------------
def doubts_of(raw: RawTable, column: Column, si: Array) -> list[Doubt]:
    """Doubts of a column by itself: its size, and where a variable may lie."""
    usual = MEASURED.get(column.kind)
    size = float(np.max(np.abs(si), initial=0.0))
    if raw.own or column.settled or usual is None or size == 0:
        return []
    least = usual.least / (DECLARED if column.scale is not None else 1.0)
    name = SI[column.kind] if SI[column.kind] != "1" else ""
    shown = f"{column.header!r} is at most {size:.4g} {name}".rstrip() + f" ({column.reading})"
    if not least <= size <= usual.most:
        factor = 1.0 if column.scale is None else column.scale.measured.factor
        found = inside_by({column.kind: size / factor}, column.unit) if column.plain else []
        guess = f"; did you mean {' or '.join(found[:2])}?" if found else ""
        most = f"{usual.least:g} .. {usual.most:g} {name}".rstrip()
        many = f"{column.kind}s".replace("ys", "ies")
        words = f"{shown}, where {many} of such rigs reach {most}{guess}"
        return [Doubt(f"{words} {_remedy(column, found[0] if found else '...')}")]
    own = column.variable is None or column.variable.name.rpartition(".")[2] == "force"
    if column.kind == "force" and own and column.plain and float(si.max()) <= 0:
        return [Doubt(f"{shown}, and never pulls (> 0): {_turned(column, 'N')}")]
    return _beyond(column, si)


def _remedy(column: Column, likely: str) -> str:
    said = f"units={{{column.argument!r}: {column.unit!r}}} if it is so"
    if column.scale is not None:
        return f"Correct the header, or say {said}"
    return f"Say units={{{column.argument!r}: {likely!r}}}, or {said}"


def _beyond(column: Column, si: Array) -> list[Doubt]:
    """Doubts of a variable that leaves its range."""
    v = column.variable
    if v is None or not (np.isfinite(v.min) and np.isfinite(v.max) and v.max > v.min):
        return []
    edge = OUTSIDE * (v.max - v.min)
    low, high = float(si.min()), float(si.max())
    most = max(v.max + edge, MEASURED["pressure"].most if column.kind == "pressure" else -np.inf)
    if v.min - edge <= low and high <= most:
        return []
    what = (
        f"{column.header!r} runs from {v.shown(low)} to {v.shown(high)} ({column.reading}), where "
        f"{v.name} lies within {v.shown(v.min)} .. {v.shown(v.max)}: "
    )
    if not column.plain:
        return [Doubt(f"{what}check its calibration. {_remedy(column, '...')}")]
    if v.min <= -high and -low <= v.max:
        return [Doubt(what + _turned(column, v.unit))]
    factor = 1.0 if column.scale is None else column.scale.measured.factor
    sizes = {u: unit(u).factor / factor for u in MEASURED[column.kind].units if u != column.unit}
    fitting = [u for u, f in sizes.items() if v.min - edge <= f * low and f * high <= v.max + edge]
    guess = (
        f"did you mean {' or '.join(fitting[:2])}?" if fitting else "check its unit and its zero."
    )
    return [Doubt(f"{what}{guess} {_remedy(column, fitting[0] if fitting else '...')}")]


def _turned(column: Column, si: str) -> str:
    """What to say of a column that counts the other way."""
    per = "" if column.scale is not None else f" * 1 {si}"
    base = si if column.scale is None else column.scale.unit
    return (
        f"say units={{{column.argument!r}: '0 {base} - x{per}'}} if it counts the other way, "
        f"units={{{column.argument!r}: {column.unit!r}}} if it is so"
    )


def above_ambient(column: Column, si: Array, command: Array | None = None) -> list[Doubt]:
    """The doubt whether a pressure (whose ``command`` is gauge) never below ambient is absolute."""
    if column.settled or not si.size or column.shift:
        return []
    low = float(np.percentile(si, 5)) if si.size >= FEW_ROWS else float(si.min())
    if command is not None:
        above = float(np.median(si - command))
        absolute = NEAR_AMBIENT[0] < above < NEAR_AMBIENT[1] and low > 0.8 * NEAR_AMBIENT[0]
    elif si.size < FEW_ROWS and _nominal(low):
        absolute = False
    else:
        absolute = NEAR_AMBIENT[0] < low < NEAR_AMBIENT[1] and float(si.max()) > 1.5 * low
    return [_absolute(column, float(si.min()))] if absolute else []


def _absolute(column: Column, low: float) -> Doubt:
    base = column.unit.removesuffix(" abs")
    return Doubt(
        f"{column.header!r} never falls below {low / 1e5:.3g} bar: if it is absolute, say "
        f"units={{{column.argument!r}: '{base} abs'}}, else units={{{column.argument!r}: {base!r}}}"
    )


def doubts_of_table(
    columns: Mapping[str, Column], p: Array, contraction: Array, force: Array
) -> list[Doubt]:
    """Doubts of a force table's columns beside each other."""
    pulling = (force > 0.2 * force.max()) & (p > 0)
    strong = pulling & (contraction >= -0.02)
    if not np.any(strong):
        return []
    pressure, pull = columns["pressure"], columns["force"]
    strained = columns.get("contraction") or columns["length"]
    found: list[Doubt] = []
    gain = force[strong] / p[strong]
    usual, largest = float(np.median(gain)), float(gain.max())
    low, high = FORCE_PER_PRESSURE
    if max(largest / usual, usual / float(gain.min())) > MIXED:
        most = largest / usual > usual / float(gain.min())
        odd = np.nonzero(strong)[0][int(np.argmax(gain) if most else np.argmin(gain))]
        found.append(
            Doubt(
                f"{pressure.header!r} is {p[odd]:g} Pa where {pull.header!r} is {force[odd]:g} N "
                f"(row {odd + 1} of those read), which takes some {force[odd] / usual:.3g} Pa in "
                "other rows: it mixes units, or marks missing values, which missing=[...] says"
            )
        )
    elif not (pressure.settled and pull.settled) and not low <= largest <= high:
        found.append(
            Doubt(
                f"the largest force per pressure is {largest:.3g} m2, where muscles have {low:g} "
                f".. {high:g}: {pressure.header!r} ({pressure.reading}) or {pull.header!r} "
                f"({pull.reading}) is in another unit; say units={{'pressure': ..., 'force': ...}}"
            )
        )
    elif not (pressure.settled or pressure.shift):
        low = _from_zero(p, contraction, force, strong)
        found += [_absolute(pressure, low)] if low else []
    if not strained.settled and _rises(force[pulling] / p[pulling], contraction[pulling]):
        found.append(
            Doubt(
                f"the force rises with the contraction ({strained.header!r}, {strained.reading}), "
                "where every muscle's falls: lengths taken for contractions, or another sign? Say "
                "columns={'length': ...} or units={'" + strained.argument + "': ...}"
            )
        )
    return found or _out_of_order(pull, p, contraction, force)


def _out_of_order(pull: Column, p: Array, contraction: Array, force: Array) -> list[Doubt]:
    """The cell that contradicts most others: of two the one with more pressure and no more
    contraction pulls more.
    """
    if p.size > MOST_COMPARED:
        return []
    over = (p[:, None] >= p) & (contraction[:, None] <= contraction)
    wrong = over & (force > 0.2 * force.max()) & (force[:, None] < HALF * force)
    if not wrong.any():
        return []
    count = wrong.sum(axis=0) + wrong.sum(axis=1)
    odd = int(np.argmax(count))
    other = int(np.argmax(wrong[odd] | wrong[:, odd]))
    said = [
        f"{force[i]:g} N at {p[i] / 1e5:.3g} bar, {100 * contraction[i]:.3g} % (row {i + 1} of "
        "those read)"
        for i in (odd, other)
    ]
    return [
        Doubt(
            f"{pull.header!r} is {said[0]} beside {said[1]}, where a muscle pulls more with more "
            "pressure and less contraction: correct it, or say missing=[...] if it marks a missing "
            "value"
        )
    ]


def _from_zero(p: Array, contraction: Array, force: Array, strong: NDArray[np.bool_]) -> float:
    """The pressure [Pa] that is read where a muscle at its rest length does not yet pull, if that
    is near the atmosphere's (or, without such cells, one that is no round number); else 0.
    """
    resting = (np.abs(contraction) < 0.02) & (force > 0)
    if np.unique(np.round(p[resting], -2)).size >= 3:
        slope, begin = np.polyfit(p[resting], force[resting], 1)
        zero = -begin / slope if slope > 0 else 0.0
        return float(p.min()) if 0.8e5 < zero < 1.25e5 and p.min() > 0.8e5 else 0.0
    low = float(p.min())
    near = NEAR_AMBIENT[0] < low < NEAR_AMBIENT[1] and float(p.max()) > 2 * low
    return low if near and not _nominal(low) and np.any(strong) else 0.0


def _nominal(pressure: float) -> bool:
    """Whether it is a set point, 1 bar, which no sensor reads so exactly."""
    return pressure == float(f"{pressure:.1g}")


def _rises(gain: Array, contraction: Array) -> bool:
    """Whether the force per pressure rises with the contraction, by rank."""
    if gain.size < 6 or float(np.ptp(contraction)) < 0.02:
        return False
    ranks = [np.argsort(np.argsort(v)).astype(float) for v in (gain, contraction)]
    return bool(np.corrcoef(ranks[0], ranks[1])[0, 1] > 0.6)

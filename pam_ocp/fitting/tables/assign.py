"""Which column of a force table holds which quantity, and in which unit."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from ...core.calibration import AMBIENT, COUNTS, Scale, scale_of
from ...core.errors import InputError, UnknownNameError
from ...core.units import unit
from .headers import is_unit, parse_header, words_of
from .labels import LABELS
from .raw import RawTable
from .table_checks import QUANTITIES

__all__ = ["Assigned", "assigned", "require_columns"]

Assigned = dict[str, tuple[str, Scale | None]]
"""quantity: (header, scale; None where no unit was named)."""


def assigned(
    raw: RawTable,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    ambient: float = AMBIENT,
) -> Assigned:
    """Quantities of a table, from the user's words first, then from the headers.

    Raises InputError, UnknownNameError.
    """
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
    found: Assigned = {}
    for quantity, (_, names) in QUANTITIES.items():
        chosen = raw.header(quantity, names, columns)
        if chosen is not None:
            found[quantity] = (chosen, _scale(raw, quantity, chosen, units, ambient))
    return found


def _scale(
    raw: RawTable, quantity: str, header: str, units: Mapping[str, str], ambient: float
) -> Scale | None:
    """The unit that the header or the user states for a quantity; None when neither does."""
    said, wanted = raw.unit(header), units.get(quantity)
    base = unit(QUANTITIES[quantity][0])
    where = f"{raw.label}: column {header!r}"
    if wanted is None:
        if said is None:
            return None
        scale = scale_of(where, said, base, None, ambient)
        _require_kind(scale, said, quantity, header)
        return scale
    scale = scale_of(f"units[{quantity!r}]", wanted, base, said, ambient)
    if scale.formula is not None:
        return scale
    if not scale.measured.compatible(base) or wanted.lower() in COUNTS - {"1"}:
        raise InputError(
            f"units[{quantity!r}] = {wanted!r} is no unit of a {quantity}; "
            f"{_calibration(quantity, wanted)}"
        )
    if said is not None and is_unit(said) and _contradicts(said, scale, base):
        raise InputError(
            f"column {header!r} says {said} but units[{quantity!r}] = {wanted!r}; "
            "correct the header or leave units away"
        )
    return scale


def _contradicts(said: str, scale: Scale, base: Any) -> bool:
    """A header's unit is another one; that a pressure is absolute, the user may add."""
    measured = scale_of("", said, None, None).measured
    return bool(measured.compatible(base)) and (
        measured.factor != scale.measured.factor or (said.endswith(" abs") and not scale.shift)
    )


def _require_kind(scale: Scale, said: str, quantity: str, header: str) -> None:
    base = unit(QUANTITIES[quantity][0])
    if scale.measured.compatible(base) and (said.lower() not in COUNTS or said == "1"):
        return
    raise InputError(
        f"column {header!r} names the unit {said}, which is none of a {quantity} "
        f"(such as {base.name}); correct the header or {_calibration(quantity, said)}"
    )


def _calibration(quantity: str, said: str) -> str:
    shown = {"pressure": "bar", "force": "N", "length": "mm", "contraction": "%"}[quantity]
    return f"give a calibration: units={{{quantity!r}: '{said} * 2 {shown}/{said} - 0.3 {shown}'}}"


def require_columns(raw: RawTable, found: Mapping[str, Any]) -> None:
    """Raises InputError for a quantity that no column holds."""
    missing = [q for q in ("pressure", "force") if q not in found]
    if "length" not in found and "contraction" not in found:
        missing.append("length")
    if not missing:
        return
    quantity = missing[0]
    words = "length or contraction" if quantity == "length" else quantity
    example = {"pressure": "pressure_Pa", "force": "force_N", "length": "length_m"}[quantity]
    taken = {header for header, _ in found.values()}
    near = _near_headers(quantity, [h for h in raw.columns if h not in taken], raw)
    hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    shown = repr(near[0]) if near else "..."
    moved = bool(near) and parse_header(near[0])[0] in _DISPLACEMENTS
    less = ", units={'length': '300 mm - x'} (the rest length less what it moved)" if moved else ""
    same = " or constants={'contraction': '5 %'} where it is the same in all rows (from "
    same += "the file's name: pattern='..._{contraction [%]}pct.csv')"
    constant = same if quantity == "length" and not near else ""
    raise InputError(
        f"{raw.label} has no column for the {words} among {', '.join(map(repr, raw.columns))}: "
        f"{hint}Name it {example!r} or give columns={{{quantity!r}: {shown}}}{less}{constant}"
    )


_DISPLACEMENTS = words_of(
    "displacement, stroke, travel, shortening, hub, weg, verschiebung, course, carrera, corsa"
)


def _near_headers(quantity: str, headers: Iterable[str], raw: RawTable) -> list[str]:
    """Headers that are spelled nearly so, or else those in a unit of the quantity."""
    headers = list(headers)
    plain = {parse_header(h)[0]: h for h in headers}
    wanted = [quantity, "contraction"] if quantity == "length" else [quantity]
    near = [m for w in wanted for m in difflib.get_close_matches(w, plain, n=2, cutoff=0.6)]
    if near:
        return [plain[m] for m in near]
    bases = [unit(QUANTITIES[w][0]) for w in wanted if w != "contraction"]
    found = []
    for header in headers:
        said = raw.unit(header)
        if said is None or not is_unit(said) or said.lower() in COUNTS:
            continue
        if any(scale_of("", said, None, None).measured.compatible(b) for b in bases):
            found.append(header)
    return found[:3]

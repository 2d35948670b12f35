"""Cyclic and mirrored motions: which states close, and what a mirror image says by itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ...core.errors import InputError
from ...judge.statement import Cyclic, Stop
from ...plants.plant import Plant
from ...plants.stillness import totals
from .limits import range_of
from .problem import Condition

__all__ = ["closing_states", "not_implied"]


def closing_states(plant: Plant, cyclic: Cyclic) -> dict[str, tuple[float, str]] | None:
    if cyclic is False or cyclic is None:
        return None
    sums = totals(plant)  # what only adds up never comes back
    if cyclic is True:
        return {v.name: (1.0, v.name) for v in plant.states if v.name not in sums}
    if cyclic != "mirrored":
        raise InputError(f"cyclic = {cyclic!r}: choose True, False or 'mirrored'")
    mirror = plant.mirror_map
    if not mirror:
        raise InputError(
            f"cyclic = 'mirrored': plant {plant.name!r} declares no mirror symmetry "
            "(unequal muscles have none); use cyclic=True"
        )
    return {v.name: mirror.get(v.name, (1.0, v.name)) for v in plant.states if v.name not in sums}


def not_implied(
    plant: Plant,
    stops: Sequence[Stop],
    last: tuple[Condition, ...],
    closing: Mapping[str, tuple[float, str]],
) -> tuple[Condition, ...]:
    """Of a mirrored motion's last node: what the first node's image does not say already."""
    if len(stops) != 2:
        raise InputError("cyclic = 'mirrored' takes two stops: the start and its mirror image")
    first = {n: range_of(n, v, plant.variable(n)) for n, v in stops[0].values.items()}
    kept = []
    for condition, name in zip(last, stops[1].values, strict=False):  # rest follows by symmetry
        sign, image = closing.get(name, (1.0, name))
        if image not in first:
            kept.append(condition)
            continue
        low, high = sorted(sign * v for v in first[image])
        if max(abs(condition.low - low), abs(condition.high - high)) > 1e-9 * condition.nominal:
            raise InputError(
                f"cyclic = 'mirrored': {condition.label} = {condition.shown.shown(condition.low)} "
                f"is not the mirror image of stop 1, {condition.shown.shown(low)}; use cyclic=True"
            )
    return tuple(kept)

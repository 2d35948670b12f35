"""Rows of a form for what a registry knows: a plant's arguments and components, as signatures say.

Nothing is listed here: a new plant, feed, loss or load shows its own arguments with their units.
A component is a mapping with its ``kind``, as a [plant] table has it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from ..core.errors import InputError
from ..core.quantities import quantity
from ..core.registry import Argument, Registry, registry_of
from ..core.units import display_unit
from ..core.units import unit as unit_of
from .elements import Menu, Number, Part, Row, Text, Tick, buttons, parts_of

Change = Callable[[str, Any], None]
SEVERAL = ("losses", "loads")
"""Arguments that take several components."""
LEFT_OUT = ("muscle", "muscle2", "name", "totals", "moment_arm2", "limits")
"""Arguments of plants that have a place of their own on the page, or none."""


def argument_rows(
    registry: Registry[Any], kind: str, content: Mapping[str, Any], change: Change, *, turning: bool
) -> list[Row]:
    """Rows for each argument of ``kind``; change(name, value) with None for "not given".

    turning : of two units that an argument may have, take that of a rotation.
    """
    left_out = LEFT_OUT if registry.noun == "plant" else ("name",)
    return [
        row
        for name, argument in registry.arguments(kind).items()
        if name not in left_out
        for row in _rows(name, argument, content.get(name), partial(change, name), turning)
    ]


def _rows(
    name: str, argument: Argument, value: Any, act: Callable[[Any], None], turning: bool
) -> list[Row]:
    kinds, default = registry_of(name), argument.default
    label = name.replace("_", " ")
    if kinds is not None and name in SEVERAL:
        return _components(label, kinds, list(value or ()), act, turning)
    if kinds is not None:
        return _component(label, kinds, value, act, turning)
    shown = default if value is None else value
    if isinstance(default, bool):
        return [(Tick(label), bool(shown), act)]
    if argument.units:
        unit = argument.units[-1 if turning and len(argument.units) > 1 else 0]
        if isinstance(default, tuple):
            return [_list(label, shown, unit, act)]
        given = isinstance(default, int | float)
        if isinstance(shown, int | float):
            return [(Number(label, unit, optional=not given), shown, act)]
        return [(Number(label, unit, optional=not given), None, act)] if value is None else []
    if isinstance(default, int | str):
        return [(Text(label), shown, lambda text: act(_like(default, text)))]
    return []


def _list(words: str, values: Sequence[float], unit: str, act: Callable[[Any], None]) -> Row:
    """Several numbers of one unit, between commas."""
    shown = display_unit(unit)
    factor = unit_of(shown).factor
    text = ", ".join(f"{v / factor:.6g}" for v in values)

    def said(typed: str) -> None:
        parts = parts_of(typed)
        if not parts:
            raise InputError(f"{words} is empty; give numbers between commas")
        act([quantity(words, p, unit) * (factor if _plain(p) else 1.0) for p in parts])

    return Text(f"{words} [{shown}]" if shown != "1" else words, "between commas"), text, said


def _plain(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _like(default: Any, text: str) -> Any:
    if isinstance(default, int):
        try:
            return int(text)
        except ValueError:
            raise InputError(f"{text[:40]!r} is no whole number; give one") from None
    return text


# ---- components ----------------------------------------------------------------------------------
def _component(
    words: str, kinds: Registry[Any], value: Any, act: Callable[[Any], None], turning: bool
) -> list[Row]:
    """One component: its kind in a menu, and its fields below."""
    now = value.get("kind") if isinstance(value, Mapping) else None
    options = {"": "default"} | {k: k for k in kinds}

    def chosen(kind: str) -> None:
        act(_begun(kinds, kind, turning) if kind else None)

    menu = (Menu(words, options), now, chosen)
    if not now:
        return [menu]
    inside = argument_rows(kinds, now, value, partial(_changed, value, act), turning=turning)
    return [menu, (Part(words), inside, None)]


def _components(
    words: str,
    kinds: Registry[Any],
    values: list[Any],
    act: Callable[[Any], None],
    turning: bool,
) -> list[Row]:
    """Several components, each with a button that takes it out, and a menu that adds one."""

    def replaced(i: int, fresh: Any) -> None:
        rest = [*values[:i], *([] if fresh is None else [fresh]), *values[i + 1 :]]
        act(rest or None)

    def added(kind: str) -> None:
        if kind:
            act([*values, _begun(kinds, kind, turning)])

    rows: list[Row] = []
    for i, value in enumerate(values):
        kind = value["kind"]
        out = buttons(
            {"Remove": partial(replaced, i, None)},
            names={"Remove": f"Remove {kind}"},
            strong=kind,
            hint=kinds.words(kind),
        )
        change = partial(_changed, value, partial(replaced, i))
        inside = argument_rows(kinds, kind, value, change, turning=turning)
        rows.append((Part(f"{words} {i}"), [out, *inside], None))
    return [*rows, (Menu(f"{words}: add", {"": "choose ..."} | {k: k for k in kinds}), "", added)]


def _changed(content: Mapping[str, Any], act: Callable[[Any], None], name: str, value: Any) -> None:
    fresh = {k: v for k, v in content.items() if k != name}
    act(fresh if value is None else {**fresh, name: value})


def _begun(kinds: Registry[Any], kind: str, turning: bool) -> dict[str, Any]:
    """A component with what must be given: of each such argument one unit as people read it."""
    content: dict[str, Any] = {"kind": kind}
    for name, argument in kinds.arguments(kind).items():
        if argument.default is inspect.Parameter.empty:
            inner = registry_of(name)
            if inner is not None:
                content[name] = _begun(inner, next(iter(inner)), turning)
            elif argument.units:
                unit = argument.units[-1 if turning and len(argument.units) > 1 else 0]
                content[name] = unit_of(display_unit(unit)).factor
    return content

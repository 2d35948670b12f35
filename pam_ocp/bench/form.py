"""Fields for what a registry knows: a plant's arguments and components, read off their signatures.

Nothing is listed here: a new plant, feed, loss or load shows its own arguments with their units.
A component is a mapping with its ``kind``, as a [plant] table has it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from nicegui import ui

from ..core.errors import InputError
from ..core.quantities import quantity
from ..core.registry import Argument, Registry, registry_of
from ..core.units import display_unit
from ..core.units import unit as unit_of
from . import elements as el

__all__ = ["argument_fields"]

Change = Callable[[str, Any], None]
SEVERAL = ("losses", "loads")
"""Arguments that take several components."""
LEFT_OUT = ("muscle", "muscle2", "name", "totals", "moment_arm2", "limits")
"""Arguments of plants that have a place of their own on the page, or none."""


def argument_fields(
    registry: Registry[Any], kind: str, content: Mapping[str, Any], change: Change, *, turning: bool
) -> None:
    """A field for each argument of ``kind``; change(name, value) with None for "not given".

    turning : of two units that an argument may have, take that of a rotation.
    """
    for name, argument in registry.arguments(kind).items():
        if name in LEFT_OUT and registry.noun == "plant":
            continue
        if name == "name":
            continue
        _field(name, argument, content.get(name), partial(change, name), turning)


def _field(
    name: str, argument: Argument, value: Any, act: Callable[[Any], None], turning: bool
) -> None:
    kinds = registry_of(name)
    words = name.replace("_", " ")
    if kinds is not None and name in SEVERAL:
        _components(words, kinds, list(value or ()), act, turning)
    elif kinds is not None:
        _component(words, kinds, value, act, turning)
    elif isinstance(argument.default, bool):
        el.check(words, bool(argument.default if value is None else value), act)
    elif argument.units:
        unit = argument.units[-1 if turning and len(argument.units) > 1 else 0]
        _quantity(words, argument, value, unit, act)
    elif isinstance(argument.default, int | str):
        shown = argument.default if value is None else value
        el.text_field(words, str(shown), lambda text: act(_like(argument.default, text)))


def _quantity(
    words: str, argument: Argument, value: Any, unit: str, act: Callable[[Any], None]
) -> None:
    default = argument.default
    if isinstance(default, tuple):
        _list(words, default if value is None else value, unit, act)
        return
    usual = default if isinstance(default, int | float) and not isinstance(default, bool) else None
    shown = usual if value is None else value
    if isinstance(shown, int | float) or shown is None:
        el.Field(words, shown, unit, act, optional=usual is None)


def _list(words: str, values: Sequence[float], unit: str, act: Callable[[Any], None]) -> None:
    """Several numbers of one unit, between commas."""
    shown = display_unit(unit)
    factor = unit_of(shown).factor
    text = ", ".join(f"{v / factor:.6g}" for v in values)

    def said(typed: str) -> None:
        parts = [p.strip() for p in typed.split(",") if p.strip()]
        if not parts:
            raise InputError(f"{words} is empty; give numbers between commas")
        act([quantity(words, f"{p} {shown}" if _plain(p) else p, unit) for p in parts])

    el.text_field(f"{words} [{shown}]" if shown != "1" else words, text, said, "between commas")


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
) -> None:
    """One component: its kind in a menu, and its fields below."""
    now = value.get("kind") if isinstance(value, Mapping) else None
    options = {"": "default"} | {k: k for k in kinds}

    def chosen(kind: str) -> None:
        act(_begun(kinds, kind, turning) if kind else None)

    el.choice(words, options, now or "", chosen, kinds.words(now) if now else "")
    if now:
        with ui.element("div").classes("bench-component"):
            argument_fields(kinds, now, value, partial(_changed, value, act), turning=turning)


def _components(
    words: str,
    kinds: Registry[Any],
    values: list[Any],
    act: Callable[[Any], None],
    turning: bool,
) -> None:
    """Several components, each with a button that takes it out, and a menu that adds one."""

    def replaced(i: int, fresh: Any) -> None:
        rest = [*values[:i], *([] if fresh is None else [fresh]), *values[i + 1 :]]
        act(rest or None)

    def added(kind: str) -> None:
        if kind:
            act([*values, _begun(kinds, kind, turning)])

    for i, value in enumerate(values):
        with ui.element("div").classes("bench-component"):
            with ui.element("div").classes("bench-row"):
                el.tag("strong", value["kind"], title=kinds.words(value["kind"]))
                el.button(
                    "Remove", partial(replaced, i, None), aria_label=f"Remove {value['kind']}"
                )
            change = partial(_changed, value, partial(replaced, i))
            argument_fields(kinds, value["kind"], value, change, turning=turning)
    el.choice(f"{words}: add", {"": "choose ..."} | {k: k for k in kinds}, "", added)


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

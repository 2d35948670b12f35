"""What was done on the page as a Python script of public verbs: made of the state alone.

Whoever runs it in the session's folder gets the figures of the page: numbers are written with all
their digits. Each tab says its own lines (``Tab.lines``); those of data, muscle and plant are here,
so that they can be tested without a page. No text of a user or a file stands in the script but as a
quoted literal, or as a comment on one line.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from ..core.registry import Registry, registry_of
from ..muscles.laws.user_defined import law_named
from ..plants.kinds import PLANTS

__all__ = ["HEAD", "call", "data_lines", "literal", "muscle_lines", "plant_lines", "script_of"]

HEAD = '''"""Repeats a session of pam-ocp bench; run it in the folder that holds "files"."""

import dataclasses

import numpy as np

import pam_ocp as pam
'''
ROOMS = ("feeds", "losses", "loads", "plants", "gas", "muscles")
"""Where the script looks for components: pam.feeds.Regulator."""


def script_of(parts: Iterable[Sequence[str]]) -> str:
    """The script: what each tab has to say, in the order of the tabs."""
    blocks = ["\n".join(lines) for lines in parts if lines]
    text = "\n\n".join(blocks)
    imports = {"dataclasses": "dataclasses.", "numpy as np": "np."}
    head = HEAD
    for name, used in imports.items():
        if used not in text:
            head = head.replace(f"import {name}\n\n", "")
    return f"{head}\n{text}\n"


def literal(value: Any) -> str:
    """A value as Python; lists of numbers as they are."""
    return repr(value)


def call(function: str, *args: str, **keywords: Any) -> str:
    """``pam.verb(table, name=value)``; arguments are code, keywords values. None is left out."""
    said = [*args, *(f"{k}={literal(v)}" for k, v in keywords.items() if v is not None)]
    return f"{function}({', '.join(said)})"


# ---- data ----------------------------------------------------------------------------------------
def data_lines(state: Mapping[str, Any]) -> list[str]:
    """The chosen table, without the cells that are switched off; records by their names."""
    lines = []
    fitted = state["muscle"] is not None and state["muscle"]["kind"] == "fit"
    data = [d for d in state["data"] if d.get("is") == "record" or d["id"] == state["chosen"]]
    if fitted:  # the table that was fitted, whatever has been chosen since
        table = state["muscle"]["table"]
        data = [d for d in data if d.get("is") == "record"] + [table]
    for item in data:
        source = item["bundled"] if "bundled" in item else f"files/{item['file']}"
        said = {k: v for k, v in item["said"].items() if k != "kind"}
        if item.get("is") == "record":
            lines += [
                f"# {_comment(item['name'])}",
                f"{item['id']} = {call('pam.read_records', literal(source), **said)}",
            ]
        else:
            lines += [f"# {_comment(item['name'])}"]
            lines += [f"table = {call('pam.read_table', literal(source), **said)}"]
            if item.get("off"):
                lines += [
                    f"off = {literal(sorted(item['off']))}  # cells that are switched off",
                    "table = table.subset([i not in off for i in range(len(table))])",
                ]
    return lines


def _comment(text: str) -> str:
    """On one line."""
    return "".join(c if c.isprintable() else " " for c in str(text))[:100]


# ---- the muscle ----------------------------------------------------------------------------------
def muscle_lines(state: Mapping[str, Any]) -> list[str]:
    """The muscle: of the catalogue, a file, or the fit, with what sliders changed."""
    said = state["muscle"]
    if said is None:
        return []
    if said["kind"] == "catalogue":
        made = call("pam.muscle", literal(said["name"]), rest_length=said.get("rest_length"))
        return [f"muscle = {made}"]
    if said["kind"] == "file":
        return [f"muscle = pam.load_muscle({literal('files/' + said['file'])})"]
    law, fixed = said["law"], said.get("fixed") or None
    kept = {n: said[n] for n in ("rest_length", "diameter", "name", "source")}
    lines = [
        f"fit = {call('pam.fit_force', 'table', literal(law), fixed=fixed)}",
        "print(fit.report())",
        f"muscle = {call('fit.muscle', **kept)}",
    ]
    if said.get("moved"):
        kind = law_named(law)
        named = call("type(fit.law)", **said["coefficients"])
        lines += [f"# coefficients of the {kind.title}, moved by hand"]
        lines += [f"muscle = dataclasses.replace(muscle, law={named})"]
    return lines


# ---- the plant -----------------------------------------------------------------------------------
def plant_lines(state: Mapping[str, Any]) -> list[str]:
    """The plant, and its operating point."""
    if state["muscle"] is None:
        return []
    content = dict(state["plant"])
    name = content.pop("arrangement")
    values = content.pop("set", {})
    sensors = content.pop("sensors", {})
    if ":" in name:
        return [
            f"# the plant {_comment(name)} is code of your own: import it, and call it with muscle"
        ]
    said = {k: _argument(k, v, PLANTS, name) for k, v in content.items()}
    lines = [f"plant = {_written(f'pam.{name}', ['muscle'], said)}"]
    for sensed, sensor in sensors.items():
        lines += [f"plant.add_sensor({literal(sensed)}, {_component('sensors', sensor)})"]
    if values:
        lines += [f"plant = plant.with_values({literal(values)})"]
    if state["point"]:
        lines += [f"point = pam.equilibrium(plant, {literal(state['point'])})", "print(point)"]
    return lines


def _written(function: str, first: Sequence[str], said: Mapping[str, str]) -> str:
    return f"{function}({', '.join([*first, *(f'{k}={v}' for k, v in said.items())])})"


def _argument(name: str, value: Any, registry: Registry[Any], owner: str) -> str:
    """A value of a [plant] table as code."""
    if isinstance(value, Mapping):
        return _component(name, value)
    if isinstance(value, list) and registry_of(name) is not None:
        inside = ", ".join(_component(name, one) for one in value)
        return f"({inside}{',' if len(value) == 1 else ''})"
    return literal(tuple(value) if isinstance(value, list) else value)


def _component(argument: str, content: Mapping[str, Any]) -> str:
    import pam_ocp as pam

    kinds = registry_of(argument)
    assert kinds is not None
    given = dict(content)
    kind = kinds.name(argument, given.pop("kind", kinds.default or next(iter(kinds))))
    room = next(r for r in ROOMS if hasattr(getattr(pam, r), kind))
    said = {k: _argument(k, v, kinds, kind) for k, v in given.items()}
    return _written(f"pam.{room}.{kind}", [], said)

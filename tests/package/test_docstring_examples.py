"""Every public callable shows an example, and all of them run and print what they say."""

import ast
import dataclasses
import doctest
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

import pam_ocp as pam

PAGE = Path(__file__).parents[2] / "docs" / "reference.md"


def _rooms() -> dict[str, ModuleType]:
    """{name: room}; the rooms of rooms, too."""
    found, open_ends = {"pam": pam}, [("pam", pam)]
    while open_ends:
        title, room = open_ends.pop()
        for name in room.__all__:
            inner = getattr(room, name)
            if inspect.ismodule(inner) and inner not in found.values():
                found[f"{title}.{name}"] = inner
                open_ends.append((f"{title}.{name}", inner))
    return found


def _callables() -> dict[str, dict[str, Any]]:
    """{room: {name: public callable}}, each once, in its own room."""
    found: dict[str, dict[str, Any]] = {}
    seen: set[int] = set()
    for title, room in sorted(_rooms().items(), key=lambda item: -item[0].count(".")):
        things = {n: getattr(room, n) for n in room.__all__}
        own = {
            n: o
            for n, o in things.items()
            if (inspect.isclass(o) or inspect.isroutine(o)) and id(o) not in seen
        }
        seen |= {id(o) for o in own.values()}
        found[title] = own
    return found


ROOMS = _callables()
(CODE,) = re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.S)
MADE_BY = {
    node.targets[0].id: node
    for node in ast.parse(CODE).body
    if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
}
MADE: dict[str, Any] = {}


def known(tree: ast.AST) -> dict[str, Any]:
    """What the page's block makes of the names that a piece of code speaks of."""
    names: dict[str, Any] = {}
    exec("import numpy as np\nimport pam_ocp as pam", names)
    spoken = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
    for name in spoken & set(MADE_BY):
        if name not in MADE:
            node = MADE_BY[name]
            inner = known(node.value)
            exec(compile(ast.Module([node], []), str(PAGE), "exec"), inner)
            MADE[name] = inner[name]
        names[name] = MADE[name]
    return names


def examples(thing: Callable[..., Any]) -> list[doctest.Example]:
    return doctest.DocTestParser().get_examples(inspect.getdoc(thing) or "")


@pytest.mark.parametrize("room", ROOMS)
def test_every_public_callable_shows_an_example(room):
    assert [name for name, thing in ROOMS[room].items() if not examples(thing)] == []
    assert (_rooms()[room].__doc__ or "").strip()


@pytest.mark.parametrize("room", ROOMS)
def test_what_holds_arrays_is_compared_by_identity(room):
    """By value, == and ``in`` raise NumPy's "truth value of an array", and nothing is a key."""
    by_value = [
        name
        for name, thing in ROOMS[room].items()
        if dataclasses.is_dataclass(thing)
        and thing.__dataclass_params__.eq
        and any("Array" in str(f.type) for f in dataclasses.fields(thing) if f.compare)
    ]
    assert by_value == []


LONG = {"pam", *(f"pam.{n}" for n in ("control", "export", "fitting", "planning", "studies"))}


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize(
    "room", [pytest.param(r, marks=pytest.mark.slow) if r in LONG else r for r in ROOMS]
)
def test_the_examples_of_a_room_print_what_they_say(room, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    report: list[str] = []
    for name, thing in ROOMS[room].items():
        source = examples(thing)
        names = known(ast.parse("".join(e.source for e in source)))
        test = doctest.DocTest(source, names, f"{room}.{name}", None, 0, None)
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test, out=report.append)
    assert not report, "".join(report)


def test_rooms_are_found():
    assert {"pam", "pam.control", "pam.laws", "pam.experiments"} <= set(ROOMS)
    assert sum(map(len, ROOMS.values())) > 250

"""Arrows between rooms run down only; one module is the door upwards, and its use is narrow."""

import ast
import importlib
import importlib.util
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

import pytest

import pam_ocp

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "pam_ocp"


def _loaded(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@cache
def _trees() -> dict[str, ast.Module]:
    """{file below pam_ocp that speaks of the door: its syntax}."""
    return {
        path.relative_to(PACKAGE).as_posix(): ast.parse(text)
        for path in PACKAGE.rglob("*.py")
        if "courtesy" in (text := path.read_text("utf-8")) or path.name == "courtesy.py"
    }


drawing = _loaded(ROOT / "docs" / "rooms.py")


@cache  # not when tests are collected
def _behind() -> dict[str, set[str]]:
    found: dict[str, set[str]] = drawing.behind_the_door(drawing.arrows(PACKAGE))
    return found


def test_the_contracts_of_pyproject_are_kept():
    linter = (
        "from importlinter.cli import lint_imports as run; raise SystemExit(run(no_cache=True))"
    )
    done = subprocess.run(
        [sys.executable, "-c", linter], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 broken" in done.stdout


@pytest.mark.slow
def test_no_module_leads_back_to_itself_but_through_the_door():
    assert drawing.circles(_behind()) == []


def test_no_room_leads_back_to_itself():
    assert drawing.circles(drawing.rooms(_behind())) == []


@pytest.mark.parametrize(
    "back",
    [
        "import house.low.one",
        "from house.low import one",
        "from ..low.one import name",
        "from .. import low",
        "def late():\n    from ..low import one",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..low.one import Name",
    ],
)
def test_a_circle_is_seen_however_it_is_written(tmp_path, back):
    for name, text in {
        "__init__": "",
        "low/__init__": "from .one import name",
        "low/one": "from ..high import two",
        "high/__init__": "",
        "high/two": back,
    }.items():
        path = tmp_path / "house" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, "utf-8")
    (circle,) = drawing.circles(drawing.arrows(tmp_path / "house"))
    assert {"house.low.one", "house.high.two"} <= set(circle)


def test_all_that_two_circles_share_is_one_group():
    assert drawing.circles({"a": {"b"}, "b": {"c", "d"}, "c": {"a"}, "d": {"b"}, "e": {"a"}}) == [
        ["a", "b", "c", "d"]
    ]


def test_the_picture_of_the_rooms_is_drawn_from_the_imports():
    text = drawing.PAGE.read_text("utf-8")
    drawn = drawing.drawn(drawing.rooms(_behind()))
    assert drawing.page(text, drawn) == text, "run `python docs/rooms.py`"


def test_the_site_draws_the_arrows_of_the_page_downwards():
    graph = {"a": {"b", "c", "d"}, "b": {"d"}, "c": {"d"}, "d": set()}
    made = drawing.drawing(graph)
    ends = re.findall(r'"M([\d.]+) ([\d.]+)C.* ([\d.]+) ([\d.]+)"/>', made)
    at = {n: (x, float(y)) for x, y, n in re.findall(r'<text x="([\d.]+)" y="([\d.]+)">(\w)', made)}
    under = {
        (a, b)
        for x, y, u, v in ends
        for a in at
        for b in at
        if (at[a][0], at[b][0]) == (x, u) and at[a][1] < float(y) + 5 <= float(v) + 5 < at[b][1]
    }
    assert {("a", "b"), ("a", "c"), ("b", "d"), ("c", "d")} <= under
    assert len(ends) == 4  # a over d follows from others


def test_modules_are_named_in_strings_only_where_names_load_lazily_and_by_what_serves_others():
    """Such arrows are not seen: a name that is loaded lazily, a registry's room, a child's work."""
    named = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if re.search(r"\b(import_module|__import__)\(", path.read_text("utf-8"))
    }
    assert named <= {
        "core/digest.py",  # modules of the user's
        "core/foreign.py",
        "core/lazy.py",
        "core/registry.py",
        "export/isolation.py",
        "rig/watchdog_server.py",  # what vents by a library of its own
    }


# ---- the door ------------------------------------------------------------------------------------
def _doors_names() -> dict[str, str]:
    """{name: module below pam_ocp} of what the door imports for types."""
    return {
        alias.name: node.module
        for node in ast.walk(_trees()["courtesy.py"])
        if isinstance(node, ast.ImportFrom) and node.level and node.module != "core.lazy"
        for alias in node.names
    }


@cache
def _uses() -> list[tuple[str, str, bool]]:
    """(module, name, whether a method's last statement returns a call of it) of courtesy.NAME."""
    found = []
    for file, tree in _trees().items():
        forwarded, used = set(), []
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                for method in (n for n in node.body if isinstance(n, ast.FunctionDef)):
                    if isinstance(last := method.body[-1], ast.Return):
                        forwarded |= {id(getattr(last.value, "func", None))}
            elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "courtesy":
                used.append(node)
        found += [(file, node.attr, id(node) in forwarded) for node in used]
    return found


def test_only_methods_go_through_the_door_and_only_to_return_what_is_found_there():
    assert [use for use in _uses() if not use[2]] == []


def test_the_door_leads_to_what_its_types_say_and_to_nothing_that_is_not_used():
    from pam_ocp import courtesy

    used = {name for _, name, _ in _uses()}
    assert {n: m for n, m in _doors_names().items() if n in used} == courtesy._HOMES
    for name, home in courtesy._HOMES.items():
        assert getattr(courtesy, name).__module__ == f"pam_ocp.{home}"


def test_what_else_the_door_names_is_named_in_annotations_only():
    types = set(_doors_names()) - {name for _, name, _ in _uses()}
    for_types, imported = [], []
    for tree in _trees().values():
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module == "courtesy":
                imported += [a.name for a in node.names]
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
                inside = (n for n in node.body if isinstance(n, ast.ImportFrom))
                for_types += [a.name for n in inside if n.module == "courtesy" for a in n.names]
    assert sorted(imported) == sorted(for_types)
    assert types == set(imported)


# ---- what an import loads ------------------------------------------------------------------------
def printed(code: str) -> set[str]:
    """The words that a process of its own prints."""
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "name",
    ["pam_ocp", "pam_ocp.courtesy", "pam_ocp.export", "pam_ocp.fitting", "pam_ocp.vibration"],
)
def test_an_import_loads_names_only_when_they_are_used(name):
    """No stopwatch: what is not loaded takes no time."""
    code = (
        f"import sys; before = set(sys.modules); import {name};print(*sorted(m for m in "
        "set(sys.modules) - before if m.split('.')[0] in {'pam_ocp', 'casadi', 'numpy', 'scipy', "
        "'matplotlib', 'control', 'fmpy', 'pandas'}))"
    )
    # the guard against Ctrl-C while a module is loaded must be there before the first one is
    face = {"pam_ocp", "pam_ocp.core", "pam_ocp.core.interrupts", "pam_ocp.core.lazy"}
    assert printed(code) == {*face, name}


def test_a_first_plan_loads_nothing_that_it_does_not_use():
    """Files, other laws, re-solves, arcs, other processes and random numbers are for others; SciPy
    alone takes as long as a plan; plotting, tables and python-control have no part.
    """
    code = (
        "import sys, pam_ocp as pam; muscle = pam.muscle('DMSP-20-200N'); "
        "slide = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.1); "
        "assert pam.plan(slide, [{'x': -0.01}, {'x': 0.01}]).verified; print(*sys.modules)"
    )
    unused = ("planning.problem.problem_file", "planning.solvers.newton", "plants.plant_file")
    unused += ("planning.arcs_search", "core.workers")
    loaded = printed(code)
    assert "pam_ocp.planning.planner" in loaded
    assert not loaded & {"matplotlib", "pandas", "control", "scipy", "fmpy", "multiprocessing"}
    assert not loaded & {"numpy.random", "secrets", *(f"pam_ocp.{name}" for name in unused)}


def test_a_name_that_a_module_does_not_have_is_an_attribute_error():
    import pam_ocp.fitting

    with pytest.raises(AttributeError, match=r"'pam_ocp\.fitting' has no attribute 'fit_frce'"):
        _ = pam_ocp.fitting.fit_frce
    assert {"fit_force", "ForceTable"} <= set(dir(pam_ocp.fitting))


FACES = sorted(p.parent.relative_to(ROOT).as_posix() for p in PACKAGE.rglob("__init__.pyi"))


@pytest.mark.parametrize("folder", FACES)
def test_a_stub_names_what_its_package_loads_and_where_each_is_defined(folder):
    package = importlib.import_module(folder.replace("/", "."))
    named = set(package.__all__)
    for node in ast.parse((ROOT / folder / "__init__.pyi").read_text("utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            assert all(alias.asname == alias.name for alias in node.names)
            for alias in node.names:
                value = getattr(package, alias.name)
                home = getattr(value, "__module__", None) if callable(value) else None
                stands = importlib.util.resolve_name(
                    "." * node.level + (node.module or ""), package.__name__
                )
                assert home in (None, stands) or not home.startswith("pam_ocp"), alias.name
                named.discard(alias.name)
    assert not named


def test_the_face_has_about_sixty_names_and_each_of_them_stands_in_no_second_room():
    rooms = {name for name in pam_ocp.__all__ if isinstance(getattr(pam_ocp, name), ModuleType)}
    assert 50 <= len(set(pam_ocp.__all__) - rooms) <= 60
    for name in set(pam_ocp.__all__) - rooms:
        for room in rooms:
            own = getattr(pam_ocp, room)
            if (room, name) == ("datasets", "load"):  # by the name of a set, not of a file
                continue
            if name in getattr(own, "__all__", ()):
                assert getattr(own, name) is getattr(pam_ocp, name)

"""Registries: entering, finding and refusing names; modules of a room that find themselves."""

import inspect
import subprocess
import sys
import textwrap

import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.core.errors import UnknownNameError
from pam_ocp.core.registry import Registry, registries, registry_of


@pytest.fixture
def gears(tmp_path, monkeypatch):
    """A registry of a room with two files, neither of which is mentioned anywhere."""
    room = tmp_path / "gear_room"
    (room / "inner").mkdir(parents=True)
    (room / "__init__.py").write_text("")
    (room / "inner" / "__init__.py").write_text("")
    (room / "old_server.py").write_text("raise RuntimeError('a script of another process')")
    entry = """
        from pam_ocp.core.registry import registries
        (gears,) = (r for r in registries() if r.noun == "gear")
        @gears.register(units={{"ratio": "1", "radius": ("m", "mm")}})
        class {name}:
            '''{name} gear. Further words.'''
            def __init__(self, ratio: float, radius=0.1, label: str = "", count: float = 3): ...
    """
    for path, name in (("spur.py", "SpurGear"), ("inner/worm.py", "WormGear")):
        (room / path).write_text(textwrap.dedent(entry.format(name=name)))
    monkeypatch.syspath_prepend(str(tmp_path))
    registry: Registry = Registry("gear", "gear_room", argument="gear")
    yield registry
    from pam_ocp.core import registry as module

    del module._REGISTRIES["gear"]
    for name in [n for n in sys.modules if n.partition(".")[0] == "gear_room"]:
        del sys.modules[name]


def test_files_of_a_room_are_found_by_themselves(gears):
    assert list(gears) == ["SpurGear", "WormGear"]
    assert "WormGear" in gears
    assert gears.words("SpurGear") == "SpurGear gear"
    assert registry_of("gear") is gears
    assert registry_of("gears") is None


def test_a_name_that_is_known_imports_nothing_else(gears):
    gears.register("Rack")(object)
    assert "Rack" in gears
    assert gears["Rack"] is not None
    assert "gear_room.spur" not in sys.modules
    assert "SpurGear" in gears  # which is found in its file
    assert {"gear_room.spur", "gear_room.inner.worm"} <= set(sys.modules)


def test_a_name_may_be_written_in_either_way(gears):
    assert gears.find("gear", "worm_gear") is gears["WormGear"]
    assert gears.name("gear", "SpurGear") == "SpurGear"


def test_unknown_names_are_met_with_the_nearest_ones(gears):
    with pytest.raises(UnknownNameError, match=r"plant.gear 'WurmGear': did you mean 'WormGear'"):
        gears.find("plant.gear", "WurmGear")
    with pytest.raises(UnknownNameError, match=r"known: SpurGear, WormGear, FILE.py:NAME"):
        gears.find("gear", "x", "FILE.py:NAME")
    with pytest.raises(KeyError, match="unknown gear 'x'"):
        gears["x"]
    assert gears.get("x") is None


def test_arguments_come_with_units_and_defaults(gears):
    known = gears.arguments("SpurGear")
    assert list(known) == ["ratio", "radius", "label", "count"]
    assert known["ratio"].required
    assert not known["radius"].required
    units = [known[n].units for n in known]
    assert units == [("1",), ("m", "mm"), (), ("1",)]  # a float without a unit is a plain number


def test_a_name_belongs_to_one_only_until_it_is_removed(gears):
    class SpurGear:
        """Another one."""

    assert len(gears) == 2
    refused(r"registered already, by gear_room.spur.SpurGear; give", gears.register(), SpurGear)
    gears.remove("SpurGear")
    assert gears.register()(SpurGear) is gears["SpurGear"]
    assert gears.register()(SpurGear) is SpurGear  # a module that is loaded again
    gears.remove("SpurGear")
    with pytest.raises(UnknownNameError):
        gears.remove("SpurGear")


def test_units_are_told_of_arguments_that_exist():
    from pam_ocp.cli.components import groups

    for registry, _ in groups():
        for name in registry:
            strange = set(registry._units[name]) - set(registry.arguments(name))
            assert not strange, (registry.noun, name, strange)
            for argument in registry.arguments(name).values():
                if isinstance(argument.default, float):
                    assert argument.units or registry.noun in ("law", "controller", "estimator")


def test_every_component_says_what_it_is():
    from pam_ocp.cli.components import groups

    shown = [registry for registry, _ in groups()]
    assert {id(r) for r in registries()} <= {id(r) for r in shown}  # none is left out of the page
    for registry in shown:
        assert len(registry) > 0
        for name in registry:
            assert len(registry.words(name)) > 8, (registry.noun, name)
            assert inspect.getmodule(registry[name]) is not None or registry[name]


def test_names_are_known_whatever_was_imported_first():
    code = """
        from pam_ocp.{module} import {name} as registry
        print(*registry)
    """
    for module, name, expected in (
        ("muscles.law", "LAWS", "thick-wall"),
        ("plants.kinds", "FEEDS", "SpoolValve"),
        ("judge.statement", "COSTS", "exergy"),
        ("planning.solvers.solver", "SOLVERS", "ipopt"),
    ):
        text = textwrap.dedent(code.format(module=module, name=name))
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
        assert expected in done.stdout.split(), done.stderr


def test_components_take_texts_with_units_for_all_their_quantities():
    """What "0.0003 MPa" or "5 %" gives is what the number in SI gives."""
    spring = pam.loads.Spring("0.5 N/mm", rest="5 mm")
    assert (spring.stiffness, spring.rest) == (pytest.approx(500.0), pytest.approx(0.005))
    creep = pam.losses.Creep(stiffness=["0.3 kN", 200.0], time=("200 ms", 2.0))
    assert creep == pam.losses.Creep(stiffness=(300.0, 200.0), time=(0.2, 2.0))
    assert pam.feeds.SpoolValve(overlap="5 %").overlap == pytest.approx(0.05)
    assert pam.feeds.Tube(lag="20 ms").lag == pytest.approx(0.02)
    refused(r"Tube\.lag = '20 mm'.*something else", pam.feeds.Tube, lag="20 mm")

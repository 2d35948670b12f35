"""The script of a session repeats what the page shows, with all digits, for any choice."""

import ast
import random

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.bench.made import World, muscle_of, plant_of, table_of
from pam_ocp.bench.script import script_of
from pam_ocp.bench.session import EMPTY
from pam_ocp.plants.kinds import FEEDS, LOADS, LOSSES, PLANTS

CATALOGUE = {"kind": "catalogue", "name": "DMSP-20-300", "rest_length": None}


def run(state, folder, monkeypatch):
    """The names that the script leaves behind."""
    text = script_of(state)
    ast.parse(text)
    monkeypatch.chdir(folder)
    names = {}
    exec(compile(text, "session.py", "exec"), names)
    return names


def state_with(**parts):
    return {**EMPTY, **parts}


def bundled(**more):
    said = {"rest_length": 0.3}
    name = "DMSP-20-300_static.csv"
    return {"id": "data1", "name": name, "bundled": name, "said": said, "is": "table", **more}


def test_the_table_without_its_cells_that_are_off(tmp_path, monkeypatch):
    item = bundled(off=[0, 17, 40])
    names = run(state_with(data=[item], chosen="data1"), tmp_path, monkeypatch)
    own = table_of(World(tmp_path), item)
    assert len(names["table"]) == 123
    assert np.array_equal(names["table"].force, own.force)


def test_a_dropped_file_with_units_and_names_of_its_own(tmp_path, monkeypatch):
    (tmp_path / "files").mkdir()
    rows = "".join(
        f"{p},{x},{max(0, 9 * p - 2 * x)}\n" for p in (20, 60, 90) for x in range(0, 20, 4)
    )
    (tmp_path / "files" / "0-a.csv").write_text("P1,contraction [%],F\n" + rows, "utf-8")
    said = {
        "columns": {"pressure": "P1", "force": "F"},
        "units": {"pressure": "psi", "force": "lbf"},
    }
    item = {"id": "data1", "name": "my 'rig'\n# no", "file": "0-a.csv", "said": said, "off": []}
    names = run(state_with(data=[item], chosen="data1"), tmp_path, monkeypatch)
    assert np.allclose(names["table"].pressure.max(), 90 * 6894.757293168, rtol=1e-12)
    assert np.array_equal(names["table"].force, table_of(World(tmp_path), item).force)


@pytest.mark.parametrize("law", ["six-parameter", "three-element", "polynomial-1-3"])
@pytest.mark.parametrize("moved", [False, True])
def test_the_fitted_muscle_as_fitted_and_as_moved_by_hand(law, moved, tmp_path, monkeypatch):
    item = bundled(off=[3, 50])
    fit = pam.fit_force(table_of(World(tmp_path), item), law)
    fitted = {n: float(v) for n, v in fit.law.values.items()}
    free = random.choice(fit.free)
    coefficients = {**fitted, free: fitted[free] * 1.07} if moved else fitted
    table = fit.table
    muscle = {
        "kind": "fit",
        "table": item,
        "law": law,
        "fixed": {},
        "coefficients": coefficients,
        "fitted": fitted,
        "moved": moved,
        "rest_length": 0.3,
        "diameter": 0.02,
        "pressure_range": [float(table.pressure.min()), float(table.pressure.max())],
        "contraction_range": [float(table.contraction.min()), float(table.contraction.max())],
        "name": "my muscle",
        "source": "here",
    }
    state = state_with(data=[], muscle=muscle)  # the data may have been removed since
    names = run(state, tmp_path, monkeypatch)
    own = muscle_of(World(tmp_path, state))
    p, kappa = np.meshgrid(np.linspace(1e5, 6e5, 7), np.linspace(0.02, 0.25, 9))
    assert np.allclose(names["muscle"].force(p, kappa), own.force(p, kappa), rtol=1e-9, atol=1e-9)
    for name in ("rest_length", "diameter", "pressure_range", "contraction_range", "name"):
        assert getattr(names["muscle"], name) == getattr(own, name)


def some_component(rng, kinds, turning):
    """A component with a random value for about half of its plain arguments."""
    kind = rng.choice(list(kinds))
    content = {"kind": kind}
    for name, argument in kinds.arguments(kind).items():
        number = argument.default
        if argument.required and argument.units:
            content[name] = rng.uniform(1, 20)
        elif argument.units and type(number) is float and number > 0 and rng.random() < 0.5:
            content[name] = number * rng.uniform(0.9, 1.1)
    return content


@pytest.mark.parametrize("arrangement", list(PLANTS))
@pytest.mark.parametrize("draw", range(3))
def test_plants_of_random_components(arrangement, draw, tmp_path, monkeypatch):
    seed = random.randrange(10**6)
    print("seed", seed)
    rng = random.Random(seed)
    known = PLANTS.arguments(arrangement)
    losses = [k for k in LOSSES if k not in ("DirectionalDamping", "StrandFriction")]
    table = {"arrangement": arrangement, "mass": 3.0 * rng.uniform(1, 2)}
    table = {k: v for k, v in table.items() if k in known or k == "arrangement"}
    if "feed" in known and rng.random() < 0.8:
        feed = rng.choice(["IdealPressure", "Regulator", "OnOffValves", "SpoolValve"])
        table["feed"] = {"kind": feed}
        assert feed in FEEDS
    if rng.random() < 0.8:
        table["losses"] = [{"kind": k} for k in rng.sample(losses, rng.randint(1, 2))]
    if "loads" in known:
        table["loads"] = [some_component(rng, LOADS, False)]
    state = state_with(muscle={**CATALOGUE, "name": "DMSP-20-300"}, plant=table)
    own = plant_of(World(tmp_path, state))
    made = run(state, tmp_path, monkeypatch)["plant"]
    assert made.variables == own.variables
    x, u, p = (own.vector(c) for c in ("state", "input", "parameter"))
    for one, other in zip(own.function(x, u, p), made.function(x, u, p), strict=True):
        assert np.array_equal(np.asarray(one), np.asarray(other), equal_nan=True)


def test_the_operating_point_is_found_again(tmp_path, monkeypatch, capsys):
    point = {"muscle.pressure": 2.7e5}
    state = state_with(muscle=CATALOGUE, plant={"arrangement": "HangingLoad"}, point=point)
    names = run(state, tmp_path, monkeypatch)
    own = pam.equilibrium(plant_of(World(tmp_path, state)), point)
    assert names["point"]["x"] == pytest.approx(own["x"], rel=1e-9)
    assert "muscle.pressure" in capsys.readouterr().out


def test_words_of_a_user_stay_words(tmp_path):
    evil = 'x\'); import os; os._exit(1) #\n"""\nimport os'
    muscle = {**CATALOGUE, "name": evil}
    item = bundled(name=evil, file=evil)
    state = state_with(
        data=[item], chosen="data1", muscle=muscle, plant={"arrangement": f"{evil}:a"}
    )
    text = script_of(state)
    imported = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Import)]
    assert {a.name for n in imported for a in n.names} <= {
        "pam_ocp",
        "numpy",
        "dataclasses",
        "runpy",
    }


def test_nothing_chosen_is_a_script_that_does_nothing():
    assert "table" not in script_of(EMPTY)

"""Dynamic fits written and read again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.fitting import fit_plant
from pam_ocp.fitting.dynamic.plant_fit import load_plant_fit


def cart(extra: bool = False) -> pam.Plant:
    plant = pam.Plant("cart")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    f = plant.input("force", unit="N")
    m = plant.parameter("mass", 2.0, unit="kg", min=0.0)
    c = plant.parameter("damper", 3.0, unit="N.s/m", min=0.0)
    if extra:
        c = c + plant.parameter("friction", 0.0, unit="N.s/m")
    plant.der(x, v)
    plant.der(v, (f - c * v) / m)
    return plant


@pytest.fixture(scope="module")
def fit() -> pam.fitting.PlantFit:
    plant, records = cart(), []
    for seed in range(2):
        random = np.random.default_rng(seed)
        t = np.arange(0, 1.01, 0.02)
        force = random.uniform(-5, 5, 8)[np.minimum((t / 0.15).astype(int), 7)]
        run = pam.simulate(plant, {"force": (t, force)}, t=t)
        x = run["x"] + 1e-3 + 1e-4 * random.standard_normal(t.size)
        variables = [plant.variable("force"), plant.variable("x")]
        records.append(pam.Trajectory(t, {"force": force, "x": x}, variables, "previous"))
    return fit_plant(plant.with_values(mass=1.5), records, ["mass", "damper"])


def test_a_saved_fit_comes_back_and_validates(fit: pam.fitting.PlantFit, tmp_path: Path) -> None:
    again = load_plant_fit(fit.save(tmp_path / "fit.json"), cart())
    assert again.values == fit.values
    assert again.plant.variable("mass").start == fit.plant.variable("mass").start
    assert again.covariance == pytest.approx(fit.covariance, rel=1e-9)
    for name in fit.values:
        assert again.interval(name, 0.9) == pytest.approx(fit.interval(name, 0.9), rel=1e-9)
    assert again.fit_percent == fit.fit_percent
    assert again.warnings == fit.warnings
    assert again.report() == fit.report()
    assert [c.tolist() for c in again.residuals] == [c.tolist() for c in fit.residuals]
    one, other = (f.validate(fit.records[1])[0]["x"].fit_percent for f in (fit, again))
    assert other == pytest.approx(one, rel=1e-9)


def test_files_that_hold_no_such_fit_are_refused(fit: pam.fitting.PlantFit, tmp_path: Path) -> None:
    path = fit.save(tmp_path / "fit.json")
    (tmp_path / "other.json").write_text("{}")
    content = json.loads(path.read_text())
    del content["linearisation"]["scale"]
    (tmp_path / "broken.json").write_text(json.dumps(content))
    for name, plant, words in (
        ("fit", cart(extra=True), "whose parameters are others: only the plant has friction"),
        ("none", cart(), "no such file"),
        ("other", cart(), "is no fit of a plant"),
        ("broken", cart(), "cannot be read as a fit of a plant"),
    ):
        refused(words, load_plant_fit, tmp_path / f"{name}.json", plant)

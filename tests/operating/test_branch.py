"""Branches of equilibria round their folds, against closed forms."""

import numpy as np
import pytest
from conftest import BAR, refused

import pam_ocp as pam
from pam_ocp.operating.resting_point import EquilibriumError
from pam_ocp.operating.several import equilibrium_branch


def cusp(**bounds):
    """x' = r + x - x^3: an S with folds at x = -+1/sqrt(3), r = +-2/(3 sqrt(3))."""
    plant = pam.Plant("cusp")
    x, r = plant.state("x", start=-1.5, **bounds), plant.input("r", nominal=0.5)
    a = plant.parameter("a", 1.0)
    plant.der(x, r + a * x - x**3)
    plant.output("cube", x**3)
    return plant


def test_an_s_is_followed_round_both_its_folds():
    path = equilibrium_branch(cusp(), "r", -1.0, 1.0)
    assert path.end == ""
    assert path.values[0] == -1.0
    assert path.values[-1] == pytest.approx(1.0, abs=1e-12)
    x = path["x"]
    assert np.all(np.diff(x) > 0)
    assert path["r"] == pytest.approx(x**3 - x, abs=1e-9)
    first, second = path.folds
    assert (first["x"], second["x"]) == pytest.approx((-1 / np.sqrt(3), 1 / np.sqrt(3)), abs=1e-7)
    assert first["r"] == pytest.approx(2 / (3 * np.sqrt(3)), abs=1e-12)
    kinds = [
        p.stability for p, v in zip(path.points, x, strict=True) if abs(abs(v) - 3**-0.5) > 0.01
    ]
    inside = [abs(v) < 3**-0.5 for v in x if abs(abs(v) - 3**-0.5) > 0.01]
    assert kinds == ["unstable" if i else "stable" for i in inside]
    assert 10 < len(path) < 400


def test_along_a_parameter_and_along_an_output():
    """At r = 0.1: a = x^2 - 0.1/x has a fold at x = -0.05^(1/3); and by its output x^3."""
    plant = cusp().with_values(x=-1.2)
    fold = equilibrium_branch(plant, "a", 1.3, 0.0, {"r": 0.1}, max_points=300)
    (turn,) = fold.folds
    assert turn["x"] == pytest.approx(-(0.05 ** (1 / 3)), abs=1e-6)
    assert turn["a"] == pytest.approx(3 * 0.05 ** (2 / 3), rel=1e-10)
    assert fold.end == "the branch comes back to the start value"
    assert fold.values[-1] == pytest.approx(1.3)
    assert fold["a"] == pytest.approx(fold["x"] ** 2 - 0.1 / fold["x"], abs=1e-8)
    cube = equilibrium_branch(cusp(), "cube", -1.0, 1.0)
    assert cube.folds == ()
    assert cube["r"] == pytest.approx(cube["x"] ** 3 - cube["x"], abs=1e-9)


def test_without_a_fold_it_is_the_path(hanging):
    branch = equilibrium_branch(hanging, "mass", 5.0, 40.0, {"muscle.command": 3 * BAR})
    path = pam.operating.equilibrium_path(
        hanging, "mass", branch.values, {"muscle.command": 3 * BAR}
    )
    assert branch.end == ""
    assert branch["x"] == pytest.approx(path["x"], abs=1e-9)
    assert branch.points[-1].plant.variable("mass").start == pytest.approx(40.0)


def test_where_it_ends_it_says_why():
    path = equilibrium_branch(cusp(max=0.2), "r", -1.0, 1.0)
    assert path.end == "x reaches the end of its range"
    assert path["x"].max() <= 0.2
    assert len(path.folds) == 1
    assert equilibrium_branch(cusp(), "r", -1.0, 1.0, max_points=5).end == "after 5 points"
    refused("start and stop are the same", equilibrium_branch, cusp(), "r", 1.0, 1.0)
    with pytest.raises(EquilibriumError):
        equilibrium_branch(cusp(max=-1.4), "r", -1.0, 1.0)

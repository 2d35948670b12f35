"""check_fmu finds out what is wrong with an FMU, and plays inputs of every kind."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import pytest
from conftest import BAR, benchmark_slide
from fmu_tools import exported
from hostile import contents, packed
from numpy.polynomial import chebyshev, polynomial

import pam_ocp as pam
from pam_ocp.core.signals import PiecewisePolynomial
from pam_ocp.export import check_fmu, source
from pam_ocp.export.check import FmuCheck, check_fmus

DESCRIPTION = "modelDescription.xml"


def copied(path: Path, changes: Any) -> Any:
    """The checks of copies of a unit with other files (None: left out), in one process."""
    whole, others = contents(path), []
    for number, change in enumerate(changes):
        content = {name: c for name, c in (whole | change).items() if c is not None}
        others.append(packed(path.with_name(f"copy{number}.fmu"), content))
    return check_fmus(others)


def described(path: Path, changes: Any) -> Any:
    """The checks of copies with other descriptions: changes(root) makes each."""

    def described_so(change: Any) -> dict[str, bytes]:
        root = ElementTree.fromstring(contents(path)[DESCRIPTION])
        change(root)
        return {DESCRIPTION: ElementTree.tostring(root)}

    return copied(path, map(described_so, changes))


def test_a_wrong_trajectory_is_found_out(slide_unit):
    plant, t = benchmark_slide(), np.linspace(0, 0.1, 11)
    right = pam.simulate(plant, {"muscle1.command": 4 * BAR}, t=t)
    assert check_fmu(slide_unit, right).ok
    other = pam.simulate(plant.with_values(mass=2.01), {"muscle1.command": 4 * BAR}, t=t)
    found = check_fmu(slide_unit, other)
    assert not found.ok
    assert "NOT well" in str(found)
    assert check_fmu(slide_unit, other, parameters={"mass": 2.01}).ok


def test_what_cannot_be_compared_is_no_agreement():
    found = {"ModelExchange": {"x": 1e-9, "v": float("nan")}}
    check = FmuCheck(Path("load.fmu"), "2.0", 1e-6, (), deviations=found)
    assert np.isnan(check.largest)
    assert np.isnan(check.to_dict()["largest"]["ModelExchange"])


def test_damaged_fmus_are_found_out(fmus):
    path = fmus["2.0"].folder.with_name("2.fmu")
    (binary,) = (n for n in contents(path) if n.startswith("binaries/"))
    text, library = contents(path)[DESCRIPTION], contents(path)[binary]
    wrong = {
        "no binary": {binary: None},
        "no shared library": {binary: b"nonsense"},
        "belong together": {DESCRIPTION: text.replace(b'guid="{', b'guid="{1')},
        "foreign__name": {binary: library.replace(b"fmi2Terminate", b"foreign__name")},
    }
    for words, found in zip(wrong, copied(path, wrong.values()), strict=True):
        assert any(words in finding for finding in found.findings), words


def test_wrong_directional_derivatives_are_found_out(fmi, tmp_path, monkeypatch):
    right = source.plant_functions

    def wrong(plant: pam.Plant) -> Any:
        functions = {f.name(): f for f in right(plant)}
        forward = functions["plant_forward"]
        given = forward.sx_in()
        dxdot, dy = forward(*given)
        functions["plant_forward"] = ca.Function("plant_forward", given, [1.001 * dxdot, dy])
        return list(functions.values())

    monkeypatch.setattr(source, "plant_functions", wrong)
    found = check_fmu(exported(benchmark_slide(), tmp_path, fmi))
    assert any("directional derivatives along x" in finding for finding in found.findings)


def test_curved_inputs_that_jump_are_played_in_every_mode(slide_unit):
    """Polynomials of degree 7 with bends of a bar in 50 ms, as plans have them."""
    plant, rng = benchmark_slide(), np.random.default_rng(5)
    breaks, h = np.linspace(0.0, 0.4, 9), 0.05
    pieces = np.zeros((8, 8, 2))
    for k, i in np.ndindex(8, 2):
        bends = np.array([3.0, *rng.uniform(-0.25, 0.25, 7)]) * BAR
        curve = chebyshev.Chebyshev(bends, domain=[0.0, h]).convert(kind=polynomial.Polynomial)
        pieces[k, :, i] = curve.coef
    inputs = PiecewisePolynomial(breaks, pieces)
    motion = pam.simulate(plant, inputs, t=np.linspace(0.0, 0.4, 41))
    left = inputs(breaks[1:-1] - 1e-9) - inputs(breaks[1:-1])
    assert np.abs(left).max() > 0.3 * BAR
    found = check_fmu(slide_unit, motion)
    assert found.ok, str(found)
    assert found.largest < 2e-7
    columns = {n: motion[n] for n in motion.names}
    lines = pam.Trajectory(motion.t, columns, motion.variables, "linear")
    # the samples alone do not say how they are joined
    assert check_fmu(slide_unit, lines).largest > 1e-3


# ---- the binary against its description ---------------------------------------------------------


def attributes(root: Any, name: str, fmi: str) -> Any:
    variable = next(v for v in root.find("ModelVariables") if v.get("name") == name)
    return variable if fmi == "3.0" else variable[0]


@pytest.mark.slow
def test_a_description_that_is_not_the_binarys_is_found_out(fmu, slide_unit):

    def says(name: str, **changed: str) -> Any:
        return lambda root: attributes(root, name, fmu.fmi).attrib.update(changed)

    changes = [
        says("mass"),
        says("mass", start="3.0"),
        says("muscle1.command", start="200000.0"),
        says("mass", max="2.5"),
        says("mass", min="-1.0"),
    ]
    checks = described(slide_unit, changes)
    right, other, command, most, least = (found.findings for found in checks)
    assert right == ()
    assert "mass is 2 at the start in CoSimulation, 3 in the description" in other
    words = "muscle1.command is 300000 at the start in ModelExchange, 200000 in the d"
    assert words in str(command)
    assert most == ("mass = 5 is taken, beyond its max 2.5 in the description",)
    assert least == ("mass = -1 is refused, its min in the description",)


def test_dependencies_that_are_not_told_are_found_out(fmu, slide_unit):
    fmi = fmu.fmi

    def forgotten(group: str, unknown: str, known: str) -> Any:
        def change(root: Any) -> None:
            variables = [v.get("name") for v in root.find("ModelVariables")]
            numbers = {n: str(i + 1) for i, n in enumerate(variables)}
            if fmi == "3.0":
                numbers = {v.get("name"): v.get("valueReference") for v in root[-2]}
            structure = root.find("ModelStructure")
            entries = structure if fmi == "3.0" else structure.find(group + "s")
            here = [e for e in entries if e.tag in ("Unknown", group)]
            keys = [(e.get("index"), e.get("valueReference")) for e in here]
            entry = next(e for e, k in zip(here, keys, strict=True) if numbers[unknown] in k)
            told = ("dependencies", "dependenciesKind")
            pairs = zip(*(entry.get(name).split() for name in told), strict=True)
            kept = zip(*((d, k) for d, k in pairs if d != numbers[known]), strict=True)
            for name, words in zip(told, kept, strict=True):
                entry.set(name, " ".join(words))

        return change

    told = "{} depends on {} which the description does not tell"
    group = "Derivative" if fmi == "2.0" else "ContinuousStateDerivative"
    cases = (
        ("Output", "muscle1.force", "x", "x,"),
        ("InitialUnknown", "muscle2.force", "muscle2.a5", "muscle2.a5 at the start,"),
        (group, "der(muscle1.pressure)", "muscle1.command", "muscle1.command,"),
    )
    checks = described(slide_unit, [forgotten(*case[:3]) for case in cases])
    for (_, unknown, _, words), found in zip(cases, checks, strict=True):
        assert found.findings == (told.format(unknown, words),)

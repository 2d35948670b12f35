"""Files of each released version are read as what they are: 0.1 and 0.2, kept as they were written.

The expected figures are those that the version printed when it wrote its file.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam

KEPT = Path(__file__).parents[1] / "versions"
VERSIONS = ("0.1", "0.2")
LAST_PLACE = {"0.1": 0.001088894589417974, "0.2": 0.0003841883048946121}


def slide(version: str) -> pam.Plant:
    muscle = pam.load_muscle(KEPT / version / "muscle.toml")
    return pam.AntagonisticSlide(muscle, 2.0, **({} if version == "0.1" else {"damping": 80.0}))


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_a_motion(version: str, ending: str) -> None:
    motion = pam.load(KEPT / version / f"motion.{ending}")
    assert motion["x"][-1] == pytest.approx(LAST_PLACE[version], rel=1e-12)
    assert motion.variable("muscle1.pressure").unit == "Pa"


@pytest.mark.parametrize("version", VERSIONS)
def test_a_muscle_and_the_fit_of_its_force(version: str) -> None:
    assert pam.load(KEPT / version / "muscle.toml").rest_length == 0.2
    assert pam.load(KEPT / version / "force_fit.json").rmse == pytest.approx(6.195613025605761)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_fit_of_a_plant(version: str) -> None:
    path = KEPT / version / "plant_fit.json"
    fit = pam.fitting.load_plant_fit(path, slide(version))
    assert fit.values["mass"] == pytest.approx(2.0, rel=1e-6)
    assert "mass" in str(pam.load(path))


@pytest.mark.parametrize("version", VERSIONS)
def test_a_plan_keeps_its_motion_and_says_that_it_cannot_be_judged(version: str) -> None:
    path = KEPT / version / "plan.npz"
    motion = pam.load(path)
    assert motion["x"][[0, -1]] == pytest.approx([-0.01, 0.01], abs=1e-6)
    if version == "0.2":  # whose damping was said, so that today's slide is the same
        start = {n: motion[n][0] for n in motion.named("state")}
        again = pam.simulate(slide(version), motion, start=start, rtol=1e-9)
        assert np.interp(motion.t, again.t, again["x"]) == pytest.approx(motion["x"], abs=2e-6)
    refused(r"former version.*Trajectory\.load", pam.load_plan, path, slide(version))


def test_the_command_line_takes_the_motion_of_a_former_plan(capsys: pytest.CaptureFixture) -> None:
    from pam_ocp.cli.main import main

    assert main(["compare", *[str(KEPT / "0.2" / "plan.npz")] * 2]) == 0
    assert main(["look", str(KEPT / "0.1" / "plan.npz")]) == 0
    assert "muscle1.pressure" in capsys.readouterr().out

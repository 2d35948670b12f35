"""All kinds of units keep the static rules of FMI 2 and 3; a unit that breaks one is found out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fmi_rules
import numpy as np
import pytest
from conftest import BAR, benchmark_slide
from fmpy.validation import validate_fmu
from fmu_tools import COMMANDS, VERSIONS
from hostile import replaced

import pam_ocp as pam
from pam_ocp.control import KalmanFilter, block, chain, mpc_block
from pam_ocp.control.controller_plants import pid_controller
from pam_ocp.export import export_fmu
from pam_ocp.export.motion import export_motion


def slide() -> Any:
    return benchmark_slide()


def valves() -> Any:
    feed, losses = pam.feeds.SpoolValve(overlap=0.05), pam.losses.BoucWen()
    return pam.HangingLoad("DMSP-20-400N", mass=20.0, feed=feed, losses=losses)


def joint() -> Any:
    return pam.AntagonisticJoint(pam.muscle("DMSP-20-200N"), losses=pam.losses.PrandtlIshlinskii())


def pid() -> Any:
    weights = {COMMANDS[0]: 1.0, COMMANDS[1]: -1.0}
    return pid_controller(benchmark_slide(), "x", weights, proportional=2e6)


def lqi() -> Any:
    plant = benchmark_slide()
    law = pam.lqr(plant, {"x": 0.0, "stiffness": 2.2e4}, integral={"x": 80.0}, sample_time=1e-3)
    return block(law, plant=plant)


def predictive() -> Any:
    plant = benchmark_slide()
    rate = dict.fromkeys(COMMANDS, 0.1)
    mpc = pam.Mpc(plant, horizon=2, sample_time=5e-3, track={"x": 1.0}, rate=rate, iterations=1)
    kalman = KalmanFilter(plant, sample_time=5e-3, measured={"x": 1e-5})
    return block(chain([kalman, mpc_block(mpc)]), plant=plant)


PLANTS = {"slide": slide, "valves": valves, "joint": joint, "pid": pid}
BLOCKS = {"lqi": lqi, "predictive": predictive}


def written(name: str, fmi: Any, folder: Path) -> Path:
    path = folder / f"{name.partition(' ')[0]}.fmu"
    if name == "motion":
        commands = {f"muscle{i}.command": (2.0 + i) * BAR for i in (1, 2)}
        t = np.linspace(0, 0.1, 11)
        run = pam.simulate(benchmark_slide(), commands, t=t)
        return export_motion(run, path, fmi=fmi, platforms="native")
    if name == "slide shared":
        plant = pam.AntagonisticSlide("DMSP-20-200N", losses=pam.losses.CoulombFriction())
        return export_fmu(plant, path, fmi=fmi, platforms="native", share=True)
    if name == "lqi unclocked":
        return export_fmu(lqi(), path, fmi=fmi, platforms="native", clock=False)
    return export_fmu({**PLANTS, **BLOCKS}[name](), path, fmi=fmi, platforms="native")


@pytest.mark.parametrize("name", [*PLANTS, *BLOCKS, "slide shared", "lqi unclocked", "motion"])
def test_a_unit_keeps_every_rule(name, fmi, tmp_path):
    path = written(name, fmi, tmp_path)
    assert fmi_rules.findings(path) == []
    assert validate_fmu(str(path)) == []


# ---- the rules find what is broken --------------------------------------------------------------
BROKEN = {
    "names": ('name="mass"', 'name="x"'),
    "references": (' valueReference="2"', ' valueReference="1"'),
    "combinations": (
        'causality="parameter" variability="tunable"',
        'causality="parameter" variability="continuous"',
    ),
    "starts": (' initial="exact"', ' initial="calculated"'),
    "ranges": ('nominal="1.0" start="2.0"', 'nominal="1.0" start="2e9"'),
    "one_time": ('causality="input"', 'causality="independent"'),
    "units": ('<Unit name="Pa">', '<Unit name="Pascal">'),
    "types": ('declaredType="Mass"', 'declaredType="Masse"'),
    "slopes": ('derivative="1"', 'derivative="999"'),
    "experiment": ('startTime="0.0"', 'startTime="9.0"'),
    "files": ('modelIdentifier="', 'modelIdentifier="7'),
}
STRUCTURE = {
    "2.0": {
        "complete": ("<Outputs>", '<Outputs><Unknown index="10" />'),
        "dependencies": ('dependenciesKind="constant"', 'dependenciesKind="constant fixed"'),
    },
    "3.0": {
        "complete": ("<ModelStructure>", '<ModelStructure><Output valueReference="9" />'),
        "dependencies": ('dependenciesKind="constant"', 'dependenciesKind="constant fixed"'),
        "clocks": ('name="mass"', 'name="mass" clocks="77"'),
    },
}
ICON_FILE = "terminalsAndIcons/terminalsAndIcons.xml"
ICONS = {"terminals": ('variableName="x"', 'variableName="somewhere"')}


@pytest.fixture(scope="module", params=VERSIONS)
def sound(request: Any, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    folder = tmp_path_factory.mktemp("sound")
    return request.param, written("slide", request.param, folder)


def test_each_rule_finds_what_breaks_it(sound, tmp_path):
    fmi, path = sound
    described = {**BROKEN, **STRUCTURE[fmi]}
    tried = set()
    for rule, (old, new) in [*described.items(), *ICONS.items()]:
        file = "modelDescription.xml" if rule in described else ICON_FILE
        found = fmi_rules.findings(replaced(path, tmp_path / f"{rule}.fmu", file, old, new))
        assert any(f.startswith(f"{rule}: ") for f in found), (rule, found)
        tried.add(rule)
    left = {r.__name__ for r in fmi_rules.RULES} - tried
    assert left == ({"clocks"} if fmi == "2.0" else set())

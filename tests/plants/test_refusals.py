"""What cannot be is refused: every number of every component, by its name."""

import json
import math

import pytest
from conftest import refused

import pam_ocp as pam

NAN = math.nan
TOO_SMALL = {  # the least value that is refused, at the edge
    pam.feeds.Tube: {"volume": 0.0, "lag": 0.0},
    pam.feeds.SpoolValve: {
        "conductance": 0.0,
        "exhaust_conductance": 0.0,
        "max_pressure": 0.0,
        "supply": 0.0,
        "leak": -1e-12,
        "critical_ratio": -0.01,
        "overlap": -0.01,
    },
    pam.feeds.OnOffValves: {"conductance": 0.0, "leak": -1e-12},
    pam.feeds.Regulator: {"lag": 0.0, "max_pressure": 0.0, "max_rate": 0.0},
    pam.losses.ConstantDamping: {"value": -0.01},
    pam.losses.StiffnessDamping: {"ratio": -0.01},
    pam.losses.CoulombFriction: {
        "constant": -1.0,
        "per_pressure": -1e-6,
        "excess": -0.1,
        "speed": 0.0,
        "stribeck_speed": 0.0,
    },
    pam.losses.BoucWen: {"friction": -1.0, "yield_contraction": 0.0, "beta": 0.49, "order": 0.99},
    pam.losses.MaxwellSlip: {"friction": (-1.0,), "yield_contraction": (0.0,), "edge": 0.0},
    pam.losses.Creep: {"stiffness": (-1.0,), "time": (0.0,)},
    pam.loads.Spring: {"stiffness": -1.0},
    pam.loads.Damper: {"coefficient": -1.0},
    pam.loads.DryFriction: {"coulomb": -1.0, "speed": 0.0},
    pam.loads.Inertia: {"value": -0.1},
    pam.loads.Wall: {"stiffness": 0.0, "damping": -1.0, "width": 0.0, "side": 0},
}
TOO_LARGE = {
    pam.feeds.SpoolValve: {"critical_ratio": 1.0, "overlap": 0.5},
    pam.losses.BoucWen: {"beta": 1.01},
    pam.losses.MaxwellSlip: {"edge": 1.01},
}
GIVEN = {
    pam.feeds.Tube: {"volume": 1e-5, "lag": 1e-2},
    pam.losses.ConstantDamping: {"value": 1.0},
    pam.losses.MaxwellSlip: {"friction": (1.0,), "yield_contraction": (0.01,)},
    pam.losses.Creep: {"stiffness": (1.0,), "time": (1.0,)},
    pam.loads.Spring: {"stiffness": 1.0},
    pam.loads.Damper: {"coefficient": 1.0},
    pam.loads.DryFriction: {"coulomb": 1.0},
    pam.loads.Inertia: {"value": 1.0},
    pam.loads.Wall: {"position": 0.1},
}
CASES = [
    (kind, argument, value)
    for table in (TOO_SMALL, TOO_LARGE)
    for kind, arguments in table.items()
    for argument, value in arguments.items()
]


@pytest.mark.parametrize(
    ("kind", "argument", "value"), CASES, ids=[f"{k.__name__}-{a}-{v}" for k, a, v in CASES]
)
def test_a_number_that_cannot_be_is_refused_by_its_name(kind, argument, value):
    given = GIVEN.get(kind, {})
    kind(**given)
    for wrong in (value, (NAN,) if isinstance(value, tuple) else NAN):
        refused(rf"{kind.__name__}.*{argument}", kind, **{**given, argument: wrong})


@pytest.mark.parametrize(
    ("plant", "argument", "wrong"),
    [
        (pam.HangingLoad, "mass", 0.0),
        (pam.HangingLoad, "inclination", NAN),
        (pam.SpringOverMuscle, "spring_stiffness", 0.0),
        (pam.SpringOverMuscle, "preload", NAN),
        (pam.SeriesLoad, "fitting_mass", 0.0),
        (pam.SeriesLoad, "tendon_stiffness", 0.0),
        (pam.SeriesLoad, "tendon_damping", -1.0),
        (pam.AntagonisticSlide, "stroke", 0.0),
        (pam.AntagonisticSlide, "pre_contraction", NAN),
        (pam.AntagonisticJoint, "inertia", 0.0),
        (pam.AntagonisticJoint, "moment_arm", 0.0),
        (pam.AntagonisticJoint, "moment_arm2", -0.01),
        (pam.AntagonisticJoint, "link_mass", -1.0),
        (pam.AntagonisticJoint, "link_length", -1.0),
        (pam.AntagonisticJoint, "limits", (0.1, -0.1)),
        (pam.AntagonisticJoint, "limits", (NAN, 0.1)),
        (pam.AntagonisticJoint, "limits", 0.1),
    ],
)
def test_an_arrangement_that_cannot_be_is_refused(plant, argument, wrong):
    refused(argument.rstrip("2"), plant, pam.muscle("DMSP-20-400N"), **{argument: wrong})


def test_a_plant_file_of_another_version_is_refused(tmp_path):
    path = pam.plants.save_plant(pam.HangingLoad("DMSP-20-400N"), tmp_path / "plant.json")
    content = json.loads(path.read_text("utf-8"))
    path.write_text(json.dumps({**content, "format": "pam_ocp plant 99"}), "utf-8")
    refused("another version .pam_ocp plant 99", pam.plants.load_plant, path)

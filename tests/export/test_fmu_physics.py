"""Each force law, loss and feed goes through an FMU and moves there as it does in Python."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import BAR
from fmu_tools import require_agreement

import pam_ocp as pam
from pam_ocp.muscles.catalogue import catalogue_entry
from pam_ocp.muscles.law import coefficient
from pam_ocp.muscles.laws.user_defined import own_law, polynomial_law, spline_law
from pam_ocp.plants.damping import CoulombFriction, DirectionalDamping
from pam_ocp.plants.memory import BoucWen, Creep, MaxwellSlip
from pam_ocp.plants.prandtl_ishlinskii import PrandtlIshlinskii
from pam_ocp.plants.valves import OnOffValves, SpoolValve, Tube

pytestmark = pytest.mark.slow


@cache
def laws():
    """A muscle of every law of the library and of every way to make one's own, taut at 5-15 %."""
    by_law = {}
    for name in pam.muscles.muscle_names():
        known = "rest_length" in catalogue_entry(name)
        muscle = pam.muscle(name, rest_length=None if known else 0.25)
        by_law.setdefault(muscle.law.name, muscle)
    six = pam.muscle("DMSP-20-300")
    fitted = {}
    cells = np.meshgrid(np.linspace(0.02, 0.2, 8), np.linspace(1e5, 6e5, 6))
    kappa, p = (a.ravel() for a in cells)
    table = pam.fitting.ForceTable(p, kappa, np.maximum(six.tension(p, kappa), 0), 0.3)
    for law in ("geometric", "corrected", "five-parameter", "hildebrandt"):
        if law in pam.laws.LAWS and law not in by_law:
            asked = pam.laws.LAWS[law].fixed_coefficients().items()
            radii = ("radius", "rest_radius", "r0")
            held = {n: 0.01 for n, default in asked if default is None and n in radii}
            fitted[law] = pam.fit_force(table, law, fixed=held or None).muscle(diameter=0.02)
    for made in (polynomial_law(2, 3), spline_law([0.0, 0.1, 0.25])):
        fitted[made.name] = pam.fit_force(table, made).muscle(diameter=0.02)
    held = {"a": coefficient("N/Pa", 1e-3, "area"), "b": coefficient("1", 1.0, "decline")}
    own = own_law("own", lambda p, kappa, a, b: a * p * (1 - b * kappa), held)
    fitted["own"] = pam.Muscle(own(2.5e-3, 3.5), 0.3, 0.02)
    return {**by_law, **fitted}


def agreement(plant, inputs, tmp_path, duration=0.3):
    t = np.linspace(0.0, duration, 61)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        motion = pam.simulate(plant, {n: f(t) for n, f in inputs.items()}, t=t, rtol=1e-11)
    require_agreement(plant, motion, tmp_path)


def wave(t):
    return 3.5 * BAR + 1.0 * BAR * np.sign(np.sin(20 * t))


TO_AND_FRO = {"muscle.command": lambda t: 0.4 * np.sign(np.sin(20 * t))}
IN_TURN = {
    "muscle.fill": lambda t: 0.3 * (np.sin(20 * t) > 0),
    "muscle.vent": lambda t: 0.3 * (np.sin(20 * t) <= 0),
}


@pytest.mark.parametrize("name", sorted(laws()))
def test_every_force_law_agrees(name, tmp_path):
    plant = pam.HangingLoad(laws()[name], 12.0, damping=pam.losses.ConstantDamping(200.0))
    agreement(plant, {"muscle.command": wave}, tmp_path)


@pytest.mark.parametrize(
    "losses",
    [
        (CoulombFriction(10.0, 1e-5, 0.5),),
        (BoucWen(),),
        (MaxwellSlip(),),
        (Creep(),),
        (DirectionalDamping.reynolds(),),
        (DirectionalDamping.festo(),),
        (CoulombFriction(), MaxwellSlip(), Creep()),
    ],
    ids=lambda losses: "+".join(type(loss).__name__ for loss in losses),
)
def test_every_loss_agrees(losses, tmp_path):
    damping = pam.losses.ConstantDamping(40.0)
    plant = pam.HangingLoad("DMSP-20-300", 10.0, damping=damping, losses=losses)
    agreement(plant, {"muscle.command": wave}, tmp_path)


@pytest.mark.parametrize(
    ("feed", "inputs"),
    [
        (SpoolValve(), TO_AND_FRO),
        (SpoolValve(tube=Tube(), leak=1e-10, totals=True), TO_AND_FRO),
        (OnOffValves(), IN_TURN),
    ],
    ids=["spool", "spool-tube-leak-totals", "on-off"],
)
def test_every_feed_agrees(feed, inputs, tmp_path):
    plant = pam.HangingLoad(pam.muscle("DMSP-20-300"), 10.0, feed=feed)
    agreement(plant, inputs, tmp_path)


@pytest.mark.parametrize(
    "plant",
    [
        pam.SpringOverMuscle(
            "DMSP-20-300", loads=(pam.loads.Wall(0.04), pam.loads.ExternalForce())
        ),
        pam.SeriesLoad("DMSP-20-300", 10.0, loads=(pam.loads.DryFriction(3.0),)),
        pam.HangingLoad("DMSP-20-300", 10.0, inclination=0.6, loads=(pam.loads.Spring(300.0),)),
    ],
    ids=lambda p: p.name,
)
def test_every_arrangement_agrees(plant, tmp_path):
    agreement(plant, {"muscle.command": wave}, tmp_path)


def test_all_that_remembers_and_the_body_agree(tmp_path):
    known = pam.muscle("DMSP-20-200N")
    law = pam.laws.with_ends(pam.laws.with_bladder(known.law, 2e4), 0.05, 1.03, 60.0)
    muscle = replace(known, law=law, mass_per_length=0.2, end_mass=0.1, pull_off=2e3)
    losses = (
        PrandtlIshlinskii((4.0, 3.0), (3.0, 2.0), (0.004, 0.02), per_pressure=2e-6),
        BoucWen(5.0, per_pressure=2e-6),
        MaxwellSlip((3.0, 2.0), (0.005, 0.02), per_pressure=2e-6),
        pam.losses.StrandFriction(0.05),
        pam.losses.ForceVelocity(),
        pam.losses.LoadCreep(),
        pam.losses.Preconditioning(),
    )
    plant = pam.HangingLoad(muscle, 10.0, losses=losses)
    plant = plant.with_values(plant.equilibrium({"muscle.command": 2.6e5}))
    command = lambda t: 2.6e5 + 7e4 * np.sin(6 * t) * np.cos(2 * t)  # noqa: E731
    agreement(plant, {"muscle.command": command}, tmp_path, 1.5)

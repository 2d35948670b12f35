"""Linear systems at points that are none of rest say so, and name the state and its rate."""

from __future__ import annotations

import warnings

import pytest

import pam_ocp as pam

GRAVITY = 9.80665


@pytest.fixture
def plant() -> pam.Plant:
    return pam.HangingLoad("DMSP-20-400N", 10.0)


def test_a_slack_load_falls_and_that_is_said(plant):
    with pytest.warns(UserWarning, match=rf"v changes by -{GRAVITY:.4g} m/s2"):
        plant.linearize({"x": 0.11, "muscle.pressure": 0.0, "muscle.command": 0.0})


def test_a_pressure_that_follows_its_command_is_named_in_bar(plant):
    rest = plant.equilibrium(x=0.05)
    held = {n: rest[n] for n in ("x", "muscle.pressure")}
    # 2 bar away with a lag of 50 ms
    with pytest.warns(UserWarning, match=r"muscle\.pressure changes by 40 bar/s"):
        plant.linearize({**held, "muscle.command": rest["muscle.pressure"] + 2e5})


def test_a_moving_position_is_named(plant):
    rest = plant.equilibrium(x=0.05)
    held = {n: rest[n] for n in ("x", "muscle.pressure", "muscle.command")}
    with pytest.warns(UserWarning, match=r"x changes by 200 mm/s"):
        plant.linearize({**held, "v": 0.2})


@pytest.mark.parametrize(
    ("feed", "losses"),
    [
        (None, ()),
        (None, (pam.losses.MaxwellSlip(),)),
        (pam.feeds.SpoolValve(leak=1e-10, spool=pam.feeds.FirstOrderSpool()), ()),
    ],
    ids=["regulator", "held memory", "leaking valve"],
)
def test_at_rest_nothing_is_said(feed, losses):
    plant = pam.HangingLoad("DMSP-20-400N", 10.0, feed=feed, losses=losses)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plant.linearize(plant.equilibrium(x=0.05))


def test_what_only_sums_up_may_change():
    plant = pam.HangingLoad(
        "DMSP-20-400N", 10.0, feed=pam.feeds.SpoolValve(leak=1e-10, totals=True)
    )
    bare = pam.HangingLoad("DMSP-20-400N", 10.0, feed=pam.feeds.SpoolValve(leak=1e-10))
    rest = bare.equilibrium(x=0.05)
    held = {n: rest[n] for n in ("x", "muscle.pressure", "muscle.command")}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plant.linearize(held)  # air is drawn all the time, to fill what leaks


def test_along_a_motion_nothing_is_said(plant):
    motion = pam.simulate(plant, duration=0.1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pam.operating.linearize_along(plant, motion)

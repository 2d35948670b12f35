"""A hanging load, its twin in simulated time, and a rig on it."""

import math

import pytest

import pam_ocp as pam


def instruments(x=1e-5, pressure=200.0):
    """Sensors with these standard deviations [m, Pa]."""
    noise = {"x": x, "muscle.pressure": pressure}
    return {n: pam.simulation.Instrument(noise=v) for n, v in noise.items()}


@pytest.fixture(scope="session")
def plant():
    return pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=10.0, damping=100.0)


@pytest.fixture
def made(plant):
    """made(faults=..., guard=..., readings=...) -> (rig, twin), on a simulated clock."""

    def make(faults=(), guard=None, readings=None, record=None, noise=True, **of_twin):
        clock = pam.rig.SimulatedClock()
        own = [
            pam.rig.Reading("x", low="-20 mm", high="70 mm", rate="2 m/s", frozen="30 ms"),
            pam.rig.Reading(
                "muscle.pressure",
                low="-0.3 bar",
                high="5.5 bar",
                frozen="30 ms",
                follows="muscle.command",
                deviation="1 bar",
                within="0.25 s",
            ),
        ]
        shown, seen = (
            [*own, pam.rig.Reading("supply", "Pa", low=low)] if readings is None else readings
            for low in (-math.inf, "3 bar")
        )
        sensors = instruments() if noise else None
        twin = pam.rig.Twin(plant, shown, clock=clock, sensors=sensors, faults=faults, **of_twin)
        driver = pam.rig.driver("twin", twin=twin)
        return pam.Rig(driver, seen, plant=plant, clock=clock, guard=guard, record=record), twin

    return make

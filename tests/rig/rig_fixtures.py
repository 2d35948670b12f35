"""A hanging load, its twin in simulated time, and a rig on it."""

import pytest

import pam_ocp as pam


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
        chosen = own if readings is None else readings
        sensors = {
            "x": pam.simulation.Instrument(noise=1e-5),
            "muscle.pressure": pam.simulation.Instrument(noise=200.0),
        }
        twin = pam.rig.Twin(
            plant,
            [*chosen, pam.rig.Reading("supply", "Pa")] if readings is None else chosen,
            clock=clock,
            sensors=sensors if noise else None,
            faults=faults,
            **of_twin,
        )
        seen = (
            [*chosen, pam.rig.Reading("supply", "Pa", low="3 bar")] if readings is None else chosen
        )
        rig = pam.Rig(
            pam.rig.driver("twin", twin=twin),
            seen,
            plant=plant,
            clock=clock,
            guard=guard,
            record=record,
        )
        return rig, twin

    return make

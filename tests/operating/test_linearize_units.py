"""Linear systems in units that serve numbers of like size."""

import copy
import pickle

import control
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam


@pytest.fixture(scope="module")
def plant():
    return pam.HangingLoad(pam.muscle("DMSP-20-300"), mass=10.0)


@pytest.fixture(scope="module")
def point(plant):
    return plant.equilibrium(x=0.02)


def test_units_change_numbers_and_no_dynamics(plant, point):
    """1 bar more moves as many mm as 1e5 Pa move m, times 1000; poles have no unit of length."""
    units = {"x": "mm", "muscle.pressure": "bar", "muscle.command": "bar", "muscle.force": "kN"}
    factors = {"x": 1e-3, "muscle_pressure": 1e5, "muscle_force": 1e3}
    si, mixed = plant.linearize(point), pam.linearize(plant, point, units=units)
    assert mixed.units["x"] == "mm"
    assert mixed.units["v"] == "m/s"
    assert np.allclose(np.sort_complex(si.poles()), np.sort_complex(mixed.poles()), rtol=1e-9)
    gains = mixed(3j, squeeze=False)[:, 0] / si(3j, squeeze=False)[:, 0]
    expected = [1e5 / factors.get(name, 1.0) for name in si.output_labels]
    assert gains == pytest.approx(expected, rel=1e-9)


def test_units_change_what_passes_through_at_once():
    plant = pam.HangingLoad("DMSP-20-300", 10.0, feed=pam.feeds.IdealPressure())
    point = plant.equilibrium(x=0.02)
    units = {"muscle.pressure": "bar", "muscle.force": "kN"}
    found = [plant.linearize(point, outputs=["muscle.force"], units=u).D for u in (None, units)]
    slope = pam.muscle("DMSP-20-300").law.dtension_dp(point["muscle.pressure"], 0.02 / 0.3)
    assert [float(d[0, 0]) for d in found] == pytest.approx([slope, slope * 1e5 / 1e3])


def test_in_display_units_a_transfer_function_has_no_zero_far_away(plant, point):
    """From pressure to position there are three poles and no zero at all."""
    system = pam.linearize(plant, point, outputs=["x"], units="display")
    transfer = control.ss2tf(system)
    assert not any(abs(z) < 1e9 for z in transfer.zeros())
    assert transfer.dcgain() == pytest.approx(system.dcgain(), rel=1e-6)


def test_wrong_units_are_refused(plant, point):
    refused(r"units\['x'\] = 'bar'", pam.linearize, plant, point, units={"x": "bar"})
    refused("display", pam.linearize, plant, point, units="shown")


def test_a_linear_system_travels_between_processes(plant, point):
    system = pam.linearize(plant, point, dt=0.01)
    for other in (pickle.loads(pickle.dumps(system)), copy.deepcopy(system)):
        assert (other.dt, other.name, other.units) == (0.01, system.name, system.units)
        assert (other.input_labels, other.output_labels) == (
            system.input_labels,
            system.output_labels,
        )
        for name in "ABCD":
            assert np.array_equal(getattr(other, name), getattr(system, name))


def test_a_point_of_another_plant_is_no_point_to_design_at(point):
    slide = pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), 2.0, pre_contraction=0.1)
    refused("belongs to 'hanging_load', not 'antagonistic_slide'", pam.lqr, slide, point)

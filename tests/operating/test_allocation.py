"""Allocation of an antagonistic pair: exact, and as attainable as the reference says."""

import numpy as np
import pytest
from conftest import BAR, flat, refused

import pam_ocp as pam
from pam_ocp.operating import Allocation, AllocationError

RANGE = (0.5 * BAR, 6 * BAR)


@pytest.fixture
def joint():
    """The pair of REFERENCE section 5: DMSP-20-400N, r = 40 mm, k0 = 12.5 %."""
    return pam.AntagonisticJoint(pam.muscle("DMSP-20-400N"), moment_arm=0.04, pre_contraction=0.125)


def test_effort_and_stiffness_are_what_the_reference_says(joint):
    pair = Allocation(joint)
    assert pair.effort_range(0.0, pressures=RANGE) == pytest.approx((-41.0, 41.0), abs=0.05)
    assert pair.stiffness_range(0.0, taut=False, pressures=RANGE) == pytest.approx(
        (4.9, 45.6), abs=0.05
    )
    for angle in (0.8, -0.8):
        low, high = pair.stiffness_range(angle, taut=False, pressures=RANGE)
        assert (low, high) == pytest.approx((16.7, 39.1), abs=0.06)


def test_allocation_is_exact_and_the_plant_confirms_it(joint):
    pair = Allocation(joint)
    rng = np.random.default_rng(0)
    theta = rng.uniform(-0.8, 0.8, 1000)
    p = rng.uniform(*RANGE, size=(2, 1000))
    law = pam.muscle("DMSP-20-400N").law
    kappa = 0.125 + np.array([1, -1])[:, None] * 0.04 * theta / 0.4
    torque = 0.04 * (law.tension(p[0], kappa[0]) - law.tension(p[1], kappa[1]))
    slopes = law.dtension_dkappa(p[0], kappa[0]) + law.dtension_dkappa(p[1], kappa[1])
    stiffness = -(0.04**2) / 0.4 * slopes
    found = np.array(pair.pressures(theta, torque, stiffness))
    assert np.max(np.abs(found - p)) / BAR < 1e-9

    taut = pair.feasible(theta, *p)
    assert 100 < taut.sum() < 1000
    for i in np.flatnonzero(taut)[:20]:
        y = joint.function([theta[i], 0, *found[:, i]], found[:, i], joint.vector("parameter"))[1]
        outputs = dict(zip([v.name for v in joint.outputs], flat(y), strict=True))
        if min(outputs["muscle1.force"], outputs["muscle2.force"]) > 1.0:
            assert outputs["torque"] == pytest.approx(torque[i], rel=1e-9, abs=1e-9)
            assert outputs["stiffness"] == pytest.approx(stiffness[i], rel=1e-9)


def test_a_slide_is_allocated_too(slide):
    p1, p2 = Allocation(slide).pressures(0.004, 100.0, 2.5e4)
    point = slide.equilibrium({"x": 0.0, "stiffness": 2e4})
    y = slide.function([0.004, 0, p1, p2], [p1, p2], slide.vector("parameter"))[1]
    outputs = dict(zip([v.name for v in slide.outputs], flat(y), strict=True))
    assert outputs["muscle1.force"] - outputs["muscle2.force"] == pytest.approx(100.0, rel=1e-9)
    assert outputs["stiffness"] == pytest.approx(2.5e4, rel=1e-9)
    again = Allocation(slide).pressures(0.0, 0.0, 2e4)
    assert again == pytest.approx((point["muscle1.pressure"], point["muscle2.pressure"]), rel=1e-9)


def test_the_taut_ends_of_the_stiffness_are_where_a_muscle_goes_slack_or_full(joint):
    pair = Allocation(joint)
    low, high = pair.stiffness_range(0.2, 5.0)
    for stiffness in (low, high):
        p = np.array(pair.pressures(0.2, 5.0, stiffness))
        assert pair.feasible(0.2, *p)
        beyond = stiffness + (1e-3 if stiffness == high else -1e-3) * stiffness
        assert not pair.feasible(0.2, *pair.pressures(0.2, 5.0, beyond))


def test_co_contraction_coordinates_go_there_and_back():
    p = np.random.default_rng(2).uniform(0, 6 * BAR, size=(2, 50))
    assert np.allclose(
        pam.operating.pressures_of(*pam.operating.common_and_difference(*p)), p, rtol=1e-14
    )


def test_what_is_asked_may_have_units(joint):
    pair = Allocation(joint)
    texts, numbers = pair.pressures("9 deg", "5 N.m", "30 N.m/rad"), (np.pi / 20, 5.0, 30.0)
    assert np.array(texts) == pytest.approx(np.array(pair.pressures(*numbers)))
    assert pair.stiffness_range("9 deg", "5 N.m", pressures=("0.5 bar", "6 bar")) == pytest.approx(
        pair.stiffness_range(np.pi / 20, 5.0, pressures=RANGE)
    )
    refused(r"effort = '5 N': this measures something else", pair.pressures, 0.0, "5 N", 30.0)


def test_what_is_out_of_reach_says_how_far_one_can_go(joint):
    with pytest.raises(
        AllocationError, match=r"effort 80 is out of reach at theta = 0: -44\.7 \.\. 44\.7"
    ):
        Allocation(joint).stiffness_range(0.0, 80.0)
    refused("the first the smaller", Allocation(joint).effort_range, 0.0, pressures=(6e5, 1e5))


def test_a_plant_without_a_pair_is_refused(hanging):
    refused("muscle1", Allocation, hanging)

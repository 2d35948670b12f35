"""Every old name that docs/migration.md lists does what the page says of it."""

import pickle
import re
from pathlib import Path

import pytest
from conftest import refused

import pam_ocp as pam

PAGE = (Path(__file__).parents[2] / "docs" / "migration.md").read_text("utf-8")
LISTED = {
    name: room
    for room, names in re.findall(r"^\| `pam\.(\w+)` \| (`\w+`(?:, `\w+`)*) \|$", PAGE, re.M)
    for name in re.findall(r"`(\w+)`", names)
}
MOVED = pam._MOVED
RENAMED = [
    (call, old, "sample_time")
    for calls, old in (
        ("closed_loop lqr control.kalman control.tvlqr control.scheduled_lqr", "dt"),
        ("Mpc KalmanFilter control.MovingHorizonEstimator", "step"),
    )
    for call in calls.split()
]


def test_the_page_lists_the_names_that_moved_last_and_none_wrongly():
    assert len(LISTED) >= 10
    assert LISTED.items() <= MOVED.items()


@pytest.mark.parametrize("name", MOVED)
def test_a_name_that_has_moved_works_and_says_where_it_stands(name):
    place = f"{MOVED[name]}.{name}"
    with pytest.warns(DeprecationWarning, match=rf"is pam_ocp\.{place} since"):
        old = getattr(pam, name)
    assert old is getattr(getattr(pam, MOVED[name]), name)


@pytest.mark.parametrize("old", ["plants.elastic.SeriesLoad", "muscles.muscle.Muscle"])
def test_a_pickle_of_version_0_2_finds_its_class(old):
    module, _, name = old.rpartition(".")
    assert pickle.loads(f"cpam_ocp.{module}\n{name}\n.".encode()) is getattr(pam, name)


def test_a_campaign_under_its_former_name_says_the_new_one(tmp_path):
    with pytest.warns(DeprecationWarning, match="fit_forces"), pytest.raises(pam.PamError):
        pam.fitting.fit_campaign(tmp_path, length_laws=[])


def test_the_plant_of_an_fmu_under_its_former_name_says_the_new_one():
    with (
        pytest.warns(DeprecationWarning, match=r"plant=.* is export_fmu\(system="),
        pytest.raises(pam.PamError, match="nowhere"),
    ):
        pam.export_fmu(plant=pam.HangingLoad("DMSP-20-300", mass=5.0), path="nowhere/load.fmu")


@pytest.mark.parametrize(("call", "old", "new"), RENAMED)
def test_an_argument_of_a_former_name_is_refused_by_the_new_one(call, old, new):
    place = pam
    for part in call.split("."):
        place = getattr(place, part)
    refused(rf"no argument '{old}'; did you mean {new}", place, error=TypeError, **{old: 1e-3})


@pytest.mark.parametrize(("call", "old", "new"), RENAMED)
def test_the_page_lists_arguments(call, old, new):
    row = rf"^\|.*`{call.rpartition('.')[2]}`.*\| `{old}` \| `{new}` \|$"
    assert len(re.findall(row, PAGE, re.M)) == 1

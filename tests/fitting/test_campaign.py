"""A campaign: a folder of tables, found back as it was made."""

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.fitting import ForceFit, fit_campaign, fit_forces

LAW = pam.muscle("DMSP-20-300").law
PRESSURE, CONTRACTION = (
    a.ravel() for a in np.meshgrid(np.linspace(0.5e5, 6e5, 8), np.linspace(0, 0.2, 6))
)


def written(folder, name, length, offset, random, scale=1.0):
    force = scale * np.asarray(LAW.tension(PRESSURE, CONTRACTION)) + offset
    force = np.maximum(force + random.normal(0, 1.0, force.size), 0)
    rows = zip(length * (1 - CONTRACTION), PRESSURE / 1e5, force, strict=True)
    text = "".join(f"{a:.4f},{p:.4f},{f:.3f}\n" for a, p, f in rows)
    (folder / name).write_text("length [mm],pressure [bar],force [N]\n" + text, "utf-8")


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    folder, random = tmp_path_factory.mktemp("rig"), np.random.default_rng(11)
    for length in (200, 300):
        for branch, width in (("filling", -5.0), ("venting", 5.0)):
            for run, shift in ((1, 0.0), (2, 4.0)):
                name = f"DMSP-20-{length}_{branch}_run{run}.csv"
                written(folder, name, length, width + shift, random)
    (folder / "notes.csv").write_text("day,who\n1,x\n", "utf-8")
    return folder


@pytest.fixture(scope="module")
def campaign(rig):
    return fit_forces(rig, candidates=["six-parameter", "five-parameter"])


def test_names_of_files_tell_muscle_size_branch_and_repeat(campaign):
    assert list(campaign.muscles) == ["DMSP-20-200", "DMSP-20-300"]
    study = campaign["DMSP-20-200"]
    assert (study.diameter, study.rest_length) == pytest.approx((0.020, 0.200))
    assert study.fit.table.branches == ("inflation", "deflation")
    assert set(study.fit.table.run) == {"1", "2"}
    assert list(campaign.failed) == ["notes.csv"]


def test_branches_repeats_and_hysteresis_are_those_that_were_put_in(campaign):
    study = campaign["DMSP-20-300"]
    assert study.hysteresis.mean == pytest.approx(10.0, abs=1.0)
    assert {n: f.rmse < 0.5 * study.fit.rmse for n, f in study.branches.items()} == {
        "inflation": True,
        "deflation": True,
    }
    first, second = study.runs
    assert second.mean - first.mean == pytest.approx(4.0, abs=4 * np.hypot(first.stderr, 0.05))


def test_lengths_of_one_diameter_are_fitted_together_and_left_out_in_turn(campaign):
    (group,) = campaign.lengths
    assert group.muscles == ("DMSP-20-200", "DMSP-20-300")
    assert group.joint.shared == ("a1", "a2", "a3", "a4", "a5", "a6")
    assert group.ranked[0].name == "six-parameter"
    assert group.probability > 0.01  # the same law at both lengths


def test_muscles_that_differ_are_seen_to_differ(tmp_path):
    random = np.random.default_rng(12)
    written(tmp_path, "l200_d20.csv", 200, 0.0, random)
    written(tmp_path, "l300_d20.csv", 300, 0.0, random, scale=1.05)
    (group,) = fit_forces(tmp_path, candidates=[]).lengths
    assert group.probability < 1e-6


def test_a_campaign_is_told_tabulated_and_saved(campaign, tmp_path):
    text = campaign.report()
    for part in ("[[DMSP-20-200]]", "hysteresis", "repeat 2", "[[Diameter 20 mm]]", "notes.csv"):
        assert part in text
    assert [r["branch"] for r in campaign.table()[:3]] == ["all", "inflation", "deflation"]
    data = campaign.plot_data()["DMSP-20-200"]
    np.testing.assert_allclose(data["measured"] - data["fitted"], data["residual"])
    folder = campaign.save(tmp_path / "out")
    again = ForceFit.from_json(folder / "DMSP-20-300.json")
    assert again.rmse == pytest.approx(campaign["DMSP-20-300"].fit.rmse)
    assert pam.load_muscle(folder / "DMSP-20-200.toml").rest_length == pytest.approx(0.200)


def test_columns_tell_muscles_in_one_file(tmp_path):
    force = np.asarray(LAW.tension(PRESSURE, CONTRACTION))
    rows = "".join(
        f"{name},{length},{100 * k:.4f},{p / 1e5:.4f},{f:.4f}\n"
        for name, length in (("A", 200), ("B", 400))
        for k, p, f in zip(CONTRACTION, PRESSURE, np.maximum(force, 0), strict=True)
    )
    path = tmp_path / "all.csv"
    path.write_text("muscle,l0 [mm],kappa [%],p [bar],F [N]\n" + rows, "utf-8")
    found = fit_forces([path], diameter={"A": 0.01, "B": 0.02}, candidates=[])
    assert {n: (s.diameter, s.rest_length) for n, s in found.muscles.items()} == {
        "A": (0.01, pytest.approx(0.2)),
        "B": (0.02, pytest.approx(0.4)),
    }


def test_a_folder_without_tables_is_an_error(tmp_path):
    refused("no table of a campaign", fit_forces, tmp_path, candidates=[])
    refused("is no folder", fit_forces, tmp_path / "nowhere", candidates=[])


def test_files_without_candidates_are_one_joint_fit(rig, tmp_path):
    files = sorted(rig.glob("DMSP-*.csv"))
    joint = fit_forces(files)
    assert list(joint.fits) == ["DMSP-20-200", "DMSP-20-300"]
    assert joint["DMSP-20-300"].n > 100  # four files each
    assert joint.values["a3"] == pytest.approx(LAW.values["a3"], rel=0.1)
    refused(r"^notes\.csv: ", fit_forces, rig)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"weights": [None, None]}, "belong to a joint fit; leave candidates away"),
        ({"noise": "each"}, "belong to a joint fit; leave candidates away"),
        ({"candidates": None, "loss": "huber"}, "loss is of no use to a joint fit"),
        ({"candidates": None, "diameter": 0.02}, "diameter is of no use to a joint fit"),
    ],
)
def test_what_belongs_to_the_other_kind_of_fit_is_refused(options, words):
    refused(words, fit_forces, {"A": None, "B": None}, **{"candidates": [], **options})


def test_the_former_name_of_a_campaign_goes_on(rig, campaign):
    with pytest.warns(DeprecationWarning, match="candidates=LAWS"):
        former = fit_campaign(rig, length_laws=[], units={"force": "N"})
    assert former["DMSP-20-200"].fit.law == campaign["DMSP-20-200"].fit.law

"""Trajectory and input signals."""

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp import Trajectory, UnknownNameError, Variable
from pam_ocp.core import units
from pam_ocp.core.signals import merged, signals

VARIABLES = (
    Variable("x", "state", unit="m", nominal=0.01),
    Variable("muscle.command", "input", unit="Pa", nominal=1e5),
)


def record(interpolation="previous") -> Trajectory:
    return Trajectory(
        [0.0, 0.1, 0.3],
        {"x": [0.0, 0.01, 0.03], "muscle.command": [1e5, 2e5, 4e5]},
        VARIABLES,
        interpolation,
    )


def test_held_inputs_keep_their_value_between_samples_and_states_are_joined():
    at = record().at([0.05, 0.1, 0.2])
    assert at["muscle.command"] == pytest.approx([1e5, 2e5, 2e5])
    assert at["x"] == pytest.approx([0.005, 0.01, 0.02])
    assert record("linear").at([0.2])["muscle_command"] == pytest.approx([3e5])


@pytest.mark.parametrize("ending", ["npz", "parquet", "csv"])
def test_what_was_saved_comes_back(tmp_path, ending):
    before = record()
    after = Trajectory.load(before.save(tmp_path / f"record.{ending}"))
    assert np.array_equal(after.t, before.t)
    assert after.names == before.names
    assert all(np.array_equal(after[n], before[n]) for n in before.names)
    assert [v.unit for v in after.variables] == ["m", "Pa"]
    if ending != "csv":
        assert after.variables == before.variables
        assert after.interpolation == "previous"


def test_an_unwritable_place_leaves_nothing_behind(tmp_path):
    refused("does not exist", record().save, tmp_path / "nowhere" / "record.csv")
    refused(r"\.csv, \.npz, \.parquet", record().save, tmp_path / "record.txt")
    assert list(tmp_path.iterdir()) == []


def test_a_deviation_counts_whichever_way_it_goes():
    other = record()
    other["x"][1] -= 5e-3
    other["x"][2] += 1e-3
    comparison = record().compare(other)
    found = comparison["x"]
    assert (found.largest, found.time) == (pytest.approx(5e-3), 0.1)
    assert found.relative == pytest.approx(0.5)
    assert found.rms == pytest.approx(np.sqrt((25e-6 + 1e-6) / 3))
    assert comparison.largest == pytest.approx(0.5)
    assert str(comparison).splitlines()[1].split()[0] == "x"


def test_a_gap_is_no_agreement_of_two_motions():
    other = record()
    other["muscle.command"][1] = np.nan
    assert np.isnan(record().compare(other).largest)


@pytest.mark.parametrize(
    ("t", "columns", "message"),
    [
        ([0.0, 0.0], {"x": [0, 1], "muscle.command": [0, 1]}, "must rise"),
        ([0.0, np.nan], {"x": [0, 1], "muscle.command": [0, 1]}, "not finite"),
        ([0.0, 1.0], {"x": [0], "muscle.command": [0, 1]}, "shape"),
        ([], {"x": [], "muscle.command": []}, "at least one time"),
    ],
)
def test_a_record_that_is_none_is_refused(t, columns, message):
    refused(message, Trajectory, t, columns, VARIABLES)


def test_an_unknown_column_brings_the_nearest():
    with pytest.raises(UnknownNameError, match=r"muscle\.command"):
        record()["muscle.comand"]


def test_a_function_of_time_is_followed_to_its_tolerance(hanging):
    t = np.linspace(0.0, 2.0, 11)
    u = signals(hanging, {"muscle.command": lambda s: 3e5 + 1e5 * np.sin(9 * s)}, t)
    times = np.linspace(0.0, 2.0, 1777)
    assert u(times)[:, 0] == pytest.approx(3e5 + 1e5 * np.sin(9 * times), abs=1e-3)


def test_a_jump_of_a_function_is_found(hanging):
    u = signals(
        hanging, {"muscle.command": lambda s: 1e5 if s < 0.7312 else 4e5}, np.array([0.0, 2.0])
    )
    assert u([0.7312 - 2e-9])[0, 0] == pytest.approx(1e5)
    assert u([0.7312 + 2e-9])[0, 0] == pytest.approx(4e5)


@pytest.mark.parametrize("between", ["previous", "linear"])
def test_behind_its_samples_an_input_keeps_the_last_one(between, slide):
    given = {"muscle1.command": ([0.0, 0.1], [1e5, 5e5]), "muscle2.command": 3e5}
    u = signals(slide, given, np.array([0.0, 0.2, 0.4]), between)
    assert list(u([0.0, 0.1, 0.2, 0.4])[:, 0]) == pytest.approx([1e5, 5e5, 5e5, 5e5])


def test_the_last_sample_of_a_held_input_is_its_end_not_an_interval(slide):
    t = np.array([0.0, 0.1, 0.2])
    u = signals(slide, {"muscle1.command": [1e5, 2e5, 5e5], "muscle2.command": 3e5}, t)
    assert u([0.0, 0.05, 0.1, 0.19]) == pytest.approx(
        np.array([[1e5, 3e5], [1e5, 3e5], [2e5, 3e5], [2e5, 3e5]])
    )


def test_what_is_held_goes_on_with_its_last_sample_when_the_run_goes_on(slide):
    held = {"muscle1.command": ([0.1, 0.2], [1e5, 4e5]), "muscle2.command": np.array(3e5)}
    for t in ([0.0, 0.5], [0.3, 0.5]):
        assert signals(slide, held, np.array(t))([0.0, 0.19, 0.2, 0.5])[-1].tolist() == [4e5, 3e5]
    run = pam.simulate(slide, held, t=[0.0, 0.1, 0.15, 0.2, 1.0])
    assert run["muscle1.command"].tolist() == [1e5, 1e5, 1e5, 4e5, 4e5]
    assert run["muscle1.pressure"][-1] == pytest.approx(4e5, rel=1e-6)  # 16 lags later


@pytest.mark.parametrize(
    ("inputs", "message"),
    [
        ({"x": 1.0}, "x is a state of the plant, not an input"),
        ({"muscle1.command": [1e5, 2e5, 3e5]}, "3 samples for 2 times"),
        ({"muscle1.command": [1.0, np.nan]}, "sample 1 is nan"),
        ({"muscle1.command": ([0.0, 0.0], [1e5, 2e5])}, "times must rise"),
        ({"muscle1.command": (0.5, 2e5)}, "1 samples for 1 times"),
        ({"muscle1.command": lambda t: float("nan")}, "one finite number"),
        ({"muscle1.command": 9e5}, "outside 0 bar .. 6 bar"),
        ({"muscle3.command": 1e5}, "muscle1.command"),
    ],
)
def test_bad_inputs_are_refused_with_a_reason(slide, inputs, message):
    refused(message, pam.simulate, slide, inputs, t=[0.0, 0.1])


@pytest.mark.parametrize(
    ("header", "factors"),
    [
        ("time [s],u [Pa],x [m]", (1, 1, 1)),
        ("time [ms],u [bar],x [mm]", (1e-3, 1e5, 1e-3)),
        ("time,u [kPa],x [%]", (1, 1e3, 1e-2)),
        ("time [min],u [l/min],x [N/mm]", (60, 1e-3 / 60, 1e3)),
    ],
)
def test_units_of_a_table_are_converted_to_si(tmp_path, header, factors):
    rows = np.array([[0.0, 1.5, 2.0], [0.5, 3.0, 4.0]])
    table = tmp_path / "inputs.csv"
    table.write_text(header + "\n" + "".join(f"{a},{b},{c}\n" for a, b, c in rows))
    found = pam.Trajectory.load(table)
    assert found.t == pytest.approx(factors[0] * rows[:, 0])
    assert found["u"] == pytest.approx(factors[1] * rows[:, 1])
    assert found["x"] == pytest.approx(factors[2] * rows[:, 2])
    assert all(units.unit(v.unit).factor == 1.0 for v in found.variables)


def test_a_table_whose_first_column_is_no_time_is_refused(tmp_path):
    for head in ("time [mm]", "time (ms)"):
        table = tmp_path / "inputs.csv"
        table.write_text(f"{head},x [m]\n0,1\n1,2\n")
        refused("time", pam.Trajectory.load, table, error=pam.PamError)


def test_inputs_that_jump_stand_twice_in_a_table_and_move_the_plant_again(hanging, tmp_path):
    table = tmp_path / "inputs.csv"
    table.write_text("time [s],muscle.command [bar]\n0,1.5\n0.5,1.5\n0.5,3\n1,3\n1.5,2\n")
    motion = pam.simulate(hanging, pam.Trajectory.load(table), rtol=1e-10)
    lag = hanging.variable("muscle.lag").start
    after = 3e5 - 1.5e5 * np.exp(-0.5 / lag)  # of a first-order lag, from 1.5 bar
    assert motion.at([1.0])["muscle.pressure"][0] == pytest.approx(after, rel=1e-4)
    again = pam.Trajectory.load(motion.save(tmp_path / "motion.csv"))
    assert len(again) == len(motion)
    assert pam.simulate(hanging, again, rtol=1e-10).compare(motion).largest < 1e-7


@pytest.mark.parametrize("at_the_end", [1, 2, 5])
def test_times_that_differ_by_rounding_are_one_and_the_last_is_kept(at_the_end):
    end = 0.6
    lasts = [end - k * np.spacing(end) for k in range(at_the_end)]
    found = merged(np.array([*lasts, 0.3, 0.0, np.nextafter(0.3, 1.0)]))
    np.testing.assert_array_equal(found, [0.0, 0.3, end])

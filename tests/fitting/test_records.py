"""Measured records: what is recognised and converted, and what is refused in which words."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.core.errors import InputError, UnknownNameError
from pam_ocp.fitting import ReadingWarning, read_record, read_records

T = [0.0, 0.01, 0.02, 0.03]


def columns(**changes: Any) -> dict[str, Any]:
    good = {
        "time [ms]": [0.0, 10.0, 20.0, 30.0],
        "x [mm]": [1.0, 2.0, 3.0, 4.0],
        "muscle1_command [bar]": [2.0, 3.0, 3.0, 2.0],
        "comment": ["", "", "", ""],
    }
    return {**good, **changes}


def test_names_and_units_of_a_plant_are_recognised(slide: pam.Plant) -> None:
    record = read_record(columns(), slide)
    assert record.names == ("x", "muscle1.command")
    np.testing.assert_allclose(record.t, T)
    np.testing.assert_allclose(record["x"], [1e-3, 2e-3, 3e-3, 4e-3])
    np.testing.assert_allclose(record["muscle1.command"], [2e5, 3e5, 3e5, 2e5])
    assert record.variable("muscle1.command").causality == "input"
    assert record.interpolation == "linear"


def test_columns_and_units_can_be_told(slide: pam.Plant) -> None:
    raw = {"t": T, "ch1": [1.0, 2.0, 3.0, 4.0]}
    told = {"columns": {"x": "ch1"}, "units": {"x": "mm"}, "interpolation": "previous"}
    record = read_record(raw, slide, **told)
    np.testing.assert_allclose(record["x"], [1e-3, 2e-3, 3e-3, 4e-3])
    assert record.interpolation == "previous"


def test_without_a_plant_every_column_is_an_output_in_si() -> None:
    columns = {"t_s": T, "angle [deg]": [0, 90, 180, 0], "p1_bar": [0, 1, 2, 3], "n": [1, 2, 3, 4]}
    record = read_record(columns)
    np.testing.assert_allclose(record["angle"], [0, np.pi / 2, np.pi, 0])
    np.testing.assert_allclose(record["p1"], [0, 1e5, 2e5, 3e5])
    assert [v.unit for v in record.variables] == ["rad", "Pa", "1"]


def test_a_saved_trajectory_is_read_back(tmp_path: Path, slide: pam.Plant) -> None:
    run = pam.simulate(slide, {"muscle1.command": 3e5, "muscle2.command": 2e5}, duration=0.1)
    read = read_record(run.save(tmp_path / "run.csv"), slide)
    assert set(read.names) == set(run.names)
    for name in run.names:
        np.testing.assert_array_equal(read[name], run[name])


def test_several_files_and_one_file_in_parts_are_the_same_set(tmp_path: Path) -> None:
    one, two = "t,x_mm\n0,1\n0.1,2\n0.2,3\n", "t,x_mm\n0,4\n0.1,5\n"
    for name, text in (("1.csv", one), ("2.csv", two)):
        (tmp_path / name).write_text(text)
    files = read_records([tmp_path / "1.csv", tmp_path / "2.csv"])
    assert [len(r) for r in files] == [3, 2]
    numbered = tmp_path / "numbered.csv"
    numbered.write_text("run,t,x_mm\n1,0,1\n1,0.1,2\n1,0.2,3\n2,0,4\n2,0.1,5\n")
    cut = read_records(numbered, split="run")
    for a, b in zip(files, cut, strict=True):
        np.testing.assert_array_equal(a["x"], b["x"])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"time [ms]": [0, 10, 5, 30]}, r"time runs backwards in row 3, from 0.01 to 0.005 s"),
        ({"time [ms]": [0, 10, 10, 30]}, "time stands still in row 3"),
        ({"time [ms]": [0, 10, 20, 900]}, r"a gap of 0.88 s before row 4 \(from 0.02 to 0.9 s"),
        ({"time [ms]": [0, 10, float("inf"), 30]}, "row 3 holds inf"),
        ({"x [mm]": [1.0, "slip", 3.0, 4.0]}, r"column 'x \[mm\]', row 2 holds 'slip'"),
    ],
)
def test_times_and_cells_that_cannot_be_are_refused_with_their_place(
    changes: dict[str, Any], words: str, slide: pam.Plant
) -> None:
    refused(words, read_record, columns(**changes), slide)


@pytest.mark.parametrize("column", ["time [ms]", "x [mm]"])
def test_rows_with_empty_cells_are_dropped_and_counted(column: str, slide: pam.Plant) -> None:
    cells = [1.0, 2.0, 3.0, 4.0] if column == "x [mm]" else [0.0, 10.0, 20.0, 30.0]
    holed = columns(**{column: [*cells[:1], float("nan"), *cells[2:]]})
    with pytest.warns(ReadingWarning, match=r"1 of 4 rows dropped .*first row 2"):
        record = read_record(holed, slide)
    np.testing.assert_allclose(record["x"], [1e-3, 3e-3, 4e-3])
    refused("row 2 is empty", read_record, holed, slide, empty="refuse")


@pytest.mark.parametrize("row", [0, 7, 29])
def test_a_single_wrong_time_is_dropped_wherever_it_stands(row: int) -> None:
    t = 0.1 * np.arange(30)
    wrong = t.copy()
    wrong[row] = 50.0 if row < 29 else 0.0
    words = rf"1 rows of a single wrong time dropped .*row {row + 1}"
    with pytest.warns(ReadingWarning, match=words):
        record = read_record({"t": wrong, "x": t})
    np.testing.assert_allclose(record["x"], np.delete(t, row))
    refused(r"runs backwards|gap", read_record, {"t": wrong, "x": t}, clock="refuse")


def test_a_clock_that_never_runs_is_refused() -> None:
    refused("time stands still in row 2", read_record, {"t": np.zeros(30), "x": np.arange(30.0)})


def test_a_gap_can_be_allowed(slide: pam.Plant) -> None:
    wide = columns(**{"time [ms]": [0, 10, 20, 900]})
    assert read_record(wide, slide, max_gap=1.0).duration == pytest.approx(0.9)


WAY = [1, 2, 3, 4]


def test_units_that_cannot_be_or_measure_something_else_are_refused(slide: pam.Plant) -> None:
    def wrong(words: str, column: Any, error: Any = InputError, **options: Any) -> None:
        refused(words, read_record, {"t": T, **column}, slide, error=error, **options)

    wrong(r"is in bar, which is no unit of x \(m\)", {"x [bar]": WAY})
    wrong(r"units\['x'\] = 'bar' is no unit of x", {"x [mm]": WAY}, units={"x": "bar"})
    wrong("unknown unit", {"x [furlong]": WAY}, UnknownNameError)
    wrong(r"'x', row 4, is 4 m \(read in m, as no unit was named\)", {"x": WAY})
    words, command = r"the unit cannot be right.*units=\{'muscle1.command'", [2e5, 3e5, 3e5, 2e5]
    wrong(words, {"muscle1_command [bar]": command})
    wrong("it looks like bar", {"muscle1_command": [2.0, 3.0, 3.0, 2.0]})


def test_a_muscle_without_pressure_is_no_wrong_unit(slide: pam.Plant) -> None:
    none = read_record({"t": T, "x [mm]": WAY, "muscle1_command": [0.0] * 4}, slide)
    assert np.all(none["muscle1.command"] == 0)


def test_what_is_not_there_is_named(slide: pam.Plant) -> None:
    two, wrong = {"t": [0, 1], "foo": [1, 2]}, {"error": UnknownNameError}
    refused("no column for the time", read_record, {"x": [1, 2]}, slide)
    refused("bears the name of a variable of plant", read_record, two, slide)
    refused("column 'bar'", read_record, two, slide, columns={"x": "bar"}, **wrong)
    refused("column to split at", read_records, two, slide, split="episode", **wrong)
    refused("1 sample", read_record, {"t": [0.0], "x": [1.0]}, slide)

"""What no rig of this field measures is doubted aloud with the keyword that settles it; what is
certain (a sentinel, a date, a comma) is read right and named.
"""

from __future__ import annotations

import ast
import re
import warnings
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from rig_files import REST, grid

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.core.errors import InputError
from pam_ocp.fitting import ReadingWarning, look

N = 60
T = 0.01 * np.arange(N)
WAVE = np.sin(6 * T)
BARS, MM = 2 + WAVE, 20 + 5 * WAVE
CELLS = grid()
IN_UNITS = {
    "p_bar": CELLS["pressure"] / 1e5,
    "p_mbar": CELLS["pressure"] / 1e2,
    "F_N": CELLS["force"],
    "kappa_%": 100 * CELLS["contraction"],
    "l_mm": 300 * (1 - CELLS["contraction"]),
}
ROW = np.arange(CELLS["force"].size)
EVERY = ROW % 5 == 2


@pytest.fixture(scope="module")
def plant() -> pam.Plant:
    return pam.HangingLoad("DMSP-20-300", 20.0)


def heard(function: Any, *given: Any, **options: Any) -> tuple[Any, dict[type, str]]:
    """(what is read, {class of warning: its words})."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = function(*given, **options)
    return found, {w.category: str(w.message) for w in caught}


def answered(words: str) -> dict[str, str]:
    """The first units that a doubt names."""
    said = re.search(r"units=(\{[^}]*\})", words)
    assert said, words
    return dict(ast.literal_eval(said[1]))


def record(
    time: Any = T,
    head: str = "time",
    p: Any = BARS,
    x: Any = MM,
    p_head: str = "muscle_command [bar]",
    x_head: str = "x [mm]",
) -> Any:
    return {head: time, p_head: p, x_head: x}


def table(**changed: Any) -> dict[str, Any]:
    """{header: values} of the static test; ``p_bar=...`` stands for the column of pressures."""
    usual = {"kappa": CELLS["contraction"], "p_Pa": CELLS["pressure"], "F_N": CELLS["force"]}
    for name, values in changed.items():
        first = {"k": "kappa", "l": "kappa", "p": "p_Pa", "F": "F_N"}[name[0]]
        usual = {name if h == first else h: values if h == first else v for h, v in usual.items()}
    return usual


# ---- clocks --------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("time", "settled"),
    [
        pytest.param(1e3 * T, "ms", id="steps of 10 s"),
        pytest.param(1e6 * T, "us", id="steps of 10 000 s"),
        pytest.param(1e9 * T, "ns", id="steps of 1e7 s"),
        pytest.param(T / 86400, "d", id="steps of 1e-7 s: fractions of days"),
        pytest.param(0.4166 + T / 86400, "d", id="fractions of days from ten o'clock"),
        pytest.param(np.arange(4000) / 86400, "d", id="seconds as fractions of days"),
    ],
)
def test_a_clock_without_a_unit_that_no_rig_has_is_doubted(plant: Any, time: Any, settled: str):
    wave = np.sin(np.arange(time.size))
    rig = record(time, p=2 + wave, x=20 + wave)
    read, said = heard(pam.read_record, rig, plant)
    assert "no unit was named" in said[pam.UnitWarning]
    np.testing.assert_allclose(read.t, time)  # doubted, not changed
    units = answered(said[pam.UnitWarning])
    assert units == {"time": settled}
    read, said = heard(pam.read_record, rig, plant, units=units)
    assert not said
    step = 1.0 if time.size > N else 0.01
    np.testing.assert_allclose(np.diff(read.t), step, rtol=1e-4)
    assert not heard(pam.read_record, rig, plant, units={"time": "s"})[1]


def test_counts_of_samples_are_no_seconds_and_take_a_calibration(plant: Any):
    rig = record(np.arange(N))
    read, said = heard(pam.read_record, rig, plant)
    assert "counts 0, 1, 2" in said[pam.UnitWarning]
    assert answered(said[pam.UnitWarning]) == {"time": "count * 1 ms"}
    read, said = heard(pam.read_record, rig, plant, units={"time": "count * 10 ms"})
    np.testing.assert_allclose(read.t, T, atol=1e-12)
    assert not said


@pytest.mark.parametrize(
    ("time", "head", "words"),
    [
        (45355.41666667 + T / 86400, "time", "days of a spreadsheet"),
        (739315.41666 + np.arange(N) / 86400, "time", "days of MATLAB"),
        (1.7e12 + 1e3 * T, "time [s]", "counted from 1970 in ms"),
    ],
)
def test_dates_as_numbers_are_read_as_dates_and_named(plant: Any, time: Any, head: str, words: str):
    read, said = heard(pam.read_record, record(time, head), plant)
    assert words in said[pam.UnitWarning]
    step = 1.0 if "MATLAB" in words else 0.01
    np.testing.assert_allclose(np.diff(read.t).mean(), step, rtol=1e-3)
    read, said = heard(pam.read_record, record(time, head), plant, units={"time": "s"})
    assert not said
    np.testing.assert_allclose(read.duration, time[-1] - time[0])


@pytest.mark.parametrize(
    "time",
    [1.7e9 + T, 1.7e12 + 1e3 * T, 1.7e15 + 1e6 * T, 1.33e17 + 1e7 * T, 6.38e17 + 1e7 * T],
    ids=["s", "ms", "us", "Windows", ".NET"],
)
def test_counts_from_long_ago_are_seconds_at_once(plant: Any, time: Any):
    read, said = heard(pam.read_record, record(time), plant)
    np.testing.assert_allclose(read.t, T, atol=1e-4)
    assert not said


def test_a_clock_put_back_in_autumn_runs_on_where_stamps_name_their_zone():
    begin = datetime(2024, 10, 27, 0, 59, 59, 800_000, tzinfo=timezone.utc)
    zones = [timezone(timedelta(hours=2 if i < 20 else 1)) for i in range(N)]
    moments = [(begin + timedelta(milliseconds=10 * i)).astimezone(z) for i, z in enumerate(zones)]
    for cells in ([m.isoformat() for m in moments], moments):
        read, said = heard(pam.read_record, {"time": cells, "p [bar]": BARS})
        np.testing.assert_allclose(read.t, T, atol=1e-5)
        assert not said


@pytest.mark.parametrize(
    ("bits", "head", "said"),
    [(24, "time [ms]", {}), (32, "ticks", {"time": "ms"}), (16, "n", {"time": "count * 1 ms"})],
)
def test_a_counter_is_counted_on(plant: Any, bits: int, head: str, said: Any):
    ticks = (2**bits - 200 + 10 * np.arange(N)) % 2**bits
    read, said = heard(pam.read_record, record(ticks, head), plant, time=head, units=said)
    np.testing.assert_allclose(read.t - read.t[0], T, atol=1e-9)
    assert "begins anew" in said[ReadingWarning]


def test_usual_clocks_and_what_the_package_wrote_are_not_doubted(plant: Any, tmp_path: Path):
    for time, head in (
        (T, "t"),
        (0.25 * np.arange(N), "time"),
        (np.arange(N) * 1e-5 * 200, "time"),
        (10.0 * np.arange(N), "time [s]"),
        (np.arange(N), "time [s]"),
    ):
        assert not heard(pam.read_record, record(time, head), plant)[1], head
    slow = pam.Trajectory(1e4 * np.arange(3), {"x": np.zeros(3)}, [pam.Variable("x", "output")])
    assert not heard(pam.read_record, slow.save(tmp_path / "slow.npz"))[1]


# ---- sentinels -----------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("head", "mark"),
    [
        ("p_bar", 9999),  # in one row alone
        *(("p_bar", mark) for mark in (-9999, 1e30, 9.91e37, 88.88)),
        *(("p_mbar", mark) for mark in (65535, 32767)),
        *(("F_N", mark) for mark in (-9999, 9999, -32768)),
        ("kappa_%", -999),
        ("l_mm", 999.9),
    ],
)
def test_a_sentinel_is_missing_named_and_kept_where_that_is_said(head: str, mark: float):
    rows = ROW == 7 if (head, mark) == ("p_bar", 9999) else EVERY
    rig = table(**{head: np.where(rows, mark, IN_UNITS[head])})
    read, said = heard(pam.read_table, rig, rest_length=REST)
    assert f"{mark:g}" in said[ReadingWarning]
    assert "missing=None" in said[ReadingWarning]
    np.testing.assert_allclose(read.force, CELLS["force"][~rows])
    np.testing.assert_allclose(read.pressure, CELLS["pressure"][~rows])
    try:
        kept = len(heard(pam.read_table, rig, rest_length=REST, missing=None)[0])
    except InputError:
        kept = ROW.size
    assert kept == ROW.size


@pytest.mark.parametrize("mark", ["OL", "overload", "NaN(Ind)", "#N/A", "1.#INF", "?"])
def test_words_for_nothing_are_empty_cells(mark: str):
    force = [mark if e else f"{f:.3f}" for e, f in zip(EVERY, CELLS["force"], strict=True)]
    read, said = heard(pam.read_table, table(F_N=force))
    np.testing.assert_allclose(read.force, CELLS["force"][~EVERY], atol=1e-3)
    assert "4 of 20 rows" in said[ReadingWarning]


def test_values_that_the_user_names_are_missing_and_nothing_else():
    force = [("off" if r == 3 else 1234.5 if r == 4 else f) for r, f in enumerate(CELLS["force"])]
    read, _ = heard(pam.read_table, table(F_N=force), missing=["off", 1234.5])
    np.testing.assert_allclose(read.force, np.delete(CELLS["force"], [3, 4]))
    refused(r"missing = \[True\]: give the values", pam.read_table, table(), missing=[True])


def test_a_record_loses_the_rows_of_its_sentinels_with_and_without_a_plant(plant: Any):
    rows = np.arange(N) % 20 == 3
    for owner in (plant, None):
        for mark in (-9999, 1e30, 99999):
            read, said = heard(pam.read_record, record(p=np.where(rows, mark, BARS)), owner)
            np.testing.assert_allclose(read[read.names[0]], 1e5 * BARS[~rows])
            assert f"{mark:g}" in said[ReadingWarning]


def test_nothing_is_taken_for_a_sentinel_that_may_be_measured(plant: Any):
    square = np.where(np.arange(N) % 30 < 20, 0.0, 6.0)
    stairs = np.repeat([0.0, 0.1, 0.2, 0.3, 0.4, 6.0], 10)
    through = np.linspace(900, 1100, N)  # 999 among its neighbours
    through[30] = 999
    for p in (square, stairs):
        assert not heard(pam.read_record, record(p=p), plant)[1]
    read, said = heard(pam.read_record, {"t": T, "F [N]": through})
    assert len(read) == N
    assert not said


# ---- points and commas ---------------------------------------------------------------------------
def of_rows(folder: Path, rows: list[str], unit: str = "bar", **options: Any) -> Any:
    """(what is read of a file, its warnings)."""
    file = folder / "rig.csv"
    file.write_text("\n".join([f"l [mm];p [{unit}];F [N]", *rows]))
    return heard(pam.read_table, file, rest_length=REST, **options)


@pytest.mark.parametrize("sign", [".", ","])
def test_a_column_with_the_other_decimal_sign_is_read_by_its_own(tmp_path: Path, sign: str):
    other = "," if sign == "." else "."
    bars = CELLS["pressure"] / 1e5 + 1.3  # 1.800 .. 7.300: each reads as thousands, too

    def written(v: float, digits: int, s: str) -> str:
        return f"{v:.{digits}f}".replace(".", s)

    rows = [
        ";".join([written(length, 1, sign), written(p, 3, other), written(f, 2, sign)])
        for length, p, f in zip(IN_UNITS["l_mm"], bars, CELLS["force"], strict=True)
    ]
    read, said = of_rows(tmp_path, rows)
    np.testing.assert_allclose(read.pressure, 1e5 * bars)
    np.testing.assert_allclose(read.force, CELLS["force"], atol=6e-3)
    assert "'p [bar]' has a decimal" in said[ReadingWarning]
    assert "1800" in said[ReadingWarning]


def test_thousands_and_decimals_in_one_column_are_not_mixed(tmp_path: Path):
    # 0.800 can be no thousand, so 6.300 is none
    rows = ["300,5;0.800;500,25", "300,5;6.300;2500,5", "285,25;2.000;700,5", "285,25;6.000;2000,5"]
    read, said = of_rows(tmp_path, rows)
    np.testing.assert_allclose(read.pressure, [0.8e5, 6.3e5, 2e5, 6e5])
    assert "decimal point" in said[ReadingWarning]


def test_points_between_thousands_of_pascal_stay_so(tmp_path: Path):
    rows = ["300,5;80.000;500,25", "300,5;630.000;2.500,5", "285,2;200.000;700,5"]
    read, said = of_rows(tmp_path, rows, "Pa")
    np.testing.assert_allclose(read.pressure, [0.8e5, 6.3e5, 2e5])
    assert not said


def test_what_can_be_both_is_doubted_with_the_keyword(tmp_path: Path):
    rows = ["300;2;950", "300;4;1,021", "285;4;987", "285;6;1,512"]
    for decimal, expected in ((",", 1.512), (".", 1512.0)):
        read, said = of_rows(tmp_path, rows, decimal=decimal)
        assert read.force[-1] == expected
        assert "could be" not in said.get(pam.UnitWarning, "")
    assert "decimal='.'" in of_rows(tmp_path, rows)[1][pam.UnitWarning]


# ---- units ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"p": IN_UNITS["p_mbar"]}, "'pressure': 'mbar'"),
        ({"p_Pa": IN_UNITS["p_mbar"]}, "force per pressure"),
        ({"p_bar": CELLS["pressure"] / 1e6}, "force per pressure"),
        ({"p_bar": CELLS["pressure"] * 4 / 1e5}, "did you mean psi"),
        ({"F": CELLS["force"] / 1e3}, "force per pressure"),
        ({"F_N": CELLS["force"] / 1e3}, "force per pressure"),
        ({"F": CELLS["force"] * 20}, "did you mean"),
        ({"p_bar": CELLS["pressure"] / 1e5 + 1.01325}, "'pressure': 'bar abs'"),
        ({"p": CELLS["pressure"] + 101325}, "'pressure': 'Pa abs'"),
        ({"kappa": 0.3 * (1 - CELLS["contraction"])}, "rises with the contraction"),
        ({"kappa": -0.6 * CELLS["contraction"]}, "rises with the contraction"),
        ({"p": np.where(ROW == 7, 9999, CELLS["pressure"])}, "missing=[...]"),
        ({"F_N": np.where(ROW == 7, 0, CELLS["force"])}, "0 N at 3 bar, 5 % (row 8 of those read)"),
        ({"F_N": np.where(ROW == 7, 7777, CELLS["force"])}, "7777 N at 3 bar, 5 % (row 8 of those"),
    ],
)
def test_a_table_in_a_unit_that_cannot_be_is_doubted_and_read(changed: Any, words: str):
    read, said = heard(pam.read_table, table(**changed))
    assert len(read) == ROW.size
    assert words in said[pam.UnitWarning]
    assert any(words in note for note in read.notes)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"p": CELLS["pressure"] / 6894.757}, r"units=\{'pressure': 'psi'\}"),
        ({"p": CELLS["pressure"] / 1e6}, r"units=\{'pressure': 'MPa'\}"),
        ({"p": CELLS["pressure"] / 1e5}, r"units=\{'pressure': 'bar'\}"),
        ({"F": CELLS["force"] * 102}, r"units=\{'force': 'gf'\}"),
        ({"p_bar": IN_UNITS["p_bar"] * np.where(ROW < 5, 100, 1)}, "the column mixes units"),
    ],
)
def test_a_unit_that_is_impossible_is_refused_with_the_one_that_fits(changed: Any, words: str):
    refused(words, pam.read_table, table(**changed))


def test_the_answer_settles_a_doubt():
    for changed, units in (
        ({"p": CELLS["pressure"] / 1e2}, {"pressure": "mbar"}),
        ({"p_bar": CELLS["pressure"] / 1e5 + 1.01325}, {"pressure": "bar abs"}),
        ({"F": CELLS["force"] / 1e3}, {"force": "kN"}),
    ):
        read, said = heard(pam.read_table, table(**changed), units=units)
        np.testing.assert_allclose(read.pressure, CELLS["pressure"], atol=1e-6)
        np.testing.assert_allclose(read.force, CELLS["force"])
        assert not said
    gauge = {"p_bar": CELLS["pressure"] / 1e5 + 1.01325}
    assert not heard(pam.read_table, table(**gauge), units={"pressure": "bar"})[1]


def test_tables_that_are_right_are_not_doubted():
    for name, length in (("DMSP-20-300_static.csv", 0.3), ("DMSP-10-250_static.csv", 0.25)):
        assert not heard(pam.read_table, name, rest_length=length)[1]
    assert not heard(pam.read_table, table())[1]
    for name in pam.muscles.muscle_names():
        muscle = pam.muscle(name, rest_length=0.25)
        p, kappa = (a.ravel() for a in np.meshgrid(np.arange(1, 7) * 1e5, [0.0, 0.05, 0.1, 0.15]))
        force = np.array([float(muscle.force(*one)) for one in zip(p, kappa, strict=True)])
        made = {"p [Pa]": p, "kappa": kappa, "F [N]": force}
        assert not heard(pam.read_table, made)[1], name


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (record(p=BARS * 14.5), "did you mean psi"),
        (record(p=BARS * 1e3, p_head="muscle_command"), "{'muscle.command': 'mbar'}"),
        (record(x=-MM), "{'x': '0 mm - x'}"),
        (record(x=-MM / 1e3, x_head="x"), "{'x': '0 m - x * 1 m'}"),
        (record(x=MM + 100), "check its unit and its zero"),
        ({**record(), "F": 3e4 + WAVE}, "{'muscle.force': 'gf'}"),
        ({**record(), "muscle_pressure [bar]": BARS + 1.013}, "'muscle.pressure': 'bar abs'"),
        ({**record(), "F [N]": -300 + WAVE}, "{'muscle.force': '0 N - x'}"),
        ({**record(), "v": 75 * WAVE}, "{'v': 'mm/s'}"),
        ({"t": T, "F": -300 + WAVE}, "{'f': '0 N - x * 1 N'}"),
        ({"t": T, "p [bar]": 1.013 + np.maximum(0, 3 * WAVE)}, "'p': 'bar abs'"),
    ],
)
def test_a_record_in_a_unit_that_cannot_be_is_doubted_and_read(plant: Any, rig: Any, words: str):
    owner = plant if "x [mm]" in rig or "x" in rig else None
    read, said = heard(pam.read_record, rig, owner)
    assert len(read) == N
    assert words in said[pam.UnitWarning]


@pytest.mark.parametrize(
    ("rig", "words"),
    [
        (record(x_head="x"), r"units=\{'x': 'mm'\}"),
        (record(x_head="x [m]"), r"units=\{'x': 'mm'\}"),
        (record(p_head="muscle_command"), r"units=\{'muscle\.command': 'bar'\}"),
    ],
)
def test_a_record_in_a_unit_that_is_impossible_is_refused_with_the_one_that_fits(
    plant: pam.Plant, rig: Any, words: str
):
    refused(words, pam.read_record, rig, plant)


def test_degrees_taken_for_radians_are_doubted_and_read_by_the_answer():
    joint = pam.AntagonisticJoint("DMSP-20-300", limits=(-0.6, 0.6))
    for head in ("theta", "Winkel", "joint angle"):
        rig = {"t": T, head: 5 * WAVE}
        _, said = heard(pam.read_record, rig, joint)
        assert answered(said[pam.UnitWarning]) == {"theta": "deg"}
        read, said = heard(pam.read_record, rig, joint, units={"theta": "deg"})
        np.testing.assert_allclose(read["theta"], np.radians(5 * WAVE))
        assert not said


def test_pressures_that_were_set_and_those_that_muscles_bear_are_not_doubted(plant: Any):
    held = {"t": [0.0, 1.0, 2.0], "muscle_pressure [bar]": [1.0, 2.0, 3.0]}
    high = {"t": T, "muscle_pressure [bar]": 5.5 + 3.3 * WAVE}
    for rig in (held, high):
        assert not heard(pam.read_record, rig, plant)[1]
    shown, told = 1.01 + BARS / 2, 1 + BARS / 2
    beside = {"t": T, "muscle_pressure [bar]": shown, "muscle_command [bar]": told}
    assert not heard(pam.read_record, beside, plant)[1]


def test_the_other_way_of_counting_is_a_calibration(plant: Any):
    for rig in (record(x=-MM), record(x=-MM / 1e3, x_head="x")):
        _, said = heard(pam.read_record, rig, plant)
        read, said = heard(pam.read_record, rig, plant, units=answered(said[pam.UnitWarning]))
        np.testing.assert_allclose(read["x"], MM / 1e3)
        assert not said


def test_a_preview_and_the_command_line_say_the_same(tmp_path: Path, capsys: Any):
    file = tmp_path / "run.csv"
    rows = zip(1e3 * T, np.where(np.arange(N) == 4, 9999, BARS), strict=True)
    file.write_text("time,p [bar]\n" + "\n".join(f"{t:g},{p:.4f}" for t, p in rows))
    seen = look(file)
    assert any("units={'time': 'ms'}" in doubt for doubt in seen.doubts)
    assert any("9999" in note for note in seen.notes)
    assert seen.columns[1].high < 4
    assert not look(file, units={"time": "ms"}).doubts
    assert main(["look", str(file), "--units", "time=ms", "--missing", "9999", "off"]) == 0
    assert "missing=[9999, 'off']" in capsys.readouterr().out
    assert main(["look", str(file), "--missing"]) == 0
    shown = capsys.readouterr().out
    assert "did you mean ms" in shown
    assert "taken for missing" not in shown

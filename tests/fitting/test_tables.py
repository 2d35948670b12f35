"""Measured tables: what is recognised, what is converted, and what is refused in which words."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from hypothesis import given
from hypothesis import strategies as st

from pam_ocp.core.errors import InputError, UnknownNameError
from pam_ocp.fitting import ForceTable, ReadingWarning, read_record, read_table
from pam_ocp.fitting.tables.cells import parted

L0 = 0.3
LENGTHS = [0.30, 0.285, 0.27, 0.255]
PRESSURES = [2e5, 4e5, 6e5, 6e5]
FORCES = [400.0, 500.0, 450.0, 0.0]


def table(**changes: Any) -> dict[str, Any]:
    """A good table in SI, with some columns replaced (None: taken out)."""
    columns = {"length_m": LENGTHS, "pressure_Pa": PRESSURES, "force_N": FORCES} | changes
    return {name: values for name, values in columns.items() if values is not None}


def scaled(values: list[float], factor: float) -> list[float]:
    return [v / factor for v in values]


def changed(values: list[float], row: int, value: Any) -> list[Any]:
    return [value if i == row else v for i, v in enumerate(values)]


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


# ---- what is read --------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("name", "rest_length", "cells", "taut"),
    [("DMSP-20-300_static.csv", 0.300, 126, 60), ("DMSP-10-250_static.csv", 0.250, 85, 40)],
)
def test_bundled_tables_are_found_by_name_from_any_folder(
    name: str, rest_length: float, cells: int, taut: int, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    read = read_table(name, rest_length=rest_length)
    assert (len(read), len(read.taut), int(read.slack.sum())) == (cells, taut, cells - taut)
    assert read.source == name


def test_a_file_in_the_working_folder_comes_before_the_bundled_one(
    tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "DMSP-20-300_static.csv", "kappa,p_bar,F_N\n0.1,5,700\n")
    assert len(read_table("DMSP-20-300_static.csv")) == 1


LBF = 0.45359237 * 9.80665


@pytest.mark.parametrize(
    ("heads", "sizes"),
    [
        (("length_m", "pressure_Pa", "force_N"), (1.0, 1.0, 1.0)),
        (("length [mm]", "p [kPa]", "F [N]"), (1e-3, 1e3, 1.0)),
        (("l/mm", "p/bar", "F/N"), (1e-3, 1e5, 1.0)),
        (("Length (cm)", "pressure (bar)", "Force (kN)"), (1e-2, 1e5, 1e3)),
        (("muscle_length_mm", "gauge pressure [MPa]", "pulling force (N)"), (1e-3, 1e6, 1.0)),
        (("L in mm", "P in psi", "F in lbf"), (1e-3, LBF / 0.0254**2, LBF)),
        (("Hossz [mm]", "Túlnyomás [bar]", "Erő [N]"), (1e-3, 1e5, 1.0)),
        (("Délka [mm]", "Tlak [kPa]", "Síla [N]"), (1e-3, 1e3, 1.0)),
        (("Длина, мм", "Давление, кгс/см2", "Усилие, Н"), (1e-3, 98066.5, 1.0)),
        (("长度（mm）", "压力（kPa）", "拉力（N）"), (1e-3, 1e3, 1.0)),
        (("Longueur [mm]", "p [kg/cm²]", "Effort [kgf]"), (1e-3, 98066.5, 9.80665)),
    ],
)
def test_headers_say_quantity_and_unit_in_the_usual_spellings(
    heads: tuple[str, ...], sizes: tuple[float, ...]
) -> None:
    columns = map(scaled, (LENGTHS, PRESSURES, FORCES), sizes)
    read = read_table(dict(zip(heads, columns, strict=True)), rest_length=L0)
    assert read.pressure == pytest.approx(PRESSURES, rel=1e-9)
    assert read.force == pytest.approx(FORCES, rel=1e-9)
    assert read.contraction == pytest.approx([0.0, 0.05, 0.1, 0.15], abs=1e-12)


@pytest.mark.parametrize("header", ["kappa [%]", "contraction_percent", "contraction ratio (%)"])
def test_contraction_in_percent_needs_no_rest_length(header: str) -> None:
    read = read_table(table(length_m=None, **{header: [0.0, 5.0, 10.0, 15.0]}))
    assert read.contraction == pytest.approx([0.0, 0.05, 0.1, 0.15])
    assert read.rest_length is None


def test_a_contraction_in_millimetres_is_of_the_rest_length() -> None:
    for header in ("Verkürzung [mm]", "raccourcissement [mm]", "contraction_mm"):
        columns = table(length_m=None, **{header: [0.0, 15.0, 30.0, 45.0]})
        assert read_table(columns, rest_length=L0).contraction == pytest.approx(
            [0, 0.05, 0.1, 0.15]
        )
        refused("give rest_length in metres", read_table, columns)


@pytest.mark.parametrize("header", ["Druck (abs.) [bar]", "Ciśnienie bezwzględne [bar]"])
def test_a_pressure_that_is_called_absolute_is_read_so(header: str) -> None:
    absolute = [(p + 101325.0) / 1e5 for p in PRESSURES]
    read = read_table(table(pressure_Pa=None, **{header: absolute}), rest_length=L0)
    assert read.pressure == pytest.approx(PRESSURES)


def test_a_mass_that_hangs_on_a_muscle_is_asked_for_its_weight() -> None:
    columns = table(force_N=None, **{"mass [g]": scaled(FORCES, 9.80665e-3)})
    asked = r"columns=\{'force': 'mass \[g\]'\}, units=\{'force': 'g \* 9.80665 N/kg'\}"
    refused(asked, read_table, columns, rest_length=L0)
    told = {"columns": {"force": "mass [g]"}, "units": {"force": "g * 9.80665 N/kg"}}
    assert read_table(columns, rest_length=L0, **told).force == pytest.approx(FORCES)


def test_all_columns_in_a_language_of_its_own_are_asked_for_at_once() -> None:
    columns = {"Shinikizo [bar]": [2, 4], "Mkazo [%]": [0, 5], "Nguvu [N]": [400, 500]}
    asked = {"pressure": "Shinikizo [bar]", "force": "Nguvu [N]", "contraction": "Mkazo [%]"}
    refused(re.escape(f"columns={asked}"), read_table, columns)
    assert read_table(columns, columns=asked).contraction == pytest.approx([0.0, 0.05])


@pytest.mark.parametrize(
    ("values", "said"), [((0, -5, -10, -15), "0 % - x"), ((100, 95, 90, 85), "100 % - x")]
)
def test_strains_and_relative_lengths_are_asked_for_the_way_they_count(values, said) -> None:
    columns = table(length_m=None, **{"kappa [%]": values})
    refused(re.escape(f"units={{'contraction': '{said}'}}"), read_table, columns)
    read = read_table(columns, units={"contraction": said})
    assert read.contraction == pytest.approx([0.0, 0.05, 0.1, 0.15])


@pytest.mark.parametrize(
    ("encoding", "heads"),
    [
        ("cp1250", "Hossz [mm];Nyomás [kPa];Erő [N]"),
        ("cp1250", "Długość in mm;Ciśnienie in kPa;Siła in N"),
        ("koi8_r", "Длина [мм];Давление [кПа];Сила [Н]"),
        ("big5", "長度 [mm];壓力 [kPa];拉力 [N]"),
        ("cp949", "길이 [mm];압력 [kPa];힘 [N]"),
    ],
)
def test_encodings_are_told_from_the_names_of_quantities(
    encoding: str, heads: str, tmp_path: Path
) -> None:
    (tmp_path / "t.csv").write_bytes(f"{heads}\n300;200;400\n270;600;450\n".encode(encoding))
    read = read_table(tmp_path / "t.csv", rest_length=L0)
    assert read.contraction == pytest.approx([0.0, 0.1], abs=1e-12)
    assert read.pressure == pytest.approx([2e5, 6e5])


def test_a_frame_and_a_mapping_take_names_lines_to_skip_and_a_pivot() -> None:
    pandas = pytest.importorskip("pandas")
    head = ["length [mm]", "p [bar]", "F [N]"]
    rows = [(0, 9, 9), (300, 2, 400), (270, 6, 450)]
    bare = pandas.DataFrame(rows)
    for source in (bare, dict(zip("abc", zip(*rows, strict=True), strict=True))):
        read = read_table(source, columns=head, skip=1, rest_length=L0)
        assert read.pressure == pytest.approx([2e5, 6e5])
    named = pandas.DataFrame(rows[1:], columns=head)
    wide = named.pivot(index=head[0], columns=head[1], values=head[2]).fillna(300.0)
    for read in (
        read_table(wide, rest_length=L0),
        read_table(wide.rename_axis(columns=None), pivot=head, rest_length=L0),
    ):
        assert read.force == pytest.approx([300.0, 450.0, 400.0, 300.0])
        assert read.pressure == pytest.approx([2e5, 6e5] * 2)
    refused("is no pivot", read_table, named, pivot=head, rest_length=L0)
    channels = read_record({"time": [0.0, 1.0], "1": [5.0, 6.0], "2": [7.0, 8.0]})
    assert channels["column_2"] == pytest.approx([7.0, 8.0])
    refused("differ in length", read_table, {"p": [1, 2], "1": [3]}, pivot=head)


def test_few_cells_whose_names_run_down_are_turned(tmp_path: Path) -> None:
    text = "length [mm];300;285;270\np [bar];2;4;6\nF [N];400;500;450\n"
    read = read_table(write(tmp_path, "down.csv", text), rest_length=L0)
    assert read.pressure == pytest.approx([2e5, 4e5, 6e5])


def test_columns_and_units_are_told_where_the_header_does_not() -> None:
    columns = {"P1": [2, 4, 6, 6], "P2": [1, 1, 1, 1], "x": LENGTHS, "load": FORCES}
    told = {"columns": {"pressure": "P1", "length": "x", "force": "load"}}
    read = read_table(columns, rest_length=L0, units={"pressure": "bar"}, **told)
    assert read.pressure == pytest.approx(PRESSURES)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "length_m,p [bar],F\n0.30,2,400\n0.27,6,450\n"),
        ("b.tsv", "length_m\tp [bar]\tF\n0.30\t2\t400\n0.27\t6\t450\n"),
        ("c.csv", "# rig 7\nlength_m;p [bar];F\n0,30;2,0;400\n0,27;6,0;450\n;;\n\n"),
        ("d.txt", "\ufefflength_m, p [bar], F\n0.30, 2, 400\n0.27, 6, 450\n"),
    ],
)
def test_separators_comments_and_decimal_commas(name: str, text: str, tmp_path: Path) -> None:
    read = read_table(write(tmp_path, name, text), rest_length=L0)
    assert read.pressure == pytest.approx([2e5, 6e5])
    assert read.contraction == pytest.approx([0.0, 0.1], abs=1e-12)
    assert read.force == pytest.approx([400, 450])


def test_frames_and_binary_files_read_like_text(tmp_path: Path) -> None:
    pandas, scipy_io = pytest.importorskip("pandas"), pytest.importorskip("scipy.io")
    pytest.importorskip("pyarrow")
    frame = pandas.DataFrame(table())
    frame.to_parquet(tmp_path / "t.parquet")
    np.savez(tmp_path / "t.npz", **table())
    scipy_io.savemat(tmp_path / "t.mat", table())
    expected = read_table(table(), rest_length=L0)
    for source in (frame, *(tmp_path / f"t.{s}" for s in ("parquet", "npz", "mat"))):
        read = read_table(source, rest_length=L0)
        for name in ("pressure", "contraction", "force"):
            np.testing.assert_array_equal(getattr(read, name), getattr(expected, name))


@given(
    st.lists(
        st.tuples(st.floats(0.75, 1.05), st.floats(0.1, 7.0), st.floats(1.0, 2000.0)),
        min_size=1,
        max_size=8,
    ),
    st.sampled_from([("Pa", 1.0), ("kPa", 1e3), ("bar", 1e5), ("MPa", 1e6)]),
)
def test_the_unit_of_the_pressure_does_not_change_the_table(
    rows: list[tuple[float, float, float]], unit: tuple[str, float]
) -> None:
    lengths, bars, forces = (np.array(c) for c in zip(*rows, strict=True))
    columns = {"length": lengths * L0, f"p [{unit[0]}]": bars * 1e5 / unit[1], "F": forces}
    read = read_table(columns, rest_length=L0)
    np.testing.assert_allclose(read.pressure, bars * 1e5, rtol=1e-12)
    np.testing.assert_allclose(read.contraction, 1 - lengths, atol=1e-12)


# ---- what a table knows --------------------------------------------------------------------------
def test_a_force_of_zero_or_less_is_slack() -> None:
    cells = ForceTable([2e5, 4e5, 6e5], [0.2, 0.1, 0.0], [-3.0, 0.0, 50.0])
    assert cells.slack.tolist() == [True, True, False]
    assert cells.taut.force.tolist() == [50.0]
    assert "1 taut" in repr(cells)


def test_arrays_of_a_table_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="read-only"):
        read_table(table(), rest_length=L0).force[0] = 1.0


def test_nearly_equal_contractions_are_one_level() -> None:
    cells = ForceTable(np.full(5, 1e5), [0.1, 0.2, 0.1004, 0.1996, 0.0], np.ones(5))
    assert cells.levels().tolist() == [1, 2, 1, 2, 0]


# ---- what is refused -----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("columns", "words"),
    [
        (table(pressure_Pa=None), "no column for the pressure"),
        (table(pressure_Pa=None, presure_Pa=PRESSURES), "did you mean 'presure_Pa'"),
        (table(length_m=None), "no column for the length or contraction"),
        (table(p=PRESSURES), "'pressure_Pa' and 'p' both read as pressure"),
        (table(pressure_Pa=scaled(PRESSURES, 1e5)), r"6 Pa in row 3 .* looks like bar"),
        (table(pressure_Pa=scaled(PRESSURES, 1e3)), r"600 Pa in row 3 .* looks like kPa"),
        (table(pressure_Pa=None, p_bar=PRESSURES), r"600000 bar in row 3 .* looks like Pa"),
        (table(pressure_Pa=changed(PRESSURES, 0, 2.0)), "row 1 .* mixes units"),
        (table(pressure_Pa=changed(PRESSURES, 1, -5e4)), "-50000 Pa in row 2 is negative"),
        (
            table(pressure_Pa=None, **{"p [mm]": PRESSURES}),
            "is in mm, which is no unit of a pressure",
        ),
        (table(pressure_Pa=None, **{"p [furlong]": PRESSURES}), "unknown unit 'furlong'"),
        (table(force_N=changed(FORCES, 1, float("inf"))), "column 'force_N', row 2 holds inf"),
        (table(force_N=changed(FORCES, 1, "slip")), "column 'force_N', row 2 holds 'slip'"),
        (table(force_N=[400.0, None, None, None]), "'force_N' is empty in 3 of 4 rows"),
        (table(force_N=changed(FORCES, 1, 1e6)), "1e\\+06 N in row 2 .* beyond any"),
        (table(force_N=[0.0] * 4), "all 4 cells are slack"),
        (table(force_N=[-5.0, -9.0, 0.0, 0.0]), "count pulling as positive"),
        (table(length_m=changed(LENGTHS, 2, -0.27)), "length -0.27 m in row 3 must be > 0"),
        (table(length_m=changed(LENGTHS, 2, 0.34)), "0.34 m in row 3 .* more than 10 % beyond"),
        (table(length_m=scaled(LENGTHS, 1e-3)), "unit of the lengths"),
        (table(length_m=None, kappa=[0.0, 5.0, 10.0, 15.0]), "15 in row 4 .* looks like percent"),
        (table(length_m=None, kappa=[0.0, 0.1, 0.8, 0.1]), "0.8 in row 3 is outside -10 .. 60 %"),
        (table(length_m=None, **{"kappa [%]": [0, 0.1, 0.2, 0.25]}), "looks like a fraction"),
        (table(kappa=[0.0, 0.05, 0.20, 0.15]), "0.2 in row 3 contradicts length 0.27 m in row 3"),
        (table(force_N=FORCES[:3]), "differ in length"),
        ({"length_m": [], "pressure_Pa": [], "force_N": []}, "is empty"),
        ({}, "is empty"),
    ],
)
def test_bad_tables_are_refused_in_words(columns: dict[str, Any], words: str) -> None:
    refused(words, read_table, columns, rest_length=L0)


@pytest.mark.parametrize("hole", [None, "", float("nan"), "n/a", "NaN", "#N/A", "--"])
def test_rows_with_empty_cells_are_dropped_and_counted_or_refused(hole: Any) -> None:
    columns = table(force_N=changed(FORCES, 1, hole))
    with pytest.warns(ReadingWarning, match=r"1 of 4 rows dropped .*1 in 'force_N'; first row 2"):
        read = read_table(columns, rest_length=L0)
    assert read.force.tolist() == [400.0, 450.0, 0.0]
    assert "1 of 4 rows" in read.notes[0]
    refused("column 'force_N', row 2 is empty", read_table, columns, rest_length=L0, empty="refuse")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"rest_length": None}, "give rest_length in metres"),
        ({"rest_length": -0.3}, "rest_length = -0.3 m must be > 0"),
        ({"rest_length": 300.0}, "check rest_length"),
        ({"columns": {"presure": "p"}}, "unknown quantity in columns 'presure': did you mean"),
        ({"columns": {"pressure": "pressure_pa"}}, "did you mean 'pressure_Pa'"),
        ({"units": {"pressure": "kPa"}}, "says Pa but units"),
        ({"units": {"pressure": "mm"}}, "no unit of a pressure"),
        ({"units": {"pressure": "furlong"}}, "unknown unit"),
    ],
)
def test_bad_arguments_are_refused_in_words(arguments: dict[str, Any], words: str) -> None:
    refused(words, read_table, table(), **{"rest_length": L0, **arguments})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("length_m,pressure_Pa,force_N\n", "is empty"),
        ("0.3,2e5,400\n0.27,6e5,450\n", r"no line names the 3 columns .* columns=\['length"),
        ("length_m,pressure_Pa,force_N\n0.3,2e5,400\n0.27,6e5\n", "line 3 has 2 cells"),
        ("length_m,p,p,force_N\n0.3,2e5,2e5,400\n", "'p' occurs twice"),
        ("length_m,p,F\n\n0.3,2e5,400\n0.3,x,400\n", r"'p', row 2 \(line 4\) holds 'x'"),
    ],
)
def test_bad_files_are_refused_with_their_line(text: str, words: str, tmp_path: Path) -> None:
    refused(words, read_table, write(tmp_path, "t.csv", text), rest_length=L0)


def test_a_missing_file_names_its_neighbours(tmp_path: Path) -> None:
    write(tmp_path, "muscle7.csv", "")
    with pytest.raises(UnknownNameError, match=r"did you mean '.*muscle7\.csv'"):
        read_table(tmp_path / "muscle_7.csv", rest_length=L0)
    with pytest.raises(UnknownNameError, match=r"'DMSP-20-300_static\.csv'"):
        read_table("DMSP-20-300.csv", rest_length=0.3)


def test_a_source_of_the_wrong_kind_is_refused() -> None:
    refused("give a path, a pandas DataFrame or a mapping", read_table, 3.0, rest_length=L0)
    refused("equally long", ForceTable, [1e5, 2e5], [0.0, 0.1], [1.0])


def test_a_damaged_binary_file_is_refused(tmp_path: Path) -> None:
    for name in ("t.npz", "t.mat"):
        with pytest.raises(InputError, match=f"{name}(:| cannot be read as)"):
            read_table(write(tmp_path, name, "x" * 200), rest_length=L0)


# ---- cells that say their units: ``1 bar``, ``300mm``, ``12,5 %`` --------------------------------
ROWS = [(1.0, 300.0, 200.0), (2.0, 300.0, 500.5), (2.0, 290.0, 400.0), (3.0, 290.0, 600.25)]


def in_units(separator: str = ";", form: str = "{} bar;{} mm;{} N", head: str = "p;l;F") -> str:
    rows = [form.format(*row) for row in ROWS]
    return "\n".join([head, *rows]).replace(";", separator) + "\n"


def is_that_of_rows(read: ForceTable) -> None:
    np.testing.assert_allclose(read.pressure, [1e5 * r[0] for r in ROWS])
    np.testing.assert_allclose(read.contraction, [1 - r[1] / 300 for r in ROWS], atol=1e-12)
    np.testing.assert_allclose(read.force, [r[2] for r in ROWS])


@pytest.mark.parametrize(
    "content",
    [
        in_units(),
        in_units(","),
        in_units("\t"),
        in_units(form="{}bar;{}mm;{}N"),
        in_units().replace(".", ","),
        in_units(form="{} bar;{};{} N", head="p;l [mm];F"),
        "Rig 5; 20 °C\n" + in_units(),
    ],
)
def test_cells_that_say_their_units_are_read_at_once(content: str, tmp_path: Path) -> None:
    is_that_of_rows(read_table(write(tmp_path, "rig.csv", content), rest_length=L0))


def test_mappings_and_records_of_such_cells_too(tmp_path: Path) -> None:
    columns = {"p": [f"{r[0] * 100} kPa" for r in ROWS], "F": [f"{r[2] / 1000} kN" for r in ROWS]}
    columns["kappa"] = [f"{100 * (1 - r[1] / 300)} %" for r in ROWS]
    is_that_of_rows(read_table(columns))
    run = "t,q\n" + "".join(f"{10 * k} ms,{k * k} deg\n" for k in range(6))
    record = read_record(write(tmp_path, "run.csv", run), columns={"q": "q"})
    np.testing.assert_allclose(record.t, 0.01 * np.arange(6))
    np.testing.assert_allclose(record["q"], np.deg2rad(np.arange(6) ** 2))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (in_units().replace("2.0 bar;290", "200 kPa;290"), "bar in line 2, kPa in line 4"),
        (in_units(head="p [kPa];l;F"), "kPa in the header, bar in line 2"),
        (in_units().replace("200.0 N", "200.0 mm"), "mm in line 2, N in line 3"),
    ],
)
def test_mixed_units_are_refused(content: str, words: str, tmp_path: Path) -> None:
    refused(
        f"mixes units: {words}", read_table, write(tmp_path, "rig.csv", content), rest_length=L0
    )


def test_what_is_no_number_with_a_unit() -> None:
    assert parted("1.5 bar") == ("1.5", "bar")
    assert parted("-3e2kPa") == ("-3e2", "kPa")
    words = ["2024-01-05", "12:30", "1e5", "1,234.5", "muscle 3", "3 muscles", "bar"]
    for cell in (*words, 3.0, None):
        assert parted(cell) is None, cell

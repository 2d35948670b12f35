"""Files as laboratories have them: loggers, structures, blocks, several clocks, folders."""

import json
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from conftest import refused

import pam_ocp as pam
from pam_ocp.core.exceptions import InputError
from pam_ocp.core.units import unit
from pam_ocp.fitting import ReadingWarning, look

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
T = np.arange(300) * 0.01
BAR = 3 + np.sin(T)


def topics(folder: Path, **tables: dict) -> Path:
    """A file of tables with clocks of their own."""
    path = folder / "topics.json"
    path.write_text(json.dumps({n: {h: list(c) for h, c in t.items()} for n, t in tables.items()}))
    return path


def written(folder: Path, text: str, name: str = "log.csv") -> Path:
    """A file of this text."""
    path = folder / name
    path.write_text(text)
    return path


@contextmanager
def mcap_writer(path: Path) -> Iterator[Any]:
    """Of a file of messages; the test is skipped where nobody can write one."""
    with path.open("wb") as stream:
        writer = pytest.importorskip("mcap.writer").Writer(stream)
        writer.start()
        yield writer
        writer.finish()


def lines(*columns: np.ndarray, cut: str = ",") -> str:
    rows = zip(*columns, strict=True)
    return "\n".join(cut.join(f"{v:.6f}" for v in row) for row in rows) + "\n"


def quietly(function, *arguments, **options):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        result = function(*arguments, **options)
    return result, " ".join(str(w.message) for w in told)


@pytest.mark.slow
def test_a_file_of_every_shape_is_read_right_and_none_wrong(tmp_path: Path) -> None:
    for library in ("nptdms", "rosbags", "mcap", "h5py", "pandas"):
        pytest.importorskip(library)
    import files_study

    found = [files_study.one(n, 11, tmp_path) for n in range(len(files_study.SHAPES))]
    outcomes = [row["verdict"] for row in found]
    assert not [row["text"] for row in found if "wrong" in row["verdict"].lower()]
    assert sum(o.startswith("right") for o in outcomes) >= 0.9 * len(outcomes)


OLD_UNITS = {"mmHg": 133.322387415, "Torr": 101325 / 760, "inHg": 3386.388640341, "N/mm²": 1e6}
OLD_UNITS |= dict.fromkeys(("kgf/cm2", "kgf/cm²", "kp/cm^2", "at"), 98066.5)


@pytest.mark.parametrize(("name", "size"), OLD_UNITS.items())
def test_pressures_in_units_of_other_times_and_places(name: str, size: float) -> None:
    record = pam.read_record({"time [s]": T, f"p [{name}]": BAR * 1e5 / size})
    assert record["p"] == pytest.approx(BAR * 1e5)


def test_forces_in_dekanewton_and_kilopond() -> None:
    assert unit("daN").factor == 10.0
    assert unit("kp").factor == unit("kgf").factor == 9.80665


def test_stray_and_cut_lines_are_dropped_on_request_counted_and_said(tmp_path: Path) -> None:
    rows = lines(T, BAR).splitlines()
    rows.insert(200, "--- restart ---")
    rows[100] = rows[100][:3]
    path = written(tmp_path, "time [s],p [bar]\n" + "\n".join(rows) + "\n")
    refused("bad_lines='drop'", pam.read_record, path)
    with pytest.warns(ReadingWarning, match=r"2 of 301 lines are no rows .* \(line 102, 202\)"):
        record = pam.read_record(path, bad_lines="drop")
    assert len(record) == 299


def test_a_second_table_below_is_no_bad_line(tmp_path: Path) -> None:
    text = "time [s],p [bar]\n" + lines(T, BAR) + "Calibration\nu [V],p [bar]\n1,2\n2,4\n"
    refused(
        "line 303 names columns anew", pam.read_record, written(tmp_path, text), bad_lines="drop"
    )


def test_more_bad_lines_than_rows_are_no_table(tmp_path: Path) -> None:
    text = "t [s],p [bar]\n" + "0.1,2\n0.2,3\nfoo\nbar\nbaz\n" * 20 + "0.3,1\n0.4,1\n" * 5
    with pytest.raises(InputError, match=r"at most 50 %|needs a header and at least one row"):
        pam.read_record(written(tmp_path, text), bad_lines="drop")


def test_a_last_value_that_is_cut_off_is_not_read(tmp_path: Path) -> None:
    path = written(tmp_path, "time [s],p [bar]\n" + lines(T, BAR)[:-4])
    record, words = quietly(pam.read_record, path)
    assert "the last, is cut off" in words
    assert record["p"] == pytest.approx(BAR[:-1] * 1e5, rel=1e-5)


def test_names_that_come_again_are_no_rows(tmp_path: Path) -> None:
    rows = lines(T, BAR).splitlines()
    rows.insert(50, "time [s],p [bar]")
    path = written(tmp_path, "time [s],p [bar]\n" + "\n".join(rows) + "\n")
    record, words = quietly(pam.read_record, path)
    assert "names that come again left out" in words
    assert record["p"] == pytest.approx(BAR * 1e5, rel=1e-5)


def test_a_constant_stands_for_a_column() -> None:
    cells = {"p [bar]": [1, 2, 3, 4], "F [N]": [100, 300, 500, 700]}
    for value in (0.05, "5 %", "0,05"):
        table = pam.read_table(cells, constants={"contraction": value, "branch": "up", "run": 3})
        assert table.contraction == pytest.approx([0.05] * 4)
        assert table.branch == ("inflation",) * 4
        assert table.run == ("3",) * 4
    table = pam.read_table(cells, rest_length=0.3, constants={"length": "285 mm"})
    assert table.contraction == pytest.approx([0.05] * 4)


@pytest.mark.parametrize(
    ("constants", "words"),
    [
        (0.05, "give {name: value}"),
        ({"contraction": "5 mm"}, "something else"),
        ({"pressure": 1e5}, "already"),
        ({"mass": "heavy"}, "give a number"),
    ],
)
def test_constants_that_cannot_be_are_refused(constants: object, words: str) -> None:
    cells = {"p [bar]": [1, 2, 3, 4], "F [N]": [100, 300, 500, 700]}
    refused(words, pam.read_table, cells, constants=constants)


def look_or_refusal(path: Path) -> str | None:
    """The sentence by which a file is refused; None where it is read. Other errors come out."""
    try:
        quietly(pam.read_record, path)
    except pam.PamError as error:
        return str(error)
    return None


def folder_of_runs(folder: Path) -> None:
    for muscle, gain in (("M1", 1.0), ("M2", 0.9)):
        for percent in (0, 5, 10):
            p = np.arange(1.0, 6.0)
            force = gain * p * (140 - 8 * percent)
            name = f"{muscle}_k{percent}_run1.csv"
            (folder / name).write_text("p [bar],F [N]\n" + lines(p, force))


def test_a_folder_is_one_call_and_says_what_was_read_how(tmp_path: Path) -> None:
    folder_of_runs(tmp_path)
    (tmp_path / "M3_kx_run1.csv").write_text("p [bar],F [N]\n1,2\n")
    (tmp_path / "notes.md").write_text("nothing")
    pattern = "{muscle}_k{contraction [%]}_run{run}.csv"
    found, words = quietly(pam.read_folder, tmp_path, pattern=pattern)
    assert "1 of 7 files not read" in words
    assert list(found.problems) == [str(tmp_path / "M3_kx_run1.csv")]
    assert len(found.table) == 30
    assert sorted(set(found.table.contraction)) == pytest.approx([0.0, 0.05, 0.10])
    by_muscle = found.by("muscle")
    assert max(by_muscle["M2"].table.force) == pytest.approx(630.0)
    assert str(found).count("cells between commas") == 6
    assert found.rows()[1]["contraction [%]"] == 10.0


def test_a_pattern_that_is_none_and_a_folder_without_files_are_refused(tmp_path: Path) -> None:
    folder_of_runs(tmp_path)
    refused("each brace", pam.read_folder, tmp_path, pattern="{run")
    refused("no unit", pam.read_folder, tmp_path, pattern="{x [foo]}.csv")
    refused("no file", pam.read_folder, tmp_path, pattern="*.xyz")
    with pytest.raises(InputError, match="say the unit of contraction"):
        pam.read_table(tmp_path / "M1_k5_run1.csv", pattern="M1_k{contraction}_run1.csv")
    with pytest.raises(InputError, match="does not fit the name"):
        pam.read_table(tmp_path / "M1_k5_run1.csv", pattern="M2_k{contraction [%]}_run1.csv")


def test_rows_without_a_time_are_counted_by_the_sample_time() -> None:
    refused(r"sample_time=0.001", pam.read_record, {"p [bar]": BAR})
    record, words = quietly(pam.read_record, {"p [bar]": BAR}, sample_time=0.01)
    assert "rows are counted" in words
    assert record.t == pytest.approx(T)
    # a column in milliseconds is a clock that must be named, not counted over
    with pytest.raises(InputError, match=r"time='elapsed_\[ms\]'|time='tick \[ms\]'"):
        pam.read_record({"tick [ms]": 1e3 * T, "p [bar]": BAR}, sample_time=0.01)


def test_topics_come_on_the_finest_clock_and_commands_are_held(tmp_path: Path) -> None:
    slow = np.arange(0, 3, 0.05)
    path = topics(
        tmp_path,
        sensor={"time": T, "p [bar]": BAR},
        valve={"time": slow, "command [bar]": np.floor(slow)},
        slide={"time": slow, "x [mm]": 10 * slow},
    )
    record, words = quietly(pam.read_record, path)
    assert "held between samples: command [bar]" in words
    inside = T[slow[-1] >= T]
    assert record.t == pytest.approx(inside)
    assert record["x"] == pytest.approx(0.01 * inside)
    assert record["command"] == pytest.approx(1e5 * np.floor(inside + 1e-9), abs=1e-6)


def test_clocks_without_a_unit_are_doubted_after_merging_too(tmp_path: Path) -> None:
    path = topics(tmp_path, a={"time": 1e3 * T, "p [bar]": BAR}, b={"time": 1e3 * T, "x [mm]": BAR})
    with pytest.warns(pam.UnitWarning, match=r"units=\{'time': 'ms'\}"):
        pam.read_record(path)
    record, _ = quietly(pam.read_record, path, units={"time": "ms"})
    assert record.t == pytest.approx(T)


def test_topics_that_end_alike_keep_their_paths(tmp_path: Path) -> None:
    path = tmp_path / "two.mcap"
    with mcap_writer(path) as writer:
        schema = writer.register_schema("P", "jsonschema", b"{}")
        for side, gain in (("left", 1.0), ("right", 2.0)):
            channel = writer.register_channel(f"/{side}/pressure", "json", schema)
            for t, p in zip(T, BAR, strict=True):
                data = json.dumps({"data": gain * 1e5 * p}).encode()
                now = round(1e9 * t) + 10**18
                writer.add_message(channel, log_time=now, publish_time=now, data=data)
    record, _ = quietly(pam.read_record, path)
    assert record["right_pressure"] == pytest.approx(2 * record["left_pressure"])
    assert record["left_pressure"] == pytest.approx(BAR * 1e5)


def test_nothing_is_interpolated_across_a_gap(tmp_path: Path) -> None:
    slow = np.concatenate([np.arange(0, 1, 0.05), np.arange(2, 3, 0.05)])
    path = topics(tmp_path, a={"time": T, "p [bar]": BAR}, b={"time": slow, "x [mm]": 10 * slow})
    refused("a gap of", pam.read_record, path)


def test_tables_that_were_not_recorded_together_are_not_merged(tmp_path: Path) -> None:
    path = topics(tmp_path, a={"time": T, "p [bar]": BAR}, b={"time": T + 100, "x [mm]": BAR})
    refused(r"not recorded together.*pick='a'", pam.read_record, path)
    assert pam.read_record(path, pick="b").names == ("x",)


def test_repeated_runs_are_not_taken_for_topics(tmp_path: Path) -> None:
    runs = {f"run{i}": {"t": T, "p_bar": BAR + i} for i in (1, 2)}
    scipy.io.savemat(tmp_path / "runs.mat", runs)
    refused("pick='run1'", pam.read_record, tmp_path / "runs.mat")
    record = pam.read_record(tmp_path / "runs.mat", pick="run2")
    assert record["p"] == pytest.approx((BAR + 2) * 1e5)


def test_what_is_left_out_of_a_structure_is_said(tmp_path: Path) -> None:
    made = {"time": T, "p_bar": BAR, "x_mm": BAR, "F_N": BAR[::3]}
    scipy.io.savemat(tmp_path / "rates.mat", made)
    record, words = quietly(pam.read_record, tmp_path / "rates.mat")
    assert record.names == ("p", "x")
    assert "other lengths: F_N (100)" in words


def test_a_damaged_file_of_level_4_is_one_sentence(tmp_path: Path) -> None:
    path = tmp_path / "old.mat"
    scipy.io.savemat(path, {"time": T, "p_bar": BAR}, format="4")
    sound = path.read_bytes()
    random = np.random.default_rng(3)
    for _ in range(60):
        damaged = bytearray(sound)
        damaged[int(random.integers(20))] = int(random.integers(256))
        path.write_bytes(bytes(damaged[: int(random.integers(20, len(sound)))]))
        refused = look_or_refusal(path)
        assert refused is None or "old.mat" in refused


@pytest.mark.parametrize("zone", ["CEST", "+0200", "+02", "+02:00"])
def test_a_change_of_daylight_saving_is_no_jump(zone: str, tmp_path: Path) -> None:
    after = {"CEST": "CET", "+0200": "+0100", "+02": "+01", "+02:00": "+01:00"}[zone]
    rows = [f"2024-10-27 02:59:{s:02d} {zone},{s}" for s in range(30, 60)]
    rows += [f"2024-10-27 02:00:{s:02d} {after},{60 + s}" for s in range(30)]
    record = pam.read_record(written(tmp_path, "time,p [kPa]\n" + "\n".join(rows) + "\n"))
    assert record.t == pytest.approx(np.arange(60.0))


def test_a_zone_that_is_not_known_is_refused(tmp_path: Path) -> None:
    rows = [f"2024-10-27 02:59:{s:02d} XYZ,{s}" for s in range(30)]
    with pytest.raises(InputError, match="no time"):
        pam.read_record(written(tmp_path, "time,p [kPa]\n" + "\n".join(rows) + "\n"))


def test_an_index_of_times_is_the_clock() -> None:
    pd = pytest.importorskip("pandas")
    index = pd.date_range("2024-03-31 00:59:59", periods=300, freq="10ms", tz="UTC")
    for one in (index, index.tz_convert("Europe/Berlin"), index - index[0]):
        record = pam.read_record(pd.DataFrame({"p [bar]": BAR}, index=one))
        assert record.t == pytest.approx(T)
    heads = pd.MultiIndex.from_tuples([("time", "s"), ("p", "bar")])
    record = pam.read_record(pd.DataFrame(np.c_[T, BAR], columns=heads))
    assert record["p"] == pytest.approx(BAR * 1e5)


def test_cells_of_nullable_columns_that_hold_nothing_are_gaps(tmp_path: Path) -> None:
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"time [s]": T, "n": np.arange(len(T)), "p [bar]": BAR})
    frame = frame.astype({"n": "Int64", "p [bar]": "Float64"})
    frame.loc[3, "n"] = frame.loc[5, "p [bar]"] = pd.NA
    frame.to_parquet(tmp_path / "run.parquet")
    kept = np.delete(np.arange(len(T)), [3, 5])
    for source in (frame, tmp_path / "run.parquet"):
        with pytest.warns(pam.fitting.ReadingWarning, match="2 of .* rows dropped"):
            record = pam.read_record(source)
        assert record["n"] == pytest.approx(kept)
        assert record["p"] == pytest.approx(BAR[kept] * 1e5)
    with pytest.raises(InputError, match="empty"):
        pam.read_record(frame, empty="refuse")


def test_names_may_run_down_the_left_side(tmp_path: Path) -> None:
    rows = [["time [s]", *map(str, T)], ["p [bar]", *map(str, BAR)]]
    record = pam.read_record(written(tmp_path, "\n".join(",".join(row) for row in rows)))
    assert record["p"] == pytest.approx(BAR * 1e5)


def test_html_with_cells_over_two_rows_keeps_its_columns(tmp_path: Path) -> None:
    body = "".join(
        f"<tr><td>{a:.2f}</td><td>{b:.4f}</td></tr>" for a, b in zip(T, BAR, strict=True)
    )
    head = "<tr><td rowspan=2>time [s]</td><td>Sensor</td></tr><tr><td>p [bar]</td></tr>"
    page = written(tmp_path, f"<html><table>{head}{body}</table></html>", "e.xls")
    record = pam.read_record(page)
    assert record["p"] == pytest.approx(BAR * 1e5, rel=1e-4)


def test_blocks_of_muscles_are_chosen_by_their_titles(tmp_path: Path) -> None:
    rows = ["Muscle A;;;Muscle B;;", "kappa [%];p [bar];F [N];kappa [%];p [bar];F [N]"]
    rows += [
        f"{5 * (i // 5)};{1 + i % 5};{10 + i};{5 * (i // 5)};{1 + i % 5};{90 + i}"
        for i in range(20)
    ]
    path = written(tmp_path, "\n".join(rows))
    refused("pick='Muscle A'", pam.read_table, path)
    table, _ = quietly(pam.read_table, path, pick="Muscle B")
    assert table.force[:3] == pytest.approx([90, 91, 92])


def test_blocks_below_each_other_take_their_titles(tmp_path: Path) -> None:
    text = "".join(
        f"contraction {k} %\np;F\nbar;N\n"
        + "".join(f"{i};{(100 - k) * i}\n" for i in range(1, 7))
        + "\n"
        for k in (0, 5, 10)
    )
    table = pam.read_table(written(tmp_path, text))
    assert table.contraction == pytest.approx(np.repeat([0, 0.05, 0.1], 6))
    assert table.pressure == pytest.approx(np.tile(np.arange(1, 7) * 1e5, 3))
    assert table.force[-1] == pytest.approx(540)


def test_a_last_command_holds_to_the_end_of_the_record(tmp_path: Path) -> None:
    orders = {"time": [0.0, 0.5], "p_set [bar]": [1.0, 2.0]}
    path = topics(tmp_path, rig={"time": T, "p [bar]": BAR}, orders=orders)
    record, _ = quietly(pam.read_record, path)
    assert record.t == pytest.approx(T)
    assert record["p_set"] == pytest.approx(np.where(T >= 0.5 - 1e-9, 2e5, 1e5))


def test_messages_that_cannot_be_decoded_are_named(tmp_path: Path) -> None:
    path = tmp_path / "proto.mcap"
    with mcap_writer(path) as writer:
        schema = writer.register_schema("rig.P", "protobuf", b"\x00")
        channel = writer.register_channel("/p", "protobuf", schema)
        writer.add_message(channel, log_time=1, publish_time=1, data=b"\x08\x01")
    refused("protobuf, which is not read", pam.read_record, path)


@pytest.mark.parametrize(
    ("name", "content", "package", "extra"),
    [
        ("a.tdms", b"TDSm", "nptdms", "files"),
        ("a.bag", b"#ROSBAG V2.0", "rosbags", "files"),
        ("a.mcap", b"\x89MCAP", "mcap", "files"),
        ("a.h5", b"\x89HDF\r\n\x1a\n", "h5py", "hdf5"),
        ("a.xlsx", b"PK\x03\x04", "openpyxl", "excel"),
    ],
)
def test_a_reader_that_is_not_installed_is_named_with_the_way_round_it(
    name, content, package, extra, tmp_path, monkeypatch
):
    for module in [m for m in sys.modules if m.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(content + bytes(40))
    words = rf"{package}.*pip install 'pam_ocp\[{extra}\]', or save the table as CSV"
    refused(words, pam.read_record, tmp_path / name)


def test_columns_in_units_that_are_not_known_are_left_out_and_named() -> None:
    source = {"time [s]": T, "p [bar]": BAR, "T [°C]": 20 + BAR}
    record, words = quietly(pam.read_record, source)
    assert record.names == ("p",)
    assert "'T [°C]' left out" in words
    assert look(source).ok


def test_words_of_a_wrong_encoding_can_be_said(tmp_path: Path) -> None:
    path = tmp_path / "r.csv"
    path.write_bytes(("время [с];давление [кПа]\n" + lines(T, 100 * BAR, cut=";")).encode("cp866"))
    with pytest.raises(InputError):
        pam.read_record(path)
    refused("encoding = 'klingon'", pam.read_record, path, encoding="klingon")
    columns = ["time [s]", "p [kPa]"]
    record = pam.read_record(path, encoding="cp866", skip=1, columns=columns)
    assert record["p"] == pytest.approx(BAR * 1e5, rel=1e-5)


@pytest.mark.parametrize(
    "head",
    ["Pressure setpoint", "Set pressure", "Commanded pressure", "p_target", "Soll-Druck"],
)
def test_a_pressure_that_was_asked_for_is_a_command(head: str) -> None:
    plant = pam.HangingLoad("DMSP-20-400N", mass=20.0)
    source = {"t [s]": T, "Pressure actual [bar]": BAR, f"{head} [bar]": BAR + 0.5}
    record = pam.read_record(source, plant)
    assert record["muscle.pressure"] == pytest.approx(1e5 * BAR)
    assert record["muscle.command"] == pytest.approx(1e5 * BAR + 5e4)
    source = {"t [s]": T, "Pressure actual [bar]": BAR, "Reference pressure [bar]": 0 * T + 1.013}
    assert pam.read_record(source, plant).names == ("muscle.pressure",)  # of the air, perhaps


def test_the_clock_of_a_capture_has_the_unit_that_it_states(tmp_path: Path) -> None:
    clock = {"Name": "Time", "Unit": "ms", "Data": 1e3 * T}
    signal = {"Name": "p", "Unit": "bar", "Data": BAR}
    for unit_of_clock, file in (("ms", "ms.mat"), ("", "none.mat")):
        scale = 1.0 if unit_of_clock else 1e-3
        capture = {"X": {**clock, "Unit": unit_of_clock, "Data": scale * clock["Data"]}}
        scipy.io.savemat(tmp_path / file, {"capture": {**capture, "Y": signal}})
        assert pam.read_record(tmp_path / file).t == pytest.approx(T)


def test_packed_numbers_are_unpacked_by_the_factors_beside_them(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    packed = np.round((BAR - 1) / 1e-4).astype("i4")
    packed[7] = -1
    with h5py.File(tmp_path / "packed.h5", "w") as file:
        file["t"] = T
        data = file.create_dataset("p", data=packed)
        data.attrs.update(units="bar", scale_factor=1e-4, add_offset=1.0, _FillValue=-1)
    beside = {"name": "p", "unit": "bar", "scale_factor": 1e-4, "add_offset": 1.0}
    values = [None if v < 0 else int(v) for v in packed]
    channels = [{"name": "t", "unit": "s", "data": list(T)}, {**beside, "data": values}]
    (tmp_path / "packed.json").write_text(json.dumps(channels))
    for name in ("packed.h5", "packed.json"):
        record, words = quietly(pam.read_record, tmp_path / name)
        assert record["p"] == pytest.approx(np.delete(1e5 * BAR, 7), abs=5.1)
        assert "1" in words
    (tmp_path / "packed.json").write_text(
        json.dumps([channels[0], {**channels[1], "scale_factor": "two"}])
    )
    refused("scale_factor", pam.read_record, tmp_path / "packed.json")


def test_names_that_say_no_quantity_take_that_of_their_group(tmp_path: Path) -> None:
    plant = pam.HangingLoad("DMSP-20-400N", mass=20.0)
    head = "Time;Position;Pressure;\n;;actual;setpoint\ns;mm;bar;bar\n"
    path = written(tmp_path, head + lines(T, 10 + BAR, BAR, BAR + 0.5, cut=";"))
    record = pam.read_record(path, plant)
    assert record["x"] == pytest.approx(1e-3 * (10 + BAR))
    assert record["muscle.pressure"] == pytest.approx(1e5 * BAR)
    assert record["muscle.command"] == pytest.approx(1e5 * BAR + 5e4)


def test_a_record_without_input_names_the_columns_that_may_be_one() -> None:
    plant = pam.HangingLoad("DMSP-20-400N", mass=20.0)
    source = {"t [s]": T, "x [mm]": 10 + BAR, "valve 7 [V]": BAR, "remark": ["a"] * len(T)}
    left_out = r"as an input \(muscle\.command\), and 'valve 7 \[V\]' left out"
    with pytest.warns(ReadingWarning, match=left_out):
        assert pam.read_record(source, plant).names == ("x",)
    source["p set [bar]"] = BAR
    _, words = quietly(pam.read_record, source, plant)
    assert words == ""


def test_a_factor_beside_values_that_nobody_says_to_apply_is_told(tmp_path: Path) -> None:
    clock = {"name": "t", "unit": "s", "data": list(T)}
    channel = {"name": "p", "unit": "bar", "data": list(BAR), "scale": 2.0, "offset": 0}
    (tmp_path / "run.json").write_text(json.dumps({"channels": [clock, channel]}))
    record, words = quietly(pam.read_record, tmp_path / "run.json")
    assert record["p"] == pytest.approx(1e5 * BAR)
    assert "p: scale = 2 beside its values taken as applied" in words
    plain = {**channel, "scale": 1.0}
    (tmp_path / "run.json").write_text(json.dumps({"channels": [clock, plain]}))
    assert quietly(pam.read_record, tmp_path / "run.json")[1] == ""

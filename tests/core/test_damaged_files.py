"""Damaged files are answered by one sentence; files that would never end are refused at once."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from conftest import refused
from fuzz import outcome, outcomes, readers

import pam_ocp as pam
from pam_ocp.core.errors import InputError
from pam_ocp.core.files import MOST_DEPTH, read_toml, reading


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> list[object]:
    return readers(tmp_path_factory.mktemp("sound"))


@pytest.mark.slow
def test_every_sound_file_is_read(sound):
    found = [outcome(reader, "none", reader.file) for reader in sound]
    assert [f for f in found if f.kind != "read"] == []


@pytest.mark.slow
def test_a_damaged_file_is_read_or_answered_by_one_sentence_that_names_it(sound, tmp_path):
    assert [f for f in outcomes(sound, 400, 20, tmp_path) if f.failed] == []


def test_a_table_of_50_000_columns_is_refused(tmp_path):
    file = tmp_path / "wide.csv"
    file.write_text(",".join(f"c{i}" for i in range(50_000)) + "\n" + ",".join("1" * 50_000) + "\n")
    for read in (lambda f: pam.read_table(f, rest_length=0.3), pam.fitting.read_record):
        refused(r"wide.csv has 50000 columns, more than the 2000", read, file)


def test_a_sheet_of_nine_million_cells_is_refused_before_it_is_unpacked(tmp_path):
    file = tmp_path / "large.xlsx"
    row = "<row>" + "<c><v>1</v></c>" * 3000 + "</row>"
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/worksheets/sheet1.xml", f"<sheetData>{row * 3000}</sheetData>")
    assert file.stat().st_size < 1e6
    with pytest.raises(InputError, match=r"large.xlsx unpacks to .* save the table as CSV"):
        pam.read_table(file, rest_length=0.3)


def test_a_sheet_whose_last_cell_is_far_away_is_refused(tmp_path):
    from openpyxl import Workbook

    book = Workbook()
    book.active["A1"], book.active["XFD1048576"] = "force [N]", 1.0
    book.save(tmp_path / "far.xlsx")
    with pytest.raises(InputError, match=r"far.xlsx has \d+ columns|far.xlsx has more than the"):
        pam.read_table(tmp_path / "far.xlsx", rest_length=0.3)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (".".join("a" * 50_000) + " = 1", "a key has 50000 parts"),
        ("x = { " + ".".join("a" * 50_000) + " = 1 }", "a key has 50000 parts"),
        ("x = " + "[" * 100_000, "nested 100000 deep"),
        ("x = 1\n" * 2**18, "has 2 MiB, more than the 1 allowed"),
    ],
)
def test_a_toml_file_that_asks_for_too_much_is_refused(text, words, tmp_path):
    (tmp_path / "a.toml").write_text(text)
    refused(words, read_toml, tmp_path / "a.toml")


def test_the_mark_that_editors_of_windows_put_first_is_no_content(tmp_path):
    file = tmp_path / "plan.toml"
    file.write_text("minimise = 'time'", "utf-8-sig")
    assert read_toml(file) == {"minimise": "time"}


def test_brackets_and_dots_within_texts_are_no_depth(tmp_path):
    text = "[" * 100 + "." * 100
    file = tmp_path / "a.toml"
    file.write_text(f'a = "{text}"\nb = """\n{text}\n"quoted" """\nc = \'{text}\'  # {text}\n')
    assert read_toml(file) == {"a": text, "b": f'{text}\n"quoted" ', "c": text}


def test_json_that_is_nested_too_deeply_is_refused(tmp_path):
    file = tmp_path / "muscle.json"
    for text in ("[" * 100_000, "[" * (MOST_DEPTH + 1) + "]" * (MOST_DEPTH + 1)):
        file.write_text(text)
        refused(r"muscle.json cannot be read .* nested \d+ deep", pam.load_muscle, file)
    file.write_text(json.dumps({"format": "[" * 1000}))
    refused("its 'format' must be", pam.load_muscle, file)


def test_an_archive_that_unpacks_to_more_than_is_allowed_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("pam_ocp.core.files.MOST_UNPACKED", 10_000)
    monkeypatch.setattr(pam.core.files.require_unpacked, "__defaults__", (10_000,))
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(10_000))
    refused("unpacks to 1 parts", pam.fitting.read_record, tmp_path / "a.npz")


def test_devices_folders_and_names_that_no_file_has_are_refused(tmp_path):
    for path, words in (
        ("/dev/zero", "is a device"),
        (tmp_path, "is a folder"),
        ("a\0.csv", "no such file|unknown table file"),
    ):
        refused(words, pam.fitting.read_record, path)
        refused(words, read_toml, path)


def test_objects_in_an_npz_file_are_never_unpickled(tmp_path):
    class Harm:
        def __reduce__(self):
            return (Path(tmp_path / "harm").touch, ())

    np.savez(tmp_path / "a.npz", x=np.array([Harm()], dtype=object), t=np.arange(3.0))
    for read in (pam.Trajectory.load, pam.fitting.read_record):
        with pytest.raises(InputError):
            read(tmp_path / "a.npz")
    assert not (tmp_path / "harm").exists()


def test_an_error_that_no_damage_explains_keeps_its_cause(tmp_path):
    class Strange(Exception):
        pass

    with (
        pytest.raises(InputError, match=r"a.x cannot be read as a y: Strange.*report") as caught,
        reading(tmp_path / "a.x", "a y", "mend it"),
    ):
        raise Strange
    assert isinstance(caught.value.__cause__, Strange)


@pytest.mark.parametrize("name", ["hsllib", "output_file", "option_file_name", "pardisolib"])
def test_options_of_solvers_that_load_libraries_or_write_files_need_consent(name, tmp_path):
    from fuzz import PROBLEM

    file = tmp_path / "problem.toml"
    file.write_text(PROBLEM.replace("max_iter = 50", f'{name} = "./evil.so"'))
    refused(rf"options.{name} may load a library.*--allow-code", pam.planning.load_problem, file)
    assert pam.planning.load_problem(file, allow_code=True)[1]["options"] == {name: "./evil.so"}

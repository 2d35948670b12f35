"""pam-ocp look says what is understood, and its exit code whether that suffices."""

import json
from argparse import Namespace

import pytest

from pam_ocp.cli.main import _parser, main
from pam_ocp.cli.output import command_words

RIG = "Druck;Länge;Kraft\nbar;mm;N\n2,0;300;1.021,7\n4,0;285;1.689,2\n6,0;255;1.512,9\n"


@pytest.fixture
def rig(tmp_path):
    file = tmp_path / "rig.csv"
    file.write_text(RIG, "utf-8")
    return str(file)


def test_what_must_be_said_is_asked_for_with_exit_code_1_and_then_read(rig, capsys):
    assert main(["look", rig]) == 1
    assert "NOT READ YET" in capsys.readouterr().out
    assert main(["look", rig, "--rest-length", "300 mm"]) == 0
    shown = capsys.readouterr().out
    assert "decimal comma" in shown
    assert "reads as: ForceTable(3 cells" in shown
    assert "call: pam.read_table(" in shown


def test_json_holds_the_same(rig, capsys):
    assert main(["look", rig, "--rest-length", "0.3", "--json"]) == 0
    (view,) = json.loads(capsys.readouterr().out)
    assert view["kind"] == "table"
    assert [c["meaning"] for c in view["columns"]] == ["pressure", "length", "force"]
    assert [c["unit"] for c in view["columns"]] == ["bar", "mm", "N"]
    assert view["columns"][2]["high"] == pytest.approx(1689.2)


def test_columns_units_and_several_files_are_taken(tmp_path, capsys):
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text("0.4 0.00 195\n1.15 0.05 804\n2.15 0.10 1301\n")
    said = ["--columns", "pressure [V]", "contraction", "force [N]"]
    said += ["--units", "pressure=V * 2 bar/V - 0.3 bar"]
    assert main(["look", str(tmp_path), *said]) == 0
    shown = capsys.readouterr().out
    assert shown.count("p 0.5..4 bar") == 2
    assert main(["look", str(tmp_path / "a.txt")]) == 1
    assert "as --columns 'length [mm]' 'pressure [bar]'" in capsys.readouterr().out


def test_what_cannot_be_meant_is_one_sentence_with_exit_code_2(tmp_path, rig, capsys):
    for said in (["nothing.csv"], [rig, "--units", "bar"], [rig, "--columns", "a=b", "c"]):
        assert main(["look", *said]) == 2
        assert capsys.readouterr().err.count("\n") == 1


def test_fit_takes_the_same_words(tmp_path, capsys):
    from pam_ocp.fitting import read_table

    table = read_table("DMSP-20-300_static.csv", rest_length=0.3)
    rows = [
        f"{p / 2e5} {k} {f}"
        for p, k, f in zip(table.pressure, table.contraction, table.force, strict=True)
    ]
    file = tmp_path / "rig.dat"
    file.write_text("\n".join(rows))
    said = ["--columns", "pressure [V]", "kappa", "F [N]", "--units", "pressure=V * 2 bar/V"]
    assert main(["fit", str(file), *said]) == 0
    assert "6.196" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("python", "shell"),
    [
        ("choose one with sheet='M 3'", "choose one with --sheet 'M 3'"),
        ("give units={'pressure': 'kPa', 'force': ...}", "give --units pressure=kPa force=..."),
        ("say columns=['x [mm]', 'p [bar]']", "say --columns 'x [mm]' 'p [bar]'"),
        ("missing=[9999, 'off'] or missing=None", "--missing 9999 off or --missing"),
        ("  call: read_table('a', sheet='M3')", "  call: read_table('a', sheet='M3')"),
        ("law='all', table.floor='zero'", "law='all', table.floor='zero'"),
    ],
)
def test_messages_name_options_of_the_command(python, shell):
    parser = _parser()
    assert command_words(python, Namespace(parser=parser, command="look")) == shell
    assert command_words(python, Namespace(parser=parser, command="components")) == python


def test_a_sheet_is_asked_for_by_its_option(tmp_path, capsys):
    book = pytest.importorskip("openpyxl").Workbook()
    for sheet in (book.active, book.create_sheet("M2")):
        for row in (("p [bar]", "kappa [%]", "F [N]"), (1, 2, 30), (2, 2, 60), (3, 4, 80)):
            sheet.append(row)
    book.active.title = "M1"
    book.save(tmp_path / "rig.xlsx")
    assert main(["look", str(tmp_path / "rig.xlsx")]) == 1
    assert "choose one with --sheet M1" in capsys.readouterr().out

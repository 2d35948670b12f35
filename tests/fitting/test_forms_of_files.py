"""Forms of files that say where their numbers begin, or what they are, in a way of their own."""

import json
from pathlib import Path

import pytest

import pam_ocp as pam

T = [0.0, 0.1, 0.2, 0.3, 0.4]
PASCAL = [1e5, 1.5e5, 2e5, 2.5e5, 3e5]
BAR = [1.0, 1.5, 2.0, 2.5, 3.0]
FORCE = [10.0, 20.0, 30.0, 40.0, 50.0]
ROWS = "".join(f"{t},{p},{f}\n" for t, p, f in zip(T, BAR, FORCE, strict=True))
NOTED = ROWS.replace("\n", ",1\n")
SENSORS = {"pressure": {"t": T, "samples": PASCAL}, "force": {"t": T, "samples": FORCE}}
UNITS = {"time": "s", "pressure": "bar", "force": "N"}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (
            "rows of properties above the names.csv",
            f"t0,0,0\ndt,0.1,0.1\ntime [s],pressure [bar],force [N]\n{ROWS}",
        ),
        ("a row of units with a word.csv", f"time,pressure,force,note\ns,bar,N,text\n{NOTED}"),
        ("a sensor each.json", json.dumps({"sensors": SENSORS})),
        (
            "units beside.json",
            json.dumps({"units": UNITS, "time": T, "pressure": BAR, "force": FORCE}),
        ),
    ],
)
def test_records_in_forms_of_their_own_are_read(name, text, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_text(text)
    (record,) = pam.read_records(path)
    assert record.t == pytest.approx(T)
    assert record["pressure"] == pytest.approx(PASCAL)
    assert record["force"] == pytest.approx(FORCE)


def test_a_pivot_takes_its_quantities_from_the_words_above_it(tmp_path: Path) -> None:
    path = tmp_path / "pivot.csv"
    head = "Force [N] over pressure [bar] and contraction [%]"
    path.write_text(f"{head}\n,1,2,3\n0,100,200,300\n5,80,170,260\n10,50,130,210\n")
    table = pam.read_table(path)
    assert table.pressure[:3] == pytest.approx([1e5, 2e5, 3e5])
    assert sorted(set(table.contraction)) == pytest.approx([0.0, 0.05, 0.1])
    assert table.force[:3] == pytest.approx([100.0, 200.0, 300.0])

"""Tables whose cells say their units: ``1 bar``, ``300mm``, ``12,5 %``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.core.errors import InputError
from pam_ocp.fitting.tables.cells import parted

ROWS = [(1.0, 300.0, 200.0), (2.0, 300.0, 500.5), (2.0, 290.0, 400.0), (3.0, 290.0, 600.25)]


def text(separator: str = ";", form: str = "{} bar;{} mm;{} N", head: str = "p;l;F") -> str:
    rows = [form.format(*row) for row in ROWS]
    return "\n".join([head, *rows]).replace(";", separator) + "\n"


@pytest.mark.parametrize(
    "content",
    [
        text(),
        text(","),
        text("\t"),
        text(form="{}bar;{}mm;{}N"),
        text().replace(".", ","),
        text(form="{} bar;{};{} N", head="p;l [mm];F"),
        "Rig 5; 20 °C\n" + text(),
    ],
)
def test_they_are_read_at_once(content: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.csv"
    path.write_text(content)
    table = pam.read_table(path, rest_length=0.3)
    np.testing.assert_allclose(table.pressure, [1e5 * r[0] for r in ROWS])
    np.testing.assert_allclose(table.contraction, [1 - r[1] / 300 for r in ROWS], atol=1e-12)
    np.testing.assert_allclose(table.force, [r[2] for r in ROWS])


def test_mappings_and_records_too(tmp_path: Path) -> None:
    columns = {
        "p": [f"{r[0] * 100} kPa" for r in ROWS],
        "kappa": [f"{100 * (1 - r[1] / 300)} %" for r in ROWS],
        "F": [f"{r[2] / 1000} kN" for r in ROWS],
    }
    table = pam.read_table(columns)
    np.testing.assert_allclose(table.pressure, [1e5 * r[0] for r in ROWS])
    np.testing.assert_allclose(table.contraction, [1 - r[1] / 300 for r in ROWS], atol=1e-12)
    np.testing.assert_allclose(table.force, [r[2] for r in ROWS])
    path = tmp_path / "run.csv"
    path.write_text("t,q\n" + "".join(f"{10 * k} ms,{k * k} deg\n" for k in range(6)))
    record = pam.read_record(path, columns={"q": "q"})
    np.testing.assert_allclose(record.t, 0.01 * np.arange(6))
    np.testing.assert_allclose(record["q"], np.deg2rad(np.arange(6) ** 2))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (text().replace("2.0 bar;290", "200 kPa;290"), "mixes units: bar in line 2, kPa in line 4"),
        (text(head="p [kPa];l;F"), r"mixes units: kPa in the header, bar in line 2"),
        (text().replace("200.0 N", "200.0 mm"), "mixes units: mm in line 2, N in line 3"),
    ],
)
def test_mixed_units_are_refused(content: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "rig.csv"
    path.write_text(content)
    with pytest.raises(InputError, match=words):
        pam.read_table(path, rest_length=0.3)


def test_what_is_no_number_with_a_unit() -> None:
    assert parted("1.5 bar") == ("1.5", "bar")
    assert parted("-3e2kPa") == ("-3e2", "kPa")
    for cell in (
        "2024-01-05",
        "12:30",
        "1e5",
        "1,234.5",
        "muscle 3",
        "3 muscles",
        "bar",
        3.0,
        None,
    ):
        assert parted(cell) is None, cell

"""Files as rigs write them are read right at once, or with the keyword that a sentence asks for."""

from __future__ import annotations

import ast
import re
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import refused
from rig_files import FROM_SENTENCE, REST, Case, all_cases, mckibben, ramp_rows

import pam_ocp as pam
from pam_ocp.core.errors import InputError
from pam_ocp.fitting import ReadingWarning, look
from pam_ocp.fitting.tables.ramps import _scatter


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> list[Case]:
    return all_cases(tmp_path_factory.mktemp("rig"))


def read(case: Case) -> tuple[Any, list[str]]:
    """(what is read, the warnings), after the answer to the sentence where one is due."""
    function = pam.read_table if case.kind == "table" else pam.read_record
    options = dict(case.given)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        if case.asks:
            with pytest.raises(InputError) as caught:
                function(case.source, **options)
            options[case.asks] = answer(case, str(caught.value))
        result = function(case.source, **options)
    assert all(issubclass(w.category, ReadingWarning) for w in warned)
    return result, [str(w.message) for w in warned]


def answer(case: Case, sentence: str) -> Any:
    """What the sentence says to give, or what a user knows who is asked for it."""
    said = re.search(rf"{case.asks}=(\{{[^}}]*\}}|\([^)]*\)|\[[^]]*\]|'[^']*')", sentence)
    assert said, sentence
    return ast.literal_eval(said[1]) if case.answer == FROM_SENTENCE else case.answer


@pytest.mark.slow
def test_every_file_of_the_folder_is_read_right(cases: list[Case]) -> None:
    assert len(cases) > 60
    for case in cases:
        result, said = read(case)
        for name, expected in case.truth.items():
            at = getattr(result, name) if name == "t" or case.kind == "table" else result[name]
            size = np.max(np.abs(expected))
            words = f"{case.name}: {name}"
            np.testing.assert_allclose(at, expected, rtol=0, atol=case.rtol * size, err_msg=words)
        assert any(case.says in words for words in said) if case.says else not said, case.name


@pytest.mark.slow
def test_a_preview_of_every_file_says_the_same_as_reading_it(cases: list[Case]) -> None:
    for case in cases:
        options = case.given | ({"kind": "record"} if case.kind == "record" else {})
        if case.asks:
            try:
                seen = look(case.source, **options)
                sentence = seen.problem
            except InputError as error:
                sentence = str(error)
            options[case.asks] = answer(case, sentence)
        views = look(case.source, **options)
        assert views.ok, f"{case.name}: {views}"
        for view in views if isinstance(views, tuple) else (views,):
            assert view.call.startswith("pam.read_")
            assert {"pressure", "p"} & {c.meaning for c in view.columns}
            assert view.reads_as in str(view)


SEEDS = range(40)
LANGUAGES = (
    ("length", "pressure", "force"),
    ("Länge", "Druck Ist", "Zugkraft"),
    ("longueur", "pression", "force de traction"),
    ("l", "p_meas", "F"),
    ("Lunghezza", "Pressione", "Forza"),
)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_table_in_any_dialect_is_read_as_it_was_written(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(4, 40))
    kappa, bars = rng.uniform(0, 0.3, n), rng.uniform(0.2, 7, n)
    force = mckibben(1e5 * bars, kappa) + rng.uniform(1, 5, n)
    comma = bool(rng.integers(2))
    between = rng.choice(["\t", ";", "|", "  "] if comma else [",", "\t", ";", "|", "   "])
    names, units = list(rng.choice(LANGUAGES)), ["mm", "bar", "N"]
    blanks = between.strip(" ") == ""
    in_row = bool(rng.integers(2)) and not blanks
    joined = [f"{a.replace(' ', '_')} [{u}]" for a, u in zip(names, units, strict=True)]
    heads = names if in_row else joined
    if blanks:
        heads = [h.replace(" [", "_[") for h in heads]
    digits, grouped = int(rng.integers(3, 7)), bool(rng.integers(2)) and between != ","
    order = rng.permutation(3)

    def cell(value: float) -> str:
        written = f"{value:,.{digits}f}" if grouped else f"{value:.{digits}f}"
        return written.translate(str.maketrans(",.", ".,")) if comma else written

    titles = [["Rig", "7"], ["first series"], []][: int(rng.integers(4))]
    titles = [] if blanks else titles
    body = np.column_stack([300 * (1 - kappa), bars, force])
    rows = [*titles, [heads[i] for i in order], *([[units[i] for i in order]] if in_row else [])]
    rows += [[cell(row[i]) for i in order] for row in body.tolist()]
    file = tmp_path / f"rig{rng.choice(['.csv', '.txt', '.dat'])}"
    remark = str(rng.choice(["# a remark\n", "% a remark\n", ""]))
    encoding = str(rng.choice(["utf-8", "utf-8-sig", "cp1252", "utf-16"]))
    ending = str(rng.choice(["\n", "\r\n"]))
    file.write_bytes(
        (remark + "\n".join(map(between.join, rows))).replace("\n", ending).encode(encoding)
    )
    table = pam.read_table(file, rest_length=REST)
    tolerance = 10.0**-digits
    np.testing.assert_allclose(table.contraction, kappa, atol=tolerance / 300)
    np.testing.assert_allclose(table.pressure, 1e5 * bars, atol=1e5 * tolerance)
    np.testing.assert_allclose(table.force, force, atol=tolerance)


# ---- ramps and floors ----------------------------------------------------------------------------
def ramp_table(held: str, clip: float, **options: Any) -> pam.fitting.ForceTable:
    rows = ramp_rows(seed=3, clip=clip, held=held)
    columns = {"p [Pa]": rows["p"], "kappa": rows["kappa"], "F [N]": rows["F"]}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ReadingWarning)
        return pam.read_table(columns, **options)


@pytest.mark.parametrize(
    ("held", "rising", "falling"),
    [("contraction", "inflation", "deflation"), ("pressure", "shortening", "lengthening")],
)
def test_a_ramp_of_15_000_rows_becomes_cells_by_branch_level_and_repeat(held, rising, falling):
    table = ramp_table(held, clip=0.0)
    assert 200 < len(table) <= 400
    assert set(table.branches) == {rising, falling}
    assert set(table.run) == {"1", "2"}
    for branch, sign in ((rising, 1), (falling, -1)):
        part = table.of_branch(branch)
        shift = -0.02 * sign if held == "contraction" else 0.02 * sign
        truth = mckibben(part.pressure, part.contraction) * (1 + shift) + 2.0
        # the branches lie 4 % apart; the median leaves out the cells in which they turn
        assert np.median(np.abs(part.force - truth)) < 0.002 * table.force.max()
        inside = np.abs(part.force - truth) < 3 * part.error
        assert np.mean(inside) > 0.9


def test_errors_of_cells_count_that_neighbouring_rows_follow_each_other():
    rng = np.random.default_rng(11)
    for rho in (0.0, 0.5, 0.8):
        noise = rng.standard_normal(12_000)
        for i in range(1, noise.size):
            noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho**2) * noise[i]
        groups = [np.arange(i, i + 60) for i in range(0, 11_940, 60)]
        seen, wide, scatter = _scatter(groups, np.arange(12_000.0), noise)
        claimed = np.sqrt(np.mean(np.square(scatter))) * wide / np.sqrt(60)
        assert seen == pytest.approx(rho, abs=0.1)
        assert claimed == pytest.approx(np.std([noise[g].mean() for g in groups]), rel=0.15)


def test_a_fit_of_a_ramp_finds_the_law_and_that_its_errors_follow_each_other():
    table = ramp_table("contraction", clip=0.0).of_branch("inflation")
    fit = pam.fit_force(table, "polynomial-1-3")
    k = np.linspace(0.0, 0.2, 9)
    expected = 0.98 * mckibben(4e5, k) + 2.0
    found = [fit.predict(4e5, v).force for v in k]
    np.testing.assert_allclose(np.ravel(found), expected, rtol=0.02)


def test_the_floor_of_a_sensor_is_slack_and_not_a_force():
    table = ramp_table("contraction", clip=150.0)
    assert any("floor of the sensor, 150 N" in note for note in table.notes)
    assert table.slack.any()
    assert table.taut.force.min() > 150.0
    kept = ramp_table("contraction", clip=150.0, floor=None)
    assert not kept.slack.any()
    assert kept.force.min() == pytest.approx(150.0)


def test_a_table_measured_cell_by_cell_is_no_ramp():
    levels, bars = np.meshgrid(np.linspace(0, 0.2, 30), np.linspace(0.2, 6, 20), indexing="ij")
    p, k = 1e5 * bars.ravel(), levels.ravel()
    cells = {"p": p, "kappa": k, "F": mckibben(p, k)}
    table = pam.read_table(cells)
    assert len(table) == 600
    assert table.error is None
    order = np.random.default_rng(2).permutation(600)
    assert len(pam.read_table({n: v[order] for n, v in cells.items()})) == 600


def test_stairs_are_cells_of_their_settled_halves():
    bars = np.concatenate([np.arange(0.5, 6.1, 0.5), np.arange(5.5, 0.4, -0.5)])
    p = np.concatenate([np.repeat(1e5 * bars, 60)] * 3)
    k = np.repeat([0.0, 0.1, 0.2], p.size // 3)
    creep = 1 + 0.2 * np.exp(-np.tile(np.arange(60), p.size // 60) / 5)
    noise = np.random.default_rng(4).standard_normal(p.size)
    columns = {"p": p, "kappa": k, "F": mckibben(p, k) * creep + noise}
    with pytest.warns(ReadingWarning, match="6 stairs of pressure"):
        table = pam.read_table(columns)
    taut = table.taut
    np.testing.assert_allclose(taut.force, mckibben(taut.pressure, taut.contraction), atol=5.0)


# ---- units ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("said", "header", "volts", "pascal"),
    [
        ("V * 2 bar/V - 0.3 bar", "p [V]", 1.0, 1.7e5),
        ("V*2bar/V-0.3bar", "p", 1.0, 1.7e5),
        ("(V - 0.5 V) * 2.5 bar / V", "p [V]", 2.5, 5e5),
        ("V * 2 bar/V", "p [mV]", 1500.0, 3e5),
        ("2 bar/V", "p [V]", 1.5, 3e5),
        ("(mA - 4 mA) * 10 bar / (16 mA)", "p [mA]", 12.0, 5e5),
        ("0.1 bar + V * 1 bar/V + V^2 * 0.1 bar/V^2", "p [V]", 2.0, 2.5e5),
        ("digits * 5 V/1023 * 2 bar/V", "p", 511.5, 5e5),
        ("x / 4095 * 10 bar", "p [counts]", 2047.5, 5e5),
        ("V * 2 bar/V abs", "p [V]", 1.5, 3e5 - 101325.0),
        ("bar abs", "p [bar]", 3.0, 3e5 - 101325.0),
        ("psia", "p", 40.0, 40 * 6894.757293168 - 101325.0),
    ],
)
def test_a_calibration_gives_si_and_its_units_are_checked(said, header, volts, pascal):
    cells = {header: [volts, volts], "kappa": [0.0, 0.1], "F": [9.0, 5.0]}
    table = pam.read_table(cells, units={"pressure": said})
    assert table.pressure == pytest.approx([pascal, pascal], rel=1e-9)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ("V * 2", "gives something else than Pa"),
        ("V * 2 bar/V - 0.3", "adds things of different kinds"),
        ("V * U * 2 bar", "one reading"),
        ("2 bar + 1 bar", "names no reading"),
        ("V * (2 bar/V", "closing bracket"),
        ("V ** 99 * 1 bar", "power"),
        ("V * 2 bar/V - 0,3 bar", r"cannot be read at ',3 bar'"),
        ("__import__('os').system('true') * 1 bar", "cannot be read|unknown unit"),
        ("V * 3 smoot/V", "unknown unit"),
        ("V", "calibration"),
        ("counts", "calibration"),
    ],
)
def test_a_calibration_that_cannot_be_meant_is_refused(said, words):
    cells = {"p [V]": [1.0, 2.0], "kappa": [0.0, 0.1], "F": [9.0, 5.0]}
    refused(words, pam.read_table, cells, units={"pressure": said})


def test_the_weather_is_taken_off_an_absolute_pressure():
    columns = {"p_abs [kPa]": [98.0, 398.0], "kappa": [0.0, 0.1], "F": [0.0, 5.0]}
    assert pam.read_table(columns, ambient_pressure=98e3).pressure == pytest.approx([0.0, 3e5])
    vacuum = {**columns, "p_abs [kPa]": [0.0, 398.0]}
    refused("absolute, 101325 Pa taken off", pam.read_table, vacuum)


# ---- what is said --------------------------------------------------------------------------------
def test_a_preview_says_what_is_doubtful_before_anything_is_fitted(tmp_path):
    file = tmp_path / "rig.csv"
    cells = [f"{1 + 0.1 * i:.4g},{300 - i:.4g},{min(80 * i, 900)}" for i in range(60)]
    file.write_text("p [bar],length [mm],F [N]\n" + "\n".join(cells))
    view = look(file, rest_length=REST)
    assert any("bar abs" in doubt for doubt in view.doubts)
    assert any("saturated" in doubt for doubt in view.doubts)
    absolute = look(file, rest_length=REST, units={"pressure": "bar abs"})
    assert not any("bar abs" in doubt for doubt in absolute.doubts)


def test_headers_in_words_name_the_variables_of_a_plant(slide):
    rig = {"Zeit [s]": [0.0, 0.1, 0.2], "Weg [mm]": [1.0, 2.0, 3.0]}
    rig |= {"Druck 1 Ist [bar]": [1.0, 2.0, 3.0], "p2_soll [bar]": [3.0, 2.0, 1.0]}
    record = pam.read_record(rig, slide)
    assert set(record.names) == {"x", "muscle1.pressure", "muscle2.command"}
    np.testing.assert_allclose(record["muscle1.pressure"], [1e5, 2e5, 3e5])


@pytest.mark.parametrize(
    ("heads", "words"),
    [(("Richtung", "Zyklus"), ("auf", "ab")), (("sens", "essai"), ("gonflage", "dégonflage"))],
)
def test_branches_and_repeats_are_read_in_other_languages(heads, words):
    columns = {"kappa": [0.0, 0.0], "p_bar": [1.0, 2.0], "F_N": [9.0, 8.0]}
    table = pam.read_table({**columns, heads[0]: list(words), heads[1]: [1, 2]})
    assert table.branch == ("inflation", "deflation")
    assert table.run == ("1", "2")


def test_a_displacement_is_asked_for_the_rest_length():
    columns = {"displacement [mm]": [0.0, 15.0], "p_bar": [1.0, 2.0], "F_N": [9.0, 8.0]}
    refused(r"units=\{'length': '300 mm - x'\}", pam.read_table, columns, rest_length=REST)
    said = {"columns": {"length": "displacement [mm]"}, "units": {"length": "300 mm - x"}}
    assert pam.read_table(columns, rest_length=REST, **said).contraction == pytest.approx([0, 0.05])


def test_a_number_behind_a_name_is_no_unit():
    record = pam.read_record({"t": [0.0, 1.0], "Druck 1": [1.0, 2.0], "Druck 2": [3.0, 4.0]})
    assert record.names == ("druck_1", "druck_2")


def test_workbooks_are_read_without_pandas(cases, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", None)
    (case,) = (c for c in cases if c.name == "texts.xlsx")
    assert len(pam.read_table(case.source, rest_length=REST)) == 20

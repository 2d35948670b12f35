"""Workbooks: what stands in their cells, and that formulas follow when a parameter is changed."""

import re
import shutil
import subprocess
import sys

import casadi as ca
import numpy as np
import openpyxl
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.figures.fit_book import LONGEST, formula_of
from pam_ocp.muscles.law import LAWS
from pam_ocp.studies.steps.step import Job

BAR = 1e5


def calculated(formula, values):
    """What a spreadsheet makes of a formula of numbers and names; ^ is left associative there."""
    text = re.sub(r"(?<![<>])=(?!=)", "==", formula.removeprefix("="))
    text = text.replace("^", "**").replace("<>", "!=")
    called = {
        "EXP": np.exp,
        "SQRT": np.sqrt,
        "LN": np.log,
        "ABS": abs,
        "SIN": np.sin,
        "COS": np.cos,
        "TAN": np.tan,
        "ATAN": np.arctan,
        "ATAN2": lambda x, y: np.arctan2(y, x),
        "ASIN": np.arcsin,
        "ACOS": np.arccos,
        "TANH": np.tanh,
        "MIN": min,
        "MAX": max,
        "SIGN": np.sign,
        "INT": np.floor,
        "AND": lambda *a: all(a),
        "OR": lambda *a: any(a),
        "IF": lambda c, a, b: a if c else b,
    }
    return float(eval(text, {"__builtins__": {}}, {**called, **values}))


def through_cells(formula, values):
    """The result, each cell calculated from those before."""
    known = dict(values)
    texts = formula.written(lambda name: name)
    for name in formula.cells:
        known[name] = calculated(texts[name], known)
    return calculated(texts[""], known)


LAW_NAMES = sorted(LAWS)


@pytest.mark.parametrize("name", LAW_NAMES)
def test_the_formula_of_every_law_gives_the_force_of_the_law(name):
    rng = np.random.default_rng(LAW_NAMES.index(name))
    kind = LAWS[name]
    variables = kind.coefficient_variables()
    symbols = {n: ca.SX.sym(n) for n in ("p", "kappa", *(v.name for v in variables))}
    law = kind(**{v.name: symbols[v.name] for v in variables})
    expression = law.formula(symbols["p"], symbols["kappa"])
    formula = formula_of(expression, symbols)
    function = ca.Function("f", list(symbols.values()), [expression])
    met = 0
    for _ in range(40):
        values = {v.name: v.nominal * rng.uniform(0.5, 1.5) for v in variables}
        values = {"p": rng.uniform(0, 6) * BAR, "kappa": rng.uniform(0, 0.25), **values}
        expected = float(function(*values.values()))
        if np.isfinite(expected):
            assert through_cells(formula, values) == pytest.approx(expected, rel=1e-12, abs=1e-9)
            met += 1
    assert met > 10
    assert max(map(len, formula.written(lambda n: f"law_{n}").values())) < LONGEST


def test_signs_powers_and_brackets_bind_as_in_the_expression():
    rng = np.random.default_rng(3)
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    for expression in (
        -(x**2),
        (-x) ** 2,
        2 ** (x**y),
        (x**y) ** 2,
        x - (y - (x - y)),
        x / (y / (x / 3)),
        x / y * 2 - 3 * -x,
        ca.if_else(x > y, x**2, ca.sin(y)),
        ca.fmax(x, y) - ca.fabs(x - 1.5) * ca.atan2(x, y),
        ca.expm1(x) / ca.log1p(y) + ca.sqrt(x * y) + ca.floor(3 * x) + ca.sign(x - y),
        (x + y) * ca.exp(x * y) / (1 + ca.exp(x * y)) - ca.exp(x * y) ** -2,
    ):
        function = ca.Function("f", [x, y], [expression])
        formula = formula_of(ca.SX(expression), {"x": x, "y": y})
        for a, b in rng.uniform(0.2, 2.0, (20, 2)):
            met = through_cells(formula, {"x": a, "y": b})
            assert met == pytest.approx(float(function(a, b)), rel=1e-12), str(expression)


def test_what_spreadsheets_do_not_have_is_said():
    x = ca.SX.sym("x")
    refused("spreadsheets have no", formula_of, x / ca.SX.inf() + x * ca.SX.inf(), {"x": x})


@pytest.fixture
def fit(static_fit):
    return static_fit


def test_a_fits_workbook_holds_data_parameters_intervals_and_formulas(fit, tmp_path):
    book = openpyxl.load_workbook(fit.to_excel(tmp_path / "fit.xlsx"))
    assert book.sheetnames == ["Parameters", "Data", "Curves"]
    page = book["Parameters"]
    rows = {r[0].value: [c.value for c in r] for r in page.iter_rows() if r[0].value}
    for name, (low, high) in fit.intervals().items():
        assert rows[name][1] == pytest.approx(fit.law.values[name], rel=1e-14)
        met = [e if isinstance(e, float) else float(e.replace("∞", "inf")) for e in rows[name][3:5]]
        assert met == pytest.approx([low, high], rel=1e-14)
    assert rows["RMSE"][1].startswith("=SQRT(")
    data = book["Data"]
    measured = [data.cell(r, 3).value for r in range(5, data.max_row + 1)]
    assert sorted(measured) == pytest.approx(sorted(fit.table.force))
    assert "law_a3" in data["D5"].value
    assert len(data._charts) == 2
    assert set(book.defined_names) == {f"law_{n}" for n in fit.law.values}
    kept = openpyxl.load_workbook(tmp_path / "fit.xlsx", data_only=True)
    assert kept["Parameters"]["B14"].value == pytest.approx(fit.rmse)  # seen without calculating


def test_slack_points_of_the_law_lie_at_zero_and_do_not_count(fit, tmp_path):
    page = openpyxl.load_workbook(fit.to_excel(tmp_path / "fit.xlsx"), data_only=True)["Data"]
    rows = [[c.value for c in row[:6]] for row in page.iter_rows(min_row=5)]
    slack = [r for r in rows if not r[5]]
    assert len(slack) == fit.table.slack.sum()
    assert min(r[3] for r in slack) == 0.0
    assert all(r[4] == pytest.approx(r[2] - r[3]) for r in rows)
    rest = [r[4] for r in rows if r[5]]
    assert np.sqrt(np.mean(np.square(rest))) == pytest.approx(fit.rmse)


def test_numbers_are_seen_with_four_digits_and_pages_print_as_wide_as_they_are(fit, tmp_path):
    book = openpyxl.load_workbook(fit.to_excel(tmp_path / "fit.xlsx"))
    for page in book:
        assert page.page_setup.orientation == "landscape"
        assert page.sheet_properties.pageSetUpPr.fitToPage
        assert (page.page_setup.fitToWidth or 1, page.page_setup.fitToHeight) == (1, 0)
    assert book["Data"].print_title_rows == "$4:$4"
    assert book["Data"]["C5"].number_format == "0"  # up to 1654 N
    assert book["Parameters"]["B14"].number_format == "0.000"  # RMSE 6.196 N
    assert book["Parameters"]["C7"].number_format == "0.000E+00"  # 6.893e-05
    assert book["Parameters"]["C7"].value == fit.coefficients["a1"].stderr  # all digits


def test_the_same_fit_gives_the_same_bytes(fit, tmp_path):
    one, other = (fit.to_excel(tmp_path / n).read_bytes() for n in ("a.xlsx", "b.xlsx"))
    assert one == other


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("soffice") is None, reason="no LibreOffice (soffice) here")
def test_in_libreoffice_force_and_rmse_follow_a_changed_coefficient(fit, tmp_path):
    path = fit.to_excel(tmp_path / "fit.xlsx")
    book = openpyxl.load_workbook(path)  # which drops the values: LibreOffice must calculate them
    values = dict(fit.law.values)
    values |= {"a3": values["a3"] * 1.1, "a6": values["a6"] - 50.0}
    page = book["Parameters"]
    for row in page.iter_rows(min_row=7, max_row=12):
        row[1].value = values[row[0].value]
    book["Curves"]["A5"].value = 3.21
    book.save(path)
    profile = f"-env:UserInstallation=file://{tmp_path}/profile"
    command = ["soffice", profile, "--headless", "--convert-to", "ods", "--outdir", str(tmp_path)]
    subprocess.run([*command, str(path)], check=True, capture_output=True, timeout=300)
    back = ["soffice", profile, "--headless", "--convert-to", "xlsx:Calc MS Excel 2007 XML"]
    out = tmp_path / "back"
    subprocess.run(
        [*back, "--outdir", str(out), str(tmp_path / "fit.ods")],
        check=True,
        capture_output=True,
        timeout=300,
    )
    met = openpyxl.load_workbook(out / "fit.xlsx", data_only=True)
    law = type(fit.law)(**values)
    for name, rows in (("Data", range(5, 5 + len(fit.table))), ("Curves", range(5, 46))):
        page = met[name]
        for row in rows:
            p, kappa, force = (
                page.cell(row, 1),
                page.cell(row, 2),
                page.cell(row, 3 + (name == "Data")),
            )
            expected = float(law.tension(p.value * BAR, kappa.value / 100))
            if name == "Data" and not page.cell(row, 6).value:  # slack
                expected = max(0.0, expected)
            assert force.value == pytest.approx(expected, rel=1e-9, abs=1e-6)
    assert met["Curves"]["A45"].value == 3.21
    taut = fit.table.taut
    rest = taut.force - np.asarray(law.tension(taut.pressure, taut.contraction))
    assert met["Parameters"]["B14"].value == pytest.approx(np.sqrt(np.mean(rest**2)), rel=1e-9)


def test_motions_stand_in_display_units_with_a_chart_per_unit(load_motion, tmp_path):
    book = openpyxl.load_workbook(load_motion.to_excel(tmp_path / "m.xlsx"))
    page = book["Motion"]
    head = [c.value for c in page[1]]
    column = head.index("muscle.pressure [bar]") + 1
    met = [page.cell(r, column).value for r in range(2, page.max_row + 1)]
    assert met == pytest.approx(load_motion["muscle.pressure"] / BAR)
    units = {v.display_unit for v in load_motion.variables}
    assert len(page._charts) == len(units)
    assert book["Variables"].max_row == 1 + len(load_motion.variables)


def test_what_is_not_known_is_an_empty_cell_which_no_chart_shows_as_zero(tmp_path):
    t, gaps = np.linspace(0.0, 1.0, 5), [np.nan, 1e-3, np.inf, -2e-3, -np.inf]
    motion = pam.Trajectory(t, {"x": gaps}, [pam.Variable("x", "output", unit="m")])
    page = openpyxl.load_workbook(motion.to_excel(tmp_path / "m.xlsx"))["Motion"]
    assert [c.value for c in page["B"]] == ["x [mm]", None, 1, "∞", -2, "-∞"]


def test_a_plans_workbook_begins_with_its_verdict_and_another_ending_is_refused(
    short_plan, tmp_path
):
    book = openpyxl.load_workbook(short_plan.to_excel(tmp_path / "plan.xlsx"))
    assert book.sheetnames == ["Plan", "Motion", "Variables"]
    assert book["Plan"]["A2"].value == str(short_plan.verdict)
    refused(r"ends in \.xlsx", short_plan.to_excel, tmp_path / "plan.csv")
    refused("does not exist", short_plan.to_excel, tmp_path / "none" / "plan.xlsx")


def test_without_xlsxwriter_the_extra_is_named_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "xlsxwriter", None)
    motion = pam.Trajectory([0.0, 1.0], {"x": [0.0, 1.0]}, [pam.Variable("x", "output", unit="m")])
    sentence = r"xlsxwriter, which is not installed: pip install 'pam_ocp\[excel\]'"
    refused(sentence, motion.to_excel, tmp_path / "m.xlsx")
    assert main(["simulate", "HangingLoad", "--out", str(tmp_path / "m.xlsx")]) == 2
    assert re.search(sentence, capsys.readouterr().err)
    job = Job("motion", {}, {}, tmp_path, tmp_path)
    with pytest.warns(UserWarning, match=rf"motion/m\.xlsx is left out: .*{sentence}"):
        job.workbook(motion, "m.xlsx")
    assert list(tmp_path.iterdir()) == []

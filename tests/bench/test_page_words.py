"""Messages in the words of the page, and what pictures say to who cannot see them. No browser."""

import warnings
from pathlib import Path

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.bench import look
from pam_ocp.bench.jobs.data import look_at
from pam_ocp.bench.jobs.export import report
from pam_ocp.bench.jobs.muscle import fit_law
from pam_ocp.bench.made import World
from pam_ocp.bench.session import Session
from pam_ocp.bench.words import page_words
from pam_ocp.core.errors import PamError
from pam_ocp.muscles.laws.user_defined import law_named

FOLDER = Path("/home/anna/bench/20261127-1200-ab12cd34")


def shown(text, **names):
    return page_words(text, FOLDER, names)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("give units={'pressure': 'psi'}", "choose 'psi' as the unit of 'pressure' in Columns"),
        ("say units={'force': ...}", "choose the unit of 'force' in Columns"),
        ("Say columns={'length': 'l'}", "Choose 'length' in the menu 'is' of the column 'l'"),
        ("name another with columns={...}", "name another in the menu 'is' of a column"),
        ("give missing=[9999]", "name 9999 under Missing values"),
        ("check rest_length (in metres)", "check Rest length"),
        ("clock='cut'", "'cut at gaps' in the menu Clock"),
        ("give floor=None", "choose 'a force' in the menu Slack cells read"),
        ("choose one with sheet='A'", "choose one with 'A' in the field Sheet"),
        ("hold some with fixed=...", "hold some with the fields Known constants"),
        ("needs fixed={'radius': ...}", "needs radius in the fields Known constants"),
        ("use cyclic=True", "tick Returns"),
        ("or give platforms='native'", "or choose 'this machine' in the menu Runs on"),
        # a variable of the plant, and what no menu of the page offers, stay as they are
        ("muscle2.rest_length must be > 0", "muscle2.rest_length must be > 0"),
        ("units={'force': 'N - 5 N'}", "units={'force': 'N - 5 N'}"),
    ],
)
def test_a_remedy_names_the_field_of_the_page(said, expected):
    assert shown(said) == expected


def test_files_are_named_as_they_were_dropped_and_folders_are_not_told():
    stored = "0123456789-rig_1.csv"
    place = FOLDER / "files" / stored
    names = {stored: "rig 1.csv"}
    assert page_words(f"{place}: row 3", FOLDER, names) == "rig 1.csv: row 3"
    assert page_words(f"files/{stored} is empty", FOLDER, {}) == "rig_1.csv is empty"
    assert page_words("/srv/build/c/m.c: failed", FOLDER, {}) == "m.c: failed"
    assert page_words("0.5 N/m at 3 m/s", FOLDER, {}) == "0.5 N/m at 3 m/s"


TABLES = {
    "a length": "p [bar],length [mm],F [N]\n1,300,10\n2,290,20\n3,280,10\n",
    "a wrong unit": "pressure [Pa],contraction [%],F [N]\n1e9,1,10\n2e9,2,20\n3e9,3,10\n",
    "a mark": "p [bar],contraction [%],F [N]\n1,1,10\n2,2,off?\n3,3,10\n",
    "two of a kind": "p1 [bar],p2 [bar],contraction [%],F [N]\n1,1,1,10\n2,2,2,20\n3,3,3,10\n",
    "no force": "p [bar],contraction [%],q\n1,1,10\n2,2,20\n3,3,10\n",
    "clock": "t [s],p [bar],x [mm]\n0,1,1\n1,1,2\n0.5,1,3\n2,1,4\n3,1,4\n",
    "no unit": "p,contraction [%],F [N]\n100,1,1000\n200,2,2000\n300,3,1000\n",
}


@pytest.mark.parametrize("kind", TABLES)
def test_what_a_reader_says_of_a_dropped_file_holds_no_python_and_no_path(kind, tmp_path):
    session = Session.new(tmp_path)
    file = session.store("my rig.csv", TABLES[kind].encode())
    item = {"name": "my rig.csv", "file": file, "said": {}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            seen = look_at(lambda *said: None, World(session.folder), item)
            said = [seen["problem"], *seen["doubts"]]
        except PamError as error:
            said = [str(error)]
    assert any(said), "the file was meant to be doubtful"
    for text in said:
        words = page_words(text, session.folder, session.names)
        assert str(tmp_path) not in words
        assert file[:10] not in words
        for word in ("read_table", "read_record", "={", "=[", "='", "rest_length"):
            assert word not in words.replace("constants={", "")  # the page has no such field


# ---- fits ----------------------------------------------------------------------------------------
def slack_session(folder):
    """A session with the fit of a table whose slack cells read 6 N, not 0."""
    law = pam.muscle("DMSP-20-300").law
    rows = ["p [bar],contraction [%],F [N]"]
    for p in range(7):
        for kappa in range(0, 26, 5):
            tension = float(law.tension(1e5 * p, kappa / 100))
            rows.append(f"{p},{kappa},{max(tension, 0.0) + 6 + 0.1 * ((p + kappa) % 3):.2f}")
    session = Session.new(folder)
    file = session.store("my rig.csv", "\n".join(rows).encode())
    item = {"name": "my rig.csv", "file": file, "said": {"rest_length": 0.3}}
    return session, {"table": item, "law": "six-parameter", "fixed": {}}


def quietly(job, *arguments):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return job(lambda *said: None, *arguments)


def test_residuals_of_the_page_are_those_of_taut_cells(tmp_path):
    tab = pytest.importorskip("pam_ocp.bench.tabs.muscle")
    session, said = slack_session(tmp_path)
    found = quietly(fit_law, World(session.folder), said)
    law = law_named("six-parameter")(**{c["name"]: c["value"] for c in found["coefficients"]})
    residuals, rmse = tab._residuals(law, found)
    assert (len(residuals), rmse) == (found["n"], pytest.approx(found["rmse"]))
    assert len(residuals) < 42
    assert sum(len(group["x"]) for group in tab._measured(found)) == len(residuals)


def test_the_report_of_a_session_has_its_fit_under_the_name_of_the_dropped_file(tmp_path):
    session, said = slack_session(tmp_path)
    found = quietly(fit_law, World(session.folder), said)
    names = ("pressure_range", "contraction_range", "source")
    fitted = {"kind": "fit", **said, **{k: found[k] for k in names}, "name": "M"}
    fitted |= {"coefficients": {c["name"]: c["value"] for c in found["coefficients"]}}
    session.change("fit", muscle={**fitted, "rest_length": 0.3, "diameter": None})
    made = quietly(report, World(session.folder, session.state), "")
    page = (session.folder / "exports" / made["file"]).read_text("utf-8")
    assert "95 % interval" in page
    a3 = next(c for c in found["coefficients"] if c["name"] == "a3")
    assert f"{a3['low']:.4g} .. {a3['high']:.4g}" in page
    assert "fitted to my rig.csv" in page
    assert "Force table my rig.csv" in page


# ---- pictures ------------------------------------------------------------------------------------
def test_a_picture_says_how_many_curves_and_what_its_axes_span():
    x = np.linspace(0, 25, 11)
    curves = [look.line(x, 100 * i + x, f"{i} bar") for i in range(3)]
    band = look.band(x, 0 * x, 1e6 + x)
    figure = look.figure([band, *curves], "contraction [%]", "force [N]")
    said = "3 curves; contraction from 0 to 25 %; force from 0 to 225 N"
    assert look.described(figure) == said
    marked = look.figure([look.points([1, 2, None], [3, np.nan, 5])], "time [s]", "gain [1]")
    assert look.described(marked) == "3 points; time from 1 to 2 s; gain from 3 to 5"


def test_a_picture_of_panels_names_each_and_a_surface_its_height():
    panels = [look.line([0, 1], [2, 3]), look.line([0, 1], [4, 5], yaxis="y2")]
    figure = look.figure(panels, "time [s]", "a [mm]", yaxis2=look.axis("b [bar]"))
    assert look.described(figure).endswith("a from 2 to 3 mm; b from 4 to 5 bar")
    heights = {"type": "surface", "x": [0, 1], "y": [0, 2], "z": [[1, 2], [3, None]]}
    titles = zip("xyz", ("k [%]", "p [bar]", "force [N]"), strict=True)
    scene = {f"{n}axis": {"title": {"text": words}} for n, words in titles}
    said = look.described(look.figure([heights], scene=scene))
    assert said == "k from 0 to 1 %; p from 0 to 2 bar; force from 1 to 3 N"


def test_an_empty_picture_shows_words_in_place_of_axes():
    figure = look.blank(look.figure([], "x", "y"), "what will be there")
    assert figure["layout"]["annotations"][0]["text"] == "what will be there"
    assert not figure["layout"]["xaxis"]["visible"]

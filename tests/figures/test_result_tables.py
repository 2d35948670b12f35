"""Every result has a table, a picture, a text and files; surfaces; panels of one's own."""

import csv
import json
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np
import openpyxl
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.figures.tables import plot_table, save_result

METHODS = ("plot", "report", "save", "to_excel", "to_pandas")


@pytest.fixture(scope="module")
def results(static_fit, load_10kg, load_motion):
    plant, table = load_10kg, static_fit.table
    cases = [{"parameters": {"mass": m}} for m in (5.0, 6.0)]
    return [
        load_motion,
        load_motion.compare(load_motion),
        table,
        pam.fit_force(table, "three-element"),
        pam.compare_laws(table, ["three-element", "polynomial-1-3"]),
        plant.equilibrium({"muscle.pressure": 2e5}),
        pam.operating.equilibria(plant, {"muscle.pressure": 2e5}),
        pam.simulate_many(plant, cases, inputs={"muscle.command": 3e5}, duration=0.01),
        pam.load_study("DMSP-20-300", [5.0, 10.0], [2e5], duration=0.5),
    ]


@pytest.mark.slow
def test_every_result_has_a_picture_a_text_a_frame_and_a_workbook(results, tmp_path):
    for thing in results:
        assert all(callable(getattr(thing, m)) for m in METHODS)
        assert thing.plot().axes
        assert len(thing.to_pandas()) > 0
        assert isinstance(thing.report(), str)
        book = openpyxl.load_workbook(thing.to_excel(tmp_path / "a.xlsx"))
        assert book.worksheets[0].max_row > 1


def test_a_comparison_in_files_holds_its_numbers(load_motion, load_10kg, tmp_path):
    other = pam.simulate(load_10kg.with_values(mass=12.0), {"muscle.command": 3e5}, duration=0.05)
    found = load_motion.compare(other)
    rows = list(csv.DictReader(found.save(tmp_path / "c.csv").open()))
    said = json.loads(found.save(tmp_path / "c.json").read_text())["rows"]
    for d, row, plain in zip(found.deviations, rows, said, strict=True):
        assert row["variable"] == plain["variable"] == d.variable.name
        assert float(row["largest"]) == plain["largest"] == d.largest
        assert row["unit"] == plain["unit"] == d.variable.unit
    panel = found.plot().axes[0]  # of metres and pascals, none of them hidden by the others
    assert panel.get_xscale() == "log"
    assert [t.get_text() for t in panel.get_yticklabels()][:2] == ["x [m]", "v [m/s]"]
    assert "<h1>Comparison" in found.save(tmp_path / "c.html").read_text()
    assert found.save(tmp_path / "c.txt").read_text() == f"{found}\n"
    refused(r"end the name in one of \.csv", found.save, tmp_path / "c.docx")


def test_bars_of_several_units_show_negative_values_too():
    muscle = pam.muscle("DMSP-20-300")
    slide = pam.AntagonisticSlide(muscle, mass=2.0, pre_contraction=0.10)
    (ax,) = slide.equilibrium({"x": -0.01, "muscle1.pressure": 3e5}).plot().axes
    bars = dict(zip((t.get_text() for t in ax.get_yticklabels()), ax.patches, strict=True))
    assert ax.get_xscale() == "log"
    assert "orange: negative" in ax.get_xlabel()
    assert bars["x [mm]"].get_width() == pytest.approx(10.0)
    assert bars["x [mm]"].get_facecolor() != bars["muscle1.pressure [bar]"].get_facecolor()
    assert bars["muscle1.pressure [bar]"].get_width() == pytest.approx(3.0)


def test_numbers_of_numpy_are_numbers_in_a_table_of_text(tmp_path):
    @dataclass
    class Found:
        size: float
        count: int

    path = save_result(Found(np.float64(0.1), np.int64(3)), tmp_path / "found.csv")
    assert path.read_text() == "name,value\nsize,0.1\ncount,3\n"


def test_many_simulations_stand_in_a_frame_by_what_was_varied(results):
    many = results[7]
    frame = many.to_pandas()
    assert list(frame["mass"]) == [5.0, 6.0]
    assert list(frame["x.last"]) == [r["x"][-1] for r in many.results]


def test_a_panel_of_ones_own_is_drawn_into(load_motion):
    figure, (left, right) = plt.subplots(1, 2)
    assert load_motion.plot(["x"], ax=left) is figure
    (line,) = left.lines
    assert np.allclose(line.get_ydata(), 1e3 * load_motion["x"])
    assert "[mm]" in left.get_ylabel()
    pam.muscle("DMSP-20-300").plot(ax=right)
    assert len(right.lines) == 6
    refused("names of one unit", load_motion.plot, ax=left)
    plt.close(figure)


def test_the_surface_is_the_muscles_force():
    muscle = pam.muscle("DMSP-20-300")
    (ax, *_) = muscle.plot_surface().axes
    assert ax.get_zlabel() == "pulling force [N]"
    objects = pytest.importorskip("plotly.graph_objects")
    figure = muscle.plot_surface("stiffness", interactive=True)
    assert isinstance(figure, objects.Figure)
    (surface,) = figure.data
    p, kappa = surface.y[7][9] * 1e5, surface.x[7][9] / 100
    assert surface.z[7][9] == pytest.approx(muscle.stiffness(p, kappa) / 1e3)
    refused("choose 'force' or 'stiffness'", muscle.plot_surface, "colour")


def test_interactive_panels_hold_the_motion_in_display_units(load_motion):
    pytest.importorskip("plotly")
    figure = load_motion.plot(["x", "muscle.command"], interactive=True)
    drawn = {trace.name: trace for trace in figure.data}
    assert np.allclose(drawn["x"].y, 1e3 * load_motion["x"])
    assert np.allclose(drawn["muscle.command"].y, 3.0)


def test_a_ranking_in_tables_has_what_it_is_ranked_by(static_fit, tmp_path):
    found = pam.compare_laws(static_fit.table, ["three-element", "geometric", "polynomial-1-3"])
    assert found.laws[-1].problem  # of the one whose constants are not known
    frame = found.to_pandas()
    rows = list(csv.DictReader(found.save(tmp_path / "laws.csv").open()))
    for law, row, (_, line) in zip(found.laws, rows, frame.iterrows(), strict=True):
        for name in ("parameters", "rmse", "aic", "bic", "left_out_rmse"):
            value = getattr(law, name)
            assert line[name] == pytest.approx(value, nan_ok=True)
            assert float(row[name]) == pytest.approx(value, nan_ok=True)
    assert not any(len(head) > len("left_out.0.123456") for head in frame.columns)
    assert [a.get_xlabel() for a in found.plot().axes][:2] == ["parameters", "rmse"]


def test_a_picture_of_a_long_table_says_what_it_leaves_out():
    @dataclass
    class Part:
        a: float

    @dataclass
    class Found:
        parts: tuple[Part, ...]

    for count, title in ((40, ""), (41, "the first 40 of 41 rows")):
        figure = plot_table(Found(tuple(Part(float(i)) for i in range(count))))
        assert figure.axes[0].get_title(loc="left") == title
        assert len(figure.axes[0].patches) == 40
        plt.close(figure)

"""Figures for print: as wide as a column or a page, letters of 8 pt, nothing cut or covered."""

import itertools
import re

import pytest
from matplotlib.text import Text

import pam_ocp as pam
from pam_ocp.figures.trajectory import plot_bode

INCH = 25.4


@pytest.fixture(scope="module")
def things(static_fit, load_10kg, load_motion, short_plan):
    systems = {
        f"{p} bar": load_10kg.linearize(load_10kg.equilibrium({"muscle.pressure": f"{p} bar"}))
        for p in (2, 4)
    }
    return {
        "fit": static_fit.plot,
        "muscle": pam.muscle("DMSP-20-300").plot,
        "trajectory": load_motion.plot,
        "plan": short_plan.plot,
        "bode": lambda: plot_bode(systems, "x", "muscle_command"),
    }


def words(figure):
    """Texts that are seen, ticks among them, with their boxes [pixel]."""
    figure.draw_without_rendering()
    found = [t for t in figure.findobj(Text) if t.get_visible() and t.get_text().strip()]
    ticks = {
        t for ax in figure.axes for axis in (ax.xaxis, ax.yaxis) for t in axis.get_ticklabels()
    }
    return [(t, t.get_window_extent(), t in ticks) for t in found]


@pytest.mark.parametrize("name", ["fit", "muscle", "trajectory", "plan", "bode"])
@pytest.mark.parametrize(("width", "millimetres"), [("column", 88.0), ("page", 180.0)])
def test_every_letter_is_there_and_none_covers_another(things, name, width, millimetres):
    with pam.figures.for_paper(width):
        figure = things[name]()
    assert figure.get_figwidth() * INCH == pytest.approx(millimetres)
    assert figure.get_figheight() * INCH < 240  # a page
    seen = [w for w in words(figure) if w[1].width > 0]
    assert {t.get_fontsize() for t, _, _ in seen} == {8.0}
    inside = [(t, box) for t, box, tick in seen if not tick]
    for t, box in inside:
        assert -1 <= box.x0 < box.x1 <= figure.bbox.x1 + 1, t.get_text()
        assert -1 <= box.y0 < box.y1 <= figure.bbox.y1 + 1, t.get_text()
    for (one, a), (other, b) in itertools.combinations(inside, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        assert min(across) <= 1.5, (one.get_text(), other.get_text())


def test_lines_are_thin_and_told_apart_without_colour(things):
    with pam.figures.for_paper():
        figure = things["bode"]()
    figure.draw_without_rendering()
    lines = figure.axes[0].lines
    assert len({str(line.get_linestyle()) for line in lines}) == 2
    assert all(0.4 < line.get_linewidth() < 1.2 for line in lines)
    entries = figure.axes[0].get_legend().legend_handles
    assert [e.get_linestyle() for e in entries] == [line.get_linestyle() for line in lines]


@pytest.mark.slow
def test_letters_stay_letters_in_files_that_are_written_after_the_block(things, tmp_path):
    with pam.figures.for_paper("84 mm"):
        figure = things["fit"]()
    figure.savefig(tmp_path / "fit.svg")
    text = (tmp_path / "fit.svg").read_text("utf-8")
    assert "contraction [%]" in re.findall(r"<text[^>]*>([^<]*)</text>", text)
    assert f'width="{84 / INCH * 72:.6f}'[:12] in text
    figure.savefig(tmp_path / "fit.pdf")
    pdf = (tmp_path / "fit.pdf").read_bytes()
    assert b"/FontFile2" in pdf  # TrueType, whole glyphs
    assert b"/Type3" not in pdf


def test_outside_the_block_figures_are_for_a_screen(things):
    with pytest.raises(RuntimeError), pam.figures.for_paper(0.05):
        raise RuntimeError
    assert things["fit"]().get_figwidth() == 8.0


@pytest.mark.parametrize(
    ("width", "said"),
    [("5 mm", "'column'"), (3.0, "50 .. 500"), ("wide", "'page'"), ("5 bar", "'m'")],
)
def test_a_width_that_is_none_is_told(width, said):
    with pytest.raises(pam.InputError, match=f"width.*{said}"), pam.figures.for_paper(width):
        pass


def test_a_bode_diagram_has_the_units_of_its_system(things):
    assert "[m per Pa]" in things["bode"]().axes[0].get_ylabel()

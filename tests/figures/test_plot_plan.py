"""Pictures of plans: what is drawn is what the plan holds."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from conftest import pushed, refused
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

import pam_ocp as pam
from pam_ocp import Collocation, PlanError, Profile, Stop
from pam_ocp.figures.film import _film, animate_plan
from pam_ocp.figures.plan import panels_of, plot_costates
from pam_ocp.planning.active import limits_along
from pam_ocp.planning.studies.front import pareto
from pam_ocp.planning.studies.robust import robust_plan


def double_integrator(limit=1.0):
    return pushed(limit, x={"max": 10.0})


REST = [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]


@pytest.fixture(scope="module")
def quickest():
    """Bang-bang: 1 N on 1 kg over one metre, two seconds, switched at one second."""
    return pam.plan(double_integrator(), REST, rest=False, method=Collocation(10, 4))


@pytest.fixture(scope="module")
def slide_plan():
    slide = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"), stroke=0.016, feed=pam.feeds.Regulator(0.05, 6e5, 40e5)
    )
    stops = [{"x": -0.010}, Stop({"x": 0.010}, dwell=0.05)]
    return pam.plan(slide, stops, cyclic=True, method=Collocation(8), minimise="time")


def lines(ax, label=None):
    return [line for line in ax.get_lines() if label is None or line.get_label() == label]


def test_active_limits_are_those_of_bang_and_bang(quickest):
    active = {}
    for limit in limits_along(quickest):
        if limit.active.any():
            active[limit.label] = limit.t[limit.active]
    assert set(active) == {"u max", "u min"}
    assert (active["u max"].min(), active["u max"].max()) == (0.0, pytest.approx(1.0, abs=0.02))
    assert (active["u min"].min(), active["u min"].max()) == (
        pytest.approx(1.0),
        pytest.approx(2.0),
    )


def test_limits_of_phases_and_profiles_run_where_they_hold():
    corridor = Profile([0.0, 0.5, 1.0], [0.2, 0.2, 1.2])
    plan = pam.plan(
        double_integrator(50.0),
        [{"x": 0.0}, {"x": 0.15}, {"x": 1.0}],
        duration=0.5,
        minimise="effort",
        bounds={"x": (None, corridor)},
        method=Collocation(20, 3, "linear"),
        rest=False,
        phases=[None, pam.Phase(bounds={"v": (0.1, None)})],
    )
    limits = limits_along(plan)
    profiles = [one for one in limits if one.label == "x below its profile"]
    for limit in profiles:
        assert limit.column == "x"
        assert limit.limit == pytest.approx(corridor(limit.t), abs=1e-9)
    (floor,) = (one for one in limits if one.label == "v min")
    assert floor.t.min() == pytest.approx(0.5)
    assert np.all(floor.limit == 0.1)
    assert min(one.distance.min() for one in limits) > -1e-6


def test_the_figure_shows_motion_limits_stops_and_activity(quickest):
    figure = quickest.plot()
    position, velocity, force, chart = figure.axes
    motion = quickest.replay.trajectory
    (curve,) = lines(position, "x")
    assert curve.get_ydata() == pytest.approx(1e3 * motion["x"])  # millimetres
    (speed,) = lines(velocity, "v")
    assert np.max(speed.get_ydata()) == pytest.approx(1.0, rel=1e-6)
    rings = [line for line in lines(position) if line.get_marker() == "o"]
    assert sorted((float(r.get_xdata()[0]), float(r.get_ydata()[0])) for r in rings) == [
        (0.0, 0.0),
        (pytest.approx(2.0), pytest.approx(1000.0)),
    ]
    dashed = {float(v) for line in lines(force) for v in np.unique(line.get_ydata())}
    assert {-1.0, 1.0} <= {round(v, 9) for v in dashed}
    drawn = [path.get_extents() for row in chart.collections for path in row.get_paths()]
    bars = [(bar.x0, bar.x1) for bar in drawn]
    assert min(b[0] for b in bars) == 0.0
    assert max(b[1] for b in bars) == pytest.approx(2.0)
    assert [t.get_text() for t in chart.get_yticklabels()] == ["u min", "u max"]


def test_a_dark_style_has_light_lines(quickest):
    with plt.style.context("dark_background"):
        (line,) = quickest.plot().axes[0].get_lines()[:1]
    assert min(to_rgb(line.get_color())) > 0.5


def test_a_touched_limit_of_a_state_is_shaded():
    plan = pam.plan(
        double_integrator(10.0), REST, rest=False, bounds={"v": (None, 1.0)}, method=Collocation(20)
    )
    velocity = plan.plot().axes[1]
    (wide,) = (line for line in lines(velocity) if line.get_linewidth() > 5)
    y = np.asarray(wide.get_ydata(), float)
    assert np.nanmin(y) == pytest.approx(1.0, abs=2e-4)
    t = wide.get_xdata()[np.isfinite(y)]
    # at full push the limit of speed is reached after 0.1 s and left 0.1 s before the end
    assert (t.min(), t.max()) == (pytest.approx(0.1, abs=0.03), pytest.approx(1.0, abs=0.03))


def test_dwells_and_a_plan_from_a_file_are_drawn(slide_plan, tmp_path):
    figure = slide_plan.plot()
    assert [ax.get_ylabel().split("\n")[0] for ax in figure.axes[:5]] == [
        "position",
        "velocity",
        "pressure",
        "force",
        "stiffness",
    ]
    (shade,) = (p for p in figure.axes[0].patches if p.get_alpha() == 0.05)
    drawn = shade.get_path().get_extents(shade.get_patch_transform())
    assert drawn.width == pytest.approx(slide_plan.durations[1])
    assert "muscle1.pressure_rate max" in [t.get_text() for t in figure.axes[-1].get_yticklabels()]
    stored = pam.load_plan(slide_plan.save(tmp_path / "plan.npz"), slide_plan.plant)
    assert len(stored.plot().axes) == len(figure.axes)
    assert {one.label for one in limits_along(stored)} == {
        one.label for one in limits_along(slide_plan)
    }


def test_costates_are_drawn_per_shown_unit(slide_plan):
    position, velocity, pressure = plot_costates(slide_plan).axes
    (curve,) = lines(position, "x")
    assert curve.get_ydata() == pytest.approx(1e-3 * slide_plan.costates["x"])
    assert "mm" in position.get_ylabel()
    assert len(lines(pressure)) == 2 + 1 + 2  # two muscles, zero, two nodes
    assert lines(velocity, "v")


def test_a_front_and_a_robust_plan_are_drawn(slide_plan):
    stops, method = [{"x": -0.01}, {"x": 0.01}], Collocation(8)
    front = pareto(slide_plan.plant, stops, points=3, method=method)
    (ax,) = front.plot().axes
    assert lines(ax)[0].get_xdata() == pytest.approx(front.values[:, 0])
    draws = [{"mass": 2.2}, {"mass": 1.8}]
    robust = robust_plan(
        slide_plan.plant, stops, draws=draws, unseen=draws[:1], spread={"x": 0.005}, method=method
    )
    nominal, planned = robust.plot().axes
    assert lines(planned)[1].get_ydata() == pytest.approx(1e3 * robust.members.deviation("x")[0])
    assert "nominal plan" in nominal.get_title(loc="left")
    assert not any("draw" in n for names in panels_of(robust.plan).values() for n in names)
    assert isinstance(robust.plan.plot(), Figure)


# ---- films ---------------------------------------------------------------------------------------
def middle(patch):
    return np.asarray(patch.get_xy())[:4].mean(axis=0)


def test_the_slide_stands_where_the_plan_has_it(slide_plan):
    motion = slide_plan.replay.trajectory.at(np.linspace(0.0, slide_plan.duration, 9))
    figure, drawn = _film(slide_plan, motion, 1.0)
    stage = next(ax for ax in figure.axes if not ax.axison)
    body = next(p for p in stage.patches if p.get_zorder() == 4)
    spindles = [p for p in stage.patches if p.get_zorder() == 3]
    colours = []
    for i in (0, 4):
        for draw in drawn:
            draw(i)
        assert middle(body)[0] == pytest.approx(motion["x"][i], abs=1e-12)
        for spindle, name in zip(spindles, ("muscle1", "muscle2"), strict=True):
            outline = np.asarray(spindle.get_xy())
            length = 0.2 * (1 - motion[f"{name}.contraction"][i])
            assert np.ptp(outline[:, 0]) == pytest.approx(length, abs=1e-9)
        colours.append(spindles[0].get_facecolor())
    assert colours[0] != colours[1]  # the pressure has changed


@pytest.mark.parametrize("kind", ["joint", "hanging", "series", "own"])
def test_films_of_other_plants(kind, tmp_path):
    muscle = pam.muscle("DMSP-20-400N")
    plant, stops = {
        "joint": lambda: (pam.AntagonisticJoint(muscle), [{"theta": -0.2}, {"theta": 0.2}]),
        "hanging": lambda: (pam.HangingLoad(muscle), [{"x": 0.02}, {"x": 0.04}]),
        "series": lambda: (pam.SeriesLoad(muscle), [{"x": 0.02}, {"x": 0.03}]),
        "own": lambda: (double_integrator(), REST),
    }[kind]()
    how = {"method": Collocation(10), "tolerance": None, "starts": 1}
    plan = pam.plan(plant, stops, rest=kind != "own", duration=2.0, minimise="effort", **how)
    path = animate_plan(plan, tmp_path / "motion.gif", seconds=0.2, fps=10)
    content = path.read_bytes()
    assert content[:6] == b"GIF89a"
    assert len(content) > 5_000
    from PIL import Image

    with Image.open(path) as film:
        assert film.n_frames == 2
        first = np.asarray(film.convert("RGB"), float)
        film.seek(1)
        assert np.abs(np.asarray(film.convert("RGB"), float) - first).max() > 50  # something moved


def test_what_cannot_be_drawn_is_refused(quickest, slide_plan, tmp_path):
    refused(r"written as .gif", animate_plan, quickest, tmp_path / "motion.mp4")
    refused("fps = 0", animate_plan, quickest, tmp_path / "motion.gif", fps=0)
    with pytest.raises(PlanError) as failed:
        pam.plan(
            slide_plan.plant, [{"x": -0.01}, {"x": 0.01}], duration=0.005, method=Collocation(5)
        )
    with pytest.raises(PlanError):
        animate_plan(failed.value.plan, tmp_path / "motion.gif")
    with pytest.raises(PlanError):
        failed.value.plan.plot()


def test_many_curves_are_shown_by_joints_and_their_names_do_not_overlap():
    plant = pam.Plant("row")
    stops: list[dict[str, float]] = [{}, {}]
    for i in range(5):
        q, w = plant.state(f"joint{i}.angle", unit="rad"), plant.state(f"joint{i}.speed")
        pulls = [plant.input(f"joint{i}.{n}", unit="N", min=0.0, max=1.0) for n in ("flex", "ext")]
        plant.der(q, w)
        plant.der(w, pulls[0] - pulls[1])
        stops[0][f"joint{i}.angle"], stops[1][f"joint{i}.angle"] = 0.0, 0.1 * i + 0.1
    plan = pam.plan(plant, stops, duration=2.0, minimise="effort", method=Collocation(6, 3))
    figure = plan.plot()
    figure.draw_without_rendering()
    panels = [ax for ax in figure.axes if ax.get_legend()]
    shown = [[t.get_text() for t in ax.get_legend().get_texts()] for ax in panels]
    assert all(len(names) <= 8 for names in shown)
    forces = [names for names in shown if names[0].endswith(".flex")]
    assert [n for names in forces for n in names] == [v.name for v in plant.inputs]
    assert [len(names) for names in forces] == [8, 2]  # pairs stay together
    boxes = [ax.get_legend().get_window_extent() for ax in panels]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    assert all(ax.get_window_extent().height > 60 for ax in panels)

"""Moving pictures: plans, the plant drawn by its positions; limbs in space, muscles along their
paths. Muscles are coloured by pressure or force.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import UnknownNameError, require_instance, with_kinds
from ..core.files import require_place
from ..core.interrupts import interruptible
from ..planning.result import Plan
from ..plants.hanging import hanging_sketch
from ..plants.limbs import Limb
from ..plants.sketch import Disc, Mark, Point, Sketch, Spindle
from .canvas import colour_scale, film_of, new_figure, save_film
from .plan import GREY, colours_of, panels_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..core.trajectory import Trajectory
    from ..plants.plant import Plant

Array: TypeAlias = NDArray[np.float64]
Frame: TypeAlias = Callable[[int], None]

CURVES = 3
"""Panels of curves beside the picture of the plant."""


@with_kinds
@interruptible()
def animate_plan(
    plan: Plan, path: str | Path, *, seconds: float | None = None, fps: int = 20
) -> Path:
    """Write a plan as an animated GIF: the plant moving, and the curves as they run.

    A plant that has a ``sketch()`` (those of the library, and any with one muscle) is drawn to
    scale, muscles as long as they are and coloured by pressure; any other by its curves alone.

    seconds : length of the film; by default the motion slowed down (or quickened) to 4 s. It
        repeats.
    fps : frames per second.

    Raises InputError when the ending is not .gif, PlanError for a plan that failed.

    Examples
    --------
    >>> pam.figures.animate_plan(plan, "motion.gif", seconds=0.1, fps=10).name
    'motion.gif'
    """
    require_instance("plan", plan, Plan, "give what plan() returned")
    target, count = film_of(path, 4.0 if seconds is None else seconds, fps)
    require_place(target)
    _ = plan.trajectory  # a failed plan raises here
    assert plan.replay is not None  # of a plan that succeeded
    motion = plan.replay.trajectory.at(np.linspace(0.0, plan.duration, count))
    figure, drawn = _film(plan, motion, count / fps)

    def frame(i: int) -> list[Any]:
        for draw in drawn:
            draw(i)
        return []

    return save_film(figure, frame, count, target, fps)


def _film(plan: Plan, motion: Trajectory, length: float) -> tuple[Figure, list[Frame]]:
    """The figure, and what draws its parts at a frame."""
    scene = sketch_of(plan.plant)
    panels = list(panels_of(plan).items())[: CURVES if scene else 6]
    rows = len(panels)
    figure, axes = new_figure(
        rows, 2 if scene else 1, size=(9.6 if scene else 7.0, 1.4 + 1.25 * rows)
    )
    drawn: list[Frame] = []
    if scene:
        grid = axes[0, 0].get_gridspec()
        grid.set_width_ratios([1.15, 1.0])
        for ax in axes[:, 0]:
            ax.remove()
        stage = figure.add_subplot(grid[:, 0])
        drawn.append(_drawn(stage, plan, motion, scene))
    for ax, (unit, names) in zip(axes[:, -1], panels, strict=True):
        drawn.append(_curves(ax, motion, unit, names))
    axes[-1, -1].set_xlabel("time [s]")
    for ax in axes[:-1, -1]:
        ax.tick_params(labelbottom=False)
    slower = length / plan.duration
    speed = f"{slower:.3g} times slower" if slower >= 1 else f"{1 / slower:.3g} times quicker"
    speed = "in real time" if abs(slower - 1) < 0.01 else speed
    figure.suptitle(
        f"{plan.plant.name}: {1e3 * plan.duration:.4g} ms, shown {speed}", fontsize="medium"
    )
    figure.draw_without_rendering()  # settles the layout once, so that nothing trembles
    figure.set_layout_engine("none")
    return figure, drawn


def _curves(ax: Axes, motion: Trajectory, unit: str, names: Sequence[str]) -> Frame:
    """Whole curves pale, the past dark, a dot at the present."""
    lines = []
    for name, colour in colours_of(names).items():
        variable = motion.variable(name)
        values = motion[name] / variable.display_factor
        style: dict[str, Any] = {"color": colour, "lw": 1.7}
        if variable.causality == "input":
            held = motion.interpolation == "previous"
            style |= {"lw": 0.9, "drawstyle": "steps-post" if held else "default"}
        ax.plot(motion.t, values, **style, alpha=0.25)
        (past,) = ax.plot([], [], **style, label=name)
        (now,) = ax.plot([], [], "o", color=colour, ms=4)
        lines.append((values, past, now))
    ax.set_ylabel(unit if unit != "1" else "")
    ax.set_xlim(motion.t[0], motion.t[-1])
    if len(names) <= 4:
        ax.legend(fontsize="x-small", loc="upper right", framealpha=0.75, edgecolor="none")

    def draw(i: int) -> None:
        for values, past, now in lines:
            past.set_data(motion.t[: i + 1], values[: i + 1])
            now.set_data(motion.t[i : i + 1], values[i : i + 1])

    return draw


# ---- plants --------------------------------------------------------------------------------------
STYLES: dict[str, dict[str, Any]] = {
    "body": {"fc": "#5b6770", "ec": "#333333", "zorder": 4},
    "ground": {"fc": "#c9ced3", "ec": "#6b7278", "hatch": "///", "lw": 0.8},
    "disc": {"fc": "#dfe3e6", "ec": "#6b7278", "zorder": 2},
    "muscle": {"ec": "#333333", "lw": 1.0, "zorder": 3},
    "rod": {"color": "#333333", "lw": 6, "solid_capstyle": "round", "zorder": 5},
    "rope": {"color": "#555555", "lw": 1.5, "zorder": 1},
    "needle": {"color": "#333333", "lw": 1.5, "zorder": 5},
    "rail": {"color": "#6b7278", "lw": 3, "zorder": 1},
}
"""How the shapes of a plant's sketch are drawn; those with one colour are lines."""


def _drawn(ax: Axes, plan: Plan, motion: Trajectory, sketch: Sketch) -> Frame:
    """The sketch on its stage, with a bar of colours up to the largest pressure; what moves its
    shapes.
    """
    from matplotlib import colormaps

    plant, colours = plan.plant, colormaps["YlOrRd"]
    x, u = (motion.array([v.name for v in each]).T for each in (plant.states, plant.inputs))
    places = Places(plant, x, u)
    shapes = list(shapes_along(plant, sketch, places))
    largest = max([1e4, *(float(p.max()) for _, _, p in shapes if p is not None)])
    ax.set_aspect("equal")
    ax.axis("off")
    place = {"location": "bottom", "fraction": 0.05, "pad": 0.02, "aspect": 30}
    colour_scale(ax, (0.0, largest / 1e5), "pressure [bar gauge]", "YlOrRd", **place)
    moved: list[tuple[Any, bool, Array, Array | None]] = []
    for style, points, pressure in shapes:
        line = "color" in STYLES[style]
        (artist,) = (ax.plot if line else ax.fill)([], [], **STYLES[style])
        level = None if pressure is None else np.clip(pressure / largest, 0.0, 1.0)
        moved.append((artist, line, points, level))
    for mark in sketch.marks:
        _marked(ax, plan, mark, places)
    corners = places.along(list(zip(sketch.width, sketch.height, strict=True)))[0]
    ax.set_xlim(*corners[:, 0])
    ax.set_ylim(*corners[:, 1])

    def draw(i: int) -> None:
        for artist, line, points, level in moved:
            if line:
                artist.set_data(*points[i].T)
            else:
                artist.set_xy(points[i])
            if level is not None:
                artist.set_facecolor(colours(0.05 + 0.9 * float(level[i])))

    return draw


def _marked(ax: Axes, plan: Plan, mark: Mark, places: Places) -> None:
    """A tick, and its value in the unit in which it is shown, at each stop."""
    variable = plan.plant.variable(mark.state)
    values = _stop_values(plan, mark.state)
    middle = (min(values) + max(values)) / 2 if values else 0.0
    for value in values:
        points = places.where(mark.points, mark.state, value)
        style = {"lw": 1.5} if mark.label else {"lw": 1.0, "ls": ":"}
        ax.plot(*points.T, color=GREY, **style)
        if mark.label:
            below = mark.label == "below"
            side = "right" if below and value < middle else "left"
            ax.annotate(
                f"{1e3 * value:g} mm" if variable.unit == "m" else variable.shown(value),
                points[-1],
                (0, -2) if below else (2, 0),
                textcoords="offset points",
                ha=side,
                va="top" if below else "center",
                fontsize="small",
                color="#555555",
            )


def _stop_values(plan: Plan, name: str) -> list[float]:
    """Where the plan's stops are."""
    stops = plan._problem.stops if plan._problem else ()
    return sorted({float(s[name]) for s in stops if name in s and np.ndim(s[name]) == 0})


# ---- where shapes stand: films and the page draw them --------------------------------------------
THICKNESS = 0.09
"""Radius of a stretched muscle in the picture, in parts of its length."""


def sketch_of(plant: Plant) -> Sketch | None:
    """How a plant looks; None for one that says nothing of it."""
    return plant.sketch() or hanging_sketch(plant)


class Places:
    """Points of a sketch along a motion: states x (n, moments), inputs u (m, moments)."""

    def __init__(self, plant: Plant, x: Array, u: Array) -> None:
        self._plant, self._x, self._u = plant, x, u

    def _at(self, expressions: Sequence[Any], x: Array, u: Array) -> Array:
        """(moments, expressions)."""
        plant = self._plant
        flat = ca.vertcat(*(ca.SX(e) for e in expressions))
        function = ca.Function("points", [plant.x, plant.u, plant.p], [ca.densify(flat)])
        p = np.tile(plant.vector("parameter")[:, None], (1, x.shape[1]))
        values: Array = np.asarray(function(x, u, p), float).T
        return values

    def along(self, points: Sequence[Point]) -> Array:
        """(moments, points, 2) [m]."""
        flat = self._at([c for point in points for c in point], self._x, self._u)
        return flat.reshape(-1, len(points), 2)

    def values(self, name: str) -> Array:
        """A variable of the plant, (moments,)."""
        found: Array = self._at([self._plant.expression(name)], self._x, self._u)[:, 0]
        return found

    def where(self, points: Sequence[Point], state: str, value: float) -> Array:
        """(points, 2) [m] for one value of a state, all else at its start."""
        plant = self._plant
        x = plant.vector("state", {state: value})
        flat = [c for point in points for c in point]
        found = self._at(flat, x[:, None], plant.vector("input")[:, None])
        only: Array = found.reshape(len(points), 2)
        return only


def rim(disc: Disc) -> list[Point]:
    """Points around a disc."""
    angles = np.linspace(0.0, 2 * np.pi, 60)
    (x, y), r = disc.centre, disc.radius
    return [(x + r * float(np.cos(a)), y + r * float(np.sin(a))) for a in angles]


def outline(start: Any, end: Any, kappa: float, rest_length: float) -> Array:
    """Of a muscle between two points [m], thicker the more it contracts: (points, 2)."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    along = b - a
    across = np.array([-along[1], along[0]]) / np.hypot(*along)
    s = np.linspace(0.0, 1.0, 40)
    # a braid's volume hardly shrinks: what it loses in length it gains in girth
    bulge = THICKNESS * rest_length / np.sqrt(max(1.0 - 2.0 * kappa, 0.2))
    half = bulge * (0.35 + 0.65 * np.sin(np.pi * s) ** 0.6)
    middle = a + np.outer(s, along)
    upper, lower = (middle + sign * np.outer(half, across) for sign in (1, -1))
    return np.vstack([upper, lower[::-1]])


def shapes_along(
    plant: Plant, sketch: Sketch, places: Places
) -> Iterator[tuple[str, Array, Array | None]]:
    """(style, points (moments, n, 2) [m], gauge pressure [Pa] of a muscle) of each shape."""
    for shape in sketch.shapes:
        if isinstance(shape, Spindle):
            tips = places.along([shape.start, shape.end])
            kappa = places.values(f"{shape.muscle}.contraction")
            length = float(plant.variable(f"{shape.muscle}.rest_length").start or 0.0)
            rims = [outline(a, b, k, length) for (a, b), k in zip(tips, kappa, strict=True)]
            yield "muscle", np.array(rims), places.values(f"{shape.muscle}.pressure")
        elif isinstance(shape, Disc):
            yield "disc", places.along(rim(shape)), None
        else:
            yield shape.style, places.along(shape.points), None


def scene_of(plant: Plant, t: Array, x: Array, u: Array) -> dict[str, Any] | None:
    """The sketch at moments t, as plain values in mm; None for a plant without one.

    x (n, moments), u (m, moments). Returns ``t``, ``width`` and ``height`` (low, high), and
    ``shapes``: each a ``style`` with its points in ``frames`` (moments, points, 2), or once where
    it does not move; muscles have a ``level`` of pressure (0 .. 1) for each moment, too.
    """
    sketch = sketch_of(plant)
    if sketch is None:
        return None
    places = Places(plant, x, u)
    moved = list(shapes_along(plant, sketch, places))
    ends = [
        plant.variable(f"{s.muscle}.pressure").max for s in sketch.shapes if isinstance(s, Spindle)
    ]
    seen = [float(p.max()) for _, _, p in moved if p is not None]
    largest = max([1e4, *seen, *(float(e) for e in ends if np.isfinite(e))])
    shapes: list[dict[str, Any]] = []
    for style, points, pressure in moved:
        shapes.append({"style": style, **_frames(points)})
        if pressure is not None:
            shapes[-1]["level"] = np.clip(pressure / largest, 0.0, 1.0).round(3).tolist()
    corners = places.along(list(zip(sketch.width, sketch.height, strict=True)))[0]
    return {
        "t": np.asarray(t, float).tolist(),
        "width": (1e3 * corners[:, 0]).tolist(),
        "height": (1e3 * corners[:, 1]).tolist(),
        "largest": largest,
        "shapes": shapes,
    }


def _frames(points: Array) -> dict[str, Any]:
    still = bool(np.all(np.ptp(points, axis=0) < 1e-9))
    shown = points[:1] if still else points
    return {"frames": (1e3 * shown).round(2).tolist()}


# ---- limbs in space: bones grey, muscles along their paths ---------------------------------------
COLOURED = {"force": (1.0, "force [N]"), "pressure": (1e-5, "pressure [bar]")}


@with_kinds
@interruptible()
def plot_limb(
    limb: Limb,
    values: Mapping[str, float] | None = None,
    *,
    colour: str = "force",
    view: tuple[float, float] = (15.0, -60.0),
) -> Figure:
    """The limb in space at states and inputs, by default the start values.

    values : {name: value}, or an operating point. colour : of the muscles, "force" or "pressure".
    view : elevation and azimuth [degrees].

    Examples
    --------
    >>> arm.plot({"elbow": 0.5}).savefig("arm.png")  # doctest: +SKIP
    """
    placed: Any = limb if values is None else limb.with_values(values)
    x, u = (placed.vector(kind)[:, None] for kind in ("state", "input"))
    figure: Figure = _posed(placed, x, u, colour, view)[0]
    return figure


@with_kinds
@interruptible()
def animate_limb(
    limb: Limb,
    motion: Trajectory,
    path: str | Path,
    *,
    colour: str = "force",
    view: tuple[float, float] = (15.0, -60.0),
    seconds: float = 4.0,
    fps: int = 15,
) -> Path:
    """Write a motion of the limb as an animated GIF of ``seconds``; returns the path.

    Examples
    --------
    >>> arm.animate(motion, "arm.gif", colour="pressure")  # doctest: +SKIP
    """
    target, count = film_of(path, seconds, fps)
    shown = motion.at(np.linspace(motion.t[0], motion.t[-1], count))
    x, u = (
        np.array([shown[v.name] for v in part]).reshape(len(part), -1)
        for part in (limb.states, limb.inputs)
    )
    figure, draw = _posed(limb, x, u, colour, view)
    return save_film(figure, draw, count, target, fps)


def _posed(limb: Limb, x: Array, u: Array, colour: str, view: tuple[float, float]) -> Any:
    """(figure, what draws a moment into it)."""
    if colour not in COLOURED:
        raise UnknownNameError("colour", colour, COLOURED)
    from .picture import Picture

    factor, label = COLOURED[colour]
    shown = [limb.expression(f"{m.name}.{colour}") for m in limb.muscles]
    function = ca.Function("shown", [limb.x, limb.u, limb.p], [ca.densify(ca.vertcat(*shown))])
    values = factor * np.array(
        function(x, u, np.tile(limb.vector("parameter")[:, None], x.shape[1]))
    )
    paths, bones = limb.drawing(x)
    figure = Picture(figsize=(6.4, 6.4), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    ends = 0.0, max(float(values.max()), 1e-9)
    scale = colour_scale(axes, ends, label, "plasma_r", shrink=0.6, pad=0.1)
    skeleton = [axes.plot([], [], [], "-o", color="#999999", lw=5, ms=7)[0] for _ in bones[::2]]
    cords = [axes.plot([], [], [], lw=2.5, solid_capstyle="round")[0] for _ in paths]
    everything = np.concatenate([*paths, bones]).transpose(1, 0, 2).reshape(3, -1)
    low, high = everything.min(axis=1), everything.max(axis=1)
    half = 0.5 * float((high - low).max()) + 0.02
    for setter, middle in zip("xyz", (low + high) / 2, strict=True):
        getattr(axes, f"set_{setter}lim")(middle - half, middle + half)
        getattr(axes, f"set_{setter}label")(f"{setter} [m]")
    axes.set_box_aspect((1, 1, 1))
    axes.view_init(*view)

    def draw(k: int) -> list[Any]:
        for i, line in enumerate(skeleton):
            line.set_data_3d(*bones[2 * i : 2 * i + 2, :, k].T)
        for line, points, row in zip(cords, paths, values, strict=True):
            line.set_data_3d(*points[:, :, k].T)
            line.set_color(scale.to_rgba(row[k]))
        return []

    draw(0)
    return figure, draw

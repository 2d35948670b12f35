"""The common look of all pictures: colours, panels, curves with their units; pictures and films in
files.

matplotlib is loaded only when one is drawn; figures need no display.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, WriteError, require_count, require_positive, with_kinds
from ..core.files import atomic_path
from ..core.interrupts import interruptible
from ..core.lazy import library
from ..core.trajectory import Trajectory
from ..core.units import quantity_of
from ..core.variables import Variable
from .paper import paper_size, paper_width

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

    from .picture import Picture

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Told apart by eyes that lack one kind of cone, too (after M. Okabe, K. Ito, 2008)."""
STROKES = ("-", "--", "-.", ":")
MARKS = ("o", "s", "^", "D", "v", "P")
"""Beside the colours, so that lines are told apart in print."""


def ink() -> str:
    """The colour of letters: dark on paper, light in a dark style."""
    from matplotlib import rcParams

    return str(rcParams["text.color"])


def axis_label(*variables: Variable) -> str:
    """Quantity and display unit of a panel that shows these variables, which have one unit."""
    names = {v.name.rpartition(".")[2] for v in variables}
    quantity = quantity_of(variables[0].unit) or (names.pop() if len(names) == 1 else "")
    return "\n".join(filter(None, (quantity, f"[{variables[0].display_unit}]")))


@with_kinds
@interruptible()  # matplotlib is loaded in here
def new_figure(
    rows: int, columns: int = 1, *, size: tuple[float, float], sharex: bool = False
) -> tuple[Picture, Any]:
    """A figure in the look of all pictures, with empty panels, and these, (rows, columns).

    size : of the figure [inch]. sharex : one axis of time for all panels.

    Examples
    --------
    >>> figure, ((left, right),) = pam.figures.new_figure(1, 2, size=(8.0, 3.0))
    >>> _ = left.plot(motion.t, 1e3 * motion["x"])
    >>> figure.savefig("picture.png")
    """
    from .picture import Picture

    require_count("rows", rows)
    require_count("columns", columns)
    size, *places = paper_size(size, rows, columns)
    figure = Picture(figsize=size, layout="constrained")
    axes = figure.subplots(*places, squeeze=False, sharex=sharex).reshape(rows, columns)
    for ax in axes.ravel():
        ax.grid(True, color="#dddddd", linewidth=0.6)
        ax.set_axisbelow(True)
        ax.set_prop_cycle(color=COLOURS)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, axes


def panels(
    rows: int, columns: int = 1, *, size: tuple[float, float], sharex: bool = True
) -> tuple[Picture, list[Axes]]:
    """A figure of :func:`new_figure`, and its panels row by row."""
    figure, axes = new_figure(rows, columns, size=size, sharex=sharex)
    return figure, list(axes.ravel())


def caption(ax: Axes, x: str = "", y: str = "", *, title: str = "", names: Any = "") -> None:
    """What a panel shows: its axes, a title at the left, the names of its curves (``names`` : the
    place, as matplotlib calls it).
    """
    if x:
        ax.set_xlabel(x)
    if y:
        ax.set_ylabel(y)
    if title:
        ax.set_title(title, loc="left", fontsize="medium")
    if names:
        ax.legend(frameon=False, fontsize="small", loc=names)


CURVES = 8
"""In a panel, at most: more are not told apart, nor do their names find room beside it."""


def legible(names: Sequence[str]) -> list[list[str]]:
    """Names in groups of at most ``CURVES``; those of one joint or muscle stay together."""
    owners: dict[str, list[str]] = {}
    for name in names if len(names) > CURVES else ():
        owners.setdefault(name.partition(".")[0], []).append(name)
    parts: list[list[str]] = [[] if owners else list(names)]
    for own in owners.values():
        if len(parts[-1]) + len(own) > CURVES:
            parts.append([])
        parts[-1] += own
    return [p[i : i + CURVES] for p in parts for i in range(0, len(p), CURVES)]


def over_time(panels: int, below: float = 0.0) -> tuple[Picture, list[Axes]]:
    """A figure over time and its panels, from left to right: in one column, or two where there are
    many; then an axis as wide as the figure, ``below`` [inch] high, where that is given.
    """
    columns = 1 if panels <= CURVES or paper_width() is not None else 2
    rows = -(-panels // columns)
    heights = [1.6] * rows + [below] * bool(below)
    size = (9.0 if columns == 1 else 15.0, 0.8 + sum(heights))
    figure, axes = new_figure(len(heights), columns, size=size, sharex=True)
    grid, every = axes[0, 0].get_gridspec(), list(axes[:rows].ravel())
    grid.set_height_ratios(heights)
    for ax in (*every[panels:], *(axes[-1, 1:] if below else ())):
        ax.remove()
    shown = every[:panels]
    if below:
        axes[-1, 0].set_subplotspec(grid[-1, :])
        shown.append(axes[-1, 0])
    for ax in shown[-1:] if below else shown[-columns:]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel("time [s]")
    return figure, shown


def draw(ax: Axes, trajectory: Trajectory, name: str, colour: str, **style: Any) -> None:
    """One variable over time in its display unit; held inputs as steps."""
    variable = trajectory.variable(name)
    values = trajectory[name] / variable.display_factor
    held = variable.causality == "input" and trajectory.interpolation == "previous"
    ax.plot(
        trajectory.t,
        values,
        color=colour,
        drawstyle="steps-post" if held else "default",
        **{"linewidth": 1.6, "label": variable.name, **style},
    )


def name_beside(ax: Axes) -> None:
    """The names of a panel's curves, to the right of it."""
    ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")


def colour_scale(
    ax: Any, values: tuple[float, float], label: str, colours: Any = "viridis", **place: Any
) -> ScalarMappable:
    """The colours of values between two ends, with a bar that names them beside the panel(s)."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(*values), colours)
    figure = (ax[0] if isinstance(ax, list) else ax).figure
    figure.colorbar(scale, ax=ax, label=label, **place)
    return scale


def plotly() -> tuple[Any, Any]:
    """(graph objects, make_subplots). Raises InputError where plotly is not installed."""
    library("plotly", "interactive", "interactive=True")
    import plotly.graph_objects as objects
    from plotly.subplots import make_subplots

    return objects, make_subplots


def layered(count: int) -> Sequence[dict[str, Any]]:
    """Styles of curves in one panel, the first the widest: equal ones show through each other."""
    return [
        {
            "colour": COLOURS[i % len(COLOURS)],
            "linewidth": 1.4 + 0.9 * (count - 1 - i) / max(count - 1, 1) * min(count - 1, 2),
            "linestyle": STROKES[(i // len(COLOURS)) % len(STROKES)],
        }
        for i in range(count)
    ]


# ---- in files ------------------------------------------------------------------------------------
@interruptible()
def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: float = 130) -> Path:
    """Write a figure as the file's name ends (.png, .pdf, .svg, ...), all of it or nothing.

    Raises WriteError for another ending, and where nothing can be written.
    """
    target = Path(path)
    known = figure.canvas.get_supported_filetypes()
    if target.suffix.lower().removeprefix(".") not in known:
        raise WriteError(
            f"{target}: a figure cannot be written as {target.suffix or 'a file without an ending'}"
            "; end its name in .png, .pdf or .svg"
        )
    with atomic_path(target) as temporary:
        # in memory first: some formats hide what the system refuses while they write
        temporary.write_bytes(drawn(figure, target.suffix[1:].lower(), dpi))
    return target


def drawn(figure: Figure, kind: str, dpi: float) -> bytes:
    """A figure as a file's content.

    Of pixels it is drawn once: ``savefig`` does so three times, and lays it out each time.
    """
    from matplotlib import rcParams
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    content = io.BytesIO()
    if kind != "png" or rcParams["savefig.bbox"] is not None:
        figure.savefig(content, format=kind, dpi=dpi)
        return content.getvalue()
    before = figure.canvas, figure.dpi
    try:
        figure.dpi = dpi
        canvas: Any = FigureCanvasAgg(figure)
        # half the work of level 6 for 6 % more bytes
        canvas.print_png(content, pil_kwargs={"compress_level": 3})
    finally:
        figure.set_canvas(before[0])
        figure.dpi = before[1]
    return content.getvalue()


def film_of(path: str | os.PathLike[str], seconds: float, fps: int) -> tuple[Path, int]:
    """(the file, how many frames) of a film so long. Raises InputError."""
    target = Path(path)
    if target.suffix.lower() != ".gif":
        raise InputError(f"{target.name}: an animation is written as .gif")
    require_count("fps", fps, 1, 50)
    return target, max(2, round(require_positive("seconds", seconds, "s") * fps))


def save_film(
    figure: Figure, draw: Callable[[int], list[Any]], count: int, path: Path, fps: int
) -> Path:
    """Write a figure as an animated GIF. draw : makes it the frame of this number."""
    from matplotlib.animation import FuncAnimation, PillowWriter

    film = FuncAnimation(figure, draw, frames=count, blit=False)
    with atomic_path(path) as temporary:
        film.save(temporary, writer=PillowWriter(fps=fps), dpi=80)
    return path

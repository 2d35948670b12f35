"""The force of a muscle as a surface over contraction and pressure; measured cells on it."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.interrupts import interruptible
from ..muscles.validity import ValidityWarning
from .canvas import COLOURS, plotly
from .paper import paper_size, paper_width

if TYPE_CHECKING:
    from ..fitting.static.force_fit import ForceFit
    from ..muscles.pneumatic_muscle import Muscle

Array: TypeAlias = NDArray[np.float64]
Quantity: TypeAlias = Literal["force", "stiffness"]

POINTS = 60
_LABELS = {"force": "pulling force [N]", "stiffness": "stiffness [N/mm]"}


def plot_surface(muscle: Muscle, quantity: Quantity = "force", *, interactive: bool = False) -> Any:
    """Force or stiffness (at constant pressure) over contraction [%] and pressure [bar gauge],
    within the measured range.

    interactive : a plotly figure, to be turned in a browser or a notebook (needs the extra
        ``interactive``), instead of matplotlib's. Raises InputError.
    """
    if quantity not in _LABELS:
        raise InputError(f"quantity = {quantity!r}: choose 'force' or 'stiffness'")
    low, high = muscle.contraction_range
    kappa, p = np.meshgrid(
        np.linspace(min(low, 0.0), high, POINTS), np.linspace(*muscle.pressure_range, POINTS)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ValidityWarning)
        z = muscle.force(p, kappa) if quantity == "force" else muscle.stiffness(p, kappa) / 1e3
    title = f"{muscle.name}: {muscle.law.title}"
    return _drawn(kappa, p, np.asarray(z), _LABELS[quantity], title, None, interactive)


def plot_fit_surface(fit: ForceFit, *, interactive: bool = False) -> Any:
    """The fitted force as a surface, the measured cells as points; see :func:`plot_surface`."""
    table = fit.table
    kappa, p = np.meshgrid(
        np.linspace(min(0.0, table.contraction.min()), table.contraction.max(), POINTS),
        np.linspace(table.pressure.min(), table.pressure.max(), POINTS),
    )
    z = np.maximum(np.asarray(fit.law.tension(p.ravel(), kappa.ravel())), 0.0).reshape(p.shape)
    title = f"{fit.law.title}: RMSE {fit.rmse:.2f} N"
    cells = table.contraction, table.pressure, np.maximum(table.force, 0.0)
    return _drawn(kappa, p, z, _LABELS["force"], title, cells, interactive)


@interruptible()  # matplotlib and plotly are loaded in here
def _drawn(
    kappa: Array,
    p: Array,
    z: Array,
    label: str,
    title: str,
    cells: tuple[Array, Array, Array] | None,
    interactive: bool,
) -> Any:
    there = None if cells is None else (100 * cells[0], cells[1] / 1e5, cells[2])
    if interactive:
        return _turning(100 * kappa, p / 1e5, z, label, title, there)
    from .picture import Picture

    figure = Picture(figsize=paper_size((8, 6.4))[0], layout="constrained")
    ax: Any = figure.add_subplot(projection="3d")
    ax.plot_surface(100 * kappa, p / 1e5, z, cmap="viridis", alpha=0.85, linewidth=0)
    if there is not None:
        ax.scatter(*there, color=COLOURS[1], s=12, depthshade=False)
    ax.set_xlabel("contraction [%]")
    ax.set_ylabel("pressure [bar gauge]")
    ax.set_zlabel(label)
    ax.set_title(title, loc="left", fontsize="medium")
    ax.view_init(elev=24, azim=-52)
    ax.set_box_aspect(None, zoom=0.88 if paper_width() is None else 0.74)
    return figure


def _turning(x: Array, y: Array, z: Array, label: str, title: str, cells: Any) -> Any:
    """The same by plotly, to be turned with the mouse."""
    objects, _ = plotly()
    drawn = [objects.Surface(x=x, y=y, z=z, colorscale="Viridis", opacity=0.9, name=label)]
    if cells is not None:
        mark = {"size": 3, "color": COLOURS[1]}
        there = dict(zip("xyz", cells, strict=True))
        drawn.append(objects.Scatter3d(**there, mode="markers", marker=mark, name="measured"))
    figure = objects.Figure(drawn)
    axes = {
        "xaxis_title": "contraction [%]",
        "yaxis_title": "pressure [bar gauge]",
        "zaxis_title": label,
    }
    figure.update_layout(title=title, scene=axes, template="plotly_white", height=640)
    return figure

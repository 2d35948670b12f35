"""Maps of self-excited vibration over two values; each returns a matplotlib Figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.variables import Variable
from ..numerics.newton import Array
from ..plants.plant import Plant
from .canvas import COLOURS, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..vibration.maps import AmplitudeMap, HopfMap

__all__ = ["plot_amplitude_map", "plot_hopf_map"]


def plot_hopf_map(found: HopfMap) -> Figure:
    """The border and its frequency as maps; crosses where vibration begins with a jump."""
    plant = next(p for row in found.points for p in row if p is not None).plant
    parameter = plant.variable(found.parameter)
    figure, axes = new_figure(1, 2, size=(10.5, 4.2))
    left, right = axes[0]
    border = found.border / parameter.display_factor
    _field(left, plant, found.axes, border, f"border: {parameter.label}")
    _field(right, plant, found.axes, found.frequencies, "frequency at the border [Hz]")
    hard = found.lyapunov > 0
    _marks(left, plant, found.axes, hard, "begins with a jump", "x")
    return figure


def plot_amplitude_map(found: AmplitudeMap) -> Figure:
    """Amplitude and frequency as maps, with the border of stability of the rest."""
    variable = found.plant.variable(found.state)
    figure, axes = new_figure(1, 2, size=(10.5, 4.2))
    left, right = axes[0]
    swing = found.amplitude / variable.display_factor
    _field(left, found.plant, found.axes, swing, f"amplitude of {variable.label}")
    _field(right, found.plant, found.axes, found.frequency, "frequency [Hz]")
    x, y = _scaled(found.plant, found.axes)
    if min(found.growth.shape) > 1 and np.nanmin(found.growth) < 0 < np.nanmax(found.growth):
        for ax in (left, right):
            ax.contour(x, y, found.growth.T, levels=[0.0], colors=[COLOURS[1]], linewidths=1.8)
        left.plot([], [], color=COLOURS[1], lw=1.8, label="rest loses its stability")
    moving = found.amplitude > 0
    _marks(left, found.plant, found.axes, ~found.closed & moving, "not closed", "x")
    _marks(left, found.plant, found.axes, found.outside & moving, "leaves the law's range", "o")
    if left.get_legend_handles_labels()[0]:
        left.legend(fontsize="small", loc="upper left", framealpha=0.9)
    return figure


def _scaled(plant: Plant, axes: Mapping[str, Array]) -> tuple[Array, Array]:
    first, second = (values / plant.variable(n).display_factor for n, values in axes.items())
    return np.asarray(first), np.asarray(second)


def _field(ax: Axes, plant: Plant, axes: Mapping[str, Array], values: Array, label: str) -> None:
    """Values (n, m) as colours of cells around the points; unknown ones hatched."""
    x, y = _scaled(plant, axes)
    ax.set_facecolor("#eeeeee")
    mesh = ax.pcolormesh(x, y, np.ma.masked_invalid(values.T), shading="nearest", cmap="cividis")
    ax.figure.colorbar(mesh, ax=ax, label=label)
    ax.grid(False)
    names: list[Variable] = [plant.variable(n) for n in axes]
    ax.set_xlabel(names[0].label)
    ax.set_ylabel(names[1].label)


def _marks(
    ax: Axes,
    plant: Plant,
    axes: Mapping[str, Array],
    where: NDArray[np.bool_],
    label: str,
    mark: str,
) -> None:
    if not where.any():
        return
    x, y = _scaled(plant, axes)
    i, j = np.nonzero(where)
    ax.plot(x[i], y[j], mark, ls="", mfc="none", mec=COLOURS[1], ms=6, mew=1.6, label=label)
    ax.legend(fontsize="small", loc="upper left", framealpha=0.9)

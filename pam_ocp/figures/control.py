"""Figures of the control room. matplotlib is loaded only when one is drawn;
no display is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..control.analysis import BodeCloud, Margins, ModeMap, Stroke, frequency_response
from ..core.errors import InputError
from ..core.trajectory import Trajectory
from .canvas import COLOURS, draw, new_figure

if TYPE_CHECKING:
    import control
    from matplotlib.figure import Figure

__all__ = [
    "plot_bode_cloud",
    "plot_loop",
    "plot_mode_map",
    "plot_stroke",
    "plot_tracking",
]

Array: TypeAlias = NDArray[np.float64]


def plot_tracking(
    runs: Mapping[str, Trajectory],
    names: Sequence[str],
    reference: Mapping[str, Callable[[float], float]] | None = None,
    title: str = "",
) -> Figure:
    """Several runs over time, one panel per name; with its error below where there is a reference.

    runs : {label: Trajectory}. reference : {name: function of time}, as the controller follows it.
    """
    if not runs:
        raise InputError("runs is empty: nothing to draw")
    first = next(iter(runs.values()))
    wanted = {first.variable(n).name: f for n, f in (reference or {}).items()}
    panels = [(first.variable(n).name, False) for n in names]
    panels += [(n, True) for n, _ in panels if n in wanted]
    figure, axes = new_figure(len(panels), size=(8.5, 1.0 + 1.8 * len(panels)), sharex=True)
    for ax, (name, error) in zip(axes[:, 0], panels, strict=True):
        variable = first.variable(name)
        for i, (label, run) in enumerate(runs.items()):
            colour, line = COLOURS[i % len(COLOURS)], "-" if i < 3 else "--"
            if error:
                goal = np.array([wanted[name](t) for t in run.t])
                ax.plot(
                    run.t,
                    (run[name] - goal) / variable.display_factor,
                    color=colour,
                    lw=1.4,
                    label=label,
                    ls=line,
                )
            else:
                draw(ax, run, name, colour, linewidth=1.4, label=label, linestyle=line)
        if not error and name in wanted:
            goal = np.array([wanted[name](t) for t in first.t]) / variable.display_factor
            ax.plot(first.t, goal, color="#222222", lw=1.0, ls="--", label="reference")
        unit = "" if variable.display_unit == "1" else f" [{variable.display_unit}]"
        ax.set_ylabel(f"error of {name}{unit}" if error else variable.label)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside upper left", frameon=False, fontsize="small", ncols=3
    )
    axes[0, 0].set_title(title, loc="left", fontsize="medium")
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def plot_bode_cloud(cloud: BodeCloud, level: float = 0.95, title: str = "") -> Figure:
    """Every response thinly, the nominal one on top; below, magnitudes over the nominal one, with
    the band that holds ``level`` of them."""
    figure, axes = new_figure(3, size=(8, 8), sharex=True)
    magnitude, phase, relative = axes[:, 0]
    size = np.abs(cloud.nominal)
    for i, response in enumerate(cloud.responses):
        style: dict[str, Any] = {"color": COLOURS[0], "lw": 0.6, "alpha": 0.3}
        label = f"{len(cloud.responses)} draws" if i == 0 else None
        magnitude.loglog(cloud.frequency, np.abs(response), label=label, **style)
        phase.semilogx(cloud.frequency, np.degrees(np.unwrap(np.angle(response))), **style)
        relative.semilogx(cloud.frequency, 100 * (np.abs(response) / size - 1), **style)
    low, high = (100 * (bound / size - 1) for bound in cloud.band(level))
    band = f"{100 * level:g} % of them"
    relative.fill_between(cloud.frequency, low, high, color=COLOURS[4], alpha=0.3, lw=0, label=band)
    magnitude.loglog(cloud.frequency, size, color=COLOURS[1], lw=1.4, label="nominal")
    angle = np.degrees(np.unwrap(np.angle(cloud.nominal)))
    phase.semilogx(cloud.frequency, angle, color=COLOURS[1], lw=1.4)
    relative.axhline(0.0, color=COLOURS[1], lw=1.4)
    magnitude.set_ylabel(f"|{cloud.output} / {cloud.source}| (SI)")
    magnitude.set_title(title, loc="left", fontsize="medium")
    for ax in (magnitude, relative):
        ax.legend(frameon=False, fontsize="small", loc="upper left")
    phase.set_ylabel("phase [deg]")
    relative.set_ylabel("magnitude over\nnominal, less 1 [%]")
    relative.set_xlabel("frequency [Hz]")
    return figure


def plot_loop(
    loops: Mapping[str, control.StateSpace],
    found: Mapping[str, Margins] | None = None,
    hertz: tuple[float, float] = (0.05, 500.0),
) -> Figure:
    """Smallest singular value of I + L (robustness) and largest sensitivity over frequency.

    loops : {label: loop gain broken at the inputs}, as ``StateFeedback.loop``.
    """
    figure, axes = new_figure(2, size=(8, 6), sharex=True)
    upper, lower = axes[:, 0]
    frequency = np.geomspace(*hertz, 600)
    for i, (label, loop) in enumerate(loops.items()):
        response = frequency_response(loop, frequency)
        values = np.linalg.svd(np.eye(loop.ninputs) + response, compute_uv=False)
        gain = np.linalg.svd(response, compute_uv=False)[:, 0]
        text = label
        if found is not None and label in found:
            text += f" (phase margins {', '.join(f'{p:.0f}' for p in found[label].phase)} deg)"
        colour = COLOURS[i % len(COLOURS)]
        upper.loglog(frequency, gain, color=colour, label=text)
        lower.loglog(frequency, 1 / values[:, -1], color=colour, label=label)
    upper.axhline(1.0, color="#999999", lw=0.8, ls=":")
    upper.set_ylabel("largest gain of the loop L")
    upper.legend(frameon=False, fontsize="small")
    lower.axhline(1.0, color="#999999", lw=0.8, ls=":")
    lower.set_ylabel("sensitivity of the inputs")
    lower.set_xlabel("frequency [Hz]")
    return figure


def plot_stroke(strokes: Mapping[str, Stroke], title: str = "") -> Figure:
    """Reach, weakest direction, visibility and modes along the stroke, for labelled studies."""
    panels: tuple[tuple[str, str], ...] = (
        ("reach", "reach of the position\n[nominal]"),
        ("weakest", "reach in the weakest\ndirection [nominal]"),
        ("visible", "visibility of the\nleast visible [nominal]"),
        ("frequency", "natural frequency [Hz]"),
        ("damping", "damping ratio"),
    )
    first = next(iter(strokes.values()))
    variable = first.points[0].plant.variable(first.name)
    figure, axes = new_figure(len(panels), size=(8, 9.5), sharex=True)
    for ax, (attribute, label) in zip(axes[:, 0], panels, strict=True):
        for i, (name, stroke) in enumerate(strokes.items()):
            values = getattr(stroke, attribute)
            ax.plot(
                stroke.values / variable.display_factor,
                values,
                color=COLOURS[i % len(COLOURS)],
                label=name,
            )
        ax.set_ylabel(label, fontsize="small")
        ax.set_ylim(bottom=0.0)
    axes[0, 0].set_title(title, loc="left", fontsize="medium")
    axes[0, 0].legend(frameon=False, fontsize="small", ncols=3)
    axes[-1, 0].set_xlabel(variable.label)
    return figure


def plot_mode_map(found: ModeMap, title: str = "") -> Figure:
    """Contours of natural frequency and damping ratio over the two axes;
    blank without equilibrium.
    """
    figure, axes = new_figure(1, 2, size=(11, 4.6))
    (outer, rows), (inner, columns) = found.axes.items()
    x, y = found.plant.variable(outer), found.plant.variable(inner)
    panels = (
        (axes[0, 0], found.frequency, "natural frequency [Hz]"),
        (axes[0, 1], found.damping, "damping ratio"),
    )
    for ax, values, label in panels:
        shown = np.ma.masked_invalid(values.T)
        drawn = ax.pcolormesh(
            rows / x.display_factor,
            columns / y.display_factor,
            shown,
            shading="gouraud" if not shown.mask.any() else "nearest",
            cmap="viridis",
            rasterized=True,
        )
        if shown.count() and float(np.ptp(shown.compressed())) > 1e-6 * float(np.abs(shown).max()):
            lines = ax.contour(
                rows / x.display_factor,
                columns / y.display_factor,
                shown,
                levels=8,
                colors="white",
                linewidths=0.8,
            )
            ax.clabel(lines, fontsize=8, fmt="%.3g")
        figure.colorbar(drawn, ax=ax, label=label)
        ax.set_xlabel(x.label)
        ax.grid(False)
    axes[0, 0].set_ylabel(y.label)
    axes[0, 0].set_title(title, loc="left", fontsize="medium")
    return figure

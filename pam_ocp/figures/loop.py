"""The figure of a closed loop. matplotlib is loaded only when it is drawn; no display is needed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.trajectory import Trajectory
from .canvas import COLOURS, draw, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..control.loop import ClosedLoop
    from ..control.mpc_statistics import MpcStatistics

__all__ = ["plot_closed_loop", "plot_durations"]

Array: TypeAlias = NDArray[np.float64]


def plot_closed_loop(loop: ClosedLoop, title: str = "") -> Figure:
    """Tracked variables with their reference and error, inputs, unknowns found, and step times.

    Bands around unknowns are two standard deviations wide on each side. Where the loop knows no
    reference the states are shown, without errors; where the controller keeps no times, none.
    """
    real, wanted = loop.trajectory, loop.reference
    shown = real.named("state") if wanted is None else wanted.names
    controls = [n for n in real.named("input") if not real.variable(n).disturbance]
    unknown = [] if loop.estimate is None else _unknowns(loop.estimate, real)
    rows = len(shown) + (wanted is not None) + 1 + len(unknown) + (loop.statistics is not None)
    figure, axes = new_figure(rows, size=(8.5, 1.0 + 1.7 * rows))
    free = iter(axes[:, 0])
    for name in shown:
        ax = next(free)
        draw(ax, real, name, COLOURS[0])
        if wanted is not None:
            goal = wanted[name] / real.variable(name).display_factor
            ax.plot(real.t, goal, "k:", lw=1.0, drawstyle="steps-post", label="reference")
        ax.set_ylabel(real.variable(name).label)
    if wanted is not None:
        _draw_error(next(free), real, wanted, shown[0])
    ax = next(free)
    for i, name in enumerate(controls):
        draw(ax, real, name, COLOURS[i % len(COLOURS)], linewidth=1.2)
    ax.set_ylabel(f"inputs [{real.variable(controls[0]).display_unit}]" if controls else "inputs")
    if loop.estimate is not None:
        for name in unknown:
            _draw_unknown(next(free), loop.estimate, real, name)
    if loop.statistics is not None:
        _draw_times(next(free), loop.statistics, loop.seen.t[:-1])
    for ax in axes[:, 0]:
        ax.set_xlim(real.t[0], real.t[-1])
        ax.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, fontsize="small")
    axes[0, 0].set_title(title, loc="left", fontsize="medium")
    axes[-1, 0].set_xlabel("time [s]")
    return figure


def _unknowns(estimate: Trajectory, real: Trajectory) -> list[str]:
    """Estimated quantities that are no states of the real side."""
    states = set(real.named("state"))
    return [n for n in estimate.names if not n.startswith("deviation.") and n not in states]


def _draw_error(ax: Axes, real: Trajectory, wanted: Trajectory, name: str) -> None:
    """The error where it is small: jumps of the reference reach out of the panel."""
    variable = real.variable(name)
    error = (real[name] - wanted[name]) / variable.display_factor
    reach = max(3 * float(np.median(np.abs(error))), 1e-12)
    ax.plot(real.t, error, color=COLOURS[1], lw=1.2, label="error")
    ax.set_ylim(-2 * reach, 2 * reach)
    ax.set_ylabel(f"error [{variable.display_unit}]")


def _draw_unknown(ax: Axes, estimate: Trajectory, real: Trajectory, name: str) -> None:
    variable = estimate.variable(name)
    factor = variable.display_factor
    value, deviation = estimate[name] / factor, estimate[f"deviation.{name}"] / factor
    ax.plot(estimate.t, value, color=COLOURS[3], lw=1.4, label="estimated")
    band: dict[str, Any] = {"color": COLOURS[3], "alpha": 0.2, "lw": 0}
    ax.fill_between(estimate.t, value - 2 * deviation, value + 2 * deviation, **band)
    late = slice(len(value) // 5, None)  # the first guess would set the scale
    low, high = np.min((value - 3 * deviation)[late]), np.max((value + 3 * deviation)[late])
    if name in real:
        truth = real[name] / factor
        ax.plot(real.t, truth, "k:", lw=1.0, drawstyle="steps-post", label="true")
        low, high = min(low, truth.min()), max(high, truth.max())
    margin = 0.1 * max(high - low, 1e-12)
    ax.set_ylim(low - margin, high + margin)
    ax.set_ylabel(variable.label)


def _draw_times(ax: Axes, statistics: MpcStatistics, t: Array) -> None:
    seconds = np.array([s.seconds for s in statistics.steps])
    ax.plot(t, 1e3 * seconds, ".", ms=2.5, color=COLOURS[5], label="step time")
    ax.axhline(1e3 * statistics.median, color=COLOURS[2], lw=1.0, label="median")
    ax.set_ylim(bottom=0, top=1.1e3 * statistics.worst)
    ax.set_ylabel("time [ms]")


def plot_durations(histograms: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Histograms {what: (edges [s] (n + 1), counts (n))} of durations, both axes logarithmic."""
    figure, axes = new_figure(1, len(histograms), size=(8.5, 3.2))
    for ax, (what, (edges, counts)) in zip(axes[0], histograms.items(), strict=True):
        micro = 1e6 * np.asarray(edges, dtype=float)
        micro[0] = max(micro[0], micro[1] / 2)
        if not np.isfinite(micro[-1]):
            micro[-1] = 2 * micro[-2]
        there = np.flatnonzero(counts)
        ax.stairs(np.maximum(counts, 0.5), micro, baseline=0.5, fill=True, color=COLOURS[0])
        ax.set(xscale="log", yscale="log", xlabel=f"{what} [us]", ylabel="samples")
        if len(there):
            ax.set_xlim(micro[there[0]] / 1.5, micro[there[-1] + 1] * 1.5)
    return figure

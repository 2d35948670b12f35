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
from ..core.interrupts import interruptible
from ..core.trajectory import Trajectory
from .canvas import COLOURS, caption, draw, ink, name_beside, panels

if TYPE_CHECKING:
    import control
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..control.loop import ClosedLoop
    from ..control.mpc_statistics import MpcStatistics

Array: TypeAlias = NDArray[np.float64]


@interruptible()
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
    shown = [(first.variable(n).name, False) for n in names]
    shown += [(n, True) for n, _ in shown if n in wanted]
    figure, axes = panels(len(shown), size=(8.5, 1.0 + 1.8 * len(shown)))
    for ax, (name, error) in zip(axes, shown, strict=True):
        variable = first.variable(name)
        for i, (words, run) in enumerate(runs.items()):
            colour, line = COLOURS[i % len(COLOURS)], "-" if i < 3 else "--"
            style: dict[str, Any] = {"linewidth": 1.4, "label": words, "linestyle": line}
            if error:
                goal = np.array([wanted[name](t) for t in run.t])
                ax.plot(run.t, (run[name] - goal) / variable.display_factor, color=colour, **style)
            else:
                draw(ax, run, name, colour, **style)
        if not error and name in wanted:
            goal = np.array([wanted[name](t) for t in first.t]) / variable.display_factor
            ax.plot(first.t, goal, color=ink(), lw=1.0, ls="--", label="reference")
        unit = "" if variable.display_unit == "1" else f" [{variable.display_unit}]"
        ax.set_ylabel(f"error of {name}{unit}" if error else variable.label)
    figure.legend(
        *axes[0].get_legend_handles_labels(),
        loc="outside upper left",
        frameon=False,
        fontsize="small",
        ncols=3,
    )
    caption(axes[0], title=title)
    caption(axes[-1], "time [s]")
    return figure


@interruptible()
def plot_bode_cloud(cloud: BodeCloud, level: float = 0.95, title: str = "") -> Figure:
    """Every response thinly, the nominal one on top; below, magnitudes over the nominal one, with
    the band that holds ``level`` of them."""
    figure, (magnitude, phase, relative) = panels(3, size=(8, 8))
    size = np.abs(cloud.nominal)
    for i, response in enumerate(cloud.responses):
        style: dict[str, Any] = {"color": COLOURS[0], "lw": 0.6, "alpha": 0.3}
        words = f"{len(cloud.responses)} draws" if i == 0 else None
        magnitude.loglog(cloud.frequency, np.abs(response), label=words, **style)
        phase.semilogx(cloud.frequency, np.degrees(np.unwrap(np.angle(response))), **style)
        relative.semilogx(cloud.frequency, 100 * (np.abs(response) / size - 1), **style)
    low, high = (100 * (bound / size - 1) for bound in cloud.band(level))
    band = f"{100 * level:g} % of them"
    relative.fill_between(cloud.frequency, low, high, color=COLOURS[4], alpha=0.3, lw=0, label=band)
    magnitude.loglog(cloud.frequency, size, color=COLOURS[1], lw=1.4, label="nominal")
    angle = np.degrees(np.unwrap(np.angle(cloud.nominal)))
    phase.semilogx(cloud.frequency, angle, color=COLOURS[1], lw=1.4)
    relative.axhline(0.0, color=COLOURS[1], lw=1.4)
    gain = f"|{cloud.output} / {cloud.source}| (SI)"
    caption(magnitude, y=gain, title=title, names="upper left")
    caption(phase, y="phase [deg]")
    caption(relative, "frequency [Hz]", "magnitude over\nnominal, less 1 [%]", names="upper left")
    return figure


@interruptible()
def plot_loop(
    loops: Mapping[str, control.StateSpace],
    found: Mapping[str, Margins] | None = None,
    hertz: tuple[float, float] = (0.05, 500.0),
) -> Figure:
    """Smallest singular value of I + L (robustness) and largest sensitivity over frequency.

    loops : {label: loop gain broken at the inputs}, as ``StateFeedback.loop``.
    """
    figure, (upper, lower) = panels(2, size=(8, 6))
    frequency = np.geomspace(*hertz, 600)
    for name, loop in loops.items():
        response = frequency_response(loop, frequency)
        values = np.linalg.svd(np.eye(loop.ninputs) + response, compute_uv=False)
        gain = np.linalg.svd(response, compute_uv=False)[:, 0]
        text = name
        if found is not None and name in found:
            text += f" (phase margins {', '.join(f'{p:.0f}' for p in found[name].phase)} deg)"
        upper.loglog(frequency, gain, label=text)
        lower.loglog(frequency, 1 / values[:, -1], label=name)
    for ax in (upper, lower):
        ax.axhline(1.0, color="#999999", lw=0.8, ls=":")
    caption(upper, y="largest gain of the loop L", names="best")
    caption(lower, "frequency [Hz]", "sensitivity of the inputs")
    return figure


@interruptible()
def plot_stroke(strokes: Mapping[str, Stroke], title: str = "") -> Figure:
    """Reach, weakest direction, visibility and modes along the stroke, for labelled studies."""
    shown = (
        ("reach", "reach of the position\n[nominal]"),
        ("weakest", "reach in the weakest\ndirection [nominal]"),
        ("visible", "visibility of the\nleast visible [nominal]"),
        ("frequency", "natural frequency [Hz]"),
        ("damping", "damping ratio"),
    )
    first = next(iter(strokes.values()))
    variable = first.points[0].plant.variable(first.name)
    figure, axes = panels(len(shown), size=(8, 9.5))
    for ax, (attribute, words) in zip(axes, shown, strict=True):
        for name, stroke in strokes.items():
            values = getattr(stroke, attribute)
            ax.plot(stroke.values / variable.display_factor, values, label=name)
        ax.set_ylabel(words, fontsize="small")
        ax.set_ylim(bottom=0.0)
    caption(axes[0], title=title)
    axes[0].legend(frameon=False, fontsize="small", ncols=3)
    caption(axes[-1], variable.label)
    return figure


@interruptible()
def plot_mode_map(found: ModeMap, title: str = "") -> Figure:
    """Contours of natural frequency and damping ratio over the two axes;
    blank without equilibrium.
    """
    figure, axes = panels(1, 2, size=(11, 4.6), sharex=False)
    (outer, rows), (inner, columns) = found.axes.items()
    x, y = found.plant.variable(outer), found.plant.variable(inner)
    maps = (found.frequency, "natural frequency [Hz]"), (found.damping, "damping ratio")
    for ax, (values, words) in zip(axes, maps, strict=True):
        shown = np.ma.masked_invalid(values.T)
        places = rows / x.display_factor, columns / y.display_factor, shown
        shading: Any = "gouraud" if not shown.mask.any() else "nearest"
        drawn = ax.pcolormesh(*places, shading=shading, cmap="viridis", rasterized=True)
        if shown.count() and float(np.ptp(shown.compressed())) > 1e-6 * float(np.abs(shown).max()):
            lines = ax.contour(*places, levels=8, colors="white", linewidths=0.8)
            ax.clabel(lines, fontsize=8, fmt="%.3g")
        figure.colorbar(drawn, ax=ax, label=words)
        caption(ax, x.label)
        ax.grid(False)
    caption(axes[0], y=y.label, title=title)
    return figure


# ---- closed loops --------------------------------------------------------------------------------
@interruptible()
def plot_closed_loop(loop: ClosedLoop, title: str = "") -> Figure:
    """Tracked variables with their reference and error, inputs (a panel per unit), unknowns found,
    and step times.

    Bands around unknowns are two standard deviations wide on each side. Where the loop knows no
    reference the states are shown, without errors; where the controller keeps no times, none.
    """
    real, wanted = loop.trajectory, loop.reference
    shown = real.named("state") if wanted is None else wanted.names
    controls: dict[str, list[str]] = {}
    for name in real.named("input"):
        if not real.variable(name).disturbance:
            controls.setdefault(real.variable(name).display_unit, []).append(name)
    unknown = [] if loop.estimate is None else _unknowns(loop.estimate, real)
    rows = len(shown) + (wanted is not None) + len(controls) + len(unknown)
    rows += loop.statistics is not None
    figure, axes = panels(rows, size=(8.5, 1.0 + 1.7 * rows), sharex=False)
    free = iter(axes)
    for name in shown:
        ax = next(free)
        draw(ax, real, name, COLOURS[0])
        if wanted is not None:
            goal = wanted[name] / real.variable(name).display_factor
            ax.plot(real.t, goal, label="reference", **_given())
        ax.set_ylabel(real.variable(name).label)
    if wanted is not None:
        _draw_error(next(free), real, wanted, shown[0])
    for unit, names in controls.items():
        ax = next(free)
        for i, name in enumerate(names):
            draw(ax, real, name, COLOURS[i % len(COLOURS)], linewidth=1.2)
        ax.set_ylabel(f"inputs [{unit}]")
    if loop.estimate is not None:
        for name in unknown:
            _draw_unknown(next(free), loop.estimate, real, name)
    if loop.statistics is not None:
        _draw_times(next(free), loop.statistics, loop.seen.t[:-1])
    for ax in axes:
        ax.set_xlim(real.t[0], real.t[-1])
        name_beside(ax)
    caption(axes[0], title=title)
    caption(axes[-1], "time [s]")
    return figure


def _given() -> dict[str, Any]:
    """The style of what is told, not found."""
    return {"color": ink(), "ls": ":", "lw": 1.0, "drawstyle": "steps-post"}


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
        ax.plot(real.t, truth, label="true", **_given())
        low, high = min(low, truth.min()), max(high, truth.max())
    margin = 0.1 * max(high - low, 1e-12)
    ax.set_ylim(low - margin, high + margin)
    ax.set_ylabel(variable.label)


def _draw_times(ax: Axes, statistics: MpcStatistics, t: Array) -> None:
    seconds = statistics.seconds
    ax.plot(t[-len(seconds) :], 1e3 * seconds, ".", ms=2.5, color=COLOURS[5], label="step time")
    ax.axhline(1e3 * statistics.median, color=COLOURS[2], lw=1.0, label="median")
    ax.set_ylim(bottom=0, top=1.1e3 * statistics.worst)
    ax.set_ylabel("time [ms]")


@interruptible()
def plot_durations(histograms: Mapping[str, tuple[Array, Array]]) -> Figure:
    """Histograms {what: (edges [s] (n + 1), counts (n))} of durations, both axes logarithmic."""
    figure, axes = panels(1, len(histograms), size=(8.5, 3.2), sharex=False)
    for ax, (what, (edges, counts)) in zip(axes, histograms.items(), strict=True):
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

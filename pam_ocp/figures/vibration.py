"""Pictures of vibrations; each returns a matplotlib Figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.interrupts import interruptible
from ..core.trajectory import Trajectory
from ..numerics.newton import Array
from ..plants.plant import Plant
from .canvas import COLOURS, caption, colour_scale, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..operating.along import StabilityPath
    from ..vibration.cycle import LimitCycle
    from ..vibration.cycle_branch import CycleBranch
    from ..vibration.energy_balance import Energy
    from ..vibration.free import Backbone, FreeVibration
    from ..vibration.hopf_bifurcation import HopfBorder
    from ..vibration.maps import AmplitudeMap, HopfMap


@interruptible()
def plot_phase(
    trajectories: Sequence[Trajectory],
    state: str,
    plant: Plant,
    *,
    labels: Sequence[str] = (),
    values: Array | None = None,
    label: str = "",
) -> Figure:
    """Phase portrait: the velocity of a position over it, one line for each trajectory.

    labels : one for each line; or values : a number for each line, shown as colour, named
        ``label``.
    """
    position = plant.variable(state)
    rate = plant.positions.get(position.name)
    if rate is None:
        raise InputError(
            f"state: {position.name} has no velocity among the states; name a position"
        )
    velocity = plant.variable(rate)
    figure, (ax,) = panels(1, size=(6.4, 5.2))
    if values is None:
        colours: list[Any] = [COLOURS[i % len(COLOURS)] for i in range(len(trajectories))]
    else:
        ends = float(np.min(values)), float(np.max(values)) * (1 + 1e-12)
        colours = list(colour_scale(ax, ends, label).to_rgba(values))
    for i, trajectory in enumerate(trajectories):
        ax.plot(
            trajectory[position.name] / position.display_factor,
            trajectory[velocity.name] / velocity.display_factor,
            color=colours[i],
            lw=1.1,
            label=labels[i] if i < len(labels) else None,
        )
    caption(ax, position.label, velocity.label, names="upper right" if labels else "")
    return figure


@interruptible()
def plot_envelope(motion: FreeVibration) -> Figure:
    """Deviation from rest with the envelope through its turning points;
    frequency per cycle below.
    """
    variable = motion.point.plant.variable(motion.state)
    factor = variable.display_factor
    figure, (upper, lower) = panels(2, size=(8, 5.5))
    t = motion.trajectory.t
    upper.plot(
        t, (motion.trajectory[motion.state] - motion.rest) / factor, color=COLOURS[0], lw=1.2
    )
    times, deviations = motion.peaks
    for above in (True, False):
        side = (deviations > 0) == above
        style: dict[str, Any] = {"color": COLOURS[1], "ms": 3, "lw": 1.0}
        style["label"] = "envelope" if above else None
        upper.plot(times[side], deviations[side] / factor, "o--", **style)
    caption(upper, y=f"{variable.name} - rest [{variable.display_unit}]", names="upper right")
    middles = (motion.crossings[:-1] + motion.crossings[1:]) / 2
    lower.plot(middles, motion.frequencies, "o-", color=COLOURS[0], ms=3, lw=1.0)
    _readable(lower, motion.frequencies)
    caption(lower, "time [s]", "frequency [Hz]")
    return figure


def _readable(ax: Axes, values: Array) -> None:
    """Keep the axis from blowing up rounding: at least 1 % of the value is shown."""
    middle, half = (values.max() + values.min()) / 2, np.ptp(values) / 2
    half = max(1.1 * half, 0.01 * abs(middle))
    ax.set_ylim(middle - half, middle + half)
    ax.ticklabel_format(axis="y", useOffset=False)


@interruptible()
def plot_backbone(curves: Mapping[str, Backbone]) -> Figure:
    """Frequency over amplitude, one line for each named backbone."""
    figure, (ax,) = panels(1, size=(7, 4.2))
    for name, curve in curves.items():
        variable = curve.point.plant.variable(curve.state)
        order = np.argsort(curve.amplitudes)
        amplitudes = curve.amplitudes[order] / variable.display_factor
        ax.plot(amplitudes, curve.frequencies[order], "o-", ms=3.5, lw=1.3, label=name or None)
        caption(ax, f"amplitude of {variable.name} [{variable.display_unit}]")
    caption(ax, y="frequency [Hz]", names="best" if any(curves) else "")
    ax.ticklabel_format(axis="y", useOffset=False)
    return figure


@interruptible()
def plot_energy(energy: Energy) -> Figure:
    """Energies over time; below, the power that the resistance takes."""
    figure, (upper, lower) = panels(2, size=(8, 5.5))
    # the zero of the potential is arbitrary: here its smallest value
    shift = energy.potential.min()
    upper.plot(energy.t, energy.kinetic, color=COLOURS[0], lw=1.0, label="kinetic")
    upper.plot(energy.t, energy.potential - shift, color=COLOURS[2], lw=1.0, label="potential")
    upper.plot(energy.t, energy.total - shift, color=COLOURS[1], lw=1.8, label="total")
    lower.plot(energy.t, energy.rate, color=COLOURS[1], lw=1.2)
    caption(upper, y="energy [J]", names="upper right")
    caption(lower, "time [s]", "dE/dt [W]")
    return figure


@interruptible()
def plot_stability(path: StabilityPath) -> Figure:
    """Eigenvalues in the complex plane along the path, and the growth rate over the parameter."""
    variable = path.plant.variable(path.parameter)
    values = path.values / variable.display_factor
    figure, (plane, growth) = panels(1, 2, size=(10, 4.4), sharex=False)
    scale = colour_scale(plane, (values.min(), values.max()), variable.label)
    for column in path.eigenvalues.T:
        plane.scatter(column.real, column.imag, c=scale.to_rgba(values), s=12)
    plane.axvline(0.0, color="#555555", lw=0.8)
    growth.plot(values, path.growth, color=COLOURS[0], lw=1.5)
    growth.axhline(0.0, color="#555555", lw=0.8)
    caption(plane, "real part [1/s]", "imaginary part [rad/s]")
    caption(growth, variable.label, "largest real part [1/s]")
    return figure


@interruptible()
def plot_border(border: HopfBorder) -> Figure:
    """The border over the two parameters, coloured by what is born there; frequency below."""
    point = next(p for p in border.points if p is not None)
    first, second = (point.plant.variable(n) for n in (border.parameter, border.over))
    figure, (upper, lower) = panels(2, size=(7.5, 6.5))
    x = border.values / second.display_factor
    y = border.border / first.display_factor
    upper.plot(x, y, color="#555555", lw=1.0)
    kinds = ("supercritical: a stable cycle is born", "subcritical: an unstable cycle is born")
    for wanted, colour, text in zip((True, False), (COLOURS[0], COLOURS[1]), kinds, strict=True):
        chosen = (border.supercritical == wanted) & np.isfinite(y)
        if chosen.any():
            upper.plot(x[chosen], y[chosen], "o", color=colour, ms=4, label=text)
    top = 1.15 * float(np.nanmax(y))
    up = point.crossing > 0
    upper.fill_between(
        x, y, top if up else 0.0, color=COLOURS[1], alpha=0.08, lw=0, label="rest is unstable"
    )
    upper.set_ylim(0.0 if np.nanmin(y) > 0 else None, top)
    lower.plot(x, border.frequencies, "o-", color=COLOURS[2], ms=3.5, lw=1.0)
    caption(upper, y=first.label, names="best")
    caption(lower, second.label, "frequency [Hz]")
    if np.nanmin(x) > 0 and np.nanmax(x) > 20 * np.nanmin(x):
        lower.set_xscale("log")
    return figure


@interruptible()
def plot_multipliers(cycle: LimitCycle) -> Figure:
    """Floquet multipliers in the complex plane, with the unit circle."""
    figure, (ax,) = panels(1, size=(5, 5))
    angle = np.linspace(0, 2 * np.pi, 200)
    ax.plot(np.cos(angle), np.sin(angle), color="#888888", lw=1.0)
    first, *others = cycle.multipliers
    ax.plot([first.real], [first.imag], "o", color="#888888", ms=7, label="1 (shift in time)")
    ax.plot(
        np.real(others), np.imag(others), "x", color=COLOURS[1], ms=8, mew=2, label="the others"
    )
    ax.set_aspect("equal", adjustable="datalim")
    caption(ax, "real part", "imaginary part", names="upper left")
    return figure


@interruptible()
def plot_branch(branch: CycleBranch, state: str) -> Figure:
    """Amplitude and frequency over the parameter; stable parts solid, unstable ones dashed."""
    plant = branch.cycles[0].plant
    variable, swings = plant.variable(branch.parameter), plant.variable(state)
    figure, (upper, lower) = panels(2, size=(7.5, 6.5))
    x = branch.values / variable.display_factor
    rows = (branch.amplitudes(state) / swings.display_factor, 1 / branch.periods)
    for ax, y in zip((upper, lower), rows, strict=True):
        _by_stability(ax, x, y, branch.stable)
    caption(upper, y=f"amplitude of {swings.name} [{swings.display_unit}]", names="best")
    words = f": {variable.description}" if variable.description else ""
    caption(lower, f"{variable.label}{words}", "frequency [Hz]")
    return figure


def _by_stability(ax: Axes, x: Array, y: Array, stable: NDArray[np.bool_]) -> None:
    for wanted, style, name in ((True, "-", "stable"), (False, "--", "unstable")):
        # a line between two cycles belongs to the second of them
        for i in np.flatnonzero(stable[1:] == wanted) + 1:
            ax.plot(x[i - 1 : i + 1], y[i - 1 : i + 1], style, color=COLOURS[not wanted], lw=1.5)
        chosen = stable == wanted
        if chosen.any():
            ax.plot(x[chosen], y[chosen], "o", color=COLOURS[not wanted], ms=3.5, label=name)


# ---- maps over two values ------------------------------------------------------------------------
@interruptible()
def plot_hopf_map(found: HopfMap) -> Figure:
    """The border and its frequency as maps; crosses where vibration begins with a jump."""
    plant = next(p for row in found.points for p in row if p is not None).plant
    parameter = plant.variable(found.parameter)
    figure, (left, right) = panels(1, 2, size=(10.5, 4.2), sharex=False)
    border = found.border / parameter.display_factor
    _field(left, plant, found.axes, border, f"border: {parameter.label}")
    _field(right, plant, found.axes, found.frequencies, "frequency at the border [Hz]")
    hard = found.lyapunov > 0
    _marks(left, plant, found.axes, hard, "begins with a jump", "x")
    return figure


@interruptible()
def plot_amplitude_map(found: AmplitudeMap) -> Figure:
    """Amplitude and frequency as maps, with the border of stability of the rest."""
    variable = found.plant.variable(found.state)
    figure, (left, right) = panels(1, 2, size=(10.5, 4.2), sharex=False)
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


def _field(ax: Axes, plant: Plant, axes: Mapping[str, Array], values: Array, words: str) -> None:
    """Values (n, m) as colours of cells around the points; unknown ones hatched."""
    x, y = _scaled(plant, axes)
    ax.set_facecolor("#eeeeee")
    mesh = ax.pcolormesh(x, y, np.ma.masked_invalid(values.T), shading="nearest", cmap="cividis")
    ax.figure.colorbar(mesh, ax=ax, label=words)
    ax.grid(False)
    caption(ax, *(plant.variable(n).label for n in axes))


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

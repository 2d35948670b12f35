"""Pictures of motions, muscles and fits. matplotlib is loaded only when one is drawn; figures need
no display.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError
from ..core.interrupts import interruptible
from ..core.trajectory import Trajectory
from ..muscles.validity import ValidityWarning
from .canvas import (
    COLOURS,
    MARKS,
    STROKES,
    axis_label,
    caption,
    colour_scale,
    draw,
    ink,
    layered,
    legible,
    name_beside,
    over_time,
    panels,
    plotly,
)
from .paper import paper_size, paper_width

if TYPE_CHECKING:
    import control
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ..fitting.static.force_fit import ForceFit
    from ..muscles.pneumatic_muscle import Muscle
    from ..simulation.compare import RecordComparison

Array: TypeAlias = NDArray[np.float64]
Quantity: TypeAlias = Literal["force", "stiffness"]

POINTS = 60
"""Of a surface along each axis."""
_LABELS = {"force": "pulling force [N]", "stiffness": "stiffness [N/mm]"}
DASHES = ("solid", "dash", "dashdot", "dot")
"""Strokes as plotly calls them."""


@interruptible()
def plot_trajectory(
    trajectory: Trajectory,
    names: Sequence[str] | None = None,
    *,
    ax: Axes | None = None,
    interactive: bool = False,
) -> Any:
    """One panel per display unit (and kind of quantity), over time.

    ax : draw into this panel of the user's; the names must then be of one unit.
    interactive : a plotly figure instead.
    """
    chosen = [trajectory.variable(n).name for n in (trajectory.names if names is None else names)]
    if not chosen:
        raise InputError("names is empty: nothing to draw")
    units: dict[str, list[str]] = {}
    for name in chosen:
        units.setdefault(trajectory.variable(name).display_unit, []).append(name)
    if interactive:
        return _interactive(trajectory, list(units.values()))
    if ax is not None:
        if len(units) > 1:
            raise InputError(
                f"ax: one panel holds one unit, and these names have {', '.join(units)}; give "
                "names of one unit"
            )
        for name, style in zip(chosen, layered(len(chosen)), strict=True):
            draw(ax, trajectory, name, **style)
        caption(ax, "time [s]", axis_label(*map(trajectory.variable, chosen)), names="best")
        return ax.figure
    parts = [part for members in units.values() for part in legible(members)]
    figure, axes = over_time(len(parts))
    for panel, members in zip(axes, parts, strict=True):
        for name, style in zip(members, layered(len(members)), strict=True):
            if trajectory.variable(name).causality == "input":
                style["linestyle"] = "--"
            draw(panel, trajectory, name, **style)
        caption(panel, y=axis_label(*map(trajectory.variable, members)))
        name_beside(panel)
    return figure


def _interactive(trajectory: Trajectory, parts: Sequence[Sequence[str]]) -> Any:
    """The same panels as a figure of plotly's, which answers the mouse."""
    objects, make_subplots = plotly()
    figure = make_subplots(rows=len(parts), shared_xaxes=True, vertical_spacing=0.03)
    for row, members in enumerate(parts, start=1):
        for i, name in enumerate(members):
            variable = trajectory.variable(name)
            held = variable.causality == "input" and trajectory.interpolation == "previous"
            dash = DASHES[(i // len(COLOURS)) % len(DASHES)]
            dash = "dash" if variable.causality == "input" else dash
            line = objects.Scatter(
                x=trajectory.t,
                y=trajectory[name] / variable.display_factor,
                name=name,
                line={"color": COLOURS[i % len(COLOURS)], "dash": dash},
                line_shape="hv" if held else "linear",
            )
            figure.add_trace(line, row=row, col=1)
        label = axis_label(*map(trajectory.variable, members)).replace("\n", " ")
        figure.update_yaxes(title_text=label, row=row, col=1)
    figure.update_xaxes(title_text="time [s]", row=len(parts), col=1)
    height = 120 + 190 * len(parts)
    figure.update_layout(height=height, template="plotly_white", hovermode="x unified")
    return figure


@interruptible()
def plot_fit(fit: ForceFit, title: str = "", *, ax: Axes | None = None) -> Any:
    """Measured and fitted force over contraction, one line per pressure; residuals below.

    ax : only the forces, into this panel of the user's.
    """
    if ax is not None:
        _draw_forces(fit, ax, title)
        caption(ax, "contraction [%]")
        return ax.figure
    table = fit.table
    figure, (upper, lower) = panels(2, size=(8, 7))
    _draw_forces(fit, upper, title)
    pressures = np.unique(table.pressure)
    for colour, p in zip(_colours(pressures), pressures, strict=True):
        taut = (table.pressure == p) & ~table.slack
        residual = table.force[taut] - np.asarray(fit.law.tension(p, table.contraction[taut]))
        lower.plot(100 * table.contraction[taut], residual, "o", color=colour, ms=4)
    _pressure_scale([upper, lower], pressures)
    lower.axhline(0.0, color="#555555", lw=0.8)
    caption(lower, "contraction [%]", "measured - fitted [N]")
    return figure


def _draw_forces(fit: ForceFit, upper: Axes, title: str) -> None:
    """Measured cells and the law."""
    table = fit.table
    pressures = np.unique(table.pressure)
    shade = _colours(pressures)
    grid = np.linspace(0.0, float(table.contraction.max()) * 1.08, 200)
    for colour, p in zip(shade, pressures, strict=True):
        at = table.pressure == p
        taut, slack = at & ~table.slack, at & table.slack
        upper.plot(100 * table.contraction[taut], table.force[taut], "o", color=colour, ms=4)
        upper.plot(
            100 * table.contraction[slack], table.force[slack], "x", color=colour, ms=3, alpha=0.5
        )
        model = np.maximum(np.asarray(fit.law.tension(p, grid)), 0.0)
        upper.plot(100 * grid, model, "-", color=colour, lw=1.0)
    upper.set_ylim(bottom=-0.03 * float(table.force.max()))
    heading = title or f"{fit.law.title}: RMSE {fit.rmse:.2f} N over {len(table.taut)} cells"
    upper.plot([], [], "o", color=ink(), ms=4, label="measured")
    upper.plot([], [], "x", color=ink(), ms=3, label="slack (not fitted)")
    upper.plot([], [], "-", color=ink(), lw=1, label="fitted law")
    caption(upper, y="pulling force [N]", title=heading, names="best")


def _colours(values: Any) -> Any:
    """A colour for each value, from dark (least) to bright (largest)."""
    from matplotlib import colormaps

    spread = float(np.ptp(values)) or 1.0
    return colormaps["viridis"](0.9 * (values - np.min(values)) / spread)


def _pressure_scale(axes: list[Any], pressures: Any) -> None:
    """The colour bar that goes with :func:`_colours`."""
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    if len(pressures) < 2:
        return
    ends = float(pressures.min()) / 1e5, float(pressures.max()) / 1e5
    part = ListedColormap(colormaps["viridis"](np.linspace(0.0, 0.9, 256)))
    colour_scale(axes, ends, "pressure [bar gauge]", part, fraction=0.05)


@interruptible()
def plot_comparison(
    reference: Trajectory, other: Trajectory, names: Sequence[str], labels: tuple[str, str]
) -> Figure:
    """Two trajectories over each other, and their difference scaled by nominals below."""
    figure, (*axes, last) = panels(len(names) + 1, size=(8, 2.0 + 1.6 * len(names)))
    there = other if np.array_equal(reference.t, other.t) else other.at(reference.t)
    for i, (ax, name) in enumerate(zip(axes, names, strict=True)):
        colour = COLOURS[i % len(COLOURS)]
        draw(ax, reference, name, "#bbbbbb", linewidth=3.5, label=labels[0])
        draw(ax, there, name, colour, linewidth=1.1, label=labels[1])
        caption(ax, y=reference.variable(name).label, names="upper right")
        difference = np.abs(there[name] - reference[name]) / reference.variable(name).nominal
        last.semilogy(reference.t, np.maximum(difference, 1e-17), color=colour, lw=1.2, label=name)
    caption(last, "time [s]", "|difference| / nominal")
    last.legend(frameon=False, fontsize="small", ncols=3)
    return figure


@interruptible()
def plot_bode(
    systems: dict[str, control.StateSpace],
    output: str,
    source: str,
    hertz: tuple[float, float] = (0.1, 100.0),
    units: tuple[str, str] | None = None,
) -> Figure:
    """Bode diagram from one input to one output, for each named system; decibels on the right.

    units : of output and source, for the axis; by default those of the first system, as
        :func:`pam_ocp.linearize` tells them, else both are called SI.
    """
    own = getattr(next(iter(systems.values()), None), "units", {})
    if units is None and output in own and source in own:
        units = own[output], own[source]
    figure, (magnitude, phase) = panels(2, size=(8, 6))
    frequency = np.geomspace(*hertz, 600)
    for label, system in systems.items():
        row, column = system.output_labels.index(output), system.input_labels.index(source)
        response = np.asarray(system(2j * np.pi * frequency, squeeze=False))[row, column]
        magnitude.loglog(frequency, np.abs(response), label=label)
        phase.semilogx(frequency, np.degrees(np.unwrap(np.angle(response))))
    gain = "SI" if units is None else f"{units[0]} per {units[1]}"
    level = magnitude.twinx()
    level.set_ylim(*(20 * np.log10(end) for end in magnitude.get_ylim()))
    caption(level, y="[dB]")
    caption(magnitude, y=f"|{output} / {source}|\n[{gain}]", names="best")
    caption(phase, "frequency [Hz]", "phase [deg]")
    return figure


@interruptible()
def plot_record(comparison: RecordComparison) -> Figure:
    """Measured and simulated over each other, and the residual, for each compared variable."""
    return plot_records([comparison])


@interruptible()
def plot_records(comparisons: Sequence[RecordComparison]) -> Figure:
    """The same of several records, one below the other."""
    rows = [(c, a) for c in comparisons for a in c.agreements]
    figure, axes = panels(len(rows), 2, size=(11, 1.0 + 2.1 * len(rows)), sharex=False)
    for left, right, (comparison, agreement) in zip(axes[::2], axes[1::2], rows, strict=True):
        variable = comparison.measured.variable(agreement.name)
        name, measured, simulated = agreement.name, comparison.measured, comparison.simulated
        draw(left, measured, name, "#888888", linewidth=2.6, label="measured")
        draw(left, simulated, name, COLOURS[0], linewidth=1.2, label="simulated")
        caption(left, y=variable.label, names="best")
        left.set_title(f"fit {agreement.fit_percent:.1f} %", loc="left", fontsize="small")
        residual = (measured[name] - simulated[name]) / variable.display_factor
        right.plot(measured.t, residual, color=COLOURS[1], lw=1.2)
        right.axhline(0.0, color="#555555", lw=0.8)
        said = f"measured - simulated, RMSE {variable.shown(agreement.rmse)}"
        right.set_title(said, loc="left", fontsize="small")
        right.sharex(left)
    for ax in axes[-2:]:
        caption(ax, "time [s]")
    return figure


@interruptible()
def plot_load_study(title: str, lines: Mapping[str, Mapping[str, Sequence[float]]]) -> Figure:
    """Rest, frequency, damping ratio, overshoot, settling time and air against pressure.

    lines : {label: {column of a load study: values [SI]}}, ``pressure`` among the columns.
    """
    shown = (
        ("position", "contraction [mm]", 1e3),
        ("frequency", "natural frequency [Hz]", 1.0),
        ("damping_ratio", "damping ratio", 1.0),
        ("overshoot", "overshoot [%]", 100.0),
        ("settling_time", "settling time [s]", 1.0),
        ("air", "air for the step [mg]", 1e6),
    )
    figure, axes = panels(3, 2, size=(10, 9))
    for ax, (name, words, factor) in zip(axes, shown, strict=True):
        most = 0.0
        for i, (label, columns) in enumerate(lines.items()):
            bars = [p / 1e5 for p in columns["pressure"]]
            values = [v * factor for v in columns[name]]
            mark, line = MARKS[i % len(MARKS)], STROKES[i % len(STROKES)]
            ax.plot(bars, values, line, marker=mark, ms=4, label=label)
            most = max(most, *(v for v in values if np.isfinite(v)), 0.0)
        caption(ax, y=words)
        ax.set_ylim(0.0, 1.08 * most or 1.0)  # a constant must not lie on the frame
    caption(axes[0], title=title, names="best")
    for ax in axes[-2:]:
        caption(ax, "pressure [bar gauge]")
    return figure


@interruptible()
def plot_muscle(muscle: Muscle, *, ax: Axes | None = None) -> Any:
    """Force and stiffness over contraction, one line per pressure, within the measured range.

    ax : only the force, into this panel of the user's.
    """
    figure: Any = None
    shown: list[Any] = [ax]
    if ax is None:
        figure, shown = panels(1, 2, size=(11, 4.6), sharex=False)
    low, high = muscle.contraction_range
    kappa = np.linspace(min(low, 0.0), high, 300)
    pressures = np.linspace(muscle.pressure_range[0], muscle.pressure_range[1], 7)[1:]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ValidityWarning)
        for colour, p in zip(_colours(pressures), pressures, strict=True):
            drawn = muscle.force(p, kappa), muscle.stiffness(p, kappa) / 1e3
            for panel, values in zip(shown, drawn, strict=False):
                panel.plot(100 * kappa, values, color=colour, lw=1.6, label=f"{p / 1e5:.2g} bar")
    labels = "pulling force [N]", "stiffness at constant pressure [N/mm]"
    for panel, label in zip(shown, labels, strict=False):
        caption(panel, "contraction [%]", label)
        panel.set_ylim(bottom=0.0)
    title = f"{muscle.name}: {muscle.law.title}"
    caption(shown[0], title=title, names="best" if ax is not None else "")
    if ax is not None:
        return ax.figure
    _pressure_scale(shown, pressures)
    return figure


# ---- surfaces over contraction and pressure ------------------------------------------------------
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

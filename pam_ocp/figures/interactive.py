"""Figures that answer the mouse, by plotly (the extra ``interactive``)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.lazy import library
from ..core.trajectory import Trajectory
from .canvas import COLOURS, axis_label

__all__ = ["surface", "trajectory_panels"]

Array: TypeAlias = NDArray[np.float64]
DASHES = ("solid", "dash", "dashdot", "dot")


def _plotly() -> tuple[Any, Any]:
    """(graph objects, make_subplots). Raises InputError where plotly is not installed."""
    library("plotly", "interactive", "interactive=True")
    import plotly.graph_objects as objects
    from plotly.subplots import make_subplots

    return objects, make_subplots


def trajectory_panels(trajectory: Trajectory, panels: Sequence[Sequence[str]]) -> Any:
    """One panel per unit over time, as :func:`pam_ocp.figures.trajectory.plot_trajectory`."""
    objects, make_subplots = _plotly()
    figure = make_subplots(rows=len(panels), shared_xaxes=True, vertical_spacing=0.03)
    for row, members in enumerate(panels, start=1):
        for i, name in enumerate(members):
            variable = trajectory.variable(name)
            held = variable.causality == "input" and trajectory.interpolation == "previous"
            dash = "dash" if variable.causality == "input" else DASHES[(i // len(COLOURS)) % 4]
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
    figure.update_xaxes(title_text="time [s]", row=len(panels), col=1)
    figure.update_layout(
        height=120 + 190 * len(panels), template="plotly_white", hovermode="x unified"
    )
    return figure


def surface(
    x: Array,
    y: Array,
    z: Array,
    label: str,
    title: str,
    cells: tuple[Array, Array, Array] | None,
) -> Any:
    """A surface over contraction [%] and pressure [bar]; cells (SI) as points."""
    objects, _ = _plotly()
    drawn = [objects.Surface(x=x, y=y, z=z, colorscale="Viridis", opacity=0.9, name=label)]
    if cells is not None:
        mark = {"size": 3, "color": COLOURS[1]}
        there = {"x": 100 * cells[0], "y": cells[1] / 1e5, "z": cells[2]}
        drawn.append(objects.Scatter3d(**there, mode="markers", marker=mark, name="measured"))
    figure = objects.Figure(drawn)
    axes = {
        "xaxis_title": "contraction [%]",
        "yaxis_title": "pressure [bar gauge]",
        "zaxis_title": label,
    }
    figure.update_layout(title=title, scene=axes, template="plotly_white", height=640)
    return figure

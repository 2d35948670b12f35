"""Limbs in space: bones grey, muscles along their paths, coloured by force or pressure."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import UnknownNameError, with_kinds
from ..core.interrupts import interruptible
from ..core.trajectory import Trajectory
from ..plants.limbs import Limb
from .canvas import colour_scale
from .saved import film_of, save_film

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array: TypeAlias = NDArray[np.float64]

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
    figure: Figure = _stage(placed, x, u, colour, view)[0]
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
    figure, draw = _stage(limb, x, u, colour, view)
    return save_film(figure, draw, count, target, fps)


def _stage(limb: Limb, x: Array, u: Array, colour: str, view: tuple[float, float]) -> Any:
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

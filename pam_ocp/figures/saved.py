"""Figures and films in files."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, WriteError, require_count, require_positive
from ..core.files import atomic_path
from ..core.interrupts import interruptible

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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

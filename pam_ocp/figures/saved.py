"""Figures in files."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

from ..core.errors import WriteError
from ..core.files import atomic_path
from ..core.interrupts import interruptible

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["save_figure"]


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
        drawn = io.BytesIO()  # some formats hide what the system refuses while they write
        figure.savefig(drawn, format=target.suffix[1:].lower(), dpi=dpi)
        temporary.write_bytes(drawn.getvalue())
    return target

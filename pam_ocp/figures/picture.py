"""Picture: a figure that shows itself in notebooks, and in a window when it is asked to."""

from __future__ import annotations

import io
import itertools
from typing import Any

from matplotlib import get_backend, rc_context
from matplotlib.figure import Figure

from ..core.errors import InputError
from ..core.interrupts import interruptible
from .paper import VECTORS, adapt, paper_width

_NUMBERS = itertools.count(1001)
"""Of windows: beyond those that pyplot counts from one."""


class Picture(Figure):
    """A matplotlib Figure, for all that matplotlib can do with one.

    As the last line of a notebook's cell it is shown; ``show()`` opens a window.
    """

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._to_adapt = self._printed = paper_width() is not None

    @interruptible()
    def draw(self, renderer: Any) -> None:
        """As matplotlib does; what is for print is made so before it is drawn first."""
        if self._to_adapt:
            self._to_adapt = False
            adapt(self)
        super().draw(renderer)

    @interruptible()
    def savefig(self, fname: Any, **named: Any) -> None:
        """As matplotlib does; what is for print keeps its letters as text."""
        with rc_context(VECTORS if self._printed else {}):
            super().savefig(fname, **named)

    def _repr_png_(self) -> bytes:
        drawn = io.BytesIO()
        self.savefig(drawn, format="png", dpi=90)
        return drawn.getvalue()

    def show(self, warn: bool = True) -> None:
        """Open a window with the figure, or show it in the notebook, as pyplot's backend does.

        Raises InputError where the backend can show nothing (no display).
        """
        import matplotlib.pyplot as plt

        if self.canvas.manager is None:
            canvas = plt.figure().canvas  # of the backend in use, whichever that is
            plt.close(canvas.figure)
            kind = type(canvas)
            if kind.required_interactive_framework is None and "inline" not in get_backend():
                raise InputError(
                    f"matplotlib's backend {get_backend()!r} opens no windows: save the figure by "
                    "figure.savefig('name.png'), or choose another by matplotlib.use(...)"
                )
            kind.new_manager(self, next(_NUMBERS))
        super().show(warn)

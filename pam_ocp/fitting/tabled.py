"""Estimates with intervals as a table: for pandas, and for LaTeX."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING

from .statistics import Coefficient, coefficient_frame

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["Tabled"]

ESCAPES = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
ESCAPES |= {sign: f"\\{sign}" for sign in "&%$#_{}"}
PLAIN = range(-3, 4)
"""Powers of ten of numbers that are written without one."""


class Tabled:
    """What has coefficients and their intervals."""

    if TYPE_CHECKING:

        @property
        def coefficients(self) -> Mapping[str, Coefficient]: ...

        def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]: ...

    def to_pandas(self) -> pd.DataFrame:
        """The estimates as a DataFrame: value, stderr, low, high (95 %), unit; SI."""
        return coefficient_frame(self.coefficients, self.intervals())

    def to_latex(self, level: float = 0.95) -> str:
        r"""The estimates as a LaTeX table (``\usepackage{booktabs}``): value ± standard error, both
        rounded by the latter's second digit, confidence interval, unit; SI.

        Examples
        --------
        >>> print(fit.to_latex().splitlines()[2])
        Parameter & Value $\pm$ standard error & 95\,\% interval & Unit \\
        """
        intervals = self.intervals(level)
        head = rf"Parameter & Value $\pm$ standard error & {100 * level:g}\,\% interval & Unit"
        rows = [
            rf"{_escaped(n)} & {_numbers(c, intervals.get(n))} & {_unit(c.unit)} \\"
            for n, c in self.coefficients.items()
        ]
        begin, end = r"\begin{tabular}{lrrl}", r"\end{tabular}"
        return "\n".join(
            [begin, r"\toprule", rf"{head} \\", r"\midrule", *rows, r"\bottomrule", end]
        )


def _escaped(text: str) -> str:
    return "".join(ESCAPES.get(sign, sign) for sign in text)


def _unit(name: str) -> str:
    """Modelica's spelling, "m3/(s.Pa)", with raised powers."""
    raised = re.sub(r"(?<=[A-Za-z])(-?\d+)", r"$^{\1}$", _escaped(name))
    return "" if name == "1" else raised.replace(".", r"\,")


def _numbers(c: Coefficient, interval: tuple[float, float] | None) -> str:
    """Value and interval, with one power of ten and the decimals that the standard error tells."""
    known = 0 < c.stderr < math.inf and not c.held
    size = abs(c.value) or (c.stderr if known else 1.0)
    power = _order(size)
    power = 0 if power in PLAIN else power
    decimals = power + (1 - _order(c.stderr) if known else 3 - _order(size))

    def text(value: float) -> str:
        if not math.isfinite(value):
            return rf"{'-' if value < 0 else ''}\infty"
        return f"{round(value / 10.0**power, decimals) + 0.0:.{max(decimals, 0)}f}"

    scale = rf" \times 10^{{{power}}}" if power else ""
    if c.held or interval is None:
        return f"${text(c.value)}{scale}$ (held) &"
    both = rf"{text(c.value)} \pm {text(c.stderr)}"
    low, high = map(text, interval)
    return rf"${f'({both}){scale}' if power else both}$ & $[{low},\ {high}]{scale}$"


def _order(size: float) -> int:
    return math.floor(math.log10(size))

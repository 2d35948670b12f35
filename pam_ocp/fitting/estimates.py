"""What the results of all fits have in common: estimates with intervals, tables of them (pandas,
LaTeX), and words about them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import UnknownNameError
from ..core.foreign import frame
from ..core.units import significant
from .statistics import Array, Coefficient, Linearisation

if TYPE_CHECKING:
    import pandas as pd

ESCAPES = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
ESCAPES |= {sign: f"\\{sign}" for sign in "&%$#_{}"}
PLAIN = range(-3, 4)
"""Powers of ten of numbers that are written without one."""
DOUBTFUL = 0.5
"""Probability from which a correlation is a warning; below, it still counts in the intervals."""
LIKELY = 0.95
"""Probability from which a correlation is stated as a fact."""


class Tabled:
    """Estimates with intervals, value ± t standard errors, also as a table."""

    if TYPE_CHECKING:

        @property
        def coefficients(self) -> Mapping[str, Coefficient]: ...

    @property
    def _called(self) -> str:
        """What messages call an estimate."""
        return "estimate"

    def _half(self, c: Coefficient, level: float) -> float:
        """Half width of the interval of an estimate."""
        raise NotImplementedError

    @property
    def _free(self) -> Iterable[str]:
        """What was estimated; the rest was known."""
        return self.coefficients

    def _entry(self, name: str) -> Coefficient:
        if name not in self.coefficients:
            raise UnknownNameError(self._called, name, self.coefficients)
        return self.coefficients[name]

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of an estimate [its unit]."""
        self._entry(name)
        return self.intervals(level)[name]

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals of all estimates."""
        ends = ((c, self._half(c, level)) for c in map(self._entry, self._free))
        return {c.name: (c.value - half, c.value + half) for c, half in ends}

    def _ends(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Intervals of all; of what was held its value, twice."""
        return {n: (c.value, c.value) for n, c in self.coefficients.items()} | self.intervals(level)

    def _row(self) -> dict[str, float]:
        """``a3``, ``a3_stderr``, ``a3_low``, ``a3_high`` (95 %) of each, for a table; SI."""
        found: dict[str, float] = {}
        for n, (low, high) in self._ends().items():
            c = self.coefficients[n]
            found |= {n: c.value, f"{n}_stderr": c.stderr, f"{n}_low": low, f"{n}_high": high}
        return found

    def to_pandas(self) -> pd.DataFrame:
        """The estimates as a DataFrame: value, stderr, low, high (95 %), unit; SI."""
        ends, estimates = self._ends(), self.coefficients.items()
        rows = [(c.value, c.stderr, *ends[n], c.unit, c.held, c.description) for n, c in estimates]
        head = ("value", "stderr", "low", "high", "unit", "held", "description")
        return frame(rows, head, list(ends), "name")

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


class Estimates(Tabled):
    """A result whose estimates are those of a linearised problem near its optimum, unless a kind of
    fit knows better (a profile in place of value ± t standard errors, coefficients held).
    """

    if TYPE_CHECKING:

        @property
        def linearisation(self) -> Linearisation: ...

    @property
    def _free(self) -> Iterable[str]:
        return self.linearisation.names

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """Every estimate by name."""
        linear = self.linearisation
        rows = zip(linear.names, linear.values, linear.stderr(), linear.units, strict=True)
        return {n: Coefficient(n, float(v), float(e), u, False) for n, v, e, u in rows}

    @property
    def values(self) -> dict[str, float]:
        """{estimate: value} [SI]."""
        return {n: c.value for n, c in self.coefficients.items()}

    @property
    def dof(self) -> int:
        """Degrees of freedom: measured values less estimates."""
        return self.linearisation.dof

    @property
    def rank(self) -> int:
        """How many independent combinations of the estimates the data determine."""
        return self.linearisation.rank

    @property
    def condition(self) -> float:
        """Condition number of the Jacobian with columns of unit length."""
        return self.linearisation.condition

    @property
    def covariance(self) -> Array:
        """Covariance of the estimates; of what the data determine where rank is lacking."""
        return self.linearisation.covariance

    @property
    def correlation(self) -> Array:
        """Correlation matrix of the estimates."""
        return self.linearisation.correlation

    def _half(self, c: Coefficient, level: float) -> float:
        return self.linearisation.reach(level) * c.stderr

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the estimates are trusted; empty when there is nothing."""
        return tuple(following(self.linearisation))

    def _coefficient_lines(
        self, title: str, level: float, reasons: Mapping[str, str] | None = None
    ) -> list[str]:
        """Estimates with intervals under a heading; reasons : what is to be said of some."""
        ends, words = self._ends(level), reasons or {}
        lines = (coefficient_line(c, ends[n], words.get(n)) for n, c in self.coefficients.items())
        return [f"{title}; SI", *lines]

    def _warning_lines(self) -> list[str]:
        found = self.warnings
        return ["[[Warnings]]", *(f"    {text}" for text in found)] if found else []


# ---- LaTeX ---------------------------------------------------------------------------------------
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


# ---- words ---------------------------------------------------------------------------------------
def coefficient_line(c: Coefficient, interval: tuple[float, float], reason: str | None = "") -> str:
    """``a3: -56.66 ± 4.5 (8 %), -65.8 .. -47.6``; ``reason`` why an end is open."""
    unit = "" if c.unit == "1" else f" {c.unit}"
    if c.held:
        return f"    {c.name}: {significant(c.value)}{unit} (held)"
    low, high = interval
    relative = f"{100 * c.stderr / abs(c.value):.2g} %" if c.value else "-"
    return (
        f"    {c.name}: {significant(c.value)} ± {significant(c.stderr, 2)}{unit} ({relative}), "
        f"{significant(low)} .. {significant(high)}" + (f" (open: {reason})" if reason else "")
    )


def correlation_lines(linearisation: Linearisation) -> list[str]:
    """Correlations beyond 0.5 under a heading; nothing when there are none."""
    pairs = linearisation.correlated()
    lines = [f"    C({a}, {b}) = {r:+.4f}" for r, a, b in pairs]
    return ["[[Correlations]] (beyond 0.5)", *lines] if lines else []


def at_edge(names: Iterable[str], values: Mapping[str, float]) -> list[str]:
    """Coefficients (by name) that ended at the edge of their range."""
    return [
        f"{name} = {values[name]:g} ended at the edge of its range: its interval means "
        "nothing; hold it with fixed=... or take another law"
        for name in names
    ]


def following(linear: Linearisation) -> list[str]:
    """That errors are serially correlated, and what that does to intervals."""
    serial = linear.serial
    if serial is None or serial.probability < DOUBTFUL:
        return []
    plain, wide = linear.independent.stderr(), linear.stderr()
    seen = np.isfinite(plain) & (plain > 0)
    reach = linear.reach(0.95) / linear.independent.reach(0.95)
    factor = reach * float(np.median(wide[seen] / plain[seen])) if seen.any() else reach
    return [
        f"errors {'are' if serial.probability > LIKELY else 'may be'} serially correlated "
        f"{serial.order} (probability {100 * serial.probability:.3g} %, correlation of neighbours "
        f"about {serial.correlation:.2g}): intervals and bands are widened for it, by a factor of "
        f"about {factor:.2g}"
    ]

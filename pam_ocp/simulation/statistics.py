"""Statistics of numbers that pass by: mean, spread, quantiles; Sobol indices of drawn cases."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_count, require_finite
from ..core.shown import shown

Array: TypeAlias = NDArray[np.float64]

NORMAL = 1.959963984540054
"""Half the width of a 95 % interval, in standard errors."""
CENTROIDS = 2000
"""Of a digest at most: quantiles are good to 1e-3 of the cases and better, at the ends to single
ones."""
BUFFER = 20_000
"""Numbers that wait until they are put into the digest."""
BLOCK = 1024
"""Base samples that are drawn at a time, a power of two."""
LEVEL = 0.95


@dataclass(eq=False)
class Statistic:
    """Mean, spread and quantiles of numbers, which are not kept themselves.

    Quantiles are exact up to 20 000 numbers; beyond, of a t-digest: the error in the share of cases
    is below 1e-3 in the middle, smaller at the ends. Numbers that are NaN count as ``missing``.
    The same numbers in the same order give the same bits.

    Examples
    --------
    >>> import numpy as np
    >>> found = pam.simulation.Statistic().add(np.array([1.0, 2.0, 3.0]))
    >>> found.mean, found.std, found.quantile(0.5)
    (2.0, 1.0, 2.0)
    """

    count: int = 0
    """Of numbers."""
    missing: int = 0
    mean: float = 0.0
    _squares: float = 0.0
    min: float = math.inf
    max: float = -math.inf
    _centres: Array = field(default_factory=lambda: np.empty(0), repr=False)
    _weights: Array = field(default_factory=lambda: np.empty(0), repr=False)
    _waiting: list[Array] = field(default_factory=list, repr=False)

    def add(self, values: Array) -> Statistic:
        """Take further numbers into account; returns itself."""
        there = values[~np.isnan(values)]
        self.missing += len(values) - len(there)
        if not len(there):
            return self
        n, mean = len(there), float(there.mean())
        whole, apart = self.count + n, mean - self.mean
        self._squares += float(((there - mean) ** 2).sum()) + apart**2 * self.count * n / whole
        self.mean += apart * n / whole
        self.count = whole
        self.min, self.max = min(self.min, float(there.min())), max(self.max, float(there.max()))
        self._waiting.append(there)
        if sum(map(len, self._waiting)) > BUFFER:
            self._settle()
        return self

    @property
    def std(self) -> float:
        """Standard deviation of the numbers (of a sample: n - 1)."""
        return math.sqrt(self._squares / (self.count - 1)) if self.count > 1 else math.nan

    @property
    def half_width(self) -> float:
        """Of the 95 % interval of the mean."""
        return NORMAL * self.std / math.sqrt(self.count) if self.count > 1 else math.inf

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the mean."""
        return self.mean - self.half_width, self.mean + self.half_width

    def quantile(self, share: float) -> float:
        """The number below which this share of them lies (0 .. 1)."""
        share = require_finite("share", share, "")
        if not 0 <= share <= 1:
            raise InputError(f"share = {share:g} must lie in 0 .. 1")
        centres, weights = self._merged()
        if not len(centres):
            return math.nan
        # each centre stands in the middle of its weight; the ends are exact
        at = (np.cumsum(weights) - weights / 2 - 0.5) / max(self.count - 1, 1)
        at = np.concatenate([[0.0], at, [1.0]])
        return float(np.interp(share, at, np.concatenate([[self.min], centres, [self.max]])))

    def _merged(self) -> tuple[Array, Array]:
        waiting = np.concatenate([np.empty(0), *self._waiting])
        centres = np.concatenate([self._centres, waiting])
        weights = np.concatenate([self._weights, np.ones(len(waiting))])
        order = np.argsort(centres, kind="stable")
        return centres[order], weights[order]

    def _settle(self) -> None:
        """Neighbours are joined, fewer at the ends (T. Dunning, The t-digest, Software Impacts 7
        (2021) 100049, scale function k1).
        """
        centres, weights = self._merged()
        middle = (np.cumsum(weights) - weights / 2) / weights.sum()
        bins = np.floor(CENTROIDS * (np.arcsin(2 * middle - 1) / np.pi + 0.5)).astype(np.intp)
        starts = np.flatnonzero(np.diff(bins, prepend=-1))
        self._weights = np.add.reduceat(weights, starts)
        self._centres = np.add.reduceat(centres * weights, starts) / self._weights
        self._waiting = []

    def __str__(self) -> str:
        if not self.count:
            return f"no numbers, {self.missing} missing"
        low, middle, high = (self.quantile(q) for q in (0.05, 0.5, 0.95))
        missing = f", {self.missing} missing" if self.missing else ""
        return (
            f"mean {self.mean:.6g} ± {self.half_width:.2g}, std {self.std:.4g}, 5/50/95 % "
            f"{low:.5g} / {middle:.5g} / {high:.5g}, {self.min:.5g} .. {self.max:.5g}{missing}"
        )


# ---- Sobol indices -------------------------------------------------------------------------------
class SobolCases:
    """Cases for Sobol indices: Saltelli's scheme on scrambled Sobol points, drawn as they are read.

    ranges : {parameter: (low, high)}, each uniform. base : base samples, a power of two; there are
        base * (parameters + 2) cases. seed : of the scrambling.

    Raises InputError.

    Examples
    --------
    >>> cases = pam.simulation.SobolCases({"mass": (5.0, 20.0), "muscle.lag": (0.02, 0.1)}, 64)
    >>> len(cases), sorted(next(iter(cases))["parameters"])
    (256, ['mass', 'muscle.lag'])
    """

    def __init__(
        self, ranges: Mapping[str, tuple[float, float]], base: int, *, seed: int = 0
    ) -> None:
        require_count("base", base, 2)
        if base & (base - 1):
            raise InputError(
                f"base = {base} must be a power of two, such as {1 << base.bit_length()}"
            )
        if not isinstance(ranges, Mapping) or not ranges:
            raise InputError(f"ranges = {ranges!r}: give {{parameter: (low, high)}}")
        self.ranges: dict[str, tuple[float, float]] = {}
        for name, ends in ranges.items():
            if not isinstance(ends, Sequence) or isinstance(ends, str) or len(ends) != 2:
                raise InputError(f"ranges[{name!r}] = {ends!r}: give (low, high)")
            low, high = (require_finite(f"ranges[{name!r}]", end, "") for end in ends)
            if not low < high:
                raise InputError(f"ranges[{name!r}]: low = {low:g} must lie below high = {high:g}")
            self.ranges[name] = low, high
        self.base, self.seed = base, require_count("seed", seed, 0)

    def __len__(self) -> int:
        return self.base * (len(self.ranges) + 2)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        from scipy.stats import qmc

        names, d = list(self.ranges), len(self.ranges)
        low, high = np.array(list(self.ranges.values())).T
        engine = qmc.Sobol(2 * d, scramble=True, seed=np.random.default_rng(self.seed))
        for begin in range(0, self.base, BLOCK):
            points = engine.random(min(BLOCK, self.base - begin))
            a, b = low + points[:, :d] * (high - low), low + points[:, d:] * (high - low)
            mixed = np.repeat(a[:, None], d + 2, axis=1)  # A, A with one column of B each, B
            mixed[:, np.arange(1, d + 1), np.arange(d)] = b
            mixed[:, -1] = b
            for row in mixed.reshape(-1, d).tolist():
                yield {"parameters": dict(zip(names, row, strict=True))}

    def indices(self, values: Array) -> SobolIndices:
        """Indices from one number of each case, by SALib. Raises InputError."""
        try:
            from SALib.analyze import sobol
        except ImportError:
            raise InputError(
                "Sobol indices need SALib: pip install 'pam_ocp[sensitivity]'"
            ) from None
        values = np.asarray(values, float)
        if values.shape != (len(self),):
            raise InputError(f"{values.size} numbers for {len(self)} cases; run all of them")
        gone = int(np.sum(~np.isfinite(values)))
        if gone:
            raise InputError(
                f"{gone} of {len(self)} cases have no number (failed, or never there); Sobol "
                "indices need all: narrow the ranges, or keep a number that is always there"
            )
        if np.ptp(values) == 0:
            raise InputError("the number is the same in all cases: it has no variance to share out")
        names = list(self.ranges)
        problem = {
            "num_vars": len(names),
            "names": names,
            "bounds": [list(r) for r in self.ranges.values()],
        }
        found = sobol.analyze(
            problem, values, calc_second_order=False, conf_level=LEVEL, seed=self.seed
        )
        return SobolIndices(
            {
                n: (float(v), float(w))
                for n, v, w in zip(names, found["S1"], found["S1_conf"], strict=True)
            },
            {
                n: (float(v), float(w))
                for n, v, w in zip(names, found["ST"], found["ST_conf"], strict=True)
            },
        )


@shown
@dataclass(frozen=True)
class SobolIndices:
    """What part of a number's variance each parameter has, {parameter: (index, half width of its
    95 % interval)}.

    Examples
    --------
    >>> import numpy as np
    >>> cases = pam.simulation.SobolCases({"a": (0.0, 1.0), "b": (0.0, 1.0)}, 256)
    >>> a, b = np.array([list(c["parameters"].values()) for c in cases]).T
    >>> found = cases.indices(a + 2 * b)  # variances 1 : 4
    >>> [round(found.first[n][0], 1) for n in ("a", "b")]
    [0.2, 0.8]
    """

    first: Mapping[str, tuple[float, float]]
    """By the parameter alone."""
    total: Mapping[str, tuple[float, float]]
    """By it and all that it does together with others."""

    def __str__(self) -> str:
        width = max(map(len, self.first))
        lines = [f"{'':<{width}}  first order        total"]
        for name in sorted(self.total, key=lambda n: -self.total[n][0]):
            (s, ds), (t, dt) = self.first[name], self.total[name]
            lines.append(f"{name:<{width}}  {s:7.4f} ± {ds:<7.4f}  {t:7.4f} ± {dt:.4f}")
        return "\n".join(lines)

"""What a ladder of models tells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.errors import UnknownNameError
from ...plants.plant import Plant
from ..estimates import coefficient_line
from ..statistics import Array, Coefficient, student_t
from .adequacy import Adequacy
from .cross_validation import paired
from .run_statistics import BLOCKS

__all__ = ["Ladder", "Part", "RungFit", "compared"]

Part: TypeAlias = "tuple[int, int, int]"
"""(record, first sample, last sample + 1)."""
MARGIN = 0.01
"""Models whose errors differ by less than this part count as equally good, however sure it is."""


@dataclass(frozen=True, eq=False)
class RungFit:
    """One rung: fitted to all records, and what it predicts of parts that it was not fitted to.

    plant : with the fitted values. coefficients : the free parameters with standard errors.
    rmse : of each measured variable over all parts left out [its unit]. losses : mean squared error
    of each part, in parts of the variables' variances, averaged over the variables (n,).
    against : how the error (a root mean square) compares with the rung before, as (ratio - 1, half
    width of its interval). worse : whether it is significantly worse than the best rung.
    seconds : processor time of its fit to all records. failure : why there is none.
    """

    name: str
    plant: Plant
    coefficients: Mapping[str, Coefficient]
    rmse: Mapping[str, float]
    losses: Array = field(repr=False)
    states: int
    seconds: float
    against: tuple[float, float] = (np.nan, np.nan)
    worse: bool = False
    failure: str = ""

    @property
    def score(self) -> float:
        """Root of the mean loss: 1 is what a constant predicts."""
        return float(np.sqrt(np.mean(self.losses))) if self.losses.size else float("inf")


@dataclass(frozen=True, eq=False)
class Ladder:
    """What :func:`fit_ladder` found.

    rungs : from the simplest up. parts : what was left out, each once. best : the rung of the least
    error; chosen : the simplest that is not significantly worse. unclimbed : names of rungs for
    which there was no time.

    Examples
    --------
    >>> from functools import partial
    >>> rig = partial(pam.HangingLoad, muscle, 10.0, damping=100.0)
    >>> commanded = pam.Trajectory(
    ...     record.t,
    ...     {n: record[n] for n in ("muscle.command", "x")},
    ...     [plant.variable(n) for n in ("muscle.command", "x")],
    ...     "previous",
    ... )
    >>> ladder = pam.fitting.fit_ladder(rig, commanded, folds=3, rungs=["static", "lag"])
    >>> ladder.best.name
    '+ lag'
    """

    rungs: tuple[RungFit, ...]
    parts: tuple[Part, ...] = field(repr=False)
    fold: NDArray[np.intp] = field(repr=False)
    outputs: tuple[str, ...]
    records: int
    level: float
    seconds: float
    unclimbed: tuple[str, ...] = ()
    adequacy: Adequacy = field(default_factory=Adequacy)
    """What the residuals of the chosen rung tell; nothing is tested of a static one."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the chosen rung is used; empty when there is nothing."""
        return tuple(filter(None, (self.adequacy.sentence,)))

    def __getitem__(self, name: str) -> RungFit:
        return next(r for r in self.rungs if r.name.removeprefix("+ ") == name.removeprefix("+ "))

    @property
    def best(self) -> RungFit:
        return min(self.rungs, key=lambda r: r.score)

    @property
    def chosen(self) -> RungFit:
        return next(r for r in self.rungs if not r.worse and not r.failure)

    @property
    def plant(self) -> Plant:
        """The chosen one, fitted to all records."""
        return self.chosen.plant

    def intervals(
        self, rung: str | None = None, level: float | None = None
    ) -> dict[str, tuple[float, float]]:
        """Confidence intervals of a rung's values (by default the chosen one's, at the ladder's
        level); blocks of the records count as independent, not samples.
        """
        if rung is not None and rung.removeprefix("+ ") not in self._names:
            raise UnknownNameError("rung", rung, self._names)
        found = self.chosen if rung is None else self[rung]
        blocks = max(1, -(-BLOCKS // self.records)) * self.records
        t = student_t(self.level if level is None else level, blocks - 1)
        told = self.adequacy.stderr if found is self.chosen else {}
        halves = {n: t * told.get(n, c.stderr) for n, c in found.coefficients.items()}
        return {
            n: (c.value - halves[n], c.value + halves[n]) for n, c in found.coefficients.items()
        }

    @property
    def _names(self) -> list[str]:
        return [r.name.removeprefix("+ ") for r in self.rungs]

    def report(self) -> str:
        """The ladder as text: error of what was left out, gain, cost, and the chosen rung."""
        shown = [self.rungs[0].plant.variable(n) for n in self.outputs]
        heads = [f"{v.name} [{v.display_unit}]" for v in shown]
        wide = [max(len(h), 9) + 2 for h in heads]
        name = max(12, *(len(r.name) + 2 for r in self.rungs))
        lines = [
            f"[[Ladder]] {self.rungs[0].plant.name}",
            f"    {self.records} record{'s' * (self.records > 1)} of {', '.join(self.outputs)}; "
            f"{len(self.parts)} parts in {int(self.fold.max()) + 1} folds, each predicted by a fit "
            f"without it; {self.seconds:.1f} s",
            "[[Rungs]] error (RMS) of free runs in the parts left out",
            f"      {'model':<{name}}{'free':>5}{'states':>7}"
            + "".join(f"{h:>{w}}" for h, w in zip(heads, wide, strict=True))
            + f"{'error':>9}{'against the rung before':>26}{'fit [s]':>9}",
        ]
        for r in self.rungs:
            mark = "*" if r is self.chosen else " "
            row = f"    {mark} {r.name:<{name}}{len(r.coefficients):>5}{r.states:>7}"
            if r.failure:
                lines.append(f"{row}  failed: {r.failure}")
                continue
            row += "".join(
                f"{r.rmse[v.name] / v.display_factor:>{w}.4g}"
                for v, w in zip(shown, wide, strict=True)
            )
            gain, half = r.against
            said = "" if np.isnan(gain) else f"{100 * gain:+.1f} % ± {100 * half:.1f}"
            lines.append(f"{row}{r.score:>9.4f}{said:>26}{r.seconds:>9.2f}")
        lines += [f"      {n:<{name}} no time left" for n in self.unclimbed]
        lines += [
            f"    error: of all variables, in parts of their spread; ±: {100 * self.level:g} % of "
            "paired differences over the parts",
            f"    * the simplest that is not significantly (and by 1 %) worse than the best "
            f"({self.best.name.removeprefix('+ ')})",
            "    free: fitted parameters; fit: processor time of the fit to all records",
            f"[[Parameters]] of '{self.chosen.name}', ± standard error, {100 * self.level:g} % "
            "interval; SI",
        ]
        intervals = self.intervals()
        lines += [coefficient_line(c, intervals[n]) for n, c in self.chosen.coefficients.items()]
        lines += [f"    warning: {text}" for text in self.warnings]
        return "\n".join(lines)

    __str__ = report


# ---- comparison ---------------------------------------------------------------------------------
def compared(found: Sequence[RungFit], level: float) -> list[RungFit]:
    """Each rung against the one before, and against the best; paired over the parts."""
    best = min((r for r in found if not r.failure), key=lambda r: r.score)
    compared: list[RungFit] = []
    last: RungFit | None = None
    for rung in found:
        if rung.failure:
            compared.append(rung)
            continue
        against = (np.nan, np.nan)
        if last is not None:
            gain, half = _ratio(rung, last, level)
            against = (float(np.expm1(gain)), float(np.exp(gain) * np.sinh(min(half, 50.0))))
        behind, half = _ratio(rung, best, 2 * level - 1 if level > 0.5 else level)
        compared.append(replace(rung, against=against, worse=behind - half > np.log1p(MARGIN)))
        last = rung
    return compared


def _ratio(rung: RungFit, other: RungFit, level: float) -> tuple[float, float]:
    """Mean of ln(error/other's error) over the parts, and the half width of its interval."""
    tiny = 1e-30
    gaps = 0.5 * np.log((rung.losses + tiny) / (other.losses + tiny))
    mean, _, half = paired(gaps, level)
    return mean, half

"""What a fit of holds tells."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.files import write_json
from ...plants.plant import Plant
from ..estimates import Estimates, at_edge, correlation_lines
from ..statistics import Array, Linearisation

__all__ = ["HoldsFit"]


DECIDING = 0.45
"""Leverage from which a hold nearly decides alone; half of it where there are two alike."""
HANGING = 2.0
"""A standard error that grows by more than this without such holds hangs on them."""
LOST = 1e-8
"""Singular values below this part of the largest count as zero (columns of unit length)."""


@dataclass(frozen=True, eq=False)
class HoldsFit(Estimates):
    """Estimates from measured equilibria.

    plant : with the estimated parameters. measured, residuals : {variable: (n,)} [SI], the
    latter measured less predicted. given : what was put in, as measured. side : (n,), +1 where
    positions rose to the hold, -1 where they fell, 0 unknown. weights : (n, measured), below 1
    where a robust loss counts a hold less. unreached : holds at which the plant finds no rest.

    Examples
    --------
    >>> p = np.array([2e5, 3e5, 4e5, 5e5])
    >>> x = [plant.equilibrium({"muscle.pressure": v})["x"] for v in p]
    >>> found = pam.fitting.fit_holds(plant, {"muscle_pressure": p, "x": x}, "mass")
    >>> round(found.values["mass"], 3)
    10.0
    """

    plant: Plant
    linearisation: Linearisation = field(repr=False)
    measured: Mapping[str, Array] = field(repr=False)
    residuals: Mapping[str, Array] = field(repr=False)
    given: Mapping[str, Array] = field(repr=False)
    side: Array = field(repr=False)
    weights: Array = field(repr=False)
    loss: str
    at_bound: tuple[str, ...] = ()
    unreached: tuple[int, ...] = ()

    @property
    def n(self) -> int:
        """Number of holds."""
        return int(self.side.size)

    @cached_property
    def leverage(self) -> Array:
        """Part of each hold (n,), 0 to 1, in its own prediction: near 1, it decides alone."""
        linear = self.linearisation
        norms = np.linalg.norm(linear.jacobian, axis=0)
        basis = np.linalg.qr(linear.jacobian / np.where(norms > 0, norms, 1.0))[0]
        rows = np.sum(basis**2, axis=1).reshape(self.n, -1)
        return np.asarray(np.max(rows, axis=1))

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean square of the residuals of each measured variable [its unit]."""
        return {n: float(np.sqrt(np.mean(r**2))) for n, r in self.residuals.items()}

    @property
    def predicted(self) -> dict[str, Array]:
        """{variable: (n,)} as the fitted plant has it, zeros and bands included."""
        return {n: y - self.residuals[n] for n, y in self.measured.items()}

    @cached_property
    def _alone(self) -> NDArray[np.intp]:
        """Holds that nearly decide alone, where there are enough others."""
        enough = self.n > 5 * len(self.linearisation.names)
        return np.nonzero(enough & (self.leverage > DECIDING))[0]

    @cached_property
    def hanging(self) -> dict[str, float]:
        """{estimate: factor by which its interval is wider than ± t standard errors}, of those that
        hang on few holds.

        Beside a muscle that goes slack, or a rest that is about to vanish, a position moves far for
        little: the linear model that gives such a hold its weight holds nowhere else, so its
        information does not count for the interval. Infinite where the others tell nothing.
        """
        if not self._alone.size:
            return {}
        linear = self.linearisation
        kept = np.ones(self.n, dtype=bool)
        kept[self._alone] = False
        rows = linear.jacobian.reshape(self.n, -1, len(linear.names))
        size = np.linalg.norm(linear.jacobian, axis=0)
        size = np.where(size > 0, size, 1.0)
        wide = _variances(rows[kept].reshape(-1, len(linear.names)) / size)
        usual = _variances(linear.jacobian / size)
        factor = np.sqrt(wide / usual)
        return {n: float(f) for n, f in zip(linear.names, factor, strict=True) if not f <= HANGING}

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of an estimate [its unit], value ± t standard errors; wider where it
        hangs on few holds (see ``hanging``).
        """
        c = self._entry(name)
        half = self.linearisation.reach(level) * c.stderr * self.hanging.get(name, 1.0)
        return c.value - half, c.value + half

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the estimates are trusted."""
        found = [
            f"the holds hardly see this combination: changing {words} together moves no hold "
            "beyond its noise"
            for _, _, words in self.linearisation.hardly_seen()
        ]
        if self.unreached:
            shown = ", ".join(str(i + 1) for i in self.unreached[:5])
            found.append(
                f"the fitted plant finds no rest at {len(self.unreached)} of {self.n} holds (row "
                f"{shown}): the linear model stands in there"
            )
        if self._alone.size:
            shown = ", ".join(str(i + 1) for i in self._alone[:5])
            found.append(
                f"few holds nearly decide (row {shown}), as where a muscle goes slack or a rest is "
                "about to vanish"
                + (
                    f": {', '.join(self.hanging)} hang on them, and their intervals are those of "
                    "the other holds; leave these holds out, or measure more like them"
                    if self.hanging
                    else "; the others tell nearly as much"
                )
            )
        ignored = int(np.sum(self.weights.min(axis=1) < 0.1))
        if ignored:
            found.append(f"{ignored} of {self.n} holds lie so far off that they hardly count")
        return (*found, *super().warnings, *at_edge(self.at_bound, self.values))

    def report(self, level: float = 0.95) -> str:
        """The fit as text."""
        sides = {"from below": np.sum(self.side > 0), "from above": np.sum(self.side < 0)}
        ways = ", ".join(f"{int(n)} come to {words}" for words, n in sides.items() if n)
        linear = self.linearisation
        lines = [
            "[[Plant]]",
            f"    {self.plant.name}: {self.plant.description}",
            "[[Holds]]",
            f"    {self.n} equilibria, given {', '.join(self.given)}{'; ' + ways if ways else ''}",
            "[[Fit]]",
            *(
                f"    {n}: RMSE {r:.4g} {self.plant.variable(n).unit}, largest residual "
                f"{self.residuals[n][np.argmax(np.abs(self.residuals[n]))]:+.3g}"
                for n, r in self.rmse.items()
            ),
            f"    loss {self.loss}, {self.dof} degrees of freedom, condition "
            f"{linear.condition:.3g}",
            *self._coefficient_lines(
                f"[[Estimates]] ± standard error (relative), {100 * level:g} % interval",
                level,
                dict.fromkeys(self.hanging, "hangs on few holds"),
            ),
            *correlation_lines(linear),
            *self._warning_lines(),
        ]
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write estimates with intervals, holds and residuals as JSON."""
        intervals = self.intervals()
        content = {
            "format": "pam_ocp fit of holds",
            "version": 1,
            "units": "SI",
            "plant": self.plant.name,
            "estimates": {
                n: {"value": c.value, "stderr": c.stderr, "unit": c.unit, "interval": intervals[n]}
                for n, c in self.coefficients.items()
            },
            "rmse": self.rmse,
            "given": {n: a.tolist() for n, a in self.given.items()},
            "measured": {n: a.tolist() for n, a in self.measured.items()},
            "residuals": {n: a.tolist() for n, a in self.residuals.items()},
            "side": self.side.tolist(),
            "warnings": list(self.warnings),
        }
        return write_json(path, content)


def _variances(jacobian: Array) -> Array:
    """Diagonal of (J^T J)^-1; infinite where a direction has no information."""
    _, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    lost = s <= LOST * s[0]
    parts = (vt.T / np.where(lost, 1.0, s)) ** 2
    found = parts[:, ~lost].sum(axis=1)
    return np.asarray(np.where((parts[:, lost] > LOST).any(axis=1), np.inf, found))

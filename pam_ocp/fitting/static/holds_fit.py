"""What a fit of holds tells."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from ...core.errors import UnknownNameError
from ...core.files import write_json
from ...plants.plant import Plant
from ..statistics import Array, Coefficient, Linearisation
from .doubts import at_edge, following
from .report import coefficient_line, correlation_lines

__all__ = ["HoldsFit"]


DECIDING = 0.45
"""Leverage from which a hold nearly decides alone; half of it where there are two alike."""


@dataclass(frozen=True, eq=False)
class HoldsFit:
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

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """The estimates by name, zeros and bands included."""
        linear = self.linearisation
        rows = zip(linear.names, linear.values, linear.stderr(), linear.units, strict=True)
        return {n: Coefficient(n, float(v), float(e), u, False) for n, v, e, u in rows}

    @property
    def values(self) -> dict[str, float]:
        """{estimate: value} [SI]."""
        return {n: c.value for n, c in self.coefficients.items()}

    @property
    def n(self) -> int:
        """Number of holds."""
        return int(self.side.size)

    @property
    def dof(self) -> int:
        """Degrees of freedom: measured values less estimates."""
        return self.linearisation.dof

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

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Confidence interval of an estimate [its unit], value ± t standard errors."""
        if name not in self.coefficients:
            raise UnknownNameError("estimate", name, self.coefficients)
        c = self.coefficients[name]
        half = self.linearisation.reach(level) * c.stderr
        return c.value - half, c.value + half

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Confidence intervals of all estimates."""
        return {n: self.interval(n, level) for n in self.coefficients}

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
        alone = np.nonzero(self.leverage > DECIDING)[0]
        if alone.size and self.n > 5 * len(self.linearisation.names):
            shown = ", ".join(str(i + 1) for i in alone[:5])
            found.append(
                f"the estimates hang on few holds (row {shown}), as where a muscle goes slack or a "
                "rest is about to vanish: the intervals are too short; leave these holds out, or "
                "give bounds"
            )
        ignored = int(np.sum(self.weights.min(axis=1) < 0.1))
        if ignored:
            found.append(f"{ignored} of {self.n} holds lie so far off that they hardly count")
        return (*found, *following(self.linearisation), *at_edge(self.at_bound, self.values))

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
            f"[[Estimates]] ± standard error (relative), {100 * level:g} % interval; SI",
            *(coefficient_line(c, self.interval(n, level)) for n, c in self.coefficients.items()),
            *correlation_lines(linear),
        ]
        if self.warnings:
            lines += ["[[Warnings]]", *(f"    {text}" for text in self.warnings)]
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

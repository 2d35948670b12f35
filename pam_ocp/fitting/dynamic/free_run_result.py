"""What a fit of free runs tells: values with intervals, its runs, its doubts."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...core.plausible import outside
from ...core.shown import shown
from ...core.signals import Interpolation
from ...core.trajectory import Trajectory
from ...plants.plant import Plant
from ..estimates import coefficient_line
from ..statistics import Array, Coefficient
from .adequacy import Adequacy, adequacy_of, residual_adequacy
from .descent import descend
from .evidence import evidence_of
from .experiment import recorded, running
from .fit_result import FittedPlant
from .rig import Rig, RunUnknowns, unknowns_of
from .rollout import Rollout, spreads
from .run_statistics import Spread
from .runs import FreeRun, Runs, runs_of, settled_starts

__all__ = ["FreeRunFit", "ran"]


@shown
@dataclass(frozen=True, eq=False)
class FreeRunFit(FittedPlant):
    """A plant fitted to free runs.

    plant : with the fitted values. rig : dead times, sensors, starts and corrections, known and
    found. training : its runs along the records of the fit. integration_error : how much halving
    the step changes the runs (RMS, unit of each variable); moved : by how many standard errors it
    would move each value; fine : whether all of that is small. at_bound : unknowns that ended
    at the edge of their range. cost : mean squared error before and after, in parts of the measured
    variables' variance. converged : whether the search came to its end.

    Examples
    --------
    >>> found = pam.fit_free_run(plant, record, ["mass"], horizon=0.3, every=0.2, outputs=["x"])
    >>> abs(found.values["mass"] - 10.0) < 0.1
    True
    """

    plant: Plant
    training: FreeRun
    values: Mapping[str, float]
    at_bound: tuple[str, ...]
    integration_error: Mapping[str, float]
    cost: tuple[float, float]
    status: str
    evaluations: int
    seconds: float
    interpolation: Interpolation = "linear"
    """How inputs count as having run between the samples of records that do not say it."""
    inputs_ran: str = ""
    """How that was decided, in words; empty where the records say it."""
    options: Mapping[str, Any] = field(default_factory=dict, repr=False)
    """horizon, every, outputs, history, steps and warm_up of the runs."""
    rig: Rig = field(default_factory=Rig)
    own_starts: Mapping[str, Array] = field(default_factory=dict, repr=False)
    """{state: where it began in each record}, of states with starts of their own."""
    spread: Spread | None = field(default=None, repr=False)
    moved: Mapping[str, float] = field(default_factory=dict, repr=False)
    fine: bool = True
    converged: bool = True
    records: tuple[Trajectory, ...] = field(default=(), repr=False)
    unknowns: RunUnknowns = field(default_factory=RunUnknowns, repr=False)
    z: Array = field(default_factory=lambda: np.empty(0), repr=False)
    """Of the unknowns, scaled."""

    @cached_property
    def adequacy(self) -> Adequacy:
        """What the residuals of one motion through each record tell about the model; see
        :class:`Adequacy`.
        """
        pushed = any(n.endswith(".disturbance") for n, _ in self.rig.corrections)
        if self.spread is None or not self.records or pushed or np.any(self.training.diverged):
            return Adequacy()  # a model with a disturbance says itself that it lacks something
        u, names = self.unknowns, list(self.training.names)
        known = running(self.records, self.interpolation)
        evidence = evidence_of(self.plant, known, names, u, self.rig, self.z)
        if evidence is None and self.at_bound:  # a mass of nothing: no motion can be followed there
            edge = [n in self.at_bound for n in u.names]
            begin = np.where(edge, u.guess, self.z)
            evidence = evidence_of(self.plant, known, names, u, self.rig, begin)
        own = {n: c.stderr for n, c in self.spread.coefficients.items()}
        if evidence is None and self._whole:
            runs = self.training
            seen = [~np.isnan(m).any(axis=1) for m in runs.measured]
            errors, measured = (
                [a[s] for a, s in zip(part, seen, strict=True)]
                for part in (runs.measured - runs.predicted, runs.measured)
            )
            return residual_adequacy(names, errors, measured, len(self.z), own)
        given = None if self._whole else own
        return adequacy_of(evidence, 1 / spreads(self.plant, names, self.training.measured), given)

    @property
    def _whole(self) -> bool:
        """Whether the runs are one motion through each record, its start free."""
        whole = self.options.get("horizon") is None and not self.options.get("warm_up")
        return whole and len(self.unknowns.own_starts) == len(self.plant.states)

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """Every unknown but the starts of single records, with its standard error: that of
        autocorrelated residuals, and where the model is inadequate, of what that may shift.
        """
        if self.spread is None:
            return {}
        a = self.adequacy
        told = {} if self.at_bound and a.adequate else a.stderr
        return {
            n: c
            if n in self.at_bound or c.stderr == np.inf
            else replace(c, stderr=told.get(n, c.stderr))
            for n, c in self.spread.coefficients.items()
        }

    def _freedom(self, name: str) -> int:
        assert self.spread is not None
        a = self.adequacy
        own = self._whole and name in a.stderr and not self.at_bound
        return a.dof if own else self.spread.dof

    def _plain(self) -> Array:
        assert self.spread is not None
        k = len(self.coefficients)
        return self.spread.covariance[:k, :k]

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the fit is used; empty when there is nothing."""
        found = list(self.training.warnings)
        if not self.converged:
            found.append(f"the search did not come to its end: {self.status}")
        found += self.coarse
        found += [text for text in (self.adequacy.sentence,) if text]
        return tuple(found)

    @cached_property
    def coarse(self) -> tuple[str, ...]:
        """What the length of the steps costs, in words; empty where that does not count."""
        if self.fine:
            return ()
        steps, error = self.options["steps"], self.training.rmse
        name = max(self.integration_error, key=lambda n: self.integration_error[n] / error[n])
        said = (
            f"the integration is coarse for these records: with {2 * steps} steps to a sample "
            f"instead of {steps}, {name} changes by {self.integration_error[name]:.2g} where its "
            f"error is {error[name]:.2g}"
        )
        most = max(self.moved, key=lambda n: self.moved[n], default=None)
        if most is not None and self.moved[most] >= 0.05:
            said += f", and {most} by some {self.moved[most]:.1f} standard errors"
        return (said + f"; give steps={4 * steps}",)

    def validate(self, records: Trajectory | Sequence[Trajectory], **options: Any) -> FreeRun:
        """Runs of the same kind along other records; a warning says so where some diverge.

        Starts that each record has for itself are estimated from it; nothing else is. ``options``
        of the runs that differ, such as ``every``.
        """
        known = running(recorded(records), self.interpolation)
        options = {**self.options, "outputs": list(self.training.names), **options}
        if not self.own_starts:
            return ran(self.plant, runs_of(self.plant, known, **options), (), self.rig)
        runs = runs_of(self.plant, known, **options)
        along = list(self.unknowns.along)
        states = [v.name for v in self.plant.states]
        guesses = settled_starts(self.plant, runs, len(known), along).T
        unknowns, _ = unknowns_of(
            self.plant,
            (),
            runs.names,
            len(known),
            runs.t[0],
            starts={n: "record" for n in self.own_starts if states.index(n) not in along},
            hidden=dict(zip(along, guesses, strict=True)),
        )
        rollout = Rollout(self.plant, runs, unknowns, self.rig)
        found = descend(rollout, unknowns.guess, unknowns.low, unknowns.high, 30)
        return ran(self.plant, runs, unknowns, self.rig, found.z)

    def __str__(self) -> str:
        shown = self.plant.variable
        lines = [
            f"{self.plant.name}: {len(self.training.start)} free runs of {self.training.t[-1]:g} "
            f"s, {self.evaluations} evaluations, {self.seconds:.1f} s: {self.status}",
        ]
        for h in self.training.horizons or (self.training.t[-1],):
            over = f" over {h:g} s" if len(self.training.horizons) > 1 else ""
            lines += [
                f"    {n}: RMSE{over} {shown(n).shown(e)}"
                for n, e in self.training.rmse_over(h).items()
            ]
        if self.spread is None:
            lines += [f"    {n} = {shown(n).shown(v)}" for n, v in self.values.items()]
        lines += [coefficient_line(c, self.interval(n)) for n, c in self.coefficients.items()]
        if self.at_bound:
            lines.append(f"    at the edge of their range: {', '.join(self.at_bound)}")
        lines += [f"    {text}" for text in (self.inputs_ran,) if text]
        lines += [f"    warning: {text}" for text in self.warnings]
        return "\n".join(lines)


def ran(plant: Plant, runs: Runs, unknowns: Any, rig: Rig, z: Array | None = None) -> FreeRun:
    """The runs, with a warning where some diverge."""
    found = runs.result(
        Rollout(plant, runs, unknowns, rig).predicted(np.empty(0) if z is None else z)
    )
    for text in found.warnings:
        warnings.warn(text, RuntimeWarning, stacklevel=outside())
    return found

"""Which law? The same table fitted by many, judged where none of them was fitted.

With a few contraction levels a law of six coefficients is nearly saturated, so a small RMSE proves
little. Leaving one level out asks what a user asks: the force at a length that was not measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from ...core.cases import ending
from ...core.errors import FitError, InputError, UnknownNameError
from ...core.executors import Place
from ...core.shown import shown
from ...core.stop import TimeIsUp, deadline, verb
from ...muscles.law import LAWS, ForceLaw
from ...muscles.laws.user_defined import polynomial_law
from ..tables.force_table import ForceTable, require_table
from .correlation import sequences, surprise
from .force_fit import ForceFit
from .search import minimise_near
from .shared import JointForceFit
from .static import fit_force, independent, law_class

Fit = TypeVar("Fit", ForceFit, JointForceFit)


@dataclass(frozen=True, eq=False)
class Candidate(Generic[Fit]):
    """A law tried: its fit (None by a ``problem``), RMSE [N] by what was ``left_out`` of a fit."""

    name: str
    fit: Fit | None
    left_out: Mapping[Any, float]
    problem: str = ""

    @property
    def parameters(self) -> int:
        """Number of fitted coefficients."""
        return len(self.fit.linearisation.names) if self.fit else 0

    @property
    def rmse(self) -> float:
        """RMSE over the taut cells [N]."""
        return self.fit.rmse if self.fit else float("nan")

    @property
    def left_out_rmse(self) -> float:
        """Mean RMSE over what was left out, each of its fit [N]; NaN when there is nothing."""
        return float(np.mean([*self.left_out.values()])) if self.left_out else float("nan")

    @property
    def rank(self) -> tuple[bool, float, float]:
        """By which candidates are sorted: the best where it was not fitted first."""
        doubt = np.inf if np.isnan(self.left_out_rmse) else self.left_out_rmse
        return self.fit is None, doubt, self.rmse


@dataclass(frozen=True, eq=False)
class ComparedLaw(Candidate[ForceFit]):
    """One law on the table.

    fit : None, with the reason in ``problem``, where there is none.
    left_out : contraction of each interior level -> RMSE [N] there of a fit without it.

    Examples
    --------
    >>> comparison.best.name, round(comparison.best.left_out_rmse, 1)
    ('five-parameter', 16.4)
    """

    @property
    def aic(self) -> float:
        """Akaike's criterion, -2 ln L + 2 (k + 1), for normal errors of unknown variance.

        -2 ln L is n ln(SS/n) for independent errors. Where residuals say that errors follow each
        other, their likelihood is that of such errors, and the correlation one unknown more; else a
        few hundred cells of a ramp would pass for as many pieces of evidence.
        """
        return self._criterion(2.0)

    @property
    def bic(self) -> float:
        """Schwarz's criterion, -2 ln L + ln(n) (k + 1); see :attr:`aic`."""
        return self._criterion(float(np.log(self.fit.n))) if self.fit else float("nan")

    def _criterion(self, price: float) -> float:
        if self.fit is None:
            return float("nan")
        fit = self.fit
        orders = [] if fit.terms.independent else sequences(fit.cells)
        wrong = surprise(fit.root_weights * fit.residuals, orders, price)
        return wrong + price * (self.parameters + 1)


@shown
@dataclass(frozen=True, eq=False)
class LawComparison:
    """Laws on one table, the best at a level left out first; those without a fit last.

    Examples
    --------
    >>> [law.name for law in comparison.laws]
    ['five-parameter', 'six-parameter']
    """

    laws: tuple[ComparedLaw, ...]
    source: str = ""

    def __getitem__(self, name: str) -> ComparedLaw:
        for law in self.laws:
            if law.name == name:
                return law
        raise UnknownNameError("compared law", name, [law.name for law in self.laws])

    @property
    def best(self) -> ComparedLaw:
        """The law that predicts levels left out best."""
        return self.laws[0]

    def __str__(self) -> str:
        wide = 2 + max(len(law.name) for law in self.laws)
        lines = [
            f"{self.source or 'table'}; left out: mean RMSE at the interior contraction levels, "
            "each left out of the fit",
            f"{'law':<{wide}}{'k':>3}{'RMSE [N]':>10}{'AIC':>9}{'BIC':>9}{'left out [N]':>14}",
        ]
        for law in self.laws:
            if law.fit is None:
                lines.append(f"{law.name:<{wide}}  - {law.problem}")
                continue
            lines.append(
                f"{law.name:<{wide}}{law.parameters:>3}{law.rmse:>10.2f}{law.aic:>9.1f}{law.bic:>9.1f}"
                f"{law.left_out_rmse:>14.2f}" + (f"  {law.problem}" if law.problem else "")
            )
        return "\n".join(lines)


@verb
def compare_laws(
    table: ForceTable,
    laws: Iterable[str | type[ForceLaw]] | None = None,
    *,
    fixed: Mapping[str, float] | None = None,
    errors: Literal["as found", "independent"] = "as found",
    executor: Place = None,
    time_limit: float | None = None,
) -> LawComparison:
    """Fit several laws to one table and leave each interior contraction level out in turn.

    Parameters
    ----------
    table : from :func:`read_table`.
    laws : names or classes; by default all of ``LAWS`` and the polynomials of degree 1 and 3.
    fixed : known constants [SI] for the laws that have them, as ``{"radius": 0.010,
        "rest_diameter": 0.020, "max_contraction_ratio": 0.25}``.
    errors : as for :func:`fit_force`; of the fits, and of AIC and BIC.
    executor : where the laws are fitted, as for :func:`pam_ocp.each`.
    time_limit : [s]; laws that are not reached are listed with it as the reason.

    ``print`` the result for a table. Laws whose constants are not given, or whose fit is not found,
    are listed with the reason. Raises InputError, UnknownNameError (no law, or a name in ``fixed``
    that no law knows).

    Examples
    --------
    >>> pam.compare_laws(table, ["six-parameter", "five-parameter"]).best.name
    'five-parameter'
    """
    require_table(table)
    given: Iterable[str | type[ForceLaw]] = [*LAWS, polynomial_law(1, 3)] if laws is None else laws
    chosen = [given] if isinstance(given, str) else list(given)
    if not chosen:
        raise InputError("laws is empty: give names or classes of force laws")
    kinds = [law_class(law) for law in chosen]
    constants = {v.name for kind in kinds for v in kind.coefficient_variables()}
    for name in fixed or {}:
        if name not in constants:
            raise UnknownNameError("constant in fixed of any of these laws", name, constants)
    independent(errors)
    work = partial(_compared, table, fixed or {}, errors)
    ended: dict[int, ComparedLaw] = {}
    with suppress(TimeIsUp):
        for i, law in ending(work, kinds, executor=executor, chunk=1, what="laws"):
            if isinstance(law, Exception):
                raise law
            ended[i] = law
    late = f"{deadline()} was over"
    found = [ended.get(i, ComparedLaw(k.name, None, {}, late)) for i, k in enumerate(kinds)]
    return LawComparison(tuple(sorted(found, key=lambda law: law.rank)), table.source)


def _compared(
    table: ForceTable,
    fixed: Mapping[str, float],
    errors: Literal["as found", "independent"],
    kind: type[ForceLaw],
) -> ComparedLaw:
    own = {n: v for n, v in fixed.items() if n in kind.fixed_coefficients()}
    missing = [
        n
        for n, v in kind.fixed_coefficients().items()
        if v is None and n not in own and n != "rest_length"
    ]
    if missing:
        return ComparedLaw(kind.name, None, {}, f"needs fixed={{{missing[0]!r}: ...}}")
    fit: ForceFit | None = None
    where = ""
    try:
        fit = fit_force(table, kind, fixed=own, errors=errors)
        where = "with a level left out"
        return ComparedLaw(kind.name, fit, _left_out(fit))
    except TimeIsUp:
        return ComparedLaw(kind.name, fit, {}, f"{deadline()} was over {where}".rstrip())
    except (FitError, InputError) as error:
        return ComparedLaw(kind.name, fit, {}, f"{where}: {error}" if where else str(error))


def _left_out(fit: ForceFit) -> dict[float, float]:
    whole, level = fit.problem, fit.cells.levels()
    start = fit.vector[None, list(whole.nonlinear)] if whole.nonlinear else None
    left = [level == i for i in range(1, level.max())]
    parts = [replace(whole, cells=fit.cells.subset(~o), weights=whole.weights[~o]) for o in left]
    few = min((len(p.cells) for p in parts), default=len(whole.free))
    if few < len(whole.free):
        raise InputError(f"{few} taut cells remain, fewer than the {len(whole.free)} coefficients")
    errors = {}
    for out, found in zip(left, minimise_near(parts, start), strict=True):
        if isinstance(found, FitError):
            raise found
        there = replace(whole, cells=fit.cells.subset(out), weights=np.ones(int(np.sum(out))))
        residuals = there.residuals(found.coefficients[None])[0]
        errors[float(there.cells.contraction.mean())] = float(np.sqrt(np.mean(residuals**2)))
    return errors

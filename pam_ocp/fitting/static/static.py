"""Static fit: the coefficients of a force law from a measured table, at the global optimum.

Which law? The same table is fitted by many, judged where none of them was fitted. With a few
contraction levels a law of six coefficients is nearly saturated, so a small RMSE proves little.
Leaving one level out asks what a user asks: the force at a length that was not measured.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar, get_args

import numpy as np
from numpy.typing import ArrayLike

from ...core.cases import ending
from ...core.errors import FitError, InputError, UnknownNameError, require_ends, require_positive
from ...core.executors import Place
from ...core.shown import shown
from ...core.stop import TimeIsUp, deadline, verb
from ...core.variables import Variable
from ...muscles.law import LAWS, ForceLaw
from ...muscles.laws.user_defined import law_named, polynomial_law
from ..statistics import Array, Linearisation, require_choice
from ..tables.force_table import ForceTable, require_table
from .correlation import sequences, surprise
from .force_fit import ForceFit
from .least_squares import HUBER, LeastSquares, Loss, Terms, sizes, spread
from .search import minimise, minimise_near, robust_start

LOG = logging.getLogger(__name__)
SMALLEST_ERROR = 0.3
"""Of a cell, in parts of the usual one: below that it is luck of few rows, and counts as this."""


@verb
def fit_force(
    table: ForceTable,
    law: str | type[ForceLaw] = "six-parameter",
    *,
    start: Mapping[str, float] | None = None,
    fixed: Mapping[str, float] | None = None,
    weights: ArrayLike | Literal["equal"] | None = None,
    loss: Loss = "squares",
    censored: bool = False,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    noise: float | None = None,
    errors: Literal["as found", "independent"] = "as found",
    time_limit: float | None = None,
) -> ForceFit:
    """Fit a force law to a measured table: the global optimum, with intervals.

    Parameters
    ----------
    table : from :func:`read_table`; the taut cells are fitted.
    law : name in ``LAWS``, "polynomial-3-4", "spline-3:0,0.1,0.25", or a class of force laws.
    start : coefficients to try in addition to the scan [SI]. The optimum does not depend on it.
    fixed : coefficients to hold [SI], ``{"a3": -40.0}``. Known constants of a law (a radius, say)
        belong here too; its ``rest_length`` is taken from the table.
    weights : per cell, 1/(standard deviation) up to a common factor; multiplies the residual.
        As long as the table (values at slack cells are ignored). None: from ``table.error`` where
        the table carries it (a ramp binned to cells), else "equal".
    loss : "squares"; another where some cells are far off (a slipped clamp, a wrong digit).
        "bisquare" is the one to take: an MM-estimate, which cells beyond 4.685 standard deviations
        do not move at all, wherever they lie (V. Yohai, Ann. Stat. 15 (1987) 642-656). "huber" goes
        over from squares to absolute values at 1.345 standard deviations, "l1" counts absolute
        values: both have one optimum, but a wrong cell at the edge of the table pulls them.
    censored : slack cells count too: there the law must be below 1 N (the width of the clamp).
    bounds : {coefficient: (low, high)} [SI].
    priors : {coefficient: (mean, standard deviation)} [SI], known from elsewhere: normal.
    noise : standard deviation of a measurement of weight 1 [N], against which priors weigh; by
        default estimated from a fit without them.
    errors : "as found": where residuals say that errors are serially correlated (from row to row,
        along a ramp, along pressure), intervals and bands are widened for it (see
        :mod:`pam_ocp.fitting.static.correlation`). "independent": they are known not to be, as
        after measuring in random order.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises InputError, UnknownNameError (arguments that cannot be, fewer taut cells than
    coefficients), FitError (no stationary point was found).

    Examples
    --------
    >>> fit = pam.fit_force(table)
    >>> fit
    ForceFit(six-parameter: RMSE 6.196 N over 60 taut cells)
    >>> print(f"{100 * fit.rmse / table.force.max():.1f} % of the largest force")
    0.4 % of the largest force
    """
    began = time.perf_counter()
    require_table(table)
    kind = law_class(law)
    held = held_coefficients(kind, dict(fixed or {}), table)
    terms = Terms(
        require_choice("loss", loss, get_args(Loss)),
        censored=bool(censored),
        bounds=checked_pairs(kind, "bounds", bounds, held),
        priors=checked_pairs(kind, "priors", priors, held),
        independent=independent(errors),
    )
    whole = LeastSquares.of(kind, table, held, cell_weights(weights, table), terms)
    problem, begin = _settled(whole, noise)
    optimum = minimise(problem, _start(problem, dict(start or {})), begin)
    LOG.info("%s fitted to %d cells: %s", kind.name, len(table), optimum.solver.status)
    return ForceFit(
        law=kind(**dict(zip(problem.names, optimum.coefficients.tolist(), strict=True))),
        table=table,
        held=tuple(n for n in problem.names if n in held),
        weights=None if _are_equal(weights, table) else problem.weights,
        solver=replace(optimum.solver, seconds=time.perf_counter() - began),
        terms=problem.terms,
    )


# ---- arguments -----------------------------------------------------------------------------------
def law_class(law: Any) -> type[ForceLaw]:
    if isinstance(law, str):
        return law_named(law)
    if isinstance(law, type) and issubclass(law, ForceLaw):
        return law
    raise InputError(f"law = {law!r} must be a name ({', '.join(LAWS)}) or a class of force laws")


def _known(kind: type[ForceLaw], argument: str, names: Iterable[str]) -> dict[str, Variable]:
    """The coefficients of a law; an UnknownNameError where ``names`` holds another."""
    known = {v.name: v for v in kind.coefficient_variables()}
    for name in names:
        if name not in known:
            raise UnknownNameError(f"coefficient of the {kind.name} law in {argument}", name, known)
    return known


def _checked(kind: type[ForceLaw], argument: str, values: Mapping[str, Any]) -> dict[str, float]:
    known = _known(kind, argument, values)
    return {n: known[n].check(v, argument) for n, v in values.items()}


def held_coefficients(
    kind: type[ForceLaw], fixed: dict[str, Any], table: ForceTable
) -> dict[str, float]:
    """The coefficients that no fit may move: the user's, and the law's known constants."""
    constants = {**kind.fixed_coefficients()}
    if constants.get("rest_length", 0.0) is None:
        constants["rest_length"] = table.rest_length
    constants.update(_checked(kind, "fixed", fixed))
    missing = [n for n, v in constants.items() if v is None]
    if missing:
        words = {v.name: v.description for v in kind.coefficient_variables()}
        raise InputError(
            f"the {kind.name} law needs fixed={{{missing[0]!r}: ...}} ({words[missing[0]]}), "
            "which no fit of the force can tell"
        )
    return {n: float(v) for n, v in constants.items() if v is not None}


def cell_weights(weights: ArrayLike | Literal["equal"] | None, table: ForceTable) -> Array:
    """Of the taut cells."""
    if _are_equal(weights, table):
        return np.ones(len(table.taut))
    if weights is None:
        error = table.taut.error
        assert error is not None
        usual = float(np.median(error))
        return np.asarray(usual / np.maximum(error, SMALLEST_ERROR * usual))
    try:
        array = np.asarray(weights, dtype=float)
    except (OverflowError, TypeError, ValueError) as error:
        raise InputError(f"weights does not hold numbers only: {error}") from None
    if array.shape != (len(table),):
        raise InputError(
            f"weights has shape {array.shape}; give one weight per cell of the table, "
            f"({len(table)},)"
        )
    chosen: Array = array[~table.slack]
    bad = np.nonzero(~(np.isfinite(chosen) & (chosen > 0)))[0]
    if bad.size:
        raise InputError(
            f"weights: taut cell {bad[0] + 1} has {chosen[bad[0]]}; weights must be finite and > 0 "
            "(take a cell out with table.subset(...))"
        )
    return chosen


def _are_equal(weights: Any, table: ForceTable) -> bool:
    """Whether all cells count alike: as wished, or for want of known errors."""
    if isinstance(weights, str):
        if weights != "equal":
            raise InputError(f"weights = {weights!r}: give one for each cell, or 'equal'")
        return True
    error = table.taut.error
    known = error is not None and error.size and np.all(np.isfinite(error) & (error > 0))
    return weights is None and not known


def independent(errors: Any) -> bool:
    return bool(require_choice("errors", errors, ("as found", "independent")) == "independent")


def checked_pairs(
    kind: type[ForceLaw], argument: str, given: Mapping[str, Any] | None, held: Mapping[str, float]
) -> tuple[tuple[str, float, float], ...]:
    """(name, first, second) of bounds or priors, checked."""
    known, pairs = _known(kind, argument, given or {}), []
    for name, value in (given or {}).items():
        if name in held:
            raise InputError(f"{argument}: {name} is held; take it out of {argument} or of fixed")
        where, unit = f"{argument}[{name!r}]", known[name].unit
        two = require_ends(where, value, unit) if argument == "bounds" else _prior(where, value)
        pairs.append((name, *two))
    return tuple(pairs)


def _prior(where: str, value: Any) -> tuple[float, float]:
    try:
        mean, deviation = (float(v) for v in value)
    except (TypeError, ValueError):
        raise InputError(f"{where} = {value!r}: give (mean, standard deviation)") from None
    if not (np.isfinite(mean) and 0 < deviation < np.inf):
        raise InputError(
            f"{where} = {value!r} must be (mean, standard deviation), the second positive"
        )
    return mean, deviation


def _settled(problem: LeastSquares, noise: float | None) -> tuple[LeastSquares, Array | None]:
    """The problem with the scales that its loss and priors need from the data; where to begin."""
    terms = problem.terms
    if terms.priors and noise is None:
        bare = replace(problem, terms=replace(terms, priors=(), loss="squares"))
        noise = float(np.sqrt(minimise(bare).cost / max(len(problem.cells) - len(problem.free), 1)))
    if noise is not None:
        terms = replace(terms, noise=require_positive("noise", noise, "N"))
    if terms.loss == "bisquare":
        begin, edge = robust_start(replace(problem, terms=terms))
        return replace(problem, terms=replace(terms, threshold=edge)), begin
    if terms.loss != "squares":
        straight = replace(terms, loss="l1", threshold=np.sqrt(2) * terms.noise)
        terms = straight
    if problem.terms.loss == "huber":
        found = minimise(replace(problem, terms=straight)).coefficients
        residuals = problem.evaluate(found[None])[0][0]
        edge = HUBER * max(spread(residuals, len(problem.free)), 1e-9 * problem.size)
        terms = replace(terms, loss="huber", threshold=edge)
    return replace(problem, terms=terms), None


def _start(problem: LeastSquares, start: Mapping[str, Any]) -> Array | None:
    """The user's values of the nonlinear coefficients; nominal sizes where none is given."""
    given = _checked(problem.law, "start", start)
    wanted = [problem.names[i] for i in problem.nonlinear]
    if not any(n in given for n in wanted):
        return None
    nominal = {v.name: sizes(v) for v in problem.variables}
    values = np.array([[given.get(n, nominal[n][0]) for n in wanted]])
    # beyond the edges of the scan a law has degenerated; a start there counts as the edge
    reach = [np.abs(nominal[n]) for n in wanted]
    sizes_ = np.clip(np.abs(values), [s.min() for s in reach], [s.max() for s in reach])
    return np.asarray(np.where(values < 0, -sizes_, sizes_))


@verb
def fit_branches(
    table: ForceTable, law: Any = "six-parameter", **options: Any
) -> Mapping[str, ForceFit]:
    """A fit for each branch of a table; options as for :func:`fit_force`, without weights.

    Raises InputError for a table without branches.

    Examples
    --------
    >>> sorted(pam.fitting.fit_branches(both))
    ['deflation', 'inflation']
    """
    if not require_table(table).branches:
        raise InputError(
            "the table has no branches; label cells in a column 'branch' (inflation, deflation)"
        )
    if options.get("weights") is not None:
        raise InputError("weights belong to a whole table; fit branch by branch with fit_force")
    return {b: fit_force(table.of_branch(b), law, **options) for b in table.branches}


# ---- which law? ----------------------------------------------------------------------------------
class Judged(Protocol):
    """A fit that candidates are compared by."""

    @property
    def linearisation(self) -> Linearisation: ...
    @property
    def rmse(self) -> float: ...


Fit = TypeVar("Fit", bound=Judged)


@dataclass(frozen=True, eq=False)
class Candidate(Generic[Fit]):
    """A law tried: its fit (None by a ``problem``), RMSE [N] by what was ``left_out`` of a fit."""

    name: str
    fit: Fit | None
    left_out: Mapping[Any, float]
    problem: str = ""

    _figures: ClassVar[tuple[str, ...]] = ("parameters", "rmse", "left_out_rmse")
    """Of a table of candidates (figures/tables.py)."""

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

    _figures = ("parameters", "rmse", "aic", "bic", "left_out_rmse")

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

"""Static fit: the coefficients of a force law from a measured table, at the global optimum."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from ...core.errors import InputError, UnknownNameError, require_ends, require_positive
from ...core.stop import verb
from ...core.variables import Variable
from ...muscles.law import LAWS, ForceLaw
from ...muscles.laws.user_defined import law_named
from ..statistics import Array, require_choice
from ..tables.force_table import ForceTable, require_table
from .force_fit import ForceFit
from .least_squares import HUBER, LeastSquares, Loss, Terms, sizes, spread
from .search import minimise, robust_start

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

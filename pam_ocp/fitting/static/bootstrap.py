"""Bootstrap of a static fit (B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, TypeAlias

import numpy as np

from ...core.cases import Place, ending
from ...core.errors import FitError, InputError, UnknownNameError, require_count
from ...core.stop import TimeIsUp, deadline, verb
from ..statistics import Array
from .correlation import drawn_errors, scaled_errors, sequences
from .least_squares import LeastSquares
from .optimum import Optimum
from .search import NEAR, minimise

__all__ = ["Bootstrap", "Resampling", "bootstrap"]

Resampling: TypeAlias = Literal["residuals", "cases"]


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Refitted coefficients: ``samples`` (n, k) of the free ones, in the order of ``names``.

    failed : resampled tables of which no fit was found; they are left out.

    Examples
    --------
    >>> found = fit.bootstrap(20)
    >>> found.samples.shape, found.failed
    ((20, 6), 0)
    """

    names: tuple[str, ...]
    samples: Array
    failed: int = 0
    ended: str = ""
    """Why there are fewer samples than were asked for ("" when there are not)."""

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Percentile interval of one coefficient."""
        if name not in self.names:
            raise UnknownNameError("fitted coefficient", name, self.names)
        if not 0 < level < 1:
            raise InputError(f"level = {level:g} must lie between 0 and 1, as in 0.95")
        column = self.samples[:, self.names.index(name)]
        low, high = np.quantile(column, [(1 - level) / 2, (1 + level) / 2])
        return float(low), float(high)

    @property
    def stderr(self) -> dict[str, float]:
        """Standard deviation of each coefficient over the samples."""
        return dict(zip(self.names, self.samples.std(axis=0, ddof=1).tolist(), strict=True))

    @property
    def covariance(self) -> Array:
        """Covariance over the samples (k, k)."""
        return np.atleast_2d(np.cov(self.samples.T))


@verb
def bootstrap(
    fit: Optimum,
    n: int,
    seed: int,
    method: Resampling,
    *,
    executor: Place = None,
    time_limit: float | None = None,
) -> Bootstrap:
    """See :meth:`ForceFit.bootstrap`."""
    require_count("n", n, 2)
    if method not in ("residuals", "cases"):
        raise InputError(f"method = {method!r}: choose 'residuals' or 'cases'")
    if method == "residuals" and fit.dof < 1:
        raise InputError("bootstrap needs more cells than coefficients; there are no residuals")
    random = np.random.default_rng(require_count("seed", seed, 0))
    problem, failed, ended = fit.problem, 0, ""
    start = fit.vector[None, list(problem.nonlinear)] if problem.nonlinear else None
    found: dict[int, Array] = {}
    tables = (_resampled(fit, problem, random, method) for _ in range(n))
    try:
        for i, result in ending(
            partial(_refitted, start), tables, executor=executor, what="bootstrap", count=n
        ):
            if isinstance(result, FitError):
                failed += 1
            elif isinstance(result, Exception):
                raise result
            else:
                found[i] = result
    except TimeIsUp:
        if len(found) < 2:
            raise
        ended = f"{deadline()} was over behind {len(found)} of {n} tables"
    samples = [found[i] for i in sorted(found)]
    if len(samples) < 2:
        raise FitError(f"{failed} of {n} resampled tables gave no fit; the data are too few")
    return Bootstrap(fit.free, np.array(samples), failed, ended)


def _refitted(start: Array | None, problem: LeastSquares) -> Array:
    """The fit of a resampled table, from that to the measured one."""
    coefficients = minimise(problem, start, effort=NEAR).coefficients
    return np.asarray(coefficients[list(problem.free)])


def _resampled(
    fit: Optimum, problem: LeastSquares, random: np.random.Generator, method: Resampling
) -> LeastSquares:
    """Serially correlated errors, as the fit found, do so in what is drawn."""
    cells, serial = problem.cells, fit.serial
    order = next((o for o in sequences(cells) if serial and o.words == serial.order), None)
    if serial is not None and order is not None:
        draw = drawn_errors if method == "residuals" else scaled_errors
        errors = draw(serial, order, problem.weights * fit.residuals, fit.sigma, random)
    elif method == "cases":
        drawn = random.integers(0, len(cells), len(cells))
        return replace(problem, cells=cells.subset(drawn), weights=problem.weights[drawn])
    else:
        # residuals are smaller than errors: the fit has taken up its coefficients' share
        weighted = problem.weights * fit.residuals * np.sqrt(len(cells) / max(fit.dof, 1))
        errors = random.choice(weighted - weighted.mean(), len(cells))
    force = cells.force - fit.residuals + errors / problem.weights
    return replace(problem, cells=replace(cells, force=force))

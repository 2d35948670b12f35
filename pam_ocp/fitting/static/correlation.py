"""Serially correlated errors: found in residuals, and counted in a covariance.

A regulator that settles, friction and creep make neighbouring measurements err alike, so n of them
tell less than n. The errors along a sequence are taken as e_i = rho e_(i-1) + new (an AR(1)
process, stationary). rho has a restricted likelihood, that of the part of the data which no
coefficient can take up (H. Patterson, R. Thompson, Biometrika 58 (1971) 545-554): residuals
themselves are less correlated than errors do, for the fit has taken up what lasts long.
Coefficients stay those of least squares; their covariance is (J^T J)^-1 J^T R J (J^T J)^-1,
averaged over rho with that likelihood (all values from 0 to 1 equally likely before), so that not
knowing rho counts, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..statistics import Array, SerialErrors, inverse, spanned
from ..tables.force_table import ForceTable

NEGLECTED = 0.15
"""Probability of a correlation below which errors count as independent.

Of independent errors, a few dozen of them, that is what the data usually leave.
"""
RHO = np.linspace(0.0, 0.98, 50)
UNLIKELY = 1e-10
"""Weight below which a correlation is not looked at."""
AT_ONCE = 1_000_000
"""Numbers that are held at once."""
FEWEST = 6
"""Degrees of freedom below which nothing is said about a correlation."""


def neighbours(series: Sequence[Array]) -> float:
    """Correlation of neighbouring values over all series, each about zero."""
    products = sum(float(r[1:] @ r[:-1]) for r in series)
    squares = sum(float(r @ r) for r in series)
    return products / squares if squares else 0.0


def widening(rho: float) -> float:
    """Factor by which such a correlation of neighbours widens the error of a long series' mean."""
    return float(np.sqrt((1 + rho) / (1 - min(rho, 0.999))))


@dataclass(frozen=True)
class Order:
    """An order of the measurements, and whether each follows the one before."""

    words: str
    order: NDArray[np.intp]
    follows: NDArray[np.bool_]


def sequences(*tables: ForceTable) -> list[Order]:
    """Orders in which errors of cells may be correlated: row after row; the same within a ramp
    (contraction level, branch and run); along pressure in each of these. Nothing follows from table
    to table.
    """
    table = np.repeat(np.arange(len(tables)), [len(t) for t in tables])
    labels = (
        [x for t in tables for x in getattr(t, n) or ("",) * len(t)] for n in ("branch", "run")
    )
    coded = (np.unique(own, return_inverse=True)[1] for own in labels)
    keys = (table, np.concatenate([t.levels() for t in tables]), *coded)
    ramp = np.ravel_multi_index(keys, [int(k.max(initial=0)) + 1 for k in keys])
    rows, pressure = np.arange(len(table)), np.concatenate([t.pressure for t in tables])
    found: list[Order] = []
    for words, part, key in (
        ("from row to row", table, rows),
        ("along each ramp", ramp, rows),
        ("along pressure at each level", ramp, pressure),
    ):
        order = np.lexsort((key, part))
        follows = np.concatenate([[False], np.diff(part[order]) == 0])[: len(rows)]
        if not any(
            np.array_equal(order, d.order) and np.array_equal(follows, d.follows) for d in found
        ):
            found.append(Order(words, order, follows))
    return found


def serial_errors(
    jacobian: Array, residuals: Array, orders: Sequence[Order]
) -> SerialErrors | None:
    """Whether residuals are serially correlated in one of ``orders``; None when not. jacobian,
    residuals : weighted, of the measurements; rows of priors may follow in the Jacobian.
    """
    n = len(residuals)
    basis = spanned(jacobian[:n])
    freedom = n - basis.shape[1]
    size = float(residuals @ residuals)
    if freedom < FEWEST or not np.isfinite(size) or size <= 0:
        return None
    found = [(_likelihood(basis, residuals, o), o) for o in orders if o.follows.any()]
    if not found:
        return None
    top = max(float(v.max()) for (v, _), _ in found)
    follow = [float(np.mean(np.exp(v - top))) for (v, _), _ in found]
    (values, squares), order = found[int(np.argmax(follow))]  # the largest of all is often rho = 0
    alone = np.exp(values[0] - top)
    probability = float(np.mean(follow) / (alone + np.mean(follow)))
    if probability < NEGLECTED:
        return None
    weights = np.exp(values - values.max())
    weights *= probability / weights.sum()
    weights[0] += 1 - probability  # rho = 0
    mean = int(np.argmin(np.abs(RHO - weights @ RHO)))
    counted = np.nonzero((weights > UNLIKELY) | (np.arange(RHO.size) == mean))[0]
    scale = (squares / squares[0])[counted]
    parts = scale[:, None, None] * _meats(jacobian, order, RHO[counted])
    middle = int(np.nonzero(counted == mean)[0][0])
    usual = inverse(parts[middle], 1e-10) / max(len(parts[middle]), 1)
    return SerialErrors(
        order.words,
        float(RHO[mean]),
        probability,
        parts[middle],
        float(np.sqrt(scale[middle])),
        weights[counted] / weights[counted].sum(),
        np.einsum("ij,gji->g", usual, parts),
        freedom,
        RHO[counted],
        np.sqrt(scale),
    )


def surprise(residuals: Array, orders: Sequence[Order], price: float) -> float:
    """-2 ln L of normal residuals, independent or AR(1) in one of ``orders``, with a ``price`` for
    that.
    """
    n, size = len(residuals), max(float(residuals @ residuals), 1e-300)
    found = [n * np.log(size / n)]
    for one in orders:
        squares = np.maximum(_products(residuals[:, None], one)[:, 0, 0], 1e-300)
        spread = one.follows.sum() * np.log(1 - RHO**2)
        found.append(float(np.min(n * np.log(squares / n) + spread)) + price)
    return float(min(found))


def drawn_errors(
    serial: SerialErrors, order: Order, residuals: Array, sigma: float, random: np.random.Generator
) -> Array:
    """New errors (n,), correlated as those of a fit are; their correlation is drawn, too. A sieve
    bootstrap (P. Buehlmann, Bernoulli 3 (1997) 123-148). sigma : of independent errors.
    """
    i = int(random.choice(serial.values.size, p=serial.weights))
    rho, late = float(serial.values[i]), order.follows
    r = residuals[order.order]
    new = r.copy()
    new[late] = (r[late] - rho * r[np.nonzero(late)[0] - 1]) / np.sqrt(1 - rho**2)
    new -= new.mean()
    new *= sigma * float(serial.spreads[i]) / max(float(np.sqrt(np.mean(new**2))), 1e-300)
    return _following(random.choice(new, len(new)), rho, order)


def scaled_errors(
    serial: SerialErrors, order: Order, residuals: Array, sigma: float, random: np.random.Generator
) -> Array:
    """As :func:`drawn_errors`, as large from place to place as the residuals there: of a window of
    neighbours so long that most of what they share stays within (D. Andrews, Econometrica 59 (1991)
    817-858, for AR(1)).
    """
    n, rho = len(order.order), serial.correlation
    width = 2 * round((6 * (rho / (1 - rho**2)) ** 2 * n) ** (1 / 3)) + 3
    squares = residuals[order.order] ** 2
    window = np.ones(min(width, n))
    local = np.convolve(squares, window, "same") / np.convolve(np.ones(n), window, "same")
    size = np.empty(n)
    size[order.order] = np.sqrt(local / max(float(np.mean(squares)), 1e-300))
    size = np.maximum(size, 1e-3)
    return np.asarray(size * drawn_errors(serial, order, residuals / size, sigma, random))


def _following(new: Array, rho: float, order: Order) -> Array:
    """AR(1) of the variance of ``new``, in the order of the table."""
    own = np.where(order.follows, np.sqrt(1 - rho**2), 1.0) * new
    found, value = np.empty_like(own), 0.0
    for place, (part, follows) in enumerate(zip(own.tolist(), order.follows, strict=True)):
        found[place] = value = part + rho * value if follows else part
    result = np.empty_like(found)
    result[order.order] = found
    return result


def _likelihood(basis: Array, residuals: Array, order: Order) -> tuple[Array, Array]:
    """Logarithm of the restricted likelihood, and least squares of new errors, for each of RHO."""
    whole = _products(np.column_stack([basis, residuals]), order)
    normal, mixed, square = whole[:, :-1, :-1], whole[:, :-1, -1], whole[:, -1, -1]
    fitted = np.linalg.solve(normal, mixed[:, :, None])[:, :, 0]
    squares = np.maximum(square - np.sum(mixed * fitted, axis=1), 1e-300)
    spread = np.linalg.slogdet(normal)[1] + order.follows.sum() * np.log(1 - RHO**2)
    freedom = len(residuals) - basis.shape[1]
    return -(spread + freedom * np.log(squares)) / 2, squares


def _products(columns: Array, order: Order) -> Array:
    """X^T R^-1 X (g, k, k) of columns (n, k) for each of RHO, by differences along the order."""
    x, late, rho = columns[order.order], order.follows, RHO[:, None, None]
    first, own, before = x[~late], x[late], x[np.nonzero(late)[0] - 1]
    cross = own.T @ before
    moved = own.T @ own - rho * (cross + cross.T) + rho**2 * (before.T @ before)
    return np.asarray(first.T @ first + moved / (1 - rho**2))


def _meats(jacobian: Array, order: Order, rho: Array) -> Array:
    """J^T R J (g, k, k) for each correlation. With z_i = J_i + rho z_(i-1), R = sums of rho^|i-j|.
    The recursion runs over pairs, fours, ... of rows (prefix sums, W. Hillis, G. Steele, Comm. ACM
    29 (1986) 1170-1183), until rho to that power counts for nothing.
    """
    n = len(order.order)
    rows = np.ascontiguousarray(jacobian[:n][order.order].T)
    few = max(1, AT_ONCE // max(rows.size, 1))
    parts = []
    for low in range(0, rho.size, few):
        factor = rho[low : low + few, None, None] * order.follows
        z, reach = np.repeat(rows[None], len(factor), axis=0), 1
        while reach < n and np.max(factor) > 1e-17:
            z[:, :, reach:] += factor[:, :, reach:] * z[:, :, :-reach]
            factor[:, :, reach:] *= factor[:, :, :-reach].copy()
            factor[:, :, :reach] = 0.0
            reach *= 2
        crossed = (z - rows) @ rows.T
        parts.append(crossed + crossed.transpose(0, 2, 1) + jacobian.T @ jacobian)
    return np.concatenate(parts)

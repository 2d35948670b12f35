"""Linear mixed effects, out of what each unit says of its parameters.

A unit (a record, a muscle) tells of its parameters z in information form: its log likelihood is
x.z - z.A.z/2 but for a constant, where A (k, k) may lack rank. Units of a group scatter about the
group's mean with a covariance B, which is found by restricted maximum likelihood (D. Harville,
J. Am. Stat. Assoc. 72 (1977) 320-338) with the EM steps of N. Laird and J. Ware (Biometrics 38
(1982) 963-974), kept off zero by a factor |B|^1/2 in the likelihood (Y. Chung and others, J. Educ.
Behav. Stat. 40 (2015) 136-157); means and what is left of each unit are the best linear unbiased
predictions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .statistics import Array, inverse, require_level, student_t

STEPS = 400
SETTLED = 1e-5
"""Change of B in a step, in parts of what units scatter by in all."""
NODES = 64
"""Values of the size of B over which the error of a unit is averaged."""


@dataclass(frozen=True, eq=False)
class Scatter:
    """How units scatter about the means of their groups, and what follows for both. covariance : B
    (k, k). means, errors : of the groups (g, k), and their covariances (g, k, k). own : variance
    (k,) of what a unit alone says, harmonic mean. dof : units less groups. diagonal : whether there
    were too few units for correlations.
    """

    covariance: Array
    means: Array
    errors: Array
    own: Array
    dof: int
    diagonal: bool

    def spreads(self, level: float) -> tuple[Array, Array, Array]:
        """Standard deviation of each parameter between units, and its interval, by chi2 (three
        (k,)).
        """
        from scipy.special import chdtri

        level, size = require_level(level), np.diag(self.covariance)
        if self.dof < 1:
            return np.sqrt(size), np.zeros_like(size), np.full_like(size, np.inf)
        tail, free = (1 - level) / 2, size > 0
        whole = size + self.own
        if self.dof > 1:  # squares without the factor |B|^1/2, which moved the optimum
            whole *= np.maximum(1 - whole / (self.dof * np.where(free, size, np.inf)), 0)
        ends = [self.dof / chdtri(self.dof, q) for q in (tail, 1 - tail)]
        low, high = (np.sqrt(np.where(free, np.maximum(e * whole - self.own, 0), 0)) for e in ends)
        return np.sqrt(size), low, high

    def predicted(self, a: Array, x: Array, group: NDArray[np.intp]) -> tuple[Array, Array]:
        """Each unit's parameters (n, k) and their covariances, shrunken towards its group's mean.
        That the means and the size of B are uncertain adds to the covariance (C. Morris, J. Am.
        Stat. Assoc. 78 (1983) 47-55).
        """
        from scipy.special import chdtri

        first, total = _predicted(self, self.covariance, a, x, group)
        if self.dof < 3 or not self.covariance.any():
            return first, total
        nodes = self.dof / chdtri(self.dof, (np.arange(NODES) + 0.5) / NODES)
        mean = spread = np.zeros_like(first)
        total = np.zeros_like(total)
        for size in nodes:
            z, error = _predicted(self, size * self.covariance, a, x, group)
            mean, spread = mean + z / NODES, spread + (z - first) ** 2 / NODES
            total = total + error / NODES
        moved = np.sqrt(np.maximum(spread - (mean - first) ** 2, 0))
        return first, total + moved[:, :, None] * moved[:, None, :] * np.eye(first.shape[1])

    def reach(self, level: float) -> float:
        """Half width of the interval of a mean in standard errors."""
        return student_t(level, self.dof)


def between(
    a: Array, x: Array, group: NDArray[np.intp], free: NDArray[np.bool_], begin: Array | None = None
) -> Scatter:
    """The scatter of units about the means of their groups, searched from ``begin``. a, x : (n, k,
    k), (n, k), what each unit says. group : (n,), numbers that rise from 0. free : (k,), which
    parameters units have of their own.
    """
    n, k = x.shape
    count = int(group.max()) + 1
    dof = n - count
    scale = 1 / np.sqrt(np.maximum(np.mean(a, axis=0).diagonal(), 1e-300))
    a, x = a * np.outer(scale, scale), x * scale
    own = 1 / np.maximum(np.mean(1 / _variances(a), axis=0), 1e-300)
    diagonal = dof < 2 * int(free.sum())
    b = np.zeros((k, k))
    if dof > 0:
        b = _first(a, x, group, own) if begin is None else begin / np.outer(scale, scale)
        b = b * np.outer(free, free)
    for _ in range(STEPS if dof > 0 and free.any() else 0):
        new = _step(a, x, group, b) * (n / (n - 1) if dof > 1 else 1)
        if diagonal:
            new = np.diag(np.diag(new))
        whole = np.sqrt(np.maximum(np.diag(new), np.diag(b)) + own)
        change = float(np.max(np.abs(new - b) / np.outer(whole, whole)))
        b = new
        if change < SETTLED:
            break
    means, errors = _means(*marginal(a, x, b), group, count)
    square = np.outer(scale, scale)
    return Scatter(b * square, means * scale, errors * square, own * scale**2, dof, diagonal)


def marginal(a: Array, x: Array, b: Array) -> tuple[Array, Array]:
    """What units say of their group's mean: (A^-1 + B)^-1, and x likewise."""
    root = np.linalg.inv(np.eye(len(b)) + a @ b)
    narrowed = root @ a
    return (narrowed + narrowed.transpose(0, 2, 1)) / 2, (root @ x[:, :, None])[:, :, 0]


def effects(a: Array, x: Array, b: Array, means: Array) -> Array:
    """Of each unit, about the mean that holds for it: B (I + A B)^-1 (x - A mean)."""
    rest = x[:, :, None] - a @ means[:, :, None]
    return np.asarray((b @ np.linalg.inv(np.eye(len(b)) + a @ b) @ rest)[:, :, 0])


def _variances(a: Array) -> Array:
    """Of what units say alone (n, k); infinite where one does not see a parameter."""
    d = np.sqrt(np.maximum(np.diagonal(a, axis1=1, axis2=2), 1e-300))
    values, vectors = np.linalg.eigh(a / (d[:, :, None] * d[:, None, :]))
    lost = values < 1e-12
    parts = vectors**2 / np.where(lost, 1.0, values)[:, None, :]
    unseen = np.any((vectors**2 > 1e-9) & lost[:, None, :], axis=2)
    return np.where(unseen, np.inf, parts.sum(axis=2) / d**2)


def _first(a: Array, x: Array, group: NDArray[np.intp], own: Array) -> Array:
    """Where EM begins: diagonal, the variance of the units' own values."""
    values = (inverse(a) @ x[:, :, None])[:, :, 0]
    known = np.isfinite(_variances(a))
    found = own.copy()
    for j in range(x.shape[1]):
        seen = known[:, j]
        if seen.sum() > 2:
            z, g = values[seen, j], group[seen]
            mean = np.bincount(g, z) / np.maximum(np.bincount(g), 1)
            found[j] = max(float(np.mean((z - mean[g]) ** 2)), 0.01 * own[j])
    return np.diag(np.where(np.isfinite(found), found, 1.0))


def summed(values: Array, group: NDArray[np.intp], count: int) -> Array:
    """Sums over the units of each group, whose numbers rise from 0 without a gap."""
    return np.asarray(np.add.reduceat(values, np.searchsorted(group, np.arange(count)), axis=0))


def _means(a: Array, x: Array, group: NDArray[np.intp], count: int) -> tuple[Array, Array]:
    """Means of the groups by generalised least squares, and their covariances."""
    whole, right = summed(a, group, count), summed(x, group, count)
    errors = inverse(whole)
    return (errors @ right[:, :, None])[:, :, 0], errors


def _step(a: Array, x: Array, group: NDArray[np.intp], b: Array) -> Array:
    """One EM step for B: the mean of b b' expected with the B before, means integrated out."""
    means, errors = _means(*marginal(a, x, b), group, int(group.max()) + 1)
    effect, n = effects(a, x, b, means[group]), len(x)
    # B root is the units' covariance; K = B root A is what the mean's error does to effects
    root = np.linalg.inv(np.eye(len(b)) + a @ b)
    total = effect.T @ effect / n + b @ np.mean(root, axis=0)
    part = b @ root @ a
    total = total + np.mean(part @ errors[group] @ part.transpose(0, 2, 1), axis=0)
    return np.asarray((total + total.T) / 2)


def _predicted(
    scatter: Scatter, b: Array, a: Array, x: Array, group: NDArray[np.intp]
) -> tuple[Array, Array]:
    """See :meth:`Scatter.predicted`, for one B."""
    means, errors = _means(*marginal(a, x, b), group, len(scatter.means))
    narrow = b @ np.linalg.inv(np.eye(len(b)) + a @ b)
    rest = np.eye(len(b)) - narrow @ a
    own = means[group] + effects(a, x, b, means[group])
    error = narrow + rest @ errors[group] @ rest.transpose(0, 2, 1)
    return own, (error + error.transpose(0, 2, 1)) / 2


def shrunken_variances(squares: Array, dof: Array) -> Array:
    """Variances of units out of sums of squares (n,), drawn towards what they have in common.
    Inverse gamma, by the moments of logarithms (G. Smyth, Stat. Appl. Genet. Mol. Biol. 3 (2004),
    Article 3, 6.2).
    """
    from scipy.optimize import brentq
    from scipy.special import digamma, polygamma

    seen = (dof > 0) & (squares > 0)
    if not seen.any():
        return np.zeros_like(squares)
    pooled = float(squares[seen].sum() / dof[seen].sum())
    half = dof[seen] / 2
    log = np.log(squares[seen] / dof[seen]) - digamma(half) + np.log(half)
    excess = float(np.var(log, ddof=1) - np.mean(polygamma(1, half))) if seen.sum() > 2 else 0.0
    if excess <= 1e-6:
        return np.full_like(squares, pooled)
    prior = 2 * float(brentq(lambda d: polygamma(1, d) - excess, 1e-6, 2 / excess + 2))
    common = float(np.exp(np.mean(log) + digamma(prior / 2) - np.log(prior / 2)))
    return np.asarray((prior * common + squares) / (prior + dof))

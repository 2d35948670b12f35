"""Statistics of least squares near its optimum: covariance, rank, intervals, and doubts in words.

Linearised least squares as in G. Seber, C. Wild, Nonlinear Regression (1989), ch. 5: the
covariance is s^2 (J^T J)^-1 with the exact Jacobian J at the optimum and s^2 the residual sum of
squares over the degrees of freedom; intervals by Student's t. The Jacobian's columns are scaled
to unit length before its rank is judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_finite
from ..muscles.law import ForceLaw
from ..numerics.elementwise import Elementwise

Array: TypeAlias = NDArray[np.float64]
RANK_TOLERANCE = 1e-9
"""Singular values below this times the largest count as zero (columns of unit length)."""
BISECTIONS = 60
"""Of the half width of an interval: to the rounding of its ends."""
BLOCK, SMALLEST_BLOCK = 16384, 256
"""Values that are held for each operation of a law's functions; places at least."""
NEARLY_DEPENDENT = 100.0
"""Condition number of the scaled Jacobian from which a fit says what the data hardly see."""


def _expression(law: type[ForceLaw]) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    function = law.function()
    p, kappa = ca.SX.sym("p"), ca.SX.sym("kappa")
    c = ca.SX.sym("c", function.size1_in(2))
    return p, kappa, c, function(p, kappa, c)[0]


@cache
def elementwise(law: type[ForceLaw], order: int) -> Elementwise:
    """(p, kappa, *coefficients) -> tension (order 0), and its gradient in the coefficients (1), and
    what is not zero by structure in the upper triangle of its second derivatives (2).
    """
    p, kappa, c, tension = _expression(law)
    found = [ca.densify(tension)]
    if order:
        found.append(ca.densify(ca.jacobian(tension, c)))
    if order > 1:
        found.append(ca.triu(ca.hessian(tension, c)[0]))
    return Elementwise(ca.Function("law", [p, kappa, c], ca.cse(found)))


@cache
def second_places(law: type[ForceLaw]) -> tuple[tuple[int, int], ...]:
    """(row, column), row <= column, of the second derivatives that :func:`elementwise` gives."""
    _, _, c, tension = _expression(law)
    rows, columns = ca.triu(ca.hessian(tension, c)[0]).sparsity().get_triplet()
    return tuple(zip(rows, columns, strict=True))


def forces(law: type[ForceLaw], p: Array, kappa: Array, coefficients: Array) -> Array:
    """Tension (m, n) at places (n,) for coefficients (m, all)."""
    found = np.empty((len(coefficients), len(p)))
    for part, block in in_blocks(law, 0, p, kappa, coefficients):
        found[:, part] = block[:, 0]
    return found


def forces_and_slopes(
    law: type[ForceLaw], p: Array, kappa: Array, coefficients: Array
) -> tuple[Array, Array]:
    """Tension (m, n) and its derivatives (m, n, all) at places (n,) for coefficients (m, all)."""
    m, size = coefficients.shape
    both = np.empty((m, 1 + size, len(p)))
    for part, block in in_blocks(law, 1, p, kappa, coefficients):
        both[:, :, part] = block
    return both[:, 0], both[:, 1:].transpose(0, 2, 1)


def in_blocks(
    law: type[ForceLaw], order: int, p: Array, kappa: Array, coefficients: Array
) -> Iterator[tuple[slice, Array]]:
    """The outputs (m, outputs, block) of :func:`elementwise`, so many places (n,), or (m, n), at a
    time as a cache holds. The array is used again for the next block.
    """
    function, (m, n) = elementwise(law, order), (len(coefficients), p.shape[-1])
    p, kappa = np.atleast_2d(p), np.atleast_2d(kappa)
    columns = coefficients.T[:, :, None]
    step = min(n, max(SMALLEST_BLOCK, BLOCK // max(m, 1)))
    room = np.empty((m, function.outputs, step))
    for low in range(0, n, step or 1):
        part = slice(low, min(low + step, n))
        found = room[:, :, : part.stop - low]
        for i, value in enumerate(function(p[:, part], kappa[:, part], *columns)):
            found[:, i] = value
        yield part, found


def even(columns: Array) -> tuple[Array, Array]:
    """Columns (n, k) of unit length, and the lengths (k,) that they had; 1 for columns of zeros."""
    norms = np.linalg.norm(columns, axis=0)
    norms = np.where(norms > 0, norms, 1.0)
    return columns / norms, norms


def spanned(columns: Array, tolerance: float = RANK_TOLERANCE) -> Array:
    """Orthonormal columns that span the given ones (n, k); small singular values count as zero."""
    u, s, _ = np.linalg.svd(even(columns)[0], full_matrices=False)
    return np.asarray(u[:, s > tolerance * s.max(initial=1e-300)])


def inverse(squares: Array, tolerance: float = 1e-13) -> Array:
    """Pseudoinverses of symmetric matrices >= 0 (..., k, k), their diagonals scaled to 1."""
    d = np.sqrt(np.maximum(np.diagonal(squares, axis1=-2, axis2=-1), 0.0))
    d = np.where(d > 0, d, 1.0)
    both = d[..., :, None] * d[..., None, :]
    return np.asarray(np.linalg.pinv(squares / both, rcond=tolerance, hermitian=True) / both)


def require_level(level: float) -> float:
    """``level``, or an InputError when it is no part between 0 and 1."""
    level = require_finite("level", level)
    if not 0 < level < 1:
        raise InputError(f"level = {level:g} must lie between 0 and 1, as in 0.95")
    return level


def student_t(level: float, dof: int) -> float:
    """Half width of a two-sided interval in standard errors; infinite without freedom."""
    from scipy.special import stdtrit

    level = require_level(level)
    return float(stdtrit(dof, (1 + level) / 2)) if dof > 0 else float("inf")


def require_choice(argument: str, value: Any, known: Sequence[str]) -> Any:
    """``value``, or an InputError when it is none of ``known``."""
    if value not in known:
        *first, last = map(repr, known)
        raise InputError(f"{argument} = {value!r}: choose {', '.join(first)} or {last}")
    return value


def f_test(gained: float, more: int, left: float, dof: int) -> tuple[float, float]:
    """(F, the probability that chance makes it as large) of ``more`` freedoms that ``gained`` of a
    sum of squares, of which ``left`` stays with ``dof``.
    """
    from scipy.special import fdtrc

    f = max(gained, 0.0) / more / (left / dof) if left else float("inf")
    return f, float(fdtrc(more, dof, f)) if np.isfinite(f) else 0.0


@dataclass(frozen=True)
class Coefficient:
    """One coefficient of a fit [unit]; stderr is 0 where held, infinite where the data are blind.

    Examples
    --------
    >>> a3 = fit.coefficients["a3"]
    >>> a3.held, a3.stderr > 0
    (False, True)
    """

    name: str
    value: float
    stderr: float
    unit: str
    held: bool
    description: str = ""


@dataclass(frozen=True, eq=False)
class Prediction:
    """Force [N] of the fitted law, its standard error, and intervals; nothing is below zero.

    ``confidence`` (low, high) holds the law's mean, ``prediction`` a new measurement. ``slack`` :
    where the law is below zero, and a muscle, which only pulls, slack. ``outside`` : where no data
    are near; the band holds for the law, and nothing says that the law holds there.

    Examples
    --------
    >>> band = fit.predict(3e5, 0.10)
    >>> bool(band.confidence[0] < band.force < band.confidence[1])
    True
    """

    force: Array
    stderr: Array
    confidence: tuple[Array, Array]
    prediction: tuple[Array, Array]
    level: float
    slack: NDArray[np.bool_]
    outside: NDArray[np.bool_]

    @classmethod
    def of_law(
        cls,
        force: Array,
        stderr: Array,
        confidence: tuple[Array, Array],
        prediction: tuple[Array, Array],
        level: float,
        outside: NDArray[np.bool_],
    ) -> Prediction:
        """What a law and its bands say of a muscle, which is slack where they are below zero."""
        pull, *ends = (np.maximum(a, 0.0) for a in (force, *confidence, *prediction))
        bands = (ends[0], ends[1]), (ends[2], ends[3])
        return cls(pull, stderr, *bands, level, np.asarray(force <= 0), outside)


@dataclass(frozen=True)
class SolverStatistics:
    """How the optimum was found.

    gradient : largest cosine between the residual and a column of the Jacobian, 0 at an optimum.
    scanned : points of the global scan. at_bound : coefficients that ended at a bound.
    doubt : why the optimum is in doubt, in words; empty when it is not.

    Examples
    --------
    >>> fit.solver.gradient < 1e-6, fit.solver.at_bound
    (True, ())
    """

    status: str
    iterations: int
    gradient: float
    scanned: int
    at_bound: tuple[str, ...] = ()
    seconds: float = 0.0
    doubt: str = ""


@dataclass(frozen=True, eq=False)
class SerialErrors:
    """Serially correlated errors.

    order : along what, in words. probability : that errors are serially correlated at all.
    correlation : of neighbouring errors, the mean over all that the data leave possible.
    meat : (k, k), J^T R J with that correlation, for errors of the variance that independent ones
    would have. spread : standard deviation of an error, in that of independent ones.
    weights, sizes : (g,), how likely each rho is, and the variances that it gives to the
    coefficients, in those of ``correlation``. dof : degrees of freedom.
    values, spreads : (g,), each rho, and the standard deviation of an error with it.
    """

    order: str
    correlation: float
    probability: float
    meat: Array = field(repr=False)
    spread: float
    weights: Array = field(repr=False)
    sizes: Array = field(repr=False)
    dof: int
    values: Array = field(repr=False)
    spreads: Array = field(repr=False)

    def reach(self, level: float) -> float:
        """Half width of a two-sided interval in standard errors (those with ``correlation``)."""
        from scipy.special import stdtr

        roots = np.sqrt(self.sizes)
        low, high = student_t(level, self.dof) * np.array([roots.min(), roots.max()])
        for _ in range(BISECTIONS):  # scipy.optimize would take a quarter of a second to load
            half = (low + high) / 2
            below = self.weights @ stdtr(self.dof, half / roots) < (1 + level) / 2
            low, high = (half, high) if below else (low, half)
        return float((low + high) / 2)


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A least-squares problem near its optimum. names, values, units : of the k fitted parameters.
    jacobian : weighted derivatives (n, k). scale : standard deviation of a residual. dof : degrees
    of freedom. active : gradients (m, k) of constraints that hold as equalities at the optimum.
    serial : serially correlated errors, which widen the covariance; None for independent ones.
    """

    names: Sequence[str]
    values: Array
    units: Sequence[str]
    jacobian: Array
    scale: float
    dof: int
    active: Array | None = None
    serial: SerialErrors | None = None

    @cached_property
    def decomposition(self) -> tuple[Array, Array, Array]:
        """Lengths of the columns; singular values and right vectors with columns of unit length."""
        columns, norms = even(self.jacobian)
        scaled = np.linalg.qr(columns, mode="r")  # all that its SVD is wanted for
        if self.active is None or not len(self.active):
            _, s, vt = np.linalg.svd(scaled, full_matrices=False)
            return norms, s, vt
        held = np.linalg.svd(self.active / norms)
        free = held[2][int(np.sum(held[1] > RANK_TOLERANCE * held[1][0])) :].T
        _, s, vt = np.linalg.svd(scaled @ free, full_matrices=False)
        return norms, s, vt @ free.T

    @property
    def rank(self) -> int:
        """How many independent combinations of the parameters the data determine."""
        s = self.decomposition[1]
        return int(np.sum(s > RANK_TOLERANCE * s[0])) if s.size else 0

    @property
    def condition(self) -> float:
        """Condition number of the Jacobian with columns of unit length."""
        s = self.decomposition[1]
        with np.errstate(over="ignore"):  # a column all but without entries
            return float(s[0] / s[-1]) if s.size and s[-1] > 0 else float("inf")

    @property
    def _root(self) -> Array:
        norms, s, vt = self.decomposition
        return np.asarray(vt[: self.rank].T / s[: self.rank] / norms[:, None])

    @cached_property
    def _factor(self) -> Array:
        """Covariance for errors of variance 1."""
        inverse = self._root @ self._root.T
        return np.asarray(inverse if self.serial is None else inverse @ self.serial.meat @ inverse)

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the parameters; of what the data determine where rank is lacking."""
        scale = self.scale if self.dof else float("inf")
        with np.errstate(invalid="ignore"):
            return np.asarray(scale**2 * self._factor)

    @property
    def correlation(self) -> Array:
        """Correlation matrix of the parameters."""
        size = np.sqrt(np.maximum(np.diag(self._factor), 1e-300))
        return np.asarray(self._factor / np.outer(size, size))

    def reach(self, level: float) -> float:
        """Half width of a two-sided interval in standard errors."""
        if self.serial is None:
            return student_t(level, self.dof)
        return self.serial.reach(level)

    @cached_property
    def independent(self) -> Linearisation:
        """The same, were the errors independent."""
        return self if self.serial is None else replace(self, serial=None)

    def blind(self, directions: Array) -> NDArray[np.bool_]:
        """Whether a direction (rows, in parameters) has a part that the data do not see."""
        norms, _, vt = self.decomposition
        scaled = directions / norms
        length = np.linalg.norm(scaled, axis=1)
        unseen = np.linalg.norm(scaled @ vt[self.rank :].T, axis=1)
        return np.asarray(unseen > 1e-6 * length)

    def stderr(self, directions: Array | None = None) -> Array:
        """Standard errors of linear combinations (rows), by default of the parameters."""
        if directions is None:
            directions = np.eye(len(self.names))
        if not self.dof:
            return np.full(len(directions), np.inf)
        variance = np.einsum("ij,jk,ik->i", directions, self.covariance, directions)
        error = np.sqrt(np.maximum(variance, 0.0))
        return np.where(self.blind(directions), np.inf, error)

    def hardly_seen(self) -> Iterator[tuple[bool, Array, str]]:
        """Combinations that the data do not (True) or hardly (False) see: one standard error's
        change, or 10 % of the largest participant where that is infinite, and in words.
        """
        norms, s, vt = self.decomposition
        for value, vector in zip(s, vt, strict=True):
            if value * NEARLY_DEPENDENT > s[0]:
                continue
            lost = bool(value <= RANK_TOLERANCE * s[0]) or not self.dof
            move = vector / norms
            if lost:
                lead = int(np.argmax(np.abs(vector)))
                move *= 0.1 * (abs(self.values[lead]) or 1.0) / move[lead]
            else:
                move *= self.scale / value
            words = " and ".join(
                f"{n} by {d:+.3g}{'' if u == '1' else ' ' + u}"
                for n, d, u, part in zip(self.names, move, self.units, np.abs(vector), strict=True)
                if part > 0.1
            )
            yield bool(value <= RANK_TOLERANCE * s[0]), np.asarray(move), words

    def correlated(self, beyond: float = 0.5) -> list[tuple[float, str, str]]:
        """Pairs of parameters with a correlation beyond a limit, the strongest first."""
        r, n = self.correlation, self.names
        pairs = [(float(r[i, j]), n[j], n[i]) for i in range(len(n)) for j in range(i)]
        return sorted((p for p in pairs if abs(p[0]) > beyond), key=lambda pair: -abs(pair[0]))

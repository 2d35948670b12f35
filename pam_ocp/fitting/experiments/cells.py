"""Which cells to measure next: pressures and lengths that shrink the intervals of a force law most.

The sensitivities are those at the present estimate (a locally optimal design): with coefficients
that are poorly known, design again after every few measurements. (V. Fedorov, Theory of Optimal
Experiments, 1972; A. Atkinson, A. Donev, R. Tobias, Optimum Experimental Designs, 2007, ch. 9-12.)
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.cases import results_of
from ...core.errors import (
    InputError,
    UnknownNameError,
    kind_of,
    require_count,
    require_ends,
    require_finite,
    require_positive,
)
from ...core.executors import Place
from ...core.files import atomic_path
from ...core.stop import verb
from ...muscles.law import ForceLaw
from ..static.force_fit import ForceFit
from ..static.optimum import sensitivity
from ..statistics import Array, Linearisation, require_choice, student_t
from ..tables.force_table import ForceTable

DesignCriterion: TypeAlias = Literal["D", "A", "I"]
GRID = 25
"""Candidates along each range, before points move between them."""
TAUT = 3.0
"""Cells are proposed where the law pulls with at least this many standard deviations of the noise.
"""
_WORDS = {
    "D": "volume of the joint confidence region",
    "A": "mean relative variance of the coefficients",
    "I": "mean variance of the predicted force",
}


@dataclass(frozen=True, eq=False)
class CellDesign:
    """Cells to measure next, and what they promise.

    cells : pressure, contraction, and the force [N] that the law expects there; in order of
    pressure. stderr_before, stderr_after : standard errors of the coefficients that are free.
    prediction_before, prediction_after : root of the mean variance of the predicted force [N].
    efficiency : at least this, against the best design of the same size on the grid of candidates.

    Examples
    --------
    >>> design = pam.experiments.design_cells(fit, 4)
    >>> len(design.cells.force), design.stderr_after["a3"] < design.stderr_before["a3"]
    (4, True)
    """

    cells: ForceTable
    criterion: DesignCriterion
    parameters: tuple[str, ...]
    stderr_before: Mapping[str, float]
    stderr_after: Mapping[str, float]
    prediction_before: float
    prediction_after: float
    efficiency: float
    noise: float
    law: ForceLaw = field(repr=False)
    dof: int = field(repr=False)
    """Degrees of freedom after the measurement."""

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Interval that the coefficient will have if it turns out as it is now."""
        if name not in self.stderr_after:
            raise UnknownNameError("free coefficient", name, self.stderr_after)
        value = float(self.law.values[name])
        half = student_t(level, self.dof) * self.stderr_after[name]
        return value - half, value + half

    def report(self) -> str:
        """The cells and the standard errors before and after, as text."""
        t, length = self.cells, self.cells.rest_length
        head = f"{'':>5}{'p [bar]':>9}{'kappa [%]':>11}" + (f"{'l [mm]':>9}" if length else "")
        of = "" if self.criterion == "I" else f" ({', '.join(self.parameters)})"
        lines = [
            f"{len(t)} further cells for the {self.law.name} law, {self.criterion}-optimal: least "
            f"{_WORDS[self.criterion]}{of}",
            f"at least {100 * self.efficiency:.0f} % as good as any choice of {len(t)} candidates; "
            f"noise of a measurement {self.noise:.3g} N",
            head + f"{'F expected [N]':>16}",
        ]
        for i in range(len(t)):
            shown = f"{i + 1:>5}{t.pressure[i] / 1e5:>9.3f}{100 * t.contraction[i]:>11.2f}"
            shown += f"{1e3 * length * (1 - t.contraction[i]):>9.2f}" if length else ""
            lines.append(shown + f"{t.force[i]:>16.1f}")
        lines.append(f"{'standard error of':<18}{'before':>11}{'after':>11}{'ratio':>8}")
        for name, after in self.stderr_after.items():
            before = self.stderr_before[name]
            lines.append(f"{name:<18}{before:>11.4g}{after:>11.4g}{after / before:>8.2f}")
        lines.append(
            f"{'mean force [N]':<18}{self.prediction_before:>11.4g}{self.prediction_after:>11.4g}"
            f"{self.prediction_after / self.prediction_before:>8.2f}"
        )
        return "\n".join(lines)

    __str__ = report

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the cells as CSV for the bench, with an empty column for the force."""
        cells, length = self.cells, self.cells.rest_length
        columns = {"pressure_Pa": cells.pressure, "contraction": cells.contraction}
        columns["expected_force_N"] = cells.force
        if length:
            columns["length_m"] = length * (1 - cells.contraction)
        forms = ["%.6g", "%.6g", "%.4g", "%.6g"][: len(columns)]
        rows, head = np.column_stack(list(columns.values())), ",".join(columns)
        with atomic_path(path) as temporary:
            np.savetxt(temporary, rows, forms, ",", header=head, comments="", encoding="utf-8")
        return Path(path)


@dataclass(frozen=True, eq=False)
class _Known:
    """What is known of a law before the measurement."""

    law: ForceLaw
    free: tuple[str, ...]
    linearisation: Linearisation
    noise: float
    rest_length: float | None

    def gradient(self, p: Array, kappa: Array) -> tuple[Array, Array]:
        """Tension (m,) [N] and its derivatives (m, k) with respect to the free coefficients."""
        return sensitivity(self.law, self.free, p, kappa)

    @property
    def information(self) -> Array:
        """M0 (k, k), of measurements in units of the noise."""
        jacobian = self.linearisation.jacobian / self.noise
        return np.asarray(jacobian.T @ jacobian)

    def after(self, rows: Array) -> Linearisation:
        """With further measurements of gradients ``rows`` (n, k) [N/unit]."""
        known = self.linearisation
        jacobian = np.concatenate([known.jacobian, rows])
        return replace(known, jacobian=jacobian, scale=self.noise, dof=known.dof + len(rows))


@verb
def design_cells(
    known: ForceFit | ForceLaw,
    n: int,
    *,
    criterion: DesignCriterion = "D",
    parameters: Sequence[str] | None = None,
    pressure: tuple[float, float] | None = None,
    contraction: tuple[float, float] | None = None,
    candidates: tuple[ArrayLike, ArrayLike] | None = None,
    predict_at: tuple[ArrayLike, ArrayLike] | None = None,
    repeats: int | None = None,
    noise: float | None = None,
    covariance: ArrayLike | None = None,
    fixed: Sequence[str] = (),
    executor: Place = None,
    time_limit: float | None = None,
) -> CellDesign:
    """Propose ``n`` further cells within the bench's limits that shrink the chosen intervals most.

    Parameters
    ----------
    known : a fit, whose data count; or a law with the ``covariance`` of its coefficients (in the
        order of ``law.free_coefficients()`` without ``fixed``). A law alone: nothing is measured
        yet.
    criterion : "D", the volume of the joint confidence region of ``parameters``; "A", their mean
        relative variance; "I", the mean variance of the force predicted at ``predict_at``.
    parameters : whose intervals shall shrink; by default all free coefficients.
    pressure, contraction : (low, high) that the bench reaches [Pa], [1]; by default those of the
        fit's table. Points lie anywhere between.
    candidates : (pressures, contractions), equally long: measure only there.
    predict_at : (pressures, contractions) where the force matters; by default all candidates.
    repeats : how often one cell may be proposed; by default any number. With 1 points do not move
        off the candidates.
    noise : standard deviation of a measurement [N]; by default the fit's.
    fixed : coefficients of a law (not of a fit) that are known.
    executor : where the eight starts of the search are tried, as for :func:`pam_ocp.each`; pays
        from some hundred cells on.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Cells where the law pulls with less than three standard deviations are left out. Raises
    InputError, UnknownNameError (arguments that cannot be, too few points for the coefficients).

    Examples
    --------
    >>> design = pam.experiments.design_cells(fit, 4, pressure=(1e5, 6e5))
    >>> bool(design.cells.pressure.max() < 6.001e5)
    True
    """
    require_choice("criterion", criterion, tuple(_WORDS))
    require_count("n", n)
    state = _known(known, noise, covariance, fixed)
    places = chosen(state.free, parameters, "coefficient")
    points, steps = _candidates(state, known, pressure, contraction, candidates)
    tension, gradient = state.gradient(*points.T)
    taut = tension >= TAUT * state.noise
    if not taut.any():
        raise InputError("the law is slack at all candidates: widen pressure or contraction")
    points, gradient = points[taut], gradient[taut]
    where = (
        gradient if predict_at is None else state.gradient(*_points("predict_at", predict_at).T)[1]
    )
    aim = _criterion(state, criterion, places, where)
    most = n if repeats is None else require_count("repeats", repeats)
    selection = exchange(
        gradient / state.noise, n, aim, state.information, repeats=most, executor=executor
    )
    cells = points[selection.indices]
    if steps is not None and most >= n:
        cells = refine(cells, steps, _reachable(state, points), aim, state.information)
    cells = cells[np.lexsort((cells[:, 1], cells[:, 0]))]
    return _design(state, criterion, places, cells, where, selection.efficiency)


def _design(
    state: _Known,
    criterion: DesignCriterion,
    places: tuple[int, ...],
    cells: Array,
    where: Array,
    efficiency: float,
) -> CellDesign:
    tension, gradient = state.gradient(*cells.T)
    after = state.after(gradient)
    source = f"designed for the {state.law.name} law"
    return CellDesign(
        cells=ForceTable(cells[:, 0], cells[:, 1], tension, state.rest_length, source),
        criterion=criterion,
        parameters=tuple(state.free[i] for i in places),
        stderr_before=dict(zip(state.free, state.linearisation.stderr().tolist(), strict=True)),
        stderr_after=dict(zip(state.free, after.stderr().tolist(), strict=True)),
        prediction_before=float(np.sqrt(np.mean(state.linearisation.stderr(where) ** 2))),
        prediction_after=float(np.sqrt(np.mean(after.stderr(where) ** 2))),
        efficiency=efficiency,
        noise=state.noise,
        law=state.law,
        dof=after.dof,
    )


def _criterion(
    state: _Known, criterion: DesignCriterion, places: tuple[int, ...], where: Array
) -> Criterion:
    if criterion == "D":
        return Criterion(places)
    if criterion == "I":
        return Criterion((), where.T @ where / len(where))
    sizes = np.abs(state.linearisation.values)
    nominal = {v.name: v.nominal for v in state.law.coefficient_variables()}
    sizes = np.where(sizes > 0, sizes, [nominal[n] for n in state.free])
    weight = np.zeros(sizes.size)
    weight[list(places)] = 1 / (len(places) * sizes[list(places)] ** 2)
    return Criterion((), np.diag(weight))


# ---- arguments -----------------------------------------------------------------------------------
def _known(
    known: Any, noise: float | None, covariance: ArrayLike | None, fixed: Sequence[str]
) -> _Known:
    if isinstance(known, ForceFit):
        if covariance is not None or fixed:
            raise InputError("covariance and fixed belong to a law; a fit has its own")
        if noise is None and not known.dof:
            raise InputError("noise is missing: the fit has no degrees of freedom to tell it")
        told = None if noise is None else require_positive("noise", noise, "N")
        size = told or known.usual * known.sigma
        linear = known.linearisation
        scale = size / known.usual if told else max(float(linear.scale), 1e-9)
        # a robust fit sees its data with more scatter than one measurement has
        jacobian = linear.jacobian * size / scale
        if linear.serial is not None and linear.rank == len(known.free):
            root = _root(linear.covariance, len(known.free))
            jacobian = size * root * float(linear.scale) / scale
        linear = replace(linear, jacobian=jacobian, scale=size, serial=None)
        return _Known(known.law, known.free, linear, size, known.table.rest_length)
    if not isinstance(known, ForceLaw):
        raise InputError(f"known is {kind_of(known)}; give a ForceFit or a force law")
    if noise is None:
        raise InputError("noise is missing: give the standard deviation of a measurement [N]")
    size = require_positive("noise", noise, "N")
    variables = {v.name: v for v in known.coefficient_variables()}
    for name in fixed:
        if name not in variables:
            raise UnknownNameError("coefficient in fixed", name, variables)
    free = tuple(n for n in known.free_coefficients() if n not in fixed)
    values = np.array([float(known.values[n]) for n in free])
    root = np.zeros((len(free), len(free)))
    if covariance is not None:
        root = size * _root(np.asarray(covariance, dtype=float), len(free))
    units = [variables[n].unit for n in free]
    # without data of its own the noise is as good as known: intervals are normal
    linear = Linearisation(free, values, units, root, size, 10**6)
    length = known.values.get("rest_length")
    return _Known(known, free, linear, size, None if length is None else float(length))


def _root(covariance: Array, k: int) -> Array:
    """R with R^T R = covariance^-1."""
    if covariance.shape != (k, k) or not np.all(np.isfinite(covariance)):
        raise InputError(
            f"covariance has shape {covariance.shape}; give finite numbers, ({k}, {k})"
        )
    sizes = np.sqrt(np.abs(np.diag(covariance)))
    try:
        factor = np.linalg.cholesky(covariance / np.outer(sizes, sizes))
    except np.linalg.LinAlgError:
        raise InputError("covariance is not positive definite") from None
    return np.asarray(np.linalg.inv(factor) / sizes)


def _points(argument: str, given: tuple[ArrayLike, ArrayLike]) -> Array:
    try:
        p, kappa = (np.atleast_1d(np.asarray(a, dtype=float)) for a in given)
    except (TypeError, ValueError):
        raise InputError(f"{argument}: give (pressures [Pa], contractions)") from None
    if p.shape != kappa.shape or p.ndim != 1 or not np.all(np.isfinite([p, kappa])):
        raise InputError(
            f"{argument}: pressures {p.shape} and contractions {kappa.shape} must be finite and "
            "equally long rows"
        )
    return np.stack([p, kappa], axis=1)


def _range(
    name: str, given: Any, usual: tuple[float, float] | None, unit: str
) -> tuple[float, float]:
    if given is None:
        if usual is None:
            raise InputError(f"{name} is missing: give (low, high) that the bench reaches")
        return usual
    low, high = (require_finite(name, end) for end in require_ends(name, given, unit))
    return low, high


def _candidates(
    state: _Known, known: Any, pressure: Any, contraction: Any, candidates: Any
) -> tuple[Array, Array | None]:
    """Points (m, 2) and the grid's steps, None for candidates of the user's."""
    if candidates is not None:
        if pressure is not None or contraction is not None:
            raise InputError("candidates are given: leave pressure and contraction away")
        return _points("candidates", candidates), None
    p_usual = k_usual = None
    if isinstance(known, ForceFit):
        table = known.table
        p_usual = (max(float(table.pressure.min()), 0.0), float(table.pressure.max()))
        k_usual = (float(table.contraction.min()), float(table.contraction.max()))
    p_range = _range("pressure", pressure, p_usual, "Pa")
    k_range = _range("contraction", contraction, k_usual, "1")
    axes = [np.linspace(*r, GRID) for r in (p_range, k_range)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)
    return grid, np.array([(r[1] - r[0]) / (GRID - 1) for r in (p_range, k_range)])


def _reachable(state: _Known, grid: Array) -> Any:
    """Gradients in units of noise at points; NaN beyond the bench's limits, and where slack."""
    low, high = grid.min(axis=0), grid.max(axis=0)

    def gradient(points: Array) -> Array:
        tension, rows = state.gradient(*points.T)
        edge = 1e-12 * (high - low)
        inside = np.all((points >= low - edge) & (points <= high + edge), axis=1)
        return np.where(
            (inside & (tension >= TAUT * state.noise))[:, None], rows / state.noise, np.nan
        )

    return gradient


# ---- exact optimal designs -----------------------------------------------------------------------
# Measurements with gradients f (rows, in units of their noise) add their information f f^T to what
# is known: C = (M0 + sum f f^T)^-1. All criteria here are convex functions of the information, so
# the gradient at a design bounds how far any other design could be better.
RIDGE = 1e-9
"""Information added in every direction while a design is sought from nothing, times that of the
candidates.
"""
BETTER = 1e-9
"""Relative improvement below which exchanging ends."""
STARTS = 8
"""Designs from which exchanging begins: one built up point by point, the others random."""


def chosen(free: Sequence[str], parameters: Sequence[str] | None, called: str) -> tuple[int, ...]:
    """Positions of the parameters whose intervals shall shrink, by default of all that are free."""
    wanted = free if parameters is None else parameters
    if isinstance(wanted, str) or not wanted:
        raise InputError(f"parameters = {parameters!r}: give a list of free {called}s")
    for name in wanted:
        if name not in free:
            raise UnknownNameError(f"free {called} in parameters", name, free)
    return tuple(free.index(n) for n in wanted)


@dataclass(frozen=True, eq=False)
class Criterion:
    """What a design makes small, as a function of the covariance C (k, k). chosen : positions of
    the parameters whose ln det C[chosen, chosen] counts (D- or D_s-optimal). weight : W (k, k) of
    the mean variance trace(W C) (A-, c- and I-optimal); then ``chosen`` does not count.
    """

    chosen: tuple[int, ...]
    weight: Array | None = None

    def value(self, covariance: Array) -> float:
        """The criterion; infinite for no covariance."""
        if not np.all(np.isfinite(covariance)):
            return float("inf")
        if self.weight is not None:
            return float(np.sum(self.weight * covariance))
        sign, logarithm = np.linalg.slogdet(covariance[np.ix_(self.chosen, self.chosen)])
        return float(logarithm) if sign > 0 else float("inf")

    def with_one_more(self, covariance: Array, rows: Array) -> Array:
        """The criterion after one more measurement, for each of the rows (m, k); shape (m,)."""
        moved = rows @ covariance
        spread = 1 + np.einsum("ij,ij->i", moved, rows)
        if self.weight is not None:
            gain = np.einsum("ij,jk,ik->i", moved, self.weight, moved) / spread
            return np.asarray(self.value(covariance) - gain)
        block = covariance[np.ix_(self.chosen, self.chosen)]
        part = moved[:, self.chosen]
        gain = np.einsum("ij,ij->i", part, np.linalg.solve(block, part.T).T) / spread
        return np.asarray(self.value(covariance) + np.log1p(-np.minimum(gain, 1 - 1e-15)))

    def slope(self, covariance: Array) -> Array:
        """G (k, k): the criterion falls by f^T G f for a small amount of the measurement f."""
        if self.weight is not None:
            return np.asarray(covariance @ self.weight @ covariance)
        columns = covariance[:, self.chosen]
        return np.asarray(columns @ np.linalg.solve(columns[list(self.chosen)], columns.T))

    def efficiency(self, value: float, least: float) -> float:
        """How good a design is against one of value ``least``: variances' ratio, 1 for the best."""
        if self.weight is not None:
            return float(np.clip(least / value, 0.0, 1.0))
        return float(np.clip(np.exp((least - value) / len(self.chosen)), 0.0, 1.0))

    def scaled(self, sizes: Array) -> Criterion:
        """The same for parameters multiplied by ``sizes``."""
        weight = None if self.weight is None else self.weight / np.outer(sizes, sizes)
        return replace(self, weight=weight)


@dataclass(frozen=True, eq=False)
class Selection:
    """n chosen rows. efficiency : at least this, against the best design of the same candidates."""

    indices: NDArray[np.intp]
    value: float
    efficiency: float


def exchange(
    rows: Array,
    n: int,
    criterion: Criterion,
    information: Array,
    *,
    repeats: int,
    seed: int = 0,
    executor: Place = None,
) -> Selection:
    """The n of the candidates' ``rows`` (m, k) that make the criterion smallest, given M0. Every
    point is exchanged against the best of all candidates until no exchange helps (modified Fedorov
    algorithm: R. Cook, C. Nachtsheim, Technometrics 22 (1980) 315-324), from several starts.
    repeats : how often one candidate may be chosen. Raises InputError for too few candidates, or
    where no n of them determine the parameters.
    """
    if len(rows) * repeats < n:
        raise InputError(
            f"n = {n} points from {len(rows)} candidates, each at most {repeats} times: there are "
            "too few; widen the ranges or allow more repeats"
        )
    sizes = np.sqrt(np.diag(information) + np.mean(rows**2, axis=0))
    if np.any(sizes == 0):
        raise InputError(
            f"no candidate depends on parameter {int(np.argmin(sizes)) + 1}: hold it, or widen the "
            "ranges"
        )
    rows, known = rows / sizes, information / np.outer(sizes, sizes)
    scaled = criterion.scaled(sizes)
    base = known + RIDGE * np.eye(len(known))
    random = np.random.default_rng(seed)
    stock = np.repeat(np.arange(len(rows)), min(repeats, n))
    starts = [_built_up(rows, n, scaled, base, repeats)]
    starts += [random.choice(stock, n, replace=False) for _ in range(STARTS - 1)]
    work = partial(_exchanged, rows, scaled, base, repeats)
    found = results_of(work, starts, executor=executor, chunk=1, what="designs")
    value, indices = min(found, key=lambda pair: pair[0])
    covariance = _inverse(known + rows[indices].T @ rows[indices])
    if covariance is None:
        raise InputError(
            f"{n} points do not determine {rows.shape[1]} parameters with what is known so far: "
            "ask for more points, or hold parameters"
        )
    value = scaled.value(covariance)
    gains = np.einsum("ij,jk,ik->i", rows, scaled.slope(covariance), rows)
    best = float(np.sum(np.sort(np.repeat(gains, min(repeats, n)))[-n:]))
    least = value - max(best - float(np.sum(gains[indices])), 0.0)
    # back to the parameters' own units
    own = 0.0 if criterion.weight is not None else np.sum(np.log(sizes[list(criterion.chosen)]))
    return Selection(np.sort(indices), value - 2 * float(own), scaled.efficiency(value, least))


def _inverse(information: Array) -> Array | None:
    """Covariance, or None where the information is lacking in some direction."""
    values, vectors = np.linalg.eigh(information)
    if values[0] <= 1e-13 * values[-1]:
        return None
    return np.asarray(vectors / values @ vectors.T)


def _one_more(
    rows: Array, criterion: Criterion, base: Array, repeats: int, chosen: NDArray[np.intp]
) -> Array:
    """The criterion with each row beside the chosen ones; infinite where there are enough."""
    covariance = np.linalg.inv(base + rows[chosen].T @ rows[chosen])
    values = criterion.with_one_more(covariance, rows)
    values[np.bincount(chosen, minlength=len(rows)) >= repeats] = np.inf
    return values


def _built_up(
    rows: Array, n: int, criterion: Criterion, base: Array, repeats: int
) -> NDArray[np.intp]:
    chosen = np.empty(0, dtype=np.intp)
    for _ in range(n):
        chosen = np.append(chosen, np.argmin(_one_more(rows, criterion, base, repeats, chosen)))
    return chosen


def _exchanged(
    rows: Array, criterion: Criterion, base: Array, repeats: int, begun: NDArray[np.intp]
) -> tuple[float, NDArray[np.intp]]:
    chosen = begun.copy()
    value = criterion.value(np.linalg.inv(base + rows[chosen].T @ rows[chosen]))
    while True:
        before = value
        for place in range(chosen.size):
            values = _one_more(rows, criterion, base, repeats, np.delete(chosen, place))
            best = int(np.argmin(values))
            if values[best] < value - BETTER * abs(value):
                chosen[place], value = best, float(values[best])
        if not value < before - BETTER * abs(before):
            return value, chosen


def refine(
    points: Array,
    steps: Array,
    gradient: Callable[[Array], Array],
    criterion: Criterion,
    information: Array,
    halvings: int = 7,
) -> Array:
    """Points (n, d) moved off the grid of candidates, to where the criterion is smallest: each in
    turn to the best of a grid of 5^d around it, whose width begins with ``steps`` (d,) and is
    halved when no point moves. ``gradient`` gives rows at points, NaN where nobody may measure.
    """
    points, width = points.copy(), steps.astype(float)
    sizes = np.sqrt(np.diag(information) + np.sum(gradient(points) ** 2, axis=0))
    rows, known = gradient(points) / sizes, information / np.outer(sizes, sizes)
    scaled = criterion.scaled(sizes)
    around = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5)] * points.shape[1]), -1)
    around = around.reshape(-1, points.shape[1])
    for _ in range(halvings):
        for _ in range(20):
            moved = False
            for place in range(len(points)):
                others = np.delete(rows, place, axis=0)
                covariance = np.linalg.inv(known + RIDGE * np.eye(len(known)) + others.T @ others)
                near = points[place] + around * width
                found = gradient(near) / sizes
                good = np.all(np.isfinite(found), axis=1)
                values = np.full(len(near), np.inf)
                values[good] = scaled.with_one_more(covariance, found[good])
                best, here = int(np.argmin(values)), float(values[len(near) // 2])
                if values[best] < here - BETTER * abs(here):
                    points[place], rows[place], moved = near[best], found[best], True
            if not moved:
                break
        width /= 2
    return points

"""Which cells to measure next: pressures and lengths that shrink the intervals of a force law most.

The sensitivities are those at the present estimate (a locally optimal design): with coefficients
that are poorly known, design again after every few measurements.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

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
from .optimal import Criterion, chosen, exchange, refine

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
        length = self.cells.rest_length
        head = "pressure_Pa,contraction,expected_force_N" + (",length_m" if length else "")
        rows = zip(self.cells.pressure, self.cells.contraction, self.cells.force, strict=True)
        with atomic_path(path) as temporary:
            text = [head]
            for p, kappa, force in rows:
                end = f",{length * (1 - kappa):.6g}" if length else ""
                text.append(f"{p:.6g},{kappa:.6g},{force:.4g}{end}")
            temporary.write_text("\n".join(text) + "\n", encoding="utf-8")
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
        size = known.sigma if noise is None else require_positive("noise", noise, "N")
        linear = known.linearisation
        scale = max(float(known.linearisation.scale), 1e-9) if noise is None else size
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

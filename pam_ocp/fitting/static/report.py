"""What a static fit says in words: its report, in the habit of lmfit, what to know before its
coefficients are trusted, and what repeats and branches of its table tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import floor as whole

import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_instance, with_kinds
from ...core.shown import shown
from ...core.units import significant
from ..estimates import at_edge, correlation_lines, following
from ..statistics import Array, f_test, spanned
from ..tables.force_table import ForceTable, require_table
from .correlation import FEWEST
from .optimum import Optimum

MOST_SHOWN = 3
"""Combinations that are spelled out."""
SURE = 3.0
"""Standard errors from which a difference is stated as a fact."""


def force_report(fit: Optimum, level: float, opened: Mapping[str, str]) -> str:
    """See :meth:`ForceFit.report`; opened : why an interval has an infinite end."""
    data, solver, w = fit.table, fit.solver, fit.weights
    worst = int(np.argmax(np.abs(fit.residuals)))
    place = f"{fit.cells.pressure[worst] / 1e5:.3g} bar, {100 * fit.cells.contraction[worst]:.3g} %"
    length = "" if data.rest_length is None else f", rest length {data.rest_length:g} m"
    lines = [
        "[[Law]]",
        f"    {fit.law.title}: {fit.law.reference}",
        "[[Data]]",
        f"    {data.source or 'table'}: {fit.n} taut cells of {len(data)}, "
        f"{fit.cells.levels().max() + 1} contraction levels{length}",
        "[[Fit]]",
        f"    RMSE {fit.rmse:.4g} N, R2 {fit.r2:.6f}, s {fit.sigma:.4g} N with "
        f"{fit.dof} degrees of freedom",
        f"    largest residual {fit.residuals[worst]:+.3g} N at {place}",
        f"    condition {fit.condition:.3g}, rank {fit.rank} of {len(fit.free)}",
        *([] if w is None else [f"    cells are weighted, from {w.min():.3g} to {w.max():.3g}"]),
        "    errors taken as independent"
        if fit.serial is None
        else f"    errors are serially correlated {fit.serial.order} with probability "
        f"{100 * fit.serial.probability:.3g} %, which intervals and bands count",
        f"    {solver.status}, {solver.iterations} iterations after a scan of "
        f"{solver.scanned} points, {1e3 * solver.seconds:.0f} ms",
        *fit._coefficient_lines(
            f"[[Coefficients]] ± standard error (relative), {100 * level:g} % interval"
            f"{' (profile likelihood)' if fit.has_profile else ''}",
            level,
            opened,
        ),
        *_published_lines(fit),
        *correlation_lines(fit.linearisation),
        *_branch_lines(fit),
        *fit._warning_lines(),
    ]
    return "\n".join(lines)


def _published_lines(fit: Optimum) -> list[str]:
    """The same as laboratories print it, for laws that know their published units."""
    published = getattr(fit.law, "published", None)
    if published is None:
        return []
    values: Mapping[str, float] = published()
    texts = [
        f"{n} {significant(v)} ± "
        f"{significant(fit.coefficients[n].stderr * abs(v / fit.law.values[n]), 2)}"
        for n, v in values.items()
        if fit.law.values[n]
    ]
    return ["    with p in bar, kappa in %: " + ", ".join(texts)]


def _branch_lines(fit: Optimum) -> list[str]:
    """Residuals by branch, and the test by repeats, for a report; nothing without labels."""
    lines = []
    cells, residuals = fit.cells, fit.residuals
    if len(cells.branches) > 1:
        lines.append("[[Branches]] mean residual (measured - fitted), RMSE")
        for name in cells.branches:
            own = residuals[[b == name for b in cells.branch]]
            lines.append(
                f"    {name or '(no label)'}: {own.size} cells, {own.mean():+.3g} N, "
                f"{np.sqrt(np.mean(own**2)):.3g} N"
            )
    try:
        return [*lines, "[[Repeats]]", f"    {lack_of_fit(fit)}"]
    except InputError:  # no repeats, no section
        return lines


# ---- doubts --------------------------------------------------------------------------------------
def force_warnings(fit: Optimum) -> tuple[str, ...]:
    """See :attr:`ForceFit.warnings`."""
    found = [fit.solver.doubt] if fit.solver.doubt else []
    found += [*floor_doubts(fit), *unseen(fit), *_saturated(fit), *following(fit.linearisation)]
    if 0 < fit.dof < FEWEST and not fit.terms.independent:
        found.append(
            f"with {fit.dof} degrees of freedom nothing tells whether errors are correlated: "
            "intervals hold for independent ones only"
        )
    if fit.dof == 0:
        found.append("as many coefficients as taut cells: no error can be estimated")
    return (*found, *at_edge(fit.solver.at_bound, fit.law.values))


def floor_doubts(fit: Optimum) -> list[str]:
    """What slack cells read, whether taut ones carry it, too, and where the law contradicts."""
    floor, found = fit.table.floor_found, []
    if floor is not None and floor.matters:
        found.append(f"{floor}{_carried(fit, floor.value) if floor.shifted else ''}")
    far = SURE * fit.usual * fit.sigma if fit.dof else float("inf")
    tension = fit.cells.force - fit.residuals
    pushed = tension < -far
    if pushed.any():
        found.append(
            f"the law pushes at {int(pushed.sum())} taut cells (with up to {-tension.min():.3g} "
            "N), as no muscle can: these may be slack (read_table(..., floor='5 N'), or "
            "table.with_floor(5.0), says up to which reading cells are), or the law does not fit"
        )
    limp = fit.table.subset(fit.table.slack & (fit.table.force > 0))
    if floor is not None and len(limp):
        pulled = np.asarray(fit.law.tension(limp.pressure, limp.contraction)) - floor.limit
        if np.any(pulled > far):
            found.append(
                f"the law pulls at {int(np.sum(pulled > far))} cells that count as slack (with up "
                f"to {pulled.max() + floor.limit:.3g} N): if they are taut, give floor=None, or "
                "table.with_floor(None)"
            )
    return found


def _carried(fit: Optimum, floor: float) -> str:
    """Whether a constant force beside the law, in taut cells, is the floor (Wald test)."""
    w, rest = fit.root_weights, fit._influential
    basis = spanned(w[:, None] * fit.jacobian)
    alone = w - basis @ (basis.T @ w)
    size = float(np.linalg.norm(alone))
    remedy = "floor='zero' (of read_table, or table.with_floor('zero')) takes it off"
    unknown = (
        f"; whether it is the zero of the load cell, which taut cells then carry, too, they do not "
        f"tell: if so, {remedy}"
    )
    serial = fit.linearisation.serial
    error = fit.sigma * (serial.spread if serial else 1.0) / max(size, 1e-300)
    if not fit.dof or size <= 1e-6 * np.linalg.norm(w) or not error > 0:
        return unknown
    zero = float(alone @ rest) / size**2
    seen, same = abs(zero) > SURE * error, abs(zero - floor) <= SURE * error
    size_said = f"({zero:.3g} ± {error:.2g} N)"
    if same:
        return f"; taut cells carry it, too {size_said}: {remedy}" if seen else unknown
    return unknown if seen else f"; taut cells do not carry it {size_said}"


def unseen(fit: Optimum) -> list[str]:
    """Combinations of coefficients that the data do not, or hardly, see."""
    found = [
        f"the data {'do not' if lost else 'hardly'} see this combination: changing {words} "
        "together moves the force of no taut cell by more than "
        f"{np.max(np.abs(fit.jacobian @ move)):.2g} N"
        f"{'' if lost or not fit.dof else ' (one standard error)'}"
        for lost, move, words in fit.linearisation.hardly_seen()
    ]
    if len(found) > MOST_SHOWN:
        more = len(found) - MOST_SHOWN
        found[MOST_SHOWN:] = [
            f"{more} more combinations of the {len(fit.free)} coefficients are not seen, or "
            "hardly; take a law with fewer"
        ]
    return found


def _saturated(fit: Optimum) -> list[str]:
    if not type(fit.law).is_affine():
        return []
    # at each contraction the law is a straight line in p: two numbers at most
    level = fit.cells.levels()
    lines = [np.unique(fit.cells.pressure[level == i]).size for i in range(level.max() + 1)]
    told = sum(min(2, count) for count in lines)
    if told - len(fit.free) > 2:
        return []
    return [
        f"{len(lines)} contraction levels: at each the law is a straight line in p, so they tell "
        f"{told} numbers for {len(fit.free)} coefficients, nearly saturated; a small RMSE proves "
        "little, measure at more lengths"
    ]


SAME_PRESSURE = 0.005
"""Cells whose pressures differ by less than this part of the largest count as repeats."""
SAME_CONTRACTION = 0.001


# ---- repeats -------------------------------------------------------------------------------------
@shown
@dataclass(frozen=True)
class LackOfFit:
    """Scatter of repeats against what the law leaves over (F-test).

    pure_error : standard deviation of repeats [N], with ``pure_dof`` degrees of freedom.
    misfit : root of the mean square of the law's distance from the means of repeats [N], with
    ``misfit_dof``. f, probability : that so large a ratio comes from scatter alone.

    Examples
    --------
    >>> found = pam.fit_force(twice).lack_of_fit()
    >>> print(f"{found.pure_error:.2f} N")  # two readings 1 N apart: 1/sqrt(2)
    0.71 N
    """

    pure_error: float
    pure_dof: int
    misfit: float
    misfit_dof: int
    f: float
    probability: float

    def __str__(self) -> str:
        judged = (
            "the law leaves something out that repeats do not explain"
            if self.probability < 0.05
            else "no sign that the law leaves anything out"
        )
        return (
            f"repeats scatter by {self.pure_error:.3g} N ({self.pure_dof} degrees of freedom), "
            f"the law misses their means by {self.misfit:.3g} N ({self.misfit_dof}): F = "
            f"{self.f:.3g}, probability {self.probability:.2g}; {judged}"
        )


@with_kinds
def lack_of_fit(fit: Optimum) -> LackOfFit:
    """Test a fit by least squares against repeats of its cells (weights count).

    Cells of the same pressure (to 0.5 % of the largest), contraction (to 0.001) and branch are
    repeats. (N. Draper, H. Smith, Applied Regression Analysis, 1998, 2.1; approximate for a law
    that is not linear in its coefficients.)

    Raises InputError where no cell was repeated, no freedom is left, or the loss is a robust one.

    Examples
    --------
    >>> found = pam.fitting.lack_of_fit(pam.fit_force(twice))
    >>> found.probability < 0.01  # what is left over is no noise
    True
    """
    require_instance("fit", fit, Optimum, "give what fit_force() returned")
    if fit.terms.loss != "squares" or fit.terms.priors:
        raise InputError("lack_of_fit needs loss='squares' without priors")
    group = repeats(fit.cells)
    count = int(group.max()) + 1
    pure_dof, misfit_dof = fit.n - count, count - len(fit.free)
    if pure_dof < 1:
        raise InputError(
            "no cell of the table was measured twice: repeats are what tells pure error"
        )
    if misfit_dof < 1:
        raise InputError(
            f"{count} distinct cells for {len(fit.free)} coefficients: the law goes through the "
            "means of repeats, there is nothing to test"
        )
    w = fit.root_weights**2
    means = np.bincount(group, w * fit.cells.force) / np.bincount(group, w)
    pure = float(np.sum(w * (fit.cells.force - means[group]) ** 2))
    misfit = max(fit.squares - pure, 0.0)
    f, probability = f_test(misfit, misfit_dof, pure, pure_dof)
    return LackOfFit(
        float(np.sqrt(pure / pure_dof)),
        pure_dof,
        float(np.sqrt(misfit / misfit_dof)),
        misfit_dof,
        f,
        probability,
    )


def repeats(table: ForceTable) -> NDArray[np.intp]:
    """Number of the distinct cell that each cell repeats, from 0; shape (n,)."""
    near = SAME_PRESSURE * float(np.max(np.abs(table.pressure), initial=0.0)) or 1.0
    branches = table.branch or ("",) * len(table)
    # the first cell of each number lies in one box of the size of the tolerances, alone
    first: dict[tuple[str, int, int], tuple[int, float, float]] = {}
    numbers = np.zeros(len(table), dtype=np.intp)
    cells = zip(branches, table.pressure.tolist(), table.contraction.tolist(), strict=True)
    for i, (branch, p, kappa) in enumerate(cells):
        row, column = whole(p / near), whole(kappa / SAME_CONTRACTION)
        boxes = ((branch, row + a, column + b) for a in (-1, 0, 1) for b in (-1, 0, 1))
        same = [
            number
            for number, p0, kappa0 in (first[box] for box in boxes if box in first)
            if abs(p - p0) <= near and abs(kappa - kappa0) <= SAME_CONTRACTION
        ]
        if not same:
            first[branch, row, column] = (len(first), p, kappa)
        numbers[i] = min(same, default=len(first) - 1)
    return numbers


# ---- branches ------------------------------------------------------------------------------------
@shown
@dataclass(frozen=True, eq=False)
class Hysteresis:
    """Force on deflation less that on inflation, at the same pressure and contraction.

    pressure, contraction, width : (m,), at the cells of inflation within deflation's pressures
    [Pa, 1, N]. largest_force : of the table [N].

    Examples
    --------
    >>> print(f"{pam.fitting.hysteresis(both).largest:.2f} N")
    1.00 N
    """

    pressure: Array = field(repr=False)
    contraction: Array = field(repr=False)
    width: Array = field(repr=False)
    largest_force: float

    @property
    def mean(self) -> float:
        """Mean width [N]."""
        return float(np.mean(self.width))

    @property
    def largest(self) -> float:
        """Largest width, by size [N]."""
        return float(self.width[np.argmax(np.abs(self.width))])

    @property
    def stderr(self) -> float:
        """Standard error of the mean width, from the scatter of the widths [N]."""
        n = self.width.size
        return float(np.std(self.width, ddof=1) / np.sqrt(n)) if n > 1 else float("nan")

    def by_level(self) -> dict[float, float]:
        """Mean width [N] at each contraction level."""
        table = ForceTable(self.pressure, self.contraction, np.ones(self.width.size))
        level = table.levels()
        return {
            float(self.contraction[level == i].mean()): float(self.width[level == i].mean())
            for i in range(level.max() + 1)
        }

    def __str__(self) -> str:
        lines = [
            f"hysteresis: deflation less inflation {self.mean:.3g} ± {self.stderr:.2g} N in the "
            f"mean of {self.width.size} cells ({100 * self.mean / self.largest_force:.2g} % of "
            f"the largest force), at most {self.largest:.3g} N"
        ]
        lines += [f"  at {100 * k:5.2f} %: {w:8.3g} N" for k, w in self.by_level().items()]
        return "\n".join(lines)


@with_kinds
def hysteresis(table: ForceTable) -> Hysteresis:
    """Width between the branches "inflation" and "deflation" of a table's taut cells.

    At each contraction level deflation's force is interpolated along pressure (repeats averaged) at
    the pressures of inflation; nothing is extrapolated.

    Raises InputError for a table without both branches, or none of whose levels hold both.

    Examples
    --------
    >>> print(f"{pam.fitting.hysteresis(both).mean:.2f} N")
    1.00 N
    """
    require_table(table)
    for name in ("inflation", "deflation"):
        if name not in table.branches:
            raise InputError(
                f"the table has no cells of {name} (branches: "
                f"{', '.join(table.branches) or 'none'}); label them in a column 'branch', or "
                "give columns={'branch': ...}"
            )
    taut = table.taut
    level = taut.levels()
    up, down = (np.array([b == n for b in taut.branch]) for n in ("inflation", "deflation"))
    pressure, contraction, width = [], [], []
    for i in range(level.max() + 1):
        there = down & (level == i)
        known, place = np.unique(taut.pressure[there], return_inverse=True)
        if known.size < 2:
            continue
        force = np.bincount(place, taut.force[there]) / np.bincount(place)
        for j in np.nonzero(up & (level == i))[0]:
            p = taut.pressure[j]
            if known[0] * (1 - 1e-9) <= p <= known[-1] * (1 + 1e-9):
                pressure.append(p)
                contraction.append(taut.contraction[j])
                width.append(float(np.interp(p, known, force)) - taut.force[j])
    if not width:
        raise InputError(
            "inflation and deflation share no range of pressure at any contraction level; measure "
            "both at the same lengths"
        )
    return Hysteresis(
        np.array(pressure), np.array(contraction), np.array(width), float(taut.force.max())
    )

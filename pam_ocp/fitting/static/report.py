"""What a static fit says in words: its report, in the habit of lmfit, and what to know before its
coefficients are trusted.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...core.units import significant
from ..estimates import at_edge, correlation_lines, following
from ..statistics import spanned
from .branches import branch_lines
from .correlation import FEWEST
from .optimum import Optimum

MOST_SHOWN = 3
"""Combinations that are spelled out."""
SURE = 3.0
"""Standard errors from which a difference is stated as a fact."""


def force_report(fit: Optimum, level: float, opened: Mapping[str, str]) -> str:
    """See :meth:`ForceFit.report`; opened : why an interval has an infinite end."""
    data, solver = fit.table, fit.solver
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
        *_weight_lines(fit),
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
        *branch_lines(fit),
        *fit._warning_lines(),
    ]
    return "\n".join(lines)


def _weight_lines(fit: Optimum) -> list[str]:
    if fit.weights is None:
        return []
    low, high = fit.weights.min(), fit.weights.max()
    return [f"    cells are weighted, from {low:.3g} to {high:.3g}"]


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
    far = SURE * fit.sigma if fit.dof else float("inf")
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

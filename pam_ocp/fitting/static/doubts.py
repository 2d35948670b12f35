"""What to know before the coefficients of a static fit are trusted, in words."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from ..statistics import Linearisation

from .optimum import Optimum

__all__ = ["at_edge", "following", "force_warnings", "unseen"]

MOST_SHOWN = 3
"""Combinations that are spelled out."""


DOUBTFUL = 0.5
"""Probability of a correlation from which it is a warning; below it still counts in the intervals.
"""
LIKELY = 0.95
"""Probability from which a correlation is stated as a fact."""


def force_warnings(fit: Optimum) -> tuple[str, ...]:
    """See :attr:`ForceFit.warnings`."""
    found = [fit.solver.doubt] if fit.solver.doubt else []
    found += [*unseen(fit), *_saturated(fit), *following(fit.linearisation)]
    if fit.dof == 0:
        found.append("as many coefficients as taut cells: no error can be estimated")
    return (*found, *at_edge(fit.solver.at_bound, fit.law.values))


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


def at_edge(names: Iterable[str], values: Mapping[str, float]) -> list[str]:
    """Coefficients (by name) that ended at the edge of their range."""
    return [
        f"{name} = {values[name]:g} ended at the edge of its range: its interval means "
        "nothing; hold it with fixed=... or take another law"
        for name in names
    ]


def following(linear: Linearisation) -> list[str]:
    """That errors follow each other, and what that does to intervals."""
    serial = linear.serial
    if serial is None or serial.probability < DOUBTFUL:
        return []
    plain, wide = linear.independent.stderr(), linear.stderr()
    seen = np.isfinite(plain) & (plain > 0)
    reach = linear.reach(0.95) / linear.independent.reach(0.95)
    factor = reach * float(np.median(wide[seen] / plain[seen])) if seen.any() else reach
    return [
        f"errors {'' if serial.probability > LIKELY else 'may '}follow each other {serial.order} "
        f"(probability {100 * serial.probability:.3g} %, correlation of neighbours about "
        f"{serial.correlation:.2g}): intervals and bands are widened for it, by a factor of about "
        f"{factor:.2g}"
    ]


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

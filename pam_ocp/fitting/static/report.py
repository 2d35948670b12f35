"""Fits as text, in the habit of lmfit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ..statistics import Coefficient, Linearisation
from .branches import branch_lines
from .force_fit import ForceFit

__all__ = ["coefficient_line", "correlation_lines", "force_report"]


def force_report(fit: ForceFit, level: float) -> str:
    """See :meth:`ForceFit.report`."""
    data, solver = fit.table, fit.solver
    intervals, opened = fit.intervals(level), fit.open_ends(level)
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
        else f"    errors follow each other {fit.serial.order} with probability "
        f"{100 * fit.serial.probability:.3g} %, which intervals and bands count",
        f"    {solver.status}, {solver.iterations} iterations after a scan of "
        f"{solver.scanned} points, {1e3 * solver.seconds:.0f} ms",
        f"[[Coefficients]] ± standard error (relative), {100 * level:g} % interval"
        f"{' (profile likelihood)' if fit.has_profile else ''}; SI",
        *(
            coefficient_line(c, intervals.get(c.name, (c.value,) * 2), opened.get(c.name, ""))
            for c in fit.coefficients.values()
        ),
        *_published_lines(fit),
        *correlation_lines(fit.linearisation),
        *branch_lines(fit),
    ]
    if fit.warnings:
        lines += ["[[Warnings]]", *(f"    {text}" for text in fit.warnings)]
    return "\n".join(lines)


def _weight_lines(fit: ForceFit) -> list[str]:
    if fit.weights is None:
        return []
    low, high = fit.weights.min(), fit.weights.max()
    return [f"    cells are weighted, from {low:.3g} to {high:.3g}"]


def coefficient_line(c: Coefficient, interval: tuple[float, float], reason: str = "") -> str:
    """``a3: -56.66 ± 4.5 (8 %), -65.8 .. -47.6``; ``reason`` why an end is open."""
    unit = "" if c.unit == "1" else f" {c.unit}"
    if c.held:
        return f"    {c.name}: {c.value:.6g}{unit} (held)"
    low, high = interval
    relative = f"{100 * c.stderr / abs(c.value):.2g} %" if c.value else "-"
    return (
        f"    {c.name}: {c.value:.6g} ± {c.stderr:.2g}{unit} ({relative}), {low:.5g} .. {high:.5g}"
        + (f" (open: {reason})" if reason else "")
    )


def correlation_lines(linearisation: Linearisation) -> list[str]:
    """Correlations beyond 0.5 under a heading; nothing when there are none."""
    pairs = linearisation.correlated()
    lines = [f"    C({a}, {b}) = {r:+.4f}" for r, a, b in pairs]
    return ["[[Correlations]] (beyond 0.5)", *lines] if lines else []


def _published_lines(fit: ForceFit) -> list[str]:
    """The same as laboratories print it, for laws that know their published units."""
    published = getattr(fit.law, "published", None)
    if published is None:
        return []
    values: Mapping[str, float] = published()
    texts = [
        f"{n} {v:.6g} ± {fit.coefficients[n].stderr * abs(v / fit.law.values[n]):.2g}"
        for n, v in values.items()
        if fit.law.values[n]
    ]
    return ["    with p in bar, kappa in %: " + ", ".join(texts)]

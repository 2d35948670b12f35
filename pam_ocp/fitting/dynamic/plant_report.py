"""Fits of plants as text, in the habit of lmfit."""

from __future__ import annotations

from ..estimates import coefficient_line
from .plant_fit import PlantFit

__all__ = ["plant_report"]


def plant_report(fit: PlantFit, level: float) -> str:
    """See :meth:`PlantFit.report`."""
    linear = fit.linearisation
    samples = sum(len(r) for r in fit.residuals)
    known = set(fit.coefficients)
    pairs = [(r, a, b) for r, a, b in linear.correlated(0.8) if a in known and b in known]
    lines = [
        "[[Plant]]",
        f"    {fit.plant.name}: {fit.plant.description}",
        "[[Records]]",
        f"    {len(fit.records)} with {samples} samples of {', '.join(fit.measured)}",
        *([f"    {fit.inputs_ran}"] if fit.inputs_ran else []),
        "[[Fit]]" + (" of the smoothed motion" if fit.process_noise else ""),
        *(
            f"    {n}: RMSE {fit.plant.variable(n).shown(e)}, fit {fit.fit_percent[n]:.2f} %"
            for n, e in fit.rmse.items()
        ),
        f"    condition {linear.condition:.3g}, rank {fit.rank} of {len(linear.names)} unknowns "
        f"(initial states included), {linear.dof} degrees of freedom",
        f"    {fit.method}: {fit.status}, {fit.iterations} iterations, {fit.seconds:.2f} s",
        *(
            f"    process noise of {n}: {size:.4g} {fit.plant.variable(n).unit}/sqrt(s)"
            for n, size in fit.process_noise.items()
        ),
        *(
            f"    measured {n} with noise of {fit.plant.variable(n).shown(size)}: its errors are "
            "estimated, too"
            for n, size in fit.input_noise.items()
        ),
    ]
    if fit.warnings:
        lines += ["[[Warnings]]", *(f"    {text}" for text in fit.warnings)]
    lines.append(f"[[Parameters]] ± standard error (relative), {100 * level:g} % interval; SI")
    lines += [coefficient_line(c, fit.interval(c.name, level)) for c in fit.coefficients.values()]
    if pairs:
        lines.append("[[Correlations]] (beyond 0.8)")
        lines += [f"    C({a}, {b}) = {r:+.4f}" for r, a, b in pairs]
    return "\n".join(lines)

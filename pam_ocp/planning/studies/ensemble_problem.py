"""What is asked of a plant's motion, asked of an ensemble of such plants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from ...core.errors import InputError
from ...judge.statement import Avoid, Constraint, Phase, Stop
from ...plants.ensemble import Ensemble

__all__ = ["ensemble_arguments", "ensemble_stop"]


def ensemble_arguments(ensemble: Ensemble, given: Mapping[str, Any], kept: bool) -> dict[str, Any]:
    """Arguments of plan for the nominal plant (all but stops), said of the ensemble.

    kept : the copies keep bounds and constraints too, not the nominal plant only.
    """
    found = dict(given)
    for name in ("integrand", "final"):
        if found.get(name) is not None:
            found[name] = ensemble.expression_in(0, found[name])
    designed = set(found.get("design") or {}) & set(ensemble.draws[0])
    if designed:
        raise InputError(f"design: {', '.join(sorted(designed))} is drawn, it cannot be chosen")
    if found.get("bounds"):
        found["bounds"] = _bounds(ensemble, found["bounds"], kept)
    if found.get("constraints"):
        found["constraints"] = _constraints(ensemble, found["constraints"], kept)
    if found.get("phases"):
        found["phases"] = [
            phase
            if phase is None
            else Phase(
                phase.duration,
                _bounds(ensemble, phase.bounds, kept),
                _constraints(ensemble, phase.constraints, kept),
            )
            for phase in found["phases"]
        ]
    return found


def _bounds(ensemble: Ensemble, bounds: Mapping[str, Any], kept: bool) -> dict[str, Any]:
    copies = {m: b for n, b in bounds.items() for m in ensemble.images(n)} if kept else {}
    return {**bounds, **copies}


def _constraints(
    ensemble: Ensemble, constraints: Sequence[Constraint | Avoid], kept: bool
) -> list[Constraint | Avoid]:
    found: list[Constraint | Avoid] = []
    for given in constraints:
        for k in range(len(ensemble.draws) + 1 if kept else 1):
            of = f" in draw {k}" if k else ""
            if isinstance(given, Constraint):
                expression = ensemble.expression_in(k, given.expression)
                found.append(replace(given, expression=expression, name=given.name + of))
            elif k == 0:
                found.append(given)
            else:
                region = {
                    (ensemble.images(n) or [n] * k)[k - 1] if n != "time" else n: value
                    for n, value in given.region.items()
                }
                found.append(Avoid(region, given.name + of))
    return found


def ensemble_stop(
    ensemble: Ensemble, stop: Mapping[str, Any] | Stop, spread: Mapping[str, float]
) -> Stop:
    """A stop, with the copies' watched variables within their spread there."""
    stop = stop if isinstance(stop, Stop) else Stop(stop)
    within = {
        f"{n}.deviation{k}": (-width, width)
        for n, width in spread.items()
        if n in ensemble.own
        for k in range(1, len(ensemble.draws) + 1)
    }
    return replace(stop, values={**stop.values, **within})

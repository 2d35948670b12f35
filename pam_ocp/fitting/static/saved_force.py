"""Static fits in files of JSON."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import InputError, UnknownNameError
from ...core.files import read_json, reading, write_json
from ...muscles.law import ForceLaw
from ...muscles.laws.user_defined import law_named
from ..statistics import SolverStatistics
from ..tables.floor import Floor
from ..tables.force_table import ForceTable
from .force_fit import ForceFit
from .least_squares import Terms

__all__ = ["read_fit", "write_fit"]

FORMAT = "pam_ocp force fit"


def write_fit(fit: ForceFit, path: str | os.PathLike[str]) -> Path:
    """See :meth:`ForceFit.to_json`."""
    table = {n: getattr(fit.table, n).tolist() for n in ("pressure", "contraction", "force")}
    table |= {n: list(getattr(fit.table, n)) for n in ("branch", "run") if getattr(fit.table, n)}
    floor = fit.table.floor_found
    table["censored"] = fit.table.slack.tolist()
    content = {
        "format": FORMAT,
        "version": 1,
        "units": "SI: Pa gauge, N, m, contraction as a fraction",
        "law": fit.law.name,
        "coefficients": {n: float(v) for n, v in fit.law.values.items()},
        "held": list(fit.held),
        "stderr": {n: c.stderr for n, c in fit.coefficients.items() if np.isfinite(c.stderr)},
        "intervals": {n: [_finite(e) for e in pair] for n, pair in fit.intervals().items()},
        "open": fit.open_ends(),
        "correlation": None
        if fit.serial is None
        else {"along": fit.serial.order, "neighbours": fit.serial.correlation},
        "rmse": fit.rmse,
        "r2": fit.r2 if np.isfinite(fit.r2) else None,
        "warnings": list(fit.warnings),
        "solver": asdict(fit.solver),
        "terms": _written(fit.terms),
        "weights": None if fit.weights is None else fit.weights.tolist(),
        "rest_length": fit.table.rest_length,
        "source": fit.table.source,
        "table": table,
        "floor": None if floor is None else asdict(floor),
    }
    return write_json(path, content)


def read_fit(path: str | os.PathLike[str], law: type[ForceLaw] | None = None) -> ForceFit:
    """See :meth:`ForceFit.from_json`."""
    content = read_json(path, "a fit", FORMAT, "to_json() writes one")
    with reading(path, "a fit", "give one that to_json() wrote"):
        kind = law or _law_named(content["law"])
        solver = SolverStatistics(**content["solver"])
        table, floor = dict(content["table"]), content.get("floor")
        if "censored" in table:
            table["censored"] = np.array(table["censored"], dtype=bool)
        return ForceFit(
            law=kind(**content["coefficients"]),
            table=ForceTable(
                **table,
                floor=Floor(**floor) if floor else None,
                rest_length=content["rest_length"],
                source=content["source"],
            ),
            held=tuple(content["held"]),
            weights=None if content["weights"] is None else np.array(content["weights"]),
            solver=replace(solver, at_bound=tuple(solver.at_bound)),
            terms=_read(content.get("terms", {})),
        )


def _law_named(name: Any) -> type[ForceLaw]:
    try:
        return law_named(str(name))
    except UnknownNameError as error:
        raise InputError(f"{error} Give the class of an own law: law=...") from None


def _finite(value: float) -> float | None:
    """JSON has no infinity: null for an open end."""
    return float(value) if np.isfinite(value) else None


def _written(terms: Terms) -> dict[str, Any]:
    """As JSON, which has no infinity: null in its place."""
    content = asdict(terms)
    content["threshold"] = terms.threshold if np.isfinite(terms.threshold) else None
    content["bounds"] = [
        (n, *(value if np.isfinite(value) else None for value in ends)) for n, *ends in terms.bounds
    ]
    return content


def _read(content: dict[str, Any]) -> Terms:
    if not content:
        return Terms()
    threshold = content["threshold"]
    bounds = tuple(
        (n, -np.inf if low is None else low, np.inf if high is None else high)
        for n, low, high in content["bounds"]
    )
    return Terms(
        content["loss"],
        np.inf if threshold is None else threshold,
        content["censored"],
        bounds,
        tuple((n, mean, deviation) for n, mean, deviation in content["priors"]),
        content["noise"],
        content.get("independent", False),
    )

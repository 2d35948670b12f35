"""Do static fits hold on other people's tables? Random synthetic tables, all laws, intervals and
bands.

    python benchmarks/fit_study.py 500 --seed 7 --out study.json

Each table is sampled from a law of the library: a fit to one of the bundled maps, its coefficients
moved by up to 10 %. Random too: 3 to 6 contraction levels (the first not always at rest), 5 to 14
pressures, ramps up or up and down, in order of levels or of pressures, labelled or not, repeats,
noise of 3 to 5 N for a muscle of 1500 N (in proportion for a smaller one) that follows itself along
a ramp with a correlation of 0 to 0.9, slack cells at zero force, cells that are missing, units of
the columns.

Counted: exceptions; how often the 95 % interval of a coefficient holds its true value, and how
often the 95 % band of the mean force holds the true force, at 60 places of the table's range (both
from the law that the table was sampled from). Coefficients and places that the data do not see
(their error is infinite, and the fit says so) are counted apart. Also written: for each law alone.
"""

from __future__ import annotations

import argparse
import json
import time
import traceback
import warnings
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import pam_ocp as pam

RIG = {"radius": 0.010, "rest_diameter": 0.020, "max_contraction_ratio": 0.25}
MAPS = (("DMSP-20-300_static.csv", 0.300, 1.0), ("DMSP-10-250_static.csv", 0.250, 0.5))
FREE_FORMS = ("polynomial-1-3", "polynomial-2-2", "spline-2:0,0.12,0.25")
PLACES = 60
LEVEL = 0.95
MOVED = 0.1
"""Part by which coefficients of the truth are moved."""


@dataclass(frozen=True)
class Case:
    """A table with the law that it was sampled from; ``columns`` as a user's file has them."""

    law: Any
    name: str
    fixed: Mapping[str, float]
    columns: Mapping[str, Any]
    rest_length: float
    levels: int
    correlation: float
    noise: float

    def table(self) -> pam.fitting.ForceTable:
        return pam.read_table(dict(self.columns), rest_length=self.rest_length)


_TRUTHS: dict[tuple[str, str], tuple[Any, dict[str, float]]] = {}


def law_names() -> list[str]:
    from pam_ocp.muscles.law import LAWS

    return [*LAWS, *FREE_FORMS]


def truth(name: str, source: str, length: float, scale: float) -> tuple[Any, dict[str, float]]:
    """A law as fitted to a bundled map, and its known constants."""
    if (name, source) not in _TRUTHS:
        from pam_ocp.fitting.static.static import law_class

        known = {"radius": 0.010, "rest_diameter": 0.020, "max_contraction_ratio": 0.25}
        constants = law_class(name).fixed_coefficients()
        fixed = {
            n: v * (scale if "ratio" not in n else 1) for n, v in known.items() if n in constants
        }
        table = pam.read_table(source, rest_length=length)
        _TRUTHS[name, source] = pam.fit_force(table, name, fixed=fixed).law, fixed
    return _TRUTHS[name, source]


def sample(random: np.random.Generator, name: str | None = None) -> Case:
    """One random table."""
    name = name or str(random.choice(law_names()))
    source, length, scale = MAPS[int(random.integers(2))]
    while True:
        base, fixed = truth(name, source, length, scale)
        moved = {
            n: v
            if n in type(base).fixed_coefficients()
            else v * random.uniform(1 - MOVED, 1 + MOVED)
            for n, v in base.values.items()
        }
        law = type(base)(**moved)
        levels = int(random.integers(3, 7))
        kappa = np.linspace(random.choice([0.0, 0.01, 0.03]), random.uniform(0.15, 0.24), levels)
        kappa = kappa + 0.003 * random.standard_normal(levels)
        pressure = np.linspace(random.choice([0.0, 0.5e5, 1e5]), 6e5, int(random.integers(5, 15)))
        columns = ramps(random, law, kappa, pressure, 3e-3 * scale**2)
        if columns is not None and (columns["force"] > 0).sum() >= len(base.values) + 3:
            break
    correlation, noise = columns.pop("correlation"), columns.pop("noise")
    return Case(
        law, name, fixed, in_units(random, columns, length), length, levels, correlation, noise
    )


def ramps(
    random: np.random.Generator, law: Any, kappa: Any, pressure: Any, gain: float
) -> dict[str, Any] | None:
    """Cells in the order of measurement; None where the law hardly pulls."""
    both, times = random.random() < 0.4, 2 if random.random() < 0.25 else 1
    rows: list[tuple[float, float, str, str]] = []
    for run in range(times):
        for k in kappa:
            jitter = 0.01e5 * random.standard_normal((2, pressure.size))
            rows += [(k, max(p, 0.0), "inflation", str(run)) for p in pressure + jitter[0]]
            if both:
                back = (pressure + jitter[1])[::-1]
                rows += [(k, max(p, 0.0), "deflation", str(run)) for p in back]
    k, p = (np.array([row[i] for row in rows]) for i in (0, 1))
    true = np.asarray(law.tension(p, k))
    if not np.all(np.isfinite(true)) or true.max() < 100 or true.max() > 5e3:
        return None
    if np.any(true[p < 0.02e5] > 0.15 * true.max()):  # no muscle pulls without pressure
        return None
    correlation = float(random.choice([0.0, random.uniform(0.0, 0.9)]))
    noise = random.uniform(3, 5) * min(true.max() / 1500, 1.0)
    error = np.empty(k.size)
    for i in range(k.size):  # the ramp begins anew where the level or the run does
        fresh = i == 0 or k[i] != k[i - 1]
        error[i] = random.standard_normal() * (1 if fresh else np.sqrt(1 - correlation**2))
        error[i] += 0.0 if fresh else correlation * error[i - 1]
    force = np.where(true > 0, true + noise * error, 0.0)
    keep = random.random(k.size) > random.choice([0.0, 0.1])
    order = np.arange(k.size)
    if not both and random.random() < 0.3:  # the file is sorted by pressure, not as measured
        order = np.lexsort((k, np.round(p / 1e4)))
    order = order[keep[order]]
    columns: dict[str, Any] = {"pressure": p[order], "contraction": k[order], "force": force[order]}
    if both and random.random() < 0.6:
        columns["branch"] = [rows[i][2] for i in order]
    if times > 1 and random.random() < 0.6:
        columns["run"] = [rows[i][3] for i in order]
    return {**columns, "correlation": correlation, "noise": noise}


def in_units(random: np.random.Generator, columns: dict[str, Any], length: float) -> dict[str, Any]:
    unit, factor = (("Pa", 1.0), ("bar", 1e5), ("kPa", 1e3))[int(random.integers(3))]
    found = {f"pressure [{unit}]": columns["pressure"] / factor, "force [N]": columns["force"]}
    form = int(random.integers(3))
    if form == 0:
        found["contraction [1]"] = columns["contraction"]
    elif form == 1:
        found["contraction [%]"] = 100 * columns["contraction"]
    else:
        found["length [mm]"] = 1e3 * length * (1 - columns["contraction"])
    return found | {n: columns[n] for n in ("branch", "run") if n in columns}


def true_values(case: Case, fit: Any) -> dict[str, float]:
    """The truth, named as the fit does."""
    values = dict(case.law.values)
    if (
        "k3" in values
        and (values["k1"] - values["k3"]) * (fit.law.values["k1"] - fit.law.values["k3"]) < 0
    ):
        # of two slopes either may be called the first
        values |= {
            a: values[b]
            for a, b in zip(("k0", "k1", "k2", "k3"), ("k2", "k3", "k0", "k1"), strict=True)
        }
    return values


def judged(case: Case, random: np.random.Generator) -> dict[str, Any]:
    """How often intervals and band hold the truth."""
    table = case.table()
    fit = pam.fit_force(table, case.name, fixed=case.fixed)
    intervals = fit.intervals(LEVEL)
    values = true_values(case, fit)
    seen = {n: bool(np.isfinite(c.stderr)) for n, c in fit.coefficients.items() if not c.held}
    held = [low <= values[n] <= high for n, (low, high) in intervals.items() if seen[n]]
    ends = [bool(np.isfinite(end)) for n, pair in intervals.items() if seen[n] for end in pair]
    p = random.uniform(fit.cells.pressure.min(), fit.cells.pressure.max(), PLACES)
    k = random.uniform(fit.cells.contraction.min(), fit.cells.contraction.max(), PLACES)
    true = np.asarray(case.law.tension(p, k))
    p, k, true = p[true > 0], k[true > 0], true[true > 0]
    band = fit.predict(p, k, LEVEL)
    finite = np.isfinite(band.stderr)
    inside = (band.confidence[0] <= true) & (true <= band.confidence[1])
    fit.report(LEVEL)
    return {
        "law": case.name,
        "levels": case.levels,
        "correlation": case.correlation,
        "cells": fit.n,
        "coefficients": [int(sum(held)), len(held)],
        "open ends": len(ends) - sum(ends),
        "unseen": len(intervals) - len(held),
        "band": [int(inside[finite].sum()), int(finite.sum())],
        "no band": int((~finite).sum()),
        "serial": None if fit.serial is None else fit.serial.correlation,
        "edge": list(fit.solver.at_bound),
        "names": {
            n: bool(low <= values[n] <= high) for n, (low, high) in intervals.items() if seen[n]
        },
        "mean width": float(np.mean(np.diff(band.confidence, axis=0)[0][finite]))
        if finite.any()
        else None,
    }


def study(count: int, seed: int, first: int = 0) -> list[dict[str, Any]]:
    """Every table by its own number, so that a part of a study is a part of it."""
    results = []
    for number in range(first, first + count):
        random = np.random.default_rng([seed, number])
        case = sample(random, law_names()[number % len(law_names())])
        began = time.process_time()
        try:
            found = judged(case, random)
        except Exception as error:
            found = {
                "law": case.name,
                "error": f"{type(error).__name__}: {error}",
                "trace": traceback.format_exc(),
            }
        results.append({"number": number, **found, "seconds": time.process_time() - began})
    return results


def summary(results: list[dict[str, Any]]) -> str:
    good = [r for r in results if "error" not in r]
    lines = [f"{len(results)} tables, {len(results) - len(good)} exceptions"]
    parts: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for r in good:
        parts["all"].append(r)
        parts[f"law {r['law']}"].append(r)
        parts[f"{r['levels']} levels"].append(r)
        parts[
            f"errors {'follow' if r['correlation'] else 'alone'}, "
            f"{'un' if r['serial'] is None else ''}seen"
        ].append(r)
        parts[
            "correlation "
            + ("0" if not r["correlation"] else "< 0.45" if r["correlation"] < 0.45 else "< 0.9")
        ].append(r)
    lines.append(
        f"{'':<34}{'tables':>7}{'coefficients':>14}{'band':>8}{'open':>6}{'unseen':>8}{'edge':>6}{'s':>7}"
    )
    for name, rows in sorted(parts.items()):
        share = [
            100 * sum(r[key][0] for r in rows) / max(sum(r[key][1] for r in rows), 1)
            for key in ("coefficients", "band")
        ]
        lines.append(
            f"{name:<34}{len(rows):>7}{share[0]:>12.1f} %{share[1]:>6.1f} %"
            f"{sum(r['open ends'] for r in rows):>6}{sum(r['unseen'] for r in rows):>8}"
            f"{sum(bool(r['edge']) for r in rows):>6}{np.mean([r['seconds'] for r in rows]):>7.2f}"
        )
    lines += [f"{r['number']} {r['law']}: {r['error']}" for r in results if "error" in r]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("count", type=int, nargs="?", default=500)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--first", type=int, default=0, help="number of the first table")
    parser.add_argument("--out", type=Path, help="write all results as JSON")
    options = parser.parse_args()
    warnings.simplefilter("ignore", pam.muscles.ValidityWarning)
    results = study(options.count, options.seed, options.first)
    if options.out:
        options.out.write_text(json.dumps(results))
    print(summary(results))


if __name__ == "__main__":
    main()

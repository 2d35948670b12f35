"""Do static fits hold on other people's tables? Random synthetic tables, all laws, intervals and
bands.

    python benchmarks/fit_study.py 500 --seed 7 [--table study.jsonl]
    python benchmarks/fit_study.py 140 --seed 7 --floor

Each table is sampled from a law of the library: a fit to one of the bundled maps, its coefficients
moved by up to 10 %. Random too: 3 to 6 contraction levels (the first not always at rest), 5 to 14
pressures, ramps up or up and down, in order of levels or of pressures, labelled or not, repeats,
noise of 3 to 5 N for a muscle of 1500 N (in proportion for a smaller one) that follows itself along
a ramp with a correlation of 0 to 0.9, slack cells at zero force, cells that are missing, units of
the columns.

Counted: exceptions; how often the 95 % interval of a coefficient holds its true value, and how
often the 95 % band of the mean force holds the true force, at 60 places of the table's range (both
from the law that the table was sampled from). Coefficients and places that the data do not see
(their error is infinite, and the fit says so) are counted apart.

--floor: what a load cell shows while the muscle is slack. The slack cells read, in turn: exactly 0;
a floor of 2 to 12 N for a muscle of 1500 N, positive or negative; noise about zero; a floor for
each branch; one that rises with pressure; or they are left out. The floor scatters by 0.05, 0.3 or
1 times the noise of taut cells. Counted for each kind: tables in which a cell counts as taut where
the law is 8 standard deviations below zero (missed), of these those in which no warning names it
(silent); tables in which a cell counts as slack that pulls with more than that (false); RMSE over
taut cells in parts of the noise; how often the 95 % interval of a coefficient holds its true value,
with the floor found and with none sought.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import harness
import numpy as np

import pam_ocp as pam
from pam_ocp.fitting.static.static import law_class
from pam_ocp.muscles.law import LAWS

RIG = {"radius": 0.010, "rest_diameter": 0.020, "max_contraction_ratio": 0.25}
MAPS = (("DMSP-20-300_static.csv", 0.300, 1.0), ("DMSP-10-250_static.csv", 0.250, 0.5))
LAW_NAMES = [*LAWS, "polynomial-1-3", "polynomial-2-2", "spline-2:0,0.12,0.25"]
PLACES = 60
LEVEL = 0.95
MOVED = 0.1
"""Part by which coefficients of the truth are moved."""
FLOORS = ("zero", "plus", "minus", "noise", "branches", "pressure", "no slack cell")


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


@cache
def truth(name: str, source: str, length: float, scale: float) -> tuple[Any, dict[str, float]]:
    """A law as fitted to a bundled map, and its known constants."""
    constants = law_class(name).fixed_coefficients()
    fixed = {n: v * (scale if "ratio" not in n else 1) for n, v in RIG.items() if n in constants}
    table = pam.read_table(source, rest_length=length)
    return pam.fit_force(table, name, fixed=fixed).law, fixed


def sample(random: np.random.Generator, name: str | None = None) -> Case:
    """One random table."""
    name = name or str(random.choice(LAW_NAMES))
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


# ---- intervals and bands -------------------------------------------------------------------------
def held(case: Case, fit: Any) -> dict[str, bool]:
    """Of each coefficient that the data see: whether its interval holds the truth."""
    values = true_values(case, fit)
    seen = {n for n, c in fit.coefficients.items() if np.isfinite(c.stderr)}
    intervals = fit.intervals(LEVEL).items()
    return {n: bool(low <= values[n] <= high) for n, (low, high) in intervals if n in seen}


def judged(case: Case, random: np.random.Generator) -> harness.Row:
    """How often intervals and band hold the truth."""
    fit = pam.fit_force(case.table(), case.name, fixed=case.fixed)
    names, intervals = held(case, fit), fit.intervals(LEVEL)
    ends = [bool(np.isfinite(end)) for n in names for end in intervals[n]]
    p = random.uniform(fit.cells.pressure.min(), fit.cells.pressure.max(), PLACES)
    k = random.uniform(fit.cells.contraction.min(), fit.cells.contraction.max(), PLACES)
    true = np.asarray(case.law.tension(p, k))
    p, k, true = p[true > 0], k[true > 0], true[true > 0]
    band = fit.predict(p, k, LEVEL)
    finite = np.isfinite(band.stderr)
    inside = (band.confidence[0] <= true) & (true <= band.confidence[1])
    fit.report(LEVEL)
    return {
        "text": f"{case.name}, {case.levels} levels, correlation {case.correlation:.2f}",
        "law": case.name,
        "levels": case.levels,
        "correlation": case.correlation,
        "coefficients": [sum(names.values()), len(names)],
        "open": len(ends) - sum(ends),
        "unseen": len(intervals) - len(names),
        "band": [int(inside[finite].sum()), int(finite.sum())],
        "serial": None if fit.serial is None else fit.serial.correlation,
        "edge": bool(fit.solver.at_bound),
    }


def one(number: int, seed: int) -> harness.Row:
    """Every table by its own number, so that a part of a study is a part of it."""
    random = np.random.default_rng([seed, number])
    return judged(sample(random, LAW_NAMES[number % len(LAW_NAMES)]), random)


def groups(row: harness.Row) -> Iterator[str]:
    """The lines of the summary to which a table belongs."""
    yield "all"
    yield f"law {row['law']}"
    yield f"{row['levels']} levels"
    seen = "un" if row["serial"] is None else ""
    yield f"errors {'follow' if row['correlation'] else 'alone'}, {seen}seen"
    size = row["correlation"]
    yield f"correlation {'0' if not size else '< 0.45' if size < 0.45 else '< 0.9'}"


def of_intervals(rows: list[harness.Row]) -> str:
    parts: dict[str, list[harness.Row]] = defaultdict(list)
    for row in rows:
        for name in groups(row):
            parts[name].append(row)
    lines = []
    for name, some in sorted(parts.items()):
        shares = [
            100 * sum(r[key][0] for r in some) / max(sum(r[key][1] for r in some), 1)
            for key in ("coefficients", "band")
        ]
        counts = [sum(r[key] for r in some) for key in ("open", "unseen", "edge")]
        seconds = float(np.mean([r["processor"] for r in some]))
        lines.append([name, len(some), *(f"{s:.1f} %" for s in shares), *counts, seconds])
    heads = ("", "tables", "coefficients", "band", "open", "unseen", "edge", "s")
    return harness.table(heads, lines)


# ---- floors --------------------------------------------------------------------------------------
def with_floor(
    case: Case, kind: str, random: np.random.Generator
) -> tuple[pam.fitting.ForceTable, Any]:
    """The table as the load cell shows it, and the true tension of its cells."""
    table = case.table()
    true = np.asarray(case.law.tension(table.pressure, table.contraction))
    slack, force = true <= 0, table.force.copy()
    size = random.uniform(2, 12) * min(true.max() / 1500, 1)
    scatter = case.noise * random.choice([0.05, 0.3, 1.0])
    second = np.array([b == "deflation" for b in table.branch] or [False] * len(table))
    floor = {
        "plus": size,
        "minus": -size,
        "branches": np.where(second, size, -size / 2),
        "pressure": size * (1 + table.pressure / 6e5),
    }.get(kind, 0.0)
    error = 0.0 if kind == "zero" else scatter * random.standard_normal(len(table))
    force[slack] = np.broadcast_to(floor + error, force.shape)[slack]
    kept = ~slack if kind == "no slack cell" else np.ones(len(table), dtype=bool)
    made = pam.fitting.ForceTable(
        table.pressure, table.contraction, force, table.rest_length, "", table.branch, table.run
    ).with_floor(None)
    return made.subset(kept).with_floor("found"), true[kept]


def one_floor(number: int, seed: int) -> harness.Row:
    random, kind = np.random.default_rng([seed, number]), FLOORS[number % len(FLOORS)]
    case = sample(random)
    table, true = with_floor(case, kind, random)
    fit, plain = (
        pam.fit_force(t, case.name, fixed=case.fixed) for t in (table, table.with_floor(None))
    )
    far = 8 * case.noise
    missed = bool(np.any(~table.slack & (true < -far)))
    named = any("law pushes" in words or "slack" in words for words in fit.warnings)
    return {
        "text": f"{kind}, {case.name}",
        "floor": kind,
        "missed": missed,
        "silent": missed and not named,
        "false": bool(np.any(table.slack & (true > far))),
        "rmse": fit.rmse / case.noise,
        "held": list(held(case, fit).values()),
        "plain": list(held(case, plain).values()),
    }


def of_floors(rows: list[harness.Row]) -> str:
    lines = []
    for kind in ("all", *FLOORS):
        some = [r for r in rows if kind in ("all", r["floor"])]
        if some:
            counts = [sum(r[key] for r in some) for key in ("missed", "silent", "false")]
            shares = [harness.share(v for r in some for v in r[key]) for key in ("held", "plain")]
            middle = float(np.median([r["rmse"] for r in some]))
            lines.append([kind, len(some), *counts, middle, *(f"{s:.1f} %" for s in shares)])
    heads = ("floor", "tables", "missed", "silent", "false", "RMSE", "held", "none sought")
    return harness.table(heads, lines)


# ---- the study -----------------------------------------------------------------------------------
def cases(given: harness.Given) -> harness.Keyed:
    work = one_floor if given.floor else one
    for number in harness.numbers(given):
        yield number, partial(work, number, given.seed)


def summary(rows: list[harness.Row]) -> str:
    good = [r for r in rows if "verdict" not in r]
    return of_floors(good) if good and "floor" in good[0] else of_intervals(good)


OPTIONS = {"--floor": harness.flag("slack cells that show a force")}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=500, seed=1, options=OPTIONS)

"""Do static fits find what a load cell shows while the muscle is slack?

    python benchmarks/floor_study.py 70 --seed 7

Random tables as in fit_study.py, whose slack cells read, in turn: exactly 0; a floor of 2 to 12 N
for a muscle of 1500 N (in proportion for a smaller one), positive or negative; noise about zero; a
floor for each branch; one that rises with pressure; or that are left out. The floor scatters by
0.05, 0.3 or 1 times the noise of taut cells.

Counted for each kind: tables in which a cell counts as taut where the law is 8 standard deviations
below zero (missed), of these those in which no warning names it; tables in which a cell counts as
slack that pulls with more than that (false); RMSE over taut cells in parts of the noise; how often
the 95 % interval of a coefficient holds its true value, with the floor found and with none sought.
"""

from __future__ import annotations

import argparse
import warnings
from collections import defaultdict
from typing import Any

import fit_study
import numpy as np

import pam_ocp as pam

KINDS = ("zero", "plus", "minus", "noise", "branches", "pressure", "no slack cell")


def shown(case: Any, kind: str, random: np.random.Generator) -> tuple[pam.fitting.ForceTable, Any]:
    """The table as the load cell shows it, and the true tension of its cells."""
    table = case.table()
    true = np.asarray(case.law.tension(table.pressure, table.contraction))
    slack, force = true <= 0, table.force.copy()
    size = random.uniform(2, 12) * min(true.max() / 1500, 1)
    scatter = case.noise * random.choice([0.05, 0.3, 1.0])
    second = np.array([b == "deflation" for b in table.branch] or [False] * len(table))
    floor = {
        "zero": 0.0,
        "plus": size,
        "minus": -size,
        "noise": 0.0,
        "branches": np.where(second, size, -size / 2),
        "pressure": size * (1 + table.pressure / 6e5),
        "no slack cell": 0.0,
    }[kind]
    error = 0.0 if kind == "zero" else scatter * random.standard_normal(len(table))
    force[slack] = np.broadcast_to(floor + error, force.shape)[slack]
    kept = ~slack if kind == "no slack cell" else np.ones(len(table), dtype=bool)
    made = pam.fitting.ForceTable(
        table.pressure, table.contraction, force, table.rest_length, "", table.branch, table.run
    ).with_floor(None)
    return made.subset(kept).with_floor("found"), true[kept]


def judged(case: Any, table: pam.fitting.ForceTable) -> tuple[Any, int, int]:
    fit = pam.fit_force(table, case.name, fixed=case.fixed)
    true = fit_study.true_values(case, fit)
    seen = {n for n, c in fit.coefficients.items() if np.isfinite(c.stderr)}
    held = [lo <= true[n] <= hi for n, (lo, hi) in fit.intervals().items() if n in seen]
    return fit, sum(held), len(held)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("count", type=int, nargs="?", default=70)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    found: dict[str, list[Any]] = defaultdict(list)
    for number in range(options.count):
        random = np.random.default_rng([options.seed, number])
        kind = KINDS[number % len(KINDS)]
        case = fit_study.sample(random)
        table, true = shown(case, kind, random)
        far = 8 * case.noise
        try:
            fit, held, of = judged(case, table)
            _, plain, plain_of = judged(case, table.with_floor(None))
        except pam.PamError as error:
            print(number, kind, case.name, error)
            continue
        missed = bool(np.any(~table.slack & (true < -far)))
        told = any("law pushes" in words or "slack" in words for words in fit.warnings)
        false = bool(np.any(table.slack & (true > far)))
        row = (missed, missed and not told, false, fit.rmse / case.noise, held, of, plain, plain_of)
        found[kind].append(row)
        found["all"].append(row)
    print(
        f"{'':<16}{'tables':>7}{'missed':>8}{'silent':>8}{'false':>7}{'RMSE':>7}{'held':>9}{'else':>9}"
    )
    for kind, rows in found.items():
        a = np.array(rows, dtype=float)
        share, plain = 100 * a[:, 4].sum() / a[:, 5].sum(), 100 * a[:, 6].sum() / a[:, 7].sum()
        print(
            f"{kind:<16}{len(a):>7}{a[:, 0].sum():>8.0f}{a[:, 1].sum():>8.0f}{a[:, 2].sum():>7.0f}"
            f"{np.median(a[:, 3]):>7.2f}{share:>7.1f} %{plain:>7.1f} %"
        )


if __name__ == "__main__":
    main()

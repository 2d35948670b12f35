"""How well can a level of contraction that was not measured be predicted, and what stands in the
way?

    python benchmarks/leave_one_out.py

1. every law of the library, each interior level left out in turn;
2. straight lines in pressure at each level: what scatters within a level;
3. many smooth forms of G and H in F = G(kappa) p + H(kappa), the best chosen with hindsight;
4. what a shift of one level's length would do, by an F-test.

docs/cross_validation.md draws the conclusions.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from itertools import product

import numpy as np
from scipy.stats import f as f_distribution

import pam_ocp as pam

MUSCLES = {
    name: (length, {"rest_diameter": 2 * r, "radius": r, "max_contraction_ratio": 0.25})
    for name, length, r in (("DMSP-20-300", 0.300, 0.010), ("DMSP-10-250", 0.250, 0.005))
}
SHIFTS = np.linspace(-0.015, 0.015, 61)
Form = Callable[[np.ndarray, float], np.ndarray]
"""(kappa, rate) -> column (n)."""


COLUMNS: dict[str, Form] = {
    "1": lambda k, q: np.ones_like(k),
    "k": lambda k, q: k,
    "k2": lambda k, q: k**2,
    "(1-k)2": lambda k, q: (1 - k) ** 2,  # of the ideal braid
    "exp": lambda k, q: np.exp(-q * k),
    "1/(1+qk)": lambda k, q: 1 / (1 + q * k),
    "exp(-sqrt)": lambda k, q: np.exp(-q * np.sqrt(np.maximum(k, 0))),
}
GAINS = ("1, k", "1, (1-k)2", "1, k, k2", "1, k, exp", "1, (1-k)2, exp", "1, k, 1/(1+qk)")
OFFSETS = ("1, exp", "1, k, exp", "1, 1/(1+qk)", "1, exp(-sqrt)")
RATES = np.geomspace(3, 300, 60)


class Forms:
    """Least squares of F = G p + H on the taut cells, the common rate by a scan."""

    def __init__(self, p: np.ndarray, kappa: np.ndarray, force: np.ndarray) -> None:
        self.p, self.kappa, self.force = p, kappa, force

    def design(self, gain: str, offset: str, rate: float, kappa: np.ndarray) -> np.ndarray:
        columns = [self.p * COLUMNS[name](kappa, rate) for name in gain.split(", ")]
        return np.column_stack([*columns, *(COLUMNS[n](kappa, rate) for n in offset.split(", "))])

    def fit(self, gain: str, offset: str, used: np.ndarray, kappa: np.ndarray | None = None):
        """Least squares, (sum, residuals of all cells, number of coefficients)."""
        kappa = self.kappa if kappa is None else kappa
        best = None
        for rate in RATES:
            a = self.design(gain, offset, rate, kappa)
            size = np.linalg.norm(a[used], axis=0)
            c = np.linalg.lstsq(a[used] / size, self.force[used], rcond=1e-10)[0] / size
            rest = self.force - a @ c
            total = float(rest[used] @ rest[used])
            if best is None or total < best[0]:
                best = total, rest, a.shape[1] + 1
        return best


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def left_out(forms: Forms, gain: str, offset: str, level: np.ndarray) -> list[float]:
    """RMSE [N] at each interior level, left out of its fit."""
    return [rms(forms.fit(gain, offset, level != i)[1][level == i]) for i in range(1, level.max())]


def lines(table: pam.fitting.ForceTable) -> None:
    """G and H of each level by a straight line in pressure."""
    level, p = table.levels(), table.pressure / 1e5
    print("level   cells   G [N/bar]     H [N]   scatter [N]")
    for i in range(level.max() + 1):
        here = level == i
        a = np.stack([p[here], np.ones(here.sum())], axis=1)
        c = np.linalg.lstsq(a, table.force[here], rcond=None)[0]
        k = 100 * table.contraction[here].mean()
        print(
            f"{k:5.2f} %{here.sum():>7}{c[0]:>12.2f}{c[1]:>10.1f}"
            f"{rms(table.force[here] - a @ c):>12.2f}"
        )


def hindsight(forms: Forms, level: np.ndarray) -> None:
    """All pairs of forms, the best last-level-out first."""
    found = []
    for g, h in product(GAINS, OFFSETS):
        errors = left_out(forms, g, h, level)
        total, _, k = forms.fit(g, h, np.ones(level.size, dtype=bool))
        found.append((float(np.mean(errors)), errors, g, h, k, np.sqrt(total / level.size)))
    found.sort(key=lambda row: row[0])
    print(f"{len(found)} forms, the best with hindsight:")
    for mean, errors, g, h, k, rmse in found[:4]:
        shown = ", ".join(f"{e:.1f}" for e in errors)
        print(f"  G: {g:<15} H: {h:<14} k {k}  RMSE {rmse:5.2f}  left out {mean:5.2f} N ({shown})")


def shifts(forms: Forms, level: np.ndarray, rest_length: float) -> None:
    """The length of one level as one more unknown: by how much, and how likely by chance."""
    gain, offset = "1, (1-k)2", "1, exp"
    every = np.ones(level.size, dtype=bool)
    plain, _, k = forms.fit(gain, offset, every)
    print(
        "length of one level free (braid's G, H = h0 + h1 exp; RMSE "
        f"{np.sqrt(plain / level.size):.2f} N without):"
    )
    for i in range(level.max() + 1):
        here = level == i
        sums = [forms.fit(gain, offset, every, forms.kappa + d * here)[0] for d in SHIFTS]
        best = int(np.argmin(sums))
        dof = level.size - k - 1
        f = (plain - sums[best]) / (sums[best] / dof)
        outside = [
            np.mean(
                left_out(Forms(forms.p, forms.kappa + d * here, forms.force), gain, offset, level)
            )
            for d in SHIFTS[::2]
        ]
        at = int(np.argmin(outside))
        print(
            f"  level {100 * forms.kappa[here].mean():5.2f} %: longer by "
            f"{-1e3 * rest_length * SHIFTS[best]:+.2f} mm, RMSE "
            f"{np.sqrt(sums[best] / level.size):.2f} N, F = {f:.3g} (probability "
            f"{f_distribution.sf(f, 1, dof):.1g}); left out at best {outside[at]:.2f} N with "
            f"{-1e3 * rest_length * SHIFTS[::2][at]:+.2f} mm"
        )


def main() -> None:
    for name, (length, constants) in MUSCLES.items():
        table = pam.read_table(f"{name}_static.csv", rest_length=length)
        print(f"\n==== {name}\n{pam.compare_laws(table, fixed=constants)}\n")
        taut = table.taut
        lines(taut)
        forms, level = Forms(taut.pressure / 1e5, taut.contraction, taut.force), taut.levels()
        hindsight(forms, level)
        shifts(forms, level, length)


if __name__ == "__main__":
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pam.muscles.ValidityWarning)
        main()

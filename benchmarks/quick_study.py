"""Does ``quick`` find the right law in a table with faults, or say what it doubts?

    python benchmarks/quick_study.py [tables] [seed]

Tables of catalogue muscles (their own laws, random levels, noise) and the bundled ones, written as
a laboratory would (CSV with points or commas, two header rows, workbooks, other units) with one of
these faults in turn: none; a floor of the load cell; its zero off; cells that are wrong. *Right* is
a fit whose forces are those of the law that made the table, to 2 % of the largest force or three
standard deviations of the noise; bundled tables are right where 98 % of the variance is explained.
*Told* is a doubt that names the fault. Without a seed it comes from the clock.
"""

from __future__ import annotations

import sys
import tempfile
import time
import warnings
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

import pam_ocp as pam
from pam_ocp.studies import quick

FAULTS = {
    "none": (),
    "floor": ("floor", "slack", "no forces"),
    "zero off": ("zero", "floor", "slack", "offset"),
    "wrong cells": ("stand apart",),
}
LENGTH = 0.25
UNITS = {
    "si": ("pressure [Pa]", 1.0, "contraction", 1.0, "force [N]", 1.0),
    "bar": ("pressure [bar]", 1e-5, "contraction [%]", 100.0, "force [N]", 1.0),
    "kPa": ("p [kPa]", 1e-3, "length [mm]", 1e3, "force [kN]", 1e-3),
}


def drawn(rng: np.random.Generator, fault: str) -> tuple[pam.Muscle, Any, float, np.ndarray]:
    """(muscle, its cells (n, 3) in SI with noise and fault, noise [N], true forces)."""
    names = [n for n in pam.muscles.muscle_names() if not n.endswith("-wall")]
    name = str(rng.choice(names))
    try:
        muscle = pam.muscle(name)
    except pam.InputError:
        muscle = pam.muscle(name, rest_length=LENGTH)
    top = muscle.pressure_range[1]
    most = min(float(muscle.max_contraction(top)), muscle.contraction_range[1])
    p, k = np.meshgrid(
        np.linspace(0.1 * top, top, int(rng.integers(6, 12))),
        np.linspace(max(0.0, muscle.contraction_range[0]), most, int(rng.integers(6, 11))),
        indexing="ij",
    )
    true = np.maximum([float(muscle.force(a, b)) for a, b in zip(p.flat, k.flat, strict=True)], 0.0)
    noise = float(rng.uniform(0.001, 0.006)) * true.max()
    force = true + noise * rng.standard_normal(true.size) * (true > 0)
    if fault == "floor":
        force = np.maximum(force, np.quantile(true[true > 0], rng.uniform(0.05, 0.15)))
    if fault == "zero off":
        force = force + rng.choice([-1.0, 1.0]) * rng.uniform(0.02, 0.06) * true.max()
    if fault == "wrong cells":
        force[rng.choice(np.flatnonzero(true > 0), 2, replace=False)] *= rng.uniform(1.5, 3.0)
    return muscle, np.column_stack([p.ravel(), k.ravel(), force]), noise, true


def written(rng: np.random.Generator, folder: Path, muscle: pam.Muscle, cells: Any) -> Path:
    """The file, in a dialect."""
    unit, form = str(rng.choice([*UNITS])), str(rng.choice(["csv", "commas", "two rows", "xlsx"]))
    pressure, p_scale, second, k_scale, force, f_scale = UNITS[unit]
    k = cells[:, 1]
    if second.startswith("length"):
        k = float(muscle.rest_length) * (1 - k)
    columns = np.column_stack([cells[:, 0] * p_scale, k * k_scale, cells[:, 2] * f_scale])
    heads = [pressure, second, force]
    path = folder / ("rig.xlsx" if form == "xlsx" else "rig.csv")
    if form == "xlsx":
        import openpyxl

        book = openpyxl.Workbook()
        book.active.append(heads)
        for row in columns.tolist():
            book.active.append(row)
        book.save(path)
        return path
    between = ";" if form == "commas" else ","
    rows = [heads]
    if form == "two rows":
        names = [h.partition(" [")[0] for h in heads]
        rows = [names, [h.partition(" [")[2].rstrip("]") for h in heads]]
    lines = [between.join(row) for row in rows]
    for row in columns:
        text = between.join(f"{v:.7g}" for v in row)
        lines.append(text.replace(".", ",") if form == "commas" else text)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def one(seed: int, number: int, fault: str) -> tuple[str, bool, bool, Any]:
    rng = np.random.default_rng([seed, number])
    with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        muscle, cells, noise, true = drawn(rng, fault)
        path = written(rng, Path(place), muscle, cells)
        made = quick(path, Path(place) / "out", rest_length=float(muscle.rest_length))
        taut = true > 0
        found = made.fit.muscle(rest_length=float(muscle.rest_length))
        force = [float(found.force(p, k)) for p, k in cells[taut, :2]]
        error = float(np.sqrt(np.mean((force - true[taut]) ** 2)))
        allowed = max(3 * noise, 0.02 * true.max())
        told = any(word in doubt for doubt in made.doubts for word in FAULTS[fault])
        words = f"{muscle.name} by {muscle.law.name}, {path.name}: {made.fit.law.name}, error "
        words += f"{error:.3g} N of {allowed:.3g}, motion "
        words += "none" if made.plan is None else "verified" if made.plan.verified else "unverified"
        return words, error <= allowed, told, made


def main(count: int = 30, seed: int | None = None) -> dict[str, int]:
    seed = int(time.time()) if seed is None else seed
    print(f"seed {seed}")
    counts = dict.fromkeys(("right", "told", "neither", "motion verified", "refused"), 0)
    tables = sorted(f.name for f in files("pam_ocp.data").iterdir() if "static" in f.name)
    for number in range(count):
        fault = list(FAULTS)[number % len(FAULTS)]
        begin = time.process_time()
        try:
            if number < len(tables):
                fault = "bundled"
                with tempfile.TemporaryDirectory() as place, warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    length = 1e-3 * int(tables[number].split("_")[0].split("-")[2])
                    made = quick(tables[number], Path(place) / "out", rest_length=length)
                right, told = made.fit.r2 > 0.98, bool(made.doubts)
                words = f"{tables[number]}: {made.fit.law.name}, R2 {made.fit.r2:.4f}"
            else:
                words, right, told, made = one(seed, number, fault)
        except pam.PamError as error:
            counts["refused"] += 1
            print(f"{number:4} {fault:<12} refused: {error}", flush=True)
            continue
        counts["right" if right else "told" if told else "neither"] += 1
        counts["motion verified"] += bool(made.plan is not None and made.plan.verified)
        said = "right" if right else "told" if told else "NEITHER"
        seconds = time.process_time() - begin
        print(f"{number:4} {fault:<12} {said:<8} {words}; {seconds:.1f} s", flush=True)
        if not right or made.plan is None or not made.plan.verified:
            print("".join(f"       {doubt}\n" for doubt in made.doubts), end="")
    print(", ".join(f"{name} {value}" for name, value in counts.items()))
    return counts


if __name__ == "__main__":
    main(*(int(a) for a in sys.argv[1:]))

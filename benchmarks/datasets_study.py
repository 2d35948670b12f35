"""How well do the library's own models predict the data sets of pam.datasets?

    python benchmarks/datasets_study.py [--out FOLDER] [--only WORD ...]

Static sets: every law of the library, fitted to the training cells. The robot arm, where its files
are (PAM_OCP_DATA): the last angles held, ARX of each joint or of the whole arm, and the grey box of
examples/fit_joint.py with the values found there, of episodes 0-47 (no test set has any of them).
Nothing is drawn: the seed has no effect. --out keeps the scores as JSON; docs/datasets.md has the
figures.

    python benchmarks/datasets_study.py --make CLONE FOLDER

writes mpi_arm_64_episodes.csv into FOLDER, from a clone of github.com/ALRhub/action-conditional-rkn
(commit fd871bd); its checksum is looked at when it is loaded.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import arm
import harness
import leave_one_out
import numpy as np

import pam_ocp as pam
from pam_ocp.datasets import DATASETS, Split, load, score
from pam_ocp.fitting import ArxStructure
from pam_ocp.muscles.laws.user_defined import polynomial_law

Model = Callable[[pam.Trajectory, pam.Trajectory], np.ndarray]
JOINTS = (1, 2, 3, 4)
ANGLES = [f"q{j}" for j in JOINTS]
PRESSURES = [f"p{k}" for k in range(1, 9)]
ALONE = [([f"q{j}"], [f"p{2 * j - 1}", f"p{2 * j}"]) for j in JOINTS]


# ---- models -------------------------------------------------------------------------------------
def law(split: Split, kind: Any) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    constants = leave_one_out.MUSCLES[split.dataset.name][1]
    own = {n: v for n, v in constants.items() if n in kind.fixed_coefficients()}
    fit = pam.fit_force(split.train, kind, fixed=own)
    return lambda kappa, p: fit.law.tension(p, kappa)


def held(past: pam.Trajectory, inputs: pam.Trajectory) -> np.ndarray:
    return np.tile(past.array(ANGLES)[-1], (len(inputs), 1))


def arx(split: Split, order: int, groups: list[tuple[list[str], list[str]]]) -> Model:
    """ARX models, each of some outputs and inputs, that together predict all angles."""
    models = [ArxStructure(*group, order, [0.5], every=0.1).fit(split.train) for group in groups]

    def predict(past: pam.Trajectory, inputs: pam.Trajectory) -> np.ndarray:
        found = {}
        for (outputs, drives), model in zip(groups, models, strict=True):
            y = list(past.array(outputs))
            u = np.concatenate([past.array(drives)[:-1], inputs.array(drives)])
            for k in range(len(past), len(u)):
                rows = [*(y[k - i] for i in range(1, order + 1)), *u[k - order + 1 : k + 1][::-1]]
                y.append(np.clip(np.concatenate([*rows, [1.0]]) @ model.coefficients, -10, 10))
            found |= dict(zip(outputs, np.array(y[len(past) - 1 :]).T, strict=True))
        return np.column_stack([found[n] for n in ANGLES])

    return predict


def grey(split: Split) -> Model:
    """The joints of examples/fit_joint.py, from the last angle and the speed of a parabola."""
    plants = [arm.fit_joint.joint(j).with_values(arm.fit_joint.FOUND[j]) for j in JOINTS]

    def predict(past: pam.Trajectory, inputs: pam.Trajectory) -> np.ndarray:
        found = []
        for name, plant in zip(ANGLES, plants, strict=True):
            speed = np.polyfit(past.t[-8:], past[name][-8:], 2)[1]
            start = {"q": past[name][-1], "w": speed}
            drive = {v.name: inputs[v.name] for v in plant.inputs}
            line = {"t": inputs.t, "interpolation": "linear", "rtol": 1e-6}
            found.append(pam.simulate(plant, drive, start=start, **line)["q"])
        return np.column_stack(found)

    return predict


LAWS = {
    kind.name: partial(law, kind=kind) for kind in (*pam.laws.LAWS.values(), polynomial_law(1, 3))
}
MODELS: dict[str, Callable[[Split], Model]] = {
    "held": lambda split: held,
    "ARX(5) alone": partial(arx, order=5, groups=ALONE),
    "ARX(5) whole": partial(arx, order=5, groups=[(ANGLES, PRESSURES)]),
    "grey box": grey,
}


# ---- study --------------------------------------------------------------------------------------
def make(clone: str, folder: str) -> harness.Row:
    """The first 64 episodes, without their first samples."""
    lines = [",".join(DATASETS["mpi_arm"].columns)]
    files = sorted((Path(clone) / "data/PAMData/Data2").iterdir())[:64]
    for number, file in enumerate(files):
        samples = np.array(json.loads(file.read_text("utf-8"))["ob"])[1:]
        for k, row in enumerate(samples[:, [*range(4), *range(8, 16)]]):
            lines.append(",".join([f"{number},{k / 100:.2f}", *(f"{value:.5f}" for value in row)]))
    harness.write(Path(folder) / arm.FILES[0], "\n".join([*lines, ""]))
    return {"text": f"{len(lines) - 1} samples"}


def one(name: str, split: str, model: str, fit: Any, out: Path | None) -> harness.Row:
    task = load(name, split)
    found = score(task, fit(task), model=model)
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        found.save(out / f"{name}, {split}, {model}.json")
    cells = {p.label: f"{p.rmse:.4g} ({p.nrmse:.3f})" for p in found.parts}
    row = {"task": f"{name}, {split}", "model": model, "cells": cells}
    return {**row, "first": found.parts[0].rmse}


def cases(given: harness.Given) -> harness.Keyed:
    if given.make:
        yield "make", partial(make, *given.make)
        return
    for name, info in DATASETS.items():
        models = LAWS if info.rest_length else MODELS
        for split, model in product(info.splits, models):
            work = partial(one, name, split, model, models[model], given.out)
            yield f"{name}, {split}, {model}", work


def summary(rows: list[harness.Row]) -> str:
    """A table for each task: RMSE, and in brackets NRMSE."""
    texts = []
    for task in dict.fromkeys(row["task"] for row in rows if "task" in row):
        own = sorted((r for r in rows if r.get("task") == task), key=lambda row: row["first"])
        lines = [[row["model"], *row["cells"].values()] for row in own]
        texts.append(f"{task}\n{harness.table(['model', *own[0]['cells']], lines)}")
    return "\n\n".join(texts)


OPTIONS = {
    "--out": {"type": Path, "help": "folder for the scores as JSON"},
    "--make": {"nargs": 2, "metavar": ("CLONE", "FOLDER"), "help": "see above"},
}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, seed=0, options=OPTIONS)

"""A robot arm of four joints and eight muscles: grey boxes against ARX, nested cross-validation.

Every structure below is fitted to free runs of both files of episodes and chosen, joint by joint,
by ``pam.fitting.choose``: whole episodes are left out, the folds are drawn when the script starts,
and starts of the search are sizes, never values that were fitted before. The yardstick is the best
of several ARX models (own angle and pressures, or all of them; several orders; pressures as
recorded, or 20 ms ahead of it), picked with hindsight, which flatters it.

    q'' = T1 - T2 + load(q) - stop(q) - c q' - friction tanh(q'/v)      in parts of the inertia

is the grey box of examples/fit_joint.py: tensions affine in the pressure, friction that grows with
tension. "late" adds that the pressures are recorded later than they act, by an estimated time.

Run:  python benchmarks/arm.py [64.csv 200.csv ...] [--folds 3] [--seed N] [--only own|late]
                               [--test other.csv]

--test judges the chosen models, fitted to all episodes of the training files, on another file.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import pam_ocp as pam
from pam_ocp.fitting import ArxStructure, Choice, FreeRunStructure, choose

HERE = Path(__file__).resolve().parent
FILES = ("mpi_arm_64_episodes.csv", "mpi_arm_200_episodes.csv")
HORIZONS = (0.1, 0.25, 0.5, 1.0)
EVERY = 0.05
"""From start to start where runs are judged [s]."""
EVALUATIONS = 12
JOINTS = (1, 2, 3, 4)


def example() -> Any:
    """examples/fit_joint.py, where the joints and the reader stand."""
    spec = importlib.util.spec_from_file_location(
        "fit_joint", HERE.parent / "examples/fit_joint.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["fit_joint"] = module
    spec.loader.exec_module(module)
    return module


fit_joint = example()


# ---- structures ---------------------------------------------------------------------------------
def structures(j: int) -> dict[str, FreeRunStructure]:
    """Of one joint, in units of its record: q, and the pressures that its plant has."""
    plant = fit_joint.joint(j).with_values(fit_joint.CRUDE[j])
    free = [v.name for v in plant.parameters]
    options = {
        "horizon": (0.1, 0.25),
        "every": 0.25,
        "history": 2,
        "steps": 2,
        "evaluations": EVALUATIONS,
        "begin_short": False,
    }
    judged = {"horizon": HORIZONS, "every": EVERY, "steps": 4, "history": 2}
    late = {**options, "delay": (-0.04, 0.02)}
    return {
        "own": FreeRunStructure(plant, free, options, judged),
        "late": FreeRunStructure(plant, free, late, judged),
    }


def yardsticks() -> dict[str, dict[str, ArxStructure]]:
    """{joints that it sees: {name: model}}."""
    angles, muscles = [f"q{j}" for j in range(1, 5)], [f"p{k}" for k in range(1, 9)]

    def made(seen: Sequence[int], order: int, lag: int) -> ArxStructure:
        outputs = [angles[j - 1] for j in seen]
        inputs = [muscles[k] for j in seen for k in (2 * j - 2, 2 * j - 1)]
        return ArxStructure(outputs, inputs, order, HORIZONS, EVERY, lag=lag)

    orders = (2, 5, 8, 15, 30)
    own = {
        f"q{j}": {f"own {n}, lag {lag}": made((j,), n, lag) for n in orders for lag in (0, -2)}
        for j in range(1, 5)
    }
    everything = {
        f"all {n}, lag {lag}": made((1, 2, 3, 4), n, lag) for n in (5, 8) for lag in (0, -2)
    }
    return {**own, "all": everything}


# ---- data ---------------------------------------------------------------------------------------
def read(paths: Sequence[Path]) -> list[pam.Trajectory]:
    return [r for path in paths for r in fit_joint.read_arm(path)]


def found_files() -> list[Path]:
    folder = Path(os.environ.get("PAM_OCP_DATA", HERE.parents[1] / "shared" / "data"))
    return [folder / name for name in FILES if (folder / name).exists()]


# ---- comparison ---------------------------------------------------------------------------------
def best_arx(
    train: Sequence[pam.Trajectory], test: Sequence[pam.Trajectory]
) -> dict[str, dict[str, np.ndarray]]:
    """{joint: {ARX: losses (n, horizons)}} on ``test``."""
    found: dict[str, dict[str, np.ndarray]] = {f"q{j}": {} for j in range(1, 5)}
    for models in yardsticks().values():
        for name, model in models.items():
            losses = model.losses(model.fit(train), test)
            for i, q in enumerate(model.outputs):
                found[q][name] = losses[:, i :: len(model.outputs)]
    return found


def table(grey: dict[str, np.ndarray], arx: dict[str, dict[str, np.ndarray]]) -> str:
    """RMSE by joint and horizon, of the grey boxes and of the best ARX of each cell."""
    head = "".join(f"{f'{h:g} s':>24}" for h in HORIZONS)
    lines = ["RMSE [rad] grey / best ARX (ratio), free runs from every 0.05 s", f"{'':10}{head}"]
    for q, losses in grey.items():
        cells = []
        for h in range(len(HORIZONS)):
            own = float(np.sqrt(np.nanmean(losses[:, h])))
            name = min(arx[q], key=lambda n, h=h: np.nanmean(arx[q][n][:, h]))
            best = float(np.sqrt(np.nanmean(arx[q][name][:, h])))
            cells.append(f"{own:.4f} / {best:.4f} ({own / best:.2f})".rjust(24))
        lines.append(f"joint {q[1]:<4}" + "".join(cells))
    return "\n".join(lines)


def main(words: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--only", help="one structure: plain cross-validation")
    parser.add_argument("--test", type=Path, default=None)
    given = parser.parse_args(words)
    files = given.files or found_files()
    if not files:
        print(
            "the arm's episodes are not here: give the files, or set PAM_OCP_DATA to their folder"
        )
        return
    arm = read(files)
    seed = int(np.random.SeedSequence().generate_state(1)[0]) if given.seed is None else given.seed
    print(f"{len(arm)} episodes of {', '.join(f.name for f in files)}, seed {seed}", flush=True)
    choices: dict[int, Choice] = {}
    for j in JOINTS:
        began = time.process_time()
        choices[j] = choose(
            {n: s for n, s in structures(j).items() if given.only in (None, n)},
            fit_joint.records_of(j, arm),
            folds=given.folds,
            seed=seed,
            criteria=[f"{h:g} s" for h in HORIZONS],
            refit=given.test is not None,
        )
        print(f"\njoint {j}: {time.process_time() - began:.0f} s of processor time")
        print(choices[j], flush=True)
    fold = choices[1].folds
    arx: dict[str, dict[str, np.ndarray]] = {f"q{j}": {} for j in range(1, 5)}
    for k in range(given.folds):
        train = [r for r, f in zip(arm, fold, strict=True) if f != k]
        test = [r for r, f in zip(arm, fold, strict=True) if f == k]
        for q, models in best_arx(train, test).items():
            for name, losses in models.items():
                arx[q].setdefault(name, np.full((len(arm), len(HORIZONS)), np.nan))[fold == k] = (
                    losses
                )
    nested = {f"q{j}": choices[j].nested for j in JOINTS}
    print("\nnested cross-validation\n" + table(nested, arx), flush=True)
    if given.test is not None:
        other = read([given.test])
        losses = {
            f"q{j}": structures(j)[c.name].losses(c.model, fit_joint.records_of(j, other))
            for j, c in choices.items()
        }
        print(f"\n{given.test.name}\n" + table(losses, best_arx(arm, other)))


if __name__ == "__main__":
    main(sys.argv[1:])

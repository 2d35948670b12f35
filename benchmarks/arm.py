"""A robot arm of four joints and eight muscles: grey boxes against ARX and, with --gru, against
networks; nested cross-validation.

Every structure below is fitted to free runs of both files of episodes and chosen by
``pam.fitting.choose``: whole episodes are left out, the folds are drawn when the script starts, and
starts of the search are sizes, never values that were fitted before. The yardstick, the best of
several ARX models of each joint (own angle and pressures, or all of them; several orders; pressures
as recorded, or 20 ms ahead of it), is chosen in the same way by the same folds. --gru adds another,
an ensemble of gated recurrent units that read 0.2 s of the joint's own angle and pressures. Ratios
have 95 % intervals from differences episode by episode.

    q'' = T1 - T2 + load(q) - stop(q) - c q' - friction tanh(q'/v)      in parts of the inertia

is the grey box of examples/fit_joint.py: tensions affine in the pressure, friction that grows with
tension; the pressures are recorded later than they act, by an estimated time. Joints 2 and 3 have
parallel axes, so that each one's acceleration moves the other: "coupled" has the inertia of a
double pendulum between them, "apart" has not.

Run:  python benchmarks/arm.py [64.csv 200.csv ...] [--folds 3] [--seed N] [--groups 1,4,23]
                               [--only apart|coupled] [--gru] [--test other.csv]

--only fits one structure, so that nothing is chosen inside. --test judges the chosen models, fitted
to all episodes of the training files, on another file.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import harness
import numpy as np

import pam_ocp as pam
from pam_ocp.fitting import ArxStructure, Choice, FreeRunFit, FreeRunStructure, GruStructure, choose
from pam_ocp.fitting.dynamic.choice import as_ratio, rmse_ratios

harness.importable("examples")
import fit_joint  # noqa: E402

HERE = Path(__file__).resolve().parent
FILES = ("mpi_arm_64_episodes.csv", "mpi_arm_200_episodes.csv")
HORIZONS = (0.1, 0.25, 0.5, 1.0)
EVERY = 0.05
"""From start to start where runs are judged [s]."""
EVALUATIONS = 12
OPTIONS = {
    "horizon": (0.1, 0.25),
    "every": 0.25,
    "history": 2,
    "steps": 2,
    "evaluations": EVALUATIONS,
    "begin_short": False,
    "delay": (-0.04, 0.02),
}
JUDGED = {"horizon": HORIZONS, "every": EVERY, "steps": 4, "history": 2}


# ---- structures ---------------------------------------------------------------------------------
def alone(j: int) -> FreeRunStructure:
    plant = fit_joint.joint(j).with_values(fit_joint.CRUDE[j])
    return FreeRunStructure(plant, [v.name for v in plant.parameters], OPTIONS, JUDGED)


@dataclass(frozen=True)
class Apart:
    """Some joints of the arm, each by itself. Losses: by horizon, and in it by joint."""

    joints: tuple[int, ...]

    @property
    def complexity(self) -> float:
        return sum(alone(j).complexity for j in self.joints)

    def fit(self, records: Sequence[pam.Trajectory], /) -> dict[int, FreeRunFit]:
        return {j: alone(j).fit(of_joint(j, records)) for j in self.joints}

    def losses(
        self, model: Mapping[int, FreeRunFit], records: Sequence[pam.Trajectory], /
    ) -> np.ndarray:
        found = [alone(j).losses(model[j], of_joint(j, records)) for j in self.joints]
        return np.stack(found, axis=2).reshape(len(records), -1)


@dataclass(frozen=True)
class Coupled:
    """Joints 2 and 3 with what each one's acceleration does to the other.

    First each by itself, then from there with the coupling.
    """

    evaluations: int = 6

    @property
    def complexity(self) -> float:
        return float(len(pair().parameters))

    def _structure(self, values: Mapping[str, float]) -> FreeRunStructure:
        plant = pair().with_values(values)
        options = {**OPTIONS, "evaluations": self.evaluations}
        return FreeRunStructure(plant, [v.name for v in plant.parameters], options, JUDGED)

    def fit(self, records: Sequence[pam.Trajectory], /) -> FreeRunFit:
        found = Apart((2, 3)).fit(records)
        values = {f"{n}_{j}": v for j, fit in found.items() for n, v in fit.values.items()}
        return self._structure(values).fit(of_pair(records))

    def losses(self, model: FreeRunFit, records: Sequence[pam.Trajectory], /) -> np.ndarray:
        return self._structure({}).losses(model, of_pair(records))


def pair() -> pam.Plant:
    """Joints 2 and 3 as a double pendulum; everything in parts of the inertia of its own joint.

    | 1 + 2 b2 cos q3   c2 + b2 cos q3 |        | f2 + b2 sin q3 (2 w2 w3 + w3^2) |
    | c3 + b3 cos q3           1       | q'' =  | f3 - b3 sin q3 w2^2             |

    with f of the joint alone, and gravity of both angles together.
    """
    plant = pam.Plant("joints2and3", "two joints with parallel axes, each with its pair of muscles")
    angle = {j: plant.state(f"q{j}", unit="rad") for j in (2, 3)}
    speed = {j: plant.state(f"w{j}", unit="rad/s") for j in (2, 3)}
    inputs: dict[str, ca.SX] = {}
    both = angle[2] + angle[3]
    force = {}
    for j in (2, 3):
        one = fit_joint.joint(j).with_values(fit_joint.CRUDE[j])
        for v in one.inputs:
            if v.name not in inputs:
                inputs[v.name] = plant.input(v.name)
        own = [
            plant.parameter(
                f"{v.name}_{j}", v.start, nominal=v.nominal, unit=v.unit, min=v.min, max=v.max
            )
            for v in one.parameters
        ]
        u = ca.vertcat(*(inputs[v.name] for v in one.inputs))
        rates = one.function(ca.vertcat(angle[j], speed[j]), u, ca.vertcat(*own))[0]
        force[j] = rates[1]
        for name, wave in (("sin", ca.sin(both)), ("cos", ca.cos(both))):
            force[j] += plant.parameter(f"both_{name}_{j}", 0.0, nominal=10, unit="1/s2") * wave

    def inertia(name: str, value: float, nominal: float, end: float) -> ca.SX:
        return plant.parameter(name, value, nominal=nominal, min=-end, max=end)

    c2, b2 = inertia("c2", 0.05, 0.1, 1.0), inertia("b2", 0.0, 0.1, 0.3)
    c3, b3 = inertia("c3", 0.3, 0.5, 3.0), inertia("b3", 0.0, 0.5, 2.0)
    w2, w3, sine, cosine = speed[2], speed[3], ca.sin(angle[3]), ca.cos(angle[3])
    f2 = force[2] + b2 * sine * (2 * w2 * w3 + w3**2)
    f3 = force[3] - b3 * sine * w2**2
    m22, m23, m32 = 1 + 2 * b2 * cosine, c2 + b2 * cosine, c3 + b3 * cosine
    det = m22 - m23 * m32
    for j, rate in ((2, f2 - m23 * f3), (3, m22 * f3 - m32 * f2)):
        plant.der(angle[j], speed[j])
        plant.der(speed[j], rate / det)
    return plant


def structures(joints: tuple[int, ...], only: str | None = None) -> dict[str, Any]:
    found: dict[str, Any] = {"apart": Apart(joints)}
    if joints == (2, 3):
        found["coupled"] = Coupled()
    return {only: found[only]} if only in found else found


WHOLE = [f"q{k}" for k in range(1, 5)], [f"p{k}" for k in range(1, 9)]
FIRST = 0.05
"""Where the first runs start [s], as of the grey boxes, which need two samples of the past."""


def own(j: int) -> tuple[list[str], list[str]]:
    """Outputs and inputs of joint j alone."""
    return [f"q{j}"], [f"p{2 * j - 1}", f"p{2 * j}"]


def yardsticks(j: int) -> dict[str, Any]:
    """ARX models of joint j: of its own columns, and of those of the whole arm."""

    def made(outputs: Sequence[str], inputs: Sequence[str], order: int, lag: int) -> ArxStructure:
        return ArxStructure(outputs, inputs, order, HORIZONS, EVERY, first=FIRST, lag=lag)

    alone = {f"own {n}, lag {g}": made(*own(j), n, g) for n in (5, 8, 15) for g in (0, -2)}
    return alone | {
        f"all {n}, lag {g}": OneOf(made(*WHOLE, n, g), j - 1) for n in (5, 8) for g in (0, -2)
    }


def networks(j: int) -> dict[str, Any]:
    """Gated recurrent units on the columns of joint j (those of the whole arm made them worse);
    pressures 20 ms ahead, the older ones from memory.
    """
    return {"GRU": GruStructure(*own(j), HORIZONS, EVERY, first=FIRST, lag=-2)}


KEPT: dict[Any, Any] = {}
"""Of ARX models of the whole arm, which serve all joints."""


@dataclass(frozen=True)
class OneOf:
    """One output of an ARX model of several."""

    whole: ArxStructure
    place: int

    @property
    def complexity(self) -> float:
        return self.whole.complexity

    def fit(self, records: Sequence[pam.Trajectory], /) -> Any:
        key = (self.whole.order, self.whole.lag, *map(id, records))
        if key not in KEPT:
            KEPT[key] = self.whole.fit(records)
        return KEPT[key]

    def losses(self, model: Any, records: Sequence[pam.Trajectory], /) -> np.ndarray:
        key = (id(model), *map(id, records))
        if key not in KEPT:
            KEPT[key] = self.whole.losses(model, records)
        return KEPT[key][:, self.place :: len(self.whole.outputs)]


# ---- data ---------------------------------------------------------------------------------------
def read(paths: Sequence[Path]) -> list[pam.Trajectory]:
    """The episodes of all files; pressures ran by lines between samples."""
    return [r.running("linear") for path in paths for r in fit_joint.read_arm(path)]


def of_joint(j: int, records: Sequence[pam.Trajectory]) -> list[pam.Trajectory]:
    return [r.running("linear") for r in fit_joint.records_of(j, list(records))]


def of_pair(records: Sequence[pam.Trajectory]) -> list[pam.Trajectory]:
    names = ("q2", "q3", *(v.name for v in pair().inputs))
    return [pam.Trajectory(r.t, {n: r[n] for n in names}, interpolation="linear") for r in records]


def found_files() -> list[Path]:
    folder = Path(os.environ.get("PAM_OCP_DATA", HERE.parents[1] / "shared" / "data"))
    return [folder / name for name in FILES if (folder / name).exists()]


# ---- comparison ---------------------------------------------------------------------------------
def by_joint(joints: tuple[int, ...], losses: np.ndarray) -> dict[int, np.ndarray]:
    """{joint: (n, horizons)}."""
    whole = losses.reshape(len(losses), len(HORIZONS), len(joints))
    return {j: whole[:, :, i] for i, j in enumerate(joints)}


def row(j: int, rival: str, grey: np.ndarray, other: np.ndarray) -> str:
    """By horizon the RMSE of the chosen grey box, by the folds left out, and its ratio to that of
    the chosen rival.
    """
    own = np.sqrt(np.nanmean(grey, axis=0))
    pairs = zip(own, rmse_ratios(grey, other), strict=True)
    return f"joint {j} / {rival:<5}" + "".join(
        f"{rmse:.4f} {as_ratio(ratio)}".rjust(29) for rmse, ratio in pairs
    )


CRITERIA = [f"{h:g} s" for h in HORIZONS]


def main(words: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--folds", type=int, default=3)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--groups", default="1,4,23", help="joints that are fitted together")
    parser.add_argument("--only", help="one structure, where there are two")
    parser.add_argument("--gru", action="store_true", help="networks as a second yardstick")
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
    head = "".join(f"{c:>29}" for c in CRITERIA)
    rows: list[str] = []
    refit = given.test is not None
    groups = [tuple(int(c) for c in group) for group in given.groups.split(",")]
    kinds = {"ARX": yardsticks, "GRU": networks} if given.gru else {"ARX": yardsticks}
    rivals: dict[int, dict[str, Choice]] = {j: {} for group in groups for j in group}
    for j, name in ((j, name) for j in rivals for name in kinds):
        ways = {"folds": given.folds, "seed": seed, "refit": refit, "criteria": CRITERIA}
        found = choose(kinds[name](j), arm, rule="best", **ways)  # as the grey boxes are
        rivals[j][name] = found
        print(
            f"joint {j}: {name} chosen in the folds: {', '.join(found.chosen)}\n{found}", flush=True
        )
    for joints in groups:
        began = time.process_time()
        choice = choose(
            structures(joints, given.only),
            arm,
            folds=given.folds,
            seed=seed,
            criteria=[f"q{j}, {c}" for c in CRITERIA for j in joints],
            refit=refit,
            progress=lambda done, of: print(f"    fit {done} of {of}", file=sys.stderr, flush=True),
        )
        print(f"\njoints {joints}: {time.process_time() - began:.0f} s of processor time")
        print(choice, flush=True)
        nested = by_joint(joints, choice.nested)
        for j, name in ((j, name) for j in joints for name in kinds):
            rival = rivals[j][name]
            rows.append(row(j, name, nested[j], rival.nested))
            print(rows[-1], flush=True)
            if given.test is not None:
                other = read([given.test])
                losses = structures(joints)[choice.name].losses(choice.model, other)
                best = kinds[name](j)[rival.name].losses(rival.model, other)
                text = row(j, name, by_joint(joints, losses)[j], best)
                print(f"{given.test.name}: {text}", flush=True)
    title = "RMSE [rad] of the grey box, and its ratio to the rival's, free runs from every 0.05 s"
    print("\n".join(["", title, f"{'':15}{head}", *sorted(rows)]))


if __name__ == "__main__":
    main(sys.argv[1:])

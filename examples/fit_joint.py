"""A grey-box model of each joint of a muscle-driven robot arm, judged by free runs against ARX.

The arm has four joints, each pulled by an antagonistic pair of muscles. Measured at 100 Hz are the
joint angles and the pressures in the muscles (in parts of full scale: no newtons are known). The
model of a joint, everything in parts of its inertia, so as angular accelerations [1/s2]:

    q'' = T1 - T2 + load(q) - stop(q) - c q' - friction tanh(q'/v)
    T   = max(0, (g + g' q) p + h + h' q + h'' q^2)        tension: affine in the pressure p, as the
                                                           six-parameter law is; a muscle only pulls
    friction = f0 + mu1 T1 + mu2 T2 + (pressures of a neighbouring joint's muscles, whose tendons
                                       press on this joint's)

It is dry friction, growing with the tension of the tendons, that makes the difference: the joints
stick for tenths of a second, which no linear model can do. Parameters come from free runs of 0.5 s
over episodes 0-47; each episode 48-63 is then free-run for 0.5 s from every 0.25 s, and so are the
linear models: ARX(5) of the joint's own angle and pressures, and of all angles and all pressures.

Run:  python examples/fit_joint.py [folder for the results] [mpi_arm_64_episodes.csv] [--full]

The data are those of Büchler et al. (MPI for Intelligent Systems) in the repository
ALRhub/action-conditional-rkn, here as columns episode, t_s, q1_rad .. q4_rad, p1_norm .. p8_norm.
Without a path they are looked for in the folder PAM_OCP_DATA or ../shared/data; where there are
none, a synthetic arm takes their place. --full fits from crude starts (minutes), not from the
values below.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

import pam_ocp as pam
from pam_ocp.fitting import FreeRun, FreeRunFit, fit_free_run, free_run
from pam_ocp.muscles.law import clamp

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FILE = "mpi_arm_64_episodes.csv"
JOINTS = (1, 2, 3, 4)
HORIZON, EVERY, RATE = 0.5, 0.25, 100
TRAINING = 48
ORDER = 5

NEIGHBOURS = {1: (3, 4), 2: (), 3: (7, 8), 4: (5, 6)}
"""Muscles of other joints whose tendons add to a joint's friction."""

CREEP = {1: 0.02, 2: 0.02, 3: 0.03, 4: 0.1}
"""Speed below which friction is rounded off [rad/s]; joint 4 is the light and quick one."""

CRUDE: dict[int, dict[str, float]] = {
    1: {"gain1": 130, "gain2": 130},
    2: {"gain3": 130, "gain4": 130, "pre3": -13, "pre4": -13},
    3: {
        "gain5": 450,
        "gain6": 450,
        "pre5": -180,
        "pre6": -180,
        "load_cos": -40,
        "grip5": 0.4,
        "grip6": 0.4,
    },
    4: {"gain7": 800, "gain8": 800, "pre7": -320, "pre8": -320},
}
"""Starts from nothing but sizes: joints 3 and 4 pull only above 0.4 of full pressure."""

FOUND: dict[int, dict[str, float]] = {
    1: {
        "friction": 1.12,
        "gain1": 144,
        "gain_slope1": 8.58,
        "pre1": -14.5,
        "stiff1": -48.1,
        "stiff_slope1": 1.07,
        "grip1": 0.248,
        "gain2": 133,
        "gain_slope2": 65.7,
        "pre2": -11.3,
        "stiff2": 36.6,
        "stiff_slope2": 25.3,
        "grip2": 0.258,
        "press3": 9.26,
        "press4": 8.9,
        "damping": 8.47,
        "load_sin": 1.84,
        "load_cos": 3.42,
    },
    2: {
        "friction": 0.0541,
        "gain3": 173,
        "gain_slope3": 89,
        "pre3": -4.62,
        "stiff3": -16.7,
        "stiff_slope3": -10.1,
        "grip3": 0.566,
        "gain4": 67.8,
        "gain_slope4": 42.4,
        "pre4": 21.9,
        "stiff4": 33.7,
        "stiff_slope4": 10.6,
        "grip4": 0.0544,
        "damping": 11.2,
        "load_sin": 1.75,
        "load_cos": -21.4,
    },
    3: {
        "friction": 0.0146,
        "gain5": 329,
        "gain_slope5": -19.8,
        "pre5": -162,
        "stiff5": -87.7,
        "stiff_slope5": -13,
        "grip5": 0.486,
        "gain6": 352,
        "gain_slope6": -55.5,
        "pre6": -161,
        "stiff6": 48.6,
        "stiff_slope6": -29.7,
        "grip6": 0.575,
        "press7": 9.22,
        "press8": 14.5,
        "damping": 5.4,
        "load_sin": 26.3,
        "load_cos": -32.9,
        "stop": -1.61,
        "stop_damping": 48.5,
        "stop_stiffness": 7730,
    },
    4: {
        "friction": 45.6,
        "gain7": 970,
        "gain_slope7": 251,
        "pre7": -367,
        "stiff7": -245,
        "stiff_slope7": -103,
        "grip7": 0.279,
        "gain8": 1050,
        "gain_slope8": -56.7,
        "pre8": -390,
        "stiff8": 213,
        "stiff_slope8": -66.4,
        "grip8": 0.203,
        "press5": 164,
        "press6": 77.4,
        "damping": 35.8,
        "load_sin": -90.8,
        "load_cos": 11.4,
    },
}
"""Where the full fit ended, rounded: a quick fit starts here."""


def joint(j: int) -> pam.Plant:
    """Joint j with its two muscles, the pressures (and those of its neighbours) as inputs."""
    size = CRUDE[j][f"gain{2 * j}"]
    plant = pam.Plant(f"joint{j}", "a joint with an antagonistic pair, in parts of its inertia")
    q = plant.state("q", unit="rad", description="angle")
    w = plant.state("w", unit="rad/s", description="angular velocity")

    def constant(
        name: str, value: float, nominal: float, says: str, unit: str = "1/s2", **limits: float
    ) -> ca.SX:
        return plant.parameter(name, value, nominal=nominal, description=says, unit=unit, **limits)

    tension = []
    friction = constant("friction", 0.03 * size, 10, "dry, without any tension", min=0)
    for k, side in ((2 * j - 1, 1), (2 * j, -1)):
        p = plant.input(f"p{k}", description=f"pressure in muscle {k}, of full scale")
        gain = constant(f"gain{k}", size, 100, "tension per pressure", min=0)
        slope = constant(f"gain_slope{k}", 0.0, 100, "its change with the angle")
        pre = constant(f"pre{k}", 0.0, 100, "tension without pressure")
        linear = constant(f"stiff{k}", -side * size / 10, 100, "its change with the angle")
        square = constant(f"stiff_slope{k}", 0.0, 100, "and with the square of it")
        pull = clamp((gain + slope * q) * p + pre + linear * q + square * q**2, 0.02 * size)
        friction += constant(f"grip{k}", 0.1, 0.1, "friction per tension", "1", min=0, max=1) * pull
        tension.append(plant.output(f"tension{k}", pull, nominal=100))
    for k in NEIGHBOURS[j]:
        p = plant.input(f"p{k}", description=f"pressure in muscle {k} of a neighbouring joint")
        friction += constant(f"press{k}", size / 100, 10, "friction per its pressure", min=0) * p
    damping = constant("damping", 10.0, 10, "viscous", "1/s", min=0, max=200)
    load = constant("load_sin", 0.0, 10, "gravity: of sin(q)") * ca.sin(q)
    load += constant("load_cos", 0.0, 10, "gravity: of cos(q)") * ca.cos(q)
    if j == 3:  # the one joint that the episodes drive against its stop
        depth = clamp(constant("stop", -1.62, 1, "angle of the lower stop", "rad") - q, 0.01)
        loss = constant("stop_damping", 10.0, 10, "of the stop", "1/s", min=0)
        load += constant("stop_stiffness", 5000.0, 1000, "of the stop", min=0) * depth
        load -= loss * w * depth / ca.sqrt(depth**2 + 1e-4)
    plant.der(q, w)
    plant.der(w, tension[0] - tension[1] + load - damping * w - friction * ca.tanh(w / CREEP[j]))
    return plant


# ---- data ----------------------------------------------------------------------------------------
def find_data(given: Path | None = None) -> Path | None:
    """The file that was named, or the one in PAM_OCP_DATA or ../shared/data; None without any."""
    here = globals().get("__file__", sys.argv[0])  # a notebook has no file
    beside = Path(here).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("PAM_OCP_DATA", beside))
    path = given or folder / FILE
    if given is None and not path.exists():
        return None
    return path


def read_arm(path: Path) -> list[pam.Trajectory]:
    """One record for each episode, with the columns q1 .. q4 [rad] and p1 .. p8."""
    columns = {f"p{k}": f"p{k}_norm" for k in range(1, 9)}
    return pam.read_records(path, split="episode", columns=columns)


def synthetic_arm(episodes: int = 64, seconds: float = 1.3) -> list[pam.Trajectory]:
    """The models' own motion under smooth random pressures, with an encoder's noise."""
    random = np.random.default_rng(0)
    t = np.arange(round(seconds * RATE)) / RATE
    records = []
    for _ in range(episodes):
        knots = np.linspace(0, seconds, 7)
        p = {f"p{k}": np.interp(t, knots, random.uniform(0, 1, 7)) for k in range(1, 9)}
        angles = {}
        for j in JOINTS:
            plant = joint(j).with_values(FOUND[j])
            inputs = {v.name: (t, p[v.name]) for v in plant.inputs}
            start = {"q": -0.7 if j in (2, 3) else 0.0}
            run = pam.simulate(plant, inputs, t=t, start=start, interpolation="linear", rtol=1e-5)
            angles[f"q{j}"] = run["q"] + 2e-4 * random.standard_normal(t.size)
        records.append(pam.Trajectory(t, {**angles, **p}))
    return records


def records_of(j: int, arm: list[pam.Trajectory]) -> list[pam.Trajectory]:
    """Records with the variables of joint j's plant."""
    names = [v.name for v in joint(j).inputs]
    return [pam.Trajectory(r.t, {"q": r[f"q{j}"], **{n: r[n] for n in names}}) for r in arm]


# ---- grey box -----------------------------------------------------------------------------------
def fit(j: int, arm: list[pam.Trajectory], full: bool = False, judge: bool = True) -> FreeRunFit:
    """Joint j fitted to the training episodes: polished from values found before, or in full."""
    plant = joint(j).with_values(CRUDE[j] if full else FOUND[j])
    return fit_free_run(
        plant,
        records_of(j, arm[:TRAINING]),
        [v.name for v in plant.parameters],
        horizon=HORIZON,
        every=0.1,
        steps=4,
        evaluations=40 if full else 3,
        judge=judge,
    )


# ---- linear models ------------------------------------------------------------------------------
class ARX:
    """q(k) linear in the past 5 angles and in 5 pressures of each muscle,
    from that at k - lag on.
    """

    def __init__(self, angles: dict[int, tuple[int, ...]], lag: int = 0) -> None:
        """angles : for each joint the joints whose angles and pressures its regression holds."""
        self._seen, self._lag = angles, lag
        self._theta: dict[int, np.ndarray] = {}

    def _regressors(self, j: int, q: np.ndarray, p: np.ndarray, k: int) -> np.ndarray:
        joints = np.array(self._seen[j])
        muscles = np.concatenate([2 * joints - 2, 2 * joints - 1])
        last = k - self._lag + 1
        past = p[np.maximum(np.arange(last - ORDER, last), 0)][:, muscles]
        return np.concatenate([q[k - ORDER : k, joints - 1].ravel(), past.ravel(), [1.0]])

    def fit(self, arm: list[pam.Trajectory]) -> ARX:
        """One-step least squares over all samples of all episodes."""
        data = [_arrays(r) for r in arm]
        for j in JOINTS:
            rows = [self._regressors(j, q, p, k) for q, p in data for k in range(ORDER, len(q))]
            targets = np.concatenate([q[ORDER:, j - 1] for q, _ in data])
            self._theta[j] = np.linalg.lstsq(np.array(rows), targets, rcond=None)[0]
        return self

    def runs(self, arm: list[pam.Trajectory], like: FreeRun) -> np.ndarray:
        """Angles (n, K, 4) along free runs from the same starts."""
        found = []
        for number, start in zip(like.record, like.start, strict=True):
            q, p = _arrays(arm[int(number)])
            first = round(start * RATE)
            q = q.copy()
            for k in range(first + 1, first + 1 + len(like.t)):
                q[k] = [self._theta[j] @ self._regressors(j, q, p, k) for j in JOINTS]
            found.append(q[first + 1 : first + 1 + len(like.t)])
        return np.array(found)


def _arrays(record: pam.Trajectory) -> tuple[np.ndarray, np.ndarray]:
    return record.array([f"q{j}" for j in JOINTS]), record.array([f"p{k}" for k in range(1, 9)])


LINEAR = {
    "ARX(5) own": ({j: (j,) for j in JOINTS}, 0),
    "same, p to k-1": ({j: (j,) for j in JOINTS}, 1),
    "ARX(5) all": (dict.fromkeys(JOINTS, JOINTS), 0),
}


# ---- comparison ---------------------------------------------------------------------------------
@dataclass(frozen=True)
class Comparison:
    """Angles of several models along the same free runs: (n, K, 4) each [rad]."""

    runs: FreeRun
    measured: np.ndarray
    predicted: dict[str, np.ndarray]

    def rmse(self, model: str, runs: np.ndarray | slice = slice(None)) -> np.ndarray:
        """Of each joint, over all samples of all runs, or of some [rad]."""
        error = (self.predicted[model] - self.measured)[runs]
        return np.sqrt(np.mean(error**2, axis=(0, 1)))

    def ratio(self, draws: int = 2000) -> tuple[np.ndarray, np.ndarray]:
        """Grey box against the best linear model of each joint, and its 90 % interval.

        By bootstrap of whole episodes: runs of one episode are not independent.
        """
        best = [min(LINEAR, key=lambda n: self.rmse(n)[i]) for i in range(len(JOINTS))]

        def ratio(runs: np.ndarray) -> list[float]:
            grey = self.rmse("grey box", runs)
            return [grey[i] / self.rmse(n, runs)[i] for i, n in enumerate(best)]

        episodes = [np.nonzero(self.runs.record == r)[0] for r in np.unique(self.runs.record)]
        random = np.random.default_rng(0)
        chosen = random.integers(len(episodes), size=(draws, len(episodes)))
        spread = [ratio(np.concatenate([episodes[i] for i in row])) for row in chosen]
        return np.array(ratio(np.arange(len(self.measured)))), np.percentile(
            spread, (5, 95), axis=0
        )

    def __str__(self) -> str:
        lines = [f"RMSE [rad] of {len(self.measured)} free runs of {HORIZON:g} s, joints 1 to 4"]
        for model in self.predicted:
            lines.append(f"  {model:<16}" + "".join(f"{e:12.4f}" for e in self.rmse(model)))
        ratio, (low, high) = self.ratio()
        lines.append(f"  {'grey/best ARX':<16}" + "".join(f"{r:12.2f}" for r in ratio))
        intervals = "".join(f"{f'{a:.2f}..{b:.2f}':>12}" for a, b in zip(low, high, strict=True))
        return "\n".join([*lines, f"  {'90 % interval':<16}" + intervals])


def compare(arm: list[pam.Trajectory], plants: dict[int, pam.Plant]) -> Comparison:
    """Free runs of all models over the test episodes."""
    trained, unseen = arm[:TRAINING], arm[TRAINING:]
    grey = [
        free_run(plants[j], records_of(j, unseen), horizon=HORIZON, every=EVERY, steps=16)
        for j in JOINTS
    ]
    measured = np.concatenate([g.measured for g in grey], axis=2)
    now = [
        _arrays(unseen[int(r)])[0][round(t * RATE)]
        for r, t in zip(grey[0].record, grey[0].start, strict=True)
    ]
    predicted = {"grey box": np.concatenate([g.predicted for g in grey], axis=2)}
    for name, arguments in LINEAR.items():
        predicted[name] = ARX(*arguments).fit(trained).runs(unseen, grey[0])
    predicted["angle held"] = np.broadcast_to(np.array(now)[:, None, :], measured.shape)
    return Comparison(grey[0], measured, predicted)


def draw(comparison: Comparison, arm: list[pam.Trajectory]) -> Figure:
    """Four test episodes: measured, and the free runs of the grey box and of ARX."""
    import matplotlib.pyplot as plt

    shown = (0, 4, 8, 13)
    figure, axes = plt.subplots(4, len(shown), figsize=(14, 10), sharex=True, layout="constrained")
    for column, episode in enumerate(shown):
        record = arm[TRAINING + episode]
        mine = np.nonzero(comparison.runs.record == episode)[0]
        for j, ax in zip(JOINTS, axes[:, column], strict=True):
            ax.plot(record.t, record[f"q{j}"], "k", lw=1.6, label="measured")
            for model, colour in (("ARX(5) own", "C1"), ("grey box", "C0")):
                for n, i in enumerate(mine):
                    t = comparison.runs.start[i] + comparison.runs.t
                    label = model if n == 0 else None
                    ax.plot(
                        t, comparison.predicted[model][i, :, j - 1], colour, lw=1.2, label=label
                    )
            ax.grid(alpha=0.3)
            if column == 0:
                ax.set_ylabel(f"joint {j} [rad]")
        axes[0, column].set_title(f"episode {TRAINING + episode} (not fitted)")
        axes[-1, column].set_xlabel("t [s]")
    axes[0, 0].legend(loc="best", fontsize=8)
    figure.suptitle("Free runs of 0.5 s from every 0.25 s: only the pressures are given")
    return figure


def main(folder: Path, given: Path | None, full: bool) -> None:
    path = find_data(given)
    if path is None:
        print(f"{FILE} is not here: a synthetic arm takes its place (nothing measured below)")
    arm = synthetic_arm() if path is None else read_arm(path)
    fits = {}
    for j in JOINTS:
        fits[j] = fit(j, arm, full)
        print(fits[j])
        print(f"    halving the step moves it by {fits[j].integration_error['q']:.2g} rad (RMS)\n")
    comparison = compare(arm, {j: f.plant for j, f in fits.items()})
    print(comparison)
    draw(comparison, arm).savefig(folder / "fit_joint.png", dpi=120)


if __name__ == "__main__":
    words = [a for a in sys.argv[1:] if a != "--full"]
    tables = [Path(a) for a in words if a.endswith(".csv")]
    target = Path(next((a for a in words if not a.endswith(".csv")), "fit_joint"))
    target.mkdir(parents=True, exist_ok=True)
    main(target, tables[0] if tables else None, "--full" in sys.argv)

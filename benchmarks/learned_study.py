"""What the physics leaves out, learned from a few records: does it help, and do bands hold?

    python benchmarks/learned_study.py [100] [--seed N] [--table FILE]

A hanging load on a muscle, with random mass, damping, lag and commands, has beside what its model
knows a force of one kind: a spring that hardens, friction of the second power, dry friction, a
force of the pressure, or none. The model's damping and lag are fitted to six records of 3 s of the
position and the pressure, the rest is learned, and six new records judge: the error with what was
learned in parts of that without, and how much of them lies in the 90 % bands. Where nothing is
missing, nothing should be learned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import casadi as ca
import harness
import numpy as np

import pam_ocp as pam
from pam_ocp.fitting import GaussianProcess, Residual, Splines, fit_residual

STEP, DURATION, RECORDS = 0.01, 3.0, 6
NOISE = {"x": 2e-5, "muscle.pressure": 300.0}
Missing = Callable[[ca.SX, ca.SX, ca.SX, float], ca.SX]
KINDS: Mapping[str, Missing] = {
    "hardening spring": lambda x, v, p, size: -size * (x / 0.04) ** 3,
    "quadratic friction": lambda x, v, p, size: -size * v * ca.fabs(v) / 0.04,
    "dry friction": lambda x, v, p, size: -size * ca.tanh(v / 0.01) / 4,
    "force of pressure": lambda x, v, p, size: size * ca.sin(p / 1e5) / 4,
    "none": lambda x, v, p, size: ca.SX(0),
}


def records(plant: pam.Plant, random: np.random.Generator) -> list[pam.Trajectory]:
    """Motions from rest under commands that are held for 0.1 to 0.4 s, as they are measured."""
    names, found = ("muscle.command", *NOISE), []
    t = np.arange(0.0, DURATION + STEP / 2, STEP)
    for _ in range(RECORDS):
        command, first = np.empty(len(t)), 0
        while first < len(t):
            last = first + int(random.integers(10, 40))
            command[first:last], first = random.uniform(2e5, 4.5e5), last
        rest = plant.equilibrium({"muscle.command": command[0]})
        run = pam.simulate(plant, {"muscle.command": command}, t=t, start=rest)
        columns = {n: run[n] + NOISE.get(n, 0.0) * random.standard_normal(len(t)) for n in names}
        variables = [plant.variable(n) for n in names]
        found.append(pam.Trajectory(t, columns, variables, "previous"))
    return found


def judged(kind: str, random: np.random.Generator) -> harness.Row:
    """Whether something was learned, the error of x in parts of that without it, and coverage."""
    mass = random.uniform(5, 20)
    feed = pam.feeds.Regulator(lag=random.uniform(0.03, 0.1))
    load = pam.HangingLoad("DMSP-20-300", mass, damping=random.uniform(60, 200), feed=feed)
    size = random.uniform(0.1, 0.3) * 9.81
    x, v, p = (load.expression(n) for n in ("x", "v", "muscle.pressure"))
    true = load.with_terms(lambda _: {"v": KINDS[kind](x, v, p, size)})
    train, test = records(true, random), records(true, random)
    model = load.with_values({"damping": 120.0, "muscle.lag": 0.06})
    options = {"horizon": 0.5, "every": 0.25, "judge": False}
    fit = pam.fit_free_run(model, train, ["damping", "muscle.lag"], **options)
    shape = (GaussianProcess(), Splines())[int(random.integers(2))]
    lacking = Residual("v", ["x", "v", "muscle.pressure"], shape)
    learned = fit_residual(fit, lacking, folds=3)
    band = learned.predict(test)
    ratio = band.run.rmse["x"] / fit.validate(test).rmse["x"]
    found = {"kind": kind, "learned": learned.strength is not None, "ratio": ratio}
    text = f"{kind}, {type(shape).__name__}: {ratio:.3f} of the error"
    return found | {"coverage": band.coverage["x"], "text": text}


def cases(given: harness.Given) -> harness.Keyed:
    for number in harness.numbers(given):
        random = np.random.default_rng([given.seed, number])
        kind = list(KINDS)[number % len(KINDS)]
        yield number, partial(judged, kind, random)


def summary(rows: Sequence[harness.Row]) -> str:
    lines = []
    for kind in KINDS:
        own = [r for r in rows if r.get("kind") == kind]
        if own:
            learned, ratios, bands = np.array(
                [(r["learned"], r["ratio"], r["coverage"]) for r in own], float
            ).T
            lines.append(
                f"{kind:<20} learned in {learned.mean():.0%} of {len(own)}, median "
                f"{np.median(ratios):.3f} of the error, worst {ratios.max():.3f}; 90 % bands hold "
                f"{bands.mean():.1%}"
            )
    return "\n".join(lines)


if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=100)

"""Does a dynamic fit say when its model is inadequate, and do its intervals hold the truth?

    python benchmarks/adequacy_study.py [300] [--seed N] [--fault NAME ...]

Random rigs (hanging loads, slides, joints, springs over a muscle; catalogue muscles, masses, lags,
damping, noise, excitation, what is measured, what is free, which fit) with one of eight faults in
turn: none; a floor of the force sensor; drift of a gain; friction; hysteresis; the scale of a
sensor; coloured noise; a lag or dead time. The fitted model knows of none of them. A fault is as
large as asked for only if it counts: it changes what is measured by more than its noise. So does
whatever is free, if it changes by a tenth: of a slack pair of muscles no fit tells anything.

Printed: each rig with what was said of it, then by fault how often the model was called inadequate
and how often the cause was named rightly; and how many of the parameters lie within their 95 %
intervals where nothing was named.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import harness
import numpy as np

import pam_ocp as pam

F, L = pam.feeds, pam.losses
SAMPLE = 0.01
FAULTS = {
    "none": "",
    "floor": "floor",
    "drift": "drift",
    "friction": "friction or hysteresis",
    "hysteresis": "friction or hysteresis",
    "scale": "scale",
    "coloured noise": "coloured noise",
    "lag": "lag",
}
MUSCLES = ["DMSP-20-200N", "DMSP-20-400N", "DMSP-20-300", "DMSP-10-250", "DMSP-10"]
NOISE = {"m": 2e-5, "rad": 3e-4, "Pa": 600.0, "N": 1.0}
"""Standard deviations of sensors, times a factor from 1/3 to 3."""


@dataclass
class Rig:
    """build : the plant, with more losses. free : {entry: true value}."""

    kind: str
    build: Any
    plant: pam.Plant
    position: str
    free: dict[str, float]
    outputs: list[str]
    noise: dict[str, float]


def drawn_rig(rng: np.random.Generator, fault: str) -> Rig:
    kind = str(rng.choice(["hanging", "slide", "joint", "spring"]))
    muscle, lag = str(rng.choice(MUSCLES)), float(rng.uniform(0.03, 0.12))
    single = kind in ("hanging", "spring")
    feed = F.Regulator(lag) if single else F.PairRegulator(lag, base=float(rng.uniform(2e5, 3e5)))
    damping = float(rng.uniform(40, 150))
    mass = float(rng.uniform(2, 12) if kind == "hanging" else rng.uniform(1, 5))

    stiff, preload = float(rng.uniform(3e3, 8e3)), float(rng.uniform(50, 150))

    def build(losses: Any = ()) -> pam.Plant:
        given = {"feed": feed, "losses": losses}
        if kind == "hanging":
            return pam.HangingLoad(muscle, mass, damping=damping, **given)
        if kind == "slide":
            return pam.AntagonisticSlide(muscle, mass, damping=damping, **given)
        if kind == "joint":
            return pam.AntagonisticJoint(muscle, 0.02 * mass, damping=4e-3 * damping, **given)
        return pam.SpringOverMuscle(muscle, mass, stiff, preload, damping=damping, **given)

    plant = build()
    first = "muscle" if single else "muscle1"
    position = "theta" if kind == "joint" else "x"
    outputs = [position]
    outputs += [f"{first}.pressure"] if rng.random() < 0.5 else []
    outputs += [f"{first}.force"] if fault == "floor" or rng.random() < 0.3 else []
    some = "" if single else "*"
    entries = ["damping", f"muscle{some}.lag", "inertia" if kind == "joint" else "mass"]
    entries += [f"muscle{some}.a2"] if single else ["base_pressure"]
    count = int(rng.integers(2, 4))
    chosen = sorted(rng.choice(entries, count, replace=False).tolist())
    free = {e: float(plant.variable(e.replace("*", "1")).start or 0.0) for e in chosen}
    size = float(3 ** rng.uniform(-1, 1))
    noise = {n: size * NOISE[plant.variable(n).unit] for n in outputs}
    return Rig(kind, build, plant, position, free, outputs, noise)


def excitation(rng: np.random.Generator, rig: Rig) -> list[tuple[Any, dict[str, Any], str]]:
    """(t, inputs, between) of one to three records with 800 to 1500 samples together."""
    total, records = int(rng.integers(800, 1500)), int(rng.integers(1, 4))
    found = []
    low, high = (
        (1.5e5, 5e5)
        if len(rig.plant.inputs) == 1 and rig.kind in ("hanging", "spring")
        else (-1.2e5, 1.2e5)
    )
    (name,) = (v.name for v in rig.plant.inputs)
    for _ in range(records):
        n = total // records
        t, way = SAMPLE * np.arange(n), str(rng.choice(["steps", "lines", "sines"]))
        if way == "steps":
            hold = int(rng.integers(20, 60))
            u = np.repeat(rng.uniform(low, high, n // hold + 1), hold)[:n]
        elif way == "lines":
            knots = max(int(n * SAMPLE * rng.uniform(1.5, 4)), 4)
            u = np.interp(t, np.linspace(0, t[-1], knots), rng.uniform(low, high, knots))
        else:
            w = 2 * np.pi * rng.uniform(0.2, 2.5, 3)
            s = np.sin(np.outer(t, w) + rng.uniform(0, 6, 3)).sum(axis=1) / 3
            u = (low + high) / 2 + (high - low) / 2 * s
        found.append((t, {name: u}, "previous" if way == "steps" else "linear"))
    return found


def with_fault(rng: np.random.Generator, rig: Rig, fault: str) -> tuple[list[pam.Trajectory], bool]:
    """The records, and whether the fault and what is free change them by more than their noise."""
    signals = excitation(rng, rig)
    strong = rng.uniform(0.5, 1.0)
    losses: Any = ()
    if fault == "friction":
        losses = L.CoulombFriction(25.0 * strong, speed=5e-3)
    if fault == "hysteresis":
        losses = L.BoucWen(30.0 * strong, float(rng.uniform(0.002, 0.01)))
    true = rig.build(losses)
    late, target = int(rng.integers(1, 5)), str(rng.choice(rig.outputs))
    by_input, rho = bool(rng.random() < 0.5), float(rng.uniform(0.6, 0.95))
    ends = np.cumsum([0.0, *(t[-1] for t, _, _ in signals)])
    level = float(rng.uniform(0.08, 0.3))
    shown, counts, seen = [], False, dict.fromkeys(rig.free, 0.0)
    for k, (t, inputs, between) in enumerate(signals):
        clock = (ends[k] + t) / ends[-1]
        (name, u), *_ = inputs.items()
        acting = u
        if fault == "drift" and by_input:
            acting = u * (1 + 0.12 * strong * clock)
        if fault == "lag":
            acting = np.concatenate([np.full(late, u[0]), u[:-late]])
        plain, other = (motion(p, name, a, t, between) for p, a in ((rig.plant, u), (true, acting)))
        for entry, value in rig.free.items():
            changed = motion(with_entries(rig.plant, {entry: 1.1 * value}), name, u, t, between)
            moved = [np.std(changed[n] - plain[n]) / rig.noise[n] for n in rig.outputs]
            seen[entry] = max(seen[entry], *moved)
        columns: dict[str, Any] = {name: u}
        for n in rig.outputs:
            y = other[n].copy()
            if fault == "drift" and not by_input and n == target:
                y *= 1 + 0.12 * strong * clock
            if fault == "scale" and n == target:
                y *= 1 + 0.05 * strong
            if fault == "floor" and n.endswith("force"):
                y = np.maximum(y, np.quantile(y, level))
            counts |= bool(np.std(y - plain[n]) > rig.noise[n])
            e = rng.standard_normal(len(t))
            if fault == "coloured noise":
                for i in range(1, len(t)):
                    e[i] = rho * e[i - 1] + np.sqrt(1 - rho**2) * e[i]
            columns[n] = y + rig.noise[n] * e
        variables = [rig.plant.variable(n) for n in columns]
        shown.append(pam.Trajectory(t, columns, variables, between))
    counts |= fault in ("none", "coloured noise")
    return shown, counts and min(seen.values()) > 1.0


def with_entries(plant: pam.Plant, values: dict[str, float]) -> pam.Plant:
    """A pattern stands for both muscles."""
    return plant.with_values(
        {
            p: v
            for e, v in values.items()
            for p in ([e] if "*" not in e else [e.replace("*", i) for i in "12"])
        }
    )


def motion(plant: pam.Plant, name: str, u: Any, t: Any, between: Any) -> pam.Trajectory:
    start = plant.equilibrium({name: float(u[0])})
    values = {v.name: float(start[v.name]) for v in plant.states}
    return pam.simulate(plant, {name: u}, t=t, start=values, interpolation=between, rtol=1e-9)


def fitted(rng: np.random.Generator, rig: Rig, records: list[pam.Trajectory]) -> tuple[str, Any]:
    off = {e: v * float(rng.uniform(0.8, 1.25)) for e, v in rig.free.items()}
    start = with_entries(rig.plant, off)
    way = str(rng.choice(["whole", "whole", "horizon", "plant"]))
    if way == "plant":
        limit = 40.0  # kinks of a slack muscle can make a collocation crawl
        return way, pam.fit_plant(
            start, records, list(rig.free), outputs=rig.outputs, time_limit=limit
        )
    given = {"horizon": None} if way == "whole" else {"horizon": 0.4, "every": 0.2}
    return way, pam.fit_free_run(start, records, list(rig.free), outputs=rig.outputs, **given)


def one(seed: int, k: int, fault: str) -> harness.Row:
    for tries in range(20):
        rng = np.random.default_rng([seed, k, tries])
        try:
            rig = drawn_rig(rng, fault)
            records, counts = with_fault(rng, rig, fault)
        except pam.PamError:
            continue  # a load that this muscle does not hold
        if counts:
            break
    else:
        return {"verdict": "no rig"}
    way, fit = fitted(rng, rig, records)
    a = fit.adequacy
    inside = {}
    for entry, true in rig.free.items():
        name = next(
            n for n in fit.coefficients if entry in (n, n.split(" = ")[0].replace("1", "*"))
        )
        low, high = fit.interval(name)
        inside[entry] = bool(low <= true <= high)
    cause = a.cause or ("not tested" if a.untested else "")
    outside = [n for n, i in inside.items() if not i]
    alarm = bool(cause) != (fault != "none")
    mark = "" if cause == FAULTS[fault] else " <<<" if alarm else " <"
    return {
        "fault": fault,
        "cause": cause,
        "tested": bool(a.tests),
        "inside": inside,
        "way": way,
        "text": f"{fault:<15} -> {cause or 'adequate'}{mark} {rig.kind}, {way}, "
        f"{', '.join(rig.outputs)}; free {', '.join(rig.free)}; excess {a.excess:.2g}"
        + (f"; outside: {', '.join(outside)}" if outside else "")
        + ("" if a.tests else "; NOT TESTED"),
    }


def cases(given: harness.Given) -> harness.Keyed:
    for k in harness.numbers(given):
        yield k, partial(one, given.seed, k, given.fault[k % len(given.fault)])


def summary(rows: list[harness.Row]) -> str:
    found = [r for r in rows if "fault" in r]
    lines = []
    for fault in FAULTS:
        some = [r for r in found if r["fault"] == fault]
        if some:
            rejected = sum(bool(r["cause"]) and r["tested"] for r in some)
            right = sum(r["cause"] == FAULTS[fault] for r in some)
            lines.append([fault, len(some), rejected, right])
    parts = [harness.table(("fault", "rigs", "inadequate", "cause named"), lines)]
    faulty = [bool(r["cause"]) and r["tested"] for r in found if r["fault"] != "none"]
    clean = [bool(r["cause"]) for r in found if r["fault"] == "none"]
    parts.append(f"inadequacy found in {harness.share(faulty):.1f} %")
    parts.append(f"false alarms {harness.share(clean):.1f} %")
    for label, some in (
        ("no inadequacy named", [r for r in found if not r["cause"]]),
        ("coloured noise", [r for r in found if r["fault"] == "coloured noise"]),
    ):
        for way in ("all", "whole", "horizon", "plant"):
            held = [i for r in some if way in ("all", r["way"]) for i in r["inside"].values()]
            if held:
                count = f"{sum(held)} of {len(held)} ({harness.share(held):.1f} %)"
                parts.append(f"within 95 % intervals, {label}, {way}: {count}")
    return "\n".join(parts)


OPTIONS = {"--fault": {"choices": list(FAULTS), "nargs": "+", "default": list(FAULTS)}}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=300, options=OPTIONS)

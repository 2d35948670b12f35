"""Rest of plants whose muscles have memory: found, in balance, staying, and held by LQR and Mpc.

Random cases over all arrangements, feeds and losses that are well-posed by construction: SciPy
finds on the force laws alone, with the friction that the chosen memory keeps, pressures inside
their range under which all muscles are taut. Each is asked for by position, by position and
stiffness, or by pressures; for a memory that is virgin, from above, from below, or given. What is
found must balance by hand-written equations, and ``simulate`` must stay there for 1 s.

    python benchmarks/rest_study.py [cases] [seed] [--controlled 10]

--controlled: for so many cases more, how far from the set point LQR with integral action and a
Kalman filter, and an Mpc, end, and whether a motion is planned from there.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import harness
import numpy as np
from scipy.optimize import brentq

import pam_ocp as pam

GRAVITY = 9.80665
MUSCLES = ("DMSP-20-200N", "DMSP-20-400N", "DMSP-20-300", "DMSP-10-250")
FEEDS = {
    "ideal": pam.feeds.IdealPressure(),
    "regulator": pam.feeds.Regulator(0.06),
    "spool": pam.feeds.SpoolValve(),
    "spool and tube": pam.feeds.SpoolValve(tube=pam.feeds.Tube(), leak=1e-10),
    "on-off": pam.feeds.OnOffValves(),
}
LOSSES = {
    "none": (),
    "creep": (pam.losses.Creep(),),
    "dry friction": (pam.losses.CoulombFriction(12.0),),
    "bouc-wen": (pam.losses.BoucWen(),),
    "maxwell-slip": (pam.losses.MaxwellSlip(),),
    "all memories": (
        pam.losses.BoucWen(8.0, 0.01),
        pam.losses.MaxwellSlip((5.0, 3.0), (0.002, 0.01)),
        pam.losses.Creep(),
    ),
}
MEMORIES = ("virgin", "above", "below", "given")
KINDS = ("hanging", "spring", "series", "slide", "joint")
FIGURES = ("missed", "moved")
TAUT = 15.0
"""Least tension [N] of a muscle of a well-posed case, and least distance from the largest pressure
[%].
"""


@dataclass
class Case:
    """What rests: hand-written equations are in :meth:`needed` and :meth:`missed`."""

    kind: str
    feed: str
    muscles: tuple[Any, ...]
    mass: float
    position: float
    """As a part of the stroke [0 .. 1] of the first muscle, or of what both muscles allow [-1 ..
    1].
    """
    extra: dict[str, float] = field(default_factory=dict)
    way: str = "position"

    @property
    def pair(self) -> bool:
        return len(self.muscles) == 2

    @property
    def names(self) -> tuple[str, ...]:
        return ("muscle1", "muscle2") if self.pair else ("muscle",)

    def plant(self, losses: tuple[Any, ...]) -> pam.Plant:
        first, last, more = self.muscles[0], self.muscles[-1], self.extra
        common = {"feed": FEEDS[self.feed], "losses": losses}
        if self.kind == "hanging":
            return pam.HangingLoad(first, self.mass, **common)
        if self.kind == "spring":
            spring, slope = (more["spring"], more["preload"]), more["inclination"]
            return pam.SpringOverMuscle(first, self.mass, *spring, inclination=slope, **common)
        if self.kind == "series":
            return pam.SeriesLoad(first, self.mass, more["tendon"], **common)
        damping = pam.losses.ConstantDamping(60.0 if self.kind == "slide" else 1.0)
        common |= {"muscle2": last, "damping": damping}
        if self.kind == "slide":
            return pam.AntagonisticSlide(first, self.mass, more["before"], **common)
        common |= {"moment_arm2": more["arm2"], "link_mass": self.mass, "link_length": 0.2}
        return pam.AntagonisticJoint(first, 0.05, more["arm1"], more["before"], **common)

    # ---- by hand ----------------------------------------------------------------------------
    @property
    def named(self) -> str:
        return "theta" if self.kind == "joint" else "x"

    def reached(self) -> float:
        """The shortening of the (first) muscle, or x or theta [m, rad]."""
        low, high = self.muscles[0].contraction_range
        if not self.pair:
            low = max(low, 0.0)
            return float((low + self.position * (high - low)) * self.muscles[0].rest_length)
        before, ways = self.extra["before"], []
        for m, arm in zip(self.muscles, self.arms, strict=True):
            low, high = m.contraction_range
            ways.append(min(before - low, high - before) * float(m.rest_length) / arm)
        return self.position * min(ways)

    @property
    def arms(self) -> tuple[float, ...]:
        if self.kind == "joint":
            return self.extra["arm1"], self.extra["arm2"]
        return (1.0,) * len(self.muscles)

    def contractions(self, s: float) -> list[float]:
        if not self.pair:
            return [s / float(self.muscles[0].rest_length)]
        return [
            self.extra["before"] + sign * arm * s / float(m.rest_length)
            for m, arm, sign in zip(self.muscles, self.arms, (1, -1), strict=True)
        ]

    def load(self, s: float) -> float:
        """What the muscles' pull must be at s [N, N m]."""
        if self.kind == "spring":
            uphill = self.mass * GRAVITY * np.sin(self.extra["inclination"])
            return float(self.extra["preload"] + self.extra["spring"] * s + uphill)
        if self.kind == "slide":
            return 0.0
        if self.kind == "joint":
            return float(self.mass * GRAVITY * 0.2 * np.sin(s))
        return self.mass * GRAVITY

    def pull(self, s: float, pressures: list[float], friction: list[float]) -> float:
        """Of the muscles at s, less the friction against their contraction."""
        pulls = [
            arm * max(float(m.tension(p, k)) - f, 0.0)
            for m, arm, p, k, f in zip(
                self.muscles, self.arms, pressures, self.contractions(s), friction, strict=True
            )
        ]
        return pulls[0] - pulls[1] if self.pair else pulls[0]

    def pressures(self, friction: list[float]) -> list[float] | None:
        """Pressures at which the position is one of rest, found by SciPy; None when it is none."""
        s = self.reached()
        k = self.contractions(s)
        if not self.pair:
            found = [_balancing(self.muscles[0], k[0], self.load(s) + friction[0])]
        else:
            second = self.extra["pull"]
            first = (self.load(s) + self.arms[1] * second) / self.arms[0]
            each = zip(self.muscles, k, (first, second), friction, strict=True)
            found = [_balancing(m, at, p + f) if p > TAUT else None for m, at, p, f in each]
        return None if None in found else found  # type: ignore[return-value]

    def friction(
        self, memory: str, losses: tuple[Any, ...], values: dict[str, float]
    ) -> list[float]:
        """Of each muscle [N], by the sign in which its contraction changed last."""
        found = []
        for name, sign in zip(self.names, (1, -1), strict=False):
            total = 0.0
            for loss in losses:
                if isinstance(loss, pam.losses.BoucWen):
                    parts = {f"{name}.hysteresis": loss.friction}
                elif isinstance(loss, pam.losses.MaxwellSlip):
                    parts = {f"{name}.slip{j}": f for j, f in enumerate(loss.friction, start=1)}
                else:
                    continue
                slid = {"virgin": 0.0, "above": -1.0, "below": 1.0}.get(memory)
                total += sum(
                    f * (values[n] if slid is None else sign * slid) for n, f in parts.items()
                )
            found.append(total)
        return found


def _balancing(muscle: Any, contraction: float, force: float) -> float | None:
    low, high = muscle.pressure_range
    low, high = max(low, 0.0) + 0.03 * high, 0.97 * high

    def excess(pressure: float) -> float:
        return float(muscle.tension(pressure, contraction)) - force

    if force < 0 or excess(low) > 0 or excess(high) < 0:
        return None
    return float(brentq(excess, low, high, xtol=1e-6))


def random_case(rng: np.random.Generator, kind: str, feed: str) -> Case:
    """A case that is well-posed for every loss and memory of this study."""
    most = max(sum(np.sum(getattr(x, "friction", 0.0)) for x in v) for v in LOSSES.values())
    for _ in range(2000):
        pair = kind in ("slide", "joint")
        muscles = tuple(pam.muscle(str(rng.choice(MUSCLES))) for _ in range(2 if pair else 1))
        if pair and rng.uniform() < 0.4:
            muscles = (muscles[0], muscles[0])
        case = Case(
            kind,
            feed,
            muscles,
            float(rng.uniform(2, 40) if not pair else rng.uniform(0.5, 3)),
            float(rng.uniform(-0.8, 0.8) if pair else rng.uniform(0.05, 0.85)),
            {
                "before": float(rng.uniform(0.08, 0.14)),
                "pull": float(rng.uniform(60, 300)),
                "arm1": float(rng.uniform(0.02, 0.05)),
                "arm2": float(rng.uniform(0.02, 0.05)),
                "spring": float(rng.uniform(1e3, 1e4)),
                "preload": float(rng.uniform(50, 200)),
                "inclination": float(rng.uniform(-1.0, 1.0)),
                "tendon": float(10 ** rng.uniform(4, 6)),
            },
            str(rng.choice(["position", "position and stiffness", "pressure"])),
        )
        ends = [[a, b] for a in (-most, most) for b in (-most, most)]
        found = [case.pressures(f[: len(muscles)]) for f in ends]
        # a leak drains what is above the supply: nothing rests there
        top = 0.97 * getattr(FEEDS[feed], "supply", np.inf)
        if all(found) and all(p < top for pressures in found for p in pressures or []):
            return case
    raise RuntimeError(f"no well-posed case of {kind} with {feed}")


def conditions(case: Case, pressures: list[float]) -> dict[str, float]:
    """As many as inputs, by the case's way of asking."""
    given = {f"{n}.fill": 0.0 for n in case.names if case.feed == "on-off"}
    if case.way == "pressure":
        return given | {f"{n}.pressure": p for n, p in zip(case.names, pressures, strict=True)}
    s = case.reached()
    given[case.named] = s - (case.load(s) / case.extra["tendon"] if case.kind == "series" else 0.0)
    if case.pair and case.way == "position":
        given["muscle2.pressure"] = pressures[1]
    elif case.pair:
        kappa = case.contractions(case.reached())[0]
        given["muscle1.stiffness"] = float(case.muscles[0].stiffness(pressures[0], kappa))
    return given


def resting(case: Case, losses: tuple[Any, ...], memory: str, values: Any = None) -> Any:
    """The plant, the friction of its muscles, and the point of rest that the case asks for."""
    plant, friction = case.plant(losses), case.friction(memory, losses, values or {})
    given = conditions(case, case.pressures(friction) or [])
    return plant, friction, plant.equilibrium(given, memory=values if memory == "given" else memory)


def found(case: Case, name: str, memory: str, values: dict[str, float]) -> harness.Row:
    """The row of a case with one of the losses: the force out of balance at its point of rest, over
    the load, and how far it moves in 1 s beyond what giving up the last 2 % of friction explains.
    """
    losses, missed, moved, why = LOSSES[name], np.nan, np.nan, []
    try:
        plant, friction, point = resting(case, losses, memory, values)
    except pam.PamError as error:
        why = [str(error)]
    else:
        s = point["muscle.shortening" if case.kind == "series" else case.named]
        at = [point[f"{n}.pressure"] for n in case.names]
        size = max(abs(case.load(s)), 50.0 * max(case.arms))
        missed = abs(case.pull(s, at, friction) - case.load(s)) / size
        if point.stability != "unstable":
            edges = any(abs(z) > 0.98 for z in point.memory.values())
            held = sum(np.sum(getattr(loss, "friction", 0.0)) for loss in losses) if edges else 0.0
            lost = 0.02 * sum(case.arms) * held / stiffness(case, s, at, friction)
            moved = max(way_in_a_second(plant, point, case.named) - 2.0 * lost, 0.0)
    return {
        "verdict": "at rest" if missed <= 1e-6 and not moved > 1e-5 else "NOT AT REST",
        "losses": name,
        "found": not why,
        "missed": missed,
        "moved": moved,
        "text": f"{case.kind}, {case.feed}, {memory}, by {case.way}: missed {missed:.1e}, "
        f"moved {moved:.1e}",
        "why": why,
    }


def start_of(plant: pam.Plant, point: Any) -> dict[str, float]:
    return {v.name: float(x) for v, x in zip(plant.states, point.x, strict=True)}


def way_in_a_second(plant: pam.Plant, point: Any, position: str) -> float:
    """The largest way [m, rad] from a point of rest."""
    inputs = {v.name: float(u) for v, u in zip(plant.inputs, point.u, strict=True)}
    run = pam.simulate(plant, inputs, duration=1.0, start=start_of(plant, point))
    return float(np.abs(run[position] - point[position]).max())


def stiffness(case: Case, s: float, pressures: list[float], friction: list[float]) -> float:
    """Of the whole about s, by differences of the hand-written pull."""
    step = 1e-6

    def excess(at: float) -> float:
        return case.pull(at, pressures, friction) - case.load(at)

    return abs(excess(s + step) - excess(s - step)) / (2 * step)


def controlled(case: Case, losses: tuple[Any, ...], memory: str) -> tuple[float, float, int]:
    """Distance from the set point behind 3 s, as a part of the stroke: of lqr with integral action
    and a Kalman filter started 2 % of the stroke away, of an Mpc; and how often the Mpc failed.
    """
    plant, _, point = resting(case, losses, memory)
    x = plant.variable(case.named)
    stroke = x.max - x.min
    feedback = pam.lqr(plant, point, integral={case.named: 30.0}, sample_time=2e-3)
    pam.control.kalman(plant, point, measured={case.named: 1e-5})
    goal = point[case.named]
    away = float(np.clip(goal + 0.02 * stroke, x.min, x.max))
    start = start_of(plant, point) | {case.named: away}
    if case.kind == "series":
        start["muscle.shortening"] += away - goal
    run = pam.closed_loop(feedback, plant, duration=3.0, sample_time=2e-3, start=start)
    left = abs(run[case.named][-1] - goal) / stroke
    rate, track = {v.name: 0.02 for v in plant.inputs}, {case.named: 10.0}
    ask = {"horizon": 25, "sample_time": 0.02, "method": "rosenbrock"}
    mpc = pam.Mpc(plant, track=track, rate=rate, **ask)
    known = [v for v in map(plant.variable, point.values) if v.causality != "output"]
    within = {v.name: float(np.clip(point[v.name], v.min, v.max)) for v in known}
    loop = mpc.closed_loop(plant, {case.named: away}, 2.0, start=within)
    last = abs(loop.trajectory[case.named][-1] - away) / stroke
    return left, last, mpc.statistics.failures


def planned(case: Case, losses: tuple[Any, ...], memory: str) -> str:
    """The quickest motion from the case's place 3 % of the stroke away, begun with that memory."""
    plant, _, point = resting(case, losses, memory)
    x = plant.variable(case.named)
    goal, stroke = point[case.named], x.max - x.min
    away = goal + 0.03 * stroke if goal + 0.03 * stroke < x.max else goal - 0.03 * stroke
    plan = pam.plan(plant, [{case.named: goal}, {case.named: away}], memory=memory)
    began = {n: plan.trajectory[n][0] for n in point.memory}
    same = all(abs(value - point.memory[n]) < 1e-6 for n, value in began.items())
    words = "verified" if plan.verified else f"NOT VERIFIED {plan.verdict}"
    return f"{words} {plan.duration:.3f} s, memory {'as asked' if same else 'OTHER'}"


def closed(case: Case, name: str, memory: str) -> harness.Row:
    """The row of a case that is controlled, and planned from."""
    left, last, failed = controlled(case, LOSSES[name], memory)
    text = f"{name}, {memory}: LQR {100 * left:.3f} %, Mpc {100 * last:.3f} % of the stroke away"
    text += f", {failed} failures of Mpc; plan {planned(case, LOSSES[name], memory)}"
    return {"left": left, "last": last, "text": text}


def cases(given: harness.Given) -> harness.Keyed:
    """``count`` cases, each with every loss, memories in turn; then those that are controlled."""
    rng = np.random.default_rng(given.seed)
    for i in range(given.count):
        feed = list(FEEDS)[(i // len(KINDS)) % len(FEEDS)]
        case = random_case(rng, KINDS[i % len(KINDS)], feed)
        memory = MEMORIES[(i // 2) % len(MEMORIES)]
        for name, losses in LOSSES.items():
            held = [v.name for v in case.plant(losses).states if v.memory == "held"]
            values = {n: float(rng.uniform(-1, 1)) for n in held}
            yield f"{i} {name}", partial(found, case, name, memory, values)
    rng = np.random.default_rng(given.seed + 1000)
    for i in range(given.controlled):
        name = ("bouc-wen", "maxwell-slip", "all memories")[i % 3]
        case = random_case(rng, KINDS[i % len(KINDS)], "regulator")
        yield f"controlled {i} {case.kind}", partial(closed, case, name, MEMORIES[i % 3])


def summary(rows: list[harness.Row]) -> str:
    lines = []
    for name in LOSSES:
        some = [r for r in rows if r.get("losses") == name]
        if some:
            worst = [max((r[k] for r in some if r[k] == r[k]), default=np.nan) for k in FIGURES]
            lines.append([name, len(some), sum(r["found"] for r in some), *worst])
    text = harness.table(("losses", "cases", "found", "out of balance", "moves in 1 s"), lines)
    loops = [r for r in rows if "left" in r]
    if loops:
        away = [100 * max(r[k] for r in loops) for k in ("left", "last")]
        text += f"\nat most away, % of the stroke: LQR {away[0]:.3f}, Mpc {away[1]:.3f}"
    return text


OPTIONS = {"--controlled": {"type": int, "default": 10, "help": "cases of closed loops"}}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=60, seed=1, options=OPTIONS)

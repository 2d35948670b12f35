"""What must vanish at rest, found by the library, against what is known by construction.

Catalogue: muscles, pre-contractions, feeds and arrangements: rate and acceleration of the load (and
of the muscle's end, where a tendon lies between them) must vanish.

Own plants: random systems of parts whose conditions of rest are written beside their equations:
two actuators that can only push beyond a dead band, behind pressures or not; velocities in other
units, momenta, sums of two, functions; wheels and cams that count a motion; chains of masses;
positions that an input drives; a load on a driven base; spools with overlap; sensors; totals;
states whose rate is a constant. States are declared in random order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from typing import Any

import casadi as ca
import numpy as np

import pam_ocp as pam
from pam_ocp.plants.stillness import rest_rows

Rows = list[tuple[str, int]]
FEEDS: dict[str, Callable[[], Any]] = {
    "ideal": pam.feeds.IdealPressure,
    "regulator": pam.feeds.Regulator,
    "spool": pam.feeds.SpoolValve,
    "on-off": pam.feeds.OnOffValves,
}


# ---- catalogue ------------------------------------------------------------------------------
def muscles() -> dict[str, Any]:
    """All of the catalogue; 0.25 m long where it gives no length."""
    found = {}
    for name in pam.muscles.muscle_names():
        try:
            found[name] = pam.muscle(name)
        except pam.InputError:
            found[name] = pam.muscle(name, rest_length=0.25)
    return found


def catalogue() -> Iterator[tuple[str, Callable[[], pam.Plant], Rows]]:
    """(words, what makes the plant, its rows of rest) of every muscle in pairs and alone."""
    for (name, muscle), (fed, feed) in product(muscles().items(), FEEDS.items()):
        if muscle.diameter is None and fed in ("spool", "on-off"):
            continue
        low, high = muscle.contraction_range
        for part in (0.1, 0.25, 0.4, 0.6, 0.8):
            before = low + part * (high - low)
            words = f"{name}, {before:.3f}, {fed}"
            slide = partial(pam.AntagonisticSlide, muscle, 2.0, before, damping=20.0, feed=feed())
            yield f"{words}, slide", slide, both("x")
            joint = partial(pam.AntagonisticJoint, muscle, 0.05, 0.03, before, feed=feed())
            yield f"{words}, joint", joint, both("theta")
        words = f"{name}, {fed}"
        yield f"{words}, hanging", partial(pam.HangingLoad, muscle, 10.0, feed=feed()), both("x")
        over = partial(pam.SpringOverMuscle, muscle, 2.0, 500.0, 50.0, feed=feed())
        yield f"{words}, spring over muscle", over, both("x")
        series = partial(pam.SeriesLoad, muscle, 10.0, feed=feed())
        yield f"{words}, series", series, both("x") + both("muscle.shortening")


def both(position: str) -> Rows:
    return [(position, 1), (position, 2)]


# ---- own plants -----------------------------------------------------------------------------
@dataclass
class Draft:
    """Parts of a plant to be: states with the equations of their rates, and what must vanish."""

    rng: np.random.Generator
    states: list[tuple[str, str, dict[str, Any]]] = field(default_factory=list)
    rates: dict[str, Callable[[dict[str, ca.SX]], Any]] = field(default_factory=dict)
    inputs: list[tuple[str, float, float]] = field(default_factory=list)
    groups: list[tuple[list[str], tuple[int, ...]]] = field(default_factory=list)
    """Positions that count one motion, and the orders in which it must vanish: asked once, of the
    first that is declared.
    """
    stops: dict[str, tuple[float, float]] = field(default_factory=dict)

    def state(self, name: str, unit: str, rate: Callable[[dict[str, ca.SX]], Any], **more: Any):
        self.states.append((name, unit, more))
        self.rates[name] = rate

    def built(self, name: str) -> tuple[pam.Plant, Rows]:
        plant, symbols = pam.Plant(name), {}
        order = [self.states[i] for i in self.rng.permutation(len(self.states))]
        for state, unit, more in order:
            symbols[state] = plant.state(state, unit=unit, **more)
        for control, low, high in self.inputs:
            symbols[control] = plant.input(control, min=low, max=high)
        for state, rate in self.rates.items():
            plant.der(symbols[state], rate(symbols))
        place = {state: i for i, (state, _, _) in enumerate(order)}
        asked = [(min(g, key=place.__getitem__), orders) for g, orders in self.groups]
        asked.sort(key=lambda each: place[each[0]])
        return plant, [(position, order) for position, orders in asked for order in orders]


def beyond(value: ca.SX, band: float, rounded: float) -> ca.SX:
    """max(value - band, 0); with rounded edges where ``rounded`` > 0."""
    if not rounded:
        return ca.fmax(value - band, 0.0)
    return (value - band + ca.sqrt((value - band) ** 2 + rounded**2) - rounded) / 2


def velocity(draft: Draft, k: int, force: Callable[[dict[str, ca.SX]], Any], mass: float):
    """States that carry the velocity of motion k, in some coordinates; returns the velocity."""
    kind = draft.rng.choice(["literal", "millimetres", "momentum", "sum", "function"])
    v = f"v{k}"
    if kind == "literal":
        draft.state(v, "m/s", lambda s: force(s) / mass, nominal=0.5)
        return lambda s: s[v]
    if kind == "millimetres":
        draft.state(v, "m/s", lambda s: 1e3 * force(s) / mass, nominal=500.0)
        return lambda s: 1e-3 * s[v]
    if kind == "momentum":
        draft.state(v, "kg.m/s", force)
        return lambda s: s[v] / mass
    if kind == "sum":
        draft.state(v, "m/s", lambda s: 0.3 * force(s) / mass, nominal=0.5)
        draft.state(f"w{k}", "m/s", lambda s: 0.7 * force(s) / mass, nominal=0.5)
        return lambda s: s[v] + s[f"w{k}"]
    draft.state(v, "m/s", lambda s: force(s) / mass / ca.cosh(s[v]), nominal=0.5)
    return lambda s: ca.sinh(s[v])


def moved_by_pushers(draft: Draft, k: int) -> None:
    """A mass between two actuators that only push beyond a dead band; counted by others, too."""
    rng = draft.rng
    band, rounded, mass = rng.uniform(0.05, 0.8), rng.choice([0.0, 1e-3]), rng.uniform(0.5, 5.0)
    damping, spring = rng.choice([0.0, 3.0]), rng.choice([0.0, 20.0])
    lagging, dry = rng.random() < 0.6, rng.choice([0.0, 0.5])
    sources = [f"u{k}a", f"u{k}b"]
    draft.inputs += [(u, 0.0, 1.0) for u in sources]
    x = f"x{k}"
    if lagging:
        for u in list(sources):
            p, lag = u.replace("u", "p"), rng.uniform(0.01, 0.1)
            draft.state(p, "1", lambda s, u=u, p=p, t=lag: (s[u] - s[p]) / t, min=0.0, max=1.0)
        sources = [u.replace("u", "p") for u in sources]

    def force(s: dict[str, ca.SX]) -> ca.SX:
        push, pull = (beyond(s[name], band, rounded) for name in sources)
        slowed = damping * speed(s) + dry * ca.tanh(speed(s) / 0.01)
        return 30.0 * (push - pull) - spring * s[x] - slowed

    speed = velocity(draft, k, force, mass)
    draft.state(x, "m", speed, min=-0.5, max=0.5)
    draft.groups.append((counted(draft, k, x, speed), (1, 2)))
    draft.stops[x] = (0.0, 0.1)


def counted(draft: Draft, k: int, x: str, speed: Callable[[dict[str, ca.SX]], Any]) -> list[str]:
    """The positions of one motion: x, a wheel, a cam whose radius changes on the way."""
    names = [x]
    if draft.rng.random() < 0.4:
        draft.state(f"wheel{k}", "rad", lambda s: -20.0 * speed(s), nominal=5.0)
        names.append(f"wheel{k}")
    if draft.rng.random() < 0.3:
        draft.state(f"cam{k}", "m", lambda s: speed(s) * (1.0 + 0.8 * s[x]))
        names.append(f"cam{k}")
    return names


def chain(draft: Draft, k: int) -> None:
    """Masses on springs in a row; one actuator behind a pressure pushes the first."""
    count, band = int(draft.rng.integers(2, 4)), draft.rng.uniform(0.0, 0.5)
    u, p = f"u{k}", f"p{k}"
    draft.inputs.append((u, -1.0, 1.0))
    draft.state(p, "1", lambda s: (s[u] - s[p]) / 0.05, min=-1.0, max=1.0)
    names = [f"q{k}_{i}" for i in range(count)]
    speeds: list[Any] = []

    def force(i: int, s: dict[str, ca.SX]) -> ca.SX:
        q = [s[n] for n in names]
        pull = sum(40.0 * (q[j] - q[i]) for j in (i - 1, i + 1) if 0 <= j < count)
        slowed = sum(2.0 * (speeds[j](s) - speeds[i](s)) for j in (i - 1, i + 1) if 0 <= j < count)
        push = beyond(s[p], band, 0.0) - beyond(-s[p], band, 0.0)
        return pull + slowed + (10.0 * push if i == 0 else 0.0)

    for i, q in enumerate(names):
        speeds.append(velocity(draft, 100 * k + i, lambda s, i=i: force(i, s), 1.0 + i))
        draft.state(q, "m", speeds[i])
        draft.groups.append(([q], (1, 2)))
    draft.stops |= dict.fromkeys(names, (0.0, 0.1))


def driven(draft: Draft, k: int) -> None:
    """x' = u, at times with a dead band, and at times a load on a spring behind it."""
    u, x, band = f"u{k}", f"x{k}", draft.rng.choice([0.0, 0.3])
    draft.inputs.append((u, -1.0, 1.0))
    draft.state(x, "m", lambda s: beyond(s[u], band, 0.0) - beyond(-s[u], band, 0.0))
    draft.groups.append(([x], (1,)))
    draft.stops[x] = (0.0, 0.1)
    if draft.rng.random() < 0.5:
        y, w = f"y{k}", f"w{k}"
        draft.state(y, "m", lambda s: s[w])
        draft.state(w, "m/s", lambda s: 60.0 * (s[x] - s[y]) - 3.0 * s[w])
        draft.groups.append(([y], (1, 2)))
        draft.stops[y] = (0.0, 0.1)


def overlapped(draft: Draft, k: int) -> None:
    """A cylinder behind a spool with overlap: its acceleration may jump at the overlap's ends."""
    u, x, s_name = f"u{k}", f"x{k}", f"s{k}"
    band = draft.rng.uniform(0.1, 0.5)
    draft.inputs.append((u, -1.0, 1.0))
    draft.state(s_name, "1", lambda s: (s[u] - s[s_name]) / 0.02, min=-1.0, max=1.0)
    draft.state(x, "m", lambda s: beyond(s[s_name], band, 0.0) - beyond(-s[s_name], band, 0.0))
    draft.groups.append(([x], (1, 2)))
    draft.stops[x] = (0.0, 0.1)


def beside(draft: Draft) -> None:
    """What asks for nothing: sensors, totals, clocks."""
    x = next(iter(draft.stops))
    if draft.rng.random() < 0.4:
        draft.state("sensor", "m", lambda s: (s[x] - s["sensor"]) / 0.03)
    if draft.rng.random() < 0.4:
        u = draft.inputs[0][0]
        draft.state("air", "kg", lambda s: s[u] ** 2 + 0.1)
    if draft.rng.random() < 0.4:
        rate = draft.rng.choice([0.0, 1.0])
        draft.state("clock", "s", lambda s: rate)


PARTS = (moved_by_pushers, moved_by_pushers, chain, driven, overlapped)


def own_plant(rng: np.random.Generator, number: int) -> tuple[pam.Plant, Rows, Draft]:
    """A random plant of one or two parts, and its rows of rest."""
    draft = Draft(rng)
    parts = [PARTS[number % len(PARTS)]]
    if rng.random() < 0.4:
        parts.append(PARTS[int(rng.integers(len(PARTS)))])
    for k, part in enumerate(parts, start=1):
        part(draft, k)
    beside(draft)
    return *draft.built(f"own{number}." + ".".join(p.__name__ for p in parts)), draft


# ---- what is found --------------------------------------------------------------------------
def found_rows(plant: pam.Plant) -> Rows:
    return [(position.name, order) for position, order, _ in rest_rows(plant, plant.resting())]

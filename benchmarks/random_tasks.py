"""Random planning tasks, of everything that there is, each with its statement in words.

Muscles, arrangements, feeds, supplies, gases, losses, loads, objectives, limits and stops are drawn
independently. Feasible are they by statics alone: at each point between the stops every muscle can
pull with the force that is needed there, whatever its losses do, at a pressure that its feed can
give, with a margin (from the force law, nothing of the planner is asked); the time is free or long.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np
from scipy.optimize import brentq

import pam_ocp as pam
from pam_ocp.muscles.gas import BraidVolume, Gas
from pam_ocp.muscles.heat import ConstantHeatTransfer, PressureHeatTransfer, Rubber

GRAVITY = 9.80665
MARGIN = 0.06
"""Of the pressure range, kept free at the points of rest."""
FREE_LENGTH = (0.15, 0.4)
"""Rest lengths of muscles whose set leaves it open [m]."""
Draw = np.random.Generator


@dataclass
class Task:
    """A plant, the arguments of plan, and the positions that are at rest at the stops: states or
    outputs, named by whoever made the plant.
    """

    words: str
    plant: pam.Plant
    stops: list[Any]
    positions: tuple[str, ...]
    arguments: dict[str, Any] = field(default_factory=dict)

    def __str__(self) -> str:
        shown = {k: v for k, v in self.arguments.items() if v}
        return f"{self.words}; stops {self.stops}, {shown}"


class Infeasible(Exception):
    """Nothing of some size can be asked of what was drawn: another is."""


def chance(rng: Draw, probability: float) -> bool:
    return bool(rng.random() < probability)


def chosen(rng: Draw, choices: dict[Any, float]) -> Any:
    weights = np.array(list(choices.values()), float)
    return list(choices)[int(rng.choice(len(choices), p=weights / weights.sum()))]


def told(*words: str) -> str:
    return ", ".join(w for w in words if w)


# ---- muscles and statics -------------------------------------------------------------------------
def any_muscle(rng: Draw, name: str | None = None) -> pam.Muscle:
    """Of the whole catalogue."""
    name = name or str(rng.choice(pam.muscles.muscle_names()))
    try:
        return pam.muscle(name)
    except pam.InputError:  # its set leaves the length open
        return pam.muscle(name, rest_length=round(float(rng.uniform(*FREE_LENGTH)), 3))


@dataclass(frozen=True)
class Puller:
    """A muscle with the largest pressure that its feed gives and the force that losses may take."""

    muscle: pam.Muscle
    top: float
    lost: float

    def forces(self, contraction: float) -> tuple[float, float]:
        """The least and the largest force to count on, whatever the losses do [N]."""
        low = max(float(self.muscle.pressure_range[0]), 0.0) + MARGIN * self.top
        least, most = (
            float(self.muscle.tension(p, contraction)) for p in (low, self.top * (1 - MARGIN))
        )
        return max(least + self.lost, 2.0 + self.lost), most - self.lost

    def can(self, contraction: float, force: float) -> bool:
        least, most = self.forces(contraction)
        return least < force < most

    def at(self, pressure: float, contraction: float) -> float:
        return float(self.muscle.tension(pressure, contraction))


def longest(grid: np.ndarray, good: list[bool]) -> tuple[float, float]:
    """Ends of the longest run of grid points that are good."""
    best, begin = (0, 0), None
    for i, ok in enumerate([*good, False]):
        if ok and begin is None:
            begin = i
        if not ok and begin is not None:
            best, begin = max(best, (begin, i - 1), key=lambda run: run[1] - run[0]), None
    if best[1] - best[0] < 4:
        raise Infeasible
    return float(grid[best[0]]), float(grid[best[1]])


def two_places(rng: Draw, low: float, high: float) -> tuple[float, float]:
    """Two positions, at least a sixth of the way apart."""
    while True:
        a, b = rng.uniform(low, high, 2)
        if abs(b - a) > (high - low) / 6:
            return float(a), float(b)


# ---- components ----------------------------------------------------------------------------------
def gas(rng: Draw) -> tuple[Gas, str]:
    """Isothermal to adiabatic, or with its own energy, warm walls and surroundings."""
    given: dict[str, Any] = {"dead_volume": rng.uniform(5e-6, 4e-5)}
    if chance(rng, 0.3):
        given["temperature"] = rng.uniform(278.0, 308.0)
    if chance(rng, 0.2):
        given["volume"] = BraidVolume()
    words = ""
    if chance(rng, 0.45):
        value = rng.uniform(10, 150)
        kind = ConstantHeatTransfer if chance(rng, 0.6) else PressureHeatTransfer
        given["heat"], words = kind(value), f"heat {value:.0f} W/m2K"
        if chance(rng, 0.2):
            given["rubber"] = Rubber(rng.uniform(10, 100))
            words += " and rubber"
    else:
        given["exponent"] = rng.uniform(1.0, 1.4)
    return Gas(**given), words


def receiver(rng: Draw, volume: float, top: float) -> tuple[Any, str]:
    """A tank with a compressor, behind a regulator, or that is only emptied."""
    pressure = top + rng.uniform(0.6e5, 2.5e5)
    kind = chosen(rng, {"compressor": 2, "regulated": 2, "tank": 1})
    size = volume * rng.uniform(*((20, 60) if kind == "tank" else (5, 30)))
    source = None
    if kind == "compressor":
        flow, stop = volume * rng.uniform(3, 12), pressure * rng.uniform(1.0, 1.1)
        source = pam.feeds.Compressor(flow, stop)
    elif kind == "regulated":
        source = pam.feeds.PressureRegulator(
            pressure,
            pressure + rng.uniform(1e5, 3e5),
            rng.uniform(3e-9, 3e-8),
            relief=float(rng.choice([0.0, 0.1])),
        )
    wall = rng.uniform(0.1, 3.0) if chance(rng, 0.4) else None
    made = pam.feeds.Receiver(size, pressure, source, wall_conductance=wall)
    return made, f"{1e3 * size:.2g} l {kind}" + (" with heat" if wall else "")


def valve(rng: Draw, muscle: pam.Muscle, top: float) -> tuple[Any, str]:
    """Any valve, with all that may stand around it."""
    volume = np.pi / 4 * float(muscle.diameter) ** 2 * float(muscle.rest_length) * 2.0
    air, gas_words = gas(rng)
    supply, supply_words = top + rng.uniform(0.5e5, 2e5), ""
    if chance(rng, 0.35):
        supply, supply_words = receiver(rng, volume, top)
    given: dict[str, Any] = {"supply": supply, "gas": air, "max_pressure": top}
    words = [gas_words, supply_words]
    if chance(rng, 0.3):
        long = chance(rng, 0.35)
        given["tube"] = (
            pam.feeds.LumpedTube(rng.uniform(0.3, 2.0), 4e-3, int(rng.integers(1, 4)))
            if long
            else pam.feeds.Tube(rng.uniform(3e-6, 3e-5), rng.uniform(2e-3, 2e-2))
        )
        words.append("lumped tube" if long else "tube")
        if chance(rng, 0.35):
            given["quick_exhaust"] = pam.feeds.QuickExhaust()
            words.append("quick exhaust")
    if chance(rng, 0.15) and "tank" not in supply_words:  # which would only run empty
        given["leak"] = volume / (rng.uniform(40, 200) * 1e5)
        words.append("leak")
    kind = chosen(rng, {"spool": 5, "on/off": 3, "servo": 2, "catalogue": 2})
    if kind == "catalogue":
        name = str(rng.choice(pam.feeds.valve_names()))
        return pam.feeds.valve(name, **given), told(name, *words)
    given["conductance"] = volume / (rng.uniform(0.03, 0.4) * 1e5)
    if chance(rng, 0.2):
        given["exhaust_conductance"] = given["conductance"] * rng.uniform(0.5, 1.5)
    if kind == "on/off":
        return pam.feeds.OnOffValves(**given), told("on/off valves", *words)
    given["overlap"] = float(rng.choice([0.0, 0.02, 0.05, 0.1]))
    if chance(rng, 0.3):
        play = rng.uniform(0.005, 0.03) if chance(rng, 0.3) else 0.0
        second = chance(rng, 0.4)
        given["spool"] = (
            pam.feeds.SecondOrderSpool(rng.uniform(20, 90), hysteresis=play)
            if second
            else pam.feeds.FirstOrderSpool(rng.uniform(3e-3, 2e-2), hysteresis=play)
        )
        order = "second" if second else "first"
        words.append(f"spool of {order} order" + " with play" * bool(play))
    if kind == "servo":
        lag = rng.uniform(2e-3, 2e-2) if chance(rng, 0.5) else 0.0
        gain = rng.uniform(0.5e-5, 4e-5)
        made = pam.feeds.ServoValve(**given, pressure_gain=gain, command_lag=lag)
        return made, told("servo valve", *words)
    return pam.feeds.SpoolValve(**given), told("spool valve", *words)


def regulator(rng: Draw, top: float) -> tuple[dict[str, Any], str]:
    """Arguments of a pressure regulator, as rigs have them."""
    given: dict[str, Any] = {"lag": rng.uniform(0.02, 0.15), "max_pressure": top}
    if chance(rng, 0.3):
        given["max_rate"] = rng.uniform(1e6, 6e6)
    if chance(rng, 0.25):
        given["venting_lag"] = given["lag"] * rng.uniform(0.7, 2.0)
    if chance(rng, 0.25):
        given["slew"] = rng.uniform(2e6, 8e6)
    if chance(rng, 0.25):
        order, cells = ((4, 1), (2, 1), (1, 6))[int(rng.integers(3))]
        given["dead_time"] = pam.feeds.DeadTime(rng.uniform(0.005, 0.03), order, cells)
    if chance(rng, 0.2):
        given["gain"] = top / 10.0
    return given, told("regulator", *(k.replace("_", " ") for k in given if k not in ("lag",)))


def feed(rng: Draw, muscle: pam.Muscle, top: float, pair: bool = False) -> tuple[Any, str]:
    """Any feed whose largest pressure is ``top``."""
    kinds = {"regulator": 4, "valve": 5, "ideal": 1, "pair": 2 if pair else 0}
    kind = chosen(rng, kinds)
    if kind == "valve" and muscle.diameter is None:
        kind = "regulator"
    if kind == "ideal":
        return pam.feeds.IdealPressure(top), "pressure itself"
    if kind == "valve":
        return valve(rng, muscle, top)
    given, words = regulator(rng, top)
    if kind == "pair":
        given.pop("gain", None)
        base = top * rng.uniform(0.4, 0.6)
        return pam.feeds.PairRegulator(**given, base=base), f"pair {words}"
    return pam.feeds.Regulator(**given), words


def one_loss(rng: Draw, kind: str, top: float, size: float) -> tuple[Any, float]:
    """(a loss, the largest force that it can take at rest or slowly [N]); size : typical [N]."""
    friction, losses = size * rng.uniform(0.01, 0.06), pam.losses
    scale = rng.uniform(5e-7, 3e-6) if chance(rng, 0.25) else 0.0
    grown = friction * (1 + scale * top)
    parts = friction * np.array([0.3, 0.3, 0.2, 0.2])
    stiffness = size * rng.uniform(0.2, 1.5)
    made: dict[str, Callable[[], tuple[Any, float]]] = {
        "Coulomb": lambda: (losses.CoulombFriction(friction, excess=0.3), 1.3 * friction),
        "Bouc-Wen": lambda: (
            losses.BoucWen(friction, rng.uniform(0.003, 0.01), per_pressure=scale),
            grown,
        ),
        "Maxwell-slip": lambda: (losses.MaxwellSlip(tuple(parts), per_pressure=scale), grown),
        "Prandtl-Ishlinskii": lambda: (
            losses.PrandtlIshlinskii(
                (0.5 * friction, 0.4 * friction), (0.4 * friction, 0.3 * friction)
            ),
            1.5 * friction,
        ),
        "creep": lambda: (losses.Creep((stiffness,), (rng.uniform(0.2, 3.0),)), 0.25 * stiffness),
        "creep under load": lambda: (
            losses.LoadCreep((stiffness,), (rng.uniform(0.3, 3.0),)),
            0.25 * stiffness,
        ),
        "preconditioning": lambda: (losses.Preconditioning(0.5 * stiffness), 0.13 * stiffness),
        "strands": lambda: (losses.StrandFriction(0.2, diameter=0.02), 4e-5 * top),
        "directional damping": lambda: (
            losses.DirectionalDamping([(200.0, 2e-4)], [(100.0, 1e-4)]),
            0.0,
        ),
        "force-velocity": lambda: (losses.ForceVelocity(0.5 * friction, 2e-5), 0.2 * friction),
    }
    return made[kind]()


LOSSES = (
    "Coulomb", "Bouc-Wen", "Maxwell-slip", "Prandtl-Ishlinskii", "creep", "creep under load",
    "preconditioning", "strands", "directional damping", "force-velocity",
)  # fmt: skip


def losses(rng: Draw, top: float, size: float) -> tuple[tuple[Any, ...], float, str]:
    """None, one or two: (losses, largest force [N], words)."""
    count = chosen(rng, {0: 4, 1: 5, 2: 1})
    kinds = [str(k) for k in rng.choice(LOSSES, count, replace=False)]
    made = [one_loss(rng, kind, top, size) for kind in kinds]
    return tuple(loss for loss, _ in made), sum(lost for _, lost in made), told(*kinds)


@dataclass(frozen=True)
class Loads:
    """Loads, the force that they need from the muscles at a position, and friction about it."""

    made: tuple[Any, ...] = ()
    need: Callable[[float], float] = lambda s: 0.0
    dry: float = 0.0
    words: str = ""

    @property
    def symmetric(self) -> bool:
        return not any(w in self.words for w in ("external", "wall"))


def loads(rng: Draw, force: float, reach: float) -> Loads:
    """For forces of a size [N or N m] along a position of a size [m or rad]."""
    kinds = ("spring", "damper", "friction", "inertia", "external", "wall")
    kind = chosen(rng, {"": 5, **dict.fromkeys(kinds, 1)})
    stiffness, value = force / reach * rng.uniform(0.02, 0.15), force * rng.uniform(-0.1, 0.1)
    dry, place = force * rng.uniform(0.005, 0.03), reach * rng.uniform(0.3, 0.9)
    hard = force / reach * rng.uniform(0.2, 2.0)
    one = pam.loads
    if kind == "spring":
        return Loads((one.Spring(stiffness),), lambda s: stiffness * s, 0.0, kind)
    if kind == "damper":
        return Loads((one.Damper(force / reach * rng.uniform(1e-3, 2e-2)),), words=kind)
    if kind == "friction":
        return Loads((one.DryFriction(dry, reach * rng.uniform(0.01, 0.05)),), dry=dry, words=kind)
    if kind == "inertia":
        return Loads((one.Inertia(force / reach * rng.uniform(2e-5, 3e-4)),), words=kind)
    if kind == "external":
        return Loads((one.ExternalForce(start=value),), lambda s: -value, 0.0, "external force")
    if kind == "wall":
        made = one.Wall(place, hard, 1e-3 * hard, 1, 0.01 * force)
        return Loads((made,), lambda s: hard * max(s - place, 0.0), 0.0, kind)
    return Loads()


# ---- arrangements --------------------------------------------------------------------------------
@dataclass(frozen=True)
class Made:
    """A plant with a position in a feasible range; others are at rest with it."""

    words: str
    plant: pam.Plant
    name: str
    range: tuple[float, float]
    positions: tuple[str, ...]
    symmetric: bool = False


def sized(muscle: pam.Muscle, top: float) -> float:
    """The force of a muscle in the middle of its stroke at its largest pressure [N]."""
    return float(muscle.tension(top, 0.4 * muscle.contraction_range[1]))


def top_of(rng: Draw, *muscles: pam.Muscle) -> float:
    """A largest pressure that all of them stand [Pa]."""
    top = min(float(m.pressure_range[1]) for m in muscles)
    return top if chance(rng, 0.6) else top * rng.uniform(0.8, 1.0)


def single(rng: Draw) -> Made:
    """One muscle: a hanging load, one on a slope, on a spring, on a tendon, or regulated."""
    muscle = any_muscle(rng)
    top = top_of(rng, muscle)
    size, length = sized(muscle, top), float(muscle.rest_length)
    lossy, lost, loss_words = losses(rng, top, size)
    kind = chosen(rng, {"hanging": 4, "slope": 1, "spring": 2, "tendon": 2, "regulated": 1})
    load = loads(rng, size, 0.2 * length) if kind != "regulated" else Loads()
    mass = size / GRAVITY * rng.uniform(0.08, 0.5)
    fed, feed_words = feed(rng, muscle, top)
    common: dict[str, Any] = {"feed": fed, "losses": lossy, "loads": load.made}
    weight, stretch, name, positions = mass * GRAVITY, 0.0, "x", ("x",)
    if kind == "hanging":
        plant = pam.HangingLoad(muscle, mass, **common)
    elif kind == "slope":
        slope = rng.uniform(0.3, 1.2)
        weight *= np.sin(slope)
        plant = pam.HangingLoad(muscle, mass, inclination=slope, **common)
    elif kind == "spring":
        stiffness, preload = size / length * rng.uniform(0.5, 3), size * rng.uniform(0.03, 0.2)
        mass *= 0.3
        plant = pam.SpringOverMuscle(muscle, mass, stiffness, preload, **common)
        need = lambda s, n=load.need: n(s) + preload + stiffness * s  # noqa: E731
        load, weight = Loads(load.made, need, load.dry, load.words), 0.0
    elif kind == "tendon":
        tendon = size / length * rng.uniform(20, 200)
        stretch = weight / tendon
        plant = pam.SeriesLoad(muscle, mass, tendon, **common)
        positions = tuple(plant.load_positions)
    else:
        feed_words = "position feedback"
        gain, lag = top / length * rng.uniform(0.3, 2), rng.uniform(0.05, 0.15)
        given = {"gain": gain, "lag": lag, "max_pressure": top, "losses": lossy}
        plant = pam.RegulatedLoad(muscle, mass, **given)
    puller = Puller(muscle, top, lost + load.dry)
    grid = np.linspace(0.0, 0.95 * muscle.contraction_range[1] * length, 60)
    good = [puller.can((s + stretch) / length, weight + load.need(s)) for s in grid]
    words = told(f"{muscle.name}", f"{mass:.1f} kg {kind}", feed_words, loss_words, load.words)
    return Made(words, plant, name, longest(grid, good), positions)


def pair_can(
    first: Puller, second: Puller, kappas: tuple[float, float], need: float, ratio: float, fed: Any
) -> bool:
    """Whether two muscles can hold ``need`` [N at the first], ratio : of the second's arm to the
    first's.
    """
    if isinstance(fed, pam.feeds.PairRegulator):
        reach = 0.9 * min(fed.base, first.top - fed.base)

        def net(d: float) -> float:
            pulls = first.at(fed.base + d, kappas[0]), second.at(fed.base - d, kappas[1])
            return pulls[0] - ratio * pulls[1] - need

        lost = first.lost + ratio * second.lost
        if not net(-reach) < -lost <= lost < net(reach):
            return False
        d = brentq(net, -reach, reach)
        ends = first.at(fed.base + d, kappas[0]), second.at(fed.base - d, kappas[1])
        return min(ends[0] - first.lost, ends[1] - second.lost) > 5.0
    (low1, high1), (low2, high2) = first.forces(kappas[0]), second.forces(kappas[1])
    low, high = max(low1, ratio * low2 + need), min(high1, ratio * high2 + need)
    return low < 0.95 * high


def pair(rng: Draw) -> Made:
    """Two muscles on a slide or on a joint, equal or not."""
    one = any_muscle(rng)
    other = one if chance(rng, 0.6) else any_muscle(rng)
    rotary = chance(rng, 0.5)
    top = top_of(rng, one, other)
    fed, feed_words = feed(rng, one if one.diameter else other, top, pair=True)
    if isinstance(fed, pam.feeds.SpoolValve | pam.feeds.OnOffValves) and not other.diameter:
        other = one
    size = min(sized(one, top), sized(other, top))
    lossy, lost, loss_words = losses(rng, top, size)
    lengths = float(one.rest_length), float(other.rest_length)
    k0 = rng.uniform(0.35, 0.55) * min(one.contraction_range[1], other.contraction_range[1])
    common: dict[str, Any] = {"muscle2": other, "feed": fed, "losses": lossy}
    puller, second = Puller(one, top, lost), Puller(other, top, lost)
    arm, ratio, link = 1.0, 1.0, (0.0, 0.0)
    if rotary:
        arm = rng.uniform(0.08, 0.2) * min(lengths)
        ratio = 1.0 if chance(rng, 0.5) else rng.uniform(0.8, 1.25)
        link = (0.0, 0.0) if chance(rng, 0.5) else (size * arm * rng.uniform(0.05, 0.2), 0.2)
        link = (link[0] / GRAVITY / 0.2, link[1])
        load = loads(rng, size * arm, k0 * min(lengths) / arm)
        inertia = size * arm * rng.uniform(3e-4, 5e-3)
        common |= {"pre_contraction": k0, "moment_arm2": arm * ratio, "loads": load.made}
        common |= {"link_mass": link[0], "link_length": link[1]}
        plant = pam.AntagonisticJoint(one, inertia, arm, **common)
        words = f"{inertia:.2g} kg m2 joint"
    else:
        load, mass = loads(rng, size, k0 * min(lengths)), size * rng.uniform(5e-4, 1e-2)
        plant = pam.AntagonisticSlide(one, mass, k0, loads=load.made, **common)
        words = f"{mass:.2g} kg slide"
    name = "theta" if rotary else "x"
    reach = 0.95 * k0 * min(lengths[0], lengths[1] / ratio) / arm
    grid = np.linspace(-reach, reach, 61)

    def good(s: float) -> bool:
        kappas = k0 + arm * s / lengths[0], k0 - ratio * arm * s / lengths[1]
        weight = link[0] * GRAVITY * link[1] * np.sin(s)
        needs = [(load.need(s) + weight + d) / arm for d in (-load.dry, load.dry)]
        return all(pair_can(puller, second, kappas, need, ratio, fed) for need in needs)

    inside = [good(float(s)) for s in grid]
    names = one.name if one is other else f"{one.name} against {other.name}"
    symmetric = one is other and ratio == 1.0 and load.symmetric
    words = told(names, words, feed_words, loss_words, load.words)
    return Made(words, plant, name, longest(grid, inside), (name,), symmetric)


def pendulum(rng: Draw) -> Made:
    """One muscle on a lever swings a pendulum; angular momentum or the rate is the state."""
    muscle = any_muscle(rng)
    top = top_of(rng, muscle)
    size, rest = sized(muscle, top), float(muscle.rest_length)
    radius, length = rest * rng.uniform(0.08, 0.14), rng.uniform(0.2, 0.5)
    mass = size * radius / (GRAVITY * length) * rng.uniform(0.2, 0.5)
    inertia, momentum = mass * length**2, chance(rng, 0.5)
    plant = pam.Plant("pendulum")
    theta = plant.state("theta", unit="rad", min=-0.3, max=1.4)
    moved = plant.state("turn", unit="N.m.s", nominal=inertia) if momentum else None
    omega = moved / inertia if momentum else plant.state("omega", unit="rad/s")
    fed, feed_words = feed(rng, muscle, top)
    lossy, lost, loss_words = losses(rng, top, size)
    k0 = 0.02
    moves = {"shortening": radius * theta, "rate": radius * omega, "pre_contraction": k0}
    part = plant.add_muscle("muscle", muscle, **moves, feed=fed, losses=lossy)
    torque = radius * part.force - mass * GRAVITY * length * ca.sin(theta)
    torque -= 0.05 * mass * length * omega
    plant.der(theta, omega)
    plant.der(moved if momentum else omega, torque if momentum else torque / inertia)
    puller, grid = Puller(muscle, top, lost), np.linspace(0.1, 1.3, 50)
    good = [
        k0 + radius * s / rest < 0.95 * muscle.contraction_range[1]
        and puller.can(k0 + radius * s / rest, mass * GRAVITY * length * np.sin(s) / radius)
        for s in grid
    ]
    words = told(f"{muscle.name}", f"pendulum of {mass:.2g} kg", feed_words, loss_words)
    return Made(words, plant, "theta", longest(grid, good), ("theta",))


def arm(rng: Draw) -> Made:
    """Two links in a row, without gravity, each between two muscles; the elbow follows."""
    muscle, plant = any_muscle(rng), pam.Plant("arm")
    top = top_of(rng, muscle)
    size, rest = sized(muscle, top), float(muscle.rest_length)
    radius, k0 = rest * rng.uniform(0.08, 0.15), 0.45 * muscle.contraction_range[1]
    given, words = regulator(rng, top)
    q = [plant.state(f"q{i}", unit="rad", min=-0.9, max=0.9, nominal=0.3) for i in (1, 2)]
    w = [plant.state(f"w{i}", unit="rad/s") for i in (1, 2)]
    pulls = []
    for i in (0, 1):
        sides = [
            plant.add_muscle(
                f"{side}{i + 1}",
                muscle,
                shortening=sign * radius * q[i],
                rate=sign * radius * w[i],
                pre_contraction=k0,
                feed=pam.feeds.Regulator(**given),
            )
            for side, sign in (("flexor", 1), ("extensor", -1))
        ]
        pulls.append(radius * (sides[0].force - sides[1].force))
    inertia = size * radius * rng.uniform(1e-3, 5e-3)
    coupling, friction = 0.3 * inertia * ca.cos(q[1]), 0.02 * size * radius
    m11, m12, m22 = 1.6 * inertia + 2 * coupling, 0.4 * inertia + coupling, 0.4 * inertia
    bend = 0.3 * inertia * ca.sin(q[1])
    left = [
        pulls[0] - friction * w[0] + bend * w[1] * (2 * w[0] + w[1]),
        pulls[1] - friction * w[1] - bend * w[0] ** 2,
    ]
    det = m11 * m22 - m12**2
    for i in (0, 1):
        plant.der(q[i], w[i])
    plant.der(w[0], (m22 * left[0] - m12 * left[1]) / det)
    plant.der(w[1], (m11 * left[1] - m12 * left[0]) / det)
    reach = min(0.6 * k0 * rest / radius, 0.8)
    puller = Puller(muscle, top, 0.0)
    grid = np.linspace(-reach, reach, 41)
    good = [
        pair_can(puller, puller, (k0 + radius * s / rest, k0 - radius * s / rest), 0.0, 1.0, None)
        for s in grid
    ]
    ends = longest(grid, good)
    return Made(told(f"{muscle.name}", "arm of two links", words), plant, "q1", ends, ("q1", "q2"))


# ---- plants that are no muscles ------------------------------------------------------------------
Own = tuple[str, tuple[str, ...], float]
"""Its position, all positions at rest with it, and how far it can go."""


def own(rng: Draw) -> Made:
    """Plants that a user might write: other coordinates, one-sided actuators, chains."""
    kind = chosen(rng, dict.fromkeys(OWN, 1))
    plant = pam.Plant(kind)
    name, positions, reach = OWN[kind](plant, rng)
    return Made(f"own: {kind}", plant, name, (0.0, reach), positions)


def _pushed(plant: pam.Plant, most: float = 1.0) -> ca.SX:
    return plant.input("u", min=-most, max=most)


def _gear(plant: pam.Plant, rng: Draw) -> Own:
    x, v, ratio = plant.state("x"), plant.state("v"), rng.uniform(0.2, 5.0)
    plant.der(x, v * ratio)
    plant.der(v, _pushed(plant))
    return "x", ("x",), rng.uniform(0.5, 3)


def _momentum(plant: pam.Plant, rng: Draw) -> Own:
    x, q = plant.state("x", unit="m"), plant.state("momentum", unit="kg.m/s")
    mass, drag = rng.uniform(0.5, 5.0), rng.uniform(0, 0.3)
    plant.der(x, q / mass)
    plant.der(q, _pushed(plant) - drag * q / mass)
    return "x", ("x",), rng.uniform(0.5, 2)


def _rapidity(plant: pam.Plant, rng: Draw) -> Own:
    x, w = plant.state("x"), plant.state("w")
    plant.der(x, ca.sinh(w))
    plant.der(w, _pushed(plant) / ca.cosh(w))
    return "x", ("x",), rng.uniform(0.5, 3)


def _swing(plant: pam.Plant, rng: Draw) -> Own:
    length, mass = rng.uniform(0.3, 1.0), rng.uniform(0.5, 2.0)
    inertia, weight = mass * length**2, mass * GRAVITY * length
    theta = plant.state("theta", unit="rad")
    moment = plant.state("angular_momentum", nominal=inertia)
    plant.der(theta, moment / inertia)
    torque = _pushed(plant, 1.5 * weight)
    plant.der(moment, torque - weight * ca.sin(theta) - 0.05 * moment / inertia)
    return "theta", ("theta",), rng.uniform(0.5, 3.0)


def _jerk(plant: pam.Plant, rng: Draw) -> Own:
    x, v, a = (plant.state(n) for n in ("x", "v", "a"))
    plant.der(x, v)
    plant.der(v, a)
    plant.der(a, _pushed(plant))
    return "x", ("x",), rng.uniform(0.5, 2)


def _rotated(plant: pam.Plant, rng: Draw) -> Own:
    """A double integrator in sum and difference of position and velocity."""
    a, b, u = plant.state("a"), plant.state("b"), _pushed(plant)
    v = (a - b) / 2
    plant.der(a, v + u)
    plant.der(b, v - u)
    plant.output("x", (a + b) / 2)
    return "x", ("x",), rng.uniform(0.5, 2)


def _chain(plant: pam.Plant, rng: Draw) -> Own:
    """Masses in a row on springs, pushed at the first."""
    n, k, u = int(rng.integers(2, 5)), rng.uniform(50, 300), _pushed(plant, 5.0)
    x = [plant.state(f"x{i}", nominal=0.1) for i in range(n)]
    q = [plant.state(f"p{i}") for i in range(n)]
    mass = rng.uniform(0.5, 1.5, n)
    links = [
        k * (x[i] - x[i + 1]) + 3 * (q[i] / mass[i] - q[i + 1] / mass[i + 1]) for i in range(n - 1)
    ]
    for i in range(n):
        plant.der(x[i], q[i] / mass[i])
        plant.der(q[i], (u if i == 0 else links[i - 1]) - (links[i] if i < n - 1 else 0))
    return f"x{n - 1}", tuple(f"x{i}" for i in range(n)), rng.uniform(0.15, 0.5)


def _one_sided(plant: pam.Plant, rng: Draw) -> Own:
    """Two actuators that only pull, each behind a lag and a dead band."""
    x, v = plant.state("x", unit="m", nominal=0.1), plant.state("v", unit="m/s")
    lag, band, most = rng.uniform(0.03, 0.2), rng.uniform(0.05, 0.3), rng.uniform(5.0, 30.0)
    pulls = []
    for i in (1, 2):
        s = plant.state(f"s{i}", min=0.0, max=1.0, start=0.5)
        u = plant.input(f"u{i}", min=0.0, max=1.0)
        plant.der(s, (u - s) / lag)
        over = s - band
        pulls.append(most * (over + ca.sqrt(over**2 + 1e-6)) / 2)
    mass, drag, spring = rng.uniform(0.5, 5.0), rng.uniform(0.5, 5.0), rng.choice([0.0, 5.0])
    plant.der(x, v)
    plant.der(v, (pulls[0] - pulls[1] - drag * v - spring * x) / mass)
    return "x", ("x",), rng.uniform(0.1, 0.4)


OWN: dict[str, Callable[[pam.Plant, Draw], Own]] = {
    f.__name__.strip("_"): f for f in (_gear, _momentum, _rapidity, _swing, _jerk, _rotated, _chain)
} | {"one-sided pair": _one_sided}


# ---- what is asked -------------------------------------------------------------------------------
def objective(rng: Draw, made: Made, legs: int) -> dict[str, Any]:
    """What is minimised, in free time or in a long one."""
    plant, name = made.plant, made.name
    outputs = {v.name for v in plant.outputs}
    valves = any(n.endswith(".exergy_flow") for n in outputs)
    muscles = any(n.endswith(".force") for n in outputs)
    still = float(rng.uniform(1.0, 2.5))  # of each leg
    if plant.name in OWN:
        still *= 4.0
    goals: dict[Any, float] = {
        "time": 6,
        "time and rate": 1.5,
        "effort": 2,
        "work": 3 if muscles else 0,
        "air": 1.5 if valves else 0,
        "exergy": 1.5 if valves else 0,
        "time and work": 1 if muscles else 0,
        "peak": 1,
        "square": 1,
        "track": 1,
        "energy": 1 if muscles else 0,
    }
    goal = chosen(rng, goals)
    if goal == "time":
        return {} if chance(rng, 0.7) else {"duration": (0.02, 8.0)}
    if goal == "time and rate":
        return {"minimise": {"time": 1.0, "rate": 1e-4}}
    if goal == "time and work":
        return {"minimise": {"time": 1.0, "work": rng.uniform(0.02, 0.3)}}
    fixed: dict[str, Any] = {"duration": still if chance(rng, 0.7) else (0.5 * still, 2 * still)}
    speed = plant.positions.get(name)
    if goal == "track":
        return fixed | {"minimise": {}, "track": {name: float(np.mean(made.range))}}
    if goal in ("peak", "square") and speed:
        return fixed | {"minimise": {f"{goal}({speed})": 1.0, "effort": 1e-3}}
    if goal == "energy":  # with a smooth share of the inputs
        return fixed | {"minimise": {"work": 1.0, "effort": 1e-2}}
    if goal in ("work", "air", "exergy"):
        return fixed | {"minimise": goal}
    return {"duration": still, "minimise": "effort"}  # slower is always less


def limits(rng: Draw, made: Made, a: float, b: float) -> dict[str, Any]:
    """Bounds, forbidden regions and budgets that leave a motion."""
    found: dict[str, Any] = {}
    plant, name, way = made.plant, made.name, abs(b - a)
    speed, wide = plant.positions.get(name), {}
    if speed and chance(rng, 0.2):
        fastest = float(way * rng.uniform(2.0, 8.0))
        wide[speed] = (-fastest, fastest)
    if chance(rng, 0.12):
        wide[name] = (min(a, b) - 0.1 * way, max(a, b) + 0.1 * way)
    outputs = {v.name for v in plant.outputs}
    if "muscle.force" in outputs and chance(rng, 0.1):
        wide["muscle.force"] = (1.0, None)
    if wide:
        found["bounds"] = wide
    if speed and chance(rng, 0.1):
        middle, half = (a + b) / 2, 0.2 * way
        fast = float(way * rng.uniform(3.0, 10.0))
        found["constraints"] = [
            pam.Avoid({name: (middle, half), speed: (np.sign(b - a) * fast, 0.5 * fast)})
        ]
    if chance(rng, 0.08):
        found["budgets"] = {"time": (None, 20.0 if plant.name in OWN else 9.0)}
    return found


def itinerary(rng: Draw, made: Made) -> tuple[list[Any], dict[str, Any], str]:
    """(stops, whether and how the motion closes, words)."""
    name = made.name
    a, b = two_places(rng, *made.range)
    memory: dict[str, Any] = {}
    if any(v.memory == "held" for v in made.plant.states) and chance(rng, 0.5):
        memory = {"memory": str(rng.choice(["above", "below"]))}
    middle = a + (b - a) * rng.uniform(0.3, 0.7)
    closes = "tank" not in made.words  # what is taken from one does not come back
    cycle, both = 3 if closes else 0, closes and made.symmetric and made.plant.mirror_map
    ways = {"there": 6, "cycle": cycle, "mirrored": 2 if both else 0}
    kind = chosen(rng, {**ways, "via": 1, "dwell": 1.5, "three": 1})
    one, other = {name: a}, {name: b}
    if kind == "cycle":
        return [one, other], {"cyclic": True}, kind
    if kind == "mirrored":
        reach = 0.9 * min(-made.range[0], made.range[1])
        if reach <= 0:
            raise Infeasible
        far = reach * rng.uniform(0.3, 1.0)
        return [{name: -far}, {name: far}], {"cyclic": "mirrored"}, kind
    if kind == "via":
        return [one, pam.Stop({name: middle}, rest=False), other], memory, kind
    if kind == "dwell":
        stay = pam.Stop(other, dwell=float(rng.uniform(0.05, 0.3)))
        return [one, stay, {name: middle}], memory, kind
    if kind == "three":
        return [one, {name: middle}, other], memory, kind
    return [one, other], memory, ""


MAKERS: dict[Any, float] = {single: 8, pair: 8, pendulum: 1, arm: 0.7, own: 3}
"""With muscles, and plants of another kind."""


def random_task(rng: Draw, makers: dict[Any, float] = MAKERS) -> Task:
    """A task on a plant of some makers, by weight (draws anew until one can be)."""
    while True:
        try:
            made = chosen(rng, makers)(rng)
            stops, arguments, words = itinerary(rng, made)
        except (Infeasible, pam.InputError):  # such as a stroke outside of what was measured
            continue
        places = [(s.values if isinstance(s, pam.Stop) else s)[made.name] for s in stops]
        variable = made.plant.variable(made.name)
        if not all(variable.min <= s <= variable.max for s in places):
            continue
        arguments |= objective(rng, made, len(stops))
        arguments |= limits(rng, made, min(places), max(places))
        return Task(told(made.words, words), made.plant, stops, made.positions, arguments)

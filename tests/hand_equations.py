"""The equations of muscles, feeds, losses, loads and arrangements, written out with math alone.

From docs/model.md, the docstrings' formulas and the published tables; nothing of pam_ocp is used,
so that the plants can be held against it. A muscle is a name of ``SETS`` with a rest length; states
and inputs are mappings by name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

GRAVITY = 9.80665
AIR = 287.05
AMBIENT = 101325.0
WARM = 293.15

SETS = {  # a1 .. a6 for p in bar, kappa in %
    "DMSP-10": (-9.2194029, 203.7012413, -0.34221042, -3.2255991, 109.2038216, -208.372034),
    "DMSP-20-200N": (-4.00180705, 292.4620246, -0.32930845, -9.33564098, 294.0538256, -280.498151),
    "DMSP-20-400N": (-4.35573, 281.22370, -0.32866, -9.27035, 302.20107, -263.69185),
}

Numbers = Mapping[str, float]


@dataclass(frozen=True)
class Fibre:
    """A muscle: its set, rest length [m], inner diameter [m]."""

    name: str
    length: float
    diameter: float = 0.02

    def tension(self, p: float, kappa: float) -> float:
        a1, a2, a3, a4, a5, a6 = SETS[self.name]
        bar, percent = p / 1e5, 100 * kappa
        grown = math.exp(a3 * percent)
        return (a1 * bar + a2) * grown + a4 * percent * bar + a5 * bar + a6

    def slope(self, p: float, kappa: float) -> float:
        """dF/dkappa [N] per unit of contraction."""
        a1, a2, a3, a4, _, _ = SETS[self.name]
        bar = p / 1e5
        return 100 * ((a1 * bar + a2) * a3 * math.exp(a3 * 100 * kappa) + a4 * bar)

    def stiffness(self, p: float, kappa: float) -> float:
        """-(1/l0) dF/dkappa of a taut muscle, 0 of a slack one [N/m]."""
        return -self.slope(p, kappa) / self.length if self.tension(p, kappa) > 0 else 0.0

    def gain(self, kappa: float) -> float:
        """G = dF/dp [N/Pa]."""
        a1, _, a3, a4, a5, _ = SETS[self.name]
        return (a1 * math.exp(a3 * 100 * kappa) + a4 * 100 * kappa + a5) / 1e5

    def volume(self, kappa: float) -> float:
        """V0 + l0 integral of G [m3]."""
        a1, _, a3, a4, a5, _ = SETS[self.name]
        k = 100 * kappa
        grown = a1 / a3 * (math.exp(a3 * k) - 1) + a4 * k**2 / 2 + a5 * k
        return math.pi / 4 * self.diameter**2 * self.length + self.length / 1e7 * grown


# ---- losses: (p, kappa, speed of shortening, states) -> force against contraction, derivatives
# -----


@dataclass(frozen=True)
class Loss:
    """Force [N] and derivatives of own states, both functions of (z, p, kappa, v, l0)."""

    force: Callable[..., float]
    rates: Callable[..., dict[str, float]] = lambda *_: {}


def coulomb(constant: float, per_pressure: float, excess: float, v0: float, vs: float) -> Loss:
    def force(z: Numbers, p: float, kappa: float, v: float, length: float) -> float:
        level = (constant + per_pressure * p) * (1 + excess * math.exp(-((v / vs) ** 2)))
        return level * math.tanh(v / v0)

    return Loss(force)


def bouc_wen(friction: float, width: float, beta: float, order: float) -> Loss:
    def rates(z: Numbers, p: float, kappa: float, v: float, length: float) -> dict[str, float]:
        h, rate = z["hysteresis"], v / length
        bend = beta * abs(rate) * abs(h) ** (order - 1) * h + (1 - beta) * rate * abs(h) ** order
        return {"hysteresis": (rate - bend) / width}

    return Loss(lambda z, *_: friction * z["hysteresis"], rates)


def creep(stiffness: float, time: float) -> Loss:
    return Loss(
        lambda z, p, kappa, *_: stiffness * (kappa - z["creep1"]),
        lambda z, p, kappa, *_: {"creep1": (kappa - z["creep1"]) / time},
    )


def maxwell(friction: tuple[float, ...], widths: tuple[float, ...], edge: float) -> Loss:
    def sticking(z: float) -> float:
        s = min(max((z - 1 + edge) / edge, 0.0), 1.0)
        return 1 - s**3

    def rates(z: Numbers, p: float, kappa: float, v: float, length: float) -> dict[str, float]:
        rate, found = v / length, {}
        for i, width in enumerate(widths, start=1):
            free = sticking(z[f"slip{i}"]) if rate > 0 else sticking(-z[f"slip{i}"])
            found[f"slip{i}"] = rate * free / width
        return found

    return Loss(lambda z, *_: sum(f * z[f"slip{i + 1}"] for i, f in enumerate(friction)), rates)


# ---- feeds: (z, u, fibre, kappa, speed of shortening) -> derivatives, outputs
# ----------------------


def orifice(p1: float, p2: float, conductance: float, b: float, warm: float) -> float:
    """ISO 6358 [kg/s], away from equal pressures."""
    if p2 > p1:
        return -orifice(p2, p1, conductance, b, warm)
    ratio = p2 / p1
    assert ratio < 0.999, "the hand-written flow ends where the laminar part begins"
    choked = p1 * conductance * 1.185 * math.sqrt(293.15 / warm)
    return choked * (1.0 if ratio <= b else math.sqrt(1 - ((ratio - b) / (1 - b)) ** 2))


@dataclass(frozen=True)
class Lag:
    """p' = (u - p)/lag."""

    lag: float

    def __call__(
        self, z: Numbers, u: Numbers, fibre: Fibre, kappa: float, v: float
    ) -> tuple[dict[str, float], dict[str, float]]:
        return {"pressure": (u["command"] - z["pressure"]) / self.lag}, {}


def ideal(
    z: Numbers, u: Numbers, fibre: Fibre, kappa: float, v: float
) -> tuple[dict[str, float], dict[str, float]]:
    return {}, {}


@dataclass(frozen=True)
class Valves:
    """Two valves, a leak and perhaps a tube; ``opened`` gives both openings from the inputs."""

    opened: Callable[[Numbers], tuple[float, float]]
    inlet: float
    outlet: float
    b: float
    supply: float
    leak: float
    dead: float
    n: float
    warm: float
    ambient: float
    tube: tuple[float, float] | None = None

    def __call__(
        self, z: Numbers, u: Numbers, fibre: Fibre, kappa: float, v: float
    ) -> tuple[dict[str, float], dict[str, float]]:
        inside = z["pressure"] + self.ambient
        node = inside if self.tube is None else z["tube_pressure"] + self.ambient
        fill, vent = self.opened(u)
        source = self.supply + self.ambient
        drawn = fill * orifice(source, node, self.inlet, self.b, self.warm)
        vented = vent * orifice(node, self.ambient, self.outlet, self.b, self.warm)
        lost = orifice(inside, self.ambient, self.leak, self.b, self.warm)
        entering, rates = drawn - vented, {}
        if self.tube is not None:
            volume, lag = self.tube
            through = (node - inside) / lag * volume / (self.n * AIR * self.warm)
            rates["tube_pressure"] = self.n * AIR * self.warm * (entering - through) / volume
            entering = through
        net = entering - lost
        volume = fibre.volume(kappa) + self.dead
        growing = fibre.gain(kappa) * v  # dV/dt = l0 G dkappa/dt
        rates["pressure"] = self.n * (AIR * self.warm * net - inside * growing) / volume
        exergy = drawn * AIR * self.warm * math.log(source / self.ambient)
        return rates, {
            "volume": volume,
            "mass_flow": net,
            "supply_flow": drawn,
            "exergy_flow": exergy,
        }


# ---- a muscle at work
# ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Puller:
    """A fibre with feed and losses, called ``name`` in the plant."""

    name: str
    fibre: Fibre
    feed: Callable[..., tuple[dict[str, float], dict[str, float]]]
    losses: tuple[Loss, ...] = ()

    def at(self, x: Numbers, u: Numbers, kappa: float, v: float) -> tuple[float, Any, Any]:
        """(force, derivatives, outputs) at a contraction and a speed of shortening [m/s]."""
        z = {k.removeprefix(f"{self.name}."): value for k, value in x.items()}
        w = {k.removeprefix(f"{self.name}."): value for k, value in u.items()}
        p = z["pressure"] if "pressure" in z else w["pressure"]
        rates, outputs = self.feed(z, w, self.fibre, kappa, v)
        tension = self.fibre.tension(p, kappa)
        assert abs(tension) > 1.0, "within the rounding of the clamp"
        lost = 0.0
        for loss in self.losses:
            lost += loss.force(z, p, kappa, v, self.fibre.length)
            rates = {**rates, **loss.rates(z, p, kappa, v, self.fibre.length)}
        if self.losses:
            outputs["loss"] = lost
        assert abs(tension - lost) > 1.0, "within the rounding of the clamp"
        force = max(tension - lost, 0.0)
        outputs |= {
            "force": force,
            "contraction": kappa,
            "power": force * v,
            "stiffness": self.fibre.stiffness(p, kappa),
        }
        named = [{f"{self.name}.{k}": value for k, value in d.items()} for d in (rates, outputs)]
        return force, named[0], named[1]


# ---- loads: (position, velocity, inputs) -> force, and mass that moves along
# -----------------------


@dataclass(frozen=True)
class Loads:
    """Spring, damper, dry friction, an outside force, added inertia and a wall, all at once."""

    spring: tuple[float, float] = (0.0, 0.0)
    damper: float = 0.0
    friction: tuple[float, float] = (0.0, 1e-3)
    inertia: float = 0.0
    outside: str | None = None
    wall: tuple[float, float, float, int] | None = None
    """(position, stiffness, damping, side)."""

    def force(self, x: float, v: float, u: Numbers) -> float:
        stiffness, rest = self.spring
        level, speed = self.friction
        total = -stiffness * (x - rest) - self.damper * v - level * math.tanh(v / speed)
        if self.outside:
            total += u[self.outside]
        if self.wall:
            total += wall_force(*self.wall, x, v)
        return total


def wall_force(
    where: float, k: float, c: float, side: int, x: float, v: float, width: float = 1.0
) -> float:
    """Spring and damper in contact, never pulling; contact is rounded off below ``width`` [N]."""
    depth, speed = side * (x - where), side * v
    elastic = k * depth
    if elastic < -width:
        return 0.0
    assert elastic > width, "within the rounding of contact"
    factor = 1 + c * speed / (elastic + width)
    assert abs(factor) > 0.1, "within the rounding of leaving"
    return -side * elastic * max(factor, 0.0)


# ---- damping -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Viscous:
    """c constant, or 2 zeta sqrt(m k), k rounded off below 1 N/m (or N m/rad)."""

    constant: float | None = None
    ratio: float = 0.0

    def __call__(self, mass: float, stiffness: float) -> float:
        if self.constant is not None:
            return self.constant
        rounded = (stiffness + math.sqrt(stiffness**2 + 1)) / 2
        return 2 * self.ratio * math.sqrt(mass * rounded)


# ---- arrangements: states and inputs -> (derivatives, outputs)
# -------------------------------------


@dataclass(frozen=True)
class Arrangement:
    """What all have in common."""

    mass: float
    damping: Viscous
    pulling: tuple[Puller, ...]
    loads: Loads = field(default_factory=Loads)


@dataclass(frozen=True)
class Hanging(Arrangement):
    """m x'' + c x' = F - m g sin(inclination)."""

    inclination: float = math.pi / 2

    def __call__(self, x: Numbers, u: Numbers) -> tuple[dict[str, float], dict[str, float]]:
        (one,) = self.pulling
        force, rates, outputs = one.at(x, u, x["x"] / one.fibre.length, x["v"])
        k = outputs["muscle.stiffness"]
        push = (
            force
            - self.mass * GRAVITY * math.sin(self.inclination)
            - self.damping(self.mass, k) * x["v"]
            + self.loads.force(x["x"], x["v"], u)
        )
        motion = {"x": x["v"], "v": push / (self.mass + self.loads.inertia)}
        return {**motion, **rates}, {**outputs, "stiffness": k}


@dataclass(frozen=True)
class Sprung(Arrangement):
    """m x'' + c x' = F - (preload + k x) - m g sin(inclination)."""

    spring: float = 0.0
    preload: float = 0.0
    inclination: float = 0.0

    def __call__(self, x: Numbers, u: Numbers) -> tuple[dict[str, float], dict[str, float]]:
        (one,) = self.pulling
        force, rates, outputs = one.at(x, u, x["x"] / one.fibre.length, x["v"])
        k = outputs["muscle.stiffness"] + self.spring
        bias = self.preload + self.spring * x["x"]
        push = (
            force
            - bias
            - self.mass * GRAVITY * math.sin(self.inclination)
            - self.damping(self.mass, k) * x["v"]
            + self.loads.force(x["x"], x["v"], u)
        )
        motion = {"x": x["v"], "v": push / (self.mass + self.loads.inertia)}
        return {**motion, **rates}, {**outputs, "stiffness": k, "spring_force": bias}


@dataclass(frozen=True)
class Slide(Arrangement):
    """m x'' + c x' = F1 - F2, kappa1,2 = k0 +- x/l0."""

    k0: float = 0.1

    def __call__(self, x: Numbers, u: Numbers) -> tuple[dict[str, float], dict[str, float]]:
        one, two = self.pulling
        f1, r1, o1 = one.at(x, u, self.k0 + x["x"] / one.fibre.length, x["v"])
        f2, r2, o2 = two.at(x, u, self.k0 - x["x"] / two.fibre.length, -x["v"])
        k = o1["muscle1.stiffness"] + o2["muscle2.stiffness"]
        push = f1 - f2 - self.damping(self.mass, k) * x["v"]
        push += self.loads.force(x["x"], x["v"], u)
        motion = {"x": x["v"], "v": push / (self.mass + self.loads.inertia)}
        return {**motion, **r1, **r2}, {**o1, **o2, "stiffness": k}


@dataclass(frozen=True)
class Joint(Arrangement):
    """I theta'' + c theta' = r1 F1 - r2 F2 - m g d sin(theta); arms (s, r = s') over theta."""

    k0: float = 0.125
    arms: tuple[tuple[Callable[[float], float], Callable[[float], float]], ...] = ()
    link: tuple[float, float] = (0.0, 0.0)

    def turned(self, theta: float, x: Numbers, u: Numbers) -> tuple[float, Any, Any]:
        """(torque, derivatives, outputs) of the muscles."""
        (one, two), ((s1, r1), (s2, r2)), omega = self.pulling, self.arms, x["omega"]
        f1, d1, o1 = one.at(x, u, self.k0 + s1(theta) / one.fibre.length, r1(theta) * omega)
        f2, d2, o2 = two.at(x, u, self.k0 - s2(theta) / two.fibre.length, -r2(theta) * omega)
        more = {"muscle1.radius": r1(theta), "muscle2.radius": r2(theta)}
        return r1(theta) * f1 - r2(theta) * f2, {**d1, **d2}, {**o1, **o2, **more}

    def __call__(self, x: Numbers, u: Numbers) -> tuple[dict[str, float], dict[str, float]]:
        theta, omega, h = x["theta"], x["omega"], 1e-5
        torque, rates, outputs = self.turned(theta, x, u)
        k = 0.0  # -d(torque)/dtheta; losses held, as for one muscle
        for n, sign, (_, r) in zip(("muscle1", "muscle2"), (1, -1), self.arms, strict=True):
            slope = (r(theta + h) - r(theta - h)) / (2 * h)
            k += r(theta) ** 2 * outputs[f"{n}.stiffness"] - sign * slope * outputs[f"{n}.force"]
        mass, length = self.link
        push = (
            torque
            - mass * GRAVITY * length * math.sin(theta)
            - self.damping(self.mass, k) * omega
            + self.loads.force(theta, omega, u)
        )
        motion = {"theta": omega, "omega": push / (self.mass + self.loads.inertia)}
        return {**motion, **rates}, {**outputs, "stiffness": k, "torque": torque}


@dataclass(frozen=True)
class Series(Arrangement):
    """m x'' = T - m g, m_e y'' + c y' = F - T, T = k_t (y - x) + c_t (y' - x') >= 0."""

    tendon: tuple[float, float] = (1e5, 20.0)
    fitting: float = 0.2

    def __call__(self, x: Numbers, u: Numbers) -> tuple[dict[str, float], dict[str, float]]:
        (one,) = self.pulling
        y, w = x["muscle.shortening"], x["muscle.velocity"]
        force, rates, outputs = one.at(x, u, y / one.fibre.length, w)
        k_t, c_t = self.tendon
        pull = k_t * (y - x["x"]) + c_t * (w - x["v"])
        assert abs(pull) > 1.0, "within the rounding of the tendon"
        pull = max(pull, 0.0)
        k = outputs["muscle.stiffness"]
        load = pull - self.mass * GRAVITY + self.loads.force(x["x"], x["v"], u)
        end = force - pull - self.damping(self.fitting, k) * w
        motion = {
            "x": x["v"],
            "v": load / (self.mass + self.loads.inertia),
            "muscle.shortening": w,
            "muscle.velocity": end / self.fitting,
        }
        series = k * k_t / (k + k_t)
        return {**motion, **rates}, {**outputs, "stiffness": series, "tendon_force": pull}


@dataclass(frozen=True)
class Regulated:
    """lag p' = u - p, u = set pressure + gain (reference - s) - derivative gain s', in 0 .. top."""

    gain: float
    derivative: float
    lag: float
    top: float

    def __call__(
        self, z: Numbers, u: Numbers, fibre: Fibre, kappa: float, v: float
    ) -> tuple[dict[str, float], dict[str, float]]:
        wanted = u["set_pressure"] + self.gain * (u["reference"] - kappa * fibre.length)
        wanted -= self.derivative * v
        command = min(max(wanted, 0.0), self.top)
        assert min(abs(wanted), abs(wanted - self.top)) > 2e4, "within the rounding of the range"
        return {"pressure": (command - z["pressure"]) / self.lag}, {"command": command}

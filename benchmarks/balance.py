"""Books of what random motions conserve or lose: a balance per component, closed over each motion.

A ledger is a rate of what goes in, what is stored, and a rate of what is lost. Over a motion

    in = stored at the end - stored at the beginning + lost

has to hold, with what is lost >= 0 at every instant (of entropy: made). All of these are written
here by hand from states and outputs, apart from the package's own equations; the two integrals are
states of the same simulation. :func:`ledgers` finds those of a plant of ``physics_study.py`` by
what it is made of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

import pam_ocp as pam
from pam_ocp.muscles.gas import Gas
from pam_ocp.muscles.heat import ConstantHeatTransfer, PressureHeatTransfer

L = pam.losses
MUSCLE = "DMSP-20-200N"
R, G = 287.05, 1.4
CP = R * G / (G - 1)
T0, P0 = 293.15, 101325.0
TOLERANCE = 1e-7
"""Of what is exchanged: what may be missing in the books of a motion at rtol 1e-11."""
LEAST_EXCHANGE = 1e-4
"""Of what is stored: a motion that exchanges less, such as behind a closed valve, is at rest."""
NEGATIVE = 1e-9
"""Of the largest power: rounding of a loss that is zero."""


@dataclass(frozen=True)
class Ledger:
    """Rate of what goes in, what is stored, rate of what is lost.

    nominal : size of the exchange over a motion, for the integrator.
    makes : what ``lost`` says is made instead, such as entropy.
    """

    name: str
    put_in: ca.SX
    stored: ca.SX
    lost: ca.SX | float = 0.0
    nominal: float = 1.0
    makes: bool = False


@dataclass(frozen=True)
class Closing:
    """Of one motion: what is missing in the books, and the least loss, in parts of the exchange."""

    ledger: str
    missing: float
    least: float

    @property
    def holds(self) -> bool:
        return self.missing <= TOLERANCE and self.least >= -NEGATIVE


class Read:
    """Expressions of a plant by name, those of one of its muscles first, and of its parameters."""

    def __init__(self, plant: pam.Plant, muscle: str = "muscle") -> None:
        self.plant, self.muscle = plant, muscle
        self.names = {v.name for v in plant.variables}

    def __contains__(self, name: str) -> bool:
        return f"{self.muscle}.{name}" in self.names or name in self.names

    def __getitem__(self, name: str) -> ca.SX:
        own = f"{self.muscle}.{name}"
        return self.plant.expression(own if own in self.names else name)

    def get(self, name: str, instead: float) -> ca.SX | float:
        return self[name] if name in self else instead  # noqa: SIM401

    def der(self, name: str) -> ca.SX:
        own = f"{self.muscle}.{name}"
        return self.plant.expression(f"der({own if own in self.names else name})")


# ---- what moves ----------------------------------------------------------------------------------
def motion(at: Read) -> Iterator[Ledger]:
    """Pull times speed lifts and speeds up the load and half the body; the damper loses c v^2."""
    mass, v = at["mass"], at["v"]
    if "mass_per_length" in at:
        mass += (at["mass_per_length"] * at["rest_length"] + at["end_mass"]) / 2
    stored = mass * v**2 / 2 + mass * at["gravity"] * at["x"]
    yield Ledger("motion", at["force"] * v, stored, at["damping"] * v**2)


def sliding(each: Sequence[Read]) -> Iterator[Ledger]:
    """Two muscles pull a slide to and fro."""
    one, two = each
    v = one["v"]
    stored, lost = one["mass"] * v**2 / 2, one["damping"] * v**2
    yield Ledger("motion", (one["force"] - two["force"]) * v, stored, lost)


def turning(each: Sequence[Read]) -> Iterator[Ledger]:
    """Two muscles turn a joint: half their bodies moves along at the ends of their levers."""
    one, two = each
    theta, omega = one["theta"], one["omega"]
    put_in = (one["radius"] * one["force"] - two["radius"] * two["force"]) * omega
    inertia = one["inertia"]
    for at in each:
        body = at["mass_per_length"] * at["rest_length"] + at["end_mass"]
        inertia += body / 2 * at["radius"] ** 2
    raised = one["link_mass"] * one["gravity"] * one["link_length"] * (1 - ca.cos(theta))
    stored = inertia * omega**2 / 2 + raised
    yield Ledger("motion", put_in, stored, one["damping"] * omega**2)


def law(at: Read, muscle: pam.Muscle) -> Iterator[Ledger]:
    """Air gives p dV; the muscle gives its tension, and keeps the law's own work at no pressure."""
    kappa, v = at["contraction"], at["v"]
    tension = at["tension"] + at.get("loss", 0.0)
    own = gauss(lambda k: muscle.tension(ca.SX(0), k), kappa)
    given = at["pressure"] * ca.jacobian(at["volume"], at["x"]) * v - tension * v
    yield Ledger("law and volume", given, -muscle.rest_length * own)


def gauss(f: Callable[[ca.SX], Any], end: ca.SX, count: int = 40) -> ca.SX:
    """The integral of f from 0 to ``end``."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    pairs = zip(nodes, weights, strict=True)
    return sum((w / 2 * end * f((n + 1) / 2 * end) for n, w in pairs), ca.SX(0))


# ---- losses: force times speed in, springs stored, sliding and flowing lost ---------------------
def rounded(rate: ca.SX) -> ca.SX:
    return ca.sqrt(rate**2 + 1e-8)  # the rest rate of 1e-4/s


def sticking(share: ca.SX, edge: Any, most: float) -> ca.SX:
    return 1 - ca.fmin(ca.fmax((share - (1 - edge)) / edge, 0), most) ** 3


def lost_in(at: Read, loss: Any) -> tuple[ca.SX | float, ca.SX]:
    """(stored [J], lost [W]) of a loss, over its rest length."""
    length, kappa, v, p = at["rest_length"], at["contraction"], at["v"], at["pressure"]
    rate = v / length
    if isinstance(loss, L.CoulombFriction):
        excess = 1 + loss.excess * ca.exp(-((v / loss.stribeck_speed) ** 2))
        return 0.0, (loss.constant + loss.per_pressure * p) * excess * v * ca.tanh(v / loss.speed)
    if isinstance(loss, L.StrandFriction):
        arm = 4 * math.pi * loss.contact_radius * at["strand_diameter"] / 2 / math.tan(loss.angle)
        return 0.0, loss.coefficient * arm * p * (1 - kappa) * v * ca.tanh(v / loss.speed)
    if isinstance(loss, L.DirectionalDamping):
        share = (1 + ca.tanh(v / loss.speed)) / 2
        (to,), (fro,) = loss.contracting, loss.relaxing
        return 0.0, v**2 * (share * (to[0] + to[1] * p) + (1 - share) * (fro[0] + fro[1] * p))
    if isinstance(loss, L.ForceVelocity):
        share = (1 + ca.tanh(v / loss.turn)) / 2
        both = [
            getattr(loss, way) + getattr(loss, f"{way}_per_pressure") * p
            for way in ("contracting", "relaxing")
        ]
        full = share * both[0] + (1 - share) * both[1]
        return 0.0, full * v**2 / (loss.speed + ca.sqrt(v**2 + loss.turn**2))
    if isinstance(loss, L.Creep | L.LoadCreep):
        key, quicker = "creep", ca.SX(1)
        if isinstance(loss, L.LoadCreep):
            key, quicker = "load_creep", 1 + pull(at["tension"] + at["loss"]) / loss.load
        (k,), (time,) = loss.stiffness, loss.time
        strain = kappa - at[f"{key}1"]
        return length * k * strain**2 / 2, length * quicker * k * strain**2 / time
    if isinstance(loss, L.Preconditioning):
        return softened(at, loss)
    return slipped(at, loss, rate)


def pull(tension: ca.SX, width: float = 1.0) -> ca.SX:
    """What a muscle pulls: never less than nothing, rounded off within the slack width [N]."""
    t = ca.fmin(ca.fmax((tension + width) / (2 * width), 0), 1)
    return ca.fmax(tension, width) - width + width * t**4 * (2 * t**2 - 6 * t + 5)


def softened(at: Read, loss: Any) -> tuple[ca.SX, ca.SX]:
    """The area under the softened curve, and what it falls by as more is softened."""
    kappa, reached = at["contraction"], at["reached"]
    k, part, width = loss.stiffness, loss.softening, loss.width

    def below(c: ca.SX) -> ca.SX:
        return ca.fmax(reached - c, 0) / width

    area = gauss(lambda c: k * c * (1 - part * ca.tanh(below(c))), kappa)
    falls = gauss(lambda c: k * c * part * (1 - ca.tanh(below(c)) ** 2) / width, kappa)
    return at["rest_length"] * area, at["rest_length"] * falls * at.der("reached")


def slipped(at: Read, loss: Any, rate: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Springs hold a force; what slides of the rate, and what is let go, is lost with it."""
    top = pam.muscle(MUSCLE).pressure_range[1]
    scale, most = (1 + loss.per_pressure * each for each in (ca.fmax(at["pressure"], 0), top))
    if isinstance(loss, L.BoucWen):
        both = [bouc_wen(at, loss, rate, scale, most)]
    elif isinstance(loss, L.MaxwellSlip):
        both = [
            element(at[f"slip{i}"] * f * most, f / y, f * most, (f * scale,) * 2, loss.edge, rate)
            for i, (f, y) in enumerate(zip(loss.friction, loss.yield_contraction, strict=True), 1)
        ]
    else:
        (c,), (r,), (y,) = loss.contracting, loss.relaxing, loss.yield_contraction
        kappa, size = at["contraction"], largest(loss, c, r) * most
        growth = loss.contracting_growth, loss.relaxing_growth
        ends = [scale * e * (1 + g * kappa) for e, g in zip((c, r), growth, strict=True)]
        both = [element(at["play1"] * size, c / y, size, (ends[0], ends[1]), loss.edge, rate)]
    stored, lost = (sum(each, ca.SX(0)) for each in zip(*both, strict=True))
    return at["rest_length"] * stored, at["rest_length"] * lost


def element(
    force: ca.SX, k: Any, size: Any, ends: tuple[Any, Any], edge: float, rate: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """(stored, lost) per rest length of a spring k that holds between -ends[1] and ends[0] [N]."""
    up, down = (rate + rounded(rate)) / 2, (rate - rounded(rate)) / 2
    holds = up * sticking(force / ends[0], edge, 3.0) + down * sticking(-force / ends[1], edge, 3.0)
    held = ca.fmax(ca.fmin(force, ends[0]), -ends[1])
    return force**2 / (2 * k), held * rate - force * (holds + let_go(force, size, ends) / k)


def let_go(force: ca.SX, size: Any, ends: tuple[Any, Any]) -> ca.SX:
    """Rate [N/s] at which a force comes back to an end that has fallen below it."""
    beyond = ca.fmax(force - ends[0], 0) / size, ca.fmax(-ends[1] - force, 0) / size
    soft = [e * ca.fmin(e / (0.1 * end / size), 1) for e, end in zip(beyond, ends, strict=True)]
    return size * (soft[1] - soft[0]) / 0.01


def bouc_wen(at: Read, loss: Any, rate: ca.SX, scale: ca.SX, most: float) -> tuple[ca.SX, ca.SX]:
    """(stored, lost) per rest length."""
    full, size = loss.friction * scale, loss.friction * most
    force, k = at["hysteresis"] * size, loss.friction / loss.yield_contraction
    share = force / full
    width = ca.sqrt(share**2 + 1e-12)
    n, beta, keeps = loss.order, loss.beta, sticking(width, 0.02, 1.0)
    slides = beta * rounded(rate) * width ** (n - 1) * share + (1 - beta) * rate * width**n
    slides *= 1 - keeps * (1 - (rate / rounded(rate)) ** 2)
    held = ca.fmax(ca.fmin(force, full), -full) if loss.per_pressure else force
    gone = let_go(force, size, (full, full)) / k if loss.per_pressure else 0.0
    return force**2 / (2 * k), held * rate - force * (rate - slides + gone)


def largest(loss: Any, c: float, r: float) -> float:
    """The largest force [N] that the element can hold within the muscle's range of contraction,
    without pressure.
    """
    end = pam.muscle(MUSCLE).contraction_range[1]
    growth = loss.contracting_growth, loss.relaxing_growth
    return max(c * max(1, 1 + growth[0] * end), r * max(1, 1 + growth[1] * end))


# ---- air -----------------------------------------------------------------------------------------
def polytropic(at: Read) -> Iterator[Ledger]:
    """p V^n rises by what flows in: n R T V^(n-1) per mass."""
    n, volume = at["gas.exponent"], at["volume"] / 1e-4
    put_in = n * R * T0 * at["mass_flow"] * volume ** (n - 1) / 1e-4
    yield Ledger("p V^n", put_in, (at["pressure"] + P0) * volume**n, nominal=1e5)


def heat(at: Read, gas: Gas) -> Iterator[Ledger]:
    """Energy of the air in the muscle, and of its wall."""
    absolute, volume, warm = at["pressure"] + P0, at["volume"], at["temperature"]
    wall = at.get("rubber_temperature", T0)
    growing = ca.jacobian(volume, at["x"]) * at["v"]
    length = at["rest_length"] * (1 - at["contraction"])
    area = 2 * ca.sqrt(math.pi * (volume - at["gas.dead_volume"]) * length)
    h: Any = at["gas.heat_transfer"]
    if isinstance(gas.heat, PressureHeatTransfer):
        h = h * ca.sqrt(absolute * warm / (P0 * T0))
    passed = h * area * (wall - warm)
    given = at["enthalpy_flow"] + passed - absolute * growing
    yield Ledger("energy of the air", given, absolute * volume / (G - 1), nominal=10.0)
    if gas.rubber is not None:
        cooled = gas.rubber.outward * (wall - T0)
        yield Ledger("energy of the wall", -passed - cooled, gas.rubber.capacity * wall)


def upwind(one: Any, two: Any, here: Any, there: Any) -> ca.SX:
    """Temperature of a stream from ``one`` to ``two`` [Pa absolute], ``here`` and ``there`` [K].

    Where the pressures differ by less than a part of 1e-3 the two are mixed, as in the model.
    """
    flow = (one - two) / (1e-3 * ca.fmax(one, two))
    share = ca.fmin(ca.fmax((flow + 1) / 2, 0), 1)
    return there + share**3 * (10 - 15 * share + 6 * share**2) * (here - there)


def entropy(at: Read, supply: float) -> Iterator[Ledger]:
    """Of air from a constant supply: throttled, mixed and warmed, each makes entropy.

    What leaves the muscle takes its entropy along; what a stream out of it carries besides, where
    temperatures are mixed, is heat at the muscle's temperature.
    """
    absolute, warm, source = at["pressure"] + P0, at["temperature"], supply + P0
    wall = at.get("rubber_temperature", T0)
    drawn, vented, passed = at["supply_flow"], at["vent_flow"], at["heat_flow"]
    coming = upwind(source, absolute, at.get("gas.supply_temperature", T0), warm)
    going = upwind(absolute, P0, warm, T0)
    s = CP * ca.log(warm / T0) - R * ca.log(absolute / P0)
    before = CP * ca.log(coming / T0) - R * ca.log(source / P0)
    brought, extra = s - before + CP * (coming - warm) / warm, CP * (coming - warm) / warm
    filling = drawn > 0
    made = ca.if_else(filling, drawn * brought, 0) + passed * (1 / warm - 1 / wall)
    put_in = drawn * ca.if_else(filling, before, s + extra) + passed / wall
    put_in -= vented * (s + CP * (going - warm) / warm)
    stored = absolute * at["volume"] / (R * warm) * s
    yield Ledger("entropy of the air", put_in, stored, made, nominal=0.1, makes=True)


def mass(each: Sequence[Read], feed: Any) -> Iterator[Ledger]:
    """Of all air within the plant; its muscles share one receiver, if there is one."""
    at, stored, source = each[0], ca.SX(0), ca.SX(0)
    for one in each:
        stored += (one["pressure"] + P0) * one["volume"] / (R * one["temperature"])
        source += one["supply_flow"]
    if "receiver.air_pressure" in at:
        t = at.get("receiver.air_temperature", T0)
        stored += (at["receiver.air_pressure"] + P0) * at["receiver.volume"] / (R * t)
        source = at["receiver.inflow"]
    if "tube_pressure" in at:
        stored += (at["tube_pressure"] + P0) * at["gas.tube_volume"] / (R * T0)
    if "tube_pressure1" in at:
        count = feed.tube.segments
        part = math.pi / 4 * feed.tube.diameter**2 * feed.tube.length / count
        pressures = sum((at[f"tube_pressure{i + 1}"] + P0 for i in range(count)), ca.SX(0))
        stored += pressures * part / (feed.tube.exponent * R * T0)
    vented = sum((one["vent_flow"] for one in each), ca.SX(0))
    yield Ledger("mass of all air", source - vented, stored, nominal=1e-3)


def everything(each: Sequence[Read]) -> Iterator[Ledger]:
    """Energy of the air in all muscles and their receiver together."""
    at = each[0]
    inflow, tank = at["receiver.inflow"], at["receiver.air_temperature"]
    share = ca.fmin(ca.fmax((inflow / 1e-5 + 1) / 2, 0), 1)
    share = share**3 * (10 - 15 * share + 6 * share**2)  # a flow below 1e-5 kg/s mixes both
    put_in = CP * inflow * (tank + share * (T0 - tank)) + at["receiver.heat_flow"]
    stored = (at["receiver.air_pressure"] + P0) * at["receiver.volume"] / (G - 1)
    for one in each:
        absolute, warm = one["pressure"] + P0, one["temperature"]
        position, velocity = one.plant.states[:2]
        growing = ca.jacobian(one["volume"], one[position.name]) * one[velocity.name]
        gone = CP * one["vent_flow"] * upwind(absolute, P0, warm, T0) + absolute * growing
        put_in += one["heat_flow"] - gone
        stored += absolute * one["volume"] / (G - 1)
    yield Ledger("energy of all air", put_in, stored, nominal=100.0)


def waves(at: Read, tube: Any) -> Iterator[Ledger]:
    """Compressed and moving air in a lumped tube: sums of squares, less what friction takes."""
    bore = math.pi / 4 * tube.diameter**2
    step = tube.length / tube.segments
    entering = at["supply_flow"] - at["vent_flow"]
    ends = [at[f"tube_pressure{i + 1}"] + P0 for i in range(tube.segments)]
    ends.append(at["pressure"] + P0)
    stored, lost = ca.SX(0), ca.SX(0)
    for i in range(tube.segments):
        flow = at[f"tube_flow{i + 1}"]
        density = (ends[i] + ends[i + 1]) / (2 * R * T0)
        reynolds = ca.fabs(flow) * tube.diameter / (bore * 1.82e-5)
        laminar = 128 * 1.82e-5 * step * flow / (math.pi * tube.diameter**4 * density)
        friction = laminar * (1 + (reynolds / (64 / 0.3164) ** (4 / 3)) ** 4) ** (3 / 16)
        stored += bore * step / (2 * tube.exponent * R * T0) * ends[i] ** 2
        stored += step / (2 * bore) * flow**2
        lost += friction * flow
    put_in = ends[0] * entering - ends[-1] * flow
    yield Ledger("waves in the tube", put_in, stored, lost, nominal=100.0)


# ---- spools, regulators, electronics -----------------------------------------------------------
def spool(at: Read, feed: Any) -> Iterator[Ledger]:
    """A lag is a spring on a dashpot, a second-order spool a mass on a spring; play is friction."""
    s, rate = at["valve.spool"], at.der("valve.spool")
    if "valve.rate" in at:
        w, damping = 2 * math.pi * feed.spool.frequency, feed.spool.damping
        stored = (w * s) ** 2 / 2 + at["valve.rate"] ** 2 / 2
        lost = 2 * damping * w * at["valve.rate"] ** 2
        yield Ledger("spool", w**2 * at["command"] * rate, stored, lost, nominal=1e3)
    else:
        yield Ledger("spool", at["command"] * rate, s**2 / 2, feed.spool.time * rate**2)
    if "valve.play" in at:
        z, half = at["valve.play"], at["valve.hysteresis"] / 2
        turn = ca.sqrt(rate**2 + 1e-2)  # the rest rate of 0.1/s
        holds = (rate + turn) / 2 * sticking(z, 0.05, 3.0)
        holds += (rate - turn) / 2 * sticking(-z, 0.05, 3.0)
        yield Ledger("play", z * rate, half * z**2 / 2, z * (rate - holds), nominal=0.1)


def lagging(at: Read, wanted: ca.SX) -> Iterator[Ledger]:
    """A pressure that follows what is wanted never runs away from it."""
    wanted, rate = wanted / 1e5, at.der("pressure") / 1e5
    p = at["pressure"] / 1e5
    yield Ledger("regulator", wanted * rate, p**2 / 2, (wanted - p) * rate, nominal=10.0)


def filtering(at: Read) -> Iterator[Ledger]:
    """A sensor's filter lags behind what it reads."""
    f, rate = at["x.filtered"], at.plant.expression("der(x.filtered)")
    yield Ledger("filter", at["x"] * rate, f**2 / 2, at["x.filter"] * rate**2, nominal=1e-3)


def metered(at: Read, supply: float) -> Iterator[Ledger]:
    """What the meters say: work, and the exergy of the air drawn."""
    yield Ledger("work", at["force"] * at["v"], at["work"], nominal=10.0)
    each = R * T0 * math.log((supply + P0) / P0)
    yield Ledger("exergy", at["supply_flow"] * each, at["exergy_drawn"], nominal=100.0)


def electronics(at: Read, feed: Any) -> Iterator[Ledger]:
    """The lag behind the loop's comparison."""
    wanted = feed.pressure_gain * (at["set_pressure"] - at["pressure"])
    rate = at.der("demand")
    lost = feed.command_lag * rate**2
    yield Ledger("electronics", wanted * rate, at["demand"] ** 2 / 2, lost)


def delay(at: Read, feed: Any) -> Iterator[Ledger]:
    """A delay line holds the square of what passes, and loses what a polynomial cannot carry.

    Of w w' (degree 2 n - 1) Radau's sum misses its leading term, always with the same sign.
    """
    order = feed.dead_time.order
    # Radau's points: zeros of P_n + P_(n-1), mirrored to 0 .. 1 with 1 among them
    legendre = np.polynomial.legendre
    points = np.sort((1 - legendre.legroots([*[0] * (order - 1), 1, 1])) / 2)
    weights = np.linalg.solve(np.vander(points, increasing=True).T, 1 / np.arange(1, order + 1))
    missed = 1 / (2 * order) - weights @ points ** (2 * order - 1)
    values = [at[f"delay{i + 1}"] / 1e5 for i in range(order)]
    begin, places = at["command"] / 1e5, np.array([0.0, *points])
    leading = sum(
        (
            w / np.prod([p - q for q in places if q != p])
            for w, p in zip([begin, *values], places, strict=True)
        ),
        ca.SX(0),
    )
    held = sum((b * w**2 / 2 for b, w in zip(weights, values, strict=True)), ca.SX(0))
    time = at["dead_time"]
    put_in = (begin**2 - values[-1] ** 2) / 2
    lost = -missed * order * leading**2
    yield Ledger("delay line", put_in, time * held, lost, nominal=1.0)


# ---- which a plant has ------------------------------------------------------------------------
def with_heat(feed: Any) -> Any:
    """The feed on a muscle whose air has a temperature, where it has none and needs books."""
    if not hasattr(feed, "gas"):
        return feed
    parts = (feed.tube, feed.quick_exhaust, None if np.isscalar(feed.supply) else feed.supply)
    if feed.gas.heat is None and any(part is not None for part in parts):
        return replace(feed, gas=Gas(heat=ConstantHeatTransfer(40.0)))
    return feed


def ledgers(plant: pam.Plant, muscle: pam.Muscle, feed: Any, loss: Any) -> list[Ledger]:
    """All that apply to a load on one muscle with this feed and this loss (or None)."""
    at = Read(plant)
    found = list(motion(at))
    if loss is not None:
        stored, lost = lost_in(at, loss)
        found.append(Ledger("loss", at["loss"] * at["v"], ca.SX(stored), lost))
    if "delay1" in at:
        found += [*lagging(at, at["set_pressure"]), *delay(at, feed)]
    if isinstance(feed, pam.plants.PositionFeedback):
        found += lagging(at, at["command"])
    if "x.filtered" in at:
        found += filtering(at)
    if "volume" not in at:
        return found
    if "rubber_temperature" not in at and "threshold" not in at:
        found += law(at, muscle)
    if "temperature" not in at:
        found += polytropic(at)
    else:
        found += [*heat(at, feed.gas), *mass([at], feed)]
        if feed.tube is None and np.isscalar(feed.supply):
            found += entropy(at, float(feed.supply))
    if "receiver.air_temperature" in at:
        found += everything([at])
    if "air_drawn" in at:
        found += metered(at, float(feed.supply))
    if "tube_flow1" in at:
        found += waves(at, feed.tube)
    if "valve.spool" in at:
        found += spool(at, feed)
    if "demand" in at:
        found += electronics(at, feed)
    return found


def of_a_pair(plant: pam.Plant) -> list[Ledger]:
    """All that apply to two muscles against each other, on a slide or a joint."""
    each = [Read(plant, f"muscle{i}") for i in (1, 2)]
    found = list(turning(each) if "theta" in each[0] else sliding(each))
    if "receiver.air_temperature" in each[0]:
        found += [*mass(each, None), *everything(each)]
    if "difference" in each[0]:
        for one, sign in zip(each, (1, -1), strict=True):
            found += lagging(one, one["base_pressure"] + sign * one["difference"])
    return found


# ---- a motion and its books --------------------------------------------------------------------
class Books:
    """A plant with the integrals of its ledgers as further states."""

    def __init__(self, plant: pam.Plant, entries: list[Ledger]) -> None:
        self.plant, self.entries = plant, entries
        p = plant.vector("parameter")
        rates = ca.vertcat(*(r for e in entries for r in (e.put_in, e.lost)))
        stored = ca.vertcat(*(e.stored for e in entries))
        free = [plant.x, plant.u, plant.p]
        self.rates = ca.Function("rates", free, [rates])
        self.stored = ca.Function("stored", free, [stored])
        self.metered = pam.Plant("metered")
        x, u = (
            [
                getattr(self.metered, kind)(v.name, unit=v.unit, nominal=v.nominal, start=v.start)
                for v in vs
            ]
            for kind, vs in (("state", plant.states), ("input", plant.inputs))
        )
        both = ca.vertcat(*x), ca.vertcat(*u), p
        for symbol, rate in zip(x, ca.vertsplit(plant.function(*both)[0]), strict=True):
            self.metered.der(symbol, rate)
        for i, rate in enumerate(ca.vertsplit(self.rates(*both))):
            total = self.metered.state(f"integral{i}", nominal=entries[i // 2].nominal)
            self.metered.der(total, rate)

    def closed(self, inputs: Any, start: Any, duration: float, samples: int) -> list[Closing]:
        """One motion under inputs, its books at the end."""
        t = np.linspace(0, duration, samples)
        run = pam.simulate(self.metered, inputs, t=t, start=start, rtol=1e-11)
        x = run.array([v.name for v in self.plant.states]).T
        u = run.array([v.name for v in self.plant.inputs]).T
        p = self.plant.vector("parameter")
        rates, stored = (np.asarray(f(x, u, p)) for f in (self.rates, self.stored))
        found = []
        for i, entry in enumerate(self.entries):
            put_in, lost = (run[f"integral{2 * i + j}"][-1] for j in (0, 1))
            each = np.abs(rates[2 * i : 2 * i + 2])
            exchanged = np.trapezoid(each.sum(axis=0), t) + np.ptp(stored[i])
            exchanged += LEAST_EXCHANGE * np.abs(stored[i]).max()
            missing = stored[i, -1] - stored[i, 0] - put_in + (-lost if entry.makes else lost)
            least = min(rates[2 * i + 1].min() / max(each.max(), 1e-300), 0.0)
            found.append(Closing(entry.name, abs(missing) / exchanged, least))
        return found

"""Random planning tasks that are feasible by construction: every arrangement, feed, loss and load
of the library, and plants of one's own in odd coordinates.

Feasible: along the whole way a point of rest exists with every muscle taut and every pressure
inside its range, whatever friction does (found here by SciPy on the force law alone), and the time
is free or long. Nothing of the planner is asked.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from scipy.optimize import brentq

import pam_ocp as pam

MUSCLES = ("DMSP-20-200N", "DMSP-20-400N", "DMSP-20-300", "DMSP-10-250", "DMSP-20-300-wall")
GRAVITY = 9.80665
MARGIN = 0.05
"""Of the pressure range, kept free at the points of rest."""


@dataclass
class Task:
    """A plant and the arguments of plan."""

    words: str
    plant: pam.Plant
    stops: list
    arguments: dict = field(default_factory=dict)


# ---- statics by SciPy on the force law alone ----------------------------------------------------
def balancing(muscle, contraction, force):
    """The gauge pressure at which a muscle pulls with ``force``, or None outside its range."""
    low, high = muscle.pressure_range
    low, high = (max(low, 0.0) + MARGIN * high, high * (1 - MARGIN))

    def excess(pressure):
        return float(muscle.tension(pressure, contraction)) - force

    if excess(low) > 0 or excess(high) < 0:
        return None
    return brentq(excess, low, high)


def pulls(muscle, contraction, force, lost):
    """Whether a muscle can pull with ``force`` >= 10 N whatever its losses (up to +-lost) do."""
    wanted = (force - lost, force + lost)
    return force - lost > 10.0 and all(
        balancing(muscle, contraction, f) is not None for f in wanted
    )


def pair_pulls(first, second, kappa1, kappa2, need, lost, ratio=1.0):
    """Whether two muscles against each other can give ``need`` [N at the first], taut."""
    for pull in np.geomspace(15.0, 1500.0, 30):
        if pulls(first, kappa1, pull + max(need, 0), lost) and pulls(
            second, kappa2, (pull + max(-need, 0)) * ratio, lost
        ):
            return True
    return False


# ---- components ---------------------------------------------------------------------------------
def feed(rng, muscle):
    """Any feed: regulators most often, then valves, then the pressure itself."""
    kind = rng.choice(["regulator", "spool", "onoff", "ideal"], p=[0.45, 0.25, 0.15, 0.15])
    if muscle.diameter is None and kind in ("spool", "onoff"):
        kind = "regulator"
    if kind == "regulator":
        limit = None if rng.random() < 0.6 else rng.uniform(1e6, 6e6)
        return pam.feeds.Regulator(lag=rng.uniform(0.03, 0.15), max_rate=limit), kind
    if kind == "ideal":
        return pam.feeds.IdealPressure(), kind
    options = {
        "conductance": pam.gas.conductance_from_flow(rng.uniform(100.0, 700.0)),
        "supply": 1.1e5 + muscle.pressure_range[1],
        "tube": pam.feeds.Tube() if rng.random() < 0.3 else None,
    }
    valve = pam.feeds.SpoolValve if kind == "spool" else pam.feeds.OnOffValves
    return valve(**options), kind + (" with tube" if options["tube"] else "")


def losses(rng, stroke):
    """(losses, largest force they can take [N], words); ``stroke`` is in contraction."""
    kind = rng.choice(
        ["none", "coulomb", "bouc-wen", "slip", "creep", "slip and creep"],
        p=[0.4, 0.12, 0.12, 0.12, 0.12, 0.12],
    )
    creep = pam.losses.Creep((rng.uniform(100, 600),), (rng.uniform(0.2, 3.0),))
    friction = rng.uniform(5, 25)
    slip = pam.losses.MaxwellSlip(tuple(friction * np.array([0.3, 0.3, 0.2, 0.2])))
    crept = creep.stiffness[0] * abs(stroke)
    return {
        "none": ((), 0.0, ""),
        "coulomb": ((pam.losses.CoulombFriction(friction),), friction, "coulomb"),
        "bouc-wen": (
            (pam.losses.BoucWen(friction, rng.uniform(0.003, 0.01)),),
            friction,
            "bouc-wen",
        ),
        "slip": ((slip,), friction, "maxwell-slip"),
        "creep": ((creep,), crept, "creep"),
        "slip and creep": ((slip, creep), friction + crept, "maxwell-slip, creep"),
    }[str(kind)]


def loads(rng, scale, a, b):
    """(loads, force they need against them at a position, largest friction, words).

    scale : 1 for a slide [m, N], the moment arm for a joint [rad, N m].
    """
    kind = rng.choice(
        ["none", "spring", "damper", "friction", "inertia", "force", "wall"],
        p=[0.46, 0.09, 0.09, 0.09, 0.09, 0.09, 0.09],
    )
    stiffness, constant = rng.uniform(100, 1000) * scale**2, rng.uniform(-20, 20) * scale
    dry = rng.uniform(1, 10) * scale
    gap = max(a, b) + rng.uniform(0.1, 0.5) * abs(b - a)
    none = lambda s: 0.0  # noqa: E731
    made = {
        "none": ((), none, 0.0),
        "spring": ((pam.loads.Spring(stiffness),), lambda s: stiffness * s, 0.0),
        "damper": ((pam.loads.Damper(rng.uniform(2, 30) * scale**2),), none, 0.0),
        "friction": ((pam.loads.DryFriction(dry, 1e-2 / max(scale, 1e-9) * 0.1),), none, dry),
        "inertia": ((pam.loads.Inertia(rng.uniform(0.2, 2.0) * scale**2),), none, 0.0),
        "force": ((pam.loads.ExternalForce(start=constant),), lambda s: -constant, 0.0),
        "wall": ((pam.loads.Wall(gap, 2e4 * scale, 20.0 * scale**2, 1, 0.5 * scale),), none, 0.0),
    }[str(kind)]
    return (*made, "" if kind == "none" else str(kind))


# ---- arrangements --------------------------------------------------------------------------------
def way(a, b):
    return np.linspace(a, b, 9)


def told(*words):
    return ", ".join(w for w in words if w)


def one_muscle(rng, muscle, needs, x, parts, make, words):
    """The task of one muscle whose load needs ``needs(s)`` [N] at rest, or None."""
    (lossy, lost, loss_words), (loaded, need, dry, load_words) = parts
    length = float(muscle.rest_length)
    for s in way(*x):
        if not pulls(muscle, s / length, needs(s) + need(s), lost + dry):
            return None
    source, feed_words = feed(rng, muscle)
    plant = make(feed=source, losses=lossy, loads=loaded)
    return plant, "x", x, told(words, feed_words, loss_words, load_words)


def hanging(rng, muscle):
    mass, length = rng.uniform(1.0, 25.0), float(muscle.rest_length)
    x = rng.uniform(0.0, 0.25, 2) * length
    slope = None if rng.random() < 0.8 else rng.uniform(0.4, 1.2)
    weight = mass * GRAVITY * (1.0 if slope is None else np.sin(slope))
    parts = losses(rng, (x[1] - x[0]) / length), loads(rng, 1.0, *x)

    def make(**more):
        return pam.HangingLoad(muscle, mass, inclination=slope, **more)

    return one_muscle(rng, muscle, lambda s: weight, x, parts, make, f"{mass:.1f} kg hanging")


def sprung(rng, muscle):
    mass, spring, preload = rng.uniform(0.5, 5), rng.uniform(1e3, 1e4), rng.uniform(20, 150)
    length = float(muscle.rest_length)
    x = rng.uniform(0.0, 0.2, 2) * length
    parts = losses(rng, (x[1] - x[0]) / length), loads(rng, 1.0, *x)

    def make(**more):
        return pam.SpringOverMuscle(muscle, mass, spring, preload, **more)

    return one_muscle(
        rng, muscle, lambda s: preload + spring * s, x, parts, make, f"{mass:.1f} kg on a spring"
    )


def series(rng, muscle):
    mass, tendon = rng.uniform(2.0, 25.0), rng.uniform(2e4, 2e5)
    length = float(muscle.rest_length)
    stretch = mass * GRAVITY / tendon
    x = rng.uniform(0.0, 0.2, 2) * length
    lossy, lost, loss_words = losses(rng, (x[1] - x[0]) / length)
    for s in way(*x):
        if not pulls(muscle, (s + stretch) / length, mass * GRAVITY, lost):
            return None
    source, feed_words = feed(rng, muscle)
    plant = pam.SeriesLoad(muscle, mass, tendon, feed=source, losses=lossy)
    words = f"{mass:.1f} kg on a tendon of {tendon / 1e3:.0f} N/mm"
    return plant, "x", x, told(words, feed_words, loss_words)


def regulated(rng, muscle):
    mass, length = rng.uniform(2.0, 25.0), float(muscle.rest_length)
    x = rng.uniform(0.0, 0.22, 2) * length
    lossy, lost, loss_words = losses(rng, (x[1] - x[0]) / length)
    for s in way(*x):
        if not pulls(muscle, s / length, mass * GRAVITY, lost):
            return None
    plant = pam.RegulatedLoad(
        muscle, mass, gain=rng.uniform(1e5, 2e6), lag=rng.uniform(0.05, 0.15), losses=lossy
    )
    return plant, "x", x, told(f"{mass:.1f} kg with position feedback", loss_words)


def slide(rng, muscle):
    mass, k0 = rng.uniform(0.5, 10.0), rng.uniform(0.06, 0.14)
    other = muscle if rng.random() < 0.6 else pam.muscle(str(rng.choice(MUSCLES)))
    length, other_length = float(muscle.rest_length), float(other.rest_length)
    x = rng.uniform(-0.08, 0.08, 2) * min(length, other_length)
    lossy, lost, loss_words = losses(rng, (x[1] - x[0]) / min(length, other_length))
    loaded, need, dry, load_words = loads(rng, 1.0, *x)
    for s in way(*x):
        for friction in (-dry, dry):
            if not pair_pulls(
                muscle, other, k0 + s / length, k0 - s / other_length, need(s) + friction, lost
            ):
                return None
    source, feed_words = feed(rng, muscle if other.diameter else other)
    plant = pam.AntagonisticSlide(
        muscle, mass, k0, muscle2=other, feed=source, losses=lossy, loads=loaded
    )
    return plant, "x", x, told(f"{mass:.1f} kg on a slide", feed_words, loss_words, load_words)


def joint(rng, muscle):
    inertia, arm = rng.uniform(0.01, 0.2), rng.uniform(0.02, 0.05)
    ratio = 1.0 if rng.random() < 0.5 else rng.uniform(0.8, 1.25)
    length = float(muscle.rest_length)
    reach = 0.09 * length / (arm * max(ratio, 1.0))
    angle = rng.uniform(-reach, reach, 2)
    link = (0.0, 0.0) if rng.random() < 0.5 else (rng.uniform(0.2, 2.0), rng.uniform(0.05, 0.3))
    lossy, lost, loss_words = losses(rng, arm * (angle[1] - angle[0]) / length)
    loaded, need, dry, load_words = loads(rng, arm, *angle)
    for s in way(*angle):
        weight = link[0] * GRAVITY * link[1] * np.sin(s)
        for friction in (-dry, dry):
            if not pair_pulls(
                muscle,
                muscle,
                0.125 + arm * s / length,
                0.125 - ratio * arm * s / length,
                (need(s) + weight + friction) / arm,
                lost,
                1 / ratio,
            ):
                return None
    source, feed_words = feed(rng, muscle)
    plant = pam.AntagonisticJoint(
        muscle,
        inertia,
        arm,
        moment_arm2=arm * ratio,
        link_mass=link[0],
        link_length=link[1],
        feed=source,
        losses=lossy,
        loads=loaded,
    )
    words = told(f"{inertia:.2f} kg m2 on a joint", feed_words, loss_words, load_words)
    return plant, "theta", angle, words


ARRANGEMENTS = (hanging, sprung, series, regulated, slide, joint)


def library_task(rng, maker=None):
    """A random feasible task of the library's arrangements (draws anew until one is)."""
    while True:
        muscle = pam.muscle(str(rng.choice(MUSCLES)))
        try:
            made = (maker or rng.choice(ARRANGEMENTS))(rng, muscle)
        except pam.InputError:  # a stroke outside the muscles' measured range
            continue
        if made is None:
            continue
        plant, name, (a, b), words = made
        variable = plant.variable(name)
        if not all(variable.min <= s <= variable.max for s in (a, b)) or abs(b - a) < 2e-3:
            continue
        arguments = {"cyclic": bool(rng.random() < 0.35)}
        goal = rng.random()
        valves = any(v.name.endswith(".exergy_flow") for v in plant.outputs)
        if goal < 0.2:
            arguments |= {"duration": 2.0, "minimise": "effort"}
        elif goal < 0.3:
            arguments["minimise"] = {"time": 1.0, "rate": 1e-4}
        elif goal < 0.4:
            arguments |= {"duration": rng.uniform(1.0, 2.0), "minimise": "work"}
        elif goal < 0.5 and valves:
            arguments |= {"duration": 2.0, "minimise": str(rng.choice(["air", "exergy"]))}
        return Task(
            told(muscle.name, words), plant, [{name: float(a)}, {name: float(b)}], arguments
        )


# ---- plants of one's own
# ----------------------------------------------------------------------------
def gear(rng):
    plant, ratio = pam.Plant("gear"), rng.uniform(0.2, 5.0)
    x, v = plant.state("x"), plant.state("v")
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, v * ratio)
    plant.der(v, u)
    return plant, [{"x": 0.0}, {"x": rng.uniform(0.3, 3)}]


def momentum(rng):
    plant, mass = pam.Plant("momentum"), rng.uniform(0.5, 5.0)
    x, q = plant.state("x", unit="m"), plant.state("momentum", unit="kg.m/s")
    u = plant.input("u", unit="N", min=-1.0, max=1.0)
    plant.der(x, q / mass)
    plant.der(q, u - rng.uniform(0, 0.3) * q / mass)
    return plant, [{"x": 0.0}, {"x": rng.uniform(0.3, 2)}]


def rapidity(rng):
    plant = pam.Plant("rapidity")
    x, w = plant.state("x"), plant.state("w")
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, ca.sinh(w))
    plant.der(w, u / ca.cosh(w))
    return plant, [{"x": 0.0}, {"x": rng.uniform(0.3, 3)}]


def logarithm(rng):
    plant = pam.Plant("logarithm")
    s, v = plant.state("s"), plant.state("v")
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(s, v * ca.exp(-s))
    plant.der(v, u)
    return plant, [{"s": 0.0}, {"s": rng.uniform(0.2, 1.0)}]


def swinging(rng):
    plant, length, mass = pam.Plant("swing"), rng.uniform(0.3, 1.0), rng.uniform(0.5, 2.0)
    inertia = mass * length**2
    theta = plant.state("theta", unit="rad", display_unit="deg")
    moment = plant.state("angular_momentum", nominal=inertia)
    u = plant.input(
        "torque", unit="N.m", min=-1.5 * mass * 9.81 * length, max=1.5 * mass * 9.81 * length
    )
    plant.der(theta, moment / inertia)
    plant.der(moment, u - mass * 9.81 * length * ca.sin(theta) - 0.05 * moment / inertia)
    return plant, [{"theta": 0.0}, {"theta": rng.uniform(0.5, 3.0)}]


def two_masses(rng):
    plant, k = pam.Plant("two_masses"), rng.uniform(20, 200)
    x1, x2 = plant.state("x1", nominal=0.1), plant.state("x2", nominal=0.1)
    v1, v2 = plant.state("v1"), plant.state("v2")
    u = plant.input("u", min=-2.0, max=2.0)
    plant.der(x1, v1)
    plant.der(x2, v2)
    plant.der(v1, u - k * (x1 - x2) - 0.5 * (v1 - v2))
    plant.der(v2, k * (x1 - x2) + 0.5 * (v1 - v2))
    return plant, [{"x1": 0.0, "x2": 0.0}, {"x2": rng.uniform(0.1, 0.5)}]


def chain(rng):
    plant, k = pam.Plant("chain"), rng.uniform(100, 300)
    x = [plant.state(f"x{i}", nominal=0.1) for i in range(4)]
    q = [plant.state(f"p{i}") for i in range(4)]
    u = plant.input("u", min=-5.0, max=5.0)
    masses = rng.uniform(0.5, 1.5, 4)
    for i in range(4):
        plant.der(x[i], q[i] / masses[i])
        pull = (
            u
            if i == 0
            else k * (x[i - 1] - x[i]) + 3 * (q[i - 1] / masses[i - 1] - q[i] / masses[i])
        )
        push = (
            0
            if i == 3
            else k * (x[i] - x[i + 1]) + 3 * (q[i] / masses[i] - q[i + 1] / masses[i + 1])
        )
        plant.der(q[i], pull - push)
    return plant, [{"x0": 0.0}, {"x3": rng.uniform(0.1, 0.4)}]


def jerk(rng):
    plant = pam.Plant("jerk")
    x, v, a = (plant.state(n) for n in ("x", "v", "a"))
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(x, v)
    plant.der(v, a)
    plant.der(a, u)
    return plant, [{"x": 0.0}, {"x": rng.uniform(0.3, 2)}]


def first_order(rng):
    plant, tau = pam.Plant("tank"), rng.uniform(0.1, 1.0)
    x = plant.state("level")
    u = plant.input("u", min=0.0, max=1.0)
    plant.der(x, (u - x) / tau)
    return plant, [{"level": 0.1}, {"level": rng.uniform(0.5, 0.9)}]


def rotated(rng):
    """A double integrator in sum and difference of position and velocity."""
    plant = pam.Plant("rotated")
    a, b = plant.state("a"), plant.state("b")
    u = plant.input("u", min=-1.0, max=1.0)
    v = (a - b) / 2
    plant.der(a, v + u)
    plant.der(b, v - u)
    plant.output("x", (a + b) / 2)
    return plant, [{"x": 0.0}, {"x": rng.uniform(0.3, 2)}]


def lever(rng):
    """A muscle swings a pendulum by a lever, angular momentum as the state."""
    muscle, radius = pam.muscle("DMSP-20-400N"), rng.uniform(0.03, 0.05)
    mass, length = rng.uniform(1.0, 4.0), rng.uniform(0.3, 0.5)
    inertia = mass * length**2
    plant = pam.Plant("lever")
    theta = plant.state("theta", unit="rad", min=-0.3, max=1.3)
    turn = plant.state("turn", unit="N.m.s", nominal=inertia)
    source, _ = feed(rng, muscle)
    part = plant.add_muscle(
        "muscle",
        muscle,
        shortening=radius * theta,
        rate=radius * turn / inertia,
        pre_contraction=0.03,
        feed=source,
    )
    plant.der(theta, turn / inertia)
    weight = mass * GRAVITY * length * ca.sin(theta)
    plant.der(turn, radius * part.force - weight - 0.3 * turn / inertia)
    goal = rng.uniform(0.7, 1.1)
    for s in way(0.2, goal):
        if not pulls(
            muscle, 0.03 + radius * s / 0.4, mass * GRAVITY * length * np.sin(s) / radius, 0
        ):
            return lever(rng)
    return plant, [{"theta": 0.2}, {"theta": goal}]


OWN = (
    gear,
    momentum,
    rapidity,
    logarithm,
    swinging,
    two_masses,
    chain,
    jerk,
    first_order,
    rotated,
    lever,
)


def own_task(rng):
    """A random task on a plant that a user might write."""
    maker = rng.choice(OWN)
    plant, stops = maker(rng)
    arguments = {"cyclic": bool(rng.random() < 0.25)}
    if rng.random() < 0.2 and maker is not first_order:
        arguments |= {"duration": 8.0, "minimise": "effort"}
    return Task(f"own: {plant.name}", plant, stops, arguments)


def random_task(rng):
    """Three of four from the library, one on a plant of one's own."""
    return library_task(rng) if rng.random() < 0.75 else own_task(rng)

"""The mechanics of a limb's rigid bodies: mass matrix and bias forces, as CasADi expressions.

Composite rigid bodies and recursive Newton-Euler (R. Featherstone, Rigid Body Dynamics Algorithms,
2008, ch. 5 and 6) on vectors of three. Each body's frame moves with it, is parallel to the base's
where all joints are at 0, and begins at the joint that carries the body.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True)
class Joint:
    """A joint of a limb, with what its file says. Origin and axis are those at q = 0, in the base.

    kind : "revolute", "prismatic" or "fixed". low, high : limits [rad or m]. velocity, effort :
    largest ones, infinite where the file has none (or 0). damping, friction : viscous coefficient
    and Coulomb friction. armature : inertia of a drive. stiffness, rest : of a spring.
    """

    name: str
    kind: str
    parent: str
    child: str
    origin: Array
    axis: Array
    low: float = -math.inf
    high: float = math.inf
    velocity: float = math.inf
    effort: float = math.inf
    damping: float = 0.0
    friction: float = 0.0
    armature: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0

    @property
    def rotary(self) -> bool:
        return self.kind == "revolute"


@dataclass(frozen=True)
class Link:
    """A rigid body: its frame, centre of mass and inertia about that at q = 0, in the base."""

    name: str
    origin: Array
    rotation: Array
    mass: float = 0.0
    centre: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))


class Tree(Protocol):
    """What carries what: the part of a Skeleton that its mechanics are made of."""

    @property
    def links(self) -> Mapping[str, Link]: ...

    @property
    def joints(self) -> tuple[Joint, ...]: ...

    def chain(self, link: str) -> tuple[Joint, ...]: ...

    def moving(self, link: str) -> tuple[str, ...]: ...

    def index(self, joint: str) -> int: ...


class _Mass(NamedTuple):
    """Mass, first moment and inertia about the origin of a frame."""

    mass: float
    moment: ca.SX
    inertia: ca.SX

    def __add__(self, other: _Mass) -> _Mass:  # type: ignore[override]
        moment, inertia = self.moment + other.moment, self.inertia + other.inertia
        return _Mass(self.mass + other.mass, moment, inertia)


def mass_matrix(body: Tree, q: ca.SX) -> ca.SX:
    """M(q), without the drives' inertias."""
    found = ca.SX(len(body.joints), len(body.joints))
    carried = {j.name: _composite(body, j, q) for j in body.joints}
    for k, joint in enumerate(body.joints):
        all_of, axis = carried[joint.name], ca.SX(joint.axis)
        # momentum, and angular momentum about the frame's origin, at the joint's unit speed
        if joint.rotary:
            linear, angular = ca.cross(axis, all_of.moment), all_of.inertia @ axis
        else:
            linear, angular = all_of.mass * axis, ca.cross(all_of.moment, axis)
        above = [j for j in body.chain(joint.child) if j.kind != "fixed"]
        for here, below in zip(reversed(above), [None, *reversed(above)], strict=False):
            if below is not None:
                linear, angular = _turned(body, below, q, linear), _turned(body, below, q, angular)
                angular += ca.cross(_offset(body, below, here, q), linear)
            i = body.index(here.name)
            found[i, k] = found[k, i] = ca.dot(here.axis, angular if here.rotary else linear)
    return found


def bias(body: Tree, q: ca.SX, w: ca.SX, gravity: ca.SX) -> ca.SX:
    """h(q, q') of M q'' + h = tau. gravity : a vector [m/s2]."""
    tau, rest = ca.SX(len(body.joints), 1), ca.SX(3, 1)

    def loads(at: Joint | None, spin: ca.SX, turning: ca.SX, speeding: ca.SX) -> list[ca.SX]:
        """Force and moment about its origin that a frame's bodies and all beyond them take.

        spin, turning, speeding : angular velocity and acceleration, acceleration of the origin.
        """
        own = _own(body, at)
        force = own.mass * speeding + _whirled(spin, turning, own.moment)
        moment = own.inertia @ turning + ca.cross(spin, own.inertia @ spin)
        moment += ca.cross(own.moment, speeding)
        for joint in _next(body, at):
            k, axis = body.index(joint.name), ca.SX(joint.axis)
            arm = _offset(body, joint, at, q)
            there = speeding + _whirled(spin, turning, arm)
            if not joint.rotary:
                there += 2 * ca.cross(spin, axis * w[k])
            inner = [_turned(body, joint, -q, v) for v in (spin, turning, there)]
            if joint.rotary:
                inner[1] += ca.cross(inner[0], axis) * w[k]
                inner[0] += axis * w[k]
            push, twist = loads(joint, *inner)
            tau[k] = ca.dot(axis, twist if joint.rotary else push)
            push, twist = _turned(body, joint, q, push), _turned(body, joint, q, twist)
            force += push
            moment += twist + ca.cross(arm, push)
        return [force, moment]

    loads(None, rest, rest, -gravity)
    return tau


def _whirled(spin: ca.SX, turning: ca.SX, arm: ca.SX) -> ca.SX:
    return ca.cross(turning, arm) + ca.cross(spin, ca.cross(spin, arm))


def _composite(body: Tree, at: Joint, q: ca.SX) -> _Mass:
    """Of all that a joint moves, in its frame."""
    found = _own(body, at)
    for joint in _next(body, at):
        mass, moment, inertia = _composite(body, joint, q)
        moment = _turned(body, joint, q, moment)
        inertia = _turned(body, joint, q, _turned(body, joint, q, inertia).T)
        arm = ca.skew(_offset(body, joint, at, q))
        both = arm @ ca.skew(moment)
        shifted = inertia - both - both.T - mass * arm @ arm
        found += _Mass(mass, moment + mass * _offset(body, joint, at, q), shifted)
    return found


def _own(body: Tree, at: Joint | None) -> _Mass:
    """Of what moves with a frame."""
    found = _Mass(0.0, ca.SX(3, 1), ca.SX(3, 3))
    for name in _links(body, at):
        link = body.links[name]
        centre = link.centre - (np.zeros(3) if at is None else at.origin)
        about = centre @ centre * np.eye(3) - np.outer(centre, centre)
        moments = ca.SX(link.mass * centre), ca.SX(link.inertia + link.mass * about)
        found += _Mass(link.mass, *moments)
    return found


def _next(body: Tree, at: Joint | None) -> Iterator[Joint]:
    """The joints that a frame carries."""
    links = _links(body, at)
    return (j for j in body.joints if j.parent in links)


def _links(body: Tree, at: Joint | None) -> list[str]:
    """What moves with a frame; at None with the base."""
    last = None if at is None else at.name
    return [name for name in body.links if (body.moving(name) or (None,))[-1] == last]


def _turned(body: Tree, joint: Joint, q: ca.SX, v: ca.SX) -> ca.SX:
    """Columns in a joint's frame as the frame before has them (Rodrigues' rotation)."""
    if not joint.rotary:
        return v
    angle, axis = q[body.index(joint.name)], ca.SX(joint.axis)
    along = axis @ (axis.T @ v)
    return along + ca.cos(angle) * (v - along) + ca.sin(angle) * (ca.skew(axis) @ v)


def _offset(body: Tree, joint: Joint, at: Joint | None, q: ca.SX) -> ca.SX:
    """Of a joint's frame from the one before."""
    arm = ca.SX(joint.origin - (np.zeros(3) if at is None else at.origin))
    return arm if joint.rotary else arm + joint.axis * q[body.index(joint.name)]

"""Limbs: rigid bodies of a URDF or MJCF file, moved by muscles along paths over their joints."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, kind_of, require_finite, require_flag, require_positive
from ..core.stop import turns
from ..core.system import Scope
from ..muscles.gas import ConsistentVolume, air_mass
from ..muscles.pneumatic_muscle import Muscle
from .components import as_muscle
from .damping import Loss
from .declaration import CHANGEABLE
from .feeds import AttachedMuscle, Feed
from .loads import Coordinate, Damper, DryFriction, Load, Spring, Wall, applied, as_loads
from .plant import Plant
from .rigid_bodies import Joint
from .skeleton import Skeleton, found_file, read_skeleton

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..core.trajectory import Trajectory
    from ..courtesy import StaticOptimisation

Array: TypeAlias = NDArray[np.float64]

ATMOSPHERE = 101325.0
ARC = 7
"""Points that are drawn of a cord on a pulley."""


@dataclass(frozen=True)
class LimbMuscle:
    """A muscle of a limb and its path.

    name : of the muscle. muscle, feed, losses : as ``Plant.add_muscle`` takes them.
    path : from one end to the other, points ``(link, (x, y, z))`` [m] in a link's frame, joined by
        straight lines, and pulleys ``(joint, radius)`` [m] about a joint's axis; a radius > 0 pulls
        towards +q, < 0 towards -q. A pulley between two points, the first on the link before the
        joint and the second on that behind it (or the other way round), takes the cord round a
        cylinder, which it may leave; at an end of the path, or beside another pulley, the cord
        stays on it: the path shortens by radius q.
    offset : length of the muscle less that of its path [m]: minus what cords take; of a path of
        pulleys alone its length where the joints are at 0. Or give
    pre_contraction : contraction of the muscle where all joints are at 0.

    Examples
    --------
    >>> flexor = pam.plants.LimbMuscle(
    ...     "flexor", "DMSP-20-300", [("elbow", 0.03)], pre_contraction=0.1
    ... )
    >>> flexor.path
    (('elbow', 0.03),)
    """

    name: str
    muscle: Muscle | str
    path: Sequence[tuple[str, Any]]
    offset: float | None = None
    pre_contraction: float | None = None
    feed: Feed | None = None
    losses: Loss | Sequence[Loss] = ()

    def __post_init__(self) -> None:
        if (self.offset is None) == (self.pre_contraction is None):
            raise InputError(f"muscle {self.name!r}: give one of offset and pre_contraction")
        for argument in ("offset", "pre_contraction"):
            if getattr(self, argument) is not None:
                require_finite(argument, getattr(self, argument))
        given = [] if isinstance(self.path, str | Mapping) else list(self.path)
        path = tuple(_element(self.name, element) for element in given)
        if not any(_is_pulley(e) for e in path) and len(path) < 2:
            raise InputError(
                f"muscle {self.name!r}: path = {self.path!r}: give two points (link, (x, y, z)) or "
                "more, or a pulley (joint, radius)"
            )
        object.__setattr__(self, "path", path)


def _element(name: str, element: Any) -> tuple[str, Any]:
    """A point or a pulley, checked."""
    try:
        where, value = element
        found = np.asarray(value, float)
    except (TypeError, ValueError):
        where, found = None, np.zeros(0)
    if not isinstance(where, str) or found.shape not in ((), (3,)) or not np.isfinite(found).all():
        raise InputError(
            f"muscle {name!r}: its path holds {element!r}; give points (link, (x, y, z)) and "
            "pulleys (joint, radius)"
        )
    if found.shape == () and not found:
        raise InputError(f"muscle {name!r}: the pulley {element!r} has no radius")
    return where, float(found) if found.shape == () else tuple(float(v) for v in found)


def _is_pulley(element: tuple[str, Any]) -> bool:
    return isinstance(element[1], float)


class Limb(Plant):
    """Rigid bodies of a file, moved by muscles: M(q) q'' + h(q, q') = sum r(q) F + loads.

    Moment arms r = -d(path length)/dq are exact, so the muscles' work is the joints' work. Its
    base is fixed.

    Parameters
    ----------
    model : path of a URDF file, or of an MJCF file (which needs MuJoCo); "arm.urdf", seven joints,
        comes with the package. Its joints are revolute
        (hinge), continuous, prismatic (slide) or fixed. Damping, friction, limits, largest speed
        and effort of the joints are taken from it (0 for speed and effort: none), of MJCF armature
        and springs, too; contacts, actuators and tendons are not.
    muscles : one LimbMuscle or several.
    damping : {joint: viscous coefficient [N m s/rad or N s/m]}, in place of the file's.
    friction : {joint: Coulomb friction [N m or N]}, in place of the file's.
    loads : {joint: loads}; their names begin with the joint's, such as ``elbow.external_force``.
    stops : whether elastic stops (``Wall``) stand at the limits; without them limits are bounds of
        the states, kept by plans.
    gravity : vector in the base [m/s2]; by default the file's, of URDF (0, 0, -9.80665).

    States: positions by the joints' names [rad or m], ``<joint>.velocity``, and those of feeds and
    losses. Outputs ``<joint>.torque`` of the muscles, ``<joint>.stiffness`` = -d(torque)/dq at
    constant pressures and losses, and the muscles' own. Path constraints, which plans keep: the
    muscles' ``<muscle>.tension`` >= 0, ``<muscle>.reach`` (contraction in its measured range) and
    ``<joint>.effort``.

    Raises InputError for files, joints, links and paths that make no limb, naming them.

    Examples
    --------
    >>> both = [
    ...     pam.plants.LimbMuscle(n, "DMSP-20-300", [("elbow", r)], pre_contraction=0.1)
    ...     for n, r in (("flexor", 0.03), ("extensor", -0.03))
    ... ]
    >>> arm = pam.plants.limb("arm.urdf", both)  # doctest: +SKIP
    >>> arm.equilibrium({"elbow": 0.3, "extensor.pressure": 2e5})  # doctest: +SKIP
    """

    def __init__(
        self,
        model: str | os.PathLike[str],
        muscles: LimbMuscle | Sequence[LimbMuscle],
        *,
        damping: Mapping[str, float] | None = None,
        friction: Mapping[str, float] | None = None,
        loads: Mapping[str, Load | Sequence[Load]] | None = None,
        stops: bool = False,
        gravity: Sequence[float] | None = None,
        name: str = "limb",
    ) -> None:
        super().__init__(name, "rigid bodies, moved by pneumatic muscles")
        require_flag("stops", stops)
        body = read_skeleton(model, gravity)
        self.file, self.gravity = str(found_file(model)), tuple(body.gravity.tolist())
        self.muscles: tuple[LimbMuscle, ...] = as_muscles(
            muscles, LimbMuscle, "give LimbMuscle(name, muscle, path)"
        )
        self.joints = _with_given(body, damping, friction)
        given = {body.joints[body.index(j)].name: as_loads(v) for j, v in (loads or {}).items()}
        q, w = self._coordinates()
        anatomy = [self._attach(body, one, q, w) for one in self.muscles]
        attached = [a for a, _, _ in anatomy]
        arms = -ca.jacobian(ca.vertcat(*(length for _, length, _ in anatomy)), q)
        self._refuse_idle(arms)
        pulls = [self._torque(i, arms[:, i], attached, q) for i in range(len(self.joints))]
        mass, bias = self._dynamics(body, q, w, given, stops)
        masses = ca.vertcat(*(a.moving_mass for a in attached))
        if not masses.is_zero():  # bodies at the ends of levers: m r (r q'' + r' q')
            mass += arms.T @ ca.diag(masses) @ arms
            bias += arms.T @ (masses * ca.jtimes(arms @ w, q, w))
        acceleration = ca.cse(ca.ldl_solve(ca.vertcat(*pulls) - bias, *ca.ldl(mass)))
        for i, joint in enumerate(self.joints):
            self.der(self._symbols[joint.name], w[i])
            self.der(self._symbols[f"{joint.name}.velocity"], acceleration[i])
        wanted = ca.SX.sym("acceleration", len(self.joints))
        pressures = ca.SX.sym("pressure", len(self.muscles))
        self._arguments = [wanted, pressures]
        self._anatomy = {
            "required": mass @ wanted + bias,
            "arms": arms,
            "lengths": ca.vertcat(*(length for _, length, _ in anatomy)),
            "paths": ca.vertcat(*(points.reshape((-1, 1)) for _, _, points in anatomy)),
            "bones": _bones(body, q),
            **_static(attached, pressures, arms, q),
        }

    def _dynamics(
        self,
        body: Skeleton,
        q: ca.SX,
        w: ca.SX,
        given: Mapping[str, tuple[Load, ...]],
        stops: bool,
    ) -> tuple[ca.SX, ca.SX]:
        """M and h of M q'' + h = torques of the muscles; loads are in both."""
        outside, added = [], []
        for i, joint in enumerate(self.joints):
            loads = _own_loads(joint, stops)
            loads += [_renamed(joint, load) for load in given.get(joint.name, ())]
            force, more = applied(self, loads, Coordinate(q[i], w[i], rotary=joint.rotary))
            outside.append(force)
            added.append(more)
        scope = Scope(self).of("m/s2", 10.0, min=0.0, tunable=True)
        gravity = scope.parameter("gravity", float(np.linalg.norm(body.gravity)), "gravity")
        mass = body.mass_matrix(q) + ca.diag(ca.vertcat(*added))
        return mass, body.bias(q, w, gravity) - ca.vertcat(*outside)

    def _coordinates(self) -> tuple[ca.SX, ca.SX]:
        positions, speeds = [], []
        for joint in self.joints:
            near = min(max(0.0, joint.low), joint.high)
            unit, nominal = ("rad", 0.3) if joint.rotary else ("m", 0.1)
            scope = Scope(self).of(unit, nominal, min=joint.low, max=joint.high, start=near)
            positions.append(scope.state(joint.name, f"position of joint {joint.name}"))
        for joint in self.joints:
            unit, nominal = ("rad/s", 1.0) if joint.rotary else ("m/s", 0.3)
            most = joint.velocity
            scope = Scope(self, joint.name).of(unit, nominal, min=-most, max=most)
            speeds.append(scope.state("velocity", f"velocity of joint {joint.name}"))
        return ca.vertcat(*positions), ca.vertcat(*speeds)

    def _attach(
        self, body: Skeleton, one: LimbMuscle, q: ca.SX, w: ca.SX
    ) -> tuple[AttachedMuscle, ca.SX, ca.SX]:
        """(the muscle, length of its path, points of its path)."""
        part = as_muscle(one.muscle, one.name)
        length, points = _path(body, one, q)
        rest = float(part.rest_length)
        if one.offset is None:
            at_zero = ca.Function("at_zero", [q], [length])(0)
            offset = rest * (1 - float(one.pre_contraction or 0.0)) - float(at_zero)
        else:
            offset = one.offset
        scope = Scope(self, one.name)
        own = scope.of("m", 0.1, tunable=True).parameter(
            "offset", offset, f"length of {one.name} less that of its path"
        )
        attached = self.add_muscle(
            one.name,
            part,
            shortening=-(length + own),
            rate=-ca.jtimes(length, q, w),
            pre_contraction=ca.SX(1),
            feed=one.feed,
            losses=one.losses,
        )
        low, high = part.contraction_range
        scope.of("1", 0.1, min=low, max=high).constraint(
            "reach", attached.contraction, f"contraction of {one.name} in its measured range"
        )
        return attached, length, points

    def _refuse_idle(self, arms: ca.SX) -> None:
        q = ca.vertcat(*(self._symbols[j.name] for j in self.joints))
        start = [self.variable(j.name).start or 0.0 for j in self.joints]
        values = np.array(ca.Function("arms", [q], [arms])(start))
        for i, one in enumerate(self.muscles):
            if arms[i, :].nnz() == 0 or arms[i, :].is_zero():
                raise InputError(
                    f"muscle {one.name!r} crosses no joint: its path lies on parts that do not "
                    "move against each other"
                )
            if not np.isfinite(values[i]).all():
                raise InputError(
                    f"muscle {one.name!r}: two points of its path coincide at the start; give "
                    "them a distance"
                )

    def _torque(self, i: int, arms: ca.SX, attached: Sequence[AttachedMuscle], q: ca.SX) -> ca.SX:
        """Declare torque, stiffness and effort of a joint; the muscles' torque."""
        joint = self.joints[i]
        effort = "N.m" if joint.rotary else "N"
        forces = ca.vertcat(*(a.force for a in attached))
        along = ca.vertcat(*(a.stiffness for a in attached))
        torque = ca.dot(arms, forces)
        of = f"of the muscles on joint {joint.name}"
        scope = Scope(self, joint.name)
        scope.of(effort, 10.0).output("torque", torque, of)
        scope.of("N.m/rad" if joint.rotary else "N/m", 10.0).output(
            "stiffness",
            ca.dot(arms**2, along) - ca.dot(ca.jacobian(arms, q[i]), forces),
            f"stiffness of joint {joint.name} at constant pressures",
        )
        if math.isfinite(joint.effort):
            scope.of(effort, 10.0, min=-joint.effort, max=joint.effort).constraint(
                "effort", torque, f"{of}, which its limit bounds"
            )
        return torque

    # ---- anatomy -------------------------------------------------------------------------------
    @turns
    def anatomy(self, *names: str) -> ca.Function:
        """CasADi function (x, u, p, acceleration, pressures) -> these expressions of the limb.

        "required" : torques that the joints need for the acceleration [N m or N]. "lengths" of the
        paths [m], "arms" : moment arms, muscles x joints [m]. "force", "stiffness", "air" : of
        muscles [N], joints [N m/rad] and muscles [kg] at pressures [Pa], without losses; "taut" :
        of muscles [N], above 0 where nothing is rounded. "paths" and "bones" : points to draw.
        """
        arguments = [self.x, self.u, self.p, *self._arguments]
        results = [self._anatomy[name] for name in names]

        def build() -> ca.Function:
            return ca.Function("anatomy", arguments, ca.cse(results))

        function: ca.Function = self.cached(("anatomy", names), build)
        return function

    def moment_arms(self, values: Mapping[str, float] | None = None) -> Array:
        """Moment arms at positions [m], muscles x joints, in the plant's order.

        values : {joint: position}; others are at their start. Positive: the muscle pulls to +q.
        """
        x = self.vector("state", values)
        free = [0.0] * len(self.joints), [0.0] * len(self.muscles)
        found = self.anatomy("arms")(x, self.vector("input"), self.vector("parameter"), *free)
        return np.array(found)

    def drawing(self, x: Any) -> tuple[list[Array], Array]:
        """(points of each muscle's path, ends of the bones), both (points, 3, moments) [m], at
        states x, (states, moments).
        """
        x = np.asarray(x, float).reshape(len(self.states), -1)
        free = [np.zeros((len(row), 1)) for row in (self.joints, self.muscles)]
        u, p = (self.vector(c)[:, None] for c in ("input", "parameter"))
        found = self.anatomy("paths", "bones").map(x.shape[1])(
            x, *(np.tile(v, x.shape[1]) for v in (u, p, *free))
        )
        paths, bones = (np.array(f).reshape(-1, 3, x.shape[1]) for f in found)
        counts = [sum(ARC if _is_pulley(e) else 1 for e in m.path) for m in self.muscles]
        return np.split(paths, np.cumsum(counts)[:-1]), bones

    def static_optimisation(self, *motion: Any, **more: Any) -> StaticOptimisation:
        """Pressures that give the joints the moments of a motion; see
        :func:`pam_ocp.operating.static_optimisation`.
        """
        return courtesy.static_optimisation(self, *motion, **more)

    def plot(self, values: Mapping[str, float] | None = None, **options: Any) -> Figure:
        """The limb in space; see :func:`pam_ocp.figures.film.plot_limb`."""
        return courtesy.plot_limb(self, values, **options)

    def animate(self, motion: Trajectory, path: str | Path, **options: Any) -> Path:
        """A film (GIF) of a motion; see :func:`pam_ocp.figures.film.animate_limb`."""
        return courtesy.animate_limb(self, motion, path, **options)

    def __getstate__(self) -> dict[str, Any]:
        names = tuple(self._anatomy)
        return {
            **super().__getstate__(),
            "limb": (self.muscles, self.joints, names, self.anatomy(*names)),
            "file": (self.file, self.gravity),
        }

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self.muscles, self.joints, names, function = state["limb"]
        self.file, self.gravity = state["file"]
        self._arguments = [
            ca.SX.sym("acceleration", len(self.joints)),
            ca.SX.sym("pressure", len(self.muscles)),
        ]
        columns = [self._column(self._symbols, c) for c in CHANGEABLE]
        self._anatomy = dict(zip(names, function.call([*columns, *self._arguments]), strict=True))


limb = Limb
"""The short name: ``pam.plants.limb("arm.urdf", muscles)``."""


def as_muscles(muscles: Any, kind: type, words: str) -> tuple[Any, ...]:
    """One or more of a kind, each with a name of its own. words : what to give instead of others.

    Raises InputError.
    """
    given = (muscles,) if isinstance(muscles, kind) else tuple(muscles or ())
    for one in given:
        if not isinstance(one, kind):
            raise InputError(f"muscles holds {kind_of(one)}; {words}")
    names = [one.name for one in given]
    if not given or len(set(names)) < len(names):
        raise InputError(f"muscles = {names}: give one or more, each with a name of its own")
    return given


def _with_given(body: Skeleton, damping: Any, friction: Any) -> tuple[Joint, ...]:
    """The joints with the user's damping and friction."""
    joints = list(body.joints)
    for name, value in (damping or {}).items():
        i = body.index(name)
        joints[i] = replace(joints[i], damping=_coefficient("damping", name, value))
    for name, value in (friction or {}).items():
        i = body.index(name)
        joints[i] = replace(joints[i], friction=_coefficient("friction", name, value))
    return tuple(joints)


def _coefficient(argument: str, joint: str, value: Any) -> float:
    return require_positive(f"{argument} of {joint}", value, zero=True)


def _own_loads(joint: Joint, stops: bool) -> list[Load]:
    """What the file (or the user) says of a joint, as loads."""
    loads: list[Load] = [Damper(joint.damping, f"{joint.name}.damper")]
    if joint.friction:
        loads.append(DryFriction(joint.friction, name=f"{joint.name}.friction"))
    if joint.stiffness:
        loads.append(Spring(joint.stiffness, joint.rest, f"{joint.name}.spring"))
    if stops:
        stiffness, damping = (2e3, 5.0) if joint.rotary else (1e5, 50.0)
        for at, side, word in ((joint.high, 1, "upper"), (joint.low, -1, "lower")):
            if math.isfinite(at):
                name = f"{joint.name}.{word}_stop"
                loads.append(Wall(at, stiffness, damping, side, 0.1, name))
    return loads


def _renamed(joint: Joint, load: Load) -> Load:
    """A load whose name begins with that of its joint, where it has a name to change."""
    own: Any = load
    named = is_dataclass(own) and "name" in {f.name for f in fields(own)}
    return cast(Load, replace(own, name=f"{joint.name}.{own.name}") if named else own)


def _bones(body: Skeleton, q: ca.SX) -> ca.SX:
    """Ends of lines to draw: from each joint to those it carries, or to its last link's end."""
    ends = []
    for joint in body.joints:
        own = [n for n in body.links if body.moving(n) == body.moving(joint.child)]
        next_ones = [j.origin for j in body.joints if j.parent in own]
        places = [body.links[n].origin for n in own]
        places += [body.links[n].centre for n in own if body.links[n].mass]
        far = max(places, key=lambda p: float(np.linalg.norm(p - joint.origin)))
        for place in next_ones or [far]:
            ends += [_fixed(body, joint.child, p, q) for p in (joint.origin, place)]
    return ca.vertcat(*ends)


def _fixed(body: Skeleton, link: str, place: Array, q: ca.SX) -> ca.SX:
    """A point that is fixed to a link, said where it is in the base at q = 0."""
    own = body.links[link]
    return body.point(link, own.rotation.T @ (place - own.origin), q)


def _arc(body: Skeleton, joint: Joint, radius: float, q: ca.SX) -> list[ca.SX]:
    """Points to draw of a cord on a pulley, on the side on which it pulls."""
    down = body.links[joint.child].centre - joint.origin
    across = np.cross(joint.axis, down)
    if np.linalg.norm(across) < 1e-9:
        across = np.cross(joint.axis, np.eye(3)[int(np.argmin(np.abs(joint.axis)))])
    across = across / np.linalg.norm(across)
    along, angles = np.cross(across, joint.axis), np.linspace(-1.2, 1.2, ARC)
    arms = [radius * across * np.cos(a) + abs(radius) * along * np.sin(a) for a in angles]
    return [_fixed(body, joint.parent, joint.origin + arm, q) for arm in arms]


def _static(
    attached: Sequence[AttachedMuscle], pressures: ca.SX, arms: ca.SX, q: ca.SX
) -> dict[str, ca.SX]:
    """Forces, stiffness of the joints and air at given pressures, without losses."""
    forces = [a.muscle.force(pressures[i], a.contraction) for i, a in enumerate(attached)]
    torque = arms.T @ ca.vertcat(*forces)
    stiffness = [-ca.jacobian(torque[i], q[i]) for i in range(torque.numel())]
    taut = [
        a.muscle.tension(pressures[i], a.contraction) - a.muscle.slack_width
        for i, a in enumerate(attached)
    ]
    found = {
        "force": ca.vertcat(*forces),
        "taut": ca.vertcat(*taut),
        "stiffness": ca.vertcat(*stiffness),
    }
    try:
        volumes = [ConsistentVolume().filled(a.muscle, a.contraction, _value) for a in attached]
    except InputError:  # no diameter, or no law of which a volume follows
        return found
    absolute = pressures + ATMOSPHERE
    return {**found, "air": ca.vertcat(*(air_mass(absolute[i], v) for i, v in enumerate(volumes)))}


def _value(name: str, value: float, **attributes: Any) -> float:
    return value


# ---- paths -------------------------------------------------------------------------------------
def _path(body: Skeleton, one: LimbMuscle, q: ca.SX) -> tuple[ca.SX, ca.SX]:
    """(length of a path, its points in the base, 3 x n)."""
    length, drawn, path = ca.SX(0), [], one.path
    for before, element, behind in zip((None, *path), path, (*path[1:], None), strict=False):
        if not _is_pulley(element):
            drawn.append(body.point(*element, q))
            if behind is not None and not _is_pulley(behind):
                ends = element, behind
                a, b = (body.point(*e, q, beside=o[0]) for e, o in (ends, ends[::-1]))
                length += ca.sqrt(ca.sumsqr(a - b))
            continue
        joint, radius = body.joints[body.index(element[0])], element[1]
        if not joint.rotary:
            raise InputError(
                f"muscle {one.name!r}: pulley {element!r}: joint {joint.name!r} is prismatic; give "
                "points on the links"
            )
        angle = q[body.index(joint.name)]
        if before is None or behind is None or _is_pulley(before) or _is_pulley(behind):
            length -= radius * angle
        else:
            length += _wrapped(body, one.name, joint, radius, (before, behind), angle)
        drawn += _arc(body, joint, radius, q)
    return length, ca.horzcat(*drawn)


def _wrapped(
    body: Skeleton,
    name: str,
    joint: Joint,
    radius: float,
    ends: tuple[tuple[str, Any], tuple[str, Any]],
    angle: ca.SX,
) -> ca.SX:
    """Length from point to point round a cylinder about the joint's axis, straight where the cord
    leaves it. It has no step and no kink there: the line touches the cylinder.
    """
    sides = [_before(body, joint, link) for link, _ in ends]
    if sorted(map(str, sides)) != ["False", "True"]:
        raise InputError(
            f"muscle {name!r}: the pulley on {joint.name!r} stands between points on "
            f"{ends[0][0]!r} and {ends[1][0]!r}; give one on {joint.parent!r} and one on "
            f"{joint.child!r} (via points)"
        )
    axis, size, way = joint.axis, abs(radius), math.copysign(1.0, radius)
    spokes = [body.at_zero(*e) - joint.origin for e in (ends if sides[0] else ends[::-1])]
    rise = float(axis @ (spokes[1] - spokes[0]))
    a, b = (s - axis * (axis @ s) for s in spokes)
    distances = float(np.linalg.norm(a)), float(np.linalg.norm(b))
    if min(distances) <= size:
        raise InputError(
            f"muscle {name!r}: a point beside the pulley on {joint.name!r} is {min(distances):.3g} "
            f"m from its axis, within the radius of {size:g} m"
        )
    turned = math.atan2(axis @ np.cross(a, b), a @ b)  # from the first spoke to the second
    between = (-way * turned) % (2 * math.pi) - way * angle
    contact = between - sum(math.acos(size / d) for d in distances)
    flat = sum(math.sqrt(d**2 - size**2) for d in distances) + size * contact
    chord = distances[0] ** 2 + distances[1] ** 2 - 2 * math.prod(distances) * ca.cos(between)
    return ca.SX(ca.sqrt(ca.if_else(contact > 0, flat**2, chord) + rise**2))


def _before(body: Skeleton, joint: Joint, link: str) -> bool | None:
    """Whether a link is one with the joint's parent (True), with its child (False), or neither."""
    moving = body.moving(link)
    above = body.moving(joint.parent)
    return True if moving == above else False if moving == (*above, joint.name) else None

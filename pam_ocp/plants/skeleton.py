"""The rigid bodies of a limb: read from URDF or MJCF, and checked; where their points are."""

from __future__ import annotations

import math
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, UnknownNameError
from ..core.lazy import library
from . import rigid_bodies
from .rigid_bodies import Joint, Link

Array: TypeAlias = NDArray[np.float64]

GRAVITY = (0.0, 0.0, -9.80665)
KINDS = ("revolute", "continuous", "prismatic", "fixed")
ROUNDING = 1e-15
"""Components of unit vectors below this are 0: what cos(pi/2) leaves."""
TRIANGLE = 1e-3
"""Part by which a moment of inertia may exceed the sum of the others: rounded numbers in files."""


class Skeleton:
    """Links and joints of a limb whose base is fixed. All positions are CasADi expressions of q.

    Raises InputError for what cannot be computed, naming the joint or the link.
    """

    def __init__(self, name: str, links: Iterable[Link], joints: Iterable[Joint], gravity: Any):
        self.name = name
        self.links = {link.name: link for link in links}
        self._above = {j.child: j for j in joints}  # each link's joint towards the base
        self.joints = tuple(j for j in joints if j.kind != "fixed")
        self.gravity = np.asarray(gravity, float)
        self._check(tuple(joints))
        self._check_masses()

    # ---- what is refused -----------------------------------------------------------------------
    def _check(self, joints: tuple[Joint, ...]) -> None:
        for joint in joints:
            for link in (joint.parent, joint.child):
                if link not in self.links:
                    raise InputError(
                        f"joint {joint.name!r} names link {link!r}, which is not there"
                    )
            if joint.low > joint.high:
                raise InputError(
                    f"joint {joint.name!r} has the limits ({joint.low:g}, {joint.high:g}): the "
                    "lower must be the smaller"
                )
        if len(self._above) < len(joints):
            twice = next(self._above[j.child] for j in joints if self._above[j.child] is not j)
            raise InputError(
                f"joint {twice.name!r} closes a loop: link {twice.child!r} has two parents; a limb "
                "is a tree"
            )
        roots = [name for name in self.links if name not in self._above]
        if len(roots) != 1:
            raise InputError(
                f"the limb has {len(roots)} links without a parent ({', '.join(roots)}): one must "
                "carry all others"
            )
        for link in self.links:
            self.chain(link)
        if not self.joints:
            raise InputError(f"limb {self.name!r} has no joint that moves")
        for body in self.links.values():
            _check_inertia(body)

    def _check_masses(self) -> None:
        """Refuse joints that move nothing: the mass matrix would have no inverse."""
        q = ca.SX.sym("q", len(self.joints))
        matrix = ca.Function("matrix", [q], [self.mass_matrix(q)])
        for trial in (0.0, 0.3):
            m = np.array(matrix(np.full(len(self.joints), trial)))
            scale = np.sqrt(np.maximum(np.diag(m), 0.0))
            for joint, size in zip(self.joints, scale, strict=True):
                if not size > 0:
                    raise InputError(
                        f"joint {joint.name!r} moves no mass (mass matrix singular): give link "
                        f"{joint.child!r} or one beyond it a mass and inertia"
                    )
            values, vectors = np.linalg.eigh(m / np.outer(scale, scale))
            if values[0] < 1e-9 and trial:
                of = [self.joints[i].name for i in np.flatnonzero(np.abs(vectors[:, 0]) > 0.3)]
                raise InputError(
                    f"joints {', '.join(of)} move the same masses in the same way (mass matrix "
                    "singular): give the links between them mass and inertia"
                )

    # ---- kinematics ----------------------------------------------------------------------------
    def chain(self, link: str) -> tuple[Joint, ...]:
        """The joints from the base to a link, fixed ones too. Raises UnknownNameError."""
        if link not in self.links:
            raise UnknownNameError(f"link of limb {self.name!r}", link, self.links)
        found: list[Joint] = []
        while link in self._above:
            found.insert(0, self._above[link])
            link = found[0].parent
            if len(found) > len(self._above):
                raise InputError(f"joint {found[0].name!r} is part of a ring without a base")
        return tuple(found)

    def moving(self, link: str) -> tuple[str, ...]:
        """Names of the joints that move a link, from the base on."""
        return tuple(j.name for j in self.chain(link) if j.kind != "fixed")

    def index(self, joint: str) -> int:
        """Position of a joint in q. Raises UnknownNameError."""
        names = [j.name for j in self.joints]
        if joint not in names:
            raise UnknownNameError(f"joint of limb {self.name!r}", joint, names)
        return names.index(joint)

    def at_zero(self, link: str, xyz: Any) -> Array:
        """A point of a link where all joints are at 0, in the base."""
        self.chain(link)
        own = self.links[link]
        return np.asarray(own.origin + own.rotation @ np.asarray(xyz, float), float)

    def point(self, link: str, xyz: Any, q: ca.SX, beside: str | None = None) -> ca.SX:
        """A point of a link [m] in the base; with ``beside``, in what carries both links.

        So the distance of points of two links depends on the joints between them alone.
        """
        position = ca.SX(self.at_zero(link, xyz))
        chain = self.chain(link)
        common = () if beside is None else self.chain(beside)
        shared = next(
            (i for i, (a, b) in enumerate(zip(chain, common, strict=False)) if a is not b),
            min(len(chain), len(common)),
        )
        for joint in reversed(chain[shared:]):
            if joint.kind == "prismatic":
                position += joint.axis * q[self.index(joint.name)]
            elif joint.kind == "revolute":  # Rodrigues' rotation
                angle, arm, axis = q[self.index(joint.name)], position - joint.origin, joint.axis
                along = axis * ca.dot(axis, arm)
                across = ca.cos(angle) * (arm - along) + ca.sin(angle) * ca.cross(ca.SX(axis), arm)
                position = ca.SX(joint.origin + along + across)
        return ca.SX(position)

    # ---- dynamics ------------------------------------------------------------------------------
    def mass_matrix(self, q: ca.SX) -> ca.SX:
        """M(q), with the drives' inertias."""
        drives = ca.diag(ca.SX([j.armature for j in self.joints]))
        return ca.SX(rigid_bodies.mass_matrix(self, q) + drives)

    def bias(self, q: ca.SX, w: ca.SX, gravity: ca.SX) -> ca.SX:
        """h(q, q') of M q'' + h = tau: Coriolis, centrifugal forces and weight.

        gravity : magnitude [m/s2]; its direction is that of ``self.gravity``.
        """
        size = np.linalg.norm(self.gravity)
        way = self.gravity / size if size else np.array(GRAVITY) / np.linalg.norm(GRAVITY)
        return rigid_bodies.bias(self, q, w, gravity * ca.SX(way))


def _check_inertia(link: Link) -> None:
    if link.mass < 0 or not np.all(np.isfinite(link.inertia)):
        raise InputError(f"link {link.name!r} has the mass {link.mass:g} kg: give one >= 0")
    low, middle, high = np.linalg.eigvalsh(link.inertia)
    if low < -TRIANGLE * max(high, 0.0) or high > (1 + TRIANGLE) * (low + middle):
        raise InputError(
            f"link {link.name!r} has the principal moments of inertia {low:.3g}, {middle:.3g}, "
            f"{high:.3g} kg m2, which no body has: none is negative or above the sum of the others"
        )


def _unit(name: str, axis: Array) -> Array:
    size = np.linalg.norm(axis)
    if not size > 0:
        raise InputError(f"joint {name!r} has the axis (0, 0, 0): give its direction")
    axis = axis / size
    return np.asarray(np.where(np.abs(axis) < ROUNDING, 0.0, axis), float)


def found_file(path: str | os.PathLike[str]) -> Path:
    """A file, or the one of this name that comes with the package (``arm.urdf``)."""
    file, bundled = Path(path), Path(str(files("pam_ocp.data"))) / os.fspath(path)
    return bundled if not file.is_file() and bundled.is_file() else file


def read_skeleton(path: str | os.PathLike[str], gravity: Any = None) -> Skeleton:
    """The rigid bodies of a URDF or MJCF file. gravity : [m/s2], in place of the file's."""
    file = found_file(path)
    if not file.is_file():
        raise InputError(f"limb: the file {os.fspath(path)!r} does not exist")
    try:
        root = ET.parse(file).getroot()
    except (ET.ParseError, UnicodeDecodeError) as error:
        raise InputError(f"limb: {os.fspath(path)!r} is no XML: {error}") from None
    if root.tag == "robot":
        name, links, joints = _of_urdf(root)
        own: Any = GRAVITY
    elif root.tag == "mujoco":
        name, links, joints, own = _of_mjcf(file)
    else:
        raise InputError(
            f"limb: {os.fspath(path)!r} is neither URDF (<robot>) nor MJCF (<mujoco>): its root is "
            f"<{root.tag}>"
        )
    given = own if gravity is None else np.asarray(gravity, float)
    if np.shape(given) != (3,) or not np.all(np.isfinite(given)):
        raise InputError(f"gravity = {gravity!r}: give three numbers [m/s2]")
    return Skeleton(name or file.stem, links, joints, given)


# ---- URDF --------------------------------------------------------------------------------------
def _of_urdf(root: ET.Element) -> tuple[str, list[Link], list[Joint]]:
    elements = root.findall("joint")
    names = [e.get("name", "") for e in (*elements, *root.findall("link"))]
    for name in names:
        if not name or names.count(name) > 2:
            raise InputError(f"limb: the name {name!r} of a joint or link is missing or repeated")
    for element in elements:
        kind = element.get("type")
        if kind not in KINDS or element.find("mimic") is not None:
            what = "a mimic joint" if kind in KINDS else f"of type {kind!r}"
            raise InputError(
                f"joint {element.get('name')!r} is {what}: a limb has a fixed base and joints of "
                f"its own, {', '.join(KINDS)}"
            )
    above = {_of(e, "child", "link"): e for e in elements}
    poses: dict[str, tuple[Array, Array]] = {}

    def pose(link: str, depth: int = 0) -> tuple[Array, Array]:
        if link not in poses:
            element = above.get(link)
            if element is None or depth > len(above):
                poses[link] = np.eye(3), np.zeros(3)
            else:
                turned, place = pose(_of(element, "parent", "link"), depth + 1)
                xyz, rotation = _origin(element)
                poses[link] = turned @ rotation, place + turned @ xyz
        return poses[link]

    links = []
    for element in root.findall("link"):
        rotation, origin = pose(str(element.get("name")))
        links.append(_urdf_link(element, origin, rotation))
    joints = [_urdf_joint(e, *pose(_of(e, "child", "link"))) for e in elements]
    return str(root.get("name", "")), links, joints


def _urdf_link(element: ET.Element, origin: Array, rotation: Array) -> Link:
    name, inertial = str(element.get("name")), element.find("inertial")
    if inertial is None:
        return Link(name, origin, rotation)
    xyz, own = _origin(inertial)
    tensor, turned = inertial.find("inertia"), rotation @ own
    inertia = np.zeros((3, 3))
    for i, a in enumerate("xyz"):
        for j, b in enumerate("xyz"):
            key = f"i{min(a, b)}{max(a, b)}"
            inertia[i, j] = 0.0 if tensor is None else _numbers(tensor, key, "0", name)[0]
    mass = inertial.find("mass")
    kg = 0.0 if mass is None else float(_numbers(mass, "value", "0", name)[0])
    return Link(name, origin, rotation, kg, origin + rotation @ xyz, turned @ inertia @ turned.T)


def _urdf_joint(element: ET.Element, rotation: Array, origin: Array) -> Joint:
    name, kind = str(element.get("name")), str(element.get("type"))
    axis, limit, dynamics = (element.find(tag) for tag in ("axis", "limit", "dynamics"))
    way = np.array([1.0, 0, 0]) if axis is None else _numbers(axis, "xyz", "1 0 0", name, 3)

    def number(of: ET.Element | None, key: str, default: float) -> float:
        return default if of is None else float(_numbers(of, key, repr(default), name)[0])

    bounded = limit is not None and kind in ("revolute", "prismatic")
    return Joint(
        name,
        "revolute" if kind == "continuous" else kind,
        _of(element, "parent", "link"),
        _of(element, "child", "link"),
        origin,
        _unit(name, rotation @ way),
        number(limit, "lower", 0.0) if bounded else -math.inf,
        number(limit, "upper", 0.0) if bounded else math.inf,
        number(limit, "velocity", 0.0) or math.inf,
        number(limit, "effort", 0.0) or math.inf,
        number(dynamics, "damping", 0.0),
        number(dynamics, "friction", 0.0),
    )


def _of(element: ET.Element, tag: str, key: str) -> str:
    child = element.find(tag)
    if child is None or not child.get(key):
        raise InputError(f"joint {element.get('name')!r} has no <{tag} {key}=...>")
    return str(child.get(key))


def _numbers(element: ET.Element, key: str, default: str, name: str, count: int = 1) -> Array:
    text = element.get(key, default)
    try:
        found = np.array([float(v) for v in text.split()])
    except ValueError:
        found = np.zeros(0)
    if len(found) != count or np.any(np.isnan(found)):
        raise InputError(f"{name!r}: <{element.tag} {key}={text!r}> must hold {count} number(s)")
    return found


def _origin(element: ET.Element) -> tuple[Array, Array]:
    """(xyz, rotation) of an <origin>: roll, pitch, yaw about fixed axes."""
    origin, name = element.find("origin"), str(element.get("name", "inertial"))
    if origin is None:
        return np.zeros(3), np.eye(3)
    rpy = _numbers(origin, "rpy", "0 0 0", name, 3)
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    rotation = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return _numbers(origin, "xyz", "0 0 0", name, 3), rotation


# ---- MJCF --------------------------------------------------------------------------------------
def _of_mjcf(file: Path) -> tuple[str, list[Link], list[Joint], Array]:
    """Bodies as MuJoCo's compiler has them; where one has several joints, links between them."""
    mujoco = library("mujoco", "mujoco", "a limb of an MJCF file")
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except ValueError as error:
        raise InputError(f"limb: MuJoCo cannot read {str(file)!r}: {error}") from None
    if model.neq:
        raise InputError(
            f"equality {model.equality(0).name!r} couples parts of the limb: it has to be a tree"
        )
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    links, joints = [], []
    for i in range(model.nbody):
        body = model.body(i)
        turned = data.ximat[i].reshape(3, 3)
        inertia = turned @ np.diag(model.body_inertia[i]) @ turned.T
        pose = data.xpos[i].copy(), data.xmat[i].reshape(3, 3).copy()
        mass, centre = float(model.body_mass[i]), data.xipos[i].copy()
        links.append(Link(body.name or f"body{i}", *pose, mass, centre, inertia))
        if i == 0:
            continue
        above = model.body(int(body.parentid[0]))
        parent = above.name or f"body{above.id}"
        first, count = int(body.jntadr[0]), int(body.jntnum[0])
        own = [_mjcf_joint(mujoco, model, data, k) for k in range(first, first + count)]
        if not own:
            own = [
                Joint(f"{links[-1].name}.fixed", "fixed", "", "", pose[0], np.array([1.0, 0, 0]))
            ]
        for k, joint in enumerate(own):
            last = k == len(own) - 1
            child = links[-1].name if last else f"{links[-1].name}.{joint.name}"
            if not last:
                links.insert(-1, Link(child, *pose))
            joints.append(replace(joint, parent=parent, child=child))
            parent = child
    return str(model.names.split(b"\0")[0].decode()), links, joints, model.opt.gravity.copy()


def _mjcf_joint(mujoco: Any, model: Any, data: Any, k: int) -> Joint:
    joint = model.joint(k)
    name, kind = joint.name or f"joint{k}", mujoco.mjtJoint(int(joint.type[0]))
    rotary = kind == mujoco.mjtJoint.mjJNT_HINGE
    if not rotary and kind != mujoco.mjtJoint.mjJNT_SLIDE:
        raise InputError(
            f"joint {name!r} is {kind.name.removeprefix('mjJNT_').lower()}: a limb has a fixed "
            "base and joints of one degree of freedom, hinge and slide"
        )
    if model.qpos0[int(joint.qposadr[0])] != 0:
        raise InputError(f"joint {name!r} has a ref other than 0, which a limb does not know")
    at, limited = int(joint.dofadr[0]), bool(model.jnt_limited[k])
    low, high = model.jnt_range[k] if limited else (-math.inf, math.inf)
    return Joint(
        name,
        "revolute" if rotary else "prismatic",
        "",
        "",
        data.xanchor[k].copy(),
        _unit(name, data.xaxis[k].copy()),
        float(low),
        float(high),
        damping=float(np.ravel(model.dof_damping[at])[0]),
        friction=float(model.dof_frictionloss[at]),
        armature=float(model.dof_armature[at]),
        stiffness=float(np.ravel(model.jnt_stiffness[k])[0]),
        rest=float(model.qpos_spring[int(joint.qposadr[0])]),
    )

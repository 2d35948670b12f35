"""Muscles as actuators of MuJoCo: MJCF for tendons, actuators, sensors; callbacks for their laws.

MuJoCo's own muscle is a biological one. Here an actuator's activations are the states of feed and
losses (pressure, hysteresis, a valve's spool), and its force that of the fitted law.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import casadi as ca
import numpy as np

from ...core.atomic import atomic_path
from ...core.errors import InputError, UnknownNameError, require_finite, require_positive
from ...core.lazy import library
from ...core.stop import verb
from ...muscles.pneumatic_muscle import Muscle
from ...numerics.solvers import Buffered
from ...plants.alone import muscle_alone
from ...plants.components import as_muscle
from ...plants.damping import Loss
from ...plants.feeds import Feed
from ...plants.limbs import Limb, as_muscles
from ...plants.plant import Plant
from .instructions import REACH, quickest
from .registry import ENDINGS, WORLDS

Way: TypeAlias = "Sequence[str] | Mapping[str, float]"

MOVED = ("length", "speed")


@dataclass(frozen=True)
class MujocoMuscle:
    """A muscle and its way through a MuJoCo model.

    name : of the actuator. muscle, feed, losses : as ``Plant.add_muscle`` takes them.
    way : names of the sites that its tendon leads through, or {joint: moment arm [m]} (1 for a
        slide): the change of its length with the joint.
    offset : its length less that of the tendon [m]: of a way by sites minus what the cords take, of
        a way by joints its length where they are at 0.

    Examples
    --------
    >>> one = pam.export.MujocoMuscle("flexor", "DMSP-20-300", {"slide": -1.0}, offset=0.3)
    >>> one.commands
    ('flexor.command',)
    """

    name: str
    muscle: Muscle | str
    way: Way
    feed: Feed | None = None
    losses: Loss | Sequence[Loss] = ()
    offset: float = 0.0

    def __post_init__(self) -> None:
        require_finite("offset", self.offset)
        sites = not isinstance(self.way, Mapping)
        if not self.way or isinstance(self.way, str) or (sites and len(self.way) < 2):
            raise InputError(
                f"way = {self.way!r}: give two sites or more, or the moment arm of each joint"
            )

    @cached_property
    def plant(self) -> Plant:
        """The muscle alone: length and speed in, force out."""
        muscle = as_muscle(self.muscle)
        return muscle_alone(muscle, feed=self.feed, losses=self.losses, name=self.name)

    @property
    def commands(self) -> tuple[str, ...]:
        """Names of its inputs beside length and speed; each is the control of an actuator."""
        moved = {f"{self.name}.{m}" for m in MOVED}
        return tuple(v.name for v in self.plant.inputs if v.name not in moved)


@verb
def to_mujoco(muscles: MujocoMuscle | Sequence[MujocoMuscle]) -> MujocoMuscles:
    """Muscles for a MuJoCo model: :meth:`MujocoMuscles.mjcf` and :meth:`MujocoMuscles.installed`.

    Raises InputError where MuJoCo is missing, and for names that stand twice.

    Examples
    --------
    >>> one = pam.export.MujocoMuscle("flexor", "DMSP-20-300", {"slide": -1.0}, offset=0.3)
    >>> made = pam.export.to_mujoco([one])  # doctest: +SKIP
    """
    library("mujoco", "mujoco", "to_mujoco")
    return _muscles(muscles)


@verb
def mujoco_limb(limb: Limb, *, timestep: float = 1e-3) -> tuple[Any, MujocoMuscles]:
    """(MuJoCo's model of a limb, its muscles there): the bodies of the limb's file, by RK4.

    Its damping and offsets are the limb's; limits of range and effort and contacts are off. Paths
    are of points alone or of pulleys alone; loads, friction and stops of the limb are not taken
    along.

    Raises InputError where MuJoCo is missing, and for a path that mixes points and pulleys.

    Examples
    --------
    >>> model, made = pam.export.mujoco_limb(arm)  # doctest: +SKIP
    """
    timestep = require_positive("timestep", timestep, "s")
    mujoco = library("mujoco", "mujoco", "mujoco_limb")
    spec = mujoco.MjSpec.from_file(limb.file)
    muscles = []
    for one in limb.muscles:
        pulleys = [e for e in one.path if isinstance(e[1], float)]
        if pulleys and len(pulleys) < len(one.path):
            raise InputError(
                f"muscle {one.name!r}: MuJoCo takes a path of points or of pulleys, not both"
            )
        way: Way = {joint: -radius for joint, radius in pulleys}
        if not pulleys:
            way = [f"{one.name}.{i}" for i in range(len(one.path))]
            for site, (link, xyz) in zip(way, one.path, strict=True):
                (spec.body(link) or spec.worldbody).add_site(name=site, pos=xyz)
        offset = limb.variable(f"{one.name}.offset").start or 0.0
        muscles.append(MujocoMuscle(one.name, one.muscle, way, one.feed, one.losses, offset))
    for joint in limb.joints:
        own = spec.joint(joint.name)
        own.limited = own.actfrclimited = False  # of the range, and of the effort
        damping = limb.variable(f"{joint.name}.damper.coefficient").start or 0.0
        own.damping = [damping, *[0.0] * (np.size(own.damping) - 1)]
        own.frictionloss = 0.0
    made = _muscles(muscles)
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.option.gravity = limb.gravity
    text = spec.to_xml().replace("</mujoco>", f"{made.mjcf()}</mujoco>")
    return mujoco.MjModel.from_xml_string(text), made


@verb
def export_mjcf(
    muscles: MujocoMuscle | Sequence[MujocoMuscle],
    path: str | os.PathLike[str],
    *,
    model: str | os.PathLike[str] | None = None,
) -> Path:
    """Write the tendons, actuators and sensors of muscles as MJCF; returns the path.

    model : an MJCF file whose elements are to stand with them; by default the file has them alone,
        for ``<include file="..."/>`` in a model of one's own.

    Forces need :meth:`MujocoMuscles.installed`, in Python: MJCF has no words for these laws.

    Raises InputError for a model that is no MJCF, and for names that stand twice.

    Examples
    --------
    >>> one = pam.export.MujocoMuscle("flexor", "DMSP-20-300", {"slide": -1.0}, offset=0.3)
    >>> pam.export.export_mjcf([one], "muscles.xml").name
    'muscles.xml'
    """
    elements = _muscles(muscles).elements()
    if model is None:
        root = ET.Element("mujocoinclude")
    else:
        try:
            root = ET.parse(model).getroot()
        except (ET.ParseError, OSError) as error:
            raise InputError(f"model = {os.fspath(model)!r} is no MJCF file: {error}") from None
        if root.tag != "mujoco":
            raise InputError(f"model = {os.fspath(model)!r} is no MJCF: its root is <{root.tag}>")
    root.extend(elements)
    ET.indent(root)
    with atomic_path(path) as file:
        file.write_text(ET.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
    return Path(path)


@WORLDS.register("mujoco")
def _muscles_of(
    muscles: MujocoMuscle | Sequence[MujocoMuscle],
    path: str | os.PathLike[str] | None = None,
    **options: Any,
) -> Any:
    """Muscles as actuators of MuJoCo: callbacks, or with a path the elements of a model's file."""
    return to_mujoco(muscles) if path is None else export_mjcf(muscles, path, **options)


ENDINGS[".xml"] = "mujoco"


def _muscles(muscles: MujocoMuscle | Sequence[MujocoMuscle]) -> MujocoMuscles:
    words = (
        "MuJoCo has the masses and takes muscles alone: give MujocoMuscle(name, muscle, way, ...)"
    )
    return MujocoMuscles(as_muscles(muscles, MujocoMuscle, words))


@dataclass(frozen=True)
class MujocoMuscles:
    """Muscles of one model.

    Examples
    --------
    >>> one = pam.export.MujocoMuscle("flexor", "DMSP-20-300", {"slide": -1.0}, offset=0.3)
    >>> "actuatorfrc" in pam.export.MujocoMuscles((one,)).mjcf()
    True
    """

    muscles: tuple[MujocoMuscle, ...]

    def mjcf(self) -> str:
        """The elements tendon, actuator and sensor as text, to stand within ``<mujoco>``."""
        made = self.elements()
        for element in made:
            ET.indent(element)
        return "\n".join(ET.tostring(e, encoding="unicode") for e in made)

    def elements(self) -> list[ET.Element]:
        """The same as elements."""
        tendons, actuators, sensors = (ET.Element(t) for t in ("tendon", "actuator", "sensor"))
        for one in self.muscles:
            tendon = f"{one.name}.tendon"
            if isinstance(one.way, Mapping):
                way = ET.SubElement(tendons, "fixed", name=tendon)
                for joint, arm in one.way.items():
                    ET.SubElement(way, "joint", joint=joint, coef=repr(float(arm)))
            else:
                way = ET.SubElement(tendons, "spatial", name=tendon, width="0.01")
                for site in one.way:
                    ET.SubElement(way, "site", site=site)
            states = len(one.plant.states)
            kind = {"dyntype": "user", "actdim": str(states)} if states else {"dyntype": "none"}
            force = {"gaintype": "fixed", "gainprm": "0", "biastype": "user"}
            for i, command in enumerate(one.commands or ("",)):
                name = one.name if i == 0 else command
                given = {**kind, **force} if i == 0 else {"gainprm": "0"}
                if command:
                    v = one.plant.variable(command)
                    given |= {"ctrllimited": "true", "ctrlrange": f"{v.min!r} {v.max!r}"}
                ET.SubElement(actuators, "general", {"name": name, "tendon": tendon, **given})
            ET.SubElement(sensors, "actuatorfrc", name=f"{one.name}.force", actuator=one.name)
            ET.SubElement(sensors, "tendonpos", name=f"{one.name}.length", tendon=tendon)
            ET.SubElement(sensors, "tendonvel", name=f"{one.name}.speed", tendon=tendon)
        return [tendons, actuators, sensors]

    # ---- in the engine ------------------------------------------------------------------------
    @contextmanager
    def installed(self, model: Any) -> Iterator[MujocoMuscles]:
        """MuJoCo computes these muscles of this (loaded) model in the ``with``.

        Callbacks belong to the whole process: one set of muscles at a time, and MuJoCo cannot load
        another model meanwhile. What was set before is set again behind it.

        Raises InputError where the model's time step is too long for the quickest state (which says
        how long it may be), or an actuator of these muscles is missing.
        """
        import mujoco

        laws = self._laws(model)

        def dynamics(m: Any, d: Any, i: int) -> float:
            law = laws.get(i)
            if law is None:
                return 0.0
            slopes = law.evaluated(d)[0]
            d.act_dot[law.begin : law.begin + law.count] = slopes
            return float(slopes[0])

        def bias(m: Any, d: Any, i: int) -> float:
            law = laws.get(i)
            return 0.0 if law is None else -float(law.evaluated(d)[1])

        before = mujoco.get_mjcb_act_dyn(), mujoco.get_mjcb_act_bias()
        mujoco.set_mjcb_act_dyn(dynamics)
        mujoco.set_mjcb_act_bias(bias)
        try:
            yield self
        finally:
            mujoco.set_mjcb_act_dyn(before[0])
            mujoco.set_mjcb_act_bias(before[1])

    def reset(self, model: Any, data: Any, values: Mapping[str, float] | None = None) -> None:
        """Start states into ``data.act``, start commands into ``data.ctrl``.

        values : other states and commands by name. Raises UnknownNameError.
        """
        known = {v.name: v for m in self.muscles for v in (*m.plant.states, *m.plant.inputs)}
        for name in values or {}:
            if name not in known:
                raise UnknownNameError("values", name, list(known))
        for law in self._laws(model, checked=False).values():
            plant = law.muscle.plant
            own = [(values or {}).get(v.name, v.start) for v in plant.states]
            data.act[law.begin : law.begin + law.count] = own
            for at, name in zip(law.controls, law.muscle.commands, strict=True):
                data.ctrl[at] = (values or {}).get(name, plant.variable(name).start)

    def _laws(self, model: Any, checked: bool = True) -> dict[int, _Law]:
        laws = {}
        for one in self.muscles:
            law = _Law(one, model)
            if checked:
                law.check(float(model.opt.timestep))
            laws[law.actuator] = law
        return laws


class _Law:
    """One muscle in one model: where it stands there, and what computes it."""

    def __init__(self, muscle: MujocoMuscle, model: Any) -> None:
        self.muscle, plant = muscle, muscle.plant
        names = [muscle.name, *muscle.commands[1:]]
        found = [_actuator(model, n) for n in names]
        self.actuator = found[0]
        self.controls = found if muscle.commands else []
        self.begin = int(model.actuator_actadr[self.actuator])
        self.count = len(plant.states)
        if self.count and int(model.actuator_actnum[self.actuator]) != self.count:
            raise InputError(
                f"actuator {muscle.name!r} of the model has {model.actuator_actnum[self.actuator]} "
                f"activations, the muscle {self.count} states; write its MJCF anew"
            )
        p = plant.vector("parameter")
        x, u = ca.SX.sym("x", self.count), ca.SX.sym("u", len(plant.inputs))
        slopes = plant.function(x, u, p)[0]
        names = [v.name for v in plant.outputs]
        force = plant.function(x, u, p)[1][names.index(f"{muscle.name}.force")]
        results = [ca.densify(slopes), ca.densify(force)]
        self._function = Buffered(ca.Function("muscle", [x, u], ca.cse(results)))
        inputs = [v.name for v in plant.inputs]
        self._moved = [inputs.index(f"{muscle.name}.{m}") for m in MOVED]
        self._commanded = [inputs.index(c) for c in muscle.commands]

    def evaluated(self, data: Any) -> tuple[Any, Any]:
        """(slopes of the states, force) now."""
        x, u = self._function.arguments
        x[:] = data.act[self.begin : self.begin + self.count]
        length, speed = self._moved
        u[length] = data.actuator_length[self.actuator] + self.muscle.offset
        u[speed] = data.actuator_velocity[self.actuator]
        for at, control in zip(self._commanded, self.controls, strict=True):
            u[at] = data.ctrl[control]
        self._function.call()
        slopes, force = self._function.results
        return slopes[:, 0], force[0, 0]

    def check(self, step: float) -> None:
        """Refuse a time step that this muscle's states do not stand."""
        plant = self.muscle.plant
        fastest = quickest(plant, plant.vector("input")) if self.count else 0.0
        if fastest * step > REACH:
            raise InputError(
                f"timestep = {step:g} s is too long for {self.muscle.name!r}, whose quickest state "
                f"allows {REACH / fastest:.2g} s; set the model's option timestep"
            )


def _actuator(model: Any, name: str) -> int:
    import mujoco

    found = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_ACTUATOR, name)
    if found < 0:
        raise InputError(
            f"the model has no actuator {name!r}; put MujocoMuscles.mjcf() or the file of "
            "export_mjcf into it"
        )
    return int(found)

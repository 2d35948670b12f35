"""Static optimisation: which pressures give a limb's joints the moments that a motion needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, UnknownNameError, require_numbers
from ..core.stop import verb
from ..numerics.solvers import nlpsol, quiet_ipopt
from ..plants.components import as_muscle
from ..plants.limbs import Limb

Array: TypeAlias = NDArray[np.float64]
Given: TypeAlias = "Mapping[str, ArrayLike] | None"

COSTS = ("stiffness", "force", "air")
REACHED = 1e-6
"""Part of the muscles' largest moment (of the stiffness at half pressure) that counts as missed."""
TIE = 1e-6
"""Weight of squared pressures, which decide where the cost leaves a choice."""


@dataclass(frozen=True, eq=False)
class StaticOptimisation:
    """Pressures for moments, over time. Arrays have one value for each instant.

    pressures [Pa] and forces [N] by muscle; moments : what the joints need [N m or N], missing :
    what of it no pressures give; stiffness : of the joints [N m/rad or N/m], as found.
    reached : whether moments (and stiffnesses, where asked for) are those wanted.

    Examples
    --------
    >>> found = arm.static_optimisation({"elbow": 0.5})  # doctest: +SKIP
    >>> print(found.verdict)  # doctest: +SKIP
    reached at all 1 instants
    """

    pressures: dict[str, Array]
    forces: dict[str, Array]
    moments: dict[str, Array]
    missing: dict[str, Array]
    stiffness: dict[str, Array]
    wanted_stiffness: dict[str, Array]
    reached: NDArray[np.bool_]

    @property
    def verdict(self) -> str:
        """One line: reached, or at how many instants not, and what is missing most."""
        lost = int(np.sum(~self.reached))
        if not lost:
            return f"reached at all {len(self.reached)} instants"
        worst = max(self.missing, key=lambda name: float(np.max(np.abs(self.missing[name]))))
        at = int(np.argmax(np.abs(self.missing[worst])))
        short = float(self.missing[worst][at])
        text = f"NOT REACHED at {lost} of {len(self.reached)} instants: "
        if abs(short) > 0:
            return text + f"{worst} lacks a moment of {short:.3g} at instant {at}"
        gaps = {n: self.stiffness[n] - v for n, v in self.wanted_stiffness.items()}
        worst = max(gaps, key=lambda name: float(np.max(np.abs(gaps[name]))))
        at = int(np.argmax(np.abs(gaps[worst])))
        nearest, asked = self.stiffness[worst][at], self.wanted_stiffness[worst][at]
        return text + f"{worst} has a stiffness of {nearest:.3g}, not {asked:.3g}, at instant {at}"

    def __repr__(self) -> str:
        return f"<StaticOptimisation: {self.verdict}>"


@verb
def static_optimisation(
    limb: Limb,
    positions: Mapping[str, ArrayLike],
    velocities: Given = None,
    accelerations: Given = None,
    *,
    minimise: str = "stiffness",
    stiffness: Given = None,
) -> StaticOptimisation:
    """Pressures within their limits that give the joints the moments of a motion.

    limb : its parameters count. positions, velocities, accelerations : {joint: a number, or one for
        each instant}; joints that are not named stay at their start values, at rest.
    minimise : "stiffness", the squared stiffnesses of the joints (least co-contraction); "force",
        the squared forces by the largest; "air", the mass of air in the muscles.
    stiffness : {joint: wanted stiffness [N m/rad or N/m]}, kept besides the moments; the rest is
        chosen by ``minimise``.

    IPOPT solves each instant, with the laws' exact derivatives; losses of the muscles are left out.
    Where moments are out of reach, the pressures are those of the nearest ones; where stiffnesses
    are, of the nearest with these moments. Muscles stay taut, where any pressure makes them so.

    Raises InputError, UnknownNameError for joints that are none.

    Examples
    --------
    >>> held = pam.operating.static_optimisation(
    ...     arm, {"elbow": 0.5}, stiffness={"elbow": 30.0}
    ... )  # doctest: +SKIP
    """
    if not isinstance(limb, Limb):
        raise InputError("static_optimisation needs a limb, pam.plants.limb(...)")
    if minimise not in COSTS:
        raise UnknownNameError("minimise", minimise, COSTS)
    problem = _Problem(limb, minimise, stiffness or {})
    x, acceleration = _instants(limb, positions, velocities, accelerations, problem.wanted)
    rows = [problem.solved(x[:, k], acceleration[:, k], k) for k in range(x.shape[1])]
    muscles, joints = [m.name for m in limb.muscles], [j.name for j in limb.joints]
    columns = [np.array(column).T for column in zip(*rows, strict=True)]
    names = (muscles, muscles, joints, joints, joints)
    pressures, forces, moments, missing, stiff = (
        dict(zip(n, c, strict=True)) for n, c in zip(names, columns[:5], strict=True)
    )
    wanted = {n: np.broadcast_to(v, x.shape[1]) for n, v in problem.wanted.items()}
    reached = np.asarray(columns[5], bool)
    return StaticOptimisation(pressures, forces, moments, missing, stiff, wanted, reached)


class _Problem:
    """What is solved at each instant."""

    def __init__(self, limb: Limb, minimise: str, stiffness: Mapping[str, ArrayLike]) -> None:
        self.limb, self.minimise = limb, minimise
        self.names = [j.name for j in limb.joints]
        self.wanted = {_joint(limb, n): _row(f"stiffness of {n}", v) for n, v in stiffness.items()}
        self.low, self.high = _limits(limb)
        quantities = ["required", "arms", "force", "stiffness", "taut"]
        if minimise == "air":
            quantities.append("air")
        try:
            self.at = limb.anatomy(*quantities)
        except KeyError:
            raise InputError(
                'minimise = "air" needs the volume of each muscle: give Muscle(diameter=...) and a '
                "law of which a volume follows"
            ) from None
        self.u, self.p = limb.vector("input"), limb.vector("parameter")
        self.chosen = np.array([self.names.index(n) for n in self.wanted], int)
        self._solvers = {kept: self._solver(kept) for kept in (2, 1, 0)}

    def _solver(self, kept: int) -> Any:
        """kept: 2 moments and stiffnesses, at least cost; 1 moments, nearest stiffnesses; 0 none,
        nearest moments.
        """
        joints = len(self.names)
        share = ca.SX.sym("share", len(self.low))  # of the range of pressure
        sizes = [len(self.limb.states), joints, len(self.chosen), len(self.low), joints, joints]
        given = ca.SX.sym("given", sum(sizes))
        x, needed, aim, most, torque, usual = ca.vertsplit(given, [0, *np.cumsum(sizes).tolist()])
        pressures = self.low + share * (self.high - self.low)
        found = self.at(x, self.u, self.p, np.zeros(joints), pressures)
        arms, force, stiff, taut = found[1:5]
        chosen = ca.DM(np.eye(joints)[self.chosen])
        gaps = (arms.T @ force - needed) / torque, (chosen @ stiff - aim) / (chosen @ usual)
        if kept < 2:
            cost = ca.sumsqr(gaps[kept])
        elif self.minimise == "air":
            cost = 1e3 * ca.sum1(found[5])
        else:
            cost = ca.sumsqr(stiff / usual if self.minimise == "stiffness" else force / most)
        nlp = {"x": share, "p": given, "f": cost + TIE * ca.sumsqr(share)}
        nlp["g"] = ca.vertcat(taut / most, *gaps[:kept])
        return nlpsol("static", "ipopt", nlp, quiet_ipopt(max_iter=200, tol=1e-10))

    def solved(self, x: Array, acceleration: Array, k: int) -> tuple[Any, ...]:
        """(pressures, forces, moments, missing, stiffness, reached) at one instant."""
        needed, arms, most, _, room = self._values(x, acceleration, self.high)
        pulling, most = room > 0, np.maximum(most, 1.0)  # others are slack at any pressure
        usual = np.maximum(np.abs(self._values(x, acceleration, self.high / 2)[3]), 1e-6)
        torque = np.maximum(np.abs(arms).T @ most, 1e-6)
        aim = np.array([v[min(k, v.size - 1)] for v in self.wanted.values()])
        given = np.concatenate([x, needed, aim, most, torque, usual])
        start = 0.5 * pulling
        for kept in (2, 1, 0, 2) if self.wanted else (2, 0, 2):
            solver = self._solvers[kept]
            equal = np.zeros([0, len(self.names), len(self.names) + len(self.chosen)][kept])
            low = np.concatenate([np.where(pulling, 0.0, -np.inf), equal])
            high = np.concatenate([np.full(len(pulling), np.inf), equal])
            found = solver(x0=start, p=given, lbx=0.0, ubx=1.0 * pulling, lbg=low, ubg=high)
            share = np.clip(np.array(found["x"]).ravel(), 0.0, 1.0)
            pressures = self.low + share * (self.high - self.low)
            _, _, force, stiff, _ = self._values(x, acceleration, pressures)
            missing = needed - arms.T @ force
            gaps = [missing / torque, (stiff[self.chosen] - aim) / usual[self.chosen]]
            reached = bool(np.all(np.abs(np.concatenate(gaps)) <= REACHED))
            if solver.stats()["success"] and (reached if kept != 1 else True):
                if kept:
                    break
                start = share  # reachable after all: once more, from there
            elif kept == 0:
                break
        missing[np.abs(missing) <= REACHED * torque] = 0.0
        return pressures, force, needed, missing, stiff, reached

    def _values(self, x: Array, acceleration: Array, pressures: Array) -> list[Array]:
        """Moments needed, moment arms, forces, stiffness of the joints, distance from slack."""
        found = self.at(x, self.u, self.p, acceleration, pressures)
        required, arms, force, stiff, taut = (np.array(f) for f in found[:5])
        return [required.ravel(), arms, force.ravel(), stiff.ravel(), taut.ravel()]


def _instants(
    limb: Limb, positions: Given, velocities: Given, accelerations: Given, wanted: Given
) -> tuple[Array, Array]:
    """(states, accelerations), a column for each instant."""
    names = [j.name for j in limb.joints]
    tables = [
        {_joint(limb, n): _row(f"{word} of {n}", v) for n, v in (given or {}).items()}
        for word, given in (
            ("position", positions),
            ("velocity", velocities),
            ("acceleration", accelerations),
        )
    ]
    sizes = {v.size for t in (*tables, wanted or {}) for v in t.values()}  # type: ignore[union-attr]
    count = max(sizes, default=1)
    if sizes - {1, count}:
        raise InputError(f"the joints have {sizes} values: give one each, or one for each instant")
    x = np.tile(limb.vector("state")[:, None], count)
    acceleration = np.zeros((len(names), count))
    states = [v.name for v in limb.states]
    for rows, table, ending in (
        (x, tables[0], ""),
        (x, tables[1], ".velocity"),
        (acceleration, tables[2], None),
    ):
        for name, values in table.items():
            at = names.index(name) if ending is None else states.index(name + ending)
            rows[at] = values
    return x, acceleration


def _row(argument: str, values: Any) -> Array:
    return np.atleast_1d(np.asarray(require_numbers(argument, values), float)).ravel()


def _joint(limb: Limb, name: str) -> str:
    names = [j.name for j in limb.joints]
    if name not in names:
        raise UnknownNameError(f"joint of limb {limb.name!r}", name, names)
    return name


def _limits(limb: Limb) -> tuple[Array, Array]:
    """Smallest and largest pressure of each muscle [Pa]: the plant's bounds, or its law's range."""
    ends = []
    for one in limb.muscles:
        variable = limb.variable(f"{one.name}.pressure")
        own = as_muscle(one.muscle).pressure_range
        given = (variable.min, variable.max)
        ends.append([g if np.isfinite(g) else o for g, o in zip(given, own, strict=True)])
    low, high = np.array(ends, float).T
    return low, high

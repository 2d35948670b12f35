"""Periodic collocation: a closed motion as polynomials on a mesh, its period among the unknowns.

On each interval of the mesh the state is a polynomial through its start and the Radau points and
meets the plant's equation there; the last interval ends where the first begins. Two rows more fix
the phase and the place on the branch. Sources: Ascher, Mattheij, Russell, Numerical Solution of
Boundary Value Problems, SIAM 1995; Doedel, Keller, Kernevez, Int. J. Bifurcation and Chaos 1
(1991) 745-772 (elimination inside the intervals, phase condition, pseudo-arclength).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.system import System
from .collocation import collocation_matrices, collocation_points, lagrange
from .newton import Array, NewtonError, newton

S = TypeVar("S", bound=System)

COLLAPSED = 1e-5
"""Below this amplitude, scaled by nominals, a closed motion is an equilibrium."""

SHRUNK = 0.05
"""A failed search whose motion has shrunk to this part of the guess was on the way to rest."""

COLLAPSE = (
    "it collapses to an equilibrium; start from a larger oscillation, or choose parameters beyond "
    "the Hopf border"
)


@dataclass(frozen=True)
class Orbit:
    """A closed motion in scaled numbers.

    mesh : (n + 1,) from 0 to 1. z : (n, degree, nx) states scaled by nominals at the Radau points.
    period [s]; lam : the varying value in units of its nominal.
    """

    mesh: Array
    z: Array
    period: float
    lam: float

    @property
    def starts(self) -> Array:
        """States at the beginnings of the intervals, (n, nx)."""
        return np.asarray(np.roll(self.z[:, -1], 1, axis=0))

    @property
    def swing(self) -> float:
        """The largest distance between two values of a state, scaled by nominals."""
        return float(np.max(np.ptp(self.z, axis=(0, 1))))

    def at(self, s: Array, order: int = 0) -> Array:
        """States (or d/ds of them) at fractions s of the period, (len(s), nx)."""
        s = np.where(s == 1.0, 1.0, s % 1.0)  # the end belongs to the last interval
        i = np.clip(np.searchsorted(self.mesh, s, side="right") - 1, 0, len(self.z) - 1)
        h = np.diff(self.mesh)[i]
        through = (0.0, *radau(self.z.shape[1]).tolist())
        basis = np.stack(lagrange(through, (s - self.mesh[i]) / h, order), axis=-1)
        nodes = np.concatenate([self.starts[:, None], self.z], axis=1)
        return np.asarray(np.einsum("sj,sjx->sx", basis, nodes[i])) / h[:, None] ** order

    def on(self, mesh: Array) -> Orbit:
        """The same motion, interpolated on another mesh."""
        points = fractions(mesh, radau(self.z.shape[1]))
        return replace(self, mesh=mesh, z=self.at(points.ravel()).reshape(*points.shape, -1))


@dataclass(frozen=True)
class Row:
    """A linear condition on an orbit: mean of z . direction + period share + lam share = right.

    z : (n, degree, nx) direction on the points of a mesh; period [1/s] and lam as plain factors.
    """

    z: Array
    period: float
    lam: float
    right: float

    def through(self, orbit: Orbit) -> Row:
        """The same direction, the right side such that this orbit meets it."""
        return replace(self, right=self.right + self.missed(orbit))

    def missed(self, orbit: Orbit) -> float:
        """Left less right side."""
        weights = _weights(orbit.mesh, self.z.shape[1])[..., None]
        mean = float(np.sum(weights * self.z * orbit.z))
        return mean + self.period * orbit.period + self.lam * orbit.lam - self.right

    def times(self, factor: float) -> Row:
        """The direction multiplied by a factor."""
        return Row(factor * self.z, factor * self.period, factor * self.lam, factor * self.right)

    def dot(self, other: Row, orbit: Orbit) -> float:
        """Inner product of two directions at an orbit; the period counts relative to itself."""
        weights = _weights(orbit.mesh, self.z.shape[1])[..., None]
        mean = float(np.sum(weights * self.z * other.z))
        return mean + self.period * other.period * orbit.period**2 + self.lam * other.lam

    def on(self, old: Array, mesh: Array) -> Row:
        """The same direction on another mesh."""
        return replace(self, z=Orbit(old, self.z, 0.0, 0.0).on(mesh).z)


class Periodic(Generic[S]):
    """The equations of a closed motion of a plant, one value of it left to vary.

    parameter : name of a parameter or an input, or None when nothing varies. Inputs are constant.
    """

    def __init__(self, plant: S, parameter: str | None, degree: int) -> None:
        self.plant, self.degree = plant, degree
        self.nominal = plant.vector("state", attribute="nominal")
        self.variable = None if parameter is None else plant.variable(parameter)
        self.constants = np.concatenate([plant.vector("input"), plant.vector("parameter")])
        names = [v.name for v in (*plant.inputs, *plant.parameters)]
        self.place = np.zeros(len(names))
        self.lam = 0.0
        """The plant's own value of what varies, scaled by nominals (0 when nothing does)."""
        if self.variable is not None:
            # constants and place * lam add up: the varying one stands in place alone
            i = names.index(self.variable.name)
            self.place[i] = self.variable.nominal
            self.lam = float(self.constants[i] / self.variable.nominal)
            self.constants[i] = 0.0

    def stage(self) -> ca.Function:
        """One interval: (start, points, step, lam, constants) -> defects,
        Jacobians in the first 4.
        """
        nx, nu, degree = len(self.nominal), len(self.plant.inputs), self.degree
        start, points = ca.SX.sym("start", nx), ca.SX.sym("points", nx, degree)
        step, lam = ca.SX.sym("step"), ca.SX.sym("lam")
        constants = ca.SX.sym("constants", len(self.constants))
        values = constants + self.place * lam
        derivative = collocation_matrices(radau(degree))[0]
        slopes = ca.horzcat(start, points) @ ca.DM(derivative)
        rates = [
            self.plant.function(points[:, j] * self.nominal, values[:nu], values[nu:])[0]
            / self.nominal
            for j in range(degree)
        ]
        defects = ca.vec(slopes - step * ca.horzcat(*rates))
        flat = ca.vec(points)
        return ca.Function(
            "stage",
            [start, flat, step, lam, constants],
            [defects, *(ca.densify(ca.jacobian(defects, s)) for s in (start, flat, step, lam))],
        )

    def linearised(self, orbit: Orbit) -> _Linearised:
        """Defects of an orbit and their exact Jacobian, interval by interval."""
        n, degree, nx = orbit.z.shape
        size = degree * nx
        key = ("periodic", self.place.tobytes(), degree)
        h = np.diff(orbit.mesh)
        found = self.plant.cached(key, self.stage).map(n)(
            orbit.starts.T,
            orbit.z.reshape(n, size).T,
            orbit.period * h[None, :],
            orbit.lam,
            self.constants,
        )
        defects, *blocks = (np.asarray(m).reshape(size, n, -1).transpose(1, 0, 2) for m in found)
        start, points, step, lam = blocks
        return _Linearised(defects[..., 0], start, points, step[..., 0] * h[:, None], lam[..., 0])

    def phase(self, orbit: Orbit) -> Row:
        """Mean of (z - orbit) . orbit' = 0: no shift in time against this orbit."""
        s = fractions(orbit.mesh, radau(self.degree))
        slope = orbit.at(s.ravel(), 1).reshape(orbit.z.shape)
        return Row(slope / np.sqrt(np.mean(slope**2)), 0.0, 0.0, 0.0).through(orbit)

    def solve(self, orbit: Orbit, row: Row, tolerance: float = 1e-11) -> Orbit:
        """The closed motion near ``orbit`` that meets ``row`` too."""
        rows = (self.phase(orbit), row)
        like, scale = orbit, orbit.period

        def unpacked(w: Array) -> Orbit:
            return replace(
                like, z=w[:-2].reshape(like.z.shape), period=float(w[-2]) * scale, lam=float(w[-1])
            )

        def equations(w: Array) -> tuple[Array, Callable[[Array], Array]]:
            trial = unpacked(w)
            system = self.linearised(trial)
            residual = np.concatenate([system.defects.ravel(), [r.missed(trial) for r in rows]])
            return residual, lambda right: system.solve(right, rows, like.mesh, scale)

        start = np.concatenate([like.z.ravel(), [1.0, like.lam]])
        try:
            w, _ = newton(equations, start, tolerance=tolerance)
        except NewtonError as error:
            # towards rest Newton creeps, since there any period will do
            if error.last is not None and unpacked(error.last).swing < SHRUNK * like.swing:
                raise NewtonError(COLLAPSE) from None
            raise
        if w[-2] <= 0:
            raise NewtonError("Newton's method ran to a period that is not positive")
        found = unpacked(w)
        if found.swing < 2 * COLLAPSED:
            raise NewtonError(COLLAPSE)
        return found

    def tangent(self, orbit: Orbit, row: Row) -> Row:
        """The direction of the branch at an orbit, of length 1, with row . tangent > 0."""
        n, degree, nx = orbit.z.shape
        right = np.zeros(n * degree * nx + 2)
        right[-1] = 1.0
        rows = (self.phase(orbit), row)
        w = self.linearised(orbit).solve(right, rows, orbit.mesh, orbit.period)
        found = Row(w[:-2].reshape(orbit.z.shape), w[-2] / orbit.period, w[-1], 0.0)
        return found.times(1 / np.sqrt(found.dot(found, orbit)))

    def multipliers(self, orbit: Orbit) -> NDArray[np.complex128]:
        """Floquet multipliers: first that of a shift in time, which is 1, then by falling size."""
        values, vectors = np.linalg.eig(self.linearised(orbit).monodromy)
        flow = orbit.at(np.zeros(1), 1)[0]
        along = np.abs(flow @ vectors) / np.linalg.norm(flow)
        # near a fold two eigenvectors lie nearly along the flow: the value nearest 1 is the one
        candidates = np.flatnonzero(along > 0.99 * along.max())
        trivial = candidates[np.argmin(np.abs(values[candidates] - 1))]
        others = np.delete(values, trivial)
        ordered = np.concatenate([values[[trivial]], others[np.argsort(-np.abs(others))]])
        return np.asarray(ordered, dtype=complex)

    def trivial_error(self, orbit: Orbit) -> float:
        """How far the monodromy fails to carry the flow into itself, relative to the flow."""
        flow = orbit.at(np.ones(1), 1)[0]
        carried = self.linearised(orbit).monodromy @ flow
        return float(np.linalg.norm(carried - flow) / np.linalg.norm(flow))

    # ---- the mesh -----------------------------------------------------------------------------
    def errors(self, orbit: Orbit) -> Array:
        """Estimated error of each interval scaled by nominals: the defect between the points."""
        inner = np.concatenate([[0.0], radau(self.degree)])
        s = fractions(orbit.mesh, (inner[:-1] + inner[1:]) / 2)
        values = self.constants + self.place * orbit.lam
        nu = len(self.plant.inputs)
        x = (orbit.at(s.ravel()) * self.nominal).T
        xdot = np.asarray(self.plant.function(x, values[:nu], values[nu:])[0])
        defect = orbit.at(s.ravel(), 1) - orbit.period * xdot.T / self.nominal
        worst = np.abs(defect).reshape(*s.shape, -1).max(axis=(1, 2))
        return np.asarray(worst * np.diff(orbit.mesh) / self.degree)

    def refined(self, mesh: Array, errors: Array, tolerance: float) -> Array:
        """A mesh whose intervals above the tolerance are split.

        Where a muscle goes slack, the force's third derivative turns within a very short time: the
        error there falls slowly, and is met by splitting again and again.
        """
        pieces = np.ceil((errors / (0.3 * tolerance)) ** (1 / (self.degree + 1)))
        pieces[errors <= tolerance] = 1
        starts = [
            np.linspace(low, high, int(n), endpoint=False)
            for low, high, n in zip(mesh[:-1], mesh[1:], pieces, strict=True)
        ]
        return np.append(np.concatenate(starts), 1.0)

    def coarsened(self, orbit: Orbit, tolerance: float, least: int) -> Array:
        """A mesh with neighbours joined as long as the joint error would stay below the tolerance.

        Along a branch slack phases move: this takes away the small intervals that they leave.
        """
        mesh, errors = orbit.mesh, self.errors(orbit)
        density = (errors / (0.1 * tolerance)) ** (1 / (self.degree + 1)) / np.diff(mesh)
        density[errors < 0.02 * tolerance] /= 4  # mostly rounding, which no power governs
        keep, begin = [0], 0
        for i in range(1, len(errors)):
            joint = (mesh[i + 1] - mesh[begin]) * density[begin : i + 1].max()
            if joint > 1 or mesh[i + 1] - mesh[begin] > 1 / least:
                keep.append(i)
                begin = i
        return np.append(mesh[keep], 1.0)


@dataclass(frozen=True)
class _Linearised:
    """Defects (n, m) of all intervals and their derivatives, m = degree * nx.

    start (n, m, nx), points (n, m, m), period (n, m) [1/s], lam (n, m).
    """

    defects: Array
    start: Array
    points: Array
    period: Array
    lam: Array

    @property
    def monodromy(self) -> Array:
        """The exact derivative of the collocated motion's end with respect to its start, scaled."""
        nx = self.start.shape[2]
        maps = -np.linalg.solve(self.points, self.start)[:, -nx:]
        total = np.eye(nx)
        for one in maps:
            total = one @ total
        return total

    def solve(self, right: Array, rows: tuple[Row, Row], mesh: Array, scale: float) -> Array:
        """The step (points, period/scale, lam) for which Jacobian . step = right.

        The inner points of each interval are eliminated first; what remains couples the ends of
        the intervals, the period and lam.
        """
        n, m, nx = self.start.shape
        bordered = [self.start, self.period[..., None] * scale, self.lam[..., None]]
        known = np.concatenate([*bordered, right[:-2].reshape(n, m, 1)], axis=2)
        inner = np.linalg.solve(self.points, known)
        # points_i = known - start_i . end_(i-1) - (period, lam): dz_i in terms of the ends
        size = n * nx
        matrix, rest = np.zeros((size + 2, size + 2)), np.zeros(size + 2)
        last = inner[:, -nx:]
        matrix[:size, :size] = np.eye(size)
        for i in range(n):
            before = (i - 1) % n
            here, there = slice(i * nx, i * nx + nx), slice(before * nx, before * nx + nx)
            matrix[here, there] += last[i, :, :nx]
        matrix[:size, size:] = last[:, :, nx : nx + 2].reshape(size, 2)
        rest[:size] = last[:, :, -1].ravel()
        for k, row in enumerate(rows):
            weighted = (_weights(mesh, row.z.shape[1])[..., None] * row.z).reshape(n, m)
            parts = np.einsum("im,imj->ij", weighted, inner)
            matrix[size + k, :size] = -np.roll(parts[:, :nx], -1, axis=0).ravel()
            matrix[size + k, size:] = -parts[:, nx : nx + 2].sum(axis=0)
            matrix[size + k, size:] += [row.period * scale, row.lam]
            rest[size + k] = right[k - 2] - parts[:, -1].sum()
        reduced = np.linalg.solve(matrix, rest)
        ends = np.roll(reduced[:size].reshape(n, nx), 1, axis=0)
        z = inner[..., -1] - np.einsum("imj,ij->im", inner[..., :nx], ends)
        z -= inner[..., nx : nx + 2] @ reduced[size:]
        return np.concatenate([z.ravel(), reduced[size:]])


def fractions(mesh: Array, inside: Array) -> Array:
    """The points ``inside`` (of 0 .. 1) of each interval of the mesh, (n, len(inside))."""
    return np.asarray(mesh[:-1, None] + np.diff(mesh)[:, None] * inside)


def radau(degree: int) -> Array:
    """The Radau points in (0, 1], the last is 1."""
    return collocation_points("radau", degree)


def _weights(mesh: Array, degree: int) -> Array:
    """Quadrature weights of the mean over the period, (n, degree)."""
    return np.outer(np.diff(mesh), collocation_matrices(radau(degree))[2])

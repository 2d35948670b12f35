"""Hopf points: where a pair of eigenvalues crosses the imaginary axis and vibration is born.

Source: Kuznetsov, Elements of Applied Bifurcation Theory, 3rd ed., Springer 2004, sections 5.4
(first Lyapunov coefficient) and 10.2 (the augmented system).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import courtesy
from ..core.errors import InputError, PamError, VibrationError
from ..core.shown import shown
from ..core.stop import TimeIsUp, deadline, verb
from ..numerics.newton import Array, NewtonError, casadi_equations, newton
from ..operating.along import StabilityPath, stability_path
from ..operating.held import Memory
from ..operating.rest import VariedRest
from ..operating.resting_point import OperatingPoint
from ..plants.plant import Plant, Values

if TYPE_CHECKING:
    from matplotlib.figure import Figure


WIDE = 30.0
"""Ratio of a bracket's ends from which it is searched in equal ratios."""
FINER = 2
"""So often a step of the search is searched again, where eigenvalues change sides unseen."""


@shown
@dataclass(frozen=True, eq=False)
class HopfPoint:
    """An equilibrium with a pair of eigenvalues +-i omega.

    Examples
    --------
    >>> border.value > 1e5, round(border.frequency, 1), border.supercritical
    (True, 2.9, True)
    """

    point: OperatingPoint
    """The equilibrium; ``point.plant`` holds the parameters of the Hopf point."""
    parameter: str
    value: float
    """Value of the parameter there [its unit]."""
    frequency: float
    """omega/2 pi [Hz]."""
    crossing: float
    """Rate of the real part with the parameter [1/s per unit]: > 0, unstable above ``value``."""
    lyapunov: float
    """First Lyapunov coefficient [1/s, states scaled by nominals]: < 0, stable cycles are born."""
    mode: NDArray[np.complex128] = field(repr=False)
    """Eigenvector in SI, its largest scaled entry 1: x(t) = rest + Re(mode e^(i omega t))."""
    residual: float = 0.0
    """Of the augmented system, scaled by nominals."""

    @property
    def plant(self) -> Plant:
        """The plant with its parameters, inputs and states at the Hopf point."""
        return self.point.plant

    @property
    def supercritical(self) -> bool:
        """Whether the cycle that is born is stable and exists where the rest is unstable.

        Else it is unstable, exists beside the stable rest, and a larger vibration may stand there.
        """
        return self.lyapunov < 0

    def __str__(self) -> str:
        variable = self.plant.variable(self.parameter)
        side = "above" if self.crossing > 0 else "below"
        kind = "supercritical" if self.supercritical else "subcritical"
        return (
            f"Hopf point at {variable.name} = {variable.shown(self.value)}: {self.frequency:.4f} "
            f"Hz, unstable {side}, {kind}"
        )


@dataclass(frozen=True, eq=False)
class HopfBorder:
    """The border between rest and vibration over two parameters.

    Examples
    --------
    >>> rest = {"x": 0.04, "muscle.reference": 0.04}
    >>> gain, lags = "muscle.gain", [0.1, 0.2]
    >>> found = pam.vibration.hopf_border(regulated, gain, (1e5, 1e7), "muscle.lag", lags, rest)
    >>> found.border.shape, found.reasons
    ((2,), {})
    """

    parameter: str
    over: str
    values: Array
    """Of ``over``, (n,) [its unit]."""
    points: tuple[HopfPoint | None, ...]
    """None where no border was found; ``reasons`` says why."""
    reasons: dict[float, str]

    @property
    def border(self) -> Array:
        """Value of ``parameter`` at the border [its unit], (n,); NaN where none was found."""
        return np.array([np.nan if p is None else p.value for p in self.points])

    @property
    def frequencies(self) -> Array:
        """Frequency at the border [Hz], (n,)."""
        return np.array([np.nan if p is None else p.frequency for p in self.points])

    @property
    def supercritical(self) -> NDArray[np.bool_]:
        """Whether a stable cycle is born, (n,)."""
        return np.array([p is not None and p.supercritical for p in self.points])

    def plot(self) -> Figure:
        """The border over the two parameters, with its frequency below."""
        return courtesy.plot_border(self)


@verb
def hopf(
    plant: Plant,
    parameter: str,
    bracket: tuple[float, float],
    conditions: Mapping[str, float] | None = None,
    /,
    *,
    points: int = 21,
    memory: Memory = "virgin",
    time_limit: float | None = None,
    **more: float,
) -> HopfPoint:
    """The first value in a bracket at which a complex pair crosses the imaginary axis.

    Parameters
    ----------
    parameter : name of the parameter (or input) that varies between the ends of ``bracket``.
    conditions, memory : of the equilibria, as for :func:`pam_ocp.equilibrium`. Hysteresis sticks in
        small motion about rest; larger motion slides, which damps it more than the point says.
    points : how many equilibria are looked at to find a change of sign.

    The augmented system (rest, A q = i omega q, |q| fixed) is then solved by Newton with exact
    Jacobians to 1e-12 scaled by nominals.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises InputError when no pair crosses in the bracket, UnknownNameError, EquilibriumError.

    Examples
    --------
    >>> rest = {"x": 0.04, "muscle.reference": 0.04}
    >>> found = pam.vibration.hopf(regulated, "muscle.gain", (1e5, 1e7), rest)
    >>> print(f"{found.value / 1e5:.2f} bar/m, {found.frequency:.2f} Hz")
    13.83 bar/m, 2.87 Hz
    """
    given = {**(conditions or {}), **more}
    low, high = (plant.variable(parameter).check(b, "bracket") for b in bracket)
    start = _found(plant, parameter, _between(low, high, points), given, memory, FINER)
    rest = VariedRest(plant, parameter, given, memory)
    return _solved(rest, _augmented(rest), start)


def _between(low: float, high: float, points: int) -> Array:
    """Values from low to high: equal ratios where they span decades."""
    spread = np.geomspace if low * high > 0 and not 1 / WIDE < high / low < WIDE else np.linspace
    return np.asarray(spread(low, high, points))


def _found(
    plant: Plant, parameter: str, values: Array, given: Values, memory: Memory, finer: int
) -> Array:
    """:func:`_crossing` on these values; between two of them where a pair is born and crosses."""
    path = stability_path(plant, parameter, values, given, memory=memory)
    try:
        return _crossing(path)
    except InputError as error:
        unstable = np.sum(path.eigenvalues.real > 0, axis=1)
        for i in np.flatnonzero(np.abs(np.diff(unstable)) >= 2) if finer else ():
            ends = _between(float(values[i]), float(values[i + 1]), len(values))
            try:
                return _found(plant, parameter, ends, given, memory, finer - 1)
            except InputError:
                continue
        raise error from None


def _crossing(path: StabilityPath) -> Array:
    """Start (z, lam, omega, Re q, Im q) for the augmented system, from a path's change of sign."""
    s = path.eigenvalues
    oscillates = np.abs(s.imag) > 1e-6 * np.abs(s)
    changes = (s.real[:-1] * s.real[1:] <= 0) & oscillates[:-1] & oscillates[1:]
    variable = path.plant.variable(path.parameter)
    if not changes.any():
        ends = " .. ".join(variable.shown(v) for v in path.values[[0, -1]])
        raise InputError(
            f"bracket: no complex pair of eigenvalues crosses the imaginary axis for "
            f"{variable.name} = {ends} (largest real part {path.growth.min():.3g} .. "
            f"{path.growth.max():.3g} 1/s); widen the bracket or change the conditions"
        )
    i = int(np.argmax(changes.any(axis=1)))
    j = int(np.argmax(changes[i]))
    share = s[i, j].real / (s[i, j].real - s[i + 1, j].real) if s[i, j].real else 0.0
    z, value, pole = (
        (1 - share) * a[i] + share * a[i + 1] for a in (path.scaled, path.values, s[:, j])
    )
    rest_plant = path.points[i].plant
    nominal = rest_plant.vector("state", attribute="nominal")
    point = path.points[i if share < 0.5 else i + 1]
    a = np.asarray(point.plant.jacobians(point.x, point.u, point.plant.vector("parameter"))[0]) * (
        nominal[None, :] / nominal[:, None]
    )
    poles, vectors = np.linalg.eig(a)
    omega = abs(pole.imag)
    q = vectors[:, np.argmin(np.abs(poles - 1j * omega))]
    q = q / q[np.argmax(np.abs(q))]
    return np.concatenate([z, [value / variable.nominal, omega], q.real, q.imag])


def _augmented(rest: VariedRest) -> ca.Function:
    """(w, constants, c) -> (residual, Jacobian); w as in :func:`_crossing`,
    c fixes the phase of q.
    """
    z, lam, constants, found = rest.symbols()
    nx = rest.nx
    omega, real, imaginary = ca.SX.sym("omega"), ca.SX.sym("re", nx), ca.SX.sym("im", nx)
    c_real, c_imaginary = ca.SX.sym("c_re", nx), ca.SX.sym("c_im", nx)
    a = found["slopes"]
    residual = ca.vertcat(
        found["rest"],
        a @ real + omega * imaginary,
        a @ imaginary - omega * real,
        ca.dot(c_real, real) + ca.dot(c_imaginary, imaginary) - 1,
        ca.dot(c_real, imaginary) - ca.dot(c_imaginary, real),
    )
    w = ca.vertcat(z, lam, omega, real, imaginary)
    return ca.Function(
        "augmented",
        [w, constants, ca.vertcat(c_real, c_imaginary)],
        [residual, ca.jacobian(residual, w)],
    )


def _solved(rest: VariedRest, augmented: ca.Function, start: Array) -> HopfPoint:
    n, nx = len(rest.nominal), rest.nx
    q0 = start[n + 2 :]
    equations = casadi_equations(augmented, rest.constants, q0 / (q0 @ q0))
    try:
        w, residual = newton(equations, start)
    except NewtonError as error:
        raise VibrationError(str(error)) from None
    omega = float(w[n + 1])
    if not omega > 0:
        raise VibrationError(
            "the pair of eigenvalues meets on the real axis (omega = 0): that is no Hopf point"
        )
    z, value = w[:n], float(w[n]) * rest.variable.nominal
    rest.variable.check(value, "the border")
    q = w[n + 2 : n + 2 + nx] + 1j * w[n + 2 + nx :]
    q = q / q[np.argmax(np.abs(q))]
    crossing, lyapunov = _direction(rest, z, w[n], omega, q)
    return HopfPoint(
        rest.at(z, value),
        rest.variable.name,
        value,
        omega / (2 * np.pi),
        crossing,
        lyapunov,
        q * rest.nominal[:nx],
        residual,
    )


def _direction(
    rest: VariedRest, z: Array, lam: float, omega: float, q: NDArray[np.complex128]
) -> tuple[float, float]:
    """d Re(s)/d(parameter) along the path of rest, and the first Lyapunov coefficient."""
    nx = rest.nx
    a, turned, b, c = (
        np.asarray(m)
        for m in rest.plant.cached(("hopf", *rest.key), lambda: _derivatives(rest))(
            z, lam, rest.constants
        )
    )
    poles, left = np.linalg.eig(a.T)
    p = left[:, np.argmin(np.abs(poles - 1j * omega))]
    crossing = float((p @ turned @ q / (p @ q)).real) / rest.variable.nominal

    q = q / np.linalg.norm(q)
    p = p / (p @ q)  # so that p.q = 1; p stands for the conjugate of Kuznetsov's
    b, c = b.reshape(nx, nx, nx, order="F"), c.reshape(nx, nx, nx, nx, order="F")
    eye = np.eye(nx)
    follow = rest.at(z, float(lam) * rest.variable.nominal).stuck  # held memories follow the rest
    lift, pick = follow.lift(rest.nominal[:nx]), follow.pick()
    bent = np.einsum("ijk,j,k", b, q, q.conj())
    mean = lift @ np.linalg.solve(pick @ a @ lift, pick @ bent)
    double = np.linalg.solve(2j * omega * eye - a, np.einsum("ijk,j,k", b, q, q))
    sum_ = (
        np.einsum("ijkl,j,k,l", c, q, q, q.conj())
        - 2 * np.einsum("ijk,j,k", b, q, mean)
        + np.einsum("ijk,j,k", b, q.conj(), double)
    )
    return crossing, float((p @ sum_).real / (2 * omega))


def _derivatives(rest: VariedRest) -> ca.Function:
    """(z, lam, constants) -> A, dA/dlam along the path of rest, second and third derivatives."""
    z, lam, constants, found = rest.symbols()
    nx = rest.nx
    residual = found["rest"]
    moved = -ca.solve(ca.jacobian(residual, z), ca.jacobian(residual, lam))
    a = ca.densify(found["slopes"])
    along_z = ca.jacobian(ca.vec(a), z)
    turned = along_z @ moved + ca.jacobian(ca.vec(a), lam)
    second = ca.densify(along_z[:, :nx])
    third = ca.jacobian(ca.vec(second), z)[:, :nx]
    return ca.Function(
        "derivatives",
        [z, lam, constants],
        [a, ca.densify(ca.reshape(turned, nx, nx)), second, ca.densify(third)],
    )


@verb
def hopf_border(
    plant: Plant,
    parameter: str,
    bracket: tuple[float, float],
    over: str,
    values: ArrayLike,
    conditions: Mapping[str, float] | None = None,
    /,
    *,
    points: int = 21,
    memory: Memory = "virgin",
    time_limit: float | None = None,
    **more: float,
) -> HopfBorder:
    """The border between rest and vibration: ``parameter`` at the Hopf point, for values of
    ``over``.

    ``hopf_border(plant, "muscle.gain", (1e5, 2e7), "muscle.lag", lags, x=0.04, ...)``. Each point
    starts from its neighbour; where that fails, ``bracket`` is searched as by :func:`hopf`.

    parameter, over : names of two parameters (or inputs). values : (n,) of ``over`` [its unit].
    bracket, conditions, points, memory : as for :func:`hopf`.
    time_limit : [s]; values that were not reached when it is over are failures (OutOfTime when no
        border is found before).

    Raises InputError when no border is found for any value; single failures are NaN in ``border``,
    with the reason in ``reasons``.

    Examples
    --------
    >>> rest = {"x": 0.04, "muscle.reference": 0.04}
    >>> gain, lags = "muscle.gain", [0.1, 0.2]
    >>> found = pam.vibration.hopf_border(regulated, gain, (1e5, 1e7), "muscle.lag", lags, rest)
    >>> bool(np.isfinite(found.border).all())
    True
    """
    given = {plant.variable(n).name: v for n, v in {**(conditions or {}), **more}.items()}
    second = plant.variable(over)
    if second.name == plant.variable(parameter).name:
        raise InputError(f"over: {second.name} is the first parameter already; name another")
    numbers = np.atleast_1d(np.asarray(values, dtype=float))
    for value in numbers:
        second.check(value)
    walk = BorderWalk(plant, parameter, bracket, points, memory)
    found = [walk({**given, second.name: value}, value) for value in numbers.tolist()]
    if walk.last is None:
        reason = next(iter(walk.reasons.values()))
        raise InputError(f"no border for any value of {second.name}: {reason}")
    name = plant.variable(parameter).name
    return HopfBorder(name, second.name, numbers, tuple(found), walk.reasons)


@dataclass
class BorderWalk:
    """Hopf points one beside the other, each sought from the last that was found, and why there is
    none at some places.
    """

    plant: Plant
    parameter: str
    bracket: tuple[float, float]
    points: int
    memory: Memory
    last: HopfPoint | None = None
    reasons: dict[Any, str] = field(default_factory=dict)

    def __call__(self, given: Values, place: Any) -> HopfPoint | None:
        """The point under these conditions; None where there is none, or no time left."""
        try:
            self.last = self._near(given)
            return self.last
        except PamError as error:
            self.reasons[place] = str(error)
        except TimeIsUp:
            if self.last is None:
                raise
            self.reasons[place] = f"{deadline()} was over"
        return None

    def _near(self, given: Values) -> HopfPoint:
        """Next to the last one if it lies in the bracket, else by a search of the bracket."""
        if self.last is not None:
            last, rest = self.last, VariedRest(self.plant, self.parameter, given, self.memory)
            q = last.mode / rest.nominal[: rest.nx]
            scaled = np.concatenate([last.point.x, last.point.u]) / rest.nominal
            here = [last.value / rest.variable.nominal, 2 * np.pi * last.frequency]
            start = np.concatenate([scaled, here, q.real, q.imag])
            try:
                found = _solved(rest, _augmented(rest), start)
                if self.bracket[0] <= found.value <= self.bracket[1]:
                    return found
            except PamError:
                pass  # too far from the last one: look for it in the bracket
        return hopf(
            self.plant,
            self.parameter,
            self.bracket,
            given,
            points=self.points,
            memory=self.memory,
        )

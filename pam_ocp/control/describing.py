"""Describing functions: the first harmonic of a plant's answer to a sine, over amplitude and
frequency.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import InputError, SimulationError, require_instance, require_numbers
from ..core.stop import verb
from ..core.variables import Variable
from ..muscles.pneumatic_muscle import Muscle
from ..numerics.newton import iterate, least_squares
from ..numerics.solvers import integrator
from ..operating.linear import chosen_signals, point_of
from ..operating.resting_point import OperatingPoint
from ..plants.plant import Plant, Values, require_plant
from .kinds import Array

STEADY = 1e-9
"""A motion repeats itself when a period changes no state by more than this part of its nominal."""
ITERATIONS = 30
MOST = 5.0
"""Longest Newton step towards the periodic motion, scaled by nominals."""


@dataclass(frozen=True, eq=False)
class DescribingFunction:
    """First harmonics Y = N(A, f) A of an output under the input u0 + A sin(2 pi f t).

    amplitude : (a,) of the input [SI]; frequency : (f,) [Hz].
    values : (a, f) complex, N [output per input, SI]; abs is the gain, angle the phase.
    mean : (a, f) of the output over a period [SI].
    distortion : (a, f), r.m.s. of the higher harmonics over that of the first one: how far to trust
        predictions that take the first harmonic for the whole.
    stable : (a, f), whether the periodic motion attracts its neighbours (Floquet multipliers).

    Examples
    --------
    >>> found = pam.control.describing_function(plant, "muscle.command", "x", [1e4], [1.0], point)
    >>> found.values.shape, bool(found.stable.all())
    ((1, 1), True)
    """

    source: str
    output: str
    amplitude: Array
    frequency: Array
    values: NDArray[np.complex128] = field(repr=False)
    mean: Array = field(repr=False)
    distortion: Array = field(repr=False)
    stable: NDArray[np.bool_] = field(repr=False)


@verb
def describing_function(
    plant: Plant,
    source: str,
    output: str,
    amplitudes: ArrayLike,
    hertz: ArrayLike,
    at: OperatingPoint | Values | None = None,
    *,
    samples: int = 128,
    rtol: float = 1e-9,
    time_limit: float | None = None,
) -> DescribingFunction:
    """The sinusoidal-input describing function of a plant, which need not be memoryless.

    source : an input; output : a state or output. amplitudes [SI] > 0, by which the input stays in
    its range; hertz : frequencies > 0.
    at : the point about which the input swings and where the other inputs stay; by default the
        start values.
    samples : of a period, for the harmonics.

    The periodic motion is found by Newton's method on the map of one period, with the derivative of
    that map from the variational equations; so it is steady at once, also where it is not stable,
    or slow to settle. For small amplitudes N is the frequency response. For a memoryless
    characteristic python-control's ``describing_function`` needs no simulation; see
    :func:`muscle_characteristic`.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises InputError for bad arguments, SimulationError when a motion does not become periodic (an
    integrating plant with a mean drift has no periodic motion).

    Examples
    --------
    >>> found = pam.control.describing_function(plant, "muscle.command", "x", [1e4], [1.0], point)
    >>> print(f"{1e8 * abs(found.values[0, 0]):.1f} mm/bar")
    19.4 mm/bar
    """
    require_plant(plant)
    (source,) = chosen_signals("source", plant, [source], ("input",))
    (output,) = chosen_signals("output", plant, [output], ("state", "output"))
    size, frequency = (_positive(n, v) for n, v in (("amplitudes", amplitudes), ("hertz", hertz)))
    if samples < 16:
        raise InputError(f"samples = {samples} must be >= 16")
    plant, x, u = point_of(plant, at)
    _require_room(plant.variable(source), u[[v.name for v in plant.inputs].index(source)], size)
    period = _Period(plant, source, output, u, samples, rtol)
    table = np.empty((4, len(size), len(frequency)), dtype=complex)
    for j, f in enumerate(frequency):
        start = x  # from small amplitudes to large ones, each starts from its neighbour
        for i in np.argsort(size):
            start, multipliers = period.steady(start, size[i], f)
            table[:, i, j] = (*period.harmonics(start, size[i], f), np.abs(multipliers).max() < 1)
    return DescribingFunction(
        source, output, size, frequency, table[0], table[1].real, table[2].real, table[3].real > 0.5
    )


def _require_room(v: Variable, middle: float, amplitudes: Array) -> None:
    """InputError where a swing leaves the input's range."""
    most = float(amplitudes.max())
    room = min(middle - v.min, v.max - middle)
    if most > room + 1e-9 * v.nominal:
        raise InputError(
            f"amplitudes: {v.name} swings by {v.shown(most)} about {v.shown(middle)}, beyond its "
            f"range {v.shown(v.min)} .. {v.shown(v.max)}; give at most {v.shown(max(room, 0.0))}, "
            "or another point"
        )


def _positive(name: str, values: ArrayLike) -> Array:
    found = np.atleast_1d(require_numbers(name, values))
    if found.ndim != 1 or not found.size or not np.all(found > 0):
        raise InputError(f"{name} must hold finite numbers > 0")
    return found


class _Period:
    """The map of one period, dx/dtau = T f(x, u0 + A sin(2 pi tau)), scaled by nominals."""

    def __init__(
        self, plant: Plant, source: str, output: str, u: Array, samples: int, rtol: float
    ) -> None:
        self.plant, self.samples = plant, samples
        self.nominal = plant.vector("state", attribute="nominal")
        self.constants = np.concatenate([plant.vector("parameter"), u])
        n, m = len(self.nominal), len(plant.parameters)
        x, t = ca.SX.sym("x", n), ca.SX.sym("t")
        p = ca.SX.sym("p", len(self.constants))
        swing = ca.SX.sym("swing", 2)  # amplitude, period
        inputs = ca.SX(p[m:])
        column = [v.name for v in plant.inputs].index(source)
        inputs[column] += swing[0] * ca.sin(2 * ca.pi * t)
        xdot, y, _ = plant.function(x * self.nominal, inputs, p[:m])
        ode = swing[1] * xdot / self.nominal
        slopes = ca.SX.sym("slopes", n, n)
        change = ca.jacobian(ode, x) @ slopes
        given, options = ca.vertcat(swing, p), {"reltol": rtol, "abstol": rtol}
        single = {"t": t, "x": x, "p": given, "ode": ode}
        varied = {"x": ca.vertcat(x, ca.vec(slopes)), "ode": ca.vertcat(ode, ca.vec(change))}
        self.map = integrator("period", "rosenbrock", single | varied, 0.0, 1.0, options)
        self.grid = (np.arange(samples) + 1.0) / samples
        self.motion = integrator("motion", "rosenbrock", single, 0.0, self.grid.tolist(), options)
        shown = [v.name for v in (*plant.states, *plant.outputs)].index(output)
        value = ca.vertcat(x * self.nominal, y)[shown]
        self.output = ca.Function("output", [t, x, given], [value])

    def _failure(self, amplitude: float, hertz: float, why: str) -> SimulationError:
        return SimulationError(
            f"{self.plant.name!r} under amplitude {amplitude:g} at {hertz:g} Hz {why}; start "
            "nearer by more amplitudes, or take a point that it swings about"
        )

    def steady(
        self, start: Array, amplitude: float, hertz: float
    ) -> tuple[Array, NDArray[np.complex128]]:
        """The state (SI) at the begin of a period of the periodic motion, and its multipliers."""
        n, given = len(self.nominal), [amplitude, 1 / hertz, *self.constants]
        slopes = np.eye(n)

        def missed(x: Array) -> tuple[Array, Callable[[Array], Array]]:
            try:
                found = self.map(x0=[*x, *np.eye(n).ravel()], p=given)["xf"]
                end = np.asarray(found, dtype=float).ravel()
            except RuntimeError:
                end = np.array([np.nan])
            if not np.all(np.isfinite(end)):
                raise self._failure(amplitude, hertz, "cannot be integrated") from None
            slopes[:] = end[n:].reshape(n, n, order="F")
            return end[:n] - x, least_squares(slopes - np.eye(n), rcond=1e-13)

        root = iterate(
            missed,
            start / self.nominal,
            tolerance=STEADY,
            settled=1e3 * STEADY,
            steps=ITERATIONS,
            halvings=0,
            longest=MOST,
        )
        if root.reason:
            raise self._failure(amplitude, hertz, "does not become periodic")
        return root.w * self.nominal, np.asarray(np.linalg.eigvals(slopes), complex)

    def harmonics(
        self, start: Array, amplitude: float, hertz: float
    ) -> tuple[complex, float, float]:
        """N, the mean, and the distortion of the output over the period that begins at
        ``start``.
        """
        given = [amplitude, 1 / hertz, *self.constants]
        states = self.motion(x0=start / self.nominal, p=given)["xf"]
        y = np.asarray(self.output(self.grid[None, :], states, given), dtype=float).ravel()
        # y = mean + sum over k of Re(c_k e^(2 pi i k t)); a sine of amplitude A is -i A
        found = np.fft.rfft(np.roll(y, 1)) / self.samples * 2
        rest = np.sqrt(np.sum(np.abs(found[2:]) ** 2))
        first = max(float(np.abs(found[1])), 1e-300)
        return complex(found[1] * 1j / amplitude), float(y.mean()), float(rest / first)


@verb
def muscle_characteristic(
    muscle: Muscle, pressure: float, contraction: float
) -> Callable[[float], float]:
    """Force against displacement of a muscle at a constant pressure, as a memoryless
    characteristic.

    Returns f(x) = F(pressure, contraction) - F(pressure, contraction + x / rest length) [N], x in
    m: what resists a shortening by x. For ``control.describing_function`` and its plot (with
    ``zero_check=False``, since it is not odd).

    Examples
    --------
    >>> force = pam.control.muscle_characteristic(muscle, 3e5, 0.10)
    >>> round(force(0.0), 6), force(0.001) > 0
    (0.0, True)
    """
    require_instance("muscle", muscle, Muscle, "give a Muscle, such as muscle('DMSP-20-300')")
    centre = float(muscle.force(pressure, contraction))

    def resist(x: float) -> float:
        moved = contraction + float(np.squeeze(x)) / muscle.rest_length
        return centre - float(muscle.force(pressure, moved))

    return resist

"""Free vibration about an equilibrium: frequency, decay, and frequency against amplitude."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import courtesy
from ..core.errors import (
    InputError,
    VibrationError,
    require_finite,
    require_numbers,
    require_positive,
)
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..numerics.newton import Array
from ..operating.held import Memory, carried
from ..operating.resting_point import OperatingPoint, equilibrium
from ..plants.plant import Plant, Values
from ..simulation.simulator import simulate

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@shown
@dataclass(frozen=True, eq=False)
class FreeVibration:
    """A motion that was let go beside an equilibrium, cycle by cycle.

    A cycle runs from one rising passage through rest to the next.

    Examples
    --------
    >>> held = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.IdealPressure())
    >>> swing = pam.vibration.free_vibration(held, {"muscle.pressure": 3e5}, 5e-3, cycles=5)
    >>> round(swing.damping_ratio, 2)
    0.1
    """

    trajectory: Trajectory
    point: OperatingPoint
    state: str
    crossings: Array
    """Times of the rising passages through rest [s], (n + 1,)."""
    highs: Array
    """Largest deviation from rest in each cycle, above [unit of the state], (n,)."""
    lows: Array
    """Largest deviation below rest in each cycle, negative, (n,)."""
    peaks: tuple[Array, Array]
    """All turning points of the record: times [s], deviations from rest."""
    settled: float | None = None
    """With hysteresis: where the motion comes to rest [unit of the state], beside the point."""

    @property
    def frequencies(self) -> Array:
        """Frequency of each cycle [Hz], (n,)."""
        return np.asarray(1 / np.diff(self.crossings))

    @property
    def amplitudes(self) -> Array:
        """Half the distance between the turning points of each cycle, (n,)."""
        return (self.highs - self.lows) / 2

    @property
    def frequency(self) -> float:
        """Mean frequency over all whole cycles [Hz]."""
        return float((len(self.crossings) - 1) / (self.crossings[-1] - self.crossings[0]))

    @property
    def log_decrement(self) -> float:
        """Mean of ln(amplitude / next amplitude); 0 when nothing is lost, NaN for one cycle."""
        if len(self.amplitudes) < 2:
            return float("nan")
        return float(np.log(self.amplitudes[0] / self.amplitudes[-1]) / (len(self.amplitudes) - 1))

    @property
    def damping_ratio(self) -> float:
        """Of the linear oscillator with the same decrement."""
        return float(self.log_decrement / np.hypot(2 * np.pi, self.log_decrement))

    @cached_property
    def rest(self) -> float:
        """Value of the state at rest, about which it swings."""
        return self.point[self.state] if self.settled is None else self.settled

    def __str__(self) -> str:
        v = self.point.plant.variable(self.state)
        return (
            f"{len(self.frequencies)} cycles about {v.name} = {v.shown(self.rest)}: "
            f"{self.frequency:.4f} Hz, amplitude {v.shown(self.amplitudes[0])} to "
            f"{v.shown(self.amplitudes[-1])}, damping ratio {self.damping_ratio:.4g}"
        )

    def plot(self) -> Figure:
        """The same as :meth:`plot_envelope`."""
        return self.plot_envelope()

    def plot_phase(self) -> Figure:
        """Phase portrait: rate over state."""
        return courtesy.plot_phase(
            [self.trajectory], self.state, self.point.plant, labels=["free vibration"]
        )

    def plot_envelope(self) -> Figure:
        """The state over time with the envelope through its turning points; frequency below."""
        return courtesy.plot_envelope(self)


@dataclass(frozen=True, eq=False)
class Backbone:
    """Frequency against amplitude, one motion per offset.

    offsets, amplitudes, lows, highs [unit of the state], frequencies [Hz] : (n,) each;
    the turning points are deviations from rest.

    Examples
    --------
    >>> held = pam.HangingLoad(muscle, 10.0, damping=0.0, feed=pam.feeds.IdealPressure())
    >>> found = pam.vibration.backbone(held, {"muscle.pressure": 3e5}, [1e-3, 1e-2])
    >>> found.frequencies.round(2)
    array([4.7, 4.7])
    """

    state: str
    point: OperatingPoint
    offsets: Array
    frequencies: Array
    amplitudes: Array
    lows: Array
    highs: Array

    def plot(self) -> Figure:
        """Frequency over amplitude."""
        return courtesy.plot_backbone({"": self})


def watched(plant: Plant, state: str | None, argument: str = "state") -> Variable:
    """The variable that is named; by default x, or what else is the plant's one position."""
    if state is None:
        named_x = [v.name for v in plant.states if v.name == "x"]
        found = named_x or list(plant.load_positions)
        if len(found) != 1:
            has = ", ".join(found) or "none"
            raise InputError(f"{argument}: positions of {plant.name!r} are {has}; name a state")
        (state,) = found
    return plant.variable(state)


@verb
def free_vibration(
    plant: Plant,
    at: OperatingPoint | Values,
    offset: float,
    *,
    state: str | None = None,
    cycles: float = 20,
    samples: int = 100,
    rtol: float = 1e-11,
    memory: Memory = "virgin",
    time_limit: float | None = None,
) -> FreeVibration:
    """Let the plant go, at rest, beside its equilibrium; inputs stay constant.

    Parameters
    ----------
    plant : with ``IdealPressure`` feeds the pressure is constant, as a free vibration wants it.
    at : an OperatingPoint at rest, or conditions for one (``{"muscle.pressure": 4e5}``).
    offset : where the state starts, from rest [its unit]; all other states start at rest.
        Upwards is positive for ``x``. In a nonlinear plant the other turning point differs:
        DMSP-20-400N, 20 kg at 4 bar, undamped: 3.432 Hz let go at +2 mm; at +30 mm 3.437 Hz by
        the law's tension, but 3.255 Hz with force >= 0, since the muscle is slack at the top (at
        -30 mm 3.210 Hz: the load then flies to +32 mm).
    state : the state that is displaced and watched; by default x, or the plant's one position.
    cycles : length of the record, in periods of the plant linearised at rest.
    samples : per such period. rtol : of the integrator.
    memory : what hysteresis keeps at rest, see :func:`pam_ocp.equilibrium`; on the way from rest to
        the offset it has followed the motion. The swing is measured about the place where it ends.

    Frequencies come from passages through rest, located on polynomials of degree 5 that use the
    exact derivatives. Raises VibrationError when the plant does not oscillate there, InputError
    for bad arguments, SimulationError when the integration fails.

    time_limit : [s]; OutOfTime when it is over before there is a result.

    Examples
    --------
    >>> held = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.IdealPressure())
    >>> swing = pam.vibration.free_vibration(held, {"muscle.pressure": 3e5}, 5e-3, cycles=5)
    >>> print(f"{swing.frequency:.2f} Hz, damping ratio {swing.damping_ratio:.2f}")
    4.68 Hz, damping ratio 0.10
    """
    point = at if isinstance(at, OperatingPoint) else equilibrium(plant, at, memory=memory)
    plant = point.plant
    variable = watched(plant, state)
    if variable.causality != "state":
        raise InputError(f"state: {variable.name} is an {variable.causality}; give a state")
    offset = require_finite("offset", offset, variable.unit)
    if offset == 0:
        raise InputError("offset = 0: the plant would stay at rest; give a distance from rest")
    cycles = require_positive("cycles", cycles)
    period = 1 / _natural_frequency(point, variable.name, offset)
    x0 = dict(zip([v.name for v in plant.states], point.x, strict=True))
    x0.update(carried(plant, point.x, point.u, variable.name, offset))
    x0[variable.name] += offset
    trajectory = simulate(
        plant,
        dict(zip([v.name for v in plant.inputs], point.u, strict=True)),
        start=x0,
        t=np.linspace(0.0, cycles * period, int(np.ceil(cycles * samples)) + 1),
        rtol=rtol,
    )
    return _measured(plant, point, trajectory, variable.name)


def _natural_frequency(point: OperatingPoint, state: str, offset: float) -> float:
    """Of the slowest oscillating pair of poles [Hz], without damping: at rest, or else at the speed
    of the swing, where dry friction no longer grows with speed.
    """
    plant, pairs = point.plant, _pairs(point.poles)

    def slopes(x: Array) -> Array:
        return np.asarray(plant.jacobians(x, point.u, plant.vector("parameter"))[0])

    if not len(pairs) and state in plant.positions:
        at, names = point.x.copy(), [v.name for v in plant.states]
        row = names.index(plant.positions[state])
        at[row] = offset * np.sqrt(max(-slopes(at)[row, names.index(state)], 0.0))
        pairs = _pairs(np.linalg.eigvals(slopes(at)).astype(complex))
    if not len(pairs):
        shown = ", ".join(f"{s.real:.3g}" for s in point.poles)
        raise VibrationError(
            f"{plant.name!r} does not oscillate about this point: all its poles are real "
            f"({shown} 1/s); lessen the damping"
        )
    return float(np.min(np.abs(pairs)) / (2 * np.pi))


def _pairs(poles: NDArray[np.complex128]) -> NDArray[np.complex128]:
    return np.asarray(poles[poles.imag > 1e-9 * np.abs(poles)])


def _measured(
    plant: Plant, point: OperatingPoint, trajectory: Trajectory, state: str
) -> FreeVibration:
    curve = smooth(plant, trajectory, state)
    settled = _settled(curve) if point.memory else None
    rest = point[state] if settled is None else settled
    times, _, directions = curve.zeros(rest)
    crossings = times[directions > 0]
    if len(crossings) < 2:
        raise VibrationError(
            f"{state} passes its rest upwards {len(crossings)} time(s) in "
            f"{trajectory.duration:.3g} s, so no whole cycle can be measured; make the record "
            "longer (cycles) or the damping smaller"
        )
    turns, values, _ = curve.zeros(0.0, order=1)
    deviations = values - rest
    cycle = np.searchsorted(crossings, turns) - 1
    inside = [deviations[cycle == i] for i in range(len(crossings) - 1)]
    return FreeVibration(
        trajectory,
        point,
        state,
        crossings,
        np.array([np.max(d) for d in inside]),
        np.array([np.min(d) for d in inside]),
        (turns, deviations),
        settled,
    )


def _settled(curve: Smooth) -> float | None:
    """The middle of the last swing: where friction leaves the motion; None without a swing."""
    values = curve.zeros(0.0, order=1)[1]
    return float(np.mean(values[-2:])) if len(values) > 1 else None


@verb
def backbone(
    plant: Plant,
    at: OperatingPoint | Values,
    offsets: Sequence[float] | ArrayLike,
    *,
    state: str | None = None,
    rtol: float = 1e-11,
    memory: Memory = "virgin",
    time_limit: float | None = None,
) -> Backbone:
    """Frequency against amplitude: a free vibration from each offset, its first cycle measured.

    Arguments as in :func:`free_vibration`.

    time_limit : [s]; OutOfTime when it is over before there is a result.

    Examples
    --------
    >>> held = pam.HangingLoad(muscle, 10.0, damping=0.0, feed=pam.feeds.IdealPressure())
    >>> found = pam.vibration.backbone(held, {"muscle.pressure": 3e5}, [1e-3, 5e-3])
    >>> found.amplitudes.round(4)
    array([0.001, 0.005])
    """
    variable = watched(plant, state)
    starts = np.atleast_1d(require_numbers("offsets", offsets, variable.unit))
    if not starts.size or starts.ndim > 1:
        raise InputError("offsets: give a row of at least one distance from rest")
    point = at if isinstance(at, OperatingPoint) else equilibrium(plant, at, memory=memory)
    motions = [
        free_vibration(plant, point, float(a), state=variable.name, cycles=4.0, rtol=rtol)
        for a in starts
    ]
    return Backbone(
        variable.name,
        point,
        starts,
        *(
            np.array([getattr(m, key)[0] for m in motions])
            for key in ("frequencies", "amplitudes", "lows", "highs")
        ),
    )


# ---- passages of a motion through a level, and its turning points, to high order -----------------
@dataclass(frozen=True)
class Smooth:
    """One state over time, joined by polynomials of degree 5 that keep value, slope, curvature.

    t : (n,) times [s]. derivatives : (3, n) value and first two derivatives at these times.
    """

    t: Array
    derivatives: Array

    def zeros(self, level: float = 0.0, order: int = 0) -> tuple[Array, Array, Array]:
        """Times where the derivative of this order (0 or 1) crosses ``level``.

        Returns (times, values of the state there, +1 rising or -1 falling). Exact zeros at a
        sample count with the interval that follows.
        """
        y = self.derivatives[order] - level
        before = np.where(y[:-1] == 0, -np.sign(y[1:]), np.sign(y[:-1]))
        at = np.flatnonzero(before * np.sign(y[1:]) < 0)
        low, high = np.zeros(len(at)), np.ones(len(at))
        for _ in range(60):
            middle = (low + high) / 2
            short = (self._value(at, middle, order) - level) * before[at] > 0
            low, high = np.where(short, middle, low), np.where(short, high, middle)
        h = np.diff(self.t)[at]
        return self.t[at] + low * h, self._value(at, low, 0), -before[at]

    def _value(self, interval: NDArray[np.intp], s: Array, order: int) -> Array:
        """Value (0) or slope (1) at the fraction s of the intervals."""
        h = np.diff(self.t)[interval]
        y0, v0, a0 = self.derivatives[:, interval] * np.array([h**0, h, h**2])
        y1, v1, a1 = self.derivatives[:, interval + 1] * np.array([h**0, h, h**2])
        rest = np.array([y1 - y0 - v0 - a0 / 2, v1 - v0 - a0, a1 - a0])
        # value, slope and curvature at s = 1 fix the powers 3, 4 and 5
        c3, c4, c5 = np.array([[10, -4, 0.5], [-15, 7, -1], [6, -3, 0.5]]) @ rest
        if order == 0:
            value = y0 + s * (v0 + s * (a0 / 2 + s * (c3 + s * (c4 + s * c5))))
        else:
            value = (v0 + s * (a0 + s * (3 * c3 + s * (4 * c4 + s * 5 * c5)))) / h
        return np.asarray(value)


def smooth(plant: Plant, trajectory: Trajectory, name: str) -> Smooth:
    """The state ``name`` of a simulated trajectory with its exact derivatives.

    Inputs must be constant. Slope and curvature come from the plant's equation, so crossings
    are found with an error of order 6 in the sampling interval.
    """
    rates = plant.cached(("rates",), lambda: _rates(plant))
    states = trajectory.array([v.name for v in plant.states]).T
    inputs = trajectory.array([v.name for v in plant.inputs]).T
    first, second = (np.asarray(m) for m in rates(states, inputs, plant.vector("parameter")))
    row = [v.name for v in plant.states].index(plant.variable(name).name)
    return Smooth(trajectory.t, np.array([states[row], first[row], second[row]]))


def _rates(plant: Plant) -> ca.Function:
    """(x, u, p) -> (x', x'') at constant u."""
    xdot = ca.vertcat(*(plant.expression(f"der({v.name})") for v in plant.states))
    return ca.Function("rates", [plant.x, plant.u, plant.p], [xdot, ca.jtimes(xdot, plant.x, xdot)])

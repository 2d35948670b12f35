"""Self-excited vibration over two values, such as load and pressure: where it begins, how large."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import courtesy
from ..core.cases import ending
from ..core.errors import InputError, PamError, VibrationError, require_count
from ..core.executors import Place
from ..core.shown import shown
from ..core.stop import TimeIsUp, deadline, verb
from ..numerics.newton import Array
from ..operating.held import Memory
from ..operating.resting_point import OperatingPoint, equilibrium
from ..plants.plant import Plant, require_plant
from ..simulation.simulator import simulate
from .cycle import limit_cycle
from .free import watched
from .hopf_bifurcation import BorderWalk, HopfPoint

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PUSH = 0.05
"""Of the rest along its least damped mode, scaled by nominals, where the caller gives none."""
ROUND = 20
"""Periods simulated at once; the swing of the last quarter is compared with that of the first."""
STILL = 1e-6
"""A swing below this, scaled by nominals, is rest."""
SETTLED = 1e-3
"""Relative change of the swing over a round below which collocation is tried."""


@shown
@dataclass(frozen=True, eq=False)
class HopfMap:
    """A parameter at the border between rest and vibration, over two values.

    Examples
    --------
    >>> axes = {"mass": [10.0, 30.0], "x": [0.04]}
    >>> rest = {"muscle.reference": 0.04}
    >>> found = pam.vibration.hopf_map(regulated, "muscle.gain", (1e5, 1e7), axes, rest)
    >>> found.border.shape
    (2, 1)
    """

    parameter: str
    axes: Mapping[str, Array]
    """Two: {name: (n,)}, {name: (m,)} [their units]."""
    points: tuple[tuple[HopfPoint | None, ...], ...]
    """(n, m); None where no border was found."""
    reasons: Mapping[tuple[float, float], str]

    @property
    def border(self) -> Array:
        """(n, m) [unit of the parameter]; NaN where none was found."""
        return self._table("value")

    @property
    def frequencies(self) -> Array:
        """Frequency at the border [Hz], (n, m)."""
        return self._table("frequency")

    @property
    def lyapunov(self) -> Array:
        """First Lyapunov coefficients (n, m): < 0, vibration begins small (see HopfPoint)."""
        return self._table("lyapunov")

    def _table(self, attribute: str) -> Array:
        return np.array(
            [[np.nan if p is None else getattr(p, attribute) for p in row] for row in self.points]
        )

    def __str__(self) -> str:
        found = [p for row in self.points for p in row if p is not None]
        variable = found[0].plant.variable(self.parameter)
        low, high = (variable.shown(float(f(self.border))) for f in (np.nanmin, np.nanmax))
        slow, fast = np.nanmin(self.frequencies), np.nanmax(self.frequencies)
        hard = sum(not p.supercritical for p in found)
        text = (
            f"border of vibration over {' and '.join(self.axes)}: {variable.name} {low} .. {high}, "
            f"{slow:.3g} .. {fast:.3g} Hz"
        )
        if hard:
            text += f"; {hard} of {len(found)} begin with a jump (subcritical)"
        return text + (f"; {len(self.reasons)} without a border" if self.reasons else "")

    def plot(self) -> Figure:
        """The border and its frequency as maps; crosses where vibration begins with a jump."""
        return courtesy.plot_hopf_map(self)


@shown
@dataclass(frozen=True, eq=False)
class AmplitudeMap:
    """How a plant vibrates by itself over two values.

    Examples
    --------
    >>> axes = {"mass": [20.0], "x": [0.04]}
    >>> found = pam.vibration.amplitude_map(regulated, axes, {"muscle.reference": 0.04})
    >>> float(found.amplitude[0, 0]) > 0 or bool(found.growth[0, 0] < 0)
    True
    """

    plant: Plant
    state: str
    axes: Mapping[str, Array]
    """Two: {name: (n,)}, {name: (m,)} [their units]."""
    amplitude: Array
    """(n, m) half the swing of the state [its unit]; 0 where the push dies out, NaN where unknown
    (see ``reasons``)."""
    frequency: Array
    """(n, m) [Hz]; NaN at rest."""
    growth: Array
    """(n, m) largest real part of the eigenvalues at rest [1/s]: > 0, rest is unstable."""
    closed: NDArray[np.bool_]
    """(n, m) whether the vibration is a closed motion, confirmed by collocation; where it is not
    (several frequencies, or kinks too sharp), amplitude and frequency are those simulated."""
    outside: NDArray[np.bool_]
    """(n, m) whether it leaves the range of the states, where the law is extrapolated."""
    reasons: Mapping[tuple[float, float], str]

    def __str__(self) -> str:
        moving = self.amplitude > 0
        variable = self.plant.variable(self.state)
        text = (
            f"vibration over {' and '.join(self.axes)}: {int(moving.sum())} of {moving.size} "
            "points vibrate"
        )
        if moving.any():
            most = variable.shown(float(self.amplitude[moving].max()))
            text += f", {variable.name} by up to +-{most}"
        beside = int((moving & (self.growth < 0)).sum())
        if beside:
            text += f"; at {beside} of them rest is stable, too: a push decides"
        if self.outside.any():
            text += f"; {int(self.outside.sum())} leave the range of the law"
        return text + (f"; {len(self.reasons)} unknown" if self.reasons else "")

    def plot(self) -> Figure:
        """Amplitude and frequency as maps, with the border of stability of the rest."""
        return courtesy.plot_amplitude_map(self)


@verb
def hopf_map(
    plant: Plant,
    parameter: str,
    bracket: tuple[float, float],
    axes: Mapping[str, ArrayLike],
    conditions: Mapping[str, float] | None = None,
    /,
    *,
    points: int = 21,
    memory: Memory = "virgin",
    time_limit: float | None = None,
    **more: float,
) -> HopfMap:
    """The value of a parameter from which a plant vibrates by itself, over two others.

    ``hopf_map(plant, "muscle.position_gain", (0.1, 100), {"mass": masses, "x": places})``.

    axes : {name: values} of two parameters, inputs, states or outputs [their units].
    parameter, bracket, conditions, points, memory : as for :func:`hopf`.
    time_limit : [s]; points that were not reached when it is over are failures.

    Raises InputError when no border is found anywhere; single failures are NaN in ``border``, with
    the reason in ``reasons``.

    Examples
    --------
    >>> axes = {"mass": [10.0, 30.0], "x": [0.04]}
    >>> rest = {"muscle.reference": 0.04}
    >>> found = pam.vibration.hopf_map(regulated, "muscle.gain", (1e5, 1e7), axes, rest)
    >>> bool((found.border > 0).all())
    True
    """
    given, grid = _grid(plant, axes, {**(conditions or {}), **more})
    (one, first), (two, second) = grid.items()
    if plant.variable(parameter).name in grid:
        raise InputError(f"axes: {parameter} is the parameter that is looked for; name another")
    walk = BorderWalk(plant, parameter, bracket, points, memory)
    rows: list[tuple[HopfPoint | None, ...]] = []
    for a in first.tolist():
        walk.last = (rows[-1][0] if rows else None) or walk.last
        rows.append(tuple(walk({**given, one: a, two: b}, (a, b)) for b in second.tolist()))
    if walk.last is None:
        raise InputError(f"no border anywhere: {next(iter(walk.reasons.values()))}")
    return HopfMap(plant.variable(parameter).name, grid, tuple(rows), walk.reasons)


@verb
def amplitude_map(
    plant: Plant,
    axes: Mapping[str, ArrayLike],
    conditions: Mapping[str, float] | None = None,
    /,
    *,
    state: str | None = None,
    push: Mapping[str, float] | None = None,
    periods: int = 400,
    memory: Memory = "virgin",
    executor: Place = None,
    time_limit: float | None = None,
    **more: float,
) -> AmplitudeMap:
    """How large the vibration is that a push leaves, over two values such as load and pressure.

    At each point of the grid the plant is put to rest, pushed, and simulated until its swing is
    steady; the closed motion is then found by collocation (:func:`limit_cycle`).

    Parameters
    ----------
    axes : {name: values} of two parameters, inputs, states or outputs [their units].
    conditions, memory : of the rest, as for :func:`pam_ocp.equilibrium`.
    state : whose swing is told; by default x, or the plant's one position.
    push : {state: change} [its unit]. By default a small one along the least damped mode: what then
        vibrates does so by itself. A large one finds vibration that stands beside a stable rest.
    periods : of the least damped mode, simulated at most.
    executor : where, as for :func:`pam_ocp.each`.
    time_limit : [s]; points that were not reached when it is over are unknown.

    Raises InputError for axes and names; what fails at a point stands in ``reasons``.

    Examples
    --------
    >>> calm = regulated.with_values({"muscle.gain": 2e5})
    >>> axes = {"mass": [20.0], "x": [0.04]}
    >>> found = pam.vibration.amplitude_map(calm, axes, {"muscle.reference": 0.04})
    >>> float(found.amplitude[0, 0])
    0.0
    """
    given, grid = _grid(plant, axes, {**(conditions or {}), **more})
    (one, first), (two, second) = grid.items()
    variable = watched(plant, state)
    if variable.causality != "state":
        raise InputError(f"state: {variable.name} is an {variable.causality}; name a state")
    require_count("periods", periods, ROUND)
    pushed = {plant.variable(n).name: float(v) for n, v in (push or {}).items()}
    places = [(float(a), float(b)) for a in first for b in second]
    task = partial(_cell, plant, given, (one, two), variable.name, pushed, periods, memory)
    table = np.full((5, len(places)), np.nan)
    reasons: dict[tuple[float, float], str] = {}
    reached: set[int] = set()
    try:
        for i, answer in ending(task, places, executor=executor, chunk=1, what="places"):
            if isinstance(answer, Exception):
                raise answer
            reached.add(i)
            table[:, i], reason = answer
            if reason:
                reasons[places[i]] = reason
    except TimeIsUp:
        late = [place for i, place in enumerate(places) if i not in reached]
        reasons |= dict.fromkeys(late, f"{deadline()} was over")
    amplitude, frequency, growth, closed, outside = table.reshape(5, len(first), len(second))
    return AmplitudeMap(
        plant, variable.name, grid, amplitude, frequency, growth, closed == 1, outside == 1, reasons
    )


def _grid(
    plant: Plant, axes: Mapping[str, ArrayLike], conditions: Mapping[str, float]
) -> tuple[dict[str, float], dict[str, Array]]:
    """Conditions and axes by the plant's own names, checked."""
    require_plant(plant)
    given = {plant.variable(n).name: v for n, v in conditions.items()}
    grid = {}
    for name, values in axes.items():
        variable = plant.variable(name)
        checked = [variable.check(v, "axes") for v in np.atleast_1d(np.asarray(values))]
        if variable.name in given:
            raise InputError(f"axes: {variable.name} is among the conditions as well; drop one")
        grid[variable.name] = np.array(checked, dtype=float)
    if len(grid) != 2 or not all(len(v) for v in grid.values()):
        raise InputError(
            f"axes names {', '.join(grid) or 'nothing'}: give two, such as "
            '{"mass": [10, 20, 40], "x": [0.04, 0.06, 0.08]}'
        )
    return given, grid


def _cell(
    plant: Plant,
    given: Mapping[str, float],
    names: tuple[str, str],
    state: str,
    push: Mapping[str, float],
    periods: int,
    memory: Memory,
    place: tuple[float, float],
) -> tuple[tuple[float, ...], str]:
    """What stands in an AmplitudeMap at a place; the reason where it is not known."""
    growth = np.nan
    try:
        point = equilibrium(plant, {**given, **dict(zip(names, place, strict=True))}, memory=memory)
        growth, period, mode = _least_damped(point)
        return _swing(point, state, _pushed(point, push, mode), growth, period, periods), ""
    except PamError as error:
        return (np.nan, np.nan, growth, 0.0, 0.0), str(error)


def _least_damped(point: OperatingPoint) -> tuple[float, float, Array]:
    """Growth [1/s] and period [s] of the pair that grows fastest, and its mode, largest entry 1."""
    plant = point.plant
    nominal = plant.vector("state", attribute="nominal")
    a = np.asarray(plant.jacobians(point.x, point.u, plant.vector("parameter"))[0])
    poles, vectors = np.linalg.eig(a * nominal[None, :] / nominal[:, None])
    swinging = np.abs(poles.imag) > 1e-6 * np.abs(poles)
    if not swinging.any():
        return float(poles.real.max()), 2 * np.pi / float(np.abs(poles).max()), vectors[:, 0].real
    i = int(np.argmax(np.where(swinging, poles.real, -np.inf)))
    mode = vectors[:, i] / vectors[np.argmax(np.abs(vectors[:, i])), i]
    return float(poles.real.max()), 2 * np.pi / abs(poles[i].imag), mode.real


def _pushed(point: OperatingPoint, push: Mapping[str, float], mode: Array) -> dict[str, float]:
    """The state to start from, within the plant's bounds."""
    found = {}
    for variable, rest, along in zip(point.plant.states, point.x, mode, strict=True):
        by = push.get(variable.name, 0.0) if push else PUSH * along * variable.nominal
        found[variable.name] = float(np.clip(rest + by, variable.min, variable.max))
    return found


def _swing(
    point: OperatingPoint,
    state: str,
    start: Mapping[str, float],
    growth: float,
    period: float,
    periods: int,
) -> tuple[float, float, float, float, float]:
    """Simulate until the swing is steady; the closed motion where there is one."""
    plant, variable = point.plant, point.plant.variable(state)
    values = dict(zip((v.name for v in plant.inputs), point.u, strict=True))
    t = np.linspace(0.0, ROUND * period, 40 * ROUND + 1)
    quarter = len(t) // 4
    for _ in range(periods // ROUND):
        motion = simulate(plant, values, t=t, start=start, rtol=1e-8)
        swing = motion[state]
        before, after = float(np.ptp(swing[:quarter])), float(np.ptp(swing[-quarter:]))
        if after < STILL * variable.nominal:
            return 0.0, np.nan, growth, 1.0, 0.0
        if abs(after - before) <= SETTLED * after:
            break
        end = motion.row(-1)
        start = {v.name: float(np.clip(end[v.name], v.min, v.max)) for v in plant.states}
    try:
        cycle = limit_cycle(plant, motion, tolerance=1e-7)
        if cycle.stable:
            size, left = cycle.amplitude(state), float(bool(cycle.outside))
            return size, cycle.frequency, growth, 1.0, left
    except PamError:
        pass
    if abs(after - before) > SETTLED * after:
        change = "grows" if after > before else "dies out"
        raise VibrationError(
            f"after {periods} periods it still {change}, at +-{variable.shown(after / 2)}; allow "
            "more periods, or give another push"
        )
    left = any(motion[v.name].min() < v.min or motion[v.name].max() > v.max for v in plant.states)
    return after / 2, _passages(t, swing), growth, 0.0, float(left)


def _passages(t: Array, swing: Array) -> float:
    """Frequency [Hz] by the passages through the middle, over the last half."""
    half = len(t) // 2
    y = swing[half:] - (swing[half:].max() + swing[half:].min()) / 2
    rises = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    if len(rises) < 2:
        return float("nan")
    return float((len(rises) - 1) / (t[half + rises[-1]] - t[half + rises[0]]))

"""Continuation of a limit cycle in one parameter, through folds, by its arc length.

Source: Doedel, Keller, Kernevez, Int. J. Bifurcation and Chaos 1 (1991) 745-772.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, VibrationError, require_positive
from ..core.shown import shown
from ..core.stop import TimeIsUp, deadline, turns, verb
from ..core.variables import Variable
from ..numerics.continuation import Walk
from ..numerics.newton import Array, NewtonError
from ..numerics.periodic_collocation import Orbit, Periodic, Row
from ..plants.plant import Plant
from .cycle import LimitCycle, Settings, converged, finished, pin
from .free import watched

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Direction: TypeAlias = Literal["larger", "smaller", "up", "down"]

SMALLEST_STEP = 1e-4
"""Fraction of the asked step below which the continuation gives up."""

MULTIPLIER_TOLERANCE = 1e-4
"""Largest error of the multiplier that must be 1 along a branch: its mesh follows the states."""

GROWTH = 1.5
"""By what steps grow again."""

HALVINGS = 4
"""Of the step that passes an end of the range, towards the cycle at it."""

LEAST_COSINE = 0.9
"""Of the angle between neighbouring tangents; steps are shortened where the branch bends more."""


@shown
@dataclass(frozen=True)
class CycleBranch:
    """Limit cycles along a branch, in the order in which they were found.

    Examples
    --------
    >>> small = pam.vibration.limit_cycle(border.plant, border, amplitude={"x": 2e-3})
    >>> found = pam.vibration.continue_cycle(small, "muscle.gain", (1e5, 1e7), most=3)
    >>> len(found.cycles), found.stable.shape
    (3, (3,))
    """

    parameter: str
    cycles: tuple[LimitCycle, ...]
    ended: str
    """Why the branch ends where it does."""

    @property
    def values(self) -> Array:
        """The parameter at each cycle [its unit]; not monotone where the branch folds."""
        return np.array([c.plant.variable(self.parameter).start for c in self.cycles])

    @property
    def periods(self) -> Array:
        """[s]"""
        return np.array([c.period for c in self.cycles])

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Whether each cycle is stable."""
        return np.array([c.stable for c in self.cycles])

    @property
    def folds(self) -> tuple[int, ...]:
        """Indices of the cycles next to which the parameter turns back."""
        turns = np.diff(np.sign(np.diff(self.values)))
        return tuple(int(i) + 1 for i in np.flatnonzero(turns))

    @turns
    def amplitudes(self, name: str) -> Array:
        """Half the swing of a state at each cycle [its unit]."""
        return np.array([c.amplitude(name) for c in self.cycles])

    @turns
    def at(self, value: float) -> tuple[LimitCycle, ...]:
        """The cycles at exactly this value of the parameter: one for each passage of the branch."""
        offsets = self.values - value
        found = []
        for i in np.flatnonzero(offsets[:-1] * offsets[1:] <= 0):
            one, two = self.cycles[i : i + 2]
            periodic = Periodic(one.plant, self.parameter, one.settings.degree)
            ends = self._orbit(one), self._orbit(two)
            found.append(_pinned(periodic, *ends, value, two.settings))
        if not found:
            v = self.cycles[0].plant.variable(self.parameter)
            raise InputError(
                f"value = {v.shown(value)}: the branch covers {v.shown(self.values.min())} .. "
                f"{v.shown(self.values.max())}"
            )
        return tuple(found)

    def _orbit(self, cycle: LimitCycle) -> Orbit:
        return replace(cycle.orbit, lam=Periodic(cycle.plant, self.parameter, 2).lam)

    def plot(self, state: str | None = None) -> Figure:
        """Amplitude and frequency over the parameter; unstable cycles dashed."""
        return courtesy.plot_branch(self, watched(self.cycles[0].plant, state).name)

    def plot_phase(self, state: str | None = None) -> Figure:
        """Phase portraits of the cycles in one picture."""
        v = self.cycles[0].plant.variable(self.parameter)
        return courtesy.plot_phase(
            [c.trajectory for c in self.cycles],
            watched(self.cycles[0].plant, state).name,
            self.cycles[0].plant,
            values=self.values / v.display_factor,
            label=v.label,
        )


@verb
def continue_cycle(
    cycle: LimitCycle,
    parameter: str,
    within: tuple[float, float],
    *,
    direction: Direction = "larger",
    step: float = 0.5,
    most: int = 100,
    tolerance: float = 1e-7,
    time_limit: float | None = None,
) -> CycleBranch:
    """Follow a limit cycle while a parameter (or an input) changes, also through folds.

    Parameters
    ----------
    parameter : its name. within : the range in which it may move [its unit]; the branch ends
        exactly at an end of it, or where it shrinks to an equilibrium, or after ``most`` cycles.
    direction : which way to set out: to "larger" or "smaller" oscillations, or with the
        parameter going "up" or "down".
    step : largest step along the branch, scaled by nominals (root mean square of the states,
        period relative, parameter); halved where the branch bends or Newton fails.
    tolerance : as in :func:`limit_cycle`, for the cycles of the branch.
    time_limit : [s]; when it is over, the branch so far is returned.

    Raises InputError for bad arguments. A branch that cannot be followed further is no error: what
    was found is returned, and ``ended`` says why it ends.

    Examples
    --------
    >>> small = pam.vibration.limit_cycle(border.plant, border, amplitude={"x": 2e-3})
    >>> found = pam.vibration.continue_cycle(small, "muscle.gain", (1e5, 1e7), most=3)
    >>> bool(found.amplitudes("x")[-1] > small.amplitude("x"))
    True
    """
    variable, low, high = _range(cycle, parameter, within)
    if direction not in ("larger", "smaller", "up", "down"):
        raise InputError(f"direction = {direction!r}: choose 'larger', 'smaller', 'up' or 'down'")
    step = require_positive("step", step)
    periodic = Periodic(cycle.plant, variable.name, cycle.settings.degree)
    settings = replace(
        cycle.settings,
        tolerance=require_positive("tolerance", tolerance),
        multiplier_tolerance=MULTIPLIER_TOLERANCE,
    )
    start, curve = replace(cycle.orbit, lam=periodic.lam), _Cycles(periodic, settings)
    walk = Walk(
        curve,
        start,
        curve.tangent(start, direction),
        length=step,
        longest=step,
        shortest=SMALLEST_STEP * step,
        growth=GROWTH,
        least_cosine=LEAST_COSINE,
    )
    cycles, ended = [cycle], f"{most} cycles were found"
    try:
        while len(cycles) < most:
            before, tangent = walk.place, walk.tangent
            try:
                length = walk.advance()
            except NewtonError as error:
                ended = f"the branch cannot be followed further: {error}"
                break
            value = walk.place.lam * variable.nominal
            if not low < value < high:
                bound = low if value <= low else high
                ended = f"{variable.name} reaches {variable.shown(bound)}"
                try:
                    cycles.append(_reached(curve, before, tangent, length, walk.place, bound))
                except VibrationError as error:
                    ended += f", where the cycle is not found: {error}"
                break
            if _mirrored(before, walk.place):
                shown = variable.shown(value)
                ended = (
                    "the cycle shrinks to an equilibrium (Hopf point) near "
                    f"{variable.name} = {shown}"
                )
                break
            cycles.append(finished(periodic, walk.place, settings))
    except TimeIsUp:
        ended = f"{deadline()} was over"
    return CycleBranch(variable.name, tuple(cycles), ended)


def _range(
    cycle: LimitCycle, parameter: str, within: tuple[float, float]
) -> tuple[Variable, float, float]:
    """What varies, and the checked ends of its range."""
    variable = cycle.plant.variable(parameter)
    if variable.causality not in ("parameter", "input"):
        raise InputError(
            f"parameter: {variable.name} is {variable.kind}; name a parameter or an input"
        )
    low, high = (variable.check(v, "within") for v in within)
    start = variable.start or 0.0
    if not low <= start <= high or low == high:
        raise InputError(
            f"within = {variable.shown(low)} .. {variable.shown(high)} must hold the cycle's own "
            f"{variable.name} = {variable.shown(start)}"
        )
    return variable, low, high


@dataclass(frozen=True)
class _Cycles:
    """The curve of closed motions, for :class:`pam_ocp.numerics.continuation.Walk`."""

    periodic: Periodic[Plant]
    settings: Settings

    def tangent(self, orbit: Orbit, direction: Direction) -> Row:
        """The way to set out."""
        swing = Row(orbit.z - orbit.z.mean(axis=(0, 1)), 0.0, 0.0, 0.0)
        tangent = self.periodic.tangent(orbit, swing)
        ahead = {"larger": 1.0, "smaller": -1.0}.get(direction, 0.0)
        if not ahead:
            ahead = float(np.sign(tangent.lam)) * (1.0 if direction == "up" else -1.0)
        return tangent.times(ahead)

    def step(self, place: Orbit, tangent: Row, length: float) -> tuple[Orbit, Row, float]:
        """The orbit a length away along the tangent, on a mesh of its own, and the tangent there.

        Raises NewtonError.
        """
        periodic, settings = self.periodic, self.settings
        mesh = periodic.coarsened(place, settings.tolerance, settings.intervals)
        row = tangent.on(place.mesh, mesh)
        start = place.on(mesh)
        guess = replace(
            start,
            z=start.z + length * row.z,
            lam=start.lam + length * row.lam,
            period=start.period * (1 + length * row.period * start.period),
        )
        try:
            found = converged(periodic, guess, row.through(guess), settings)
            row = row.on(mesh, found.mesh)
            ahead = periodic.tangent(found, row)
        except (VibrationError, np.linalg.LinAlgError) as error:
            raise NewtonError(str(error)) from None
        return found, ahead, row.dot(ahead, found)


def _reached(
    curve: _Cycles, before: Orbit, tangent: Row, length: float, after: Orbit, value: float
) -> LimitCycle:
    """The cycle at exactly this value within a step; from nearer neighbours where Newton fails."""
    periodic = curve.periodic
    assert periodic.variable is not None
    lam = value / periodic.variable.nominal
    for _ in range(HALVINGS):
        try:
            return _pinned(periodic, before, after, value, curve.settings)
        except VibrationError:
            length /= 2
        try:
            middle, ahead, _ = curve.step(before, tangent, length)
        except NewtonError as error:
            raise VibrationError(str(error)) from None
        if (middle.lam - lam) * (before.lam - lam) > 0:
            before, tangent = middle, ahead
        else:
            after = middle
    return _pinned(periodic, before, after, value, curve.settings)


def _pinned(
    periodic: Periodic[Plant], one: Orbit, two: Orbit, value: float, settings: Settings
) -> LimitCycle:
    """The cycle between two neighbours at exactly this value of the parameter."""
    assert periodic.variable is not None
    lam = value / periodic.variable.nominal
    share = (lam - one.lam) / (two.lam - one.lam) if two.lam != one.lam else 1.0
    mesh = periodic.coarsened(two, settings.tolerance, settings.intervals)
    first, second = one.on(mesh), two.on(mesh)
    near = Orbit(
        mesh,
        first.z + share * (second.z - first.z),
        one.period + share * (two.period - one.period),
        lam,
    )
    found = converged(periodic, near, pin(near, lam), settings)
    return finished(periodic, replace(found, lam=lam), settings)


def _mirrored(before: Orbit, after: Orbit) -> bool:
    """Whether a small cycle has passed through rest: its oscillation has changed sign."""
    s = np.linspace(0, 1, 65)[:-1]
    one, two = (o.at(s) - o.at(s).mean(axis=0) for o in (before, after))
    return bool(np.sum(one * two) < 0)

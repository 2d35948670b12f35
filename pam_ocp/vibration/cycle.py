"""Limit cycles: sustained vibration as a closed motion, with its Floquet multipliers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import courtesy
from ..core.errors import InputError, VibrationError, kind_of, require_count, require_positive
from ..core.shown import shown
from ..core.signals import signals
from ..core.stop import turns, verb
from ..core.trajectory import Trajectory
from ..numerics.newton import Array, NewtonError
from ..numerics.periodic_collocation import COLLAPSED, Orbit, Periodic, Row, fractions, radau
from ..plants.plant import Plant, require_plant
from ..simulation.integrate import evaluated
from ..simulation.simulator import simulate
from .free import smooth, watched
from .hopf_bifurcation import HopfPoint

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SAMPLES = 400
"""Samples of a cycle's trajectory."""


@dataclass(frozen=True)
class Settings:
    """How cycles are solved: polynomials of ``degree``, mesh refined until below ``tolerance``."""

    degree: int = 6
    tolerance: float = 1e-9
    intervals: int = 20
    most_intervals: int = 500
    multiplier_tolerance: float = 3e-7
    """Largest error of the multiplier that must be 1."""


@shown
@dataclass(frozen=True, eq=False)
class LimitCycle:
    """A closed motion of a plant under constant inputs.

    Examples
    --------
    >>> cycle = pam.vibration.limit_cycle(border.plant, border, amplitude={"x": 2e-3})
    >>> round(1e3 * cycle.amplitude("x"), 1), abs(cycle.frequency / border.frequency - 1) < 0.05
    (2.0, True)
    """

    plant: Plant
    """With the parameters and inputs of this cycle."""
    trajectory: Trajectory
    """One period, 401 samples."""
    period: float
    """[s]"""
    multipliers: NDArray[np.complex128]
    """Floquet multipliers: the trivial one (1 but for rounding) first, then by falling size."""
    error: float
    """Estimated error of the collocation, scaled by nominals."""
    slack: Mapping[str, float]
    """Fraction of the period during which each muscle is slack, by constraint (``x.tension``)."""
    orbit: Orbit = field(repr=False)
    settings: Settings = field(repr=False, default_factory=Settings)

    @property
    def frequency(self) -> float:
        """[Hz]"""
        return 1 / self.period

    @property
    def stable(self) -> bool:
        """Whether neighbouring motions are drawn in:
        all other multipliers inside the unit circle.
        """
        return bool(np.all(np.abs(self.multipliers[1:]) < 1))

    @property
    def outside(self) -> tuple[str, ...]:
        """States that leave their allowed range, where the force law is not known to hold."""
        names = []
        for v in self.plant.states:
            column = self.trajectory[v.name]
            if column.min() < v.min or column.max() > v.max:
                names.append(v.name)
        return tuple(names)

    @turns
    def amplitude(self, name: str) -> float:
        """Half the distance between the largest and the smallest value of a state [its unit]."""
        turns = smooth(self.plant, self.trajectory, name).zeros(0.0, order=1)[1]
        return float(np.ptp(turns) / 2)

    @cached_property
    def closing_error(self) -> float:
        """How far :func:`pam_ocp.simulation.simulator` (rtol 1e-12) misses its start after one
        period, / nominal.

        The true accuracy of the collocation; an unstable cycle's multiplier enlarges it.
        """
        names = [v.name for v in self.plant.states]
        low, high, nominal = (
            self.plant.vector("state", attribute=a) for a in ("min", "max", "nominal")
        )
        states = self.trajectory.array(names)
        room = np.min(np.minimum(states - low, high - states) / nominal, axis=1)
        start = states[int(np.argmax(room))]  # a simulation starts within the bounds
        replay = simulate(
            self.plant, t=[0.0, self.period], start=dict(zip(names, start, strict=True)), rtol=1e-12
        )
        return float(np.max(np.abs(replay.array(names)[-1] - start) / nominal))

    def __str__(self) -> str:
        kind = "stable" if self.stable else "unstable"
        largest = (
            f"{np.max(np.abs(self.multipliers[1:])):.4g}" if len(self.multipliers) > 1 else "-"
        )
        text = f"{kind} limit cycle: {self.frequency:.5g} Hz, largest other multiplier {largest}"
        for v in self.plant.states:
            text += f"\n  {v.name:<20} +-{v.shown(self.amplitude(v.name))}"
        for name, share in self.slack.items():
            if share:
                text += f"\n  {name.rpartition('.')[0]} is slack during {share:.1%} of the period"
        for name in self.outside:
            v = self.plant.variable(name)
            text += (
                f"\n  {name} leaves {v.shown(v.min)} .. {v.shown(v.max)}: the law is extrapolated"
            )
        return text

    def plot(self) -> Figure:
        """A period over time."""
        figure: Figure = self.trajectory.plot()
        return figure

    def plot_phase(self, state: str | None = None) -> Figure:
        """Phase portrait: rate over state."""
        name = watched(self.plant, state).name
        return courtesy.plot_phase(
            [self.trajectory], name, self.plant, labels=[f"{self.frequency:.3f} Hz"]
        )

    def plot_multipliers(self) -> Figure:
        """Floquet multipliers and the unit circle."""
        return courtesy.plot_multipliers(self)


@verb
def limit_cycle(
    plant: Plant,
    guess: Trajectory | HopfPoint,
    *,
    amplitude: Mapping[str, float] | None = None,
    degree: int = 6,
    tolerance: float = 1e-9,
    time_limit: float | None = None,
) -> LimitCycle:
    """The closed motion near a guess, by periodic collocation with unknown period.

    Parameters
    ----------
    guess : a Trajectory of the plant that has come near the cycle (its last oscillation is used,
        and its inputs, which must be constant there), or a HopfPoint of it.
    amplitude : for a HopfPoint, {state: half of its swing} [its unit], by default about a third
        of a nominal. The cycle then has about this size, and the Hopf point's parameter moves to
        the value at which it exists (see ``cycle.plant``): on one side of the Hopf point or the
        other, depending on ``supercritical``. Go on from there by :func:`continue_cycle`.
    degree : of the polynomials, 2 to 9. tolerance : estimated error of the states in units of
        nominal; the mesh is refined until it is met.

    The Jacobian is exact and sparse; Floquet multipliers come from the exact derivative of the
    collocated motion with respect to its start.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises VibrationError with the reason (no convergence; the guess collapses to an equilibrium),
    InputError for a guess that does not oscillate or bad arguments.

    Examples
    --------
    >>> cycle = pam.vibration.limit_cycle(border.plant, border, amplitude={"x": 2e-3})
    >>> cycle.stable, cycle.error < 1e-9
    (True, True)
    """
    require_count("degree", degree, 2, 9)
    require_plant(plant)
    if not isinstance(guess, (HopfPoint, Trajectory)):
        raise InputError(f"guess is {kind_of(guess)}, not a Trajectory or a HopfPoint")
    settings = Settings(degree, require_positive("tolerance", tolerance))
    try:
        if isinstance(guess, HopfPoint):
            return _from_hopf(plant, guess, amplitude, settings)
        if amplitude is not None:
            raise InputError("amplitude goes with a HopfPoint as guess; a Trajectory has its own")
        return _from_trajectory(plant, guess, settings)
    except VibrationError as error:
        raise VibrationError(f"no limit cycle found from this guess: {error}") from None


def _from_hopf(
    plant: Plant, start: HopfPoint, amplitude: Mapping[str, float] | None, settings: Settings
) -> LimitCycle:
    names = [v.name for v in start.plant.states]
    if names != [v.name for v in plant.states]:
        raise InputError(f"the Hopf point belongs to {start.plant.name!r}, not {plant.name!r}")
    periodic = Periodic(start.plant, start.parameter, settings.degree)
    mode = start.mode / periodic.nominal
    if amplitude is None:
        size = 0.3 / float(np.max(np.abs(mode)))
    else:
        if len(amplitude) != 1:
            raise InputError(f"amplitude = {dict(amplitude)}: name one state")
        ((name, swing),) = amplitude.items()
        variable = plant.variable(name)
        if variable.name not in names:
            raise InputError(f"amplitude: {variable.name} is an {variable.causality}; name a state")
        swing = require_positive(f"amplitude of {variable.name}", swing, variable.unit)
        size = swing / float(np.abs(start.mode[names.index(variable.name)]))
    mesh = np.linspace(0, 1, settings.intervals + 1)
    rest = np.broadcast_to(
        start.point.x / periodic.nominal, (settings.intervals, settings.degree, len(names))
    )
    still = Orbit(mesh, rest, 1 / start.frequency, periodic.lam)
    s = fractions(mesh, radau(settings.degree))
    wave = np.real(np.exp(2j * np.pi * s)[..., None] * mode)
    orbit = replace(still, z=rest + size * wave)
    # what is held is the share of the linear mode in the motion
    row = Row(wave, 0.0, 0.0, 0.0).through(orbit)
    return finished(periodic, converged(periodic, orbit, row, settings), settings)


def _from_trajectory(plant: Plant, guess: Trajectory, settings: Settings) -> LimitCycle:
    names = [v.name for v in plant.states]
    last = guess.at(guess.t[guess.t >= guess.t[-1] - guess.duration / 2])
    inputs = {}
    for v in plant.inputs:
        if v.name not in guess:
            continue
        if np.ptp(last[v.name]) > 1e-9 * v.nominal:
            raise InputError(f"the guess's input {v.name} moves; a limit cycle has constant inputs")
        inputs[v.name] = float(last[v.name][-1])
    plant = plant.with_values(inputs)
    nominal = plant.vector("state", attribute="nominal")
    states = last.array(names) / nominal
    begin, end = _oscillation(last.t, states)
    periodic = Periodic(plant, None, settings.degree)
    mesh = np.linspace(0, 1, settings.intervals + 1)
    t = begin + (end - begin) * fractions(mesh, radau(settings.degree))
    z = np.stack([np.interp(t, last.t, column) for column in states.T], axis=-1)
    orbit = Orbit(mesh, z, end - begin, 0.0)
    return finished(periodic, converged(periodic, orbit, pin(orbit, 0.0), settings), settings)


def _oscillation(t: Array, states: Array) -> tuple[float, float]:
    """Begin and end [s] of the last oscillation: the state that swings most passes its middle."""
    swing = np.ptp(states, axis=0)
    if swing.max() < 2 * COLLAPSED:
        raise InputError(
            f"the guess does not oscillate (all states move by less than {swing.max():.1e} of "
            "nominal in its second half): it has come to rest; start farther from rest, or choose "
            "parameters beyond the Hopf border"
        )
    y = states[:, int(np.argmax(swing))]
    y = y - (y.max() + y.min()) / 2
    rises = np.flatnonzero((y[:-1] < 0) & (y[1:] >= 0))
    if len(rises) < 2:
        raise InputError(
            "the guess holds less than one oscillation in its second half; make it longer"
        )
    share = y[rises] / (y[rises] - y[rises + 1])
    times = t[rises] + share * (t[rises + 1] - t[rises])
    there = np.stack([np.interp(times, t, column) for column in states.T], axis=-1)
    # a cycle may pass its middle more than once: take the last passage that comes home
    distance = np.max(np.abs(there[:-1] - there[-1]) / swing.max(), axis=1)[::-1][:8]
    back = int(np.argmax(distance <= 2 * distance.min() + 1e-2))
    return float(times[-2 - back]), float(times[-1])


# ---- shared with the continuation -----------------------------------------------------------


def pin(orbit: Orbit, lam: float) -> Row:
    """The condition that the varying value is ``lam``."""
    return Row(np.zeros_like(orbit.z), 0.0, 1.0, lam)


def converged(periodic: Periodic[Plant], orbit: Orbit, row: Row, settings: Settings) -> Orbit:
    """The closed motion that meets ``row``, on a mesh fine enough for states and multipliers."""
    tolerance = settings.tolerance
    for _ in range(16):
        try:
            orbit = periodic.solve(orbit, row)
        except NewtonError as error:
            raise VibrationError(str(error)) from None
        errors = periodic.errors(orbit)
        if errors.max() <= tolerance:
            if periodic.trivial_error(orbit) <= settings.multiplier_tolerance:
                return orbit
            tolerance /= 10  # at the ends of slack phases multipliers are harder than states
        if len(errors) > settings.most_intervals:
            if errors.max() <= settings.tolerance:
                return orbit  # the multiplier that must be 1 shows how far the others hold
            break
        mesh = periodic.refined(orbit.mesh, errors, tolerance)
        row = row.on(orbit.mesh, mesh)
        orbit = orbit.on(mesh)
        if row.z.any():
            row = row.through(orbit)
    raise VibrationError(
        f"the estimated error {errors.max():.1e} stays above the tolerance {tolerance:.0e} (units "
        f"of nominal) on {len(orbit.z)} intervals; allow a larger tolerance"
    )


def finished(periodic: Periodic[Plant], orbit: Orbit, settings: Settings) -> LimitCycle:
    """What a user wants to know of a closed motion."""
    plant = periodic.plant
    if periodic.variable is not None:
        value = orbit.lam * periodic.variable.nominal
        plant = plant.with_values({periodic.variable.name: value})
    s = np.linspace(0, 1, SAMPLES + 1)
    states = orbit.at(s) * periodic.nominal
    times = s * orbit.period
    inputs = signals(plant, None, times, "previous")
    trajectory = evaluated(plant, times, states, inputs)
    paths = np.asarray(plant.function(states.T, inputs(times).T, plant.vector("parameter"))[2])
    slack = {
        v.name: float(np.mean(row[:-1] < 0))
        for v, row in zip(plant.constraints, paths, strict=True)
        if v.name.endswith(".tension")
    }
    return LimitCycle(
        plant,
        trajectory,
        orbit.period,
        periodic.multipliers(orbit),
        float(periodic.errors(orbit).max()),
        slack,
        orbit,
        settings,
    )

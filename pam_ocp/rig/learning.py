"""What runs teach. Identification: design an excitation, play it, fit, judge; and again. Iterative
learning: a motion that is repeated gets better from run to run.

Learning is norm-optimal (N. Amann, D. H. Owens, E. Rogers, IEE Proc. Control Theory Appl. 143
(1996) 217-224): the change of the inputs minimises |e - G du|^2 + weight (|du|^2 + bend |d2u|^2),
with G the response of the tracked variable by the linearisation along the motion, d2u second
differences. A run that is worse than the best one so far is taken back, and bend grows: models are
wrong first where a load swings by itself, so changes are learned the slower, the quicker they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_count, require_positive
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..fitting.dynamic.dynamic import fit_plant
from ..fitting.dynamic.plant_fit import PlantFit
from ..fitting.experiments.signals import SignalDesign, design_signal
from ..plants.plant import Plant
from ..simulation.sampled import SampledPlant
from .side import play, start_of

if TYPE_CHECKING:
    from .rig import Rig

Array: TypeAlias = NDArray[np.float64]
INSIDE = 0.9
"""Part of the guard's limits, from their middle, that an excitation may go to by the model."""
POINTS = 100
"""Of the motion, at which inputs are changed."""
BEND = 100.0
"""Weight of second differences at first. The worst of 20 twins at random gets 9.2 times better in
ten runs with 100, 5.7 times with 30, 4.3 times without (there steps were halved instead)."""
STRICTER = 4.0
"""By which it grows after a run that was worse."""


# ---- parameters of the model ---------------------------------------------------------------------
@shown
@dataclass(frozen=True)
class Identified:
    """What was found: ``fit`` of all records, ``plant`` with its values, and why it ended.

    Examples
    --------
    >>> pam.rig.Identified.__name__
    'Identified'
    """

    fit: PlantFit
    designs: tuple[SignalDesign, ...] = field(repr=False)
    records: tuple[Trajectory, ...] = field(repr=False)
    reached: bool
    """Whether all intervals are as narrow as was asked for."""
    ended: str

    @property
    def plant(self) -> Plant:
        """The model with the fitted values."""
        return self.fit.plant

    @property
    def adequate(self) -> bool:
        """Whether the residuals show no sign of anything missing in the model."""
        return self.fit.adequacy.adequate

    def report(self) -> str:
        """Rounds, why it ended, and the fit's own report."""
        return f"{len(self.records)} excitations; {self.ended}\n{self.fit.report()}"

    __str__ = report


@verb
def identify(
    rig: Rig,
    free: Sequence[str | Sequence[str]],
    *,
    duration: float = 4.0,
    width: float = 0.05,
    rounds: int = 3,
    within: float | None = None,
    at: Mapping[str, float] | None = None,
    noise: Mapping[str, float] | None = None,
    inputs: Mapping[str, tuple[float, float]] | None = None,
    sample: float | None = None,
    segments: int = 8,
    outputs: Sequence[str] | None = None,
    offsets: Sequence[str] = (),
    seed: int = 0,
) -> Identified:
    """Fit parameters of the rig's model to excitations that are designed for it, one by one.

    Each excitation is the best by the fit so far (:func:`design_signal`), within the ranges of the
    commands and inside of the guard's limits; all records are fitted together, and the fit's
    adequacy is judged. It ends when all 95 % intervals are narrower than ``width`` on each side,
    relative to their values, after ``rounds``, or where another excitation would not end ``within``
    [s] on the rig's clock (the first one is always played).

    free : parameters, as for :func:`fit_plant`. duration : of an excitation [s]. at : commands to
    start from; by default the middle of their ranges. noise : {reading: standard deviation}; by
    default measured at rest. inputs : {command: (low, high)}, by default the middle 80 % of their
    ranges. sample : of the fit [s]; by default a multiple of the rig's near 20 ms. segments :
    levels of each command. outputs, offsets : as for :func:`fit_plant`.

    Raises RigError where the guard vents, InputError, FitError.
    """
    if rig.plant is None:
        raise InputError("identify: the rig has no model; give Rig(..., plant=...)")
    require_count("rounds", rounds)
    width, duration = require_positive("width", width), require_positive("duration", duration, "s")
    every = max(1, round((sample or 0.02) / rig.sample_time))
    step = every * rig.sample_time
    known_names = {v.name for v in (*rig.plant.states, *rig.plant.outputs)}
    measured = [n for n, r in rig.readings.items() if not r.slope_of and n in known_names]
    measured = [n for n in measured if n in (outputs or measured)]
    rig.require_armed()
    most = None if within is None else require_positive("within", within, "s")
    begun = rig.clock.now()
    ranges = inputs or {n: _inner(c.low, c.high, 0.8) for n, c in rig.commands.items()}
    begin = {n: (low + high) / 2 for n, (low, high) in ranges.items()} | dict(at or {})
    if noise is None:
        seen = rig.check(1.0)
        sizes = {n: rig.readings[n].variable(rig.plant).nominal for n in measured}
        noise = {n: max(seen[n]["deviation"], 1e-4 * sizes[n]) for n in measured}
    limits = {
        n: _inner(r.low, r.high, INSIDE)
        for n, r in rig.readings.items()
        if n in measured and np.isfinite(r.low) and np.isfinite(r.high)
    }
    known: Plant | PlantFit = rig.plant
    designs: list[SignalDesign] = []
    records: list[Trajectory] = []
    ended = f"{rounds} rounds are over"
    reached = False
    for k in range(rounds):
        if most is not None and k and rig.clock.now() - begun + duration > most:
            ended = f"{most:g} s are over"
            break
        model = known if isinstance(known, Plant) else known.plant
        rest = model.equilibrium(begin)
        design = design_signal(
            known,
            list(free),
            duration=duration,
            noise={n: noise[n] for n in measured},
            inputs=ranges,
            sample=step,
            segments=segments,
            limits=limits,
            start={v.name: rest[v.name] for v in model.states},
            tries=1,
            seed=seed + k,
        )
        designs.append(design)
        records.append(_thinned(play(rig, design.trajectory, begin), every))
        known = fit_plant(
            model, records, list(free), outputs=measured, offsets=offsets, widest=False
        )
        if _narrow(known, width):
            reached, ended = True, f"all intervals are within {100 * width:g} % of their values"
            break
    assert isinstance(known, PlantFit)
    return Identified(known, tuple(designs), tuple(records), reached, ended)


def _inner(low: float, high: float, part: float) -> tuple[float, float]:
    middle, half = (low + high) / 2, part * (high - low) / 2
    return middle - half, middle + half


def _thinned(record: Trajectory, every: int) -> Trajectory:
    """Every so many samples, at which inputs may have changed; between them they were held."""
    rows = slice(None, None, every)
    columns: dict[str, Any] = {n: record[n][rows] for n in record.names}
    return Trajectory(record.t[rows], columns, record.variables, "previous")


def _narrow(fit: PlantFit, width: float) -> bool:
    for name, (low, high) in fit.intervals().items():
        value = fit.values[name]
        if not (np.isfinite(high - low) and (high - low) / 2 <= width * abs(value)):
            return False
    return True


# ---- inputs of a motion --------------------------------------------------------------------------
@shown
@dataclass(frozen=True)
class Learned:
    """What the runs came to. ``errors`` : RMS of the tracked variable in each run [its unit];
    ``inputs``, ``start`` : those of the best run, and the commands of the rest before it, for
    ``rig.run(learned.inputs, start=learned.start)``; ``runs`` : what was read in each.

    Examples
    --------
    >>> pam.rig.Learned.__name__
    'Learned'
    """

    track: str
    errors: tuple[float, ...]
    inputs: Trajectory = field(repr=False)
    start: Mapping[str, float]
    runs: tuple[Trajectory, ...] = field(repr=False)

    @property
    def gain(self) -> float:
        """Error of the first run over that of the best."""
        return self.errors[0] / min(self.errors)

    def report(self) -> str:
        """The errors, run by run."""
        rows = [f"run {k + 1}: RMS of {self.track} {e:.4g}" for k, e in enumerate(self.errors)]
        return "\n".join([*rows, f"{self.gain:.3g} times better than the first"])

    __str__ = report


@verb
def learn(
    rig: Rig,
    motion: Any,
    track: str,
    *,
    runs: int = 10,
    weight: float = 1e-3,
    step: float | None = None,
    gain: float = 0.8,
) -> Learned:
    """Repeat a motion on an armed rig, and change its inputs so that ``track`` follows it.

    motion : a plan or a trajectory of the rig's model, with all its states and inputs. track : a
    reading that the motion has, too. weight : of changes of the inputs, relative to the largest
    response squared. step : by which inputs are changed [s]; by default a hundredth of the motion.
    gain : part of the optimal change that is made.

    Raises RigError where the guard vents, InputError.
    """
    wanted = getattr(motion, "trajectory", motion)
    plant = rig.plant
    if plant is None or not isinstance(wanted, Trajectory):
        raise InputError("learn: give a rig with a model (plant=), and a plan or trajectory of it")
    require_count("runs", runs)
    rig.require_armed()
    if track not in rig.readings or track not in wanted:
        raise InputError(f"track = {track!r} must be a reading of the rig and stand in the motion")
    usual = wanted.duration / POINTS
    asked = usual if step is None else require_positive("step", step, "s")
    every = max(1, round(asked / rig.sample_time))
    h = every * rig.sample_time
    count = max(2, round(wanted.duration / h))
    times = np.minimum(wanted.t[0] + h * np.arange(count + 1), wanted.t[-1])
    goal = wanted.at(times)[track]
    names = list(rig.commands)
    response = _response(plant, wanted, times, track, names, h)
    nominal = np.array([rig.commands[n].high - rig.commands[n].low for n in names])
    scaled = response * np.tile(nominal, count + 1)[None, :]
    size = float(np.linalg.norm(scaled, 2)) ** 2
    second = np.kron(np.diff(np.eye(count + 1), 2, axis=0), np.eye(len(names)))
    middles = np.minimum(times[:-1] + h / 2, wanted.t[-1])
    begin = start_of(rig, wanted)
    u = np.vstack([[begin[n] for n in names], wanted.at(middles).array(names)])
    low, high = (np.array([getattr(rig.commands[n], a) for n in names]) for a in ("low", "high"))
    best, bend = (np.inf, u, np.zeros(count + 1)), BEND
    errors, seen = [], []
    for _ in range(runs):
        run = play(rig, _inputs(plant, times, u[1:], names), dict(zip(names, u[0], strict=True)))
        error = goal - np.interp(times - times[0], run.t, run[track])
        rms = float(np.sqrt(np.mean(error**2)))
        errors.append(rms)
        seen.append(run)
        if rms <= best[0]:
            best = rms, u, error
        else:
            bend *= STRICTER
        cost = weight * size * (np.eye(scaled.shape[1]) + bend * second.T @ second)
        change = np.linalg.solve(scaled.T @ scaled + cost, scaled.T @ best[2])
        u = np.clip(best[1] + gain * change.reshape(count + 1, -1) * nominal, low, high)
    start = dict(zip(names, best[1][0].tolist(), strict=True))
    inputs = _inputs(plant, times, best[1][1:], names)
    return Learned(track, tuple(errors), inputs, start, tuple(seen))


def _inputs(plant: Plant, times: Array, u: Array, names: list[str]) -> Trajectory:
    """Inputs held from time to time."""
    held = np.vstack([u, u[-1:]])
    columns = {n: held[:, i] for i, n in enumerate(names)}
    return Trajectory(times - times[0], columns, [plant.variable(n) for n in names], "previous")


def _response(
    plant: Plant, motion: Trajectory, times: Array, track: str, names: list[str], h: float
) -> Array:
    """Change of ``track`` at the times (n+1) per change of the inputs: those of the rest before the
    motion, and those held over each step, ((n+1) m).
    """
    at = motion.at(times)
    x, u = at.array([v.name for v in plant.states]), at.array([v.name for v in plant.inputs])
    sampled, places = (
        SampledPlant(plant, h),
        [[v.name for v in plant.inputs].index(n) for n in names],
    )
    n, m, count = x.shape[1], len(names), len(times) - 1
    row = _row(plant, track, x, u)
    scale = plant.vector("state", attribute="nominal")
    a, b = (np.asarray(j) for j in plant.jacobians(x[0], u[0], plant.vector("parameter"))[:2])
    inner = np.linalg.pinv(a * scale / scale[:, None], rcond=1e-9)
    rest = -(inner @ (b[:, places] / scale[:, None])) * scale[:, None]
    found = np.zeros((count + 1, (count + 1) * m))
    state = np.zeros((n, (count + 1) * m))
    state[:, :m] = rest
    found[0] = row[0] @ state
    for k in range(count):
        step_a, step_b = sampled.slopes(x[k], u[k], inputs=places)
        state = step_a @ state
        state[:, (k + 1) * m : (k + 2) * m] += step_b
        found[k + 1] = row[k + 1] @ state
    return found


def _row(plant: Plant, track: str, x: Array, u: Array) -> Array:
    """Slopes of the tracked variable over the states, along the motion."""
    states = [v.name for v in plant.states]
    name = plant.variable(track).name
    if name in states:
        return np.tile(np.eye(len(states))[states.index(name)], (len(x), 1))
    place = [v.name for v in plant.outputs].index(name)
    p = plant.vector("parameter")
    return np.array(
        [np.asarray(plant.jacobians(a, b, p)[2])[place] for a, b in zip(x, u, strict=True)]
    )

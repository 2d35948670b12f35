"""Iterative learning: a motion that is repeated gets better from run to run.

Norm-optimal (N. Amann, D. H. Owens, E. Rogers, IEE Proc. Control Theory Appl. 143 (1996) 217-224):
the change of the inputs minimises |e - G du|^2 + weight (|du|^2 + bend |d2u|^2), with G the
response of the tracked variable by the linearisation along the motion, d2u second differences. A
run that is worse than the best one so far is taken back, and bend grows: models are wrong first
where a load swings by itself, so changes are learned the slower, the quicker they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, require_count, require_positive
from ..core.shown import shown
from ..core.stop import verb
from ..core.trajectory import Trajectory
from ..plants.plant import Plant
from ..simulation.sampled import SampledPlant
from .side import play, start_of

if TYPE_CHECKING:
    from .rig import Rig

Array: TypeAlias = NDArray[np.float64]
POINTS = 100
"""Of the motion, at which inputs are changed."""
BEND = 100.0
"""Weight of second differences at first. The worst of 20 twins at random gets 9.2 times better in
ten runs with 100, 5.7 times with 30, 4.3 times without (there steps were halved instead)."""
STRICTER = 4.0
"""By which it grows after a run that was worse."""


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

    def __str__(self) -> str:
        return self.report()


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

"""What a closed loop did, compared with what it was asked to do: from its signals alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.errors import require_names, with_kinds
from ..core.shown import shown
from ..core.trajectory import Trajectory

Array: TypeAlias = NDArray[np.float64]

LATE = 0.1
"""Of a run, at its end: where a set point is to have been reached."""
MISSED = 0.01
"""Of the stroke: farther from its set point a variable has missed it."""
SMALLEST_STROKE = 0.2
"""Of nominal: what is to stay where it is, or to go less far, is not measured by less; a hundredth
of it is what a rig's position sensor tells (20 um where 10 mm are nominal).
"""
TURNS = 4
"""In the second half of a run: what passes its middle as often swings."""
LITTLE = 1e-3
"""Of an error, what is left of it when it was gone: no way any more."""
FIGURES = 3
"""Digits of a distance that is told."""
UNCONVERGED = 0.2
"""Of the calls of a solver: more that are not converged are named."""
ASTRAY = 0.25
"""Of the changes from sample to sample: predictions that miss more are named."""
BROKEN = 0.01
"""Of nominal: a limit that is exceeded by more is broken."""
SATURATED = 0.5
"""Of the second half of a run: an input at its limits for longer explains what was missed."""
STILL = 1e-6
"""Of nominal: an input that changes by less stood still."""
NOISE = 3.0
"""Standard deviations of a measurement that are nobody's fault."""


@shown
@dataclass(frozen=True)
class LoopVerdict:
    """Whether a closed loop did what it was asked, in one sentence; ``bool(verdict)``.

    Examples
    --------
    >>> mpc = pam.Mpc(plant, horizon=20, sample_time=0.01, track={"x": 1.0})
    >>> loop = mpc.closed_loop(plant, {"x": 0.045}, duration=1.0, start=point)
    >>> bool(loop.verdict)
    True
    >>> loop.verdict.missed
    {}
    """

    faults: tuple[str, ...] = ()
    """What was not as it should be, each in words with its figures."""
    kept: tuple[str, ...] = ()
    """What was looked at and found in order."""
    missed: Mapping[str, float] = field(default_factory=dict)
    """{variable: distance from its set point at the end, as a part of the stroke}, of those missed;
    of a variable that is to stay, or goes less far, as a part of a fifth of its nominal value.
    """
    broken: Mapping[str, float] = field(default_factory=dict)
    """{variable: by how much its range was exceeded [its unit]}."""
    idle: tuple[str, ...] = ()
    """Inputs that had no influence on what was to be reached."""
    unconverged: float | None = None
    """Part of the solver's calls that did not converge, failed ones among them."""
    prediction: float | None = None
    """Error of the predictions over one sample, as a part of the changes over one sample."""

    def __bool__(self) -> bool:
        return not self.faults

    def __str__(self) -> str:
        if self.faults:
            return f"not as asked: {'; '.join(self.faults)}"
        return f"as asked: {'; '.join(self.kept) or 'nothing was to be reached or kept'}"

    def _brief(self) -> str:
        return str(self)


@with_kinds
def judge_loop(
    motion: Trajectory,
    *,
    wanted: Trajectory | None = None,
    inputs: Sequence[str] = (),
    limits: Mapping[str, tuple[float, float]] | None = None,
    noise: Mapping[str, float] | None = None,
    calls: Mapping[str, int] | None = None,
    predicted: Mapping[str, ArrayLike] | None = None,
    sample_time: float = 0.0,
    idle: Sequence[str] = (),
    behind: Sequence[str] = (),
) -> LoopVerdict:
    """The verdict on a closed loop by what happened in it.

    motion : states, inputs and outputs as they were [SI]. wanted : what was to be reached, at the
        same times. inputs : those that the controller chose.
    limits : {variable: (low, high)} besides the variables' own ranges.
    noise : {variable: standard deviation of what the controller knows of it}.
    calls : {"all", "unconverged", "failed": how many} of the controller's solver.
    predicted : {variable: values at the end of each sample, as they were predicted at its
        beginning}, and ``sample_time`` [s].
    idle : inputs that are known to have no influence where the run began.
    behind : inputs whose dead zone stands behind something that moves (a spool): it is not crossed
        at once, and where a loop swings that is why.

    Examples
    --------
    >>> still = pam.simulate(plant, duration=1.0, start=point)
    >>> wanted = pam.Trajectory(still.t, {"x": still["x"] + 0.01}, [still.variable("x")])
    >>> missed = pam.judge.judge_loop(still, wanted=wanted, inputs=["muscle.command"]).missed
    >>> round(missed["x"], 6)
    1.0
    """
    noise = noise or {}
    require_names("inputs", inputs)
    for name in (*inputs, *(limits or {})):
        motion.variable(name)
    missed, words = _missed(motion, wanted, noise, behind)
    faults, kept = list(words.values()), []
    if wanted is not None and not missed and (reached := _judged(motion, wanted)):
        kept.append(f"{', '.join(reached)} within {100 * MISSED:g} % of the stroke")
    found, told = _idle(motion, wanted, missed, inputs, idle)
    faults += told
    broken = _broken(motion, limits or {}, set(inputs))
    faults += [
        f"{n} leaves its range by {motion.variable(n).shown(size, FIGURES)}"
        for n, size in broken.items()
    ]
    if not broken:
        kept.append("limits kept")
    share = None
    if calls and calls["all"]:
        share, solved = _solved(calls)
        (faults if share > UNCONVERGED or calls["failed"] else kept).append(solved)
    error = None
    if predicted:
        error, foretold = _prediction(motion, predicted, sample_time, noise)
        if error is not None:
            (faults if error > ASTRAY else kept).append(foretold)
    return LoopVerdict(tuple(faults), tuple(kept), missed, broken, found, share, error)


def _late(motion: Trajectory) -> NDArray[np.bool_]:
    return np.asarray(motion.t >= motion.t[-1] - LATE * motion.duration)


def _judged(motion: Trajectory, wanted: Trajectory) -> list[str]:
    """What is wanted at one value at the end of the run; along a motion nothing is a set point."""
    late = _late(motion)
    known = [n for n in wanted.names if n in motion]
    return [n for n in known if np.ptp(wanted[n][late]) <= MISSED * _stroke(motion, wanted, n)]


def _stroke(motion: Trajectory, wanted: Trajectory, name: str) -> float:
    """How far a variable is to go; of one that is to stay at least ``SMALLEST_STROKE``."""
    goal = wanted[name]
    way = max(float(np.ptp(goal)), float(np.max(np.abs(goal - motion[name][0]))))
    return max(way, SMALLEST_STROKE * float(motion.variable(name).nominal))


def _missed(
    motion: Trajectory,
    wanted: Trajectory | None,
    noise: Mapping[str, float],
    behind: Sequence[str],
) -> tuple[dict[str, float], dict[str, str]]:
    """(distances as parts of the stroke, in words), of the set points that were missed."""
    shares: dict[str, float] = {}
    words: dict[str, str] = {}
    if wanted is None:
        return shares, words
    late = _late(motion)
    for name in _judged(motion, wanted):
        variable, goal = motion.variable(name), wanted[name]
        stroke = _stroke(motion, wanted, name)
        error = float(np.max(np.abs(motion[name] - goal)[late]))
        if error > MISSED * stroke + NOISE * noise.get(name, 0.0):
            shares[name] = error / stroke
            way, unit = stroke, "the stroke"
            if stroke <= SMALLEST_STROKE * variable.nominal:
                way, unit = variable.nominal, f"its nominal {variable.shown(variable.nominal)}"
            words[name] = (
                f"{name} ends {variable.shown(error, FIGURES)} from its set point "
                f"{variable.shown(goal[-1], 2 * FIGURES)} ({100 * error / way:.3g} % of {unit})"
                f"{_manner(motion, name, motion[name] - goal, MISSED * stroke, behind)}"
            )
    return shares, words


def _manner(
    motion: Trajectory, name: str, error: Array, allowed: float, behind: Sequence[str]
) -> str:
    """How a set point is missed, in words: whether it swings, or is still on its way."""
    second = motion.t >= motion.t[0] + motion.duration / 2
    around = error[second] - float(np.mean(error[second]))
    swing = float(np.ptp(around)) / 2
    wide = np.abs(around) > swing / 4
    times = motion.t[second][wide][1:][np.diff(np.sign(around[wide])) != 0]
    if swing > allowed and len(times) >= TURNS:
        often = (len(times) - 1) / (2 * (times[-1] - times[0]))
        told = f", swinging by {motion.variable(name).shown(swing, FIGURES)} at {often:.2g} Hz"
        if behind:
            told += (
                f", while the dead zone of {', '.join(behind)} is crossed behind a part that "
                "moves, which takes time"
            )
        return told
    begin, end = abs(error[second][0]), abs(error[-1])
    if len(times) <= 1 and LITTLE * begin < end < begin / 2:
        return ", still on its way"
    return ""


def _idle(
    motion: Trajectory,
    wanted: Trajectory | None,
    missed: Mapping[str, float],
    inputs: Sequence[str],
    idle: Sequence[str],
) -> tuple[tuple[str, ...], list[str]]:
    """(inputs without influence, in words): asked only where something was missed."""
    if wanted is None or not missed:
        return (), []
    known = [n for n in inputs if n in motion]
    at_end: list[str] = []
    still: list[str] = []
    told = []
    for name in known:
        variable, values = motion.variable(name), motion[name]
        edge = STILL * variable.nominal
        held = (values <= variable.min + edge) | (values >= variable.max - edge)
        late = float(np.mean(held[len(held) // 2 :]))
        if np.ptp(values) <= edge and np.all(held):
            at_end.append(name)
        elif np.ptp(values) <= edge:
            still.append(name)
        elif late > SATURATED:
            told.append(f"{name} is at its limits {100 * late:.0f} % of the time")
    if at_end:
        told.append(f"{', '.join(at_end)} stood at an end of the range all the time")
    stuck = [n for n in missed if np.ptp(motion[n]) <= STILL * motion.variable(n).nominal]
    moved = [n for n in known if n not in still and n not in at_end]
    without = list(dict.fromkeys([*idle, *still]))
    if stuck and moved and not without:
        without = moved
    if without and (stuck or idle or len(still) == len(known)):
        told.append(f"{', '.join(without)} had no influence on {', '.join(missed)}")
    else:
        without = []
    return tuple(dict.fromkeys([*at_end, *without])), told


def _broken(
    motion: Trajectory, limits: Mapping[str, tuple[float, float]], inputs: set[str]
) -> dict[str, float]:
    """By how much ranges were exceeded; inputs act within theirs."""
    found: dict[str, float] = {}
    for name in motion.names:
        if name in inputs:
            continue
        variable = motion.variable(name)
        low, high = limits.get(name, (variable.min, variable.max))
        low, high = max(low, variable.min), min(high, variable.max)
        values = motion[name]
        beyond = float(max(np.max(values - high), np.max(low - values)))
        if beyond > BROKEN * variable.nominal:
            found[name] = beyond
    return found


def _solved(calls: Mapping[str, int]) -> tuple[float, str]:
    count, failed = calls["all"], calls["failed"]
    left = calls["unconverged"] + failed
    words = (
        f"{left} of {count} solves did not converge" if left else f"all {count} solves converged"
    )
    if failed:
        words += f", {failed} of them failed"
    return left / count, words


def _prediction(
    motion: Trajectory,
    predicted: Mapping[str, ArrayLike],
    sample_time: float,
    noise: Mapping[str, float],
) -> tuple[float | None, str]:
    """(root mean square of the errors over that of the changes, in words), of the worst variable.

    None where nothing changed by more than what is not known of it.
    """
    shares: dict[str, float] = {}
    for name, values in predicted.items():
        told = np.asarray(values, dtype=float)
        t = sample_time * np.arange(len(told) + 1.0)
        real = np.interp(t, motion.t, motion[name])
        known = np.isfinite(told)
        if not known.any():
            continue
        change, error = (
            float(np.sqrt(np.mean(np.square(e[known])))) for e in (np.diff(real), told - real[1:])
        )
        floor = noise.get(name, 0.0)
        if change > NOISE * floor + STILL * motion.variable(name).nominal:
            shares[name] = max(error - NOISE * floor, 0.0) / change
    if not shares:
        return None, ""
    worst = max(shares, key=lambda n: shares[n])
    share = shares[worst]
    if share > ASTRAY:
        return share, (
            f"predictions of {worst} over one sample miss {100 * share:.0f} % of its changes"
        )
    return share, f"predictions of {worst} miss {100 * share:.1f} % of its changes"

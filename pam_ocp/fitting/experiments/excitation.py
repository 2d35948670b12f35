"""Signals for a record that is to be designed, what must be kept while they run, and the Fisher
information of that record as a function of its inputs.

The sensitivities d(measured)/d(parameters, initial state) are those of the motion by RK4 (R. Mehra,
IEEE Trans. Autom. Control 19 (1974) 753-768). CasADi differentiates it, so the information has
exact derivatives by the inputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeAlias

import casadi as ca
import numpy as np

from ...core.errors import (
    FitError,
    InputError,
    SimulationError,
    require_count,
    require_ends,
    require_positive,
)
from ...core.stop import check
from ...core.trajectory import Trajectory
from ...numerics.runge_kutta import rk4
from ...plants.plant import Plant, Values
from ..dynamic.coverage import Band, Coverage, Reach
from ..dynamic.experiment import ParameterGroup, played
from ..dynamic.rig import RunUnknowns, Unknown
from ..statistics import Array

FAINT = 1e-6
"""Information on each initial state [1/nominal^2] that is always there: some are seen by nothing.
"""


@dataclass(frozen=True, eq=False)
class Excitation:
    """A record of K + 1 samples every ``sample`` s under inputs mid + half (basis @ w). basis : (K
    + 1, d) values at the samples, or (K, d) in the intervals when inputs are held. w : (d, nu) is
    what a design chooses. mid, half : of the inputs' ranges (nu,). noise : {measured variable:
    standard deviation}. watched : {variable: (low, high)} to keep.
    """

    plant: Plant
    groups: Sequence[ParameterGroup]
    noise: Mapping[str, float]
    sample: float
    basis: Array
    held: bool
    inputs: tuple[str, ...]
    mid: Array
    half: Array
    start: Array
    known_start: bool
    watched: Mapping[str, tuple[float, float]]
    steps: int = 1

    @property
    def count(self) -> int:
        """Number of intervals, K."""
        return len(self.basis) - (not self.held)

    @property
    def unknowns(self) -> int:
        """Parameters, then initial states where these are not known."""
        return len(self.groups) + (0 if self.known_start else len(self.plant.states))

    # ---- programs ---------------------------------------------------------------------------
    @cached_property
    def _nominal(self) -> Array:
        return self.plant.vector("state", attribute="nominal")

    def _step(self) -> ca.Function:
        """(state in nominals, inputs at the begin and end, parameters) -> state a sample later."""
        plant, nominal = self.plant, self._nominal
        x, p = ca.SX.sym("x", len(nominal)), ca.SX.sym("p", len(plant.parameters))
        u0, u1 = (ca.SX.sym(n, len(plant.inputs)) for n in ("u0", "u1"))

        def slope(z: ca.SX, at: float) -> ca.SX:
            u = u0 + (u1 - u0) * at / self.steps
            return plant.function(z * nominal, u, p)[0] / nominal

        after = rk4(slope, x, self.sample / self.steps, self.steps)
        return ca.Function("step", [x, u0, u1, p], [after])

    def _signals(self, w: Any) -> tuple[Any, Any, Any]:
        """Inputs (nu, .) at the begin and end of the intervals, and at the samples."""
        plant = self.plant
        places = [[v.name for v in plant.inputs].index(n) for n in self.inputs]
        lift = np.zeros((len(plant.inputs), len(places)))
        lift[places, range(len(places))] = self.half
        base = plant.vector("input")
        base[places] = self.mid
        u = ca.repmat(ca.DM(base), 1, len(self.basis)) + ca.DM(lift) @ (ca.DM(self.basis) @ w).T
        if self.held:
            return u, u, ca.horzcat(u, u[:, -1])
        return u[:, :-1], u[:, 1:], u

    def _along(self, expressions: Sequence[ca.SX]) -> ca.Function:
        """(w, off) -> expressions of the plant's variables at all samples, row by row; off : of the
        unknowns, parameters in the groups' scales, initial states in nominals.
        """
        plant, k, n = self.plant, len(self.groups), self.count
        w = ca.MX.sym("w", self.basis.shape[1], len(self.inputs))
        off = ca.MX.sym("off", self.unknowns)
        groups = RunUnknowns(tuple(map(Unknown.of_group, self.groups)))
        p = groups.vector(plant, ca.DM(groups.guess) + off[:k])
        begin = ca.MX(ca.DM(self.start / self._nominal))
        begin = begin if self.known_start else begin + off[k:]
        early, late, at = self._signals(w)
        later = self._step().mapaccum(n)(begin, early, late, ca.repmat(p, 1, n))
        x = ca.horzcat(begin, later) * ca.repmat(ca.DM(self._nominal), 1, n + 1)
        read = ca.Function("read", [plant.x, plant.u, plant.p], [ca.vertcat(*expressions)])
        return ca.Function("along", [ca.vec(w), off], [read.map(n + 1)(x, at, p)])

    @cached_property
    def information(self) -> ca.Function:
        """w (d nu) -> Fisher information (k, k) of the unknowns, in groups' scales and nominals."""
        w = ca.MX.sym("w", self.basis.shape[1] * len(self.inputs))
        off = ca.MX.sym("off", self.unknowns)
        seen = self._along([self.plant.expression(n) / size for n, size in self.noise.items()])
        rows = ca.Function("rows", [w, off], [ca.jacobian(ca.vec(seen(w, off)), off)])
        table = ca.densify(rows(w, np.zeros(self.unknowns)))
        faint = np.full(self.unknowns, FAINT)
        faint[: len(self.groups)] = 0.0
        return ca.Function("information", [w], [table.T @ table + ca.diag(ca.DM(faint))])

    def _values_along(self, expressions: Sequence[ca.SX]) -> ca.Function:
        """w -> expressions of the plant's variables at all samples, row by row."""
        w = ca.MX.sym("w", self.basis.shape[1] * len(self.inputs))
        found = self._along(expressions)(w, np.zeros(self.unknowns))
        return ca.Function("values", [w], [found])

    @cached_property
    def kept(self) -> ca.Function:
        """w -> watched variables at all samples, (value - middle)/(half range), row by row."""
        plant = self.plant
        return self._values_along(
            [
                (plant.expression(n) - low) / (high - low)
                if np.isfinite(high - low)
                else (plant.expression(n) - (low if np.isfinite(low) else high))
                / plant.variable(n).nominal
                for n, (low, high) in self.watched.items()
            ]
        )

    @cached_property
    def measured(self) -> ca.Function:
        """w -> measured variables (ny, K + 1) [their units]."""
        return self._values_along([self.plant.expression(n) for n in self.noise])

    def limits(self) -> tuple[Array, Array]:
        """Bounds of ``kept`` for one sample."""
        low, high = [], []
        for least, most in self.watched.values():
            both = np.isfinite(most - least)
            low.append(0.0 if np.isfinite(least) else -np.inf)
            high.append(1.0 if both else 0.0 if np.isfinite(most) else np.inf)
        return np.array(low), np.array(high)


def criterion_of(total: int, chosen: Sequence[int], weights: Sequence[float] | None) -> ca.Function:
    """Information (k, k) -> ln det C_ss = ln(det M_rr / det M), r all but s; or sum(weights
    variances).
    """
    m = ca.SX.sym("m", total, total)
    if weights is not None:
        root = ca.chol(m)  # m = root^T root
        inverse = ca.solve(root, ca.SX.eye(total))
        variances = ca.sum2(inverse**2)
        return ca.Function(
            "A", [m], [ca.log(sum(a * variances[i] for a, i in zip(weights, chosen, strict=True)))]
        )
    rest = [i for i in range(total) if i not in chosen]
    value = -2 * ca.sum1(ca.log(ca.diag(ca.chol(m))))
    if rest:
        value += 2 * ca.sum1(ca.log(ca.diag(ca.chol(m[rest, rest]))))
    return ca.Function("D", [m], [value])


Family: TypeAlias = Literal["steps", "ramps", "multisine"]
FAMILIES = ("steps", "ramps", "multisine")
RANDOM = 40
"""Random signals of the family: the best are where a search begins, all are what it is held
against.
"""


def span(e: Excitation) -> Array:
    """Rows of the basis that must stay within -1 .. 1: none where bounds of w see to it."""
    partition = bool(np.all(e.basis >= 0) and np.all(e.basis.sum(axis=1) <= 1 + 1e-12))
    return e.basis[:0] if partition else e.basis


def _basis(family: Family, count: int, segments: int) -> Array:
    """(count or count + 1, segments) shapes of the family over the samples, within -1 .. 1."""
    if family == "steps":
        place = np.arange(count) * segments // count
        return np.asarray((place[:, None] == np.arange(segments)).astype(float))
    share = np.arange(count + 1) / count
    if family == "ramps":
        nodes = np.linspace(0, 1, segments)
        return np.stack([np.interp(share, nodes, row) for row in np.eye(segments)], axis=1)
    columns = [np.ones(count + 1)]
    for i in range(1, segments):
        angle = 2 * np.pi * ((i + 1) // 2) * share
        columns.append(np.sin(angle) if i % 2 else np.cos(angle))
    return np.stack(columns, axis=1)


def random_signals(e: Excitation, seed: int) -> list[Array]:
    """Random signals of the family that fill the inputs' ranges to a random part."""
    random, rows = np.random.default_rng(seed), span(e)
    found = []
    for _ in range(RANDOM):
        w = random.uniform(-1, 1, (e.basis.shape[1], len(e.inputs)))
        if len(rows):
            w /= np.max(np.abs(rows @ w), axis=0)
        found.append((w * random.uniform(0.3, 1.0)).ravel(order="F"))
    return found


def excitation(
    plant: Plant,
    unknown: Sequence[ParameterGroup],
    sigma: Mapping[str, float],
    inputs: Any,
    duration: float,
    sample: float,
    family: Any,
    segments: int,
    limits: Mapping[str, tuple[float, float]] | None,
    start: Values | None,
    known_start: bool,
) -> Excitation:
    if family not in FAMILIES:
        raise InputError(f"family = {family!r}: choose one of {', '.join(FAMILIES)}")
    h = require_positive("sample", sample, "s")
    count = round(require_positive("duration", duration, "s") / h)
    require_count("segments", segments, 1, count)
    usual = {v.name: (v.min, v.max) for v in plant.inputs if not v.disturbance}
    ranges = ranges_of(plant, inputs, usual)
    low, high = np.array(list(ranges.values())).T
    return Excitation(
        plant=plant,
        groups=unknown,
        noise=sigma,
        sample=h,
        basis=_basis(family, count, segments),
        held=family == "steps",
        inputs=tuple(ranges),
        mid=(low + high) / 2,
        half=(high - low) / 2,
        start=plant.vector("state", start),
        known_start=known_start,
        watched=_watched(plant, limits or {}),
    )


def ranges_of(
    plant: Plant, inputs: Any, usual: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """{input: (low, high)} that may be played, of the user's ranges or names, within its bounds."""
    if inputs is None:
        inputs = usual
    if not isinstance(inputs, Mapping):
        inputs = {n: usual.get(plant.variable(n).name, (-np.inf, np.inf)) for n in inputs}
    found = {}
    for name, ends in inputs.items():
        variable = plant.variable(name)
        if variable.causality != "input":
            raise InputError(f"inputs: {variable.name} is {variable.kind}, not an input")
        low, high = require_ends(f"inputs[{name!r}]", ends, variable.unit)
        low, high = max(low, variable.min), min(high, variable.max)
        if not low < high or not np.isfinite(high - low):
            raise InputError(
                f"inputs: {variable.name} may run over {low:g} .. {high:g}; give a finite range "
                f"within its bounds, inputs={{{variable.name!r}: (low, high)}}"
            )
        found[variable.name] = (low, high)
    if not found:
        raise InputError("inputs is empty: there is no signal to design")
    return found


def _watched(
    plant: Plant, limits: Mapping[str, tuple[float, float]]
) -> dict[str, tuple[float, float]]:
    """Bounds of states and path constraints, narrowed by the user's limits."""
    own = {v.name: (v.min, v.max) for v in (*plant.states, *plant.constraints)}
    for name, ends in limits.items():
        variable = plant.variable(name)
        low, high = require_ends(f"limits[{name!r}]", ends, variable.unit)
        low, high = max(low, variable.min), min(high, variable.max)
        if not low < high:
            raise InputError(f"limits: {variable.name} would have to stay in {low:g} .. {high:g}")
        own[variable.name] = (low, high)
    return {n: ends for n, ends in own.items() if np.isfinite(ends).any()}


# ---- signals that go where records have not been -------------------------------------------------
LEVELS = 8
"""Places of its range to which each input goes, in a random order."""
LINES = 2
"""Sines in each octave whose amplitude is missing."""
SHRINKING = 5
"""Halvings in the search of the part of a signal that keeps the limits."""
KEPT = 1e-3
"""Part of a range by which a limit may be left, as in other designs."""
MARGIN = 1.1
"""Times the missing amplitude that is played: the plant is not quite as it is thought to be."""


@dataclass(frozen=True, eq=False)
class GapSignal:
    """A signal to play, and what its record would leave open.

    trajectory : the inputs and the motion that is expected. before, after : coverage of what is to
    be predicted, without and with this record. violation : how far limits are left, in parts of
    their range.

    Examples
    --------
    >>> asked = pam.fitting.coverage(dynamic_fit, {"muscle.command": 5e5}, duration=0.5)
    >>> gap = pam.experiments.design_signal(asked, duration=0.5, sample=0.02, tries=1)
    >>> gap.inputs, gap.violation
    (('muscle.command',), 0.0)
    """

    trajectory: Trajectory
    inputs: tuple[str, ...]
    before: Coverage = field(repr=False)
    after: Coverage = field(repr=False)
    violation: float

    def report(self) -> str:
        """What was open, and what would be, as text."""
        t = self.trajectory.t
        lines = [
            f"{t[-1] - t[0]:g} s of {', '.join(self.inputs)}",
            f"far from all records: {100 * self.before.far:.0f} % of the samples, "
            f"{100 * self.after.far:.0f} % with this one",
            f"octaves with amplitudes that are missing: {len(self.before.new_bands)}, "
            f"{len(self.after.new_bands)} with this one",
            "variables that leave what was measured: "
            f"{', '.join(r.name for r in self.before.left) or 'none'}; with this one: "
            f"{', '.join(r.name for r in self.after.left) or 'none'}",
        ]
        if self.violation > 1e-4:
            lines.append(f"limits are left by up to {100 * self.violation:.2g} % of their range")
        return "\n".join(lines)

    __str__ = report


def close_gap(
    gap: Coverage, duration: float, sample: float, inputs: Any, limits: Any, tries: int, seed: int
) -> GapSignal:
    """See :func:`design_signal`, which calls this for a :class:`Coverage`."""
    plant = gap.plant
    t = np.arange(0.0, require_positive("duration", duration, "s") + sample / 2, sample)
    reaches = {v.name: _reach_of(gap, v.name) for v in plant.inputs if not v.disturbance}
    usual = {
        n: (min(r.seen[0], r.asked[0]), max(r.seen[1], r.asked[1])) for n, r in reaches.items()
    }
    ranges = ranges_of(plant, inputs, usual)
    kept = {plant.variable(n).name: ends for n, ends in (limits or {}).items()}
    missing = {n: [b for b in gap.new_bands if b.name == n] for n in ranges}
    random = np.random.default_rng(seed)
    best: tuple[float, GapSignal] | None = None
    for _ in range(require_count("tries", tries)):
        check()
        drive = {
            n: _signal(t, ends, _reach_of(gap, n), missing[n], random) for n, ends in ranges.items()
        }
        held = {
            v.name: np.full(len(t), gap.seen[0][v.name][0])
            for v in plant.inputs
            if v.name not in drive and v.name in gap.seen[0]
        }
        motion = _within(gap, drive, held, t, kept)
        if motion is None:
            continue
        found = GapSignal(
            motion, tuple(drive), gap, gap.seeing(motion), _violation(motion, kept, plant)
        )
        open_ = found.after.far + len(found.after.new_bands) / max(len(gap.bands), 1)
        open_ += sum(min(r.beyond, 1.0) for r in found.after.left) / len(gap.reaches)
        merit = open_ + 10 * found.violation
        if best is None or merit < best[0]:
            best = (merit, found)
    if best is None:
        raise FitError(
            "the plant cannot be simulated under any signal of this kind; narrow the inputs' "
            "ranges with inputs={name: (low, high)}"
        )
    return best[1]


def _reach_of(gap: Coverage, name: str) -> Reach:
    return next(r for r in gap.reaches if r.name == name)


def _signal(
    t: Array,
    ends: tuple[float, float],
    reach: Reach,
    bands: Sequence[Band],
    random: np.random.Generator,
) -> Array:
    """Ramps between levels all over the range that is asked for, and sines where these miss."""
    low, high = max(ends[0], reach.asked[0]), min(ends[1], reach.asked[1])
    if not low < high:
        low, high = ends
    levels = low + (high - low) * random.permutation(np.linspace(0, 1, LEVELS))
    wave = np.zeros(len(t))
    for band in bands:
        for _ in range(LINES):
            f = band.low * (band.high / band.low) ** random.uniform()
            size = MARGIN * band.asked / np.sqrt(LINES)
            wave += size * np.sin(2 * np.pi * (f * t + random.uniform()))
    knots = np.linspace(t[0], t[-1], 2 * LEVELS)  # each level is held as long as it is gone to
    steady = np.interp(t, knots, np.repeat(levels, 2))
    return np.asarray(np.clip(steady + wave, *ends))


def _within(
    gap: Coverage,
    drive: Mapping[str, Array],
    held: Mapping[str, Array],
    t: Array,
    limits: Mapping[str, tuple[float, float]],
) -> Trajectory | None:
    """The motion under as much of a signal, about where the records begin, as keeps the limits;
    under all of it where none does. None where nothing can be simulated.
    """
    first = gap.seen[0]
    middle = {n: float(first[n][0]) if n in first else float(np.mean(u)) for n, u in drive.items()}

    def under(part: float) -> Trajectory | None:
        some = {n: middle[n] + part * (u - middle[n]) for n, u in drive.items()}
        return _motion(gap, {**some, **held}, t)

    best = whole = under(1.0)
    if whole is None or _violation(whole, limits, gap.plant) <= KEPT:
        return whole
    low, high = 0.0, 1.0
    for _ in range(SHRINKING):
        part = (low + high) / 2
        motion = under(part)
        if motion is None or _violation(motion, limits, gap.plant) > KEPT:
            high = part
        else:
            low, best = part, motion
    return best


def _motion(gap: Coverage, drive: Mapping[str, Any], t: Array) -> Trajectory | None:
    first = gap.seen[0]
    start = {v.name: float(first[v.name][0]) for v in gap.plant.states if v.name in first}
    try:
        return played(gap.plant, Trajectory(t, drive), start, 1e-5)
    except SimulationError:
        return None


def _violation(
    motion: Trajectory, limits: Mapping[str, tuple[float, float]], plant: Plant
) -> float:
    worst = 0.0
    for name, (low, high) in limits.items():
        size = high - low if np.isfinite(high - low) else plant.variable(name).nominal
        column = motion[name]
        worst = max(worst, float((low - column).max()) / size, float((column - high).max()) / size)
    return worst

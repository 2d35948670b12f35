"""Which signal to play next: inputs whose record will shrink the intervals of a plant's parameters.

The signal is a linear family (steps, ramps or a multisine) within the inputs' ranges, its
coefficients chosen by IPOPT with exact derivatives of the Fisher information, within limits on
states and outputs. The information is that at the present values (a locally optimal design).
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, overload

import casadi as ca
import numpy as np

from ...core.errors import (
    FitError,
    InputError,
    SimulationError,
    UnknownNameError,
    kind_of,
    require_positive,
)
from ...core.signals import Interpolation
from ...core.stop import verb
from ...core.trajectory import Trajectory
from ...muscles.law import ForceLaw
from ...numerics.solvers import nlpsol, quiet_ipopt
from ...plants.plant import Plant, Values, require_plant
from ..dynamic.coverage import Coverage
from ..dynamic.experiment import ParameterGroup, groups, played
from ..dynamic.plant_fit import PlantFit
from ..static.force_fit import ForceFit
from ..statistics import Array, require_choice, student_t
from .cells import CellDesign, chosen, design_cells
from .excitation import (
    RANDOM,
    Excitation,
    Family,
    GapSignal,
    close_gap,
    criterion_of,
    random_signals,
    span,
)
from .excitation import excitation as excitation_of

ACCURATE = 2e-3
"""Error of the integration, of the spread of each measured variable, that a design is content with.
"""
STEPS = (1, 2, 4, 8, 16, 32)
"""Steps of RK4 from sample to sample, tried in turn."""
ITERATIONS = 150
NORMAL = 10**9
"""Degrees of freedom of errors that are known."""


@dataclass(frozen=True, eq=False)
class SignalDesign:
    """A signal to play, and what its record promises.

    trajectory : the inputs, and the plant's motion under them as it is expected (an accurate
    simulation). stderr : standard errors of the free parameters after the record [their units];
    stderr_before : of the fit that was given, infinite without one; stderr_random : the median over
    random signals of the same family and ranges that keep the limits (all of them where none does).
    gain : ratio of the criterion's standard error (geometric mean over the chosen parameters, or
    root of their mean relative variance) of the best of those random signals to this one.

    Examples
    --------
    >>> design = pam.experiments.design_signal(dynamic_fit, duration=0.5, sample=0.02, tries=1)
    >>> design.parameters, 0.0 < design.stderr["mass"] < 1.0
    (('mass',), True)
    """

    trajectory: Trajectory
    inputs: tuple[str, ...]
    family: Family
    criterion: Literal["D", "A"]
    parameters: tuple[str, ...]
    values: Mapping[str, float]
    units: Mapping[str, str]
    stderr: Mapping[str, float]
    stderr_before: Mapping[str, float]
    stderr_random: Mapping[str, float]
    gain: float
    violation: float
    """Largest violation of the limits at the samples, of their range (1e-6 and less: none)."""
    seconds: float
    excitation: Excitation = field(repr=False)

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Interval that the parameter will have if it turns out as it is now."""
        if name not in self.stderr:
            raise UnknownNameError("free parameter", name, self.stderr)
        half = student_t(level, NORMAL) * self.stderr[name]
        return self.values[name] - half, self.values[name] + half

    def report(self) -> str:
        """The promised standard errors against those before and those of random signals,
        as text.
        """
        t = self.trajectory.t
        lines = [
            f"{self.family} of {', '.join(self.inputs)} over {t[-1] - t[0]:g} s, {t.size} samples; "
            f"{self.criterion}-optimal for {', '.join(self.parameters)}; {self.seconds:.1f} s",
            f"{self.gain:.2f} times as sharp as the best of {RANDOM} random ones",
            f"{'standard error of':<26}{'value':>12}{'before':>12}{'random':>12}{'designed':>12}",
        ]
        for name, error in self.stderr.items():
            unit = "" if self.units[name] == "1" else f" [{self.units[name]}]"
            lines.append(
                f"{name + unit:<26}{self.values[name]:>12.5g}{self.stderr_before[name]:>12.4g}"
                f"{self.stderr_random[name]:>12.4g}{error:>12.4g}"
            )
        if self.violation > 1e-4:
            lines.append(f"limits are left by up to {100 * self.violation:.2g} % of their range")
        return "\n".join(lines)

    __str__ = report


@overload
def design_signal(
    known: Coverage,
    *,
    duration: float,
    inputs: Mapping[str, tuple[float, float]] | Sequence[str] | None = None,
    sample: float = 0.01,
    limits: Mapping[str, tuple[float, float]] | None = None,
    tries: int = 3,
    seed: int = 0,
    time_limit: float | None = None,
) -> GapSignal: ...
@overload
def design_signal(
    known: Plant | PlantFit,
    free: Sequence[str | Sequence[str]] | None = None,
    *,
    duration: float,
    noise: Mapping[str, float] | None = None,
    inputs: Mapping[str, tuple[float, float]] | Sequence[str] | None = None,
    sample: float = 0.01,
    family: Family = "steps",
    segments: int = 20,
    criterion: Literal["D", "A"] = "D",
    parameters: Sequence[str] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    start: Values | None = None,
    known_start: bool = False,
    tries: int = 3,
    seed: int = 0,
    time_limit: float | None = None,
) -> SignalDesign: ...
@verb
def design_signal(
    known: Plant | PlantFit | Coverage,
    free: Sequence[str | Sequence[str]] | None = None,
    *,
    duration: float,
    noise: Mapping[str, float] | None = None,
    inputs: Mapping[str, tuple[float, float]] | Sequence[str] | None = None,
    sample: float = 0.01,
    family: Family = "steps",
    segments: int = 20,
    criterion: Literal["D", "A"] = "D",
    parameters: Sequence[str] | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    start: Values | None = None,
    known_start: bool = False,
    tries: int = 3,
    seed: int = 0,
    time_limit: float | None = None,
) -> SignalDesign | GapSignal:
    """Propose the inputs of a record that tells the chosen parameters best; or, for a
    :class:`Coverage`, one that goes where the records of a fit have not been.

    Parameters
    ----------
    known : a plant with parameter values near the true ones; or a PlantFit, whose covariance
        counts as what is known already. Of a Coverage: signals that visit the amplitudes,
        frequencies and places which are missing for what is to be predicted; of all other arguments
        ``duration``, ``sample``, ``inputs`` (by default as far as what is asked for, within their
        bounds), ``limits``, ``tries`` and ``seed`` count.
    free : parameters that will be fitted, as for :func:`fit_plant`; by default those of the fit.
    duration, sample : of the record [s].
    noise : {measured state or output: standard deviation of a sample}; by default the fit's.
    inputs : {input: (low, high)} that may be played, or names; by default all inputs that are no
        disturbances, within their own bounds.
    family : "steps" (levels held), "ramps" (joined by lines) or "multisine" (the first harmonics of
        1/duration, with free amplitudes and phases).
    segments : levels, or sine and cosine terms, for each input.
    criterion : "D", volume of the joint confidence region of ``parameters`` (by default all free);
        "A", their mean relative variance.
    limits : {variable or constraint: (low, high)} to keep at the samples, beside the bounds of the
        plant's states and its path constraints, which are always kept.
    start : initial states; by default the plant's. known_start : whether a later fit may take them
        as known.
    tries : how many of the best random signals are improved.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises InputError, UnknownNameError (arguments that cannot be), FitError (a plant that RK4
    cannot follow at these samples, a parameter that no signal tells).

    Examples
    --------
    >>> options = {"noise": {"x": 1e-5}, "segments": 4, "sample": 0.02, "tries": 1}
    >>> design = pam.experiments.design_signal(plant, ["mass"], duration=0.5, **options)
    >>> design.trajectory.duration
    0.5
    """
    began = time.perf_counter()
    if isinstance(known, Coverage):
        return close_gap(known, duration, sample, inputs, limits, max(tries, 1) * 3, seed)
    plant, information, sigma = _known(known, noise)
    unknown = groups(plant, _free(known, free))
    names = [g.name for g in unknown]
    require_choice("criterion", criterion, ("D", "A"))
    places = chosen(names, parameters, "parameter")
    excitation = excitation_of(
        plant,
        unknown,
        sigma,
        inputs,
        duration,
        sample,
        family,
        segments,
        limits,
        start,
        known_start,
    )
    random = random_signals(excitation, seed)
    excitation = _accurate(excitation, random[0])
    before, root = _before(information, unknown)
    aim = _Aim.of(excitation, criterion, places, root)
    judged = [aim.judge(w) for w in random]
    best = _improved(aim, random, judged, tries)
    kept = [j for j in judged if j.violation < 1e-3] or judged
    own = aim.judge(best)
    if not np.isfinite(own.value):
        raise FitError(
            f"no signal of this family tells {', '.join(names)} together; measure more, free fewer "
            "parameters, or widen the inputs' ranges"
        )
    errors = np.median([j.errors for j in kept], axis=0)
    share = 0.5 / (1 if criterion == "A" else len(places))
    return SignalDesign(
        trajectory=_played(excitation, best),
        inputs=excitation.inputs,
        family=family,
        criterion=criterion,
        parameters=tuple(names[i] for i in places),
        values={g.name: g.value for g in unknown},
        units={g.name: g.unit for g in unknown},
        stderr=dict(zip(names, own.errors.tolist(), strict=True)),
        stderr_before=before,
        stderr_random=dict(zip(names, errors.tolist(), strict=True)),
        gain=float(np.exp(share * (min(j.value for j in kept) - own.value))),
        violation=own.violation,
        seconds=time.perf_counter() - began,
        excitation=excitation,
    )


# ---- what is optimised ---------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Judged:
    value: float
    errors: Array
    violation: float


@dataclass(frozen=True, eq=False)
class _Aim:
    """The criterion of an excitation with what was known before (k, k), in the groups' scales."""

    excitation: Excitation
    value: ca.Function
    known: Array

    @classmethod
    def of(
        cls, excitation: Excitation, criterion: str, chosen: Sequence[int], known: Array
    ) -> _Aim:
        g, total = excitation.groups, excitation.unknowns
        weights = None
        if criterion == "A":
            relative = [g[i].scale / abs(g[i].value) if g[i].value else 1.0 for i in chosen]
            weights = [r**2 / len(chosen) for r in relative]
        before = np.zeros((total, total))
        before[: len(g), : len(g)] = known
        return cls(excitation, criterion_of(total, chosen, weights), before)

    def expression(self, w: Any) -> Any:
        return self.value(self.excitation.information(w) + ca.DM(self.known))

    def judge(self, w: Array) -> _Judged:
        """Criterion, standard errors of the parameters, and the largest violation of limits."""
        e = self.excitation
        information = np.asarray(e.information(w)) + self.known
        size = np.sqrt(np.maximum(np.diag(information), 1e-300))
        count = len(e.groups)
        scales = np.array([g.scale for g in e.groups])
        with np.errstate(all="ignore"):
            if not np.all(np.isfinite(information)):
                return _Judged(np.inf, np.full(count, np.inf), np.inf)
            values, vectors = np.linalg.eigh(information / np.outer(size, size))
            if values[0] <= 1e-12 * values[-1]:
                return _Judged(np.inf, np.full(count, np.inf), self.violation(w))
            covariance = vectors / values @ vectors.T / np.outer(size, size)
        errors = np.sqrt(np.diag(covariance))[:count] * scales
        return _Judged(float(self.value(information)), errors, self.violation(w))

    def violation(self, w: Array) -> float:
        e = self.excitation
        bounded = span(e) @ w.reshape(-1, len(e.inputs), order="F")
        worst = max(float(np.max(np.abs(bounded), initial=0.0)) - 1, 0.0)
        if e.watched:
            low, high = e.limits()
            kept = np.asarray(e.kept(w))
            worst = max(worst, float(np.max(np.maximum(low[:, None] - kept, kept - high[:, None]))))
        return worst if np.isfinite(worst) else float("inf")


def _improved(aim: _Aim, random: Sequence[Array], judged: Sequence[_Judged], tries: int) -> Array:
    """The best of the random signals followed by IPOPT, or the best of all."""
    e = aim.excitation
    order = sorted(
        range(len(random)), key=lambda i: judged[i].value + 20 * min(judged[i].violation, 1e3)
    )
    w = ca.MX.sym("w", random[0].size)
    rows = span(e)
    matrix = ca.reshape(w, e.basis.shape[1], len(e.inputs))
    one = np.ones(len(rows) * len(e.inputs))
    constraints, low, high = [ca.vec(ca.DM(rows) @ matrix)], [-one], [one]
    if e.watched:
        least, most = e.limits()
        constraints.append(ca.vec(e.kept(w)[:, 1:]))
        low.append(np.tile(least, e.count))
        high.append(np.tile(most, e.count))
    options = quiet_ipopt(
        tol=1e-5,
        acceptable_tol=1e-3,
        acceptable_iter=8,
        max_iter=ITERATIONS,
        mu_strategy="adaptive",
        hessian_approximation="limited-memory",
        honor_original_bounds="yes",
    )
    nlp: Any = {"x": w, "f": aim.expression(w), "g": ca.vertcat(*constraints)}
    solver = nlpsol("design", "ipopt", nlp, options)
    best, least_value = random[order[0]], judged[order[0]]
    for i in order[:tries]:
        answer = solver(
            x0=random[i], lbx=-1.0, ubx=1.0, lbg=np.concatenate(low), ubg=np.concatenate(high)
        )
        found = np.asarray(answer["x"]).ravel()
        own = aim.judge(found) if np.all(np.isfinite(found)) else None
        if own is not None and (own.violation > 1e-3, own.value) < (
            least_value.violation > 1e-3,
            least_value.value,
        ):
            best, least_value = found, own
    return best


# ---- the motion ----------------------------------------------------------------------------------
def _played(e: Excitation, w: Array) -> Trajectory:
    """The motion under a signal, by an accurate integration."""
    columns = e.mid + e.half * (e.basis @ w.reshape(-1, len(e.inputs), order="F"))
    if e.held:
        columns = np.concatenate([columns, columns[-1:]])
    between: Interpolation = "previous" if e.held else "linear"
    t = e.sample * np.arange(e.count + 1)
    drive = Trajectory(t, dict(zip(e.inputs, columns.T, strict=True)), interpolation=between)
    begin = dict(zip((v.name for v in e.plant.states), e.start.tolist(), strict=True))
    return played(e.plant, drive, begin, 1e-8)


def _accurate(e: Excitation, w: Array) -> Excitation:
    """With as many steps of RK4 between samples as the motion needs."""
    try:
        truth = _played(e, w).array(list(e.noise)).T
    except SimulationError as error:
        raise FitError(
            f"the plant cannot be simulated under a random signal of these ranges ({error}); "
            "narrow them, or start elsewhere with start=..."
        ) from None
    size = np.maximum(np.ptp(truth, axis=1), 1e-12)
    for steps in STEPS:
        finer = replace(e, steps=steps)
        gap = np.abs(np.asarray(finer.measured(w)) - truth)
        if np.all(gap <= ACCURATE * size[:, None]):
            return finer
    raise FitError(
        f"{STEPS[-1]} steps of RK4 in {e.sample:g} s do not follow {e.plant.name!r}: it is too "
        "stiff for these samples; give a shorter sample=..."
    )


# ---- arguments -----------------------------------------------------------------------------------
def _known(
    known: Any, noise: Mapping[str, float] | None
) -> tuple[Plant, PlantFit | None, dict[str, float]]:
    fit = known if isinstance(known, PlantFit) else None
    plant = known.plant if isinstance(known, PlantFit) else require_plant(known)
    if noise is None and fit is None:
        raise InputError("noise is missing: give {measured variable: standard deviation}")
    given = dict(fit.noise if noise is None and fit is not None else noise or {})
    names = {v.name for v in (*plant.states, *plant.outputs)}
    sigma = {}
    for name, value in given.items():
        own = plant.variable(name).name
        if own not in names:
            raise InputError(f"noise: {own} is neither a state nor an output of the plant")
        sigma[own] = require_positive(f"noise[{name!r}]", value, plant.variable(name).unit)
    if not sigma:
        raise InputError("noise is empty: name what will be measured")
    return plant, fit, sigma


def _free(known: Any, free: Sequence[str | Sequence[str]] | None) -> Sequence[str | Sequence[str]]:
    if free is not None:
        if isinstance(free, str) or not free:
            raise InputError(f"free = {free!r}: give a list of parameters")
        return free
    if not isinstance(known, PlantFit):
        raise InputError("free is missing: name the parameters that will be fitted")
    return [n.split(" = ") if " = " in n else n for n in known.descriptions]


def _before(
    fit: PlantFit | None, unknown: Sequence[ParameterGroup]
) -> tuple[dict[str, float], Array]:
    """Standard errors before, and their information (k, k) in the groups' scales."""
    errors = {g.name: float("inf") for g in unknown}
    information = np.zeros((len(unknown), len(unknown)))
    if fit is None:
        return errors, information
    order = list(fit.coefficients)
    both = [i for i, g in enumerate(unknown) if g.name in order]
    rows = [order.index(unknown[i].name) for i in both]
    scales = np.array([unknown[i].scale for i in both])
    errors |= {unknown[i].name: fit.coefficients[unknown[i].name].stderr for i in both}
    if both and fit.rank == len(fit.linearisation.names):
        covariance = fit.covariance[np.ix_(rows, rows)] / np.outer(scales, scales)
        information[np.ix_(both, both)] = np.linalg.inv(covariance)
    return errors, information


@overload
def design_experiment(known: ForceFit | ForceLaw, *args: Any, **options: Any) -> CellDesign: ...
@overload
def design_experiment(known: Plant | PlantFit, *args: Any, **options: Any) -> SignalDesign: ...
@overload
def design_experiment(known: Coverage, *args: Any, **options: Any) -> GapSignal: ...
@verb
def design_experiment(
    known: Any, *args: Any, **options: Any
) -> CellDesign | SignalDesign | GapSignal:
    """What to measure next so that intervals shrink most, within the bench's limits.

    For a ForceFit or a force law: pressures and lengths, see :func:`design_cells` for the
    arguments. For a PlantFit, a Plant or a Coverage: the pressure signal, see
    :func:`design_signal`.

    Raises InputError for anything else.

    Examples
    --------
    >>> design = pam.experiments.design_experiment(fit, 4)  # of a plant: a signal to play
    >>> type(design).__name__
    'CellDesign'
    """
    if isinstance(known, (ForceFit, ForceLaw)):
        return design_cells(known, *args, **options)
    if isinstance(known, (Plant, PlantFit, Coverage)):
        return design_signal(known, *args, **options)
    raise InputError(
        f"known is {kind_of(known)}; give a ForceFit, a force law, a Plant or a PlantFit"
    )

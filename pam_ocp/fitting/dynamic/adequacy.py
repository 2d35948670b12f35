"""Whether a fitted plant is adequate to its records: what its residuals tell, and of what.

Under an adequate model residuals are white, as large as the noise that the records show by
themselves, and orthogonal to whatever the plant may lack. Three kinds of tests, at a common level
(Bonferroni): a portmanteau test (G. Ljung, G. Box, Biometrika 65 (1978) 297-303); lack of fit
against the noise found in high differences of the records (J. Rice, Annals of Statistics 12 (1984)
1215-1230), which knows of no model; and score tests, one of each possible cause (see
:mod:`.suspects`). Where any of them rejects, causes are tested once more, on residuals whitened as
autoregressive noise: what is significant even so is no coloured noise, and the single suspect that
takes up most of them names the cause. Where there are no motions at their least squares to ask for
causes, the first two kinds judge the fit's own residuals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..static.correlation import neighbours
from ..statistics import Array, even, f_test, inverse
from .evidence import Evidence, Motion, projected, solved
from .suspects import CAUSES, Suspect, sensor_suspects

LEVEL = 0.01
"""Probability that an adequate model is called inadequate."""
ORDERS = (2, 3, 4, 5)
"""Of the differences in which noise is looked for."""
MEDIAN = 0.6744897501960817
"""Of the absolute value of a standard normal variable."""
EFFICIENCY = 2.72
"""Variance of a noise found by a median, in that of one found by squares."""
NEGLIGIBLE = 1e-6
"""Of a suspect's column, that is left when the fitted values are projected out."""
FEWEST = 10
"""Degrees of freedom of the residuals below which nothing is said."""
DEEPEST = 12
"""Order of the autoregressive noise, at most."""
EXACT = 5.0
"""Residuals below so many errors of the integration are not looked at: records without noise."""
RESOLVED = 1e-5
"""The same, in parts of a variable's range: less is what a simulation or a file rounds."""


@dataclass(frozen=True)
class AdequacyTest:
    """A test of the residuals; it rejects below ``level``, its share of the common level.

    Examples
    --------
    >>> test = pam.fitting.AdequacyTest("whiteness", 60.0, (30, 0), 9e-4, level=1.25e-3)
    >>> test.rejects
    True
    """

    name: str
    statistic: float
    dof: tuple[int, int]
    probability: float
    level: float

    @property
    def rejects(self) -> bool:
        """Whether an adequate model would hardly leave such residuals."""
        return self.probability < self.level


@dataclass(frozen=True)
class Adequacy:
    """What the residuals of a dynamic fit tell about its model.

    cause : "" for an adequate model, else the likeliest of "drift", "friction or hysteresis",
    "scale", "lag", "floor", "law", "coloured noise", "unknown", "not told" (there are no motions to
    tell it from). subject : what it concerns; amount [unit] : as much of it describes the
    residuals. explained : part of the excess over white noise that it takes up. tests : all that
    were made. noise : of each measured variable as its record shows it without a model; rms : of
    the residuals [its unit]. correlation : of neighbouring residuals. shifts : by how much fitted
    values would change with the cause in the model. stderr : standard errors, with autocorrelated
    residuals and these shifts counted, and how far from the values the least squares of whole
    motions lie. dof : degrees of freedom, of as many independent residuals as tell as much.

    Examples
    --------
    >>> dynamic_fit.adequacy.adequate, dynamic_fit.adequacy.sentence
    (True, '')
    """

    cause: str = ""
    subject: str = ""
    amount: float = 0.0
    unit: str = "1"
    explained: float = 0.0
    tests: tuple[AdequacyTest, ...] = ()
    noise: Mapping[str, float] = field(default_factory=dict)
    rms: Mapping[str, float] = field(default_factory=dict)
    correlation: Mapping[str, float] = field(default_factory=dict)
    shifts: Mapping[str, float] = field(default_factory=dict)
    stderr: Mapping[str, float] = field(default_factory=dict)
    dof: int = 0
    untested: str = ""
    """Why nothing was tested, where that is a reason to doubt the fit."""

    @property
    def adequate(self) -> bool:
        """Whether no test rejects the model."""
        return not self.cause

    @property
    def excess(self) -> float:
        """Residuals over the noise that the records show, of the variable where it is largest."""
        return max((self.rms[n] / max(s, 1e-300) for n, s in self.noise.items()), default=1.0)

    @property
    def sentence(self) -> str:
        """What is likely to be missing, or that nothing was tested, in one sentence; empty for an
        adequate model.
        """
        if self.untested:
            return f"whether the model is adequate was not tested: {self.untested}"
        return "" if self.adequate else _sentence(self)

    def report(self) -> str:
        """The verdict and its tests, as text."""
        rows = [
            f"    {t.name}: {t.statistic:.3g} ({t.dof[0]}, {t.dof[1]} degrees of freedom), "
            f"probability {t.probability:.2g}{' *' if t.rejects else ''}"
            for t in self.tests
        ]
        head = self.sentence or (
            "the residuals show no sign of an inadequate model"
            if self.tests
            else "the residuals were not tested: they are as small as the integration's error, "
            "too few, or those of a smoothed motion"
        )
        return "\n".join([f"    {head}", *rows])

    __str__ = report


UNTESTED = Adequacy()
"""Of records without noise, or too short for it."""
LOST = Adequacy(untested="the plant cannot be followed through the records")


def _sentence(a: Adequacy) -> str:
    size = f"{100 * a.amount:+.2g} %" if a.unit == "1" else f"{a.amount:+.2g} {a.unit}"
    likely = {
        "drift": f"{a.subject} drifts (by some {size} along the records)",
        "friction or hysteresis": "friction or hysteresis that the model does not have acts on "
        f"{a.subject} (some {size}, against the direction of motion)",
        "scale": f"the {'scale' if a.unit == '1' else 'zero'} of {a.subject} is off "
        f"(by some {size})",
        "lag": f"{a.subject} acts later or earlier than in the model (a lag or dead time)",
        "floor": f"the sensor of {a.subject} does not show values at an end of its range (a floor, "
        "slack or saturation)",
        "law": f"a force on {a.subject} depends on position or speed in another way than in the "
        "model (force law, load, damping)",
        "coloured noise": f"the noise of {a.subject} is coloured (neighbouring residuals have a "
        f"correlation of {max(a.correlation.values(), default=0.0):.2f})",
        "unknown": "something that looks like none of drift, friction, scale, lag, coloured noise",
        "not told": "what is missing cannot be told, because motions through the records cannot be "
        "followed, or are nearer to them than the fit is",
    }[a.cause]
    worst = max(a.noise, key=lambda n: a.rms[n] / max(a.noise[n], 1e-300))
    found = (
        f"the model is inadequate to these records (residuals of {worst} are {a.excess:.2g} times "
        f"its noise): {'' if a.cause == 'not told' else 'probably '}{likely}"
    )
    moved = {
        n: s / e for n, s in a.shifts.items() if (e := a.stderr.get(n, 0.0)) and abs(s) > 0.5 * e
    }
    if moved:
        most = max(moved, key=lambda n: abs(moved[n]))
        found += f"; with it {most} would change by {a.shifts[most]:+.2g}"
    return found + "; intervals are widened accordingly"


# ---- noise --------------------------------------------------------------------------------------
def record_noise(series: Sequence[Array]) -> tuple[float, float]:
    """Standard deviation of white noise on a smooth signal; relative standard error of its square.
    By the median of absolute differences, which jumps do not move; the least over the orders.
    """
    found, count = [], 0
    for order in ORDERS:
        weights = np.array([1.0])
        for _ in range(order):
            weights = np.convolve(weights, [1.0, -1.0])
        size = np.sqrt(np.sum(weights**2))
        parts = [np.convolve(s, weights, "valid") / size for s in series if len(s) > 2 * order]
        if not parts:
            break
        every = np.concatenate(parts)
        scale = float(np.median(np.abs(every))) / MEDIAN
        own = np.correlate(weights, weights, "full") / size**2
        # quantised: most differences are zero
        root = float(np.sqrt(np.mean(every**2)))
        error = float(EFFICIENCY * 2 * np.sum(own**2) / every.size)
        found.append((scale if scale > 0 else root, error))
        count = every.size
    if not count:
        return 0.0, float("inf")
    sigma, error = min(found)
    return sigma, float(np.sqrt(error))


@dataclass(frozen=True, eq=False)
class Noise:
    """Autoregressive noise: e_t = sum a_j e_(t-j) + innovation, of this variance."""

    coefficients: Array
    innovation: float

    @property
    def order(self) -> int:
        return int(self.coefficients.size)

    def whitened(self, x: Array) -> Array:
        """Along the first axis, without the first ``order`` values; in standard deviations."""
        p = self.order
        found = x[p:].copy()
        for j, a in enumerate(self.coefficients, 1):
            found -= a * x[p - j : len(x) - j]
        return np.asarray(found / np.sqrt(max(self.innovation, 1e-300)))

    def meat(self, x: Array) -> Array:
        """x^T R x with the noise's covariance R, by what all innovations make of x."""
        from scipy.signal import lfilter

        if not self.order:
            return np.asarray(self.innovation * (x.T @ x))
        before = min(20 * len(x), 2000)
        reverse = np.concatenate([x[::-1], np.zeros((before, x.shape[1]))])
        made = lfilter([1.0], [1.0, *(-self.coefficients)], reverse, axis=0)
        return np.asarray(self.innovation * (made.T @ made))

    @property
    def effective(self) -> float:
        """Part of the samples that would tell as much of a mean if they were independent."""
        if not self.order:
            return 1.0
        variance = float(self.meat(np.ones((1, 1)))[0, 0])
        long = self.innovation / max(1 - float(self.coefficients.sum()), 1e-3) ** 2
        return float(min(max(variance / long, 1e-3), 1.0))


def noise_of(series: Sequence[Array], most: int = DEEPEST, lost: float = 0.0) -> Noise:
    """Of residuals (series about zero) less ``lost`` degrees of freedom, by Schwarz' criterion."""
    n = sum(len(s) for s in series)
    deepest = max(0, min(most, n // 20, min(len(s) for s in series) // 4))
    covariance = np.array(
        [sum(float(s[k:] @ s[: len(s) - k]) for s in series) for k in range(deepest + 1)]
    ) / max(n - lost, 1.0)
    a, variance = np.empty(0), covariance[0]
    best = (n * np.log(max(variance, 1e-300)), a, variance)
    for p in range(1, deepest + 1):
        if not variance > 1e-12 * covariance[0]:
            break
        k = (covariance[p] - a @ covariance[p - 1 : 0 : -1] if p > 1 else covariance[1]) / variance
        a = np.concatenate([a - k * a[::-1], [k]])
        variance *= 1 - k**2
        criterion = n * np.log(max(variance, 1e-300)) + p * np.log(n)
        if criterion < best[0]:
            best = (criterion, a, variance)
    return Noise(best[1], float(best[2]))


# ---- tests --------------------------------------------------------------------------------------
def adequacy_of(
    evidence: Evidence | None, weights: Array, stderr: Mapping[str, float] | None = None
) -> Adequacy:
    """weights : (ny,) with which the fit counted its residuals. stderr : of its values, where these
    are not those of the least squares of the motions. Without tests where there is no evidence, or
    the residuals are those of the integration or of rounding: records without noise.
    """
    if evidence is None:
        return LOST
    rms = evidence.rms
    if np.any(rms <= np.maximum(EXACT * evidence.integration, _resolved(evidence.measured))):
        return UNTESTED
    case = _Case(evidence, 1 / rms, _columns(evidence))
    base = case.regressed(())
    if base.dof < FEWEST:
        return UNTESTED
    case = replace(case, weights=1 / base.sigma)
    base = case.regressed(())
    tests, noise = _tests(case, base)
    rejected = any(t.rejects for t in tests)
    cause = _likeliest(case, base) if rejected else ("", base)
    return _verdict(case, base, cause, tests, noise, weights, stderr)


def residual_adequacy(
    names: Sequence[str],
    residuals: Sequence[Array],
    measured: Sequence[Array],
    lost: int,
    stderr: Mapping[str, float],
    apart: Mapping[str, float] | None = None,
) -> Adequacy:
    """By the residuals of a fit alone, (K, ny) in each record. lost : degrees of freedom that the
    fit took. stderr : of its values; apart : how far from them the least squares lie, as far as
    that is known.
    """
    every, shares = np.concatenate(residuals), lost / len(names)
    dof = every.size - lost
    if dof < FEWEST:
        return UNTESTED
    sigma = np.sqrt(np.sum(every**2, axis=0) / (len(every) - shares))
    if np.any(sigma <= _resolved(measured)):
        return UNTESTED
    series = [[r[:, j] for r in residuals] for j in range(len(names))]
    test, noise = _noise_test(measured, names, sigma, dof, LEVEL / 2)
    tests = (_whiteness(series, LEVEL / 2), test)
    effective = [noise_of(r, lost=shares).effective for r in series]
    wide, far = 1 / np.sqrt(min(effective)), apart or {}
    return Adequacy(
        "not told" if any(t.rejects for t in tests) else "",
        tests=tests,
        noise=noise,
        rms=dict(zip(names, sigma.tolist(), strict=True)),
        correlation={n: neighbours(r) for n, r in zip(names, series, strict=True)},
        stderr={n: float(np.hypot(e * wide, far.get(n, 0.0))) for n, e in stderr.items()},
        dof=max(int(sum(effective) * len(every) - lost), 2),
    )


def _resolved(measured: Sequence[Array]) -> Array:
    """Of each variable, what no sensor resolves."""
    return np.asarray(RESOLVED * np.ptp(np.concatenate(measured), axis=0))


@dataclass(frozen=True, eq=False)
class _Regressed:
    """Residuals of motions by least squares in starts, values and some suspects. squares : their
    sum, whitened if they were; columns : independent ones of values and suspects.
    """

    values: Array
    residuals: list[Array]
    squares: float
    dof: int
    columns: int
    sigma: Array

    @property
    def series(self) -> list[list[Array]]:
        """Of each variable, its residuals in each motion."""
        return [[r[:, j] for r in self.residuals] for j in range(len(self.sigma))]


@dataclass(frozen=True, eq=False)
class _Case:
    evidence: Evidence
    weights: Array
    columns: tuple[tuple[Suspect, Sequence[Array]], ...]
    """Suspects with their slopes (K, ny) in each motion."""

    def of(self, cause: str) -> tuple[int, ...]:
        return tuple(i for i, (s, _) in enumerate(self.columns) if s.cause == cause)

    def stacked(self, number: int, chosen: Sequence[int]) -> Array:
        """Slopes (K, ny, k + chosen) of a motion."""
        m = self.evidence.motions[number]
        more = [self.columns[i][1][number] for i in chosen]
        return np.concatenate([m.values, *(c[..., None] for c in more)], axis=2)

    def regressed(self, chosen: Sequence[int], noises: Sequence[Noise] | None = None) -> _Regressed:
        """Generalised least squares where ``noises`` of the measured variables are given."""
        motions = [
            _whitened(m, self.stacked(i, chosen), self.weights, noises)
            for i, m in enumerate(self.evidence.motions)
        ]
        error, columns = projected(motions, np.ones(1))
        found = solved(columns, error)
        left = error - columns @ found
        rank = int(np.linalg.matrix_rank(even(columns)[0], tol=1e-6)) if columns.size else 0
        starts = sum(
            int(np.linalg.matrix_rank(even(m.start.reshape(-1, m.start.shape[2]))[0], tol=1e-6))
            for m in motions
        )
        dof = error.size - rank - starts
        residuals = []
        for i, m in enumerate(self.evidence.motions):
            e = m.error - self.stacked(i, chosen) @ found
            w = self.weights[:, None]
            begun = solved((m.start * w).reshape(e.size, -1), (e * self.weights).ravel())
            residuals.append(e - m.start @ begun)
        every = np.concatenate(residuals)
        sigma = np.sqrt(np.sum(every**2, axis=0) / max(len(every) * dof / error.size, 1.0))
        return _Regressed(found, residuals, float(left @ left), dof, rank, np.asarray(sigma))

    def criterion(self, cause: str, more: int) -> float:
        """Schwarz' criterion of the model with all suspects of a cause at their least squares."""
        n = sum(len(m.error) for m in self.evidence.motions)
        squares = self.evidence.squares_with(cause)
        return float(n * np.sum(np.log(np.maximum(squares, 1e-300))) + more * np.log(n))

    def noises(self, fit: _Regressed) -> list[Noise]:
        lost = fit.columns / len(self.weights)
        weighed = zip(fit.series, self.weights, strict=True)
        return [noise_of([r * w for r in own], lost=lost) for own, w in weighed]


def _whitened(m: Motion, columns: Array, weights: Array, noises: Sequence[Noise] | None) -> Motion:
    """Weighed, filtered, all variables behind each other as one."""

    def flat(x: Array) -> Array:
        y = x * weights[:, None] if x.ndim == 3 else x * weights
        parts = [
            y[:, i] if noises is None else noises[i].whitened(y[:, i]) for i in range(y.shape[1])
        ]
        return np.concatenate(parts)

    def wide(x: Array) -> Array:
        return flat(x)[:, None, :]

    return Motion(flat(m.error)[:, None], wide(m.start), wide(columns), wide(m.start[..., :0]))


def _columns(evidence: Evidence) -> tuple[tuple[Suspect, list[Array]], ...]:
    """Suspects of the plant, and those of sensors, with their slopes in each motion."""
    found = [
        (s, [m.suspects[..., i] for m in evidence.motions]) for i, s in enumerate(evidence.suspects)
    ]
    modelled = [m.error + y for m, y in zip(evidence.motions, evidence.measured, strict=True)]
    named = zip(evidence.outputs, evidence.units, strict=True)
    return (*found, *sensor_suspects(tuple(named), modelled, evidence.measured))


def _tests(case: _Case, base: _Regressed) -> tuple[tuple[AdequacyTest, ...], dict[str, float]]:
    causes = [c for c in CAUSES if case.of(c)]
    level = LEVEL / (2 + len(causes))
    e = case.evidence
    test, noise = _noise_test(e.measured, e.outputs, base.sigma, base.dof, level)
    tests = [_whiteness(base.series, level), test]
    for cause in causes:
        found = _scored(base, case.regressed(case.of(cause)))
        if found is not None:
            tests.append(AdequacyTest(cause, *found, level))
    return tuple(tests), noise


def _scored(base: _Regressed, wider: _Regressed) -> tuple[float, tuple[int, int], float] | None:
    """(F, its degrees of freedom, probability) of more suspects; None where that tells nothing."""
    more = wider.columns - base.columns
    if more < 1 or wider.dof < FEWEST:
        return None
    f, chance = f_test(base.squares - wider.squares, more, wider.squares, wider.dof)
    return f, (more, wider.dof), chance


def _noise_test(
    measured: Sequence[Array], names: Sequence[str], sigma: Array, dof: int, level: float
) -> tuple[AdequacyTest, dict[str, float]]:
    """Whether residuals of these sizes are larger than the noise that the records show; and it."""
    from scipy.special import ndtr

    noise, most = {}, 0.0
    for j, name in enumerate(names):
        own, error = record_noise([y[:, j] for y in measured])
        noise[name] = min(own, float(sigma[j])) or float(sigma[j])
        scatter = np.sqrt(error**2 + 2 / dof)
        ratio = float(sigma[j] / max(own, 1e-300))
        most = max(most, (min(ratio, 1e6) ** 2 - 1) / scatter if np.isfinite(scatter) else 0.0)
    chance = 1 - (1 - float(ndtr(-most))) ** len(noise) if most < 8 else 0.0
    return AdequacyTest("noise of the records", most, (dof, 0), chance, level), noise


def _whiteness(variables: Sequence[Sequence[Array]], level: float) -> AdequacyTest:
    """The portmanteau of Ljung and Box, over all variables with their series of residuals."""
    from scipy.special import chdtrc

    total, lags = 0.0, 0
    for series in variables:
        n = sum(len(s) for s in series)
        most = max(1, min(int(10 * np.log10(n)), min(len(s) for s in series) // 3))
        zero = sum(float(s @ s) for s in series)
        for k in range(1, most + 1):
            pairs = sum(len(s) - k for s in series)
            r = sum(float(s[k:] @ s[:-k]) for s in series) / zero
            total += n * (n + 2) * r**2 / max(pairs, 1)
        lags += most
    return AdequacyTest("whiteness", total, (lags, 0), float(chdtrc(lags, total)), level)


# ---- causes -------------------------------------------------------------------------------------
def _likeliest(case: _Case, base: _Regressed) -> tuple[str, _Regressed]:
    """That which takes up most, if any is more than autoregressive noise may seem to be: by score
    tests of residuals whitened as such, or because it leaves white ones, which a cause as slow as
    an offset may do that looks like noise itself. Of all by the least squares with each: where much
    is missing slopes do not reach so far, as values have moved to make up for it.
    """
    noises = case.noises(base)
    white = case.regressed((), noises)
    causes = [c for c in CAUSES if case.of(c)]
    more, told = {}, False
    for cause in causes:
        found = _scored(white, case.regressed(case.of(cause), noises))
        if found is not None:
            level = LEVEL / len(causes)
            told |= found[2] < level or _whitens(base, case.regressed(case.of(cause)), level)
            more[cause] = found[1][0]
    if not told:
        name = "coloured noise" if any(n.order for n in noises) else "unknown"
        return name, base
    name = min(more, key=lambda c: case.criterion(c, more[c]))
    return name, case.regressed(case.of(name))


def _whitens(base: _Regressed, wider: _Regressed, level: float) -> bool:
    """Whether more suspects are significant in white noise, and leave nothing but such."""
    found = _scored(base, wider)
    significant = found is not None and found[2] < level
    return significant and not _whiteness(wider.series, LEVEL).rejects


# ---- verdict ------------------------------------------------------------------------------------
def _verdict(
    case: _Case,
    base: _Regressed,
    cause: tuple[str, _Regressed],
    tests: tuple[AdequacyTest, ...],
    noise: dict[str, float],
    weights: Array,
    given: Mapping[str, float] | None,
) -> Adequacy:
    e = case.evidence
    (name, fit), k = cause, len(e.names)
    rms = dict(zip(e.outputs, base.sigma.tolist(), strict=True))
    follows = {n: neighbours(own) for n, own in zip(e.outputs, base.series, strict=True)}
    shifts = (base.values[:k] - fit.values[:k]) * e.scale
    # the noise that the values were found in: with all that the model leaves out
    noises = case.noises(base)

    def errors(weights: Array) -> Array:
        return np.sqrt(np.maximum(np.diag(_covariance(case, noises, weights)), 0.0)) * e.scale

    own = errors(weights) if given is None else np.array([given[n] for n in e.names])
    # runs from measured starts are biased by the noise of these: what they say lies apart from the
    # least squares of whole motions by more than chance, and the mean square of how far it lies,
    # with the variance of those, is its mean squared error
    least = own if given is not None and name else errors(case.weights)
    apart = np.hypot(least, e.shifts * e.scale)
    stderr = np.hypot(np.maximum(own, apart), shifts)
    subject, amount, unit = _subject(case, name, case.noises(fit))
    part = 1 - fit.squares / max(base.squares, 1e-300)
    effective = sum(x.effective for x in noises) * sum(map(len, base.residuals))
    return Adequacy(
        name,
        subject,
        amount,
        unit,
        part,
        tests,
        noise,
        rms,
        follows,
        dict(zip(e.names, shifts.tolist(), strict=True)),
        dict(zip(e.names, stderr.tolist(), strict=True)),
        max(int(effective - k), 2),
    )


def _covariance(case: _Case, noises: Sequence[Noise], weights: Array) -> Array:
    """Of values found by least squares with these weights, (J^T J)^-1 J^T R J (J^T J)^-1."""
    projections, k = [], len(case.evidence.names)
    if not k:
        return np.empty((0, 0))
    for m in case.evidence.motions:
        _, columns = projected([m], weights)
        projections.append(columns.reshape(*m.error.shape, k))
    every, size = even(np.concatenate([p.reshape(-1, k) for p in projections]))
    usual = inverse(every.T @ every)
    meat = np.zeros((k, k))
    for p in projections:
        for j, noise in enumerate(noises):
            meat += noise.meat(p[:, j] * weights[j] / case.weights[j] / size)
    return np.asarray(usual @ meat @ usual / np.outer(size, size))


def _subject(case: _Case, cause: str, noises: Sequence[Noise]) -> tuple[str, float, str]:
    """Of the suspects of a cause, the one that takes up most by itself, and how much of it."""
    if cause == "coloured noise":
        order = [n.effective for n in noises]
        return case.evidence.outputs[int(np.argmin(order))], 0.0, "1"
    if not case.of(cause):
        return "", 0.0, "1"
    alone = [(case.regressed((i,), noises), i) for i in case.of(cause)]
    fit, i = min(alone, key=lambda a: a[0].squares)
    suspect = case.columns[i][0]
    return suspect.subject, float(-fit.values[-1]) * suspect.size, suspect.unit

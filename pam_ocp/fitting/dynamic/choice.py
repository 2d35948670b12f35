"""Choice among structures by nested cross-validation over records: nothing is chosen by what judges
it.

M. Stone, J. R. Stat. Soc. B 36 (1974) 111-147; why the choice itself must be inside of the loop: G.
Cawley, N. Talbot, J. Mach. Learn. Res. 11 (2010) 2079-2107. Each fold of records is once the test.
Among the others structures are fitted without one more fold and judged by that one; the chosen is
fitted to all that are not the test. A fit without folds i and j serves as inner fit of test i
(judged by j) and of test j (judged by i), so K folds take K (K - 1)/2 + K fits of each structure,
not K^2.
"""

from __future__ import annotations

import itertools
import secrets
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.cases import ending
from ...core.errors import (
    FitError,
    InputError,
    PamError,
    UnknownNameError,
    kind_of,
    require_count,
    require_instance,
    with_kinds,
)
from ...core.executors import Client, Place
from ...core.stop import limited
from ...core.trajectory import Trajectory
from ..statistics import Array, require_level, student_t


def mean_loss(losses: Array) -> Array:
    """By criterion (m,) of losses (n, m), over the parts that can be judged by it (no NaN)."""
    seen = ~np.isnan(losses)
    total = np.where(seen, losses, 0.0).sum(axis=0)
    return np.asarray(np.where(seen.any(axis=0), total / np.maximum(seen.sum(axis=0), 1), np.nan))


def paired(differences: Array, level: float) -> tuple[float, float, float]:
    """(mean, its standard error, half width of its interval) of differences part by part: what
    makes a part hard for both models drops out. The parts count as independent.
    """
    n = len(differences)
    mean = float(differences.mean())
    if n < 2:
        return mean, float("inf"), float("inf")
    error = float(differences.std(ddof=1)) / float(np.sqrt(n))
    return mean, error, student_t(level, n - 1) * error


def rmse_ratios(losses: Array, reference: Array, level: float = 0.95) -> Array:
    """(ratio, low, high) of RMSEs by criterion (m, 3), of losses of the same records (n, m). The
    interval of a ratio of means (W. Cochran, Sampling Techniques, 1977, ch. 6) on the scale of its
    logarithm: it holds both ways round. NaN where fewer than two records allow a criterion.
    """
    found = np.full((losses.shape[1], 3), np.nan)
    for k, (own, other) in enumerate(zip(losses.T, reference.T, strict=True)):
        both = np.isfinite(own) & np.isfinite(other)
        if both.sum() < 2 or not (own[both].any() and other[both].any()):
            continue
        ratio = own[both].mean() / other[both].mean()
        _, _, half = paired(own[both] - ratio * other[both], level)
        wide = np.exp(0.5 * half / own[both].mean())
        found[k] = np.sqrt(ratio) * np.array([1.0, 1.0 / wide, wide])
    return found


Rule: TypeAlias = Literal["simplest", "best"]


@runtime_checkable
class Structure(Protocol):
    """What can be chosen: a model's form, with the way in which its parameters are found.

    With a process pool it travels by pickle: a dataclass of a module, no lambda. One with a true
    attribute ``alone`` starts threads, which forked processes lack: it is fitted here, after the
    others, unless there is an executor of the caller's own.

    Examples
    --------
    >>> isinstance(orders["order 1"], pam.fitting.Structure)
    True
    """

    @property
    def complexity(self) -> float:
        """What a user pays for it: by habit the number of free parameters."""
        ...

    def fit(self, records: Sequence[Trajectory], /) -> Any:
        """The fitted model; PamError where these records allow none."""
        ...

    def losses(self, model: Any, records: Sequence[Trajectory], /) -> ArrayLike:
        """Mean squared error of each record (n,), or of each by several criteria, such as horizons
        or outputs (n, m); NaN where a record is too short to be judged.
        """
        ...


@dataclass(frozen=True, eq=False)
class Tried:
    """What came of one structure in the (outer) cross-validation over all records.

    loss : mean over the records, by criterion (m,). score : mean of the criteria, each in parts of
    the best structure's. behind : mean lead of the best, in its score, and ``error``, its standard
    error, from differences record by record. chosen : in how many inner loops it was taken.

    Examples
    --------
    >>> [tried.name for tried in choice.tried]  # the simplest first
    ['order 1', 'order 2']
    """

    name: str
    complexity: float
    loss: Array
    score: float
    behind: float
    error: float
    chosen: int
    seconds: float
    """Processor time of its fit to one training set, on average."""
    failures: tuple[str, ...] = ()
    losses: Array = field(default_factory=lambda: np.empty((0, 0)), repr=False)
    """Of every record, by a fit without its fold (n, m)."""


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen structure, and what its choice is worth.

    name, model : chosen by cross-validation over all records, and fitted to all of them (None with
    ``refit=False``). tried : every structure, the simplest first. nested : loss of *choosing* (n,
    m): each record is judged by what was chosen and fitted without its fold; its mean is the honest
    figure, ``tried[...].loss`` of the winner is too good. chosen : the name in each fold. folds :
    the fold of each record. seed : that made them.

    Examples
    --------
    >>> choice.name in orders, choice.nested.shape
    (True, (3, 1))
    """

    name: str
    model: Any = field(repr=False)
    tried: tuple[Tried, ...] = field(repr=False)
    nested: Array = field(repr=False)
    chosen: tuple[str, ...]
    folds: NDArray[np.intp] = field(repr=False)
    seed: int
    criteria: tuple[str, ...]
    rule: Rule
    seconds: float

    def __getitem__(self, name: str) -> Tried:
        return next(t for t in self.tried if t.name == name)

    @property
    def rmse(self) -> dict[str, float]:
        """Root of the nested loss by criterion: what to expect of the choice on new records."""
        return dict(zip(self.criteria, np.sqrt(mean_loss(self.nested)).tolist(), strict=True))

    def table(self) -> str:
        """What was tried, as text: the RMSE of each structure by criterion, its price, its fate."""
        width = max(12, *(len(t.name) + 2 for t in self.tried))
        wide = max(11, *(len(c) + 2 for c in self.criteria))
        head = "".join(f"{c:>{wide}}" for c in self.criteria)
        lines = [
            f"{len(self.folds)} records in {int(self.folds.max()) + 1} folds (seed {self.seed}), "
            f"nested cross-validation, {self.seconds:.1f} s",
            f"  {'structure':<{width}}{'size':>6}{head}{'behind the best':>22}{'chosen':>8}"
            f"{'fit [s]':>9}",
        ]
        for t in self.tried:
            row = "".join(f"{x:>{wide}.4g}" for x in np.sqrt(t.loss))
            behind = "failed" if not np.isfinite(t.score) else f"{t.behind:.3f} ± {t.error:.3f}"
            lines.append(
                f"{'>' if t.name == self.name else ' '} {t.name:<{width}}{t.complexity:>6g}{row}"
                f"{behind:>22}{t.chosen:>8}{t.seconds:>9.2f}"
            )
            lines += [f"      failed: {text}" for text in sorted(set(t.failures))]
        row = "".join(f"{x:>{wide}.4g}" for x in self.rmse.values())
        lines.append(
            f"  {'the choice':<{width}}{'':>6}{row}   (nested: what new records will show)"
        )
        lines += [f"  warning: {text}" for text in getattr(self.model, "warnings", ())]
        return "\n".join(lines)

    __str__ = table

    def against(self, reference: str, level: float = 0.95) -> Ratios:
        """RMSE of each structure in parts of that of one of them, with intervals at ``level``."""
        if reference not in [t.name for t in self.tried]:
            raise UnknownNameError("structure", reference, [t.name for t in self.tried])
        given = {t.name: t.losses for t in self.tried} | {NESTED: self.nested}
        found = {n: rmse_ratios(x, self[reference].losses, level) for n, x in given.items()}
        return Ratios(reference, level, self.criteria, found)


@dataclass(frozen=True, eq=False)
class Ratios:
    """RMSE in parts of that of a reference structure, on the same records.

    by_name : {structure: (m, 3)}, by criterion the ratio and its interval's ends; the last, "the
    choice", is what choosing is worth (nested). Below one throughout: significantly better. The
    records count as independent.

    Examples
    --------
    >>> choice.against("order 1")["order 1"]
    array([[1., 1., 1.]])
    """

    reference: str
    level: float
    criteria: tuple[str, ...]
    by_name: Mapping[str, Array] = field(repr=False)

    def __getitem__(self, name: str) -> Array:
        return self.by_name[name]

    def table(self) -> str:
        """One row for each structure."""
        width = max(12, *(len(n) + 2 for n in self.by_name))
        wide = max(20, *(len(c) + 2 for c in self.criteria))
        lines = [
            f"RMSE / RMSE of {self.reference}, {100 * self.level:g} % intervals",
            f"  {'structure':<{width}}" + "".join(f"{c:>{wide}}" for c in self.criteria),
        ]
        for name, rows in self.by_name.items():
            lines.append(f"  {name:<{width}}" + "".join(f"{as_ratio(r):>{wide}}" for r in rows))
        return "\n".join(lines)

    __str__ = table


NESTED = "the choice"


def as_ratio(row: Array) -> str:
    """``0.82 (0.79, 0.85)``."""
    ratio, low, high = row
    return f"{ratio:.2f} ({low:.2f}, {high:.2f})" if np.isfinite(ratio) else "-"


RULES = ("simplest", "best")


@with_kinds
def choose(
    structures: Mapping[str, Structure],
    records: Sequence[Trajectory],
    *,
    folds: int = 5,
    groups: Sequence[Hashable] | None = None,
    rule: Rule = "simplest",
    level: float = 0.95,
    criteria: Sequence[str] = (),
    seed: int | None = None,
    executor: Place = None,
    refit: bool = True,
    progress: Callable[[int, int], None] | None = None,
    time_limit: float | None = None,
) -> Choice:
    """Choose a structure by nested cross-validation over records (episodes).

    Parameters
    ----------
    structures : {name: :class:`Structure`}, such as :class:`FreeRunStructure`,
        :class:`PlantStructure`, :class:`ArxStructure` or :class:`GruStructure`.
    records : one Trajectory each; whole records are left out, never parts of them.
    folds : of records, at least 3: one is the test, one judges the fits to the others.
    groups : a label for each record; those of one label (cut from one run, one muscle, one day)
        stay in one fold, as those that are the same must.
    rule : "simplest", the least complexity that is not significantly behind the best (at
        ``level``, from paired differences over the records), or "best".
    criteria : names of the columns that ``losses`` gives.
    seed : of the folds; drawn where none is given, and told by the result.
    executor : where, as for :func:`pam_ocp.each`. Take processes: in threads CasADi's objects take
        turns.
    refit : whether the chosen one is fitted to all records in the end.
    progress : called as progress(done, all) after each fit.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Raises InputError (arguments that cannot be), FitError (no structure fits every fold).

    Examples
    --------
    >>> pam.fitting.choose(orders, episodes, folds=3, seed=1).name in orders
    True
    """
    began = time.perf_counter()
    given = _structures(structures)
    chosen_records = [require_instance("records", r, Trajectory, _RECORDS) for r in records]
    if rule not in RULES:
        raise InputError(f"rule = {rule!r}: choose one of {', '.join(RULES)}")
    require_level(level)
    drawn = secrets.randbelow(2**31) if seed is None else seed
    fold = _folds(chosen_records, folds, groups, drawn)
    count = int(fold.max()) + 1
    with limited(time_limit):
        found = _fits(given, chosen_records, fold, executor, progress)
        names = _criteria(criteria, found)
        outer = {n: _gathered(found, n, fold, [(k,) for k in range(count)]) for n in given}
        prices = {n: float(s.complexity) for n, s in given.items()}
        winner, ranked = _pick(prices, outer, rule, level)
        per_fold, nested = [], np.full((len(fold), len(names)), np.nan)
        for k in range(count):
            taken = winner
            if len(given) > 1:
                others = [(i, k) for i in range(count) if i != k]
                inner = {n: _gathered(found, n, fold, others)[fold != k] for n in given}
                taken, _ = _pick(prices, inner, rule, level)
            per_fold.append(taken)
            nested[fold == k] = outer[taken][fold == k]
        model = given[winner].fit(chosen_records) if refit else None
    tried = [
        Tried(
            n,
            prices[n],
            mean_loss(outer[n]),
            *ranked[n],
            per_fold.count(n),
            float(np.mean([f.seconds for f in found[n].values()])),
            tuple(f.failure for f in found[n].values() if f.failure),
            outer[n],
        )
        for n in sorted(given, key=lambda n: prices[n])
    ]
    return Choice(
        winner,
        model,
        tuple(tried),
        nested,
        tuple(per_fold),
        fold,
        drawn,
        names,
        rule,
        time.perf_counter() - began,
    )


_RECORDS = "give Trajectories, one for each episode (see read_records)"


# ---- arguments ----------------------------------------------------------------------------------
def _structures(given: Any) -> dict[str, Structure]:
    if not isinstance(given, Mapping) or not given:
        raise InputError("structures: give {name: structure}, at least one")
    for name, structure in given.items():
        if not isinstance(structure, Structure):
            raise InputError(
                f"structures[{name!r}] is {kind_of(structure)}: it needs fit(records), "
                "losses(model, records) and complexity"
            )
    return dict(given)


def _folds(
    records: Sequence[Trajectory], folds: int, groups: Sequence[Hashable] | None, seed: int
) -> NDArray[np.intp]:
    """The fold of each record: whole groups, at random, the largest first into the emptiest."""
    count = len(records)
    labels = list(range(count)) if groups is None else list(groups)
    if len(labels) != count:
        raise InputError(f"groups has {len(labels)} labels for {count} records")
    members: dict[Hashable, list[int]] = {}
    known: dict[Hashable, int] = {}
    for place, (label, r) in enumerate(zip(labels, records, strict=True)):
        members.setdefault(label, []).append(place)
        content = r.t.tobytes(), *((n, r[n].tobytes()) for n in r.names)
        before = known.setdefault(content, place)
        if labels[before] != label:
            raise InputError(
                f"records[{place}] is records[{before}] once more: a fit to the one would be "
                "judged by the other; leave it out, or give both one label in groups=[...]"
            )
    require_count("folds", folds, 3)
    if len(members) < folds:
        raise InputError(
            f"{len(members)} independent records make no {folds} folds; record more, or "
            "folds=3 at the least"
        )
    random = np.random.default_rng(seed)
    order = [list(members.values())[i] for i in random.permutation(len(members))]
    fold, filled = np.zeros(count, dtype=np.intp), np.zeros(folds)
    for places in sorted(order, key=len, reverse=True):
        target = int(np.argmin(filled))
        fold[places] = target
        filled[target] += len(places)
    return fold


def _criteria(given: Sequence[str], found: Mapping[str, Mapping[Any, _Fitted]]) -> tuple[str, ...]:
    widths = {
        f.losses[k].shape[1] for fits in found.values() for f in fits.values() for k in f.losses
    }
    if len(widths) != 1:
        raise FitError(
            "no structure could be fitted"
            if not widths
            else f"structures give {sorted(widths)} criteria; all must be judged by the same"
        )
    (width,) = widths
    names = tuple(given) or (
        ("RMSE",) if width == 1 else tuple(f"RMSE {i + 1}" for i in range(width))
    )
    if len(names) != width:
        raise InputError(f"criteria names {len(names)}, the structures give {width}")
    return names


# ---- fits ---------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Fitted:
    """Of one structure to one training set: losses of the records of each fold left out."""

    losses: Mapping[int, Array]
    seconds: float
    failure: str = ""


def _losses(structure: Structure, model: Any, records: Sequence[Trajectory]) -> Array:
    found = np.asarray(structure.losses(model, records), dtype=float)
    if found.ndim == 1:
        found = found[:, None]
    if found.ndim != 2 or len(found) != len(records):
        raise InputError(
            f"losses of {type(structure).__name__} have shape {found.shape} for {len(records)} "
            "records; give one row for each"
        )
    return found


def _fits(
    structures: Mapping[str, Structure],
    records: Sequence[Trajectory],
    fold: NDArray[np.intp],
    executor: Place,
    progress: Callable[[int, int], None] | None,
) -> dict[str, dict[tuple[int, ...], _Fitted]]:
    """Every structure without every fold, and without every pair of folds (sorted)."""
    count = int(fold.max()) + 1
    left_out: list[tuple[int, ...]] = [(k,) for k in range(count)]
    if len(structures) > 1:  # of one alone there is nothing to choose
        left_out += itertools.combinations(range(count), 2)
    # long fits first: the last worker is not left alone with one
    tasks = [(n, out) for n in structures for out in left_out]
    tasks.sort(key=lambda task: -structures[task[0]].complexity)

    work = partial(_without, structures, records, fold)
    found: dict[str, dict[tuple[int, ...], _Fitted]] = {n: {} for n in structures}
    place = executor if isinstance(executor, Executor | Client) else 0
    shared = [t for t in tasks if not getattr(structures[t[0]], "alone", False)]
    alone = [t for t in tasks if getattr(structures[t[0]], "alone", False)]
    fits = (
        (group[i], fitted)
        for group, where in ((shared, executor), (alone, place))
        if group
        for i, fitted in ending(work, group, executor=where, chunk=1, what="fits")
    )
    for done, (task, fitted) in enumerate(fits, start=1):
        if isinstance(fitted, Exception):
            raise fitted
        name, out = task
        found[name][out] = fitted
        if progress is not None:
            progress(done, len(tasks))
    return found


def _without(
    structures: Mapping[str, Structure],
    records: Sequence[Trajectory],
    fold: NDArray[np.intp],
    task: tuple[str, tuple[int, ...]],
) -> _Fitted:
    """Of a structure's name and the folds left out, here or in another process."""
    name, out = task
    placed = list(zip(records, fold, strict=True))
    training = [r for r, k in placed if k not in out]
    structure, began = structures[name], time.process_time()
    try:
        model = structure.fit(training)
        seconds = time.process_time() - began
        losses = {i: _losses(structure, model, [r for r, k in placed if k == i]) for i in out}
    except PamError as error:
        return _Fitted({}, time.process_time() - began, f"{type(error).__name__}: {error}")
    return _Fitted(losses, seconds)


def _gathered(
    found: Mapping[str, Mapping[tuple[int, ...], _Fitted]],
    name: str,
    fold: NDArray[np.intp],
    left_out: Sequence[tuple[int, ...]],
) -> Array:
    """Losses (n, m) of all records, each by the fit without the folds ``(judged, ...)``; infinite
    where that failed.
    """
    fits = found[name]
    width = max((x.shape[1] for f in fits.values() for x in f.losses.values()), default=1)
    rows = np.full((len(fold), width), np.inf)
    for out in left_out:
        fitted = fits[tuple(sorted(out))]
        if not fitted.failure:
            rows[fold == out[0]] = fitted.losses[out[0]]
    return rows


# ---- the choice ---------------------------------------------------------------------------------
def _pick(
    prices: Mapping[str, float], losses: Mapping[str, Array], rule: Rule, level: float
) -> tuple[str, dict[str, tuple[float, float, float]]]:
    """The name that the rule takes, and (score, behind the best, its standard error) of each. The
    score is the mean over the criteria, each in parts of the least mean loss by it.
    """
    means = {n: mean_loss(x) for n, x in losses.items()}
    usable = [n for n, m in means.items() if np.all(np.isfinite(m))]
    if not usable:
        raise FitError("no structure could be fitted to every fold and judged by every criterion")
    least = np.maximum(np.min([means[n] for n in usable], axis=0), 1e-300)
    scores = {n: float(np.mean(means[n] / least)) if n in usable else np.inf for n in losses}
    best = min(usable, key=lambda n: (scores[n], prices[n]))
    found, close = {}, []
    for n, x in losses.items():
        if n not in usable:
            found[n] = (np.inf, np.inf, np.nan)
            continue
        gaps = (x - losses[best]) / least
        # a record that only short horizons can judge counts with those
        shares = gaps / np.maximum((~np.isnan(gaps)).sum(axis=0), 1)
        rows = np.nansum(shares, axis=1) / len(least)
        # one-sided: only those that are behind have something to prove
        behind, error, half = paired(len(rows) * rows, 2 * level - 1)
        found[n] = (scores[n], behind, error)
        if behind <= half or n == best:
            close.append(n)
    winner = best if rule == "best" else min(close, key=lambda n: (prices[n], scores[n]))
    return winner, found

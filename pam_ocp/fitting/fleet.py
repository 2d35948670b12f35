"""Fleets: many records of many muscles, fitted hierarchically.

Of a kind (a make and diameter) muscles are alike but not the same, and so are records of one
muscle, which is mounted and calibrated anew each time: coefficients z of record r of muscle m are

    z_r = mean of the kind + b_m + w_r,    b_m ~ N(0, B),    w_r ~ N(0, W).

The nonlinear mixed model is solved by the alternation of M. Lindstrom and D. Bates (Biometrics 46
(1990) 673-687): the law is linearised at each record's own coefficients, and the linear model
(:mod:`pam_ocp.fitting.mixed_effects`) tells them anew. Its beginning is the least squares of all
records of each muscle. Noise of a record is its own, drawn towards what all have in common.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.cases import results_of
from ..core.errors import (
    FitError,
    InputError,
    UnknownNameError,
    broadcast,
    require_instance,
    require_numbers,
)
from ..core.executors import Place
from ..core.shown import shown
from ..core.stop import verb
from ..core.units import significant
from ..muscles.law import ForceLaw
from .estimates import Estimates, Tabled
from .mixed_effects import Scatter, between, effects, marginal, shrunken_variances, summed
from .static.optimum import sensitivity
from .static.static import cell_weights, fit_force, held_coefficients, law_class
from .statistics import Array, Coefficient, Prediction, elementwise, inverse, student_t
from .tables.force_table import joined_tables
from .tables.record_catalogue import Catalogue, Record, require_catalogue

Key: TypeAlias = "tuple[str, str]"
"""Kind and muscle."""
PASSES = 12
STILL = 0.01
"""Standard errors that muscles move in the last pass."""


@shown
@dataclass(frozen=True, eq=False, repr=False)
class FleetMuscle(Tabled):
    """A muscle of a fleet: what its records say, drawn towards its kind as far as they leave open.

    coefficients : values with standard errors. alone : what its own records say (NaN what they do
    not). law : with these coefficients; None for fits that were made already. records : how many.

    Examples
    --------
    >>> low, high = fleet.of("no. 1").intervals()["a2"]
    >>> bool(low < fleet.of("no. 1").coefficients["a2"].value < high)
    True
    """

    name: str
    kind: str
    records: int
    coefficients: dict[str, Coefficient]
    covariance: Array = field(repr=False)
    alone: dict[str, float] = field(repr=False)
    law: ForceLaw | None
    dof: int

    def _half(self, c: Coefficient, level: float) -> float:
        return student_t(level, self.dof) * c.stderr

    def __str__(self) -> str:
        values = ", ".join(f"{n} {significant(c.value)}" for n, c in self.coefficients.items())
        return f"{self.name} ({self.kind or 'one kind'}), {self.records} records: {values}"


@shown
@dataclass(frozen=True, eq=False, repr=False)
class Population(Tabled):
    """What muscles of a kind have in common, and by how much they and their records differ.

    coefficients : of the mean muscle. between, within : scatter of muscles, and of the records of
    one muscle. law : of the mean muscle; None for fits made already. shared : coefficients that all
    muscles of the kind have.

    Examples
    --------
    >>> kind = fleet.population()
    >>> kind.muscles, kind.shared
    (3, ('a3',))
    >>> spread, low, high = kind.spread()["a2"]
    >>> bool(low < spread < high)
    True
    """

    kind: str
    muscles: int
    coefficients: dict[str, Coefficient]
    covariance: Array = field(repr=False)
    between: Scatter = field(repr=False)
    within: Scatter = field(repr=False)
    law: ForceLaw | None
    shared: tuple[str, ...]
    noise: float

    def _half(self, c: Coefficient, level: float) -> float:
        """Of the mean of the kind."""
        return self.between.reach(level) * c.stderr

    def spread(self, level: float = 0.95) -> dict[str, tuple[float, float, float]]:
        """Standard deviation between muscles, and its interval; a low end of 0: they may be one."""
        return self._spread(self.between, level)

    def record_spread(self, level: float = 0.95) -> dict[str, tuple[float, float, float]]:
        """Standard deviation between records of one muscle, beyond noise, and its interval."""
        return self._spread(self.within, level)

    def _spread(self, scatter: Scatter, level: float) -> dict[str, tuple[float, float, float]]:
        rows = np.array(scatter.spreads(level)).T.tolist()
        return {n: (r[0], r[1], r[2]) for n, r in zip(self.coefficients, rows, strict=True)}

    def new_muscle(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Intervals that hold the coefficients of another muscle of the kind."""
        size = np.sqrt(np.diag(self.between.covariance + self.covariance))
        half = self.between.reach(level) * size
        rows = zip(self.coefficients.items(), half.tolist(), strict=True)
        return {n: (c.value - h, c.value + h) for (n, c), h in rows}

    def predict(
        self, p: ArrayLike | str, kappa: ArrayLike | str, level: float = 0.95
    ) -> Prediction:
        """Force [N] at gauge pressure p [Pa] and contraction kappa; arrays broadcast.

        ``confidence`` holds the mean muscle, ``prediction`` another muscle of the kind.
        """
        if self.law is None:
            raise InputError(
                "predict needs a force law: give fit_fleet records, not fits that were made already"
            )
        p, kappa = require_numbers("p", p, "Pa"), require_numbers("kappa", kappa, "1")
        both = broadcast(p=p, kappa=kappa)
        force, slopes = sensitivity(self.law, list(self.coefficients), *map(np.ravel, both))
        t, shape = self.between.reach(level), both[0].shape
        errors = [
            np.sqrt(np.einsum("ni,ij,nj->n", slopes, c, slopes)).reshape(shape)
            for c in (self.covariance, self.covariance + self.between.covariance)
        ]
        force = force.reshape(shape)
        mean, other = ((force - t * e, force + t * e) for e in errors)
        nowhere = np.zeros(shape, dtype=bool)
        return Prediction.of_law(force, errors[0], mean, other, level, nowhere)

    def __str__(self) -> str:
        values = ", ".join(f"{n} {significant(c.value)}" for n, c in self.coefficients.items())
        return f"{self.kind or 'one kind'}, mean of {self.muscles} muscles: {values}"


@shown
@dataclass(frozen=True, eq=False, repr=False)
class FleetFit:
    """A fleet fitted: populations by kind, muscles by name.

    failed : {muscle: why it could not be fitted}. passes : of the alternation; seconds : in all.

    Examples
    --------
    >>> fleet
    <FleetFit 6 records of 3 muscles of 1 kind>
    >>> print(fleet.report().splitlines()[0])
    [[Fleet]] 6 records of 3 muscles of 1 kind
    """

    kinds: dict[str, Population]
    muscles: dict[Key, FleetMuscle]
    failed: dict[str, str]
    passes: int
    seconds: float

    def population(self, kind: str | None = None) -> Population:
        """Of a kind; of the only one where none is named."""
        if kind is None and len(self.kinds) == 1:
            return next(iter(self.kinds.values()))
        if kind not in self.kinds:
            raise UnknownNameError("kind of the fleet", str(kind), self.kinds)
        return self.kinds[kind]

    def of(self, muscle: str, kind: str | None = None) -> FleetMuscle:
        """A muscle; with its kind, where two have one of that name."""
        found = [m for m in self.muscles.values() if m.name == muscle and kind in (None, m.kind)]
        if len(found) > 1:
            raise InputError(f"muscle {muscle!r} is of several kinds; give kind={found[0].kind!r}")
        if not found:
            raise UnknownNameError("muscle of the fleet", muscle, [m.name for m in self])
        return found[0]

    def __iter__(self) -> Any:
        return iter(self.muscles.values())

    def table(self) -> list[dict[str, Any]]:
        """A row for each muscle: coefficients with standard errors and intervals (95 %); SI."""
        return [{"kind": m.kind, "muscle": m.name, "records": m.records, **m._row()} for m in self]

    def report(self, level: float = 0.95) -> str:
        """Of each kind: what muscles share, and by how much they and their records differ."""
        lines = [f"[[Fleet]] {self}"]
        for kind in self.kinds.values():
            lines += [
                f"[[{kind.kind or 'One kind'}]] {kind.muscles} muscles, noise {kind.noise:.3g}"
                f"; mean, {100 * level:g} % interval; spread of muscles; of records; SI"
            ]
            ends, muscles, records = kind.intervals(level), kind.spread(level), kind.record_spread()
            for n, c in kind.coefficients.items():
                low, high = (significant(e) for e in ends[n])
                size, least, most = (significant(s, 3) for s in muscles[n])
                apart = f"{size} ({least} .. {most})" if n not in kind.shared else "shared"
                same = "; no sign that muscles differ" if muscles[n][1] == 0 < muscles[n][0] else ""
                lines.append(
                    f"    {n}: {significant(c.value)}, {low} .. {high}; {apart}; "
                    f"{significant(records[n][0], 3)}{same}"
                )
            if kind.between.diagonal:
                lines.append("    too few muscles to tell correlations between coefficients")
        lines += ["[[Not used]]"] * bool(self.failed)
        return "\n".join([*lines, *(f"    {n}: {why}" for n, why in self.failed.items())])

    def __str__(self) -> str:
        records, n, k = sum(m.records for m in self), len(self.muscles), len(self.kinds)
        return f"{records} records of {n} muscles of {k} kind{'s' * (k != 1)}"


@verb
def fit_fleet(
    records: Catalogue | Iterable[Record] | Mapping[str, Sequence[Estimates]],
    law: str | type[ForceLaw] = "six-parameter",
    *,
    shared: Sequence[str] = (),
    fixed: Mapping[str, float] | None = None,
    kinds: Mapping[str, str] | None = None,
    executor: Place = None,
) -> FleetFit:
    """Fit many records of many muscles hierarchically: what a kind shares, what each has its own.

    Parameters
    ----------
    records : a :class:`Catalogue`, records, or force fits that were made already, {muscle: fits},
        which count by values and covariance.
    law : as for :func:`fit_force`.
    shared : coefficients that muscles of a kind and their records have in common exactly.
    fixed : coefficients to hold [SI].
    kinds : {muscle: kind}, for fits that were made already; records have theirs.
    executor : where muscles are fitted, as for :func:`pam_ocp.each`.

    A record may hold fewer cells than the law has coefficients. A muscle whose records cannot be
    fitted even together is left to its kind. Intervals are for normal scatter.

    Raises InputError, UnknownNameError for arguments that cannot be, FitError where no muscle of a
    kind can be fitted.

    Examples
    --------
    >>> pam.fitting.fit_fleet(records, shared=["a3"]).population().muscles
    3
    """
    began, passes = time.perf_counter(), 1
    failed: dict[str, str] = {}
    if isinstance(records, Mapping):
        found = _of_fits(records, kinds or {}, shared)
    else:
        cells, failed = _measured(require_catalogue(records), law, dict(fixed or {}), executor)
        found, passes = _alternated(cells, _own(shared, cells.names))
    return _result(found, failed, passes, time.perf_counter() - began)


# ---- what was measured ---------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Muscle:
    """Taut cells of a muscle's records behind each other, which begin at ``starts``."""

    key: Key
    p: Array
    kappa: Array
    force: Array
    weights: Array
    starts: NDArray[np.intp]
    held: dict[str, float]
    begin: Array | None
    problem: str

    def informed(
        self, kind: type[ForceLaw], free: Sequence[int], z: Array
    ) -> tuple[Array, Array, Array]:
        """J^T J, J^T r (of records, at their coefficients z (records, all)), and r^T r."""
        counts = np.diff([*self.starts, len(self.p)])
        columns = np.repeat(z, counts, axis=0).T
        values = elementwise(kind, 1)(self.p, self.kappa, *columns)
        r = self.weights * (self.force - values[0])
        j = np.stack([np.broadcast_to(values[1 + i], r.shape) for i in free], axis=1)
        j = j * self.weights[:, None]
        products = (j[:, :, None] * j[:, None, :], j * r[:, None], r**2)
        normal, slope, square = (np.add.reduceat(a, self.starts, axis=0) for a in products)
        return normal, slope, square


@dataclass(frozen=True, eq=False)
class _Cells:
    """All muscles of a law, with the coefficients that are sought."""

    law: type[ForceLaw]
    free: tuple[int, ...]
    muscles: list[_Muscle]

    @property
    def names(self) -> list[str]:
        return [self.law.coefficient_variables()[i].name for i in self.free]


def _measured(
    catalogue: Catalogue, law: Any, fixed: dict[str, float], executor: Place
) -> tuple[_Cells, dict[str, str]]:
    """The cells of each muscle, and where its coefficients begin."""
    kind = law_class(law)
    groups: dict[Key, list[Record]] = {}
    for record in catalogue:
        groups.setdefault((record.kind, record.muscle), []).append(record)
    work = partial(_muscle, kind, fixed)
    found = results_of(work, groups.items(), executor=executor, count=len(groups), what="muscles")
    held = found[0].held
    free = tuple(i for i, v in enumerate(kind.coefficient_variables()) if v.name not in held)
    empty = {m.key[1]: "none of its cells is taut" for m in found if not len(m.p)}
    used = [m for m in found if len(m.p)]
    begun: list[_Muscle] = []
    for one in used:
        if one.begin is None:
            others = [m.begin for m in used if m.key[0] == one.key[0] and m.begin is not None]
            if not others:
                raise FitError(f"no muscle of kind {one.key[0]!r} can be fitted: {one.problem}")
            one = replace(one, begin=np.median(others, axis=0))
        begun.append(one)
    if not begun:
        raise FitError("no cell of any record is taut")
    return _Cells(kind, free, begun), empty


def _muscle(kind: type[ForceLaw], fixed: dict[str, float], part: tuple[Key, Any]) -> _Muscle:
    """The taut cells of a muscle, and least squares of all of them together."""
    key, records = part
    tables = [t for t in (r.table.taut for r in records) if len(t)]
    held = held_coefficients(kind, fixed, records[0].table)
    begin, problem = None, ""
    try:
        every = joined_tables(tables) if tables else records[0].table
        begin = fit_force(every, kind, fixed=fixed, weights="equal", errors="independent").vector
    except (InputError, FitError) as error:
        problem = str(error)
    p, kappa, force = (
        np.concatenate([getattr(t, n) for t in tables]) if tables else np.zeros(0)
        for n in ("pressure", "contraction", "force")
    )
    weights = np.concatenate([cell_weights(None, t) for t in tables]) if tables else np.zeros(0)
    starts = np.cumsum([0, *(len(t) for t in tables)])[:-1]
    return _Muscle(key, p, kappa, force, weights, starts, held, begin, problem)


# ---- the alternation -----------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Solved:
    """The linear model of a kind: values and errors of its muscles (n, k), (n, k, k), what they say
    alone (n, k), and values of each record (records, k).
    """

    within: Scatter
    between: Scatter
    values: Array
    errors: Array
    own: Array
    recorded: Array


@dataclass(frozen=True, eq=False)
class _Kind:
    """A kind: its muscles (n) with the number of their records, and what was found of them."""

    name: str
    muscles: list[str]
    records: list[int]
    names: list[str]
    units: list[str]
    solved: _Solved
    noise: float
    dof: int
    """Of the noise, for where the scatter of records says none."""
    laws: list[tuple[type[ForceLaw], dict[str, float]]] = field(default_factory=list)


def _alternated(cells: _Cells, own: NDArray[np.bool_]) -> tuple[list[_Kind], int]:
    """Kind after kind, until muscles stand still."""
    found, most = [], 0
    units = {v.name: v.unit for v in cells.law.coefficient_variables()}
    for name in dict.fromkeys(m.key[0] for m in cells.muscles):
        muscles = [m for m in cells.muscles if m.key[0] == name]
        records = np.array([len(m.starts) for m in muscles])
        place = np.repeat(np.arange(len(muscles)), records)
        counts = np.concatenate([np.diff([*m.starts, len(m.p)]) for m in muscles])
        z = np.repeat([m.begin for m in muscles], records, axis=0)
        free, last = list(cells.free), None
        for step in range(1, PASSES + 1):
            parts = [m.informed(cells.law, free, z[place == i]) for i, m in enumerate(muscles)]
            normal, slope, square = (np.concatenate(p) for p in zip(*parts, strict=True))
            if not all(np.isfinite(a).all() for a in (normal, slope)):
                raise FitError(f"the fit of kind {name!r} left where its law is finite")
            variance, dof = _noise(normal, slope, square, counts)
            a = normal / variance[:, None, None]
            x = slope / variance[:, None] + (a @ z[:, free][:, :, None])[:, :, 0]
            one = _solved(a, x, place, own, last)
            new = z.copy()
            new[:, free] = one.recorded
            size = np.sqrt(np.maximum(np.diagonal(one.errors, axis1=1, axis2=2), 1e-300))
            still = last is not None and np.max(np.abs(one.values - last.values) / size) < STILL
            z, last, most = new, one, max(most, step)
            if still:
                break
        found.append(
            _Kind(
                name,
                [m.key[1] for m in muscles],
                records.tolist(),
                cells.names,
                [units[n] for n in cells.names],
                one,
                float(np.sqrt(np.median(variance))),
                dof,
                [(cells.law, m.held) for m in muscles],
            )
        )
    return found, most


def _noise(normal: Array, slope: Array, square: Array, counts: Array) -> tuple[Array, int]:
    """Variance of each record's noise, about its own optimum; degrees of freedom in all."""
    step = (inverse(normal) @ slope[:, :, None])[:, :, 0]
    least = np.maximum(square - np.sum(step * slope, axis=1), 0.0)
    dof = np.maximum(counts - normal.shape[1], 0).astype(float)
    least = np.where(dof > 0, least, 0.0)
    if not dof.sum():
        raise FitError("no record has more cells than the law has coefficients: noise is unknown")
    size = 1e-12 * max(float(np.mean(square / counts)), 1e-12)
    return np.maximum(shrunken_variances(least, dof), size), int(dof.sum())


def _solved(
    a: Array, x: Array, place: NDArray[np.intp], own: NDArray[np.bool_], last: _Solved | None
) -> _Solved:
    """Records within muscles, muscles within the kind. last : to begin from."""
    begin = (None, None) if last is None else (last.within.covariance, last.between.covariance)
    within = between(a, x, place, own, begin[0])
    narrowed, right = marginal(a, x, within.covariance)
    count = int(place.max()) + 1
    whole, sums = summed(narrowed, place, count), summed(right, place, count)
    muscles = between(whole, sums, np.zeros(count, dtype=np.intp), own, begin[1])
    values, errors = muscles.predicted(whole, sums, np.zeros(count, dtype=np.intp))
    recorded = values[place] + effects(a, x, within.covariance, values[place])
    alone = (inverse(whole) @ sums[:, :, None])[:, :, 0]
    return _Solved(within, muscles, values, errors, alone, recorded)


# ---- fits that were made already -----------------------------------------------------------------
def _of_fits(
    fits: Mapping[str, Sequence[Estimates]], kinds: Mapping[str, str], shared: Sequence[str]
) -> list[_Kind]:
    every = [(m, fit) for m, own in fits.items() for fit in own]
    for _, fit in every:
        require_instance("records", fit, Estimates, "give {muscle: fits}, each of one record")
    if not every:
        raise InputError("records: there is no fit in it; give {muscle: fits}")
    first = every[0][1].linearisation
    names, units = list(first.names), list(first.units)
    for muscle, fit in every:
        if list(fit.linearisation.names) != names:
            raise InputError(
                f"a fit of {muscle} has {', '.join(fit.linearisation.names)}, the first "
                f"{', '.join(names)}: fits of a fleet need the same parameters"
            )
    found = []
    own = _own(shared, names)
    for kind in dict.fromkeys(kinds.get(m, "") for m in fits):
        muscles = [m for m in fits if kinds.get(m, "") == kind and fits[m]]
        chosen = [(i, f) for i, m in enumerate(muscles) for f in fits[m]]
        a = inverse(np.array([f.covariance for _, f in chosen]))
        z = np.array([f.linearisation.values for _, f in chosen])
        x = (a @ z[:, :, None])[:, :, 0]
        one = _solved(a, x, np.array([i for i, _ in chosen]), own, None)
        count, dof = [len(fits[m]) for m in muscles], sum(f.dof for _, f in chosen)
        found.append(_Kind(kind, muscles, count, names, units, one, float("nan"), dof))
    return found


# ---- the result ----------------------------------------------------------------------------------
def _own(shared: Sequence[str], names: Sequence[str]) -> NDArray[np.bool_]:
    """Which coefficients muscles have of their own."""
    if isinstance(shared, str):
        raise InputError(f"shared = {shared!r}: give a list of coefficients")
    for name in shared:
        if name not in names:
            raise UnknownNameError("coefficient in shared", name, names)
    return np.array([n not in shared for n in names])


def _result(kinds: list[_Kind], failed: dict[str, str], passes: int, seconds: float) -> FleetFit:
    populations, muscles = {}, {}
    for kind in kinds:
        found = kind.solved
        scatter = np.diag(found.between.covariance)
        mean, error = found.between.means[0], found.between.errors[0]
        populations[kind.name] = Population(
            kind.name,
            len(kind.muscles),
            _coefficients(kind, mean, error),
            error,
            found.between,
            found.within,
            _law(kind, 0, mean),
            tuple(n for n, b in zip(kind.names, scatter, strict=True) if b == 0),
            kind.noise,
        )
        dof = found.within.dof if found.within.covariance.any() else 0
        for i, name in enumerate(kind.muscles):
            muscles[kind.name, name] = FleetMuscle(
                name,
                kind.name,
                kind.records[i],
                _coefficients(kind, found.values[i], found.errors[i]),
                found.errors[i],
                dict(zip(kind.names, found.own[i].tolist(), strict=True)),
                _law(kind, i, found.values[i]),
                dof or kind.dof,
            )
    return FleetFit(populations, muscles, failed, passes, seconds)


def _law(kind: _Kind, muscle: int, values: Array) -> ForceLaw | None:
    """Of a muscle, with these coefficients; None for fits made already."""
    if not kind.laws:
        return None
    law, held = kind.laws[muscle]
    return law(**{**held, **dict(zip(kind.names, values.tolist(), strict=True))})


def _coefficients(kind: _Kind, values: Array, covariance: Array) -> dict[str, Coefficient]:
    errors = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    rows = zip(kind.names, values.tolist(), errors.tolist(), kind.units, strict=True)
    return {n: Coefficient(n, v, e, unit, False) for n, v, e, unit in rows}

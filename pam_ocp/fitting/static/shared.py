"""Joint fit of one law to several muscles with shared coefficients.

Muscles of one make and different length have some coefficients in common; what one table hardly
shows another may. The law that knows the length (length-scaled) fits all lengths with one set.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import compress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.cases import results_of
from ...core.errors import FitError, InputError, UnknownNameError
from ...core.executors import Place, placed
from ...muscles.law import ForceLaw
from ..estimates import Estimates, at_edge, correlation_lines
from ..statistics import (
    Array,
    Linearisation,
    SerialErrors,
    SolverStatistics,
    even,
    require_choice,
    spanned,
)
from ..tables.force_table import ForceTable, require_table
from .correlation import sequences, serial_errors
from .force_fit import ForceFit
from .least_squares import ENOUGH, PLAIN, LeastSquares, Sums, Terms, projected, sizes
from .local_optimum import STATIONARY, Minimum, by_newton
from .optimum import FARTHEST, refitted, walked
from .report import floor_doubts, unseen
from .search import Effort, minimise
from .static import cell_weights, checked_pairs, held_coefficients, independent

JOINT = Effort(600, 12)
"""Of the scan."""


@dataclass(frozen=True, eq=False, repr=False)
class MemberFit(ForceFit):
    """One muscle of a joint fit: a ForceFit whose intervals know of the other muscles' data."""

    marginal: Linearisation = field(kw_only=True)
    """Of this muscle's coefficients, all others of the joint fit unknown."""

    @cached_property
    def linearisation(self) -> Linearisation:
        return self.marginal

    @property
    def dof(self) -> int:
        """Degrees of freedom of the joint fit."""
        return self.marginal.dof

    @property
    def sigma(self) -> float:
        """Standard deviation of a measurement of weight 1 of this table [N]."""
        return self.marginal.scale if self.dof else float("nan")

    @property
    def _scale(self) -> float:
        return self.sigma

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """As of a fit alone, but for the number of levels: the other tables tell more."""
        return (*floor_doubts(self), *unseen(self), *at_edge(self.solver.at_bound, self.law.values))

    @property
    def has_profile(self) -> bool:
        """No: a profile of one table alone leaves out what the others tell."""
        return False

    def profile_interval(
        self, name: str, level: float = 0.95, *, executor: Place = None
    ) -> tuple[float, float]:
        raise InputError("a muscle of a joint fit: take profile_interval of the joint fit")

    def bootstrap(self, n: int = 500, seed: int = 0, **options: Any) -> Any:
        raise InputError("a muscle of a joint fit cannot be resampled without the others")

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        raise InputError(
            "a muscle of a joint fit has intervals that its own table does not tell; save the "
            "muscle with save_muscle(fit.muscle(...), file)"
        )


def marginal_root(jacobian: Array, place: Any) -> Array:
    """R (k, k) with R^T R the information on some unknowns, the others projected out (by QR)."""
    scaled, norms = even(jacobian)
    others, rest = spanned(np.delete(scaled, place, axis=1), 1e-12), scaled[:, place]
    rest = rest - others @ (others.T @ rest)
    return np.asarray(np.linalg.qr(rest, mode="r") * norms[place])


@dataclass(frozen=True, eq=False)
class JointForceFit(Estimates):
    """Several muscles fitted together.

    fits : {muscle: its fit}. names : of the unknowns, ``"a4"`` where shared, ``"a1[20 mm]"`` where
    each muscle has its own. linearisation : of the unknowns, in that order.
    noise : {muscle: standard deviation of a measurement of weight 1 [N]}.

    Examples
    --------
    >>> joint = pam.fit_forces({"new": table, "old": table})
    >>> joint.shared == joint.names, round(joint["new"].rmse, 1)
    (True, 6.2)
    """

    fits: Mapping[str, MemberFit]
    names: tuple[str, ...]
    shared: tuple[str, ...]
    linearisation: Linearisation = field(repr=False)
    noise: Mapping[str, float]
    solver: SolverStatistics
    problem: JointProblem = field(repr=False)

    @property
    def _called(self) -> str:
        return "unknown of the joint fit"

    def __getitem__(self, name: str) -> MemberFit:
        if name not in self.fits:
            raise UnknownNameError("muscle of the joint fit", name, self.fits)
        return self.fits[name]

    @property
    def cost(self) -> float:
        """Weighted sum of squared residuals of all tables [N2]."""
        return self.problem.cost(self.linearisation.values)

    @property
    def rmse(self) -> float:
        """Over all taut cells, without weights [N]."""
        residuals = np.concatenate([f.residuals for f in self.fits.values()])
        return float(np.sqrt(np.mean(residuals**2)))

    def profile_interval(
        self, name: str, level: float = 0.95, *, executor: Place = None
    ) -> tuple[float, float]:
        """Interval by profile likelihood: all others fitted anew on either side.

        Infinite at an end that the data leave open. executor : where the two ends are sought, as
        for :func:`pam_ocp.each`.
        """
        step, linear = self._entry(name).stderr, self.linearisation
        placed(executor)
        if not np.isfinite(step):
            return -np.inf, np.inf
        i = self.names.index(name)
        widened = step / float(linear.independent.stderr()[i])
        limit = self.cost + (linear.reach(level) * widened * linear.scale) ** 2
        ends = [(i, -step, limit), (i, step, limit)]
        low, high = results_of(self._end, ends, executor=executor, chunk=1, what="profiles")
        return low, high

    def _end(self, end: tuple[int, float, float]) -> float:
        """Where the profiled squares reach ``limit`` on the side of ``step``."""
        i, step, limit = end
        low, high = (float(b[i]) for b in self.problem.bounds())
        others, z = partial(refitted, self.problem, held=(i,)), np.array(self.linearisation.values)
        return walked(others, z, i, step, limit, (low, high), FARTHEST * abs(step))[0]

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the coefficients are trusted."""
        found = [f"{n}: {words}" for n, f in self.fits.items() for words in floor_doubts(f)]
        found += [
            f"the data {'do not' if lost else 'hardly'} see this combination: changing {words} "
            "together moves no taut cell beyond its noise"
            for lost, _, words in self.linearisation.hardly_seen()
        ]
        return (*found, *super().warnings, *at_edge(self.solver.at_bound, self.values))

    def report(self, level: float = 0.95) -> str:
        """The fit as text: muscles, shared and own coefficients with intervals, warnings."""
        law = next(iter(self.fits.values())).law
        lines = [
            "[[Law]]",
            f"    {law.title}: {law.reference}",
            f"    shared by {len(self.fits)} muscles: {', '.join(self.shared) or 'nothing'}",
            "[[Data]]",
            *(
                f"    {name}: {f.n} taut cells of {len(f.table)}, RMSE {f.rmse:.4g} N, "
                f"noise {self.noise[name]:.3g} N"
                for name, f in self.fits.items()
            ),
            "[[Fit]]",
            f"    RMSE {self.rmse:.4g} N over all, {self.dof} degrees of freedom, rank "
            f"{self.linearisation.rank} of {len(self.names)}",
            f"    {self.solver.status}, {1e3 * self.solver.seconds:.0f} ms",
            *self._coefficient_lines(
                f"[[Coefficients]] ± standard error (relative), {100 * level:g} % interval", level
            ),
            *correlation_lines(self.linearisation),
            *self._warning_lines(),
        ]
        return "\n".join(lines)


def jointly_fitted(
    tables: Any,
    kind: type[ForceLaw],
    *,
    shared: Sequence[str] | Literal["all"] = "all",
    fixed: Mapping[str, float | Sequence[float]] | None = None,
    weights: Sequence[ArrayLike | None] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    noise: Literal["equal", "each"] = "equal",
    errors: Literal["as found", "independent"] = "as found",
) -> JointForceFit:
    """See :func:`fit_forces`; tables : {muscle: table}, or a sequence of tables."""
    began = time.perf_counter()
    named = _named(tables)
    require_choice("noise", noise, ("equal", "each"))
    problem, common, units = _stated(kind, named, shared, fixed, weights, bounds)
    optimum, factors = _settled(problem, noise)
    weighted = problem.weighted(factors)
    linear = _linearised(weighted, optimum, units)
    if independent(errors):
        linear = linear.independent
    sizes = linear.scale / np.array(factors) if linear.dof else np.full(len(named), np.nan)
    solver = replace(optimum.solver, seconds=time.perf_counter() - began)
    fits = {}
    for i, (name, table) in enumerate(named.items()):
        fits[name] = _member(problem, i, factors[i], table, optimum, linear, solver)
    return JointForceFit(
        fits=fits,
        names=problem.names,
        shared=common,
        linearisation=linear,
        noise=dict(zip(named, sizes.tolist(), strict=True)),
        solver=solver,
        problem=weighted,
    )


def _settled(problem: JointProblem, noise: str) -> tuple[Minimum, list[float]]:
    """The optimum, and the factor of each table's weights (their geometric mean is 1)."""
    factors = [1.0] * len(problem.parts)
    optimum = minimise(problem, _separate(problem), effort=JOINT)
    if optimum.solver.gradient > STATIONARY:
        raise FitError(
            f"the joint fit came to no stationary point ({optimum.solver.status}); share "
            "fewer coefficients, or hold the nonlinear ones with fixed=..."
        )
    for _ in range(50 if noise == "each" else 0):
        rms = []
        for part, c in zip(
            problem.parts, problem.coefficients(optimum.coefficients[None]), strict=True
        ):
            size = part.size
            rms.append(max(np.sqrt(np.mean(part.evaluate(c)[0] ** 2)), 1e-9 * size))
        found = (np.exp(np.mean(np.log(rms))) / np.array(rms)).tolist()
        change = float(np.max(np.abs(np.log(np.array(found) / factors))))
        factors = found
        scanned, near = optimum.solver.scanned, optimum.coefficients[None]
        optimum = by_newton(problem.weighted(factors), near, scanned)[0]
        if change < 1e-8:
            break
    return optimum, factors


def _separate(problem: JointProblem) -> Array | None:
    """Nonlinear unknowns that the tables alone would have: every one's for what is shared."""
    try:
        alone = [minimise(part).coefficients for part in problem.parts]
    except FitError:  # a table too poor to be fitted alone gives no start
        return None
    starts = []
    for lead in range(len(alone)):
        z = np.zeros(problem.count)
        for i in [*(j for j in range(len(alone)) if j != lead), lead]:
            z[problem.places[i]] = alone[i][list(problem.parts[i].free)]
        starts.append(z[problem.nonlinear])
    return np.array(starts)


def _stated(
    kind: type[ForceLaw],
    tables: Mapping[str, ForceTable],
    shared: Any,
    fixed: Mapping[str, Any] | None,
    weights: Any,
    bounds: Any,
) -> tuple[JointProblem, tuple[str, ...], list[str]]:
    """The problem, which unknowns are shared, and the units of all."""
    every = [v.name for v in kind.coefficient_variables()]
    unit_of = {v.name: v.unit for v in kind.coefficient_variables()}
    helds = [
        held_coefficients(kind, own, t)
        for own, t in zip(_fixed(fixed, tables), tables.values(), strict=True)
    ]
    free = [n for n in every if n not in helds[0]]
    common = tuple(free) if shared == "all" else _shared(shared, every, free)
    weights = [None] * len(tables) if weights is None else weights
    if len(weights) != len(tables):
        raise InputError(
            f"weights: {len(weights)} for {len(tables)} tables; give one (or None) each"
        )
    pairs = checked_pairs(kind, "bounds", bounds, helds[0])
    parts, names = [], list(common)
    places: list[Any] = []
    for (name, table), held, own in zip(tables.items(), helds, weights, strict=True):
        place = []
        for n in free:
            label = n if n in common else f"{n}[{name}]"
            if label not in names:
                names.append(label)
            place.append(names.index(label))
        places.append(np.array(place, dtype=np.intp))
        # as a problem of its own a table may hold fewer cells than the law has coefficients
        parts.append(
            LeastSquares.of(
                kind, table, held, cell_weights(own, table), Terms(bounds=pairs), few=True
            )
        )
    problem = JointProblem(tuple(parts), tuple(places), tuple(names))
    if problem.cells < problem.count:
        raise InputError(
            f"the tables have {problem.cells} taut cells, fewer than the {problem.count} unknowns: "
            "share more coefficients, hold some with fixed=..., or measure more"
        )
    return problem, common, [unit_of[n.split("[")[0]] for n in names]


def _linearised(problem: JointProblem, optimum: Minimum, units: Sequence[str]) -> Linearisation:
    z = optimum.coefficients
    residuals, jacobian = (a[0] for a in problem.evaluate(z[None]))
    dof = problem.cells - problem.count
    scale = float(np.sqrt(problem.cost(z) / dof)) if dof else float("nan")
    rounding = np.linalg.norm(residuals) <= 1e-9 * problem.size
    orders = sequences(*(p.cells for p in problem.parts))
    serial = None if rounding else serial_errors(jacobian, residuals, orders)
    return Linearisation(problem.names, z, units, jacobian, scale, dof, serial=serial)


def _member(
    problem: JointProblem,
    i: int,
    factor: float,
    table: ForceTable,
    optimum: Minimum,
    linear: Linearisation,
    solver: SolverStatistics,
) -> MemberFit:
    part, place = problem.parts[i], problem.places[i]
    c = problem.coefficients(optimum.coefficients[None])[i][0]
    names = part.names
    free = tuple(names[j] for j in part.free)
    root, unknowns = marginal_root(linear.jacobian, place) / factor, place.tolist()
    marginal = replace(
        linear,
        names=free,
        values=linear.values[place],
        units=[linear.units[j] for j in unknowns],
        jacobian=root,
        scale=linear.scale / factor,
        serial=_marginal_serial(linear, root, place, factor),
    )
    at_bound = [linear.names[j] in solver.at_bound for j in unknowns]
    return MemberFit(
        law=part.law(**dict(zip(names, c.tolist(), strict=True))),
        table=table,
        held=tuple(n for n in names if n not in free),
        weights=None if np.all(part.weights == 1) else part.weights,
        solver=replace(solver, at_bound=tuple(compress(free, at_bound))),
        terms=PLAIN,
        marginal=marginal,
    )


def _marginal_serial(
    linear: Linearisation, root: Array, place: Any, factor: float
) -> SerialErrors | None:
    """The serially correlated errors, such that the covariance is that of the joint fit."""
    if linear.serial is None or not linear.scale > 0:
        return None
    normal = root.T @ root
    block = linear.covariance[np.ix_(place, place)] / (linear.scale / factor) ** 2
    return replace(linear.serial, meat=normal @ block @ normal)


# ---- arguments -----------------------------------------------------------------------------------
def _named(tables: Any) -> dict[str, ForceTable]:
    if isinstance(tables, ForceTable):
        raise InputError("tables is one ForceTable; give several, or take fit_force")
    if isinstance(tables, Mapping):
        found = {str(n): t for n, t in tables.items()}
    else:
        chosen = list(tables)
        sources = [getattr(t, "source", "") for t in chosen]
        distinct = len(set(sources)) == len(sources) and all(sources)
        found = {
            s if distinct else str(i + 1): t
            for i, (s, t) in enumerate(zip(sources, chosen, strict=True))
        }
    for name, table in found.items():
        require_table(table, f"table {name}")
    if len(found) < 2:
        raise InputError("tables: give at least two; one alone is for fit_force")
    return found


def _fixed(fixed: Mapping[str, Any] | None, tables: Mapping[str, Any]) -> list[dict[str, Any]]:
    """What is held, for each muscle."""
    found: list[dict[str, Any]] = [{} for _ in tables]
    for name, value in (fixed or {}).items():
        values = [value] * len(tables) if np.ndim(value) == 0 else list(value)
        if len(values) != len(tables):
            raise InputError(
                f"fixed[{name!r}] has {len(values)} values for {len(tables)} tables; give one "
                "number, or one for each"
            )
        for own, number in zip(found, values, strict=True):
            own[name] = number
    return found


def _shared(shared: Any, every: Sequence[str], free: Sequence[str]) -> tuple[str, ...]:
    if isinstance(shared, str):
        raise InputError(f"shared = {shared!r}: give a list of coefficients, or 'all'")
    for name in shared:
        if name not in every:
            raise UnknownNameError("coefficient in shared", name, every)
        if name not in free:
            raise InputError(f"shared: {name} is held; take it out of shared or of fixed")
    return tuple(n for n in free if n in shared)


# ---- the problem ---------------------------------------------------------------------------------
FEWEST = 100
"""Cells of each table that a scan looks at."""


@dataclass(frozen=True, eq=False)
class JointProblem:
    """Fits of one law to several tables; ``places[i]`` says where in z each free coefficient of
    table i stands (in the order of ``parts[i].free``)."""

    parts: tuple[LeastSquares, ...]
    places: tuple[NDArray[np.intp], ...]
    names: tuple[str, ...] = ()
    """Of the unknowns."""

    @property
    def law(self) -> type[ForceLaw]:
        return self.parts[0].law

    @property
    def terms(self) -> Terms:
        """Plain squares."""
        return PLAIN

    @property
    def limited(self) -> bool:
        """Whether there are inequalities other than the law's own."""
        return any(p.limited for p in self.parts)

    @cached_property
    def count(self) -> int:
        """Number of unknowns."""
        return 1 + max(int(p.max()) for p in self.places)

    @property
    def free(self) -> range:
        """Positions of the unknowns: all are free."""
        return range(self.count)

    @cached_property
    def size(self) -> float:
        """Norm of the weighted forces of all tables [N]."""
        return float(np.sqrt(sum(p.size**2 for p in self.parts)))

    @property
    def cells(self) -> int:
        """Number of taut cells of all tables."""
        return sum(len(p.cells) for p in self.parts)

    @cached_property
    def nonlinear(self) -> list[int]:
        """Positions in z of the coefficients in which the law is not linear."""
        return sorted({z for part, i, z in self._each() if i in part.nonlinear})

    def _each(self) -> Iterator[tuple[LeastSquares, int, int]]:
        """(a table's problem, one of its free coefficients, where in z it stands)."""
        for part, place in zip(self.parts, self.places, strict=True):
            yield from ((part, i, z) for i, z in zip(part.free, place.tolist(), strict=True))

    def coefficients(self, z: Array) -> list[Array]:
        """All coefficients of each law (m, all) at unknowns (m, count)."""
        found = []
        for part, place in zip(self.parts, self.places, strict=True):
            c = np.tile(part.base, (len(z), 1))
            c[:, list(part.free)] = z[:, place]
            found.append(c)
        return found

    def evaluate(self, z: Array) -> tuple[Array, Array]:
        """Weighted residuals (m, n) and Jacobians (m, n, count) at unknowns (m, count)."""
        residuals, jacobians = [], []
        for part, place, c in zip(self.parts, self.places, self.coefficients(z), strict=True):
            rest, slopes = part.evaluate(c)
            wide = np.zeros((*rest.shape, self.count))
            wide[:, :, place] = slopes[:, :, list(part.free)]
            residuals.append(rest)
            jacobians.append(wide)
        return np.concatenate(residuals, axis=1), np.concatenate(jacobians, axis=1)

    def sums(self, z: Array, second: bool = False) -> Sums:
        """The quadratic model at unknowns (m, count)."""
        m, size = len(z), self.count
        found = Sums(
            np.zeros(m), np.zeros((m, size)), np.zeros((m, size, size)), np.zeros((m, size, size))
        )
        for part, place, c in zip(self.parts, self.places, self.coefficients(z), strict=True):
            own, free = part.sums(c, second), list(part.free)
            block = (slice(None), place[:, None], place[None, :])
            found.cost[:] += own.cost
            found.right[:, place] += own.right[:, free]
            found.normal[block] += own.normal[:, free][:, :, free]
            found.second[block] += own.second[:, free][:, :, free]
        return found

    def cost(self, z: Array) -> float:
        """Weighted sum of squares [N2]."""
        return float(self.sums(z[None]).cost[0])

    def with_priors(self, z: Array) -> tuple[Array, Array]:
        """As :meth:`evaluate`: there are no priors on what several tables share."""
        return self.evaluate(z)

    def project(self, values: Array) -> tuple[Array, Array]:
        """Best linear unknowns for nonlinear ``values`` (m, k): costs (m,), z (m, count)."""
        z, good = np.zeros((len(values), self.count)), np.ones(len(values), dtype=bool)
        z[:, self.nonlinear] = values
        linear = [i for i in range(self.count) if i not in self.nonlinear]
        rows = []
        for part, place in zip(self.parts, self.places, strict=True):
            at = dict(zip(part.free, place.tolist(), strict=True))
            _, whole, finite = part.triangles(z[:, [at[i] for i in part.nonlinear]])
            wide = np.zeros((*whole.shape[:2], len(linear) + 1))
            wide[:, :, [*(linear.index(at[i]) for i in part.linear), -1]] = whole
            rows.append(wide)
            good &= finite
        cost, z[:, linear], _ = projected(np.concatenate(rows, axis=1), good)
        return cost, z

    def bounds(self) -> tuple[Array, Array]:
        """Of z: the narrowest of all tables that share an unknown."""
        low, high = np.full(self.count, -np.inf), np.full(self.count, np.inf)
        for part, i, z in self._each():
            low[z] = max(low[z], part.variables[i].min)
            high[z] = min(high[z], part.variables[i].max)
        return low, high

    @cached_property
    def scales(self) -> list[Array]:
        """Values at which each nonlinear unknown is scanned."""
        variables = {z: part.variables[i] for part, i, z in self._each()}
        return [sizes(variables[z]) for z in self.nonlinear]

    def near(self, start: Array) -> tuple[Array, Array]:
        """Bounds within the reach of the scan: beyond it a law degenerates."""
        low, high = self.bounds()
        for i, scale in zip(self.nonlinear, self.scales, strict=True):
            if not np.isfinite(high[i] - low[i]):
                reach = np.sort(np.copysign([np.abs(scale).min(), np.abs(scale).max()], start[i]))
                low[i], high[i] = max(low[i], reach[0]), min(high[i], reach[1])
        return low, high

    def thinned(self) -> JointProblem:
        """The problem on so many cells as a scan needs."""
        enough = max(ENOUGH // len(self.parts), FEWEST)
        return replace(self, parts=tuple(p.thinned(enough) for p in self.parts))

    def weighted(self, factors: Sequence[float]) -> JointProblem:
        """The same with all weights of each table multiplied."""
        parts = (
            replace(p, weights=p.weights * f) for p, f in zip(self.parts, factors, strict=True)
        )
        return replace(self, parts=tuple(parts))

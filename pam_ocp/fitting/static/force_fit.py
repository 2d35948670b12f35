"""What a static fit tells: coefficients with errors, intervals, predictions, its doubts, and
its bootstrap (B. Efron, R. Tibshirani, An Introduction to the Bootstrap, 1993).
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ... import courtesy
from ...core.calibration import AMBIENT
from ...core.cases import ending
from ...core.errors import (
    FitError,
    InputError,
    UnknownNameError,
    broadcast,
    require_count,
    require_numbers,
)
from ...core.executors import Place, placed
from ...core.files import read_json, reading, write_json
from ...core.progress import working
from ...core.quantities import meant_within, outside
from ...core.shown import shown
from ...core.stop import TimeIsUp, deadline, verb
from ...muscles.law import ForceLaw
from ...muscles.laws.user_defined import law_named
from ...muscles.pneumatic_muscle import Muscle
from ...muscles.validity import ValidityWarning
from ..statistics import Array, Prediction, SolverStatistics, require_choice, require_level
from ..tables.floor import Floor
from ..tables.force_table import ForceTable
from .correlation import drawn_errors, scaled_errors, sequences
from .least_squares import LeastSquares, Terms, finite
from .optimum import Ends, Optimum, Sweep, profile_ends
from .report import LackOfFit, force_report, force_warnings, lack_of_fit
from .search import minimise_near

if TYPE_CHECKING:
    from matplotlib.axes import Axes

STRAIGHT = 0.2
"""By this part of its half width the profile interval of a coefficient may differ from value ± t
errors for the law to count as nearly linear in it.
"""


@shown
@dataclass(frozen=True, eq=False, repr=False)
class ForceFit(Optimum):
    """A force law fitted to a table, with all that the data say about its coefficients.

    law : the fitted law. table : the data, slack cells included. held : coefficients that were
    not fitted. weights : of the taut cells, or None. solver : how the optimum was found.
    terms : loss, censoring, bounds and priors of the fit.

    Examples
    --------
    >>> fit
    ForceFit(six-parameter: RMSE 6.196 N over 60 taut cells)
    >>> low, high = fit.interval("a3")
    >>> low < fit.law.values["a3"] < high
    True
    >>> fit.muscle(rest_length=0.300, diameter=0.020).law.name
    'six-parameter'
    """

    def __repr__(self) -> str:
        return f"ForceFit({self.law.name}: RMSE {self.rmse:.4g} N over {self.n} taut cells)"

    # ---- what the data say about the coefficients ---------------------------------------------
    def interval(
        self,
        name: str,
        level: float = 0.95,
        *,
        linearised: bool = False,
        executor: Place = None,
    ) -> tuple[float, float]:
        """Confidence interval of a coefficient [its unit]; see :meth:`intervals`."""
        entry = self._entry(name)
        if entry.held:
            return entry.value, entry.value
        return self.intervals(level, linearised=linearised, executor=executor)[name]

    def intervals(
        self, level: float = 0.95, *, linearised: bool = False, executor: Place = None
    ) -> dict[str, tuple[float, float]]:
        """Confidence intervals of the free coefficients.

        By profile likelihood, as :meth:`profile_interval`, wherever it is defined: after least
        squares without inequalities. Else, and with ``linearised``, value ± t standard errors,
        which is short on one side for a coefficient in which the law bends. An end may be infinite:
        see :meth:`open_ends`.

        executor : where profiles are walked along that do not end within milliseconds, as for
            :func:`pam_ocp.each`; the ends are the same everywhere.
        """
        placed(executor)
        found = super().intervals(level)
        if not linearised and self.has_profile and self.sigma > 0:
            ends = self._profiled(level, executor)
            found |= {n: (e.low, e.high) for n, e in ends.items()}
        return found

    def open_ends(self, level: float = 0.95) -> dict[str, str]:
        """Why an interval of :meth:`intervals` has an infinite end, by coefficient."""
        found = {
            n: "the data do not see it alone"
            for n in self.free
            if not np.isfinite(self.coefficients[n].stderr)
        }
        return found | {n: e.reason for n, e in self._profiled(level).items() if e.reason}

    def _profiled(self, level: float, executor: Place = None) -> Mapping[str, Ends]:
        """Ends of the profile intervals of the coefficients for which there is one."""
        known: dict[float, Mapping[str, Ends]] = self.__dict__.setdefault("_profiles", {})
        if level not in known:
            names = [n for n in self.free if np.isfinite(self.coefficients[n].stderr)]
            wanted = self.has_profile and self.sigma > 0 and self.problem.nonlinear
            reach = self.linearisation.reach(level)
            known[level] = profile_ends(self, names, reach, executor) if wanted else {}
        return known[level]

    def profile_interval(
        self, name: str, level: float = 0.95, *, executor: Place = None
    ) -> tuple[float, float]:
        """Confidence interval by profile likelihood: where F(1, dof) of the squares is exceeded.

        All other coefficients are fitted anew at each value, so the interval may be lopsided; an
        end that the data leave open is infinite. (Bates, Watts, Nonlinear Regression, 1988, 6.1.)
        Where errors are serially correlated, the excess is larger in the ratio of the variances
        with and without that (R. Chandler, S. Bate, Biometrika 94 (2007) 167-183).

        executor : where the two ends are sought, as for :meth:`intervals`.
        """
        entry = self._entry(name)
        if entry.held:
            return entry.value, entry.value
        if not np.isfinite(entry.stderr):
            return -np.inf, np.inf
        if self.terms.loss != "squares":
            raise InputError(
                "profile_interval needs loss='squares'; after a robust fit use bootstrap()"
            )
        ends = profile_ends(self, (name,), self.linearisation.reach(level), executor)[name]
        return ends.low, ends.high

    def predict(
        self, p: ArrayLike | str, kappa: ArrayLike | str, level: float = 0.95
    ) -> Prediction:
        """Force at gauge pressure p [Pa] and contraction kappa, with intervals; arrays broadcast.

        p, kappa : numbers, or texts with a unit ("3 bar", "10 %"). ``prediction`` is for a
        measurement as uncertain as the cells are on average. Where the one nonlinear coefficient of
        a law is hardly known, the bands are those of the profile likelihood: all that laws reach
        which fit as well as its interval allows, no narrower than ``stderr`` says. A muscle only
        pulls: where the law is below zero the force is 0, and ``slack`` true (``law.tension`` tells
        the law itself). Outside of the data ``outside`` is true, and a ValidityWarning says so.

        Raises InputError for what no muscle can be (a contraction of 10, for 10 %).
        """
        pressure, contraction = _places(p, kappa)
        away = _beyond(self.table, pressure, contraction)
        force, gradient = self._sensitivity(pressure.ravel(), contraction.ravel())
        force = force.reshape(pressure.shape)
        error = self.linearisation.stderr(gradient).reshape(pressure.shape)
        t = self.linearisation.reach(level)
        with np.errstate(invalid="ignore"):
            half = np.where(error > 0, t * error, 0.0)
        low, high = force - half, force + half
        if self._bends:
            low, high = self._swept_band(pressure, contraction, level, low, high)
        serial = self.linearisation.serial
        spread = self.usual * self.sigma * (1.0 if serial is None else serial.spread)
        new = t * spread if self.dof else np.inf
        wide = (force - np.hypot(force - low, new), force + np.hypot(high - force, new))
        return Prediction.of_law(force, error, (low, high), wide, level, away)

    @cached_property
    def _bends(self) -> bool:
        """Whether a linearised band misleads: the one nonlinear coefficient is hardly known."""
        if len(self.problem.nonlinear) != 1 or not self.has_profile or not self.sigma > 0:
            return False
        c = self.coefficients[self.problem.names[self.problem.nonlinear[0]]]
        if not np.isfinite(c.stderr):
            return True
        half = self.linearisation.reach(0.95) * c.stderr
        ends = np.abs(np.array(self.interval(c.name)) - c.value)
        return bool(np.any(np.abs(ends / half - 1) > STRAIGHT))

    def _swept_band(
        self, p: Array, kappa: Array, level: float, low: Array, high: Array
    ) -> tuple[Array, Array]:
        """The band by profile likelihood, no narrower than the linearised one (low, high)."""
        sweep, linear = Sweep.of(self), self.linearisation
        if sweep is None or not p.size:
            return low, high
        gradient = self._sensitivity(p.ravel(), kappa.ravel())[1]
        plain, wide = linear.independent.stderr(gradient), linear.stderr(gradient)
        with np.errstate(invalid="ignore"):
            ratio = np.where(np.isfinite(plain) & (plain > 0), wide / plain, 1.0)
        limits = self.cost + (linear.reach(level) * ratio * self.sigma) ** 2
        ends = (e.reshape(p.shape) for e in sweep.band(p.ravel(), kappa.ravel(), limits))
        return np.minimum(low, next(ends)), np.maximum(high, next(ends))

    @verb
    def bootstrap(
        self,
        n: int = 500,
        seed: int = 0,
        *,
        method: Resampling = "residuals",
        executor: Place = None,
        time_limit: float | None = None,
    ) -> Bootstrap:
        """Refit ``n`` resampled tables: intervals without the assumptions of a linearisation.

        method : "residuals" puts residuals, drawn with replacement, on the fitted law; "cases"
        draws the cells themselves, also right where the scatter is not the same everywhere. Where
        errors are serially correlated (``serial``), what is drawn does so, too; with "cases" it is
        as large from place to place as the residuals there.
        executor : where, as for :func:`pam_ocp.each`; the samples are the same everywhere.
        time_limit : [s]; what was refitted until then is returned, and ``ended`` says so.
        """
        require_count("n", n, 2)
        require_choice("method", method, ("residuals", "cases"))
        if method == "residuals" and self.dof < 1:
            raise InputError("bootstrap needs more cells than coefficients; there are no residuals")
        random = np.random.default_rng(require_count("seed", seed, 0))
        problem, failed, ended = self.problem, 0, ""
        start = self.vector[None, list(problem.nonlinear)] if problem.nonlinear else None
        found: dict[int, Array] = {}
        tables = (_resampled(self, problem, random, method) for _ in range(n))
        some = min(max(TOGETHER // len(problem.cells), 1), MOST_TOGETHER)
        groups = iter(lambda: list(islice(tables, some)), [])
        given: dict[str, Any] = {"executor": executor, "count": -(-n // some)}
        try:
            with working("bootstrap", n) as bar:
                for i, results in ending(partial(_refitted, start), groups, **given):
                    if isinstance(results, Exception):
                        raise results
                    fitted = {j: c for j, c in enumerate(results) if not isinstance(c, FitError)}
                    found |= {i * some + j: c for j, c in fitted.items()}
                    failed += len(results) - len(fitted)
                    bar.step(len(results))
        except TimeIsUp:
            if len(found) < 2:
                raise
            ended = f"{deadline()} was over behind {len(found)} of {n} tables"
        samples = [found[i] for i in sorted(found)]
        if len(samples) < 2:
            raise FitError(f"{failed} of {n} resampled tables gave no fit; the data are too few")
        return Bootstrap(self.free, np.array(samples), failed, ended)

    def lack_of_fit(self) -> LackOfFit:
        """F-test of the law against the scatter of repeats; see :func:`report.lack_of_fit`."""
        return lack_of_fit(self)

    # ---- doubts, in words ---------------------------------------------------------------------
    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the coefficients are trusted; empty when there is nothing."""
        return force_warnings(self)

    # ---- out of it ------------------------------------------------------------------------------
    def muscle(
        self,
        *,
        rest_length: float | None = None,
        diameter: float | None = None,
        name: str = "fitted muscle",
        source: str = "",
    ) -> Muscle:
        """The muscle with this law; pressure and contraction ranges are those of the table.

        rest_length : [m], by default the table's. diameter : inner diameter at rest [m].
        """
        length = self.table.rest_length if rest_length is None else rest_length
        if length is None:
            raise InputError("rest_length is missing: the table holds none; give it in metres")
        data = self.table
        return Muscle(
            self.law,
            rest_length=length,
            diameter=diameter,
            pressure_range=(float(max(data.pressure.min(), 0.0)), float(data.pressure.max())),
            contraction_range=(float(data.contraction.min()), float(data.contraction.max())),
            name=name,
            source=source or f"{self.law.title} fitted to {data.source or 'a table'}",
        )

    def report(self, level: float = 0.95) -> str:
        """The fit as text: statistics, coefficients ± standard error, correlations, warnings."""
        return force_report(self, level, self.open_ends(level))

    def plot(self, *, ax: Axes | None = None) -> Any:
        """Measured and fitted force over contraction, one colour per pressure; residuals below.

        ax : draw the forces into this panel instead.
        """
        return courtesy.plot_fit(self, ax=ax)

    def plot_surface(self, *, interactive: bool = False) -> Any:
        """The fitted force over contraction and pressure, measured cells on it, in 3D.

        interactive : by plotly (needs the extra ``interactive``).
        """
        return courtesy.plot_fit_surface(self, interactive=interactive)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write all of it (.json, as :meth:`to_json`, or .xlsx), its coefficients (.csv), its text
        (.txt) or a page (.html).
        """
        if Path(path).suffix.lower() == ".json":
            return self.to_json(path)
        if Path(path).suffix.lower() == ".xlsx":
            return self.to_excel(path)
        return courtesy.save_result(self, path)

    def to_excel(self, path: str | os.PathLike[str]) -> Path:
        """Write a workbook (.xlsx): data, coefficients with intervals, the law as formulas that
        follow when a coefficient is changed, charts.
        """
        return courtesy.write_fit_book(self, path)

    def to_json(self, path: str | os.PathLike[str]) -> Path:
        """Write law, coefficients, data and statistics;
        :meth:`from_json` reads them back exactly.
        """
        kept = ("pressure", "contraction", "force", "branch", "run")
        columns = {n: np.asarray(getattr(self.table, n)) for n in kept}
        table: dict[str, Any] = {n: c.tolist() for n, c in columns.items() if c.size}
        table["censored"] = self.table.slack.tolist()
        floor, serial = self.table.floor_found, self.serial
        content = {
            "format": FORMAT,
            "version": 1,
            "units": "SI: Pa gauge, N, m, contraction as a fraction",
            "law": self.law.name,
            "coefficients": {n: float(v) for n, v in self.law.values.items()},
            "held": list(self.held),
            "stderr": {n: c.stderr for n, c in self.coefficients.items() if np.isfinite(c.stderr)},
            "intervals": {n: list(map(finite, pair)) for n, pair in self.intervals().items()},
            "open": self.open_ends(),
            "correlation": None
            if serial is None
            else {"along": serial.order, "neighbours": serial.correlation},
            "rmse": self.rmse,
            "r2": finite(self.r2),
            "warnings": list(self.warnings),
            "solver": asdict(self.solver),
            "terms": self.terms.to_json(),
            "weights": None if self.weights is None else self.weights.tolist(),
            "rest_length": self.table.rest_length,
            "source": self.table.source,
            "table": table,
            "floor": None if floor is None else asdict(floor),
        }
        return write_json(path, content)

    def save_ssv(
        self,
        path: str | os.PathLike[str],
        muscles: str | Sequence[str] = "muscle",
        *,
        rest_length: float | None = None,
    ) -> Path:
        """Write the fitted muscle as SSV (SSP 1.0), with which a plant's FMU is set without Python.

        muscles : names of the muscles in the FMU, such as ("muscle1", "muscle2").
        rest_length : [m], where the table does not tell it.
        """
        return courtesy.write_muscle_ssv(self.muscle(rest_length=rest_length), path, muscles)

    @classmethod
    def from_json(cls, path: str | os.PathLike[str], law: type[ForceLaw] | None = None) -> ForceFit:
        """Read what :meth:`to_json` wrote. ``law`` : the class, for a law of the user's own."""
        content = read_json(path, "a fit", FORMAT, "to_json() writes one")
        with reading(path, "a fit", "give one that to_json() wrote"):
            kind = law or _law_named(content["law"])
            solver = SolverStatistics(**content["solver"])
            table, floor = dict(content["table"]), content.get("floor")
            if "censored" in table:
                table["censored"] = np.array(table["censored"], dtype=bool)
            return ForceFit(
                law=kind(**content["coefficients"]),
                table=ForceTable(
                    **table,
                    floor=Floor(**floor) if floor else None,
                    rest_length=content["rest_length"],
                    source=content["source"],
                ),
                held=tuple(content["held"]),
                weights=None if content["weights"] is None else np.array(content["weights"]),
                solver=replace(solver, at_bound=tuple(solver.at_bound)),
                terms=Terms.from_json(content.get("terms", {})),
            )


FORMAT = "pam_ocp force fit"


def _law_named(name: Any) -> type[ForceLaw]:
    try:
        return law_named(str(name))
    except UnknownNameError as error:
        raise InputError(f"{error} Give the class of an own law: law=...") from None


# ---- where a prediction is asked for -------------------------------------------------------------
MARGIN = 0.02
"""Of the range of the data: so far beyond their hull a place still counts as within."""
REACH = (-1.0, 1.0)
"""Contraction ratios: no muscle is stretched to twice its length, or contracts to nothing."""


def _places(p: Any, kappa: Any) -> tuple[Array, Array]:
    """Gauge pressures [Pa] and contractions, broadcast: numbers, or texts as "3 bar" and "10 %"."""
    pressure = np.asarray(require_numbers("p", p, "Pa", doubted=True))
    kappas = np.asarray(require_numbers("kappa", kappa, "1"))
    low = pressure < -AMBIENT
    if low.any():
        raise InputError(
            f"p = {pressure[low].flat[0]:g} Pa lies below vacuum: give gauge pressures, from "
            f"{-AMBIENT:g} Pa"
        )
    bad = (kappas <= REACH[0]) | (kappas >= REACH[1])
    if bad.any():
        value = float(kappas[bad].flat[0])
        raise InputError(
            f"kappa = {value:g} is no contraction ratio of a muscle: give (l0 - l)/l0 between "
            f"{REACH[0]:g} and {REACH[1]:g}{meant_within(value, '1', 0.0, 0.6)}"
        )
    both = broadcast(p=pressure, kappa=kappas)
    return both[0], both[1]


def _beyond(table: ForceTable, p: Array, kappa: Array) -> NDArray[np.bool_]:
    """Which places lie outside the convex hull of a table's cells, slack ones included; warns."""
    cells = np.stack([table.pressure, table.contraction], axis=1)
    low, span = cells.min(axis=0), np.ptp(cells, axis=0)
    scale = np.where(span > 0, span, np.array([0.02 * max(abs(low[0]), 1.0), 0.005]))
    asked = (np.stack([p.ravel(), kappa.ravel()], axis=1) - low) / scale
    normals = _hull((cells - low) / scale)
    found = np.any(asked @ normals[:, :2].T + normals[:, 2] > MARGIN, axis=1).reshape(p.shape)
    if found.any():
        high = low + span
        warnings.warn(
            f"{int(found.sum())} of {found.size} predictions lie outside of the data (p "
            f"{low[0] / 1e5:.3g} to {high[0] / 1e5:.3g} bar, kappa {100 * low[1]:.3g} to "
            f"{100 * high[1]:.3g} %, and not every pair of these): the band holds for the law, and "
            "nothing says that the law holds there (prediction.outside says where)",
            ValidityWarning,
            stacklevel=outside(),
        )
    return np.asarray(found)


def _hull(points: Array) -> Array:
    """Half planes (m, 3), n.x + d <= 0 within; those of the box for points on a line."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        return np.asarray(ConvexHull(points).equations)
    except (QhullError, ValueError):
        low, high = points.min(axis=0), points.max(axis=0)
        sides = [[-1, 0, low[0]], [1, 0, -high[0]], [0, -1, low[1]], [0, 1, -high[1]]]
        return np.array(sides, dtype=float)


# ---- bootstrap -----------------------------------------------------------------------------------
Resampling: TypeAlias = Literal["residuals", "cases"]
TOGETHER, MOST_TOGETHER = 10_000, 25
"""Cells of the tables that are refitted side by side, and how many these are."""


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Refitted coefficients: ``samples`` (n, k) of the free ones, in the order of ``names``.

    failed : resampled tables of which no fit was found; they are left out.

    Examples
    --------
    >>> found = fit.bootstrap(20)
    >>> found.samples.shape, found.failed
    ((20, 6), 0)
    """

    names: tuple[str, ...]
    samples: Array
    failed: int = 0
    ended: str = ""
    """Why there are fewer samples than were asked for ("" when there are not)."""

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """Percentile interval of one coefficient."""
        if name not in self.names:
            raise UnknownNameError("fitted coefficient", name, self.names)
        level = require_level(level)
        column = self.samples[:, self.names.index(name)]
        low, high = np.quantile(column, [(1 - level) / 2, (1 + level) / 2])
        return float(low), float(high)

    @property
    def stderr(self) -> dict[str, float]:
        """Standard deviation of each coefficient over the samples."""
        return dict(zip(self.names, self.samples.std(axis=0, ddof=1).tolist(), strict=True))

    @property
    def covariance(self) -> Array:
        """Covariance over the samples (k, k)."""
        return np.atleast_2d(np.cov(self.samples.T))


def _refitted(start: Array | None, problems: Sequence[LeastSquares]) -> list[Array | FitError]:
    """The fits of resampled tables, from that to the measured one."""
    free = list(problems[0].free)
    return [
        found if isinstance(found, FitError) else np.asarray(found.coefficients[free])
        for found in minimise_near(problems, start)
    ]


def _resampled(
    fit: Optimum, problem: LeastSquares, random: np.random.Generator, method: Resampling
) -> LeastSquares:
    """Serially correlated errors, as the fit found, do so in what is drawn."""
    cells, serial = problem.cells, fit.serial
    order = next((o for o in sequences(cells) if serial and o.words == serial.order), None)
    if serial is not None and order is not None:
        draw = drawn_errors if method == "residuals" else scaled_errors
        errors = draw(serial, order, problem.weights * fit.residuals, fit.sigma, random)
    elif method == "cases":
        drawn = random.integers(0, len(cells), len(cells))
        return replace(problem, cells=cells.subset(drawn), weights=problem.weights[drawn])
    else:
        # residuals are smaller than errors: the fit has taken up its coefficients' share
        weighted = problem.weights * fit.residuals * np.sqrt(len(cells) / max(fit.dof, 1))
        errors = random.choice(weighted - weighted.mean(), len(cells))
    force = cells.force - fit.residuals + errors / problem.weights
    return replace(problem, cells=replace(cells, force=force))

"""Fit of holds: where a plant came to rest, at which pressure, tells its spring, load, law, zeros.

A hold is an equilibrium: pressures and positions, waited for. What is estimated moves the
equilibria that the plant has at the measured pressures; they are compared with the measured
positions.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import FitError, InputError, UnknownNameError, require_names, require_positive
from ...core.files import write_json
from ...core.stop import verb
from ...core.trajectory import Trajectory
from ...plants.plant import Plant, require_plant
from ...plants.plant_data import carried
from ..estimates import Estimates, at_edge, correlation_lines
from ..statistics import Array, Coefficient, Linearisation, require_choice, spanned
from ..tables.cells import named_branch
from ..tables.records import read_record
from ..tables.sources import load
from .correlation import Order, serial_errors
from .hold_model import HoldModel, Holds, settled
from .least_squares import Terms, robust_scale
from .static import independent

DECIDING = 0.45
"""Leverage from which a hold nearly decides alone; half of it where there are two alike."""
HANGING = 2.0
"""A standard error that grows by more than this without such holds hangs on them."""


@dataclass(frozen=True, eq=False)
class HoldsFit(Estimates):
    """Estimates from measured equilibria.

    plant : with the estimated parameters. measured, residuals : {variable: (n,)} [SI], the
    latter measured less predicted. given : what was put in, as measured. side : (n,), +1 where
    positions rose to the hold, -1 where they fell, 0 unknown. weights : (n, measured), below 1
    where a robust loss counts a hold less. unreached : holds at which the plant finds no rest.

    Examples
    --------
    >>> round(pam.fitting.fit_holds(plant, holds, "mass").values["mass"], 3)
    10.0
    """

    plant: Plant
    linearisation: Linearisation = field(repr=False)
    measured: Mapping[str, Array] = field(repr=False)
    residuals: Mapping[str, Array] = field(repr=False)
    given: Mapping[str, Array] = field(repr=False)
    side: Array = field(repr=False)
    weights: Array = field(repr=False)
    loss: str
    at_bound: tuple[str, ...] = ()
    unreached: tuple[int, ...] = ()

    @property
    def n(self) -> int:
        """Number of holds."""
        return int(self.side.size)

    @cached_property
    def leverage(self) -> Array:
        """Part of each hold (n,), 0 to 1, in its own prediction: near 1, it decides alone."""
        basis = spanned(self.linearisation.jacobian)
        rows = np.sum(basis**2, axis=1).reshape(self.n, -1)
        return np.asarray(np.max(rows, axis=1))

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean square of the residuals of each measured variable [its unit]."""
        return {n: float(np.sqrt(np.mean(r**2))) for n, r in self.residuals.items()}

    @property
    def predicted(self) -> dict[str, Array]:
        """{variable: (n,)} as the fitted plant has it, zeros and bands included."""
        return {n: y - self.residuals[n] for n, y in self.measured.items()}

    @cached_property
    def _alone(self) -> NDArray[np.intp]:
        """Holds that nearly decide alone, where there are enough others."""
        enough = self.n > 5 * len(self.linearisation.names)
        return np.nonzero(enough & (self.leverage > DECIDING))[0]

    @cached_property
    def hanging(self) -> dict[str, float]:
        """{estimate: factor by which its interval is wider than ± t standard errors}, of those that
        hang on few holds.

        Beside a muscle that goes slack, or a rest that is about to vanish, a position moves far for
        little: the linear model that gives such a hold its weight holds nowhere else, so its
        information does not count for the interval. Infinite where the others tell nothing.
        """
        if not self._alone.size:
            return {}
        linear = replace(self.linearisation, serial=None, scale=1.0)
        kept = np.ones(self.n, dtype=bool)
        kept[self._alone] = False
        rows = linear.jacobian.reshape(self.n, -1, len(linear.names))[kept]
        others = replace(linear, jacobian=rows.reshape(-1, len(linear.names)))
        factor = others.stderr() / linear.stderr()
        return {n: float(f) for n, f in zip(linear.names, factor, strict=True) if not f <= HANGING}

    def _half(self, c: Coefficient, level: float) -> float:
        """Wider where it hangs on few holds (see ``hanging``)."""
        return super()._half(c, level) * self.hanging.get(c.name, 1.0)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the estimates are trusted."""
        found = [
            f"the holds hardly see this combination: changing {words} together moves no hold "
            "beyond its noise"
            for _, _, words in self.linearisation.hardly_seen()
        ]
        if self.unreached:
            shown = ", ".join(str(i + 1) for i in self.unreached[:5])
            found.append(
                f"the fitted plant finds no rest at {len(self.unreached)} of {self.n} holds (row "
                f"{shown}): the linear model stands in there"
            )
        if self._alone.size:
            shown = ", ".join(str(i + 1) for i in self._alone[:5])
            found.append(
                f"few holds nearly decide (row {shown}), as where a muscle goes slack or a rest is "
                "about to vanish"
                + (
                    f": {', '.join(self.hanging)} hang on them, and their intervals are those of "
                    "the other holds; leave these holds out, or measure more like them"
                    if self.hanging
                    else "; the others tell nearly as much"
                )
            )
        ignored = int(np.sum(self.weights.min(axis=1) < 0.1))
        if ignored:
            found.append(f"{ignored} of {self.n} holds lie so far off that they hardly count")
        return (*found, *super().warnings, *at_edge(self.at_bound, self.values))

    def report(self, level: float = 0.95) -> str:
        """The fit as text."""
        sides = {"from below": np.sum(self.side > 0), "from above": np.sum(self.side < 0)}
        ways = ", ".join(f"{int(n)} come to {words}" for words, n in sides.items() if n)
        linear = self.linearisation
        lines = [
            "[[Plant]]",
            f"    {self.plant.name}: {self.plant.description}",
            "[[Holds]]",
            f"    {self.n} equilibria, given {', '.join(self.given)}{'; ' + ways if ways else ''}",
            "[[Fit]]",
            *(
                f"    {n}: RMSE {r:.4g} {self.plant.variable(n).unit}, largest residual "
                f"{self.residuals[n][np.argmax(np.abs(self.residuals[n]))]:+.3g}"
                for n, r in self.rmse.items()
            ),
            f"    loss {self.loss}, {self.dof} degrees of freedom, condition "
            f"{linear.condition:.3g}",
            *self._coefficient_lines(
                f"[[Estimates]] ± standard error (relative), {100 * level:g} % interval",
                level,
                dict.fromkeys(self.hanging, "hangs on few holds"),
            ),
            *correlation_lines(linear),
            *self._warning_lines(),
        ]
        return "\n".join(lines)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write estimates with intervals, holds and residuals as JSON."""
        intervals = self.intervals()
        content = {
            "format": "pam_ocp fit of holds",
            "version": 1,
            "units": "SI",
            "plant": self.plant.name,
            "estimates": {
                n: {"value": c.value, "stderr": c.stderr, "unit": c.unit, "interval": intervals[n]}
                for n, c in self.coefficients.items()
            },
            "rmse": self.rmse,
            "given": {n: a.tolist() for n, a in self.given.items()},
            "measured": {n: a.tolist() for n, a in self.measured.items()},
            "residuals": {n: a.tolist() for n, a in self.residuals.items()},
            "side": self.side.tolist(),
            "warnings": list(self.warnings),
        }
        return write_json(path, content | carried(self.plant))


SIDES = {
    **{"below": 1.0, "inflation": 1.0, "1": 1.0, "above": -1.0, "deflation": -1.0},
    **dict.fromkeys(("", "0", "nan", "unknown"), 0.0),
}
"""Words for the way in which positions (of a muscle: pressures) went before the hold, beside those
for branches of a force table.
"""
COLUMN = ("side", "branch", "direction", "came from")
UNSEEN = 10.0
"""Errors of this many times an estimate, or of its nominal size if that is larger, tell that the
holds do not see it.
"""


@verb
def fit_holds(
    plant: Plant,
    holds: Any,
    estimate: str | Sequence[str],
    *,
    measured: Sequence[str] | None = None,
    side: str | ArrayLike | None = None,
    inputs: Mapping[str, float] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    noise: Mapping[str, float] | None = None,
    loss: Literal["squares", "huber", "bisquare"] = "squares",
    errors: Literal["as found", "independent"] = "as found",
    columns: Mapping[str, str] | None = None,
    units: Mapping[str, str] | None = None,
    time_limit: float | None = None,
) -> HoldsFit:
    """Estimate what a plant's measured equilibria tell: springs, loads, coefficients, zeros, bands.

    Parameters
    ----------
    plant : any plant; its values are where the estimates start.
    holds : a hold per row: file, DataFrame, mapping or Trajectory, with columns named as the
        plant's variables (``muscle_pressure [bar], x [mm]``). A column of a pressure state stands
        for the pressure in the muscle; one of an input for what was commanded.
    estimate : parameters of the plant by name; ``"zero.NAME"``, what the sensor of a variable shows
        at 0; ``"band.NAME"``, half the width between positions come to from below and from above.
    measured : what is compared; by default the positions and outputs among the columns.
    side : the way to each hold: "below" (positions rose), "above", values +1 and -1, or "sequence":
        from hold to hold as measured, in the order of the rows. By default a column called side,
        branch or direction; without one, the sequence where band, friction or memory asks for it.
    inputs : constant inputs (or states) without a column [SI].
    bounds : {estimate: (low, high)} [SI], within those of the plant's variables.
    noise : {measured: standard deviation}, to weigh several measured variables; by default found.
    loss : "squares"; "huber" or "bisquare" where some holds are wrong, as in :func:`fit_force`.
    errors : "as found": serially correlated errors from hold to hold widen the intervals.
    columns, units : as for :func:`read_record`.
    time_limit : [s]; OutOfTime when it is over.

    Raises InputError, UnknownNameError (arguments or holds that cannot be), FitError (the holds do
    not tell what was asked; it names the combination that stays open).

    Examples
    --------
    >>> found = pam.fitting.fit_holds(plant, holds, "mass")  # pressures and positions, side by side
    >>> round(found.values["mass"], 3)
    10.0
    """
    require_plant(plant)
    require_choice("loss", loss, ("squares", "huber", "bisquare"))
    names = require_names("estimate", estimate)
    table, label = _read(plant, holds, columns, units)
    compared = _compared(plant, table, measured)
    settable = {v.name for v in (*plant.states, *plant.inputs)}
    given = {n: a for n, a in table.items() if n not in compared and n in settable}
    count = len(next(iter(table.values())))
    for name, value in (inputs or {}).items():
        given[plant.variable(name).name] = np.full(count, plant.variable(name).check(value))
    parameters, zeros, bands = _sorted(plant, names, given, compared)
    way = _ways(plant, table, label, side, compared, bool(bands))
    inner = [n for n in zeros if n in given]
    near = {n: table[n] for n in compared}
    if way is None:
        way = _sequence(HoldModel.of(plant, given, compared, [], [], np.zeros(count), near), near)
    model = HoldModel.of(plant, given, compared, parameters, inner, way, near)
    labels = [*parameters, *(f"zero.{n}" for n in inner)]
    outer = [f"zero.{n}" for n in zeros if n not in given] + [f"band.{n}" for n in bands]
    problem = Holds(model, np.stack([table[n] for n in compared], 1), [*labels, *outer], way)
    if problem.y.size < len(names):
        raise InputError(
            f"{problem.y.size} measured values for {len(names)} estimates: measure more holds"
        )
    limits = problem.limits(bounds or {})
    sizes = _noise(plant, noise or {}, compared)
    found, sizes, weights, terms = settled(problem, limits, sizes, noise, compared, loss)
    return _result(problem, found, sizes, weights, terms, independent(errors), limits)


def _noise(plant: Plant, noise: Mapping[str, Any], compared: Sequence[str]) -> Array:
    """The standard deviation of each measured variable [SI]; 1 where none is given."""
    for name in noise:
        if name not in compared:
            raise UnknownNameError("measured variable in noise", name, compared)
    given = (noise.get(n, 1.0) for n in compared)
    units = (plant.variable(n).unit for n in compared)
    sizes = zip(compared, given, units, strict=True)
    return np.array([require_positive(f"noise[{n!r}]", v, u) for n, v, u in sizes])


# ---- arguments -----------------------------------------------------------------------------------
def _read(
    plant: Plant, holds: Any, columns: Mapping[str, str] | None, units: Mapping[str, str] | None
) -> tuple[dict[str, Array], list[Any] | None]:
    """Columns of the plant's variables [SI], and the labels of the way to each hold."""
    if isinstance(holds, Trajectory):
        return {v.name: np.asarray(holds[v.name]) for v in holds.variables}, None
    raw = load(holds)
    label = next((list(c) for h, c in raw.columns.items() if str(h).lower() in COLUMN), None)
    count = len(next(iter(raw.columns.values()), ()))
    clock = "number of the hold [s]"
    numbered = {**raw.columns, clock: list(range(count))}
    record = read_record(numbered, plant, columns=columns, units=units, time=clock)
    return {v.name: np.asarray(record[v.name]) for v in record.variables}, label


def _compared(plant: Plant, table: Mapping[str, Array], measured: Any) -> list[str]:
    if measured is not None:
        names = [plant.variable(n).name for n in measured]
    else:
        outputs = [v.name for v in plant.outputs]
        names = [n for n in table if n in plant.positions or n in outputs]
    missing = [n for n in names if n not in table]
    if missing or not names:
        raise InputError(
            f"holds: no column of {missing[0] if missing else 'a position'}; those found are "
            f"{', '.join(table) or 'none'}, positions of the plant {', '.join(plant.positions)}"
        )
    return names


def _sorted(
    plant: Plant, names: Sequence[str], given: Mapping[str, Array], compared: Sequence[str]
) -> tuple[list[str], list[str], list[str]]:
    """Parameters, variables with a zero, and with a band."""
    found: dict[str, list[str]] = {"parameter": [], "zero": [], "band": []}
    for name in names:
        kind, dot, rest = name.partition(".")
        if kind in ("zero", "band") and dot:
            variable = plant.variable(rest).name
            known = list(compared) if kind == "band" else [*compared, *given]
            if variable not in known:
                raise UnknownNameError(f"measured variable with a {kind}", rest, known)
            found[kind].append(variable)
        else:
            variable = plant.variable(name).name
            if plant.variable(name).causality != "parameter":
                raise InputError(
                    f"estimate: {name} is no parameter of {plant.name!r}; name parameters, "
                    "'zero.NAME' or 'band.NAME'"
                )
            found["parameter"].append(variable)
    every = [n for one in found.values() for n in one]
    if not every:
        raise InputError("estimate is empty: name parameters of the plant, zeros or bands")
    for kind, own in found.items():
        twice = [n for n in own if own.count(n) > 1]
        if twice:
            raise InputError(f"estimate names {twice[0]} ({kind}) twice")
    return found["parameter"], found["zero"], found["band"]


def _ways(
    plant: Plant,
    table: Mapping[str, Array],
    label: list[Any] | None,
    side: Any,
    compared: Sequence[str],
    bands: bool,
) -> Array | None:
    """+1, -1 or 0 (n,); None for the sequence."""
    n = len(next(iter(table.values())))
    rough = any(v.memory == "held" for v in plant.states) or any(
        v.widest > 0 and v.unit in ("m/s", "rad/s") for v in plant.parameters
    )
    if side is None and label is None:
        side = "sequence" if bands or rough else "unknown"
    given: Any = label if side is None else side
    if isinstance(given, str):
        if given == "sequence":
            return None
        given = [given] * n
    texts = (str("" if s is None else s).strip().lower() for s in given)
    words = [named_branch(text.removesuffix(".0")) for text in texts]
    bad = [w for w in words if w not in SIDES]
    if bad or len(words) != n:
        raise InputError(
            f"side: {f'{bad[0]!r} is no side' if bad else f'{len(words)} sides for {n} holds'}; "
            "give 'below' (positions rose), 'above', +1 or -1 for each hold, or 'sequence'"
        )
    found = np.array([SIDES[w] for w in words])
    if bands and not found.any():
        raise InputError("band: no hold has a side; give side='sequence' or a column 'side'")
    return found


def _sequence(model: HoldModel, measured: Mapping[str, Array]) -> Array:
    """The way to each hold from the one before: as the plant without friction would go, which noise
    does not turn round; as measured where it stands still. 0 for the first.
    """
    y = next(iter(measured.values()))
    way = model.predicted(np.empty(0), model.anchored(np.empty(0)))[0][:, 0]
    small = 1e-9 * max(float(np.ptp(y)), 1e-300)
    moved = np.diff(np.where(np.isfinite(way).all(), way, y), prepend=np.nan)
    moved = np.where(np.abs(moved) > small, moved, np.diff(y, prepend=np.nan))
    return np.asarray(np.nan_to_num(np.sign(moved)))


def _result(
    problem: Holds,
    found: Array,
    sizes: Array,
    weights: Array,
    terms: Terms,
    alone: bool,
    limits: tuple[Array, Array],
) -> HoldsFit:
    rest, slopes = problem(found)
    k, n = len(found), problem.y.size
    scaled, jacobian = (rest / sizes).ravel(), (-slopes / sizes[:, None]).reshape(n, k)
    dof = n - k
    if terms.loss == "squares":
        scale = float(np.sqrt(scaled @ scaled / dof)) if dof else float("nan")
    else:
        scale = robust_scale(terms, scaled, k)
    rows, y = rest.shape
    order = np.arange(n).reshape(rows, y).T.ravel()
    follows = np.tile(np.arange(rows) > 0, y)
    counted = (rest / sizes * weights).ravel()
    quiet = alone or np.linalg.norm(scaled) <= 1e-9 * np.linalg.norm(problem.y / sizes)
    orders = [] if quiet else [Order("from hold to hold", order, follows)]
    serial = serial_errors(jacobian, counted, orders)
    units = [v.unit for v in problem.variables]
    linear = Linearisation(problem.names, found, units, jacobian, scale, dof, serial=serial)
    _require_seen(linear, problem.nominal)
    inside = {
        n: float(v)
        for n, v in zip(problem.names, found, strict=True)
        if n in problem.model.parameters
    }
    assert problem.z is not None
    _, reached = problem.model.solved(found[: problem.inner], problem.z)
    at_bound = [
        n
        for n, v, low, high in zip(problem.names, found, *limits, strict=True)
        if min(v - low, high - v) <= 1e-9 * max(abs(v), 1e-12)
    ]
    return HoldsFit(
        plant=problem.model.plant.with_values(inside),
        linearisation=linear,
        measured={n: problem.y[:, i] for i, n in enumerate(problem.model.measured)},
        residuals={n: rest[:, i] for i, n in enumerate(problem.model.measured)},
        given=dict(problem.model.given),
        side=problem.way,
        weights=weights,
        loss=terms.loss,
        at_bound=tuple(at_bound),
        unreached=tuple(int(i) for i in np.nonzero(~reached)[0]),
    )


def _require_seen(linear: Linearisation, nominal: Array) -> None:
    """FitError where the holds leave a combination open."""
    sizes = np.maximum(np.abs(linear.values), nominal)
    for lost, move, words in linear.independent.hardly_seen():
        if lost or np.max(np.abs(move) / sizes) > UNSEEN:
            raise FitError(
                f"the holds do not tell all of {', '.join(linear.names)}: changing {words} "
                "together moves no hold beyond its noise; hold one of them, or measure what "
                "tells them apart (other pressures, loads or positions, both ways)"
            )

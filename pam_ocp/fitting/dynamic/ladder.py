"""Which model? A ladder of them on the same records, each with one thing more, judged by what it
predicts of the parts that it was not fitted to.

Every rung is fitted to all records, and once without each fold of them; the parts left out are
predicted by free runs through the whole record (see :mod:`.rungs`). Rungs are compared part by
part, so that what makes a part hard for all of them drops out: the simplest rung that is not
significantly worse than the best is marked.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Protocol

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import (
    FitError,
    InputError,
    OutOfTime,
    UnknownNameError,
    require_count,
    require_instance,
    with_kinds,
)
from ...core.executors import Place
from ...core.interrupts import interruptible
from ...core.progress import counted
from ...core.stop import TimeIsUp, check, limited, spared
from ...core.trajectory import Trajectory
from ...muscles.law import LAWS
from ...plants.feeds import DeadTime, Regulator
from ...plants.losses import CoulombFriction, Creep, MaxwellSlip
from ...plants.plant import Plant
from ..estimates import coefficient_line
from ..statistics import require_level, student_t
from .adequacy import Adequacy, adequacy_of
from .choice import paired
from .evidence import evidence_of
from .experiment import bounds_of, groups, measured_names, recorded
from .free_run_result import BLOCKS
from .rig import Rig, unknowns_of
from .rungs import (
    FIRST_RATE,
    Part,
    Rung,
    RungFit,
    Task,
    climbed,
    left_out,
    usual_steps,
)
from .runs import Band, half_widths

LADDER = (
    *("static", "lag", "unequal lags", "dead time", "slew", "friction", "memory"),
    *("memory per pressure", "force law", "creep"),
)
"""What there is to climb, in this order."""
BEGINS = {"unequal lags": "lag", "memory per pressure": "memory"}
"""Rungs that begin from another one, without which there is none."""
LAGS = ("lag", "venting_lag")
"""Equal in all muscles on the rung "lag", and each muscle's own on "unequal lags"."""
MASSES = {"mass", "inertia"}
SCALES = (0.3, 1.0, 3.0, 10.0)
"""Times a free mass or inertia, and the damping with it, where a rung brings what dissipates: what
stands still tells nothing of it, and minima lie between light and damped (it creeps) and heavy (it
swings); without friction the former is often the better one, with it the latter.
"""
SLIP_YIELDS = (0.003, 0.015)
"""Contractions at which the elements of the memory slide; their forces are fitted."""
MARGIN = 0.01
"""Models whose errors differ by less than this part count as equally good, however sure it is."""
REPORTING = 5.0
"""Seconds to say what was found when a time limit is over."""


class Builder(Protocol):
    """What makes the plant of a rung: ``partial(pam.AntagonisticSlide, muscle, 2.0)``, a class, or
    a function of one's own.
    """

    def __call__(self, *, feed: Any, losses: Any) -> Plant: ...


@with_kinds
@interruptible()
def fit_ladder(
    build: Builder | Sequence[Rung],
    records: Trajectory | Sequence[Trajectory],
    free: Sequence[str | Sequence[str]] = (),
    *,
    feed: Regulator | None = None,
    dynamic: Sequence[str | Sequence[str]] | None = None,
    rungs: Sequence[str] = LADDER,
    outputs: Sequence[str] | None = None,
    folds: int = 5,
    steps: int | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    level: float = 0.95,
    executor: Place = None,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
) -> Ladder:
    """Climb from a static model to one with lag, dead time, slew limit, friction, memory, creep.

    Parameters
    ----------
    build : makes the plant of a rung from ``feed=`` and ``losses=``, as
        ``functools.partial(pam.AntagonisticSlide, muscle, 2.0)``; or rungs of your own
        (:class:`Rung`), from the simplest up, with which ``free``, ``feed``, ``dynamic`` and
        ``rungs`` are left out.
    records : with all inputs and some states or outputs. Each should begin at rest: what is not
        measured begins there.
    free : parameters to fit on every rung, as for :func:`fit_plant` (a gain, a base pressure, the
        muscle's coefficients); they begin where ``build`` sets them.
    feed : the regulator on which rungs are built: its gain, base, lags; by default ``Regulator()``.
    dynamic : parameters freed from the second rung on; by default the plant's damping.
    rungs : which to climb, of "static", "lag", "unequal lags", "dead time", "slew", "friction",
        "memory" (slip), "memory per pressure" (in proportion to 1 + c p), "force law" (the
        coefficients of all muscles but for kinds that ``free`` names of some: those of the others
        may set the scale; a mass or inertia stays as found) and "creep". Other parameters of these
        count as equal in two muscles.
    outputs : what is compared; by default all states and outputs that the records hold.
    folds : of parts of the records (at least 3), each predicted once by a fit to the others. Whole
        records are the parts where there are as many, else each is cut.
    steps : of the integration in each sampling interval; by default of 1.25 ms. Values are found
        with as many more as the residuals ask for.
    bounds : {free parameter: (low, high)}.
    level : of intervals and of the significance of differences.
    executor : where the fits without folds are made, as for :func:`pam_ocp.each`.
    progress : called with a line for each rung.
    time_limit : [s]; rungs for which there is no time are named, OutOfTime where none was climbed.

    Raises InputError, UnknownNameError (of arguments), FitError (no rung can be fitted).

    Examples
    --------
    >>> from functools import partial
    >>> rig = partial(pam.HangingLoad, muscle, 10.0, damping=100.0)
    >>> ladder = pam.fitting.fit_ladder(rig, commanded, folds=3, rungs=["static", "lag"])
    >>> [rung.name for rung in ladder.rungs]
    ['static', '+ lag']
    """
    began = time.perf_counter()
    chosen = recorded(records)
    ladder = (
        rungs_of(build, free, feed=feed, dynamic=dynamic, names=rungs)
        if callable(build)
        else _own(build)
    )
    names = measured_names(ladder[-1].plant, chosen, outputs)
    require_level(level)
    parts = _parts(chosen, require_count("folds", folds, 3))
    # in turn, so that a fold has parts of early and of late
    fold = np.arange(len(parts), dtype=np.intp) % min(folds, len(parts))
    number = usual_steps(chosen) if steps is None else require_count("steps", steps)
    task = Task(chosen, names, parts, fold, number, _bounds(ladder, bounds))
    with limited(time_limit):
        found = _climbed_all(ladder, task, executor, progress)
        with spared(REPORTING):
            result = Ladder(
                tuple(compared(found, level)),
                tuple(parts),
                fold,
                tuple(names),
                len(chosen),
                level,
                time.perf_counter() - began,
                tuple(r.name for r in ladder[len(found) :]),
            )
            rung = next(r for r in ladder if r.name == result.chosen.name)
            adequacy = Adequacy() if rung.static else _adequacy(result)
            return replace(result, adequacy=adequacy, seconds=time.perf_counter() - began)


def _bounds(
    ladder: Sequence[Rung], bounds: Mapping[str, tuple[float, float]] | None
) -> dict[str, tuple[float, float]]:
    """Each belongs to a parameter that some rung frees and holds its value."""
    given = bounds_of(bounds)
    free = [{g.name for g in groups(rung.plant, rung.free)} for rung in ladder]
    for name in given:
        if not any(name in each for each in free):
            every = sorted(set().union(*free))
            raise UnknownNameError("parameter in bounds that no rung frees:", name, every)
    for rung, names in zip(ladder, free, strict=True):
        groups(rung.plant, rung.free, {n: ends for n, ends in given.items() if n in names})
    return given


def _adequacy(ladder: Ladder) -> Adequacy:
    """Of the chosen rung, its dead times as they were found."""
    fit, names = ladder.chosen, list(ladder.outputs)
    m = fit.model
    plant = m.plant.with_values(m.unknowns.parameters(m.plant, m.z))
    found = zip(m.unknowns.groups, m.z, strict=False)
    free = [replace(g, value=float(v * g.scale)) for g, v in found]
    unknowns, _ = unknowns_of(plant, free, names, len(m.records), 1.0)
    rig = m.unknowns.rig(plant, names, m.rig, m.z)
    evidence = evidence_of(plant, m.records, names, unknowns, Rig(rig.delays), unknowns.guess)
    weights = 1 / np.array([max(fit.rmse[n], 1e-300) for n in names])
    return adequacy_of(evidence, weights, {n: c.stderr for n, c in fit.coefficients.items()})


def _climbed_all(
    ladder: Sequence[Rung],
    task: Task,
    executor: Place,
    progress: Callable[[str], None] | None,
) -> list[RungFit]:
    """The rungs for which there is time."""
    found: list[RungFit] = []
    values: dict[str, float] = {}
    rate = FIRST_RATE
    try:
        for rung in counted(ladder, "rungs"):
            check()
            fit, values, rate = climbed(task, rung, values, rate, executor)
            found.append(fit)
            if progress is not None:
                progress(f"{fit.name}: {fit.failure or f'error {fit.score:.4f}'}")
    except TimeIsUp:
        if not any(not r.failure for r in found):
            raise OutOfTime(
                "the time limit was over before the first rung was climbed; allow more time, or "
                "give fewer folds"
            ) from None
    if all(r.failure for r in found):
        raise FitError(f"no rung could be fitted: {found[0].failure}")
    return found


# ---- arguments ----------------------------------------------------------------------------------
def _own(given: Sequence[Rung]) -> list[Rung]:
    ladder = list(given) if isinstance(given, Sequence) else []
    wrong = [r for r in ladder if not isinstance(r, Rung)]
    if wrong or not ladder:
        raise InputError(
            "build: give a function of feed= and losses= that makes a plant, or a list of Rungs"
        )
    return ladder


def _parts(records: Sequence[Trajectory], folds: int) -> list[Part]:
    """Whole records, or each cut into as many pieces as make a part for each fold and more."""
    if len(records) >= folds:
        return [(r, 0, len(record)) for r, record in enumerate(records)]
    pieces = 6 * folds if len(records) == 1 else folds
    found = []
    for r, record in enumerate(records):
        if len(record) < 4 * pieces:
            raise InputError(
                f"record {r + 1} has {len(record)} samples, too few for {pieces} parts; take fewer "
                "folds"
            )
        edges = np.linspace(0, len(record), pieces + 1).round().astype(int).tolist()
        found += [(r, a, b) for a, b in pairwise(edges)]
    return found


# ---- the usual candidates ---
def rungs_of(
    build: Builder,
    free: Sequence[str | Sequence[str]] = (),
    *,
    feed: Regulator | None = None,
    dynamic: Sequence[str | Sequence[str]] | None = None,
    names: Sequence[str] = LADDER,
) -> list[Rung]:
    """The rungs of :func:`fit_ladder`; one start of each is (nearly) the rung before."""
    regulator = require_instance(
        "feed", feed or Regulator(), Regulator, "give a Regulator or PairRegulator"
    )
    unknown = [n for n in names if n not in LADDER]
    if unknown:
        raise UnknownNameError("rung", unknown[0], LADDER)
    steps = [n for n in LADDER if n in names]
    if not steps:
        raise InputError(f"rungs is empty: name some of {', '.join(LADDER)}")
    for later, first in BEGINS.items():
        if later in steps and first not in steps:
            raise InputError(
                f'rungs has "{later}" without "{first}", from which it begins; name both'
            )
    added, found = _added(regulator), list[Rung]()
    parts: dict[str, Any] = {"dead_time": None, "slew": None, "venting_slew": None}
    losses: tuple[Any, ...] = ()
    own: tuple[str, ...] = ()
    law: dict[str, bool] = {}
    for name in steps:
        one, static = added[name], name == "static"
        parts |= one.parts
        losses = (*(e for e in losses if type(e) not in map(type, one.losses)), *one.losses)
        own += one.free
        plant = build(feed=replace(regulator, **parts), losses=losses)
        if name == "unequal lags":
            if len(_tied(plant, "lag")) < 2:
                continue
            own = tuple(n for k in own for n in (_tied(plant, k) if k in LAGS else (k,)))
        chosen, starts = _present(plant, free), list(one.starts)
        if name == "force law":
            taken = _members(plant, chosen)
            # what is free of one muscle alone is held of the others: it may set the scale
            kinds = {n.rpartition(".")[2] for n in taken}
            every = _coefficients(plant).items()
            law = {n: straight for n, straight in every if n.rpartition(".")[2] not in kinds}
            if not law:
                continue
            own += tuple(sorted(law))
        if law:  # from here on a mass sets the scale of the forces
            chosen = [e for e in chosen if not MASSES & _members(plant, [e])]
        if one.damps or (not static and all(r.static for r in found)):
            scales = _scaled(plant, free, dynamic)
            # the first of several starts is the rung before, which has its own mass
            starts += [{**a, **b} for b in scales for a in starts[1:] or starts]
        if not static:
            moving = ("damping", "damping_ratio") if dynamic is None else dynamic
            chosen += _present(plant, moving, dynamic is not None)
            chosen += [_tied(plant, key) for key in own]
        by_name = tuple({n: v for k, v in s.items() for n in _tied(plant, k)} for s in starts)
        by_rate = {n: p for k, p in one.fast.items() for n in _tied(plant, k)}
        label = name if not found else f"+ {name}"
        sets = _sets(law) if name == "force law" else ()
        found.append(Rung(label, plant, tuple(chosen), by_name, static, by_rate, sets))
    return found


@dataclass(frozen=True)
class _Added:
    """What a rung has beyond the one before. fast : see :class:`Rung`. damps : whether a free mass
    is tried lighter and heavier.
    """

    free: tuple[str, ...] = ()
    starts: tuple[dict[str, float], ...] = ({},)
    parts: Mapping[str, Any] = field(default_factory=dict)
    losses: tuple[Any, ...] = ()
    fast: Mapping[str, Sequence[float]] = field(default_factory=dict)
    damps: bool = False


def _added(regulator: Regulator) -> dict[str, _Added]:
    """By rung, for a regulator."""

    def alike(names: tuple[str, ...], *values: float, **more: Any) -> _Added:
        return _Added(names, tuple(dict.fromkeys(names, v) for v in values) or ({},), **more)

    lags = LAGS if regulator.venting_lag is not None else LAGS[:1]
    given = regulator.dead_time
    line = given if isinstance(given, DeadTime) else DeadTime(0.01, order=3)
    friction = CoulombFriction(5.0, speed=3e-3)
    slip = MaxwellSlip((2.0, 2.0), SLIP_YIELDS, edge=1.0)
    pressed = replace(slip, per_pressure=1e-6)
    creep = ("creep1_stiffness", "creep1_time")
    creeps = [dict(zip(creep, v, strict=True)) for v in ((0.1, 1.0), (100.0, 0.3), (100.0, 3.0))]
    late, forces = ("dead_time",), ("slip1_force", "slip2_force")
    slow = {"slew": regulator.slew or 1e6}
    return {
        "static": _Added(),
        "lag": alike(lags, 0.002, 0.02, 0.1),
        "unequal lags": _Added(),
        "dead time": alike(late, 0.001, 0.004, 0.02, 0.06, parts={"dead_time": line}),
        "slew": alike(("slew",), parts=slow, fast={"slew": (3.0, 0.9, 0.5, 0.25)}),
        "friction": alike(("friction_constant",), 0.0, 1.0, 8.0, losses=(friction,), damps=True),
        "memory": alike(forces, 0.0, 1.0, 6.0, losses=(slip,), damps=True),
        "memory per pressure": alike(
            ("slip_per_pressure",), 0.0, 3e-6, 3e-5, losses=(pressed,)
        ),  # in place of the rung before's
        "force law": _Added(),
        "creep": _Added(creep, tuple(creeps), losses=(Creep((200.0,), (1.0,)),)),
    }


def _tied(plant: Plant, key: str) -> tuple[str, ...]:
    """All parameters called so, of whatever muscle: equal in a ladder; or the one of that name."""
    names = (v.name for v in plant.parameters)
    return tuple(n for n in names if key in (n, n.rpartition(".")[2]))


def _scaled(
    plant: Plant, free: Sequence[Any], dynamic: Sequence[Any] | None
) -> list[dict[str, float]]:
    """Starts that are lighter and heavier than the plant, where its mass or inertia is free."""
    sought = [g for e in (free, dynamic or ()) for g in _present(plant, e)]
    if not MASSES & _members(plant, sought):
        return []
    names = (MASSES | {"damping"}) & {v.name for v in plant.parameters}
    values = {n: float(plant.variable(n).start or 0.0) for n in sorted(names)}
    return [{n: v * factor for n, v in values.items()} for factor in SCALES]


def _members(plant: Plant, entries: Sequence[str | Sequence[str]]) -> set[str]:
    """Names of all parameters that entries of free name."""
    return {plant.parameters[m].name for g in groups(plant, entries) for m in g.members}


def _coefficients(plant: Plant) -> dict[str, bool]:
    """{coefficient of a muscle's force law: whether the force is a straight line in it}."""
    known = {v.name for v in plant.parameters}
    found: dict[str, bool] = {}
    for muscle in {n.rpartition(".")[0] for n in known if "." in n}:
        laws = {k: [v.name for v in k.coefficient_variables(f"{muscle}.")] for k in LAWS.values()}
        fitting = [k for k, own in laws.items() if known >= {*own}]
        if not fitting:
            continue
        law = max(fitting, key=lambda k: len(laws[k]))
        at = ca.SX.sym("p"), ca.SX.sym("kappa"), ca.SX.sym("c", len(laws[law]))
        force = law.function()(*at)[0]
        curved = np.array(ca.DM(ca.hessian(force, at[2])[0].sparsity(), 1)).diagonal()
        found |= dict(zip(laws[law], (curved == 0).tolist(), strict=True))
    return found


def _sets(law: Mapping[str, bool]) -> tuple[frozenset[str], ...]:
    """Coefficients of all muscles that are called the same; those last in which forces curve."""
    kinds = sorted({n.rpartition(".")[2] for n, straight in law.items() if straight})
    sets = (frozenset(n for n in law if n.rpartition(".")[2] == k) for k in kinds)
    return (*sets, frozenset(n for n, straight in law.items() if not straight))


def _present(
    plant: Plant, wanted: Sequence[str | Sequence[str]], required: bool = True
) -> list[str | tuple[str, ...]]:
    """Entries of free; of defaults those that the plant has."""
    known = {v.name for v in plant.parameters}
    found: list[str | tuple[str, ...]] = []
    for entry in wanted:
        plain = entry if isinstance(entry, str) else tuple(entry)
        if required or plain in known:
            found.append(plain)
    groups(plant, found)  # refuses what is no parameter
    return found


# ---- what it tells ---
@dataclass(frozen=True, eq=False)
class Ladder:
    """What :func:`fit_ladder` found.

    rungs : from the simplest up. parts : what was left out, each once. best : the rung of the least
    error; chosen : the simplest that is not significantly worse. unclimbed : names of rungs for
    which there was no time.

    Examples
    --------
    >>> ladder.best.name
    '+ lag'
    """

    rungs: tuple[RungFit, ...]
    parts: tuple[Part, ...] = field(repr=False)
    fold: NDArray[np.intp] = field(repr=False)
    outputs: tuple[str, ...]
    records: int
    level: float
    seconds: float
    unclimbed: tuple[str, ...] = ()
    adequacy: Adequacy = field(default_factory=Adequacy)
    """What the residuals of the chosen rung tell; nothing is tested of a static one."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to know before the chosen rung is used; empty when there is nothing."""
        return tuple(filter(None, (self.adequacy.sentence,)))

    def __getitem__(self, name: str) -> RungFit:
        return next(r for r in self.rungs if r.name.removeprefix("+ ") == name.removeprefix("+ "))

    @property
    def best(self) -> RungFit:
        return min(self.rungs, key=lambda r: r.score)

    @property
    def chosen(self) -> RungFit:
        return next(r for r in self.rungs if not r.worse and not r.failure)

    @property
    def plant(self) -> Plant:
        """The chosen one, fitted to all records."""
        return self.chosen.plant

    def predict(
        self,
        records: Trajectory | Sequence[Trajectory],
        rung: str | None = None,
        level: float = 0.9,
    ) -> Band:
        """Runs of a rung (by default the chosen one) through whole records, from what is measured
        at their begin, with bands that hold ``level`` of what is measured there: as wide as errors
        of what folds left out near such a point, and wider where the folds disagree (CV+, R. Barber
        et al., Annals of Statistics 49 (2021) 486-507, over neighbours). Motion unlike that of the
        records, and models that lack something, may be held less often.

        Raises InputError where the level is none or the rung failed, UnknownNameError for others.
        """
        require_level(level)
        found, every = self._named(rung), recorded(records)
        if found.failure:
            raise InputError(f"rung = {found.name!r} has no fit ({found.failure}); choose another")
        measured_names(found.plant, every, self.outputs)
        ends = (found.model.z, *found.members)
        run, *members = (replace(found.model, z=z).run(every) for z in ends)
        apart = np.array([m.predicted - run.predicted for m in members])
        left = left_out(found, self.parts, self.fold)
        return Band(run, half_widths(apart, run.predicted, left, level))

    def intervals(
        self, rung: str | None = None, level: float | None = None
    ) -> dict[str, tuple[float, float]]:
        """Confidence intervals of a rung's values (by default the chosen one's, at the ladder's
        level); blocks of the records count as independent, not samples.
        """
        found = self._named(rung)
        blocks = max(1, -(-BLOCKS // self.records)) * self.records
        t = student_t(self.level if level is None else level, blocks - 1)
        told = self.adequacy.stderr if found is self.chosen else {}
        halves = {n: t * told.get(n, c.stderr) for n, c in found.coefficients.items()}
        return {
            n: (c.value - halves[n], c.value + halves[n]) for n, c in found.coefficients.items()
        }

    def _named(self, rung: str | None) -> RungFit:
        """By default the chosen one."""
        names = [r.name.removeprefix("+ ") for r in self.rungs]
        if rung is not None and rung.removeprefix("+ ") not in names:
            raise UnknownNameError("rung", rung, names)
        return self.chosen if rung is None else self[rung]

    def report(self) -> str:
        """The ladder as text: error of what was left out, gain, cost, and the chosen rung."""
        shown = [self.rungs[0].plant.variable(n) for n in self.outputs]
        heads = [f"{v.name} [{v.display_unit}]" for v in shown]
        wide = [max(len(h), 9) + 2 for h in heads]
        name = max(12, *(len(r.name) + 2 for r in self.rungs))
        lines = [
            f"[[Ladder]] {self.rungs[0].plant.name}",
            f"    {self.records} record{'s' * (self.records > 1)} of {', '.join(self.outputs)}; "
            f"{len(self.parts)} parts in {int(self.fold.max()) + 1} folds, each predicted by a fit "
            f"without it; {self.seconds:.1f} s",
            "[[Rungs]] error (RMS) of free runs in the parts left out",
            f"      {'model':<{name}}{'free':>5}{'states':>7}"
            + "".join(f"{h:>{w}}" for h, w in zip(heads, wide, strict=True))
            + f"{'error':>9}{'against the rung before':>26}{'fit [s]':>9}",
        ]
        for r in self.rungs:
            mark = "*" if r is self.chosen else " "
            row = f"    {mark} {r.name:<{name}}{len(r.coefficients):>5}{r.states:>7}"
            if r.failure:
                lines.append(f"{row}  failed: {r.failure}")
                continue
            row += "".join(
                f"{r.rmse[v.name] / v.display_factor:>{w}.4g}"
                for v, w in zip(shown, wide, strict=True)
            )
            gain, half = r.against
            said = "" if np.isnan(gain) else f"{100 * gain:+.1f} % ± {100 * half:.1f}"
            lines.append(f"{row}{r.score:>9.4f}{said:>26}{r.seconds:>9.2f}")
        lines += [f"      {n:<{name}} no time left" for n in self.unclimbed]
        lines += [
            f"    error: of all variables, in parts of their spread; ±: {100 * self.level:g} % of "
            "paired differences over the parts",
            f"    * the simplest that is not significantly (and by 1 %) worse than the best "
            f"({self.best.name.removeprefix('+ ')})",
            "    free: fitted parameters; fit: processor time of the fit to all records",
            f"[[Parameters]] of '{self.chosen.name}', ± standard error, {100 * self.level:g} % "
            "interval; SI",
        ]
        intervals = self.intervals()
        lines += [coefficient_line(c, intervals[n]) for n, c in self.chosen.coefficients.items()]
        lines += [f"    warning: {text}" for text in self.warnings]
        return "\n".join(lines)

    __str__ = report


# ---- comparison ---------------------------------------------------------------------------------
def compared(found: Sequence[RungFit], level: float) -> list[RungFit]:
    """Each rung against the one before, and against the best; paired over the parts."""
    best = min((r for r in found if not r.failure), key=lambda r: r.score)
    compared: list[RungFit] = []
    last: RungFit | None = None
    for rung in found:
        if rung.failure:
            compared.append(rung)
            continue
        against = (np.nan, np.nan)
        if last is not None:
            gain, half = _ratio(rung, last, level)
            against = (float(np.expm1(gain)), float(np.exp(gain) * np.sinh(min(half, 50.0))))
        behind, half = _ratio(rung, best, 2 * level - 1 if level > 0.5 else level)
        compared.append(replace(rung, against=against, worse=behind - half > np.log1p(MARGIN)))
        last = rung
    return compared


def _ratio(rung: RungFit, other: RungFit, level: float) -> tuple[float, float]:
    """Mean of ln(error/other's error) over the parts, and the half width of its interval."""
    tiny = 1e-30
    gaps = 0.5 * np.log((rung.losses + tiny) / (other.losses + tiny))
    mean, _, half = paired(gaps, level)
    return mean, half

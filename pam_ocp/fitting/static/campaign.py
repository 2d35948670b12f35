"""A campaign of static measurements: each muscle, each branch, repeats, lengths together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from ...core.cases import Place, results_of
from ...core.errors import FitError, InputError
from ...core.executors import placed
from ...core.stop import verb
from ...muscles.law import ForceLaw
from ..statistics import Array
from ..tables.force_table import ForceTable
from .branches import Hysteresis, LackOfFit, hysteresis, lack_of_fit, repeats
from .campaign_files import collected, joined
from .campaign_result import Campaign, LengthLaw, LengthStudy, MuscleStudy, RunStudy
from .force_fit import ForceFit
from .shared import JointForceFit, fit_forces
from .static import fit_branches, fit_force, law_class

__all__ = ["fit_campaign"]

SAME_DIAMETER = 0.02
"""Diameters that differ by less than this part are those of one group."""


@verb
def fit_campaign(
    tables: Any,
    law: str | type[ForceLaw] = "six-parameter",
    *,
    rest_length: float | Mapping[str, float] | None = None,
    diameter: float | Mapping[str, float] | None = None,
    shared: Sequence[str] | Literal["all"] = "all",
    length_laws: Sequence[str | type[ForceLaw]] = (
        "six-parameter",
        "five-parameter",
        "length-scaled",
    ),
    fixed: Mapping[str, float] | None = None,
    loss: Literal["squares", "huber", "l1", "bisquare"] = "squares",
    errors: Literal["as found", "independent"] = "as found",
    columns: Any = None,
    units: Mapping[str, str] | None = None,
    reading: Mapping[str, Any] | None = None,
    executor: Place = None,
    time_limit: float | None = None,
) -> Campaign:
    """Fit a folder of static tables: per muscle, per branch, repeats against each other, lengths.

    Parameters
    ----------
    tables : a folder, a list of files or tables, or {muscle: file or table}. Files of one muscle
        are put together. Which muscle, branch and repeat a file holds is read from columns (muscle,
        branch, run, rest_length, diameter), else from its name: ``DMSP-20-300_filling_run2.csv`` is
        the second filling of a muscle of 20 mm by 300 mm (also ``l300_d20``, ``20x300``).
    law : as for :func:`fit_force`.
    rest_length, diameter : [m], of all muscles, or {muscle, or a part of its name: value}; they
        come before what columns and names say.
    shared : coefficients that muscles of one diameter have in common (:func:`fit_forces`).
    length_laws : laws tried on all lengths of one diameter together, each length left out in turn.
    fixed : coefficients to hold [SI], of the laws that have them.
    loss, errors : as for :func:`fit_force`.
    columns, units : as for :func:`read_table`. reading : further keywords for it.
    executor : where muscles are fitted, and laws with each length left out, as for
        :func:`pam_ocp.each`.
    time_limit : [s]; OutOfTime when it is over.

    Returns
    -------
    Campaign: muscles and groups with their fits, ``table()``, ``report()``, ``plot_data()`` and
    ``save(folder)``. Files that could not be read, and studies that the data do not allow, are
    listed with the reason.

    Raises
    ------
    InputError : no table at all, or arguments that cannot be.

    Examples
    --------
    >>> campaign = pam.fitting.fit_campaign({"M1": table}, rest_length=0.300)
    >>> campaign.save("campaign").name
    'campaign'
    """
    kind = law_class(law)
    placed(executor)
    options = {n: v for n, v in (("columns", columns), ("units", units)) if v is not None}
    measured, failed = collected(tables, rest_length, diameter, {**options, **(reading or {})})
    parts: dict[str, list[Any]] = {}
    for one in measured:
        parts.setdefault(one.muscle, []).append(one)
    muscles: dict[str, MuscleStudy] = {}
    studied = results_of(
        _Studied(kind, fixed, loss, errors),
        list(parts.items()),
        executor=executor,
        chunk=1,
        what="muscles",
    )
    for name, study in zip(parts, studied, strict=True):
        if isinstance(study, str):
            failed[name] = study
        else:
            muscles[name] = study
    if not muscles:
        reasons = "; ".join(f"{n}: {why}" for n, why in list(failed.items())[:3])
        raise InputError(f"no muscle of the campaign could be fitted: {reasons}")
    groups = [
        _lengths(g, muscles, kind, shared, length_laws, fixed, errors, executor)
        for g in _grouped(muscles)
    ]
    return Campaign(kind, muscles, tuple(groups), failed)


def _own(kind: type[ForceLaw], fixed: Mapping[str, float] | None) -> dict[str, float]:
    known = {v.name for v in kind.coefficient_variables()}
    return {n: v for n, v in (fixed or {}).items() if n in known}


# ---- one muscle ----------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Studied:
    """How muscles are fitted; called with a name and what was measured of it."""

    kind: type[ForceLaw]
    fixed: Mapping[str, float] | None
    loss: Literal["squares", "huber", "l1", "bisquare"]
    errors: Literal["as found", "independent"]

    def __call__(self, part: tuple[str, list[Any]]) -> MuscleStudy | str:
        """The study, or why there is none."""
        name, own = part
        width = next((p.diameter for p in own if p.diameter), None)
        fixed = _own(self.kind, self.fixed)
        try:
            table = joined(own)
            fit = fit_force(table, self.kind, fixed=fixed, loss=self.loss, errors=self.errors)
        except (InputError, FitError) as error:
            return str(error)
        return _muscle(name, width, fit, self.fixed, self.loss, self.errors)


def _muscle(
    name: str, diameter: float | None, fit: ForceFit, fixed: Any, loss: Any, errors: Any
) -> MuscleStudy:
    reasons: dict[str, str] = {}
    table = fit.table

    def tried(what: str, call: Any) -> Any:
        try:
            return call()
        except (InputError, FitError) as error:
            reasons[what] = str(error)
            return None

    branches: Mapping[str, ForceFit] = {}
    if len(table.branches) > 1:
        options = {"fixed": _own(type(fit.law), fixed), "loss": loss, "errors": errors}
        branches = tried("branches", lambda: fit_branches(table, type(fit.law), **options)) or {}
    else:
        reasons["branches"] = "the table has one branch only"
    loop: Hysteresis | None = tried("hysteresis", lambda: hysteresis(table))
    lack: LackOfFit | None = tried("lack of fit", lambda: lack_of_fit(fit))
    return MuscleStudy(name, diameter, fit, branches, loop, lack, _runs(fit), reasons)


def _runs(fit: ForceFit) -> tuple[RunStudy, ...]:
    """Each repeat against the mean of the repeats of each of its cells; against the law where
    no cell was repeated.
    """
    cells = fit.cells
    names = list(dict.fromkeys(cells.run))
    if len(names) < 2:
        return ()
    group = repeats(cells)
    count = np.bincount(group)
    means = np.bincount(group, cells.force) / count
    twice = (count > 1)[group]
    off = np.where(twice, cells.force - means[group], np.nan) if twice.any() else fit.residuals
    found = []
    for name in names:
        own = off[np.array([r == name for r in cells.run])]
        own = own[np.isfinite(own)]
        if own.size:
            spread = float(np.std(own, ddof=1)) if own.size > 1 else float("nan")
            found.append(
                RunStudy(
                    name,
                    own.size,
                    float(own.mean()),
                    spread / own.size**0.5,
                    float(np.sqrt(np.mean(own**2))),
                )
            )
    return tuple(found)


# ---- lengths of one diameter ---------------------------------------------------------------------
def _grouped(muscles: Mapping[str, MuscleStudy]) -> list[list[str]]:
    """Muscles of one diameter, where there are several of them."""
    groups: list[list[str]] = []
    known = sorted((m.diameter, n) for n, m in muscles.items() if m.diameter)
    for size, name in known:
        last = groups[-1] if groups else None
        first = muscles[last[0]].diameter if last else None
        if last is not None and first and abs(size - first) <= SAME_DIAMETER * first:
            last.append(name)
        else:
            groups.append([name])
    return [g for g in groups if len(g) > 1]


def _lengths(
    names: list[str],
    muscles: Mapping[str, MuscleStudy],
    kind: type[ForceLaw],
    shared: Any,
    laws: Sequence[Any],
    fixed: Any,
    errors: Any,
    executor: Place,
) -> LengthStudy:
    tables = {n: muscles[n].fit.table for n in names}
    joint: JointForceFit | None = None
    problem = ""
    probability = float("nan")
    try:
        joint = fit_forces(tables, kind, shared=shared, fixed=_own(kind, fixed), errors=errors)
        probability = _sharing(joint, [muscles[n].fit for n in names])
    except (InputError, FitError) as error:
        problem = str(error)
    size = muscles[names[0]].diameter or float("nan")
    kinds = [law_class(one) for one in laws]
    work = partial(_length_law, tables, fixed, errors)
    return LengthStudy(
        size,
        tuple(names),
        joint,
        probability,
        problem,
        tuple(results_of(work, kinds, executor=executor, chunk=1, what="laws")),
    )


def _sharing(joint: JointForceFit, alone: Sequence[ForceFit]) -> float:
    """Probability that sharing costs as much by noise alone (F-test of nested fits, independent
    errors).
    """
    from scipy.special import fdtrc

    if any(f.terms.loss != "squares" for f in alone):
        return float("nan")
    free = sum(f.squares for f in alone)
    dof = sum(f.n - len(f.free) for f in alone)
    more = joint.dof - dof
    if more < 1 or dof < 1 or free <= 0:
        return float("nan")
    return float(fdtrc(more, dof, max(joint.cost - free, 0.0) / more / (free / dof)))


def _length_law(
    tables: Mapping[str, ForceTable], fixed: Any, errors: Any, kind: type[ForceLaw]
) -> LengthLaw:
    """One set of coefficients for all lengths, and for each length left out."""
    own = _own(kind, fixed)
    try:
        whole = fit_forces(tables, kind, fixed=own, errors=errors)
        left_out = {n: _predicted(kind, tables, n, own) for n in tables}
    except (InputError, FitError) as error:
        return LengthLaw(kind.name, None, {}, str(error))
    return LengthLaw(kind.name, whole, left_out, "")


def _predicted(
    kind: type[ForceLaw], tables: Mapping[str, ForceTable], name: str, fixed: dict[str, float]
) -> float:
    """RMSE [N] at a muscle of a law fitted to the others."""
    others = {n: t for n, t in tables.items() if n != name}
    if len(others) > 1:
        law: ForceLaw = next(iter(fit_forces(others, kind, fixed=fixed).fits.values())).law
    else:
        law = fit_force(next(iter(others.values())), kind, fixed=fixed).law
    there = tables[name].taut
    if "rest_length" in law.values:
        law = replace(law, rest_length=there.rest_length)  # type: ignore[call-arg]
    wrong: Array = there.force - np.asarray(law.tension(there.pressure, there.contraction))
    return float(np.sqrt(np.mean(wrong**2)))

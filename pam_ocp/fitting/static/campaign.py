"""Several muscles: one joint fit, or a whole campaign, with candidates for all lengths together.

Of a campaign each muscle is fitted, each branch, repeats are laid beside each other, and muscles of
one diameter are fitted together.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, overload

import numpy as np
from numpy.typing import ArrayLike

from ...core.cases import results_of
from ...core.errors import RAW, FitError, InputError, PamError, blamed, kind_of, require_positive
from ...core.executors import Place, placed
from ...core.files import require_local
from ...core.quantities import outside
from ...core.stop import verb
from ...core.units import unit
from ...muscles.law import ForceLaw
from ..statistics import Array, f_test
from ..tables.cells import branch_of, is_unit, parse_header
from ..tables.force_table import ForceTable, TableArguments, joined_tables, read_table, table_of
from ..tables.raw import RawTable, say
from ..tables.sources import ENDINGS, is_readable, load, naming
from .campaign_result import Campaign, LengthLaw, LengthStudy, MuscleStudy, RunStudy
from .force_fit import ForceFit
from .least_squares import Loss
from .report import hysteresis, lack_of_fit, repeats
from .shared import JointForceFit, jointly_fitted
from .static import fit_branches, fit_force, law_class

CANDIDATES = ("six-parameter", "five-parameter", "length-scaled")
"""Laws that a campaign tries on all lengths of one diameter."""
SAME_DIAMETER = 0.02
"""Diameters that differ by less than this part are those of one group."""


@overload
def fit_forces(
    tables: Any,
    law: str | type[ForceLaw] = "six-parameter",
    *,
    candidates: None = None,
    shared: Sequence[str] | Literal["all"] = "all",
    fixed: Mapping[str, float | Sequence[float]] | None = None,
    weights: Sequence[ArrayLike | None] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    noise: Literal["equal", "each"] = "equal",
    errors: Literal["as found", "independent"] = "as found",
    rest_length: float | Mapping[str, float] | None = None,
    reading: Mapping[str, Any] | None = None,
    time_limit: float | None = None,
) -> JointForceFit: ...
@overload
def fit_forces(
    tables: Any,
    law: str | type[ForceLaw] = "six-parameter",
    *,
    candidates: Sequence[str | type[ForceLaw]],
    shared: Sequence[str] | Literal["all"] = "all",
    fixed: Mapping[str, float] | None = None,
    loss: Loss = "squares",
    errors: Literal["as found", "independent"] = "as found",
    rest_length: float | Mapping[str, float] | None = None,
    diameter: float | Mapping[str, float] | None = None,
    reading: Mapping[str, Any] | None = None,
    executor: Place = None,
    time_limit: float | None = None,
) -> Campaign: ...
@verb
def fit_forces(
    tables: Any,
    law: str | type[ForceLaw] = "six-parameter",
    *,
    candidates: Sequence[str | type[ForceLaw]] | None = None,
    shared: Sequence[str] | Literal["all"] = "all",
    fixed: Mapping[str, Any] | None = None,
    weights: Sequence[ArrayLike | None] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    noise: Literal["equal", "each"] = "equal",
    loss: Loss = "squares",
    errors: Literal["as found", "independent"] = "as found",
    rest_length: float | Mapping[str, float] | None = None,
    diameter: float | Mapping[str, float] | None = None,
    reading: Mapping[str, Any] | None = None,
    executor: Place = None,
    time_limit: float | None = None,
) -> JointForceFit | Campaign:
    """Fit one law to several muscles that have coefficients in common; with ``candidates`` study
    the whole campaign: per muscle, per branch, repeats against each other, lengths.

    Parameters
    ----------
    tables : {muscle: table or file}, a sequence of tables (named by their sources, or numbered), a
        folder, or a list of files. Files of one muscle are put together. Which muscle, branch and
        repeat a file holds is read from columns (muscle, branch, run, rest_length, diameter), else
        from its name: ``DMSP-20-300_filling_run2.csv`` is the second filling of a muscle of 20 mm
        by 300 mm (also ``l300_d20``, ``20x300``).
    law : name in ``LAWS``, or a class.
    candidates : laws tried with one set of coefficients on all lengths of one diameter, each length
        left out in turn; may be empty. None: one joint fit, and nothing else.
    shared : coefficients that all muscles (of one diameter) have in common; "all" of the free ones
        by default, as the length-scaled law wants it for muscles of different rest length.
    fixed : coefficients to hold [SI], of the laws that have them: one number for all muscles, or,
        of a joint fit, one for each in their order. A law's ``rest_length`` is taken from each
        table.
    weights : per muscle, as for :func:`fit_force`; of a joint fit. bounds : {coefficient: (low,
        high)} [SI]; of a joint fit.
    noise : of a joint fit. "equal": one standard deviation for all tables (times 1/weight); "each":
        every table has its own, estimated from its residuals (iterated least squares).
    loss : of the fits of single muscles, as for :func:`fit_force`.
    errors : as for :func:`fit_force`.
    rest_length, diameter : [m], of all muscles, or {muscle, or a part of its name: value}; they
        come before what columns and names say.
    reading : further keywords for :func:`read_table`, such as ``{"units": {"pressure": "kPa"}}``.
    executor : where muscles are fitted, and candidates with each length left out, as for
        :func:`pam_ocp.each`.
    time_limit : [s]; OutOfTime when it is over before there is a result.

    Of a joint fit ``joint["muscle"]`` is a ForceFit of that muscle with the joint intervals. Of a
    Campaign files that could not be read, and studies that the data do not allow, are listed with
    the reason. Raises InputError, UnknownNameError (arguments that cannot be, no table at all,
    fewer cells than unknowns), FitError (no stationary point of a joint fit).

    Examples
    --------
    >>> joint = pam.fit_forces({"new": table, "old": table}, shared=["a3"])
    >>> len(joint.names)  # a3, and five of each
    11
    >>> campaign = pam.fit_forces({"M1": table}, candidates=[], rest_length=0.300)
    >>> round(campaign["M1"].fit.rmse, 1)
    6.2
    """
    kind = law_class(law)
    if candidates is None:
        if loss != "squares" or diameter is not None:
            word = "diameter" if loss == "squares" else "loss"
            raise InputError(f"{word} is of no use to a joint fit; it belongs to candidates=[...]")
        return jointly_fitted(
            _of_muscles(tables, rest_length, reading),
            kind,
            shared=shared,
            fixed=fixed,
            weights=weights,
            bounds=bounds,
            noise=noise,
            errors=errors,
        )
    if weights is not None or bounds is not None or noise != "equal":
        raise InputError("weights, bounds and noise belong to a joint fit; leave candidates away")
    placed(executor)
    parts, failed = collected(tables, rest_length, diameter, reading or {})
    study = _Study(kind, fixed, loss, errors)
    muscles: dict[str, MuscleStudy] = {}
    studied = results_of(study.muscle, [*parts.items()], executor=executor, chunk=1, what="muscles")
    for name, found in zip(parts, studied, strict=True):
        if isinstance(found, str):
            failed[name] = found
        else:
            muscles[name] = found
    if not muscles:
        reasons = "; ".join(f"{n}: {why}" for n, why in list(failed.items())[:3])
        raise InputError(f"no muscle of the campaign could be fitted: {reasons}")
    kinds = [law_class(one) for one in candidates]
    groups = [study.lengths(g, shared, kinds, executor) for g in _grouped(muscles)]
    return Campaign(kind, muscles, tuple(groups), failed)


def fit_campaign(
    tables: Any,
    law: str | type[ForceLaw] = "six-parameter",
    *,
    length_laws: Sequence[str | type[ForceLaw]] = CANDIDATES,
    columns: Any = None,
    units: Mapping[str, str] | None = None,
    reading: Mapping[str, Any] | None = None,
    **options: Any,
) -> Campaign:
    """The former name of :func:`fit_forces` with ``candidates``.

    Examples
    --------
    >>> pam.fitting.fit_campaign({"M1": table}, rest_length=0.300)["M1"].name  # and a warning
    'M1'
    """
    warnings.warn(
        "fit_campaign(..., length_laws=LAWS) is fit_forces(..., candidates=LAWS), its columns= and "
        "units= are reading={'columns': ..., 'units': ...}, since version 0.2",
        DeprecationWarning,
        stacklevel=outside(),
    )
    told = {n: v for n, v in (("columns", columns), ("units", units)) if v is not None}
    return fit_forces(
        tables, law, candidates=length_laws, reading={**told, **(reading or {})}, **options
    )


def _of_muscles(tables: Any, rest_length: Any, reading: Mapping[str, Any] | None) -> Any:
    """{muscle: table} of files; tables stay as they are."""
    if isinstance(tables, ForceTable):
        return tables
    several = isinstance(tables, Mapping | list | tuple)
    every = tables.values() if isinstance(tables, Mapping) else tables if several else ()
    if several and not any(isinstance(t, str | Path | Mapping) for t in every):
        return tables
    measured, failed = collected(tables, rest_length, None, reading or {})
    for name, why in failed.items():
        raise InputError(f"{name}: {why}")
    return {name: joined(own) for name, own in measured.items()}


@dataclass(frozen=True, eq=False)
class _Study:
    """How the fits of a campaign are made."""

    kind: type[ForceLaw]
    fixed: Mapping[str, float] | None
    loss: Loss
    errors: Literal["as found", "independent"]

    def held(self, kind: type[ForceLaw]) -> dict[str, float]:
        """What is fixed of a law."""
        known = {v.name for v in kind.coefficient_variables()}
        return {n: v for n, v in (self.fixed or {}).items() if n in known}

    # ---- one muscle -----------------------------------------------------------------------------
    def muscle(self, part: tuple[str, list[Any]]) -> MuscleStudy | str:
        """The study of (name, what was measured of it), or why there is none."""
        name, own = part
        options = {"fixed": self.held(self.kind), "loss": self.loss, "errors": self.errors}
        try:
            fit = fit_force(joined(own), self.kind, **options)  # type: ignore[arg-type]
        except (InputError, FitError) as error:
            return str(error)
        reasons: dict[str, str] = {}

        def tried(what: str, call: Any) -> Any:
            try:
                return call()
            except (InputError, FitError) as error:
                reasons[what] = str(error)
                return None

        branches: Mapping[str, ForceFit] = {}
        if len(fit.table.branches) > 1:
            call = partial(fit_branches, fit.table, self.kind, **options)
            branches = tried("branches", call) or {}
        else:
            reasons["branches"] = "the table has one branch only"
        loop = tried("hysteresis", partial(hysteresis, fit.table))
        lack = tried("lack of fit", partial(lack_of_fit, fit))
        width = next((p.diameter for p in own if p.diameter), None)
        return MuscleStudy(name, width, fit, branches, loop, lack, _runs(fit), reasons)

    # ---- lengths of one diameter ----------------------------------------------------------------
    def lengths(
        self,
        muscles: Sequence[MuscleStudy],
        shared: Any,
        kinds: Sequence[type[ForceLaw]],
        executor: Place,
    ) -> LengthStudy:
        """Muscles of one diameter together."""
        tables = {m.name: m.fit.table for m in muscles}
        joint: JointForceFit | None = None
        problem, probability = "", float("nan")
        try:
            joint = jointly_fitted(
                tables, self.kind, shared=shared, fixed=self.held(self.kind), errors=self.errors
            )
            probability = _sharing(joint, [m.fit for m in muscles])
        except (InputError, FitError) as error:
            problem = str(error)
        work = partial(self.length_law, tables)
        laws = results_of(work, kinds, executor=executor, chunk=1, what="laws")
        size = muscles[0].diameter or float("nan")
        return LengthStudy(size, tuple(tables), joint, probability, problem, tuple(laws))

    def length_law(self, tables: Mapping[str, ForceTable], kind: type[ForceLaw]) -> LengthLaw:
        """One set of coefficients for all lengths, and for each length left out."""
        try:
            whole = jointly_fitted(tables, kind, fixed=self.held(kind), errors=self.errors)
            left_out = {n: self._predicted(kind, tables, n) for n in tables}
        except (InputError, FitError) as error:
            return LengthLaw(kind.name, None, {}, str(error))
        return LengthLaw(kind.name, whole, left_out, "")

    def _predicted(
        self, kind: type[ForceLaw], tables: Mapping[str, ForceTable], name: str
    ) -> float:
        """RMSE [N] at a muscle of a law fitted to the others."""
        others, fixed = {n: t for n, t in tables.items() if n != name}, self.held(kind)
        fit: ForceFit
        if len(others) > 1:
            fit = next(iter(jointly_fitted(others, kind, fixed=fixed).fits.values()))
        else:
            fit = fit_force(next(iter(others.values())), kind, fixed=fixed)
        there, law = tables[name].taut, fit.law
        if "rest_length" in law.values:
            law = replace(law, rest_length=there.rest_length)  # type: ignore[call-arg]
        wrong: Array = there.force - np.asarray(law.tension(there.pressure, there.contraction))
        return float(np.sqrt(np.mean(wrong**2)))


def _runs(fit: ForceFit) -> tuple[RunStudy, ...]:
    """Each repeat against the mean of the repeats of its cells, or, without any, the law."""
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
            error = float(np.std(own, ddof=1)) / own.size**0.5 if own.size > 1 else float("nan")
            rmse = float(np.sqrt(np.mean(own**2)))
            found.append(RunStudy(name, own.size, float(own.mean()), error, rmse))
    return tuple(found)


def _grouped(muscles: Mapping[str, MuscleStudy]) -> list[list[MuscleStudy]]:
    """Muscles of one diameter, where there are several of them."""
    groups: list[list[MuscleStudy]] = []
    known = sorted((m.diameter, n) for n, m in muscles.items() if m.diameter)
    for size, name in known:
        first = groups[-1][0].diameter if groups else None
        if first and abs(size - first) <= SAME_DIAMETER * first:
            groups[-1].append(muscles[name])
        else:
            groups.append([muscles[name]])
    return [g for g in groups if len(g) > 1]


def _sharing(joint: JointForceFit, alone: Sequence[ForceFit]) -> float:
    """Probability that sharing costs as much by noise alone (F-test of nested fits)."""
    if any(f.terms.loss != "squares" for f in alone):
        return float("nan")
    free = sum(f.squares for f in alone)
    dof = sum(f.n - len(f.free) for f in alone)
    more = joint.dof - dof
    if more < 1 or dof < 1 or free <= 0:
        return float("nan")
    return f_test(joint.cost - free, more, free, dof)[1]


# ---- whose table it is: words of the user, columns, the file's name ------------------------------
IDLE = {"static", "isometric", "force", "forces", "table", "measured", "data", "cells", "map"}
"""Words of a file's name that say nothing of the muscle."""
_NUMBER = r"(\d+(?:[.p]\d+)?)"
_SIZED = re.compile(
    rf"(?:^|[^0-9a-z.]){_NUMBER}[-_x]{_NUMBER}(?:mm|n)?(?=$|[^0-9a-z])", re.IGNORECASE
)
_LENGTH = re.compile(
    rf"(?:^|[^a-z])(?:l0?|len|length)[=_-]?{_NUMBER}(mm|cm|m)?(?=$|[^0-9a-z])", re.I
)
_DIAMETER = re.compile(
    rf"(?:^|[^a-z])(?:d0?|dia|diameter)[=_-]?{_NUMBER}(mm|cm|m)?(?=$|[^0-9a-z])", re.I
)
_RUN = re.compile(r"^(?:run|rep|repeat|trial|r|no)[-=]?(\d+)$", re.IGNORECASE)
_COLUMNS = {
    "muscle": ("muscle", "specimen", "sample", "name"),
    "rest_length": ("rest length", "l0"),
    "diameter": ("diameter", "d0", "inner diameter"),
}
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


@dataclass(frozen=True, eq=False)
class Measured:
    """A table and whose it is. diameter : [m], None where nothing says it."""

    muscle: str
    table: ForceTable
    diameter: float | None


def collected(
    source: Any,
    rest_length: float | Mapping[str, float] | None,
    diameter: float | Mapping[str, float] | None,
    reading: Mapping[str, Any],
) -> tuple[dict[str, list[Measured]], dict[str, str]]:
    """The tables of each muscle, and the files that could not be read, with the reason."""
    found: list[Measured] = []
    failed: dict[str, str] = {}
    for name, one in _sources(source):
        if isinstance(one, ForceTable):
            size = _said(diameter, name) or _sizes(name)[1]
            length = _said(rest_length, name) or one.rest_length or _sizes(name)[0]
            found.append(Measured(name, replace(one, rest_length=length), size))
            continue
        try:
            found += _read(name, one, rest_length, diameter, reading)
        except PamError as error:
            failed[name] = str(error)
    if not found:
        reasons = "; ".join(f"{n}: {why}" for n, why in list(failed.items())[:3])
        raise InputError(f"no table of a campaign could be read: {reasons or 'there is no file'}")
    muscles: dict[str, list[Measured]] = {}
    for part in found:
        muscles.setdefault(part.muscle, []).append(part)
    return muscles, failed


def _sources(source: Any) -> list[tuple[str, Any]]:
    if isinstance(source, ForceTable):
        return [(source.source or "table", source)]
    if isinstance(source, Mapping):
        return [(str(n), t) for n, t in source.items()]
    if isinstance(source, (str, Path)):
        require_local(source)
        folder = Path(source)
        if not folder.is_dir():
            raise InputError(
                f"{folder} is no folder: give a folder of tables, a list of files, or "
                "{muscle: table}"
            )
        paths = sorted(p for p in folder.rglob("*") if is_readable(p))
        return [(p.name, p) for p in paths]
    if not isinstance(source, Iterable):
        raise InputError(f"tables is {kind_of(source)}: give a folder, files or tables")
    return [
        (t.source or str(i + 1), t) if isinstance(t, ForceTable) else (Path(t).name, t)
        for i, t in enumerate(source)
    ]


def _read(
    name: str,
    source: Any,
    rest_length: Any,
    diameter: Any,
    reading: Mapping[str, Any],
) -> list[Measured]:
    """The tables of one file, one for each muscle that a column names."""
    muscle, branch, run = _named(name if isinstance(source, (str, Path)) else f"{name}.table")
    found = []
    try:
        words = TableArguments(**reading)
    except RAW as error:  # said as read_table would
        raise blamed(read_table, (source,), reading, error) from error
    with naming(source):
        for own, part, told in _parts(load(source, words), muscle):
            length = _said(rest_length, own) or told.get("rest_length") or _sizes(own)[0]
            width = _said(diameter, own) or told.get("diameter") or _sizes(own)[1]
            table = table_of(part, TableArguments(rest_length=length, **reading))
            say(part.label, table.notes)
            labels: dict[str, Any] = {"source": name}
            if branch and not table.branch:
                labels["branch"] = (branch,) * len(table)
            if run and not table.run:
                labels["run"] = (run,) * len(table)
            found.append(Measured(own, replace(table, **labels), width))
    return found


def _parts(raw: RawTable, muscle: str) -> list[tuple[str, RawTable, dict[str, float]]]:
    """(muscle, its rows, sizes that columns tell [m]): one for each that columns tell apart."""
    keys = {
        key: header
        for key, words in _COLUMNS.items()
        for header in raw.columns
        if parse_header(str(header))[0] in words
    }
    named = [str(n) for n in raw.columns[keys.pop("muscle")]] if "muscle" in keys else None
    sizes = [[float(v) for v in raw.columns[header]] for header in keys.values()]
    rows: dict[tuple[Any, ...], list[int]] = {}
    for i, key in enumerate(zip(named or [muscle] * len(raw), *sizes, strict=True)):
        rows.setdefault(key, []).append(i)
    found = []
    for (own, *values), chosen in rows.items():
        told = {k: v * _scale(keys[k], v) for k, v in zip(keys, values, strict=True)}
        if named is None and len(rows) > 1:
            own = f"{muscle} {', '.join(f'{1e3 * v:g} mm' for v in told.values())}"
        found.append((own, raw.taken(np.array(chosen)) if len(rows) > 1 else raw, told))
    return found


def _scale(header: str, value: float) -> float:
    """Of a size in metres; no muscle is 2 m long, or 2 mm."""
    said = parse_header(str(header))[1]
    return unit(said).factor if said and is_unit(said) else 1.0 if value < 2.0 else 1e-3


def _said(words: Any, muscle: str) -> float | None:
    """What the user said of a muscle [m]: one number for all, or by (a part of) its name."""
    if words is None:
        return None
    if isinstance(words, Mapping):
        for key, value in words.items():
            if str(key) == muscle or str(key) in muscle:
                return require_positive(f"size of {key}", value, "m")
        return None
    return require_positive("size", words, "m")


def _sizes(name: str) -> tuple[float | None, float | None]:
    """(rest length, diameter) [m] that a name tells: DMSP-20-300, l300_d20, 20x300mm."""
    length, width = _LENGTH.search(name), _DIAMETER.search(name)
    if length or width:
        both = [
            None if m is None else float(m[1].replace("p", ".")) * _UNITS[(m[2] or "mm").lower()]
            for m in (length, width)
        ]
        return both[0], both[1]
    pair = _SIZED.search(name)
    if pair is None:
        return None, None
    small, large = sorted(1e-3 * float(pair[i].replace("p", ".")) for i in (1, 2))
    return (large, small) if 2e-3 <= small <= 0.1 and 2 * small < large < 5 else (None, None)


def _named(file: str) -> tuple[str, str, str]:
    """(muscle, branch, run) that a file's name tells."""
    stem = file
    while Path(stem).suffix.lower() in (*ENDINGS, ".gz", ".table"):
        stem = stem[: -len(Path(stem).suffix)]
    branch = run = ""
    kept = []
    for word in re.split(r"[_\s]+", stem):
        numbered = _RUN.match(word)
        if branch_of(word):
            branch = branch_of(word) or ""
        elif numbered:
            run = numbered[1]
        elif word.lower() not in IDLE:
            kept.append(word)
    if len(kept) > 1 and kept[-1].isdigit() and len(kept[-1]) < 3 and not run:
        run = kept.pop()
    return "_".join(kept) or stem, branch, run


def joined(parts: Sequence[Measured]) -> ForceTable:
    """The tables of one muscle in one; those without labels are runs of their own."""
    tables = [p.table for p in parts]
    if len(tables) == 1:
        return tables[0]
    lengths = {t.rest_length for t in tables}
    if len(lengths) > 1:
        raise InputError(
            f"{parts[0].muscle}: its tables have different rest lengths "
            f"({', '.join(f'{v:g} m' if v else 'none' for v in lengths)}); name muscles apart"
        )
    several = len({t.source for t in tables}) > 1
    if several:
        tables = [t if t.run else replace(t, run=(t.source,) * len(t)) for t in tables]
    whole = joined_tables(tables)
    named = ", ".join(dict.fromkeys(t.source for t in tables))
    return replace(whole, source=named, file=whole.file if several else ())

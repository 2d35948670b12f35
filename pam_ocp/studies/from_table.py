"""One page from one file: a measured table to law, plant, motion, FMU, report and workbook.

Nothing happens here that other verbs do not do; what they want to be told is assumed, and each
assumption is said with the argument that changes it.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from ..core.atomic import make_folder
from ..core.errors import FitError, InputError, PamError
from ..core.quantities import quantity
from ..core.shown import shown
from ..core.stop import verb
from ..fitting.static.force_fit import ForceFit
from ..fitting.static.static import LawComparison, compare_laws, fit_force
from ..fitting.tables.force_table import ForceTable, read_table
from ..muscles.muscle_file import save_muscle
from ..muscles.pneumatic_muscle import Muscle
from ..operating.operating_point import pole_texts
from ..plants.feeds import Regulator
from ..plants.hanging import HangingLoad
from ..plants.plant import Plant
from ..plants.slide import AntagonisticSlide

Counterforce: TypeAlias = Literal["pair", "load"]

GRAVITY = 9.81
LAG = 0.05
"""Of the pressure regulators [s]."""
MIDDLE = 0.4
"""Of the largest contraction: where the muscles of a pair stand in the middle, and part of the
force at half the pressure that a hanging load takes.
"""
PART = 0.5
"""Of the way that muscles of a pair can go: the motion that is planned."""
INERTIA = 200.0
"""Acceleration [m/s2] that half the pressure gives the slide between two muscles."""
LEVELS = 0.35, 0.75
"""Parts of the highest pressure at which a hanging load rests at its two stops."""
NAMES = {
    "muscle": "muscle.toml",
    "plan": "plan.npz",
    "fmu": "plant.fmu",
    "workbook": "fit.xlsx",
    "page": "report.html",
}
APART, MOST = 6.0, 0.1
"""Robust standard deviations of a residual that stands apart, and part of the cells that may."""
LEVEL = 0.05
"""Laws whose errors at lengths left out differ by less than this part are level."""


@shown
@dataclass(frozen=True, eq=False)
class Quick:
    """What :func:`quick` made of a table.

    assumptions : {step: what was taken for granted, and the argument that changes it}. doubts : all
    that a step warned of, or why it could not be done. files : {what: path}. comparison : None
    where one law was asked for; plan, linear : None where that step failed.

    Examples
    --------
    >>> made = pam.studies.quick("DMSP-20-300_static.csv", "out", rest_length=0.3)
    >>> made.plan.verified, sorted(made.files)
    (True, ['fmu', 'muscle', 'page', 'plan', 'workbook'])
    """

    table: ForceTable
    fit: ForceFit
    muscle: Muscle
    plant: Plant
    comparison: LawComparison | None
    plan: Any
    linear: Any
    assumptions: Mapping[str, str]
    doubts: tuple[str, ...]
    files: Mapping[str, Path] = field(repr=False)

    def report(self) -> str:
        """What came out, what was assumed, and what is in doubt, as text."""
        law, fit = self.fit.law.name, self.fit
        lines = [f"{law} law: {fit.n} cells, RMSE {fit.rmse:.3g} N, R2 {fit.r2:.4f}"]
        if self.plan is not None:
            lines.append(f"motion of {self.plan.duration:.3g} s, {self.plan.verdict}")
        if self.linear is not None:
            poles = ", ".join(pole_texts(self.linear.poles()))
            lines.append(f"linearised at rest: poles {poles} 1/s")
        lines += ["", "Assumed:", *(f"  {step}: {said}" for step, said in self.assumptions.items())]
        if self.doubts:
            lines += ["", "In doubt:", *(f"  {said}" for said in self.doubts)]
        lines += ["", "Written:", *(f"  {path}" for path in self.files.values())]
        return "\n".join(lines)

    __str__ = report


@verb
def quick(
    source: Any,
    into: str | os.PathLike[str],
    *,
    rest_length: float | str | None = None,
    diameter: float | str | None = None,
    law: str | Iterable[str] | None = None,
    counterforce: Counterforce = "pair",
    mass: float | str | None = None,
    stops: Sequence[float | str] | None = None,
    platforms: Iterable[str] = ("native",),
    overwrite: bool = False,
    **reading: Any,
) -> Quick:
    """Read a force table, rank the laws, fit the best, build a plant, plan its quickest motion,
    linearise it, export it, and write one page and a workbook.

    Parameters
    ----------
    source : a ForceTable, or as for :func:`pam_ocp.read_table`, which takes ``reading``, too
        (columns, units, ...).
    into : folder for muscle.toml, plan.npz, plant.fmu, report.html, fit.xlsx.
    rest_length : of the muscle [m]; where the table holds contractions 0.3 m is assumed.
    diameter : inner diameter at rest [m]; only flows through valves need it.
    law : one law, or those to rank; by default all whose constants are known.
    counterforce : "pair": a second muscle of the kind on a slide; "load": a hanging weight.
    mass : [kg]; by default from the muscle's force.
    stops : two positions [m] of the motion.
    platforms : of the FMU, as for :func:`pam_ocp.export_fmu`.
    overwrite : whether such files that are there may be replaced.

    Raises InputError where the table cannot be read or no law be fitted; what fails behind that is
    named in ``doubts``, and the rest goes on.

    Examples
    --------
    >>> made = pam.studies.quick("DMSP-20-300_static.csv", "load", rest_length=0.3,
    ...     counterforce="load", law="six-parameter")
    >>> made.fit.law.name, made.plan.verified
    ('six-parameter', True)
    """
    if counterforce not in ("pair", "load"):
        raise InputError(f"counterforce = {counterforce!r}: choose 'pair' or 'load'")
    target = Path(into)
    there = [name for name in NAMES.values() if (target / name).exists()]
    if there and not overwrite:
        raise InputError(
            f"into = {target}: {', '.join(there)} stand there; give another folder, or "
            "overwrite=True"
        )
    work = _Work(platforms)
    table, fit, comparison = work.fitted(source, rest_length, law, reading)
    muscle = work.muscle(table, fit, rest_length, diameter)
    plant = work.plant(muscle, counterforce, mass)
    motion = work.planned(plant, counterforce, stops)
    linear = work.linearised(plant, counterforce)
    things = {
        "The laws": comparison,
        "The law": fit,
        "The muscle": muscle,
        "The plant": plant,
        "The motion": motion,
        "The plant linearised": linear,
        "The table": table,
    }
    things = {heading: thing for heading, thing in things.items() if hasattr(thing, "_repr_html_")}
    files = work.written(make_folder(target), muscle, plant, motion, fit, things, source)
    doubts = tuple(dict.fromkeys(work.doubts))
    return Quick(
        table, fit, muscle, plant, comparison, motion, linear, work.assumptions, doubts, files
    )


class _Work:
    """The steps, and what they assume and doubt."""

    def __init__(self, platforms: Iterable[str]) -> None:
        self.platforms = list(platforms)
        self.assumptions: dict[str, str] = {}
        self.doubts: list[str] = []

    @contextmanager
    def _heard(self, step: str, needed: bool = False) -> Iterator[None]:
        """Warnings become doubts, and so do errors of what the rest can do without."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                yield
            except PamError as error:
                if needed:
                    raise
                self.doubts.append(f"{step}: {error}")
        own = (UserWarning, RuntimeWarning)
        self.doubts += [f"{step}: {w.message}" for w in caught if issubclass(w.category, own)]

    def fitted(
        self, source: Any, rest_length: Any, law: Any, reading: Mapping[str, Any]
    ) -> tuple[ForceTable, ForceFit, LawComparison | None]:
        length = None if rest_length is None else quantity("rest_length", rest_length, "m")
        if isinstance(source, ForceTable):
            table = source
            if reading:
                raise InputError(f"{', '.join(reading)}: a ForceTable has been read already")
        else:
            with self._heard("reading", needed=True):
                table = read_table(source, rest_length=length, **reading)
        named = [law] if isinstance(law, str) else law
        with self._heard("law", needed=True):
            comparison = compare_laws(table, named)
            best = comparison.best
            if best.fit is None:
                whys = [each.problem for each in comparison.laws]
                why = next((w for w in whys if not w.startswith("needs ")), whys[0])
                raise FitError(f"no law could be fitted: {why}")
            self.doubts += [f"law: {said}" for said in (*best.fit.warnings, *_outliers(best.fit))]
        self.assumptions["law"] = (
            f"{best.name}, the best of {len(comparison.laws)} at lengths left out (law=)"
        )
        level = [
            other.name
            for other in comparison.laws[1:]
            if other.fit and other.left_out_rmse < (1 + LEVEL) * best.left_out_rmse
        ]
        if level:
            self.doubts.append(f"law: as good at lengths left out: {', '.join(level)} (law=)")
        return table, best.fit, comparison if len(comparison.laws) > 1 else None

    def muscle(self, table: ForceTable, fit: ForceFit, length: Any, diameter: Any) -> Muscle:
        known = table.rest_length if length is None else quantity("rest_length", length, "m")
        if known is None:
            known = 0.3
            self.assumptions["muscle"] = "0.3 m long at rest (rest_length=)"
        wide = None if diameter is None else quantity("diameter", diameter, "m")
        name = Path(table.source).stem if table.source else "muscle"
        with self._heard("muscle", needed=True):
            return fit.muscle(rest_length=known, diameter=wide, name=name)

    def plant(self, muscle: Muscle, counterforce: Counterforce, mass: Any) -> Plant:
        top = muscle.pressure_range[1]
        most = min(float(muscle.max_contraction(top)), muscle.contraction_range[1])
        middle = max(MIDDLE * most, muscle.contraction_range[0] + 0.01)
        force = float(muscle.force(top, middle)) / 2
        if mass is None:
            mass = MIDDLE * force / GRAVITY if counterforce == "load" else force / INERTIA
            mass = float(f"{mass:.2g}")
            self.assumptions["mass"] = f"{mass:g} kg, from the muscle's force (mass=)"
        mass = quantity("mass", mass, "kg")
        self.assumptions["pressure"] = f"regulators with a lag of {LAG:g} s, 0 .. {top / 1e5:g} bar"
        feed = Regulator(LAG, max_pressure=top)
        with self._heard("plant", needed=True):
            if counterforce == "load":
                self.assumptions["plant"] = "a load hangs on the muscle (counterforce=)"
                return HangingLoad(muscle, mass, feed=feed, name="plant")
            self.assumptions["plant"] = (
                f"two such muscles on a slide, each contracted by {100 * middle:.3g} % in the "
                "middle (counterforce=)"
            )
            return AntagonisticSlide(muscle, mass, float(f"{middle:.3g}"), feed=feed, name="plant")

    def planned(self, plant: Plant, counterforce: Counterforce, stops: Any) -> Any:
        from ..planning.planner import plan

        found = None
        with self._heard("motion"):
            if stops is None:
                ends = _stops(plant, counterforce)
                said = f"{1e3 * ends[0]:.3g} to {1e3 * ends[1]:.3g} mm"
                self.assumptions["motion"] = f"the quickest from {said} (stops=)"
            else:
                ends = [quantity("stops", x, "m") for x in stops]
            found = plan(plant, [{"x": x} for x in ends])
            if not found.verified:
                self.doubts.append(f"motion: {found.verdict}")
        return found

    def linearised(self, plant: Plant, counterforce: Counterforce) -> Any:
        from ..operating.linear import linearize
        from ..operating.resting_point import equilibrium

        name = "muscle1.pressure" if counterforce == "pair" else "muscle.pressure"
        half = plant.variable(name).max / 2
        found = None
        with self._heard("linearisation"):
            self.assumptions["linearisation"] = f"at rest with {name} = {half / 1e5:.3g} bar"
            point = {name: half} | ({"x": 0.0} if counterforce == "pair" else {})
            found = linearize(plant, equilibrium(plant, point))
        return found

    def written(
        self,
        folder: Path,
        muscle: Muscle,
        plant: Plant,
        motion: Any,
        fit: ForceFit,
        things: Mapping[str, Any],
        source: Any,
    ) -> dict[str, Path]:
        """{what: file} in a folder."""
        from ..export.package import export_fmu
        from ..figures.report import write_report

        platforms = self.platforms
        self.assumptions["FMU"] = f"FMI 2.0 for {', '.join(platforms)} (platforms=)"
        steps: dict[str, Callable[[Path], Any]] = {
            "muscle": lambda path: save_muscle(muscle, path),
            "plan": lambda path: motion.save(path),
            "fmu": lambda path: export_fmu(plant, path, platforms=platforms),
            "workbook": lambda path: fit.to_excel(path),
        }
        if motion is None:
            del steps["plan"]
        files = {}
        for what, write in steps.items():
            with self._heard(what):
                write(folder / NAMES[what])
                files[what] = folder / NAMES[what]
        named = source if isinstance(source, str | os.PathLike) else fit.table.source or "a table"
        name = Path(named).name
        said = [
            f"{step[0].upper()}{step[1:]}: {words}." for step, words in self.assumptions.items()
        ]
        doubts = [f"In doubt, {words}." for words in dict.fromkeys(self.doubts)]
        made_from = isinstance(source, str | os.PathLike) and Path(source).is_file()
        write_report(
            folder / NAMES["page"],
            things,
            title=f"From {name} to a motion",
            text="\n\n".join([*said, *doubts]),
            sources=[source] if made_from else [],
        )
        return files | {"page": folder / NAMES["page"]}


def _outliers(fit: ForceFit) -> list[str]:
    """Cells that stand apart from the law fitted to the others, in standard deviations by the
    median and the 90 % quantile of the residuals.
    """
    try:
        robust = fit_force(fit.table, type(fit.law), loss="bisquare")
    except PamError:
        return []
    size = np.abs(robust.residuals - np.median(robust.residuals))
    # by the quantile, too: a law that is not quite right has more residuals beyond the median's
    middle, high = np.median(size), np.quantile(size, 1 - MOST, method="lower")
    apart = np.flatnonzero(size > APART * max(middle / 0.6745, high / 1.645))
    if not len(apart):
        return []
    cells = fit.cells
    named = "; ".join(
        f"{cells.pressure[i] / 1e5:.3g} bar, {100 * cells.contraction[i]:.3g} %, "
        f"{cells.force[i]:.4g} N"
        for i in apart[:3]
    )
    return [
        f"{len(apart)} cell(s) stand apart from the law, as wrong ones do ({named}); correct them, "
        "or fit with loss='bisquare'"
    ]


def _stops(plant: Plant, counterforce: Counterforce) -> list[float]:
    """Two positions [m] that the plant can rest at."""
    from ..operating.resting_point import equilibrium

    if counterforce == "pair":
        variable = plant.variable("x")
        far = float(f"{PART * min(-variable.min, variable.max):.2g}")
        return [-far, far]
    top = plant.variable("muscle.command").max
    points = [equilibrium(plant, {"muscle.command": part * top})["x"] for part in LEVELS]
    return [float(f"{x:.2g}") for x in points]

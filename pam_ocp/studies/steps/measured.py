"""Steps that begin with measurements: a static table, a force law fitted to it, a muscle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar, get_args

from ...core.errors import InputError, UnknownNameError
from ...core.quantities import quantity, table
from .step import STEPS, Job, Made, Step, doubts, intervals_said, text_of, write_intervals

if TYPE_CHECKING:
    from ...fitting.tables.force_table import ForceTable
    from ...muscles.pneumatic_muscle import Muscle

_WORDS = (
    *("columns", "units", "sheet", "skip", "pick", "pivot", "delimiter", "decimal", "empty"),
    *("encoding", "bad_lines", "constants", "pattern", "missing", "floor"),
)


@STEPS.register("table")
class TableStep(Step):
    """A measured static table: pressure, length or contraction, force."""

    stage = "measured"
    needs = ("file",)
    keys = ("file", "rest_length", "ambient_pressure", *_WORDS, "ramp", "without")
    offers: ClassVar[Mapping[str, str]] = {"table": "table.csv"}
    whole = True

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        return {"table": cls.read("table", job)}

    @classmethod
    def read(cls, noun: str, job: Job) -> ForceTable:
        """From the measured file itself."""
        from ...fitting.tables.force_table import read_table

        name = text_of(job, "file")
        beside = job.folder / name
        given = {n: job.said[n] for n in (*_WORDS, "ramp") if n in job.said}
        for key, unit in (("rest_length", "m"), ("ambient_pressure", "Pa")):
            if key in job.said:
                given[key] = job.si(key, unit)
        found = read_table(str(beside) if beside.exists() else name, **given)
        return _without(found, job.listed("without"))

    @classmethod
    def work(cls, job: Job) -> Made:
        found = cls.read("table", job)
        columns = {
            "pressure [Pa]": found.pressure,
            "contraction [1]": found.contraction,
            "force [N]": found.force,
        }
        labels = {n: getattr(found, n) for n in ("branch", "run") if getattr(found, n)}
        rows = zip(*columns.values(), *labels.values(), strict=True)
        job.table("table.csv", [*columns, *labels], rows)
        numbers = {"cells": (float(len(found)), "1")}
        return Made(found, f"{len(found)} cells read", numbers=numbers, sure=found.notes)


def _without(measured: ForceTable, cells: list[Any]) -> ForceTable:
    """The table less these cells, which count from 0 in the order that they were read in."""
    for cell in cells:
        if isinstance(cell, bool) or not isinstance(cell, int) or not 0 <= cell < len(measured):
            raise InputError(
                f"without: {cell!r} is no cell of the table; give whole numbers from 0 to "
                f"{len(measured) - 1}"
            )
    if len(set(cells)) == len(measured):
        raise InputError(f"without names all {len(measured)} cells of the table: leave some")
    return measured.subset([i not in set(cells) for i in range(len(measured))])


def fixed_values(laws: Iterable[str], said: Any) -> dict[str, float]:
    """Coefficients of laws that are held, in SI."""
    from ...fitting.static.static import law_class

    units = {v.name: v.unit for law in laws for v in law_class(law).coefficient_variables()}
    return {
        n: quantity(f"fixed.{n}", v, units.get(n, "1")) for n, v in table("fixed", said).items()
    }


@STEPS.register("fit")
class FitStep(Step):
    """A force law fitted to a measured table, with intervals."""

    stage = "fitted"
    parts: ClassVar[Mapping[str, str]] = {"table": "table"}
    needs = ("table",)
    keys = ("law", "fixed", "loss", "rest_length", "diameter", "name")
    offers: ClassVar[Mapping[str, str]] = {"muscle": "muscle.toml"}

    @classmethod
    def _fixed(cls, job: Job) -> dict[str, float]:
        said = job.get("law", "six-parameter")
        return fixed_values(said if isinstance(said, list) else [said], job.get("fixed", {}))

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        from ...fitting.static.least_squares import Loss
        from ...fitting.static.static import law_class
        from ...muscles.catalogue import muscle

        said = job.get("law", "six-parameter")
        kinds = [law_class(law) for law in (said if isinstance(said, list) else [said])]
        kind, known = kinds[0], {v.name for k in kinds for v in k.coefficient_variables()}
        for name in cls._fixed(job):
            if name not in known:
                raise UnknownNameError("fixed: coefficient", name, sorted(known))
        if job.get("loss", "squares") not in get_args(Loss):
            raise UnknownNameError("loss", job.said["loss"], get_args(Loss))
        length = job.si("rest_length", "m") or job.parts["table"].rest_length
        if length is None:
            raise InputError("rest_length is missing: the table holds none; give it here or there")
        usual = muscle("DMSP-20-300")
        law = usual.law
        if kind is not type(law):
            nominal = {v.name: v.nominal for v in kind.coefficient_variables()}
            own = {"rest_length": length} if "rest_length" in nominal else {}
            law = kind(**{**nominal, **own})
        diameter = job.si("diameter", "m")
        return {"muscle": replace(usual, law=law, rest_length=length, diameter=diameter)}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...fitting.static.static import compare_laws, fit_force
        from ...muscles.muscle_file import save_muscle

        measured, law = job.parts["table"], job.get("law", "six-parameter")
        fixed = cls._fixed(job)
        text = ""
        if isinstance(law, list):
            ranking = compare_laws(measured, law, fixed=fixed)
            text, best = f"{ranking}\n\n", ranking.best.fit
            if best is None:
                raise InputError(f"law: none of them could be fitted: {ranking.best.problem}")
            fit = best
        else:
            fit = fit_force(measured, law, fixed=fixed, loss=job.get("loss", "squares"))
        muscle = fit.muscle(
            rest_length=job.si("rest_length", "m"),
            diameter=job.si("diameter", "m"),
            name=job.get("name", job.name),
        )
        save_muscle(muscle, job.out / "muscle.toml")
        fit.to_json(job.out / "fit.json")
        job.workbook(fit, "fit.xlsx")
        job.save(fit.plot())
        write_intervals(fit, job, "coefficients.csv", "coefficient")
        numbers = {"rmse": (fit.rmse, "N"), "r2": (fit.r2, "1")}
        return Made(
            fit,
            f"RMSE {fit.rmse:.4g} N over {fit.n} taut cells{doubts(fit.warnings)}",
            True,
            numbers | {c.name: (c.value, c.unit) for c in fit.coefficients.values()},
            (*intervals_said(fit), *fit.warnings),
            text + fit.report(),
        )


@STEPS.register("muscle")
class MuscleStep(Step):
    """A muscle of the catalogue, or of a muscle file."""

    stage = "assumed"
    needs = ("name",)
    keys = ("name", "rest_length")
    offers: ClassVar[Mapping[str, str]] = {"muscle": "muscle.toml"}

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        return {"muscle": cls._muscle(job)}

    @classmethod
    def _muscle(cls, job: Job) -> Muscle:
        from ...muscles.muscle_file import ENDINGS
        from ...plants.plant_file import muscle_of

        name = text_of(job, "name")
        if name.endswith(ENDINGS) and "rest_length" not in job.said:
            return muscle_of(name, "name", job.folder)
        return muscle_of(dict(job.said), "muscle", job.folder)

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...muscles.muscle_file import save_muscle

        muscle = cls._muscle(job)
        save_muscle(muscle, job.out / "muscle.toml")
        job.save(muscle.plot())
        return Made(muscle, f"{muscle.obtained}: {muscle.law.title}")

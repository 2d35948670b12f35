"""Steps that make plants: one described in words, one whose parameters are fitted to records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import tomli_w

from ...core.errors import InputError
from ...core.files import read_toml, require_file
from ..plant_fit_problem import FITTING, READING, fit_arguments, records_of
from .step import STEPS, Job, Made, Step, csv_text, doubts

if TYPE_CHECKING:
    from ...fitting.dynamic.plant_fit import PlantFit
    from ...plants.plant import Plant

__all__ = ["FitPlantStep", "PlantStep", "copy_plant", "plant_in"]

FILE = "plant.toml"
_MUSCLES = ("muscle", "muscle2")


@STEPS.register("plant")
class PlantStep(Step):
    """A plant: an arrangement of muscles with load, feed and losses."""

    stage = "assumed"
    parts: ClassVar[Mapping[str, str]] = dict.fromkeys(_MUSCLES, "muscle")
    loose = _MUSCLES
    needs = ("arrangement", "muscle")
    keys = ("arrangement", "*")
    offers: ClassVar[Mapping[str, str]] = {"plant": FILE}

    @classmethod
    def _plant(cls, job: Job) -> Plant:
        from ...plants.plant_file import plant_of

        content = {**job.said, **job.parts}
        return plant_of(content, "plant", job.folder, allow_code=job.allow_code)

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        return {"plant": cls._plant(job)}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...muscles.muscle_file import save_muscle
        from ...plants.plant_file import muscle_of

        plant, content = cls._plant(job), dict(job.said)
        for key in _MUSCLES:
            if key in content:
                given = job.parts.get(key) or content[key]
                save_muscle(muscle_of(given, key, job.folder), job.out / f"{key}.toml")
                content[key] = f"{key}.toml"
        file, colon, member = str(content["arrangement"]).rpartition(":")
        if colon:
            copied = job.out / Path(file).name
            copied.write_bytes((job.folder / file).read_bytes())
            content["arrangement"] = f"{copied.name}:{member}"
        (job.out / FILE).write_text(tomli_w.dumps({"plant": content}), "utf-8")
        return Made(plant, plant.description)

    @classmethod
    def read(cls, noun: str, job: Job) -> Plant:
        return plant_in(job)


def plant_in(job: Job) -> Plant:
    """The plant of a step's own file."""
    from ...plants.plant_file import plant_of

    path = job.out / FILE
    return plant_of(read_toml(path)["plant"], "plant", path.parent, allow_code=job.allow_code)


@STEPS.register("fit-plant")
class FitPlantStep(Step):
    """Parameters of a plant fitted to measured records, and validated on others."""

    stage = "fitted"
    parts: ClassVar[Mapping[str, str]] = {"plant": "plant"}
    needs = ("plant", "records", "free")
    keys = ("records", "validate", "free", *READING, *FITTING)
    offers: ClassVar[Mapping[str, str]] = {"plant": FILE}

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        plant = job.parts["plant"]
        for name in ("records", "validate"):
            for file in job.listed(name):
                require_file(job.folder / file)
        for name in job.listed("free"):
            if "*" not in name:
                plant.variable(name)
        fit_arguments(job.said, plant)
        return {"plant": plant}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...fitting.dynamic.dynamic import fit_plant

        plant = job.parts["plant"]
        records, others = (
            records_of(job.said, plant, [job.folder / n for n in job.listed(name)])
            for name in ("records", "validate")
        )
        if not records:
            raise InputError("records is empty: name at least one file")
        fit = fit_plant(plant, records, job.listed("free"), **fit_arguments(job.said, plant))
        fit.save(job.out / "fit.json")
        job.save(fit.plot())
        checked = fit.validate(others) if others else []
        for number, comparison in enumerate(checked, start=1):
            job.save(comparison.plot(), f"validation{number}.png")
        _write_values(fit, job.out / "values.csv")
        _write_plant(fit, job)
        text = "\n".join([fit.report(), *(f"[[Validation]]\n{c}" for c in checked)])
        numbers = {f"rmse.{n}": (e, plant.variable(n).unit) for n, e in fit.rmse.items()}
        numbers |= {c.name: (c.value, c.unit) for c in fit.coefficients.values()}
        said = ", ".join(f"{n} {p:.1f} %" for n, p in fit.fit_percent.items())
        said += doubts(fit.warnings)
        return Made(fit, f"fit {said}", True, numbers, _sure(fit, checked), text)

    @classmethod
    def read(cls, noun: str, job: Job) -> Plant:
        return plant_in(job)


def _write_plant(fit: PlantFit, job: Job) -> None:
    """The plant's own file with the fitted values, and what lies beside it."""
    content = dict(read_toml(copy_plant(job))["plant"])
    before = {v.name: v.start for v in job.parts["plant"].parameters}
    fitted = {v.name: v.start for v in fit.plant.parameters if v.start != before[v.name]}
    content["set"] = {**content.get("set", {}), **fitted}
    (job.out / FILE).write_text(tomli_w.dumps({"plant": content}), "utf-8")


def copy_plant(job: Job) -> Path:
    """The plant's own file, and what lies beside it, among those of a step that stands on it."""
    for path in sorted(job.sources["plant"].iterdir()):
        if path.suffix in (".toml", ".py"):
            (job.out / path.name).write_bytes(path.read_bytes())
    return job.out / FILE


def _write_values(fit: PlantFit, path: Path) -> None:
    intervals = fit.intervals()
    rows = [
        (c.name, c.value, c.stderr, *intervals.get(c.name, (c.value, c.value)), c.unit)
        for c in fit.coefficients.values()
    ]
    path.write_text(csv_text(("name", "value", "stderr", "low", "high", "unit"), rows), "utf-8")


def _sure(fit: PlantFit, checked: list[Any]) -> tuple[str, ...]:
    wide = [
        f"{n} lies in {low:.5g} .. {high:.5g} {fit.coefficients[n].unit} (95 %)"
        for n, (low, high) in fit.intervals().items()
    ]
    others = [
        f"another record is met in {a.name} by {a.fit_percent:.1f} %"
        for c in checked
        for a in c.agreements
    ]
    return (*wide, *others, *fit.warnings)

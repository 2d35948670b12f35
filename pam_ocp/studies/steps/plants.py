"""Steps that make plants: one described in words, one whose parameters are fitted to records."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import tomli_w

from ...core.errors import InputError
from ...core.files import read_toml, require_file, write_json
from ...core.quantities import table
from ..problem import FITTING, READING, fit_arguments, records_of
from .step import (
    STEPS,
    Job,
    Made,
    Step,
    doubts,
    in_si,
    intervals_said,
    values,
    write_intervals,
)

if TYPE_CHECKING:
    from ...fitting.dynamic.plant_fit import PlantFit
    from ...plants.plant import Plant

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
        write_intervals(fit, job, "values.csv")
        _write_plant(fit, job)
        text = "\n".join([fit.report(), *(f"[[Validation]]\n{c}" for c in checked)])
        numbers = {f"rmse.{n}": (e, plant.variable(n).unit) for n, e in fit.rmse.items()}
        numbers |= {c.name: (c.value, c.unit) for c in fit.coefficients.values()}
        said = ", ".join(f"{n} {p:.1f} %" for n, p in fit.fit_percent.items())
        said += doubts(fit.warnings)
        return Made(fit, f"fit {said}", True, numbers, _sure(fit, checked), text)


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


def _sure(fit: PlantFit, checked: list[Any]) -> tuple[str, ...]:
    others = [
        f"another record is met in {a.name} by {a.fit_percent:.1f} %"
        for c in checked
        for a in c.agreements
    ]
    return (*intervals_said(fit), *others, *fit.warnings)


@STEPS.register("linearize")
class LinearizeStep(Step):
    """An equilibrium and the linear model about it: poles, frequencies, matrices."""

    parts: ClassVar[Mapping[str, str]] = {"plant": "plant"}
    needs = ("plant",)
    keys = ("rest", "inputs", "outputs", "si")

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        plant = job.parts["plant"]
        values("rest", plant, job.get("rest", {}))
        for key in ("inputs", "outputs"):
            for name in job.listed(key):
                plant.variable(name)
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...figures.trajectory import plot_bode
        from ...operating.linear import linear_model, modes

        plant = job.parts["plant"]
        rest = values("rest", plant, table("rest", job.get("rest", {})))
        point = plant.equilibrium(rest or {v.name: v.start or 0.0 for v in plant.inputs})
        chosen: dict[str, Any] = {n: job.listed(n) or None for n in ("inputs", "outputs")}
        chosen["units"] = None if job.get("si") else "display"
        system = linear_model(plant, point, stuck=True, **chosen)
        found = modes(system)
        matrices = {n: getattr(system, n).tolist() for n in "ABCD"}
        labels = {n: getattr(system, f"{n}_labels") for n in ("state", "input", "output")}
        write_json(job.out / "linear.json", {**labels, "units": dict(system.units), **matrices})
        poles = [(float(p.real), float(p.imag)) for p in point.poles]
        job.table("poles.csv", ("real [1/s]", "imaginary [1/s]"), poles)
        output, source = system.output_labels[0], system.input_labels[0]
        shown = system.units[output], system.units[source]
        job.save(plot_bode({plant.name: system}, output, source, units=shown))
        numbers = {v: (point.values[v], plant.variable(v).unit) for v in point.values}
        for i, (hertz, ratio) in enumerate(found, start=1):
            numbers |= {f"frequency{i}": (hertz, "Hz"), f"damping_ratio{i}": (ratio, "1")}
        said = "; ".join(f"{f:.3g} Hz, damping ratio {z:.3g}" for f, z in found)
        verdict = ", ".join(filter(None, (point.stability, said)))
        return Made(point, verdict, point.stability != "unstable", numbers, (), str(point))


@STEPS.register("loads")
class LoadsStep(Step):
    """Equilibrium, vibration and settling of a muscle over load and pressure."""

    parts: ClassVar[Mapping[str, str]] = {"muscle": "muscle"}
    loose = ("muscle",)
    needs = ("muscle",)
    keys = ("masses", "pressures", "duration")

    @classmethod
    def _arguments(cls, job: Job) -> dict[str, Any]:
        given = (("masses", "kg"), ("pressures", "Pa"))
        found: dict[str, Any] = {n: in_si(n, job.said[n], u) for n, u in given if n in job.said}
        if "duration" in job.said:
            found["duration"] = job.si("duration", "s")
        return found

    @classmethod
    def _muscle(cls, job: Job) -> Any:
        from ...plants.plant_file import muscle_of

        return muscle_of(job.parts.get("muscle") or job.said["muscle"], "muscle", job.folder)

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        cls._arguments(job)
        cls._muscle(job)
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ..loads import load_study

        found = load_study(cls._muscle(job), **cls._arguments(job))
        found.save(job.out / "loads.csv")
        job.save(found.plot())
        carried = sum(c.position == c.position for c in found.cases)
        return Made(found, f"{carried} of {len(found.cases)} loads are carried", text=str(found))

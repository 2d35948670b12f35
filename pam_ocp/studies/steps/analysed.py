"""Steps that look at a plant or a muscle: linear models, loads, and motion-free figures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from ...core.files import write_json
from ...core.quantities import table
from .step import STEPS, Job, Made, Step, csv_text, in_si, values

__all__ = ["LinearizeStep", "LoadsStep"]


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
        head = ("real [1/s]", "imaginary [1/s]")
        (job.out / "poles.csv").write_text(csv_text(head, poles), "utf-8")
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

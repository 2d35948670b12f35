"""Steps that leave Python: units (FMU), systems (SSP), controllers in C; the check of a unit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from ...core.errors import InputError, UnknownNameError
from ...core.files import require_file, write_json
from ...core.quantities import quantity, table
from .step import STEPS, Job, Made, Step, seconds, text_of

if TYPE_CHECKING:
    from ...core.trajectory import Trajectory

_CHOSEN = ("platforms", "inputs", "outputs")


def _platforms(job: Job) -> list[str] | None:
    """What a unit is built for. Raises UnknownNameError."""
    from ...export.compile import PLATFORMS

    names = job.listed("platforms")
    for name in names:
        if name not in (*PLATFORMS, "native"):
            raise UnknownNameError("platforms", name, [*PLATFORMS, "native"])
    return names or None


def _fmi(job: Job) -> Any:
    """Raises InputError for what is no version."""
    version = job.get("fmi", "2.0")
    if version not in ("2.0", "3.0"):
        raise InputError(f"fmi = {version!r}: give '2.0' or '3.0'")
    return version


def _times(job: Job, *keys: str) -> dict[str, float]:
    return {key: seconds(job, key) for key in keys if key in job.said}


def _kilobytes(path: Path) -> str:
    return f"{path.stat().st_size / 1e3:.0f} kB"


@STEPS.register("export")
class ExportStep(Step):
    """A plant as an FMU for Model Exchange and Co-Simulation, or a controller as a sampled FMU."""

    parts: ClassVar[Mapping[str, str]] = {"plant": "plant", "controller": "controller"}
    keys = ("fmi", "step_size", *_CHOSEN)
    offers: ClassVar[Mapping[str, str]] = {"fmu": "plant.fmu"}

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        if len(job.parts) != 1:
            raise InputError("give plant or controller, and one of them only")
        _fmi(job)
        _platforms(job)
        _times(job, "step_size")
        for key in ("inputs", "outputs", "step_size") if "controller" in job.parts else ():
            if key in job.said:
                raise InputError(f"{key}: that of a controller is its own; leave it out")
        for key in ("inputs", "outputs"):
            for name in job.listed(key):
                job.parts["plant"].variable(name)
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...export import export_fmu

        fmi, platforms = _fmi(job), _platforms(job)
        thing = job.parts.get("plant") or job.parts["controller"]
        chosen: dict[str, Any] = {n: job.listed(n) for n in ("inputs", "outputs") if n in job.said}
        chosen |= _times(job, "step_size")
        path = export_fmu(thing, job.out / "plant.fmu", fmi=fmi, platforms=platforms, **chosen)
        return Made(None, f"FMI {fmi}, {_kilobytes(path)}")


@STEPS.register("export-c")
class ExportCStep(Step):
    """A controller as C99 source, with a program that tests itself."""

    parts: ClassVar[Mapping[str, str]] = {"controller": "controller"}
    needs = ("controller",)
    keys = ("precision", "name")

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        if job.get("precision", "double") not in ("double", "single"):
            raise InputError(f"precision = {job.said['precision']!r}: give 'double' or 'single'")
        if "name" in job.said:
            text_of(job, "name")
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...export import export_c

        said = {k: job.said[k] for k in cls.keys if k in job.said}
        folder = export_c(job.parts["controller"], job.out / "c", **said)
        sizes = [p.stat().st_size for p in folder.rglob("*.c")]
        return Made(None, f"{len(sizes)} files of C, {sum(sizes) / 1e3:.0f} kB")


@STEPS.register("export-ssp")
class ExportSspStep(Step):
    """A plant with a motion that plays its inputs, or with a controller, as a system (SSP)."""

    parts: ClassVar[Mapping[str, str]] = {
        "plant": "plant",
        "motion": "motion",
        "controller": "controller",
    }
    needs = ("plant",)
    keys = ("connections", "hold", "fmi", "platforms", "step_size", "stop_time")

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        _fmi(job)
        _platforms(job)
        _times(job, "step_size", "stop_time")
        said = table("connections", job.get("connections", {}))
        held = table("hold", job.get("hold", {}))
        if not said and set(job.parts) != {"plant", "motion"}:
            raise InputError(
                "connections is missing: without it a motion alone plays the plant's inputs; give "
                "{ 'plant.INPUT' = 'controller.OUTPUT' }"
            )
        for wire in (*said, *said.values(), *held):
            if str(wire).partition(".")[0] not in job.parts:
                raise UnknownNameError("connections: component", str(wire), list(job.parts))
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...export import export_ssp

        parts, times = dict(job.parts), _times(job, "step_size", "stop_time")
        wires = dict(job.get("connections", {}))
        if not wires:
            wires = {f"plant.{v.name}": f"motion.{v.name}" for v in parts["plant"].inputs}
        if "motion" in parts:
            times = {"stop_time": parts["motion"].duration, **times}
        if held := job.get("hold", {}):
            parts["held"], more = _held(held, parts)
            wires |= more
        options = {"fmi": _fmi(job), "platforms": _platforms(job), **times}
        path = export_ssp(parts, wires, job.out / "system.ssp", **options)
        return Made(None, f"{len(parts)} components, {_kilobytes(path)}")


def _held(said: Mapping[str, Any], parts: Mapping[str, Any]) -> tuple[Trajectory, dict[str, str]]:
    """(a motion that holds inputs of components at values, its wires). Raises UnknownNameError."""
    from dataclasses import replace

    from ...control.blocks.running import block
    from ...core.trajectory import Trajectory

    variables, values, wires = [], {}, {}
    for key, value in said.items():
        component, _, name = key.partition(".")
        owner = parts[component] if component == "plant" else block(parts[component])
        inputs = {v.name: v for v in owner.inputs}
        if name not in inputs:
            raise UnknownNameError(f"hold: input of {component}", name, list(inputs))
        variables.append(replace(inputs[name], name=key))
        values[key] = [quantity(f"hold.{key}", value, inputs[name].unit)] * 2
        wires[key] = f"held.{key}"
    return Trajectory([0.0, 1.0], values, variables), wires


@STEPS.register("check")
class CheckStep(Step):
    """An FMU validated, run by another tool, and compared with a motion."""

    stage = "verified"
    parts: ClassVar[Mapping[str, str]] = {"fmu": "fmu", "against": "motion"}
    loose = ("fmu",)
    needs = ("fmu",)
    keys = ("tolerance",)

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        quantity("tolerance", job.get("tolerance", 1e-6))
        if "fmu" not in job.parts:
            from ...plants.plant_file import require_allowed

            name = job.said["fmu"]
            require_file(job.folder / str(name))
            require_allowed(
                f"fmu = {name!r} would run the machine code of that FMU", job.allow_code
            )
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...export import check_fmu

        path = job.parts.get("fmu") or job.folder / str(job.said["fmu"])
        tolerance = quantity("tolerance", job.get("tolerance", 1e-6))
        found = check_fmu(path, against=job.parts.get("against"), tolerance=tolerance)
        write_json(job.out / "check.json", found.to_dict())
        said = "nothing was found" if found.ok else found.findings[0]
        sure = [
            f"{m}: within {max(d.values()):.1e} (scaled by nominals)"
            for m, d in found.deviations.items()
        ]
        numbers = {"largest": (found.largest, "1")}
        return Made(found, said, found.ok, numbers, sure, str(found))

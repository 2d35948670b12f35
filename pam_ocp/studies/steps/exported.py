"""Steps that leave Python: a plant as an FMU, and the check of an FMU."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from ...core.errors import InputError, UnknownNameError
from ...core.files import require_file, write_json
from ...core.quantities import quantity
from .step import STEPS, Job, Made, Step

__all__ = ["CheckStep", "ExportStep"]

_CHOSEN = ("platforms", "inputs", "outputs")


@STEPS.register("export")
class ExportStep(Step):
    """A plant as an FMU for Model Exchange and Co-Simulation."""

    parts: ClassVar[Mapping[str, str]] = {"plant": "plant"}
    needs = ("plant",)
    keys = ("fmi", *_CHOSEN)
    offers: ClassVar[Mapping[str, str]] = {"fmu": "plant.fmu"}

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        from ...export.compile import PLATFORMS

        if job.get("fmi", "2.0") not in ("2.0", "3.0"):
            raise InputError(f"fmi = {job.said['fmi']!r}: give '2.0' or '3.0'")
        for name in job.listed("platforms"):
            if name not in (*PLATFORMS, "native"):
                raise UnknownNameError("platforms", name, [*PLATFORMS, "native"])
        for key in ("inputs", "outputs"):
            for name in job.listed(key):
                job.parts["plant"].variable(name)
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...export import export_fmu

        fmi = job.get("fmi", "2.0")
        chosen: dict[str, Any] = {n: job.listed(n) or None for n in _CHOSEN}
        path = export_fmu(job.parts["plant"], job.out / "plant.fmu", fmi=fmi, **chosen)
        return Made(None, f"FMI {fmi}, {path.stat().st_size / 1e3:.0f} kB")


@STEPS.register("check")
class CheckStep(Step):
    """An FMU validated, run by another tool, and held against a motion."""

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
            f"{m}: within {max(d.values()):.1e} of nominal" for m, d in found.deviations.items()
        ]
        numbers = {"largest": (found.largest, "1")}
        return Made(found, said, found.ok, numbers, sure, str(found))

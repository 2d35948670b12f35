"""Steps with controllers: one designed about a plant, and its run in closed loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import tomli_w

from ...core.errors import InputError
from ...core.quantities import known_keys, table
from ..loop_problem import (
    DEFAULTS,
    controller_of,
    loop_settings,
    loop_text,
    require_spans,
    run_loop,
)
from .motions import Moves, write_motion
from .plants import copy_plant, plant_in
from .step import STEPS, Job, Made, Step, ends, values

__all__ = ["ControllerStep", "LoopStep"]

FILE = "controller.toml"


def _require_kind(name: str, said: Any, usual: str, *more: str) -> Mapping[str, Any]:
    """What is known of a table with its ``kind``: the arguments by name.

    Raises InputError for kinds and keys that are unknown.
    """
    from ...control.kinds import CONTROLLERS, ESTIMATORS

    kinds = {"controller": CONTROLLERS, "estimator": ESTIMATORS}[name]
    given = dict(table(name, said))
    kind = given.pop("kind", usual)
    if kind in more:
        return {}
    known = kinds.name(f"{name}.kind", kind, *more)
    known_keys(f"{name} ({known})", given, [*kinds.arguments(known), "kind"])
    return kinds.arguments(known)


@STEPS.register("controller")
class ControllerStep(Step):
    """A controller designed for a plant, about an equilibrium where its kind asks for one."""

    parts: ClassVar[Mapping[str, str]] = {"plant": "plant"}
    needs = ("plant", "controller")
    keys = ("controller", "rest")
    offers: ClassVar[Mapping[str, str]] = {"controller": FILE}

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        known = _require_kind("controller", job.said["controller"], "mpc")
        rest = values("rest", job.parts["plant"], job.get("rest", {}))
        if "at" in known and not (rest or "at" in job.said["controller"]):
            raise InputError(
                "rest is missing: this controller is about an equilibrium; give its conditions, "
                'as rest = { x = "10 mm" }'
            )
        return {"controller": None}

    @classmethod
    def _made(cls, job: Job, plant: Any) -> Any:
        rest = values("rest", plant, job.get("rest", {}))
        point = plant.equilibrium(rest) if rest else None
        return controller_of(plant, point, job.said["controller"], {})

    @classmethod
    def work(cls, job: Job) -> Made:
        made = cls._made(job, job.parts["plant"])
        copy_plant(job)
        said = {k: job.said[k] for k in cls.keys if k in job.said}
        (job.out / FILE).write_text(tomli_w.dumps(said), "utf-8")
        return Made(made, f"{type(made).__name__}, a step every {made.sample_time * 1e3:g} ms")

    @classmethod
    def read(cls, noun: str, job: Job) -> Any:
        return cls._made(job, plant_in(job))


@STEPS.register("loop")
class LoopStep(Moves):
    """A controller in closed loop, with an estimator if there is one, against the plant."""

    stage = "verified"
    parts: ClassVar[Mapping[str, str]] = {
        "plant": "plant",
        "controller": "controller",
        "against": "plant",
    }
    loose = ("controller", "against")
    needs = ("plant",)
    keys = tuple(n for n in DEFAULTS if n not in ("plant", "muscle", "set"))

    @classmethod
    def _settings(cls, job: Job) -> dict[str, Any]:
        said = {n: v for n, v in job.said.items() if n not in job.parts}
        settings: dict[str, Any] = {**loop_settings("the loop", said), **job.parts}
        against = settings["against"]
        if "against" not in job.parts and against not in ("plant", "fmu"):
            raise InputError(
                f"against = {against!r}: give 'plant', 'fmu', or the name of a step that makes a "
                "plant"
            )
        require_spans(settings)
        return settings

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        settings, plant = cls._settings(job), job.parts["plant"]
        if "controller" not in job.parts:
            _require_kind("controller", settings["controller"], "mpc")
        _require_kind("estimator", settings["estimator"], "kalman", "none")
        for name in ("start", "real", "noise"):
            values(name, plant, settings[name])
        for name in ("reference", "sensors"):
            for variable in table(name, settings[name]):
                plant.variable(variable)
        real = job.parts.get("against", plant)
        for variable in table("disturbances", settings["disturbances"]):
            real.variable(variable)
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        settings = cls._settings(job)
        loop = run_loop(settings)
        write_motion(loop.trajectory, job)
        loop.save(job.out / "loop.npz")
        job.save(loop.plot())
        failures = loop.statistics.failures if loop.statistics else 0
        window = min(float(settings["window"]), float(settings["duration"]))
        numbers = ends(loop.trajectory)
        for name in loop.reference.names if loop.reference else ():
            error = loop.steady_error(name, window)
            numbers[f"steady_error.{name}"] = error, loop.trajectory.variable(name).unit
        told = {"plant": job.said["plant"], "against": job.get("against", "plant")}
        text = loop_text({**settings, **told}, loop)
        verdict = f"{failures} steps without a solution" if failures else "every step was solved"
        sure = [line for line in text.splitlines()[1:] if not line.startswith("controller")]
        return Made(loop, verdict, not failures, numbers, sure, text)

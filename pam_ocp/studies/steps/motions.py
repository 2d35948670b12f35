"""Steps that move a plant: planned, simulated; and the comparison of two motions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import tomli_w

from ...core.errors import InputError, PlanError, PlanWarning, UnknownNameError, require_count
from ...core.quantities import known_keys, quantity, table
from ..problem import (
    DEFAULTS,
    controller_of,
    loop_settings,
    loop_text,
    require_spans,
    run_loop,
    window_of,
)
from .plants import FILE as PLANT
from .plants import copy_plant
from .step import STEPS, Job, Made, Step, ends, plant_in, seconds, values

if TYPE_CHECKING:
    from ...core.trajectory import Trajectory

_PLANNING = (
    *("stops", "cyclic", "duration", "minimise", "bounds", "rest", "memory", "phases"),
    *("constraints", "track", "budgets", "design", "integrand", "final", "method", "tolerance"),
    *("starts", "solver", "compiled", "options"),
)


class Moves(Step):
    """What offers a motion."""

    offers: ClassVar[Mapping[str, str]] = {"motion": "motion.npz"}
    parts: ClassVar[Mapping[str, str]] = {"plant": "plant"}


def write_motion(motion: Trajectory, job: Job) -> None:
    """Where it is read, and as a table."""
    for ending in ("npz", "csv"):
        motion.save(job.out / f"motion.{ending}")


@STEPS.register("plan")
class PlanStep(Moves):
    """An optimal motion of a plant, checked by an independent integration."""

    needs = ("plant", "stops")
    keys = _PLANNING

    @classmethod
    def _arguments(cls, job: Job) -> dict[str, Any]:
        from ...planning.problem.problem_file import plan_arguments

        said = {n: v for n, v in job.said.items() if n != "plant"}
        return plan_arguments(job.parts["plant"], said, allow_code=job.allow_code)

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        cls._arguments(job)
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        import warnings

        from ...planning.planner import plan

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", PlanWarning)  # the verdict says it
            found = plan(job.parts["plant"], **cls._arguments(job))
        if not found.solved:
            raise PlanError(f"no plan was found: {found.status}", found)
        found.save(job.out / "plan.npz")
        job.workbook(found, "plan.xlsx")
        write_motion(found.trajectory, job)
        job.save(found.plot())
        numbers = {"duration": (found.duration, "s"), "objective": (found.objective, "1")}
        numbers |= {n: (v, found.plant.variable(n).unit) for n, v in found.design.items()}
        sure = []
        if found.replay is not None:
            numbers |= {"replay_error": (found.replay.error, "1")}
            numbers |= {"violation": (found.replay.violation, "1")}
            sure = [
                f"an independent integration deviates by {found.replay.error:.2e} "
                "(scaled by nominals)",
                f"limits are exceeded by at most {found.replay.violation:.2e} (scaled by nominals)",
            ]
        return Made(found, str(found.verdict), found.verified, numbers, sure, str(found))


@STEPS.register("simulate")
class SimulateStep(Moves):
    """The motion of a plant under inputs: constant, or those of another motion."""

    parts: ClassVar[Mapping[str, str]] = {"plant": "plant", "inputs": "motion"}
    loose = ("inputs",)
    needs = ("plant",)
    keys = ("inputs", "rest", "start", "duration", "samples", "rtol", "set")

    @classmethod
    def _arguments(cls, job: Job) -> dict[str, Any]:
        plant = job.parts["plant"]
        found: dict[str, Any] = {"rtol": quantity("rtol", job.get("rtol", 1e-8))}
        if "inputs" not in job.parts:
            found["inputs"] = values("inputs", plant, job.get("inputs", {}))
            if "duration" not in job.said:
                raise InputError("duration is missing: give it, or inputs = the name of a motion")
        if "duration" in job.said:
            count = require_count("samples", job.get("samples", 201), 2)
            found["t"] = [seconds(job, "duration") * i / (count - 1) for i in range(count)]
        if "rest" in job.said and "start" in job.said:
            raise InputError("rest and start are both given; give one")
        if "start" in job.said:
            found["start"] = values("start", plant, job.said["start"])
        found["parameters"] = values("set", plant, job.get("set", {}))
        return found

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        cls._arguments(job)
        values("rest", job.parts["plant"], job.get("rest", {}))
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...simulation.simulator import simulate

        plant, arguments = job.parts["plant"], cls._arguments(job)
        if "inputs" in job.parts:
            arguments["inputs"] = job.parts["inputs"]
        if "rest" in job.said:
            plant = plant.with_values(arguments.pop("parameters"))
            arguments["start"] = plant.equilibrium(values("rest", plant, job.said["rest"]))
        motion = simulate(plant, **arguments)
        write_motion(motion, job)
        job.workbook(motion, "motion.xlsx")
        job.save(motion.plot())
        return Made(motion, f"{motion.duration:g} s simulated", numbers=ends(motion))


@STEPS.register("compare")
class CompareStep(Step):
    """Deviation of one motion from another, variable by variable."""

    stage = "verified"
    parts: ClassVar[Mapping[str, str]] = {"reference": "motion", "other": "motion"}
    needs = ("reference", "other")
    keys = ("names", "tolerance")

    @classmethod
    def check(cls, job: Job) -> dict[str, Any]:
        quantity("tolerance", job.get("tolerance", 1.0))
        job.listed("names")
        return {}

    @classmethod
    def work(cls, job: Job) -> Made:
        from ...figures.trajectory import plot_comparison

        one, other = job.parts["reference"], job.parts["other"]
        for name in job.listed("names"):
            if name not in one.names or name not in other.names:
                raise UnknownNameError("names", name, [n for n in one.names if n in other])
        found = one.compare(other, job.listed("names") or None)
        rows = [
            (d.variable.name, d.largest, d.rms, d.time, d.variable.unit) for d in found.deviations
        ]
        job.table("differences.csv", ("variable", "largest", "rms", "at t [s]", "unit"), rows)
        names = [d.variable.name for d in found.deviations][:8]
        labels = str(job.said["reference"]), str(job.said["other"])
        job.save(plot_comparison(one, other, names, labels))
        numbers = {"largest": (found.largest, "1")}
        numbers |= {n: (largest, unit) for n, largest, _, _, unit in rows}
        said = f"largest difference {found.largest:.3g} (scaled by nominal values)"
        good = "tolerance" not in job.said or found.largest <= quantity(
            "tolerance", job.said["tolerance"]
        )
        return Made(found, said, good, numbers, (said,), str(found))


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
        return cls._made(job, plant_in(job.out / PLANT, job.allow_code))


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
        window = window_of(settings)
        numbers = ends(loop.trajectory)
        for name in loop.reference.names if loop.reference else ():
            error = loop.steady_error(name, window)
            numbers[f"steady_error.{name}"] = error, loop.trajectory.variable(name).unit
        told = {"plant": job.said["plant"], "against": job.get("against", "plant")}
        text = loop_text({**settings, **told}, loop)
        verdict = f"{failures} steps without a solution" if failures else "every step was solved"
        sure = [line for line in text.splitlines()[1:] if not line.startswith("controller")]
        return Made(loop, verdict, not failures, numbers, sure, text)

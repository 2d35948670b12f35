"""Problems in words: what files say of a fit to records becomes records and arguments of fit_plant;
what they say of a closed loop becomes a controller, an estimator and a run.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, require_positive
from ..core.files import reading
from ..core.quantities import known_keys, pair, quantity, table
from ..plants.plant import Plant

if TYPE_CHECKING:
    from ..control.estimators.extended_kalman import Estimator
    from ..control.loop import ClosedLoop
    from ..core.trajectory import Trajectory
    from ..operating.resting_point import OperatingPoint


def values(where: str, plant: Plant, said: Any) -> dict[str, float]:
    """Values of a plant's variables in SI, as a table of a file or of options names them."""
    return {
        plant.variable(n).name: quantity(f"{where}.{n}", v, plant.variable(n).unit)
        for n, v in table(where, said).items()
    }


def listed(where: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{where} = {value!r}: give a list, as [{value!r}]")
    return value


# ---- a fit to records ----------------------------------------------------------------------------
READING = (
    *("columns", "units", "time", "interpolation", "max_gap", "split", "clock", "sample_time"),
    *("ambient_pressure", "sheet", "skip", "pick", "delimiter", "decimal", "empty"),
    *("encoding", "bad_lines", "constants", "pattern"),
)
FITTING = (
    "outputs",
    "delay",
    "offsets",
    "gains",
    "noise",
    "input_noise",
    "process_noise",
    "bounds",
    "inputs",
    "method",
    "degree",
    "step",
)
"""Keys of a study file that read_record, and fit_plant, take."""


def records_of(
    study: Mapping[str, Any], plant: Plant, paths: Iterable[str | Path]
) -> list[Trajectory]:
    """The records in files, read as the study says."""
    from ..fitting.tables.records import read_records

    reading = {n: study[n] for n in READING if n in study and n != "split"}
    found: list[Trajectory] = []
    for path in paths:
        found += read_records(path, plant, split=study.get("split"), **reading)
    return found


def fit_arguments(study: Mapping[str, Any], plant: Plant) -> dict[str, Any]:
    """Arguments of fit_plant, in SI."""
    found: dict[str, Any] = {n: study[n] for n in ("method", "degree") if n in study}
    for name in ("outputs", "offsets", "gains"):
        if name in study:
            found[name] = listed(name, study[name])
    for name in ("noise", "inputs", "input_noise"):
        if name in study:
            found[name] = values(name, plant, study[name])
    if "process_noise" in study:  # of the plant [unit/sqrt(s)]
        said = table("process_noise", study["process_noise"])
        found["process_noise"] = {n: quantity(f"process_noise.{n}", v) for n, v in said.items()}
    if "bounds" in study:
        found["bounds"] = bounds_of(study, plant)
    if "step" in study:
        found["step"] = quantity("step", study["step"], "s")
    if "delay" in study:
        given = study["delay"] if isinstance(study["delay"], list) else [study["delay"]]
        ends = [quantity("delay", v, "s") for v in given]
        if len(ends) > 2:
            raise InputError(f"delay: {len(ends)} values; give one, or two to find it between")
        found["delay"] = ends[0] if len(ends) == 1 else (ends[0], ends[1])
    return found


def bounds_of(study: Mapping[str, Any], plant: Plant) -> dict[str, tuple[float, float]]:
    ends = {
        n: pair(f"bounds.{n}", v, plant.variable(n.replace("*", "1")).unit)
        for n, v in table("bounds", study["bounds"]).items()
    }
    return {
        n: (-float("inf") if low is None else low, float("inf") if high is None else high)
        for n, (low, high) in ends.items()
    }


# ---- a closed loop -------------------------------------------------------------------------------
DEFAULTS: dict[str, Any] = {
    "plant": "antagonistic_slide",
    "muscle": "DMSP-20-200N",
    "set": {},
    "real": {},
    "against": "plant",
    "duration": 2.0,
    "window": 0.2,
    "seed": 0,
    "start": {},
    "controller": {},
    "estimator": {},
    "reference": {},
    "noise": {},
    "sensors": {},
    "disturbances": {},
}
"""What a problem file may hold, and what holds without it."""


def loop_settings(where: str, said: Mapping[str, Any]) -> dict[str, Any]:
    """DEFAULTS, and what a file says over them. Raises InputError for keys and kinds of values."""
    known_keys(where, said, DEFAULTS)
    settings = {n: dict(v) if isinstance(v, dict) else v for n, v in DEFAULTS.items()}
    for name, value in said.items():
        if isinstance(DEFAULTS[name], dict):
            table(f"{where}: {name}", value)
        elif isinstance(value, dict) and name != "plant":
            raise InputError(f"{where}: {name} must be a value, not a table")
    settings.update(said)
    return {**settings, "folder": None, "file": None, "allow_code": False}


def require_spans(study: dict[str, Any]) -> None:
    """Duration and window in seconds, in place."""
    for name in ("duration", "window"):
        study[name] = require_positive(name, quantity(name, study[name], "s"), "s")


def run_loop(study: Mapping[str, Any]) -> ClosedLoop:
    """The closed loop that settings describe. Raises InputError for invalid input."""
    from ..control.loop import closed_loop

    with guarded(study):
        controller, model, arguments = set_up(study)
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as folder:
        side = _real(study["against"], model, Path(folder))
        return closed_loop(controller, side, duration=study["duration"], **arguments)


def guarded(study: Mapping[str, Any]) -> AbstractContextManager[None]:
    """Around what a problem file says, if there is one."""
    file = study["file"] if study["folder"] else None
    return reading(file, "a problem file", "see its keys") if file else nullcontext()


def set_up(study: Mapping[str, Any]) -> tuple[Any, Plant, dict[str, Any]]:
    """(controller, its model, further arguments of closed_loop)."""
    from ..control.controller import Tracking
    from ..control.references import source

    plant = _plant(study)
    position = next(iter(plant.positions), plant.states[0].name)
    reference = study["reference"] or _reference(plant, position, study["duration"])
    sources = {n: source(f"reference.{n}", v, plant.variable(n).unit) for n, v in reference.items()}
    start = values("start", plant, study["start"]) or {n: s(0.0) for n, s in sources.items()}
    rest = plant.equilibrium(start)
    begin = {v.name: rest[v.name] for v in (*plant.states, *plant.inputs) if not v.disturbance}
    model = plant.with_values(begin)
    controls = [v.name for v in model.inputs if not v.disturbance]
    controller, sample_time = study["controller"], 0.005
    if isinstance(controller, Mapping):
        sample_time = controller.get("sample_time", sample_time)
        usual = {
            "sample_time": sample_time,
            "horizon": 40,
            "delay": 1,
            "track": {n: 1.0 if n == position else 0.05 for n in sources},
            "rate": dict.fromkeys(controls, 0.05),
        }
        controller = controller_of(model, rest, controller, usual)
    sample_time = getattr(controller, "sample_time", sample_time)  # one's own may have none
    estimator = _estimator(model, position, {"sample_time": sample_time, **study["estimator"]})
    against = study["against"]
    side = against if isinstance(against, Plant) else model
    disturbances = {
        n: source(f"disturbances.{n}", v, side.variable(n).unit, before=0.0)
        for n, v in study["disturbances"].items()
    }
    untold = isinstance(controller, Tracking) and not callable(controller)
    return (
        controller,
        model,
        {
            "reference": sources if study["reference"] or untold else {},
            "estimator": estimator,
            "disturbances": disturbances,
            "noise": values("noise", plant, study["noise"]) or None,
            "sensors": sensors_of(study["sensors"]),
            "parameters": values("real", plant, study["real"]),
            "start": begin,
            "seed": study["seed"],
        },
    )


def controller_of(
    model: Plant, rest: OperatingPoint | None, said: Mapping[str, Any], usual: Mapping[str, Any]
) -> Any:
    """The controller that a table with its ``kind`` describes. usual : arguments that it may leave
    out, of kinds that are not about a point; those that are get ``rest`` for it."""
    from ..control.kinds import CONTROLLERS

    given = {"kind": "mpc", **said}
    kind = CONTROLLERS.name("controller.kind", given.pop("kind"))
    known = CONTROLLERS.arguments(kind)
    settings = {n: v for n, v in usual.items() if n in known} if "at" not in known else {"at": rest}
    return _made("controller", CONTROLLERS[kind], model, {**settings, **given})


def sensors_of(given: Mapping[str, Any]) -> dict[str, Any]:
    """{measured variable: its Instrument}."""
    from ..simulation.instruments import Instrument

    known = [f.name for f in fields(Instrument)]
    found = {}
    for name, said in table("sensors", given).items():
        known_keys(f"sensors.{name}", table(f"sensors.{name}", said), known)
        found[name] = Instrument(**said)
    return found


def _plant(study: Mapping[str, Any]) -> Plant:
    """The model: by name, or from the file's table."""
    from ..plants.plant_file import muscle_of, plant_of
    from .file_kinds import plant_called

    folder, given = study.get("folder"), study["plant"]
    if isinstance(given, Plant):
        plant = given
    elif isinstance(given, Mapping):
        content = {"muscle": study["muscle"], **given}
        plant = plant_of(content, folder=folder, allow_code=study["allow_code"])
    else:
        typed = given == study["file"]  # on the command line: that is the consent
        muscle = muscle_of(study["muscle"], folder=folder)
        plant = plant_called(given, muscle, folder, allow_code=typed or study["allow_code"])
    return plant.with_values(values("set", plant, study["set"]))


def _reference(plant: Plant, position: str, duration: float) -> dict[str, Any]:
    """Steps of the position over a third of its range to each side, at last rest at the middle."""
    variable = plant.variable(position)
    low, high = (
        bound if abs(bound) < float("inf") else sign * variable.nominal
        for bound, sign in ((variable.min, -1), (variable.max, 1))
    )
    middle, reach = (low + high) / 2, (high - low) / 6
    stops = [middle + reach, middle - reach]
    reference: dict[str, Any] = {
        position: {"stops": stops, "dwell": 0.4, "rest": middle, "rest_from": 0.75 * duration}
    }
    if any(v.name == "stiffness" for v in plant.outputs) and len(plant.inputs) > 1:
        reference["stiffness"] = 2e4
    return reference


def _estimator(model: Plant, position: str, settings: dict[str, Any]) -> Estimator | None:
    """By default the position and the pressures are measured, and the mass is estimated."""
    from ..control.kinds import ESTIMATORS

    kind = settings.pop("kind", "kalman")
    if kind == "none":
        return None
    chosen = ESTIMATORS.find("estimator.kind", kind, "none")
    for key in ("measured", "process", "uncertainty"):
        if key in settings:
            settings[key] = values(f"estimator.{key}", model, settings[key])
    pressures = [v for v in model.states if v.unit == "Pa"]
    at = model.variable(position)
    settings.setdefault(
        "measured", {position: 2e-3 * at.nominal, **{v.name: 500.0 for v in pressures}}
    )
    settings.setdefault(
        "uncertainty", {v.name: 0.01 * v.nominal for v in model.states}
    )  # a run starts at rest
    mass = next((v for v in model.parameters if v.name == "mass"), None)
    if mass is not None and mass.start:
        settings.setdefault("unknown", {"mass": (0.25 * mass.start, 0.025 * mass.start)})
    made: Estimator = _made("estimator", chosen, model, settings)
    return made


def _made(where: str, kind: Callable[..., Any], model: Plant, settings: Mapping[str, Any]) -> Any:
    """A controller or estimator; settings that it does not know are named."""
    import inspect

    known_keys(where, settings, [n for n in inspect.signature(kind).parameters if n != "plant"])
    return kind(model, **settings)


def _real(against: str | Plant, model: Plant, folder: Path) -> Plant | Path:
    if isinstance(against, Plant):
        return against
    if against == "plant":
        return model
    if against == "fmu":
        from ..export import export_fmu

        exported: Path = export_fmu(model, folder / f"{model.name}.fmu", platforms=["native"])
        return exported
    if against.endswith(".fmu"):
        return Path(against)
    raise InputError(f"against = {against!r}: give plant, fmu, or the path of an FMU (.fmu)")


def window_of(study: Mapping[str, Any]) -> float:
    """The time at the end over which errors are steady [s]."""
    return min(float(study["window"]), float(study["duration"]))


def loop_title(study: Mapping[str, Any]) -> str:
    """What moves, in a word or two."""
    given = study["plant"]
    return str(given.get("arrangement") if isinstance(given, Mapping) else given)


def loop_text(study: Mapping[str, Any], loop: ClosedLoop) -> str:
    """How a run went: steps, steady errors, what was found."""
    window = window_of(study)
    lines = [f"{loop_title(study)} against {study['against']}, {loop.trajectory.duration:g} s"]
    lines += [f"real side: {n} = {v}" for n, v in study["real"].items()]
    if loop.statistics is not None:
        lines.append(f"controller: {loop.statistics}")
        lines.append(
            f"predictions: within {loop.prediction_error:.1e} (scaled by nominals) of a finer "
            "integration"
        )
    lines.append(f"verdict: {loop.verdict}")
    for name in loop.reference.names if loop.reference else ():
        variable = loop.trajectory.variable(name)
        error = variable.shown(loop.steady_error(name, window))
        lines.append(f"steady error of {name}: {error} (largest of the last {window:g} s)")
    if loop.estimate is not None:
        last = loop.estimate.row(-1)
        states = set(loop.trajectory.named("state"))
        for name in loop.estimate.names:
            if not name.startswith("deviation.") and name not in states:
                found = loop.estimate.variable(name)
                spread = last[f"deviation.{name}"] / found.display_factor
                lines.append(f"found: {name} = {found.shown(last[name])} ± {2 * spread:.2g} (95 %)")
    return "\n".join(lines)

"""The command ``pam-ocp mpc``: a closed loop of controller,
estimator and a real side that differs.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError, require_finite, require_positive
from ..core.files import read_toml, reading
from ..core.quantities import known_keys, quantity, table
from .options import add_allow_code, require_places

if TYPE_CHECKING:
    from ..control.estimators.extended_kalman import Estimator
    from ..control.loop import ClosedLoop
    from ..plants.plant import Plant

__all__ = ["add_mpc"]

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

EPILOG = """\
A problem file (TOML), every key optional. Values are numbers in SI, or texts with a unit; plain
keys come first:

  against = "fmu"                         # "plant", "fmu", or the path of an FMU
  duration = "2 s"
  real = { mass = "2.6 kg" }              # what is different on the real side
  start = { x = 0.0, stiffness = 2e4 }    # the run starts at rest there
  noise = { x = "0.02 mm" }              # standard deviations; default: what the estimator expects

  sensors = { x = { delay = "4 ms", resolution = "0.01 mm", filter = "2 ms" } }

  [plant]                                 # as for 'pam-ocp plan', or a name: plant = "hanging_load"
  arrangement = "AntagonisticSlide"
  muscle = "DMSP-20-200N"
  mass = "2 kg"

  [reference]                             # a value, or stops that are each held for a time
  x = { stops = ["10 mm", "-10 mm"], dwell = "0.4 s", rest = 0.0, rest_from = "1.2 s" }
  stiffness = 2e4

  [controller]                            # and arguments of its class
  kind = "mpc"
  sample_time = 0.005
  horizon = 40
  delay = 1
  track = { x = 1.0, stiffness = 0.05 }

  [estimator]                             # and arguments of its class
  kind = "kalman"                         # "kalman", "moving-horizon" or "none"
  unknown = { mass = [0.5, 0.05] }        # initial deviation, drift per square root of a second

  [disturbances]                          # not told to the controller; [value, from when on]
  push = ["40 N", "1 s"]

The report says how often the controller found no solution ("failed"), how often it applied one that
had not converged, and how far its predictions are from a finer integration of its own model.

Exit code: 0, or 1 when the controller found no solution at some step, 2 for a file or an option
that cannot be meant.
"""


def add_mpc(commands: Any) -> None:
    """Add the command to the parser's commands."""
    mpc = commands.add_parser(
        "mpc",
        help="model predictive control in closed loop",
        description="Run model predictive control with an estimator against a plant, or its FMU, "
        "whose "
        "load differs; print step times, steady error and what was found.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    mpc.add_argument(
        "problem",
        nargs="?",
        metavar="PROBLEM",
        help="a problem file (.toml), or a plant as in 'export' (default: antagonistic_slide)",
    )
    mpc.add_argument("--muscle", metavar="MUSCLE", help="name in the catalogue, or a muscle file")
    for name, meaning in (
        ("set", "value of the model's parameter or start value"),
        ("real", "value on the real side that the controller is not told, as in mass=2.6"),
    ):
        mpc.add_argument(
            f"--{name}",
            action="append",
            default=[],
            metavar="NAME=VALUE",
            help=f"{meaning}, in SI (may be repeated)",
        )
    mpc.add_argument("--against", metavar="SIDE", help="plant, fmu, or FILE.fmu (default: plant)")
    mpc.add_argument("--estimator", metavar="KIND", help="kind of estimator (default: kalman)")
    mpc.add_argument("--duration", type=float, metavar="S")
    mpc.add_argument("--seed", type=int, help="of the noise (default: 0)")
    mpc.add_argument("--out", type=Path, metavar="FILE", help="write the motion (.csv, .npz)")
    mpc.add_argument("--plot", type=Path, metavar="FILE.png", help="draw the run")
    add_allow_code(mpc)
    mpc.set_defaults(run=_mpc)


def _mpc(options: argparse.Namespace) -> int:
    require_places(options.out, options.plot)
    study = _study(options)
    loop = _run(study)
    print(_report(study, loop))
    if options.out:
        print(f"-> {loop.trajectory.save(options.out)}")
    if options.plot:
        from ..figures.saved import save_figure

        print(f"-> {save_figure(loop.plot(_title(study)), options.plot, dpi=120)}")
    return 1 if loop.statistics and loop.statistics.failures else 0


def _study(options: argparse.Namespace) -> dict[str, Any]:
    """DEFAULTS, what the problem file says over them, and what the command line says over that."""
    study = {n: dict(v) if isinstance(v, dict) else v for n, v in DEFAULTS.items()}
    study["folder"] = None
    study["file"] = options.problem
    study["allow_code"] = options.allow_code
    if options.problem and options.problem.endswith(".toml"):
        with reading(options.problem, "a problem file", "'pam-ocp mpc --help' shows one"):
            study.update(_file(Path(options.problem)))
        study["folder"] = Path(options.problem).parent
    elif options.problem:
        study["plant"] = options.problem
    for name in ("muscle", "against", "duration", "seed"):
        if getattr(options, name) is not None:
            study[name] = getattr(options, name)
    if str(study["against"]).endswith(".fmu") and options.against is None:
        from ..plants.plant_file import require_allowed

        what = f"against = {study['against']!r} would run the machine code of that FMU"
        require_allowed(what, options.allow_code)
    for name in ("set", "real"):
        study[name] = {**study[name], **_pairs(name, getattr(options, name))}
    if options.estimator is not None:
        study["estimator"] = {**study["estimator"], "kind": options.estimator}
    with _guard(study):
        for name in ("duration", "window"):
            study[name] = require_positive(name, quantity(name, study[name], "s"), "s")
    return study


def _file(path: Path) -> dict[str, Any]:
    read = read_toml(path)
    known_keys(str(path), read, DEFAULTS)
    for name, value in read.items():
        if isinstance(DEFAULTS[name], dict):
            table(name, value)
        elif isinstance(value, dict) and name != "plant":
            raise InputError(f"{path}: {name} must be a value, not a table")
    return read


def _pairs(option: str, texts: list[str]) -> dict[str, float]:
    values = {}
    for text in texts:
        name, equals, number = text.partition("=")
        if not equals:
            raise InputError(f"--{option} {text}: give NAME=VALUE with a number in SI")
        values[name.strip()] = require_finite(f"--{option} {name.strip()}", number)
    return values


# ---- the run ------------------------------------------------------------------------------------


def _run(study: Mapping[str, Any]) -> ClosedLoop:
    from ..control.loop import closed_loop

    with _guard(study):
        controller, model, arguments = _set_up(study)
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as folder:
        side = _real(study["against"], model, Path(folder))
        return closed_loop(controller, side, duration=study["duration"], **arguments)


def _guard(study: Mapping[str, Any]) -> AbstractContextManager[None]:
    """Around what a problem file says, if there is one."""
    file = study["file"] if study["folder"] else None
    return reading(file, "a problem file", "see its keys") if file else nullcontext()


def _set_up(study: Mapping[str, Any]) -> tuple[Any, Plant, dict[str, Any]]:
    """(controller, its model, further arguments of closed_loop)."""
    from ..control.controller import Tracking
    from ..control.kinds import CONTROLLERS
    from ..control.references import source

    plant = _plant(study)
    position = next(iter(plant.positions), plant.states[0].name)
    reference = study["reference"] or _reference(plant, position, study["duration"])
    sources = {n: source(f"reference.{n}", v, plant.variable(n).unit) for n, v in reference.items()}
    start = _values("start", plant, study["start"]) or {n: s(0.0) for n, s in sources.items()}
    rest = plant.equilibrium(start)
    begin = {v.name: rest[v.name] for v in (*plant.states, *plant.inputs) if not v.disturbance}
    model = plant.with_values(begin)
    controls = [v.name for v in model.inputs if not v.disturbance]
    usual = {
        "sample_time": 0.005,
        "horizon": 40,
        "delay": 1,
        "track": {n: 1.0 if n == position else 0.05 for n in sources},
        "rate": dict.fromkeys(controls, 0.05),
    }
    given = {"kind": "mpc", **study["controller"]}
    kind = CONTROLLERS.name("controller.kind", given.pop("kind"))
    settings = {n: v for n, v in usual.items() if n in CONTROLLERS.arguments(kind)} | given
    controller = _made("controller", CONTROLLERS[kind], model, settings)
    sample_time = settings.get("sample_time", usual["sample_time"])
    estimator = _estimator(model, position, {"sample_time": sample_time, **study["estimator"]})
    disturbances = {
        n: source(f"disturbances.{n}", v, model.variable(n).unit, before=0.0)
        for n, v in study["disturbances"].items()
    }
    return (
        controller,
        model,
        {
            "reference": sources if study["reference"] or isinstance(controller, Tracking) else {},
            "estimator": estimator,
            "disturbances": disturbances,
            "noise": _values("noise", plant, study["noise"]) or None,
            "sensors": _sensors(study["sensors"]),
            "parameters": _values("real", plant, study["real"]),
            "start": begin,
            "seed": study["seed"],
        },
    )


def _sensors(given: Mapping[str, Any]) -> dict[str, Any]:
    from ..simulation.instruments import Instrument

    known = [f.name for f in fields(Instrument)]
    found = {}
    for name, said in table("sensors", given).items():
        known_keys(f"sensors.{name}", table(f"sensors.{name}", said), known)
        found[name] = Instrument(**said)
    return found


def _plant(study: Mapping[str, Any]) -> Plant:
    """The model: by name, or from the file's table."""
    from ..plants.plant_file import muscle_of, named_plant, plant_of

    folder, given = study.get("folder"), study["plant"]
    if isinstance(given, Mapping):
        content = {"muscle": study["muscle"], **given}
        plant = plant_of(content, folder=folder, allow_code=study["allow_code"])
    else:
        typed = given == study["file"]  # on the command line: that is the consent
        muscle = muscle_of(study["muscle"], folder=folder)
        plant = named_plant(given, muscle, folder, allow_code=typed or study["allow_code"])
    return plant.with_values(_values("set", plant, study["set"]))


def _values(where: str, plant: Plant, given: Mapping[str, Any]) -> dict[str, float]:
    """Values of a plant's variables in SI."""
    return {n: quantity(f"{where}.{n}", v, plant.variable(n).unit) for n, v in given.items()}


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
            settings[key] = _values(f"estimator.{key}", model, settings[key])
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


def _real(against: str, model: Plant, folder: Path) -> Plant | Path:
    if against == "plant":
        return model
    if against == "fmu":
        from ..export import export_fmu

        exported: Path = export_fmu(model, folder / f"{model.name}.fmu", platforms=["native"])
        return exported
    if against.endswith(".fmu"):
        return Path(against)
    raise InputError(f"against = {against!r}: give plant, fmu, or the path of an FMU (.fmu)")


def _title(study: Mapping[str, Any]) -> str:
    given = study["plant"]
    return str(given.get("arrangement") if isinstance(given, Mapping) else given)


def _report(study: Mapping[str, Any], loop: ClosedLoop) -> str:
    window = min(float(study["window"]), float(study["duration"]))
    lines = [f"{_title(study)} against {study['against']}, {loop.trajectory.duration:g} s"]
    lines += [f"real side: {n} = {v}" for n, v in study["real"].items()]
    if loop.statistics is not None:
        lines.append(f"controller: {loop.statistics}")
        lines.append(
            f"predictions: within {loop.prediction_error:.1e} of nominal of a finer integration"
        )
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

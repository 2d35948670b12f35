"""The commands of plants and muscles: ``pam-ocp simulate``, ``compare``, ``linearize``, ``export``,
``check``, ``muscles`` and ``loads``.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np

import pam_ocp as pam

from ..core.errors import InputError, require_count, require_positive
from ..core.files import MOST_ROWS, make_folder, read_toml, reading, write_json
from ..core.quantities import known_keys, quantity, table
from ..core.units import unit as unit_of
from ..plants.plant_data import carried
from .command import (
    choice,
    command,
    count,
    file,
    flag,
    named,
    number,
    option,
    output,
    pairs,
    plot,
    repeated,
    seconds,
    several,
)
from .options import (
    A_PLANT,
    length_of,
    muscle_named,
    plant_said,
    require_motion_ending,
    rest,
    rest_length,
    written,
)
from .output import deliver, picture, tell, wrote

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ..core.trajectory import Trajectory
    from ..operating.linear_model import LinearModel
    from ..plants.plant import Plant


# ---- simulate ------------------------------------------------------------------------------------
@command(
    "simulate",
    "simulate a plant",
    *A_PLANT,
    named("--input", "constant input, such as muscle.command='3 bar'"),
    file(
        "--inputs",
        "FILE",
        "recorded inputs: a plan, closed loop, motion or measured record, as a command wrote "
        "it or as a table",
    ),
    rest("begin at rest under this condition"),
    option("--duration", "S", "such as '500 ms'; seconds without unit"),
    count("--samples", "N", "rows of the result (default: 201, or those of --inputs)"),
    option("--rtol", "R", "relative tolerance (default: 1e-8)", type=number, default=1e-8),
    output("--out", "FILE", "write the motion (.csv, .npz, .parquet, .xlsx)"),
    plot("draw the motion"),
    about="Integrate a plant under constant or recorded inputs, print its last values, "
    "and write and draw the motion.",
)
def _simulate(options: argparse.Namespace) -> int:
    require_motion_ending(options.out)
    plant = plant_said(options)
    inputs = _inputs(plant, options)
    start = plant.equilibrium(pairs("--rest", options.rest)) if options.rest else None
    given = 201 if options.samples is None else options.samples
    samples = require_count("--samples", given, 2, MOST_ROWS)
    times: Any = None
    if options.duration is not None:
        duration = quantity("--duration", options.duration, "s")
        times = np.linspace(0.0, require_positive("--duration", duration, "s"), samples)
    elif options.inputs is None:
        raise InputError("give --duration, such as --duration '500 ms', or --inputs FILE")
    elif options.samples is not None:
        times = np.linspace(inputs.t[0], inputs.t[-1], samples)
    motion = pam.simulate(plant, inputs, t=times, start=start, rtol=options.rtol)
    tell(options, _last(motion), lambda: {"time": float(motion.t[-1]), **motion.row(-1)})
    deliver(options, out=lambda path: written(motion, path, plant), plot=picture(motion.plot))
    return 0


def _inputs(plant: Plant, options: argparse.Namespace) -> Any:
    from ..studies.file_kinds import motion_in

    if options.inputs is not None:
        if options.input:
            raise InputError("give --inputs FILE, or --input NAME=VALUE, not both")
        return motion_in(options.inputs)
    given = pairs("--input", options.input)
    return {
        variable.name: variable.check(variable.number(value, "--input"), "--input")
        for variable, value in ((plant.variable(n), v) for n, v in given.items())
    }


def _last(motion: Trajectory) -> str:
    """The last row of a motion in display units."""
    values = {v.name: float(motion[v.name][-1]) for v in motion.variables}
    lines = [f"at the end, t = {motion.t[-1]:g} s:"]
    return "\n".join(lines + [f"{n:<28}{motion.variable(n).shown(v)}" for n, v in values.items()])


# ---- compare -------------------------------------------------------------------------------------
@command(
    "compare",
    "compare two trajectories",
    file("reference", "REFERENCE"),
    file("other", "OTHER"),
    several("--names", "NAME", "columns to compare (default: all shared ones)"),
    option(
        "--tolerance",
        "R",
        "largest difference allowed, in units of nominal (default: any)",
        type=number,
    ),
    plot("draw both and the difference"),
    about="How far a second motion is from a first, variable by variable, at the first "
    "one's times: plans, closed loops, motions, measured records. Exit code 1 when the largest "
    "difference exceeds --tolerance.",
)
def _compare(options: argparse.Namespace) -> int:
    from ..figures.trajectory import plot_comparison
    from ..studies.file_kinds import motion_in

    if options.tolerance is not None:
        require_positive("--tolerance", options.tolerance, zero=True)
    one, other = motion_in(options.reference), motion_in(options.other)
    found = one.compare(other, options.names)
    rows = {
        d.variable.name: {"largest": d.largest, "rms": d.rms, "time": d.time}
        for d in found.deviations
    }
    tell(options, found, {"largest": found.largest, "variables": rows})
    names = list(rows)[:8]
    labels = options.reference.name, options.other.name
    deliver(options, plot=picture(lambda: plot_comparison(one, other, names, labels)))
    if options.tolerance is not None and not found.largest <= options.tolerance:
        tell(options, f"largest difference {found.largest:.3g} of nominal > {options.tolerance:g}")
        return 1
    return 0


# ---- linearize -----------------------------------------------------------------------------------
@command(
    "linearize",
    "poles, frequencies and matrices of a plant about an equilibrium",
    *A_PLANT,
    rest("condition of rest (default: the inputs' start values)"),
    *(
        several(f"--{kind}", "NAME", f"{kind} to keep (default: all)")
        for kind in ("inputs", "outputs")
    ),
    output(
        "--out", "FILE.json", "write A, B, C, D with names and units (display units: mm, bar, deg)"
    ),
    flag("--si", "matrices in SI instead of display units"),
    plot("Bode diagram from the first input kept"),
    about="Compute an equilibrium, linearise the plant about it, and print values, "
    "poles and natural frequencies.",
)
def _linearize(options: argparse.Namespace) -> int:
    from ..figures.trajectory import plot_bode
    from ..operating.linear import linear_model

    if options.out and options.out.suffix.lower() != ".json":
        raise InputError(f"--out {options.out}: matrices are written as .json")
    plant = plant_said(options)
    conditions = pairs("--rest", options.rest)
    point = plant.equilibrium(conditions or {v.name: v.start or 0.0 for v in plant.inputs})

    def model(units: Literal["display"] | None) -> LinearModel:
        return linear_model(
            plant, point, inputs=options.inputs, outputs=options.outputs, units=units, stuck=True
        )

    def told(system: LinearModel) -> dict[str, Any]:
        return {
            "point": point.values,
            "stability": point.stability,
            "poles": [[float(p.real), float(p.imag)] for p in point.poles],
            "modes": [{"hertz": f, "damping_ratio": z} for f, z in pam.operating.modes(system)],
            "states": system.state_labels,
            "inputs": system.input_labels,
            "outputs": system.output_labels,
            "units": dict(system.units),
            **{name: getattr(system, name).tolist() for name in "ABCD"},
        }

    system = model(None if options.si else "display")
    said = told(system)
    tell(options, _text(point, said), lambda: told(model(None)))

    def save(path: Path) -> Path:
        return write_json(path, {"format": "pam_ocp linear model 1", **said, **carried(plant)})

    def bode() -> Figure:
        output, source = system.output_labels[0], system.input_labels[0]
        units = system.units[output], system.units[source]
        return plot_bode({plant.name: system}, output, source, units=units)

    deliver(options, out=save, plot=picture(bode))
    return 0


def _text(point: Any, said: dict[str, Any]) -> str:
    from ..operating.operating_point import pole_texts

    lines = [f"equilibrium, {said['stability']}:", str(point), "poles [1/s]:"]
    lines += [f"    {text}" for text in pole_texts(point.poles)]
    lines += [
        f"natural frequency {m['hertz']:.4g} Hz, damping ratio {m['damping_ratio']:.3g}"
        for m in said["modes"]
    ]
    return "\n".join(lines)


# ---- FMUs ----------------------------------------------------------------------------------------
SYSTEM = """\
A system file (TOML) with a table [connections] is written as SSP:

  stop_time = "2 s"                       # also: step_size, fmi, version, booleans, ...

  [components.plant]                      # a plant as for 'pam-ocp plan', or a study file's
  arrangement = "AntagonisticSlide"
  muscle = "DMSP-20-200N"

  [components]
  motion = "plan.npz"                     # a Trajectory, in the folder of this file
  controller = "mine.py:controller"       # a Block, a controller or a plant (with --allow-code)

  [connections]                           # every input of every component = an output
  "plant.muscle1.command" = "controller.muscle1.command"
"""
_SHAPES = ("matrices", "booleans", "enumerations")
_KEYS = ("components", "connections", "step_size", "stop_time", "fmi", "name", "version", *_SHAPES)


@command(
    "export",
    "export a plant as an FMU, a system as an SSP",
    *A_PLANT,
    choice(
        "--fmi",
        ("2.0", "3.0"),
        "version of the standard (default: 2.0, which every tool reads)",
        type=lambda text: f"{text}.0" if text in ("2", "3") else text,
    ),
    repeated(
        "--platform",
        "NAME",
        "native, or a platform by name (may be repeated; default: the usual five; on request "
        "x86-linux, x86-windows, aarch64-windows)",
    ),
    *(
        repeated(
            f"--{kind}",
            "NAME",
            f"{kind} that the FMU shows (may be repeated; default: all; the rest become {rest})",
        )
        for kind, rest in (("input", "tunable parameters"), ("output", "local variables"))
    ),
    output("--out", "FILE", "default: PLANT.fmu or SYSTEM.ssp"),
    about="Export a plant as an FMU for Model Exchange and Co-Simulation, or a system "
    "file as an SSP of such units.",
    epilog=SYSTEM,
)
def _export(options: argparse.Namespace) -> int:
    target: Path | None = options.out
    if is_system(options.plant):
        for name in ("muscle", "set", "input", "output"):
            if getattr(options, name):
                raise InputError(
                    f"--{name}: {options.plant} says what it is made of; change it there"
                )
        given = (options.fmi, options.platform, options.allow_code)
        wrote(options, write_system(options.plant, target, *given))
        return 0
    plant = plant_said(options)
    target = target or Path(f"{plant.name}.fmu")
    chosen = {"inputs": options.input, "outputs": options.output}
    fmu = pam.export_fmu(
        plant, target, fmi=options.fmi or "2.0", platforms=options.platform, **chosen
    )
    wrote(options, fmu)
    return 0


def is_system(name: str) -> bool:
    """Whether a file named on the command line describes a system."""
    return name.endswith(".toml") and "connections" in read_toml(name)


def write_system(
    file: str, target: Path | None, fmi: str | None, platforms: Any, allow_code: bool
) -> Path:
    """Write the SSP that a system file describes, by default beside where we are as NAME.ssp."""

    content = read_toml(file)
    with reading(file, "a system file", "see 'pam-ocp export --help'"):
        known_keys(file, content, _KEYS)
        folder = Path(file).parent
        described = table("components", content.get("components", {}))
        components = {n: _component(n, c, folder, allow_code) for n, c in described.items()}
        connections = table("connections", content["connections"])
        more: dict[str, Any] = {
            n: quantity(n, content[n], "s") for n in ("step_size", "stop_time") if n in content
        }
        more |= {n: content[n] for n in _SHAPES if n in content}
    name = str(content.get("name", Path(file).stem))
    return pam.export_ssp(
        components,
        {str(k): str(v) for k, v in connections.items()},
        target or Path(f"{name}.ssp"),
        name=name,
        fmi=cast(Any, fmi or content.get("fmi", "2.0")),
        platforms=platforms,
        version=cast(Any, str(content.get("version", "1.0"))),
        **more,
    )


def _component(name: str, said: Any, folder: Path, allow_code: bool) -> Any:
    from ..plants.plant_file import member_of, plant_of, require_allowed

    if isinstance(said, Mapping):
        return plant_of(said, f"components.{name}", folder, allow_code=allow_code)
    if not isinstance(said, str):
        raise InputError(f"components.{name} = {said!r}: give a table, or the name of a file")
    file, colon, member = said.rpartition(":")
    if not colon or not file.endswith(".py"):
        return pam.Trajectory.load(folder / said)
    require_allowed(f"{said!r} would run the Python file {file}", allow_code)
    found = member_of(folder / file, member)
    return found() if callable(found) and not hasattr(found, "sample_time") else found


@command(
    "check",
    "check an FMU",
    file("fmu", "FMU"),
    file(
        "--against",
        "FILE",
        "plan, closed loop, motion or measured record whose inputs are replayed and whose "
        "outputs are compared",
    ),
    option(
        "--time-limit",
        "S",
        "time limit in seconds, or as '5 min'; exceeding it fails the check (default: 60)",
        type=seconds,
        default=60.0,
    ),
    about="Validate an FMU and run it by fmpy. Exit code 0 if all is well, 1 otherwise.",
)
def _check(options: argparse.Namespace) -> int:
    from ..studies.file_kinds import require_role

    require_role(options.fmu, "FMU")
    reference = _reference(options.against) if options.against else None
    result = pam.check_fmu(options.fmu, against=reference, time_limit=options.time_limit)
    tell(options, result, result.to_dict)
    return 0 if result.ok else 1


def _reference(path: Path) -> Trajectory:
    """The motion in a file; a plan's inputs played tightly, as its samples are a solver's."""
    from ..studies.file_kinds import kind_of, motion_in

    kind = kind_of(path)
    found = kind.read(path) if kind.read is not None and "plan" in kind.words else None
    if isinstance(found, pam.planning.Plan):
        return pam.simulate(found.plant, found.trajectory, t=found.trajectory.t)
    return motion_in(path)


# ---- muscles -------------------------------------------------------------------------------------
@command(
    "muscles",
    "list the catalogue of muscles, or show one",
    choice("show", ("show",), "show one muscle", nargs="?"),
    option("name", "NAME", "name in the catalogue, or a muscle file", nargs="?"),
    rest_length(" (where the catalogue holds none)"),
    plot("draw force over contraction and pressure"),
    about="Without arguments: the catalogue. 'show NAME': one muscle with its source, forces "
    "and stiffness.",
)
def _muscles(options: argparse.Namespace) -> int:
    from ..muscles.catalogue import summary, transfer_note

    if options.show:
        return _show(options)
    for name, given in (("--rest-length", options.rest_length), ("--plot", options.plot)):
        if given is not None:
            raise InputError(f"{name}: of one muscle; give show NAME, too")
    lines = {name: summary(name) for name in pam.muscles.muscle_names()}
    text = "\n".join(lines.values())
    tell(options, f"{text}\n\n{transfer_note()}", {"muscles": lines})
    return 0


def _show(options: argparse.Namespace) -> int:
    if options.name is None:
        raise InputError("muscles show: give the NAME of a muscle; 'pam-ocp muscles' lists them")

    muscle = muscle_named(options.name, length_of("--rest-length", options.rest_length))
    text = muscle_text(muscle)
    if options.name in pam.muscles.muscle_names():
        text += f"\n\n{pam.muscles.attribution(options.name)}"
    tell(options, text, lambda: _muscle_data(muscle))
    deliver(options, plot=picture(muscle.plot))
    return 0


def _muscle_data(muscle: Any) -> dict[str, Any]:
    return {
        "name": muscle.name,
        "law": muscle.law.name,
        "coefficients": muscle.law.values,
        "rest_length": muscle.rest_length,
        "diameter": muscle.diameter,
        "pressure_range": muscle.pressure_range,
        "contraction_range": muscle.contraction_range,
        "source": muscle.source,
    }


def muscle_text(muscle: Any) -> str:
    """A muscle's source and a table of its force [N] over pressure and contraction."""

    low, high = muscle.contraction_range
    pressures = [muscle.pressure_range[1] * i / 6 for i in range(1, 7)]
    contractions = [max(low, 0.0) + (high - max(low, 0.0)) * i / 5 for i in range(6)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pam.muscles.ValidityWarning)
        rows = [[float(muscle.force(p, k)) for k in contractions] for p in pressures]
        ends = [float(muscle.max_contraction(p)) for p in pressures]
    lines = [
        f"{muscle.name}: {muscle.law.title}",
        f"rest length {1e3 * muscle.rest_length:g} mm"
        + (f", inner diameter {1e3 * muscle.diameter:g} mm" if muscle.diameter else ""),
        f"source: {muscle.source}",
        *([muscle.note] if muscle.note else []),
        "",
        "force [N]; rows: pressure [bar gauge], columns: contraction [%]; last: slack from there "
        "on",
        f"{'':>7}" + "".join(f"{100 * k:>9.1f}" for k in contractions) + f"{'slack at':>10}",
    ]
    for p, row, end in zip(pressures, rows, ends, strict=True):
        lines.append(
            f"{p / 1e5:>7.2f}" + "".join(f"{f:>9.1f}" for f in row) + f"{100 * end:>8.1f} %"
        )
    return "\n".join(lines)


@command(
    "loads",
    "the influence of loads on a muscle",
    option(
        "--muscle",
        "MUSCLE",
        "name in the catalogue, or a muscle file (default: DMSP-20-400N)",
        default="DMSP-20-400N",
    ),
    several(
        "--masses",
        "KG",
        "numbers in kg, or with a unit, such as '500 g'",
        default=[5, 10, 20, 50, 100],
    ),
    several(
        "--pressures",
        "BAR",
        "numbers in bar, or with a unit, such as '300 kPa'",
        default=[1, 2, 3, 4, 5, 6],
    ),
    file("--out", "DIR", "write loads.csv and loads.png into this folder"),
    about="Rest, natural frequency, damping, overshoot, settling time, work and air of a "
    "hanging load, against load and pressure.",
)
def _loads(options: argparse.Namespace) -> int:
    folder = make_folder(options.out) if options.out else None
    masses = [_in("--masses", m, "kg") for m in options.masses]
    pressures = [_in("--pressures", p, "bar") for p in options.pressures]
    study = pam.load_study(muscle_named(options.muscle), masses, pressures)
    tell(options, study, lambda: {"cases": [asdict(c) for c in study.cases]})
    if folder:
        wrote(options, study.save(folder / "loads.csv"))
        wrote(options, picture(study.plot)(folder / "loads.png"))
    return 0


def _in(option: str, value: str | float, unit: str) -> float:
    """In SI, of a text with a unit, or of a number in ``unit``."""
    text = str(value).replace("\u2212", "-")  # the typesetter's minus
    try:
        return float(text) * unit_of(unit).factor
    except ValueError:
        return quantity(option, text, unit)

"""The commands of plants: ``pam-ocp simulate``, ``compare`` and ``linearize``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from ..core.files import MOST_ROWS
from ..core.quantities import quantity
from .options import (
    add_pairs,
    add_plant,
    add_plot,
    add_rest,
    number,
    pairs,
    plant_said,
    require_motion_ending,
    require_places,
    whole,
    written,
)
from .output import add_json, tell, wrote

if TYPE_CHECKING:
    from ..core.trajectory import Trajectory
    from ..plants.plant import Plant


def add_simulate(commands: Any) -> None:
    """The command ``simulate``."""
    simulate = commands.add_parser(
        "simulate",
        help="simulate a plant",
        description="Integrate a plant under constant or recorded inputs, print its last values, "
        "and write and draw the motion.",
    )
    add_plant(simulate)
    add_pairs(simulate, "--input", "constant input, such as muscle.command='3 bar'")
    simulate.add_argument(
        "--inputs",
        type=Path,
        metavar="FILE",
        help="recorded inputs: a plan, closed loop, motion or measured record, as a command wrote "
        "it or as a table",
    )
    add_rest(simulate, "begin at rest under this condition")
    simulate.add_argument("--duration", metavar="S", help="such as '500 ms'; seconds without unit")
    simulate.add_argument(
        "--samples", type=whole, default=201, metavar="N", help="rows of the result (default: 201)"
    )
    simulate.add_argument(
        "--rtol", type=number, default=1e-8, metavar="R", help="relative tolerance (default: 1e-8)"
    )
    simulate.add_argument(
        "--out", type=Path, metavar="FILE", help="write the motion (.csv, .npz, .parquet, .xlsx)"
    )
    add_plot(simulate, "draw the motion")
    add_json(simulate)
    simulate.set_defaults(run=_simulate)


def _simulate(options: argparse.Namespace) -> int:
    import numpy as np

    from ..core.errors import require_count, require_positive
    from ..figures.saved import save_figure
    from ..simulation.simulator import simulate

    require_places(options.out, options.plot)
    require_motion_ending(options.out)
    plant = plant_said(options)
    inputs = _inputs(plant, options)
    start = plant.equilibrium(pairs("--rest", options.rest)) if options.rest else None
    if options.duration is not None:
        require_count("--samples", options.samples, 2, MOST_ROWS)
        duration = quantity("--duration", options.duration, "s")
        end = require_positive("--duration", duration, "s")
        times: Any = np.linspace(0.0, end, options.samples)
    elif options.inputs is None:
        raise InputError("give --duration, such as --duration '500 ms', or --inputs FILE")
    else:
        times = None
    motion = simulate(plant, inputs, t=times, start=start, rtol=options.rtol)
    tell(options, _last(motion), lambda: {"time": float(motion.t[-1]), **motion.row(-1)})
    if options.out:
        wrote(options, written(motion, options.out, plant))
    if options.plot:
        wrote(options, save_figure(motion.plot(), options.plot))
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


def add_compare(commands: Any) -> None:
    """The command ``compare``."""
    compare = commands.add_parser(
        "compare",
        help="compare two trajectories",
        description="How far a second motion is from a first, variable by variable, at the first "
        "one's times: plans, closed loops, motions, measured records. Exit code 1 when the largest "
        "difference exceeds --tolerance.",
    )
    compare.add_argument("reference", type=Path, metavar="REFERENCE")
    compare.add_argument("other", type=Path, metavar="OTHER")
    compare.add_argument(
        "--names", nargs="+", metavar="NAME", help="columns to compare (default: all shared ones)"
    )
    compare.add_argument(
        "--tolerance",
        type=number,
        metavar="R",
        help="largest difference allowed, in units of nominal (default: any)",
    )
    add_plot(compare, "draw both and the difference")
    add_json(compare)
    compare.set_defaults(run=_compare)


def _compare(options: argparse.Namespace) -> int:
    from ..core.errors import require_positive
    from ..figures.saved import save_figure
    from ..figures.trajectory import plot_comparison
    from ..studies.file_kinds import motion_in

    require_places(options.plot)
    if options.tolerance is not None:
        require_positive("--tolerance", options.tolerance, zero=True)
    one, other = motion_in(options.reference), motion_in(options.other)
    found = one.compare(other, options.names)
    rows = {
        d.variable.name: {"largest": d.largest, "rms": d.rms, "time": d.time}
        for d in found.deviations
    }
    tell(options, found, {"largest": found.largest, "variables": rows})
    if options.plot:
        names = [d.variable.name for d in found.deviations][:8]
        labels = options.reference.name, options.other.name
        wrote(options, save_figure(plot_comparison(one, other, names, labels), options.plot))
    if options.tolerance is not None and not found.largest <= options.tolerance:
        tell(options, f"largest difference {found.largest:.3g} of nominal > {options.tolerance:g}")
        return 1
    return 0


# ---- linearize -----------------------------------------------------------------------------------
def add_linearize(commands: Any) -> None:
    """The command ``linearize``."""
    linearize = commands.add_parser(
        "linearize",
        help="poles, frequencies and matrices of a plant about an equilibrium",
        description="Compute an equilibrium, linearise the plant about it, and print values, "
        "poles and natural frequencies.",
    )
    add_plant(linearize)
    add_rest(linearize, "condition of rest (default: the inputs' start values)")
    for kind in ("inputs", "outputs"):
        linearize.add_argument(
            f"--{kind}", nargs="+", metavar="NAME", help=f"{kind} to keep (default: all)"
        )
    linearize.add_argument(
        "--out",
        type=Path,
        metavar="FILE.json",
        help="write A, B, C, D with names and units (display units: mm, bar, deg)",
    )
    linearize.add_argument(
        "--si", action="store_true", help="matrices in SI instead of display units"
    )
    add_plot(linearize, "Bode diagram from the first input kept")
    add_json(linearize)
    linearize.set_defaults(run=_linearize)


def _linearize(options: argparse.Namespace) -> int:
    from ..core.files import write_json
    from ..figures.saved import save_figure
    from ..figures.trajectory import plot_bode
    from ..operating.linear import linear_model, modes
    from ..plants.plant_data import carried

    require_places(options.out, options.plot)
    if options.out and options.out.suffix.lower() != ".json":
        raise InputError(f"--out {options.out}: matrices are written as .json")
    plant = plant_said(options)
    conditions = pairs("--rest", options.rest)
    point = plant.equilibrium(conditions or {v.name: v.start or 0.0 for v in plant.inputs})
    system = linear_model(
        plant,
        point,
        inputs=options.inputs,
        outputs=options.outputs,
        units=None if options.si else "display",
        stuck=True,
    )
    said = {
        "point": point.values,
        "stability": point.stability,
        "poles": [[float(p.real), float(p.imag)] for p in point.poles],
        "modes": [{"hertz": f, "damping_ratio": z} for f, z in modes(system)],
        "states": system.state_labels,
        "inputs": system.input_labels,
        "outputs": system.output_labels,
        "units": dict(system.units),
        **{name: getattr(system, name).tolist() for name in "ABCD"},
    }
    tell(options, _text(point, said), said)
    if options.out:
        words = {"format": "pam_ocp linear model 1", **said, **carried(plant)}
        wrote(options, write_json(options.out, words))
    if options.plot:
        output, source = system.output_labels[0], system.input_labels[0]
        units = system.units[output], system.units[source]
        figure = plot_bode({plant.name: system}, output, source, units=units)
        wrote(options, save_figure(figure, options.plot))
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

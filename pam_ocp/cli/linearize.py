"""``pam-ocp linearize``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from .options import add_plot, add_rest, pairs, require_places
from .output import add_json, tell, wrote
from .plants import add_plant, plant_said

__all__ = ["add_linearize"]


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

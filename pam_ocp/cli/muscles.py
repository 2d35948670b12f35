"""The commands of muscles: ``pam-ocp muscles`` and ``loads``."""

from __future__ import annotations

import argparse
import warnings
from dataclasses import asdict
from typing import Any

from ..core.errors import InputError
from .options import add_out, add_plot, add_rest_length, length_of, muscle_named
from .output import add_json, tell, wrote


def add_loads(commands: Any) -> None:
    """Add ``loads`` to the parser's commands."""
    loads = commands.add_parser(
        "loads",
        help="the influence of loads on a muscle",
        description="Rest, natural frequency, damping, overshoot, settling time, work and air of a "
        "hanging load, against load and pressure.",
    )
    loads.add_argument(
        "--muscle",
        default="DMSP-20-400N",
        metavar="MUSCLE",
        help="name in the catalogue, or a muscle file (default: DMSP-20-400N)",
    )
    loads.add_argument(
        "--masses",
        nargs="+",
        default=[5, 10, 20, 50, 100],
        metavar="KG",
        help="numbers in kg, or with a unit, such as '500 g'",
    )
    loads.add_argument(
        "--pressures",
        nargs="+",
        default=[1, 2, 3, 4, 5, 6],
        metavar="BAR",
        help="numbers in bar, or with a unit, such as '300 kPa'",
    )
    add_out(loads, "DIR", "write loads.csv and loads.png into this folder")
    add_json(loads)
    loads.set_defaults(run=_loads)


def add_muscles(commands: Any) -> None:
    """Add ``muscles`` to the parser's commands."""
    muscles = commands.add_parser(
        "muscles",
        help="list the catalogue of muscles, or show one",
        description="Without arguments: the catalogue. 'show NAME': one muscle with its source, "
        "forces "
        "and stiffness.",
    )
    muscles.add_argument("show", nargs="?", choices=("show",), help="show one muscle")
    muscles.add_argument(
        "name", nargs="?", metavar="NAME", help="name in the catalogue, or a muscle file"
    )
    add_rest_length(muscles, " (where the catalogue holds none)")
    add_plot(muscles, "draw force over contraction and pressure")
    add_json(muscles)
    muscles.set_defaults(run=_muscles)


def _loads(options: argparse.Namespace) -> int:
    from ..core.files import make_folder
    from ..figures.saved import save_figure
    from ..studies.loads import load_study

    folder = make_folder(options.out) if options.out else None
    masses = [_in("--masses", m, "kg") for m in options.masses]
    pressures = [_in("--pressures", p, "bar") for p in options.pressures]
    study = load_study(muscle_named(options.muscle), masses, pressures)
    tell(options, study, lambda: {"cases": [asdict(c) for c in study.cases]})
    if folder:
        wrote(options, study.save(folder / "loads.csv"))
        wrote(options, save_figure(study.plot(), folder / "loads.png"))
    return 0


def _in(option: str, value: str | float, unit: str) -> float:
    """In SI, of a text with a unit, or of a number in ``unit``."""
    from ..core.quantities import quantity
    from ..core.units import unit as unit_of

    text = str(value)
    try:
        return float(text) * unit_of(unit).factor
    except ValueError:
        return quantity(option, text, unit)


def _muscles(options: argparse.Namespace) -> int:
    from ..muscles.catalogue import muscle_names, summary, transfer_note

    if options.show:
        return _show(options)
    lines = {name: summary(name) for name in muscle_names()}
    text = "\n".join(lines.values())
    tell(options, f"{text}\n\n{transfer_note()}", {"muscles": lines})
    return 0


def _show(options: argparse.Namespace) -> int:
    if options.name is None:
        raise InputError("muscles show: give the NAME of a muscle; 'pam-ocp muscles' lists them")
    from ..muscles.catalogue import attribution, muscle_names

    muscle = muscle_named(options.name, length_of("--rest-length", options.rest_length))
    said = f"\n\n{attribution(options.name)}" if options.name in muscle_names() else ""
    tell(options, f"{muscle_text(muscle)}{said}", lambda: _data(muscle))
    if options.plot:
        from ..figures.saved import save_figure
        from ..figures.trajectory import plot_muscle

        wrote(options, save_figure(plot_muscle(muscle), options.plot))
    return 0


def _data(muscle: Any) -> dict[str, Any]:
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

    from ..muscles.validity import ValidityWarning

    low, high = muscle.contraction_range
    pressures = [muscle.pressure_range[1] * i / 6 for i in range(1, 7)]
    contractions = [max(low, 0.0) + (high - max(low, 0.0)) * i / 5 for i in range(6)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ValidityWarning)
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

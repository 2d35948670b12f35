"""The command ``pam-ocp``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .. import __version__
from ..core.errors import InputError, PamError
from ..core.interrupts import interruptible
from ..core.stop import limited
from .components import add_components
from .fit import add_fit_plant
from .ladder import add_ladder
from .linearize import add_linearize
from .mpc import add_mpc
from .options import length_of, require_places
from .plan import add_plan
from .plants import add_plant, muscle_named, plant_said
from .reading import add_look
from .report import add_report
from .simulate import add_compare, add_simulate
from .static import add_campaign, add_fit, add_fit_holds
from .systems import EPILOG, is_system, write_system

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (0 done, 1 checked and found wanting, 2 bad input)."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if not hasattr(options, "run"):
        parser.print_help()
        return 2
    try:
        seconds = None if options.command == "check" else options.time_limit
        with _plain_warnings(), _terminable(), interruptible(), limited(seconds):
            return int(options.run(options) or 0)
    except PamError as error:
        print(f"pam-ocp {options.command}: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader (head, less) has seen enough
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 - the interpreter flushes it at its end
        return 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """A warning is a line that says what it says, without a place in our code."""
    before = warnings.formatwarning

    def plain(message: Warning | str, *_: Any, **__: Any) -> str:
        return f"pam-ocp: {message}\n"

    warnings.formatwarning = plain
    try:
        yield
    finally:
        warnings.formatwarning = before


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pam-ocp",
        description="Pneumatic artificial muscles: fit a measured muscle, plan its optimal motion, "
        "export the plant as an FMU.",
        epilog="Start with 'pam-ocp tour': it does all of it on a bundled measured muscle. "
        "Exit codes: 0 done; 1 checked, and something was found; 2 bad input; 3 planned, but not "
        "verified; 130 interrupted; 143 ended.",
    )
    parser.add_argument("--version", action="version", version=f"pam-ocp {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")

    for add in (
        _add_tour,
        add_look,
        add_fit,
        add_campaign,
        add_fit_holds,
        add_fit_plant,
        add_ladder,
        _add_export,
        _add_check,
        _add_loads,
        _add_muscles,
        add_components,
        add_simulate,
        add_compare,
        add_linearize,
        add_report,
        add_plan,
        add_mpc,
    ):
        add(commands)
    for name, command in commands.choices.items():
        if name != "check":  # its own
            command.add_argument(
                "--time-limit",
                type=float,
                metavar="S",
                help="end after so many seconds (default: no limit)",
            )
    return parser


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends the command as Ctrl-C does, its children and temporary files with it: 143."""

    def asked(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    mine = threading.current_thread() is threading.main_thread()
    default = mine and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if default:
        signal.signal(signal.SIGTERM, asked)
    try:
        yield
    finally:
        if default:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _add_tour(commands: Any) -> None:
    tour = commands.add_parser("tour", help="the whole chain on a bundled measured muscle")
    tour.add_argument(
        "--out",
        type=Path,
        default=Path("tour"),
        metavar="DIR",
        help="folder for the results (default: tour)",
    )
    tour.set_defaults(run=_tour)


def _add_export(commands: Any) -> None:
    export = commands.add_parser(
        "export",
        help="export a plant as an FMU, a system as an SSP",
        description="Export a plant as an FMU for Model Exchange and Co-Simulation, or a system "
        "file as an SSP of such units.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_plant(export)
    export.add_argument(
        "--fmi",
        choices=("2.0", "3.0"),
        help="version of the standard (default: 2.0, which every tool reads)",
    )
    export.add_argument(
        "--platform",
        action="append",
        metavar="NAME",
        help="native, or a platform by name (may be repeated; default: the usual five; on request "
        "x86-linux, x86-windows, aarch64-windows)",
    )
    for kind, rest in (("input", "tunable parameters"), ("output", "local variables")):
        export.add_argument(
            f"--{kind}",
            action="append",
            metavar="NAME",
            help=f"{kind} that the FMU shows (may be repeated; default: all; the rest become "
            f"{rest})",
        )
    export.add_argument("--out", type=Path, metavar="FILE", help="default: PLANT.fmu or SYSTEM.ssp")
    export.set_defaults(run=_export)


def _add_check(commands: Any) -> None:
    check = commands.add_parser(
        "check",
        help="check an FMU",
        description="Validate an FMU and run it by fmpy. Exit code 0 when nothing is found, 1 "
        "otherwise.",
    )
    check.add_argument("fmu", type=Path, metavar="FMU")
    check.add_argument(
        "--against",
        type=Path,
        metavar="FILE",
        help="Trajectory (.npz, .parquet) whose inputs are replayed and whose outputs are compared",
    )
    check.add_argument(
        "--time-limit",
        type=float,
        default=60.0,
        metavar="S",
        help="stop the FMU after so many seconds, which is a finding (default 60)",
    )
    check.set_defaults(run=_check)


def _add_loads(commands: Any) -> None:
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
    loads.add_argument(
        "--out", type=Path, metavar="DIR", help="write loads.csv and loads.png into this folder"
    )
    loads.set_defaults(run=_loads)


def _add_muscles(commands: Any) -> None:
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
    muscles.add_argument(
        "--rest-length", metavar="M", help="such as '300 mm', where the catalogue holds none"
    )
    muscles.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="draw force over contraction and pressure"
    )
    muscles.set_defaults(run=_muscles)


def _tour(options: argparse.Namespace) -> int:
    from ..studies.tour import tour

    tour(options.out, say=lambda text: print(text, flush=True))
    return 0


def _export(options: argparse.Namespace) -> int:
    from ..export import export_fmu

    target: Path | None = options.out
    require_places(target)
    if is_system(options.plant):
        given = (options.fmi, options.platform, options.allow_code)
        print(f"-> {write_system(options.plant, target, *given)}")
        return 0
    plant = plant_said(options)
    target = target or Path(f"{plant.name}.fmu")
    chosen = {"inputs": options.input, "outputs": options.output}
    fmu = export_fmu(plant, target, fmi=options.fmi or "2.0", platforms=options.platform, **chosen)
    print(f"-> {fmu}")
    return 0


def _check(options: argparse.Namespace) -> int:
    from ..core.trajectory import Trajectory
    from ..export import check_fmu

    reference = Trajectory.load(options.against) if options.against else None
    result = check_fmu(options.fmu, against=reference, time_limit=options.time_limit)
    print(result)
    return 0 if result.ok else 1


def _loads(options: argparse.Namespace) -> int:
    from ..core.files import make_folder
    from ..figures.saved import save_figure
    from ..studies.loads import load_study

    folder = make_folder(options.out) if options.out else None
    masses = [_in("--masses", m, "kg") for m in options.masses]
    pressures = [_in("--pressures", p, "bar") for p in options.pressures]
    study = load_study(muscle_named(options.muscle), masses, pressures)
    print(study)
    if folder:
        print(f"-> {study.save(folder / 'loads.csv')}")
        print(f"-> {save_figure(study.plot(), folder / 'loads.png')}")
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
    for name in muscle_names():
        print(summary(name))
    print(f"\n{transfer_note()}")
    return 0


def _show(options: argparse.Namespace) -> int:
    if options.name is None:
        raise InputError("muscles show: give the NAME of a muscle; 'pam-ocp muscles' lists them")
    from ..muscles.catalogue import attribution, muscle_names

    muscle = muscle_named(options.name, length_of("--rest-length", options.rest_length))
    print(muscle_text(muscle))
    if options.name in muscle_names():
        print(f"\n{attribution(options.name)}")
    if options.plot:
        from ..figures.saved import save_figure
        from ..figures.trajectory import plot_muscle

        print(f"-> {save_figure(plot_muscle(muscle), options.plot)}")
    return 0


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

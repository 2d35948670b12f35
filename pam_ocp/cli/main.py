"""The command ``pam-ocp``."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..core.errors import InputError, PamError
from ..core.stop import limited
from .components import add_components
from .fit import add_fit_plant
from .ladder import add_ladder
from .mpc import add_mpc
from .options import add_allow_code, require_places
from .plan import add_plan

__all__ = ["main"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (0 done, 1 checked and found wanting, 2 bad input)."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if not hasattr(options, "run"):
        parser.print_help()
        return 2
    try:
        with _terminable(), limited(None if options.command == "check" else options.time_limit):
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


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="pam-ocp",
        description="Pneumatic artificial muscles: fit a measured muscle, plan its optimal motion, "
        "export the plant as an FMU.",
        epilog="Start with 'pam-ocp tour': it does all of it on a bundled measured muscle.",
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")

    for add in (
        _add_tour,
        _add_fit,
        add_fit_plant,
        add_ladder,
        _add_export,
        _add_check,
        _add_loads,
        _add_muscles,
        add_components,
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


def _add_fit(commands: Any) -> None:
    fit = commands.add_parser("fit", help="fit a force law to a measured table")
    fit.add_argument(
        "table",
        metavar="TABLE",
        help="CSV with length (or contraction), pressure, force; units in the header, as in "
        "length_m,pressure_Pa,force_N; or a bundled table such as DMSP-20-300_static.csv",
    )
    fit.add_argument(
        "--rest-length",
        type=float,
        metavar="M",
        help="length at zero pressure and load, in metres (needed unless the table holds "
        "contractions)",
    )
    fit.add_argument(
        "--diameter", type=float, metavar="M", help="inner diameter at rest, in metres"
    )
    fit.add_argument(
        "--law",
        default="six-parameter",
        metavar="LAW",
        help="force law (default: six-parameter); also polynomial-1-3 (degrees), "
        "spline-3:0,0.1,0.25 "
        "(degree and contractions)",
    )
    fit.add_argument(
        "--loss",
        default="squares",
        metavar="LOSS",
        help="squares (default); bisquare, where some cells are measured wrong; huber; l1",
    )
    fit.add_argument("--name", metavar="NAME", help="name of the muscle in the muscle file")
    fit.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the muscle file (.toml, .json) that the other commands take",
    )
    fit.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="draw measurement, law and residuals"
    )
    fit.set_defaults(run=_fit)


def _add_export(commands: Any) -> None:
    export = commands.add_parser(
        "export",
        help="export a plant as an FMU",
        description="Export a plant as an FMU for Model Exchange and Co-Simulation.",
    )
    export.add_argument(
        "plant",
        metavar="PLANT",
        help="a plant of the library by name, such as HangingLoad or AntagonisticSlide; "
        "FILE.py:NAME "
        "(a Plant, or a function that returns one); or FILE.toml with a table [plant]",
    )
    export.add_argument(
        "--muscle",
        default="DMSP-20-300",
        metavar="MUSCLE",
        help="name in the catalogue, or a muscle file (default: DMSP-20-300)",
    )
    export.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value of a parameter or start value, in SI (may be repeated)",
    )
    export.add_argument(
        "--fmi",
        choices=("2.0", "3.0"),
        default="2.0",
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
    export.add_argument("--out", type=Path, metavar="FILE.fmu", help="default: PLANT.fmu")
    add_allow_code(export)
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
        "--masses", type=float, nargs="+", default=[5, 10, 20, 50, 100], metavar="KG"
    )
    loads.add_argument(
        "--pressures", type=float, nargs="+", default=[1, 2, 3, 4, 5, 6], metavar="BAR"
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
        "--rest-length", type=float, metavar="M", help="in metres, where the catalogue holds none"
    )
    muscles.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="draw force over contraction and pressure"
    )
    muscles.set_defaults(run=_muscles)


def _tour(options: argparse.Namespace) -> int:
    from ..studies.tour import tour

    tour(options.out, say=lambda text: print(text, flush=True))
    return 0


def _fit(options: argparse.Namespace) -> int:
    from ..fitting.static.static import fit_force
    from ..fitting.tables.force_table import read_table
    from ..muscles.muscle_file import save_muscle

    require_places(options.out, options.plot)
    table = read_table(options.table, rest_length=options.rest_length)
    fitted = fit_force(table, options.law, loss=options.loss)
    print(fitted.report())
    if options.plot:
        from ..figures.saved import save_figure
        from ..figures.trajectory import plot_fit

        print(f"-> {save_figure(plot_fit(fitted), options.plot)}")
    if options.out:
        length = table.rest_length if options.rest_length is None else options.rest_length
        if length is None:
            raise InputError("--rest-length is needed to write a muscle file")
        name = options.name or Path(options.table).stem
        muscle = fitted.muscle(rest_length=length, diameter=options.diameter, name=name)
        print(f"-> {save_muscle(muscle, options.out)}")
    return 0


def _export(options: argparse.Namespace) -> int:
    from ..export import export_fmu

    target: Path | None = options.out
    require_places(target)
    plant = _plant(options.plant, options.muscle, options.allow_code)
    values = {}
    for text in options.set:
        name, equals, number = text.partition("=")
        try:
            values[name.strip()] = float(number)
        except ValueError:
            equals = ""
        if not equals:
            raise InputError(f"--set {text}: give NAME=VALUE with a number in SI, as in mass=3.0")
    plant = plant.with_values(values)
    target = target or Path(f"{plant.name}.fmu")
    chosen = {"inputs": options.input, "outputs": options.output}
    fmu = export_fmu(plant, target, fmi=options.fmi, platforms=options.platform, **chosen)
    print(f"-> {fmu}")
    return 0


def _plant(name: str, muscle_name: str, allow_code: bool) -> Any:
    """A plant by its name, from a user's file (FILE.py:NAME), or from a table (FILE.toml).

    A file named on the command line is run; one named in another file only with ``allow_code``.
    """
    from ..core.files import read_toml, reading
    from ..plants.plant_file import named_plant, plant_of

    if name.endswith(".toml"):
        content = read_toml(name)
        with reading(name, "a plant", "give it a table [plant], as for 'pam-ocp plan'"):
            where = f"{name}: plant"
            folder = Path(name).parent
            return plant_of(content.get("plant"), where, folder, allow_code=allow_code)
    return named_plant(name, _muscle(muscle_name), allow_code=True)


def _muscle(name: str, rest_length: float | None = None) -> Any:
    from ..muscles.catalogue import muscle
    from ..muscles.muscle_file import ENDINGS, load_muscle

    return load_muscle(name) if name.endswith(ENDINGS) else muscle(name, rest_length=rest_length)


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
    study = load_study(
        _muscle(options.muscle), options.masses, [p * 1e5 for p in options.pressures]
    )
    print(study)
    if folder:
        print(f"-> {study.save(folder / 'loads.csv')}")
        print(f"-> {save_figure(study.plot(), folder / 'loads.png')}")
    return 0


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
    muscle = _muscle(options.name, options.rest_length)
    print(muscle_text(muscle))
    if options.plot:
        from ..figures.saved import save_figure
        from ..figures.trajectory import plot_muscle

        print(f"-> {save_figure(plot_muscle(muscle), options.plot)}")
    return 0


def muscle_text(muscle: Any) -> str:
    """A muscle's source and a table of its force [N] over pressure and contraction."""
    import warnings

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

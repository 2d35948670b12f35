"""The commands of static measurements: ``pam-ocp fit``, ``campaign`` and ``fit-holds``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from ..core.files import require_ending
from ..core.quantities import quantity
from ..studies.plant_fit_problem import values
from .options import (
    PLANT,
    add_diameter,
    add_out,
    add_plant_options,
    add_plot,
    add_rest_length,
    length_of,
    pairs,
    plant_said,
    require_places,
)
from .output import add_json, coefficients, tell, wrote
from .reading import add_floor, add_reading, reading_options

if TYPE_CHECKING:
    from ..fitting.static.force_fit import ForceFit
    from ..fitting.tables.force_table import ForceTable

LOSSES = "squares (default); bisquare, where some cells are measured wrong; huber; l1"


def add_fit(commands: Any) -> None:
    """Add ``fit`` to the parser's commands."""
    fit = commands.add_parser(
        "fit",
        help="fit a force law to a measured table",
        description="Fit a force law to a measured table. A folder of tables: 'pam-ocp campaign'; "
        "equilibria under a spring or a load: 'pam-ocp fit-holds'; time series: 'pam-ocp "
        "fit-plant'.",
    )
    fit.add_argument(
        "table",
        metavar="TABLE",
        help="file with length (or contraction), pressure, force; units in the header, as in "
        "length_m,pressure_Pa,force_N ('pam-ocp look' says what is understood); or a bundled "
        "table such as DMSP-20-300_static.csv",
    )
    add_rest_length(fit, " (needed unless the table holds contractions)")
    add_diameter(fit)
    fit.add_argument(
        "--law",
        action="append",
        metavar="LAW",
        help="force law (default: six-parameter); also polynomial-1-3 (degrees), "
        "spline-3:0,0.1,0.25 (degree and contractions); several, or 'all', are "
        "ranked by leaving out lengths, and the best is fitted",
    )
    add_reading(fit)
    add_floor(fit)
    _add_fixed(fit)
    fit.add_argument("--loss", default="squares", metavar="LOSS", help=LOSSES)
    fit.add_argument(
        "--branches", action="store_true", help="also fit each branch, and report the hysteresis"
    )
    fit.add_argument("--name", metavar="NAME", help="name of the muscle in the muscle file")
    fit.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the muscle file (.toml, .json) that the other commands take",
    )
    fit.add_argument(
        "--save",
        type=Path,
        metavar="FILE",
        help="write the fit itself: data, intervals, residuals (.json for 'report', .html, .csv, "
        ".txt)",
    )
    fit.add_argument(
        "--ssv",
        type=Path,
        metavar="FILE.ssv",
        help="write the parameters as a parameter set of a plant's FMU (SSP 1.0)",
    )
    fit.add_argument(
        "--muscles",
        nargs="+",
        metavar="NAME",
        help="names of the muscles in that FMU, such as muscle1 muscle2 (default: muscle)",
    )
    fit.add_argument(
        "--excel",
        type=Path,
        metavar="FILE.xlsx",
        help="write a workbook: data, coefficients, the law as live formulas, charts",
    )
    add_plot(fit, "draw measurement, law and residuals")
    add_json(fit)
    fit.set_defaults(run=_fit)


def add_campaign(commands: Any) -> None:
    """Add ``campaign`` to the parser's commands."""
    campaign = commands.add_parser(
        "campaign",
        help="fit a folder of static tables: muscles, branches, repeats, lengths",
        description="Fit every table of a folder: files of one muscle together, each branch, "
        "repeats against each other, muscles of one diameter with shared coefficients, and laws "
        "over lengths. Which muscle, branch and repeat a file holds is read from columns (muscle, "
        "branch, run, rest_length, diameter), else from its name, as in "
        "DMSP-20-300_filling_run2.csv.",
    )
    campaign.add_argument("tables", nargs="+", metavar="FOLDER", help="folder, or files")
    campaign.add_argument("--law", default="six-parameter", metavar="LAW", help="force law")
    for name, words in (
        ("rest-length", "length at zero pressure and load"),
        ("diameter", "inner diameter at rest"),
    ):
        campaign.add_argument(
            f"--{name}",
            nargs="+",
            metavar="[NAME=]M",
            help=f"{words}, of all muscles, or by (a part of) the name: 0.3, 300mm, 'A=300mm'",
        )
    campaign.add_argument(
        "--shared",
        nargs="+",
        metavar="NAME",
        help="coefficients shared by muscles of one diameter (default: all)",
    )
    add_reading(campaign)
    add_floor(campaign)
    _add_fixed(campaign)
    campaign.add_argument("--loss", default="squares", metavar="LOSS", help=LOSSES)
    campaign.add_argument(
        "--out", type=Path, metavar="DIR", help="write report, table, fits and muscle files"
    )
    campaign.add_argument(
        "--plot", type=Path, metavar="DIR", help="draw each muscle into this folder"
    )
    add_json(campaign)
    campaign.set_defaults(run=_campaign)


def add_fit_forces(commands: Any) -> None:
    """Add ``fit-forces`` to the parser's commands."""
    forces = commands.add_parser(
        "fit-forces",
        help="fit one law to the tables of several muscles with shared coefficients",
        description="Fit one force law to the tables of several muscles, with shared "
        "coefficients; print all with intervals. A folder with branches and "
        "repeats: 'pam-ocp campaign'.",
    )
    forces.add_argument("tables", nargs="+", metavar="TABLE", help="a file for each muscle")
    forces.add_argument("--law", default="six-parameter", metavar="LAW", help="force law")
    forces.add_argument(
        "--rest-length",
        nargs="+",
        metavar="[NAME=]L",
        help="at zero pressure and load, of all muscles, or by the table's name: 0.3, 'A=300mm'",
    )
    forces.add_argument(
        "--shared", nargs="+", metavar="NAME", help="common coefficients (default: all)"
    )
    forces.add_argument(
        "--noise",
        choices=("equal", "each"),
        default="equal",
        help="one standard deviation for all tables (default), or one for each",
    )
    add_reading(forces)
    add_floor(forces)
    _add_fixed(forces)
    add_out(forces, "DIR", "write a muscle file for each table into this folder")
    forces.add_argument("--plot", type=Path, metavar="DIR", help="draw each muscle into it")
    add_json(forces)
    forces.set_defaults(run=_fit_forces)


def add_fit_holds(commands: Any) -> None:
    """Add ``fit-holds`` to the parser's commands."""
    holds = commands.add_parser(
        "fit-holds",
        help="fit a spring, a load, zeros of sensors, friction to measured equilibria",
        description="Estimate parameters of a plant from measured equilibria (holds): a table with "
        "a row for each, columns named as the plant's variables, such as "
        "'muscle_pressure [bar],x [mm],side'. side: below (positions rose to the hold) or above.",
    )
    holds.add_argument("holds", metavar="TABLE", help="a hold per row")
    holds.add_argument("--plant", required=True, metavar="PLANT", help=PLANT)
    add_plant_options(holds)
    holds.add_argument(
        "--estimate",
        nargs="+",
        required=True,
        metavar="NAME",
        help="parameters; zero.NAME, of a sensor; band.NAME, half the width of the hysteresis",
    )
    holds.add_argument("--measured", nargs="+", metavar="NAME", help="variables to compare")
    holds.add_argument("--side", metavar="SIDE", help="below, above, or sequence: from row to row")
    holds.add_argument("--inputs", nargs="+", default=[], metavar="NAME=VALUE", help="constants")
    add_reading(holds)
    holds.add_argument("--loss", default="squares", metavar="LOSS", help="squares, huber, bisquare")
    holds.add_argument("--out", type=Path, metavar="FILE.json", help="write the fit")
    add_json(holds)
    holds.set_defaults(run=_fit_holds)


def _add_fixed(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--fixed",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="coefficients to hold, and known constants of laws, as a3=-40 radius=10mm",
    )


# ---- what they do -------------------------------------------------------------------------------
def _fixed(texts: Sequence[str], laws: Iterable[str]) -> dict[str, float]:
    from ..studies.steps.measured import fixed_values

    return fixed_values(laws, pairs("--fixed", texts))


def _fit(options: argparse.Namespace) -> int:
    if options.muscles and options.ssv is None:
        raise InputError("--muscles names those of an FMU: give --ssv, the file for it")
    from ..fitting.static.static import fit_force
    from ..fitting.tables.force_table import read_table
    from ..muscles.muscle_file import ending_of, save_muscle
    from ..studies.file_kinds import require_role

    require_places(options.out, options.save, options.plot, options.ssv, options.excel)
    if options.out:
        ending_of(options.out)
    if options.ssv:
        require_ending(options.ssv, ".ssv", "a set of parameters")
    length = length_of("--rest-length", options.rest_length)
    diameter = length_of("--diameter", options.diameter)
    require_role(options.table, "table")
    table = read_table(options.table, rest_length=length, **reading_options(options))
    laws = options.law or ["six-parameter"]
    if len(laws) > 1 or laws == ["all"]:
        fitted = _ranked(options, table, laws)
    else:
        fixed = _fixed(options.fixed, laws)
        fitted = fit_force(table, laws[0], loss=options.loss, fixed=fixed)
    branches = _branch_lines(fitted) if options.branches else []
    tell(options, fitted.report(), lambda: fit_data(fitted))
    if branches:
        tell(options, "\n".join(branches))
    if options.plot:
        from ..figures.saved import save_figure
        from ..figures.trajectory import plot_fit

        wrote(options, save_figure(plot_fit(fitted), options.plot))
    if options.excel:
        wrote(options, fitted.to_excel(options.excel))
    if options.out:
        length = table.rest_length if length is None else length
        if length is None:
            raise InputError("--rest-length is needed to write a muscle file")
        name = options.name or Path(options.table).stem
        muscle = fitted.muscle(rest_length=length, diameter=diameter, name=name)
        wrote(options, save_muscle(muscle, options.out))
    if options.save:
        wrote(options, fitted.save(options.save))
    if options.ssv:
        wrote(
            options, fitted.save_ssv(options.ssv, options.muscles or ["muscle"], rest_length=length)
        )
    return 0


def fit_data(fit: ForceFit) -> dict[str, Any]:
    """A fit as plain data, for JSON."""
    return {
        "law": fit.law.name,
        "cells": fit.n,
        "rmse": fit.rmse,
        "r2": fit.r2,
        "coefficients": coefficients(fit),
        "warnings": fit.warnings,
    }


def _ranked(options: argparse.Namespace, table: ForceTable, laws: Sequence[str]) -> ForceFit:
    """The best of several laws at lengths left out; the ranking is printed."""
    from ..core.errors import FitError
    from ..fitting.static.static import compare_laws
    from ..muscles.law import LAWS

    if options.loss != "squares":
        raise InputError("--loss: several laws are ranked by least squares; give one --law with it")
    chosen = [*LAWS, "polynomial-1-3"] if laws == ["all"] else laws
    comparison = compare_laws(table, chosen, fixed=_fixed(options.fixed, chosen))
    tell(options, f"{comparison}\n")
    best = comparison.best.fit
    if best is None:
        raise FitError(f"none of the laws could be fitted: {comparison.best.problem}")
    return best


def _branch_lines(fitted: ForceFit) -> list[str]:
    from ..fitting.static.report import hysteresis
    from ..fitting.static.static import fit_branches

    table, fixed = fitted.table, {n: float(fitted.law.values[n]) for n in fitted.held}
    lines = []
    for name, fit in fit_branches(
        table, type(fitted.law), fixed=fixed, loss=fitted.terms.loss
    ).items():
        lines += ["", f"[[Branch {name}]]", *fit.report().splitlines()]
    return [*lines, "", str(hysteresis(table))]


def _campaign(options: argparse.Namespace) -> int:
    from ..core.files import make_folder
    from ..fitting.static.campaign import CANDIDATES, fit_forces

    tables: Any = options.tables
    if len(tables) == 1 and Path(tables[0]).is_dir():
        tables = tables[0]
    result = fit_forces(
        tables,
        options.law,
        candidates=CANDIDATES,
        rest_length=_lengths("--rest-length", options.rest_length),
        diameter=_lengths("--diameter", options.diameter),
        shared=options.shared or "all",
        fixed=_fixed(options.fixed, [options.law]),
        loss=options.loss,
        reading=reading_options(options),
    )
    tell(options, result.report(), lambda: {"muscles": result.table()})
    if options.out:
        wrote(options, result.save(options.out))
    if options.plot:
        from ..figures.saved import save_figure
        from ..figures.trajectory import plot_fit

        folder = make_folder(options.plot)
        for name, study in result.muscles.items():
            plain = "".join(c if c.isalnum() or c in "-+." else "_" for c in name)
            wrote(options, save_figure(plot_fit(study.fit), folder / f"{plain}.png"))
    return 0


def _fit_forces(options: argparse.Namespace) -> int:
    from ..core.errors import FitError
    from ..core.files import make_folder
    from ..fitting.static.campaign import fit_forces
    from ..fitting.tables.force_table import read_table
    from ..muscles.muscle_file import save_muscle

    lengths = _lengths("--rest-length", options.rest_length)
    tables = {}
    for file in options.tables:
        name = Path(file).stem
        if name in tables:
            raise InputError(f"{file}: a second table of the name {name}; give each its own")
        length = _of(lengths, name) if isinstance(lengths, dict) else lengths
        tables[name] = read_table(file, rest_length=length, **reading_options(options))
    try:
        joint = fit_forces(
            tables,
            options.law,
            shared=options.shared or "all",
            fixed=_fixed(options.fixed, [options.law]),
            noise=options.noise,
        )
    except FitError as error:
        print(f"pam-ocp fit-forces: {error}", file=sys.stderr)
        return 1
    tell(
        options,
        joint.report(),
        lambda: {"coefficients": coefficients(joint), "rmse": joint.rmse, "tables": list(tables)},
    )
    for name in tables:
        if options.out:
            path = make_folder(options.out) / f"{name}.toml"
            wrote(options, save_muscle(joint[name].muscle(name=name), path))
        if options.plot:
            from ..figures.saved import save_figure

            drawn = joint[name].plot()
            wrote(options, save_figure(drawn, make_folder(options.plot) / f"{name}.png"))
    return 0


def _of(lengths: dict[str, float], name: str) -> float | None:
    """The length of the muscle whose name holds a key."""
    return next((v for n, v in lengths.items() if n in name), None)


def _lengths(option: str, texts: Sequence[str] | None) -> Any:
    """One length for all, or {name: length} [m]."""
    if not texts:
        return None
    if len(texts) == 1 and "=" not in texts[0]:
        return quantity(option, texts[0], "m")
    return {n: quantity(f"{option} {n}", v, "m") for n, v in pairs(option, texts).items()}


def _fit_holds(options: argparse.Namespace) -> int:
    from ..core.errors import FitError
    from ..fitting.static.holds import fit_holds

    require_places(options.out)
    plant = plant_said(options)
    try:
        fit = fit_holds(
            plant,
            options.holds,
            options.estimate,
            measured=options.measured,
            side=options.side,
            inputs=values("inputs", plant, pairs("--inputs", options.inputs)),
            loss=options.loss,
            **reading_options(options),
        )
    except FitError as error:
        print(f"pam-ocp fit-holds: {error}", file=sys.stderr)
        return 1
    said = {"parameters": coefficients(fit), "rmse": fit.rmse, "warnings": fit.warnings}
    tell(options, fit.report(), said)
    if options.out:
        wrote(options, fit.save(options.out))
    return 0

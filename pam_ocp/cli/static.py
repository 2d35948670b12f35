"""The commands of static measurements: ``pam-ocp look`` (what a file holds), ``fit``, ``campaign``,
``fit-forces`` and ``fit-holds``.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pam_ocp as pam

from ..core.errors import FitError, InputError
from ..core.files import make_folder, require_ending
from ..core.quantities import quantity
from ..studies.problem import values
from .command import (
    asked,
    choice,
    command,
    file,
    flag,
    number,
    option,
    output,
    pairs,
    plot,
    repeated,
    several,
)
from .options import (
    DIAMETER,
    FLOOR,
    PLANT,
    PLANT_VALUES,
    READING,
    length_of,
    number_in,
    plant_said,
    reading_options,
    rest_length,
)
from .output import coefficients, deliver, picture, tell, wrote

if TYPE_CHECKING:
    from ..fitting.static.force_fit import ForceFit
    from ..fitting.tables.force_table import ForceTable
    from ..studies.file_kinds import FileKind

LOOK = """\
  pam-ocp look rig.csv --rest-length "300 mm"
  pam-ocp look rig.txt --columns "length [mm]" "pressure [bar]" "force [N]"
  pam-ocp look rig.xlsx --sheet M3 --columns pressure=ch1 --units "pressure=V * 2 bar/V - 0.3 bar"
  pam-ocp look run7.csv --clock cut

Nothing is fitted. Exit code: 0 if the file can be read, 1 if information is missing (it is
printed), 2 for an invalid file or option.
"""
LOSS = option(
    "--loss",
    "LOSS",
    "squares (default); bisquare, where some cells are measured wrong; huber; l1",
    default="squares",
)
RANKED = ("name", "parameters", "rmse", "aic", "bic", "left_out_rmse", "problem")
"""What a ranking says of each law."""
LAW = option("--law", "LAW", "force law", default="six-parameter")
FIXED = several(
    "--fixed",
    "NAME=VALUE",
    "coefficients to hold, and known constants of laws, as a3=-40 radius=10mm",
    default=[],
)


# ---- look ----------------------------------------------------------------------------------------
@command(
    "look",
    "show how measured files are interpreted, before fitting",
    several("files", "FILE", "files, folders or patterns"),
    *READING,
    FLOOR,
    rest_length(),
    choice("--kind", ("table", "record"), "if taken for the other"),
    option("--time", "HEADER", "column of the time of a record"),
    choice("--clock", ("mend", "cut", "refuse"), "of a record (default: mend)"),
    option("--max-gap", "S", "longest step that is not a gap", type=number),
    option("--sample-time", "S", "resample a record, or 'even'"),
    about="Print how files are interpreted, column by column: names, units, ranges, "
    "empty cells, the clock, ramps, warnings, and the call that reads them.",
    epilog=LOOK,
)
def _look(options: argparse.Namespace) -> int:
    from ..fitting.tables.preview import Previews
    from ..studies.file_kinds import kind_of

    if len(options.files) == 1 and Path(options.files[0]).is_file():
        kind = kind_of(options.files[0])
        if "table" not in kind.roles:
            return _look_at_ours(options, kind)
    said = reading_options(options)
    own = asked(options, "rest_length", "kind", "time", "clock", "max_gap", "sample_time")
    said |= {name: number_in(value) for name, value in own.items()}
    source = options.files[0] if len(options.files) == 1 else options.files
    seen = pam.fitting.look(source, **said)
    views = seen if isinstance(seen, Previews) else [seen]
    tell(options, seen, lambda: [view.to_dict() for view in views])
    return 0 if seen.ok else 1


def _look_at_ours(options: argparse.Namespace, kind: FileKind) -> int:
    """A file that a command wrote: what it is and holds, and who takes it."""
    path = Path(options.files[0])
    held = "" if kind.read is None else str(kind.read(path))
    words = f"{path} is {kind.words}, taken {kind.use}"
    tell(options, f"{words}\n{held}".rstrip(), {"kind": kind.words, "use": kind.use, "is": held})
    return 0


# ---- fit -----------------------------------------------------------------------------------------
@command(
    "fit",
    "fit a force law to a measured table",
    option(
        "table",
        "TABLE",
        "file with length (or contraction), pressure, force; units in the header, as in "
        "length_m,pressure_Pa,force_N ('pam-ocp look' says what is understood); or a bundled "
        "table such as DMSP-20-300_static.csv",
    ),
    rest_length(" (needed unless the table holds contractions)"),
    DIAMETER,
    repeated(
        "--law",
        "LAW",
        "force law (default: six-parameter); also polynomial-1-3 (degrees), "
        "spline-3:0,0.1,0.25 (degree and contractions); several, or 'all', are "
        "ranked by leaving out lengths, and the best is fitted",
    ),
    *READING,
    FLOOR,
    FIXED,
    LOSS,
    flag("--branches", "also fit each branch, and report the hysteresis"),
    option("--name", "NAME", "name of the muscle in the muscle file"),
    output("--out", "FILE", "write the muscle file (.toml, .json) that the other commands take"),
    output(
        "--save",
        "FILE",
        "write the fit itself: data, intervals, residuals (.json for 'report', .html, .csv, .txt)",
    ),
    output(
        "--ssv",
        "FILE.ssv",
        "write the parameters as a parameter set of a plant's FMU (SSP 1.0)",
    ),
    several(
        "--muscles",
        "NAME",
        "names of the muscles in that FMU, such as muscle1 muscle2 (default: muscle)",
    ),
    output(
        "--excel",
        "FILE.xlsx",
        "write a workbook: data, coefficients, the law as live formulas, charts",
        ".xlsx",
    ),
    plot("draw measurement, law and residuals"),
    about="Fit a force law to a measured table. A folder of tables: 'pam-ocp campaign'; "
    "equilibria under a spring or a load: 'pam-ocp fit-holds'; time series: 'pam-ocp fit-plant'.",
)
def _fit(options: argparse.Namespace) -> int:
    if options.muscles and options.ssv is None:
        raise InputError("--muscles names those of an FMU: give --ssv, the file for it")
    from ..muscles.muscle_file import ending_of
    from ..studies.file_kinds import require_role

    if options.out:
        ending_of(options.out)
    if options.ssv:
        require_ending(options.ssv, ".ssv", "a set of parameters")
    length = length_of("--rest-length", options.rest_length)
    diameter = length_of("--diameter", options.diameter)
    require_role(options.table, "table")
    table = pam.read_table(options.table, rest_length=length, **reading_options(options))
    laws = options.law or ["six-parameter"]
    if len(laws) > 1 or laws == ["all"]:
        fitted = _ranked(options, table, laws)
    else:
        fixed = _fixed(options.fixed, laws)
        fitted = pam.fit_force(table, laws[0], loss=options.loss, fixed=fixed)
    branches = _branches(fitted) if options.branches else None
    tell(options, fitted.report(), lambda: fit_data(fitted))
    if branches:
        tell(options, *branches)

    def save(path: Path) -> Path:
        known = table.rest_length if length is None else length
        if known is None:
            raise InputError("--rest-length is needed to write a muscle file")
        name = options.name or Path(options.table).stem
        return pam.save_muscle(fitted.muscle(rest_length=known, diameter=diameter, name=name), path)

    muscles = options.muscles or ["muscle"]
    deliver(
        options,
        plot=picture(fitted.plot),
        excel=fitted.to_excel,
        out=save,
        save=fitted.save,
        ssv=lambda path: fitted.save_ssv(path, muscles, rest_length=length),
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


def _fixed(texts: Sequence[str], laws: Iterable[str]) -> dict[str, float]:
    from ..studies.steps.measured import fixed_values

    return fixed_values(laws, pairs("--fixed", texts))


def _ranked(options: argparse.Namespace, table: ForceTable, laws: Sequence[str]) -> ForceFit:
    """The best of several laws at lengths left out; the ranking is printed."""
    from ..muscles.law import LAWS

    if options.loss != "squares":
        raise InputError("--loss: several laws are ranked by least squares; give one --law with it")
    chosen = [*LAWS, "polynomial-1-3"] if laws == ["all"] else laws
    comparison = pam.compare_laws(table, chosen, fixed=_fixed(options.fixed, chosen))
    ranking = [{n: getattr(law, n) for n in RANKED} for law in comparison.laws]
    tell(options, f"{comparison}\n", {"ranking": ranking})
    best = comparison.best.fit
    if best is None:
        raise FitError(f"none of the laws could be fitted: {comparison.best.problem}")
    return best


def _branches(fitted: ForceFit) -> tuple[str, dict[str, Any]]:
    """Fits of the branches, and the hysteresis: for people, and as plain data."""
    table, fixed = fitted.table, {n: float(fitted.law.values[n]) for n in fitted.held}
    fits = pam.fitting.fit_branches(table, type(fitted.law), fixed=fixed, loss=fitted.terms.loss)
    width = pam.fitting.hysteresis(table)
    text = "".join(f"\n[[Branch {name}]]\n{fit.report()}\n" for name, fit in fits.items())
    return f"{text}\n{width}", {
        "branches": {name: fit_data(fit) for name, fit in fits.items()},
        "hysteresis": {n: getattr(width, n) for n in ("mean", "stderr", "largest")},
    }


# ---- several muscles -----------------------------------------------------------------------------
@command(
    "campaign",
    "fit a folder of static tables: muscles, branches, repeats, lengths",
    several("tables", "FOLDER", "folder, or files"),
    LAW,
    *(
        several(
            f"--{name}",
            "[NAME=]M",
            f"{words}, of all muscles, or by (a part of) the name: 0.3, 300mm, 'A=300mm'",
        )
        for name, words in (
            ("rest-length", "length at zero pressure and load"),
            ("diameter", "inner diameter at rest"),
        )
    ),
    several("--shared", "NAME", "coefficients shared by muscles of one diameter (default: all)"),
    *READING,
    FLOOR,
    FIXED,
    LOSS,
    file("--out", "DIR", "write report, table, fits and muscle files"),
    file("--plot", "DIR", "draw each muscle into this folder"),
    about="Fit every table of a folder: files of one muscle together, each branch, "
    "repeats against each other, muscles of one diameter with shared coefficients, and laws "
    "over lengths. Which muscle, branch and repeat a file holds is read from columns (muscle, "
    "branch, run, rest_length, diameter), else from its name, as in "
    "DMSP-20-300_filling_run2.csv.",
)
def _campaign(options: argparse.Namespace) -> int:
    from ..fitting.static.campaign import CANDIDATES

    tables: Any = options.tables
    if len(tables) == 1 and Path(tables[0]).is_dir():
        tables = tables[0]
    result = pam.fit_forces(
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
    deliver(options, out=result.save)
    if options.plot:
        folder = make_folder(options.plot)
        for name, study in result.muscles.items():
            plain = "".join(c if c.isalnum() or c in "-+." else "_" for c in name)
            wrote(options, picture(study.fit.plot)(folder / f"{plain}.png"))
    return 0


@command(
    "fit-forces",
    "fit one law to the tables of several muscles with shared coefficients",
    several("tables", "TABLE", "a file for each muscle"),
    LAW,
    several(
        "--rest-length",
        "[NAME=]L",
        "at zero pressure and load, of all muscles, or by the table's name: 0.3, 'A=300mm'",
    ),
    several("--shared", "NAME", "common coefficients (default: all)"),
    choice(
        "--noise",
        ("equal", "each"),
        "one standard deviation for all tables (default), or one for each",
        default="equal",
    ),
    *READING,
    FLOOR,
    FIXED,
    file("--out", "DIR", "write a muscle file for each table into this folder"),
    file("--plot", "DIR", "draw each muscle into it"),
    about="Fit one force law to the tables of several muscles, with shared "
    "coefficients; print all with intervals. A folder with branches and "
    "repeats: 'pam-ocp campaign'.",
    fails=FitError,
)
def _fit_forces(options: argparse.Namespace) -> int:
    lengths = _lengths("--rest-length", options.rest_length)
    tables = {}
    for path in options.tables:
        name = Path(path).stem
        if name in tables:
            raise InputError(f"{path}: a second table of the name {name}; give each its own")
        length = _of(lengths, name) if isinstance(lengths, dict) else lengths
        tables[name] = pam.read_table(path, rest_length=length, **reading_options(options))
    joint = pam.fit_forces(
        tables,
        options.law,
        shared=options.shared or "all",
        fixed=_fixed(options.fixed, [options.law]),
        noise=options.noise,
    )
    tell(
        options,
        joint.report(),
        lambda: {"coefficients": coefficients(joint), "rmse": joint.rmse, "tables": list(tables)},
    )
    for name in tables:
        if options.out:
            path = make_folder(options.out) / f"{name}.toml"
            wrote(options, pam.save_muscle(joint[name].muscle(name=name), path))
        if options.plot:
            wrote(options, picture(joint[name].plot)(make_folder(options.plot) / f"{name}.png"))
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


# ---- holds ---------------------------------------------------------------------------------------
@command(
    "fit-holds",
    "fit a spring, a load, zeros of sensors, friction to measured equilibria",
    option("holds", "TABLE", "a hold per row"),
    option("--plant", "PLANT", PLANT, required=True),
    *PLANT_VALUES,
    several(
        "--estimate",
        "NAME",
        "parameters; zero.NAME, of a sensor; band.NAME, half the width of the hysteresis",
        required=True,
    ),
    several("--measured", "NAME", "variables to compare"),
    option("--side", "SIDE", "below, above, or sequence: from row to row"),
    several("--inputs", "NAME=VALUE", "constants", default=[]),
    *READING,
    option("--loss", "LOSS", "squares, huber, bisquare", default="squares"),
    output("--out", "FILE.json", "write the fit"),
    about="Estimate parameters of a plant from measured equilibria (holds): a table with "
    "a row for each, columns named as the plant's variables, such as "
    "'muscle_pressure [bar],x [mm],side'. side: below (positions rose to the hold) or above.",
    fails=FitError,
)
def _fit_holds(options: argparse.Namespace) -> int:
    plant = plant_said(options)
    fit = pam.fitting.fit_holds(
        plant,
        options.holds,
        options.estimate,
        measured=options.measured,
        side=options.side,
        inputs=values("inputs", plant, pairs("--inputs", options.inputs)),
        loss=options.loss,
        **reading_options(options),
    )
    said = {"parameters": coefficients(fit), "rmse": fit.rmse, "warnings": fit.warnings}
    tell(options, fit.report(), said)
    deliver(options, out=fit.save)
    return 0

"""The commands of measured records: ``pam-ocp fit-plant`` (parameters of a plant) and ``ladder``
(which model do the records ask for?).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pam_ocp as pam

from ..core.errors import FitError, InputError
from ..core.files import read_toml, reading
from ..core.progress import heard, working
from ..core.quantities import known_keys, table
from ..studies.problem import (
    FITTING,
    READING,
    bounds_of,
    fit_arguments,
    listed,
    records_of,
    values,
)
from .command import (
    PICTURES,
    asked,
    choice,
    command,
    count,
    file,
    flag,
    named,
    option,
    output,
    pairs,
    several,
)
from .options import ALLOW_CODE, from_here
from .output import coefficients, deliver, picture, tell, wrote

if TYPE_CHECKING:
    from ..plants.plant import Plant

EPILOG = """\
Records: CSV (also TSV, XLSX, NPZ, MAT, Parquet) with a column for the time, for every input of the
plant and for at least one state or output, named as the plant's variables ('_' for '.'), with
units:

  time [s],muscle1_command [bar],muscle2_command [bar],x [mm]

'pam-ocp fit-plant --plant FILE.toml --variables' lists the names that can be measured and freed.

A study file (TOML) for --plant has the plant, and optionally all other arguments; the command line
takes precedence. Values are numbers in SI, or texts with a unit; plain keys come before tables:

  records = ["run1.csv", "run2.csv"]      # in the folder of this file
  validate = ["run3.csv"]
  free = ["damping", "muscle*.lag"]       # a pattern: equal values
  outputs = ["x"]                         # default: all measured ones
  delay = ["0 ms", "50 ms"]               # of the inputs; two values: estimate it
  offsets = ["x"]                         # sensors with an unknown offset; also: gains
  noise = { x = "0.02 mm" }               # default: from the residuals
  process_noise = { v = 0.01 }            # of the plant [unit/sqrt(s)]; needs noise
  input_noise = { "muscle1.command" = "0.05 bar" }   # of measured inputs; needs noise
  bounds = { damping = [1.0, 100.0] }
  inputs = { "muscle2.command" = "3 bar" }   # constant, without a column
  columns = { x = "pot" }                 # variable = header; also: units, time, clock, sheet,
                                          # skip, ... of pam_ocp.read_record
  interpolation = "previous"              # of the inputs: "previous" (held) or "linear";
                                          # default: as in the file, else both are tried
  split = "episode"                       # column at whose changes a file is cut into records
  method = "collocation"                  # also: degree, step

  [plant]                                 # as for 'pam-ocp plan'
  arrangement = "AntagonisticSlide"
  muscle = "DMSP-20-200N"                 # or a muscle file that 'pam-ocp fit' wrote
  mass = "2 kg"
  feed = { kind = "Regulator", lag = "50 ms", max_pressure = "6 bar" }

Exit code: 0, or 1 if the records do not allow the fit (the message gives the reason), 2 for an
invalid file or option.
"""
_OWN = ("plant", "muscle", "set", "records", "validate", "free")


@command(
    "fit-plant",
    "fit parameters of a plant to measured records",
    file("records", "RECORD", "measured time series", nargs="*"),
    option(
        "--plant",
        "PLANT",
        "a study file (.toml, see below), or a plant as in 'export'",
        required=True,
    ),
    option("--muscle", "MUSCLE", "name in the catalogue, or a muscle file"),
    named("--set", "known value of a parameter, or where a free one starts, as mass=2kg"),
    several("--free", "NAME", "parameters to fit"),
    several("--outputs", "NAME", "what to compare (default: all)"),
    several("--delay", "T", "delay of the inputs, or two values: estimate it between them"),
    several("--noise", "NAME=VALUE", "standard deviations, as x=0.02mm"),
    choice("--interpolation", ("previous", "linear"), "of the inputs"),
    several("--validate", "RECORD", "other records, for validation", type=Path),
    flag("--variables", "list the plant's variables, and exit"),
    output(
        "--plot",
        "FILE.png",
        "draw records and fit; further ones as FILE-2.png, validation as FILE-validate.png",
        *PICTURES,
    ),
    output("--out", "FILE.json", "write the fit (pam_ocp.fitting.load_plant_fit reads it)"),
    output(
        "--ssv",
        "FILE.ssv",
        "write the fitted parameters as a parameter set of the plant's FMU (SSP 1.0)",
    ),
    ALLOW_CODE,
    about="Fit parameters of a plant (damping, lag, coefficients of its muscles, "
    "...) to measured time series; print values with intervals, and the "
    "errors on other records.",
    epilog=EPILOG,
    fails=FitError,
)
def _fit_plant(options: argparse.Namespace) -> int:
    file = options.plant if options.plant.endswith(".toml") else None
    with reading(file, "a study file", "see its keys") if file else nullcontext():
        study, plant = _study(options)
    if options.variables:
        tell(
            options, _variables(plant), lambda: {"variables": [asdict(v) for v in plant.variables]}
        )
        return 0
    records, others = (records_of(study, plant, study[name]) for name in ("records", "validate"))
    if not records:
        raise InputError("no record: give files, or records = [...] in the study file")
    if "free" not in study:
        raise InputError(
            "--free is missing: name the parameters to fit; --variables lists the plant's"
        )

    with reading(options.plant, "a study file", "see its keys"):
        arguments = fit_arguments(study, plant)
    with working("fit") if heard() else nullcontext() as bar:
        if bar is not None:
            arguments["progress"] = lambda stage, count, cost: bar.step(
                note=f"{stage}, cost {cost:.4g}"
            )
        fit = pam.fit_plant(plant, records, study["free"], **arguments)
    checked = fit.validate(others) if others else []
    tell(
        options,
        fit.report(),
        lambda: {
            "parameters": coefficients(fit),
            "rmse": fit.rmse,
            "fit_percent": fit.fit_percent,
            "warnings": fit.warnings,
            "adequacy": asdict(fit.adequacy),
            "validation": [{a.name: a.fit_percent for a in c.agreements} for c in checked],
        },
    )
    for number, comparison in enumerate(checked, start=1):
        tell(options, f"[[Validation]] record {number}, only its initial state estimated")
        tell(options, "\n".join(f"    {line}" for line in str(comparison).splitlines()[1:]))
    deliver(options, out=fit.save, ssv=fit.save_ssv)
    for comparisons, ending in ((fit.comparisons, ""), (checked, "-validate")):
        for number, comparison in enumerate(comparisons if options.plot else (), start=1):
            tail = f"-{number}" if number > 1 else ""
            target = options.plot.with_stem(f"{options.plot.stem}{ending}{tail}")
            wrote(options, picture(comparison.plot)(target))
    return 0


def _study(options: argparse.Namespace) -> tuple[dict[str, Any], Plant]:
    """What the file says, and the command line over it; and the plant."""
    from ..plants.plant_file import muscle_of, plant_of
    from ..studies.file_kinds import plant_called, require_role

    study: dict[str, Any] = {}
    folder = None
    if options.plant.endswith(".toml"):
        require_role(options.plant, "plant")
        study, folder = read_toml(options.plant), Path(options.plant).parent
        if "stops" in study:  # a problem of 'pam-ocp plan': its plant alone
            study = {"plant": study.get("plant")}
        known_keys(options.plant, study, (*_OWN, *READING, *FITTING))
    study["folder"] = folder
    study |= asked(options, "free", "outputs", "interpolation", "delay")
    for name in ("records", "validate"):
        given = getattr(options, name)
        study[name] = given or [(folder or Path()) / n for n in listed(name, study.get(name, []))]
        for record in study[name]:
            require_role(record, "motion")
    if options.noise is not None:
        study["noise"] = pairs("--noise", options.noise)
    described = study.get("plant", options.plant)
    if isinstance(described, Mapping):
        changed = {"muscle": from_here(options.muscle)} if options.muscle else {}
        plant = plant_of({**described, **changed}, "plant", folder, allow_code=options.allow_code)
    elif described == options.plant and options.plant.endswith(".toml"):
        raise InputError(
            f"{options.plant} describes no plant: give a [plant] table, or plant = NAME"
        )
    else:
        name = from_here(options.muscle) or study.get("muscle", "DMSP-20-300")
        typed = described == options.plant  # on the command line: that is the consent
        plant = plant_called(
            described,
            muscle_of(name, "muscle", folder),
            folder,
            allow_code=typed or options.allow_code,
        )
    said = {**table("set", study.get("set", {})), **pairs("--set", options.set)}
    return study, plant.with_values(values("set", plant, said))


def _variables(plant: Plant) -> str:
    """What can be measured, what must be, and what can be freed."""
    lines = [f"{plant.name}: {plant.description}"]
    for title, variables in (
        ("inputs (a column each, or inputs = {...})", plant.inputs),
        ("states and outputs (columns)", (*plant.states, *plant.outputs)),
        ("parameters (free, or set)", plant.parameters),
    ):
        lines.append(title)
        for v in variables:
            value = f"{v.shown(v.start):>14}" if v.start is not None else f"{v.display_unit:>14}"
            lines.append(f"  {v.name:<28}{value}  {v.description}")
    return "\n".join(lines)


# ---- which model ---------------------------------------------------------------------------------
LADDER = """\
The candidates are fitted to all records, and compared by their predictions of parts left out; the
simplest that is not significantly worse than the best is marked with *.

The study file (TOML) is that of 'pam-ocp fit-plant'. Its [plant] has the arrangement and the
regulator's start values, without the effects that candidates add (dead time, slew limit, losses):

  records = ["run1.csv", "run2.csv"]      # each begins at rest
  free = ["base_pressure", "muscle*.gain"]   # in every candidate
  dynamic = ["damping", "mass"]           # from the second on; default: the damping

  [plant]
  arrangement = "AntagonisticSlide"       # or "FILE.py:NAME": (muscle, feed=, losses=)
  muscle = "DMSP-20-200N"
  mass = "2 kg"
  feed = { kind = "PairRegulator", base = "2.5 bar", gain = "1 bar/V", lag = "50 ms" }

Exit code: 0, or 1 if no candidate could be fitted, 2 for an invalid file or option.
"""
_KEYS = (
    *("plant", "records", "free", "dynamic", "outputs", "bounds", "rungs", "folds"),
    *("columns", "units", "time", "interpolation", "max_gap", "split"),
)


def _said(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def _ladder_data(found: Any) -> dict[str, Any]:
    return {
        "chosen": found.chosen.name,
        "warnings": found.warnings,
        "rungs": {
            r.name: {
                "rmse": r.rmse,
                "worse": r.worse,
                "failure": r.failure,
                "parameters": {n: c.value for n, c in r.coefficients.items()},
            }
            for r in found.rungs
        },
    }


@command(
    "ladder",
    "select a model for records: static, or with lag, friction, hysteresis, creep",
    option("study", "FILE.toml", "plant and records; see below"),
    file("records", "RECORD", "instead of those in the study file", nargs="*"),
    several("--free", "NAME", "parameters fitted in every candidate"),
    several("--dynamic", "NAME", "parameters fitted from the second candidate on"),
    several("--rungs", "RUNG", "only these, such as 'dead time'"),
    several("--outputs", "NAME", "compare only these"),
    count("--folds", "N", "of parts left out (default 5)"),
    count("--jobs", "N", "processes (default 1)", default=1),
    ALLOW_CODE,
    about="Compare nested models (static, + lag, + unequal lags, + dead time, "
    "+ slew limit, + friction, + memory, + memory per pressure, + force law, + creep) by "
    "their predictions of parts of the records that were left out.",
    epilog=LADDER,
    fails=FitError,
)
def _ladder(options: argparse.Namespace) -> int:
    from ..plants.plant_file import builder_of

    study: dict[str, Any] = read_toml(options.study)
    known_keys(options.study, study, _KEYS)
    folder = Path(options.study).parent
    described = study.get("plant")
    if not isinstance(described, Mapping):
        raise InputError(f"{options.study} has no [plant] table: say what the ladder is built on")
    build, feed = builder_of(described, "plant", folder, allow_code=options.allow_code)
    study |= asked(options, "free", "dynamic", "rungs", "outputs", "folds")
    beside = [folder / n for n in listed("records", study.get("records", []))]
    try:
        plant: Plant = build(feed=feed, losses=())
    except TypeError as error:
        raise InputError(
            f"{options.study}: the arrangement is called with muscle, feed= and losses= on every "
            f"rung; {error}"
        ) from error
    records = records_of(study, plant, options.records or beside)
    if not records:
        raise InputError("no record: give files, or records = [...] in the study file")
    given: dict[str, Any] = {
        n: listed(n, study[n]) for n in ("dynamic", "rungs", "outputs") if n in study
    }
    if "bounds" in study:
        given["bounds"] = bounds_of(study, plant)
    pool = ProcessPoolExecutor(options.jobs) if options.jobs > 1 else None
    with pool or nullcontext():
        found = pam.fitting.fit_ladder(
            build,
            records,
            listed("free", study.get("free", [])),
            feed=feed,
            folds=study.get("folds", 5),
            executor=pool,
            progress=None if options.quiet else _said,
            time_limit=options.time_limit,
            **given,
        )
    tell(options, found.report(), lambda: _ladder_data(found))
    return 0

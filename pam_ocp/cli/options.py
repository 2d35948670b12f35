"""Options that several commands share, and what they name: lengths, plants, muscles, motions, how
files are read.
"""

from __future__ import annotations

import argparse
import ast
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pam_ocp as pam

from ..core.errors import InputError
from ..core.files import write_npz
from ..core.quantities import quantity
from ..plants.plant_data import carried
from .command import Option, asked, choice, count, flag, named, option, pairs, several

if TYPE_CHECKING:
    from ..core.trajectory import Trajectory
    from ..muscles.pneumatic_muscle import Muscle
    from ..plants.plant import Plant

ALLOW_CODE = flag(
    "--allow-code",
    "let the file run code: Python of a plant named FILE.py:NAME in it, FMUs, libraries "
    "of solvers. Read that code before: it can do whatever you can (default: refused)",
)
"""The consent to run code that a file names."""


# ---- lengths -------------------------------------------------------------------------------------
def rest_length(more: str = "") -> Option:
    """--rest-length"""
    words = f"of the muscle, such as '300 mm'; metres without a unit{more}"
    return option("--rest-length", "L", words)


DIAMETER = option("--diameter", "L", "inner diameter at rest, such as '20 mm'")


def length_of(option: str, text: str | None) -> float | None:
    """A length [m] of "300 mm" or "0.3"; None where nothing is said. Raises InputError."""
    return None if text is None else quantity(option, text, "m")


# ---- motions -------------------------------------------------------------------------------------
MOTIONS = (".csv", ".npz", ".parquet", ".xlsx")
"""What a motion is written as."""


def require_motion_ending(out: Path | None) -> None:
    """InputError where --out is no name of a motion."""
    if out is not None and out.suffix.lower() not in MOTIONS:
        raise InputError(f"--out {out}: a trajectory is written as one of {', '.join(MOTIONS)}")


def written(motion: Trajectory, path: Path, plant: Plant | None = None) -> Path:
    """A motion in a file, as its name ends; .npz carries its plant. Raises InputError."""
    ending = path.suffix.lower()
    if ending == ".npz" and plant is not None:
        content, arrays = motion._packed()
        return write_npz(path, content | carried(plant), arrays)
    return motion.to_excel(path) if ending == ".xlsx" else motion.save(path)


# ---- plants: which one, with which values --------------------------------------------------------
PLANT = (
    "a plant of the library by name, such as HangingLoad or AntagonisticSlide; FILE.py:NAME (a "
    "Plant, or a function that returns one); FILE.toml with a table [plant]; or a file that "
    "carries its plant: a plan, motion or closed loop (.npz), a fit of a plant (.json)"
)
MUSCLE = "DMSP-20-300"
PLANT_VALUES = (
    option(
        "--muscle",
        "MUSCLE",
        f"name in the catalogue, or a muscle file (default: {MUSCLE})",
    ),
    named("--set", "value of a parameter, or start value, such as mass='3 kg'; SI without a unit"),
    ALLOW_CODE,
)
A_PLANT = (option("plant", "PLANT", PLANT), *PLANT_VALUES)
"""What :func:`plant_said` makes a plant of."""


def rest(words: str) -> Option:
    """--rest"""
    return named("--rest", f"{words}, such as x='10 mm'")


def plant_said(options: argparse.Namespace) -> Plant:
    """The plant that the options A_PLANT name, with their values."""
    plant = plant_named(options.plant, options.muscle, options.allow_code)
    return plant.with_values(pairs("--set", options.set))


def plant_named(name: str, muscle: str | None, allow_code: bool) -> Plant:
    """A plant by its name, from a user's file (FILE.py:NAME), or from a table (FILE.toml).

    muscle : None for the usual one. A file named on the command line is run; one named in another
    file only with ``allow_code``. Raises InputError for a muscle beside a file that has its own.
    """
    from ..studies.file_kinds import plant_called

    require_no_own_muscle(name, muscle)
    run = allow_code or not name.endswith(".toml")
    return plant_called(name, muscle_named(muscle or MUSCLE), allow_code=run)


def require_no_own_muscle(name: str, muscle: str | None) -> None:
    """InputError where --muscle is given for a plant whose file has its muscle."""
    from ..studies.file_kinds import is_plant_file

    if muscle is not None and is_plant_file(name):
        raise InputError(f"--muscle {muscle}: {name} has its own muscle; change it there")


def from_here(muscle: str | None) -> str | None:
    """A muscle file named on the command line lies in the working folder, not beside the study."""
    from ..muscles.muscle_file import ENDINGS

    return str(Path(muscle).absolute()) if muscle and muscle.endswith(ENDINGS) else muscle


def muscle_named(name: str, rest_length: Any = None) -> Muscle:
    """A muscle by its name in the catalogue, or from a muscle file."""
    from ..muscles.muscle_file import ENDINGS
    from ..studies.file_kinds import muscle_in

    file = name.endswith(ENDINGS) or Path(name).is_file()
    if file and rest_length is not None:
        raise InputError(f"--rest-length: {name} has its own rest length; change it there")
    return muscle_in(name) if file else pam.muscle(name, rest_length=rest_length)


# ---- how files of rigs are read ------------------------------------------------------------------
READING = (
    several(
        "--columns",
        "NAME",
        "QUANTITY=HEADER where the header does not say it; or the names of all columns from "
        "the left, with units, where the file has none ('-' leaves one out)",
    ),
    several(
        "--units",
        "QUANTITY=UNIT",
        "unit, 'bar abs', or a calibration such as 'pressure=V * 2 bar/V - 0.3 bar'",
    ),
    option("--ambient-pressure", "P", "subtracted from absolute pressures (default: 1.01325 bar)"),
    option("--sheet", "NAME", "of a workbook: its name or number"),
    several(
        "--pick",
        "NAME",
        "table within nested data, as run.data; several with different clocks are resampled to one",
    ),
    several("--constants", "NAME=VALUE", "constant that the file lacks, as 'contraction=5 %%'"),
    option(
        "--pattern",
        "NAME",
        "form of the file's name, with headers in braces: '{muscle}_{contraction [%%]}.csv'",
    ),
    choice("--bad-lines", ("refuse", "drop"), "stray and cut lines (default: refuse)"),
    option("--encoding", "NAME", "of a text, as cp1252"),
    count("--skip", "N", "lines at the beginning to leave out"),
    option("--delimiter", "C", "between cells, if detected wrongly"),
    several(
        "--missing",
        "VALUE",
        "what marks a missing value (default: 9999, -999, 1e30 and their like where they "
        "stand apart); without a VALUE: nothing does",
        nargs="*",
    ),
    choice("--decimal", (".", ","), "if detected wrongly"),
    several("--pivot", "HEADER", "quantities down, across, and in the cells of a pivot"),
)
"""How a file is to be read, where it does not say it itself."""
FLOOR = option(
    "--floor",
    "F",
    "reading up to which a muscle is slack, as '5 N'; found (default): "
    "detected; zero: detected, and subtracted from all forces as the offset "
    "of the load cell; none: any positive force is taut",
)
"""What slack cells of a force table read."""


def reading_options(options: argparse.Namespace) -> dict[str, Any]:
    """What the options say, as arguments of read_table and read_record. Raises InputError."""
    plain = ("ambient_pressure", "skip", "delimiter", "decimal", "pattern", "bad_lines", "encoding")
    found = asked(options, *plain)
    if options.columns:
        split = [text.partition("=") for text in options.columns]
        if all(equals for _, equals, _ in split):
            found["columns"] = {name.strip(): header for name, _, header in split}
        elif any(equals for _, equals, _ in split):
            raise InputError(
                "--columns: give QUANTITY=HEADER for each, or the names of all columns"
            )
        else:
            found["columns"] = [None if text == "-" else text for text in options.columns]
    if options.units:
        found["units"] = pairs("--units", options.units)
    if options.pick:
        found["pick"] = options.pick[0] if len(options.pick) == 1 else options.pick
    if options.constants:
        constants = pairs("--constants", options.constants)
        found["constants"] = {name: number_in(value) for name, value in constants.items()}
    if options.missing is not None:
        found["missing"] = [number_in(text) for text in options.missing] or None
    if options.sheet is not None:
        found["sheet"] = int(options.sheet) if options.sheet.isdigit() else options.sheet
    if getattr(options, "floor", None) is not None:
        found["floor"] = options.floor
    if options.pivot:
        found["pivot"] = tuple(options.pivot)
    return found


def number_in(value: Any) -> Any:
    """A number where it is one; "300 mm" stays."""
    try:
        return ast.literal_eval(value) if isinstance(value, str) else value
    except (ValueError, SyntaxError):
        return value

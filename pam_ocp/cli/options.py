"""Options that several commands share; which plant, with which values, each with its unit."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from ..core.files import require_place, write_npz
from ..core.quantities import quantity
from ..plants.plant_data import carried

if TYPE_CHECKING:
    from ..core.trajectory import Trajectory
    from ..plants.plant import Plant
if TYPE_CHECKING:
    from ..muscles.pneumatic_muscle import Muscle
    from ..plants.plant import Plant


def add_allow_code(command: argparse.ArgumentParser) -> None:
    """The consent to run code that a file names."""
    command.add_argument(
        "--allow-code",
        action="store_true",
        help="let the file run code: Python of a plant named FILE.py:NAME in it, FMUs, libraries "
        "of solvers. Read that code before: it can do whatever you can (default: refused)",
    )


PICTURES = (".png", ".pdf", ".svg", ".eps", ".ps", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
_FOLDERS = ("campaign", "fit-forces")
"""Commands whose --plot is a folder."""


def require_outputs(options: argparse.Namespace) -> None:
    """--plot and --excel can be written, and as what their names end in: asked before long work.

    Raises InputError (WriteError where nothing can be written).
    """
    for name, endings in (("plot", PICTURES), ("excel", (".xlsx",))):
        target = getattr(options, name, None)
        if target is None or options.command in _FOLDERS:
            continue
        if target.suffix.lower() not in endings:
            shown = ", ".join(endings[:3])
            raise InputError(f"--{name} {target}: give a name that ends in {shown}")
        require_places(target)


def require_places(*targets: Path | None) -> None:
    """Files can be written there: asked before a long run, not after it.

    Raises WriteError, and InputError for a workbook without XlsxWriter.
    """
    for target in targets:
        if target is not None:
            require_place(target)
            if target.suffix.lower() == ".xlsx":
                from ..figures.workbook import require_writer

                require_writer()


def pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """{name: value} of texts NAME=VALUE. Raises InputError."""
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not value or not name.strip():
            raise InputError(f"{option} {text}: give NAME=VALUE, as mass=2kg or mass=2.0")
        found[name.strip()] = value
    return found


def whole(text: str) -> int:
    """A whole number of at most nine digits, as argparse asks for it."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
    if abs(number) > 999_999_999:
        raise argparse.ArgumentTypeError(f"{len(text)} digits are more than a number of this kind")
    return number


def number(text: str) -> float:
    """A number, as argparse asks for it."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None


def seconds(text: str) -> float:
    """A time [s] of "2 min" or "120", as argparse asks for it."""
    with suppress(ValueError):
        return float(text)
    try:
        return quantity("the time", text, "s")
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def require_motion_ending(out: Path | None) -> None:
    """InputError where --out is no name of a motion."""
    if out is not None and out.suffix.lower() not in MOTIONS:
        raise InputError(f"--out {out}: a trajectory is written as one of {', '.join(MOTIONS)}")


def length_of(option: str, text: str | None) -> float | None:
    """A length [m] of "300 mm" or "0.3"; None where nothing is said. Raises InputError."""
    return None if text is None else quantity(option, text, "m")


MOTIONS = (".csv", ".npz", ".parquet", ".xlsx")
"""What a motion is written as."""


def written(motion: Trajectory, path: Path, plant: Plant | None = None) -> Path:
    """A motion in a file, as its name ends; .npz carries its plant. Raises InputError."""
    ending = path.suffix.lower()
    if ending == ".npz" and plant is not None:
        content, arrays = motion._packed()
        return write_npz(path, content | carried(plant), arrays)
    return motion.to_excel(path) if ending == ".xlsx" else motion.save(path)


# ---- the same option in several commands -------------------------------------------------------
def add_rest_length(command: argparse.ArgumentParser, more: str = "") -> None:
    """--rest-length"""
    command.add_argument(
        "--rest-length",
        metavar="L",
        help=f"of the muscle, such as '300 mm'; metres without a unit{more}",
    )


def add_diameter(command: argparse.ArgumentParser) -> None:
    """--diameter"""
    command.add_argument("--diameter", metavar="L", help="inner diameter at rest, such as '20 mm'")


def add_plot(command: argparse.ArgumentParser, words: str) -> None:
    """--plot"""
    command.add_argument(
        "--plot", type=Path, metavar="FILE.png", help=f"{words} (.png, .pdf, .svg)"
    )


def add_out(command: argparse.ArgumentParser, kind: str, words: str) -> None:
    """--out"""
    command.add_argument("--out", type=Path, metavar=kind, help=words)


def add_pairs(command: argparse.ArgumentParser, option: str, words: str) -> None:
    """An option NAME=VALUE, which :func:`pairs` reads."""
    words = f"{words} (may be repeated)"
    command.add_argument(option, action="append", default=[], metavar="NAME=VALUE", help=words)


def add_rest(command: argparse.ArgumentParser, words: str) -> None:
    """--rest"""
    add_pairs(command, "--rest", f"{words}, such as x='10 mm'")


# ---- plants: which one, with which values --------------------------------------------------------
PLANT = (
    "a plant of the library by name, such as HangingLoad or AntagonisticSlide; FILE.py:NAME (a "
    "Plant, or a function that returns one); FILE.toml with a table [plant]; or a file that "
    "carries its plant: a plan, motion or closed loop (.npz), a fit of a plant (.json)"
)


def add_plant(command: argparse.ArgumentParser) -> None:
    """PLANT, --muscle, --set and --allow-code."""
    command.add_argument("plant", metavar="PLANT", help=PLANT)
    add_plant_options(command)


def add_plant_options(command: argparse.ArgumentParser) -> None:
    """--muscle, --set and --allow-code."""
    command.add_argument(
        "--muscle",
        default="DMSP-20-300",
        metavar="MUSCLE",
        help="name in the catalogue, or a muscle file (default: DMSP-20-300)",
    )
    words = "value of a parameter, or start value, such as mass='3 kg'; SI without a unit"
    add_pairs(command, "--set", words)
    add_allow_code(command)


def plant_said(options: argparse.Namespace) -> Plant:
    """The plant that the options of :func:`add_plant` name, with their values."""
    plant = plant_named(options.plant, options.muscle, options.allow_code)
    return plant.with_values(pairs("--set", options.set))


def plant_named(name: str, muscle: str, allow_code: bool) -> Plant:
    """A plant by its name, from a user's file (FILE.py:NAME), or from a table (FILE.toml).

    A file named on the command line is run; one named in another file only with ``allow_code``.
    """
    from ..studies.file_kinds import plant_called

    run = allow_code or not name.endswith(".toml")
    return plant_called(name, muscle_named(muscle), allow_code=run)


def muscle_named(name: str, rest_length: Any = None) -> Muscle:
    """A muscle by its name in the catalogue, or from a muscle file."""
    from ..muscles.catalogue import muscle
    from ..muscles.muscle_file import ENDINGS
    from ..studies.file_kinds import muscle_in

    file = name.endswith(ENDINGS) or Path(name).is_file()
    return muscle_in(name) if file else muscle(name, rest_length=rest_length)

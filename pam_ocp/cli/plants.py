"""Plants on the command line: which one, with which values, each with its unit."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .options import add_allow_code, pairs

if TYPE_CHECKING:
    from ..muscles.pneumatic_muscle import Muscle
    from ..plants.plant import Plant

__all__ = ["PLANT", "add_plant", "add_plant_options", "muscle_named", "plant_named", "plant_said"]

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
    command.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="value of a parameter, or start value, such as mass='3 kg'; SI without a unit (may "
        "be repeated)",
    )
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

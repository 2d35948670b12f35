"""A fit to records in words: what a study file says becomes records and arguments of fit_plant."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.errors import InputError
from ..core.quantities import pair, quantity, table

if TYPE_CHECKING:
    from ..core.trajectory import Trajectory
    from ..plants.plant import Plant

READING = (
    *("columns", "units", "time", "interpolation", "max_gap", "split", "clock", "sample_time"),
    *("ambient_pressure", "sheet", "skip", "pick", "delimiter", "decimal", "empty"),
    *("encoding", "bad_lines", "constants", "pattern"),
)
FITTING = (
    "outputs",
    "delay",
    "offsets",
    "gains",
    "noise",
    "input_noise",
    "process_noise",
    "bounds",
    "inputs",
    "method",
    "degree",
    "step",
)
"""Keys of a study file that read_record, and fit_plant, take."""


def records_of(
    study: Mapping[str, Any], plant: Plant, paths: Iterable[str | Path]
) -> list[Trajectory]:
    """The records in files, read as the study says."""
    from ..fitting.tables.records import read_records

    reading = {n: study[n] for n in READING if n in study and n != "split"}
    found: list[Trajectory] = []
    for path in paths:
        found += read_records(path, plant, split=study.get("split"), **reading)
    return found


def fit_arguments(study: Mapping[str, Any], plant: Plant) -> dict[str, Any]:
    """Arguments of fit_plant, in SI."""
    found: dict[str, Any] = {n: study[n] for n in ("method", "degree") if n in study}
    for name in ("outputs", "offsets", "gains"):
        if name in study:
            found[name] = listed(name, study[name])
    for name in ("noise", "inputs", "input_noise"):
        if name in study:
            found[name] = values(name, plant, study[name])
    if "process_noise" in study:  # of the plant [unit/sqrt(s)]
        said = table("process_noise", study["process_noise"])
        found["process_noise"] = {n: quantity(f"process_noise.{n}", v) for n, v in said.items()}
    if "bounds" in study:
        found["bounds"] = bounds_of(study, plant)
    if "step" in study:
        found["step"] = quantity("step", study["step"], "s")
    if "delay" in study:
        given = study["delay"] if isinstance(study["delay"], list) else [study["delay"]]
        ends = [quantity("delay", v, "s") for v in given]
        if len(ends) > 2:
            raise InputError(f"delay: {len(ends)} values; give one, or two to find it between")
        found["delay"] = ends[0] if len(ends) == 1 else (ends[0], ends[1])
    return found


def bounds_of(study: Mapping[str, Any], plant: Plant) -> dict[str, tuple[float, float]]:
    found = {}
    for name, ends in table("bounds", study["bounds"]).items():
        low, high = pair(f"bounds.{name}", ends, plant.variable(name.replace("*", "1")).unit)
        found[name] = (
            -float("inf") if low is None else low,
            float("inf") if high is None else high,
        )
    return found


def values(where: str, plant: Plant, said: Any) -> dict[str, float]:
    """Values of a plant's variables in SI, as a table of a file or of options names them."""
    return {
        plant.variable(n).name: quantity(f"{where}.{n}", v, plant.variable(n).unit)
        for n, v in table(where, said).items()
    }


def listed(where: str, value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise InputError(f"{where} = {value!r}: give a list, as [{value!r}]")
    return value

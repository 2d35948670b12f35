"""Records of runs, written as they come: what is on the disk is whole, whatever happens next."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from .. import __version__
from ..core.arguments import with_kinds
from ..core.errors import InputError
from ..core.files import json_of, make_folder, write_json
from ..core.trajectory import HELD, Trajectory
from ..core.variables import Variable, variable_of

__all__ = ["RecordWriter", "read_run"]

FORM = "pam_ocp.rig run"
DIGITS = 10


class RecordWriter:
    """One run in ``run_NNNN.csv``, a line a sample, and ``run_NNNN.json`` with all about it.

    folder : it gets the next number there. A line is written by one call of the system, so that it
    is there even when this process is killed after it; :func:`read_run` leaves out a line that is
    not whole. The CSV is a record as :func:`pam_ocp.read_record` reads it.

    Examples
    --------
    >>> writer = pam.rig.RecordWriter("runs", [plant.variable("x")], {"about": "a test"})
    >>> writer.row(0.0, [0.001])
    >>> path = writer.close({"missed": 0})
    >>> pam.rig.read_run(path)["x"]
    array([0.001])
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        variables: Sequence[Variable],
        about: Mapping[str, Any],
    ) -> None:
        place = Path(folder)
        make_folder(place)
        self.variables = tuple(variables)
        self.path, self._file = _next(place)
        self._about = {
            "form": FORM,
            "variables": [asdict(v) for v in variables],
            "versions": {"pam_ocp": __version__, "python": platform.python_version()},
            "platform": sys.platform,
            **about,
        }
        self._held = [HELD] if any(v.causality == "input" for v in variables) else []
        header = ["time [s]", *(f"{v.name} [{v.unit}]" for v in variables), *self._held]
        self._line(header)
        self._tell({"ended": False})

    def _line(self, cells: Sequence[str]) -> None:
        os.write(self._file, (",".join(cells) + "\n").encode("utf-8"))

    def _tell(self, more: Mapping[str, Any]) -> None:
        write_json(self.path.with_suffix(".json"), _plain({**self._about, **more}))

    def row(self, time: float, values: Sequence[float]) -> None:
        """A sample: its time [s], and the values in the order of the variables [SI]."""
        cells = [f"{time:.6f}", *(f"{v:.{DIGITS}g}" for v in values)]
        self._line([*cells, "1"] if self._held else cells)

    def close(self, more: Mapping[str, Any]) -> Path:
        """The end, with what is known of the run now."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
            self._tell({"ended": True, **more})
        return self.path


def _next(place: Path) -> tuple[Path, int]:
    """A new file of the next number, opened."""
    numbers = [p.stem[4:] for p in place.glob("run_*.csv")]
    number = max((int(n) for n in numbers if n.isdigit()), default=0)
    while True:
        number += 1
        path = place / f"run_{number:04d}.csv"
        try:
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND
            return path, os.open(path, flags, 0o644)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(f"{place}: no record can be written there ({error})") from None


def _plain(value: Any) -> Any:
    """As JSON has it; what is not finite is a text."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return repr(value)
    return value


@with_kinds
def read_run(path: str | os.PathLike[str]) -> Trajectory:
    """The Trajectory of a run that a rig recorded, as far as it came; inputs are inputs, and held.

    Raises InputError for what no rig wrote.

    Examples
    --------
    >>> writer = pam.rig.RecordWriter("runs", list(plant.inputs), {})
    >>> writer.row(0.0, [2e5])
    >>> pam.rig.read_run(writer.path).named("input")  # it is still being written
    ('muscle.command',)
    """
    source = Path(path)
    try:
        text = source.read_text("utf-8")
        about = json_of(source.with_suffix(".json").read_bytes())
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{source}: no record of a rig can be read there ({error})") from None
    if about.get("form") != FORM:
        raise InputError(f"{source.with_suffix('.json')}: a rig did not write this")
    said = [
        {k: float(v) if v in ("inf", "-inf") else v for k, v in s.items()}
        for s in about["variables"]
    ]
    variables = [variable_of(s) for s in said]
    whole = [line for line in text.split("\n")[1:-1] if line]
    try:
        rows = np.array([[float(c) for c in line.split(",")] for line in whole])
    except ValueError as error:
        raise InputError(f"{source}: {error}; the file is damaged") from None
    if not len(rows):
        raise InputError(f"{source}: the run ended before its first sample")
    if rows.shape[1] < len(variables) + 1:
        raise InputError(f"{source}: a line has {rows.shape[1]} cells; the file is damaged")
    columns = {v.name: rows[:, i + 1] for i, v in enumerate(variables)}
    return Trajectory(rows[:, 0], columns, variables, "previous")


def about_run(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What stands beside a record."""
    found: dict[str, Any] = json.loads(Path(path).with_suffix(".json").read_text("utf-8"))
    return found

"""check_fmu: is an FMU well formed, and does it move as it should?"""

from __future__ import annotations

import contextlib
import os
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import (
    InputError,
    SimulationError,
    require_finite,
    require_instance,
    require_positive,
    with_kinds,
)
from ..core.files import require_local
from ..core.interrupts import interruptible
from ..core.shown import shown
from ..core.trajectory import Trajectory
from .archive import printable
from .isolation import run_alone

Array: TypeAlias = NDArray[np.float64]


@shown
@dataclass(frozen=True)
class FmuCheck:
    """What :func:`check_fmu` found. ``print`` it for a report; ``ok`` for a verdict.

    Examples
    --------
    >>> path = pam.export_fmu(plant, "load.fmu", platforms=["native"])
    >>> check = pam.check_fmu(path)
    >>> check.ok, check.fmi, check.findings
    (True, '2.0', ())
    """

    path: Path
    fmi: str
    """Its version; empty when the description could not be read."""
    tolerance: float
    platforms: tuple[str, ...]
    """Platforms the FMU has a binary for, by their names in FMI 3."""
    findings: tuple[str, ...] = ()
    """What is wrong, one sentence each."""
    deviations: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    """For each mode: the largest deviation of each variable, in units of its nominal."""
    trajectories: Mapping[str, Trajectory] = field(default_factory=dict, repr=False)
    """For each mode: what the FMU did, at the times and with the inputs of ``against``."""

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    @property
    def largest(self) -> float:
        """The largest deviation of all, scaled by nominals; 0 when nothing was compared."""
        found = [d for mode in self.deviations.values() for d in mode.values()]
        return float(np.max(found, initial=0.0))  # NaN, where one is

    def to_dict(self) -> dict[str, Any]:
        """The verdict and its figures as plain data, for JSON."""
        return {
            "file": self.path.name,
            "fmi": self.fmi,
            "ok": self.ok,
            "platforms": list(self.platforms),
            "findings": list(self.findings),
            "largest": {
                mode: float(np.max([*found.values()])) for mode, found in self.deviations.items()
            },
            "deviations": {mode: dict(found) for mode, found in self.deviations.items()},
        }

    def __str__(self) -> str:
        lines = [
            f"{self.path.name}: FMI {self.fmi or '?'}, {'all well' if self.ok else 'NOT well'}",
            f"platforms: {', '.join(self.platforms) or 'none'}",
        ]
        names = list(dict.fromkeys(n for mode in self.deviations.values() for n in mode))
        if names:
            lines.append(
                f"{'largest deviation / nominal':<28}"
                + "".join(f"{m:>16}" for m in self.deviations)
            )
            lines += [
                f"{name:<28}"
                + "".join(f"{mode.get(name, np.nan):>16.1e}" for mode in self.deviations.values())
                for name in names
            ]
        lines += [f"- {finding}" for finding in self.findings]
        return "\n".join(map(printable, lines))


@with_kinds
def check_fmu(
    path: str | os.PathLike[str],
    against: Trajectory | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    tolerance: float = 1e-6,
    duration: float = 0.2,
    time_limit: float = 60.0,
) -> FmuCheck:
    """Validate an FMU and let it run in every mode it has.

    1. FMPy's validation of the description and the file.
    2. Binaries: which platforms are there, do they export FMI functions only.
    3. Simulation in Co-Simulation and Model Exchange, compared with ``against`` at its times; the
       inputs run between the samples as the trajectory says: held, linear or curved, exactly in
       Model Exchange, in Co-Simulation by lines (FMI 2) or pairs of held values (FMI 3) with the
       same mean and first moment, to an error of about 1e-8 (scaled). Without a trajectory
       the two modes are compared with each other over ``duration`` [s], at constant inputs.
    4. The binary is as described: it starts at the start values and within the ranges, takes
       both ends of the ranges of inputs and parameters (and refuses parameters beyond for all or
       for none), and what moves with another variable is among its dependencies.
    5. A state saved, serialised and restored in another instance continues to the last bit.
    6. Directional derivatives agree with differences to 1e-6.

    Parameters
    ----------
    path : the FMU.
    against : a Trajectory whose columns have the FMU's names: inputs are played, the first row of
        the states (and of parameters, where it has some) is the start, states and outputs are
        compared.
    parameters : values [SI] other than the FMU's start values, by name.
    tolerance : largest deviation allowed, in units of each variable's nominal.
    duration : of the simulation without a trajectory [s].
    time_limit : for the whole check [s]; then the unit is stopped, which is a finding.

    The unit is unpacked, read and run in a process of its own, which ends with this call and with
    this process: a crash, an exit or a hang of the unit is a finding that names the FMI function.
    It may take 2 GB of memory (where the platform can limit that) and unpack to 1 GB in 10 000
    files; names that lead out of the archive's folder and XML with a DOCTYPE are findings. This
    guards against accidents; a unit that means harm still runs with the rights of the user.
    Everything else that runs an FMU (closed loops, :class:`Runner`) does so in this process.

    Raises InputError when the file is no archive or nothing can be compared, SimulationError when
    the process cannot be started. What is wrong with the FMU stands in the result.

    Examples
    --------
    >>> path = pam.export_fmu(plant, "load.fmu", platforms=["native"])
    >>> pam.check_fmu(path, against=motion).largest < 1e-4
    True
    """
    (check,) = check_fmus(
        [path],
        against,
        parameters=parameters,
        tolerance=tolerance,
        duration=duration,
        time_limit=time_limit,
    )
    return check


@interruptible()
def check_fmus(
    paths: Sequence[str | os.PathLike[str]],
    against: Trajectory | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    tolerance: float = 1e-6,
    duration: float = 0.2,
    time_limit: float = 60.0,
) -> list[FmuCheck]:
    """:func:`check_fmu` of several units of one origin, one after the other in one process.

    Python and its libraries are loaded once for all of them, which takes longer than a check. A
    unit that ends the process ends its own check only: the next ones run in a new process.
    time_limit : for each, on average [s].
    """
    if isinstance(paths, (str, os.PathLike)):
        raise InputError(f"paths = {str(paths)!r} is one file; give a list of them, or check_fmu")
    tolerance = require_positive("tolerance", tolerance)
    duration = require_positive("duration", duration, "s")
    time_limit = require_positive("time_limit", time_limit, "s")
    require_instance("against", against, Trajectory, "give a Trajectory, or none", none=True)
    values = {n: require_finite(f"parameters: {n}", v) for n, v in (parameters or {}).items()}
    files = [_readable(Path(path)) for path in paths]
    same = {
        "against": _plain(against),
        "parameters": values,
        "tolerance": tolerance,
        "duration": duration,
    }
    jobs = [{"path": str(file.absolute()), **same} for file in files]
    found: list[FmuCheck] = []
    while len(found) < len(files):  # again behind a unit that has ended the process
        rest = len(found)
        told = _inspected(jobs[rest:], files[rest], time_limit, against)
        found += [_verdict(t, f, tolerance) for t, f in zip(told, files[rest:], strict=False)]
    return found


def _readable(file: Path) -> Path:
    require_local(file)
    if not file.is_file():
        raise InputError(f"{file}: {'a folder, no FMU' if file.is_dir() else 'no such file'}")
    if not os.access(file, os.R_OK):
        raise InputError(f"{file}: this file cannot be read as an FMU (no permission)")
    if not zipfile.is_zipfile(file):
        raise InputError(f"{file}: this file cannot be read as an FMU (it is no zip archive)")
    return file


def _inspected(
    jobs: Sequence[Mapping[str, Any]], file: Path, time_limit: float, against: Trajectory | None
) -> list[dict[str, Any]]:
    """What came of the first jobs: of all of them, or up to the one that ended the process."""
    told: list[dict[str, Any]] = [{"findings": []}]

    def hear(next_unit: bool = False, findings: Sequence[str] = (), **what: Any) -> None:
        if next_unit:
            told.append({"findings": []})
        told[-1]["findings"] += findings
        told[-1].update(what)

    try:
        with tempfile.TemporaryDirectory(prefix="pam_ocp_", ignore_cleanup_errors=True) as name:
            work = "pam_ocp.export.inspection:inspect_each"
            limit = time_limit * len(jobs)
            ended = run_alone(work, {"units": jobs}, Path(name), limit, hear)
            if against is not None:
                for i, unit in enumerate(told):
                    unit["runs"] = _runs(unit, Path(name) / str(i), against)
    except OSError as error:
        raise SimulationError(f"{file}: there is no room to unpack it ({error})") from None
    if not ended.finished:
        told[-1]["findings"].append(f"the unit {ended}; the check ended there")
    return told


def _runs(told: Mapping[str, Any], folder: Path, against: Trajectory) -> dict[str, Trajectory]:
    """What the unit did, while its files are there."""
    inputs, names = against.named("input"), told.get("compared", ())
    runs: dict[str, Trajectory] = {}
    for kind, file in told.get("played", {}).items():
        with contextlib.suppress(OSError, ValueError):  # the unit has touched the file
            values = np.load(folder / file, allow_pickle=False)
            columns = {n: against[n] for n in inputs} | dict(zip(names, values.T, strict=True))
            variables = [against.variable(n) for n in (*names, *inputs)]
            runs[kind] = Trajectory(against.t, columns, variables, against.interpolation)
    return runs


def _verdict(told: Mapping[str, Any], file: Path, tolerance: float) -> FmuCheck:
    """Raises InputError where nothing could be compared."""
    if "refused" in told:
        raise InputError(told["refused"])
    return FmuCheck(
        file,
        told.get("fmi", ""),
        tolerance,
        tuple(told.get("platforms", ())),
        tuple(told["findings"]),
        told.get("deviations", {}),
        told.get("runs", {}),
    )


def _plain(record: Trajectory | None) -> Trajectory | None:
    """A record that another process can read, whatever class of the caller's it is."""
    if record is None:
        return None
    columns = {n: record[n] for n in record.names}
    return Trajectory(record.t, columns, record.variables, record.interpolation, (), record.signals)

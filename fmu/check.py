"""check_fmu: is an FMU well formed, and does it move as it should?"""

from __future__ import annotations

import os
import struct
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pam_ocp.errors import InputError, require_positive
from pam_ocp.trajectory import Trajectory

from .compile import PLATFORMS, native
from .replay import replay
from .runner import Kind, Runner, UnpackedFmu, pointer
from .symbols import exported_symbols

__all__ = ["FmuCheck", "check_fmu"]

Array: TypeAlias = NDArray[np.float64]

_LINKER_MARKS = ("__dso_handle", "_mh_dylib_header")
"""zig's linker exports these two addresses from every library for macOS."""


@dataclass(frozen=True)
class FmuCheck:
    """What :func:`check_fmu` found. ``print`` it for a report; ``ok`` for a verdict."""

    path: Path
    fmi: str
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
        """The largest deviation of all, in units of nominal; 0 when nothing was compared."""
        return max((d for mode in self.deviations.values() for d in mode.values()), default=0.0)

    def to_dict(self) -> dict[str, Any]:
        """The verdict and its figures as plain data, for JSON."""
        return {
            "file": self.path.name,
            "fmi": self.fmi,
            "ok": self.ok,
            "platforms": list(self.platforms),
            "findings": list(self.findings),
            "largest": {mode: max(found.values()) for mode, found in self.deviations.items()},
            "deviations": {mode: dict(found) for mode, found in self.deviations.items()},
        }

    def __str__(self) -> str:
        lines = [
            f"{self.path.name}: FMI {self.fmi}, {'all well' if self.ok else 'NOT well'}",
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
        return "\n".join(lines)


def check_fmu(
    path: str | os.PathLike[str],
    against: Trajectory | None = None,
    *,
    parameters: Mapping[str, float] | None = None,
    tolerance: float = 1e-6,
    duration: float = 0.2,
) -> FmuCheck:
    """Validate an FMU and let it run in every mode it has.

    1. FMPy's validation of the description and the file.
    2. Binaries: which platforms are there, do they export FMI functions only.
    3. Simulation in Co-Simulation and Model Exchange, compared with ``against`` at its times; the
       inputs run between the samples as the trajectory says: held, linear or curved, exactly in
       Model Exchange, in Co-Simulation by lines (FMI 2) or pairs of held values (FMI 3) with the
       same mean and first moment, to an error of about 1e-8 of nominal. Without a trajectory
       the two modes are compared with each other over ``duration`` [s], at constant inputs.
    4. A state saved, serialised and restored in another instance continues to the last bit.
    5. Directional derivatives agree with differences to 1e-6.

    Parameters
    ----------
    path : the FMU.
    against : a Trajectory whose columns have the FMU's names: inputs are played, the first row of
        the states (and of parameters, where it has some) is the start, states and outputs are
        compared.
    parameters : values [SI] other than the FMU's start values, by name.
    tolerance : largest deviation allowed, in units of each variable's nominal.

    Raises InputError when the file cannot be read as an FMU or nothing can be compared. What is
    wrong with a readable FMU stands in the result.
    """
    from fmpy.validation import validate_fmu

    file = Path(path)
    require_positive("tolerance", tolerance)
    require_positive("duration", duration, "s")
    if not file.is_file():
        raise InputError(f"{file}: no such file")
    with tempfile.TemporaryDirectory(prefix="pam_ocp_") as folder:
        fmu = UnpackedFmu(file, Path(folder))
        platforms, findings = _binaries(file, fmu)
        findings = [*validate_fmu(str(file)), *findings]
        deviations: dict[str, dict[str, float]] = {}
        runs: dict[str, Trajectory] = {}
        if native().name in platforms:
            try:
                deviations, runs = _simulated(fmu, against, parameters or {}, duration)
                findings += _too_large(deviations, tolerance)
                findings += _state_findings(fmu) + _derivative_findings(fmu)
            except InputError:
                raise
            except Exception as error:  # FMPy raises plain Exceptions
                findings.append(str(error))
        else:
            findings.append(f"no binary for this machine ({native().name}): nothing was simulated")
    return FmuCheck(file, fmu.fmi, tolerance, platforms, tuple(findings), deviations, runs)


def _too_large(deviations: Mapping[str, Mapping[str, float]], tolerance: float) -> list[str]:
    return [
        f"{mode}: {name} deviates by {value:.1e} of its nominal, {tolerance:g} is allowed"
        for mode, columns in deviations.items()
        for name, value in columns.items()
        if not value <= tolerance
    ]


# ---- binaries -----------------------------------------------------------------------------------


def _binaries(path: Path, fmu: UnpackedFmu) -> tuple[tuple[str, ...], list[str]]:
    """Platforms with a binary, and what is wrong with the binaries."""
    interfaces = (fmu.description.modelExchange, fmu.description.coSimulation)
    identifier = next(i.modelIdentifier for i in interfaces if i is not None)
    platforms, findings = [], []
    with zipfile.ZipFile(path) as archive:
        names = set(archive.namelist())
        for platform in PLATFORMS.values():
            folder = platform.folder2 if fmu.fmi == "2.0" else platform.name
            name = f"binaries/{folder}/{identifier}{platform.suffix}"
            if name not in names:
                continue
            platforms.append(platform.name)
            try:
                symbols = exported_symbols(archive.read(name))
            except (ValueError, IndexError, struct.error) as error:
                findings.append(f"{name} is no shared library ({error})")
                continue
            known = (f"fmi{fmu.fmi[0]}", *_LINKER_MARKS)
            foreign = [s for s in symbols if not s.startswith(known)]
            if foreign:
                findings.append(f"{name} exports foreign symbols: {', '.join(foreign[:5])}")
            if not symbols:
                findings.append(f"{name} exports nothing")
    return tuple(platforms), findings


# ---- simulation ---------------------------------------------------------------------------------


def _kinds(fmu: UnpackedFmu) -> list[Kind]:
    offered: list[tuple[Kind, object]] = [
        ("CoSimulation", fmu.description.coSimulation),
        ("ModelExchange", fmu.description.modelExchange),
    ]
    return [kind for kind, interface in offered if interface is not None]


def _simulated(
    fmu: UnpackedFmu,
    against: Trajectory | None,
    parameters: Mapping[str, float],
    duration: float,
) -> tuple[dict[str, dict[str, float]], dict[str, Trajectory]]:
    """Deviations, and what the FMU did, for each mode."""
    if against is not None:
        compared = [n for n in against.names if n in fmu.names("output")]
        if not compared:
            raise InputError("the trajectory has no column that is an output of the FMU")
        truth = against.array(compared)
        found = {kind: replay(fmu, kind, against, parameters, compared) for kind in _kinds(fmu)}
        runs: dict[str, Trajectory] = {
            kind: _run(against, compared, values) for kind, values in found.items()
        }
        return {k: _deviations(fmu, compared, truth, v) for k, v in found.items()}, runs
    outputs = fmu.names("output")
    still = Trajectory(np.linspace(0.0, duration, 51), {})
    found = {kind: replay(fmu, kind, still, parameters, outputs) for kind in _kinds(fmu)}
    if len(found) < 2:
        return {}, {}
    first, second = found
    return {f"{first} - {second}": _deviations(fmu, outputs, found[first], found[second])}, {}


def _run(record: Trajectory, names: list[str], values: Array) -> Trajectory:
    inputs = record.named("input")
    columns = {n: record[n] for n in inputs} | dict(zip(names, values.T, strict=True))
    variables = [record.variable(n) for n in (*names, *inputs)]
    return Trajectory(record.t, columns, variables, record.interpolation)


def _deviations(fmu: UnpackedFmu, names: list[str], truth: Array, found: Array) -> dict[str, float]:
    scaled = np.max(np.abs(found - truth), axis=0) / fmu.nominals(names)
    return dict(zip(names, map(float, scaled), strict=True))


# ---- saved states and derivatives ---------------------------------------------------------------


def _state_findings(fmu: UnpackedFmu) -> list[str]:
    """A state restored in another instance must continue to the last bit."""
    simulation = fmu.description.coSimulation
    if simulation is None or not simulation.canSerializeFMUstate:
        return []
    outputs, size = fmu.names("output"), 1e-3
    with Runner(fmu, "CoSimulation") as one, Runner(fmu, "CoSimulation") as other:
        for runner in (one, other):
            runner.initialize({}, 0.0, None)
        for i in range(10):
            one.step(i * size, size)
        saved = one.save()
        other.restore(saved)
        for i in range(10, 20):
            one.step(i * size, size)
            other.step(i * size, size)
        same = np.array_equal(one.get(outputs), other.get(outputs))
        one.restore(saved)
        for i in range(10, 20):
            one.step(i * size, size)
        rolled_back = np.array_equal(one.get(outputs), other.get(outputs))
    findings = []
    if not same:
        findings.append("a state restored in another instance does not continue to the last bit")
    if not rolled_back:
        findings.append("a state rolled back does not continue to the last bit")
    return findings


def _derivative_findings(fmu: UnpackedFmu) -> list[str]:
    """Directional derivatives against differences, in units of nominal.

    At a kink the derivative is that of one side: differences are central and to either side.
    """
    if not fmu.has_directional_derivatives:
        return []
    unknowns = [f"der({n})" for n in fmu.states]
    unknowns += [n for n in fmu.names("output") if n not in fmu.states]
    knowns = [*fmu.states, *fmu.names("input")]
    scale, reach = fmu.nominals(unknowns), 1e-5 * fmu.nominals(knowns)
    findings = []
    with Runner(fmu, "ModelExchange") as runner:
        runner.initialize({}, 0.0, None)
        point = runner.get(knowns)

        def at(values: Array) -> Array:
            n = len(fmu.states)
            states = np.ascontiguousarray(values[:n])
            runner.inner.setContinuousStates(pointer(states), n)
            runner.set(dict(zip(knowns[n:], values[n:], strict=True)))
            return runner.get(unknowns)

        for i, known in enumerate(knowns):
            step = np.where(np.arange(len(knowns)) == i, reach, 0.0)
            before, last, here, next_, behind = (at(point + k * step) for k in (-2, -1, 0, 1, 2))
            twice = (next_ - last, 4 * next_ - 3 * here - behind, 3 * here - 4 * last + before)
            at(point)
            exact = runner.directional(unknowns, [known], [1.0])
            size = np.maximum(np.abs(exact), scale / reach[i] * 1e-5)
            errors = [np.abs(exact - t / (2 * reach[i])) / size for t in twice]
            if np.max(np.min(errors, axis=0)) > 1e-5:
                findings.append(f"directional derivatives along {known} differ from differences")
    return findings

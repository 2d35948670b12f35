"""What :func:`check_fmu` does with a unit, in a process of the unit's own (see isolation.py)."""

from __future__ import annotations

import os
import struct
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, UnknownNameError
from ..core.trajectory import Trajectory
from .archive import printable
from .compile import PLATFORMS, native
from .isolation import Tell
from .runner import Kind, Runner, UnpackedFmu, note_calls, pointer, replay
from .symbols import exported_symbols

Array: TypeAlias = NDArray[np.float64]

_LINKER_MARKS = ("__dso_handle", "_mh_dylib_header")
"""zig's linker exports these two addresses from every library for macOS."""
_ROUNDING = 1e-9
"""What a start value may be off, in parts of itself or of its nominal: decimals are rounded."""
_SHARES = (1e-3, -1e-3, 0.1, -0.1)
"""Of a variable's size, by which it is moved to see what depends on it."""
_MOST_FINDINGS, _LONGEST = 100, 500
"""Of one kind, and characters of one."""


def inspect_each(job: Mapping[str, Any], tell: Tell, note: Callable[[str], None]) -> None:
    """:func:`inspect` of the jobs ``units``, each in a folder of its own named by its number;
    between two of them tells ``next_unit``.
    """
    here = Path.cwd()
    for number, unit in enumerate(job["units"]):
        if number:
            tell(next_unit=True)
        folder = here / str(number)
        folder.mkdir()
        os.chdir(folder)
        inspect(unit, tell, note)
        os.chdir(here)


def inspect(job: Mapping[str, Any], tell: Tell, note: Callable[[str], None]) -> None:
    """Tell ``fmi``, ``platforms``, ``findings`` (lists, to be joined), ``deviations``, ``compared``
    and ``played`` ({mode: file of values}); ``refused`` when the caller's arguments are wrong.

    job : ``path``, ``against``, ``parameters``, ``tolerance``, ``duration``.
    """
    from fmpy.validation import validate_fmu

    note_calls(note)
    path = Path(job["path"])
    note("the reading of its description")
    try:
        fmu = UnpackedFmu(path, Path("unit").absolute())
    except InputError as error:
        return _tell_findings(tell, [str(error).removeprefix(f"{path}: ")])
    tell(fmi=fmu.fmi)
    _tell_findings(tell, validate_fmu(str(path)))
    note("")
    if not _interfaces(fmu):
        return _tell_findings(tell, ["the FMU offers neither Co-Simulation nor Model Exchange"])
    platforms, findings = _binaries(path, fmu)
    tell(platforms=platforms)
    _tell_findings(tell, findings)
    if native().name not in platforms:
        here = native().name
        return _tell_findings(tell, [f"no binary for this machine ({here}): nothing was simulated"])
    against, parameters = job["against"], job["parameters"]
    try:
        _require_known(fmu, against, parameters)
    except InputError as error:
        return tell(refused=str(error))
    try:
        _run_all(fmu, against, parameters, job["duration"], job["tolerance"], tell)
    except MemoryError:
        _tell_findings(tell, ["the unit asked for more memory than it may have"])
    except Exception as error:  # FMPy raises plain Exceptions
        _tell_findings(tell, [str(error) or repr(error)])


def _tell_findings(tell: Tell, findings: Iterable[object]) -> None:
    """Someone else's words go to a terminal: printable, and not without end."""
    lines = [" ".join(str(f).split()) for f in findings]
    plain = [printable(f)[:_LONGEST] for f in lines]
    more = len(plain) - _MOST_FINDINGS
    tell(findings=plain[:_MOST_FINDINGS] + ([f"... and {more} more"] if more > 0 else []))


def _interfaces(fmu: UnpackedFmu) -> list[tuple[Kind, Any]]:
    offered: list[tuple[Kind, Any]] = [
        ("CoSimulation", fmu.description.coSimulation),
        ("ModelExchange", fmu.description.modelExchange),
    ]
    return [(kind, interface) for kind, interface in offered if interface is not None]


def _require_known(
    fmu: UnpackedFmu, against: Trajectory | None, parameters: Mapping[str, float]
) -> None:
    for name in parameters:
        if name not in fmu.references:
            raise UnknownNameError("variable of the FMU", name, fmu.references)
    if against is not None and not _compared(fmu, against):
        raise InputError("the trajectory has no column that is an output of the FMU")


def _compared(fmu: UnpackedFmu, against: Trajectory) -> list[str]:
    return [n for n in against.names if n in fmu.names("output")]


def _run_all(
    fmu: UnpackedFmu,
    against: Trajectory | None,
    parameters: Mapping[str, float],
    duration: float,
    tolerance: float,
    tell: Tell,
) -> None:
    if against is None:
        deviations = _modes_compared(fmu, parameters, duration)
    else:
        deviations = _replayed(fmu, against, parameters, tell)
    tell(deviations=deviations)
    _tell_findings(tell, _too_large(deviations, tolerance))
    _tell_findings(tell, _start_findings(fmu))
    _tell_findings(tell, _range_findings(fmu))
    _tell_findings(tell, _dependency_findings(fmu))
    _tell_findings(tell, _state_findings(fmu))
    _tell_findings(tell, _derivative_findings(fmu))


# ---- binaries -----------------------------------------------------------------------------------


def _binaries(path: Path, fmu: UnpackedFmu) -> tuple[tuple[str, ...], list[str]]:
    """Platforms with a binary, and what is wrong with the binaries."""
    identifier = _interfaces(fmu)[0][1].modelIdentifier
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
            except (ValueError, IndexError, struct.error, OverflowError) as error:
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


def _modes_compared(
    fmu: UnpackedFmu, parameters: Mapping[str, float], duration: float
) -> dict[str, dict[str, float]]:
    """Without a record: the two modes against each other, at constant inputs."""
    outputs = fmu.names("output")
    still = Trajectory(np.linspace(0.0, duration, 51), {})
    found = {k: replay(fmu, k, still, parameters, outputs) for k, _ in _interfaces(fmu)}
    if len(found) < 2:
        return {}
    first, second = found
    return {f"{first} - {second}": _deviations(fmu, outputs, found[first], found[second])}


def _replayed(
    fmu: UnpackedFmu, against: Trajectory, parameters: Mapping[str, float], tell: Tell
) -> dict[str, dict[str, float]]:
    """Each mode against the record; what the FMU did goes into files."""
    compared = _compared(fmu, against)
    truth = against.array(compared)
    deviations: dict[str, dict[str, float]] = {}
    played = {}
    for kind, _ in _interfaces(fmu):
        values = replay(fmu, kind, against, parameters, compared)
        played[kind] = f"{kind}.npy"
        np.save(played[kind], values, allow_pickle=False)
        deviations[kind] = _deviations(fmu, compared, truth, values)
    tell(compared=compared, played=played)
    return deviations


def _deviations(fmu: UnpackedFmu, names: list[str], truth: Array, found: Array) -> dict[str, float]:
    scaled = np.max(np.abs(found - truth), axis=0) / fmu.nominals(names)
    return dict(zip(names, map(float, scaled), strict=True))


def _too_large(deviations: Mapping[str, Mapping[str, float]], tolerance: float) -> list[str]:
    return [
        f"{mode}: {name} deviates by {value:.1e} of its nominal, {tolerance:g} is allowed"
        for mode, columns in deviations.items()
        for name, value in columns.items()
        if not value <= tolerance
    ]


# ---- saved states and derivatives ---------------------------------------------------------------


def _plain_reals(fmu: UnpackedFmu) -> dict[str, Any]:
    """Real variables that are no arrays."""
    reals = {n: v for n, v in fmu.variables.items() if v.type in ("Real", "Float64")}
    return {n: v for n, v in reals.items() if not getattr(v, "dimensions", None)}


def _start_findings(fmu: UnpackedFmu) -> list[str]:
    """The binary starts at the values that the description states, and within its ranges."""
    plain = _plain_reals(fmu)
    given = ("input", "parameter", "structuralParameter")
    stated = {
        n: float(v.start)
        for n, v in plain.items()
        if v.start is not None and (v.initial == "exact" or v.causality in given)
    }
    findings = []
    for kind, _ in _interfaces(fmu):
        with Runner(fmu, kind) as runner:
            runner.initialize({}, 0.0, None)
            values = dict(zip(plain, runner.get(list(plain)), strict=True))
        where = f"at the start in {kind}"
        for name, start in stated.items():
            size = max(abs(start), float(fmu.nominals([name])[0]))
            if abs(values[name] - start) > _ROUNDING * size:
                told = f"{start:g} in the description"
                findings.append(f"{name} is {values[name]:g} {where}, {told}")
        for name, v in plain.items():
            low, high = _range(v)
            slack = _ROUNDING * float(fmu.nominals([name])[0])
            if not low - slack <= values[name] <= high + slack:
                told = f"outside of {low:g} .. {high:g}, its range in the description"
                findings.append(f"{name} is {values[name]:g} {where}, {told}")
    return findings


def _range(variable: Any) -> tuple[float, float]:
    low, high = (None if end is None else float(end) for end in (variable.min, variable.max))
    return -np.inf if low is None else low, np.inf if high is None else high


def _range_findings(fmu: UnpackedFmu) -> list[str]:
    """The binary takes both ends of the ranges of inputs and parameters; if it refuses parameters
    beyond theirs, which is left to it, then those of all.
    """
    kind = _interfaces(fmu)[0][0]
    findings: list[str] = []
    refused: list[str] = []
    taken: list[str] = []
    for name, v in _plain_reals(fmu).items():
        if v.causality not in ("input", "parameter") or v.variability == "constant":
            continue
        low, high = _range(v)
        for end, value, outwards in (("min", low, -1.0), ("max", high, 1.0)):
            if not np.isfinite(value):
                continue
            if not _takes(fmu, kind, name, value):
                findings.append(f"{name} = {value:g} is refused, its {end} in the description")
            beyond = value + outwards * max(abs(value), float(fmu.nominals([name])[0]))
            if v.causality == "parameter":
                told = (
                    f"{name} = {beyond:g} is taken, beyond its {end} {value:g} in the description"
                )
                (taken if _takes(fmu, kind, name, beyond) else refused).append(told)
    return findings + (taken if refused else [])


def _takes(fmu: UnpackedFmu, kind: Kind, name: str, value: float) -> bool:
    with Runner(fmu, kind) as runner:  # anew: after an error an instance need not go on
        try:
            runner.set({name: value})
        except Exception:  # FMPy raises plain Exceptions
            return False
    return True


def _dependency_findings(fmu: UnpackedFmu) -> list[str]:
    """What moves when a known moves is told as a dependency: at the start, and in Model Exchange
    between events. A dependency that is told and not seen is none the less right.
    """
    kind = _interfaces(fmu)[-1][0]
    description, plain = fmu.description, _plain_reals(fmu)
    given = [n for n, v in plain.items() if v.causality in ("input", "parameter")]
    exact = [n for n, v in plain.items() if v.initial == "exact" and n not in given]
    findings = _undeclared(fmu, kind, description.initialUnknowns, [*given, *exact], True)
    if kind == "ModelExchange":
        unknowns = [*description.outputs, *description.derivatives]
        knowns = [*fmu.states, *fmu.names("input")]
        findings += _undeclared(fmu, kind, unknowns, knowns, False)
    return findings


def _undeclared(
    fmu: UnpackedFmu, kind: Kind, unknowns: Iterable[Any], knowns: Iterable[str], start: bool
) -> list[str]:
    plain = _plain_reals(fmu)
    told = {
        u.variable.name: {v.name for v in u.dependencies}
        for u in unknowns
        if u.dependencies is not None and u.variable.name in plain
    }
    if not told:
        return []
    findings, names, where = [], list(told), " at the start" if start else ""
    scale = fmu.nominals(names)
    for known in (n for n in knowns if n in plain):
        moved = _moved(fmu, kind, names, known, start) > _ROUNDING * scale
        findings += [
            f"{name} depends on {known}{where}, which the description does not tell"
            for name, moves in zip(names, moved, strict=True)
            if moves and known not in told[name] and name != known
        ]
    return findings


def _moved(fmu: UnpackedFmu, kind: Kind, names: Sequence[str], known: str, start: bool) -> Array:
    """How far variables move at most with ``known``, by shares of its size within its range; up to
    where the binary refuses that.
    """
    low, high = _range(fmu.variables[known])
    farthest = np.zeros(len(names))
    with Runner(fmu, kind) as runner:
        runner.begin(0.0)
        if not start:
            runner.end_initialization()
        before, value = runner.get(names), float(runner.get([known])[0])
        size = max(abs(value), float(fmu.nominals([known])[0]))
        for share in _SHARES:
            try:
                runner.set({known: float(np.clip(value + share * size, low, high))})
                after = runner.get(names)
            except Exception:  # FMPy raises plain Exceptions
                break
            farthest = np.fmax(farthest, np.abs(after - before))
    return farthest


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
    """Directional derivatives against differences, scaled by nominals.

    At a kink the derivative is that of one side: differences are central and to either side.
    """
    if not fmu.has_directional_derivatives:
        return []
    unknowns = list(fmu.derivatives)
    plain = _plain_reals(fmu)
    unknowns += [n for n in fmu.names("output") if n not in fmu.states and n in plain]
    knowns = [*fmu.states, *(n for n in fmu.names("input") if n in plain)]
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

"""What the tests of an FMU in motion share."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from conftest import BAR, benchmark_slide
from fmpy.fmi3 import FMU3Slave
from fmpy.ssp.ssd import get_connections, read_ssd

from pam_ocp.export import check_fmu, export_fmu
from pam_ocp.export.runner import Runner, UnpackedFmu

VERSIONS = ("2.0", "3.0")
KINDS = ("CoSimulation", "ModelExchange")
COMMANDS = ("muscle1.command", "muscle2.command")
DISCARD, ERROR = 2, 3


def exported(system: Any, folder: Path, fmi: Any = "2.0", **options: Any) -> Path:
    """The FMU of a plant or a block, of itself for this machine."""
    options.setdefault("platforms", "native")
    folder.mkdir(exist_ok=True)
    return export_fmu(system, folder / f"{fmi[0]}.fmu", fmi=fmi, **options)


def opened(system: Any, folder: Path, fmi: Any = "2.0", **options: Any) -> UnpackedFmu:
    """The same unpacked, below the folder."""
    return UnpackedFmu(exported(system, folder, fmi, **options), folder / fmi)


def unpacked(folder: Path) -> dict[str, UnpackedFmu]:
    """The benchmark's slide in both versions, unpacked."""
    return {fmi: opened(benchmark_slide(), folder, fmi) for fmi in VERSIONS}


def event_mode(unit: UnpackedFmu) -> FMU3Slave:
    """An instance of FMI 3 whose importer knows events."""
    inner = FMU3Slave(
        guid=unit.description.guid,
        unzipDirectory=str(unit.folder),
        modelIdentifier=unit.description.coSimulation.modelIdentifier,
        instanceName="instance",
    )
    inner.instantiate(eventModeUsed=True)
    return inner


def started(
    fmu: UnpackedFmu, kind: Any, start: dict[str, float] | None = None, time: float = 0.0
) -> Runner:
    runner = Runner(fmu, kind)
    runner.initialize(start or {}, time, None)
    return runner


def now(runner: Runner) -> float:
    """The time at which an instance stands; value reference 0 in both versions."""
    read = runner.inner.getReal if runner.fmu.fmi == "2.0" else runner.inner.getFloat64
    return float(read([0])[0])


def bars_every(step: float, duration: float, seed: int = 7) -> tuple[Any, Any]:
    """Commands like those of a planned tour: held, jumping by bars at each step."""
    t = np.arange(0, round(duration / step) + 1) * step
    return t, np.random.default_rng(seed).uniform(0.5 * BAR, 5.5 * BAR, (len(t), 2))


class System:
    """The units of a system (SSP), which exchange when they are told to."""

    def __init__(self, path: Path, folder: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        system = read_ssd(str(path)).system
        self.units = {
            part.name: Runner(UnpackedFmu(folder / part.source, folder / part.name), "CoSimulation")
            for part in system.elements
        }
        self.wires = {
            f"{b.parent.name}.{b.name}": f"{a.parent.name}.{a.name}"
            for a, b in get_connections(system)
        }

    def values(self) -> dict[str, float]:
        """All of them, by component.variable; what an input is to be is that of its source."""
        found = {}
        for key, unit in self.units.items():
            names = list(unit.fmu.references)
            found |= dict(zip((f"{key}.{n}" for n in names), unit.get(names).tolist(), strict=True))
        return found | {sink: found[source] for sink, source in self.wires.items()}

    def set(self, values: dict[str, float]) -> None:
        """Inputs."""
        for sink in self.wires:
            key, _, name = sink.partition(".")
            self.units[key].set({name: values[sink]})

    def step(self, time: float, size: float) -> None:
        for unit in self.units.values():
            unit.step(time, size)

    def free(self) -> None:
        for unit in self.units.values():
            unit.inner.freeInstance()


def coupled(path: Path, folder: Path, steps: int, step: float) -> dict[str, Any]:
    """A system stepped here: all step, then all hand over; values behind each step. The first
    inputs are 0, as in FMPy.
    """
    system, rows = System(path, folder), []
    for unit in system.units.values():
        unit.initialize({}, 0.0, None)
    given = dict.fromkeys(system.wires, 0.0)
    for k in range(steps):
        system.set(given)
        system.step(k * step, step)
        given = system.values()
        rows.append(given)
    system.free()
    return {n: np.array([row[n] for row in rows]) for n in rows[0]}


def require_agreement(plant: Any, motion: Any, folder: Path, fmi: Any = "2.0") -> None:
    """The plant's FMU moves in every mode as the motion does, and is well; and something moves."""
    checked = check_fmu(exported(plant, folder, fmi), against=motion)
    assert checked.findings == ()
    assert set(checked.deviations) == set(KINDS)
    assert checked.largest < 1e-6
    assert np.ptp(motion["x"]) > 1e-3


def sound(system: Any, folder: Path, fmi: Any, **options: Any) -> UnpackedFmu:
    """The FMU of a plant or a block, checked and unpacked."""
    found = check_fmu(exported(system, folder, fmi, **options))
    assert found.ok, str(found)
    return UnpackedFmu(found.path, folder / fmi)

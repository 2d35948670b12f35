"""What the tests of an FMU in motion share."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from conftest import BAR, benchmark_slide

from pam_ocp.export import export_fmu
from pam_ocp.export.runner import Runner, UnpackedFmu

VERSIONS = ("2.0", "3.0")
KINDS = ("CoSimulation", "ModelExchange")
COMMANDS = ("muscle1.command", "muscle2.command")
DISCARD, ERROR = 2, 3


def unpacked(folder: Path) -> dict[str, UnpackedFmu]:
    """The benchmark's slide in both versions, unpacked."""
    found = {}
    for fmi in VERSIONS:
        path = export_fmu(benchmark_slide(), folder / f"{fmi[0]}.fmu", fmi=fmi, platforms="native")  # type: ignore[arg-type]
        found[fmi] = UnpackedFmu(path, folder / fmi)
    return found


def started(fmu: UnpackedFmu, kind: Any, start: dict[str, float] | None = None) -> Runner:
    runner = Runner(fmu, kind)
    runner.initialize(start or {}, 0.0, None)
    return runner


def now(runner: Runner) -> float:
    """The time at which an instance stands; value reference 0 in both versions."""
    read = runner.inner.getReal if runner.fmu.fmi == "2.0" else runner.inner.getFloat64
    return float(read([0])[0])


def bars_every(step: float, duration: float, seed: int = 7) -> tuple[Any, Any]:
    """Commands like those of a planned tour: held, jumping by bars at each step."""
    t = np.arange(0, round(duration / step) + 1) * step
    return t, np.random.default_rng(seed).uniform(0.5 * BAR, 5.5 * BAR, (len(t), 2))


def coupled(
    path: Path, folder: Path, steps: int, step: float, wires: dict[str, str], seen: tuple[str, ...]
) -> dict[str, Any]:
    """A system (SSP) stepped here: all step, then all hand over. The first inputs are 0, as in
    FMPy.

    wires : {sink: source}; returns their values and those of ``seen`` (component.variable) by step.
    """
    with zipfile.ZipFile(path) as archive:
        archive.extractall(folder)
    ends = [*wires, *wires.values(), *seen]
    runners = {}
    for key in dict.fromkeys(end.partition(".")[0] for end in ends):
        fmu = UnpackedFmu(folder / "resources" / f"{key}.fmu", folder / key)
        runners[key] = started(fmu, "CoSimulation")

    def value(end: str) -> float:
        key, _, name = end.partition(".")
        return float(runners[key].get([name])[0])

    values, rows = dict.fromkeys(wires, 0.0), []
    for k in range(steps):
        for key, runner in runners.items():
            own = {n: v for n, v in values.items() if n.startswith(f"{key}.")}
            runner.set({n.removeprefix(f"{key}."): v for n, v in own.items()})
            runner.step(k * step, step)
        values = {sink: value(source) for sink, source in wires.items()}
        rows.append([*values.values(), *(value(end) for end in seen)])
    for runner in runners.values():
        runner.__exit__(None, None, None)
    return dict(zip([*wires, *seen], np.array(rows).T, strict=True))

"""What the tests of an FMU in motion share."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from conftest import BAR, benchmark_slide

from pam_ocp.fmu import export_fmu
from pam_ocp.fmu.runner import Runner, UnpackedFmu

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

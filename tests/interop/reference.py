"""What the importers are compared with, and where their deviations are noted."""

from __future__ import annotations

import csv
import importlib
import json
import os
import xml.etree.ElementTree as ET
import zipfile
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

FOLDER = os.environ.get("PAM_OCP_INTEROP", "")
"""Where run.py laid FMUs and reference motions; empty outside of it."""
LIMIT = 1e-6
"""Largest deviation allowed, in units of each variable's nominal."""
SYSTEM_LIMIT = 1e-9
"""The same of systems, whose parts are the same units exchanged at the same instants."""


def needs_run() -> None:
    """Skip a whole test file where run.py has not prepared anything."""
    if not FOLDER:
        pytest.skip("other tools' importers: python tests/interop/run.py", allow_module_level=True)


def importer(module: str) -> ModuleType:
    """The module of an importer; a skip with the reason when it, or a system library,
    is missing.
    """
    try:
        return importlib.import_module(module)
    except (ImportError, OSError, RuntimeError) as error:
        name = module.partition(".")[0]
        reasons = json.loads((Path(FOLDER) / "not_installed.json").read_text(encoding="utf-8"))
        pytest.skip(f"{name}: {reasons.get(name, error)}")


class Motion:
    """One reference motion: ``held``, ``constant``, ``system``, ``feedback`` or ``sampled`` of the
    slide, ``predictive`` and ``turning`` with valves, ``controller`` of the sampled block.

    handed : of a system, as read once the inputs of the next step are handed over.
    """

    def __init__(self, name: str, handed: bool = False) -> None:
        folder = Path(FOLDER)
        facts = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
        self.table_path = folder / f"{name}{'_handed' if handed else ''}.csv"
        with self.table_path.open(encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        table = np.array(rows, float)
        self.columns = dict(zip(header, table.T, strict=True))
        self.t = self.columns["time"]
        self.step: float = facts["step"]
        about = facts.get(name, facts)
        self.start: dict[str, float] = about["start"]
        self.inputs: list[str] = about["inputs"]
        self.states: list[str] = about["states"]
        self.nominals: dict[str, float] = about["nominals"]
        self.results = list(self.nominals)

    def inputs_at(self, k: int) -> list[float]:
        """The inputs held over step k."""
        return [float(self.columns[n][k]) for n in self.inputs]

    def check(
        self, tool: str, mode: str, rows: Any, names: list[str] | None = None, limit: float = LIMIT
    ) -> None:
        """Note the largest deviation of ``rows`` (behind each step), and fail beyond ``limit``.

        ``rows`` has a row for each time but the first, a column for each name.
        """
        names = self.results if names is None else names
        truth = np.column_stack([self.columns[n] for n in names])[1:]
        found = np.asarray(rows, float)
        assert found.shape == truth.shape
        scaled = np.abs(found - truth) / [self.nominals[n] for n in names]
        assert np.ptp(truth[:, 0]) > 0.1 * self.nominals[names[0]], "the motion does not move"
        note(tool, mode, float(np.max(scaled)))
        worst = names[int(np.argmax(np.max(scaled, axis=0)))]
        assert np.max(scaled) <= limit, f"{worst} deviates by {np.max(scaled):.1e} of its nominal"


def note(tool: str, mode: str, deviation: float | str) -> None:
    """A line for the table that run.py prints."""
    with (Path(FOLDER) / "results.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps([tool, mode, deviation]) + "\n")


def fmu(version: str, unit: str = "slide") -> Path:
    """The FMU of one version of FMI ("2" or "3"): of the slide or its "controller"."""
    return Path(FOLDER) / f"{unit}{version}.fmu"


class Description:
    """The few facts of a modelDescription.xml that a bare loader asks its user for."""

    def __init__(self, path: Path) -> None:
        with zipfile.ZipFile(path) as archive:
            root = ET.fromstring(archive.read("modelDescription.xml"))
        variables = root.find("ModelVariables")
        simulation = root.find("CoSimulation")
        assert variables is not None
        assert simulation is not None
        self.token = root.get("guid") or root.get("instantiationToken") or ""
        self.identifier = simulation.get("modelIdentifier", "")
        self.references = {v.get("name", ""): int(v.get("valueReference", "")) for v in variables}

    def of(self, names: Any) -> list[int]:
        return [self.references[n] for n in names]

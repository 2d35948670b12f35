"""FMU Manipulation Toolbox: its checks, a container around the FMU,
a binary made of the sources.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from reference import Motion, fmu, importer, needs_run, note

needs_run()

VERSIONS = ("2", "3")
TOOLBOX = "fmu-manipulation-toolbox"
COMPILER = shlex.split(os.environ.get("CC", "cc"))[0]


def toolbox(command: str, *arguments: str, folder: Path) -> str:
    """What a command of the toolbox says; it must end well and find no fault."""
    importer("fmu_manipulation_toolbox")
    program = Path(sys.executable).parent / command
    done = subprocess.run(
        [str(program), *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert not [line for line in said.splitlines() if line.startswith(("ERROR", "CRITICAL"))], said
    return said


def run(path: Path, motion: Motion, names: list[str], start: dict[str, float]) -> np.ndarray:
    """Co-Simulation by FMPy: the named results behind each step."""
    fmpy = importer("fmpy")
    columns = ("time", *motion.inputs)
    played = np.empty(len(motion.t), dtype=[(n, float) for n in columns])
    for name in columns:
        played[name] = motion.columns[name]
    result = fmpy.simulate_fmu(
        str(path),
        fmi_type="CoSimulation",
        stop_time=float(motion.t[-1]),
        output_interval=motion.step,
        step_size=motion.step,
        start_values=start,
        input=played,
        output=names,
    )
    return np.column_stack([result[n] for n in names])[1:]


@pytest.mark.parametrize("version", VERSIONS)
def test_its_checks_find_nothing(version: str, tmp_path: Path) -> None:
    said = toolbox("fmutool", "-input", str(fmu(version)), "-check", folder=tmp_path)
    assert f"compliant with FMI-{version}.0" in said
    assert "No semantic error" in said
    assert "WARNING" not in said, said
    note(TOOLBOX, f"FMI {version} check", "nothing found")


@pytest.mark.parametrize("version", VERSIONS)
def test_a_binary_compiled_from_the_sources_moves_alike(version: str, tmp_path: Path) -> None:
    if shutil.which(COMPILER) is None:
        pytest.skip(f"{TOOLBOX}: no C compiler {COMPILER!r} to compile sources with")
    bare, built = tmp_path / "bare.fmu", tmp_path / "built.fmu"
    with zipfile.ZipFile(fmu(version)) as old, zipfile.ZipFile(bare, "w") as new:
        for name in old.namelist():
            if not name.startswith("binaries/"):
                new.writestr(name, old.read(name))
    toolbox(
        "fmutool", "-input", str(bare), "-compile-sources", "-output", str(built), folder=tmp_path
    )
    with zipfile.ZipFile(built) as archive:
        assert any(n.startswith("binaries/") for n in archive.namelist())
    motion = Motion("held")
    rows = run(built, motion, motion.results, motion.start)
    motion.check(TOOLBOX, f"FMI {version} CS, compiled", rows)


@pytest.mark.parametrize("outer", VERSIONS)
@pytest.mark.parametrize("inner", VERSIONS)
def test_a_container_around_it_moves_alike(inner: str, outer: str, tmp_path: Path) -> None:
    motion = Motion("held")
    shutil.copy(fmu(inner), tmp_path / "slide.fmu")
    description = {
        "name": "box.fmu",
        "step_size": motion.step,
        "fmu": ["slide.fmu"],
        "input": [[n, "slide.fmu", n] for n in motion.inputs],
        "output": [["slide.fmu", n, n] for n in motion.results],
        "start": [["slide.fmu", n, v] for n, v in motion.start.items()],
        "auto_input": False,
        "auto_output": False,
    }
    (tmp_path / "box.json").write_text(json.dumps(description))
    toolbox(
        "fmucontainer",
        "-container",
        "box.json",
        "-fmu-directory",
        str(tmp_path),
        "-fmi",
        outer,
        folder=tmp_path,
    )
    rows = run(tmp_path / "box.fmu", motion, motion.results, {})
    motion.check(TOOLBOX, f"FMI {inner} CS in a container of FMI {outer}", rows)

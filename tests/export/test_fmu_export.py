"""What an exported FMU holds: description, binaries, reproducible bytes; and what is refused."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import fmpy
import fmpy.validation
import numpy as np
import pytest
from conftest import benchmark_slide, refused
from fmu_tools import VERSIONS, exported
from hostile import contents
from lxml import etree

import pam_ocp as pam
from pam_ocp import ExportError, InputError, UnknownNameError
from pam_ocp.export import PLATFORMS, check_fmu, export_fmu
from pam_ocp.export import compile as compiler
from pam_ocp.export.symbols import exported_symbols


def oscillator(name: str = "oscillator") -> pam.Plant:
    """A plant a user wrote: x'' = (f - k x)/m."""
    plant = pam.Plant(name, "a mass on a spring")
    x = plant.state("x", unit="m", start=0.1)
    v = plant.state("v", unit="m/s")
    f = plant.input("force", unit="N")
    m = plant.parameter("mass", 2.0, unit="kg", min=1e-6)
    k = plant.parameter("spring.rate", 100.0, unit="N/m", min=0.0, tunable=True)
    plant.der(x, v)
    plant.der(v, (f - k * x) / m)
    plant.output("spring.force", k * x, unit="N")
    plant.output("twice", 2 * f, unit="N")
    return plant


@pytest.mark.parametrize("make", [benchmark_slide, oscillator])
def test_fmpy_finds_nothing_to_complain_about(make, fmi, tmp_path):
    assert fmpy.validation.validate_fmu(str(exported(make(), tmp_path, fmi))) == []


def test_every_variable_tells_unit_range_nominal_and_meaning(fmi, tmp_path):
    plant = benchmark_slide()
    description = fmpy.read_model_description(str(exported(plant, tmp_path, fmi)))
    variables = {v.name: v for v in description.modelVariables}
    for expected in (*plant.states, *plant.inputs, *plant.parameters, *plant.outputs):
        found, kind = variables[expected.name], expected.causality
        assert found.causality == ("output" if kind == "state" else kind)
        assert (found.unit, found.description) == (expected.unit, expected.description)
        assert float(found.nominal) == expected.nominal
        assert found.displayUnit in (expected.display_unit, None)
        for bound in ("min", "max"):
            value, text = getattr(expected, bound), getattr(found, bound)
            if bound == "max" and kind == "parameter" and not np.isfinite(value):
                assert float(text) > abs(expected.start)  # far beyond any usual value
            else:
                assert float(text) == value if np.isfinite(value) else text is None
        if kind != "output":
            assert float(found.start) == expected.start
    assert variables["mass"].variability == "tunable"
    assert variables["muscle1.a1"].variability == "fixed"
    units = {u.name: u for u in description.unitDefinitions}
    assert units["Pa"].displayUnits[0].name == "bar"
    assert float(units["Pa"].displayUnits[0].factor) == pytest.approx(1e-5)
    assert (units["Pa"].baseUnit.kg, units["Pa"].baseUnit.m, units["Pa"].baseUnit.s) == (1, -1, -2)


def test_dependencies_are_exact(fmi, tmp_path):
    description = fmpy.read_model_description(str(exported(oscillator(), tmp_path, fmi)))

    def known(unknowns: Any) -> dict[str, dict[str, str]]:
        pairs = {u.variable.name: (u.dependencies, u.dependenciesKind) for u in unknowns}
        return {n: {d.name: k for d, k in zip(*p, strict=True)} for n, p in pairs.items()}

    assert known(description.derivatives) == {
        "der(x)": {"v": "constant"},
        "der(v)": {"x": "tunable", "force": "fixed"},
    }
    assert known(description.outputs) == {
        "x": {"x": "constant"},
        "v": {"v": "constant"},
        "spring.force": {"x": "tunable"},
        "twice": {"force": "constant"},
    }
    assert known(description.initialUnknowns) == {
        "der(x)": {"v": "constant"},
        "der(v)": dict.fromkeys(("x", "force", "mass", "spring.rate"), "dependent"),
        "spring.force": {"x": "dependent", "spring.rate": "dependent"},
        "twice": {"force": "constant"},
    }


def test_the_same_plant_gives_the_same_bytes(fmi, tmp_path, monkeypatch):
    first = exported(benchmark_slide(), tmp_path, fmi).read_bytes()
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / "elsewhere"))
    monkeypatch.setenv("ZIG_GLOBAL_CACHE_DIR", str(tmp_path / "zig"))
    assert exported(benchmark_slide(), tmp_path, fmi).read_bytes() == first


def test_another_start_value_gives_another_token(tmp_path):
    tokens = {
        fmpy.read_model_description(str(exported(plant, tmp_path))).guid
        for plant in (oscillator(), oscillator().with_values(mass=3.0))
    }
    assert len(tokens) == 2


def test_only_fmi_functions_can_be_seen_from_outside(fmi, tmp_path):
    inside = contents(exported(benchmark_slide(), tmp_path, fmi))
    (library,) = (c for n, c in inside.items() if n.startswith("binaries/"))
    symbols = exported_symbols(library)
    header = (Path(__file__).parents[2] / f"fmu/include/fmi{fmi[0]}Functions.h").read_text()
    declared = set(re.findall(rf"FMI{fmi[0]}_Export\s+\w+\s+(fmi\w+)\s*;", header))
    assert set(symbols) == declared
    assert str(tmp_path).encode() not in library
    assert str(Path.home()).encode() + b"/" not in library


@pytest.mark.slow
def test_five_platforms_are_in_the_file(fmi, tmp_path):
    path = exported(benchmark_slide(), tmp_path, fmi, platforms=None)
    found = check_fmu(path)
    assert found.ok, str(found)
    assert set(found.platforms) == {n for n, p in PLATFORMS.items() if not p.on_request}
    binaries = {n: c for n, c in contents(path).items() if n.startswith("binaries/")}
    marks = {".so": b"\x7fELF", ".dll": b"MZ", ".dylib": b"\xcf\xfa\xed\xfe"}
    assert len(binaries) == {"2.0": 4, "3.0": 5}[fmi]
    if fmi == "2.0":
        marks[".dylib"] = b"\xca\xfe\xba\xbe"  # both processors in one file
    for name, content in binaries.items():
        assert content.startswith(marks[Path(name).suffix]), name
    if fmi == "2.0":  # what the FMU names is really there, whoever reads the fat header
        dylib = next(c for n, c in binaries.items() if n.endswith(".dylib"))
        thin = [int.from_bytes(dylib[16 + 20 * i : 20 + 20 * i], "big") for i in range(2)]
        assert all(dylib[offset : offset + 4] == b"\xcf\xfa\xed\xfe" for offset in thin)


@pytest.mark.slow
def test_sources_in_the_file_compile_without_warnings(tmp_path):
    for fmi in VERSIONS:
        folder = fmpy.extract(str(exported(benchmark_slide(), tmp_path, fmi)), str(tmp_path / fmi))
        command = [sys.executable, "-m", "ziglang", "cc", "-std=c11", "-O1", "-Wall", "-Wextra"]
        command += ["-c", "fmu.c", "-o", "fmu.o"]
        # also without a home
        how = {"env": {**os.environ, "ZIG_GLOBAL_CACHE_DIR": str(tmp_path / "zig")}}
        how |= {"cwd": f"{folder}/sources", "capture_output": True, "text": True, "check": True}
        assert subprocess.run(command, **how).stderr == ""


def test_documentation_shows_equations_and_parameters(tmp_path):
    inside = contents(exported(oscillator(), tmp_path))
    page = inside["documentation/index.html"].decode()
    assert {"model.png", "documentation/licenses/license.txt"} <= set(inside)
    assert "der(x) = v" in page
    assert "twice = 2.*force" in page
    for parameter in oscillator().parameters:
        assert f"<td>{parameter.name}</td>" in page


def test_a_reference_motion_goes_into_the_documentation(tmp_path):
    plant, t = oscillator(), np.linspace(0, 1, 11)
    motion = pam.simulate(plant, {"force": 3.0}, t=t)
    first = exported(plant, tmp_path, reference=motion)
    assert fmpy.validation.validate_fmu(str(first)) == []
    content, inside = first.read_bytes(), contents(first)
    results, inputs = (
        inside[f"documentation/oscillator_{n}.csv"].decode().splitlines() for n in ("ref", "in")
    )
    assert inside["documentation/reference.png"].startswith(b"\x89PNG")
    assert "reference.png" in inside["documentation/index.html"].decode()
    assert results[0] == '"time","x","v","spring.force","twice"'
    last = [motion[n][-1] for n in ("x", "v", "spring.force", "twice")]
    assert [float(c) for c in results[-1].split(",")] == [1.0, *last]
    assert inputs[:2] == ['"time","force"', "0.0,3.0"]
    assert exported(plant, tmp_path, reference=motion).read_bytes() == content


def test_changed_values_become_start_values(tmp_path):
    plant = oscillator().with_values(mass=3.5, x=-0.2)
    description = fmpy.read_model_description(str(exported(plant, tmp_path)))
    start = {v.name: v.start for v in description.modelVariables}
    assert (float(start["mass"]), float(start["x"])) == (3.5, -0.2)


# ---- refused -------------------------------------------------------------------------------------


def test_bad_arguments_are_refused_in_a_sentence(tmp_path):
    plant, path = oscillator(), tmp_path / "plant.fmu"
    with pytest.raises(UnknownNameError, match=r"did you mean 'x86_64-linux'"):
        export_fmu(plant, path, platforms=["x86_64-linus"])
    refused("FMI version", export_fmu, plant, path, error=UnknownNameError, fmi="1.0")
    refused("not a Plant", export_fmu, "plant", path)
    refused("tolerance", export_fmu, plant, path, tolerance=0.5)
    refused("fixed_step", export_fmu, plant, path, fixed_step=-1.0)
    with pytest.raises(InputError, match="does not exist"):
        export_fmu(plant, tmp_path / "nowhere" / "plant.fmu", platforms="native")
    assert list(tmp_path.iterdir()) == []


def test_a_variable_named_time_is_refused(tmp_path):
    plant = pam.Plant("clock")
    plant.der(plant.state("time"), 1.0)
    with pytest.raises(ExportError, match="'time'"):
        export_fmu(plant, tmp_path / "clock.fmu", platforms="native")


def test_without_compiler_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "_zig", lambda: None)
    monkeypatch.setattr(compiler, "_local", lambda: None)
    with pytest.raises(ExportError, match=r"no C compiler .*gcc.*pip install 'pam_ocp\[cross\]'"):
        export_fmu(oscillator(), tmp_path / "plant.fmu", platforms="native")
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def tools(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """A folder that alone is searched for compilers, with scripts put into it."""
    folder = tmp_path / "tools"
    folder.mkdir()
    search = shutil.which
    monkeypatch.setattr(compiler.shutil, "which", lambda name: search(name, path=str(folder)))

    def add(name: str, script: str) -> Path:
        (folder / name).write_text(f"#!/bin/sh\n{script}\n")
        (folder / name).chmod(0o755)
        return folder / name

    compiler._local.cache_clear()
    yield add
    compiler._local.cache_clear()


@pytest.mark.skipif(os.name == "nt", reason="scripts of a shell")
def test_the_compiler_of_this_machine_is_taken_first_where_it_works(tools):
    tools("cc", "exit 1")  # is there, and makes nothing
    assert compiler._local() is None
    assert compiler._compiler(compiler.native(), alone=True).cross
    compiler._local.cache_clear()
    real = shutil.which("gcc") or shutil.which("clang")
    if real is None:
        pytest.skip("no C compiler here")
    gcc = tools("gcc", f'exec "{real}" "$@"')
    assert compiler._compiler(compiler.native(), alone=True).command == (str(gcc),)
    # among other platforms all are zig's: the same bytes wherever the unit is made
    assert compiler._compiler(compiler.native(), alone=False).cross


def test_visual_c_is_asked_in_its_own_words():
    cl = compiler._Compiler((r"C:\VC\bin\cl.exe" if os.name == "nt" else "/vc/cl.exe",), "19.4")
    command = compiler._command(cl, compiler.PLATFORMS["x86_64-windows"], "plant.dll", "fmu.c")
    assert command[1:] == [
        *("/nologo", "/std:c11", "/O2", "/LD", "/fp:precise", "/utf-8"),
        *("fmu.c", "/Fe:plant.dll", "/link", "/Brepro"),
    ]


def test_a_name_that_c_keeps_for_itself_is_changed(tmp_path):
    description = fmpy.read_model_description(str(exported(oscillator("double"), tmp_path)))
    assert description.coSimulation.modelIdentifier == "double_"


def test_a_file_that_is_no_fmu_is_refused(tmp_path):
    path = tmp_path / "plant.fmu"
    refused("no such file", check_fmu, path)
    path.write_text("no zip")
    refused("cannot be read as an FMU", check_fmu, path)


def test_a_source_code_fmu_is_built_as_its_build_description_says(fmi, tmp_path):
    """By the machine's own compiler, and runs as the FMU that has a binary."""
    cc = shutil.which("cc") or shutil.which("gcc")
    if cc is None:
        pytest.skip("no C compiler")
    plant = benchmark_slide()
    bare = export_fmu(plant, tmp_path / "bare.fmu", fmi=fmi, platforms="source")
    whole = export_fmu(plant, tmp_path / "whole.fmu", fmi=fmi, platforms="native")
    folder = Path(fmpy.extract(str(bare), str(tmp_path / "bare")))
    assert not (folder / "binaries").exists()
    told = etree.parse(str(folder / "sources/buildDescription.xml")).getroot()[0]
    files = [f.get("name", "") for f in told.iter("SourceFile")]
    place = folder / "binaries" / ("linux64" if fmi == "2.0" else "x86_64-linux")
    place.mkdir(parents=True)
    library = place / f"{told.get('modelIdentifier')}.so"
    options = ["-std=c11", "-shared", "-fPIC", "-ffp-contract=off"]
    command = [cc, *options, "-o", str(library), *files, "-lm"]
    subprocess.run(command, cwd=folder / "sources", check=True)
    run = {"stop_time": 0.1, "output_interval": 0.01, "start_values": {"muscle1.command": 4e5}}
    built = fmpy.simulate_fmu(str(folder), **run)
    packed = fmpy.simulate_fmu(str(whole), **run)
    assert np.ptp(built["x"]) > 1e-4
    assert built["x"] == pytest.approx(packed["x"], abs=1e-12)

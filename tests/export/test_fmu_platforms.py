"""One FMU, three platforms: native, aarch64 under qemu, Windows under Wine give the same bits."""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable
from decimal import Decimal, localcontext
from pathlib import Path
from typing import Any

import fmpy
import numpy as np
import pytest
from conftest import benchmark_slide, hardening_cart
from hostile import contents

import pam_ocp as pam
from pam_ocp.export import PLATFORMS, check_fmu, export_fmu
from pam_ocp.export.compile import compile_library, native, platforms_named
from pam_ocp.export.source import c_sources, c_text
from pam_ocp.export.symbols import exported_symbols
from pam_ocp.plants.damping import CoulombFriction

PROGRAMS = Path(__file__).parents[2] / "fmu" / "tests"
ARM_ROOT = Path("/usr/aarch64-linux-gnu")
QEMU = shutil.which("qemu-aarch64") or shutil.which("qemu-aarch64-static")
WINE = (
    shutil.which("wine64") or shutil.which("wine64", path="/usr/lib/wine") or shutil.which("wine")
)
LINES = 20
"""How often the loader (fmu/tests/loader.c) prints in its 2000 steps."""

needs_qemu = pytest.mark.skipif(
    QEMU is None or not ARM_ROOT.is_dir(),
    reason="needs qemu-aarch64 and an aarch64 C library (Debian: qemu-user, libc6-arm64-cross)",
)
needs_wine = pytest.mark.skipif(
    WINE is None or platform.machine().lower() not in ("x86_64", "amd64"),
    reason="needs wine on x86_64 (Debian: wine64)",
)


needs_32_bits = pytest.mark.skipif(
    not Path("/lib/ld-linux.so.2").exists()
    or platform.machine().lower() not in ("x86_64", "amd64", "i686"),
    reason="needs a 32-bit C library on x86 (Debian: libc6-i386)",
)


def rubbing_slide() -> pam.Plant:
    """Dry friction with a Stribeck hump: tanh and exp on top of the force law's exp."""
    losses = (CoulombFriction(10.0, 1e-5, 0.5),)
    return pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), mass=2.0, losses=losses)


def row_of_loads() -> pam.Plant:
    """Twelve coupled loads: functions whose local variables take more than a page of the stack."""
    plant = pam.Plant("row_of_loads")
    muscle = pam.muscle("DMSP-20-400N")
    x = [plant.state(f"x{i}", unit="m", start=0.04, nominal=0.01) for i in range(12)]
    v = [plant.state(f"v{i}", unit="m/s", nominal=0.1) for i in range(12)]
    for i in range(12):
        own = plant.add_muscle(f"muscle{i}", muscle, shortening=x[i], rate=v[i])
        beside = sum(x[j] - x[i] for j in (i - 1, i + 1) if 0 <= j < 12)
        plant.der(x[i], v[i])
        plant.der(v[i], (own.force - 200.0 + 2e3 * beside - 50.0 * v[i]) / 20.0)
    return plant


class Bench:
    """FMUs and loaders, built once; ``run`` gives what a platform's loader prints."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.fmus: dict[Any, Path] = {}
        self.loaders: dict[Any, Path] = {}

    def fmu(self, make: Callable[[], pam.Plant], fmi: Any) -> Path:
        """The FMU for all three platforms, unpacked."""
        if (make, fmi) not in self.fmus:
            target = self.folder / f"{make.__name__}{fmi[0]}"
            names = {native().name, "aarch64-linux", "x86_64-windows", "x86-linux"}
            path = export_fmu(make(), target.with_suffix(".fmu"), fmi=fmi, platforms=names)
            fmpy.extract(str(path), str(target))
            self.fmus[make, fmi] = target
        return self.fmus[make, fmi]

    def loader(self, fmi: str, name: str) -> Path:
        """The C program for one platform, compiled by zig."""
        if (fmi, name) not in self.loaders:
            target = self.folder / f"loader{fmi[0]}-{name}.exe"
            command = [sys.executable, "-m", "ziglang", "cc", "-target", PLATFORMS[name].target]
            command += ["-std=c11", "-O1", f"-DFMI={fmi[0]}", "-I", str(c_sources() / "include")]
            command += [str(PROGRAMS / "loader.c"), "-o", str(target)]
            subprocess.run([*command, *(["-ldl"] if name.endswith("linux") else [])], check=True)
            self.loaders[fmi, name] = target
        return self.loaders[fmi, name]

    def run(self, make: Any, fmi: str, name: str, *emulator: str, **environment: str) -> list[str]:
        folder = self.fmu(make, fmi)
        told = fmpy.read_model_description(str(folder))
        chosen = PLATFORMS[name]
        place = folder / "binaries" / (chosen.folder2 if fmi == "2.0" else name)
        library = place / f"{told.coSimulation.modelIdentifier}{chosen.suffix}"
        plant = make()
        first = {v.name: str(v.valueReference) for v in told.modelVariables}
        groups = (plant.inputs, plant.states, plant.outputs)
        ranges = [word for group in groups for word in (first[group[0].name], str(len(group)))]
        command = [*emulator, str(self.loader(fmi, name)), str(library), told.guid, *ranges]
        how = {"capture_output": True, "text": True, "env": os.environ | environment}
        done = subprocess.run(command, check=False, **how)
        assert done.returncode == 0, done.stdout + done.stderr
        lines = done.stdout.split("\n")
        return [line.strip() for line in lines if line.strip()]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    return Bench(tmp_path_factory.mktemp("platforms"))


PLANTS = [(benchmark_slide, "2.0"), (benchmark_slide, "3.0"), (rubbing_slide, "2.0")]
CASES = pytest.mark.parametrize(("make", "fmi"), PLANTS)


def moves(lines: list[str]) -> bool:
    """Whether a loader printed what it should, and every line another one."""
    return len(lines) == LINES == len({line.partition(" ")[2] for line in lines})


@needs_qemu
@CASES
def test_aarch64_gives_the_bits_of_this_machine(make, fmi, bench):
    here = bench.run(make, fmi, native().name)
    there = bench.run(make, fmi, "aarch64-linux", str(QEMU), "-L", str(ARM_ROOT))
    assert moves(here)
    assert there == here


@needs_32_bits
@CASES
def test_32_bits_give_the_bits_of_this_machine(make, fmi, bench):
    here = bench.run(make, fmi, native().name)
    assert moves(here)
    assert bench.run(make, fmi, "x86-linux") == here


@pytest.mark.slow
def test_platforms_on_request_have_their_folders_and_fmis_symbols(fmi, tmp_path):
    """Of the big plant, too: its functions ask for Windows' check of the stack."""
    wanted = {
        "x86-linux": ("linux32", ".so"),
        "x86-windows": ("win32", ".dll"),
        "aarch64-windows": ("aarch64-windows", ".dll"),
    }
    assert not any(n in {p.name for p in platforms_named(None)} for n in wanted)
    windows = [name for name in wanted if name.endswith("windows")]
    cases = [(hardening_cart(), [*wanted, "native"])]
    if fmi == "3.0":  # the functions are those of FMI 2
        cases.append((row_of_loads(), windows))
    for plant, platforms in cases:
        path = export_fmu(plant, tmp_path / "x.fmu", fmi=fmi, platforms=platforms)
        inside = contents(path)
        for name in set(wanted) & set(platforms):
            folder, suffix = wanted[name]
            place = f"binaries/{folder if fmi == '2.0' else name}/{plant.name}{suffix}"
            symbols = exported_symbols(inside[place])
            assert f"fmi{fmi[0]}DoStep" in symbols
            assert all(s.startswith(f"fmi{fmi[0]}") for s in symbols)
        built = {native().name if name == "native" else name for name in platforms}
        assert set(check_fmu(path).platforms) == built


@needs_wine
@pytest.mark.slow
@pytest.mark.parametrize(("make", "fmi"), [*PLANTS, (row_of_loads, "3.0")])
def test_windows_gives_the_bits_of_this_machine(make, fmi, bench, tmp_path_factory):
    prefix = tmp_path_factory.getbasetemp() / "wine"
    here = bench.run(make, fmi, native().name)
    environment = {"WINEPREFIX": str(prefix), "WINEDEBUG": "-all", "DISPLAY": ""}
    environment["WINEDLLOVERRIDES"] = "mscoree,mshtml="  # nothing of .NET or of a browser is set up
    there = bench.run(make, fmi, "x86_64-windows", str(WINE), **environment)
    assert moves(here)
    assert there == here


# ---- the exponentials that make it so -----------------------------------------------------------

_EXPORTS = """
#include "elementary.h"
#if defined(_WIN32)
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
EXPORT double own_exp(double x) { return portable_exp(x); }
EXPORT double own_expm1(double x) { return portable_expm1(x); }
EXPORT double own_tanh(double x) { return portable_tanh(x); }
"""


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The functions of fmu/src/elementary.h."""
    header = c_text("elementary.h")
    sources = {"elementary.h": header, "main.c": _EXPORTS}
    path = tmp_path_factory.mktemp("elementary") / f"own{native().suffix}"
    path.write_bytes(compile_library(sources, "main.c", native(), "own"))
    library = ctypes.CDLL(str(path))
    for name in ("own_exp", "own_expm1", "own_tanh"):
        function = getattr(library, name)
        function.restype, function.argtypes = ctypes.c_double, [ctypes.c_double]
    return library


def exact(name: str, x: float) -> Decimal:
    """The value to fifty digits."""
    value = Decimal(x)
    if name == "exp":
        return value.exp()
    if name == "expm1":
        return value.exp() - 1
    return 1 - 2 / ((2 * value).exp() + 1)


@pytest.mark.parametrize(("name", "allowed"), [("exp", 0.6), ("expm1", 2.0), ("tanh", 2.5)])
def test_exponentials_are_right_to_the_last_bits(name, allowed, own):
    rng = np.random.default_rng(4)
    ranges = ((-30, 30, 3000), (-1, 1, 3000), (-0.02, 0.02, 1000), (-708, 709, 1000))
    tiny = rng.choice([-1, 1], 1000) * 10 ** rng.uniform(-14, -2, 1000)
    points = np.concatenate([*(rng.uniform(*r) for r in ranges), tiny])
    function = getattr(own, f"own_{name}")
    with localcontext() as context:
        context.prec = 50
        for x in map(float, points):
            truth = exact(name, x)
            unit = Decimal(float(np.spacing(abs(float(truth)))))
            assert abs(Decimal(function(x)) - truth) <= Decimal(allowed) * unit, x


def test_exponentials_at_their_ends(own):
    inf, nan = float("inf"), float("nan")
    for x, expected in (
        (0.0, (1.0, 0.0, 0.0)),
        (inf, (inf, inf, 1.0)),
        (-inf, (0.0, -1.0, -1.0)),
        (710.0, (inf, inf, 1.0)),
        (-746.0, (0.0, -1.0, -1.0)),
        (nan, (nan, nan, nan)),
        (-745.0, (5e-324, -1.0, -1.0)),
        (1e-320, (1.0, 1e-320, 1e-320)),
    ):
        found = (own.own_exp(x), own.own_expm1(x), own.own_tanh(x))
        assert np.array_equal(found, expected, equal_nan=True), x
    assert own.own_exp(709.782712893384) == pytest.approx(1.797693134862273e308, rel=1e-12)
    assert own.own_exp(709.7827128933841) == inf

"""A C export at work: compiled here, its step called by ctypes; and its self-test on machines."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pam_ocp.core.block import Block
from pam_ocp.export.c_code.files import field_names


@cache
def works(compiler: str, *flags: str) -> bool:
    """Whether a program that this compiler makes with these flags runs here: it is tried."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.c").write_text("int main(void) { return 0; }\n")
        for command in ([compiler, *flags, "a.c", "-o", "a"], [str(Path(folder) / "a")]):
            try:
                if subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode:
                    return False
            except OSError:
                return False
    return True


def require_works(compiler: str | None, *flags: str) -> None:
    """A skip unless programs made by this compiler with these flags run here."""
    if compiler is None or not works(compiler, *flags):
        pytest.skip(f"needs {compiler or 'a C compiler'} with {' '.join(flags)}")


COMPILER = next((c for c in map(shutil.which, ("gcc", "cc", "clang")) if c and works(c)), None)
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")
STRICT = (
    *("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion"),
    *("-Wshadow", "-Wdouble-promotion", "-Werror"),
)

ZIG = (sys.executable, "-m", "ziglang", "cc")
WARN = ("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion", "-Werror")
BARE = Path(__file__).parent / "export" / "cortex"
"""A start-up file, a linker script and the few headers that a bare Cortex-M7 wants."""

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler (cc)")


def run(*command: Any, cwd: Path | None = None) -> str:
    """What a command prints; AssertionError with its words where it fails."""
    done = subprocess.run(
        [str(c) for c in command], cwd=cwd, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stderr, done.stderr  # warnings
    return done.stdout


def effort(source: Path) -> str:
    """-O2, as users compile; of predictive controllers it takes twice as long as -O1."""
    return "-O2" if source.stat().st_size < 200_000 else "-O1"


def printed_by(text: str, folder: Path, *more: str, given: Sequence[Any] = ()) -> list[str]:
    """The words that a program prints, compiled with these further files and flags."""
    (folder / "program.c").write_text(text)
    efforts = {effort(folder / file) for file in more if file.endswith(".c")}
    flags = ("-std=c99", min(efforts, default="-O2"), "-ffp-contract=off")
    run(COMPILER, *flags, "program.c", *more, "-o", "program", "-lm", cwd=folder)
    return run(folder / "program", *given).split()


def selftest(folder: Path, name: str, *flags: str, compiler: Any = None) -> str:
    """What the self-test prints; it fails with a warning of the compiler, too."""
    program = folder / "selftest"
    sources = [f"{name}.c", f"{name}_selftest.c"]
    chosen = compiler or [COMPILER]
    run(*chosen, *STRICT, *flags, *sources, "-o", program, "-lm", cwd=folder)
    return run(program)


def needs(program: str) -> str:
    """Where a program is; a skip where it is not."""
    found = shutil.which(program) or shutil.which(f"{program}-static")
    if found is None:
        pytest.skip(f"needs {program}")
    return found


def bits_of(printed: str) -> str:
    """The sum of bits that a self-test prints; it must have passed."""
    assert "passed" in printed, printed
    found = re.search(r"bits ([0-9a-f]{8})", printed)
    assert found is not None
    return found.group(1)


def on_aarch64(folder: Path, name: str) -> str:
    """What the self-test prints on aarch64, under qemu."""
    emulator = needs("qemu-aarch64")
    sources = [f"{name}.c", f"{name}_selftest.c", "-static", "-o", "elsewhere"]
    run(
        *ZIG,
        "-target",
        "aarch64-linux-musl",
        *WARN,
        effort(folder / f"{name}.c"),
        *sources,
        cwd=folder,
    )
    return run(emulator, folder / "elsewhere")


def on_cortex_m7(folder: Path, name: str) -> str:
    """What it prints on qemu's mps2-an500, without an operating system or a C library."""
    emulator = needs("qemu-system-arm")
    cpu = ("-target", "thumb-freestanding-eabihf", "-mcpu=cortex_m7+fp_armv8d16+fp64")
    plain = ("-ffreestanding", "-fno-math-errno", "-fno-sanitize=all", "-fno-unwind-tables")
    sources = [BARE / "startup.c", f"{name}.c", f"{name}_selftest.c"]
    link = (f"-Wl,-T,{BARE / 'mps2.ld'}", "-I", BARE / "include", "-o", "bare.elf")
    level = effort(folder / f"{name}.c")
    run(*ZIG, *cpu, *plain, *WARN, level, *sources, *link, cwd=folder)
    semihosting = ("-semihosting-config", "enable=on,target=native")
    machine = ("-M", "mps2-an500", "-nographic", *semihosting)
    command = [emulator, *machine, "-kernel", str(folder / "bare.elf")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr  # semihosting writes to the latter


class Program:
    """A Controller whose step is the compiled C of a block."""

    def __init__(
        self,
        folder: Path,
        name: str,
        block: Block,
        told: Callable[[float], Mapping[str, float]] | None = None,
        real: Any = ctypes.c_double,
    ) -> None:
        library = folder / f"{name}.so"
        source = folder / f"{name}.c"
        if not library.exists() or library.stat().st_mtime < source.stat().st_mtime:
            level = effort(source)
            # -O1 warns of what -O2 sees through: self-tests ask for warnings
            flags = STRICT if level == "-O2" else ("-std=c99", level, "-ffp-contract=off")
            run(COMPILER, *flags, "-shared", "-fPIC", source, "-o", library, "-lm", cwd=folder)
        self._library = ctypes.CDLL(str(library))
        self._step = getattr(self._library, f"{name}_step")
        self._init = getattr(self._library, f"{name}_init")
        self.block, self.told, self.sample_time = block, told, block.sample_time
        kinds = ("inputs", "parameters", "outputs")
        self.inputs, self.parameters, self.outputs = (
            (real * max(len(getattr(block, k)), 1))() for k in kinds
        )
        self._state = ctypes.create_string_buffer(1 << 22)
        self.fields = {k: field_names(getattr(block, k)) for k in kinds}
        self.reset()

    def reset(self) -> None:
        self._init(self._state, self.parameters, self.inputs)

    def step(self, values: Mapping[str, float]) -> dict[str, float]:
        """One step from inputs by name; those not named stay as they are."""
        for i, v in enumerate(self.block.inputs):
            if v.name in values:
                self.inputs[i] = values[v.name]
        self._step(self._state, self.parameters, self.inputs, self.outputs)
        return {v.name: float(self.outputs[i]) for i, v in enumerate(self.block.outputs)}

    def __call__(self, t: float, measured: Mapping[str, float]) -> dict[str, float]:
        found = self.step({**measured, **(self.told(t) if self.told else {})})
        return {n: found[n] for n in self.block.commands}


def with_gaps(
    made: Block, program: Program, samples: int, seed: int, blind: Collection[int] = ()
) -> Iterator[tuple[Any, Any]]:
    """(outputs in C, in Python) of samples about the start, a fifth of whose measurements is no
    number; in the ``blind`` ones all of them.
    """
    rng, names = np.random.default_rng(seed), [v.name for v in made.inputs]
    memory, p, start = made.start("memory"), made.start("parameters"), made.start("inputs")
    nominal = np.array([v.nominal for v in made.inputs])
    for k in range(samples):
        values = start + 0.02 * nominal * rng.standard_normal(len(start))
        values[rng.random(len(start)) < 0.2] = rng.choice([np.nan, np.inf, -np.inf])
        if k in blind:
            values[:] = np.nan
        found = program.step(dict(zip(names, values, strict=True)))
        memory, outputs = (np.asarray(m).ravel() for m in made.step(memory, values, p))
        yield np.array([*found.values()]), outputs

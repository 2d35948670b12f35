"""A C export at work: compiled here, its step called by ctypes; and its self-test on machines."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from pam_ocp.core.block import Block
from pam_ocp.export.c_code.files import field_names

COMPILER = shutil.which("gcc") or shutil.which("cc") or shutil.which("clang")
STRICT = (
    *("-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion"),
    *("-Wshadow", "-Wdouble-promotion", "-Werror"),
)

needs_compiler = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler (cc)")


def run(*command: Any, cwd: Path | None = None) -> str:
    """What a command prints; AssertionError with its words where it fails."""
    done = subprocess.run(
        [str(c) for c in command], cwd=cwd, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stderr, done.stderr  # warnings
    return done.stdout


def selftest(folder: Path, name: str, *flags: str, compiler: Any = None) -> str:
    """What the self-test prints; it fails with a warning of the compiler, too."""
    program = folder / "selftest"
    sources = [f"{name}.c", f"{name}_selftest.c"]
    chosen = compiler or [COMPILER]
    run(*chosen, *STRICT, *flags, *sources, "-o", program, "-lm", cwd=folder)
    return run(program)


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
        run(COMPILER, *STRICT, "-shared", "-fPIC", f"{name}.c", "-o", library, "-lm", cwd=folder)
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

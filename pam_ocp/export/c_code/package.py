"""export_c: a block as C source for a target, with the test vectors of its self-test."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import tempfile
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.atomic import make_folder, require_local
from ...core.block import Block
from ...core.errors import SHOWN, ExportError, InputError, require_count, require_positive
from ...core.exceptions import WriteError
from ...core.stop import verb
from .files import CExport, Vectors
from .generated import LARGEST_SINGLE, PRECISIONS, Precision, counted, step_code
from .single import single_outputs

Array: TypeAlias = NDArray[np.float64]

_HEADERS = """
    assert complex ctype elementary errno fenv float inttypes iso646 limits locale math setjmp
    signal stdarg stdbool stddef stdint stdio stdlib string tgmath time wchar wctype
"""
"""Of C99, and one of ours: a NAME.h of the same name would stand in for it."""

MARK = "pam_ocp_export.json"
"""Tells a folder that export_c wrote."""
TOLERANCE = {"double": 1e-12, "single": 1e-4}
"""Least tolerance of a self-test."""
STEPS, STEPS_WITH_LOOPS = 200, 50
"""Of the test vectors."""
MARGIN = 10.0
"""How much more than the effect of rounding a self-test allows."""
USELESS = {"double": 1e-6, "single": 0.05}
"""Test vectors end where the effect of rounding, relative, grows beyond: inputs that contradict
each other can make a filter of a plant with hysteresis chaotic."""


@verb
def export_c(
    controller: Block | Any,
    folder: str | os.PathLike[str],
    *,
    precision: Literal["double", "single"] = "double",
    name: str | None = None,
    steps: int | None = None,
    inputs: ArrayLike | None = None,
    tolerance: float | None = None,
    seed: int = 0,
    **options: Any,
) -> Path:
    """Write a controller as C99 source without heap, global state or system calls.

    The folder holds ``NAME.h`` (structs of inputs, parameters, outputs and state; init and step),
    ``NAME.c``, ``NAME_selftest.c`` with test vectors, CMakeLists.txt, and README.md with memory,
    counts of operations and the worst case of every loop. It is written whole or not at all; an
    export that stands there is replaced.

    Parameters
    ----------
    controller : a Block, or what ``pam_ocp.control.block`` makes one of, with its ``options``.
    precision : of all numbers. The self-test compares with Python's double in either.
    name : prefix of all names in C; by default the block's.
    steps, seed : of the test vectors, by default 200, or 50 of a block with loops (an Mpc), whose
        steps take long; or inputs (n, inputs) [SI] in the block's order.
    tolerance : of the self-test, relative; by default 1e-12 (double) or 1e-4 (single), or ten times
        what rounding makes of the outputs, where that is more.

    Returns the folder. Raises InputError for invalid input, ExportError for a block that
    cannot be C, WriteError for a folder that is there and is no such export.

    Examples
    --------
    >>> law = pam.lqr(plant, point, sample_time=2e-3)
    >>> folder = pam.export.export_c(law, "regulator", plant=plant, steps=20)
    >>> sorted(path.name for path in folder.glob("*.h"))
    ['state_feedback.h']
    """
    if precision not in PRECISIONS:
        raise InputError(f"precision = {precision!r}: choose 'double' or 'single'")
    kind = PRECISIONS[precision]
    if isinstance(controller, Block) and options:
        raise InputError(
            f"{controller.name} is a block already, so {min(options)} is of no effect; give "
            "options to pam_ocp.control.block, which makes it"
        )
    block = controller if isinstance(controller, Block) else Block.of(controller, **options)
    prefix = _prefix(name or block.name)
    _require_finite(block, kind)
    place = _place(folder)
    given = _inputs(block, steps, inputs, seed)
    single = precision == "single"
    expected = outputs_of(block, given, single=single)
    errors, told = sensitivity(block, given, expected, kind.digits, single)
    sound = int(np.sum(errors <= USELESS[precision]))
    if not sound:
        raise ExportError(
            f"{block.name}: rounding in {precision} precision changes its outputs by "
            f"{errors[0]:.1g} of their size in the first step; take precision='double', or give "
            "inputs=... of its normal use"
        )
    given, told = given[:sound], told[:sound]
    if tolerance is None:
        tolerance = max(TOLERANCE[precision], MARGIN * float(errors[sound - 1]))
    limit = require_positive("tolerance", tolerance)
    export = CExport(
        block,
        step_code(block, kind),
        kind,
        counted(block.step),
        Vectors(given, told, limit),
        prefix,
    )
    about = {"kind": "C source of a block", "name": prefix, "precision": precision}
    _write(place, {**export.files(), MARK: json.dumps(about, indent=2) + "\n"})
    return place


def _prefix(name: str) -> str:
    prefix = name.replace(".", "_")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", prefix):
        raise InputError(
            f"name = {name!r}: it begins all names in C; use letters, digits and underscores, a "
            "letter first"
        )
    if prefix.lower() in _HEADERS.split():  # file systems may not tell capitals
        raise InputError(
            f"name = {name!r}: {prefix.lower()}.h is a header that C code includes itself; give "
            f"another name, such as 'my_{prefix}'"
        )
    return prefix


def _require_finite(block: Block, precision: Precision) -> None:
    largest = LARGEST_SINGLE if precision.name == "single" else np.finfo(float).max
    for kind in ("parameters", "memory", "inputs"):
        for variable, value in zip(getattr(block, kind), block.start(kind), strict=True):
            if not abs(value) <= largest:
                raise InputError(
                    f"{variable.name} = {value:g} of {block.name} is no number that "
                    f"{precision.name} precision holds; give a finite one"
                )


def _inputs(block: Block, steps: int | None, inputs: ArrayLike | None, seed: int) -> Array:
    if inputs is None:
        if steps is None:
            steps = STEPS_WITH_LOOPS if block.loops else STEPS
        return inputs_of(block, require_count("steps", steps), require_count("seed", seed, 0))
    try:
        given = np.asarray(inputs, dtype=float)
    except (TypeError, ValueError):
        raise InputError(f"inputs = {SHOWN.repr(inputs)}: give rows of numbers") from None
    if given.ndim != 2 or given.shape[1] != len(block.inputs) or not len(given):
        raise InputError(
            f"inputs has the shape {given.shape}; give (steps, {len(block.inputs)}): "
            f"{', '.join(v.name for v in block.inputs)}"
        )
    return given


# ---- test vectors ------------------------------------------------------------------------------
REACH = 0.3
"""How far the inputs go about their start values, scaled by nominals."""


def inputs_of(block: Block, steps: int, seed: int) -> Array:
    """Smooth inputs (steps, inputs) about their start values, with gaps in what may be missing."""
    random = np.random.default_rng(seed)
    k = np.arange(steps)
    columns = []
    for v in block.inputs:
        start = v.start or 0.0
        column = np.full(steps, start)
        if v.name == "enable":
            column[steps // 2 : steps // 2 + steps // 10] = 0.0
        else:
            for waves in (1, 3, 7):
                size = REACH * v.nominal / waves * random.standard_normal()
                column += size * np.sin(2 * math.pi * (waves * k / steps + random.random()))
            column = np.clip(column, v.min, v.max)
            if v.name in block.missing:
                column[random.random(steps) < 0.03] = np.nan
        columns.append(column)
    if block.missing and steps >= 40:  # and once for longer than anything holds
        names = [v.name for v in block.inputs]
        columns[names.index(block.missing[0])][-steps // 5 : -steps // 10] = np.nan
    found: Array = np.array(columns).T.reshape(steps, len(block.inputs))
    return found


def outputs_of(
    block: Block, inputs: Array, rounding: float = 0.0, single: bool = False, seed: int = 0
) -> Array:
    """Outputs (steps, outputs) of the block in Python.

    single : inputs and parameters are rounded, as in C. rounding : relative error that the memory
    suffers in each step.
    """
    random = np.random.default_rng(seed)
    memory, parameters = block.start("memory"), block.start("parameters")
    if single:
        inputs, parameters = (a.astype(np.float32).astype(float) for a in (inputs, parameters))
    rows = []
    for row in inputs:
        memory, outputs = (np.asarray(m).ravel() for m in block.step(memory, row, parameters))
        rows.append(outputs)
        if rounding:
            moved = memory * (1 + rounding * random.uniform(-1, 1, len(memory)))
            memory = np.where(memory == np.round(memory), memory, moved)  # counts are exact
    found = np.array(rows).reshape(len(inputs), len(block.outputs))
    if not np.all(np.isfinite(found)):
        raise ExportError(
            f"{block.name}: its outputs are not finite under the test vectors; guard it "
            "(pam_ocp.control.block(...)), or give inputs=... of its normal use"
        )
    return found


def sensitivity(
    block: Block, inputs: Array, expected: Array, digits: float, single: bool
) -> tuple[Array, Array]:
    """Of each step so far, the largest change of an output, relative to itself and its nominal,
    that rounding makes; and the expected outputs, NaN for flags (whole numbers) that rounding may
    turn over.

    digits : spacing of numbers at 1. Each value of the memory errs by some of it in each step; in
    single precision every operation is carried out so, too, where the step allows it.
    """
    nominal = np.array([v.nominal for v in block.outputs])
    flags = np.all(expected == np.round(expected), axis=0)
    runs = [outputs_of(block, inputs, 4 * digits, single)]
    drawn = single_outputs(block, inputs) if single else None
    if drawn is not None:
        runs.append(drawn[0])
    told, errors = expected.copy(), np.zeros(len(expected))
    for run in runs:
        wanted = expected[: len(run)]
        off = np.abs(run - wanted)
        size = np.max((off / (nominal + np.abs(wanted)))[:, ~flags], axis=1, initial=0.0)
        errors[: len(run)] = np.maximum(errors[: len(run)], size)
        told[: len(run)][(off > 0) & flags] = np.nan
    if single:  # flags are sure as far as every operation was carried out, by all draws
        sure = 0 if drawn is None else drawn.shape[1]
        told[sure:, flags] = np.nan
        if drawn is not None:
            told[:sure][np.any(drawn != expected[:sure], axis=0) & flags] = np.nan
    return np.maximum.accumulate(errors), told


# ---- the folder ---------------------------------------------------------------------------------
def _place(folder: str | os.PathLike[str]) -> Path:
    """The folder to write. Raises WriteError where something else stands there."""
    require_local(folder)
    place = Path(os.path.realpath(folder))
    if place.is_dir():
        if any(place.iterdir()) and not (place / MARK).is_file():
            raise WriteError(
                f"{os.fspath(folder)} is there and is no export of C code; give a new folder"
            )
    elif place.exists():
        raise WriteError(f"{os.fspath(folder)} is a file; give the name of a folder")
    return place


def _write(place: Path, files: dict[str, str]) -> None:
    """All files, in a folder beside the place that then takes it."""
    make_folder(place.parent)
    try:
        fresh = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
    except OSError as error:
        raise WriteError(f"{place} was not written ({error.strerror})", error.errno) from None
    try:
        for name, text in files.items():
            (fresh / name).write_text(text, encoding="utf-8", newline="\n")
        fresh.chmod(0o755)
        if place.is_dir():
            old = Path(tempfile.mkdtemp(prefix=f".{place.name}-", dir=place.parent))
            place.rename(old / "old")
            try:
                fresh.rename(place)
            except OSError:
                (old / "old").rename(place)
                raise
            finally:
                shutil.rmtree(old, ignore_errors=True)
        else:
            fresh.rename(place)
    except OSError as error:
        raise WriteError(f"{place} was not written ({error.strerror})", error.errno) from None
    finally:
        shutil.rmtree(fresh, ignore_errors=True)

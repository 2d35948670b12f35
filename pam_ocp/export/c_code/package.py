"""export_c: a block as C source for a target."""

from __future__ import annotations

import json
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
from ...core.errors import ExportError, InputError, require_count, require_positive
from ...core.exceptions import WriteError
from ...core.stop import verb
from .counts import counted
from .files import CExport, Vectors
from .generated import LARGEST_SINGLE, PRECISIONS, Precision, step_code
from .vectors import inputs_of, outputs_of, sensitivity

Array: TypeAlias = NDArray[np.float64]

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
        return inputs_of(block, require_count("steps", steps), seed)
    given = np.asarray(inputs, dtype=float)
    if given.ndim != 2 or given.shape[1] != len(block.inputs) or not len(given):
        raise InputError(
            f"inputs has the shape {given.shape}; give (steps, {len(block.inputs)}): "
            f"{', '.join(v.name for v in block.inputs)}"
        )
    return given


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

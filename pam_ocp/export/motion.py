"""A planned motion as an FMU that plays it, and as a table that importers read."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, kind_of, with_kinds
from ..core.files import atomic_path, require_ending
from ..core.signals import PiecewisePolynomial
from ..core.stop import verb
from ..core.system import Scope
from ..core.trajectory import Trajectory
from ..core.variables import Variable
from ..plants.plant import Plant
from . import source
from .assembly import Content, write_fmu
from .description import table
from .layout import FmiVersion, PlantLayout, checked
from .runner import as_polynomials

Array: TypeAlias = NDArray[np.float64]

_JUMP = 1e-9
"""A signal jumps where its two sides differ by more than this part of its nominal."""
_WORK = {"PLANT_ARG": 6, "PLANT_RES": 3, "PLANT_IW": 1, "PLANT_W": 1}


@verb
def export_motion(
    motion: Trajectory,
    path: str | os.PathLike[str],
    *,
    names: Sequence[str] | None = None,
    name: str = "motion",
    fmi: FmiVersion = "2.0",
    platforms: Iterable[str] | str | None = None,
    step_size: float = 1e-3,
) -> Path:
    """Write a motion as an FMU without inputs whose outputs play it; returns its path.

    The outputs have the names of the columns: connect ``muscle1.command`` with ``muscle1.command``.
    Inputs of the motion are played as they ran, also between samples (held, in lines, or as the
    plan's polynomials); other columns are joined by straight lines. Before its start and behind its
    end the motion stands still. The state ``clock`` is the time in the motion: its start value says
    where to begin. In Model Exchange each jump is a time event. For Model Exchange and
    Co-Simulation.

    Parameters
    ----------
    motion : a Trajectory, such as a plan's.
    path : the file to write. An existing file is replaced when all is done.
    names : which columns to play; by default the inputs, or all when there is none.
    name : the name of the FMU.
    fmi, platforms, step_size : see :func:`export_fmu`.

    Raises InputError (nothing to play, a column named "clock", a bad value), UnknownNameError (a
    column or a platform), ExportError (no compiler).

    Examples
    --------
    >>> path = pam.export.export_motion(plan.trajectory, "motion.fmu", platforms=["native"])
    >>> path.name
    'motion.fmu'
    """
    chosen = _columns(motion, names)
    if len(motion) < 2:
        raise InputError("the motion has one sample only; give at least two to play")
    played = _signals(motion, chosen)
    plant = player(name, motion, chosen)
    settings = checked(fmi, step_size, 1e-6, None, motion.duration)
    equations = [("der(clock)", "1"), *((n, f"column {n} of the motion at clock") for n in chosen)]
    content = Content("fmu", lambda: _code(motion, chosen, played), lambda: equations)
    return write_fmu(PlantLayout(plant), path, settings, platforms, content)


@with_kinds
def save_input_table(
    motion: Trajectory, path: str | os.PathLike[str], *, names: Sequence[str] | None = None
) -> Path:
    """Write columns of a motion as CSV in the format of FMI's reference inputs (``*_in.csv``).

    Importers join the rows by straight lines; where a value jumps, its time stands twice, with the
    value before the jump and the one behind it. Curved signals are followed at the motion's
    samples.

    names : which columns; by default the inputs, or all when there is none. Units are SI.

    Examples
    --------
    >>> path = pam.export.save_input_table(plan.trajectory, "motion_in.csv")
    >>> path.read_text().splitlines()[0]
    '"time","muscle1.command","muscle2.command"'
    """
    require_ending(path, ".csv", "a table of inputs")
    chosen = _columns(motion, names)
    rows = _rows(_signals(motion, chosen), motion, chosen)
    with atomic_path(path) as temporary:
        temporary.write_text(table(chosen, rows), encoding="utf-8")
    return Path(path)


def _columns(motion: Trajectory, names: Sequence[str] | None) -> list[str]:
    if not isinstance(motion, Trajectory):
        raise InputError(f"motion is {kind_of(motion)}, not a Trajectory, such as plan.trajectory")
    if names is None:
        names = motion.named("input") or motion.names
    if isinstance(names, str) or not names:
        raise InputError(f"names = {names!r}: give a list of at least one column")
    return [motion.variable(n).name for n in names]


# ---- signals ------------------------------------------------------------------------------------


def _signals(motion: Trajectory, names: Sequence[str]) -> PiecewisePolynomial:
    """The columns as piecewise polynomials with common breaks."""
    exact, inputs = motion.signals, motion.named("input")
    breaks = motion.t if len(motion) > 1 else np.append(motion.t, motion.t + 1.0)
    held = [n for n in names if n in inputs] if motion.interpolation == "previous" else []
    if exact is None and np.ptp(motion.array(held)[-2:], axis=0).any():
        breaks = np.append(breaks, 2 * breaks[-1] - breaks[-2])  # the last sample is held, too
    sampled = [n for n in names if exact is None or n not in inputs]
    if exact is not None:
        inside = exact.breaks[(exact.breaks > breaks[0]) & (exact.breaks < breaks[-1])]
        breaks = np.union1d(breaks if sampled else breaks[[0, -1]], inside)
        breaks = breaks[np.diff(breaks, prepend=-np.inf) > 1e-12 * (1 + np.abs(breaks))]
    return PiecewisePolynomial(breaks, as_polynomials(motion, names, breaks, held)[1])


def _ends(played: PiecewisePolynomial) -> Array:
    """Values at the end of each piece."""
    powers = np.diff(played.breaks)[:, None] ** np.arange(played.degree + 1)
    return np.asarray(np.einsum("tj,tji->ti", powers, played.coefficients))


def _jumps(played: PiecewisePolynomial, nominals: Array) -> NDArray[np.bool_]:
    """For each break inside: whether any value jumps there."""
    gap = np.abs(played.coefficients[1:, 0] - _ends(played)[:-1]) / nominals
    return np.asarray(np.any(gap > _JUMP, axis=1))


def _nominals(motion: Trajectory, names: Sequence[str]) -> Array:
    return np.array([motion.variable(n).nominal for n in names])


def _rows(played: PiecewisePolynomial, motion: Trajectory, names: Sequence[str]) -> Array:
    """Times and values that straight lines join; two rows at a jump."""
    after = played.coefficients[:, 0]
    ends = _ends(played)
    jumps = _jumps(played, _nominals(motion, names))
    rows = [np.array([played.breaks[0], *after[0]])]
    for k in range(len(after)):
        low, high = played.breaks[k], played.breaks[k + 1]
        if played.degree > 1:
            between = motion.t[(motion.t > low + 1e-9) & (motion.t < high - 1e-9)]
            rows += [np.array([t, *v]) for t, v in zip(between, played(between), strict=True)]
        rows.append(np.array([high, *ends[k]]))
        if k < len(jumps) and jumps[k]:
            rows.append(np.array([high, *after[k + 1]]))
    return np.array(rows)


# ---- the FMU ------------------------------------------------------------------------------------


def player(name: str, motion: Trajectory, names: Sequence[str]) -> Plant:
    """The variables of the FMU. The expressions say only that outputs depend on the clock."""
    plant = Plant(name, "plays a motion")
    scope = Scope(plant)
    size = max(1.0, float(np.max(np.abs(motion.t))))
    clock = scope.of("s", size, start=float(motion.t[0])).state("clock", "time in the motion")
    plant.der(clock, 1.0)
    for column in names:
        known: Variable = motion.variable(column)
        shown = scope.of(known.unit, known.nominal, display_unit=known.display_unit)
        shown.output(column, ca.sin(clock), known.description)
    return plant


def _code(
    motion: Trajectory, names: Sequence[str], played: PiecewisePolynomial
) -> source.ModelCode:
    """The C code that plays, with its table."""
    jumps = bool(np.any(_jumps(played, _nominals(motion, names))))
    data = "\n".join(
        [
            "/* A motion: breaks [s] and coefficients [SI], piece by piece, power by power. */",
            f"#define MOTION_PIECES {len(played.breaks) - 1}",
            f"#define MOTION_TERMS {played.degree + 1}",
            f"#define MODEL_JUMPS {int(jumps)}",
            source.table("double", "MOTION_BREAKS", map(source.number, played.breaks)),
            source.table("double", "MOTION_TABLE", map(source.number, played.coefficients.ravel())),
            "",
        ]
    )
    files = {"plant.c": source.c_text("motion.c"), "motion_data.h": data}
    return source.ModelCode(files, _WORK)

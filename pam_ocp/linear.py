"""Linearisation: from a plant to python-control, by exact Jacobians."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .equilibrium import OperatingPoint, equilibrium
from .errors import InputError
from .plant.plant import Plant, Values

if TYPE_CHECKING:
    import control

__all__ = ["OperatingPoint", "equilibrium", "linearize", "modes"]

Array: TypeAlias = NDArray[np.float64]


def _point(plant: Plant, at: OperatingPoint | Values | None) -> tuple[Plant, Array, Array]:
    if isinstance(at, OperatingPoint):
        if {v.name for v in at.plant.states} != {v.name for v in plant.states}:
            raise InputError(
                f"the operating point belongs to {at.plant.name!r}, not {plant.name!r}"
            )
        return at.plant, at.x, at.u
    given = {plant.variable(n).name: v for n, v in (at or {}).items()}
    moved = plant.with_values(given)
    return moved, moved.vector("state"), moved.vector("input")


def linearize(
    plant: Plant,
    at: OperatingPoint | Values | None = None,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
) -> control.StateSpace:
    """The plant near a point as python-control's StateSpace: x' = A x + B u, y = C x + D u.

    at : an OperatingPoint (of :func:`equilibrium`) or values by name; by default the start values.
    inputs, outputs : names to keep; by default all inputs, and all states and outputs.

    Jacobians are exact (CasADi); signals keep the plant's names with ``_`` for ``.``, since
    python-control reads a dot as system.signal. Units are SI.
    """
    import control

    plant, x, u = _point(plant, at)
    chosen_in = _chosen("inputs", plant, inputs, ("input",))
    chosen_out = _chosen("outputs", plant, outputs, ("state", "output"))
    a, b, c, d = (np.asarray(m) for m in plant.jacobians(x, u, plant.vector("parameter")))
    c = np.vstack([np.eye(len(x)), c])
    d = np.vstack([np.zeros((len(x), len(u))), d])
    all_in = [v.name for v in plant.inputs]
    all_out = [v.name for v in (*plant.states, *plant.outputs)]
    columns, rows = [all_in.index(n) for n in chosen_in], [all_out.index(n) for n in chosen_out]

    def plain(names: Sequence[str]) -> list[str]:
        return [n.replace(".", "_") for n in names]

    return control.ss(
        a, b[:, columns], c[rows], d[np.ix_(rows, columns)], name=plant.name,
        states=plain([v.name for v in plant.states]), inputs=plain(chosen_in), outputs=plain(chosen_out),
    )  # fmt: skip


def _chosen(
    argument: str, plant: Plant, names: Sequence[str] | None, allowed: tuple[str, ...]
) -> list[str]:
    known = [v for a in allowed for v in plant.variables if v.causality == a]
    if names is None:
        return [v.name for v in known]
    names = [names] if isinstance(names, str) else names
    chosen = [plant.variable(n) for n in names]
    for variable in chosen:
        if variable.causality not in allowed:
            raise InputError(
                f"{argument}: {variable.name} is a {variable.causality}; choose among "
                f"{', '.join(v.name for v in known)}"
            )
    return [v.name for v in chosen]


def modes(system: control.StateSpace) -> list[tuple[float, float]]:
    """(natural frequency [Hz], damping ratio) of each oscillating pair of poles, slowest first."""
    poles = np.asarray(system.poles())
    pairs = poles[poles.imag > 1e-9 * np.abs(poles)]
    found = [(abs(s) / (2 * np.pi), -s.real / abs(s)) for s in pairs]
    return sorted((float(f), float(z)) for f, z in found)

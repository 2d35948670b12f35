"""Arcs of a plan: the parts of its motion along which the same limits are active.

Between two switches a motion is smooth, and one polynomial of a high degree follows it; across a
switch none does. :class:`Arcs` plans so that intervals end on the switches; ``plan.arcs``
(arcs_named.py) names those of any plan.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..core.errors import require_count
from ..core.shown import shown
from ..numerics.collocation import HIGHEST_DEGREE
from .transcription.mesh import Form, Interval, Mesh

__all__ = ["BY_ARCS", "FORM", "INTERIOR", "Arc", "Arcs", "guarded"]

INTERIOR = "interior"
"""What an arc is called along which no limit of its input is active."""
FORM = Form("radau", "polynomial", guarded=False)
"""Of meshes by arcs: with ends on the switches, polynomials do not swing."""


@dataclass(frozen=True)
class _ByArcs(Form):
    """The same, where refinement by arcs is asked for."""


BY_ARCS = _ByArcs("radau", "polynomial", guarded=False)


@dataclass(frozen=True)
class Arcs:
    """Collocation whose intervals end where the inputs switch.

    A coarse motion is planned first (``intervals`` per leg, Radau's points of ``degree``, inputs
    polynomial); from its multipliers the arcs are read off, and one interval is laid on each, whose
    length is an unknown: a bang-bang motion ends with one interval per arc, and to errors of 1e-8
    of nominal. Degrees are raised, then intervals split, until the replay meets the plan's
    tolerance. Where that leads to nothing the mesh is refined as usual. ``plan.arcs`` names the
    arcs. Not for plants with kinks (dry friction, hysteresis).

    Examples
    --------
    >>> pam.Arcs(intervals=8, degree=5)
    Arcs(intervals=8, degree=5)
    """

    intervals: int = 12
    degree: int = 4

    def __post_init__(self) -> None:
        require_count("intervals", self.intervals)
        require_count("degree", self.degree, 2, HIGHEST_DEGREE)

    def mesh(self, legs: int) -> Mesh:
        """Equal intervals on each leg, to begin with."""
        one = (
            Interval(leg, 1.0 / self.intervals, self.degree)
            for leg in range(legs)
            for _ in range(self.intervals)
        )
        return Mesh(tuple(one), BY_ARCS)


def guarded(mesh: Mesh) -> Mesh:
    """The mesh with bounds of polynomial inputs held between their points too."""
    form = mesh.form
    return Mesh(mesh.intervals, Form(form.scheme, form.control, guarded=True))


@shown
@dataclass(frozen=True)
class Arc:
    """A part of a motion along which one input does one thing.

    Examples
    --------
    >>> [arc.active for arc in plan.arcs if arc.input == "muscle1.command"][:1] != []
    True
    """

    input: str
    start: float
    """[s]"""
    end: float
    """[s]"""
    active: str
    """The limit that leads the input: "muscle1.command max", say; else "interior"."""

    @property
    def duration(self) -> float:
        """[s]"""
        return self.end - self.start

    def __str__(self) -> str:
        return f"{self.start:.6g} ... {self.end:.6g} s: {self.input}: {self.active}"

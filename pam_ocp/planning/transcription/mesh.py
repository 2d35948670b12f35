"""The mesh of a plan: intervals with their degrees, and how states and inputs run inside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby
from typing import Literal, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ...core.errors import InputError, require_count
from ...core.shown import shown
from ...numerics.collocation import HIGHEST_DEGREE, collocation_points, lagrange

Array: TypeAlias = NDArray[np.float64]
Control: TypeAlias = Literal["constant", "linear", "polynomial"]
Scheme: TypeAlias = Literal["radau", "gauss", "shooting"]

SPLIT_DEGREE = 5
"""Degree of the parts of an interval that was split."""
HELD_SPLIT_DEGREE = 7
"""The same where inputs are constant or linear inside: states are smooth there."""
UNRESOLVED = 0.03
"""Error of an interval in units of nominal from which it does not resolve its motion: it is split
at once.
"""
MOST_STEPS = 64
"""RK4 steps in an interval of multiple shooting, before it is split."""
GUARDS = 3
"""Checks of a polynomial input's bounds between each two of its points."""
WATCHES = {"polynomial": 15}
"""Checks between each two points of what was seen beyond its limit there. A polynomial input may
then be so by 0.5 % of its range, instead of 8 % (Ehlich and Zeller, Math. Z. 86, 1964: 1 / cos(pi /
2 m) with m checks per degree); a margin does the rest.
"""
FEW_WATCHES = 5
"""The same where inputs are constant or linear: states are smooth."""
MARGIN = 1.2
"""By how much of what is still seen beyond a limit it is then held back."""
MOST_MARGIN = 0.05
"""The sum of a limit's margins, in units of nominal, before the interval is split instead."""
HELD_DEGREE = 3
"""Degree of the states where inputs are held constant in place of polynomials."""
CONTROLS = ("constant", "linear", "polynomial")


def _weights(values: Sequence[float]) -> ca.DM:
    """A sparse column: at a node all weights but one are zero."""
    return ca.sparsify(ca.DM(values))


def _between(taus: Array, count: int) -> Array:
    """tau = 0, and ``count`` places between each two of (0, taus, 1)."""
    nodes = np.concatenate([[0.0], taus, [1.0]])
    shares = np.arange(1, count + 1) / (count + 1)
    inside = nodes[:-1, None] + np.diff(nodes)[:, None] * shares
    return np.append(0.0, inside[np.diff(nodes) > 1e-9].ravel())


@dataclass(frozen=True)
class Form:
    """How states and inputs run inside an interval, over tau in 0 .. 1."""

    scheme: Scheme
    control: Control
    guarded: bool = False
    """Whether bounds of polynomial inputs hold between their points too."""

    def collocated(self, degree: int) -> Array:
        """Where the equation of motion is met; none for shooting."""
        if self.scheme == "shooting":
            return np.zeros(0)
        return collocation_points(self.scheme, degree)

    def state_taus(self, degree: int) -> Array:
        """Where states are unknowns; the last is the interval's end, tau = 1."""
        return _points(self, degree)

    def profile_taus(self, degree: int) -> Array:
        """Where functions of time are evaluated; the first is tau = 0."""
        if self.scheme == "shooting":
            return np.linspace(0.0, 1.0, 2 * degree + 1)
        return np.insert(self.state_taus(degree), 0, 0.0)

    def cost_points(self, degree: int) -> int:
        """At how many points running costs are evaluated."""
        return 4 * degree if self.scheme == "shooting" else degree

    def input_taus(self, degree: int) -> Array:
        """Where the values of an input stand."""
        if self.control == "polynomial":
            return self.collocated(degree)
        return np.array([0.0]) if self.control == "constant" else np.array([0.0, 1.0])

    def guard_taus(self, degree: int) -> Array:
        """Where polynomial inputs are always checked between their points, the start of the
        interval among them.
        """
        if not self.guarded or self.control != "polynomial":
            return np.zeros(0)
        return _between(self.input_taus(degree), GUARDS)

    def watch_taus(self, degree: int) -> Array:
        """Where is checked what was seen beyond its limit between the points."""
        return _between(self.state_taus(degree), WATCHES.get(self.control, FEW_WATCHES))

    def weights(self, degree: int, tau: float) -> ca.DM:
        """Weights of these values that give the input at ``tau`` (Lagrange)."""
        return _weights(lagrange(self.input_taus(degree).tolist(), float(tau)))

    def state_weights(self, degree: int, tau: float) -> ca.DM:
        """Weights of the start and the states at their points that give the state at ``tau``."""
        through = lagrange((0.0, *self.collocated(degree).tolist()), float(tau))
        ends = 1 + len(self.state_taus(degree)) - len(through)  # Gauss: the end is no node
        return _weights((*through, *(0.0,) * ends))

    def input_powers(self, degree: int) -> Array:
        """(columns, columns) matrix from the values to coefficients of powers of tau."""
        return _powers(self, degree)


@cache
def _powers(form: Form, degree: int) -> Array:
    """See :meth:`Form.input_powers`; not to be written to."""
    found: Array = np.asarray(np.linalg.inv(np.vander(form.input_taus(degree), increasing=True)))
    found.setflags(write=False)
    return found


@cache
def _points(form: Form, degree: int) -> Array:
    """See :meth:`Form.state_taus`; not to be written to."""
    if form.scheme == "radau":
        found = np.array(form.collocated(degree))
    else:
        found = np.append(form.collocated(degree), 1.0)
    found.setflags(write=False)
    return found


@dataclass(frozen=True)
class Interval:
    """A part of a leg, ``fraction`` of its duration long; ``degree`` of its polynomials.

    For shooting, ``degree`` is the number of RK4 steps. raised : whether refinement has tried a
    higher degree here already. watched : (bound or path condition, margin in nominals) of what was
    seen beyond its limit between the points; see :meth:`Form.watch_taus`. joined : whether held
    inputs go on from the interval before with the same values: there it is finer for states only.
    """

    leg: int
    fraction: float
    degree: int
    raised: bool = False
    watched: tuple[tuple[str, float], ...] = ()
    joined: bool = False

    def split(self, parts: int, degree: int, joined: bool = False) -> list[Interval]:
        """Equal parts of this degree; ``joined``: with one value of held inputs for all."""
        part = replace(self, fraction=self.fraction / parts, degree=degree, raised=False)
        return [part, *[replace(part, joined=joined)] * (parts - 1)]


@dataclass(frozen=True)
class Mesh:
    """All intervals of a motion in order, and the form of states and inputs in them."""

    intervals: tuple[Interval, ...]
    form: Form

    def first(self, node: int) -> int:
        """The first interval behind a node; the number of intervals at the last one."""
        return sum(i.leg < node for i in self.intervals)

    def held(self) -> list[int]:
        """The first interval of each value that held inputs have."""
        return [k for k, interval in enumerate(self.intervals) if not interval.joined]

    def clock(self, nominals: Array) -> tuple[Array, Array]:
        """Weights of the legs' durations in units of ``nominals`` [s]: in the length of each
        interval, (n, legs), and in its start and the end of the motion, (n + 1, legs).
        """
        lengths = np.zeros((len(self.intervals), len(nominals)))
        for k, interval in enumerate(self.intervals):
            lengths[k, interval.leg] = interval.fraction * nominals[interval.leg]
        starts = np.vstack([np.zeros(len(nominals)), np.cumsum(lengths, axis=0)])
        return lengths, starts


def _equal(intervals: int, degree: int, legs: int, form: Form) -> Mesh:
    one = tuple(
        Interval(leg, 1.0 / intervals, degree) for leg in range(legs) for _ in range(intervals)
    )
    return Mesh(one, form)


@dataclass(frozen=True)
class Collocation:
    """Direct collocation: ``intervals`` per leg, polynomials of ``degree`` (1 to 9).

    control : inputs "constant" on each interval (as a digital controller holds them), "linear" and
        continuous, or "polynomial" with a value at each collocation point (few intervals of high
        degree then go a long way: 6 of degree 9, say). None: constant, but linear where the least
        work is asked of muscles whose pressure is an input: each jump of it costs work.
    points : "radau" (stiffly accurate; the end of an interval is a point) or "gauss" (Legendre;
        order 2 degree instead of 2 degree - 1; Biegler, Nonlinear Programming, 2010, sect. 10.2).
    guarded : bounds of polynomial inputs, and path constraints that depend on them, are asked for
        between the points too; without, they may be far outside there (a switch makes them swing),
        which the plan's replay reports.

    Examples
    --------
    >>> method = pam.Collocation(intervals=10, degree=4)
    >>> pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], method=method).verified
    True
    """

    intervals: int = 50
    degree: int = 3
    control: Control | None = None
    points: Literal["radau", "gauss"] = "radau"
    guarded: bool = True

    def __post_init__(self) -> None:
        require_count("intervals", self.intervals)
        require_count("degree", self.degree, 1, HIGHEST_DEGREE)
        if self.control is not None and self.control not in CONTROLS:
            raise InputError(f"control = {self.control!r}: choose one of {', '.join(CONTROLS)}")
        if self.points not in ("radau", "gauss"):
            raise InputError(f"points = {self.points!r}: choose 'radau' or 'gauss'")

    def mesh(self, legs: int) -> Mesh:
        """Equal intervals on each leg."""
        form = Form(self.points, self.control or "constant", self.guarded)
        return _equal(self.intervals, self.degree, legs, form)


@dataclass(frozen=True)
class Shooting:
    """Direct multiple shooting: ``intervals`` per leg, ``steps`` of RK4 in each.

    Fewer unknowns than collocation; for plants that are not stiff (RK4 is explicit), and where
    bounds need hold at the intervals' ends only.
    control : "constant" or "linear" inputs on each interval.

    Examples
    --------
    >>> method = pam.planning.Shooting(intervals=20)
    >>> pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], method=method).verified
    True
    """

    intervals: int = 50
    steps: int = 4
    control: Literal["constant", "linear"] = "constant"

    def __post_init__(self) -> None:
        require_count("intervals", self.intervals)
        require_count("steps", self.steps, 1, MOST_STEPS)
        if self.control not in ("constant", "linear"):
            raise InputError(f"control = {self.control!r}: choose 'constant' or 'linear'")

    def mesh(self, legs: int) -> Mesh:
        """Equal intervals on each leg."""
        return _equal(self.intervals, self.steps, legs, Form("shooting", self.control))


Method: TypeAlias = Collocation | Shooting


def watched(mesh: Mesh, beyond: Sequence[Mapping[str, float]], tolerance: float) -> Mesh:
    """The mesh with checks between the points where a limit is exceeded there by the tolerance.

    beyond : for each interval {bound or path condition: by how much}, in units of nominal. First
    the limit is checked there; then, with a margin; where that does not do, or inside an interval
    of shooting nothing is known, the interval is split.
    """
    intervals: list[Interval] = []
    for interval, excess in zip(mesh.intervals, beyond, strict=True):
        seen = {label: value for label, value in excess.items() if value > tolerance}
        known = dict(interval.watched)
        margins = {n: known[n] + MARGIN * value if n in known else 0.0 for n, value in seen.items()}
        finite = all(margin <= MOST_MARGIN for margin in margins.values())
        if not seen:
            intervals.append(interval)
        elif mesh.form.scheme == "shooting":
            intervals += interval.split(2, interval.degree)
        elif finite:
            intervals.append(replace(interval, watched=tuple({**known, **margins}.items())))
        else:
            intervals += replace(interval, watched=()).split(2, min(interval.degree, SPLIT_DEGREE))
    return Mesh(tuple(intervals), mesh.form)


def doubled(mesh: Mesh, least: int = 1, joined: bool = False) -> Mesh:
    """The mesh with all intervals split in two, of a degree of at least ``least``; ``joined``: with
    one value of held inputs for both parts.
    """
    parts = (
        part
        for i in mesh.intervals
        for part in replace(i, watched=()).split(2, max(i.degree, least), joined)
    )
    return Mesh(tuple(parts), mesh.form)


def coarsened(mesh: Mesh) -> Mesh:
    """The mesh with each two neighbours on a leg made one."""
    found: list[Interval] = []
    for leg in range(1 + mesh.intervals[-1].leg):
        own = [i for i in mesh.intervals if i.leg == leg]
        for k in range(0, len(own), 2):
            fraction = sum(i.fraction for i in own[k : k + 2])
            found.append(replace(own[k], fraction=fraction, watched=()))
    return Mesh(tuple(found), mesh.form)


def halved(mesh: Mesh, joined: bool = False) -> Mesh:
    """The same, of a high degree where inputs are simple."""
    smooth = mesh.form.control != "polynomial" and mesh.form.scheme != "shooting"
    return doubled(mesh, HELD_SPLIT_DEGREE if smooth else 1, joined)


def merged(mesh: Mesh, count: int) -> Mesh:
    """A coarser mesh: ``count`` neighbours in one, as many as there are at the end of a leg."""
    intervals: list[Interval] = []
    for _, group in groupby(mesh.intervals, key=lambda interval: interval.leg):
        own = list(group)
        for i in range(0, len(own), count):
            part = own[i : i + count]
            degrees = [interval.degree for interval in part]
            degree = sum(degrees) if mesh.form.scheme == "shooting" else max(degrees)
            fraction = sum(interval.fraction for interval in part)
            intervals.append(Interval(part[0].leg, fraction, degree))
    return Mesh(tuple(intervals), mesh.form)


def held(mesh: Mesh) -> Mesh:
    """A mesh with constant inputs in place of polynomial ones: an interval for each of their
    values.
    """
    intervals: list[Interval] = []
    for interval in mesh.intervals:
        parts = replace(interval, watched=()).split(interval.degree, HELD_DEGREE)
        intervals += parts
    return Mesh(tuple(intervals), replace(mesh.form, control="constant"))


def refined(mesh: Mesh, errors: Sequence[float], tolerance: float, kinks: bool = False) -> Mesh:
    """The mesh with more points where the error of an interval exceeds the tolerance.

    The degree is raised first (by 1 for each two decades, at least 1; the steps of RK4 by its
    fourth order), then the interval is split, into as many parts as there are decades to go (2 to
    4). A polynomial input that switches inside an interval, or a kink of the plant, is not helped
    by degrees: where one rise was not enough, such an interval is split.
    """
    shooting, joined = mesh.form.scheme == "shooting", mesh.form.control == "constant"
    intervals: list[Interval] = []
    for interval, error in zip(mesh.intervals, errors, strict=True):
        if not error > tolerance:
            intervals.append(interval)
            continue
        decades = float(np.log10(error / tolerance)) if np.isfinite(error) else 4.0
        if shooting:
            degree = int(np.ceil(interval.degree * 1.1 * 10 ** (decades / 4)))
        else:
            degree = interval.degree + max(1, int(np.ceil(decades / 2)))
        rough = interval.raised and (kinks or mesh.form.control == "polynomial")
        rough = rough or (joined and not shooting and error > UNRESOLVED)
        if degree <= (MOST_STEPS if shooting else HIGHEST_DEGREE) and not rough:
            intervals.append(replace(interval, degree=degree, raised=True))
        else:
            parts = min(max(2, int(np.ceil(decades))), 4)
            low = SPLIT_DEGREE if mesh.form.control == "polynomial" else HELD_SPLIT_DEGREE
            parted = interval.split(parts, interval.degree if shooting else low, joined)
            intervals += [replace(part, raised=interval.raised) for part in parted]
    return Mesh(tuple(intervals), mesh.form)


def doubled_at_most(
    mesh: Mesh, errors: Sequence[float], tolerance: float, kinks: bool = False, points: int = 0
) -> Mesh:
    """The same for a tolerance that leaves the mesh at most twice as many points, or ``points``:
    finer where errors are the largest. What is far finer at once has other optima, or too many
    unknowns.
    """
    most = max(points, 2 * sum(i.degree for i in mesh.intervals))
    finer = refined(mesh, errors, tolerance, kinks)
    while sum(i.degree for i in finer.intervals) > most:
        tolerance *= 4.0
        finer = refined(mesh, errors, tolerance, kinks)
    return finer


# ---- arcs: the parts of a motion along which the same limits are active --------------------------
# Between two switches a motion is smooth, and one polynomial of a high degree follows it; across a
# switch none does. Arcs plans so that intervals end on the switches.
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
        return _equal(self.intervals, self.degree, legs, BY_ARCS)


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

"""How good a loop is, and how well a plant can be moved and seen: margins, clouds, stroke, maps."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.cases import results_of
from ..core.errors import InputError, kind_of, require_count, require_ends, require_numbers
from ..core.executors import Place
from ..core.shown import shown
from ..core.stop import verb
from ..operating.linear import gramian, linearize, modes
from ..operating.resting_point import EquilibriumError, OperatingPoint
from ..operating.several import equilibrium_path
from ..plants.plant import Plant, Values
from .kinds import Array
from .state_feedback import StateFeedback

if TYPE_CHECKING:
    import control


def frequency_response(system: control.StateSpace, hertz: ArrayLike) -> NDArray[np.complex128]:
    """C (s I - A)^-1 B + D at frequencies [Hz]: (n, outputs, inputs); at z of a sampled system.

    As ``system(2j pi f)``, which solves one frequency after the other in Python: clouds and margins
    ask for some 100 000 of them, so all are solved at once here.
    """
    a, b, c, d = (np.asarray(getattr(system, n)) for n in ("A", "B", "C", "D"))
    s = 2j * np.pi * np.asarray(hertz, float)[:, None, None]
    s = np.exp(s * system.dt) if system.dt else s
    return np.asarray(c @ np.linalg.solve(s * np.eye(len(a)) - a, b.astype(complex)[None]) + d)


# ---- margins ------------------------------------------------------------------------------------
@shown
@dataclass(frozen=True)
class Margins:
    """Of a loop broken at each of its inputs in turn, the others closed; and of all at once.

    gain : factor by which the gain may rise (inf: any); of a loop that is unstable when closed, one
    below 1, to which it must fall (nan: none is enough). phase : [deg]. crossover : [Hz].
    modulus : smallest distance of the Nyquist curve from -1, 1/modulus is the largest sensitivity.
    all_inputs : smallest singular value of I + L over frequency: as modulus, all inputs at once.
    """

    inputs: tuple[str, ...]
    gain: tuple[float, ...]
    phase: tuple[float, ...]
    crossover: tuple[float, ...]
    modulus: tuple[float, ...]
    all_inputs: float

    def __str__(self) -> str:
        lines = [f"{'input':<22}{'gain':>8}{'phase':>10}{'crossover':>12}{'modulus':>9}"]
        lines += [
            f"{n:<22}{g:>8.3g}{p:>6.1f} deg{c:>9.3g} Hz{m:>9.3f}"
            for n, g, p, c, m in zip(
                self.inputs, self.gain, self.phase, self.crossover, self.modulus, strict=True
            )
        ]
        return "\n".join([*lines, f"smallest singular value of I + L: {self.all_inputs:.3f}"])


@verb
def margins(loop: control.StateSpace, hertz: tuple[float, float] = (1e-2, 1e3)) -> Margins:
    """Margins of a square loop gain L under negative feedback, as ``StateFeedback.loop``.

    By ``control.stability_margins`` for each input; modulus over 2000 frequencies in ``hertz``, of
    a sampled loop (delays are exact there) up to half its sampling rate.

    Examples
    --------
    >>> found = pam.control.margins(pam.lqr(plant, point).loop)
    >>> bool(found.modulus[0] > 0.99)  # the circle of LQR
    True
    """
    import control

    if not isinstance(loop, control.StateSpace):
        raise InputError(
            f"margins: loop is {kind_of(loop)}, not a control.StateSpace, such as "
            "StateFeedback.loop"
        )
    if loop.ninputs != loop.noutputs:
        raise InputError(f"margins: the loop has {loop.ninputs} inputs and {loop.noutputs} outputs")
    if loop.dt is True:
        raise InputError("margins: the loop's sample time is not known; give it as dt [s]")
    low, high = _rising(hertz)
    frequency = np.geomspace(low, min(high, 0.5 / loop.dt) if loop.dt else high, 2000)
    stable, found = _stable(loop), []
    for i in range(loop.ninputs):
        others = [j for j in range(loop.ninputs) if j != i]
        single = control.ss(*_closed(loop, others, [i]), loop.dt)
        gains, phases, _, _, crossings, _ = control.stability_margins(single, returnall=True)
        nearest = int(np.argmin(np.abs(phases))) if len(phases) else None
        response = frequency_response(single, frequency)
        more, less = (g for g in gains if g > 1), (g for g in gains if g < 1)
        found.append(
            (
                min(more, default=np.inf) if stable else max(less, default=np.nan),
                np.inf if nearest is None else phases[nearest],
                np.nan if nearest is None else crossings[nearest] / (2 * np.pi),
                np.abs(1 + response).min(),
            )
        )
    response = frequency_response(loop, frequency)
    least = np.linalg.svd(np.eye(loop.ninputs) + response, compute_uv=False)[:, -1].min()
    gain, phase, crossover, modulus = (
        tuple(float(v) for v in column) for column in zip(*found, strict=True)
    )
    return Margins(tuple(loop.input_labels), gain, phase, crossover, modulus, float(least))


def _closed(loop: control.StateSpace, shut: list[int], left: list[int]) -> tuple[Array, ...]:
    """A, B, C, D from the inputs ``left`` to their outputs, those in ``shut`` fed back."""
    a, b, c, d = (np.asarray(getattr(loop, n)) for n in "ABCD")
    rows = np.hstack([c, d[:, left]])
    back = np.linalg.solve(np.eye(len(shut)) + d[np.ix_(shut, shut)], rows[shut])
    whole = np.block([[a, b[:, left]], [rows[left]]])
    whole = whole - np.vstack([b[:, shut], d[np.ix_(left, shut)]]) @ back
    n = len(a)
    return whole[:n, :n], whole[:n, n:], whole[n:, :n], whole[n:, n:]


def _stable(loop: control.StateSpace) -> bool:
    """Whether nothing grows when it is closed; a pole on the border is one of states that no input
    reaches.
    """
    poles = np.linalg.eigvals(_closed(loop, list(range(loop.ninputs)), [])[0])
    grown = np.log(np.abs(poles) + 1e-300) if loop.dt else np.real(poles)
    return bool(np.all(grown <= 1e-9 * max(1.0, np.abs(poles).max(initial=0.0))))


def _rising(hertz: Any) -> tuple[float, float]:
    """(lowest, highest) frequency [Hz]."""
    low, high = require_ends("hertz", hertz, "Hz")
    if not 0 < low < high:
        raise InputError(f"hertz = ({low:g}, {high:g}): give (lowest, highest) [Hz], both > 0")
    return low, high


def _some(verb: str, cases: Iterable[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    if not (listed := list(cases)):
        raise InputError(f"{verb}: cases is empty; give some, as sweep(mass=[8.0, 12.0])")
    return listed


@verb
def margins_over(
    feedback: StateFeedback, cases: Iterable[Mapping[str, Any]], conditions: Values
) -> list[tuple[Margins, NDArray[np.complex128]]]:
    """Margins and closed-loop poles of one feedback on plants with other parameters.

    cases : as :func:`pam_ocp.simulation.draws` and :func:`pam_ocp.simulation.sweep` give them
    ({"parameters": {...}}).
    conditions : of rest for each of them; with integral action the integrated outputs keep theirs.

    Examples
    --------
    >>> feedback = pam.lqr(plant, point)
    >>> cases = pam.simulation.sweep(mass=[8.0, 12.0])
    >>> found = pam.control.margins_over(feedback, cases, {"x": 0.04})
    >>> all(poles.real.max() < 0 for _, poles in found)
    True
    """
    results = []
    for case in _some("margins_over", cases):
        moved = feedback.point.plant.with_values(case.get("parameters", {}))
        point = moved.equilibrium(conditions, guess=feedback.point)
        system = linearize(moved, point, inputs=feedback.inputs)
        other = replace(feedback, system=system, point=point)
        results.append((margins(other.loop), other.poles))
    return results


# ---- clouds -------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class BodeCloud:
    """Frequency responses of many plants of one kind.

    frequency : (n,) [Hz]. nominal : (n,) complex, responses : (cases, n) complex, SI.
    points : the equilibria of the cases.
    """

    source: str
    output: str
    frequency: Array
    nominal: NDArray[np.complex128]
    responses: NDArray[np.complex128] = field(repr=False)
    points: tuple[OperatingPoint, ...] = field(repr=False)

    def band(self, level: float = 0.95) -> tuple[Array, Array]:
        """Magnitudes between which this share of the responses lies at each frequency."""
        if not 0 < level < 1:
            raise InputError(f"level = {level:g} must lie in 0 .. 1")
        size = np.abs(self.responses)
        low, high = np.quantile(size, [(1 - level) / 2, (1 + level) / 2], axis=0)
        return np.asarray(low), np.asarray(high)


@verb
def bode_cloud(
    plant: Plant,
    conditions: Values,
    cases: Sequence[Mapping[str, Any]],
    *,
    source: str,
    output: str,
    hertz: tuple[float, float] = (0.1, 100.0),
    count: int = 200,
) -> BodeCloud:
    """Responses from an input to a state or output, each case at its own equilibrium.

    cases : [{"parameters": {...}}], from :func:`pam_ocp.simulation.draws` over a fit's covariance,
    say.
    conditions : of rest, the same for all. Raises EquilibriumError when a case has none.

    Examples
    --------
    >>> cases = pam.simulation.sweep(mass=[8.0, 12.0])
    >>> names = {"source": "muscle.command", "output": "x"}
    >>> pam.control.bode_cloud(plant, {"x": 0.04}, cases, **names).frequency.shape
    (200,)
    """
    cases = _some("bode_cloud", cases)
    frequency = np.geomspace(*_rising(hertz), require_count("count", count, 2))
    middle = plant.equilibrium(conditions)

    def response(point: OperatingPoint) -> NDArray[np.complex128]:
        system = linearize(point.plant, point, inputs=[source], outputs=[output])
        return frequency_response(system, frequency)[:, 0, 0]

    points = tuple(
        plant.with_values(case.get("parameters", {})).equilibrium(conditions, guess=middle)
        for case in cases
    )
    return BodeCloud(
        plant.variable(source).name,
        plant.variable(output).name,
        frequency,
        response(middle),
        np.array([response(p) for p in points]),
        points,
    )


# ---- along the stroke ---------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class Stroke:
    """Measures at equilibria along one variable, scaled by nominals.

    reach : (n,) how far the position can be moved within the horizon by inputs of unit energy
        (integral of (u/nominal)^2 = 1 s). weakest : the same in the direction of the states that is
        hardest to move (0: not controllable). visible : response of the outputs over the horizon to
        the state that is hardest to see (0: not observable).
    frequency [Hz], damping : of the slowest oscillation (NaN where there is none).
    """

    name: str
    values: Array
    points: tuple[OperatingPoint, ...] = field(repr=False)
    reach: Array
    weakest: Array
    visible: Array
    frequency: Array
    damping: Array
    outputs: tuple[str, ...]
    horizon: float


@verb
def along_stroke(
    plant: Plant,
    name: str,
    values: Iterable[float],
    conditions: Values | None = None,
    *,
    outputs: Sequence[str] | None = None,
    horizon: float = 0.2,
) -> Stroke:
    """Controllability and observability along a path of equilibria, by finite-time gramians.

    name, values, conditions : see :func:`equilibrium_path`. outputs : what is measured; by default
    the positions. horizon : [s], to be about as long as a motion.

    Examples
    --------
    >>> stroke = pam.control.along_stroke(plant, "x", [0.02, 0.03, 0.04])
    >>> stroke.frequency.round(1)  # natural frequency at each place [Hz]
    array([4.3, 4.2, 4.5])
    """
    path = equilibrium_path(plant, name, values, conditions)
    seen = (
        list(plant.load_positions) if outputs is None else [plant.variable(n).name for n in outputs]
    )
    if not seen:
        raise InputError(f"along_stroke: {plant.name!r} has no position; name the outputs")
    controls = [v.name for v in plant.inputs if not v.disturbance]
    states = [v for v in plant.states if v.memory != "held"]  # which stick to the others
    nominal = np.array([v.nominal for v in states])
    effort = np.array([plant.variable(n).nominal for n in controls])
    scale = np.array([plant.variable(n).nominal for n in seen])
    place = [v.name for v in states].index(next(iter(plant.load_positions), plant.states[0].name))
    rows = []
    for point in path.points:
        system = linearize(point.plant, point, inputs=controls, outputs=seen, stuck=True)
        a = np.asarray(system.A) * nominal / nominal[:, None]
        b = np.asarray(system.B) * effort / nominal[:, None]
        c = np.asarray(system.C) * nominal / scale[:, None]
        reached, shown = gramian(a, b, horizon), gramian(a.T, c.T, horizon)
        least = [max(float(np.linalg.eigvalsh(w)[0]), 0.0) ** 0.5 for w in (reached, shown)]
        swing = modes(system)
        rows.append((reached[place, place] ** 0.5, *least, *(swing[0] if swing else (np.nan,) * 2)))
    reach, weakest, visible, frequency, damping = np.array(rows, dtype=float).T
    return Stroke(
        path.name,
        path.values,
        path.points,
        reach,
        weakest,
        visible,
        frequency,
        damping,
        tuple(seen),
        horizon,
    )


# ---- maps ---------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class ModeMap:
    """Natural frequency [Hz] and damping ratio of the slowest oscillation over two variables.

    axes : {name: values} of the two; frequency, damping, stable : (n_1, n_2), NaN (False) where
    there is no equilibrium within the bounds (and ``within``), or no oscillation.
    """

    plant: Plant
    axes: dict[str, Array]
    frequency: Array = field(repr=False)
    damping: Array = field(repr=False)
    stable: NDArray[np.bool_] = field(repr=False)


@verb
def mode_map(
    plant: Plant,
    axes: Mapping[str, ArrayLike],
    conditions: Values | None = None,
    *,
    free: Sequence[str] = (),
    within: Mapping[str, tuple[float, float]] | None = None,
    executor: Place = None,
) -> ModeMap:
    """Modes at the equilibria over two conditions.

    ``mode_map(hanging, {"muscle.command": p, "x": x}, free=["gravity"])`` keeps the mass and lets a
    constant force hold it at every (p, x). conditions, free : see :func:`equilibrium`.
    within : {state, input or output: (low, high)} outside which nothing is shown, such as
        ``{"muscle.force": (10.0, inf)}``: near slack a muscle is no spring.
    executor : where the rows (values of the first axis) are worked on, as for
        :func:`pam_ocp.each`; within a row each point starts from its neighbour.

    Examples
    --------
    >>> found = pam.control.mode_map(plant, {"mass": [5.0, 10.0], "x": [0.03, 0.04]})
    >>> found.frequency.round(2)
    array([[5.52, 5.91],
           [4.15, 4.46]])
    """
    variables = {plant.variable(n): v for n, v in axes.items()}
    grid = {v.name: np.atleast_1d(require_numbers(v.name, a, v.unit)) for v, a in variables.items()}
    if len(grid) != 2:
        raise InputError(f"mode_map takes two axes; {len(grid)} given")
    (outer, rows), (inner, columns) = grid.items()
    for name, values in grid.items():
        if not len(values):
            raise InputError(f"axis {name!r} of mode_map holds no value; give one, at least")
    work = partial(
        _modes_of_row, plant, dict(conditions or {}), outer, inner, columns, free, within
    )
    found = results_of(work, list(rows), executor=executor, chunk=1, what="rows")
    frequency, damping, stable = (np.array(part) for part in zip(*found, strict=True))
    return ModeMap(plant, grid, frequency, damping, stable)


def _modes_of_row(
    plant: Plant,
    conditions: Values,
    outer: str,
    inner: str,
    columns: Array,
    free: Sequence[str],
    within: Mapping[str, tuple[float, float]] | None,
    value: float,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Frequency, damping and stability at the points of one row; NaN and False where none is."""
    frequency, damping = np.full(len(columns), np.nan), np.full(len(columns), np.nan)
    stable = np.zeros(len(columns), dtype=bool)
    for j, point in _row(plant, {**conditions, outer: value}, inner, columns, free):
        if any(not low <= point[n] <= high for n, (low, high) in (within or {}).items()):
            continue
        stable[j] = point.stability == "stable"
        swing = modes(linearize(point.plant, point, outputs=[], stuck=True))
        if swing:
            frequency[j], damping[j] = swing[0]
    return frequency, damping, stable


def _row(
    plant: Plant, given: Values, name: str, values: Array, free: Sequence[str]
) -> list[tuple[int, OperatingPoint]]:
    """Points of one row, from whichever end there is one."""
    for order in (1, -1):
        try:
            path = equilibrium_path(plant, name, values[::order], given, free=free)
        except EquilibriumError:
            continue
        numbers = range(len(values))[::order]
        return list(zip(numbers, path.points, strict=False))
    return []

"""Input signals: piecewise polynomials of time, made from whatever a user has.

Constants, samples (held or joined by lines), functions of time and trajectories all become one
exact form, so that an integrator never steps over a jump.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import comb
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError, kind_of, require_numbers
from .expressions import polynomial
from .quantities import is_quantity
from .system import HasInputs
from .variables import Causality

Array: TypeAlias = NDArray[np.float64]
Interpolation: TypeAlias = Literal["previous", "linear"]
Inputs: TypeAlias = "Mapping[str, Any] | Sampled | PiecewisePolynomial | None"

FUNCTION_TOLERANCE = 1e-9
"""A function of time becomes polynomials that follow it to this part of the input's nominal."""
SHORTEST_PIECE = 1e-9
"""... down to pieces of this length [s], where a jump is taken for a jump."""
MOST_PIECES = 100_000
"""... as long as it takes no more than so many (some 1000 periods of a sine)."""


@dataclass(frozen=True)
class PiecewisePolynomial:
    """Signals u_i(t) = sum_j c[k, j, i] (t - breaks[k])^j on breaks[k] <= t < breaks[k + 1].

    breaks : (n + 1,) times [s], rising. coefficients : (n, degree + 1, number of signals).
    Outside the breaks the first and the last value are held.
    """

    breaks: Array
    coefficients: Array

    def require(self, count: int) -> None:
        """Raises InputError where breaks and coefficients do not make ``count`` signals."""
        n = self.breaks.size - 1
        rising = self.breaks.ndim == 1 and n >= 1 and np.all(np.diff(self.breaks) > 0)
        if not (rising and np.all(np.isfinite(self.breaks))):
            raise InputError("breaks of the signals must be at least two finite times, rising")
        shape = self.coefficients.shape
        if len(shape) != 3 or shape[0] != n or shape[1] < 1 or shape[2] != count:
            raise InputError(
                f"coefficients of the signals have shape {shape}; for {n} pieces of {count} "
                f"signals give ({n}, degree + 1, {count})"
            )

    @property
    def degree(self) -> int:
        return int(self.coefficients.shape[1]) - 1

    def __call__(self, t: ArrayLike) -> Array:
        """Values (number of times, number of signals); the right-hand value at a jump."""
        return self._at(t, "right")

    def before(self, t: ArrayLike) -> Array:
        """The same, but the left-hand value at a jump."""
        return self._at(t, "left")

    def _at(self, t: ArrayLike, side: Literal["left", "right"]) -> Array:
        inside = np.clip(np.atleast_1d(np.asarray(t, float)), self.breaks[0], self.breaks[-1])
        piece = np.searchsorted(self.breaks, inside, side=side) - 1
        piece = np.clip(piece, 0, len(self.breaks) - 2)
        since = (inside - self.breaks[piece])[:, None]
        return np.asarray(polynomial(self.coefficients[piece].swapaxes(0, 1), since))

    def shifted(self, breaks: Array) -> PiecewisePolynomial:
        """The same signals on finer breaks (which must hold the old ones that lie inside)."""
        if np.array_equal(breaks, self.breaks):
            return self
        inside = np.clip(breaks[:-1], self.breaks[0], self.breaks[-1])
        piece = np.clip(
            np.searchsorted(self.breaks, inside + 1e-12 * (1 + abs(inside)), side="right") - 1,
            0,
            len(self.breaks) - 2,
        )
        s = inside - self.breaks[piece]
        old = self.coefficients[piece]
        new = np.zeros_like(old)
        n = self.degree + 1
        for j in range(n):  # Taylor shift: (s + h)^m = sum_j binom(m, j) s^(m-j) h^j
            for m in range(j, n):
                new[:, j] += comb(m, j) * (s ** (m - j))[:, None] * old[:, m]
        outside = (breaks[:-1] < self.breaks[0]) | (breaks[:-1] >= self.breaks[-1])
        new[outside, 1:] = 0.0
        new[outside, 0] = self(breaks[:-1][outside])
        late = breaks[:-1] >= self.breaks[-1]
        if late.any():
            new[late, 0] = self.final()
        return PiecewisePolynomial(np.asarray(breaks, float), new)

    def final(self) -> Array:
        """The value at the last break, from the left."""
        h = self.breaks[-1] - self.breaks[-2]
        return np.asarray((h ** np.arange(self.degree + 1)) @ self.coefficients[-1])


class Sampled(Protocol):
    """Named time series that can drive a plant: a :class:`pam_ocp.Trajectory`."""

    @property
    def t(self) -> Array: ...

    @property
    def names(self) -> Sequence[str]: ...

    @property
    def interpolation(self) -> Interpolation: ...

    @property
    def signals(self) -> PiecewisePolynomial | None: ...

    def named(self, causality: Causality, /) -> tuple[str, ...]: ...

    def __getitem__(self, name: str, /) -> Array: ...

    def __contains__(self, name: object, /) -> bool: ...


def signals(
    plant: HasInputs,
    inputs: Inputs,
    t: Array,
    interpolation: Interpolation = "previous",
) -> PiecewisePolynomial:
    """The inputs of a plant over [t[0], t[-1]] as one piecewise polynomial.

    inputs : {name: number | array of len(t) | function of time | (times, values) | pandas Series
        over time}, a Trajectory, or None; inputs that are not named keep their start value.
    interpolation : how arrays run between the samples ("previous" holds, "linear" joins).
    """
    if isinstance(inputs, PiecewisePolynomial):
        if inputs.coefficients.shape[2] != len(plant.inputs):
            raise InputError(
                f"inputs hold {inputs.coefficients.shape[2]} signals, the plant has "
                f"{len(plant.inputs)} inputs"
            )
        return inputs
    if not isinstance(interpolation, str) or interpolation not in ("previous", "linear"):
        raise InputError(f"interpolation = {interpolation!r}: choose 'previous' (held) or 'linear'")
    given = _by_name(plant, inputs)
    if inputs is not None and not isinstance(inputs, Mapping):
        if inputs.signals is not None:
            names = inputs.named("input")
            order = [names.index(v.name) for v in plant.inputs]
            return PiecewisePolynomial(
                inputs.signals.breaks, inputs.signals.coefficients[:, :, order]
            )
        interpolation = inputs.interpolation
    pieces = [
        _one(variable, given.get(variable.name, variable.start), t, interpolation)
        for variable in plant.inputs
    ]
    return joined(pieces, t)


def _by_name(plant: HasInputs, inputs: Any) -> dict[str, Any]:
    if inputs is None:
        return {}
    if isinstance(inputs, Mapping):
        given = {plant.variable(name).name: value for name, value in inputs.items()}
        wrong = [n for n in given if plant.variable(n).causality != "input"]
        if wrong:
            raise InputError(
                f"inputs: {wrong[0]} is {plant.variable(wrong[0]).kind} of the plant, not "
                f"an input; its inputs are {', '.join(v.name for v in plant.inputs)}"
            )
        return given
    if not hasattr(inputs, "interpolation"):
        raise InputError(
            f"inputs is {kind_of(inputs)}: give {{name: value}}, such as "
            f"{{{plant.inputs[0].name if plant.inputs else 'name'!r}: 3e5}}, or a Trajectory"
        )
    missing = [v.name for v in plant.inputs if v.name not in inputs]
    if missing:
        raise InputError(
            f"inputs: the trajectory holds no column {missing[0]!r} but {', '.join(inputs.names)}; "
            "name its columns as the plant's inputs"
        )
    return {v.name: (inputs.t, inputs[v.name]) for v in plant.inputs}


def _one(variable: Any, value: Any, t: Array, interpolation: Interpolation) -> PiecewisePolynomial:
    if callable(value):
        return _from_function(variable, value, t)
    if hasattr(value, "to_numpy") and type(getattr(value, "index", None)).__name__ != "RangeIndex":
        value = _of_series(value)
    label = f"input {variable.name}"
    if isinstance(value, tuple) and len(value) == 2:
        times = np.atleast_1d(require_numbers(label, value[0], "s"))
        samples = np.atleast_1d(require_numbers(label, value[1], variable.unit))
    elif is_quantity(value) or (not isinstance(value, list | tuple) and np.ndim(value) == 0):
        constant = np.full((1, 1, 1), variable.check(value))
        return PiecewisePolynomial(np.array([t[0], t[-1]]), constant)
    else:
        times, samples = t, require_numbers(label, value, variable.unit)
    variable.doubt(samples)
    if np.shape(samples) != np.shape(times) or np.ndim(samples) != 1 or len(samples) < 2:
        raise InputError(
            f"input {variable.name}: {np.size(samples)} samples for {np.size(times)} times; "
            "give a number, one value per time, a (times, values) pair, or a function of time"
        )
    if not np.all(np.diff(times) > 0):
        raise InputError(f"input {variable.name}: the times must rise from sample to sample")
    if interpolation == "previous":
        if times[-1] < t[-1]:  # the last sample holds, too
            times, samples = np.append(times, t[-1]), np.append(samples, samples[-1])
        return PiecewisePolynomial(times, samples[:-1, None, None])
    slopes = np.diff(samples) / np.diff(times)
    return PiecewisePolynomial(times, np.stack([samples[:-1], slopes], axis=1)[:, :, None])


def _of_series(value: Any) -> Any:
    """(times, values) of a pandas Series over time: seconds, durations or stamps from the first."""
    clock = getattr(value, "index", None)
    if clock is None:  # of polars, say
        return value.to_numpy()
    if hasattr(clock, "tz"):
        clock = clock - clock[0]
    return clock.total_seconds() if hasattr(clock, "total_seconds") else clock, value.to_numpy()


DEGREE = 5
"""Every break starts a step of an integrator: of a cubic there would be three times as many."""
NODES = np.minimum((1 - np.cos(np.pi * np.arange(DEGREE + 1) / DEGREE)) / 2, 1.0 - 1e-9)
"""Of a polynomial on a piece of length 1; at its end it may jump."""
LOOKED_AT = 2000
"""At so many times of a run, at least, polynomials are compared with the function, and at one or
more between two nodes."""
ORDERS = np.arange(DEGREE + 1)
THROUGH = np.linalg.inv(NODES[:, None] ** ORDERS).T
"""Values at the nodes -> coefficients of the polynomial through them."""
BATCH = 4096
"""So many pieces are fitted at a time."""
COMPARED = 8
"""At so many times a function that takes an array is asked for numbers, too."""


def _from_function(
    variable: Any, function: Callable[[float], float], t: Array
) -> PiecewisePolynomial:
    """Pieces through Chebyshev points (Lobatto's), halved until they follow the function."""
    sample = _sampled(variable, function)
    each = 1 + LOOKED_AT // (DEGREE * (len(t) - 1))
    among = np.linspace(NODES[:-1], NODES[1:], each + 2, axis=1)[:, 1:-1].ravel()
    places, powers = np.concatenate([NODES, among]), (among[:, None] ** ORDERS).T
    enough = FUNCTION_TOLERANCE * variable.nominal
    found: list[tuple[Array, Array, Array]] = []
    left, right = np.asarray(t[:-1], float), np.asarray(t[1:], float)  # what is still to be fitted
    done, most = 0, MOST_PIECES + len(left)
    while left.size:
        a, b = left[:BATCH], right[:BATCH]
        h = b - a
        values = sample(a, h, places)
        piece = values[:, : len(NODES)] @ THROUGH
        error = np.abs(values[:, len(NODES) :] - piece @ powers).max(axis=1)
        good = (error <= enough) | (h <= SHORTEST_PIECE)
        found.append((a[good], piece[good] / h[good, None] ** ORDERS, values[good, 0]))
        done += int(good.sum())
        left, right = left[BATCH:], right[BATCH:]
        if not good.all():
            a, b = a[~good], b[~good]
            middle = (a + b) / 2
            left = np.concatenate([np.stack([a, middle], axis=1).ravel(), left])
            right = np.concatenate([np.stack([middle, b], axis=1).ravel(), right])
        if done >= most and left.size:
            raise InputError(
                f"input {variable.name}: the function changes so fast that {most} polynomials "
                f"follow it to t = {left[0]:g} s only, of {t[-1]:g} s; give a slower function, a "
                "shorter duration, or samples as (times, values)"
            )
    begins, pieces, said = (np.concatenate(part) for part in zip(*found, strict=True))
    variable.doubt(said)
    order = np.argsort(begins, kind="stable")
    return PiecewisePolynomial(np.append(begins[order], t[-1]), pieces[order][:, :, None])


def _sampled(
    variable: Any, function: Callable[[Any], Any]
) -> Callable[[Array, Array, Array], Array]:
    """(begins, lengths, places in [0, 1]) -> values (pieces, places) of a user's function."""

    def checked(value: Any, time: float) -> float:
        try:
            array = np.ravel(require_numbers("value", value, variable.unit))
        except InputError:
            array = np.empty(0)
        if array.size != 1:
            raise InputError(
                f"input {variable.name}: the function gives {str(value)[:60]} at t = {time:g} s; "
                "it must give one finite number"
            )
        return float(array[0])

    def at_once(times: Array) -> Array | None:
        """All values by one call, where the function takes arrays and says the same of numbers."""
        try:
            found = function(times.copy())
        except Exception:  # written for a number; what else is wrong shows for one
            return None
        if not isinstance(found, np.ndarray) or found.dtype != float or found.shape != times.shape:
            return None
        few = np.arange(COMPARED) * (times.size - 1) // (COMPARED - 1)
        try:
            alone = np.array([function(float(s)) for s in times[few]], float)
        except (TypeError, ValueError):
            return None
        close = 1e-3 * FUNCTION_TOLERANCE * variable.nominal  # vectorised sines differ by an ulp
        same = alone.shape == few.shape and bool(np.all(np.abs(alone - found[few]) <= close))
        return found if same and np.isfinite(found).all() else None

    def values(begins: Array, lengths: Array, places: Array) -> Array:
        times = (begins[:, None] + lengths[:, None] * places).ravel()
        array = at_once(times) if times.size > COMPARED else None
        if array is not None:
            return array.reshape(-1, len(places))
        numbers = times.tolist()
        try:
            found: list[Any] = [function(s) for s in numbers]
        except TypeError:
            _require_one_argument(variable, function)
            raise
        if not {type(v) for v in found} <= {float, np.float64} or not np.isfinite(found).all():
            found = [checked(v, s) for v, s in zip(found, numbers, strict=True)]
        return np.array(found).reshape(-1, len(places))

    return values


def _require_one_argument(variable: Any, function: Callable[[Any], Any]) -> None:
    try:
        inspect.signature(function).bind(0.0)
    except TypeError:
        raise InputError(
            f"input {variable.name}: the function has to take one argument, the time [s]"
        ) from None
    except ValueError:  # of C, without a signature
        pass


def joined(pieces: list[PiecewisePolynomial], t: Array) -> PiecewisePolynomial:
    """Several signals on the union of their breaks, over [t[0], t[-1]]."""
    inside = [p.breaks[(p.breaks > t[0]) & (p.breaks < t[-1])] for p in pieces]
    breaks = merged(np.concatenate([t[[0, -1]], *inside]))
    degree = max((p.degree for p in pieces), default=0)
    coefficients = np.zeros((len(breaks) - 1, degree + 1, len(pieces)))
    for i, p in enumerate(pieces):
        own = p if np.array_equal(p.breaks, breaks) else p.shifted(breaks)
        coefficients[:, : p.degree + 1, i] = own.coefficients[:, :, 0]
    return PiecewisePolynomial(breaks, coefficients)


def merged(times: Array) -> Array:
    """Sorted times without those that differ only by rounding."""
    times = np.sort(times)
    near = 1e-12 * (1 + np.abs(times))
    keep = np.diff(times, prepend=-np.inf) > near
    keep &= times[-1] - times > near  # however many differ from the last by rounding: that one
    keep[[0, -1]] = True
    return np.asarray(times[keep])

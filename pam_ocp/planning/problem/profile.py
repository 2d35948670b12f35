"""Profile: a bound or an aim that changes with time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.errors import InputError

__all__ = ["Profile"]

Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Profile:
    """Values over the time since the motion began: a bound or an aim for :func:`pam_ocp.plan`.

    t : (n,) rising times [s], n >= 2. values : (n,) values in SI.
    smooth : a cubic spline through the values (n >= 4), two times differentiable, which solvers
        like; by default straight lines. Before the first and behind the last time the end values
        are held.

    Raises InputError for times that do not rise, values that are not finite, or lengths that
    differ.

    Examples
    --------
    >>> roof = pam.Profile([0.0, 0.03, 0.2], [0.0, 0.011, 0.011])
    >>> under = pam.plan(slide, [{"x": -0.01}, {"x": 0.01}], bounds={"x": (None, roof)})
    >>> under.verified
    True
    """

    t: Array
    values: Array
    smooth: bool = False

    def __init__(self, t: ArrayLike, values: ArrayLike, smooth: bool = False) -> None:
        times, samples = np.asarray(t, float), np.asarray(values, float)
        if times.ndim != 1 or times.shape != samples.shape or len(times) < 2:
            raise InputError(
                f"Profile: {times.shape} times and {samples.shape} values; give two lists of equal "
                "length, at least two entries each"
            )
        if not (np.all(np.isfinite(samples)) and np.all(np.diff(times) > 0)):
            raise InputError("Profile: the times must rise and all values be finite")
        if smooth and len(times) < 4:
            raise InputError(f"Profile: smooth=True needs at least 4 values, not {len(times)}")
        for field, value in (("t", times), ("values", samples), ("smooth", bool(smooth))):
            object.__setattr__(self, field, value)

    def function(self) -> ca.Function:
        """CasADi function t [s] -> value, for use in a symbolic graph."""
        kind = "bspline" if self.smooth else "linear"
        table = ca.interpolant("profile", kind, [self.t.tolist()], self.values.tolist())
        t = ca.MX.sym("t")
        held = ca.fmin(ca.fmax(t, self.t[0]), self.t[-1])
        return ca.Function("profile", [t], [table(held)])

    def __call__(self, t: Any) -> Array:
        """Values at times [s] (any shape)."""
        times = np.asarray(t, float)
        found = np.asarray(self.function()(times.reshape(1, -1)), float)
        return found.reshape(times.shape)

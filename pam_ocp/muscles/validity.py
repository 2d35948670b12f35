"""Where a law or a muscle was measured, and a warning, once, when that range is left."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.quantities import outside
from ..core.variables import Variable

Range = tuple[float, float]
UNLIMITED: Range = (-math.inf, math.inf)
ROUNDING = 1e-9
"""Leaving a range by this much of its upper end is rounding, not extrapolation."""

FAR = 0.1
"""Of a range: so far beyond it a motion is worth a warning."""

_QUANTITIES = {
    "pressure": Variable("pressure", "parameter", unit="Pa"),
    "contraction": Variable("contraction", "parameter", display_unit="%"),
}
_WARNED: set[tuple[str, str]] = set()


class ValidityWarning(UserWarning):
    """A formula is used outside the range it was measured or stated for.

    Examples
    --------
    >>> import warnings
    >>> with warnings.catch_warnings(record=True) as given:
    ...     warnings.simplefilter("always")
    ...     _ = pam.muscle("DMSP-20-300").force(3e5, 0.5)  # measured to 0.26
    ...
    >>> given[0].category.__name__
    'ValidityWarning'
    """


@dataclass(frozen=True)
class Validity:
    """Range of gauge pressure [Pa] and contraction ratio [1] in which a formula holds."""

    pressure: Range = UNLIMITED
    contraction: Range = UNLIMITED
    note: str = ""

    def check(self, subject: str, pressure: Any, contraction: Any) -> None:
        """Warn, once for each ``subject`` and quantity, when a number lies outside."""
        for quantity, values in (("pressure", pressure), ("contraction", contraction)):
            low, high = getattr(self, quantity)
            if (subject, quantity) in _WARNED or (low, high) == UNLIMITED or not np.size(values):
                continue
            slack = ROUNDING * abs(high) if math.isfinite(high) else 0.0
            least, most = float(np.min(values)), float(np.max(values))
            if least >= low - slack and most <= high + slack:
                continue
            _WARNED.add((subject, quantity))
            shown = _QUANTITIES[quantity].shown
            warnings.warn(
                f"{subject}: {quantity} = {shown(least if least < low - slack else most)} is "
                f"outside {shown(low)} .. {shown(high)}, where it holds; the force is an "
                "extrapolation" + (f" ({self.note})" if self.note else ""),
                ValidityWarning,
                stacklevel=outside(),
            )


def warn_beyond(
    subject: str, quantity: str, values: Any, largest: float, unit: str, gives_way: str
) -> None:
    """Warn, once for each ``subject`` and quantity, where a number lies above what is borne."""
    if (subject, quantity) in _WARNED or not np.size(values):
        return
    most = float(np.max(values))
    if most > largest * (1 + ROUNDING):
        _WARNED.add((subject, quantity))
        warnings.warn(
            f"{subject}: {quantity} = {most:g} {unit} is above {largest:g} {unit}, at which "
            f"{gives_way} way",
            ValidityWarning,
            stacklevel=outside(),
        )


def warn_outside(subject: str, variable: Variable, values: Any, t: Any) -> None:
    """Warn, once for each ``subject`` and variable, where a motion goes beyond a variable's range
    by more than a tenth of its width: so little the law goes on as it did.
    """
    low, high = variable.min, variable.max
    if (subject, variable.name) in _WARNED or not math.isfinite(high - low):
        return
    beyond = np.maximum(low - values, values - high)
    k = int(np.argmax(beyond))
    if beyond[k] > FAR * (high - low):
        _WARNED.add((subject, variable.name))
        warnings.warn(
            f"{subject}: {variable.name} = {variable.shown(values[k])} at {t[k]:.4g} s is outside "
            f"{variable.shown(low)} .. {variable.shown(high)}. Nothing stops it there, where "
            "the force law may be an extrapolation: check start, inputs and load, or add stops "
            "(pam.loads.Wall)",
            ValidityWarning,
            stacklevel=outside(),
        )


def forget_warnings() -> None:
    """Give every warning of :class:`Validity` once more."""
    _WARNED.clear()

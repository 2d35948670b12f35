"""Force laws: the pulling force of a muscle over gauge pressure and contraction ratio.

A law is a frozen dataclass whose fields are its coefficients, in SI (Pa gauge, kappa a
fraction). A field holds a number, or a CasADi symbol when the law stands in a plant: the
formula is written once, in :meth:`ForceLaw.formula`, and everything else (numbers, arrays,
slopes, inverse, C code) comes out of it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cache
from typing import Any, ClassVar, TypeAlias, TypeVar, overload

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..variables import Variable

__all__ = ["LAWS", "FloatOrSX", "ForceLaw", "SixParameterLaw", "clamp", "coefficient"]

FloatOrSX: TypeAlias = "float | ca.SX"
Array: TypeAlias = NDArray[np.float64]
Law = TypeVar("Law", bound="ForceLaw")

SLACK_WIDTH = 1.0
"""Default half width of the smooth transition between taut and slack [N]."""


def clamp(tension: ca.SX, width: FloatOrSX) -> ca.SX:
    """Smooth max(tension, 0): a muscle only pulls.

    Exactly ``tension`` from ``width`` on, exactly 0 below ``-width``; between them a polynomial
    of degree 6 with three continuous derivatives (the integral of the quintic smoothstep), at
    most 0.16 ``width`` above max(tension, 0). So a taut muscle follows its law to the last digit.
    """
    s = (tension / width + 1) / 2
    blend = width * s**4 * (2 * s**2 - 6 * s + 5)
    return ca.if_else(tension >= width, tension, ca.if_else(tension <= -width, 0, blend))


def coefficient(unit: str, nominal: float, description: str) -> Any:
    """A dataclass field for a law's coefficient, with what a Variable wants to know of it."""
    return field(metadata={"unit": unit, "nominal": nominal, "description": description})


@dataclass(frozen=True)
class ForceLaw(ABC):
    """Base of all force laws. A subclass gives its coefficients as fields, and ``formula``."""

    name: ClassVar[str]
    title: ClassVar[str]
    reference: ClassVar[str]

    @abstractmethod
    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        """The law as printed, without clamp: tension [N] at gauge pressure p [Pa], contraction kappa."""

    # ---- coefficients -------------------------------------------------------------------
    @classmethod
    def coefficient_variables(cls, prefix: str = "") -> tuple[Variable, ...]:
        """The coefficients as parameter variables (unit, nominal, description), without values."""
        return tuple(
            Variable(
                f"{prefix}{f.name}",
                "parameter",
                unit=f.metadata["unit"],
                nominal=f.metadata["nominal"],
                description=f.metadata["description"],
            )
            for f in fields(cls)
        )

    @property
    def values(self) -> dict[str, Any]:
        """The coefficients by name [SI]."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def substituted(self: Law, symbol: Callable[[str, Any], Any]) -> Law:
        """The same law with each coefficient replaced by ``symbol(name, value)``."""
        return replace(self, **{n: symbol(n, v) for n, v in self.values.items()})

    @classmethod
    @cache
    def function(cls) -> ca.Function:
        """CasADi function (p, kappa, coefficients) -> (tension, its slopes dF/dkappa, dF/dp)."""
        p, kappa = ca.SX.sym("p"), ca.SX.sym("kappa")
        symbols = [ca.SX.sym(f.name) for f in fields(cls)]
        tension = cls(*symbols).formula(p, kappa)
        slopes = [ca.jacobian(tension, kappa), ca.jacobian(tension, p)]
        return ca.Function(
            f"{cls.__name__}",
            [p, kappa, ca.vertcat(*symbols)],
            [tension, *(ca.densify(s) for s in slopes)],
            ["p", "kappa", "coefficients"],
            ["tension", "dF_dkappa", "dF_dp"],
        )

    def _evaluate(self, index: int, p: Any, kappa: Any) -> Any:
        return evaluate(self.function(), index, p, kappa, list(self.values.values()))

    # ---- what a law answers -------------------------------------------------------------
    @overload
    def tension(self, p: ca.SX, kappa: ca.SX) -> ca.SX: ...
    @overload
    def tension(self, p: ArrayLike, kappa: ArrayLike) -> Array: ...
    def tension(self, p: Any, kappa: Any) -> Any:
        """The law without clamp [N]; negative where a real muscle is slack. Arrays broadcast."""
        return self._evaluate(0, p, kappa)

    def dtension_dkappa(self, p: Any, kappa: Any) -> Any:
        """Exact derivative of the tension with respect to contraction [N]."""
        return self._evaluate(1, p, kappa)

    def dtension_dp(self, p: Any, kappa: Any) -> Any:
        """Exact derivative of the tension with respect to pressure [N/Pa = m2]."""
        return self._evaluate(2, p, kappa)

    @abstractmethod
    def pressure(self, tension: Any, kappa: Any) -> Any:
        """Gauge pressure [Pa] at which the muscle pulls with ``tension`` [N] at ``kappa``."""


def evaluate(function: ca.Function, index: int, p: Any, kappa: Any, rest: list[Any]) -> Any:
    """Output ``index`` of ``function(p, kappa, rest)``: symbolic for SX, else broadcast arrays.

    Anything that is no CasADi expression comes back as a float (for scalars) or an ndarray.
    """
    if any(isinstance(a, ca.SX) for a in (p, kappa, *rest)):
        return function(p, kappa, ca.vertcat(*rest))[index]
    pressures, contractions = np.broadcast_arrays(
        np.asarray(p, dtype=float), np.asarray(kappa, dtype=float)
    )
    if pressures.size == 0:
        return np.empty(pressures.shape)
    result = function(pressures.reshape(1, -1), contractions.reshape(1, -1), ca.DM(rest))[index]
    array = np.asarray(result, dtype=float).reshape(pressures.shape)
    return array if array.ndim else float(array)


@dataclass(frozen=True)
class SixParameterLaw(ForceLaw):
    """F = (a1 p + a2) exp(a3 kappa) + a4 kappa p + a5 p + a6.

    Affine in pressure: F = G(kappa) p + H(kappa), so the inverse is exact.

    Source: Sárosi, Bíró, Németh, Cveticanin, Mechanism and Machine Theory 85 (2015) 25-34,
    eq. (3) (its "exp^(a3 r)" read as exp(a3 kappa)). Published sets are for p in bar and kappa in
    percent: :meth:`from_published` converts them.
    """

    a1: FloatOrSX = coefficient("N/Pa", 1e-4, "exponential term, per pressure")
    a2: FloatOrSX = coefficient("N", 100.0, "exponential term")
    a3: FloatOrSX = coefficient("1", 10.0, "exponent of the contraction")
    a4: FloatOrSX = coefficient("N/Pa", 1e-2, "contraction times pressure")
    a5: FloatOrSX = coefficient("N/Pa", 1e-3, "pressure")
    a6: FloatOrSX = coefficient("N", 100.0, "constant")

    name: ClassVar[str] = "six-parameter"
    title: ClassVar[str] = "Six-parameter law (Sárosi-Fabulya)"
    reference: ClassVar[str] = "Sárosi et al., Mech. Mach. Theory 85 (2015) 25-34, eq. (3)"

    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        return (
            (self.a1 * p + self.a2) * ca.exp(self.a3 * kappa)
            + self.a4 * kappa * p
            + self.a5 * p
            + self.a6
        )

    def pressure(self, tension: Any, kappa: Any) -> Any:
        """Exact inverse p = (F - H)/G. InputError where G <= 0 (beyond kappa of about 0.31)."""
        slope = self.dtension_dp(0.0, kappa)
        if not isinstance(slope, ca.SX) and np.any(np.asarray(slope) <= 0):
            raise InputError(
                f"kappa = {np.max(np.asarray(kappa)):g}: pressure does not raise the force of this "
                "law any more; ask for contractions below its largest (about 0.3)"
            )
        return (tension - self.tension(0.0, kappa)) / slope

    # bar and percent, as the sets are printed; factor_SI = value_published * factor
    _PUBLISHED: ClassVar[dict[str, float]] = {
        "a1": 1e-5, "a2": 1.0, "a3": 100.0, "a4": 1e-3, "a5": 1e-5, "a6": 1.0,
    }  # fmt: skip

    @classmethod
    def from_published(cls, coefficients: Any) -> SixParameterLaw:
        """The law from (a1 .. a6) as published: p in bar (gauge), kappa in percent, F in N."""
        values = [float(c) for c in coefficients]
        if len(values) != 6 or not np.all(np.isfinite(values)):
            raise InputError(f"coefficients = {values}: give the six finite numbers a1 .. a6")
        return cls(*(v * f for v, f in zip(values, cls._PUBLISHED.values(), strict=True)))

    def published(self) -> dict[str, float]:
        """a1 .. a6 for p in bar and kappa in percent, as in the literature's tables."""
        return {n: float(v) / self._PUBLISHED[n] for n, v in self.values.items()}


LAWS: dict[str, type[ForceLaw]] = {law.name: law for law in (SixParameterLaw,)}
"""Every law of the library by its name."""

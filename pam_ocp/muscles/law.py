"""Force laws: the pulling force of a muscle over gauge pressure and contraction ratio.

A law is a frozen dataclass whose fields are its coefficients, in SI (Pa gauge, kappa a
fraction). A field holds a number, or a CasADi symbol when the law stands in a plant: the
formula is written once, in :meth:`ForceLaw.formula`, and everything else (numbers, arrays,
slopes, inverse, volume, C code) comes out of it.
"""

# ruff: noqa: RUF009 - coefficient() gives a dataclasses.field()

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cache, lru_cache
from typing import Any, ClassVar, TypeAlias, TypeVar, overload

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.calibration import AMBIENT
from ..core.errors import InputError, broadcast, require_numbers, require_positive, with_kinds
from ..core.registry import Registry
from ..core.stop import locked
from ..core.variables import Variable
from .validity import Validity

FloatOrSX: TypeAlias = "float | ca.SX"
Array: TypeAlias = NDArray[np.float64]
Law = TypeVar("Law", bound="ForceLaw")

SLACK_WIDTH = 1.0
"""Default half width of the smooth transition between taut and slack [N]."""

LARGEST_CONTRACTION = 0.45
"""No muscle contracts further: the ideal braid of any angle ends at 0.42."""

CONTRACTIONS = (-1.0, 1.0)
"""Beyond, a contraction is none: percent, or a length."""

LOWEST, HIGHEST = -1e6, 1e8
"""Where an inverse pressure is looked for [Pa gauge]."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)


def clamp(tension: ca.SX, width: FloatOrSX) -> ca.SX:
    """Smooth max(tension, 0): a muscle only pulls.

    Exactly ``tension`` from ``width`` on, exactly 0 below ``-width``; between them a polynomial
    of degree 6 with three continuous derivatives (the integral of the quintic smoothstep), at
    most 0.16 ``width`` above max(tension, 0). So a taut muscle follows its law to the last digit.
    """
    s = (tension / width + 1) / 2
    blend = width * s**4 * (2 * s**2 - 6 * s + 5)
    return ca.if_else(tension >= width, tension, ca.if_else(tension <= -width, 0, blend))


@with_kinds
def coefficient(
    unit: str,
    nominal: float,
    description: str,
    *,
    minimum: float = -math.inf,
    maximum: float = math.inf,
    fixed: bool = False,
    default: float | None = None,
) -> Any:
    """A dataclass field for a law's coefficient, with what a Variable wants to know of it.

    unit, nominal, description, minimum, maximum : as in :class:`Variable` [unit].
    fixed : a known constant (a length, the smoothing of a kink) that no fit should touch.
    default : value where none is given; such fields must come last.

    Examples
    --------
    >>> area = pam.laws.coefficient("N/Pa", 1e-3, "area", minimum=0.0)
    >>> law = pam.laws.own_law("piston", lambda p, kappa, area: area * p, {"area": area})
    >>> float(law(area=1e-3).tension(2e5, 0.0))
    200.0
    """
    if minimum > maximum:
        raise InputError(f"minimum = {minimum:g} must not lie above maximum = {maximum:g}")
    require_positive("nominal", nominal)
    if not minimum <= nominal <= maximum and not minimum <= -nominal <= maximum:
        raise InputError(f"nominal = {nominal:g} must lie in {minimum:g} .. {maximum:g}")
    return field(
        default=MISSING if default is None else default,
        metadata={
            "unit": unit,
            "nominal": nominal,
            "description": description,
            "min": minimum,
            "max": maximum,
            "fixed": fixed,
        },
    )


@locked
@dataclass(frozen=True)
class ForceLaw(ABC):
    """Base of all force laws. A subclass gives its coefficients as fields, and ``formula``.

    name, title, reference : key in ``LAWS``, what people call it, where it comes from.
    validity : where the law as such is said to hold; numbers outside give a warning, once.

    Examples
    --------
    >>> law = muscle.law
    >>> print(f"{law.tension(3e5, 0.10):.0f} N")
    234 N
    >>> print(f"{law.pressure(law.tension(3e5, 0.10), 0.10):.0f} Pa")  # the inverse
    300000 Pa
    """

    name: ClassVar[str]
    title: ClassVar[str]
    reference: ClassVar[str]
    validity: ClassVar[Validity] = Validity()

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        locked(cls)

    def __post_init__(self) -> None:
        for variable in self.coefficient_variables():
            value = getattr(self, variable.name)
            if not isinstance(value, (ca.SX, ca.MX)):
                variable.check(value, f"coefficient of the {self.name} law")

    @abstractmethod
    def formula(self, p: ca.SX, kappa: ca.SX) -> ca.SX:
        """The law as printed, without clamp: tension [N] at gauge pressure p [Pa], contraction
        kappa.
        """

    # ---- coefficients -------------------------------------------------------------------
    @classmethod
    @lru_cache(maxsize=128)
    def coefficient_variables(cls, prefix: str = "") -> tuple[Variable, ...]:
        """The coefficients as parameter variables (unit, nominal, range), without values."""
        return tuple(
            Variable(
                f"{prefix}{f.name}",
                "parameter",
                unit=f.metadata["unit"],
                min=f.metadata.get("min", -math.inf),
                max=f.metadata.get("max", math.inf),
                nominal=f.metadata["nominal"],
                description=f.metadata["description"],
            )
            for f in fields(cls)
        )

    @classmethod
    def free_coefficients(cls) -> tuple[str, ...]:
        """Names of the coefficients that a fit determines; their number is the law's size."""
        return tuple(f.name for f in fields(cls) if not f.metadata.get("fixed", False))

    @classmethod
    def fixed_coefficients(cls) -> dict[str, float | None]:
        """Names of the known constants, each with its default (None: it must be given)."""
        return {
            f.name: None if f.default is MISSING else float(f.default)
            for f in fields(cls)
            if f.metadata.get("fixed", False)
        }

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
        symbols = {f.name: ca.SX.sym(f.name) for f in fields(cls)}
        tension = ca.SX(cls(**symbols).formula(p, kappa))
        slopes = [ca.jacobian(tension, kappa), ca.jacobian(tension, p)]
        return ca.Function(
            f"{cls.__name__}",
            [p, kappa, ca.vertcat(*symbols.values())],
            [tension, *(ca.densify(s) for s in slopes)],
            ["p", "kappa", "coefficients"],
            ["tension", "dF_dkappa", "dF_dp"],
        )

    @classmethod
    @cache
    def is_affine(cls) -> bool:
        """Whether F = G(kappa) p + H(kappa): the second derivative in p is structurally zero."""
        p, kappa = ca.SX.sym("p"), ca.SX.sym("kappa")
        slope = cls.function()(p, kappa, ca.SX.sym("c", cls.function().size1_in(2)))[2]
        return not ca.depends_on(slope, p)

    def _evaluate(self, index: int, p: Any, kappa: Any) -> Any:
        p, kappa = at_point(p, kappa)
        if not any(isinstance(a, (ca.SX, ca.MX)) for a in (p, kappa)):
            self.validity.check(f"{self.name} law", p, kappa)
        return self._number(index, p, kappa)

    def _number(self, index: int, p: Any, kappa: Any) -> Any:
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

    def pressure(self, tension: Any, kappa: Any) -> Any:
        """Gauge pressure [Pa] at which the muscle pulls with ``tension`` [N] at ``kappa``.

        Exact, p = (F - H)/G, for a law that is affine in pressure, also for symbols; else the
        root in a bracket, of numbers. InputError where pressure does not raise the force (G <= 0:
        for the six-parameter law beyond kappa of about 0.31), or where no pressure gives the
        tension.
        """
        tension = require_numbers("force", tension, "N")
        kappa = require_numbers("kappa", kappa, "1", *CONTRACTIONS)
        arguments = (tension, kappa, *self.values.values())
        symbolic = any(isinstance(a, (ca.SX, ca.MX)) for a in arguments)
        if not self.is_affine():
            if symbolic:
                raise InputError(
                    f"pressure(): the {self.name} law has no closed inverse; give numbers, or put "
                    "the equation force = ... to your solver"
                )
            return self._pressure_by_root(tension, kappa)
        slope, offset = self._number(2, 0.0, kappa), self._number(0, 0.0, kappa)
        if not symbolic and np.any(np.asarray(slope) <= 0):
            raise InputError(
                f"kappa = {np.max(np.asarray(kappa)):g}: pressure does not raise the force of this "
                "law any more; ask for contractions below its largest (about 0.3)"
            )
        result = (tension - offset) / slope
        return float(result) if isinstance(result, np.ndarray) and not result.ndim else result

    def _pressure_by_root(self, tension: Any, kappa: Any) -> Any:
        from scipy.optimize import brentq

        def inverse(wanted: float, contraction: float) -> float:
            def excess(p: float) -> float:
                return float(self._number(0, p, contraction)) - wanted

            low, high = 0.0, 1e5
            while excess(high) < 0 and high < HIGHEST:
                high *= 2
            while excess(low) > 0 and low > LOWEST:
                low = 2 * low - 1e5
            if excess(high) < 0 or excess(low) > 0:
                raise InputError(
                    f"{self.name} law: no pressure up to {HIGHEST / 1e5:g} bar gives a force of "
                    f"{wanted:g} N at kappa = {contraction:g}; ask for less contraction"
                )
            return float(brentq(excess, low, high, xtol=1e-12, rtol=1e-14))

        found = np.vectorize(inverse, otypes=[float])(tension, kappa)
        return found if found.ndim else float(found)

    def blocked_force(self, p: Any) -> Any:
        """Tension at rest length [N]."""
        return self.tension(p, 0.0)

    def max_contraction(self, p: Any) -> Any:
        """Contraction at which the unloaded muscle goes slack at gauge pressure p [Pa].

        NaN when it is slack already at kappa = 0, or taut up to 0.45. Arrays go through.
        """

        def largest(pressure: float) -> float:
            low, high = 0.0, LARGEST_CONTRACTION
            for _ in range(5):  # a 450th of the bracket each time, which ends at 2e-14
                grid = np.linspace(low, high, 451)
                slack = np.nonzero(self._number(0, pressure, grid) <= 0)[0]
                if not slack.size or slack[0] == 0:
                    return math.nan
                low, high = grid[slack[0] - 1], grid[slack[0]]
            return float(low + high) / 2

        found = np.vectorize(largest, otypes=[float])(gauge(p))
        return found if found.ndim else float(found)

    # ---- energy ----------------------------------------------------------------------------
    def gain_area(self, kappa: Any) -> Any:
        """Integral of G = dF/dp from 0 to ``kappa`` [m2], for laws affine in pressure.

        Times the rest length this is the volume [m3] by which the muscle grows, since virtual
        work says dF/dp = -dV/dl. Here by Gauss-Legendre with 12 points (to rounding for smooth
        laws); laws with a closed form override ``_gain_area``.
        """
        return self._gain_area(require_numbers("kappa", kappa, "1", *CONTRACTIONS))

    def _gain_area(self, kappa: Any) -> Any:
        return self._gain_integral(0.0, kappa)

    def _gain_integral(self, start: Any, end: Any) -> Any:
        if not self.is_affine():
            raise InputError(
                f"the {self.name} law is not a straight line in pressure, so no volume that "
                "depends on contraction alone is consistent with it; use BraidVolume or "
                "PolynomialVolume"
            )
        coefficients = ca.vertcat(*self.values.values())
        half = (end - start) / 2
        total = 0.0
        for node, weight in zip(_NODES, _WEIGHTS, strict=True):
            at = start + half * (1 + float(node))
            total += float(weight) * self.function()(0.0, at, coefficients)[2]
        return half * total


def at_point(p: Any, kappa: Any) -> tuple[Any, Any]:
    """Gauge pressure [Pa] and contraction, checked: numbers, arrays or CasADi expressions."""
    return gauge(p), require_numbers("kappa", kappa, "1", *CONTRACTIONS)


def gauge(p: Any) -> Any:
    """A gauge pressure [Pa], checked: nothing lies below vacuum."""
    return require_numbers("p", p, "Pa", -AMBIENT, doubted=True)


def evaluate(function: ca.Function, index: int, p: Any, kappa: Any, rest: list[Any]) -> Any:
    """Output ``index`` of ``function(p, kappa, rest)``: symbolic for SX, else broadcast arrays.

    Anything that is no CasADi expression comes back as a float (for scalars) or an ndarray.
    """
    if any(isinstance(a, (ca.SX, ca.MX)) for a in (p, kappa, *rest)):
        return function(p, kappa, ca.vertcat(*rest))[index]
    return over_arrays(function, index, p, kappa, constants=(ca.DM(rest),))


def over_arrays(
    function: ca.Function, index: int, *arrays: Any, constants: tuple[Any, ...] = ()
) -> Any:
    """Output ``index`` of ``function(*arrays, *constants)``, the arrays broadcast; a float for
    numbers.
    """
    rows = broadcast(**{function.name_in(i): a for i, a in enumerate(arrays)})
    if rows[0].size == 0:
        return np.empty(rows[0].shape)
    found = function.call([*(ca.DM(row.reshape(1, -1)) for row in rows), *constants])[index]
    array = np.asarray(found, dtype=float).reshape(rows[0].shape)
    return array if array.ndim else float(array)


LAWS: Registry[type[ForceLaw]] = Registry("law", f"{__package__}.laws")
"""Every law by its name."""


def register(law: type[Law]) -> type[Law]:
    """Class decorator: put a law into ``LAWS`` under its name."""
    return LAWS.register(law.name)(law)


@register
@dataclass(frozen=True)
class SixParameterLaw(ForceLaw):
    """F = (a1 p + a2) exp(a3 kappa) + a4 kappa p + a5 p + a6.

    Affine in pressure: F = G(kappa) p + H(kappa), so the inverse is exact.

    Source: Sárosi, Bíró, Németh, Cveticanin, Mechanism and Machine Theory 85 (2015) 25-34,
    eq. (3) (its "exp^(a3 r)" read as exp(a3 kappa)). Published sets are for p in bar and kappa in
    percent: :meth:`from_published` converts them.

    Examples
    --------
    >>> published = muscle.law.published()  # a1 .. a6 for bar and percent
    >>> law = pam.laws.SixParameterLaw.from_published(published.values())
    >>> bool(np.isclose(law.tension(3e5, 0.10), muscle.law.tension(3e5, 0.10)))
    True
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

    def _gain_area(self, kappa: Any) -> Any:
        """(a1/a3)(e^(a3 kappa) - 1) + a4 kappa^2/2 + a5 kappa [m2]; our inference from eq. (3)."""
        exponential = self.a1 / self.a3 * ca.expm1(self.a3 * kappa)
        return exponential + self.a4 * kappa**2 / 2 + self.a5 * kappa

    # bar and percent, as the sets are printed; factor_SI = value_published * factor
    _PUBLISHED: ClassVar[dict[str, float]] = {
        "a1": 1e-5,
        "a2": 1.0,
        "a3": 100.0,
        "a4": 1e-3,
        "a5": 1e-5,
        "a6": 1.0,
    }

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

"""Laws whose form the user chooses: polynomials, B-splines, an expression of one's own.

Each function here makes a subclass of ForceLaw, so that everything that takes a law's class
(fits, catalogues, plants) takes these too.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from ...core.arguments import with_kinds
from ...core.errors import InputError, UnknownNameError, require_count
from ...core.expressions import expression_of
from ...core.stop import turns
from ..law import LAWS, ForceLaw, coefficient
from ..validity import Validity
from .around import AROUND
from .made import made_law

__all__ = [
    "law_named",
    "own_law",
    "polynomial_law",
    "spline_law",
]

_TYPICAL = {"g": ("N/Pa", 3e-3, "gain G"), "h": ("N", 300.0, "force at zero pressure H")}


_POLYNOMIAL = re.compile(r"polynomial-(\d+)-(\d+)")
_SPLINE = re.compile(r"spline-(\d+):(.+)")


def law_named(name: str) -> type[ForceLaw]:
    """The class of laws of this name: one of ``LAWS``, or a form with its numbers.

    "polynomial-3-4" is ``polynomial_law(3, 4)``, "spline-3:0,0.1,0.25" ``spline_law([0, 0.1, 0.25],
    3)``, "six-parameter+bladder" ``bladder_law(SixParameterLaw)``.
    """
    if name in LAWS:
        return LAWS[name]
    inner, plus, kind = str(name).rpartition("+")
    if plus and kind in AROUND:
        return AROUND[kind](law_named(inner))
    if found := _POLYNOMIAL.fullmatch(str(name)):
        return polynomial_law(int(found[1]), int(found[2]))
    if found := _SPLINE.fullmatch(str(name)):
        try:
            breaks = [float(part) for part in found[2].split(",")]
        except ValueError:
            raise InputError(f"law = {name!r}: give numbers behind the colon") from None
        return spline_law(breaks, int(found[1]))
    known = (*LAWS, "polynomial-DEGREE-DEGREE", "spline-DEGREE:BREAK,BREAK,...", "LAW+bladder")
    raise UnknownNameError("force law", name, known)


@with_kinds
def polynomial_law(gain_degree: int = 3, offset_degree: int = 4) -> type[ForceLaw]:
    """The class of laws F = G(kappa) p + H(kappa) with G = sum g_i kappa^i, H = sum h_i kappa^i.

    Coefficients g0 .. [N/Pa] and h0 .. [N]. Linear in all of them, so a fit is one least-squares
    solve. As many contraction levels as coefficients of G must have been measured.

    Examples
    --------
    >>> law = pam.laws.polynomial_law(1, 3)
    >>> print(f"{pam.fit_force(table, law).rmse:.1f} N")
    6.9 N
    """
    return _polynomial_law(
        _degree("gain_degree", gain_degree), _degree("offset_degree", offset_degree)
    )


@cache
@turns
def _polynomial_law(gain_degree: int, offset_degree: int) -> type[ForceLaw]:
    degrees = {"g": gain_degree, "h": offset_degree}

    def polynomial(law: ForceLaw, letter: str, kappa: Any) -> Any:
        return sum(getattr(law, f"{letter}{i}") * kappa**i for i in range(degrees[letter] + 1))

    def area(law: ForceLaw, kappa: Any) -> Any:
        return sum(
            getattr(law, f"g{i}") * kappa ** (i + 1) / (i + 1) for i in range(gain_degree + 1)
        )

    def described(letter: str, i: int) -> Any:
        unit, size, words = _TYPICAL[letter]
        # contractions are about 1/4, so the i-th coefficient is about 4^i times the constant
        return coefficient(unit, size * 4.0**i, f"{words}, contraction to the power {i}")

    return made_law(
        f"PolynomialLaw{gain_degree}{offset_degree}",
        {f"{c}{i}": described(c, i) for c, degree in degrees.items() for i in range(degree + 1)},
        formula=lambda law, p, kappa: polynomial(law, "g", kappa) * p + polynomial(law, "h", kappa),
        gain_area=area,
        name=f"polynomial-{gain_degree}-{offset_degree}",
        title=f"Polynomials of degree {gain_degree} (gain) and {offset_degree} (offset)",
        reference="free law, affine in pressure",
        remake=(polynomial_law, (gain_degree, offset_degree)),
    )


@with_kinds
def spline_law(breaks: Sequence[float], degree: int = 3) -> type[ForceLaw]:
    """The class of laws F = G(kappa) p + H(kappa) with B-splines G and H.

    breaks : increasing contractions where the polynomial pieces meet, ends included; beyond them
        the end pieces go on.
    degree : of the pieces; 3 has two continuous derivatives of the force.

    ``len(breaks) - 1 + degree`` coefficients each, g0 .. [N/Pa] and h0 .. [N].

    Examples
    --------
    >>> law = pam.laws.spline_law([0.0, 0.1, 0.25], degree=2)
    >>> len(law.free_coefficients())
    8
    """
    points = tuple(float(b) for b in breaks)
    if len(points) < 2 or not np.all(np.isfinite(points)) or np.any(np.diff(points) <= 0):
        raise InputError(f"breaks = {list(points)}: give two or more increasing contractions")
    return _spline_law(points, _degree("degree", degree))


@cache
@turns
def _spline_law(breaks: tuple[float, ...], degree: int) -> type[ForceLaw]:
    count = len(breaks) - 1 + degree

    def spline(law: ForceLaw, letter: str, kappa: Any) -> Any:
        basis = _basis(breaks, degree, kappa)
        return sum(getattr(law, f"{letter}{i}") * b for i, b in enumerate(basis))

    def area(law: ForceLaw, kappa: Any) -> Any:
        # Piece by piece, so that the Gauss points never straddle a break.
        inner = [*breaks[1:-1]]
        total = 0.0
        for low, high in zip([-np.inf, *inner], [*inner, np.inf], strict=True):
            start, end = (ca.fmin(ca.fmax(k, low), high) for k in (ca.SX(0.0), kappa))
            total += law._gain_integral(start, end)
        return total

    fields = {
        f"{letter}{i}": coefficient(unit, size, f"{words}, B-spline {i}")
        for letter, (unit, size, words) in _TYPICAL.items()
        for i in range(count)
    }
    return made_law(
        f"SplineLaw{degree}",
        fields,
        formula=lambda law, p, kappa: spline(law, "g", kappa) * p + spline(law, "h", kappa),
        gain_area=area,
        name=f"spline-{degree}:{','.join(map(repr, breaks))}",
        title=f"B-splines of degree {degree} in {len(breaks) - 1} pieces",
        reference="free law, affine in pressure",
        validity=Validity(contraction=(breaks[0], breaks[-1]), note="the breaks of its splines"),
        remake=(spline_law, (breaks, degree)),
    )


def _basis(breaks: tuple[float, ...], degree: int, kappa: Any) -> list[Any]:
    """All B-splines of ``degree`` over ``breaks`` with repeated ends, by Cox and de Boor."""
    knots = [breaks[0]] * degree + list(breaks) + [breaks[-1]] * degree
    last = len(breaks) - 2 + degree  # index of the last piece that is no point
    basis: list[Any] = []
    for i in range(len(knots) - 1):
        if not degree <= i <= last:
            basis.append(0.0)
            continue
        above = 1.0 if i == degree else kappa >= knots[i]  # the end pieces go on outwards
        below = 1.0 if i == last else kappa < knots[i + 1]
        basis.append(above * below)
    for d in range(1, degree + 1):
        basis = [
            _ratio(kappa - knots[i], knots[i + d] - knots[i]) * basis[i]
            + _ratio(knots[i + d + 1] - kappa, knots[i + d + 1] - knots[i + 1]) * basis[i + 1]
            for i in range(len(basis) - 1)
        ]
    return basis


def _ratio(numerator: Any, denominator: float) -> Any:
    return numerator / denominator if denominator else 0.0


@with_kinds
@turns
def own_law(
    name: str,
    formula: Callable[..., ca.SX] | ca.SX,
    coefficients: Mapping[str, Any],
    *,
    title: str = "",
    reference: str = "a law of the user's own",
    validity: Validity | None = None,
) -> type[ForceLaw]:
    """The class of laws given by an expression of your own.

    formula : tension [N] as a CasADi expression in the SX symbols named ``p`` [Pa gauge],
        ``kappa`` and the coefficients' names; or a function ``formula(p, kappa, **coefficients)``.
    coefficients : name -> :func:`coefficient` (unit, nominal, description, range).

    Raises InputError for an expression with symbols that are neither p, kappa nor coefficients.

    Examples
    --------
    >>> def force(p, kappa, area, k):
    ...     return area * p - k * kappa
    ...
    >>> coefficients = {
    ...     "area": pam.laws.coefficient("N/Pa", 1e-3, "area"),
    ...     "k": pam.laws.coefficient("N", 1e3, "spring"),
    ... }
    >>> law = pam.laws.own_law("sprung", force, coefficients)
    >>> float(law(area=1e-3, k=2e3).tension(2e5, 0.05))
    100.0
    >>> print(f"{pam.fit_force(table, law).rmse:.0f} N")
    91 N
    """
    for key in coefficients:
        if not key.isidentifier() or key in ("p", "kappa", "slack_width", "pre_contraction"):
            raise InputError(f"coefficient {key!r}: choose another name; it is no name or is taken")
        if not isinstance(coefficients[key], Field):
            raise InputError(
                f"coefficient {key!r} = {coefficients[key]!r}: describe it by "
                'coefficient(unit, nominal, description), as coefficient("N", 100.0, "offset")'
            )
    if isinstance(formula, ca.SX):
        formula = _from_expression(formula, tuple(coefficients))
    elif not callable(formula):
        raise InputError(f"formula = {formula!r} must be a CasADi SX expression or a function")
    else:
        symbols = {key: ca.SX.sym(key) for key in coefficients}
        _require_arguments(formula, tuple(coefficients))
        expression_of(f"law {name!r}", formula, ca.SX.sym("p"), ca.SX.sym("kappa"), **symbols)
    if not coefficients:
        raise InputError("coefficients is empty: name at least one, as {'area': coefficient(...)}")
    law = made_law(
        "OwnLaw",
        dict(coefficients),
        formula=lambda law, p, kappa: formula(p, kappa, **law.values),
        name=name,
        title=title or name,
        reference=reference,
        validity=validity or Validity(),
    )
    law.function()  # a formula that cannot be evaluated fails here, not in the first simulation
    return law


def _require_arguments(formula: Callable[..., ca.SX], names: tuple[str, ...]) -> None:
    try:
        inspect.signature(formula).bind(0, 0, **dict.fromkeys(names, 0))
    except TypeError:
        raise InputError(
            f"formula: the function has to take p, kappa, {', '.join(names)}, by these names"
        ) from None
    except ValueError:  # compiled, and it does not say
        return


def _from_expression(expression: ca.SX, names: tuple[str, ...]) -> Callable[..., ca.SX]:
    found = {s.name(): s for s in ca.symvar(expression)}
    unknown = sorted(set(found) - {"p", "kappa", *names})
    if unknown or expression.shape != (1, 1):
        raise InputError(
            f"formula: give a scalar expression in p, kappa, {', '.join(names)}"
            + (f"; it holds {', '.join(unknown)} too" if unknown else "")
        )
    symbols = [found.get(n, ca.SX.sym(n)) for n in ("p", "kappa", *names)]
    function = ca.Function("own", symbols, [expression])
    return lambda p, kappa, **values: function(p, kappa, *(values[n] for n in names))


def _degree(argument: str, value: int) -> int:
    return require_count(argument, value, 0, 12)

"""Laws whose form the user chooses: polynomials, B-splines, an expression of one's own; and laws
around a law: a bladder that must be filled before it pulls, ends that do not contract.

Each function here makes a subclass of ForceLaw, so that everything that takes a law's class
(fits, catalogues, plants) takes these too.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, field, fields, make_dataclass
from functools import cache
from typing import Any, cast

import casadi as ca
import numpy as np

from ...core.errors import InputError, UnknownNameError, require_count, with_kinds
from ...core.expressions import expression_of, polynomial
from ...core.stop import turns
from ..law import LAWS, ForceLaw, clamp, coefficient
from ..validity import Validity

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

    def of(law: ForceLaw, letter: str) -> list[Any]:
        return [getattr(law, f"{letter}{i}") for i in range(degrees[letter] + 1)]

    def area(law: ForceLaw, kappa: Any) -> Any:
        return kappa * polynomial([g / (i + 1) for i, g in enumerate(of(law, "g"))], kappa)

    def described(letter: str, i: int) -> Any:
        unit, size, words = _TYPICAL[letter]
        # contractions are about 1/4, so the i-th coefficient is about 4^i times the constant
        return coefficient(unit, size * 4.0**i, f"{words}, contraction to the power {i}")

    return _made_law(
        f"PolynomialLaw{gain_degree}{offset_degree}",
        {f"{c}{i}": described(c, i) for c, degree in degrees.items() for i in range(degree + 1)},
        formula=lambda law, p, kappa: (
            polynomial(of(law, "g"), kappa) * p + polynomial(of(law, "h"), kappa)
        ),
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

    return _made_law(
        f"SplineLaw{degree}",
        {
            f"{letter}{i}": coefficient(unit, size, f"{words}, B-spline {i}")
            for letter, (unit, size, words) in _TYPICAL.items()
            for i in range(count)
        },
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
    law = _made_law(
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


# ---- classes that are made at run time -----------------------------------------------------------
def _made_law(
    class_name: str,
    coefficients: Mapping[str, Any],
    *,
    remake: tuple[Callable[..., type[ForceLaw]], tuple[Any, ...]] | None = None,
    **members: Any,
) -> type[ForceLaw]:
    """A frozen dataclass of this name with ForceLaw as its base."""
    if remake is not None:  # classes made at run time are pickled as the call that makes them
        members["made_by"] = remake
        members["__reduce__"] = lambda law: (_remade, (*remake, tuple(law.values.values())))
    return cast(
        type[ForceLaw],
        make_dataclass(
            class_name,
            [(n, float, f) for n, f in coefficients.items()],
            bases=(ForceLaw,),
            namespace={"__doc__": members["title"], "__module__": __name__, **members},
            frozen=True,
        ),
    )


def _remade(factory: Callable[..., type[ForceLaw]], arguments: Any, values: Any) -> ForceLaw:
    return factory(*arguments)(*values)


# ---- laws around a law ---------------------------------------------------------------------------
WIDTH = 2e3
"""Half width [Pa] over which a bladder begins to pull."""


@with_kinds
def bladder_law(law: type[ForceLaw]) -> type[ForceLaw]:
    """The class of laws F(max(p - threshold, 0), kappa): a bladder with a dead pressure.

    Below the threshold the pressure goes into the bladder alone, until it touches the braid; above,
    it is as much less. Rounded off by the polynomial of the clamp within ``threshold_width``.
    Coefficients besides those of ``law``: ``threshold`` [Pa], which a fit may determine, and the
    fixed ``threshold_width``.

    The volume consistent with it is that of ``law``: what the bladder takes up below the threshold
    is left out. Source: dead pressure of bladders, B. Tondu, J. Intell. Mater. Syst. Struct. 23
    (2012) 225-253 (abstract read); the form is our reconstruction.

    Examples
    --------
    >>> law = pam.laws.bladder_law(pam.laws.SixParameterLaw)
    >>> law.name
    'six-parameter+bladder'
    """
    return _bladder_law(_free_of(law, "bladder"))


@cache
def _bladder_law(law: type[ForceLaw]) -> type[ForceLaw]:
    def formula(self: Any, p: Any, kappa: Any) -> Any:
        return _inside(law, self).formula(clamp(p - self.threshold, self.threshold_width), kappa)

    return _around(
        law,
        "bladder",
        "behind a bladder's dead pressure",
        {
            "threshold": coefficient(
                "Pa", 2e4, "dead pressure of the bladder", minimum=0.0, default=2e4
            ),
            "threshold_width": coefficient(
                "Pa", WIDTH, "rounding of the dead pressure", minimum=1.0, fixed=True, default=WIDTH
            ),
        },
        formula=formula,
        gain_area=lambda self, kappa: _inside(law, self).gain_area(kappa),
    )


@with_kinds
def ends_law(law: type[ForceLaw]) -> type[ForceLaw]:
    """The class of laws F(p, c kappa) - tube kappa with c = taper/(1 - rigid): rigid ends.

    rigid : part of the rest length that does not contract (fittings, where the rest length was
        measured over them), 0 .. 0.9. taper : factor k >= 1 by which the middle contracts more than
        the whole, since the ends stay conical. tube : elastic force of the inner tube per unit of
        contraction [N] where tube and braid are both fixed to the ends; 0 where only the braid is,
        and the tube can slide.

    The consistent volume is V0 + l0 integral_0^kappa G(c kappa) dkappa, so muscle and gas stay
    passive. Source: contraction corrected by a factor for the conical ends, B. Tondu, P. Lopez,
    IEEE Control Syst. Mag. 20 (2000) 15-38; "boundary constraint of rigid tips" and the two
    fixations, B. Tondu, J. Intell. Mater. Syst. Struct. 23 (2012) 225-253 (abstracts read). That
    the fixation acts as a spring beside the law is our reconstruction.

    Examples
    --------
    >>> law = pam.laws.ends_law(pam.laws.SixParameterLaw)
    >>> law.name
    'six-parameter+ends'
    """
    return _ends_law(_free_of(law, "ends"))


@cache
def _ends_law(law: type[ForceLaw]) -> type[ForceLaw]:
    def factor(self: Any) -> Any:
        return self.taper / (1 - self.rigid)

    def formula(self: Any, p: Any, kappa: Any) -> Any:
        return _inside(law, self).formula(p, factor(self) * kappa) - self.tube * kappa

    return _around(
        law,
        "ends",
        "with rigid, conical ends",
        {
            "rigid": coefficient(
                "1",
                0.1,
                "part of the rest length that does not contract",
                minimum=0.0,
                maximum=0.9,
                fixed=True,
                default=0.0,
            ),
            "taper": coefficient(
                "1", 1.1, "contraction of the middle over the whole", minimum=1.0, default=1.0
            ),
            "tube": coefficient(
                "N",
                100.0,
                "elastic force of a fixed tube, per contraction",
                minimum=0.0,
                default=0.0,
            ),
        },
        formula=formula,
        gain_area=lambda self, kappa: (
            _inside(law, self).gain_area(factor(self) * kappa) / factor(self)
        ),
    )


AROUND: dict[str, Callable[[type[ForceLaw]], type[ForceLaw]]] = {
    "bladder": bladder_law,
    "ends": ends_law,
}
"""What may stand behind a law's name after a +."""


@with_kinds
def with_bladder(law: ForceLaw, threshold: Any, width: Any = WIDTH) -> ForceLaw:
    """``law`` behind a dead pressure ``threshold`` [Pa]; see :func:`bladder_law`.

    Examples
    --------
    >>> law = pam.laws.with_bladder(muscle.law, threshold=3e4)
    >>> bool(np.isclose(law.tension(3e5, 0.1), muscle.law.tension(2.7e5, 0.1)))
    True
    """
    made = bladder_law(type(law))
    return made(**{**law.values, "threshold": threshold, "threshold_width": width})


@with_kinds
def with_ends(law: ForceLaw, rigid: float = 0.0, taper: float = 1.0, tube: float = 0.0) -> ForceLaw:
    """``law`` with ends that do not contract; see :func:`ends_law`.

    Examples
    --------
    >>> law = pam.laws.with_ends(muscle.law, rigid=0.1)
    >>> bool(abs(law.tension(3e5, 0.09) - muscle.law.tension(3e5, 0.10)) < 1e-9)
    True
    """
    return ends_law(type(law))(**{**law.values, "rigid": rigid, "taper": taper, "tube": tube})


def _free_of(law: type[ForceLaw], kind: str) -> type[ForceLaw]:
    if not (isinstance(law, type) and issubclass(law, ForceLaw)):
        raise InputError(f"law = {law!r} must be a class of laws, such as SixParameterLaw")
    if kind in law.name.split("+")[1:]:
        raise InputError(f"law {law.name!r} has {kind} already; change their coefficients")
    return law


def _inside(law: type[ForceLaw], outer: ForceLaw) -> ForceLaw:
    """The law inside, with its part of the coefficients."""
    names = {v.name for v in law.coefficient_variables()}
    return law(**{n: v for n, v in outer.values.items() if n in names})


def _around(
    law: type[ForceLaw],
    kind: str,
    words: str,
    more: dict[str, Any],
    **members: Any,
) -> type[ForceLaw]:
    taken = {v.name for v in law.coefficient_variables()} & set(more)
    if taken:
        raise InputError(f"law {law.name!r} has a coefficient {taken.pop()!r} of its own already")
    made_by = getattr(law, "made_by", None)
    inside = {f.name: field(default=f.default, metadata=f.metadata) for f in fields(law)}
    return _made_law(
        f"{law.__name__}{kind.capitalize()}",
        {**inside, **more},
        name=f"{law.name}+{kind}",
        title=f"{law.title} {words}",
        reference=law.reference,
        validity=law.validity,
        remake=(_again, (kind, None if made_by else law, made_by)),
        **members,
    )


def _again(kind: str, law: type[ForceLaw] | None, made_by: Any) -> type[ForceLaw]:
    """The class around a law that stands in a module, or around one that is made by a call."""
    return AROUND[kind](made_by[0](*made_by[1]) if law is None else law)

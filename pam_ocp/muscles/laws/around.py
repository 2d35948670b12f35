"""Laws around a law: a bladder that must be filled before it pulls, ends that do not contract.

Each makes a class of laws of another one; its coefficients stand behind those of the law inside,
and it is known by a name in which both stand, such as "six-parameter+bladder".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from ...core.arguments import with_kinds
from ...core.errors import InputError
from ..law import ForceLaw, clamp, coefficient
from .made import copied_fields, made_law

__all__ = ["AROUND", "bladder_law", "ends_law", "with_bladder", "with_ends"]

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
    return made_law(
        f"{law.__name__}{kind.capitalize()}",
        {**copied_fields(law), **more},
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

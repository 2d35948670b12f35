"""Muscle: a force law with the geometry and the ranges of one real muscle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import casadi as ca
import numpy as np

from ..errors import InputError, require_positive
from .force import SLACK_WIDTH, FloatOrSX, ForceLaw, clamp, evaluate

__all__ = ["Muscle"]


@dataclass(frozen=True)
class Muscle:
    """A pneumatic artificial muscle.

    Parameters
    ----------
    law : force law with its coefficients.
    rest_length : length of the active membrane at zero pressure and load, l0 [m].
    diameter : inner diameter at rest [m], or None when it is not known.
    slack_width : half width of the smooth clamp at zero force [N]; see :func:`force.clamp`.
    pressure_range, contraction_range : where the law was measured ([Pa gauge], [1]).
    name, source, note : what it is, where its numbers come from, what to know before use.

    ``rest_length`` and ``slack_width`` may be CasADi symbols inside a plant.
    """

    law: ForceLaw
    rest_length: FloatOrSX
    diameter: float | None = None
    slack_width: FloatOrSX = SLACK_WIDTH
    pressure_range: tuple[float, float] = (0.0, 6e5)
    contraction_range: tuple[float, float] = (0.0, 0.25)
    name: str = "muscle"
    source: str = ""
    note: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.law, ForceLaw):
            raise InputError(f"law = {self.law!r} must be a ForceLaw, such as SixParameterLaw(...)")
        for argument, unit in (("rest_length", "m"), ("slack_width", "N")):
            if not isinstance(getattr(self, argument), ca.SX):
                require_positive(argument, getattr(self, argument), unit)
        if self.diameter is not None:
            require_positive("diameter", self.diameter, "m")
        for argument in ("pressure_range", "contraction_range"):
            low, high = getattr(self, argument)
            if not low < high:
                raise InputError(f"{argument} = ({low:g}, {high:g}): the lower end must be the smaller")

    # ---- force and stiffness ---------------------------------------------------------------
    def tension(self, p: Any, kappa: Any) -> Any:
        """The law without clamp [N] at gauge pressure p [Pa] and contraction kappa."""
        return self.law.tension(p, kappa)

    def force(self, p: Any, kappa: Any) -> Any:
        """Pulling force [N], >= 0: the law with the smooth clamp. Arrays broadcast."""
        return self._evaluate(0, p, kappa)

    def stiffness(self, p: Any, kappa: Any) -> Any:
        """Stiffness at constant pressure -(1/l0) dF/dkappa [N/m], positive when taut.

        Eq. (4) of the source paper with its missing minus sign: dl = -l0 dkappa.
        """
        return self._evaluate(1, p, kappa)

    def pressure(self, force: Any, kappa: Any) -> Any:
        """Gauge pressure [Pa] at which the muscle pulls with ``force`` [N] at ``kappa`` (taut)."""
        return self.law.pressure(force, kappa)

    def blocked_force(self, p: Any) -> Any:
        """Force at rest length [N]."""
        return self.force(p, 0.0)

    def max_contraction(self, p: float) -> float:
        """Contraction at which the unloaded muscle goes slack at pressure p [Pa].

        NaN when it is slack everywhere between kappa = 0 and 0.45.
        """
        grid = np.linspace(0.0, 0.45, 451)
        tension = np.asarray(self.law.tension(p, grid))
        if tension[0] <= 0:
            return float("nan")
        slack = np.nonzero(tension <= 0)[0]
        if not slack.size:
            return float("nan")
        low, high = grid[slack[0] - 1], grid[slack[0]]
        while high - low > 1e-14:  # bisection: the bracket holds exactly one sign change
            middle = (low + high) / 2
            if self.law.tension(p, middle) > 0:
                low = middle
            else:
                high = middle
        return float((low + high) / 2)

    def _evaluate(self, index: int, p: Any, kappa: Any) -> Any:
        rest = [*self.law.values.values(), self.rest_length, self.slack_width]
        return evaluate(_clamped(type(self.law)), index, p, kappa, rest)

    # ---- in a plant --------------------------------------------------------------------------
    def substituted(self, symbol: Callable[[str, Any], Any]) -> Muscle:
        """The same muscle with every physical constant replaced by ``symbol(name, value)``."""
        return replace(
            self,
            law=self.law.substituted(symbol),
            rest_length=symbol("rest_length", self.rest_length),
            slack_width=symbol("slack_width", self.slack_width),
        )


@cache
def _clamped(law: type[ForceLaw]) -> ca.Function:
    """(p, kappa, [coefficients, l0, width]) -> (force, stiffness) of the clamped law."""
    p, kappa = ca.SX.sym("p"), ca.SX.sym("kappa")
    coefficients = ca.SX.sym("coefficients", law.function().size1_in(2))
    rest_length, width = ca.SX.sym("l0"), ca.SX.sym("width")
    force = clamp(law.function()(p, kappa, coefficients)[0], width)
    stiffness = -ca.jacobian(force, kappa) / rest_length
    return ca.Function(
        f"clamped_{law.__name__}",
        [p, kappa, ca.vertcat(coefficients, rest_length, width)],
        [force, stiffness],
    )

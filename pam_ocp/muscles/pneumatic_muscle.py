"""Muscle: a force law with the geometry and the ranges of one real muscle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import casadi as ca
import numpy as np

from .. import courtesy
from ..core.errors import (
    InputError,
    require_count,
    require_ends,
    require_finite,
    require_numbers,
    require_positive,
    with_kinds,
)
from ..core.quantities import doubt
from ..core.shown import shown
from ..core.stop import locked, turns
from .law import CONTRACTIONS, SLACK_WIDTH, FloatOrSX, ForceLaw, at_point, clamp, evaluate
from .validity import Validity, warn_beyond

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@shown
@locked
@dataclass(frozen=True)
class Muscle:
    """A pneumatic artificial muscle.

    Parameters
    ----------
    law : force law with its coefficients.
    rest_length : length of the active membrane at zero pressure and load, l0 [m].
        A law that holds a rest length of its own must hold the same one.
    diameter : inner diameter at rest [m], or None when it is not known.
    slack_width : half width of the smooth clamp at zero force [N]; see :func:`force.clamp`.
    pressure_range, contraction_range : where the law was measured ([Pa gauge], [1]).
        Numbers outside give a ValidityWarning, once for each muscle.
    name, source, note : what it is, where its numbers come from, what to know before use.
    mass : mass of the muscle [kg], or None; for energy and power per mass. By default that of its
        body, where this is given.
    mass_per_length, end_mass : of the muscle's body [kg/m], and of both its ends together [kg]; the
        body then moves along in plants, half of it (see :attr:`body_mass`). 0: no body.
    burst_pressure : [Pa] at which the tube bursts, or None. pull_off : force [N] that pulls the
        ends off, or None. Plans stay below both (the path constraints ``<name>.to_burst`` and
        ``<name>.to_pull_off``); numbers beyond give a ValidityWarning, once for each muscle.
    construction : "braided", "netted" or "embedded", the classes of the source paper, or "".
    obtained : "published", "transcribed" or "fitted here", or "".

    ``rest_length`` and ``slack_width`` may be CasADi symbols inside a plant.

    Examples
    --------
    >>> mine = pam.Muscle(fit.law, rest_length=0.300, diameter=0.020, name="M1")
    >>> print(f"{mine.force(3e5, 0.10):.0f} N, {mine.stiffness(3e5, 0.10):.0f} N/m")
    234 N, 9001 N/m
    >>> print(f"{mine.max_contraction(6e5):.3f}")
    0.248
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
    mass: float | None = None
    construction: str = ""
    obtained: str = ""
    mass_per_length: float = 0.0
    end_mass: float = 0.0
    burst_pressure: float | None = None
    pull_off: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.law, ForceLaw):
            raise InputError(f"law = {self.law!r} must be a ForceLaw, such as SixParameterLaw(...)")
        for argument, unit in (
            ("rest_length", "m"),
            ("slack_width", "N"),
            ("diameter", "m"),
            ("mass", "kg"),
            ("burst_pressure", "Pa"),
            ("pull_off", "N"),
        ):
            value = getattr(self, argument)
            required = argument in ("rest_length", "slack_width")
            if (value is not None or required) and not isinstance(value, ca.SX):
                number = require_positive(argument, value, unit)
                doubt(argument, number, unit)
                object.__setattr__(self, argument, number)
        for argument in ("mass_per_length", "end_mass"):
            unit = "kg/m" if argument == "mass_per_length" else "kg"
            number = require_positive(argument, getattr(self, argument), unit, zero=True)
            object.__setattr__(self, argument, number)
        own = self.law.values.get("rest_length", self.rest_length)
        symbolic = isinstance(own, ca.SX) or isinstance(self.rest_length, ca.SX)
        if not symbolic and not math.isclose(own, self.rest_length, rel_tol=1e-12):
            raise InputError(
                f"rest_length = {self.rest_length:g} m, but the {self.law.name} law holds "
                f"{own:g} m; give both the same, or use Muscle.with_rest_length"
            )
        for argument, unit in (("pressure_range", "Pa"), ("contraction_range", "1")):
            allowed = CONTRACTIONS if unit == "1" else (-math.inf, math.inf)
            low, high = (
                require_numbers(argument, require_finite(argument, end, unit), unit, *allowed)
                for end in require_ends(argument, getattr(self, argument), unit)
            )
            object.__setattr__(self, argument, (low, high))
        doubt("pressure_range", self.pressure_range[1], "Pa")

    @property
    def body_mass(self) -> FloatOrSX:
        """Rest length x mass per length + ends [kg].

        One end of the muscle is fixed, the other moves with the load: half of this mass moves.
        """
        return self.rest_length * self.mass_per_length + self.end_mass

    @property
    def known_mass(self) -> float | None:
        """``mass``, or that of the body; None where neither is given [kg]."""
        body = self.body_mass
        return self.mass if self.mass is not None or not body else float(body)

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
        found = self.law.pressure(force, kappa)
        if not isinstance(found, (ca.SX, ca.MX)):
            known = np.asarray(found)[np.isfinite(found)]
            self._measured.check(f"muscle {self.name!r}", known, ())
        return found

    def blocked_force(self, p: Any) -> Any:
        """Force at rest length [N]."""
        return self.force(p, 0.0)

    def max_contraction(self, p: Any) -> Any:
        """Contraction at which the unloaded muscle goes slack at pressure p [Pa].

        NaN when it is slack already at rest length, or taut up to 0.45.
        """
        return self.law.max_contraction(p)

    def with_rest_length(self, rest_length: float) -> Muscle:
        """The same muscle with another rest length [m], also in a law that holds it."""
        rest_length = require_positive("rest_length", rest_length, "m")
        law = self.law
        if "rest_length" in law.values:
            law = law.substituted(lambda n, v: rest_length if n == "rest_length" else v)
        return replace(self, law=law, rest_length=rest_length)

    def plot(self, *, ax: Axes | None = None) -> Any:
        """Force and stiffness over contraction, one line per pressure, where it was measured.

        ax : draw the force into this panel instead.
        """
        return courtesy.plot_muscle(self, ax=ax)

    def plot_surface(
        self, quantity: Literal["force", "stiffness"] = "force", *, interactive: bool = False
    ) -> Any:
        """Force or stiffness over contraction and pressure, in 3D.

        interactive : by plotly (needs the extra ``interactive``), instead of matplotlib.
        """
        return courtesy.plot_surface(self, quantity, interactive=interactive)

    def _brief(self) -> str:
        if isinstance(self.rest_length, ca.SX):
            return f"{self.name}: {self.law.title}"
        return f"{self.name}: {self.law.title}, rest length {1e3 * self.rest_length:g} mm"

    def _evaluate(self, index: int, p: Any, kappa: Any) -> Any:
        p, kappa = at_point(p, kappa)
        rest = [*self.law.values.values(), self.rest_length, self.slack_width]
        if not any(isinstance(a, (ca.SX, ca.MX)) for a in (p, kappa, *rest)):
            self.law.validity.check(f"{self.law.name} law", p, kappa)
            self._measured.check(f"muscle {self.name!r}", p, kappa)
        found = evaluate(_clamped(type(self.law)), index, p, kappa, rest)
        if not isinstance(found, (ca.SX, ca.MX)):
            self._check_strength(p, found if index == 0 else None)
        return found

    def _check_strength(self, p: Any, force: Any) -> None:
        """Warn, once, where numbers are beyond what the muscle bears."""
        if self.burst_pressure is not None:
            subject = f"strength of muscle {self.name!r}"
            warn_beyond(subject, "pressure", p, self.burst_pressure, "Pa", "its tube gives")
        if self.pull_off is not None and force is not None:
            subject = f"strength of muscle {self.name!r}"
            warn_beyond(subject, "force", force, self.pull_off, "N", "its ends give")

    @property
    def _measured(self) -> Validity:
        return Validity(self.pressure_range, self.contraction_range, "outside what was measured")

    # ---- in a plant --------------------------------------------------------------------------
    def substituted(self, symbol: Callable[[str, Any], Any]) -> Muscle:
        """The same muscle with every physical constant replaced by ``symbol(name, value)``."""
        rest_length = symbol("rest_length", self.rest_length)
        return replace(
            self,
            law=self.law.substituted(
                lambda n, v: rest_length if n == "rest_length" else symbol(n, v)
            ),
            rest_length=rest_length,
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
        ["p", "kappa", "constants"],
        ["force", "stiffness"],
    )


# ---- equal muscles side by side ------------------------------------------------------------------
ACROSS = ("radius", "rest_diameter", "wall")
"""Coefficients that are lengths across the muscle."""
PROBES = (np.array([1e5, 3e5, 5e5]), np.array([0.02, 0.11, 0.19]))
"""Pressures and contractions at which a law is looked at."""


@with_kinds
@turns
def in_parallel(muscle: Muscle, count: int) -> Muscle:
    """``count`` equal muscles side by side on the same load, as one muscle.

    Forces, masses, volume and so the air that is needed are ``count`` times those of one; ranges
    and rest length stay. It has the diameter of one tube with their cross-section, so that every
    Volume is scaled with it. Dead volume, valves and losses are those that the plant is given: of
    all together.

    Raises InputError where a law cannot be scaled by its coefficients (one of your own).

    Examples
    --------
    >>> two = pam.muscles.in_parallel(muscle, 2)
    >>> bool(np.isclose(two.law.tension(3e5, 0.1), 2 * muscle.law.tension(3e5, 0.1)))
    True
    """
    require_count("count", count)
    if count == 1:
        return muscle
    return replace(
        muscle,
        law=_scaled(muscle.law, count),
        diameter=None if muscle.diameter is None else math.sqrt(count) * muscle.diameter,
        slack_width=count * muscle.slack_width,
        mass=_times(count, muscle.mass),
        mass_per_length=count * muscle.mass_per_length,
        end_mass=count * muscle.end_mass,
        pull_off=_times(count, muscle.pull_off),
        name=f"{count} x {muscle.name}",
    )


def _times(count: int, value: float | None) -> float | None:
    return None if value is None else count * value


def _scaled(law: ForceLaw, count: int) -> ForceLaw:
    """The law of ``count`` times the force: forces and cross-sections among its coefficients."""
    units = {v.name: v.unit for v in law.coefficient_variables()}

    def factor(name: str, value: Any) -> Any:
        if units[name].startswith("N"):
            return count * value
        return math.sqrt(count) * value if name in ACROSS else value

    scaled = law.substituted(factor)
    p, kappa = (a.ravel() for a in np.meshgrid(*PROBES))
    one, many = (
        evaluate(part.function(), 0, p, kappa, [*part.values.values()]) for part in (law, scaled)
    )
    if not np.allclose(many, count * one, rtol=1e-9, atol=1e-9 * float(np.abs(one).max())):
        raise InputError(
            f"law {law.name!r}: its coefficients in N do not scale the force; build the muscle of "
            f"{count} with a law of its own"
        )
    return scaled

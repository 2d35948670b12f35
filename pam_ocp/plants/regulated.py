"""A load on one muscle whose pressure is fed back from its position: an active element."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from ..core.errors import require_finite, require_positive
from ..core.system import Declares, Scope
from ..muscles.law import clamp
from ..muscles.pneumatic_muscle import Muscle
from .damping import Damping, Loss
from .hanging import HangingLoad
from .kinds import FEEDS, PLANTS
from .regulator import pressure_attributes


@FEEDS.register(
    units={
        "gain": "Pa/m",
        "derivative_gain": "Pa.s/m",
        "lag": "s",
        "max_pressure": "Pa",
        "rounding": "Pa",
    }
)
@dataclass(frozen=True)
class PositionFeedback:
    """Position feedback: a regulator follows the muscle's shortening s = kappa l0 with a lag.

    lag p' = u - p,  u = set pressure + gain (reference - s) - derivative_gain s',
    held within 0 .. ``max_pressure``.

    gain : [Pa/m]. derivative_gain : [Pa.s/m].
    lag : time constant of the regulator [s].
    max_pressure : the largest pressure that the regulator gives [Pa]; by default the end of the
        muscle's measured range.
    rounding : half width [Pa] of the rounded ends of the command's range; between them the command
        is exactly linear.
    totals : see :class:`Regulator`.

    Declares the state ``<name>.pressure``, the inputs ``<name>.set_pressure`` and
    ``<name>.reference`` [m], the output ``<name>.command``, and all of the above as parameters.

    Examples
    --------
    >>> followed = pam.HangingLoad(muscle, 10.0, feed=pam.plants.PositionFeedback(gain=5e5))
    >>> [v.name for v in followed.inputs]
    ['muscle.set_pressure', 'muscle.reference']
    """

    gain: float = 1e6
    derivative_gain: float = 0.0
    lag: float = 0.1
    max_pressure: float | None = None
    rounding: float = 2e4
    totals: bool = False

    def __post_init__(self) -> None:
        require_finite("PositionFeedback.gain", self.gain, "Pa/m")
        require_finite("PositionFeedback.derivative_gain", self.derivative_gain, "Pa.s/m")
        require_positive("PositionFeedback.lag", self.lag, "s")
        require_positive("PositionFeedback.rounding", self.rounding, "Pa")
        if self.max_pressure is not None:
            require_positive("PositionFeedback.max_pressure", self.max_pressure, "Pa")

    def connect(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> ca.SX:
        """Declare the loop; return the gauge pressure [Pa]."""
        attributes = pressure_attributes(muscle, self.max_pressure)
        top = attributes["max"]
        scope = Scope(plant, name)
        pressure = scope.of(**attributes).state("pressure", f"gauge pressure in {name}")
        middle = scope.of(**attributes).input(
            "set_pressure", f"commanded gauge pressure of {name} at its reference"
        )
        reference = scope.of("m", 0.01).input(
            "reference", f"shortening of {name} at which the set pressure is commanded"
        )
        slope = self.derivative_gain
        gain, derivative_gain, lag, largest, rounding = (
            scope.of(
                unit, nominal, min=low, display_unit=unit.replace("Pa", "bar"), tunable=True
            ).parameter(key, value, f"{words} ({name})")
            for key, value, unit, low, nominal, words in (
                ("gain", self.gain, "Pa/m", -math.inf, 1e6, "feedback of position"),
                ("derivative_gain", slope, "Pa.s/m", -math.inf, 1e5, "feedback of velocity"),
                ("lag", self.lag, "s", 1e-6, 0.1, "time constant of the regulator"),
                ("max_pressure", top, "Pa", 1.0, 1e5, "largest pressure of the regulator"),
                ("rounding", self.rounding, "Pa", 1.0, 1e4, "rounding of the command's ends"),
            )
        )
        length = muscle.rest_length
        wanted = (
            middle + gain * (reference - contraction * length) - derivative_gain * rate * length
        )
        command = clamp(wanted, rounding) - clamp(wanted - largest, rounding)
        plant.der(pressure, (command - pressure) / lag)
        scope.of("Pa", 1e5).output("command", command, f"commanded gauge pressure of {name}")
        return pressure


@PLANTS.register(
    units={
        "mass": "kg",
        "gain": "Pa/m",
        "derivative_gain": "Pa.s/m",
        "lag": "s",
        "max_pressure": "Pa",
    }
)
class RegulatedLoad(HangingLoad):
    """A hanging load whose pressure is fed back from its position through a regulator with a lag.

    m x'' + c x' = F(p, kappa) - m g and lag p' = set pressure + gain (reference - x)
    - derivative_gain x' - p, the command held within 0 .. max_pressure. The feedback brings
    in energy, so beyond a border over (gain, lag) the rest position is unstable and the load
    vibrates by itself: at constant pressure it never could (see :mod:`pam_ocp.vibration`).
    With F_p = dF/dp and k the muscle's stiffness at rest the characteristic polynomial is

        m lag s^3 + (m + c lag) s^2 + (c + k lag + F_p derivative_gain) s + k + F_p gain.

    Parameters
    ----------
    muscle : the muscle, or its name in the catalogue; its rest length sets the stroke.
    mass : load [kg].
    gain, derivative_gain, lag, max_pressure, totals : see :class:`PositionFeedback`.
    damping : ``StiffnessDamping(ratio)`` (default 0.1), ``ConstantDamping(value)`` or just its
        value.
    losses : friction, hysteresis, creep of the muscle, as ``(CoulombFriction(), Creep())``.

    States x [m] (upwards), v [m/s], muscle.pressure [Pa]; inputs muscle.set_pressure [Pa] and
    muscle.reference [m]; so an equilibrium takes two conditions.

    Examples
    --------
    >>> regulated = pam.RegulatedLoad(muscle, mass=10.0, gain=5e5)
    >>> rest = regulated.equilibrium({"x": 0.04, "muscle.reference": 0.04})
    >>> rest.stability
    'stable'
    """

    def __init__(
        self,
        muscle: Muscle | str,
        mass: float = 20.0,
        *,
        gain: float = 1e6,
        derivative_gain: float = 0.0,
        lag: float = 0.1,
        max_pressure: float | None = None,
        damping: Damping | float | None = None,
        losses: Loss | Sequence[Loss] = (),
        totals: bool = False,
        name: str = "regulated_load",
    ) -> None:
        feedback = PositionFeedback(gain, derivative_gain, lag, max_pressure, totals=totals)
        super().__init__(muscle, mass, damping=damping, feed=feedback, losses=losses, name=name)
        self.description = "a hanging load on a muscle with pressure fed back from its position"

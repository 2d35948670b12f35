"""Heat between the air in a muscle and its wall: transfer coefficients, and the rubber's own
temperature.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core.errors import require_finite, require_positive
from .gas import HEATS, REFERENCE_TEMPERATURE, RUBBERS, Declare, HeatTransfer

__all__ = ["ConstantHeatTransfer", "HeatTransfer", "PressureHeatTransfer", "Rubber"]


def _declared(value: float, declare: Declare, words: str) -> Any:
    return declare(
        "heat_transfer",
        value,
        unit="W/(m2.K)",
        min=0.0,
        nominal=10.0,
        description=words,
    )


@HEATS.register(units={"value": "W/(m2.K)"})
@dataclass(frozen=True)
class ConstantHeatTransfer:
    """h = value: a constant coefficient of heat transfer; 0 adiabatic, large isothermal.

    value : [W/(m2.K)]. Some 10 to 100 are usual for air in cylinders; the default is our choice.

    Examples
    --------
    >>> air = pam.gas.Gas(heat=pam.muscles.ConstantHeatTransfer(30.0))
    >>> warm = pam.HangingLoad(muscle, feed=pam.feeds.SpoolValve(gas=air))
    >>> warm.variable("muscle.temperature").start
    293.15
    """

    value: float = 30.0

    def __post_init__(self) -> None:
        require_positive("ConstantHeatTransfer.value", self.value, "W/(m2.K)", zero=True)

    def coefficient(self, absolute: ca.SX, temperature: ca.SX, declare: Declare) -> ca.SX:
        """See :class:`HeatTransfer`."""
        return ca.SX(_declared(self.value, declare, "coefficient of heat transfer to the wall"))


@HEATS.register(units={"value": "W/(m2.K)", "pressure": "Pa"})
@dataclass(frozen=True)
class PressureHeatTransfer:
    """h = value [p T/(p0 T0)]^exponent: heat transfer rises with density.

    value : [W/(m2.K)] at ``pressure`` p0 [Pa absolute] and T0 = 293.15 K. exponent : 0.5 by
        default, the form after Eichelberg that is in use for pneumatic cylinders (its figures for
        muscles are not known to us: identify value).

    Examples
    --------
    >>> air = pam.gas.Gas(heat=pam.muscles.PressureHeatTransfer(30.0))
    >>> warm = pam.HangingLoad(muscle, feed=pam.feeds.SpoolValve(gas=air))
    >>> "muscle.temperature" in [v.name for v in warm.states]
    True
    """

    value: float = 30.0
    exponent: float = 0.5
    pressure: float = 101325.0

    def __post_init__(self) -> None:
        require_positive("PressureHeatTransfer.value", self.value, "W/(m2.K)", zero=True)
        require_finite("PressureHeatTransfer.exponent", self.exponent)
        require_positive("PressureHeatTransfer.pressure", self.pressure, "Pa")

    def coefficient(self, absolute: ca.SX, temperature: ca.SX, declare: Declare) -> ca.SX:
        """See :class:`HeatTransfer`."""
        h = _declared(self.value, declare, "coefficient of heat transfer at the pressure of rest")
        power = declare(
            "heat_exponent",
            self.exponent,
            min=-2.0,
            max=2.0,
            description="exponent of the coefficient of heat transfer over pressure x temperature",
        )
        relative = absolute * temperature / (self.pressure * REFERENCE_TEMPERATURE)
        return ca.SX(h * ca.fmax(relative, 1e-6) ** power)


@RUBBERS.register(
    units={"capacity": "J/K", "outward": "W/K", "stiffening": "1/K", "reference": "K"}
)
@dataclass(frozen=True)
class Rubber:
    """The membrane as a thermal mass: C T' = h A (T_air - T) - G (T - T_outside) + warming P_loss.

    capacity : C [J/K], mass times some 1.7 kJ/(kg.K). outward : G [W/K], to the surroundings.
    stiffening : part by which the law's force at zero pressure grows per kelvin above
        ``reference``, F = F_law(p, kappa) + stiffening (T - reference) F_law(0, kappa) [1/K]; 0 by
        default (no effect). Only the wall's own force changes: what the pressure does is geometry.
    reference : temperature at which the law was measured [K].
    warming : part of the power of the muscle's losses (friction, hysteresis) that warms the rubber.

    The muscle gets the state ``<name>.rubber_temperature``. One temperature for the whole wall and
    one number for its effect are our reconstruction: a law to be fitted.

    Examples
    --------
    >>> heat = pam.muscles.ConstantHeatTransfer(30.0)
    >>> air = pam.gas.Gas(heat=heat, rubber=pam.muscles.Rubber(capacity=100.0))
    >>> warm = pam.HangingLoad(muscle, feed=pam.feeds.SpoolValve(gas=air))
    >>> "muscle.rubber_temperature" in [v.name for v in warm.states]
    True
    """

    capacity: float = 100.0
    outward: float = 0.3
    stiffening: float = 0.0
    reference: float = REFERENCE_TEMPERATURE
    warming: float = 1.0

    def __post_init__(self) -> None:
        require_positive("Rubber.capacity", self.capacity, "J/K")
        require_positive("Rubber.outward", self.outward, "W/K", zero=True)
        require_positive("Rubber.reference", self.reference, "K")
        require_finite("Rubber.stiffening", self.stiffening, "1/K")
        require_positive("Rubber.warming", self.warming, zero=True)

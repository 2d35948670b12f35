"""Air in a muscle: the volume it fills, how its pressure changes, how it flows.

The one room with absolute pressures; their names say so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import casadi as ca
import numpy as np

from ..core.errors import (
    InputError,
    broadcast,
    require_finite,
    require_numbers,
    require_positive,
    with_kinds,
)
from ..core.expressions import polynomial
from ..core.quantities import is_quantity
from ..core.registry import Registry
from ..core.stop import turns
from .law import CONTRACTIONS, FloatOrSX, at_point, over_arrays
from .pneumatic_muscle import Muscle

__all__ = [
    "AMBIENT_PRESSURE",
    "BraidVolume",
    "ConsistentVolume",
    "Gas",
    "HeatTransfer",
    "PolynomialVolume",
    "Volume",
    "air_mass",
    "closed_stiffness",
    "conductance_from_flow",
    "iso6358",
    "muscle_volume",
    "specific_exergy",
]

GAS_CONSTANT = 287.05
"""Dry air [J/(kg K)]."""
ADIABATIC_EXPONENT = 1.4
"""Of air, cp/cv."""
HEAT_CAPACITY = GAS_CONSTANT * ADIABATIC_EXPONENT / (ADIABATIC_EXPONENT - 1)
"""cp of air [J/(kg K)]."""
AMBIENT_PRESSURE = 101325.0
"""Standard atmosphere [Pa absolute]."""
REFERENCE_TEMPERATURE = 293.15
"""T0 of ISO 6358 [K]."""
REFERENCE_DENSITY = 1.185
"""rho0 of ISO 6358 [kg/m3]: air at 1 bar absolute and T0."""
LEAST = 1e-9
"""Of what must be above zero, in SI."""
LARGEST_RATIO = 0.99
"""Of critical pressure ratios."""
LAMINAR_RATIO = 0.999
"""Above this ratio of pressures the flow is linear in their difference."""

Declare = Callable[..., Any]
"""declare(name, value, **attributes of a Variable) -> symbol of a parameter, or the value itself.
"""


def _number(name: str, value: float, **_: Any) -> float:
    return value


# ---- volume --------------------------------------------------------------------------------


class Volume(Protocol):
    """The volume that the gas fills in a muscle, over its contraction.

    Examples
    --------
    >>> volume: pam.gas.Volume = pam.gas.ConsistentVolume(diameter=0.020)
    >>> pam.gas.Gas(volume=volume).volume
    ConsistentVolume(diameter=0.02)
    """

    def filled(self, muscle: Muscle, kappa: ca.SX, declare: Declare) -> ca.SX:
        """Volume [m3] at contraction kappa, without dead volume; ``declare`` makes parameters."""


VOLUMES: Registry[Callable[..., Volume]] = Registry("volume", __package__, argument="volume")
GASES: Registry[Callable[..., Gas]] = Registry("gas", __package__, argument="gas")
HEATS: Registry[Callable[..., Any]] = Registry("heat transfer", __package__, argument="heat")
RUBBERS: Registry[Callable[..., Any]] = Registry("rubber", __package__, argument="rubber")


class HeatTransfer(Protocol):
    """How well heat passes between the air in a muscle and the inside of its wall.

    Examples
    --------
    >>> heat: pam.gas.HeatTransfer = pam.muscles.ConstantHeatTransfer(30.0)
    >>> pam.gas.Gas(heat=heat).heat
    ConstantHeatTransfer(value=30.0)
    """

    def coefficient(self, absolute: ca.SX, temperature: ca.SX, declare: Declare) -> ca.SX:
        """h [W/(m2.K)] at the air's absolute pressure [Pa] and temperature [K]."""


def _diameter(muscle: Muscle, own: float | None, declare: Declare) -> FloatOrSX:
    value = muscle.diameter if own is None else own
    if value is None:
        raise InputError(
            f"muscle {muscle.name!r} has no diameter, so its volume is not known; "
            "give Muscle(..., diameter=) or the volume's own diameter= [m]"
        )
    declared: FloatOrSX = declare(
        "diameter", value, unit="m", min=1e-5, nominal=1e-2, description="inner diameter at rest"
    )
    return declared


@VOLUMES.register(units={"diameter": "m"})
@dataclass(frozen=True)
class ConsistentVolume:
    """V = V0 + l0 integral_0^kappa G dkappa, with G = dF/dp: consistent with the force law.

    From virtual work, dF/dp = -dV/dl; V0 = pi d^2 l0/4 is the one free constant. With this volume
    a muscle and its gas are passive, with any other one they are not. For laws affine in
    pressure; others raise InputError. That a fitted law's G be used so is our inference.

    diameter : inner diameter at rest [m]; by default the muscle's.

    Examples
    --------
    >>> volume = pam.gas.muscle_volume(muscle, 0.0, pam.gas.ConsistentVolume())
    >>> bool(abs(volume - np.pi * 0.010**2 * 0.300) < 1e-9)
    True
    """

    diameter: float | None = None

    def filled(self, muscle: Muscle, kappa: ca.SX, declare: Declare) -> ca.SX:
        rest = math.pi / 4 * _diameter(muscle, self.diameter, declare) ** 2 * muscle.rest_length
        return ca.SX(rest + muscle.rest_length * muscle.law.gain_area(kappa))


@VOLUMES.register(units={"angle": "rad", "diameter": "m"})
@dataclass(frozen=True)
class BraidVolume:
    """V = pi r0^2 l0 (1-kappa) [1 - cos^2(alpha0) (1-kappa)^2] / sin^2(alpha0).

    A cylinder in fibres of constant length; consistent with the geometric law and no other.

    angle : braid angle at rest alpha0 [rad]; the default is that of a DMSP-20 (24.42 degrees).
    diameter : inner diameter at rest [m]; by default the muscle's.

    Examples
    --------
    >>> braid = pam.gas.BraidVolume()
    >>> volume = pam.gas.muscle_volume(muscle, np.array([0.0, 0.2]), braid)
    >>> bool(volume[1] > volume[0])
    True
    """

    angle: float = math.radians(24.42)
    diameter: float | None = None

    def __post_init__(self) -> None:
        if not 0 < require_finite("BraidVolume.angle", self.angle, "rad") < math.pi / 2:
            raise InputError(f"BraidVolume.angle = {self.angle:g} rad must lie in 0 .. pi/2")

    def filled(self, muscle: Muscle, kappa: ca.SX, declare: Declare) -> ca.SX:
        angle = declare(
            "braid_angle",
            self.angle,
            unit="rad",
            min=1e-3,
            max=1.57,
            nominal=0.5,
            description="braid angle at rest",
        )
        rest = math.pi / 4 * _diameter(muscle, self.diameter, declare) ** 2 * muscle.rest_length
        length = 1 - kappa
        return ca.SX(rest * length * (1 - ca.cos(angle) ** 2 * length**2) / ca.sin(angle) ** 2)


@VOLUMES.register(units={"coefficients": "m3"})
@dataclass(frozen=True)
class PolynomialVolume:
    """V = v0 + v1 kappa + v2 kappa^2 + ... [m3], as fitted to a measurement of the volume.

    Examples
    --------
    >>> measured = pam.gas.PolynomialVolume([1e-4, 3e-4])
    >>> print(f"{pam.gas.muscle_volume(muscle, 0.1, measured):.2e} m3")
    1.30e-04 m3
    """

    coefficients: Sequence[float]

    def __post_init__(self) -> None:
        values = tuple(require_finite("PolynomialVolume", v, "m3") for v in self.coefficients)
        if not values or values[0] <= 0:
            raise InputError(f"PolynomialVolume: {list(values)}: the first, v0 [m3], must be > 0")
        object.__setattr__(self, "coefficients", values)

    def filled(self, muscle: Muscle, kappa: ca.SX, declare: Declare) -> ca.SX:
        coefficients = [
            declare(
                f"v{i}",
                v,
                unit="m3",
                nominal=1e-4,
                description=f"volume, contraction to the power {i}",
            )
            for i, v in enumerate(self.coefficients)
        ]
        return ca.SX(polynomial(coefficients, kappa))


@with_kinds
@turns
def muscle_volume(muscle: Muscle, kappa: Any, volume: Volume | None = None) -> Any:
    """Volume of the gas [m3] at contraction ``kappa`` (arrays go through); no dead volume.

    volume : ``ConsistentVolume()`` by default.

    Examples
    --------
    >>> print(f"{1e3 * pam.gas.muscle_volume(muscle, 0.20):.2f} l")
    0.20 l
    """
    symbol = ca.SX.sym("kappa")
    expression = (volume or ConsistentVolume()).filled(muscle, symbol, _number)
    values = require_numbers("kappa", kappa, "1", *CONTRACTIONS)
    return over_arrays(ca.Function("volume", [symbol], [ca.SX(expression)]), 0, values)


@with_kinds
def air_mass(absolute: Any, volume: Any, temperature: Any = REFERENCE_TEMPERATURE) -> Any:
    """Mass of the air [kg] at an absolute pressure [Pa] in a volume [m3]: p V/(R T).

    Examples
    --------
    >>> print(f"{1e3 * pam.gas.air_mass(1e5, 1e-3):.2f} g")  # a litre at 1 bar
    1.19 g
    """
    absolute = require_numbers("absolute", absolute, "Pa", 0.0, doubted=True)
    volume = require_numbers("volume", volume, "m3", 0.0, doubted=True)
    temperature = require_numbers("temperature", temperature, "K", LEAST, doubted=True)
    return absolute * volume / (GAS_CONSTANT * temperature)


# ---- gas -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chamber:
    """Expressions of a gas in a plant: total volume [m3], its slope over kappa, constants.

    temperature : of the surroundings [K], and of the gas where it has none of its own.
    area : of the wall that the gas touches [m2].
    """

    volume: ca.SX
    slope: ca.SX
    exponent: ca.SX
    temperature: ca.SX
    ambient: ca.SX
    area: ca.SX

    def pressure_rate(self, absolute: ca.SX, mass_flow: Any, rate: Any) -> ca.SX:
        """dp/dt = n (R T mdot - p_abs dV/dt)/V [Pa/s]; rate = dkappa/dt [1/s]."""
        supplied = GAS_CONSTANT * self.temperature * mass_flow
        return ca.SX(self.exponent * (supplied - absolute * self.slope * rate) / self.volume)


def energy_balance(
    absolute: Any,
    temperature: Any,
    volume: Any,
    volume_rate: Any,
    mass_flow: Any,
    carried: Any,
    heat: Any,
) -> tuple[Any, Any]:
    """(dp/dt [Pa/s], dT/dt [K/s]) of air in a volume [m3] that changes by ``volume_rate`` [m3/s].

    mass_flow : into it [kg/s]. carried : sum of the flows into it, each times the temperature of
    the air that flows [kg.K/s]. heat : flow of heat into it [W].

    From U = cv m T = p V/(g - 1) and dU/dt = cp carried - p dV/dt + heat with p V = m R T:
    dp/dt = [g R carried - g p dV/dt + (g - 1) heat]/V, and dT/T = dp/p + dV/V - dm/m; g = 1.4. An
    ideal gas of one temperature and pressure, without kinetic energy.
    """
    g = ADIABATIC_EXPONENT
    pressing = g * (GAS_CONSTANT * carried - absolute * volume_rate) + (g - 1) * heat
    growing = pressing + absolute * volume_rate - GAS_CONSTANT * temperature * mass_flow
    return pressing / volume, temperature * growing / (absolute * volume)


@GASES.register(units={"dead_volume": "m3", "temperature": "K", "ambient": "Pa"})
@dataclass(frozen=True)
class Gas:
    """The air in a muscle: dp_abs/dt = n (R T mdot - p_abs dV/dt)/V, or by its energy.

    volume : ``ConsistentVolume()`` (default), ``BraidVolume(...)`` or ``PolynomialVolume(...)``.
    dead_volume : of fittings and hose, added at every contraction [m3].
    exponent : polytropic n; 1 isothermal (slow) .. 1.4 adiabatic (fast). The default 1.2 between
        them is our choice.
    temperature : of supply and gas [K]. ambient : [Pa absolute].
    heat : ``ConstantHeatTransfer(...)`` or ``PressureHeatTransfer(...)`` to the wall: the air's
        temperature becomes the state ``<name>.temperature``, by the balance of its energy
        (:func:`energy_balance`), and ``temperature`` is that of the surroundings; the exponent is
        not used. No transfer is n = 1.4 (for venting; what is filled in comes warm), perfect
        transfer n = 1.
    rubber : with heat, the wall's own temperature: ``Rubber(...)``; None holds it at that of the
        surroundings.

    Source: R T mdot = d(p V)/dt for n = 1 and the energy balance without heat for n = 1.4; the
    polytropic form between them is the usual one in pneumatics.

    Examples
    --------
    >>> air = pam.gas.Gas(dead_volume=1e-5, exponent=1.3)
    >>> valves = pam.HangingLoad(muscle, 10.0, feed=pam.feeds.SpoolValve(gas=air))
    >>> valves.variable("muscle.gas.exponent").start
    1.3
    """

    volume: Volume = field(default_factory=ConsistentVolume)
    dead_volume: float = 20e-6
    exponent: float = 1.2
    temperature: float = REFERENCE_TEMPERATURE
    ambient: float = AMBIENT_PRESSURE
    heat: HeatTransfer | None = None
    rubber: Any = None

    def __post_init__(self) -> None:
        if not hasattr(self.volume, "filled"):
            raise InputError(
                f"Gas.volume = {self.volume!r}: give a component, such as ConsistentVolume()"
            )
        if self.heat is not None and not hasattr(self.heat, "coefficient"):
            raise InputError(
                f"Gas.heat = {self.heat!r}: give a component, such as ConstantHeatTransfer(30.0)"
            )
        if self.rubber is not None and self.heat is None:
            raise InputError("Gas.rubber is warmed by the air: give heat=, how heat gets there")
        require_positive("Gas.dead_volume", self.dead_volume, "m3", zero=True)
        require_positive("Gas.temperature", self.temperature, "K")
        require_positive("Gas.ambient", self.ambient, "Pa")
        if not 1 <= require_finite("Gas.exponent", self.exponent) <= 1.67:
            raise InputError(
                f"Gas.exponent = {self.exponent:g} must lie in 1 (isothermal) .. 1.67; air's "
                "adiabatic exponent is 1.4"
            )

    def chamber(self, muscle: Muscle, contraction: Any, declare: Declare = _number) -> Chamber:
        """The gas of a muscle at a contraction; ``declare`` makes parameters of its constants."""
        kappa = ca.SX.sym("kappa")
        filled = ca.SX(self.volume.filled(muscle, kappa, declare))
        dead = declare(
            "dead_volume",
            self.dead_volume,
            unit="m3",
            min=0.0,
            nominal=1e-5,
            description="volume of fittings and hose",
        )
        exponent = self.exponent
        if self.heat is None:
            exponent = declare(
                "exponent", self.exponent, min=1.0, max=1.67, description="polytropic exponent"
            )
        temperature = declare(
            "temperature",
            self.temperature,
            unit="K",
            min=1.0,
            nominal=300.0,
            description="temperature of the air"
            if self.heat is None
            else "temperature of the surroundings",
        )
        ambient = declare(
            "ambient",
            self.ambient,
            unit="Pa",
            min=1.0,
            nominal=1e5,
            description="absolute pressure of the surroundings",
        )
        slope = ca.jacobian(filled, kappa)
        length = muscle.rest_length * (1 - kappa)
        area = 2 * ca.sqrt(math.pi * filled * length)  # of a cylinder of this volume and length
        total, slope, area = (
            ca.substitute(e, kappa, ca.SX(contraction)) for e in (filled + dead, slope, area)
        )
        return Chamber(total, slope, ca.SX(exponent), temperature, ambient, area)


@with_kinds
@turns
def closed_stiffness(muscle: Muscle, p: Any, kappa: Any, gas: Gas | None = None) -> Any:
    """Stiffness with closed valve [N/m]: the gas is compressed, p_abs V^n stays constant.

    k = -(1/l0) [dF/dkappa - dF/dp n p_abs (dV/dkappa)/V], of the law without clamp; arrays
    broadcast. Compare :meth:`Muscle.stiffness`, that at constant pressure.

    Examples
    --------
    >>> bool(pam.gas.closed_stiffness(muscle, 3e5, 0.1) > muscle.stiffness(3e5, 0.1))
    True
    """
    gas = gas or Gas()
    p, kappa = at_point(p, kappa)
    pressure, contraction = ca.SX.sym("p"), ca.SX.sym("kappa")
    chamber = gas.chamber(muscle, contraction)
    tension = muscle.tension(pressure, contraction)
    slopes = [ca.jacobian(tension, z) for z in (contraction, pressure)]
    absolute = pressure + chamber.ambient
    compressed = chamber.exponent * absolute * chamber.slope / chamber.volume
    k = -(slopes[0] - slopes[1] * compressed) / muscle.rest_length
    return over_arrays(
        ca.Function("k", [pressure, contraction], [k], ["p", "kappa"], ["k"]), 0, p, kappa
    )


# ---- flow ---------------------------------------------------------------------------------------


@with_kinds
@turns
def iso6358(
    upstream: Any,
    downstream: Any,
    conductance: Any,
    critical_ratio: Any = 0.3,
    temperature: Any = REFERENCE_TEMPERATURE,
    laminar_ratio: float = LAMINAR_RATIO,
) -> Any:
    """Mass flow [kg/s] through an orifice by ISO 6358, negative when it runs backwards.

    upstream, downstream : absolute pressures [Pa]; floats, arrays or CasADi expressions.
    conductance : sonic conductance C [m3/(s Pa)]; critical_ratio : b.
    temperature : of the air upstream [K].

    mdot = p1 C rho0 sqrt(T0/T1), choked for p2/p1 <= b; above, times
    sqrt(1 - ((p2/p1 - b)/(1 - b))^2). That formula has an infinite derivative at p1 = p2, so for
    p2/p1 > ``laminar_ratio`` the flow is linear in p1 - p2, continuous in value (its slope there
    steps by a factor of about 2) and with one slope through zero.

    Examples
    --------
    >>> choked = pam.gas.iso6358(7e5, 1e5, 2.75e-8)
    >>> print(f"{1e3 * choked:.1f} g/s")
    22.8 g/s
    >>> pam.gas.iso6358(7e5, 2e5, 2.75e-8) == choked
    True
    """
    given = (
        require_numbers("upstream", upstream, "Pa", 0.0, doubted=True),
        require_numbers("downstream", downstream, "Pa", 0.0, doubted=True),
        require_numbers("conductance", conductance, "m3/(s.Pa)", 0.0, doubted=True),
        require_numbers("critical_ratio", critical_ratio, "1", 0.0, LARGEST_RATIO),
        require_numbers("temperature", temperature, "K", LEAST, doubted=True),
        laminar_ratio,
    )
    if not any(isinstance(g, np.ndarray) for g in given):
        return _iso6358(*given)
    names = ("upstream", "downstream", "conductance", "critical_ratio", "temperature", "ratio")
    rows = broadcast(**dict(zip(names, given, strict=True)))
    found = _iso6358(*(ca.DM(row.reshape(1, -1)) for row in rows))
    return np.asarray(found, dtype=float).reshape(rows[0].shape)


def _iso6358(
    upstream: Any,
    downstream: Any,
    conductance: Any,
    critical_ratio: Any,
    temperature: Any,
    laminar_ratio: Any,
) -> Any:
    high, low = ca.fmax(upstream, downstream), ca.fmin(upstream, downstream)
    ratio = ca.fmin(ca.fmax(low / high, critical_ratio), laminar_ratio)
    subsonic = ca.sqrt(1 - ((ratio - critical_ratio) / (1 - critical_ratio)) ** 2)
    # +-p1 outside the laminar section, a straight line through zero within it
    driving = ca.fmax(ca.fmin((upstream - downstream) / (1 - laminar_ratio), high), -high)
    cooling = ca.sqrt(REFERENCE_TEMPERATURE / temperature)
    return driving * conductance * REFERENCE_DENSITY * cooling * subsonic


@with_kinds
def conductance_from_flow(
    flow: float,
    critical_ratio: float = 0.3,
    upstream: float = 7.013e5,
    downstream: float = 6.013e5,
) -> float:
    """Sonic conductance C [m3/(s Pa)] from a catalogue's standard nominal flow qnN [l/min].

    The catalogue's flow is that from 6 to 5 bar gauge (``upstream``, ``downstream`` in Pa
    absolute): C = qnN / (60000 p1 sqrt(1 - ((p2/p1 - b)/(1 - b))^2)). 700 l/min with b = 0.3 give
    2.75e-8. The volume is taken at the reference state of ISO 6358.

    Examples
    --------
    >>> print(f"{pam.gas.conductance_from_flow(700.0):.2e}")
    2.75e-08
    """
    flow = 60e3 * require_positive("flow", flow, "m3/s") if is_quantity(flow) else flow
    flow = require_positive("flow", flow, "l/min")
    critical_ratio = require_finite("critical_ratio", critical_ratio, "1")
    if not 0 <= critical_ratio < 1:
        raise InputError(
            f"critical_ratio = {critical_ratio:g} must lie in 0 .. 1 (usual: 0.2 to 0.5)"
        )
    upstream = require_positive("upstream", upstream, "Pa")
    downstream = require_positive("downstream", downstream, "Pa")
    if not downstream < upstream:
        raise InputError(f"upstream = {upstream:g} Pa must be above downstream = {downstream:g} Pa")
    ratio = max(downstream / upstream, critical_ratio)
    subsonic = math.sqrt(1 - ((ratio - critical_ratio) / (1 - critical_ratio)) ** 2)
    return flow / 60e3 / (upstream * subsonic)


@with_kinds
@turns
def specific_exergy(absolute: Any, ambient: Any, temperature: Any, own: Any = None) -> Any:
    """Work that air at this pressure and ambient temperature can do: R T ln(p/p0) [J/kg].

    own : the air's temperature [K] where it is another one; more by cp (T_own - T - T ln(T_own/T)).

    Examples
    --------
    >>> print(f"{1e-3 * pam.gas.specific_exergy(7e5, 1e5, 293.15):.0f} kJ/kg")  # R T ln 7
    164 kJ/kg
    """
    absolute = require_numbers("absolute", absolute, "Pa", LEAST, doubted=True)
    ambient = require_numbers("ambient", ambient, "Pa", LEAST, doubted=True)
    temperature = require_numbers("temperature", temperature, "K", LEAST, doubted=True)
    exergy = GAS_CONSTANT * temperature * ca.log(absolute / ambient)
    if own is None:
        return exergy
    return exergy + HEAT_CAPACITY * (own - temperature - temperature * ca.log(own / temperature))

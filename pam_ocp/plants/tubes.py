"""Tubes between valve and muscle, and the quick exhaust at their end."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from ..muscles.dead_zone import smooth_step
from ..muscles.gas import GAS_CONSTANT, conductance_from_flow
from .airflow import Air, Place, Stream, between, holding, through
from .kinds import QUICK_EXHAUSTS, TUBES

VISCOSITY = 1.82e-5
"""Of air at 20 degrees Celsius [Pa.s]."""
MEETING = (64 / 0.3164) ** (4 / 3)
"""Reynolds number where the laminar and Blasius' friction are equal: 1187."""

LEAST_PRESSURE = 1e3
"""Of the air whose density is asked for [Pa absolute]: trial steps of integrators go below zero."""


@dataclass(frozen=True)
class Around:
    """What a tube knows of the muscle that it feeds.

    declare : makes parameters. pressure_state : makes a state of gauge pressure by its name.
    """

    name: str
    ambient: ca.SX
    temperature: ca.SX
    exponent: Any
    declare: Callable[..., Any]
    pressure_state: Callable[[str], ca.SX]


class TubeComponent(Protocol):
    """A tube between a valve and a muscle."""

    def port(self, plant: Declares, around: Around, far: Place) -> Place:
        """Declare the tube that ends in ``far``; the place at the valve's end."""


@TUBES.register(units={"volume": "m3", "lag": "s"})
@dataclass(frozen=True)
class Tube:
    """A tube between valve and muscle: a volume, and a first-order lag to the muscle's pressure.

    The flow is linear (laminar) in the difference of pressures, with the resistance at which the
    pressure in the tube settles to the muscle's within ``lag``. Sound is not modelled: for tubes
    of more than a metre the delay of length/343 m/s is missing; :class:`LumpedTube` has it.

    volume : [m3]. lag : time constant [s].

    Examples
    --------
    >>> feed = pam.feeds.SpoolValve(tube=pam.feeds.Tube(volume=2e-5, lag=0.01))
    >>> len(pam.HangingLoad(muscle, feed=feed).states)
    4
    """

    volume: float = 10e-6
    lag: float = 5e-3

    def __post_init__(self) -> None:
        require_positive("Tube.volume", self.volume, "m3")
        require_positive("Tube.lag", self.lag, "s")

    def port(self, plant: Declares, around: Around, far: Place) -> Place:
        """See :class:`TubeComponent`."""
        node = around.pressure_state(f"{around.name}.tube_pressure")
        volume = around.declare(
            "tube_volume", self.volume, "m3", 1e-5, "volume of the tube", min=1e-12
        )
        lag = around.declare("tube_lag", self.lag, "s", 1e-2, "time constant of the tube", min=1e-6)
        per_flow = around.exponent * GAS_CONSTANT * around.temperature / volume  # Pa/s for 1 kg/s
        place, net = holding(plant, Air(node + around.ambient, around.temperature))
        between(place, far, (place.air.absolute - far.air.absolute) / (lag * per_flow))
        plant.der(node, per_flow * net.mass)
        return place


@TUBES.register(units={"length": "m", "diameter": "m"})
@dataclass(frozen=True)
class LumpedTube:
    """A tube of n segments with volume, friction and inertia: acoustic waves.

    Per segment of length dx = length/n, bore A: dp/dt = n_p R T (m_in - m_out)/(A dx), and for the
    flow m out of it towards the muscle dm/dt = (A/dx)(p - p_next - friction). Friction goes from
    the laminar 128 mu dx m/(pi d^4 rho) at small Reynolds numbers to the turbulent after Blasius,
    0.3164 Re^(-1/4) (dx/d) m^2/(2 rho A^2): laminar times [1 + (Re/1187)^4]^(3/16).

    length, diameter : [m], inside. segments : n >= 1, each with two states.
    exponent : polytropic n_p of the air in it; 1.4 gives the speed of sound sqrt(n_p R T), 1 that
        of slow changes in a narrow tube.

    The one-dimensional balance of mass and momentum of the textbooks, lumped (Krichel and Sawodny
    (2014) treat long pneumatic lines; not read, so no form of theirs is claimed). Left out: the
    air's kinetic energy (Mach numbers to some 0.3), frequency-dependent friction, a temperature of
    its own (what leaves it is as warm as the surroundings), a soft wall. The number of segments
    limits what it shows: n segments carry waves to about n/4 per passage time length/343 m/s.

    Examples
    --------
    >>> feed = pam.feeds.SpoolValve(tube=pam.feeds.LumpedTube(2.0, 0.004, segments=2))
    >>> len(pam.HangingLoad(muscle, feed=feed).states)
    7
    """

    length: float = 1.0
    diameter: float = 4e-3
    segments: int = 3
    exponent: float = 1.4

    def __post_init__(self) -> None:
        require_positive("LumpedTube.length", self.length, "m")
        require_positive("LumpedTube.diameter", self.diameter, "m")
        segments = require_finite("LumpedTube.segments", self.segments)
        if segments != int(segments) or not 1 <= segments <= 100:
            raise InputError(f"LumpedTube.segments = {segments:g} must be a whole number 1 .. 100")
        if not 1 <= require_finite("LumpedTube.exponent", self.exponent) <= 1.67:
            raise InputError(f"LumpedTube.exponent = {self.exponent:g} must lie in 1 .. 1.67")

    def port(self, plant: Declares, around: Around, far: Place) -> Place:
        """See :class:`TubeComponent`."""
        length, diameter, exponent = (
            around.declare(key, value, **attributes)
            for key, value, attributes in (
                ("tube_length", self.length, {"unit": "m", "min": 1e-3, "nominal": 1.0}),
                ("tube_diameter", self.diameter, {"unit": "m", "min": 1e-5, "nominal": 1e-3}),
                ("tube_exponent", self.exponent, {"min": 1.0, "max": 1.67}),
            )
        )
        bore, step = math.pi / 4 * diameter**2, length / int(self.segments)
        warm = GAS_CONSTANT * around.temperature
        after = far
        for i in range(int(self.segments), 0, -1):
            node = around.pressure_state(f"{around.name}.tube_pressure{i}")
            flow = (
                Scope(plant, around.name)
                .of("kg/s", 1e-3, memory="settling")
                .state(f"tube_flow{i}", f"air out of segment {i} of the tube of {around.name}")
            )
            place, net = holding(plant, Air(node + around.ambient, around.temperature))
            between(place, after, flow)
            mean = (place.air.absolute + after.air.absolute) / 2
            density = ca.fmax(mean, LEAST_PRESSURE) / warm
            drop = (
                place.air.absolute - after.air.absolute - _friction(flow, density, diameter, step)
            )
            plant.der(node, exponent * warm / (bore * step) * net.mass)
            plant.der(flow, bore / step * drop)
            after = place
        return after


def _friction(flow: ca.SX, density: ca.SX, diameter: Any, length: Any) -> ca.SX:
    """Loss of pressure [Pa] along a piece of tube, with the flow's sign."""
    bore = math.pi / 4 * diameter**2
    reynolds = flow * diameter / (bore * VISCOSITY)
    laminar = 32 * VISCOSITY * length / (diameter**2 * bore * density)
    # f = 64/Re blended with 0.3164 Re^(-1/4), as a factor on the laminar loss: smooth at rest
    turbulent = (1 + (reynolds / MEETING) ** 4) ** (3 / 16)
    return ca.SX(flow * laminar * turbulent)


@QUICK_EXHAUSTS.register(units={"conductance": "m3/(s.Pa)", "threshold": "Pa", "band": "Pa"})
@dataclass(frozen=True)
class QuickExhaust:
    """A quick-exhaust valve at the muscle: opens to ambient when the tube's pressure falls below.

    The opening goes smoothly from 0 to 1 while the muscle's pressure exceeds that at the valve's
    end of the tube by ``threshold`` to ``threshold`` + ``band``.

    conductance, critical_ratio : C [m3/(s.Pa)] and b of ISO 6358, open.
    threshold, band : [Pa]. Their defaults are our choice.

    The lip that shuts the tube while it vents is left out: a little air goes back through the tube.

    Examples
    --------
    >>> vent = pam.feeds.QuickExhaust()
    >>> feed = pam.feeds.SpoolValve(tube=pam.feeds.Tube(), quick_exhaust=vent)
    >>> len(pam.HangingLoad(muscle, feed=feed).states)
    4
    """

    conductance: float = conductance_from_flow(700.0)
    critical_ratio: float = 0.3
    threshold: float = 1e4
    band: float = 2e4

    def __post_init__(self) -> None:
        require_positive("QuickExhaust.conductance", self.conductance, "m3/(s.Pa)")
        require_positive("QuickExhaust.threshold", self.threshold, "Pa", zero=True)
        require_positive("QuickExhaust.band", self.band, "Pa")
        if not 0 <= require_finite("QuickExhaust.critical_ratio", self.critical_ratio) < 1:
            raise InputError(
                f"QuickExhaust.critical_ratio = {self.critical_ratio:g} must lie in 0 .. 1"
            )

    def vent(
        self, declare: Callable[..., Any], muscle: Place, port: Place, outside: Place
    ) -> Stream:
        """Connect it between a muscle and ambient, moved by the pressure at ``port``."""
        words = "sonic conductance of the quick exhaust"
        conductance = declare(
            "quick_conductance", self.conductance, "m3/(s.Pa)", 1e-8, words, min=0.0
        )
        threshold, band = (
            declare(f"quick_{key}", value, "Pa", 1e4, f"{key} of the quick exhaust", min=low)
            for key, value, low in (("threshold", self.threshold, 0.0), ("band", self.band, 1.0))
        )
        excess = muscle.air.absolute - port.air.absolute - threshold
        opening = smooth_step(ca.SX(excess / band))
        return through(muscle, outside, conductance, self.critical_ratio, opening)

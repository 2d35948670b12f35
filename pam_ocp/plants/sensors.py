"""Sensors: what is read off a state or output, as outputs of the plant."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca

from ..core import units
from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, Scope
from ..core.variables import Variable
from .kinds import SENSORS


@SENSORS.register(units={"filter": "s", "zero": ("m", "rad", "Pa", "N", "V", "1")})
@dataclass(frozen=True)
class Sensor:
    """A sensor of a quantity q: gain q + zero behind a first-order filter, quantised.

    gain : reading per quantity; 1 by default, in V/rad for an angle that is read in volts.
    zero : reading at q = 0 [unit of the reading].
    filter : time constant [s], or None.
    resolution : step of the reading [its unit] (quantisation), or None.
    unit : of the reading; by default that of the quantity.

    For q = x, adds the output ``x.measured`` = gain x + zero, x behind the state ``x.filtered``
    where there is a filter, and the parameters ``x.gain``, ``x.zero`` and ``x.filter``. With a
    resolution the output ``x.reading`` is ``x.measured`` rounded to whole steps: it has no slopes,
    so that fits, plans and linear models look at ``x.measured``, to which the steps are noise of
    resolution/sqrt(12).

    Examples
    --------
    >>> seen = pam.HangingLoad(muscle, 10.0)
    >>> seen.add_sensor("x", pam.plants.Sensor(filter=0.01))
    >>> "x.measured" in [v.name for v in seen.outputs]
    True
    """

    gain: float = 1.0
    zero: float = 0.0
    filter: float | None = None
    resolution: float | None = None
    unit: str | None = None

    def __post_init__(self) -> None:
        if require_finite("Sensor.gain", self.gain) == 0:
            raise InputError("Sensor.gain = 0 reads nothing: give the reading per quantity")
        for argument, unit in (("filter", "s"), ("resolution", self.unit or "")):
            if getattr(self, argument) is not None:
                value = require_positive(f"Sensor.{argument}", getattr(self, argument), unit)
                object.__setattr__(self, argument, value)
        object.__setattr__(self, "zero", require_finite("Sensor.zero", self.zero, self.unit or ""))
        if self.unit is not None:
            units.unit(self.unit)

    def attach(self, plant: Declares, variable: Variable, value: ca.SX) -> tuple[str, ...]:
        """Declare what the sensor of a quantity adds; the names of its states."""
        name, states = variable.name, []
        shown = variable.description or name
        scope = Scope(plant, name)
        if self.filter is not None:
            time = scope.of("s", 0.01, min=1e-6).parameter(
                "filter", self.filter, f"time constant of the sensor of {name}"
            )
            behind = scope.of(
                variable.unit,
                variable.nominal,
                start=variable.start or 0.0,
                display_unit=variable.display_unit,
            ).state("filtered", f"{shown}, behind the sensor's filter")
            plant.der(behind, (value - behind) / time)
            value, states = behind, [f"{name}.filtered"]
        unit = self.unit or variable.unit
        nominal = abs(self.gain) * variable.nominal
        gain = scope.of(_ratio(unit, variable.unit), abs(self.gain)).parameter(
            "gain", self.gain, f"reading of {name} per quantity"
        )
        zero = scope.of(unit, nominal).parameter("zero", self.zero, f"reading of {name} at zero")
        attributes: dict[str, Any] = {"unit": unit, "nominal": nominal}
        if self.unit is None:
            attributes["display_unit"] = variable.display_unit
        measured = gain * value + zero
        scope.of(**attributes).output("measured", measured, f"{shown}, as measured")
        if self.resolution is not None:
            step = scope.of(unit, nominal, min=1e-12 * nominal).parameter(
                "resolution", self.resolution, f"step of the reading of {name}"
            )
            reading = step * ca.floor(measured / step + 0.5)
            scope.of(**attributes).output("reading", reading, f"{shown}, as read")
        return tuple(states)


def as_sensor(value: Any) -> Sensor:
    """``value``, or an InputError when it is no Sensor."""
    if isinstance(value, Sensor):
        return value
    raise InputError(f"sensor = {value!r}: give a Sensor, such as Sensor(zero=0.001, filter=0.01)")


def _ratio(unit: str, other: str) -> str:
    """The unit of one per another, in Modelica's spelling."""
    if unit == other:
        return "1"
    (above, below), (under, over) = (
        u.replace("(", "").replace(")", "").split("/", 1) if "/" in u else (u, "")
        for u in (unit, other)
    )
    top = ".".join(u for u in (above, over) if u not in ("", "1")) or "1"
    bottom = [u for u in ".".join((below, under)).split(".") if u not in ("", "1")]
    if not bottom:
        return top
    return f"{top}/{bottom[0]}" if len(bottom) == 1 else f"{top}/({'.'.join(bottom)})"

"""A spool valve inside its own feedback of pressure and position: an active element made of air."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import casadi as ca

from ..core.errors import InputError, require_finite, require_positive
from ..core.system import Declares, PathOf, Scope
from ..muscles.law import clamp
from ..muscles.pneumatic_muscle import Muscle
from .kinds import FEEDS
from .opening import Asked, path_of
from .valves import GAS_UNITS, Filling, SpoolValve


@FEEDS.register(
    units=GAS_UNITS | {"pressure_gain": "1/Pa", "position_gain": "1/m", "command_lag": "s"}
)
@dataclass(frozen=True, kw_only=True)
class ServoValve(SpoolValve):
    """A spool valve that follows a set pressure, a position or both, by proportional feedback.

    w = pressure_gain (set pressure - p) + position_gain (reference - s), held within -1 .. 1, is
    the opening asked for; s = kappa l0 is the muscle's shortening. A pressure regulator as it is
    built (position_gain 0), and a position servo (pressure_gain 0). Unlike a ``Regulator`` it moves
    air: the flow that it can give, the supply, the tube and the spool limit it.

    pressure_gain : [1/Pa]; 2e-5 opens fully at 0.5 bar. position_gain : [1/m].
    command_lag : of sensor and electronics, lag d' = w - d; 0 for none [s].
    rounding : half width of the rounded ends of -1 .. 1.
    Others: see :class:`SpoolValve`. The dead zone is inverted, as good electronics do, where the
    spool has no motion of its own; with ``spool=`` it stays in the loop, and near rest the feedback
    then ends in it. Controllers invert it: they choose ``<name>.aim``, the set pressure (or the
    reference) of a valve without a dead zone, and send what opens the valve as far.

    Inputs ``<name>.set_pressure`` [Pa] and ``<name>.reference`` [m], each where its gain is not 0;
    output ``<name>.command``; gains and lag are parameters.

    Examples
    --------
    >>> valve = pam.feeds.ServoValve(pressure_gain=2e-5, leak=2e-10)
    >>> [v.name for v in pam.HangingLoad(muscle, feed=valve).inputs]
    ['muscle.set_pressure']
    """

    pressure_gain: float = 2e-5
    position_gain: float = 0.0
    command_lag: float = 0.0
    rounding: float = 0.02

    def __post_init__(self) -> None:
        super().__post_init__()
        require_finite("ServoValve.pressure_gain", self.pressure_gain, "1/Pa")
        require_finite("ServoValve.position_gain", self.position_gain, "1/m")
        require_positive("ServoValve.command_lag", self.command_lag, "s", zero=True)
        require_positive("ServoValve.rounding", self.rounding)
        if not self.pressure_gain and not self.position_gain:
            raise InputError(
                "ServoValve: pressure_gain = position_gain = 0 leaves nothing that is followed; "
                "give one of them, or use a SpoolValve"
            )

    def fill(
        self, plant: Declares, name: str, muscle: Muscle, contraction: ca.SX, rate: ca.SX
    ) -> Filling:
        """See :meth:`GasFeed.fill`."""
        looped = cast(Declares, _Looped(plant, name, self, muscle, contraction))
        return super().fill(looped, name, muscle, contraction, rate)

    def demand(
        self, plant: Declares, name: str, muscle: Muscle, pressure: ca.SX, contraction: ca.SX
    ) -> tuple[ca.SX, ca.SX, Asked, dict[str, Any]]:
        """Declare what the loop needs: (the opening that it asks for; the input that moves it, how
        that is told, and what it says of itself).
        """
        top = muscle.pressure_range[1] if self.max_pressure is None else self.max_pressure
        length = next(v.start for v in plant.variables if v.name == f"{name}.rest_length") or 0.0
        stroke = muscle.contraction_range[1] * length
        errors = (
            ("pressure", self.pressure_gain, "Pa", 1e5, pressure, top),
            ("position", self.position_gain, "m", 0.01, contraction * muscle.rest_length, stroke),
        )
        wanted: ca.SX = ca.SX(0)
        moved: tuple[ca.SX, ca.SX, dict[str, Any]] | None = None
        scope = Scope(plant, name)
        for key, value, unit, nominal, found, reach in errors:
            if not value:
                continue
            gain = scope.of(
                f"1/{unit}",
                1 / nominal,
                display_unit="1/bar" if unit == "Pa" else "1/m",
                tunable=True,
                relaxed=1 / reach if value * reach > 1 else 0.0,
            ).parameter(f"{key}_gain", value, f"feedback of {key} ({name}): opening per {unit}")
            about: dict[str, Any] = {
                "unit": unit,
                "nominal": nominal,
                **({"min": 0.0, "max": top, "start": top / 2} if key == "pressure" else {}),
                "description": f"{key} that the valve of {name} brings about",
            }
            aim = plant.input(
                f"{name}.set_pressure" if key == "pressure" else f"{name}.reference", **about
            )
            moved = moved or (aim, gain, about)
            wanted += gain * (aim - found)
        assert moved is not None  # one gain is not 0
        late = self._lagged(plant, name, wanted) if self.command_lag else wanted
        asked = self._held(late)
        scope.of("1", 0.1).output("command", asked, f"opening asked of {name}'s valve")
        entry, add = plant.gathered()
        add(asked)
        behind = (late,) if self.command_lag else ()
        return asked, moved[0], Asked(entry, self._held(wanted), moved[1], behind), moved[2]

    def _held(self, wanted: ca.SX) -> ca.SX:
        """Within -1 .. 1."""
        width = self.rounding
        return ca.SX(clamp(wanted + 1, width) - clamp(wanted - 1, width) - 1)

    def _lagged(self, plant: Declares, name: str, wanted: ca.SX) -> ca.SX:
        scope = Scope(plant, name)
        lag = scope.of("s", 1e-2, min=1e-6, tunable=True).parameter(
            "command_lag", self.command_lag, f"lag of sensor and electronics ({name})"
        )
        demand = scope.of("1", 0.1, memory="settling").state(
            "demand", f"opening asked for behind the lag ({name})"
        )
        plant.der(demand, (wanted - demand) / lag)
        return demand


class _Looped:
    """The plant as the valve sees it: its command is no input, but what the loop asks for."""

    def __init__(
        self, plant: Declares, name: str, servo: ServoValve, muscle: Muscle, contraction: ca.SX
    ) -> None:
        self._plant, self._name, self._servo = plant, name, servo
        self._muscle, self._contraction = muscle, contraction
        self._pressure: ca.SX | None = None
        self._aim: tuple[ca.SX, Asked, dict[str, Any]] | None = None

    def __getattr__(self, attribute: str) -> Any:
        return getattr(self._plant, attribute)

    def state(self, name: str, *, start: float = 0.0, **attributes: Any) -> ca.SX:
        symbol = self._plant.state(name, start=start, **attributes)
        if name == f"{self._name}.pressure":
            self._pressure = symbol
        return symbol

    def input(self, name: str, *, start: float = 0.0, **attributes: Any) -> ca.SX:
        if name != f"{self._name}.command" or self._pressure is None:
            return self._plant.input(name, start=start, **attributes)
        held, aim, asked, about = self._servo.demand(
            self._plant, self._name, self._muscle, self._pressure, self._contraction
        )
        if self._servo.spool is None:
            return held
        self._aim = aim, asked, about
        return asked.symbol

    def opening(
        self,
        name: str,
        commands: Sequence[ca.SX],
        forward: ca.SX,
        inverse: Callable[[ca.SX], Sequence[ca.SX]],
        paths: Sequence[tuple[ca.SX, PathOf]],
        behind: ca.SX | None = None,
        **attributes: Any,
    ) -> list[ca.SX]:
        """What is asked for is the opening itself: the dead zone is inverted. Behind a spool that
        moves it stays, and controllers choose another aim in place of the input.
        """
        (entry,) = commands
        if self._aim is None:
            return [path_of(of, entry) for _, of in paths]
        aim, asked, about = self._aim
        about = about | {"description": f"{about['description']}, were there no overlap"}
        return self._plant.opening(
            f"{self._name}.aim", [aim], forward, inverse, paths, behind, asked, **about
        )

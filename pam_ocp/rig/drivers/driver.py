"""What a driver is, and what drivers share.

A driver knows a transport and nothing of physics: raw numbers by the names of channels.
"""

from __future__ import annotations

import base64
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from ...core.errors import InputError, PamError
from ...core.registry import Registry
from ..channels import Command, Reading


class DriverError(PamError):
    """No valid answer of the device: nothing came, or nothing that is whole.

    Examples
    --------
    >>> issubclass(pam.rig.DriverError, pam.PamError)
    True
    """


@runtime_checkable
class Driver(Protocol):
    """A way to a rig. What it raises while it reads or writes counts as a missing answer.

    It may have, and the rig then uses: ``open(readings, commands)``, called once with the channels
    by name; ``synchronise()``, called as the rig is armed; ``arm()``, which lets a device act again
    that has vented; ``emergency()``, an :class:`Emergency` by which the watchdog vents without this
    process.

    Examples
    --------
    >>> driver = pam.rig.driver("udp", host="127.0.0.1", port=9750)
    >>> isinstance(driver, pam.rig.Driver)
    True
    """

    def read(self) -> dict[str, float]:
        """Raw numbers by the names of the readings, and ``"time"``: when they were taken, on the
        clock of ``time.monotonic()`` [s].
        """

    def write(self, inputs: Mapping[str, float]) -> None:
        """Send raw numbers by the names of the commands."""

    def vent(self) -> None:
        """Let the air out, whatever was sent before; may be called at any time."""

    def close(self) -> None:
        """Let go of the transport."""


DRIVERS: Registry[Any] = Registry("driver", "pam_ocp.rig.drivers", argument="driver")


@dataclass(frozen=True)
class Emergency:
    """How the watchdog's process vents by itself.

    kind : "tcp", "udp" or "file" (a serial port), to which ``payload`` is sent again and again;
    "call": ``target`` ("module:function") is called with ``arguments`` and gives a driver to vent.
    """

    kind: str
    target: str
    port: int = 0
    payload: bytes = b""
    arguments: Mapping[str, Any] | None = None

    @property
    def told(self) -> dict[str, Any]:
        """As JSON, for processes that vent (watchdog_server.py, vent_server.py)."""
        own = {n: getattr(self, n) for n in ("kind", "target", "port")}
        payload = base64.b64encode(self.payload).decode("ascii")
        more = {"payload": payload, "arguments": dict(self.arguments or {}), "path": sys.path}
        return own | more


class DeviceClock:
    """From a device's own clock to ``time.monotonic()``: a stamp that stops where the device does.

    The smallest delay that was seen stands for the way of an answer; ``drift`` [s/s] lets clocks
    run apart.
    """

    def __init__(self, drift: float = 1e-3) -> None:
        self.drift = drift
        self._offset: float | None = None
        self._at = 0.0

    def __call__(self, device: float, received: float) -> float:
        """When an answer was taken that says ``device`` [s], and came in at ``received`` [s]."""
        ahead = received - device
        if self._offset is None:
            self._offset = ahead
        else:
            self._offset = min(self._offset + self.drift * (received - self._at), ahead)
        self._at = received
        return device + self._offset


class Clocked:
    """Counts of what came in, for reports; and the present time."""

    def __init__(self) -> None:
        self.counts = {"answers": 0, "late": 0, "damaged": 0, "missing": 0}
        self._stamp = DeviceClock()

    def synchronise(self) -> None:
        """Begin anew with the device's clock, which may have been set since."""
        self._stamp = DeviceClock()

    @staticmethod
    def now() -> float:
        """Of this host [s]."""
        return time.monotonic()


def missing(library: str, package: str) -> InputError:
    """What is raised where a driver's library is not installed."""
    return InputError(
        f"this driver needs {library}: install it by  pip install 'pam_ocp[rig]'  (or {package})"
    )


def addressed(channels: Mapping[str, Reading] | Mapping[str, Command]) -> list[tuple[str, int]]:
    """(name, register) of all that a driver has to know. Raises InputError where one has none."""
    found = []
    for name, channel in channels.items():
        if getattr(channel, "slope_of", ""):
            continue
        address = channel.address
        if not isinstance(address, int) or isinstance(address, bool) or address < 0:
            raise InputError(f"{name}: address = {address!r}: give the number of a register")
        found.append((name, address))
    return found


# ---- a twin in the same process: no transport at all ---------------------------------------------
@DRIVERS.register("twin")
class TwinDriver:
    """A twin in this process, without a transport; on a simulated clock it runs at full speed.

    Examples
    --------
    >>> twin = pam.rig.Twin(plant, clock=pam.rig.SimulatedClock())
    >>> driver = pam.rig.driver("twin", twin=twin)
    >>> sorted(driver.read())
    ['muscle.pressure', 'time', 'x']
    """

    def __init__(self, twin: Any) -> None:
        self.twin = twin

    def read(self) -> dict[str, float]:
        """See :class:`Driver`."""
        seen = self.twin.read()
        if seen is None:
            raise DriverError("the twin does not answer")
        return dict(seen)

    def write(self, inputs: Mapping[str, float]) -> None:
        """See :class:`Driver`."""
        self._require()
        self.twin.write(inputs)

    def vent(self) -> None:
        """See :class:`Driver`."""
        self._require()
        self.twin.vent()

    def _require(self) -> None:
        if not self.twin.answers:
            raise DriverError("the twin does not answer")

    def arm(self) -> None:
        """Let the twin act again."""
        self.twin.arm()

    def close(self) -> None:
        """See :class:`Driver`."""

"""A twin in the same process: no transport at all."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .driver import DRIVERS, DriverError


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

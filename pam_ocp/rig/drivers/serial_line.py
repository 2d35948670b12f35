"""Serial lines: microcontrollers that speak the lines of lines.py."""

from __future__ import annotations

import time
from typing import Any

from ...core.errors import InputError, require_count, require_positive
from .driver import DRIVERS, Emergency, missing
from .lines import Cut, LineDriver

__all__ = ["SerialLine"]


@DRIVERS.register("serial", units={"timeout": "s"})
class SerialLine(LineDriver):
    """Serial port of a microcontroller, with check sums (pyserial).

    port : such as "/dev/ttyACM0" or "COM3". baud : of the line; USB takes any. timeout : for an
    answer [s]; tries : lines sent until none counts as missing.

    Examples
    --------
    >>> from pam_ocp.rig.drivers.driver import DRIVERS
    >>> DRIVERS["serial"].__name__
    'SerialLine'
    """

    def __init__(
        self, port: str, baud: int = 1_000_000, timeout: float = 0.008, tries: int = 2
    ) -> None:
        super().__init__(require_positive("timeout", timeout, "s"), require_count("tries", tries))
        try:
            import serial
        except ImportError:
            raise missing("pyserial", "pyserial") from None
        self.port = port
        try:
            self._line: Any = serial.Serial(port, baud, timeout=0, write_timeout=self.timeout)
        except (serial.SerialException, ValueError, OSError) as error:
            raise InputError(
                f"port = {port!r} cannot be opened ({error}); look whether the device is there and "
                "whether you may use it"
            ) from None
        self._cut, self._lines = Cut(), list[bytes]()

    def send(self, data: bytes) -> None:
        """See :class:`LineDriver`."""
        self._lines.clear()
        self._line.write(data)  # serial's errors are OSErrors

    def receive(self, until: float) -> bytes:
        """See :class:`LineDriver`."""
        while not self._lines:
            left = until - time.monotonic()
            if left <= 0:
                return b""
            self._line.timeout = left
            self._lines += self._cut(self._line.read(max(1, self._line.in_waiting)))
        return self._lines.pop(0)

    def fileno(self) -> int:
        """See :class:`LineDriver`."""
        return int(self._line.fileno())

    def close(self) -> None:
        """See :class:`Driver`."""
        self._line.close()

    def emergency(self) -> Emergency:
        """The port is opened a second time by the watchdog."""
        return Emergency("file", self.port, payload=self.alarm())

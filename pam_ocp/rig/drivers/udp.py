"""UDP: boards on a network that speak the lines of lines.py, a datagram each."""

from __future__ import annotations

import select
import socket
import time

from ...core.errors import InputError, require_count, require_positive
from .driver import DRIVERS, Emergency
from .lines import LONGEST, LineDriver

__all__ = ["Udp"]


@DRIVERS.register("udp", units={"timeout": "s"})
class Udp(LineDriver):
    """Datagrams to a board on a network, with check sums.

    host, port : of the board. timeout : for an answer [s]; tries : datagrams sent until none counts
    as missing.

    Examples
    --------
    >>> driver = pam.rig.driver("udp", host="127.0.0.1", port=9750)
    >>> driver.close()
    """

    datagrams = True

    def __init__(self, host: str, port: int, timeout: float = 0.008, tries: int = 2) -> None:
        super().__init__(require_positive("timeout", timeout, "s"), require_count("tries", tries))
        self.host, self.port = host, require_count("port", port, 1, 65535)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))  # what others send is not received
        except OSError as error:
            self._socket.close()
            raise InputError(f"host = {host!r} is not known ({error})") from None
        self._socket.setblocking(False)

    def send(self, data: bytes) -> None:
        """See :class:`LineDriver`."""
        self._socket.send(data)

    def receive(self, until: float) -> bytes:
        """See :class:`LineDriver`."""
        left = until - time.monotonic()
        if left > 0 and select.select([self._socket], [], [], left)[0]:
            return self._socket.recv(LONGEST) or b"\n"
        return b""

    def fileno(self) -> int:
        """See :class:`LineDriver`."""
        return self._socket.fileno()

    def close(self) -> None:
        """See :class:`Driver`."""
        self._socket.close()

    def emergency(self) -> Emergency:
        """A datagram of its own."""
        return Emergency("udp", self.host, self.port, self.alarm().lstrip(b"\n"))

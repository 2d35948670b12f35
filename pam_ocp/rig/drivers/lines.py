"""Lines with a check sum: the drivers of serial ports and UDP, and the other end of them.

A line is ASCII and ends in a line feed::

    >SEQ CODE NUMBERS*CRC        from the host
    <SEQ TIME NUMBERS*CRC        the answer

SEQ : 32 bits, rising; the answer repeats it, and a device acts on newer lines only (V always).
CODE : R reads, W sends the commands in the order of the channels, V vents and stays so until A
arms. TIME : the device's clock in microseconds; behind it the readings in the order of the
channels. CRC : CRC-32 (zlib) of all before the asterisk, eight hexadecimal digits. Numbers are
decimal, ``nan`` is one.
"""

from __future__ import annotations

import select
import socket
import time
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.errors import InputError, require_count, require_positive
from ..channels import Command, Reading
from .driver import DRIVERS, Clocked, DriverError, Emergency, missing

LONGEST = 1024
"""Bytes of a line; what is longer is noise."""
MOD = 1 << 32


def framed(body: str) -> bytes:
    """A line with its check sum.

    Examples
    --------
    >>> from pam_ocp.rig.drivers.lines import framed, unframed
    >>> unframed(framed(">1 R"))
    '>1 R'
    """
    data = body.encode("ascii")
    return data + b"*%08X\n" % zlib.crc32(data)


def unframed(line: bytes) -> str | None:
    """What stands in a line; None where its check sum does not say so."""
    data, star, check = line.rstrip(b"\r\n").rpartition(b"*")
    if star and len(check) == 8 and check == b"%08X" % zlib.crc32(data):
        return data.decode("ascii", "replace")
    return None


class LineDriver(Clocked):
    """Asks by lines and takes whole, fitting answers alone. A subclass sends and receives bytes.

    sequence : of the last line. datagrams : lines come one by one, or in a stream of bytes.
    """

    datagrams = False

    def __init__(self, timeout: float, tries: int) -> None:
        super().__init__()
        self.timeout, self.tries = timeout, tries
        self.sequence = int(time.time() * 1e3) % MOD  # newer than that of a run before
        self._readings: list[str] = []
        self._commands: list[str] = []

    def open(self, readings: Mapping[str, Reading], commands: Mapping[str, Command]) -> None:
        """The channels, whose order is that of the numbers in a line."""
        self._readings = [n for n, r in readings.items() if not r.slope_of]
        self._commands = list(commands)

    def send(self, data: bytes) -> None:
        """Send a line. Raises OSError."""
        raise NotImplementedError

    def receive(self, until: float) -> bytes:
        """The next line, or b"" when ``until`` (``time.monotonic()``) is over. Raises OSError."""
        raise NotImplementedError

    def fileno(self) -> int:
        """What the loop in C writes to and reads from, as it is for a system call."""
        raise NotImplementedError

    def exchange(self, code: str, numbers: Sequence[float] = ()) -> dict[str, float]:
        """The readings of an answer. Raises DriverError when none came in time."""
        text = " ".join([code, *(repr(float(n)) for n in numbers)])
        cause: object = "no answer"
        for _ in range(self.tries):
            self.sequence = (self.sequence + 1) % MOD
            try:
                self.send(framed(f">{self.sequence} {text}"))
                until = time.monotonic() + self.timeout
                while line := self.receive(until):
                    if (found := self._taken(line)) is not None:
                        return found
            except OSError as error:
                cause = error
        self.counts["missing"] += 1
        raise DriverError(
            f"no valid answer within {self.tries} x {1e3 * self.timeout:g} ms ({cause})"
        )

    def _taken(self, line: bytes) -> dict[str, float] | None:
        """The readings in a line, if it answers what was asked."""
        received = self.now()
        body = unframed(line)
        fields = [] if body is None else body.split(" ")
        try:
            sequence, device, *values = (float(f) for f in [fields[0].lstrip("<"), *fields[1:]])
        except (IndexError, ValueError):
            self.counts["damaged"] += 1
            return None
        if not fields[0].startswith("<") or len(values) != len(self._readings):
            self.counts["damaged"] += 1
            return None
        if sequence != self.sequence:
            self.counts["late"] += 1
            return None
        self.counts["answers"] += 1
        found = dict(zip(self._readings, values, strict=True))
        return {**found, "time": self._stamp(1e-6 * device, received)}

    # ---- a Driver -------------------------------------------------------------------------------
    def read(self) -> dict[str, float]:
        """See :class:`Driver`."""
        return self.exchange("R")

    def write(self, inputs: Mapping[str, float]) -> None:
        """See :class:`Driver`."""
        self.exchange("W", [inputs[n] for n in self._commands])

    def vent(self) -> None:
        """See :class:`Driver`."""
        self.exchange("V")

    def arm(self) -> None:
        """Let the device act again."""
        self.exchange("A")

    @staticmethod
    def alarm() -> bytes:
        """The line by which anybody vents."""
        return b"\n" + framed(">0 V")


# ---- the other end -------------------------------------------------------------------------------
class LineServer:
    """The other end: answers lines on behalf of a device (a twin)."""

    def __init__(self, device: Any, readings: Sequence[str], commands: Sequence[str]) -> None:
        self.device, self.readings, self.commands = device, readings, commands
        self._last: int | None = None

    def answer(self, line: bytes) -> bytes:
        """The answer to a line; b"" where there is none to be given."""
        body = unframed(line)
        fields = [] if body is None else body.split(" ")
        try:
            sequence, code = int(fields[0].lstrip(">")), fields[1]
            numbers = [float(f) for f in fields[2:]]
        except (IndexError, ValueError):
            return b""
        if not fields[0].startswith(">") or not self._act(sequence, code, numbers):
            return b""
        seen = self.device.read()
        if seen is None:
            return b""
        told = " ".join(repr(float(seen[n])) for n in self.readings)
        return framed(f"<{sequence} {round(1e6 * seen['time'])} {told}".rstrip())

    def _act(self, sequence: int, code: str, numbers: list[float]) -> bool:
        if code == "V":
            self.device.vent()
            return True
        if self._last is not None and not 0 < (sequence - self._last) % MOD < MOD // 2:
            return False  # old, or sent twice
        self._last = sequence
        if code == "A":
            self.device.arm()
        elif code == "W" and len(numbers) == len(self.commands):
            self.device.write(dict(zip(self.commands, numbers, strict=True)))
        return code in ("A", "R") or (code == "W" and len(numbers) == len(self.commands))


class Cut:
    """Bytes into lines."""

    def __init__(self) -> None:
        self._rest = b""

    def __call__(self, data: bytes) -> list[bytes]:
        """Lines that are whole now, each with its line feed."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest = rest[-LONGEST:]
        return [line + b"\n" for line in lines if line]


# ---- UDP and serial ports ------------------------------------------------------------------------
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

"""Modbus TCP: valve terminals, remote I/O, controllers (pymodbus)."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

from ...core.errors import InputError, require_count, require_flag, require_positive
from ..channels import Command, Reading
from .driver import DRIVERS, Clocked, DriverError, Emergency, addressed, missing

CODES = {"float32": ">f", "int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I"}
MOST = 120
"""Registers in one request."""


def packed(value: float, form: str) -> list[int]:
    """A number as registers, the high word first; rounded and kept in range for whole numbers."""
    code = CODES[form]
    if form != "float32":
        bits = 8 * struct.calcsize(code)
        low, high = (
            (0, 2**bits - 1) if form.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        )
        value = min(max(round(value), low), high)
    data = struct.pack(code, value)
    return list(struct.unpack(f">{len(data) // 2}H", data))


def unpacked(registers: Sequence[int], form: str) -> float:
    """The number in registers."""
    data = struct.pack(f">{len(registers)}H", *registers)
    return float(struct.unpack(CODES[form], data)[0])


def size(form: str) -> int:
    """Registers of a form."""
    return struct.calcsize(CODES[form]) // 2


def check_of(registers: Sequence[int]) -> list[int]:
    """CRC-32 of registers, as two."""
    total = zlib.crc32(struct.pack(f">{len(registers)}H", *registers))
    return [total >> 16, total & 0xFFFF]


class Block:
    """Channels that lie side by side in registers."""

    def __init__(self, places: Mapping[str, tuple[int, str]]) -> None:
        self.places = dict(places)
        self.first = min((a for a, _ in self.places.values()), default=0)
        self.count = max((a + size(f) for a, f in self.places.values()), default=0) - self.first
        if self.count > MOST:
            raise InputError(
                f"the addresses of {', '.join(self.places)} span {self.count} registers; keep them "
                f"within {MOST}, which is what one request takes"
            )

    def values(self, registers: Sequence[int]) -> dict[str, float]:
        """Numbers by name."""
        return {
            n: unpacked(registers[a - self.first : a - self.first + size(f)], f)
            for n, (a, f) in self.places.items()
        }

    def registers(self, values: Mapping[str, float]) -> list[int]:
        """The block's registers; those between channels are 0."""
        found = [0] * self.count
        for n, (a, f) in self.places.items():
            found[a - self.first : a - self.first + size(f)] = packed(values[n], f)
        return found


def layout(
    readings: Mapping[str, Reading], commands: Mapping[str, Command], time_address: int | None
) -> tuple[Block, Block]:
    """(input registers that are read, holding registers that are written)."""
    read = {n: (a, readings[n].format) for n, a in addressed(readings)}
    if time_address is not None:
        read["time"] = (time_address, "uint32")
    written = {n: (a, commands[n].format) for n, a in addressed(commands)}
    return Block(read), Block(written)


@DRIVERS.register("modbus", units={"timeout": "s"})
class Modbus(Clocked):
    """Registers of a Modbus TCP device (pymodbus): valve terminals, remote I/O.

    host, port, device : of the device. Readings are input registers, commands holding registers,
    each channel at its ``address``, in one block each.
    time_address : input registers (uint32) with the device's clock in steps of 0.1 ms, where it has
    one; without it a stamp is the time at which an answer came.
    vent_coil : a coil that vents when it is set; without one the commands' vent values are sent.
    check : both blocks are followed by their CRC-32 in two registers, as twins have them: TCP keeps
    damage out, programs between do not.
    timeout : for an answer [s].

    Examples
    --------
    >>> driver = pam.rig.driver("modbus", host="127.0.0.1", port=5020)
    >>> driver.close()
    """

    def __init__(
        self,
        host: str,
        port: int = 502,
        device: int = 1,
        time_address: int | None = None,
        vent_coil: int | None = None,
        check: bool = False,
        timeout: float = 0.015,
    ) -> None:
        super().__init__()
        try:
            from pymodbus.client import ModbusTcpClient
        except ImportError:
            raise missing("pymodbus", "pymodbus") from None
        import logging

        logging.getLogger("pymodbus").setLevel(logging.CRITICAL)  # a missing answer is ours to tell
        self.host, self.port = host, require_count("port", port, 1, 65535)
        self.device = require_count("device", device, 0, 255)
        self.time_address, self.vent_coil = time_address, vent_coil
        self.check = bool(require_flag("check", check))
        timeout = require_positive("timeout", timeout, "s")
        self._client: Any = ModbusTcpClient(host, port=port, timeout=timeout, retries=0)
        self._ticks: int | None = None
        self._passed = 0
        self._commands: dict[str, Command] = {}
        self._read, self._written = Block({}), Block({})

    def open(self, readings: Mapping[str, Reading], commands: Mapping[str, Command]) -> None:
        """The channels with their addresses. Raises InputError."""
        self._commands = dict(commands)
        self._read, self._written = layout(readings, commands, self.time_address)

    def _asked(self, request: str, *arguments: Any, **more: Any) -> Any:
        """An answer. Raises DriverError; the connection is then made anew."""
        try:
            answer = getattr(self._client, request)(*arguments, device_id=self.device, **more)
            if not answer.isError():
                self.counts["answers"] += 1
                return answer
            cause = str(answer)
        except Exception as error:  # pymodbus raises many kinds for what comes damaged
            cause = str(error)
        self.counts["missing"] += 1
        self._client.close()
        raise DriverError(f"{self.host}:{self.port}: {' '.join(cause.split())[:200]}")

    def _damaged(self, words: str) -> DriverError:
        self.counts["damaged"] += 1
        self._client.close()
        return DriverError(f"{self.host}:{self.port}: {words}")

    # ---- a Driver -------------------------------------------------------------------------------
    def read(self) -> dict[str, float]:
        """See :class:`Driver`."""
        count = self._read.count + 2 * self.check
        answer = self._asked("read_input_registers", self._read.first, count=count)
        received, registers = self.now(), list(answer.registers)
        if len(registers) != count:
            raise self._damaged(f"{len(registers)} registers came, {count} were asked for")
        if self.check and check_of(registers[:-2]) != registers[-2:]:
            raise self._damaged("the check sum of the registers is wrong")
        found = self._read.values(registers)
        ticks = found.pop("time", None)
        stamp = received if ticks is None else self._stamp(self._device(int(ticks)), received)
        return {**found, "time": stamp}

    def _device(self, ticks: int) -> float:
        """Seconds of the device's clock, which runs over after 2^32 steps."""
        if self._ticks is not None:
            step = (ticks - self._ticks) % 2**32
            self._passed += step if step < 2**31 else step - 2**32
        self._ticks = ticks
        return 1e-4 * self._passed

    def write(self, inputs: Mapping[str, float]) -> None:
        """See :class:`Driver`."""
        registers = self._written.registers(inputs)
        if self.check:
            registers += check_of(registers)
        self._asked("write_registers", self._written.first, registers)

    def vent(self) -> None:
        """See :class:`Driver`."""
        if self.vent_coil is not None:
            self._asked("write_coil", self.vent_coil, True)
        else:
            self.write(self._vented())

    def arm(self) -> None:
        """Let the device act again."""
        if self.vent_coil is not None:
            self._asked("write_coil", self.vent_coil, False)

    def close(self) -> None:
        """See :class:`Driver`."""
        self._client.close()

    def _vented(self) -> dict[str, float]:
        return {n: c.raw_vent for n, c in self._commands.items()}

    def emergency(self) -> Emergency:
        """A connection of its own, over which one request is sent again and again."""
        if self.vent_coil is not None:
            body = struct.pack(">BHH", 5, self.vent_coil, 0xFF00)
        else:
            registers = self._written.registers(self._vented())
            registers += check_of(registers) if self.check else []
            head = struct.pack(">BHHB", 16, self._written.first, len(registers), 2 * len(registers))
            body = head + struct.pack(f">{len(registers)}H", *registers)
        data = struct.pack(">HHHB", 1, 0, len(body) + 1, self.device) + body
        return Emergency("tcp", self.host, self.port, data)

"""Twins behind transports: Modbus TCP, serial lines (pseudo-terminals), UDP, OPC UA."""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
import threading
from collections.abc import Callable, Mapping
from datetime import datetime, timedelta, timezone
from typing import Any

from ..core.errors import InputError, require_count, with_kinds
from .drivers.driver import missing
from .drivers.lines import LONGEST, Cut, LineServer, framed, unframed
from .drivers.modbus import check_of, layout
from .twin import Twin

TIME_ADDRESS, VENT_COIL = 0, 0
"""Of twins behind Modbus."""
LOOK = 0.05
"""How often a server looks whether it is to end [s]."""


class Served:
    """A twin that is being served; ``address`` says how a driver reaches it. ``with`` ends it."""

    def __init__(self, address: dict[str, Any], work: Callable[[Served], None]) -> None:
        self.address, self.ended = address, threading.Event()
        self._thread = threading.Thread(target=work, args=(self,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End it."""
        self.ended.set()
        self._thread.join(5.0)

    def wait(self, seconds: float | None = None) -> None:
        """Until it is ended, or for a time."""
        self.ended.wait(seconds)

    def __enter__(self) -> Served:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


@with_kinds
def serve(twin: Twin, kind: str = "modbus", *, port: int = 0, host: str = "127.0.0.1") -> Served:
    """Put a twin behind a transport, in a thread of this process (``pam-ocp twin``: in its own).

    kind : "modbus", "serial" (a pseudo-terminal; not on Windows), "udp", "opcua". port : 0 for any
    that is free. ``served.address`` holds the arguments of :func:`driver`.

    Examples
    --------
    >>> twin = pam.rig.Twin(plant)
    >>> with pam.rig.serve(twin, "udp") as served:
    ...     driver = pam.rig.driver(**served.address)
    ...     rig = pam.Rig(driver, plant=plant)
    ...     rig.read()["x"] < 0.05
    ...
    True
    """
    kinds: Mapping[str, Callable[[Twin, str, int], Served]] = {
        "modbus": _modbus,
        "serial": lambda t, h, p: _serial(t),
        "udp": _udp,
        "opcua": _opcua,
    }
    if kind not in kinds:
        raise InputError(f"kind = {kind!r}: choose one of {', '.join(kinds)}")
    require_count("port", port, 0, 65535)
    try:
        return kinds[kind](twin, host, port)
    except OSError as error:
        raise InputError(
            f"port = {port} of {host} cannot be taken ({error}); give another"
        ) from None


def _line_server(twin: Twin) -> LineServer:
    readings = [n for n, r in twin.readings.items() if not r.slope_of]
    return LineServer(twin, readings, list(twin.commands))


def _udp(twin: Twin, host: str, port: int) -> Served:
    server, line = _line_server(twin), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.bind((host, port))

    def work(own: Served) -> None:
        while not own.ended.is_set():
            if select.select([line], [], [], LOOK)[0]:
                data, who = line.recvfrom(LONGEST)
                if answer := server.answer(data):
                    line.sendto(answer, who)
            else:
                twin.tick()
        line.close()

    return Served({"kind": "udp", "host": host, "port": line.getsockname()[1]}, work)


def _serial(twin: Twin) -> Served:
    if sys.platform == "win32":
        raise InputError("kind = 'serial' needs pseudo-terminals, which Windows has not; use udp")
    import tty

    inner, outer = os.openpty()
    tty.setraw(outer)
    server, cut = _line_server(twin), Cut()

    def work(own: Served) -> None:
        while not own.ended.is_set():
            if select.select([inner], [], [], LOOK)[0]:
                for asked in cut(os.read(inner, 4096)):
                    if answer := server.answer(asked):
                        os.write(inner, answer)
            else:
                twin.tick()
        os.close(inner)
        os.close(outer)

    return Served({"kind": "serial", "port": os.ttyname(outer)}, work)


# ---- Modbus TCP ---------------------------------------------------------------------------------
class Registers:
    """The twin as registers: answers requests of Modbus (functions 3, 4, 5, 16)."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self._read, self._written = layout(twin.readings, twin.commands, TIME_ADDRESS)
        self._last = {n: c.raw_vent for n, c in twin.commands.items()}

    def answer(self, request: bytes) -> bytes | None:
        """The answer to function and data; None where the twin says nothing."""
        code = request[0]
        try:
            if code == 4:
                return self._registers(code, request, self._inputs())
            if code == 3:
                return self._registers(code, request, self._held())
            if code == 5:
                coil, value = struct.unpack(">HH", request[1:5])
                if coil != VENT_COIL:
                    return bytes([code | 0x80, 2])
                (self.twin.vent if value else self.twin.arm)()
            elif code == 16:
                if (wrong := self._write(request)) is not None:
                    return bytes([code | 0x80, wrong])
            else:
                return bytes([code | 0x80, 1])
        except (struct.error, IndexError):
            return bytes([code | 0x80, 3])
        return None if self.twin.read() is None else request[:5]

    def _inputs(self) -> tuple[int, list[int]] | None:
        seen = self.twin.read()
        if seen is None:
            return None
        seen["time"] = float(round(1e4 * seen["time"]) % 2**32)
        registers = self._read.registers(seen)
        return self._read.first, registers + check_of(registers)

    def _held(self) -> tuple[int, list[int]]:
        registers = self._written.registers(self._last)
        return self._written.first, registers + check_of(registers)

    def _registers(
        self, code: int, request: bytes, found: tuple[int, list[int]] | None
    ) -> bytes | None:
        if found is None:
            return None
        first, count = struct.unpack(">HH", request[1:5])
        offset = first - found[0]
        part = found[1][offset : offset + count] if offset >= 0 else []
        if not 0 < count <= 125 or len(part) != count:
            return bytes([code | 0x80, 2])
        return struct.pack(f">BB{count}H", code, 2 * count, *part)

    def _write(self, request: bytes) -> int | None:
        """What is wrong with it, as Modbus numbers exceptions."""
        first, count, length = struct.unpack(">HHB", request[1:6])
        registers = list(struct.unpack(f">{length // 2}H", request[6 : 6 + length]))
        own = self._written.count
        if first != self._written.first or count not in (own, own + 2) or len(registers) != count:
            return 2
        if count == own + 2 and check_of(registers[:own]) != registers[own:]:
            return 3
        self._last = self._written.values(registers[:own])
        self.twin.write(self._last)
        return None


def _modbus(twin: Twin, host: str, port: int) -> Served:
    registers = Registers(twin)
    listening = socket.create_server((host, port))

    def work(own: Served) -> None:
        open_ends: dict[socket.socket, bytes] = {}
        while not own.ended.is_set():
            ready = select.select([listening, *open_ends], [], [], LOOK)[0]
            if not ready:
                twin.tick()
            for end in ready:
                if end is listening:
                    new = listening.accept()[0]
                    new.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    open_ends[new] = b""
                elif (rest := _talk(end, open_ends[end], registers)) is None:
                    del open_ends[end]
                    end.close()
                else:
                    open_ends[end] = rest
        for end in (listening, *open_ends):
            end.close()

    address = {"kind": "modbus", "host": host, "port": listening.getsockname()[1]}
    more = {"time_address": TIME_ADDRESS, "vent_coil": VENT_COIL, "check": True}
    return Served({**address, **more}, work)


def _talk(end: socket.socket, before: bytes, registers: Registers) -> bytes | None:
    """Answer all whole requests; what is left of the bytes. None where the connection is over."""
    try:
        came = end.recv(4096)
        if not came:
            return None
        data = before + came
        while len(data) >= 8:
            number, protocol, length = struct.unpack(">HHH", data[:6])
            if protocol != 0 or not 2 <= length <= 254:
                return None
            if len(data) < 6 + length:
                break
            unit, request, data = data[6], data[7 : 6 + length], data[6 + length :]
            answer = registers.answer(request)
            if answer is not None:
                end.sendall(struct.pack(">HHHB", number, 0, len(answer) + 1, unit) + answer)
        return data
    except OSError:
        return None


# ---- OPC UA -------------------------------------------------------------------------------------
def _opcua(twin: Twin, host: str, port: int) -> Served:
    """Nodes "ns=2;s=NAME" of all channels, and "ns=2;s=vent"."""
    try:
        import asyncua
        from asyncua.sync import Server
    except ImportError:
        raise missing("asyncua", "asyncua") from None
    if port == 0:
        with socket.create_server((host, 0)) as probe:
            port = probe.getsockname()[1]
    url = f"opc.tcp://{host}:{port}"
    ua: Any = asyncua.ua
    server: Any = Server()
    server.set_endpoint(url)
    server.set_security_policy([ua.SecurityPolicyType.NoSecurity])
    space = server.register_namespace("urn:pam_ocp:twin")
    folder = server.nodes.objects.add_object(space, "twin")
    readings = [n for n, r in twin.readings.items() if not r.slope_of]

    def node(name: str, value: Any) -> Any:
        made = folder.add_variable(ua.NodeId(name, space), name, value)
        made.set_writable()
        return made

    shown = {n: node(n, 0.0) for n in readings}
    told = {n: node(n, c.raw_vent) for n, c in twin.commands.items()}
    vented, sample, order = node("vent", True), node("sample", ""), node("order", "")
    server.start()
    known: dict[Any, Any] = {}

    def value_of(node: Any) -> Any:
        """The last good one: damage on the way may write one of bad quality, or none."""
        data = node.read_data_value(False)
        if data.StatusCode.is_good() and data.Value is not None and data.Value.Value is not None:
            known[node.nodeid] = data.Value.Value
        return known[node.nodeid]

    for each in (order, vented, *told.values()):
        value_of(each)

    def work(own: Served) -> None:
        try:
            follow(own)
        finally:
            server.stop()  # its thread would keep the process

    def follow(own: Served) -> None:
        before: tuple[Any, ...] = ()
        ordered = _Ordered(list(told))
        while not own.ended.wait(2e-3):
            sent = ordered(value_of(order))
            if sent is None:
                sent = {n: float(value_of(v)) for n, v in told.items()}
            now = (bool(value_of(vented)), *sent.values())
            if now != before:
                if now[0]:
                    twin.vent()
                else:
                    if not before or before[0]:
                        twin.arm()
                    twin.write(sent)
                before = now
            seen = twin.read()
            if seen is not None:
                age = timedelta(seconds=twin.now() - seen["time"])
                stamp = datetime.now(timezone.utc) - age
                numbers = " ".join(repr(float(seen[n])) for n in readings)
                sample.write_value(
                    framed(f"{round(1e6 * seen['time'])} {numbers}").decode().rstrip()
                )
                for n, v in shown.items():
                    v.write_value(ua.DataValue(ua.Variant(float(seen[n])), SourceTimestamp=stamp))

    address = {"kind": "opcua", "url": url, "vent_node": f"ns={space};s=vent", "check": True}
    return Served(address, work)


class _Ordered:
    """Commands of the node "order": the newest that came whole; None before the first."""

    def __init__(self, names: list[str]) -> None:
        self._names, self._last = names, -1
        self._values: dict[str, float] | None = None

    def __call__(self, text: Any) -> dict[str, float] | None:
        body = unframed(text.encode("ascii", "replace")) if isinstance(text, str) else None
        number, *values = (body or "").split(" ")
        try:
            found = dict(zip(self._names, map(float, values), strict=True))
            if int(number) > self._last:
                self._last, self._values = int(number), found
        except ValueError:
            pass  # damaged: the last one stands
        return self._values

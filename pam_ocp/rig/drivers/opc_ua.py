"""OPC UA: controllers of machines that offer their variables as nodes (asyncua)."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

from ...core.errors import InputError, require_count, require_flag, require_positive
from ..channels import Channel, Command, Reading
from .driver import DRIVERS, Clocked, DriverError, Emergency, missing
from .lines import framed, unframed

FAILURES = 3
"""In a row, after which the connection is made anew; where it is closed, at once."""
SLACK = 0.05
"""After asyncua's own end of waiting, for a call that it has lost [s]."""
CONNECTING = 1.0
"""For an answer while it is made [s]."""


def _text_of(error: Exception) -> str:
    """What an error says; asyncua keeps bytes that are not UTF-8 as lone surrogates, which no
    file of records or log takes."""
    text = str(error) or type(error).__name__
    return text.encode("utf-8", "backslashreplace").decode()


@DRIVERS.register("opcua", units={"timeout": "s"})
class OpcUa(Clocked):
    """Nodes of an OPC UA server (asyncua), each channel at its ``address`` ("ns=2;s=x").

    url : such as "opc.tcp://192.168.0.10:4840". namespace : of channels without such an address,
    which are called as they are. vent_node : a Boolean that vents when it is True;
    without one the commands' vent values are sent. timeout : for an answer [s].
    check : all readings are one text, the node "sample", all commands another, "order", as twins
    have them: "TIME NUMBERS*CRC" and "NUMBERS*CRC" of lines.py. So values belong together, and
    damage is seen, which OPC UA without signatures leaves to TCP.

    A value whose quality is not good is none. Its stamp is the server's source time, where there is
    one. A connection that is lost is made anew beside the loop, which misses answers meanwhile.

    Examples
    --------
    >>> from pam_ocp.rig.drivers.driver import DRIVERS
    >>> sorted(DRIVERS)
    ['modbus', 'opcua', 'ros', 'serial', 'twin', 'udp']
    """

    def __init__(
        self,
        url: str,
        vent_node: str | None = None,
        namespace: int = 2,
        timeout: float = 0.05,
        check: bool = False,
    ) -> None:
        super().__init__()
        try:
            import asyncua.sync  # noqa: F401
        except ImportError:
            raise missing("asyncua", "asyncua") from None
        self.url, self.vent_node = url, vent_node
        self.check = bool(require_flag("check", check))
        self.namespace = require_count("namespace", namespace, 0)
        self.timeout = require_positive("timeout", timeout, "s")
        self._failures, self._renewing, self._closed = 0, False, False
        self._order = time.time_ns()  # rises from run to run
        self._commands: dict[str, Command] = {}
        self._addresses: dict[str, str] = {}
        self._nodes: dict[str, Any] = {}
        self._read: list[str] = []
        try:
            self._client: Any = self._connected()
        except Exception as error:  # asyncua's own, sockets', asyncio's
            raise InputError(f"url = {url!r} does not answer ({_text_of(error)})") from None

    def _connected(self) -> Any:
        """A client that is; raises anything."""
        from asyncua.sync import Client

        client: Any = Client(self.url, timeout=max(self.timeout, CONNECTING))
        try:
            client.connect()
        except Exception:
            client.tloop.stop()
            raise
        client.aio_obj.uaclient._timeout = client.aio_obj.uaclient.protocol.timeout = self.timeout
        client.tloop.timeout = self.timeout + SLACK
        return client

    def open(self, readings: Mapping[str, Reading], commands: Mapping[str, Command]) -> None:
        """The channels with their nodes. Raises InputError."""
        self._commands = dict(commands)
        self._read = [n for n, r in readings.items() if not r.slope_of]
        self._addresses = {
            c.name: self._address(c)
            for c in (*readings.values(), *commands.values())
            if not getattr(c, "slope_of", "")
        }
        if self.check:
            self._addresses |= {n: f"ns={self.namespace};s={n}" for n in ("sample", "order")}
        self._find(self._client)

    def _find(self, client: Any) -> None:
        self._nodes = {n: client.get_node(a) for n, a in self._addresses.items()}

    def _address(self, channel: Channel) -> str:
        own = channel.address
        return own if isinstance(own, str) else f"ns={self.namespace};s={channel.name}"

    def _asked(self, call: Any, *arguments: Any) -> Any:
        try:
            answer = call(*arguments)
        except Exception as error:  # asyncua's own, sockets', asyncio's
            self.counts["missing"] += 1
            self._failures += 1
            if self._failures >= FAILURES or isinstance(error, ConnectionError):
                self._renew()
            raise DriverError(f"{self.url}: {_text_of(error)}") from None
        self._failures = 0
        self.counts["answers"] += 1
        return answer

    def _renew(self) -> None:
        """Another connection, made in a thread: the loop goes on without answers meanwhile."""
        if self._renewing or self._closed:
            return
        self._renewing, old = True, self._client

        def work() -> None:
            try:
                fresh = self._connected()
                self._find(fresh)
                self._client, self._failures = fresh, 0
                _dropped(old)
                if self._closed:
                    _dropped(fresh)
            except Exception:  # tried again at the next failure
                self._failures = FAILURES
            finally:
                self._renewing = False

        threading.Thread(target=work, daemon=True).start()

    def _ready(self) -> None:
        if self._renewing:
            self.counts["missing"] += 1
            raise DriverError(f"{self.url}: the connection is made anew")

    def read(self) -> dict[str, float]:
        """See :class:`Driver`."""
        import asyncua

        self._ready()
        names = ["sample"] if self.check else self._read
        nodes = [self._nodes[n].aio_obj for n in names]
        ua: Any = asyncua.ua
        attribute = ua.AttributeIds.Value

        async def ask() -> Any:
            return await self._client.aio_obj.uaclient.read_attributes(
                [n.nodeid for n in nodes], attribute
            )

        answers = self._asked(lambda: self._client.tloop.post(ask()))
        received, found, stamps = self.now(), {}, []
        if len(answers) != len(names) or any(a.Value is None for a in answers):
            self.counts["damaged"] += 1
            raise DriverError(f"{self.url}: an answer does not hold what was asked for")
        if self.check:
            return self._whole(answers[0].Value.Value, received)
        for name, answer in zip(self._read, answers, strict=True):
            if not answer.StatusCode.is_good():
                self.counts["damaged"] += 1
                raise DriverError(f"{self.url}: {name} is of quality {answer.StatusCode.name}")
            found[name] = float(answer.Value.Value)
            if answer.SourceTimestamp is not None:
                stamps.append(answer.SourceTimestamp.timestamp())
        oldest = min(stamps, default=None)
        return {**found, "time": received if oldest is None else self._stamp(oldest, received)}

    def _whole(self, text: Any, received: float) -> dict[str, float]:
        """The readings of a text with its check sum."""
        body = unframed(text.encode("ascii", "replace")) if isinstance(text, str) else None
        try:
            device, *values = (float(f) for f in (body or "").split(" "))
            found = dict(zip(self._read, values, strict=True))
        except ValueError:
            self.counts["damaged"] += 1
            raise DriverError(f"{self.url}: the check sum of the sample is wrong") from None
        return {**found, "time": self._stamp(1e-6 * device, received)}

    def _send(self, values: Mapping[Any, Any]) -> None:
        self._ready()
        self._asked(self._client.write_values, list(values), list(values.values()))

    def write(self, inputs: Mapping[str, float]) -> None:
        """See :class:`Driver`."""
        if self.check:
            self._order += 1
            numbers = " ".join(repr(float(inputs[n])) for n in self._commands)
            text = framed(f"{self._order} {numbers}").decode().rstrip()
            self._send({self._nodes["order"]: text})
        else:
            self._send({self._nodes[n]: float(inputs[n]) for n in self._commands})

    def vent(self) -> None:
        """See :class:`Driver`."""
        if self.vent_node is not None:
            self._send({self._client.get_node(self.vent_node): True})
        else:
            self.write({n: c.raw_vent for n, c in self._commands.items()})

    def arm(self) -> None:
        """Let the server act again."""
        if self.vent_node is not None:
            self._send({self._client.get_node(self.vent_node): False})

    def close(self) -> None:
        """See :class:`Driver`."""
        self._closed = True
        _dropped(self._client)

    def emergency(self) -> Emergency:
        """A session of its own, in a process that loads asyncua."""
        commands = {n: (self._address(c), c.raw_vent) for n, c in self._commands.items()}
        arguments = {
            "url": self.url,
            "vent_node": self.vent_node,
            "commands": commands,
            "check": self.check,
        }
        return Emergency("call", "pam_ocp.rig.drivers.opc_ua:venting", arguments=arguments)


def _dropped(client: Any) -> None:
    """Let go of a client, whatever it says."""
    client.tloop.timeout = CONNECTING
    with contextlib.suppress(Exception):
        client.disconnect()
    with contextlib.suppress(Exception):
        client.tloop.stop()


def venting(
    url: str,
    vent_node: str | None,
    commands: Mapping[str, tuple[str, float]],
    check: bool = False,
) -> OpcUa:
    """What the watchdog makes, to vent by it."""
    driver = OpcUa(url, vent_node, timeout=1.0, check=check)
    sent = {
        n: Command(n, "1", low=v - 1, high=v + 1, vent=v, address=a)
        for n, (a, v) in commands.items()
    }
    driver.open({}, sent)
    return driver

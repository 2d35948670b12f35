"""OPC UA: controllers of machines that offer their variables as nodes (asyncua)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ...core.errors import InputError, require_count, require_positive
from ..channels import Channel, Command, Reading
from .driver import DRIVERS, Clocked, DriverError, Emergency, missing

__all__ = ["OpcUa"]


@DRIVERS.register("opcua", units={"timeout": "s"})
class OpcUa(Clocked):
    """Nodes of an OPC UA server (asyncua), each channel at its ``address`` ("ns=2;s=x").

    url : such as "opc.tcp://192.168.0.10:4840". namespace : of channels without such an address,
    which are called as they are. vent_node : a Boolean that vents when it is True;
    without one the commands' vent values are sent. timeout : for an answer [s].

    A value whose quality is not good is none. Its stamp is the server's source time, where there is
    one.

    Examples
    --------
    >>> from pam_ocp.rig.drivers.driver import DRIVERS
    >>> sorted(DRIVERS)
    ['modbus', 'opcua', 'serial', 'twin', 'udp']
    """

    def __init__(
        self, url: str, vent_node: str | None = None, namespace: int = 2, timeout: float = 0.05
    ) -> None:
        super().__init__()
        try:
            from asyncua.sync import Client
        except ImportError:
            raise missing("asyncua", "asyncua") from None
        self.url, self.vent_node = url, vent_node
        self.namespace = require_count("namespace", namespace, 0)
        self.timeout = require_positive("timeout", timeout, "s")
        self._client: Any = Client(url, timeout=max(self.timeout, 1.0))  # of connecting
        try:
            self._client.connect()
        except Exception as error:  # asyncua's own, sockets', asyncio's
            self._client.tloop.stop()
            raise InputError(f"url = {url!r} does not answer ({error})") from None
        self._client.aio_obj.uaclient._timeout = self.timeout
        self._commands: dict[str, Command] = {}
        self._nodes: dict[str, Any] = {}
        self._read: list[str] = []

    def open(self, readings: Mapping[str, Reading], commands: Mapping[str, Command]) -> None:
        """The channels with their nodes. Raises InputError."""
        self._commands = dict(commands)
        self._read = [n for n, r in readings.items() if not r.slope_of]
        self._nodes = {
            c.name: self._client.get_node(self._address(c))
            for c in (*readings.values(), *commands.values())
            if not getattr(c, "slope_of", "")
        }

    def _address(self, channel: Channel) -> str:
        own = channel.address
        return own if isinstance(own, str) else f"ns={self.namespace};s={channel.name}"

    def _asked(self, call: Any, *arguments: Any) -> Any:
        try:
            answer = call(*arguments)
        except Exception as error:  # asyncua's own, sockets', asyncio's
            self.counts["missing"] += 1
            raise DriverError(f"{self.url}: {error or type(error).__name__}") from None
        self.counts["answers"] += 1
        return answer

    def read(self) -> dict[str, float]:
        """See :class:`Driver`."""
        import asyncua

        nodes = [self._nodes[n].aio_obj for n in self._read]
        ua: Any = asyncua.ua
        attribute = ua.AttributeIds.Value

        async def ask() -> Any:
            return await self._client.aio_obj.uaclient.read_attributes(
                [n.nodeid for n in nodes], attribute
            )

        answers = self._asked(lambda: self._client.tloop.post(ask()))
        received, found, stamps = self.now(), {}, []
        for name, answer in zip(self._read, answers, strict=True):
            if not answer.StatusCode.is_good():
                self.counts["damaged"] += 1
                raise DriverError(f"{self.url}: {name} is of quality {answer.StatusCode.name}")
            found[name] = float(answer.Value.Value)
            if answer.SourceTimestamp is not None:
                stamps.append(answer.SourceTimestamp.timestamp())
        oldest = min(stamps, default=None)
        return {**found, "time": received if oldest is None else self._stamp(oldest, received)}

    def _send(self, values: Mapping[Any, Any]) -> None:
        self._asked(self._client.write_values, list(values), list(values.values()))

    def write(self, inputs: Mapping[str, float]) -> None:
        """See :class:`Driver`."""
        self._send({self._nodes[n]: float(inputs[n]) for n in self._commands})

    def vent(self) -> None:
        """See :class:`Driver`."""
        if self.vent_node is not None:
            self._send({self._client.get_node(self.vent_node): True})
        else:
            self.write({n: c.raw(float(c.vent or 0.0)) for n, c in self._commands.items()})

    def arm(self) -> None:
        """Let the server act again."""
        if self.vent_node is not None:
            self._send({self._client.get_node(self.vent_node): False})

    def close(self) -> None:
        """See :class:`Driver`."""
        self._client.disconnect()

    def emergency(self) -> Emergency:
        """A session of its own, in a process that loads asyncua."""
        commands = {
            n: (self._address(c), c.raw(float(c.vent or 0.0))) for n, c in self._commands.items()
        }
        arguments = {"url": self.url, "vent_node": self.vent_node, "commands": commands}
        return Emergency("call", "pam_ocp.rig.drivers.opc_ua:venting", arguments=arguments)


def venting(url: str, vent_node: str | None, commands: Mapping[str, tuple[str, float]]) -> OpcUa:
    """What the watchdog makes, to vent by it."""
    driver = OpcUa(url, vent_node, timeout=1.0)
    sent = {
        n: Command(n, "1", low=v - 1, high=v + 1, vent=v, address=a)
        for n, (a, v) in commands.items()
    }
    driver.open({}, sent)
    return driver

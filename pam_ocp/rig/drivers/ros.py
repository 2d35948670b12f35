"""ROS 2: topics of a robot's nodes (rclpy)."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

from ...core.errors import InputError, require_positive
from ..channels import Channel, Command, Reading
from .driver import DRIVERS, Clocked, DriverError, Emergency

FIELDS = ("position", "velocity", "effort")
KINDS = ("JointState", "Float64MultiArray")
DEPTH = 1
"""Of the queues: the newest message counts."""


@DRIVERS.register("ros", units={"timeout": "s"})
class Ros(Clocked):
    """Topics of ROS 2: readings from one, commands to another (rclpy, which comes with ROS 2).

    states : topic of the readings, of the type ``message``. A channel's ``address`` is in a
    "JointState" "JOINT.position" (or velocity, effort; by default the channel's name and its
    position), in a "Float64MultiArray" its index (by default its place among the readings).
    commands : topic of a Float64MultiArray with all commands in the order of the channels.
    vent : topic of a Bool, true to vent and false to act; without one the commands' vent values are
    sent. timeout : for the first message [s].

    ROS answers nothing: the age of the newest message says whether the robot is there, by the
    stamp in its header, and of arrays by their arrival.

    Examples
    --------
    >>> from pam_ocp.rig.drivers.driver import DRIVERS
    >>> DRIVERS["ros"].__name__
    'Ros'
    """

    def __init__(
        self,
        states: str = "joint_states",
        commands: str = "commands",
        vent: str | None = None,
        message: str = "JointState",
        node: str = "pam_ocp_rig",
        timeout: float = 0.5,
    ) -> None:
        super().__init__()
        if message not in KINDS:
            raise InputError(f"message = {message!r}: choose one of {', '.join(KINDS)}")
        self.timeout, self.message = require_positive("timeout", timeout, "s"), message
        self._topics = {"states": states, "commands": commands, "vent": vent}
        try:
            import rclpy
            from rclpy.executors import SingleThreadedExecutor
            from sensor_msgs import msg as sensors
            from std_msgs import msg as standard
        except ImportError:
            raise InputError(
                "this driver needs rclpy, which is part of ROS 2 and not on PyPI: install ROS 2, "
                "and source its setup file before Python is started"
            ) from None
        self._types: Any = standard
        self._begun = not rclpy.ok()
        if self._begun:
            rclpy.init()
        self._ros: Any = rclpy
        self._node: Any = rclpy.create_node(node)
        joints = message == "JointState"
        kind = sensors.JointState if joints else standard.Float64MultiArray
        self._node.create_subscription(kind, states, self._taken, DEPTH)
        self._out: Any = self._node.create_publisher(standard.Float64MultiArray, commands, DEPTH)
        self._vents: Any = vent and self._node.create_publisher(standard.Bool, vent, DEPTH)
        self._executor: Any = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._first = threading.Event()
        self._newest: tuple[Any, float] | None = None
        self._commands: dict[str, Command] = {}
        self._places: dict[str, tuple[str, int | str]] = {}
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def _taken(self, message: Any) -> None:
        self._newest = message, self.now()
        self.counts["answers"] += 1
        self._first.set()

    def open(self, readings: Mapping[str, Reading], commands: Mapping[str, Command]) -> None:
        """The channels with their places in messages. Raises InputError."""
        self._commands = dict(commands)
        own = [r for r in readings.values() if not r.slope_of]
        self._places = {r.name: self._place(r, i) for i, r in enumerate(own)}

    def _place(self, channel: Channel, index: int) -> tuple[str, int | str]:
        """(field, joint or index)."""
        given = channel.address
        if self.message == "Float64MultiArray":
            if given is None:
                return "data", index
            if not isinstance(given, int) or isinstance(given, bool) or given < 0:
                raise InputError(f"{channel.name}: address = {given!r}: give an index of the array")
            return "data", given
        joint, _, field = str(channel.name if given is None else given).rpartition(".")
        if field not in FIELDS:
            joint, field = str(channel.name if given is None else given), "position"
        return field, joint

    # ---- a Driver -------------------------------------------------------------------------------
    def read(self) -> dict[str, float]:
        """See :class:`Driver`."""
        if self._newest is None:
            self._first.wait(self.timeout)
        if self._newest is None:
            self.counts["missing"] += 1
            raise DriverError(f"nothing comes from the topic {self._topics['states']}")
        message, received = self._newest
        try:
            found = {n: self._value(message, *place) for n, place in self._places.items()}
        except (LookupError, ValueError) as error:
            self.counts["damaged"] += 1
            raise DriverError(f"a message of {self._topics['states']} has no {error}") from None
        stamp = received
        if self.message == "JointState":
            at = message.header.stamp
            stamp = self._stamp(at.sec + 1e-9 * at.nanosec, received)
        return {**found, "time": stamp}

    @staticmethod
    def _value(message: Any, field: str, place: int | str) -> float:
        if isinstance(place, str):
            names = list(message.name)
            if place not in names:
                raise LookupError(f"joint {place}")
            place = names.index(place)
        values = getattr(message, field)
        if place >= len(values):
            raise LookupError(f"{field}[{place}]")
        return float(values[place])

    def write(self, inputs: Mapping[str, float]) -> None:
        """See :class:`Driver`."""
        values = [float(inputs[n]) for n in self._commands]
        self._out.publish(self._types.Float64MultiArray(data=values))

    def vent(self) -> None:
        """See :class:`Driver`."""
        if self._vents:
            self._vents.publish(self._types.Bool(data=True))
        self.write({n: c.raw_vent for n, c in self._commands.items()})

    def arm(self) -> None:
        """Let the robot act again."""
        if self._vents:
            self._vents.publish(self._types.Bool(data=False))

    def close(self) -> None:
        """See :class:`Driver`."""
        self._executor.shutdown()
        self._thread.join(5.0)
        with contextlib.suppress(Exception):  # ROS may be shut down already
            self._node.destroy_node()
            if self._begun:
                self._ros.shutdown()

    def emergency(self) -> Emergency:
        """A node of its own, in a process that loads rclpy."""
        arguments = {
            **self._topics,
            "values": {n: c.raw_vent for n, c in self._commands.items()},
        }
        return Emergency("call", "pam_ocp.rig.drivers.ros:venting", arguments=arguments)


def venting(states: str, commands: str, vent: str | None, values: Mapping[str, float]) -> Ros:
    """What the watchdog makes, to vent by it."""
    driver = Ros(states, commands, vent, node="pam_ocp_vent")
    driver.open(
        {},
        {n: Command(n, "1", low=v - 1, high=v + 1, vent=v) for n, v in values.items()},
    )
    time.sleep(0.2)  # for subscribers to be found
    return driver

"""The driver of ROS 2, on a stub of rclpy, and on rclpy itself where it is installed."""

import sys
import threading
import time
import types

import pytest
from conftest import refused
from rig_fixtures import plant  # noqa: F401 - a fixture

import pam_ocp as pam


class Message:
    """Of the stub: fields as they are given."""

    def __init__(self, **fields):
        self.__dict__.update(fields)


class Bus:
    """Topics of the stub: {name: callbacks}; what is published is called back at once."""

    def __init__(self):
        self.heard, self.published = {}, []

    def publish(self, topic, message):
        self.published.append((topic, message))
        for act in self.heard.get(topic, []):
            act(message)


@pytest.fixture
def bus(monkeypatch):
    bus, begun = Bus(), []

    class Node:
        def __init__(self, name):
            self.name = name

        def create_subscription(self, kind, topic, act, depth):
            bus.heard.setdefault(topic, []).append(act)

        def create_publisher(self, kind, topic, depth):
            return types.SimpleNamespace(publish=lambda m: bus.publish(topic, m))

        def destroy_node(self):
            begun.append("destroyed")

    class Executor:
        def __init__(self):
            self.over = threading.Event()

        def add_node(self, node):
            pass

        def spin(self):
            self.over.wait()

        def shutdown(self):
            self.over.set()

    rclpy = types.ModuleType("rclpy")
    rclpy.ok, rclpy.init = lambda: bool(begun), lambda: begun.append("init")
    rclpy.create_node, rclpy.shutdown = Node, lambda: begun.append("shutdown")
    rclpy.executors = types.ModuleType("rclpy.executors")
    rclpy.executors.SingleThreadedExecutor = Executor
    for name, found in {"rclpy": rclpy, "rclpy.executors": rclpy.executors}.items():
        monkeypatch.setitem(sys.modules, name, found)
    for package, names in {
        "sensor_msgs": ("JointState",),
        "std_msgs": ("Float64MultiArray", "Bool"),
    }.items():
        whole, inner = types.ModuleType(package), types.ModuleType(f"{package}.msg")
        for name in names:
            setattr(inner, name, type(name, (Message,), {}))
        whole.msg = inner
        monkeypatch.setitem(sys.modules, package, whole)
        monkeypatch.setitem(sys.modules, f"{package}.msg", inner)
    bus.begun = begun
    return bus


def joints(x, pressure, t):
    stamp = types.SimpleNamespace(sec=int(t), nanosec=round(1e9 * (t - int(t))))
    return Message(
        header=types.SimpleNamespace(stamp=stamp),
        name=["other", "slide", "muscle"],
        position=[9.0, x, 0.0],
        velocity=[],
        effort=[0.0, 0.0, pressure],
    )


READINGS = [
    pam.rig.Reading("x", address="slide.position", low="-30 mm", high="90 mm"),
    pam.rig.Reading("muscle.pressure", address="muscle.effort", scale="bar"),
]


@pytest.fixture
def robot(bus, plant):
    """A twin behind the topics of the stub: (bus, twin)."""
    twin, ended = pam.rig.Twin(plant), threading.Event()

    def commanded(message):
        twin.write({"muscle.command": message.data[0]})

    bus.heard["commands"] = [commanded]
    bus.heard["vent"] = [lambda m: twin.vent() if m.data else twin.arm()]

    def work():
        while not ended.wait(2e-3):
            seen = twin.read()
            message = joints(seen["x"], seen["muscle.pressure"] / 1e5, seen["time"] + 1e6)
            bus.publish("joint_states", message)

    thread = threading.Thread(target=work)
    thread.start()
    yield bus, twin
    ended.set()
    thread.join()


def test_a_rig_behind_topics_runs_under_the_guard_and_is_vented(robot, plant):
    bus, twin = robot
    driver = pam.rig.driver("ros", vent="vent")
    guard = pam.rig.Guard(max_age="1 s", late="1 s")
    with pam.Rig(driver, READINGS, plant=plant, guard=guard, watchdog=False) as rig:
        rig.arm()
        run = rig.run(lambda t: {"muscle.command": 2.5e5}, 1.0)
        assert run["x"][-1] > 0.01
        assert abs(run["muscle.pressure"][-1] - 2.5e5) < 2e4
        assert not twin.armed
        assert time.monotonic() - rig.read()["time"] < 1.0  # by the header's stamp
    assert bus.begun[-1] == "shutdown"


def test_a_robot_that_falls_silent_is_vented(bus, plant):
    """One message, and none after it: it grows old."""
    driver = pam.rig.driver("ros", timeout="5 ms")
    rig = pam.Rig(driver, READINGS, plant=plant, watchdog=False)
    refused("joint_states", rig.read, error=pam.rig.RigError)
    bus.publish("joint_states", joints(0.01, 1.0, 5.0))
    assert rig.read()["muscle.pressure"] == 1e5
    time.sleep(0.05)
    refused("ms old", rig.arm, error=pam.rig.RigError)
    bus.publish("joint_states", Message(**{**joints(0, 0, 6.0).__dict__, "name": ["other"]}))
    refused("has no joint slide", rig.read, error=pam.rig.RigError)
    rig.close()


def test_arrays_have_their_readings_by_index(bus):
    driver = pam.rig.driver("ros", message="Float64MultiArray", states="array")
    readings = {"a": pam.rig.Reading("a", "1"), "b": pam.rig.Reading("b", "1", address=3)}
    commands = {n: pam.rig.Command(n, "1", low=0.0, high=9.0) for n in ("u", "w")}
    driver.open(readings, commands)
    bus.publish("array", Message(data=[1.0, 2.0, 3.0, 4.0]))
    seen = driver.read()
    assert (seen["a"], seen["b"]) == (1.0, 4.0)
    driver.write({"w": 2.0, "u": 1.0})
    assert bus.published[-1][0] == "commands"
    assert bus.published[-1][1].data == [1.0, 2.0]
    emergency = driver.emergency()
    assert emergency.arguments["values"] == {"u": 0.0, "w": 0.0}
    driver.close()


def test_without_ros_the_driver_says_what_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    refused("part of ROS 2", pam.rig.driver, "ros")
    refused("Float64MultiArray", pam.rig.driver, "ros", message="Image")


def test_on_rclpy_itself_a_message_comes_and_goes():
    rclpy = pytest.importorskip("rclpy", reason="no ROS 2 here: the driver is tested on a stub")
    from sensor_msgs.msg import JointState

    driver = pam.rig.driver("ros", timeout="5 s")
    driver.open({"x": pam.rig.Reading("x", "m")}, {})
    node = rclpy.create_node("tests")
    publisher = node.create_publisher(JointState, "joint_states", 1)
    end = time.monotonic() + 10.0
    while driver._newest is None and time.monotonic() < end:
        publisher.publish(JointState(name=["x"], position=[0.25]))
        time.sleep(0.05)
    assert driver.read()["x"] == 0.25
    node.destroy_node()
    driver.close()

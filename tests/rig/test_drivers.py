"""Drivers against servers of their own kind, over lines that drop, double, delay and damage."""

import socket
import struct
import sys
import threading
import time
import zlib

import numpy as np
import pytest
from conftest import refused
from rig_fixtures import made, plant  # noqa: F401 - fixtures
from rig_tools import Bad, BadSerial, BadTcp, BadUdp, Counting, arm, end_of, quiet, through

import pam_ocp as pam
from pam_ocp.rig.drivers.driver import DeviceClock
from pam_ocp.rig.drivers.lines import LineServer, framed, unframed
from pam_ocp.rig.drivers.modbus import packed, unpacked

SECONDS = 1.5
posix = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


def opened(kind, device, **address):
    driver = pam.rig.driver(kind, **address)
    driver.open(device.readings, device.commands)
    return driver


def talk(driver, device, seconds=SECONDS, doubled=False):
    """Reads and writes for a while: (answers, failures, longest call [s]).

    doubled : the same look may be read twice, of a server that looks by itself.
    """
    good, failed, longest, last = 0, 0, 0.0, 0.0
    end, k = time.monotonic() + seconds, 0
    while time.monotonic() < end:
        k += 1
        begin = time.monotonic()
        try:
            if k % 2:
                seen = driver.read()
                assert seen["b"] == 1.0 - 2.0 * seen["a"]
                assert seen["a"] == int(seen["a"])
                assert seen["a"] > last or (doubled and seen["a"] == last)  # neither old nor twice
                last = seen["a"]
            else:
                driver.write({"u": float(k), "w": 3.0 * k})
            good += 1
        except pam.rig.DriverError:
            failed += 1
            if doubled:
                time.sleep(2e-3)  # it is connecting
        longest = max(longest, time.monotonic() - begin)
    assert all(sent["w"] == 3.0 * sent["u"] for sent in device.written)
    numbers = [sent["u"] for sent in device.written]
    assert numbers == sorted(numbers)
    return good, failed, longest


@pytest.mark.parametrize(
    ("kind", "way", "bad", "timeout", "library"),
    [
        ("udp", BadUdp, {"seed": 1}, 0.02, "socket"),
        ("udp", BadUdp, {"seed": 2}, 0.02, "socket"),
        pytest.param("serial", BadSerial, {"seed": 3}, 0.02, "serial", marks=posix),
        ("modbus", BadTcp, {"seed": 4, "share": 0.02}, 0.03, "pymodbus"),
    ],
    ids=["udp 1", "udp 2", "serial", "modbus"],
)
def test_no_wrong_value_is_taken_from_a_bad_line(kind, way, bad, timeout, library):
    pytest.importorskip(library)
    device, bad = Counting(), Bad(**bad)
    with pam.rig.serve(device, kind) as served, way(end_of(served.address), bad) as between:
        address = {**through(served.address, between), "timeout": timeout}
        driver = opened(device=device, **address)
        good, failed, longest = talk(driver, device)
        driver.close()
    assert all(bad.done.values()), bad.done
    assert good > 3 * failed > 0 or failed == 0
    assert good > 30
    assert longest < 1.0
    if kind == "udp":
        assert driver.counts["damaged"] + driver.counts["late"] > 0


@pytest.mark.slow
def test_opc_ua_reads_and_writes_the_nodes_of_a_server():
    pytest.importorskip("asyncua")
    device = Counting()
    with pam.rig.serve(device, "opcua") as served:
        driver = opened(device=device, **served.address)
        driver.arm()
        end = time.monotonic() + 10.0
        driver.write({"u": 5.0, "w": 15.0})
        while (not device.written or device.written[-1]["u"] != 5.0) and time.monotonic() < end:
            time.sleep(0.01)
        seen = driver.read()
        assert abs(seen["time"] - time.monotonic()) < 5.0
        before = device.vents  # those of connecting are over: a write came after them
        driver.vent()
        while device.vents == before and time.monotonic() < end:
            time.sleep(0.01)
        driver.close()
    assert device.armed
    assert device.written[-1] == {"u": 5.0, "w": 15.0}
    assert device.vents > before
    assert seen["a"] >= 1.0


@pytest.mark.slow
def test_a_server_of_opc_ua_outlives_values_of_bad_quality_and_leaves_no_thread():
    """A damaged frame may write one: seen after some minutes of a bad line."""
    asyncua = pytest.importorskip("asyncua")
    from asyncua.sync import Client

    before, device, ua = set(threading.enumerate()), Counting(), asyncua.ua
    with pam.rig.serve(device, "opcua") as served:
        driver = opened(**{**served.address, "device": device, "timeout": 2.0})
        arm(driver, device)
        vents = device.vents
        with Client(served.address["url"]) as client:
            for name, value in (("order", "x"), ("vent", True), ("u", 1.0)):
                wrong = ua.DataValue(ua.Variant(value), ua.StatusCode(0x7F000000))
                client.get_node(f"ns=2;s={name}").write_value(wrong)
        time.sleep(0.1)
        assert device.vents == vents
        last = driver.read()["a"]
        driver.write({"u": 2.0, "w": 6.0})
        end = time.monotonic() + 10.0
        while not (device.written and device.written[-1]["u"] == 2.0) and time.monotonic() < end:
            time.sleep(0.01)
        assert device.written[-1] == {"u": 2.0, "w": 6.0}
        assert driver.read()["a"] > last
        driver.close()
    end = time.monotonic() + 10.0
    while (left := set(threading.enumerate()) - before) and time.monotonic() < end:
        time.sleep(0.01)
    assert not left


@pytest.mark.slow
def test_opc_ua_takes_no_wrong_value_from_a_bad_line_and_connects_again():
    pytest.importorskip("asyncua")
    device, bad = Counting(), Bad(5, share=0.008)
    with pam.rig.serve(device, "opcua") as served, BadTcp(end_of(served.address), bad) as between:
        address = through(served.address, between)
        with quiet(bad):
            driver = opened(device=device, **address)
            arm(driver, device)
        good, failed, longest = talk(driver, device, 12.0, doubled=True)
        driver.close()
    assert all(bad.done.values()), bad.done
    assert failed > 3  # connections broke,
    assert good > 200  # and were made anew
    assert longest < 0.5
    assert len(device.written) > 20


def test_opc_ua_says_when_the_server_is_gone():
    pytest.importorskip("asyncua")
    with pytest.raises(pam.InputError, match="does not answer"):
        pam.rig.driver("opcua", url="opc.tcp://127.0.0.1:9", timeout="0.1 s")


def test_a_line_is_that_of_the_documentation():
    body = ">7 W 0.5 2.0"
    assert framed(body) == f"{body}*{zlib.crc32(body.encode()):08X}\n".encode()
    assert unframed(framed(body)) == body
    for place in range(len(framed(body)) - 1):
        damaged = bytearray(framed(body))
        damaged[place] ^= 4
        assert unframed(bytes(damaged)) is None


def test_a_device_acts_once_on_a_line_and_vents_always():
    device = Counting()
    server = LineServer(device, ["a", "b"], ["u", "w"])
    assert server.answer(framed(">10 W 1.0 3.0"))
    assert not server.answer(framed(">10 W 1.0 3.0"))
    assert not server.answer(framed(">9 W 2.0 6.0"))
    assert not server.answer(framed(">11 W 2.0"))
    assert server.answer(framed(">0 V"))
    assert device.written == [{"u": 1.0, "w": 3.0}]
    assert device.vents == 1


def test_registers_are_those_of_ieee_754_high_word_first():
    assert packed(1.5, "float32") == list(struct.unpack(">HH", struct.pack(">f", 1.5)))
    assert unpacked(packed(-7.0, "int16"), "int16") == -7.0
    assert packed(70000.0, "uint16") == [65535]
    assert packed(-1.0, "int32") == [0xFFFF, 0xFFFF]


def test_modbus_speaks_with_the_server_of_pymodbus():
    """A server that is not ours, without check sums, clock and vent coil."""
    pytest.importorskip("pymodbus")
    import asyncio
    import threading

    server_module = pytest.importorskip("pymodbus.server")
    data = pytest.importorskip("pymodbus.simulator")
    if not hasattr(data, "SimDevice"):
        pytest.skip("pymodbus before 3.12")
    registers = packed(1.25, "float32") + packed(-3.0, "float32")
    simple = [
        data.SimData(0, values=[*[0] * 2, *registers, *[0] * 4], datatype=data.DataType.REGISTERS)
    ]
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    loop, made, ready = asyncio.new_event_loop(), [], threading.Event()

    def work():
        async def serve():
            made.append(
                server_module.ModbusTcpServer(
                    data.SimDevice(1, simdata=simple), address=("127.0.0.1", port)
                )
            )
            await made[0].serve_forever(background=True)
            ready.set()

        loop.run_until_complete(serve())
        loop.run_forever()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    assert ready.wait(10.0)
    device = Counting()
    driver = opened("modbus", device, host="127.0.0.1", port=port, timeout=1.0)
    try:
        seen = driver.read()
        assert (seen["a"], seen["b"]) == (1.25, -3.0)
        driver.write({"u": 2.5, "w": 7.5})
    finally:
        driver.close()
        asyncio.run_coroutine_threadsafe(made[0].shutdown(), loop).result(10.0)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(10.0)


def test_the_stamp_of_a_device_that_stands_still_grows_old():
    clock = DeviceClock()
    stamps = [clock(1.0 + k * 0.01, 100.0 + k * 0.01 + 0.002 * (k % 3)) for k in range(50)]
    assert np.allclose(stamps, 100.0 + 0.01 * np.arange(50), atol=1e-4)
    assert 101.0 - clock(1.49, 101.0) > 0.5


@pytest.mark.parametrize(
    ("kind", "arguments", "words"),
    [
        ("modbos", {}, "modbus"),
        ("udp", {"host": "127.0.0.1"}, "port"),
        ("udp", {"host": "127.0.0.1", "port": 70000}, "65535"),
        ("serial", {"port": "/dev/nothing"}, "cannot be opened"),
        ("modbus", {"host": "127.0.0.1", "timeout": "5 mm"}, "timeout"),
        ("udp", {"host": "127.0.0.1", "port": 1, "baud": 1}, "baud"),
    ],
)
def test_what_a_driver_cannot_be_is_said_in_a_sentence(kind, arguments, words):
    if kind in ("serial", "modbus"):
        pytest.importorskip({"serial": "serial", "modbus": "pymodbus"}[kind])
    refused(words, pam.rig.driver, kind, **arguments)

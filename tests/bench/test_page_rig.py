"""The tab Rig in a real browser, on a twin: arming, moving, venting when the rest hangs."""

import json
import os
import signal
import subprocess
import sys
import time
import urllib.request

import pytest
from browser_tools import Hand, Server
from page_fixtures import driver  # noqa: F401 - a fixture

import pam_ocp as pam

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="stops processes by signals"),
]
RIG = """
sample_time = "10 ms"
plant = {{ arrangement = "HangingLoad", muscle = "DMSP-20-300" }}
driver = {{ kind = "udp", host = "127.0.0.1", port = {port}, timeout = "0.2 s" }}
readings.x = {{ low = "-30 mm", high = "90 mm" }}
readings."muscle.pressure" = {{ low = "-0.5 bar", high = "7 bar" }}
commands."muscle.command" = {{ high = "6 bar" }}
guard = {{ max_age = "1 s", late = "1 s", heartbeat = "60 s" }}
"""
"""Its watchdog waits so long that what vents sooner is the button."""


@pytest.fixture
def rig_page(driver, tmp_path):  # noqa: F811
    """(hand on the tab Rig, server, twin)."""
    pytest.importorskip("nicegui")
    twin = pam.rig.Twin(pam.HangingLoad("DMSP-20-300"))
    with pam.rig.serve(twin, "udp") as served:
        (tmp_path / "bench.toml").write_text(RIG.format(port=served.address["port"]))
        server = Server(tmp_path, "--rig", str(tmp_path / "bench.toml"))
        driver.delete_all_cookies()
        hand = Hand(driver)
        hand.open(server.address.replace("/?", "/new?"))
        hand.press("Rig")
        hand.sees("not armed: the air is out")
        yield hand, server, twin
        driver.get("about:blank")
        server.process.send_signal(signal.SIGCONT)
        assert "Traceback" not in server.end()


def armed_and_moving(hand, twin):
    hand.until(lambda: hand.all("iframe"), "the vent button")
    assert "Arm" not in [b.text for b in hand.shown("button")]  # not before that is said:
    hand.field("Nobody is near, the emergency stop works").click()
    hand.press("Arm")
    hand.until(lambda: "\narmed" in hand.text, "armed")
    hand.type("muscle.command", "2.5")
    hand.press("Move")
    hand.until(lambda: twin.armed and twin.values["x"] > 0.01, "a motion")


def press_vent(hand):
    hand.driver.switch_to.frame(hand.all("iframe")[0])
    hand.all("button")[0].click()
    hand.until(lambda: "Vent lines were sent" in hand.text, "the answer of the button")
    hand.driver.switch_to.default_content()


def vented(hand, twin):
    """Lines reach it as datagrams; its own watchdog would take a minute."""
    hand.until(lambda: not twin.armed, "a vented twin", within=30.0)


def test_the_tab_arms_moves_shows_and_vents(rig_page):
    hand, _, twin = rig_page
    assert "Move" not in [b.text for b in hand.shown("button")]  # nothing moves that is not armed
    armed_and_moving(hand, twin)
    hand.until(lambda: max(hand.traces("x over time")[0]["y"][-5:]) > 10.0, "x [mm] in the plot")
    press_vent(hand)
    vented(hand, twin)
    hand.sees("vented: the vent button was pressed")
    hand.sees("not armed: the air is out")
    time.sleep(1.5)  # for a second the button goes on
    armed_and_moving(hand, twin)  # by a watchdog of its own
    press_vent(hand)
    vented(hand, twin)


@pytest.mark.parametrize("hung", ["page", "rig"])
def test_the_vent_button_works_when_the_rest_hangs(rig_page, hung):
    hand, server, twin = rig_page
    armed_and_moving(hand, twin)
    page = server.process.pid
    stopped = page if hung == "page" else _child_of(page, "rig_worker")
    os.kill(stopped, signal.SIGSTOP)
    try:
        press_vent(hand)
        vented(hand, twin)
    finally:
        os.kill(stopped, signal.SIGCONT)


def test_what_was_asked_before_the_button_is_not_done_after_it(tmp_path):
    twin = pam.rig.Twin(pam.HangingLoad("DMSP-20-300"))
    with pam.rig.serve(twin, "udp") as served:
        (tmp_path / "bench.toml").write_text(RIG.format(port=served.address["port"]))
        worker = subprocess.Popen(
            [sys.executable, "-m", "pam_ocp.bench.rig_worker", str(tmp_path / "bench.toml")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        with worker:
            ask(worker, "arm")
            while not heard(worker).get("armed"):
                pass
            os.kill(worker.pid, signal.SIGSTOP)
            ask(worker, "arm")
            os.kill(worker.pid, signal.SIGINT)
            os.kill(worker.pid, signal.SIGCONT)
            while "button" not in heard(worker).get("error", ""):
                pass
            ask(worker, "rest")
            states = [heard(worker)]
            while not (states[-1].get("doing") == "" and "values" not in states[-1]):
                states.append(heard(worker))
            assert not any(s["armed"] for s in states)
            assert not twin.armed
            ask(worker, "arm")  # and what is asked after it is
            while not heard(worker).get("armed"):  # whose watchdog may end it at once
                pass


def test_what_a_users_own_code_prints_is_nothing_that_the_page_reads(tmp_path):
    (tmp_path / "own.py").write_text(
        "import os\nimport pam_ocp as pam\nprint('hello', flush=True)\nos.write(1, b'of C\\n')\n"
        "plant = pam.HangingLoad\n"
    )
    (tmp_path / "bench.toml").write_text(
        'plant = { arrangement = "own.py:plant", muscle = "DMSP-20-300" }\n'
        'driver = { kind = "udp", host = "127.0.0.1", port = 9 }\n'
    )
    command = [sys.executable, "-m", "pam_ocp.bench.rig_worker", str(tmp_path / "bench.toml")]
    with subprocess.Popen(
        [*command, "--allow-code"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as worker:
        said = heard(worker)
        assert [c["name"] for c in said["channels"]] == ["x", "muscle.pressure", "muscle.command"]
        assert [c["vent"] for c in said["channels"]] == [None, None, 0.0]
        worker.stdin.close()
        printed = worker.stderr.read()
    assert "hello" in printed
    assert "of C" in printed


def ask(worker, do):
    worker.stdin.write(json.dumps({"do": do, "at": time.monotonic()}) + "\n")
    worker.stdin.flush()


def heard(worker):
    return json.loads(worker.stdout.readline())


def test_who_does_not_know_the_token_cannot_vent(rig_page):
    hand, _, twin = rig_page
    armed_and_moving(hand, twin)
    address = hand.all("iframe")[0].get_attribute("src")
    wrong = address.rpartition("/")[0] + "/guess/vent"
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(urllib.request.Request(wrong, data=b""))
    assert twin.armed
    press_vent(hand)


def _child_of(parent, name):
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                with open(f"/proc/{entry}/stat") as stat, open(f"/proc/{entry}/cmdline") as line:
                    if int(stat.read().split()[3]) == parent and name in line.read():
                        return int(entry)
            except OSError:
                continue
    raise AssertionError(f"no process {name}")

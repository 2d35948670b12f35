"""Commands of others end with who asked for them, and with all that they have started."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
import uuid
from pathlib import Path

import pytest

from pam_ocp.core.processes import Processes, end, start

posix = pytest.mark.skipif(os.name != "posix", reason="a supervisor is for POSIX")
linux = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")

RUNAWAY = """
import os, sys, time
if os.fork() == 0:
    os.setsid()
    if os.fork():
        os._exit(0)
    open(sys.argv[1], "w").write("there")
    time.sleep(600)
while not os.path.exists(sys.argv[1]):
    time.sleep(0.01)
if sys.argv[2] == "stay":
    time.sleep(600)
sys.exit(7)
"""
"""A grandchild in a session of its own, whose parent is gone."""


@pytest.fixture
def marked(monkeypatch):
    """Says which processes carry this test's mark in their environment."""
    mark = uuid.uuid4().hex
    monkeypatch.setenv("PAM_OCP_MARK", mark)

    def found(within=20.0):
        """Those that are left behind some seconds, which are given to end."""
        until = time.monotonic() + within
        while True:
            left = [pid for pid in filter(str.isdigit, os.listdir("/proc")) if carries(pid, mark)]
            if not left or time.monotonic() > until:
                return left
            time.sleep(0.02)

    return found


def carries(pid, mark):
    try:
        return (
            pid != str(os.getpid()) and mark.encode() in Path(f"/proc/{pid}/environ").read_bytes()
        )
    except OSError:
        return False


def wait_for(condition):
    until = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.01)


def runaway(tmp_path, then):
    return [sys.executable, "-c", RUNAWAY, str(tmp_path / "there"), then]


@linux
def test_what_a_command_leaves_behind_is_gone_when_it_has_ended(tmp_path, marked):
    assert start(runaway(tmp_path, "go")).wait(60) == 7
    assert marked(0.0) == []


@linux
def test_a_command_is_ended_with_what_it_has_started(tmp_path, marked):
    process = start(runaway(tmp_path, "stay"))
    wait_for((tmp_path / "there").exists)
    assert len(marked(0.0)) == 3
    end(process)
    assert marked(0.0) == []


@posix
@pytest.mark.parametrize("number", [signal.SIGSEGV, signal.SIGKILL, signal.SIGTERM])
def test_a_command_that_a_signal_ends_is_said_to_have_ended_so(number):
    kill = f"import os; os.kill(os.getpid(), {int(number)})"
    assert start([sys.executable, "-c", kill]).wait(60) == -number


@posix
def test_a_command_that_there_is_not_is_said():
    process = start(["no-such-command"], stderr=subprocess.PIPE, text=True)
    assert "no-such-command: No such file" in process.communicate()[1]
    assert process.returncode == 1


@posix
def test_who_ignores_the_ends_of_children_is_told_of_this_one():
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        process = start([sys.executable, "-c", "raise SystemExit(3)"], stdout=subprocess.PIPE)
        assert process.stdout.read() == b""
    finally:
        signal.signal(signal.SIGCHLD, before)
    process.wait()


@linux
def test_who_may_not_run_python_any_more_ends_a_command_with_its_group(
    tmp_path, marked, monkeypatch
):
    """After setuid, say; a session of its own is not found then."""
    python = sys.executable
    monkeypatch.setattr("sys.executable", str(tmp_path / "none"))
    both = "import os, time; os.fork(); open(f'{os.getpid()}', 'w'); time.sleep(600)"
    process = start([python, "-c", both], cwd=tmp_path)
    wait_for(lambda: len(list(tmp_path.iterdir())) == 2)
    assert len(marked(0.0)) == 2
    end(process)
    assert marked() == []


PARENT = """
import os, signal, sys, time
from pam_ocp.core.processes import start
number, then, folder = int(sys.argv[1]), sys.argv[2], sys.argv[3]
start(sys.argv[4:], folder)
while then == "later" and not os.path.exists(sys.argv[-2]):
    time.sleep(0.01)
os.kill(os.getpid(), number)
"""


@linux
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("when", ["at once", "later"])
def test_a_command_ends_with_who_asked_for_it(tmp_path, marked, number, when):
    """At once: before the supervisor has looked at anything."""
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "file").touch()
    said = [str(int(number)), when, str(folder), *runaway(tmp_path, "stay")]
    assert subprocess.run([sys.executable, "-c", PARENT, *said]).returncode == -number
    wait_for(lambda: not folder.exists())  # a process that just begins carries no mark yet
    assert marked() == []


@linux
def test_commands_of_several_threads_end_together(tmp_path, marked):
    """Also one that is asked for while the others are ended."""
    places, found = [tmp_path / str(i) for i in range(3)], []
    for place in places:
        place.mkdir()

    def work(place):
        try:
            done = running.run(runaway(place, "stay"), place, dict(os.environ))
            found.append(done.returncode)
        except OSError as error:
            found.append(str(error))

    threads = [threading.Thread(target=work, args=(place,)) for place in places]
    with Processes() as running:
        for thread, place in zip(threads[:2], places, strict=False):
            thread.start()
            wait_for((place / "there").exists)
    threads[2].start()
    for thread in threads:
        thread.join(60)
    assert sorted(map(str, found)) == ["-9", "-9", "the other commands were ended"]
    assert marked(0.0) == []


COMPILE = """
import random, sys
from pam_ocp.export.compile import compile_all, platforms_named
print("go", flush=True)
text = f"double f(double x) {{ return x + {random.SystemRandom().random()}; }}"
while True:
    text += " "
    names = ["x86_64-linux", "aarch64-linux"]
    compile_all({"a.c": text}, "a.c", platforms_named(names), "a")
"""


@linux
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGKILL])
def test_no_compiler_outlives_the_script_that_asked_for_it(tmp_path, marked, monkeypatch, number):
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / "cache"))
    command = [sys.executable, "-c", textwrap.dedent(COMPILE)]
    for delay in (0.02, 0.1, 0.3, 0.7, 1.1):
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as process:
            assert process.stdout.readline() == "go\n"
            time.sleep(delay)
            process.send_signal(number)
            assert process.wait(30) != 0
        assert marked() == []

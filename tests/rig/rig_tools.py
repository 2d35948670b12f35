"""Devices and bad lines for the tests of rigs."""

import contextlib
import os
import random
import select
import socket
import sys
import threading
import time

import pam_ocp as pam
from pam_ocp.rig.channels import channels_of


class Counting:
    """A device whose readings belong together: b = -2 a + 1, and a rises with each look."""

    def __init__(self):
        self.readings = channels_of(
            pam.rig.Reading,
            [pam.rig.Reading("a", "1", address=2), pam.rig.Reading("b", "1", address=4)],
            None,
        )
        self.commands = channels_of(
            pam.rig.Command,
            [
                pam.rig.Command("u", "1", low=-1e6, high=1e6, vent=0.0, address=0),
                pam.rig.Command("w", "1", low=-1e6, high=1e6, vent=0.0, address=2),
            ],
            None,
        )
        self.looks, self.written, self.vents, self.armed = 0, [], 0, False

    def now(self):
        return time.monotonic()

    def read(self):
        self.looks += 1
        return {"a": float(self.looks), "b": 1.0 - 2.0 * self.looks, "time": self.now()}

    def write(self, inputs):
        self.written.append(dict(inputs))

    def vent(self):
        self.vents += 1

    def tick(self):
        pass

    def arm(self):
        self.armed = True


class Bad:
    """What happens to bytes on their way: dropped, doubled, late or damaged, by chance."""

    def __init__(self, seed, share=0.05, latest=0.03):
        self.random, self.share, self.latest = random.Random(seed), share, latest
        self.done = dict.fromkeys(("dropped", "doubled", "late", "damaged"), 0)

    def __call__(self, data):
        """[(after how many seconds, bytes)]."""
        kind = self.random.random() / self.share
        if kind >= 4:
            return [(0.0, data)]
        name = ("dropped", "doubled", "late", "damaged")[int(kind)]
        self.done[name] += 1
        if name == "dropped":
            return []
        if name == "doubled":
            return [(0.0, data), (0.0, data)]
        if name == "late":
            return [(self.latest * self.random.random(), data)]
        changed = bytearray(data)
        for _ in range(self.random.randint(1, 4)):
            changed[self.random.randrange(len(changed))] = self.random.randrange(256)
        if self.random.random() < 0.3:
            del changed[self.random.randrange(len(changed)) :]
        return [(0.0, bytes(changed))] if changed else []


class Between:
    """A thread that passes bytes on between two ends, through :class:`Bad`."""

    def __init__(self, bad):
        self.bad, self.ended, self._waiting = bad, threading.Event(), []
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self.ended.set()
        self._thread.join(5.0)

    def _pass_on(self, data, send):
        for wait, part in self.bad(data):
            self._waiting.append((time.monotonic() + wait, part, send))
        self._send()

    def _send(self):
        now = time.monotonic()
        due = [w for w in self._waiting if w[0] <= now]
        self._waiting = [w for w in self._waiting if w[0] > now]
        for _, part, send in due:
            with contextlib.suppress(OSError):
                send(part)


class BadUdp(Between):
    def __init__(self, port, bad):
        super().__init__(bad)
        self.near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.near.bind(("127.0.0.1", 0))
        self.far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.far.connect(("127.0.0.1", port))
        self.port = self.near.getsockname()[1]

    def _work(self):
        who = None
        while not self.ended.is_set():
            for end in select.select([self.near, self.far], [], [], 0.002)[0]:
                if end is self.near:
                    data, who = self.near.recvfrom(4096)
                    self._pass_on(data, self.far.send)
                elif who is not None:
                    data = self.far.recv(4096)
                    self._pass_on(data, lambda part, who=who: self.near.sendto(part, who))
            self._send()
        self.near.close()
        self.far.close()


class BadTcp(Between):
    def __init__(self, port, bad):
        super().__init__(bad)
        self.listening = socket.create_server(("127.0.0.1", 0))
        self.port, self.target = self.listening.getsockname()[1], port

    def _work(self):
        pairs = {}
        while not self.ended.is_set():
            for end in select.select([self.listening, *pairs], [], [], 0.002)[0]:
                if end is self.listening:
                    near = self.listening.accept()[0]
                    far = socket.create_connection(("127.0.0.1", self.target))
                    pairs |= {near: far, far: near}
                elif end in pairs:
                    try:
                        data = end.recv(4096)
                    except OSError:
                        data = b""
                    if data:
                        self._pass_on(data, pairs[end].sendall)
                    else:
                        other = pairs.pop(end)
                        pairs.pop(other)
                        end.close()
                        other.close()
            self._send()
        for end in (self.listening, *pairs):
            end.close()


class BadSerial(Between):
    def __init__(self, path, bad):
        import tty

        super().__init__(bad)
        self.inner, self.outer = os.openpty()
        tty.setraw(self.outer)
        self.far = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.far)
        self.path = os.ttyname(self.outer)

    def _work(self):
        while not self.ended.is_set():
            for end in select.select([self.inner, self.far], [], [], 0.002)[0]:
                data = os.read(end, 4096)
                other = self.far if end == self.inner else self.inner
                self._pass_on(data, lambda part, other=other: os.write(other, part))
            self._send()
        for end in (self.inner, self.outer, self.far):
            os.close(end)


def child(code, *arguments):
    """Start Python with a script."""
    import subprocess

    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )

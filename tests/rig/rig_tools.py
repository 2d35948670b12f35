"""Devices and bad lines for the tests of rigs."""

import contextlib
import os
import random
import select
import socket
import sys
import threading
import time

import numpy as np

import pam_ocp as pam
from pam_ocp.control.inverse import stiffness_of
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


@contextlib.contextmanager
def quiet(bad):
    """While the line is good: who connects in vain says so and is gone."""
    share, bad.share = bad.share, 1e-12
    yield
    bad.share = share


def end_of(address):
    """What a bad line is put before: a port or a path."""
    return address["port"] if "port" in address else int(address["url"].rpartition(":")[2])


def through(address, between):
    """The address of the bad line in place of the device's."""
    if "url" in address:
        return {**address, "url": f"opc.tcp://127.0.0.1:{between.port}"}
    return {**address, "port": getattr(between, "path", None) or between.port}


def arm(driver, device, seconds=20.0):
    """Until it is, over a bad line."""
    end = time.monotonic() + seconds
    while not device.armed and time.monotonic() < end:
        with contextlib.suppress(pam.rig.DriverError):
            driver.arm()
        time.sleep(0.01)
    assert device.armed


def child(code, *arguments):
    """Start Python with a script."""
    import subprocess

    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def on_twin(model, readings=None, commands=None, true=None, **of_twin):
    """(rig, twin) on a simulated clock; true : the twin's plant where it differs from the model."""
    clock = pam.rig.SimulatedClock()
    twin = pam.rig.Twin(true or model, readings, commands, clock=clock, **of_twin)
    rig = pam.Rig(pam.rig.driver("twin", twin=twin), readings, commands, plant=model, clock=clock)
    return rig, twin


# ---- twins at random ----------------------------------------------------------------------------
MUSCLES = ("DMSP-20-200N", "DMSP-20-400N", "DMSP-20-300", "DMSP-20-300-wall", "DMSP-40")


def losses_at_random(rng, muscle):
    """Hysteresis of one of three kinds, 2 to 4 % of a muscle's force at 6 bar, and creep."""
    force = float(muscle.force(6e5, 0.1))
    size = force * float(rng.uniform(0.02, 0.04))
    kind = rng.integers(3)
    if kind == 0:
        own = pam.losses.BoucWen(size, float(rng.uniform(0.003, 0.008)))
    elif kind == 1:
        own = pam.losses.MaxwellSlip([0.3 * size, 0.3 * size, 0.2 * size, 0.2 * size])
    else:
        parts = ([0.5 * size, 0.4 * size], [0.3 * size, 0.25 * size])
        own = pam.losses.PrandtlIshlinskii(*parts)
    creep = pam.losses.Creep([force * float(rng.uniform(0.3, 0.9))], [float(rng.uniform(0.5, 3.0))])
    return own, creep


def drawn(rng):
    """(muscle, {kind of plant: its options})."""
    name = str(rng.choice(MUSCLES))
    muscle = pam.muscle(name, **({"rest_length": 0.25} if name == "DMSP-40" else {}))
    weight = float(muscle.force(6e5, 0.1))
    return muscle, {
        "slide": {"mass": float(rng.uniform(1.0, 4.0))},
        "joint": {"inertia": float(rng.uniform(0.02, 0.08))},
        "hanging": {"mass": weight / 9.81 * float(rng.uniform(0.1, 0.3)), "damping": 100.0},
    }


def drawn_widely(rng):
    """The same with small muscles, light and heavy loads, lightly damped ones among them."""
    name = str(rng.choice((*MUSCLES, "DMSP-10-250")))
    muscle = pam.muscle(name, **({"rest_length": 0.25} if name == "DMSP-40" else {}))
    weight = float(muscle.force(6e5, 0.1))
    heavy, damped = rng.uniform(0.0, 1.0, 2)
    pair = {"pre_contraction": float(rng.uniform(0.08, 0.12))}
    return muscle, {
        "slide": {"mass": 0.7 * 10**heavy, "damping": 7.0 * 10**damped, **pair},
        "joint": {"inertia": 0.01 * 10**heavy, "damping": 0.1 * 10**damped, **pair},
        "hanging": {"mass": weight / 9.81 * (0.05 + 0.3 * heavy), "damping": 30.0 * 5**damped},
    }


def twin_at_random(seed, kind=None, way="twin", wide=False):
    """(rig, twin, model) of a slide, a joint or a hanging load on a simulated clock.

    way : "modbus" or "serial" for a transport between (``twin.served.close()`` ends it).
    wide : as :func:`drawn_widely` says.

    The twin has losses, a force that is up to 20 % off, dead zones, a delay of 5 ms, noise; the
    model none of these.
    """
    rng = np.random.default_rng(seed)
    plants = {
        "slide": pam.AntagonisticSlide,
        "joint": pam.AntagonisticJoint,
        "hanging": pam.HangingLoad,
    }
    muscle, made = (drawn_widely if wide else drawn)(rng)
    chosen = kind or str(rng.choice(list(plants)))
    plant_of, options = plants[chosen], made[chosen]
    model, clock = plant_of(muscle, **options), pam.rig.SimulatedClock()
    true = plant_of(muscle, losses=losses_at_random(rng, muscle), **options)
    (position,) = model.load_positions
    reach = model.variable(position)
    half = (reach.max - reach.min) / 2
    pressures = [v.name for v in model.states if v.name.endswith(".pressure")]
    sensors = {n: pam.simulation.Instrument(noise=200.0) for n in pressures}
    sensors[position] = pam.simulation.Instrument(noise=5e-4 * half)
    zones = [
        pam.rig.Fault("dead_zone", n.replace("pressure", "command"), float(rng.uniform(2e3, 8e3)))
        for n in pressures
    ]
    readings = [
        pam.rig.Reading(position, low=reach.min - 0.6 * half, high=reach.max, address=2),
        *(
            pam.rig.Reading(n, low="-0.3 bar", high="6.5 bar", address=4 + 2 * i)
            for i, n in enumerate(pressures)
        ),
    ]
    twin = pam.rig.Twin(
        true,
        clock=clock,
        sensors=sensors,
        scale=float(rng.choice([0.8, 1.2])) if rng.random() < 0.5 else float(rng.uniform(0.8, 1.2)),
        delay=0.005,
        seed=seed,
        faults=zones,
    )
    address = {"kind": "twin", "twin": twin}
    if way != "twin":
        twin.served = pam.rig.serve(twin, way)
        address = {**twin.served.address, "timeout": 1.0}
    rig = pam.Rig(pam.rig.driver(**address), readings, plant=model, clock=clock)
    return rig, twin, model


def wanted_sine(model):
    """A sine of 1 Hz through two fifths of what the model can do: (its trajectory, position).

    Its own motion, without a feedback that could ring: pressures by inverse dynamics, commands by
    the feeds' equations, which are linear in them.
    """
    (position,) = model.load_positions
    velocity = model.load_positions[position]
    reach = model.variable(position)
    middle, size = (reach.min + reach.max) / 2, 0.2 * (reach.max - reach.min)
    inverse = pam.control.InverseDynamics(model)
    if len(inverse.muscles) == 1:
        middle = reach.min + 0.35 * (reach.max - reach.min)
    more = {"stiffness": stiffness_of(model)} if len(inverse.muscles) == 2 else {}
    w, t = 2 * np.pi, np.linspace(0.0, 2.0, 801)
    x = middle - size * np.cos(w * t)
    v, a = w * size * np.sin(w * t), w**2 * size * np.cos(w * t)
    pressures = np.array([inverse(*each, **more) for each in zip(x, v, a, strict=True)])
    names = [f"{m}.pressure" for m in inverse.muscles]
    columns = {position: x, velocity: v, **dict(zip(names, pressures.T, strict=True))}
    assert {s.name for s in model.states} == set(columns)
    states = np.column_stack([columns[s.name] for s in model.states])
    places = [[s.name for s in model.states].index(n) for n in names]
    slopes = np.gradient(pressures, t, axis=0)
    p, rest = model.vector("parameter"), model.vector("input")
    u = np.empty((len(t), len(model.inputs)))
    for k, (state, slope) in enumerate(zip(states, slopes, strict=True)):
        still = np.asarray(model.function(state, rest, p)[0]).ravel()[places]
        steep = np.asarray(model.jacobians(state, rest, p)[1])[places]
        u[k] = rest + np.linalg.solve(steep, slope - still)
    columns |= {n.name: u[:, i] for i, n in enumerate(model.inputs)}
    variables = [*model.states, *model.inputs]
    return pam.Trajectory(t, columns, variables), position

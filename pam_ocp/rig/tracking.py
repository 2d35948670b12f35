"""Tracking with what a rig has taught: the model's inverse, corrected by what it leaves over, and
the gains of its PID.

The model gives an acceleration a(x, v, p) for asked pressures p. What a rig shows besides, r = a(x,
v, p) - acceleration, is fitted linearly over functions of the motion alone: powers of position,
velocity, acceleration, and operators with memory (stops of Prandtl-Ishlinskii, low passes that
creep). So it can be reckoned along any reference, and asked for beforehand: the fit of an inverse
directly on its inputs (M. Jordan, D. Rumelhart, Cognitive Science 16 (1992) 307-354).

The gains come of what a rig itself has shown: its frequency response, and its error in a run.
Around a motion that is tracked, the error e answers to accelerations u asked for besides as M e'' +
D e' + K e = -u(t - T). The four are fitted to the response that is measured while the rig moves and
a sum of sines is asked for; the gains are those with the least error, with room to spare.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..control.blocks.running import Running
from ..control.compensation import HysteresisCompensation, Rounded
from ..control.controller import Measured
from ..control.inverse import unreached
from ..control.kinds import law_of
from ..control.pid import PID
from ..control.references import Source
from ..core.errors import InputError

Array: TypeAlias = NDArray[np.float64]
Response: TypeAlias = NDArray[np.complex128]

STOPS = np.geomspace(0.01, 0.8, 7)
"""Thresholds of the stops, in halves of the range."""
YIELDS = np.array([0.02, 0.04, 0.07, 0.12, 0.25, 0.5])
"""Those of elements of Bouc and Wen, whose edges are round (orders 1 and 2, beta 1/2)."""
CREEPS = np.array([0.3, 1.0, 3.0, 10.0])
"""Time constants of the low passes [s]."""
PACE = 2 * np.pi
"""Velocities and accelerations are counted in this times the range's half, per second (1 Hz)."""
FAR = 1.3
"""Halves of the range beyond which powers of the position grow no further."""
EVERY = 5
"""Which of the samples of the past are looked at."""
FILTER = 0.01
"""Of a derivative, where a bandwidth is given [s]."""


class Memory:
    """Functions of a motion, sample after sample: what r is a sum of.

    middle, half : of the range of positions. The first ``smooth`` ones are without memory; that at
    ``slope`` is the position itself.
    """

    smooth, slope = 12, 1

    def __init__(self, middle: float, half: float, sample_time: float) -> None:
        self.middle, self.half, self.sample_time = middle, half, sample_time
        self._share = 1 - np.exp(-sample_time / CREEPS)
        self.reset()

    def reset(self, slow: Array | None = None) -> None:
        """Forget the past; slow : where the low passes begin, see :meth:`crept`."""
        self._given = slow
        self._begun, self._last = False, 0.0
        self._plays, self._slow = np.zeros(len(STOPS)), np.zeros(len(CREEPS))
        self._round = np.zeros((2, len(YIELDS)))

    def __call__(self, x: float, v: float, a: float) -> Array:
        """The functions' values, the motion having gone on by a sample to here."""
        s = (x - self.middle) / self.half
        w, c = v / (self.half * PACE), a / (self.half * PACE**2)
        if not self._begun:
            self._plays = np.full(len(STOPS), s)
            self._slow = np.full(len(CREEPS), s) if self._given is None else self._given
            self._last, self._begun = s, True
        self._round = bent(self._round, (s - self._last) / YIELDS)
        self._last = s
        self._plays = np.maximum(s - STOPS, np.minimum(s + STOPS, self._plays))
        self._slow = self._slow + self._share * (s - self._slow)
        stops, creeps = s - self._plays, s - self._slow
        q = min(max(s, -FAR), FAR)
        powers = [1.0, s, q**2, q**3, q**4, q**5, w, w * q, w * q**2, w * abs(w), c, c * q]
        return np.concatenate([powers, stops, q * stops, *self._round, q * self._round[1], creeps])

    def crept(self, t: Array, x: Array) -> Array:
        """Where the low passes are after positions of the past, each held since the one before."""
        left = np.exp((t - t[-1])[:, None] / CREEPS)
        s = (x - self.middle) / self.half
        return np.asarray(s[0] * left[0] + s[1:] @ np.diff(left, axis=0))

    def along(self, x: Array, v: Array, a: Array, slow: Array | None = None) -> Array:
        """The functions along a motion, a row a sample."""
        self.reset(slow)
        return np.array([self(*row) for row in zip(x, v, a, strict=True)])


def bent(z: Array, way: Array) -> Array:
    """Elements of Bouc and Wen of orders 1 and 2 (rows) after a way, in parts of their yields.

    With beta 1/2 they unload along a straight line, and load as 1 - exp and tanh: exact steps.
    """
    up = np.where(way < 0, -1.0, 1.0)
    z, far = up * z, np.abs(way)
    back = np.minimum(np.maximum(-z, 0.0), far)
    z, far = z + back, far - back
    first = 1 - (1 - z[0]) * np.exp(-far[0])
    second = np.tanh(np.arctanh(np.minimum(z[1], 1 - 1e-12)) + far[1])
    loaded = np.array([first, second])
    return np.asarray(up * np.where(far > 0, loaded, z))


@dataclass
class Residual:
    """r as a sum over the functions of :class:`Memory`; ``weights`` of them [its unit]."""

    memory: Memory
    weights: Array

    @classmethod
    def none(cls, memory: Memory) -> Residual:
        """Nothing yet."""
        return cls(memory, np.zeros(len(memory(memory.middle, 0.0, 0.0))))

    def fitted(self, rows: Array, values: Array, ridge: float = 1e-4) -> Residual:
        """Least squares, with a little ridge on the weights of columns of size one."""
        size = np.sqrt(np.mean(rows**2, axis=0)) + 1e-9
        scaled = rows / size
        normal = scaled.T @ scaled / len(rows) + ridge * np.eye(rows.shape[1])
        weights = np.linalg.solve(normal, scaled.T @ values / len(rows)) / size
        return Residual(self.memory, weights)

    def again(self) -> Residual:
        """The same, its past forgotten."""
        m = self.memory
        return Residual(Memory(m.middle, m.half, m.sample_time), self.weights)

    def __call__(self, x: float, v: float, a: float) -> float:
        return float(self.memory(x, v, a) @ self.weights)


@dataclass
class LearnedInverse:
    """Tracks a position of a rig: inverse of the model, what it leaves over, and a PID.

    ``closed_loop(law, rig, {"x": ...})``. plant : the model. residual : what was fitted. ahead :
    by which the inverse looks ahead [s], the time from a command to its effect. pid : the feedback.
    rounding : of the reference's corners [s]. ceilings : {command: largest value sent}. past : what
    the rig has read lately, (time, {reading: value}), by which a run knows what creeps still.
    """

    inverse: HysteresisCompensation
    residual: Residual
    ahead: float
    pid: PID
    rounding: float = 0.04
    ceilings: Mapping[str, float] = field(default_factory=dict)
    past: Sequence[tuple[float, Mapping[str, float]]] = field(default=(), repr=False)
    plant: Any = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.plant = self.inverse.plant
        self.sample_time = self.inverse.sample_time

    @property
    def position(self) -> str:
        """What it tracks."""
        return self.inverse.inverse.position

    def placed(self, bandwidth: float) -> PID:
        """Of the rig's inertia, damping and stiffness, so that the open loop is bandwidth/s."""
        damp, stiff = self.slopes()
        return PID(bandwidth * max(damp, 0.0), bandwidth * max(stiff, 0.0), bandwidth, FILTER)

    def slopes(self) -> tuple[float, float]:
        """Acceleration to be asked for per velocity and per position, in the range's middle."""
        memory = self.residual.memory
        stiff, damp = slopes(self.inverse, memory.middle)
        return damp, stiff + float(self.residual.weights[memory.slope]) / memory.half

    def crept(self) -> Array | None:
        """Where the low passes are by now; None where nothing is known."""
        rows = [(t, seen[self.position]) for t, seen in [*self.past][::-EVERY][::-1]]
        return self.residual.memory.crept(*np.array(rows).T) if rows else None

    def resting(self, x: float) -> dict[str, float]:
        """Commands under which a position rests."""
        controller = replace(self, past=()).tracking({self.position: lambda t: x}, {}, True)
        inverse, extra = self.inverse.inverse, self.residual.again()(x, 0.0, 0.0)
        held = inverse(x, 0.0, extra, self.inverse.stiffness)
        pressures = {f"{m}.pressure": float(p) for m, p in zip(inverse.muscles, held, strict=True)}
        return controller(0.0, {self.position: x, **pressures})

    def tracking(
        self, reference: Mapping[str, Source], inputs: Mapping[str, float], preview: bool
    ) -> LearnedTracking:
        """The controller of one run; see :class:`Tracking`."""
        if set(reference) != {self.position}:
            raise InputError(
                f"reference: {', '.join(reference) or 'nothing'} is given; this controller tracks "
                f"{self.position} alone"
            )
        return LearnedTracking(self, reference[self.position], preview)


class LearnedTracking:
    """One run of a LearnedInverse. ``asked`` : (time, pressures asked for then) of each sample;
    ``added`` : accelerations asked for besides. probe : a part of these, over time. slow : where
    what creeps was at the beginning.
    """

    slow: Array | None = None
    probe: Source | None = None

    def __init__(self, owner: LearnedInverse, reference: Source, preview: bool) -> None:
        self.owner, self.plant, self.sample_time = owner, owner.plant, owner.sample_time
        inner = owner.inverse
        self._reference, self._path = reference, Rounded(reference, owner.rounding / 2, preview)
        pressures = [f"{m}.pressure" for m in inner.inverse.muscles]
        self._law = Running(law_of(inner), {owner.position, *pressures})
        known = [v.name for v in self._law.block.memory]
        self._places = [known.index(f"model.{p}") for p in pressures]
        self._held = [n.removeprefix("memory.") for n in known if n.startswith("memory.")]
        self._held_places = [known.index(f"memory.{n}") for n in self._held]
        self._unreached = self._reach()
        self._pid, self._residual = replace(owner.pid), owner.residual.again()
        names = (owner.position, inner.inverse.velocity, "acceleration")
        self._now, self._coming = ([f"{k}.{n}" for n in names] for k in ("wanted", "ahead"))
        self.reset()

    def reset(self) -> None:
        """See :class:`Controller`."""
        self._law.reset()
        self._pid.reset()
        self._residual = self._residual.again()
        self._begun, self._beyond = False, 0.0
        self.asked: list[tuple[float, Array]] = []
        self.added: list[float] = []

    def wanted(self, t: float) -> dict[str, float]:
        """What is to be reached at a time [s]."""
        return {self.owner.position: self._reference(t)}

    def __call__(self, t: float, measured: Measured) -> dict[str, float]:
        """See :class:`Controller`."""
        o, law = self.owner, self._law
        more = self._pid(self._path(t)[0] - measured[o.position], o.sample_time, self._beyond)
        more += self.probe(t) if self.probe else 0.0
        self.added.append(more)
        law.measure(measured)
        if not self._begun:
            self.slow = o.crept()
            self._residual.memory.reset(self.slow)
            self._tell(self._now, t + o.ahead, more)
            self._begun = True
        time = t + o.ahead + o.sample_time
        motion = self._tell(self._coming, time, more)
        commands = law.commands()
        p, held = law.memory[self._places].copy(), law.memory[self._held_places]
        self._beyond = float(self._unreached(*motion, p, held))
        self.asked.append((t + o.sample_time, p))
        return {n: min(u, o.ceilings.get(n, u)) for n, u in commands.items()}

    def _tell(self, names: list[str], t: float, more: float) -> tuple[float, float, float]:
        """Ask for the motion at a time, and say which it is."""
        x, v, a = self._path(t)
        a += self._residual(x, v, a) + more
        self._law.tell(dict(zip(names, (x, v, a), strict=True)))
        return x, v, a

    def _reach(self) -> ca.Function:
        """(position, velocity, acceleration, pressures, memories) -> see ``unreached``."""
        inverse = self.owner.inverse.inverse
        x, v, a = (ca.MX.sym(n) for n in "xva")
        p, held = ca.MX.sym("p", len(self._places)), ca.MX.sym("held", len(self._held))
        states = dict(zip(self._held, ca.vertsplit(held), strict=True))
        return ca.Function("reach", [x, v, a, p, held], [unreached(inverse, x, v, a, p, states)])


def slopes(inner: HysteresisCompensation, x: float) -> tuple[float, float]:
    """Acceleration to be asked for per position and per velocity, by the model."""
    inverse = inner.inverse
    p = inverse(x, 0.0, 0.0, inner.stiffness)
    half = 1e-3 * (abs(inverse.plant.variable(inverse.position).nominal) or 1.0)
    stiff = inverse.accelerations([x - half, x + half], [0.0, 0.0], [p, p])
    damp = inverse.accelerations([x, x], [-half, half], [p, p])
    return -float(np.diff(stiff)[0]) / (2 * half), -float(np.diff(damp)[0]) / (2 * half)


# ---- gains ---------------------------------------------------------------------------------------
BLOCK = 4.0
"""Of a run that gives one response [s]."""
LINES, BELOW = np.arange(1.5, 40.1, 0.5), 0.4
"""Of what is asked for [Hz]: every other one that a block resolves, for its window's sake; up to
this part of the sampling rate.
"""
STEP = 1 / BLOCK
"""Between frequencies at which the gains are judged [Hz]."""
SENSITIVITY = 2.0
"""Largest |1/(1 + P C)| at any frequency, for any of the answers that are thought possible."""
STIFFER, LOOSER, LATER = (0.75, 1.0, 1.3), (0.5, 1.0), (0.0, 0.003)
"""These: K and D in parts of those found, and by how much later commands may act [s]."""
ODD = 0.3
"""Of the logarithm of a response, what counts as an outlier."""
BEGUN = ((1.0, 1.0), (1.0, -1.0), (4.0, 4.0), (4.0, -4.0), (12.0, 12.0), (12.0, -4.0))
"""Where the search begins: integral gain in K, the other two in damping and mass [1/s]."""
LEAST = 2.0
"""Of the integral gain, in K [1/s]: what drifts is to be followed."""
TRIES, FARTHEST = 300, 20.0
"""Of each search; logarithm of the integral gain, at most."""
FILTERS = 5e-3, 0.1
"""Shortest and longest filter of the derivative [s]."""


def lines(h: float) -> Array:
    """Frequencies of what is asked for in samples of h [s]."""
    return np.asarray(LINES[LINES * h < BELOW])


@dataclass(frozen=True)
class Answer:
    """Of the error to an acceleration that is asked for: M, D, K, and the time ``late`` [s]."""

    mass: float
    damping: float
    stiffness: float
    late: float

    @classmethod
    def shown(cls, error: Array, added: Array, h: float, stiffness: float) -> Answer:
        """That of a run: samples of h [s] of the error and of what was asked for, at ``lines(h)``.

        stiffness : about what K is.
        """
        from scipy.optimize import least_squares

        f = lines(h)
        place = np.round(f * BLOCK).astype(int)
        e, u = (_spectra(values, h)[:, place] for values in (error, added))
        seen = -np.sum(e * u.conj(), axis=0) / np.sum(np.abs(u) ** 2, axis=0)

        def missed(q: Array) -> Array:
            m, d, k = np.exp(q[:3])
            ratio = np.log(seen / cls(m, d, k, q[3]).response(f, h))
            return np.concatenate([ratio.real, ratio.imag])

        begun = [
            np.array([0.0, np.log(0.3 * np.sqrt(k)), np.log(k), 2 * h])
            for k in max(stiffness, 1.0) * np.array([0.5, 1.0, 2.0])
        ]
        found = [least_squares(missed, q, loss="soft_l1", f_scale=ODD) for q in begun]
        best = min(found, key=lambda r: float(r.cost)).x
        mass, damping, still = np.exp(best[:3])
        return cls(float(mass), float(damping), float(still), float(best[3]))

    def response(self, f: Array, h: float) -> Response:
        """Error per acceleration asked for in samples of h [s], at frequencies [Hz]."""
        s = 2j * np.pi * f
        held = np.sinc(f * h) * np.exp(-s * (self.late + h / 2))
        return np.asarray(held / (self.mass * s**2 + self.damping * s + self.stiffness))

    def possible(self) -> list[Answer]:
        """Others that are to be reckoned with."""
        return [
            Answer(self.mass, d * self.damping, k * self.stiffness, self.late + t)
            for k in STIFFER
            for d in LOOSER
            for t in LATER
        ]


def _spectra(values: Array, h: float) -> Response:
    """Of each block of a run, at multiples of STEP."""
    size = round(BLOCK / h)
    rows = values[: len(values) // size * size].reshape(-1, size)
    return np.fft.rfft(rows * np.hanning(size + 1)[:-1], axis=1)


def placed_by(seen: Answer, h: float, error: Array, old: PID) -> PID:
    """The PID of sample time h [s] with the least error, in the mean square over what is possible.

    error : that of runs of whole blocks with the gains ``old``: with others its spectrum is that
    times (1 + P C_old)/(1 + P C). Of those gains with which all loops are stable, and of a
    sensitivity below SENSITIVITY.
    """
    from scipy.optimize import minimize

    f = np.arange(STEP, lines(h)[-1], STEP)
    z = np.exp(2j * np.pi * f * h)
    plants = np.array([answer.response(f, h) for answer in seen.possible()])
    power = np.mean(np.abs(_spectra(error, h)) ** 2, axis=0)[1 : len(f) + 1]
    power = power * np.abs(1 + _answer(old, z, h) * plants) ** 2
    whole = float(np.sum(power))
    damped = max(seen.damping, 0.3 * np.sqrt(seen.stiffness * seen.mass))

    def gains(q: Array) -> PID:
        # a search may go far where a limit holds its gain
        time = 1e-2 * float(np.exp(np.clip(q[3], *np.log(np.array(FILTERS) / 1e-2))))
        integral = LEAST + float(np.exp(min(q[0], FARTHEST)))
        return PID(damped * q[1], seen.stiffness * integral, seen.mass * q[2], time)

    def cost(q: Array) -> float:
        back = 1 + _answer(gains(q), z, h) * plants
        stable = np.abs(np.unwrap(np.angle(back), axis=1)[:, -1]) < np.pi  # none goes around -1
        left = np.sqrt(np.sum(power / np.abs(back) ** 2) / whole)
        beyond = max(1 / float(np.min(np.abs(back))) / SENSITIVITY - 1, 0.0)
        return float(left * (1 + 10 * beyond) + 100 * np.sum(~stable))

    def search(begin: Array) -> Any:
        corners = begin + np.vstack([np.zeros(4), np.diag([0.7, 3.0, 3.0, 0.7])])
        options = {"maxfev": TRIES, "xatol": 1e-2, "fatol": 1e-4, "initial_simplex": corners}
        return minimize(cost, begin, method="Nelder-Mead", options=options)

    found = [search(np.array([np.log(w), size, size, 0.0])) for w, size in BEGUN]
    return gains(min(found, key=lambda r: float(r.fun)).x)


def _answer(pid: PID, z: Response, h: float) -> Response:
    """Acceleration asked for per error."""
    slope = (1 - 1 / z) / h
    return np.asarray(pid.kp + pid.ki / slope + pid.kd * slope / (1 + pid.filter_time * slope))

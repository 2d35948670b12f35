"""What drifts on a rig: scale of force, leak and creep are estimated along runs, with bands.

The model gets three parameters that no rig has: every muscle's force is multiplied by
``drift.scale``, every pressure leaks at ``drift.leak`` [1/s], and beside every muscle stands an
element of creep, ``drift.creep`` (kappa - e) [N] with the time ``drift.time``. A moving-horizon
estimator finds them. What they are at first, model error included, is learned from the first
motion; an alarm is raised for what leaves that.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..control.estimators.moving_horizon import MovingHorizonEstimator
from ..core.errors import InputError, UnknownNameError, require_instance, require_positive
from ..core.trajectory import Trajectory
from ..plants.plant import Plant, require_plant
from .twin import forces_changed

Array: TypeAlias = NDArray[np.float64]

UNKNOWN = {"drift.scale": ("scale of force", 1.0), "drift.leak": ("leak", 0.0)}
UNKNOWN |= {"drift.creep": ("creep", 0.0)}
"""Parameters, in words, with their values in a sound model."""
TOLERANCE = {"scale of force": 0.05, "leak": 0.1, "creep": 150.0}
"""[1, 1/s, N]: what is less is no drift, by default."""
SPREAD = {"drift.scale": (0.2, 0.004), "drift.leak": (0.2, 0.01), "drift.creep": (100.0, 5.0)}
"""(at first, per root of a second) of what is estimated."""
CREEP_TIME = 10.0
"""[s]."""
LASTS = 0.3
"""How long an error of the model's forces stays the same [s]."""
DEVIATIONS = 4.0
"""Half a band for an alarm, in standard deviations; bands that are shown have two."""
HOLD, AGAIN = 2.0, 20.0
"""How long it is outside before the alarm [s]; and before one that follows another: what drifts
pulls the other estimates along for a while."""


def drifting(plant: Plant, creep_time: float = CREEP_TIME) -> Plant:
    """The plant with parameters ``drift.scale`` (1), ``drift.leak`` and ``drift.creep`` (0).

    Raises InputError for a plant without outputs ``*.force``.

    Examples
    --------
    >>> from pam_ocp.rig.drift import drifting
    >>> [v.name for v in drifting(plant).parameters][-4:]
    ['drift.scale', 'drift.leak', 'drift.creep', 'drift.time']
    """
    own = Plant(plant.name, plant.description)
    symbols = {
        v.name: own._declare(v)
        for kind in ("states", "inputs", "parameters")
        for v in getattr(plant, kind)
    }
    scale = own.parameter("drift.scale", 1.0, min=0.1, max=3.0)
    leak = own.parameter("drift.leak", 0.0, unit="1/s", min=-10.0, max=50.0)
    creep = own.parameter("drift.creep", 0.0, unit="N", min=-1e4, max=1e4, nominal=100.0)
    time = own.parameter("drift.time", creep_time, unit="s", min=1e-3)
    x, u, p = (
        ca.vertcat(*(symbols[v.name] for v in kind))
        for kind in (plant.states, plant.inputs, plant.parameters)
    )
    contraction = {
        v.name: ca.substitute([plant.expression(v.name)], [plant.x, plant.u, plant.p], [x, u, p])[0]
        for v in plant.outputs
        if v.name.endswith(".contraction")
    }
    followed: dict[str, ca.SX] = {}

    def changed(name: str, force: ca.SX) -> ca.SX:
        muscle = name.removesuffix(".force")
        kappa = contraction.get(f"{muscle}.contraction")
        if kappa is None:
            return scale * force
        e = own.state(f"{muscle}.drift_creep", nominal=0.1)
        followed[muscle] = e
        own.der(e, (kappa - e) / time)
        return scale * force - creep * (kappa - e)

    rates, outputs = forces_changed(plant, changed, x, u, p)
    for i, v in enumerate(plant.states):
        lost = leak * symbols[v.name] if v.name.endswith(".pressure") else 0
        own.der(symbols[v.name], rates[i] - lost)
    for i, v in enumerate(plant.outputs):
        own._define(v, outputs[i])
    return own


@dataclass(frozen=True)
class Alarm:
    """What has drifted: ``what`` ("scale of force", "leak", "creep"), from ``before`` to ``now``
    (each value, standard deviation) [SI], found at ``time`` [s] on the monitor's clock.

    Examples
    --------
    >>> print(pam.rig.Alarm("scale of force", (1.0, 0.01), (0.88, 0.01), 7.5))
    scale of force has drifted from 1 +- 0.02 to 0.88 +- 0.02
    """

    what: str
    before: tuple[float, float]
    now: tuple[float, float]
    time: float

    def __str__(self) -> str:
        unit = {"leak": " 1/s", "creep": " N"}.get(self.what, "")
        said = [f"{v:.3g} +- {2 * d:.2g}{unit}" for v, d in (self.before, self.now)]
        return f"{self.what} has drifted from {said[0]} to {said[1]}"


class Monitor:
    """Watches a rig along its runs and says what has drifted.

    Parameters
    ----------
    plant : the model. measured : {reading: standard deviation of its noise}.
    sample_time : of the estimate [s]; readings between are left out. horizon : of the
        moving-horizon estimator, in such samples.
    error : of the model's forces, relative, as hysteresis makes it: what it explains is no drift.
    learn : motion from which the present state of the rig is learned [s], or longer, until the
        estimates stand; alarms come after it. It should be such as the motions to come.
    compiled : the estimator as machine code: a fifth of the time, after some seconds at first.
    tolerance : {"scale of force", "leak" [1/s], "creep" [N]: what counts as a drift}.

    Give it to a rig (``rig.monitor = monitor``), or records to :meth:`follow`. ``alarms`` are those
    raised so far, ``history`` the estimates: rows of time, values, deviations.

    Raises InputError, UnknownNameError.

    Examples
    --------
    >>> monitor = pam.rig.Monitor(plant, measured={"x": 1e-5, "muscle.pressure": 200.0})
    >>> monitor.alarms, monitor.learned
    ([], False)
    """

    def __init__(
        self,
        plant: Plant,
        *,
        measured: Mapping[str, float],
        sample_time: float = 0.02,
        horizon: int = 5,
        learn: float = 30.0,
        error: float = 0.05,
        compiled: bool = False,
        tolerance: Mapping[str, float] | None = None,
    ) -> None:
        self.plant = drifting(require_plant(plant))
        self.measured = dict(measured)
        self.sample_time = require_positive("sample_time", sample_time, "s")
        self.learn = require_positive("learn", learn, "s")
        for name in tolerance or {}:
            if name not in TOLERANCE:
                raise UnknownNameError("drift", name, TOLERANCE)
        self.tolerance = TOLERANCE | {
            n: require_positive(f"tolerance[{n!r}]", v) for n, v in (tolerance or {}).items()
        }
        self._estimator = MovingHorizonEstimator(
            self.plant,
            sample_time=self.sample_time,
            measured=self.measured,
            horizon=horizon,
            unknown=SPREAD,
            robust=3.0,
            compiled=compiled,
            process=_noise(self.plant, require_positive("error", error, zero=True)),
            method="rosenbrock",
        )
        self.alarms: list[Alarm] = []
        self.before: dict[str, tuple[float, float]] = {}
        """{what: (middle, spread)} as learned; the spread is that of the estimates' own band and of
        their range, which errors of the model make wide. Empty until then."""
        self.history: list[Array] = []
        self._clock = 0.0
        self._due: float | None = None
        self._sent: list[dict[str, float]] = []
        self._outside = dict.fromkeys(TOLERANCE, 0.0)

    @property
    def learned(self) -> bool:
        """Whether it knows the rig's state from which drifts count."""
        return bool(self.before)

    def _learn(self) -> None:
        """What the estimates were over the last half of ``learn``, once they stand there: the means
        of its two halves differ by less than half the tolerances.
        """
        rows = np.array(self.history)
        rows = rows[rows[:, 0] > self._clock - 0.5 * self.learn]
        half = len(rows) // 2
        moved = np.abs(rows[:half, 1:4].mean(axis=0) - rows[half:, 1:4].mean(axis=0))
        if np.any(moved > 0.5 * np.array([self.tolerance[n] for n in TOLERANCE])):
            return
        for i, name in enumerate(TOLERANCE):
            column = rows[:, 1 + i]
            middle = float(column.max() + column.min()) / 2
            self.before[name] = middle, float(np.ptp(column)) / 2 + float(rows[:, 4 + i].mean())

    @property
    def now(self) -> dict[str, tuple[float, float]]:
        """{what: (value, standard deviation)}."""
        found = self._estimator.estimate
        return {w: (found.values[n], found.deviation[n]) for n, (w, _) in UNKNOWN.items()}

    def begin(self) -> None:
        """A new run: the rig's state is unknown, what has been learned stays."""
        self._estimator.reset([*UNKNOWN] if self.history else [])
        self._due, self._sent = None, []

    def sample(self, time: float, seen: Mapping[str, float], sent: Mapping[str, float]) -> None:
        """One sample of a run: readings [SI] at a time [s], and the commands on them."""
        if self._due is None:
            self._due = time
        if time >= self._due - 1e-9:
            e = self._estimator
            if self._sent:
                held = {n: float(np.mean([s[n] for s in self._sent])) for n in self._sent[0]}
                steps = max(1, min(10, round((time - self._due) / self.sample_time) + 1))
                for _ in range(steps):
                    e.predict(held)
                    self._clock += self.sample_time
            e.correct({n: seen[n] for n in self.measured if n in seen}, dict(sent))
            self._judge()
            while self._due <= time + 1e-9:
                self._due += self.sample_time
            self._sent = []
        self._sent.append(dict(sent))

    def _judge(self) -> None:
        now = self.now
        values, deviations = zip(*now.values(), strict=True)
        self.history.append(np.array([self._clock, *values, *deviations]))
        if not self.learned:
            if self._clock >= self.learn:
                self._learn()
            return
        beyond = {}
        for what, (mean, spread) in self.before.items():
            value, deviation = now[what]
            allowed = self.tolerance[what] + 2 * spread + DEVIATIONS * deviation
            away = abs(value - mean) > allowed
            self._outside[what] = self._outside[what] + self.sample_time if away else 0.0
            known = {a.what for a in self.alarms}
            if self._outside[what] > (AGAIN if known else HOLD) and what not in known:
                beyond[what] = abs(value - mean) / allowed
        if beyond:
            what = max(beyond, key=lambda n: beyond[n])
            self.alarms.append(Alarm(what, self.before[what], now[what], self._clock))

    def follow(self, record: Trajectory) -> list[Alarm]:
        """A whole record, as a run gives it; the alarms that it raised."""
        require_instance("record", record, Trajectory, "give the record of a run")
        known = len(self.alarms)
        sent = record.named("input")
        missing = [n for n in self.measured if n not in record]
        if missing:
            raise InputError(f"the record has no {missing[0]}; it holds {', '.join(record.names)}")
        self.begin()
        for k, t in enumerate(record.t.tolist()):
            row = {n: float(record[n][k]) for n in record.names}
            self.sample(t, {n: row[n] for n in self.measured}, {n: row[n] for n in sent})
        return self.alarms[known:]

    def report(self) -> str:
        """The present values with bands of two deviations, and the alarms."""
        rows = [f"{'':<16}{'now':>10}{'band':>10}{'at first':>10}{'tolerance':>11}"]
        for what, (value, deviation) in self.now.items():
            first = f"{self.before[what][0]:.3g}" if self.learned else "-"
            rows.append(
                f"{what:<16}{value:>10.3g}{2 * deviation:>10.2g}{first:>10}"
                f"{self.tolerance[what]:>11.3g}"
            )
        return "\n".join([*rows, *map(str, self.alarms)])


def _noise(plant: Plant, error: float) -> dict[str, float]:
    """Process noise by name: of velocities what an error of the forces does that lasts ``LASTS``
    (at rest in the middle of the commands); elements of creep follow exactly.
    """
    follow = {v.name: 1e-6 for v in plant.states if v.name.endswith(".drift_creep")}
    middle = {v.name: 0.5 * (v.min + v.max) for v in plant.inputs if math.isfinite(v.max - v.min)}
    slope = ca.Function(
        "slope",
        [plant.x, plant.u, plant.p],
        [
            ca.jacobian(
                ca.vertcat(*(plant.expression(f"der({v.name})") for v in plant.states)),
                plant.expression("drift.scale"),
            )
        ],
    )
    point = plant.equilibrium(middle)
    numbers = [[point[v.name] for v in kind] for kind in (plant.states, plant.inputs)]
    effect = np.abs(np.array(slope(*numbers, plant.vector("parameter")))).ravel()
    size = error * math.sqrt(LASTS) * effect
    return follow | {
        v.name: float(d)
        for v, d in zip(plant.states, size, strict=True)
        if d > 0 and v.name not in follow
    }

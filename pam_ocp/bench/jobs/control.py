"""Controllers about the operating point, for the tab Control: their linear loop, a run against the
plant, and one that runs in real time under somebody's hand.

A controller is a member of the session's ``controllers``::

    {"id", "name", "kind": "pid" | "lqr" | "mpc", "sample_time", "gains": {name: value},
     "study": {"step", "duration", "push", "push_from", "noise"}}
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...control.analysis import frequency_response, margins
from ...control.linear_quadratic import lqr
from ...control.loop import ClosedLoop, closed_loop
from ...control.mpc.mpc import Mpc
from ...control.point_pid import PointPid
from ...control.sides import Actuators, PlantSide, Side, side_of
from ...control.state_feedback import StateFeedback
from ...core.errors import InputError
from ...export.package import export_fmu
from ...figures.film import scene_of
from ...operating.resting_point import OperatingPoint
from ...plants.plant import Plant
from ..look import numbers
from ..made import World, kept, plant_of, point_of
from ..script import PUSH, law_keywords, pushed, run_keywords
from ..work import Say, job

FRESH = 4000
"""Samples after which a live side begins anew where it is: what it recorded is dropped."""
RANGE = (1e-1, 300.0)
"""[Hz] of frequency responses."""

GAINS: dict[str, dict[str, tuple[str, float]]] = {
    "pid": {
        "proportional": ("P", 1.0),
        "integral": ("I", 0.0),
        "derivative": ("D", 0.0),
    },
    "lqr": {
        "position": ("position", 10.0),
        "velocity": ("velocity", 1.0),
        "effort": ("effort", 1.0),
        "integral": ("integral", 100.0),
    },
    "mpc": {
        "horizon": ("horizon", 20.0),
        "position": ("position", 1.0),
        "rate": ("rate", 0.01),
    },
}
"""{kind: {gain: (its word, value at first)}}."""


# ---- nouns ---------------------------------------------------------------------------------------
def first_point(plant: Plant) -> dict[str, float]:
    """Conditions of an equilibrium to begin with: the middle of the stroke, pairs at 3 bar."""
    name = next(iter(plant.positions), None)
    if name is None:
        raise InputError(f"{plant.name} has no position that moves; choose another arrangement")
    v = plant.variable(name)
    low, high = (e if np.isfinite(e) else 0.0 for e in (v.min, v.max))
    said = {name: float(low + 0.4 * (high - low) if low == 0 else 0.5 * (low + high))}
    pressures = [n.name for n in plant.states if n.name.endswith(".pressure")]
    if len(pressures) == 2:
        said[pressures[0]] = 0.5 * min(plant.variable(pressures[0]).max, 6e5)
    return said


def first_controller(
    plant: Plant, point: Mapping[str, float], kind: str, id: str
) -> dict[str, Any]:
    """A controller to begin with; PID gains by the margin of the proportional loop."""
    gains = {n: value for n, (_, value) in GAINS[kind].items()}
    name = next(iter(plant.positions))
    if kind == "pid":
        gains = _cautious(plant, point)
    v = plant.variable(name)
    words = {"pid": "PID", "lqr": "LQR", "mpc": "MPC"}[kind]
    return {
        "id": id,
        "name": f"{words} {id.removeprefix('controllers')}",
        "kind": kind,
        "sample_time": 5e-3 if kind == "mpc" else 1e-3,
        "gains": gains,
        "study": {
            "step": 0.1 * v.nominal,
            "duration": 1.0,
            "push": 0.0,
            "push_from": 0.5,
            "noise": 0.0,
        },
    }


def _cautious(plant: Plant, point: Mapping[str, float]) -> dict[str, float]:
    """A fifth of the proportional gain at which the loop begins to swing, and an integral whose
    corner lies at a tenth of that frequency."""
    import control

    unit = max(v.nominal for v in plant.in_openings().inputs if not v.disturbance)
    size = unit / plant.variable(next(iter(plant.positions))).nominal
    margin, _, crossing, _ = control.margin(PointPid(plant, point, size).loop)
    if not np.isfinite(margin) or not np.isfinite(crossing):
        margin, crossing = 1.0, 10.0
    gain = float(f"{0.2 * margin * size:.2g}")
    return {
        "proportional": gain,
        "integral": float(f"{0.1 * gain * crossing:.2g}"),
        "derivative": 0.0,
    }


def _side(world: World) -> Plant:
    """The plant that can be pushed; where it takes no loads, as it is."""
    return plant_of(world.but(plant=pushed(world.state["plant"])))


def law_arguments(plant: Plant, said: Mapping[str, Any]) -> dict[str, Any]:
    """The keywords of PointPid, lqr or Mpc that a controller stands for."""
    position, velocity = next(iter(plant.positions.items()))
    inputs = [v.name for v in plant.inputs if not v.disturbance]
    return law_keywords(said, position, velocity, partial(dict.fromkeys, inputs))


def controller_of(plant: Plant, point: OperatingPoint, said: Mapping[str, Any]) -> Any:
    """The controller that is described, about a point."""
    if said["kind"] not in GAINS:
        raise InputError(f"controller = {said['kind']!r} is none that the bench knows")
    arguments = law_arguments(plant, said)
    if said["kind"] == "mpc":
        return Mpc(plant, **arguments)
    return (PointPid if said["kind"] == "pid" else lqr)(plant, point, **arguments)


# ---- the linear loop -----------------------------------------------------------------------------
@job("Linear loop", warm="control", latest="gains", time_limit=60.0, quiet=True)
def designed(say: Say, world: World, said: Mapping[str, Any]) -> dict[str, Any]:
    """Poles, frequency response, step response and margins of the linear loop."""
    import control

    plant = plant_of(world)
    point = point_of(world, plant)
    made = controller_of(plant, point, said)
    position = next(iter(plant.positions))
    linear = plant.linearize(point)
    found: dict[str, Any] = {
        "rest": float(point[position]),
        "open": _complex(np.linalg.eigvals(np.asarray(linear.A))),
    }
    if isinstance(made, Mpc):
        return found
    loop, closed_system = _loops(made)
    hertz = np.geomspace(*RANGE, 300)
    response = frequency_response(loop, hertz)
    if response.shape[1:] == (1, 1):
        single = response[:, 0, 0]
        magnitude, phase = np.abs(single), np.unwrap(np.angle(single))
        # the branch that begins nearest to that of an integrator
        phase -= 2 * np.pi * np.round((phase[0] + np.pi / 2) / (2 * np.pi))
        found["phase"] = numbers(np.degrees(phase))
    else:
        magnitude = np.linalg.svd(response, compute_uv=False)[:, 0]
    poles = np.asarray(made.poles)
    end = _settled(poles)
    t = np.linspace(0.0, end, 400)
    found |= {
        "poles": _complex(poles),
        "hertz": numbers(hertz),
        "magnitude": numbers(20 * np.log10(np.maximum(magnitude, 1e-12))),
        "stable": bool(poles.real.max() < 0),
        "margins": _margins(made),
    }
    if closed_system is not None and found["stable"]:
        _, y = control.step_response(closed_system, t)
        found["step"] = {"t": numbers(t), "y": numbers(np.asarray(y).ravel())}
        found["overshoot"] = float(np.max(y) - 1.0)
    return found


def _loops(made: PointPid | StateFeedback) -> tuple[Any, Any]:
    """(loop gain, closed loop from the wanted to the reached position, or None)."""
    import control

    if isinstance(made, PointPid):
        return made.loop, control.feedback(made.loop, 1)
    if not made.integrated:
        return made.loop, None
    a, b, gains = made.augmented()
    k = len(made.integrated)
    wanted = np.vstack([np.zeros((len(a) - k, k)), -np.eye(k)])
    return made.loop, control.ss(a - b @ gains, wanted, a[-k:], np.zeros((k, k)))


def _settled(poles: Any) -> float:
    """A time [s] in which the slowest mode that decays has gone."""
    rates = -np.asarray(poles).real
    slow = rates[rates > 1e-3]
    return float(np.clip(6.0 / slow.min(), 0.05, 20.0)) if slow.size else 2.0


def _margins(made: Any) -> dict[str, float | None]:
    """Gain [dB] and phase [deg] margin, the smaller of all inputs, and the crossover [Hz]."""
    found = margins(made.loop)
    gain, phase = float(min(found.gain)), float(min(found.phase))
    crossover = float(np.nanmax(found.crossover)) if np.isfinite(found.crossover).any() else None
    return {
        "gain": float(20 * np.log10(gain)) if np.isfinite(gain) and gain > 0 else None,
        "phase": phase if np.isfinite(phase) else None,
        "crossover": crossover,
    }


def _complex(values: Any) -> dict[str, list[Any]]:
    each = np.asarray(values, complex)
    return {"re": numbers(each.real), "im": numbers(each.imag)}


def _shown(plant: Plant) -> list[str]:
    return [v.name for v in (*plant.states, *plant.inputs) if not v.disturbance]


# ---- a run ---------------------------------------------------------------------------------------
def loop_of(world: World, said: Mapping[str, Any]) -> ClosedLoop:
    """The run of a controller against the plant as a script makes it. The last few are kept."""
    return _loop(world, {k: said[k] for k in said if k not in ("id", "name")})


@kept("plant", "muscle", "point")
def _loop(world: World, said: Mapping[str, Any]) -> ClosedLoop:
    plant = plant_of(world)
    side = _side(world)
    point = point_of(world, plant)
    made = controller_of(plant, point, said)
    position = next(iter(plant.positions))
    keywords = run_keywords(said, position, point[position] + said["study"]["step"])
    if keywords["disturbances"] and PUSH not in {v.name for v in side.inputs}:
        raise InputError(f"{side.name} takes no force from outside; set the push to 0")
    start = {n: point[n] for n in _shown(plant)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return closed_loop(made, side, start=start, **keywords)


@job("Run {}", warm="control", latest="run", time_limit=120.0)
def closed(say: Say, world: World, said: Mapping[str, Any]) -> dict[str, Any]:
    """The run as plain values, with its film."""
    say(None, "running")
    found = loop_of(world, said)
    motion = found.trajectory
    every = max(1, len(motion.t) // 600)
    side = _side(world)
    position = next(iter(side.positions))
    inputs = [v.name for v in side.inputs]
    columns = {
        n: numbers(motion[n][::every] / motion.variable(n).display_factor)
        for n in (position, *inputs)
    }
    units = {n: motion.variable(n).display_unit for n in columns}
    return {
        "t": numbers(motion.t[::every]),
        "columns": columns,
        "units": units,
        "reference": None
        if found.reference is None
        else numbers(found.reference[position][::every] / motion.variable(position).display_factor),
        "position": position,
        "inputs": inputs,
        "words": str(found),
        "figures": loop_figures(found, position),
    }


def loop_figures(found: ClosedLoop, position: str) -> dict[str, float]:
    """What the exported script says of a run, too."""
    reached = found.trajectory[position]
    return {
        f"final({position})": float(reached[-1]),
        f"max({position})": float(reached.max()),
        f"min({position})": float(reached.min()),
    }


# ---- live ----------------------------------------------------------------------------------------
class _Live:
    """A controller and the real side, sample after sample."""

    def __init__(self, world: World, said: Mapping[str, Any]) -> None:
        self.plant = plant_of(world)
        self.whole = _side(world)
        self.point = point_of(world, self.plant)
        self.position = next(iter(self.plant.positions))
        self.sample_time = said["sample_time"]
        self.goal = self.point[self.position]
        start = {n: self.point[n] for n in _shown(self.plant)}
        file = None
        if said.get("against") == "fmu":  # the real side among the session's exports
            file = export_fmu(self.whole, world.exported("live.fmu"), platforms=["native"])
        self.side = self._begin(start, file)
        made = controller_of(self.plant, self.point, said)
        self.controller = made
        if not (isinstance(made, StateFeedback) and not made.integrated):
            told = {self.position: lambda t: self.goal}
            self.controller = made.tracking(told, dict(self.side.inputs), False)
        self.controller.reset()
        self.actuators = Actuators(self.side, self.plant)
        self.k = self.since = 0

    def _begin(self, start: Mapping[str, float], file: Path | None = None) -> Side:
        side = side_of(
            self.whole if file is None else file,
            self.plant,
            self.sample_time,
            1,
            parameters=None,
            start=dict(start),
            rtol=1e-6,
        )
        return side.__enter__()

    def run(self, samples: int, push: float) -> dict[str, Any]:
        """What happens in so many samples."""
        rows: dict[str, list[float]] = {"reference": [], self.position: []}
        rows |= {n: [] for n in self.side.inputs}
        times = []
        for _ in range(samples):
            t = self.k * self.sample_time
            if PUSH in self.side.inputs:
                self.side.inputs[PUSH] = push
            now = self.side.values()
            answer = self.actuators(t, self.controller(t, now))
            self.side.inputs.update({n: u for n, u in answer.items() if n != PUSH})
            self.side.step(t)
            times.append(t)
            rows["reference"].append(self.goal)
            rows[self.position].append(now[self.position])
            for n in self.side.inputs:
                rows[n].append(self.side.inputs[n])
            self.k += 1
        self.since += samples
        if self.since > FRESH and isinstance(self.side, PlantSide):
            self.side = self._begin(self._standing(self.side))
            self.since = 0
        return {"t": times, "rows": rows}

    def _standing(self, side: Side) -> dict[str, float]:
        """States and inputs of the plant as a side has them."""
        values = side.values()
        return {v.name: values[v.name] for v in (*self.whole.states, *self.whole.inputs)}

    def go_on(self, before: _Live) -> bool:
        """Begin where another controller's run stands, of the same plant; whether that can be."""
        if not isinstance(before.side, PlantSide):
            return False
        self.side.__exit__(None, None, None)
        self.side = self._begin(self._standing(before.side))
        self.actuators = Actuators(self.side, self.plant)
        self.goal = before.goal
        self.k = round(before.k * before.sample_time / self.sample_time)
        return True

    def scene(self) -> dict[str, Any] | None:
        """The side as it stands."""
        values = self.side.values()
        x, u = (
            np.array([[values.get(v.name, v.start or 0.0)] for v in each])
            for each in (self.whole.states, self.whole.inputs)
        )
        return scene_of(self.whole, np.zeros(1), x, u)


_runs: dict[str, tuple[tuple[str, str], _Live]] = {}


@job("Live", warm="live", time_limit=60.0, quiet=True)
def live(say: Say, world: World, said: Mapping[str, Any], ask: Mapping[str, Any]) -> dict[str, Any]:
    """Some samples more of a run; it is begun where this process has none, which the answer says
    ("restart"). With other gains it goes on where it stands, and is built anew ("built").

    ask : {"run": its name, "seconds", "reference" [SI], "push" [N]}.
    """
    made_of = [world.state[n] for n in ("plant", "muscle", "point")]
    whose = json.dumps([made_of, said.get("against"), ask["run"]], sort_keys=True)
    key = whose, json.dumps(said, sort_keys=True)
    there = _runs.get(str(world.folder))
    built = there is None or there[0] != key
    fresh = there is None or there[0][0] != key[0]
    if built:
        run = _Live(world, said)
        if there is not None:
            fresh = fresh or not run.go_on(there[1])
            there[1].side.__exit__(None, None, None)
        _runs[str(world.folder)] = there = key, run
    assert there is not None
    run = there[1]
    if ask["reference"] is not None:
        run.goal = float(ask["reference"])
    samples = max(1, round(ask["seconds"] / run.sample_time))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = run.run(samples, float(ask["push"]))
    whole = {v.name: v for v in (*run.whole.states, *run.whole.inputs)}
    rows = {
        n: numbers(np.array(v) / whole[run.position if n == "reference" else n].display_factor)
        for n, v in found["rows"].items()
    }
    return {
        "t": found["t"],
        "rows": rows,
        "restart": fresh,
        "built": built,
        "scene": run.scene(),
    }

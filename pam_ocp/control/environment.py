"""``pam.env``: a plant as a Gymnasium environment, alone or many at once, scored by the optimum."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, UnknownNameError, require_count, require_positive
from ..core.lazy import library
from ..core.stop import verb
from ..export.worlds.jax_world import JaxPlant, jax_plant
from ..planning.planner import plan
from ..plants.plant import Plant, Values, require_plant
from .kinds import Array

Target: TypeAlias = "Mapping[str, float | tuple[float, float]]"
Kind = Literal["reach", "track", "stiffness"]

RK4_STEPS = 40
"""Steps of rk4 within a sample, beyond which Rodas5P makes two."""
PARTS = 10
"""Steps within the longest that rk4 stands: for an error of about 1e-6 (scaled by nominals)."""
SLOW = 5.0
"""Speed at which a target counts as reached, in tolerances of nominal speeds."""


@dataclass(frozen=True)
class Task:
    """What is asked of a policy.

    kind : "reach": come to rest at the target as soon as possible. "stiffness": the same, with
        outputs such as a stiffness among the target's values. "track": follow ``amplitude``
        sin(2 pi ``frequency`` t) about the target's values.
    target : {name of a state or an output: value, or (low, high) drawn at each reset} [SI].
    tolerance : of each value, in parts of its nominal, within which it counts as reached.
    duration : of an episode [s], after which it is truncated.

    Examples
    --------
    >>> pam.control.Task("reach", {"x": 0.03}, duration=1.0).kind
    'reach'
    """

    kind: Kind
    target: Target
    tolerance: float = 0.01
    duration: float = 2.0
    amplitude: Mapping[str, float] = field(default_factory=dict)
    frequency: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise InputError(f"task = {self.kind!r}: choose one of {', '.join(get_args(Kind))}")
        if not self.target:
            raise InputError("target is empty; name what is to be reached, as {'x': 0.01}")
        for name in ("tolerance", "duration", "frequency"):
            require_positive(name, getattr(self, name))
        for name in self.amplitude:
            if name not in self.target:
                raise UnknownNameError("amplitude", name, list(self.target))


@verb
def env(
    plant: Plant,
    task: Kind | Task,
    target: Target | None = None,
    *,
    start: Values | None = None,
    sample_time: float = 0.01,
    num_envs: int | None = None,
    **options: Any,
) -> Any:
    """A plant as a ``gymnasium.Env``; with ``num_envs`` as a ``gymnasium.vector.VectorEnv``.

    task : "reach", "track", "stiffness", or a Task. target, and as options ``tolerance``,
        ``duration``, ``amplitude``, ``frequency`` : see :class:`Task`.
    start : conditions of the equilibrium at which episodes start, as ``plant.equilibrium`` takes
        them; by default the plant's start values.
    sample_time : for which an action is held [s].

    Actions are -1 .. 1 for each input's min .. max. Observations are the states in units of
    nominal, then how far each of the target's values is off, in units of its nominal. A motion that
    leaves the range of a state ends the episode.

    Rewards of "reach" and "stiffness" add up to minus the time [s], plus what the distance (in
    units of nominal) became less: this shaping changes no optimal policy; leaving a range costs the
    duration. Rewards of "track" add up to minus the integral of the squared error. ``info`` has
    ``time``, ``distance``, ``success``. ``environment.optimum`` is the verified Plan of the same
    task, and ``environment.score(time)`` its duration as a part of a policy's time.

    Needs the extra ``gym``. Raises InputError for an input without finite range, UnknownNameError
    for a target that is no state or output.

    Examples
    --------
    >>> world = pam.env(plant, "reach", {"x": 0.02}, start={"x": 0.01})  # doctest: +SKIP
    >>> observation, info = world.reset(seed=1)  # doctest: +SKIP
    """
    library("gymnasium", "gym", "env")
    library("jax", "gym", "env")
    plant = require_plant(plant)
    if not isinstance(task, Task):
        task = Task(task, target or {}, **options)
    elif target is not None or options:
        raise InputError("target and its options stand in the Task; leave them out")
    step = require_positive("sample_time", sample_time, "s")
    system = _System(plant, jax_plant(plant), task, dict(start or {}), step)
    if num_envs is None:
        return _classes()[0](system)
    return _classes()[1](system, require_count("num_envs", num_envs))


@dataclass(frozen=True, eq=False)
class _System:
    """Many plants side by side, in NumPy: what one and many environments share."""

    plant: Plant
    world: JaxPlant
    task: Task
    start: Values
    sample_time: float

    def __post_init__(self) -> None:
        known = {v.name: v for v in (*self.plant.states, *self.plant.outputs)}
        for name in self.task.target:
            if name not in known:
                raise UnknownNameError("target", name, list(known))
        for v in self.plant.inputs:
            if not (math.isfinite(v.min) and math.isfinite(v.max)):
                raise InputError(f"env: input {v.name} has no finite range; give it min and max")

    @cached_property
    def begin(self) -> tuple[Array, Array]:
        """States and inputs at the start of an episode."""
        point = self.plant.equilibrium(self.start) if self.start else None
        plant = self.plant if point is None else self.plant.with_values(point)
        return plant.vector("state"), plant.vector("input")

    @cached_property
    def places(self) -> tuple[NDArray[np.int64], Array]:
        """Where the target's values stand among states and outputs, and their nominals."""
        known = [*self.plant.states, *self.plant.outputs]
        names = [v.name for v in known]
        at = [names.index(n) for n in self.task.target]
        return np.array(at), np.array([known[i].nominal for i in at])

    @cached_property
    def _moved(self) -> Any:
        """(x, u) -> (x a sample later, y there), compiled."""
        longest = self.world.longest / PARTS
        steps = max(1, math.ceil(self.sample_time / longest)) if longest < math.inf else 1
        method = "rk4" if steps <= RK4_STEPS else "rosenbrock"
        steps = max(steps, 2) if method == "rk4" else 2
        stepper = self.world.stepper(self.sample_time / steps, method)  # type: ignore[arg-type]

        def moved(x: Any, u: Any) -> Any:
            new = stepper.run(x, u, steps=steps)
            return new, self.world.outputs(0.0, new, u)

        return _compiled(moved)

    @cached_property
    def outputs(self) -> Any:
        """(x, u) -> y (n, ny), compiled."""
        return _compiled(lambda x, u: self.world.outputs(0.0, x, u))

    def moved(self, x: Array, action: Array) -> tuple[Array, Array, Array]:
        """(x, y, u) a sample later."""
        low, high = (self.plant.vector("input", attribute=a) for a in ("min", "max"))
        u = low + (np.clip(np.asarray(action, float), -1, 1) + 1) / 2 * (high - low)
        return *self._moved(x, u), u

    def drawn(self, rng: np.random.Generator, n: int) -> Array:
        """Targets (n, values)."""
        ends = [np.broadcast_to(v, 2) for v in self.task.target.values()]
        rows = [[float(rng.uniform(*e)) for e in ends] for _ in range(n)]
        return np.array(rows, float).reshape(n, len(ends))

    def wanted(self, target: Array, t: Array) -> Array:
        """The target's values at times (n,)."""
        if self.task.kind != "track":
            return target
        size = np.array([self.task.amplitude.get(n, 0.0) for n in self.task.target])
        wave = np.sin(2 * np.pi * self.task.frequency * t)
        moved: Array = target + size * wave[:, None]
        return moved

    def off(self, x: Array, y: Array, target: Array, t: Array) -> Array:
        """How far the values are from the wanted ones, scaled by nominals (n, values)."""
        at, nominal = self.places
        values = np.concatenate([x, y], axis=-1)[:, at]
        missing: Array = (self.wanted(target, t) - values) / nominal
        return missing

    def seen(self, x: Array, off: Array) -> Array:
        """The observation (n, nx + values)."""
        return np.concatenate([x / self.world.signature.nominal, off], axis=-1)

    def still(self, x: Array) -> NDArray[np.bool_]:
        """Whether what is moved is slow: below the tolerance in units of nominal speeds."""
        states = {v.name: i for i, v in enumerate(self.plant.states)}
        at = [states[v] for v in self.plant.load_positions.values()]
        speeds = np.abs(x[:, at]) / self.world.signature.nominal[at]
        return np.asarray(np.all(speeds <= SLOW * self.task.tolerance, axis=-1))

    def left(self, x: Array) -> NDArray[np.bool_]:
        """Whether a state is outside of its range, or no number."""
        low, high = (self.plant.vector("state", attribute=a) for a in ("min", "max"))
        slack = 1e-6 * self.world.signature.nominal
        return np.asarray(~np.all((x >= low - slack) & (x <= high + slack), axis=-1))

    def judged(
        self, off: Array, before: Array, x: Array, t: Array
    ) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
        """(reward, terminated, truncated, success) of a sample."""
        left, late = self.left(x), t >= self.task.duration - 1e-9
        if self.task.kind == "track":
            reward = -np.sum(off**2, axis=-1) * self.sample_time
            success = np.zeros(len(x), bool)
        else:
            nearer = np.linalg.norm(before, axis=-1) - np.linalg.norm(off, axis=-1)
            reward = nearer - self.sample_time
            success = np.all(np.abs(off) <= self.task.tolerance, axis=-1) & self.still(x) & ~left
        reward = np.where(left, -self.task.duration, reward)
        return reward, success | left, late & ~(success | left), success

    @cached_property
    def optimum(self) -> Any:
        """The verified quickest Plan from the start to the (middle of the) target."""
        if self.task.kind == "track":
            raise InputError("optimum: a task that tracks has none; its measure is the error")
        middle = {n: float(np.mean(v)) for n, v in self.task.target.items()}
        states = {v.name: x for v, x in zip(self.plant.states, self.begin[0], strict=True)}
        first = {n: v for n, v in states.items() if n in self.plant.load_positions}
        return plan(self.plant, stops=[self.start or first, middle])

    def score(self, time: float) -> float:
        """The optimal time as a part of a policy's: 1 is the optimum."""
        return float(self.optimum.duration / require_positive("time", time, "s"))


def _compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    import jax

    jitted = jax.jit(function)

    def called(*arguments: Array) -> Any:
        with jax.enable_x64(True):
            return jax.tree.map(np.asarray, jitted(*arguments))

    return called


@cache
def _classes() -> tuple[type, type]:
    """The classes of one and of many environments, made where Gymnasium is there."""
    import gymnasium
    from gymnasium.vector import AutoresetMode, VectorEnv

    def spaces(system: _System) -> tuple[Any, Any]:
        sizes = len(system.plant.states) + len(system.task.target), len(system.plant.inputs)
        return (
            gymnasium.spaces.Box(-np.inf, np.inf, (sizes[0],), np.float64),
            gymnasium.spaces.Box(-1.0, 1.0, (sizes[1],), np.float32),
        )

    class Common:
        """The episodes under way."""

        def __init__(self, system: _System, count: int) -> None:
            self.system, self.count = system, count
            self._x = np.tile(system.begin[0], (count, 1))
            self._t = np.zeros(count)
            self._target = np.zeros((count, len(system.task.target)))
            self._off = np.zeros_like(self._target)

        @property
        def optimum(self) -> Any:
            """The verified Plan of this task."""
            return self.system.optimum

        def score(self, time: float) -> float:
            """The optimal time as a part of a policy's."""
            return self.system.score(time)

        def begun(self, which: NDArray[np.bool_], rng: np.random.Generator) -> None:
            """Start these episodes."""
            system, n = self.system, int(np.sum(which))
            self._x[which], self._t[which] = system.begin[0], 0.0
            self._target[which] = system.drawn(rng, n)
            y = system.outputs(self._x, np.tile(system.begin[1], (self.count, 1)))
            off = system.off(self._x, y, self._target, self._t)
            self._off[which] = off[which]

        def sampled(self, action: Any) -> tuple[Any, ...]:
            x, y, _ = self.system.moved(self._x, action)
            self._t = self._t + self.system.sample_time
            off = self.system.off(x, y, self._target, self._t)
            judged = self.system.judged(off, self._off, x, self._t)
            self._x, self._off = np.where(np.isfinite(x), x, self._x), off
            self._off = np.where(np.isfinite(off), off, 0.0)
            return judged

        def seen(self) -> Array:
            return self.system.seen(self._x, self._off)

        def told(self, success: Any) -> dict[str, Any]:
            distance = np.linalg.norm(self._off, axis=-1)
            return {"time": self._t.copy(), "distance": distance, "success": success}

    class One(Common, gymnasium.Env):  # type: ignore[misc]
        """One plant."""

        metadata: Any = {"render_modes": []}  # noqa: RUF012

        def __init__(self, system: _System) -> None:
            Common.__init__(self, system, 1)
            self.observation_space, self.action_space = spaces(system)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, Any]:
            gymnasium.Env.reset(self, seed=seed)
            self.begun(np.array([True]), self.np_random)
            return self.seen()[0], self._first(np.array([False]))

        def step(self, action: Any) -> tuple[Array, float, bool, bool, Any]:
            reward, ended, late, success = self.sampled(np.asarray(action)[None])
            told = self._first(success)
            return self.seen()[0], float(reward[0]), bool(ended[0]), bool(late[0]), told

        def _first(self, success: Any) -> dict[str, Any]:
            return {k: v[0].item() for k, v in self.told(success).items()}

    class Many(Common, VectorEnv):  # type: ignore[misc]
        """Many plants at once; an episode that ended starts anew at the next step."""

        metadata: Any = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

        def __init__(self, system: _System, count: int) -> None:
            Common.__init__(self, system, count)
            self.num_envs = count
            self.single_observation_space, self.single_action_space = spaces(system)
            batch = gymnasium.vector.utils.batch_space
            self.observation_space = batch(self.single_observation_space, count)
            self.action_space = batch(self.single_action_space, count)
            self._over = np.zeros(count, bool)

        def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Array, Any]:
            VectorEnv.reset(self, seed=seed)
            self.begun(np.ones(self.count, bool), self.np_random)
            self._over[:] = False
            return self.seen(), self.told(np.zeros(self.count, bool))

        def step(self, action: Any) -> tuple[Array, Array, Any, Any, Any]:
            over = self._over
            reward, ended, late, success = self.sampled(action)
            if over.any():
                self.begun(over, self.np_random)
                reward[over] = 0.0
                for flags in (ended, late, success):
                    flags[over] = False
            self._over = ended | late
            return self.seen(), reward, ended, late, self.told(success)

    return One, Many

"""Networks, beside which a user sees what the physics is worth.

Fitted to records and judged by free runs from the starts at which
:class:`~pam_ocp.fitting.dynamic.structures.ArxStructure` is judged. A network's
step is written once, for NumPy and for JAX: it is trained in JAX by optax, on free runs over the
longest horizon, and predicts in NumPy, so that a model that was kept needs neither. An error counts
in parts of how far the outputs move over as many samples, lest the ends of runs be all that is
learnt. Scales, windows and those held out for early stopping come from the training records alone.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...core.errors import FitError, require_count, require_positive
from ...core.lazy import library
from ...core.trajectory import Trajectory
from ..statistics import Array
from .structures import BlackBox, Scales, levels_of, one_length

Weights: TypeAlias = dict[str, Any]
Single: TypeAlias = NDArray[np.float32]
FARTHEST = 50.0
"""Where free runs are clipped, in standard deviations of the outputs."""
HELD_OUT = 0.2
"""Part of the windows that stops the training early."""
CHECKED = 50
"""Updates from one look at the held-out windows to the next."""
JUDGES = 256
"""Held-out windows of each member."""
PATIENCE = 10
"""Looks without a better one, of any member, that end the training."""
WARM = 0.05
"""Part of the updates over which the rate rises."""
LARGEST_GRADIENT = 1.0


# ---- what computes ------------------------------------------------------------------------------
@dataclass(frozen=True)
class _Arrays:
    """NumPy, or JAX: functions of arrays, and a loop over their first axis."""

    xp: Any
    scan: Callable[..., Any]


def _loop(step: Callable[[Any, Any], tuple[Any, Any]], carry: Any, rows: Any) -> tuple[Any, Any]:
    """As jax.lax.scan."""
    found = []
    for row in rows:
        carry, one = step(carry, row)
        found.append(one)
    return carry, np.array(found)


NUMPY = _Arrays(np, _loop)


def _features(xp: Any, levels: Any, gain: Any) -> Any:
    """The newest of some levels (..., order, c), and their differences in parts of ``gain``."""
    differences = (levels[..., :-1, :] - levels[..., 1:, :]) / gain
    whole = xp.concatenate([levels[..., :1, :], differences], axis=-2)
    return whole.reshape(*levels.shape[:-2], -1)


@dataclass(frozen=True)
class _Network:
    """Increment of the outputs out of a linear part and hidden units: a layer of tanh, or, with a
    ``memory``, gated recurrent units (K. Cho et al., 2014, arXiv 1406.1078).
    """

    outputs: int
    inputs: int
    order: int
    lag: int
    units: int
    memory: bool = False

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Of the weights."""
        n, features = self.units, self.order * (self.outputs + self.inputs)
        gates = {"gates": (features + n, 2 * n), "gates0": (2 * n,)}
        return {
            "linear": (features, self.outputs),
            "offset": (self.outputs,),
            **(gates if self.memory else {}),
            "in": (features, n),
            **({"recalled": (n, n)} if self.memory else {}),
            "in0": (n,),
            "out": (n, self.outputs),
        }

    @property
    def weights(self) -> int:
        """How many there are."""
        return sum(int(np.prod(shape)) for shape in self.shapes().values())

    def features(self, xp: Any, past: Any, inputs: Any, times: Any, gains: Any) -> Any:
        """Of the samples before each of ``times`` (times, n, features)."""
        y = _features(xp, levels_of(xp, past, times, 1, self.order), gains[0])
        u = _features(xp, levels_of(xp, inputs, times, self.lag, self.order), gains[1])
        return xp.concatenate([y, u], axis=-1)

    def _hidden(self, xp: Any, w: Weights, memory: Any, x: Any) -> Any:
        """The units after features x; a layer without memory does not ask for the last ones."""
        if not self.memory:
            return xp.tanh(x @ w["in"] + w["in0"])
        both = xp.concatenate([x, memory], axis=-1) @ w["gates"] + w["gates0"]
        gates = 0.5 * (1.0 + xp.tanh(0.5 * both))  # the logistic function
        keep, reset = gates[..., : self.units], gates[..., self.units :]
        new = xp.tanh(x @ w["in"] + (reset * memory) @ w["recalled"] + w["in0"])
        return keep * memory + (1.0 - keep) * new

    def run(self, way: _Arrays, w: Weights, past: Any, inputs: Any, gains: Any) -> Any:
        """Free run (h, n, ny) behind a past (b, n, ny), which fills the memory, along inputs (b +
        h, n, nu), all scaled.
        """
        xp, before = way.xp, len(past)

        def step(carry: Any, u: Any) -> tuple[Any, Any]:
            memory, levels = carry
            x = xp.concatenate([_features(xp, levels, gains[0]), u], axis=-1)
            memory = self._hidden(xp, w, memory, x)
            increment = x @ w["linear"] + w["offset"] + memory @ w["out"]
            y = xp.clip(levels[:, 0] + gains[0] * increment, -FARTHEST, FARTHEST)
            return (memory, xp.concatenate([y[:, None], levels[:, :-1]], axis=1)), y

        def warm(memory: Any, x: Any) -> tuple[Any, Any]:
            return self._hidden(xp, w, memory, x), ()

        memory = xp.zeros_like(past[0, :, :1] * w["in0"])
        if self.memory:
            read = self.features(xp, past, inputs, np.arange(1, before), gains)
            memory = way.scan(warm, memory, read)[0]
        times = np.arange(before, len(inputs))
        drive = _features(xp, levels_of(xp, inputs, times, self.lag, self.order), gains[1])
        levels = levels_of(xp, past, [before], 1, self.order)[0]
        return way.scan(step, (memory, levels), drive)[1]


# ---- fitted networks ----------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class NetworkModel:
    """A trained network, or several whose predictions are averaged. before : samples of the past
    that it reads, the start included. held_out : loss of each member on the windows that stopped
    its training, in parts of outputs that stay where they are.
    """

    network: _Network
    weights: tuple[Mapping[str, Array], ...]
    scales: tuple[Scales, Scales]
    before: int
    held_out: tuple[float, ...]
    sampling: float

    def predict(self, past: Array, inputs: Array) -> Array:
        """Free runs (n, h, ny): of the outputs of b samples of the past (n, b, ny), and the inputs
        of these and of the run (n, b + h, nu). InputError where the past is too short.
        """
        past, inputs = one_length(past, inputs, self.before)
        y, u = (s(x).swapaxes(0, 1) for s, x in zip(self.scales, (past, inputs), strict=True))
        gains = tuple(s.gain for s in self.scales)
        runs = [self.network.run(NUMPY, dict(w), y, u, gains) for w in self.weights]
        scale = self.scales[0]
        return np.asarray(scale.mean + scale.size * np.mean(runs, axis=0).swapaxes(0, 1))


# ---- training -----------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _Windows:
    """Free runs from scaled records one behind the other; ``places`` : (record, start) of each."""

    y: Array
    u: Array
    begin: NDArray[np.intp]
    length: NDArray[np.intp]
    places: NDArray[np.intp]
    before: int
    ahead: int

    def __call__(self, chosen: NDArray[np.intp]) -> tuple[Single, Single, Single]:
        """Outputs and inputs (..., before + ahead, c) of some windows (...), and whether a sample
        of the run lies in the record (..., ahead).
        """
        record, start = np.moveaxis(self.places[chosen], -1, 0)[..., None]
        place = start + np.arange(1 - self.before, self.ahead + 1)
        inside = place[..., self.before :] < self.length[record]
        place = self.begin[record] + np.clip(place, 0, self.length[record] - 1)
        y, u = self.y[place], self.u[place]
        return y.astype(np.float32), u.astype(np.float32), inside.astype(np.float32)


def _drawable(
    runs: BlackBox, series: Sequence[tuple[Array, Array]], before: int, sampling: float
) -> _Windows:
    """All starts behind ``first`` from which the shortest horizon lies in the record."""
    first = round(runs.first / sampling)
    least, most = (round(f(runs.horizon) / sampling) for f in (min, max))
    length = np.array([len(y) for y, _ in series])
    places = [(i, k) for i, n in enumerate(length) for k in range(first, n - least)]
    if len(places) < 2:
        raise FitError(
            f"no record is longer than first = {runs.first:g} s and the shortest horizon, "
            f"{min(runs.horizon):g} s"
        )
    y, u = (np.concatenate(part) for part in zip(*series, strict=True))
    begin = np.cumsum(length) - length
    return _Windows(y, u, begin, length, np.array(places), before, most)


def _weighing(pool: _Windows, random: np.random.Generator) -> Array:
    """1 / mean square of how far outputs move within 1, 2, ... samples (ahead, ny)."""
    chosen = random.integers(len(pool.places), size=4 * JUDGES)
    y, _, inside = pool(chosen)
    moved = (y[:, pool.before :] - y[:, pool.before - 1 : pool.before]) ** 2
    count = np.maximum(inside.sum(axis=0), 1)[:, None]
    square = (moved * inside[..., None]).sum(axis=0) / count
    floor = 1e-6 + 1e-3 * square.max(axis=0)
    return np.asarray(1.0 / np.maximum(square, floor), dtype=np.float32)


def _linear(network: _Network, pool: _Windows, gains: tuple[Array, Array]) -> tuple[Array, Array]:
    """Least squares of one step, where the training of the linear part begins."""
    y, u, _ = replace(pool, ahead=1)(np.arange(len(pool.places)))
    past = y[:, : pool.before].swapaxes(0, 1)
    x = network.features(np, past, u.swapaxes(0, 1), [pool.before], gains)[0]
    rows = np.column_stack([x, np.ones(len(x))])
    steps = (y[:, pool.before] - y[:, pool.before - 1]) / gains[0]
    found = np.linalg.lstsq(rows, steps, rcond=1e-6)[0]
    return found[:-1], found[-1]


def _begin(
    network: _Network, members: int, linear: tuple[Array, Array], random: np.random.Generator
) -> dict[str, Array]:
    """Weights of all members (members, ...): the linear part the same, the others at random."""
    found = {}
    for name, shape in network.shapes().items():
        spread = random.standard_normal((members, *shape)) / np.sqrt(shape[0])
        found[name] = spread if len(shape) > 1 else np.zeros((members, *shape))
    found["out"] *= 0.1  # the linear part alone is not far from the best
    found["linear"] = np.repeat(linear[0][None], members, axis=0)
    found["offset"] = np.repeat(linear[1][None], members, axis=0)
    return {n: w.astype(np.float32) for n, w in found.items()}


@lru_cache(maxsize=16)
def _updates(network: _Network, before: int) -> tuple[Any, Any, Any]:
    """(begin, advance, judged) of the training of all members at once, compiled once for data of
    any length.
    """
    import jax
    import optax
    from jax import numpy as jnp

    way = _Arrays(jnp, jax.lax.scan)
    method = optax.chain(
        optax.clip_by_global_norm(LARGEST_GRADIENT), optax.scale_by_adam(), optax.scale(-1.0)
    )

    def loss(w: Any, window: Any, scale: Any) -> Any:
        y, u, inside = window
        y, u = jnp.swapaxes(y, 0, 1), jnp.swapaxes(u, 0, 1)
        run = network.run(way, w, y[:before], u, scale[1:])
        square = (run - y[before:]) ** 2 * scale[0][:, None]
        return jnp.sum(square.mean(axis=-1) * inside.T) / jnp.sum(inside)

    def update(w: Any, state: Any, window: Any, rate: Any, scale: Any) -> Any:
        slope = jax.grad(loss)(w, window, scale)
        change, state = method.update(slope, state, w)
        return optax.apply_updates(w, {n: rate * c for n, c in change.items()}), state

    every = jax.vmap(update, in_axes=(0, 0, 0, None, None))

    def advance(w: Any, state: Any, drawn: Any, rates: Any, scale: Any) -> Any:
        def one(carry: Any, row: Any) -> Any:
            return every(*carry, *row, scale), ()

        return jax.lax.scan(one, (w, state), (drawn, rates))[0]

    judged = jax.jit(jax.vmap(loss, in_axes=(0, 0, None)))
    return jax.vmap(method.init), jax.jit(advance), judged


def _rates(steps: int, largest: float) -> Single:
    """Of every update, whole rounds of them: rising at first, then down to zero by a cosine."""
    count = CHECKED * -(-steps // CHECKED)
    part = (np.arange(count) + 1) / count
    falls = 0.5 + 0.5 * np.cos(np.pi * np.clip((part - WARM) / (1 - WARM), 0, 1))
    return (largest * np.minimum(part / WARM, 1) * falls).astype(np.float32)


def _split(
    count: int, members: int, apart: bool, random: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Windows of each member for training, and those held out (members, JUDGES). The latter are one
    piece of the row of all windows, ``apart`` another for each member.
    """
    out = min(max(1, round(HELD_OUT * count)), count - 1)
    shifts = random.integers(count) + np.arange(members) * out * apart
    rows = (shifts[:, None] + np.arange(count)) % count
    picked = random.integers(out, size=(members, JUDGES))
    return rows[:, out:], np.take_along_axis(rows[:, :out], picked, axis=1)


_AT_FORK = {"jax": False}
"""Whether this process was forked from one that had JAX."""


def _forked() -> None:
    _AT_FORK["jax"] = "jax" in sys.modules


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def _require_jax(asks: str) -> None:
    """InputError without the extra, FitError where JAX would wait for threads forever."""
    for name in ("jax", "optax"):
        library(name, "learn", asks)
    if _AT_FORK["jax"]:
        raise FitError(
            f"{asks} is to be trained in a process that was forked from one with JAX, where it has "
            "no threads: executor=0, or a pool with multiprocessing.get_context('spawn')"
        )


# ---- structures ---------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _NetworkStructure(BlackBox):
    """What networks have in common; :class:`NarxStructure` explains the fields."""

    outputs: Sequence[str]
    inputs: Sequence[str]
    horizon: Sequence[float]
    every: float
    first: float = 0.1
    lag: int = 0
    units: int = 32
    steps: int = 2000
    batch: int = 64
    rate: float = 3e-3
    seed: int = 0
    alone: ClassVar[bool] = True

    def __post_init__(self) -> None:
        self.require("units", "steps", "batch")
        require_positive("rate", self.rate)
        require_count("seed", self.seed, 0)

    def _made(self, order: int, memory: bool) -> _Network:
        return _Network(len(self.outputs), len(self.inputs), order, self.lag, self.units, memory)

    def _fitted(
        self,
        network: _Network,
        before: int,
        members: int,
        records: Sequence[Trajectory],
    ) -> NetworkModel:
        """With a memory all members are kept, each with other windows held out; else the best."""
        _require_jax(type(self).__name__)
        data, apart = self.data(records), network.memory
        scales = data.scales
        scaled = [(scales[0](y), scales[1](u)) for y, u in data.series]
        pool = _drawable(self, scaled, before, data.sampling)
        gains = scales[0].gain, scales[1].gain
        weights, losses = self._trained(network, pool, gains, members, apart)
        kept = range(members) if apart else [int(np.argmin(losses))]
        if not np.all(np.isfinite(losses[list(kept)])):
            raise FitError("the training left the range of numbers; a lower rate= may help")
        chosen = tuple({n: w[i].astype(float) for n, w in weights.items()} for i in kept)
        held_out = tuple(losses[list(kept)].tolist())
        return NetworkModel(network, chosen, scales, before, held_out, data.sampling)

    def _trained(
        self,
        network: _Network,
        pool: _Windows,
        gains: tuple[Array, Array],
        members: int,
        apart: bool,
    ) -> tuple[dict[str, Array], Array]:
        """(weights of all members, their losses on what they held out)."""
        random = np.random.default_rng(self.seed)
        scale = (_weighing(pool, random), *(g.astype(np.float32) for g in gains))
        training, held = _split(len(pool.places), members, apart, random)
        begin, advance, judged = _updates(network, pool.before)
        w = _begin(network, members, _linear(network, pool, gains), random)
        state, judges = begin(w), pool(held)
        best, least, waited = w, np.asarray(judged(w, judges, scale)), 0
        for rates in _rates(self.steps, self.rate).reshape(-1, CHECKED):
            chosen = random.integers(training.shape[1], size=(CHECKED, members, self.batch))
            drawn = pool(training[np.arange(members)[:, None], chosen])
            w, state = advance(w, state, drawn, rates, scale)
            now = np.asarray(judged(w, judges, scale))
            better = now < least  # never by what is not a number
            waited = 0 if better.any() else waited + 1
            least = np.where(better, now, least)
            best = {
                n: np.where(better.reshape(-1, *[1] * (old.ndim - 1)), np.asarray(w[n]), old)
                for n, old in best.items()
            }
            if waited >= PATIENCE:
                break
        return best, least


@dataclass(frozen=True, eq=False)
class NarxStructure(_NetworkStructure):
    """A network on what :class:`ArxStructure` is linear in (S. Chen, S. Billings, P. Grant, Int. J.
    Control 51 (1990) 1191-1214); needs ``pam_ocp[learn]``.

    ``order``, ``lag``, ``horizon``, ``every``, ``first`` : as there. A linear part and a hidden
    layer of ``units`` tanh give the increment of the outputs. ``tries`` of them begin at random
    (``seed``) and are trained side by side on free runs over the longest horizon, by at most
    ``steps`` updates of ``batch`` runs (Adam, its ``rate`` falling to zero); the one that is best
    on the windows held out is taken.

    Examples
    --------
    >>> names = ["x"], ["muscle.command"]
    >>> network = pam.fitting.NarxStructure(*names, order=2, horizon=[0.1], every=0.2, units=8)
    >>> network.complexity  # weights: 4 + 1 of the linear part, (4 + 1) 8 + 8 of the layer
    53.0
    >>> model = network.fit(runs)  # doctest: +SKIP
    >>> model.predict(past, inputs).shape  # (n, b, 1), (n, b + 10, 1)  # doctest: +SKIP
    (n, 10, 1)
    """

    order: int = 5
    tries: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_count("order", self.order)
        require_count("tries", self.tries)

    @property
    def _network(self) -> _Network:
        return self._made(self.order, memory=False)

    @property
    def complexity(self) -> float:
        """Number of weights."""
        return float(self._network.weights)

    def fit(self, records: Sequence[Trajectory], /) -> NetworkModel:
        """Trained on free runs drawn from all records. FitError where none is long enough."""
        before = max(self.order, self.order + self.lag)
        return self._fitted(self._network, before, self.tries, records)


@dataclass(frozen=True, eq=False)
class GruStructure(_NetworkStructure):
    """Gated recurrent units that read ``warm_up`` seconds of the past and then run freely along the
    inputs; needs ``pam_ocp[learn]``.

    Outputs and inputs, and their last differences, feed ``units`` and a linear part; both together
    give the increment of the outputs. Each of ``members`` begins at random, holds out other windows
    to be stopped early, and all are averaged (B. Lakshminarayanan et al., 2017, arXiv 1612.01474).
    The other fields are as for :class:`NarxStructure`.

    Examples
    --------
    >>> names = ["x"], ["muscle.command"]
    >>> network = pam.fitting.GruStructure(*names, horizon=[0.1], every=0.2, units=8, members=2)
    >>> network.complexity  # weights of both members
    650.0
    >>> rivals = {"GRU": network, "ARX(2)": yardstick}  # doctest: +SKIP
    >>> print(pam.fitting.choose(rivals, runs, folds=3).against("ARX(2)"))  # doctest: +SKIP
    """

    warm_up: float = 0.2
    members: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        require_count("members", self.members)
        require_positive("warm_up", self.warm_up)

    @property
    def _network(self) -> _Network:
        return self._made(2, memory=True)

    @property
    def complexity(self) -> float:
        """Number of weights of all members."""
        return float(self.members * self._network.weights)

    def fit(self, records: Sequence[Trajectory], /) -> NetworkModel:
        """Trained on free runs drawn from all records. FitError where none is long enough."""
        before = max(2, round(self.warm_up / self.data(records).sampling) + 1)
        return self._fitted(self._network, before, self.members, records)

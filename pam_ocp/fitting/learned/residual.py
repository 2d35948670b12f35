"""A learned residual in the equations of a plant: what a rate or an output has beyond the physics.

For a rate r of a state (a velocity's: force over mass; a pressure's: flow) or an output::

    rate = physics + size f(s, h; w),      h_i' = (tanh(W_i [s, h, 1]) - h_i)/lag_i

with s the scaled variables that it depends on, f a :class:`Shape` with weights w, and h its memory:
leaky units within -1 .. 1 whatever happens, so that none of it is unstable by itself. ``passive``
makes it -size f^2 v/(size of v): it takes energy from the motion and never gives any.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from ...core.errors import InputError, require_count, require_flag, require_instance, require_names
from ...plants.plant import Plant
from ..statistics import Array
from .shapes import Form, GaussianProcess, Shape

__all__ = ["Attached", "Residual", "Visited", "attached"]

LAGS = (0.02, 0.5)
"""Of the first and the last unit of a memory [s], the others in geometric steps between."""
ASIDE = 0.1
"""A square has no slope at zero: weights of a passive residual begin beside it."""
LEAST = 1e-9
"""Standard deviation, in nominals, below which a variable is a constant."""


@dataclass(frozen=True)
class Residual:
    """What the physics leaves out, as a function that is learned; see :func:`fit_residual`.

    of : the state to whose rate it is added, or the output to whose value. A force or a moment is
        the rate of a velocity, a flow that of a pressure.
    on : states, inputs and outputs that it depends on.
    shape : the function: :class:`GaussianProcess`, :class:`Network`, :class:`Splines`, or any
        :class:`Shape`.
    passive : it may only take energy out (of a velocity).
    memory : how many states of its own it has, for what depends on the past.

    Examples
    --------
    >>> pam.fitting.Residual("v", ["x", "v", "muscle.pressure"], passive=True).memory
    0
    """

    of: str
    on: Sequence[str]
    shape: Shape = field(default_factory=GaussianProcess)
    passive: bool = False
    memory: int = 0

    def __post_init__(self) -> None:
        if not require_names("on", self.on):
            raise InputError("on is empty: name the states, inputs or outputs it depends on")
        require_instance("shape", self.shape, Shape, "give GaussianProcess(), Network(), Splines()")
        require_flag("passive", self.passive)
        require_count("memory", self.memory, 0)


@dataclass(frozen=True, eq=False)
class Visited:
    """Where training motions were: states (m, nx) and inputs (m, nu)."""

    x: Array
    u: Array

    def of(self, plant: Plant, expressions: Sequence[ca.SX]) -> Array:
        """Values (m, k) of expressions at the plant's parameters."""
        read = ca.Function("read", [plant.x, plant.u, plant.p], [ca.vertcat(*expressions)])
        found = read.map(len(self.x))(self.x.T, self.u.T, plant.vector("parameter"))
        return np.asarray(np.asarray(found, dtype=float).T)

    def shuffled(self, random: np.random.Generator) -> Visited:
        """Each variable where it was, at another time than the others: along motions the terms of
        a rate balance each other, here their size shows.
        """
        return Visited(random.permuted(self.x, axis=0), random.permuted(self.u, axis=0))


@dataclass(frozen=True, eq=False)
class Attached:
    """A plant with residuals. weights : names of their parameters. centre, precision : of the
    penalty (weights - centre)' precision (weights - centre); at ``centre`` the plant is what it
    was. begin : where a search begins.
    """

    plant: Plant
    weights: tuple[str, ...]
    centre: Array
    begin: Array
    precision: Array
    memories: tuple[str, ...]

    def at(self, weights: Array) -> Plant:
        """The plant with these weights."""
        return self.plant.with_values(dict(zip(self.weights, weights.tolist(), strict=True)))


def attached(
    plant: Plant, residuals: Sequence[Residual], visited: Visited, random: np.random.Generator
) -> Attached:
    """The plant with residuals, scaled by where training motions were."""
    found = Attached(plant, (), np.empty(0), np.empty(0), np.empty((0, 0)), ())
    for number, residual in enumerate(residuals):
        label = f"{plant.variable(residual.of).name}.learned"
        if any(w.startswith(f"{label}.") for w in found.weights):
            raise InputError(f"residuals[{number}] is a second one of {residual.of}; give one")
        one = _with_one(found.plant, residual, label, visited, random)
        blocks = found.precision, one.precision
        sizes = [len(b) for b in blocks]
        precision = np.zeros((sum(sizes), sum(sizes)))
        precision[: sizes[0], : sizes[0]], precision[sizes[0] :, sizes[0] :] = blocks
        visited = Visited(np.pad(visited.x, ((0, 0), (0, residual.memory))), visited.u)
        found = Attached(
            one.plant,
            found.weights + one.weights,
            np.concatenate([found.centre, one.centre]),
            np.concatenate([found.begin, one.begin]),
            precision,
            found.memories + one.memories,
        )
    return found


def _with_one(
    plant: Plant, residual: Residual, label: str, visited: Visited, random: np.random.Generator
) -> Attached:
    variable = plant.variable(residual.of)
    if variable.causality not in ("state", "output"):
        raise InputError(
            f"of = {residual.of!r} is an {variable.causality}; a residual is added to the rate of "
            "a state, or to an output"
        )
    if residual.passive and variable.name not in plant.positions.values():
        raise InputError(
            f"passive = True: {variable.name} is no velocity, the rate of another state"
        )
    of_state = variable.causality == "state"
    on = [plant.expression(n) for n in require_names("on", residual.on)]
    whole = plant.expression(f"der({variable.name})" if of_state else variable.name)
    seen = visited.of(plant, on)
    middle, wide = seen.mean(axis=0), seen.std(axis=0)
    nominal = np.array([plant.variable(n).nominal for n in require_names("on", residual.on)])
    wide = np.where(wide > LEAST * nominal, wide, nominal)
    size = _size(visited.shuffled(random).of(plant, [whole]), variable.nominal)
    s = (ca.vertcat(*on) - ca.DM(middle)) / ca.DM(wide)
    samples = (seen - middle) / wide
    m, d = residual.memory, len(on)
    leaky = random.standard_normal((m, d + m + 1)) / np.sqrt(d + m)
    past = np.tanh(samples @ leaky[:, :d].T + leaky[:, -1])
    form = residual.shape.form(np.hstack([samples, past]), random)
    values = np.concatenate([form.begin, leaky.ravel(order="F")])
    names = tuple(f"{label}.w{i + 1}" for i in range(len(values)))
    memories = tuple(f"{label}.memory{i + 1}" for i in range(m))

    speed = plant.expression(variable.name)
    wide_speed = _size(visited.of(plant, [speed]), variable.nominal)

    def declare(made: Plant) -> Mapping[str, ca.SX]:
        said = f"learned weight of what is added to {variable.name}"
        w = ca.vertcat(
            *(
                made.parameter(n, v, description=said)
                for n, v in zip(names, values.tolist(), strict=True)
            )
        )
        kept = [made.state(n, min=-1.0, max=1.0, description="learned memory") for n in memories]
        h = ca.vertcat(ca.SX(0, 1), *kept)
        inner = ca.reshape(w[len(form.begin) :], m, d + m + 1)
        lags = np.geomspace(*LAGS, m)
        for i in range(m):
            driven = ca.tanh(inner[i, : d + m] @ ca.vertcat(s, h) + inner[i, d + m])
            made.der(kept[i], (driven - h[i]) / lags[i])
        f = form.value(ca.vertcat(s, h), w[: len(form.begin)])
        if residual.passive:
            return {variable.name: -size * f**2 * speed / wide_speed}
        return {variable.name: size * f}

    begin = values.copy()
    if residual.passive:
        begin[: len(form.begin)] += ASIDE * form.linear * random.standard_normal(len(form.begin))
    return Attached(
        plant.with_terms(declare), names, values, begin, _precision(form, leaky.size), memories
    )


def _size(values: Array, nominal: float) -> float:
    """Of what varies: its standard deviation over the training motions."""
    found = float(values.std())
    return found if found > LEAST * nominal else nominal


def _precision(form: Form, more: int) -> Array:
    n = len(form.begin)
    found = np.eye(n + more)
    found[:n, :n] = form.precision
    return found

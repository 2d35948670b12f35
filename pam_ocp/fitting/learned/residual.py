"""A learned residual in the equations of a plant: what a rate or an output has beyond the physics.

For a rate r of a state (a velocity's: force over mass; a pressure's: flow) or an output::

    rate = physics + size f(s, h; w),      h_i' = (tanh(W_i [s, h, 1]) - h_i)/lag_i

with s the scaled variables that it depends on, f a :class:`Shape` with weights w, and h its memory:
leaky units within -1 .. 1 whatever happens, so that none of it is unstable by itself. ``passive``
makes it -size f^2 v/(size of v), a force along this velocity's coordinate, which moves the other
joints of a limb, too: it takes energy from the motion and never gives any.

A shape is of scaled variables (mean 0, standard deviation 1 over the training motions), of size 1,
and stays bounded far from them: a model that was good without it cannot run away because of it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.linalg import block_diag

from ...core.errors import (
    InputError,
    require_count,
    require_flag,
    require_instance,
    require_names,
    require_positive,
)
from ...plants.limbs import Limb
from ...plants.plant import Plant
from ..statistics import Array


@dataclass(frozen=True, eq=False)
class Form:
    """A function of d scaled variables with n weights. value : (variables (d,), weights (n,)) ->
    scalar. begin : where a search begins, and from where weights are shrunk back to: a function
    that is zero. linear : which weights (n,) are zero there. precision : (n, n), positive definite;
    the penalty is (w - begin)' precision (w - begin).
    """

    value: Callable[[ca.SX, ca.SX], ca.SX]
    begin: Array
    linear: Array
    precision: Array


@runtime_checkable
class Shape(Protocol):
    """What makes a :class:`Form` for samples (m, d) of its scaled variables.

    Examples
    --------
    >>> isinstance(pam.fitting.Network(6), pam.fitting.Shape)
    True
    """

    def form(self, samples: Array, random: np.random.Generator, /) -> Form:
        """The form; what it draws comes from ``random``."""
        ...


@dataclass(frozen=True)
class Network:
    """One hidden layer: b + sum of v_i tanh(W_i s + c_i), i = 1 .. ``units``; for any number of
    variables. Weights of the hidden layer begin at random, those behind it at zero.

    Examples
    --------
    >>> form = pam.fitting.Network(6).form(np.zeros((1, 2)), np.random.default_rng(1))
    >>> len(form.begin)  # 6 units with 2 weights, an offset and a weight behind, and an offset
    25
    """

    units: int = 8

    def __post_init__(self) -> None:
        require_count("units", self.units)

    def form(self, samples: Array, random: np.random.Generator, /) -> Form:
        """See :class:`Shape`."""
        d, n = samples.shape[1], self.units
        inner = random.standard_normal((n, d + 1)) / np.sqrt(max(d, 1))
        begin = np.concatenate([inner.ravel(order="F"), np.zeros(n + 1)])

        def value(s: ca.SX, w: ca.SX) -> ca.SX:
            hidden = ca.reshape(w[: n * (d + 1)], n, d + 1)
            behind = w[n * (d + 1) :]
            return ca.dot(behind[:n], ca.tanh(hidden[:, :d] @ s + hidden[:, d])) + behind[n]

        linear = np.arange(len(begin)) >= inner.size
        return Form(value, begin, linear, np.eye(len(begin)))


@dataclass(frozen=True)
class GaussianProcess:
    """The mean of a Gaussian process with a squared-exponential kernel, by inducing points (E.
    Snelson, Z. Ghahramani, NIPS 18 (2005) 1257): sum of w_i exp(-|s - z_i|^2/(2 l^2)).

    points : how many, placed among the samples by k-means. width : length scale l over the root of
    the number of variables. It tends to zero away from the training motions.

    Examples
    --------
    >>> samples = np.linspace(-2, 2, 50)[:, None]
    >>> form = pam.fitting.GaussianProcess(10).form(samples, np.random.default_rng(1))
    >>> len(form.begin)
    10
    """

    points: int = 20
    width: float = 1.0

    def __post_init__(self) -> None:
        require_count("points", self.points)
        require_positive("width", self.width)

    def form(self, samples: Array, random: np.random.Generator, /) -> Form:
        """See :class:`Shape`."""
        length = self.width * np.sqrt(samples.shape[1])
        count = min(self.points, len(np.unique(samples, axis=0)))
        centres, _ = kmeans2(samples, count, minit="++", rng=random)
        gaps = np.sum((centres[:, None] - centres[None]) ** 2, axis=2)
        kernel = np.exp(-gaps / (2 * length**2)) + 1e-6 * np.eye(len(centres))
        z = ca.DM(centres)

        def value(s: ca.SX, w: ca.SX) -> ca.SX:
            away = z - ca.repmat(s.T, len(centres), 1)
            return ca.dot(w, ca.exp(-ca.sum2(away**2) / (2 * length**2)))

        begin = np.zeros(len(centres))
        return Form(value, begin, np.ones(len(centres), bool), kernel)


@dataclass(frozen=True)
class Splines:
    """A sum of cubic splines, one of each variable: nothing but their sum, easy to draw and to read
    (T. Hastie, R. Tibshirani, Generalized Additive Models, 1990).

    knots : intervals of each, over the middle 98 % of its samples; beyond, the value there is held.
    The penalty is on second differences, and a hundredth of it on the weights themselves.

    Examples
    --------
    >>> form = pam.fitting.Splines(5).form(np.zeros((3, 2)), np.random.default_rng(1))
    >>> len(form.begin)  # 5 + 3 for each variable
    16
    """

    knots: int = 6

    def __post_init__(self) -> None:
        require_count("knots", self.knots)

    def form(self, samples: Array, random: np.random.Generator, /) -> Form:
        """See :class:`Shape`; nothing is drawn."""
        low, high = np.quantile(samples, [0.01, 0.99], axis=0)
        high = np.maximum(high, low + 1e-6)
        d, n = samples.shape[1], self.knots + 3
        places = np.arange(n) - 1.0

        def value(s: ca.SX, w: ca.SX) -> ca.SX:
            inside = (s - ca.DM(low)) / ca.DM(high - low)
            along = self.knots * ca.fmin(ca.fmax(inside, 0), 1)
            total = ca.SX(0)
            for j in range(d):
                away = ca.fabs(along[j] - ca.DM(places))
                basis = (ca.fmax(2 - away, 0) ** 3 - 4 * ca.fmax(1 - away, 0) ** 3) / 6
                total += ca.dot(w[j * n : (j + 1) * n], basis)
            return total

        rough = np.diff(np.eye(n), 2, axis=0)
        one = rough.T @ rough + 0.01 * np.eye(n)
        return Form(value, np.zeros(d * n), np.ones(d * n, bool), np.kron(np.eye(d), one))


# ---- in a plant ---------------------------------------------------------------------------------
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
    passive : it may only take energy out (of a velocity): a force along its coordinate. In
        equations of your own the coordinate is to have an inertia that it shares with no other.
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
        """Each variable where it was, at another time than the others: along motions the terms of a
        rate balance each other, here their size shows.
        """
        return Visited(random.permuted(self.x, axis=0), random.permuted(self.u, axis=0))


@dataclass(frozen=True, eq=False)
class Attached:
    """A plant with residuals; ``weights`` : names of their parameters. The penalty is (weights -
    centre)' precision (weights - centre); at ``centre`` the plant is what it was, from ``begin`` a
    search goes.
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
        precision = block_diag(found.precision, one.precision)
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
            taken = -size * f**2 * speed / wide_speed
            return {n: part * taken for n, part in _moved(plant, variable.name).items()}
        return {variable.name: size * f}

    begin = values.copy()
    if residual.passive:
        begin[: len(form.begin)] += ASIDE * form.linear * random.standard_normal(len(form.begin))
    precision = block_diag(form.precision, np.eye(leaky.size))
    return Attached(plant.with_terms(declare), names, values, begin, precision, memories)


def _moved(plant: Plant, velocity: str) -> dict[str, ca.SX]:
    """What a force along a velocity's coordinate adds to rates, in parts of that velocity's own:
    the joints of a limb push each other, and an acceleration of one alone could give energy.
    """
    joints = [f"{j.name}.velocity" for j in plant.joints] if isinstance(plant, Limb) else []
    if not isinstance(plant, Limb) or velocity not in joints:
        return {velocity: ca.SX(1)}
    wanted, still = ca.SX.sym("acceleration", len(joints)), [0.0] * len(plant.muscles)
    required = plant.anatomy("required")(plant.x, plant.u, plant.p, wanted, still)
    one = ca.SX.eye(len(joints))[:, joints.index(velocity)]
    column = ca.cse(ca.ldl_solve(one, *ca.ldl(ca.jacobian(required, wanted))))
    own = column[joints.index(velocity)]
    return {n: column[i] / own for i, n in enumerate(joints)}


def _size(values: Array, nominal: float) -> float:
    """Of what varies: its standard deviation over the training motions."""
    found = float(values.std())
    return found if found > LEAST * nominal else nominal

"""Functions whose weights are learned: a small network, a Gaussian process, splines.

Each is of scaled variables (mean 0, standard deviation 1 over the training motions), of size 1, and
stays bounded far from them: a model that was good without it cannot run away because of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import casadi as ca
import numpy as np
from scipy.cluster.vq import kmeans2

from ...core.errors import require_count, require_positive
from ..statistics import Array

__all__ = ["Form", "GaussianProcess", "Network", "Shape", "Splines"]


@dataclass(frozen=True, eq=False)
class Form:
    """A function of d scaled variables with n weights.

    value : (variables (d,), weights (n,)) -> scalar. begin : where a search begins, and from where
    weights are shrunk back to: a function that is zero. linear : which weights (n,) are zero there.
    precision : (n, n), positive definite; the penalty is (w - begin)' precision (w - begin).
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

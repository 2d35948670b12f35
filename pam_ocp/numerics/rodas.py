"""Rodas5P with steps of its own, as one CasADi function per step: for the simulation of plants.

G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the
Julia Differential Equations package, BIT Numerical Mathematics 63 (2023) 27: 8 stages, order 5,
L-stable, an embedded solution and a dense output of order 4. In the form of E. Hairer, G. Wanner,
Solving Ordinary Differential Equations II, 1996, IV.7, as in fmu/src/solver.c:

    (I/(h gamma) - J) k_i = f(t + alpha_i h, x + sum a_ij k_j) + sum c_ij/h k_j + h d_i df/dt

CasADi's own integrator of this kind reads two clocks around each evaluation of f, which takes as
long as some hundred operations; a step written out reads none, and knows no grid of output times.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from ..core.stop import check
from .solvers import Buffered

Array: TypeAlias = NDArray[np.float64]

GAMMA = 0.21193756319429014
ALPHA = (0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664)
"""1 for the last three stages."""
SLOPE = (
    0.21193756319429014,
    -0.42387512638858027,
    -0.3384627126235924,
    1.8046452872882734,
    2.325825639765069,
)
"""0 for the last three stages."""
A: tuple[tuple[float, ...], ...] = (
    (),
    (3.0,),
    (2.849394379747939, 0.45842242204463923),
    (-6.954028509809101, 2.489845061869568, -10.358996098473584),
    (2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641),
    (
        -7.502846399306121,
        2.561846144803919,
        -11.627539656261098,
        -0.18268767659942256,
        0.030198172008377946,
    ),
)
"""The last two stages: the sixth, and the solutions behind it added."""
C: tuple[tuple[float, ...], ...] = (
    (),
    (-14.155112264123755,),
    (-17.97296035885952, -2.859693295451294),
    (147.12150275711716, -1.41221402718213, 71.68940251302358),
    (165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306),
    (
        24.854864614690072,
        -3.0009227002832186,
        47.4931110020768,
        5.5814197821558125,
        -0.6610691825249471,
    ),
    (
        30.91273214028599,
        -3.1208243349937974,
        77.79954646070892,
        34.28646028294783,
        -19.097331116725623,
        -28.087943162872662,
    ),
    (
        37.80277123390563,
        -3.2571969029072276,
        112.26918849496327,
        66.9347231244047,
        -40.06618937091002,
        -54.66780262877968,
        -9.48861652309627,
    ),
)
DENSE: tuple[tuple[float, ...], ...] = (
    (
        25.948786856663858,
        -2.5579724845846235,
        10.433815404888879,
        -2.3679251022685204,
        0.524948541321073,
        1.1241088310450404,
        0.4272876194431874,
        -0.17202221070155493,
    ),
    (
        -9.91568850695171,
        -0.9689944594115154,
        3.0438037242978453,
        -24.495224566215796,
        20.176138334709044,
        15.98066361424651,
        -6.789040303419874,
        -6.710236069923372,
    ),
    (
        11.419903575922262,
        2.8879645146136994,
        72.92137995996029,
        80.12511834622643,
        -52.072871366152654,
        -59.78993625266729,
        -0.15582684282751913,
        4.883087185713722,
    ),
)
"""Within a step, s from 0 to 1: (1 - s) x + s (x_new + (1 - s) (b1 + s (b2 + s b3)))."""

WITHIN = 1 / 3
"""Where the dense output is asked how far it misses the equations, in steps with output times: over
long steps of stiff systems it is worse than their ends tell. No polynomial of low order that
vanishes at both ends is even there.
"""
LONGEST = 10_000
"""Operations of a step, beyond which it is not written out: clocks no longer count."""
SAFETY, SHRINK, GROW = 0.9, 0.1, 2.5
"""h_new = h SAFETY error^(-1/5), within these factors, as in fmu/src/solver.c."""
LEAST_ERROR = 1e-5
FIRST_CHANGE = 0.5
"""By which no state changes over the first step, in the units of the states."""
STRETCH, EVEN = 1.08, 4.0
CAUTION, BEHIND_REJECTED = 0.6, 0.1
SHORTEST = 1e-13
"""Step at which nothing more is tried, as a part of the span."""
LEAST = 1e-13
"""Tolerance below which rounding is all that an estimate tells: it is not for this method."""
ASKED = 256
"""After so many steps we look for signals and time limits."""


def written_out(ode: ca.Function) -> Rodas | None:
    """The method for x' = ode(t, x, c, p) of SX; None where a step would be long.

    c : what may change from piece to piece, such as coefficients of inputs. p : parameters.
    """
    if 9 * ode.n_instructions() > LONGEST:
        return None
    t, h = ca.SX.sym("t"), ca.SX.sym("h")
    x, c, p = (ca.SX.sym(n, ode.size1_in(i)) for n, i in (("x", 1), ("c", 2), ("p", 3)))
    slope = ode(t, x, c, p)
    jacobian, drift = ca.jacobian(slope, x), ca.densify(ca.jacobian(slope, t))
    solve = _eliminated(ca.SX.eye(x.numel()) / (h * GAMMA) - jacobian)
    k: list[ca.SX] = []
    stage = x
    for i in range(8):
        alpha = ALPHA[i] if i < len(ALPHA) else 1.0
        stage = x + _sum(A[i], k) if i < len(A) else stage + k[-1]
        right = (slope if i == 0 else ode(t + alpha * h, stage, c, p)) + _sum(C[i], k) / h
        right += h * SLOPE[i] * drift if i < len(SLOPE) else 0
        k.append(solve(right))
    rows = ca.horzcat(stage + k[-1], *(_sum(row, k) for row in DENSE))
    sizes = ca.vertcat(ca.fabs(rows[:, 0]), ca.fabs(k[-1]))
    error = _finite(ca.mmax(ca.fabs(k[-1])), sizes)
    step = ca.Function("step", [t, h, x, c, p], ca.cse([ca.densify(rows), error]))
    if step.n_instructions() > LONGEST:
        return None
    fastest = _finite(ca.mmax(ca.fabs(slope)), ca.fabs(slope))
    rate = ca.Function("rate", [t, h, x, c, p], [fastest])
    made = ca.SX.sym("made", x.numel(), 4)
    inside, speed = _inside(x, ca.horzsplit(made), WITHIN)
    wrong = ca.fabs(solve(ode(t + WITHIN * h, inside, c, p) - speed / h))
    error = _finite(ca.mmax(wrong), wrong)
    between = ca.Function("between", [t, h, x, c, p, made], ca.cse([error]))
    first = Buffered(step)
    known, results = first.arguments, first.results[0].T.ravel()  # a view of its memory
    return Rodas(first, Buffered(between, [*known, results]), Buffered(rate, known))


def _inside(x: Any, made: Any, s: Any) -> tuple[Any, Any]:
    """A place within a step, and its change with s."""
    new, b1, b2, b3 = made
    place = (1 - s) * x + s * (new + (1 - s) * (b1 + s * (b2 + s * b3)))
    change = new - x + (1 - 2 * s) * b1 + s * (2 - 3 * s) * b2 + s**2 * (3 - 4 * s) * b3
    return place, change


def _finite(value: ca.SX, sizes: ca.SX) -> ca.SX:
    """The value, infinite where one of the sizes is none: a maximum overlooks what is no number."""
    return ca.if_else(ca.sum1(sizes) < np.inf, value, np.inf)


def _sum(factors: tuple[float, ...], parts: list[ca.SX]) -> ca.SX:
    return sum((f * part for f, part in zip(factors, parts, strict=True)), ca.SX(0))


def _eliminated(matrix: ca.SX) -> Callable[[ca.SX], ca.SX]:
    """Right side -> solution, by Gauss without exchange of rows.

    For short steps the diagonal prevails; where it does not and a pivot is lost, so is the error
    estimate, and the step is taken again, shorter.
    """
    n = matrix.size1()
    m = [[matrix[i, j] for j in range(n)] for i in range(n)]
    inverse: list[ca.SX] = []
    for i in range(n):
        inverse.append(1 / m[i][i])
        for r in range(i + 1, n):
            if not m[r][i].is_zero():
                m[r][i] = m[r][i] * inverse[i]
                for j in range(i + 1, n):
                    if not m[i][j].is_zero():
                        m[r][j] = m[r][j] - m[r][i] * m[i][j]

    def solve(right: ca.SX) -> ca.SX:
        y = [right[i] for i in range(n)]
        for i in range(n):
            for j in range(i):
                if not m[i][j].is_zero():
                    y[i] = y[i] - m[i][j] * y[j]
        for i in reversed(range(n)):
            for j in range(i + 1, n):
                if not m[i][j].is_zero():
                    y[i] = y[i] - m[i][j] * y[j]
            y[i] = y[i] * inverse[i]
        return ca.vertcat(*y)

    return solve


@dataclass(frozen=True, eq=False)
class Rodas:
    """The method for one system.

    step : (t, h, x, c, p) -> (x_new and the dense output, largest error). between : the same and
    (x_new and dense output) -> largest error of the dense output. rate : as step -> how fast x
    changes. Both read where step reads, and between what it found.
    """

    step: Buffered
    between: Buffered
    rate: Buffered

    def __call__(
        self,
        grid: Array,
        breaks: Array,
        controls: Array,
        x0: Array,
        p: Array,
        tolerance: float,
        max_steps: int,
    ) -> Array | None:
        """States (n, nx) at the times of ``grid`` (n,), from x0 at its first; None where no step
        leads on, or more than ``max_steps`` are wanted for each interval of the grid.

        breaks : (m + 1,) of the grid, first and last among them. controls : (m, nc) between them.
        """
        self.step.arguments[2][:], self.step.arguments[4][:] = x0, p
        way = _Way(self, grid.tolist(), tolerance, max_steps * (len(grid) - 1))
        ends = breaks.tolist()
        for begin, end, own in zip(ends[:-1], ends[1:], controls, strict=True):
            if not way.over(begin, end, own):
                return None
        rows = np.frombuffer(b"".join(way.rows))
        return _between(grid, np.array([*way.begins, grid[-1]]), x0, rows)


class _Way:
    """The steps that were taken, and the length that is suggested for the next one.

    How lengths are chosen is told in fmu/src/solver.c.
    """

    def __init__(self, method: Rodas, grid: list[float], tolerance: float, budget: int) -> None:
        self.method, self.grid, self.tolerance, self.budget = method, grid, tolerance, budget
        self.place, self.tried, self.suggested = 1, 0, np.inf
        self.begins: list[float] = []
        self.rows: list[bytes] = []
        made, size = (m.T.ravel() for m in method.step.results)  # views of its memory
        self._views: list[Any] = [memoryview(a) for a in (*method.step.arguments[:3], made, size)]

    def over(self, t: float, end: float, control: Array) -> bool:
        """To the end of a piece; False where nothing leads there."""
        step, rate = self.method.step, self.method.rate
        step.arguments[0][0], step.arguments[3][:] = t, control
        rate.call()
        fastest = float(rate.results[0][0, 0])
        if not fastest < np.inf:
            return False
        self.suggested = min(self.suggested, end - t)
        if fastest * self.suggested > FIRST_CHANGE:
            self.suggested = FIRST_CHANGE / fastest
        return self._steps(t, end)

    def _steps(self, t: float, end: float) -> bool:
        call, tolerance = self.method.step.call, self.tolerance
        time, length, x, made, error_of = self._views
        new = made[: len(x)]
        between, wrong = self.method.between, self.method.between.results[0]
        grid, begun, row = self.grid, self.begins.append, self.rows.append
        suggested, shortest, allowed = self.suggested, SHORTEST * (end - t), 1.0
        while True:
            self.tried += 1
            if not self.tried % ASKED:
                check()
            if self.tried > self.budget or suggested < shortest:
                return False
            left = end - t
            last = left <= suggested * STRETCH
            h = left if last else suggested
            if not last and left < EVEN * STRETCH * suggested:
                h = left / -(-left // (suggested * STRETCH))
            time[0], length[0] = t, h
            call()
            error = error_of[0] / tolerance
            while grid[self.place] <= t:
                self.place += 1
            if error <= allowed and grid[self.place] < t + h:  # a time of the grid within the step
                between.call()
                error = max(error, float(wrong[0, 0]) / tolerance)
            if not error <= allowed:
                factor = max(SHRINK, SAFETY * error**-0.2) if error < np.inf else SHRINK
                suggested = h * min(factor, SAFETY) * (CAUTION if allowed == 1.0 else 1.0)
                allowed = BEHIND_REJECTED
                continue
            factor = min(GROW, SAFETY * error**-0.2) if error > LEAST_ERROR else GROW
            begun(t)
            row(made.tobytes())
            x[:] = new
            allowed = 1.0
            if not (h < suggested and factor >= 1.0) or factor * h > suggested:
                suggested = factor * h
            if last:
                self.suggested = suggested
                return True
            t += h


def _between(grid: Array, times: Array, x0: Array, rows: Array) -> Array:
    """States at the grid's times; steps lead from each of ``times`` (m + 1,) to the next, and
    ``rows`` (m 4 nx,) hold what they came to and their dense output.
    """
    rows = rows.reshape(len(times) - 1, 4, -1)
    before = np.concatenate([x0[None], rows[:-1, 0]])
    step = np.clip(np.searchsorted(times, grid, side="left") - 1, 0, len(rows) - 1)
    s = np.minimum((grid - times[step]) / (times[step + 1] - times[step]), 1.0)[:, None]
    states: Array = _inside(before[step], [rows[step, j] for j in range(4)], s)[0]
    return states

"""Answers of the peers, each verified by means of its own: SciPy, and equations.py.

Three tasks. *Planning*: PAM-2DIR (a). *Fitting*: the six coefficients of a force law to made-up
measurements of 60 or 10 000 cells, with intervals of 95 %. *Simulation*: a second of the slide of
PAM-2DIR, its commands given at 101 instants and joined by lines, at a tolerance of 1e-8.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any

import equations as e
import numpy as np
from numpy.polynomial import polynomial
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares
from scipy.stats import t as student

SCALE = np.array([0.03, 1.0, 6.0, 6.0])
"""Of deviations [m, m/s, bar, bar]."""
TRUTH = np.array([e.A1, e.A2, e.A3, e.A4, e.A5, e.A6])
NOISE = 5.0
"""Standard deviation of a measured force [N]."""
TAUT = 50.0
"""Cells pull with more than that, so that no tool leaves one out as slack [N]."""
TIGHT: dict[str, Any] = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-11}


Command = Callable[[float], Any]
"""Commanded pressures [bar] over time."""


def deviation(states: Any, start: Any, pieces: Iterable[tuple[float, float, Command]]) -> float:
    """Largest deviation of states from a tight integration, which begins anew at each piece of the
    commands: (begin, end, commands of time).
    """
    states, z, worst = np.array(states) / SCALE[:, None], np.array(start) / SCALE, 0.0
    for k, (begin, end, command) in enumerate(pieces, 1):

        def slope(t: float, y: Any, command: Command = command) -> Any:
            return np.array(e.slopes(*(y * SCALE), *command(t))) / SCALE

        z = solve_ivp(slope, (begin, end), z, **TIGHT).y[:, -1]
        worst = max(worst, float(np.max(np.abs(z - states[:, k]))))
    return worst


def plan_error(found: dict[str, Any]) -> float:
    """Largest deviation of a tight integration of the inputs from the motion found."""
    points, ends = np.array(found["points"]), found["duration"] * np.array(found["breaks"])

    def along(begin: float, end: float, values: Any) -> tuple[float, float, Command]:
        line = polynomial.polyfit(points, values.T, len(points) - 1)
        return begin, end, lambda t: polynomial.polyval((t - begin) / (end - begin), line)

    pieces = map(along, ends[:-1], ends[1:], np.array(found["inputs"]))
    return deviation(found["states"], np.array(found["states"])[:, 0], pieces)


def plan_miss(found: dict[str, Any]) -> float:
    """By how much a plan is one of another task: the largest excess over the ends and limits of
    PAM-2DIR at its mesh points and the points of its inputs, over SCALE, 100 N and e.RATE.
    """
    states, inputs = np.array(found["states"]), np.array(found["inputs"])
    (x, _, p1, p2), first, last = states, states[:, 0], states[:, -1]
    at_start = e.forces(first[0], *first[2:])
    ends = [(first[0] + e.STOP) / SCALE[0], first[1], (at_start[0] - at_start[1]) / 100]
    mirrored = np.array([-first[0], -first[1], first[3], first[2]])
    ends += list((last - mirrored) / SCALE)
    pressures = np.concatenate([p1, p2, inputs.ravel()])
    beyond = [(np.abs(x) - e.STROKE) / SCALE[0], -pressures / 6, (pressures - e.LARGEST) / 6]
    beyond += [-force / 100 for force in e.forces(x, p1, p2, exp=np.exp)]
    for point, beside in ((0.0, states[2:, :-1]), (1.0, states[2:, 1:])):
        at = np.isclose(found["points"], point)  # where states are told, too
        rates = (inputs[:, :, at] - beside.T[:, :, None]) / e.LAG
        beyond.append(np.abs(rates).ravel() / e.RATE - 1)
    beyond.append(np.array([0.02 - found["duration"], found["duration"] - 1.0]))
    worst = max(float(part.max(initial=0.0)) for part in beyond)
    return max(worst, float(np.max(np.abs(ends))))


class Measurements:
    """Cells of a force table, and the least sum of squares that the law leaves on them."""

    def __init__(self, count: int) -> None:
        random = np.random.default_rng(20)
        self.p, self.kappa = random.uniform(1, 6, 2 * count), random.uniform(0, 0.15, 2 * count)
        taut = np.flatnonzero(self.law(TRUTH) > TAUT)[:count]
        self.p, self.kappa = self.p[taut], self.kappa[taut]
        self.force = self.law(TRUTH) + random.normal(0, NOISE, count)
        self.least = self._squares(None, 0.0)

    def law(self, a: np.ndarray) -> np.ndarray:
        """The forces [N]; p in bar, contraction as a fraction."""
        bend = np.exp(a[2] * self.kappa)
        return (a[0] * self.p + a[1]) * bend + a[3] * self.kappa * self.p + a[4] * self.p + a[5]

    def write(self, path: Path) -> None:
        cells = {"p": self.p, "kappa": self.kappa, "force": self.force}
        path.write_text(json.dumps({n: v.tolist() for n, v in cells.items()}), "utf-8")

    def _squares(self, held: int | None, value: float) -> float:
        """Least sum of squares, one coefficient held; by SciPy, from the true coefficients."""
        free = [i for i in range(6) if i != held]

        def residuals(z: np.ndarray) -> np.ndarray:
            a = TRUTH.copy()
            a[free] = z * TRUTH[free]
            if held is not None:
                a[held] = value
            return self.law(a) - self.force

        tight = {"xtol": 1e-14, "ftol": 1e-14, "gtol": 1e-14}
        return 2 * float(least_squares(residuals, np.ones(len(free)), "3-point", **tight).cost)

    def excess(self, coefficients: list[float]) -> float:
        """How far the sum of squares lies above the least one, relative."""
        found = float(np.sum((self.law(np.array(coefficients)) - self.force) ** 2))
        return found / self.least - 1

    def ends(self, intervals: list[list[float]]) -> float:
        """How far the ends of the intervals are from 95 % of the profile likelihood, relative in
        standard errors: at an end, the squares that all others leave have grown by t^2 s^2.
        """
        free = len(self.force) - 6
        limit, worst = float(student.ppf(0.975, free)), 0.0
        for i, pair in enumerate(intervals):
            for end in pair:
                grown = max(0.0, (self._squares(i, end) / self.least - 1) * free)
                worst = max(worst, abs(grown**0.5 / limit - 1))
        return worst


def simulated_inputs() -> tuple[np.ndarray, np.ndarray]:
    """(times, commands in bar) of the simulation."""
    t = np.array(e.TIMES)
    return t, np.array([e.command(s) for s in t]).T


def simulation_error(found: dict[str, Any]) -> float:
    """Largest deviation from SciPy's DOP853 at 1e-11, which begins anew at each kink."""
    t, u = simulated_inputs()
    pieces = ((a, b, lambda s: [np.interp(s, t, row) for row in u]) for a, b in pairwise(t))
    return deviation(found["states"], e.REST, pieces)

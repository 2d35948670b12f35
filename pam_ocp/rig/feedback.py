"""Gains of a PID by what a rig itself has shown: its frequency response, and its error in a run.

Around a motion that is tracked, the error e answers to accelerations u asked for besides as M e'' +
D e' + K e = -u(t - T). The four are fitted to the response that is measured while the rig moves and
a sum of sines is asked for; the gains are those with the least error, with room to spare.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..control.pid import PID

Array: TypeAlias = NDArray[np.float64]
Response: TypeAlias = NDArray[np.complex128]

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

"""PAM-2DIR in plain CasADi, as a careful user writes it: scaled, Radau, mapped stages, IPOPT.

    python benchmarks/plain.py a|b [intervals]

The base of all ratios in run.py. It knows nothing of pam_ocp, and nothing is replayed. Case (a):
least time; (b): in 0.15 s with the least rate of the commands, which are states then.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from time import process_time

import casadi as ca
import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "peers"))
import equations as e

DEGREE = 3
NOMINAL = (0.01, 0.5, 1.0, 1.0)
HELD, WEIGHT, FASTEST = 0.15, 1e-2, 2000.0


class Plain:
    """One of the cases, stated; a call solves it from the usual guess or from a solution."""

    def __init__(self, case: str, intervals: int = e.INTERVALS) -> None:
        self.n, self.case = intervals, case
        size = np.array(NOMINAL if case == "a" else (*NOMINAL, 1.0, 1.0))
        self.nx = nx = len(size)
        stage = self._stage(size)
        n, width = intervals, nx * (DEGREE + 1) + 2
        w = ca.MX.sym("w", width, n)
        last, duration = ca.MX.sym("last", nx), ca.MX.sym("T")
        mass = ca.MX.sym("mass")
        t = duration if case == "a" else HELD
        defects, ends, path, cost = stage.map(n)(
            w[:nx, :],
            w[nx : nx * (DEGREE + 1), :],
            w[-2:, :],
            ca.repmat(t / n, 1, n),
            ca.repmat(mass, 1, n),
        )
        following = ca.horzcat(w[:nx, 1:], last)
        first = w[:nx, 0]
        f1, f2 = e.forces(*(first[i] * size[i] for i in (0, 2, 3)), exp=ca.exp)
        swap = [0, 1, 3, 2, 5, 4][:nx]
        mirror = np.array([-1, -1, 1, 1, 1, 1][:nx])
        closed = [last[i] - mirror[i] * first[swap[i]] for i in range(nx)]
        g = [
            ca.vec(defects),
            ca.vec(ends - following),
            *closed,
            first[0] * size[0] + e.STOP,
            first[1],
            (f1 - f2) / 100,
            ca.vec(path),
        ]
        equal = sum(part.numel() for part in g[:-1])
        count = equal + g[-1].numel()
        self.lbg = np.zeros(count)
        self.ubg = np.zeros(count)
        self.lbg[equal:] = np.tile([*[-1.0, -1.0, 0.0, 0.0] * DEGREE, -1.0, -1.0], n)
        self.ubg[equal:] = np.tile([*[1.0, 1.0, np.inf, np.inf] * DEGREE, 1.0, 1.0], n)
        objective = duration if case == "a" else WEIGHT * ca.sum2(cost)
        unknowns = ca.vertcat(ca.vec(w), last, duration)
        options = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes"}}
        nlp = {"x": unknowns, "p": mass, "f": objective, "g": ca.vertcat(*g)}
        self.solver = ca.nlpsol("plain", "ipopt", nlp, options)
        self.lbx, self.ubx, self.guess = self._bounds(size)

    def _stage(self, size: np.ndarray) -> ca.Function:
        nx = self.nx
        x, points, u = ca.MX.sym("x", nx), ca.MX.sym("k", nx * DEGREE), ca.MX.sym("u", 2)
        h, mass = ca.MX.sym("h"), ca.MX.sym("mass")
        z, v, m = ca.SX.sym("z", nx), ca.SX.sym("v", 2), ca.SX.sym("m")
        parts = ca.vertsplit(z * size)
        command = ca.vertsplit(v) if nx == 4 else parts[4:]
        slopes = list(e.slopes(*parts[:4], *command, exp=ca.exp))
        slopes[1] *= e.MASS / m
        if nx == 6:
            slopes += [v[0] * 100, v[1] * 100]  # unknowns in 100 bar/s
        rates = ca.vertcat(*slopes[2:4]) / e.RATE
        pulls = ca.vertcat(*e.forces(parts[0], parts[2], parts[3], exp=ca.exp)) / 100
        model = ca.Function("model", [z, v, m], [ca.vertcat(*slopes) / size, rates, pulls])
        c, d, _ = ca.collocation_coeff(ca.collocation_points(DEGREE, "radau"))
        whole = ca.horzcat(x, ca.reshape(points, nx, DEGREE))
        change = whole @ c
        defects, path = [], []
        for j in range(DEGREE):
            f, rate, pull = model(whole[:, j + 1], u, mass)
            defects.append(change[:, j] - h * f)
            path += [rate, pull]
        path.append(model(x, u, mass)[1])
        cost = h * ca.sumsqr(u * (100 if nx == 6 else 1))
        results = [ca.vertcat(*defects), whole @ d, ca.vertcat(*path), cost]
        return ca.Function("stage", [x, points, u, h, mass], results)

    def _bounds(self, size: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        high = np.array([e.STROKE, np.inf, e.LARGEST, e.LARGEST, e.LARGEST, e.LARGEST][: self.nx])
        low = np.array([-e.STROKE, -np.inf, 0, 0, 0, 0][: self.nx])
        low, high = low / size, high / size
        most = FASTEST / 100 if self.nx == 6 else e.LARGEST
        least = -most if self.nx == 6 else 0.0
        lows = [*np.tile(low, DEGREE + 1), least, least]
        highs = [*np.tile(high, DEGREE + 1), most, most]
        rows = []
        for k in range(self.n):
            for j in range(DEGREE + 1):
                place = -e.STOP + 2 * e.STOP * (k + j / DEGREE) / self.n
                rows += [place / size[0], 0.2 / size[1], *([3.0] * (self.nx - 2))]
            rows += [0.0, 0.0] if self.nx == 6 else [3.0, 3.0]
        end = [e.STOP / size[0], 0.2 / size[1], *([3.0] * (self.nx - 2))]
        lbx = np.concatenate([np.tile(lows, self.n), low, [0.02]])
        ubx = np.concatenate([np.tile(highs, self.n), high, [1.0]])
        return lbx, ubx, np.array([*rows, *end, e.GUESS])

    def __call__(self, mass: float = e.MASS) -> dict[str, float]:
        """Solve: objective, iterations, processor seconds."""
        begin = process_time()
        limits = {"lbx": self.lbx, "ubx": self.ubx, "lbg": self.lbg, "ubg": self.ubg}
        found = self.solver(x0=self.guess, p=mass, **limits)
        stats = self.solver.stats()
        assert stats["success"], stats["return_status"]
        return {
            "objective": float(found["f"]),
            "iterations": float(stats["iter_count"]),
            "seconds": process_time() - begin,
        }


def main() -> None:
    case = sys.argv[1]
    ready = process_time()
    found = Plain(case, *(int(a) for a in sys.argv[2:3]))()
    done = process_time()
    print(json.dumps({**found, "first": done - ready, "whole": done}))


if __name__ == "__main__":
    main()

"""How quick as_nlsys is against a plain NumPy right-hand side, both in input_output_response.

Run:  python benchmarks/nlsys.py

Both systems get the same inputs, solver, tolerances and output times, and give the same outputs. The
NumPy side is what an engineer would write by hand: one array operation serves both muscles, constants
are looked up beforehand, branches only where the model has them (the clamp at zero force, ISO 6358).
The figures are seconds of one run on one machine: only their ratio means something.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import control
import numpy as np
from numpy.typing import NDArray

import pam_ocp as pam
from pam_ocp.muscle.valves import SpoolValve
from pam_ocp.nlsys import as_nlsys

BAR = 1e5
Array: TypeAlias = NDArray[np.float64]
Derivative = Callable[[float, Array, Array, dict[str, Any]], Array]


class NumpySlide:
    """An antagonistic slide by hand: two six-parameter muscles, a mass, viscous damping."""

    def __init__(self, plant: pam.Plant) -> None:
        value = {v.name: v.start for v in plant.parameters}
        both = {n.removeprefix("muscle1.") for n in value if n.startswith("muscle1.")}
        self.c = {
            n: np.array([value[f"muscle1.{n}"], value[f"muscle2.{n}"]], dtype=float) for n in both
        }
        self.k0, self.m, self.d = value["pre_contraction"], value["mass"], value["damping"]
        self.sign = np.array([1.0, -1.0])

    def muscles(self, x: float, p: Array) -> tuple[Array, Array, Array]:
        """Contraction, force and stiffness of both muscles."""
        c = self.c
        kappa = self.k0 + self.sign * x / c["rest_length"]
        e = np.exp(c["a3"] * kappa)
        tension = (c["a1"] * p + c["a2"]) * e + c["a4"] * kappa * p + c["a5"] * p + c["a6"]
        slope = c["a3"] * (c["a1"] * p + c["a2"]) * e + c["a4"] * p
        w = c["slack_width"]
        if tension.min() >= w.max():  # taut: the usual case first
            return kappa, tension, -slope / c["rest_length"]
        s = (tension / w + 1) / 2
        blend = w * s**4 * (2 * s**2 - 6 * s + 5)
        force = np.where(tension >= w, tension, np.where(tension <= -w, 0.0, blend))
        gain = s**3 * (6 * s**2 - 15 * s + 10)
        gain = np.where(tension >= w, 1.0, np.where(tension <= -w, 0.0, gain))
        return kappa, force, -gain * slope / c["rest_length"]

    def pressure_rate(self, kappa: Array, v: float, p: Array, u: Array) -> Array:
        """First-order regulators."""
        return np.asarray((u - p) / self.c["lag"])

    def update(self, t: float, x: Array, u: Array, params: dict[str, Any]) -> Array:
        p = x[2:]
        kappa, force, _ = self.muscles(x[0], p)
        acceleration = (force[0] - force[1] - self.d * x[1]) / self.m
        return np.concatenate(([x[1], acceleration], self.pressure_rate(kappa, x[1], p, u)))

    def output(self, t: float, x: Array, u: Array, params: dict[str, Any]) -> Array:
        kappa, force, stiffness = self.muscles(x[0], x[2:])
        return np.concatenate((x, force, kappa, stiffness, [stiffness.sum()]))


class NumpyValves(NumpySlide):
    """The same slide fed through spool valves: gas of consistent volume, ISO 6358."""

    def __init__(self, plant: pam.Plant, overlap: float) -> None:
        super().__init__(plant)
        self.g = {n.removeprefix("gas."): v for n, v in self.c.items() if n.startswith("gas.")}
        self.half = overlap / 2
        radius = pam.muscle("DMSP-20-200N").diameter / 2
        self.v0 = np.pi * radius**2 * self.c["rest_length"]

    def clamp(self, z: Array) -> Array:
        w = self.half
        s = (z / w + 1) / 2
        return np.where(z >= w, z, np.where(z <= -w, 0.0, w * s**4 * (2 * s**2 - 6 * s + 5)))

    def flow(self, up: Array, down: Array, conductance: Array) -> Array:
        b = self.g["critical_ratio"]
        high, low = np.maximum(up, down), np.minimum(up, down)
        ratio = np.minimum(np.maximum(low / high, b), 0.999)
        subsonic = np.sqrt(1 - ((ratio - b) / (1 - b)) ** 2)
        driving = np.maximum(np.minimum((up - down) / (1 - 0.999), high), -high)
        cooling = np.sqrt(293.15 / self.g["temperature"])
        return np.asarray(driving * conductance * 1.185 * cooling * subsonic)

    def gas(self, kappa: Array, p: Array, u: Array) -> tuple[Array, Array, Array, Array]:
        """Volume, slope of volume, mass flow, supply flow."""
        g, c = self.g, self.c
        e = np.exp(c["a3"] * kappa)
        area = c["a1"] / c["a3"] * (e - 1) + c["a4"] * kappa**2 / 2 + c["a5"] * kappa
        volume = g["dead_volume"] + self.v0 + c["rest_length"] * area
        slope = c["rest_length"] * (c["a1"] * e + c["a4"] * kappa + c["a5"])
        inlet, outlet = (self.clamp(s * u - self.half) / (1 - self.half) for s in (1, -1))
        absolute, supply = p + g["ambient"], g["ambient"] + g["supply"]
        drawn = inlet * self.flow(supply, absolute, g["conductance"])
        vented = outlet * self.flow(absolute, g["ambient"], g["exhaust_conductance"])
        leaked = self.flow(absolute, g["ambient"], g["leak"])
        return volume, slope, drawn - vented - leaked, drawn

    def pressure_rate(self, kappa: Array, v: float, p: Array, u: Array) -> Array:
        g = self.g
        volume, slope, net, _ = self.gas(kappa, p, u)
        rate = slope * self.sign * v / self.c["rest_length"]
        absolute = p + g["ambient"]
        return np.asarray(
            g["exponent"] * (287.05 * g["temperature"] * net - absolute * rate) / volume
        )

    def output(self, t: float, x: Array, u: Array, params: dict[str, Any]) -> Array:
        kappa, force, stiffness = self.muscles(x[0], x[2:])
        volume, _, net, drawn = self.gas(kappa, x[2:], u)
        return np.concatenate((x, force, kappa, stiffness, [stiffness.sum()], volume, net, drawn))


@dataclass(frozen=True)
class Case:
    """A plant, the same by hand, and the outputs that both give."""

    label: str
    plant: pam.Plant
    by_hand: NumpySlide
    outputs: list[str]
    u: Array
    t: Array


def cases() -> list[Case]:
    muscle = pam.muscle("DMSP-20-200N")
    t = np.linspace(0.0, 1.0, 401)
    wave = np.vstack([np.sin(12 * t), -np.sin(12 * t)])

    def both(*names: str) -> list[str]:
        return [f"muscle{i}.{n}" for n in names for i in (1, 2)]

    outputs = ["x", "v", *both("pressure", "force", "contraction", "stiffness"), "stiffness"]
    regulated = pam.AntagonisticSlide(muscle, mass=2.0, stroke=0.016)
    overlap = 0.02
    valves = pam.AntagonisticSlide(muscle, mass=2.0, stroke=0.016, feed=SpoolValve(overlap=overlap))
    return [
        Case("regulators", regulated, NumpySlide(regulated), outputs, 3 * BAR + BAR * wave, t),
        Case(
            "spool valves", valves, NumpyValves(valves, overlap),
            outputs + both("volume", "mass_flow", "supply_flow"), 0.3 * wave, t,
        ),
    ]  # fmt: skip


def measure(
    case: Case, solver: str = "RK45", rtol: float = 1e-8, repeats: int = 5
) -> dict[str, float]:
    """Seconds of both (the best of ``repeats``) and their largest difference in units of nominal."""
    plant, start = case.plant, dict.fromkeys(("muscle1.pressure", "muscle2.pressure"), 3 * BAR)
    quick = as_nlsys(plant, start, outputs=case.outputs)
    plain = control.nlsys(
        case.by_hand.update, case.by_hand.output, states=quick.nstates, inputs=quick.ninputs,
        outputs=quick.noutputs,
    )  # fmt: skip
    atol = rtol * plant.vector("state", attribute="nominal")
    seconds = {"as_nlsys": np.inf, "NumPy": np.inf}
    values = {}
    for _ in range(repeats):  # by turns, so that other work on the machine meets both
        for label, system in (("as_nlsys", quick), ("NumPy", plain)):
            begin = time.perf_counter()
            response = control.input_output_response(
                system, case.t, case.u, quick.x0, solve_ivp_method=solver,
                solve_ivp_kwargs={"rtol": rtol, "atol": atol},
            )  # fmt: skip
            seconds[label] = min(seconds[label], time.perf_counter() - begin)
            values[label] = np.asarray(response.outputs)
    nominal = np.array([plant.variable(n).nominal for n in case.outputs])[:, None]
    return {
        **seconds,
        "ratio": seconds["NumPy"] / seconds["as_nlsys"],
        "difference": float(np.max(np.abs(values["as_nlsys"] - values["NumPy"]) / nominal)),
    }


def own_integrator(case: Case, repeats: int = 5) -> float:
    """Seconds of the same response by ``PlantSystem.response``, rtol 1e-10 (its first call builds)."""
    start = dict.fromkeys(("muscle1.pressure", "muscle2.pressure"), 3 * BAR)
    system = as_nlsys(case.plant, start, outputs=case.outputs)
    system.response(case.t, case.u)
    best = np.inf
    for _ in range(repeats):
        begin = time.perf_counter()
        system.response(case.t, case.u)
        best = min(best, time.perf_counter() - begin)
    return float(best)


def one_call(case: Case, calls: int = 5000) -> tuple[float, float]:
    """Microseconds of one right-hand side: as_nlsys, NumPy."""
    system = as_nlsys(case.plant, outputs=case.outputs)
    x, u = system.x0, system.u0
    found = []
    for function in (system._rhs, lambda t, x, u: case.by_hand.update(t, x, u, {})):
        begin = time.perf_counter()
        for _ in range(calls):
            function(0.0, x, u)
        found.append((time.perf_counter() - begin) / calls * 1e6)
    return found[0], found[1]


def main() -> None:
    print(f"{'case':<14}{'solver':<8}{'as_nlsys':>10}{'NumPy':>10}{'ratio':>7}{'difference':>12}")
    for case in cases():
        for solver in ("RK45", "LSODA"):
            r = measure(case, solver)
            print(
                f"{case.label:<14}{solver:<8}{r['as_nlsys']:>9.4f}s{r['NumPy']:>9.4f}s{r['ratio']:>7.1f}"
                f"{r['difference']:>12.1e}"
            )
        print(
            f"{case.label:<14}own     {own_integrator(case):>9.4f}s (PlantSystem.response, rtol 1e-10)"
        )
        quick, plain = one_call(case)
        print(f"{case.label:<14}one right-hand side: {quick:.2f} us, NumPy {plain:.2f} us")


if __name__ == "__main__":
    main()

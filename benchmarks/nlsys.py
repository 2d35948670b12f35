"""How quick as_nlsys is against a plain NumPy right-hand side given to python-control.

Run:  python benchmarks/nlsys.py

Four arrangements, each measured in one run with the same inputs, start, output times and outputs:

1. one right-hand side;
2. a whole ``control.input_output_response`` by the same solver at the same tolerances: there most
   of the time is Python's (SciPy's stepper, python-control's interpolation of the inputs), which
   both sides pay;
3. a whole response that agrees with ``pam_ocp.simulation.simulator`` to 1e-6 of nominal:
   ``PlantSystem.response`` against ``input_output_response`` of the NumPy system, with the loosest
   tolerance that suffices;
4. the same with inputs held over samples: ``input_output_response`` of ``as_nlsys(..., dt=)``
   against that of a discrete-time system whose update integrates the NumPy right-hand side by
   SciPy.

The NumPy side is what an engineer would write by hand: one array operation serves both muscles,
constants are looked up beforehand, branches only where the model has them (the clamp at zero force,
ISO 6358). The figures are seconds of one run on one machine: only their ratio means something.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import control
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.operating.nlsys import as_nlsys
from pam_ocp.plants.valves import SpoolValve

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
            "spool valves",
            valves,
            NumpyValves(valves, overlap),
            outputs + both("volume", "mass_flow", "supply_flow"),
            0.3 * wave,
            t,
        ),
    ]


def quickest(runs: dict[str, Callable[[], Any]], repeats: int = 5) -> tuple[dict[str, float], Any]:
    """Seconds of each (the best of ``repeats``), and what each returned.

    By turns, so that other work on the machine meets all of them.
    """
    seconds, results = dict.fromkeys(runs, np.inf), {}
    for _ in range(repeats):
        for label, run in runs.items():
            begin = time.perf_counter()
            results[label] = run()
            seconds[label] = min(seconds[label], time.perf_counter() - begin)
    return seconds, results


START = dict.fromkeys(("muscle1.pressure", "muscle2.pressure"), 3 * BAR)


def by_hand(case: Case, system: Any) -> Any:
    """The NumPy right-hand side as a system of python-control."""
    return control.nlsys(
        case.by_hand.update,
        case.by_hand.output,
        states=system.nstates,
        inputs=system.ninputs,
        outputs=system.noutputs,
    )


def solved(case: Case, system: Any, x0: Array, solver: str, rtol: float) -> Any:
    """``control.input_output_response`` with absolute tolerances of rtol times nominal."""
    atol = rtol * case.plant.vector("state", attribute="nominal")
    return control.input_output_response(
        system,
        case.t,
        case.u,
        x0,
        solve_ivp_method=solver,
        solve_ivp_kwargs={"rtol": rtol, "atol": atol},
    )


def apart(case: Case, one: Any, other: Any) -> float:
    """Largest difference of two responses' outputs in units of nominal."""
    nominal = np.array([case.plant.variable(n).nominal for n in case.outputs])[:, None]
    return float(np.max(np.abs(np.asarray(one.outputs) - np.asarray(other.outputs)) / nominal))


def same_solver(case: Case, solver: str = "RK45", rtol: float = 1e-8) -> dict[str, float]:
    """Seconds of both at the same solver and tolerances."""
    quick = as_nlsys(case.plant.in_commands(), START, outputs=case.outputs)
    plain = by_hand(case, quick)
    seconds, found = quickest(
        {
            "as_nlsys": lambda: solved(case, quick, quick.x0, solver, rtol),
            "NumPy": lambda: solved(case, plain, quick.x0, solver, rtol),
        }
    )
    return {
        **seconds,
        "ratio": seconds["NumPy"] / seconds["as_nlsys"],
        "difference": apart(case, found["as_nlsys"], found["NumPy"]),
    }


def same_accuracy(
    case: Case, solver: str = "RK45", limit: float = 1e-6, loosest: float = 1e-6, repeats: int = 5
) -> dict[str, float]:
    """Seconds of both, each within ``limit`` of simulate (which runs at rtol 1e-12 for this).

    loosest : the tolerance at which the search for the one that suffices to NumPy begins.
    """
    quick = as_nlsys(case.plant.in_commands(), START, outputs=case.outputs)
    plain = by_hand(case, quick)
    truth = quick.response(case.t, case.u, rtol=1e-12)
    rtol = loosest
    while apart(case, solved(case, plain, quick.x0, solver, rtol), truth) > limit:
        rtol /= 2
    seconds, found = quickest(
        {
            "as_nlsys": lambda: quick.response(case.t, case.u),
            "NumPy": lambda: solved(case, plain, quick.x0, solver, rtol),
        },
        repeats,
    )
    return {
        **seconds,
        "rtol": rtol,
        "ratio": seconds["NumPy"] / seconds["as_nlsys"],
        "difference": apart(case, found["as_nlsys"], truth),
    }


def sampled(
    case: Case, solver: str = "RK45", limit: float = 1e-6, loosest: float = 1e-6, repeats: int = 3
) -> dict[str, float]:
    """Seconds of both in discrete time, inputs held, each within ``limit`` of simulate."""
    dt = float(case.t[1] - case.t[0])
    quick = as_nlsys(case.plant.in_commands(), START, outputs=case.outputs, dt=dt)
    nominal = case.plant.vector("state", attribute="nominal")
    truth = quick.response(case.t, case.u, rtol=1e-12)

    def plain(rtol: float) -> Any:
        def update(t: float, x: Array, u: Array, params: dict[str, Any]) -> Array:
            motion = solve_ivp(
                lambda s, z: case.by_hand.update(s, z, u, params),
                (0.0, dt),
                x,
                method=solver,
                rtol=rtol,
                atol=rtol * nominal,
            )
            return np.asarray(motion.y[:, -1])

        return control.nlsys(
            update,
            case.by_hand.output,
            states=quick.nstates,
            inputs=quick.ninputs,
            outputs=quick.noutputs,
            dt=dt,
        )

    def run(system: Any) -> Any:
        return control.input_output_response(system, case.t, case.u, quick.x0)

    rtol = loosest
    while apart(case, run(plain(rtol)), truth) > limit:
        rtol /= 2
    system = plain(rtol)
    seconds, found = quickest(
        {"as_nlsys": lambda: run(quick), "NumPy": lambda: run(system)}, repeats
    )
    return {
        **seconds,
        "rtol": rtol,
        "ratio": seconds["NumPy"] / seconds["as_nlsys"],
        "difference": apart(case, found["as_nlsys"], truth),
    }


def one_call(case: Case, calls: int = 5000) -> tuple[float, float]:
    """Microseconds of one right-hand side: as_nlsys, NumPy."""
    system = as_nlsys(case.plant.in_commands(), outputs=case.outputs)
    x, u = system.x0, system.u0
    found = []
    for function in (system._rhs, lambda t, x, u: case.by_hand.update(t, x, u, {})):
        begin = time.perf_counter()
        for _ in range(calls):
            function(0.0, x, u)
        found.append((time.perf_counter() - begin) / calls * 1e6)
    return found[0], found[1]


def main() -> None:
    print(
        f"{'plant':<14}{'arrangement':<22}{'solver':<8}{'as_nlsys':>10}{'NumPy':>10}{'ratio':>7}"
        f"{'difference':>12}{'rtol':>9}"
    )
    for case in cases():
        quick, plain = one_call(case)
        print(
            f"{case.label:<14}{'one right-hand side':<30}{quick:>8.2f}us{plain:>8.2f}us"
            f"{plain / quick:>7.1f}"
        )
        for label, arrangement in (
            ("same solver", same_solver),
            ("to 1e-6 of simulate", same_accuracy),
            ("held, to 1e-6", sampled),
        ):
            for solver in ("RK45", "LSODA"):
                r = arrangement(case, solver)
                print(
                    f"{case.label:<14}{label:<22}{solver:<8}{r['as_nlsys']:>9.4f}s"
                    f"{r['NumPy']:>9.4f}s{r['ratio']:>7.1f}{r['difference']:>12.1e}"
                    f"{r.get('rtol', 1e-8):>9.0e}"
                )


if __name__ == "__main__":
    main()

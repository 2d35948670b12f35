"""What run.py measures: groups of figures, each run in a process of its own, again and again.

    python benchmarks/measured.py GROUP [--quick]

prints one group as JSON. A group is a function of ``quick`` (smaller sizes) that returns {figure:
number}. Seconds are those of the processor, unless a figure says "wall". A figure named NAME@SIZE
belongs to the curve NAME over sizes; page.py draws the curves and tells their slopes.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from time import thread_time
from typing import Any

from harness import process, repeated, timed, took
from pam_2dir import BAR, COMMANDS, STOPS, WISHES, plant, slide

HERE = Path(__file__).resolve().parent
GROUPS: dict[str, Callable[[bool], dict[str, float]]] = {}
PLAIN = 400
"""Intervals beyond which plain CasADi, no figure of ours, takes longer than all else here."""


def group(function: Callable[[bool], dict[str, float]]) -> Callable[[bool], dict[str, float]]:
    """A function that measures figures."""
    GROUPS[function.__name__] = function
    return function


# ---- starting -----------------------------------------------------------------------------------
PLANT = "import pam_ocp as pam; pam.HangingLoad('DMSP-20-400N')"


@group
def start(quick: bool) -> dict[str, float]:
    """Imports, the least of three each (the first reads from the disk); the tour, warm caches."""
    works = ("import casadi", "import pam_ocp", PLANT)
    casadi, ours, plant = (min(process("-c", w).processor for _ in range(3)) for w in works)
    found = {
        "import [s]": ours,
        "import beyond CasADi [s]": ours - casadi,
        "import and a plant beyond CasADi [s]": plant - casadi,
    }
    if not quick:
        with tempfile.TemporaryDirectory() as folder:
            tour = ("-m", "pam_ocp", "tour", "--out", folder)
            process(*tour)
            found["tour, warm caches [s]"] = process(*tour).processor
    return found


FIRST = """
import sys
from time import process_time
begin = process_time()
sys.path.insert(0, ".")
import pam_ocp as pam
import pam_2dir
plant = pam_2dir.plant({case!r})
ready = process_time()
wish = pam_2dir.WISHES[{case!r}]
plan = pam.plan(plant, pam_2dir.STOPS, method=pam.Collocation(50, 3), **wish)
assert plan.verified
print(process_time() - ready, plan.statistics["iterations"])
"""


@group
def first_plan(quick: bool) -> dict[str, float]:
    """PAM-2DIR as a whole process, and the first plan after import, to plain CasADi."""
    found: dict[str, float] = {}
    for case in "ab":
        plain, ours = process("plain.py", case), process("-c", FIRST.format(case=case))
        first = float(ours.result.split()[0]) / json.loads(plain.result)["first"]
        found[f"({case}) whole process / plain"] = ours.processor / plain.processor
        found[f"({case}) first plan / plain"] = first
        found[f"({case}) plain, whole [s]"] = plain.processor
    return found


# ---- planning -----------------------------------------------------------------------------------
@group
def again(quick: bool) -> dict[str, float]:
    """A planner's whole call from a neighbour's solution, to plain CasADi, cold."""
    import plain

    import pam_ocp as pam

    found = {}
    for case in "ab":
        bare = plain.Plain(case)
        bare()
        cold = median(bare()["seconds"] for _ in range(3))
        planner = pam.Planner(plant(case), STOPS, method=pam.Collocation(50, 3), **WISHES[case])
        near = planner()
        loads = iter([2.02, 2.2, 2.1, 1.9, 2.05, 1.95, 2.15, 2.08, 1.98])
        seconds = timed(lambda p=planner, n=near, m=loads: p({"mass": next(m)}, guess=n), 7)
        found[f"({case}) re-solve, whole call / plain cold"] = seconds / cold
    return found


@group
def accurate(quick: bool) -> dict[str, float]:
    """(a) to an error of 1e-6."""
    import pam_ocp as pam

    plant, found = slide(), {}
    for name, way in (("", {}), (" by arcs", {"method": pam.Arcs()})):
        ask: dict[str, Any] = {"cyclic": "mirrored", "tolerance": 1e-6, **way}
        seconds, _, plan = repeated(partial(pam.plan, plant, STOPS, **ask), 1)
        found[f"(a) to 1e-6{name} [s]"] = seconds
        found[f"(a) to 1e-6{name}, intervals"] = float(plan.statistics["intervals"])
        found[f"(a) to 1e-6{name}, error"] = plan.replay_error
    return found


# ---- control ------------------------------------------------------------------------------------
@group
def estimators(quick: bool) -> dict[str, float]:
    """A Kalman filter's step, and that of a moving horizon of 10 [ms]."""
    import pam_ocp as pam

    plant = slide()
    rest = plant.equilibrium(x=-0.01, stiffness=2e4)
    inputs = {n: rest[n] for n in COMMANDS}
    common = {"sample_time": 0.005, "measured": {"x": 1e-5}, "start": rest}
    found, moving = {}, pam.control.MovingHorizonEstimator
    for name, estimator in (
        ("Kalman filter", pam.KalmanFilter(plant, **common)),
        ("moving horizon", moving(plant, horizon=10, **common)),
        ("Kalman filter, compiled", pam.KalmanFilter(plant, compiled=True, **common)),
        ("moving horizon, compiled", moving(plant, horizon=10, compiled=True, **common)),
    ):
        seconds = []
        for k in range(120 if quick else 600):
            begin = thread_time()
            estimator.correct({"x": rest["x"] + 1e-5 * (k % 7 - 3)})
            estimator.predict(inputs)
            seconds.append(thread_time() - begin)
        found[f"{name} [ms]"] = 1e3 * median(seconds[20:])
    return found


# ---- fitting ------------------------------------------------------------------------------------
@group
def compare(quick: bool) -> dict[str, float]:
    """compare_laws, ten laws on 100 cells."""
    import numpy as np

    import pam_ocp as pam

    law = pam.muscle("DMSP-20-200N").force
    p, kappa = np.meshgrid(np.linspace(0.5, 6, 10) * BAR, np.linspace(0, 0.2, 10))
    force = np.asarray(law(p.ravel(), kappa.ravel())).ravel()
    force = force + np.random.default_rng(7).normal(0, 3.0, 100)
    table = pam.fitting.ForceTable(p.ravel(), kappa.ravel(), force, rest_length=0.3)
    fixed = {"radius": 0.010, "rest_diameter": 0.020, "max_contraction_ratio": 0.28}
    seconds, wall, made = took(lambda: pam.compare_laws(table, fixed=fixed, executor=0))
    return {
        "compare_laws, 100 cells [s]": seconds,
        "compare_laws, 100 cells, wall [s]": wall,
        "laws that were fitted": float(sum(entry.fit is not None for entry in made.laws)),
    }


# ---- simulating ---------------------------------------------------------------------------------
@group
def simulation(quick: bool) -> dict[str, float]:
    """One second of four states to 1e-8: ours, SciPy's and python-control's."""
    import control
    import numpy as np
    from scipy.integrate import solve_ivp

    import pam_ocp as pam

    plant = slide()
    names = [v.name for v in plant.inputs]
    t = np.linspace(0.0, 1.0, 101)
    wave = 3 * BAR + BAR * np.array([np.sin(7 * t), np.cos(9 * t)])
    inputs = dict(zip(names, wave, strict=True))
    common: dict[str, Any] = {"t": t, "rtol": 1e-8, "interpolation": "linear"}
    ours = timed(lambda: pam.simulate(plant, inputs, **common), 5)
    p, scale = plant.vector("parameter"), plant.vector("state", attribute="nominal")
    x0 = plant.vector("state") / scale

    def rates(_: float, z: Any, u: Any, parameters: Any = None) -> Any:
        return np.asarray(plant.function(z * scale, u, p)[0]).ravel() / scale

    def slope(time: float, z: Any) -> Any:
        return rates(time, z, [np.interp(time, t, row) for row in wave])

    def scipy(method: str) -> float:
        return timed(
            lambda: solve_ivp(slope, (0, 1), x0, method, t_eval=t, rtol=1e-8, atol=1e-8), 1
        )

    system = control.NonlinearIOSystem(rates, None, inputs=2, states=4, outputs=4)
    settings = {"solve_ivp_kwargs": {"rtol": 1e-8, "atol": 1e-8}, "solve_ivp_method": "LSODA"}
    machine = timed(lambda: pam.simulate(plant, inputs, compiled=True, **common), 20)
    found = {"simulate 1 s [s]": ours, "simulate 1 s, compiled [s]": machine}
    by_control = timed(lambda: control.input_output_response(system, t, wave, x0, **settings), 1)
    for name, seconds in (
        ("SciPy LSODA", scipy("LSODA")),
        ("SciPy Radau", scipy("Radau")),
        ("python-control", by_control),
    ):
        found[f"{name} / simulate"] = seconds / ours
        found[f"{name} / simulate, compiled"] = seconds / machine
    linear = partial(pam.simulate, plant, inputs, method="cvodes", **common)
    found["cvodes / simulate"] = timed(linear, 1) / ours
    waves = [lambda s: 3 * BAR + BAR * np.sin(7 * s), lambda s: 3 * BAR + BAR * np.cos(9 * s)]
    functions = dict(zip(names, waves, strict=True))
    common.pop("interpolation")
    timed_functions = timed(lambda: pam.simulate(plant, functions, **common), 1)
    found["simulate, functions of time [ms]"] = 1e3 * timed_functions
    return found


# ---- in proportion ------------------------------------------------------------------------------
@group
def records(quick: bool) -> dict[str, float]:
    """Long records: simulated, and fitted to; seconds, and the memory that it took [MB]."""
    import resource

    import numpy as np

    import pam_ocp as pam

    plant, random = slide(), np.random.default_rng(1)
    t = np.linspace(0.0, 1000.0, 100_001)
    wave = 3 * BAR + BAR * np.array([np.sin(7 * t), np.cos(9 * t)])
    inputs = dict(zip([v.name for v in plant.inputs], wave, strict=True))
    known = timed(lambda: pam.simulate(plant, inputs, t=t, compiled=True), 1)
    found = {"simulate 1000 s, 100 001 samples, compiled [s]": known}

    load = pam.HangingLoad("DMSP-20-400N", mass=20.0)
    levels = np.linspace(2, 6, 41) * BAR
    rests = np.array([load.equilibrium({"muscle.pressure": p})["x"] for p in levels])
    count = 100_000 if quick else 1_000_000
    at = random.integers(0, len(levels), count)
    held = {"muscle.pressure": levels[at], "x": rests[at] + random.normal(0, 1e-5, count)}
    fit_holds = took(lambda: pam.fitting.fit_holds(load, held, "mass"))
    found[f"fit_holds, {count} holds [s]"] = fit_holds.processor

    count = 10_000 if quick else 100_000
    t = np.arange(count) / 1000
    command = np.repeat(random.uniform(2, 5, count // 1000), 1000) * BAR
    motion = pam.simulate(load, {"muscle.command": command}, t=t, rtol=1e-6)
    names = ("x", "muscle.pressure", "muscle.command")
    record = pam.Trajectory(
        t,
        {n: motion[n] + (random.normal(0, 1e-5, count) if n == "x" else 0) for n in names},
        [load.variable(n) for n in names],
    )
    fit = {"horizon": 0.3, "every": 0.2, "outputs": ["x"], "judge": False}
    free_run = took(lambda: pam.fit_free_run(load, record, ["mass"], **fit))
    found[f"fit_free_run, {count} samples [s]"] = free_run.processor
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {**found, "long records, all of the process [MB]": most}


@group
def exported(quick: bool) -> dict[str, float]:
    """An Mpc of horizon 50 as an FMU, compiled anew, and as C in single precision."""
    import mpc

    import pam_ocp as pam

    controller = mpc.controller(slide(), 50, iterations=1)
    with tempfile.TemporaryDirectory() as folder:
        os.environ["PAM_OCP_CACHE"] = folder
        block = pam.control.block(controller)
        unit = took(lambda: pam.export_fmu(block, f"{folder}/mpc.fmu", platforms="native"))
        code = took(lambda: pam.export_c(block, f"{folder}/mpc", precision="single"))
    return {
        "Mpc 50 as FMU, compiled [s]": unit.processor,
        "Mpc 50 as C, single precision [s]": code.processor,
    }


@group
def long_works(quick: bool) -> dict[str, float]:
    """The documentation, with the examples that no build in this tree has run yet. Not in small
    sizes.
    """
    if quick:
        return {}
    with tempfile.TemporaryDirectory() as folder:
        site = ("-m", "sphinx", "-q", "-E", "-b", "html", str(HERE.parent / "docs"), folder)
        return {"documentation, built [s]": process(*site).processor}


@group
def ensemble(quick: bool) -> dict[str, float]:
    """The example of robust plans."""
    with tempfile.TemporaryDirectory() as folder:
        example = process(str(HERE.parent / "examples/robust_plan.py"), folder)
    return {"examples/robust_plan.py [s]": example.processor}


@group
def fmu_step(quick: bool) -> dict[str, float]:
    """A communication step of an FMU, in units of six right-hand sides and a Jacobian."""
    if quick:
        return {}
    import fmu_step as script

    return {f"FMU, {name} [units]": value for name, value in script.figures(quick).items()}


# ---- growth -------------------------------------------------------------------------------------
@group
def intervals(quick: bool) -> dict[str, float]:
    """Growth with the number of intervals, beside plain CasADi."""
    import plain

    import pam_ocp as pam

    plant, found = slide(), {}
    for n in (25, 50, 100) if quick else (25, 50, 100, 200, 400, 800):
        planner = pam.Planner(plant, STOPS, cyclic="mirrored", method=pam.Collocation(n, 3))
        seconds, _, plan = took(partial(planner, tolerance=None))
        found[f"plan [s]@{n}"] = seconds
        found[f"iterations@{n}"] = float(plan.statistics["iterations"])
        if n > PLAIN:
            continue
        bare = plain.Plain("a", n)()
        found[f"plan, plain CasADi [s]@{n}"] = bare["seconds"]
        found[f"iterations, plain CasADi@{n}"] = bare["iterations"]
    return found


@group
def mpc_step(quick: bool) -> dict[str, float]:
    """Mpc on the slide, and its growth with the horizon [ms]; worst steps out of 10 000."""
    import mpc
    import numpy as np

    plant, found = slide(), {}
    for horizon in (10, 50) if quick else (10, 25, 50, 100, 200):
        for how, compiled in (("Mpc", False), ("Mpc compiled", True)):
            for name, iterations in (("one iteration", 1), ("converged", 30)):
                steps = 200 if horizon != 50 or quick else 10_000 if compiled else 1000
                options = {"iterations": iterations, "compiled": compiled}
                _, seconds = mpc.run(plant, horizon, False, steps, **options)
                middle = 1e3 * float(np.median(seconds))
                found[f"{how}, {name} [ms]@{horizon}"] = middle
                if horizon == 50:
                    found[f"{how} 50, {name} [ms]"] = middle
                    worst = 1e3 * float(seconds.max()) / middle
                    found[f"{how} 50, {name}, worst / median"] = worst
    return found


@group
def fit_cells(quick: bool) -> dict[str, float]:
    """fit_force with intervals, and SciPy's Levenberg-Marquardt, over the number of cells."""
    import numpy as np
    from scipy.optimize import curve_fit

    import pam_ocp as pam

    law, found = pam.muscle("DMSP-20-200N").force, {}
    random = np.random.default_rng(20)

    def formula(at: Any, a1: float, a2: float, a3: float, a4: float, a5: float, a6: float) -> Any:
        p, kappa = at
        return (a1 * p + a2) * np.exp(a3 * kappa) + a4 * kappa * p + a5 * p + a6

    def fitted(table: pam.fitting.ForceTable) -> Any:
        return pam.fit_force(table).intervals()

    begin = list(law.published) if hasattr(law, "published") else [-4.0, 292, -33, -934, 294, -280]
    for count in (60, 1000) if quick else (60, 300, 1000, 10_000, 50_000):
        p, kappa = random.uniform(0.5, 6, count) * BAR, random.uniform(0, 0.2, count)
        force = np.asarray(law(p, kappa)).ravel() + random.normal(0, 5.0, count)
        table = pam.fitting.ForceTable(p, kappa, force, rest_length=0.3).taut
        found[f"fit_force with intervals [s]@{count}"] = timed(partial(fitted, table), 1)
        at = np.array([table.pressure / BAR, table.contraction])
        begin[2] = -20.0
        lm = partial(curve_fit, formula, at, table.force, begin, maxfev=20000)
        found[f"SciPy LM [s]@{count}"] = timed(lm, 1)
    return found


def chain(count: int, pushed: int = 1) -> Any:
    """Masses in a row between springs and dampers, 2 count states; so many of them are pushed."""
    import pam_ocp as pam

    plant = pam.Plant("chain", "masses between springs")
    q = [plant.state(f"q{i}", nominal=0.01) for i in range(count)]
    v = [plant.state(f"v{i}", nominal=0.1) for i in range(count)]
    push = [plant.input(f"push{i}", start=1.0, min=-20.0, max=20.0) for i in range(pushed)]
    for i in range(count):
        left = q[i - 1] if i else 0
        right = q[i + 1] if i + 1 < count else 0
        force = 400 * (left - 2 * q[i] + right) - 3 * v[i] - 1e4 * q[i] ** 3
        plant.der(q[i], v[i])
        plant.der(v[i], force + (push[i] if i < pushed else 0))
    return plant


@group
def states(quick: bool) -> dict[str, float]:
    """A simulation, and a plan (quickest from rest to rest, each mass pushed), over the states."""
    import numpy as np

    import pam_ocp as pam

    found, t = {}, np.linspace(0.0, 1.0, 101)
    push, common = {"push0": np.sin(20 * t)}, {"t": t, "rtol": 1e-8}
    for count in (2, 8) if quick else (2, 4, 8, 12, 18):
        plant, many = chain(count), 2 * count
        run = partial(pam.simulate, plant, push, **common)
        found[f"simulate [s]@{many}"] = timed(run, 3)
        found[f"simulate, compiled [s]@{many}"] = timed(partial(run, compiled=True), 9)
        stops = [{f"q{i}": place for i in range(count)} for place in (0.0, 0.01)]
        planner = pam.Planner(chain(count, count), stops, method=pam.Collocation(30, 3))
        seconds, _, plan = repeated(partial(planner, tolerance=None), 1)
        found[f"plan, masses in a row [s]@{many}"] = seconds
        found[f"iterations, masses in a row@{many}"] = float(plan.statistics["iterations"])
    return found


@group
def cases(quick: bool) -> dict[str, float]:
    """What the loop over cases adds to a plain loop, and what two processes gain (wall)."""
    import many

    return many.figures(quick)


def main() -> None:
    name, *options = sys.argv[1:]
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    print("FIGURES " + json.dumps(GROUPS[name]("--quick" in options)))


if __name__ == "__main__":
    main()

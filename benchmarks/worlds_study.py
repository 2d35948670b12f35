"""Random plants in every world, against pam.simulate.

    python benchmarks/worlds_study.py [40] [--seed N] [--minutes M] [--worlds jax onnx ...]

Each plant is drawn from everything that there is (``random_tasks.py``) and moves for 1 s, its
inputs held for 0.2 s each. JAX integrates by itself (``simulate``); the slopes of ONNX, PyTorch and
the Modelica source, which a reader of this file's own takes in, are integrated by SciPy's LSODA.
What single precision adds to the slopes acts on those of CasADi; plants that amplify any rounding
of their states are counted apart.
MuJoCo has masses of its own: there a muscle with a feed and losses, drawn alike, lifts a weight.
Errors are the largest over states and times, scaled by nominal values; slopes backwards (JAX,
PyTorch) stand against central differences of CasADi's function, away from kinks. What a world
refuses is counted by its sentence.
"""

from __future__ import annotations

import math
import re
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import casadi as ca
import harness
import numpy as np
import random_tasks
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.export.worlds.modelica import RESERVED, identifiers

TIMES = np.linspace(0.0, 1.0, 6)
LIMITS = {"jax": 1e-6, "torch": 1e-6, "onnx": 1e-6, "onnx single": 1e-4, "modelica": 1e-6}
LIMITS |= {"mujoco": 1e-3, "gradients of jax": 1e-5, "gradients of torch": 1e-5}
NEEDS = {"jax": "jax", "torch": "torch", "onnx": "onnxruntime", "mujoco": "mujoco"}
MUJOCO_STEP = 2.5e-5
SLACK_STEP = 1e-2
"""How far from a point of the motion slopes are compared, scaled by nominal values."""
HOLD = 1e-3
"""[s], for which what rounding adds to slopes is held: longer than it lasts, so that it moves
plants more than it would; a tenth of it where that is too much.
"""
LONGEST = 300
"""For a plant in one world [s]; what takes longer is counted apart."""
NOT_SIMULATED: Counter[str] = Counter()
"""Draws that have no start or that ``pam.simulate`` refuses, by kind of error."""
Slope = Callable[[Any, Any], Any]


@dataclass(frozen=True)
class Drawn:
    """A plant, its inputs (6, nu), and how ``pam.simulate`` says that it moves (6, nx)."""

    words: str
    plant: pam.Plant
    inputs: np.ndarray
    truth: np.ndarray

    @property
    def nominal(self) -> np.ndarray:
        return self.plant.vector("state", attribute="nominal")


class Amplified(Exception):
    """The plant makes much of any rounding of its states."""


def deviation(found: np.ndarray, made: Drawn) -> float:
    return float(np.max(np.abs(found - made.truth) / made.nominal))


def simulated(words: str, plant: pam.Plant, inputs: np.ndarray) -> Drawn:
    moves = {v.name: inputs[:, i] for i, v in enumerate(plant.inputs)}
    run = pam.simulate(plant, moves, t=TIMES)
    return Drawn(words, plant, inputs, np.column_stack([run[v.name] for v in plant.states]))


def ranges(plant: pam.Plant) -> tuple[np.ndarray, np.ndarray]:
    low, high = (plant.vector("input", attribute=a) for a in ("min", "max"))
    return np.where(np.isfinite(low), low, -1), np.where(np.isfinite(high), high, 1)


def any_plant(rng: np.random.Generator) -> Drawn:
    """Of any maker, from its start values, inputs in the middle of their ranges."""
    while True:
        try:
            made = random_tasks.chosen(rng, random_tasks.MAKERS)(rng)
            low, high = ranges(made.plant)
            u = low + (high - low) * rng.uniform(0.3, 0.7, (len(TIMES), len(low)))
            return simulated(made.words, made.plant, u)
        except (random_tasks.Infeasible, pam.PamError) as refusal:
            NOT_SIMULATED[type(refusal).__name__] += 1


# ---- worlds --------------------------------------------------------------------------------------
def integrated(slope: Slope, made: Drawn) -> np.ndarray:
    """States at the times, by LSODA, so tight that its own errors do not count: along play and
    Bouc and Wen's elements 1e-10 left 2e-6.
    """
    z, rows, nominal = made.truth[0] / made.nominal, [made.truth[0]], made.nominal
    for k, end in enumerate(TIMES[1:]):

        def scaled(_: float, z: np.ndarray, k: int = k) -> np.ndarray:
            return np.asarray(slope(z * nominal, made.inputs[k]), float) / nominal

        run = solve_ivp(scaled, (TIMES[k], end), z, method="LSODA", rtol=1e-12, atol=1e-12)
        if not run.success:
            raise RuntimeError(run.message)
        z = run.y[:, -1]
        rows.append(z * nominal)
    return np.array(rows)


def off_course(added: Slope, made: Drawn, hold: float) -> np.ndarray:
    """States at the times where ``added`` comes to CasADi's slopes, held for so long [s] each.

    No integrator takes slopes that rounding makes ragged: with a tolerance of 1e-8 LSODA is off by
    1.6e-4 in double precision already along a tube, with 1e-10 its steps end in the noise.
    """
    plant, nominal = made.plant, made.nominal
    z, more = (ca.SX.sym(name, len(nominal)) for name in ("z", "more"))
    u = ca.SX.sym("u", len(plant.inputs))
    slope = plant.function(nominal * z, u, plant.vector("parameter"))[0] / nominal + more
    system = {"x": z, "p": ca.vertcat(u, more), "ode": slope}
    options = {"abstol": 1e-12, "reltol": 1e-12, "max_num_steps": 1_000_000}
    step = ca.integrator("step", "cvodes", system, 0.0, hold, options)
    x, rows = made.truth[0] / nominal, [made.truth[0]]
    for k in range(len(TIMES) - 1):
        for _ in range(round((TIMES[1] - TIMES[0]) / hold)):
            given = np.concatenate([made.inputs[k], added(x * nominal, made.inputs[k]) / nominal])
            x = np.ravel(step(x0=x, p=given)["xf"])
        rows.append(x * nominal)
    return np.array(rows)


def in_jax(made: Drawn, folder: Path) -> np.ndarray:
    import jax

    with jax.enable_x64(True):
        return np.array(pam.export.to_jax(made.plant).simulate(TIMES, made.inputs))


def in_torch(made: Drawn, folder: Path) -> np.ndarray:
    import torch

    module = pam.export.to_torch(made.plant)
    return integrated(
        lambda x, u: module.f(0.0, torch.tensor(x), torch.tensor(u)).detach().numpy(), made
    )


def onnx_slope(plant: pam.Plant, folder: Path, precision: str) -> Slope:
    import onnxruntime

    path = pam.export.to_onnx(plant, folder / "plant.onnx", precision=precision)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options)
    kind = np.float64 if precision == "double" else np.float32
    known = {i.name for i in session.get_inputs()}
    p = plant.vector("parameter")[None].astype(kind)

    def slope(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        given = {"x": x[None].astype(kind), "u": u[None].astype(kind), "p": p}
        return session.run(["xdot"], {n: given[n] for n in known})[0][0].astype(float)

    return slope


def in_single(made: Drawn, folder: Path) -> np.ndarray:
    """Raises Amplified where rounding the states alone has half of the effect."""
    single, p = onnx_slope(made.plant, folder, "single"), made.plant.vector("parameter")

    def exact(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.ravel(made.plant.function(x, u, p)[0])

    for hold in (HOLD, HOLD / 10):
        found = off_course(lambda x, u: single(x, u) - exact(x, u), made, hold)
        if (far := deviation(found, made)) <= LIMITS["onnx single"]:
            return found
    rounded = off_course(lambda x, u: exact(x.astype(np.float32), u) - exact(x, u), made, hold)
    if (alone := deviation(rounded, made)) > far / 2:
        raise Amplified(f"{far:.1e}; {alone:.1e} by the states' rounding alone")
    return found


def modelica_slope(plant: pam.Plant, folder: Path) -> Slope:
    """The equations of the source as a Python function of (x, u)."""
    text = pam.export.export_modelica(plant, folder / "plant.mo").read_text("utf-8")
    equations = text.split("\nequation\n")[1].rsplit("\nend ", 1)[0]
    # both branches of a condition are computed only where they are asked for, as in Modelica
    branch = ", lambda: "
    pairs = (("noEvent(if ", "where("), (" then ", branch), (" else ", branch), ("^", "**"))
    for modelica, python in pairs:
        equations = equations.replace(modelica, python)
    equations = re.sub(r"der\((\w+)\) =", r"der_\1 =", equations)
    names = identifiers([v.name for v in plant.variables], RESERVED)
    lines = [re.sub(r";$", "", line.strip()) for line in equations.splitlines()]
    slopes = [f"der_{names[v.name]}" for v in plant.states]
    known = {n: getattr(math, n) for n in ("exp", "log", "sqrt", "sin", "cos", "tan", "asin")}
    known |= {n: getattr(math, n) for n in ("acos", "atan", "atan2", "sinh", "cosh", "tanh")}
    known |= {"abs": abs, "min": min, "max": max, "floor": math.floor, "ceil": math.ceil}
    known |= {"sign": lambda a: (a > 0) - (a < 0)}
    known |= {"where": lambda test, then, other: then() if test else other()}
    values = re.findall(r"^\s*parameter Real (\w+)\(.*?\) = ([^\s;]+)", text, re.M)
    known |= {name: float(value) for name, value in values}
    x, u = ([names[v.name] for v in group] for group in (plant.states, plant.inputs))
    body = "\n".join(f"    {line}" for line in lines)
    taken = "".join(f"    {', '.join(g)}, = {n}\n" for n, g in (("x_", x), ("u_", u)) if g)
    exec(f"def slope_(x_, u_):\n{taken}{body}\n    return [{', '.join(slopes)}]\n", known)
    return lambda x_, u_: known["slope_"](x_.tolist(), u_.tolist())


# ---- MuJoCo --------------------------------------------------------------------------------------
WORLD = """<mujoco><option timestep="{step}" integrator="RK4" gravity="0 0 -{gravity}"/><worldbody>
<body><joint name="x" type="slide" axis="0 0 1" damping="20"/>
<geom type="sphere" size=".05" mass="{mass}"/></body></worldbody>{muscles}</mujoco>"""


def lifted(rng: np.random.Generator) -> tuple[Drawn, Any, float]:
    """A weight on any muscle with any feed and losses, its MuJoCo muscle, and its mass."""
    while True:
        muscle = random_tasks.any_muscle(rng)
        top = random_tasks.top_of(rng, muscle)
        size, length = random_tasks.sized(muscle, top), float(muscle.rest_length)
        feed, feed_words = random_tasks.feed(rng, muscle, top)
        losses, _, loss_words = random_tasks.losses(rng, top, size)
        mass = size / random_tasks.GRAVITY * rng.uniform(0.08, 0.5)
        start = 0.4 * float(muscle.contraction_range[1]) * length
        try:
            plant = pam.HangingLoad(muscle, mass, feed=feed, losses=losses, damping=20.0)
            plant = plant.with_values(plant.equilibrium({"x": start}))
            low, high = ranges(plant)
            u = plant.vector("input") + 0.1 * (high - low) * rng.uniform(-1, 1, len(low))
            u = np.tile(np.clip(u, low, high), (len(TIMES), 1))
            words = random_tasks.told(muscle.name, f"{mass:.1f} kg", feed_words, loss_words)
            made = simulated(words, plant, u)
        except pam.PamError:
            continue
        one = pam.export.MujocoMuscle("muscle", muscle, {"x": -1.0}, feed, losses, offset=length)
        return made, one, mass


def in_mujoco(made: Drawn, one: Any, mass: float) -> np.ndarray:
    """Rows of x and v."""
    import mujoco

    muscles = pam.export.to_mujoco([one])
    scene = {"step": MUJOCO_STEP, "gravity": random_tasks.GRAVITY, "mass": mass}
    model = mujoco.MjModel.from_xml_string(WORLD.format(muscles=muscles.mjcf(), **scene))
    data = mujoco.MjData(model)
    given = (made.truth[0], made.inputs[0])
    groups = zip((made.plant.states, made.plant.inputs), given, strict=True)
    values = {v.name: x for group, row in groups for v, x in zip(group, row, strict=True)}
    known = {v.name for v in (*one.plant.states, *one.plant.inputs)}
    muscles.reset(model, data, {n: x for n, x in values.items() if n in known})
    data.qpos[0], data.qvel[0] = values["x"], values["v"]
    rows = [[data.qpos[0], data.qvel[0]]]
    with muscles.installed(model):
        for _ in TIMES[1:]:
            mujoco.mj_step(model, data, round((TIMES[1] - TIMES[0]) / MUJOCO_STEP))
            rows.append([data.qpos[0], data.qvel[0]])
    return np.array(rows)


# ---- gradients -----------------------------------------------------------------------------------
def gradient_error(made: Drawn, world: str, rng: np.random.Generator) -> float:
    """The largest error of the gradient of a weighted sum of slopes, scaled by its largest entry.

    NaN where differences of two widths say that every point drawn lies at a kink.
    """
    plant = made.plant
    groups = [plant.states, plant.inputs, plant.parameters]
    p = plant.vector("parameter")
    scale = np.concatenate([[v.nominal for v in g] for g in groups[:2]] + [np.abs(p)])
    ends = np.cumsum([len(g) for g in groups])[:-1]
    worst = math.nan
    for k in range(1, len(TIMES)):
        off = SLACK_STEP * made.nominal * rng.uniform(-1, 1, len(made.nominal))
        at = np.concatenate([made.truth[k] + off, made.inputs[k], p])
        weights = rng.uniform(0.5, 1.0, len(off)) / made.nominal
        wide, narrow = (
            differences(plant, at, ends, weights, h * scale) * scale for h in (2e-4, 1e-4)
        )
        size = np.max(np.abs(narrow))
        if not np.max(np.abs(wide - narrow)) < 1e-6 * size:
            continue
        found = backwards(plant, world, at, ends, weights) * scale
        worst = np.fmax(worst, np.max(np.abs(found - narrow)) / size)
    return float(worst)


def differences(
    plant: pam.Plant, at: np.ndarray, ends: np.ndarray, weights: np.ndarray, step: np.ndarray
) -> np.ndarray:
    """Central, of order 4."""
    columns = np.tile(at[:, None], (1, 4 * len(at)))
    factors = np.array([-2, -1, 1, 2])
    for j, h in enumerate(step):
        columns[j, 4 * j : 4 * j + 4] += factors * h
    slopes = np.array(plant.function(*np.split(columns, ends))[0])
    values = (weights @ slopes).reshape(-1, 4)
    with np.errstate(invalid="ignore", divide="ignore"):
        found = values @ np.array([1, -8, 8, -1]) / (12 * step)
    return np.where(step > 0, found, 0.0)


def backwards(
    plant: pam.Plant, world: str, at: np.ndarray, ends: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """The gradient by the world's own derivatives."""
    if world == "torch":
        import torch

        module = pam.export.to_torch(plant)
        parts = [torch.tensor(a, requires_grad=True) for a in np.split(at, ends)]
        torch.sum(torch.tensor(weights) * module.f(0.0, *parts)).backward()
        # PyTorch has no gradient, rather than zeros, by what slopes do not depend on
        grads = [torch.zeros_like(a) if a.grad is None else a.grad for a in parts]
        return np.concatenate([a.numpy() for a in grads])
    import jax

    with jax.enable_x64(True):
        made = pam.export.to_jax(plant)
        parts = [jax.numpy.asarray(a) for a in np.split(at, ends)]
        slope = jax.grad(lambda q: jax.numpy.dot(weights, made.f(0.0, *q)))
        return np.concatenate([np.asarray(g) for g in slope(parts)])


# ---- the study -----------------------------------------------------------------------------------
WORLDS: dict[str, Callable[[Drawn, Path], np.ndarray]] = {
    "jax": in_jax,
    "torch": in_torch,
    "onnx": lambda made, folder: integrated(onnx_slope(made.plant, folder, "double"), made),
    "onnx single": in_single,
    "modelica": lambda made, folder: integrated(modelica_slope(made.plant, folder), made),
}


def compared(computed: Callable[[], float], limit: float) -> harness.Row:
    """The error of a plant in a world, or why there is none."""
    signal.alarm(LONGEST)
    try:
        error = computed()
    except TimeoutError:
        return {"outcome": "too slow"}
    except Amplified as said:
        return {"outcome": "amplified", "why": str(said)}
    except pam.PamError as refusal:
        return {"outcome": "refused", "why": re.sub(r"'[^']*'|\d[\d.e+-]*", "_", str(refusal))}
    except Exception as failure:
        return {"outcome": "failed", "why": f"{type(failure).__name__}: {failure}"}
    finally:
        signal.alarm(0)
    return {"outcome": "compared" if error <= limit else "above", "error": error}


def comparisons(
    number: int, seed: int, worlds: list[str]
) -> Iterator[tuple[str, str, Callable[[], float]]]:
    """(world, words of the plant, what computes the error) of one plant."""
    rng = np.random.default_rng([seed, number])
    made = any_plant(rng)

    def far(world: str) -> float:
        with tempfile.TemporaryDirectory() as folder:
            return deviation(WORLDS[world](made, Path(folder)), made)

    for world in WORLDS:
        if world in worlds:
            yield world, made.words, partial(far, world)
    for world in ("jax", "torch"):
        if f"gradients of {world}" in worlds:
            yield f"gradients of {world}", made.words, partial(gradient_error, made, world, rng)
    if "mujoco" not in worlds:
        return
    weight, one, mass = lifted(rng)
    first = [[v.name for v in weight.plant.states].index(n) for n in ("x", "v")]

    def off() -> float:
        wrong = np.abs(in_mujoco(weight, one, mass) - weight.truth[:, first])
        return float(np.max(wrong / weight.nominal[first]))

    yield "mujoco", weight.words, off


def one(number: int, seed: int, worlds: list[str]) -> harness.Row:
    """A plant through the worlds."""
    found, why, draws = {}, [], NOT_SIMULATED.copy()
    for world, words, computed in comparisons(number, seed, worlds):
        row = found[world] = compared(computed, LIMITS[world])
        if row["outcome"] != "compared":
            why.append(f"{world}: {row['outcome']} {row.get('why', row.get('error'))}: {words}")
    text = ", ".join(f"{w} {r['error']:.1e}" for w, r in found.items() if "error" in r)
    return {"text": text, "why": why, "worlds": found, "again": dict(NOT_SIMULATED - draws)}


def _over(signum: int, frame: Any) -> None:
    raise TimeoutError


def cases(given: harness.Given) -> harness.Keyed:
    absent = {w for w in given.worlds for n, m in NEEDS.items() if n in w and not find_spec(m)}
    print(f"not installed: {', '.join(sorted(absent)) or 'none'}")
    signal.signal(signal.SIGALRM, _over)
    begin = time.monotonic()
    for number in harness.numbers(given):
        if time.monotonic() - begin > 60 * given.minutes:
            return
        yield number, partial(one, number, given.seed, [w for w in given.worlds if w not in absent])


WAYS = ("amplified", "refused", "too slow")


def summary(rows: list[harness.Row]) -> str:
    plants = [r for r in rows if "worlds" in r]
    lines, refused = [], Counter[str]()
    for world, limit in LIMITS.items():
        found = [r["worlds"][world] for r in plants if world in r["worlds"]]
        errors = [f["error"] for f in found if not math.isnan(f.get("error", math.nan))]
        ways = Counter(f["outcome"] for f in found)
        bad = [ways["above"] + ways["failed"], *(ways[w] for w in WAYS)]
        if found:
            lines.append([world, len(errors), max(errors, default=math.nan), limit, *bad])
        refused.update(f"{world}: {f['why']}" for f in found if f["outcome"] == "refused")
    again = sum((Counter(r["again"]) for r in plants), Counter[str]())
    heads = ("world", "compared", "worst error", "limit", "above or failed", *WAYS)
    parts = [f"drawn again: {dict(again)}", harness.table(heads, lines)]
    return "\n".join([*parts, *(f"refused {n} times by {s}" for s, n in refused.items())])


OPTIONS = {
    "--minutes": {"type": float, "default": math.inf, "help": "no plant is begun later"},
    "--worlds": {"nargs": "*", "default": list(LIMITS), "choices": list(LIMITS)},
}

if __name__ == "__main__":
    harness.main(__doc__, cases, summary, count=40, options=OPTIONS)

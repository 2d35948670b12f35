"""The predictive controller on the planner's benchmark plant: steps, C, quadratic programs.

    python benchmarks/mpc.py [horizon ...]                  steps in Python, as ratios to IPOPT
    python benchmarks/mpc.py c [steps] [programs]           the controller in C, and its programs

Steps: the plant of PAM-2DIR follows a square wave between the stops: steps of 5 ms, RK4 with two
sub-steps, all limits soft, shifted warm start. IPOPT solves the same program from the same guess.
Times are those of the thread on the processor, so that other programs do not enter; "wall" is the
median by the clock. The garbage of the set-up is frozen first, as before any loop that must be on
time.

C: the controller of that plant and of one with spool valves, a dead zone and hysteresis, horizon
50, one SQP step a call: exported by ``pam.export_c``, built with zig, called through ctypes in a
closed loop with the model, beside the same block in Python and ``Mpc.control`` with HPIPM. Then the
quadratic programs along the first loop by several solvers: time, and distance from the solution of
PIQP at its tightest (needs daqp and osqp).
"""

from __future__ import annotations

import ctypes
import gc
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any

import casadi as ca
import harness
import numpy as np
from pam_2dir import COMMANDS, slide

import pam_ocp as pam
from pam_ocp.control.mpc.mpc import Mpc
from pam_ocp.control.mpc.stage_qp import StageQp
from pam_ocp.control.step import Givens, Step
from pam_ocp.core.block import Block

STEP = 0.005
METHODS: tuple[tuple[str, dict[str, Any], int], ...] = (
    ("ipopt", {"solver": "ipopt"}, 60),
    ("piqp, one iteration", {"solver": "piqp", "iterations": 1, "compiled": False}, 400),
    ("hpipm, one iteration", {"iterations": 1, "compiled": False}, 400),
    ("one iteration, compiled", {"iterations": 1, "compiled": True}, 400),
    ("hpipm, converged, work bounded", {"iterations": 30, "compiled": False}, 400),
    ("converged, work bounded, compiled", {"iterations": 30, "compiled": True}, 400),
    ("hpipm, converged", {"iterations": 30, "work": None, "compiled": False}, 400),
)
HORIZON = 50
MEMORY = 1 << 22
"""Bytes handed to a controller in C for its state: more than any takes."""
ZIG = (sys.executable, "-m", "ziglang", "cc", "-O2", "-ffp-contract=off", "-fPIC")


def square_wave(t: Any, half: float) -> Any:
    """Between -half and half [m], twice a second."""
    return np.where(np.asarray(t) % 0.5 < 0.25, -half, half)


def controller(plant: pam.Plant, horizon: int, **options: Any) -> Mpc:
    rate = dict.fromkeys(COMMANDS, 0.1)
    return Mpc(plant, horizon=horizon, sample_time=STEP, track={"x": 1.0}, rate=rate, **options)


def predicted(plant: pam.Plant, mpc: Mpc) -> np.ndarray:
    """The next state, where the plant follows the model."""
    low, high = (plant.vector("state", attribute=a) for a in ("min", "max"))
    return np.clip(mpc.prediction().array([v.name for v in plant.states])[1], low, high)


# ---- steps in Python -----------------------------------------------------------------------------
def run(
    plant: pam.Plant, horizon: int, preview: bool, steps: int, **options: Any
) -> tuple[Mpc, np.ndarray]:
    """The controller after so many steps, and the processor time of each after the first [s]."""
    mpc = controller(plant, horizon, **options)
    rest = plant.equilibrium(x=-0.014, stiffness=2e4)
    mpc.reset({n: rest[n] for n in COMMANDS})
    state, seconds = rest.x, []
    gc.collect()
    gc.freeze()
    for k in range(steps):
        t = STEP * (k + (np.arange(horizon + 1) if preview else np.zeros(horizon + 1)))
        wanted = {"x": square_wave(t, 0.014)}
        begin = thread_time()
        mpc.control(state, wanted)
        seconds.append(thread_time() - begin)
        state = predicted(plant, mpc)
    gc.unfreeze()
    return mpc, np.array(seconds[1:])


def compare_methods(horizons: list[int]) -> None:
    plant = slide()
    begin = perf_counter()
    controller(plant, HORIZON)
    print(f"build, horizon {HORIZON}: {perf_counter() - begin:.3f} s")
    print("milliseconds a step; evaluation and Python are what the QP solver does not take")
    rows, base = [], 1.0
    for preview in (False, True):
        for horizon in horizons:
            for name, options, steps in METHODS:
                mpc, seconds = run(plant, horizon, preview, steps, **options)
                done, middle, worst = mpc.statistics, float(np.median(seconds)), seconds.max()
                base = middle if name == "ipopt" else base
                qp = float(np.median([s.qp_seconds for s in done.steps[1:]]))
                figures = (middle, float(np.quantile(seconds, 0.99)), float(worst), done.median, qp)
                iterations = float(np.mean([s.iterations for s in done.steps[1:]]))
                label = f"{name}, {horizon}{', preview' if preview else ''}"
                relative = (float(worst) / middle, middle / base, iterations, done.fallbacks)
                rows.append([label, *(1e3 * f for f in figures), *relative])
                print(f"{label}: {1e3 * middle:.3f} ms", flush=True)
    heads = ("median", "99 %", "worst", "wall", "of it QP", "worst/med", "ratio", "iterations")
    print(harness.table(("", *heads, "fallbacks"), rows))


# ---- the controller in C -------------------------------------------------------------------------
@dataclass
class Loop:
    """A plant, its controller as an object and as a block, and the point where the loop begins."""

    name: str
    plant: pam.Plant
    mpc: Mpc
    rest: Any

    def __post_init__(self) -> None:
        self.block: Block = pam.control.block(self.mpc)
        self.place = {v.name: i for i, v in enumerate(self.block.inputs)}


def regulated() -> Loop:
    plant = slide()
    mpc = controller(plant, HORIZON, iterations=1)
    return Loop("slide with regulators", plant, mpc, plant.equilibrium(x=-0.014, stiffness=2e4))


def spools() -> Loop:
    plant = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"),
        mass=2.0,
        pre_contraction=0.10,
        stroke=0.016,
        damping=pam.losses.ConstantDamping(20.0),
        losses=pam.losses.BoucWen(),
        feed=pam.feeds.SpoolValve(overlap=0.1),
    )
    mpc = Mpc(
        plant,
        horizon=HORIZON,
        sample_time=STEP,
        track={"x": 1.0, "muscle1.pressure": 0.01},
        rate=dict.fromkeys(COMMANDS, 0.05),
        iterations=1,
        method="rosenbrock",
        substeps=1,
    )
    rest = plant.equilibrium(x=0.0, **{"muscle1.pressure": 2e5})
    return Loop("slide with spool valves, dead zone, hysteresis", plant, mpc, rest)


class InC:
    """A block built for this machine: ``step(inputs)`` gives outputs, and times itself."""

    def __init__(self, block: Block, folder: Path) -> None:
        self.folder, name = pam.export_c(block, folder, steps=20, tolerance=1e-9), block.name
        self.object, library = folder / "block.o", folder / "lib.so"
        source = str(folder / f"{name}.c")
        subprocess.run([*ZIG, "-std=c99", "-c", "-o", self.object, source], check=True)
        subprocess.run([*ZIG, "-shared", "-o", library, self.object, "-lm"], check=True)
        code = ctypes.CDLL(str(library))
        self._state = ctypes.create_string_buffer(MEMORY)
        sizes = (len(block.parameters) + 1, len(block.inputs), len(block.outputs))
        self._parameters, self.inputs, self.outputs = (np.zeros(n) for n in sizes)
        arrays = (self._parameters, self.inputs, self.outputs)
        p, i, o = (ctypes.c_void_p(a.ctypes.data) for a in arrays)
        self._step, init = getattr(code, f"{name}_step"), getattr(code, f"{name}_init")
        self._arguments = (self._state, p, i, o)
        self.begin = lambda: init(self._state, p, i)
        self.begin()

    def step(self, inputs: np.ndarray) -> tuple[np.ndarray, float]:
        self.inputs[:] = inputs
        begin = thread_time()
        self._step(*self._arguments)
        return self.outputs.copy(), thread_time() - begin

    @property
    def bytes(self) -> int:
        text = (self.folder / "README.md").read_text()
        return int(re.search(r"_state` \| (\d+)", text)[1])  # type: ignore[index]

    @property
    def calls(self) -> list[str]:
        """Functions of others that the object file asks for."""
        nm = subprocess.run(["nm", self.object], capture_output=True, text=True, check=True)
        return sorted({line.split()[-1] for line in nm.stdout.splitlines() if " U " in line})


def closed(
    loop: Loop, steps: int, act: Callable[[np.ndarray], tuple[np.ndarray, float]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(inputs, outputs, seconds) of a loop with the model, noise of seed 0, a square wave."""
    plant, block, place = loop.plant, loop.block, loop.place
    commands = [v.name for v in plant.inputs]
    chosen = [[v.name for v in block.outputs].index(n) for n in commands]
    random, advance = np.random.default_rng(0), Step(STEP, "rosenbrock", 4)
    x, u = np.array(loop.rest.x), np.array([loop.rest[n] for n in commands])
    z = [ca.SX.sym(n, k) for n, k in (("x", len(x)), ("u", len(u)))]
    given = Givens(plant)
    un = np.array([v.nominal for v in plant.inputs])
    xn = plant.vector("state", attribute="nominal")
    moved = advance.expression(given, z[0] / xn, z[1] / un, ca.SX(given.vector())) * xn
    after = ca.Function("f", z, [moved])
    low, high = (plant.vector("state", attribute=a) for a in ("min", "max"))
    rows, outputs, seconds = [], [], []
    for k in range(steps):
        row = np.array([v.start or 0.0 for v in block.inputs])
        seen = x * (1 + 1e-4 * random.standard_normal(len(x)))
        row[[place[v.name] for v in plant.states]] = seen
        row[place["wanted.x"]] = square_wave(k * STEP, 0.012)
        if "wanted.muscle1.pressure" in place:
            row[place["wanted.muscle1.pressure"]] = 2e5
        found, spent = act(row)
        rows.append(row)
        outputs.append(found)
        seconds.append(spent)
        x = np.clip(np.asarray(after(x, found[chosen])).ravel(), low, high)
    return np.array(rows), np.array(outputs), np.array(seconds)


def in_python(loop: Loop, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(outputs, seconds) of the same block in Python."""
    memory, parameters = loop.block.start("memory"), loop.block.start("parameters")
    outputs, seconds = [], []
    for row in rows:
        begin = thread_time()
        memory, out = loop.block.step(memory, row, parameters)
        seconds.append(thread_time() - begin)
        outputs.append(np.asarray(out).ravel())
    return np.array(outputs), np.array(seconds)


def by_hpipm(loop: Loop, rows: np.ndarray) -> np.ndarray:
    """Seconds of Mpc.control with HPIPM along the same measurements."""
    wanted = {n[7:]: i for n, i in loop.place.items() if n.startswith("wanted.")}
    loop.mpc.reset()
    seconds = []
    for row in rows:
        state = [row[loop.place[v.name]] for v in loop.plant.states]
        begin = thread_time()
        loop.mpc.control(state, {n: row[i] for n, i in wanted.items()})
        seconds.append(thread_time() - begin)
    return np.array(seconds)


def compare(loop: Loop, steps: int) -> None:
    """C, the same in Python, and HPIPM: times, memory, and by how much commands differ."""
    block = loop.block
    with tempfile.TemporaryDirectory() as folder:
        one = InC(block, Path(folder) / "one")
        rows, outputs, seconds = closed(loop, steps, one.step)
        one.begin()
        same = all(np.array_equal(one.step(r)[0], o) for r, o in zip(rows, outputs, strict=True))
        print(f"{loop.name}: {len(block.memory)} numbers of memory, state of {one.bytes} bytes")
        print(f"  called from outside: {', '.join(one.calls)}; twice the same bits: {same}")
    few = rows[: max(steps // 10, 1)]
    found, python = in_python(loop, few)
    exact = outputs[: len(few)]
    miss = np.abs(found - exact) / np.abs(exact).max(axis=0).clip(1e-9)
    commands = [i for i, v in enumerate(block.outputs) if v.name in block.commands]
    ways = {"C": seconds, "the same in Python": python, "Mpc with HPIPM": by_hpipm(loop, few)}
    for label, all_steps in ways.items():
        t = 1e3 * all_steps[1:]
        print(
            f"  {label}: median {np.median(t):.3f} ms, 99 % {np.quantile(t, 0.99):.3f}, worst "
            f"{t.max():.3f} ({t.max() / np.median(t):.2f} of the median)"
        )
    work, status = (
        outputs[1:, [v.name for v in block.outputs].index(f"solver.{n}")]
        for n in ("work", "status")
    )
    most = block.loops["iterations of the interior-point method"]
    print(
        f"  work: median {np.median(work):.0f}, most {work.max():.0f} of {most}; failed "
        f"{np.sum(status > 1)}; IPOPT asked {loop.mpc.statistics.fallbacks} times; commands in "
        f"Python and C differ by {miss[:, commands].max():.1e} of their largest"
    )


# ---- solvers of the quadratic programs -----------------------------------------------------------
class Programs:
    """The quadratic programs along a loop, one after another at ``point``."""

    def __init__(self, count: int) -> None:
        loop = regulated()
        self.plant, self.mpc, self.x = loop.plant, loop.mpc, loop.rest.x
        self.mpc.reset({n: loop.rest[n] for n in COMMANDS})
        self.count, self.point, self.program = count, self.mpc._sqp.point, self.mpc.program

    def __iter__(self) -> Iterator[int]:
        mpc, x = self.mpc, self.x
        for k in range(self.count):
            mpc.control(x, {"x": float(square_wave(k * STEP, 0.014))})
            x = predicted(self.plant, mpc)
            mpc._references({"x": float(square_wave((k + 1) * STEP, 0.014))})
            mpc._guess(x / self.program.x_nominal)
            self.point()
            yield k

    def matrices(self) -> tuple[Any, Any]:
        """(h, a) of the program at the point, sparse."""
        import scipy.sparse as sp

        p, point = self.program, self.point
        i, j = p.h_sparsity.get_triplet()
        h = sp.csc_matrix((point.h, (i, j)), (p.size, p.size))
        return h, sp.csc_matrix((point.a, (p.a_rows, p.a_columns)), (len(p.a_low), p.size))


Solved = tuple[np.ndarray, float]
"""(solution, seconds)."""


def quickest(call: Callable[[], Any], times: int = 3) -> tuple[Any, float]:
    """(result, the least seconds of some calls)."""
    seconds = []
    for _ in range(times):
        begin = thread_time()
        result = call()
        seconds.append(thread_time() - begin)
    return result, min(seconds)


def riccati(programs: Programs, folder: Path) -> Callable[[], Solved]:
    """The interior-point method of the block, alone, built from its C code."""
    core, p, point = programs.mpc.real_time(), programs.program, programs.point
    qp = core.qp
    generator = ca.CodeGenerator("qp.c", {})
    generator.add(qp.solve)
    generator.generate(f"{folder}/")
    library, source = folder / "qp.so", folder / "qp.c"
    subprocess.run([*ZIG, "-shared", "-o", library, source, "-lm"], check=True)
    buffer, call = ca.external("qp", str(library)).buffer()
    data = [np.zeros(qp.solve.nnz_in(k)) for k in range(2)] + [np.array([float(qp.iterations)])]
    results = [np.zeros(qp.solve.nnz_out(k)) for k in range(3)]
    for k, a in enumerate(data):
        buffer.set_arg(k, memoryview(a))
    for k, a in enumerate(results):
        buffer.set_res(k, memoryview(a))
    size = p.nx + len(p.rated) + p.nu

    def solve() -> Solved:
        nodes, end = point.unknowns[p.at], point.unknowns[p.at_last]
        bounds = np.array([b.value for b in core.bounds]) / core._nominal
        arguments = (nodes[:size], end[: p.nx], point.references.T, point.given, bounds, 0)
        for kept, new in zip(data[:2], qp.write(*arguments), strict=True):
            kept[:] = np.asarray(new).ravel(order="F")
        _, spent = quickest(call)
        found = np.zeros(p.size + p.nx + len(p.rated) + 1)
        found[p.at[:size]] = results[0].reshape(-1, size).T
        found[p.at_last[: p.nx]] = results[1]
        return found[: p.size], spent

    solve.buffer = buffer  # type: ignore[attr-defined]  # it holds what ``call`` reads
    return solve


def condensed(programs: Programs) -> Callable[[], Solved]:
    """DAQP on the dense program in inputs and slacks, without what condensing takes."""
    import daqp
    import scipy.sparse as sp
    from scipy.sparse.linalg import splu

    p, point = programs.program, programs.point
    equal = p.a_low == p.a_high
    sizes = zip(p.dimensions["nx"], p.dimensions["nu"], strict=True)
    x = np.concatenate([np.repeat([True, False], pair) for pair in sizes])

    def solve() -> Solved:
        h, a = programs.matrices()
        e = a[equal]
        states = splu(e[:, x].tocsc())
        t = np.zeros((p.size, int(np.sum(~x))))
        t[x], t[~x] = -states.solve(e[:, ~x].toarray()), np.eye(t.shape[1])
        c = np.zeros(p.size)
        c[x] = states.solve(point.a_low[equal])
        limits = sp.vstack([a[~equal], sp.eye(p.size, format="csc")[x]])
        low, high = (
            np.concatenate([w[~x], np.concatenate([rows[~equal], w[x]]) - limits @ c])
            for w, rows in ((point.w_low, point.a_low), (point.w_high, point.a_high))
        )
        low[low < -1e5], high[high > 1e5] = -1e30, 1e30
        keep, count = (low > -1e30) | (high < 1e30), t.shape[1]
        keep[:count] = True
        rows = np.ascontiguousarray((limits @ t)[keep[count:]])
        cost = t.T @ (h @ t), t.T @ (point.gradient + h @ c)
        sense = np.zeros(int(keep.sum()), dtype=np.int32)
        arguments = (*cost, rows, high[keep], low[keep], sense)
        (u, _, flag, _), spent = quickest(lambda: daqp.solve(*arguments))
        return (t @ u + c if flag > 0 else np.full(p.size, np.nan)), spent

    return solve


def by_osqp(programs: Programs) -> Callable[[], Solved]:
    import osqp
    import scipy.sparse as sp

    point, size = programs.point, programs.program.size
    accuracy = {"eps_abs": 1e-6, "eps_rel": 1e-6, "max_iter": 20000, "verbose": False}

    def solve() -> Solved:
        h, a = programs.matrices()
        rows = sp.vstack([a, sp.eye(size)], format="csc")
        low = np.concatenate([point.a_low, point.w_low])
        high = np.concatenate([point.a_high, point.w_high])
        solver = osqp.OSQP()
        solver.setup(sp.triu(h, format="csc"), point.gradient, rows, low, high, **accuracy)
        result = solver.solve()
        return np.asarray(result.x, float), result.info.run_time

    return solve


def conic(programs: Programs, plugin: str, options: dict[str, Any]) -> Callable[[], Solved]:
    """A solver of CasADi's."""
    p, point = programs.program, programs.point
    quiet = {"error_on_fail": False, "print_time": False, **options}
    solver = ca.conic("c", plugin, {"h": p.h_sparsity, "a": p.a_sparsity}, quiet)

    def solve() -> Solved:
        arguments = {
            "h": ca.DM(p.h_sparsity, point.h),
            "g": point.gradient,
            "a": ca.DM(p.a_sparsity, point.a),
            "lba": point.a_low,
            "uba": point.a_high,
            "lbx": point.w_low,
            "ubx": point.w_high,
        }
        found, spent = quickest(lambda: solver(**arguments), 1)
        return np.asarray(found["x"]).ravel(), spent

    return solve


def hpipm(programs: Programs) -> Callable[[], Solved]:
    direction = np.zeros(programs.program.size)
    call = StageQp(programs.point, direction)

    def solve() -> Solved:
        _, spent = quickest(call)
        return direction.copy(), spent

    return solve


def candidates(count: int) -> None:
    """The programs of a loop by each solver."""
    programs = Programs(count)
    tight = {"piqp": {"eps_abs": 1e-12, "eps_rel": 1e-12}}
    reference = conic(programs, "piqp", tight)
    with tempfile.TemporaryDirectory() as folder:
        solvers = {
            "own Riccati method, C": riccati(programs, Path(folder)),
            "HPIPM": hpipm(programs),
            "DAQP, condensed": condensed(programs),
            "OSQP 1e-6": by_osqp(programs),
            "PIQP (CasADi)": conic(programs, "piqp", {}),
        }
        found: dict[str, list[tuple[float, float]]] = {name: [] for name in solvers}
        for _ in programs:
            exact, hard = reference()[0], programs.program.w_low != 0.0  # no slacks
            for name, solve in solvers.items():
                solution, spent = solve()
                found[name].append((1e3 * spent, float(np.max(np.abs(solution - exact)[hard]))))
    rows = []
    for name, pairs in found.items():
        t, miss = np.array(pairs).T
        far = [float(f(miss)) for f in (np.nanmedian, np.nanmax)]
        rows.append([name, float(np.median(t)), float(t.max()), *far, int(np.isnan(miss).sum())])
    print(f"{count} quadratic programs of {programs.program.size} unknowns, milliseconds:")
    print(harness.table(("solver", "median", "worst", "distance", "at most", "failed"), rows))


def main(words: list[str]) -> None:
    if words[:1] != ["c"]:
        compare_methods([int(a) for a in words] or [30, 50])
        return
    steps, programs = ([int(a) for a in words[1:]] + [10_000, 200][len(words) - 1 :])[:2]
    candidates(programs)
    for loop in (regulated(), spools()):
        compare(loop, steps)


if __name__ == "__main__":
    main(sys.argv[1:])

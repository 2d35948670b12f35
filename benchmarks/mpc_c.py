"""The Mpc in C against Python, and the quadratic programs of its calls by several solvers.

1. The controller of the planner's benchmark slide (regulators) and of one with spool valves, a dead
   zone and hysteresis, horizon 50, one SQP step a call: exported by ``pam.export_c``, built with
   zig, called through ctypes in a closed loop with the model; times are processor times.
2. The quadratic programs along the slide's loop by each candidate: time, and distance from the
   solution of PIQP at its tightest.

Run:  python benchmarks/mpc_c.py [steps] [programs]
"""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from time import thread_time
from typing import Any

import casadi as ca
import daqp
import numpy as np
import osqp
import scipy.sparse as sp
import scipy.sparse.linalg

import pam_ocp as pam
from pam_ocp.control.mpc.stage_qp import StageQp
from pam_ocp.control.step import Givens, Step
from pam_ocp.core.block import Block

sys.path.insert(0, str(Path(__file__).parent))
from mpc import COMMANDS, STEP, benchmark_plant

HORIZON = 50
MEMORY = 1 << 22
"""Bytes handed to a controller for its state: more than any takes."""


def regulated() -> tuple[pam.Plant, pam.control.Mpc, Any]:
    plant = benchmark_plant()
    mpc = pam.control.Mpc(
        plant,
        horizon=HORIZON,
        sample_time=STEP,
        track={"x": 1.0},
        rate=dict.fromkeys(COMMANDS, 0.1),
        iterations=1,
    )
    return plant, mpc, plant.equilibrium(x=-0.014, stiffness=2e4)


def spools() -> tuple[pam.Plant, pam.control.Mpc, Any]:
    plant = pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"),
        mass=2.0,
        pre_contraction=0.10,
        stroke=0.016,
        damping=pam.losses.ConstantDamping(20.0),
        losses=pam.losses.BoucWen(),
        feed=pam.feeds.SpoolValve(overlap=0.1),
    )
    mpc = pam.control.Mpc(
        plant,
        horizon=HORIZON,
        sample_time=STEP,
        track={"x": 1.0, "muscle1.pressure": 0.01},
        rate=dict.fromkeys(COMMANDS, 0.05),
        iterations=1,
        method="rosenbrock",
        substeps=1,
    )
    return plant, mpc, plant.equilibrium(x=0.0, **{"muscle1.pressure": 2e5})


# ---- a block in C -------------------------------------------------------------------------------
class InC:
    """A block built for this machine: ``step(inputs)`` gives outputs, and times itself."""

    def __init__(self, block: Block, folder: Path) -> None:
        self.block, self.folder = block, pam.export_c(block, folder, steps=20, tolerance=1e-9)
        self.library = folder / "lib.so"
        source = folder / f"{block.name}.c"
        build = [sys.executable, "-m", "ziglang", "cc", "-std=c99", "-O2", "-ffp-contract=off"]
        self.object = folder / "block.o"
        subprocess.run([*build, "-fPIC", "-c", "-o", str(self.object), str(source)], check=True)
        whole = [*build, "-shared", "-o", str(self.library), str(self.object), "-lm"]
        subprocess.run(whole, check=True)
        self._c = ctypes.CDLL(str(self.library))
        self._state = ctypes.create_string_buffer(MEMORY)
        sizes = (len(block.inputs), len(block.parameters) + 1, len(block.outputs))
        self.inputs, self._parameters, self.outputs = (np.zeros(n) for n in sizes)
        arrays = (self.inputs, self._parameters, self.outputs)
        i, p, o = (ctypes.c_void_p(a.ctypes.data) for a in arrays)
        self._step = getattr(self._c, f"{block.name}_step")
        self._arguments = (self._state, p, i, o)
        self.begin = lambda: getattr(self._c, f"{block.name}_init")(self._state, p, i)
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
        told = subprocess.run(["nm", str(self.object)], capture_output=True, text=True, check=True)
        return sorted({line.split()[-1] for line in told.stdout.splitlines() if " U " in line})


def closed(
    plant: pam.Plant, mpc: pam.control.Mpc, rest: Any, steps: int, act: Callable[..., Any]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(inputs, outputs, seconds) of a loop with the model, noise of seed 0, a square wave."""
    block = mpc.block_for_benchmark  # type: ignore[attr-defined]
    place = {v.name: i for i, v in enumerate(block.inputs)}
    commands = [v.name for v in plant.inputs]
    chosen = [[v.name for v in block.outputs].index(n) for n in commands]
    random = np.random.default_rng(0)
    advance = Step(STEP, "rosenbrock", 4)
    x, u = np.array(rest.x), np.array([rest[n] for n in commands])
    given = Givens(plant)
    z = [ca.SX.sym(n, k) for n, k in (("x", len(x)), ("u", len(u)))]
    q = given.vector()
    un = np.array([v.nominal for v in plant.inputs])
    xn = plant.vector("state", attribute="nominal")
    after = ca.Function("f", z, [advance.expression(given, z[0] / xn, z[1] / un, ca.SX(q)) * xn])
    low, high = (plant.vector("state", attribute=a) for a in ("min", "max"))
    rows, outputs, seconds = [], [], []
    for k in range(steps):
        row = np.array([v.start or 0.0 for v in block.inputs])
        seen = x * (1 + 1e-4 * random.standard_normal(len(x)))
        for v, value in zip(plant.states, seen, strict=True):
            row[place[v.name]] = value
        row[place["wanted.x"]] = -0.012 if (k * STEP) % 0.5 < 0.25 else 0.012
        if "wanted.muscle1.pressure" in place:
            row[place["wanted.muscle1.pressure"]] = 2e5
        found, spent = act(row)
        rows.append(row)
        outputs.append(found)
        seconds.append(spent)
        x = np.clip(np.asarray(after(x, found[chosen])).ravel(), low, high)
    return np.array(rows), np.array(outputs), np.array(seconds)


def compare(name: str, made: tuple[pam.Plant, pam.control.Mpc, Any], steps: int) -> None:
    plant, mpc, rest = made
    block = pam.control.block(mpc)
    mpc.block_for_benchmark = block  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory() as folder:
        one = InC(block, Path(folder) / "one")
        rows, outputs, seconds = closed(plant, mpc, rest, steps, one.step)
        one.begin()
        same = all(np.array_equal(one.step(r)[0], o) for r, o in zip(rows, outputs, strict=True))
        print(f"{name}: {len(block.memory)} numbers of memory, state of {one.bytes} bytes")
        print(f"  called from outside: {', '.join(one.calls)}; twice the same bits: {same}")
    memory, parameters = block.start("memory"), block.start("parameters")
    python, found = [], []
    for row in rows[: max(steps // 10, 1)]:
        begin = thread_time()
        memory, out = block.step(memory, row, parameters)
        python.append(thread_time() - begin)
        found.append(np.asarray(out).ravel())
    count = len(found)
    miss = np.abs(np.array(found) - outputs[:count]) / np.abs(outputs[:count]).max(axis=0).clip(
        1e-9
    )
    commands = [i for i, v in enumerate(block.outputs) if v.name in block.commands]
    named = {v.name: outputs[1:, i] for i, v in enumerate(block.outputs)}
    for label, t in (("C", seconds[1:]), ("the same in Python", np.array(python[1:]))):
        print(
            f"  {label}: median {1e3 * np.median(t):.3f} ms, 99 % {1e3 * np.quantile(t, 0.99):.3f}"
            f", worst {1e3 * t.max():.3f} ({t.max() / np.median(t):.2f} of the median)"
        )
    work, status = named["solver.work"], named["solver.status"]
    print(
        f"  work: median {np.median(work):.0f}, most {work.max():.0f} of "
        f"{block.loops['iterations of the interior-point method']}; failed {np.sum(status > 1)}; "
        f"commands in Python and C differ by {miss[:, commands].max():.1e} of their largest"
    )
    by_hpipm(plant, mpc, rows[: max(steps // 10, 1)], np.median(seconds[1:]))


def by_hpipm(plant: pam.Plant, mpc: pam.control.Mpc, rows: np.ndarray, median: float) -> None:
    """Mpc.control with HPIPM along the same measurements."""
    block = mpc.block_for_benchmark  # type: ignore[attr-defined]
    place = {v.name: i for i, v in enumerate(block.inputs)}
    wanted = {n[7:]: i for n, i in place.items() if n.startswith("wanted.")}
    mpc.reset()
    seconds = []
    for row in rows:
        state = [row[place[v.name]] for v in plant.states]
        begin = thread_time()
        mpc.control(state, {n: row[i] for n, i in wanted.items()})
        seconds.append(thread_time() - begin)
    t = np.array(seconds[1:])
    print(
        f"  Mpc in Python with HPIPM: median {1e3 * np.median(t):.3f} ms, worst {1e3 * t.max():.3f}"
        f"; C takes {median / np.median(t):.2f} of it; IPOPT asked {mpc.statistics.fallbacks} times"
    )


# ---- candidates for the quadratic programs ------------------------------------------------------
class Programs:
    """The quadratic programs along a loop, one after another at ``point``."""

    def __init__(self, count: int) -> None:
        self.plant, self.mpc, self.rest = regulated()
        self.mpc.reset({n: self.rest[n] for n in COMMANDS})
        self.count, self.point, self.program = count, self.mpc._sqp.point, self.mpc.program

    def __iter__(self) -> Any:
        mpc, x = self.mpc, self.rest.x
        low, high = (self.plant.vector("state", attribute=a) for a in ("min", "max"))
        for k in range(self.count):
            wanted = {"x": -0.014 if (k * STEP) % 0.5 < 0.25 else 0.014}
            mpc.control(x, wanted)
            plan = mpc.prediction()
            x = np.clip(plan.array([v.name for v in self.plant.states])[1], low, high)
            mpc._references({"x": -0.014 if ((k + 1) * STEP) % 0.5 < 0.25 else 0.014})
            mpc._guess(x / self.program.x_nominal)
            self.point()
            yield k


def timed(call: Callable[[], Any], times: int = 3) -> tuple[Any, float]:
    best, result = np.inf, None
    for _ in range(times):
        begin = thread_time()
        result = call()
        best = min(best, thread_time() - begin)
    return result, best


class Riccati:
    """The interior-point method of the block, alone, built from its C code."""

    def __init__(self, programs: Programs, folder: Path) -> None:
        self.p, self.core = programs, programs.mpc.real_time()
        qp = self.core.qp
        generator = ca.CodeGenerator("qp.c", {})
        generator.add(qp.solve)
        generator.generate(f"{folder}/")
        build = [sys.executable, "-m", "ziglang", "cc", "-O2", "-ffp-contract=off", "-shared"]
        library = str(folder / "qp.so")
        subprocess.run([*build, "-fPIC", "-o", library, str(folder / "qp.c"), "-lm"], check=True)
        self.buffer, self.call = ca.external("qp", library).buffer()
        self.data = [np.zeros(qp.solve.nnz_in(k)) for k in range(2)]
        self.data.append(np.array([float(qp.iterations)]))
        self.results = [np.zeros(qp.solve.nnz_out(k)) for k in range(3)]
        for k, a in enumerate(self.data):
            self.buffer.set_arg(k, memoryview(a))
        for k, a in enumerate(self.results):
            self.buffer.set_res(k, memoryview(a))
        self.memory = 8 * (qp.solve.sz_w() + sum(len(a) for a in self.data))

    def __call__(self) -> tuple[np.ndarray, float]:
        p, point = self.p.program, self.p.point
        nodes, end = point.unknowns[p.at], point.unknowns[p.at_last]
        size = p.nx + len(p.rated) + p.nu
        bounds = np.array([b.value for b in self.core.bounds]) / self.core._nominal
        arguments = (nodes[:size], end[: p.nx], point.references.T, point.given, bounds, 0)
        for kept, new in zip(self.data[:2], self.core.qp.write(*arguments), strict=True):
            kept[:] = np.asarray(new).ravel(order="F")
        _, spent = timed(self.call)
        found = np.zeros(p.size + p.nx + len(p.rated) + 1)
        found[p.at[:size]] = self.results[0].reshape(-1, size).T
        found[p.at_last[: p.nx]] = self.results[1]
        return found[: p.size], spent


class Condensed:
    """DAQP on the dense program in inputs and slacks; ``condensing`` takes what it takes."""

    memory = 0

    def __init__(self, programs: Programs) -> None:
        self.p, self.condensing = programs, []
        p = programs.program
        self.equal = p.a_low == p.a_high
        sizes_x, sizes_u = p.dimensions["nx"], p.dimensions["nu"]
        self.states = np.concatenate(
            [np.repeat([True, False], (a, b)) for a, b in zip(sizes_x, sizes_u, strict=True)]
        )

    def __call__(self) -> tuple[np.ndarray, float]:
        p, point = self.p.program, self.p.point
        begin = thread_time()
        a = sp.csc_matrix((point.a, (p.a_rows, p.a_columns)), (len(p.a_low), p.size))
        i, j = p.h_sparsity.get_triplet()
        h = sp.csc_matrix((point.h, (i, j)), (p.size, p.size))
        e, x = a[self.equal], self.states
        solve = scipy.sparse.linalg.splu(e[:, x].tocsc())
        t = np.zeros((p.size, int(np.sum(~x))))
        t[x] = -solve.solve(e[:, ~x].toarray())
        t[~x] = np.eye(t.shape[1])
        c = np.zeros(p.size)
        c[x] = solve.solve(point.a_low[self.equal])
        hc, fc = t.T @ (h @ t), t.T @ (point.gradient + h @ c)
        limits = sp.vstack([a[~self.equal], sp.eye(p.size, format="csc")[x]])
        low = np.concatenate([point.a_low[~self.equal], point.w_low[x]]) - limits @ c
        high = np.concatenate([point.a_high[~self.equal], point.w_high[x]]) - limits @ c
        low = np.concatenate([point.w_low[~x], low])
        high = np.concatenate([point.w_high[~x], high])
        low[low < -1e5], high[high > 1e5] = -1e30, 1e30
        keep = (low > -1e30) | (high < 1e30)
        count = t.shape[1]
        keep[:count] = True
        rows = np.ascontiguousarray((limits @ t)[keep[count:]])
        self.condensing.append(thread_time() - begin)
        sense = np.zeros(int(keep.sum()), dtype=np.int32)
        arguments = (hc, fc, rows, high[keep], low[keep], sense)
        (u, _, flag, _), spent = timed(lambda: daqp.solve(*arguments))
        return (t @ u + c if flag > 0 else np.full(p.size, np.nan)), spent


class Osqp:
    memory = 0

    def __init__(self, programs: Programs) -> None:
        self.p = programs

    def __call__(self) -> tuple[np.ndarray, float]:
        p, point = self.p.program, self.p.point
        a = sp.csc_matrix((point.a, (p.a_rows, p.a_columns)), (len(p.a_low), p.size))
        rows = sp.vstack([a, sp.eye(p.size)], format="csc")
        i, j = p.h_sparsity.get_triplet()
        h = sp.triu(sp.csc_matrix((point.h, (i, j)), (p.size, p.size)), format="csc")
        low = np.concatenate([point.a_low, point.w_low])
        high = np.concatenate([point.a_high, point.w_high])
        solver = osqp.OSQP()
        solver.setup(
            h,
            point.gradient,
            rows,
            low,
            high,
            verbose=False,
            eps_abs=1e-6,
            eps_rel=1e-6,
            max_iter=20000,
        )
        result = solver.solve()
        return np.asarray(result.x, float), result.info.run_time


class Conic:
    """A solver of CasADi's."""

    memory = 0

    def __init__(self, programs: Programs, plugin: str, options: dict[str, Any]) -> None:
        p = programs.program
        self.p = programs
        chosen = {"error_on_fail": False, "print_time": False, **options}
        self.solver = ca.conic("c", plugin, {"h": p.h_sparsity, "a": p.a_sparsity}, chosen)

    def __call__(self) -> tuple[np.ndarray, float]:
        p, point = self.p.program, self.p.point
        arguments = {
            "h": ca.DM(p.h_sparsity, point.h),
            "g": point.gradient,
            "a": ca.DM(p.a_sparsity, point.a),
            "lba": point.a_low,
            "uba": point.a_high,
            "lbx": point.w_low,
            "ubx": point.w_high,
        }
        found, spent = timed(lambda: self.solver(**arguments), 1)
        return np.asarray(found["x"]).ravel(), spent


class Hpipm:
    memory = 0

    def __init__(self, programs: Programs) -> None:
        self.direction = np.zeros(programs.program.size)
        self.call = StageQp(programs.point, self.direction)

    def __call__(self) -> tuple[np.ndarray, float]:
        _, spent = timed(self.call)
        return self.direction.copy(), spent


def candidates(count: int) -> None:
    programs = Programs(count)
    tight = {"piqp": {"eps_abs": 1e-12, "eps_rel": 1e-12}}
    reference = Conic(programs, "piqp", tight)
    with tempfile.TemporaryDirectory() as folder:
        solvers: dict[str, Any] = {
            "own Riccati method, C": Riccati(programs, Path(folder)),
            "HPIPM": Hpipm(programs),
            "DAQP, condensed": Condensed(programs),
            "OSQP 1e-6": Osqp(programs),
            "PIQP (CasADi)": Conic(programs, "piqp", {}),
        }
        times: dict[str, list[float]] = {n: [] for n in solvers}
        misses: dict[str, list[float]] = {n: [] for n in solvers}
        for _ in programs:
            exact, _ = reference()
            for name, solver in solvers.items():
                found, spent = solver()
                slack = programs.program.w_low == 0.0
                times[name].append(spent)
                misses[name].append(float(np.max(np.abs(found - exact)[~slack])))
        print(f"{count} quadratic programs of {programs.program.size} unknowns, milliseconds:")
        for name in solvers:
            t, miss = 1e3 * np.array(times[name]), np.array(misses[name])
            failed = int(np.sum(~np.isfinite(miss)))
            print(
                f"  {name:<24} median {np.median(t):8.3f}  worst {t.max():8.3f}  distance "
                f"{np.nanmedian(miss):.1e}, at most {np.nanmax(miss):.1e}  failed {failed}"
            )
        condensing = 1e3 * np.array(solvers["DAQP, condensed"].condensing)
        print(f"  (condensing with NumPy: median {np.median(condensing):.3f})")


def main() -> None:
    steps, count = ([int(a) for a in sys.argv[1:]] + [10000, 200][len(sys.argv) - 1 :])[:2]
    candidates(count)
    compare("slide with regulators", regulated(), steps)
    compare("slide with spool valves, dead zone, hysteresis", spools(), steps)


if __name__ == "__main__":
    main()

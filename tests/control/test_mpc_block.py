"""An Mpc as a block: the same optimum, the same bits, a bounded worst case, no heap."""

import re

import casadi as ca
import numpy as np
import pytest
from conftest import flat, refused
from mpc_cases import COMMANDS, exact, mass
from mpc_cases import slide_mpc as any_slide_mpc

import pam_ocp as pam
from pam_ocp.control.mpc.mpc import Mpc
from pam_ocp.control.mpc.mpc_block import mpc_block
from pam_ocp.control.mpc.riccati import ITERATIONS
from pam_ocp.core.errors import UnknownNameError


def mass_mpc(**options) -> Mpc:
    settings = {
        "horizon": 12,
        "sample_time": 0.1,
        "track": {"x": 1.0},
        "rate": {"f": 1e-2},
        "solver": "riccati",
        "bounds": {"v": (-0.4, 0.4)},
    }
    return Mpc(mass(1.0), **{**settings, **options})


def slide_mpc(**options) -> Mpc:
    return any_slide_mpc(**{"horizon": 20, "solver": "riccati", "iterations": 1, **options})


class Running:
    """A block called by name, its memory kept."""

    def __init__(self, block):
        self.block, self.memory = block, block.start("memory")
        self.parameters = block.start("parameters")
        self.sent = {}

    def __call__(self, **inputs):
        told = {**inputs, **{f"sent.{n}": u for n, u in self.sent.items()}}
        known = {k.replace(".", "_"): v for k, v in told.items()}
        row = [known.get(v.name.replace(".", "_"), v.start) for v in self.block.inputs]
        memory, outputs = self.block.step(self.memory, row, self.parameters)
        self.memory = flat(memory)
        found = dict(zip((v.name for v in self.block.outputs), flat(outputs), strict=True))
        self.sent = {n: found[n] for n in self.block.commands}
        return found


# ---- the quadratic program -----------------------------------------------------------------------
@pytest.mark.parametrize("goal", [0.006, 0.012, -0.012])
def test_the_riccati_method_finds_the_optimum_of_the_quadratic_program(goal):
    """After a jump of the reference, with active limits of inputs, and soft ones that give way."""
    mpc = slide_mpc(bounds={"x": (-0.004, 0.004)}, solver="hpipm")
    rest = mpc.plant.equilibrium(x=0.0, stiffness=2e4)
    mpc.reset({v.name: rest[v.name] for v in rest.plant.inputs})
    mpc.control(rest.x, {"x": 0.0, "stiffness": 2e4})
    point, p, core = mpc._sqp.point, mpc.program, mpc.real_time()
    mpc._references({"x": goal, "stiffness": 2e4})
    point()
    wanted = exact(p, point)
    size = p.nx + len(p.rated) + p.nu
    bounds = np.array([b.value / b.limit.variable.nominal for b in core.bounds])
    nodes, end = point.unknowns[p.at], point.unknowns[p.at_last]
    data = core.qp.write(nodes[:size], end[: p.nx], point.references.T, point.given, bounds, 0)
    dy, dy_end, told = core.qp.solve(*data, ITERATIONS)
    here = np.append(wanted, np.zeros(p.nx + len(p.rated) + 1))[p.at[:size]]
    assert np.abs(here).max() > 0.1
    assert np.asarray(dy) == pytest.approx(here, abs=1e-6)
    assert np.asarray(dy_end).ravel() == pytest.approx(wanted[p.at_last[: p.nx]], abs=1e-6)
    assert float(told[2]) < ITERATIONS


# ---- the same in every form ----------------------------------------------------------------------
def test_the_block_gives_what_the_mpc_gives_bit_for_bit():
    mpc = slide_mpc()
    block = Running(mpc_block(mpc))
    rest = mpc.plant.equilibrium(x=0.0, stiffness=2e4)
    mpc.reset({n: rest[n] for n in COMMANDS})
    block.sent = {n: rest[n] for n in COMMANDS}
    state, random = rest.x, np.random.default_rng(1)
    for k in range(25):
        goal = 0.008 if k < 12 else -0.008
        given = dict(zip((v.name for v in mpc.plant.states), state, strict=True))
        chosen = mpc.control(given, {"x": goal, "stiffness": 2e4})
        found = block(**given, **{"wanted.x": goal, "wanted.stiffness": 2e4})
        assert {n: found[n] for n in COMMANDS} == chosen
        plan = mpc.prediction()
        state = [plan[n][1] * (1 + 1e-4 * random.standard_normal()) for n in given]


@pytest.mark.parametrize("delay", [0, 1])
def test_with_preview_it_is_told_the_reference_at_each_node(delay):
    mpc = mass_mpc(delay=delay)
    wanted = np.linspace(0.0, 1.0, 13)
    block = Running(mpc_block(mpc, preview=True))
    inputs = {f"ahead.x.k{k}": wanted[k] for k in range(1, 13)}
    found = block(x=0.2, v=0.1, **{"wanted.x": wanted[0]}, **inputs)
    assert found["f"] == mpc.control([0.2, 0.1], {"x": wanted})["f"]


@pytest.mark.parametrize(("delay", "preview"), [(1, True), (0, False)])
def test_the_loop_tells_a_block_what_is_to_come(delay, preview):
    mpc, wanted = mass_mpc(delay=delay), {"x": lambda t: 0.1 * (t > 0.8)}
    told = {"duration": 1.5, "preview": preview}
    plain = pam.closed_loop(mpc, mass(1.0), wanted, **told)
    made = pam.control.block(mpc, plant=mass(1.0), preview=True)
    found = pam.closed_loop(pam.control.BlockController(made), mass(1.0), wanted, **told)
    assert np.array_equal(found["f"], plain["f"])
    assert (np.abs(plain["f"][:4]).max() > 1e-3) == preview


def test_limits_parameters_and_what_an_estimator_finds_may_change_while_it_runs():
    block = mpc_block(mass_mpc(), estimated=("m", "der(v)"))
    names = [v.name for v in block.parameters]
    running = Running(block)
    running.parameters[names.index("high.v")] = 0.2
    found = running(x=-1.0, v=0.1, m=2.0, push=0.1, **{"der.v": 0.05})
    mpc = mass_mpc(bounds={"v": (-0.4, 0.2)})
    told = mpc.control([-1.0, 0.1], values={"m": 2.0, "push": 0.1, "der(v)": 0.05})
    assert found["f"] == told["f"]


def test_openings_of_valves_are_sent_as_commands():
    plant = pam.HangingLoad("DMSP-20-400N", mass=20.0, feed=pam.feeds.SpoolValve(overlap=0.1))
    how = {"solver": "riccati", "method": "rosenbrock", "substeps": 1, "iterations": 1}
    mpc = Mpc(plant, horizon=8, sample_time=0.005, track={"x": 1.0}, **how)
    rest = plant.equilibrium(x=0.03)
    mpc.reset({"muscle.command": rest["muscle.command"]})
    block = Running(mpc_block(mpc))
    block.sent = {"muscle.command": rest["muscle.command"]}
    given = {v.name: rest[v.name] for v in plant.states}
    found = block(**given, **{"wanted.x": 0.035})["muscle.command"]
    assert found == pytest.approx(mpc.control(given, {"x": 0.035})["muscle.command"], rel=1e-9)
    assert abs(found) > 0.05  # beyond half the overlap


# ---- when something is missing or impossible -----------------------------------------------------
def test_a_measurement_that_is_missing_is_replaced_by_the_models_prediction():
    """A mass that follows the model: with v never measured the commands are the same."""
    blocks = [Running(mpc_block(mass_mpc())) for _ in range(2)]
    x, v, h = 0.0, 0.0, 0.1
    for k in range(15):
        seen, blind = blocks[0](x=x, v=v, wanted_x=1.0), blocks[1](x=x, v=np.nan, wanted_x=1.0)
        assert blind["f"] == pytest.approx(seen["f"], abs=1e-9)
        assert blind["solver.missing"] == k + 1
        assert seen["solver.missing"] == 0
        x, v = x + h * v + h * h / 2 * seen["f"], v + h * seen["f"]
    assert x > 0.3


def test_programs_without_a_solution_are_told_and_at_last_the_fallback_is_sent():
    """A hard bound of the speed that no force can keep."""
    block = mpc_block(mass_mpc(soft=False), patience=2)
    running = Running(block)
    names = [v.name for v in block.parameters]
    running.parameters[names.index("fallback.f")] = -0.25
    running(x=0.0, v=0.1)
    told = [running(x=0.0, v=3.0) for _ in range(4)]
    assert [t["solver.status"] for t in told] == [2, 2, 3, 3]
    assert [t["solver.failures"] for t in told] == [1, 2, 3, 4]
    assert told[-1]["f"] == -0.25
    back = running(x=0.0, v=0.1)
    assert back["solver.status"] <= 1
    assert np.isfinite(back["f"])


def test_whatever_is_measured_the_work_is_bounded_and_commands_stay_in_their_range():
    block = mpc_block(mass_mpc(iterations=3, work=12))
    running, random = Running(block), np.random.default_rng(3)
    most = block.loops["iterations of the interior-point method"]
    assert most == 11 + 20
    for _ in range(60):
        x, v, goal = random.standard_normal(3) * 10.0 ** random.uniform(-3, 9, 3)
        told = running(x=x, v=v if random.random() < 0.8 else np.inf, wanted_x=goal)
        assert np.all(np.isfinite(list(told.values())))
        assert abs(told["f"]) <= 1.0
        assert told["solver.work"] <= most
        assert told["solver.iterations"] <= 3


def test_soft_limits_that_give_way_and_limits_that_hold_are_told():
    running = Running(mpc_block(mass_mpc()))
    free = running(x=0.0, v=0.0, wanted_x=0.0)
    assert free["solver.active"] == 0
    fast = running(x=0.0, v=0.8, wanted_x=1.0)
    assert fast["solver.violation"] == pytest.approx(0.3, abs=1e-3)  # 0.8 - 0.1 at full force
    assert fast["solver.active"] > 0


# ---- its C code ----------------------------------------------------------------------------------
def test_its_c_code_loops_over_the_horizon_without_heap_or_variables_of_its_own():
    texts = []
    for horizon in (10, 40):
        block = mpc_block(mass_mpc(horizon=horizon))
        generator = ca.CodeGenerator("step.c", {})
        generator.add(block.step)
        texts.append(generator.dump())
    assert len(texts[1].splitlines()) < 1.5 * len(texts[0].splitlines())
    for text in texts:
        assert not re.search(r"malloc|alloca|\bexp\(|\btanh\(", text)
        assert not re.search(r"(?m)^static (?!const |int casadi|inline )", text)


def test_the_work_memory_grows_with_the_horizon_and_no_faster():
    small, large = (mpc_block(mass_mpc(horizon=n)).step.sz_w() for n in (20, 40))
    assert large < 2 * small


# ---- what cannot be meant ------------------------------------------------------------------------
def test_an_mpc_that_cannot_be_bounded_and_names_that_are_not_there_are_refused():
    refused("cannot be bounded", mpc_block, mass_mpc(solver="ipopt"))
    refused("push", mpc_block, mass_mpc(), error=UnknownNameError, estimated=("pushh",))
    refused("patience = -1", mpc_block, mass_mpc(), patience=-1)
    refused("iterations = 0", mpc_block, mass_mpc(), iterations=0)

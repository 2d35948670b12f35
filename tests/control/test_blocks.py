"""Controllers as blocks: the same commands as the controllers, and what their guard does."""

import casadi as ca
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.control import (
    PID,
    BlockController,
    InverseDynamics,
    KalmanFilter,
    OffsetFree,
    OpenLoop,
    PointPid,
    PressureLoop,
    block,
    chain,
    kalman,
    lqr,
    tvlqr,
)
from pam_ocp.control.blocks.guard import guarded
from pam_ocp.control.estimators.stationary import WithEstimate
from pam_ocp.control.kinds import BLOCKS
from pam_ocp.control.references import sine
from pam_ocp.core.block import Block
from pam_ocp.core.errors import UnknownNameError

MUSCLE = pam.muscle("DMSP-20-300")
REST = {"x": 0.002, "stiffness": 2.2e4}
STEP = 2e-3


@pytest.fixture(scope="module")
def slide():
    return pam.AntagonisticSlide(MUSCLE, mass=2.0)


@pytest.fixture(scope="module")
def valved():
    return pam.AntagonisticSlide(MUSCLE, mass=2.0, feed=pam.feeds.SpoolValve())


def same_commands(controller, plant, told=None, made=None, duration=0.15, least=0.02, **loop):
    """The closed loops with the controller and with its block have the same inputs, which move."""
    made = made or block(controller, plant=plant)
    loop = {"sample_time": made.sample_time, "noise": {}, **loop}
    plain = pam.closed_loop(controller, plant, duration=duration, **loop)
    loop = {k: v for k, v in loop.items() if k not in ("reference", "estimator")}
    found = pam.closed_loop(BlockController(made, told), plant, duration=duration, **loop)
    for v in plant.inputs:
        assert np.ptp(plain[v.name]) > least * v.nominal
        assert np.abs(plain[v.name] - found[v.name]).max() < 1e-10 * v.nominal


def step_of(t):
    return 0.002 + 0.005 * (t > 0.05)


def test_pid_about_a_point_as_a_block_gives_the_same_commands(valved):
    """Until inputs meet their ends, and back from there."""
    law = PointPid(valved, valved.equilibrium(REST), 10.0, 20.0, 0.02, sample_time=STEP)

    def far(t):
        return 0.002 + 0.15 * (0.05 < t < 0.1)

    same_commands(law, valved, lambda t: {"wanted.x": far(t)}, reference={"x": far})
    ran = pam.closed_loop(law, valved, {"x": far}, duration=0.15, noise={})
    assert max(np.ptp(ran[v.name]) for v in valved.inputs) > 0.9 * valved.inputs[0].max


def test_offset_free_feedback_as_a_block_gives_the_same_commands(valved):
    commands = {v.name: 0.1 for v in valved.inputs}
    measured = {"x": 1e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    estimator = kalman(valved, REST, measured=measured, disturbances=commands, sample_time=STEP)
    feedback = lqr(valved, REST, sample_time=STEP)
    same_commands(OffsetFree(feedback, estimator, ["x"], {"x": 0.004}), valved, noise={"x": 1e-5})


def test_offsets_of_a_regulators_command_are_estimated_in_a_block_as_in_python(slide):
    known = {"measured": {"x": 1e-5}, "disturbances": {"muscle1.command": 1e4}}
    estimator = kalman(slide, REST, **known, sample_time=STEP)
    feedback = lqr(slide, REST, sample_time=STEP)
    same_commands(OffsetFree(feedback, estimator, ["x"], {"x": 0.002}), slide, noise={"x": 1e-5})


def test_lqg_as_a_block_gives_the_same_commands(slide):
    estimator = kalman(slide, REST, measured={"x": 1e-5}, sample_time=STEP)
    law = WithEstimate(lqr(slide, REST, sample_time=STEP), estimator)
    for guard in (True, False):
        same_commands(law, slide, made=block(law, plant=slide, guard=guard))


def test_feedback_along_a_motion_and_the_motion_alone_give_the_same_commands(valved):
    feedback = lqr(valved, REST, integral={"x": 80.0}, sample_time=STEP)
    run = pam.closed_loop(feedback, valved, {"x": step_of}, duration=0.1)
    along = tvlqr(valved, run.trajectory, integral={"x": 50.0}, sample_time=STEP)
    same_commands(along, valved)
    same_commands(OpenLoop(valved, run.trajectory, STEP), valved)


def test_an_extended_filter_and_a_feedback_in_a_chain_give_the_same_commands(slide):
    feedback = lqr(slide, REST, sample_time=STEP)
    known = {"measured": {"x": 1e-5, "muscle1.pressure": 500.0}, "unknown": {"mass": (0.2, 0.01)}}
    estimator = KalmanFilter(slide, sample_time=STEP, **known)
    made = block(chain([estimator, feedback]), plant=slide)
    same_commands(feedback, slide, made=made, estimator=estimator, noise={"x": 1e-5})


def test_a_motion_inverse_dynamics_and_pressure_loops_in_a_chain_feed_forward(valved):
    """The commands that the controllers give for the motion, sample by sample."""
    t = STEP * np.arange(60)
    x, v, a = (np.array(n) for n in zip(*map(sine(0.0, 0.006, 2.0), t), strict=True))
    columns = {"x": x, "v": v, "stiffness": np.full(60, 2.2e4), "acceleration": a}
    variables = [valved.variable(n) for n in ("x", "v", "stiffness")]
    variables.append(pam.Variable("acceleration", "output", unit="m/s2"))
    motion = pam.Trajectory(t, columns, variables)
    inverse, loop = InverseDynamics(valved), PressureLoop(valved)
    parts = [block(part, sample_time=STEP, guard=False) for part in (motion, inverse, loop)]
    controller = BlockController(block(chain(parts), plant=valved))
    rng = np.random.default_rng(3)
    for k in range(60):
        seen = {f"muscle{i}.pressure": rng.uniform(1e5, 6e5) for i in (1, 2)}
        p = inverse(x[k], v[k], a[k], 2.2e4)
        expected = loop({"muscle1": p[0], "muscle2": p[1]}, seen)
        ends = valved.variable("muscle1.command")
        expected = {n: min(max(u, ends.min), ends.max) for n, u in expected.items()}
        assert controller(0.0, seen) == pytest.approx(expected, abs=1e-10)


def test_there_is_a_block_of_every_kind_of_controller():
    kinds = {"StateFeedback", "OffsetFree", "WithEstimate", "StationaryFilter", "KalmanFilter"}
    kinds |= {"ScheduledFeedback", "TrajectoryFeedback", "OpenLoop", "PositionController"}
    kinds |= {"PressureLoop", "InverseDynamics", "HysteresisCompensation", "PID", "Trajectory"}
    kinds |= {"PointPid"}
    assert kinds <= set(BLOCKS)


# ---- the guard ---------------------------------------------------------------------------------
def pid_block(**guard):
    """kp = 2, ki = 10, at 10 ms; the commands may be -1 .. 1."""
    guard = {"limits": {"command": (-1.0, 1.0)}, **guard}
    return block(PID(2.0, 10.0), sample_time=0.01, **guard)


def commands_of(made, rows):
    """Outputs of steps with these inputs; inputs not named are 0, ``enable`` is 1."""
    controller, found = BlockController(made), []
    for row in rows:
        controller(0.0, {"wanted.measured": 0.0, "measured": 0.0, "enable": 1.0, **row})
        found.append(controller.outputs)
    return found


def test_a_pid_block_is_the_sum_that_its_formula_says():
    rng = np.random.default_rng(5)
    errors = 0.02 * rng.standard_normal(50)
    found = commands_of(pid_block(), [{"wanted.measured": e} for e in errors])
    expected = 2.0 * errors + 10.0 * 0.01 * np.cumsum(errors)
    assert np.allclose([f["command"] for f in found], expected, rtol=0, atol=1e-14)


def test_an_integral_does_not_wind_up_at_a_limit():
    away = [{"wanted.measured": 1.0}] * 100
    found = commands_of(pid_block(), [*away, {"wanted.measured": -0.01}])
    assert found[50]["command"] == 1.0
    assert found[50]["status"] == 8
    assert found[-1]["command"] < 0.3  # with 1 s of wind-up it would stay at 1


def test_a_missing_measurement_is_held_and_then_the_command_is_the_safe_one():
    made = pid_block(hold=3, safe={"command": -0.5})
    seen = [{"measured": -0.1}] * 5 + [{"measured": np.nan}] * 6 + [{"measured": -0.1}] * 2
    found = commands_of(made, seen)
    status = [f["status"] for f in found]
    assert status == [0] * 5 + [2] * 3 + [6] * 3 + [0] * 2
    assert found[5]["command"] == pytest.approx(2 * 0.1 + 10 * 0.01 * 0.6)
    assert [f["command"] for f in found[8:11]] == [-0.5] * 3


def test_before_the_first_measurement_the_command_is_the_safe_one():
    made = pid_block(safe={"command": 0.25})
    found = commands_of(made, [{"measured": np.inf}] * 2 + [{"measured": 0.0}])
    assert [f["command"] for f in found[:2]] == [0.25, 0.25]
    assert found[0]["status"] == 6


@pytest.mark.parametrize("ki", [10.0, 0.0])
def test_switching_on_begins_at_the_command_that_stands(ki):
    """By the integral where there is one; else the difference fades with its time constant."""
    guard = {"limits": {"command": (-1.0, 1.0)}, "safe": {"command": 0.6}, "fade_time": 0.05}
    made = block(PID(2.0, ki), sample_time=0.01, **guard)
    off, on = [{"enable": 0.0, "measured": -0.1}] * 20, [{"measured": -0.1}] * 30
    found = [f["command"] for f in commands_of(made, [*off, *on])]
    assert found[19] == 0.6
    assert found[20] == pytest.approx(0.6, abs=1e-12)
    if ki:
        assert found[21] == pytest.approx(0.6 + 10 * 0.01 * 0.1)
    else:
        left = (0.05 / 0.06) ** np.arange(30)
        assert found[20:] == pytest.approx(0.2 + 0.4 * left)


def test_lqi_goes_on_from_the_commands_that_acted_while_it_was_off(slide):
    feedback = lqr(slide, REST, integral={"x": 80.0, "stiffness": 5.0}, sample_time=STEP)
    safe = {"muscle1.command": 3.1e5, "muscle2.command": 2.4e5}
    controller = BlockController(block(feedback, safe=safe))
    at = dict(zip((v.name for v in slide.states), feedback.point.x, strict=True))
    at |= {"stiffness": 2.2e4, "x": 0.0021}
    for _ in range(5):
        assert controller(0.0, {**at, "enable": 0.0}) == safe
    assert controller(0.0, {**at, "enable": 1.0}) == pytest.approx(safe, rel=1e-9)
    names = [v.name for v in controller.block.memory]
    fading = [controller.memory[names.index(f"fade.{n}")] for n in safe]
    assert np.abs(fading).max() < 1.0  # [Pa]: two integrals follow two commands


def test_rates_are_kept_and_told():
    made = pid_block(rates={"command": 2.0})
    found = commands_of(made, [{"wanted.measured": 0.4}] * 5)
    assert np.allclose(np.diff([0.0, *(f["command"] for f in found)]), 0.02)
    assert all(f["status"] == 16 for f in found)


def test_what_is_no_number_is_never_sent(slide):
    """Whatever comes in, for thousands of random steps."""
    feedback = lqr(slide, REST, integral={"x": 80.0}, sample_time=STEP)
    made = block(feedback)
    rng = np.random.default_rng(8)
    memory, p = made.start("memory"), made.start("parameters")
    absurd = np.array([np.nan, np.inf, -np.inf, 1e29, -1e29, 0.0])
    low, high = (np.array([getattr(v, a) for v in made.outputs]) for a in ("min", "max"))
    for _ in range(3000):
        size = len(made.inputs)
        wrong, usual = rng.choice(absurd, size), rng.standard_normal(size)
        values = np.where(rng.random(size) < 0.2, wrong, usual)
        memory, outputs = (np.asarray(m).ravel() for m in made.step(memory, values, p))
        assert np.all(np.isfinite(memory))
        assert np.all((outputs >= low) & (outputs <= high))


@pytest.mark.parametrize("symbol", [ca.SX, ca.MX])
def test_all_memory_stays_where_one_of_it_would_be_no_number(symbol):
    memory, y, none = (symbol.sym(n, size) for n, size in (("m", 2), ("y", 1), ("p", 0)))
    after = [memory[0] + 1 / y, memory[1] + 1]
    step = ca.Function("step", [memory, y, none], [ca.vertcat(*after), memory[1]])
    ends = (pam.Variable("y", "input"),), (pam.Variable("command", "output", min=-9.0, max=9.0),)
    kept = tuple(pam.Variable(n, "state", start=0.0) for n in ("sum", "count"))
    law = Block("sums", STEP, *ends, (), kept, step, commands=("command",))
    made = guarded(law)
    state, told = made.start("memory"), []
    for value in (1.0, 2.0, 0.0, 4.0):
        state, outputs = made.step(state, [value, 1.0], made.start("parameters"))
        told.append([*np.asarray(state).ravel()[:2], *np.asarray(outputs).ravel()])
    # sum and count after each step; the command, which is the count before it and begins anew where
    # it stands; 32: the law gave no number
    assert told == [[1, 1, 0, 0], [1.5, 2, 1, 0], [1.5, 2, 1, 32], [1.75, 3, 1, 0]]


def test_a_filter_goes_on_without_what_is_missing(slide):
    """With nothing measured it predicts: the model's own step."""
    estimator = kalman(slide, REST, measured={"x": 1e-5}, sample_time=STEP)
    made = block(estimator, guard=False)
    names = [v.name for v in made.inputs]
    memory, p = made.start("memory"), made.start("parameters")
    values = np.zeros(len(names))
    values[names.index("x")] = 0.0025
    for n in ("muscle1.command", "muscle2.command"):
        values[names.index(f"sent.{n}")] = estimator.point[n]
    memory, first = (np.asarray(m).ravel() for m in made.step(memory, values, p))
    values[names.index("x")] = np.nan
    _, second = (np.asarray(m).ravel() for m in made.step(memory, values, p))
    x0 = estimator.point.x
    expected = x0 + np.asarray(estimator.system.A) @ (first - x0)
    assert np.allclose(second, expected, rtol=1e-12)


def test_gains_have_units_and_limits_may_be_texts(slide):
    feedback = lqr(slide, REST, integral={"x": 80.0}, sample_time=STEP)
    made = block(feedback, limits={"muscle1.command": ("0.5 bar", "4 bar")})
    found = {v.name: v for v in made.parameters}
    assert found["K.muscle1.command.x"].unit == "Pa/m"
    assert found["K.muscle1.command.v"].unit == "Pa.s/m"
    assert found["K.muscle1.command.muscle2.pressure"].unit == "1"
    assert found["min.muscle1.command"].start == 0.5e5


def test_the_loop_tells_a_block_what_to_reach(hanging):
    point = hanging.equilibrium(x=0.04)
    feedback = lqr(hanging, point, integral={"x": 100.0}, sample_time=STEP)
    controller = BlockController(block(feedback))
    loop = pam.closed_loop(controller, hanging, {"x": 0.042}, duration=1.0, start=point)
    assert loop.steady_error("x", 0.1) < 1e-5
    refused("is not told v", pam.closed_loop, controller, hanging, {"v": 0.1}, duration=0.1)


# ---- refused ------------------------------------------------------------------------------------
def test_what_cannot_be_a_block_is_refused_in_one_sentence(slide, hanging):
    feedback = lqr(slide, REST, sample_time=STEP)
    refused("not known as a block", block, object())
    refused("for another plant", block, feedback, plant=hanging)
    refused("limits=", block, PID(1.0))
    refused("command", block, feedback, error=UnknownNameError, rates={"muscle3.command": 1e6})
    refused("outside", block, feedback, safe={"muscle1.command": 1e9})
    refused("beyond the command's range", block, feedback, limits={"muscle1.command": (-1.0, 1e5)})
    refused("option of a StateFeedback", block, feedback, error=UnknownNameError, gain=3.0)
    refused("guarded already", block, block(feedback))
    refused("PID.kp = inf must be a finite number", PID, float("inf"))
    changed = PID(1.0)
    changed.kp = float("inf")
    refused("must be finite", block, changed, limits={"command": (-1, 1)})


def test_chains_that_do_not_fit_are_refused(slide):
    feedback = lqr(slide, REST, sample_time=STEP)
    estimator = kalman(slide, REST, measured={"x": 1e-5}, sample_time=1e-3)
    refused("sample_time", chain, [estimator, feedback])
    refused("named", chain, [feedback, feedback])
    estimator = kalman(slide, REST, measured={"x": 1e-5}, sample_time=STEP)
    given = [estimator, feedback], {"state_feedback.y": "filter.estimate.x"}
    refused("y", chain, *given, error=UnknownNameError)
    refused("counts in", chain, [estimator, feedback], {"state_feedback.v": "filter.estimate.x"})
    given = [estimator, feedback], {"feedback.x": "filter.estimate.x"}
    refused("part of the chain", chain, *given, error=UnknownNameError)


def test_what_is_no_plant_and_no_controller_is_named(hanging):
    refused("plant is an int", block, PID(1.0, 0.1), plant=5)
    refused("mpc_block: controller is a str: give an Mpc", pam.control.mpc_block, "x")
    refused("plant is an int", PointPid, 5, {}, proportional=1.0)
    refused("PointPid: at is an int", PointPid, hanging, 3, proportional=1.0)
    refused("plant is a dict", pam.export.save_ssv, {"a": 1}, "a.ssv")


def test_numbers_may_be_texts_with_units():
    ends = {"command": (-1.0, 1.0)}
    plain = block(PID(3.0, 10.0, 0.1, 4e-3), sample_time=2e-3, limits=ends, fade_time=0.02)
    texts = PID("3", 10, "0.1", "4 ms")  # type: ignore[arg-type]
    told = block(texts, sample_time="2 ms", limits=ends, fade_time="20 ms")
    assert told.sample_time == plain.sample_time
    assert np.array_equal(told.start("parameters"), plain.start("parameters"))
    plant = pam.HangingLoad(MUSCLE, 10.0)
    seen = KalmanFilter(plant, sample_time=STEP, measured={"x": "0.1 mm"})  # type: ignore[dict-item]
    assert seen.deviations == {"x": pytest.approx(1e-4)}

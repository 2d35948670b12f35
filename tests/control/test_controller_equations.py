"""Controllers and filters, call by call, against the same equations written down by hand."""

import pickle

import numpy as np
import pytest

import pam_ocp as pam
from pam_ocp.control import (
    PID,
    BlockController,
    InverseDynamics,
    KalmanFilter,
    OffsetFree,
    PointPid,
    PositionController,
    PressureLoop,
    block,
    kalman,
    lqr,
    scheduled_lqr,
    tvlqr,
)
from pam_ocp.control.references import sine

MUSCLE = pam.muscle("DMSP-20-300")
REST = {"x": 0.002, "stiffness": 2.2e4}
STEP = 2e-3


@pytest.fixture(scope="module")
def slide():
    return pam.AntagonisticSlide(MUSCLE, mass=2.0)


@pytest.fixture(scope="module")
def point(slide):
    return slide.equilibrium(REST)


def seen(plant, point, count=40, seed=1, size=0.1):
    """Random measurements about a point: all states and outputs by name."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield {
            v.name: float(point[v.name] + size * v.nominal * rng.standard_normal())
            for v in (*plant.states, *plant.outputs)
        }


def states(plant, measured):
    return np.array([measured[v.name] for v in plant.states])


def ends(plant, names):
    """Lowest and highest values of inputs."""
    return np.transpose([(plant.variable(n).min, plant.variable(n).max) for n in names])


def compared(commands, names, u, rtol=1e-10):
    assert [commands[n] for n in names] == pytest.approx(u, rel=rtol)


def test_lqi_integrates_but_at_the_ends_of_the_inputs(slide, point):
    law = lqr(slide, REST, integral={"x": 80.0, "stiffness": 5.0}, sample_time=STEP)
    u0 = np.array([point[n] for n in law.inputs])
    low, high = ends(slide, law.inputs)
    integral, frozen = np.zeros(2), np.zeros(2)
    goal = np.array([point["x"], point["stiffness"]])
    for measured in seen(slide, point, size=0.5):
        u = u0 - law.K @ (states(slide, measured) - point.x) - law.Ki @ integral
        compared(law(0.0, measured), law.inputs, u)
        error = np.array([measured["x"], measured["stiffness"]]) - goal
        further = -law.Ki * error * (u - np.clip(u, low, high))[:, None]  # what each would add
        held = np.any(further > 0, axis=0)
        integral += np.where(held, 0.0, STEP * error)
        frozen += held
    assert np.all((frozen > 0) & (frozen < 40))
    law.reset()
    first = next(seen(slide, point))
    compared(law(0.0, first), law.inputs, u0 - law.K @ (states(slide, first) - point.x))
    law.K[:] *= 2  # a gain that was changed by hand counts
    law.reset()
    compared(law(0.0, first), law.inputs, u0 - law.K @ (states(slide, first) - point.x))


def test_a_copy_of_a_block_in_the_loop_goes_on_where_it_stands(slide, point):
    law = BlockController(block(lqr(slide, REST, integral={"x": 80.0}, sample_time=STEP)))
    first, second, *_ = seen(slide, point)
    law(0.0, {**first, "x": 0.003})
    other = pickle.loads(pickle.dumps(law))
    assert other(STEP, second) == law(STEP, second)
    law.reset()
    assert other(STEP, second) != law(STEP, second)


def test_pid_about_a_point_filters_its_derivative_and_freezes_its_integral(slide, point):
    p, i, d, filter_time = 2e7, 4e8, 1e5, 5e-3
    law = PointPid(slide, point, p, i, d, sample_time=STEP)
    names = [*law.shares]
    low, high = ends(slide, names)
    weights, u0 = np.array([*law.shares.values()]), np.array([point[n] for n in names])
    integral, slope, last, full, frozen = 0.0, 0.0, None, 0.0, 0
    for measured in seen(slide, point, seed=2, size=2.0):
        error = point["x"] - measured["x"]
        if last is not None:
            share = filter_time / (filter_time + STEP)
            slope = share * slope + (1 - share) * (error - last) / STEP
        last = error
        if full * error > 0:  # the integral would go further out
            frozen += 1
        else:
            integral += error * STEP
        asked = u0 + weights * (p * error + i * integral + d * slope)
        compared(law(0.0, measured), names, np.clip(asked, low, high))
        out = np.sign(asked - np.clip(asked, low, high)) * weights
        full = out[0] if np.all(out == out[0]) else 0.0
    assert frozen > 0


def test_an_input_without_a_part_in_the_loop_does_not_wind_it_up(slide, point):
    first, second = (v.name for v in slide.inputs)
    alone, both = (
        PointPid(slide, point, 1e6, 5e7, weights=weights, sample_time=STEP)
        for weights in ({first: 1.0}, {first: 1.0, second: 0.0})
    )
    for error in (0.1,) * 50 + (-0.1,) * 20:
        measured = {"x": point["x"] - error}
        assert both(0.0, measured)[first] == alone(0.0, measured)[first]


def test_a_stationary_filter_is_its_linear_system_with_its_gain(slide, point):
    law = kalman(slide, REST, measured={"x": 1e-4, "stiffness": 50.0}, sample_time=STEP)
    a, b, c, d = (np.asarray(getattr(law.system, n)) for n in "ABCD")
    deviation, moved = np.zeros(len(a)), np.zeros(b.shape[1])
    y0 = np.array([point["x"], point["stiffness"]])
    rng = np.random.default_rng(3)
    for measured in seen(slide, point):
        y = np.array([measured["x"], measured["stiffness"]])
        deviation = deviation + law.gain @ (y - y0 - c @ deviation - d @ moved)
        assert law.correct(measured) == pytest.approx(point.x + deviation, rel=1e-10)
        sent = {v.name: float(point[v.name] + 2e5 * rng.standard_normal()) for v in slide.inputs}
        law.predict(sent)
        held = [np.clip(sent[v.name], v.min, v.max) for v in slide.inputs]
        moved = np.array(held) - point.u
        deviation = a @ deviation + b @ moved
    assert law.deviation == pytest.approx(deviation, rel=1e-10)


def test_offset_free_feedback_goes_to_the_rest_of_the_linear_plant_under_the_disturbance():
    """[A B; C 0] (x_d, u_d) = (-B_d d, goal), of least norm in units of nominal."""
    plant = pam.AntagonisticSlide(MUSCLE, 2.0, loads=pam.loads.ExternalForce("push"))
    rest = plant.equilibrium(REST)

    def observer():
        drift = {"push": 1.0}
        return kalman(plant, rest, measured={"x": 1e-4}, disturbances=drift, sample_time=STEP)

    feedback, beside = lqr(plant, rest, sample_time=STEP), observer()
    law = OffsetFree(feedback, observer(), ["x"], {"x": 0.003})
    system = pam.linearize(plant, rest, outputs=["x"])
    a, b, c = (np.asarray(getattr(system, n)) for n in "ABC")
    names = [v.name for v in plant.inputs]
    chosen, push = [names.index(n) for n in feedback.inputs], names.index("push")
    nx, nu = len(a), len(chosen)
    moving = (*plant.states, *(plant.inputs[i] for i in chosen))
    size = np.array([v.nominal for v in moving])
    matrix = np.block([[a, b[:, chosen]], [c, np.zeros((1, nu))]]) * size
    scale = np.append(size[:nx], plant.variable("x").nominal)[:, None]
    for measured in seen(plant, rest, 10):
        x = beside.correct(measured)
        found = beside.disturbance["push"] - rest["push"]
        right = np.append(-b[:, push] * found, 0.003 - rest["x"])[:, None]
        moved = size * np.linalg.lstsq(matrix / scale, right / scale, rcond=1e-12)[0].ravel()
        u = rest.u[chosen] + moved[nx:] - feedback.K @ (x - rest.x - moved[:nx])
        expected = np.clip(u, *ends(plant, feedback.inputs))
        sent = law(0.0, measured)
        compared(sent, feedback.inputs, expected, rtol=1e-6)
        beside.predict(sent)


def test_scheduled_feedback_is_linear_between_the_points_of_its_grid(slide):
    axes = {"x": [-0.01, 0.01], "stiffness": [2e4, 2.3e4]}
    place = {"x": 0.005, "stiffness": 2.1e4}
    law = scheduled_lqr(slide, axes, lambda t: place, sample_time=STEP)
    at = {"x": 0.75, "stiffness": 1 / 3}
    corners = np.outer([1 - at["x"], at["x"]], [1 - at["stiffness"], at["stiffness"]])

    def mean(values):
        return np.tensordot(corners, values, 2)

    columns = [[v.name for v in slide.inputs].index(n) for n in law.family.inputs]
    for measured in seen(slide, slide.equilibrium(REST), 5):
        deviation = states(slide, measured) - mean(law.family.x)
        u = mean(law.family.u)[columns] - mean(law.K) @ deviation
        compared(law(0.0, measured), law.family.inputs, u)


def test_feedback_along_a_motion_takes_gains_and_motion_of_the_moment(slide):
    feedback = lqr(slide, REST, integral={"x": 80.0}, sample_time=STEP)
    run = pam.closed_loop(feedback, slide, {"x": lambda t: 0.002 + 0.004 * t}, duration=0.1)
    law = tvlqr(slide, run.trajectory, integral={"x": 50.0}, sample_time=STEP)
    names, integral = [v.name for v in slide.states], np.zeros(1)

    def at(values, times, t):
        flat = values.reshape(len(values), -1)
        row = [np.interp(t, times, column) for column in flat.T]
        return np.reshape(row, values.shape[1:])

    motion = run.trajectory
    measurements = seen(slide, slide.equilibrium(REST), 20)
    for t, measured in zip((0.0131 + STEP * np.arange(20)).tolist(), measurements, strict=True):
        x0 = at(motion.array(names), motion.t, t)
        u = law._open.planned(t) - at(law.K, law.t, t) @ (states(slide, measured) - x0)
        u = u - at(law.Ki, law.t, t) @ integral
        compared(law(t, measured), law.inputs, u)
        low, high = ends(slide, law.inputs)
        if np.all((u >= low) & (u <= high)):
            integral = integral + STEP * (measured["x"] - at(motion["x"], motion.t, t))
    assert abs(integral[0]) > 0


def test_position_control_is_pid_inverse_dynamics_and_pressure_loops_in_turn(slide, point):
    path, gains = sine(0.0, 0.012, 3.0), PID.placed(3.0)
    inverse, loop = InverseDynamics(slide), PressureLoop(slide, time_constant=0.02)
    how = {"stiffness": 2.2e4, "inner": loop}
    law = PositionController(slide, path, PID.placed(3.0), sample_time=STEP, **how)
    pid, full = PID(gains.kp, gains.ki, gains.kd, gains.filter_time), False
    for k, measured in enumerate(seen(slide, point)):
        x, v, a = path(k * STEP)
        p = inverse(x, v, a + pid(x - measured["x"], STEP, full), 2.2e4)
        full = bool(np.all((p <= inverse.low) | (p >= inverse.high)))
        expected = loop(dict(zip(inverse.muscles, p.tolist(), strict=True)), measured)
        compared(law(k * STEP, measured), [*expected], [*expected.values()], rtol=1e-9)
    with pytest.raises(pam.InputError, match="give a stiffness for a pair"):
        PositionController(slide, path, gains, sample_time=STEP)(0.0, measured)


def test_an_extended_filter_is_that_of_finite_differences_and_joint_measurements(slide, point):
    """Of the model's own step, whose Jacobians are those of differences here."""
    known = {"measured": {"x": 1e-4, "muscle1.pressure": 2e3}, "unknown": {"mass": (0.3, 0.1)}}
    filter = KalmanFilter(slide, sample_time=STEP, start=point, **known)
    sent = {v.name: float(point[v.name]) + 3e4 for v in slide.inputs}
    scale, n = filter._scale, len(filter._scale)
    rows = np.eye(n)[[filter.names.index(m) for m in ("x", "muscle1.pressure")]]
    noise = np.diag((np.array([1e-4, 2e3]) / (rows @ scale)) ** 2)
    u, q = filter._inputs(sent), filter.given.vector()

    def step(z):
        return np.asarray(filter._predict(z, u, q)[0]).ravel()

    z, p = filter._z.copy(), filter.covariance.copy()
    for measured in seen(slide, point, 5):
        y = np.array([measured["x"], measured["muscle1.pressure"]]) / (rows @ scale)
        gain = p @ rows.T @ np.linalg.inv(rows @ p @ rows.T + noise)
        z, p = z + gain @ (y - rows @ z), p - gain @ rows @ p
        known = {k: measured[k] for k in ("x", "muscle1.pressure")}
        state = [*filter.correct(known, sent).state.values()]
        assert state == pytest.approx((z * scale)[: n - 1], rel=1e-9)
        slopes = [(step(z + 1e-5 * e) - step(z - 1e-5 * e)) / 2e-5 for e in np.eye(n)]
        half = np.asarray(filter._predict(z, u, q)[2])
        a, density = np.transpose(slopes), filter._density
        added = a @ density @ a.T + 4 * half @ density @ half.T + density
        z, p = step(z), a @ p @ a.T + STEP / 6 * added
        filter.predict(sent)
        assert filter.covariance == pytest.approx(p, rel=1e-5, abs=1e-12)

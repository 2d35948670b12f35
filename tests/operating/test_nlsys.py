"""A plant as python-control's NonlinearIOSystem."""

import copy
import pickle
import threading

import control
import numpy as np
import pytest
from conftest import BAR, flat, refused

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.operating.plant_system import as_nlsys


def tight(plant, rtol=1e-11):
    return {"rtol": rtol, "atol": rtol * plant.vector("state", attribute="nominal")}


@pytest.fixture
def wave():
    t = np.linspace(0.0, 0.6, 121)
    return t, np.vstack([3 * BAR + BAR * np.sin(15 * t), 3 * BAR - BAR * np.sin(15 * t)])


@pytest.fixture
def system(slide):
    return as_nlsys(slide, slide.equilibrium(x=0.0, stiffness=2.2e4))


def test_python_control_and_simulate_compute_the_same_motion(slide, system, wave):
    t, u = wave
    motion = pam.simulate(
        slide,
        {"muscle1.command": u[0], "muscle2.command": u[1]},
        t=t,
        interpolation="linear",
        start={v.name: x for v, x in zip(slide.states, system.x0, strict=True)},
    )
    response = control.input_output_response(
        system, t, u, system.x0, solve_ivp_method="DOP853", solve_ivp_kwargs=tight(slide)
    )
    names = [v.name for v in (*slide.states, *slide.outputs)]
    nominal = np.array([slide.variable(n).nominal for n in names])
    difference = np.abs(np.asarray(response.outputs).T - motion.array(names)) / nominal
    assert difference.max() < 1e-6
    own = system.response(t, u)
    assert np.allclose(own.outputs.T, motion.array(names), rtol=0, atol=1e-9 * nominal)
    assert own.output_labels == response.output_labels


def test_signals_and_parameters_have_the_plants_names_with_underscores(slide, system):
    assert system.input_labels == ["muscle1_command", "muscle2_command"]
    assert system.state_labels == ["x", "v", "muscle1_pressure", "muscle2_pressure"]
    assert system.params["muscle1_lag"] == 0.05
    assert system.units["muscle1_pressure"] == "Pa"
    assert system.units["stiffness"] == "N/m"


def test_parameters_change_by_python_controls_params(slide, system):
    x, u = np.array([0.002, 0.1, 2e5, 3e5]), np.array([3e5, 3e5])
    heavy = slide.with_values(mass=3.0)
    expected = flat(slide.function(x, u, heavy.vector("parameter"))[0])
    assert system.dynamics(0.0, x, u, params={"mass": 3.0}) == pytest.approx(expected, rel=1e-14)
    light = flat(slide.function(x, u, slide.vector("parameter"))[0])
    assert system.dynamics(0.0, x, u) == pytest.approx(light, rel=1e-14)
    assert system.updfcn(0.0, x, u, {"mass": 3.0}) == pytest.approx(expected, rel=1e-14)


def test_a_parameter_outside_its_range_is_refused(system):
    with pytest.raises(InputError, match="mass: value = -1 kg is outside"):
        system.dynamics(0.0, system.x0, system.u0, params={"mass": -1.0})


def test_inputs_left_out_are_held_at_the_point(slide):
    point = slide.equilibrium(x=0.003, stiffness=2.2e4)
    one = as_nlsys(slide, point, inputs=["muscle1.command"], outputs=["x"])
    assert one.ninputs == 1
    assert one.u0 == pytest.approx([point["muscle1.command"]])
    assert np.abs(one.dynamics(0.0, one.x0, one.u0)).max() < 1e-3  # Pa/s among the states
    refused("inputs: x is a state", as_nlsys, slide, inputs=["x"])


def test_linearize_of_python_control_is_exact_here(slide, system):
    there = control.linearize(system, system.x0, system.u0)
    point = slide.equilibrium(x=0.0, stiffness=2.2e4)
    ours = slide.linearize(point)
    for name in "ABCD":
        assert getattr(there, name) == pytest.approx(getattr(ours, name), rel=1e-12, abs=1e-12)
    heavy = control.linearize(system, system.x0, system.u0, params={"mass": 4.0})
    assert heavy.A[1, 0] == pytest.approx(there.A[1, 0] / 2, rel=1e-12)


def test_find_operating_point_finds_the_equilibrium(hanging):
    point = hanging.equilibrium(x=0.06)
    system = as_nlsys(hanging, point, outputs=["x"])
    guess = point.x + np.array([2e-3, 0.0, 1e4])
    found = control.find_operating_point(system, guess, point.u, root_kwargs={"tol": 1e-13})
    assert found.states == pytest.approx(point.x, rel=1e-8, abs=1e-10)


def test_interconnected_with_a_controller_it_is_the_closed_loop_of_linear_theory(hanging):
    point = hanging.equilibrium(x=0.06)
    plant = as_nlsys(hanging, point, outputs=["x"])
    gain = 2e6
    controller = control.nlsys(
        None,
        lambda t, x, u, p: point["muscle.command"] + gain * (u[0] - u[1]),
        inputs=["r", "x"],
        outputs=["muscle_command"],
        name="controller",
    )
    loop = control.interconnect([plant, controller], inputs=["r"], outputs=["x"])
    t, small = np.linspace(0, 0.5, 51), 1e-6
    kwargs = {"rtol": 1e-10, "atol": 1e-10 * hanging.vector("state", attribute="nominal")}
    response = control.input_output_response(
        loop, t, np.full_like(t, 0.06 + small), plant.x0, solve_ivp_kwargs=kwargs
    )
    linear = hanging.linearize(point, outputs=["x"])
    closed = control.feedback(gain * linear, 1)
    expected = np.asarray(control.forced_response(closed, t, np.full_like(t, small)).outputs)
    assert np.asarray(response.outputs) - 0.06 == pytest.approx(
        expected, abs=1e-3 * float(np.abs(expected).max())
    )


def test_a_phase_plane_is_drawn_of_an_autonomous_plant(long_muscle):
    plant = pam.HangingLoad(long_muscle, feed=pam.feeds.IdealPressure())
    point = plant.equilibrium(x=0.06)
    system = as_nlsys(plant, point, inputs=[])
    assert (system.ninputs, system.nstates) == (0, 2)
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    drawn = control.phase_plane_plot(
        system, [0.04, 0.08, -0.5, 0.5], 0.3, gridspec=[4, 4], plot_separatrices=False, ax=axes
    )
    assert drawn is not None
    assert len(axes.lines) > 0
    (mark,) = control.phaseplot.equilpoints(system, [0.04, 0.08, -0.5, 0.5], ax=axes)
    assert flat(mark.get_xydata()) == pytest.approx([0.06, 0.0], abs=1e-6)


# ---- sampled -------------------------------------------------------------------------------------
def test_a_sampled_system_moves_as_simulate_does_under_held_inputs(slide, wave):
    t, u = wave
    system = as_nlsys(slide, slide.equilibrium(x=0.0, stiffness=2.2e4), dt=5e-3)
    motion = pam.simulate(
        slide,
        {"muscle1.command": u[0], "muscle2.command": u[1]},
        t=t,
        start={v.name: x for v, x in zip(slide.states, system.x0, strict=True)},
    )
    names = [v.name for v in (*slide.states, *slide.outputs)]
    nominal = np.array([slide.variable(n).nominal for n in names])
    assert np.ptp(motion["x"]) > 1e-3
    for response in (control.input_output_response(system, t, u, system.x0), system.response(t, u)):
        difference = np.abs(np.asarray(response.outputs).T - motion.array(names)) / nominal
        assert difference.max() < 1e-6


def test_a_sampled_system_is_linearised_by_the_derivatives_of_its_step(slide):
    point, dt = slide.equilibrium(x=0.003, stiffness=2.2e4), 0.01
    at_rest = control.linearize(as_nlsys(slide, point, dt=dt), point.x, point.u)
    exact = slide.linearize(point, dt=dt)  # at rest: the matrix exponential
    assert at_rest.dt == dt
    n, e = slide.vector("state", attribute="nominal"), slide.vector("input", attribute="nominal")
    scaled = lambda g: (g.A * n / n[:, None], g.B * e / n[:, None])  # noqa: E731
    for found, expected in zip(scaled(at_rest), scaled(exact), strict=True):
        assert np.allclose(found, expected, rtol=0, atol=1e-8)
    system, x = (
        as_nlsys(slide, point, inputs=["muscle1.command"], dt=dt, rtol=1e-12),
        point.x.copy(),
    )
    x[1:] += [0.2, 4e4, -3e4]  # in motion, by differences
    moving, h = control.linearize(system, x, point.u[:1]), 1e-4
    for i in range(4):
        step = h * n * np.eye(4)[i]
        slope = (system._rhs(0, x + step, point.u[:1]) - system._rhs(0, x - step, point.u[:1])) / 2
        assert np.asarray(moving.A)[:, i] * h * n[i] / n == pytest.approx(slope / n, abs=1e-9)


def test_a_sampled_plant_and_a_sampled_controller_are_closed_loops_closed_loop(slide):
    """python-control's interconnection of both, against the loop of this package."""
    point, dt = slide.equilibrium(x=0.003, stiffness=2.2e4), 2e-3
    feedback = pam.lqr(slide, point, sample_time=dt)
    plant = as_nlsys(slide, point, outputs=[v.name for v in slide.states], dt=dt)
    law = control.nlsys(
        None,
        lambda t, x, u, p: point.u - feedback.K @ (u - point.x),
        inputs=plant.output_labels,
        outputs=plant.input_labels,
        name="law",
        dt=dt,
    )
    loop = control.interconnect([plant, law], inputs=[], outputs=plant.output_labels)
    start = point.x + np.array([-1e-3, 0.0, 0.0, 0.0])
    t = dt * np.arange(101)
    found = control.input_output_response(loop, t, np.zeros((0, 101)), start)
    run = pam.closed_loop(
        feedback,
        slide,
        duration=0.2,
        sample_time=dt,
        start={v.name: x for v, x in zip(slide.states, start, strict=True)},
    )
    n = slide.vector("state", attribute="nominal")
    motion = run.trajectory
    assert np.abs(motion["x"] - point.x[0]).max() > 5e-4
    difference = (np.asarray(found.states).T - motion.array([v.name for v in slide.states])) / n
    assert np.abs(difference).max() < 1e-6


def test_a_sampling_time_and_inputs_of_the_wrong_shape_are_refused(slide, system):
    refused("dt = 0 s must be > 0", as_nlsys, slide, dt=0.0)
    refused(r"U has shape \(3,\)", system.response, np.linspace(0, 1, 11), [1e5, 1e5, 1e5])


def test_copies_and_pickles_have_memory_of_their_own(system):
    x, u = system.x0 + 1e-3, system.u0
    expected = system.dynamics(0.0, x, u)
    for other in (copy.deepcopy(system), pickle.loads(pickle.dumps(system))):
        first = other.dynamics(0.0, x, u)
        system.dynamics(0.0, 2 * x, u)
        assert first == pytest.approx(expected, rel=1e-14)
        assert other._state_buffers.holder is not system._state_buffers.holder


def test_threads_do_not_disturb_each_other(system):
    points = [system.x0 + np.array([k * 1e-4, k * 1e-2, 0, 0]) for k in range(4)]
    expected = [system._rhs(0.0, x, system.u0) for x in points]
    wrong = []

    def work(k):
        for _ in range(3000):
            if not np.array_equal(system._rhs(0.0, points[k], system.u0), expected[k]):
                wrong.append(k)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


def test_the_static_force_of_a_muscle_has_a_describing_function(long_muscle):
    """Force over length about 10 % at constant pressure: softening, so the gain falls from k."""
    p, middle, l0 = 3 * BAR, 0.10, long_muscle.rest_length
    centre = long_muscle.force(p, middle)

    def force(x):
        return float(centre - long_muscle.force(p, middle + float(np.squeeze(x)) / l0))

    gains = control.describing_function(force, [1e-5, 0.02], zero_check=False)
    assert np.real(gains[0]) == pytest.approx(long_muscle.stiffness(p, middle), rel=1e-4)
    assert np.real(gains[1]) != pytest.approx(np.real(gains[0]), rel=1e-3)

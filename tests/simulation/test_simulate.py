"""simulate against SciPy, against energy, and under failure."""

import math

import numpy as np
import pytest
from conftest import BAR, refused, scipy_states

import pam_ocp as pam
from pam_ocp import SimulationError
from pam_ocp.muscles.validity import ValidityWarning, forget_warnings


@pytest.mark.parametrize("interpolation", ["previous", "linear"])
def test_a_slide_under_random_commands_agrees_with_scipy(slide, interpolation):
    t = np.linspace(0.0, 0.5, 26)
    u = np.random.default_rng(4).uniform(2 * BAR, 5 * BAR, size=(2, 26))
    inputs = {"muscle1.command": u[0], "muscle2.command": u[1]}
    motion = pam.simulate(slide, inputs, t=t, interpolation=interpolation)

    def value(time):
        k = min(int(np.searchsorted(t, time, side="right")) - 1, len(t) - 2)
        part = (time - t[k]) / (t[k + 1] - t[k]) if interpolation == "linear" else 0.0
        return u[:, k] + part * (u[:, k + 1] - u[:, k])

    expected = scipy_states(slide, value, t)
    nominal = slide.vector("state", attribute="nominal")
    assert np.max(np.abs(motion.array(motion.named("state")) - expected) / nominal) < 1e-7


def test_a_hanging_load_under_a_function_of_time_agrees_with_scipy(hanging):
    command = lambda t: 4 * BAR + BAR * np.sin(12 * t)  # noqa: E731
    t = np.linspace(0.0, 1.0, 41)
    motion = pam.simulate(hanging, {"muscle.command": command}, t=t, rtol=1e-11)
    expected = scipy_states(hanging, command, t, rtol=1e-12)
    nominal = hanging.vector("state", attribute="nominal")
    assert np.max(np.abs(motion.array(motion.named("state")) - expected) / nominal) < 1e-7


def test_a_trajectory_replays_itself(slide):
    commands = {"muscle1.command": lambda t: (3 + np.sin(30 * t)) * BAR, "muscle2.command": 3 * BAR}
    t = np.linspace(0, 0.2, 41)
    sampled = {
        "muscle1.command": commands["muscle1.command"](t),
        "muscle2.command": np.full(41, 3 * BAR),
    }
    first = pam.simulate(slide, sampled, t=t)
    again = pam.simulate(slide, first)
    assert first.compare(again).largest < 1e-12


def test_without_damping_energy_is_conserved():
    """E = m v^2/2 - integral of (F - m g) dx stays, with constant pressure and c = 0."""
    muscle = pam.muscle("DMSP-20-400N")
    plant = pam.HangingLoad(
        muscle, 20.0, damping=pam.losses.ConstantDamping(0.0), feed=pam.feeds.IdealPressure()
    )
    motion = pam.simulate(
        plant,
        {"muscle.pressure": 4 * BAR},
        t=np.linspace(0, 3, 301),
        start={"x": 0.0708},
        rtol=1e-12,
    )
    a1, a2, a3, a4, a5, a6 = muscle.law.values.values()
    x, v, p, l0 = motion["x"], motion["v"], 4 * BAR, 0.4
    assert motion["muscle.force"].min() > 2.0  # taut all along: the closed form below holds
    k = x / l0
    work = l0 * ((a1 * p + a2) / a3 * np.exp(a3 * k) + a4 * p * k**2 / 2 + (a5 * p + a6) * k)
    energy = 20.0 * v**2 / 2 - work + 20.0 * 9.80665 * x
    assert np.ptp(energy) < 1e-9 * np.ptp(work)


def test_parameters_apply_to_one_run_only(hanging):
    heavy = pam.simulate(
        hanging, {"muscle.command": 4 * BAR}, duration=5.0, parameters={"mass": 50.0}
    )
    light = pam.simulate(hanging, {"muscle.command": 4 * BAR}, duration=5.0)
    assert heavy["x"][-1] == pytest.approx(49.5e-3, abs=0.05e-3)
    assert light["x"][-1] == pytest.approx(80.8e-3, abs=0.05e-3)


def test_a_failure_says_where_and_keeps_what_was_computed():
    plant = pam.Plant("blow_up", "x' = x^2 ends at t = 1")
    x = plant.state("x", start=1.0)
    plant.der(x, x**2)
    with pytest.raises(SimulationError, match=r"gave up behind t = 0\.974") as caught:
        pam.simulate(plant, t=np.linspace(0.0, 2.0, 40), max_steps=5000)
    part = caught.value.trajectory
    assert caught.value.time == pytest.approx(38 / 39)
    assert part["x"] == pytest.approx(1 / (1 - part.t), rel=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "give duration"),
        ({"duration": -1.0}, "duration = -1 s must be > 0"),
        ({"duration": 1.0, "t": [0.0, 1.0]}, "not both"),
        ({"t": [0.0, 1.0, 0.5]}, "rise"),
        ({"duration": 1.0, "start": {"x": 9.0}}, "outside"),
        ({"duration": 1.0, "start": {"mass": 9.0}}, "mass is a parameter, not a state"),
        ({"duration": 1.0, "parameters": {"x": 9.0}}, "x is a state"),
        ({"duration": 1.0, "rtol": 0.0}, "rtol"),
    ],
)
def test_bad_arguments_are_refused(hanging, arguments, message):
    refused(message, pam.simulate, hanging, **arguments)


@pytest.mark.parametrize(
    ("method", "step"), [("cvodes", None), ("rk4", 1e-4), ("rosenbrock", 1e-3)]
)
def test_all_methods_agree(slide, method, step):
    t = np.linspace(0.0, 0.3, 16)
    u = np.random.default_rng(4).uniform(2.5 * BAR, 4.5 * BAR, size=(2, 16))
    inputs = {"muscle1.command": u[0], "muscle2.command": u[1]}
    one = pam.simulate(slide, inputs, t=t)
    other = pam.simulate(slide, inputs, t=t, method=method, step=step, rtol=1e-11)
    assert one.compare(other, one.named("state")).largest < 1e-6


def test_rk4_has_order_four(slide):
    inputs = {"muscle1.command": 4 * BAR, "muscle2.command": 3.5 * BAR}
    t = [0.0, 0.064]
    exact = pam.simulate(slide, inputs, t=t, rtol=1e-13)["x"][-1]
    errors = [
        abs(pam.simulate(slide, inputs, t=t, method="rk4", step=h)["x"][-1] - exact)
        for h in (0.002, 0.001, 0.0005)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([4.0, 4.0], abs=0.5)


def test_crossings_of_an_oscillator_are_where_the_cosine_says():
    plant = pam.Plant("oscillator")
    x, v = plant.state("x", start=1.0), plant.state("v")
    plant.der(x, v)
    plant.der(v, -((2 * np.pi) ** 2) * x)
    motion = pam.simulate(plant, t=np.linspace(0.0, 2.0, 23), events=["x"], rtol=1e-12)
    assert [e.time for e in motion.events] == pytest.approx([0.25, 0.75, 1.25, 1.75], abs=1e-10)
    assert [e.rising for e in motion.events] == [False, True, False, True]
    assert motion["x"] == pytest.approx(np.cos(2 * np.pi * motion.t), abs=1e-9)


def test_slack_begins_and_ends_where_scipy_finds_it():
    """A load thrown upwards: slack, free fall, taut again; with a clamp narrower than 1e-5 N."""
    from dataclasses import replace

    from scipy.integrate import solve_ivp

    muscle = replace(pam.muscle("DMSP-20-400N"), slack_width=1e-5)
    plant = pam.HangingLoad(
        muscle, 20.0, damping=pam.losses.ConstantDamping(0.0), feed=pam.feeds.IdealPressure()
    )
    t = np.linspace(0.0, 0.4, 81)
    start = {"x": 0.06, "v": 0.8}
    motion = pam.simulate(
        plant, {"muscle.pressure": 4 * BAR}, t=t, start=start, events=["muscle.tension"], rtol=1e-12
    )
    slack = lambda s, z: muscle.law.tension(4 * BAR, z[0] / 0.4)  # noqa: E731
    slack.terminal = True

    def fall(s, z):
        return [z[1], -9.80665]

    def pull(s, z):
        return [z[1], slack(s, z) / 20.0 - 9.80665]

    time, z, expected = 0.0, np.array([0.06, 0.8]), []
    for rule, direction in ((pull, -1), (fall, 1)):
        slack.direction = direction
        run = solve_ivp(rule, (time, 1.0), z, events=slack, method="DOP853", rtol=1e-13, atol=1e-14)
        time, z = run.t_events[0][0], run.y_events[0][0]
        expected.append(time)
    assert [e.time for e in motion.events[:2]] == pytest.approx(expected, abs=1e-9)
    assert [e.rising for e in motion.events[:2]] == [False, True]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "euler"}, "rosenbrock, cvodes, rk4"),
        ({"method": "rk4"}, "needs a step"),
        ({"method": "cvodes", "step": 1e-3}, "leave out step"),
        ({"events": ["muscle.tensoin"]}, r"muscle\.tension"),
    ],
)
def test_a_method_or_event_that_does_not_exist_is_refused(hanging, arguments, message):
    refused(message, pam.simulate, hanging, duration=0.1, **arguments)


@pytest.mark.parametrize("rtol", [1e-20, 9e-15, 1.0, 7.0])
def test_a_tolerance_beyond_what_numbers_allow_is_refused(hanging, rtol):
    refused(r"rtol = .* must lie in 1e-14 \.\. 1", pam.simulate, hanging, duration=0.1, rtol=rtol)


def test_an_input_of_a_megahertz_is_refused_with_the_time_it_was_followed_to(hanging, monkeypatch):
    monkeypatch.setattr("pam_ocp.core.signals.MOST_PIECES", 2000)
    wave = {"muscle.command": lambda t: 4e5 + 1e5 * np.sin(2e6 * np.pi * t)}
    with pytest.raises(pam.InputError, match=r"muscle\.command: the function changes so fast"):
        pam.simulate(hanging, wave, duration=1.0)


def test_a_function_of_time_is_followed_to_a_billionth(hanging):
    def wave(t: float) -> float:
        return 4e5 + 1e5 * np.sin(300 * t)

    signals = pam.simulate(hanging, {"muscle.command": wave}, duration=0.05, rtol=1e-6).signals
    t = np.linspace(0, 0.05, 9973)
    assert np.abs(signals(t)[:, 0] - wave(t)).max() < 3e-9 * 1e5


@pytest.mark.parametrize("t", [[0.0, 2.0], np.linspace(0.0, 2.0, 8)])
@pytest.mark.parametrize("width", [0.3, 0.002])
def test_a_pulse_between_two_output_times_is_not_overlooked(t, width):
    plant = pam.Plant("integrator")
    x, u = plant.state("x"), plant.input("u")
    plant.der(x, u)
    run = pam.simulate(plant, {"u": lambda s: 1.0 if 0.5031 <= s < 0.5031 + width else 0.0}, t=t)
    assert run["x"][-1] == pytest.approx(width, abs=1e-8)


def test_a_series_of_pandas_runs_over_its_own_times():
    pandas = pytest.importorskip("pandas")
    plant = pam.Plant("integrator")
    x, u = plant.state("x"), plant.input("u")
    plant.der(x, u)
    clocks = [0.0, 0.1, 0.2], pandas.to_timedelta(["0 s", "100 ms", "200 ms"])
    for clock in (*clocks, pandas.date_range("2026-03-29 00:59:59.9Z", periods=3, freq="100ms")):
        series = pandas.Series([1.0, 3.0, 0.0], index=clock)
        assert pam.simulate(plant, {"u": series}, t=[0.0, 1.0])["x"][-1] == pytest.approx(0.4)
    rows = pandas.Series([1.0, 3.0, 0.0])  # without times: one at each output time
    assert pam.simulate(plant, {"u": rows}, t=[0.0, 1.0, 1.5])["x"][-1] == pytest.approx(2.5)


@pytest.mark.parametrize("first", [0.0, 3.0])
def test_a_dead_time_is_exactly_a_shift_of_the_command(first):
    muscle, dead = pam.muscle("DMSP-20-300"), 0.03
    late, prompt = (
        pam.HangingLoad(muscle, 10.0, feed=pam.feeds.Regulator(lag=0.05, dead_time=d))
        for d in (dead, None)
    )
    t = first + np.linspace(0.0, 0.4, 41)
    steps = {0.0: 2 * BAR, 0.05: 4 * BAR, 0.2: 3 * BAR}
    times, values = first + np.array([*steps, 0.4]), np.array([*steps.values(), 3 * BAR])
    begin = prompt.equilibrium({"muscle.command": 2 * BAR})
    start = {v.name: begin[v.name] for v in prompt.states}
    line = {v.name: 2 * BAR for v in late.states if ".delay" in v.name}
    command = {"muscle.command": (times, values)}
    run = pam.simulate(late, command, t=t, start=start | line, dead_times="exact", rtol=1e-9)
    command = {"muscle.command": (np.append(first, times[1:] + dead), values)}
    shifted = pam.simulate(prompt, command, t=t, start=start, rtol=1e-9)
    assert np.abs(run["x"] - shifted["x"]).max() < 1e-8


def _of_numbers(t):
    return 4e5 + 1e5 * math.sin(300 * t)  # TypeError for an array


def _of_arrays_and_numbers(t):
    return 4e5 + 1e5 * np.sin(300 * t)


def _otherwise_of_arrays(t):
    return np.full_like(t, 4e5) if np.ndim(t) else _of_numbers(t)


def _changing_its_argument(t):
    t *= 300
    return 4e5 + 1e5 * np.sin(t)


@pytest.mark.parametrize(
    "function", [_of_numbers, _of_arrays_and_numbers, _otherwise_of_arrays, _changing_its_argument]
)
def test_a_function_of_time_means_what_it_says_of_numbers(hanging, function):
    given = {"muscle.command": function}
    signals = pam.simulate(hanging, given, duration=0.05, rtol=1e-6).signals
    t = np.linspace(0, 0.05, 991)
    wanted = [_of_numbers(s) for s in t.tolist()]
    assert np.abs(signals(t)[:, 0] - wanted).max() < 3e-9 * 1e5


@pytest.mark.parametrize("at", [0.02, 0.0234567])  # a time of the grid, and one between two
def test_a_function_that_jumps_is_followed_on_both_sides(hanging, at):
    def jump(t: float) -> float:
        return (2e5 if t < at else 4e5) + 1e5 * np.cos(9 * t)

    t = np.linspace(0, 0.05, 26)
    signals = pam.simulate(hanging, {"muscle.command": jump}, t=t, rtol=1e-6).signals
    near = at + np.array([-1e-3, -1e-6, -3e-9, 3e-9, 1e-6, 1e-3])
    wanted = [jump(s) for s in near]
    assert np.abs(signals(near)[:, 0] - wanted).max() < 3e-9 * 1e5


def test_a_load_thrown_beyond_the_muscle_is_told_once(recwarn):
    """At rest, slack, 8 m/s upwards: it flies to v^2/(2 g), ten times the stroke."""
    forget_warnings()
    plant = pam.HangingLoad("DMSP-20-300", mass=5.0, damping=0.0, feed=pam.feeds.IdealPressure())
    high = 8.0**2 / (2 * 9.80665)
    for _ in range(2):
        flown = pam.simulate(plant, {"muscle.pressure": 0.0}, duration=0.9, start={"v": 8.0})
    assert flown["x"].max() == pytest.approx(high, rel=5e-3)
    (said,) = [str(w.message) for w in recwarn if w.category is ValidityWarning]
    assert said.startswith("simulate: hanging_load: x = 326")
    assert " is outside 0 mm .. 78 mm. Nothing stops it there" in said

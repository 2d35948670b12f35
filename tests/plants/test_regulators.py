"""Regulators as rigs have them: dead time, slew limit, two lags, volts, pairs; and sensors."""

from __future__ import annotations

import math
import pickle
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import solve_ivp
from scipy.interpolate import pade
from scipy.special import gammainc

import pam_ocp as pam
from pam_ocp.core.errors import InputError

BAR = 1e5
F = pam.feeds


def hanging(feed: Any) -> pam.Plant:
    return pam.HangingLoad("DMSP-20-200N", 10.0, feed=feed)


EACH: dict[str, Any] = {"lag": 0.05, "venting_lag": 0.09, "slew": 6e5, "venting_slew": 4e5}
EACH |= {"dead_time": F.DeadTime(0.02, order=3), "max_pressure": 6e5}
PAIR = {"gain": 0.8e5, "bias": -2e3, "base": 2.5e5}


def pair(feed: Any) -> pam.Plant:
    return pam.AntagonisticSlide("DMSP-20-200N", 2.0, damping=60.0, feed=feed)


def rig(**changes: Any) -> pam.Plant:
    """An antagonistic pair with everything that a regulator can have."""
    return pair(F.PairRegulator(**(EACH | PAIR | changes)))


def of_both(**values: float) -> dict[str, float]:
    """Values of both muscles."""
    return {f"muscle{i}.{n}": v for i in (1, 2) for n, v in values.items()}


def pressure_after_step(feed: Any, low: float, high: float, t: Any, **values: float) -> Any:
    plant = hanging(feed).with_values({f"muscle.{n}": v for n, v in values.items()})
    start = plant.equilibrium({"muscle.command": low})
    motion = pam.simulate(plant, {"muscle.command": high}, t=t, start=start, rtol=1e-11)
    return motion["muscle.pressure"]


# ---- closed forms --------------------------------------------------------------------------------
def test_a_slew_limit_is_a_ramp_and_then_the_lag() -> None:
    t, lag, slew, rise = np.linspace(0, 0.8, 81), 0.06, 7e5, 2.5e5
    p = pressure_after_step(F.Regulator(lag, slew=slew), 2e5, 2e5 + rise, t, slew_rounding=1e-6)
    until = rise / slew - lag  # from here on the lag asks for less than the limit
    law = np.where(t < until, slew * t, rise - slew * lag * np.exp(-np.maximum(t - until, 0) / lag))
    np.testing.assert_allclose(p, 2e5 + law, rtol=1e-6)


def test_venting_has_a_slew_limit_of_its_own() -> None:
    t, slew = np.linspace(0, 0.3, 31), 3e5
    p = pressure_after_step(F.Regulator(0.02, slew=9e5, venting_slew=slew), 4e5, 2e5, t)
    np.testing.assert_allclose(p, 4e5 - slew * t, rtol=1e-6)


@pytest.mark.parametrize(("low", "high", "lag"), [(1e5, 4e5, 0.05), (4e5, 1e5, 0.11)])
def test_filling_and_venting_have_lags_of_their_own(low: float, high: float, lag: float) -> None:
    t = np.linspace(0, 0.5, 51)
    p = pressure_after_step(F.Regulator(0.05, venting_lag=0.11), low, high, t, switch_width=math.pi)
    np.testing.assert_allclose(p, high + (low - high) * np.exp(-t / lag), rtol=1e-6)


def test_where_the_pressure_is_what_was_asked_for_it_rests_whatever_the_roundings() -> None:
    plant = rig().with_values(of_both(switch_width=5e4, slew_rounding=1.0))
    point = plant.equilibrium(difference=0.7)
    assert point["muscle1.pressure"] == pytest.approx(2.5e5 + 0.7 * 0.8e5 - 2e3, abs=1e-6)
    assert point["muscle2.pressure"] == pytest.approx(2.5e5 - 0.7 * 0.8e5 - 2e3, abs=1e-6)


# ---- dead times ----------------------------------------------------------------------------------
def transfer(dead_time: Any, s: complex) -> complex:
    """From command to effect, of the plant's own matrices."""
    plant = hanging(F.Regulator(0.05, dead_time=dead_time))
    a, b, _, _ = (
        np.asarray(m)
        for m in plant.jacobians(*(plant.vector(c) for c in ("state", "input", "parameter")))
    )
    line = [i for i, v in enumerate(plant.states) if ".delay" in v.name]
    a, b = a[np.ix_(line, line)], b[line, :1]
    return complex(np.linalg.solve(s * np.eye(len(line)) - a, b)[-1, 0])


@pytest.mark.parametrize("order", [1, 2, 4, 6])
def test_one_cell_is_the_approximation_of_pade(order: int) -> None:
    series = [(-1) ** k / math.factorial(k) for k in range(2 * order)]
    above, below = pade(series, order, order - 1)
    for s in (3j, 40j, 200j, 30.0 + 70j):
        expected = above(0.03 * s) / below(0.03 * s)
        assert transfer(F.DeadTime(0.03, order), s) == pytest.approx(expected, rel=1e-6)


def test_cells_of_order_one_are_a_chain_of_lags() -> None:
    t, time, n = np.linspace(0, 0.1, 51), 0.03, 5
    plant = hanging(F.Regulator(0.05, dead_time=F.DeadTime(time, order=1, cells=n)))
    start = plant.equilibrium({"muscle.command": 2e5})
    motion = pam.simulate(plant, {"muscle.command": 3e5}, t=t, start=start, rtol=1e-11)
    np.testing.assert_allclose(
        motion["muscle.delay5"], 2e5 + 1e5 * gammainc(n, n * t / time), rtol=1e-6
    )


@pytest.mark.parametrize("between", ["previous", "linear"])
def test_exact_dead_times_shift_the_command(between: Any) -> None:
    t, lag, time = np.linspace(0, 1.0, 401), 0.05, 0.0273
    knots, values = np.array([0, 0.2, 0.5, 0.53, 1.0]), np.array([3, 4, 2, 3.5, 3.5]) * BAR
    plant = hanging(F.Regulator(lag, dead_time=time))
    start = plant.equilibrium({"muscle.command": 3e5})

    def late(now: float) -> float:
        if between == "linear":
            return float(np.interp(now - time, knots, values))
        return float(values[max(np.searchsorted(knots, now - time + 1e-12, side="right") - 1, 0)])

    p, at = [3e5], 3e5
    grid = np.unique(np.concatenate([t, knots + time]))
    for a, b in pairwise(grid[grid <= 1.0]):

        def slope(s: float, x: Any, a: float = a) -> Any:
            return (late(s if between == "linear" else a) - x) / lag

        at = float(solve_ivp(slope, (a, b), [at], rtol=1e-11, atol=1e-6).y[0, -1])
        if np.any(np.isclose(b, t, rtol=0, atol=1e-14)):
            p.append(at)
    asked = {"interpolation": between, "dead_times": "exact", "rtol": 1e-11}
    motion = pam.simulate(plant, {"muscle.command": (knots, values)}, t=t, start=start, **asked)
    np.testing.assert_allclose(motion["muscle.pressure"], p, rtol=1e-6)
    early = t < time
    np.testing.assert_allclose(motion["muscle.delay4"][early], 3e5, rtol=1e-12)


def test_lines_of_higher_order_come_nearer_to_the_exact_dead_time() -> None:
    u = {"muscle.command": ([0, 0.2, 0.5, 1.0], [3e5, 4e5, 2e5, 2e5])}
    errors = []
    for order in (1, 3, 5, 8):
        plant = hanging(F.Regulator(0.05, dead_time=F.DeadTime(0.03, order)))
        start = plant.equilibrium({"muscle.command": 3e5})
        both = [
            pam.simulate(plant, u, duration=1.0, start=start, rtol=1e-8, dead_times=kind)["x"]
            for kind in ("line", "exact")
        ]
        errors.append(np.abs(both[0] - both[1]).max())
    assert errors[3] < 1e-6  # of some 10 mm
    assert all(b < 0.4 * a for a, b in pairwise(errors))


def test_exact_dead_times_want_a_command_that_stood() -> None:
    plant = hanging(F.Regulator(dead_time=0.02))
    with pytest.raises(InputError, match="delay4 runs from 100000 to 300000"):
        pam.simulate(plant, duration=0.1, start={"muscle.delay1": 1e5}, dead_times="exact")


def test_without_its_line_a_plant_takes_the_late_command_as_an_input() -> None:
    plant = pickle.loads(pickle.dumps(rig()))
    bare = pam.plants.without_dead_times(plant.with_values(mass=3.0))
    assert [v.name for v in bare.inputs] == ["difference", "difference.delay3"]
    assert bare.variable("mass").start == 3.0
    line = {f"difference.delay{i}": 0.5 for i in (1, 2, 3)}
    plant = plant.with_values(mass=3.0)
    whole = pam.simulate(plant, {"difference": 0.5}, duration=0.3, start=line)
    driven = pam.simulate(bare, {"difference.delay3": 0.5}, duration=0.3)
    np.testing.assert_allclose(driven["x"], whole["x"], atol=1e-9)


# ---- the whole rig -------------------------------------------------------------------------------
def test_the_rig_moves_as_scipy_says() -> None:
    """The equations of the pair, written out, with the kinks as they are."""
    rounded = of_both(switch_width=math.pi, slew_rounding=1e-6)
    plant = rig(dead_time=None).with_values(rounded)
    force = plant.function
    names = [v.name for v in plant.states]

    def slope(_: float, z: Any, u: float) -> Any:
        found = np.asarray(force(z, [u], plant.vector("parameter"))[0]).ravel()
        for i, sign in ((1, 1), (2, -1)):
            place = names.index(f"muscle{i}.pressure")
            error = 2.5e5 + sign * 0.8e5 * u - 2e3 - z[place]
            found[place] = np.clip(error / (0.05 if error > 0 else 0.09), -4e5, 6e5)
        return found

    start = plant.equilibrium(difference=0.0)
    z, t = plant.vector("state", start), np.linspace(0, 0.5, 26)
    motion = pam.simulate(plant, {"difference": 1.5}, t=t, start=start, rtol=1e-10)
    run = solve_ivp(
        slope, (0, 0.5), z, args=(1.5,), t_eval=motion.t, method="LSODA", rtol=1e-10, atol=1e-9
    )
    for i, name in enumerate(names):
        scale = plant.variable(name).nominal
        np.testing.assert_allclose(motion[name], run.y[i], atol=2e-5 * scale)


def test_one_command_for_the_pair_is_two_commands_about_the_base() -> None:
    joined, apart = rig(), pair(F.Regulator(**EACH))
    t, u = np.linspace(0, 0.5, 51), np.array([0.0] * 10 + [1.0] * 20 + [-0.6] * 21)
    one = pam.simulate(joined, {"difference": u}, t=t, start=joined.equilibrium(difference=0.0))
    commands = {f"muscle{i}.command": 2.48e5 + s * 0.8e5 * u for i, s in ((1, 1), (2, -1))}
    begin = apart.equilibrium({n: c[0] for n, c in commands.items()})
    two = pam.simulate(apart, commands, t=t, start=begin)
    np.testing.assert_allclose(one["x"], two["x"], atol=1e-10)


def test_a_gain_makes_the_command_volts_within_the_range_of_pressure() -> None:
    feed = F.Regulator(gain="1.2 bar/V", bias="-0.3 bar", max_pressure=6e5)
    command = hanging(feed).variable("muscle.command")
    assert command.unit == "V"
    assert command.min == pytest.approx(0.25)
    assert command.max == pytest.approx(5.25)


def test_the_symmetry_of_a_pair_turns_the_command_round() -> None:
    plant = rig()
    plant.add_sensor("x", pam.plants.Sensor(filter=0.01))
    image = plant.mirror_map
    assert image["difference"] == (-1.0, "difference")
    assert image["difference.delay2"] == (-1.0, "difference.delay2")
    assert image["x.filtered"] == (-1.0, "x.filtered")
    z = np.random.default_rng(5).normal(size=len(plant.states)) * 0.01
    u, p = np.array([0.4]), plant.vector("parameter")
    names = [v.name for v in plant.states]
    swap = [image.get(n, (1.0, n)) for n in names]

    def mirrored(v: Any) -> Any:
        return np.array([s * v[names.index(n)] for s, n in swap])

    rates = [np.asarray(plant.function(a, b, p)[0]).ravel() for a, b in ((z, u), (mirrored(z), -u))]
    np.testing.assert_allclose(mirrored(rates[0]), rates[1], rtol=1e-9, atol=1e-6)


def test_linear_models_are_the_slopes_of_the_equations() -> None:
    plant = rig()
    plant.add_sensor("x", pam.plants.Sensor(gain=40.0, zero=0.5, filter=0.01, unit="V"))
    point = plant.equilibrium(difference=0.4)
    x, u, p = point.x, point.u, plant.vector("parameter")
    a, b, c, _ = (np.asarray(m) for m in plant.jacobians(x, u, p))

    def both(z: Any) -> Any:
        found = plant.function(z[: len(x)], z[len(x) :], p)
        return np.concatenate([np.asarray(f).ravel() for f in found[:2]])

    z = np.concatenate([x, u])
    sizes = 1e-6 * np.array([v.nominal for v in (*plant.states, *plant.inputs)])
    for j, step in enumerate(np.diag(sizes)):
        slope = (both(z + step) - both(z - step)) / (2 * sizes[j])
        exact = np.concatenate([a, c])[:, j] if j < len(x) else b[:, j - len(x)]
        scale = np.abs(exact).max() + 1e-9
        assert np.abs(slope[: len(exact)] - exact).max() < 2e-6 * scale


# ---- sensors -------------------------------------------------------------------------------------
def test_a_sensor_shows_gain_zero_filter_and_steps() -> None:
    plant = hanging(None)
    sensor = pam.plants.Sensor(gain=50.0, zero=0.2, filter=0.02, resolution=0.005, unit="V")
    plant.add_sensor("x", sensor)
    assert plant.variable("x.gain").unit == "V/m"
    u = {"muscle.command": 4e5}
    motion = pam.simulate(plant, u, duration=0.5, rtol=1e-11)
    fine = pam.simulate(plant, u, t=np.linspace(0, 0.5, 20001), rtol=1e-11)
    slope = lambda t, z: (np.interp(t, fine.t, fine["x"]) - z) / 0.02  # noqa: E731
    tight = {"t_eval": motion.t, "rtol": 1e-9, "atol": 1e-12, "max_step": 1e-3}
    lag = solve_ivp(slope, (0, 0.5), [motion["x.filtered"][0]], **tight)
    np.testing.assert_allclose(motion["x.measured"], 50 * lag.y[0] + 0.2, atol=1e-6)
    steps = motion["x.reading"] / 0.005
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-9)
    assert np.abs(motion["x.reading"] - motion["x.measured"]).max() <= 0.0025 + 1e-12


def test_a_filter_on_one_muscle_alone_ends_the_symmetry() -> None:
    plant = rig()
    plant.add_sensor("muscle1.pressure", pam.plants.Sensor(filter=0.01))
    assert plant.equilibrium(difference=0.0)["x"] == pytest.approx(0.0, abs=1e-9)
    assert plant.mirror_map == {}


# ---- what is refused -----------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: F.DeadTime(0.0), "DeadTime.time = 0 s must be > 0"),
        (lambda: F.DeadTime(0.1, order=10), "DeadTime.order = 10: give a whole number from 1 to 9"),
        (lambda: F.Regulator(venting_slew=1e5), "venting_slew: give slew"),
        (lambda: F.Regulator(dead_time=[0.1]), "dead_time = .*give seconds"),
        (lambda: F.Regulator(gain=-1e5), "gain = -100000 Pa/V must be > 0"),
        (lambda: hanging(F.PairRegulator()), "feeds two muscles by one command"),
        (lambda: rig(base=7e5), "base = 700000 Pa must lie below max_pressure"),
        (lambda: hanging(None).add_sensor("muscle.command", pam.plants.Sensor()), "is an input"),
        (lambda: hanging(None).add_sensor("x", 3), "give a Sensor"),
        (lambda: pam.plants.Sensor(gain=0.0), "gain = 0 reads nothing"),
    ],
)
def test_what_cannot_be_is_refused(make: Any, words: str) -> None:
    refused(words, make)


# ---- what is done with them ----------------------------------------------------------------------
def test_an_fmu_of_the_whole_rig_agrees_to_a_millionth(tmp_path: Any) -> None:
    plant = rig()
    sensor = pam.plants.Sensor(gain=50.0, zero=0.2, filter=0.01, resolution=0.01, unit="V")
    plant.add_sensor("x", sensor)
    t, start = np.arange(0, 0.3, 0.01), plant.equilibrium(difference=0.0)
    u = np.repeat(np.random.default_rng(6).uniform(-1.5, 1.5, 3), 10)
    motion = pam.simulate(plant, {"difference": u}, t=t, start=start, rtol=1e-11)
    path = pam.export_fmu(plant, tmp_path / "rig.fmu", platforms="native")
    assert pam.check_fmu(path, motion, tolerance=1e-6).ok


def test_a_plan_with_dead_time_begins_with_a_command_that_stood() -> None:
    late = rig(slew=None, venting_slew=None, venting_lag=None)
    plan = pam.plan(late, stops=[{"x": -0.006}, {"x": 0.006}], minimise="time")
    assert plan.success
    start = {v.name: plan.trajectory[v.name][0] for v in late.states}
    stood = [start[f"difference.delay{i}"] for i in (1, 2, 3)]
    np.testing.assert_allclose(stood, stood[0], atol=1e-6)
    held = pam.simulate(late, {"difference": stood[0]}, duration=1.0, start=start)
    assert np.ptp(held["x"]) < 1e-6  # under the command that stood nothing moves
    prompt = rig(slew=None, venting_slew=None, venting_lag=None, dead_time=None)
    sooner = pam.plan(prompt, stops=[{"x": -0.006}, {"x": 0.006}], minimise="time")
    assert plan.duration > sooner.duration


def test_a_problem_file_takes_all_of_it() -> None:
    from pam_ocp.plants.plant_file import plant_of

    plant = plant_of(
        {
            "arrangement": "AntagonisticSlide",
            "muscle": "DMSP-20-200N",
            "feed": {
                "kind": "PairRegulator",
                "base": "2.5 bar",
                "gain": "0.8 bar/V",
                "slew": "6 bar/s",
                "venting_lag": "90 ms",
                "dead_time": {"time": "20 ms", "order": 3},
            },
            "sensors": {"x": {"zero": "1 mm", "filter": "10 ms"}},
        }
    )
    values = {v.name: v.start for v in plant.parameters}
    assert values["muscle2.slew"] == 6e5
    assert values["difference.dead_time"] == 0.02
    assert values["x.zero"] == 1e-3
    assert [v.name for v in plant.inputs] == ["difference"]

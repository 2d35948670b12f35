"""What stands still in a plant, read off its equations, against coordinates chosen by hand."""

from itertools import islice

import casadi as ca
import numpy as np
import pytest
from conftest import flat
from rest_rows import catalogue, found_rows, own_plant

import pam_ocp as pam
from pam_ocp.plants.stillness import (
    POINTS,
    Position,
    _Region,
    rate_of,
    rest_rows,
    settled_names,
    totals,
)


def pendulum():
    """Angle q, momentum L, pressure p that drives it, a slow sensor s, and air drawn in all."""
    plant = pam.Plant("pendulum")
    air, p = plant.state("air", unit="kg"), plant.state("p", unit="bar", nominal=3.0)
    s, momentum = plant.state("s", unit="rad"), plant.state("L", unit="N.m.s")
    q = plant.state("q", unit="rad", min=-1.0, max=1.0)
    u, gust = plant.input("u"), plant.input("gust", disturbance=True)
    plant.der(q, momentum / 0.4)
    plant.der(momentum, p - 7.0 * ca.sin(q) - 0.3 * momentum + gust)
    plant.der(p, (u - p) / 0.05)
    plant.der(s, (q - s) / 0.02)
    plant.der(air, p**2)
    return plant


def geared(rate):
    """Position and velocity, x' = rate(v), v' = u/3, and a wheel of 50 mm that counts the way."""
    plant = pam.Plant("geared")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    wheel = plant.state("wheel", unit="rad")
    u = plant.input("u", unit="N")
    plant.der(x, rate(v))
    plant.der(v, u / 3)
    plant.der(wheel, rate(v) / 0.05)
    return plant


def test_an_angle_rests_a_pressure_a_sensor_and_a_total_do_not():
    plant = pendulum()
    assert plant.resting() == (Position("q", ("L",)),)
    assert settled_names(plant) == ("s",)
    assert totals(plant) == ("air",)


@pytest.mark.parametrize("loss", [lambda v: v**2, lambda v: ca.sqrt(v**2 + 1e-6) - 1e-3])
def test_a_loss_or_a_way_sums_up_in_whatever_unit(loss):
    """Neither goes back, where a wheel that counts the same motion does."""
    plant = pam.Plant("lossy")
    x, v, total = plant.state("x", unit="m"), plant.state("v"), plant.state("total", unit="m")
    for state, rate in ((x, v), (v, plant.input("u") / 3), (total, loss(v))):
        plant.der(state, rate)
    plant.der(plant.state("wheel", unit="rad"), v / 0.05)
    assert totals(plant) == ("total",)
    assert [p.name for p in plant.resting()] == ["x", "wheel"]


def test_what_an_input_moves_straight_has_no_acceleration_and_a_disturbance_moves_nothing():
    plant = pam.Plant("table")
    x, y, v = (plant.state(n, unit="m") for n in "xyv")
    u, gust = plant.input("u"), plant.input("gust", disturbance=True)
    plant.der(x, 2 * u)
    plant.der(y, v + gust)
    plant.der(v, u)
    assert plant.resting(["y"]) == (Position("x", (), True), Position("y", ("v",)))
    assert [(q.name, order) for q, order, _ in rest_rows(plant, plant.resting(["y"]))] == [
        ("x", 1),
        ("y", 1),
    ]  # y's acceleration is u, which the first row holds at zero


@pytest.mark.parametrize(
    ("rate", "slope"), [(lambda v: v / 2, 0.5), (lambda v: ca.sinh(3 * v), 3.0)]
)
def test_rest_asks_for_rate_and_acceleration_once_for_all_that_count_one_motion(rate, slope):
    plant = geared(rate)
    assert plant.resting() == (Position("x", ("v",)), Position("wheel", ("v",)))
    rows = rest_rows(plant, plant.resting())
    assert [(q.name, order) for q, order, _ in rows] == [("x", 1), ("x", 2)]
    f = ca.Function("f", [plant.x, plant.u, plant.p], [row[2] for row in rows])
    speed, acceleration = (float(e) for e in f([0.3, 0.0, 2.0], [6.0], []))
    assert (speed, acceleration) == pytest.approx((0.0, 6.0 / 3 * slope))
    assert float(f([0.3, 0.1, 2.0], [6.0], [])[0]) == pytest.approx(float(rate(0.1)))


def test_without_a_position_nothing_is_asked():
    plant = pam.Plant("lag")
    p, u = plant.state("p", unit="Pa"), plant.input("u")
    plant.der(p, u - p)
    assert plant.resting() == ()
    assert rest_rows(plant, ()) == []
    assert settled_names(plant) == ()


def test_two_coupled_slides_both_rest_in_the_order_of_the_states():
    plant = pam.Plant("two")
    w, y = plant.state("w", unit="m/s"), plant.state("y", unit="m")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    u = plant.input("u")
    plant.der(y, w)
    plant.der(w, 30 * (x - y))
    plant.der(x, v + w)
    plant.der(v, u - 20 * (x - y))
    assert plant.resting() == (Position("y", ("w",)), Position("x", ("w", "v")))
    rows = rest_rows(plant, plant.resting())
    f = ca.Function("f", [plant.x, plant.u, plant.p], [row[2] for row in rows])
    values = [float(e) for e in f([0.5, 0.1, 0.4, 0.25], [9.0], [])]
    expected = {("y", 1): 0.5, ("y", 2): 30 * 0.3, ("x", 1): 0.75, ("x", 2): 9.0 - 6.0 + 9.0}
    found = {(q.name, order): v for (q, order, _), v in zip(rows, values, strict=True)}
    assert found == pytest.approx(expected)
    assert list(found) == [("y", 1), ("y", 2), ("x", 1), ("x", 2)]


def test_units_or_the_stops_names_decide_which_of_two_is_the_position():
    def circle(one, two):
        plant = pam.Plant("circle")
        a, b = plant.state("a", unit=one), plant.state("b", unit=two)
        plant.der(a, b)
        plant.der(b, -a)
        return plant

    assert [q.name for q in circle("m/s", "m").resting()] == ["b"]
    assert [q.name for q in circle("m", "m").resting()] == ["a"]
    assert [q.name for q in circle("m", "m").resting(["b"])] == ["b"]
    assert [q.name for q in circle("Pa", "kg").resting()] == ["a"]  # nothing else is there
    assert [q.name for q in circle("Pa", "1").resting()] == ["b"]


def test_the_rate_of_an_output_is_its_derivative_along_the_motion():
    plant = pam.Plant("elbow")
    q, w = plant.state("q", unit="rad"), plant.state("w", unit="rad/s")
    plant.der(q, w)
    plant.der(w, -9.0 * ca.sin(q))
    plant.output("height", 0.3 * ca.cos(q), unit="m")
    f = ca.Function("f", [plant.x], [rate_of(plant, "height"), rate_of(plant, "q")])
    rate, own = (float(e) for e in f([0.7, 2.0]))
    assert (rate, own) == pytest.approx((-0.3 * np.sin(0.7) * 2.0, 2.0))


def test_a_filter_of_a_filter_settles_and_a_filter_of_a_pressure_does_not():
    plant = pam.Plant("sensors")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    p = plant.state("p", unit="Pa")
    one, two, other = (plant.state(n, unit="m") for n in ("one", "two", "other"))
    creep = plant.state("creep", memory="settling")
    u = plant.input("u")
    plant.der(x, v)
    plant.der(v, p)
    plant.der(p, u - p)
    plant.der(one, x - one)
    plant.der(two, one - two)
    plant.der(other, p - other)
    plant.der(creep, x - creep)
    assert settled_names(plant) == ("one", "two", "creep")
    assert totals(plant) == ()  # each of them follows itself
    assert flat(plant.function([0, 0, 0, 0, 1, 0, 0], [0], [])[0])[4] == -1.0


def test_what_a_disturbance_keeps_moving_does_not_rest():
    plant = pam.Plant("raft")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    y, w = plant.state("y", unit="m"), plant.state("w", unit="m/s")
    u, stream = plant.input("u"), plant.input("stream", start=1.0, disturbance=True)
    plant.der(x, stream + 0.1 * ca.sin(v))
    plant.der(v, u)
    plant.der(y, stream - 1 + w)
    plant.der(w, u)
    assert plant.resting() == (Position("y", ("w",)),)
    assert plant.with_values(stream=0.05).resting() == (
        Position("x", ("v",)),
        Position("y", ("w",)),
    )


# ---- over the region of operation, not at one point ---------------------------------------------
def test_muscles_of_the_catalogue_lose_no_row():
    """Every 29th of 572."""
    for words, make, expected in islice(catalogue(), 0, None, 29):
        assert found_rows(make()) == expected, words


def test_own_plants_lose_no_row_and_repeat_none():
    rng = np.random.default_rng(7)
    for number in range(25):
        plant, expected, _ = own_plant(rng, number)
        assert found_rows(plant) == expected, plant.name


@pytest.mark.parametrize("band", [0.05, 0.5, 0.9, 2.0])
def test_one_sided_actuators_with_a_dead_band_accelerate_what_they_push(band):
    """With the last band they push nowhere in their range; that is no reason to drop the row."""
    plant = pam.Plant("pushed")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    a, b = (plant.input(n, min=0.0, max=1.0) for n in "ab")
    plant.der(x, v)
    plant.der(v, ca.fmax(a - band, 0) - ca.fmax(b - band, 0))
    assert [order for _, order, _ in rest_rows(plant, plant.resting())] == [1, 2]


def test_a_position_behind_a_spool_with_overlap_is_one():
    plant = pam.Plant("overlap")
    x, s = plant.state("x", unit="m"), plant.state("s", min=-1.0, max=1.0)
    u = plant.input("u", min=-1.0, max=1.0)
    plant.der(s, (u - s) / 0.02)
    plant.der(x, ca.fmax(s - 0.3, 0) - ca.fmax(-s - 0.3, 0))
    assert plant.resting() == (Position("x", ("s",)),)


def test_a_cam_counts_the_same_motion_by_a_radius_that_changes():
    plant = pam.Plant("cam")
    x, v = plant.state("x", unit="m", min=-1.0, max=1.0), plant.state("v", unit="m/s")
    cam, u = plant.state("cam", unit="m"), plant.input("u")
    plant.der(x, v)
    plant.der(v, u - v)
    plant.der(cam, v * (1 + 0.5 * x))
    rows = rest_rows(plant, plant.resting())
    assert [(q.name, order) for q, order, _ in rows] == [("x", 1), ("x", 2)]


def test_what_falls_for_ever_is_asked_to_stand():
    """x'' = -g has no slope in anything, and cannot vanish."""
    plant = pam.Plant("stone")
    x, v, u = plant.state("x", unit="m"), plant.state("v", unit="m/s"), plant.input("u")
    y = plant.state("y", unit="m")
    plant.der(x, v)
    plant.der(v, -9.81)
    plant.der(y, u)
    rows = rest_rows(plant, (Position("x", ("v",)),))
    assert [order for _, order, _ in rows] == [1, 2]
    with pytest.raises(pam.PlanError):
        pam.plan(plant, [{"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}], starts=1)


def test_roots_are_found_where_a_bound_holds_most_of_each_step():
    """10 a + b = 10.5 with a and b in [0, 1]: steps of least length press a onto its bound."""
    plant = pam.Plant("corner")
    a, b = (plant.state(name, min=0.0, max=1.0) for name in "ab")
    plant.der(a, 0.0)
    plant.der(b, 0.0)
    z, _ = _Region(plant, ca.vertcat(10 * a + b - 10.5)).roots([0])
    assert z.shape[1] == POINTS
    np.testing.assert_allclose(10 * z[0] + z[1], 10.5, rtol=1e-12)
    assert np.all((z >= 0.0) & (z <= 1.0))

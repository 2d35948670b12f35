"""Openings in place of commands with a dead zone: values, bounds and equations, by hand."""

import pickle

import casadi as ca
import numpy as np
import pytest
from conftest import flat, refused

import pam_ocp as pam
from pam_ocp import InputError
from pam_ocp.plants.inversion import Inversion, in_dead_zone

WIDTH = 0.2


def carriage(width=WIDTH):
    """x' = v, v' = k e(a) + 2 b - d: a has a dead zone, b has none, d is a disturbance."""
    plant = pam.Plant("carriage")
    x, v = plant.state("x", unit="m"), plant.state("v", unit="m/s")
    b = plant.input("b", unit="N", start=0.25, min=-3.0, max=3.0)
    a = plant.input("axis.a", unit="rad", start=0.6, min=-1.0, max=2.0, nominal=0.5)
    d = plant.input("d", disturbance=True)
    k = plant.parameter("k", 5.0, min=0.0)
    w = plant.parameter("w", width, min=0.0)
    effect = plant.dead_zone(a, w)
    plant.der(x, v)
    plant.der(v, k * effect + 2 * b - d)
    plant.output("pull", k * effect)
    plant.mirror({"x": (-1.0, "x"), "v": (-1.0, "v"), "axis.a": (-1.0, "axis.a")})
    return plant


def valved():
    """Two valves that share an opening: fill and vent, duties from 0 to 1."""
    plant = pam.Plant("chamber")
    p = plant.state("p", unit="bar")
    fill = plant.input("fill", min=0.0, max=1.0, start=0.4)
    vent = plant.input("vent", min=0.0, max=1.0, start=0.1)
    one, two = plant.opening(
        "way",
        [fill, vent],
        fill - vent,
        lambda w: [ca.fmax(w, 0), ca.fmax(-w, 0)],
        [(fill, lambda w: ca.fmax(w, 0)), (vent, lambda w: ca.fmax(-w, 0))],
        min=-1.0,
        max=1.0,
    )
    plant.der(p, 3 * one - 7 * two)
    return plant


def test_the_plant_in_openings_obeys_the_same_equations():
    plant = carriage()
    inner = plant.in_openings()
    assert [v.name for v in inner.inputs] == ["b", "axis.a_effect", "d"]
    effect = inner.variable("axis.a_effect")
    assert (effect.min, effect.max, effect.start) == pytest.approx((-0.9, 1.9, 0.5))
    assert (effect.unit, effect.nominal) == ("rad", 0.5)
    p = plant.vector("parameter")
    sent = flat(plant.function([0.1, 0.2], [0.3, 0.8, 0.4], p)[0])
    chosen = flat(inner.function([0.1, 0.2], [0.3, 0.8 - WIDTH / 2, 0.4], p)[0])
    assert sent == pytest.approx([0.2, 5 * 0.7 + 0.6 - 0.4], rel=1e-12)
    assert chosen == pytest.approx(sent, rel=1e-12)
    assert float(inner.function([0.1, 0.2], [0.3, 0.7, 0.4], p)[1]) == pytest.approx(3.5)
    assert inner.mirror_map["axis.a_effect"] == (-1.0, "axis.a_effect")
    assert inner.openings == ()
    assert inner.in_openings() is inner


def on_both_sides():
    """Two chambers with a valve each; p' = 3 filling - 7 venting - leak, the valve rounded at 0."""
    plant = pam.Plant("pair")
    for name in ("one", "two"):
        p = plant.state(f"{name}.p", unit="bar")
        c = plant.input(f"{name}.command", min=-2.0, max=1.0)
        plant.dead_zone(plant.input(f"{name}.other"), 0.1, f"{name}.effect")
        half = c / 2
        up, down = plant.opening(
            f"{name}.way",
            [c],
            half,
            lambda w: [2 * w],
            [(ca.fmax(half, 0), "filling"), (ca.fmax(-half, 0), "venting")],
            min=-1.0,
            max=0.5,
            nominal=0.1,
        )
        plant.der(p, 3 * up - 7 * down - p)
        plant.output(f"{name}.flow", 3 * up)
    pairs = {"p": "p", "command": "command", "other": "other"}
    plant.mirror({f"one.{n}": (1.0, f"two.{m}") for n, m in pairs.items()})
    return plant


def test_ways_are_inputs_of_their_own_and_give_nothing_back():
    plant = on_both_sides().with_values({"one.command": -0.4, "two.command": 0.6})
    for made in (plant.in_ways(), pickle.loads(pickle.dumps(plant)).in_ways()):
        assert [v.name for v in made.inputs] == [
            f"{name}.{way}"
            for name in ("one", "two")
            for way in ("way.filling", "way.venting", "effect")
        ]
        ranges = {v.name: (v.min, v.max, v.start) for v in made.inputs}
        assert ranges["one.way.filling"] == pytest.approx((0.0, 0.5, 0.0))
        assert ranges["one.way.venting"] == pytest.approx((0.0, 1.0, 0.2))
        assert ranges["two.way.filling"] == pytest.approx((0.0, 0.5, 0.3))
        assert made.openings == ()
        assert made.mirror_map["one.way.venting"] == (1.0, "two.way.venting")
        small = [1e-5, 0.0, 0.0, 0.0, 1e-5, 0.0]
        slopes, flows, _ = made.function([0.1, 0.2], small, plant.vector("parameter"))
        assert flat(slopes) == pytest.approx([3e-5 - 0.1, -7e-5 - 0.2], rel=1e-12)
        assert flat(flows) == pytest.approx([3e-5, 0.0], abs=1e-15)
    rounded = plant.in_openings()
    flows = rounded.function([0.1, 0.2], [1e-5, 0.0, -1e-5, 0.0], rounded.vector("parameter"))[1]
    assert flat(flows)[1] < -1e-6  # what a motion would live on where air is what it costs


def test_ways_change_places_in_a_mirror_that_turns_the_sign():
    plant = on_both_sides()
    plant.mirror({"one.command": (-1.0, "two.command"), "two.command": (-1.0, "one.command")})
    found = plant.in_ways().mirror_map
    assert found["one.way.filling"] == (1.0, "two.way.venting")
    assert found["two.way.filling"] == (1.0, "one.way.venting")


@pytest.mark.parametrize("of", ["leaking", 3, None])
def test_a_path_is_a_way_or_a_function(of):
    plant = pam.Plant("wrong")
    u = plant.input("u")
    with pytest.raises(InputError, match=f"is {of!r}; give 'filling' or 'venting'"):
        plant.opening("w", [u], u, lambda w: [w], [(u, of)])


def test_openings_without_ways_stay_whole():
    assert valved().in_ways().inputs[0].name == "way"
    assert carriage().in_commands().in_ways().inputs[1].name == "axis.a"


def test_openings_start_where_the_commands_do_with_the_plants_own_values():
    other = carriage().with_values({"w": 0.4, "axis.a": -0.9, "b": 1.5, "k": 7.0}).in_openings()
    starts = {v.name: v.start for v in (*other.inputs, *other.parameters)}
    assert starts == pytest.approx({"axis.a_effect": -0.7, "b": 1.5, "d": 0.0, "k": 7.0, "w": 0.4})


def test_a_plant_kept_in_commands_has_no_openings_and_the_same_equations():
    plant = carriage()
    plain = plant.in_commands()
    assert plain.openings == ()
    assert [v.name for v in plain.inputs] == [v.name for v in plant.inputs]
    assert plain.in_openings() is plain
    assert plain.in_commands() is plain
    p = plant.vector("parameter")
    assert flat(plain.function([0, 0], [0, 0.6, 0], p)[0]) == pytest.approx([0, 5 * 0.5])


def test_a_plant_with_openings_travels():
    for plant in (carriage(), valved()):
        there = pickle.loads(pickle.dumps(plant))
        names = [v.name for v in there.in_openings().inputs]
        assert names == [v.name for v in plant.in_openings().inputs]
        x, u, p = (plant.vector(c) + 0.1 for c in ("state", "input", "parameter"))
        for one, two in ((plant, there), (plant.in_openings(), there.in_openings())):
            u = one.vector("input") + 0.1
            assert flat(two.function(x, u, p)[0]) == pytest.approx(flat(one.function(x, u, p)[0]))
        sent = Inversion(there).commands({there.openings[0].name: 0.3})
        assert sent == pytest.approx(Inversion(plant).commands({plant.openings[0].name: 0.3}))


def test_values_go_to_and_fro_between_commands_and_openings():
    inversion = Inversion(carriage())
    assert inversion
    assert not Inversion(carriage().in_commands())
    assert inversion.openings({"axis.a": -0.6, "b": 1.0}) == pytest.approx(
        {"axis.a_effect": -0.5, "b": 1.0}
    )
    assert inversion.commands({"axis_a_effect": 0.9, "x": 0.3}) == pytest.approx(
        {"axis.a": 1.0, "x": 0.3}
    )
    p = np.array([5.0, 0.4])
    assert inversion.openings({"axis.a": -0.6}, p) == pytest.approx({"axis.a_effect": -0.4})
    assert inversion.commands({"axis.a_effect": -0.4}, p) == pytest.approx({"axis.a": -0.6})
    assert inversion.conditions({"axis_a": 0.6, "x": 0.2}) == pytest.approx(
        {"x": 0.2, "axis.a_effect": 0.5}
    )
    assert inversion.conditions(None) == {}
    assert inversion.conditions({"axis_a_effect": 0.3}) == {"axis.a_effect": 0.3}


def test_an_opening_of_two_commands_takes_what_is_not_said_from_their_start():
    inversion = Inversion(valved())
    assert inversion.openings({"fill": 0.7}) == pytest.approx({"way": 0.7 - 0.1})
    assert inversion.openings({"vent": 0.9}) == pytest.approx({"way": 0.4 - 0.9})
    assert inversion.openings({"fill": 0.2, "way": 0.3}) == {"way": 0.3}
    assert inversion.commands({"way": -0.3}) == pytest.approx({"fill": 0.0, "vent": 0.3})
    assert inversion.names({"fill": 2.0, "vent": 5.0, "p": 1.0}) == {"way": 5.0, "p": 1.0}
    assert inversion.names({"vent": 5.0, "fill": 2.0}) == {"way": 5.0}


def test_names_inside_are_those_of_openings():
    one, two = Inversion(carriage()), Inversion(valved())
    assert [one.name(n) for n in ("axis_a", "axis.a", "axis_a_effect", "b")] == [
        *3 * ["axis.a_effect"],
        "b",
    ]
    assert (one.alone("axis.a"), one.alone("b")) == ("axis.a_effect", "b")
    assert (two.alone("fill"), two.name("fill")) == ("fill", "way")
    assert one.variable("axis_a_effect").max == pytest.approx(1.9)
    assert one.variable("axis_a").max == 2.0
    assert one.opening_of("axis.a") is None


def test_references_of_commands_become_rows_of_openings():
    inversion = Inversion(carriage())
    found = inversion.references({"axis_a": [0.6, 1.1, -0.4], "b": 2.0}, 3)
    assert found["axis.a_effect"] == pytest.approx([0.5, 1.0, -0.3])
    assert found["b"] == 2.0
    assert inversion.references({"axis.a": 0.6}, 2)["axis.a_effect"] == pytest.approx([0.5, 0.5])
    assert inversion.references({"b": 1.0}, 2) == {"b": 1.0}


def test_bounds_of_commands_become_bounds_of_openings_and_the_ranges_ends_none():
    inversion = Inversion(carriage())
    inf = np.inf
    assert inversion.bounds({"axis.a": (-0.6, 2.0), "b": (0.0, 1.0)}) == {
        "axis.a_effect": (pytest.approx(-0.5), inf),
        "b": (0.0, 1.0),
    }
    both = inversion.bounds({"axis.a": (-1.0, 1.0), "axis.a_effect": (-0.3, 1.2)})
    assert both == {"axis.a_effect": (-0.3, pytest.approx(0.9))}
    # more venting is less opening; the other valve stands at its start
    two = Inversion(valved()).bounds({"vent": (0.0, 0.3), "fill": (0.2, 1.0)})
    assert two == {"way": (pytest.approx(max(0.4 - 0.3, 0.2 - 0.1)), inf)}


def test_conditions_leave_openings_free_unless_they_name_a_command():
    inversion = Inversion(carriage())
    assert inversion.all_free({"x": 0.1, "axis.a_effect": 0.2})
    assert not inversion.all_free({"x": 0.1, "axis_a": 0.2})
    assert not Inversion(carriage().in_commands()).all_free({"x": 0.1})


def test_rows_of_inputs_keep_each_plants_order():
    one, two = Inversion(carriage()), Inversion(valved())
    sent = np.array([[1.0, 0.6, 0.2], [2.0, -0.4, 0.3]])
    chosen = np.array([[1.0, 0.5, 0.2], [2.0, -0.3, 0.3]])
    assert one.rows(sent) == pytest.approx(chosen)
    assert one.sent(chosen) == pytest.approx(sent)
    p = np.array([5.0, 0.6])
    assert one.rows(sent, p)[0] == pytest.approx([1.0, 0.3, 0.2])
    assert one.sent(np.array([[1.0, 0.3, 0.2]]), p) == pytest.approx(sent[:1])
    duties = np.array([[0.8, 0.1], [0.2, 0.5], [0.3, 0.3]])
    assert two.rows(duties) == pytest.approx(np.array([[0.7], [-0.3], [0.0]]))
    assert two.sent(np.array([[0.7], [-0.2]])) == pytest.approx(np.array([[0.7, 0], [0, 0.2]]))


def test_operating_points_are_entered_and_left_with_their_own_values():
    plant = carriage()
    inversion = Inversion(plant)
    point = plant.with_values(w=0.4, k=2.0).equilibrium({"axis.a": 0.7, "x": 0.3})
    inside = inversion.entered(point)
    assert [v.name for v in inside.plant.inputs] == ["b", "axis.a_effect", "d"]
    assert inside.values["axis.a_effect"] == pytest.approx(0.5)
    assert inside.values["b"] == pytest.approx(-2.0 * 0.5 / 2)
    assert inversion.entered(inside) is inside
    again = inversion.left(inside)
    assert again.plant.vector("parameter") == pytest.approx([2.0, 0.4])
    assert again.u == pytest.approx(point.u)
    assert inversion.carrying(inside).variable("x").start == plant.variable("x").start


def test_a_command_in_its_dead_zone_has_less_slope():
    plant = carriage()
    assert in_dead_zone(plant, np.array([[0.0, 0.5, 0.0], [0.0, 0.1, 0.0]]))
    assert not in_dead_zone(plant, np.array([[0.0, 0.5, 0.0], [0.0, -0.3, 0.0]]))
    assert not in_dead_zone(plant.in_commands(), np.zeros((1, 3)))


def test_an_opening_stands_in_for_inputs_once():
    plant = pam.Plant("wrong")
    x, u = plant.state("x"), plant.input("u")
    refused("stands in for x", plant.opening, "w", [x], x, lambda w: [w], [])
    refused("stands in for nothing", plant.opening, "w", [], u, lambda w: [w], [])
    refused("'u' is declared twice", plant.opening, "u", [u], u, lambda w: [w], [])
    plant.opening("w", [u], u, lambda w: [w], [(u, lambda w: w)])
    refused("'w' is declared twice", plant.opening, "w", [u], u, lambda w: [w], [])


def test_a_servo_of_two_feedbacks_moves_its_spool_and_declares_no_opening():
    """Where the load stands at its reference, the position says nothing: the spool is asked as by
    the pressure alone. One aim without the other does not tell what the valve opens.
    """
    by_pressure, by_both = (
        pam.HangingLoad(
            "DMSP-20-400N",
            10.0,
            feed=pam.feeds.ServoValve(command_lag=0.01, spool=pam.feeds.FirstOrderSpool(), **gains),
        )
        for gains in ({}, {"position_gain": 30.0})
    )
    x, aim = [0.03, 0.1, 2.5e5, 0.4, -0.6], 3.5e5
    one, both = (
        flat(plant.function(x, u, plant.vector("parameter"))[0])
        for plant, u in ((by_pressure, [aim]), (by_both, [aim, x[0]]))
    )
    assert both == pytest.approx(one, rel=1e-12)
    assert by_pressure.openings
    assert by_both.openings == ()
    assert by_both.in_openings() is by_both


def test_an_effect_that_other_inputs_change_is_no_opening():
    plant = pam.Plant("gated")
    x, a, b = plant.state("x"), plant.input("a"), plant.input("b", start=1.0)
    (flow,) = plant.opening("w", [a], a * b, lambda w: [w / b], [(a * b, lambda w: w)])
    plant.der(x, flow)
    assert plant.openings == ()
    assert flat(plant.function([0.0], [2.0, 3.0], [])[0]) == pytest.approx([6.0])

"""Dead zone, its inverse, the two ways of a signed opening, by the sentences that state them."""

import casadi as ca
import numpy as np
import pytest

from pam_ocp.muscles.dead_zone import beyond_dead_zone, dead_zone, dead_zone_inverse, two_ways

c, w = ca.SX.sym("c"), ca.SX.sym("w")
EFFECT = ca.Function("effect", [c, w], [dead_zone(c, w), *beyond_dead_zone(c, w)])
COMMAND = ca.Function("command", [c, w], [dead_zone_inverse(c, w)])
WAYS = ca.Function("ways", [c], list(two_ways(c)))


@pytest.mark.parametrize("width", [0.04, 0.3])
def test_beyond_its_width_a_command_loses_half_of_it(width):
    for command in (width, 1.7 * width, -width, -5.0):
        effect, above, below = (float(e) for e in EFFECT(command, width))
        left = np.sign(command) * (abs(command) - width / 2)
        assert effect == pytest.approx(left, rel=1e-12)
        assert (above, below) == pytest.approx((max(left, 0.0), max(-left, 0.0)), rel=1e-12)


@pytest.mark.parametrize("width", [0.04, 0.3])
def test_within_its_width_it_is_the_integral_of_the_quintic_smoothstep(width):
    for s in (0.1, 0.35, 0.5, 0.8, 0.99):
        grid = np.linspace(0, s, 20001)
        step = grid**3 * (10 - 15 * grid + 6 * grid**2)
        expected = width * np.trapezoid(step, grid)
        assert float(EFFECT(s * width, width)[0]) == pytest.approx(expected, rel=1e-6)
        assert float(EFFECT(-s * width, width)[0]) == pytest.approx(-expected, rel=1e-6)


@pytest.mark.parametrize("width", [0.04, 0.3])
def test_the_inverse_gives_the_command_back_everywhere(width):
    commands = np.concatenate([width * np.array([0.02, 0.3, 0.7, 0.999, 1.0, 1.001]), [0.7, 3.0]])
    for command in (*commands, *-commands):
        effect = float(EFFECT(command, width)[0])
        assert float(COMMAND(effect, width)) == pytest.approx(command, rel=1e-9)
    assert float(COMMAND(0.0, width)) == 0.0


def test_a_valve_without_overlap_has_a_dead_zone_of_a_ten_thousandth():
    assert float(EFFECT(0.5, 0.0)[0]) == pytest.approx(0.5 - 0.5e-4, rel=1e-12)
    assert float(EFFECT(1e-4, 0.0)[0]) == pytest.approx(0.5e-4, rel=1e-9)
    assert float(EFFECT(0.9e-4, 0.0)[0]) > 0.4e-4
    assert float(COMMAND(0.5, 0.0)) == pytest.approx(0.5 + 0.5e-4, rel=1e-12)


def test_two_ways_differ_by_the_opening_and_are_apart_beyond_a_thousandth():
    for opening in (-0.4, -1.1e-3, 1.1e-3, 0.7):
        filling, venting = (float(e) for e in WAYS(opening))
        assert (filling, venting) == pytest.approx((max(opening, 0), max(-opening, 0)), abs=1e-15)
    assert [float(e) for e in WAYS(0.0)] == [0.0, 0.0]
    slopes = ca.Function("slopes", [c], [ca.jacobian(way, c) for way in two_ways(c)])
    assert [float(e) for e in slopes(0.0)] == pytest.approx([0.5, -0.5])
    for part in (-0.6, 0.2, 0.8):
        z = (part + 1) / 2
        share = z**3 * (10 - 15 * z + 6 * z**2)
        filling, venting = (float(e) for e in WAYS(part * 1e-3))
        assert filling == pytest.approx(part * 1e-3 * share, rel=1e-12)
        assert filling - venting == pytest.approx(part * 1e-3, rel=1e-12)

"""The formulas of a dead zone: what it leaves of a command, its exact inverse,
a valve's two ways.
"""

from __future__ import annotations

import casadi as ca

from .law import clamp

LEAST_OVERLAP = 1e-4
"""A dead zone is at least so wide (in the command's unit): a critically lapped valve is rounded so.
"""
ROUNDING = 1e-3
"""Openings smaller than this mix the slopes of filling and venting: half and half at zero."""
_NEWTON_STEPS = 8
"""From the left on a concave function: the error is 1e-16 after six."""


def dead_zone(command: ca.SX, width: ca.SX) -> ca.SX:
    """What is left of a command beyond a dead zone of +-width/2, rounded within ``width`` of zero.

    Zero at zero, sign(c) (|c| - width/2) from ``width`` on, three continuous derivatives.
    """
    above, below = beyond_dead_zone(command, width)
    return ca.SX(above - below)


def beyond_dead_zone(command: ca.SX, width: ca.SX) -> tuple[ca.SX, ca.SX]:
    """The positive and the negative part of :func:`dead_zone`; one of them is always zero."""
    half = ca.fmax(width, LEAST_OVERLAP) / 2
    return clamp(command - half, half), clamp(-command - half, half)


def dead_zone_inverse(effect: ca.SX, width: ca.SX) -> ca.SX:
    """The command of which :func:`dead_zone` leaves ``effect``, to rounding; no iteration is left.

    Within the rounded part, s^4 (2 s^2 - 6 s + 5) = t is solved for s = c/width as
    s (2 s^2 - 6 s + 5)^(1/4) = t^(1/4): rising and concave in s, so Newton's method from its
    tangent at 0 converges from one side, in a fixed number of steps (for C code).
    """
    half = ca.fmax(width, LEAST_OVERLAP) / 2
    size = ca.fabs(effect)
    root = ca.sqrt(ca.sqrt(ca.fmax(ca.fmin(size / half, 1.0), 1e-40)))
    s = root / 5**0.25
    for _ in range(_NEWTON_STEPS):
        factor = 2 * s**2 - 6 * s + 5
        fourth = ca.sqrt(ca.sqrt(factor))
        slope = fourth + s * (s - 1.5) * fourth / factor
        s = s - (s * fourth - root) / slope
    return ca.SX(ca.sign(effect) * ca.if_else(size >= half, size + half, 2 * half * s))


def smooth_step(z: ca.SX) -> ca.SX:
    """0 below z = 0, 1 above z = 1, z^3 (10 - 15 z + 6 z^2) between: two continuous derivatives."""
    z = ca.fmax(ca.fmin(z, 1.0), 0.0)
    return ca.SX(z**3 * (10 - 15 * z + 6 * z**2))


def two_ways(opening: ca.SX) -> tuple[ca.SX, ca.SX]:
    """(filling, venting) of a signed opening: max(w, 0) and max(-w, 0), their difference always w.

    The flows of the two ways differ at the same pressure, so that of w has a kink at zero. Within
    ``ROUNDING`` the ways are mixed smoothly: the slope at zero is the mean of both, whatever the
    last digits of w; there one of the two is slightly negative.
    """
    share = smooth_step((opening / ROUNDING + 1) / 2)
    return ca.SX(opening * share), ca.SX(opening * (share - 1))

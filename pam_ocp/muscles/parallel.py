"""Equal muscles side by side, as one."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from ..core.arguments import with_kinds
from ..core.errors import InputError, require_count
from ..core.stop import turns
from .law import ForceLaw
from .pneumatic_muscle import Muscle

__all__ = ["in_parallel"]

ACROSS = ("radius", "rest_diameter", "wall")
"""Coefficients that are lengths across the muscle."""
PROBES = (np.array([1e5, 3e5, 5e5]), np.array([0.02, 0.11, 0.19]))
"""Pressures and contractions at which a law is looked at."""


@with_kinds
@turns
def in_parallel(muscle: Muscle, count: int) -> Muscle:
    """``count`` equal muscles side by side on the same load, as one muscle.

    Forces, masses, volume and so the air that is needed are ``count`` times those of one; ranges
    and rest length stay. It has the diameter of one tube with their cross-section, so that every
    Volume is scaled with it. Dead volume, valves and losses are those that the plant is given: of
    all together.

    Raises InputError where a law cannot be scaled by its coefficients (one of your own).

    Examples
    --------
    >>> two = pam.muscles.in_parallel(muscle, 2)
    >>> bool(np.isclose(two.law.tension(3e5, 0.1), 2 * muscle.law.tension(3e5, 0.1)))
    True
    """
    require_count("count", count)
    if count == 1:
        return muscle
    return replace(
        muscle,
        law=_scaled(muscle.law, count),
        diameter=None if muscle.diameter is None else math.sqrt(count) * muscle.diameter,
        slack_width=count * muscle.slack_width,
        mass=_times(count, muscle.mass),
        mass_per_length=count * muscle.mass_per_length,
        end_mass=count * muscle.end_mass,
        pull_off=_times(count, muscle.pull_off),
        name=f"{count} x {muscle.name}",
    )


def _times(count: int, value: float | None) -> float | None:
    return None if value is None else count * value


def _scaled(law: ForceLaw, count: int) -> ForceLaw:
    """The law of ``count`` times the force: forces and cross-sections among its coefficients."""
    units = {v.name: v.unit for v in law.coefficient_variables()}

    def factor(name: str, value: Any) -> Any:
        if units[name].startswith("N"):
            return count * value
        return math.sqrt(count) * value if name in ACROSS else value

    scaled = law.substituted(factor)
    p, kappa = (a.ravel() for a in np.meshgrid(*PROBES))
    one, many = (
        np.asarray(part.function()(p[None], kappa[None], list(part.values.values()))[0])
        for part in (law, scaled)
    )
    if not np.allclose(many, count * one, rtol=1e-9, atol=1e-9 * float(np.abs(one).max())):
        raise InputError(
            f"law {law.name!r}: its coefficients in N do not scale the force; build the muscle of "
            f"{count} with a law of its own"
        )
    return scaled

"""What a plant is built with, taken from what a user gives: names of muscles, single components,
numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Real
from typing import Any, cast

import casadi as ca

from ..core.errors import InputError, kind_of
from ..muscles.catalogue import muscle as catalogued
from ..muscles.pneumatic_muscle import Muscle
from .damping import ConstantDamping, Damping, Loss


def as_muscle(value: Any, argument: str = "muscle") -> Muscle:
    """A Muscle, or the muscle of the catalogue that a name stands for."""
    if isinstance(value, Muscle):
        return value
    if isinstance(value, str):
        return catalogued(value)
    raise InputError(
        f"{argument} is {_called(value)}: give a Muscle, or a name of the catalogue such as "
        "'DMSP-20-300'" + ("; a fit gives one, fit.muscle(...)" if hasattr(value, "muscle") else "")
    )


def as_damping(value: Any, default: Damping) -> Damping:
    """A damping component; a number is a constant coefficient."""
    if value is None:
        return default
    if isinstance(value, str | Real):
        return ConstantDamping(cast(float, value))
    return cast(
        Damping, component("damping", value, "coefficient", "a number or StiffnessDamping(0.1)")
    )


def as_losses(value: Any) -> tuple[Loss, ...]:
    """Losses of a muscle: one of them, several, or none."""
    return cast("tuple[Loss, ...]", components("losses", value, "CoulombFriction()"))


def components(argument: str, value: Any, example: str) -> tuple[Any, ...]:
    """One component with a ``force``, several, or none."""
    if value is None:
        return ()
    one = isinstance(value, str | ca.SX) or hasattr(value, "force")
    several = isinstance(value, Iterable) and not one
    return tuple(component(argument, v, "force", example) for v in (value if several else (value,)))


def component(argument: str, value: Any, method: str, example: str) -> Any:
    """``value``, or an InputError when it is no component with this method."""
    if isinstance(value, type) and hasattr(value, method):
        raise InputError(
            f"{argument} holds the class {value.__name__}, not one made of it: write "
            f"{value.__name__}(...)"
        )
    if not callable(getattr(value, method, None)):
        raise InputError(f"{argument} holds {_called(value)}: give components, such as {example}")
    return value


def _called(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else kind_of(value)

"""Equilibria of a plant under conditions, within the variables' bounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..core.errors import PamError, require_instance
from ..core.stop import verb
from ..plants.inversion import Inversion
from ..plants.plant import Plant, Values, require_plant
from .held import Memory
from .operating_point import OperatingPoint, require_point_of
from .rest import ROUGH, TOLERANCE, Expressions, Rest, posed

__all__ = [
    "TOLERANCE",
    "EquilibriumError",
    "OperatingPoint",
    "equilibrium",
]

Array: TypeAlias = NDArray[np.float64]


class EquilibriumError(PamError):
    """No equilibrium meets the conditions within the plant's bounds.

    Examples
    --------
    >>> plant.equilibrium({"muscle.command": 1e5}, mass=300.0)
    Traceback (most recent call last):
    pam_ocp.operating.resting_point.EquilibriumError: no equilibrium of 'hanging_load' ...
    """


@verb
def equilibrium(
    plant: Plant,
    conditions: Values | None = None,
    /,
    *,
    free: Sequence[str] = (),
    expressions: Expressions | None = None,
    guess: OperatingPoint | None = None,
    memory: Memory = "virgin",
    **more: Any,
) -> OperatingPoint:
    """The equilibrium that meets conditions on states, inputs, outputs (or parameters).

    ``equilibrium(plant, x=0.0, stiffness=2e4)``; values of parameters replace the plant's. As many
    conditions are needed as the plant has inputs (each condition fixes one freedom of rest);
    disturbances (external forces) that are not named are held at their start value.

    With hysteresis (BoucWen, MaxwellSlip) rest is a continuum: what these keep is chosen by
    ``memory``, or by naming their states among the values, and needs no condition.

    free : parameters, disturbances and held memories to be found as well, each for one more
        condition: the load that rests at x under 3 bar is ``equilibrium(plant, {"x": 0.05,
        "muscle.command": 3e5}, free=["mass"])["mass"]``. The point's own ``plant`` then has these
        parameters.
    expressions : {label: (CasADi expression of the plant's symbols, value)}, each one more
        condition for what is no variable, such as the co-contraction of a pair: ``{"mean":
        ((plant.expression("muscle1.pressure") + plant.expression("muscle2.pressure")) / 2, 3e5)}``.
    guess : a point to start from (a neighbour), tried first.
    memory : what hysteresis keeps: "virgin" (nothing has slid yet), "above" or "below" (the side
        from which all positions came, everything has slid fully), or {state: value}.
        ``point.memory`` says it. Creep is settled.

    Muscles fed by valves count one input each, their opening, unless commands are named.

    Solved within the variables' bounds by IPOPT from several starts, then by Newton to rounding.
    Raises InputError when the conditions are too few or too many, EquilibriumError when no point
    within the bounds meets them (it names the one that fails, and by how much).

    Examples
    --------
    >>> point = pam.equilibrium(plant, x=0.04)
    >>> print(f"{point['muscle.pressure'] / 1e5:.3f} bar")
    2.687 bar
    >>> load = pam.equilibrium(plant, {"x": 0.05, "muscle.command": 3e5}, free=["mass"])
    >>> print(f"{load['mass']:.2f} kg")
    5.95 kg
    """
    require_instance("conditions", conditions, Mapping, "give values by name", none=True)
    wanted = {**(conditions or {}), **more}
    inversion = Inversion(require_plant(plant))
    require_instance("guess", guess, OperatingPoint, "give an OperatingPoint", none=True)
    if guess is not None:
        require_point_of(plant, guess)
    asked = wanted, free, expressions, memory
    if inversion.all_free(wanted):  # a closed valve's command has no slope, its opening has
        near = None if guess is None else inversion.entered(guess)
        inner = equilibrium(
            inversion.inner, wanted, free=free, expressions=expressions, guess=near, memory=memory
        )
        return _in_commands(inversion, inner, asked)
    search = posed(plant, *asked)
    point, nearest = search.solve(guess)
    if point is None:
        raise EquilibriumError(why_not(search, nearest))
    return point


def resting_point(plant: Plant, wanted: Values) -> OperatingPoint | None:
    """The same, and None where there is none: to say why takes longer than to find that out."""
    inversion = Inversion(plant)
    asked: Any = wanted, (), None, "virgin"
    if inversion.all_free(wanted):
        inner = resting_point(inversion.inner, wanted)
        return None if inner is None else _in_commands(inversion, inner, asked)
    return posed(plant, *asked).solve()[0]


def _in_commands(inversion: Inversion, inner: OperatingPoint, asked: Any) -> OperatingPoint:
    left = inversion.left(inner)
    if len(left.plant.inputs) != len(
        inversion.inner.inputs
    ):  # two valves for one opening are exact
        return left
    return _polished(left, posed(inversion.plant, *asked))


def _polished(near: OperatingPoint, search: Rest) -> OperatingPoint:
    """A point whose commands were inverted, brought to rest: where a dead zone is rounded, they
    are not exact.
    """
    z = search.vector(near)
    found = search.converged(z)
    return replace(near, residual=search.worst(z)) if found is None else search.point(found)


# ---- when there is none -------------------------------------------------------------------------
def why_not(search: Rest, nearest: Array) -> str:
    """What cannot be met, and for each condition the value that the others would allow."""
    plant = search.plant
    wanted = [_said(plant, n, v) for n, v in search.values.items()] + _kept(search)
    remedies = list(dict.fromkeys(filter(None, (_remedy(search, n) for n in search.values))))
    if remedies:
        hint = f"With all else as it is, {' or '.join(remedies)}"
    else:
        near = search.point(np.clip(nearest, search.low, search.high))
        at = ", ".join(
            f"{v.name} = {v.exactly(near[v.name])}" for v in (*plant.states, *plant.inputs)
        )
        worst = search.names[int(np.argmax(np.abs(search.residual(nearest))))]
        missed = f"{worst} is not {'met' if worst in search.values else 'zero'}"
        hint = f"The nearest point is {at}, where {missed}"
    return (
        f"no equilibrium of {plant.name!r} with {', '.join(wanted)} within the plant's bounds. "
        f"{hint}; or change the load or the muscle"
    )


def _kept(search: Rest) -> list[str]:
    """What memories keep, as far as it is not what they start with."""
    moved = {n: v for n, v in search.pinned.items() if v != (search.plant.variable(n).start or 0.0)}
    if len(moved) > 3:
        return ["what its memories hold"]
    return [_said(search.plant, n, v) for n, v in moved.items()]


def _said(plant: Plant, name: str, value: float) -> str:
    known = {v.name for v in plant.variables}
    return f"{name} = {plant.variable(name).exactly(value) if name in known else f'{value:.6g}'}"


def _remedy(search: Rest, name: str) -> str:
    """What to change for condition ``name`` to be met, or the value of it that the others allow.

    Each remedy has been tried: "" where none is sound.
    """
    plant, given = search.plant, search.values[name]
    if name in search.more:
        return ""
    variable = plant.variable(name)
    for high, more_pressure in ((search.high, False), (search.higher, True)):
        point = search.relaxed(name, more_pressure)
        if point is None:
            continue
        value = round(search.point(point)[name] / variable.nominal, 9) * variable.nominal
        if abs(value - given) <= ROUGH * variable.nominal:
            value = given
        told = _tried(search, name, value, point, high)
        if told is None:
            continue
        value, point = told
        beyond = _beyond(search, point, name)
        words = [] if value == given else [f"{name} = {variable.exactly(value)}"]
        if not [*words, *beyond]:
            continue  # met as it stands: nothing to change
        out = " (beyond the plant's range)" if beyond or value > variable.max else ""
        return (
            f"{' with '.join([*words, *([' and '.join(beyond)] if beyond else [])])} would do{out}"
        )
    return ""


def _beyond(search: Rest, point: Array, name: str) -> list[str]:
    """The inputs of a point that lie beyond their range (states only where no input does)."""
    variables = (*search.plant.states, *search.plant.inputs)
    found = [
        (v, z)
        for v, z in zip(variables, point[: len(variables)], strict=True)
        if z > v.max + ROUGH * v.nominal
    ]
    inputs = [(v, z) for v, z in found if v.causality == "input"] or found
    return [f"{v.name} = {v.exactly(z)}" for v, z in inputs if v.name != name]


def _tried(
    search: Rest, name: str, value: float, point: Array, high: Array
) -> tuple[float, Array] | None:
    """The value as it will be printed, and the equilibrium there; None when there is none.

    A printed value is rounded: where that leads beyond the border of what is possible, it goes a
    little further from the value that was given.
    """
    variable, given = search.plant.variable(name), search.values[name]
    factor = variable.display_factor
    for further in (0.0, 1e-5, 1e-4, 1e-3, 1e-2):
        tried = float(f"{(value + further * (value - given)) / factor:.6g}") * factor
        if value == given:
            tried = given
        elif variable.exactly(tried) == variable.exactly(given):
            return None
        most = np.inf if high is search.higher and variable.unit == "Pa" else variable.max
        if not variable.min <= tried <= most:
            continue
        found = search.moved(name, tried).converged(point, high)
        if found is not None:
            return tried, found
    return None

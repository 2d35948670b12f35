"""Rest, maps, vibration and loads for the tab Plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ...core.errors import InputError
from ...figures.film import scene_of
from ...operating.linear import linearize, modes
from ...operating.operating_point import OperatingPoint
from ...operating.resting_point import EquilibriumError, equilibrium
from ...plants.plant import Plant
from ...plants.plant_file import component_of
from ...studies.loads import load_study
from ...vibration.free import free_vibration
from ..made import World, muscle_of, plant_of
from ..work import Say, job

ALONG = 41
"""Pressures of a map of a plant with one muscle."""
ACROSS = 13
"""Pressures of each muscle in a map of a plant with two."""
FRAMES = 61
"""Of a moving picture."""
LEAST = 0.02
"""A map begins at this part of the largest pressure."""


@job("The plant", warm="plant", latest="outline", time_limit=60.0, quiet=True)
def outline_of(say: Say, world: World) -> dict[str, Any]:
    """What a plant consists of, and its picture along its stroke."""
    plant = plant_of(world)
    return {
        "variables": [
            {
                "name": v.name,
                "causality": v.causality,
                "unit": v.display_unit,
                "start": None if v.start is None else float(v.start) / v.display_factor,
            }
            for v in plant.variables
        ],
        "pressures": pressures_of(plant),
        "scene": stroke(plant),
    }


def pressures_of(plant: Plant) -> list[str]:
    """The pressures of its muscles, by name."""
    known = {v.name for v in plant.variables}
    names = [n.removesuffix(".rest_length") for n in known if n.endswith(".rest_length")]
    return sorted(f"{n}.pressure" for n in names if f"{n}.pressure" in known)


def stroke(plant: Plant) -> dict[str, Any] | None:
    """The picture along the stroke of its first position, all else at its start."""
    if not plant.positions:
        return None
    name = next(iter(plant.positions))
    variable = plant.variable(name)
    start = float(variable.start or 0.0)
    low = variable.min if np.isfinite(variable.min) else start - 5 * variable.nominal
    high = variable.max if np.isfinite(variable.max) else start + 5 * variable.nominal
    values = np.linspace(low, high, FRAMES)
    index = [v.name for v in plant.states].index(name)
    x = np.tile(plant.vector("state")[:, None], (1, FRAMES))
    x[index] = values
    u = np.tile(plant.vector("input")[:, None], (1, FRAMES))
    found = scene_of(plant, values / variable.display_factor, x, u)
    if found is not None:
        still = int(np.argmin(np.abs(values)))
        found |= {"along": name, "unit": variable.display_unit, "still": still}
    return found


@job("Operating point", warm="plant", latest="rest", time_limit=60.0, quiet=True)
def rest(say: Say, world: World, point: Mapping[str, float]) -> dict[str, Any]:
    """The equilibrium under conditions: values with units, stability, vibration."""
    plant = plant_of(world)
    found = equilibrium(plant, dict(point))
    shown = []
    for name, value in found.values.items():
        v = found.plant.variable(name)
        clean = 0.0 if abs(value) < 1e-9 * v.nominal else value  # without rounding about zero
        shown.append((name, clean / v.display_factor, v.display_unit))
    swinging = modes(linearize(found.plant, found, stuck=True))
    return {
        "values": {n: float(v) for n, v in found.values.items()},
        "shown": shown,
        "stability": found.stability,
        "modes": [(float(f), float(z)) for f, z, *_ in swinging],
    }


@job("Equilibrium map", warm="plant")
def equilibrium_map(say: Say, world: World) -> dict[str, Any]:
    """Position and stiffness at rest against the pressures of the muscles; NaN where there is none.

    One muscle: arrays (n,); two: (n, n), the first pressure across.
    """
    plant = plant_of(world)
    names = pressures_of(plant)
    if not 1 <= len(names) <= 2 or not plant.positions:
        raise InputError(f"a map needs one or two muscles that move something, not {len(names)}")
    position = next(iter(plant.positions))
    stiffness = _stiffness(plant)
    count = ALONG if len(names) == 1 else ACROSS
    highest = (float(plant.variable(n).max) for n in names)
    tops = [top if np.isfinite(top) else 6e5 for top in highest]
    axes = [np.linspace(LEAST * top, top, count) for top in tops]
    others = [{names[1]: q} for q in axes[1]] if len(names) == 2 else [{}]
    lines = []
    for j, other in enumerate(others):
        say(j / len(others), f"{j} of {len(others)} rows")
        conditions = [{names[0]: p, **other} for p in axes[0]]
        lines.append(_line(plant, conditions, position, stiffness))
    grid = np.array(lines) if len(names) == 2 else lines[0]
    shown, felt = plant.variable(position), plant.variable(stiffness)
    return {
        "pressures": axes,
        "position": grid[..., 0],
        "stiffness": grid[..., 1],
        "names": names,
        "position_name": position,
        "position_unit": (shown.display_unit, shown.display_factor),
        "stiffness_unit": (felt.display_unit, felt.display_factor),
    }


def _line(
    plant: Plant,
    conditions: Sequence[Mapping[str, float]],
    position: str,
    stiffness: str,
) -> Any:
    """(position, stiffness) of equilibria one after the other, each the next one's guess."""
    guess: OperatingPoint | None = None
    rows = []
    for one in conditions:
        try:
            guess = equilibrium(plant, dict(one), guess=guess)
            rows.append((guess[position], guess[stiffness]))
        except EquilibriumError:
            rows.append((np.nan, np.nan))
    return np.array(rows)


def _stiffness(plant: Plant) -> str:
    names = [v.name for v in plant.outputs]
    for name in ("stiffness", *(n for n in names if n.endswith(".stiffness"))):
        if name in names:
            return name
    raise InputError(f"{plant.name!r} has no output for its stiffness, so that there is no map")


@job("Free vibration", warm="plant")
def vibration(say: Say, world: World, offset: float, cycles: float) -> dict[str, Any]:
    """The motion beside the equilibrium, let go: with the pressures held."""
    # constant pressure, as a free vibration wants it
    arrangement = str(world.state["plant"]["arrangement"])
    if ":" not in arrangement and arrangement != "RegulatedLoad":
        world = world.but(plant={**world.state["plant"], "feed": {"kind": "IdealPressure"}})
    plant = plant_of(world)
    known = {v.name for v in plant.variables}
    conditions = {_pressure(n, known): v for n, v in world.state["point"].items()}
    name = next(iter(plant.positions))
    found = free_vibration(plant, conditions, offset, state=name, cycles=cycles)
    motion = found.trajectory
    shown = plant.variable(name)
    chosen = np.unique(np.linspace(0, len(motion.t) - 1, 1500).round().astype(int))
    frames = np.unique(np.linspace(0, len(motion.t) - 1, 4 * FRAMES).round().astype(int))
    x, u = (motion.array([v.name for v in each]).T for each in (plant.states, plant.inputs))
    return {
        "name": name,
        "unit": shown.display_unit,
        "t": motion.t[chosen],
        "values": motion[name][chosen] / shown.display_factor,
        "frequency": found.frequency,
        "damping": found.damping_ratio,
        "scene": scene_of(plant, motion.t[frames], x[:, frames], u[:, frames]),
    }


def _pressure(name: str, known: set[str]) -> str:
    """With ideal pressure, a muscle's command is its pressure."""
    held = name.replace(".command", ".pressure")
    return held if name not in known and held in known else name


@job("Load study", warm="plant")
def loads(
    say: Say, world: World, masses: Sequence[float], pressures: Sequence[float]
) -> dict[str, Any]:
    """The load study of the session's muscle, with the plant's feed, losses and damping."""
    table = {k: v for k, v in world.state["plant"].items() if k in ("feed", "losses", "damping")}
    parts = _parts(table)
    found = load_study(muscle_of(world), list(masses), list(pressures), **parts)
    return {
        "cases": [{k: float(v) for k, v in vars(case).items()} for case in found.cases],
        "words": str(found),
    }


def _parts(table: Mapping[str, Any]) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for name, content in table.items():
        if isinstance(content, list):
            made[name] = [component_of(name, one) for one in content]
        else:
            made[name] = component_of(name, content) if isinstance(content, Mapping) else content
    return made

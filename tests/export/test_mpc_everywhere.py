"""One predictive controller with its estimator in Python, in a system of FMUs, and in C."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import fmpy.ssp.simulation
import numpy as np
import pytest
from c_program import COMPILER, Program

import pam_ocp as pam
from pam_ocp.control import KalmanFilter, block, chain, mpc_block
from pam_ocp.core.variables import Variable
from pam_ocp.export.runner import Runner, UnpackedFmu

STEP, STEPS = 5e-3, 60
GOALS = {"slide": 0.004, "joint": 0.05}


def valve_plant(kind: str) -> pam.Plant:
    """From rest, with spool valves, their dead zone and hysteresis."""
    muscle, memory = pam.muscle("DMSP-20-200N"), pam.losses.BoucWen()
    made = pam.AntagonisticSlide if kind == "slide" else pam.AntagonisticJoint
    plant = made(muscle, losses=memory, feed=pam.feeds.SpoolValve(overlap=0.05))
    point = plant.equilibrium({plant.states[0].name: 0.0, "muscle1.pressure": 3e5})
    return plant.with_values(dict(zip((v.name for v in plant.states), point.x, strict=True)))


def controller(plant: pam.Plant) -> Any:
    place = plant.states[0].name
    measured = {place: 1e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    weights = {"track": {place: 1.0}, "rate": {v.name: 3.0 for v in plant.inputs}}
    mpc = pam.control.Mpc(plant, horizon=15, sample_time=STEP, iterations=1, **weights)
    estimator = KalmanFilter(plant, sample_time=STEP, measured=measured)
    return block(chain([estimator, mpc_block(mpc)]), plant=plant)


def wired(plant: pam.Plant, law: Any) -> dict[str, str]:
    place = plant.states[0].name
    told = {f"wanted.{place}": "goal.place", "enable": "goal.on"}
    sinks = {f"law.{v.name}": told.get(v.name, f"plant.{v.name}") for v in law.inputs}
    return sinks | {f"plant.{v.name}": f"law.{v.name}" for v in plant.inputs}


def by_hand(
    plant: pam.Plant, law: Any, wires: dict[str, str], folder: Path, told: dict[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """The plant's unit under the block's step in Python: all step, then all hand over."""
    unit = UnpackedFmu(folder / "resources" / "plant.fmu", folder / "unpacked")
    names = [v.name for v in (*plant.states, *plant.outputs)]
    memory, parameters = law.start("memory"), law.start("parameters")
    values, rows, seen = dict.fromkeys(wires, 0.0), [], []
    with Runner(unit, "CoSimulation") as real:
        real.initialize({}, 0.0, None)
        for k in range(STEPS):
            entered = [values[f"law.{v.name}"] for v in law.inputs]
            seen.append(entered)
            after = law.step(memory, entered, parameters)
            memory, answered = (np.asarray(m).ravel() for m in after)
            real.set({v.name: values[f"plant.{v.name}"] for v in plant.inputs})
            real.step(k * STEP, STEP)
            sources = {f"plant.{n}": x for n, x in zip(names, real.get(names), strict=True)}
            sources |= {f"law.{v.name}": x for v, x in zip(law.outputs, answered, strict=True)}
            sources |= told
            values = {sink: float(sources[source]) for sink, source in wires.items()}
            rows.append([sources[f"plant.{n}"] for n in names] + list(answered))
    return np.array(rows), np.array(seen)


@pytest.mark.slow
@pytest.mark.parametrize("kind", GOALS)
def test_an_mpc_with_its_estimator_is_the_same_in_python_in_fmus_and_in_c(kind, tmp_path):
    plant = valve_plant(kind)
    law = controller(plant)
    wires = wired(plant, law)
    place = plant.states[0]
    on = Variable("on", "output", description="the controller acts")
    goal = Variable("place", "output", unit=place.unit, nominal=place.nominal)
    columns = {"place": np.full(2, GOALS[kind]), "on": np.ones(2)}
    parts = {"law": law, "plant": plant, "goal": pam.Trajectory([0.0, 1.0], columns, [goal, on])}
    system = pam.export_ssp(parts, wires, tmp_path / "system.ssp", platforms=["native"])
    with zipfile.ZipFile(system) as archive:
        archive.extractall(tmp_path / "parts")
    told, end = {"goal.place": GOALS[kind], "goal.on": 1.0}, (STEPS - 0.5) * STEP
    rows, seen = by_hand(plant, law, wires, tmp_path / "parts", told)
    run = fmpy.ssp.simulation.simulate_ssp(str(system), stop_time=end, step_size=STEP)
    names = [f"plant.{v.name}" for v in (*plant.states, *plant.outputs)]
    names += [f"law.{v.name}" for v in law.outputs]
    found = np.array([run[n] for n in names]).T[-STEPS:]
    sizes = [v.nominal for v in (*plant.states, *plant.outputs, *law.outputs)]
    assert np.abs((found - rows) / sizes).max() < 1e-9
    assert abs(rows[-1, 0] - GOALS[kind]) < 0.2 * abs(GOALS[kind])  # it goes where it is told
    if COMPILER is None:
        pytest.skip("no C compiler here: the system of FMUs was compared, C was not")
    pam.export_c(law, tmp_path / "c", name="law", tolerance=1e-9)
    program = Program(tmp_path / "c", "law", law)
    for k, entered in enumerate(seen):
        given = dict(zip((v.name for v in law.inputs), entered, strict=True))
        answered = np.array(list(program.step(given).values()))
        asked = rows[k, -len(law.outputs) :]
        assert np.abs((answered - asked) / sizes[-len(law.outputs) :]).max() < 1e-9

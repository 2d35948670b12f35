"""FMUs and reference motions for the importers: run by the interpreter that has pam_ocp."""

from __future__ import annotations

import json
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

import pam_ocp as pam
from pam_ocp.control.controller_plants import pid_controller, state_feedback_controller
from pam_ocp.export import export_fmu, export_ssp
from pam_ocp.export.runner import Runner, UnpackedFmu

BAR = 1e5
STEP, STEPS = 1e-3, 400
START = {"x": 0.004, "mass": 1.5}
"""Values an importer sets before the simulation; the FMU's own are others."""
CONSTANT = {"muscle1.command": 4.2 * BAR, "muscle2.command": 2.1 * BAR}


def plant() -> pam.Plant:
    return pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"))


def commands(t: Any) -> dict[str, Any]:
    """Steps of one muscle and ramps of the other, held over each step of the grid."""
    first = np.where(t < 0.05, 3.0, np.where(t < 0.2, 4.5, 2.5))
    second = np.interp(t, [0.0, 0.1, 0.22, 0.3, 0.4], [3.0, 3.0, 1.5, 4.0, 3.5])
    return {"muscle1.command": first * BAR, "muscle2.command": second * BAR}


def write_motion(
    path: Path, model: pam.Plant, inputs: dict[str, Any], given: dict[str, float]
) -> None:
    """A table of one motion: time, inputs, then states and outputs."""
    t = np.arange(STEPS + 1) * STEP
    states = {v.name for v in model.states}
    motion = pam.simulate(
        model,
        inputs,
        t=t,
        start={n: v for n, v in given.items() if n in states},
        parameters={n: v for n, v in given.items() if n not in states},
    )
    names = [v.name for v in (*model.inputs, *model.states, *model.outputs)]
    table = np.column_stack([t, motion.array(names)])
    header = ",".join(["time", *names])
    np.savetxt(path, table, fmt="%.17g", delimiter=",", header=header, comments="")


COMMANDS = tuple(CONSTANT)
WIRES = {
    **{f"plant.{n}": f"pid.{n}" for n in COMMANDS},
    **{f"pid.feedforward.{n}": f"motion.{n}" for n in COMMANDS},
    "pid.reference": "motion.x",
    "pid.position": "plant.x",
}


FEEDBACK_WIRES = {
    **{f"plant.{n}": f"feedback.{n}" for n in COMMANDS},
    **{f"feedback.{n}": f"plant.{n}" for n in ("x", "v", "muscle1.pressure", "muscle2.pressure")},
    "feedback.reference.x": "goal.x",
}


def write_systems(folder: Path, model: pam.Plant) -> None:
    """A PID that follows a motion (system), and an LQI that goes to a goal (feedback)."""
    write_system(folder / "system", model, WIRES, pid_parts(model))
    write_system(folder / "feedback", model, FEEDBACK_WIRES, feedback_parts(model))


def feedback_parts(model: pam.Plant) -> dict[str, Any]:
    point = model.equilibrium(x=0.002, stiffness=2.2e4)
    law = pam.lqr(model, point, integral={"x": 100.0})
    goal = np.array([0.002, 0.002, 0.005, 0.005])
    t = np.array([0.0, 0.05, 0.2, STEPS * STEP])
    start = dict(zip((v.name for v in model.states), point.x.tolist(), strict=True))
    mass = 1.3 * float(model.variable("mass").start or 1.0)
    return {
        "goal": pam.Trajectory(t, {"x": goal}, [model.variable("x")]),
        "feedback": state_feedback_controller(law),
        "plant": model.with_values({**start, "mass": mass}),
    }


def pid_parts(model: pam.Plant) -> dict[str, Any]:
    t = np.arange(STEPS + 1) * STEP
    swing = {COMMANDS[0]: (4 - np.cos(8 * t)) * BAR, COMMANDS[1]: (2 + np.cos(8 * t)) * BAR}
    weights = {COMMANDS[0]: 1.0, COMMANDS[1]: -1.0}
    gains = {"proportional": 2e6, "integral": 1.5e8, "derivative": 1e4}
    return {
        "motion": pam.simulate(model, swing, t=t),
        "pid": pid_controller(model, "x", weights, **gains),
        "plant": model.with_values(mass=1.5 * float(model.variable("mass").start or 1.0)),
    }


def write_system(
    target: Path, model: pam.Plant, wires: dict[str, str], parts: dict[str, Any]
) -> None:
    """Plant, controller and motion as an SSP, and what the system does as a table beside it."""
    path = export_ssp(parts, wires, target.with_suffix(".ssp"), stop_time=STEPS * STEP)
    names = [v.name for v in (*model.states, *model.outputs)]
    t = np.arange(STEPS + 1) * STEP
    table = np.column_stack([t, _coupled(path, wires, list(parts), names)])
    header = ",".join(["time", *names])
    file = target.with_suffix(".csv")
    np.savetxt(file, table, fmt="%.17g", delimiter=",", header=header, comments="")


def _coupled(path: Path, wires: dict[str, str], parts: list[str], names: list[str]) -> Any:
    """The plant's values at each time when all parts step, and then all hand over."""
    with tempfile.TemporaryDirectory() as name:
        folder, runners = Path(name), {}
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        for key in parts:
            fmu = UnpackedFmu(folder / "resources" / f"{key}.fmu", folder / key)
            runners[key] = Runner(fmu, "CoSimulation")
            runners[key].initialize({}, 0.0, None)

        def hand_over() -> None:
            values = {}
            for sink, source in wires.items():
                key, _, variable = source.partition(".")
                values[sink] = float(runners[key].get([variable])[0])
            for sink, value in values.items():
                key, _, variable = sink.partition(".")
                runners[key].set({variable: value})

        for _ in runners:  # the motion's first values reach the plant through the controller
            hand_over()
        rows = [runners["plant"].get(names)]
        for k in range(STEPS):
            for runner in runners.values():
                runner.step(k * STEP, STEP)
            rows.append(runners["plant"].get(names))
            hand_over()
        for runner in runners.values():
            runner.__exit__(None, None, None)
    return np.array(rows)


def build(folder: Path) -> None:
    """Everything the tests of the importers read."""
    folder.mkdir(parents=True, exist_ok=True)
    model = plant()
    for version in ("2.0", "3.0"):
        export_fmu(model, folder / f"slide{version[0]}.fmu", fmi=version)  # type: ignore[arg-type]
    inputs = commands(np.arange(STEPS + 1) * STEP)
    write_motion(folder / "held.csv", model, inputs, START)
    write_motion(folder / "constant.csv", model, CONSTANT, START)
    write_systems(folder, model)
    results = (*model.states, *model.outputs)
    facts = {
        "start": START,
        "step": STEP,
        "inputs": [v.name for v in model.inputs],
        "states": [v.name for v in model.states],
        "nominals": {v.name: v.nominal for v in results},
    }
    (folder / "facts.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]))

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
from pam_ocp.control import block
from pam_ocp.control.controller_plants import pid_controller, state_feedback_controller
from pam_ocp.core.block import Block
from pam_ocp.core.variables import Variable
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


def write_table(path: Path, names: list[str], columns: Any) -> None:
    """Time, and columns at each step."""
    table = np.column_stack([np.arange(STEPS + 1) * STEP, columns])
    header = ",".join(["time", *names])
    np.savetxt(path, table, fmt="%.17g", delimiter=",", header=header, comments="")


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
    write_table(path, names, motion.array(names))


COMMANDS = tuple(CONSTANT)
WIRES = {
    **{f"plant.{n}": f"pid.{n}" for n in COMMANDS},
    **{f"pid.feedforward.{n}": f"motion.{n}" for n in COMMANDS},
    "pid.reference": "motion.x",
    "pid.position": "plant.x",
}


FEEDBACK_STATES = ("x", "v", "muscle1.pressure", "muscle2.pressure")
FEEDBACK_WIRES = {
    **{f"plant.{n}": f"feedback.{n}" for n in COMMANDS},
    **{f"feedback.{n}": f"plant.{n}" for n in FEEDBACK_STATES},
    "feedback.reference.x": "goal.x",
}


SAMPLED_WIRES = {
    **{f"plant.{n}": f"state_feedback.{n}" for n in COMMANDS},
    **{f"state_feedback.{n}": f"plant.{n}" for n in FEEDBACK_STATES},
    "state_feedback.wanted.x": "goal.x",
    "state_feedback.enable": "goal.on",
}


def write_systems(folder: Path, model: pam.Plant) -> None:
    """A PID that follows a motion (system), an LQI that goes to a goal (feedback), the same LQI as
    a sampled block (sampled), and predictive controllers behind Kalman filters, of a slide and of a
    joint (predictive, turning).
    """
    for name, valves in {"predictive": valve_plant(), "turning": valve_plant("joint")}.items():
        export_fmu(valves, folder / f"{name}2.fmu", fmi="2.0", platforms="native")
        write_system(folder / name, valves, predictive_wires(valves), predictive_parts(valves))
    write_system(folder / "sampled", model, SAMPLED_WIRES, sampled_parts(model))
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


def feedback_law(model: pam.Plant) -> Any:
    point = model.equilibrium(x=0.002, stiffness=2.2e4)
    return pam.lqr(model, point, integral={"x": 100.0}, sample_time=STEP)


def enabled(place: Variable, t: Any, values: Any) -> pam.Trajectory:
    """A goal, and the word that the controller acts."""
    on = Variable("on", "output", description="the controller acts")
    return pam.Trajectory(t, {place.name: values, "on": np.ones(len(t))}, [place, on])


def sampled_parts(model: pam.Plant) -> dict[str, Any]:
    parts = feedback_parts(model)
    goal = parts["goal"]
    return {
        "goal": enabled(model.variable("x"), goal.t, goal["x"]),
        "state_feedback": block(feedback_law(model), plant=model),
        "plant": parts["plant"],
    }


GOALS = {"x": 0.004, "theta": 0.05}
"""Where the predictive controllers go."""


def valve_plant(kind: str = "slide") -> pam.Plant:
    """A slide or joint with spool valves, their dead zone and hysteresis, from rest."""
    valves = pam.feeds.SpoolValve(overlap=0.05)
    muscle, memory = pam.muscle("DMSP-20-200N"), pam.losses.BoucWen()
    made = pam.AntagonisticSlide if kind == "slide" else pam.AntagonisticJoint
    model = made(muscle, losses=memory, feed=valves)
    point = model.equilibrium({model.states[0].name: 0.0, "muscle1.pressure": 3 * BAR})
    return model.with_values(dict(zip((v.name for v in model.states), point.x, strict=True)))


def predictive_parts(model: pam.Plant) -> dict[str, Any]:
    place = model.states[0]
    measured = {place.name: 1e-5, "muscle1.pressure": 500.0, "muscle2.pressure": 500.0}
    weights = {v.name: 3.0 for v in model.inputs}
    mpc = pam.control.Mpc(
        model, horizon=15, sample_time=STEP, track={place.name: 1.0}, rate=weights, iterations=1
    )
    estimator = pam.control.KalmanFilter(model, sample_time=STEP, measured=measured)
    law = pam.control.chain([estimator, pam.control.mpc_block(mpc)])
    return {
        "goal": enabled(place, np.array([0.0, STEPS * STEP]), np.full(2, GOALS[place.name])),
        "predictive": block(law, plant=model),
        "plant": model,
    }


def predictive_wires(model: pam.Plant) -> dict[str, str]:
    place = model.states[0].name
    seen = (place, "muscle1.pressure", "muscle2.pressure")
    return {
        **{f"plant.{v.name}": f"predictive.{v.name}" for v in model.inputs},
        **{f"predictive.{n}": f"plant.{n}" for n in seen},
        f"predictive.wanted.{place}": f"goal.{place}",
        "predictive.enable": "goal.on",
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
    """Plant, controller and motion as an SSP, and what the system does as tables beside it: read
    behind each step (NAME.csv), and once inputs are handed over (NAME_handed.csv).
    """
    path = export_ssp(
        parts, wires, target.with_suffix(".ssp"), stop_time=STEPS * STEP, platforms="native"
    )
    names = [v.name for v in (*model.states, *model.outputs)]
    stepped, handed = _coupled(path, wires, list(parts), names)
    write_table(target.with_name(f"{target.name}.csv"), names, stepped)
    write_table(target.with_name(f"{target.name}_handed.csv"), names, handed)


def _coupled(
    path: Path, wires: dict[str, str], parts: list[str], names: list[str]
) -> tuple[Any, Any]:
    """The plant's values at each time when all parts step, and then all hand over. Before, values
    are handed over while all are initialized, until the last part knows them.

    Returns them read before, and behind, the plant is given what was handed over: states are the
    same, outputs that depend on inputs without delay (a valve's flow) are not.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with zipfile.ZipFile(path) as archive:
            archive.extractall(folder)
        units = {
            key: UnpackedFmu(folder / "resources" / f"{key}.fmu", folder / key) for key in parts
        }
        runners: dict[str, Runner] = {}
        values: dict[str, float] = {}

        def hand_over() -> None:
            for sink, source in wires.items():
                key, _, variable = source.partition(".")
                values[sink] = float(runners[key].get([variable])[0])

        def given(key: str) -> dict[str, float]:
            own = f"{key}."
            return {n.removeprefix(own): v for n, v in values.items() if n.startswith(own)}

        for _ in parts:
            for runner in runners.values():
                runner.__exit__(None, None, None)
            runners = {key: Runner(unit, "CoSimulation") for key, unit in units.items()}
            for key, runner in runners.items():
                runner.initialize(given(key), 0.0, None)
            hand_over()
        rows, handed = [runners["plant"].get(names)], []
        for key, runner in runners.items():
            runner.set(given(key))
        handed.append(runners["plant"].get(names))
        for k in range(STEPS):
            for key, runner in runners.items():
                runner.set(given(key))
                runner.step(k * STEP, STEP)
            rows.append(runners["plant"].get(names))
            hand_over()
            runners["plant"].set(given("plant"))
            handed.append(runners["plant"].get(names))
        for runner in runners.values():
            runner.__exit__(None, None, None)
    return np.array(rows), np.array(handed)


PARAMETER = "fade_time"


def write_controller(path: Path, controller: Block) -> dict[str, Any]:
    """What a block's own step answers to measurements that jump every 7 steps; facts of it."""
    rng = np.random.default_rng(5)
    start, scale = controller.start("inputs"), [v.nominal for v in controller.inputs]
    inputs = start + 0.05 * rng.standard_normal((STEPS + 1, len(start))) * scale
    inputs = inputs[np.arange(STEPS + 1) // 7 * 7]
    inputs[:, [v.name for v in controller.inputs].index("enable")] = 1.0
    parameters = [0.02 if v.name == PARAMETER else v.start or 0.0 for v in controller.parameters]
    memory, rows = controller.start("memory"), []
    for row in inputs[:-1]:
        memory, outputs = controller.step(memory, row, parameters)
        rows.append(np.asarray(outputs).ravel())
    names = [v.name for v in (*controller.inputs, *controller.outputs)]
    write_table(path, names, np.column_stack([inputs, [rows[0], *rows]]))
    return {
        "start": {PARAMETER: 0.02},
        "inputs": [v.name for v in controller.inputs],
        "states": [],
        "nominals": {v.name: v.nominal for v in controller.outputs},
    }


def facts_of(model: pam.Plant) -> dict[str, Any]:
    """What a system's results are measured by."""
    nominals = {v.name: v.nominal for v in (*model.states, *model.outputs)}
    return {"start": {}, "inputs": [], "states": [], "nominals": nominals}


def build(folder: Path) -> None:
    """Everything the tests of the importers read."""
    folder.mkdir(parents=True, exist_ok=True)
    model = plant()
    unit = block(feedback_law(model), plant=model)
    for version in ("2.0", "3.0"):
        target = folder / f"controller{version[0]}.fmu"
        export_fmu(unit, target, fmi=version)  # type: ignore[arg-type]
        export_fmu(model, folder / f"slide{version[0]}.fmu", fmi=version)  # type: ignore[arg-type]
    export_fmu(unit, folder / "unclocked3.fmu", fmi="3.0", clock=False)
    inputs = commands(np.arange(STEPS + 1) * STEP)
    write_motion(folder / "held.csv", model, inputs, START)
    write_motion(folder / "constant.csv", model, CONSTANT, START)
    write_systems(folder, model)
    results = (*model.states, *model.outputs)
    valved = {"predictive": valve_plant(), "turning": valve_plant("joint")}
    facts = {
        **{name: facts_of(valves) for name, valves in valved.items()},
        "start": START,
        "step": STEP,
        "inputs": [v.name for v in model.inputs],
        "states": [v.name for v in model.states],
        "nominals": {v.name: v.nominal for v in results},
        "controller": write_controller(folder / "controller.csv", unit),
    }
    (folder / "facts.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")


if __name__ == "__main__":
    build(Path(sys.argv[1]))

"""The FMU of an antagonistic slide in other people's importers, in every mode that each one has."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference import Description, Motion, fmu, importer, needs_run

needs_run()

VERSIONS = ("2", "3")
NANO = 1e9
UNITS = pytest.mark.parametrize(
    ("unit", "played", "what"), [("slide", "held", ""), ("controller", "controller", ", sampled")]
)


@UNITS
def test_libcosimpy_co_simulation(unit: str, played: str, what: str) -> None:
    execution = importer("libcosimpy.CosimExecution").CosimExecution
    slave = importer("libcosimpy.CosimSlave").CosimLocalSlave
    motion, told = Motion(played), Description(fmu("2", unit))
    master = execution.from_step_size(round(motion.step * NANO))
    here = slave(str(fmu("2", unit)), unit)
    index = master.add_local_slave(here)
    override = importer("libcosimpy.CosimManipulator").CosimManipulator.create_override()
    observer = importer("libcosimpy.CosimObserver").CosimObserver.create_last_value()
    assert master.add_manipulator(override)
    assert master.add_observer(observer)
    for name, value in motion.start.items():
        assert master.real_initial_value(index, told.references[name], value)
    rows = []
    for k in range(len(motion.t) - 1):
        assert override.slave_real_values(index, told.of(motion.inputs), motion.inputs_at(k))
        assert master.step()
        rows.append(list(observer.last_real_values(index, told.of(motion.results))))
    motion.check("libcosimpy", "FMI 2 CS" + what, rows)


@UNITS
@pytest.mark.parametrize("version", VERSIONS)
def test_ecospy_co_simulation(version: str, unit: str, played: str, what: str) -> None:
    """ecos 0.7.2 frees the name of a clock's interval twice: its unit of FMI 3 has no clock."""
    ecos = importer("ecospy")
    file = fmu(version, "unclocked" if (version, unit) == ("3", "controller") else unit)
    motion = Motion(played)
    with ecos.EcosSimulationStructure() as structure:
        structure.add_model(unit, str(file))
        structure.add_parameter_set("start", {f"{unit}::{n}": v for n, v in motion.start.items()})
        with ecos.EcosSimulation(step_size=motion.step, structure=structure) as simulation:
            assert simulation.init(parameter_set="start"), ecos.EcosLib.get_last_error()
            rows = []
            for k in range(len(motion.t) - 1):
                for name, value in zip(motion.inputs, motion.inputs_at(k), strict=True):
                    simulation.set_real(f"{unit}::{name}", value)
                simulation.step()
                rows.append([simulation.get_real(f"{unit}::{n}") for n in motion.results])
            simulation.terminate()
    motion.check("ecospy", f"FMI {version} CS{what}", rows)


@UNITS
def test_fmuloader_co_simulation_fmi_2(unit: str, played: str, what: str) -> None:
    fmi = importer("fmuloader.fmi2")
    motion, told = Motion(played), Description(fmu("2", unit))
    with fmi.Fmi2Slave(fmu("2", unit), model_identifier=told.identifier) as slave:
        slave.instantiate(unit, fmi.Fmi2Type.CO_SIMULATION, guid=told.token)
        slave.setup_experiment(start_time=0.0)
        slave.set_real(told.of(motion.start), list(motion.start.values()))
        slave.enter_initialization_mode()
        slave.exit_initialization_mode()
        rows = _stepped(motion, told, slave.set_real, slave.do_step, slave.get_real)
        slave.terminate()
        slave.free_instance()
    motion.check("fmuloader", "FMI 2 CS" + what, rows)


@UNITS
def test_fmuloader_co_simulation_fmi_3(unit: str, played: str, what: str) -> None:
    fmi = importer("fmuloader.fmi3")
    motion, told = Motion(played), Description(fmu("3", unit))
    with fmi.Fmi3Slave(fmu("3", unit), model_identifier=told.identifier) as slave:
        slave.instantiate_co_simulation(unit, instantiation_token=told.token)
        slave.set_float64(told.of(motion.start), list(motion.start.values()))
        slave.enter_initialization_mode(start_time=0.0)
        slave.exit_initialization_mode()
        rows = _stepped(motion, told, slave.set_float64, slave.do_step, slave.get_float64)
        slave.terminate()
        slave.free_instance()
    motion.check("fmuloader", "FMI 3 CS" + what, rows)


SUBSTEPS = 10


@pytest.mark.parametrize("version", VERSIONS)
def test_fmuloader_model_exchange(version: str) -> None:
    """fmuloader brings no integrator: the classical Runge-Kutta method in ten substeps."""
    fmi = importer(f"fmuloader.fmi{version}")
    motion, told = Motion("held"), Description(fmu(version))
    loader = fmi.Fmi2Slave if version == "2" else fmi.Fmi3Slave
    with loader(fmu(version), model_identifier=told.identifier) as model:
        put = model.set_real if version == "2" else model.set_float64
        get = model.get_real if version == "2" else model.get_float64
        if version == "2":
            model.instantiate("slide", fmi.Fmi2Type.MODEL_EXCHANGE, guid=told.token)
            model.setup_experiment(start_time=0.0)
        else:
            model.instantiate_model_exchange("slide", instantiation_token=told.token)
        put(told.of(motion.start), list(motion.start.values()))
        model.enter_initialization_mode()
        model.exit_initialization_mode()
        model.enter_continuous_time_mode()
        rows = []
        for k, time in enumerate(motion.t[:-1]):
            put(told.of(motion.inputs), motion.inputs_at(k))
            _runge_kutta(model, version, float(time), motion)
            rows.append(get(told.of(motion.results)))
        model.terminate()
        model.free_instance()
    motion.check("fmuloader", f"FMI {version} ME", rows)


def _runge_kutta(model: Any, version: str, time: float, motion: Motion) -> None:
    """One communication step of Model Exchange from ``time`` on."""
    n, h = len(motion.states), motion.step / SUBSTEPS
    read = model.get_derivatives if version == "2" else model.get_continuous_state_derivatives

    def rate(at: float, states: Any) -> Any:
        model.set_time(at)
        model.set_continuous_states(list(states))
        return np.array(read(n))

    x = np.array(model.get_continuous_states(n))
    for i in range(SUBSTEPS):
        at = time + i * h
        k1 = rate(at, x)
        k2 = rate(at + h / 2, x + h / 2 * k1)
        k3 = rate(at + h / 2, x + h / 2 * k2)
        k4 = rate(at + h, x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    model.set_continuous_states(list(x))
    model.completed_integrator_step()


def _stepped(motion: Motion, told: Description, put: Any, step: Any, get: Any) -> list[Any]:
    """Co-Simulation by a loader that gives the bare functions."""
    rows = []
    for k, time in enumerate(motion.t[:-1]):
        put(told.of(motion.inputs), motion.inputs_at(k))
        step(float(time), motion.step)
        rows.append(get(told.of(motion.results)))
    return rows


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("version", VERSIONS)
def test_fmpy(version: str, kind: str) -> None:
    fmpy = importer("fmpy")
    motion = Motion("held")
    played = _doubled(motion) if kind == "ModelExchange" else _single(motion)
    result = fmpy.simulate_fmu(
        str(fmu(version)),
        fmi_type=kind,
        stop_time=float(motion.t[-1]),
        output_interval=motion.step,
        step_size=motion.step,
        relative_tolerance=1e-10,
        start_values=motion.start,
        input=played,
        output=motion.results,
    )
    at_end = np.array([np.flatnonzero(np.abs(result["time"] - t) < 1e-9)[-1] for t in motion.t[1:]])
    rows = np.column_stack([result[n] for n in motion.results])[at_end]
    motion.check("fmpy", f"FMI {version} {'CS' if kind == 'CoSimulation' else 'ME'}", rows)


def _single(motion: Motion) -> Any:
    """Inputs at the communication points: FMPy holds them over a step of Co-Simulation."""
    names = ("time", *motion.inputs)
    table = np.empty(len(motion.t), dtype=[(n, float) for n in names])
    for name in names:
        table[name] = motion.columns[name]
    return table


def _doubled(motion: Motion) -> Any:
    """Two rows at each time, an event for FMPy: the input before the jump, and behind it."""
    single = _single(motion)
    table = np.repeat(single, 2)[:-1]
    table["time"] = np.repeat(single["time"], 2)[1:]
    return table


@pytest.mark.parametrize("version", VERSIONS)
def test_casadi_model_exchange(version: str, tmp_path: Path) -> None:
    ca = importer("casadi")
    motion = Motion("held")
    with zipfile.ZipFile(fmu(version)) as archive:
        archive.extractall(tmp_path)
    builder = ca.DaeBuilder("slide", str(tmp_path))
    builder.set("mass", motion.start["mass"])
    states, inputs = builder.x(), builder.u()
    assert set(states) == set(motion.states)
    dae = builder.create("dae", ["x", "u"], ["ode"])
    outputs = builder.create("outputs", ["x", "u"], ["y"])
    shown = builder.y()
    x, u = ca.MX.sym("x", len(states)), ca.MX.sym("u", len(inputs))
    scale = ca.DM([motion.nominals[n] for n in states])
    problem = {"x": x, "u": u, "ode": dae(x=scale * x, u=u)["ode"] / scale}
    options = {"reltol": 1e-11, "abstol": 1e-11}
    over = ca.integrator("over", "cvodes", problem, 0.0, motion.step, options)
    begin = {n: builder.start(n)[0] for n in states} | motion.start
    now = ca.DM([begin[n] for n in states]) / scale
    rows = []
    for k in range(len(motion.t) - 1):
        held = dict(zip(motion.inputs, motion.inputs_at(k), strict=True))
        given = [held[n] for n in inputs]
        now = over(x0=now, u=given)["xf"]
        y = outputs(scale * now, given)
        found = dict(zip(shown, map(float, y.nz), strict=True))
        rows.append([found[n] for n in motion.results])
    motion.check("casadi", f"FMI {version} ME", rows)


@pytest.mark.parametrize("kind", ["CoSimulation", "ModelExchange"])
@pytest.mark.parametrize("version", VERSIONS)
def test_estim8(version: str, kind: str) -> None:
    """estim8 plays no inputs: they are constant, and given like parameters."""
    models = importer("estim8.models")
    motion = Motion("constant")
    given = {**motion.start, **dict(zip(motion.inputs, motion.inputs_at(0), strict=True))}
    model = models.FmuModel(str(fmu(version)), fmi_type=kind, r_tol=1e-10)
    mode = f"FMI {version} {'CS' if kind == 'CoSimulation' else 'ME'}"
    for _ in range(2):  # the second time the instance is reset
        simulation = model.simulate(
            0.0, float(motion.t[-1]), motion.step, parameters=given, observe=motion.results
        )
        rows = np.column_stack([simulation[n].values for n in motion.results])[1:]
        motion.check("estim8", mode, rows)


@pytest.mark.parametrize("version", VERSIONS)
def test_cofmupy_co_simulation(version: str, tmp_path: Path) -> None:
    cofmupy = importer("cofmupy")
    motion = Motion("held")
    table = tmp_path / "commands.csv"
    header = ",".join(["t", *motion.inputs])
    # half a step early: "previous" in this table must not hang on the last bit of a summed time
    times = motion.t - 0.5 * motion.step
    columns = np.column_stack([times, *(motion.columns[n] for n in motion.inputs)])
    np.savetxt(table, columns, fmt="%.17g", delimiter=",", header=header, comments="")
    connections = [
        {
            "source": {"type": "csv", "path": str(table), "variable": name},
            "target": {"id": "slide", "variable": name},
        }
        for name in motion.inputs
    ]
    model = {"id": "slide", "path": str(fmu(version)), "initialization": motion.start}
    config = tmp_path / "config.json"
    config.write_text(json.dumps({"fmus": [model], "connections": connections}))
    coordinator = cofmupy.Coordinator()
    coordinator.start(str(config))
    for _ in motion.t[:-1]:
        coordinator.do_step(motion.step)
    results = coordinator.get_results()
    rows = np.column_stack([results[("slide", n)] for n in motion.results])
    motion.check("cofmupy", f"FMI {version} CS", rows)

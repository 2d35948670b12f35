"""Plant, controller and motion in an SSP 1.0, run by tools that read such systems."""

from __future__ import annotations

from pathlib import Path

import pytest
from reference import FOLDER, Description, Motion, fmu, importer, needs_run

needs_run()

NANO = 1e9
SYSTEMS = pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("system", "SSP, PID"),
        ("feedback", "SSP, LQI"),
        ("sampled", "SSP, sampled LQI"),
        ("predictive", "SSP, Kalman filter and MPC"),
    ],
)


@SYSTEMS
def test_libcosimpy_runs_the_system(name: str, mode: str) -> None:
    execution = importer("libcosimpy.CosimExecution").CosimExecution
    motion, told = (
        Motion(name),
        Description(fmu("2", "valves" if name == "predictive" else "slide")),
    )
    system = Path(FOLDER) / f"{name}.ssp"
    master = execution.from_ssp_file(str(system), step_size=round(motion.step * NANO))
    observer = importer("libcosimpy.CosimObserver").CosimObserver.create_last_value()
    assert master.add_observer(observer)
    index = master.slave_index_from_instance_name("plant")
    rows = []
    for _ in motion.t[:-1]:
        assert master.step()
        rows.append(list(observer.last_real_values(index, told.of(motion.results))))
    motion.check("libcosimpy", mode, rows)


@SYSTEMS
def test_ecospy_runs_the_system(name: str, mode: str) -> None:
    if name == "predictive":
        pytest.skip("ecospy hands over other values before the first step: another motion")
    ecos = importer("ecospy")
    motion = Motion(name)
    system = Path(FOLDER) / f"{name}.ssp"
    with ecos.EcosSimulation(step_size=motion.step, ssp_path=str(system)) as simulation:
        assert simulation.init(parameter_set="initialValues"), ecos.EcosLib.get_last_error()
        rows = []
        for _ in motion.t[:-1]:
            simulation.step()
            rows.append([simulation.get_real(f"plant::{n}") for n in motion.results])
        simulation.terminate()
    motion.check("ecospy", mode, rows)

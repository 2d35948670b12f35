"""Plant, controller and motion in an SSP 1.0, run by tools that read such systems."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from reference import FOLDER, SYSTEM_LIMIT, Description, Motion, fmu, importer, needs_run

needs_run()

NANO = 1e9
SYSTEMS = pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("system", "SSP, PID"),
        ("feedback", "SSP, LQI"),
        ("sampled", "SSP, sampled LQI"),
        ("predictive", "SSP, Kalman filter and MPC"),
        ("turning", "SSP, the same on a joint"),
    ],
)


@SYSTEMS
def test_libcosimpy_runs_the_system(name: str, mode: str) -> None:
    execution = importer("libcosimpy.CosimExecution").CosimExecution
    unit = name if name in ("predictive", "turning") else "slide"
    motion, told = Motion(name), Description(fmu("2", unit))
    system = Path(FOLDER) / f"{name}.ssp"
    master = execution.from_ssp_file(str(system), step_size=round(motion.step * NANO))
    observer = importer("libcosimpy.CosimObserver").CosimObserver.create_last_value()
    assert master.add_observer(observer)
    index = master.slave_index_from_instance_name("plant")
    rows = []
    for _ in motion.t[:-1]:
        assert master.step()
        rows.append(list(observer.last_real_values(index, told.of(motion.results))))
    motion.check("libcosimpy", mode, rows, limit=SYSTEM_LIMIT)


@SYSTEMS
def test_ecospy_runs_the_system(name: str, mode: str) -> None:
    """It reads a unit once it has handed over the inputs of the next step: outputs that depend on
    inputs without delay (the flow of a valve) are those that the next step begins with.
    """
    ecos = importer("ecospy")
    motion, before = Motion(name, handed=True), Motion(name)
    system = Path(FOLDER) / f"{name}.ssp"
    with ecos.EcosSimulation(step_size=motion.step, ssp_path=str(system)) as simulation:
        assert simulation.init(parameter_set="initialValues"), ecos.EcosLib.get_last_error()
        rows = []
        for _ in motion.t[:-1]:
            simulation.step()
            rows.append([simulation.get_real(f"plant::{n}") for n in motion.results])
        simulation.terminate()
    motion.check("ecospy", mode, rows, limit=SYSTEM_LIMIT)
    states = [n for n in motion.results if np.array_equal(motion.columns[n], before.columns[n])]
    assert motion.results[0] in states
    columns = [motion.results.index(n) for n in states]
    before.check("ecospy", mode, np.array(rows)[:, columns], states, limit=SYSTEM_LIMIT)

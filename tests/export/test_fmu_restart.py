"""Model Exchange by an importer whose solver restarts only when the unit asks for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fmpy
import numpy as np
from fmpy.fmi2 import FMU2Model
from fmpy.sundials import CVodeSolver
from fmu_tools import COMMANDS

import pam_ocp as pam
from pam_ocp.export import export_fmu

HELD, PARTS, TOLERANCE = 0.02, 25, 1e-8


class _NoInput:
    """For FMPy's solver: inputs do not change but at our own events."""

    def nextEvent(self, _: float) -> float:
        return np.inf

    def apply(self, *_: Any, **__: Any) -> None:
        return None


def exchanged(plant: pam.Plant, folder: Path, values: Any, listens: bool) -> Any:
    """States at the ends of all parts; ``listens``: restart where values of states "changed"."""
    path = export_fmu(plant, folder / f"{listens}.fmu", platforms="native")
    told = fmpy.read_model_description(str(path))
    references = {v.name: v.valueReference for v in told.modelVariables}
    commands = [references[n] for n in COMMANDS]
    states = [references[v.name] for v in plant.states]
    model = FMU2Model(
        guid=told.guid,
        unzipDirectory=fmpy.extract(str(path), str(folder / f"u{listens}")),
        modelIdentifier=plant.name,
        instanceName="m",
    )
    model.instantiate()
    model.setupExperiment(startTime=0.0)
    model.enterInitializationMode()
    model.setReal(commands, list(values[0]))
    model.exitInitializationMode()
    model.newDiscreteStates()
    model.enterContinuousTimeMode()
    solver = CVodeSolver(
        nx=len(states),
        nz=0,
        get_x=model.getContinuousStates,
        set_x=model.setContinuousStates,
        get_dx=model.getDerivatives,
        get_z=model.getEventIndicators,
        get_nominals=model.getNominalsOfContinuousStates,
        set_time=model.setTime,
        input=_NoInput(),
        startTime=0.0,
        relativeTolerance=TOLERANCE,
        maxNumSteps=100_000,
    )
    rows = [model.getReal(states)]
    for k in range(PARTS):
        if k:
            model.enterEventMode()
            model.setReal(commands, list(values[k]))
            changed = model.newDiscreteStates()[3]
            model.enterContinuousTimeMode()
            if listens and changed:
                solver.reset(k * HELD)
        solver.step(k * HELD, (k + 1) * HELD)
        rows.append(model.getReal(states))
    model.terminate()
    model.freeInstance()
    return np.array(rows)


def test_an_importer_that_restarts_when_asked_is_right_where_inputs_jump(tmp_path):
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"))
    values = np.random.default_rng(31).uniform(0.5e5, 5.5e5, (PARTS, 2))
    held = dict(zip(COMMANDS, np.vstack([values, values[-1]]).T, strict=True))
    t = np.arange(PARTS + 1) * HELD
    truth = pam.simulate(plant, held, t=t, interpolation="previous", rtol=1e-11)
    names = [v.name for v in plant.states]
    scale = plant.vector("state", None, "nominal")

    def error(listens: bool) -> float:
        try:
            found = exchanged(plant, tmp_path, values, listens)
        except RuntimeError:  # CVODE gives up
            return np.inf
        return float(np.max(np.abs(found - truth.array(names)) / scale))

    assert error(True) < 1e-5
    assert error(False) > 1e-2

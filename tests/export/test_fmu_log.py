"""What an FMU writes into the importer's log, and what it keeps to itself."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from conftest import BAR
from fmpy import fmi2, fmi3
from fmpy.fmi1 import FMICallException
from fmu_tools import KINDS, VERSIONS

from pam_ocp.export.runner import UnpackedFmu

WARNING, ERROR = 1, 3
Line = tuple[int, str, str]  # status, category, message


def instance(fmu: UnpackedFmu, kind: str, logging: bool, lines: list[Line]) -> Any:
    """An FMPy instance before initialization whose log goes to ``lines``."""
    interface = getattr(fmu.description, kind[0].lower() + kind[1:])
    module = fmi2 if fmu.fmi == "2.0" else fmi3
    name = f"FMU{fmu.fmi[0]}{'Model' if kind == 'ModelExchange' else 'Slave'}"
    inner = getattr(module, name)(
        guid=fmu.description.guid,
        unzipDirectory=str(fmu.folder),
        modelIdentifier=interface.modelIdentifier,
    )
    if fmu.fmi == "3.0":
        inner.instantiate(
            loggingOn=logging,
            logMessage=lambda _, status, category, text: lines.append(
                (status, category.decode(), text.decode())
            ),
        )
        return inner
    callbacks = fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(
        lambda _, __, status, category, text: lines.append(
            (status, category.decode(), text.decode())
        )
    )
    callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
    callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
    inner.instantiate(callbacks=callbacks, loggingOn=logging)
    return inner


def initialize(inner: Any, fmu: UnpackedFmu) -> None:
    if fmu.fmi == "2.0":
        inner.setupExperiment(startTime=0.0)
    inner.enterInitializationMode()
    inner.exitInitializationMode()


def setter(inner: Any, fmu: UnpackedFmu) -> Callable[[str, float], None]:
    write = inner.setReal if fmu.fmi == "2.0" else inner.setFloat64
    return lambda name, value: write([fmu.references[name]], [value])


@pytest.mark.parametrize("kind", KINDS)
def test_an_input_outside_its_range_is_logged_once_and_used(fmu: UnpackedFmu, kind: str) -> None:
    lines: list[Line] = []
    inner = instance(fmu, kind, False, lines)
    initialize(inner, fmu)
    write = setter(inner, fmu)
    write("muscle1.command", 6 * BAR)  # its max
    assert lines == []
    for value in (90 * BAR, 91 * BAR, 3 * BAR, 90 * BAR):
        write("muscle1.command", value)
    ((status, category, text),) = lines
    assert (status, category) == (WARNING, "logStatusWarning")
    assert "muscle1.command = 9e+06 is outside 0 .. 600000" in text
    read = inner.getReal if fmu.fmi == "2.0" else inner.getFloat64
    assert read([fmu.references["muscle1.command"]])[0] == 90 * BAR
    write("muscle2.command", -BAR)
    assert len(lines) == 2
    assert "muscle2.command = -100000" in lines[1][2]
    inner.reset()
    write("muscle1.command", 90 * BAR)
    assert len(lines) == 3
    inner.freeInstance()


def test_each_instance_warns_for_itself(fmu: UnpackedFmu) -> None:
    lines: tuple[list[Line], list[Line]] = ([], [])
    for own in lines:
        inner = instance(fmu, "CoSimulation", True, own)
        setter(inner, fmu)("muscle1.command", 90 * BAR)
        inner.freeInstance()
    assert [len(own) for own in lines] == [1, 1]


def test_rounding_at_a_bound_is_not_worth_a_word(fmu: UnpackedFmu) -> None:
    lines: list[Line] = []
    inner = instance(fmu, "CoSimulation", True, lines)
    write = setter(inner, fmu)
    write("muscle1.command", 6 * BAR * (1 + 1e-8))
    write("muscle2.command", -1e-3)
    assert lines == []
    write("muscle1.command", 6 * BAR * (1 + 1e-4))
    assert len(lines) == 1
    inner.freeInstance()


def test_a_slope_that_leads_an_input_out_of_its_range_is_logged(
    fmus: dict[str, UnpackedFmu],
) -> None:
    lines: list[Line] = []
    fmu = fmus["2.0"]  # FMI 3 has no slopes of inputs
    inner = instance(fmu, "CoSimulation", False, lines)
    initialize(inner, fmu)
    setter(inner, fmu)("muscle1.command", 5 * BAR)
    inner.setRealInputDerivatives([fmu.references["muscle1.command"]], [1], [100 * BAR])
    inner.doStep(0.0, 0.1)
    assert [line[:2] for line in lines] == [(WARNING, "logStatusWarning")]
    inner.freeInstance()


def test_an_input_that_is_not_a_number_stays_an_error(fmu: UnpackedFmu) -> None:
    lines: list[Line] = []
    inner = instance(fmu, "CoSimulation", True, lines)
    with pytest.raises(FMICallException) as failure:
        setter(inner, fmu)("muscle1.command", np.nan)
    assert failure.value.status == ERROR
    assert [line[:2] for line in lines] == [(ERROR, "logStatusError")]
    inner.freeInstance()


@pytest.mark.parametrize("categories", [["logSteps"], ["logAll"]])
def test_steps_that_go_well_are_logged_only_when_asked_for(
    fmu: UnpackedFmu, categories: list[str]
) -> None:
    lines: list[Line] = []
    inner = instance(fmu, "CoSimulation", True, lines)
    initialize(inner, fmu)
    for k in range(5):
        inner.doStep(k * 0.01, 0.01)
    assert lines == []
    inner.setDebugLogging(True, categories)
    inner.doStep(0.05, 0.01)
    assert [line[:2] for line in lines] == [(0, "logSteps")]
    inner.freeInstance()


def test_warnings_can_be_switched_off_and_on(fmu: UnpackedFmu) -> None:
    lines: list[Line] = []
    inner = instance(fmu, "CoSimulation", False, lines)
    write = setter(inner, fmu)
    inner.setDebugLogging(False, ["logStatusWarning"])
    write("muscle1.command", 90 * BAR)
    assert lines == []
    inner.setDebugLogging(True, ["logStatusWarning"])
    write("muscle1.command", 90 * BAR)
    assert len(lines) == 1
    inner.freeInstance()


@pytest.mark.parametrize("fmi", VERSIONS)
def test_every_category_is_in_the_description(fmi: str, fmus: dict[str, UnpackedFmu]) -> None:
    text = (fmus[fmi].folder / "modelDescription.xml").read_text()
    for name in ("logStatusError", "logStatusDiscard", "logStatusWarning", "logSteps", "logAll"):
        assert f'<Category name="{name}"' in text

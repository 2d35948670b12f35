"""What an FMU writes into the importer's log, and what it keeps to itself."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import BAR
from fmpy import fmi2, fmi3
from fmpy.fmi1 import FMICallException
from fmu_tools import KINDS

from pam_ocp.export.runner import UnpackedFmu

WARNING, ERROR = 1, 3
Line = tuple[int, str, str]  # status, category, message


class Logged:
    """An FMPy instance before initialization, and what it writes into its log; freed at the end."""

    def __init__(self, fmu: UnpackedFmu, kind: str = "CoSimulation", logging: bool = True) -> None:
        self.fmu, self.lines = fmu, list[Line]()
        interface = getattr(fmu.description, kind[0].lower() + kind[1:])
        module = fmi2 if fmu.fmi == "2.0" else fmi3
        name = f"FMU{fmu.fmi[0]}{'Model' if kind == 'ModelExchange' else 'Slave'}"
        self.inner = getattr(module, name)(
            guid=fmu.description.guid,
            unzipDirectory=str(fmu.folder),
            modelIdentifier=interface.modelIdentifier,
        )
        if fmu.fmi == "3.0":
            heard = lambda _, *line: self._heard(*line)  # noqa: E731
            self.inner.instantiate(loggingOn=logging, logMessage=heard)
            return
        callbacks = fmi2.fmi2CallbackFunctions()
        heard = lambda _, __, *line: self._heard(*line)  # noqa: E731
        callbacks.logger = fmi2.fmi2CallbackLoggerTYPE(heard)
        callbacks.allocateMemory = fmi2.defaultCallbacks.allocateMemory
        callbacks.freeMemory = fmi2.defaultCallbacks.freeMemory
        self.inner.instantiate(callbacks=callbacks, loggingOn=logging)

    def _heard(self, status: int, category: bytes, text: bytes) -> None:
        self.lines.append((status, category.decode(), text.decode()))

    def __enter__(self) -> Logged:
        return self

    def __exit__(self, *_: Any) -> None:
        self.inner.freeInstance()

    def initialize(self) -> None:
        if self.fmu.fmi == "2.0":
            self.inner.setupExperiment(startTime=0.0)
        self.inner.enterInitializationMode()
        self.inner.exitInitializationMode()

    def write(self, name: str, value: float) -> None:
        write = self.inner.setReal if self.fmu.fmi == "2.0" else self.inner.setFloat64
        write([self.fmu.references[name]], [value])

    @property
    def kinds(self) -> list[tuple[int, str]]:
        return [line[:2] for line in self.lines]


@pytest.mark.parametrize("kind", KINDS)
def test_an_input_outside_its_range_is_logged_once_and_used(fmu, kind):
    with Logged(fmu, kind, False) as one:
        one.initialize()
        one.write("muscle1.command", 6 * BAR)  # its max
        assert one.lines == []
        for value in (90 * BAR, 91 * BAR, 3 * BAR, 90 * BAR):
            one.write("muscle1.command", value)
        ((status, category, text),) = one.lines
        assert (status, category) == (WARNING, "logStatusWarning")
        assert "muscle1.command = 9e+06 is outside 0 .. 600000" in text
        read = one.inner.getReal if fmu.fmi == "2.0" else one.inner.getFloat64
        assert read([fmu.references["muscle1.command"]])[0] == 90 * BAR
        one.write("muscle2.command", -BAR)
        assert len(one.lines) == 2
        assert "muscle2.command = -100000" in one.lines[1][2]
        one.inner.reset()
        one.write("muscle1.command", 90 * BAR)
        assert len(one.lines) == 3


def test_each_instance_warns_for_itself(fmu):
    for _ in range(2):
        with Logged(fmu) as one:
            one.write("muscle1.command", 90 * BAR)
            assert len(one.lines) == 1


def test_rounding_at_a_bound_is_not_worth_a_word(fmu):
    with Logged(fmu) as one:
        one.write("muscle1.command", 6 * BAR * (1 + 1e-8))
        one.write("muscle2.command", -1e-3)
        assert one.lines == []
        one.write("muscle1.command", 6 * BAR * (1 + 1e-4))
        assert len(one.lines) == 1


def test_a_slope_that_leads_an_input_out_of_its_range_is_logged(fmus):
    fmu = fmus["2.0"]  # FMI 3 has no slopes of inputs
    with Logged(fmu, logging=False) as one:
        one.initialize()
        one.write("muscle1.command", 5 * BAR)
        command = [fmu.references["muscle1.command"]]
        one.inner.setRealInputDerivatives(command, [1], [100 * BAR])
        one.inner.doStep(0.0, 0.1)
        assert one.kinds == [(WARNING, "logStatusWarning")]


def test_an_input_that_is_not_a_number_stays_an_error(fmu):
    with Logged(fmu) as one:
        with pytest.raises(FMICallException) as failure:
            one.write("muscle1.command", np.nan)
        assert failure.value.status == ERROR
        assert one.kinds == [(ERROR, "logStatusError")]


@pytest.mark.parametrize("categories", [["logSteps"], ["logAll"]])
def test_steps_that_go_well_are_logged_only_when_asked_for(fmu, categories):
    with Logged(fmu) as one:
        one.initialize()
        for k in range(5):
            one.inner.doStep(k * 0.01, 0.01)
        assert one.lines == []
        one.inner.setDebugLogging(True, categories)
        one.inner.doStep(0.05, 0.01)
        assert one.kinds == [(0, "logSteps")]


def test_warnings_can_be_switched_off_and_on(fmu):
    with Logged(fmu, logging=False) as one:
        for wanted in (False, True):
            one.inner.setDebugLogging(wanted, ["logStatusWarning"])
            one.write("muscle1.command", 90 * BAR)
            assert len(one.lines) == wanted


def test_every_category_is_in_the_description(fmu):
    text = (fmu.folder / "modelDescription.xml").read_text()
    for name in ("logStatusError", "logStatusDiscard", "logStatusWarning", "logSteps", "logAll"):
        assert f'<Category name="{name}"' in text

"""Saved states of an FMU, and many instances."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmu_tools import COMMANDS, bars_every, now, started

from pam_ocp.export.runner import Runner, UnpackedFmu

# ---- saved states --------------------------------------------------------------------------------


def test_a_restored_state_continues_to_the_last_bit_in_another_instance(fmu: UnpackedFmu) -> None:
    t, commands = bars_every(0.002, 0.1)
    outputs = fmu.names("output")

    def play(runner: Runner, low: int, high: int) -> Any:
        for k in range(low, high):
            runner.set(dict(zip(COMMANDS, commands[k], strict=True)))
            runner.step(t[k], t[k + 1] - t[k])
        return runner.get(outputs)

    with started(fmu, "CoSimulation", {"mass": 1.7}) as one:
        play(one, 0, 20)
        saved = one.save()
        end = play(one, 20, 50)
    with started(fmu, "CoSimulation") as other:
        other.restore(saved)
        assert np.array_equal(play(other, 20, 50), end)
        other.restore(saved)  # once more: a rollback
        assert np.array_equal(play(other, 20, 50), end)
    assert saved[:8] == bytes(8)


@pytest.mark.parametrize("place", [0, 9, 17, 21, 40, 100, -1])
def test_damaged_states_are_refused(fmu: UnpackedFmu, place: int) -> None:
    with started(fmu, "CoSimulation") as runner:
        saved = bytearray(runner.save())
        saved[place] ^= 0xFF
        with pytest.raises(FMICallException):
            runner.restore(bytes(saved))
        with pytest.raises(FMICallException):
            runner.restore(bytes(saved[:-8]))
        assert len(runner.log) == 2
        runner.step(0.0, 0.01)  # and nothing has happened


def test_a_state_of_the_other_kind_is_refused(fmu: UnpackedFmu) -> None:
    with started(fmu, "ModelExchange") as exchange, started(fmu, "CoSimulation") as simulation:
        with pytest.raises(FMICallException):
            simulation.restore(exchange.save())
        assert "Model Exchange" in simulation.log[-1][1]


def test_reset_brings_back_the_start(fmu: UnpackedFmu) -> None:
    with started(fmu, "CoSimulation", {"x": 0.01, "mass": 1.0}) as runner:
        runner.step(0.0, 0.01)
        runner.inner.reset()
        runner.initialize({}, 0.0, None)
        assert list(runner.get(["x", "mass"])) == [0.0, 2.0]
        assert now(runner) == 0.0


# ---- many instances ------------------------------------------------------------------------------


def test_instances_do_not_disturb_each_other(fmu: UnpackedFmu) -> None:
    t, commands = bars_every(0.005, 0.1)

    def alone(mass: float) -> Any:
        with started(fmu, "CoSimulation", {"mass": mass}) as runner:
            for k, (low, high) in enumerate(pairwise(t)):
                runner.set(dict(zip(COMMANDS, commands[k], strict=True)))
                runner.step(low, high - low)
            return runner.get(["x", "v"])

    runners = [started(fmu, "CoSimulation", {"mass": m}) for m in (1.0, 2.0, 4.0)]
    for k, (low, high) in enumerate(pairwise(t)):
        for runner in runners:
            runner.set(dict(zip(COMMANDS, commands[k], strict=True)))
            runner.step(low, high - low)
    together = [runner.get(["x", "v"]) for runner in runners]
    for runner in runners:
        runner.__exit__(None, None, None)
    assert np.array_equal(together, [alone(m) for m in (1.0, 2.0, 4.0)])

"""Directional and adjoint derivatives of an FMU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import BAR, benchmark_slide, flat
from fmpy.fmi1 import FMICallException
from fmu_tools import COMMANDS, KINDS, started

import pam_ocp as pam
from pam_ocp.export.runner import UnpackedFmu

# ---- partial derivatives
# --------------------------------------------------------------------------


def _jacobian_by_differences(plant: pam.Plant, x: Any, u: Any) -> Any:
    """d(xdot, y)/d(x, u) by central differences of the plant's own function in Python."""
    p = plant.vector("parameter")
    nominal = [*plant.vector("state", None, "nominal"), *plant.vector("input", None, "nominal")]
    point = np.concatenate([x, u])

    def value(z: Any) -> Any:
        xdot, y, _ = plant.function(z[: len(x)], z[len(x) :], p)
        return np.concatenate([flat(xdot), flat(y)])

    columns = []
    for i, size in enumerate(nominal):
        step = np.zeros(len(point))
        step[i] = 1e-5 * size
        columns.append((value(point + step) - value(point - step)) / (2 * step[i]))
    return np.array(columns).T


@pytest.mark.parametrize("kind", KINDS)
def test_directional_derivatives_agree_with_differences(fmu: UnpackedFmu, kind: str) -> None:
    plant = benchmark_slide()
    x, u = np.array([0.004, 0.1, 2.5 * BAR, 3.5 * BAR]), np.array([3 * BAR, 2 * BAR])
    knowns = [*fmu.states, *COMMANDS]
    unknowns = [f"der({n})" for n in fmu.states] + [v.name for v in plant.outputs]
    expected = _jacobian_by_differences(plant, x, u)
    with started(fmu, kind, dict(zip(knowns, [*x, *u], strict=True))) as runner:
        for column, known in enumerate(knowns):
            found = runner.directional(unknowns, [known], [1.0])
            scale = np.max(np.abs(expected), axis=1)
            assert np.max(np.abs(found - expected[:, column]) / scale) < 1e-6
        with pytest.raises(FMICallException):
            runner.directional(unknowns, ["muscle1.force"], [1.0])


def test_states_are_outputs_of_themselves_and_parameters_are_known(fmu: UnpackedFmu) -> None:
    with started(fmu, "ModelExchange") as runner:
        assert list(runner.directional(["x", "v"], ["v", "x"], [2.0, 5.0])) == [5.0, 2.0]
    with started(fmu, "ModelExchange", {"muscle1.command": 5 * BAR}) as runner:
        at = runner.get(["muscle1.pressure"])[0]
        slope = runner.directional(["der(muscle1.pressure)"], ["muscle1.lag"], [1.0])
        assert slope[0] == pytest.approx(-(5 * BAR - at) / 0.05**2)


def test_adjoint_and_directional_derivatives_agree_in_the_dot_product(
    fmus: dict[str, UnpackedFmu],
) -> None:
    fmu, rng = fmus["3.0"], np.random.default_rng(11)
    knowns = [*fmu.states, *fmu.names("input"), *fmu.names("parameter")]
    unknowns = [*fmu.names("output"), *(f"der({n})" for n in fmu.states)]
    seed = rng.normal(size=len(knowns)) * fmu.nominals(knowns)
    weight = rng.normal(size=len(unknowns)) / fmu.nominals(unknowns)
    with started(fmu, "ModelExchange", {"x": 0.003}) as runner:
        forward = runner.directional(unknowns, knowns, list(seed))
        references = (runner.references(unknowns), runner.references(knowns))
        reverse = np.array(
            runner.inner.getAdjointDerivative(*references, list(weight), len(knowns))
        )
    terms = np.concatenate([weight * forward, -reverse * seed])
    assert abs(np.sum(terms)) < 1e-12 * np.sum(np.abs(terms))

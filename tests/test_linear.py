"""Equilibria and linearisation."""

import re

import numpy as np
import pytest
from conftest import BAR, flat

import pam_ocp as pam
from pam_ocp import EquilibriumError, InputError


@pytest.mark.parametrize(
    ("mass", "bar", "position", "frequency"),
    [
        (20, 2, 34.6, 2.74), (20, 4, 80.8, 3.43), (20, 6, 97.3, 4.20),
        (50, 2, 5.4, 3.10), (50, 4, 49.5, 2.21), (50, 6, 76.2, 2.66),
        (10, 4, 91.4, 4.85), (100, 6, 41.5, 1.92),
    ],
)  # fmt: skip
def test_the_hanging_load_rests_and_swings_where_the_reference_says(
    hanging, mass, bar, position, frequency
):
    point = hanging.equilibrium({"mass": mass, "muscle.command": bar * BAR})
    assert point["x"] * 1e3 == pytest.approx(position, abs=0.05)
    ((found, damping),) = pam.modes(hanging.linearize(point))
    assert found == pytest.approx(frequency, abs=0.005)
    assert damping == pytest.approx(0.1, rel=1e-6)


def test_poles_are_those_of_the_second_order_equation(hanging):
    point = hanging.equilibrium(x=0.06)
    k, m, zeta = point["stiffness"], 20.0, 0.1
    w = np.sqrt(k / m)
    expected = [
        -1 / 0.05,
        complex(-zeta * w, w * np.sqrt(1 - zeta**2)),
        complex(-zeta * w, -w * np.sqrt(1 - zeta**2)),
    ]
    poles = hanging.linearize(point).poles()
    assert sorted(poles, key=lambda s: (s.real, s.imag)) == pytest.approx(
        sorted(expected, key=lambda s: (complex(s).real, complex(s).imag)), rel=1e-6
    )


def test_jacobians_agree_with_finite_differences(slide):
    point = slide.equilibrium({"x": 0.004, "stiffness": 2.5e4})
    system = slide.linearize(point)
    p = slide.vector("parameter")
    n = len(point.x)

    def values(z):
        xdot, y, _ = slide.function(z[:n], z[n:], p)
        return np.concatenate([flat(xdot), z[:n], flat(y)])

    z = np.concatenate([point.x, point.u])
    step = 1e-5 * np.concatenate([slide.vector(c, attribute="nominal") for c in ("state", "input")])
    columns = [
        (8 * (values(z + h) - values(z - h)) - (values(z + 2 * h) - values(z - 2 * h)))
        / (12 * h.sum())
        for h in np.diag(step)
    ]
    expected = np.column_stack(columns)
    found = np.block([[system.A, system.B], [system.C, system.D]])
    scale = np.maximum(np.abs(expected), 1e-6 * np.abs(expected).max(axis=1, keepdims=True) + 1e-12)
    assert np.max(np.abs(found - expected) / scale) < 1e-5


def test_signals_keep_their_names_in_python_control(slide):
    system = slide.linearize(inputs=["muscle1.command"], outputs=["x", "muscle1.force"])
    assert system.input_labels == ["muscle1_command"]
    assert system.output_labels == ["x", "muscle1_force"]
    assert system.state_labels == ["x", "v", "muscle1_pressure", "muscle2_pressure"]
    assert system.name == "antagonistic_slide"


def test_a_slide_rests_at_the_stiffness_asked_for(slide):
    point = slide.equilibrium(x=0.0, stiffness=2e4)
    assert point["stiffness"] == pytest.approx(2e4, rel=1e-12)
    assert point["muscle1.force"] == pytest.approx(point["muscle2.force"], rel=1e-12)
    assert point.residual < 1e-9


def test_too_few_conditions_are_counted(slide):
    with pytest.raises(InputError, match=r"needs 2 condition.*1 given: x"):
        slide.equilibrium(x=0.0)


def test_a_load_too_heavy_says_the_pressure_that_would_carry_it(hanging, long_muscle):
    needed = float(long_muscle.law.pressure(100.0 * 9.80665, 0.0)) / BAR
    with pytest.raises(
        EquilibriumError, match=r"no equilibrium.*muscle\.command = 2 bar"
    ) as caught:
        hanging.equilibrium({"mass": 100.0, "muscle.command": 2 * BAR})
    suggested = re.search(r"muscle\.command = ([\d.]+) bar would do", str(caught.value))
    assert float(suggested[1]) == pytest.approx(needed, rel=1e-4)
    with pytest.raises(EquilibriumError, match=r"beyond the plant's range"):
        hanging.equilibrium({"mass": 250.0, "muscle.command": 2 * BAR})


def test_a_condition_outside_its_range_is_refused(hanging):
    with pytest.raises(InputError, match="x: the condition = 500 mm is outside"):
        hanging.equilibrium(x=0.5)


def test_the_linear_system_moves_as_the_plant_does_nearby(hanging):
    import control

    point = hanging.equilibrium(x=0.06)
    system = hanging.linearize(point, outputs=["x"])
    t = np.linspace(0, 0.6, 61)
    small = 20.0  # Pa
    motion = pam.simulate(
        hanging, {"muscle.command": point["muscle.command"] + small}, t=t,
        start={n: point[n] for n in ("x", "v", "muscle.pressure")},
    )  # fmt: skip
    response = control.forced_response(system, t, np.full_like(t, small))
    assert motion["x"] - 0.06 == pytest.approx(
        np.asarray(response.outputs), abs=2e-3 * float(np.max(response.outputs))
    )

"""Margins, measures, clouds and figures."""

import control
import numpy as np
import pytest
from conftest import BAR, refused
from scipy import linalg

import pam_ocp as pam
from pam_ocp.control.analysis import (
    along_stroke,
    bode_cloud,
    frequency_response,
    margins,
    margins_over,
    mode_map,
)
from pam_ocp.control.linear_quadratic import lqr
from pam_ocp.control.loop import closed_loop
from pam_ocp.operating.linear import gramian


# ---- margins and measures
def test_margins_of_a_third_order_loop_are_the_textbooks():
    """L = 2/(s (s+1) (s+2)): gain margin 3, at w = sqrt(2)."""
    loop = control.ss(control.tf([2.0], [1.0, 3.0, 2.0, 0.0]), inputs=["u"], outputs=["y"])
    found = margins(loop)
    assert found.gain[0] == pytest.approx(3.0, rel=1e-6)
    w = 2 * np.pi * found.crossover[0]
    value = 2 / (1j * w * (1j * w + 1) * (1j * w + 2))
    assert abs(value) == pytest.approx(1.0, rel=1e-6)
    assert found.phase[0] == pytest.approx(180 + np.degrees(np.angle(value)), abs=1e-6)
    assert found.modulus[0] == pytest.approx(found.all_inputs, rel=1e-9)
    assert "phase" in str(found)


def test_frequency_responses_are_python_controls(slide):
    system = slide.linearize(slide.equilibrium(x=0.0, stiffness=2.2e4))
    f = np.geomspace(0.1, 100, 7)
    expected = np.moveaxis(np.asarray(system(2j * np.pi * f)), -1, 0)
    found = frequency_response(system, f)
    assert np.allclose(found, expected, rtol=1e-8, atol=1e-10 * np.abs(expected).max())


def test_margins_of_sampled_fed_through_and_unstable_loops():
    """An integrator k T/(z - 1) behind two samples of delay, by hand: at w T = pi/5 its phase is
    -180 deg, where |L| = k T/(2 sin(pi/10)); at |L| = 1 the phase is -90 deg - 2.5 w T.
    """
    k, dt = 20.0, 0.01
    z = control.tf([1, 0], [1], dt)
    found = margins(control.ss(k * dt * z**-2 / (z - 1)))
    assert found.gain[0] == pytest.approx(2 * np.sin(np.pi / 10) / (k * dt), rel=1e-6)
    angle = 2 * np.arcsin(k * dt / 2)
    assert found.crossover[0] == pytest.approx(angle / dt / (2 * np.pi), rel=1e-6)
    assert found.phase[0] == pytest.approx(90 - np.rad2deg(2.5 * angle), rel=1e-5)
    # 2/(s + 1) + 1/2: |L| = 1 at w = sqrt(7), |1 + L| falls to 3/2
    found = margins(control.ss([[-1.0]], [[1.0]], [[2.0]], [[0.5]]))
    turned = np.rad2deg(np.angle(0.5 + 2 / (1 + 1j * np.sqrt(7))))
    assert found.phase[0] == pytest.approx(180 + turned, rel=1e-6)
    assert found.modulus[0] == pytest.approx(1.5, rel=1e-5)
    # the third-order loop of gain 10 is unstable: 6 is the most
    unstable = margins(control.ss(control.tf([10.0], [1.0, 3.0, 2.0, 0.0])))
    assert unstable.gain[0] == pytest.approx(0.6, rel=1e-6)
    assert unstable.phase[0] < 0
    # two loops fed through: each alone, the other closed, 1/(s+1) + d12 d21 terms by hand
    both = control.ss([[-1.0]], [[1.0, 0.0]], [[1.0], [0.0]], [[0.0, 0.4], [0.5, 1.0]])
    single = margins(both).modulus[0]
    w = 1j * 2 * np.pi * np.geomspace(1e-2, 1e3, 2000)
    assert single == pytest.approx(np.abs(1 + 1 / (1 + w) - 0.4 * 0.5 / 2).min(), rel=1e-9)
    refused("sample time is not known", margins, control.ss(control.tf([1], [1, 0.5], True)))


def test_the_gramian_is_theorys_for_unstable_stable_and_stiff_systems():
    scalar = gramian(np.array([[1.0]]), np.array([[1.0]]), 2.0)
    assert scalar[0, 0] == pytest.approx((np.exp(4) - 1) / 2, rel=1e-12)
    a, b = np.array([[-1.0, 5.0], [0.0, -3e3]]), np.array([[0.0], [1.0]])
    long = gramian(a, b, 60.0)
    lyapunov = linalg.solve_continuous_lyapunov(a, -b @ b.T)
    assert np.allclose(long, lyapunov, rtol=1e-9, atol=1e-15)


def test_the_position_of_a_slide_alone_does_not_show_both_pressures(slide):
    """Equal regulators: the pressures enter the force as one sum that decays on its own."""
    place = ("x", np.linspace(-0.006, 0.006, 5), {"stiffness": 2.3e4})
    alone = along_stroke(slide, *place)
    both = along_stroke(slide, *place, outputs=["x", "muscle1.pressure"])
    assert alone.visible.max() < 1e-6
    assert both.visible.min() > 1e-3
    assert alone.weakest.min() > 1e-3
    k = [p["stiffness"] for p in alone.points]
    assert alone.frequency == pytest.approx(np.sqrt(np.array(k) / 2.0) / (2 * np.pi), rel=1e-9)


def test_modes_over_pressure_and_contraction_are_those_of_the_second_order_equation(long_muscle):
    plant = pam.HangingLoad(long_muscle, mass=20.0, damping=pam.losses.ConstantDamping(100.0))
    p, kappa = np.array([2.0, 4.0]) * BAR, np.array([0.05, 0.10, 0.15])
    grid = {"muscle.command": p, "x": kappa * 0.4}
    found = mode_map(plant, grid, free=["gravity"])
    k = np.array([[long_muscle.stiffness(a, b) for b in kappa] for a in p])
    assert found.frequency == pytest.approx(np.sqrt(k / 20.0) / (2 * np.pi), rel=1e-6)
    assert found.damping == pytest.approx(100.0 / (2 * np.sqrt(k * 20.0)), rel=1e-6)
    assert found.stable.all()
    weak = mode_map(plant, grid, free=["gravity"], within={"muscle.force": (600.0, np.inf)})
    force = np.array([[long_muscle.force(a, b) for b in kappa] for a in p])
    assert np.array_equal(np.isnan(weak.frequency), force < 600.0)


def test_far_above_resonance_a_cloud_falls_with_the_mass(hanging):
    """|x/p_command| -> (dF/dp) / (m w^2 |1 + i w lag|), dF/dp the same at one place, pressure."""
    cases = [{"parameters": {"mass": m}} for m in (15.0, 20.0, 30.0)]
    asked = {"source": "muscle.command", "output": "x", "hertz": (0.1, 300.0)}
    cloud = bode_cloud(hanging, {"muscle.command": 4 * BAR}, cases, **asked)
    slope = [hanging_gain(p) for p in cloud.points]
    size = np.abs(cloud.responses[:, -1])
    w = 2 * np.pi * 300.0
    expected = np.array(slope) / (np.array([15.0, 20.0, 30.0]) * w**2 * np.hypot(1, w * 0.05))
    assert size == pytest.approx(expected, rel=2e-3)
    assert np.allclose(cloud.responses[1], cloud.nominal, rtol=1e-6)
    low, high = cloud.band(0.5)
    assert np.all(low <= high)


def hanging_gain(point):
    """dF/dp of the muscle at a point, by the force law."""
    law = pam.muscle("DMSP-20-400N").law
    return float(law.dtension_dp(point["muscle.pressure"], point["muscle.contraction"]))


def test_a_feedback_keeps_a_lighter_and_a_heavier_slide_stable(slide):
    point = slide.equilibrium(x=0.004, stiffness=2.3e4)
    feedback = lqr(slide, point, integral={"x": 80.0})
    cases = [{"parameters": {"mass": m}} for m in (1.4, 2.0, 2.6)]
    found = margins_over(feedback, cases, {"x": 0.004, "stiffness": 2.3e4})
    assert all(poles.real.max() < 0 for _, poles in found)
    assert found[1][0].phase == pytest.approx(margins(feedback.loop).phase, rel=1e-6)
    assert np.sort(found[1][1].real) == pytest.approx(np.sort(feedback.poles.real), rel=1e-6)


def test_every_figure_is_drawn_without_pyplot(slide, hanging):
    from matplotlib.figure import Figure

    from pam_ocp.figures import control as plots

    point = slide.equilibrium(x=0.0, stiffness=2.2e4)
    feedback = lqr(slide, point)
    run = closed_loop(feedback, slide, duration=0.02).trajectory
    rest, masses = {"x": 0.0, "stiffness": 2.2e4}, pam.simulation.sweep(mass=[1.0, 3.0])
    cloud = bode_cloud(slide, rest, masses, source="muscle1.command", output="x")
    stroke = along_stroke(slide, "x", [0.0, 0.001], {"stiffness": 2.2e4})
    found = mode_map(hanging, {"muscle.command": [2e5, 3e5], "x": [0.02, 0.04]}, free=["gravity"])
    figures = [
        plots.plot_tracking({"LQR": run}, ["x"], {"x": lambda t: 0.0}, "title"),
        plots.plot_bode_cloud(cloud),
        plots.plot_loop({"LQR": feedback.loop}, {"LQR": margins(feedback.loop)}),
        plots.plot_stroke({"slide": stroke}),
        plots.plot_mode_map(found),
    ]
    assert all(isinstance(f, Figure) for f in figures)
    refused("runs is empty", plots.plot_tracking, {}, ["x"])


def test_what_is_no_system_and_an_empty_axis_are_refused_in_a_sentence(slide, hanging):
    axes = {"muscle.command": [], "x": [0.02, 0.03]}
    refused(r"axis 'muscle\.command' of mode_map holds no value", mode_map, hanging, axes)
    refused(r"margins: loop is a dict, not a control\.StateSpace", margins, {})
    refused(r"modes: system is a float, not a control\.StateSpace", pam.operating.modes, 1.0)
    words = "guess is a str, not a Trajectory or a HopfPoint"
    refused(words, pam.vibration.limit_cycle, slide, "here")

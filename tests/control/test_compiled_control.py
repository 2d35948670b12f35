"""Mpc and estimators by machine code: what they find without it, and what happens without a
compiler."""

import numpy as np
import pytest
from test_mpc import double_integrator

import pam_ocp as pam
from pam_ocp.control.estimators.extended_kalman import KalmanFilter
from pam_ocp.control.mpc.mpc import Mpc
from pam_ocp.core.errors import ExportError
from pam_ocp.export import machine

H = 0.05


def moves(**options):
    """Inputs of an Mpc on a double integrator, from x = 1 to 0, and the library's hand in it."""
    mpc = Mpc(double_integrator(), horizon=10, sample_time=H, track={"x": 1.0, "v": 0.1}, **options)
    state, found = {"x": 1.0, "v": 0.0}, []
    for _ in range(5):
        found.append(mpc.control(state, {"x": 0.0, "v": 0.0})["f"])
        state = {
            "x": state["x"] + H * state["v"] + H**2 / 2 * found[-1],
            "v": state["v"] + H * found[-1],
        }
    return np.array(found)


def test_a_compiled_mpc_moves_as_the_other(tmp_path, monkeypatch):
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path))
    plain = moves()
    assert not list(tmp_path.glob("function/*"))
    np.testing.assert_allclose(moves(compiled=True), plain, rtol=1e-6, atol=1e-8)
    assert list(tmp_path.glob("function/*"))
    monkeypatch.setattr(machine, "compile_library", None)  # what is there is used
    np.testing.assert_allclose(moves(compiled=True), plain, rtol=1e-6, atol=1e-8)


def test_a_compiled_filter_is_the_linear_kalman_filter(tmp_path, monkeypatch):
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path))
    found = KalmanFilter(
        double_integrator(),
        sample_time=H,
        measured={"x": 1e-2, "v": 0.3},
        process={"v": 0.5},
        uncertainty={"x": 0.1, "v": 0.4},
        compiled=True,
    )
    assert list(tmp_path.glob("function/*"))
    # by hand, in SI
    a, q = np.array([[1.0, H], [0.0, 1.0]]), 0.25
    noise = q * np.array([[H**3 / 3, H**2 / 2], [H**2 / 2, H]])
    z, p, r = np.zeros(2), np.diag([0.1**2, 0.4**2]), np.diag([1e-4, 0.09])
    for k in range(12):
        seen, force = np.array([0.1 * np.sin(k), 0.2 * np.cos(k)]), 0.3 * (-1) ** k
        gain = p @ np.linalg.inv(p + r)
        z, p = z + gain @ (seen - z), p - gain @ p
        estimate = found.correct({"x": seen[0], "v": seen[1]})
        assert [estimate.state["x"], estimate.state["v"]] == pytest.approx(z.tolist(), abs=1e-9)
        deviation = [estimate.deviation["x"], estimate.deviation["v"]]
        assert deviation == pytest.approx(np.sqrt(np.diag(p)).tolist(), rel=1e-6)
        z = a @ z + np.array([H**2 / 2, H]) * force
        p = a @ p @ a.T + noise
        found.predict({"f": force})


def test_without_a_compiler_it_says_so(tmp_path, monkeypatch):
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path))

    def none(*arguments):
        raise ExportError("no C compiler is found")

    monkeypatch.setattr(machine, "compile_library", none)
    with pytest.raises(pam.InputError, match=r"compiled = True: no C compiler is found"):
        moves(compiled=True)
    assert np.all(np.isfinite(moves()))

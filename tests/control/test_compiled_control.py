"""Mpc and estimators by machine code: what they find without it, and what happens without a
compiler."""

import numpy as np
import pytest
from conftest import refused
from mpc_cases import mass as free_mass

from pam_ocp.control.estimators.extended_kalman import KalmanFilter
from pam_ocp.control.mpc.mpc import Mpc
from pam_ocp.core.errors import ExportError
from pam_ocp.export import machine

H = 0.05


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """A place for machine code of this test alone."""
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path))
    return tmp_path


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """One for several tests, so that a program is compiled once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PAM_OCP_CACHE", str(tmp_path_factory.mktemp("machine_code")))
        yield


def moves(**options):
    """Inputs of an Mpc on a double integrator, from x = 1 to 0, and the library's hand in it."""
    mpc = Mpc(free_mass(), horizon=10, sample_time=H, track={"x": 1.0, "v": 0.1}, **options)
    (x, v), found = (1.0, 0.0), []
    for _ in range(5):
        found.append(mpc.control({"x": x, "v": v}, {"x": 0.0, "v": 0.0})["f"])
        x, v = x + H * v + H**2 / 2 * found[-1], v + H * found[-1]
    return np.array(found)


def test_a_compiled_mpc_moves_as_the_other(cache, monkeypatch):
    plain = moves()
    assert not list(cache.glob("function/*"))
    np.testing.assert_allclose(moves(compiled=True), plain, rtol=1e-6, atol=1e-8)
    assert list(cache.glob("function/*"))
    monkeypatch.setattr(machine, "compile_library", None)  # what is there is used
    np.testing.assert_allclose(moves(compiled=True), plain, rtol=1e-6, atol=1e-8)


def bounded(**options):
    """A mass that may not go faster than 0.4 m/s nor be pushed harder than 1 N."""
    asked = {"track": {"x": 1.0}, "rate": {"f": 1e-3}, "bounds": {"v": (-0.4, 0.4)}}
    return Mpc(free_mass(limit=1.0), horizon=12, sample_time=0.1, **asked, **options)


@pytest.mark.slow
def test_a_compiled_step_finds_what_ipopt_finds_at_limits_that_hold(shared):
    machine_code, ipopt = bounded(iterations=20, compiled=True), bounded(solver="ipopt")
    state = np.array([0.0, 0.8])  # outside its soft limit: brought back
    for k in range(25):
        wanted = {"x": 1.0 if k < 12 else -1.0}
        given = {"push": 0.1}
        found = machine_code.control(state, wanted, given)["f"]
        assert found == pytest.approx(ipopt.control(state, wanted, given)["f"], abs=1e-4)
        for mpc in (machine_code, ipopt):
            mpc.reset({"f": found})
        state = state @ [[1, 0], [0.1, 1]] + (found + 0.1) * np.array([0.005, 0.1])


@pytest.mark.slow
def test_where_a_compiled_program_has_no_solution_ipopt_is_asked(shared):
    mpc = bounded(soft=False, compiled=True)
    assert np.isfinite(mpc.control([0.0, 2.0])["f"])
    assert mpc.statistics.fallbacks == mpc.statistics.failures == 1


@pytest.mark.slow
def test_a_compiled_call_is_cut_off_after_a_jump_and_completed_later(shared):
    """At 1.5 times ``work``, or with its first quadratic program."""
    mpc = bounded(iterations=20, work=4, compiled=True)
    free = bounded(iterations=20, work=None, compiled=True)
    for controller in (mpc, free):
        state = np.zeros(2)
        for k in range(40):
            found = controller.control(state, {"x": 0.0 if k == 0 else 3.0})["f"]
            state = state @ [[1, 0], [0.1, 1]] + found * np.array([0.005, 0.1])
        assert controller.statistics.fallbacks == 0
        assert state[1] == pytest.approx(0.4, abs=1e-4)  # as fast as it may
    calls = mpc.statistics.steps[1:]
    assert max(s.work for s in calls) <= max(6, *(s.work for s in calls if s.iterations == 1))
    assert max(s.work for s in calls) < max(s.work for s in free.statistics.steps[1:])
    assert calls[-1].converged


def test_the_compiled_call_of_real_time_is_that_of_python_to_the_last_bit(cache):
    plain = moves(solver="riccati", bounds={"v": (-0.5, 0.5)})
    compiled = moves(solver="riccati", bounds={"v": (-0.5, 0.5)}, compiled=True)
    assert list(cache.glob("function/*"))
    np.testing.assert_array_equal(compiled, plain)


def test_a_compiled_filter_is_the_linear_kalman_filter(cache):
    known = {"measured": {"x": 1e-2, "v": 0.3}, "process": {"v": 0.5}}
    known["uncertainty"] = {"x": 0.1, "v": 0.4}
    found = KalmanFilter(free_mass(), sample_time=H, **known, compiled=True)
    assert list(cache.glob("function/*"))
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


def test_without_a_compiler_it_says_so(cache, monkeypatch):

    def none(*arguments):
        raise ExportError("no C compiler is found")

    monkeypatch.setattr(machine, "compile_library", none)
    refused(r"compiled = True: no C compiler is found", moves, compiled=True)
    assert np.all(np.isfinite(moves()))

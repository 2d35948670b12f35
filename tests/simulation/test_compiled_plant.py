"""Simulations by machine code: against SciPy, and what happens where there is none."""

import numpy as np
import pytest
from conftest import BAR, refused, scipy_states

import pam_ocp as pam
from pam_ocp.core.errors import ExportError, OutOfTime
from pam_ocp.export import machine
from pam_ocp.simulation.integrate import Integration


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """A cache in which nothing is."""
    monkeypatch.setenv("PAM_OCP_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def no_compiler(own_cache, monkeypatch):
    def none(*arguments):
        raise ExportError("no C compiler is found")

    monkeypatch.setattr(machine, "compile_library", none)


def commands(t, seed):
    random = np.random.default_rng(seed)
    names = ("muscle1.command", "muscle2.command")
    return {n: random.uniform(1 * BAR, 5 * BAR, len(t)) for n in names}


@pytest.mark.parametrize("interpolation", ["previous", "linear"])
@pytest.mark.parametrize(
    ("way", "seed", "error"), [({"compiled": True}, 3, 1e-7), ({"method": "cvodes"}, 11, 1e-6)]
)
def test_a_slide_under_random_commands_agrees_with_scipy(slide, way, seed, error, interpolation):
    """Over jumps and kinks."""
    t = np.linspace(0.0, 0.3, 7)
    motion = pam.simulate(slide, commands(t, seed), t=t, interpolation=interpolation, **way)
    expected = scipy_states(slide, lambda s: motion.signals(s)[0], t)
    nominal = slide.vector("state", attribute="nominal")
    assert np.abs((motion.array(motion.named("state")) - expected) / nominal).max() < error


def test_breaks_between_output_times_are_met(hanging):
    times = np.array([0.0, 0.0301, 0.0999, 0.2])
    wave = (times, np.array([1.0, 4.0, 2.0, 2.0]) * BAR)
    t = np.array([0.0, 0.15, 0.2])
    motion = pam.simulate(hanging, {"muscle.command": wave}, t=t, compiled=True)
    expected = scipy_states(hanging, lambda s: motion.signals(s)[0], np.append(times[:3], t[1:]))
    nominal = hanging.vector("state", attribute="nominal")
    last = np.array([motion[v.name][-1] for v in hanging.states])
    assert np.abs((last - expected[-1]) / nominal).max() < 1e-7


def test_outputs_are_those_of_the_plant(slide):
    t = np.linspace(0.0, 0.2, 11)
    motion = pam.simulate(slide, commands(t, 5), t=t, compiled=True)
    x = np.array([motion[v.name] for v in slide.states])
    u = np.array([motion[v.name] for v in slide.inputs])
    y = np.asarray(slide.function(x, u, slide.vector("parameter"))[1])
    for i, variable in enumerate(slide.outputs):
        np.testing.assert_allclose(motion[variable.name], y[i], rtol=1e-11, atol=1e-11)


def test_what_is_compiled_is_used_where_it_is_asked_for(hanging, own_cache, monkeypatch):
    given = {"inputs": {"muscle.command": 3 * BAR}, "duration": 0.2}
    before = pam.simulate(hanging, **given)
    built = pam.simulate(hanging, compiled=True, **given)
    assert not np.array_equal(before["x"], built["x"])
    np.testing.assert_allclose(before["x"], built["x"], atol=1e-7)
    monkeypatch.setattr(machine, "compile_library", None)
    assert np.array_equal(pam.simulate(hanging, compiled=None, **given)["x"], built["x"])
    assert np.array_equal(pam.simulate(hanging, **given)["x"], before["x"])  # to the last bit
    heavier = pam.HangingLoad(pam.muscle("DMSP-20-400N"), mass=31.0)
    other = pam.simulate(heavier, compiled=True, **given)
    assert not np.array_equal(other["x"], built["x"])


def test_without_a_compiler_casadi_is_asked_unless_machine_code_is(hanging, no_compiler):
    given = {"inputs": {"muscle.command": 3 * BAR}, "duration": 0.1}
    with pytest.raises(pam.InputError, match=r"compiled = True: no C compiler is found"):
        pam.simulate(hanging, compiled=True, **given)
    plain = pam.simulate(hanging, compiled=False, **given)
    assert np.array_equal(pam.simulate(hanging, **given)["x"], plain["x"])


def test_code_that_disagrees_with_casadi_is_not_used(hanging, own_cache, monkeypatch):
    given = {"inputs": {"muscle.command": 3 * BAR}, "duration": 0.1}
    plain = pam.simulate(hanging, compiled=False, **given)
    true = machine.MachinePlant.outputs

    def wrong(self, x, u, p, xdot=None):
        y = true(self, x, u, p, xdot)
        xdot *= 1 + 1e-6
        return y

    monkeypatch.setattr(machine.MachinePlant, "outputs", wrong)
    with pytest.warns(UserWarning, match="does not agree with CasADi"):
        motion = pam.simulate(hanging, compiled=True, **given)
    assert np.array_equal(motion["x"], plain["x"])


def test_a_time_limit_ends_machine_code(slide):
    t = np.linspace(0.0, 5000.0, 500_001)
    given = commands(t, 7)
    pam.simulate(slide, duration=0.01, compiled=True)
    with pytest.raises(OutOfTime):
        pam.simulate(slide, given, t=t, compiled=True, time_limit=0.3)


def test_a_motion_that_ends_in_a_pole_fails_as_by_casadi():
    plant = pam.Plant("pole")
    x = plant.state("x", start=1.0, nominal=1.0)
    plant.der(x, x * x)  # 1/(1 - t)
    with pytest.raises(pam.SimulationError) as caught:
        pam.simulate(plant, t=np.linspace(0.0, 2.0, 42), compiled=True, max_steps=5000)
    assert caught.value.time == pytest.approx(40 / 41)
    assert caught.value.trajectory["x"][-1] == pytest.approx(41.0, rel=1e-6)


def test_steps_between_two_times_are_counted(slide):
    given = {"inputs": {"muscle1.command": 4 * BAR}, "t": [0.0, 0.5]}
    pam.simulate(slide, compiled=True, **given)
    with pytest.raises(pam.SimulationError):
        pam.simulate(slide, compiled=True, max_steps=3, **given)


@pytest.mark.parametrize("other", [{"method": "cvodes"}, {"step": 1e-3}])
def test_other_methods_are_not_compiled(hanging, other):
    refused("leave out compiled", pam.simulate, hanging, duration=0.1, compiled=True, **other)


def test_many_simulations_are_compiled_beforehand(hanging, own_cache, monkeypatch):
    monkeypatch.setattr("pam_ocp.simulation.many.COMPILED", 3)
    cases = pam.simulation.sweep(mass=[5.0, 10.0, 20.0])
    common = {"inputs": {"muscle.command": 4 * BAR}, "duration": 0.1}
    here = pam.simulate_many(hanging, cases, **common)
    alone = pam.simulate(hanging, parameters={"mass": 10.0}, compiled=True, **common)
    assert np.array_equal(here.results[1]["x"], alone["x"])
    workers = pam.simulate_many(hanging, cases, workers=1, **common)
    assert all(
        np.array_equal(a["x"], b["x"]) for a, b in zip(here.results, workers.results, strict=True)
    )


# ---- CVODES -------------------------------------------------------------------------------------
def test_jumps_are_told_from_kinks(slide):
    t = np.linspace(0.0, 1.0, 6)
    line, steps = np.array([1.0, 2, 1, 2, 1, 2]) * BAR, np.array([1.0, 1, 3, 3, 2, 2]) * BAR

    def jumps(interpolation, samples):
        motion = pam.simulate(
            slide, {"muscle1.command": samples}, t=t, interpolation=interpolation, rtol=1e-4
        )
        run = Integration.over(slide, motion.signals, t, slide.vector("state"))
        return run._jumps(len(run.u.breaks) - 1).tolist()

    assert jumps("linear", line) == []
    assert jumps("previous", steps) == [2, 4]

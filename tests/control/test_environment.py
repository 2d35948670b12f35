"""A plant as a Gymnasium environment, alone and many at once."""

import importlib

import numpy as np
import pytest
from conftest import refused
from design_tools import example

import pam_ocp as pam

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("jax")
START, TARGET = {"x": 0.02}, {"x": 0.03}


@pytest.fixture(scope="module")
def plant():
    feed = pam.feeds.Regulator(0.05, max_pressure=6e5)
    return pam.HangingLoad(pam.muscle("DMSP-20-300"), 5.0, feed=feed)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("kind", ["reach", "track", "stiffness"])
def test_gymnasium_finds_nothing_wrong(plant, kind):
    target = {"x": 0.03} if kind != "stiffness" else {"x": 0.03, "stiffness": 2e4}
    made = pam.env(plant, kind, target, start=START)
    checker = importlib.import_module("gymnasium.utils.env_checker")
    checker.check_env(made, skip_render_check=True)


def test_an_episode_is_seen_to_begin_at_its_rest():
    """Outputs of ideal pressures hang on the inputs: those of the rest, not the plant's own."""
    slide = pam.AntagonisticSlide("DMSP-20-300", feed=pam.feeds.IdealPressure())
    start, goal = {"x": 0.0, "stiffness": 2.0e4}, {"x": 0.01, "stiffness": 2.5e4}
    seen, _ = pam.env(slide, "stiffness", goal, start=start).reset(seed=0)
    off = [(goal[n] - start[n]) / slide.variable(n).nominal for n in goal]
    np.testing.assert_allclose(seen[-2:], off, atol=1e-9)


def to_pressure(plant, pressure):
    return np.array([2 * pressure / plant.variable("muscle.command").max - 1], np.float32)


def test_an_episode_moves_as_simulate_says(plant):
    made = pam.env(plant, "reach", {"x": 0.5 * 0.12}, start=START, sample_time=0.02)
    made.reset(seed=0)
    rest = plant.equilibrium(START)
    action = to_pressure(plant, rest["muscle.pressure"] + 3e4)
    sent = (float(action[0]) + 1) / 2 * plant.variable("muscle.command").max
    for _ in range(5):
        seen, *_, told = made.step(action)
    truth = pam.simulate(plant.with_values(rest), {"muscle.command": sent}, duration=0.1)
    wanted = [truth[v.name][-1] / v.nominal for v in plant.states]
    np.testing.assert_allclose(seen[:3], wanted, atol=1e-6)
    assert np.isclose(told["time"], 0.1)


def test_rewards_of_an_episode_add_up_to_its_time_and_what_became_nearer(plant):
    made = pam.env(plant, "reach", TARGET, start=START, tolerance=0.05)
    made.reset(seed=0)
    goal = to_pressure(plant, plant.equilibrium(TARGET)["muscle.pressure"])
    total, ended, late = 0.0, False, False
    while not (ended or late):
        _, reward, ended, late, told = made.step(goal)
        total += reward
    assert ended
    assert told["success"]
    nominal = plant.variable("x").nominal
    assert np.isclose(total, 0.01 / nominal - told["distance"] - told["time"], atol=1e-6)
    optimum = made.optimum
    assert optimum.verified
    assert 0.0 < made.score(told["time"]) < 1.05
    assert made.score(optimum.duration) == 1.0


def test_many_do_what_one_does(plant):
    one = pam.env(plant, "reach", TARGET, start=START, duration=0.05)
    many = pam.env(plant, "reach", TARGET, start=START, duration=0.05, num_envs=3)
    first, _ = one.reset(seed=0)
    rows, _ = many.reset(seed=0)
    np.testing.assert_allclose(rows, np.tile(first, (3, 1)))
    actions = np.array([[0.1], [-0.2], [0.1]], np.float32)
    for k in range(5):
        seen, reward, *_, late, _ = one.step(actions[0])
        rows, rewards, _, lates, _ = many.step(actions)
        np.testing.assert_allclose(rows[[0, 2]], [seen, seen], atol=1e-12)
        np.testing.assert_allclose(rewards[0], reward, atol=1e-12)
        assert lates[0] == late == (k == 4)
    rows, rewards, *_ = many.step(actions)  # starts anew
    np.testing.assert_allclose(rows, np.tile(first, (3, 1)))
    assert not rewards.any()


def test_leaving_a_range_ends_an_episode(plant):
    made = pam.env(plant, "reach", TARGET, start=START)
    made.reset(seed=0)
    rows = [made.step(np.array([-1.0], np.float32)) for _ in range(30)]
    ended = next(row for row in rows if row[2])
    assert ended[1] == -2.0
    assert not ended[4]["success"]


def test_what_is_asked_wrongly_is_told(plant):
    refused("target", pam.env, plant, "reach", {"y": 1.0}, error=pam.UnknownNameError)
    refused("task = 'walk'", pam.env, plant, "walk", TARGET)
    refused("target is empty", pam.env, plant, "reach")
    with pytest.raises(pam.InputError, match="none; its measure is the error"):
        _ = pam.env(plant, "track", TARGET, start=START).optimum
    free = pam.Plant("free")
    x, u = free.state("x"), free.input("u")
    free.der(x, u)
    refused("input u has no finite range", pam.env, free, "reach", {"x": 1.0})


@pytest.mark.slow
def test_a_trained_policy_comes_within_a_tenth_of_the_optimum(tmp_path, monkeypatch):
    pytest.importorskip("cmaes")
    monkeypatch.chdir(tmp_path)
    run = example("world_policy")
    assert run.told["success"]
    assert run.path[-1] == pytest.approx(0.05, abs=1e-4)
    assert 0.9 < run.optimum.duration / run.told["time"] < 1.02

"""Many simulations: sweeps, draws, executors, failures."""

from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from conftest import BAR, dask_client, refused

import pam_ocp as pam

COMMON = {"inputs": {"muscle.command": 4 * BAR}, "duration": 0.2}


def test_a_sweep_is_the_single_simulations(hanging):
    many = pam.simulate_many(
        hanging, pam.simulation.sweep(mass=[10.0, 20.0], muscle_lag=[0.05, 0.1]), **COMMON
    )
    assert [c["parameters"] for c in many.cases][2] == {"mass": 20.0, "muscle_lag": 0.05}
    for i, case in enumerate(many.cases):
        alone = pam.simulate(hanging, parameters=case["parameters"], **COMMON)
        assert np.array_equal(alone["x"], many.trajectories[i]["x"])


@pytest.mark.parametrize("pool", [ThreadPoolExecutor, ProcessPoolExecutor])
def test_an_executor_gives_the_same_results_and_a_failing_case_is_reported(hanging, pool):
    cases = [
        *pam.simulation.sweep(mass=list(np.linspace(5, 50, 9))),
        {"parameters": {"mass": -1.0}},
    ]
    seen = []
    with pool(2) as executor:
        many = pam.simulate_many(
            hanging,
            cases,
            executor=executor,
            chunk=3,
            progress=lambda done, count: seen.append((done, count)),
            **COMMON,
        )
    here = pam.simulate_many(hanging, cases, **COMMON)
    assert len(many.trajectories) == 9
    assert list(many.failures) == [9]
    assert "mass: start = -1 kg is outside" in str(many)
    assert seen[-1] == (10, 10)
    assert all(
        np.array_equal(many.trajectories[i]["x"], here.trajectories[i]["x"]) for i in range(9)
    )


def test_a_pickled_plant_moves_as_before(slide):
    import pickle

    again = pickle.loads(pickle.dumps(slide.with_values(mass=3.0)))
    assert again.variables == slide.with_values(mass=3.0).variables
    assert again.positions == slide.positions
    assert again.mirror_map == slide.mirror_map
    inputs = {"muscle1.command": 4 * BAR, "muscle2.command": 3 * BAR}
    assert (
        pam.simulate(again, inputs, duration=0.1)
        .compare(pam.simulate(slide, inputs, duration=0.1, parameters={"mass": 3.0}))
        .largest
        < 1e-13
    )


def test_draws_have_the_covariance_asked_for():
    covariance = np.array([[4.0, 1e-6], [1e-6, 1e-12]])
    cases = pam.simulation.draws({"a": 1.0, "b": 2e-6}, covariance, 20000, prefix="m.", seed=3)
    samples = np.array([list(c["parameters"].values()) for c in cases])
    assert list(cases[0]["parameters"]) == ["m.a", "m.b"]
    assert samples.mean(axis=0) == pytest.approx([1.0, 2e-6], abs=0.05, rel=0.02)
    assert np.cov(samples.T) == pytest.approx(covariance, rel=0.05)
    for none in ([[1.0, 0.5], [0.0, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]):
        refused("has to be symmetric", pam.simulation.draws, {"a": 1.0, "b": 1.0}, none, 2)


def test_a_case_with_a_wrong_key_is_refused(hanging):
    refused("case 0 holds", pam.simulate_many, hanging, [{"mass": 1.0}], **COMMON)


@pytest.mark.slow
def test_a_dask_cluster_serves_as_executor(hanging):
    with dask_client() as client:
        many = pam.simulate_many(
            hanging,
            pam.simulation.sweep(mass=[10.0, 20.0, 30.0]),
            executor=client.get_executor(),
            chunk=1,
            **COMMON,
        )
    assert len(many.trajectories) == 3, str(many)

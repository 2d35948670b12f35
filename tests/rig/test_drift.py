"""What drifts on a rig is estimated along its runs and named; on a sound one nothing is."""

import math

import numpy as np
import pytest
from conftest import refused
from rig_fixtures import plant  # noqa: F401 - a fixture
from rig_tools import on_twin

import pam_ocp as pam
from pam_ocp.rig.drift import drifting

MEASURED = {"x": 1e-5, "muscle.pressure": 200.0}
NOISE = {n: pam.simulation.Instrument(noise=s) for n, s in MEASURED.items()}
AT, OVER = 30.0, 5.0
"""When a drift begins on the twin, and how long it takes to be whole [s]."""


def test_a_plant_that_may_drift_is_the_same_until_it_does(plant):
    other = drifting(plant)
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = [rng.uniform(0.0, 0.05), rng.normal(0.0, 0.1), rng.uniform(1e5, 5e5)]
        u = [rng.uniform(1e5, 5e5)]
        p = plant.vector("parameter")
        rates = np.array(plant.function(x, u, p)[0]).ravel()
        force = _output(plant, x, "muscle.force")
        scale, leak, creep, e = 1.3, 0.4, 500.0, 0.02
        kappa = _output(plant, x, "muscle.contraction")
        found = np.array(other.function([*x, e], u, [*p, scale, leak, creep, 10.0])[0]).ravel()
        assert np.allclose(
            np.array(other.function([*x, e], u, [*p, 1.0, 0.0, 0.0, 10.0])[0]).ravel()[:3],
            rates,
            rtol=1e-12,
        )
        assert found[0] == rates[0]
        assert math.isclose(
            found[1], rates[1] + ((scale - 1) * force - creep * (kappa - e)) / 10.0, rel_tol=1e-9
        )
        assert math.isclose(found[2], rates[2] - leak * x[2], rel_tol=1e-12, abs_tol=1e-6)
        assert math.isclose(found[3], (kappa - e) / 10.0, rel_tol=1e-12)


def _output(plant, x, name):
    values = np.array(plant.function(x, [2e5], plant.vector("parameter"))[1]).ravel()
    return float(values[[v.name for v in plant.outputs].index(name)])


@pytest.fixture
def watched(plant):
    """watched(real, change, **of twin) -> the rig's monitor after a minute."""

    def run(real, change=None, span=60.0, **of_twin):
        rig, twin = on_twin(plant, true=real, sensors=NOISE, **of_twin)
        rig.monitor = pam.rig.Monitor(plant, measured=MEASURED, learn="20 s")

        def moving(t):
            for name, (first, last) in (change or {}).items():
                part = min(max((t - AT) / OVER, 0.0), 1.0)
                twin.change(**{name: first + part * (last - first)})
            return {"muscle.command": 3e5 + 8e4 * math.sin(3 * t) + 6e4 * math.sin(1.1 * t)}

        rig.arm()
        rig.run(moving, span)
        return rig.monitor

    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "parameter", "first", "last"),
    [
        ("scale of force", "drift.scale", 1.0, 0.85),
        ("leak", "drift.leak", 0.0, 0.8),
        ("creep", "drift.creep", 0.0, 600.0),
    ],
)
def test_what_drifts_is_named(watched, plant, what, parameter, first, last):
    monitor = watched(
        drifting(plant, creep_time=7.0), {parameter: (first, last)}, scale=1.1, seed=3
    )
    assert [a.what for a in monitor.alarms] == [what]
    assert AT < monitor.alarms[0].time < AT + 20.0
    value, deviation = monitor.now[what]
    assert abs(value / (1.1 if what == "scale of force" else 1.0) - last) < 0.15 * max(last, 1.0)
    assert deviation < 0.1 * max(abs(value), 1.0)
    assert what in monitor.report()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_a_sound_rig_raises_no_alarm_though_the_model_errs(watched, seed):
    real = pam.HangingLoad("DMSP-20-300", mass=10.0, damping=100.0, losses=[pam.losses.BoucWen()])
    monitor = watched(real, scale=1.0 + 0.1 * (-1) ** seed, seed=seed, span=70.0)
    assert monitor.learned
    assert monitor.alarms == []


@pytest.mark.slow
def test_a_run_that_was_recorded_can_be_followed_later(plant):
    rig, _ = on_twin(plant, sensors=NOISE, scale=1.2)
    rig.arm()
    run = rig.run(lambda t: {"muscle.command": 3e5 + 1e5 * math.sin(3 * t)}, 15.0)
    monitor = pam.rig.Monitor(plant, measured=MEASURED)
    assert monitor.follow(run) == []
    refused("give the record of a run", monitor.follow, 3)
    value, deviation = monitor.now["scale of force"]
    assert abs(value - 1.2) < max(3 * deviation, 0.01)
    with pytest.raises(pam.InputError, match=r"muscle\.pressure"):
        monitor.follow(pam.Trajectory(run.t, {"x": run["x"]}, (plant.variable("x"),)))


def test_what_a_monitor_cannot_be_is_said(plant):
    refused("leek", pam.rig.Monitor, plant, measured=MEASURED, tolerance={"leek": 1.0})
    own = pam.Plant("cart")
    x = own.state("x", unit="m")
    own.der(x, -x)
    refused(r"\.force", pam.rig.Monitor, own, measured={"x": 1e-3})

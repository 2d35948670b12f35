"""Heat, receivers, tubes and spools in every verb: linear models, fits, plans, FMUs."""

from itertools import cycle

import numpy as np
import pytest
from conftest import noisy_record
from fmu_tools import require_agreement

import pam_ocp as pam
from pam_ocp.muscles.gas import Gas
from pam_ocp.muscles.heat import ConstantHeatTransfer, PressureHeatTransfer, Rubber

F = pam.feeds
WARM = Gas(heat=ConstantHeatTransfer(40.0))
FEEDS = {
    "heat": F.SpoolValve(gas=WARM),
    "pressure heat, rubber": F.SpoolValve(
        gas=Gas(heat=PressureHeatTransfer(), rubber=Rubber(20.0, stiffening=2e-3))
    ),
    "receiver": F.SpoolValve(supply=F.Receiver(1e-3)),
    "warm receiver, compressor": F.SpoolValve(
        supply=F.Receiver(1e-3, source=F.Compressor(pressure=6e5), wall_conductance=1.0), gas=WARM
    ),
    "tube": F.SpoolValve(tube=F.LumpedTube(1.0, 4e-3, 2)),
    "first-order spool": F.SpoolValve(spool=F.FirstOrderSpool(8e-3), offset=0.01),
    "second-order spool": F.SpoolValve(spool=F.SecondOrderSpool(), exhaust_overlap=0.05),
    "quick exhaust": F.SpoolValve(tube=F.Tube(10e-6, 20e-3), quick_exhaust=F.QuickExhaust()),
}


def hanging(feed):
    return pam.HangingLoad("DMSP-20-200N", 10.0, damping=100.0, feed=feed)


@pytest.mark.parametrize("name", FEEDS)
def test_it_rests_and_its_linear_model_is_that_of_differences(name):
    plant = hanging(FEEDS[name])
    point = plant.equilibrium({"x": 0.03})
    assert np.abs(plant.function(point.x, point.u, plant.vector("parameter"))[0]).max() < 1e-5
    x = point.x + 0.1 * plant.vector("state", attribute="nominal")
    u = point.u + 0.2
    p = plant.vector("parameter")
    a = np.asarray(plant.jacobians(x, u, p)[0])
    for i, v in enumerate(plant.states):
        step = np.zeros(len(x))
        step[i] = 1e-5 * v.nominal
        ends = [np.asarray(plant.function(x + s, u, p)[0]).ravel() for s in (step, -step)]
        slope = (ends[0] - ends[1]) / (2e-5 * v.nominal)
        assert a[:, i] == pytest.approx(slope, rel=1e-5, abs=1e-5 * (1 + np.abs(slope).max()))


@pytest.mark.slow
@pytest.mark.parametrize(("name", "fmi"), zip(FEEDS, cycle(["2.0", "3.0"])))
def test_its_fmu_moves_as_it_does_in_python(name, fmi, tmp_path):
    plant = hanging(FEEDS[name])
    t = np.linspace(0, 0.5, 51)
    command = 0.08 * np.sign(np.sin(20 * t))
    own = [v.name for v in plant.states if v.name.startswith("muscle.") and "pressure" in v.name]
    start = {"x": 0.03, **dict.fromkeys(own, 3e5)}
    motion = pam.simulate(plant, {"muscle.command": (t, command)}, t=t, start=start, rtol=1e-11)
    require_agreement(plant, motion, tmp_path, fmi)


@pytest.mark.slow
@pytest.mark.parametrize("name", FEEDS)
def test_a_plan_with_it_is_verified(name):
    stops, way = [{"x": 0.025}, {"x": 0.03}], pam.Collocation(12, 4)
    asked = {"minimise": "effort", "duration": 0.4, "starts": 1, "method": way}
    assert pam.plan(hanging(FEEDS[name]), stops=stops, **asked).verdict


def noisy(plant, seed, tenths):
    """Pressure and position of random commands for so many tenths of a second, with noise."""
    draw = np.random.default_rng(seed)
    t = 0.01 * np.arange(10 * tenths)
    command = np.repeat(draw.uniform(-0.25, 0.25, tenths), 10)
    start = {"x": 0.03, "muscle.pressure": 3e5}
    run = pam.simulate(plant, {"muscle.command": (t, command)}, t=t, start=start)
    noise = {"x": 2e-5, "muscle.pressure": 500.0}
    return noisy_record(plant, run, {"muscle.command": command}, noise, draw)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "free"),
    [
        ("heat", {"muscle.gas.heat_transfer": 20.0, "muscle.gas.conductance": 2.2e-8}),
        ("receiver", {"receiver.volume": 1.3e-3}),
        ("first-order spool", {"muscle.valve.time": 5e-3, "muscle.valve.offset": 0.0}),
    ],
)
def test_a_fit_has_the_truth_within_its_intervals(name, free):
    bottle = F.SpoolValve(supply=F.Receiver(1e-3, source=F.Compressor(2e-4, pressure=7e5)))
    plant = hanging(bottle if name == "receiver" else FEEDS[name])
    told = noisy(plant, 3, 20 if name == "receiver" else 10)  # a bottle is emptied slowly
    fit = pam.fit_plant(plant.with_values(free), told, list(free))
    intervals = fit.intervals()
    for parameter in free:
        low, high = intervals[parameter]
        assert low < plant.variable(parameter).start < high

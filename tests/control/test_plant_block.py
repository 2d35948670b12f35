"""A plant as a sampled block, alone and with its controller: one unit for FMU and C."""

import fmpy
import numpy as np
import pytest
from c_program import needs_compiler, selftest
from conftest import hardening_cart, refused, scipy_states

import pam_ocp as pam
from pam_ocp.control import block, chain, kalman, lqr, plant_block

STEP = 2e-3


def ran(made, samples, told):
    """Outputs by name over samples; told : inputs of sample k by name."""
    memory, inputs, parameters = (made.start(k) for k in ("memory", "inputs", "parameters"))
    places = {v.name: i for i, v in enumerate(made.inputs)}
    rows = []
    for k in range(samples):
        for name, value in told(k).items():
            inputs[places[name]] = value
        memory, outputs = (np.asarray(a).ravel() for a in made.step(memory, inputs, parameters))
        rows.append(outputs)
    return dict(zip([v.name for v in made.outputs], np.array(rows).T, strict=True))


def off(plant, names, columns, other):
    """The largest difference from a trajectory, in nominals."""
    return max(
        np.max(np.abs(columns[n] - other[n][: len(columns[n])])) / plant.variable(n).nominal
        for n in names
    )


def test_alone_it_moves_as_scipy_says(slide):
    """Commands are held over each sample, and outputs follow those held before."""
    low = slide.vector("input")
    commands = low + 2e4 * np.random.default_rng(5).uniform(-1, 1, (40, len(low)))
    made = plant_block(slide, sample_time=STEP)
    names = [v.name for v in slide.inputs]
    columns = ran(made, 40, lambda k: dict(zip(names, commands[k], strict=True)))
    held = lambda t: commands[min(int(t / STEP + 1e-9), 39)]  # noqa: E731
    states = scipy_states(slide, held, STEP * np.arange(40))
    for i, v in enumerate(slide.states):
        assert np.max(np.abs(columns[v.name] - states[:, i])) < 1e-4 * v.nominal
    held = slide.function(states[7], commands[6], slide.vector("parameter"))[1]
    assert columns["muscle1.force"][7] == pytest.approx(float(held[0]), rel=1e-4)


@pytest.mark.parametrize(("delay", "samples"), [(0, 300), (1, 300), (3, 60)])
def test_with_a_controller_it_is_the_closed_loop(delay, samples, slide):
    """With a delay of 3, for which it is not designed, the loop soon swings up."""
    point = slide.equilibrium(x=0.0, stiffness=2e4)
    law = lqr(slide, point, integral={"x": 50.0}, sample_time=STEP)
    made = plant_block(slide, law, start=point, delay=delay, substeps=8)
    assert [v.name for v in made.inputs] == ["wanted.x", "enable"]
    columns = ran(made, samples, lambda k: {"wanted.x": 0.003})
    with pytest.warns(UserWarning, match="closed loop"):
        loop = pam.closed_loop(law, slide, {"x": 0.003}, duration=0.6, delay=delay, start=point)
    assert np.ptp(loop["x"]) > 2e-3
    assert off(slide, [v.name for v in slide.states], columns, loop.trajectory) < 2e-5


def test_an_estimator_and_disturbances_are_part_of_it(slide):
    """A load that pulls from 0.1 s on; the law knows only the measured position."""
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), loads=pam.loads.ExternalForce())
    point = plant.equilibrium(x=0.0, stiffness=2e4)
    filter = kalman(plant, point, measured={"x": 1e-5}, sample_time=STEP)
    law = lqr(plant, point, sample_time=STEP)
    made = plant_block(plant, block(chain([filter, law], name="lqg"), plant=plant), start=point)
    pull = next(v.name for v in plant.inputs if v.disturbance)
    columns = ran(made, 200, lambda k: {pull: 10.0 * (k >= 50)})
    watch = kalman(plant, point, measured={"x": 1e-5}, sample_time=STEP)
    real = {"disturbances": {pull: (10.0, 0.1)}, "noise": {}, "start": point}
    loop = pam.closed_loop(law, plant, estimator=watch, duration=0.4, **real)
    assert np.ptp(loop["x"]) > 1e-4
    assert off(plant, ["x", "v"], columns, loop.trajectory) < 1e-4


def test_substeps_follow_the_tolerance(slide):
    """RODAS3 is of order 3: an error smaller by 1000 takes ten times as many steps."""
    spool = pam.AntagonisticSlide(pam.muscle("DMSP-20-200N"), feed=pam.feeds.SpoolValve())
    made = (plant_block(spool, sample_time=STEP, tolerance=t) for t in (1e-3, 1e-6))
    counts = [one.loops["steps of the plant"] for one in made]
    assert 4 <= counts[1] / counts[0] <= 32


def test_substeps_follow_walls_and_slip_that_no_first_sample_meets():
    """Thrown to and fro between walls, each sample begun where SciPy says."""
    rough = [pam.loads.Wall(0.01, stiffness=1e6), pam.loads.DryFriction(10.0)]
    plant = pam.AntagonisticSlide(pam.muscle("DMSP-20-300"), loads=rough)
    made = plant_block(plant, sample_time=STEP)
    count, width = 60, len(plant.states)
    sides = [[6e5, 0.0], [0.0, 6e5]]
    commands = np.repeat(sides, count // 2, axis=0)
    states = scipy_states(
        plant, lambda t: commands[min(int(t / STEP + 1e-9), count - 1)], STEP * np.arange(count)
    )
    assert np.max(states[:, 0]) > 0.01
    p, nominal = made.start("parameters"), plant.vector("state", attribute="nominal")
    for k in range(count - 1):
        memory = [*commands[k], *states[k], 1.0]  # held, state, started
        outputs = np.asarray(made.step(memory, commands[k], p)[1]).ravel()
        assert np.max(np.abs(outputs[:width] - states[k + 1]) / nominal) < 2e-4


@needs_compiler
def test_it_leaves_as_c_and_as_an_fmu(tmp_path, slide):
    point = slide.equilibrium(x=0.0, stiffness=2e4)
    law = lqr(slide, point, integral={"x": 50.0}, sample_time=STEP)
    made = plant_block(slide, law, start=point)
    folder = pam.export_c(made, tmp_path / "c", name="whole", steps=50)
    assert "passed" in selftest(folder, "whole")
    unit = pam.export_fmu(made, tmp_path / "whole.fmu", platforms=["native"])
    told = {"output": ["x"], "start_values": {"wanted.x": 0.003}}
    found = fmpy.simulate_fmu(str(unit), stop_time=0.2, step_size=STEP, **told)
    columns = ran(made, 100, lambda k: {"wanted.x": 0.003})
    assert np.max(np.abs(found["x"][1:101] - columns["x"])) < 1e-12


def test_what_does_not_fit_is_refused(slide, hanging):
    law = lqr(hanging, hanging.equilibrium(x=0.04), sample_time=STEP)
    refused("controller", plant_block, slide, law)
    refused("sample_time", plant_block, hanging, law, sample_time=1e-3)
    refused("1024 substeps", plant_block, hardening_cart(), sample_time=100.0)
    refused("delay", plant_block, hanging, law, delay=-1)

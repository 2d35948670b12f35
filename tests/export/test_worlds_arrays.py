"""A plant in JAX, PyTorch and ONNX: the same numbers, slopes and motions."""

import importlib
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import refused

import pam_ocp as pam
from pam_ocp.core.block import Block
from pam_ocp.core.variables import Variable

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
X, V, U = 0.3, -0.7, 1.7
OPERATIONS = {  # name: (in CasADi, in NumPy)
    "exp": (ca.exp, np.exp, V),
    "log": (ca.log, np.log, U),
    "sqrt": (ca.sqrt, np.sqrt, U),
    "sin": (ca.sin, np.sin, V),
    "cos": (ca.cos, np.cos, V),
    "tan": (ca.tan, np.tan, V),
    "asin": (ca.asin, np.arcsin, V),
    "acos": (ca.acos, np.arccos, V),
    "atan": (ca.atan, np.arctan, V),
    "floor": (ca.floor, np.floor, V),
    "ceil": (ca.ceil, np.ceil, V),
    "sign": (ca.sign, np.sign, V),
    "fabs": (ca.fabs, np.abs, V),
    "sinh": (ca.sinh, np.sinh, V),
    "cosh": (ca.cosh, np.cosh, V),
    "tanh": (ca.tanh, np.tanh, V),
    "asinh": (ca.asinh, np.arcsinh, V),
    "acosh": (ca.acosh, np.arccosh, U),
    "atanh": (ca.atanh, np.arctanh, V),
    "log1p": (lambda a: ca.log1p(1e-9 * a), lambda a: np.log1p(1e-9 * a), V),
    "expm1": (lambda a: ca.expm1(1e-9 * a), lambda a: np.expm1(1e-9 * a), V),
    "large_expm1": (lambda a: ca.expm1(9 * a), lambda a: np.expm1(9 * a), V),
    "inverse": (lambda a: 1 / a, lambda a: 1 / a, V),
    "square": (lambda a: a**2, lambda a: a**2, V),
    "power": (lambda a: a**2.3, lambda a: a**2.3, U),
    "not": (lambda a: ca.logic_not(a < 0), lambda a: float(not a < 0), V),
}
PAIRS = {
    "fmod": (ca.fmod, np.fmod),
    "remainder": (ca.remainder, lambda a, b: a - b * np.round(a / b)),
    "copysign": (ca.copysign, np.copysign),
    "hypot": (ca.hypot, np.hypot),
    "fmin": (ca.fmin, np.minimum),
    "fmax": (ca.fmax, np.maximum),
    "lt": (lambda a, b: a < b, lambda a, b: float(a < b)),
    "le": (lambda a, b: a <= b, lambda a, b: float(a <= b)),
    "eq": (lambda a, b: a == b, lambda a, b: float(a == b)),
    "ne": (lambda a, b: a != b, lambda a, b: float(a != b)),
    "and": (lambda a, b: ca.logic_and(a < 1, b < 1), lambda a, b: float(a < 1 and b < 1)),
    "or": (lambda a, b: ca.logic_or(a < 0, b < 0), lambda a, b: float(a < 0 or b < 0)),
    "if_else": (lambda a, b: ca.if_else(a < b, 2 * a, b), lambda a, b: 2 * a if a < b else b),
}
ANGLES = {"right_up": (X, U), "left_up": (X, -U), "left_down": (V, -U), "right_down": (V, U)}


@pytest.fixture(scope="module")
def jnp():
    jax = pytest.importorskip("jax")
    with jax.enable_x64(True):
        yield importlib.import_module("jax.numpy")


@pytest.fixture(scope="module")
def everything():
    """A plant with each operation as an output, and what NumPy says of them."""
    plant = pam.Plant("operations")
    x, v = plant.state("x", start=X), plant.state("v", start=V)
    u = plant.input("u", start=U)
    symbols, wanted = {X: x, V: v, U: u}, []
    plant.der(x, v)
    plant.der(v, u - x)
    for name, (symbolic, numeric, at) in OPERATIONS.items():
        plant.output(name, symbolic(symbols[at]))
        wanted.append(numeric(at))
    for name, (symbolic, numeric) in PAIRS.items():
        for a, b in ((X, V), (V, X), (U, V)):
            plant.output(f"{name}_{len(wanted)}", symbolic(symbols[a], symbols[b]))
            wanted.append(numeric(a, b))
    for name, (a, b) in ANGLES.items():
        second = symbols[abs(b)] if b > 0 else -symbols[abs(b)]
        plant.output(name, ca.atan2(symbols[a], second))
        wanted.append(np.arctan2(a, b))
    return plant, np.array(wanted, float)


def outputs_in(world, plant, tmp_path, precision="double"):
    x, u = plant.vector("state"), plant.vector("input")
    if world == "jax":
        jax = pytest.importorskip("jax")
        return np.array(jax.jit(pam.export(plant, world="jax").outputs)(0.0, x, u))
    if world == "torch":
        torch = pytest.importorskip("torch")
        module = pam.export(plant, world="torch")
        return module(torch.tensor(x), torch.tensor(u))[1].detach().numpy()
    runtime = pytest.importorskip("onnxruntime")
    path = pam.export(plant, tmp_path / "plant.onnx", precision=precision)
    session = runtime.InferenceSession(path)
    kind = np.float64 if precision == "double" else np.float32
    given = {"x": x[None], "u": u[None], "p": plant.vector("parameter")[None]}
    named = {i.name: given[i.name].astype(kind) for i in session.get_inputs()}
    return session.run(["y"], named)[0][0]


@pytest.mark.parametrize("world", ["jax", "torch", "onnx"])
@pytest.mark.slow
def test_every_operation_is_what_numpy_says(world, everything, jnp, tmp_path):
    plant, wanted = everything
    pytest.importorskip("onnx" if world == "onnx" else world)
    found = outputs_in(world, plant, tmp_path)
    np.testing.assert_allclose(found, wanted, rtol=1e-13, atol=1e-15)


def test_single_precision_is_what_numpy_says_to_seven_digits(everything, tmp_path):
    pytest.importorskip("onnx")
    plant, wanted = everything
    found = outputs_in("onnx", plant, tmp_path, "single")
    np.testing.assert_allclose(found, wanted, rtol=2e-5, atol=1e-6)


# ---- random plants -------------------------------------------------------------------------------


def random_plants(seeds):
    sys.path.insert(0, str(BENCHMARKS))
    try:
        tasks = importlib.import_module("random_tasks")
    finally:
        sys.path.remove(str(BENCHMARKS))
    makers = (tasks.single, tasks.pair, tasks.pendulum, tasks.arm, tasks.own)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        try:
            plant = makers[seed % len(makers)](rng).plant
        except (tasks.Infeasible, pam.InputError):
            continue
        low, high = (plant.vector("input", attribute=a) for a in ("min", "max"))
        low, high = np.where(np.isfinite(low), low, -1), np.where(np.isfinite(high), high, 1)
        yield plant, low + (high - low) * rng.uniform(0.3, 0.7, (6, len(low)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_random_plants_move_as_simulate_says(jnp):
    t, count = np.linspace(0.0, 1.0, 6), 0
    for plant, u in random_plants([4, 7, 10, 12]):
        moves = {v.name: u[:, i] for i, v in enumerate(plant.inputs)}
        truth = pam.simulate(plant, moves, t=t)
        found = np.array(pam.export.to_jax(plant).simulate(t, u))
        wanted = np.column_stack([truth[v.name] for v in plant.states])
        nominal = plant.vector("state", attribute="nominal")
        assert np.max(np.abs(found - wanted) / nominal) < 1e-6, plant.name
        count += 1
    assert count >= 3


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_random_plants_have_the_same_slopes_in_torch_and_onnx(tmp_path):
    torch, runtime = pytest.importorskip("torch"), pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    for plant, u in random_plants([0, 2, 3, 6]):
        x = np.tile(plant.vector("state"), (6, 1))
        p = plant.vector("parameter")
        wanted = np.array([np.ravel(plant.function(*row, p)[0]) for row in zip(x, u, strict=True)])
        scale = 1e-12 * (np.abs(wanted) + plant.vector("state", attribute="nominal"))
        module = pam.export.to_torch(plant)
        found = module.f(0.0, torch.tensor(x), torch.tensor(u)).detach().numpy()
        assert np.all(np.abs(found - wanted) <= scale)
        session = runtime.InferenceSession(pam.export.to_onnx(plant, tmp_path / "p.onnx"))
        given = {"x": x, "u": u, "p": p[None]}
        found = session.run(["xdot"], {i.name: given[i.name] for i in session.get_inputs()})[0]
        assert np.all(np.abs(found - wanted) <= scale)


# ---- functions of JAX ----------------------------------------------------------------------------


@pytest.fixture
def resting(hanging):
    """A load that is at rest and stays taut when the pressure rises a little."""
    return hanging.with_values(hanging.equilibrium(x=0.03))


def command(plant):
    return plant.vector("state")[2] + 2e4


def final(plant, mass):
    """x after 0.2 s by CasADi's integrators."""
    moves = {"muscle.command": command(plant)}
    return pam.simulate(plant, moves, duration=0.2, parameters={"mass": mass})["x"][-1]


@pytest.mark.parametrize("method", ["rk4", pytest.param("rosenbrock", marks=pytest.mark.slow)])
def test_the_slope_of_a_motion_by_a_parameter_is_that_of_differences(resting, jnp, method):
    import jax

    world = pam.export.to_jax(resting)
    stepper = world.stepper(1e-3, method)

    def end(mass):
        return stepper.run(world.x0, jnp.array([command(resting)]), {"mass": mass}, steps=200)[0]

    mass, h = float(world.p["mass"]), 1e-3
    wanted = (final(resting, mass + h) - final(resting, mass - h)) / (2 * h)
    assert np.isclose(end(mass), final(resting, mass), rtol=1e-7)
    assert np.isclose(jax.grad(end)(mass), wanted, rtol=1e-5)


@pytest.mark.slow
def test_a_batch_is_what_vmap_makes_of_one(hanging, jnp):
    import jax

    world = pam.export.to_jax(hanging)
    rng = np.random.default_rng(0)
    x = world.x0 * (1 + 0.01 * rng.random((3, 3)))
    masses, u = jnp.linspace(1.0, 9.0, 3), jnp.array([2e5])
    wide = world.f(0.0, x, u, {"mass": masses})
    one = jax.vmap(lambda x, m: world.f(0.0, x, u, {"mass": m}))(x, masses)
    single = [world.f(0.0, x[k], u, {"mass": masses[k]}) for k in range(3)]
    np.testing.assert_array_equal(wide, one)
    np.testing.assert_array_equal(wide, np.array(single))
    stepper = world.stepper(1e-3)
    every = stepper.run(x, u, {"mass": masses}, steps=5, keep=True)
    np.testing.assert_array_equal(every[-1], stepper.run(x, u, {"mass": masses}, steps=5))


def test_parameters_go_by_name_or_as_an_array(hanging, jnp):
    world = pam.export.to_jax(hanging)
    array = np.array([world.p[n] for n in world.parameters])
    x, u = world.x0 + 1e-3, world.u0
    np.testing.assert_array_equal(world.f(0, x, u), world.f(0, x, u, world.p))
    np.testing.assert_array_equal(world.f(0, x, u), world.f(0, x, u, array))
    heavier = hanging.with_values(mass=7.0)
    wanted = np.ravel(heavier.function(np.array(x), np.array(u), heavier.vector("parameter"))[0])
    np.testing.assert_allclose(world.f(0, x, u, {"mass": 7.0}), wanted, rtol=1e-13)


@pytest.mark.parametrize(("method", "order"), [("rk4", 4), ("rosenbrock", 5)])
def test_half_the_step_has_the_error_that_the_order_says(jnp, method, order):
    plant = pam.Plant("oscillator")  # x = cos(10 t)
    x, v = plant.state("x", start=1.0), plant.state("v")
    plant.der(x, v)
    plant.der(v, -100 * x)
    world = pam.export.to_jax(plant)
    errors = []
    for steps in (50, 100):
        stepper = world.stepper(1.0 / steps, method)
        told = stepper.error(world.x0, world.u0, steps=steps)
        path = stepper.run(world.x0, world.u0, steps=steps, keep=True)
        errors.append(float(path[-1, 0]) - np.cos(10.0))
        t = np.linspace(0, 1, steps + 1)
        true = np.abs(path - np.column_stack([np.cos(10 * t), -10 * np.sin(10 * t)]))
        assert np.isclose(told, np.max(true), rtol=0.1)
    assert np.log2(errors[0] / errors[1]) > order - 0.4


@pytest.fixture
def valves():
    return pam.HangingLoad("DMSP-20-300", 5.0, feed=pam.feeds.SpoolValve())


def test_a_step_too_long_is_refused_with_the_longest(valves, jnp):
    world = pam.export.to_jax(valves)
    refused(r"step = 0.1 s is too long for rk4.*at most", world.stepper, 0.1, "rk4")
    assert world.stepper(0.1).method == "rosenbrock"
    assert world.stepper(world.longest / 2).method == "rk4"
    refused("method = 'euler'", world.stepper, 1e-3, "euler")


def test_a_valve_moves_by_equal_steps_as_simulate_says(valves, jnp):
    valves = valves.with_values(valves.equilibrium(x=0.03))
    world = pam.export.to_jax(valves)
    found = world.stepper(1e-3, "rosenbrock").run(world.x0, jnp.array([0.1]), steps=100)
    truth = pam.simulate(valves, {"muscle.command": 0.1}, duration=0.1)
    wanted = np.array([truth[n][-1] for n in world.states])
    assert np.max(np.abs(found - wanted) / valves.vector("state", attribute="nominal")) < 1e-6


@pytest.mark.slow
def test_diffrax_integrates_the_term(resting, jnp):
    diffrax = pytest.importorskip("diffrax")
    world, held = pam.export.to_jax(resting), command(resting)
    nominal = resting.vector("state", attribute="nominal")
    control = diffrax.PIDController(rtol=1e-9, atol=1e-9 * nominal)
    term, method = world.term(lambda t: jnp.array([held])), diffrax.Dopri5()
    given = (0.0, 0.2, None, world.x0, {"mass": 19.0})
    made = diffrax.diffeqsolve(term, method, *given, stepsize_controller=control)
    assert np.isclose(made.ys[-1, 0], final(resting, 19.0), rtol=1e-7)


def test_a_motion_that_leads_nowhere_is_nan(jnp):
    plant = pam.Plant("burst")  # x' = x^2: infinite at t = 1
    x = plant.state("x", start=1.0)
    plant.der(x, x**2)
    rows = pam.export.to_jax(plant).simulate(np.array([0.0, 0.5, 2.0]))
    assert np.isclose(rows[1, 0], 2.0, rtol=1e-7)
    assert np.isnan(rows[2, 0])


# ---- torch, controllers, refusals ----------------------------------------------------------------


@pytest.mark.slow
def test_torch_trains_a_parameter(resting):
    torch = pytest.importorskip("torch")
    module = pam.export.to_torch(resting)
    mass = torch.tensor(19.0, dtype=torch.float64, requires_grad=True)
    held = torch.tensor([command(resting)])
    path = module.run(module.x0, held, {"mass": mass}, step=1e-3, steps=200)
    path[-1, 0].backward()
    wanted = (final(resting, 19.001) - final(resting, 18.999)) / 2e-3
    assert np.isclose(path[-1, 0].item(), final(resting, 19.0), rtol=1e-7)
    assert np.isclose(mass.grad.item(), wanted, rtol=1e-5)
    assert [tuple(q.shape) for q in module.parameters()] == [(len(module.signature.parameters),)]


def test_a_controller_leaves_for_all_worlds(slide, jnp, tmp_path):
    law = pam.lqr(slide, {"x": 0.001, "stiffness": "22 N/mm"}, sample_time=2e-3)
    block = pam.control.block(law)
    rng = np.random.default_rng(1)
    memory, inputs = block.start("memory"), block.start("inputs")
    inputs = inputs + 1e-3 * rng.random(len(inputs))
    after, wanted = (np.ravel(r) for r in block.step(memory, inputs, block.start("parameters")))
    made = pam.export.to_jax(law)
    found = made.step(jnp.array(memory), jnp.array(inputs))
    np.testing.assert_allclose(found[0], after, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[1], wanted, rtol=1e-12)
    torch = pytest.importorskip("torch")
    found = pam.export.to_torch(block)(torch.tensor(memory), torch.tensor(inputs))
    np.testing.assert_allclose(found[1].detach(), wanted, rtol=1e-12)
    runtime = pytest.importorskip("onnxruntime")
    session = runtime.InferenceSession(pam.export(law, tmp_path / "law.onnx"))
    given = {"memory": memory, "inputs": inputs, "p": block.start("parameters")}
    named = {i.name: given[i.name][None] for i in session.get_inputs()}
    np.testing.assert_allclose(session.run(["outputs"], named)[0][0], wanted, rtol=1e-12)
    told = session.get_modelmeta().custom_metadata_map
    assert told["outputs"].split(",") == [v.name for v in block.outputs]


def test_what_is_no_formula_is_refused_in_one_sentence(jnp):
    table = ca.interpolant("table", "bspline", [[0.0, 1.0, 2.0, 3.0]], [0.0, 1.0, 4.0, 9.0])
    memory, u, p = ca.MX.sym("m", 0), ca.MX.sym("u", 1), ca.MX.sym("p", 0)
    step = ca.Function("step", [memory, u, p], [memory, table(u)])
    ends = (Variable("u", "input", start=0.0),), (Variable("y", "output"),)
    block = Block("look", 1e-3, *ends, (), (), step)
    with pytest.raises(pam.ExportError, match="block 'look' holds what is no formula") as caught:
        pam.export.to_jax(block)
    assert "\n" not in str(caught.value)


def test_wrong_names_and_shapes_are_told(hanging, jnp, tmp_path):
    world = pam.export.to_jax(hanging)
    with pytest.raises(pam.UnknownNameError, match=r"'mas'.*mass"):
        world.f(0.0, world.x0, world.u0, {"mas": 1.0})
    refused(r"x has shape \(2,\).*3 entries", world.f, 0.0, world.x0[:2], world.u0)
    refused("ends in none of", pam.export, hanging, tmp_path / "plant.abc")
    refused("jaxx", pam.export, hanging, error=pam.UnknownNameError, world="jaxx")
    refused("not a Plant", pam.export, pam.muscle("DMSP-20-300"), world="jax")


@pytest.mark.parametrize(
    ("library", "extra"), [("jax", "jax"), ("torch", "torch"), ("onnx", "onnx")]
)
def test_a_missing_library_is_told_with_the_command(hanging, monkeypatch, tmp_path, library, extra):
    monkeypatch.setitem(sys.modules, library, None)
    given = (tmp_path / "a.onnx",) if library == "onnx" else ()
    refused(rf"pip install 'pam_ocp\[{extra}\]'", pam.export, hanging, *given, world=library)


def test_no_world_is_loaded_before_it_is_asked_for():
    code = (
        "import sys, pam_ocp as pam; plant = pam.HangingLoad(pam.muscle('DMSP-20-300')); "
        "pam.export.WORLDS['fmu']; list(pam.export.WORLDS); pam.env; "
        "print([m for m in ('jax', 'torch', 'onnx', 'mujoco', 'gymnasium') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"

"""Muscles and plants that several tests use, and independent integration by SciPy."""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # small matrices: threads would only wait

import locale
import random
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from scipy.integrate import solve_ivp

import pam_ocp as pam
from pam_ocp.core.signals import PiecewisePolynomial

BAR = 1e5
# hundreds of children import the same modules: images of containers often forbid to keep them
# compiled, which doubles what a child takes to start
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# no test reads a stopwatch, and a busy machine draws slowly
settings.register_profile("suite", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("suite")
ROOMS = sorted({p.parent.name for p in Path(__file__).parent.glob("*/test_*.py")})


@pytest.fixture
def long_muscle() -> pam.Muscle:
    """The DMSP-20-400N of the catalogue."""
    return pam.muscle("DMSP-20-400N")


@pytest.fixture
def hanging(long_muscle: pam.Muscle) -> pam.Plant:
    return pam.HangingLoad(long_muscle, mass=20.0)


@pytest.fixture
def joint(long_muscle: pam.Muscle) -> pam.Plant:
    return pam.AntagonisticJoint(long_muscle, inertia=0.05, link_mass=1.0, link_length=0.2)


@pytest.fixture
def slide() -> pam.Plant:
    """The plant of the planner's benchmark PAM-2DIR."""
    return benchmark_slide()


def benchmark_slide(feed: Any = None) -> pam.Plant:
    return pam.AntagonisticSlide(
        pam.muscle("DMSP-20-200N"),
        mass=2.0,
        pre_contraction=0.10,
        stroke=0.016,
        damping=pam.losses.ConstantDamping(20.0),
        feed=feed or pam.feeds.Regulator(0.05, max_pressure=6 * BAR, max_rate=40 * BAR),
    )


def hardening_cart(limit: float = 10.0) -> pam.Plant:
    """A mass on a hardening spring, pushed by a force."""
    plant = pam.Plant("cart")
    x = plant.state("x", unit="m", nominal=0.4)
    v = plant.state("v", unit="m/s", nominal=2.5)
    u = plant.input("u", unit="N", min=-limit, max=limit, nominal=3.0)
    m = plant.parameter("mass", 1.5, unit="kg", min=0.1)
    k = plant.parameter("stiffness", 0.7, unit="N/m", min=0.0)
    plant.der(x, v)
    plant.der(v, (u - k * x * (1 + x**2)) / m)
    plant.output("power", u * v, unit="W")
    return plant


def pushed(
    limit: float,
    mass: float | None = None,
    also: Callable[[pam.Plant, Any, Any, Any], object] | None = None,
    **more: dict[str, Any],
) -> pam.Plant:
    """x' = v and v' = u, or u / mass, with |u| <= limit. also : declares more, of (plant, x, v, u).
    more : of the variables, by name.
    """
    plant = pam.Plant("cart")
    x, v = (plant.state(n, unit=unit, **more.get(n, {})) for n, unit in (("x", "m"), ("v", "m/s")))
    u = plant.input("u", unit="N", min=-limit, max=limit, **more.get("u", {}))
    m = 1.0 if mass is None else plant.parameter("mass", mass, unit="kg", min=0.1, max=10.0)
    plant.der(x, v)
    plant.der(v, u / m)
    if also is not None:
        also(plant, x, v, u)
    return plant


def judged_held(
    plant: pam.Plant, start: Any, inputs: Any, stops: Any, duration: float = 1.0, **words: Any
) -> pam.judge.Judgement:
    """Of a motion under constant inputs."""
    signals = PiecewisePolynomial(np.array([0.0, duration]), np.array([[inputs]], float))
    motion = pam.judge.Motion(np.array(start, float), signals, (duration,))
    return pam.judge.judge(plant, pam.judge.Statement(stops, **words), motion)


@contextmanager
def dask_client() -> Iterator[Any]:
    """Of a cluster of two workers on this machine; the test is skipped where there is no Dask."""
    distributed = pytest.importorskip("distributed")
    with (
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster,
        distributed.Client(cluster) as client,
    ):
        yield client


def refused(
    words: str,
    call: Callable[..., Any],
    *arguments: Any,
    error: type[Exception] = pam.InputError,
    **options: Any,
) -> None:
    """The call raises an error that says these words."""
    with pytest.raises(error, match=words):
        call(*arguments, **options)


def flat(value: Any) -> Any:
    """A CasADi matrix as a row of numbers."""
    return np.asarray(value).ravel()


def noisy_record(
    plant: pam.Plant,
    run: pam.Trajectory,
    told: Mapping[str, Any],
    noise: Mapping[str, float],
    random: np.random.Generator,
    between: Any = "previous",
) -> pam.Trajectory:
    """What a rig keeps of a motion: inputs as they were told, measured variables with noise."""
    columns = dict(told)
    for name, size in noise.items():
        columns[name] = run[name] + size * random.standard_normal(len(run.t))
    return pam.Trajectory(run.t, columns, [plant.variable(n) for n in columns], between)


def rates_and_outputs(
    plant: pam.Plant, values: Mapping[str, float] | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """({state: its rate}, {output: its value}) where states and inputs have these values; those
    not named have their own.
    """
    known = {v.name: v.start for v in (*plant.states, *plant.inputs)}
    at = known | dict(values or {})
    assert len(at) == len(known), "neither a state nor an input"
    x, u = ([at[v.name] for v in part] for part in (plant.states, plant.inputs))
    rates, outputs = (flat(e) for e in plant.function(x, u, plant.vector("parameter"))[:2])
    return (
        dict(zip((v.name for v in plant.states), rates, strict=True)),
        dict(zip((v.name for v in plant.outputs), outputs, strict=True)),
    )


def scipy_states(
    plant: pam.Plant,
    inputs: Callable[[float], Any],
    t: Any,
    x0: Any = None,
    *,
    method: str = "DOP853",
    rtol: float = 1e-11,
) -> Any:
    """States (n, nx) at ``t`` by SciPy,
    a jump of the inputs allowed at each t (right-hand value).
    """
    p, nominal = plant.vector("parameter"), plant.vector("state", attribute="nominal")
    x = plant.vector("state") if x0 is None else np.asarray(x0, float)

    def f(time: float, z: Any, low: float, high: float) -> Any:
        # stages of a step over [low, high) never see the input beyond its end
        inside = min(max(time, low), np.nextafter(high, low))
        return np.asarray(plant.function(z * nominal, inputs(inside), p)[0]).ravel() / nominal

    rows = [x]
    for low, high in pairwise(t):
        solution = solve_ivp(
            f,
            (low, high),
            rows[-1] / nominal,
            method=method,
            rtol=rtol,
            atol=rtol,
            args=(low, high),
        )
        assert solution.success
        rows.append(solution.y[:, -1] * nominal)
    return np.array(rows)


@pytest.fixture
def plain_pictures(monkeypatch):
    """For tests that look at no picture: it is some bytes, and takes no time to draw."""
    monkeypatch.setattr("pam_ocp.figures.canvas.drawn", lambda figure, kind, dpi: b"a picture")


@pytest.fixture(scope="session")
def fmus(tmp_path_factory):
    """The benchmark's slide as an FMU of each version, unpacked."""
    from fmu_tools import unpacked

    return unpacked(tmp_path_factory.mktemp("fmus"))


@pytest.fixture(params=["2.0", "3.0"])
def fmi(request):
    """One version after the other."""
    return request.param


@pytest.fixture
def fmu(fmus, fmi):
    """The slide in a version."""
    return fmus[fmi]


@pytest.fixture
def slide_unit(fmu):
    """The same as a file."""
    return fmu.folder.with_name(f"{fmu.fmi[0]}.fmu")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--shuffle", type=int, metavar="SEED", help="modules and their tests in random order"
    )


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark each test with its room: ``pytest -m planning``."""
    seed = config.getoption("--shuffle")
    if seed is not None:  # modules stay together: what they share is made once
        places: dict[Path, float] = {}
        chance = random.Random(seed)
        chance.shuffle(items)
        items.sort(key=lambda item: places.setdefault(item.path, chance.random()))
    for item in items:
        room = item.path.parent.name
        if room in ROOMS:
            item.add_marker(room)


def pytest_configure(config: pytest.Config) -> None:
    """The rooms are the folders of the tests; Ctrl-C works though a shell's background bars it."""
    if "PAM_TEST_LOCALE" in os.environ:  # as programs with windows do, which load FMUs
        locale.setlocale(locale.LC_ALL, "")
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for room in ROOMS:
        config.addinivalue_line("markers", f"{room}: tests of this room")


@pytest.hookimpl(wrapper=True)
def pytest_report_to_serializable() -> Iterator[Any]:
    """What libraries say of damaged bytes (lone surrogates) reaches pytest-xdist's server too."""
    return _printable((yield))


def _printable(value: Any) -> Any:
    if isinstance(value, str):
        return value.encode("utf-8", "backslashreplace").decode()
    if isinstance(value, dict):
        return {key: _printable(item) for key, item in value.items()}
    return type(value)(map(_printable, value)) if isinstance(value, list | tuple) else value


# ---- what pictures, pages and workbooks are made of ----------------------------------------------
@pytest.fixture(scope="session")
def static_fit():
    return pam.fit_force(pam.read_table("DMSP-20-300_static.csv", rest_length=0.3))


@pytest.fixture(scope="session")
def load_10kg():
    return pam.HangingLoad("DMSP-20-300", mass=10.0)


@pytest.fixture(scope="session")
def load_motion(load_10kg):
    return pam.simulate(load_10kg, {"muscle.command": 3e5}, duration=0.05)


@pytest.fixture(scope="session")
def short_plan():
    slide = pam.AntagonisticSlide("DMSP-20-300", mass=2.0, pre_contraction=0.10)
    stops = [{"x": -0.01}, {"x": 0.01}]
    return pam.plan(slide, stops, method=pam.Collocation(8), tolerance=None)

"""CONTRIBUTING.md, tried: each kind of component is added here, once, and used by its name.

What a contributor would write as a new file stands between two registrations; nothing else of the
package is touched, and the registries are as before afterwards.
"""

import importlib
import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import casadi as ca
import numpy as np
import pytest
from conftest import flat, rates_and_outputs, refused
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

import pam_ocp as pam
from pam_ocp.cli.main import main
from pam_ocp.control.kinds import CONTROLLERS, ESTIMATORS
from pam_ocp.control.mpc.sqp import QP_SOLVERS, conic
from pam_ocp.core.registry import Registry
from pam_ocp.figures.film import _film
from pam_ocp.judge.statement import COSTS, running_cost
from pam_ocp.muscles.gas import VOLUMES
from pam_ocp.muscles.law import LAWS, coefficient, register
from pam_ocp.planning.problem.problem_file import load_problem
from pam_ocp.planning.solvers.solver import SOLVERS, Outcome
from pam_ocp.plants.kinds import DAMPINGS, FEEDS, LOADS, LOSSES, PLANTS
from pam_ocp.plants.plant_file import plant_of
from pam_ocp.plants.sketch import Line, Mark, Polygon, Sketch, Spindle, box
from pam_ocp.studies.steps.step import STEPS, Made, Step

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
MUSCLE = "DMSP-20-200N"
QUICK = "[method]\nintervals = 8\ndegree = 5\n"


@contextmanager
def known(registry: Registry, *names: str) -> Iterator[None]:
    """Names that were registered just now, until the end of the block."""
    try:
        yield
    finally:
        for name in names:
            registry.remove(name)
            assert name not in registry


def problem(tmp_path, *parts: str):
    file = tmp_path / "problem.toml"
    file.write_text("\n".join(parts), "utf-8")
    return load_problem(file)


def is_taken_by_every_verb(plant: pam.Plant, tmp_path, **at: float) -> None:
    """It simulates, linearises where it rests, and its C code is that of an FMU."""
    motion = pam.simulate(plant, duration=0.02)
    assert np.all(np.isfinite(motion.array([v.name for v in plant.states])))
    system = pam.linearize(plant, plant.equilibrium(at))
    assert np.all(np.isfinite(system.A))
    assert pam.export_fmu(plant, tmp_path / "it.fmu", platforms="source").stat().st_size > 1e4


# ---- a law -----------------------------------------------------------------------------------
def test_a_law_is_one_class(tmp_path):
    @register
    @dataclass(frozen=True)
    class CubicLaw(pam.laws.ForceLaw):
        """F = (g0 + g1 kappa + g3 kappa^3) p - h0."""

        g0: float = coefficient("N/Pa", 3e-3, "gain at rest length")
        g1: float = coefficient("N/Pa", 1e-2, "gain, linear term")
        g3: float = coefficient("N/Pa", 1e-2, "gain, cubic term")
        h0: float = coefficient("N", 100.0, "force at zero pressure")

        name: ClassVar[str] = "cubic"
        title: ClassVar[str] = "Cubic law"
        reference: ClassVar[str] = "a test"

        def formula(self, p, kappa):
            return (self.g0 + self.g1 * kappa + self.g3 * kappa**3) * p - self.h0

    with known(LAWS, "cubic"):
        true = CubicLaw(3e-3, -9e-3, -2e-2, 80.0)
        muscle = pam.Muscle(true, rest_length=0.25, diameter=0.02)
        pam.save_muscle(muscle, tmp_path / "cubic.toml")
        p, kappa = np.meshgrid([2e5, 4e5, 6e5], [0.0, 0.05, 0.1, 0.15])
        measured = (3e-3 - 9e-3 * kappa - 2e-2 * kappa**3) * p - 80.0
        table = tmp_path / "table.csv"
        rows = np.column_stack([kappa.ravel(), p.ravel(), measured.ravel()])
        np.savetxt(
            table, rows, delimiter=",", header="contraction,pressure_Pa,force_N", comments=""
        )
        fit = pam.fit_force(pam.read_table(table), "cubic")
        for name, value in true.values.items():
            assert fit.law.values[name] == pytest.approx(value, rel=1e-6)
        file = {"arrangement": "HangingLoad", "muscle": str(tmp_path / "cubic.toml"), "mass": 20.0}
        plant = plant_of(file)
        speed = rates_and_outputs(plant, {"x": 0.02, "muscle.pressure": 2e5})[0]["v"]
        assert speed == pytest.approx((3e-3 - 9e-3 * 0.08 - 2e-2 * 0.08**3) * 1e4 - 4.0 - 9.80665)
        is_taken_by_every_verb(plant, tmp_path, x=0.02)
    refused("cubic", pam.load_muscle, tmp_path / "cubic.toml")


# ---- a load ----------------------------------------------------------------------------------
def test_a_load_is_one_class(tmp_path):
    @LOADS.register(units={"pull": ("N", "N.m"), "reach": ("m", "rad"), "mass": ("kg", "kg.m2")})
    @dataclass(frozen=True)
    class Magnet:
        """A magnet at the origin: F = -pull q/(1 + q^2), q = position/reach; it moves along."""

        pull: float
        reach: float = 0.005
        mass: float = 0.1
        name: str = "magnet"

        def force(self, plant, at):
            pull = plant.parameter(
                f"{self.name}.pull", self.pull, unit=at.effort, min=0.0, tunable=True
            )
            q = at.position / self.reach
            return -pull * q / (1 + q**2)

        def inertia(self, plant, at):
            return plant.parameter(
                f"{self.name}.mass", self.mass, unit="kg.m2" if at.rotary else "kg", min=0.0
            )

    with known(LOADS, "Magnet"):
        plant, arguments = problem(
            tmp_path,
            "minimise = 'time'",
            "stops = [{ x = '-5 mm' }, { x = '5 mm' }]",
            f"[plant]\narrangement = 'AntagonisticSlide'\nmuscle = '{MUSCLE}'\nmass = 2.0",
            "loads = [{ kind = 'Magnet', pull = '30 N', reach = '4 mm', mass = '200 g' }]",
            QUICK,
        )
        equal = {"muscle1.pressure": 2e5, "muscle2.pressure": 2e5, "x": 0.0, "v": 0.0}
        weak = plant.with_values({"magnet.pull": 0.0})
        with_it, without = (
            rates_and_outputs(p, equal | {"x": 0.004})[0]["v"] for p in (plant, weak)
        )
        assert with_it - without == pytest.approx(-15.0 / 2.2)
        assert pam.plan(plant, tolerance=None, **arguments).solved
        is_taken_by_every_verb(plant, tmp_path, x=0.001, stiffness=2e4)
        turned = plant_of(
            {
                "arrangement": "AntagonisticJoint",
                "muscle": MUSCLE,
                "loads": [{"kind": "magnet", "pull": "2 N.m", "reach": "10 deg"}],
            }
        )
        assert turned.variable("magnet.pull").unit == "N.m"
        with pytest.raises(pam.UnknownNameError, match=r"'pul': did you mean 'pull'"):
            plant_of(
                {
                    "arrangement": "HangingLoad",
                    "muscle": MUSCLE,
                    "loads": [{"kind": "Magnet", "pul": 1}],
                }
            )
    with pytest.raises(pam.UnknownNameError, match=r"loads\[0\].kind 'Magnet'"):
        plant_of({"arrangement": "HangingLoad", "muscle": MUSCLE, "loads": [{"kind": "Magnet"}]})


# ---- a feed ----------------------------------------------------------------------------------
def test_a_feed_is_one_class(tmp_path):
    @FEEDS.register(units={"lag": "s", "band": "Pa"})
    @dataclass(frozen=True)
    class LazyRegulator:
        """lag q' = (u - p) e^2/(e^2 + band^2), e = u - p: it hardly moves within a dead band."""

        lag: float = 0.05
        band: float = 5e3

        def connect(self, plant, name, muscle, contraction, rate):
            top = muscle.pressure_range[1]
            state = {"unit": "Pa", "min": 0.0, "max": top, "start": top / 2, "nominal": 1e5}
            pressure = plant.state(f"{name}.held", **state)
            command = plant.input(f"{name}.command", **state)
            band = plant.parameter(f"{name}.band", self.band, unit="Pa", min=1.0, nominal=1e4)
            e = command - pressure
            plant.der(pressure, e * e**2 / (e**2 + band**2) / self.lag)
            return pressure

    with known(FEEDS, "LazyRegulator"):
        plant = plant_of(
            {
                "arrangement": "HangingLoad",
                "muscle": MUSCLE,
                "mass": "10 kg",
                "feed": {"kind": "LazyRegulator", "lag": "20 ms", "band": "0.1 bar"},
            }
        )
        rate, _ = rates_and_outputs(plant, {"muscle.held": 2e5, "muscle.command": 2.2e5})
        assert rate["muscle.held"] == pytest.approx(2e4 * 4e8 / (4e8 + 1e8) / 0.02)
        motion = pam.simulate(plant, inputs={"muscle.command": 3e5}, duration=0.3)
        assert motion["muscle.pressure"] == pytest.approx(motion["muscle.held"])  # declared for it

        def alone(t, p):
            e = 3e5 - p
            return e * e**2 / (e**2 + 1e8) / 0.02

        exact = solve_ivp(alone, (0, 0.3), [motion["muscle.held"][0]], rtol=1e-10, atol=1e-4)
        assert motion["muscle.held"][-1] == pytest.approx(exact.y[0, -1], rel=1e-6)
        assert pam.export_fmu(plant, tmp_path / "it.fmu", platforms="source").exists()


# ---- a loss ----------------------------------------------------------------------------------
def test_a_loss_is_one_class(tmp_path):
    @LOSSES.register(units={"static": "N", "speed": "m/s"})
    @dataclass(frozen=True)
    class Stribeck:
        """F = static v/sqrt(v^2 + speed^2) exp(-|v|/(10 speed)), the falling branch alone."""

        static: float = 10.0
        speed: float = 1e-3

        def force(self, plant, name, motion):
            size = plant.parameter(f"{name}.static", self.static, unit="N", min=0.0, nominal=10.0)
            smooth = ca.sqrt(motion.velocity**2 + self.speed**2)
            return size * motion.velocity / smooth * ca.exp(-smooth / (10 * self.speed))

    with known(LOSSES, "Stribeck"):
        plant = plant_of(
            {
                "arrangement": "SpringOverMuscle",
                "muscle": MUSCLE,
                "losses": [{"kind": "Stribeck", "static": "12 N", "speed": "2 mm/s"}],
            }
        )
        at = {"x": 0.01, "v": 0.03, "muscle.pressure": 3e5}
        lost = pam.simulate(plant, duration=0.01, start=at)["muscle.loss"][0]
        smooth = math.hypot(0.03, 2e-3)
        assert lost == pytest.approx(12.0 * 0.03 / smooth * math.exp(-smooth / 0.02), rel=1e-9)
        is_taken_by_every_verb(plant, tmp_path, x=0.01)


# ---- a damping, a volume ---------------------------------------------------------------------
def test_a_damping_is_one_class():
    @DAMPINGS.register(units={"time": "s"})
    @dataclass(frozen=True)
    class Rayleigh:
        """c = time k: damping in proportion to stiffness."""

        time: float = 1e-3

        def coefficient(self, plant, mass, stiffness, unit="N.s/m"):
            time = plant.parameter("damping_time", self.time, unit="s", min=0.0, nominal=1e-3)
            return time * stiffness

    with known(DAMPINGS, "Rayleigh"):
        plant = plant_of(
            {
                "arrangement": "HangingLoad",
                "muscle": MUSCLE,
                "mass": 10.0,
                "damping": {"kind": "Rayleigh", "time": "2 ms"},
            }
        )
        at = {"x": 0.02, "muscle.pressure": 3e5}
        slow, fast = (rates_and_outputs(plant, at | {"v": v})[0]["v"] for v in (0.0, 0.1))
        k = pam.muscle(MUSCLE).stiffness(3e5, 0.02 / pam.muscle(MUSCLE).rest_length)
        assert fast - slow == pytest.approx(-2e-3 * k * 0.1 / 10.0)


def test_a_volume_is_one_class():
    @VOLUMES.register(units={"rest": "m3", "growth": "m3"})
    @dataclass(frozen=True)
    class StraightVolume:
        """V = rest + growth kappa."""

        rest: float
        growth: float

        def filled(self, muscle, kappa, declare):
            return declare("v_rest", self.rest, unit="m3") + self.growth * kappa

    with known(VOLUMES, "StraightVolume"):
        volume = {"kind": "StraightVolume", "rest": "0.1 l", "growth": "0.2 l"}
        plant = plant_of(
            {
                "arrangement": "HangingLoad",
                "muscle": MUSCLE,
                "feed": {"kind": "OnOffValves", "gas": {"volume": volume, "dead_volume": "0 l"}},
            }
        )
        motion = pam.simulate(plant, duration=0.01)
        expected = 1e-4 + 2e-4 * motion["muscle.contraction"]
        assert motion["muscle.volume"] == pytest.approx(expected, rel=1e-9)


# ---- a running cost --------------------------------------------------------------------------
def test_a_running_cost_is_one_function(tmp_path):
    @running_cost("tension", unit="N2.s", nominal=1e4, slower_is_less=True)
    def tension(plant, symbols):
        """Integral of the squared force of both muscles."""
        return plant.expression("muscle1.force") ** 2 + plant.expression("muscle2.force") ** 2

    plant = f"[plant]\narrangement = 'AntagonisticSlide'\nmuscle = '{MUSCLE}'\n"
    stops = "stops = [{ x = '-5 mm' }, { x = '5 mm' }]\nduration = '0.2 s'\n"
    with known(COSTS, "tension"):
        slide, light = problem(tmp_path, "minimise = 'tension'", stops, plant, QUICK)
        _, bound = problem(tmp_path, "minimise = 'effort'", stops, plant, QUICK)
        best = pam.plan(slide, tolerance=None, **light)
        other = pam.plan(slide, tolerance=None, **bound)
        spent = [
            np.trapezoid(m["muscle1.force"] ** 2 + m["muscle2.force"] ** 2, m.t)
            for m in (p.replay.trajectory for p in (best, other))
        ]
        assert best.objective * 1e4 == pytest.approx(spent[0], rel=1e-2)
        assert spent[0] < 0.99 * spent[1]
        most = (spent[0] + spent[1]) / 2
        _, kept = problem(
            tmp_path,
            "minimise = 'effort'",
            stops,
            f"budgets = {{ tension = {most} }}",
            plant,
            QUICK,
        )
        between = pam.plan(slide, tolerance=None, **kept)
        assert other.objective < between.objective
        free, endless = problem(
            tmp_path, "minimise = 'tension'", stops.replace("duration = '0.2 s'", ""), plant
        )
        refused("'tension' needs a fixed duration", pam.plan, free, **endless)
    refused("unknown objective 'tension'", pam.plan, slide, error=pam.UnknownNameError, **light)


# ---- a plant ---------------------------------------------------------------------------------
def test_a_plant_is_one_class(tmp_path):
    @PLANTS.register(units={"mass": "kg", "arm": "m", "length": "m"})
    class Lever(pam.Plant):
        """Two muscles turn a lever with a weight at its end, against gravity."""

        def __init__(self, muscle, mass=1.0, arm=0.03, length=0.2, *, feed=None, name="lever"):
            super().__init__(name, "a lever between two muscles")
            theta = self.state("theta", unit="rad", min=-0.4, max=0.4, nominal=0.1)
            omega = self.state("omega", unit="rad/s", nominal=1.0)
            m = self.parameter("mass", mass, unit="kg", min=1e-6, tunable=True)
            r = self.parameter("arm", arm, unit="m", min=1e-6, nominal=0.01)
            far = self.parameter("length", length, unit="m", min=1e-6, nominal=0.1)
            flexor, extensor = (
                self.add_muscle(
                    name,
                    muscle,
                    shortening=side * r * theta,
                    rate=side * r * omega,
                    pre_contraction=0.1,
                    feed=feed,
                )
                for name, side in (("flexor", 1), ("extensor", -1))
            )
            torque = r * (flexor.force - extensor.force) - m * 9.80665 * far * ca.cos(theta)
            self.der(theta, omega)
            self.der(omega, (torque - 0.1 * omega) / (m * far**2))

        def sketch(self):
            theta, far = self.expression("theta"), self.expression("length")
            end = (far * ca.cos(theta), far * ca.sin(theta))
            return Sketch(
                (
                    Polygon(box((-0.05, -0.35), (0.05, -0.3)), "ground"),
                    Spindle("flexor", (-0.03, -0.3), (-0.03, 0.0)),
                    Spindle("extensor", (0.03, -0.3), (0.03, 0.0)),
                    Line([(0.0, 0.0), end], "rod"),
                ),
                (-0.1, 1.2 * far),
                (-0.4, 0.2),
                (Mark("theta", [(0.0, 0.0), end]),),
            )

    with known(PLANTS, "Lever"):
        plant, arguments = problem(
            tmp_path,
            "minimise = { time = 1.0, effort = 1e-3 }",
            "stops = [{ theta = '-5 deg' }, { theta = '5 deg' }]",
            f"[plant]\narrangement = 'lever'\nmuscle = '{MUSCLE}'\nmass = '500 g'\n",
            QUICK,
        )
        plan = pam.plan(plant, tolerance=None, **arguments)
        assert plan.solved
        motion = plan.replay.trajectory.at(np.linspace(0.0, plan.duration, 5))
        figure, drawn = _film(plan, motion, 1.0)
        stage = next(ax for ax in figure.axes if ax.get_aspect() == 1.0)
        drawn[0](4)
        tip = [line.get_xydata()[-1] for line in stage.lines if line.get_linewidth() == 6]
        theta = motion["theta"][4]
        assert tip[0] == pytest.approx([0.2 * math.cos(theta), 0.2 * math.sin(theta)], abs=1e-12)
        is_taken_by_every_verb(plant, tmp_path, theta=0.05, **{"flexor.force": 400.0})
    with pytest.raises(pam.UnknownNameError, match=r"plant.arrangement 'lever'"):
        plant_of({"arrangement": "lever", "muscle": MUSCLE})


# ---- a solver --------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_solver_is_one_class(tmp_path):
    @SOLVERS.register("slsqp")
    class Slsqp:
        """SciPy's sequential least squares programming."""

        def __init__(self, program, options=None, progress=False):
            nlp = program.nlp
            x, p, f, g = (nlp[k] for k in ("x", "p", "f", "g"))
            self._cost = ca.Function("f", [x, p], [f, ca.densify(ca.gradient(f, x))])
            self._rows = ca.Function("g", [x, p], [g, ca.densify(ca.jacobian(g, x))])
            self._options = {"maxiter": 200, "ftol": 1e-10, **(options or {})}

        def __call__(self, program, guess, start="cold", warm=None):
            p, (low, high), (least, most) = (
                program.parameters(),
                program.bounds(),
                program.limits(),
            )
            equal = least == most
            parts = [("eq", equal, 1.0, least)]
            parts += [("ineq", ~equal & np.isfinite(least), 1.0, least)]
            parts += [("ineq", ~equal & np.isfinite(most), -1.0, most)]
            rows = [
                {
                    "type": kind,
                    "fun": lambda x, i=i, s=s, e=e: s * (flat(self._rows(x, p)[0]) - e)[i],
                    "jac": lambda x, i=i, s=s: s * np.asarray(self._rows(x, p)[1])[i],
                }
                for kind, i, s, e in parts
                if i.any()
            ]
            found = minimize(
                lambda x: float(self._cost(x, p)[0]),
                np.clip(guess, low, high),
                jac=lambda x: flat(self._cost(x, p)[1]),
                bounds=list(zip(low, high, strict=True)),
                constraints=rows,
                method="SLSQP",
                options=self._options,
            )
            nothing = np.zeros(len(least)), np.zeros(len(found.x))
            return Outcome(
                found.x,
                found.fun,
                found.message,
                found.success,
                found.nit,
                0.0,
                *nothing,
                (),
                "SLSQP",
            )

    with known(SOLVERS, "slsqp"):
        content = (
            "minimise = { effort = 1.0 }\nduration = '0.3 s'\nsolver = 'slsqp'\nstarts = 1",
            "stops = [{ x = '10 mm' }, { x = '20 mm' }]",
            f"[plant]\narrangement = 'HangingLoad'\nmuscle = '{MUSCLE}'\nmass = 10.0",
            "[method]\nintervals = 5\ndegree = 5",
        )
        plant, arguments = problem(tmp_path, *content)
        theirs = pam.plan(plant, tolerance=None, **arguments)
        ours = pam.plan(plant, tolerance=None, **{**arguments, "solver": "ipopt"})
        assert theirs.solved
        assert theirs.objective == pytest.approx(ours.objective, rel=1e-5)
        with pytest.raises(pam.InputError, match="compiled = True goes with solver = 'ipopt'"):
            pam.plan(plant, tolerance=None, compiled=True, **arguments)
    refused("solver = 'slsqp': choose one of ipopt", pam.plan, plant, **arguments)


# ---- a controller, an estimator, a QP solver -------------------------------------------------
def test_a_controller_is_one_class(tmp_path, capsys):
    @CONTROLLERS.register("relay")
    class Relay:
        """More pressure below the place, less above it."""

        def __init__(self, plant, place: float, low: float = 1e5, high: float = 3e5) -> None:
            self.name, self.place, self.ends = plant.inputs[0].name, place, (high, low)

        def reset(self):
            """Nothing to forget."""

        def __call__(self, t, measured):
            return {self.name: self.ends[measured["x"] > self.place]}

    file, motion = tmp_path / "loop.toml", tmp_path / "motion.csv"
    file.write_text(
        f"plant = 'hanging_load'\nmuscle = '{MUSCLE}'\nset = {{ mass = '10 kg' }}\n"
        "duration = '1 s'\nstart = { x = '20 mm' }\n"
        "[controller]\nkind = 'relay'\nplace = 0.03\nhigh = 4e5\n[estimator]\nkind = 'none'\n"
    )
    with known(CONTROLLERS, "relay"):
        assert main(["mpc", str(file), "--out", str(motion)]) == 0
        run = pam.Trajectory.load(motion)
        late = run["x"][run.t > 0.5]
        assert late.min() < 0.03 < late.max()
        assert set(np.unique(run["muscle.command"])) == {1e5, 4e5}
    capsys.readouterr()
    assert main(["mpc", str(file)]) == 2
    said = capsys.readouterr().err
    assert "unknown controller.kind 'relay': known: hysteresis-compensation, lqr, mpc" in said


def test_an_estimator_is_one_class(capsys):
    @ESTIMATORS.register("gated")
    class Gated(pam.KalmanFilter):
        """A Kalman filter that does not believe what is far from what it expects."""

        seen: ClassVar[list[int]] = []

        def correct(self, measurement, inputs=None):
            expected = self.estimate.state
            near = {
                n: v
                for n, v in measurement.items()
                if abs(v - expected.get(n, v)) < self.plant.variable(n).nominal
            }
            self.seen.append(len(near))
            return super().correct(near, inputs)

    with known(ESTIMATORS, "gated"):
        assert main(["mpc", "--estimator", "gated", "--duration", "0.05"]) == 0
        assert len(Gated.seen) >= 10
        assert "steady error of x" in capsys.readouterr().out
    assert main(["mpc", "--estimator", "gated", "--duration", "0.05"]) == 2
    assert "unknown estimator.kind 'gated': known: kalman" in capsys.readouterr().err


def test_a_qp_solver_is_one_function():
    @QP_SOLVERS.register("qrqp")
    def qrqp(program):
        """CasADi's own active-set method."""
        return conic(program, "qrqp", {"print_iter": False, "print_header": False})

    with known(QP_SOLVERS, "qrqp"):
        plant = pam.AntagonisticSlide(MUSCLE)
        rest = plant.equilibrium(x=0.0, stiffness=2e4)
        state = {v.name: rest[v.name] for v in plant.states}
        asked = {
            "horizon": 8,
            "sample_time": 5e-3,
            "track": {"x": 1.0, "stiffness": 0.05},
            "rate": {v.name: 0.05 for v in plant.inputs},
        }
        given = [
            pam.Mpc(plant, solver=solver, **asked).control(state, {"x": 0.004, "stiffness": 2e4})
            for solver in ("qrqp", "piqp")
        ]
        for name, value in given[0].items():
            assert value == pytest.approx(given[1][name], abs=50.0)  # 5e-4 of nominal
    with pytest.raises(
        pam.InputError, match="'qrqp': choose 'hpipm', 'piqp', 'riccati' or 'ipopt'"
    ):
        pam.Mpc(plant, solver="qrqp", **asked)


def test_a_step_of_a_study_is_one_class(tmp_path):
    @STEPS.register("double")
    class Double(Step):
        """Twice a number."""

        needs = ("value",)

        @classmethod
        def work(cls, job):
            twice = 2 * job.get("value")
            (job.out / "twice.txt").write_text(f"{twice:g}", "utf-8")
            return Made(verdict=f"twice is {twice:g}", numbers={"twice": (twice, "1")})

    with known(STEPS, "double"):
        file = tmp_path / "study.toml"
        file.write_text("steps.mine = { kind = 'double', value = 21.0 }", "utf-8")
        found = pam.studies.run_study(file, tmp_path / "out", cache=tmp_path / "kept")
        assert found.ok
        assert found["mine"].verdict == "twice is 42"
        assert (tmp_path / "out" / "mine" / "twice.txt").read_text("utf-8") == "42"


# ---- what CONTRIBUTING.md shows ---------------------------------------------------------------
def test_the_load_and_the_problem_of_the_page_work(tmp_path, monkeypatch):
    code, words = (re.search(rf"```{kind}\n(.*?)```", PAGE, re.S)[1] for kind in ("python", "toml"))
    for name in ("..core.errors", ".kinds", ".loads"):
        full = f"pam_ocp.plants{name}" if name.count(".") == 1 else f"pam_ocp{name[1:]}"
        code = code.replace(f"from {name} import", f"from {full} import")
    (tmp_path / "magnet.py").write_text(code, "utf-8")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.import_module("magnet")
    with known(LOADS, "Magnet"):
        plant, _ = problem(tmp_path, "stops = [{ x = 0.0 }, { x = '1 mm' }]", words)
        assert plant.variable("magnet.pull").start == 30.0


def test_the_page_names_every_registry_and_every_file_that_holds_one():
    holders = {"plants/kinds.py", "muscles/law.py", "muscles/gas.py", "control/kinds.py"}
    holders |= {"judge/statement.py", "planning/solvers/solver.py", "control/mpc/sqp.py"}
    holders |= {"studies/steps/step.py", "rig/drivers/driver.py", "export/worlds/registry.py"}
    found = {
        path.relative_to(ROOT / "pam_ocp").as_posix()
        for path in (ROOT / "pam_ocp").rglob("*.py")
        if re.search(r"^[A-Z_]+: Registry\[", path.read_text("utf-8"), re.M)
    }
    assert found == holders
    assert all(f"`{name}`" in PAGE for name in holders)

"""Planning problems as files, and the command that solves them."""

import math
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from cli_tools import run
from conftest import benchmark_slide, refused

import pam_ocp as pam
from pam_ocp import Avoid, Collocation, Constraint, InputError, Phase, Profile, Stop
from pam_ocp.planning import Shooting
from pam_ocp.planning.problem.problem_file import expression_of, load_problem
from pam_ocp.plants.kinds import PLANTS
from pam_ocp.plants.plant_file import muscle_of, plant_of

EXAMPLE = Path(__file__).parents[2] / "examples" / "slide.toml"

PLANT = """
[plant]
arrangement = "AntagonisticSlide"
muscle = "DMSP-20-200N"
stroke = "16 mm"
feed = { kind = "Regulator", lag = "50 ms", max_pressure = "6 bar", max_rate = "40 bar/s" }
"""
STOPS = """
[[stops]]
x = "-1.5 cm"
[[stops]]
x = 0.015
"""


def written(tmp_path, *parts):
    file = tmp_path / "problem.toml"
    file.write_text("\n".join(parts), "utf-8")
    return file


def function(plant, expression):
    return ca.Function("f", [plant.x, plant.u, plant.p, pam.planning.TIME], [expression])


def test_the_example_says_what_python_says():
    plant, arguments = load_problem(EXAMPLE)
    own = benchmark_slide()
    for one, two in zip(plant.variables, own.variables, strict=True):
        assert (one.name, one.start) == (two.name, pytest.approx(two.start))
        assert one.max == pytest.approx(two.max)
    assert arguments["stops"] == [Stop({"x": -0.015}), Stop({"x": 0.015}, dwell=0.05)]
    assert arguments["bounds"]["muscle1.force"] == (50.0, None)
    assert arguments["duration"] == (0.02, 1.0)
    assert arguments["method"] == Collocation(20, 4)
    assert (arguments["cyclic"], arguments["minimise"]) == (True, "time")


EVERY_KEY = """
cyclic = false
rest = true
memory = "below"
duration = ["0.2 s", { min = "100 ms", max = 1.0 }]
minimise = { time = 1.0, "final(x)" = -0.5 }
tolerance = 1e-5
integrand = "1e-3*v**2 + 0*time"
final = "(x - 1e-3)**2"
method = { kind = "Shooting", intervals = 4, steps = 2, control = "linear" }
options = { max_iter = 50 }

[[stops]]
x = ["-5 mm", "-4 mm"]
muscle1.pressure = "2 bar"
[[stops]]
x = { min = "2 mm" }
rest = false
[[stops]]
x = "4 mm"
dwell = { min = "10 ms", max = "20 ms" }
within = 0.01

[bounds]
muscle1.force = { min = "20 N" }
"der(muscle1.pressure)" = ["-20 bar/s", inf]
x = { max = { t = [0.0, "0.5 s"], values = ["5 mm", "10 mm"] } }
v = { t = [0, 1, 2, 3], values = [0, 1, 0, 1], smooth = true }

[[constraints]]
expression = "muscle1.force - muscle2.force"
min = "-0.1 kN"
unit = "N"
nominal = 10.0
name = "net force"
[[constraints]]
avoid = { x = ["0 mm", "1 mm"], time = ["0.1 s", "20 ms"] }

[[phases]]
duration = "0.3 s"
[[phases]]
bounds = { v = [-1.0, 1.0] }
[[phases.constraints]]
expression = "abs(v)"
max = 2

[track]
stiffness = { aim = "20 N/mm", weight = 2.0 }
x = { aim = { t = [0, 1], values = ["0 mm", "2 mm"] } }

[budgets]
effort = 3.0
work = { max = "2 J" }

[design]
mass = ["1500 g", "2.5 kg"]
"""


def test_every_key_is_understood(tmp_path):
    plant, found = load_problem(written(tmp_path, EVERY_KEY, PLANT))
    assert found["stops"] == [
        Stop({"x": (-0.005, -0.004), "muscle1.pressure": pytest.approx(2e5)}),
        Stop({"x": (0.002, None)}, rest=False),
        Stop({"x": 0.004}, dwell=(0.01, 0.02), within=0.01),
    ]
    assert found["memory"] == "below"
    assert found["duration"] == [0.2, (0.1, 1.0)]
    assert found["minimise"] == {"time": 1.0, "final(x)": -0.5}
    assert found["method"] == Shooting(4, 2, "linear")
    assert found["options"] == {"max_iter": 50}
    assert found["design"]["mass"] == pytest.approx((1.5, 2.5))
    assert found["budgets"] == {"effort": 3.0, "work": (None, 2.0)}
    assert found["track"]["stiffness"] == pytest.approx((2e4, 2.0))
    assert isinstance(found["track"]["x"][0], Profile)
    bounds = found["bounds"]
    assert bounds["der(muscle1.pressure)"] == (pytest.approx(-2e6), None)
    assert bounds["x"][0] is None
    assert bounds["x"][1](0.25) == pytest.approx(0.0075)
    assert bounds["v"].smooth
    net, region = found["constraints"]
    assert isinstance(net, Constraint)
    assert (net.low, net.high, net.name, net.nominal) == (-100.0, None, "net force", 10.0)
    assert region == Avoid({"x": (0.0, 0.001), "time": (0.1, 0.02)})
    first, second = found["phases"]
    assert isinstance(first, Phase)
    assert (first.duration, first.bounds, list(first.constraints)) == (0.3, {}, [])
    assert second.duration is None
    assert second.bounds == {"v": (-1.0, 1.0)}
    assert second.constraints[0].high == 2
    running = function(plant, found["integrand"])
    x = plant.vector("state", {"v": 2.0})
    assert float(running(x, 0, plant.vector("parameter"), 5.0)) == pytest.approx(4e-3)
    pam.Planner(plant, **{k: v for k, v in found.items() if k != "tolerance"})  # the planner agrees


def test_a_file_gives_the_plan_that_python_gives(tmp_path):
    """The half cycle of the planner's benchmark: 0.060778 s by 50 constant inputs (published)."""
    head = 'cyclic = "mirrored"\nduration = { min = "20 ms", max = "1 s" }'
    plant, arguments = load_problem(written(tmp_path, head, PLANT, STOPS))
    assert pam.plan(plant, **arguments).duration == pytest.approx(0.060778, abs=2e-6)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        (["cycl = true", PLANT, STOPS], "unknown key of the problem 'cycl': did you mean 'cyclic'"),
        ([STOPS], "plant is missing"),
        ([PLANT], "stops is missing"),
        ([PLANT, STOPS, "cyclic = true"], r"stops\[2\] holds 'cyclic'.*above the first"),
        ([PLANT, STOPS, "y = 1"], "'y'"),
        ([PLANT, STOPS, 'v = "3 mm"'], r"stops\[2\].v = '3 mm': this measures something else"),
        ([PLANT, STOPS, 'v = "fast"'], "give a number with its unit"),
        ([PLANT, STOPS, 'v = "1 m/fortnight"'], "unknown unit 'm/fortnight'"),
        ([PLANT, STOPS, "dwell = { min = 1 }"], "give both min and max"),
        ([PLANT, STOPS, "rest = 1"], "give true or false"),
        (["stops = 3", PLANT], "list of tables"),
        (['cyclic = "yes"', PLANT, STOPS], "true, false or 'mirrored'"),
        (['method = { kind = "Radau" }', PLANT, STOPS], "unknown method.kind 'Radau'"),
        (["method = { steps = 3 }", PLANT, STOPS], "key of method"),
        (["method = { degree = 30 }", PLANT, STOPS], "from 1 to 9"),
        ([PLANT, STOPS, "[bounds]\nx = [1]"], r"bounds.x = \[1\]: give \[low, high\]"),
        ([PLANT, STOPS, "[bounds]\nx = { t = [0], values = 3 }"], "bounds.x.values = 3"),
        ([PLANT, STOPS, "[budgets]\nheat = 1"], "unknown objective 'heat'"),
        ([PLANT, STOPS, "[[constraints]]\nexpression = 'q'\nmax = 1"], "'q'"),
        ([PLANT, STOPS, "[[constraints]]\nmax = 1"], "expression = None: give a text"),
        ([PLANT, STOPS, "[[constraints]]\navoid = { x = 1 }"], "centre, half width"),
        (
            [PLANT + "mas = 3", STOPS],
            r"key of plant \(AntagonisticSlide\) 'mas': did you mean 'mass'",
        ),
        ([PLANT + 'mass = "3 m"', STOPS], "plant.mass = '3 m'"),
        ([PLANT + "mass = -3", STOPS], "mass = -3 kg must be > 0"),
        ([PLANT + "set = { lag = 3 }", STOPS], "unknown variable"),
        ([PLANT.replace("Regulator", "Regulatr"), STOPS], "did you mean 'Regulator'"),
        ([PLANT.replace("kind = ", "sort = "), STOPS], "plant.feed.kind is missing"),
        ([PLANT.replace("lag = ", "log = "), STOPS], r"plant.feed \(Regulator\) 'log'"),
        ([PLANT.replace("DMSP-20-200N", "DMSP-20"), STOPS], "unknown muscle 'DMSP-20'"),
        ([PLANT.replace("AntagonisticSlide", "Slide"), STOPS], "unknown plant.arrangement 'Slide'"),
        (["[plant]", STOPS], "plant.arrangement is missing; give one of AntagonisticJoint"),
        (["= 3"], "cannot be read as a TOML file"),
    ],
)
def test_what_is_wrong_in_a_file_is_said(tmp_path, parts, message):
    file = written(tmp_path, *parts)
    with pytest.raises(InputError, match=message) as caught:
        load_problem(file)
    assert str(file) in str(caught.value)


def test_plants_of_all_arrangements_and_components(tmp_path):
    for name in PLANTS:
        assert plant_of({"arrangement": name, "muscle": "DMSP-20-200N"}).states
    joint = plant_of(
        {
            "arrangement": "antagonistic_joint",
            "muscle": "DMSP-20-200N",
            "moment_arm": "30 mm",
            "limits": ["-20 deg", "20 deg"],
            "damping": {"kind": "ConstantDamping", "value": "0.2 N.m.s/rad"},
            "losses": [{"kind": "CoulombFriction", "constant": "10 N"}, {"kind": "Creep"}],
            "loads": [{"kind": "Spring", "stiffness": "5 N.m/rad"}, {"kind": "ExternalForce"}],
            "feed": {
                "kind": "SpoolValve",
                "supply": "7 bar",
                "tube": {"volume": "5e-3 l", "lag": "4 ms"},
                "gas": {
                    "dead_volume": "15e-6 m3",
                    "volume": {"kind": "BraidVolume", "angle": "25 deg"},
                },
            },
            "set": {"inertia": "0.06 kg.m2", "muscle1.pressure": "1.5 bar"},
        }
    )
    assert joint.variable("theta").max == pytest.approx(math.radians(20))
    for name, value in (
        ("inertia", 0.06),
        ("spring.stiffness", 5.0),
        ("muscle1.friction_constant", 10.0),
        ("damping", 0.2),
        ("muscle1.gas.supply", 7e5),
        ("muscle1.gas.tube_volume", 5e-6),
        ("muscle1.pressure", 1.5e5),
    ):
        found = [v for v in joint.variables if v.name.startswith(name)]
        assert found[0].start == pytest.approx(value), name


def test_a_muscle_file_and_a_users_plant(tmp_path):
    pam.save_muscle(pam.muscle("DMSP-20-200N"), tmp_path / "mine.json")
    (tmp_path / "mine.py").write_text(
        "import pam_ocp\ndef load(muscle):\n    return pam_ocp.HangingLoad(muscle, mass=7.0)\n"
    )
    content = (
        '[plant]\narrangement = "mine.py:load"\nmuscle = "mine.json"\nset = { mass = "8 kg" }\n'
    )
    with pytest.raises(InputError, match=r"would run the Python file .*mine.py.*--allow-code"):
        load_problem(written(tmp_path, content, STOPS))
    plant, _ = load_problem(written(tmp_path, content, STOPS), allow_code=True)
    assert plant.variable("mass").start == 8.0
    with pytest.raises(InputError, match=r"unknown name in .*mine.py 'lod'"):
        load_problem(written(tmp_path, content.replace(":load", ":lod"), STOPS), allow_code=True)
    with pytest.raises(InputError, match="no such Python file"):
        load_problem(
            written(tmp_path, content.replace("mine.py", "none.py"), STOPS), allow_code=True
        )
    assert muscle_of({"name": "DMSP-20-200N", "rest_length": "250 mm"}).rest_length == 0.25


def test_expressions_in_text_are_those_of_numpy(slide):
    text = "-sqrt(muscle1.pressure/1e5)*(x - 2*max(v, 0.5))**2 + der(x)/cos(time) + min(1, exp(x))"
    rng = np.random.default_rng(1)
    x, u = rng.uniform(0.1, 1.0, 4) * [0.01, 1, 1e5, 1e5], rng.uniform(1e5, 2e5, 2)
    found = function(slide, expression_of(slide, text))(x, u, slide.vector("parameter"), 0.3)
    wanted = -np.sqrt(x[2] / 1e5) * (x[0] - 2 * max(x[1], 0.5)) ** 2 + x[1] / np.cos(0.3) + 1
    assert float(found) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x +", "is no expression"),
        ("__import__('os')", "unknown function"),
        ("x if v else 1", "is not understood"),
        ("x[0]", "is not understood"),
        ("sqrt(x, v)", "sqrt takes 1 arguments"),
        ("'x'", "is not understood"),
        ("x.real", "unknown variable"),
        ("der(mass)", "is no state"),
    ],
)
def test_expressions_that_are_none_are_refused(slide, text, message):
    refused(message, expression_of, slide, text)


# ---- the command ---------------------------------------------------------------------------------
def test_the_command_plans_and_writes(capsys, tmp_path):
    head = 'cyclic = "mirrored"\nmethod = { intervals = 10 }'
    file = written(tmp_path, head, PLANT, STOPS)
    targets = {"--out": "plan.npz", "--csv": "motion.csv", "--fmu-inputs": "inputs.csv"}
    targets["--plot"] = "plan.png"
    options = [part for o, name in targets.items() for part in (o, tmp_path / name)]
    code, out, err = run(capsys, "plan", file, *options, "--log")
    assert (code, err) == (0, "")
    assert "replay     error" in out
    assert out.count("->") == len(targets)
    plant, _ = load_problem(file)
    plan = pam.load_plan(tmp_path / "plan.npz", plant)
    log = [line.split() for line in out.splitlines() if line.strip()[:1].isdigit()]
    assert float(log[-1][1]) == pytest.approx(plan.duration, rel=1e-4)
    motion = pam.Trajectory.load(tmp_path / "motion.csv")
    assert motion["x"][[0, -1]] == pytest.approx([-0.015, 0.015], abs=1e-9)
    assert (tmp_path / "plan.png").stat().st_size > 20_000
    table = np.genfromtxt(tmp_path / "inputs.csv", delimiter=",", names=True)
    assert table["time"][-1] == pytest.approx(plan.duration)


@pytest.mark.slow
def test_an_impossible_motion_has_exit_code_1_and_names_the_conflict(capsys, tmp_path):
    file = written(tmp_path, 'duration = "30 ms"\nmethod = { intervals = 10 }', PLANT, STOPS)
    code, out, err = run(capsys, "plan", file, "--log", "--explain")
    assert code == 1
    assert "other guesses" in out
    assert "The most violated constraint is stop" in err
    assert "violation" in out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--out", "plan.mat"), "give a name that ends in .npz"),
        (("--plot", "no/where.png"), "folder no does not exist"),
        ((), "is outside the stroke"),
    ],
)
def test_bad_input_has_exit_code_2(capsys, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    file = written(tmp_path, PLANT, STOPS.replace("0.015", "0.15"))
    code, _, err = run(capsys, "plan", file, *options)
    assert code == 2
    assert message in err


@pytest.mark.slow
def test_the_example_runs(capsys, tmp_path):
    code, out, _ = run(capsys, "plan", EXAMPLE, "--animate", tmp_path / "slide.gif")
    assert code == 0
    assert "0.05 +" in out
    assert (tmp_path / "slide.gif").stat().st_size > 100_000


def test_a_plan_that_is_not_verified_has_exit_code_3_and_is_written_all_the_same(capsys, tmp_path):
    problem = """
    tolerance = 1e-13
    method = { intervals = 4, degree = 2 }
    options = { max_iter = 60 }
    """
    file = written(tmp_path, problem, PLANT, STOPS)
    code, out, err = run(capsys, "plan", file, "--out", tmp_path / "plan.npz")
    assert code == 3
    assert out.startswith("NOT VERIFIED: ")
    assert "is not verified: " in err
    assert "PlanWarning" not in err
    assert (tmp_path / "plan.npz").exists()


def test_the_file_of_a_plan_is_one_of_its_motion_too(tmp_path):
    plant = pam.AntagonisticSlide("DMSP-20-200N")
    plan = pam.plan(plant, [{"x": -0.002}, {"x": 0.002}])
    path = plan.save(tmp_path / "plan.npz")
    motion = pam.Trajectory.load(path)
    assert motion.names == plan.trajectory.names
    assert motion["x"].tolist() == plan.trajectory["x"].tolist()
    assert motion.variable("x").unit == "m"
    again = pam.simulate(plant, motion, t=[0.0, plan.duration])
    assert again["x"][-1] == pytest.approx(0.002, abs=1e-5)
    assert pam.load_plan(path, plant).verified

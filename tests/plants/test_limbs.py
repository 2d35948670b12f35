"""Limbs of URDF and MJCF files against equations by hand, the package's own joints, and MuJoCo."""

import pickle
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from conftest import rates_and_outputs, refused
from design_tools import example

import pam_ocp as pam
from pam_ocp.fitting.learned.residual import Visited, attached
from pam_ocp.plants import LimbMuscle
from pam_ocp.plants.skeleton import read_skeleton

ARM = Path(pam.__file__).parent / "data" / "arm.urdf"
G = 9.80665
MUSCLE = "DMSP-20-400N"
SLACK = [LimbMuscle("idle", MUSCLE, [("a", 0.01)], pre_contraction=0.3)]  # pulls nothing at 0 bar


def joint(name, parent, child, xyz="0 0 0", axis="0 -1 0", kind="revolute", rest=""):
    limit = '<limit lower="-1" upper="1" effort="0" velocity="0"/>' if kind != "continuous" else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="0 0 0"/><axis xyz="{axis}"/>{limit}{rest}</joint>'
    )


def link(name, mass=0.0, com="0 0 0", ixx=0.0, iyy=0.0, izz=0.0, rpy="0 0 0"):
    if not mass:
        return f'<link name="{name}"/>'
    return (
        f'<link name="{name}"><inertial><origin xyz="{com}" rpy="{rpy}"/><mass value="{mass}"/>'
        f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    )


@pytest.fixture
def limb(tmp_path):
    """(elements of a URDF, muscles) -> the limb."""

    def made(*elements, muscles=SLACK, **options):
        path = tmp_path / "limb.urdf"
        path.write_text(f'<robot name="limb">{"".join(elements)}</robot>')
        return pam.plants.limb(path, muscles, **options)

    return made


def rates(plant, values):
    return rates_and_outputs(plant, values)[0]


BAR = link("bar", 1.5, "0 0 -0.2", 0.02, 0.02, 0.001)


def test_a_limb_of_one_joint_is_a_pendulum(limb):
    plant = limb(link("base"), BAR, joint("a", "base", "bar"), damping={"a": 0.3})
    for angle, speed in ((0.4, -1.2), (-0.9, 0.5)):
        inertia = 0.02 + 1.5 * 0.2**2
        expected = (-1.5 * G * 0.2 * np.sin(angle) - 0.3 * speed) / inertia
        found = rates(plant, {"a": angle, "a.velocity": speed})
        assert found["a.velocity"] == pytest.approx(expected, rel=1e-12)
        assert found["a"] == speed


def test_two_muscles_on_pulleys_are_an_antagonistic_joint(limb):
    muscle = pam.Muscle(**{**vars(pam.muscle("DMSP-20-300")), "end_mass": 0.2})
    losses = (pam.losses.BoucWen(20.0, 0.005), pam.losses.Creep())
    pair = [
        LimbMuscle(n, muscle, [("a", r)], pre_contraction=0.125, losses=losses)
        for n, r in (("muscle1", 0.04), ("muscle2", -0.03))
    ]
    extra = joint("a", "base", "bar", rest='<dynamics damping="0.3"/>')
    wall = {"a": pam.loads.Wall(0.1)}
    plant = limb(link("base"), BAR, extra, muscles=pair, loads=wall)
    of_link = {"moment_arm2": 0.03, "link_mass": 1.5, "link_length": 0.2}
    outer = {"losses": losses, "loads": pam.loads.Wall(0.1)}
    own = pam.AntagonisticJoint(muscle, 0.02 + 1.5 * 0.04, **of_link, **outer)
    for theta, omega, p1, p2 in ((0.2, 1.0, 3e5, 2e5), (-0.3, -2.0, 1e5, 4e5)):
        common = {"muscle1.pressure": p1, "muscle2.pressure": p2, "muscle1.hysteresis": 0.4}
        expected = rates(own, {"theta": theta, "omega": omega, **common})
        found = rates(plant, {"a": theta, "a.velocity": omega, **common})
        for mine, theirs in (("a", "theta"), ("a.velocity", "omega")):
            assert found[mine] == pytest.approx(expected[theirs], rel=1e-9)
        for name in ("muscle1.pressure", "muscle1.hysteresis", "muscle2.hysteresis"):
            assert found[name] == pytest.approx(expected[name], rel=1e-9)
        shown = rates_and_outputs(plant, {"a": theta, "a.velocity": omega, **common})[1]
        along = [r**2 * shown[f"muscle{i}.stiffness"] for i, r in ((1, 0.04), (2, 0.03))]
        assert shown["a.stiffness"] == pytest.approx(sum(along), rel=1e-9)  # creep is a loss


ROD = [
    link("base"),
    link("upper", 1.0, "0 0 -0.15", 1.0 * 0.3**2 / 12, 1.0 * 0.3**2 / 12, 1e-4),
    link("lower", 0.8, "0 0 -0.15", 0.8 * 0.3**2 / 12, 0.8 * 0.3**2 / 12, 1e-4),
]


def test_the_planar_arm_is_a_limb(limb):
    muscle = pam.muscle(MUSCLE)
    own = example("planar_arm").planar_arm(muscle)
    muscles = [
        LimbMuscle(f"{side}{i}", muscle, [(f"q{i}", sign * 0.035)], pre_contraction=0.12)
        for i in (1, 2)
        for side, sign in (("flexor", 1), ("extensor", -1))
    ]
    shoulder, elbow = joint("q1", "base", "upper"), joint("q2", "upper", "lower", "0 0 -0.3")
    friction = {"q1": 0.4, "q2": 0.4}
    plant = limb(*ROD, shoulder, elbow, muscles=muscles, damping=friction)
    rng = np.random.default_rng(5)
    for _ in range(5):
        q1, q2, w1, w2 = rng.uniform(-0.8, 0.8, 4)
        pressures = {f"{m.name}.pressure": rng.uniform(1e5, 4e5) for m in muscles}
        expected = rates(own, {"q1": q1, "q2": q2, "w1": w1, "w2": w2, **pressures})
        turning = {"q1.velocity": w1, "q2.velocity": w2}
        found = rates(plant, {"q1": q1, "q2": q2, **turning, **pressures})
        for i in "12":
            assert found[f"q{i}.velocity"] == pytest.approx(expected[f"w{i}"], rel=1e-9)


def test_a_passive_residual_takes_energy_from_joints_that_push_each_other(limb):
    """By the mass matrix of two rods; an acceleration of one joint alone may give energy."""
    shoulder, elbow = joint("a", "base", "upper"), joint("b", "upper", "lower", "0 0 -0.3")
    plant, random = limb(*ROD, shoulder, elbow), np.random.default_rng(8)
    one = pam.fitting.Residual("a.velocity", ["b", "b.velocity"], passive=True)
    visited = Visited(random.standard_normal((50, len(plant.states))), np.zeros((50, 1)))
    made = attached(plant, [one], visited, random)
    pushed = made.at(random.standard_normal(len(made.centre)))
    rod = [(m * 0.3**2 / 12, m * 0.15**2, m * 0.3 * 0.15, m * 0.3**2) for m in (1.0, 0.8)]
    (own, far, _, _), (own2, far2, both, end) = rod
    for _ in range(50):
        q, w = random.uniform(-0.8, 0.8, 2), random.standard_normal(2)
        at = {"a": q[0], "b": q[1], "a.velocity": w[0], "b.velocity": w[1]}
        gained = [rates(p, at)[f"{j}.velocity"] for p in (pushed, plant) for j in "ab"]
        coupled = own2 + far2 + both * np.cos(q[1])
        first = own + far + own2 + far2 + end + 2 * both * np.cos(q[1])
        mass = np.array([[first, coupled], [coupled, own2 + far2]])
        force = mass @ np.subtract(gained[:2], gained[2:])
        assert force[1] == pytest.approx(0.0, abs=1e-9 * abs(force[0]))
        assert force[0] * w[0] <= 0.0


def test_a_limb_without_damping_keeps_its_energy(limb):
    shoulder, elbow = joint("a", "base", "upper"), joint("b", "upper", "lower", "0 0 -0.3")
    plant = limb(*ROD, shoulder, elbow)
    run = pam.simulate(plant, t=np.linspace(0, 2, 201), start={"a": 0.5, "b": 0.4})
    a, b, va, vb = (run[n] for n in ("a", "b", "a.velocity", "b.velocity"))
    own = 0.3**2 / 12
    knee = 0.3 * np.array([np.sin(a), -np.cos(a)])
    second = knee + 0.15 * np.array([np.sin(a + b), -np.cos(a + b)])
    speed = 0.3 * va * np.array([np.cos(a), np.sin(a)])
    speed += 0.15 * (va + vb) * np.array([np.cos(a + b), np.sin(a + b)])
    moving = 0.5 * (own + 0.15**2) * va**2
    moving += 0.4 * ((speed**2).sum(axis=0) + own * (va + vb) ** 2)
    energy = moving + G * (0.5 * knee[1] + 0.8 * second[1])
    assert np.ptp(moving) > 0.5
    assert np.ptp(energy) < 1e-5


# ---- against MuJoCo ------------------------------------------------------------------------------
def reference_arm():
    """The arm of examples/limb.py."""
    return example("limb").seven_joint_arm()


def test_a_tree_with_prismatic_and_fixed_joints_moves_as_in_mujoco(tmp_path):
    """Axes askew, a branch, a fixed link, full inertias: torques for any motion."""
    mujoco = pytest.importorskip("mujoco")
    rng = np.random.default_rng(6)

    def bones(name):
        half = rng.normal(size=(3, 3))
        i = 0.01 * (half @ half.T)
        i = np.trace(i) * np.eye(3) - i  # of points of mass: a body has it
        pairs = {f"i{'xyz'[j]}{'xyz'[k]}": i[j, k] for j in range(3) for k in range(j, 3)}
        words = " ".join(f'{k}="{v:.17g}"' for k, v in pairs.items())
        place = "{:.17g} {:.17g} {:.17g}".format(*rng.normal(size=3) * 0.1)
        return (
            f'<link name="{name}"><inertial><origin xyz="{place}" rpy="0.3 -0.2 0.5"/>'
            f'<mass value="{rng.uniform(0.5, 2.0):.17g}"/><inertia {words}/></inertial></link>'
        )

    def any_joint(parent, child, kind):
        xyz, axis = (" ".join(f"{v:.17g}" for v in rng.normal(size=3)) for _ in range(2))
        made = joint(f"to_{child}", parent, child, xyz, axis, kind)
        return made.replace('rpy="0 0 0"', 'rpy="0.4 0.1 -0.7"')

    tree = [("base", "a", "revolute"), ("a", "b", "prismatic"), ("b", "c", "fixed")]
    tree += [("c", "d", "revolute"), ("a", "e", "revolute"), ("d", "f", "prismatic")]
    elements = [link("base"), *map(bones, "abcdef"), *(any_joint(*j) for j in tree)]
    path = tmp_path / "tree.urdf"
    path.write_text(f'<robot name="tree">{"".join(elements)}</robot>')
    body, model = read_skeleton(path), mujoco.MjModel.from_xml_path(str(path))
    model.opt.gravity, data = (0, 0, -G), mujoco.MjData(model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    order = [body.index(model.joint(i).name) for i in range(model.njnt)]
    q, w, a = (ca.SX.sym(n, 5) for n in "qwa")
    torques = body.mass_matrix(q) @ a + body.bias(q, w, ca.SX(G))
    required = ca.Function("required", [q, w, a], [torques])
    for _ in range(5):
        drawn = rng.normal(size=(3, 5))
        data.qpos, data.qvel, data.qacc = drawn[:, order]
        mujoco.mj_inverse(model, data)
        found = np.array(required(*drawn)).ravel()[order]
        np.testing.assert_allclose(found, data.qfrc_inverse, atol=1e-9)


def test_mass_matrix_and_inverse_dynamics_are_those_of_mujoco():
    mujoco = pytest.importorskip("mujoco")
    model = mujoco.MjModel.from_xml_path(str(ARM))
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.gravity = (0, 0, -G)
    data, plant, rng = mujoco.MjData(model), reference_arm(), np.random.default_rng(2)
    assert [model.joint(i).name for i in range(model.njnt)] == [j.name for j in plant.joints]
    dampings = np.array(
        [plant.variable(f"{j.name}.damper.coefficient").start for j in plant.joints]
    )
    required = plant.anatomy("required")
    for _ in range(5):
        q, w, a = rng.uniform(-0.3, 0.3, 7), rng.normal(size=7), rng.normal(size=7)
        data.qpos, data.qvel, data.qacc = q, w, a
        mujoco.mj_inverse(model, data)
        x = plant.vector("state")
        x[:14] = [*q, *w]
        found = required(x, plant.vector("input"), plant.vector("parameter"), a, np.zeros(14))
        expected = data.qfrc_inverse + np.where(model.dof_damping.ravel()[:7] == 0, dampings * w, 0)
        np.testing.assert_allclose(np.array(found).ravel(), expected, atol=1e-9)


def test_a_limb_of_mjcf_is_that_of_urdf(limb, tmp_path):
    pytest.importorskip("mujoco")
    elements = [
        link("base"),
        link("arm", 1.2, "0.05 0.02 -0.1", 0.012, 0.01, 0.005, rpy="0.3 -0.2 0.5"),
        link("hand", 0.4, "0.1 0 0", 0.002, 0.003, 0.002),
        joint("a", "base", "arm", "0 0.1 1", "0 -1 0", rest='<dynamics damping="0.2"/>'),
        joint("s", "arm", "hand", "0.1 0 -0.3", "1 0 1", kind="prismatic"),
    ]
    path = [("base", (0.0, 0.1, 1.1)), ("hand", (0.02, 0.0, 0.05))]
    muscles = [LimbMuscle("m", MUSCLE, path, pre_contraction=0.1)]
    expected = limb(*elements, muscles=muscles)
    import mujoco

    text = (tmp_path / "limb.urdf").read_text()
    mass_of_base = '<mujoco><compiler fusestatic="false"/></mujoco>'
    spec = mujoco.MjSpec.from_string(text.replace("</robot>", mass_of_base + "</robot>"))
    spec.option.gravity = (0, 0, -G)
    spec.compile()
    file = tmp_path / "limb.xml"
    file.write_text(spec.to_xml())
    found = pam.plants.limb(file, muscles)
    for values in ({"a": 0.3, "s": -0.02}, {"a": -0.6, "a.velocity": 2.0, "s.velocity": 0.3}):
        one, two = rates(expected, values), rates(found, values)
        assert two == pytest.approx(one, rel=1e-6)  # MJCF rounds its numbers
    assert found.variable("a").max == pytest.approx(1.0)


def wrapped(limb, radius):
    path = [("base", (0.06, 0.01, 0.15)), ("a", radius), ("bar", (0.05, -0.02, -0.18))]
    muscles = [LimbMuscle("m", MUSCLE, path, pre_contraction=0.1)]
    return limb(link("base"), BAR, joint("a", "base", "bar"), muscles=muscles)


@pytest.mark.parametrize("radius", [0.03, -0.03])
def test_a_cord_round_a_cylinder_has_mujocos_length(limb, radius):
    mujoco = pytest.importorskip("mujoco")
    side = 0.1 if radius < 0 else -0.1  # a cord that pulls towards -q passes on this side
    plant = wrapped(limb, radius)
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><site name="a" pos="0.06 0.01 0.15"/>
        <site name="s" pos="{-side} 0 0"/>
        <geom name="c" type="cylinder" size="0.03 0.1" zaxis="0 1 0" contype="0" conaffinity="0"/>
        <body><joint name="a" axis="0 -1 0"/><geom type="sphere" size="0.01" pos="0 0 -0.2"/>
        <site name="b" pos="0.05 -0.02 -0.18"/></body></worldbody><tendon><spatial name="t">
        <site site="a"/><geom geom="c" sidesite="s"/><site site="b"/></spatial></tendon></mujoco>"""
    )
    data, lengths = mujoco.MjData(model), plant.anatomy("lengths", "arms")
    straight = 0
    for angle in np.linspace(-0.9, 0.9, 13):
        data.qpos[0] = angle
        mujoco.mj_forward(model, data)
        x = plant.vector("state", {"a": angle})
        u, p = plant.vector("input"), plant.vector("parameter")
        length, arm = lengths(x, u, p, np.zeros(1), np.zeros(1))
        assert float(length) == pytest.approx(float(data.ten_length[0]), abs=1e-9)
        x[0] += 1e-6
        beyond = float(lengths(x, u, p, np.zeros(1), np.zeros(1))[0])
        x[0] -= 2e-6
        slope = (beyond - float(lengths(x, u, p, np.zeros(1), np.zeros(1))[0])) / 2e-6
        assert float(arm) == pytest.approx(-slope, abs=1e-8)
        straight += abs(float(arm)) > 0.0301
    assert straight < 13


def test_moment_arms_are_the_slope_of_the_paths_lengths():
    plant = reference_arm()
    rng = np.random.default_rng(1)
    q = dict(zip((j.name for j in plant.joints), rng.uniform(0.1, 0.3, 7), strict=True))
    arms, step = plant.moment_arms(q), 1e-6
    lengths = plant.anatomy("lengths")
    rest = plant.vector("input"), plant.vector("parameter"), np.zeros(7), np.zeros(14)

    def length(values):
        return np.array(lengths(plant.vector("state", values), *rest)).ravel()

    for i, name in enumerate(q):
        slope = length({**q, name: q[name] + step}) - length({**q, name: q[name] - step})
        np.testing.assert_allclose(arms[:, i], -slope / (2 * step), atol=1e-8)
    assert np.all(np.abs(arms).sum(axis=1) > 5e-3)


# ---- what is refused -----------------------------------------------------------------------------
OK = [link("base"), BAR]
HINGE = joint("a", "base", "bar")


@pytest.mark.parametrize(
    ("elements", "said"),
    [
        ([*OK, HINGE.replace("revolute", "floating")], "joint 'a' is of type 'floating'"),
        ([*OK, joint("a", "base", "bar", rest='<mimic joint="b"/>')], "joint 'a' is a mimic joint"),
        ([link("base"), link("bar"), HINGE], "joint 'a' moves no mass"),
        ([*OK, joint("a", "base", "foot")], "joint 'a' names link 'foot'"),
        ([*OK, link("other", 1.0, "0 0 0", 1, 1, 1), HINGE], "2 links without a parent"),
        ([*OK, HINGE, joint("b", "base", "bar")], "joint 'b' closes a loop"),
        ([*OK, joint("a", "base", "bar", axis="0 0 0")], "joint 'a' has the axis"),
        ([link("base"), link("bar", 1.0, "0 0 0", 1.0, 0.1, 0.1), HINGE], "link 'bar' has the"),
        ([link("base"), link("bar", -1.0, "0 0 0", 1.0, 1.0, 1.0), HINGE], "mass -1 kg"),
        ([*OK, HINGE.replace('lower="-1"', 'lower="2"')], "the lower must be the smaller"),
        ([*OK, HINGE.replace('"0 -1 0"', '"0 -1 x"')], "must hold 3 number"),
    ],
)
def test_what_is_no_limb_is_refused_by_name(limb, elements, said):
    refused(said, limb, *elements)


def pulling(path, **options):
    return LimbMuscle("m", MUSCLE, path, **(options or {"offset": 0.0}))


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ([("base", (0, 0, 0)), ("bra", (0, 0, 0.1))], "unknown link of limb 'limb' 'bra'"),
        ([("knee", 0.03)], "unknown joint of limb 'limb' 'knee'"),
        ([("bar", (0, 0, 0)), ("bar", (0, 0, 0.1))], "muscle 'm' crosses no joint"),
        ([("base", (0, 0, 0.2)), ("a", 0.03), ("base", (0, 0, 0.1))], "via points"),
        ([("base", (0, 0, 0.01)), ("a", 0.03), ("bar", (0, 0, -0.1))], "within the radius"),
    ],
)
def test_a_path_that_leads_nowhere_is_refused(limb, path, said):
    refused(said, limb, *OK, HINGE, muscles=pulling(path))


def test_arguments_are_refused(limb, tmp_path):
    with pytest.raises(pam.InputError, match="give one of offset and pre_contraction"):
        pulling([("a", 0.03)], offset=0.1, pre_contraction=0.1)
    refused("has no radius", pulling, [("a", 0.0)])
    refused("two points", pulling, [("base", (0, 0, 0))])
    refused("its path holds", pulling, [("base", (0, 0))])
    refused(r"nowhere.urdf' does not exist", pam.plants.limb, tmp_path / "nowhere.urdf", SLACK)
    refused("each with a name of its own", limb, *OK, HINGE, muscles=[*SLACK, *SLACK])
    refused("unknown joint of limb 'limb' 'b'", limb, *OK, HINGE, damping={"b": 1.0})
    (tmp_path / "words.urdf").write_text("words")
    refused("is no XML", pam.plants.limb, tmp_path / "words.urdf", SLACK)


def test_a_free_body_of_mjcf_is_refused(tmp_path):
    pytest.importorskip("mujoco")
    file = tmp_path / "free.xml"
    file.write_text(
        '<mujoco><worldbody><body><freejoint name="loose"/><geom size="1"/></body>'
        "</worldbody></mujoco>"
    )
    refused("joint 'loose' is free", pam.plants.limb, file, SLACK)


# ---- as all plants -------------------------------------------------------------------------------
def test_a_limb_travels_and_keeps_its_anatomy(limb):
    plant = wrapped(limb, 0.03).with_values({"gravity": 1.62})
    copy = pickle.loads(pickle.dumps(plant))
    values = {"a": 0.4, "a.velocity": 1.0}
    assert rates(copy, values) == rates(plant, values)
    np.testing.assert_array_equal(copy.moment_arms({"a": 0.4}), plant.moment_arms({"a": 0.4}))


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"damping": {"elbow": -1.0}}, "damping of elbow = -1 must be >= 0"),
        ({"friction": {"elbow": -1.0}}, "friction of elbow = -1 must be >= 0"),
        ({"stops": "yes"}, "stops = 'yes': give True or False"),
    ],
)
def test_values_that_no_joint_has_are_refused_by_their_argument(given, said):
    flexor = pam.plants.LimbMuscle("f", "DMSP-20-300", [("elbow", 0.03)], pre_contraction=0.1)
    refused(said, pam.plants.limb, "arm.urdf", flexor, **given)


def test_a_step_of_mujoco_is_positive():
    flexor = pam.plants.LimbMuscle("f", "DMSP-20-300", [("elbow", 0.03)], pre_contraction=0.1)
    with pytest.raises(pam.InputError, match="timestep = -1 s must be > 0"):
        pam.export.mujoco_limb(pam.plants.limb("arm.urdf", flexor), timestep=-1.0)


def pair_of(limb):
    muscles = [
        LimbMuscle(n, "DMSP-20-300", [("a", r)], pre_contraction=0.1)
        for n, r in (("flexor", 0.04), ("extensor", -0.04))
    ]
    return limb(link("base"), BAR, joint("a", "base", "bar"), muscles=muscles, damping={"a": 0.3})


def test_a_limb_is_drawn_and_filmed(limb, tmp_path):
    plant = pair_of(limb)
    figure = plant.plot({"a": 0.4, "flexor.pressure": 3e5}, colour="pressure")
    (axes, bar) = figure.axes
    assert bar.get_ylabel() == "pressure [bar]"
    ends = [np.array(line.get_data_3d()) for line in axes.lines]
    tip = 0.2 * np.array([np.sin(0.4), 0.0, -np.cos(0.4)])
    np.testing.assert_allclose(ends[0], np.column_stack([np.zeros(3), tip]), atol=1e-12)
    assert len(ends) == 3
    run = pam.simulate(plant, {"flexor.command": 3e5}, t=np.linspace(0, 0.2, 11))
    assert plant.animate(run, tmp_path / "a.gif", seconds=0.2, fps=5).stat().st_size > 1000
    refused("unknown colour", plant.plot, colour="red")


# ---- the arm of seven joints and fourteen muscles ------------------------------------------------
COMMANDS = {"biceps.command": 3e5, "deltoid_front.command": 4e5, "flexor.command": 2e5}
COMMANDS |= {"radial.command": 1.5e5, "abductor.command": 2e5, "pronator.command": 2e5}


def test_the_arm_moves_in_mujoco_as_here():
    mujoco = pytest.importorskip("mujoco")
    plant = reference_arm()
    model, made = pam.export.mujoco_limb(plant)
    data, path = mujoco.MjData(model), []
    made.reset(model, data, COMMANDS)
    with made.installed(model):
        for _ in range(1000):
            path.append(data.qpos.copy())
            mujoco.mj_step(model, data)
    run = pam.simulate(plant, COMMANDS, t=np.linspace(0.0, 0.999, 1000))
    found = np.array([run[j.name] for j in plant.joints]).T
    assert np.all(np.ptp(found, axis=0) > 0.15)
    np.testing.assert_allclose(np.array(path), found, atol=1e-3)


@pytest.mark.parametrize("effort", ["1", "1000"])
def test_a_joint_s_effort_is_no_limit_in_mujoco_either(effort, limb):
    """Largest efforts bound plans: the muscle's torque of some 30 N m acts in full."""
    mujoco = pytest.importorskip("mujoco")
    hinge = joint("a", "base", "bar").replace('effort="0"', f'effort="{effort}"')
    pull = [LimbMuscle("flexor", MUSCLE, [("a", 0.03)], pre_contraction=0.05)]
    plant = limb(link("base"), BAR, hinge, muscles=pull)
    model, made = pam.export.mujoco_limb(plant)
    data = mujoco.MjData(model)
    made.reset(model, data, {"flexor.pressure": 4e5})
    with made.installed(model):
        mujoco.mj_forward(model, data)
    expected = rates(plant, {"flexor.pressure": 4e5})["a.velocity"]
    assert expected > 100
    assert data.qacc[0] == pytest.approx(expected, rel=1e-5)


def test_mujoco_takes_no_path_of_points_and_pulleys(limb):
    pytest.importorskip("mujoco")
    refused("of points or of pulleys", pam.export.mujoco_limb, wrapped(limb, 0.03))


@pytest.mark.slow
def test_the_arm_rests_where_static_optimisation_says_and_is_linear_there():
    plant = reference_arm()
    posture = {"elbow": 0.8, "shoulder_flexion": 0.4, "wrist_flexion": 0.1}
    found = plant.static_optimisation(posture)
    assert found.reached.all()
    at = {j.name: posture.get(j.name, 0.0) for j in plant.joints}
    pressures = {f"{n}.pressure": p[0] for n, p in found.pressures.items()}
    accelerations = rates(plant, {**at, **pressures})
    assert max(abs(accelerations[f"{n}.velocity"]) for n in at) < 1e-4
    given = ("deltoid_rear", "adductor", "outer_rotator", "triceps", "supinator")
    given += ("extensor", "ulnar")
    point = plant.equilibrium({**at, **{f"{n}.pressure": found.pressures[n][0] for n in given}})
    for name, pressure in found.pressures.items():
        assert point[f"{name}.pressure"] == pytest.approx(pressure[0], rel=1e-5)
    system = plant.linearize(point)
    states = [v.name for v in plant.states]
    at_rest = {n: float(point[n]) for n in states}
    u = {v.name: float(point[v.name]) for v in plant.inputs}
    commanded = plant.with_values(u)
    for column in (states.index("elbow"), states.index("biceps.pressure")):
        name, step = states[column], 1e-5 * plant.variable(states[column]).nominal
        ends = [rates(commanded, at_rest | {name: at_rest[name] + d}) for d in (step, -step)]
        slopes = [(ends[0][n] - ends[1][n]) / (2 * step) for n in states]
        np.testing.assert_allclose(system.A[:, column], slopes, rtol=1e-5, atol=1e-7)


@pytest.mark.slow
def test_the_arm_is_planned_and_verified():
    limb, way = example("limb"), pam.Collocation(intervals=16, degree=7)
    asked = {"stops": [limb.HANG, limb.REACH], "duration": 0.6, "minimise": "effort"}
    plan = pam.plan(limb.seven_joint_arm(), **asked, method=way)
    assert plan.verified
    for name, angle in limb.REACH.items():
        assert plan.trajectory[name][-1] == pytest.approx(angle, abs=1e-3)


@pytest.mark.slow
def test_a_limb_is_an_fmu(limb, tmp_path):
    """Two joints out of plane, muscles over a pulley, in a straight line, and round a cylinder."""
    import fmpy

    shoulder = joint("a", "base", "upper", axis="0 -1 0")
    elbow = joint("b", "upper", "lower", "0 0 -0.3", axis="1 -1 0")
    paths = {
        "deltoid": [("a", 0.05)],
        "biceps": [("upper", (0.05, 0.02, -0.1)), ("lower", (0.04, 0.01, -0.05))],
        "triceps": [("upper", (-0.04, 0, -0.05)), ("b", -0.02), ("lower", (-0.03, 0, -0.15))],
    }
    muscles = [LimbMuscle(n, MUSCLE, path, pre_contraction=0.1) for n, path in paths.items()]
    plant = limb(*ROD, shoulder, elbow, muscles=muscles, damping={"a": 0.4, "b": 0.4})
    commands = {"deltoid.command": 3e5, "biceps.command": 3e5, "triceps.command": 1e5}
    fmu = pam.export_fmu(plant, tmp_path / "limb.fmu", platforms=["native"])
    found = fmpy.simulate_fmu(
        str(fmu), stop_time=1.0, output_interval=0.01, start_values=commands, output=["a", "b"]
    )
    run = pam.simulate(plant, commands, t=np.linspace(0.0, 1.0, 101))
    for name in ("a", "b"):
        assert np.ptp(run[name]) > 0.1
        np.testing.assert_allclose(found[name], run[name], atol=1e-6)

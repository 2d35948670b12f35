"""robust_plan for a share of all plants: against theory, SciPy, and what cannot be met."""

import warnings

import numpy as np
import pytest
from conftest import refused, scipy_states
from scipy.stats import binomtest, norm
from test_plan_robust import METHOD, STOPS, WIDTH, draws, plant  # noqa: F401 - a fixture

import pam_ocp as pam
from pam_ocp import Collocation, PlanError, PlanWarning, Stop
from pam_ocp.planning.studies.robust import robust_plan
from pam_ocp.planning.studies.robust_result import Share


def pushed_mass():
    """x'' = u - f, the force f unknown and constant:
    it moves every motion of T seconds by f T^2/2.
    """
    mass = pam.Plant("mass")
    x, v = mass.state("x", unit="m"), mass.state("v", unit="m/s", nominal=3.0)
    u = mass.input("u", unit="N", min=-500.0, max=500.0, nominal=50.0)
    f = mass.parameter("force", 0.0, unit="N")
    mass.der(x, v)
    mass.der(v, u - f)
    return mass


def forces(count, seed):
    return [{"force": float(f)} for f in np.random.default_rng(seed).standard_normal(count)]


MASS = {"draws": forces, "start": "same", "method": Collocation(8, 3, "linear")}
FROM_TO = [{"x": 0.0}, {"x": 1.0}]


def in_a_second(spread, stops=FROM_TO, **asked):
    """A robust plan of the mass, of least effort unless something else is asked for."""
    asked = {"minimise": "effort", "duration": 1.0, **MASS, **asked}
    return robust_plan(pushed_mass(), stops, spread=spread, **asked)


def test_limits_are_looked_at_between_the_points_of_the_plan():
    """v = 6 t (1 - t) - f t is largest, 1.5 - f/2 + f^2/24, at t = (1 - f/6)/2: for f = -3 N that
    is 3.375 m/s, and 3.344 m/s at the nearest point.
    """
    asked = {"draws": [{"force": 0.1}], "share": None, "method": Collocation(2, 3, "linear")}
    asked |= {"rest": False, "stops": [{"x": 0.0, "v": 0.0}, {"x": 1.0, "v": 0.0}]}
    for most, kept in ((3.35, False), (3.38, True)):
        robust = in_a_second({"x": 5.0}, bounds={"v": (None, most)}, **asked)
        assert robust.judge(robust.verify([{"force": "-3 N"}])).kept.tolist() == [kept]


def test_a_dwell_varies_as_its_stop_does():
    """Plants are f T^2/2 off: 0.05 f m when the nominal one comes to rest, 0.072 f when it goes."""
    stops = [{"x": 0.0}, Stop({"x": 1.0}, dwell=0.2), {"x": 0.9}]
    asked = {"draws": [{"force": 0.1}], "share": None, "stops": stops, "duration": [1.0, 0.5]}
    robust = in_a_second([None, {"x": 0.08}, None], **asked)
    assert robust.verified
    assert np.abs(robust.members.at_stops("x")) == pytest.approx(np.array([[0.05, 0.072]]))
    found = robust.judge(robust.verify([{"force": 0.11}, {"force": 0.115}]))
    assert found.kept.tolist() == [True, False]


@pytest.mark.slow
def test_the_back_off_in_time_is_that_of_the_normal_distribution():
    """Effort wants time, the spread of 0.1 m allows T with |f| T^2/2 < 0.1 for 95 %: 0.32 s."""
    asked = {"minimise": {"effort": 1.0, "time": 1e-6}, "duration": (0.05, 2.0)}
    robust = in_a_second({"x": 0.1}, **asked)
    assert robust.verified
    true = 2 * norm.cdf(0.2 / robust.plan.duration**2) - 1
    low, high = robust.share.interval
    assert low < true < high
    assert 0.93 < true < 0.995  # as many as wanted, and not many more: the rest costs effort
    again = robust.judge(robust.verify(forces(2000, 777))).kept.mean()
    assert again == pytest.approx(true, abs=0.02)


@pytest.mark.slow
def test_the_back_off_from_a_limit_is_that_of_the_normal_distribution():
    """As far as it goes in 1 s with x < 3 for 95 %: short of it by 1.645/2."""
    spread, stops = [None, {"x": 50.0}], [{"x": 0.0}, {"x": (0.0, 5.0)}]
    far = {"minimise": {"final(x)": -1.0, "effort": 1e-6}, "bounds": {"x": (-10.0, 3.0)}}
    robust = in_a_second(spread, stops, share=0.9, **far)
    back_off = 3.0 - robust.trajectory["x"][-1]
    assert robust.verified
    assert 0.87 < norm.cdf(2 * back_off) < 0.98
    assert robust.share.interval[0] < norm.cdf(2 * back_off) < robust.share.interval[1]
    free = in_a_second(spread, stops, all_within=False, **far)
    assert free.trajectory["x"][-1] == pytest.approx(3.0, abs=1e-3)


def test_what_no_input_can_keep_says_where_and_how_far():
    """In one second 95 % come within 1.96/2 m, whatever the input: 0.1 m cannot be."""
    with pytest.raises(PlanError, match=r"deviation\d") as caught:
        in_a_second({"x": 0.1})
    words = str(caught.value)
    assert "stop 2: x, where 95 % come within" in words
    far = float(words.split("come within ")[1].split()[0]) / 1e3  # mm
    assert far == pytest.approx(norm.ppf(0.975) / 2, rel=0.15)


def test_the_best_that_was_found_is_returned_with_a_warning():
    """Wide enough for the first six plants, too narrow for 95 %: a second plan cannot be."""
    first = [max(abs(d["force"]) for d in forces(6, seed)) for seed in range(20)]
    seed = int(np.argmin(first))
    width = first[seed] / 2 * 1.001
    assert width < 0.7 * norm.ppf(0.975) / 2
    with pytest.warns(PlanWarning, match="not verified: of unseen ones"):
        robust = in_a_second({"x": width}, seed=seed)
    assert not robust.verified
    assert not robust.verdict
    assert robust.share.value == pytest.approx(2 * norm.cdf(2 * width) - 1, abs=0.08)
    assert robust.share.stretch == pytest.approx(norm.ppf(0.975) / 2 / width, rel=0.15)
    assert "stop 2: x" in robust.share.hindrance
    assert len(robust.members.draws) == 6
    assert str(robust).startswith("not verified")


def test_each_stop_has_its_own_spread_and_limits_count_too():
    """Positions f t^2/2 off at 1 s and 2 s, velocities f t: by hand for six forces."""
    known = [-0.9, -0.45, -0.1, 0.1, 0.45, 0.9]
    stops = [{"x": 0.0}, pam.Stop({"x": 1.0}, rest=False), {"x": 2.0}]
    asked = {"draws": [{"force": 0.05}], "share": None, "bounds": {"v": (-3.0, 3.0)}}
    spread = [None, {"x": 0.25}, {"x": 1.0, "v": 1.0}]
    robust = in_a_second(spread, stops, duration=[1.0, 1.0], **asked)
    spread = robust.verify([{"force": f} for f in known])
    assert spread.at_stops("x")[:, 1] == pytest.approx([-2 * f for f in known], abs=1e-9)
    kept = [abs(f) / 2 <= 0.25 and abs(2 * f) <= 1.0 for f in known]
    assert robust.judge(spread).kept.tolist() == kept == [False, True, True, True, True, False]
    assert robust._within(spread) == pytest.approx(4 / 6)
    quick = float(robust.trajectory["v"].max())
    assert quick < 3.0
    pulled = robust.judge(robust.verify([{"force": -2.0}]))
    assert "v" in pulled.labels
    where = robust.verify([{"force": -2.0}]).motions[0]["v"].max()
    assert pulled.excess[0, pulled.labels.index("v")] == pytest.approx((where - 3.0) / 3.0 - 1e-3)


def test_a_plant_that_cannot_be_simulated_keeps_nothing():
    robust = in_a_second({"x": 1.0}, draws=[{"force": 0.1}], share=None)
    spread = robust.verify([{"force": 0.1}, {"force": float("inf")}])
    assert robust.judge(spread).kept.tolist() == [True, False]


def test_the_share_and_its_interval_are_those_of_the_binomial_distribution():
    for kept, count in ((0, 100), (100, 100), (93, 100), (190, 200)):
        share = Share(kept, count, 0.95, 0.9, None)
        expected = binomtest(kept, count).proportion_ci(0.9, method="exact")
        assert share.interval == pytest.approx((expected.low, expected.high), abs=1e-12)
        assert share.enough == (kept / count >= 0.95)


@pytest.fixture(scope="module")
def found(plant):  # noqa: F811 - the fixture
    asked = {"duration": (0.02, 0.5), "method": METHOD, "fresh": 100, "begin": 4, "seed": 5}
    made = lambda n, s: draws(plant, n, s)  # noqa: E731
    return robust_plan(plant, STOPS, draws=made, spread={"x": WIDTH}, **asked)


@pytest.mark.slow
def test_a_sample_that_was_never_used_confirms_the_share(plant, found):  # noqa: F811
    assert found.verified
    assert found.share.value >= 0.95
    assert len(found.rounds) > 1  # four plants were not enough
    assert [r.planned_for for r in found.rounds] == sorted({r.planned_for for r in found.rounds})
    assert found.share.seed == 5 + len(found.rounds)
    sample = draws(plant, 100, found.share.seed)
    assert list(found.unseen.draws) == sample
    used = {d["muscle1.a1"] for d in found.members.draws}
    assert not used & {d["muscle1.a1"] for d in sample}
    assert found.price > 0


@pytest.mark.slow
def test_scipy_judges_other_plants_alike(plant):  # noqa: F811
    """Plants of a seed that the plan did not see, each integrated by SciPy."""
    arguments = {"spread": {"x": WIDTH}, "duration": (0.02, 0.5), "method": METHOD}
    found = robust_plan(plant, STOPS, draws=draws(plant, 8, 5), share=None, **arguments)
    others, motion = draws(plant, 20, 12345), found.trajectory
    spread = found.verify(others)
    judged = found.judge(spread)
    stops = [name.startswith("stop") for name in judged.labels]
    kept = judged.excess[:, stops].max(axis=1) <= 0
    assert not np.any(judged.kept & ~kept)
    for draw, run, keeps in zip(others, spread.motions, kept, strict=True):
        x0 = run.array(run.named("state"))[0]
        states = scipy_states(
            plant.with_values(draw), lambda t: motion.signals(t)[0], motion.t, x0, rtol=1e-9
        )
        off = np.abs(states[[0, -1], 0] - motion["x"][[0, -1]]).max()
        assert keeps == (off <= WIDTH), (off, WIDTH)
    assert 0.75 < kept.mean() < 1.0


@pytest.mark.slow
def test_a_list_of_unseen_plants_is_judged_too(plant):  # noqa: F811
    arguments = {"spread": {"x": WIDTH}, "duration": (0.02, 0.5), "method": METHOD}
    few, many = draws(plant, 3, 1), draws(plant, 40, 2)
    with pytest.warns(PlanWarning, match="of 40 plants"):
        robust = robust_plan(plant, STOPS, draws=few, unseen=many, **arguments)
    assert (robust.share.count, robust.share.seed) == (40, None)
    assert robust.share.value == robust.unseen.share_within({"x": WIDTH})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        alone = robust_plan(plant, STOPS, draws=few, share=None, **arguments)
    assert str(alone.verdict) == "verified for the 3 plants planned for, and said of no others"
    with pytest.warns(PlanWarning, match="none was tried"):
        robust_plan(plant, STOPS, draws=few, **arguments)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"share": 1.0}, "share = 1 must lie between 0 and 1"),
        ({"confidence": 0.0}, "confidence = 0 must lie"),
        ({"fresh": 50}, "fresh = 50"),
        ({"rounds": 0}, "rounds = 0"),
        ({"draws": lambda n, s: forces(n, 1)}, "the same plants for the seeds"),
        ({"draws": lambda n, s: forces(5, s)}, "gave 5 draws, not 6"),
        ({"draws": lambda n, s: [{"force": float("inf")}] * n}, "force"),
    ],
)
def test_samples_that_cannot_be_are_refused(arguments, message):
    refused(message, in_a_second, {"x": 5.0}, **arguments)

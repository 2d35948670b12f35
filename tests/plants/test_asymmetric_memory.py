"""Memory that is not symmetric or grows with pressure; friction and creep that depend on the load.

Expected values are closed forms, the sharp play operator written out below, or SciPy.
"""

import math
from itertools import pairwise

import numpy as np
import pytest
from conftest import refused
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq
from test_losses import LENGTH, PRESSURE, Drawn, loss_at

import pam_ocp as pam
from pam_ocp.core.errors import InputError

L = pam.losses
TOP = 6.75e5  # end of the muscle's range of pressure
PLAY = L.PrandtlIshlinskii((10.0, 8.0), (6.0, 5.0), (0.004, 0.02), 2.0, -0.5)
GROWING = 4e-6


class Bench:
    """A muscle drawn along, with the state of its loss: rates and force by name."""

    def __init__(self, loss, **parameters):
        self.plant = Drawn(loss)
        self.p = self.plant.vector("parameter", parameters)
        self.names = [v.name for v in self.plant.outputs]

    def at(self, kappa, rate, z, pressure=PRESSURE):
        """(rates of the memory, loss force [N])."""
        x = [(kappa - 0.08) * LENGTH, *np.atleast_1d(z)]
        u = [rate * LENGTH, pressure]
        xdot, y, _ = self.plant.function(x, u, self.p)
        force = float(y[self.names.index("muscle.loss")])
        return np.asarray(xdot).ravel()[1:], force

    def moved(self, z, kappa, rate, t, pressure=PRESSURE):
        """The memory z at times t of a way from a contraction on (a column for each time)."""

        def slope(s, z):
            return self.at(kappa + rate * s, rate, z, pressure)[0]

        how = {"method": "LSODA", "rtol": 1e-10, "atol": 1e-13, "t_eval": t}
        return solve_ivp(slope, (0, t[-1]), z, max_step=t[-1] / 40 if rate else np.inf, **how).y

    def rested(self, z, kappa, duration, pressure=PRESSURE):
        """The memory after some time at rest."""
        return self.moved(z, kappa, 0.0, [duration], pressure)[:, -1]

    def along(self, turns, rate=0.1, pressure=PRESSURE, z=None):
        """Force at the end of each straight stroke between contractions, and the last memory."""
        z = self.plant.vector("state")[1:] if z is None else np.asarray(z, float)
        forces = []
        for here, there in pairwise(turns):
            way = math.copysign(rate, there - here)
            z = self.moved(z, here, way, [abs(there - here) / rate], pressure)[:, -1]
            forces.append(self.at(there, way, z, pressure)[1])
        return np.array(forces), z


def sharp(turns, pieces=2000):
    """The generalised play operators of PLAY by their definition, in small steps."""
    held = [0.0, 0.0]
    ends = []
    for here, there in pairwise(turns):
        path = np.linspace(here, there, pieces)
        for low, high in pairwise(path):
            for i, (c, r, y) in enumerate(((10.0, 6.0, 0.004), (8.0, 5.0, 0.02))):
                w = held[i] + c / y * (high - low)
                held[i] = max(-r * (1 - 0.5 * high), min(c * (1 + 2 * high), w))
        ends.append(sum(held))
    return np.array(ends)


# ---- Prandtl-Ishlinskii, asymmetric --------------------------------------------------------------


def test_far_along_each_way_the_force_is_that_of_its_envelope():
    # widths that hardly round off: what is left is the lag in the edge, edge (growth yield)/3
    bench = Bench(PLAY, **{"muscle.play_edge": 1e-4, "muscle.play_rest_rate": 1e-9})
    forces, _ = bench.along([0.08, 0.2, 0.1], rate=1.0)
    assert forces[0] == pytest.approx((10.0 + 8.0) * (1 + 2 * 0.2), rel=2e-6)
    assert forces[1] == pytest.approx(-(6.0 + 5.0) * (1 - 0.5 * 0.1), rel=2e-6)


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize("edge", [0.02, 0.3])
def test_at_rest_each_element_gives_up_its_edge_and_no_more(way, edge):
    """Slid fully, it holds 1 - edge + edge/sqrt(1 + t/t0): s' = -s^3/(2 t0) of the passage 1 - s^3.

    t0 = edge F/(k rest rate), F what it can hold at this contraction and k its stiffness.
    """
    rest_rate, kappa = 1e-4, 0.1
    bench = Bench(PLAY, **{"muscle.play_edge": edge, "muscle.play_rest_rate": rest_rate})
    # the state is the force in parts of the largest, at the end of the range
    top = pam.muscle("DMSP-20-300").contraction_range[1]
    friction, yields = np.array([[10.0, 6.0], [8.0, 5.0]]), np.array([0.004, 0.02])
    holds = friction @ [1 + 2 * kappa, 0] if way > 0 else friction @ [0, 1 - 0.5 * kappa]
    largest = friction[:, 0] * (1 + 2 * top)
    t = np.array([1.0, 10.0, 100.0, 1e4])
    found = bench.moved(way * holds / largest, kappa, 0.0, t)
    t0 = edge * holds / (friction[:, 0] / yields * rest_rate)
    left = 1 - edge + edge / np.sqrt(1 + t[:, None] / t0)
    assert found.T * largest == pytest.approx(way * holds * left, rel=1e-7)
    assert np.all(left > 1 - edge)


def test_after_a_turn_the_sum_gives_up_more_than_each_element():
    """docs/losses.md: 9.6 + 12 N at 10 %, back by 1.5 %: -6 and 9.6 - 400 x 0.015 = 3.6 N."""
    bench = Bench(L.PrandtlIshlinskii())
    _, z = bench.along([0.08, 0.03, 0.1, 0.085])
    before = bench.at(0.085, 0.0, z)[1]
    assert before == pytest.approx(-6.0 + 3.6, rel=0.01)
    after = bench.at(0.085, 0.0, bench.rested(z, 0.085, 1e5))[1]
    assert after - before == pytest.approx(0.02 * 6.0, rel=0.02)
    assert 1 - after / before == pytest.approx(0.05, abs=0.002)


def test_the_smooth_model_goes_over_into_the_sharp_operator_as_its_edge_narrows():
    rng = np.random.default_rng(31)
    turns = [0.08, *rng.uniform(0.03, 0.22, 3)]
    operator = PLAY.elements()
    operator.reset(0.08)
    exact = operator.force(turns[1:])
    off = [
        np.max(np.abs(Bench(PLAY, **{"muscle.play_edge": edge}).along(turns)[0] - exact))
        for edge in (0.05, 0.005)
    ]
    assert off[1] < 0.2 * off[0] < 0.2
    assert off[1] < 0.01


def test_the_operator_is_the_generalised_play_by_its_definition():
    rng = np.random.default_rng(32)
    turns = [0.0, *rng.uniform(0.0, 0.25, 12)]
    assert PLAY.elements().force(turns[1:]) == pytest.approx(sharp(turns), abs=1e-9)


def test_its_inverse_is_exact_over_any_history():
    rng = np.random.default_rng(33)
    for _ in range(50):
        n = rng.integers(1, 6)
        given = rng.uniform(200, 8000, n), rng.uniform(1, 20, n), rng.uniform(1, 20, n)
        growth = rng.uniform(-1.5, 4, 2)
        slope = 1.2 * max(1.0, np.abs(growth).max() * (given[1].sum() + given[2].sum()))
        kappa = rng.uniform(0, 0.25, 30)
        total = slope * kappa + L.SlipElements(*given, *growth).force(kappa)
        back = L.SlipElements(*given, *growth).contraction(total, slope)
        assert np.max(np.abs(back - kappa)) < 1e-12


def test_equal_envelopes_follow_masings_rule_and_so_does_the_inverse():
    k, f, slope = np.array([3000.0, 800.0]), np.array([9.0, 12.0]), 500.0

    def virgin(kappa):  # initial loading: every spring until it slides
        return slope * kappa + np.minimum(k * kappa, f).sum()

    down = virgin(0.1) - 2 * virgin(0.015)  # from 0.1 down to 0.07: twice the curve at half
    elements = L.SlipElements(k, f, f)
    assert slope * 0.1 + elements.force(0.1) == pytest.approx(virgin(0.1), abs=1e-12)
    assert slope * 0.07 + elements.force(0.07) == pytest.approx(down, abs=1e-12)
    elements.reset()
    assert elements.contraction([virgin(0.1), down], slope) == pytest.approx([0.1, 0.07], abs=1e-14)


def test_what_has_no_inverse_or_no_meaning_is_refused():
    falling = L.SlipElements([1000.0], [10.0], [10.0], -1.5, -1.5)
    refused("slope = 5 N is too small", falling.contraction, 11.0, 5.0)
    with pytest.raises(InputError, match="beyond what contractions up to"):
        L.SlipElements([1000.0], [10.0], [10.0]).contraction(1e6, 50.0)
    refused("one of each per element", L.SlipElements, [1.0, 2.0], [1.0], [1.0])
    refused("relaxing_growth = -3 must be >= -2", L.PrandtlIshlinskii, relaxing_growth=-3.0)
    refused("one of each per element", L.PrandtlIshlinskii, (1.0, 2.0), (1.0,), (0.01, 0.02))
    refused(r"per_pressure = 0.5 1/Pa must lie in 0", L.MaxwellSlip, per_pressure=0.5)
    refused(r"softening = 1.5 must lie in 0", L.Preconditioning, softening=1.5)


# ---- growth with pressure, and dissipation -------------------------------------------------------

SCALED = {
    "bouc-wen": L.BoucWen(20.0, 0.005, 0.7, per_pressure=GROWING),
    "maxwell-slip": L.MaxwellSlip((12.0, 8.0), (0.004, 0.01), per_pressure=GROWING),
    "play": L.PrandtlIshlinskii(
        (12.0, 8.0), (12.0, 8.0), (0.004, 0.01), 0.0, 0.0, per_pressure=GROWING
    ),
}


@pytest.mark.parametrize("loss", SCALED.values(), ids=SCALED)
@pytest.mark.parametrize("pressure", [0.0, 2e5, TOP])
def test_full_slide_grows_with_pressure(loss, pressure):
    force, _ = Bench(loss).along([0.08, 0.16], pressure=pressure)
    assert force[0] == pytest.approx(20.0 * (1 + GROWING * pressure), rel=1e-3)


@pytest.mark.parametrize("loss", SCALED.values(), ids=SCALED)
def test_a_pressure_that_falls_lets_go_what_it_no_longer_holds(loss):
    bench = Bench(loss)
    _, z = bench.along([0.08, 0.16], pressure=6e5)
    assert bench.at(0.16, 0.0, z, 1e5)[1] == pytest.approx(20 * 1.4, rel=1e-3)
    raised = bench.at(0.16, 0.0, bench.rested(z, 0.16, 0.2, 1e5), 6e5)[1]
    assert raised == pytest.approx(20 * 1.4, rel=0.02)  # and does not come back with it


def stored(loss, z):
    """Elastic energy over the rest length [N] of the elements at their states z."""
    scale = 1 + loss.per_pressure * TOP
    if isinstance(loss, L.PrandtlIshlinskii):
        top = 0.26
        most = [max(1, 1 + g * top) for g in (loss.contracting_growth, loss.relaxing_growth)]
        rows = zip(loss.contracting, loss.relaxing, loss.yield_contraction, z, strict=True)
        return sum(
            (max(c * most[0], r * most[1]) * scale * s) ** 2 * y / (2 * c) for c, r, y, s in rows
        )
    stiff = np.atleast_1d(loss.friction) * np.atleast_1d(loss.yield_contraction)
    return float(np.sum(stiff * (scale * np.asarray(z)) ** 2 / 2))


RANDOM = {
    **SCALED,
    "asymmetric": PLAY,
    "asymmetric, growing": L.PrandtlIshlinskii(relaxing_growth=-1.5, per_pressure=GROWING),
}


@pytest.mark.parametrize("loss", RANDOM.values(), ids=RANDOM)
def test_it_dissipates_at_every_instant_of_any_motion_under_any_pressure(loss):
    bench, rng = Bench(loss), np.random.default_rng(8)
    count = len(bench.plant.states) - 1
    for _ in range(200):
        kappa, rate = rng.uniform(0, 0.25), rng.choice([-1, 1]) * 10 ** rng.uniform(-6, 1)
        z, pressure = rng.uniform(-1, 1, count), rng.uniform(0, TOP)
        zdot, force = bench.at(kappa, rate, z, pressure)
        h = 1e-7
        gained = sum(
            (stored(loss, z + h * e) - stored(loss, z - h * e)) / (2 * h) * r
            for e, r in zip(np.eye(count), zdot, strict=True)
        )
        assert force * rate - gained >= -1e-6 * (abs(force * rate) + abs(gained))


@pytest.mark.parametrize("memory", ["virgin", "above", "below"])
def test_rest_takes_the_envelope_of_the_side_from_which_the_load_came(memory):
    muscle = pam.muscle("DMSP-20-400N")
    plant = pam.HangingLoad(muscle, 20.0, losses=PLAY)
    point = plant.equilibrium({"muscle.command": 3e5}, memory=memory)

    def left(kappa):
        held = {"virgin": 0.0, "below": 18.0 * (1 + 2 * kappa), "above": -11.0 * (1 - 0.5 * kappa)}[
            memory
        ]
        return float(muscle.tension(3e5, kappa)) - held - 20 * 9.80665

    assert point["muscle.contraction"] == pytest.approx(brentq(left, 0.0, 0.27), rel=1e-9)


# ---- without memory ------------------------------------------------------------------------------


@pytest.mark.parametrize("pressure", [1e5, 5e5])
def test_strands_rub_in_proportion_to_pressure_and_less_when_contracted(pressure):
    mu, a, angle, d = 0.25, 4e-4, math.radians(25.0), 0.021
    loss = L.StrandFriction(mu, a, angle, d, excess=0.5, stribeck_speed=0.05)
    for v in (0.03, -0.03):
        kinetic = mu * 4 * math.pi * a * d / 2 * pressure * (1 - 0.08) / math.tan(angle)
        expected = math.copysign(kinetic * (1 + 0.5 * math.exp(-((0.03 / 0.05) ** 2))), v)
        assert loss_at(loss, v, pressure) == pytest.approx(expected, rel=1e-6)


def test_strand_friction_is_the_work_of_turning_strands():
    # per d(kappa): moment mu p A a times the turn 2 d(alpha), by differences of the geometry
    mu, a, angle, r, p, kappa, h = 0.3, 5e-4, 0.42, 0.01, 3e5, 0.08, 1e-6
    alpha = lambda k: math.acos(math.cos(angle) * (1 - k))  # noqa: E731
    area = 2 * math.pi * r * math.sin(alpha(kappa)) / math.sin(angle) * LENGTH * (1 - kappa)
    turn = 2 * (alpha(kappa + h) - alpha(kappa - h)) / (2 * h)
    expected = mu * p * area * a * turn / LENGTH
    found = loss_at(L.StrandFriction(mu, a, angle, 2 * r), 0.05, p)
    assert found == pytest.approx(expected, rel=1e-6)


def test_the_force_velocity_relation_is_hills_hyperbola_scaled_by_pressure():
    loss = L.ForceVelocity(20.0, 1e-4, 15.0, 5e-5, speed=0.08, turn=1e-6)
    for p in (1e5, 6e5):
        for v in (0.01, 0.08, 1.0):
            assert loss_at(loss, v, p) == pytest.approx((20 + 1e-4 * p) * v / (0.08 + v), rel=1e-6)
            lost = (15 + 5e-5 * p) * v / (0.08 + v)
            assert loss_at(loss, -v, p) == pytest.approx(-lost, rel=1e-6)


def test_creep_under_load_is_creep_with_a_shorter_time():
    loss = L.LoadCreep((800.0,), (0.5,), load=400.0)
    bench = Bench(loss)
    carried = float(pam.muscle("DMSP-20-300").tension(PRESSURE, 0.08))
    force = bench.at(0.08, 0.0, bench.rested([0.0], 0.08, 0.4))[1]
    quicker = 0.5 / (1 + carried / 400.0)
    assert force == pytest.approx(800 * 0.08 * math.exp(-0.4 / quicker), rel=1e-6)
    refused("one of each per element", L.LoadCreep, (1.0,), (1.0, 2.0))


@pytest.mark.parametrize(
    "loss",
    [L.StrandFriction(diameter=0.02, excess=0.3), L.ForceVelocity(), L.LoadCreep()],
    ids=["strands", "hill", "creep"],
)
def test_what_is_lost_is_never_given_back(loss):
    bench, rng = Bench(loss), np.random.default_rng(9)
    for _ in range(200):
        kappa, rate = rng.uniform(0, 0.25), rng.choice([-1, 1]) * 10 ** rng.uniform(-6, 1)
        settled = rng.uniform(0, 0.25, len(bench.plant.states) - 1)
        flow, force = bench.at(kappa, rate, settled, rng.uniform(0, TOP))
        in_spring = sum(500.0 * (kappa - settled) * (rate - flow)) if settled.size else 0.0
        assert force * rate - in_spring >= -1e-12 * abs(force * rate)


# ---- preconditioning -----------------------------------------------------------------------------

RUBBER = L.Preconditioning(300.0, 0.4, 0.02)


def test_the_first_contraction_is_stiff_and_the_second_soft_up_to_the_largest():
    bench = Bench(RUBBER)
    (up, down), z = bench.along([0.08, 0.2, 0.1], z=[0.08])
    assert z[0] == pytest.approx(0.2, abs=1.1e-3)
    assert up == pytest.approx(300 * 0.2, rel=0.03)
    assert down == pytest.approx(300 * 0.1 * (1 - 0.4 * math.tanh((z[0] - 0.1) / 0.02)), rel=1e-6)
    (again, back), same = bench.along([0.1, 0.19, 0.1], z=z)
    assert same == pytest.approx(z, abs=1e-6)
    assert back == pytest.approx(down, rel=1e-6)
    assert again == pytest.approx(
        300 * 0.19 * (1 - 0.4 * math.tanh((z[0] - 0.19) / 0.02)), rel=1e-6
    )


def test_softening_dissipates_and_is_never_undone():
    bench, rng = Bench(RUBBER), np.random.default_rng(10)

    def energy(kappa, reached):
        soft = lambda s: 1 - 0.4 * math.tanh(max(reached - s, 0) / 0.02)  # noqa: E731
        parts = [0.0, min(reached, kappa), kappa]
        return sum(quad(lambda s: 300 * s * soft(s), *ends)[0] for ends in pairwise(parts))

    for _ in range(200):
        kappa, reached = rng.uniform(0.01, 0.25, 2)
        (rising,), force = bench.at(kappa, rng.uniform(-1, 1), [reached])
        assert rising >= 0
        h = 1e-5
        assert energy(kappa, reached + h) <= energy(kappa, reached - h) + 1e-12
        slope = (energy(kappa + h, reached) - energy(kappa - h, reached)) / (2 * h)
        assert force == pytest.approx(slope, rel=1e-3, abs=1e-3)


def test_a_muscle_that_was_exercised_before_starts_soft():
    plant = pam.HangingLoad("DMSP-20-300", losses=L.Preconditioning(reached=0.2))
    assert plant.variable("muscle.reached").start == 0.2
    virgin = pam.HangingLoad("DMSP-20-300", losses=L.Preconditioning())
    both = [p.equilibrium({"muscle.command": 4e5})["x"] for p in (virgin, plant)]
    assert both[1] > both[0]

"""Joint fits of several muscles: exact recovery, SciPy on the stacked problem, and coverage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from conftest import refused
from scipy.optimize import least_squares
from scipy.stats import f as fisher
from static_tables import grid, joined, measured, six

from pam_ocp.core.errors import FitError, InputError, UnknownNameError
from pam_ocp.fitting import ForceTable, fit_force
from pam_ocp.fitting.static.campaign import fit_forces
from pam_ocp.fitting.static.search import minimise
from pam_ocp.fitting.static.shared import JointForceFit, JointProblem
from pam_ocp.muscles.law import SixParameterLaw
from pam_ocp.muscles.laws.empirical import LengthScaledLaw

TWENTY = SixParameterLaw.from_published((12.789, 419.48, -0.42, -8.7013, 267.672, -309.603))
TEN = SixParameterLaw.from_published((-3.0515, 168.235, -0.42, -2.90206, 91.4042, -201.027))
P, KAPPA = grid(np.array([0.0, 0.03, 0.06, 0.1, 0.14, 0.18]), np.linspace(1e5, 6e5, 8))


def cells(law: Any, noise: float = 0.0, seed: int = 0, length: float | None = None) -> ForceTable:
    """The taut cells of a law on the grid, with noise."""
    force = law.tension(P, KAPPA)
    taut = force > 30
    error = noise * np.random.default_rng(seed).standard_normal(int(taut.sum()))
    return ForceTable(P[taut], KAPPA[taut], force[taut] + error, length)


def scaled(length: float, ratio: float) -> ForceTable:
    p, r = grid(np.linspace(0.02, 0.9, 6), np.linspace(2e5, 6e5, 5))
    force = LengthScaledLaw.from_published("20", length, ratio).tension(p, r * ratio)
    taut = force > 20
    return ForceTable(p[taut], (r * ratio)[taut], force[taut], length)


@pytest.fixture(scope="module")
def joint() -> JointForceFit:
    tables = {"20": cells(TWENTY, 5.0, 1), "10": cells(TEN, 5.0, 2)}
    return fit_forces(tables, shared=["a3"], errors="independent")


# ---- recovery ------------------------------------------------------------------------------------
def test_without_noise_the_truth_comes_back_exactly() -> None:
    found = fit_forces({"20": cells(TWENTY), "10": cells(TEN)}, shared=["a3"])
    for name, law in (("20", TWENTY), ("10", TEN)):
        for n, value in law.values.items():
            assert float(found[name].law.values[n]) == pytest.approx(value, rel=1e-6)
    assert found.names[0] == "a3"
    assert len(found.names) == 11


def test_the_length_scaled_law_is_found_across_lengths() -> None:
    lengths, ratios = (0.1, 0.2, 0.3), (0.22, 0.24, 0.25)
    tables = [scaled(*pair) for pair in zip(lengths, ratios, strict=True)]
    found = fit_forces(tables, "length-scaled", fixed={"max_contraction_ratio": ratios})
    truth = LengthScaledLaw.from_published("20", 0.1)
    assert found.shared == ("a0", "a1", "a3", "b1", "b2")
    for name in found.shared:
        assert found.coefficients[name].value == pytest.approx(float(truth.values[name]), rel=1e-5)
    # one length alone cannot tell b1 from b2: their product is all it sees
    held = {"max_contraction_ratio": 0.22}
    alone = fit_forces([tables[0], tables[0]], "length-scaled", fixed=held)
    assert alone.linearisation.rank == 4
    assert any("b1" in text and "b2" in text for text in alone.warnings)


def test_nothing_shared_is_each_muscle_alone() -> None:
    tables = {"20": cells(TWENTY, 5.0, 1), "10": cells(TEN, 5.0, 2)}
    found = fit_forces(tables, shared=[], errors="independent")
    for name, table in tables.items():
        alone = fit_force(table, errors="independent")
        for n, c in alone.coefficients.items():
            assert float(found[name].law.values[n]) == pytest.approx(c.value, rel=1e-5)
            pooled = c.stderr * found[name].sigma / alone.sigma  # one s of both tables
            assert found[name].coefficients[n].stderr == pytest.approx(pooled, rel=1e-4)


def test_everything_shared_is_one_big_table() -> None:
    one, two = cells(TWENTY, 5.0, 1), cells(TWENTY, 5.0, 2)
    whole = fit_force(joined(one, two), errors="independent")
    found = fit_forces([one, two], errors="independent")
    for n, c in whole.coefficients.items():
        assert found.coefficients[n].value == pytest.approx(c.value, rel=1e-6)
        assert found.coefficients[n].stderr == pytest.approx(c.stderr, rel=1e-6)
        assert found["1"].coefficients[n].stderr == pytest.approx(c.stderr, rel=1e-6)
    assert found.cost == pytest.approx(whole.squares, rel=1e-9)


# ---- statistics ----------------------------------------------------------------------------------
def stacked(tables: list[ForceTable]) -> tuple[Any, Any]:
    """Residuals of two six-parameter laws with a common a3, and a start; p in bar, kappa in %."""

    def residuals(z: np.ndarray) -> np.ndarray:
        rest = []
        for table, own in zip(tables, (z[1:6], z[6:11]), strict=True):
            c = np.insert(own, 2, z[0])
            rest.append(six(c, table.pressure / 1e5, 100 * table.contraction) - table.force)
        return np.concatenate(rest)

    start = np.array([-0.4, 12, 400, -8, 260, -300, -3, 170, -3, 90, -200.0])
    return residuals, start


def test_values_and_errors_agree_with_scipy_on_the_stacked_problem(joint: JointForceFit) -> None:
    residuals, start = stacked([f.table for f in joint.fits.values()])
    answer = least_squares(residuals, start, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    dof = answer.fun.size - 11
    j = answer.jac / np.linalg.norm(answer.jac, axis=0)
    covariance = 2 * answer.cost / dof * np.linalg.inv(j.T @ j)
    errors = np.sqrt(np.diag(covariance)) / np.linalg.norm(answer.jac, axis=0)
    assert joint.cost == pytest.approx(2 * answer.cost, rel=1e-8)
    assert joint.dof == dof
    factors = {"a1": 1e5, "a2": 1.0, "a3": 1e-2, "a4": 1e3, "a5": 1e5, "a6": 1.0}
    order = ["a3", *(f"{n}[{m}]" for m in ("20", "10") for n in ("a1", "a2", "a4", "a5", "a6"))]
    for name, value, error in zip(order, answer.x, errors, strict=True):
        found, factor = joint.coefficients[name], factors[name[:2]]
        assert found.value * factor == pytest.approx(value, rel=1e-4)
        assert found.stderr * factor == pytest.approx(error, rel=1e-3)


def test_a_joint_fit_tells_what_a_single_one_tells(joint: JointForceFit) -> None:
    pytest.importorskip("pandas")
    jacobian = joint.linearisation.jacobian
    scaled = jacobian / np.linalg.norm(jacobian, axis=0)
    assert joint.rank == np.linalg.matrix_rank(scaled) == 11
    assert joint.condition == pytest.approx(np.linalg.cond(scaled), rel=1e-6)
    errors = np.sqrt(np.diag(joint.covariance))
    expected = joint.covariance / np.outer(errors, errors)
    np.testing.assert_allclose(joint.correlation, expected, rtol=1e-9, atol=1e-12)
    frame = joint.to_pandas()
    assert tuple(frame.index) == joint.names
    assert frame["high"]["a3"] == joint.interval("a3")[1]


def test_a_muscle_of_a_joint_fit_has_the_joint_intervals(joint: JointForceFit) -> None:
    member = joint["10"]
    assert member.interval("a3") == pytest.approx(joint.interval("a3"))
    assert member.interval("a6") == pytest.approx(joint.interval("a6[10]"))
    alone = fit_force(member.table)
    assert member.coefficients["a3"].stderr < alone.coefficients["a3"].stderr
    places = [joint.names.index(n if n == "a3" else f"{n}[10]") for n in member.free]
    assert member.covariance == pytest.approx(joint.covariance[np.ix_(places, places)], rel=1e-6)
    # the law's mean at a point: gradient of this muscle times the joint covariance
    gradient = member._sensitivity(np.array([3e5]), np.array([0.1]))[1][0]
    expected = np.sqrt(gradient @ joint.covariance[np.ix_(places, places)] @ gradient)
    assert float(member.predict(3e5, 0.1).stderr) == pytest.approx(expected, rel=1e-6)
    assert member.muscle(rest_length=0.25).law == member.law


@pytest.mark.slow
def test_intervals_cover_the_truth_and_errors_are_the_scatter() -> None:
    """60 synthetic pairs of tables, noise 4 N and 1 N, both unknown."""
    found, covered = [], 0
    for seed in range(60):
        tables = {"20": cells(TWENTY, 4.0, seed), "10": cells(TEN, 1.0, 1000 + seed)}
        fit = fit_forces(tables, shared=["a3"], noise="each")
        low, high = fit.interval("a3")
        covered += low <= float(TWENTY.a3) <= high
        found.append([c.value for c in fit.coefficients.values()] + list(fit.noise.values()))
    scatter = np.std(found, axis=0, ddof=1)
    errors = [c.stderr for c in fit.coefficients.values()]
    assert scatter[:11] == pytest.approx(errors, rel=0.3)  # the last fit's own; 60 know 9 %
    assert np.mean(found, axis=0)[-2:] == pytest.approx([4.0, 1.0], rel=0.04)
    assert covered >= 52  # of 60; 1 in 350 of fewer at 95 %


def test_profile_interval_ends_where_the_f_statistic_does(joint: JointForceFit) -> None:
    residuals, start = stacked([f.table for f in joint.fits.values()])
    limit = joint.cost * (1 + fisher.ppf(0.95, 1, joint.dof) / joint.dof)
    for end in joint.profile_interval("a3"):
        held = lambda z, a3=end / 100: residuals(np.concatenate([[a3], z]))  # noqa: E731
        answer = least_squares(held, start[1:], x_scale="jac")
        assert 2 * answer.cost == pytest.approx(limit, rel=1e-5)


def test_tables_of_their_own_noise_are_weighed_by_it() -> None:
    tables = {"20": cells(TWENTY, 8.0, 3), "10": cells(TEN, 0.5, 4)}
    each = fit_forces(tables, shared=["a3"], noise="each")
    equal = fit_forces(tables, shared=["a3"])
    assert each.noise["20"] == pytest.approx(8.0, rel=0.3)
    assert each.noise["10"] == pytest.approx(0.5, rel=0.3)
    assert equal.noise["20"] == equal.noise["10"]
    known = [np.full(len(table), 1 / each.noise[n]) for n, table in tables.items()]
    same = fit_forces(tables, shared=["a3"], weights=known)
    assert same.interval("a3") == pytest.approx(each.interval("a3"), rel=1e-4)
    assert each["10"].sigma == pytest.approx(each.noise["10"])


def test_measured_muscles_share_an_exponent() -> None:
    tables = {"20": measured(), "10": measured("DMSP-10-250")}
    fit = fit_forces(tables, shared=["a3"], noise="each")
    assert fit["20"].rmse == pytest.approx(6.67, abs=0.05)
    assert fit["10"].rmse == pytest.approx(1.18, abs=0.02)
    text = fit.report()
    assert "shared by 2 muscles: a3" in text
    assert "a6[10]: " in text


# ---- words ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"shared": ["a9"]}, "unknown coefficient in shared 'a9'"),
        ({"shared": "a3"}, "give a list of coefficients, or 'all'"),
        ({"shared": ["a3"], "fixed": {"a3": -40.0}}, "a3 is held"),
        ({"fixed": {"a3": [1.0, 2.0, 3.0]}}, "3 values for 2 tables"),
        ({"weights": [None]}, "1 for 2 tables"),
        ({"noise": "own"}, "choose 'equal' or 'each'"),
        ({"law": "seven"}, "unknown force law 'seven'"),
    ],
)
def test_bad_arguments_are_refused_in_words(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises((InputError, UnknownNameError), match=words):
        fit_forces([cells(TWENTY), cells(TEN)], **arguments)


def test_tables_that_cannot_serve_are_refused(joint: JointForceFit) -> None:
    refused("one ForceTable", fit_forces, cells(TEN))
    refused("at least two", fit_forces, [cells(TEN)])
    refused("table 2 is an int", fit_forces, [cells(TEN), 3])
    few = [cells(TEN).subset(slice(0, 4)), cells(TWENTY).subset(slice(0, 4))]
    refused("8 taut cells, fewer than the 11 unknowns", fit_forces, few, shared=["a3"])
    with pytest.raises(UnknownNameError, match="muscle of the joint fit"):
        joint["30"]
    refused("profile_interval of the joint fit", joint["10"].profile_interval, "a3")
    refused("save_muscle", joint["10"].to_json, "never.json")


def test_a_poor_table_borrows_from_a_rich_one() -> None:
    """Four cells fix two own coefficients when the others come from the other table."""
    poor = cells(TWENTY, 1.0, 5).subset([0, 9, 17, 25])
    fit = fit_forces({"rich": cells(TWENTY, 1.0, 6), "poor": poor}, shared=["a1", "a2", "a3", "a4"])
    for name in ("a5[poor]", "a6[poor]"):
        low, high = fit.interval(name, 0.999)
        assert low <= float(getattr(TWENTY, name[:2])) <= high


def test_bounds_of_a_shared_unknown_are_the_narrowest_of_its_tables() -> None:
    from types import SimpleNamespace

    def part(*bounds: tuple[float, float]) -> Any:
        variables = [SimpleNamespace(min=low, max=high) for low, high in ((-9.0, 9.0), *bounds)]
        return SimpleNamespace(free=(1, 2), variables=variables)

    parts = part((-1.0, 2.0), (0.0, np.inf)), part((-3.0, 1.5), (-7.0, 8.0))
    problem = JointProblem(parts, (np.array([0, 1]), np.array([0, 2])))
    low, high = problem.bounds()
    assert list(low) == [-1.0, 0.0, -7.0]
    assert list(high) == [1.5, np.inf, 8.0]


def test_a_joint_fit_tries_the_starts_that_it_is_given() -> None:
    class Blind(JointProblem):
        @property
        def scales(self) -> Any:
            return [np.full(1, np.nan) for _ in self.nonlinear]  # nothing is seen there

    whole = fit_forces({"20": cells(TWENTY), "10": cells(TEN)}, shared=["a3"]).problem
    blind = Blind(whole.parts, whole.places, whole.names)
    refused("no finite force anywhere in the scan", minimise, blind, error=FitError)
    found = minimise(blind, np.array([[1e9], [-40.0]]))
    assert found.coefficients[blind.nonlinear] == pytest.approx([-42.0], rel=1e-6)
    assert found.solver.scanned == 3

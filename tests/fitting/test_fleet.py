"""Fleets: catalogues of records, and their hierarchical fit against truths that were drawn."""

import numpy as np
import pytest
from conftest import refused
from scipy.stats import chi2

import pam_ocp as pam
from pam_ocp import InputError, UnknownNameError
from pam_ocp.fitting import Catalogue, ForceTable, Record, fit_fleet
from pam_ocp.fitting.mixed_effects import between, shrunken_variances

LAW = pam.muscle("DMSP-20-300").law
NAMES = list(LAW.values)
MEAN = np.array(list(LAW.values.values()))
SPREAD = 0.05 * np.abs(MEAN)


def record(truth, random, muscle, number, cells=40, kind="DMSP-20", **told):
    p, kappa = random.uniform(0.5e5, 6e5, cells), random.uniform(0, 0.2, cells)
    force = np.asarray(type(LAW)(**dict(zip(NAMES, truth, strict=True))).tension(p, kappa))
    table = ForceTable(p, kappa, force + random.normal(0, 2, cells), rest_length=0.3, floor=None)
    return Record(table, muscle, kind=kind, name=f"{kind}/{muscle}/{number}", **told)


def drawn(seed, muscles, records, own=1.0, **more):
    """Truths of muscles, and records of them."""
    random = np.random.default_rng(seed)
    truths = [MEAN + own * SPREAD * random.normal(size=MEAN.size) for _ in range(muscles)]
    found = [
        record(t, random, f"m{i}", j, **more) for i, t in enumerate(truths) for j in range(records)
    ]
    return truths, found


@pytest.fixture(scope="module")
def fleet():
    truths, records = drawn(5, 30, 4)
    return truths, fit_fleet(records, executor=0)


def held(intervals, truth):
    return [intervals[n][0] <= t <= intervals[n][1] for n, t in zip(NAMES, truth, strict=True)]


# ---- the fit -------------------------------------------------------------------------------------
def test_intervals_of_muscles_hold_the_truth_as_often_as_they_say(fleet):
    truths, found = fleet
    hits = np.mean([held(found.of(f"m{i}").intervals(), t) for i, t in enumerate(truths)])
    assert 0.90 <= hits <= 0.99  # 180 intervals, of each muscle correlated


def test_the_mean_of_a_kind_and_its_spread_are_those_that_were_drawn(fleet):
    kind = fleet[1].population()
    assert np.mean(held(kind.intervals(0.99), MEAN)) == 1
    for n, size in zip(NAMES, SPREAD, strict=True):
        _, low, high = kind.spread(0.99)[n]
        assert low <= size <= high


def test_records_without_scatter_of_their_own_show_little(fleet):
    kind = fleet[1].population()
    assert kind.record_spread()["a2"][0] < 0.1 * kind.spread()["a2"][0]


def test_another_muscle_of_the_kind_lies_in_its_interval(fleet):
    truths, _ = drawn(77, 200, 0)
    kind = fleet[1].population()
    p, kappa = np.array([2e5, 5e5]), np.array([0.02, 0.1])
    band = kind.predict(p, kappa)
    laws = [type(LAW)(**dict(zip(NAMES, t, strict=True))) for t in truths]
    forces = np.array([law.tension(p, kappa) for law in laws])
    assert 0.88 <= np.mean((band.prediction[0] <= forces) & (forces <= band.prediction[1])) <= 1
    assert np.all(band.confidence[1] - band.confidence[0] < band.prediction[1] - band.prediction[0])
    assert 0.88 <= np.mean([held(kind.new_muscle(), t) for t in truths]) <= 1


def test_a_muscle_that_could_not_be_fitted_alone_is_drawn_towards_its_kind():
    _, records = drawn(8, 12, 2)
    random = np.random.default_rng(9)
    poor = record(MEAN, random, "poor", 0, cells=4)
    with pytest.raises(InputError):
        pam.fit_force(poor.table)
    one = fit_fleet([*records, poor], executor=0).of("poor")
    assert np.mean(held(one.intervals(), MEAN)) == 1
    mean = np.array([one.coefficients[n].value for n in NAMES])
    assert np.all(np.abs(mean - MEAN) < 4 * SPREAD)


def test_what_is_shared_is_one_number_for_all_muscles():
    _, records = drawn(3, 4, 2, own=0.0)
    found = fit_fleet(records, shared=["a3"], executor=0)
    assert len({one.coefficients["a3"].value for one in found}) == 1
    assert len({one.coefficients["a2"].value for one in found}) == 4
    assert found.population().shared == ("a3",)
    assert "a3: " in found.report()
    assert "shared" in found.report()


def test_kinds_are_fitted_apart_and_processes_give_the_same_bits():
    _, first = drawn(1, 3, 2)
    _, second = drawn(2, 3, 2, kind="DMSP-40")
    both = fit_fleet([*first, *second], executor=2)
    alone = fit_fleet(second, executor=0)
    assert list(both.kinds) == ["DMSP-20", "DMSP-40"]
    assert both.of("m1", "DMSP-40").intervals() == alone.of("m1").intervals()
    refused("give kind=", both.of, "m1")
    with pytest.raises(UnknownNameError):
        both.population()
    assert len(both.table()) == 6


def test_fits_that_were_made_already_count_by_value_and_covariance():
    truths, records = drawn(4, 20, 1)
    fits = {r.muscle: [pam.fit_force(r.table, errors="independent")] for r in records}
    found = fit_fleet(fits)
    hits = np.mean([held(found.of(f"m{i}").intervals(), t) for i, t in enumerate(truths)])
    assert 0.85 <= hits <= 0.99  # variances of single fits are their own: some 90 %
    refused("law", found.population().predict, 1e5, 0.1)
    refused("records", fit_fleet, {"a": [1.0]})


def test_restricted_maximum_likelihood_of_balanced_units_is_the_analysis_of_variance():
    """One parameter, known equal variances: B is the variance of values less that variance."""
    z, own = np.random.default_rng(0).normal(0, 3, 40), 0.5
    a = np.full((40, 1, 1), 1 / own)
    one = np.zeros(40, dtype=np.intp)
    found = between(a, z[:, None] / own, one, np.array([True]))
    # the factor |B|^1/2 makes 39 degrees of freedom 38
    assert found.covariance[0, 0] == pytest.approx(np.var(z, ddof=1) * 39 / 38 - own, rel=0.01)
    assert found.means[0, 0] == pytest.approx(z.mean())
    assert found.errors[0, 0, 0] == pytest.approx((found.covariance[0, 0] + own) / 40)


@pytest.mark.parametrize("records", [[2, 2, 2, 1, 1, 1, 1, 1, 1], [2] * 9, [3, 1, 4, 1, 5]])
def test_the_scatter_of_records_counts_each_muscle_s_mean_once(records):
    group = np.repeat(np.arange(len(records)), records)
    z = np.random.default_rng(8).normal(5.0, 2.0, group.size)
    means = np.bincount(group, z) / records
    squares, dof = float(np.sum((z - means[group]) ** 2)), group.size - len(records)
    a = np.full((group.size, 1, 1), 1e8)  # next to no error of their own
    found = between(a, 1e8 * z[:, None], group, np.array([True]))
    assert found.covariance[0, 0] == pytest.approx(squares / (dof - 1), rel=1e-2)
    _, low, high = found.spreads(0.95)
    ends = np.sqrt(squares / chi2.ppf([0.975, 0.025], dof))
    assert [low[0], high[0]] == pytest.approx(ends, rel=1e-2)


def test_variances_are_drawn_together_only_where_they_agree():
    random, dof = np.random.default_rng(1), np.full(400, 10.0)
    same = shrunken_variances(random.chisquare(10, 400), dof)
    assert np.ptp(same) < 0.5
    apart = shrunken_variances(random.chisquare(10, 400) * random.choice([1, 100], 400), dof)
    assert np.ptp(np.log(apart)) > 4


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: fit_fleet("folder"), "records"),
        (lambda: fit_fleet([]), "none"),
        (lambda: fit_fleet([1]), "records"),
        (lambda: fit_fleet(drawn(1, 2, 1)[1], shared="a3"), "list"),
        (lambda: fit_fleet(drawn(1, 2, 1)[1], shared=["b"]), "coefficient in shared"),
        (lambda: Record(drawn(1, 1, 1)[1][0].table, "m", when="May"), "ISO 8601"),
        (lambda: Record(drawn(1, 1, 1)[1][0].table, ""), "muscle"),
        (lambda: Catalogue.of(drawn(1, 1, 1)[1] * 2), "two records"),
        (lambda: Catalogue.of(3), "records is an int"),
        (lambda: Catalogue.of(drawn(1, 1, 1)[1]).select(when="24"), "first, last"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(call, words):
    refused(words, call, error=pam.PamError)


# ---- the catalogue -------------------------------------------------------------------------------
@pytest.fixture
def records():
    random = np.random.default_rng(6)
    return [
        record(MEAN, random, f"m{i % 3}", i, who="AB"[i % 2], when=f"2024-0{1 + i}-15", cells=9 + i)
        for i in range(6)
    ]


@pytest.mark.parametrize("remote", [False, True])
def test_a_catalogue_comes_back_from_its_store_as_it_was(records, tmp_path, remote):
    pytest.importorskip("pyarrow")
    store = f"memory://fleet/{tmp_path.name}" if remote else tmp_path / "fleet"
    Catalogue.of(records[:4]).save(store)
    Catalogue.of(records[4:]).save(store)  # beside the others
    found = list(Catalogue.open(store))
    assert [r.name for r in found] == [r.name for r in records]
    for one, other in zip(found, records, strict=True):
        for name in ("who", "when", "muscle", "kind"):
            assert getattr(one, name) == getattr(other, name)
        for name in ("pressure", "contraction", "force", "slack"):
            assert np.array_equal(getattr(one.table, name), getattr(other.table, name))
        assert one.table.rest_length == other.table.rest_length
    refused("already", Catalogue.of(records[:1]).save, store)


def test_a_catalogue_is_asked_by_columns_and_days(records, tmp_path):
    pytest.importorskip("pyarrow")
    Catalogue.of(records).save(tmp_path)
    whole = Catalogue.open(tmp_path)
    assert len(whole.select(who="A")) == 3
    assert len(whole.select(who=["A", "B"], muscle="m1")) == 2
    between = whole.select(when=("2024-02", "2024-03")).entries
    assert [e["when"] for e in between] == ["2024-02-15", "2024-03-15"]
    assert len(whole.select(when=(None, "2024-01-15"))) == 1
    assert list(whole.to_pandas().muscle.unique()) == ["m0", "m1", "m2"]
    with pytest.raises(UnknownNameError):
        whole.select(whose="A")


def test_a_folder_without_records_or_with_a_damaged_one_says_so(records, tmp_path):
    pytest.importorskip("pyarrow")
    refused("holds no records", Catalogue.open, tmp_path)
    Catalogue.of(records).save(tmp_path)
    (tmp_path / "cells-00000.parquet").write_bytes(b"PAR1")
    refused("Parquet", list, Catalogue.open(tmp_path))

"""benchmarks/run.py: what became slower is seen, whatever its figure is called; page.py."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def folder():
    """The folder of the benchmarks, where its modules are found."""
    sys.path.insert(0, str(FOLDER))
    before = set(sys.modules)
    try:
        yield FOLDER
    finally:
        sys.path.remove(str(FOLDER))
        for name in set(sys.modules) - before:  # "run" and "page" are names of others, too
            if str(FOLDER) in str(getattr(sys.modules[name], "__file__", "")):
                del sys.modules[name]


@pytest.fixture(scope="module")
def run(folder):
    import run

    return run


@pytest.fixture(scope="module")
def page(folder):
    import page

    return page


def stored(figures):
    return {"figures": {n: {"median": v, "values": [v, 1.1 * v]} for n, v in figures.items()}}


def test_a_fifth_more_is_told_of_every_figure_that_has_a_goal(run):
    """But of those by the clock and of worst steps, which scatter."""
    before = dict.fromkeys(run.WANTED, 1.0)
    worse = {n: 1.25 if sign == "<=" else 0.8 for n, (sign, _) in run.WANTED.items()}
    told = run.slower(stored(before) | {"missing": {}}, stored(worse) | {"missing": {}})
    silent = {n for n in before if not any(t.startswith(f"{n}: ") for t in told)}
    assert silent == {n for n in before if "wall" in n or "worst" in n}


def test_less_than_a_fifth_others_and_what_is_better_are_not_told(run):
    before = {"fit [s]@60": 1.0, "SciPy LM [s]@60": 1.0, "plan, plain CasADi [s]@50": 1.0}
    after = {"fit [s]@60": 1.15, "SciPy LM [s]@60": 2.0, "plan, plain CasADi [s]@50": 2.0}
    assert run.slower(stored(before), stored(after) | {"missing": {}}) == []
    assert run.slower(stored(before), stored({"fit [s]@60": 0.5}) | {"missing": {}}) == []


def test_a_group_that_fails_where_it_did_not_is_told(run):
    before = stored({}) | {"missing": {"cases": "no end in 900 s"}}
    after = stored({}) | {"missing": {"cases": "no end in 900 s", "start": "ImportError"}}
    assert run.slower(before, after) == ["start: not measured any more: ImportError"]


def of_a_run(made_up, **changed):
    """What a run writes, made up."""
    return {
        "time": "2026-01-02T03:04:05+00:00",
        "commit": "abc1234",
        "machine": {"processor": "one", "processors": 2},
        "system": "a system",
        "load": 0.1,
        "versions": {"python": "3.11.0"},
        "quick": False,
        "repeats": 2,
        "missing": {},
        **stored(made_up),
        **changed,
    }


@pytest.fixture
def file(tmp_path):
    """Write what a run says; the path."""

    def written(name, made_up, **changed):
        path = tmp_path / name
        path.write_text(json.dumps(of_a_run(made_up, **changed)), "utf-8")
        return str(path)

    return written


@pytest.mark.parametrize(("seconds", "code"), [(1.0, 0), (1.19, 0), (1.21, 1), (0.2, 0)])
def test_the_exit_code_tells_of_a_fifth(run, file, capsys, seconds, code):
    old = file("old.json", {"fit [s]@60": 1.0, "SciPy LSODA / simulate": 30.0})
    new = file("new.json", {"fit [s]@60": seconds, "SciPy LSODA / simulate": 30.0})
    assert run.main(["--read", new, "--against", old]) == code
    said = capsys.readouterr().out
    assert ("fit [s]@60: 21 % slower (median 1 -> 1.21)" in said) == bool(code)
    assert ("nothing is more than 20 % slower" in said) != bool(code)
    assert "not the same" not in said


def test_one_noisy_repetition_is_not_told(run, file):
    """Best values are compared: 1.3, 1.0 and 1.4 beside 1.0 and 1.1."""
    old = file("old.json", {"fit [s]@60": 1.0})
    noisy = {"fit [s]@60": {"median": 1.3, "values": [1.3, 1.0, 1.4]}}
    new = file("new.json", {}, figures=noisy)
    assert run.main(["--read", new, "--against", old]) == 0


def test_another_machine_is_told(run, file, capsys):
    old = file("old.json", {}, machine={"processor": "another", "processors": 8})
    assert run.main(["--read", file("new.json", {}), "--against", old]) == 0
    assert "not the same machine" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "words"),
    [(None, "No such file"), ("{", "Expecting"), ('{"figures": {}}', "has no missing, quick")],
)
def test_a_file_of_something_else_is_named(run, tmp_path, capsys, text, words):
    path = tmp_path / "old.json"
    if text is not None:
        path.write_text(text, "utf-8")
    with pytest.raises(SystemExit) as stopped:
        run.main(["--read", str(path)])
    said = capsys.readouterr().err
    assert stopped.value.code == 2
    assert str(path) in said
    assert words in said


def test_wrong_calls_are_refused(run, file):
    for call in (["--repeats", "0"], ["--read", file("a.json", {}), "--against-commit", "HEAD"]):
        with pytest.raises(SystemExit) as stopped:
            run.main(call)
        assert stopped.value.code == 2


@pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")
def test_a_commit_is_unpacked_and_an_unknown_one_refused(run, tmp_path, capsys):
    known = ["git", "-C", str(FOLDER), "rev-parse", "--verify", "HEAD"]
    if subprocess.run(known, capture_output=True).returncode:
        pytest.skip("this is no checkout of git")
    tree = run.unpacked("HEAD", tmp_path)
    assert (tree / "pam_ocp" / "__init__.py").is_file()
    assert run.environment(tree)["PYTHONPATH"].startswith(str(tree))
    with pytest.raises(SystemExit) as stopped:
        run.unpacked("no-such-revision", tmp_path)
    assert stopped.value.code == 2
    assert "no-such-revision" in capsys.readouterr().err


def test_trees_take_turns_and_what_fails_is_not_tried_again(run, monkeypatch, tmp_path):
    asked = []

    def once(name, quick, tree):
        asked.append((name, tree.name))
        return "ImportError" if name == "fit_cells" else {"plan [s]@25": float(len(asked))}

    monkeypatch.setattr(run, "once", once)
    trees = [run.Measured(tmp_path / "new"), run.Measured(tmp_path / "old")]
    new, old = run.measure(["intervals", "fit_cells"], True, 2, trees)
    groups = ["intervals", "intervals", "fit_cells", "fit_cells", "intervals", "intervals"]
    assert asked == list(zip(groups, ["new", "old"] * 3, strict=True))
    assert new["figures"]["plan [s]@25"] == {"median": 3.0, "values": [1.0, 5.0]}
    assert old["figures"]["plan [s]@25"]["values"] == [2.0, 6.0]
    assert new["missing"] == {"fit_cells": "ImportError"}


@pytest.mark.parametrize("power", [0.0, 1.0, 1.5])
def test_the_slope_at_the_end_of_a_power_law(page, power):
    """A constant part, which hides the power at small sizes, is left out of it."""
    sizes = [10, 100, 1000, 10_000]
    values = [1e3, *(s**power for s in sizes[1:])]
    assert page.exponent(sizes, values) == pytest.approx(power, abs=1e-12)


def test_one_size_has_no_slope(page):
    assert page.exponent([10], [1.0]) is None
    assert page.exponent([10, 20], [0.0, 1.0]) is None


PAGE = "# How quick\n\n<!-- figures: begin -->\nold\n<!-- figures: end -->\n\n## More\n"


def test_the_page_tells_curves_slopes_goals_peers_and_failures(run, page, tmp_path):
    (tmp_path / "benchmarks.md").write_text(PAGE, "utf-8")
    curves = {f"plan [s]@{n}": 0.001 * n for n in (25, 50, 100)}
    goals = {"fit_force with intervals [s]@60": 0.005, "Kalman filter [ms]": 0.4}
    tools = {
        "pam_ocp": {"whole": 0.5, "error": 1.7e-8},
        "base": {"whole": 2.0},
        "x": "failed: a | b",
    }
    said = of_a_run(curves | goals, missing={"cases": "no end in 900 s"}, peers={"planning": tools})
    goals = tmp_path / "figures.md"
    written = page.write_page(said, tmp_path, goals)
    text, figures = (p.read_text("utf-8") for p in (tmp_path / "benchmarks.md", goals))
    assert text.startswith("# How quick\n\n<!-- figures: begin -->\n`python benchmarks/run.py")
    assert text.endswith("<!-- figures: end -->\n\n## More\n")
    assert "old" not in text.split()
    assert "| plan [s] over intervals | 25: 0.025, 50: 0.05, 100: 0.1 | 1.00 |" in figures
    assert "| fit_force with intervals [s], 60 | 0.005 | 0.005 .. 0.0055 | <= 0.01 |" in figures
    assert "| Kalman filter [ms] | 0.4 | 0.4 .. 0.44 | <= 0.1 (not reached) |" in figures
    assert "| cases | not measured: no end in 900 s |" in figures
    assert "| pam_ocp | 0.5 | 1.7e-08 |" in text
    assert "| x | failed: a \\| b |" in text
    made = ["benchmarks.md", "figures.md", "growth-light.svg", "growth-dark.svg"]
    assert [p.name for p in written] == made
    for path in written[2:]:
        first = path.read_bytes()
        assert b"<svg" in first
    page.write_page(said, tmp_path, goals)  # again: the same, and nothing beside it
    assert path.read_bytes() == first
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(p.name for p in written)


def test_a_page_without_curves_has_no_plots(page, tmp_path):
    (tmp_path / "benchmarks.md").write_text(PAGE, "utf-8")
    files = [tmp_path / "benchmarks.md", tmp_path / "figures.md"]
    assert page.write_page(of_a_run({"import [s]": 0.1}), tmp_path, files[1]) == files
    assert "growth" not in (tmp_path / "benchmarks.md").read_text("utf-8")


def test_every_curve_that_is_drawn_is_measured(page):
    """Names of figures stand in two places: in page.py and where they are measured."""
    sources = "".join((FOLDER / f).read_text("utf-8") for f in ("measured.py", "many.py"))
    for _, _, names in page.CURVES.values():
        for name in names:
            family = name.replace("Mpc compiled, converged", "{how}, {name}")
            family = family.replace("Mpc, converged", "{how}, {name}")
            assert f'"{family}@{{' in sources, name

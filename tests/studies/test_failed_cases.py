"""Cases of a sweep that failed: counted, told with their reasons, in one process or several."""

import html
import math

import pytest

from pam_ocp.studies import run_study

FAILING = """
[steps.load]
kind = "plant"
arrangement = "HangingLoad"
muscle = "DMSP-20-300"

[steps.rest]
kind = "linearize"
plant = "load"
rest = { "muscle.pressure" = "3 bar" }

[steps.some]
kind = "sweep"
of = "rest"
vary = { "load.mass" = ["5 kg", "400 kg"] }
numbers = ["frequency1"]

[steps.none]
kind = "sweep"
of = "rest"
vary = { "load.mass" = ["500 kg", "600 kg"] }
numbers = ["frequency1"]

[steps.plants]
kind = "sweep"
of = "load"
vary = { "load.mass" = ["5 kg", "8 kg"] }
"""


@pytest.mark.parametrize("workers", [1, 2])
def test_cases_of_a_sweep_that_failed_are_counted_and_say_why(tmp_path, workers):
    places = tmp_path / "study.toml", tmp_path / "out"
    places[0].write_text(FAILING)
    for state in ("done", "kept"):
        result = run_study(*places, cache=tmp_path / "cache", workers=workers)
        assert result["some"].verdict == "1 of 2 cases done"
        assert result["none"].verdict == "0 of 2 cases done"
        assert (result["plants"].verdict, result["plants"].good) == ("2 of 2 cases done", True)
        assert result["plants"].state == state
        reason = result["rest[some 2]"].verdict
        assert reason.startswith("no equilibrium of 'hanging_load'")
        assert f"rest[some 2]  linearize  failed    {reason}" in str(result)
        assert reason in html.unescape(result.report.read_text("utf-8"))
        # undamped: the stiffness at rest and the mass say it
        stiffness = result["rest[some 1]"].numbers["stiffness"][0]
        own = math.sqrt(stiffness / 5.0) / (2 * math.pi)
        assert result["rest[some 1]"].numbers["frequency1"][0] == pytest.approx(own, rel=1e-6)


def test_an_unknown_number_is_told_alike_by_a_worker(tmp_path):
    """The error itself crosses; what cannot be read again breaks a pool of processes."""
    places = tmp_path / "study.toml", tmp_path / "out"
    places[0].write_text(FAILING.replace('"frequency1"', '"frequency"', 1))
    said = [run_study(*places, workers=n, fresh=True)["some"].verdict for n in (1, 2)]
    assert said[0] == said[1] == "unknown number of rest 'frequency': did you mean 'frequency1'?"

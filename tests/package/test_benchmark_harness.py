"""benchmarks/harness.py: cases, limits, tables to go on from."""

import json
import multiprocessing
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

import pam_ocp as pam

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def harness():
    sys.path.insert(0, str(FOLDER))
    try:
        import harness

        yield harness
    finally:
        sys.path.remove(str(FOLDER))
        sys.modules.pop("harness", None)


def test_what_a_case_refuses_or_raises_is_a_row(harness):
    def refused():
        raise pam.InputError("no such muscle")

    def raised():
        raise ZeroDivisionError("by zero")

    rows = [harness.judged(work) for work in (refused, raised, lambda: {"verdict": "right"})]
    assert [row["verdict"] for row in rows] == ["refused", "RAISED", "right"]
    assert [row.get("why") for row in rows] == [
        ["no such muscle"],
        ["ZeroDivisionError: by zero"],
        None,
    ]
    assert all(row["processor"] >= 0.0 for row in rows)


def test_a_case_is_given_up_after_its_processor_seconds_and_one_that_sleeps_is_not(harness):
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("processes are not forked here")

    def busy():
        harness.about("runs for ever")
        while True:
            pass

    def asleep():
        time.sleep(1.0)
        return {"verdict": "awake"}

    given_up = {"text": "runs for ever", "verdict": "over time", "processor": 0.5}
    assert harness.limited(busy, 0.5) == given_up
    assert harness.limited(asleep, 0.5)["verdict"] == "awake"
    assert harness.limited(lambda: os._exit(1), 0.5)["verdict"] == "DIED"


def test_a_table_is_gone_on_with_and_that_of_another_seed_is_not(harness, tmp_path):
    table, done = tmp_path / "table.jsonl", []

    def cases(given):
        for number in harness.numbers(given):
            yield number, lambda n=number: done.append(n) or {"verdict": "right", "square": n**2}

    harness.run(cases, harness.asked(2, 7, table=table))
    rows = harness.run(cases, harness.asked(4, 7, table=table))
    assert done == [0, 1, 2, 3]
    assert [row["square"] for row in rows] == [0, 1, 4, 9]
    assert [json.loads(line)["case"] for line in table.read_text().splitlines()] == [*"0123"]
    harness.run(cases, harness.asked(1, 8, table=table))
    assert done == [0, 1, 2, 3, 0]
    assert harness.tally(rows).startswith("   4 of 4 right\n")


@pytest.mark.parametrize(
    ("words", "numbers"),
    [
        (["3"], [0, 1, 2]),
        (["2", "--start", "5"], [5, 6]),
        (["9", "--start", "5", "--end", "7"], [5, 6]),
        (["--only", "3,17", "4"], [3, 17, 4]),
    ],
)
def test_numbers_of_cases(harness, words, numbers):
    given = harness.parser("", 100, 1).parse_args(words)
    assert list(harness.numbers(given)) == numbers
    assert all(harness.chosen(given, number) for number in numbers)


@pytest.mark.parametrize("words", [["5", "7"], ["5", "--seed", "7"], ["--seed", "7", "5"]])
def test_a_seed_stands_behind_the_count_or_its_option(harness, words):
    given = harness.parser("", 100, 1).parse_args(words)
    assert (given.count, given.seed) == (5, 7)


def test_a_part_of_a_name_chooses_a_case(harness):
    given = harness.parser("", None, 1).parse_args(["--only", "hanging, ideal"])
    assert harness.chosen(given, "hanging, ideal, work")
    assert not harness.chosen(given, "hanging, spool, work")


def test_a_table_in_markdown(harness):
    text = harness.table(("tool", "seconds"), [("a | b", 0.12345), ("c", 3)])
    assert text == "| tool | seconds |\n|---|---|\n| a \\| b | 0.123 |\n| c | 3 |"


STUDIES = sorted(p.name for p in FOLDER.glob("*.py") if "\n    harness.main(" in p.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES)
def test_a_study_tells_what_it_takes(study):
    command = [sys.executable, str(FOLDER / study), "--help"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "--seed" in told

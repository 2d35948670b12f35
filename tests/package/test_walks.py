"""The newcomer's walks in docs/architecture.md lead over files that are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text("utf-8")
FILE = re.compile(r"`((?:[A-Za-z0-9_]+/)*[A-Za-z0-9_]+\.(?:py|toml|c|h|md))`")


def sections(text, mark):
    """{heading: what stands below it} of the headings that begin with the mark."""
    parts = re.split(rf"(?m)^{mark} (.*)$", text)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


WALKS = sections(sections(TEXT, "##")["Five walks through the code"], "###")


def test_there_are_the_five_walks():
    assert [name.split(",")[0] for name in WALKS] == [
        "Pressure",
        "A plan",
        "A new loss",
        "A fit",
        "A bug report",
    ]


@pytest.mark.parametrize("walk", WALKS)
def test_the_files_of_a_walk_exist(walk):
    named = FILE.findall(WALKS[walk])
    assert len(set(named)) >= 8
    gone = {n for n in named if not any((base / n).is_file() for base in (ROOT, ROOT / "pam_ocp"))}
    assert gone == set()


def test_files_that_the_rest_of_the_page_names_exist():
    named = set(FILE.findall(TEXT))
    gone = {n for n in named if not any((base / n).is_file() for base in (ROOT, ROOT / "pam_ocp"))}
    assert gone <= set().union(*(FILE.findall(walk) for walk in WALKS.values()))

"""The paper: its length, its references, its figure."""

import re
import struct
import sys
from pathlib import Path

import pytest
import yaml

import pam_ocp

PAPER = Path(__file__).parents[2] / "paper"
_, HEAD, TEXT = (PAPER / "paper.md").read_text("utf-8").split("---\n", 2)
REFERENCES = (PAPER / "paper.bib").read_text("utf-8")


def test_the_paper_is_short_and_has_the_parts_of_its_form():
    assert len(TEXT.split()) <= 1000
    parts = re.findall(r"(?m)^# (.*)$", TEXT)
    assert parts[:3] == ["Summary", "Statement of need", "State of the field"]
    assert parts[-1] == "References"
    head = yaml.safe_load(HEAD)
    assert {"title", "tags", "authors", "affiliations", "date"} <= set(head)
    assert (PAPER / head["bibliography"]).is_file()


def test_what_is_cited_is_in_the_references_and_nothing_else():
    cited = set(re.findall(r"@([a-z]+\d*)", TEXT))
    assert cited == set(re.findall(r"(?m)^@\w+\{(\w+),", REFERENCES))


def test_a_doi_is_one_that_the_citation_file_has():
    known = (PAPER.parent / "CITATION.cff").read_text("utf-8")
    dois = re.findall(r"doi\s*= \{(.*?)\}", REFERENCES)
    assert dois
    assert all(f"doi: {doi}\n" in known for doi in dois)


def test_as_many_laws_are_counted_as_there_are():
    words = ["six", "seven", "eight", "nine", "ten", "eleven", "twelve"]
    numbers = dict(zip(words, range(6, 13), strict=True))
    (count,) = re.findall(r"corrected; (\w+) others are included", TEXT)
    assert numbers[count] + 1 == len(pam_ocp.laws.LAWS)


@pytest.mark.slow
def test_the_figure_is_drawn_by_its_script(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(PAPER))
    import figure

    try:
        made = figure.main(tmp_path).read_bytes()
    finally:
        sys.modules.pop("figure")
    sizes = [
        struct.unpack(">II", png[16:24]) for png in (made, (PAPER / "figure.png").read_bytes())
    ]
    assert sizes[0] == sizes[1]

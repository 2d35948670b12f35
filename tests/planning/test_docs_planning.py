"""docs/planning.md and docs/problem_files.md tell every term and key."""

import re
from pathlib import Path

import pam_ocp as pam
from pam_ocp.judge.statement import COSTS
from pam_ocp.planning.problem.problem import FORMS
from pam_ocp.planning.problem.problem_file import _READERS

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "".join((DOCS / name).read_text("utf-8") for name in ("planning.md", "problem_files.md"))


def test_every_term_and_key_is_told():
    told = set(re.findall(r"`(\w+)(?:\(NAME\))?`", PAGE))
    assert {*COSTS, "rate", *FORMS} <= told
    assert {"plant", *_READERS} <= told


def test_public_names_exist():
    names = set(re.findall(r"pam\.([a-zA-Z_]+)", PAGE))
    assert names <= set(dir(pam))

"""What docs/planning.md and docs/problem_files.md show runs as it stands there."""

import re
from pathlib import Path

import pytest

import pam_ocp as pam
from pam_ocp.judge.costs import COSTS
from pam_ocp.planning.problem.problem import FORMS
from pam_ocp.planning.problem.problem_file import _READERS

DOCS = Path(__file__).parents[2] / "docs"
PAGE = "".join((DOCS / name).read_text("utf-8") for name in ("planning.md", "problem_files.md"))


@pytest.mark.slow
def test_the_blocks_run_in_their_order(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (problem,) = re.findall(r"```toml\n(.*?)```", PAGE, re.S)
    (tmp_path / "problem.toml").write_text(problem, "utf-8")
    blocks = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    assert len(blocks) >= 10
    names: dict = {}
    for number, code in enumerate(blocks, start=1):
        exec(compile(code, f"planning.md, block {number}", "exec"), names)
    shown = capsys.readouterr().out
    assert "The most violated constraint is" in shown
    assert "x of 200 plants unseen" in shown
    assert "verified: of unseen ones" in shown
    assert "not verified" not in shown
    for picture in ("plan.png", "robust.png", "front.png", "costates.png", "motion.gif"):
        assert (tmp_path / picture).stat().st_size > 5_000


def test_every_term_and_key_is_told():
    told = set(re.findall(r"`(\w+)(?:\(NAME\))?`", PAGE))
    assert {*COSTS, "rate", *FORMS} <= told
    assert {"plant", *_READERS} <= told


def test_public_names_exist():
    names = set(re.findall(r"pam\.([a-zA-Z_]+)", PAGE))
    assert names <= set(dir(pam))

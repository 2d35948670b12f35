"""What docs/files.md shows runs as it stands there."""

import re
import warnings
from pathlib import Path

import pytest

from pam_ocp.fitting import ReadingWarning

DOCS = Path(__file__).parents[2] / "docs"


def test_the_blocks_run_in_their_order_and_print_what_stands_there(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (DOCS / "files.md").read_text("utf-8")
    blocks = re.findall(r"```(python|text)\n(.*?)```", page, re.S)
    names: dict = {}
    shown = ""
    for number, (kind, code) in enumerate(blocks, start=1):
        if kind == "text":
            assert code.strip() == shown.strip()
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ReadingWarning)
            exec(compile(code, f"files.md, block {number}", "exec"), names)
        shown = capsys.readouterr().out
    assert names["table"].pressure == pytest.approx([0.5e5, 2e5, 4e5])
    assert names["ramp"].error is not None
    assert names["ramp"].slack.any()
    assert [len(r) for r in names["records"]] == [300, 100]

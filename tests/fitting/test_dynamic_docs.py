"""The page on dynamic fits runs as it stands there."""

import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "dynamic_fits.md"


@pytest.mark.slow
def test_every_block_of_the_page_runs(capsys):
    namespace: dict[str, object] = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.S):
        exec(compile(code, PAGE.name, "exec"), namespace)
    shown = capsys.readouterr().out
    assert "the choice" in shown
    assert "a prediction may fail here" in shown

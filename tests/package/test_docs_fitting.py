"""What the page on fitting shows runs as it stands there."""

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "fitting.md").read_text("utf-8")


@pytest.mark.slow
def test_the_blocks_on_campaigns_and_holds_run_one_after_another(tmp_path, monkeypatch, capsys):
    section = PAGE[PAGE.index("## Static campaigns and holds") :]
    section = section[: (section + "\n## ").index("\n## ", 3)]
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", section, re.S):
        exec(compile(block, "docs/fitting.md", "exec"), names)
    shown = capsys.readouterr().out
    for part in ("[[Diameter 20 mm]]", "hysteresis", "[[Holds]]", "left out"):
        assert part in shown
    assert (tmp_path / "campaign" / "table.csv").exists()

"""What the README shows runs as it stands there."""

import re
from pathlib import Path

import pytest

README = (Path(__file__).parents[2] / "README.md").read_text("utf-8")


@pytest.mark.slow
def test_the_ten_lines_of_python_run(tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len(code.strip().splitlines()) <= 12
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "RMSE 6.196 N" in shown
    assert "all well" in shown


def test_names_in_the_readme_exist():
    import pam_ocp as pam

    names = set(re.findall(r"`pam\.([a-zA-Z_]+)", README))
    assert names
    assert names <= set(dir(pam))


def test_every_public_name_is_documented():
    import pam_ocp as pam

    undocumented = [
        n for n in pam.__all__ if not (getattr(pam, n).__doc__ or "").strip() and n != "LAWS"
    ]
    assert undocumented == []

"""What the README shows runs as it stands there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text("utf-8")
LIST = (ROOT / "docs" / "what_is_in_it.md").read_text("utf-8")


@pytest.mark.slow
def test_the_ten_lines_of_python_run(tmp_path, monkeypatch, capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.S)
    assert len(code.strip().splitlines()) <= 12
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    shown = capsys.readouterr().out
    assert "RMSE 6.196 N" in shown
    assert "all well" in shown


def test_names_in_the_readme_and_its_list_exist():
    import pam_ocp as pam

    names = set(re.findall(r"`pam\.([a-zA-Z_]+)", README + LIST))
    assert names
    assert names <= set(dir(pam))


def test_the_readme_is_short_and_cites_this_version():
    import pam_ocp

    assert len(README.split()) <= 500
    assert f"version = {{{pam_ocp.__version__}}}" in README


def test_every_public_name_is_documented():
    import pam_ocp as pam

    undocumented = [
        n for n in pam.__all__ if not (getattr(pam, n).__doc__ or "").strip() and n != "LAWS"
    ]
    assert undocumented == []

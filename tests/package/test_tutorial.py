"""The tutorial, followed to the letter: its commands, files and blocks, in their order."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
STEP = re.compile(r"^```(sh|toml|python)\n(.*?)^```", re.S | re.M)
COMMAND = 'pam-ocp() { "$PYTHON" -m pam_ocp "$@"; }; set -e\n'


def steps():
    return STEP.findall((DOCS / "tutorial.md").read_text("utf-8"))


@pytest.mark.slow
def test_the_tutorial_leads_from_the_workbook_to_the_fmu(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copy(DOCS / "rig.xlsx", tmp_path)
    names: dict[str, object] = {}
    said = ""
    for kind, text in steps():
        if kind == "toml":
            name = re.match(r"# (\S+\.toml)\n", text)
            Path(name[1]).write_text(text)
        elif kind == "python":
            exec(compile(text, "docs/tutorial.md", "exec"), names)
        else:
            done = subprocess.run(
                ["bash", "-c", COMMAND + text],
                capture_output=True,
                text=True,
                env={**os.environ, "PYTHON": sys.executable, "MPLBACKEND": "Agg"},
                check=False,
            )
            assert done.returncode == 0, (text, done.stdout, done.stderr)
            said += done.stdout
    said += capsys.readouterr().out
    for part in ("verified", "all well", "a3", "Hz"):
        assert part in said
    pictures = ("fit.png", "step.png", "plan.png", "bode.png", "report.html", "m7_slide.fmu")
    assert all(Path(name).stat().st_size > 10_000 for name in pictures)


def test_the_tutorial_has_commands_files_and_python():
    assert {kind for kind, _ in steps()} == {"sh", "toml", "python"}


def test_the_workbook_is_the_one_that_its_script_makes(tmp_path, monkeypatch):
    from openpyxl import load_workbook

    monkeypatch.syspath_prepend(str(DOCS))
    import rig

    rig.main(tmp_path / "rig.xlsx")
    made, kept = (
        [list(row) for row in load_workbook(path)["Readings"].values]
        for path in (tmp_path / "rig.xlsx", DOCS / "rig.xlsx")
    )
    assert made == kept

"""The tutorial's steps and its workbook; its blocks run when the site is made (tests/site.py)."""

import re
from pathlib import Path

DOCS = Path(__file__).parents[2] / "docs"
STEP = re.compile(r"^```(sh|toml|python)\n(.*?)^```", re.S | re.M)


def steps():
    return STEP.findall((DOCS / "tutorial.md").read_text("utf-8"))


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

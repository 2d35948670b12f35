"""The list of components, on the site and by the command, has all that is registered."""

import re
from pathlib import Path

import pytest

from pam_ocp.cli.components import groups, page
from pam_ocp.cli.main import main
from pam_ocp.plants.kinds import LOADS

PACKAGE = Path(__file__).parents[2] / "pam_ocp"
MADE = re.compile(r"^[A-Z_]+: Registry\[.*\] = Registry\(\s*\"([^\"]+)\"", re.M)


def test_each_registry_of_the_package_has_its_table_with_a_row_for_each_name():
    nouns = {n for f in PACKAGE.rglob("*.py") for n in MADE.findall(f.read_text("utf-8"))}
    tables = dict(re.findall(r"(?ms)^## (.*?)\n(.*?)(?=^## |\Z)", page()))
    assert len(nouns) > 20
    assert set(tables) == nouns
    for registry, _ in groups():
        assert re.findall(r"(?m)^\| `(.*?)` \|", tables[registry.noun]) == list(registry)


def test_the_command_lists_one_kind_or_all(capsys):
    assert main(["components", "load"]) == 0
    shown = capsys.readouterr().out
    assert "Spring: F = -k (position - rest)" in shown
    assert "stiffness [N/m or N.m/rad]" in shown
    assert "Regulator" not in shown
    assert main(["components", "running-cost"]) == 0
    assert "exergy" in capsys.readouterr().out
    assert main(["components", "lode"]) == 2
    assert "did you mean 'load'" in capsys.readouterr().err


def test_what_registers_appears_by_itself(capsys):
    @LOADS.register(units={"size": ("N", "N.m")})
    class Wind:
        """A steady wind."""

        def __init__(self, size: float = 3.0) -> None: ...

    try:
        assert "| `Wind` | A steady wind | `size = 3 [N or N.m]` |" in page()
    finally:
        LOADS.remove("Wind")
    with pytest.raises(KeyError):
        LOADS["Wind"]

"""docs/components.md says what is registered; the command shows the same."""

from pathlib import Path

import pytest

from pam_ocp.cli.components import page
from pam_ocp.cli.main import main
from pam_ocp.plants.kinds import LOADS

PAGE = Path(__file__).parents[2] / "docs" / "components.md"


def test_the_page_is_what_the_registries_say():
    assert PAGE.read_text("utf-8") == page(), (
        "write it anew: pam-ocp components --markdown > docs/components.md"
    )


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

"""The command line in this process."""

from __future__ import annotations

import shlex
from typing import Any

from pam_ocp.cli.main import main


def run(capsys: Any, command: str = "", *more: Any) -> tuple[int, str, str]:
    """(exit code, output, errors) of a command's words, and of more that may hold blanks."""
    code = main([*shlex.split(command), *map(str, more)])
    shown = capsys.readouterr()
    return code, shown.out, shown.err

"""``pam-ocp completion``: what a shell needs to complete commands and options by tab."""

from __future__ import annotations

import argparse
from typing import Any

__all__ = ["add_completion"]

SHELLS = ("bash", "zsh", "tcsh")
EPILOG = """\
  pam-ocp completion bash > ~/.local/share/bash-completion/completions/pam-ocp
  pam-ocp completion zsh > ~/.zfunc/_pam-ocp          # a folder of $fpath
  pam-ocp completion tcsh >> ~/.tcshrc
"""


def add_completion(commands: Any) -> None:
    """Add the command to the parser's commands."""
    completion = commands.add_parser(
        "completion",
        help="print a script by which a shell completes commands and options",
        description="Print a completion script for a shell.",
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    completion.add_argument("shell", choices=SHELLS)
    completion.set_defaults(run=_completion)


def _completion(options: argparse.Namespace) -> int:
    import shtab

    print(shtab.complete(_with_files(options.parser), options.shell))
    return 0


def _with_files(made: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Arguments that are files complete as files."""
    import shtab

    for action in made._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in dict.fromkeys(action.choices.values()):
                _with_files(command)
        elif action.nargs != 0 and not action.choices:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    return made

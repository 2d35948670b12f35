"""The command ``pam-ocp``."""

from __future__ import annotations

import argparse
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NoReturn

from .. import __version__
from ..core.errors import PamError
from ..core.exceptions import nearest
from ..core.interrupts import interruptible
from ..core.stop import limited
from ..export.cache import home_folder, usable_folder
from . import components, fit, plan, plants, rig, static, study
from .command import COMMANDS, Option, option, seconds
from .output import bars, command_of, command_words, escaping, finish, logged

assert all((components, fit, plan, plants, rig, static, study))  # they register their commands
ORDER = (
    *("tour", "quick", "study", "look", "fit", "campaign", "fit-forces", "fit-holds", "fit-plant"),
    *("ladder", "export", "check", "loads", "muscles", "components", "simulate", "compare"),
    *("linearize", "report", "plan", "mpc", "rig", "twin", "completion", "bench"),
)
"""Of the commands, in the help."""
HABITS = (
    option(
        "--time-limit", "S", "time limit in seconds, or as '5 min' (default: none)", type=seconds
    ),
    Option(("-q", "--quiet"), {"action": "store_true", "help": "print errors only (and --json)"}),
    Option(
        ("-v", "--verbose"),
        {"action": "count", "default": 0, "help": "log to the error stream; -vv: in detail"},
    ),
)
"""Options of all commands."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns the exit code (0 done, 1 checked and found wanting, 2 bad input)."""
    with escaping():
        try:
            code = _run(arguments)
            sys.stdout.flush()
            return code
        except KeyboardInterrupt:
            _tell_error("interrupted")
            return 130
        except BrokenPipeError:  # the reader (head, less) has seen enough
            _discard_output()
            return 0
        except OSError as error:  # of standard output, mostly: files have errors of our own
            where = f"{error.filename}: " if error.filename else "the output was not written: "
            _tell_error(f"pam-ocp: {where}{error.strerror or error}")
            _discard_output()
            return 2


def _run(arguments: Sequence[str] | None) -> int:
    made = _parser()
    options, unknown = made.parse_known_args(arguments)
    if unknown:
        _refuse(made, options, unknown)
    if not hasattr(options, "run"):
        made.print_help()
        return 2
    options.parser = made
    _give_fonts_a_place()
    try:
        seconds = None if options.command == "check" else options.time_limit
        with (
            _plain_warnings(options),
            _terminable(),
            logged(options.verbose),
            bars(not options.quiet),
            interruptible(),
            limited(seconds),
        ):
            return _done(options)
    except PamError as error:
        _tell_error(f"pam-ocp {options.command}: {command_words(str(error), options)}")
        return 2


def _done(options: argparse.Namespace) -> int:
    """The command's exit code, once it has come to its end, or found that there is no result."""
    command = COMMANDS[options.command]
    command.require_writable(options)
    try:
        code = command.run(options)
    except command.fails as error:
        _tell_error(f"pam-ocp {options.command}: {error}")
        return 1
    finish(options)
    return code


def _refuse(
    made: argparse.ArgumentParser, options: argparse.Namespace, unknown: Sequence[str]
) -> NoReturn:
    """The end of a command with words that it does not know, and the options nearest to them."""
    options.parser, near = made, list[str]()
    if options.command is not None:
        known = [o for a in command_of(options)._actions for o in a.option_strings]
        near = [n for w in unknown if w.startswith("--") for n in nearest(w, known, 0.75)[:1]]
    hint = f"; did you mean {' or '.join(near)}?" if near else ""
    made.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")


class _Formatter(argparse.HelpFormatter):
    """Breaks lines of what has none; what has (files as they are written) stays as it is."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        if "\n" not in text:
            return super()._fill_text(text, width, indent)
        return "".join(f"{indent}{line}" for line in text.splitlines(keepends=True))


class _Parser(argparse.ArgumentParser):
    """One whose help must be written (argparse swallows what goes wrong there), and which names
    the choice that was probably meant.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=_Formatter, **options)

    def error(self, message: str) -> NoReturn:
        found = re.search(r"invalid choice: '(.*)' \(choose from (.*)\)$", message)
        near = nearest(found[1], re.findall(r"[\w.-]+", found[2]), 0.6) if found else []
        hint = f" did you mean {' or '.join(near)}?" if near else ""
        super().error(f"{message}{hint}")

    def _print_message(self, message: str, file: Any = None) -> None:
        file = file or sys.stderr
        file.write(message)
        file.flush()


def _tell_error(words: str) -> None:
    with suppress(OSError):  # of a full error stream nobody hears
        print(words, file=sys.stderr)


def _discard_output() -> None:
    """The interpreter would flush it once more at its end, and fail."""
    sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def _give_fonts_a_place() -> None:
    """A folder for Matplotlib where there is no home: it warns otherwise, and is slow."""
    home = home_folder()
    if "MPLCONFIGDIR" not in os.environ and (home is None or not os.access(home, os.W_OK)):
        os.environ["MPLCONFIGDIR"] = str(usable_folder("matplotlib"))


@contextmanager
def _plain_warnings(options: argparse.Namespace) -> Iterator[None]:
    """A warning is a line that says what it says, without a place in our code."""
    before = warnings.formatwarning

    def plain(message: Warning | str, *_: Any, **__: Any) -> str:
        return f"pam-ocp: {command_words(str(message), options)}\n"

    warnings.formatwarning = plain
    try:
        yield
    finally:
        warnings.formatwarning = before


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="pam-ocp",
        description="Pneumatic artificial muscles: fit a measured muscle, plan its optimal motion, "
        "export the plant as an FMU.",
        epilog="Start with 'pam-ocp tour', the whole chain on a bundled measured muscle. "
        "Exit codes: 0 success; 1 no result, or a check failed; 2 bad input; 3 "
        "plan not verified; 130 interrupted; 143 terminated "
        "(docs/command_line.md).",
    )
    parser.add_argument("--version", action="version", version=f"pam-ocp {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")

    for name in ORDER:
        COMMANDS[name].add(commands, name, *HABITS)
    return parser


@contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM ends the command as Ctrl-C does, its children and temporary files with it: 143."""

    def asked(number: int, frame: Any) -> None:
        raise SystemExit(128 + number)

    mine = threading.current_thread() is threading.main_thread()
    default = mine and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    if default:
        signal.signal(signal.SIGTERM, asked)
    try:
        yield
    finally:
        if default:
            signal.signal(signal.SIGTERM, signal.SIG_DFL)

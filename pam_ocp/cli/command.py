"""How a command is described, once: its help, its options, and the function that does it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ..core.errors import InputError
from ..core.files import require_place
from ..core.quantities import quantity

PICTURES = (".png", ".pdf", ".svg", ".eps", ".ps", ".jpg", ".jpeg", ".tif", ".tiff", ".webp")
Run = TypeVar("Run", bound=Callable[[argparse.Namespace], int])


@dataclass(frozen=True)
class Option:
    """An option or an argument, as argparse is told of it.

    endings : of a file that the command writes, what its name may end in (none: anything); None
    for all else.
    """

    names: tuple[str, ...]
    settings: Mapping[str, Any]
    endings: tuple[str, ...] | None = None

    def add(self, command: Any) -> None:
        """To a parser, or a group of one."""
        command.add_argument(*self.names, **self.settings)

    def require_writable(self, options: argparse.Namespace) -> None:
        """What is to be written can be: asked before a long run, not after it.

        Raises WriteError, and InputError for another ending, or a workbook without XlsxWriter.
        """
        if self.endings is None:
            return
        name = self.names[0]
        target = getattr(options, name.lstrip("-").replace("-", "_"))
        if target is None:
            return
        ending = target.suffix.lower()
        if self.endings and ending not in self.endings:
            shown = ", ".join(self.endings[:3])
            raise InputError(f"{name} {target}: give a name that ends in {shown}")
        require_place(target)
        if ending == ".xlsx":
            from ..figures.workbook import require_writer

            require_writer()


@dataclass(frozen=True)
class OneOf:
    """Options of which one must be given."""

    options: tuple[Option, ...]

    def add(self, command: Any) -> None:
        """See :class:`Option`."""
        group = command.add_mutually_exclusive_group(required=True)
        for one in self.options:
            one.add(group)


@dataclass(frozen=True)
class Command:
    """A command: a line of ``help``, what it is ``about``, its options, and ``run``.

    fails : errors that say that there is no result, rather than bad input (exit code 1).
    """

    help: str
    about: str | None
    epilog: str | None
    options: tuple[Option | OneOf, ...]
    run: Callable[[argparse.Namespace], int]
    fails: tuple[type[Exception], ...]

    def add(self, commands: Any, name: str, *habits: Option) -> None:
        """To the parser's commands; habits : options that all commands have, where this one has
        none of its own.
        """
        parser = commands.add_parser(
            name, help=self.help, description=self.about, epilog=self.epilog
        )
        own = {n for o in self.options if isinstance(o, Option) for n in o.names}
        for one in (*self.options, *(h for h in habits if h.names[-1] not in own)):
            one.add(parser)
        parser.set_defaults(run=self.run)

    def require_writable(self, options: argparse.Namespace) -> None:
        """See :meth:`Option.require_writable`."""
        for one in self.options:
            if isinstance(one, Option):
                one.require_writable(options)


COMMANDS: dict[str, Command] = {}


def command(
    name: str,
    help: str,
    *options: Option | OneOf,
    about: str | None = None,
    epilog: str | None = None,
    json: bool = True,
    fails: type[Exception] | tuple[type[Exception], ...] = (),
) -> Callable[[Run], Run]:
    """Registers the function as what a command does; see :class:`Command`. json : has --json."""

    def registered(run: Run) -> Run:
        every = (*options, JSON) if json else options
        errors = fails if isinstance(fails, tuple) else (fails,)
        COMMANDS[name] = Command(help, about, epilog, every, run, errors)
        return run

    return registered


# ---- kinds of options ----------------------------------------------------------------------------
def option(name: str, metavar: str | None, help: str | None = None, **more: Any) -> Option:
    """A text, unless ``type`` says otherwise; an argument where the name has no dashes."""
    return Option((name,), {"metavar": metavar, "help": help, **more})


class _Joined(argparse.Action):
    """Keeps the values of an option that is repeated, where argparse has the last alone."""

    def __call__(self, _: Any, options: Any, values: Any, __: Any = None) -> None:
        before = getattr(options, self.dest)
        setattr(options, self.dest, values if before is self.default else [*before, *values])


def several(name: str, metavar: str, help: str | None = None, **more: Any) -> Option:
    """One or more, together or one by one."""
    return option(name, metavar, help, **{"nargs": "+", "action": _Joined, **more})


def repeated(name: str, metavar: str, help: str, **more: Any) -> Option:
    """One, as often as it is given."""
    return option(name, metavar, help, action="append", **more)


def flag(name: str, help: str, **more: Any) -> Option:
    """Given or not."""
    return Option((name,), {"action": "store_true", "help": help, **more})


def choice(name: str, known: tuple[str, ...], help: str | None = None, **more: Any) -> Option:
    """One of these."""
    return Option((name,), {"choices": known, "help": help, **more})


def count(name: str, metavar: str | None, help: str, **more: Any) -> Option:
    """A whole number."""
    return option(name, metavar, help, type=whole, **more)


def file(name: str, metavar: str, help: str | None = None, **more: Any) -> Option:
    """A file that is read, or a folder."""
    return option(name, metavar, help, type=Path, **more)


def output(name: str, metavar: str, help: str, *endings: str, **more: Any) -> Option:
    """A file that is written."""
    made = file(name, metavar, help, **more)
    return Option(made.names, made.settings, endings)


def named(name: str, words: str) -> Option:
    """NAME=VALUE, which :func:`pairs` reads."""
    return repeated(name, "NAME=VALUE", f"{words} (may be repeated)", default=[])


def plot(words: str) -> Option:
    """--plot"""
    return output("--plot", "FILE.png", f"{words} (.png, .pdf, .svg)", *PICTURES)


JSON = flag("--json", "print one JSON document instead of text; SI")


# ---- what they hold ------------------------------------------------------------------------------
def whole(text: str) -> int:
    """A whole number of at most nine digits, as argparse asks for it."""
    try:
        number = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number") from None
    if abs(number) > 999_999_999:
        raise argparse.ArgumentTypeError(f"{len(text)} digits are more than a number of this kind")
    return number


def number(text: str) -> float:
    """A number, as argparse asks for it."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None


def seconds(text: str) -> float:
    """A time [s] of "2 min" or "120", as argparse asks for it."""
    with suppress(ValueError):
        return float(text)
    try:
        return quantity("the time", text, "s")
    except InputError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def pairs(option: str, texts: Sequence[str]) -> dict[str, str]:
    """{name: value} of texts NAME=VALUE. Raises InputError."""
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not value or not name.strip():
            raise InputError(f"{option} {text}: give NAME=VALUE, as mass=2kg or mass=2.0")
        if name.strip() in found:
            raise InputError(f"{option} {text}: {name.strip()} is given twice; give it once")
        found[name.strip()] = value
    return found


def asked(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """{name: value} of those options that were given."""
    said = {name: getattr(options, name) for name in names}
    return {name: value for name, value in said.items() if value is not None}

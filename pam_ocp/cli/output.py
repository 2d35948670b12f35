"""What a command says: text for people, or one JSON document; where it wrote; and how far it is."""

from __future__ import annotations

import argparse
import ast
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core.files import spelled
from ..core.progress import Bar, listening

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def tell(
    options: argparse.Namespace,
    text: object,
    data: Mapping[str, Any] | Callable[[], Any] | None = None,
) -> None:
    """Print ``text``, or keep ``data`` (or what it returns) for the JSON document."""
    if getattr(options, "json", False):
        said = data() if callable(data) else data
        if said is None:
            return
        if isinstance(said, Mapping):
            options.said = {**getattr(options, "said", {}), **said}
        else:
            options.said = said
    elif not options.quiet:
        print(command_words(str(text), options), flush=True)


@contextmanager
def escaping() -> Iterator[None]:
    """What the terminal's encoding lacks (LC_ALL=C, names that are no text) is printed escaped."""
    out: Any = sys.stdout
    if not hasattr(out, "reconfigure"):
        yield
        return
    before = out.errors
    out.reconfigure(errors="backslashreplace")
    try:
        yield
    finally:
        ours = sys.stdout is out  # it may have been given up
        if ours:
            out.reconfigure(errors=before)


def wrote(options: argparse.Namespace, path: object) -> None:
    """A file was written."""
    if getattr(options, "json", False):
        said = getattr(options, "said", {})
        if isinstance(said, dict):
            said.setdefault("written", []).append(str(path))
            options.said = said
    elif not options.quiet:
        print(f"-> {spelled(str(path))}")


def deliver(options: argparse.Namespace, **writers: Callable[[Path], object]) -> None:
    """Write the files that are asked for: {option: what writes one, and returns its path}."""
    for name, write in writers.items():
        path = getattr(options, name)
        if path:
            wrote(options, write(path))


def picture(draw: Callable[[], Figure], dpi: float = 130) -> Callable[[Path], Path]:
    """What writes a figure, which is drawn then."""

    def write(path: Path) -> Path:
        from ..figures.canvas import save_figure

        return save_figure(draw(), path, dpi)

    return write


def finish(options: argparse.Namespace) -> None:
    """Print the JSON document, if there is one."""
    if getattr(options, "json", False) and hasattr(options, "said"):
        encoding = getattr(sys.stdout, "encoding", None) or "utf-8"
        ascii_only = "utf" not in encoding.lower()
        print(json.dumps(plain(options.said), ensure_ascii=ascii_only))


def plain(value: Any) -> Any:
    """As JSON has it: no NaN, no infinity, no arrays."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str | int | bool) or value is None:
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Sequence):
        return [plain(v) for v in value]
    return str(value)


def coefficients(fit: Any) -> dict[str, Any]:
    """Of any fit: {name: value, standard error, interval, unit}."""
    intervals = fit.intervals()
    return {
        n: {
            "value": c.value,
            "stderr": c.stderr,
            "interval": list(intervals.get(n, (c.value, c.value))),
            "unit": c.unit,
        }
        for n, c in fit.coefficients.items()
    }


@contextmanager
def logged(level: int) -> Iterator[None]:
    """For this block, the loggers ``pam_ocp.*`` print to the error stream: 1 info, 2 all."""
    if not level:
        yield
        return
    import logging

    logger = logging.getLogger(__package__.partition(".")[0])
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(name)s: %(message)s"))
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO if level == 1 else logging.DEBUG)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


# ---- messages in the words of a command: its options in place of Python's arguments --------------
def command_of(options: argparse.Namespace) -> argparse.ArgumentParser:
    """The parser of the command that was given."""
    (commands,) = (a for a in options.parser._actions if a.dest == "command")
    found: argparse.ArgumentParser = commands.choices[options.command]
    return found


def command_words(text: str, options: argparse.Namespace) -> str:
    """A message as the command says it: ``--clock cut`` for ``clock='cut'``.

    What the command has no option for stays; so do lines that show a call of Python.
    """
    if not hasattr(options, "parser"):  # what a command does is called from elsewhere
        return text
    named = [
        (action.dest, long)
        for action in command_of(options)._actions
        if (long := next((o for o in action.option_strings if o.startswith("--")), None))
    ]
    lines = text.split("\n")
    return "\n".join(x if x.startswith("  call: ") else _line(x, named) for x in lines)


def _line(text: str, named: list[tuple[str, str]]) -> str:
    text = re.sub(r" \(of read_table, or table\.with_floor\('\w+'\)\)", "", text)
    if "rest_length" in dict(named):
        example = r"rest_length in metres, as in read_table\(.*?\)"
        text = re.sub(example, "--rest-length, as --rest-length '300 mm'", text)
    text = re.sub(r"\bread_\w+\(\.\.\., (\w+=[^)]*)\)", r"\1", text)
    for name, option in named:
        text = text.replace(f"{name}=True", option)
        # mass=2.0 alone is an example of NAME=VALUE
        plain = r"|[\d.]*\d" if "_" in name else ""
        value = rf"(\{{[^}}]*\}}|\[(?:'[^']*'|[^\[\]'])*\]|'[^']*'|None|\.\.\.{plain})(?!\w)"
        text = re.sub(rf"(?<![\w.]){name}={value}", partial(_option, option), text)
    return text


def _option(option: str, found: re.Match[str]) -> str:
    try:
        given = ast.literal_eval(found[1])
    except (SyntaxError, ValueError):
        return f"{option} {found[1]}"
    if given is None:
        return f"{option} none" if option != "--missing" else option  # of no text at all
    if isinstance(given, dict):
        parts = [f"{n}={'...' if v is ... else v}" for n, v in given.items()]
    else:
        several = given if isinstance(given, list) else [given]
        parts = ["..." if v is ... else str(v) for v in several]
    return " ".join([option, *map(_quoted, parts)])


def _quoted(part: str) -> str:
    return f"'{part}'" if set(part) & set(" *[]()") else part


# ---- bars with the time left, on a terminal; silence elsewhere -----------------------------------
SHORT = 1.0
"""What takes no longer shows no bar [s]."""


@contextmanager
def bars(wanted: bool = True) -> Iterator[None]:
    """For this block, long work shows a bar on the terminal's error stream."""
    if not wanted or not sys.stderr.isatty():
        yield
        return
    with listening(_bar):
        yield


def _bar(what: str, total: int | None) -> Bar:
    from tqdm import tqdm

    return _Shown(tqdm(total=total, desc=what, delay=SHORT, leave=False, file=sys.stderr))


class _Shown:
    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def step(self, more: int = 1, note: str = "") -> None:
        """See :class:`Bar`."""
        if note:
            self._bar.set_postfix_str(note, refresh=False)
        self._bar.update(more)

    def close(self) -> None:
        """See :class:`Bar`."""
        self._bar.close()
